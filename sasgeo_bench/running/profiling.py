# SPDX-License-Identifier: Apache-2.0
"""Measure what a matcher costs on a small computer: latency over minutes, memory, bytes, heat and energy."""

import math
import os
import sys
import time
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field
from itertools import cycle
from pathlib import Path
from typing import Final

import numpy as np
import psutil

from sasgeo_bench.core import progress
from sasgeo_bench.core.errors import ConfigError, MatchError, counted
from sasgeo_bench.core.plugins import ORACLE
from sasgeo_bench.core.progress import tell
from sasgeo_bench.matching.matcher import lacks
from sasgeo_bench.regions.packed_map import UnpackedMap
from sasgeo_bench.regions.region_files import read_manifest
from sasgeo_bench.running.plan import RunPlan, RunRequest, plan_run, reach_of
from sasgeo_bench.running.runner import map_bytes
from sasgeo_bench.running.sensors import EnergyMeter, clock_mhz, hottest_celsius, processor_name
from sasgeo_bench.running.training import trained
from sasgeo_bench.running.worker import Limits, Worker

LEAST_FIXES: Final = 20  # whatever time they take: fewer have no percentiles
MOST_ASKED: Final = 512  # queries, again and again: their rows are held
_PART_S: Final = 60.0  # of the time that a part of the table is about


@dataclass(frozen=True, kw_only=True)
class ProfileRequest:
    """Request for a profile.

    `spec` is a matcher's name or module:Class; `tasks` are folders of one map. Its processes and ours share `cores`
    processors, and may hold `memory_bytes`. Queries are asked one after the other, from the first again at their end,
    for `sustain_s` seconds and 20 answers at least; with `radius_m`, those alone whose prior is a disc of at most this
    radius. `maps` are packed ones, as of a run.
    """

    spec: str
    tasks: Sequence[Path]
    out: Path
    cores: int = 1
    memory_bytes: int = 2 * 10**9
    sustain_s: float = 300.0
    radius_m: float | None = None
    top_k: int = 25
    train: Sequence[Path] = ()
    is_sandboxed: bool = True
    maps: Sequence[UnpackedMap] = ()


@dataclass(frozen=True, slots=True, kw_only=True)
class Fix:
    """One answer: when it was asked, seconds after the first; how long it took by our clock and by the processor's."""

    since_s: float
    seconds: float
    cpu_s: float
    status: str


@dataclass(frozen=True, slots=True, kw_only=True)
class Reading:
    """Readings of the sensors at a time; None where there are none."""

    since_s: float
    celsius: float | None
    mhz: float | None


@dataclass(frozen=True, kw_only=True)
class Profile:
    """What a matcher cost.

    `start_s` is the time until its process had loaded it, `prepare_s` that for the map, and `first_s` that of the first
    fix, which is not among `fixes`. `index_bytes` is by how much the process grew while it prepared the map, of whose
    files it may read `map_bytes`; `peak_bytes` is the most that all its processes held at once; a query has
    `query_bytes` on the average. `joules` are those of all the computer during `fixes`, None without a counter. Priors
    are discs of `radius_m` at most, or any.
    """

    matcher: str
    version: str
    region: str
    km2: float
    suites: tuple[str, ...]
    queries: int
    machine: Mapping[str, str | float]
    start_s: float
    prepare_s: float
    first_s: float
    index_bytes: int
    map_bytes: int
    peak_bytes: int
    query_bytes: float
    joules: float | None
    fixes: tuple[Fix, ...]
    readings: tuple[Reading, ...]
    isolation: Mapping[str, str] = field(default_factory=dict)
    radius_m: float | None = None

    @property
    def statuses(self) -> dict[str, int]:
        """Return how many fixes ended in each way."""
        return dict(Counter(fix.status for fix in self.fixes).most_common())

    @property
    def answered(self) -> tuple[Fix, ...]:
        """Return the fixes that are answers; latencies are of these."""
        return tuple(fix for fix in self.fixes if fix.status == "ok")

    def latency_s(self, share: float, *, since_s: float = 0.0, until_s: float = math.inf) -> float:
        """Return a quantile of latency of answers asked within a time; nan without any."""
        taken = [fix.seconds for fix in self.answered if since_s <= fix.since_s < until_s]
        return float(np.quantile(taken, share)) if taken else math.nan

    def minutes(self) -> list[dict[str, float]]:
        """Return for each minute fixes, median and 95 % latency in seconds, and temperature at its end."""
        last_s = max((fix.since_s for fix in self.fixes), default=0.0)
        rows = []
        for at in range(max(1, math.ceil(last_s / _PART_S - 0.1))):  # a tenth of a minute is none
            since_s, until_s = at * _PART_S, (at + 1) * _PART_S
            hot = [one.celsius for one in self.readings if since_s <= one.since_s < until_s and one.celsius is not None]
            rows.append(
                {
                    "minute": at + 1,
                    "fixes": sum(since_s <= fix.since_s < until_s for fix in self.fixes),
                    "p50_s": self.latency_s(0.5, since_s=since_s, until_s=until_s),
                    "p95_s": self.latency_s(0.95, since_s=since_s, until_s=until_s),
                    "celsius": hot[-1] if hot else math.nan,
                }
            )
        return rows

    def thermal_note(self) -> str:
        """Say whether it slowed down, and what is known of heat."""
        rows = self.minutes()
        heat = [one.celsius for one in self.readings if one.celsius is not None]
        known = f"{heat[0]:.0f} to {max(heat):.0f} degrees Celsius" if heat else "this computer has no sensor of heat"
        if len(rows) < 2:
            return f"too short to tell whether it slows down; {known}"
        change = rows[-1]["p50_s"] / rows[0]["p50_s"] - 1
        side = "above" if change > 0 else "below"
        return f"the median of the last minute is {abs(change):.0%} {side} that of the first; {known}"

    def to_dict(self) -> dict[str, object]:
        """Return all of it as plain values."""
        return asdict(self)


