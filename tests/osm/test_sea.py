# SPDX-License-Identifier: Apache-2.0
"""Sea and land: the right side of a coast is water, wherever the frame is cut and whatever lies around it."""

import datetime as dt
import json
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
import shapely
from hypothesis import given
from hypothesis import strategies as st

from sasgeo_bench.geometry.grid import Grid
from sasgeo_bench.osm.features import SEA
from sasgeo_bench.osm.history import DatedExtract, read_history
from sasgeo_bench.osm.mapped import CONTRARY, OPEN, find_shore, project
from sasgeo_bench.osm.read import read_extract
from sasgeo_bench.osm.taxonomy import load_taxonomy
from sasgeo_bench.regions.build import plan_build
from sasgeo_bench.regions.graph import build_graph
from sasgeo_bench.regions.layers import OUTSIDE, PRESENT, burn, burn_layers, make_paint
from sasgeo_bench.regions.region_spec import find_region_file, read_region_file
from tests.osm.drawing import osm

FRAME = shapely.box(0, 0, 1000, 1000)


def island(x, y, radius, corners=9):
    """A ring with water on its right: counter-clockwise."""
    turns = np.linspace(0, 2 * np.pi, corners, endpoint=False)
    ring = np.column_stack((x + radius * np.cos(turns), y + radius * np.sin(turns)))
    return shapely.LineString([*ring, ring[0]])


def lines(*points):
    return [shapely.LineString(part) for part in points]


def is_in(faces, x, y):
    return bool(shapely.contains_xy(shapely.union_all(faces), x, y))


def area(faces):
    return float(shapely.area(faces).sum())


# Islands in a lattice never touch, whatever their sizes.
islands = st.lists(
    st.tuples(st.integers(0, 3), st.integers(0, 3), st.floats(20, 110), st.integers(3, 12)),
    min_size=1,
    max_size=6,
    unique_by=lambda item: item[:2],
).map(lambda found: [island(125 + 250 * col, 125 + 250 * row, *size) for col, row, *size in found])


@given(islands)
def test_all_but_the_islands_is_sea(coast):
    shore = find_shore(coast, FRAME)
    land = sum(shapely.Polygon(ring).area for ring in coast)
    assert shore.unknown == {}
    assert area(shore.land) == pytest.approx(land)
    assert area(shore.sea) == pytest.approx(1e6 - land)


@given(islands, st.booleans())
def test_a_coast_drawn_the_other_way_round_swaps_sea_and_land(coast, has_mainland):
    coast = coast + lines([(-50, 500), (1050, 500)]) * has_mainland
    there, back = (find_shore(ways, FRAME) for ways in (coast, [shapely.reverse(way) for way in coast]))
    assert area(there.sea) == pytest.approx(area(back.land))
    assert area(there.land) == pytest.approx(area(back.sea))


@given(islands, st.floats(0.05, 0.95), st.floats(0.05, 0.95), st.integers(0, 2**32 - 1))
def test_a_coast_in_any_pieces_and_order_gives_the_same_sea(coast, first, second, seed):
    cut = []
    for ring in coast:
        points = shapely.get_coordinates(ring)
        at = sorted({1 + int(share * (len(points) - 2)) for share in (first, second)})
        bounds = [0, *at, len(points) - 1]
        cut += lines(*(points[low : high + 1] for low, high in pairwise(bounds) if high > low))
    shuffled = [cut[index] for index in np.random.default_rng(seed).permutation(len(cut))]
    assert area(find_shore(shuffled, FRAME).sea) == pytest.approx(area(find_shore(coast, FRAME).sea))
    assert find_shore(shuffled, FRAME).unknown == {}


@given(islands, st.floats(0.2, 0.8))
def test_wherever_the_frame_is_cut_what_both_parts_know_is_the_same(coast, share):
    """A part that sees no coast says nothing; no part says otherwise than the whole."""
    whole = find_shore(coast, FRAME)
    for part in (shapely.box(0, 0, 1000 * share, 1000), shapely.box(1000 * share, 0, 1000, 1000)):
        shore = find_shore(coast, part)
        for here, there in ((shore.sea, whole.sea), (shore.land, whole.land)):
            if len(shore.sea):
                assert area([shapely.union_all(here)]) == pytest.approx(
                    shapely.union_all(there).intersection(part).area, abs=1e-6
                )


