# SPDX-License-Identifier: Apache-2.0
"""Answer the queries of tasks and write their rows; one process answers all tasks that search its map."""

import threading
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from contextlib import ExitStack
from dataclasses import dataclass, field, replace
from functools import partial
from itertools import groupby
from typing import Final, Generic, TypeVar

from sasgeo_bench.core.errors import MatchError, StoreError
from sasgeo_bench.core.plugins import ORACLE
from sasgeo_bench.core.texts import one_line
from sasgeo_bench.matching.matcher import Prediction, Status, lacks
from sasgeo_bench.matching.tracker import check_prediction
from sasgeo_bench.regions.region_files import check_files, read_manifest
from sasgeo_bench.running import prediction_files
from sasgeo_bench.running.failures import LOG, our_failure
from sasgeo_bench.running.oracle import Oracle
from sasgeo_bench.running.plan import RunPart, RunPlan, by_map, reach_of
from sasgeo_bench.running.sandbox import PROMISES, UNGUARDED, joined
from sasgeo_bench.running.worker import Reply, Worker, guarded
from sasgeo_bench.tasks.query import Query
from sasgeo_bench.tasks.task_files import answer_hash

GIVEN_UP: Final = "given up after"  # begins the message of those that are not asked any more


class Patience:
    """Counts questions in a row that a plugin did not answer in time, over all its processes.

    >>> patience = Patience(most_late=2)
    >>> for status in ("timeout", "ok", "timeout", "timeout"):
    ...     patience.note(status, "no answer within 30 s")
    >>> patience.given_up
    'given up after 2 queries in a row without an answer in time (no answer within 30 s)'
    """

    def __init__(self, what: str = "queries", *, most_late: int = 10) -> None:  # questions in a row
        self._what, self._most_late = what, most_late
        self._lock = threading.Lock()
        self._late = 0
        self._given_up: str | None = None

    def note(self, status: Status, message: str) -> None:
        """Record the outcome of a question."""
        with self._lock:
            self._late = self._late + 1 if status == "timeout" else 0
            if self._late == self._most_late and self._given_up is None:
                ended = f"{GIVEN_UP} {self._late} {self._what} in a row without an answer in time"
                self._given_up = one_line(f"{ended} ({message})")

    @property
    def given_up(self) -> str | None:
        """Return the message of the questions that are not asked any more, None before that."""
        with self._lock:
            return self._given_up


Item = TypeVar("Item")

# One more process has to start and to prepare a map: 1.6 s of a core, or far more. While the time of a query is unknown
# (10 ms or 10 s), fewer queries than this for each process do not justify one; chunks for a cluster are no smaller.
LEAST_ITEMS: Final = 8


def is_worth_starting(*, left: int, askers: int, start_s: float, pace_s: float | None) -> bool:
    """Return whether one more process is worth its start: whether its share of the queries takes as long at least.

    `left` queries are pending for `askers` processes; `start_s` includes preparing the map. While the time of a query,
    `pace_s`, is unknown, the share must hold `LEAST_ITEMS` queries.

    >>> [is_worth_starting(left=40, askers=1, start_s=2.0, pace_s=pace_s) for pace_s in (0.01, 1.0)]
    [False, True]
    """
    share = left / (askers + 1)
    return share >= LEAST_ITEMS if pace_s is None else share * pace_s >= start_s


class Schedule(Generic[Item]):
    """Queries of several maps, shared by threads.

    `lines` holds the queries of each map in groups, each of which one thread answers, and the number of queries.

    >>> schedule = Schedule([(iter(["ab", "c"]), 3), (iter("d"), 1)])
    >>> while (number := schedule.take()) is not None:
    ...     print(number, *schedule.groups(number))
    0 ab c
    1 d
    """

    def __init__(
        self, lines: Sequence[tuple[Iterator[Sequence[Item]], int]], *, clock: Callable[[], float] = time.monotonic
    ) -> None:
        self._lines = [_Line(items, count) for items, count in lines]
        self._clock = clock
        self._changed = threading.Condition()
        self.is_stopped = False

    def take(self) -> int | None:
        """Return the map to work on next, or None if nothing is left; wait until help is known to be worth it."""
        with self._changed:
            while not self.is_stopped:
                line = next((line for line in self._lines if line.askers == 0), None) or self._in_need()
                if line is not None:
                    line.askers += 1
                    return self._lines.index(line)
                if not any(line.left for line in self._lines):
                    return None
                self._changed.wait()
        return None

    def _in_need(self) -> "_Line[Item] | None":
        in_need = (line for line in self._lines if line.is_worth_starting())
        return max(in_need, key=lambda line: line.left / (line.askers + 1), default=None)

    def groups(self, number: int) -> Iterator[Sequence[Item]]:
        """Yield groups of a map, each to one thread only; measure the time until the thread asks for the next."""
        line, is_first = self._lines[number], True
        while not self.is_stopped:
            group = line.draw()
            if group is None:
                break
            begun = self._clock()
            yield group
            with self._changed:
                line.note(self._clock() - begun, len(group), is_first=is_first)
                self._changed.notify_all()
            is_first = False
        with self._changed:
            self._changed.notify_all()

    def wait_for_stop(self, seconds: float) -> bool:
        """Return whether the schedule is stopped, now or within some seconds."""
        with self._changed:
            return self._changed.wait_for(lambda: self.is_stopped, timeout=seconds)

    def stop(self) -> None:
        """Give no more work, and wake all waiting threads."""
        with self._changed:
            self.is_stopped = True
            self._changed.notify_all()


