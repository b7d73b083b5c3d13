# SPDX-License-Identifier: Apache-2.0
"""Made-up maps that suit a kind of matcher each, and the view and the prior that matchers are asked about."""

from dataclasses import dataclass, replace
from functools import cache
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import shapely
from sasgeo_baselines.liu_object_graph import LiuObjectGraph

from sasgeo_bench.geometry.grid import Grid
from sasgeo_bench.geometry.pose import Pose, Prior
from sasgeo_bench.regions.evidence import PRESENT, UNKNOWN, Evidence
from sasgeo_bench.regions.graph import build_graph
from sasgeo_bench.sasgeo.nodes import INDEX, MOST_ARMS, Nodes
from sasgeo_bench.tasks.query import Query
from sasgeo_bench.tasks.vectors import as_features, vector_table
from tests.made_up import CLASSES, HERE, SIDE, query_of, region_of, textured, view_of

PRIOR = Prior(center_m=(1240.0, 8760.0), radius_m=100.0, yaw_deg=80.0, yaw_sigma_deg=5.0, scale_sigma=0.03)
ANYWHERE = Prior(center_m=None, radius_m=None, yaw_deg=None, yaw_sigma_deg=None, scale_sigma=0.03)


@dataclass(frozen=True)
class World:
    """A map, and the pose and the prior of the view that is asked about."""

    region: Any
    here: Pose = HERE
    prior: Prior = PRIOR
    drawn: Evidence | None = None  # the view, where it is not what the layers show

    def seen(self, size_cells: int) -> Evidence:
        return self.drawn or view_of(self.region, self.here, size_cells=size_cells)

    def query(self, size_cells: int, **changes: Any) -> Query:
        return replace(query_of(self.seen(size_cells), self.prior), **changes)


def hidden(query: Query, cols: slice) -> Query:
    """The same view with some columns unknown."""
    cells = query.evidence.cells.copy()
    cells[:, :, cols] = UNKNOWN
    return replace(query, evidence=query.evidence.replace(cells))


@cache
def things() -> World:
    """Houses, roads and ponds of many sizes, anywhere."""
    return World(region_of(textured(5)))


def with_features(layers: np.ndarray, name: str, shapes: list[shapely.Geometry], **changes: Any) -> World:
    """Layers with the features that they were drawn of, and their graph."""
    region = region_of(layers, **changes)
    region.features = as_features(vector_table([(name, 0, False, shape) for shape in shapes]))
    region.graph = build_graph(region.features)
    return World(region)


@cache
def houses() -> World:
    """Houses of many sizes, none of which touch."""
    rng = np.random.default_rng(1)
    kept: list[tuple[int, ...]] = []
    for _ in range(440):
        row, col = rng.integers(4, SIDE - 40, 2).tolist()
        house = (row, col, *rng.integers(7, 26, 2).tolist())
        if len(kept) < 110 and all(_are_apart(house, other) for other in kept):
            kept.append(house)
    layers, shapes = np.zeros((len(CLASSES), SIDE, SIDE), dtype=np.uint8), []
    for row, col, height, width in kept:
        layers[0, row : row + height, col : col + width] = 1
        shapes.append(shapely.box(1000 + col, 9000 - row - height, 1000 + col + width, 9000 - row))
    return with_features(layers, "building", shapes)


def _are_apart(one: tuple[int, ...], other: tuple[int, ...], gap: int = 4) -> bool:
    return any(
        first[at] + first[at + 2] + gap <= second[at] for first, second in ((one, other), (other, one)) for at in (0, 1)
    )


@cache
def bare() -> World:
    """A map that knows of no buildings and no roads, and has nothing else."""
    return with_features(np.zeros((1, SIDE, SIDE), dtype=np.uint8), "water", [], classes=("water",))


@cache
def streets() -> World:
    """Crooked streets 5 m wide between the corners of a lattice, of which a third are missing."""
    rng, count = np.random.default_rng(3), 9
    steps = 1030.0 + 46.0 * np.arange(count)
    corners = np.stack(np.meshgrid(steps, steps + 7575.0), axis=-1) + rng.uniform(-13, 13, (count, count, 2))
    pairs = [*zip(corners[:, :-1].reshape(-1, 2), corners[:, 1:].reshape(-1, 2), strict=True)]
    pairs += zip(corners[:-1].reshape(-1, 2), corners[1:].reshape(-1, 2), strict=True)
    lines = [shapely.LineString(pair) for pair in pairs if rng.random() < 0.7]
    layers = np.zeros((len(CLASSES), SIDE, SIDE), dtype=np.uint8)
    for line in lines:
        at = (shapely.get_coordinates(line) - (1000.0, 9000.0)) * (1, -1) - 0.5
        cv2.polylines(layers[1], [np.rint(at * 16).astype(np.int32)], isClosed=False, color=1, thickness=5, shift=4)
    return with_features(layers, "road_minor", lines)


