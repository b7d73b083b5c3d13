# SPDX-License-Identifier: Apache-2.0
"""How a board grows to a million queries on a cluster, and how many workers its scheduler can keep busy.

Measured here: seconds and bytes of a drawn query and of an answer (suites clean and occlusion on an embedded town, one
process), and the processor time that a dask scheduler and its client, both in this process, spend on an item that takes
no time: with as much to send as a chunk of 256 queries has. The table multiplies these: nothing in it but the first
lines was carried out. A scheduler is the limit where its workers end more items a second than it can hand out.

    python benchmarks/cluster.py --workers 2 4 8
"""

import argparse
import resource
import statistics
import tempfile
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import sasgeo_bench as sgb
from sasgeo_bench.core.progress import spread
from sasgeo_bench.running.plan import RunRequest, plan_run
from sasgeo_bench.running.runner import run
from sasgeo_bench.tasks import task_files

TOWN = "town-riverside"
SUITES = ["clean", "occlusion"]
CHUNK = 256  # queries, as in a run on a cluster
ITEMS = 2000
MATCHERS = 10
ANSWERS_S = {"a trivial matcher": 0.004, "sasgeo": 0.37}  # a query: overhead of the process, and benchmarks/README.md
SIZES = (1_000, 10_000, 100_000, 1_000_000)


@dataclass(frozen=True, kw_only=True)
class Unit:
    """What one query takes."""

    drawing_s: float
    query_bytes: float
    answer_bytes: float
    queries_per_task: float


@dataclass(frozen=True, kw_only=True)
class Item:
    """What travels with a chunk: ids of queries, and the hash of each."""

    asked: dict[str, str]


def ends(item: Item) -> int:
    """Take no time."""
    return len(item.asked)


def size_of(folder: Path) -> int:
    """Bytes of all files below a folder."""
    return sum(path.stat().st_size for path in folder.rglob("*") if path.is_file())


def unit_of(out: Path, count: int) -> Unit:
    """Draw queries on a town and answer them."""
    sgb.build_region([TOWN], out=out)
    begun = time.perf_counter()
    sgb.make_tasks(suite=SUITES, regions=[TOWN], split="crossfit", n=count, up_to=True, out=out)
    drawing_s = time.perf_counter() - begun
    tasks = [out / "tasks" / suite / TOWN for suite in SUITES]
    queries = sum(len(task_files.Task.open(task).ids()) for task in tasks)
    plan = plan_run(RunRequest(spec="random", tasks=tasks, out=out))
    run(plan)
    return Unit(
        drawing_s=drawing_s / queries,
        query_bytes=(size_of(out / "tasks") + size_of(out / "truth")) / queries,
        answer_bytes=size_of(out / "runs") / queries,
        queries_per_task=queries / len(tasks),
    )


def items_of(count: int) -> Iterator[Item]:
    """Make up chunks."""
    for at in range(count):
        yield Item(asked={f"{at * CHUNK + one:024x}": f"{at * CHUNK + one:064x}" for one in range(CHUNK)})


def scheduled(workers: int, count: int) -> tuple[float, float]:
    """Return seconds by the clock, and of this process, that an item takes; the start of the workers left out."""
    found = []
    for items in (list(items_of(workers)), list(items_of(count))):
        begun, before = time.perf_counter(), resource.getrusage(resource.RUSAGE_SELF)
        done = sum(spread(ends, items, dask=f"local:{workers}"))
        used = resource.getrusage(resource.RUSAGE_SELF)
        assert done == CHUNK * len(items)  # noqa: S101 - of a benchmark
        found.append((time.perf_counter() - begun, used.ru_utime + used.ru_stime - before.ru_utime - before.ru_stime))
    (few_s, few_cpu_s), (many_s, many_cpu_s) = found
    return (many_s - few_s) / (count - workers), (many_cpu_s - few_cpu_s) / (count - workers)


def main() -> None:
    """Print two tables."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--workers", type=int, nargs="+", default=[2, 4, 8])
    parser.add_argument("--runs", type=int, default=3)
    parser.add_argument("--sites", type=int, default=24)
    said = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        unit = unit_of(Path(folder), said.sites)
    print(
        f"a query: drawn in {1000 * unit.drawing_s:.1f} ms, {unit.query_bytes:.0f} bytes; an answer: "
        f"{unit.answer_bytes:.0f} bytes\n"
    )
    print("| workers | items a second | ms of the scheduler an item |\n|---:|---:|---:|")
    costs_s = []
    for workers in said.workers:
        clock_s, cpu_s = (
            statistics.median(one) for one in zip(*(scheduled(workers, ITEMS) for _ in range(said.runs)), strict=True)
        )
        costs_s.append(cpu_s)
        print(f"| {workers} | {1 / clock_s:.0f} | {1000 * cpu_s:.2f} |", flush=True)
    item_s = max(costs_s)
    print("\n| queries | tasks | MB | drawing, core h | answers of a matcher, MB | chunks of ten | scheduler, s |")
    print("|---:|---:|---:|---:|---:|---:|---:|")
    for size in SIZES:
        chunks = MATCHERS * -(-size // CHUNK)
        cells = (
            f"{size:,}",
            f"{size / unit.queries_per_task:,.0f}",
            f"{size * unit.query_bytes / 1e6:,.0f}",
            f"{size * unit.drawing_s / 3600:.2f}",
            f"{size * unit.answer_bytes / 1e6:,.0f}",
            f"{chunks:,}",
            f"{chunks * item_s:.1f}",
        )
        print(f"| {' | '.join(cells)} |")
    print("\n| | core h of ten for a million queries | workers that a scheduler keeps busy |\n|---|---:|---:|")
    for name, answer_s in ANSWERS_S.items():
        hours = MATCHERS * SIZES[-1] * answer_s / 3600
        print(f"| {name}, {1000 * answer_s:.0f} ms a query | {hours:,.0f} | {CHUNK * answer_s / item_s:,.0f} |")


if __name__ == "__main__":
    main()