def test_an_inlet_is_sea_and_the_spit_in_it_land():
    inlet = lines([(-10, 400), (300, 400), (300, 800), (500, 800), (500, 400), (1010, 400)])
    shore = find_shore([*inlet, island(400, 600, 30)], FRAME)
    assert is_in(shore.sea, 350, 700)
    assert is_in(shore.land, 400, 600)
    assert is_in(shore.land, 150, 700)
    assert not is_in(shore.land, 150, 300)


def test_around_a_small_gap_the_ground_is_unknown_and_the_rest_is_decided():
    shore = find_shore(lines([(-10, 500), (400, 500)], [(420, 500), (1010, 500)]), FRAME)
    assert set(shore.unknown) == {OPEN}
    assert shapely.contains_xy(shore.unknown[OPEN], 410, 510)
    assert not shapely.contains_xy(shore.unknown[OPEN], 410, 540)
    assert is_in(shore.sea, 410, 400)
    assert is_in(shore.land, 410, 600)
    assert not is_in([*shore.sea, *shore.land], 410, 505)


def test_a_coast_that_ends_near_the_edge_goes_on_to_it_and_a_loop_does_not_flood_the_land():
    shore = find_shore(lines([(30, 500), (970, 500)]), FRAME)
    assert area([shore.unknown[OPEN]]) < 2 * np.pi * 60 * 60
    assert is_in(shore.sea, 500, 400)
    assert is_in(shore.land, 500, 600)
    loop = lines([(-10, 500), (500, 500), (502, 501), (501, 502), (500.5, 499), (1010, 500)])
    shore = find_shore(loop, FRAME)
    assert shore.unknown == {}
    assert area(shore.land) == pytest.approx(500_000, rel=0.01)
    assert len(find_shore([], FRAME).sea) == 0
    beyond = find_shore(lines([(2000, 0), (2000, 900)]), FRAME)
    assert (len(beyond.sea), len(beyond.land), beyond.unknown) == (0, 0, {})


def test_coasts_that_contradict_each_other_leave_the_ground_between_them_unknown():
    shore = find_shore(lines([(-10, 300), (1010, 300)], [(-10, 700), (1010, 700)]), FRAME)
    assert set(shore.unknown) == {CONTRARY}
    assert area([shore.unknown[CONTRARY]]) == pytest.approx(400_000)
    assert is_in(shore.sea, 500, 100)
    assert is_in(shore.land, 500, 900)


# In an extract

GRID = Grid(epsg=32632, west_m=499_900.0, north_m=5_205_400.0, cell_size_m=2.0, rows=300, cols=350)


def coast_file(tmp_path, *ways, towns=True, bounds="minlat='46.995' minlon='8.99' maxlat='47.005' maxlon='9.01'"):
    """An OSM file: coastlines, a road, and hamlets in its corners."""
    corners = [(x, y) for x in range(-740, 740, 60) for y in range(-540, 540, 60) if towns]
    hamlets = [({"building": "yes"}, [(x, y), (x + 20, y), (x + 20, y + 20), (x, y)]) for x, y in corners]
    road = ({"highway": "residential"}, [(-700, 300), (700, 310)])
    coast = [({"natural": "coastline"}, way) for way in ways]
    return osm(tmp_path / "coast.osm", *coast, road, *hamlets, head=f"<bounds {bounds}/>")


def water_of(reading, grid=GRID):
    names = load_taxonomy().names
    return burn_layers(make_paint(reading.features, names, reading.coverage), grid)[names.index("water")]


QUAY = [(-900, 0), (-50, 0), (-50, -40), (50, -40), (50, 0), (900, 0)]


def test_the_sea_of_an_extract_is_water_without_a_date_of_its_own(tmp_path):
    reading = read_extract(coast_file(tmp_path, QUAY), GRID)
    sea = reading.features[reading.features["osm_type"] == SEA]
    assert list(sea["class"]) == ["water"]
    assert sea["timestamp"].isna().all()
    is_wet = water_of(reading) == PRESENT
    shore, quay = is_wet[:, -1].argmax(), is_wet[:, 50].argmax()  # first wet row in the east, and at 9 E
    assert shore > 0
    assert quay - shore == 20  # the quay stands 40 m out
    assert is_wet[quay:, 50].all()


