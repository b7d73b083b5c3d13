# SPDX-License-Identifier: Apache-2.0
"""Measure the search of many views at once by PyTorch, and its agreement with the search of one.

    .venv/bin/python benchmarks/torch_search.py --device cuda                         # 16 km2, 64 views
    .venv/bin/python benchmarks/torch_search.py --km2 1 --batch 4 --agree 4           # on a processor

The map is a made-up town in cells of 2 m with 13 classes; views of 192 m lie anywhere on it at any heading, a tenth of
what they see of each class is missed and as much made up, in patches. Place and heading are unknown, the scale is
known. Each row searches with other headings: those of the plan, then `--headings`.

A fix is a batch's time over its views, the median of `--runs` after two for warming up, with all copies to the device
and back but that of the map. Shares are those of the coarsest level and of all after it; what is left copies views and
makes results. The reference is `find.Search` with the same headings, one view after another on one core of the same
machine. Views agree where the best poses lie within half a cell of the map and half a degree. Modes agree where one of
the other's lies within a cell and a degree; scores are compared at those.
"""

import argparse
import math
import statistics
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from sasgeo_bench.core.errors import SasgeoError
from sasgeo_bench.geometry.grid import Grid
from sasgeo_bench.geometry.pose import Pose, Prior, wrap_deg
from sasgeo_bench.search.field import FULL, Field, Template, between, warped
from sasgeo_bench.search.find import Search
from sasgeo_bench.search.plan import Found, Mode, Plan
from sasgeo_bench.search.torch_search import BatchSearch, torch

CELL_M = 2.0
VIEW_CELLS = 96
CLASSES = 13
PATCH_CELLS = 6
MISSED, MADE_UP = 0.1, 0.1  # shares of what is seen of a class
AGREE, EXTRA, ABSENT = 1.0, 0.6, 0.4  # gains of Eqs. 7-8
ANYWHERE = Prior(center_m=None, radius_m=None, yaw_deg=None, yaw_sigma_deg=None, scale_sigma=0.0)


def town(side: int, rng: np.random.Generator) -> Field:
    """Draw roads, houses and areas of 13 classes on a square map."""
    layers = np.zeros((CLASSES, side, side), dtype=np.uint8)
    km2 = (side * CELL_M / 1000) ** 2
    for at, layer in enumerate(layers):
        if at < 4:  # a third of the classes are lines
            for _ in range(math.ceil(12 * km2)):
                start, turn = rng.uniform(0, side, 2), rng.uniform(0, 2 * math.pi)
                bends = turn + np.cumsum(rng.normal(0, 0.25, 12))
                ways = np.cumsum(
                    rng.uniform(10, 40, 12)[:, None] * np.column_stack((np.cos(bends), np.sin(bends))), axis=0
                )
                cv2.polylines(
                    layer, [np.rint(start + ways).astype(np.int32)], isClosed=False, color=FULL, thickness=1 + at
                )
        else:
            size = (4, 6, 8, 12, 16, 24, 32, 48, 64)[at - 4]
            for _ in range(math.ceil(9000 * km2 / size**1.6)):
                box = (tuple(rng.uniform(0, side, 2)), tuple(rng.uniform(0.5, 1.5, 2) * size), rng.uniform(0, 180))
                cv2.fillPoly(layer, [np.rint(cv2.boxPoints(box)).astype(np.int32)], FULL)
    grid = Grid(epsg=32632, west_m=5e5, north_m=5.3e6, cell_size_m=CELL_M, rows=side, cols=side)
    return Field.of(grid=grid, layers=layers, known=np.full((side, side), FULL, np.uint8))


def patches(share: float, rng: np.random.Generator) -> NDArray[np.bool_]:
    """Draw where a detector errs, shape (CLASSES, VIEW_CELLS, VIEW_CELLS)."""
    side = VIEW_CELLS // PATCH_CELLS
    errs = rng.random((CLASSES, side, side)) < share
    return errs.repeat(PATCH_CELLS, axis=1).repeat(PATCH_CELLS, axis=2)


def views_of(ground: Field, count: int, rng: np.random.Generator) -> list[Template]:
    """Look at a map from random poses."""
    west, south, east, north = ground.grid.bounds_m
    half_m = VIEW_CELLS * CELL_M / 2
    frame = Grid(epsg=0, west_m=-half_m, north_m=half_m, cell_size_m=CELL_M, rows=VIEW_CELLS, cols=VIEW_CELLS)
    views = []
    for _ in range(count):
        at = rng.uniform((west + half_m, south + half_m), (east - half_m, north - half_m))
        pose = Pose(easting_m=at[0], northing_m=at[1], yaw_deg=rng.uniform(0, 360))
        to_map = between(frame, pose, ground.grid)
        truth = np.stack([warped(layer, to_map, frame.shape) for layer in ground.layers]) > FULL // 2
        made_up = rng.permutation(truth) & patches(MADE_UP, rng)  # of another class, so in shapes of the town
        seen = ((truth & ~patches(MISSED, rng)) | made_up).astype(np.float32)
        weights = (AGREE + EXTRA) * seen - ABSENT * (1 - seen)
        views.append(Template(weights=weights, known=-EXTRA * seen.sum(axis=0), cell_size_m=CELL_M))
    return views


