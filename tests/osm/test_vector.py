# SPDX-License-Identifier: Apache-2.0
"""Maps of one's own in the usual formats: the same features from each, in any CRS, by a table of classes."""

import json
import shutil
import sqlite3
import subprocess
import warnings
import zipfile
from pathlib import Path

import geopandas as gpd
import numpy as np
import pandas as pd
import pyarrow.parquet as pq
import pyproj
import pytest
import shapely
from shapely import affinity

from sasgeo_bench.core.config import parse_toml
from sasgeo_bench.core.errors import ConfigError, CoverageError, ExtractError
from sasgeo_bench.geometry.grid import Grid
from sasgeo_bench.osm import vector
from sasgeo_bench.osm.locate import ClassTable, imagery_folders, named_files
from sasgeo_bench.osm.read import read_vector
from sasgeo_bench.osm.taxonomy import load_taxonomy
from sasgeo_bench.regions.layers import burn

EPSG, WEST, SOUTH, SIDE_M = 32632, 500_000.0, 5_210_000.0, 200
GRID = Grid(epsg=EPSG, west_m=WEST, north_m=SOUTH + SIDE_M, cell_size_m=1.0, rows=SIDE_M, cols=SIDE_M)
EVERYWHERE = shapely.box(8.9, 46.9, 9.1, 47.2)


def at(shape: shapely.Geometry) -> shapely.Geometry:
    """Move a shape from the corner of the grid to its place."""
    return affinity.translate(shape, WEST, SOUTH)


HOUSE = at(shapely.box(10, 10, 30, 20))
COURT = at(shapely.box(100, 100, 140, 130).difference(shapely.box(110, 110, 130, 120)))
ROWS = at(shapely.MultiPolygon([shapely.box(50, 50, 60, 60), shapely.box(70, 50, 80, 60)]))
POND = at(affinity.rotate(shapely.box(150, 20, 180, 50), 30))
TRACK = at(shapely.LineString([(0, 180), (100, 185), (200, 180)]))
FAR = at(shapely.box(5000, 5000, 5010, 5010))
MAP = gpd.GeoDataFrame(
    {"use": ["house", "pond", "house", "track", "house", "house"], "wide_m": [0, 0, 0, 3.5, 0, 0]},
    geometry=[HOUSE, POND, COURT, TRACK, ROWS, FAR],
    crs=EPSG,
)
TABLE = 'column = "use"\nvalues = { house = "building", pond = "water", track = "road_minor" }'


def table(text: str = 'class = "building"') -> ClassTable:
    return parse_toml(text, ClassTable, source="[[own_map]]")


def read(path, text='class = "building"', grid=GRID, stated=EVERYWHERE):
    return read_vector(path, grid, table=table(text), stated_coverage=stated)


def frame(*shapes, crs=EPSG, **columns):
    return gpd.GeoDataFrame(columns, geometry=list(shapes), crs=crs)


def saved(path: Path, features: gpd.GeoDataFrame, **more: object) -> Path:
    if path.suffix == ".parquet":
        features.to_parquet(path, **more)
    elif path.suffix == ".geojson":
        path.write_text(features.to_json(drop_id=True, to_wgs84=features.crs.to_epsg() == 4326))
    else:
        driver = "ESRI Shapefile" if path.suffix == ".zip" else None
        features.to_file(path, driver=driver, **more)
    return path


FORMATS = {
    "a.gpkg": {},
    "a.fgb": {"SPATIAL_INDEX": "YES"},
    "plain.fgb": {"SPATIAL_INDEX": "NO"},
    "a.parquet": {},
    "boxed.parquet": {"write_covering_bbox": True},
    "a.geojson": {},
}


@pytest.mark.parametrize("name", FORMATS)
def test_every_format_gives_the_same_features_in_the_same_order(name, tmp_path):
    more = "\nepsg = 32632" if name.endswith("geojson") else ""
    found = read(saved(tmp_path / name, MAP, **FORMATS[name]), f'{TABLE}\nwidth_column = "wide_m"{more}').features
    expected = [("road_minor", TRACK), ("building", HOUSE), ("building", ROWS), ("building", COURT), ("water", POND)]
    assert found["class"].tolist() == [name for name, _ in expected]
    for shape, (_, wanted) in zip(found.geometry, expected, strict=True):
        assert shapely.hausdorff_distance(shape, wanted) < 0.002
        assert shapely.area(shape) == pytest.approx(wanted.area, abs=0.1)
    assert found["osm_id"].tolist() == [-5, -4, -3, -2, -1]  # none of OpenStreetMap, which are positive
    assert found["width_m"].tolist()[0] == 3.5
    assert found["width_m"].isna().tolist() == [False, True, True, True, True]


