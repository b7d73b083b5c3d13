# SPDX-License-Identifier: Apache-2.0
"""Tasks on disk: `queries.parquet` and `task.json` for everyone, `truth.parquet` for the scorer alone."""

import hashlib
from collections import Counter
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack
from itertools import chain, islice
from pathlib import Path
from typing import Annotated, Any, Final, TypeVar

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import shapely
from pydantic import Field

from sasgeo_bench.config import Document, check_document
from sasgeo_bench.errors import ConfigError, StoreError
from sasgeo_bench.files.folders import file_record, sha256_of
from sasgeo_bench.files.json import read_json
from sasgeo_bench.files.parquet import open_table, read_schema, read_table, table_writer
from sasgeo_bench.files.paths import given_path
from sasgeo_bench.regions.evidence import CELLS_PER_BYTE
from sasgeo_bench.regions.region import ATTRIBUTION, LICENCE, Manifest
from sasgeo_bench.tasks.frames import LABEL_SCHEMA, LABELS, label_row
from sasgeo_bench.tasks.query import TASK_VERSION, TASK_VERSIONS, Head, Query, Truth
from sasgeo_bench.tasks.task_rows import (
    ADDED,
    ASKED,
    FILE_SCHEMA,
    HEAD_SCHEMA,
    MAY_BE_NULL,
    PLAIN_TRUTH_SCHEMA,
    QUERY_SCHEMA,
    TRUTH_SCHEMA,
    VIEW_BYTES,
    asked_sha256,
    is_like,
    poses_of,
    query_of,
    query_row,
    stream_of,
    truth_of,
    truth_row,
    with_added,
)
from sasgeo_bench.texts import FOLDER, json_text

Row = TypeVar("Row")
Made = TypeVar("Made")
Count = Annotated[int, Field(ge=0)]
Folder = Annotated[str, Field(pattern=FOLDER)]  # never a path that leaves its root

QUERIES: Final = "queries.parquet"
TASK: Final = "task.json"
FAILED_PICTURES: Final = "failed_pictures"  # of `task.json`: how many a segmenter failed at; absent if none
TRUTH: Final = "truth.parquet"
TRUTH_OF: Final = "truth.json"
PRIVATE: Final = "private_seed"  # in task.json and truth.json: commitment and bits, where the seed is private
SEALED: Final = "sealed_seed"  # the same of queries of a sealed place
SCHEMA_VERSION: Final = 1
_MEND: Final = "make the queries again"
_ROWS: Final = 128  # of a row group, which is in memory at once
_ROWS_WITH_FRAMES: Final = 8  # the same where labels of pictures are in memory, too
_MAP: Final = ("map_fingerprint", "map_inputs_sha256")  # hashes of the searched map in `task.json`
_READ: Final = ", ".join(map(str, TASK_VERSIONS))  # readable versions of tasks


class TaskFile(Document):
    """Hash and size of the queries."""

    sha256: str
    bytes: Count


class TaskFiles(Document):
    """Files of a task, of which there is one."""

    queries: Annotated[TaskFile, Field(alias=QUERIES)]


class TaskManifest(Document):
    """Contents of `task.json`; an unknown key is an error, since a later schema has another version."""

    schema_version: int
    task_version: int
    suite: Folder
    suite_version: Count | None = None
    suite_sha256: str | None = None  # of the code of a suite of another package
    title: str
    what: str | None = None
    separates: str | None = None
    falsifier: str | None = None
    strength_unit: str | None = None
    region: Folder
    map_date: str | None = None
    map_fingerprint: str
    map_inputs_sha256: str | None = None
    split: str | None = None
    split_sha256: str | None = None
    sites: Count | None = None
    views_cells: list[Count] | None = None
    epsg: int | None = None
    made_by: str | None = None
    counts: dict[str, Count]
    prior_groups: list[str] | None = None
    candidates_sha256: str | None = None
    private_seed: dict[str, str | int] | None = None  # its commitment and bits
    sealed_seed: dict[str, str | int] | None = None  # the same
    frames: Count | None = None  # pictures of all queries
    segmenter: dict[str, str] | None = None  # what made the evidence of the pictures: name, version, hash
    failed_pictures: Count | None = None  # that the segmenter failed at
    files: TaskFiles
    licence: str | None = None
    attribution: str | None = None


