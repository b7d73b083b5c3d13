# SPDX-License-Identifier: Apache-2.0
"""Plan a run: what was requested, and which queries are pending."""

import hashlib
import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any, Final

from sasgeo_bench.errors import ConfigError, MatchError, StoreError, counted
from sasgeo_bench.matching.learned_file import TrainingRecord, learned_path, read_learned
from sasgeo_bench.matching.matcher import MatcherCard
from sasgeo_bench.matching.plugins import ORACLE, check_card_name, list_entry_points
from sasgeo_bench.matching.results import STATUSES, Status, matcher_hash
from sasgeo_bench.regions.region_files import read_manifest
from sasgeo_bench.running import prediction_files
from sasgeo_bench.running.oracle import CARD
from sasgeo_bench.running.training_tasks import TrainingSet, plan_training
from sasgeo_bench.running.worker import Limits, Reach, Worker
from sasgeo_bench.tasks import task_files
from sasgeo_bench.tasks.split import Split
from sasgeo_bench.tasks.task_rows import asked_under

MOST_LINES: Final = 12  # tasks that are named; the others are counted
MOST_TRAINED: Final = 2000  # pairs that travel to a process at once
_MOST_S: Final = 7 * 86_400.0
_BYTES_PER_MB = 10**6
_HIDDEN: Final = ("tasks", "truth", "runs", "boards", "release", "sheets")  # below a root: they tell truths
_LATER_LIMITS: Final = ("scratch_bytes", "processes")  # they make another run only where somebody changes them
_LEAST_MB, _MOST_MB = 64, 4_000_000


