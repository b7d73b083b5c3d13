# SPDX-License-Identifier: Apache-2.0
"""Ways that lost nodes where the extract was cut: the ground they lead over is unknown."""

from itertools import pairwise
from typing import Any, Final

import numpy as np
import shapely
from numpy.typing import NDArray
from shapely.ops import substring

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
