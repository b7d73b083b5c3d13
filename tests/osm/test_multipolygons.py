# SPDX-License-Identifier: Apache-2.0
"""Multipolygons of the old style: tags on the outer ways, a relation that has none of its own."""

import datetime as dt

import pytest

from sasgeo_bench.geometry.grid import Grid
from sasgeo_bench.osm.history import ObjectKey, read_lifecycle
from sasgeo_bench.osm.multipolygons import area_relation, kind_keys
from sasgeo_bench.osm.read import read_extract
from sasgeo_bench.osm.taxonomy import load_taxonomy
from tests.osm.drawing import osm

GRID = Grid(epsg=32632, west_m=499_700.0, north_m=5_205_500.0, cell_size_m=1.0, rows=600, cols=600)
BARE = {"type": "multipolygon"}
HOUSE, WOOD, FOREST = {"building": "yes"}, {"natural": "wood"}, {"landuse": "forest"}
WATER, MEADOW, ROAD = {"natural": "water"}, {"landuse": "meadow"}, {"highway": "track"}
SQUARE = [(0, 0), (100, 0), (100, 100), (0, 100), (0, 0)]
YARD = [(30, 30), (70, 30), (70, 70), (30, 70), (30, 30)]
BAY = [(80, 80), (90, 80), (90, 90), (80, 90), (80, 80)]
BESIDE = [(200, 0), (220, 0), (220, 20), (200, 20), (200, 0)]
SOUTH, NORTH = SQUARE[:3], SQUARE[2:]
WHOLE, HOLED, IN_YARD = 10_000, 8_400, 1_600


def write(path, ways, *relations, **more):
    """Write ways (corners, tags) and relations (members, tags)."""
    head = "<bounds minlat='46.995' minlon='8.995' maxlat='47.005' maxlon='9.005'/>"
    return osm(path, *((tags, corners) for corners, tags in ways), relations=relations, head=head, **more)


def areas(reading):
    """Area features by class: their sizes in hundreds of m2, ascending, outlines and lines aside."""
    table = reading.features[reading.features.geometry.area > 0]
    return {
        name: sorted(round(size, -2) for size in rows.geometry.area) for name, rows in table.groupby("class", sort=True)
    }


CASES = {
    "tags on the outer way": ([(SQUARE, HOUSE), (YARD, {})], BARE, {"building": [HOLED]}),
    "two open outer ways": ([(SOUTH, FOREST), (NORTH, FOREST)], BARE, {"green": [WHOLE]}),
    "tags on both": ([(SQUARE, WATER), (YARD, {})], BARE | WATER, {"water": [HOLED]}),
    "alike by class on both": ([(SQUARE, WOOD), (YARD, {})], BARE | FOREST, {"green": [HOLED]}),
    "a name on the relation": ([(SQUARE, HOUSE), (YARD, {})], BARE | {"name": "Palace"}, {"building": [HOLED]}),
    "a note on the relation": ([(SQUARE, HOUSE), (YARD, {})], BARE | {"FIXME": "what?"}, {"building": [HOLED]}),
    "names that differ": ([(SOUTH, FOREST | {"name": "A"}), (NORTH, FOREST | {"name": "B"})], BARE,
     {"green": [WHOLE]}),
    "tags that differ within a class": ([(SOUTH, FOREST), (NORTH, WOOD)], BARE, {"green": [WHOLE]}),
    "an outer way without tags": ([(SOUTH, FOREST), (NORTH, {"source": "survey"})], BARE, {"green": [WHOLE]}),
    "an outer way that is a track": ([(SOUTH, FOREST), (NORTH, ROAD)], BARE, {}),
    "outer ways of two classes": ([(SOUTH, FOREST), (NORTH, WATER)], BARE, {}),
    "an inner way with the same tags": ([(SQUARE, HOUSE), (YARD, HOUSE)], BARE, {"building": [HOLED]}),
    "the same but for the source": ([(SQUARE, HOUSE | {"source": "a"}), (YARD, HOUSE | {"source": "b",
     "note:de": "?"})], BARE, {"building": [HOLED]}),
    "an inner way with other tags": ([(SQUARE, FOREST), (YARD, WOOD)], BARE, {"green": [IN_YARD, HOLED]}),
    "an inner way of another class": ([(SQUARE, FOREST), (YARD, WATER)], BARE, {"green": [HOLED], "water": [IN_YARD]}),
    "in the new style an inner way is its own": ([(SQUARE, {}), (YARD, FOREST)], BARE | FOREST, {"green": [IN_YARD,
     HOLED]}),
    "an outer way of another class": ([(SQUARE, FOREST), (YARD, {})], BARE | WATER, {"green": [WHOLE],
     "water": [HOLED]}),
    "a part of a building": ([(SQUARE, HOUSE), (YARD, {})], BARE | {"building:part": "yes"}, {"building": [WHOLE]}),
    "a site with a class of its own": ([(SQUARE, HOUSE), (YARD, {})], BARE | {"amenity": "school"},
     {"building": [WHOLE]}),
    "a boundary without a word": ([(SQUARE, WOOD), (YARD, {})], {"type": "boundary"}, {"green": [HOLED]}),
    "a boundary of its own": ([(SQUARE, WOOD), (YARD, {})], {"type": "boundary", "boundary": "administrative"},
     {"green": [WHOLE]}),
    "a square to walk on": ([(SQUARE, {"highway": "pedestrian", "area": "yes"}), (YARD, {})], BARE,
     {"road_minor": [HOLED]}),
    "an outer way that says it is none": ([(SQUARE, HOUSE | {"area": "no"}), (YARD, {})], BARE, {}),
}  # fmt: skip