def profile(
    request: ProfileRequest,
    *,
    plan: RunPlan | None = None,
) -> Profile:
    """Measure a matcher, as planned by `plan_profile`; nothing is stored.

    Raises
    ------
    ConfigError
        If the tasks are of several maps, none of their queries can be asked, or there are fewer cores.
    MatchError
        If the matcher cannot be loaded, the map cannot be prepared, or none of the first fixes is an answer.
    StoreError
        If a task or its map is missing or damaged.
    """
    plan = plan or plan_profile(request)
    region = plan.parts[0].region
    manifest = read_manifest(region)
    with _pinned(request.cores) as cores:
        plan = trained(plan)
        result = plan.training_result
        if result is not None and result.learned is None:
            raise MatchError(f"{plan.card.name} learned nothing: {result.status}: {result.message}")
        asked, count = _asked(plan, request, is_pictured=manifest.imagery is not None)
        queries = counted(len(asked), "query", "queries") + (f", the first of {count}," if count > len(asked) else "")
        tell(f"{plan.card.name}: {queries} on {region.name}, again and again for {request.sustain_s:g} s")
        reach = reach_of(plan.request, (region,))
        with Worker(spec=request.spec, reach=reach, limits=plan.request.limits) as worker:
            begun = time.perf_counter()
            worker.load()
            start_s = time.perf_counter() - begun
            ready = worker.prepare(region, None if result is None else result.learned)
            if ready.status != "ok":
                raise MatchError(f"{plan.card.name} cannot prepare {region.name}: {ready.status}: {ready.message}")
            first = worker.match(asked[0], top_k=request.top_k)
            meter = EnergyMeter()
            fixes, readings = _sustained(worker, asked, request, meter=meter)
            return Profile(
                matcher=plan.card.name,
                version=plan.card.version,
                region=region.name,
                km2=math.prod(manifest.grid.shape) * manifest.cell_size_m**2 / 1e6,
                suites=tuple(dict.fromkeys(part.task.manifest.suite for part in plan.parts)),
                queries=len(asked),
                machine=_machine(cores, request),
                start_s=start_s,
                prepare_s=ready.seconds or 0.0,
                first_s=first.seconds or math.nan,
                index_bytes=ready.grown_bytes or 0,
                map_bytes=map_bytes(plan.parts[0]),
                peak_bytes=worker.peak_bytes,
                query_bytes=float(np.mean([len(blob) for blob in asked])),
                joules=meter.joules(),
                fixes=tuple(fixes),
                readings=tuple(readings),
                isolation=dict(worker.isolation),
                radius_m=request.radius_m,
            )


