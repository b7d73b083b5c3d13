# SPDX-License-Identifier: Apache-2.0
"""Burning: the cells GDAL would burn, lines as wide as they are, and nothing absent beyond what is mapped."""

import geopandas as gpd
import numpy as np
import pytest
import rasterio.features
import shapely
from affine import Affine
from hypothesis import given
from hypothesis import strategies as st

from sasgeo_bench.geometry.grid import Grid
from sasgeo_bench.regions.layers import OUTSIDE, burn, burn_layers, cog_faults, make_paint, write_layers
from tests.drawn_features import features_of

GRID = Grid(epsg=32632, west_m=0.0, north_m=40.0, cell_size_m=1.0, rows=40, cols=50)
EVERYWHERE = shapely.box(-1e6, -1e6, 1e6, 1e6)


def table(*rows: tuple[str, shapely.Geometry, float], **columns) -> gpd.GeoDataFrame:
    """Features by class, shape and width; columns hold a value for each."""
    more = [dict(zip(columns, values, strict=True)) for values in zip(*columns.values(), strict=True)] or [{}] * len(
        rows
    )
    named = ({"class": name, "geometry": shape, "width_m": width} for name, shape, width in rows)
    return features_of(*(row | own for row, own in zip(named, more, strict=True)))


@st.composite
def stars(draw):
    """A polygon around a point, some with a hole, vertices off the cell centres."""
    count = draw(st.integers(3, 12))
    centre = np.array([draw(st.floats(-10, 60)), draw(st.floats(-10, 50))])
    angles = np.linspace(0, 2 * np.pi, count, endpoint=False)
    reach = np.array([draw(st.floats(1.5, 25)) for _ in range(count)])
    ring = centre + reach[:, None] * np.column_stack((np.cos(angles), np.sin(angles)))
    hole = [centre + 0.4 * (ring - centre)] if draw(st.booleans()) else []
    shape = shapely.Polygon(ring + 0.0137, [inner + 0.0137 for inner in hole])
    return shapely.orient_polygons(shape)


@given(st.lists(stars(), min_size=1, max_size=6))
def test_burning_marks_exactly_the_cells_that_gdal_marks(shapes):
    ours = burn(np.array(shapes, dtype=object), GRID)
    theirs = rasterio.features.rasterize(shapes, out_shape=GRID.shape, transform=Affine(*GRID.transform)) == 1
    assert (ours == theirs).all()


@pytest.mark.parametrize("cell_size_m", [2.0, 1.0, 0.5, 0.25])
def test_a_road_is_as_wide_as_tagged_at_every_cell_size(cell_size_m):
    road = table(("road_major", shapely.LineString([(100.3, 100.1), (900.2, 500.4)]), 7.5))
    cells = round(1000 / cell_size_m)
    grid = Grid(epsg=32632, west_m=0.0, north_m=1000.0, cell_size_m=cell_size_m, rows=cells, cols=cells)
    burnt_m2 = (burn_layers(make_paint(road, ("road_major",), EVERYWHERE), grid) == 1).sum() * cell_size_m**2
    length_m = road.geometry.length.iloc[0]
    assert abs(burnt_m2 / length_m - 7.5) < 0.05 * 7.5


def test_several_classes_may_hold_in_one_cell_and_beyond_the_mapped_area_all_are_unknown():
    both = table(("water", shapely.box(0, 0, 50, 40), np.nan), ("bridge", shapely.LineString([(0, 20), (50, 20)]), 6.0))
    water, bridge = burn_layers(make_paint(both, ("water", "bridge"), EVERYWHERE), GRID)
    assert ((water == 1) & (bridge == 1)).sum() == 6 * 50
    road = table(("road_major", shapely.LineString([(0, 20), (50, 20)]), 6.0))
    layers = burn_layers(make_paint(road, ("road_major", "water"), shapely.box(0, 0, 25, 40)), GRID)
    assert (layers[:, :, 25:] == OUTSIDE).all()
    assert not (layers[:, :, :25] == OUTSIDE).any()
    assert (layers[0, :, :25] == 1).sum() == 6 * 25
    classes = ("water", "waterway")
    water, river = burn_layers(make_paint(table(RIVER, LAKE), classes, shapely.box(0, 0, 30, 40)), GRID)
    assert (river[:, 30:] == OUTSIDE).all()
    assert (river[:, 20:30] == 0).all()
    assert (water[:, 20:30] == 1).all()


