# SPDX-License-Identifier: Apache-2.0
"""Answers of a run or a submission: their one schema, rows and tables, parts on disk, and checks of untrusted rows."""

import os
import re
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, Final, Self

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from numpy.typing import NDArray
from pydantic import ValidationError, ValidationInfo, ValidatorFunctionWrapHandler, field_validator

from sasgeo_bench.core import config
from sasgeo_bench.core.errors import StoreError
from sasgeo_bench.core.folders import fresh_file, uncollected
from sasgeo_bench.core.json import read_json
from sasgeo_bench.core.parquet import read_batches, read_schema, read_table, write_table
from sasgeo_bench.core.paths import given_path
from sasgeo_bench.core.texts import (
    BOUNDS,
    MOST_CANDIDATES,
    MOST_DIAGNOSTICS,
    MOST_MESSAGE,
    MOST_NAME,
    bounds_text,
    is_line,
    json_text,
    one_line,
)
from sasgeo_bench.geometry.pose import Pose
from sasgeo_bench.matching.cards import Names, Record, TrainingRecord
from sasgeo_bench.matching.matcher import SAME_PLACE_M, STATUSES, Prediction
from sasgeo_bench.matching.tracker import MOST_VARIANCE, SIDE, are_covariances
from sasgeo_bench.regions.region import ATTRIBUTION, LICENCE
from sasgeo_bench.tasks.task_files import ASKED, POSE_FIELDS, answer_hash, dependency_key, is_like, poses_of

RUN: Final = "run.json"
PACKED: Final = "packed.json"  # beside it where answers came packed: they were not asked here, whatever `run.json` says
_MEND_RUN: Final = "remove it and run again, its parts are kept"
_MOST: Final = 1e18  # seconds or bytes of a run: more is no measurement

_EXPECTED: Final = {
    "learned": "key, file, trained_on and pairs",
    "rendered_imagery": "a hash",
    "follower": "settings with a hash",
}

Number = int | float | None


class CardRecord(config.Record):
    """Card of a matcher as boards and pages show it; a card of an older version may lack some texts."""

    name: str = ""
    version: str = ""
    title: str | None = None
    source: str | None = None
    ours: str | None = None
    licence: str | None = None
    tracks: Names | None = None
    needs: Names | None = None
    limits: str | None = None
    trained_on: Names | dict[str, list[str] | str] | str | None = None


class FollowerRecord(Record):
    """How a matcher of single views was asked about flights: settings, and the hash of these and of the code."""

    hash: str


class RunManifest(Record):
    """Content of `run.json`; what a run does not state is empty, and is not written again.

    `learned` records the training by the runner; `rendered_imagery` is the hash of imagery that the matcher looked at.
    `prepare_s`, `index_bytes` and `peak_bytes` are the largest of all processes, `cpu_s` is that of all answers
    together. `packed` is True where the answers came in an archive.

    >>> run = RunManifest(hash="ab", cpu_s=1.5)
    >>> run.suite, run.cpu_s, run.key
    ('', 1.5, None)
    """

    schema_version: int | None = None
    matcher: CardRecord = CardRecord()
    spec: str | None = None
    hash: str = ""
    suite: str = ""
    region: str = ""
    task_version: int | None = None
    queries_sha256: str = ""
    map_fingerprint: str | None = None
    top_k: int | None = None
    limits: dict[str, int | float] | None = None
    warm_up: str | None = None
    learned: TrainingRecord | None = None
    rendered_imagery: str | None = None
    follower: FollowerRecord | None = None
    map_bytes: Number = None
    prepare_s: Number = None
    index_bytes: Number = None
    cpu_s: Number = None
    peak_bytes: Number = None
    isolation: dict[str, str] | None = None
    licence: str | None = None
    attribution: str | None = None
    packed: bool = False

    @field_validator("matcher", *_EXPECTED, mode="wrap")
    @classmethod
    def _check_record(cls, value: object, handler: ValidatorFunctionWrapHandler, info: ValidationInfo) -> object:
        """Refuse a record as a whole, which its author wrote as a whole."""
        try:
            return handler(value)
        except ValidationError as error:
            name = str(info.field_name)
            if name in _EXPECTED:
                raise ValueError(f"{name} is {one_line(repr(value))}, expected {_EXPECTED[name]}") from error
            if isinstance(value, dict):
                raise
            raise ValueError("matcher.name is None") from error

    @field_validator("map_bytes", "prepare_s", "index_bytes", "cpu_s", "peak_bytes", mode="before")
    @classmethod
    def _check_number(cls, value: object, info: ValidationInfo) -> object:
        is_number = isinstance(value, int | float) and not isinstance(value, bool) and 0 <= value <= _MOST
        if value is not None and not is_number:
            raise ValueError(f"{info.field_name} of a run is {value!r}, expected a number from 0 to {_MOST:.0e}")
        return value

    @property
    def key(self) -> str | None:
        """Return what rows are tied to besides their queries: training, rendered imagery, how flights are followed."""
        training, follower = self.learned, self.follower
        return dependency_key(
            None if training is None else training.key,
            self.rendered_imagery,
            None if follower is None else follower.hash,
        )

    @classmethod
    def open(cls, folder: Path) -> Self | None:
        """Read `run.json` of a folder; None if there is no run. Raise `StoreError` if it is damaged."""
        path = folder / RUN
        if not path.is_file():
            return None
        content = read_json(path, mend=_MEND_RUN)
        if not isinstance(content, dict):
            raise damaged(path, f"it holds {str(content)[:40]!r}")
        if (folder / PACKED).exists():
            content["packed"] = True
        try:
            return cls.model_validate(content)
        except ValidationError as error:
            first = error.errors()[0]
            field = "" if first["type"] == "value_error" else ".".join(map(str, first["loc"]))  # ours name the field
            where = f"{field} is {first['input']!r}: " if field else ""
            raise damaged(path, where + first["msg"].removeprefix("Value error, ")) from error

    def save(self, folder: Path) -> None:
        """Write `run.json` in place of an older one; raise `StoreError` if the folder cannot be written."""
        with fresh_file(folder / RUN, mend="check your rights and the free space") as scratch:
            scratch.write_text(json_text(self.content()), encoding="utf-8")

    def content(self) -> dict[str, object]:
        """Return what `run.json` states, for a writer of JSON."""
        return self.model_dump(mode="json", exclude_unset=True)


