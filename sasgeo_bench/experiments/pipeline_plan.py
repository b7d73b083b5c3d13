# SPDX-License-Identifier: Apache-2.0
"""A pipeline file -> a plan: queries to draw, runs with what they learn from, and what is missing yet."""

from collections import Counter
from collections.abc import Mapping, Sequence
from contextlib import nullcontext
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final

from sasgeo_bench.boards.pipeline_spec import LearningSpec, PipelineFile
from sasgeo_bench.core.errors import ConfigError, MatchError, StoreError, counted, named
from sasgeo_bench.core.plugins import ORACLE, YARDSTICK, check_names, is_tracker
from sasgeo_bench.core.progress import reporting, silent, tell
from sasgeo_bench.experiments.experiment import Experiment, find_experiment
from sasgeo_bench.experiments.sealed import Seal, seal_of
from sasgeo_bench.regions.region_spec import list_region_files, read_region_file
from sasgeo_bench.running import prediction_files
from sasgeo_bench.running.plan import RunPlan, RunRequest, plan_run
from sasgeo_bench.running.training_tasks import Lessons
from sasgeo_bench.running.worker import Limits
from sasgeo_bench.scoring.controls import REFERENCE
from sasgeo_bench.scoring.metric_plugins import find_metrics
from sasgeo_bench.scoring.rows import is_unranked
from sasgeo_bench.sensing.rendering.palettes import PALETTES
from sasgeo_bench.tasks.build import is_of_region, look_of, made_tasks, why_to_draw
from sasgeo_bench.tasks.private_seed import PrivateSeed, Seed
from sasgeo_bench.tasks.query import BY, CONTROLS, RENDERED, SEQUENCE, PriorGroup, base_of
from sasgeo_bench.tasks.split import HALVES, Split
from sasgeo_bench.tasks.suites.all_suites import find_suite, is_pictured, known_suite
from sasgeo_bench.tasks.suites.base import Choice
from sasgeo_bench.tasks.task_plan import Request, TaskRequest, plan_requests, root_of

HELD_OUT: Final = "held out"
_NOT_TRAINED: Final = ("calibration", "test")


@dataclass(frozen=True, slots=True, kw_only=True)
class TrainingGroup:
    """Task folders that a matcher is asked in one run, and those it learns from before; none if it stays untaught.

    `name` is the half in a cross-fit, "held out" in a hold-out, and which of several models answers; `model` is its
    number, from 0.
    """

    name: str
    asked: tuple[Path, ...]
    train: tuple[Path, ...]
    model: int = 0


