# SPDX-License-Identifier: Apache-2.0
"""Twins: parts of a map copied to another place of it, with or without a change, so that two places look alike."""

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Final

import lazy_loader  # type: ignore[import-untyped, unused-ignore]
import numpy as np
import shapely
import shapely.affinity
from numpy.typing import NDArray

from sasgeo_bench.geometry.pairs import overlapping
from sasgeo_bench.osm.features import check_features
from sasgeo_bench.osm.taxonomy import load_taxonomy

if TYPE_CHECKING:
    import geopandas as gpd
    import pandas as pd
else:  # loaded when a table is made
    gpd, pd = lazy_loader.load("geopandas"), lazy_loader.load("pandas")

Change = Callable[["gpd.GeoDataFrame"], "gpd.GeoDataFrame"]

ROADS: Final = load_taxonomy().of_graph("road")

_DECIMALS: Final = 3  # as in `osm.read`: shared vertices stay equal
_FINE_DECIMALS: Final = 6  # of a cut or a copy: both stay on the cut line, so that the mask stays the same
_AT_M: Final = 0.1  # a road this near to a junction meets it
_BEND_M: Final = 10.0  # length of a road that is bent to meet a moved junction
_LEAST_M: Final = 0.05  # shorter or thinner leftovers of a cut are dropped


@dataclass(frozen=True, slots=True, kw_only=True)
class Paste:
    """One copy: the features in a disc around `source_m` replace those in a disc around `target_m`.

    `change` edits the copy in the coordinates of the source; None copies it unchanged. With an `outline`, also in these
    coordinates, only that part of the changed disc is copied.
    """

    source_m: tuple[float, float]
    target_m: tuple[float, float]
    radius_m: float
    change: Change | None = None
    outline: shapely.Polygon | None = None

    @property
    def shift_m(self) -> tuple[float, float]:
        """Return the way from the source to the target, east and north."""
        return (self.target_m[0] - self.source_m[0], self.target_m[1] - self.source_m[1])

    @property
    def area(self) -> shapely.Polygon:
        """Return the ground that is replaced."""
        if self.outline is None:
            return _disc(self.target_m, self.radius_m)
        return shapely.affinity.translate(self.outline, *self.shift_m)


def paste(features: "gpd.GeoDataFrame", pastes: Sequence[Paste]) -> "gpd.GeoDataFrame":
    """Copy parts of a feature table; features that cross the rim of a disc are cut there.

    Sources are read from the given table, even if another copy overwrites them.
    """
    if not pastes:
        return features
    kept = without(features, shapely.union_all([item.area for item in pastes]))
    # Neither the order of the rows nor the numbers of the ways say which place is the original.
    copies, first_id = [], int(features["osm_id"].max()) + 1
    for item in sorted(pastes, key=lambda paste: paste.target_m):
        copies.append(_copy(features, item, first_id=first_id))
        first_id += len(copies[-1])
    table = pd.concat([kept, *copies], ignore_index=True)
    return check_features(gpd.GeoDataFrame(table, geometry="geometry", crs=features.crs).astype(dict(_types(features))))


def _types(features: "gpd.GeoDataFrame") -> Iterable[tuple[str, object]]:
    return ((name, kind) for name, kind in features.dtypes.items() if name != "geometry")


def around(features: "gpd.GeoDataFrame", center_m: tuple[float, float], radius_m: float) -> "gpd.GeoDataFrame":
    """Return the features within a disc, cut at its rim."""
    return _cut(features, _disc(center_m, radius_m), keep_inside=True)


def without(features: "gpd.GeoDataFrame", area: shapely.Geometry) -> "gpd.GeoDataFrame":
    """Return the features outside an area, cut at its rim."""
    return _cut(features, area, keep_inside=False)


def _copy(features: "gpd.GeoDataFrame", item: Paste, *, first_id: int) -> "gpd.GeoDataFrame":
    piece = around(features, item.source_m, item.radius_m)
    if item.change is not None:
        piece = item.change(piece)
    if item.outline is not None:
        piece = _cut(piece, item.outline, keep_inside=True)
    moved = shapely.transform(piece.geometry.to_numpy(), lambda at: (at + item.shift_m).round(_FINE_DECIMALS))
    again = piece.set_geometry(gpd.GeoSeries(moved, index=piece.index, crs=features.crs))
    return again.assign(osm_id=first_id + np.unique(again["osm_id"], return_inverse=True)[1])


