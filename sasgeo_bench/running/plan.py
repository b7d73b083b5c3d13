# SPDX-License-Identifier: Apache-2.0
"""Plan a run: what was requested, and which queries are pending."""

import hashlib
import json
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from collections.abc import Set as AbstractSet
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Final

from sasgeo_bench.core.errors import ConfigError, StoreError, counted, named
from sasgeo_bench.core.plugins import (
    MATCHERS,
    ORACLE,
    list_entry_points,
)
from sasgeo_bench.core.progress import check_jobs
from sasgeo_bench.core.texts import MOST_CANDIDATES
from sasgeo_bench.matching.cards import TrainingRecord, learned_path, read_learned
from sasgeo_bench.matching.follower import follower_record
from sasgeo_bench.matching.matcher import SOUND, STATUSES, MatcherCard, matcher_hash
from sasgeo_bench.regions.imagery import ORTHO
from sasgeo_bench.regions.packed_map import UNPACKED, UnpackedMap
from sasgeo_bench.regions.region_files import read_manifest
from sasgeo_bench.running import prediction_files
from sasgeo_bench.running.oracle import CARD
from sasgeo_bench.running.plugin_code import matcher_code
from sasgeo_bench.running.prediction_files import FollowerRecord, RunManifest
from sasgeo_bench.running.training_tasks import Lessons, TrainingSet, plan_training, root_of
from sasgeo_bench.running.worker import Limits, Reach, Reply, Worker, hidden_below, loaded_card
from sasgeo_bench.tasks.query import flight_id
from sasgeo_bench.tasks.split import Split
from sasgeo_bench.tasks.task_files import Task, TaskManifest, answer_hash, dependency_key

MOST_LINES: Final = 12  # tasks that are named; the others are counted
MOST_TRAINED: Final = 2000  # pairs that travel to a process at once
_MOST_S: Final = 7 * 86_400.0
_BYTES_PER_MB = 10**6
MAPS: Final = ("regions/*", f"{UNPACKED}/*/*")  # below a root: built, and unpacked
_LEAST_MB, _MOST_MB = 64, 4_000_000


@dataclass(frozen=True, kw_only=True)
class RunRequest:
    """Request for a run.

    `spec` is a matcher's name or module:Class; `tasks` are folders out/tasks/<suite>/<region>, whose rows go to
    out/runs/<matcher>/<hash>/<suite>/<region> below `out`. `jobs` counts processes at once; `dask` is the address of a
    scheduler, or local:N for N processes on this machine, with `jobs` 1. `shard` is (i, n), from 1: the i-th of n parts
    of the queries; `limit` bounds the queries of each task. Queries are asked again whose row has a status in `again`
    or was written before the stamp `since_ns`. Without `is_sandboxed`, trusted code runs without isolation, and
    `run.json` says so.

    `train` are tasks with truths, of places that are not asked, for a matcher with a `learn`; `most_trained` bounds
    their queries, evenly over places, then suites, then sites; only what `lessons` hold is used. `split` defines
    places and how far apart training and test places must lie. An oracle (`is_oracle`) may train on what it is asked,
    and is never ranked. `hidden` are files that the matcher must not see besides truths and the like, such as that of a
    private seed. `only` are the hashes of the queries to ask, by id: others, and flights with one of these, are left
    out; all are asked without it. `maps` are packed ones, unpacked: a task on one of these needs no built region.
    """

    spec: str
    tasks: Sequence[Path]
    out: Path
    top_k: int = 25
    limits: Limits = field(default_factory=Limits)
    jobs: int = 1
    dask: str | None = None
    shard: tuple[int, int] = (1, 1)
    limit: int | None = None
    again: Sequence[str] = ()
    since_ns: int = 0
    is_sandboxed: bool = True
    train: Sequence[Path] = ()
    most_trained: int = 200
    lessons: Lessons = field(default_factory=Lessons)
    split: Split | None = None
    is_oracle: bool = False
    hidden: Sequence[Path] = ()
    only: Mapping[str, str] | None = None
    maps: Sequence[UnpackedMap] = ()


