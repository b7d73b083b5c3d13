# SPDX-License-Identifier: Apache-2.0
"""What a file in `pipelines/` says: an experiment as data, read before anything is run."""

import datetime as dt
import difflib
import hashlib
import json
from collections.abc import Collection, Mapping
from pathlib import Path
from typing import Annotated, Final, Literal, Self

from pydantic import Field, model_validator

from sasgeo_bench.boards.manifests import PipelineRecord
from sasgeo_bench.core.config import (
    Document,
    Line,
    NamedDocument,
    Prose,
    Short,
    find_document,
    list_documents,
    read_document,
)
from sasgeo_bench.core.plugins import YARDSTICK
from sasgeo_bench.scoring.compare import (
    LESS,
    LOWER,
    OF_MATCHERS,
    RELATIVE,
    ContrastMetric,
    attainable,
    best_value,
    unreachable,
)
from sasgeo_bench.scoring.contrasts import Contrast
from sasgeo_bench.sensing.reference_imagery import COARSEST_M, FINEST_M, Look
from sasgeo_bench.sensing.rendering.palettes import Family
from sasgeo_bench.sensing.rendering.seasons import Season
from sasgeo_bench.tasks.query import BY, CONTROLS, PUBLISHED, RENDERED, Detector, PriorGroup, Track
from sasgeo_bench.tasks.suites.ages import DAYS_PER_YEAR

PAPER_SUITE: Final = "paper-poc"
Crop = Literal["unknown", "absent", "smaller"]
CHOICE: Final = ("views_cells", "kinds", "tracks")  # keys of a [[task]]
ONE_DETECTOR: Final = [PUBLISHED]
# Keys that came after the first boards, by table, and what is meant without them: files that leave one out keep the
# hash that their boards were made under.
_NEWER: Final[Mapping[str, Mapping[str, object]]] = {
    "contrast": {"pilot": None, "detectors": []},
    "pilot": {"control": None, "spread": None},
    "task": {**{key: [] for key in CHOICE}, "detectors": ONE_DETECTOR, "segmenters": [], "regions": []},
    "paper": {"crop_readings": []},
    "learning": {"detector": PUBLISHED, "kinds": [], "models": 1},
}

Name = Annotated[str, Field(pattern=r"^[a-z0-9][a-z0-9_-]{0,99}$")]  # of a folder, too
SegmenterName = Annotated[str, Field(pattern=r"^[a-z0-9][a-z0-9_-]{0,99}(\+shares)?$")]  # +shares: recalibrated


class PilotSpec(Document):
    """What is known of a contrast from train places; see `scoring.contrasts.Pilot`."""

    second: Annotated[float, Field(ge=-1, le=1)] | None = None  # of a difference it may be below 0
    control: Annotated[float, Field(ge=0, le=1)] | None = None
    false_share: Annotated[float, Field(ge=0, le=1)] | None = None
    spread: Annotated[float, Field(ge=0, le=1)] | None = None
    discordant: Annotated[float, Field(ge=0, le=1)] | None = None
    correlation: Annotated[float, Field(ge=0, le=1)] = 0.05