def _disc(center_m: tuple[float, float], radius_m: float) -> shapely.Polygon:
    return shapely.Point(center_m).buffer(radius_m, quad_segs=16)


def _cut(features: "gpd.GeoDataFrame", area: shapely.Geometry, *, keep_inside: bool) -> "gpd.GeoDataFrame":
    """Return features inside (or outside) an area, cut at its rim; drop parts of a lower dimension."""
    geometry = features.geometry.to_numpy()
    shapely.prepare(area)
    meets, within = shapely.intersects(area, geometry), shapely.contains_properly(area, geometry)
    chosen = np.flatnonzero(meets if keep_inside else ~within)
    shapes = geometry[chosen].copy()
    crossing = (meets & ~within)[chosen]
    cut = shapely.intersection if keep_inside else shapely.difference
    shapes[crossing] = _same_dimension(cut(shapely.make_valid(shapes[crossing]), area), shapes[crossing])
    shapes[crossing] = shapely.transform(shapes[crossing], lambda at: at.round(_FINE_DECIMALS))
    is_left = ~shapely.is_empty(shapes) & (np.maximum(shapely.length(shapes), shapely.area(shapes)) > _LEAST_M)
    table = features.iloc[chosen[is_left]]
    return table.set_geometry(gpd.GeoSeries(shapes[is_left], index=table.index, crs=features.crs))


def _same_dimension(shapes: NDArray[np.object_], like: NDArray[np.object_]) -> NDArray[np.object_]:
    """Drop the points and lines that a cut leaves of areas, and the points that it leaves of lines."""
    found = np.empty(len(shapes), dtype=object)
    kinds = shapely.get_dimensions(like)
    for at, shape in enumerate(shapes):
        parts = shapely.get_parts(shapely.get_parts(shape))
        parts = [part for part in parts if shapely.get_dimensions(part) == kinds[at] and not shapely.is_empty(part)]
        gather = shapely.MultiPolygon if kinds[at] == 2 else shapely.MultiLineString
        found[at] = parts[0] if len(parts) == 1 else gather(parts)  # of none it makes an empty one
    return found


def mirror(
    features: "gpd.GeoDataFrame",
    classes: Sequence[str] | None,
    center_m: tuple[float, float],
    *,
    within_m: float = math.inf,
) -> "gpd.GeoDataFrame":
    """Mirror features of some classes, or all (None), from east to west about a place; kind and amount stay.

    What crosses the circle `within_m` around the place is cut there, and its outer part stays.
    """
    is_one = np.ones(len(features), dtype=bool) if classes is None else features["class"].isin(list(classes)).to_numpy()
    if math.isfinite(within_m):
        if not is_one.any():
            return features
        whole = partial(mirror, classes=classes, center_m=center_m)
        middle = Paste(source_m=center_m, target_m=center_m, radius_m=within_m, change=whole)
        table = pd.concat([features[~is_one], paste(features[is_one], [middle])], ignore_index=True)
        return table.set_geometry("geometry", crs=features.crs)
    shapes = features.geometry.to_numpy().copy()
    flip, shift = np.array([-1.0, 1.0]), np.array([2 * center_m[0], 0.0])
    shapes[is_one] = shapely.transform(shapes[is_one], lambda at: (at * flip + shift).round(_DECIMALS))
    return features.set_geometry(gpd.GeoSeries(shapes, index=features.index, crs=features.crs))


def split_long(features: "gpd.GeoDataFrame", *, piece_m: float, least_area_m2: float) -> "gpd.GeoDataFrame":
    """Cut large buildings across their long side into a row of houses; their union stays exactly the same."""
    is_large = (features["class"] == "building").to_numpy() & (features.geometry.area.to_numpy() >= least_area_m2)
    large = features[is_large]
    rows = [_row_of_houses(shape, piece_m) for shape in large.geometry]
    houses = large.iloc[np.repeat(np.arange(len(rows)), [len(row) for row in rows])]
    shapes = gpd.GeoSeries([house for row in rows for house in row], index=houses.index, crs=features.crs)
    table = pd.concat([features[~is_large], houses.set_geometry(shapes)], ignore_index=True)
    return gpd.GeoDataFrame(table, geometry="geometry", crs=features.crs).astype(dict(_types(features)))


