# SPDX-License-Identifier: Apache-2.0
"""OSM files as editors, servers and filters write them: one town is read from each, or a line says what is wrong."""

import bz2
import datetime as dt
import gzip

import osmium
import pytest
import shapely
from osmium.osm.mutable import Node, Way

from sasgeo_bench.core.errors import CoverageError, ExtractError
from sasgeo_bench.geometry.grid import Grid
from sasgeo_bench.osm.read import read_extract
from sasgeo_bench.osm.snapshot import is_history, read_header
from tests.osm.drawing import bounds, place

GRID = Grid(epsg=32632, west_m=499_700.0, north_m=5_205_500.0, cell_size_m=5.0, rows=130, cols=130)
DAY = dt.datetime(2015, 6, 1, tzinfo=dt.UTC)


class Town:
    """A grid of streets with the elements that a test adds, each as the text of an XML file."""

    def __init__(self):
        self.number, self.nodes, self.ways, self.relations = 1, [], [], []
        for y in range(-300, 301, 75):
            self.way([(x, y) for x in range(-300, 301, 75)], highway="service")

    def take(self):
        self.number += 1
        return self.number - 1

    def way(self, corners, more="", *, sign=1, of=None, **tags):
        of = [None] * len(corners) if of is None else of
        refs = [self.node(*corner, sign=sign) for corner in corners[: len(set(corners))]]
        refs += refs[: len(corners) - len(refs)]
        identifier = sign * self.take()
        nds = "".join(f'<nd ref="{ref}"/>' for ref in refs)
        text = "".join(f'<tag k="{key}" v="{value}"/>' for key, value in tags.items())
        self.ways.append(f'<way id="{identifier}" version="1" {more}>{nds}{text}</way>')
        return identifier

    def node(self, x, y, *, sign=1):
        lon, lat = place(x, y)
        identifier = sign * self.take()
        self.nodes.append(f'<node id="{identifier}" version="1" lat="{lat:.7f}" lon="{lon:.7f}"/>')
        return identifier

    def text(self, head=""):
        body = "\n".join((*self.nodes, *self.ways, *self.relations))
        return f'<?xml version="1.0"?>\n<osm version="0.6">{head}\n{body}</osm>\n'

    def write(self, path, head=""):
        path.write_text(self.text(head), encoding="utf-8")
        return path


def square(x, y, side=40.0):
    half = side / 2
    corners = [(x - half, y - half), (x + half, y - half), (x + half, y + half), (x - half, y + half)]
    return [*corners, corners[0]]


def houses(path, **more):
    """Total area of the buildings, to fifty square metres (UTM is 0.1 % smaller), and their ids."""
    found = read_extract(path, GRID, **more).features
    found = found[found["class"] == "building"]
    return 50 * round(float(found.geometry.area.sum()) / 50), sorted(found["osm_id"])


# Editors


@pytest.mark.parametrize("mark", ["action='delete'", 'action="delete"', "visible='false'"])
def test_what_an_editor_or_the_server_has_deleted_is_left_out(mark, tmp_path):
    town = Town()
    kept = town.way(square(0, 0), "action='modify' visible='true'", building="yes")
    town.way(square(100, 0), mark, building="yes")
    member = f'<member type="way" ref="{kept}" role="outer"/><tag k="type" v="multipolygon"/>'
    town.relations.append(f'<relation id="900" {mark}>{member}<tag k="landuse" v="forest"/></relation>')
    town.write(tmp_path / "a.osm")
    (tmp_path / "a.osm.gz").write_bytes(gzip.compress(town.text().encode()))
    (tmp_path / "a.osm.bz2").write_bytes(bz2.compress(town.text().encode()))
    for name in ("a.osm", "a.osm.gz", "a.osm.bz2"):
        assert houses(tmp_path / name) == (1600, [kept])
    assert "green" not in set(read_extract(tmp_path / "a.osm", GRID).features["class"])


def test_a_tag_that_speaks_of_deletion_deletes_nothing(tmp_path):
    town = Town()
    kept = town.way(square(0, 0), building="yes", note="action=&apos;delete&apos; &amp; &quot;visible&quot; &lt;b&gt;")
    town.way(square(100, 0), "action='delete'", building="yes")
    assert houses(town.write(tmp_path / "a.osm")) == (1600, [kept])


