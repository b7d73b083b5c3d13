# SPDX-License-Identifier: Apache-2.0
"""Queries and truths as rows: the columns of `queries.parquet` and `truth.parquet`, in both directions."""

import datetime as dt
import hashlib
import json
from collections.abc import Iterable, Iterator, Mapping, Sequence
from itertools import accumulate, pairwise
from typing import TYPE_CHECKING, Any, Final, TypeVar

import numpy as np
import pyarrow as pa
import shapely

from sasgeo_bench.geometry.pose import Pose, Prior
from sasgeo_bench.regions.evidence import Evidence, pack, unpack
from sasgeo_bench.regions.region import ATTRIBUTION, LICENCE
from sasgeo_bench.tasks.frames import FRAME, frame_of, frame_row
from sasgeo_bench.tasks.query import PUBLISHED, TASK_VERSION, Query, Step, Truth

if TYPE_CHECKING:
    import geopandas as gpd

Rows = TypeVar("Rows", pa.Table, pa.RecordBatch)

POSE_FIELDS: Final = ("easting_m", "northing_m", "yaw_deg", "scale")
# Columns that are fields of a query, and of its prior.
_FIELDS: Final = (
    *("query_id", "track", "suite", "suite_version", "part", "region"),
    *("observed_on", "season", "prior_group"),
)
_PRIOR_FIELDS: Final = ("radius_m", "yaw_deg", "yaw_sigma_deg", "scale_sigma")
_POSE: Final = pa.struct([(name, pa.float64()) for name in POSE_FIELDS])

_VECTOR: Final = pa.struct(
    [("class", pa.string()), ("level", pa.int16()), ("is_bridge", pa.bool_()), ("wkb", pa.binary())]
)

_ASKED_VERSION: Final = 1  # raised if the same row asks for another answer, not if other rows are drawn
_META: Final = {"attribution": ATTRIBUTION, "licence": LICENCE, "task_version": str(TASK_VERSION)}

QUERY_SCHEMA: Final = pa.schema(
    [
        ("query_id", pa.string()),
        ("track", pa.string()),
        ("suite", pa.string()),
        ("suite_version", pa.int16()),
        ("part", pa.string()),
        ("region", pa.string()),
        ("cell_size_m", pa.float64()),
        ("rows", pa.int32()),
        ("cols", pa.int32()),
        ("classes", pa.list_(pa.string())),
        ("evidence", pa.binary()),
        ("confidence", pa.binary()),
        ("observed_on", pa.date32()),
        ("season", pa.string()),
        ("prior_group", pa.string()),
        ("prior_easting_m", pa.float64()),
        ("prior_northing_m", pa.float64()),
        ("prior_radius_m", pa.float64()),
        ("prior_yaw_deg", pa.float64()),
        ("prior_yaw_sigma_deg", pa.float64()),
        ("prior_scale_sigma", pa.float64()),
        ("candidates", pa.list_(_POSE)),
        ("vectors", pa.list_(_VECTOR)),
        ("sequence_id", pa.string()),
        ("frame", pa.int32()),
        ("increment", pa.list_(pa.float64())),
        ("increment_covariance", pa.list_(pa.float64())),
        ("frames", pa.list_(FRAME)),
    ],
    metadata=_META,
)

ASKED: Final = "asked_sha256"  # hash of a query and its map; an answer carries it, so that it counts for no other
VIEW_BYTES: Final = "view_bytes"  # column of stored results, which hold no views: bytes of each view
FILE_SCHEMA: Final = QUERY_SCHEMA.append(pa.field(ASKED, pa.string()))

STEP_COLUMNS: Final = ("sequence_id", "frame", "increment")  # of views of flights; null for others
HEAD_SCHEMA: Final = pa.schema(
    [
        QUERY_SCHEMA.field(name)
        for name in (
            *("query_id", "track", "suite", "suite_version", "part", "region"),
            *("rows", "cell_size_m", "prior_group", "candidates", *STEP_COLUMNS),
        )
    ]
)