@dataclass(frozen=True, slots=True, kw_only=True)
class TrainingGroups:
    """Training groups of a pipeline: the split of a pipeline, that of its controls, and its table `[learning]`."""

    split: Split
    controls: Split
    learning: LearningSpec

    def of(self, asked: Sequence[Path], tasks: Sequence[Path], *, is_oracle: bool) -> list[TrainingGroup]:
        """Return the groups of a matcher that is asked some of all `tasks`; an oracle learns from what it is asked.

        In a cross-fit each half is asked after learning from the other. In a hold-out all that is not for training is
        asked after learning from the train places. Tasks of no place, as the paper's, are asked untaught. A sealed
        place never trains. Of several models each is asked in countries of its own (`models_by_place`), the first on
        tasks of no place, as controls are; an oracle has one.
        """
        groups = {task: self._group_of(task) for task in tasks}
        names = [HELD_OUT] if is_holdout(self.split) else [f"half {half}" for half in HALVES]
        none = f"no {'part' if is_holdout(self.split) else 'half'}"
        count = 1 if is_oracle else self.learning.models
        models = models_by_place(self.split, count)
        places_of = {task: self.split.places_in(base_of(task.name)) for task in asked}
        model_of = {task: next(map(models.__getitem__, places), 0) for task, places in places_of.items()}
        found = [
            TrainingGroup(
                name=(name or none) + (f", model {model + 1} of {count}" if name and count > 1 else ""),
                asked=tuple(task for task in asked if groups[task] == name and (not name or model_of[task] == model)),
                train=tuple(task for task in tasks if name and self._teaches(task, groups[task], name, is_oracle)),
                model=model,
            )
            for name in (*names, None)
            for model in range(count if name else 1)
        ]
        return [group for group in found if group.asked]

    def _teaches(self, task: Path, group: str | None, name: str, is_oracle: bool) -> bool:  # noqa: FBT001
        """Return whether a task trains for a group of places."""
        is_fit = task.parent.name in self.learning.suites and group is not None
        return is_fit and (group == name) == is_oracle and self.split.sealed_place(base_of(task.name)) is None

    def _group_of(self, task: Path) -> str | None:
        """Return the group of places that a task belongs to: "half a", "held out", "train"; None for the paper's."""
        region = base_of(task.name)
        for split in (self.split, self.controls):
            for place in split.places_in(region):
                if not is_holdout(self.split):
                    half = split.half_of.get(place)
                    return None if half is None else f"half {half}"
                if split is self.split:
                    return HELD_OUT if split.part_of(place) in _NOT_TRAINED else "train"
        return HELD_OUT if task.parent.name == CONTROLS else None

    def lines(self, requests: Sequence[Request]) -> list[str]:
        """Report what is learned from where; `requests` are those of the pipeline."""
        suites, most = ", ".join(self.learning.suites), self.learning.most
        if not is_holdout(self.split):
            how, own = "each half is asked after learning from the other", "the half itself"
        else:
            how = "calibration and test places are asked after learning from train places"
            own = "calibration and test places themselves"
        lines = [f"  learning: {how} ({suites}, at most {most} queries)"]
        if self.learning.models > 1:
            lines.append(f"    {self.learning.models} models, each of a draw of its own: countries take turns")
        for part in ("train", *_NOT_TRAINED) if is_holdout(self.split) else ():
            places = _places_of(part, requests, self.split)
            lines.append(f"    {part}: {named(places, 'place') if places else 'no place'}")
        there = {place for item in requests for place in self.split.places_in(item.region.id)}
        for half, other in () if is_holdout(self.split) else (HALVES, HALVES[::-1]):
            if not any(self.split.half_of.get(place) == half for place in there):
                lines.append(f"    half {half} has no place here: none learns for half {other}")
        if self.learning.oracles:
            lines.append(f"    {', '.join(self.learning.oracles)}: from {own}, never ranked")
        return lines


def models_by_place(split: Split, count: int) -> dict[str, int]:
    """Return which of some models answers at each place: countries of a part, or of a half, take turns, largest first.

    All places of a country have one model, so that its luck is that of the country.
    """
    found: dict[str, int] = {}
    part_of = {place.name: place.part or place.half or "" for place in split.spec.place}
    for part in sorted(set(part_of.values())):
        places = [name for name, own in part_of.items() if own == part]
        sizes = Counter(split.country_of[name] for name in places)
        turn = {country: at % count for at, country in enumerate(sorted(sizes, key=lambda one: (-sizes[one], one)))}
        found |= {name: turn[split.country_of[name]] for name in places}
    return found


def is_holdout(split: Split) -> bool:
    """Return whether whole places are held out."""
    return split.spec.kind == "holdout"


def trains(split: Split, region: str) -> bool:
    """Return whether all of a region is for training in a hold-out, so that no matcher is asked there."""
    parts = {split.part_of(place) for place in split.places_in(region)}
    return is_holdout(split) and parts == {"train"}


def needed(requests: Sequence[Request], learning: LearningSpec | None) -> tuple[Request, ...]:
    """Return the requests that are learned from or asked: on train places of a hold-out only suites to learn from.

    Those are the suites of `learning`, and rendered pictures, which segmenters learn from. Raise `ConfigError` if
    learning from a hold-out has no train or no test place, or a region of several parts.
    """
    taught = {name.partition(BY)[0] for name in (() if learning is None else learning.suites)}
    found = tuple(
        item
        for item in requests
        if not trains(item.split, item.region.id) or item.suite in taught or _is_rendered(item)
    )
    split = requests[0].split
    if not is_holdout(split):
        return found
    if learning is not None:
        _check_parts(requests, split)
    if not split.sealed and not _places_of("test", requests, split):
        raise ConfigError(
            f"no region is of a test place of the hold-out {split.spec.id!r}, and a board ranks these alone: add one"
        )
    return found


def _is_rendered(request: Request) -> bool:
    suite = request.found
    return suite.is_pictured and RENDERED in suite.drawn_by(request.choice.detectors)