def write_task(
    task_folder: Path,
    truth_folder: Path,
    pairs: Iterable[tuple[Query, Truth]],
    about: dict[str, Any],
    hidden: dict[str, Any] | None = None,
) -> int:
    """Write queries and truths into two empty folders, by row groups, then `task.json`, which completes the task.

    `pairs` are in the order of the query ids, which reveals nothing about the answers. `about` and `hidden` are the
    contents of `task.json` and `truth.json` besides counts and hashes. Return the number of queries.
    """
    counts: Counter[str] = Counter()
    groups: set[str] = set()
    frozen = hashlib.sha256()
    frames = 0
    labels: Any = None  # a writer, opened at the first picture
    with ExitStack() as stack:
        queries, truths = (
            stack.enter_context(table_writer(path, schema, compression_level=9))
            for path, schema in ((task_folder / QUERIES, FILE_SCHEMA), (truth_folder / TRUTH, TRUTH_SCHEMA))
        )
        for part in _batches(pairs):
            rows = pa.Table.from_pylist([query_row(query) for query, _ in part], schema=QUERY_SCHEMA)
            asked = [asked_sha256(row, _map_hashes(about)) for row in rows.to_pylist()]
            queries.write_table(rows.append_column(FILE_SCHEMA.field(ASKED), pa.array(asked)))
            truths.write_table(pa.Table.from_pylist([truth_row(truth) for _, truth in part], schema=TRUTH_SCHEMA))
            of_frames = _label_rows(part)
            if of_frames:
                labels = labels or stack.enter_context(table_writer(truth_folder / LABELS, LABEL_SCHEMA))
                labels.write_table(pa.Table.from_pylist(of_frames, schema=LABEL_SCHEMA), 1)
            frames += sum(len(query.frames) for query, _ in part)
            for query, _ in part:
                counts[query.track] += 1
                groups.add(query.prior_group)
                frozen.update(query.query_id.encode() + _candidate_bytes(query))
    record = file_record(task_folder / QUERIES)
    content = {
        "schema_version": SCHEMA_VERSION,
        "task_version": TASK_VERSION,
        **about,
        "counts": dict(counts),
        "prior_groups": sorted(groups),
        "candidates_sha256": frozen.hexdigest(),
        **({"frames": frames} if frames else {}),
        "files": {QUERIES: record.model_dump()},
        "licence": LICENCE,
        "attribution": ATTRIBUTION,
    }
    _write_json(truth_folder / TRUTH_OF, {"queries_sha256": record.sha256, **(hidden or {})})
    _write_json(task_folder / TASK, content)
    return counts.total()


def _label_rows(part: Sequence[tuple[Query, Truth]]) -> list[dict[str, Any]]:
    """Return the labels of all frames of some queries as rows."""
    return [label_row(truth.query_id, number, item) for _, truth in part for number, item in enumerate(truth.labels)]


def _write_json(path: Path, content: dict[str, Any]) -> None:
    path.write_text(json_text(content), encoding="utf-8")


def _candidate_bytes(query: Query) -> bytes:
    """Return the poses of the candidates as four little-endian doubles each, for the task's hash."""
    rows = [(pose.easting_m, pose.northing_m, pose.yaw_deg, pose.scale) for pose in query.candidates]
    return np.array(rows, dtype="<f8").tobytes()


def _batches(pairs: Iterable[tuple[Query, Truth]]) -> Iterator[Sequence[tuple[Query, Truth]]]:
    left = iter(pairs)
    first = next(left, None)
    if first is None:
        return
    rows = _ROWS_WITH_FRAMES if first[0].frames else _ROWS
    whole = chain([first], left)
    while batch := list(islice(whole, rows)):
        yield batch


def read_task(folder: str | Path) -> dict[str, Any]:
    """Read `task.json`; raise a StoreError if it is missing, damaged or of another version."""
    path = given_path(folder) / TASK
    if not path.is_file():
        raise StoreError(f"{folder} holds no {TASK}: make the queries first")
    content = read_json(path, mend=_MEND)
    about = content if isinstance(content, dict) else {}
    for name, known in (("schema_version", (SCHEMA_VERSION,)), ("task_version", TASK_VERSIONS)):
        if name in about and about[name] not in known:
            noun, versions = name.replace("_", " "), ", ".join(map(str, known))
            raise StoreError(f"{path} has {noun} {about[name]!r}, this version reads {versions}: {_MEND}")
    try:
        check_document(content, TaskManifest, source=TASK)
    except ConfigError as error:
        raise _damaged(path, error) from error
    return about


