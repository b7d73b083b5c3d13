# SPDX-License-Identifier: Apache-2.0
"""A matcher over tasks: whatever happens, a row for every query, and a run that goes on where it was cut off."""

import hashlib
import json
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, Final

from sasgeo_bench.errors import ConfigError, MatchError, StoreError
from sasgeo_bench.matcher import MatcherCard, check_match, lacks
from sasgeo_bench.query import Query
from sasgeo_bench.region import ATTRIBUTION, LICENCE
from sasgeo_bench.results import STATUSES, Prediction, matcher_hash, one_line
from sasgeo_bench.run.worker import Limits, Reach, Reply, Worker
from sasgeo_bench.store import rundir, taskdir
from sasgeo_bench.store.regiondir import locked, read_manifest

PART_ROWS: Final = 64
PART_S: Final = 1.0  # rows wait no longer than this to be written: what a kill loses
TOLD_S: Final = 10.0
_MOST_S: Final = 7 * 86_400.0
_LEAST_BYTES, _MOST_BYTES = 64 * 2**20, 2**42

Tell = Callable[[str], None]


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
    shard: tuple[int, int] = (1, 1)
    limit: int | None = None
    again: Sequence[str] = ()
    is_shut_in: bool = True


@dataclass(frozen=True, slots=True, kw_only=True)
class RunPart:
    """One task of a run: its folder of rows, and the queries that are left to ask."""

    task: Path
    folder: Path
    region: Path
    left: tuple[str, ...]
    done: int


@dataclass(frozen=True, kw_only=True)
class RunPlan:
    """What a run will do, after the plugin's card was read in a process of its own."""

    request: RunRequest
    card: MatcherCard
    hash: str
    isolation: dict[str, str]
    parts: tuple[RunPart, ...]

    def to_text(self) -> str:
        """A line for each task."""
        lines = [f"{self.card.name} {self.card.version} ({self.hash}), top {self.request.top_k}"]
        lines += [f"  {part.folder}: {len(part.left)} queries left, {part.done} done" for part in self.parts]
        return "\n".join(lines)


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
    if not _LEAST_BYTES <= limits.memory_bytes <= _MOST_BYTES:
        allowed = f"between {_LEAST_BYTES >> 20} and {_MOST_BYTES >> 20}"
        message = f"--memory-mb must lie {allowed}, got {limits.memory_bytes >> 20}"
        raise ConfigError(message)
    strange = next((status for status in request.again if status not in STATUSES), None)
    if strange is not None:
        message = f"--again must be one of {', '.join(STATUSES)}, got {strange!r}"
        raise ConfigError(message)
    tasks = [_task(folder) for folder in request.tasks]
    with Worker(spec=request.spec, reach=_reach(request, None), limits=request.limits) as worker:
        reply = worker.load()
        if reply.status != "ok" or reply.card is None:
            raise MatchError(reply.message or f"{request.spec}: the plugin says nothing of itself")
        card, code, isolation = reply.card, reply.code, dict(worker.isolation)
    settings = json.dumps({"top_k": request.top_k, "limits": asdict(limits)}, sort_keys=True)
    found = matcher_hash(request.spec, card.version, code.encode(), settings)
    parts = tuple(_part(request, card, found, *task) for task in tasks)
    return RunPlan(request=request, card=card, hash=found, isolation=isolation, parts=parts)


def _task(folder: Path) -> tuple[Path, dict[str, Any]]:
    about = taskdir.read_task(folder)
    return folder, about


def _reach(request: RunRequest, region: Path | None) -> Reach:
    """The map may be read; truths, and whatever other runs wrote, may not."""
    roots = {folder.resolve().parent.parent.parent for folder in request.tasks} | {request.out.resolve()}
    hidden = [root / name for root in sorted(roots) for name in ("truth", "runs", "boards")]
    readable = [] if region is None else [region.resolve()]
    return Reach(readable=readable, hidden=hidden, is_shut_in=request.is_shut_in)


