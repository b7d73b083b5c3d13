# SPDX-License-Identifier: Apache-2.0
"""What a run is asked to do, and what of it is left."""

import hashlib
import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any, Final

from sasgeo_bench.errors import ConfigError, MatchError, StoreError, counted
from sasgeo_bench.matcher import MatcherCard
from sasgeo_bench.plugins import ORACLE, list_entry_points
from sasgeo_bench.results import STATUSES, matcher_hash
from sasgeo_bench.run.oracle import CARD
from sasgeo_bench.run.worker import Limits, Reach, Worker
from sasgeo_bench.store import rundir, taskdir
from sasgeo_bench.store.regiondir import read_manifest

MOST_LINES: Final = 12  # tasks that are named; the others are counted
_MOST_S: Final = 7 * 86_400.0
_BYTES_PER_MB = 10**6
_LEAST_MB, _MOST_MB = 64, 4_000_000


@dataclass(frozen=True, kw_only=True)
class RunRequest:
    """What is asked for.

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


@dataclass(frozen=True, slots=True, kw_only=True)
class RunPart:
    """One task of a run: its folder of rows, its map, its truths, and the queries that are left to ask.

    `about` is what `task.json` says, `asked` the hash of what is asked by each query that is left
    (`taskdir.read_asked`), and `aside` how many rows of the folder answer other queries than the task holds now.
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


@dataclass(frozen=True, kw_only=True)
class RunPlan:
    """What a run will do, after the plugin's card was read in a process of its own."""

    request: RunRequest
    card: MatcherCard
    hash: str
    parts: tuple[RunPart, ...]

    def to_text(self) -> str:
        """What is left and done in all, and a line for each of the first tasks."""
        lines = [f"{self.card.name} {self.card.version} ({self.hash}), top {self.request.top_k}"]
        lines += [f"  {part.folder}: {_state((part,))}" for part in self.parts[:MOST_LINES]]
        if len(self.parts) > MOST_LINES:
            lines.append(f"  {len(self.parts) - MOST_LINES} more tasks: {_state(self.parts[MOST_LINES:])}")
        if len(self.parts) > 1:
            lines.append(f"  all {len(self.parts)} tasks: {_state(self.parts)}")
        return "\n".join(lines)


def _state(parts: Sequence[RunPart]) -> str:
    """How far some tasks are."""
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
        If the shard or a number makes no sense.
    StoreError
        If a task is missing, of another version, or its map is.
    """
    _check(request)
    if request.dask is not None:  # other processes work in other folders
        request = replace(request, out=request.out.resolve(), tasks=[task.resolve() for task in request.tasks])
    if ":" not in request.spec:
        list_entry_points()  # a clash of names is told here: what the plugin's own process prints is not shown
    tasks = [(folder, taskdir.read_task(folder)) for folder in dict.fromkeys(request.tasks)]
    card, code = _card(request)
    said = {"top_k": request.top_k, "limits": asdict(request.limits), "is_shut_in": request.is_shut_in}
    settings = json.dumps(said, sort_keys=True)
    found = matcher_hash(request.spec, card.version, code.encode(), settings)
    parts = tuple(_part(request, card, found, *task) for task in tasks)
    return RunPlan(request=request, card=card, hash=found, parts=parts)


def _check(request: RunRequest) -> None:
    """Refuse numbers that make no sense."""
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
    for name, seconds in (("--match-s", limits.match_s), ("--prepare-s", limits.prepare_s)):
        if not 0 < seconds <= _MOST_S:
            message = f"{name} must be seconds between 0 and {_MOST_S:.0f}, got {seconds:g}"
            raise ConfigError(message)
    memory_mb = limits.memory_bytes // _BYTES_PER_MB
    if not _LEAST_MB <= memory_mb <= _MOST_MB:
        message = f"--memory-mb must lie between {_LEAST_MB} and {_MOST_MB}, got {memory_mb}"
        raise ConfigError(message)
    strange = next((status for status in request.again if status not in STATUSES), None)
    if strange is not None:
        message = f"--again must be one of {', '.join(STATUSES)}, got {strange!r}"
        raise ConfigError(message)
    if request.dask is not None and request.jobs != 1:
        message = "--jobs and --dask both say how many processes there are: leave one of them out"
        raise ConfigError(message)


def _card(request: RunRequest) -> tuple[MatcherCard, str]:
    """A plugin's card and the hash of its code, told by its own process."""
    if request.spec == ORACLE:
        return CARD, ""
    with Worker(spec=request.spec, reach=reach_of(request, None), limits=request.limits) as worker:
        reply = worker.load()
    if reply.status != "ok" or reply.card is None:
        said = reply.message or "the plugin says nothing of itself"
        raise MatchError(said if request.spec in said else f"{request.spec}: cannot be made ({said})")
    if reply.card.name == ORACLE:
        message = f"{request.spec}: card: {ORACLE!r} is the name of a control of the runner, choose another one"
        raise MatchError(message)
    return reply.card, reply.code