TRUTH_SCHEMA: Final = pa.schema(
    [
        ("query_id", pa.string()),
        ("is_present", pa.bool_()),
        ("easting_m", pa.float64()),
        ("northing_m", pa.float64()),
        ("yaw_deg", pa.float64()),
        ("scale", pa.float64()),
        ("candidate", pa.int32()),
        ("pair_id", pa.string()),
        ("role", pa.string()),
        ("kind", pa.string()),
        ("strength", pa.float64()),
        ("strength_unit", pa.string()),
        ("unknown_share", pa.float64()),
        ("changed_share", pa.float64()),
        ("feature_density", pa.float64()),
        ("alias_index", pa.float64()),
        ("block", pa.string()),
        ("scene", pa.string()),
        ("measured", pa.map_(pa.string(), pa.float64())),
        ("detector", pa.string()),
    ],
    metadata=_META,
)

# Columns that older files lack, and the value that is meant by it.
ADDED: Final = {
    "detector": PUBLISHED,
    **dict.fromkeys(("frames", *STEP_COLUMNS, "increment_covariance")),
}

# Columns of queries and truths that may be null.
MAY_BE_NULL: Final = frozenset(
    {
        *("confidence", "observed_on", "season", "prior_easting_m", "prior_northing_m", "prior_radius_m"),
        *("prior_yaw_deg", "prior_yaw_sigma_deg", "candidates", "vectors", "sequence_id", "frame", "increment"),
        *("increment_covariance", "frames", ASKED, *POSE_FIELDS, "alias_index"),
    }
)

# Truths in a release: lists of pairs, since not every reader of parquet knows maps.
_PAIR: Final = pa.struct([("name", pa.string()), ("value", pa.float64())])
PLAIN_TRUTH_SCHEMA: Final = TRUTH_SCHEMA.set(
    TRUTH_SCHEMA.get_field_index("measured"), pa.field("measured", pa.list_(_PAIR))
)


def query_row(query: Query) -> dict[str, Any]:
    """Return one query as a row of `QUERY_SCHEMA`."""
    seen, prior = query.evidence, query.prior
    center = prior.center_m or (None, None)
    plain = {name: getattr(query, name) for name in _FIELDS}
    known = {f"prior_{name}": getattr(prior, name) for name in _PRIOR_FIELDS}
    return (
        plain
        | known
        | {
            "cell_size_m": seen.cell_size_m,
            "rows": seen.shape[0],
            "cols": seen.shape[1],
            "classes": list(seen.classes),
            "evidence": pack(seen.cells),
            "confidence": None if seen.confidence is None else seen.confidence.tobytes(),
            "prior_easting_m": center[0],
            "prior_northing_m": center[1],
            "candidates": [_pose_row(pose) for pose in query.candidates],
            "vectors": None if query.vectors is None else _vector_rows(query.vectors),
            "frames": [frame_row(frame) for frame in query.frames] or None,
        }
        | _step_row(query.step)
    )


def _step_row(step: Step | None) -> dict[str, Any]:
    """Return the columns of a flight; no column for a view alone."""
    if step is None:
        return {}
    numbers = {"increment": step.increment, "increment_covariance": step.covariance}
    return {
        "sequence_id": step.sequence_id,
        "frame": step.frame,
        **{name: None if values is None else list(values) for name, values in numbers.items()},
    }


def _pose_row(pose: Pose) -> dict[str, float]:
    return {name: getattr(pose, name) for name in POSE_FIELDS}


def _vector_rows(vectors: "gpd.GeoDataFrame") -> list[dict[str, Any]]:
    columns = [vectors[name].to_list() for name in ("class", "level", "is_bridge")]
    shapes = [bytes(shape) for shape in shapely.to_wkb(vectors.geometry.to_numpy())]
    return [
        {"class": name, "level": level, "is_bridge": is_bridge, "wkb": wkb}
        for name, level, is_bridge, wkb in zip(*columns, shapes, strict=True)
    ]


def query_of(row: dict[str, Any]) -> Query:
    """Return the query of a row of `QUERY_SCHEMA`."""
    shape = (len(row["classes"]), row["rows"], row["cols"])
    confidence = row["confidence"]
    evidence = Evidence(
        classes=tuple(row["classes"]),
        cells=unpack(row["evidence"], shape),
        cell_size_m=row["cell_size_m"],
        confidence=None if confidence is None else np.frombuffer(confidence, dtype=np.uint8).reshape(shape).copy(),
    )
    has_place = row["prior_radius_m"] is not None
    prior = Prior(
        center_m=(row["prior_easting_m"], row["prior_northing_m"]) if has_place else None,
        **{name: row[f"prior_{name}"] for name in _PRIOR_FIELDS},
    )
    return Query(
        **{name: row[name] for name in _FIELDS},
        evidence=evidence,
        prior=prior,
        candidates=tuple(Pose(**pose) for pose in row["candidates"] or ()),
        vectors=None if row["vectors"] is None else _vectors_of(row["vectors"]),
        frames=tuple(map(frame_of, row.get("frames") or ())),
        step=_step_of(row),
    )