def test_a_parquet_of_arrow_geometries_is_read(tmp_path):
    path = saved(tmp_path / "a.parquet", frame(HOUSE, COURT), geometry_encoding="geoarrow")
    found = read(path).features
    assert [shape.area for shape in found.geometry] == pytest.approx([200, 1000], abs=0.1)


def test_a_parquet_that_says_nothing_of_its_crs_is_longitude_and_latitude(tmp_path):
    written = pq.read_table(saved(tmp_path / "a.parquet", frame(HOUSE).to_crs(4326)))
    about = json.loads(written.schema.metadata[b"geo"])
    del about["columns"]["geometry"]["crs"]
    pq.write_table(written.replace_schema_metadata({"geo": json.dumps(about)}), tmp_path / "b.parquet")
    (found,) = read(tmp_path / "b.parquet").features.geometry
    assert shapely.hausdorff_distance(found, HOUSE) < 0.01


def test_a_zipped_shapefile_has_one_kind_of_geometry_and_is_read_by_its_prj(tmp_path):
    areas = MAP[MAP.geom_type != "LineString"].to_crs(3857)
    found = read(saved(tmp_path / "a.shp.zip", areas), 'column = "use"\nvalues = { house = "building" }')
    assert len(found.features) == 3
    assert shapely.hausdorff_distance(found.features.geometry.iloc[0], HOUSE) < 0.01
    assert found.drops == {"use=pond: not in `values`": 1}


@pytest.mark.parametrize("epsg", [4326, 3857, 25832, 32633, 3035])
@pytest.mark.parametrize("name", ["a.gpkg", "a.fgb", "a.parquet"])
def test_places_are_right_whatever_the_crs_and_the_order_of_its_axes(epsg, name, tmp_path):
    found = read(saved(tmp_path / name, frame(HOUSE, COURT).to_crs(epsg))).features
    for shape, wanted in zip(found.geometry, (HOUSE, COURT), strict=True):
        assert shapely.hausdorff_distance(shape, wanted) < 0.01
    assert shapely.get_num_interior_rings(found.geometry.iloc[1]) == 1


def ogr2ogr(*arguments: object) -> None:
    """Run the program of another GDAL than that of the libraries."""
    program = shutil.which("ogr2ogr")
    if program is None:
        pytest.skip("ogr2ogr is not on this machine")
    subprocess.run([program, *map(str, arguments)], check=True, capture_output=True)  # noqa: S603 - our own arguments


@pytest.mark.parametrize(("target", "driver"), [("b.gpkg", "GPKG"), ("b.fgb", "FlatGeobuf")])
@pytest.mark.parametrize("epsg", [4326, 4258, 3857])
def test_files_of_ogr2ogr_give_what_plain_shapely_says(target, driver, epsg, tmp_path):
    source = saved(tmp_path / "a.gpkg", MAP[MAP.geom_type != "LineString"])
    ogr2ogr("-f", driver, "-t_srs", f"EPSG:{epsg}", "-nlt", "PROMOTE_TO_MULTI", tmp_path / target, source)
    found = read(tmp_path / target, 'column = "use"\nvalues = { house = "building", pond = "water" }').features
    assert sorted(shapely.area(found.geometry)) == pytest.approx(sorted([200, 1000, 200, 900]), abs=0.2)


def test_curves_of_a_land_survey_come_as_straight_pieces(tmp_path):
    x, y = WEST + 100, SOUTH + 100
    ring = f"{x - 20} {y},{x} {y + 20},{x + 20} {y},{x} {y - 20},{x - 20} {y}"
    (tmp_path / "a.csv").write_text(f'id,WKT\n1,"CURVEPOLYGON(CIRCULARSTRING({ring}))"\n')
    files = (tmp_path / "a.gpkg", tmp_path / "a.csv")
    ogr2ogr("-f", "GPKG", *files, "-oo", "GEOM_POSSIBLE_NAMES=WKT", "-a_srs", f"EPSG:{EPSG}")
    (shape,) = read(tmp_path / "a.gpkg").features.geometry
    assert shape.area == pytest.approx(np.pi * 400, rel=0.002)