@dataclass(frozen=True, slots=True, kw_only=True)
class RunPart:
    """One task of a run: its folder of rows, its map, and its pending queries.

    `asked` gives the hash that the row of each pending query carries (`task_files.answer_hash`); `failed` counts rows
    by status of queries that were asked in vain and are not pending; `excluded` counts rows of earlier queries, of
    other training, or of other imagery. `imagery` is the hash of rendered imagery that the matcher looks at,
    `follower` says how a matcher of single views is asked about flights (`follower.follower_record`), and `key` what
    its rows are tied to.
    """

    task: Task
    folder: Path
    region: Path
    left: tuple[str, ...]
    asked: Mapping[str, str]
    done: int
    excluded: int
    failed: Mapping[str, int] = field(default_factory=dict)
    imagery: str | None = None
    follower: FollowerRecord | None = None
    key: str | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class PackedTraining:
    """What a matcher learned elsewhere, packed with a map, in place of a training set; `count` are its pairs."""

    text: str
    places: tuple[str, ...]
    count: int

    @property
    def sha256(self) -> str:
        """Hash of the text."""
        return hashlib.sha256(self.text.encode()).hexdigest()

    def to_text(self) -> str:
        """As that of a training set."""
        return f"{counted(self.count, 'query', 'queries')} of {named(self.places, 'place')}, packed with the map"


@dataclass(frozen=True, kw_only=True)
class RunPlan:
    """Plan of a run, made after the plugin's card was read in its own process.

    `training_result` is the reply to training, without a text where it failed, and None before. Where the matcher has
    learned elsewhere, `training_set` is what was packed with a map.
    """

    request: RunRequest
    card: MatcherCard
    hash: str
    parts: tuple[RunPart, ...]
    learns: bool = False
    training_set: TrainingSet | PackedTraining | None = None
    training_result: Reply | None = None

    @property
    def run_folder(self) -> Path:
        """Folder of the rows of all tasks."""
        return _run_folder(self.request, self.card, self.hash)

    @property
    def key(self) -> str | None:
        """Hash that ties rows to the training result; None without training."""
        return None if self.training_set is None else _key(self.training_set, self.training_result)

    @property
    def learned_file(self) -> Path | None:
        """Path of the learned text, which may not exist yet."""
        return None if self.training_set is None else learned_path(self.run_folder, self.training_set.sha256)

    @property
    def training_record(self) -> TrainingRecord | None:
        """Record of the training for `run.json`."""
        given, path = self.training_set, self.learned_file
        if given is None or path is None:
            return None
        has_text = self.training_result is not None and self.training_result.learned is not None
        file = path.relative_to(self.run_folder).as_posix() if has_text else None
        key = _key(given, self.training_result)
        return TrainingRecord(key=key, file=file, trained_on=list(given.places), pairs=given.count)

    def training_lines(self) -> list[str]:
        """Describe the training in a line; no line if none was requested."""
        if self.training_set is not None:
            state = "to be trained on" if self.training_result is None else "trained on"
            return [f"{state} {self.training_set.to_text()}"]
        return ["has no learn(): training data are ignored"] if self.request.train else []

    def to_text(self) -> str:
        """Describe the training, the pending and finished queries, and each of the first tasks in a line."""
        lines = [f"{self.card.name} {self.card.version} ({self.hash}), top {self.request.top_k}"]
        lines += [f"  {line}" for line in self.training_lines()]
        lines += [f"  {part.folder}: {_state((part,))}" for part in self.parts[:MOST_LINES]]
        if len(self.parts) > MOST_LINES:
            lines.append(f"  {len(self.parts) - MOST_LINES} more tasks: {_state(self.parts[MOST_LINES:])}")
        if len(self.parts) > 1:
            lines.append(f"  all {len(self.parts)} tasks: {_state(self.parts)}")
        return "\n".join(lines)


def _state(parts: Sequence[RunPart]) -> str:
    left, done, excluded = (
        sum(column) for column in zip(*((len(x.left), x.done, x.excluded) for x in parts), strict=True)
    )
    others = f", {counted(excluded, 'answer')} to other queries set aside" if excluded else ""
    return f"{counted(left, 'query', 'queries')} left, {done} done{others}"