def reach_of(request: RunRequest, region: Path | None) -> Reach:
    """The map may be read; other maps, truths, and whatever other runs wrote, may not."""
    roots = {folder.resolve().parent.parent.parent for folder in request.tasks} | {request.out.resolve()}
    hidden = [root / name for root in sorted(roots) for name in ("truth", "runs", "boards")]
    readable = [] if region is None else [region.resolve()]
    # Other dates of a place, and the map that a twin was edited from, would give the world away.
    maps = sorted(path for root in sorted(roots) for path in (root / "regions").glob("*") if path.is_dir())
    hidden += [path for path in maps if path not in readable]
    return Reach(readable=readable, hidden=hidden, is_shut_in=request.is_shut_in)


def by_map(spec: str, parts: Sequence[RunPart]) -> list[list[RunPart]]:
    """Tasks in groups that one process may answer: those on the same map, and no other date or edit of its place.

    The control that is given the truth is given that of one task at a time.
    """
    groups: dict[Path, list[RunPart]] = {}
    for part in parts:
        groups.setdefault(part.truth if spec == ORACLE else part.region.resolve(), []).append(part)
    return list(groups.values())


def _part(request: RunRequest, card: MatcherCard, found: str, task: Path, about: dict[str, Any]) -> RunPart:
    folder = request.out / "runs" / card.name / found / about["suite"] / about["region"]
    before = rundir.read_run(folder)
    if before is not None and before.get("hash") != found:
        message = f"{folder} holds answers of {before.get('hash')}, not of {found}: move it away"
        raise StoreError(message)
    taskdir.check_queries(task)
    root = task.resolve().parent.parent.parent
    region = root / "regions" / about["region"]
    if not taskdir.is_of_map(about, read_manifest(region)):
        message = f"{region} was built anew since the queries of {task} were made: make them again"
        raise StoreError(message)
    asked = taskdir.read_asked(task)
    ties = rundir.read_ties(folder) if folder.is_dir() else []
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
    folder: Path, ties: Sequence[rundir.Tie], before: Mapping[str, Any] | None, task: Path, about: Mapping[str, Any]
) -> None:
    """Refuse rows that do not say what they answer, unless `run.json` says that it is this very task."""
    is_said = all(tie.asked for tie in ties)
    if not is_said and (before or {}).get("queries_sha256") != about["files"][taskdir.QUERIES]["sha256"]:
        message = (
            f"{folder} holds answers of an older version, and not to the queries that {task} holds now: "
            "move it away and run again"
        )
        raise StoreError(message)


def _shard_of(query_id: str, count: int) -> int:
    """Which of `count` parts a query belongs to; it depends on the id alone."""
    return int.from_bytes(hashlib.sha256(query_id.encode()).digest()[:8], "big") % count
