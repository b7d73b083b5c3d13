# SPDX-License-Identifier: Apache-2.0
"""Families of classes that every built-up area has: where one is missing, the extract was filtered."""

from collections.abc import Sequence
from typing import Final

import geopandas as gpd
import shapely

FAMILIES: Final = {
    "roads": ("road_major", "road_minor", "path_track"),
    "buildings": ("building",),
    "land cover": ("water", "green", "farmland", "parking"),
}
_ROAD_KM: Final = 5.0  # of roads a square kilometre: villages have more, fields and mountains less
_HOUSES: Final = 50  # buildings a square kilometre
_LEAST_KM2: Final = 0.1  # a smaller place may well be all street


def missing_families(features: gpd.GeoDataFrame, coverage: shapely.Geometry, *, classes: Sequence[str]) -> str:
    """Return a warning that names the classes of which a built-up area has nothing, by family; empty if it has all.

    `features` and `coverage`, the mapped area, share a projected CRS, metres; `classes` are those that the map should
    hold. An extract that was filtered to roads looks like a town without a house.
    """
    km2 = shapely.area(coverage) / 1e6
    if km2 < _LEAST_KM2:
        return ""
    there = {name: features.geometry.array[(features["class"] == name).to_numpy()] for name in classes}
    roads = [shape for name in FAMILIES["roads"] for shape in there.get(name, ())]
    road_km = float(shapely.length(shapely.intersection(roads, coverage)).sum()) / 1e3 if roads else 0.0
    houses = int(shapely.intersects(there.get("building", ()), coverage).sum())
    if road_km < _ROAD_KM * km2 and houses < _HOUSES * km2:
        return ""
    wanted = [[name for name in family if name in there] for family in FAMILIES.values()]
    missing = [name for family in wanted if not any(len(there[name]) for name in family) for name in family]
    if not missing:
        return ""
    return (
        f"{km2:.1f} km2 are built up ({road_km:.1f} km of roads, {houses} buildings), and nothing is of "
        f"{', '.join(missing)}: if the extract was filtered, name what it holds by `classes` in the region file"
    )
