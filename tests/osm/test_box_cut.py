# SPDX-License-Identifier: Apache-2.0
"""A box in the header is believed where ways cross its sides and none ends inside, however empty it is."""

import pytest

from sasgeo_bench.geometry.grid import Grid, utm_epsg
from sasgeo_bench.osm.history import _frame, _grid_around
from sasgeo_bench.osm.mapped import lonlat_box
from sasgeo_bench.osm.read import read_extract
from tests.osm.drawing import bounds, osm
from tests.slow import rest_slow

GRID = Grid(epsg=32632, west_m=498_500.0, north_m=5_207_200.0, cell_size_m=10.0, rows=360, cols=300)
BOX_M = (-2000, -2000, 2000, 2000)  # west, south, east, north, metres from 9 E, 47 N


def written(path, *ways, box=BOX_M):
    """An extract of ways with a box in its header."""
    return osm(path, *ways, head=bounds(*box))


def village(x=0, y=0, reach=400, key="highway", value="residential"):
    """Streets that meet one another."""
    steps = range(-reach, reach + 1, 100)
    rows = [({key: value}, [(x + across, y + up) for across in steps]) for up in steps]
    return rows + [({key: value}, [(x + across, y + up) for up in steps]) for across in steps]


MAJOR = {"highway": "secondary"}
ACROSS = [(MAJOR, [(-2600, 0), (-400, 0), (0, 0), (400, 0), (2500, 0)])]
UP = [(MAJOR, [(0, -2300), (0, -400), (0, 0), (0, 400), (0, 2400)])]
LAKE = [(-2400, 450), (2400, 450), (2400, 2300), (-2400, 2300), (-2400, 450)]


def source_of(path):
    return read_extract(path, GRID).coverage_source


def test_a_village_whose_roads_leave_on_all_sides_fills_its_box_and_one_of_which_a_side_is_crossed_by_none_may_not(
    tmp_path,
):
    reading = read_extract(written(tmp_path / "a.osm", *village(), *ACROSS, *UP), GRID)
    assert reading.coverage_source == "header box"
    assert reading.coverage.area == pytest.approx(GRID.rows * GRID.cols * 100, rel=0.02)
    assert source_of(written(tmp_path / "a.osm", *village(), *ACROSS)) == "estimated"


def test_where_roads_end_inside_the_extract_was_cut_along_a_border_but_not_where_one_does_by_mistake(tmp_path):
    ended = [(MAJOR, [(-1500, 0), (-400, 0), (0, 0), (400, 0), (1500, 0)]),
             (MAJOR, [(0, -1500), (0, -400), (0, 0), (0, 400), (0, 1500)])]  # fmt: skip
    crossing = [({"landuse": "forest"}, [(x, y), (x + 50, y), (x + 50, y + 50), (x, y + 50), (x, y)])
                for x, y in ((-2025, 0), (1975, 0), (0, -2025), (0, 1975))]  # fmt: skip
    assert source_of(written(tmp_path / "a.osm", *village(), *ended, *crossing)) == "estimated"
    ended = (MAJOR, [(400, 400), (1200, 1300)])
    more = [(MAJOR, [(-400, 200), (-2300, 900)]), (MAJOR, [(400, -300), (2400, -1200)])]
    assert source_of(written(tmp_path / "a.osm", *village(), *ACROSS, *UP, *more, ended)) == "header box"


def test_a_stream_may_begin_anywhere_and_must_not_end(tmp_path):
    sources = [({"waterway": "stream"}, [(x, 1500), (x, 400)]) for x in (-300, 0, 300)]
    flows = written(tmp_path / "a.osm", *village(), *ACROSS, *UP, *sources)
    assert source_of(flows) == "header box"
    sinks = [(tags, line[::-1]) for tags, line in sources]
    assert source_of(written(tmp_path / "b.osm", *village(), *ACROSS, *UP, *sinks)) == "estimated"


def test_ground_inside_a_lake_is_mapped(tmp_path):
    shore = village(0, -800, 1200)
    lake = ({"natural": "water"}, [(x, y) for x, y in LAKE])
    inner = ({"natural": "water"}, [(-1500, 450), (1500, 450), (1500, 1900), (-1500, 1900), (-1500, 450)])
    box = (-1550, -2000, 1550, 1950)  # nothing crosses it in the north
    assert source_of(written(tmp_path / "a.osm", *shore, lake, box=(-1300, -2000, 1300, 2000))) == "header box"
    assert source_of(written(tmp_path / "b.osm", *shore, inner, box=box)) == "header box"
    assert source_of(written(tmp_path / "c.osm", *shore, box=box)) == "estimated"


