# SPDX-License-Identifier: Apache-2.0
"""Tasks on disk: `queries.parquet` and `task.json` for everyone, `truth.parquet` for the scorer alone."""

import datetime as dt
import difflib
import hashlib
import json
from collections import Counter
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field
from functools import cached_property
from itertools import accumulate, chain, islice, pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Final, Self, TypeVar

import numpy as np
import pyarrow as pa
import shapely
from pydantic import ConfigDict, Field, JsonValue

from sasgeo_bench.core.config import Document, check_document
from sasgeo_bench.core.errors import ConfigError, StoreError
from sasgeo_bench.core.folders import FileRecord, file_record, sha256_of
from sasgeo_bench.core.json import read_json
from sasgeo_bench.core.parquet import open_table, read_schema, read_table, table_writer
from sasgeo_bench.core.paths import given_path
from sasgeo_bench.core.texts import FOLDER, json_text
from sasgeo_bench.geometry.pose import Pose, Prior
from sasgeo_bench.regions.evidence import CELLS_PER_BYTE, Evidence, pack, unpack
from sasgeo_bench.regions.region import ATTRIBUTION, LICENCE, Manifest, Provenance
from sasgeo_bench.regions.region_files import read_manifest
from sasgeo_bench.tasks.frame_files import FRAME, LABEL_SCHEMA, LABELS, frame_of, frame_row, label_row
from sasgeo_bench.tasks.query import PUBLISHED, TASK_VERSION, TASK_VERSIONS, Head, Query, Step, Truth

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


def query_row(query: Query) -> dict[str, object]:
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


def _step_row(step: Step | None) -> dict[str, object]:
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


def _vector_rows(vectors: "gpd.GeoDataFrame") -> list[dict[str, object]]:
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
        step=None
        if row.get("sequence_id") is None
        else Step(
            sequence_id=row["sequence_id"],
            frame=row["frame"],
            increment=None if row["increment"] is None else tuple(row["increment"]),
            covariance=None if row["increment_covariance"] is None else tuple(row["increment_covariance"]),
        ),
    )


def _vectors_of(rows: Sequence[Mapping[str, object]]) -> "gpd.GeoDataFrame":
    import geopandas as gpd  # noqa: PLC0415 - only tables of geometry need it

    return gpd.GeoDataFrame(
        {
            "class": np.array([row["class"] for row in rows], dtype=object),
            "level": np.array([row["level"] for row in rows], dtype=np.int16),
            "is_bridge": np.array([row["is_bridge"] for row in rows], dtype=bool),
        },
        geometry=gpd.GeoSeries(shapely.from_wkb([row["wkb"] for row in rows]), dtype="geometry"),
    )


def asked_sha256(row: Mapping[str, object], map_hashes: Mapping[str, str]) -> str:
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


def truth_row(truth: Truth) -> dict[str, object]:
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


def dependency_key(learned: str | None, *others: str | None) -> str | None:
    """Return the key of what decides an answer besides the question: what was learned, and hashes of other things.

    Others are rendered imagery that was looked at, and how flights are followed.

    >>> dependency_key("ab", None), len(dependency_key(None, "cd"))
    ('ab', 64)
    """
    key = learned
    for other in others:
        key = key if other is None else hashlib.sha256(f"{key} {other}".encode()).hexdigest()
    return key