def _part(request: RunRequest, card: MatcherCard, found: str, task: Path, about: dict[str, Any]) -> RunPart:
    folder = request.out / "runs" / card.name / found / about["suite"] / about["region"]
    before = rundir.read_run(folder)
    now = about["files"][taskdir.QUERIES]["sha256"]
    if before is not None and before.get("queries_sha256") != now:
        message = (
            f"{folder} holds answers to other queries than {task} does now: move it away, or make the old queries again"
        )
        raise StoreError(message)
    region = task.resolve().parent.parent.parent / "regions" / about["region"]
    if read_manifest(region).fingerprint != about["map_fingerprint"]:
        message = f"{region} was built anew since the queries of {task} were made: make them again"
        raise StoreError(message)
    ids = taskdir.read_ids(task)
    index, count = request.shard
    mine = [name for name in ids if _shard_of(name, count) == index - 1]
    mine = mine if request.limit is None else mine[: request.limit]
    done = rundir.ids_done(folder, again=request.again) if folder.is_dir() else set()
    left = tuple(name for name in mine if name not in done)
    return RunPart(task=task, folder=folder, region=region, left=left, done=len(mine) - len(left))


def _shard_of(query_id: str, count: int) -> int:
    """Which of `count` parts a query belongs to; it depends on the id alone."""
    return int.from_bytes(hashlib.sha256(query_id.encode()).digest()[:8], "big") % count


@dataclass(frozen=True, slots=True, kw_only=True)
class RunReport:
    """How many rows of which status a run has added."""

    counts: dict[str, int]
    folders: tuple[Path, ...]


def run(plan: RunPlan, *, tell: Tell) -> RunReport:
    """Ask everything that is left.

    Parameters
    ----------
    plan : RunPlan
        From `plan_run`.
    tell : callable
        Gets a line now and then.

    Returns
    -------
    RunReport
        What was added.
    """
    counts: dict[str, int] = {}
    for part in plan.parts:
        if not part.left:
            tell(f"{part.folder}: nothing left, {part.done} done")
            continue
        with locked(part.folder, tell=tell):
            _run_part(plan, part, counts, tell)
    return RunReport(counts=counts, folders=tuple(part.folder for part in plan.parts))


def _run_part(plan: RunPlan, part: RunPart, counts: dict[str, int], tell: Tell) -> None:
    """Ask the queries of one task, by as many processes as are wanted."""
    writer = _Writer(part.folder, total=len(part.left), tell=tell)
    questions = _Questions(part.task, part.left)
    jobs = min(plan.request.jobs, len(part.left))
    workers = [
        Worker(spec=plan.request.spec, reach=_reach(plan.request, part.region), limits=plan.request.limits)
        for _ in range(jobs)
    ]
    _say(plan, part, workers, {})
    try:
        with ThreadPoolExecutor(max_workers=jobs) as pool:
            costs = list(pool.map(lambda worker: _ask_all(plan, part, worker, questions, writer), workers))
    finally:
        questions.stop()
        writer.flush()
    _say(plan, part, workers, costs[0])
    for status, count in writer.counts.items():
        counts[status] = counts.get(status, 0) + count


def _say(plan: RunPlan, part: RunPart, workers: Sequence[Worker], cost: dict[str, Any]) -> None:
    """Write `run.json`."""
    about = taskdir.read_task(part.task)
    rundir.write_run(
        part.folder,
        {
            "schema_version": rundir.SCHEMA_VERSION,
            "matcher": asdict(plan.card),
            "spec": plan.request.spec,
            "hash": plan.hash,
            "suite": about["suite"],
            "region": about["region"],
            "task_version": about["task_version"],
            "queries_sha256": about["files"][taskdir.QUERIES]["sha256"],
            "map_fingerprint": about["map_fingerprint"],
            "top_k": plan.request.top_k,
            "limits": asdict(plan.request.limits),
            "isolation": plan.isolation or {"files": "trusted code, not shut in"},
            "warm_up": "one query of each process is asked twice and timed the second time",
            "map_bytes": sum(path.stat().st_size for path in part.region.iterdir() if path.is_file()),
            "peak_bytes": max((worker.peak_bytes for worker in workers), default=0),
            **cost,
            "licence": LICENCE,
            "attribution": ATTRIBUTION,
        },
    )


