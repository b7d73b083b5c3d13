# SPDX-License-Identifier: Apache-2.0
"""Aerial pictures of a place: cut, reprojected, held against the map, read window by window; bad ones are refused."""

import datetime as dt
import json
import re
import shutil
from pathlib import Path

import numpy as np
import pytest
import rasterio
import shapely
from affine import Affine
from rio_cogeo.cogeo import cog_validate

from sasgeo_bench.core.errors import ConfigError, ExtractError, ImageryError, StoreError
from sasgeo_bench.regions.build import build_region, plan_build
from sasgeo_bench.regions.imagery import ORTHO
from sasgeo_bench.regions.region_files import (
    check_publishable,
    differing_files,
    read_imagery,
    read_manifest,
    read_region,
)
from sasgeo_bench.regions.region_spec import list_region_files, read_region_file
from tests import world
from tests.regions.imagery_place import GSD_M, SOUTH, WEST, Hamlet, make_hamlet, write_picture

OFF_M = (1.3, -0.7)


@pytest.fixture(scope="module")
def hamlet(tmp_path_factory: pytest.TempPathFactory) -> Hamlet:
    """The place's files, on which the picture is off the map."""
    return make_hamlet(tmp_path_factory.mktemp("hamlet"), off_m=OFF_M)


@pytest.fixture(scope="module")
def built(hamlet: Hamlet, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of the built region."""
    return build(hamlet, tmp_path_factory.mktemp("out"))


def build(hamlet: Hamlet, out: Path) -> Path:
    return world.built(hamlet.spec(), out, extract_folders=[hamlet.folder], imagery_folders=[hamlet.folder])


def refusal(hamlet: Hamlet, out: Path) -> str:
    """Build, and return the one line of the error; nothing may be left behind."""
    with pytest.raises(ImageryError) as found:
        build(hamlet, out)
    assert not list(out.rglob("*.tif"))
    assert not list(out.rglob("*.draft"))
    assert not list(out.rglob("region.json"))
    assert "\n" not in str(found.value)
    return str(found.value)


def test_a_region_whose_offset_an_earlier_program_measured_is_built_again(hamlet, built, tmp_path):
    folder = tmp_path / "regions" / built.name
    shutil.copytree(built, folder)
    about = json.loads((folder / "region.json").read_text(encoding="utf-8"))
    del about["imagery"]["offset_version"]
    about["imagery"]["offset"] = None
    (folder / "region.json").write_text(json.dumps(about), encoding="utf-8")
    before = read_manifest(folder)
    assert build(hamlet, tmp_path) == folder
    after = read_manifest(folder)
    assert after.imagery.offset.east_m == pytest.approx(OFF_M[0], abs=0.3)
    assert (after.inputs_sha256, after.fingerprint) == (before.inputs_sha256, before.fingerprint)  # answers stay
    plan = plan_build(hamlet.spec(), out=tmp_path, extract_folders=[hamlet.folder])  # pictures are not looked for
    assert plan.is_current


def test_a_picture_becomes_a_cloud_optimized_file_beside_the_layers(built):
    assert cog_validate(built / ORTHO, quiet=True)[0]
    assert differing_files(built) == []
    assert ORTHO in read_manifest(built).files
    with rasterio.open(built / ORTHO) as ortho:
        assert ortho.tags()["attribution"] == "(c) somebody with a drone"
        assert ortho.tags()["licence"] == "CC-BY-4.0"
        assert (ortho.count, ortho.dtypes[0], ortho.crs.to_epsg()) == (3, "uint8", 32632)


def test_its_pixels_fit_into_the_cells_of_the_map_and_a_line_says_what_it_shows(built):
    region, manifest = read_region(built), read_manifest(built)
    grid, cells, record = region.imagery.grid, region.grid, manifest.imagery
    assert grid.cell_size_m == pytest.approx(0.5)
    assert ((grid.west_m - cells.west_m) / cells.cell_size_m) % 1 == 0
    assert grid.bounds_m == cells.bounds_m  # the picture is larger than the place, and cut
    assert (record.rows, record.cols) == (2 * manifest.rows, 2 * manifest.cols)
    assert record.pictures[0].gsd_m == pytest.approx(GSD_M, rel=0.05)
    assert record.share == 1.0
    text = record.to_text()
    assert text.startswith(
        "mosaic.tif of 2023-06-01; pixels of 0.500 m show 100.0% of the mapped ground, off the map by"
    )
    assert text.endswith("(c) somebody with a drone (CC-BY-4.0), may be passed on")


def test_the_offset_of_the_picture_is_measured_and_of_one_of_elsewhere_none_is_given(built, hamlet, tmp_path):
    offset = read_manifest(built).imagery.offset
    assert (offset.east_m, offset.north_m) == pytest.approx(OFF_M, abs=0.15)
    assert offset.east_interval_m[0] - 0.1 <= OFF_M[0] <= offset.east_interval_m[1] + 0.1
    assert offset.residual_m < 0.5
    assert offset.tiles >= 9
    other = make_hamlet(tmp_path / "other", seed=8, off_m=(13.0, 15.0))  # its houses stand between those of the map
    shutil.copy(hamlet.folder / "houses.geojson", other.folder / "houses.geojson")
    assert read_manifest(build(other, tmp_path)).imagery.offset is None


def test_houses_are_where_the_picture_shows_them(hamlet, built):
    imagery = read_region(built).imagery
    window = imagery.read((WEST + 64, SOUTH + 64, WEST + 320, SOUTH + 320))
    to_map = window.grid.to_centres_m(np.argwhere(window.is_known)) - OFF_M
    is_roof = shapely.intersects_xy(shapely.union_all(hamlet.houses), to_map).reshape(window.grid.shape)
    grey = window.rgb.mean(axis=2)
    assert grey[is_roof].mean() - grey[~is_roof].mean() > 75


def test_a_coarser_window_is_the_mean_of_the_finer_one(built):
    imagery = read_imagery(built)
    bounds_m = (WEST + 64, SOUTH + 64, WEST + 128, SOUTH + 128)
    fine, coarse = imagery.read(bounds_m), imagery.read(bounds_m, gsd_m=2.0)
    assert coarse.rgb.shape == (32, 32, 3)
    means = fine.rgb.reshape(32, 4, 32, 4, 3).mean(axis=(1, 3))
    assert np.abs(coarse.rgb - means).mean() < 4  # JPEG


def test_beyond_the_imagery_nothing_is_known_and_a_window_of_too_many_pixels_is_refused(built, tiny):
    window = read_imagery(built).read((WEST - 10, SOUTH, WEST + 10, SOUTH + 20), gsd_m=1.0)
    assert not window.is_known[:, :10].any()
    assert window.is_known[:, 10:].all()
    assert (window.rgb[:, :10] == 0).all()
    with pytest.raises(ImageryError, match="read a smaller one, or a coarser gsd_m"):
        read_imagery(built).read((0.0, 0.0, 1e5, 1e5))
    assert tiny.region.imagery is None
    assert read_imagery(tiny.map_folder) is None
    assert '"imagery"' not in (tiny.map_folder / "region.json").read_text()


def test_reading_the_region_opens_no_pixel_and_a_changed_file_is_found(built, tmp_path):
    mine = Path(shutil.copytree(built, tmp_path / "mine"))
    (mine / ORTHO).write_bytes(b"no picture")
    assert read_region(mine).imagery is not None
    with pytest.raises(StoreError, match="build the region again"):
        read_imagery(mine)
    with pytest.raises(StoreError, match="build the region again"):
        read_region(mine).imagery.read((WEST, SOUTH, WEST + 10, SOUTH + 10))


def test_a_second_build_is_skipped_without_its_pictures_until_they_change(hamlet, built):
    folders = {"out": built.parent.parent, "extract_folders": [hamlet.folder]}
    plan = plan_build(hamlet.spec(), **folders)
    assert plan.is_current
    assert plan.pictures == ()
    other = hamlet.but(publish=False)
    assert not plan_build(other.spec(), imagery_folders=[hamlet.folder], **folders).is_current


def test_a_hole_of_one_colour_is_no_picture_but_a_small_white_roof_is(hamlet, tmp_path):
    place = Hamlet(folder=tmp_path / "place", houses=hamlet.houses, extra="empty_rgb = [255, 255, 255]\n")
    shutil.copytree(hamlet.folder, place.folder)
    with rasterio.open(place.folder / "mosaic.tif", "r+") as mosaic:
        bands = mosaic.read()
        bands[:, 300:400, 300:400] = 255
        bands[:, 500:508, 500:508] = 255
        mosaic.write(bands)
    imagery = read_imagery(build(place, tmp_path))
    window = imagery.read(imagery.record.bounds_m)
    hole_m2 = (~window.is_known).sum() * GSD_M**2
    assert hole_m2 == pytest.approx(100 * 100 * GSD_M**2, rel=0.06)
    assert imagery.record.share == pytest.approx(1 - hole_m2 / 344**2, abs=1e-3)


def test_a_picture_that_is_nowhere_or_has_another_hash_is_named_with_the_places_to_put_it(
    hamlet, tmp_path, monkeypatch
):
    monkeypatch.setenv("SASGEO_IMAGERY", str(tmp_path / "named"))
    with pytest.raises(
        ImageryError, match=r"mosaic.tif .* was not found: put it into .*named.* --imagery or SASGEO_IMAG"
    ):
        plan_build(hamlet.spec(), out=tmp_path, extract_folders=[hamlet.folder])
    spec = hamlet.spec()
    (tmp_path / "mosaic.tif").write_bytes(b"other")
    with pytest.raises(ImageryError, match="none of those accepted"):
        plan_build(spec, out=tmp_path, extract_folders=[hamlet.folder], imagery_folders=[tmp_path])


def test_pictures_are_found_one_folder_deeper_and_beside_the_extracts(hamlet, tmp_path):
    (tmp_path / "imagery" / "hamlet").mkdir(parents=True)
    (tmp_path / "osm").mkdir()
    shutil.copy(hamlet.folder / "houses.geojson", tmp_path / "imagery" / "hamlet")
    shutil.copy(hamlet.folder / "mosaic.tif", tmp_path / "imagery" / "hamlet")
    plan = plan_build(hamlet.spec(), out=tmp_path, extract_folders=[tmp_path / "osm"])
    assert plan.pictures[0].path == tmp_path / "imagery" / "hamlet" / "mosaic.tif"


GROUND = np.full((3, 64, 64), 90, dtype=np.uint8)
THERE = {"transform": Affine(1.0, 0, 1_000_900, 0, -1.0, 5_959_000)}
BAD = {
    "no CRS": (lambda path: write_picture(path, GROUND, crs=None, **THERE), "says no place"),
    "no transform": (lambda path: write_picture(path, GROUND), "says no place"),
    "16-bit": (lambda path: write_picture(path, GROUND.astype(np.uint16), **THERE), "uint16, imagery is 8-bit red"),
    "elsewhere": (lambda path: write_picture(path, GROUND, transform=Affine(1.0, 0, 4e6, 0, -1.0, 5e6)),
     r"the region is .*: leave it out"),
    "no raster": (lambda path: path.write_text("<html>not found</html>"), "cannot be read as a GeoTIFF"),
    "absurd scale": (lambda path: write_picture(path, GROUND, transform=Affine(5e4, 0, 0, 0, -5e4, 7e6)),
     "check its georeference"),
    "absurdly fine": (lambda path: write_picture(path, np.zeros((3, 1, 1), np.uint8), transform=Affine(1e-4, 0,
     1_000_900, 0, -1e-4, 5_959_000)), "check its georeference"),
}  # fmt: skip


@pytest.mark.parametrize("fault", BAD)
def test_a_bad_picture_is_refused_in_one_line_and_nothing_is_left(fault, hamlet, tmp_path):
    place = hamlet.but(folder=tmp_path / "place")
    place.folder.mkdir()
    shutil.copy(hamlet.folder / "houses.geojson", place.folder)
    make, words = BAD[fault]
    make(place.folder / "mosaic.tif")
    message = refusal(place, tmp_path / "out")
    assert re.search(words, message), message
    assert "mosaic.tif" in message


def test_a_picture_of_too_many_pixels_is_refused_before_it_is_decoded(hamlet, tmp_path):
    place = hamlet.but(folder=tmp_path / "place")
    place.folder.mkdir()
    shutil.copy(hamlet.folder / "houses.geojson", place.folder)
    about = {"driver": "GTiff", "count": 3, "height": 70_000, "width": 70_000, "dtype": "uint8", "sparse_ok": True}
    with rasterio.open(place.folder / "mosaic.tif", "w", crs="EPSG:3857", tiled=True, **about, **THERE):
        pass
    assert "the most is 4,000,000,000: cut it to the region" in refusal(place, tmp_path / "out")


def test_a_truncated_picture_is_refused_and_an_older_region_stays(hamlet, built, tmp_path):
    out = tmp_path / "out"
    shutil.copytree(built, out / "regions" / "hamlet")
    place = hamlet.but(folder=tmp_path / "place")
    shutil.copytree(hamlet.folder, place.folder)
    whole = (place.folder / "mosaic.tif").read_bytes()
    (place.folder / "mosaic.tif").write_bytes(whole[: len(whole) // 2])
    with pytest.raises(ImageryError, match=r"mosaic.tif"):
        build(place, out)
    assert differing_files(out / "regions" / "hamlet") == []
    assert [path.name for path in (out / "regions").iterdir() if "partial" in path.name] == []


def test_of_every_region_one_whose_picture_is_not_here_costs_no_other(hamlet, program, tmp_path):
    files = tmp_path / "files"
    files.mkdir()
    text = hamlet.text()
    (files / "hamlet.toml").write_text(text, encoding="utf-8")
    plain = text[: text.index("[[imagery]]")].replace('id = "hamlet"', 'id = "plain"')
    (files / "plain.toml").write_text(plain, encoding="utf-8")
    Path(shutil.copytree(hamlet.folder, tmp_path / "extracts") / "mosaic.tif").unlink()
    places = ("--region-files", files, "--extracts", tmp_path / "extracts", "--out", tmp_path / "out")
    code, _, err = program("build-region", "--every", *places)
    assert code == 2
    (line,) = [line for line in err.splitlines() if "mosaic.tif" in line]
    assert re.match(r"hamlet: not built: mosaic\.tif \(SHA-256 .*\) was not found: put it into ", line)
    assert err.splitlines()[-1].endswith("not built: 1 region (hamlet) of 2; the lines above say why")
    assert read_manifest(tmp_path / "out" / "regions" / "plain").imagery is None


def test_imagery_must_say_whether_it_may_be_passed_on_and_is_refused_where_not(hamlet, tmp_path):
    folder = build(hamlet.but(publish=False), tmp_path)
    with pytest.raises(
        StoreError, match=r"publish = false .*: leave hamlet out, or build it .* without \[\[imagery\]\]"
    ):
        check_publishable(folder, read_manifest(folder))
    with pytest.raises(ConfigError, match=r"'imagery.1.publish' is missing"):
        hamlet.but(extra='[[imagery]]\nfile = "b.tif"\n').spec()


@pytest.mark.slow
@pytest.mark.real
@pytest.mark.parametrize(("name", "most_m", "tiles"), [("zanzibar", 0.3, 4), ("banepa", 0.1, 30)])
def test_a_real_mosaic_lies_on_its_map(name, most_m, tiles, tmp_path):
    spec = read_region_file(list_region_files()[name])
    if name == "zanzibar":  # its southern part is enough
        ring = spec.coverage_parts_lonlat[1]
        box = shapely.Polygon(ring).bounds
        changes = {"bounds_lonlat": box, "coverage_parts_lonlat": [ring], "imagery": spec.imagery[1:]}
        spec = spec.model_copy(update=changes)
    try:
        plan = plan_build(spec, out=tmp_path)
    except (ExtractError, ImageryError) as error:
        pytest.skip(f"real imagery: {error}")
    manifest = build_region(plan)
    assert manifest.classes == ("building",)
    assert manifest.imagery.share > 0.98
    assert max(abs(manifest.imagery.offset.east_m), abs(manifest.imagery.offset.north_m)) < most_m
    assert manifest.imagery.offset.tiles >= tiles
    assert manifest.imagery.is_publishable == (name == "banepa")


@pytest.mark.slow
@pytest.mark.real
def test_a_map_that_holds_few_of_the_houses_has_no_offset(tmp_path):
    spec = read_region_file(list_region_files()["andorra-la-vella-ortho"])
    try:
        plan = plan_build(spec, out=tmp_path, date=dt.date(2017, 2, 19))
    except (ExtractError, ImageryError) as error:
        pytest.skip(f"real imagery: {error}")
    assert build_region(plan).imagery.offset is None


# Bounds: twice what separate measurements of clear patches gave, and never under 1 m east or north
@pytest.mark.slow
@pytest.mark.real
@pytest.mark.parametrize(
    ("name", "half_m", "most_m"),
    [("pardubice-ortho", 2.0, 5.0), ("chateaugiron-ortho", 2.0, 6.0), ("andorra-la-vella-ortho", 3.0, 8.0)],
)
def test_a_real_orthophoto_lies_a_metre_or_two_off_its_map_and_its_offset_is_measured(name, half_m, most_m, tmp_path):
    try:
        plan = plan_build(read_region_file(list_region_files()[name]), out=tmp_path)
    except (ExtractError, ImageryError) as error:
        pytest.skip(f"real imagery: {error}")
    offset = build_region(plan).imagery.offset
    assert max(abs(offset.east_m), abs(offset.north_m)) < 1.5
    widths = [high - low for low, high in (offset.east_interval_m, offset.north_interval_m)]
    assert max(widths) < 1.5
    assert 0.3 < offset.residual_m < half_m
    assert offset.residual_m < offset.residual_90_m < most_m
    assert offset.of_tiles > offset.tiles >= 30