def test_between_datums_coordinates_never_go_through_wgs_84(tmp_path):
    """GDA94 lies 1.49 m from GDA2020, and WGS 84 is taken for both."""
    x, y = 320_000.0, 5_812_000.0
    house = shapely.box(x, y, x + 20, y + 10)
    to_new = pyproj.Transformer.from_crs(28355, 7855, always_xy=True)
    moved = shapely.transform(house, lambda place: np.column_stack(to_new.transform(*place.T)))
    grid = Grid(epsg=7855, west_m=x - 90, north_m=y + 110, cell_size_m=1.0, rows=200, cols=200)
    path = saved(tmp_path / "a.gpkg", frame(house, crs=28355))
    (found,) = read(path, grid=grid, stated=shapely.box(144, -39, 146, -37)).features.geometry
    assert shapely.hausdorff_distance(found, moved) < 0.002
    assert shapely.distance(found.centroid, house.centroid) == pytest.approx(1.49, abs=0.3)


def test_a_datum_shift_that_lacks_its_grid_is_said(tmp_path):
    north = SOUTH + 440_000  # in Germany, where DHDN is used
    house = affinity.translate(HOUSE, 0, 440_000)
    grid = Grid(epsg=EPSG, west_m=WEST, north_m=north + 200, cell_size_m=1.0, rows=200, cols=200)
    stated = shapely.box(8, 50, 10, 52)
    known = pyproj.transformer.AreaOfInterest(9.0, 51.0, 9.01, 51.01)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)
        group = pyproj.transformer.TransformerGroup(31467, EPSG, always_xy=True, area_of_interest=known)
    if group.best_available:
        pytest.skip("the grid BETA2007 is on this machine")
    path = saved(tmp_path / "a.gpkg", frame(house).to_crs(31467))
    (said,) = read(path, grid=grid, stated=stated).warnings
    error_m = f"{group.transformers[0].accuracy:g} m"
    assert f"Gauss-Kruger zone 3 to EPSG:32632 with an error of about {error_m} (" in said
    assert "a better way needs 1 grid (de_adv_BETA2007.tif) (projsync)" in said
    rough = saved(tmp_path / "b.gpkg", frame(HOUSE).to_crs(31467))  # in Switzerland, where it is not
    assert "to EPSG:32632 with an unknown error" in read(rough).warnings[0]
    assert read(saved(tmp_path / "c.gpkg", frame(HOUSE).to_crs(25832))).warnings == ()


@pytest.mark.parametrize("name", ["a.gpkg", "a.fgb", "a.parquet"])
def test_a_file_without_a_crs_asks_for_it_in_one_line(name, tmp_path):
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # that it has none
        bare = saved(tmp_path / name, gpd.GeoDataFrame({"geometry": [HOUSE]}))
    with pytest.raises(ExtractError, match=r"states no coordinate reference system.*epsg = \.\.\. in its \[\[own_map"):
        read(bare)
    (found,) = read(bare, 'class = "building"\nepsg = 32632').features.geometry
    assert shapely.hausdorff_distance(found, HOUSE) < 0.002


def test_an_epsg_that_contradicts_the_file_is_refused(tmp_path):
    path = saved(tmp_path / "a.gpkg", frame(HOUSE))
    with pytest.raises(ExtractError, match=r"states EPSG:32632, its \[\[own_map\]\] epsg = 25832: leave that out"):
        read(path, 'class = "building"\nepsg = 25832')


def mercator(tmp_path, **more):
    shapes = frame(HOUSE).to_crs(3857).geometry
    features = [
        {"type": "Feature", "properties": None, "geometry": shapely.geometry.mapping(shape)} for shape in shapes
    ]
    path = tmp_path / "a.geojson"
    path.write_text(json.dumps({"type": "FeatureCollection", "features": features, **more}))
    return path


NAMED = {"crs": {"type": "name", "properties": {"name": "urn:ogc:def:crs:EPSG::3857"}}}


@pytest.mark.parametrize("more", [{}, NAMED])
def test_geojson_in_metres_is_read_only_where_the_region_file_says_so(more, tmp_path):
    with pytest.raises(ExtractError, match=r"longitude"):
        read(mercator(tmp_path, **more))
    (found,) = read(mercator(tmp_path, **more), 'class = "building"\nepsg = 3857').features.geometry
    assert shapely.hausdorff_distance(found, HOUSE) < 0.01
    if more:
        with pytest.raises(ExtractError, match=r"its \[\[own_map\]\] says epsg = 32632"):
            read(mercator(tmp_path, **more), 'class = "building"\nepsg = 32632')