@pytest.mark.parametrize(("ways", "tags", "expected"), CASES.values(), ids=CASES)
def test_an_area_of_the_old_style_has_the_tags_of_its_outer_ways(ways, tags, expected, tmp_path):
    ways = [*ways, (BESIDE, {"amenity": "parking"})]
    roles = ("outer", "inner" if len(ways[0][0]) == len(SQUARE) else "outer")
    reading = read_extract(write(tmp_path / "a.osm", ways, (tuple(zip((1, 2), roles, strict=True)), tags)), GRID)
    assert areas(reading) == expected | {"parking": [400]}


def test_new_objects_with_negative_ids_are_assembled_have_the_id_of_their_relation_and_are_counted(tmp_path):
    file = write(tmp_path / "a.osm", [(SQUARE, HOUSE), (YARD, {})], (((-9, "outer"), (-8, "inner")), BARE), first=-9)
    reading = read_extract(file, GRID)
    assert areas(reading) == {"building": [HOLED]}
    assert reading.features[["osm_type", "osm_id"]].to_numpy().tolist() == [["relation", 1]]
    assert list(reading.notes.values()) == [1]
    assert not reading.drops


def test_open_outer_ways_are_dropped_only_if_nothing_is_made_of_them(tmp_path):
    members = ((1, "outer"), (2, "outer"))
    given = read_extract(write(tmp_path / "a.osm", [(SOUTH, FOREST), (NORTH, FOREST)], (members, BARE)), GRID).drops
    assert not given
    ways = [(SOUTH, FOREST), (NORTH, ROAD), (BESIDE, HOUSE)]
    given = read_extract(write(tmp_path / "b.osm", ways, (members, BARE)), GRID).drops
    assert given == {"open way with the area key 'landuse', anywhere in the extract": 1}


def test_roles_that_are_missing_are_told_by_the_place(tmp_path):
    members = ((1, ""), (2, ""))
    for tags in ({}, WATER):
        reading = read_extract(write(tmp_path / "a.osm", [(SQUARE, HOUSE), (YARD, tags)], (members, BARE)), GRID)
        assert areas(reading) == {"building": [HOLED]} | ({"water": [IN_YARD]} if tags else {})
    clearing = [(SQUARE, {}), (YARD, MEADOW)]
    reading = read_extract(write(tmp_path / "b.osm", clearing, (((1, "outer"), (2, "")), BARE | FOREST)), GRID)
    assert areas(reading) == {"green": [IN_YARD, HOLED]}


def test_a_group_of_houses_stays_a_group_of_houses(tmp_path):
    ways, members = [(SQUARE, HOUSE), (BESIDE, HOUSE)], ((1, "outer"), (2, "outer"))
    reading = read_extract(write(tmp_path / "a.osm", ways, (members, BARE | {"name": "Yard"})), GRID)
    assert reading.features["osm_type"].tolist() == ["way", "way"]
    holed = [*ways, (YARD, {})]
    reading = read_extract(write(tmp_path / "b.osm", holed, ((*members, (3, "inner")), BARE)), GRID)
    assert areas(reading) == {"building": [HOLED + 400]}
    unknown = [(SQUARE, HOUSE), (BESIDE, {})]
    reading = read_extract(write(tmp_path / "c.osm", unknown, (((1, ""), (2, "")), BARE)), GRID)
    assert areas(reading) == {"building": [WHOLE]}


def test_two_relations_with_one_outer_way_are_one_house_with_two_yards_and_with_an_open_one_two_woods(tmp_path):
    ways = [(SQUARE, HOUSE), (YARD, {}), (BAY, {})]
    relations = [(((1, "outer"), (hole, "inner")), BARE) for hole in (2, 3)]
    assert areas(read_extract(write(tmp_path / "a.osm", ways, *relations), GRID)) == {"building": [HOLED - 100]}
    east = [(100, 0), (200, 0), (200, 100), (100, 100)]
    west = [(100, 100), (0, 100), (0, 0), (100, 0)]
    ways = [(east, FOREST), (west, FOREST), ([(100, 0), (100, 100)], FOREST)]
    relations = [(((own, "outer"), (3, "outer")), BARE) for own in (1, 2)]
    assert areas(read_extract(write(tmp_path / "a.osm", ways, *relations), GRID)) == {"green": [WHOLE, WHOLE]}


