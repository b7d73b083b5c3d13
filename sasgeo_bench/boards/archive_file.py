# SPDX-License-Identifier: Apache-2.0
"""Stored results: a board's tables with the queries, truths and answers they were made of, in few small files.

Views are left out, for scores need none of them: matchers cannot be run on stored results, but every answer can be
scored again. Figures, pictures and tables for other programs are left out, too: `publish` makes them again.
"""

import json
import re
import shutil
from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Final, get_args

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from sasgeo_bench.boards.board_files import ANSWERS, BOARD, BOARD_FILES, LEADERBOARD
from sasgeo_bench.boards.board_files import MEND as BOARD_MEND
from sasgeo_bench.boards.manifests import PackManifest, VersionRecord, parse_record
from sasgeo_bench.core.errors import ConfigError, MatchError, SasgeoError, StoreError
from sasgeo_bench.core.folders import (
    FIGURE_FILES,
    PICTURE_FILES,
    SITE,
    SITE_FOLDERS,
    check_known,
    check_room,
    check_site,
    first_difference,
    fresh_folder,
    hashes_of,
    list_files,
    locked,
    resolve_link,
    sha256_of,
)
from sasgeo_bench.core.json import MOST_BYTES as MOST_JSON_BYTES
from sasgeo_bench.core.json import parse_json
from sasgeo_bench.core.parquet import MOST_VALUES, read_schema, read_table, write_table
from sasgeo_bench.core.paths import plain_file, read_bounded
from sasgeo_bench.core.texts import FOLDER, json_text, one_line
from sasgeo_bench.matching import cards
from sasgeo_bench.matching.cards import TrainingRecord
from sasgeo_bench.matching.matcher import Prediction
from sasgeo_bench.regions.region_files import MANIFEST
from sasgeo_bench.running.prediction_files import (
    RUN,
    RunManifest,
    differing_columns,
    prediction_row,
    predictions_of,
    row_faults,
    schema_of,
)
from sasgeo_bench.tasks import task_files
from sasgeo_bench.tasks.query import Detector, PriorGroup
from sasgeo_bench.tasks.task_files import (
    ASKED,
    HEAD_SCHEMA,
    POSE_FIELDS,
    QUERIES,
    STEP_COLUMNS,
    TRUTH,
    TRUTH_OF,
    TRUTH_SCHEMA,
    VIEW_BYTES,
    Task,
    answer_hash,
    with_added,
)

PACK: Final = "pack.json"
SCHEMA_VERSION: Final = 3
_READ: Final = (1, 2, SCHEMA_VERSION)
_WITHOUT_HASHES: Final = 1  # the former layouts (1 and 2) hold figures, pictures, and a file for each matcher
PREDICTIONS: Final = "predictions.parquet"
RUNS: Final = "runs.parquet"
TABLES: Final = ("tasks", "queries", "truths")
FORMER_PREDICTIONS: Final = "predictions"
FORMER_LEARNED: Final = "learned"
TASK: Final = "task"  # column: number of the row in tasks.parquet
TASK_SCHEMA: Final = pa.schema([(name, pa.string()) for name in ("task_json", "truth_json", "region_json")])
MATCHER: Final = "matcher"  # column: whose answer it is
LEARNED: Final = "learned"  # column: text that was learned for a run
RUNS_SCHEMA: Final = pa.schema(
    [("contestant", pa.string()), ("rows", pa.int64()), ("about", pa.string()), (LEARNED, pa.string())]
)
_OLD_FILES: Final = (  # of results that list none
    *(*BOARD_FILES, f"{LEADERBOARD}.csv.gz", *FIGURE_FILES, *PICTURE_FILES),
    *(PACK, RUNS, *(f"{name}.parquet" for name in TABLES), f"{FORMER_PREDICTIONS}/*.parquet", f"{FORMER_LEARNED}/*"),
)
MOST_BYTES: Final = 14_000_000  # 5,000 queries of 14 matchers; of flights each view has an answer of its own
_LEVEL: Final = 19
_PAGE_BYTES: Final = 2**28  # one page for each column: zstd finds what is alike in the answers of all matchers
_TEXTS: Final = (  # columns of short texts that come again
    *("query_id", "track", "suite", "part", "region", "prior_group", "status", "message", MATCHER, "about", LEARNED),
    *("diagnostics.key_value.key", "measured.key_value.key"),
)
# Of these only the first bytes are alike: split into bytes they are a tenth smaller.
_NOISY: Final = (
    *(f"candidates.list.element.{name}" for name in ("easting_m", "northing_m", "score")),
    *("latency_s", "confidence", "covariance.list.element"),
)
_MADE_AGAIN: Final = (".csv", ".tex")  # of a board: the same tables for other programs; `answers` are stored anyway
_MEND: Final = "fetch the results again"
_AGAIN: Final = "make the queries again"


