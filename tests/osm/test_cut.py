# SPDX-License-Identifier: Apache-2.0
"""A place is cut out of an extract with whole ways and whole areas: what is read of it is what was read before."""

import datetime as dt

import numpy as np
import osmium
import pytest
import shapely

from sasgeo_bench.geometry.grid import Grid, utm_epsg
from sasgeo_bench.geometry.projection import from_lonlat
from sasgeo_bench.osm.cut import cut_extract
from sasgeo_bench.osm.mapped import lonlat_box
from sasgeo_bench.osm.read import read_extract
from sasgeo_bench.osm.snapshot import read_header
from tests.osm.drawing import bounds, osm, place

HOUSE, ROAD, WOOD = {"building": "yes"}, {"highway": "residential"}, {"natural": "wood", "type": "multipolygon"}


def square(west, south, side):
    east, north = west + side, south + side
    return [(west, south), (east, south), (east, north), (west, north), (west, south)]


def box(west, south, east, north):
    return (*place(west, south), *place(east, north))


def ids(path):
    found = [(item.type_str(), item.id) for item in osmium.FileProcessor(str(path))]
    assert found == sorted(found, key=lambda one: ("nwr".index(one[0]), one[1]))
    return [[number for kind, number in found if kind == wanted] for wanted in "nwr"]


@pytest.fixture
def village(tmp_path):
    return osm(
        tmp_path / "village.osm",
        (HOUSE, square(10, 10, 20)),  # 1: inside
        (HOUSE, square(500, 500, 20)),  # 2: outside
        (ROAD, [(-900, 50), (50, 50), (900, 50)]),  # 3: through, with all its nodes
        (ROAD, [(-900, 700), (900, 700)]),  # 4: past
        ({}, [(-400, -400), (400, -400), (400, 400)]),  # 5, 6: the outline of a wood around, no part of it inside
        ({}, [(400, 400), (-400, 400), (-400, -400)]),
        ({}, [(600, 600), (700, 600), (700, 700), (600, 600)]),  # 7: of a wood outside
        ({}, [(600, 0), (600, 10)]),  # 8: of a route that passes through by way 3
        relations=[
            ([(5, "outer"), (6, "outer")], WOOD),
            ([(7, "outer")], WOOD),
            ([(3, ""), (8, "")], {"type": "route", "route": "bus"}),
        ],
        head=bounds(-1000, -80, 1000, 1000),
    )


def test_a_cut_holds_what_reaches_into_its_box_whole_and_nothing_else(village, tmp_path):
    cut_extract(village, tmp_path / "cut.osm.pbf", box(-100, -100, 100, 100))
    nodes, ways, relations = ids(tmp_path / "cut.osm.pbf")
    assert (ways, relations) == ([1, 3, 5, 6], [1])
    assert len(nodes) == 4 + 3 + 4
    (stated,) = read_header(tmp_path / "cut.osm.pbf").boxes_lonlat
    assert stated == pytest.approx(box(-100, -80, 100, 100), abs=1e-6)  # not beyond the extract's own


def test_a_house_that_reaches_in_is_whole_wherever_its_way_begins(tmp_path):
    """A tool that looks at the first node alone takes it or leaves it (osmium-tool 1.15, `extract -s simple`)."""
    corners = [(90, 90), (110, 90), (110, 110), (90, 110)]  # of which one lies inside
    turned = [[*corners[at:], *corners[:at], corners[at]] for at in range(4)]
    village = osm(tmp_path / "a.osm", *((HOUSE, way) for way in turned), head=bounds(-200, -200, 200, 200))
    cut_extract(village, tmp_path / "cut.osm.pbf", box(-100, -100, 100, 100))
    nodes, ways, _ = ids(tmp_path / "cut.osm.pbf")
    assert (len(nodes), ways) == (4, [1, 2, 3, 4])