def _step_of(row: dict[str, Any]) -> Step | None:
    """Return where the query of a row stands in a flight, None for a view alone."""
    if row.get("sequence_id") is None:
        return None
    increment, covariance = row["increment"], row["increment_covariance"]
    return Step(
        sequence_id=row["sequence_id"],
        frame=row["frame"],
        increment=None if increment is None else tuple(increment),
        covariance=None if covariance is None else tuple(covariance),
    )


def _vectors_of(rows: list[dict[str, Any]]) -> "gpd.GeoDataFrame":
    import geopandas as gpd  # noqa: PLC0415 - only tables of geometry need it

    return gpd.GeoDataFrame(
        {
            "class": np.array([row["class"] for row in rows], dtype=object),
            "level": np.array([row["level"] for row in rows], dtype=np.int16),
            "is_bridge": np.array([row["is_bridge"] for row in rows], dtype=bool),
        },
        geometry=gpd.GeoSeries(shapely.from_wkb([row["wkb"] for row in rows]), dtype="geometry"),
    )


def asked_sha256(row: Mapping[str, Any], map_hashes: Mapping[str, str]) -> str:
    """Return the hash of all that decides an answer: the row of a query, and what `task.json` holds of its map.

    Fields that are null, or not in `QUERY_SCHEMA`, do not count.
    """
    fields = {name: row[name] for name in QUERY_SCHEMA.names if row.get(name) is not None}
    text = json.dumps([_ASKED_VERSION, dict(map_hashes), fields], sort_keys=True, default=_plain)
    return hashlib.sha256(text.encode()).hexdigest()


def _plain(value: bytes | dt.date) -> str:
    return value.isoformat() if isinstance(value, dt.date) else hashlib.sha256(value).hexdigest()


def with_added(rows: Rows, added: Sequence[str] = ("detector",)) -> Rows:
    """Return queries or truths with the columns that were added since they were written, last.

    >>> with_added(pa.table({"query_id": ["a"]})).to_pylist()
    [{'query_id': 'a', 'detector': 'published'}]
    """
    lost = [name for name in added if name not in rows.schema.names]
    new: list[pa.Field] = [(TRUTH_SCHEMA if name in TRUTH_SCHEMA.names else QUERY_SCHEMA).field(name) for name in lost]
    columns = [*rows.columns, *(pa.array([ADDED[field.name]] * rows.num_rows, field.type) for field in new)]
    return type(rows).from_arrays(columns, schema=pa.schema([*rows.schema, *new], metadata=rows.schema.metadata))


def truth_row(truth: Truth) -> dict[str, Any]:
    """Return one truth as a row of `TRUTH_SCHEMA`."""
    pose = _pose_row(truth.pose) if truth.pose else dict.fromkeys(POSE_FIELDS)
    names = [name for name in TRUTH_SCHEMA.names if name not in pose and name != "measured"]
    return {name: getattr(truth, name) for name in names} | pose | {"measured": list(truth.measured.items())}


def truth_of(row: dict[str, Any]) -> Truth:
    """Return the truth of a row of `TRUTH_SCHEMA`, or of a release (`PLAIN_TRUTH_SCHEMA`)."""
    pose = None if row["easting_m"] is None else Pose(**{name: row[name] for name in POSE_FIELDS})
    rest = {name: value for name, value in row.items() if name not in (*POSE_FIELDS, "measured")}
    pairs = [(pair["name"], pair["value"]) if isinstance(pair, dict) else pair for pair in row["measured"]]
    return Truth(**rest, pose=pose, measured=dict(pairs))


def truth_sha256(truth: Truth) -> str:
    """Return the hash of a truth; values that older files lack do not count."""
    fields = {name: value for name, value in truth_row(truth).items() if ADDED.get(name) != value}
    return hashlib.sha256(json.dumps(fields, sort_keys=True).encode()).hexdigest()


def tie_key(learned: str | None, *others: str | None) -> str | None:
    """Return the key of what decides an answer besides the question: what was learned, and hashes of other things.

    Others are rendered imagery that was looked at, and how flights are followed.

    >>> tie_key("ab", None), len(tie_key(None, "cd"))
    ('ab', 64)
    """
    key = learned
    for other in others:
        key = key if other is None else hashlib.sha256(f"{key} {other}".encode()).hexdigest()
    return key


