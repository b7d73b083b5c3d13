# SPDX-License-Identifier: Apache-2.0
"""What each system costs on a small computer: one core, 2 GB, views of 192 m, a disc of 500 m.

    .venv/bin/python benchmarks/budget.py --out out/budget --matcher schmidt_segcorr --matcher sasgeo

Prints a table in Markdown: seconds to index a map, what the index takes of memory for each km2, the largest memory of
the process, the seconds of an answer by the clock (median and 95 %) and of the processor, and the energy of an answer
where the machine counts it (all of its package, so that a machine with other work says too much); else "-". Systems are
untaught: what is learned changes no cost; one that cannot answer without training is not measured. Without --matcher
all systems with open numbers are measured. Views are clean ones with errors of perception, and ones with a tilt.
"""

import argparse
import os
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

import sasgeo_bench as sgb
from benchmarks.open_numbers import systems
from sasgeo_bench.core.errors import MatchError, SasgeoError
from sasgeo_bench.core.plugins import MATCHERS, check_names, list_entry_points
from sasgeo_bench.running.worker import Limits, Reach, Worker
from sasgeo_bench.tasks.task_files import query_bytes

PLACE, SIDE_M = "vaduz", 192.0
SUITES = {"clean": "perception", "local-warp": "G1 tilt"}  # each with the kind of its views
SITES, SEED, ASKED = 2, 90, 12
LIMITS = Limits(match_s=120.0, memory_bytes=2 * 10**9)
COUNTERS = Path("/sys/class/powercap")
HEAD = (
    "| System | Index, s | Index, MB for each km2 | Memory, MB | Answer, s | 95 % | Processor, s | Joules |\n"
    "|---|---:|---:|---:|---:|---:|---:|---:|"
)


@dataclass(frozen=True, slots=True, kw_only=True)
class Cost:
    """Costs of one system."""

    index_s: float
    index_bytes: int
    peak_bytes: int
    answer_s: tuple[float, ...]
    cpu_s: tuple[float, ...]
    joules: float | None


def read_joules(counters: Path = COUNTERS) -> float | None:
    """Return what the packages of this machine have used since some start, or None where nobody may read it.

    >>> read_joules(Path("nowhere")) is None
    True
    """
    try:
        packages = [folder for folder in counters.iterdir() if folder.name.count(":") == 1]
        return sum(int((folder / "energy_uj").read_text("utf-8")) for folder in packages) / 1e6 if packages else None
    except (OSError, ValueError):
        return None


def cost_of(spec: str, region: Path, blobs: list[bytes]) -> Cost:
    """Ask one system; raise `MatchError` with its words where it fails."""
    with Worker(spec=spec, reach=Reach(readable=[region.resolve()], hidden=[]), limits=LIMITS) as worker:
        ready = worker.prepare(region)
        if ready.status != "ok":
            raise MatchError(f"{spec}: {ready.message}")
        worker.match(blobs[0], top_k=10)  # what is made at the first question
        before = read_joules()
        replies = [worker.match(blob, top_k=10) for blob in blobs]
        after = read_joules()
        failed = next((reply for reply in replies if reply.status != "ok"), None)
        if failed is not None:
            raise MatchError(f"{spec}: {failed.message}")
        is_counted = before is not None and after is not None and after >= before  # a counter begins again at 0
        return Cost(
            index_s=ready.seconds or 0.0,
            index_bytes=ready.grown_bytes or 0,
            peak_bytes=worker.peak_bytes,
            answer_s=tuple(reply.seconds or 0.0 for reply in replies),
            cpu_s=tuple(reply.cpu_s for reply in replies),
            joules=(after - before) / len(replies) if is_counted and before is not None and after is not None else None,
        )


def lines(costs: dict[str, Cost], km2: float) -> Iterator[str]:
    """Yield the table, the fastest first."""
    yield HEAD
    for name, cost in sorted(costs.items(), key=lambda item: float(np.median(item[1].answer_s))):
        joules = "-" if cost.joules is None else f"{cost.joules:.1f}"
        yield (
            f"| `{name}` | {cost.index_s:.1f} | {cost.index_bytes / 1e6 / km2:.1f} | {cost.peak_bytes / 1e6:.0f} | "
            f"{np.median(cost.answer_s):.2f} | {np.quantile(cost.answer_s, 0.95):.2f} | {np.median(cost.cpu_s):.2f} | "
            f"{joules} |"
        )


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("out/budget"), help="folder of maps and views")
    parser.add_argument("--matcher", action="append", default=[], help="name from list matchers; may be repeated")
    options = parser.parse_args()
    try:
        measure(options.out, options.matcher or list(systems()))
    except SasgeoError as error:
        parser.error(str(error))


def drawn(out: Path) -> list[sgb.Query]:
    """Draw the views that are asked."""
    sgb.make_tasks(suite=list(SUITES), regions=PLACE, n=SITES, seed=SEED, out=out)
    found = []
    for suite, kind in SUITES.items():
        asked = {one.query_id for one in sgb.read_truths(out / "truth" / suite / PLACE) if one.kind == kind}
        found.extend(
            query
            for query in sgb.read_queries(out / "tasks" / suite / PLACE)
            if query.query_id in asked and query.track == "localization" and max(query.evidence.size_m) == SIDE_M
        )
    return found


def measure(out: Path, names: list[str]) -> None:
    """Measure systems one by one; those that fail are told below the table."""
    check_names(matchers=names, rejectors=[])
    stray = next((name for name in names if name not in list_entry_points(MATCHERS)), None)
    if stray is not None:
        raise MatchError(
            f"{stray} is not among the matchers of list matchers: name one of these, no tracker or module:Class"
        )
    os.sched_setaffinity(0, [min(os.sched_getaffinity(0))])
    blobs = [query_bytes(query) for query in drawn(out)[:ASKED]]
    region = out / "regions" / PLACE
    west_m, south_m, east_m, north_m = sgb.read_region(region, with_layers=False).grid.bounds_m
    km2 = (east_m - west_m) * (north_m - south_m) / 1e6
    costs, failed = {}, []
    for name in names:
        try:
            costs[name] = cost_of(name, region, blobs)
        except MatchError as error:
            failed.append(f"not measured: {error}")
    print(f"{PLACE}, {km2:.1f} km2, {len(blobs)} views, one core, {LIMITS.memory_bytes / 1e9:.0f} GB\n")
    print(*lines(costs, km2), *failed, sep="\n")


if __name__ == "__main__":
    main()
