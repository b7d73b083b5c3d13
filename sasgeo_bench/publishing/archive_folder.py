# SPDX-License-Identifier: Apache-2.0
"""A folder of stored results: check its record, files and rows; replace it only by its like."""

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Final, get_args

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from sasgeo_bench.errors import ConfigError, MatchError, StoreError
from sasgeo_bench.files.folders import (
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
    sha256_of,
)
from sasgeo_bench.files.json import MOST_BYTES
from sasgeo_bench.files.paths import read_bounded
from sasgeo_bench.leaderboard.archive_record import ArchiveRecord, VersionRecord, parse_record
from sasgeo_bench.leaderboard.board_files import BOARD, BOARD_FILES, LEADERBOARD
from sasgeo_bench.running.prediction_files import differing_columns, row_faults
from sasgeo_bench.tasks.query import Detector, PriorGroup
from sasgeo_bench.tasks.task_files import ASKED, HEAD_SCHEMA, POSE_FIELDS, STEP_COLUMNS, TRUTH_SCHEMA, VIEW_BYTES
from sasgeo_bench.texts import one_line

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
    """Return whether a folder holds stored results."""
    return (folder / PACK).is_file()


def read_settings(folder: Path) -> dict[str, Any]:
    """Read the settings that stored results were scored with, after checking the folder against its hashes.

    Raise `StoreError` if there are none, or they are damaged or of another schema.
    """
    with sound(folder):
        data = read_bounded(folder / PACK, MOST_BYTES)
        found = parse_record(data, VersionRecord).schema_version
        if found not in _READ:
            raise StoreError(
                f"{folder} has schema version {found!r}, this version reads {SCHEMA_VERSION}: fetch them again"
            )
        record = parse_record(data, ArchiveRecord)
        if record.files is None and found != _WITHOUT_HASHES:
            raise ValueError(f"{PACK} lists no files")
        if record.files is None:
            list_files(folder, without=SITE_FOLDERS)
            return record.model_dump()
        files = {**record.files, PACK: sha256_of(folder / PACK)}
        fault = first_difference(folder, files, without=SITE_FOLDERS)
        if fault is not None:
            raise StoreError(f"{folder} differs from what {PACK} says ({one_line(fault)}): fetch the results again")
        return record.model_dump()


@contextmanager
def sound(folder: Path) -> Iterator[None]:
    """Turn any error of reading stored results into a `StoreError` of one line that names their folder."""
    try:
        yield
    except StoreError:
        raise
    except (
        *(OSError, ValueError, KeyError, TypeError, AttributeError, RecursionError, MatchError),
        *(MemoryError, pa.ArrowException),
    ) as error:
        text = one_line(str(error) if isinstance(error, ValueError) else repr(error))
        raise StoreError(f"{folder} holds no sound stored results ({text}): fetch them again") from error


def check_results(folder: Path, board: Path) -> None:
    """Refuse, before a board is made, a folder that it cannot be stored in.

    Raise `StoreError` if the folder holds something else, is a file or cannot be written, or if it or the board's
    folder would lie in the other.
    """
    check_replaced(folder)
    target, other = resolve_link(folder).absolute(), resolve_link(board).absolute()
    target, other = target.parent.resolve() / target.name, other.parent.resolve() / other.name
    around = next((one for one in target.parents if one == other or (one / BOARD).is_file()), None)
    if around is not None or target == other or target in other.parents:
        raise StoreError(
            f"{folder} would lie in the board {around}: name another folder"
            if around is not None
            else f"{folder} would take the place of the board {board}: name another folder"
        )
    check_room(resolve_link(folder))


def check_replaced(folder: Path) -> None:
    """Raise `StoreError` if a folder holds anything but stored results, naming the file that would be lost."""
    if folder.exists() and not is_pack(folder) and (not folder.is_dir() or any(folder.iterdir())):
        raise StoreError(f"{folder} holds something else than stored results, which would be lost: name another folder")
    if is_pack(folder):
        try:
            listed = parse_record(read_bounded(folder / PACK, MOST_BYTES), ArchiveRecord).files
        except (OSError, ValueError):
            listed = None
        known, patterns = ({PACK}, _OLD_FILES) if listed is None else ({PACK, *listed}, ())
        check_known(folder, known, "stored results", patterns=patterns, without=SITE_FOLDERS)
        check_site(folder / SITE)


TASK: Final = "task"  # column: number of the row in tasks.parquet
TASK_SCHEMA: Final = pa.schema([(name, pa.string()) for name in ("task_json", "truth_json", "region_json")])
MATCHER: Final = "matcher"  # column: whose answer it is
LEARNED: Final = "learned"  # column: text that was learned for a run
RUNS_SCHEMA: Final = pa.schema(
    [("contestant", pa.string()), ("rows", pa.int64()), ("about", pa.string()), (LEARNED, pa.string())]
)
_HEADS: Final = HEAD_SCHEMA.append(pa.field(ASKED, pa.string())).append(pa.field(VIEW_BYTES, pa.int64()))
_SCHEMAS: Final = {
    "runs": RUNS_SCHEMA,
    "tasks": TASK_SCHEMA,
    "queries": _HEADS.append(pa.field(TASK, pa.int32())),
    "truths": TRUTH_SCHEMA.append(pa.field(TASK, pa.int32())),
}
_PAIRS: Final = pa.list_(pa.struct([("key", pa.string()), ("value", pa.float64())]))
_MAY_BE_NULL: Final = {*POSE_FIELDS, *STEP_COLUMNS, "alias_index", "region_json", LEARNED}
_TRACKS: Final = ("retrieval", "localization", "sequence")
_ROLES: Final = ("control", "stress", "falsifier")
_KINDS: Final = (
    *(pa.types.is_string, pa.types.is_integer, pa.types.is_floating),
    *(pa.types.is_boolean, pa.types.is_list, pa.types.is_map),
)