def test_sea_is_mapped_and_an_island_alone_does_not_fill_a_wide_box(tmp_path):
    coast = ({"natural": "coastline"}, [(-2600, 450), (2600, 450)][::-1])  # water on its right: in the north
    reading = read_extract(
        written(tmp_path / "a.osm", *village(0, -800, 1200), coast, box=(-1300, -2000, 1300, 2000)), GRID
    )
    assert reading.coverage_source == "header box"
    assert "water" in set(reading.features["class"])
    ring = [(-600, -600), (600, -600), (600, 600), (-600, 600), (-600, -600)]
    isle = ({"natural": "coastline"}, ring)
    wide = (-9000, -9000, 9000, 9000)
    assert source_of(written(tmp_path / "b.osm", *village(), isle, box=wide)) == "estimated and islands"


REAL = (
    ("header box", "rapperswil-2015-11-10"),
    ("estimated", "monaco-2022-07-19"),
    ("header box", "toftir-2018-06-19"),
    ("header box", "lajesflores-2015-10-04"),
    ("header box", "touba-2017-10-17"),
    ("estimated", "liechtenstein-2013-08-03"),
    ("estimated", "melilla-2024-05-24"),
    ("estimated", "otaniemi-2022-03-19"),
)


@pytest.mark.real
@pytest.mark.parametrize(("source", "name"), rest_slow(REAL, but=2))
def test_real_boxes_are_told_from_real_borders(source, name, real_extracts):
    path = real_extracts / f"{name}.osm.pbf"
    west, south, east, north = _frame(path)
    grid = _grid_around((west, south, east, north), utm_epsg((west + east) / 2, (south + north) / 2))
    assert read_extract(path, grid).coverage_source.split(" ")[0] == source.split(" ")[0]


# Extracts that were filtered


def warnings_of(path, classes=None):
    return read_extract(path, GRID, classes=classes).warnings


INNER = (-1200, -1200, 1200, 1200)


def test_a_town_of_streets_alone_names_what_it_lacks(tmp_path):
    streets = written(tmp_path / "a.osm", *village(reach=1200), box=INNER)
    (warning,) = warnings_of(streets)
    assert "nothing is of building, water, green, farmland, parking" in warning
    assert warnings_of(streets, ["road_minor", "railway"]) == ()
    assert "nothing is of building:" in warnings_of(streets, ["road_minor", "building"])[0]


def house(x, y, side=12):
    return [(x, y), (x + side, y), (x + side, y + side), (x, y + side), (x, y)]


def test_a_town_of_houses_or_railways_alone_lacks_its_streets_and_a_whole_town_nothing(tmp_path):
    houses = [({"building": "yes"}, house(x, y)) for x in range(-1190, 1200, 60) for y in range(-1190, 1200, 60)]
    (warning,) = warnings_of(written(tmp_path / "a.osm", *houses, box=INNER))
    assert "road_major, road_minor, path_track, water" in warning
    park = ({"leisure": "park"}, house(0, 0, 200))
    assert warnings_of(written(tmp_path / "b.osm", *houses, *village(reach=1200), park, box=INNER)) == ()
    rails = [({"railway": "rail"}, [(x, y) for x in range(-1300, 1301, 100)]) for y in range(-1100, 1200, 200)]
    (warning,) = warnings_of(written(tmp_path / "c.osm", *rails, box=INNER))
    assert "km of railways" in warning
    assert "nothing is of road_major, road_minor, path_track, building, water" in warning


@pytest.mark.parametrize("landuse", ["residential", "commercial", "industrial", "retail"])
def test_a_town_of_land_use_alone_lacks_its_streets_and_houses(landuse, tmp_path):
    blocks = [
        ({"landuse": landuse}, house(x, y, 270)) for x in range(-1190, 1000, 300) for y in range(-1190, 1000, 300)
    ]
    park = ({"leisure": "park"}, house(0, 0, 200))
    (warning,) = warnings_of(written(tmp_path / "a.osm", *blocks, park, box=INNER))
    assert "nothing is of road_major, road_minor, path_track, building:" in warning


def test_fields_woods_and_one_farm_without_a_road_lack_nothing(tmp_path):
    fields = [
        ({"landuse": "farmland"}, house(x, y, 270)) for x in range(-1190, 1000, 300) for y in range(-1190, 1000, 300)
    ]
    farm = ({"landuse": "residential"}, house(0, 0, 300))
    rail = ({"railway": "rail"}, [(x, 50) for x in range(-1300, 1301, 100)])
    assert warnings_of(written(tmp_path / "a.osm", *fields, farm, rail, box=INNER)) == ()


def test_a_grid_with_a_corner_beyond_the_antimeridian_ends_there():
    grid = Grid(epsg=32760, west_m=819_000.0, north_m=8_138_000.0, cell_size_m=10.0, rows=100, cols=90)
    west, _, east, _ = lonlat_box(grid)
    assert west < east == 180.0
    mirrored = Grid(epsg=32701, west_m=180_100.0, north_m=8_138_000.0, cell_size_m=10.0, rows=100, cols=90)
    west, _, east, _ = lonlat_box(mirrored)
    assert -180.0 == west < east