def is_pack(folder: Path) -> bool:
    """Return whether a folder holds stored results."""
    return (folder / PACK).is_file()


def read_pack(folder: Path) -> PackManifest:
    """Read how stored results were scored, after checking the folder against its hashes.

    Raise `StoreError` if there are none, or they are damaged or of another schema.
    """
    with sound(folder):
        data = read_bounded(folder / PACK, MOST_JSON_BYTES)
        found = parse_record(data, VersionRecord).schema_version
        if found not in _READ:
            raise StoreError(
                f"{folder} has schema version {found!r}, this version reads {SCHEMA_VERSION}: fetch them again"
            )
        record = parse_record(data, PackManifest)
        if record.files is None and found != _WITHOUT_HASHES:
            raise ValueError(f"{PACK} lists no files")
        if record.files is None:
            list_files(folder, without=SITE_FOLDERS)
            return record
        files = {**record.files, PACK: sha256_of(folder / PACK)}
        fault = first_difference(folder, files, without=SITE_FOLDERS)
        if fault is not None:
            raise StoreError(f"{folder} differs from what {PACK} says ({one_line(fault)}): fetch the results again")
        return record


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
            listed = parse_record(read_bounded(folder / PACK, MOST_JSON_BYTES), PackManifest).files
        except (OSError, ValueError):
            listed = None
        known, patterns = ({PACK}, _OLD_FILES) if listed is None else ({PACK, *listed}, ())
        check_known(folder, known, "stored results", patterns=patterns, without=SITE_FOLDERS)
        check_site(folder / SITE)


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


@dataclass(frozen=True, slots=True, kw_only=True)
class StoredRun:
    """One run: its manifest, its answers, and the file that was learned for it, if any."""

    manifest: RunManifest
    predictions: Sequence[Prediction]
    learned: Path | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class Packed:
    """Result of writing: bytes in all, bytes and number of predictions."""

    total_bytes: int
    prediction_bytes: int
    predictions: int


def write_pack(
    folder: Path,
    *,
    board: Path,
    tasks: Sequence[Task],
    runs: Mapping[str, Sequence[StoredRun]],
    settings: PackManifest,
    most_bytes: int = MOST_BYTES,
) -> Packed:
    """Store a board with what it was made of, whole or not at all; older results in `folder` are replaced.

    `tasks` are all that were scored and `runs` those of each contestant, in the order they were read. `settings` lack
    what is known when the files are written. Raise `StoreError` if the files would exceed
    `most_bytes`, the folder holds something else, or a file cannot be read or written; what was there before stays as
    it was.
    """
    check_replaced(folder)
    folder = resolve_link(folder)
    try:
        with locked(folder), fresh_folder(folder) as scratch:
            _copy_tables(board, scratch)
            _write_tasks(scratch, tasks)
            _write_runs(scratch, runs)
            found = _write_predictions(scratch, runs)
            _write_settings(scratch, settings)
            total = sum(path.stat().st_size for path in scratch.rglob("*") if path.is_file())
            _check_size(folder, total, found, most_bytes)
    except SasgeoError:
        raise
    except OSError as error:
        raise StoreError(
            f"{folder} cannot be written ({one_line(str(error.strerror or error))}): check the free space and your "
            "rights; results that were there are as they were"
        ) from error
    count = sum(len(run.predictions) for listed in runs.values() for run in listed)
    return Packed(total_bytes=total, prediction_bytes=found, predictions=count)


