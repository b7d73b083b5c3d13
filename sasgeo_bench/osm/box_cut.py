# SPDX-License-Identifier: Apache-2.0
"""Whether an extract was cut by the box of its header: ground in it without any object is then known to be empty."""

from collections.abc import Callable
from pathlib import Path
from typing import Any, Final

import numpy as np
import osmium
import shapely
from numpy.typing import NDArray

from sasgeo_bench.geometry.pairs import overlapping
from sasgeo_bench.osm.coverage import FULL_SHARE, LONGEST_M, M_PER_DEG
from sasgeo_bench.osm.mapped import find_shore
from sasgeo_bench.osm.scan import Scan
from sasgeo_bench.osm.snapshot import elements
from sasgeo_bench.osm.taxonomy import load_taxonomy

# Lines with the trait "through" lead somewhere: where they end at the edge of the data, the extract was cut there. Of
# 191 extracts with a box, those cut along a border have 2 to 11 such ends beyond the estimated area, or more than 0.38
# at its edge for each crossing of the box; those cut by a box have none beyond it and at most 0.25.
_MOST_OUTSIDE: Final = 1
_MOST_ENDS: Final = 0.3
# The box around a country or a town is crossed far less often than lines a little further inside.
_INSIDE: Final = 0.1  # of the box's width and height
_LEAST_CROSSED: Final = 0.3
_PROBES: Final = 64  # along each side of the box

Geometries = NDArray[np.object_]


def cuts_by_box(path: Path, scan: Scan, objects: Geometries) -> Callable[[shapely.Geometry, shapely.Geometry], bool]:
    """Return the function that tells whether an extract was cut by a box, from its content.

    `path` is a sorted file with one state of the world (`open_snapshot`), `scan` what was found in it, and `objects`
    the geometry of its rows and of all that lies far off, in longitude and latitude. The function gets the area that
    holds vertices (`estimate_coverage`) and the box of the header, or several boxes as one geometry.
    """

    def is_cut(found: shapely.Geometry, header: shapely.Geometry) -> bool:
        west, south, _, north = shapely.bounds(header)
        scale = np.array([np.cos(np.radians((south + north) / 2)), 1.0]) * M_PER_DEG

        def flat(geometry: Any) -> Any:  # noqa: ANN401 - one geometry or an array
            return shapely.transform(geometry, lambda lonlat: (lonlat - [west, south]) * scale)

        things, box, area = flat(objects), flat(header), flat(found)
        if _ends_inside(_through_ways(path, flat), things, area, box):
            return False
        coast = flat(shapely.from_wkb(np.array(scan.coast, dtype=object)))
        sea = shapely.union_all(find_shore(coast, box).sea)
        # 0.25 of the box: around a small island in a large box there may be others, cut away
        is_shown = shapely.area(shapely.intersection(area, box)) >= 0.25 * shapely.area(box)
        if is_shown and _filled_share(things, area, box, sea) >= FULL_SHARE:
            return True
        tips = [mark for marks in scan.gaps.values() for mark in marks]
        return _is_crossed_all_round(things, flat(np.array(tips, dtype=object)), box, sea)

    return is_cut


def _through_ways(path: Path, flat: Callable[[Any], Any]) -> list[tuple[shapely.Geometry, list[shapely.Point]]]:
    """Return open ways of the classes that lead somewhere, each with the ends at which it should meet another."""
    taxonomy = load_taxonomy()
    rules = [rule for name in taxonomy.having("through") for rule in taxonomy[name].rules if rule.geometry == "line"]
    wanted = osmium.filter.TagFilter(*((rule.key, value) for rule in rules for value in (*rule.widths, *rule.values)))
    ways = osmium.FileProcessor(str(path)).with_locations()
    found = []
    for way in elements(ways.with_filter(osmium.filter.EntityFilter(osmium.osm.WAY)).with_filter(wanted)):
        places = [(node.lon, node.lat) for node in way.nodes if node.location.valid()]
        if way.is_closed() or len(set(places)) < 2:  # no line
            continue
        ends = places[-1:] if "waterway" in way.tags else [places[0], places[-1]]  # streams begin anywhere
        found.append((flat(shapely.LineString(places)), [flat(shapely.Point(place)) for place in ends]))
    return found


