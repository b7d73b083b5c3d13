# SPDX-License-Identifier: Apache-2.0
"""Maps from GeoJSON: houses of OpenStreetMap in labelled places; whatever else is there is unknown."""

import json

import pytest
import shapely
import shapely.affinity

from sasgeo_bench.core.config import check_document
from sasgeo_bench.core.errors import ConfigError, CoverageError, ExtractError
from sasgeo_bench.core.folders import sha256_of
from sasgeo_bench.geometry.grid import Grid
from sasgeo_bench.osm.geojson import identity_of, tags_of
from sasgeo_bench.osm.locate import ExtractPart, find_parts
from sasgeo_bench.osm.read import read_geojson
from sasgeo_bench.regions.region_spec import RegionFile
from tests.regions.imagery_place import EPSG, SOUTH, WEST, make_hamlet, to_lonlat, write_houses

GRID = Grid(epsg=EPSG, west_m=WEST, north_m=SOUTH + 100, cell_size_m=1.0, rows=100, cols=100)
MAPPED = to_lonlat(shapely.box(WEST, SOUTH, WEST + 100, SOUTH + 80))
HOUSE = shapely.box(WEST + 10, SOUTH + 10, WEST + 30, SOUTH + 20)
SHED = shapely.box(WEST + 50, SOUTH + 50, WEST + 60, SOUTH + 60)


def read(*files, tags=None, classes=("building",)):
    stated = {"building": "yes"} if tags is None else tags
    return read_geojson(files, GRID, tags=stated, stated_coverage=MAPPED, classes=classes)


def written(path, *features, **more):
    path.write_text(json.dumps({"type": "FeatureCollection", "features": list(features), **more}))
    return path


def feature(shape, **properties):
    return {"type": "Feature", "properties": properties, "geometry": shapely.geometry.mapping(to_lonlat(shape))}


def test_houses_are_where_they_are_and_the_mapped_area_is_the_stated_one(tmp_path):
    write_houses(tmp_path / "a.geojson", [HOUSE, SHED])
    reading = read(tmp_path / "a.geojson")
    assert reading.features["class"].tolist() == ["building", "building"]
    assert reading.features["osm_id"].tolist() == [1, 2]
    assert shapely.hausdorff_distance(reading.features.geometry.iloc[0], HOUSE) < 0.01
    assert reading.coverage.area == pytest.approx(8000, rel=1e-3)
    assert reading.coverage_source == "region file"


def test_properties_are_tags_and_classes_that_are_not_asked_for_are_left_out(tmp_path):
    road = shapely.LineString([(WEST, SOUTH + 40), (WEST + 90, SOUTH + 40)])
    path = written(
        tmp_path / "a.geojson", feature(HOUSE, building="house"), feature(road, highway="primary"), feature(SHED)
    )
    assert read(path, tags={}).features["class"].tolist() == ["building"]
    both = read(path, tags={}, classes=("road_major", "building"))
    assert both.features["class"].tolist() == ["road_major", "building"]
    assert both.features["width_m"].notna().tolist() == [True, False]
    assert both.drops == {"Polygon without a class": 1}


@pytest.mark.parametrize("properties", [["building", "yes"], "building=yes", 7, True])
def test_properties_that_are_no_object_are_refused_by_their_feature(tmp_path, properties):
    broken = {**feature(HOUSE), "properties": properties}
    path = written(tmp_path / "a.geojson", feature(SHED), broken)
    with pytest.raises(ExtractError, match=r"the properties of feature 1 are .*, and no object of keys and values"):
        read(path)


def test_several_files_are_one_map_and_an_object_of_both_is_taken_once(tmp_path):
    first = written(tmp_path / "a.geojson", feature(HOUSE, osm_id=7), feature(SHED))
    second = written(tmp_path / "b.geojson", feature(HOUSE, osm_id=7), feature(SHED, osm_id=8))
    reading = read(first, second)
    assert sorted(reading.features["osm_id"]) == [-2, 7, 8]
    assert reading.notes == {"feature without the id of an object": 1, "object that stands there twice, taken once": 1}