def damaged(path: Path, fault: str) -> StoreError:
    """Return the error of a `run.json` with a fault."""
    return StoreError(f"{path} is damaged ({one_line(fault)}): {_MEND_RUN}")


def mark_packed(folder: Path, sha256: str) -> None:
    """Mark the answers of a run for good as such that came in an archive of this hash.

    The mark has a file of its own: `run.json` is written anew when more is asked, and may be removed.
    """
    (folder / PACKED).write_text(json_text({"archive_sha256": sha256}), encoding="utf-8")


Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
Mask = NDArray[np.bool_]

ROUND: Final = "round.json"  # beside the tasks of a run, while all of it is asked again
# Answers are scored and stored without the digits below these, which are most of the bytes (record 5).
# Powers of two: what is left out is zeros.
STEP_M: Final = 2.0**-7
STEP_DEG: Final = 2.0**-7
COVARIANCE_BITS: Final = 16
CANDIDATE_M: Final = SAME_PLACE_M + STEP_M  # of a candidate, as far as an answer that names it may be read

_MEND: Final = "write it again, or remove it where it is a part of a run"
_MEND_ROUND: Final = "remove it and enter with --again"
_ROWS_AT_ONCE: Final = 64
_PART: Final = re.compile(r"part-(\d{20})-\d+\.parquet")

SCHEMA_VERSION: Final = 1
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
RUN_SCHEMA: Final = PREDICTION_SCHEMA.append(pa.field(ASKED, pa.string()))  # of a submission
MATCHER_S: Final = "matcher_s"
# Of trackers, and not in files of others unless they follow flights.
FIX_FIELDS: Final = (pa.field("is_accepted", pa.bool_()), pa.field("covariance", pa.list_(pa.float64())))
FLOWN_SCHEMA: Final = pa.schema([*PREDICTION_SCHEMA, *FIX_FIELDS], metadata=PREDICTION_SCHEMA.metadata)
_OPTIONAL: Final = (pa.field(MATCHER_S, pa.float64()), *FIX_FIELDS)
PART_SCHEMA: Final = pa.schema([*RUN_SCHEMA, *_OPTIONAL], metadata=RUN_SCHEMA.metadata)  # of a run's own parts


def schema_of(predictions: Iterable[Prediction]) -> pa.Schema:
    """Return the schema of a file of predictions: with the columns of fixes where a tracker answered."""
    return FLOWN_SCHEMA if any(item.is_accepted is not None for item in predictions) else PREDICTION_SCHEMA


def prediction_row(prediction: Prediction) -> dict[str, object]:
    """Return a prediction as a row of `PREDICTION_SCHEMA`."""
    return {
        "query_id": prediction.query_id,
        "candidates": [
            {**{name: getattr(pose, name) for name in POSE_FIELDS}, "score": score}
            for pose, score in prediction.candidates
        ],
        "confidence": prediction.confidence,
        "diagnostics": list(prediction.diagnostics.items()),
        "status": prediction.status,
        "message": prediction.message,
        "latency_s": prediction.latency_s,
        MATCHER_S: prediction.matcher_s,
        "is_accepted": prediction.is_accepted,
        "covariance": None if prediction.covariance is None else list(prediction.covariance),
    }


def prediction_of(row: Mapping[str, Any]) -> Prediction:
    """Invert `prediction_row`; ignore further fields of a candidate."""
    poses = tuple(
        (Pose(**{name: item[name] for name in POSE_FIELDS}), item["score"]) for item in row["candidates"] or ()
    )
    return _with_candidates(row, poses)


def predictions_of(table: pa.Table) -> list[Prediction]:
    """Return the predictions of a table without `row_faults`, last first; by columns, which is faster."""
    column = table["candidates"].combine_chunks()
    if not len(table):
        return []
    with uncollected():
        poses, scores, ends = poses_of(column), column.values.field("score").to_pylist(), column.offsets.to_pylist()
        rows = table.drop_columns(["candidates"]).to_pylist()
        return [
            _with_candidates(rows[at], tuple(zip(poses[at], scores[ends[at] : ends[at + 1]], strict=True)))
            for at in reversed(range(len(rows)))
        ]


def _with_candidates(row: Mapping[str, Any], candidates: tuple[tuple[Pose, float], ...]) -> Prediction:
    return Prediction(
        query_id=row["query_id"],
        candidates=candidates,
        confidence=row["confidence"],
        diagnostics=dict(row["diagnostics"] or ()),
        status=row["status"],
        message=row["message"] or "",
        latency_s=row["latency_s"],
        matcher_s=row.get(MATCHER_S),
        is_accepted=row.get("is_accepted"),
        covariance=None if row.get("covariance") is None else tuple(row["covariance"]),
    )


