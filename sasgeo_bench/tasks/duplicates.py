# SPDX-License-Identifier: Apache-2.0
"""Duplicated ground: patches of one map that lie, rotated and moved, in another one, and blocks that look alike.

Parts of a split keep their distance on the globe. That does not help if a file holds a place under another name, date
or coordinates. Then the same buildings have the same arrangement, which `search_split` finds. Nor does it help where
two places were built, or drawn, of one pattern: `find_alike` compares blocks of ten buildings outline by outline.
"""

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations
from typing import Final, Self

import geopandas as gpd
import numpy as np
import shapely
from numpy.typing import NDArray
from scipy.spatial import KDTree

from sasgeo_bench.tasks.split import Split

NEIGHBOURS: Final = 4
LEAST_ALIKE: Final = 8  # matching buildings that make a patch
LEAST_AREA_M2: Final = 40.0
BLOCK: Final = 10  # buildings of an arrangement: one and the nine nearest to it
ALIKE_M: Final = 1.0  # outlines nowhere farther apart are alike: a cell of most maps

_WITHIN_M: Final = 2.0  # tolerance of a match
_AT_ONCE: Final = 20_000  # pairs of blocks that are compared in one step: some 100 MB

Points = NDArray[np.float64]
Numbers = NDArray[np.int64]


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


@dataclass(frozen=True, slots=True, kw_only=True)
class Arrangements:
    """Buildings, and with each the nine nearest to it: a block of ten. Buildings that touch count as one.

    A row of garages or a terrace is drawn unit by unit in one place and as one in another; on a map of cells both are
    one shape, and any ten units of equal width would lie over any other ten.

    `ids` has shape (N,), `outlines` shape (N,), in metres, and so have `middles`, easting + i northing. `blocks` has
    shape (N, 10): rows of the buildings of each block, its own first, then by distance. `keys` has shape (N, 20),
    metres, and does not depend on position and rotation: distances of the nine, side of the own building, and sides of
    all ten by size; a side is the square root of an area.
    """

    ids: Numbers
    outlines: NDArray[np.object_]
    middles: NDArray[np.complex128]
    blocks: Numbers
    keys: Points

    @classmethod
    def of(cls, features: gpd.GeoDataFrame, *, as_drawn: bool = False) -> Self:
        """Describe the visible buildings of a region; none if there are fewer than ten.

        `as_drawn` keeps buildings that touch apart. Several have the id of the first; ids of relations are negative.
        """
        is_building = (features["class"] == "building").to_numpy() & features["is_visible"].to_numpy()
        outlines = features.geometry.to_numpy()[is_building]
        ids = (features["osm_id"] * np.where(features["osm_type"] == "way", 1, -1)).to_numpy(np.int64)[is_building]
        if not as_drawn:
            outlines, ids = _merged(outlines, ids)
        if len(outlines) < BLOCK:
            outlines, ids = outlines[:0], ids[:0]
        at_m = shapely.get_coordinates(shapely.centroid(outlines)).reshape(-1, 2)
        middles = at_m[:, 0] + 1j * at_m[:, 1]
        if not len(middles):
            none = np.zeros((0, BLOCK), dtype=np.int64)
            return cls(ids=ids, outlines=outlines, middles=middles, blocks=none, keys=np.zeros((0, 2 * BLOCK)))
        distances_m, blocks = (np.asarray(found) for found in KDTree(at_m).query(at_m, k=BLOCK))
        own = np.arange(len(middles))
        is_own = blocks == own[:, None]  # of buildings with one middle another may come first
        is_own[~is_own.any(axis=1), -1] = True
        blocks = np.column_stack((own, blocks[~is_own].reshape(-1, BLOCK - 1)))
        sides_m = np.sqrt(shapely.area(outlines))
        keys = np.column_stack((distances_m[:, 1:], sides_m, np.sort(sides_m[blocks], axis=1)))
        return cls(ids=ids, outlines=outlines, middles=middles, blocks=blocks, keys=keys)

    @classmethod
    def joined(cls, maps: Sequence[Self]) -> Self:
        """Return the blocks of several maps in one, in their order."""
        first = np.cumsum([0, *(len(one.ids) for one in maps)])
        return cls(
            ids=np.concatenate([one.ids for one in maps]),
            outlines=np.concatenate([one.outlines for one in maps]),
            middles=np.concatenate([one.middles for one in maps]),
            blocks=np.concatenate([one.blocks + at for one, at in zip(maps, first, strict=False)]),
            keys=np.concatenate([one.keys for one in maps]),
        )

    def __len__(self) -> int:
        return len(self.ids)