def test_codes_of_64_bits_stay_whole_where_a_feature_lacks_them(tmp_path):
    features = [
        {"type": "Feature", "properties": values, "geometry": shapely.geometry.mapping(shape)}
        for values, shape in (({"code": 2**53 + 1}, HOUSE), ({}, ROWS), ({"code": 2**53}, COURT))
    ]
    path = tmp_path / "a.geojson"
    path.write_text(json.dumps({"type": "FeatureCollection", "features": features}))
    reading = read(path, f'epsg = 32632\ncolumn = "code"\nvalues = {{ {2**53 + 1} = "building" }}')
    assert shapely.hausdorff_distance(reading.features.geometry.iloc[0], HOUSE) < 0.002
    assert reading.drops == {"code=nothing: not in `values`": 1, f"code={2**53}: not in `values`": 1}


@pytest.mark.parametrize("name", ["a.gpkg", "a.fgb", "a.parquet"])
def test_building_no_is_none_and_what_the_table_does_not_name_is_counted_and_said(name, tmp_path):
    path = saved(tmp_path / name, frame(HOUSE, COURT, ROWS, POND, building=["yes", "no", None, "no"]))
    reading = read(path, 'column = "building"\nvalues = { yes = "building" }')
    assert len(reading.features) == 1
    assert reading.drops == {"building=no: not in `values`": 2, "building=nothing: not in `values`": 1}
    (warning,) = reading.warnings
    reasons = "2 x building=no: not in `values`, 1 x building=nothing: not in `values`"
    assert warning == f"{name}: 3 of 4 features in the region have no class ({reasons})"


def test_whole_numbers_are_named_without_a_fraction(tmp_path):
    path = saved(tmp_path / "a.gpkg", frame(HOUSE, POND, code=[31001, None]))
    assert path.exists()
    assert len(read(path, 'column = "code"\nvalues = { 31001 = "building" }').features) == 1


@pytest.mark.parametrize("name", ["a.gpkg", "plain.fgb", "a.parquet"])
def test_features_without_geometry_are_passed_over(name, tmp_path):
    options = {"a.gpkg": {"SPATIAL_INDEX": "NO"}, "plain.fgb": {"SPATIAL_INDEX": "NO"}}.get(name, {})
    path = saved(tmp_path / name, frame(HOUSE, None, COURT, shapely.Polygon(), use=["a", "b", "c", "d"]), **options)
    found = read(path, 'column = "use"\nvalues = { a = "building", b = "building", c = "building" }').features
    assert [shape.area for shape in found.geometry] == pytest.approx([200, 1000], abs=0.1)


def test_heights_and_measures_are_dropped(tmp_path):
    tall = shapely.force_3d(HOUSE, 450.0)
    assert tall.has_z
    (found,) = read(saved(tmp_path / "a.gpkg", frame(tall))).features.geometry
    assert not found.has_z
    assert shapely.hausdorff_distance(found, HOUSE) < 0.002


def test_of_a_mixed_geometry_the_areas_are_taken_and_points_and_lines_of_areas_counted(tmp_path):
    mixed = shapely.GeometryCollection([HOUSE, TRACK, at(shapely.Point(5, 5))])
    path = saved(tmp_path / "a.gpkg", frame(mixed, at(shapely.Point(9, 9)), TRACK))
    reading = read(path)
    (found,) = reading.features.geometry
    assert found.geom_type == "Polygon"
    assert found.area == pytest.approx(200, abs=0.1)
    assert reading.drops == {"Point of class building": 1, "LineString of class building": 1}
    assert reading.notes == {"geometry of several kinds, of which one was taken": 1}


def test_crossing_rings_are_mended_and_the_area_before_and_after_said(tmp_path):
    bow = at(shapely.Polygon([(0, 0), (20, 20), (20, 0), (0, 20)]))
    spike = at(shapely.Polygon([(50, 50), (60, 50), (60, 60), (60, 80), (60, 60), (50, 60)]))
    reading = read(saved(tmp_path / "a.gpkg", frame(bow, spike, HOUSE)))
    assert reading.features.geometry.is_valid.all()
    assert sorted(reading.features.area.round(1)) == [100.0, 200.0, 200.0]
    assert reading.warnings == (
        "a.gpkg: 2 shapes with crossing rings mended: 100.0 m2 before, 300.0 m2 after",
    )  # the lobes of a bow have areas of two signs


