# SPDX-License-Identifier: Apache-2.0
"""Measure a history of dated states: shares, shifts, rates and explanations by tags, per class and pair of dates."""

import datetime as dt
import hashlib
import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Final, NamedTuple

import geopandas as gpd
import numpy as np
import pandas as pd
import shapely
from numpy.typing import NDArray

from sasgeo_bench.geometry.pairs import overlapping
from sasgeo_bench.osm.history import History, Lifecycle, ObjectKey, State
from sasgeo_bench.osm.taxonomy import Kind, load_taxonomy

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


def distance_m(points_m: Floats, targets: Geometries) -> Floats:
    """Return the distance from points, shape (N, 2), to the nearest target; infinite beyond `NEAR_M`."""
    found = np.full(len(points_m), np.inf)
    if len(targets) == 0 or len(points_m) == 0:
        return found
    tree = shapely.STRtree(targets)
    (left, _), distance = tree.query_nearest(
        shapely.points(points_m), max_distance=NEAR_M, return_distance=True, all_matches=False
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


DRAWS: Final = 1000
LEVEL: Final = 0.95
_NEWTON_STEPS: Final = 60


@dataclass(frozen=True, slots=True, kw_only=True)
class Rate:
    """A yearly rate and its 95 % interval; NaN if unknown, infinite if nothing is left."""

    per_year: float
    lo: float
    hi: float


def seeded_rng(*purpose: object) -> np.random.Generator:
    """Return a random generator for one purpose (place, class, dates), the same on every machine."""
    text = "/".join(map(str, purpose))
    return np.random.default_rng(int.from_bytes(hashlib.sha256(text.encode()).digest()[:16], "big"))


def loss_rate(lost: Floats, total: Floats, years: Floats) -> Floats:
    """Estimate the yearly rate of an exponential life by maximum likelihood, from amounts lost between dates.

    `lost` and `total` have shape (..., K): amounts lost within each of K intervals of lengths `years`, and amounts at
    their beginnings. The rate, shape (...), is NaN if there was nothing to lose, infinite if all was lost.

    Notes
    -----
    A loss is only known to lie between two dates. The score is sum(lost * t / expm1(rate * t)) - sum(kept * t) = 0. It
    decreases and is convex in the rate, so that Newton's steps from below reach its one root without passing it. One
    interval has the closed form -ln(1 - share) / t.

    Examples
    --------
    >>> loss_rate(np.array([10.0, 19.0]), np.array([100.0, 100.0]), np.array([1.0, 2.0])).round(4).item()
    0.1054
    """
    exposure = total.sum(axis=-1)
    kept = ((total - lost) * years).sum(axis=-1)
    some = lost.sum(axis=-1)
    rate = np.full(exposure.shape, np.nan)
    rate[(exposure > 0) & (some <= 0)] = 0.0
    rate[(exposure > 0) & (kept <= 0)] = np.inf
    solvable = (exposure > 0) & (some > 0) & (kept > 0)
    rate[solvable] = _root(lost[solvable], kept[solvable], some[solvable], years)
    return rate


def _root(lost: Floats, kept: Floats, some: Floats, years: Floats) -> Floats:
    """Solve the score equation, shapes (N, K), (N,), (N,) and (K,)."""
    # 1 / expm1(x) > 1 / x - 1 / 2, so the root of the right hand side lies below the true one.
    rate: Floats = some / (kept + (lost * years).sum(axis=-1) / 2)
    for _ in range(_NEWTON_STEPS):
        grown = np.expm1(rate[:, None] * years)
        score = (lost * years / grown).sum(axis=-1) - kept
        slope = -(lost * years**2 * (grown + 1) / grown**2).sum(axis=-1)
        step = -score / slope
        rate += step
        if (np.abs(step) <= 1e-12 * rate).all():
            break
    return rate


def bootstrap_rate(lost: Floats, total: Floats, years: Floats, *, things: int, rng: np.random.Generator) -> Rate:
    """Estimate a yearly rate with a 95 % interval from resampled spatial blocks.

    `lost` and `total` have shape (B, K): amounts of B blocks in K intervals of lengths `years`. If none of the `things`
    was lost, the bootstrap has no variance, and the upper end is the rate at which losing none has a probability of 5 %
    (the rule of three). The interval is NaN for fewer than two blocks: neighbours change together, so one block is one
    sample.
    """
    best = float(loss_rate(lost.sum(axis=0), total.sum(axis=0), years))
    if math.isnan(best):
        return Rate(per_year=best, lo=best, hi=best)
    if best == 0.0:
        # 0.05: probability of no loss at the upper end of a zero rate
        return Rate(per_year=0.0, lo=0.0, hi=float(-np.log(0.05) / (max(things, 1) * years.mean())))
    blocks = len(total)
    if blocks < 2:  # one block cannot differ from itself
        return Rate(per_year=best, lo=math.nan, hi=math.nan)
    weights = rng.multinomial(blocks, np.full(blocks, 1 / blocks), size=DRAWS).astype(np.float64)
    drawn = loss_rate(weights @ lost, weights @ total, years)
    drawn = drawn[~np.isnan(drawn)]  # a draw of empty blocks alone had nothing to lose
    tail = (1 - LEVEL) / 2
    lo, hi = np.quantile(drawn, [tail, 1 - tail], method="inverted_cdf")
    return Rate(per_year=best, lo=float(lo), hi=float(hi))


BLOCK_M: Final = 1000.0
DAYS_PER_YEAR: Final = 365.25
LEAST_DAYS: Final = 30  # a yearly rate from a shorter time would multiply the events of single days
UNITS: Final[dict[Kind, str]] = {"area": "m2", "line": "m"}
_REASONS: Final = ("world", "catch_up", "retagged")

# Column -> pandas dtype. Shares lie within 0..1 and are NaN of an empty whole.
_RATES: Final = tuple(
    f"{what}_per_year{end}"
    for what in ("vanish", "appear", "ground_lost", "ground_gained")
    for end in ("", "_lo", "_hi")
)
_SHARES: Final = (
    *("vanished_share", "appeared_share", "vanished_number_share", "appeared_number_share", "redrawn_share"),
    *("retagged_share", "ground_lost_share", "ground_gained_share", "shift_median_m", "shift_p90_m"),
    "id_vanished_share",
)
_EXPLAINED: Final = (
    *(f"vanished_{reason}_share" for reason in ("world", "retagged", "untold")),
    *(f"appeared_{reason}_share" for reason in ("world", "catch_up", "retagged", "untold")),
)
DTYPES: Final = {
    **dict.fromkeys(("place", "class", "unit", "span"), "str"),
    **dict.fromkeys(("date_from", "date_to"), "datetime64[ms]"),
    "years": "float64",
    **dict.fromkeys(("n_from", "n_to"), "int64"),
    **dict.fromkeys(("amount_from", "amount_to", *_SHARES, *_RATES, *_EXPLAINED), "float64"),
    "blocks": "int64",
}


@dataclass(frozen=True, slots=True, kw_only=True)
class _Stock:
    """One class in one state, cut to the common area; `hidden` is the part of it not visible from above."""

    things: Areas | Pieces
    keys: list[ObjectKey]
    hidden: Geometries


@dataclass(frozen=True, slots=True, kw_only=True)
class _Why:
    """Lost amount by explanation: the world changed, the map caught up with it, or another class replaced it."""

    world: float
    catch_up: float
    retagged: float


@dataclass(frozen=True, slots=True, kw_only=True)
class _Change:
    """One class between two states: both verdicts, and their explanations."""

    date_from: dt.date
    date_to: dt.date
    old: Verdict
    new: Verdict
    n_from: int
    n_to: int
    id_vanished_share: float
    vanished: _Why
    appeared: _Why

    @property
    def years(self) -> float:
        return (self.date_to - self.date_from).days / DAYS_PER_YEAR


@dataclass(frozen=True, slots=True, kw_only=True)
class Ageing:
    """Measurements of one place: a table with the columns of `DTYPES`, its states, and its area."""

    place: str
    sources: tuple[str, ...]
    area_km2: float
    table: pd.DataFrame


def measure_ageing(history: History, *, place: str) -> Ageing:
    """Measure how each class changed between the states (at least two) of a history; `place` seeds the bootstrap.

    In the table, `span` is "interval" for neighbouring dates, "whole" for the first against the last, and "pooled" for
    the rates that explain all intervals together, without shares.

    Only objects visible from above count, as in the layers: a stream put into a culvert has vanished, and is counted as
    retagged. `vanished_share` is of the older amount, `appeared_share` of the newer; `*_number_share` is the same by
    number of things, each of which counts as gone (or new) if more than half of it is. Rates of ground count what the
    class no longer, or newly, covers, so they hold what was redrawn too. Dates less than `LEAST_DAYS` apart get shares
    but no rates.
    """
    kinds: dict[str, Kind] = {item.name: item.kind for item in load_taxonomy().classes}
    stocks = [_stocks(state, history.area, kinds) for state in history.states]
    changes = [_changes(history.states, stocks, pair, kinds) for pair in pairwise(range(len(history.states)))]
    ends = (0, len(history.states) - 1)
    changes.append(changes[0] if ends == (0, 1) else _changes(history.states, stocks, ends, kinds))
    rows: list[dict[str, object]] = []
    for name in kinds:
        of_class = [change[name] for change in changes]
        if not any(item.n_from or item.n_to for item in of_class):
            continue
        common = {"place": place, "class": name, "unit": UNITS[kinds[name]]}
        rows += [common | _row(item, "interval", place=place, name=name) for item in of_class[:-1]]
        rows.append(common | _row(of_class[-1], "whole", place=place, name=name))
        rows.append(common | _pooled_row(of_class[:-1], place=place, name=name))
    table = pd.DataFrame(rows, columns=list(DTYPES)).astype(dict(DTYPES))
    numbers_only = [column for column, kind in DTYPES.items() if kind == "float64"]
    table[numbers_only] = table[numbers_only].round(6)
    return Ageing(
        place=place,
        sources=tuple(f"{state.source} of {state.on}" for state in history.states),
        area_km2=round(float(shapely.area(history.area)) / 1e6, 3),
        table=table,
    )


def _stocks(state: State, area: shapely.Geometry, kinds: dict[str, Kind]) -> dict[str, _Stock]:
    features = state.features
    shapes = cut_to(np.asarray(features.geometry.array, dtype=object), area)
    classes, visible = features["class"].to_numpy(), features["is_visible"].to_numpy()
    widths_m = features["width_m"].to_numpy(dtype=np.float64)
    found = {}
    for name, kind in kinds.items():
        rows = np.flatnonzero((classes == name) & visible)
        things = make_areas(shapes[rows]) if kind == "area" else make_pieces(shapes[rows], widths_m[rows])
        hidden = shapes[(classes == name) & ~visible]
        found[name] = _Stock(
            things=things, keys=_keys(features, rows[things.rows]), hidden=hidden[~shapely.is_empty(hidden)]
        )
    return found


def _keys(features: gpd.GeoDataFrame, rows: Ints) -> list[ObjectKey]:
    types, ids = features["osm_type"].to_numpy()[rows], features["osm_id"].to_numpy()[rows]
    return [ObjectKey(*pair) for pair in zip(types.tolist(), ids.tolist(), strict=True)]


def _changes(
    states: Sequence[State], stocks: Sequence[dict[str, _Stock]], pair: tuple[int, int], kinds: dict[str, Kind]
) -> dict[str, _Change]:
    """Compare every class of two states; what replaced an object is known only after all classes are compared."""
    before, after = (states[index] for index in pair)
    old, new = (stocks[index] for index in pair)
    gone = {name: _verdict(old[name], new[name]) for name in kinds}
    come = {name: _verdict(new[name], old[name]) for name in kinds}
    left = {name: _lost_shapes(old[name], gone[name]) for name in kinds}
    arrived = {name: _lost_shapes(new[name], come[name]) for name in kinds}
    there = set(_keys(after.features, np.arange(len(after.features))))
    hints = np.concatenate((after.lifecycle.gone, after.lifecycle.rising))
    found = {}
    for name, kind in kinds.items():
        others = [other for other in kinds if other != name and kinds[other] == kind]
        into = np.concatenate([new[name].hidden, *(arrived[other] for other in others)])
        out_of = np.concatenate([old[name].hidden, *(left[other] for other in others)])
        keys = old[name].keys
        found[name] = _Change(
            date_from=before.on,
            date_to=after.on,
            old=gone[name],
            new=come[name],
            n_from=len(keys),
            n_to=len(new[name].keys),
            id_vanished_share=_share(sum(key not in there for key in keys), len(keys)),
            vanished=_why_vanished(old[name], gone[name], into, hints),
            appeared=_why_appeared(new[name], come[name], out_of, after.lifecycle, before),
        )
    return found


def _why_vanished(stock: _Stock, verdict: Verdict, into: Geometries, hints: Geometries) -> _Why:
    retagged = _taken(stock, verdict, into)
    world = (verdict.lost - retagged) @ _is_near(stock, verdict, hints)
    return _Why(world=float(world), catch_up=0.0, retagged=float(retagged.sum()))


def _why_appeared(stock: _Stock, verdict: Verdict, out_of: Geometries, hints: Lifecycle, before: State) -> _Why:
    """Explain what appeared: by its start date first, then by a class that was there, then by construction."""
    spans = [hints.started.get(key) for key in stock.keys]
    is_new = np.array([span is not None and span.first > before.on for span in spans], dtype=bool)[verdict.thing]
    is_old = np.array([span is not None and span.last <= before.on for span in spans], dtype=bool)[verdict.thing]
    retagged = np.where(is_new | is_old, 0.0, _taken(stock, verdict, out_of))
    is_site = _is_near(stock, verdict, before.lifecycle.rising) & ~is_old
    world = (verdict.lost - retagged) @ (is_new | is_site)
    return _Why(world=float(world), catch_up=float(verdict.lost @ is_old), retagged=float(retagged.sum()))


def _verdict(these: _Stock, others: _Stock) -> Verdict:
    if isinstance(these.things, Areas) and isinstance(others.things, Areas):
        return compare_areas(these.things, others.things)
    if isinstance(these.things, Pieces) and isinstance(others.things, Pieces):
        return compare_pieces(these.things, others.things)
    raise TypeError  # a class has one kind in every state


def _lost_shapes(stock: _Stock, verdict: Verdict) -> Geometries:
    if isinstance(stock.things, Areas):
        return stock.things.shapes[verdict.is_lost]
    return np.asarray(shapely.points(stock.things.middles[verdict.is_lost]))


def _taken(stock: _Stock, verdict: Verdict, others: Geometries) -> Floats:
    """Return the lost amount of each unit that another class of the kind, or its own hidden part, replaced."""
    taken = np.zeros(len(verdict.lost))
    units = np.flatnonzero(verdict.is_lost)
    if isinstance(stock.things, Areas):
        share = replaced_share(stock.things.shapes[units], polygons_of(others))
        taken[units] = np.minimum(share * verdict.amount[units], verdict.lost[units])
    else:
        taken[units] = verdict.lost[units] * (distance_m(stock.things.middles[units], others) <= NEAR_M)
    return taken


def _is_near(stock: _Stock, verdict: Verdict, hints: Geometries) -> NDArray[np.bool_]:
    near = np.zeros(len(verdict.lost), dtype=bool)
    units = np.flatnonzero(verdict.lost > 0)
    if isinstance(stock.things, Areas):
        near[units] = covered_share(stock.things.shapes[units], hints) >= COVER_SHARE
    else:
        near[units] = distance_m(stock.things.middles[units], hints) <= NEAR_M
    return near


def _row(change: _Change, span: str, *, place: str, name: str) -> dict[str, object]:
    old, new = change.old, change.new
    amount_from, amount_to = float(old.amount.sum()), float(new.amount.sum())
    # Shift of each re-drawn thing, and the amount kept of it
    left = old.amount - old.lost
    kept = np.bincount(old.thing, weights=left, minlength=len(old.shift_m)).astype(np.float64)
    is_redrawn = np.nan_to_num(old.shift_m) > REDRAWN_M
    moved, weight = old.shift_m[is_redrawn], kept[is_redrawn]
    quantiles = _quantiles(moved, weight, (0.5, 0.9))
    return _rates([change], span, place=place, name=name) | {
        "n_from": change.n_from,
        "n_to": change.n_to,
        "amount_from": amount_from,
        "amount_to": amount_to,
        "vanished_share": _share(old.lost.sum(), amount_from),
        "appeared_share": _share(new.lost.sum(), amount_to),
        "vanished_number_share": _share(old.lost_things, change.n_from),
        "appeared_number_share": _share(new.lost_things, change.n_to),
        "redrawn_share": _share(weight.sum(), amount_from),
        "retagged_share": _share(change.vanished.retagged, amount_from),
        "ground_lost_share": _share(old.uncovered.sum(), amount_from),
        "ground_gained_share": _share(new.uncovered.sum(), amount_to),
        "shift_median_m": quantiles[0],
        "shift_p90_m": quantiles[1],
        "id_vanished_share": change.id_vanished_share,
    }


def _pooled_row(changes: Sequence[_Change], *, place: str, name: str) -> dict[str, object]:
    first, last = changes[0], changes[-1]
    return _rates(changes, "pooled", place=place, name=name) | {
        "n_from": first.n_from,
        "n_to": last.n_to,
        "amount_from": float(first.old.amount.sum()),
        "amount_to": float(last.new.amount.sum()),
    }


def _rates(changes: Sequence[_Change], span: str, *, place: str, name: str) -> dict[str, object]:
    """Return the part that rows of one interval and of all share: dates, rates, explanations, number of blocks."""
    years = np.array([change.years for change in changes])
    first, last = changes[0].date_from, changes[-1].date_to
    old, new = _block_tables(changes)
    sides = {
        "vanish": (old.lost, old.amount, "n_from"),
        "appear": (new.lost, new.amount, "n_to"),
        "ground_lost": (old.uncovered, old.amount, "n_from"),
        "ground_gained": (new.uncovered, new.amount, "n_to"),
    }
    rates: dict[str, object] = {}
    for what, (lost, amount, count) in sides.items():
        rate = Rate(per_year=np.nan, lo=np.nan, hi=np.nan)
        if (last - first).days >= LEAST_DAYS:
            things = sum(getattr(change, count) for change in changes)
            rng = seeded_rng(place, name, span, first, last, what)
            rate = bootstrap_rate(lost, amount, years, things=things, rng=rng)
        column = f"{what}_per_year"
        rates |= {column: rate.per_year, f"{column}_lo": rate.lo, f"{column}_hi": rate.hi}
    return {
        "span": span,
        "date_from": pd.Timestamp(first),
        "date_to": pd.Timestamp(last),
        "years": float(years.sum()),
        **rates,
        **_explained("vanished", [(change.old, change.vanished) for change in changes]),
        **_explained("appeared", [(change.new, change.appeared) for change in changes]),
        "blocks": len(old.amount),
    }


def _explained(what: str, sides: Sequence[tuple[Verdict, _Why]]) -> dict[str, float]:
    """Return shares of the lost amount by explanation; together they are 1."""
    lost = float(sum(verdict.lost.sum() for verdict, _ in sides))
    shares = {name: _share(sum(getattr(why, name) for _, why in sides), lost) for name in _REASONS}
    shares["untold"] = max(1.0 - sum(shares.values()), 0.0) if lost > 0 else np.nan
    return {f"{what}_{name}_share": shares[name] for name in shares if f"{what}_{name}_share" in DTYPES}


@dataclass(frozen=True, slots=True, kw_only=True)
class _Blocks:
    """Amounts of one side of all intervals by block, each of shape (blocks, intervals)."""

    amount: Floats
    lost: Floats
    uncovered: Floats


def _block_tables(changes: Sequence[_Change]) -> tuple[_Blocks, _Blocks]:
    sides = ([change.old for change in changes], [change.new for change in changes])
    cells = [[_cells(verdict.xy_m) for verdict in side] for side in sides]
    blocks = np.unique(np.concatenate([cell for side in cells for cell in side]))
    old, new = (_added_up(side, own, blocks) for side, own in zip(sides, cells, strict=True))
    return old, new


def _added_up(verdicts: Sequence[Verdict], cells: Sequence[Ints], blocks: Ints) -> _Blocks:
    at = [np.searchsorted(blocks, cell) for cell in cells]
    sums = {
        name: np.stack(
            [
                np.bincount(where, weights=getattr(verdict, name), minlength=len(blocks)).astype(np.float64)
                for where, verdict in zip(at, verdicts, strict=True)
            ],
            axis=1,
        )
        for name in ("amount", "lost", "uncovered")
    }
    return _Blocks(**sums)


def _cells(xy_m: Floats) -> Ints:
    cells = np.floor(xy_m / BLOCK_M).astype(np.int64).reshape(-1, 2)
    return np.asarray(cells[:, 0] * 2**32 + cells[:, 1])


def _quantiles(values: Floats, weights: Floats, levels: tuple[float, ...]) -> list[float]:
    """Return weighted quantiles; NaN for no values."""
    if len(values) == 0:
        return [float("nan")] * len(levels)
    order = np.argsort(values, kind="stable")
    passed = np.cumsum(weights[order])
    places = np.searchsorted(passed, np.array(levels) * passed[-1])
    return [float(values[order][min(place, len(values) - 1)]) for place in places.tolist()]


def _share(part: float, whole: float) -> float:
    return float(part / whole) if whole > 0 else float("nan")
