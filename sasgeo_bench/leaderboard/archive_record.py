# SPDX-License-Identifier: Apache-2.0
"""What `pack.json`, `board.json` and `pictures.json` may say, held by type before anything is made of them."""

from typing import Annotated, Any, Final, Literal, TypeVar

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from sasgeo_bench.files.json import parse_json
from sasgeo_bench.regions.region import ATTRIBUTION, LICENCE
from sasgeo_bench.running.run_manifest import CardRecord
from sasgeo_bench.scoring.verdicts import ContrastMetric
from sasgeo_bench.tasks.query import Detector, Track
from sasgeo_bench.texts import FOLDER, one_line

Model = TypeVar("Model", bound=BaseModel)
Plain = Annotated[str, Field(pattern=FOLDER)]  # of what may become a folder
Sha256 = Annotated[str, Field(pattern=r"^[0-9a-f]{64}$")]
_MOST_DRAWS: Final = 1_000_000


class _Record(BaseModel):
    """No silent conversion; what a later version says besides is kept."""

    model_config = ConfigDict(frozen=True, extra="allow", strict=True, allow_inf_nan=False)


class ContrastRecord(_Record):
    """A registered contrast; see `scoring.contrasts.Contrast`."""

    model_config = ConfigDict(extra="forbid")

    name: str
    first: str
    second: str
    suites: list[str]
    kinds: list[str] = []
    detectors: list[Detector] = []
    metric: ContrastMetric = "primary"
    track: Track = "localization"
    min_effect: Annotated[float, Field(ge=0, le=1)] = 0.03


class PipelineRecord(_Record):
    """The pipeline of a board."""

    model_config = ConfigDict(extra="forbid")

    id: Plain
    sha256: str


class VersionRecord(_Record):
    """The schema version of a file; other fields are read once the schema is known."""

    schema_version: int


class ArchiveRecord(_Record):
    """All of `pack.json`: how the results were scored, and the hash of every file.

    >>> "files" in ArchiveRecord.model_fields
    True
    """

    model_config = ConfigDict(extra="forbid")

    schema_version: Literal[1, 2, 3]
    split: Plain | None
    rejectors: list[str]
    contrasts: list[ContrastRecord]
    draws: Annotated[int, Field(ge=1, le=_MOST_DRAWS)]
    by_region: list[str]
    by_block: list[str] = []
    pipeline: PipelineRecord | Annotated[dict[str, Any], Field(max_length=0)]  # empty where there was none
    contestants: list[str]
    dropped: str
    files: dict[str, Sha256] | None = None  # of the first version there are none
    licence: str = LICENCE
    attribution: str = ATTRIBUTION


class _Learned(_Record):
    file: str | None
    trained_on: list[str]
    pairs: int
    asked: list[str]


class PrivateRecord(_Record):
    """A private seed: what tells that two boards are of the same one, and how many bits it has."""

    commitment: Sha256
    bits: Annotated[int, Field(ge=1)]


class SeedRecord(_Record):
    """One figure of one matcher on both seeds.

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


class OpeningRecord(_Record):
    """One opening of a sealed place: the seed that drew it, and the day."""

    commitment: Sha256
    bits: Annotated[int, Field(ge=1)]
    opened: Annotated[str, Field(pattern=r"^\d{4}-\d{2}-\d{2}$")]


class SealedRecord(_Record):
    """A sealed place: the commitment of the seed that the board draws it by, if it does, and every opening."""

    drawn_by: Sha256 | None
    openings: list[OpeningRecord]


class _OnBothSeeds(_Record):
    verdict: Literal["run here", "reproduced", "not reproduced"]
    why: str
    figures: list[SeedRecord]


class _Entry(_Record):
    name: str
    version: str | None = None
    hash: str | None = None
    how: str | None = None
    card: CardRecord | None = None
    trained_on: list[str] | None = None
    set_apart: str | None = None
    isolation: dict[str, str] | None = None
    private: _OnBothSeeds | None = None
    learned: list[_Learned] = []
    failed_controls: list[str] = []


class _Task(_Record):
    region: str
    suite: str
    map_date: str | None = None
    queries_sha256: str | None = None


class _Elsewhere(_Record):
    matcher: str
    n: Annotated[int, Field(ge=1)]
    value: float
    lo: float
    hi: float


class ElsewhereRecord(_Record):
    """Rows of another board that asked the same queries of a suite, track and prior group."""

    board: Plain
    suite: str
    track: str
    prior_group: str
    metric: str
    rows: Annotated[list[_Elsewhere], Field(min_length=1)]


class BoardRecord(_Record):
    """The fields of `board.json` that pages use; every board has those without a default.

    >>> BoardRecord.model_validate({"scorer_version": 4, "entries": [], "tasks": []}).remarks
    []
    """

    scorer_version: int
    entries: list[_Entry]
    tasks: list[_Task]
    task_version: int | None = None
    data_version: int | None = None
    made_by: str | None = None
    libraries: dict[str, str] = {}
    pipeline: PipelineRecord | None = None
    private_seed: PrivateRecord | None = None
    private: PrivateRecord | None = None
    sealed: dict[str, SealedRecord] = {}
    split: str | None = None
    draws: int | None = None
    contrasts: list[ContrastRecord] | None = None
    by_region: list[str] = []
    by_block: list[str] = []
    without: list[str] = []
    rejectors: list[dict[str, str | bool | None]] = []
    remarks: list[str] = []
    elsewhere: list[ElsewhereRecord] = []
    failed: dict[str, str] = {}


class _Picture(_Record):
    file: str
    alt: str = ""
    region: str = ""
    suite: str = ""


_Metres = Annotated[float, Field(ge=-1e8, le=1e8)]
_Bounds = Annotated[list[_Metres], Field(min_length=4, max_length=4)]  # west, south, east, north


class _Block(_Record):
    name: str
    bounds_m: _Bounds


class _Region(_Picture):
    bounds_m: _Bounds | None = None
    blocks: list[_Block] = []


class _Strip(_Picture):
    matcher: str = ""


class _Case(_Strip):
    query_id: str = ""
    failure: str = ""
    kind: str = ""
    said: dict[str, str | float | int | bool | None] | None = None


class PicturesRecord(_Record):
    """The content of `pictures.json`.

    >>> PicturesRecord.model_validate({}).cases
    []
    """

    regions: list[_Region] = []
    suites: list[_Picture] = []
    strips: list[_Strip] = []
    flights: list[_Picture] = []
    cases: list[_Case] = []


def parse_record(data: bytes | str, model: type[Model]) -> Model:
    """Parse JSON from an untrusted source.

    Raise ValueError naming the first fault in a line: no JSON, nested without end, or a value of another type.

    >>> parse_record('{"scorer_version": 4, "entries": 5}', BoardRecord)
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
        fault = "Input should be an object" if first["type"] == "model_type" else first["msg"]
        raise ValueError(one_line(f"{where}{found}: {fault}" if where else fault)) from error
