# SPDX-License-Identifier: Apache-2.0
"""Manifests of a board: models of `board.json`, `pack.json` and `pictures.json`, as they are read and written."""

from collections.abc import Mapping
from typing import Annotated, ClassVar, Final, Literal, TypeVar

from pydantic import BaseModel, BeforeValidator, ConfigDict, Field, PlainSerializer, ValidationError

from sasgeo_bench.core.config import Record
from sasgeo_bench.core.json import parse_json
from sasgeo_bench.core.texts import FOLDER, one_line
from sasgeo_bench.matching.cards import Learned
from sasgeo_bench.regions.region import ATTRIBUTION, LICENCE, Provenance, credit_of
from sasgeo_bench.running.prediction_files import CardRecord
from sasgeo_bench.scoring.compare import LEAST_BLOCKS
from sasgeo_bench.scoring.contrasts import Contrast
from sasgeo_bench.tasks.private_seed import SealedPlace

Model = TypeVar("Model", bound=BaseModel)
Plain = Annotated[str, Field(pattern=FOLDER)]  # of what may become a folder
Sha256 = Annotated[str, Field(pattern=r"^[0-9a-f]{64}$")]
_MOST_DRAWS: Final = 1_000_000


class PipelineRecord(Record):
    """The pipeline of a board."""

    model_config = ConfigDict(extra="forbid")

    id: Plain
    sha256: str


class VersionRecord(Record):
    """The schema version of a file; other fields are read once the schema is known."""

    schema_version: int


class PackManifest(Record):
    """All of `pack.json`: how the results were scored, and the hash of every file.

    >>> "files" in PackManifest.model_fields
    True
    """

    model_config = ConfigDict(extra="forbid")
    without_empty: ClassVar = frozenset({"within", "require"})

    schema_version: Literal[1, 2, 3]
    split: Plain | None
    rejectors: list[str]
    contrasts: list[Contrast]
    draws: Annotated[int, Field(ge=1, le=_MOST_DRAWS)]
    by_region: list[str]
    by_block: list[str] = []
    pipeline: Annotated[  # an empty object where there was none
        PipelineRecord | None,
        BeforeValidator(lambda value: None if value == {} else value),
        PlainSerializer(lambda value: {} if value is None else value.model_dump()),
    ]
    within: list[str] = []  # limits and requirements of whoever scored it
    require: list[str] = []
    contestants: list[str]
    dropped: str
    files: dict[str, Sha256] | None = None  # of the first version there are none
    licence: str = LICENCE
    attribution: str = ATTRIBUTION


class SeedRecord(Record):
    """A private seed: what tells that two boards are of the same one, and how many bits it has."""

    commitment: Sha256
    bits: Annotated[int, Field(ge=1)]


class SeedFigure(Record):
    """One figure of one matcher on both seeds, and what it tells.

    Parameters
    ----------
    suite, track, prior_group, metric : str
        Of which queries, and of what: success or recall under stress, or false fixes at absent places.
    public, private : float
        The figure on each seed.
    difference, lo, hi : float
        Private less public; all intervals of a matcher hold at once (95 %, Bonferroni).
    n_public, n_private : int
        Queries.
    blocks_public, blocks_private, blocks_shared : int
        Blocks of ground that they come from, and that hold queries of both.
    is_worse : bool
        Whether the private figure is shown to be worse.
    """

    suite: str
    track: str
    prior_group: str
    metric: str
    public: float
    private: float
    difference: float
    lo: float
    hi: float
    n_public: int
    n_private: int
    blocks_public: int
    blocks_private: int
    blocks_shared: int
    is_worse: bool

    @property
    def is_decided(self) -> bool:
        """Return whether there are enough blocks to decide."""
        return min(self.blocks_public, self.blocks_private) >= LEAST_BLOCKS

    def to_text(self) -> str:
        """Both figures and their difference in a line."""
        return (
            f"{self.suite}, {self.track}, {self.metric}: private {self.private:.3f} against public {self.public:.3f}, "
            f"difference {self.difference:.3f} [{self.lo:.3f}, {self.hi:.3f}]"
        )


