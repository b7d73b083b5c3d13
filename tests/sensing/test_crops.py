# SPDX-License-Identifier: Apache-2.0
"""Crops to teach with: labels are the map at the crop's pose, pictures show what stands there, each switch counts."""

import math
from dataclasses import fields, replace
from itertools import islice

import numpy as np
import pandas as pd
import pytest
import shapely
from scipy.ndimage import map_coordinates

from sasgeo_bench.core.errors import ConfigError, ImageryError
from sasgeo_bench.geometry.grid import Grid
from sasgeo_bench.geometry.pose import Pose
from sasgeo_bench.regions.evidence import PRESENT, UNKNOWN, observe
from sasgeo_bench.regions.imagery import ImageryWindow, RenderedRecord
from sasgeo_bench.regions.region_files import read_region
from sasgeo_bench.sensing.crops import drawn_crops, real_crops
from sasgeo_bench.sensing.rendering.sheet import make_sheet
from sasgeo_bench.sensing.rendering.wild import Ingredients, draw_picture
from tests import world
from tests.drawn_features import features_of
from tests.regions.imagery_place import GSD_M, SIDE_M, SOUTH, WEST, make_hamlet

EPSG = 32632
EAST, NORTH = 500_000.0, 5_200_000.0
CLASSES = ("road_minor", "path_track", "railway", "building", "water", "green", "farmland", "parking")
WINDOW = Grid.around(EAST, NORTH, size_m=(128.0, 128.0), cell_size_m=0.5, epsg=EPSG)
LAND = shapely.box(EAST - 400, NORTH - 400, EAST + 400, NORTH + 400)
POSE = Pose(easting_m=EAST + 3.0, northing_m=NORTH - 2.0, yaw_deg=50.0)
HOUSE = ("building", shapely.box(EAST + 6, NORTH + 4, EAST + 36, NORTH + 18), np.nan)
# One of each look, none of which lies on another.
VILLAGE = (
    HOUSE,
    ("building", shapely.box(EAST + 6, NORTH - 24, EAST + 40, NORTH - 10), np.nan),
    ("road_minor", shapely.LineString([(EAST - 90, NORTH - 2), (EAST + 90, NORTH - 2)]), 9.0),
    ("railway", shapely.LineString([(EAST - 90, NORTH + 30), (EAST + 90, NORTH + 34)]), 4.0),
    ("path_track", shapely.LineString([(EAST - 90, NORTH + 26), (EAST + 90, NORTH + 24)]), 2.0),
    ("water", shapely.box(EAST - 40, NORTH - 40, EAST - 15, NORTH - 12), np.nan),
    ("green", shapely.box(EAST - 40, NORTH + 4, EAST - 22, NORTH + 20), np.nan),
    ("farmland", shapely.box(EAST - 20, NORTH + 4, EAST - 2, NORTH + 20), np.nan),
    ("parking", shapely.box(EAST - 10, NORTH - 40, EAST + 4, NORTH - 12), np.nan),
)
SWITCHES = tuple(each.name for each in fields(Ingredients) if isinstance(each.default, bool))


def sheet_of(*rows, land=LAND):
    named = ({"class": name, "geometry": shape, "width_m": width} for name, shape, width in rows)
    return make_sheet(features_of(*named, timestamp=pd.Timestamp("2020-01-01")), CLASSES, land, WINDOW)


@pytest.fixture(scope="module")
def village():
    return sheet_of(*VILLAGE)


def picture(sheet, ingredients, seed=1):
    return draw_picture(sheet, POSE, side_px=128, pixel_m=0.5, ingredients=ingredients, rng=np.random.default_rng(seed))


def seen(sheet):
    return observe(sheet.bits, sheet.grid, POSE, size_cells=128, cell_size_m=0.5)


def pixels_m(pose, side_px, pixel_m):
    """Easting and northing of each pixel's centre, by plain trigonometry: yaw is clockwise from north."""
    steps = (np.arange(side_px) + 0.5 - side_px / 2) * pixel_m
    right, up = np.meshgrid(steps, -steps)
    yaw = math.radians(pose.yaw_deg)
    east = pose.easting_m + right * math.cos(yaw) + up * math.sin(yaw)
    north = pose.northing_m - right * math.sin(yaw) + up * math.cos(yaw)
    return east, north


