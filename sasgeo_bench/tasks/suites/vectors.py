# SPDX-License-Identifier: Apache-2.0
"""A detector of vectors: lines and outlines of a view, with their own errors."""

from collections import Counter
from collections.abc import Callable, Sequence
from collections.abc import Set as AbstractSet
from dataclasses import dataclass, replace
from itertools import compress, pairwise
from typing import TYPE_CHECKING, Final

import numpy as np
import shapely
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from sasgeo_bench.geometry.pose import Pose, inverse
from sasgeo_bench.regions.evidence import footprint
from sasgeo_bench.tasks.perturbations.streams import Streams
from sasgeo_bench.tasks.query import PUBLISHED
from sasgeo_bench.tasks.state import State
from sasgeo_bench.tasks.suites.base import ViewRequest
from sasgeo_bench.tasks.vectors import VECTOR_CLASSES, vector_table

if TYPE_CHECKING:
    import geopandas as gpd

Shapes = NDArray[np.object_]
Points = NDArray[np.float64]

_LEAST_M: Final = 2.0
_FIELD_WAVES: Final = 12


@dataclass(frozen=True, slots=True, kw_only=True)
class MeasuredVectorNoise:
    """Errors of perceived vectors; all numbers are guesses, but for the bridges (recall 0.85, measured).

    `small_m2` and `short_m` are the area of a building and the length of a line that are missed half of the time.
    `hidden_share` of the length of the lines of each class is hidden where a smooth field, `canopy_m` wide, is highest;
    below mapped green the field is higher by `under_green` deviations. Curves are simplified by `coarse_m`, outlines by
    half of it. Buildings within `merged_m` become one with probability `merged_share`. `false_share` new lines and
    buildings appear for each true one. Each building is moved by `lean_m` by itself (relief), lines by a smooth shift
    of `shift_m` rms. Each class draws from a stream of its own.
    """

    small_m2: float = 12.0
    short_m: float = 6.0
    hidden_share: float = 0.06
    canopy_m: float = 30.0
    under_green: float = 1.5
    coarse_m: float = 1.5
    merged_m: float = 1.0
    merged_share: float = 0.3
    false_share: float = 0.06
    bridge_missed: float = 0.15
    lean_m: float = 0.8
    shift_m: float = 1.2
    shift_wave_m: float = 250.0


@dataclass(frozen=True, slots=True, kw_only=True)
class _Thing:
    """One object on its way to a vector: a line or an outline in the view's frame."""

    name: str
    level: int
    is_bridge: bool
    shape: shapely.Geometry


def perceive_coarsely(
    state: State, pose: Pose, *, side_m: float, noise: MeasuredVectorNoise, rng: np.random.Generator
) -> "gpd.GeoDataFrame":
    """Return the vectors of the visible features in a view of a state; columns as `vectors.perceive_vectors`."""
    outline = footprint(pose, size_m=(side_m, side_m))
    table = state.features.iloc[np.sort(state.features.sindex.query(outline, predicate="intersects"))]
    table = table[table["is_visible"].to_numpy()]
    clipped = shapely.intersection(shapely.make_valid(table.geometry.to_numpy()), outline)
    local = shapely.transform(clipped, inverse(pose).to_map)
    names = table["class"].to_numpy()
    green = shapely.union_all(local[(names == "green") & (shapely.get_dimensions(local) == 2)])  # areas
    things = [
        _Thing(name=name, level=int(level), is_bridge=bool(is_bridge), shape=part)
        for name, level, is_bridge, shape in zip(names, table["level"], table["is_bridge"], local, strict=True)
        if name in VECTOR_CLASSES
        for part in shapely.get_parts(shapely.get_parts(shape))
        if part.geom_type in ("LineString", "Polygon") and part.length >= _LEAST_M
    ]
    streams = Streams(rng)
    lines = _lines([item for item in things if item.shape.geom_type == "LineString"], green, noise, streams)
    areas = [item for item in things if item.shape.geom_type == "Polygon"]
    areas = [area for name in VECTOR_CLASSES for area in _outlines(_of(name, areas), noise, streams.of(name))]
    drives = [drive for name in VECTOR_CLASSES for drive in _drives(_of(name, lines), side_m, noise, streams.of(name))]
    made = [*lines, *areas, *drives, *_sheds(_of("building", areas), side_m, noise, streams.of("building"))]
    kept = [item for item in made if not item.shape.is_empty and item.shape.length >= _LEAST_M]
    return vector_table([(item.name, item.level, item.is_bridge, item.shape) for item in kept])


def _of(name: str, things: Sequence[_Thing]) -> list[_Thing]:
    return [item for item in things if item.name == name]