@dataclass(frozen=True, kw_only=True)
class RunRequest:
    """Request for a run.

    Parameters
    ----------
    spec : str
        A matcher's name, or module:Class.
    tasks : sequence of Path
        Task folders, out/tasks/<suite>/<region>.
    out : Path
        Root; rows go to out/runs/<matcher>/<hash>/<suite>/<region>.
    top_k : int
        Poses asked of each query.
    limits : Limits
        What the matcher may take.
    jobs : int
        Processes at once.
    dask : str, optional
        Address of a dask scheduler, or local:N for N processes of this machine; then `jobs` is 1.
    shard : tuple of int
        (i, n), from 1: this run answers the i-th of n parts of the queries.
    limit : int, optional
        Queries of each task at most.
    again : sequence of str
        Statuses whose rows are asked again.
    is_shut_in : bool
        False runs code that is trusted without isolation, and says so.
    train : sequence of Path
        Task folders, with their truths beside them, that a matcher with a `learn` learns from before it is asked; of
        places that are not asked.
    most_trained : int
        Queries to learn from at most: evenly over places, then suites, then sites.
    split : Split, optional
        Says what is one place, and how far from each other places to learn from and places that are asked must lie.
    is_oracle : bool
        Lets it learn from what it is asked, and be named as an oracle: a yardstick, never ranked.
    hidden : sequence of Path
        Files that the matcher must not see besides truths and the like, as that of a private seed.
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
    is_shut_in: bool = True
    train: Sequence[Path] = ()
    most_trained: int = 200
    split: Split | None = None
    is_oracle: bool = False
    hidden: Sequence[Path] = ()


@dataclass(frozen=True, slots=True, kw_only=True)
class RunPart:
    """One task of a run: its folder of rows, its map, its truths, and the queries that are left to ask.

    `about` is what `task.json` says, `asked` the hash of what each query that is left asks (`task_files.read_asked`)
    and of what was learnt, and `aside` how many rows of the folder answer other queries than the task holds now, or
    come of other learning.
    """

    task: Path
    about: Mapping[str, Any]
    folder: Path
    region: Path
    truth: Path
    left: tuple[str, ...]
    asked: Mapping[str, str]
    done: int
    aside: int


@dataclass(frozen=True, slots=True, kw_only=True)
class TrainingResult:
    """Result of training: a text, or the status and one line of cause where there is none."""

    text: str | None = None
    status: Status = "ok"
    message: str = ""


@dataclass(frozen=True, kw_only=True)
class RunPlan:
    """Plan of a run, made after the plugin's card was read in its own process.

    `training_result` is None before training.
    """

    request: RunRequest
    card: MatcherCard
    hash: str
    parts: tuple[RunPart, ...]
    learns: bool = False
    training_set: TrainingSet | None = None
    training_result: TrainingResult | None = None

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
        if self.training_set is None or self.key is None or self.learned_file is None:
            return None
        has_text = self.training_result is not None and self.training_result.text is not None
        file = self.learned_file.relative_to(self.run_folder).as_posix() if has_text else None
        return TrainingRecord(
            key=self.key, file=file, trained_on=self.training_set.places, pairs=self.training_set.count
        )

    def training_lines(self) -> list[str]:
        """Describe the training in a line; no line if none was requested."""
        if self.training_set is not None:
            state = "to be learnt from" if self.training_result is None else "has learnt from"
            return [f"{state} {self.training_set.to_text()}"]
        return ["does not learn: what there is to learn from is passed over"] if self.request.train else []

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
    """Count the pending and finished queries of some tasks."""
    left, done, aside = (sum(column) for column in zip(*((len(x.left), x.done, x.aside) for x in parts), strict=True))
    others = f", {counted(aside, 'answer')} to other queries set aside" if aside else ""
    return f"{counted(left, 'query', 'queries')} left, {done} done{others}"


def plan_run(request: RunRequest) -> RunPlan:
    """Read the card and the tasks, and find out what is left to do.

    Raises
    ------
    MatchError
        If the plugin cannot be loaded or its card is not sound.
    ConfigError
        If the shard or a number makes no sense, or there is nothing to learn from but what is asked (`plan_training`).
    StoreError
        If a task is missing, of another version, or its map is.
    """
    _check(request)
    if request.dask is not None:  # other processes work in other folders
        tasks, train = ([task.resolve() for task in folders] for folders in (request.tasks, request.train))
        request = replace(request, out=request.out.resolve(), tasks=tasks, train=train)
    if ":" not in request.spec:
        list_entry_points()  # a clash of names is told here: what the plugin's own process prints is not shown
    abouts = {folder: task_files.read_task(folder) for folder in request.tasks}
    card, code, learns = _card(request)
    limits = _hashed(request.limits, learns=learns)
    said = {"top_k": request.top_k, "limits": limits, "is_shut_in": request.is_shut_in}
    settings = json.dumps(said, sort_keys=True)
    found = matcher_hash(request.spec, card.version, code.encode(), settings)
    training_set = result = None
    if learns and request.train:
        apart = () if request.is_oracle else request.tasks
        training_set = plan_training(request.train, asked=apart, split=request.split, most=request.most_trained)
        text = read_learned(learned_path(_run_folder(request, card, found), training_set.sha256))
        result = None if text is None else TrainingResult(text=text)
    key = None if training_set is None else _key(training_set, result)
    parts = tuple(_part(request, card, found, key, *item) for item in abouts.items())
    return RunPlan(
        request=request,
        card=card,
        hash=found,
        parts=parts,
        learns=learns,
        training_set=training_set,
        training_result=result,
    )


def _hashed(limits: Limits, *, learns: bool) -> dict[str, float]:
    """Limits that make a run another one."""
    passed = {name for name in _LATER_LIMITS if getattr(limits, name) == getattr(Limits(), name)}
    passed |= set() if learns else {"learn_s"}
    return {name: value for name, value in asdict(limits).items() if name not in passed}


def with_training_result(plan: RunPlan, result: TrainingResult) -> RunPlan:
    """The same plan with what came of learning: only answers under it are done.

    Parameters
    ----------
    plan : RunPlan
        One with a training_set.
    result : TrainingResult
        What came of it.

    Raises
    ------
    StoreError
        As `plan_run` does.
    """
    plan = replace(plan, training_result=result)
    parts = tuple(_part(plan.request, plan.card, plan.hash, plan.key, part.task, part.about) for part in plan.parts)
    return replace(plan, parts=parts)


def _run_folder(request: RunRequest, card: MatcherCard, found: str) -> Path:
    return request.out / "runs" / card.name / found


def _key(training_set: TrainingSet, result: TrainingResult | None) -> str:
    """Hash of the text that was learnt; where there is none, of what it was to be learnt from."""
    text = None if result is None else result.text
    said = f"nothing yet from {training_set.sha256}" if text is None else text
    return hashlib.sha256(said.encode()).hexdigest()


def _check(request: RunRequest) -> None:
    """Refuse numbers out of range."""
    index, count = request.shard
    if not 1 <= index <= count:
        message = f"--shard must be i/n with 1 <= i <= n, got {index}/{count}"
        raise ConfigError(message)
    limits = request.limits
    numbers = (("--jobs", request.jobs), ("--top-k", request.top_k), ("--limit", request.limit))
    for name, value in numbers:
        if value is not None and value < 1:
            message = f"{name} must be at least 1, got {value}"
            raise ConfigError(message)
    if not 1 <= request.most_trained <= MOST_TRAINED:
        message = f"--most-trained must lie between 1 and {MOST_TRAINED}, got {request.most_trained}"
        raise ConfigError(message)
    times = (("--match-s", limits.match_s), ("--prepare-s", limits.prepare_s), ("--learn-s", limits.learn_s))
    for name, seconds in times:
        if not 0 < seconds <= _MOST_S:
            message = f"{name} must be seconds between 0 and {_MOST_S:.0f}, got {seconds:g}"
            raise ConfigError(message)
    _check_sizes(limits)
    strange = next((status for status in request.again if status not in STATUSES), None)
    if strange is not None:
        message = f"--again must be one of {', '.join(STATUSES)}, got {strange!r}"
        raise ConfigError(message)
    if request.dask is not None and request.jobs != 1:
        message = "--jobs and --dask both say how many processes there are: leave one of them out"
        raise ConfigError(message)


def _check_sizes(limits: Limits) -> None:
    sizes = (("--memory-mb", limits.memory_bytes, _LEAST_MB), ("--scratch-mb", limits.scratch_bytes, 1))
    for name, size_bytes, least_mb in sizes:
        if not least_mb <= size_bytes // _BYTES_PER_MB <= _MOST_MB:
            message = f"{name} must lie between {least_mb} and {_MOST_MB}, got {size_bytes // _BYTES_PER_MB}"
            raise ConfigError(message)


def _card(request: RunRequest) -> tuple[MatcherCard, str, bool]:
    """A plugin's card, the hash of its code, and whether it learns, told by its own process."""
    if request.spec == ORACLE:
        return CARD, "", False
    with Worker(spec=request.spec, reach=reach_of(request, ()), limits=request.limits) as worker:
        reply = worker.load()
    if reply.status != "ok" or reply.card is None:
        said = reply.message or "the plugin says nothing of itself"
        raise MatchError(said if request.spec in said else f"{request.spec}: cannot be made ({said})")
    check_card_name(request.spec, reply.card.name, is_oracle=request.is_oracle)
    return reply.card, reply.code, reply.learns