def _check_parts(requests: Sequence[Request], split: Split) -> None:
    """Refuse learning from a hold-out without a train place, or with a region that is trained on and asked."""
    if not _places_of("train", requests, split):
        raise ConfigError(
            f"[learning] has no region of a train place of the hold-out {split.spec.id!r}: add one, or leave it out"
        )
    for region in dict.fromkeys(item.region.id for item in requests):
        parts = sorted({split.part_of(place) for place in split.places_in(region)})
        if "train" in parts and len(parts) > 1:
            raise ConfigError(
                f"region {region!r} has blocks of the parts {' and '.join(parts)} of split {split.spec.id!r}, and is "
                "learned from: [learning] needs regions of one part each"
            )


def _places_of(part: str, requests: Sequence[Request], split: Split) -> tuple[str, ...]:
    """Return the places of a part that some requests are on."""
    there = {place for item in requests for place in split.places_in(item.region.id)}
    return tuple(place for place in split.blocks if place in there and split.part_of(place) == part)


# Every board has controls: of small towns that everybody can build, asked of all matchers and of a plain search.
CONTROL_REGIONS: Final = ("town-riverside", "town-suburb")
CONTROL_CELL_M: Final = 1.0  # of any town that stands in for them
CONTROL_SPLIT: Final = "crossfit"
CONTROL_SITES: Final = 8
CONTROL_MATCHERS: Final = (ORACLE, "prior_centre")  # on all queries of every board
MOST_LINES: Final = 6  # of what is to be drawn, or could not be; the rest is counted


@dataclass(frozen=True, kw_only=True)
class PipelinePlan:
    """Steps of a pipeline; `requests` in the order of the file, `controls` those of every board.

    With a private seed, `out` is the root of private runs. `jobs` counts the processes of each matcher; `dask` names a
    cluster to run on instead. `seal` tells of sealed places, `experiment` draws trials of its own, each None without
    any. `only` are the hashes of the queries to ask, all without it; those whose answer was written before the stamp
    `since_ns` are asked again. `within` and `require` are limits and requirements of the board, as of `ScoreRequest`,
    and `added` the matchers of `spec` that its file does not name. Without `is_sandboxed`, matchers are trusted code.
    """

    spec: PipelineFile
    requests: tuple[Request, ...]
    controls: tuple[Request, ...]
    out: Path
    jobs: int = 1
    dask: str | None = None
    private: PrivateSeed | None = None
    seal: Seal | None = None
    experiment: Experiment | None = None
    only: Mapping[str, str] | None = None
    since_ns: int = 0
    within: Sequence[str] = ()
    require: Sequence[str] = ()
    is_sandboxed: bool = True
    added: Sequence[str] = ()

    @property
    def split(self) -> Split | None:
        """Return the split of the tasks; None for the paper's experiment alone."""
        return self.requests[0].split if self.requests else None

    @property
    def training_groups(self) -> TrainingGroups | None:
        """Return the groups that learn from the same places; None without learning."""
        if self.split is None or self.spec.learning is None:
            return None
        return TrainingGroups(split=self.split, controls=self.controls[0].split, learning=self.spec.learning)

    @property
    def seed_files(self) -> tuple[Path, ...]:
        """Return the files of seeds, which no matcher may see."""
        seeds = (self.private, None if self.seal is None else self.seal.seed)
        return tuple(seed.file for seed in seeds if seed is not None and seed.file is not None)

    def to_text(self) -> str:
        """Return which parts of each stage are up to date; every matcher is loaded to find out.

        Raise `MatchError` or `StoreError` as the run would.
        """
        queries, controls = _stage("queries", self.requests), _stage("controls", self.controls)
        stages = [stage for stage in (queries, _paper_stage(self), controls) if stage.made or stage.lacking]
        lines = [f"{self.spec.id}: {self.spec.title}"]
        lines += [line for stage in stages for line in stage.lines()]
        lines += [] if self.training_groups is None else self.training_groups.lines(self.requests)
        lines += [] if self.seal is None else self.seal.lines()
        lines += self._imagery_lines()
        lines += _run_lines(self, stages, controls)
        lines.append(f"  score: {len(self.spec.rejectors)} rejectors, {len(self.spec.contrast)} contrasts")
        lines.append(f"  board: {board_folder(self)}")
        return "\n".join(lines)

    @property
    def imaged(self) -> tuple[Request, ...]:
        """Return one request of each region that gets rendered imagery: those asked that have no real imagery."""
        if self.spec.reference_imagery is None:
            return ()
        asked = {item.region.id: item for item in self.requests if not is_train(self, item.region.id)}
        return tuple(item for item in asked.values() if not item.region.imagery)

    def _imagery_lines(self) -> list[str]:
        """Report what imagery is rendered."""
        settings = self.spec.reference_imagery
        if settings is None:
            return []
        look = f"{settings.season}, family {settings.family}, seed {settings.seed}, {settings.age_years:g} years older"
        return [f"  reference imagery: {counted(len(self.imaged), 'region')}, rendered ({look})"]

    @property
    def matchers(self) -> tuple[str, ...]:
        """Return the matchers of the file, and those of every board."""
        return tuple(dict.fromkeys((*CONTROL_MATCHERS, *self.spec.matchers)))