@dataclass(frozen=True, kw_only=True)
class Timed(BatchSearch):
    """A search that keeps the seconds of its two steps."""

    spent: dict[str, float] = field(default_factory=dict)

    def begun(self, *given: Any) -> Any:  # noqa: ANN401 - as of the search
        """Search the coarsest level."""
        return self._timed("coarse", lambda: super(Timed, self).begun(*given))

    def followed(self, *given: Any) -> Any:  # noqa: ANN401 - as of the search
        """Refine modes."""
        return self._timed("refined", lambda: super(Timed, self).followed(*given))

    def _timed(self, name: str, step: Callable[[], Any]) -> Any:  # noqa: ANN401
        found, self.spent[name] = seconds(step, self.device)
        return found


def seconds(call: Callable[[], Any], device: str) -> tuple[Any, float]:
    """Return what a call returns, and its time until the device has done all of it."""
    begun = time.perf_counter()
    found = call()
    if device == "cuda":
        torch.cuda.synchronize()
    return found, time.perf_counter() - begun


def is_near(one: Mode, other: Mode, near_m: float, near_deg: float) -> bool:
    """Tell if two modes lie within a distance and an angle."""
    east_m, north_m = one.pose.easting_m - other.pose.easting_m, one.pose.northing_m - other.pose.northing_m
    return (
        math.hypot(east_m, north_m) <= near_m
        and abs(float(wrap_deg(one.pose.yaw_deg - other.pose.yaw_deg))) <= near_deg
    )


def agreement(found: Sequence[Found], wanted: Sequence[Found]) -> str:
    """Return columns: views with the same best pose, modes found too, and the largest difference of scores."""
    best, modes, off = 0, [], [0.0]
    for mine, theirs in zip(found, wanted, strict=False):  # the first views alone are searched one by one
        best += is_near(mine.modes[0], theirs.modes[0], CELL_M / 2, 0.5)
        unit = abs(theirs.modes[0].score)
        for mode in theirs.modes:
            pairs = [other for other in mine.modes if is_near(mode, other, CELL_M, 1.0)]
            modes.append(bool(pairs))
            off += [abs(mode.score - other.score) / unit for other in pairs[:1]]
    return f"{best} of {len(wanted)} | {statistics.mean(modes):.3f} | {max(off):.1e}"


def row(given: argparse.Namespace, ground: Field, views: Sequence[Template], step_deg: float) -> str:
    """Measure one setting."""
    search = Timed(field=ground, device=given.device, yaw_step_deg=step_deg)
    priors = [ANYWHERE] * len(views)
    first = Search(field=ground, template=views[0], prior=ANYWHERE, plan=Plan(), yaw_step_deg=step_deg)
    headings = len(first.turns.bases) * first.turns.quarters
    for _ in range(2):
        search.places(views, priors)
    if given.device == "cuda":
        torch.cuda.reset_peak_memory_stats()
    runs, steps = [], []
    for _ in range(given.runs):
        found, spent = seconds(lambda: search.places(views, priors), given.device)
        runs.append(spent)
        steps.append((search.spent["coarse"], search.spent["refined"]))
    peak = f"{torch.cuda.max_memory_allocated() / 1e6:.0f}" if given.device == "cuda" else "-"
    whole = statistics.median(runs)
    coarse, refined = (statistics.median(column) / whole for column in zip(*steps, strict=True))
    wanted, alone = [], []
    for view in views[: given.agree]:
        one = Search(field=ground, template=view, prior=ANYWHERE, plan=Plan(), yaw_step_deg=step_deg)
        result, spent = seconds(lambda one=one: one.places(10, ()), "cpu")
        wanted.append(result)
        alone.append(spent)
    per_fix = 1000 * whole / len(views)
    spread = f"{1000 * min(runs) / len(views):.2f}-{1000 * max(runs) / len(views):.2f}"
    start = f"| {headings} | {len(views)} | {per_fix:.2f} | {spread} | {coarse:.0%} | {refined:.0%} | {peak} |"
    return f"{start} {1000 * statistics.median(alone):.0f} | {agreement(found, wanted)} |"


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--device", choices=("cpu", "cuda"), default="cpu")
    parser.add_argument("--km2", type=float, default=16.0, help="area of the map")
    parser.add_argument("--batch", type=int, nargs="+", default=[64], help="views searched at once")
    parser.add_argument("--headings", type=int, default=256)
    parser.add_argument("--runs", type=int, default=7)
    parser.add_argument("--agree", type=int, default=16, help="views to search one by one too")
    given = parser.parse_args()
    cv2.setNumThreads(1)
    if torch is None:
        sys.exit("no PyTorch: pip install 'sasgeo-bench[torch]'")
    if given.device == "cuda" and not torch.cuda.is_available():
        print("no GPU")
        return
    rng = np.random.default_rng(0)
    ground = town(round(math.sqrt(given.km2) * 1000 / CELL_M), rng)
    views = views_of(ground, max(given.batch), rng)
    name = torch.cuda.get_device_name() if given.device == "cuda" else f"processor, {torch.get_num_threads()} threads"
    print(f"{name}, PyTorch {torch.__version__}; {given.km2:g} km2 in cells of {CELL_M:g} m, {CLASSES} classes\n")
    head = "headings | views | fix, ms | from-to | coarse | refined | peak MB | one by one, ms | best | modes | scores"
    print(f"| {head} |\n|{'---:|' * 11}", flush=True)
    for step_deg in (math.inf, 360 / given.headings):
        for batch in given.batch:
            print(row(given, ground, views[:batch], step_deg), flush=True)


if __name__ == "__main__":
    try:
        main()
    except SasgeoError as error:
        sys.exit(str(error))