@cache
def suburb() -> World:
    """Detached houses of many shapes on a lattice of 32 m, some with a wing."""
    rng = np.random.default_rng(3)
    layers = np.zeros((1, 640, 640), dtype=np.uint8)
    for top, left in np.ndindex(20, 20):
        row, col = np.array((top, left)) * 32 + rng.integers(0, 10, 2)
        height, width = rng.integers(6, 20, 2)
        if rng.random() < 0.7:
            layers[0, row : row + height, col : col + width] = 1
            if rng.random() < 0.5:
                layers[0, row : row + height // 2, col : col + width + 5] = 1
    return World(
        region_of(layers, classes=("building",)),
        here=Pose(easting_m=1330.0, northing_m=8660.0, yaw_deg=77.0),
        prior=replace(PRIOR, center_m=(1300.0, 8690.0), radius_m=120.0),
    )


def nodes(places_m: Any, names: list[str] | None = None, *, areas_m2: Any = 100.0, **changes: Any) -> Nodes:
    """Objects at places, of one kind or several."""
    places_m = np.asarray(places_m, dtype=np.float64).reshape(-1, 2)
    count = len(places_m)
    made = Nodes(
        places_m=places_m,
        kind=np.array([INDEX[name] for name in names or ["building patch"] * count], dtype=np.int64),
        degree=np.zeros(count, dtype=np.int64),
        area_m2=np.broadcast_to(np.asarray(areas_m2, dtype=np.float64), count).copy(),
        reach_m=np.zeros(count),
        arms_deg=np.full((count, MOST_ARMS), np.nan),
        pairs=np.zeros((0, 2), dtype=np.int64),
        relation=np.zeros(0, dtype=np.int64),
        feature=np.full(count, -1),
    )
    return replace(made, **changes)


class MadeUpMap(SimpleNamespace):
    """A map of nodes alone."""

    grid = Grid(epsg=32632, west_m=1000.0, north_m=9000.0, cell_size_m=1.0, rows=420, cols=420)

    def around(self, place_m: Any, radius_m: float) -> np.ndarray:
        return np.flatnonzero(np.hypot(*(self.nodes.places_m - place_m).T) <= radius_m)


class LiuOnMadeUp(LiuObjectGraph):
    """The matcher on a map of nodes alone."""

    def read(self, region: Any, learned: str | None) -> None:
        del learned
        self.mapped, self.grid = region, region.grid


def view_of_houses(view_m: Any, sides_m: list[int]) -> Evidence:
    """A view of 192 m with square houses, right and up of its middle, and a pond in its middle."""
    cells = np.zeros((2, 192, 192), dtype=np.uint8)
    cells[1, 90:102, 90:102] = PRESENT
    for (right, up), side in zip(view_m, sides_m, strict=True):
        row, col = round(96 - up - side / 2), round(96 + right - side / 2)
        cells[0, row : row + side, col : col + side] = PRESENT
    return Evidence(classes=("building", "water"), cells=cells, cell_size_m=1.0)


@cache
def village() -> World:
    """Sixteen houses and a pond in a view, and a map that has houses and ponds around them."""
    rng = np.random.default_rng(4)
    lattice = np.stack(np.meshgrid(np.arange(-60, 61, 40.0), np.arange(-60, 61, 40.0)), axis=-1).reshape(-1, 2)
    view_m = np.round(lattice + rng.uniform(-9, 9, lattice.shape))
    sides = rng.integers(6, 20, len(view_m))
    others_m = rng.uniform((1050, 8630), (1400, 8950), (100, 2))
    others_m = others_m[np.hypot(*(others_m - (HERE.easting_m, HERE.northing_m)).T) > 140]
    others = rng.integers(6, 20, len(others_m))
    names = ["building patch"] * len(view_m) + ["water patch"] + ["building patch", "water patch"] * len(others_m)
    places_m = np.concatenate([HERE.to_map(np.concatenate([view_m, [[0.0, 0.0]]])), others_m])
    town = nodes(places_m, names[: len(places_m)], areas_m2=np.concatenate([sides, [12], others]) ** 2.0)
    return World(MadeUpMap(nodes=town), drawn=view_of_houses(view_m, sides.tolist()))