@dataclass(frozen=True, kw_only=True)
class _Lacking:
    """A task to be drawn, why, and how many queries or flights it has at most."""

    suite: str
    region: str
    why: str
    most: int


@dataclass(frozen=True, kw_only=True)
class _Stage:
    """Tasks of one kind: folders of those that are up to date, request by request, and tasks to be drawn."""

    name: str
    made: tuple[tuple[Path, ...], ...]
    lacking: tuple[_Lacking, ...]

    def lines(self) -> list[str]:
        """Report how many are up to date, why the others are not, and the first of these by name."""
        state = f"{len(self.made)} of {counted(len(self.made) + len(self.lacking), 'task')} up to date"
        if self.lacking:
            reasons = Counter(item.why for item in self.lacking)
            causes = ", ".join(f"{count} {why}" for why, count in reasons.most_common())
            state = f"{state}, {len(self.lacking)} to be drawn ({causes}), at most {_most(self.lacking)}"
        lines = [f"  {self.name}: {state}"]
        lines += [f"    to be drawn: {item.suite} on {item.region}" for item in self.lacking[:MOST_LINES]]
        more = len(self.lacking) - MOST_LINES
        return [*lines, f"    and {more} more"] if more > 0 else lines


def _most(lacking: Sequence[_Lacking]) -> str:
    """Return how many queries and flights some tasks have at most, in words."""
    flights = sum(item.most for item in lacking if _is_of_flights(item.suite))
    queries = sum(item.most for item in lacking) - flights
    parts = [counted(queries, "query", "queries")] if queries or not flights else []
    return " and ".join([*parts, *([counted(flights, "flight")] if flights else [])])


def _stage(name: str, requests: Sequence[Request]) -> _Stage:
    """Sort requests into those that are up to date and those to be drawn."""
    found = [(request, made_tasks(request)) for request in requests]
    return _Stage(
        name=name,
        made=tuple(made for _, made in found if made is not None),
        lacking=tuple(
            _Lacking(suite=request.suite, region=request.region.id, why=why_to_draw(request), most=request.most)
            for request, made in found
            if made is None
        ),
    )


def _paper_stage(plan: PipelinePlan) -> _Stage:
    """Return which tasks of the paper's experiment are up to date, one for each seed."""
    paper = plan.spec.paper
    if paper is None or plan.experiment is None:
        return _Stage(name="", made=(), lacking=())
    drawn = plan.experiment.drawn(paper, out=plan.out, private=plan.private)
    there = {task for task in drawn if (plan.out / "tasks").joinpath(*task).is_dir()}
    return _Stage(
        name=f"the paper's experiment, {counted(paper.trials, 'trial')} of each seed",
        made=tuple((folder,) for folder in drawn.values() if folder is not None),
        lacking=tuple(
            _Lacking(
                suite=suite,
                region=region,
                why="drawn otherwise or damaged" if (suite, region) in there else "not there yet",
                most=paper.trials,
            )
            for (suite, region), folder in drawn.items()
            if folder is None
        ),
    )