def test_what_is_left_of_houses_whose_nodes_were_dropped_is_counted_and_no_house(tmp_path):
    """As `osmconvert --drop-broken-refs` leaves them: ways of one or two nodes, all of which are there."""
    left = ([(40, 0), (60, 0)], [(80, 0)], [(40, 40), (60, 40), (40, 40)])
    houses = [(HOUSE, way) for way in (square(0, 0, 20), *left)]
    path = osm(tmp_path / "a.osm", *houses, head=bounds(-200, -200, 200, 200))
    epsg = utm_epsg(*place(0, 0))
    east_m, north_m = from_lonlat(epsg).transform(*place(0, 0))
    grid = Grid(epsg=epsg, west_m=east_m - 100, north_m=north_m + 150, cell_size_m=1.0, rows=250, cols=250)
    reading = read_extract(path, grid)
    assert reading.features["osm_id"].tolist() == [1]
    assert reading.drops == {
        "way with fewer than two different nodes": 1,
        "closed way with no closed ring left": 1,
        "open way with the area key 'building', anywhere in the extract": 1,
    }


def test_a_history_is_cut_at_a_day_and_the_cut_is_of_one_state(tmp_path):
    old = tmp_path / "old.osh"
    meta = 'version="{}" visible="{}" timestamp="{}-01-01T00:00:00Z" changeset="1" uid="1" user="a"'
    way = '<way id="1" {}><nd ref="1"/><nd ref="2"/><tag k="highway" v="{}"/></way>'
    (lon, lat), (east, north) = place(0, 0), place(50, 50)
    old.write_text(
        '<osm version="0.6">'
        f'<node id="1" {meta.format(1, "true", 2010)} lat="{lat}" lon="{lon}"/>'
        f'<node id="2" {meta.format(1, "true", 2010)} lat="{north}" lon="{east}"/>'
        + way.format(meta.format(1, "true", 2010), "track")
        + way.format(meta.format(2, "true", 2020), "primary")
        + "</osm>",
        encoding="utf-8",
    )
    for year, kind in ((2015, "track"), (2021, "primary")):
        cut_extract(old, tmp_path / "cut.osm.pbf", box(-100, -100, 100, 100), at=dt.date(year, 1, 1))
        found = [item.tags["highway"] for item in osmium.FileProcessor(str(tmp_path / "cut.osm.pbf"), osmium.osm.WAY)]
        assert found == [kind]


@pytest.mark.real
@pytest.mark.parametrize(
    ("name", "lonlat"),
    [
        pytest.param("andorra-2025-01-19", (1.5218, 42.5075), marks=pytest.mark.slow),
        ("helsinki-2019-04-21", (24.95, 60.17)),
    ],
)
def test_what_is_read_of_a_real_cut_is_what_is_read_of_the_whole(name, lonlat, real_extracts, tmp_path):
    epsg = utm_epsg(*lonlat)
    place_m = from_lonlat(epsg).transform(*lonlat)
    grid, around = (
        Grid.around(*place_m, size_m=(side_m, side_m), cell_size_m=1.0, epsg=epsg) for side_m in (1000.0, 2000.0)
    )
    whole = real_extracts / f"{name}.osm.pbf"
    cut_extract(whole, tmp_path / "cut.osm.pbf", lonlat_box(around))
    assert (tmp_path / "cut.osm.pbf").stat().st_size < whole.stat().st_size / 2
    ours, theirs = (read_extract(path, grid).features for path in (tmp_path / "cut.osm.pbf", whole))
    assert len(ours) == len(theirs) > 300
    for column in ("class", "osm_type", "osm_id", "version", "level", "is_visible"):
        assert (ours[column] == theirs[column]).all()
    np.testing.assert_array_equal(ours["width_m"], theirs["width_m"])
    is_sea = (ours["osm_type"] == "coastline").to_numpy()  # its edge is that of the mapped ground
    assert shapely.equals(ours.geometry.to_numpy(), theirs.geometry.to_numpy())[~is_sea].all()