def is_covered(shapes, crop):
    return shapely.contains_xy(shapely.union_all(shapes), *pixels_m(crop.pose, len(crop.rgb), crop.pixel_m))


@pytest.fixture(scope="module")
def town(towns):
    return read_region(towns / "regions" / "town-riverside")


@pytest.fixture(scope="module")
def hamlet(tmp_path_factory):
    return make_hamlet(tmp_path_factory.mktemp("hamlet"), off_m=(3.0, -2.0))


@pytest.fixture(scope="module")
def photographed(hamlet, tmp_path_factory):
    out = tmp_path_factory.mktemp("out")
    return read_region(
        world.built(hamlet.spec(), out, extract_folders=[hamlet.folder], imagery_folders=[hamlet.folder])
    )


def test_a_seed_gives_its_crops_again_and_another_gives_others(town):
    first, again, other = (list(islice(drawn_crops([town], seed=seed, side_px=64), 4)) for seed in (3, 3, 4))
    for one, same, strange in zip(first, again, other, strict=True):
        assert one.pose == same.pose != strange.pose
        np.testing.assert_array_equal(one.rgb, same.rgb)
        np.testing.assert_array_equal(one.labels, same.labels)


def test_what_is_drawn_changes_no_pose_and_no_label(town):
    full, bare = (
        list(islice(drawn_crops([town], seed=3, side_px=64, ingredients=what), 6))
        for what in (Ingredients(), Ingredients.none())
    )
    for one, other in zip(full, bare, strict=True):
        assert one.pose == other.pose
        np.testing.assert_array_equal(one.labels, other.labels)
        assert (one.rgb != other.rgb).mean() > 0.5


def test_labels_are_what_the_map_has_under_each_pixel_at_any_heading_and_scale(town):
    shapes = {name: town.features.geometry[(town.features["class"] == name)] for name in ("building", "green")}
    crops = list(islice(drawn_crops([town], seed=5, side_px=96, pixel_m=0.6, zoom=1.5), 8))
    assert {crop.classes for crop in crops} == {town.classes}
    assert max(crop.pixel_m for crop in crops) > 1.2 * min(crop.pixel_m for crop in crops)
    assert max(crop.pose.yaw_deg for crop in crops) > 90 + min(crop.pose.yaw_deg for crop in crops)
    found = 0
    for crop in crops:
        for name, areas in shapes.items():
            layer = crop.labels[crop.classes.index(name)]
            is_there = is_covered(areas, crop) & (layer != UNKNOWN)
            found += is_there.sum()
            assert ((layer == PRESENT) == is_there).mean() > 0.985, (name, crop.pose)
    assert found > 2000


def test_beyond_the_map_every_class_is_unknown():
    west = shapely.box(EAST - 400, NORTH - 400, EAST, NORTH + 400)
    labels = seen(sheet_of(*VILLAGE, land=west))
    east, _ = pixels_m(POSE, 128, 0.5)
    assert ((labels == UNKNOWN) == (east > EAST)).mean() > 0.995


def test_without_ingredients_a_house_is_drawn_where_the_map_has_it():
    sheet = sheet_of(HOUSE)
    shown = picture(sheet, Ingredients.none())
    ground = shown[-1, 0]
    is_house = (shown != ground).any(axis=-1)
    np.testing.assert_array_equal(is_house, seen(sheet)[CLASSES.index("building")] == PRESENT)


@pytest.mark.parametrize(("off_m", "most_m"), [(1.0, 1.8), (3.0, 5.4)])
def test_a_displaced_picture_lies_within_some_metres_of_its_map(off_m, most_m):
    sheet, label = sheet_of(HOUSE), seen(sheet_of(HOUSE))[CLASSES.index("building")] == PRESENT
    middle = np.argwhere(label).mean(axis=0)
    far_m = []
    for seed in range(8):
        shown = picture(sheet, replace(Ingredients.none(), off_m=off_m), seed)
        is_house = (shown != shown[-1, 0]).any(axis=-1)
        far_m.append(0.5 * np.hypot(*(np.argwhere(is_house).mean(axis=0) - middle)))
    assert 0.2 * off_m < max(far_m) < most_m