def answer_hash(asked: str, key: str | None) -> str:
    """Return the hash that an answer carries: that of the question and of what else decides it (`dependency_key`).

    Examples
    --------
    >>> answer_hash("ab", None), len(answer_hash("ab", "cd"))
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


Row = TypeVar("Row")
Made = TypeVar("Made")
Count = Annotated[int, Field(ge=0)]
Folder = Annotated[str, Field(pattern=FOLDER)]  # never a path that leaves its root

QUERIES: Final = "queries.parquet"
TASK: Final = "task.json"
TRUTH: Final = "truth.parquet"
TRUTH_OF: Final = "truth.json"
PRIVATE: Final = "private_seed"  # in task.json and truth.json: commitment and bits, where the seed is private
SCHEMA_VERSION: Final = 1
_MEND: Final = "make the queries again"
_MAKE: Final = "make the queries first (make-queries, import-flight; of your own pictures import-photos, import-masks)"
_ROWS: Final = 128  # of a row group, which is in memory at once


class TaskFiles(Document):
    """Files of a task, of which there is one."""

    queries: Annotated[FileRecord, Field(alias=QUERIES)]


class TaskOrigin(Document):
    """How the queries of a task were drawn: what `task.json` holds besides their counts and hashes.

    Keys that a file lacks stay unset, so that a copy of the task lacks them, too.
    """

    without_empty: ClassVar = frozenset({"provenance"})

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
    map_inputs_sha256: str | None = None  # older programs recorded less of the map
    split: str | None = None
    split_sha256: str | None = None
    sites: Count | None = None
    views_cells: list[Count] | None = None
    epsg: int | None = None
    made_by: str | None = None
    private_seed: dict[str, str | int] | None = None  # its commitment and bits
    sealed_seed: dict[str, str | int] | None = None  # the same
    licence: str | None = None
    attribution: str | None = None
    picture_attribution: str | None = None  # of all imagery that real pictures are cut out of
    segmenter: dict[str, str] | None = None  # what made the evidence of the pictures: name, version, hash
    odometry: str | None = None  # of a flight that was flown: of its log, or drawn, and why
    gnss: str | None = None  # of priors by a weak receiver: of a log, or drawn, and why
    failed_pictures: Count | None = None  # that the segmenter failed at
    provenance: Provenance = Provenance()  # of the map

    @property
    def name(self) -> tuple[str, str]:
        """Suite and region, by which a task is known."""
        return self.suite, self.region

    @property
    def credit(self) -> str:
        """Return whom to name beside what is made of the map: all that it was made of."""
        return self.attribution or self.provenance.credit

    @property
    def map_hashes(self) -> dict[str, str]:
        """Hashes of the contents and the inputs of the searched map, as far as they are recorded."""
        found = {"map_fingerprint": self.map_fingerprint, "map_inputs_sha256": self.map_inputs_sha256}
        return {name: value for name, value in found.items() if value is not None}

    def is_of_map(self, manifest: Manifest) -> bool:
        """Return whether a task belongs to this very build of a map."""
        of_map = {"map_fingerprint": manifest.fingerprint, "map_inputs_sha256": manifest.inputs_sha256}
        return self.map_hashes.items() <= of_map.items()


class TaskManifest(TaskOrigin):
    """Contents of `task.json`; an unknown key is an error, since a later schema has another version."""

    schema_version: int
    task_version: int
    counts: dict[str, Count]
    prior_groups: list[str] | None = None
    candidates_sha256: str | None = None
    frames: Count | None = None  # pictures of all queries
    files: TaskFiles

    @property
    def queries_sha256(self) -> str:
        """Hash of `queries.parquet`."""
        return self.files.queries.sha256

    @property
    def queries(self) -> int:
        """Number of queries."""
        return sum(self.counts.values())

    @property
    def is_of_flights(self) -> bool:
        """Whether the queries are views of flights."""
        return "sequence" in self.counts

    @property
    def origin(self) -> TaskOrigin:
        """What is not of the queries' file, for a task made of this one."""
        known = self.model_fields_set & TaskOrigin.model_fields.keys()
        return TaskOrigin(**{name: value for name, value in self if name in known})

    def to_json(self) -> dict[str, JsonValue]:
        """Return the contents of `task.json`."""
        return self.model_dump(mode="json", by_alias=True, exclude_unset=True)


class TruthManifest(Document):
    """Contents of `truth.json`: which queries the truths are of, and what they could be drawn by again."""

    model_config = ConfigDict(frozen=True, extra="allow", strict=True)

    queries_sha256: str = "unknown"
    seed: int | None = None
    private_seed: dict[str, str | int] | None = None
    sealed_seed: dict[str, str | int] | None = None
    count: int | None = None
    maps: int | None = None
    request_sha256: str | None = None
    profile: JsonValue = None

    @classmethod
    def read(cls, truth_folder: Path) -> Self:
        """Read `truth.json`; of one that cannot be read nothing is known."""
        try:
            return check_document(read_json(truth_folder / TRUTH_OF, mend=_MEND), cls, source=TRUTH_OF)
        except (StoreError, ConfigError):
            return cls()


