# SPDX-License-Identifier: Apache-2.0
"""A degraded map lacks a fifth of its buildings, and the rest is off by as much as is said."""

import geopandas as gpd
import numpy as np
import shapely

from sasgeo_bench.geometry.grid import Grid
from sasgeo_bench.tasks.degraded_map import WARP_M, degrade, warp_field

GRID = Grid(epsg=32632, west_m=500_000.0, north_m=5_001_000.0, cell_size_m=1.0, rows=1000, cols=800)


def houses(count: int = 25) -> gpd.GeoDataFrame:
    x, y = np.meshgrid(np.linspace(500_050, 500_750, count), np.linspace(5_000_050, 5_000_950, count))
    shapes = shapely.box(x.ravel(), y.ravel(), x.ravel() + 10, y.ravel() + 10)
    classes = np.where(np.arange(len(shapes)) % 5 == 0, "road_minor", "building")
    return gpd.GeoDataFrame({"class": classes}, geometry=shapes, crs=GRID.epsg)


def test_a_fifth_of_the_buildings_and_nothing_else_is_dropped():
    before, after = houses(), degrade(houses(), GRID, np.random.default_rng(0))
    assert (after["class"] == "building").sum() == round(0.8 * (before["class"] == "building").sum())
    assert (after["class"] == "road_minor").sum() == (before["class"] == "road_minor").sum()


def test_things_are_off_by_what_is_said_and_neighbours_alike():
    before = houses()
    off = []
    for seed in range(20):
        after = degrade(before, GRID, np.random.default_rng(seed))
        moved = shapely.get_coordinates(shapely.centroid(after.geometry.to_numpy()))
        off.append(moved - shapely.get_coordinates(shapely.centroid(before.loc[after.index].geometry.to_numpy())))
    assert abs(np.sqrt(np.mean(np.concatenate(off) ** 2) * 2) - WARP_M) < 0.15
    field_m = warp_field(GRID, np.random.default_rng(1))
    assert field_m.shape == (2, 250, 200)
    assert np.abs(np.diff(field_m, axis=2)).max() < 1.0  # a metre in four: no house is torn


def test_the_same_seed_degrades_alike():
    one, two = (degrade(houses(), GRID, np.random.default_rng(4)) for _ in range(2))
    assert one.geometry.equals(two.geometry)