class ContrastSpec(Document):
    """One registered contrast; see `scoring.contrasts.Contrast`. `pilot` is for its registration alone."""

    name: Name
    first: str
    second: str
    suites: Annotated[list[str], Field(min_length=1)]
    kinds: list[Short] = []
    detectors: list[Detector] = []
    metric: ContrastMetric = "primary"
    track: Track = "localization"
    min_effect: Annotated[float, Field(gt=0, le=1)] = 0.03
    pilot: PilotSpec | None = None
    why: Prose = ""

    @property
    def registered(self) -> Contrast:
        """Return the contrast as boards hold it."""
        return Contrast(
            name=self.name,
            first=self.first,
            second=self.second,
            suites=tuple(self.suites),
            kinds=tuple(self.kinds),
            detectors=tuple(self.detectors),
            metric=self.metric,
            track=self.track,
            min_effect=self.min_effect,
        )

    @model_validator(mode="after")
    def _can_be_judged(self) -> Self:
        """Refuse a whole area: how much of it a perfect order has already is unknown."""
        if self.metric == "aurc" and (self.pilot is None or None in (self.pilot.second, self.pilot.false_share)):
            raise ValueError(
                f"contrast {self.name!r} by aurc needs a pilot with second and false_share, from train places: where "
                'many answers are false a perfect order gains little; metric = "e_aurc" needs none'
            )
        if self.metric == "false_accepted" and self.track != "sequence":
            raise ValueError(f'contrast {self.name!r} by false_accepted is of flights: say track = "sequence"')
        pilot = self.pilot or PilotSpec()
        if self.metric not in LESS and (pilot.control is not None or (pilot.second or 0) < 0):
            raise ValueError(
                f"contrast {self.name!r}: a pilot with control, or second below 0, is for metric = "
                '"interaction" or "shift"'
            )
        if self.metric == "shift" and (len(self.detectors) != 1 or PUBLISHED in self.detectors):
            raise ValueError(
                f"contrast {self.name!r} by shift compares one detector with {PUBLISHED!r}: name the other one alone, "
                'such as detectors = ["measured"]'
            )
        if pilot.second is not None:
            self._check_reach(pilot, pilot.second)
        return self

    def _check_reach(self, pilot: PilotSpec, second: float) -> None:
        """Refuse what no query could make reachable, and a pilot whose second side is better than the best."""
        best = best_value(self.metric, control=pilot.control, false_share=pilot.false_share)
        if self.metric == "aurc" and second < best:
            raise ValueError(
                f"contrast {self.name!r}: where {pilot.false_share} of the answers are false a perfect order has an "
                f"area of {best:.3f}, so the pilot's second cannot be {second}"
            )
        gain = attainable(best, second, is_lower_better=self.metric in LOWER)
        least = self.min_effect * (second if self.metric in RELATIVE else 1.0)
        message = unreachable(self.name, self.metric, gain=gain, least=least) or ""
        if message:
            raise ValueError(message)


class TaskSpec(Document):
    """Suites that are drawn alike; several of these make up a pipeline.

    `prior` is that of each suite unless given; `matchers` are those that are asked and `regions` those that are drawn,
    all of the file unless given. `views_cells`, `kinds` and `tracks` choose of the variants of each suite, all where
    they are empty: fewer variants at more sites say more. Each variant is drawn with each of `detectors`. Suites of
    pictures name `segmenters` from `list segmenters`: each makes evidence of all pictures, which is asked, learned from
    and compared as a suite of its own. With `+shares` after its name it is recalibrated by the shares of the classes on
    the map.

    >>> TaskSpec(suites=["aerial"], sites=2, segmenters=["pixel_forest"]).asked
    ['aerial+pixel_forest']
    """

    suites: Annotated[list[str], Field(min_length=1)]
    sites: Annotated[int, Field(ge=1, le=10_000)]
    prior: str | None = None
    matchers: list[str] = []
    views_cells: list[Annotated[int, Field(gt=0)]] = []
    kinds: list[Short] = []
    tracks: list[Track] = []
    detectors: Annotated[list[Detector], Field(min_length=1)] = ONE_DETECTOR
    segmenters: list[SegmenterName] = []
    regions: list[str] = []

    @property
    def asked(self) -> list[str]:
        """Return the names of the suites as matchers are asked on them."""
        both = [f"{suite}{BY}{segmenter}" for suite in self.suites for segmenter in self.segmenters]
        return both or self.suites

    @property
    def looks(self) -> list[Detector]:
        """Return the families of errors that are drawn: of perception, or of the look of pictures."""
        return [RENDERED] if self.segmenters and self.detectors == ONE_DETECTOR else self.detectors