def _row_of_houses(shape: shapely.Geometry, piece_m: float) -> list[shapely.Geometry]:
    """Cut a polygon by lines across the long side of its smallest rectangle."""
    corners = shapely.get_coordinates(shapely.minimum_rotated_rectangle(shape))[:4]
    sides = corners[[1, 2]] - corners[[0, 1]]
    long_first = bool(np.hypot(*sides[0]) >= np.hypot(*sides[1]))
    along, across = (sides[0], sides[1]) if long_first else (sides[1], sides[0])
    start = corners[0]  # both sides leave from it: the rectangle's far side is parallel to the near one
    count = max(1, round(float(np.hypot(*along)) / piece_m))
    if count == 1:
        return [shape]
    margin = 0.5 * across
    found: list[shapely.Geometry] = []
    for number in range(count):
        low, high = start + along * (number / count), start + along * ((number + 1) / count)
        if number == 0:
            low = low - along
        if number == count - 1:
            high = high + along
        slab = shapely.Polygon([low - margin, high - margin, high + across + margin, low + across + margin])
        parts = shapely.get_parts(shapely.intersection(shape, slab))
        found += [part for part in parts if part.geom_type == "Polygon" and part.area > _LEAST_M]
    return found


def open_gaps(
    features: "gpd.GeoDataFrame", junctions_m: NDArray[np.float64], *, gap_m: float, rng: np.random.Generator
) -> "gpd.GeoDataFrame":
    """Shorten one random arm of each junction, so that the road stops `gap_m` before the edge of the other one.

    `junctions_m` has shape (N, 2), easting and northing.
    """
    shapes = features.geometry.to_numpy().copy()
    width_m = np.nan_to_num(features["width_m"].to_numpy(dtype=np.float64), nan=4.0)
    is_road = features["class"].isin(ROADS).to_numpy()
    for point in junctions_m:
        place = shapely.Point(point)
        near = np.flatnonzero(is_road & (shapely.distance(shapes, place) < _AT_M))
        if len(near) < 2:  # two roads make a junction
            continue
        picked = int(near[rng.integers(len(near))])
        others = [index for index in near if index != picked]
        reach_m = max(width_m[index] for index in others) / 2 + gap_m + width_m[picked] / 2
        shapes[picked] = shapely.difference(shapes[picked], place.buffer(reach_m))
    is_left = ~shapely.is_empty(shapes)
    table = features[is_left]
    return table.set_geometry(gpd.GeoSeries(shapes[is_left], index=table.index, crs=features.crs))


def stagger(
    features: "gpd.GeoDataFrame", junctions_m: NDArray[np.float64], *, offset_m: float, rng: np.random.Generator
) -> "gpd.GeoDataFrame":
    """Replace each X-junction by two T-junctions: one road's far part starts `offset_m` along the other road.

    Road and direction are random. `junctions_m` has shape (N, 2), easting and northing; junctions where no road
    continues across another one stay.
    """
    shapes = features.geometry.to_numpy().copy()
    is_road = features["class"].isin(ROADS).to_numpy()
    for point in junctions_m:
        arms = _arms(shapes, np.flatnonzero(is_road), point)
        pairs = [
            (one, two)
            for at, one in enumerate(arms)
            for two in arms[at + 1 :]
            if float(np.dot(one.direction, two.direction)) < -0.8  # cosine between two arms of a continuing road
        ]
        if len(pairs) < 2:  # two roads that both go on make an X
            continue
        order = rng.permutation(len(pairs))
        moving, other = pairs[order[0]][int(rng.integers(2))], pairs[order[1]][0]
        shift = offset_m * other.direction
        shapes[moving.index] = _end_moved(shapes[moving.index], point, moving, shift)
        shapes[other.index] = _with_vertices(shapes[other.index], [shapely.Point((point + shift).round(_DECIMALS))])
    return features.set_geometry(gpd.GeoSeries(shapes, index=features.index, crs=features.crs))


@dataclass(frozen=True, slots=True, kw_only=True)
class _Arm:
    """A road that leaves a junction: feature, direction (a unit vector), vertex, and step to the next vertex."""

    index: int
    direction: NDArray[np.float64]
    vertex: int
    step: int