_STEP_M: Final = 3.0  # between the points of a line at which it is hidden or not


def _lines(
    things: Sequence[_Thing], green: shapely.Geometry, noise: MeasuredVectorNoise, streams: Streams
) -> list[_Thing]:
    """Simplify between junctions, miss short lines and bridges, hide stretches, shift what is left."""
    shapes = _simplified([item.shape for item in things], noise.coarse_m)
    lengths = np.array([shape.length for shape in shapes])
    names = np.array([item.name for item in things], dtype=object)
    missed, under = streams.chances(names, 2)
    seen, is_missed = missed >= _missed(lengths, noise.short_m), under < noise.bridge_missed
    canopy, shift = _field(noise.canopy_m, 1, streams.view), _field(noise.shift_wave_m, 2, streams.view)
    points = [shapely.get_coordinates(shapely.segmentize(shape, _STEP_M)) for shape in shapes]
    heights = _heights(points, canopy, green, noise.under_green)
    limits = {name: _limit(list(compress(heights, names == name)), noise) for name in set(names.tolist())}
    found = []
    for at, item in enumerate(things):
        plain = replace(item, is_bridge=False, level=0) if item.is_bridge and is_missed[at] else item
        corners = set(map(tuple, shapely.get_coordinates(shapes[at]).tolist()))
        pieces = _visible(points[at], heights[at] <= limits[item.name], corners) if seen[at] else ()
        found += [replace(plain, shape=piece) for piece in pieces]
    moved = [shapely.transform(item.shape, lambda xy: xy + noise.shift_m * shift(xy)) for item in found]
    return [replace(item, shape=shape) for item, shape in zip(found, moved, strict=True)]


def _limit(heights: Sequence[NDArray[np.float64]], noise: MeasuredVectorNoise) -> float:
    """Return the height of the canopy above which lines are hidden: of each class the same share."""
    return float(np.quantile(np.concatenate(heights), 1 - noise.hidden_share))


def _missed(sizes: NDArray[np.float64], half: float) -> NDArray[np.float64]:
    """Return the probability that a thing of some size is missed: one half at `half`, less for larger ones."""
    return np.asarray(1 / (1 + (sizes / half) ** 1.5))


def _heights(
    points: Sequence[Points], canopy: Callable[[Points], Points], green: shapely.Geometry, under_green: float
) -> list[NDArray[np.float64]]:
    if not points:
        return []
    whole = np.concatenate(points)
    shapely.prepare(green)
    under = shapely.contains_xy(green, whole[:, 0], whole[:, 1])
    heights = canopy(whole)[:, 0] + under_green * under
    return np.split(heights, np.cumsum([len(part) for part in points])[:-1])


def _visible(
    points: Points, is_seen: NDArray[np.bool_], corners: AbstractSet[tuple[float, ...]]
) -> list[shapely.LineString]:
    """Return the seen pieces of a line: their ends, and the corners between."""
    breaks = np.flatnonzero(~(is_seen[:-1] & is_seen[1:])) + 1
    parts = [part for part in np.split(points, breaks) if len(part) > 1]
    inner = [[tuple(at) in corners for at in part[1:-1].tolist()] for part in parts]
    return [shapely.LineString(part[[True, *kept, True]]) for part, kept in zip(parts, inner, strict=True)]


def _simplified(shapes: Sequence[shapely.LineString], coarse_m: float) -> list[shapely.LineString]:
    """Simplify lines, but keep the vertices where several meet, so that junctions stay."""
    rounded = [[tuple(at) for at in shapely.get_coordinates(shape).round(2).tolist()] for shape in shapes]
    shared = {at for at, count in Counter(at for line in rounded for at in set(line)).items() if count > 1}
    found = []
    for line, shape in zip(rounded, shapes, strict=True):
        points = shapely.get_coordinates(shape)
        stops = [0, *(at for at in range(1, len(line) - 1) if line[at] in shared), len(line) - 1]
        parts = [
            shapely.get_coordinates(shapely.simplify(shapely.LineString(points[low : high + 1]), coarse_m))
            for low, high in pairwise(stops)
        ]
        found.append(shapely.LineString(np.concatenate([parts[0], *(part[1:] for part in parts[1:])])))
    return found


