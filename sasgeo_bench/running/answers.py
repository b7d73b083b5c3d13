# SPDX-License-Identifier: Apache-2.0
"""Queries of some tasks -> rows in their run folders; a process answers all tasks that search its map."""

import threading
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from contextlib import ExitStack
from dataclasses import dataclass, field
from functools import partial
from typing import Final, Generic, TypeVar

from sasgeo_bench.bounds import one_line
from sasgeo_bench.errors import MatchError, StoreError
from sasgeo_bench.matching.matcher import check_match, lacks
from sasgeo_bench.matching.plugins import ORACLE
from sasgeo_bench.matching.results import Prediction
from sasgeo_bench.regions.region_files import check_files, read_manifest
from sasgeo_bench.running import prediction_files
from sasgeo_bench.running.oracle import Oracle
from sasgeo_bench.running.plan import RunPart, RunPlan, by_map, reach_of
from sasgeo_bench.running.replies import Reply
from sasgeo_bench.running.sandbox import PROMISES, joined
from sasgeo_bench.running.training import failed_by_us, guarded
from sasgeo_bench.running.worker import Worker
from sasgeo_bench.tasks import task_files
from sasgeo_bench.tasks.query import Query
from sasgeo_bench.tasks.task_rows import asked_under

Item = TypeVar("Item")

# Help begins with a start and a map to prepare: 1.6 s of a core, or far more. While nobody knows what a query takes,
# 10 ms or 10 s, fewer than this for each process are not worth one; chunks for a cluster are no smaller either.
LEAST_ITEMS: Final = 8


def pays(*, left: int, askers: int, start_s: float, pace_s: float | None) -> bool:
    """True if one more process is worth its start: its share of the queries must take at least as long.

    Parameters
    ----------
    left : int
        Queries that nobody was given yet.
    askers : int
        Processes that work on them.
    start_s : float
        What the start of a process takes, the map included.
    pace_s : float or None
        What a query takes; None while nobody knows, and the share must then be of `LEAST_ITEMS` queries.

    Examples
    --------
    >>> pays(left=40, askers=1, start_s=2.0, pace_s=0.01), pays(left=40, askers=1, start_s=2.0, pace_s=1.0)
    (False, True)
    """
    share = left / (askers + 1)
    return share >= LEAST_ITEMS if pace_s is None else share * pace_s >= start_s


class Schedule(Generic[Item]):
    """Queries of several maps, for some threads to share out among them.

    Parameters
    ----------
    lines : sequence of tuple of iterator and int
        For each map its queries, and how many these are.
    clock : callable
        Seconds.

    Examples
    --------
    >>> schedule = Schedule([(iter("ab"), 2), (iter("c"), 1)])
    >>> while (number := schedule.take()) is not None:
    ...     print(number, *schedule.items(number))
    0 a b
    1 c
    """

    def __init__(
        self, lines: Sequence[tuple[Iterator[Item], int]], *, clock: Callable[[], float] = time.monotonic
    ) -> None:
        self._lines = [_Line(items, count) for items, count in lines]
        self._clock = clock
        self._changed = threading.Condition()
        self._is_stopped = False

    @property
    def is_stopped(self) -> bool:
        """True if no more work is given."""
        return self._is_stopped

    def take(self) -> int | None:
        """The map to work on next, or None when nothing is left; waits as long as nobody knows whether help pays."""
        with self._changed:
            while not self._is_stopped:
                line = next((line for line in self._lines if line.askers == 0), None) or self._in_need()
                if line is not None:
                    line.askers += 1
                    return self._lines.index(line)
                if not any(line.left for line in self._lines):
                    return None
                self._changed.wait()
        return None

    def _in_need(self) -> "_Line[Item] | None":
        """Return the map where help pays and that has most pending queries per worker."""
        in_need = (line for line in self._lines if line.pays())
        return max(in_need, key=lambda line: line.left / (line.askers + 1), default=None)

    def items(self, number: int) -> Iterator[Item]:
        """Queries of a map, each to one of those who ask; the time until the next one is asked for is noted."""
        line, is_first = self._lines[number], True
        while not self._is_stopped:
            item = line.draw()
            if item is None:
                break
            begun = self._clock()
            yield item
            with self._changed:
                line.note(self._clock() - begun, is_first=is_first)
                self._changed.notify_all()
            is_first = False
        with self._changed:
            self._changed.notify_all()

    def wait_for_stop(self, seconds: float) -> bool:
        """True if no more work is given, now or within some seconds."""
        with self._changed:
            return self._changed.wait_for(lambda: self._is_stopped, timeout=seconds)

    def stop(self) -> None:
        """Give no more work, and wake all waiting threads."""
        with self._changed:
            self._is_stopped = True
            self._changed.notify_all()