def test_where_all_things_are_missing_bare_ground_is_left(village):
    shown = picture(village, replace(Ingredients.none(), missing=1.0))
    assert (shown == shown[0, 0]).all()


@pytest.mark.parametrize("name", SWITCHES)
def test_each_switch_adds_something_to_a_bare_picture(name, village):
    bare = Ingredients.none()
    added = [
        (picture(village, replace(bare, **{name: True}), seed) != picture(village, bare, seed)).any(axis=-1).mean()
        for seed in range(8)
    ]
    assert max(added) > 0.002


def test_cars_stand_on_streets_and_car_parks_alone(village):
    bare, labels = Ingredients.none(), seen(village)
    added = np.zeros((128, 128), dtype=bool)
    for seed in range(8):
        added |= (picture(village, replace(bare, cars=True), seed) != picture(village, bare, seed)).any(axis=-1)
    paved = (labels[CLASSES.index("road_minor")] == PRESENT) | (labels[CLASSES.index("parking")] == PRESENT)
    assert added.any()
    assert (added & ~paved).sum() < 0.15 * added.sum()  # lorries reach over a kerb


def test_shadows_fall_beside_what_stands_up_and_darken(village):
    bare = Ingredients.none()
    plain, shaded = (picture(village, replace(bare, shadows=on), 4).astype(int) for on in (False, True))
    assert (shaded <= plain).all()
    is_dark = (shaded < plain).any(axis=-1)
    house = seen(village)[CLASSES.index("building")] == PRESENT
    assert is_dark[~house].sum() > 50


@pytest.mark.parametrize("rows", [(), *((row,) for row in VILLAGE)])
def test_a_map_with_one_thing_or_none_is_drawn_too(rows):
    sheet = sheet_of(*rows)
    for seed in range(4):
        assert picture(sheet, Ingredients(), seed).std() > 1


def test_a_stream_is_not_seen_in_the_lake_that_it_crosses():
    stream = ("waterway", shapely.LineString([(EAST - 60, NORTH - 20), (EAST + 60, NORTH - 24)]), 6.0)
    lake = ("water", shapely.box(EAST - 30, NORTH - 40, EAST + 30, NORTH + 10), np.nan)
    sheet = sheet_of(lake, stream)
    in_lake = seen(sheet)[CLASSES.index("water")] == PRESENT
    shown = [picture(sheet, Ingredients.none(), seed)[in_lake] for seed in range(6)]
    assert all((colours == colours[0]).all() for colours in shown)


def test_looks_of_one_place_are_unlike_each_other(village):
    means = np.array([picture(village, Ingredients(), seed).mean(axis=(0, 1)) for seed in range(24)])
    assert (means.std(axis=0) > 15).all()
    assert means.min() > 5
    assert means.max() < 250


@pytest.mark.parametrize(
    ("change", "word"), [({"wild": 1.5}, "wild"), ({"missing": -0.1}, "missing"), ({"off_m": 99.0}, "off_m")]
)
def test_ingredients_out_of_range_are_refused_by_name(change, word):
    with pytest.raises(ConfigError, match=word):
        Ingredients(**change)


@pytest.mark.parametrize(
    ("change", "word"),
    [({"seed": -1}, "seed"), ({"side_px": 4}, "side_px"), ({"pixel_m": 0.0}, "pixel_m"), ({"zoom": 0.5}, "zoom")],
)
def test_a_setting_out_of_range_is_refused_before_the_first_crop(change, word, town):
    with pytest.raises(ConfigError, match=word):
        drawn_crops([town], **{"seed": 1, **change})