SeedVerdict = Literal["run here", "reproduced", "not reproduced"]


class SeedResult(Record):
    """How the answers of an entry fared on a private seed, and why."""

    verdict: SeedVerdict
    why: str
    figures: list[SeedFigure]


class BoardEntry(Record):
    """An entry of a board: whose answers, how they came, and what keeps it out of the ranks."""

    without_empty: ClassVar = frozenset({"private", "failed_controls"})

    name: str
    version: str | None = None
    hash: str | None = None
    how: str | None = None
    card: CardRecord | None = None
    trained_on: list[str] | None = None
    set_apart: str | None = None
    isolation: dict[str, str] | None = None
    learned: list[Learned] = []
    private: SeedResult | None = None
    failed_controls: list[str] = []


class BoardTask(Record):
    """A task that a board asked."""

    without_empty: ClassVar = frozenset({"failed_pictures", "provenance"})

    region: str
    suite: str
    suite_version: int | None = None
    map_date: str | None = None
    queries_sha256: str | None = None
    map_fingerprint: str | None = None
    failed_pictures: int | None = None
    provenance: Provenance = Provenance()  # of the map


class ElsewhereRow(Record):
    """The row of a matcher on another board."""

    matcher: str
    n: Annotated[int, Field(ge=1)]
    value: float
    lo: float
    hi: float


class Elsewhere(Record):
    """Rows of another board that asked the same queries of a suite, track and prior group."""

    board: Plain
    suite: str
    track: str
    prior_group: str
    metric: str
    rows: Annotated[list[ElsewhereRow], Field(min_length=1)]


class RejectorRecord(Record):
    """The card of a rejector, as far as boards show it."""

    name: str | None = None
    version: str | None = None
    title: str | None = None
    source: str | None = None
    licence: str | None = None
    is_calibrated: bool | None = None


class MetricRecord(Record):
    """A metric of another package: what tables show of it, and its `code`, as module:NAME, with its SHA-256.

    A bound that is missing is infinite.
    """

    name: str
    code: str
    sha256: Sha256
    meaning: str
    source: str
    unit: str
    better: Literal["higher", "lower"]
    least: float | None = None
    greatest: float | None = None
    tracks: list[str]

    def to_text(self) -> str:
        """Return in a line what it says, of what, and whose it is."""
        least, greatest = ("any" if end is None else f"{end:g}" for end in (self.least, self.greatest))
        unit = "" if self.unit == "1" else f" {self.unit}"
        whose = f"a metric of {self.code} ({self.sha256[:12]}), not of sasgeo-bench"
        text = f"{self.meaning.removesuffix('.')}. {self.better.capitalize()} is better, {least} to {greatest}{unit}"
        return f"{text}; {whose}"


class BoardManifest(Record):
    """All of `board.json`; every board has the fields without a default.

    >>> BoardManifest(scorer_version=4, entries=[], tasks=[]).remarks
    []
    """

    without_empty: ClassVar = frozenset(
        {"title", "private_seed", "private", "sealed", "metrics", "within", "require", "added", "elsewhere", "failed"}
    )

    scorer_version: int
    entries: list[BoardEntry]
    tasks: list[BoardTask]
    task_version: int | None = None
    data_version: int | None = None
    made_by: str | None = None
    libraries: dict[str, str] = {}
    pipeline: PipelineRecord | None = None
    title: str | None = None  # of the pipeline
    private_seed: SeedRecord | None = None  # that drew the queries
    private: SeedRecord | None = None  # that the rows were held against
    sealed: dict[str, SealedPlace] = {}
    split: str | None = None
    draws: int | None = None
    contrasts: list[Contrast] | None = None
    by_region: list[str] = []
    by_block: list[str] = []
    without: list[str] = []
    rejectors: list[RejectorRecord] = []
    metrics: list[MetricRecord] = []
    within: list[str] = []  # limits and requirements, as they were stated
    require: list[str] = []
    added: list[str] = []  # entries that the pipeline does not name
    remarks: list[str] = []
    elsewhere: list[Elsewhere] = []
    failed: dict[str, str] = {}
    licence: str | None = None
    attribution: str | None = None

    @property
    def further_sources(self) -> tuple[str, ...]:
        """Return the sources of its maps beside OpenStreetMap, each once."""
        return tuple(dict.fromkeys(filter(None, (task.provenance.further_sources for task in self.tasks))))

    @property
    def credit(self) -> str:
        """Return whom to name beside what is made of its maps."""
        return credit_of(task.provenance for task in self.tasks)


