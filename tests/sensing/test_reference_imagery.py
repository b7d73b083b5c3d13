# SPDX-License-Identifier: Apache-2.0
"""Rendered reference imagery: what it shows, what its record says, and what it leaves as it was."""

import datetime as dt
import shutil
from dataclasses import replace

import numpy as np
import pytest
import rasterio
import shapely
from rasterio.features import rasterize

from sasgeo_bench.core.errors import ConfigError, ImageryError, StoreError
from sasgeo_bench.core.progress import reporting
from sasgeo_bench.regions import region_files
from sasgeo_bench.regions.build import plan_build
from sasgeo_bench.regions.region_spec import find_region_file, read_region_file
from sasgeo_bench.sensing import reference_imagery
from sasgeo_bench.sensing.reference_imagery import Look, render_imagery, render_place
from tests.regions.imagery_place import make_hamlet
from tests.world import built

TOWN = "town-suburb"
COARSE = Look(gsd_m=1.0)


def spec():
    """A quarter of the town's ground, which is rendered in a quarter of the time."""
    return read_region_file(find_region_file(TOWN)).model_copy(update={"size_m": (512.0, 512.0)})


def render(out, look=COARSE, date=None):
    return render_place(spec(), look=look, out=out, date=date)


def pixels(path):
    with rasterio.open(path) as source:
        return source.read()


def state_of(folder):
    """Names and contents of all files in and beside a region."""
    return {path.name: path.read_bytes() for path in folder.parent.rglob("*") if path.is_file()}


@pytest.fixture(scope="module")
def rendered(tmp_path_factory):
    out = tmp_path_factory.mktemp("rendered")
    built(spec(), out)
    before = region_files.read_manifest(out / "regions" / TOWN)
    render(out)
    return out, before


def test_the_image_has_tiles_overviews_and_a_mask_and_covers_the_region(rendered):
    out, before = rendered
    with rasterio.open(out / "regions" / TOWN / "ortho.tif") as source:
        assert source.tags(ns="IMAGE_STRUCTURE")["LAYOUT"] == "COG"
        assert source.compression.value == "JPEG"
        assert tuple(source.bounds) == before.bounds_m
        assert source.res == (1.0, 1.0)
        assert source.dataset_mask().min() == 255
        assert source.tags()["licence"] == "ODbL-1.0"
        assert source.tags()["TIFFTAG_COPYRIGHT"] == "(c) OpenStreetMap contributors, ODbL"
        assert source.read().std() > 15


def test_the_record_says_that_it_is_rendered_of_what_and_how(rendered):
    imagery = region_files.read_imagery(rendered[0] / "regions" / TOWN)
    (picture,) = imagery.record.pictures
    extract = region_files.read_manifest(rendered[0] / "regions" / TOWN).extract
    assert (picture.file, picture.sha256, picture.date) == (extract.file, extract.sha256, extract.date)
    assert (picture.licence, picture.attribution) == ("ODbL-1.0", "(c) OpenStreetMap contributors, ODbL")
    assert picture.publish
    assert (picture.rendered.family, picture.rendered.season, picture.rendered.seed) == ("calibration", "autumn", 0)
    assert imagery.record.is_rendered
    assert imagery.record.is_publishable
    assert "rendered from town-suburb" in imagery.record.to_text()
    assert imagery.record.share == 1.0


def test_the_map_and_its_hash_stay_so_that_tasks_stay_valid(rendered):
    out, before = rendered
    after = region_files.read_manifest(out / "regions" / TOWN)
    assert {name: record for name, record in after.files.items() if name != "ortho.tif"} == before.files
    assert after.model_copy(update={"files": before.files, "imagery": None}) == before
    assert region_files.differing_files(out / "regions" / TOWN) == []
    assert plan_build(spec(), out=out).is_current


