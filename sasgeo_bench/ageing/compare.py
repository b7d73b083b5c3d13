# SPDX-License-Identifier: Apache-2.0
"""Compare one class in two states: what of each is missing in the other, and how far the rest has moved."""

from dataclasses import dataclass
from typing import Final, NamedTuple

import numpy as np
import pandas as pd
import shapely
from numpy.typing import NDArray

from sasgeo_bench.geometry.pairs import overlapping

MATCH_IOU: Final = 0.3  # of two areas that are one thing
NEAR_M: Final = 5.0  # roads in OSM lie within about 6 m of the truth, and so do re-drawn ones
REDRAWN_M: Final = 1.0  # below this a shift is rounding or a tidied corner
COVER_SHARE: Final = 0.5  # of an area covered by another class or a hint that explains it
STEP_M: Final = 5.0  # lines are compared in pieces no longer than this
LEAST_WIDTH_M: Final = 1.0  # of the ground under a line: a cell of a map, however thin a fence is
_CENTIMETRES: Final = 100.0
_LEAST_M2: Final = 1e-6
_POLYGONAL: Final = (3, 6)
_LINEAR: Final = (1, 2, 5)

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
Flags = NDArray[np.bool_]
Geometries = NDArray[np.object_]


@dataclass(frozen=True, slots=True, kw_only=True)
class Areas:
    """Area things of one class in one state: valid polygons, shape (N,), and the row of the table each comes from."""

    rows: Ints
    shapes: Geometries


@dataclass(frozen=True, slots=True, kw_only=True)
class Pieces:
    """Line things of one class in one state, cut into pieces no longer than `STEP_M`, shape (P,).

    `things` numbers the things 0..T-1, `rows` (T,) gives the row of the table each comes from. `keys` identifies equal
    segments in either direction. `segments` are the lines that other states measure their distance to, with whole areas
    of the class (squares), which have no length here. `widths_m` (P,) is the width of the ground under each piece.
    """

    rows: Ints
    things: Ints
    middles: Floats
    lengths_m: Floats
    widths_m: Floats
    keys: NDArray[np.uint64]
    segments: Geometries


@dataclass(frozen=True, slots=True, kw_only=True)
class Verdict:
    """The part of one state that is missing in another, by unit: an area thing or a piece of a line, shape (U,).

    `amount` and `lost` are in m2 or m; `uncovered` is the amount of ground that no thing of the class covers, whatever
    the pairing: a raster sees this. `xy_m` (U, 2) is the place of the unit; `thing` (U,) numbers its thing, and
    `shift_m` (T,) is the shift of each matched thing, NaN if unknown.
    """

    amount: Floats
    lost: Floats
    uncovered: Floats
    xy_m: Floats
    thing: Ints
    shift_m: Floats

    @property
    def is_lost(self) -> Flags:
        """Return which units lost more than they kept."""
        return np.asarray(self.lost > COVER_SHARE * self.amount)

    @property
    def lost_things(self) -> int:
        """Return the number of things that lost more than they kept; a line's pieces are added up."""
        things = len(self.shift_m)
        lost, amount = (np.bincount(self.thing, weights=of, minlength=things) for of in (self.lost, self.amount))
        return int((lost > COVER_SHARE * amount).sum())


def cut_to(shapes: Geometries, area: shapely.Geometry) -> Geometries:
    """Cut geometries to an area; those wholly within are returned unchanged."""
    shapely.prepare(area)
    cut = shapes.copy()
    crosses = ~shapely.contains_properly(area, shapes)
    cut[crosses] = shapely.intersection(shapely.make_valid(shapes[crosses]), area)
    return np.asarray(cut)


def polygons_of(shapes: Geometries) -> Geometries:
    """Return valid polygons or multipolygons; a geometry without area becomes empty."""
    valid = shapes.copy()
    broken = ~shapely.is_valid(shapes)
    valid[broken] = shapely.make_valid(shapes[broken])
    for index in np.flatnonzero(~np.isin(shapely.get_type_id(valid), _POLYGONAL)):
        parts = shapely.get_parts(shapely.get_parts(valid[index]))
        valid[index] = shapely.multipolygons(parts[shapely.get_type_id(parts) == _POLYGONAL[0]])
    return np.asarray(valid)