def test_no_region_no_imagery_and_bounds_of_several_are_refused(town, photographed):
    with pytest.raises(ConfigError, match="at least one region"):
        drawn_crops([], seed=1)
    with pytest.raises(ConfigError, match="town-riverside has no real imagery"):
        real_crops([town], seed=1)
    record = photographed.imagery.record
    drawn = record.pictures[0].model_copy(update={"rendered": RenderedRecord.model_construct()})
    imagery = replace(photographed.imagery, record=record.model_copy(update={"pictures": (drawn,)}))
    with pytest.raises(ConfigError, match="hamlet has no real imagery"):  # a rendered one
        real_crops([replace(photographed, imagery=imagery)], seed=1)
    with pytest.raises(ConfigError, match="bounds_m is of one region"):
        real_crops([photographed, photographed], seed=1, bounds_m=(0.0, 0.0, 1.0, 1.0))
    with pytest.raises(ConfigError, match=r"shows 30 x 30 m of the map within the bounds"):
        real_crops([photographed], seed=1, bounds_m=(WEST + 50, SOUTH + 50, WEST + 80, SOUTH + 80))


def test_a_real_crop_is_the_picture_at_its_pose_less_the_measured_offset(photographed):
    offset = photographed.imagery.record.offset
    assert math.hypot(offset.east_m - 3.0, offset.north_m + 2.0) < 0.3
    whole = photographed.imagery.read(photographed.imagery.record.bounds_m, gsd_m=GSD_M)
    for crop in islice(real_crops([photographed], seed=2, side_px=96, pixel_m=GSD_M, zoom=1.0), 5):
        east, north = pixels_m(crop.pose, 96, crop.pixel_m)
        at = whole.grid.to_uv(np.column_stack([east.ravel() + offset.east_m, north.ravel() + offset.north_m])) - 0.5
        for band in range(3):
            expected = map_coordinates(whole.rgb[..., band].astype(float), at.T[::-1], order=1).reshape(96, 96)
            assert np.median(np.abs(expected - crop.rgb[..., band])) < 12  # windows are read on lattices of their own
        roof = crop.rgb[crop.labels[0] == PRESENT].mean() - crop.rgb[crop.labels[0] != PRESENT].mean()
        assert roof > 80


def test_real_crops_stay_within_their_bounds_and_show_every_part_of_them(photographed):
    bounds_m = (WEST + 100.0, SOUTH + 40.0, WEST + 340.0, SOUTH + 200.0)
    poses = []
    for crop in islice(real_crops([photographed], seed=6, side_px=64, bounds_m=bounds_m), 60):
        east, north = pixels_m(crop.pose, 64, crop.pixel_m)
        assert bounds_m[0] <= east.min() <= east.max() <= bounds_m[2]
        assert bounds_m[1] <= north.min() <= north.max() <= bounds_m[3]
        poses.append((crop.pose.easting_m, crop.pose.northing_m))
    assert (np.ptp(poses, axis=0) > 0.5 * np.array([240.0, 160.0])).all()


class HalfShown:
    """Imagery of which the east was not photographed."""

    def __init__(self, imagery):
        self._imagery, self.record, self.off_m = imagery, imagery.record, imagery.off_m

    def read(self, bounds_m, *, gsd_m=None):
        window = self._imagery.read(bounds_m, gsd_m=gsd_m)
        east = window.grid.to_centres_m(np.argwhere(window.is_known | True))[:, 0].reshape(window.grid.shape)
        shown = window.is_known & (east < WEST + SIDE_M / 2)
        return ImageryWindow(grid=window.grid, rgb=window.rgb * shown[..., None], is_known=shown)


def test_where_the_picture_shows_nothing_labels_are_unknown(photographed):
    half = replace(photographed, imagery=HalfShown(photographed.imagery))
    mixed = 0
    for crop in islice(real_crops([half], seed=3, side_px=96), 10):
        east, _ = pixels_m(crop.pose, 96, crop.pixel_m)
        is_hidden = east + photographed.imagery.record.offset.east_m > WEST + SIDE_M / 2 + 1
        assert (crop.labels[:, is_hidden] == UNKNOWN).all()
        assert np.mean(crop.labels[0] != UNKNOWN) >= 0.5
        mixed += is_hidden.any()
    assert mixed


def test_a_place_that_shows_too_little_is_said_to(photographed, monkeypatch):
    monkeypatch.setattr("sasgeo_bench.sensing.crops._MOST_TRIES", 5)
    monkeypatch.setattr("sasgeo_bench.sensing.crops._LEAST_KNOWN", 1.1)
    with pytest.raises(ImageryError, match="5 crops in turn show too little mapped ground"):
        next(real_crops([photographed], seed=1, side_px=64))
