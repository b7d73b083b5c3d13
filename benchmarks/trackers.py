# SPDX-License-Identifier: Apache-2.0
"""How well trackers follow drawn flights, and what a step costs.

    python benchmarks/trackers.py out/tasks/flight-clean/town-grid --tracker grid_markov --tracker dead_reckoning

follows the flights of each folder of tasks, whose truths lie beside it (`make-queries`), in this process, and prints a
row for each tracker, role and kind of view: views, flights, shares of views within 25 m, of accepted views and of these
beyond 25 m, median normalised squared error of place and heading (2.37 for honest covariances), and processor time of a
step. For each tracker and map it prints the processor time to prepare, what it reads of the map included. `--memory`
prints what Python and NumPy allocate at most, what is read of the map included, and slows the rest down. It is no
leaderboard: nothing is shut in, and a crash ends it.
"""

import argparse
import math
import time
import tracemalloc
from collections import defaultdict
from pathlib import Path
from typing import NamedTuple

import numpy as np

import sasgeo_bench as sgb

NEAR_M = 25.0
MB = 1e6

Flight = list[tuple[sgb.Query, sgb.Truth]]


class Row(NamedTuple):
    """A fix: whether it is right, whether it is accepted, its normalised squared error, and its time."""

    is_near: bool
    is_accepted: bool
    error: float
    seconds: float


def read_flights(tasks: Path, *, views: int) -> list[Flight]:
    """Read the first views of all flights of a folder of tasks."""
    truths = sgb.read_truths(Path(*("truth" if part == "tasks" else part for part in tasks.parts)))
    flights: dict[str, Flight] = defaultdict(list)
    for query, truth in zip(sgb.read_queries(tasks), truths, strict=True):
        if query.step is not None and query.step.frame < views:
            flights[query.step.sequence_id].append((query, truth))
    return list(flights.values())


def follow(tracker: sgb.Tracker, flight: Flight) -> list[Row]:
    """Follow a flight; views that were not taken in the map are asked and left out."""
    tracker.start(flight[0][0].prior)
    rows = []
    for query, truth in flight:
        start = time.process_time()
        fix = tracker.step(query)
        seconds = time.process_time() - start
        if truth.pose is not None:
            rows.append(judged(fix, truth.pose, seconds))
    return rows


def judged(fix: sgb.Fix, pose: sgb.Pose, seconds: float) -> Row:
    """Compare a fix with the truth."""
    if fix.pose is None:
        return Row(is_near=False, is_accepted=False, error=math.nan, seconds=seconds)
    off = np.array(
        [
            fix.pose.easting_m - pose.easting_m,
            fix.pose.northing_m - pose.northing_m,
            float(sgb.wrap_deg(fix.pose.yaw_deg - pose.yaw_deg)),
        ]
    )
    error = math.nan if fix.covariance is None else float(off @ np.linalg.solve(np.array(fix.covariance), off))
    is_near = math.hypot(off[0], off[1]) <= NEAR_M
    return Row(is_near=is_near, is_accepted=bool(fix.is_accepted), error=error, seconds=seconds)


def allocated(*, is_measured: bool) -> str:
    """Return what is allocated now and was at most since the last call, if it is measured."""
    if not is_measured:
        return ""
    now, most = tracemalloc.get_traced_memory()
    tracemalloc.reset_peak()
    return f"; {now / MB:.0f} MB are allocated, {most / MB:.0f} MB were at most"


def row_of(name: str, flown: list[list[Row]]) -> str:
    """Return a line for the flights of a kind."""
    near, accepted, errors, seconds = np.array([row for rows in flown for row in rows], dtype=float).T
    false = ((near == 0) & (accepted == 1)).sum() / max(1, accepted.sum())
    p50, p95 = np.percentile(1000 * seconds, (50, 95))
    error = np.nanmedian(errors) if np.isfinite(errors).any() else math.nan
    return (
        f"{name:64s} {len(near):6d} {len(flown):4d} {near.mean():7.3f} {accepted.mean():7.3f} {false:7.3f} "
        f"{error:7.2f} {p50:6.0f} {p95:6.0f} {1000 * seconds.max():6.0f}"
    )


def main() -> None:
    """Follow and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("tasks", type=Path, nargs="+", help="folders made by make-queries: OUT/tasks/<suite>/<region>")
    parser.add_argument("--tracker", action="append", required=True, help="a name from list trackers")
    parser.add_argument("--views", type=int, default=1_000_000, help="first views of each flight")
    parser.add_argument("--memory", action="store_true", help="measure memory too")
    parser.add_argument("--role", action="append", help="control, stress, falsifier; default: all")
    options = parser.parse_args()
    head = ("views", "fl.", "<=25 m", "accept", "false", "NEES", "p50 ms", "p95", "max")
    for tasks in options.tasks:
        flights = read_flights(tasks, views=options.views)
        folder = tasks.parents[2] / "regions" / flights[0][0][0].region
        print(f"\n{tasks.parent.name} on {tasks.name}".ljust(66), " ".join(f"{word:>6s}" for word in head))
        for name in options.tracker:
            if options.memory:
                tracemalloc.start()
            tracker = sgb.load_tracker(name)
            region = sgb.read_region(folder, with_layers=False)
            start = time.process_time()
            tracker.prepare(region, None)
            print(
                f"{name}: prepared in {time.process_time() - start:.1f} s{allocated(is_measured=options.memory)}",
                flush=True,
            )
            by_kind: dict[str, list[list[Row]]] = defaultdict(list)
            for flight in flights:
                truth = flight[0][1]
                if not options.role or truth.role in options.role:
                    by_kind[f"{truth.role}, {truth.kind} {truth.strength:g}"].append(follow(tracker, flight))
            for kind, flown in sorted(by_kind.items()):
                print(row_of(f"{name}: {kind}", flown), flush=True)
            if len(by_kind) > 1:
                print(row_of(f"{name}: all", [rows for flown in by_kind.values() for rows in flown]))
            if options.memory:
                print(f"{name}: flew{allocated(is_measured=options.memory)}")
                tracemalloc.stop()


if __name__ == "__main__":
    main()