def _run_lines(plan: PipelinePlan, stages: Sequence[_Stage], controls: _Stage) -> list[str]:
    """Report, by matcher, answered and open queries, and answers to tasks that are drawn anew."""
    asked = [(spec, list(stages)) for spec in plan.matchers]
    asked += [] if REFERENCE in plan.matchers else [(REFERENCE, [controls])]
    lines, all_done, all_left, all_behind = [], 0, 0, 0
    for spec, own_stages in asked:
        try:
            runs = plan_runs(plan, spec, [task for stage in own_stages for made in stage.made for task in made])
        except (MatchError, StoreError) as error:
            lines.append(f"    {spec}: cannot be asked ({error})")
            continue
        left, done = count_queries(runs)
        planned = runs[0].plan
        lacking = [
            item for stage in own_stages for item in stage.lacking if is_asked(plan, spec, item.suite, item.region)
        ]
        run_folder = plan.out / "runs" / planned.card.name / planned.hash
        behind = sum(_count_rows(run_folder, item.suite, item.region) for item in lacking)
        more = f", and at most {_most(lacking)} to be drawn; {behind} answered there before" if lacking else ""
        where = " (controls alone)" if own_stages == [controls] and len(stages) > 1 else ""
        lines.append(f"    {spec}{where}: {done} answered, {left} to ask{more}")
        lines += [f"      {one.name}: {line}" for one in runs for line in one.lines()]
        all_done, all_left, all_behind = all_done + done, all_left + left, all_behind + behind
    lines.insert(0, f"  run: {counted(len(asked), 'matcher')}, {all_done} answered, {all_left} to ask")
    if all_behind:
        lines.append(
            f"    drawing anew leaves {counted(all_behind, 'answer')} where they are: those to the same queries "
            "count again, the others are set aside"
        )
    return lines


def _count_rows(run: Path, suite: str, region: str) -> int:
    """Count the answers in a matcher's runs to queries of a suite on a region, whenever drawn."""
    folders = [path for path in (run / suite).glob(f"{region}*") if path.is_dir() and is_of_region(path.name, region)]
    return sum(len({(tie.query_id, tie.asked) for tie in prediction_files.read_ties(folder)}) for folder in folders)


def board_folder(plan: PipelinePlan) -> Path:
    """Return the folder of the board."""
    return plan.out / "boards" / plan.spec.id


def plan_pipeline(
    spec: PipelineFile,
    *,
    out: Path,
    extract_folders: tuple[Path, ...] = (),
    region_folders: tuple[Path, ...] = (),
    private: PrivateSeed | None = None,
    sealed: PrivateSeed | None = None,
) -> PipelinePlan:
    """Turn a pipeline file into requests; only files of settings are read.

    `out` is the root of what is built; a line tells what is left out. The folders of extracts and regions
    serve regions that are not built yet, and files of one's own. `private` draws all queries instead of the file's
    seed, below `out/private`. `sealed` draws the sealed places of the split, which are left out without it. Raise
    `ConfigError` for an unknown suite, region or split, or if no region can be built here, or learned from, or ranked;
    `MatchError` for an unknown matcher, rejector or metric.
    """
    check_names(matchers=(*spec.matchers, *CONTROL_MATCHERS, REFERENCE), rejectors=spec.rejectors)
    find_metrics(spec.metrics)
    experiment = find_experiment(spec)
    out, seed = root_of(out, private), private or spec.seed
    requests: list[Request] = []
    for number, task in enumerate(spec.task):
        asked = TaskRequest(
            suites=tuple(task.suites),
            regions=tuple(task.regions or spec.regions),
            each=spec.regions_of_a_place,
            split=str(spec.split),  # a file with tasks names one
            count=task.sites,
            seed=seed,
            out=out,
            group=None if task.prior is None else PriorGroup.parse(task.prior),
            extract_folders=extract_folders,
            region_folders=region_folders,
            sealed_seed=sealed,
            may_be_fewer=True,
            choice=Choice(
                views_cells=tuple(task.views_cells),
                kinds=tuple(task.kinds),
                tracks=tuple(task.tracks),
                detectors=tuple(task.detectors),
            ),
        )
        try:
            with nullcontext() if number == 0 else reporting(silent):
                requests += plan_requests(asked)
        except ConfigError as error:
            raise ConfigError(f"pipeline {spec.id!r}, [[task]] {number + 1} of {len(spec.task)}: {error}") from error
    if spec.task and not requests:
        raise ConfigError(f"pipeline {spec.id!r} has no region that can be built here: name --extracts")
    _check_kinds(spec)
    _check_pictures(spec)
    _check_flights(spec)
    _check_look(spec, requests)
    kept = needed(requests, spec.learning) if requests else ()
    left = {item.region.id for item in requests} - {item.region.id for item in kept}
    if left:
        tell(f"nothing learns, so train places are left out: {', '.join(sorted(left))}")
    split = requests[0].split if requests else None
    return PipelinePlan(
        spec=spec,
        requests=kept,
        controls=_plan_controls(seed, out, split),
        out=out,
        private=private,
        experiment=experiment,
        seal=None if split is None else seal_of(split, kept, sealed, private, out=out),
    )