class PaperSpec(Document):
    """The paper's own experiment: regions and trials of each of these seeds, drawn with no split and no other setting.

    Cells that a crop cuts away are unknown. `crop_readings` draws the same trials again, each reading as a suite of its
    own: as "absent" these cells are absent, as "smaller" the view ends where the crop does.

    >>> PaperSpec().seeds, PaperSpec().trials
    ([42], 220)
    >>> PaperSpec(crop_readings=["absent"]).crops
    {'paper-poc': 'unknown', 'paper-poc-crop-absent': 'absent'}
    """

    seeds: Annotated[list[Annotated[int, Field(ge=0)]], Field(min_length=1)] = [42]
    trials: Annotated[int, Field(ge=1, le=10_000)] = 220
    crop_readings: list[Literal["absent", "smaller"]] = []

    @property
    def crops(self) -> dict[str, Crop]:
        """Return the reading of the crop by suite."""
        crops: list[Crop] = ["unknown", *self.crop_readings]
        return {paper_suite(crop): crop for crop in crops}


def paper_suite(crop: Crop) -> str:
    """Return the suite of a reading of the crop.

    >>> paper_suite("unknown"), paper_suite("smaller")
    ('paper-poc', 'paper-poc-crop-smaller')
    """
    return PAPER_SUITE if crop == "unknown" else f"{PAPER_SUITE}-crop-{crop}"


class LearningSpec(Document):
    """Queries that matchers with a `learn` are trained on: suites, number, on the other half.

    `oracles` learn from the half that they are asked on: yardsticks of what rates known in advance would be worth.
    Matchers learn from views of one `detector`, so that views of another one show what a shift costs; and under stress
    only from `kinds`, as they begin, all if empty. Views without stress always count.

    Of several `models` each learns from a draw of its own of the views, and answers in some of the countries: so the
    luck of training is in differences between countries, and in their intervals.

    >>> LearningSpec(suites=["clean"]).most
    200
    """

    suites: Annotated[list[str], Field(min_length=1)]
    most: Annotated[int, Field(ge=1, le=2000)] = 200
    oracles: list[str] = []
    detector: Detector = PUBLISHED
    kinds: list[Short] = []
    models: Annotated[int, Field(ge=1, le=20)] = 1


class ReferenceImagerySpec(Document):
    """Rendered imagery that the asked regions get, for matchers that hold pictures against pictures.

    It shows the dated map of each place that is nearest to `age_years` older than the newest one, in a look that no
    query has; `sensing.reference_imagery.Look` tells the other keys. Regions with real imagery keep that.

    >>> ReferenceImagerySpec(season="snow").date_of({dt.date(2025, 1, 1), dt.date(2014, 1, 1)})
    datetime.date(2025, 1, 1)
    """

    age_years: Annotated[float, Field(ge=0, le=100)] = 0.0
    family: Family = "calibration"
    season: Season = "autumn"
    gsd_m: Annotated[float, Field(ge=FINEST_M, le=COARSEST_M)] = 0.5
    seed: Annotated[int, Field(ge=0)] = 0

    @property
    def look(self) -> Look:
        """Return the look of the images."""
        return Look(family=self.family, season=self.season, gsd_m=self.gsd_m, seed=self.seed)

    def date_of(self, dates: Collection[dt.date]) -> dt.date:
        """Return the date of the map that is shown, out of those that a place has."""
        newest = max(dates)
        return min(sorted(dates), key=lambda date: abs((newest - date).days / DAYS_PER_YEAR - self.age_years))


class ArchiveSpec(Document):
    """The archive of answers beside the file (`experiments.head_start`), by its SHA-256: another one is not unpacked.

    >>> ArchiveSpec(sha256="0" * 64).sha256[:4]
    '0000'
    """

    sha256: Annotated[str, Field(pattern=r"^[0-9a-f]{64}$")]