def _arms(shapes: NDArray[np.object_], roads: NDArray[np.int64], point: NDArray[np.float64]) -> list[_Arm]:
    """Return the arms of a junction that is a vertex of each of its roads; roads in several parts are skipped."""
    found = []
    near = roads[shapely.distance(shapes[roads], shapely.Point(point)) < _AT_M]
    for index in near.tolist():
        if shapes[index].geom_type != "LineString":
            continue
        at = shapely.get_coordinates(shapes[index])
        vertex = int(np.argmin(np.hypot(*(at - point).T)))
        for step in (-1, 1):
            if 0 <= vertex + step < len(at) and np.hypot(*(at[vertex] - point)) < _AT_M:
                away = at[vertex + step] - at[vertex]
                found.append(
                    _Arm(index=index, direction=away / max(float(np.hypot(*away)), 1e-9), vertex=vertex, step=step)
                )
    return found


def _end_moved(
    line: shapely.Geometry, point: NDArray[np.float64], arm: _Arm, shift: NDArray[np.float64]
) -> shapely.Geometry:
    """Bend the first metres of an arm to its new start; split a road that passed the junction into two parts."""
    at = shapely.get_coordinates(line)
    moved = (point + shift).round(_DECIMALS)
    length_m = float(np.hypot(*(at[arm.vertex + arm.step] - at[arm.vertex])))
    bend = [] if length_m <= 1.5 * _BEND_M else [(at[arm.vertex] + _BEND_M * arm.direction).round(_DECIMALS)]
    if arm.step == 1:
        parts = [at[: arm.vertex + 1], np.vstack((moved, *bend, at[arm.vertex + 1 :]))]
    else:
        parts = [np.vstack((at[: arm.vertex], *bend, moved)), at[arm.vertex :]]
    lines = [shapely.LineString(part) for part in parts if len(part) > 1]
    return lines[0] if len(lines) == 1 else shapely.multilinestrings(lines)


def level_crossings(features: "gpd.GeoDataFrame") -> "gpd.GeoDataFrame":
    """Lower every bridge to the ground: roads that passed over each other now meet in a junction."""
    table = features[(features["class"] != "bridge").to_numpy()].copy()
    table["level"] = np.zeros(len(table), dtype=np.int16)
    table["is_bridge"] = np.zeros(len(table), dtype=bool)
    shapes = table.geometry.to_numpy().copy()
    is_road = table["class"].isin(ROADS).to_numpy()
    roads = np.flatnonzero(is_road & (shapely.get_dimensions(shapes) == 1))  # a square is a road too, and no line
    first, second = overlapping(shapes[roads], shapes[roads], predicate="crosses")
    meeting: dict[int, list[shapely.Geometry]] = {}
    for one, two in zip(roads[first].tolist(), roads[second].tolist(), strict=True):
        if one < two:
            points = shapely.get_parts(shapely.intersection(shapes[one], shapes[two]))
            points = [shapely.set_precision(point, 10.0**-_DECIMALS) for point in points if point.geom_type == "Point"]
            meeting.setdefault(one, []).extend(points)
            meeting.setdefault(two, []).extend(points)
    for index, points in meeting.items():
        shapes[index] = _with_vertices(shapes[index], points)
    return table.set_geometry(gpd.GeoSeries(shapes, index=table.index, crs=features.crs))


def _with_vertices(line: shapely.Geometry, points: list[shapely.Geometry]) -> shapely.Geometry:
    for point in points:
        parts = []
        for part in shapely.get_parts(line):
            along_m = float(shapely.line_locate_point(part, point))
            at = shapely.get_coordinates(part)
            lengths = np.concatenate(([0.0], np.cumsum(np.hypot(*np.diff(at, axis=0).T))))
            on_it = float(shapely.distance(part, point)) < 0.01  # metres
            if on_it and np.abs(lengths - along_m).min() > 1e-6:  # not a vertex yet
                place = int(np.searchsorted(lengths, along_m))
                part = shapely.LineString(np.insert(at, place, shapely.get_coordinates(point)[0], axis=0))  # noqa: PLW2901
            parts.append(part)
        line = parts[0] if len(parts) == 1 else shapely.multilinestrings(parts)
    return line