def test_buildings_are_seen_where_the_map_has_them(rendered):
    """The mean brightness steps more across outlines of the map than across the same ones a few pixels off."""
    region = region_files.read_region(rendered[0] / "regions" / TOWN)
    grey = pixels(rendered[0] / "regions" / TOWN / "ortho.tif").mean(axis=0)
    steps = np.hypot(*np.gradient(grey))
    lattice = region.imagery.grid
    houses = shapely.boundary(region.features.geometry[region.features["class"] == "building"].to_numpy())
    transform = rasterio.Affine(*lattice.transform)

    def across(shift_m):
        moved = shapely.transform(houses, lambda at: at + shift_m)
        return steps[rasterize(list(moved), lattice.shape, transform=transform) > 0].mean()

    # East and west alone: shadows of eaves fall to the north.
    seen = {east_m: across((east_m, 0.0)) for east_m in (-4.0, -1.0, 0.0, 1.0, 4.0)}
    assert max(seen, key=lambda east_m: seen[east_m]) == 0.0
    assert seen[0.0] > 1.1 * max(seen[-4.0], seen[4.0])


def test_a_second_time_nothing_is_rendered(rendered):
    path = rendered[0] / "regions" / TOWN / "ortho.tif"
    before, given = path.stat().st_mtime_ns, []
    with reporting(given.append):
        assert render(rendered[0]) == path
    assert path.stat().st_mtime_ns == before
    assert given == [f"{TOWN}: rendered imagery is up to date, nothing to do"]


@pytest.mark.parametrize("changes", [{"seed": 1}, {"season": "snow"}, {"family": "shifted"}])
def test_another_look_replaces_the_image(rendered, tmp_path, changes):
    shutil.copytree(rendered[0], tmp_path / "out")
    path = tmp_path / "out" / "regions" / TOWN / "ortho.tif"
    before = pixels(path)
    render(tmp_path / "out", replace(COARSE, **changes))
    assert np.abs(pixels(path).astype(int) - before).mean() > 5


def test_an_older_world_is_built_and_shown_without_what_came_later(rendered, tmp_path):
    shutil.copytree(rendered[0], tmp_path / "out")
    path = tmp_path / "out" / "regions" / TOWN / "ortho.tif"
    before = pixels(path)
    render(tmp_path / "out", date=dt.date(2014, 1, 1))
    (picture,) = region_files.read_imagery(path.parent).record.pictures
    assert picture.date == dt.date(2014, 1, 1)
    new, old = (region_files.read_region(path.parent.parent / name) for name in (TOWN, f"{TOWN}@2014-01-01"))
    grown = (new.layer("building") == 1) & (old.layer("building") == 0)
    kept = (new.layer("building") == 1) & (old.layer("building") == 1)
    changed = np.abs(pixels(path).astype(int) - before).mean(axis=0)
    assert grown.sum() > 100
    assert changed[grown].mean() > 2 * changed[kept].mean()


def test_tiles_fit_together(rendered):
    out, _ = rendered
    folder = out / "regions" / TOWN
    manifest = region_files.read_manifest(folder)
    rendering = reference_imagery._Rendering(
        folder=folder,
        manifest=manifest,
        shown=manifest,
        features=region_files.read_features(folder),
        look=Look(gsd_m=1.0),
        picture=manifest.imagery.pictures[0],
    )
    grid = manifest.grid.window(150, 150, 120, 240)
    light = replace(rendering.look.conditions(TOWN), noise=0.0)
    whole = reference_imagery.render_ortho(
        reference_imagery._scene(rendering, grid), grid, light, np.random.default_rng(0)
    )
    part = grid.window(0, 120, 120, 120)
    half = reference_imagery.render_ortho(
        reference_imagery._scene(rendering, part), part, light, np.random.default_rng(0)
    )
    differs = np.abs(whole[:, 120:].astype(int) - half).max(axis=2)
    assert np.percentile(differs, 95) <= 2  # yards are toned by number within a tile


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"family": "tropical"}, "family is one of train, calibration, test, shifted, got 'tropical'"),
        ({"season": "monsoon"}, "season is one of spring, summer, autumn, winter, snow, got 'monsoon'"),
        ({"gsd_m": 0.01}, "gsd_m lies between 0.25 and 2 m, got 0.01"),
        ({"gsd_m": float("nan")}, "gsd_m lies between 0.25 and 2 m, got nan"),
    ],
)
def test_a_look_that_there_is_not_is_refused(changes, words):
    with pytest.raises(ConfigError, match=words):
        Look(**changes)