def plan_profile(request: ProfileRequest) -> RunPlan:
    """Plan to ask everything, in a folder that nothing is written to; raise as `profile` does."""
    if request.spec == ORACLE:
        raise ConfigError(f"{ORACLE} has no process that could be measured: name another matcher")
    if not 0 < request.sustain_s < math.inf:
        raise ConfigError(f"the time must be positive seconds, got {request.sustain_s!r}")
    if request.radius_m is not None and not request.radius_m > 0:
        raise ConfigError(f"the radius must be positive metres, got {request.radius_m!r}")
    limits = Limits(memory_bytes=request.memory_bytes)
    plan = plan_run(
        RunRequest(
            spec=request.spec,
            tasks=request.tasks,
            out=request.out,
            top_k=request.top_k,
            limits=limits,
            is_sandboxed=request.is_sandboxed,
            train=request.train,
            maps=request.maps,
        )
    )
    maps = dict.fromkeys(part.region.name for part in plan.parts)
    if len(maps) != 1:
        raise ConfigError(f"the tasks are of {len(maps)} maps ({', '.join(maps)}): profile one map at a time")
    return plan


def _asked(plan: RunPlan, request: ProfileRequest, *, is_pictured: bool) -> tuple[list[bytes], int]:
    """Return the rows of the queries to ask, `MOST_ASKED` at most, flights in order; and how many could be asked."""
    reasons: Counter[str] = Counter()
    found: list[bytes] = []
    for part in plan.parts:
        for query, blob, _ in part.task.some(part.task.asked.keys()):
            # Why a prior is too wide, or None
            radius_m = request.radius_m
            far = (
                None
                if radius_m is None or (query.prior.radius_m is not None and query.prior.radius_m <= radius_m)
                else f"no prior within {radius_m:g} m"
            )
            reason = far or lacks(plan.card, query, is_taught=plan.training_set is not None, is_pictured=is_pictured)
            if reason is None and len(found) < MOST_ASKED:
                found.append(blob)
            reasons[reason or ""] += 1
    if not found:
        why = " and ".join(f"{reason} ({count})" for reason, count in reasons.most_common())
        raise ConfigError(
            f"{plan.card.name} can be asked none of the {counted(reasons.total(), 'query', 'queries')}: {why}"
        )
    return found, reasons[""]


@contextmanager
def _pinned(cores: int) -> Iterator[list[int]]:
    """Keep this thread, and the processes that it starts, on some processors."""
    if sys.platform != "linux":
        raise ConfigError("this system keeps no process on some of its cores: measure on Linux")
    before = sorted(os.sched_getaffinity(0))
    if not 0 < cores <= len(before):
        raise ConfigError(f"this computer gives us {counted(len(before), 'core')}, not {cores}")
    os.sched_setaffinity(0, before[:cores])
    try:
        yield before[:cores]
    finally:
        os.sched_setaffinity(0, before)


def _sustained(
    worker: Worker,
    asked: Sequence[bytes],
    request: ProfileRequest,
    *,
    meter: EnergyMeter,
) -> tuple[list[Fix], list[Reading]]:
    fixes: list[Fix] = []
    readings: list[Reading] = []
    begun, label, reported = time.perf_counter(), f"{request.spec} profiled", 0
    progress.begin(label, round(request.sustain_s))
    for blob in cycle(asked):
        since_s = time.perf_counter() - begun
        if since_s >= request.sustain_s and len(fixes) >= LEAST_FIXES:
            break
        if not readings or since_s - readings[-1].since_s >= 1.0:  # 1 s between two looks at the sensors
            readings.append(Reading(since_s=since_s, celsius=hottest_celsius(), mhz=clock_mhz()))
            meter.joules()
        reply = worker.match(blob, top_k=request.top_k)
        taken_s = time.perf_counter() - begun - since_s
        fixes.append(
            Fix(
                since_s=since_s,
                seconds=taken_s if reply.seconds is None else reply.seconds,
                cpu_s=reply.cpu_s,
                status=reply.status,
            )
        )
        if len(fixes) == LEAST_FIXES and not any(fix.status == "ok" for fix in fixes):
            why = f"{reply.status}: {reply.message}" if reply.message else reply.status
            raise MatchError(f"{request.spec}: none of the first {LEAST_FIXES} fixes is an answer ({why})")
        done = min(round(since_s + taken_s), round(request.sustain_s))
        progress.advance(label, done - reported)
        reported = done
    readings.append(Reading(since_s=time.perf_counter() - begun, celsius=hottest_celsius(), mhz=clock_mhz()))
    return fixes, readings


def _machine(cores: Sequence[int], request: ProfileRequest) -> dict[str, str | float]:
    return {
        "processor": processor_name(),
        "cores": len(cores),
        "cores_of_computer": os.cpu_count() or 1,
        "memory_bytes": request.memory_bytes,
        "memory_bytes_of_computer": psutil.virtual_memory().total,
        "load_before": os.getloadavg()[0],
    }
