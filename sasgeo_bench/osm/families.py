# SPDX-License-Identifier: Apache-2.0
"""Families of classes that every built-up area has: where one is missing, the extract was filtered."""

from collections.abc import Sequence
from typing import Final

import geopandas as gpd
import numpy as np
import shapely
from numpy.typing import NDArray

from sasgeo_bench.osm.taxonomy import load_taxonomy

FAMILIES: Final = {
    "roads": load_taxonomy().of_graph("road"),
    "buildings": load_taxonomy().of_graph("building"),
    "land cover": load_taxonomy().of_graph("area"),
}


def missing_families(
    features: gpd.GeoDataFrame,
    coverage: shapely.Geometry,
    *,
    classes: Sequence[str],
    built_up: Sequence[shapely.Geometry] | NDArray[np.object_],
) -> str:
    """Return a warning that names the classes of which a built-up area has nothing, by family; empty if it has all.

    `features`, `coverage`, the mapped area, and `built_up`, areas where people live or work, share a projected CRS,
    metres; `classes` are those that the map should hold. An extract that was filtered to roads looks like a town
    without a house.
    """
    km2 = shapely.area(coverage) / 1e6
    there = {name: features.geometry.array[(features["class"] == name).to_numpy()] for name in classes}
    wanted = [[name for name in family if name in there] for family in FAMILIES.values()]
    missing = [name for family in wanted if not any(len(there[name]) for name in family) for name in family]
    if km2 < 0.1 or not missing:  # a smaller place may well be all street
        return ""
    road_km = sum(_km(there.get(name, ()), coverage) for name in FAMILIES["roads"])
    rail_km = _km(there.get("railway", ()), coverage)
    houses = int(shapely.intersects(there.get("building", ()), coverage).sum())
    land = shapely.make_valid(np.asarray(built_up, dtype=object))
    land_km2 = float(shapely.area(shapely.intersection(land, coverage)).sum()) / 1e6
    # 5 km of roads a square kilometre: villages have more, fields and mountains less
    # 1 km of railways a square kilometre: there is a station, and nowhere are rails without a way to them
    # 0.1 of the ground, where people live or work
    limits = ((road_km, 5.0), (rail_km, 1.0), (houses, 50), (land_km2, 0.1))  # 50 buildings a square kilometre
    if all(found < limit * km2 for found, limit in limits):
        return ""
    return (
        f"{km2:.1f} km2 are built up ({road_km:.1f} km of roads, {rail_km:.1f} km of railways, {houses} buildings, "
        f"{land_km2:.1f} km2 to live or work on), and nothing is of {', '.join(missing)}: if the extract was filtered, "
        "name what it holds by `classes` in the region file"
    )


def _km(lines: Sequence[shapely.Geometry], coverage: shapely.Geometry) -> float:
    return float(shapely.length(shapely.intersection(lines, coverage)).sum()) / 1e3 if len(lines) else 0.0