def plan_run(request: RunRequest) -> RunPlan:
    """Read the card and the tasks, and find out what is left to do.

    Raises
    ------
    MatchError
        If the plugin cannot be loaded or its card is not sound.
    ConfigError
        If the shard or a number is out of range, or the training set is refused (`plan_training`).
    StoreError
        If a task is missing, of another version, or its map is; or if no segmenter has seen its pictures, and the
        matcher does not look at them itself.
    """
    _check(request)
    if request.dask is not None:  # other processes work in other folders
        asked, train = ([task.resolve() for task in folders] for folders in (request.tasks, request.train))
        maps = [replace(one, root=one.root.resolve()) for one in request.maps]
        request = replace(request, out=request.out.resolve(), tasks=asked, train=train, maps=maps)
    if ":" not in request.spec:
        list_entry_points()  # warns of a clash of names: what the plugin's own process prints is not shown
    tasks = [Task.open(folder) for folder in dict.fromkeys(request.tasks)]
    _check_maps(request.maps, tasks)
    card, code, learns = _card(request)
    _check_seen(tasks, card)
    limits = _hashed(request.limits, learns=learns)
    settings = json.dumps(
        {"top_k": request.top_k, "limits": limits, "is_sandboxed": request.is_sandboxed}, sort_keys=True
    )
    found = matcher_hash(request.spec, card.version, code.encode(), settings)
    training_set: TrainingSet | PackedTraining | None = None
    result = None
    if learns and not request.train:
        training_set = _packed_training(request.maps, card)
        result = None if training_set is None else Reply(status="ok", learned=training_set.text)
    elif learns:
        training_set = plan_training(
            request.train,
            asked=() if request.is_oracle else request.tasks,
            split=request.split,
            most=request.most_trained,
            lessons=request.lessons,
        )
        text = read_learned(learned_path(_run_folder(request, card, found), training_set.sha256))
        result = None if text is None else Reply(status="ok", learned=text)
    key = None if training_set is None else _key(training_set, result)
    parts = tuple(_part(request, card, found, key, task) for task in tasks)
    return RunPlan(
        request=request,
        card=card,
        hash=found,
        parts=parts,
        learns=learns,
        training_set=training_set,
        training_result=result,
    )


def _check_seen(tasks: Sequence[Task], card: MatcherCard) -> None:
    """Refuse tasks of pictures that nothing has made evidence of, unless the matcher looks at pictures itself."""
    unseen = next((task.folder for task in tasks if task.manifest.frames and not task.manifest.segmenter), None)
    if unseen is not None and "image" not in card.needs:
        raise StoreError(
            f"{unseen} holds pictures and no evidence, and {card.name!r} reads evidence: run sasgeo-bench segment "
            f"--segmenter osm_unet --tasks {unseen} first"
        )


def _hashed(limits: Limits, *, learns: bool) -> dict[str, float]:
    # Hashed only where they differ from the default
    left_out = {name for name in ("scratch_bytes", "processes") if getattr(limits, name) == getattr(Limits(), name)}
    left_out |= set() if learns else {"learn_s"}
    return {name: value for name, value in asdict(limits).items() if name not in left_out}


def with_training_result(plan: RunPlan, result: Reply) -> RunPlan:
    """Return the plan with a training result: only answers given under it count as done. Raise as `plan_run` does."""
    plan = replace(plan, training_result=result)
    parts = tuple(_part(plan.request, plan.card, plan.hash, plan.key, part.task) for part in plan.parts)
    return replace(plan, parts=parts)


def _run_folder(request: RunRequest, card: MatcherCard, found: str) -> Path:
    return request.out / "runs" / card.name / found


def _packed_training(maps: Sequence[UnpackedMap], card: MatcherCard) -> PackedTraining | None:
    """Return what a matcher learned by what is packed with the maps; None where there is nothing for it."""
    found = None
    for one in maps:
        weights = one.about.weights
        text = None if weights is None or weights.matcher != card.name else read_learned(one.learned)
        if weights is None or text is None:
            continue
        if found is not None and found.text != text:
            raise ConfigError(
                f"{one.file} holds other weights of {card.name!r} than the maps before it: run them one by one"
            )
        found = PackedTraining(text=text, places=weights.trained_on, count=weights.pairs)
    return found


def _key(training_set: TrainingSet | PackedTraining, result: Reply | None) -> str:
    text = None if result is None else result.learned
    hashed = f"nothing yet from {training_set.sha256}" if text is None else text
    return hashlib.sha256(hashed.encode()).hexdigest()