class PipelineFile(NamedDocument):
    """A pipeline file: suites on regions of a split, the paper's experiment, or both.

    >>> spec = {"id": "mine", "title": "Mine", "split": "crossfit", "matchers": ["random"]}
    >>> PipelineFile.model_validate(spec | {"task": [{"suites": ["clean"], "sites": 2}]}).top_k
    25
    """

    id: Name
    title: Line
    split: str | None = None
    regions: list[str] = []
    regions_of_a_place: Annotated[int, Field(ge=1)] | None = None
    seed: int = 0
    task: list[TaskSpec] = []
    paper: PaperSpec | None = None
    learning: LearningSpec | None = None
    reference_imagery: ReferenceImagerySpec | None = None
    matchers: Annotated[list[str], Field(min_length=1)]
    rejectors: list[str] = []
    metrics: list[str] = []
    contrast: list[ContrastSpec] = []
    top_k: Annotated[int, Field(ge=1, le=1000)] = 25
    match_s: Annotated[float, Field(gt=0, le=3600)] = 30.0
    draws: Annotated[int, Field(ge=100, le=100_000)] = 10_000
    archive: ArchiveSpec | None = None

    @property
    def sha256(self) -> str:
        """Hash of all that it says of the experiment, defaults among it, as `board.json` names it."""
        left_out = {"archive"} | {
            name
            for name in ("learning", "reference_imagery", "metrics", "regions_of_a_place")
            if not getattr(self, name)
        }
        fields = self.model_dump(mode="json", exclude=left_out)
        pilots = [item["pilot"] for item in fields["contrast"] if item["pilot"] is not None]
        named = {**fields, "pilot": pilots}
        for name, newer in _NEWER.items():
            tables = named.get(name) or []
            for table in tables if isinstance(tables, list) else [tables]:
                for key in [key for key, meant in newer.items() if table[key] == meant]:
                    del table[key]
        return hashlib.sha256(json.dumps(fields, separators=(",", ":"), ensure_ascii=False).encode()).hexdigest()

    @property
    def identity(self) -> PipelineRecord:
        """Return the pipeline as `board.json` holds it."""
        return PipelineRecord(id=self.id, sha256=self.sha256)

    @model_validator(mode="after")
    def _has_what_it_needs(self) -> Self:
        if self.rejectors and (self.split is None or not self.task):
            raise ValueError(
                "rejectors are fitted on the calibration places of a split: name 'split' and a [[task]], or none"
            )
        if not self.task and self.paper is None:
            raise ValueError("'task' is missing: draw suites by [[task]], or the paper's experiment by [paper]")
        if self.task and self.split is None:
            raise ValueError("'split' is missing: [[task]] is drawn on the regions of a split")
        if not self.task and (self.split is not None or self.regions):
            raise ValueError("'split' and 'regions' are for [[task]], and there is none: leave them out")
        if self.regions_of_a_place and (self.regions or not self.task):
            raise ValueError("'regions_of_a_place' bounds what is drawn of a split: leave it out, or 'regions'")
        return self

    @model_validator(mode="after")
    def _names_once(self) -> Self:
        suites = [name for task in self.task for name in task.asked]
        suites += [] if self.paper is None else [PAPER_SUITE, *map(paper_suite, self.paper.crop_readings)]
        for what, listed in (
            ("suite", suites),
            ("region", self.regions),
            *(("detector", [str(name) for name in task.detectors]) for task in self.task),
            *(("region", task.regions) for task in self.task),
            ("matcher", self.matchers),
            ("rejector", self.rejectors),
            ("metric", self.metrics),
            ("contrast", [item.name for item in self.contrast]),
            ("suite to learn from", [] if self.learning is None else self.learning.suites),
            ("seed", [] if self.paper is None else [str(seed) for seed in self.paper.seeds]),
        ):
            twice = sorted({name for name in listed if listed.count(name) > 1})
            if twice:
                raise ValueError(f"{what} {twice[0]!r} is listed twice")
        if CONTROLS in suites:
            raise ValueError(f"suite {CONTROLS!r} is drawn for every board: leave it out")
        drawn = [name for task in self.task for name in task.asked]
        lost = next((name for name in (self.learning.suites if self.learning else ()) if name not in drawn), None)
        if lost is not None:
            raise ValueError(
                f"learning names the suite {lost!r}, which no [[task]] draws: add it there, or leave it out"
            )
        _check_apart(self.contrast)
        for item in self.contrast:
            lost = next((name for name in item.suites if name not in suites), None)
            if lost is not None:
                raise ValueError(f"contrast {item.name!r} names the suite {lost!r}, which is not drawn")
            of_paper = set() if self.paper is None else set(self.paper.crops)
            if set(item.suites) <= of_paper and item.track != "retrieval":
                raise ValueError(f'contrast {item.name!r}: the paper\'s trials are retrieval, say track = "retrieval"')
            _check_methods(item, self.matchers, self.rejectors)
        return self

    @model_validator(mode="after")
    def _draws_what_it_names(self) -> Self:
        named = [name for task in self.task for name in task.regions]
        strange = next((name for name in named if self.regions and name not in self.regions), None)
        if strange is not None:
            raise ValueError(f"a [[task]] draws {strange!r}, which is not among 'regions': name it there, too")
        is_all_drawn = any(not task.regions for task in self.task)
        idle = next((name for name in self.regions if self.task and not is_all_drawn and name not in named), None)
        if idle is not None:
            raise ValueError(f"region {idle!r} is drawn by no [[task]]: leave it out, or name it in one")
        return self

    @model_validator(mode="after")
    def _asks_whom_it_names(self) -> Self:
        for task in self.task:
            if task.prior is not None:
                PriorGroup.parse(task.prior)
            strange = next((name for name in task.matchers if name not in self.matchers), None)
            if strange is not None:
                raise ValueError(f"a [[task]] asks {strange!r}, which is not among 'matchers': name it there, too")
        oracles = [] if self.learning is None else self.learning.oracles
        strange = next((name for name in oracles if name not in self.matchers), None)
        if strange is not None:
            raise ValueError(
                f"learning names the oracle {strange!r}, which is not among 'matchers': name it there, too"
            )
        plain = next((name for name in oracles if ":" not in name and not name.startswith(YARDSTICK)), None)
        if plain is not None:
            raise ValueError(f"learning names the oracle {plain!r}: names of oracles begin with {YARDSTICK}")
        idle = next((name for name in self.matchers if self.task and not self.suites_of(name)), None)
        if idle is not None and self.paper is None:
            raise ValueError(f"matcher {idle!r} is asked on no suite: leave it out, or name it in a [[task]]")
        for item in self.contrast:
            _check_asked(item, self.task)
            _check_drawn(item, self.task)
        if self.learning is not None:
            _check_learned(self.learning, self.task)
        return self

    def suites_of(self, matcher: str) -> frozenset[str]:
        """Suites that a matcher is asked on.

        >>> tasks = [{"suites": ["clean"], "sites": 2}, {"suites": ["alias"], "sites": 2, "matchers": ["fft_vote"]}]
        >>> spec = {"id": "mine", "title": "Mine", "split": "crossfit", "matchers": ["random", "fft_vote"]}
        >>> sorted(PipelineFile.model_validate(spec | {"task": tasks}).suites_of("random"))
        ['clean']
        """
        asked = (task for task in self.task if not task.matchers or matcher in task.matchers)
        return frozenset(name for task in asked for name in task.asked)


