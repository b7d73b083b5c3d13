# SPDX-License-Identifier: Apache-2.0
"""Predictions on disk: parts that are only ever added, and `run.json`; a file of the same shape is a submission."""

import json
import os
import re
import time
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Final

import pyarrow as pa
import pyarrow.parquet as pq

from sasgeo_bench.errors import PoseError, StoreError
from sasgeo_bench.pose import Pose
from sasgeo_bench.region import ATTRIBUTION, LICENCE
from sasgeo_bench.results import Prediction
from sasgeo_bench.store.taskrows import POSE_FIELDS, poses_of

RUN: Final = "run.json"
SCHEMA_VERSION: Final = 1
_PART: Final = re.compile(r"part-(\d{20})-\d+\.parquet")
_CANDIDATE: Final = pa.struct([(name, pa.float64()) for name in (*POSE_FIELDS, "score")])
PREDICTION_SCHEMA: Final = pa.schema(
    [
        ("query_id", pa.string()),
        ("candidates", pa.list_(_CANDIDATE)),
        ("confidence", pa.float64()),
        ("diagnostics", pa.map_(pa.string(), pa.float64())),
        ("status", pa.string()),
        ("message", pa.string()),
        ("latency_s", pa.float64()),
    ],
    metadata={"schema_version": str(SCHEMA_VERSION), "attribution": ATTRIBUTION, "licence": LICENCE},
)


def prediction_row(prediction: Prediction) -> dict[str, Any]:
    """One prediction as a row of `PREDICTION_SCHEMA`."""
    return {
        "query_id": prediction.query_id,
        "candidates": [
            {
                "easting_m": pose.easting_m,
                "northing_m": pose.northing_m,
                "yaw_deg": pose.yaw_deg,
                "scale": pose.scale,
                "score": score,
            }
            for pose, score in prediction.candidates
        ],
        "confidence": prediction.confidence,
        "diagnostics": list(prediction.diagnostics.items()),
        "status": prediction.status,
        "message": prediction.message,
        "latency_s": prediction.latency_s,
    }


def prediction_of(row: Mapping[str, Any]) -> Prediction:
    """Inverse of `prediction_row`; whatever else a candidate holds is passed over."""
    poses = tuple(
        (Pose(**{name: item[name] for name in POSE_FIELDS}), item["score"]) for item in row["candidates"] or ()
    )
    return _prediction(row, poses)


def _prediction(row: Mapping[str, Any], candidates: tuple[tuple[Pose, float], ...]) -> Prediction:
    return Prediction(
        query_id=row["query_id"],
        candidates=candidates,
        confidence=row["confidence"],
        diagnostics=dict(row["diagnostics"] or ()),
        status=row["status"],
        message=row["message"] or "",
        latency_s=row["latency_s"],
    )


def write_part(folder: Path, predictions: Sequence[Prediction]) -> Path:
    """Add some rows to a run, in a file of their own that is there whole or not at all.

    Raises
    ------
    StoreError
        If the disk is full or the folder cannot be written; what was there before is as it was.
    """
    name = f"part-{_stamp_ns(folder):020d}-{os.getpid()}"
    scratch, path = folder / f".{name}.partial", folder / f"{name}.parquet"
    table = pa.Table.from_pylist([prediction_row(item) for item in predictions], schema=PREDICTION_SCHEMA)
    try:
        folder.mkdir(parents=True, exist_ok=True)
        pq.write_table(table, scratch, compression="zstd")
        _flush(scratch)
        scratch.rename(path)
    except OSError as error:
        _remove(scratch)
        message = (
            f"{folder} cannot be written ({error.strerror or error}): free some space and run again, it goes on there"
        )
        raise StoreError(message) from error
    return path


def _stamp_ns(folder: Path) -> int:
    """Now, or just after the last part where a clock was set back: the later name is the newer row."""
    before = (_PART.fullmatch(path.name) for path in folder.glob("part-*.parquet"))
    return max(time.time_ns(), 1 + max((int(found[1]) for found in before if found), default=0))


def _remove(path: Path) -> None:
    try:
        path.unlink()
    except OSError:
        return


def _flush(path: Path) -> None:
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def parts_of(path: Path) -> list[Path]:
    """The files of a run's folder in the order they were written, or of all runs in a folder, or the file itself."""
    if path.is_file():
        return [path]
    return sorted(path.glob("part-*.parquet")) or sorted(path.rglob("part-*.parquet"), key=lambda part: part.name)