def test_a_file_packed_in_several_streams_is_read_whole(tmp_path):
    town = Town()
    house = town.way(square(0, 0), building="yes")
    text = town.text().encode()
    for pack, suffix in ((bz2.compress, "bz2"), (gzip.compress, "gz")):
        streams = [pack(text[at : at + 999]) for at in range(0, len(text), 999)]
        (tmp_path / f"a.osm.{suffix}").write_bytes(b"".join(streams))
        assert houses(tmp_path / f"a.osm.{suffix}") == (1600, [house])


@pytest.mark.parametrize("order", [1, -1])
def test_what_was_drawn_and_not_uploaded_yet_is_read_and_keeps_its_negative_id(order, tmp_path):
    town = Town()
    old = town.way(square(0, 0), building="yes")
    new = town.way(square(100, 0), sign=-1, building="yes")
    road = town.way([(-200, 37), (100, 37), (200, 37)], sign=-1, highway="primary")
    town.nodes, town.ways = town.nodes[::order], town.ways[::order]
    found = read_extract(town.write(tmp_path / "a.osm"), GRID).features
    assert houses(tmp_path / "a.osm") == (3200, sorted((old, new)))
    major = found[found["class"] == "road_major"]
    assert major["osm_id"].tolist() == [road]
    assert major.geometry.length.iloc[0] == pytest.approx(400, abs=1)


def test_the_boxes_of_several_downloads_are_one_mapped_area_and_one_in_a_comment_is_none(tmp_path):
    town, two = Town(), bounds(-320, -320, 0, 320) + bounds(0, -320, 320, 320)
    reading = read_extract(town.write(tmp_path / "a.osm", two), GRID)
    assert len(read_header(tmp_path / "a.osm").boxes_lonlat) == 2
    assert reading.coverage_source == "header box"
    assert shapely.area(reading.coverage) == pytest.approx(640 * 620, rel=0.05)
    town.way(square(0, 0), "action='delete'", building="yes")
    path = town.write(tmp_path / "b.osm", f"<!-- {bounds(-9, -9, 9, 9)} -->{two}")
    assert len(read_header(path).boxes_lonlat) == 2


def test_a_box_that_holds_none_of_the_data_is_named_and_one_in_the_older_form_is_a_box(tmp_path):
    far = '<bounds minlat="9" minlon="47" maxlat="9.01" maxlon="47.01"/>'
    with pytest.raises(CoverageError, match=r"nothing within its own bounds, \[47.0000, 9.0000, .* remove them"):
        read_extract(Town().write(tmp_path / "a.osm", far), GRID)
    (west, south), (east, north) = place(-320, -320), place(320, 320)
    old = f'<bound box="{south},{west},{north},{east}" origin="Osmosis"/>'
    assert read_header(Town().write(tmp_path / "a.osm", old)).boxes_lonlat == (
        pytest.approx((west, south, east, north)),
    )


# Servers


def geom(corners):
    places = [place(*corner) for corner in corners]
    return "".join(f'<nd lat="{lat:.7f}" lon="{lon:.7f}"/>' for lon, lat in places)


@pytest.mark.parametrize("with_ways", [True, False])
def test_places_inside_members_are_read(with_ways, tmp_path):
    town = Town()
    rings = {"outer": square(0, 0, 100), "inner": square(0, 0)}
    members = ""
    for number, (role, corners) in enumerate(rings.items(), start=800):
        ref = town.way(corners) if with_ways else number
        members += f'<member type="way" ref="{ref}" role="{role}">{geom(corners)}</member>'
        role_again = f'<member type="way" ref="{ref}" role="">{geom(corners)}</member>'
        town.relations.append(f'<relation id="{number + 100}">{role_again}<tag k="type" v="route"/></relation>')
    tags = '<tag k="type" v="multipolygon"/><tag k="building" v="yes"/>'
    town.relations.append(f'<relation id="999"><bounds minlat="0" maxlat="1"/>{members}{tags}</relation>')
    assert houses(town.write(tmp_path / "a.osm")) == (8400, [999])


def test_a_member_that_was_cut_off_at_both_ends_is_no_ring(tmp_path):
    town, corners = Town(), square(0, 0, 100)
    halves = "".join(
        f'<member type="way" ref="{number}" role="outer"><nd/>{geom(half)}<nd/></member>'
        for number, half in ((800, corners[:3]), (801, corners[3:]))
    )
    tags = '<tag k="type" v="multipolygon"/><tag k="building" v="yes"/>'
    town.relations.append(f'<relation id="999">{halves}{tags}</relation>')
    assert houses(town.write(tmp_path / "a.osm")) == (0, [])
    assert read_extract(tmp_path / "a.osm", GRID).drops == {"relation with no closed ring left": 1}