def _check_drawn(contrast: ContrastSpec, tasks: list[TaskSpec]) -> None:
    """Refuse a contrast that could count no query: Holm's adjustment would count it all the same."""
    own = [task for task in tasks if set(task.asked) & set(contrast.suites)]
    if not own:  # of the paper's trials
        return
    named, drawn = set(contrast.detectors), {name for task in own for name in task.looks}
    if named and not named & drawn:
        raise ValueError(
            f"contrast {contrast.name!r} counts views of {' and '.join(sorted(named))} alone, and its suites are drawn "
            f"with {' and '.join(sorted(drawn))}: add the detector to their [[task]]"
        )
    if contrast.metric == "shift" and any(not {PUBLISHED, *named} <= set(task.looks) for task in own):
        raise ValueError(
            f"contrast {contrast.name!r} by shift compares views of {PUBLISHED!r} and {contrast.detectors[0]!r}: name "
            f"both in detectors of the [[task]] of {' and '.join(contrast.suites)}"
        )
    if all(task.tracks and contrast.track not in task.tracks for task in own):
        raise ValueError(
            f"contrast {contrast.name!r} is of {contrast.track}, and no [[task]] of its suites draws that track"
        )


def _check_learned(learning: LearningSpec, tasks: list[TaskSpec]) -> None:
    """Refuse a detector of learning with which no suite that is learned from is drawn."""
    drawn = {name for task in tasks if set(task.asked) & set(learning.suites) for name in task.looks}
    if learning.detector not in drawn:
        raise ValueError(
            f"learning is from views of {learning.detector!r}, and its suites are drawn with "
            f"{' and '.join(sorted(drawn))}: add it to the detectors of their [[task]]"
        )


