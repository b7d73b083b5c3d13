# SPDX-License-Identifier: Apache-2.0
"""A made-up map full of small things, views cut from it, and flights over it without errors of perception."""

import datetime as dt
from collections.abc import Mapping, Sequence
from dataclasses import replace
from types import SimpleNamespace

import numpy as np

from sasgeo_bench.geometry.grid import Grid
from sasgeo_bench.geometry.pose import Pose, Prior
from sasgeo_bench.matching.tracker import Fix, Tracker, check_fix
from sasgeo_bench.regions.evidence import UNKNOWN, Evidence, LayerBits, observe
from sasgeo_bench.regions.region import Region
from sasgeo_bench.tasks.query import Query, Step

CLASSES = ("building", "road_minor", "water")
SIDE = 420
HERE = Pose(easting_m=1210.0, northing_m=8790.0, yaw_deg=77.0)  # on a map of that side, far enough from its edges


def textured(seed: int, side: int = SIDE) -> np.ndarray:
    """Houses of many sizes, long thin roads and ponds, anywhere."""
    rng = np.random.default_rng(seed)
    layers = np.zeros((len(CLASSES), side, side), dtype=np.uint8)
    for band, (count, longest) in enumerate(((side * side // 400, 14), (0, 0), (side * side // 9000, 40))):
        for _ in range(count):
            row, col = rng.integers(0, side, 2)
            height, width = rng.integers(4, longest, 2)
            layers[band, row : row + height, col : col + width] = 1
    for _ in range(side // 12):
        row, col = rng.integers(0, side, 2)
        length = int(rng.integers(20, side // 2))
        if rng.random() < 0.5:
            layers[1, row : row + 4, col : col + length] = 1
        else:
            layers[1, row : row + length, col : col + 4] = 1
    return layers


class MadeUp(SimpleNamespace):
    """What matchers read of a region."""

    read_layer = keep = None
    layer = Region.layer
    known = Region.known
    kept = Region.kept


def error_m(answer, pose=HERE):
    """How far the first pose of an answer is from a place."""
    best = answer.poses[0]
    return np.hypot(best.easting_m - pose.easting_m, best.northing_m - pose.northing_m)


def region_of(layers: np.ndarray, *, cell_size_m: float = 1.0, classes: tuple[str, ...] = CLASSES) -> MadeUp:
    """As much of a Region as a baseline reads."""
    rows, cols = layers.shape[1:]
    grid = Grid(epsg=32632, west_m=1000.0, north_m=9000.0, cell_size_m=cell_size_m, rows=rows, cols=cols)
    return MadeUp(layers=layers, grid=grid, classes=classes)


def view_of(region: MadeUp, pose: Pose, *, size_cells: int, cell_size_m: float = 1.0) -> Evidence:
    """What is seen without an error."""
    bits = LayerBits.of(region.layers)
    cells = observe(bits, region.grid, pose, size_cells=size_cells, cell_size_m=cell_size_m)
    return Evidence(classes=region.classes, cells=cells, cell_size_m=cell_size_m)


def query_of(evidence: Evidence, prior: Prior, *, candidates: tuple[Pose, ...] = (), query_id: str = "q") -> Query:
    """A question about a view."""
    return Query(
        query_id=query_id,
        track="retrieval" if candidates else "localization",
        suite="clean",
        suite_version=1,
        part="crossfit",
        region="made-up",
        evidence=evidence,
        observed_on=dt.date(2025, 1, 1),
        season="",
        prior=prior,
        prior_group="r250-weak-s3",
        candidates=candidates,
    )


def dated_region(seed: int, side: int) -> MadeUp:
    """A made-up region of the day of its views, as a reader of map ages asks for it."""
    found = region_of(textured(seed, side))
    found.manifest = SimpleNamespace(extract=SimpleNamespace(date=dt.date(2025, 1, 1)))
    return found


VIEW_CELLS = 128


def way_of(start: Pose, count: int, step_m: float) -> list[Pose]:
    """Poses of a straight flight, ahead of the first."""
    ahead_m = np.array([(0.0, frame * step_m) for frame in range(count)])
    return [replace(start, easting_m=east_m, northing_m=north_m) for east_m, north_m in start.to_map(ahead_m).tolist()]


def flight_of(
    region: MadeUp,
    poses: Sequence[Pose],
    *,
    prior: Prior,
    increment: tuple[float, float, float],
    sigmas: tuple[float, float, float],
    said: Mapping[int, tuple[float, float, float]] | None = None,
) -> list[Query]:
    """Views at poses; the odometer says `increment` of each step, or what `said` maps a frame to."""
    views = []
    covariance = tuple(np.diag(np.square(sigmas)).ravel().tolist())
    for frame, pose in enumerate(poses):
        step = Step(sequence_id="f", frame=frame)
        if frame:
            step = replace(step, increment=(said or {}).get(frame, increment), covariance=covariance)
        evidence = view_of(region, pose, size_cells=VIEW_CELLS)
        views.append(replace(query_of(evidence, prior), track="sequence", step=step))
    return views


def fly(tracker: Tracker, views: Sequence[Query], prior: Prior) -> list[Fix]:
    """Follow a flight, and check each fix."""
    tracker.start(prior)
    return [check_fix(tracker.step(view), top_k=5) for view in views]


def away_m(fix: Fix, pose: Pose) -> float:
    """Distance of an estimate from a pose."""
    assert fix.pose is not None
    return float(np.hypot(fix.pose.easting_m - pose.easting_m, fix.pose.northing_m - pose.northing_m))


def blind(view: Query) -> Query:
    """A view that shows nothing."""
    return replace(view, evidence=view.evidence.replace(np.full_like(view.evidence.cells, UNKNOWN)))