def differing_columns(table: pa.Table) -> list[tuple[str, str, str]]:
    """Return the columns that a table of predictions lacks or has of another type: name, found and expected type.

    Further columns, in any order, are no difference.

    >>> differing_columns(PREDICTION_SCHEMA.empty_table().drop_columns(["message"]))
    [('message', 'nothing', 'string')]
    """
    found = {field.name: field.type for field in table.schema}
    # Rows of a run state the matcher's own time as well; a file of somebody else need not.
    known = [*PREDICTION_SCHEMA, *(field for field in _OPTIONAL if field.name in found)]
    counts = {field: table.schema.names.count(field.name) for field in known}
    twice = [(field.name, f"{count} columns", str(field.type)) for field, count in counts.items() if count > 1]
    return twice or [
        (field.name, str(found.get(field.name, "nothing")), str(field.type))
        for field in known
        if field.name not in found or not is_like(found[field.name], field.type)
    ]


@dataclass(frozen=True, slots=True)
class Answers:
    """Answers to queries, a row for each with the columns of `PART_SCHEMA`; `excluded` counts rows that answer others.

    They are `rounded`, so that a board scored from its stored answers is the same.
    """

    table: pa.Table
    excluded: int = 0

    @classmethod
    def open(cls, folder: Path, asked: Mapping[str, str], *, is_tied: bool = True) -> Self:
        """Read answers to some queries from a run's folder; of two for one query, the one that was written last.

        `asked` gives the hash of each query, by id (`Task.asked`); a row must carry it, tied to what
        `run.json` says. `is_tied` states whether rows without a hash are known to answer these queries. A run that was
        killed before its first row has no answers. Raise `StoreError` if a part cannot be read.
        """
        tables: list[pa.Table] = []
        seen: set[str] = set()
        excluded: set[Tie] = set()
        parts = parts_of(folder)
        under = {parent: asked_in(parent, asked) for parent in {part.parent for part in parts}}
        for part in reversed(parts):
            table = _checked(part, is_own=part != folder)
            ties = _ties_of(table)
            is_own = [tie.answers(under[part.parent], is_tied=is_tied) for tie in ties]
            excluded |= {replace(tie, status="") for tie, own in zip(ties, is_own, strict=True) if not own}
            ids = [tie.query_id if own else None for tie, own in zip(ties, is_own, strict=True)]
            tables.append(_newest(table, ids, seen))
        return cls(rounded(_joined(tables)), len(excluded))

    @classmethod
    def read(cls, path: Path) -> Self:
        """Read all rows of a run's folder or a file, one for each id. Raise as `read_predictions` does."""
        return cls(rounded(_joined(list(_tables_of(path)))))

    @classmethod
    def of(cls, predictions: Iterable[Prediction]) -> Self:
        """Return answers that are in memory."""
        schema = PART_SCHEMA.remove(PART_SCHEMA.get_field_index(ASKED))
        return cls(rounded(pa.Table.from_pylist([prediction_row(item) for item in predictions], schema=schema)))

    @classmethod
    def merged(cls, parts: Sequence[Self]) -> Self:
        """Return several answers as one; of two for one query, that of the last."""
        seen: set[str] = set()
        tables = [part.table for part in reversed(parts)]
        return cls(_joined([_newest(table, table["query_id"].to_pylist(), seen) for table in tables]))

    @property
    def found(self) -> dict[str, Prediction]:
        """Return the answers by query id."""
        return {item.query_id: item for item in predictions_of(self.table)}

    def columns(self) -> "AnswerColumns":
        """Return the answers as columns, without an object for each."""
        return AnswerColumns.of(self.table)

    def some(self, rows: Sequence[int]) -> Self:
        """Return some rows."""
        return replace(self, table=self.table.take(pa.array(rows, pa.int64())))

    def lean(self) -> Self:
        """Return the answers without their candidates, which take far longer to read than all the rest."""
        nothing = pa.array([[]] * len(self.table), PREDICTION_SCHEMA.field("candidates").type)
        at = self.table.column_names.index("candidates")
        return replace(self, table=self.table.set_column(at, "candidates", nothing))


def rounded(answers: pa.Table) -> pa.Table:
    """Return answers with positions to `STEP_M` and headings to `STEP_DEG`.

    Covariances keep `COVARIANCE_BITS` bits, if they stay covariances. Scores, confidences and diagnostics are exact,
    since ranks are made of them. Rounded again, answers stay as they are.
    """
    listed = answers["candidates"].combine_chunks()
    poses = listed.flatten()
    columns = {field.name: _numbers(poses.field(field.name)) for field in _CANDIDATE}
    columns |= {name: _on_grid(columns[name], STEP_M) for name in ("easting_m", "northing_m")}
    columns["yaw_deg"] = _on_grid(columns["yaw_deg"], STEP_DEG) % 360
    struct = pa.StructArray.from_arrays([pa.array(values) for values in columns.values()], names=list(columns))
    starts = pc.subtract(listed.offsets, listed.offsets[0]).cast(pa.int32())
    new = {"candidates": pa.ListArray.from_arrays(starts, struct)}
    if "covariance" in answers.column_names:
        # a file may lack all of them, and so their type
        whole = answers["covariance"].cast(pa.list_(pa.float64())).combine_chunks()
        new["covariance"] = _rounded_covariances(whole)
    for name, column in new.items():
        answers = answers.set_column(answers.column_names.index(name), name, column)
    return answers


def _on_grid(values: Floats, step: float) -> Floats:
    return np.round(values / step) * step


def _rounded_covariances(column: pa.ListArray) -> pa.ListArray:
    exact = _numbers(column.flatten()).reshape(-1, SIDE**2)
    mantissa, exponent = np.frexp(exact)
    coarse = np.ldexp(_on_grid(mantissa, 2.0**-COVARIANCE_BITS), exponent)
    is_one = are_covariances(coarse.reshape(-1, SIDE, SIDE))
    values = pa.array(np.where(is_one[:, np.newaxis], coarse, exact).ravel())
    ends = np.concatenate([[0], np.cumsum(np.where(column.is_valid(), SIDE**2, 0))])
    return pa.ListArray.from_arrays(pa.array(ends, pa.int32()), values, mask=column.is_null())