class _Line(Generic[Item]):
    """Queries of one map, and measurements of the time they take."""

    def __init__(self, groups: Iterator[Sequence[Item]], count: int) -> None:
        self.left = count
        self.askers = 0
        self._groups = groups
        self._lock = threading.Lock()
        self._start_s = 0.0
        self._spent_s, self._count = 0.0, 0

    def draw(self) -> Sequence[Item] | None:
        """Return the next group of queries, or None."""
        with self._lock:
            group = next(self._groups, None)
            self.left = 0 if group is None else self.left - len(group)
            return group

    def note(self, seconds: float, count: int, *, is_first: bool) -> None:
        """Record the time of a group; the first of a process includes its start, and is not part of the pace."""
        if is_first:
            self._start_s = max(self._start_s, seconds)
        else:
            self._spent_s, self._count = self._spent_s + seconds, self._count + count

    def is_worth_starting(self) -> bool:
        pace_s = self._spent_s / self._count if self._count else None
        return self.left > 0 and is_worth_starting(
            left=self.left, askers=self.askers, start_s=self._start_s, pace_s=pace_s
        )


PART_ROWS: Final = 64
PART_S: Final = 1.0  # longest time between two writes: a kill loses no more


Question = tuple["_Writer", Query, bytes]


@dataclass(frozen=True, slots=True, kw_only=True)
class Cost:
    """Cost of some rows.

    `counts` gives rows by status, `messages` the first message of each other status than ok. Of one map, `prepare_s`
    seconds and `index_bytes` of growth, None where no map could be prepared; `cpu_s` within `match`, over all queries;
    `peak_bytes` is the most memory that the processes of the matcher held at once; `isolation` as in `run.json`.
    """

    counts: dict[str, int] = field(default_factory=dict)
    prepare_s: float | None = None
    index_bytes: float | None = None
    cpu_s: float = 0.0
    peak_bytes: float = 0
    isolation: dict[str, str] = field(default_factory=dict)
    messages: dict[str, str] = field(default_factory=dict)


def pool_costs(costs: Sequence[Cost]) -> Cost:
    """Pool costs: sum counts and processor seconds, keep the largest of the others, join all isolations."""
    counts: dict[str, int] = {}
    messages: dict[str, str] = {}
    for cost in costs:
        messages = _first_messages(messages, cost.messages)
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


def _first_messages(messages: dict[str, str], later: dict[str, str]) -> dict[str, str]:
    """Return the first message of each status; that a plugin was given up comes before the first late answer."""
    ended = {name: text for found in (later, messages) for name, text in found.items() if text.startswith(GIVEN_UP)}
    return later | messages | ended


class Watch:
    """Observer of the progress of tasks, called by several threads at once; this one does nothing."""

    def begin(self, part: RunPart) -> None:
        """Record that a task has begun."""

    def advance(self, part: RunPart) -> None:
        """Record that one more query has a row."""

    def end(self, part: RunPart, cost: Cost) -> None:
        """Record that all rows are written, and their cost."""


def answer(
    plan: RunPlan, parts: Sequence[RunPart], *, jobs: int, watch: Watch, patience: Patience | None = None
) -> Cost:
    """Ask the pending queries of some tasks in at most `jobs` processes, and write the rows.

    Tasks that search one map share processes; no process has more than one map. `patience` is shared with other calls
    of the same run. Raise `StoreError` if rows cannot be written; written ones stay.
    """
    groups = [[_Writer(part, watch=watch) for part in group] for group in by_map(plan.request.spec, parts)]
    patience = Patience() if patience is None else patience
    maps = [_Map(plan, group, patience) for group in groups]
    writers = [writer for group in groups for writer in group]
    schedule = Schedule([(place.groups(), place.count) for place in maps])
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
                schedule.stop()  # before the pool waits for its threads: each ends with its current query
            writing.result()
    return pool_costs([writer.cost for writer in writers])


