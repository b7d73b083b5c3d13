# SPDX-License-Identifier: Apache-2.0
"""The area that an extract maps, and the ground of ways that it cut: there, nothing is known to be absent."""

from collections.abc import Callable
from itertools import pairwise
from typing import Any, Final

import cv2
import numpy as np
import shapely
from numpy.typing import NDArray
from rasterio.features import shapes
from shapely.ops import substring

from sasgeo_bench.osm.locate import CoverageSource

CELL_M: Final = 100.0
CLOSE_M: Final = 600.0  # villages, woods and pastures of one mapped country lie closer together than this
FULL_SHARE: Final = 0.85  # data that fills this much of the header's box was cut by that box
_HALF_ROUND_DEG: Final = 180.0
M_PER_DEG: Final = 111_320.0  # of latitude; a coverage cell is 100 m, so the sphere is near enough


def estimate_coverage(lonlat: NDArray[np.float64]) -> shapely.Geometry:
    """Estimate the area that holds mapped vertices; longitude and latitude of shape (N, 2), degrees.

    Mark cells of 100 m that hold a vertex, close them over 600 m, fill holes, and remove thin tails (ways kept whole
    across the edge) and small leftovers. A region file's `coverage_lonlat` overrules the estimate. Return an empty
    polygon for no vertices.

    >>> field = np.array([[9 + i / 800, 47 + j / 1200] for i in range(40) for j in range(40)])
    >>> estimate_coverage(field).contains(shapely.Point(9.02, 47.02))
    True
    """
    if len(lonlat) == 0:
        return shapely.Polygon()
    west, south = np.percentile(lonlat, 0.1, axis=0)
    east, north = np.percentile(lonlat, 99.9, axis=0)
    if east - west > _HALF_ROUND_DEG:  # on both sides of the antimeridian: cells all around the globe are too many
        is_west = lonlat[:, 0] < 0
        return shapely.union(estimate_coverage(lonlat[is_west]), estimate_coverage(lonlat[~is_west]))
    step = np.array([CELL_M / (M_PER_DEG * np.cos(np.radians((south + north) / 2))), CELL_M / M_PER_DEG])
    pad = int(CLOSE_M / CELL_M) + 2
    origin = np.array([west, south]) - pad * step
    size = np.ceil((np.array([east, north]) - origin) / step).astype(int) + pad
    cells = np.floor((lonlat - origin) / step).astype(int)
    cells = cells[((cells >= 0) & (cells < size)).all(axis=1)]
    filled = np.zeros((size[1], size[0]), dtype=bool)
    filled[cells[:, 1], cells[:, 0]] = True
    outline = _largest(_opened(_closed(filled)))
    found = [shapely.geometry.shape(shape) for shape, _ in shapes(outline.astype(np.uint8), mask=outline)]
    scaled = shapely.transform(shapely.union_all(found), lambda points: points * step + origin)
    return shapely.simplify(scaled, float(step.mean()))


# OpenCV has all of this, and is imported anyway: scipy takes a sixth of a second to import.
def _disc(reach: int) -> NDArray[np.uint8]:
    rows, cols = np.ogrid[-reach : reach + 1, -reach : reach + 1]
    return np.asarray(rows**2 + cols**2 <= reach**2, dtype=np.uint8)


def _closed(cells: NDArray[np.bool_]) -> NDArray[np.bool_]:
    closed = cv2.morphologyEx(cells.view(np.uint8), cv2.MORPH_CLOSE, _disc(int(CLOSE_M / CELL_M / 2)))
    around = cv2.copyMakeBorder(closed, 1, 1, 1, 1, cv2.BORDER_CONSTANT, value=0)
    cv2.floodFill(around, None, (0, 0), 1)  # all that holes do not hold
    return np.asarray((closed > 0) | (around[1:-1, 1:-1] == 0))


def _opened(cells: NDArray[np.bool_]) -> NDArray[np.bool_]:
    # 150 m: half the width of what is cut off: a road or stream kept whole beyond the edge
    reach = int(150.0 / CELL_M)
    square = np.ones((2 * reach + 1, 2 * reach + 1), np.uint8)
    opened = (
        cv2.morphologyEx(cells.astype(np.uint8), cv2.MORPH_OPEN, square, borderType=cv2.BORDER_CONSTANT, borderValue=0)
        > 0
    )
    return np.asarray(opened) if opened.any() else cells


