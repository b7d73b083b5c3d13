# SPDX-License-Identifier: Apache-2.0
"""Run a matcher over tasks, here or on a dask cluster: a row for every query, and resumable."""

import threading
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack
from dataclasses import asdict, dataclass, replace
from functools import lru_cache, partial
from itertools import groupby
from pathlib import Path
from typing import TYPE_CHECKING, Final
from uuid import uuid4

from sasgeo_bench.core import progress
from sasgeo_bench.core.errors import counted
from sasgeo_bench.core.folders import locked
from sasgeo_bench.core.progress import connected, done_on, tell
from sasgeo_bench.matching.cards import write_learned
from sasgeo_bench.matching.follower import card_on_flights
from sasgeo_bench.regions import region_files
from sasgeo_bench.regions.imagery import ORTHO
from sasgeo_bench.regions.region import ATTRIBUTION, LICENCE
from sasgeo_bench.running import prediction_files
from sasgeo_bench.running.answers import LEAST_ITEMS, Cost, Patience, Watch, answer, pool_costs
from sasgeo_bench.running.plan import MOST_LINES, PackedTraining, RunPart, RunPlan, by_map, unit_of_task, whole_units
from sasgeo_bench.running.prediction_files import CardRecord, RunManifest
from sasgeo_bench.running.training import trained

if TYPE_CHECKING:
    from distributed import Client


def answer_on(client: "Client", plan: RunPlan, parts: Sequence[RunPart]) -> Iterator[tuple[int, int, Cost]]:
    """Ask all pending queries on a cluster whose workers all reach the same folders and have the plugin.

    Yields for each chunk that is done the number of its part, its queries, and its cost. A chunk whose worker dies, or
    cannot write, is given to another, which asks only queries without a row. Raises as `progress.done_on`; written rows
    stay.
    """
    threads = max(1, sum(client.nthreads().values()))
    # Other tasks' ids need not travel with every chunk, nor the blocks of a split.
    bare = replace(plan, parts=(), request=replace(plan.request, split=None))
    numbers, chunks = [], []
    for number, part in enumerate(parts):
        for ids in _chunks(part.left, threads, unit_of_task(part.task.manifest)):
            numbers.append(number)
            chunks.append(replace(part, left=ids, asked={name: part.asked[name] for name in ids}))
    for at, cost in done_on(client, partial(_answer_chunk, bare, uuid4().hex), chunks):
        yield numbers[at], len(chunks[at].left), cost