def test_the_fence_of_an_outer_way_stays_a_line_around_it_alone(tmp_path):
    ways = [(SQUARE, MEADOW | {"barrier": "fence"}), (YARD, {})]
    reading = read_extract(write(tmp_path / "a.osm", ways, (((1, "outer"), (2, "inner")), BARE)), GRID)
    assert areas(reading) == {"green": [HOLED]}
    fence = reading.features[reading.features["class"] == "field_boundary"]
    assert fence.geometry.length.tolist() == [pytest.approx(400, rel=0.01)]


def test_a_wall_on_a_relation_and_its_outer_ways_is_drawn_once(tmp_path):
    wall, members = {"barrier": "city_wall"}, ((1, "outer"), (2, "outer"), (3, "inner"))
    ways = [(SOUTH, wall), (NORTH, {"barrier": "hedge"}), (YARD, {})]
    reading = read_extract(write(tmp_path / "a.osm", ways, (members, BARE | wall)), GRID)
    assert sorted(reading.features.geometry.length) == pytest.approx([200, 560], rel=0.01)
    cut = (*members, (77, "outer"))
    ways = [*ways[:1], (BESIDE[:3], {}), *ways[2:]]
    reading = read_extract(write(tmp_path / "b.osm", ways, (cut, BARE | wall)), GRID)
    assert reading.features.geometry.length.tolist() == pytest.approx([200], rel=0.01)


def test_what_lies_under_ground_on_the_outer_way_is_not_seen_and_its_start_date_is_that_of_the_area(tmp_path):
    ways = [(SQUARE, HOUSE | {"location": "underground"}), (YARD, {}), (BESIDE, HOUSE)]
    reading = read_extract(write(tmp_path / "a.osm", ways, (((1, "outer"), (2, "inner")), BARE)), GRID)
    assert reading.features.sort_values("osm_type")["is_visible"].tolist() == [False, True]
    assert reading.hidden == {"location=underground": 1}
    ways = [(SQUARE, HOUSE | {"start_date": "2015"}), (YARD, {})]
    file = write(tmp_path / "a.osm", ways, (((1, "outer"), (2, "inner")), BARE))
    started = read_lifecycle(file, epsg=32632).started
    assert started[ObjectKey("relation", 1)] == started[ObjectKey("way", 1)]


def test_an_outer_way_that_lacks_nodes_marks_a_gap_as_in_the_new_style(tmp_path):
    cuts = []
    for style, tags in (({}, FOREST), (FOREST, {})):
        ways = [(SQUARE, tags), (YARD, {}), (BESIDE, HOUSE)]
        file = write(tmp_path / "a.osm", ways, (((1, "outer"), (2, "inner")), BARE | style))
        file.write_text(file.read_text(encoding="utf-8").replace('<nd ref="3"/>', '<nd ref="999"/>'), encoding="utf-8")
        cuts.append(read_extract(file, GRID).cuts)
    assert cuts == [{"ways that lack some nodes": 1}] * 2


def test_a_place_in_the_old_and_in_the_new_style_is_the_same_map(tmp_path):
    """So that nothing ages where only tags were moved; one history holds both."""
    members, times = ((1, "outer"), (2, "inner")), "version='{}' timestamp='{}-01-01T00:00:00Z'"
    old = write(tmp_path / "old.osm", [(SQUARE, MEADOW), (YARD, {})], (members, BARE), meta=times.format(1, 2013))
    new = write(tmp_path / "new.osm", [(SQUARE, {}), (YARD, {})], (members, BARE | MEADOW), meta=times.format(2, 2021))
    both = tmp_path / "both.osh"
    later = new.read_text(encoding="utf-8").partition("<way")[1:]
    both.write_text(old.read_text(encoding="utf-8").replace("</osm>", "".join(later)), encoding="utf-8")
    columns = ["osm_type", "osm_id", "class", "width_m", "geometry"]
    tables = [read_extract(file, GRID).features[columns] for file in (old, new)]
    tables += [read_extract(both, GRID, at=dt.date(year, 6, 1)).features[columns] for year in (2014, 2022)]
    assert len(tables[0]) == 2
    for table in tables[1:]:
        assert table.drop(columns="geometry").equals(tables[0].drop(columns="geometry"))
        assert table.geometry.geom_equals(tables[0].geometry).all()


@pytest.mark.parametrize("key", ["highway", "tourism", "place", "boundary", "building:part", "landcover"])
def test_a_relation_that_says_what_it_is_is_not_of_the_old_style(key):
    class Item:
        tags, members, version, timestamp = BARE | {key: "x"}, (), 1, None

    assert area_relation(Item, lambda _: (), kind_keys(load_taxonomy().keys)) is None