def _check(request: RunRequest) -> None:
    index, count = request.shard
    if not 1 <= index <= count:
        raise ConfigError(f"--shard must be i/n with 1 <= i <= n, got {index}/{count}")
    limits = request.limits
    check_jobs(request.jobs)
    numbers = (("--top-k", request.top_k), ("--limit", request.limit))
    for name, value in numbers:
        if value is not None and value < 1:
            raise ConfigError(f"{name} must be at least 1, got {value}")
    if not 1 <= request.most_trained <= MOST_TRAINED:
        raise ConfigError(f"--most-trained must lie between 1 and {MOST_TRAINED}, got {request.most_trained}")
    times = (("--match-s", limits.match_s), ("--prepare-s", limits.prepare_s), ("--learn-s", limits.learn_s))
    for name, seconds in times:
        if not 0 < seconds <= _MOST_S:
            raise ConfigError(f"{name} must be seconds between 0 and {_MOST_S:.0f}, got {seconds:g}")
    _check_sizes(limits)
    if request.top_k > MOST_CANDIDATES:
        raise ConfigError(f"--top-k must be at most {MOST_CANDIDATES}, the bound of an answer, got {request.top_k}")
    strange = next((status for status in request.again if status not in STATUSES), None)
    if strange is not None:
        raise ConfigError(f"--again must be one of {', '.join(STATUSES)}, got {strange!r}")
    if request.dask is not None and request.jobs != 1:
        raise ConfigError("--jobs and --dask both set the number of processes: leave one of them out")


def _check_sizes(limits: Limits) -> None:
    sizes = (("--memory-mb", limits.memory_bytes, _LEAST_MB), ("--scratch-mb", limits.scratch_bytes, 1))
    for name, size_bytes, least_mb in sizes:
        if not least_mb <= size_bytes // _BYTES_PER_MB <= _MOST_MB:
            raise ConfigError(f"{name} must lie between {least_mb} and {_MOST_MB}, got {size_bytes // _BYTES_PER_MB}")


def _card(request: RunRequest) -> tuple[MatcherCard, str, bool]:
    """Return a plugin's card and whether it learns, as its own process reports them, and the hash of its code."""
    if request.spec == ORACLE:
        return CARD, "", False
    worker = Worker(spec=request.spec, reach=reach_of(request, ()), limits=request.limits)
    card, learns = loaded_card(worker, group=MATCHERS, is_oracle=request.is_oracle)
    return card, matcher_code(request.spec), learns


def reach_of(request: RunRequest, regions: Sequence[Path]) -> Reach:
    """Let a matcher read some maps; hide other maps, all queries and truths, and the output of other runs."""
    roots = {root_of(folder) for folder in (*request.tasks, *request.train)} | {request.out.resolve()}
    readable = [region.resolve() for region in regions]
    hidden = hidden_below(sorted(roots))
    # A release next to other output is hidden too, unless its own map is the one in question.
    hidden = [path for path in hidden if not any(region.is_relative_to(path) for region in readable)]
    # Other dates of a place, and the map that a twin was edited from, would reveal the changes.
    # By where they lie: `regions` may be a link to a larger disk.
    maps = {path.resolve() for root in roots for kind in MAPS for path in root.glob(kind) if path.is_dir()}
    hidden += [*sorted(maps - set(readable)), *request.hidden]
    return Reach(readable=readable, hidden=hidden, is_sandboxed=request.is_sandboxed)


def by_map(spec: str, parts: Sequence[RunPart]) -> list[list[RunPart]]:
    """Group tasks that one process may answer: those on the same map, and no other date or edit of its place.

    The control that is given the truth gets that of one task at a time.
    """
    groups: dict[Path, list[RunPart]] = {}
    for part in parts:
        groups.setdefault(part.task.truth if spec == ORACLE else part.region.resolve(), []).append(part)
    return list(groups.values())


