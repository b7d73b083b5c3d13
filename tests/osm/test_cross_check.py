# SPDX-License-Identifier: Apache-2.0
"""Small maps with the traits of real ones, read as GDAL and osmium read them (`benchmarks/cross_check_osm.py`)."""

import math
import os
from pathlib import Path

import osmium
import pytest

from benchmarks.cross_check_osm import check
from tests.slow import rest_slow

LON, LAT = 9.0, 47.0  # the middle of a UTM zone
TRUNK = {"highway": "trunk"}
WOOD, HOUSE, MEADOW = {"landuse": "forest"}, {"building": "yes"}, {"landuse": "meadow"}
AREA = {"type": "multipolygon"}


class Sketch:
    """An OSM file that is drawn in metres; nodes of one place are one node."""

    def __init__(self) -> None:
        self.nodes: dict[tuple[float, float], int] = {}
        self.lost: set[int] = set()
        self.ways: list[str] = []
        self.relations: list[str] = []

    def node(self, place: tuple[float, float]) -> int:
        return self.nodes.setdefault(place, len(self.nodes) + 1)

    def way(self, *places, **tags: str) -> int:
        """Draw a line; return its id."""
        self.ways.append("".join(f'<nd ref="{self.node(place)}"/>' for place in places) + self.tags(tags))
        return len(self.ways)

    def box(self, west, south, east, north, **tags: str) -> int:
        """Draw a rectangle; return its id."""
        return self.way((west, south), (east, south), (east, north), (west, north), (west, south), **tags)

    def relation(self, *members: tuple[int, str], **tags: str) -> None:
        inner = "".join(f'<member type="way" ref="{ref}" role="{role}"/>' for ref, role in members)
        self.relations.append(inner + self.tags(tags))

    def tags(self, tags: dict[str, str]) -> str:
        return "".join(f'<tag k="{key}" v="{value}"/>' for key, value in tags.items())

    def write(self, path: Path) -> Path:
        scale = 111_320.0
        body = [
            f'<node id="{key}" version="1" lon="{LON + x / scale / math.cos(math.radians(LAT)):.7f}" '
            f'lat="{LAT + y / scale:.7f}"/>'
            for (x, y), key in self.nodes.items()
            if key not in self.lost
        ]
        body += [f'<way id="{at}" version="1">{text}</way>' for at, text in enumerate(self.ways, 1)]
        body += [f'<relation id="{at}" version="1">{text}</relation>' for at, text in enumerate(self.relations, 1)]
        path.write_text(f'<osm version="0.6">{"".join(body)}</osm>')
        return path


def old_style() -> Sketch:
    """Tags on outer ways: with a hole, of two open ways, on the relation too; holes that share an edge; neighbours."""
    map_ = Sketch()
    outer, hole = map_.box(0, 0, 100, 100, **HOUSE), map_.box(40, 40, 60, 60)
    map_.relation((outer, "outer"), (hole, "inner"), **AREA)
    halves = map_.way((200, 0), (300, 0), (300, 100), **WOOD), map_.way((300, 100), (200, 100), (200, 0), **WOOD)
    map_.relation(*((each, "outer") for each in halves), **AREA)
    twice = map_.box(400, 0, 500, 100, natural="water")
    map_.relation((twice, "outer"), (map_.box(420, 20, 440, 40), "inner"), natural="water", **AREA)
    around = map_.box(600, 0, 700, 100, **WOOD)
    touching = map_.box(620, 20, 640, 40, **MEADOW), map_.box(640, 20, 660, 40, natural="water")
    map_.relation((around, "outer"), *((each, "inner") for each in touching), **AREA)
    for at in range(3):
        map_.box(800 + 100 * at, 0, 900 + 100 * at, 100, landuse="farmland")
    fenced = map_.box(1200, 0, 1300, 100, barrier="fence", landuse="grass")
    map_.relation((fenced, "outer"), (map_.box(1220, 20, 1240, 40), "inner"), **AREA)
    return map_


def cut_out() -> Sketch:
    """A member and nodes that are missing, an outline of a building that is none, a bridge that leaves the map."""
    map_ = Sketch()
    whole = map_.box(0, 0, 100, 100)
    map_.relation((whole, "outer"), (900, "outer"), **WOOD, **AREA)
    map_.relation((901, "outer"), (map_.box(200, 0, 300, 100), "inner"), **WOOD, **AREA)
    map_.way((0, 200), (100, 200), (200, 200), (300, 200), (400, 200), bridge="yes", **TRUNK)
    map_.box(0, 300, 100, 400, **HOUSE)
    map_.relation((map_.box(200, 300, 300, 400), "outline"), type="building", building="church")
    map_.lost = {map_.node((200, 200)), map_.node((0, 300))}
    return map_