def make_areas(shapes: Geometries) -> Areas:
    """Return area things of a table's rows; rows without an area are left out."""
    valid = polygons_of(shapes)
    rows = np.flatnonzero(shapely.area(valid) > _LEAST_M2)
    return Areas(rows=rows, shapes=valid[rows])


def make_pieces(shapes: Geometries, widths_m: Floats | None = None) -> Pieces:
    """Cut line things of a table's rows into pieces; areas among them only support other lines.

    `widths_m` (N,) is the width in which each row is drawn, `LEAST_WIDTH_M` at least and where it is unknown.

    >>> pieces = make_pieces(np.array([shapely.LineString([(0, 0), (12, 0)]), shapely.box(0, 0, 1, 1)]))
    >>> pieces.lengths_m.tolist(), len(pieces.segments)
    ([4.0, 4.0, 4.0], 2)
    """
    kinds = shapely.get_type_id(shapes)
    squares = shapes[np.isin(kinds, _POLYGONAL)]
    rows = np.flatnonzero(~np.isin(kinds, _POLYGONAL) & (shapely.length(shapes) > 0))
    parts, owner = _linear_parts(shapes[rows])
    points, part = shapely.get_coordinates(parts, return_index=True)
    joined = np.flatnonzero(part[:-1] == part[1:]) if len(part) else np.zeros(0, dtype=np.int64)
    starts, ends = points[joined], points[joined + 1]
    lengths = np.hypot(*(ends - starts).T) if len(joined) else np.zeros(0)
    real = lengths > 0
    starts, ends, lengths, joined = starts[real], ends[real], lengths[real], joined[real]
    count = np.ceil(lengths / STEP_M).astype(np.int64)
    segment = np.repeat(np.arange(len(lengths)), count)
    order = np.arange(len(segment)) - np.repeat(np.cumsum(count) - count, count)
    along = ((order + 0.5) / count[segment])[:, None]
    lines = shapely.linestrings(np.stack((starts, ends), axis=1)) if len(lengths) else np.array([], dtype=object)
    things = owner[part[joined]][segment]
    widths = np.full(len(rows), LEAST_WIDTH_M) if widths_m is None else np.fmax(widths_m[rows], LEAST_WIDTH_M)
    return Pieces(
        rows=rows,
        things=things,
        widths_m=widths[things],
        middles=starts[segment] + along * (ends - starts)[segment],
        lengths_m=(lengths / np.maximum(count, 1))[segment],
        keys=_segment_keys(starts, ends)[segment],
        segments=np.concatenate((lines, squares)),
    )


def _linear_parts(shapes: Geometries) -> tuple[Geometries, Ints]:
    parts, owner = shapely.get_parts(shapes, return_index=True)
    deeper, inner = shapely.get_parts(parts, return_index=True)
    is_line = np.isin(shapely.get_type_id(deeper), _LINEAR)
    return deeper[is_line], owner[inner[is_line]]


def _segment_keys(starts: Floats, ends: Floats) -> NDArray[np.uint64]:
    first, last = (np.round(points * _CENTIMETRES).astype(np.int64).reshape(-1, 2) for points in (starts, ends))
    turned = (first[:, 0] > last[:, 0]) | ((first[:, 0] == last[:, 0]) & (first[:, 1] > last[:, 1]))
    low, high = np.where(turned[:, None], last, first), np.where(turned[:, None], first, last)
    hashed = pd.util.hash_pandas_object(pd.DataFrame(np.hstack((low, high))), index=False)
    return np.asarray(hashed.to_numpy(), dtype=np.uint64)