class _Line(Generic[Item]):
    """Queries of one map, and what is known of the time they take."""

    def __init__(self, items: Iterator[Item], count: int) -> None:
        self.left = count
        self.askers = 0
        self._items = items
        self._lock = threading.Lock()
        self._start_s = 0.0
        self._spent_s, self._count = 0.0, 0

    def draw(self) -> Item | None:
        """The next one; None when there is none."""
        with self._lock:
            item = next(self._items, None)
            self.left = 0 if item is None else self.left - 1
            return item

    def note(self, seconds: float, *, is_first: bool) -> None:
        """Take note of what one took; the first of a process takes its start too and says nothing of the pace."""
        if is_first:
            self._start_s = max(self._start_s, seconds)
        else:
            self._spent_s, self._count = self._spent_s + seconds, self._count + 1

    def pays(self) -> bool:
        """True if help is worth its start."""
        pace_s = self._spent_s / self._count if self._count else None
        return self.left > 0 and pays(left=self.left, askers=self.askers, start_s=self._start_s, pace_s=pace_s)


PART_ROWS: Final = 64
PART_S: Final = 1.0  # rows wait no longer than this to be written: what a kill loses


Question = tuple["_Writer", Query, bytes]


@dataclass(frozen=True, slots=True, kw_only=True)
class Cost:
    """Cost of some rows: time, memory, counts.

    Parameters
    ----------
    counts : dict of str to int
        Rows by status.
    prepare_s, index_bytes : float and int, optional
        Of one map: seconds, and by how much the memory of the process grew; None where no map could be prepared.
    cpu_s : float
        Processor seconds inside of `match`, all queries together.
    peak_bytes : int
        Most memory that a matcher's process and all that came from it held at once, in whatever task of its map.
    isolation : dict of str to str
        How the matcher was shut in.
    messages : dict of str to str
        By status, what the first row without an answer said.
    """

    counts: dict[str, int] = field(default_factory=dict)
    prepare_s: float | None = None
    index_bytes: int | None = None
    cpu_s: float = 0.0
    peak_bytes: int = 0
    isolation: dict[str, str] = field(default_factory=dict)
    messages: dict[str, str] = field(default_factory=dict)


def pool_costs(costs: Sequence[Cost]) -> Cost:
    """Several costs as one: counts and processor seconds added, the largest of the others, every isolation there was.

    Examples
    --------
    >>> pool_costs([Cost(counts={"ok": 2}, prepare_s=1.0), Cost(counts={"ok": 1}, prepare_s=3.0)]).counts
    {'ok': 3}
    """
    counts: dict[str, int] = {}
    messages: dict[str, str] = {}
    for cost in costs:
        messages = cost.messages | messages
        for status, count in cost.counts.items():
            counts[status] = counts.get(status, 0) + count
    return Cost(
        counts=counts,
        prepare_s=max((cost.prepare_s for cost in costs if cost.prepare_s is not None), default=None),
        index_bytes=max((cost.index_bytes for cost in costs if cost.index_bytes is not None), default=None),
        cpu_s=sum(cost.cpu_s for cost in costs),
        peak_bytes=max((cost.peak_bytes for cost in costs), default=0),
        isolation=joined(cost.isolation for cost in costs),
        messages=messages,
    )


class Watch:
    """Observer of the progress of tasks, called by several threads at once; this one does nothing.

    Examples
    --------
    >>> isinstance(Watch(), Watch)
    True
    """

    def begin(self, part: RunPart) -> None:
        """Record that a task has begun."""

    def advance(self, part: RunPart) -> None:
        """Record that one more query has a row."""

    def end(self, part: RunPart, cost: Cost) -> None:
        """Record that all rows are written, and their cost."""


