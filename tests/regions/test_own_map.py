# SPDX-License-Identifier: Apache-2.0
"""A map of one's own beside OpenStreetMap: each class is from one source, and both are named wherever one is."""

from pathlib import Path

import geopandas as gpd
import numpy as np
import pyarrow.parquet as pq
import pytest
import rasterio
import rasterio.features
import shapely
from affine import Affine
from numpy.typing import NDArray

from sasgeo_bench.core.config import parse_toml
from sasgeo_bench.core.errors import ConfigError, ExtractError, ImageryError, StoreError
from sasgeo_bench.core.folders import sha256_of
from sasgeo_bench.geometry.projection import from_lonlat, to_lonlat
from sasgeo_bench.regions.build import build_region, plan_build
from sasgeo_bench.regions.region import ATTRIBUTION, Region
from sasgeo_bench.regions.region_files import check_publishable, read_manifest, read_region
from sasgeo_bench.regions.region_spec import RegionFile, list_region_files, read_region_file
from tests.regions.imagery_place import write_houses

EPSG, WEST, SOUTH, SIDE_M = 32632, 500_000.0, 5_210_000.0, 512.0  # as of `write_houses`
INNER = shapely.box(WEST + 32, SOUTH + 32, WEST + SIDE_M - 32, SOUTH + SIDE_M - 32)
HOUSES = [
    shapely.box(WEST + x, SOUTH + y, WEST + x + 14, SOUTH + y + 10)
    for x in range(20, 480, 60)
    for y in range(20, 480, 60)
]
CREDIT = "building: a land survey (CC0-1.0)"
OWN = """
[[own_map]]
file = "survey.geojson"
sha256 = ["{sha256}"]
classes = {classes}
tags = {{ building = "yes" }}
licence = "CC0-1.0"
attribution = "a land survey"
publish = {publish}
"""


def lonlat(shape: shapely.Geometry) -> shapely.Geometry:
    back = to_lonlat(EPSG)
    return shapely.transform(shape, lambda at: np.column_stack(back.transform(*at.T)))


def text_of(*own: str, classes: str = '["road_major", "road_minor", "building"]', has_ring: bool = True) -> str:
    """A region file: an embedded town, and maps of one's own beside it."""
    middle = lonlat(shapely.box(WEST, SOUTH, WEST + SIDE_M, SOUTH + SIDE_M).centroid)
    ring = [list(corner) for corner in lonlat(INNER).exterior.coords[:-1]]
    return f"""
id = "mine"
title = "A town and a survey"
scenes = ["suburban"]
center_lonlat = [{middle.x}, {middle.y}]
size_m = [{SIDE_M}, {SIDE_M}]
cell_size_m = 1.0
epsg = {EPSG}
classes = {classes}
{f"coverage_lonlat = {ring}" if has_ring else ""}
[[extract]]
file = "town.osm.pbf"
date = 2024-01-01
town = {{ morphology = "suburb", seed = 3, size_m = {SIDE_M} }}
{"".join(own)}"""


def spec_of(*own: str, **changes: object) -> RegionFile:
    return parse_toml(text_of(*own, **changes), RegionFile, source="mine.toml")