def test_ways_that_carry_the_places_of_their_nodes_need_no_nodes(tmp_path):
    town = Town()
    corners = square(0, 0)
    texts = geom(corners).split("<nd ")[1:]
    nds = "".join(f'<nd ref="{900 + at % 4}" {text}' for at, text in enumerate(texts))
    town.ways.append(f'<way id="800"><center lat="47" lon="9"/>{nds}<tag k="building" v="yes"/></way>')
    assert houses(town.write(tmp_path / "a.osm")) == (1600, [800])


def on_ways(source, target, *, keep_nodes=False):
    """Write what `osmium add-locations-to-ways` writes."""
    with osmium.SimpleWriter(osmium.io.File(str(target), "pbf,locations_on_ways=true")) as writer:
        for item in osmium.FileProcessor(str(source)).with_locations():
            if not item.is_node() or keep_nodes:
                writer.add(item)
    return target


@pytest.mark.parametrize("keep_nodes", [True, False])
def test_node_places_on_ways_give_the_same_town(keep_nodes, tmp_path):
    town = Town()
    house = town.way(square(0, 0), building="yes")
    plain = town.write(tmp_path / "a.osm")
    path = on_ways(plain, tmp_path / "b.osm.pbf", keep_nodes=keep_nodes)
    assert houses(path) == houses(plain) == (1600, [house])
    assert len(read_extract(path, GRID).features) == len(read_extract(plain, GRID).features)


# Histories, repetitions, and what is no extract


def write_states(path, options):
    """A house of 2015 that is deleted in 2018, and a street that stays."""
    with osmium.SimpleWriter(osmium.io.File(str(path), options)) as writer:
        for number, corner in enumerate([*square(0, 0)[:4], (-200, 60), (200, 60)], start=1):
            writer.add_node(Node(id=number, version=1, visible=True, timestamp=DAY, location=place(*corner)))
        made = {"id": 1, "timestamp": DAY, "visible": True}
        writer.add_way(Way(**made, version=1, nodes=[1, 2, 3, 4, 1], tags={"building": "yes"}))
        if "history" in options:
            writer.add_way(Way(id=1, version=2, visible=False, timestamp=DAY.replace(year=2018), nodes=[], tags={}))
        writer.add_way(Way(**made | {"id": 2}, version=1, nodes=[5, 6], tags={"highway": "residential"}))
    return path


def test_a_history_is_told_by_its_header_whatever_its_name(tmp_path):
    path = write_states(tmp_path / "history-latest.osm.pbf", "pbf,history=true")
    assert is_history(path)
    assert houses(path, at=dt.date(2016, 1, 1)) == (1600, [1])
    assert houses(path, at=dt.date(2019, 1, 1)) == (0, [])
    with pytest.raises(ExtractError, match="give the date"):
        read_extract(path, GRID)
    with pytest.raises(ExtractError, match="nothing of 2014-12-31 or before: choose a later date"):
        read_extract(path, GRID, at=dt.date(2014, 12, 31))


def test_what_is_only_named_like_a_history_is_read_as_it_stands(tmp_path):
    path = write_states(tmp_path / "town.osh.pbf", "pbf")
    assert not is_history(path)
    reading = read_extract(path, GRID, at=dt.date(2000, 1, 1))
    assert (reading.features["class"] == "building").sum() == 1
    assert "named like a full history" in reading.warnings[0]


def test_a_history_in_xml_is_told_by_its_versions(tmp_path):
    town = Town()
    house = town.way(square(0, 0), 'timestamp="2015-06-01T00:00:00Z"', building="yes")
    town.ways.append(f'<way id="{house}" version="2" visible="false" timestamp="2018-01-01T00:00:00Z"/>')
    for name in ("history-latest.osm", "a.osh"):
        path = town.write(tmp_path / name)
        assert is_history(path)
        assert houses(path, at=dt.date(2016, 1, 1)) == (1600, [house])
        assert houses(path, at=dt.date(2019, 1, 1)) == (0, [])