def _damaged(path: Path, fault: object) -> StoreError:
    return StoreError(f"{path} is damaged ({str(fault)[:200]}): {_MEND}")


def check_queries(folder: Path) -> None:
    """Raise a StoreError if the queries are missing or not those of `task.json`."""
    recorded = read_task(folder)["files"][QUERIES]["sha256"]
    path = folder / QUERIES
    if not path.is_file() or sha256_of(path) != recorded:
        raise StoreError(f"{path} is not what {TASK} says: make the queries again")


def check_ours(folder: Path, names: Sequence[str]) -> None:
    """Raise a StoreError if a folder to replace holds foreign files."""
    if folder.exists() and not folder.is_dir():
        raise StoreError(f"{folder} is a file: move it away, a task goes there")
    other = next((path for path in sorted(folder.glob("*")) if path.name not in names), None)
    if other is not None:
        raise StoreError(f"{other} is no part of a task and would be lost: move it away")


def task_faults(task_folder: Path, truth_folder: Path) -> list[str]:
    """Check a task against its `task.json` and its truths, if there are any; return a line for each fault.

    Each line begins with the path of the file and ends with what to do about it.

    Raises
    ------
    StoreError
        If the folder holds no task, or a file cannot be read.
    """
    about = read_task(task_folder)
    faults = []
    path, recorded = task_folder / QUERIES, about["files"][QUERIES]
    if not path.is_file():
        return [f"{path}: missing: {_MEND}"]
    known = {task_folder / TASK, path}
    others = [other for other in sorted(task_folder.rglob("*")) if other not in known]
    faults += [f"{other}: not part of a task: move it away" for other in others]
    found = file_record(path)
    if found.model_dump() != recorded:  # its contents need no check
        was = f"{recorded['bytes']} bytes, {recorded['sha256']}"
        return [f"{path}: {found.bytes} bytes, SHA-256 {found.sha256}; {TASK} says {was}: {_MEND}", *faults]
    asked = [(query.query_id, query.track) for query in read_queries(task_folder)]
    names, counts = [name for name, _ in asked], dict(Counter(track for _, track in asked))
    if counts != about["counts"]:
        faults.append(f"{path}: holds {_counts_text(counts)}, {TASK} says {_counts_text(about['counts'])}: {_MEND}")
    if (truth_folder / TRUTH).is_file():
        belongs = _belongs_to(truth_folder)
        if belongs != found.sha256:
            faults.append(f"{truth_folder / TRUTH_OF}: the truths are of other queries, SHA-256 {belongs}: {_MEND}")
        answered = [truth.query_id for truth in read_truths(truth_folder)]
        if answered != names:
            not_those = f"{len(answered)} truths that are not those of the {len(names)} queries, in order"
            faults.append(f"{truth_folder / TRUTH}: {not_those}: {_MEND}")
    return faults


def _counts_text(counts: Mapping[Any, int]) -> str:
    return ", ".join(f"{count} of {track}" for track, count in sorted(counts.items()))


def _belongs_to(truth_folder: Path) -> str:
    """Return the SHA-256 of the queries that the truths of a folder belong to; "unknown" if it is not recorded."""
    return str(read_hidden(truth_folder).get("queries_sha256", "unknown"))


def check_truths(task_folder: Path, truth_folder: Path) -> None:
    """Raise a StoreError if truths are missing, belong to other queries, or have another task version."""
    if not (truth_folder / TRUTH).is_file():
        raise StoreError(
            f"{truth_folder} holds no truths of {task_folder}: "
            "name their folder with --truth, or make the queries again"
        )
    if (truth_folder / TRUTH_OF).is_file():
        read_json(truth_folder / TRUTH_OF, mend=_MEND)  # a damaged file raises here
    if _belongs_to(truth_folder) != read_task(task_folder)["files"][QUERIES]["sha256"]:
        raise StoreError(f"{truth_folder} holds the truths of other queries than {task_folder}: make the queries again")
    metadata = read_schema(truth_folder / TRUTH, mend=_MEND).metadata or {}
    version = metadata.get(b"task_version", b"none").decode(errors="replace")
    if version not in map(str, TASK_VERSIONS):
        raise StoreError(
            f"{truth_folder} holds truths of task version {version}, this version reads {_READ}: make the queries again"
        )