def test_a_ring_without_an_inside_is_counted(tmp_path):
    flat = at(shapely.Polygon([(0, 0), (20, 0), (40, 0)]))
    reading = read(saved(tmp_path / "a.gpkg", frame(flat, HOUSE)))
    assert len(reading.features) == 1
    assert reading.drops == {"shape without an inside": 1}


def test_a_sliver_covers_the_cells_whose_middle_it_holds_and_stays_a_feature(tmp_path):
    slivers = [
        at(shapely.box(40.1, 10, 40.4, 60)),
        at(shapely.box(60.4, 10, 60.6, 60)),
        at(shapely.box(80, 7.3, 99, 8.6)),
    ]
    found = read(saved(tmp_path / "a.fgb", frame(*slivers))).features
    assert len(found) == 3
    middles = np.meshgrid(WEST + np.arange(SIDE_M) + 0.5, SOUTH + SIDE_M - np.arange(SIDE_M) - 0.5)
    expected = shapely.contains_xy(shapely.union_all(slivers), *middles)
    assert (burn(found.geometry.to_numpy(), GRID) == expected).all()
    assert expected.sum() == 50 + 2 * 19


def test_lines_have_the_width_of_their_class_or_their_own_and_areas_of_roads_are_filled(tmp_path):
    verge = at(shapely.LineString([(0, 150), (200, 150)]))
    square = at(shapely.box(20, 100, 60, 140))
    features = frame(TRACK, verge, square, road=["lane", "lane", "lane"], w=[None, 6.25, None])
    path = saved(tmp_path / "a.gpkg", features)
    found = read(path, 'column = "road"\nvalues = { lane = "road_minor" }\nwidth_column = "w"').features
    rule = load_taxonomy()["road_minor"].rules[0]
    usual = np.median(list(rule.widths.values()))
    assert sorted(found["width_m"].dropna()) == pytest.approx([usual, 6.25])
    assert found.geometry[found["width_m"].isna()].area.tolist() == pytest.approx([1600], abs=0.1)


def test_a_parcel_of_a_boundary_class_is_drawn_along_its_edge(tmp_path):
    parcel = at(shapely.box(20, 100, 60, 140))
    found = read(saved(tmp_path / "a.gpkg", frame(parcel)), 'class = "field_boundary"').features
    assert found.geometry.iloc[0].geom_type in ("LineString", "LinearRing")
    assert found.geometry.iloc[0].length == pytest.approx(160, abs=0.1)


def two_layers(path):
    saved(path, frame(HOUSE), layer="houses")
    return saved(path, frame(POND), layer="ponds", mode="a")


def test_of_several_layers_one_is_named(tmp_path):
    path = two_layers(tmp_path / "a.gpkg")
    with pytest.raises(ExtractError, match=r"has 2 layers \(houses, ponds\): name one by layer"):
        read(path)
    with pytest.raises(ExtractError, match=r"has no layer 'house', it has 2 layers \(houses, ponds\)"):
        read(path, 'class = "water"\nlayer = "house"')
    (found,) = read(path, 'class = "water"\nlayer = "ponds"').features.geometry
    assert found.area == pytest.approx(POND.area, abs=0.1)


def test_a_table_without_geometry_beside_a_layer_is_no_second_layer(tmp_path):
    path = saved(tmp_path / "a.gpkg", frame(HOUSE))
    import pyogrio  # noqa: PLC0415 - this test alone

    pyogrio.write_dataframe(pd.DataFrame({"note": ["x"]}), path, layer="notes", append=True)
    assert len(read(path).features) == 1


