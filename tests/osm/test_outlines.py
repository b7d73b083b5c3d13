# SPDX-License-Identifier: Apache-2.0
"""Lines that close: walls, hedges, railways and waterways around something are outlines of it, not areas."""

import json
from dataclasses import replace

import numpy as np
import pytest
import shapely

from sasgeo_bench.geometry.grid import Grid
from sasgeo_bench.osm.read import read_extract, read_geojson
from sasgeo_bench.osm.taxonomy import load_taxonomy
from tests.osm.drawing import osm, place

GRID = Grid(epsg=32632, west_m=499_900.0, north_m=5_205_400.0, cell_size_m=1.0, rows=400, cols=400)
SIDE_M, HOLE_M = 100.0, 20.0
BOX = "<bounds minlat='46.99' minlon='8.99' maxlat='47.01' maxlon='9.01'/>"

LINE_VALUES = [
    (rule.key, value, rule.widths[value], item.name, rule.key == "highway")
    for item in load_taxonomy().classes
    for rule in item.rules
    if rule.geometry == "line" and rule.key != "bridge"
    for value in (next(iter(rule.widths)), "city_wall", "retaining_wall")
    if value in rule.widths
]


def ring(low, high, top=None):
    top = high if top is None else top
    return [(low, low), (high, low), (high, top), (low, top), (low, low)]


def square(tmp_path, tags, *, as_relation):
    """A square of 100 m with a yard of 20 m, as a closed way (the outer ring alone) or as a multipolygon."""
    ways = [({} if as_relation else tags, ring(50, 150)), ({}, ring(90, 110))]
    relation = (((1, "outer"), (2, "inner")), {"type": "multipolygon"} | tags)
    return osm(tmp_path / "square.osm", *ways, relations=[relation] * as_relation, head=BOX)


def drawn_m2(tmp_path, tags, name, *, as_relation):
    reading = read_extract(square(tmp_path, tags, as_relation=as_relation), GRID, stated_coverage=None)
    return float(reading.features.geometry.area[reading.features["class"] == name].sum()), reading


@pytest.mark.parametrize(("key", "value", "width_m", "name", "is_filled"), LINE_VALUES)
@pytest.mark.parametrize("as_relation", [False, True], ids=["closed way", "multipolygon"])
def test_a_line_that_closes_is_filled_where_it_says_so_and_squares_are(
    key, value, width_m, name, is_filled, as_relation, tmp_path
):
    solid_m2 = SIDE_M**2 - as_relation * HOLE_M**2
    area_m2, reading = drawn_m2(tmp_path, {key: value}, name, as_relation=as_relation)
    assert area_m2 == pytest.approx(solid_m2 if is_filled and as_relation else 0.0, rel=0.01)
    if not area_m2:
        ring_m = 4 * SIDE_M + as_relation * 4 * HOLE_M
        (line,) = reading.features[reading.features["class"] == name].itertuples()
        assert line.geometry.length == pytest.approx(ring_m, rel=0.01)
        assert line.width_m == pytest.approx(width_m)
    filled_m2, _ = drawn_m2(tmp_path, {key: value, "area": "yes"}, name, as_relation=as_relation)
    assert filled_m2 == pytest.approx(0.0 if key in ("barrier", "natural") else solid_m2, rel=0.01)


def strip_of(tmp_path, tags, width_m, length_m=60.0):
    """The one feature of a closed way that is so wide and long."""
    grid = replace(GRID, west_m=499_800.0)
    features = read_extract(osm(tmp_path / "strip.osm", (tags, ring(0, length_m, width_m)), head=BOX), grid).features
    (found,) = features[features["class"] == "field_boundary"].itertuples()
    return found


@pytest.mark.parametrize(
    ("tags", "width_m", "is_filled"),
    [
        ({"barrier": "hedge"}, 8.5, True),
        ({"barrier": "hedge"}, 10.0, False),
        ({"barrier": "wall"}, 2.5, True),
        ({"barrier": "wall"}, 4.0, False),
        ({"barrier": "fence"}, 12.0, False),
        ({"barrier": "city_wall"}, 10.0, True),
        ({"barrier": "city_wall"}, 14.0, False),
        ({"natural": "tree_row"}, 12.0, True),
        # What a barrier goes around, however narrow.
        ({"barrier": "hedge", "name": "Green lane"}, 2.0, False),
        ({"barrier": "wall", "amenity": "school"}, 2.0, False),
        ({"barrier": "fence", "landuse": "residential"}, 2.0, False),
    ],
)
def test_a_hedge_drawn_as_an_area_is_filled_and_a_yard_is_an_outline(tags, width_m, is_filled, tmp_path):
    found = strip_of(tmp_path, tags | {"area": "yes"}, width_m)
    if is_filled:
        assert found.geometry.area == pytest.approx(60 * width_m, rel=0.01)
        assert np.isnan(found.width_m)
    else:
        assert found.geometry.length == pytest.approx(2 * (60 + width_m), rel=0.01)
        assert found.geometry.area == 0


@pytest.mark.parametrize(("side_m", "is_filled"), [(40.0, False), (4.0, True)])
def test_yards_of_geojson_are_outlines_too(side_m, is_filled, tmp_path):
    corners = [place(*corner) for corner in ring(0, side_m)]
    tags, shape = {"barrier": "hedge", "area": "yes"}, {"type": "Polygon", "coordinates": [corners]}
    yard = {"type": "FeatureCollection", "features": [{"type": "Feature", "properties": tags, "geometry": shape}]}
    (tmp_path / "yard.geojson").write_text(json.dumps(yard))
    whole, grid = shapely.box(8.9, 46.9, 9.1, 47.1), replace(GRID, west_m=499_800.0)
    reading = read_geojson([tmp_path / "yard.geojson"], grid, tags={}, stated_coverage=whole)
    (found,) = reading.features.itertuples()
    assert found.geometry.area == pytest.approx(side_m**2 if is_filled else 0.0, rel=0.01)


@pytest.mark.parametrize("as_relation", [False, True], ids=["closed way", "multipolygon"])
@pytest.mark.parametrize(
    ("tags", "width_m"),
    [
        ({"barrier": "city_wall", "width": "6"}, 6.0),
        ({"barrier": "retaining_wall", "width": "1.5 m"}, 1.5),
        ({"barrier": "hedge", "width": "6"}, 1.5),
        ({"barrier": "fence", "width": "6"}, 0.5),
        ({"natural": "tree_row", "width": "9"}, 4.0),
    ],
)
def test_walls_of_a_town_and_of_terraces_keep_a_stated_width(tags, width_m, as_relation, tmp_path):
    reading = read_extract(square(tmp_path, tags, as_relation=as_relation), GRID)
    assert reading.features["width_m"].tolist() == [pytest.approx(width_m)]