@dataclass(frozen=True)
class Task:
    """A task on disk: its folder, what `task.json` says, the folder of its truths, and the root of its map.

    Truths and map may be missing. Queries and truths are read when they are asked for.

    Examples
    --------
    >>> task = Task.open("out/tasks/clean/town-grid")  # doctest: +SKIP
    >>> task.manifest.title, task.manifest.queries, len(list(task.queries()))  # doctest: +SKIP
    ('Clean views', 24, 24)
    """

    folder: Path
    manifest: TaskManifest = field(hash=False)
    truth: Path
    root: Path

    @classmethod
    def open(cls, folder: str | Path, root: Path | None = None, *, truth: Path | None = None) -> Self:
        """Read `task.json`.

        Parameters
        ----------
        folder : str or Path
            Folder of the task, as `out/tasks/<suite>/<region>`.
        root : Path, optional
            Folder of output with its map and truths, by default the one that holds the task.
        truth : Path, optional
            Root of truths, by default `root / "truth"`.

        Raises
        ------
        StoreError
            If `task.json` is missing, damaged or of another version.
        """
        path = given_path(folder)
        manifest = _read_manifest(path, named=folder)
        root = path.resolve().parent.parent.parent if root is None else root
        truths = root / "truth" if truth is None else truth
        return cls(path, manifest, truths / manifest.suite / manifest.region, root)

    @classmethod
    def of(cls, manifest: TaskManifest, root: Path, *, truth: Path | None = None) -> Self:
        """Return the task of a manifest where it was written below a root; nothing is read."""
        truths = root / "truth" if truth is None else truth
        below = Path(manifest.suite, manifest.region)
        return cls(root / "tasks" / below, manifest, truths / below, root)

    def __reduce__(self) -> tuple[type[Self], tuple[Path, TaskManifest, Path, Path]]:
        return type(self), (self.folder, self.manifest, self.truth, self.root)

    @property
    def region(self) -> Path:
        """The folder of the map, which may be missing or built anew since."""
        return self.root / "regions" / self.manifest.region

    def checked_region(self) -> Path:
        """Return the folder of the map; raise a StoreError if it is missing or was built anew since."""
        if not self.manifest.is_of_map(read_manifest(self.region)):
            raise StoreError(
                f"{self.region} was built anew since the queries of {self.folder} were made: make them again"
            )
        return self.region

    @property
    def has_truths(self) -> bool:
        """Whether its truths are there."""
        return (self.truth / TRUTH).is_file()

    @cached_property
    def asked(self) -> Mapping[str, str]:
        """By query id the hash of the query and of its map, which its answer has to carry."""
        path = self.folder / QUERIES
        is_recorded = ASKED in read_schema(path, mend=_MEND).names
        columns = ["query_id", ASKED] if is_recorded else QUERY_SCHEMA.names
        rows = (row for batch in read_batches(path, columns) for row in batch.to_pylist())
        return {row["query_id"]: self._asked_of(row) for row in rows}

    def _asked_of(self, row: Mapping[str, object]) -> str:
        recorded = row.get(ASKED)
        return asked_sha256(row, self.manifest.map_hashes) if recorded is None else str(recorded)

    def ids(self) -> list[str]:
        """Read the ids of the queries, in their order."""
        batches = read_batches(self.folder / QUERIES, ["query_id"])
        return [str(name) for batch in batches for name in batch["query_id"].to_pylist()]

    def queries(self) -> Iterator[Query]:
        """Yield the queries in the order of their ids, a row group in memory at a time."""
        return read_queries(self.folder)

    def some(self, ids: Collection[str]) -> Iterator[tuple[Query, bytes, str]]:
        """Yield queries of some ids, each with its bytes for a matcher's process and its hash, by row groups."""
        path = self.folder / QUERIES
        with open_table(path, mend=_MEND, is_whole=False) as source:
            for batch in source.iter_batches(batch_size=_ROWS):
                sent = batch.select([name for name in batch.schema.names if name != ASKED])
                for at, name in enumerate(batch["query_id"].to_pylist()):
                    if name in ids:
                        row = batch.slice(at, 1).to_pylist()[0]
                        yield _made(path, query_of, row), stream_of(sent.slice(at, 1)), self._asked_of(row)

    def heads(self) -> Iterator[Head]:
        """Yield the queries without their views, in the order of their ids."""
        path = self.folder / QUERIES
        for batch in read_batches(path, HEAD_SCHEMA.names):
            rows = batch.drop_columns(["candidates"]).to_pylist()
            for row, poses in zip(rows, _made(path, poses_of, batch["candidates"]), strict=True):
                way = row.pop("increment")
                yield Head(
                    view_cells=row.pop("rows"), candidates=poses, increment=None if way is None else tuple(way), **row
                )

    def parts(self) -> set[str]:
        """Read which parts of a split the queries belong to."""
        batches = read_batches(self.folder / QUERIES, ["part"])
        return {str(part) for batch in batches for part in batch["part"].unique().to_pylist()}

    def view_bytes(self) -> dict[str, int]:
        """Return the bytes of each query's view as it travels: packed cells, confidences and vectors, uncompressed.

        The size of packed cells follows from their shape, so that no view is read. Stored results record the bytes.
        """
        import pyarrow.compute as pc  # noqa: PLC0415 - slow, and no process of a matcher needs it

        path = self.folder / QUERIES
        if VIEW_BYTES in read_schema(path, mend=_MEND).names:
            table = read_table(path, mend=_MEND, columns=["query_id", VIEW_BYTES])
            return dict(zip(*(column.to_pylist() for column in table.columns), strict=True))
        found: dict[str, int] = {}
        for batch in read_batches(path, ["query_id", "rows", "cols", "classes", "confidence", "vectors"]):
            shape = (batch["rows"], batch["cols"], pc.list_value_length(batch["classes"]))
            cells = np.prod([np.asarray(side, dtype=np.int64) for side in shape], axis=0)
            confidence = np.asarray(pc.fill_null(pc.binary_length(batch["confidence"]), 0))
            vectors = batch["vectors"]
            ends = np.concatenate(([0], np.cumsum(np.asarray(pc.binary_length(vectors.values.field("wkb"))))))
            offsets = np.asarray(vectors.offsets)
            total = -(-cells // CELLS_PER_BYTE) + confidence + ends[offsets[1:]] - ends[offsets[:-1]]
            found |= dict(zip(batch["query_id"].to_pylist(), total.tolist(), strict=True))
        return found

    @cached_property
    def truths(self) -> tuple[Truth, ...]:
        """The truths in the order of the query ids; `read_truths` yields them one at a time."""
        return tuple(read_truths(self.truth))

    def check_queries(self) -> None:
        """Raise a StoreError if the queries are missing or not those of `task.json`."""
        path = self.folder / QUERIES
        if not path.is_file() or sha256_of(path) != self.manifest.queries_sha256:
            raise StoreError(f"{path} is not what {TASK} says: make the queries again")

    def check_truths(self) -> None:
        """Raise a StoreError if truths are missing, belong to other queries, or have another task version."""
        if not self.has_truths:
            raise StoreError(
                f"{self.truth} holds no truths of {self.folder}: "
                "name their folder with --truth, or make the queries again"
            )
        if (self.truth / TRUTH_OF).is_file():
            read_json(self.truth / TRUTH_OF, mend=_MEND)  # a damaged file raises here
        if TruthManifest.read(self.truth).queries_sha256 != self.manifest.queries_sha256:
            raise StoreError(
                f"{self.truth} holds the truths of other queries than {self.folder}: make the queries again"
            )
        metadata = read_schema(self.truth / TRUTH, mend=_MEND).metadata or {}
        version = metadata.get(b"task_version", b"none").decode(errors="replace")
        if version not in map(str, TASK_VERSIONS):
            raise StoreError(
                f"{self.truth} holds truths of task version {version}, this version reads "
                f"{', '.join(map(str, TASK_VERSIONS))}: make the queries again"
            )

    def faults(self) -> list[str]:
        """Check the files against `task.json` and the truths, if there are any; return a line for each fault.

        Each line begins with the path of the file and ends with what to do about it. Raise a StoreError if a file
        cannot be read.
        """
        faults = []
        path, recorded = self.folder / QUERIES, self.manifest.files.queries
        if not path.is_file():
            return [f"{path}: missing: {_MEND}"]
        known = {self.folder / TASK, path}
        others = [other for other in sorted(self.folder.rglob("*")) if other not in known]
        faults += [f"{other}: not part of a task: move it away" for other in others]
        found = file_record(path)
        if (found.sha256, found.bytes) != (recorded.sha256, recorded.bytes):  # its contents need no check
            was = f"{recorded.bytes} bytes, {recorded.sha256}"
            return [f"{path}: {found.bytes} bytes, SHA-256 {found.sha256}; {TASK} says {was}: {_MEND}", *faults]
        asked = [(query.query_id, query.track) for query in self.queries()]
        names, counts = [name for name, _ in asked], dict(Counter(track for _, track in asked))
        if counts != self.manifest.counts:
            was = _counts_text(self.manifest.counts)
            faults.append(f"{path}: holds {_counts_text(counts)}, {TASK} says {was}: {_MEND}")
        if self.has_truths:
            belongs = TruthManifest.read(self.truth).queries_sha256
            if belongs != found.sha256:
                faults.append(f"{self.truth / TRUTH_OF}: the truths are of other queries, SHA-256 {belongs}: {_MEND}")
            answered = [truth.query_id for truth in read_truths(self.truth)]
            if answered != names:
                not_those = f"{len(answered)} truths that are not those of the {len(names)} queries, in order"
                faults.append(f"{self.truth / TRUTH}: {not_those}: {_MEND}")
        return faults


def write_task(
    task_folder: Path,
    truth_folder: Path,
    pairs: Iterable[tuple[Query, Truth]],
    origin: TaskOrigin,
    hidden: TruthManifest | None = None,
) -> TaskManifest:
    """Write queries and truths into two empty folders, by row groups, then `task.json`, which completes the task.

    `pairs` are in the order of the query ids, which reveals nothing about the answers. `origin` and `hidden` are the
    contents of `task.json` and `truth.json` besides counts and hashes. Return what `task.json` says now.
    """
    counts: Counter[str] = Counter()
    groups: set[str] = set()
    frozen = hashlib.sha256()
    frames = 0
    labels: Any = None  # a writer, opened at the first picture
    terms = {"licence": origin.licence or LICENCE, "attribution": origin.credit}
    with ExitStack() as stack:
        queries, truths = (
            stack.enter_context(table_writer(path, schema.with_metadata(_META | terms), compression_level=9))
            for path, schema in ((task_folder / QUERIES, FILE_SCHEMA), (truth_folder / TRUTH, TRUTH_SCHEMA))
        )
        for part in _batches(pairs):
            rows = pa.Table.from_pylist([query_row(query) for query, _ in part], schema=QUERY_SCHEMA)
            asked = [asked_sha256(row, origin.map_hashes) for row in rows.to_pylist()]
            queries.write_table(rows.append_column(FILE_SCHEMA.field(ASKED), pa.array(asked)))
            truths.write_table(pa.Table.from_pylist([truth_row(truth) for _, truth in part], schema=TRUTH_SCHEMA))
            # Labels of all frames of some queries as rows
            of_frames = [
                label_row(truth.query_id, number, item) for _, truth in part for number, item in enumerate(truth.labels)
            ]
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
        **origin.model_dump(mode="json", exclude_unset=True, exclude={*terms}),
        "counts": dict(counts),
        "prior_groups": sorted(groups),
        "candidates_sha256": frozen.hexdigest(),
        **({"frames": frames} if frames else {}),
        "files": {QUERIES: record.model_dump()},
        **terms,
    }
    more = {} if hidden is None else hidden.model_dump(mode="json", exclude_unset=True, exclude={"queries_sha256"})
    _write_json(truth_folder / TRUTH_OF, {"queries_sha256": record.sha256, **more})
    _write_json(task_folder / TASK, content)
    return TaskManifest.model_validate(content)


