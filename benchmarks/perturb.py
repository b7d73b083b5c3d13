# SPDX-License-Identifier: Apache-2.0
"""Milliseconds of each perturbation for a view of 192 x 192 cells and 13 classes, on one core.

Views are cut from three embedded towns, so nothing is downloaded. Each figure is the mean over the views of the median
of the runs on each. `make bench` runs it.
"""

import argparse
import statistics
import tempfile
import time
from pathlib import Path

import cv2
import numpy as np

from sasgeo_bench.geometry.pose import Pose
from sasgeo_bench.regions.build import build_region, plan_build
from sasgeo_bench.regions.evidence import Evidence, LayerBits, observe
from sasgeo_bench.regions.region_files import read_region
from sasgeo_bench.regions.region_spec import find_region_file, read_region_file
from sasgeo_bench.tasks.perturbations.all_perturbations import SHIPPED
from sasgeo_bench.tasks.perturbations.base import Perturbation, share_changed, share_hidden

TOWNS = ("town-suburb", "town-riverside", "town-agricultural")
VIEWS_PER_TOWN = 4
SIZE_CELLS = 192


def town_views() -> list[Evidence]:
    """Views of the middles of the towns, each at four headings."""
    views = []
    with tempfile.TemporaryDirectory(prefix="sasgeo-bench-") as folder:
        for town in TOWNS:
            plan = plan_build(read_region_file(find_region_file(town)), out=Path(folder))
            build_region(plan)
            region = read_region(plan.folder)
            bits = LayerBits.of(region.layers)
            west_m, south_m, east_m, north_m = region.grid.bounds_m
            for index in range(VIEWS_PER_TOWN):
                pose = Pose(
                    easting_m=(west_m + east_m) / 2,
                    northing_m=(south_m + north_m) / 2 - 60 * index,
                    yaw_deg=37.0 * index,
                )
                cells = observe(bits, region.grid, pose, size_cells=SIZE_CELLS, cell_size_m=1.0)
                views.append(Evidence(classes=region.classes, cells=cells, cell_size_m=1.0))
    return views


def milliseconds(perturbation: Perturbation, view: Evidence, runs: int) -> float:
    """Median of the runs on one view, after one that warms up."""
    rng, seconds = np.random.default_rng(0), []
    perturbation(view, rng)
    for _ in range(runs):
        start = time.perf_counter()
        perturbation(view, rng)
        seconds.append(time.perf_counter() - start)
    return statistics.median(seconds) * 1e3


def main() -> None:
    """Print one row for each perturbation: time, and what it did."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--runs", type=int, default=15)
    given = parser.parse_args()
    cv2.setNumThreads(1)
    views = town_views()
    print(f"{len(views)} views of {SIZE_CELLS} x {SIZE_CELLS} cells, {len(views[0].classes)} classes")
    print(f"{'':28} {'ms':>6} {'changed':>8} {'hidden':>7}")
    for name, perturbation in SHIPPED.items():
        after = [perturbation(view, np.random.default_rng(index)) for index, view in enumerate(views)]
        changed = statistics.fmean(map(share_changed, views, after))
        hidden = statistics.fmean(map(share_hidden, views, after))
        took_ms = statistics.fmean(milliseconds(perturbation, view, given.runs) for view in views)
        print(f"{name:28} {took_ms:6.2f} {changed:8.4f} {hidden:7.4f}", flush=True)


if __name__ == "__main__":
    main()