def _copy_tables(board: Path, folder: Path) -> None:
    """Copy the tables and texts of a board, tables as small as they get."""
    for name in list_files(board, without=SITE_FOLDERS):  # refuses links: they would be followed to what they lead to
        source = board / name
        if name not in BOARD_FILES or source.suffix in _MADE_AGAIN or source.stem == ANSWERS:
            continue
        if source.suffix == ".parquet":
            table = read_table(source, mend=BOARD_MEND, most_rows=MOST_VALUES)
            words = [field.name for field in table.schema if not pa.types.is_floating(field.type)]
            _write_table(table, folder / name, dictionary=words)
        else:
            shutil.copyfile(source, folder / name)


def _write_settings(folder: Path, settings: PackManifest) -> None:
    files = hashes_of(folder, [name for name in list_files(folder) if name != PACK])
    whole = settings.model_copy(update={"files": files})
    (folder / PACK).write_text(json_text(whole.model_dump(mode="json")), encoding="utf-8")


def _check_size(folder: Path, total: int, predictions: int, most: int) -> None:
    if total > most:
        raise StoreError(
            f"{folder} would hold {total / 1e6:.1f} MB ({predictions / 1e6:.1f} MB of predictions), {most / 1e6:g} MB "
            "at most: store a pipeline of fewer matchers or sites, or of a smaller top_k; nothing was written"
        )


def _write_table(table: pa.Table, path: Path, *, dictionary: Sequence[str] = _TEXTS, split: Sequence[str] = ()) -> None:
    """Write a table as small as it gets without loss; columns that it lacks are passed over."""
    write_table(
        table,
        path,
        compression_level=_LEVEL,
        data_page_size=_PAGE_BYTES,
        row_group_size=max(len(table), 1),
        use_dictionary=_there(table, dictionary),
        column_encoding=dict.fromkeys(_there(table, split), "BYTE_STREAM_SPLIT"),
        write_statistics=False,
    )


def _there(table: pa.Table, paths: Sequence[str]) -> list[str]:
    return [path for path in paths if path.partition(".")[0] in table.column_names]


def _write_tasks(folder: Path, tasks: Sequence[Task]) -> None:
    """Write tasks without their views, and their truths."""
    rows, queries, truths = [], [], []
    for number, item in enumerate(tasks):
        region = item.region / MANIFEST
        rows.append(
            {
                "task_json": plain_file(item.folder / task_files.TASK).read_text(encoding="utf-8"),
                "truth_json": plain_file(item.truth / TRUTH_OF).read_text(encoding="utf-8"),
                "region_json": plain_file(region).read_text(encoding="utf-8") if region.is_file() else None,
            }
        )
        heads = _heads_of(item.folder / QUERIES)
        view_bytes = item.view_bytes()
        names = heads["query_id"].to_pylist()
        heads = heads.append_column(ASKED, pa.array([item.asked[name] for name in names], pa.string()))
        heads = heads.append_column(VIEW_BYTES, pa.array([view_bytes[name] for name in names], pa.int64()))
        queries.append(_numbered(heads, number))
        truth = read_table(item.truth / TRUTH, mend=_AGAIN, columns=TRUTH_SCHEMA.names)
        truths.append(_numbered(with_added(truth), number))
    _write_table(pa.Table.from_pylist(rows, schema=TASK_SCHEMA), folder / "tasks.parquet")
    _write_table(pa.concat_tables(queries), folder / "queries.parquet")
    _write_table(pa.concat_tables(truths), folder / "truths.parquet")


def _heads_of(path: Path) -> pa.Table:
    """Read queries without their views; tasks of older programs lack the columns of flights."""
    there = read_schema(path, mend=_AGAIN).names
    rows = read_table(path, mend=_AGAIN, columns=[name for name in HEAD_SCHEMA.names if name in there])
    return with_added(rows, STEP_COLUMNS).select(HEAD_SCHEMA.names)


def _numbered(table: pa.Table, number: int) -> pa.Table:
    return table.append_column(TASK, pa.array(np.full(len(table), number), pa.int32()))


def _write_runs(folder: Path, runs: Mapping[str, Sequence[StoredRun]]) -> None:
    """Write the record of each run, with what was learned for it."""
    rows = [
        {
            "contestant": name,
            "rows": len(run.predictions),
            "about": json.dumps(run.manifest.content()),
            LEARNED: None if run.learned is None else _text_of(run.learned),
        }
        for name, listed in runs.items()
        for run in listed
    ]
    _write_table(pa.Table.from_pylist(rows, schema=RUNS_SCHEMA), folder / RUNS)