def _outlines(things: Sequence[_Thing], noise: MeasuredVectorNoise, rng: np.random.Generator) -> list[_Thing]:
    """Miss small buildings, merge some neighbours, simplify outlines, move each by itself; squares of a road too."""
    areas = np.array([item.shape.area for item in things])
    left = list(compress(things, rng.random(len(things)) >= _missed(areas, noise.small_m2)))
    merged = _merged([item.shape for item in left], noise, rng)
    leans = rng.normal(0, noise.lean_m, size=(len(merged), 2))
    found = []
    for (first, shape), lean in zip(merged, leans, strict=True):
        simple = shapely.simplify(shapely.transform(shape, lambda xy, lean=lean: xy + lean), noise.coarse_m / 2)
        found.append(replace(left[first], shape=simple if simple.is_valid and not simple.is_empty else shape))
    return found


def _merged(
    shapes: Sequence[shapely.Polygon], noise: MeasuredVectorNoise, rng: np.random.Generator
) -> list[tuple[int, shapely.Polygon]]:
    """Return outlines, some neighbours as one; each with the number of its first building."""
    if not shapes:
        return []
    one, two = shapely.STRtree(shapes).query(shapes, predicate="dwithin", distance=noise.merged_m)
    pairs = np.stack((one, two))[:, one < two]
    pairs = pairs[:, np.lexsort(pairs[::-1])]
    pairs = pairs[:, rng.random(pairs.shape[1]) < noise.merged_share]
    graph = coo_array((np.ones(pairs.shape[1]), (pairs[0], pairs[1])), shape=(len(shapes), len(shapes)))
    _, group = connected_components(graph, directed=False)
    found = []
    for label in dict.fromkeys(group.tolist()):
        own = np.flatnonzero(group == label)
        first = int(own[0])
        whole = shapes[first]
        if len(own) > 1:
            half_m = noise.merged_m / 2 + 0.1
            whole = shapely.union_all([shapes[at] for at in own.tolist()]).buffer(half_m, join_style="mitre")
            whole = max(shapely.get_parts(whole.buffer(-half_m, join_style="mitre")), key=lambda part: part.area)
        found.append((first, whole))
    return found


def _drives(
    lines: Sequence[_Thing], side_m: float, noise: MeasuredVectorNoise, rng: np.random.Generator
) -> list[_Thing]:
    """Return drives that branch off lines of one class and are not there."""
    found = []
    for _ in range(rng.poisson(noise.false_share * len(lines))):
        line = lines[int(rng.integers(len(lines)))].shape
        begin = shapely.get_coordinates(shapely.line_interpolate_point(line, rng.random(), normalized=True))[0]
        turn, length_m = rng.uniform(0, 2 * np.pi), rng.uniform(10, 40)
        end = begin + length_m * np.array((np.cos(turn), np.sin(turn)))
        shape = shapely.LineString((begin, np.clip(end, -side_m / 2, side_m / 2)))
        found.append(_Thing(name="road_minor", level=0, is_bridge=False, shape=shape))
    return found


def _sheds(
    areas: Sequence[_Thing], side_m: float, noise: MeasuredVectorNoise, rng: np.random.Generator
) -> list[_Thing]:
    found = []
    for _ in range(rng.poisson(noise.false_share * len(areas))):
        near = shapely.get_coordinates(areas[int(rng.integers(len(areas)))].shape.centroid)[0]
        middle, sides = near + rng.normal(0, 15, size=2), rng.uniform(3, 9, size=2) / 2
        turn = rng.uniform(0, np.pi / 2)
        spin = np.array(((np.cos(turn), np.sin(turn)), (-np.sin(turn), np.cos(turn))))
        corners = np.array(((-1, -1), (1, -1), (1, 1), (-1, 1))) * sides @ spin + middle
        shed = shapely.Polygon(corners)
        if (np.abs(corners) <= side_m / 2).all() and not any(shed.intersects(item.shape) for item in areas):
            found.append(_Thing(name="building", level=0, is_bridge=False, shape=shed))
    return found


def _field(width_m: float, count: int, rng: np.random.Generator) -> Callable[[Points], Points]:
    """Draw `count` smooth fields of deviation 1 as a function of points: waves of many directions and lengths."""
    turns = rng.uniform(0, 2 * np.pi, (count, _FIELD_WAVES))
    numbers = 2 * np.pi / (width_m * rng.uniform(1, 4, (count, _FIELD_WAVES)))
    phases = rng.uniform(0, 2 * np.pi, (count, _FIELD_WAVES))

    def height(at: Points) -> Points:
        """Return the fields at points of shape (N, 2), shape (N, count)."""
        x, y = at[:, 0, None, None], at[:, 1, None, None]
        waves = np.cos(numbers * (x * np.cos(turns) + y * np.sin(turns)) + phases)
        return np.asarray(waves.sum(axis=2) * np.sqrt(2 / _FIELD_WAVES))

    return height