def _ask_all(schedule: Schedule[Question], maps: Sequence["_Map"]) -> None:
    while (number := schedule.take()) is not None:
        maps[number].ask(schedule, number)


def _write_in_time(writers: Sequence["_Writer"], schedule: Schedule[Question]) -> None:
    """Write rows at regular times; a failure to write stops the run."""
    try:
        while not schedule.wait_for_stop(PART_S):
            for writer in writers:
                writer.flush()
    finally:
        schedule.stop()


class _Map:
    """A map and the tasks that search it."""

    def __init__(self, plan: RunPlan, writers: Sequence["_Writer"], patience: Patience) -> None:
        self.count = sum(len(writer.part.left) for writer in writers)
        self._plan, self._writers, self._patience = plan, writers, patience
        asks = "imagery" in plan.card.needs
        self._is_pictured = asks and read_manifest(writers[0].part.region).imagery is not None

    def groups(self) -> Iterator[list[Question]]:
        """Yield queries in groups: each view alone, and all views of a flight together, since their order counts."""
        for _, group in groupby(self._questions(), key=lambda item: flight_of(item[1])):
            yield list(group)

    def _questions(self) -> Iterator[Question]:
        """Yield the queries of all tasks, each with the writer of its row; hold one row group in memory."""
        for writer in self._writers:
            writer.begin()
            for query, blob, asked in writer.part.task.some(frozenset(writer.part.left)):
                if writer.part.asked[query.query_id] != answer_hash(asked, writer.part.key):
                    raise StoreError(
                        f"{writer.part.task.folder} was made anew while it was asked: run again, answers are kept"
                    )
                yield writer, query, blob

    def ask(self, schedule: Schedule[Question], number: int) -> None:
        """Prepare the map in a new process with the first query, then answer groups of queries until none is left."""
        # Each flight has a process and a scratch folder of its own: others may fly the same way, or have flown it.
        ready = self._failed_training() or self._given_up()
        with self._process() as worker:
            is_warm = False
            for group in schedule.groups(number):
                if is_warm and group[0][1].step is not None:
                    worker.end()
                    is_warm = False
                if ready is None:
                    result = self._plan.training_result
                    region, text = self._writers[0].part.region, None if result is None else result.learned
                    ready = self._guarded(partial(worker.prepare, region, text))
                    self._check_map(ready)
                    if ready.status != "ok":  # a map that is ready answers nothing yet
                        self._patience.note(ready.status, ready.message)
                if schedule.is_stopped:
                    return
                if self._failed_training() is None:
                    for writer in {id(item[0]): item[0] for item in group}.values():
                        writer.add_process(worker, ready)
                is_warm = is_warm or self._given_up() is not None
                if ready.status == "ok" and not is_warm and self._lacks(group[0][1]) is None:
                    self._guarded(partial(worker.match, group[0][2], top_k=self._plan.request.top_k))
                    is_warm = True
                self._ask_group(schedule, worker, ready, group)

    def _ask_group(
        self, schedule: Schedule[Question], worker: Worker | Oracle, ready: Reply, group: Sequence[Question]
    ) -> None:
        """Answer the queries of a group in order; a flight ends with the first view that fails."""
        failed = None if ready.status == "ok" else ready
        for writer, query, blob in group:
            if schedule.is_stopped:
                return
            reason = self._lacks(query)
            if reason is not None:
                writer.add(Prediction(query_id=query.query_id, status="not applicable", message=reason))
                continue
            reply = failed or self._given_up()
            reply = reply or self._asked(partial(worker.match, blob, top_k=self._plan.request.top_k))
            row = self._row(query, reply)
            writer.add(row, cpu_s=reply.cpu_s)
            if query.step is not None and failed is None and row.status != "ok":
                failed = Reply(
                    status=row.status, message=f"since frame {query.step.frame} of the flight: {row.message}"
                )

    def _guarded(self, ask: Callable[[], Reply]) -> Reply:
        return guarded(ask, self._plan.run_folder, self._plan.card.name)

    def _asked(self, ask: Callable[[], Reply]) -> Reply:
        reply = self._guarded(ask)
        self._patience.note(reply.status, reply.message)
        return reply

    def _given_up(self) -> Reply | None:
        """Return the reply to every query after ten in a row that the matcher hung on; starts no process."""
        message = self._patience.given_up
        return None if message is None else Reply(status="timeout", message=message)

    def _lacks(self, query: Query) -> str | None:
        """Return why a query is not applicable to the matcher, or None."""
        is_taught = self._plan.training_set is not None
        return lacks(self._plan.card, query, is_taught=is_taught, is_pictured=self._is_pictured)

    def _row(self, query: Query, reply: Reply) -> Prediction:
        """Make a row of a reply, checked against the query again in this process."""
        row = Prediction(query_id=query.query_id, status=reply.status, message=reply.message)
        if reply.status != "ok":
            return row
        if reply.found is None:
            return replace(row, status="invalid", message="no answer in an answer")
        try:
            found = check_prediction(reply.found, query, top_k=self._plan.request.top_k)
        except MatchError as error:
            return replace(row, status="invalid", message=one_line(str(error)))
        except Exception as error:  # noqa: BLE001 - any failure costs only its own row
            words = our_failure(self._plan.run_folder / LOG, self._plan.card.name, error)
            return replace(row, status="crash", message=words)
        # Nothing but the answer itself is taken over from the process.
        found = replace(found, query_id=query.query_id, status="ok", message="")
        return replace(found, latency_s=reply.seconds, matcher_s=reply.own_s)

    def _failed_training(self) -> Reply | None:
        """Return the reply to every query after a failed training; starts no process."""
        result = self._plan.training_result
        return result if result is not None and result.learned is None else None

    def _check_map(self, ready: Reply) -> None:
        """Refuse a map that was replaced meanwhile, or is damaged: the matcher is not at fault."""
        part = self._writers[0].part
        if not part.task.manifest.is_of_map(read_manifest(part.region)):
            raise StoreError(f"{part.region} was built anew while it was searched: run again, answers are kept")
        if ready.status != "ok":
            check_files(part.region)

    def _process(self) -> Worker | Oracle:
        """Return the process that answers: a plugin's own, or the control that is given the truth."""
        request, part = self._plan.request, self._writers[0].part
        if request.spec == ORACLE:
            return Oracle(part.task.truth)
        return Worker(spec=request.spec, reach=reach_of(request, (part.region,)), limits=request.limits)