def compare_areas(these: Areas, others: Areas) -> Verdict:
    """Find which areas of one state have no counterpart in another; shifts are those of the centroids.

    Areas with a counterpart of IoU above `MATCH_IOU` lose nothing; the rest, split, merged or gone, lose what no area
    of the other state covers.

    >>> old = make_areas(shapely.box([0, 50], 0, [10, 60], 10))
    >>> new = make_areas(shapely.box([2], 0, [12], 10))
    >>> found = compare_areas(old, new)
    >>> found.lost.tolist(), found.shift_m.tolist()
    ([0.0, 100.0], [2.0, nan])
    """
    amount = shapely.area(these.shapes)
    lost, uncovered, shift = np.zeros(len(amount)), np.zeros(len(amount)), np.zeros(len(amount))
    changed = np.flatnonzero(~_is_among(these.shapes, others.shapes))
    overlap = _overlap(these.shapes[changed], others.shapes)
    rest = np.maximum(amount[changed] - overlap.covered, 0.0)
    rest[rest < _LEAST_M2 * amount[changed]] = 0.0
    is_matched = overlap.best_iou > MATCH_IOU
    lost[changed], uncovered[changed] = np.where(is_matched, 0.0, rest), rest
    centres = shapely.get_coordinates(shapely.centroid(these.shapes)).reshape(-1, 2)
    shift[changed] = np.nan
    matched = changed[is_matched]
    there = shapely.get_coordinates(shapely.centroid(others.shapes[overlap.best[is_matched]])).reshape(-1, 2)
    shift[matched] = np.hypot(*(centres[matched] - there).T)
    things = np.arange(len(amount))
    return Verdict(amount=amount, lost=lost, uncovered=uncovered, xy_m=centres, thing=things, shift_m=shift)


def _is_among(these: Geometries, others: Geometries) -> Flags:
    """Return which geometries occur bit by bit in the other state: most do, and need no search for neighbours."""
    known = pd.Index(shapely.to_wkb(shapely.normalize(others)))
    return np.asarray(pd.Index(shapely.to_wkb(shapely.normalize(these))).isin(known))


@dataclass(frozen=True, slots=True, kw_only=True)
class _Overlap:
    """IoU and number of the best counterpart of each area, and how much of it all counterparts cover, m2."""

    best: Ints
    best_iou: Floats
    covered: Floats


def _overlap(these: Geometries, others: Geometries) -> _Overlap:
    pairs = _intersections(these, others)
    best, best_iou = np.zeros(len(these), dtype=np.int64), np.zeros(len(these))
    ascending = np.argsort(pairs.iou, kind="stable")
    best[pairs.left[ascending]], best_iou[pairs.left[ascending]] = pairs.right[ascending], pairs.iou[ascending]
    covered = _covered_m2(pairs.left, pairs.shared, pairs.shared_m2, count=len(these))
    return _Overlap(best=best, best_iou=best_iou, covered=covered)


class _Intersections(NamedTuple):
    """Rows of areas that overlap, sorted, with what they share and their IoU."""

    left: Ints
    right: Ints
    shared: Geometries
    shared_m2: Floats
    iou: Floats


def _intersections(these: Geometries, others: Geometries) -> _Intersections:
    left, right = overlapping(these, others, predicate="intersects")
    order = np.lexsort((right, left))
    left, right = left[order], right[order]
    shared = shapely.intersection(these[left], others[right])
    shared_m2 = shapely.area(shared)
    real = shared_m2 > _LEAST_M2
    left, right, shared, shared_m2 = left[real], right[real], shared[real], shared_m2[real]
    iou = shared_m2 / (shapely.area(these)[left] + shapely.area(others)[right] - shared_m2)
    return _Intersections(left, right, shared, shared_m2, iou)


def _covered_m2(left: Ints, shared: Geometries, shared_m2: Floats, *, count: int) -> Floats:
    """Return the area of each union of shared pieces: a plain sum if there is one piece, as nearly everywhere."""
    covered = np.bincount(left, weights=shared_m2, minlength=count).astype(np.float64)
    pieces = np.bincount(left, minlength=count)
    starts = np.cumsum(pieces) - pieces
    for index in np.flatnonzero(pieces > 1):
        part = slice(starts[index], starts[index] + pieces[index])
        covered[index] = shapely.area(shapely.union_all(shared[part]))
    return covered