def test_longitudes_beyond_180_are_refused_by_their_feature_and_never_wrapped_or_clamped(tmp_path):
    away = feature(HOUSE)
    away["geometry"] = shapely.geometry.mapping(shapely.affinity.translate(to_lonlat(HOUSE), xoff=181.0))
    with pytest.raises(
        ExtractError, match=r"feature 1 has a broken geometry \(its bounds \(190\.00.* are no longitudes"
    ):
        read(written(tmp_path / "a.geojson", feature(SHED), away))


def test_a_crossing_ring_is_mended_and_a_feature_without_geometry_counted(tmp_path):
    bow = shapely.Polygon([(WEST, SOUTH), (WEST + 20, SOUTH + 20), (WEST + 20, SOUTH), (WEST, SOUTH + 20)])
    empty = {"type": "Feature", "properties": {}, "geometry": None}
    reading = read(written(tmp_path / "a.geojson", feature(bow), empty))
    assert reading.features.geometry.is_valid.all()
    assert reading.drops == {"feature without a geometry": 1}


SWITCHES = ("bridge", "tunnel", "building", "area")
REAL = {"ref": "1", "name": "No", "addr:housenumber": "1.0", "route": "T", "bridge": "viaduct", "oneway": "-1"}


@pytest.mark.parametrize(
    ("properties", "tags"),
    [
        ({"building": "", "landuse": "grass", "name": None, "note": "  "}, {"landuse": "grass"}),
        ({"highway": "path", "bridge": False, "tunnel": True}, {"highway": "path", "bridge": "no", "tunnel": "yes"}),
        (
            {"bridge": 0, "tunnel": 1, "layer": 1, "lanes": 0},
            {"bridge": "no", "tunnel": "yes", "layer": "1", "lanes": "0"},
        ),
        ({"layer": "-1.0", "lanes": "2.00", "width": "3.50"}, {"layer": "-1", "lanes": "2", "width": "3.50"}),
        ({"tunnel": "0.0", "bridge": "1.0", "covered": "0."}, {"tunnel": "no", "bridge": "yes", "covered": "no"}),
        ({"bridge": "F", "tunnel": "f", "building": "n", "area": "N"}, dict.fromkeys(SWITCHES, "no")),
        ({"bridge": "T", "tunnel": "t", "building": "y", "area": "Y"}, dict.fromkeys(SWITCHES, "yes")),
        ({"other_tags": '"bridge"=>"F","ref"=>"T"'}, {"bridge": "no", "ref": "T"}),
        (REAL, REAL),
        ({"layer": -1.0, "width": 3.5, "lanes": 2.0}, {"layer": "-1", "width": "3.5", "lanes": "2"}),
        ({"building": "None", "landuse": "nan", "natural": "<Null>"}, {}),
        ({"type": "way", "id": 5, "tags": {"building": "yes"}, "meta": {}}, {"building": "yes"}),
        ({"tags": '{"building": true}', "relations": []}, {"building": "yes"}),
        ({"other_tags": r'"building"=>"yes","name"=>"a \"b\", c"'}, {"building": "yes", "name": 'a "b", c'}),
        ({"building": "house", "other_tags": '"building"=>"yes"'}, {"building": "house"}),
        ({"other_tags": "a text of no form"}, {}),
        (None, {}),
    ],
)
def test_values_are_tags_as_a_mapper_writes_them(properties, tags):
    assert tags_of({"properties": properties}) == tags