def _write_json(path: Path, content: Mapping[str, object]) -> None:
    path.write_text(json_text(content), encoding="utf-8")


def _candidate_bytes(query: Query) -> bytes:
    rows = [(pose.easting_m, pose.northing_m, pose.yaw_deg, pose.scale) for pose in query.candidates]
    return np.array(rows, dtype="<f8").tobytes()


def _batches(pairs: Iterable[tuple[Query, Truth]]) -> Iterator[Sequence[tuple[Query, Truth]]]:
    left = iter(pairs)
    first = next(left, None)
    if first is None:
        return
    rows = 8 if first[0].frames else _ROWS  # 8: the same where labels of pictures are in memory, too
    whole = chain([first], left)
    while batch := list(islice(whole, rows)):
        yield batch


def read_task(folder: str | Path) -> dict[str, JsonValue]:
    """Read `task.json` as it stands there; raise as `Task.open` does, which gives more."""
    return Task.open(folder).manifest.to_json()


def _no_task(folder: Path, named: str | Path) -> str:
    """Return what is wrong with a folder that is no task, and the task that was meant, if one is near."""
    if folder.is_dir():
        inside = next(iter(sorted(folder.glob(f"*/{TASK}"))), None)
        mend = f"{_MAKE}" if inside is None else f"name a task in it, as {inside.parent}, or all by a *"
        return f"{named} holds no {TASK}: {mend}"
    above = next(parent for parent in folder.parents if parent.is_dir())
    tasks = {
        "/".join(path.parts[-3:-1]): path.parent
        for root in (above, Path("out", "tasks"))
        for depth in ("*", "*/*")
        for path in sorted(root.glob(f"{depth}/{TASK}"))
    }
    near = difflib.get_close_matches("/".join(folder.parts[-2:]), tasks, n=1, cutoff=0.8)
    return f"there is no folder {named}: " + (
        f"did you mean {tasks[near[0]]}?" if near else f"{_MAKE}, or check the path"
    )