def _check_pictures(spec: PipelineFile) -> None:
    """Refuse suites of pictures that no segmenter sees, and segmenters of suites without pictures."""
    for task in spec.task:
        for name in task.suites:
            if find_suite(name).is_pictured == bool(task.segmenters):
                continue
            what = "draws pictures, and no segmenter sees them" if not task.segmenters else "draws no pictures"
            mend = "name segmenters" if not task.segmenters else "leave segmenters out, or name it in another [[task]]"
            raise ConfigError(f"pipeline {spec.id!r}: suite {name!r} {what}: {mend}")


def _check_flights(spec: PipelineFile) -> None:
    """Refuse contrasts on a track that their suites do not have: they would count nothing."""
    for item in spec.contrast:
        odd = next((name for name in item.suites if _is_of_flights(name) != (item.track == SEQUENCE)), None)
        if odd is not None:
            what = f"is of flights, say track = {SEQUENCE!r}" if _is_of_flights(odd) else "has no flights"
            raise ConfigError(f"contrast {item.name!r} has track {item.track!r}, and suite {odd!r} {what}")


def _is_of_flights(name: str) -> bool:
    suite = known_suite(name)
    return suite is not None and SEQUENCE in suite.card.tracks


def _check_look(spec: PipelineFile, requests: Sequence[Request]) -> None:
    """Refuse reference imagery in a family of looks that a query has, too, and imagery that no suite looks at."""
    if spec.reference_imagery is None:
        return
    pictured = [item for item in requests if item.found.is_pictured]
    if not pictured:
        raise ConfigError(f"pipeline {spec.id!r} has reference_imagery, and draws no suite of pictures: leave it out")
    family = spec.reference_imagery.family
    alike = next((item.region.id for item in pictured if family in _families(item)), None)
    if alike is not None:
        raise ConfigError(
            f"pipeline {spec.id!r}: reference_imagery is of family {family!r}, and so are pictures of queries on "
            f"{alike}: take another of {', '.join(PALETTES)}"
        )


def _families(request: Request) -> set[str]:
    """Return the families of looks that the pictures of a request are drawn in."""
    found: set[str] = {look_of(request.split, block) for block in request.split.blocks_in(request.region.id)}
    return found | ({"shifted"} & set(request.choice.detectors))


def _check_kinds(spec: PipelineFile) -> None:
    """Refuse a kind of stress that a contrast counts, or learning uses, and no [[task]] draws on its suites."""
    asking = [(f"contrast {item.name!r}", item.suites, item.kinds) for item in spec.contrast]
    if spec.learning is not None:
        asking.append(("[learning]", spec.learning.suites, spec.learning.kinds))
    for who, suites, kinds in asking:
        drawn = {
            variant.kind
            for task in spec.task
            for name in set(task.asked) & set(suites)
            for variant in find_suite(name.split(BY, maxsplit=1)[0]).variants
            if variant.role == "stress" and variant.kind.startswith(tuple(task.kinds) or "")
        }
        lost = next((kind for kind in kinds if not any(one.startswith(kind) for one in drawn)), None)
        if lost is not None:
            raise ConfigError(
                f"{who} names the kind {lost!r}, which is not drawn: its suites have {', '.join(sorted(drawn))}"
            )


