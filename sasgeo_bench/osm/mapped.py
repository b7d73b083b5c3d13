# SPDX-License-Identifier: Apache-2.0
"""The mapped ground of a grid: what is sea, to the right of a coastline, and what is unknown and why."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
import shapely
from numpy.typing import NDArray

from sasgeo_bench.geometry.grid import Grid
from sasgeo_bench.geometry.projection import from_lonlat, to_lonlat
from sasgeo_bench.osm.coverage import ground_within_reach
from sasgeo_bench.osm.locate import CoverageSource
from sasgeo_bench.osm.scan import Box

OPEN: Final = "near a gap in the coastline"
CONTRARY: Final = "between coastlines that contradict each other"
_OFFSET_M: Final = 0.01  # to the side of the line; also the resolution of OSM nodes

Floats = NDArray[np.float64]
Geometries = NDArray[np.object_]


@dataclass(frozen=True, slots=True, kw_only=True)
class Shore:
    """Mapped ground by the side of the coast it lies on: `sea` and `land` are polygons, `unknown` areas by reason."""

    sea: Geometries
    land: Geometries
    unknown: dict[str, shapely.Geometry]


def find_shore(coast: Sequence[shapely.Geometry] | Geometries, mapped: shapely.Geometry) -> Shore:
    """Divide mapped ground into sea and land; `coast` has water on its right, both are in a projected CRS, metres.

    The coast and the edge of the mapped area divide it into faces. A face that meets only right sides of coasts is sea,
    only left sides land, both unknown, none neither. A coast that ends within the mapped area continues to the nearest
    beginning of another, or to the edge; ground no further from such a link than its length is unknown.

    >>> shore = find_shore([shapely.LineString([(-9, 3), (19, 3)])], shapely.box(0, 0, 10, 10))
    >>> [float(shapely.area(faces).sum()) for faces in (shore.sea, shore.land)]
    [30.0, 70.0]
    """
    # Single lines, joined where one ends and another begins
    parts = shapely.get_parts(np.array(coast, dtype=object))
    lines = np.asarray(shapely.get_parts(shapely.line_merge(shapely.multilinestrings(parts), directed=True)))
    lines = lines[shapely.intersects(lines, mapped)]
    if len(lines) == 0:
        return Shore(sea=lines, land=lines, unknown={})
    edge = shapely.boundary(mapped)
    links = _links(lines, mapped, edge)
    faces = shapely.get_parts(shapely.polygonize([shapely.unary_union([*lines, *links, edge])]))
    faces = faces[shapely.intersects(shapely.point_on_surface(faces), mapped)]
    right_m, left_m = _coast_m(lines, faces, edge)
    # 0.01 of a face's coast: less of the other side is a loop of a badly drawn line
    slip_m = 0.01 * (right_m + left_m)
    is_wet, is_dry = right_m > slip_m, left_m > slip_m
    ground = {
        OPEN: shapely.union_all(
            [shapely.buffer(link, link.length) for link in links]
            + list(faces[~is_wet & ~is_dry & shapely.intersects(faces, shapely.union_all(links))])
        ),
        CONTRARY: shapely.union_all(faces[is_wet & is_dry]),
    }
    unknown = {reason: shapely.intersection(area, mapped) for reason, area in ground.items() if not area.is_empty}
    doubt = shapely.union_all(list(unknown.values()))
    return Shore(
        sea=_without(faces[is_wet & ~is_dry], doubt), land=_without(faces[is_dry & ~is_wet], doubt), unknown=unknown
    )


def _coast_m(lines: Geometries, faces: Geometries, edge: shapely.Geometry) -> tuple[Floats, Floats]:
    """Return the metres of coast that each face has on the right and on the left of the line."""
    start, end = _segments(lines, edge)
    ahead = end - start
    length_m = np.hypot(*ahead.T)
    to_right = np.column_stack((ahead[:, 1], -ahead[:, 0])) / length_m[:, None] * _OFFSET_M

    middle = start + ahead / 2
    return _length_in(faces, middle + to_right, length_m), _length_in(faces, middle - to_right, length_m)


def _without(faces: Geometries, doubt: shapely.Geometry) -> Geometries:
    parts = shapely.get_parts(shapely.get_parts(shapely.difference(faces, doubt)))
    return np.asarray(parts[shapely.get_dimensions(parts) == 2])  # polygons


def _links(lines: Geometries, mapped: shapely.Geometry, edge: shapely.Geometry) -> list[shapely.Geometry]:
    """Return straight lines from loose ends to loose beginnings or the edge, of the smallest total length."""
    begins, ends = (shapely.get_coordinates(shapely.get_point(lines, index)) for index in (0, -1))
    places, count = np.unique(np.concatenate((begins, ends)), axis=0, return_counts=True)
    single = {tuple(place) for place in places[count == 1].tolist()}
    loose_begins, loose_ends = (
        np.array([tip for tip in tips.tolist() if tuple(tip) in single and shapely.contains_xy(mapped, *tip)]).reshape(
            -1, 2
        )
        for tips in (begins, ends)
    )
    tips = np.concatenate((loose_ends, loose_begins))
    if len(tips) == 0:
        return []
    from scipy.optimize import linear_sum_assignment  # noqa: PLC0415 - slow to import, and most places have no sea
    from scipy.spatial.distance import cdist  # noqa: PLC0415

    to_edge = [_beyond(shapely.shortest_line(shapely.Point(tip), edge)) for tip in tips]
    first = len(loose_ends)
    cost = np.zeros((len(tips), len(tips)))
    cost[:first, : len(loose_begins)] = cdist(loose_ends, loose_begins)
    cost[:first, len(loose_begins) :] = [[line.length] for line in to_edge[:first]]
    cost[first:, : len(loose_begins)] = [line.length for line in to_edge[first:]]
    # Rows: an end, or the edge that a beginning may have instead. Columns: a beginning, or the edge for an end.
    pairs = zip(*linear_sum_assignment(cost), strict=True)
    found = []
    for row, column in pairs:
        if row < first and column < len(loose_begins):
            found.append(shapely.LineString([loose_ends[row], loose_begins[column]]))
        elif row < first:
            found.append(to_edge[row])
        elif column < len(loose_begins):
            found.append(to_edge[first + column])
    return [link for link in found if link.length > 0]


def _beyond(link: shapely.Geometry) -> shapely.Geometry:
    """Lengthen a line to the edge a little: it must divide the ground, and rounding may stop it short."""
    start, end = shapely.get_coordinates(link)
    return shapely.LineString([start, end + (end - start) * (_OFFSET_M / max(link.length, _OFFSET_M))])


def _length_in(faces: Geometries, points: Floats, length_m: Floats) -> Floats:
    face, point = shapely.STRtree(shapely.points(points)).query(faces, predicate="contains")
    return np.bincount(face, weights=length_m[point], minlength=len(faces)).astype(np.float64)


def _segments(lines: Geometries, edge: shapely.Geometry) -> tuple[Floats, Floats]:
    """Return beginnings and ends, shape (N, 2), of short straight pieces, none of which crosses the edge."""
    # 25 m: the sides of a coastline are sampled once in each straight piece of at most this length
    points, line = shapely.get_coordinates(shapely.segmentize(lines, 25.0), return_index=True)
    joined = (line[1:] == line[:-1]) & (points[1:] != points[:-1]).any(axis=1)
    start, end = points[:-1][joined], points[1:][joined]
    straight = np.asarray(shapely.linestrings(np.stack((start, end), axis=1)))
    shapely.prepare(edge)
    crosses = shapely.intersects(edge, straight)
    crosses[crosses] = shapely.crosses(edge, straight[crosses])
    split = shapely.difference(straight[crosses], shapely.buffer(edge, _OFFSET_M))
    parts, owner = shapely.get_parts(split, return_index=True)
    is_left = ~shapely.is_empty(parts)
    first, last = (shapely.get_coordinates(shapely.get_point(parts[is_left], index)) for index in (0, -1))
    turned = (((last - first) * (end - start)[crosses][owner[is_left]]).sum(axis=1) < 0)[:, None]
    begins, ends = np.where(turned, last, first), np.where(turned, first, last)
    return np.concatenate((start[~crosses], begins)), np.concatenate((end[~crosses], ends))


CUT: Final = "within reach of ways cut at the edge of the extract"
_ANTIMERIDIAN_DEG: Final = 180.0
_AROUND_DEG: Final = 0.5  # coast further away has no effect, and a projection holds this far


@dataclass(frozen=True, slots=True, kw_only=True)
class Mapped:
    """The known ground of a grid, in its CRS.

    `coverage` is the mapped area less the unknown ground in it, `unknown_m2` the size of that ground by reason, and
    `sea` the polygons of the mapped area on the water side of the coast.
    """

    coverage: shapely.Geometry
    source: CoverageSource
    sea: Geometries
    unknown_m2: dict[str, float]


def map_ground(
    grid: Grid,
    area: shapely.Geometry,
    source: CoverageSource,
    *,
    coast: Geometries,
    gaps: Geometries,
    frame: shapely.Geometry,
) -> Mapped:
    """Find the mapped ground of a grid, the sea in it, and what is unknown.

    `area` and `source` come from `choose_coverage`, `gaps` from `find_gaps`; `coast` holds every coastline of the
    extract, water on its right; `frame` is a box that holds the extract's vertices. All are in longitude and latitude.
    Where the area is estimated, whole islands and the sea around them count as mapped too.
    """
    west, south, east, north = lonlat_box(grid)
    near = shapely.box(west - _AROUND_DEG, south - _AROUND_DEG, east + _AROUND_DEG, north + _AROUND_DEG)
    bounds = shapely.box(*grid.bounds_m)
    ground = project(shapely.intersection(area, near), grid.epsg)
    lines = project(coast[shapely.intersects(coast, near)], grid.epsg)
    within = project(shapely.intersection(frame, near), grid.epsg)
    if source == "estimated" and len(lines):
        whole = _islands(lines, within)
        ground, source = shapely.union(ground, whole), "estimated" if whole.is_empty else "estimated and islands"
    shore = find_shore(lines, ground)
    tips = project(gaps[shapely.intersects(gaps, near)], grid.epsg)
    lost = {CUT: ground_within_reach(tips, shapely.intersection(ground, within))} if len(tips) else {}
    unknown = {reason: shapely.intersection(part, bounds) for reason, part in (lost | shore.unknown).items()}
    coverage = _less(shapely.intersection(ground, bounds), unknown)
    sea = shapely.get_parts(shapely.get_parts(shapely.intersection(shore.sea, bounds)))
    return Mapped(
        coverage=coverage,
        source=source,
        sea=sea[shapely.area(sea) > 0],
        unknown_m2={reason: float(part.area) for reason, part in unknown.items() if part.area > 0},
    )


def _less(ground: shapely.Geometry, unknown: dict[str, shapely.Geometry]) -> shapely.Geometry:
    if all(part.is_empty for part in unknown.values()):
        return ground
    parts = shapely.get_parts(shapely.difference(ground, shapely.union_all(list(unknown.values()))))
    return shapely.multipolygons(parts[shapely.get_dimensions(parts) == 2])  # dimensions of a polygon


def _islands(coast: Geometries, frame: shapely.Geometry) -> shapely.Geometry:
    """Return islands that lie whole within a frame and the sea around them; empty if a coastline is not whole."""
    shore = find_shore(coast, frame)
    is_whole = shapely.length(shapely.intersection(shore.land, shapely.boundary(frame))) == 0
    if shore.unknown or not is_whole.any():
        return shapely.Polygon()
    islands = shapely.union_all(shore.land[is_whole])
    around = shapely.union_all([islands, *shore.sea])
    # 1000 m: sea mapped around whole islands: no view is wider, no strait much narrower
    # 20 m: simplification of islands, of which a buffer of a kilometre is taken
    return shapely.intersection(around, shapely.buffer(shapely.simplify(islands, 20.0), 1000.0))


def project(geometry: shapely.Geometry, epsg: int) -> shapely.Geometry:
    """Project longitude and latitude to easting and northing, rounded to a millimetre; one geometry or an array."""
    to_grid = from_lonlat(epsg)

    def projected(points: NDArray[np.float64]) -> NDArray[np.float64]:
        """Coordinates of shape (N, 2), degrees -> metres."""
        # 3: OSM itself is rounded to about a centimetre; a millimetre keeps shared nodes equal
        return np.column_stack(to_grid.transform(points[:, 0], points[:, 1])).round(3) + 0.0

    return shapely.transform(geometry, projected)


def lonlat_box(grid: Grid) -> Box:
    """Return west, south, east, north of a grid, degrees: the box around its bent edges.

    Of a grid with an edge at the antimeridian, a bent corner may lie beyond: the box ends there.
    """
    change = to_lonlat(grid.epsg)
    # 21 edge points along each edge of a box: its sides bend when projected
    bounds = change.transform_bounds(*grid.bounds_m, densify_pts=21)
    west, south, east, north = map(float, bounds)
    if west > east:
        left, low, right, high = grid.bounds_m
        is_eastern = change.transform((left + right) / 2, (low + high) / 2)[0] > 0
        west, east = (west, _ANTIMERIDIAN_DEG) if is_eastern else (-_ANTIMERIDIAN_DEG, east)
    return (west, south, east, north)


def box_text(box: Box | NDArray[np.float64]) -> str:
    """Format a box for an error, to four decimals."""
    return "[" + ", ".join(f"{value:.4f}" for value in box) + "]"