def _read_manifest(folder: Path, *, named: str | Path) -> TaskManifest:
    path = folder / TASK
    if not path.is_file():
        raise StoreError(_no_task(folder, named))
    content = read_json(path, mend=_MEND)
    about = content if isinstance(content, dict) else {}
    for name, known in (("schema_version", (SCHEMA_VERSION,)), ("task_version", TASK_VERSIONS)):
        if name in about and about[name] not in known:
            noun, versions = name.replace("_", " "), ", ".join(map(str, known))
            raise StoreError(f"{path} has {noun} {about[name]!r}, this version reads {versions}: {_MEND}")
    try:
        return check_document(content, TaskManifest, source=TASK)
    except ConfigError as error:
        raise _damaged(path, error) from error


def _damaged(path: Path, fault: object) -> StoreError:
    return StoreError(f"{path} is damaged ({str(fault)[:200]}): {_MEND}")


def check_ours(folder: Path, names: Sequence[str]) -> None:
    """Raise a StoreError if a folder to replace holds foreign files."""
    if folder.exists() and not folder.is_dir():
        raise StoreError(f"{folder} is a file: move it away, a task goes there")
    other = next((path for path in sorted(folder.glob("*")) if path.name not in names), None)
    if other is not None:
        raise StoreError(f"{other} is no part of a task and would be lost: move it away")