def _ends_inside(
    ways: list[tuple[shapely.Geometry, list[shapely.Point]]],
    objects: Geometries,
    area: shapely.Geometry,
    box: shapely.Geometry,
) -> bool:
    """Return whether lines that lead somewhere end at the edge of the data instead, far from the sides of the box."""
    if not ways:
        return False
    crossings = int(shapely.intersects(np.array([line for line, _ in ways]), shapely.boundary(box)).sum())
    ends = np.array([end for _, of_way in ways for end in of_way], dtype=object)
    ends = ends[shapely.contains(box, ends) & (shapely.distance(ends, shapely.boundary(box)) > LONGEST_M)]
    ends = ends[(shapely.distance(ends, shapely.boundary(area)) <= LONGEST_M) | ~shapely.intersects(ends, area)]
    end, _ = overlapping(ends, objects, predicate="intersects")
    loose = ends[np.bincount(end, minlength=len(ends)) <= 1]
    outside = int((~shapely.intersects(loose, area)).sum())
    return outside > _MOST_OUTSIDE or len(loose) > _MOST_ENDS * crossings


def _filled_share(objects: Geometries, area: shapely.Geometry, box: shapely.Geometry, sea: shapely.Geometry) -> float:
    """Return the share of the land in the box that holds vertices or lies inside a mapped area: a lake, a wood."""
    west, south, east, north = shapely.bounds(box)
    steps = (np.arange(_PROBES) + 0.5) / _PROBES
    xs, ys = np.meshgrid(west + steps * (east - west), south + steps * (north - south))
    probes = shapely.points(xs.ravel(), ys.ravel())
    probes = probes[shapely.intersects(probes, box) & ~shapely.intersects(probes, sea)]
    if len(probes) == 0:
        return 1.0
    is_filled = shapely.intersects(probes, area)
    areas = objects[shapely.get_dimensions(objects) == 2]  # polygons
    probe, _ = overlapping(probes, areas, predicate="intersects")
    is_filled[probe] = True
    return float(is_filled.mean())


def _is_crossed_all_round(objects: Geometries, tips: Geometries, box: shapely.Geometry, sea: shapely.Geometry) -> bool:
    """Return whether objects cross each side of the box that is not in the sea, as they cross lines a little inside."""
    west, south, east, north = shapely.bounds(box)
    if not shapely.equals(box, shapely.box(west, south, east, north)):
        return False  # several boxes
    inset = np.array([east - west, north - south]) * _INSIDE
    tree = shapely.STRtree(objects)

    def crossings(x: float, y: float) -> NDArray[np.int64]:
        corners = np.array([(west + x, south), (west + x, north), (east - x, south), (east - x, north),
                            (west, south + y), (east, south + y), (west, north - y), (east, north - y)])  # fmt: skip
        lines = shapely.linestrings(corners.reshape(4, 2, 2))
        line, _ = tree.query(lines, predicate="intersects")
        return np.bincount(line, minlength=4)

    sides = shapely.linestrings([[(west, south), (west, north)], [(east, south), (east, north)],
                                 [(west, south), (east, south)], [(west, north), (east, north)]])  # fmt: skip
    outer, inner = crossings(0.0, 0.0), crossings(*inset)
    outer += np.array([(shapely.distance(tips, side) <= LONGEST_M).sum() for side in sides])
    if not outer.any() or not ((outer > 0) | shapely.intersects(sides, sea)).all():
        return False
    # 30 crossings further inside: fewer are too few to compare
    return bool(inner.sum() < 30 or outer.sum() >= _LEAST_CROSSED * inner.sum())