@dataclass(frozen=True, slots=True, kw_only=True)
class AnswerColumns:
    """R rows of predictions as columns, without an object for each, and their C candidates one after the other.

    `confidence` and `latency_s` have shape (R,), NaN for null. `poses`, shape (C, 4), are easting, northing, yaw and
    scale; `scores` and `row`, shape (C,), the score and the row of each candidate; `first`, shape (R,), the first
    candidate of each row, -1 without one.
    """

    query_id: list[str]
    status: list[str]
    confidence: Floats
    latency_s: Floats
    poses: Floats
    scores: Floats
    row: Ints
    first: Ints

    @property
    def is_ok(self) -> NDArray[np.bool_]:
        """Return which rows have the status "ok", shape (R,)."""
        return np.array([status == "ok" for status in self.status], dtype=bool)

    @property
    def fix(self) -> Ints:
        """Return the candidate that is the fix of each row, its first, shape (R,); -1 where the status is not ok."""
        return np.where(self.is_ok, self.first, -1)

    @classmethod
    def of(cls, table: pa.Table) -> Self:
        """Return the columns of a table without `row_faults`.

        >>> pose = Pose(easting_m=1.0, northing_m=2.0, yaw_deg=3.0)
        >>> answers = [Prediction(query_id="a"), Prediction(query_id="b", candidates=((pose, 9.0),))]
        >>> found = Answers.of(answers).columns()
        >>> found.poses.tolist(), found.row.tolist(), found.first.tolist()
        ([[1.0, 2.0, 3.0, 1.0]], [1], [-1, 0])
        """
        lists = table["candidates"].combine_chunks()
        row, items = pc.list_parent_indices(lists).to_numpy(), pc.list_flatten(lists)
        counts = np.bincount(row, minlength=len(table))
        poses = [_numbers(items.field(name)) for name in POSE_FIELDS]
        return cls(
            query_id=table["query_id"].to_pylist(),
            status=table["status"].to_pylist(),
            confidence=_numbers(table["confidence"]),
            latency_s=_numbers(table["latency_s"]),
            poses=np.column_stack(poses),
            scores=_numbers(items.field("score")),
            row=np.asarray(row, dtype=np.int64),
            first=np.where(counts > 0, np.cumsum(counts) - counts, -1),
        )


class StoredAnswers(Mapping[str, Prediction]):
    """Answers to the queries of some tasks, read from their files when they are asked for, a task at a time.

    `read` returns the answers to each task, by its folder; `task_of` is the folder of each query. A caller that asks in
    the order of the tasks reads each of them once.
    """

    def __init__(self, read: Mapping[Path, Callable[[], Answers]], task_of: Mapping[str, Path]) -> None:
        self._read, self._task_of = dict(read), task_of
        self._last: tuple[Path | None, dict[str, Prediction]] = (None, {})

    @classmethod
    def of(cls, answers: Iterable[Prediction]) -> Self:
        """Return answers that are in memory, as those of one task."""
        listed = list(answers)
        return cls({Path(): partial(Answers.of, listed)}, dict.fromkeys((item.query_id for item in listed), Path()))

    def columns(self, query_ids: Iterable[str]) -> Iterator[AnswerColumns]:
        """Yield the answers to all queries of the tasks that some queries belong to, a task at a time."""
        asked = {self._task_of[name] for name in query_ids if name in self._task_of}
        for task, read in self._read.items():
            if task in asked:
                yield read().columns()

    def of_task(self, task: Path) -> Answers:
        """Return the answers to one task. Raise `StoreError` if they cannot be read."""
        return self._read[task]()

    def some(self, query_ids: Iterable[str]) -> dict[str, Prediction]:
        """Return the answers to some queries by id, read without those to others; raise KeyError without one.

        >>> answers = StoredAnswers.of(Prediction(query_id=name) for name in "abc")
        >>> sorted(answers.some(["c", "a"]))
        ['a', 'c']
        """
        asked: dict[Path, set[str]] = {}
        for name in query_ids:
            asked.setdefault(self._task_of[name], set()).add(name)
        found: dict[str, Prediction] = {}
        for task, names in asked.items():
            answers = self.of_task(task)
            rows = [at for at, name in enumerate(answers.table["query_id"].to_pylist()) if name in names]
            found |= answers.some(rows).found
        if lost := next((name for names in asked.values() for name in names if name not in found), None):
            raise KeyError(lost)
        return found

    def __getitem__(self, query_id: str) -> Prediction:
        """Return one answer; raise KeyError without one."""
        task = self._task_of[query_id]
        if task not in self._read:
            raise KeyError(query_id)
        return self._of(task)[query_id]

    def __iter__(self) -> Iterator[str]:
        for task in self._read:
            yield from self._of(task)

    def __len__(self) -> int:
        return sum(len(self._of(task)) for task in self._read)

    def _of(self, task: Path) -> dict[str, Prediction]:
        if self._last[0] != task:
            self._last = (task, self.of_task(task).found)
        return self._last[1]

    def lean(self) -> "StoredAnswers":
        """Return the same answers without their candidates, which take far longer to read than all the rest."""
        return StoredAnswers({task: partial(_lean, read) for task, read in self._read.items()}, self._task_of)


def _lean(read: Callable[[], Answers]) -> Answers:
    return read().lean()


# --- parts on disk ---------------------------------------------------------------------------------------------------


