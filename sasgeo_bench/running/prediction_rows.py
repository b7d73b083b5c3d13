# SPDX-License-Identifier: Apache-2.0
"""Rows of `part-*.parquet`: their schema, conversion to and from predictions, and faults of untrusted rows."""

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from typing import Any, Final, Self

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from numpy.typing import NDArray

from sasgeo_bench.files.garbage import uncollected
from sasgeo_bench.geometry.pose import Pose
from sasgeo_bench.matching.results import STATUSES, Prediction
from sasgeo_bench.matching.tracker import MOST_VARIANCE, SIDE, are_covariances
from sasgeo_bench.regions.region import ATTRIBUTION, LICENCE
from sasgeo_bench.tasks.task_rows import ASKED, POSE_FIELDS, is_like, poses_of
from sasgeo_bench.texts import (
    BOUNDS,
    MOST_CANDIDATES,
    MOST_DIAGNOSTICS,
    MOST_MESSAGE,
    MOST_NAME,
    bounds_text,
    is_line,
)

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]

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


def prediction_row(prediction: Prediction) -> dict[str, Any]:
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


def table_of(predictions: Iterable[Prediction]) -> pa.Table:
    """Return predictions as a table with the columns of a run's own parts, but for the hash of the question."""
    schema = PART_SCHEMA.remove(PART_SCHEMA.get_field_index(ASKED))
    return pa.Table.from_pylist([prediction_row(item) for item in predictions], schema=schema)


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
        >>> found = AnswerColumns.of(table_of(answers))
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


def _with_candidates(row: Mapping[str, Any], candidates: tuple[tuple[Pose, float], ...]) -> Prediction:
    """Make a prediction of a row whose candidates were read by columns."""
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


# --- untrusted rows ---------------------------------------------------------------------------------------------------

Mask = NDArray[np.bool_]
FAR: Final = 4  # times a bound, at least the bytes of a character; a file that goes beyond it is refused unread
_TEXTS: Final = ("query_id", "status", "message", ASKED)
_MOST_ITEMS: Final = {"candidates": MOST_CANDIDATES, "diagnostics": MOST_DIAGNOSTICS, "covariance": SIDE**2}
_PAIRS: Final = pa.list_(pa.struct([("key", pa.string()), ("value", pa.float64())]))


@dataclass(frozen=True, slots=True, kw_only=True)
class RowFault:
    """A fault in one row: row number, column, value found, and value expected."""

    row: int
    column: str
    found: str
    expected: str


def far_fault(batch: pa.RecordBatch) -> RowFault | None:
    """Return the first list or text of some rows that is more than `FAR` times its bound, or None.

    Texts must be dictionaries. Nothing becomes an object of Python; `row_faults` finds what is shorter.
    """
    columns = zip(batch.schema.names, batch.columns, strict=True)
    return next((fault for name, column in columns for fault in _far_faults(name, column)), None)


def _far_faults(name: str, column: pa.Array) -> Iterator[RowFault]:
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


def _longest(column: str, lengths: NDArray[np.int64], unit: str, most: int) -> Iterator[RowFault]:
    if len(lengths) and lengths.max() > FAR * most:
        row = int(np.argmax(lengths))
        yield RowFault(row=row, column=column, found=f"{lengths[row]} {unit}", expected=f"at most {most}")


def row_faults(table: pa.Table) -> Iterator[RowFault]:
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


def _faults(column: str, is_wrong: Mask, expected: str, found: str, *values: NDArray[Any]) -> Iterator[RowFault]:
    """Yield a fault for each wrong row; `found` is formatted with the values of that row."""
    yield from _firsts(column, np.flatnonzero(is_wrong), expected, found, *(one[is_wrong] for one in values))


def _numbers(column: pa.ChunkedArray | pa.Array) -> NDArray[np.float64]:
    """Return the values of a column; NaN for null."""
    return np.asarray(column.cast(pa.float64(), safe=False), dtype=np.float64)


def _is_within(name: str, values: NDArray[np.float64]) -> Mask:
    least, most = BOUNDS[name]
    return np.asarray((values >= least) & (values <= most))


def _of_texts(table: pa.Table) -> Iterator[RowFault]:
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


def _of_candidates(column: pa.ChunkedArray) -> Iterator[RowFault]:
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


def _of_covariances(column: pa.ChunkedArray) -> Iterator[RowFault]:
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


def _of_diagnostics(column: pa.ChunkedArray) -> Iterator[RowFault]:
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
) -> Iterator[RowFault]:
    """Yield the first fault of each row among those of its items; `found` is formatted with the values of that item."""
    for row, at in zip(*np.unique(rows, return_index=True), strict=True):
        text = found.format(*(one[at] for one in values))[: 2 * MOST_NAME]
        yield RowFault(row=int(row), column=column, found=text, expected=expected)