def _counts_text(counts: Mapping[Any, int]) -> str:
    return ", ".join(f"{count} of {track}" for track, count in sorted(counts.items()))


def read_queries(folder: str | Path) -> Iterator[Query]:
    """Yield the queries of a task in the order of their ids, a row group in memory at a time."""
    yield from _parsed(given_path(folder) / QUERIES, QUERY_SCHEMA, query_of)


def read_truths(folder: str | Path) -> Iterator[Truth]:
    """Yield the truths of a task in the order of the query ids."""
    yield from _parsed(given_path(folder) / TRUTH, TRUTH_SCHEMA, truth_of)


def read_batches(path: Path, columns: Sequence[str]) -> Iterator[pa.RecordBatch]:
    """Yield some columns of queries or truths, a row group in memory at a time.

    Raises
    ------
    StoreError
        If the file is missing or damaged, or lacks a column; older files may lack those of `ADDED`.
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
    schemas = (FILE_SCHEMA, TRUTH_SCHEMA, PLAIN_TRUTH_SCHEMA)
    types = [schema.field(field.name).type for schema in schemas if field.name in schema.names]
    return not types or any(is_like(field.type, kind) for kind in types)


def _parsed(path: Path, schema: pa.Schema, parse: Callable[[dict[str, object]], Made]) -> Iterator[Made]:
    for batch in read_batches(path, schema.names):
        for row in batch.to_pylist():
            yield _made(path, parse, row)


def _made(path: Path, make: Callable[[Row], Made], row: Row) -> Made:
    """Convert a row, which may be malformed."""
    try:
        return make(row)
    except (TypeError, ValueError, KeyError, AttributeError, OverflowError, shapely.errors.ShapelyError) as error:
        raise _damaged(path, error) from error