def write_part(folder: Path, predictions: Sequence[Prediction], *, asked: Mapping[str, str] | None = None) -> Path:
    """Add rows to a run, in a file of their own that is written whole or not at all.

    `asked` gives the hash that each row carries, by query id (`Task.asked`); without it, the file is one as
    anyone may submit it. Raise `StoreError` if the disk is full or the folder cannot be written.
    """
    path = folder / f"part-{_stamp_ns(folder):020d}-{os.getpid()}.parquet"
    rows = [prediction_row(item) for item in predictions]
    if asked is not None:
        rows = [row | {ASKED: asked[item.query_id]} for row, item in zip(rows, predictions, strict=True)]
    table = pa.Table.from_pylist(rows, schema=PREDICTION_SCHEMA if asked is None else PART_SCHEMA)
    with fresh_file(path, mend="free some space and run again, it continues there") as scratch:
        write_table(table, scratch)
    return path


def _stamp_ns(folder: Path) -> int:
    """Return the time now, or just after the last part if a clock was set back: a later name is a newer row."""
    return max(time.time_ns(), 1 + max(map(_written_ns, folder.glob("part-*.parquet")), default=0))


def _written_ns(part: Path) -> int:
    """Return the stamp in the name of a part, 0 if it has none."""
    found = _PART.fullmatch(part.name)
    return int(found[1]) if found else 0


def begin_round(run: Path) -> int:
    """Begin to ask all of a run again, or go on with a round that was cut; return its stamp.

    `run` is the folder of all tasks of a run. Earlier rows stay until newer ones replace them. Raise `StoreError` if
    the record of the round cannot be read or written.
    """
    since_ns = open_round(run)
    if since_ns == 0 and run.is_dir():
        since_ns = max(time.time_ns(), 1 + max(map(_written_ns, run.rglob("part-*.parquet")), default=0))
        with fresh_file(run / ROUND, mend="check your rights and the free space") as scratch:
            scratch.write_text(json_text({"since_ns": since_ns}), encoding="utf-8")
    return since_ns


def open_round(run: Path) -> int:
    """Return the stamp of the round that a run is in, since which rows count; 0 if all rows do. Raise `StoreError`."""
    path = run / ROUND
    if not path.is_file():
        return 0
    content = read_json(path, mend=_MEND_ROUND)
    since_ns = content.get("since_ns") if isinstance(content, dict) else None
    if not isinstance(since_ns, int):
        raise StoreError(f"{path} is damaged (since_ns is {since_ns!r}): {_MEND_ROUND}")
    return since_ns


def end_round(run: Path) -> None:
    """End the round of a run: all its rows count from now on, newer ones first."""
    (run / ROUND).unlink(missing_ok=True)


def is_run(folder: Path) -> bool:
    """Return True if a folder is a run, or holds those of a matcher."""
    patterns = (RUN, f"*/*/{RUN}", f"*/*/*/{RUN}")
    return any(next(folder.glob(pattern), None) is not None for pattern in patterns)


def parts_of(path: Path) -> list[Path]:
    """Return the files of a run in the order they were written, or of all runs in a folder, or the file itself."""
    if path.is_file():
        return [path]
    return sorted(path.glob("part-*.parquet")) or sorted(path.rglob("part-*.parquet"), key=lambda part: part.name)


@dataclass(frozen=True, slots=True)
class Tie:
    """Link of a row to its query: id, status, and hash of the question.

    The hash is empty in files of predictions and in runs of older versions: their rows answer any query of their id.
    A caller must know otherwise which queries these are.
    """

    query_id: str
    status: str
    asked: str

    def answers(self, asked: Mapping[str, str], *, is_tied: bool = True) -> bool:
        """Return whether the row answers one of these queries as they are now; without a hash, return `is_tied`.

        >>> [Tie("a", "ok", asked).answers({"a": "ff"}) for asked in ("ff", "ee", "")]
        [True, False, True]
        """
        now = asked.get(self.query_id)
        return now is not None and (self.asked == now if self.asked else is_tied)


def _newest(table: pa.Table, ids: Sequence[str | None], seen: set[str]) -> pa.Table:
    """Return the last row of each id that is not `seen`, and note these as seen; rows without an id are left out."""
    rows = []
    for at in range(len(ids) - 1, -1, -1):
        name = ids[at]
        if name is not None and name not in seen:
            seen.add(name)
            rows.append(at)
    return table if len(rows) == len(table) else table.take(pa.array(rows, pa.int64()))


def _joined(tables: Sequence[pa.Table]) -> pa.Table:
    """Return the rows of several tables, of which some may lack columns; an empty one where there are none."""
    plain = PART_SCHEMA.remove_metadata().empty_table()
    some = [table.replace_schema_metadata() for table in tables if len(table)]
    return pa.concat_tables(some, promote_options="permissive") if some else plain


def asked_in(folder: Path, asked: Mapping[str, str]) -> Mapping[str, str]:
    """Return the hash that each row must carry: of its query, and of what `run.json` records.

    Raise `StoreError` if `run.json` is damaged.

    >>> asked_in(Path("nowhere"), {"a": "ff"})
    {'a': 'ff'}
    """
    key = read_key(folder)
    return {name: answer_hash(one, key) for name, one in asked.items()}


def read_key(folder: Path) -> str | None:
    """Read what rows are tied to besides their queries from `run.json`. Raise as `RunManifest.open` does."""
    return (RunManifest.open(folder) or RunManifest()).key


def read_predictions(path: str | Path) -> Iterator[Prediction]:
    """Read predictions of a run's folder or a file, newest first; of two for one query, the one written last.

    A folder holds two where a query was asked again, or was drawn anew and asked: `Answers.open` separates them.

    Raises
    ------
    StoreError
        If there is none, or a file cannot be read.
    """
    for table in _tables_of(given_path(path)):
        yield from predictions_of(table)


def _tables_of(path: Path) -> Iterator[pa.Table]:
    parts = parts_of(path)
    if not parts:
        raise StoreError(f"{path} holds no predictions: run a matcher first, or name a predictions file")
    seen: set[str] = set()
    for part in reversed(parts):
        table = _checked(part, is_own=part != path)
        yield _newest(table, table["query_id"].to_pylist(), seen)