class Picture(Record):
    """A picture of a region, a suite or a flight: its file in `pictures/`, and what it shows."""

    file: str
    alt: str = ""
    region: str = ""
    suite: str = ""


_Metres = Annotated[float, Field(ge=-1e8, le=1e8)]
_Bounds = Annotated[list[_Metres], Field(min_length=4, max_length=4)]  # west, south, east, north


class MapBlock(Record):
    """A block of a map, and its edges in metres."""

    name: str
    bounds_m: _Bounds


class RegionMap(Picture):
    """A map that fills its picture: its edges and those of its blocks, metres."""

    bounds_m: _Bounds | None = None
    blocks: list[MapBlock] = []


class PictureStrip(Picture):
    """Some queries of a matcher from picture to pose."""

    matcher: str = ""


_OF_REJECTOR: Final = {"p_false_": "P(false)", "order_": "order"}
_VERDICT: Final = "accepted_"
_LEFT_OUT: Final = (_VERDICT, "reported_hpl_")


class FailedCase(PictureStrip):
    """One query that a matcher failed on, with facts about it by name."""

    query_id: str = ""
    failure: str = ""
    kind: str = ""
    facts: Mapping[str, str | float | int | bool | None] | None = None

    def lines(self) -> dict[str, str]:
        """Return the facts of a case for a page: a line for each rejector, without protection levels.

        >>> facts = {"error_m": 9, "p_false_own": 0.9, "accepted_own": "no", "reported_hpl_gauss_0.01_m": 4}
        >>> FailedCase(query_id="q", matcher="m", failure="aged", file="a.webp", facts=facts).lines()
        {'error_m': '9', 'own': 'P(false) 0.9, withheld'}
        """
        found: dict[str, str] = {}
        facts = self.facts or {}
        for name, value in facts.items():
            kind = next((kind for kind in _OF_REJECTOR if name.startswith(kind)), "")
            if kind:
                rejector = name.removeprefix(kind)
                verdict = {"yes": ", accepted", "no": ", withheld"}.get(str(facts.get(f"{_VERDICT}{rejector}")), "")
                found[rejector] = f"{_OF_REJECTOR[kind]} {value}{verdict}"
            elif not name.startswith(_LEFT_OUT):
                found[name] = str(value)
        return found


class PicturesManifest(Record):
    """All of `pictures.json`; empty where a board has no pictures.

    >>> PicturesManifest().cases
    []
    """

    regions: list[RegionMap] = []
    suites: list[Picture] = []
    strips: list[PictureStrip] = []
    flights: list[Picture] = []
    cases: list[FailedCase] = []

    @property
    def files(self) -> list[str]:
        """Return the files of all pictures."""
        kinds = (self.regions, self.suites, self.strips, self.flights, self.cases)
        return [item.file for listed in kinds for item in listed]


def parse_record(data: bytes | str, model: type[Model]) -> Model:
    """Parse JSON from an untrusted source.

    Raise ValueError naming the first fault in a line: no JSON, nested without end, or a value of another type.

    >>> parse_record('{"scorer_version": 4, "entries": 5}', BoardManifest)
    Traceback (most recent call last):
        ...
    ValueError: entries is 5: Input should be a valid list
    """
    try:
        return model.model_validate(parse_json(data))
    except ValidationError as error:
        first = error.errors(include_url=False)[0]
        where = ".".join(map(str, first["loc"]))
        found = "" if not where or first["type"] == "missing" else f" is {first['input']!r}"[:80]
        fault = "Input should be an object" if first["type"] in {"model_type", "dataclass_type"} else first["msg"]
        raise ValueError(one_line(f"{where}{found}: {fault}" if where else fault)) from error