def wrong(tmp_path: Path) -> dict[str, tuple[Path, str, str]]:
    """Files that cannot be read: path, table, and what is said."""
    house = saved(tmp_path / "house.gpkg", frame(HOUSE, use=["house"]))
    inner = f"<OGRVRTLayer name='a'><SrcDataSource>{house}</SrcDataSource></OGRVRTLayer>"
    virtual = f"<OGRVRTDataSource>{inner}</OGRVRTDataSource>"
    content = {
        "virtual.gpkg": virtual.encode(),
        "half.gpkg": house.read_bytes()[:2000],
        "half.fgb": saved(tmp_path / "a.fgb", frame(HOUSE)).read_bytes()[:90],
        "half.parquet": saved(tmp_path / "a.parquet", frame(HOUSE)).read_bytes()[:200],
        "a.zip": b"PK\x03\x04 no archive",
    }
    for name, data in content.items():
        (tmp_path / name).write_bytes(data)
    pd.DataFrame({"a": [1]}).to_parquet(tmp_path / "plain.parquet")
    with sqlite3.connect(tmp_path / "plain.gpkg") as base:
        base.execute("create table t (a)")
    base.close()
    with zipfile.ZipFile(tmp_path / "virtual.zip", "w") as archive:
        archive.writestr("a.shp", virtual)
    with zipfile.ZipFile(tmp_path / "none.zip", "w") as archive:
        archive.writestr("a.txt", "nothing")
    saved(tmp_path / "empty.gpkg", frame(HOUSE).iloc[:0])
    saved(tmp_path / "empty.parquet", frame(HOUSE).iloc[:0])
    saved(tmp_path / "empty.geojson", frame(HOUSE).iloc[:0].to_crs(4326))
    saved(tmp_path / "far.gpkg", frame(FAR))
    flipped = shapely.transform(frame(HOUSE).to_crs(4326).geometry.iloc[0], lambda place: place[:, ::-1])
    saved(tmp_path / "flipped.gpkg", frame(flipped, crs=4326))
    saved(tmp_path / "flipped.parquet", frame(flipped, crs=4326), write_covering_bbox=True)
    every = 'class = "building"'
    return {
        "virtual.gpkg": (every, "is no GeoPackage, FlatGeobuf, GeoParquet, GeoJSON or zipped Shapefile"),
        "virtual.zip": (every, "a.shp is no shapefile"),
        "none.zip": (every, "holds no layer with geometry"),
        "a.zip": (every, "cannot be read"),
        "half.gpkg": (every, "cannot be read"),
        "half.fgb": (every, "holds no layer with geometry: it is damaged"),
        "half.parquet": (every, "cannot be read as GeoParquet"),
        "plain.parquet": (every, "cannot be read as GeoParquet"),
        "plain.gpkg": (every, "cannot be read (At least one of the required GeoPackage tables"),
        "missing.gpkg": (every, "cannot be read (No such file or directory)"),
        "empty.gpkg": (every, "layer 'empty' is empty"),
        "empty.parquet": (every, "is empty"),
        "empty.geojson": (every, "is empty"),
        "far.gpkg": (
            every,
            "holds nothing in the region: it lies within [505000, 5215000, 505010, 5215010] of EPSG:32632",
        ),
        "flipped.gpkg": (every, "in the region with its axes swapped: write x, or longitude, first"),
        "flipped.parquet": (every, "in the region with its axes swapped"),
        "house.gpkg": ('column = "uses"\nvalues = { house = "building" }', "has no column 'uses', did you mean 'use'?"),
        "a.parquet": ('class = "building"\nlayer = "a"', "has no layers: leave layer = 'a' out"),
    }


WRONG = [
    *("virtual.gpkg", "virtual.zip", "none.zip", "a.zip", "half.gpkg", "half.fgb", "half.parquet", "plain.parquet"),
    *("plain.gpkg", "missing.gpkg", "empty.gpkg", "empty.parquet", "empty.geojson", "far.gpkg", "flipped.gpkg"),
    *("flipped.parquet", "house.gpkg", "a.parquet"),
]


@pytest.mark.parametrize("name", WRONG)
def test_a_file_that_cannot_be_read_is_refused_in_one_line(name, tmp_path):
    text, fault = wrong(tmp_path)[name]
    with pytest.raises((ExtractError, CoverageError)) as found:
        read(tmp_path / name, text)
    assert fault in str(found.value)
    assert name in str(found.value)
    assert "\n" not in str(found.value)


def test_values_that_name_nothing_are_said_and_a_map_of_none_is_refused(tmp_path):
    path = saved(tmp_path / "a.gpkg", MAP)
    said = read(path, TABLE.replace("pond", "pnod")).warnings
    assert said[-1] == "a.gpkg: no feature in the region has the 1 value (pnod) of `values`"
    with pytest.raises(ExtractError, match=r"none of 5 features in the region has a class \(3 x use=house: not in"):
        read(path, 'column = "use"\nvalues = { "House" = "building" }')