def _checked(part: Path, *, is_own: bool) -> pa.Table:
    """Read a part; refuse other columns than those of predictions, and rows outside their bounds."""
    table = read_part(part, is_own=is_own)
    for name, found, expected in differing_columns(table):
        fault = f"{name}: found {found}, expected {expected}"[:200]
        raise StoreError(f"{part} holds no predictions ({fault}): 'verify' lists all that is missing")
    for wrong in row_faults(table):
        fault = one_line(f"{wrong.column}: found {wrong.found}, expected {wrong.expected}")
        raise StoreError(f"{part}, row {wrong.row}, is no prediction ({fault}): 'verify' says all that is wrong")
    return table


def read_part(path: Path, *, is_own: bool) -> pa.Table:
    """Read a whole parquet file; raise `StoreError` if it is missing, damaged, too large, or no parquet file.

    `is_own` is True of a part of a run, whose answers were held to their bounds before they were written: the lengths
    of others are looked at first, which takes as long as reading them.
    """
    if not is_own:
        check_lengths(path, mend=_MEND)
    table = read_table(path, mend=_MEND)
    try:
        table.validate(full=True)  # offsets, and texts that are no UTF-8, which Arrow reads unchecked
    except pa.ArrowException as error:
        raise StoreError(f"{path} cannot be read ({one_line(str(error))}): {_MEND}") from error
    return table


def check_lengths(path: Path, *, mend: str) -> None:
    """Raise `StoreError` if a list or text of a file is far beyond its bound, before the file is read as a whole.

    A small file may unpack to lists and texts that no memory holds.
    """
    before = 0
    batches = read_batches(
        path, mend=mend, rows=_ROWS_AT_ONCE, columns=PART_SCHEMA.names, text_bytes=FAR * MOST_MESSAGE
    )
    for batch in batches:
        far = far_fault(batch)
        if far is not None:
            fault = f"{far.column}: found {far.found}, expected {far.expected}"
            raise StoreError(f"{path}, row {before + far.row}, is no prediction ({fault}): {mend}")
        before += len(batch)


def items_of(table: pa.Table) -> Iterator[dict[str, Any]]:
    """Yield the rows of a table, few of them at once as objects of Python, which are far larger."""
    for batch in table.to_batches(max_chunksize=_ROWS_AT_ONCE):
        yield from batch.to_pylist()


def merge_runs(runs: Sequence[Path], into: Path, *, asked: Mapping[str, str] | None = None) -> int:
    """Write the predictions of folders and files into one file, sorted by query; return their number.

    Of two for one query the first counts, in the order of `runs`. The same predictions give the same file, whatever
    parts they came in. With `asked`, only answers to these queries (`Task.asked`) are taken from folders.
    Answers of trackers keep `is_accepted` and `covariance`.

    Raises
    ------
    StoreError
        If there are none, the folders are of different matchers, versions or settings, two rows answer different
        queries of one id, a file cannot be read, or the new one cannot be written.
    """
    check_one_matcher(runs)
    if asked is None:
        _check_one_query(runs)
    if into.exists() and not _is_ours(into):
        raise StoreError(f"{into} is no predictions file and would be lost: name another one")
    found: dict[str, Prediction] = {}
    for path in runs:
        for prediction in _to_merge(path, asked):
            found.setdefault(prediction.query_id, prediction)
    rows = [prediction_row(found[name]) for name in sorted(found)]
    with fresh_file(into, mend="check your rights and the free space") as scratch:
        write_table(pa.Table.from_pylist(rows, schema=schema_of(found.values())), scratch)
    return len(rows)


def _to_merge(path: Path, asked: Mapping[str, str] | None) -> Iterable[Prediction]:
    if asked is None or not path.is_dir() or not parts_of(path):
        return read_predictions(path)
    return Answers.open(path, asked).found.values()


def check_one_matcher(runs: Sequence[Path]) -> None:
    """Raise `StoreError` if the `run.json` of two folders name different matchers, versions or settings."""
    folders = [run.parent for path in runs if path.is_dir() for run in sorted(path.rglob(RUN))]
    known = [(path, run) for path in folders if (run := RunManifest.open(path)) is not None]
    for path, run in known[1:]:
        first, other = known[0]
        if run.hash != other.hash:
            raise StoreError(
                f"{path} holds answers of {_who(run)}, {first} those of {_who(other)}: "
                "two matchers, versions or settings are never mixed, name the folder of one"
            )


def _check_one_query(runs: Sequence[Path]) -> None:
    """Refuse answers to two versions of a query, which a file of predictions could not separate."""
    found: dict[str, str] = {}
    for path in runs:
        for tie in read_ties(path) if path.is_dir() else []:
            if tie.asked and found.setdefault(tie.query_id, tie.asked) != tie.asked:
                raise StoreError(
                    f"{path} holds answers to query {tie.query_id} and to an earlier version of it: "
                    "name the tasks with --tasks"
                )


def _who(run: RunManifest) -> str:
    return f"{run.matcher.name or 'an unknown matcher'} {run.matcher.version} ({run.hash})"


def _is_ours(path: Path) -> bool:
    try:
        known = (PREDICTION_SCHEMA.names, FLOWN_SCHEMA.names)
        return path.is_file() and read_schema(path, mend=_MEND).names in known
    except StoreError:
        return False


def read_ties(folder: Path, *, since_ns: int = 0) -> list[Tie]:
    """Read the links of a run's rows to their queries, as written; raise `StoreError` if a part cannot be read.

    Parts that were written before the stamp `since_ns` are left out.
    """
    found: list[Tie] = []
    for part in parts_of(folder):
        if _written_ns(part) < since_ns:
            continue
        table = read_part(part, is_own=True)
        if differing_columns(table):
            raise StoreError(f"{part} holds no predictions: move it out of the run's folder")
        found += _ties_of(table)
    return found