def test_a_window_anywhere_has_the_cells_of_the_whole_at_sea_and_inland(tmp_path):
    path = coast_file(tmp_path, QUAY)
    whole = water_of(read_extract(path, GRID))
    for row, col, rows, cols in ((0, 0, 150, 350), (100, 0, 200, 350), (250, 200, 50, 150)):
        window = GRID.window(row, col, rows, cols)
        here = whole[row : row + rows, col : col + cols]
        np.testing.assert_array_equal(water_of(read_extract(path, window), window), here)
    path = coast_file(tmp_path, QUAY)
    offshore = Grid(epsg=32632, west_m=500_200.0, north_m=5_204_900.0, cell_size_m=2.0, rows=100, cols=100)
    assert (water_of(read_extract(path, offshore), offshore) == PRESENT).all()
    inland = Grid(epsg=32632, west_m=500_200.0, north_m=5_205_400.0, cell_size_m=2.0, rows=100, cols=100)
    assert not (water_of(read_extract(path, inland), inland) == PRESENT).any()


def test_the_graph_and_the_history_know_no_sea(tmp_path):
    path = coast_file(tmp_path, QUAY)
    features = read_extract(path, GRID).features
    assert SEA in set(features["osm_type"])
    assert not (build_graph(features).nodes["kind"] == "area").any()
    dated = [DatedExtract(path=path, on=dt.date(year, 1, 1)) for year in (2020, 2021)]
    for state in read_history(dated).states:
        assert SEA not in set(state.features["osm_type"])
        assert "coastline" in set(state.features["class"])


ISLE = [(-300, -300), (300, -300), (300, 300), (-300, 300), (-300, -300)]  # counter-clockwise: water around it


def test_of_whole_islands_the_sea_around_them_is_mapped_too_and_not_where_a_coast_is_broken(tmp_path):
    path = coast_file(tmp_path, ISLE, towns=False, bounds="minlat='46.9' minlon='8.9' maxlat='47.1' maxlon='9.1'")
    reading = read_extract(path, GRID)
    assert reading.coverage_source == "estimated and islands"
    assert reading.coverage.area == pytest.approx(GRID.rows * GRID.cols * 4)
    far = "minlat='46.9' minlon='8.9' maxlat='47.1' maxlon='9.1'"
    reading = read_extract(coast_file(tmp_path, ISLE[:-1], bounds=far), GRID)
    assert reading.coverage_source == "estimated"


def test_unknown_ground_is_no_cell_of_any_class_and_the_region_says_why(tmp_path):
    path = coast_file(tmp_path, QUAY[:2], [(60, 0), (900, 0)])
    reading = read_extract(path, GRID)
    assert reading.unknown_m2[OPEN] > 1000
    unknown = water_of(reading) == OUTSIDE
    assert unknown.mean() * GRID.rows * GRID.cols * 4 == pytest.approx(sum(reading.unknown_m2.values()), rel=0.01)


# Real coasts, against polygons drawn by hand

SHORES = json.loads((Path(__file__).parents[1] / "data" / "shores.geojson").read_text(encoding="utf-8"))


@pytest.mark.real
@pytest.mark.parametrize("name", ["monaco", "helgoland", "oakland", pytest.param("torshavn", marks=pytest.mark.slow)])
def test_real_harbours_are_water_and_real_quays_are_not(name, real_extracts, tmp_path):
    spec = read_region_file(find_region_file(name))
    plan = plan_build(spec, out=tmp_path, extract_folders=[real_extracts])
    extract, grid = spec.pick(None), spec.grid()
    at = extract.date if ".osh" in extract.file else None
    water = water_of(read_extract(plan.source, grid, at=at), grid)
    drawn = [item for item in SHORES["features"] if item["properties"]["region"] == name]
    assert {item["properties"]["is"] for item in drawn} == {"sea", "land"}
    for item in drawn:
        shape = project(shapely.geometry.shape(item["geometry"]), grid.epsg)
        cells = burn(np.array([shapely.orient_polygons(shape)]), grid)
        share = (water[cells] == PRESENT).mean()
        assert share > 0.97 if item["properties"]["is"] == "sea" else share < 0.03, (item["properties"], share)