@pytest.mark.parametrize("name", ["a.parquet", "a.shp.zip"])
def test_what_unpacks_to_too_much_is_refused(name, tmp_path, monkeypatch):
    path = saved(tmp_path / name, frame(HOUSE))
    monkeypatch.setattr(vector, "MOST_UNPACKED", 100)
    with pytest.raises(ExtractError, match=r"unpacks to more than .* GB: cut it to the region"):
        read(path)


@pytest.mark.parametrize("name", ["a.gpkg", "a.parquet"])
def test_too_many_features_are_refused(name, tmp_path, monkeypatch):
    path = saved(tmp_path / name, MAP)
    monkeypatch.setattr(vector, "MOST_FEATURES", 2)
    with pytest.raises(ExtractError, match=r"has more than 2 features in the region"):
        read(path, TABLE)


@pytest.mark.parametrize(
    ("text", "fault"),
    [
        ('column = "use"', "say which class its features are by class"),
        ('class = "building"\ncolumn = "use"\nvalues = { a = "water" }', "say which class its features are by class"),
        ('class = "bulding"', "its features are 'bulding', which is no class"),
        ('column = "use"\nvalues = { a = "house" }', "its features are 'house', which is no class"),
        ('class = "building"\nepsg = 999999', "epsg 999999 is unknown"),
        ('layer = "a"', "are of maps with `class`, or `column` and `values`"),
    ],
)
def test_a_table_that_says_no_classes_is_refused(text, fault):
    with pytest.raises(ConfigError) as found:
        table(text)
    assert fault in str(found.value)
    assert "\n" not in str(found.value)


@pytest.mark.real
def test_real_labels_in_web_mercator_lie_where_their_numbers_say():
    name = "OAM-393753-226409-19.geojson"
    path = next(iter(named_files(name, imagery_folders())), None)
    if path is None:
        pytest.skip(f"{name} is on no folder of imagery")
    shapes = [shapely.geometry.shape(one["geometry"]) for one in json.loads(path.read_text())["features"]]
    west, south, east, north = shapely.total_bounds(shapes)
    to_utm = pyproj.Transformer.from_crs(3857, 32645, always_xy=True)
    grid = Grid.from_bounds(*to_utm.transform_bounds(west, south, east, north), cell_size_m=0.5, epsg=32645)
    found = read(path, 'class = "building"\nepsg = 3857', grid=grid, stated=shapely.box(90, 23, 91, 24)).features
    assert len(found) == len(shapes) == 274
    moved = [shapely.transform(one, lambda at: np.column_stack(to_utm.transform(*at.T))) for one in shapes]
    assert sorted(found.area) == pytest.approx(sorted(one.area for one in moved), abs=0.05)
    assert shapely.hausdorff_distance(shapely.union_all(found.geometry.to_numpy()), shapely.union_all(moved)) < 0.01
    # 23.8 degrees north: metres of Web Mercator are longer than those on the ground by 1 / cos
    assert found.area.sum() == pytest.approx(sum(one.area for one in shapes) * np.cos(np.radians(23.8)) ** 2, rel=0.01)


def test_a_file_that_leaves_the_datum_open_says_so_or_takes_that_of_the_region_file(tmp_path):
    """PROJ takes any datum of the ellipsoid for it: DHDN, which has Bessel's, lies a hundred metres from WGS 84."""
    stated = frame(HOUSE).to_crs(31467)
    plain, path = tmp_path / "a.geojson", tmp_path / "a.gpkg"
    plain.write_text(stated.geometry.to_json())
    open_datum = pyproj.CRS("+proj=tmerc +lon_0=9 +x_0=3500000 +ellps=bessel").to_wkt("WKT1_GDAL")
    ogr2ogr("-f", "GPKG", "-a_srs", open_datum, path, plain)
    assert "to EPSG:32632 with an unknown error" in read(path).warnings[0]
    taken, told = read(path, 'class = "building"\nepsg = 31467'), read(saved(tmp_path / "b.gpkg", stated))
    assert taken.warnings[0].removeprefix("a") == told.warnings[0].removeprefix("b")
    assert shapely.hausdorff_distance(taken.features.geometry[0], told.features.geometry[0]) < 0.002