def answer(plan: RunPlan, parts: Sequence[RunPart], *, jobs: int, watch: Watch) -> Cost:
    """Ask what is left of some tasks, by as many processes as are wanted, and write the rows.

    Parameters
    ----------
    plan : RunPlan
        From `plan_run`.
    parts : sequence of RunPart
        The tasks. Those that search one map share processes; no process has more than one map.
    jobs : int
        Processes at once.
    watch : Watch
        Is told of each task and each row.

    Returns
    -------
    Cost
        What it took.

    Raises
    ------
    StoreError
        If rows cannot be written; those that were stay.
    """
    groups = [[_Writer(part, watch=watch) for part in group] for group in by_map(plan.request.spec, parts)]
    maps = [_Map(plan, group) for group in groups]
    writers = [writer for group in groups for writer in group]
    schedule = Schedule([(place.questions(), place.count) for place in maps])
    threads = min(jobs, sum(place.count for place in maps))
    with ExitStack() as ends:
        for writer in writers:
            ends.callback(writer.end)
        with ThreadPoolExecutor(max_workers=threads + 1) as pool:
            try:
                writing = pool.submit(_write_in_time, writers, schedule)
                for asking in as_completed([pool.submit(_ask_all, schedule, maps) for _ in range(threads)]):
                    asking.result()
            finally:
                schedule.stop()  # before the pool waits for its threads: each ends with the query it is at
            writing.result()
    return pool_costs([writer.cost for writer in writers])


def _ask_all(schedule: Schedule[Question], maps: Sequence["_Map"]) -> None:
    """One thread: map after map, each by a process of its own."""
    while (number := schedule.take()) is not None:
        maps[number].ask(schedule, number)


def _write_in_time(writers: Sequence["_Writer"], schedule: Schedule[Question]) -> None:
    """Write rows now and then; a failure to write stops the run."""
    try:
        while not schedule.wait_for_stop(PART_S):
            for writer in writers:
                writer.flush()
    finally:
        schedule.stop()


class _Map:
    """A map and the tasks that search it."""

    def __init__(self, plan: RunPlan, writers: Sequence["_Writer"]) -> None:
        self.count = sum(len(writer.part.left) for writer in writers)
        self._plan, self._writers = plan, writers

    def questions(self) -> Iterator[Question]:
        """Query after query, task after task, each with where its row goes; a row group in memory."""
        for writer in self._writers:
            writer.begin()
            for query, blob, asked in task_files.read_some(writer.part.task, frozenset(writer.part.left)):
                if writer.part.asked[query.query_id] != asked_under(asked, self._plan.key):
                    message = f"{writer.part.task} was made anew while it was asked: run again, answers are kept"
                    raise StoreError(message)
                yield writer, query, blob

    def ask(self, schedule: Schedule[Question], number: int) -> None:
        """One process: prepare with the first query, then answer one after the other."""
        top_k, ready, is_warm = self._plan.request.top_k, self._unlearned(), False
        with self._asked() as worker:
            for writer, query, blob in schedule.items(number):
                if ready is None:
                    result = self._plan.training_result
                    region, text = self._writers[0].part.region, None if result is None else result.text
                    ready = guarded(self._plan, partial(worker.prepare, region, text))
                    self._check_map(ready)
                    if schedule.is_stopped:
                        return
                if self._unlearned() is None:
                    writer.told_by(worker, ready)
                reason = lacks(self._plan.card, query, is_taught=self._plan.training_set is not None)
                if reason is not None:
                    writer.add(Prediction(query_id=query.query_id, status="not applicable", message=reason))
                    continue
                reply = ready
                if ready.status == "ok":
                    ask = partial(worker.match, blob, top_k=top_k)
                    if not is_warm:
                        guarded(self._plan, ask)
                        is_warm = True
                    reply = guarded(self._plan, ask)
                writer.add(self._row(query, reply), cpu_s=reply.cpu_s)

    def _row(self, query: Query, reply: Reply) -> Prediction:
        """Make a row of a reply, checked again on this side."""
        try:
            return _prediction(query, reply, self._plan.request.top_k)
        except Exception as error:  # noqa: BLE001 - whatever is made of an answer costs its own row
            failed = failed_by_us(self._plan, error)
            return Prediction(query_id=query.query_id, status=failed.status, message=failed.message)

    def _unlearned(self) -> Reply | None:
        """Return the reply to every query after a failed training; starts no process."""
        result = self._plan.training_result
        if result is None or result.text is not None:
            return None
        return Reply(status=result.status, message=result.message)

    def _check_map(self, ready: Reply) -> None:
        """Refuse a map that another run has replaced since, or that is damaged: no failure of whoever prepared it."""
        part = self._writers[0].part
        if not task_files.is_of_map(part.about, read_manifest(part.region)):
            message = f"{part.region} was built anew while it was searched: run again, answers are kept"
            raise StoreError(message)
        if ready.status != "ok":
            check_files(part.region)

    def _asked(self) -> Worker | Oracle:
        """Return what answers: a plugin in its own process, or the control that is given the truth."""
        request, part = self._plan.request, self._writers[0].part
        if request.spec == ORACLE:
            return Oracle(part.truth)
        return Worker(spec=request.spec, reach=reach_of(request, (part.region,)), limits=request.limits)


