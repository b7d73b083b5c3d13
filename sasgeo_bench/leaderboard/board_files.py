# SPDX-License-Identifier: Apache-2.0
"""Boards on disk: `leaderboard.parquet` is the master; tables of unknown origin are checked when read."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Any, Final

import pandas as pd
import pyarrow as pa
from pandas.api.types import is_numeric_dtype

from sasgeo_bench.errors import SasgeoError, StoreError
from sasgeo_bench.files.folders import (
    FIGURE_FILES,
    PICTURE_FILES,
    SITE,
    SITE_FOLDERS,
    check_known,
    check_site,
    fresh_folder,
    locked,
)
from sasgeo_bench.files.json import MOST_BYTES, parse_json
from sasgeo_bench.files.parquet import read_frame, read_schema, write_frame
from sasgeo_bench.files.paths import read_bounded
from sasgeo_bench.leaderboard.archive_record import BoardRecord, parse_record
from sasgeo_bench.regions.region import ATTRIBUTION, LICENCE
from sasgeo_bench.scoring import acceptance, controls, protection
from sasgeo_bench.scoring.controls import Verdict
from sasgeo_bench.scoring.rows import Row
from sasgeo_bench.scoring.verdicts import Finding
from sasgeo_bench.texts import csv_cell, json_text, one_line

LEADERBOARD: Final = "leaderboard"
PROTECTION: Final = "protection"
ACCEPTANCE: Final = "acceptance"
SCORES: Final = "scores"
ANSWERS: Final = "answers"
TABLES: Final = ("contrasts", "falsifiers", "controls", SCORES, ACCEPTANCE, PROTECTION, ANSWERS)  # beside the master
BOARD: Final = "board.json"
FIGURES: Final = "figures"
PICTURES: Final = "pictures"
PICTURES_FILE: Final = "pictures.json"
_AS_CSV: Final = (LEADERBOARD, PROTECTION)  # tables that are also written for a spreadsheet
_VERSIONS: Final = ("scorer_version", "task_version", "data_version", "made_by")  # stated in each table
BOARD_FILES: Final = (
    *(f"{LEADERBOARD}.{kind}" for kind in ("parquet", "csv", "md", "tex")),
    *(f"{SCORES}.parquet", "contrasts.parquet", "falsifiers.parquet", "controls.parquet", BOARD),
    *("contrasts.md", "controls.md"),
    *(f"{PROTECTION}.{kind}" for kind in ("parquet", "csv")),
    *(f"{ACCEPTANCE}.parquet", f"{ANSWERS}.parquet"),
    *("paper.parquet", "trials.parquet", "paper.md"),
)
MEND: Final = "score it again"
_TOP: Final = (*BOARD_FILES, FIGURES, PICTURES, *SITE_FOLDERS)


@dataclass(frozen=True, kw_only=True)
class Extra:
    """Additional files of a board.

    `tables` become <name>.parquet, `texts` files by name. `figures` maps names in `figures/` to functions that draw to
    a path, `pictures` names in `pictures/`, with the folder there, to contents.
    """

    tables: Mapping[str, pd.DataFrame] = field(default_factory=dict)
    texts: Mapping[str, str] = field(default_factory=dict)
    figures: Mapping[str, Callable[[Path], object]] = field(default_factory=dict)
    pictures: Mapping[str, bytes] = field(default_factory=dict)


def write_board(
    folder: Path,
    *,
    tables: Mapping[str, pd.DataFrame],
    texts: Mapping[str, str],
    about: Mapping[str, Any],
    extras: Sequence[Extra] = (),
) -> None:
    """Write a board completely or not at all; an older board of the same scorer version there is replaced.

    Each of `tables` becomes <name>.parquet, "leaderboard" and "protection" also a csv; `texts` are files by name,
    `about` the content of `board.json`. Raise StoreError if the folder holds a board of another scorer version, or
    something that is no part of a board, or cannot be written; an older board is then unchanged.
    """
    versions = {name: str(about[name]) for name in _VERSIONS if name in about}
    metadata = {"attribution": ATTRIBUTION, "licence": LICENCE, **versions}
    content = {**about, "licence": LICENCE, "attribution": ATTRIBUTION}
    try:
        with locked(folder, tell=lambda _: None):
            check_board(folder, scorer_version=int(about["scorer_version"]))
            with fresh_folder(folder) as scratch:
                for part in (Extra(tables=tables, texts=texts), *extras):
                    _write_part(scratch, part, metadata)
                for name in (one for one in _AS_CSV if one in tables):
                    (scratch / f"{name}.csv").write_text(csv_text(tables[name]), encoding="utf-8", newline="")
                content = {name: value for name, value in content.items() if name != "failed" or value}
                (scratch / BOARD).write_text(json_text(content), encoding="utf-8")
    except SasgeoError:
        raise
    except OSError as error:
        raise StoreError(
            f"{folder} cannot be written ({error.strerror or error}): check the free space and your rights, and score "
            "again; a board that was there is as it was"
        ) from error


def csv_text(table: pd.DataFrame) -> str:
    """Return a table for a spreadsheet, with an apostrophe before a text that it would take for a formula.

    >>> csv_text(pd.DataFrame({"matcher": ["=1+1"], "value": [0.5]})).splitlines()
    ['matcher,value', "'=1+1,0.5"]
    """
    texts = {name: column for name, column in table.items() if not is_numeric_dtype(column)}
    safe = {str(name): column.map({one: csv_cell(one) for one in column.unique()}) for name, column in texts.items()}
    return str(table.assign(**safe).to_csv(index=False, lineterminator="\n"))


def _write_part(folder: Path, part: Extra, metadata: Mapping[str, str]) -> None:
    for name, frame in part.tables.items():
        write_frame(frame, folder / f"{name}.parquet", attrs=metadata, **metadata)
    for name, text in part.texts.items():
        (folder / name).write_text(text, encoding="utf-8")
    for name, draw in part.figures.items():
        (folder / FIGURES).mkdir(exist_ok=True)
        draw(folder / FIGURES / name)
    for name, content in part.pictures.items():
        path = folder / PICTURES / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(content)


def check_board(folder: Path, *, scorer_version: int) -> None:
    """Refuse a folder that a board of this scorer version cannot replace.

    Raise StoreError if it holds a board of another scorer version, or something that is no part of a board.
    """
    if folder.exists() and not folder.is_dir():
        raise StoreError(f"{folder} is a file: move it away, a board goes there")
    other = next((path for path in sorted(folder.glob("*")) if path.name not in _TOP), None)
    if other is not None:
        raise StoreError(f"{other} is no part of a board and would be lost: move it away, or name another board")
    drawn = (*FIGURE_FILES, f"{FIGURES}/*.png", *PICTURE_FILES)  # figures of the paper's experiment are PNG, too
    check_known(folder, BOARD_FILES, "a board", patterns=drawn, without=SITE_FOLDERS)
    check_site(folder / SITE)
    # A file that is gone by now went with the board that another writer has just replaced.
    versions = ((path, _version(path)) for path in sorted(folder.glob("*.parquet")))
    found = next((version for path, version in versions if version != str(scorer_version) and path.exists()), None)
    if found is not None:
        raise StoreError(
            f"{folder} holds rows of scorer version {found}, this one is {scorer_version}: figures of two never share "
            "a board; name another one, or move it away and score again"
        )


def _version(path: Path) -> str:
    try:
        metadata = dict(read_schema(path, mend=MEND).metadata or {})
        return str(metadata.get(b"scorer_version", b"unknown"), encoding="utf-8")
    except (StoreError, UnicodeDecodeError):
        return "unknown"


def read_board(folder: Path) -> tuple[dict[str, Any], pd.DataFrame]:
    """Read `board.json` and the leaderboard.

    Raise StoreError if there is none, or a file is damaged.
    """
    try:
        data = read_bounded(folder / BOARD, MOST_BYTES)
        parse_record(data, BoardRecord)
        return dict(parse_json(data)), read_frame(folder / f"{LEADERBOARD}.parquet", mend=MEND)
    except StoreError:
        raise
    except NotADirectoryError as error:
        raise StoreError(f"{folder} is a file: name the folder of a board") from error
    except FileNotFoundError as error:
        raise StoreError(f"{folder} holds no board: score some runs first") from error
    except (OSError, ValueError, TypeError, KeyError, MemoryError, pa.ArrowException) as error:
        raise StoreError(f"{folder} holds a damaged board ({one_line(str(error))}): score it again") from error


def read_scores(folder: Path) -> pd.DataFrame:
    """Read the scored rows of all entries of a board.

    Raise StoreError if they are missing or damaged.
    """
    return read_frame(folder / f"{SCORES}.parquet", mend=MEND)


_TEXTS: Final = frozenset(
    {
        *("contrast", "suite", "kind", "matcher", "prior_group", "method", "supports"),
        *("rejector", "track", "mixture", "absence"),
    }
)
_FINDING: Final = {item.name: item.type for item in fields(Finding)} | {"outcome": str, "verdict": str}
ANSWER_COLUMNS: Final = (
    *("query_id", "matcher", "suite", "region", "kind", "role", "is_present", "status", "failure", "view_m"),
    *("true_easting_m", "true_northing_m", "true_yaw_deg", "fix_easting_m", "fix_northing_m", "fix_yaw_deg"),
)
_SHAPES: Final[Mapping[str, Mapping[str, Any]]] = {
    "leaderboard": {item.name: item.type for item in fields(Row)},
    "contrasts": _FINDING,
    "falsifiers": {name: str if name in _TEXTS else _FINDING[name] for name in controls.FALSIFIER_COLUMNS},
    "controls": {item.name: item.type for item in fields(Verdict)},
    "acceptance": {name: str if name in _TEXTS else float for name in acceptance.COLUMNS},
    "protection": {name: str if name in _TEXTS else float for name in protection.COLUMNS},
    "scores": {
        **dict.fromkeys(("query_id", "matcher", "suite", "track", "kind", "role", "place"), str),
        "is_present": bool,
    },
    ANSWERS: {
        name: bool if name == "is_present" else float if name.endswith(("_m", "_deg")) else str
        for name in ANSWER_COLUMNS
    },
}


def check_shape(name: str, table: pd.DataFrame) -> None:
    """Refuse a table, as "leaderboard", with a column that is missing, of another type, or without a required value.

    A table that is optional on a board may be without columns. Raise StoreError naming the file and the column.

    >>> check_shape("controls", pd.DataFrame({"control": ["blind"]}))
    Traceback (most recent call last):
        ...
    sasgeo_bench.errors.StoreError: controls.parquet has no column 'matcher': score it again
    """
    if name != "leaderboard" and not len(table.columns):
        return
    for column, kind in _SHAPES[name].items():
        if list(table.columns).count(column) != 1:
            fault = "two columns" if column in table else "no column"
            raise StoreError(f"{name}.parquet has {fault} {column!r}: score it again")
        if len(table) and not _is_of(table[column], kind):
            raise StoreError(
                f"{name}.parquet: {column} holds something else than it should, or nothing: score it again"
            )


def _is_of(values: "pd.Series[Any]", kind: object) -> bool:
    """Return whether a column holds texts, booleans or whole numbers without a gap, or numbers with gaps."""
    if kind is str:
        return bool(values.map(lambda one: isinstance(one, str)).all())
    if kind is bool:
        return bool(pd.api.types.is_bool_dtype(values)) and not values.isna().any()
    is_number = pd.api.types.is_numeric_dtype(values) and not pd.api.types.is_bool_dtype(values)
    if kind is int:
        return bool(pd.api.types.is_integer_dtype(values)) and not values.isna().any()
    return bool(is_number) or bool(values.isna().all())