def own_of(folder: Path, *, classes: str = '["building"]', publish: str = "true") -> str:
    """A map of one's own, with its file."""
    write_houses(folder / "survey.geojson", HOUSES)
    return OWN.format(sha256=sha256_of(folder / "survey.geojson"), classes=classes, publish=publish)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of the survey."""
    return tmp_path_factory.mktemp("survey")


@pytest.fixture(scope="module")
def spec(folder: Path) -> RegionFile:
    return spec_of(own_of(folder))


@pytest.fixture(scope="module")
def built(spec: RegionFile, folder: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    plan = plan_build(spec, out=tmp_path_factory.mktemp("out"), extract_folders=[folder], with_preview=True)
    build_region(plan)
    return plan.folder


def test_its_classes_are_its_own_and_the_others_those_of_the_extract(built, tmp_path):
    region = read_region(built)
    grid = region.grid
    transform = Affine(*grid.transform)
    seen = [shapely.intersection(house, INNER) for house in HOUSES if house.intersects(INNER)]
    expected = rasterio.features.rasterize(seen, out_shape=grid.shape, transform=transform)
    known = rasterio.features.geometry_mask([INNER], out_shape=grid.shape, transform=transform, invert=True)
    buildings = region.layer("building")
    assert (buildings[~known] == 255).all()
    assert (buildings[known] == expected[known]).all()
    assert len(region.features[region.features["class"] == "building"]) == len(HOUSES)
    alone = plan_build(spec_of(classes='["road_major", "road_minor"]'), out=tmp_path)
    build_region(alone)
    roads = read_region(alone.folder)
    for name in ("road_major", "road_minor"):
        assert (region.layer(name) == roads.layer(name)).all()
    assert (region.layer("road_minor") == 1).any()
    assert region.classes == ("road_major", "road_minor", "building")


def test_it_is_named_wherever_openstreetmap_is(built):
    manifest, credit = read_manifest(built), f"{ATTRIBUTION}; {CREDIT}"
    assert manifest.attribution == credit
    assert manifest.provenance.further_sources == CREDIT
    assert manifest.licence == "ODbL-1.0"
    (own,) = manifest.own_maps
    assert (own.classes, own.licence, own.attribution, own.date) == (("building",), "CC0-1.0", "a land survey", None)
    assert own.file == "survey.geojson"
    with rasterio.open(built / "layers.tif") as layers:
        assert layers.tags()["attribution"] == layers.tags()["TIFFTAG_COPYRIGHT"] == credit
    for name in ("features", "nodes", "edges"):
        metadata = pq.read_schema(built / f"{name}.parquet").metadata
        assert any(CREDIT.encode() in value for value in metadata.values()), name
    assert CREDIT.encode() in (built / "preview.png").read_bytes()


def test_it_is_an_input_of_the_region(spec, folder, built):
    out = built.parent.parent
    assert plan_build(spec, out=out, extract_folders=[folder]).is_current
    other = spec.model_copy(update={"own_map": [spec.own_map[0].model_copy(update={"attribution": "another"})]})
    assert not plan_build(other, out=out, extract_folders=[folder]).is_current
    assert "survey.geojson" in plan_build(spec, out=out, extract_folders=[folder]).to_text()
    with pytest.raises(ExtractError, match=r"^survey\.geojson \(SHA-256 .*\) was not found: put it into"):
        plan_build(spec, out=out)


def test_a_map_that_must_not_be_passed_on_is_refused(folder, tmp_path):
    plan = plan_build(spec_of(own_of(folder, publish="false")), out=tmp_path, extract_folders=[folder])
    with pytest.raises(StoreError, match=r"survey\.geojson, whose region file says publish = false .*: leave mine out"):
        check_publishable(plan.folder, build_region(plan))


@pytest.mark.parametrize(
    ("own", "changes", "fault"),
    [
        (['["building"]', '["building"]'], {}, "gives 'building' twice: a class is from one source"),
        (['["water"]'], {}, "gives 'water', which `classes` lacks: add it there"),
        (['["building"]'], {"has_ring": False}, "say where they and the extract are complete by coverage_lonlat"),
        (['["building"]'], {"classes": '["building"]'}, "gives every class: leave one to"),
        (['["bulding"]'], {}, "classes has 'bulding', which is no class"),
        (["[]"], {}, "say what the features of 'survey.geojson' are: class"),
    ],
)
def test_what_it_cannot_be_is_refused_in_a_line(own, changes, fault, folder):
    with pytest.raises(ConfigError) as found:
        spec_of(*(own_of(folder, classes=classes) for classes in own), **changes)
    assert fault in str(found.value)
    assert "\n" not in str(found.value)


TABLE = """
[[own_map]]
file = "survey.gpkg"
sha256 = ["{sha256}"]
date = 2023-05-06
layer = "ground"
column = "use"
licence = "CC-BY-4.0"
attribution = "a land survey"
publish = true
[own_map.values]
house = "building"
pond = "water"
"""
OWN_EXTRACT = f'[[extract]]\nfile = "a"\ndate = 2024-01-01\nformat = "own_map"\nsha256 = ["{"0" * 64}"]\n'
POND = shapely.box(WEST + 200, SOUTH + 205, WEST + 240, SOUTH + 235)


def survey_of(folder: Path) -> str:
    """A GeoPackage of two classes in another CRS, and the lines that name it."""
    uses = ["house"] * len(HOUSES) + ["pond", "vineyard"]
    shapes = [*HOUSES, POND, shapely.box(WEST + 400, SOUTH + 400, WEST + 410, SOUTH + 410)]
    ground = gpd.GeoDataFrame({"use": uses}, geometry=shapes, crs=EPSG)
    ground.to_crs(3035).to_file(folder / "survey.gpkg", layer="ground")
    return TABLE.format(sha256=sha256_of(folder / "survey.gpkg"))


@pytest.fixture(scope="module")
def alone(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A region of nothing but a land survey."""
    folder = tmp_path_factory.mktemp("alone")
    text = text_of(survey_of(folder), classes="[]").replace("classes = []\n", "")
    begin, end = text.index("[[extract]]"), text.index("[[own_map]]")
    spec = parse_toml(text[:begin] + text[end:], RegionFile, source="mine.toml")
    plan = plan_build(spec, out=folder / "out", extract_folders=[folder])
    build_region(plan)
    assert plan_build(spec, out=folder / "out", extract_folders=[folder]).is_current
    return plan.folder


def burnt(region: Region, shapes: list[shapely.Geometry]) -> NDArray[np.uint8]:
    """Cells whose middle a shape holds, and 255 where nothing is mapped."""
    transform = Affine(*region.grid.transform)
    inside = [part for shape in shapes if not (part := shapely.intersection(shape, INNER)).is_empty]
    found = rasterio.features.rasterize(inside, out_shape=region.grid.shape, transform=transform)
    known = rasterio.features.geometry_mask([INNER], out_shape=region.grid.shape, transform=transform, invert=True)
    return np.where(known, found, 255).astype(np.uint8)