@pytest.mark.parametrize("versions", [(1, 1), (1, 2), (2, 1)])
def test_of_merged_files_each_object_is_taken_once_and_newest(versions, tmp_path):
    town = Town()
    refs = [town.node(*corner) for corner in square(0, 0)[:4]]
    nds = "".join(f'<nd ref="{ref}"/>' for ref in [*refs, refs[0]])
    newest = max(versions)
    for version in versions:
        kind = "yes" if version == newest else "no"
        town.ways.append(f'<way id="800" version="{version}">{nds}<tag k="building" v="{kind}"/></way>')
    reading = read_extract(town.write(tmp_path / "a.osm"), GRID)
    assert houses(tmp_path / "a.osm") == (1600, [800])
    assert reading.warnings[0].startswith("1 object stood there in more than one version")


NODE = "<node id='1' lat='47' lon='9'/>"


@pytest.mark.parametrize(
    ("name", "text", "words"),
    [
        ("a.osm.pbf", "hello, this is text", "holds no OSM data"),
        ("a.osm.pbf", "", "is empty"),
        ("a.txt", "x", "of no known format"),
        ("a.osm.pbf", "\x00\x00\x00\x0d\n\tOSMHeader junk", "cannot be read"),
        ("a.osc", "", "is a change file"),
        ("a.osc.pbf", "", "is a change file"),
        ("a.geojson", "", "say format = 'geojson'"),
        ("a.osm.zip", "", "of no known format: unpack or convert it to .osm.pbf"),
        ("a.osm", f"<osm version='0.6'>{NODE}<remark> runtime error: Query timed out </remark></osm>", "timed out"),
        ("a.osm", f"<osm version='0.6'>{NODE}<area id='1'><tag k='a' v='b'/></area></osm>", "holds no element"),
        ("a.osm", '<osmChange version="0.6"><create><node id="1" version="1" lat="47" lon="9"/></create></osmChange>',
         "holds changes: give the extract"),
        ("a.osm", f"<osm version='0.6'>{NODE}<way id='{9 * 10**18}'/></osm>", "ids of up to 9000.*renumber"),
        ("a.osm", "<osm version='0.6'></osm>", "holds no element"),
        ("a.o5m", "x", r"convert it \(osmium cat a.o5m"),
        ("a.opl", "n1 x9 y47", r"convert it \(osmium cat a.opl"),
        ("a.osm", "<osm version='0.6'><way id='1' action='delete'></osm>", "cannot be read as OSM data"),
        ("a.osm", "<!DOCTYPE x [<!ENTITY a 'b'>]><osm version='0.6'><node id='1' action='delete'/></osm>", "entities"),
    ],
)  # fmt: skip
def test_what_is_no_extract_is_refused_with_what_to_do(name, text, words, tmp_path):
    (tmp_path / name).write_text(text)
    with pytest.raises((CoverageError, ExtractError), match=words) as caught:
        read_extract(tmp_path / name, GRID)
    assert "\n" not in str(caught.value)
    assert name in str(caught.value)


def test_a_header_that_promises_an_order_is_not_believed(tmp_path):
    town, header = Town(), osmium.io.Header()
    outer, inner = town.way(square(0, 0, 100)), town.way(square(0, 0))
    members = "".join(f'<member type="way" ref="{r}" role="{s}"/>' for r, s in ((outer, "outer"), (inner, "inner")))
    tags = '<tag k="type" v="multipolygon"/><tag k="building" v="yes"/>'
    town.relations.append(f'<relation id="9">{members}{tags}</relation>')
    town.ways.reverse()
    header.set("sorting", "Type_then_ID")
    with osmium.SimpleWriter(str(tmp_path / "a.osm.pbf"), header=header) as writer:
        for item in osmium.FileProcessor(str(town.write(tmp_path / "a.osm"))):
            writer.add(item)
    assert houses(tmp_path / "a.osm.pbf") == (8400, [9])


@pytest.mark.parametrize("keep", [0, 3, 4])
def test_ways_without_their_nodes_are_refused_in_one_line(keep, tmp_path):
    town = Town()
    town.nodes = [node for at, node in enumerate(town.nodes) if keep and at % keep == 0]
    with pytest.raises(ExtractError, match=r"lacks the nodes of 9 of its 9 ways: .* without -R"):
        read_extract(town.write(tmp_path / "a.osm"), GRID)