def _file_of(run: RunManifest) -> str:
    """Return the folder of a matcher's runs: its name and its hash."""
    return f"{run.matcher.name}-{run.hash}"


def _write_predictions(folder: Path, runs: Mapping[str, Sequence[StoredRun]]) -> int:
    """Write all answers, one run after the other, and return how many bytes they are."""
    tables = []
    plain = schema_of(item for listed in runs.values() for run in listed for item in run.predictions)
    for name, listed in runs.items():
        rows = [prediction_row(item) for run in listed for item in run.predictions]
        table = pa.Table.from_pylist(rows, schema=plain)
        tables.append(table.append_column(MATCHER, pa.array([name] * len(rows), pa.string())))
    schema = plain.append(pa.field(MATCHER, pa.string()))
    _write_table(pa.concat_tables([schema.empty_table(), *tables]), folder / PREDICTIONS, split=_NOISY)
    return (folder / PREDICTIONS).stat().st_size


# --- back to folders --------------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True, kw_only=True)
class Unpacked:
    """Stored results as folders again, in the order they were scored."""

    root: Path
    tasks: tuple[Path, ...]
    runs: tuple[Path, ...]


def unpack(folder: Path, into: Path) -> Unpacked:
    """Lay stored results out in an empty folder as tasks/, truth/, regions/ and runs/, as they are scored.

    Raise `StoreError` if the results are damaged.
    """
    with sound(folder):
        tables = _read_tables(folder) | {"runs": _read_runs(folder)}
        check_tables(tables)
        tasks = tuple(_lay_tasks(tables, into))
        asked = dict(zip(*(tables["queries"][name].to_pylist() for name in ("query_id", ASKED)), strict=True))
        answers = _read_predictions(folder, tables["runs"])
        check_predictions(answers)
        return Unpacked(root=into, tasks=tasks, runs=tuple(_lay_runs(tables["runs"], answers, asked, into)))


def read_stored_predictions(folder: Path, matcher: str, *, queries: Collection[str] | None = None) -> list[Prediction]:
    """Read the answers of one matcher, to some queries or all, from stored results.

    Raise `StoreError` if these answers are damaged, or the results hold none.
    """
    with sound(folder):
        table = _read_predictions(folder, _read_runs(folder))
        table = table.filter(pc.equal(table[MATCHER], matcher))
        if queries is not None:
            table = table.filter(pc.is_in(table["query_id"], pa.array(sorted(queries), pa.string())))
        check_predictions(table)
        found = predictions_of(table)
    if not found:
        raise StoreError(f"{folder} holds no answer of {matcher!r}: board.json names its matchers")
    return found


def unpack_tasks(folder: Path, into: Path) -> tuple[Path, ...]:
    """Lay the tasks of stored results out in an empty folder, with `region.json` of their maps and truths; return them.

    Raise `StoreError` if the results are damaged.
    """
    with sound(folder):
        tables = _read_tables(folder)
        check_tables(tables)
        return tuple(_lay_tasks(tables, into))


def _read_tables(folder: Path) -> dict[str, pa.Table]:
    read_pack(folder)  # checks every file against its hash
    tables = {name: read_table(folder / f"{name}.parquet", mend=_MEND) for name in TABLES}
    return tables | {"truths": with_added(tables["truths"]), "queries": with_added(tables["queries"], STEP_COLUMNS)}


def _lay_tasks(tables: Mapping[str, pa.Table], into: Path) -> Iterator[Path]:
    parts = {name: _parts_of(tables[name]) for name in ("queries", "truths")}
    for number, row in enumerate(tables["tasks"].to_pylist()):
        about = parse_json(row["task_json"])
        suite, region = (_folder_name(about[name]) for name in ("suite", "region"))
        task, truth = (into / kind / suite / region for kind in ("tasks", "truth"))
        for place in (task, truth):
            place.mkdir(parents=True)
        (task / task_files.TASK).write_text(row["task_json"], encoding="utf-8")
        (truth / TRUTH_OF).write_text(row["truth_json"], encoding="utf-8")
        write_table(parts["queries"][number], task / QUERIES)
        write_table(parts["truths"][number], truth / TRUTH)
        if row["region_json"] is not None:
            place = into / "regions" / region
            place.mkdir(parents=True, exist_ok=True)
            (place / MANIFEST).write_text(row["region_json"], encoding="utf-8")
        yield task