def read_predictions(path: Path) -> Iterator[Prediction]:
    """Predictions of a run's folder or of a file, newest first; of two for one query, the one that was written last.

    A folder holds two where a query was asked again.

    Raises
    ------
    StoreError
        If there is none, or a file cannot be read.
    """
    parts = parts_of(path)
    if not parts:
        message = f"{path} holds no predictions: run a matcher first, or name a predictions file"
        raise StoreError(message)
    seen: set[str] = set()
    for part in reversed(parts):
        table = read_part(part)
        for name, found, expected in differing_columns(table):
            fault = f"{name}: found {found}, expected {expected}"[:200]
            message = f"{part} holds no predictions ({fault}): 'validate' lists all that is missing"
            raise StoreError(message)
        for prediction in _sound(table) or _one_by_one(part, table, seen):
            if prediction.query_id not in seen:
                seen.add(prediction.query_id)
                yield prediction


def _sound(table: pa.Table) -> list[Prediction]:
    """All rows, last first, by columns; none where a row may need a word of its own."""
    column = table["candidates"].combine_chunks()
    if not isinstance(column, pa.ListArray) or any(table[name].null_count for name in ("query_id", "status")):
        return []
    values = column.values
    if values.null_count or any(values.field(name).null_count for name in (*POSE_FIELDS, "score")):
        return []
    try:
        poses = poses_of(column)
    except (PoseError, TypeError):
        return []
    scores, ends = values.field("score").to_pylist(), column.offsets.to_pylist()
    rows = table.drop_columns(["candidates"]).to_pylist()
    return [
        _prediction(rows[at], tuple(zip(poses[at], scores[ends[at] : ends[at + 1]], strict=True)))
        for at in reversed(range(len(rows)))
    ]


def _one_by_one(part: Path, table: pa.Table, seen: set[str]) -> Iterator[Prediction]:
    """Rows of queries that were not seen yet, last first, each refused in a word of its own."""
    for number, row in reversed(list(enumerate(table.to_pylist()))):
        if row["query_id"] not in seen:
            yield _read_row(part, number, row)


def _read_row(part: Path, number: int, row: Mapping[str, Any]) -> Prediction:
    """One row of a file that may be anyone's."""
    where = f"{part}, row {number}, is no prediction"
    absent = next((name for name in ("query_id", "status") if row[name] is None), None)
    if absent is not None:
        message = f"{where} ({absent} is null): 'validate' says all that is wrong"
        raise StoreError(message)
    try:
        return prediction_of(row)
    except (PoseError, TypeError) as error:
        message = f"{where} ({error}): 'validate' says all that is wrong"
        raise StoreError(message) from error


def differing_columns(table: pa.Table) -> list[tuple[str, str, str]]:
    """Columns that a table of predictions must hold and this one does not: their names, what is found, and expected.

    More columns, in any order, do no harm.

    Examples
    --------
    >>> differing_columns(PREDICTION_SCHEMA.empty_table().drop_columns(["message"]))
    [('message', 'nothing', 'string')]
    """
    found = {field.name: field.type for field in table.schema}
    counts = {field: table.schema.names.count(field.name) for field in PREDICTION_SCHEMA}
    twice = [(field.name, f"{count} columns", str(field.type)) for field, count in counts.items() if count > 1]
    return twice or [
        (field.name, str(found.get(field.name, "nothing")), str(field.type))
        for field in PREDICTION_SCHEMA
        if field.name not in found or not _is_like(found[field.name], field.type)
    ]


def _is_like(found: pa.DataType, wanted: pa.DataType) -> bool:
    """Whether a column can be read as another: any float for a float, any string for a string, null for anything."""
    if pa.types.is_null(found) or found.equals(wanted):
        return True
    if pa.types.is_floating(wanted):
        return bool(pa.types.is_floating(found) or pa.types.is_integer(found))
    if pa.types.is_string(wanted):
        return bool(pa.types.is_string(found) or pa.types.is_large_string(found))
    if pa.types.is_list(wanted):
        is_list = pa.types.is_list(found) or pa.types.is_large_list(found)
        return is_list and pa.types.is_struct(found.value_type) and _has_fields(found.value_type, wanted.value_type)
    return bool(pa.types.is_map(wanted) and pa.types.is_map(found))


def _has_fields(found: pa.StructType, wanted: pa.StructType) -> bool:
    names = [field.name for field in found]
    return all(names.count(field.name) == 1 and _is_like(found.field(field.name).type, field.type) for field in wanted)