def _chunks(ids: Sequence[str], threads: int, unit_of: Callable[[str], str]) -> Iterator[tuple[str, ...]]:
    """Split ids into chunks, several for each thread; no flight is split."""
    size = -(-len(ids) // (threads * 4))  # so that the last ones end at about the same time
    size = min(max(size, LEAST_ITEMS), 256)  # at most 256 queries of a chunk, which has `LEAST_ITEMS` at least
    chunk: list[str] = []
    for _, unit in groupby(ids, key=unit_of):
        chunk += unit
        if len(chunk) >= size:
            yield tuple(chunk)
            chunk = []
    if chunk:
        yield tuple(chunk)


def _answer_chunk(plan: RunPlan, token: str, part: RunPart) -> Cost:
    """Ask one chunk in the process of a dask worker, except queries that an earlier try of it has answered."""
    # `token` tells one run from another, which the worker may have taken part in before.
    return answer(plan, _still_left(plan, [part]), jobs=1, watch=Watch(), patience=_patience_of(token))


@lru_cache(maxsize=16)
def _patience_of(token: str) -> Patience:
    del token
    return Patience()


MOST_LOCKED: Final = 128  # tasks at once: each lock is an open file, and some systems give a process 256


@dataclass(frozen=True, slots=True, kw_only=True)
class RunReport:
    """Rows that a run has added by status, the first message of each other status than ok, and the folders."""

    counts: dict[str, int]
    messages: dict[str, str]
    folders: tuple[Path, ...]


def run(plan: RunPlan) -> RunReport:
    """Ask every pending query of a plan.

    Raises
    ------
    StoreError
        If rows cannot be written; those that were stay, and a second run continues there.
    ConfigError
        If a named cluster is not there.
    """
    for line in plan.training_lines() if plan.training_set is None else ():
        tell(f"{plan.card.name}: {line}")
    plan = trained(plan)
    if isinstance(plan.training_set, PackedTraining) and plan.learned_file is not None:
        tell(f"{plan.card.name}: trained on {plan.training_set.to_text()}")
        write_learned(plan.learned_file, plan.training_set.text)  # `run.json` names it
    _tell_state(plan)
    for part in plan.parts:
        if not part.left and part.done and prediction_files.read_key(part.folder) != part.key:
            with locked(part.folder):
                _begin(plan, part)  # answers under an earlier training count again: `run.json` says which
    parts = [part for part in plan.parts if part.left]
    if parts:
        progress.begin(plan.card.name, sum(len(part.left) for part in parts))
    if plan.request.dask is not None and parts:
        costs = _run_on_cluster(plan.request.dask, plan, parts)
    else:
        costs = _run_here(plan, parts)
    pooled = pool_costs(costs)
    return RunReport(counts=pooled.counts, messages=pooled.messages, folders=tuple(part.folder for part in plan.parts))


def _tell_state(plan: RunPlan) -> None:
    """Report the finished tasks, by name if they are few, failures, and how many rows answer other queries."""
    whole = [part for part in plan.parts if not part.left]
    if len(whole) > MOST_LINES:
        tell(f"{plan.card.name}: nothing left in {len(whole)} of {len(plan.parts)} tasks")
    else:
        for part in whole:
            tell(f"{part.folder}: nothing left, {part.done} done")
    for status, count in sorted(sum((Counter(part.failed) for part in plan.parts), Counter()).items()):
        rows = counted(count, "earlier query", "earlier queries")
        tell(f"{plan.card.name}: {rows} ended as {status}; --again {status} asks again")
    excluded = sum(part.excluded for part in plan.parts)
    if excluded:
        others = "" if plan.training_set is None else ", or of other learning"
        rows = counted(excluded, "answer")
        tell(f"{plan.card.name}: {rows} to queries that these tasks do not hold now{others}, set aside")


def _run_here(plan: RunPlan, parts: list[RunPart]) -> list[Cost]:
    """Ask the queries of all tasks on this machine."""
    costs = []
    for batch in _batches(by_map(plan.request.spec, parts)):
        with ExitStack() as locks:
            _lock(locks, batch)
            left = _still_left(plan, batch)
            if left:
                costs.append(answer(plan, left, jobs=plan.request.jobs, watch=_Notes(plan)))
    return costs


def _batches(groups: Sequence[Sequence[RunPart]]) -> Iterator[list[RunPart]]:
    """Group tasks that are locked together: those of some maps, all tasks of a map in one group."""
    batch: list[RunPart] = []
    for group in groups:
        if batch and len(batch) + len(group) > MOST_LOCKED:
            yield batch
            batch = []
        batch += group
    if batch:
        yield batch


def _lock(locks: ExitStack, parts: Sequence[RunPart]) -> None:
    """Hold the folders of some tasks; all runs lock them in one order, so that no two wait for each other."""
    for folder in sorted({part.folder for part in parts}):
        locks.enter_context(locked(folder))


def _still_left(plan: RunPlan, parts: Sequence[RunPart]) -> list[RunPart]:
    """Return the queries still pending after the locks were acquired; drop tasks without any."""
    found = []
    for part in parts:
        done = prediction_files.ids_done(
            part.folder, part.asked, again=plan.request.again, since_ns=plan.request.since_ns
        )
        left = whole_units(part.left, done, unit_of_task(part.task.manifest))
        if left:
            found.append(replace(part, left=left))
    return found


class _Notes(Watch):
    """Keeps `run.json` of each task, and reports each row, by one thread at a time."""

    def __init__(self, plan: RunPlan) -> None:
        self._plan = plan
        self._lock = threading.Lock()
        self._before: dict[Path, Cost] = {}

    def begin(self, part: RunPart) -> None:
        """Write `run.json` as a task begins."""
        with self._lock:
            self._before[part.folder] = _begin(self._plan, part)

    def advance(self, part: RunPart) -> None:
        """Report a row of the matcher as a whole: a task may be too short for a pace."""
        del part
        with self._lock:
            progress.advance(self._plan.card.name, 1)

    def end(self, part: RunPart, cost: Cost) -> None:
        _write_run(self._plan, part, cost, self._before[part.folder])


def _run_on_cluster(address: str, plan: RunPlan, parts: list[RunPart]) -> list[Cost]:
    """Ask the queries of all tasks on a cluster at once."""
    costs: list[list[Cost]] = []
    with ExitStack() as locks:
        client = locks.enter_context(connected(address))
        _lock(locks, parts)
        parts = _still_left(plan, parts)
        costs, left = [[] for _ in parts], [len(part.left) for part in parts]
        before = [_begin(plan, part) for part in parts]
        for number, count, cost in answer_on(client, plan, parts):
            costs[number].append(cost)
            left[number] -= count
            progress.advance(plan.card.name, count)
            if not left[number]:
                _write_run(plan, parts[number], pool_costs(costs[number]), before[number])
    return [pool_costs(items) for items in costs]


def _begin(plan: RunPlan, part: RunPart) -> Cost:
    """Write `run.json` as a task begins; return the cost of earlier runs of it."""
    recorded = RunManifest.open(part.folder) or RunManifest()
    before = Cost(
        prepare_s=recorded.prepare_s,
        index_bytes=recorded.index_bytes,
        cpu_s=recorded.cpu_s or 0.0,
        peak_bytes=recorded.peak_bytes or 0,
        isolation=recorded.isolation or {},
    )
    _write_run(plan, part, before, Cost())
    return before


def map_bytes(part: RunPart) -> int:
    """Return the bytes of a map; rendered imagery counts for those that look at it."""
    manifest = region_files.read_manifest(part.region)
    is_idle = manifest.imagery is not None and manifest.imagery.is_rendered and part.imagery is None
    files = (path for path in part.region.iterdir() if path.is_file() and not (is_idle and path.name == ORTHO))
    return sum(path.stat().st_size for path in files)


def _write_run(plan: RunPlan, part: RunPart, cost: Cost, before: Cost) -> None:
    """Write `run.json`: the run, and its cost together with that of earlier runs."""
    about, total = part.task.manifest, pool_costs([before, cost])
    run = RunManifest(
        schema_version=prediction_files.SCHEMA_VERSION,
        matcher=CardRecord(**asdict(plan.card if part.follower is None else card_on_flights(plan.card))),
        spec=plan.request.spec,
        hash=plan.hash,
        suite=about.suite,
        region=about.region,
        task_version=about.task_version,
        queries_sha256=about.queries_sha256,
        map_fingerprint=about.map_fingerprint,
        top_k=plan.request.top_k,
        limits=asdict(plan.request.limits),
        warm_up="one query of each process is asked twice and timed the second time",
        learned=plan.training_record,
        map_bytes=map_bytes(part),
        prepare_s=total.prepare_s,
        index_bytes=total.index_bytes,
        cpu_s=total.cpu_s,
        peak_bytes=total.peak_bytes,
        isolation=total.isolation,
        licence=LICENCE,
        attribution=ATTRIBUTION,
    )
    looks = {} if part.imagery is None else {"rendered_imagery": part.imagery}
    follows = {} if part.follower is None else {"follower": part.follower}
    run.model_copy(update=looks | follows).save(part.folder)