def _merged(outlines: NDArray[np.object_], ids: Numbers) -> tuple[NDArray[np.object_], Numbers]:
    """Return buildings with those that come within `ALIKE_M` of each other as one, in the order of their first ones."""
    half_m = ALIKE_M / 2
    grown = shapely.get_parts(shapely.union_all(shapely.buffer(outlines, half_m, join_style="mitre", mitre_limit=2.0)))
    member, body = shapely.STRtree(grown).query(shapely.point_on_surface(outlines), predicate="intersects")
    first = np.full(len(grown), len(outlines))
    np.minimum.at(first, body, member)
    order = np.argsort(first, kind="stable")
    order = order[first[order] < len(outlines)]  # an outline that crosses itself leaves slivers
    return shapely.buffer(grown[order], -half_m, join_style="mitre", mitre_limit=2.0), ids[first[order]]


@dataclass(frozen=True, slots=True, kw_only=True)
class Alike:
    """Pairs of blocks, by their rows in two `Arrangements`, and how far their outlines are apart; shape (M,) each."""

    first: Numbers
    second: Numbers
    apart_m: Points


def find_alike(first: Arrangements, second: Arrangements, *, within_m: float = ALIKE_M) -> Alike:
    """Find the blocks of ten that lie over one another, once moved and rotated, nowhere farther apart than `within_m`.

    The nearest pair comes first. Pairs that share a building (of one id) are left out: a row lies over itself, moved by
    a house. Mirrored blocks are not alike.

    Notes
    -----
    Candidates are pairs whose `keys` differ nowhere by more than `2 * within_m`, since buildings that are moved by
    `within_m` change their distance by twice as much. For each, every rotation that lays the farthest neighbour over
    one of the other block is tried, the one with the smallest error of the middles is fitted by least squares, and the
    Hausdorff distance of each two outlines is taken; the largest of the ten is `apart_m`. A copy may be missed where
    its ninth and tenth neighbour are equally far away; of a whole block others are found.

    Examples
    --------
    >>> east, north = np.indices((8, 5)).reshape(2, 40) * 30.0 + np.random.default_rng(0).uniform(0, 15, (2, 40))
    >>> town = gpd.GeoDataFrame(
    ...     {"class": "building", "is_visible": True, "osm_type": "way", "osm_id": range(40)},
    ...     geometry=shapely.box(east, north, east + 9, north + 12),
    ... )
    >>> copy = town.assign(osm_id=range(40, 80), geometry=town.rotate(30, origin=(0, 0)))
    >>> len(find_alike(Arrangements.of(town), Arrangements.of(copy)).first)
    40
    """
    # `query_ball_tree` takes four times as long.
    listed = np.asarray(KDTree(second.keys).query_ball_point(first.keys, 2 * within_m, p=np.inf), dtype=object)
    one = np.repeat(np.arange(len(listed)), [len(found) for found in listed])
    two = np.fromiter((row for found in listed for row in found), dtype=np.int64, count=len(one))
    apart_m = np.full(len(one), np.inf)
    for start in range(0, len(one), _AT_ONCE):
        step = slice(start, start + _AT_ONCE)
        apart_m[step] = _apart_m(first, second, one[step], two[step], within_m=within_m)
    order = np.argsort(apart_m, kind="stable")
    order = order[apart_m[order] <= within_m]
    return Alike(first=one[order], second=two[order], apart_m=apart_m[order])


