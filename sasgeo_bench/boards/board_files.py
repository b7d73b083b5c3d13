# SPDX-License-Identifier: Apache-2.0
"""Boards on disk: `leaderboard.parquet` is the master; tables of unknown origin are checked when read."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final, get_args

import pandas as pd
from pandas.api.types import is_numeric_dtype

from sasgeo_bench.boards.manifests import BoardManifest, parse_record
from sasgeo_bench.core.errors import SasgeoError, StoreError
from sasgeo_bench.core.folders import (
    FIGURE_FILES,
    PICTURE_FILES,
    SITE,
    SITE_FOLDERS,
    check_known,
    check_site,
    fresh_folder,
    locked,
)
from sasgeo_bench.core.json import MOST_BYTES
from sasgeo_bench.core.parquet import read_frame, read_schema, write_frame
from sasgeo_bench.core.paths import read_bounded
from sasgeo_bench.core.texts import csv_cell, json_text, one_line
from sasgeo_bench.regions.region import LICENCE
from sasgeo_bench.scoring.compare import CONTRAST_SCHEMA
from sasgeo_bench.scoring.controls import CONTROL_SCHEMA, FALSIFIER_SCHEMA
from sasgeo_bench.scoring.flights import SCORE_SCHEMA
from sasgeo_bench.scoring.frames import Column, Schema
from sasgeo_bench.scoring.metrics import primary_of
from sasgeo_bench.scoring.protection import PROTECTION_SCHEMA
from sasgeo_bench.scoring.rejection import ACCEPTANCE_SCHEMA
from sasgeo_bench.scoring.requirements import COMPLIANCE_SCHEMA
from sasgeo_bench.scoring.rows import LEADERBOARD_SCHEMA
from sasgeo_bench.tasks.query import Track

LEADERBOARD: Final = "leaderboard"
PROTECTION: Final = "protection"
ACCEPTANCE: Final = "acceptance"
SCORES: Final = "scores"
REQUIREMENTS: Final = "requirements"
ANSWERS: Final = "answers"
TABLES: Final = (
    "contrasts",
    "falsifiers",
    "controls",
    SCORES,
    ACCEPTANCE,
    PROTECTION,
    REQUIREMENTS,
    ANSWERS,
)  # not the master
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
    *(f"{name}.parquet" for name in (ACCEPTANCE, REQUIREMENTS, ANSWERS)),
    *("paper.parquet", "trials.parquet", "paper.md"),
)
MEND: Final = "score it again"
_TOP: Final = (*BOARD_FILES, FIGURES, PICTURES, *SITE_FOLDERS)


@dataclass(frozen=True, kw_only=True)
class AdditionalFiles:
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
    about: BoardManifest,
    failed: Mapping[str, str] | None = None,
    extras: Sequence[AdditionalFiles] = (),
) -> None:
    """Write a board completely or not at all; an older board of the same scorer version there is replaced.

    Each of `tables` becomes <name>.parquet, "leaderboard" and "protection" also a csv; `about` is the manifest;
    `failed` grows until the last file is made. Raise StoreError if the folder holds a board of
    another scorer version, or something that is no part of a board, or cannot be written; an older board is then
    unchanged.
    """
    versions = {name: str(getattr(about, name)) for name in _VERSIONS if getattr(about, name) is not None}
    metadata = {"attribution": about.credit, "licence": LICENCE, **versions}
    try:
        with locked(folder):
            check_board(folder, scorer_version=about.scorer_version)
            with fresh_folder(folder) as scratch:
                for part in (AdditionalFiles(tables=tables), *extras):
                    _write_part(scratch, part, metadata)
                for name in (one for one in _AS_CSV if one in tables):
                    (scratch / f"{name}.csv").write_text(csv_text(tables[name]), encoding="utf-8", newline="")
                whole = about.model_copy(update={"failed": dict(about.failed if failed is None else failed)})
                content = {
                    **whole.model_dump(mode="json", exclude_unset=True),
                    "licence": LICENCE,
                    "attribution": about.credit,
                }
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


def _write_part(folder: Path, part: AdditionalFiles, metadata: Mapping[str, str]) -> None:
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


def read_board_manifest(folder: Path) -> BoardManifest:
    """Read `board.json`; raise StoreError if there is none, or it is damaged."""
    try:
        return parse_record(read_bounded(folder / BOARD, MOST_BYTES), BoardManifest)
    except NotADirectoryError as error:
        raise StoreError(f"{folder} is a file: name the folder of a board") from error
    except FileNotFoundError as error:
        raise StoreError(f"{folder} holds no board: score some runs first") from error
    except (OSError, ValueError, MemoryError) as error:
        raise StoreError(f"{folder} holds a damaged board ({one_line(str(error))}): score it again") from error


def read_leaderboard(folder: Path) -> pd.DataFrame:
    """Read every figure of a board; raise StoreError if the table is missing, damaged or has a share beyond 0..1."""
    path = folder / f"{LEADERBOARD}.parquet"
    frame = read_frame(path, mend=MEND)
    if {"metric", "value", "matcher"} <= set(frame) and is_numeric_dtype(frame["value"]):
        shares = frame[frame["metric"].isin([primary_of(track).name for track in get_args(Track)])]
        wrong = shares[shares["value"].notna() & ~shares["value"].between(0.0, 1.0)]
        if len(wrong):
            name, metric, value = wrong.iloc[0][["matcher", "metric", "value"]]
            raise StoreError(f"{path}: {one_line(str(metric))} of {one_line(str(name))} is {value}, not 0..1: {MEND}")
    return frame


def read_scores(folder: Path) -> pd.DataFrame:
    """Read the scored rows of all entries of a board.

    Raise StoreError if they are missing or damaged.
    """
    return read_frame(folder / f"{SCORES}.parquet", mend=MEND)


_OF_SCORES: Final = ("query_id", "matcher", "suite", "region", "kind", "role", "is_present", "status")
ANSWER_SCHEMA: Final = Schema(
    ANSWERS,
    (
        *map(SCORE_SCHEMA.__getitem__, _OF_SCORES),
        Column("failure", str, "Class of the failure; empty where there is none"),
        Column("view_m", float, "Side of the view"),
        *(
            Column(f"{what}_{name}", float, f"{title}, to a tenth; NaN without one")
            for what, title in (("true", "True pose, also of an absent place"), ("fix", "Pose of the fix"))
            for name in ("easting_m", "northing_m", "yaw_deg")
        ),
    ),
)
SCHEMAS: Final[Mapping[str, Schema]] = {
    schema.name: schema
    for schema in (
        *(LEADERBOARD_SCHEMA, SCORE_SCHEMA, CONTRAST_SCHEMA, FALSIFIER_SCHEMA, CONTROL_SCHEMA),
        *(ACCEPTANCE_SCHEMA, PROTECTION_SCHEMA, COMPLIANCE_SCHEMA, ANSWER_SCHEMA),
    )
}
