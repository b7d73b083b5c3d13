# SPDX-License-Identifier: Apache-2.0
"""Queries of one task -> rows in its run folder: by one process or several, in whatever order they finish."""

import threading
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final

from sasgeo_bench.errors import MatchError
from sasgeo_bench.matcher import check_match, lacks
from sasgeo_bench.plugins import ORACLE
from sasgeo_bench.query import Query
from sasgeo_bench.results import Prediction, one_line
from sasgeo_bench.run.oracle import Oracle
from sasgeo_bench.run.plan import RunPart, RunPlan, reach_of
from sasgeo_bench.run.worker import Reply, Worker
from sasgeo_bench.store import rundir, taskdir

PART_ROWS: Final = 64
PART_S: Final = 1.0  # rows wait no longer than this to be written: what a kill loses

_AND: Final = " | "  # between ways in which parts of one run were shut in

Watch = Callable[[int], None]  # is told how many more queries have a row


@dataclass(frozen=True, slots=True, kw_only=True)
class Cost:
    """What some rows took.

    Parameters
    ----------
    counts : dict of str to int
        Rows by status.
    prepare_s, index_bytes : float and int, optional
        Of one map: seconds, and by how much the memory of the process grew; None where no map could be prepared.
    cpu_s : float
        Processor seconds inside of `match`, all queries together.
    peak_bytes : int
        Most memory that all processes of one matcher held at once.
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
    words: dict[str, list[str]] = {}
    messages: dict[str, str] = {}
    for cost in costs:
        messages = cost.messages | messages
        for status, count in cost.counts.items():
            counts[status] = counts.get(status, 0) + count
        for name, said in cost.isolation.items():
            words.setdefault(name, []).extend(said.split(_AND))
    return Cost(
        counts=counts,
        prepare_s=max((cost.prepare_s for cost in costs if cost.prepare_s is not None), default=None),
        index_bytes=max((cost.index_bytes for cost in costs if cost.index_bytes is not None), default=None),
        cpu_s=sum(cost.cpu_s for cost in costs),
        peak_bytes=max((cost.peak_bytes for cost in costs), default=0),
        isolation={name: _AND.join(dict.fromkeys(said)) for name, said in words.items()},
        messages=messages,
    )


def answer(plan: RunPlan, part: RunPart, ids: Sequence[str], *, jobs: int, watch: Watch) -> Cost:
    """Ask some queries of a task, by as many processes as are wanted, and write their rows.

    Parameters
    ----------
    plan : RunPlan
        From `plan_run`.
    part : RunPart
        The task.
    ids : sequence of str
        Queries to ask.
    jobs : int
        Processes at once.
    watch : callable
        Is told how many more queries have a row.

    Returns
    -------
    Cost
        What it took.

    Raises
    ------
    StoreError
        If rows cannot be written; those that were stay.
    """
    writer = _Writer(part.folder, watch=watch)
    questions = _Questions(part.task, ids)
    workers = [_asked(plan, part) for _ in range(min(jobs, len(ids)))]
    try:
        with ThreadPoolExecutor(max_workers=max(1, len(workers))) as pool:
            try:
                costs = list(pool.map(lambda worker: _ask_all(plan, part, worker, questions, writer), workers))
            finally:
                questions.stop()  # before the pool waits for its threads: each ends with the query it is at
    finally:
        writer.flush()
    return pool_costs([*costs, Cost(counts=writer.counts, messages=writer.messages)])


def _asked(plan: RunPlan, part: RunPart) -> Worker | Oracle:
    """Whoever is asked: a plugin in a process of its own, or the one control that is given the truth."""
    if plan.request.spec == ORACLE:
        return Oracle(part.truth)
    reach = reach_of(plan.request, part.region)
    return Worker(spec=plan.request.spec, reach=reach, limits=plan.request.limits)


def _ask_all(plan: RunPlan, part: RunPart, worker: Worker | Oracle, questions: "_Questions", writer: "_Writer") -> Cost:
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
                    is_warm, worker.cpu_s = True, 0.0
                reply = worker.match(blob, top_k=plan.request.top_k)
            writer.add(_prediction(query, reply, plan.request.top_k))
        return Cost(
            prepare_s=ready.seconds,
            index_bytes=ready.grown_bytes,
            cpu_s=worker.cpu_s,
            peak_bytes=worker.peak_bytes,
            isolation=dict(worker.isolation)
            or dict.fromkeys(("files", "truth", "network", "processes"), "trusted code, not shut in"),
        )


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
    """Queries of a task, one at a time to whoever asks; a row group in memory."""

    def __init__(self, task: Path, ids: Sequence[str]) -> None:
        self._lock = threading.Lock()
        self._rows = taskdir.read_some(task, frozenset(ids))
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
    """Rows of one task: gathered, counted, and written a part at a time."""

    def __init__(self, folder: Path, *, watch: Watch) -> None:
        self.counts: dict[str, int] = {}
        self.messages: dict[str, str] = {}
        self._folder, self._watch = folder, watch
        self._lock = threading.Lock()
        self._rows: list[Prediction] = []
        self._written = time.monotonic()

    def add(self, prediction: Prediction) -> None:
        """Take a row."""
        with self._lock:
            self._rows.append(prediction)
            self.counts[prediction.status] = self.counts.get(prediction.status, 0) + 1
            if prediction.message:
                self.messages.setdefault(prediction.status, prediction.message)
            if len(self._rows) >= PART_ROWS or time.monotonic() - self._written > PART_S:
                self._write()
            self._watch(1)

    def flush(self) -> None:
        """Write what is left."""
        with self._lock:
            self._write()

    def _write(self) -> None:
        if self._rows:
            rundir.write_part(self._folder, self._rows)
        self._rows = []
        self._written = time.monotonic()