def asked_under(asked: str, key: str | None) -> str:
    """Return the hash that an answer carries: that of the question and of what else decides it (`tie_key`).

    Examples
    --------
    >>> asked_under("ab", None), len(asked_under("ab", "cd"))
    ('ab', 64)
    """
    return asked if key is None else hashlib.sha256(f"{asked} {key}".encode()).hexdigest()


def poses_of(lists: pa.ListArray) -> list[tuple[Pose, ...]]:
    """Return the poses of each row of a column of lists, without the slow way over a dictionary for each."""
    columns = [lists.values.field(name).to_numpy(zero_copy_only=False).tolist() for name in POSE_FIELDS]
    poses = [
        Pose(easting_m=easting_m, northing_m=northing_m, yaw_deg=yaw_deg, scale=scale)
        for easting_m, northing_m, yaw_deg, scale in zip(*columns, strict=True)
    ]
    return [tuple(poses[begin:end]) for begin, end in pairwise(lists.offsets.to_pylist())]


def query_bytes(query: Query) -> bytes:
    """Return one query as it goes to a matcher's process: a row in Arrow's stream format."""
    return stream_of(pa.RecordBatch.from_pylist([query_row(query)], schema=QUERY_SCHEMA))


def query_from(data: bytes) -> Query:
    """Return the query of `query_bytes`."""
    with pa.ipc.open_stream(data) as stream:
        return query_of(stream.read_all().to_pylist()[0])


def pairs_bytes(pairs: Iterable[tuple[bytes, Truth]]) -> tuple[list[int], bytes]:
    """Return queries (as bytes) and truths as they go to a process that learns, and the length of each query."""
    queries, truths = zip(*pairs, strict=True)
    rows = pa.RecordBatch.from_pylist([truth_row(truth) for truth in truths], schema=TRUTH_SCHEMA)
    return [len(query) for query in queries], b"".join((*queries, stream_of(rows)))


def pairs_from(sizes: Sequence[int], data: bytes) -> Iterator[tuple[Query, Truth]]:
    """Yield the pairs of `pairs_bytes`."""
    ends = list(accumulate(sizes, initial=0))
    with pa.ipc.open_stream(data[ends[-1] :]) as stream:
        truths = [truth_of(row) for row in stream.read_all().to_pylist()]
    for (begin, end), truth in zip(pairwise(ends), truths, strict=True):
        yield query_from(data[begin:end]), truth


def stream_of(batch: pa.RecordBatch) -> bytes:
    """Return a batch in Arrow's stream format."""
    sink = pa.BufferOutputStream()
    with pa.ipc.new_stream(sink, batch.schema) as stream:
        stream.write_batch(batch)
    return bytes(sink.getvalue())


_LIKE: Final = (  # a kind of column, and the kinds that can be read as it
    (pa.types.is_floating, (pa.types.is_floating, pa.types.is_integer)),
    (pa.types.is_integer, (pa.types.is_integer,)),
    (pa.types.is_string, (pa.types.is_string, pa.types.is_large_string)),
    (pa.types.is_binary, (pa.types.is_large_binary,)),
    (pa.types.is_map, (pa.types.is_map,)),
)


def is_like(found: pa.DataType, expected: pa.DataType) -> bool:
    """Return whether a column can be read as another type: floats and strings of any size, null for anything.

    Examples
    --------
    >>> is_like(pa.int16(), pa.float64()), is_like(pa.string(), pa.float64())
    (True, False)
    """
    if pa.types.is_null(found) or found.equals(expected):
        return True
    if pa.types.is_list(expected):
        is_list = pa.types.is_list(found) or pa.types.is_large_list(found)
        return is_list and _is_like_inside(found.value_type, expected.value_type)
    return any(kind(expected) and any(other(found) for other in others) for kind, others in _LIKE)


def _is_like_inside(found: pa.DataType, expected: pa.DataType) -> bool:
    """Return whether items of a list can be read as another type; structs may have more fields."""
    if not pa.types.is_struct(expected):
        return is_like(found, expected)
    names = [field.name for field in found] if pa.types.is_struct(found) else []
    return all(names.count(field.name) == 1 and is_like(found.field(field.name).type, field.type) for field in expected)
