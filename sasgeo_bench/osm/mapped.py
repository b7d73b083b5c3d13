# SPDX-License-Identifier: Apache-2.0
"""The mapped ground of a grid: which part of it is sea, and what is unknown and why."""

from dataclasses import dataclass
from typing import Final

import numpy as np
import pyproj
import shapely
from numpy.typing import NDArray

from sasgeo_bench.geometry.grid import Grid
from sasgeo_bench.osm.cuts import ground_within_reach
from sasgeo_bench.osm.locate import CoverageSource
from sasgeo_bench.osm.scan import Box
from sasgeo_bench.osm.sea import find_shore

CUT: Final = "within reach of ways cut at the edge of the extract"
OFFSHORE_M: Final = 1000.0  # sea mapped around whole islands: no view is wider, no strait much narrower
_WGS84: Final = 4326
_EDGE_POINTS: Final = 21  # along each edge of a box: its sides bend when projected
_DECIMALS: Final = 3  # OSM itself is rounded to about a centimetre; a millimetre keeps shared nodes equal
_AROUND_DEG: Final = 0.5  # coast further away has no effect, and a projection holds this far
_COARSE_M: Final = 20.0  # simplification of islands, of which a buffer of a kilometre is taken
_AREA: Final = 2  # dimensions of a polygon

Geometries = NDArray[np.object_]


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
    return shapely.multipolygons(parts[shapely.get_dimensions(parts) == _AREA])


def _islands(coast: Geometries, frame: shapely.Geometry) -> shapely.Geometry:
    """Return islands that lie whole within a frame and the sea around them; empty if a coastline is not whole."""
    shore = find_shore(coast, frame)
    is_whole = shapely.length(shapely.intersection(shore.land, shapely.boundary(frame))) == 0
    if shore.unknown or not is_whole.any():
        return shapely.Polygon()
    islands = shapely.union_all(shore.land[is_whole])
    around = shapely.union_all([islands, *shore.sea])
    return shapely.intersection(around, shapely.buffer(shapely.simplify(islands, _COARSE_M), OFFSHORE_M))


def project(geometry: shapely.Geometry, epsg: int) -> shapely.Geometry:
    """Project longitude and latitude to easting and northing, rounded to a millimetre; one geometry or an array."""
    to_grid = pyproj.Transformer.from_crs(_WGS84, epsg, always_xy=True)

    def projected(points: NDArray[np.float64]) -> NDArray[np.float64]:
        """Coordinates of shape (N, 2), degrees -> metres."""
        return np.column_stack(to_grid.transform(points[:, 0], points[:, 1])).round(_DECIMALS) + 0.0

    return shapely.transform(geometry, projected)


def lonlat_box(grid: Grid) -> Box:
    """Return west, south, east, north of a grid, degrees: the box around its bent edges."""
    to_lonlat = pyproj.Transformer.from_crs(grid.epsg, _WGS84, always_xy=True)
    west, south, east, north = grid.bounds_m
    bounds = to_lonlat.transform_bounds(west, south, east, north, densify_pts=_EDGE_POINTS)
    return (float(bounds[0]), float(bounds[1]), float(bounds[2]), float(bounds[3]))


def box_text(box: Box | NDArray[np.float64]) -> str:
    """Format a box for an error, to four decimals."""
    return "[" + ", ".join(f"{value:.4f}" for value in box) + "]"
