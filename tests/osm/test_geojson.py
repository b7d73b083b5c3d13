# SPDX-License-Identifier: Apache-2.0
"""Maps from GeoJSON: houses of OpenStreetMap in labelled places; whatever else is there is unknown."""

import json

import pytest
import shapely

from sasgeo_bench.config import check_document
from sasgeo_bench.errors import ConfigError, CoverageError, ExtractError
from sasgeo_bench.files.folders import sha256_of
from sasgeo_bench.geometry.grid import Grid
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


def test_several_files_are_one_map_and_an_object_of_both_is_taken_once(tmp_path):
    first = written(tmp_path / "a.geojson", feature(HOUSE, osm_id=7), feature(SHED))
    second = written(tmp_path / "b.geojson", feature(HOUSE, osm_id=7), feature(SHED, osm_id=8))
    reading = read(first, second)
    assert sorted(reading.features["osm_id"]) == [-2, 7, 8]
    assert reading.notes == {
        "feature without the id of an object": 1,
        "object that stands there twice, taken once": 1,
    }


def test_a_crossing_ring_is_mended_and_a_feature_without_geometry_counted(tmp_path):
    bow = shapely.Polygon([(WEST, SOUTH), (WEST + 20, SOUTH + 20), (WEST + 20, SOUTH), (WEST, SOUTH + 20)])
    empty = {"type": "Feature", "properties": {}, "geometry": None}
    reading = read(written(tmp_path / "a.geojson", feature(bow), empty))
    assert reading.features.geometry.is_valid.all()
    assert reading.drops == {"feature without a geometry": 1}


BAD = {
    "": "cannot be read as GeoJSON",
    "{": "cannot be read as GeoJSON",
    "null": "no GeoJSON FeatureCollection",
    '{"type": "Feature"}': "no GeoJSON FeatureCollection",
    '{"type": "FeatureCollection", "features": [7]}': "feature 0 has a broken geometry",
    '{"type": "FeatureCollection", "features": [{"geometry": {"type": "Circle"}}]}': "feature 0 has a broken geometry",
    '{"type": "FeatureCollection", "features": [{"geometry": {"type": "Polygon", "coordinates": [[[1]]]}}]}': "broken",
    '{"type": "FeatureCollection", "features": [{"geometry": {"type": "Point", "coordinates": [5e5, 5e6]}}]}': "broken",
    '{"type": "FeatureCollection", "features": [], "crs": {"name": "EPSG:3857"}}': "reproject it to EPSG:4326",
}


@pytest.mark.parametrize("text", BAD)
def test_a_broken_file_is_refused_in_one_line(text, tmp_path):
    (tmp_path / "bad.geojson").write_text(text)
    with pytest.raises(ExtractError, match=BAD[text]) as found:
        read(tmp_path / "bad.geojson")
    assert "bad.geojson" in str(found.value)


def test_a_map_without_any_house_is_refused(tmp_path):
    far = shapely.box(WEST + 500, SOUTH, WEST + 510, SOUTH + 10)
    with pytest.raises(CoverageError, match="holds no element of class building within"):
        read(written(tmp_path / "a.geojson", feature(far)))


def test_a_region_of_geojson_must_say_its_classes_and_where_it_is_complete(tmp_path):
    hamlet = make_hamlet(tmp_path)
    content = hamlet.spec().model_dump()
    for lacking in ("classes", "coverage_parts_lonlat"):
        with pytest.raises(ValueError, match="say which by classes and coverage_parts_lonlat"):
            type(hamlet.spec())(**{name: value for name, value in content.items() if name != lacking})


def test_a_class_that_is_none_is_refused(tmp_path):
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