RIVER = ("waterway", shapely.LineString([(0, 20), (50, 20)]), 6.0)
LAKE = ("water", shapely.box(20, 0, 40, 40), np.nan)
POND = ("water", shapely.box(0, 0, 8, 8), np.nan)
ROAD = ("road_minor", shapely.LineString([(30, 0), (30, 40)]), 4.0)
BEYOND_THE_LAKE = [*range(20), *range(40, 50)]


def river_cols(*rows, classes=("water", "waterway"), **columns):
    """Columns of the map in which the river is a cell."""
    layers = burn_layers(make_paint(table(*rows, **columns), classes, EVERYWHERE), GRID)
    return np.flatnonzero((layers[classes.index("waterway")] == 1).any(axis=0)).tolist()


@pytest.mark.parametrize(
    ("columns", "cols"),
    [
        ({}, BEYOND_THE_LAKE),
        ({"is_visible": [True, False], "is_tunnel": [False, True]}, [*range(50)]),  # water in a pipe covers nothing
        ({"is_bridge": [True, False], "level": [1, 0]}, [*range(50)]),  # an aqueduct over the lake
        ({"is_bridge": [False, True], "level": [0, 1]}, BEYOND_THE_LAKE),  # a basin on a bridge is water all the same
        ({"is_visible": [False, True]}, []),
        ({"osm_type": ["way", "coastline"]}, BEYOND_THE_LAKE),  # the sea is water
    ],
)
def test_the_middle_of_a_river_is_no_line_in_its_own_water(columns, cols):
    assert river_cols(RIVER, LAKE, **columns) == cols
    assert river_cols(LAKE, RIVER, **{name: values[::-1] for name, values in columns.items()}) == cols
    assert river_cols(RIVER, LAKE, classes=("waterway",)) == river_cols(RIVER, POND) == [*range(50)]


def test_nothing_but_a_river_is_covered_and_what_covers_it_stays():
    names = ("road_minor", "water", "waterway", "bridge", "coastline")
    rows = (RIVER, LAKE, POND, ROAD, ("bridge", *ROAD[1:]), ("coastline", *ROAD[1:]))
    layers = burn_layers(make_paint(table(*rows), names, EVERYWHERE), GRID)
    alone = [burn_layers(make_paint(table(*rows), (name,), EVERYWHERE), GRID)[0] for name in names]
    np.testing.assert_array_equal(np.delete(layers, 2, axis=0), np.delete(alone, 2, axis=0))
    np.testing.assert_array_equal(layers[2], np.where(alone[1] == 1, 0, alone[2]))


@given(shapes=st.lists(stars(), min_size=1, max_size=3), row=st.integers(0, 30), col=st.integers(0, 40))
def test_a_window_of_a_covered_river_is_that_of_the_whole(shapes, row, col):
    rows = [("water", shape, np.nan) for shape in shapes]
    paint = make_paint(table(RIVER, *rows), ("waterway", "water"), EVERYWHERE)
    river, water = burn_layers(paint, GRID)
    part = burn_layers(paint, GRID.window(row, col, 10, 10))
    assert (part == np.stack((river, water))[:, row : row + 10, col : col + 10]).all()
    assert not (river & water).any()


def test_overviews_do_not_break_thin_lines():
    path = table(("path_track", shapely.LineString([(0, 3.3), (50, 37.1)]), 0.3))
    coarse = GRID.coarsen(4)
    thin = burn_layers(make_paint(path, ("path_track",), EVERYWHERE), coarse)[0]
    wide = burn_layers(make_paint(path, ("path_track",), EVERYWHERE, least_width_m=4.0), coarse)[0]
    assert (wide == 1).any(axis=0).all()
    assert not (thin == 1).any(axis=0).all()


def test_a_level_that_is_one_block_wide_is_tiled_all_the_same(tmp_path):
    tall = Grid(epsg=32632, west_m=0.0, north_m=4352.0, cell_size_m=1.0, rows=4352, cols=2048)  # overview: 512 wide

    def paint(_):
        return lambda window: np.zeros((1, *window.shape), np.uint8)

    write_layers(tmp_path / "tall.tif", tall, ("building",), paint)
    assert cog_faults(tmp_path / "tall.tif") == []


def test_strips_are_a_fault_of_a_cloud_optimized_file(tmp_path):
    with rasterio.open(
        tmp_path / "a.tif", "w", driver="GTiff", height=1024, width=600, count=1, dtype="uint8", tiled=False
    ) as target:
        target.write(np.zeros((1, 1024, 600), np.uint8))
    assert "is not tiled" in cog_faults(tmp_path / "a.tif")[0]