@pytest.mark.parametrize(
    ("feature", "identity"),
    [
        ({"properties": {"osm_id": 7, "osm_type": "way"}}, (False, 7)),
        ({"properties": {"osm_id": "7", "osm_type": "relation"}}, (True, 7)),
        ({"properties": {"osm_id": -7}}, (True, 7)),
        ({"properties": {"osm_id": None, "osm_way_id": "8"}}, (False, 8)),
        ({"properties": {"@id": "relation/9"}}, (True, 9)),
        ({"id": "way/9", "properties": None}, (False, 9)),
        ({"id": "w9", "properties": {}}, (False, 9)),
        ({"properties": {"type": "way", "id": 5}}, (False, 5)),
        ({"id": 3, "properties": {"id": 4}}, None),
        ({"properties": {"osm_id": True}}, None),
        ({"properties": {"osm_id": 2**62}}, None),
        ({"properties": {"osm_id": "7a"}}, None),
        ({"properties": {"id": 7, "element": "relation", "type": "multipolygon"}}, (True, 7)),
        ({"properties": {"osmid": 7}}, (False, 7)),
        ({"id": "a14", "properties": {}}, (False, 7)),
        ({"id": "a15", "properties": {}}, (True, 7)),
    ],
)
def test_an_object_is_named_in_many_ways(feature, identity):
    assert identity_of(feature) == identity


@pytest.mark.parametrize(
    ("kind", "properties", "identity"),
    [
        ("MultiPolygon", {"osm_id": "7", "osm_way_id": None}, (True, 7)),
        ("MultiPolygon", {"osm_id": None, "osm_way_id": "7"}, (False, 7)),
        ("MultiPolygon", {"osm_id": 7, "osm_type": "way"}, (False, 7)),
        ("LineString", {"osm_id": "7"}, (False, 7)),
        (None, {"osm_id": "7"}, (False, 7)),
    ],
)
def test_an_area_of_ogr2ogr_has_the_id_of_a_relation_or_of_a_way(kind, properties, identity):
    geometry = kind and {"type": kind}
    assert identity_of({"properties": properties, "geometry": geometry}, is_ogr=True) == identity


def test_objects_of_one_number_or_two_classes_are_kept_apart(tmp_path):
    inside = shapely.box(WEST + 12, SOUTH + 12, WEST + 20, SOUTH + 18)
    relation = feature(HOUSE, osm_id="7", osm_way_id=None, building="yes")
    way = feature(inside, osm_id=None, osm_way_id="7", building="yes")
    found = read(written(tmp_path / "a.geojson", relation, way), tags={}).features
    assert found["osm_type"].tolist() == ["way", "relation"]
    assert found.geometry.area.tolist() == pytest.approx([inside.area, HOUSE.area], rel=1e-2)
    both = [feature(HOUSE, osm_id=7, building="yes"), feature(HOUSE, osm_id=7, landuse="grass")]
    reading = read(written(tmp_path / "a.geojson", *both), tags={}, classes=("building", "green"))
    assert reading.features["class"].tolist() == ["building", "green"]


def closed(shape):
    return shapely.LineString(shape.exterior.coords)


@pytest.mark.parametrize(
    ("shape", "properties", "reason"),
    [
        (closed(HOUSE), {"building": "yes"}, "closed line that is no polygon"),
        (closed(HOUSE), {"name": "a"}, "LineString without a class"),
        (shapely.LineString(HOUSE.exterior.coords[:3]), {"building": "yes"},
         "LineString with the tags of a line or an area"),
        (shapely.GeometryCollection([HOUSE]), {"building": "yes"},
         "GeometryCollection with the tags of a line or an area"),
        (HOUSE.centroid, {"building": "yes"}, "Point with the tags of a line or an area"),
        (HOUSE.centroid, {"shop": "bakery"}, "Point without a class"),
    ],
)  # fmt: skip
def test_what_is_no_object_is_counted_as_what_it_is(shape, properties, reason, tmp_path):
    path = written(tmp_path / "a.geojson", feature(shape, **properties), feature(SHED, building="yes"))
    assert read(path, tags={}).drops == {reason: 1}