def check_tables(tables: Mapping[str, pa.Table]) -> None:
    """Raise `ValueError`, naming table and column, if no board can be made of the tables of stored results.

    `tables` are "tasks", "queries" and "truths", and "runs" where they are read.
    """
    for name, table in tables.items():
        _check_columns(name, table)
    if "runs" in tables:
        _refuse("runs", "rows", _numbers(tables["runs"]["rows"]) < 0)
    queries, truths = tables["queries"], tables["truths"]
    for name in ("queries", "truths"):
        number = _numbers(tables[name][TASK])
        _refuse(name, TASK, (number < 0) | (number >= len(tables["tasks"])) | (np.diff(number, prepend=0) < 0))
    if queries["query_id"].combine_chunks() != truths["query_id"].combine_chunks():
        raise ValueError("truths.parquet: its rows are not those of queries.parquet")
    if pc.count_distinct(queries["query_id"]).as_py() != len(queries):
        raise ValueError("queries.parquet: a query_id is there twice")
    _check_queries(queries)
    _check_truths(truths, queries)


def _numbers(column: pa.ChunkedArray) -> np.ndarray:
    return np.asarray(column.to_numpy())


def _refuse(name: str, column: str, is_wrong: np.ndarray) -> None:
    """Refuse a column with a wrong value, naming the first row that has one."""
    if is_wrong.any():
        raise ValueError(f"{name}.parquet, row {int(np.argmax(is_wrong))}: {column} holds no such value")


def _check_columns(name: str, table: pa.Table) -> None:
    """Refuse columns that are missing, there twice, of another type, or null where none may be."""
    for field in _SCHEMAS[name]:
        if table.column_names.count(field.name) != 1:
            raise ValueError(f"{name}.parquet holds no column {field.name!r}, or two")
        column = table[field.name]
        if not any(kind(field.type) and kind(column.type) for kind in _KINDS):
            raise ValueError(f"{name}.parquet: {field.name} is of type {column.type}")
        if field.name not in _MAY_BE_NULL:
            _refuse(name, field.name, _numbers(column.is_null()))


def _check_queries(queries: pa.Table) -> None:
    _refuse("queries", VIEW_BYTES, _numbers(queries[VIEW_BYTES]) < 0)
    _refuse("queries", "rows", _numbers(queries["rows"]) < 1)
    _refuse("queries", "cell_size_m", ~_is_positive(_numbers(queries["cell_size_m"])))
    _refuse("queries", "track", ~_is_in(queries["track"], _TRACKS))
    try:
        for prior_group in queries["prior_group"].unique().to_pylist():
            PriorGroup.parse(prior_group)
    except ConfigError as error:
        raise ValueError(f"queries.parquet: {error}") from error
    _check_poses("queries", _listed(queries["candidates"]))


def _check_truths(truths: pa.Table, queries: pa.Table) -> None:
    for column in ("strength", "unknown_share", "changed_share", "feature_density"):
        _refuse("truths", column, ~np.isfinite(_numbers(truths[column])))
    _refuse("truths", "role", ~_is_in(truths["role"], _ROLES))
    _refuse("truths", "detector", ~_is_in(truths["detector"], get_args(Detector)))
    is_present, candidate = _numbers(truths["is_present"]).astype(bool), _numbers(truths["candidate"])
    counts = _numbers(pc.list_value_length(queries["candidates"]))
    is_retrieval = _is_in(queries["track"], ("retrieval",))
    _refuse("truths", "candidate", (candidate < -1) | (candidate >= counts) & (candidate >= 0))
    _refuse("truths", "candidate", is_present & is_retrieval & (candidate < 0))
    has_pose = np.array([_numbers(truths[name].is_valid()) for name in POSE_FIELDS])
    _refuse("truths", "easting_m", has_pose.any(axis=0) != has_pose.all(axis=0))
    _refuse("truths", "easting_m", is_present & ~is_retrieval & ~has_pose.any(axis=0))
    _check_poses("truths", truths.filter(pa.array(has_pose.all(axis=0))).select(list(POSE_FIELDS)))
    _refuse("truths", "measured", _numbers(_listed(truths["measured"].cast(_PAIRS))["value"].is_null()))


def check_predictions(table: pa.Table) -> None:
    """Raise `ValueError`, naming the column, if no runner has written such answers."""
    for column, found, expected in differing_columns(table):
        raise ValueError(f"predictions.parquet: {column}: found {found}, expected {expected}")
    for wrong in row_faults(table):
        place = f"predictions.parquet, row {wrong.row}, {wrong.column}"
        raise ValueError(f"{place}: found {wrong.found}, expected {wrong.expected}")


def _listed(column: pa.ChunkedArray) -> pa.Table:
    """Return all items of a column of lists of structs."""
    return pa.Table.from_struct_array(pc.list_flatten(column))


def _check_poses(name: str, poses: pa.Table) -> None:
    """Refuse poses with a value that is not finite, or a scale that is not positive."""
    for column in POSE_FIELDS:
        _refuse(name, column, ~np.isfinite(_numbers(poses[column]).astype(float)))
    _refuse(name, "scale", ~_is_positive(_numbers(poses["scale"]).astype(float)))


def _is_positive(values: np.ndarray) -> np.ndarray:
    return np.asarray(np.isfinite(values) & (values > 0))


def _is_in(column: pa.ChunkedArray, values: Sequence[str]) -> np.ndarray:
    return _numbers(pc.is_in(column, pa.array(values)))