def read_hidden(truth_folder: Path) -> dict[str, Any]:
    """Read `truth.json`; return an empty dictionary if it cannot be read."""
    try:
        hidden = read_json(truth_folder / TRUTH_OF, mend=_MEND)
    except StoreError:
        return {}
    return hidden if isinstance(hidden, dict) else {}


def map_of(manifest: Manifest) -> dict[str, str]:
    """Return what `task.json` holds of a map: the hashes of its contents and of its inputs."""
    return {"map_fingerprint": manifest.fingerprint, "map_inputs_sha256": manifest.inputs_sha256}


def is_of_map(about: Mapping[str, Any], manifest: Manifest) -> bool:
    """Return whether a task belongs to this very build of a map; older programs recorded less of it."""
    return all(about.get(name, value) == value for name, value in map_of(manifest).items())


def _map_hashes(about: Mapping[str, Any]) -> dict[str, str]:
    return {name: str(about[name]) for name in _MAP if name in about}


def read_asked(folder: Path) -> dict[str, str]:
    """Read by query id the hash of the query and of its map, which its answer has to carry."""
    about, path = _map_hashes(read_task(folder)), folder / QUERIES
    is_recorded = ASKED in read_schema(path, mend=_MEND).names
    columns = ["query_id", ASKED] if is_recorded else QUERY_SCHEMA.names
    rows = (row for batch in read_batches(path, columns) for row in batch.to_pylist())
    return {row["query_id"]: _asked_of(row, about) for row in rows}


def _asked_of(row: Mapping[str, Any], about: Mapping[str, str]) -> str:
    """Return the recorded hash, or compute it for files of versions that did not record it."""
    recorded = row.get(ASKED)
    return asked_sha256(row, about) if recorded is None else str(recorded)


def read_some(folder: Path, ids: Collection[str]) -> Iterator[tuple[Query, bytes, str]]:
    """Yield queries of some ids, each with its bytes for a matcher's process and its hash; a row group at a time."""
    about = _map_hashes(read_task(folder))
    with open_table(folder / QUERIES, mend=_MEND, is_whole=False) as source:
        for batch in source.iter_batches(batch_size=_ROWS):
            sent = batch.select([name for name in batch.schema.names if name != ASKED])
            for at, name in enumerate(batch["query_id"].to_pylist()):
                if name in ids:
                    row = batch.slice(at, 1).to_pylist()[0]
                    yield _made(folder / QUERIES, query_of, row), stream_of(sent.slice(at, 1)), _asked_of(row, about)


def read_ids(folder: Path) -> list[str]:
    """Read the ids of a task's queries, in their order."""
    batches = read_batches(folder / QUERIES, ["query_id"])
    return [str(name) for batch in batches for name in batch["query_id"].to_pylist()]


def read_parts(folder: Path) -> set[str]:
    """Read which parts of a split the queries of a task belong to."""
    return {
        str(part) for batch in read_batches(folder / QUERIES, ["part"]) for part in pc.unique(batch["part"]).to_pylist()
    }