def test_features_of_which_none_has_a_class_are_refused_with_the_names_of_their_properties(tmp_path):
    parts = [feature(HOUSE, **{"class": "residential", "height": 3}), feature(SHED, **{"class": "garage"})]
    with pytest.raises(ExtractError, match="none of 2 features in the region has a class") as found:
        read(written(tmp_path / "a.geojson", *parts), tags={}, classes=None)
    assert "(2 x Polygon without a class); their properties are class, height: are they tags" in str(found.value)
    assert "move or enlarge" not in str(found.value)
    with pytest.raises(ExtractError, match=r"1 x closed line that is no polygon.*are areas polygons"):
        read(written(tmp_path / "b.geojson", feature(closed(HOUSE), building="yes")), tags={})


def test_features_of_one_object_are_its_parts(tmp_path):
    parts = [feature(shape, osm_id=7, osm_type="relation", building="yes") for shape in (HOUSE, SHED, HOUSE)]
    line = [shapely.LineString([(WEST, SOUTH + y), (WEST + 90, SOUTH + y)]) for y in (40, 60)]
    roads = [feature(shape, osm_id=8, highway="primary") for shape in line]
    reading = read(written(tmp_path / "a.geojson", *parts, *roads), tags={}, classes=("road_major", "building"))
    assert reading.features["osm_id"].tolist() == [8, 7]
    road, house = reading.features.geometry
    assert house.area == pytest.approx(HOUSE.area + SHED.area, rel=1e-3)
    assert road.length == pytest.approx(180, rel=1e-3)
    assert reading.notes == {
        "further part of an object, joined to it": 2,
        "object that stands there twice, taken once": 1,
    }


@pytest.mark.parametrize(
    ("tags", "classes"),
    [
        ({"highway": "service"}, ["road_minor"]),
        ({"highway": "service", "name": "other"}, ["road_minor", "road_minor"]),
        ({"barrier": "fence"}, ["field_boundary"]),
        ({"landuse": "meadow", "barrier": "hedge"}, ["green", "field_boundary"]),
        ({"building": "yes"}, ["building"]),
    ],
)
def test_a_closed_way_that_comes_as_a_line_and_as_an_area_is_one_object(tags, classes, tmp_path):
    turned = shapely.LineString([*HOUSE.exterior.coords[2:], *HOUSE.exterior.coords[1:3]])
    values = {key: value for key, value in tags.items() if key != "name"}  # with other tags it is another object
    both = [feature(shapely.MultiPolygon([HOUSE]), **tags), feature(turned, **values)]
    reading = read(written(tmp_path / "a.geojson", *both, feature(SHED)), tags={}, classes=None)
    assert reading.features["class"].tolist() == classes
    assert reading.drops == {"Polygon without a class": 1}


def test_a_byte_order_mark_is_passed_over_and_a_file_with_hardly_a_tag_or_of_elsewhere_says_so(tmp_path):
    path = written(tmp_path / "a.geojson", feature(HOUSE))
    path.write_bytes(b"\xef\xbb\xbf" + path.read_bytes())
    assert len(read(path).features) == 1
    few = [feature(HOUSE, building="yes"), *(feature(SHED, kind="building") for _ in range(20))]
    reading = read(written(tmp_path / "a.geojson", *few), tags={})
    assert reading.warnings[0].startswith("1 of 21 features became objects of a class (20 x Polygon without a class)")
    assert read(written(tmp_path / "b.geojson", *few[:20]), tags={}).warnings == ()
    turned = feature(HOUSE)
    turned["geometry"] = shapely.geometry.mapping(shapely.transform(to_lonlat(HOUSE), lambda points: points[:, ::-1]))
    with pytest.raises(CoverageError, match=r"move or enlarge the bounds \(what it holds lies within \[47"):
        read(written(tmp_path / "a.geojson", turned))