def _largest(cells: NDArray[np.bool_]) -> NDArray[np.bool_]:
    count, labels, about, _ = cv2.connectedComponentsWithStats(cells.astype(np.uint8), connectivity=4)
    if count == 1:
        return cells
    sizes = about[:, cv2.CC_STAT_AREA]
    # 0.02 of the largest piece: smaller ones are leftovers of relations that cross the edge
    return np.asarray((sizes >= 0.02 * sizes[1:].max())[labels] & cells)


def choose_coverage(
    lonlat: NDArray[np.float64],
    *,
    stated: shapely.Geometry | None,
    header: shapely.Geometry | None,
    is_cut_by_box: Callable[[shapely.Geometry, shapely.Geometry], bool] = lambda _found, _header: False,
) -> tuple[shapely.Geometry, CoverageSource]:
    """Choose the mapped area of an extract, in degrees, and name its source.

    The region file's polygon (`stated`) comes first. The box of the file's header, or its boxes as one geometry, is
    taken if the data fill it, or else if `is_cut_by_box` says so of the estimate and the box (`read.cuts_by_box`).
    Otherwise the extract was cut along a border, and the estimate within the box is taken.
    """
    if stated is not None:
        return stated, "region file"
    found = estimate_coverage(lonlat)
    if header is None:
        return found, "estimated"
    within = shapely.intersection(found, header)
    if shapely.area(within) >= FULL_SHARE * shapely.area(header) or is_cut_by_box(found, header):
        return header, "header box"
    return within, "estimated"


# In four real extracts 99 % of cut ways end nearer to the edge; further inside, the node is missing for other reasons.
LONGEST_M: Final = 200.0

Geometries = NDArray[np.object_]


def find_gaps(way: Any) -> list[shapely.Geometry]:  # noqa: ANN401 - an osmium way, or what looks like one
    """List the gaps of a way, in longitude and latitude; none if it has all of its nodes, or no node.

    Return a line over each gap of a closed way, and a point for each node next to a gap of an open way.
    """
    places = [(node.lon, node.lat) if node.location.valid() else None for node in way.nodes]
    known = [index for index, place in enumerate(places) if place is not None]
    if not way.is_closed():
        tips = [index for index in known if None in places[max(index - 1, 0) : index + 2]]
        return [shapely.Point(places[index]) for index in tips]
    if not known:
        return []
    round_again = [*places[known[0] : -1], *places[: known[0] + 1]]
    there = [index for index, place in enumerate(round_again) if place is not None]
    return [
        shapely.LineString([round_again[before], round_again[after]])
        for before, after in pairwise(there)
        if after > before + 1
    ]


def ground_within_reach(gaps: Geometries, mapped: shapely.Geometry) -> shapely.Geometry:
    """Return the ground on which the missing parts of cut ways may lie, within the mapped area.

    It reaches as far around each node next to a gap as the edge is away, at most `LONGEST_M`; for a closed way it
    includes what lies between its gap and the edge. `gaps` come from `find_gaps`; both arguments share a projected CRS,
    metres.

    >>> road, field = shapely.Point(3, 50), shapely.LineString([(2, 10), (2, 30)])
    >>> reach = ground_within_reach(np.array([road, field]), shapely.box(0, 0, 100, 100))
    >>> [bool(shapely.intersects_xy(reach, *place)) for place in ((4, 50), (7, 50), (1, 20), (5, 20))]
    [True, False, True, False]
    """
    tips, gap = shapely.get_coordinates(gaps, return_index=True)
    points = shapely.points(tips)
    to_edge_m = shapely.distance(points, shapely.boundary(mapped))
    is_cut = shapely.contains(mapped, points)
    is_ring = np.bincount(gap[is_cut & (to_edge_m <= LONGEST_M)], minlength=len(gaps)) > 1
    parts = shapely.get_parts(mapped)
    between = [_up_to_edge(line, parts) for line in gaps[is_ring]]
    discs = shapely.buffer(points[is_cut], np.minimum(to_edge_m, LONGEST_M)[is_cut])
    return shapely.intersection(shapely.union_all([*discs, *between]), mapped)


def _up_to_edge(gap: shapely.Geometry, parts: Geometries) -> shapely.Geometry:
    """Return the area between a line over a gap and the edge of the mapped area, by the shorter way round."""
    edge = shapely.get_exterior_ring(parts[np.argmin(shapely.distance(parts, gap))])
    ring = shapely.LineString(edge.coords)
    first, last = sorted(shapely.line_locate_point(ring, shapely.points(gap.coords)).tolist())
    if last - first <= ring.length / 2:
        around = [substring(ring, first, last)]
    else:
        around = [substring(ring, last, ring.length), substring(ring, 0, first)]
    return shapely.convex_hull(shapely.union_all([gap, *around]))
