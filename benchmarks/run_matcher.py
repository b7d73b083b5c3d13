# SPDX-License-Identifier: Apache-2.0
"""Queries a second of a run, and what the worker adds to each: its process, the message there, the answer back.

One embedded town, views of one size, one process. `overhead` is the time by the clock for each query beside the time
inside of `match`; the start of the process and the map are apart. Run it with `make bench`.
"""

import argparse
import statistics
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path

from sasgeo_bench.running import prediction_files
from sasgeo_bench.running.plan import RunRequest, plan_run
from sasgeo_bench.running.runner import run
from sasgeo_bench.running.worker import Limits, Reach, Worker
from sasgeo_bench.tasks import task_files
from sasgeo_bench.tasks.build import make_tasks
from sasgeo_bench.tasks.task_plan import TaskRequest, plan_requests

TOWN = "town-riverside"
MATCHERS = ("random", "prior_centre", "map_density_prior", "global_descriptor", "raster_uniform", "fft_vote")
VIEWS_CELLS = (96, 192, 384)
ASKED = 24


@dataclass(frozen=True, kw_only=True)
class Row:
    """One line of the table."""

    start_s: float
    prepare_s: float
    inside_ms: float
    overhead_ms: float


def town_task(out: Path) -> Path:
    """A task of some hundred queries of all sizes."""
    wanted = TaskRequest(
        suites=("occlusion",), regions=(TOWN,), split="crossfit", count=8, seed=0, out=out, may_be_fewer=True
    )
    (made,) = make_tasks(plan_requests(wanted)[0])
    return made.folder


def measure(spec: str, task: Path, out: Path, cells: int) -> Row:
    """Ask some queries of one size, one after the other; medians."""
    region = out / "regions" / TOWN
    chosen = [query for query in task_files.read_queries(task) if query.evidence.shape[0] == cells]
    blobs = [task_files.query_bytes(query) for query in chosen if query.track == "localization"][:ASKED]
    reach = Reach(readable=[region.resolve()], hidden=[(out / "truth").resolve()])
    with Worker(spec=spec, reach=reach, limits=Limits(match_s=120.0)) as worker:
        begun = time.perf_counter()
        worker.load()
        start_s = time.perf_counter() - begun
        ready = worker.prepare(region)
        worker.match(blobs[0], top_k=25)
        inside_s, whole_s = [], []
        for blob in blobs:
            begun = time.perf_counter()
            reply = worker.match(blob, top_k=25)
            whole_s.append(time.perf_counter() - begun)
            inside_s.append(reply.seconds or 0.0)
    overhead_s = [one - other for one, other in zip(whole_s, inside_s, strict=True)]
    return Row(
        start_s=start_s,
        prepare_s=ready.seconds or 0.0,
        inside_ms=1000 * statistics.median(inside_s),
        overhead_ms=1000 * statistics.median(overhead_s),
    )


def whole_run(spec: str, task: Path, jobs: int) -> float:
    """Queries a second of a whole run, its start included."""
    begun = time.perf_counter()
    with tempfile.TemporaryDirectory() as folder:
        plan = plan_run(RunRequest(spec=spec, tasks=(task,), out=Path(folder), jobs=jobs))
        run(plan)
        count = len(list(prediction_files.read_predictions(plan.parts[0].folder)))
    return count / (time.perf_counter() - begun)


def main() -> None:
    """Print two tables."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--matchers", nargs="+", default=MATCHERS)
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder)
        task = town_task(out)
        print(f"{TOWN}, suite occlusion, localization, one process, medians of {ASKED} queries\n")
        print(f"{'matcher':>18} {'cells':>6} {'start s':>8} {'prepare s':>10} {'inside ms':>10} {'overhead ms':>12}")
        for spec in arguments.matchers:
            for cells in VIEWS_CELLS:
                row = measure(spec, task, out, cells)
                numbers = f"{row.start_s:8.2f} {row.prepare_s:10.2f} {row.inside_ms:10.1f} {row.overhead_ms:12.2f}"
                print(f"{spec:>18} {cells:6d} {numbers}", flush=True)
        print(f"\nwhole runs of {len(task_files.Task.open(task).ids())} queries, start included\n")
        for spec in arguments.matchers[:3]:
            for jobs in (1, 2):
                print(f"{spec:>18} jobs {jobs}: {whole_run(spec, task, jobs):.1f} queries/s", flush=True)


if __name__ == "__main__":
    main()