def flight_of(query: Query) -> str:
    """Return the flight of a view, or the id of a view alone."""
    return query.query_id if query.step is None else query.step.sequence_id


class _Writer:
    """Collects the rows of one task, counts them, writes them in parts, and adds up their cost."""

    def __init__(self, part: RunPart, *, watch: Watch) -> None:
        self.part = part
        self._watch = watch
        self._lock = threading.RLock()
        self._rows: list[Prediction] = []
        self._counts: dict[str, int] = {}
        self._messages: dict[str, str] = {}
        self._cpu_s = 0.0
        self._processes: dict[int, tuple[Worker | Oracle, Reply]] = {}
        self._is_open = False

    def begin(self) -> None:
        self._watch.begin(self.part)
        self._is_open = True

    def add_process(self, worker: Worker | Oracle, ready: Reply) -> None:
        with self._lock:
            self._processes[id(worker)] = (worker, ready)

    def add(self, prediction: Prediction, *, cpu_s: float = 0.0) -> None:
        """Add a row; end the task with the last one."""
        with self._lock:
            self._rows.append(prediction)
            self._cpu_s += cpu_s
            self._counts[prediction.status] = self._counts.get(prediction.status, 0) + 1
            if prediction.message:
                self._messages = _first_messages(self._messages, {prediction.status: prediction.message})
            if len(self._rows) >= PART_ROWS:
                self.flush()
            self._watch.advance(self.part)
            if sum(self._counts.values()) == len(self.part.left):
                self.end()

    def flush(self) -> None:
        with self._lock:
            if self._rows:
                prediction_files.write_part(self.part.folder, self._rows, asked=self.part.asked)
            self._rows = []

    def end(self) -> None:
        """Write the remaining rows and report the cost, once; do nothing where no task was begun."""
        with self._lock:
            self.flush()
            if self._is_open:
                self._is_open = False
                self._watch.end(self.part, self.cost)

    @property
    def cost(self) -> Cost:
        with self._lock:
            own = Cost(counts=dict(self._counts), cpu_s=self._cpu_s, messages=dict(self._messages))
            return pool_costs([own, *(_process_cost(*process) for process in self._processes.values())])


def _process_cost(worker: Worker | Oracle, ready: Reply) -> Cost:
    is_described = "truth" in worker.isolation
    isolation = {} if is_described else dict.fromkeys(PROMISES, UNGUARDED)
    return Cost(
        prepare_s=ready.own_s if ready.own_s is None or ready.seconds is None else min(ready.own_s, ready.seconds),
        index_bytes=ready.grown_bytes,
        peak_bytes=worker.peak_bytes,
        isolation=isolation | worker.isolation,
    )