def test_a_region_that_is_not_built_is_refused_and_no_file_is_made(tmp_path):
    with pytest.raises(StoreError, match="is not built, or not by this region file: run sasgeo-bench build-region"):
        render(tmp_path)
    assert list(tmp_path.iterdir()) == []
    with pytest.raises(StoreError, match=r"holds no region\.json"):
        render_imagery(tmp_path / "regions" / "nowhere", tmp_path, COARSE)
    assert list(tmp_path.iterdir()) == []


def test_real_imagery_is_not_replaced(tmp_path):
    hamlet = make_hamlet(tmp_path / "files")
    folder = built(hamlet.spec(), tmp_path, extract_folders=(hamlet.folder,), imagery_folders=(hamlet.folder,))
    before = state_of(folder)
    with pytest.raises(ImageryError, match="hamlet has imagery of its own"):
        render_imagery(folder, folder, COARSE)
    assert state_of(folder).items() >= before.items()


def test_a_map_without_anything_to_draw_is_refused(rendered, tmp_path, monkeypatch):
    shutil.copytree(rendered[0], tmp_path / "out")
    whole = region_files.read_features(rendered[0] / "regions" / TOWN)
    monkeypatch.setattr(region_files, "read_features", lambda _: whole.iloc[:0])
    with pytest.raises(ImageryError, match=f"{TOWN} of 2025-01-01 shows nothing to draw: take another date"):
        render(tmp_path / "out", replace(COARSE, seed=4))


FULL = rasterio.errors.RasterioIOError("No space left on device")


@pytest.mark.parametrize(
    ("place", "fault"),
    [
        ((reference_imagery, "write_tiles"), OSError(28, "No space left on device")),
        ((reference_imagery, "write_tiles"), ImageryError("the disk is full")),
        ((reference_imagery, "write_tiles"), KeyboardInterrupt()),
        ((rasterio.shutil, "copy"), FULL),
    ],
)
def test_a_rendering_that_ends_early_leaves_the_region_as_it_was(rendered, tmp_path, monkeypatch, place, fault):
    folder = shutil.copytree(rendered[0], tmp_path / "out") / "regions" / TOWN
    before = state_of(folder)

    def fail(path, *_, **__):
        path.write_bytes(b"half of it") if fault is not FULL else None
        raise fault

    monkeypatch.setattr(*place, fail)
    with pytest.raises((StoreError, ImageryError, KeyboardInterrupt)) as caught:
        render(tmp_path / "out", replace(COARSE, seed=9))
    assert "\n" not in str(caught.value)
    assert fault is not FULL or "ortho.tif cannot be written (No space left on device)" in str(caught.value)
    assert state_of(folder) == before


@pytest.mark.slow
def test_the_command_prints_the_image_and_refuses_in_one_line(program, lay_towns, tmp_path):
    lay_towns(tmp_path / "out", TOWN)
    code, out, _ = program("render-imagery", TOWN, "--gsd-m", 2, "--season", "winter")
    assert (code, out) == (0, f"out/regions/{TOWN}/ortho.tif\n")
    code, out, err = program("render-imagery", TOWN, "--season", "monsoon")
    assert (code, out) == (2, "")
    assert err == "sasgeo-bench: season is one of spring, summer, autumn, winter, snow, got 'monsoon'\n"
    assert "rendered from" in program("inspect", TOWN)[1].replace("\n", " ")


def test_views_of_real_imagery_are_not_cut_out_of_a_rendered_one(program, lay_towns, tmp_path):
    lay_towns(tmp_path / "out", TOWN)
    program("render-imagery", TOWN, "--gsd-m", 2)
    code, _, err = program("make-queries", "--suite", "real-image", "--regions", TOWN, "--n", 1)
    assert code == 2
    assert "no real imagery" in err