_WAVES: Final = 8
_WAVELENGTHS_M: Final = (60.0, 150.0)


@dataclass(frozen=True, slots=True, kw_only=True)
class VectorNoise:
    """Errors of perceived vectors.

    Fractions of missed objects and of lines with a gap of `gap_m`; root mean square `shift_m` of a smooth shift of all
    coordinates, each axis, which keeps junctions.
    """

    missed_share: float = 0.10
    gap_share: float = 0.15
    gap_m: float = 6.0
    shift_m: float = 1.0


def perceive_vectors(
    state: State, pose: Pose, *, side_m: float, noise: VectorNoise, rng: np.random.Generator
) -> "gpd.GeoDataFrame":
    """Return the vectors of the visible features in a view of a state.

    Columns are `class`, `level`, `is_bridge` and `geometry`: (right, up) from the middle of the view, metres. `side_m`
    is the side of the view for scale 1.
    """
    outline = footprint(pose, size_m=(side_m, side_m))
    features = state.features
    near = features.sindex.query(outline, predicate="intersects")
    table = features.iloc[np.sort(near)]
    table = table[table["is_visible"].to_numpy() & table["class"].isin(VECTOR_CLASSES).to_numpy()]
    clipped = shapely.intersection(shapely.make_valid(table.geometry.to_numpy()), outline)
    back = inverse(pose)
    local = shapely.transform(clipped, back.to_map)
    streams = Streams(rng)
    local = shapely.transform(local, smooth_shift(noise.shift_m, streams.view))
    missed, gap, places = streams.chances(table["class"].to_numpy(dtype=object), 3)
    seen, gaps = missed >= noise.missed_share, gap < noise.gap_share
    rows = []
    for at, (shape, (_, row)) in enumerate(zip(local, table.iterrows(), strict=True)):
        if seen[at]:
            parts = _parts(shape, cut_m=noise.gap_m if gaps[at] else 0.0, place=float(places[at]))
            rows += [(row["class"], int(row["level"]), bool(row["is_bridge"]), part) for part in parts]
    return vector_table(rows)


def site_vectors(shot: ViewRequest, pose: Pose | None = None) -> "gpd.GeoDataFrame":
    """Perceive the vectors of a shot with its detector, at its site unless another pose is given."""
    world, place, side_m = shot.scene.world, pose or shot.site.pose, shot.variant.side_m
    rng = shot.rng("vectors", *shot.draw)
    if shot.variant.detector == PUBLISHED:
        return perceive_vectors(world, place, side_m=side_m, noise=VectorNoise(), rng=rng)
    return perceive_coarsely(world, place, side_m=side_m, noise=MeasuredVectorNoise(), rng=rng)


def smooth_shift(rms_m: float, rng: np.random.Generator) -> Callable[[NDArray[np.float64]], NDArray[np.float64]]:
    """Draw a smooth field of shifts, a sum of plane waves, as a function of points of shape (N, 2), metres."""
    turns = rng.uniform(0, 2 * np.pi, _WAVES)
    waves = (
        np.column_stack((np.cos(turns), np.sin(turns))) * (2 * np.pi / rng.uniform(*_WAVELENGTHS_M, _WAVES))[:, None]
    )
    phases = rng.uniform(0, 2 * np.pi, (2, _WAVES))
    scale_m = rms_m * np.sqrt(2 / _WAVES)

    def shifted(points: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return points (N, 2) moved by the field of waves."""
        angle = points @ waves.T
        return np.asarray(points + scale_m * np.column_stack([np.cos(angle + phase).sum(axis=1) for phase in phases]))

    return shifted


def round_vectors(vectors: "gpd.GeoDataFrame", shapes: NDArray[np.object_]) -> "gpd.GeoDataFrame":
    """Return the same vectors with other shapes, rounded."""
    columns = (vectors[name].to_list() for name in ("class", "level", "is_bridge"))
    return vector_table(list(zip(*columns, shapes, strict=True)))


def _parts(shape: shapely.Geometry, *, cut_m: float, place: float) -> list[shapely.Geometry]:
    """Return lines and polygons of a shape; cut a gap into its first line."""
    parts = [
        part for part in shapely.get_parts(shapely.get_parts(shape)) if part.geom_type in ("LineString", "Polygon")
    ]
    if cut_m and parts and parts[0].geom_type == "LineString" and parts[0].length > 2 * cut_m:
        middle = shapely.line_interpolate_point(parts[0], place * parts[0].length)
        parts = [*shapely.get_parts(shapely.difference(parts[0], middle.buffer(cut_m / 2))), *parts[1:]]
    return [part for part in parts if part.length >= _LEAST_M]