def _ties_of(table: pa.Table) -> list[Tie]:
    columns = [name for name in ("query_id", "status", ASKED) if name in table.column_names]
    return [tie_of(row) for row in table.select(columns).to_pylist()]


def tie_of(row: Mapping[str, Any]) -> Tie:
    """Return the link of one row to its query."""
    return Tie(str(row["query_id"]), str(row["status"]), str(row.get(ASKED) or ""))


def ids_done(folder: Path, asked: Mapping[str, str], *, again: Iterable[str] = (), since_ns: int = 0) -> set[str]:
    """Return the ids of queries that a run has answered as they are now.

    Rows with a status in `again` do not count, nor those that were written before the stamp `since_ns`. `asked` must
    include the training (`asked_in`). Raise `StoreError` if a part cannot be read.
    """
    ties = read_ties(folder, since_ns=since_ns) if folder.is_dir() else []
    return {tie.query_id for tie in ties if tie.status not in set(again) and tie.answers(asked)}


# --- untrusted rows ---------------------------------------------------------------------------------------------------

FAR: Final = 4  # times a bound, at least the bytes of a character; a file that goes beyond it is refused unread
_TEXTS: Final = ("query_id", "status", "message", ASKED)
_MOST_ITEMS: Final = {"candidates": MOST_CANDIDATES, "diagnostics": MOST_DIAGNOSTICS, "covariance": SIDE**2}
_PAIRS: Final = pa.list_(pa.struct([("key", pa.string()), ("value", pa.float64())]))


NO_ROW: Final = "no row for "  # begins what was found instead of an answer


@dataclass(frozen=True, slots=True)
class Violation:
    """One fault: file, where it is known, row index (-1 for the whole file), column, found and expected."""

    file: str
    row: int
    column: str
    found: str
    expected: str

    @property
    def is_missing_row(self) -> bool:
        """Return True if the fault is a query without a row."""
        return self.found.startswith(NO_ROW)

    def to_text(self) -> str:
        """Return the fault in one line.

        >>> Violation(file="mine.parquet", row=3, column="confidence", found="1.5", expected="0..1 or null").to_text()
        'mine.parquet, row 3, confidence: found 1.5, expected 0..1 or null'
        """
        where = self.file if self.row < 0 else f"{self.file}, row {self.row}"
        return f"{where}, {self.column}: found {self.found}, expected {self.expected}"


def far_fault(batch: pa.RecordBatch) -> Violation | None:
    """Return the first list or text of some rows that is more than `FAR` times its bound, or None.

    Texts must be dictionaries. Nothing becomes an object of Python; `row_faults` finds what is shorter.
    """
    columns = zip(batch.schema.names, batch.columns, strict=True)
    return next((fault for name, column in columns for fault in _far_faults(name, column)), None)


def _far_faults(name: str, column: pa.Array) -> Iterator[Violation]:
    kind = column.type
    if name in _TEXTS and pa.types.is_dictionary(kind):
        yield from _longest(name, _text_lengths(column), "bytes", MOST_MESSAGE)
    if name in _MOST_ITEMS and (pa.types.is_list(kind) or pa.types.is_large_list(kind) or pa.types.is_map(kind)):
        ends = column.offsets.to_numpy()
        yield from _longest(name, np.diff(ends), "items", _MOST_ITEMS[name])
        if pa.types.is_map(kind) and pa.types.is_dictionary(kind.key_type):
            for fault in _longest(name, _text_lengths(column.keys), "bytes in a name", MOST_NAME):
                yield replace(fault, row=int(np.searchsorted(ends, fault.row, side="right")) - 1)


def _text_lengths(texts: pa.DictionaryArray) -> NDArray[np.int64]:
    """Return the bytes of each text, 0 of a null."""
    lengths = pc.binary_length(texts.dictionary).take(texts.indices)
    return np.asarray(lengths.fill_null(0).cast(pa.int64()))


def _longest(column: str, lengths: NDArray[np.int64], unit: str, most: int) -> Iterator[Violation]:
    if len(lengths) and lengths.max() > FAR * most:
        row = int(np.argmax(lengths))
        yield Violation(file="", row=row, column=column, found=f"{lengths[row]} {unit}", expected=f"at most {most}")


def row_faults(table: pa.Table) -> Iterator[Violation]:
    """Check every number, name and text of rows against the bounds of an answer (`texts.BOUNDS`).

    The table must have all columns of predictions. Faults come by column, then by row.
    """
    if not len(table):
        return
    yield from _of_texts(table)
    for name in (name for name in ("confidence", "latency_s", MATCHER_S) if name in table.column_names):
        values, is_null = _numbers(table[name]), np.asarray(table[name].is_null())
        is_wrong = ~is_null & ~_is_within(name, values)
        yield from _faults(name, is_wrong, f"{bounds_text(name)} or null", f"{name} is {{:g}}", values)
    if "covariance" in table.column_names:
        yield from _of_covariances(table["covariance"])
    yield from _of_candidates(table["candidates"])
    yield from _of_diagnostics(table["diagnostics"])


def _faults(column: str, is_wrong: Mask, expected: str, found: str, *values: NDArray[Any]) -> Iterator[Violation]:
    """Yield a fault for each wrong row; `found` is formatted with the values of that row."""
    yield from _firsts(column, np.flatnonzero(is_wrong), expected, found, *(one[is_wrong] for one in values))


def _numbers(column: pa.ChunkedArray | pa.Array) -> NDArray[np.float64]:
    """Return the values of a column; NaN for null."""
    return np.asarray(column.cast(pa.float64(), safe=False), dtype=np.float64)