def read_view_bytes(folder: Path) -> dict[str, int]:
    """Return the bytes of each query's view as it travels: packed cells, confidences and vectors, without compression.

    The size of packed cells follows from their shape, so that no view is read. Stored results record the bytes.
    """
    if VIEW_BYTES in read_schema(folder / QUERIES, mend=_MEND).names:
        table = read_table(folder / QUERIES, mend=_MEND, columns=["query_id", VIEW_BYTES])
        return dict(zip(*(column.to_pylist() for column in table.columns), strict=True))
    found: dict[str, int] = {}
    columns = ["query_id", "rows", "cols", "classes", "confidence", "vectors"]
    for batch in read_batches(folder / QUERIES, columns):
        shape = (batch["rows"], batch["cols"], pc.list_value_length(batch["classes"]))
        cells = np.prod([np.asarray(side, dtype=np.int64) for side in shape], axis=0)
        confidence = np.asarray(pc.fill_null(pc.binary_length(batch["confidence"]), 0))
        vectors = batch["vectors"]
        ends = np.concatenate(([0], np.cumsum(np.asarray(pc.binary_length(vectors.values.field("wkb"))))))
        offsets = np.asarray(vectors.offsets)
        total = -(-cells // CELLS_PER_BYTE) + confidence + ends[offsets[1:]] - ends[offsets[:-1]]
        found |= dict(zip(batch["query_id"].to_pylist(), total.tolist(), strict=True))
    return found


def read_queries(folder: str | Path) -> Iterator[Query]:
    """Yield the queries of a task in the order of their ids, a row group in memory at a time."""
    path = given_path(folder) / QUERIES
    for row in _rows(path, QUERY_SCHEMA):
        yield _made(path, query_of, row)


def read_heads(folder: Path) -> Iterator[Head]:
    """Yield the queries of a task without their views, in the order of their ids."""
    for batch in read_batches(folder / QUERIES, HEAD_SCHEMA.names):
        rows = batch.drop_columns(["candidates"]).to_pylist()
        for row, poses in zip(rows, _made(folder / QUERIES, poses_of, batch["candidates"]), strict=True):
            way = row.pop("increment")
            yield Head(
                view_cells=row.pop("rows"), candidates=poses, increment=None if way is None else tuple(way), **row
            )


def read_truths(folder: str | Path) -> Iterator[Truth]:
    """Yield the truths of a task in the order of the query ids."""
    path = given_path(folder) / TRUTH
    for row in _rows(path, TRUTH_SCHEMA):
        yield _made(path, truth_of, row)


def read_batches(path: Path, columns: Sequence[str]) -> Iterator[pa.RecordBatch]:
    """Yield some columns of queries or truths, a row group in memory at a time.

    Raises
    ------
    StoreError
        If the file is missing or damaged, or lacks a column; older files may lack those of `task_rows.ADDED`.
    """
    with open_table(path, mend=_MEND, is_whole=False) as source:
        schema = source.schema_arrow
        known = set(schema.names)
        there = [name for name in columns if name in known or name not in ADDED]
        _check_columns(path, schema, there)
        for found in source.iter_batches(batch_size=_ROWS, columns=there):
            lost = [name for name in columns if name not in there]
            batch = with_added(found, lost).select(list(columns)) if lost else found
            empty = next((name for name in columns if name not in MAY_BE_NULL and batch[name].null_count), None)
            if empty is not None:
                raise _damaged(path, f"{empty} is null in a row")
            yield batch


def check_columns(path: Path, needed: Sequence[str]) -> None:
    """Refuse queries or truths that lack columns; raise as `read_batches` does."""
    _check_columns(path, read_schema(path, mend=_MEND), needed)


def _check_columns(path: Path, found: pa.Schema, needed: Sequence[str]) -> None:
    missing = [name for name in needed if name not in found.names]
    if missing:
        raise StoreError(f"{path} lacks the columns {', '.join(missing)}: {_MEND}")
    odd = next((name for name in needed if found.names.count(name) > 1 or not _is_known(found.field(name))), None)
    if odd is not None:
        raise StoreError(f"{path} holds the column {odd} twice, or with another type than it should: {_MEND}")


def _is_known(field: pa.Field) -> bool:
    """Return whether a column has the type that it has in our files or in a release."""
    schemas = (FILE_SCHEMA, TRUTH_SCHEMA, PLAIN_TRUTH_SCHEMA)
    types = [schema.field(field.name).type for schema in schemas if field.name in schema.names]
    return not types or any(is_like(field.type, kind) for kind in types)


def _made(path: Path, make: Callable[[Row], Made], row: Row) -> Made:
    """Convert a row, which may be malformed."""
    try:
        return make(row)
    except (TypeError, ValueError, KeyError, AttributeError, OverflowError, shapely.errors.ShapelyError) as error:
        raise _damaged(path, error) from error


def _rows(path: Path, schema: pa.Schema) -> Iterator[dict[str, Any]]:
    for batch in read_batches(path, schema.names):
        yield from batch.to_pylist()