BAD = {
    "": "cannot be read as GeoJSON",
    "{": "cannot be read as GeoJSON",
    "null": "no GeoJSON FeatureCollection",
    '{"type": "Feature"}': "no GeoJSON FeatureCollection",
    '{"type": "FeatureCollection", "features": [{"properties": "a", "geometry": null}]}': "and no object of keys",
    '{"type": "FeatureCollection", "features": [7]}': "feature 0 has a broken geometry",
    '{"type": "FeatureCollection", "features": [{"geometry": {"type": "Circle"}}]}': "feature 0 has a broken geometry",
    '{"type": "FeatureCollection", "features": [{"geometry": {"type": "Polygon", "coordinates": [[[1]]]}}]}': "broken",
    '{"type": "FeatureCollection", "features": [{"geometry": {"type": "Point", "coordinates": [5e5, 5e6]}}]}': "broken",
    '{"type": "FeatureCollection", "features": [], "crs": {"name": "EPSG:3857"}}': "reproject it to EPSG:4326",
    '\x1e{"type": "Feature"}\n': "is a sequence of features: make one FeatureCollection",
    '{"type": "Feature"}\n{"type": "Feature"}\n': "is a sequence of features: make one FeatureCollection",
}


@pytest.mark.parametrize(
    ("crs", "is_lonlat"),
    [
        ({"type": "name", "properties": {"name": "urn:ogc:def:crs:OGC:1.3:CRS84"}}, True),
        ({"properties": {"name": "urn:ogc:def:crs:OGC:1.3:CRS84"}, "type": "name"}, True),
        ({"type": "EPSG", "properties": {"code": 4326}}, True),
        ({"type": "name", "properties": {"name": "EPSG:14326"}}, False),
        ({"type": "link", "properties": {"href": "https://example.org/4326"}}, False),
        ({"type": "name", "properties": None}, False),
    ],
)
def test_longitude_and_latitude_have_many_names(crs, is_lonlat, tmp_path):
    path = written(tmp_path / "a.geojson", feature(HOUSE), crs=crs)
    if is_lonlat:
        assert len(read(path).features) == 1
        return
    with pytest.raises(ExtractError, match="reproject it to EPSG:4326"):
        read(path)


@pytest.mark.parametrize("text", BAD)
def test_a_broken_file_is_refused_in_one_line(text, tmp_path):
    (tmp_path / "bad.geojson").write_text(text)
    with pytest.raises(ExtractError, match=BAD[text]) as found:
        read(tmp_path / "bad.geojson")
    assert "bad.geojson" in str(found.value)


def test_a_region_of_geojson_must_say_its_classes_which_are_some_and_where_it_is_complete(tmp_path):
    hamlet = make_hamlet(tmp_path)
    content = hamlet.spec().model_dump()
    for lacking in ("classes", "coverage_parts_lonlat"):
        with pytest.raises(ValueError, match="say which by classes and by coverage_lonlat or coverage_parts"):
            type(hamlet.spec())(**{name: value for name, value in content.items() if name != lacking})
    content = make_hamlet(tmp_path).spec().model_dump() | {"classes": ["buildings"]}
    with pytest.raises(ConfigError, match="'buildings', which is no class: there are road_major"):
        check_document(content, RegionFile, source="hamlet.toml")


def test_a_further_file_is_found_like_the_first_and_is_part_of_the_region(tmp_path):
    hamlet = make_hamlet(tmp_path / "place")
    write_houses(tmp_path / "place" / "more.geojson", [HOUSE])
    part = ExtractPart(file="more.geojson", sha256=(sha256_of(tmp_path / "place" / "more.geojson"),))
    extract = hamlet.spec().pick(None).model_copy(update={"also": (part,)})
    assert find_parts(extract, folders=[tmp_path / "place"]) == (tmp_path / "place" / "more.geojson",)
    with pytest.raises(ExtractError, match=r"more.geojson .* was not found"):
        find_parts(extract, folders=[tmp_path])