def compare_pieces(these: Pieces, others: Pieces) -> Verdict:
    """Find which pieces of line have no line of the other state within `NEAR_M`; a piece is lost whole or not at all.

    The shift of a thing is the median, over its kept length, of the distance to the other state. A piece that lies d
    beside its line of width w no longer covers d / w of its ground.

    >>> old = make_pieces(np.array([shapely.LineString([(0, 0), (20, 0)])]))
    >>> new = make_pieces(np.array([shapely.LineString([(0, 2), (10, 2)])]))
    >>> found = compare_pieces(old, new)
    >>> float(found.lost.sum()), float(found.uncovered.sum())
    (5.0, 20.0)
    >>> wide = make_pieces(np.array([shapely.LineString([(0, 0), (20, 0)])]), np.array([8.0]))
    >>> float(compare_pieces(wide, new).uncovered.sum().round(3))
    9.501
    """
    distance = np.zeros(len(these.keys))
    changed = np.flatnonzero(~np.isin(these.keys, others.keys))
    distance[changed] = distance_m(these.middles[changed], others.segments)
    kept = distance <= NEAR_M
    lost = np.where(kept, 0.0, these.lengths_m)
    shift = np.full(len(these.rows), np.nan)
    things, medians = _medians(these.things[kept], distance[kept], these.lengths_m[kept])
    shift[things] = medians
    beside = np.minimum(distance / these.widths_m, 1.0)
    return Verdict(
        amount=these.lengths_m,
        lost=lost,
        uncovered=np.where(kept, these.lengths_m * beside, lost),
        xy_m=these.middles,
        thing=these.things,
        shift_m=shift,
    )


def distance_m(points_m: Floats, targets: Geometries, *, within_m: float = NEAR_M) -> Floats:
    """Return the distance from points, shape (N, 2), to the nearest target; infinite beyond `within_m`."""
    found = np.full(len(points_m), np.inf)
    if len(targets) == 0 or len(points_m) == 0:
        return found
    tree = shapely.STRtree(targets)
    (left, _), distance = tree.query_nearest(
        shapely.points(points_m), max_distance=within_m, return_distance=True, all_matches=False
    )
    found[left] = distance
    return found


def _medians(things: Ints, values: Floats, weights: Floats) -> tuple[Ints, Floats]:
    """Return numbers of the things that occur, ascending, and the weighted median of each one's values."""
    order = np.lexsort((values, things))
    things, values, weights = things[order], values[order], weights[order]
    present, starts = np.unique(things, return_index=True)
    if len(present) == 0:
        return present, np.zeros(0)
    total = np.add.reduceat(weights, starts)
    before = np.cumsum(weights) - weights
    within = before - np.repeat(before[starts], np.diff(np.append(starts, len(things))))
    passed = within + weights >= np.repeat(total, np.diff(np.append(starts, len(things)))) / 2 - _LEAST_M2
    first = np.flatnonzero(passed)
    _, chosen = np.unique(things[first], return_index=True)
    return present, values[first[chosen]]


def covered_share(shapes: Geometries, covers: Geometries) -> Floats:
    """Return the share of each area that other areas cover together; lines and points cover nothing."""
    areas = covers[np.isin(shapely.get_type_id(covers), _POLYGONAL)] if len(covers) else covers
    if len(shapes) == 0 or len(areas) == 0:
        return np.zeros(len(shapes))
    return np.asarray(_overlap(shapes, areas).covered / shapely.area(shapes))


def replaced_share(shapes: Geometries, newcomers: Geometries) -> Floats:
    """Return the share of each area replaced by newcomers: those paired with it, and those mostly within it.

    A forest that grows over a house takes the ground, not the place of the house; a car park on its footprint does.

    >>> house = shapely.box([0], 0, [10], 10)
    >>> replaced_share(house, shapely.box([-500], -500, [500], 500)).tolist()
    [0.0]
    >>> replaced_share(house, shapely.box([0], 0, [10], 8)).tolist()
    [0.8]
    """
    if len(shapes) == 0 or len(newcomers) == 0:
        return np.zeros(len(shapes))
    pairs = _intersections(shapes, newcomers)
    real = (pairs.iou > MATCH_IOU) | (pairs.shared_m2 > COVER_SHARE * shapely.area(newcomers)[pairs.right])
    covered = _covered_m2(pairs.left[real], pairs.shared[real], pairs.shared_m2[real], count=len(shapes))
    return np.asarray(covered / shapely.area(shapes))