def test_a_table_of_classes_fills_them_from_one_layer_and_all_others_are_of_the_extract(tmp_path):
    spec = spec_of(survey_of(tmp_path), classes='["road_major", "road_minor", "building", "water"]')
    assert spec.extract_classes == ("road_major", "road_minor")
    manifest = build_region(plan_build(spec, out=tmp_path / "out", extract_folders=[tmp_path]))
    region = read_region(tmp_path / "out" / "regions" / "mine")
    for name, shapes in (("building", HOUSES), ("water", [POND])):
        different = region.layer(name) != burnt(region, shapes)
        assert different.sum() < 10, name  # corners of the mapped area are rounded to a millimetre
    assert (region.layer("road_minor") == 1).any()
    assert manifest.drops["use=vineyard: not in `values`"] == 1
    assert any("1 of 66 features in the region have no class" in warning for warning in manifest.warnings)
    assert manifest.own_maps[0].classes == ("building", "water")
    assert manifest.attribution == f"{ATTRIBUTION}; building, water: a land survey (CC-BY-4.0)"


def test_alone_it_is_the_map_with_its_own_date_licence_and_credit(alone):
    region, manifest = read_region(alone), read_manifest(alone)
    assert region.classes == ("building", "water")
    assert manifest.extract.date.isoformat() == "2023-05-06"
    assert (manifest.licence, manifest.attribution) == ("CC-BY-4.0", "building, water: a land survey (CC-BY-4.0)")
    assert manifest.counts == {"building": len(HOUSES), "water": 1}
    for name, shapes in (("building", HOUSES), ("water", [POND])):
        assert (region.layer(name) != burnt(region, shapes)).sum() < 10, name
    with rasterio.open(alone / "layers.tif") as layers:
        assert layers.tags()["licence"] == "CC-BY-4.0"
    for name in ("features", "nodes", "edges"):
        text = str(pq.read_schema(alone / f"{name}.parquet").metadata)
        assert "CC-BY-4.0" in text, name
        assert "OpenStreetMap" not in text, name


@pytest.mark.parametrize(
    ("old", "new", "fault"),
    [
        ("date = 2023-05-06\n", "", "without an [[extract]] the first [[own_map]] needs a date"),
        (
            'id = "mine"',
            'id = "mine"\nclasses = ["road_minor", "building", "water"]',
            "no [[own_map]] gives road_minor",
        ),
        ("column", 'class = "water"\ncolumn', "say which class its features are by class"),
        ("column", 'tags = { building = "yes" }\ncolumn', "classes and tags are of a GeoJSON of tags"),
        ('column = "use"\n', "", "say which class its features are by class"),
        (
            "[[own_map]]",
            '[[extract]]\nfile = "a"\ndate = 2024-01-01\n[[own_map]]',
            "needs either sha256 = [...] or town",
        ),
        ("[[own_map]]", f"{OWN_EXTRACT}[[own_map]]", "format 'own_map' is of no [[extract]]"),
    ],
)
def test_a_region_of_it_alone_that_cannot_be_is_refused_in_a_line(old, new, fault, tmp_path):
    text = text_of(survey_of(tmp_path), classes="[]").replace("classes = []\n", "")
    text = text[: text.index("[[extract]]")] + text[text.index("[[own_map]]") :]
    assert old in text
    with pytest.raises(ConfigError) as found:
        parse_toml(text.replace(old, new, 1), RegionFile, source="mine.toml")
    assert fault in str(found.value)
    assert "\n" not in str(found.value)


@pytest.mark.slow
@pytest.mark.real
def test_koeln_has_roads_of_one_source_and_buildings_of_another_and_without_it_none(tmp_path):
    specs = [read_region_file(list_region_files()[name]) for name in ("koeln-ortho", "koeln-ortho-osm")]
    try:
        both, alone = (build_region(plan_build(spec, out=tmp_path)) for spec in specs)
    except (ExtractError, ImageryError) as error:
        pytest.skip(f"real imagery: {error}")
    assert both.attribution == f"{ATTRIBUTION}; building: Geobasis NRW, LoD2 (dl-de/zero-2-0)"
    assert alone.attribution == ATTRIBUTION
    assert both.counts["building"] > 400
    assert {name: both.counts[name] for name in alone.classes} == alone.counts
    assert "building" not in alone.classes
    assert max(abs(both.imagery.offset.east_m), abs(both.imagery.offset.north_m)) < 0.5
    assert both.imagery.offset.residual_90_m < 1.5
    assert alone.imagery.offset is None  # roads have no walls
    x, y = from_lonlat(both.epsg).transform(6.9720, 50.9390)
    assert not shapely.from_wkt(both.coverage.wkt).contains(shapely.Point(x, y))
