# SPDX-License-Identifier: Apache-2.0
"""A made-up map full of small things, and views cut from it."""

import datetime as dt
from types import SimpleNamespace

import numpy as np

from sasgeo_bench.geometry.grid import Grid
from sasgeo_bench.geometry.pose import Pose, Prior
from sasgeo_bench.regions.evidence import Evidence, LayerBits, observe
from sasgeo_bench.tasks.query import Query

CLASSES = ("building", "road_minor", "water")
SIDE = 420


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


def region_of(layers: np.ndarray, *, cell_size_m: float = 1.0, classes: tuple[str, ...] = CLASSES) -> SimpleNamespace:
    """As much of a Region as a baseline reads."""
    rows, cols = layers.shape[1:]
    grid = Grid(epsg=32632, west_m=1000.0, north_m=9000.0, cell_size_m=cell_size_m, rows=rows, cols=cols)
    return SimpleNamespace(layers=layers, grid=grid, classes=classes)


def view_of(region: SimpleNamespace, pose: Pose, *, size_cells: int, cell_size_m: float = 1.0) -> Evidence:
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
