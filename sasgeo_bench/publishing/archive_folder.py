# SPDX-License-Identifier: Apache-2.0
"""A folder of stored results: what it says of itself, whether it is what it says, and what may take its place."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Final

import pyarrow as pa

from sasgeo_bench.bounds import one_line
from sasgeo_bench.errors import MatchError, StoreError
from sasgeo_bench.files.file_manifest import (
    FIGURE_FILES,
    PICTURE_FILES,
    SITE,
    SITE_FOLDERS,
    check_known,
    check_room,
    check_site,
    first_difference,
    list_files,
    resolve_link,
)
from sasgeo_bench.files.hashes import sha256_of
from sasgeo_bench.leaderboard.archive_record import ArchiveRecord, VersionRecord, parse_record
from sasgeo_bench.leaderboard.board_files import BOARD, BOARD_FILES, LEADERBOARD

PACK: Final = "pack.json"
SCHEMA_VERSION: Final = 3
_READ: Final = (1, 2, SCHEMA_VERSION)
_WITHOUT_HASHES: Final = 1  # the former layouts (1 and 2) hold figures, pictures, and a file for each matcher
PREDICTIONS: Final = "predictions.parquet"
RUNS: Final = "runs.parquet"
TABLES: Final = ("tasks", "queries", "truths")
FORMER_PREDICTIONS: Final = "predictions"
FORMER_LEARNED: Final = "learned"
_OLD_FILES: Final = (  # of results that list none
    *(*BOARD_FILES, f"{LEADERBOARD}.csv.gz", *FIGURE_FILES, *PICTURE_FILES),
    *(PACK, RUNS, *(f"{name}.parquet" for name in TABLES), f"{FORMER_PREDICTIONS}/*.parquet", f"{FORMER_LEARNED}/*"),
)


def is_pack(folder: Path) -> bool:
    """Return whether a folder holds stored results.

    Examples
    --------
    >>> is_pack(Path("nowhere"))
    False
    """
    return (folder / PACK).is_file()


def read_settings(folder: Path) -> dict[str, Any]:
    """Read the settings that stored results were scored with.

    Raises
    ------
    StoreError
        If there are none, or they are damaged or of another schema.
    """
    with sound(folder):
        data = (folder / PACK).read_bytes()
        found = parse_record(data, VersionRecord).schema_version
        if found not in _READ:
            message = f"{folder} has schema version {found!r}, this version reads {SCHEMA_VERSION}: fetch them again"
            raise StoreError(message)
        said = parse_record(data, ArchiveRecord)
        if said.files is None and found != _WITHOUT_HASHES:
            message = f"{PACK} lists no files"
            raise ValueError(message)
        if said.files is None:
            list_files(folder, without=SITE_FOLDERS)
            return said.model_dump()
        files = {**said.files, PACK: sha256_of(folder / PACK)}
        fault = first_difference(folder, files, without=SITE_FOLDERS)
        if fault is not None:
            message = f"{folder} differs from what {PACK} says ({one_line(fault)}): fetch the results again"
            raise StoreError(message)
        return said.model_dump()


@contextmanager
def sound(folder: Path) -> Iterator[None]:
    """Tell whatever is wrong with stored results in one line that names their folder."""
    try:
        yield
    except StoreError:
        raise
    except (
        *(OSError, ValueError, KeyError, TypeError, AttributeError, RecursionError, MatchError),
        *(MemoryError, pa.ArrowException),
    ) as error:
        text = one_line(str(error) if isinstance(error, ValueError) else repr(error))
        message = f"{folder} holds no sound stored results ({text}): fetch them again"
        raise StoreError(message) from error


def check_results(folder: Path, board: Path) -> None:
    """Refuse a folder that a board cannot be stored in, before the board is made.

    Parameters
    ----------
    folder : Path
        To write.
    board : Path
        Folder of the board.

    Raises
    ------
    StoreError
        If it holds something else, is a file or cannot be written, or one of the two would lie in the other.
    """
    check_replaced(folder)
    mine, other = resolve_link(folder).absolute(), resolve_link(board).absolute()
    mine, other = mine.parent.resolve() / mine.name, other.parent.resolve() / other.name
    around = next((one for one in mine.parents if one == other or (one / BOARD).is_file()), None)
    if around is not None or mine == other or mine in other.parents:
        message = (
            f"{folder} would lie in the board {around}: name another folder"
            if around is not None
            else f"{folder} would take the place of the board {board}: name another folder"
        )
        raise StoreError(message)
    check_room(resolve_link(folder))


def check_replaced(folder: Path) -> None:
    """Refuse to replace anything but stored results without a file of somebody else.

    Raises
    ------
    StoreError
        Naming what would be lost.
    """
    if folder.exists() and not is_pack(folder) and (not folder.is_dir() or any(folder.iterdir())):
        message = f"{folder} holds something else than stored results, which would be lost: name another folder"
        raise StoreError(message)
    if is_pack(folder):
        try:
            listed = parse_record((folder / PACK).read_bytes(), ArchiveRecord).files
        except (OSError, ValueError):
            listed = None
        known, patterns = ({PACK}, _OLD_FILES) if listed is None else ({PACK, *listed}, ())
        check_known(folder, known, "stored results", patterns=patterns, without=SITE_FOLDERS)
        check_site(folder / SITE)