def _part(request: RunRequest, card: MatcherCard, found: str, key: str | None, task: Task) -> RunPart:
    """Find the pending queries of a task; refuse folders that hold other answers, and a map built anew since."""
    about = task.manifest
    folder = _run_folder(request, card, found) / about.suite / about.region
    before = RunManifest.open(folder)
    if before is not None and before.hash != found:
        raise StoreError(f"{folder} holds answers of {before.hash or 'an unknown run'}, not of {found}: move it away")
    task.check_queries()
    if about.private_seed is not None and request.out.resolve() != task.root:
        raise ConfigError(
            f"{task.folder} is of a private seed, whose answers stay with it: "
            f"say --out {task.folder.parent.parent.parent}"
        )
    region = _region_of(request, card, task)
    imagery = _rendered_imagery(card, region)
    settings = follower_record(card) if about.is_of_flights else None
    follower = None if settings is None else FollowerRecord(**settings)
    key = dependency_key(key, imagery, None if follower is None else follower.hash)
    asked = {name: answer_hash(one, key) for name, one in task.asked.items()}
    ties = prediction_files.read_ties(folder, since_ns=request.since_ns) if folder.is_dir() else []
    is_same_task = before is not None and before.queries_sha256 == about.queries_sha256
    if not (is_same_task or all(tie.asked for tie in ties)):  # rows of older versions lack the hash of their query
        raise StoreError(
            f"{folder} holds answers of an older version, and not to the queries that {task.folder} holds now: "
            "move it away and run again"
        )
    index, count = request.shard
    unit_of = unit_of_task(about)
    other = (
        set()
        if request.only is None
        else {unit_of(name) for name, one in task.asked.items() if request.only.get(name) != one}
    )
    own = [name for name in asked if _shard_of(unit_of(name), count) == index - 1 and unit_of(name) not in other]
    own = own[: request.limit]
    statuses = {tie.query_id: tie.status for tie in ties if tie.status not in request.again and tie.answers(asked)}
    left = whole_units(own, statuses.keys(), unit_of)
    failed = Counter(statuses[name] for name in set(own) - set(left) if statuses[name] not in SOUND)
    return RunPart(
        task=task,
        folder=folder,
        region=region,
        left=left,
        asked={name: asked[name] for name in left},
        done=len(own) - len(left),
        failed=failed,
        excluded=len({(tie.query_id, tie.asked) for tie in ties if not tie.answers(asked)}),
        imagery=imagery,
        follower=follower,
        key=key,
    )


def _region_of(request: RunRequest, card: MatcherCard, task: Task) -> Path:
    """Return the folder of a task's map: that of a packed one, or the built region."""
    packed = next((one for one in request.maps if _is_of(task, one)), None)
    if packed is None:
        return task.checked_region()
    if "imagery" in card.needs and packed.lacks_imagery:
        raise ConfigError(
            f"{packed.file} was packed without imagery, which {card.name!r} looks at: pack-map --with-imagery"
        )
    return packed.folder


def _is_of(task: Task, packed: UnpackedMap) -> bool:
    return task.manifest.is_of_map(read_manifest(packed.folder))


def _check_maps(maps: Sequence[UnpackedMap], tasks: Sequence[Task]) -> None:
    """Refuse packed maps that no task is on: of another build of a place answers would come from elsewhere."""
    other = next((one for one in maps if not any(_is_of(task, one) for task in tasks)), None)
    if other is not None:
        raise ConfigError(
            f"{other.file}, a map of {other.about.region}, is not what the queries of "
            f"{named([str(task.folder) for task in tasks], 'task')} were made on: pack that build, or leave it out"
        )


def unit_of_task(about: TaskManifest) -> Callable[[str], str]:
    """Return a function from the id of a query to that of what is asked at once: a flight, or the query itself."""
    return flight_id if about.is_of_flights else str


def whole_units(names: Sequence[str], done: AbstractSet[str], unit_of: Callable[[str], str]) -> tuple[str, ...]:
    """Return the queries that are left: a flight of which a view has no answer is asked from its first view on.

    >>> whole_units(["a0", "a1", "b0", "b1"], {"a0", "a1", "b0"}, lambda name: name[0])
    ('b0', 'b1')
    """
    open_units = {unit_of(name) for name in names if name not in done}
    return tuple(name for name in names if unit_of(name) in open_units)


def _rendered_imagery(card: MatcherCard, region: Path) -> str | None:
    """Return the hash of a map's rendered imagery, which is no part of the map's own, if a matcher looks at it."""
    if "imagery" not in card.needs:
        return None
    manifest = read_manifest(region)
    is_rendered = manifest.imagery is not None and manifest.imagery.is_rendered
    return manifest.files[ORTHO].sha256 if is_rendered else None


def _shard_of(query_id: str, count: int) -> int:
    """Return the shard of a query, out of `count`; it depends on the id alone."""
    return int.from_bytes(hashlib.sha256(query_id.encode()).digest()[:8], "big") % count