def _check_apart(contrasts: list[ContrastSpec]) -> None:
    """Refuse a method against itself, and two contrasts of the same: Holm's adjustment would count both."""
    seen: dict[object, str] = {}
    for item in contrasts:
        if item.first == item.second:
            raise ValueError(f"contrast {item.name!r} holds {item.first!r} against itself: name two methods")
        queries = (frozenset(item.suites), frozenset(item.kinds), frozenset(item.detectors), item.track)
        before = seen.setdefault((frozenset((item.first, item.second)), *queries, item.metric), item.name)
        if before != item.name:
            raise ValueError(f"contrasts {before!r} and {item.name!r} compare the same: leave one out")


def _check_asked(item: ContrastSpec, tasks: list[TaskSpec]) -> None:
    """Refuse a contrast of a matcher that is not asked on its suites."""
    for task in tasks:
        for method in (item.first, item.second):
            suite = next((name for name in task.asked if name in item.suites), None)
            matcher = method.split(" x ")[0]
            if suite is not None and task.matchers and matcher not in task.matchers:
                raise ValueError(f"contrast {item.name!r} names {matcher!r}, which is not asked on {suite!r}")


def _check_methods(item: ContrastSpec, matchers: list[str], rejectors: list[str]) -> None:
    """Refuse a contrast of methods that are not run."""
    is_of_rejectors = item.metric not in OF_MATCHERS
    plain = next((name for name in (item.first, item.second) if is_of_rejectors and " x " not in name), None)
    if plain is not None:
        raise ValueError(
            f"contrast {item.name!r} by {item.metric} is of rejectors: name {plain!r} as matcher x rejector"
        )
    known = {f"{one} x {two}" for one in matchers for two in rejectors} if is_of_rejectors else set(matchers)
    lost = next((name for name in (item.first, item.second) if name not in known), None)
    if lost is not None:
        where = "'matchers' x 'rejectors'" if is_of_rejectors else "'matchers'"
        near = difflib.get_close_matches(lost, sorted(known), n=1, cutoff=0.4)
        hint = f", did you mean {near[0]!r}?" if near else ""
        raise ValueError(f"contrast {item.name!r} names {lost!r}, which is not among {where}{hint}")


def read_pipeline_file(path: Path) -> PipelineFile:
    """Read one pipeline file; raises as `read_document` does."""
    return read_document(path, PipelineFile, "pipelines")


def list_pipeline_files() -> dict[str, Path]:
    """Pipeline id -> file, of those shipped; raises as `list_documents` does.

    >>> "demo" in list_pipeline_files()
    True
    """
    return list_documents("pipelines", PipelineFile, ())


def find_pipeline_file(id_or_path: str) -> Path:
    """Find a pipeline file by its id, or take the path of one; raises as `find_document` does."""
    return find_document(id_or_path, "pipeline", "or name a .toml file", list_pipeline_files)