def _ask_all(
    plan: RunPlan, part: RunPart, worker: Worker, questions: "_Questions", writer: "_Writer"
) -> dict[str, Any]:
    """One process: prepare, then query after query."""
    with worker:
        ready = worker.prepare(part.region)
        is_warm = False
        for query, blob in questions:
            reason = lacks(plan.card, query)
            if reason is not None:
                writer.add(Prediction(query_id=query.query_id, status="not applicable", message=reason))
                continue
            reply = ready
            if ready.status == "ok":
                if not is_warm:
                    worker.match(blob, top_k=plan.request.top_k)
                    is_warm = True
                reply = worker.match(blob, top_k=plan.request.top_k)
            writer.add(_prediction(query, reply, plan.request.top_k))
    return {"prepare_s": ready.seconds, "index_bytes": ready.grown_bytes}


def _prediction(query: Query, reply: Reply, top_k: int) -> Prediction:
    """A row out of a reply, checked once more on this side."""
    if reply.status != "ok":
        return Prediction(query_id=query.query_id, status=reply.status, message=reply.message)
    if reply.match is None:
        return Prediction(query_id=query.query_id, status="invalid", message="no answer in an answer")
    try:
        match = check_match(reply.match, query, top_k=top_k)
    except MatchError as error:
        return Prediction(query_id=query.query_id, status="invalid", message=one_line(str(error)))
    return Prediction(
        query_id=query.query_id,
        candidates=tuple(zip(match.poses, match.scores, strict=True)),
        confidence=match.confidence,
        diagnostics=match.diagnostics,
        latency_s=reply.seconds,
    )


class _Questions:
    """The queries that are left, one at a time to whoever asks; a row group in memory."""

    def __init__(self, task: Path, left: Sequence[str]) -> None:
        self._lock = threading.Lock()
        self._rows = taskdir.read_some(task, frozenset(left))
        self._is_stopped = False

    def __iter__(self) -> Iterator[tuple[Query, bytes]]:
        """Give each query to one of those that ask."""
        while True:
            with self._lock:
                if self._is_stopped:
                    return
                item = next(self._rows, None)
            if item is None:
                return
            yield item

    def stop(self) -> None:
        """Give nothing more."""
        self._is_stopped = True


class _Writer:
    """Rows of one task: gathered, written a part at a time, counted, and told of."""

    def __init__(self, folder: Path, *, total: int, tell: Tell) -> None:
        self.counts: dict[str, int] = {}
        self._folder, self._total, self._tell = folder, total, tell
        self._lock = threading.Lock()
        self._rows: list[Prediction] = []
        self._begun = self._written = self._told = time.monotonic()

    def add(self, prediction: Prediction) -> None:
        """Take a row."""
        with self._lock:
            self._rows.append(prediction)
            self.counts[prediction.status] = self.counts.get(prediction.status, 0) + 1
            now = time.monotonic()
            if len(self._rows) >= PART_ROWS or now - self._written > PART_S:
                self._write()
            if now - self._told > TOLD_S:
                self._told = now
                done = sum(self.counts.values())
                rate = done / (now - self._begun)
                left_s = (self._total - done) / rate
                self._tell(f"{self._folder}: {done} of {self._total}, {rate:.1f} a second, {left_s:.0f} s left")

    def flush(self) -> None:
        """Write what is left."""
        with self._lock:
            self._write()

    def _write(self) -> None:
        if self._rows:
            rundir.write_part(self._folder, self._rows)
        self._rows = []
        self._written = time.monotonic()