def _prediction(query: Query, reply: Reply, top_k: int) -> Prediction:
    """Make a row of a reply, checked against the query."""
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
        matcher_s=reply.own_s,
    )


class _Writer:
    """Rows of one task: gathered, counted, and written a part at a time; and what they took."""

    def __init__(self, part: RunPart, *, watch: Watch) -> None:
        self.part = part
        self._watch = watch
        self._lock = threading.RLock()
        self._rows: list[Prediction] = []
        self._counts: dict[str, int] = {}
        self._messages: dict[str, str] = {}
        self._cpu_s = 0.0
        self._askers: dict[int, tuple[Worker | Oracle, Reply]] = {}
        self._is_open = False

    def begin(self) -> None:
        """Begin to collect rows."""
        self._watch.begin(self.part)
        self._is_open = True

    def told_by(self, worker: Worker | Oracle, ready: Reply) -> None:
        """Take note of who answers, and of what came of the map there."""
        with self._lock:
            self._askers[id(worker)] = (worker, ready)

    def add(self, prediction: Prediction, *, cpu_s: float = 0.0) -> None:
        """Take a row; with the last one the task is at its end."""
        with self._lock:
            self._rows.append(prediction)
            self._cpu_s += cpu_s
            self._counts[prediction.status] = self._counts.get(prediction.status, 0) + 1
            if prediction.message:
                self._messages.setdefault(prediction.status, prediction.message)
            if len(self._rows) >= PART_ROWS:
                self.flush()
            self._watch.advance(self.part)
            if sum(self._counts.values()) == len(self.part.left):
                self.end()

    def flush(self) -> None:
        """Write the rows collected so far."""
        with self._lock:
            if self._rows:
                prediction_files.write_part(self.part.folder, self._rows, asked=self.part.asked)
            self._rows = []

    def end(self) -> None:
        """Write what is left and say what it took; a second time, or where nothing was begun, nothing."""
        with self._lock:
            self.flush()
            if self._is_open:
                self._is_open = False
                self._watch.end(self.part, self.cost)

    @property
    def cost(self) -> Cost:
        """Cost of the rows so far and of their processes."""
        with self._lock:
            own = Cost(counts=dict(self._counts), cpu_s=self._cpu_s, messages=dict(self._messages))
            return pool_costs([own, *(_process_cost(*asker) for asker in self._askers.values())])


def _process_cost(worker: Worker | Oracle, ready: Reply) -> Cost:
    """Cost that a process reported for its map and for itself."""
    return Cost(
        prepare_s=ready.own_s if ready.own_s is None or ready.seconds is None else min(ready.own_s, ready.seconds),
        index_bytes=ready.grown_bytes,
        peak_bytes=worker.peak_bytes,
        isolation=dict.fromkeys(() if "truth" in worker.isolation else PROMISES, "trusted code, not shut in")
        | worker.isolation,
    )
