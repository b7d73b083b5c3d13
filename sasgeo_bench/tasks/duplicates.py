# SPDX-License-Identifier: Apache-2.0
"""Duplicated ground: patches of one map that lie, rotated and moved, in another one.

Parts of a split keep their distance on the globe. That does not help if a file holds a place under another name, date
or coordinates. Then the same buildings have the same arrangement, which this search finds.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from itertools import combinations
from typing import Final

import geopandas as gpd
import numpy as np
import shapely
from numpy.typing import NDArray
from scipy.spatial import KDTree

from sasgeo_bench.tasks.split import Split

NEIGHBOURS: Final = 4
LEAST_ALIKE: Final = 8  # matching buildings that make a patch
LEAST_AREA_M2: Final = 40.0

_WITHIN_M: Final = 2.0  # tolerance of a match

Points = NDArray[np.float64]


@dataclass(frozen=True, slots=True, kw_only=True)
class Constellations:
    """Buildings of one map, and a key of each that does not depend on position and rotation.

    `en_m` has shape (N, 2), easting and northing; `keys` has shape (N,), uint64.
    """

    en_m: Points
    keys: NDArray[np.uint64]


@dataclass(frozen=True, slots=True, kw_only=True)
class Duplicate:
    """The largest patch that two maps share: the number of matching buildings, and its middle in either map."""

    count: int
    first_m: tuple[float, float]
    second_m: tuple[float, float]


def constellations(features: gpd.GeoDataFrame) -> Constellations:
    """Describe each building of a region by its area, and by the distances and areas of the four nearest ones.

    Only buildings of at least 40 m2 with four others within 250 m count. Distances are rounded to metres and areas to
    tenths of their size, so that another projection of the same ground gives nearly the same keys.
    """
    is_building = (features["class"] == "building").to_numpy() & features["is_visible"].to_numpy()
    shapes = features.geometry.to_numpy()[is_building]
    shapes = shapes[shapely.area(shapes) >= LEAST_AREA_M2]
    en_m = shapely.get_coordinates(shapely.centroid(shapes)).reshape(-1, 2)
    if len(en_m) <= NEIGHBOURS:
        return Constellations(en_m=np.zeros((0, 2)), keys=np.zeros(0, dtype=np.uint64))
    distances_m, nearest = (np.asarray(found) for found in KDTree(en_m).query(en_m, k=NEIGHBOURS + 1))
    areas = np.log(shapely.area(shapes)) / 0.1  # resolution of the area's logarithm
    described = np.column_stack((areas, distances_m[:, 1:] / 1.0, areas[nearest[:, 1:]]))
    is_near = distances_m[:, -1] < 250.0  # 250 m: largest distance of neighbours
    return Constellations(en_m=en_m[is_near], keys=_keys(np.floor(described[is_near]).astype(np.int64)))


def _keys(numbers: NDArray[np.int64]) -> NDArray[np.uint64]:
    """Return one number for each row: a multiplicative hash that is the same on any machine."""
    keys = np.zeros(len(numbers), dtype=np.uint64)
    for column in numbers.T.astype(np.uint64):
        keys = (keys ^ column) * np.uint64(0x9E3779B97F4A7C15)
        keys ^= keys >> np.uint64(29)
    return keys


def find_duplicate(first: Constellations, second: Constellations) -> Duplicate | None:
    """Return the largest patch whose buildings match up to a move and rotation; None below `LEAST_ALIKE` buildings."""
    one, two = _matches(first, second)
    if len(one) < LEAST_ALIKE:
        return None
    rng = np.random.default_rng(0)
    best = np.zeros(0, dtype=np.int64)
    for _ in range(300):
        at, other = rng.choice(len(one), size=2, replace=False)
        alike = _alike(one, two, int(at), int(other))
        if len(alike) > len(best):
            best = alike
    if len(best) < LEAST_ALIKE:
        return None
    middles = (tuple(float(value) for value in side[best].mean(axis=0)) for side in (one, two))
    (x0, y0), (x1, y1) = middles
    return Duplicate(count=len(best), first_m=(x0, y0), second_m=(x1, y1))


@dataclass(frozen=True, slots=True, kw_only=True)
class SharedGround:
    """Two blocks of different parts that hold the same ground, and the number of matching buildings."""

    first: str
    second: str
    count: int


def search_split(split: Split, maps: Mapping[str, Constellations]) -> tuple[SharedGround, ...]:
    """Search every two regions of different parts for shared ground; `maps` is by region, missing ones are skipped."""
    part_of = {block.region: split.part_of(place) for place, blocks in split.blocks.items() for block in blocks}
    listed = [region for region in part_of if region in maps]
    found = []
    for one, two in combinations(listed, 2):
        if part_of[one] == part_of[two]:
            continue
        shared = find_duplicate(maps[one], maps[two])
        if shared is not None:
            first, second = _block_at(split, one, shared.first_m), _block_at(split, two, shared.second_m)
            found.append(SharedGround(first=first, second=second, count=shared.count))
    return tuple(found)


def _block_at(split: Split, region: str, en_m: tuple[float, float]) -> str:
    return min(split.blocks_in(region), key=lambda block: float(block.polygon().distance(shapely.Point(en_m)))).id


def _matches(first: Constellations, second: Constellations) -> tuple[Points, Points]:
    """Match buildings of two maps by rare keys; return two arrays of shape (M, 2)."""
    rare = [_rare(item.keys) for item in (first, second)]
    left, right = first.keys[rare[0]], second.keys[rare[1]]
    order = np.argsort(right, kind="stable")
    low, high = (np.searchsorted(right[order], left, side=side) for side in ("left", "right"))
    pairs = [(at, int(order[index])) for at in np.flatnonzero(high > low) for index in range(low[at], high[at])]
    index = np.array(pairs, dtype=np.int64).reshape(-1, 2)
    return first.en_m[rare[0]][index[:, 0]], second.en_m[rare[1]][index[:, 1]]


def _rare(keys: NDArray[np.uint64]) -> NDArray[np.int64]:
    _, back, counts = np.unique(keys, return_inverse=True, return_counts=True)
    return np.flatnonzero(counts[back] <= 3)  # a key that is more frequent in one map belongs to rows of equal houses


def _alike(one: Points, two: Points, at: int, other: int) -> NDArray[np.int64]:
    """Return the matches that agree with the move and rotation given by two of them."""
    a, b = (complex(*(side[other] - side[at])) for side in (one, two))
    if abs(a) < 20.0 or abs(abs(a) - abs(b)) > _WITHIN_M:
        return np.zeros(0, dtype=np.int64)
    turn = b / a / abs(b / a)
    shifted = (one - one[at]) @ np.array([[turn.real, turn.imag], [-turn.imag, turn.real]]) + two[at]
    # Farther away, a small error of the rotation moves a building more.
    reach_m = np.hypot(*(one - one[at]).T)
    return np.flatnonzero(np.hypot(*(shifted - two).T) <= _WITHIN_M * (1 + reach_m / abs(a)))
