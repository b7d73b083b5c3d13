# SPDX-License-Identifier: Apache-2.0
"""Queries a second, decoys, bytes and memory: how fast a suite is drawn once its region is loaded.

Views of 192 x 192 cells of 1 m and 13 classes on one core, from a region of 16 km2 (Liechtenstein 2025-09-19 around
Vaduz; an embedded town where there is no extract). The first table gives the median over the runs of the queries drawn
a second: view, perception and whatever the suite does, without decoys and files. The second one is the whole of
`make-queries` for two numbers of sites, each in a process of its own. Run it with `make bench`.
"""

import argparse
import json
import resource
import statistics
import subprocess
import sys
import tempfile
import time
from dataclasses import replace
from pathlib import Path

from sasgeo_bench.regions.region_spec import find_region_file, read_region_file
from sasgeo_bench.tasks.build import make_tasks, read_scene
from sasgeo_bench.tasks.suites.all_suites import SUITES, find_suite
from sasgeo_bench.tasks.suites.base import Scene, Seeds, Suite, ViewRequest
from sasgeo_bench.tasks.suites.mining import describe, mine
from sasgeo_bench.tasks.suites.sites import choose_sites
from sasgeo_bench.tasks.task_plan import Request, TaskRequest, is_reachable, plan_requests

VIEW_CELLS = 192
SITES = 12
MINED = 1000
DRAWN = (
    "clean",
    "occlusion",
    "false-unknown",
    "season",
    "real-age",
    "synthetic-age",
    "growth",
    "local-warp",
    "no-priors",
)
WHOLE = ("clean", "occlusion")
FEW, MANY = 8, 64


def request_for(region: str, suite: str, count: int, out: Path, extracts: list[Path]) -> Request:
    """One request on the cross-fit split."""
    wanted = TaskRequest(
        suites=(suite,),
        regions=(region,),
        split="crossfit",
        count=count,
        seed=0,
        out=out,
        extract_folders=tuple(extracts),
        may_be_fewer=True,
    )
    return plan_requests(wanted)[0]


def draws_per_second(suite: Suite, scene: Scene, runs: int) -> float:
    """Median over the runs of all queries of 192 cells at the sites."""
    seeds = Seeds(root=0, names=("bench", suite.card.name))
    variants = tuple(item for item in suite.usable(scene) if item.view_cells == VIEW_CELLS)
    suite = replace(suite, variants=variants)
    sites = choose_sites(scene, suite, count=SITES, seeds=seeds, group=suite.card.group, may_be_fewer=True)
    rates = []
    for _ in range(runs):
        start = time.perf_counter()
        for site in sites:
            for variant in variants:
                suite.draw(ViewRequest(scene=scene, site=site, variant=variant, seeds=seeds.under("site", site.index)))
        rates.append(len(sites) * len(variants) / (time.perf_counter() - start))
    return statistics.median(rates)


def whole(region: str, suite: str, count: int, out: Path, extracts: list[Path]) -> dict[str, float]:
    """Draw and write one task: seconds, queries, bytes, and the peak memory of this process."""
    request = request_for(region, suite, count, out, extracts)
    start = time.perf_counter()
    made = make_tasks(request)
    seconds = time.perf_counter() - start
    queries = sum(item.manifest.queries for item in made)
    size = sum((item.folder / "queries.parquet").stat().st_size for item in made)
    peak_mb = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024 / 1e6
    return {"seconds": seconds, "queries": queries, "kb": size / queries / 1e3, "peak_mb": peak_mb}


def main() -> None:
    """Print both tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--runs", type=int, default=3)
    parser.add_argument("--extracts", type=Path, action="append", default=[])
    parser.add_argument("--whole", nargs=4, help=argparse.SUPPRESS)
    given = parser.parse_args()
    if given.whole:
        region, suite, count, out = given.whole
        print(json.dumps(whole(region, suite, int(count), Path(out), given.extracts)))
        return
    with tempfile.TemporaryDirectory(prefix="sasgeo-bench-") as folder:
        out = Path(folder)
        real = is_reachable(read_region_file(find_region_file("vaduz")), given.extracts, out)
        region = "vaduz" if real else "town-riverside"
        print(f"{region}, medians of {given.runs} runs, views of {VIEW_CELLS} x {VIEW_CELLS} cells, one core")
        _print_draws(region, out, given.extracts, given.runs)
        _print_mining(region, out, given.extracts)
        _print_whole(region, out, given.extracts)


def _print_draws(region: str, out: Path, extracts: list[Path], runs: int) -> None:
    print(f"\n{'suite':>16} {'queries/s':>10}")
    for name in DRAWN:
        scene, _ = read_scene(request_for(region, name, SITES, out, extracts), find_suite(name), lambda _: None)
        print(f"{name:>16} {draws_per_second(SUITES[name], scene, runs):10.0f}", flush=True)


def _print_mining(region: str, out: Path, extracts: list[Path]) -> None:
    scene, _ = read_scene(request_for(region, "clean", SITES, out, extracts), find_suite("clean"), lambda _: None)
    start = time.perf_counter()
    windows = describe(scene.map, side_m=float(VIEW_CELLS), clear_m=scene.view_reach_m)
    places = windows.points_m[:: max(1, len(windows.points_m) // MINED)][:MINED]
    for easting_m, northing_m in places.tolist():
        mine(windows, (easting_m, northing_m), count=200)
    print(f"\n200 decoys for each of {len(places)} places: {time.perf_counter() - start:.1f} s, map described once")


def _print_whole(region: str, out: Path, extracts: list[Path]) -> None:
    print(f"\n{'suite':>16} {'sites':>6} {'queries':>8} {'s':>7} {'queries/s':>10} {'kB/query':>9} {'peak MB':>8}")
    folders = [word for folder in extracts for word in ("--extracts", str(folder))]
    for name in WHOLE:
        for count in (FEW, MANY):
            command = [sys.executable, __file__, "--whole", region, name, str(count), str(out), *folders]
            row = json.loads(subprocess.run(command, check=True, capture_output=True, text=True).stdout)  # noqa: S603
            rate = row["queries"] / row["seconds"]
            shown = f"{row['queries']:8d} {row['seconds']:7.1f} {rate:10.0f} {row['kb']:9.1f} {row['peak_mb']:8.0f}"
            print(f"{name:>16} {count:6d} {shown}", flush=True)


if __name__ == "__main__":
    main()