def today() -> Sketch:
    """What is usual now: yards, squares, fenced meadows, a house of two wings that cross, ways of another class."""
    map_ = Sketch()
    map_.relation((map_.box(0, 0, 100, 100), "outer"), (map_.box(20, 20, 80, 80), "inner"), **HOUSE, **AREA)
    map_.relation((map_.box(200, 0, 300, 100), "outer"), highway="pedestrian", **AREA)
    map_.box(400, 0, 500, 100, area="yes", highway="footway")
    map_.box(600, 0, 700, 100, barrier="fence", **MEADOW)
    map_.way((800, 0), (900, 100), (900, 0), (800, 100), (800, 0), **HOUSE)
    lake = map_.box(1000, 0, 1100, 100, natural="water")
    map_.relation((lake, "outer"), (map_.box(1040, 40, 1060, 60), "inner"), leisure="park", **AREA)
    map_.way((0, 200), (300, 200), waterway="river", layer="-1", tunnel="culvert")
    map_.way((0, 300), (300, 300), railway="tram", highway="residential")
    map_.box(0, 400, 100, 500, building="no", area="no", leisure="park")
    return map_


# Hand-worked sums of our reading, m2 of areas and m of lines, and the rules that are needed to agree with GDAL.
MAPS = {
    "old": (old_style, {("building", "area"): 9_600, ("green", "area"): 10_000 + 9_200 + 400 + 9_600, ("water",
     "area"): 9_600 + 400, ("farmland", "area"): 30_000, ("field_boundary", "line"): 80 + 3 * 400 + 400},
     {"lines_lie_on_their_way", "tags_of_open_ways"}),
    "cut": (cut_out, {("green", "area"): 10_000, ("road_major", "line"): 200, ("bridge", "line"): 200, ("building",
     "area"): 15_000}, {"no_line_across_a_gap", "building_relation"}),
    "today": (today, {("building", "area"): 6_400 + 5_000, ("road_minor", "area"): 10_000, ("path_track",
     "area"): 10_000, ("green", "area"): 10_000 + 9_600, ("field_boundary", "line"): 400, ("water", "area"): 10_000,
     ("waterway", "line"): 300, ("railway", "line"): 300, ("road_minor", "line"): 300}, set()),
}  # fmt: skip


@pytest.mark.parametrize("name", MAPS)
def test_a_small_map_is_read_as_gdal_and_osmium_read_it_but_for_rules(name, tmp_path):
    draw, sums, rules = MAPS[name]
    found = check(draw().write(tmp_path / f"{name}.osm"), at="")
    ours = {(row["class"], row["form"]): row["size_ours"] for row in found["sums"] if row["size_ours"] > 0}
    assert ours == pytest.approx(sums, rel=2e-3)  # the sketch is drawn on a sphere
    assert [each for each in found["differences"] if each["rule"] is None] == []
    assert {each["rule"] for each in found["differences"] if each["reader"] == "gdal"} == rules


# Of the extracts, a place in each and half the side of a box around it, degrees.
REAL = [
    ("krems-2013-12-16.osm.pbf", (15.60, 48.41), 0.01),
    ("monaco-2015-04-27.osm.pbf", (7.42, 43.735), 0.01),
    ("berlinmitte-2022-12-20.osm.pbf", (13.38, 52.515), 0.004),
]


def cut(path: Path, middle: tuple[float, float], half: float, target: Path) -> Path:
    """Write the ways that have a node in a box, whole, and the relations of these."""
    near = {
        node.id
        for node in osmium.FileProcessor(str(path), osmium.osm.NODE)
        if max(abs(node.location.lon - middle[0]), abs(node.location.lat - middle[1])) < half
    }
    ways, nodes = set(), set(near)
    for way in osmium.FileProcessor(str(path), osmium.osm.WAY):
        refs = {node.ref for node in way.nodes}
        if not refs.isdisjoint(near):
            ways.add(way.id)
            nodes |= refs
    with osmium.SimpleWriter(str(target)) as writer:
        for item in osmium.FileProcessor(str(path)):
            members = item.members if item.is_relation() else ()
            is_in = any(each.type == "w" and each.ref in ways for each in members)
            if is_in or item.id in {"n": nodes, "w": ways, "r": ()}[item.type_str()]:
                writer.add(item)
    return target


@pytest.mark.real
@pytest.mark.parametrize(("name", "middle", "half"), rest_slow(REAL), ids=[name.split("-")[0] for name, *_ in REAL])
def test_a_cut_of_a_real_map_is_read_as_gdal_and_osmium_read_it_but_for_rules(name, middle, half, tmp_path):
    whole = Path(os.environ["SASGEO_EXTRACTS"]) / name
    if not whole.exists():
        pytest.skip(f"SASGEO_EXTRACTS has no {name}")
    found = check(cut(whole, middle, half, tmp_path / name), at="")
    assert sum(row["size_ours"] for row in found["sums"]) > 10_000
    assert [each for each in found["differences"] if each["rule"] is None] == []