def _parts_of(table: pa.Table) -> dict[int, pa.Table]:
    """Return the rows of each task, which lie together."""
    numbers, starts, counts = np.unique(table[TASK].to_numpy(), return_index=True, return_counts=True)
    plain = table.drop_columns([TASK])
    return {
        int(number): plain.slice(start, count) for number, start, count in zip(numbers, starts, counts, strict=True)
    }


def _folder_name(name: str) -> str:
    if not re.fullmatch(FOLDER, name):
        raise ValueError(f"{name!r} is no name of a folder")
    return name


def _read_runs(folder: Path) -> pa.Table:
    """Read the record of each run, with what was learned for it; results of the former layout keep that in files."""
    runs = read_table(folder / RUNS, mend=_MEND)
    if (folder / PREDICTIONS).is_file():
        return runs
    learned = [_former_learned(folder, _manifest_of(text)) for text in runs["about"].to_pylist()]
    return runs.append_column(LEARNED, pa.array(learned, pa.string()))


def _manifest_of(text: str) -> RunManifest:
    return RunManifest.model_validate(parse_json(text))


def _former_learned(folder: Path, run: RunManifest) -> str | None:
    path = folder / FORMER_LEARNED / _folder_name(_file_of(run)) / _learned_name(run.learned)
    return _text_of(path)


def _text_of(path: Path) -> str | None:
    return plain_file(path).read_text("utf-8") if path.is_file() else None


def _learned_name(training: TrainingRecord | None) -> str:
    return "" if training is None or training.file is None else _folder_name(Path(training.file).name)


def _read_predictions(folder: Path, runs: pa.Table) -> pa.Table:
    """Read all answers, unchecked, in the order of the runs; the former layout has a file for each matcher."""
    rows = runs.select(["contestant", "rows", "about"]).to_pylist()
    if (folder / PREDICTIONS).is_file():
        table = read_table(folder / PREDICTIONS, mend=_MEND)
    else:
        files = {row["contestant"]: _folder_name(_file_of(_manifest_of(row["about"]))) for row in rows}
        tables = [read_table(folder / FORMER_PREDICTIONS / f"{stem}.parquet", mend=_MEND) for stem in files.values()]
        matchers = [name for name, part in zip(files, tables, strict=True) for _ in range(len(part))]
        table = pa.concat_tables(tables).append_column(MATCHER, pa.array(matchers, pa.string()))
    is_whole = sum(row["rows"] for row in rows) == len(table)  # first: anybody may say how many there are
    if not is_whole or table[MATCHER].to_pylist() != [row["contestant"] for row in rows for _ in range(row["rows"])]:
        raise ValueError(f"{RUNS} does not tell the {len(table)} answers of {PREDICTIONS}")
    return table


def _lay_runs(runs: pa.Table, answers: pa.Table, asked: Mapping[str, str], into: Path) -> Iterator[Path]:
    start, answers = 0, answers.drop_columns([MATCHER])
    for row in runs.to_pylist():
        manifest, count = _manifest_of(row["about"]), row["rows"]
        run = into / "runs" / _folder_name(_file_of(manifest))
        place = run / _folder_name(manifest.suite) / _folder_name(manifest.region)
        place.mkdir(parents=True, exist_ok=True)
        # Not by `save`, which waits for the disk: nothing here is to outlive a crash
        (place / RUN).write_text(json_text(manifest.content()), encoding="utf-8")
        if row[LEARNED] is not None:
            (run / cards.FOLDER).mkdir(exist_ok=True)
            (run / cards.FOLDER / _learned_name(manifest.learned)).write_text(row[LEARNED], encoding="utf-8")
        part = answers.slice(start, count)
        ties = [answer_hash(asked[name], manifest.key) for name in part["query_id"].to_pylist()]
        write_table(part.append_column(ASKED, pa.array(ties, pa.string())), place / "part-0.parquet")
        start += count
        yield place