def reach_of(request: RunRequest, regions: Sequence[Path]) -> Reach:
    """Some maps may be read; other maps, all queries, truths, and whatever other runs wrote, may not."""
    folders = (*request.tasks, *request.train)
    roots = {folder.resolve().parent.parent.parent for folder in folders} | {request.out.resolve()}
    readable = [region.resolve() for region in regions]
    hidden = [root / name for root in sorted(roots) for name in _HIDDEN]
    # A release that lies where others are written is hidden too, unless it is itself what is run on.
    hidden = [path for path in hidden if not any(region.is_relative_to(path) for region in readable)]
    # Other dates of a place, and the map that a twin was edited from, would give the world away.
    maps = sorted(path for root in sorted(roots) for path in (root / "regions").glob("*") if path.is_dir())
    hidden += [*(path for path in maps if path not in readable), *request.hidden]
    return Reach(readable=readable, hidden=hidden, is_shut_in=request.is_shut_in)


def by_map(spec: str, parts: Sequence[RunPart]) -> list[list[RunPart]]:
    """Tasks in groups that one process may answer: those on the same map, and no other date or edit of its place.

    The control that is given the truth is given that of one task at a time.
    """
    groups: dict[Path, list[RunPart]] = {}
    for part in parts:
        groups.setdefault(part.truth if spec == ORACLE else part.region.resolve(), []).append(part)
    return list(groups.values())


def _part(
    request: RunRequest, card: MatcherCard, found: str, key: str | None, task: Path, about: Mapping[str, Any]
) -> RunPart:
    folder = _run_folder(request, card, found) / about["suite"] / about["region"]
    before = prediction_files.read_run(folder)
    if before is not None and before.get("hash") != found:
        message = f"{folder} holds answers of {before.get('hash')}, not of {found}: move it away"
        raise StoreError(message)
    task_files.check_queries(task)
    root = task.resolve().parent.parent.parent
    if task_files.PRIVATE in about and request.out.resolve() != root:
        message = f"{task} is of a private seed, whose answers stay beside it: say --out {task.parent.parent.parent}"
        raise ConfigError(message)
    region = root / "regions" / about["region"]
    if not task_files.is_of_map(about, read_manifest(region)):
        message = f"{region} was built anew since the queries of {task} were made: make them again"
        raise StoreError(message)
    asked = {name: asked_under(said, key) for name, said in task_files.read_asked(task).items()}
    ties = prediction_files.read_ties(folder) if folder.is_dir() else []
    _check_old(folder, ties, before, task, about)
    index, count = request.shard
    mine = [name for name in asked if _shard_of(name, count) == index - 1]
    mine = mine if request.limit is None else mine[: request.limit]
    done = {tie.query_id for tie in ties if tie.status not in request.again and tie.answers(asked)}
    left = tuple(name for name in mine if name not in done)
    return RunPart(
        task=task,
        about=about,
        folder=folder,
        region=region,
        truth=root / "truth" / about["suite"] / about["region"],
        left=left,
        asked={name: asked[name] for name in left},
        done=len(mine) - len(left),
        aside=len({(tie.query_id, tie.asked) for tie in ties if not tie.answers(asked)}),
    )


def _check_old(
    folder: Path,
    ties: Sequence[prediction_files.Tie],
    before: Mapping[str, Any] | None,
    task: Path,
    about: Mapping[str, Any],
) -> None:
    """Refuse rows that do not say what they answer, unless `run.json` says that it is this very task."""
    is_said = all(tie.asked for tie in ties)
    if not is_said and (before or {}).get("queries_sha256") != about["files"][task_files.QUERIES]["sha256"]:
        message = (
            f"{folder} holds answers of an older version, and not to the queries that {task} holds now: "
            "move it away and run again"
        )
        raise StoreError(message)


def _shard_of(query_id: str, count: int) -> int:
    """Return the shard of a query, out of `count`; it depends on the id alone."""
    return int.from_bytes(hashlib.sha256(query_id.encode()).digest()[:8], "big") % count