def _apart_m(first: Arrangements, second: Arrangements, one: Numbers, two: Numbers, *, within_m: float) -> Points:
    """Return how far the outlines of pairs of blocks are apart: infinity if their middles are, or if they share one."""
    blocks, others = first.blocks[one], second.blocks[two]
    order, worst_m = _order(first.middles[blocks], second.middles[others])
    others = np.take_along_axis(others, order, axis=1)
    is_shared = (first.ids[blocks][:, :, None] == second.ids[others][:, None, :]).any(axis=(1, 2))
    kept = np.flatnonzero((worst_m <= 2 * within_m) & ~is_shared)
    blocks, others = blocks[kept], others[kept]
    ways, other_ways = first.middles[blocks], second.middles[others]
    centre, other_centre = ways.mean(axis=1, keepdims=True), other_ways.mean(axis=1, keepdims=True)
    turn = np.exp(1j * np.angle(((other_ways - other_centre) * (ways - centre).conj()).sum(axis=1)))
    points, building = shapely.get_coordinates(first.outlines[blocks.ravel()], return_index=True)
    pair = building // BLOCK
    moved = (points[:, 0] + 1j * points[:, 1] - centre[pair, 0]) * turn[pair] + other_centre[pair, 0]
    laid = shapely.set_coordinates(first.outlines[blocks.ravel()], np.column_stack((moved.real, moved.imag)))
    between_m = shapely.hausdorff_distance(laid, second.outlines[others.ravel()])
    found = np.full(len(one), np.inf)
    found[kept] = between_m.reshape(-1, BLOCK).max(axis=1)
    return found


def _order(middles: NDArray[np.complex128], others: NDArray[np.complex128]) -> tuple[Numbers, Points]:
    """Return which building of the other block lies over each, for the best rotation, and the largest error, metres."""
    ways, others = middles - middles[:, :1], others - others[:, :1]
    worst_m, order = np.full(len(ways), np.inf), np.zeros(ways.shape, dtype=np.int64)
    for at in range(1, ways.shape[1]):
        turn = np.exp(1j * (np.angle(others[:, at]) - np.angle(ways[:, -1])))
        gaps_m = np.abs((ways * turn[:, None])[:, :, None] - others[:, None, :])
        nearest, error_m = gaps_m.argmin(axis=2), gaps_m.min(axis=2).max(axis=1)
        is_better = (np.sort(nearest, axis=1) == np.arange(ways.shape[1])).all(axis=1) & (error_m < worst_m)
        worst_m[is_better], order[is_better] = error_m[is_better], nearest[is_better]
    return order, worst_m


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


def search_look_alikes(split: Split, maps: Mapping[str, Arrangements]) -> tuple[SharedGround, ...]:
    """Search different parts for blocks of ten that look alike; `maps` is by region, missing ones are skipped.

    `count` is the number of pairs of blocks of ten between two evaluation blocks.
    """
    regions: dict[str, list[str]] = {}
    for place, blocks in split.blocks.items():
        for region in dict.fromkeys(block.region for block in blocks if block.region in maps):
            regions.setdefault(split.part_of(place), []).append(region)
    joined = {part: Arrangements.joined([maps[name] for name in names]) for part, names in regions.items()}
    of_row = {part: np.repeat(names, [len(maps[name]) for name in names]) for part, names in regions.items()}
    found: Counter[tuple[str, str]] = Counter()
    for one, two in combinations(joined, 2):
        alike = find_alike(joined[one], joined[two])
        for rows in zip(alike.first, alike.second, strict=True):
            at = [joined[part].middles[row] for part, row in zip((one, two), rows, strict=True)]
            names = [str(of_row[part][row]) for part, row in zip((one, two), rows, strict=True)]
            first, second = (_block_at(split, name, (z.real, z.imag)) for name, z in zip(names, at, strict=True))
            found[first, second] += 1
    return tuple(SharedGround(first=first, second=second, count=count) for (first, second), count in found.items())


def _block_at(split: Split, region: str, en_m: tuple[float, float]) -> str:
    return min(split.blocks_in(region), key=lambda block: float(block.polygon().distance(shapely.Point(en_m)))).id