def _is_within(name: str, values: NDArray[np.float64]) -> Mask:
    least, most = BOUNDS[name]
    return np.asarray((values >= least) & (values <= most))


def _of_texts(table: pa.Table) -> Iterator[Violation]:
    """Check that names and statuses are known, and messages are lines."""
    for name, is_sound, expected in (
        ("query_id", bool, "the id of a query"),
        ("status", STATUSES.__contains__, ", ".join(STATUSES)),
        ("message", lambda text: is_line(text, MOST_MESSAGE), f"a line of at most {MOST_MESSAGE} printable characters"),
    ):
        texts, code = _texts(table[name])
        is_odd = np.array([name != "message" if text is None else not is_sound(text) for text in texts])[code]
        yield from _faults(name, is_odd, expected, "{!r}", texts[code])


def _texts(column: pa.ChunkedArray | pa.Array) -> tuple[NDArray[np.object_], NDArray[np.int64]]:
    """Return each text once, None last, and the index of the text of each row; -1 for null."""
    whole = column.cast(pa.string())
    coded = (whole.combine_chunks() if isinstance(whole, pa.ChunkedArray) else whole).dictionary_encode()
    texts = np.array([*coded.dictionary.to_pylist(), None], dtype=object)
    return texts, coded.indices.fill_null(-1).to_numpy(zero_copy_only=False).astype(np.int64)


def _of_candidates(column: pa.ChunkedArray) -> Iterator[Violation]:
    """Check that every row has a list, not too long, of complete candidates."""
    whole = column.combine_chunks()
    is_null = np.asarray(whole.is_null())
    yield from _faults("candidates", is_null, "a list, empty where there is no pose", "null")
    if is_null.all():
        return
    rows, items = pc.list_parent_indices(whole).to_numpy(), pc.list_flatten(whole)
    counts = np.bincount(rows, minlength=len(whole))
    yield from _faults("candidates", counts > MOST_CANDIDATES, f"at most {MOST_CANDIDATES}", "{} poses", counts)
    is_null = np.asarray(items.is_null())
    yield from _firsts("candidates", rows[is_null], "poses with scores", "a null")
    rows, items = rows[~is_null], items.filter(pa.array(~is_null))
    for name in (*POSE_FIELDS, "score"):
        values = _numbers(items.field(name))
        is_wrong = ~_is_within(name, values)
        yield from _firsts("candidates", rows[is_wrong], bounds_text(name), f"{name} is {{:g}}", values[is_wrong])


def _of_covariances(column: pa.ChunkedArray) -> Iterator[Violation]:
    """Check that every covariance is null, or nine numbers that are one."""
    whole = column.cast(pa.list_(pa.float64())).combine_chunks()
    is_given = ~np.asarray(whole.is_null())
    rows, values = pc.list_parent_indices(whole).to_numpy(), _numbers(pc.list_flatten(whole))
    counts = np.bincount(rows, minlength=len(whole))
    is_odd = is_given & (counts != SIDE**2)
    yield from _faults("covariance", is_odd, f"{SIDE**2} numbers, or null", "{} numbers", counts)
    bad = rows[~(np.abs(values) <= MOST_VARIANCE)]
    is_far = is_given & ~is_odd & np.isin(np.arange(len(whole)), bad)
    yield from _faults("covariance", is_far, f"numbers within {MOST_VARIANCE:g}", "a number beyond that")
    whole_rows = np.flatnonzero(is_given & ~is_odd & ~is_far)
    table = values[np.isin(rows, whole_rows)].reshape(-1, SIDE, SIDE)
    is_none = np.zeros(len(whole), dtype=bool)
    is_none[whole_rows] = ~are_covariances(table)
    expected = "a symmetric and positive definite matrix, or null"
    yield from _faults("covariance", is_none, expected, "a matrix that is none")


def _of_diagnostics(column: pa.ChunkedArray) -> Iterator[Violation]:
    """Check the number of diagnostics of each row, their names, each a line that is there once, and their numbers."""
    whole = column.cast(_PAIRS).combine_chunks()
    rows, items = pc.list_parent_indices(whole).to_numpy(), pc.list_flatten(whole)
    counts = np.bincount(rows, minlength=len(whole))
    yield from _faults("diagnostics", counts > MOST_DIAGNOSTICS, f"at most {MOST_DIAGNOSTICS}", "{} numbers", counts)
    names, code = _texts(items.field("key"))
    is_odd = np.array([not name or not is_line(name, MOST_NAME) for name in names])[code]
    expected = f"names of 1..{MOST_NAME} printable characters"
    yield from _firsts("diagnostics", rows[is_odd], expected, "the name {!r}", names[code[is_odd]])
    place = rows * len(names) + code
    order = np.argsort(place, kind="stable")
    again = order[1:][np.diff(place[order]) == 0]
    yield from _firsts("diagnostics", rows[again], "each name once", "{!r} twice", names[code[again]])
    values = _numbers(items.field("value"))
    is_wrong = ~_is_within("diagnostics", values)
    found, expected = "diagnostics[{!r}] is {:g}", bounds_text("diagnostics")
    yield from _firsts("diagnostics", rows[is_wrong], expected, found, names[code[is_wrong]], values[is_wrong])


def _firsts(
    column: str, rows: NDArray[np.int64], expected: str, found: str, *values: NDArray[Any]
) -> Iterator[Violation]:
    """Yield the first fault of each row among those of its items; `found` is formatted with the values of that item."""
    for row, at in zip(*np.unique(rows, return_index=True), strict=True):
        text = found.format(*(one[at] for one in values))[: 2 * MOST_NAME]
        yield Violation(file="", row=int(row), column=column, found=text, expected=expected)