def _plan_controls(seed: Seed, out: Path, split: Split | None) -> tuple[Request, ...]:
    """Plan the controls of every board, in towns that the split neither trains on nor seals."""
    regions = [name for name in CONTROL_REGIONS if _may_control(name, split)]
    if not regions:
        specs = {name: read_region_file(path) for name, path in list_region_files().items()}
        made_up = (name for name, spec in specs.items() if spec.pick(None).town is not None)
        towns = [name for name in made_up if specs[name].cell_size_m == CONTROL_CELL_M]
        regions = [name for name in towns if _may_control(name, split)][:1]
    if split is not None and not regions:
        raise ConfigError(
            f"split {split.spec.id!r} trains on every embedded town or seals it, and controls need one: free one"
        )
    controls = TaskRequest(
        suites=(CONTROLS,),
        regions=tuple(regions),
        split=CONTROL_SPLIT,
        count=CONTROL_SITES,
        seed=seed,
        out=out,
        may_be_fewer=True,
    )
    with reporting(silent):
        return plan_requests(controls)


def _may_control(region: str, split: Split | None) -> bool:
    """Return whether controls may be drawn on an embedded town."""
    return split is None or not (trains(split, region) or split.sealed_place(region))


@dataclass(frozen=True, kw_only=True)
class Run:
    """One run of a matcher; a matcher that learns has one for each group, which its name states."""

    name: str
    plan: RunPlan

    def lines(self) -> list[str]:
        """Report the training for it."""
        if self.name and self.plan.training_set is None:
            return ["nothing to learn from, asked untaught"]
        return self.plan.training_lines()


def count_queries(runs: Sequence[Run]) -> tuple[int, int]:
    """Count open and answered queries."""
    parts = [part for one in runs for part in one.plan.parts]
    return sum(len(part.left) for part in parts), sum(part.done for part in parts)


def plan_runs(plan: PipelinePlan, spec: str, tasks: Sequence[Path]) -> list[Run]:
    """Plan the runs of a matcher: one, or with learning one for each group."""
    own = [task for task in tasks if is_asked(plan, spec, task.parent.name, base_of(task.name))]
    learning, groups = plan.spec.learning, plan.training_groups
    is_oracle = learning is not None and spec in learning.oracles
    whole = plan_run(
        RunRequest(
            spec=spec,
            tasks=own,
            out=plan.out,
            top_k=plan.spec.top_k,
            limits=Limits(match_s=plan.spec.match_s),
            jobs=plan.jobs,
            dask=plan.dask,
            is_oracle=is_oracle,
            hidden=plan.seed_files,
            only=plan.only,
            since_ns=plan.since_ns,
            is_sandboxed=plan.is_sandboxed,
        )
    )
    if is_oracle and not is_unranked(whole.card.name):
        raise ConfigError(
            f"learning names {spec!r} among its oracles, and its card is named {whole.card.name!r}: the names of "
            f"oracles begin with {YARDSTICK}, so that no board ranks them"
        )
    if groups is None or not whole.learns or not own:
        return [Run(name="", plan=whole)]
    learning = groups.learning
    lessons = Lessons(detector=learning.detector, kinds=tuple(learning.kinds))
    request = replace(whole.request, most_trained=learning.most, split=groups.split)
    runs = []
    for group in groups.of(own, tasks, is_oracle=is_oracle):
        taught = replace(request, tasks=group.asked, train=group.train, lessons=replace(lessons, draw=group.model))
        runs.append(Run(name=group.name, plan=plan_run(taught)))
    return runs


def is_asked(plan: PipelinePlan, spec: str, suite: str, region: str) -> bool:
    """Return whether a matcher is asked on a task: controls on all, all on the controls, else by the file.

    Nobody is asked on a train place of a hold-out. Trackers are asked on flights alone, and there of the controls the
    oracle alone.
    """
    is_of_flights = _is_of_flights(suite)
    if BY not in suite and is_pictured(suite):  # pictures are asked as a segmenter sees them
        return False
    if not is_of_flights and is_tracker(spec):
        return False
    if suite in {CONTROLS, *(() if plan.spec.paper is None else plan.spec.paper.crops)}:
        return True
    controls = {ORACLE} if is_of_flights else CONTROL_MATCHERS
    is_named = spec in plan.spec.matchers and suite in plan.spec.suites_of(spec)
    return (spec in controls or is_named) and not is_train(plan, region)


def is_train(plan: PipelinePlan, region: str) -> bool:
    """Return whether a region only trains, in a hold-out."""
    return plan.split is not None and trains(plan.split, region)


# Every board has controls: of small towns that everybody can build, asked of all matchers and of a plain search.