def read_part(path: Path) -> pa.Table:
    """A parquet file whole.

    Raises
    ------
    StoreError
        If it is not there, truncated, or no parquet file.
    """
    try:
        with pq.ParquetFile(path) as source:
            return source.read()
    except (OSError, pa.ArrowException) as error:
        text = " ".join(str(error).split())[:200]
        message = f"{path} cannot be read ({text}): write it again, or remove it where it is a part of a run"
        raise StoreError(message) from error


def merge_runs(runs: Sequence[Path], into: Path) -> int:
    """Write the predictions of several folders or files into one file, sorted by query; how many there are.

    Of two for one query the first counts, in the order of `runs`. The same predictions give the same file, whatever
    parts they came in.

    Raises
    ------
    StoreError
        If there are none, the folders are of different matchers, versions or settings, a file cannot be read, or the
        new one cannot be written.
    """
    check_one_matcher(runs)
    if into.exists() and not _is_ours(into):
        message = f"{into} is no predictions file and would be lost: name another one"
        raise StoreError(message)
    found: dict[str, Prediction] = {}
    for path in runs:
        for prediction in read_predictions(path):
            found.setdefault(prediction.query_id, prediction)
    rows = [prediction_row(found[name]) for name in sorted(found)]
    scratch = into.with_name(f".{into.name}.partial")
    try:
        into.parent.mkdir(parents=True, exist_ok=True)
        pq.write_table(pa.Table.from_pylist(rows, schema=PREDICTION_SCHEMA), scratch, compression="zstd")
        _flush(scratch)
        scratch.rename(into)
    except OSError as error:
        _remove(scratch)
        message = f"{into} cannot be written ({error.strerror or error}): check your rights and the free space"
        raise StoreError(message) from error
    return len(rows)


def check_one_matcher(runs: Sequence[Path]) -> None:
    """Refuse folders whose `run.json` say different things of who answered; files say nothing of it.

    Raises
    ------
    StoreError
        If two folders are of different matchers, versions or settings, or a `run.json` is damaged.

    Examples
    --------
    >>> check_one_matcher([Path("mine.parquet")])
    """
    folders = [run.parent for path in runs if path.is_dir() for run in sorted(path.rglob(RUN))]
    said = [(path, read_run(path)) for path in folders]
    known = [(path, about) for path, about in said if about is not None]
    for path, about in known[1:]:
        first, other = known[0]
        if about.get("hash") != other.get("hash"):
            message = (
                f"{path} holds answers of {_who(about)}, {first} those of {_who(other)}: "
                "two matchers, versions or settings are never mixed, name the folder of one"
            )
            raise StoreError(message)


def _who(about: Mapping[str, Any]) -> str:
    card = about.get("matcher")
    name, version = (card.get("name"), card.get("version")) if isinstance(card, dict) else (None, None)
    return f"{name} {version} ({about.get('hash')})"


def _is_ours(path: Path) -> bool:
    try:
        return path.is_file() and pq.read_schema(path).names == PREDICTION_SCHEMA.names
    except (OSError, pa.ArrowException):
        return False


def ids_done(folder: Path, *, again: Iterable[str] = ()) -> set[str]:
    """Ids of the queries a run has answered; those with a status in `again` do not count.

    Raises
    ------
    StoreError
        If a part cannot be read, or is none.
    """
    left_out = set(again)
    found: set[str] = set()
    for part in parts_of(folder):
        table = read_part(part)
        if differing_columns(table):
            message = f"{part} holds no predictions: move it out of the run's folder"
            raise StoreError(message)
        pairs = zip(table["query_id"].to_pylist(), table["status"].to_pylist(), strict=True)
        found |= {name for name, status in pairs if status not in left_out}
    return found


def write_run(folder: Path, about: Mapping[str, Any]) -> None:
    """Write `run.json`, in place of an older one.

    Raises
    ------
    StoreError
        If the folder cannot be written.
    """
    scratch = folder / f".{RUN}.{os.getpid()}"
    try:
        folder.mkdir(parents=True, exist_ok=True)
        scratch.write_text(json.dumps(dict(about), indent=2, ensure_ascii=False) + "\n", encoding="utf-8")
        scratch.rename(folder / RUN)
    except OSError as error:
        _remove(scratch)
        message = f"{folder} cannot be written ({error.strerror or error}): check your rights and the free space"
        raise StoreError(message) from error


def read_run(folder: Path) -> dict[str, Any] | None:
    """What `run.json` says, or None where there is none.

    Raises
    ------
    StoreError
        If it is damaged.
    """
    path = folder / RUN
    if not path.is_file():
        return None
    damaged = StoreError(f"{path} is damaged: remove it and run again, the parts beside it are kept")
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError) as error:
        raise damaged from error
    if not isinstance(content, dict):
        raise damaged
    return content
