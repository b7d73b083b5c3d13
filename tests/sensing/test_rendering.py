# SPDX-License-Identifier: Apache-2.0
"""Rendered pictures: geometry against hand-worked views, light against published numbers, styles that stay."""

import datetime as dt
from dataclasses import replace
from functools import lru_cache

import cv2
import numpy as np
import pandas as pd
import pytest
import shapely
from hypothesis import given
from hypothesis import strategies as st

from sasgeo_bench.core.errors import CameraError, ConfigError, ShapeError
from sasgeo_bench.geometry.grid import Grid
from sasgeo_bench.regions.evidence import ABSENT, PRESENT, UNKNOWN
from sasgeo_bench.sensing.camera import Camera, Intrinsics
from sasgeo_bench.sensing.ground import Plane
from sasgeo_bench.sensing.rendering.buildings import estimate_storeys
from sasgeo_bench.sensing.rendering.conditions import Conditions, Sun, cast_shadows, draw_conditions, expose, sun_at
from sasgeo_bench.sensing.rendering.ground import WOOD, green_kinds
from sasgeo_bench.sensing.rendering.palettes import PALETTES
from sasgeo_bench.sensing.rendering.plan import CROWN, Canvas, HeightPyramid, burn_numbers, trace
from sasgeo_bench.sensing.rendering.scene import Scene, make_scene, paint
from sasgeo_bench.sensing.rendering.seasons import SEASONS
from sasgeo_bench.sensing.rendering.texture import fractal, grain, noise
from sasgeo_bench.sensing.rendering.trees import BROAD, BUSH, CONIFER, Trees, paint_trees
from sasgeo_bench.sensing.rendering.view import labels, render, render_labelled, render_ortho
from tests.drawn_features import features_of

EPSG = 32632
EAST, NORTH = 500_000.0, 5_200_000.0
CLASSES = ("road_minor", "building", "water", "green")
HOUSE = shapely.box(EAST + 10, NORTH + 10, EAST + 22, NORTH + 20)
LENS = Intrinsics.from_field_of_view(horizontal_deg=60.0, width_px=192, height_px=160)
CLEAR = Conditions(noise=0.0, blur_px=0.0, jpeg_quality=0)


def features(*rows):
    """Features from (class, geometry, width or NaN)."""
    named = ({"class": name, "geometry": shape, "width_m": width} for name, shape, width in rows)
    return features_of(*named, timestamp=pd.Timestamp("2020-01-01"))


VILLAGE = (
    ("building", HOUSE, np.nan),
    ("road_minor", shapely.LineString([(EAST - 90, NORTH + 28), (EAST + 90, NORTH + 28)]), 6.0),
    ("water", shapely.box(EAST - 40, NORTH - 40, EAST - 15, NORTH - 12), np.nan),
    ("green", shapely.box(EAST - 40, NORTH - 5, EAST - 5, NORTH + 20), np.nan),
)


def scene_of(rows=VILLAGE, *, size_m=96.0, shift_m=0.0, **more) -> Scene:
    window = Grid.around(EAST + shift_m, NORTH, size_m=(size_m, size_m), cell_size_m=0.5, epsg=EPSG)
    land = shapely.box(EAST - 500, NORTH - 500, EAST + 500, NORTH + 500)
    more = {"place": "village"} | more
    return make_scene(features(*rows), CLASSES, land, window=window, **more)


@lru_cache(maxsize=2)
def village(relief: float = 1.0) -> Scene:
    return scene_of(relief=relief)


def camera(**more) -> Camera:
    values = {"east_m": EAST, "north_m": NORTH, "height_m": 80.0, "yaw_deg": 0.0}
    return Camera.pointed(intrinsics=LENS, **values | more)


def drawn(points_px) -> np.ndarray:
    """Mask of the convex outline of points."""
    mask = np.zeros((LENS.height_px, LENS.width_px), dtype=np.uint8)
    hull = cv2.convexHull(np.round(points_px - 0.5).astype(np.int32))
    return cv2.fillConvexPoly(mask, hull, 1).astype(bool)


def corners(height_m: float) -> np.ndarray:
    west, south, east, north = HOUSE.bounds
    return np.array([(x, y, height_m) for x in (west, east) for y in (south, north)])


def overlap(found, expected) -> float:
    return (found & expected).sum() / (found | expected).sum()


def test_the_sun_stands_where_the_published_example_says_and_a_time_without_zone_is_utc():
    # Reda and Andreas, NREL/TP-560-34302, appendix A.5: zenith 50.11 (refraction included), azimuth 194.34.
    when = dt.datetime(2003, 10, 17, 12, 30, 30, tzinfo=dt.timezone(dt.timedelta(hours=-7)))
    sun = sun_at(when, -105.1786, 39.742476)
    assert sun.elevation_deg == pytest.approx(90 - 50.11, abs=0.3)
    assert sun.azimuth_deg == pytest.approx(194.34, abs=0.5)
    moment = dt.datetime(2024, 5, 5, 10, 0, tzinfo=dt.UTC)
    assert sun_at(moment.replace(tzinfo=None), 10.0, 50.0) == sun_at(moment, 10.0, 50.0)


@pytest.mark.parametrize(
    ("name", "value"),
    [("cloud", -0.1), ("visibility_m", 0.0), ("noise", 1.0), ("season", "monsoon"), ("jpeg_quality", 101)],
)
def test_conditions_that_cannot_be_are_refused_by_name(name, value):
    with pytest.raises(ConfigError, match=name):
        Conditions(**{name: value})


def test_ordinary_conditions_are_drawn_alike_from_one_seed():
    first, again = (draw_conditions(np.random.default_rng(4)) for _ in range(2))
    assert first == again
    assert 20 <= first.sun.elevation_deg <= 65
    assert draw_conditions(np.random.default_rng(4), season="snow").season == "snow"


@given(row=st.integers(0, 40), col=st.integers(0, 40), wavelength_m=st.sampled_from([0.7, 2.0, 4.0]))
def test_a_window_of_noise_is_that_window_of_the_whole(row, col, wavelength_m):
    whole = Grid(epsg=EPSG, west_m=EAST, north_m=NORTH, cell_size_m=0.5, rows=64, cols=64)
    part = whole.window(row, col, 16, 20)
    for make in (lambda grid: noise(grid, wavelength_m, 3), lambda grid: fractal(grid, wavelength_m, 3), grain):
        np.testing.assert_allclose(make(part), make(whole)[row : row + 16, col : col + 20], atol=1e-4)


@pytest.mark.parametrize(("azimuth_deg", "step"), [(180.0, (-1, 0)), (270.0, (0, 1)), (0.0, (1, 0)), (90.0, (0, -1))])
def test_a_mast_throws_its_shadow_away_from_the_sun_as_long_as_its_height_asks(azimuth_deg, step):
    mast = np.zeros((61, 61), dtype=np.float32)
    mast[30, 30] = 10.0
    shade = cast_shadows(mast, 1.0, Sun(elevation_deg=45.0, azimuth_deg=azimuth_deg))
    rows, cols = np.nonzero(shade > 1e-3)
    reach = (rows - 30) * step[0] + (cols - 30) * step[1]
    assert len(rows) == 9
    assert set(reach.tolist()) == set(range(1, 10))
    assert shade[30 + 4 * step[0], 30 + 4 * step[1]] == pytest.approx(6.0, abs=1e-3)


def test_a_low_sun_reaches_as_far_as_step_by_step():
    rng = np.random.default_rng(2)
    heights = np.zeros((40, 400), dtype=np.float32)
    heights[:, 20:24] = rng.uniform(5, 20, size=(40, 1))
    shade = cast_shadows(heights, 0.5, Sun(elevation_deg=11.0, azimuth_deg=270.0))
    fall = 0.5 * np.tan(np.radians(11.0))
    expected = np.zeros_like(heights)
    for step in range(1, 300):
        expected[:, step:] = np.maximum(expected[:, step:], heights[:, :-step] - step * fall)
    np.testing.assert_allclose(shade, expected, atol=0.05)


def test_light_fades_and_turns_blue_at_nightfall_and_without_a_sun_all_is_in_shadow():
    noon, dusk = (expose(replace(CLEAR, sun=Sun(elevation_deg=e, azimuth_deg=0.0))) for e in (45.0, -6.0))
    assert dusk.sky.sum() < 0.5 * (noon.sky + noon.sun).sum()
    assert dusk.sky[2] > dusk.sky[0]
    assert not noon.lamp.any()
    assert dusk.lamp.any()
    assert noon.dark < dusk.dark <= 1
    heights = np.full((4, 4), 3.0, dtype=np.float32)
    assert (cast_shadows(heights, 1.0, Sun(elevation_deg=-5.0, azimuth_deg=0.0)) > heights).all()


def test_a_roof_lies_where_the_camera_projects_it_and_leans_outwards():
    """Relief displacement, nadir: everything between roof and foot of the house shows the house."""
    scene, view = village(), camera()
    eave_m = float(scene.buildings.eave_m[0])
    house = labels(scene, view)[CLASSES.index("building")] == PRESENT
    expected = drawn(view.project(np.vstack([corners(0.0), corners(eave_m)])))
    assert overlap(house, expected) > 0.85
    flat = labels(village(relief=0.0), view)[CLASSES.index("building")] == PRESENT
    assert overlap(flat, drawn(view.project(corners(0.0)))) > 0.9
    away = [np.hypot(*(np.argwhere(mask).mean(axis=0) - (80, 96))) for mask in (house, flat)]
    assert away[0] > away[1] + 0.5


def test_a_house_hides_the_road_behind_it_in_oblique_views():
    scene = scene_of((VILLAGE[0], VILLAGE[1]), relief=3.0)
    view = camera(tilt_deg=45.0, north_m=NORTH - 60, east_m=EAST + 16, height_m=70.0)
    behind = np.array([[EAST + 16, NORTH + 28, 0.0], [EAST + 50, NORTH + 28, 0.0]])
    (col, row), (free_col, free_row) = np.floor(view.project(behind)).astype(int)
    found = labels(scene, view)
    assert found[CLASSES.index("building"), row, col] == PRESENT
    assert found[CLASSES.index("road_minor"), row, col] == ABSENT
    assert found[CLASSES.index("road_minor"), free_row, free_col] == PRESENT


def test_rays_over_bare_ground_meet_it_where_the_camera_unprojects_them():
    view = camera(tilt_deg=35.0, yaw_deg=70.0)
    grid = Grid.around(EAST, NORTH, size_m=(100, 100), cell_size_m=0.5, epsg=EPSG)
    hits = trace(view, grid, HeightPyramid(np.zeros(grid.shape, dtype=np.float32)), slice(0, LENS.height_px))
    rows, cols = np.mgrid[0 : LENS.height_px : 20, 0 : LENS.width_px : 20]
    ground_m = view.unproject(np.stack([cols.ravel() + 0.5, rows.ravel() + 0.5], axis=1), Plane())
    uv = grid.to_uv(ground_m[:, :2])
    found = np.stack([hits.col[rows, cols].ravel(), hits.row[rows, cols].ravel()], axis=1)
    np.testing.assert_allclose(found, uv, atol=0.05)
    assert not hits.is_side.any()


def test_rays_meet_what_an_exhaustive_march_meets():
    rng = np.random.default_rng(8)
    grid = Grid.around(EAST, NORTH, size_m=(120, 120), cell_size_m=0.5, epsg=EPSG)
    heights = np.zeros(grid.shape, dtype=np.float32)
    for row, col in rng.integers(10, 220, size=(60, 2)):
        heights[row : row + 12, col : col + 9] = rng.uniform(2, 25)
    pyramid = HeightPyramid(heights)
    for tilt_deg in (0.0, 40.0):
        view = camera(tilt_deg=tilt_deg, yaw_deg=20.0)
        hits = trace(view, grid, pyramid, slice(0, LENS.height_px))
        for row, col in rng.integers(0, 160, size=(150, 2)):
            ground_col, ground_row = (
                (hits.col + hits.ahead[0] * hits.z_m)[row, col],
                (hits.row + hits.ahead[1] * hits.z_m)[row, col],
            )
            z = np.arange(26, 0, -0.02)
            c = np.clip(ground_col - hits.ahead[0][row, col] * z, 0, grid.cols - 1).astype(int)
            r = np.clip(ground_row - hits.ahead[1][row, col] * z, 0, grid.rows - 1).astype(int)
            met = np.flatnonzero(pyramid.height_m[r, c] >= z)
            expected = z[met[0]] if len(met) else 0.0
            run = np.hypot(*hits.ahead[:, row, col])
            assert hits.z_m[row, col] <= expected + 0.05
            assert (expected - hits.z_m[row, col]) * max(run, 0.05) < 6  # a corner of a cell may be cut


def painted(trees, *, season: str, height_m=0.0):
    """Height, kind and colour of a canvas after trees are painted on it, group by group."""
    plan = village().plan
    shape = plan.grid.shape
    canvas = Canvas(
        plan=plan,
        season=season,
        colour=np.zeros((*shape, 3), dtype=np.uint8),
        height_m=np.full(shape, height_m, dtype=np.float32),
        kind=np.zeros(shape, dtype=np.uint8),
        owner=np.ones(shape, dtype=np.int32),
    )
    if trees:
        paint_trees(canvas, trees)
    return canvas


def crowded(count: int, *, seed: int, side_m: float = 20.0) -> Trees:
    """Trees that stand in each other's crowns; some are equal in all."""
    rng = np.random.default_rng(seed)
    kinds = rng.integers(0, 12, count)  # so many different ones
    rng = np.random.default_rng(seed + 1)
    return Trees(
        at_m=(np.array([EAST, NORTH]) + rng.uniform(-side_m / 2, side_m / 2, (12, 2)))[kinds],
        radius_m=rng.uniform(0.6, 4.0, 12)[kinds],
        height_m=rng.uniform(1.0, 9.0, 12)[kinds],
        form=rng.choice([BROAD, CONIFER, BUSH], 12)[kinds],
        colour=rng.uniform(20, 200, (count, 3)),
        luck=rng.uniform(0, 1, 12)[kinds],
    )


@pytest.mark.parametrize("season", ["summer", "winter"])
def test_crowns_are_painted_as_one_by_one_from_the_lowest_and_group_by_group(season):
    groups = crowded(60, seed=1), crowded(40, seed=5)
    together = painted(groups, season=season, height_m=0.5)
    canvas = painted((), season=season, height_m=0.5)
    for trees in groups:
        for tree in np.argsort(trees.height_m, kind="stable"):
            paint_trees(canvas, [trees.part(np.array([tree]))])
    assert (together.kind == CROWN).sum() > 500
    for name in ("height_m", "kind", "owner", "colour"):
        np.testing.assert_array_equal(getattr(together, name), getattr(canvas, name), name)
    shown = together.kind == CROWN
    assert (together.height_m[shown] > 0.5).all()
    assert (together.height_m[~shown] == 0.5).all()
    assert together.owner[shown].max() == 0


def test_areas_are_numbered_as_shapely_holds_the_centres_of_cells_and_the_last_one_is_on_top():
    grid = Grid.around(EAST, NORTH, size_m=(60.0, 40.0), cell_size_m=0.5, epsg=EPSG)
    ring = shapely.Point(EAST + 3.2, NORTH - 1.1).buffer(17).difference(shapely.Point(EAST, NORTH).buffer(6))
    parts = shapely.MultiPolygon([shapely.box(EAST - 29, NORTH + 3.1, EAST - 20.1, NORTH + 30), HOUSE])
    beyond = shapely.box(EAST + 40, NORTH, EAST + 60, NORTH + 5)
    areas = np.array([ring, shapely.Polygon(), beyond, None, parts], dtype=object)
    centres = grid.to_centres_m(np.argwhere(np.ones(grid.shape, dtype=bool)))
    expected = np.zeros(grid.shape, dtype=np.int32)
    for number, area in enumerate(areas, 1):
        if area is not None:
            expected[shapely.contains_xy(area, *centres.T).reshape(grid.shape)] = number
    found = burn_numbers(areas, grid)
    np.testing.assert_array_equal(found, expected)
    assert set(np.unique(found)) == {0, 1, 5}


def test_what_a_crown_or_the_sky_hides_is_unknown_and_what_lies_beyond_the_map_too():
    view = camera(tilt_deg=75.0)
    found = labels(village(), view)
    assert (found[:, 0] == UNKNOWN).all()
    far = labels(village(), camera(east_m=EAST + 5000))
    assert (far == UNKNOWN).all()
    assert set(np.unique(labels(village(), camera()))) <= {ABSENT, PRESENT, UNKNOWN}


def test_one_generator_state_gives_one_picture_and_another_changes_its_noise_alone():
    scene, view = village(), camera()
    condition = replace(CLEAR, noise=0.01)
    first, again, other = (render(scene, view, condition, np.random.default_rng(seed)) for seed in (1, 1, 2))
    assert first.shape == (160, 192, 3)
    assert first.dtype == np.uint8
    np.testing.assert_array_equal(first, again)
    difference = np.abs(first.astype(int) - other)
    assert 0 < difference.mean() < 8


@pytest.mark.parametrize("family", list(PALETTES))
def test_bare_ground_has_the_colour_of_rock_or_sand_and_nothing_grows_on_it(family):
    quarry = shapely.box(EAST - 40, NORTH - 40, EAST + 40, NORTH + 40)
    wood = shapely.box(EAST - 48, NORTH - 48, EAST + 48, NORTH + 48)
    whole = scene_of((("bare", quarry, np.nan), ("green", wood, np.nan)), family=family)
    painting = paint(whole.plan, whole.buildings, "summer")
    middle = tuple(slice(side // 2 - 60, side // 2 + 60) for side in whole.plan.grid.shape)
    colour = painting.colours[0][middle].reshape(-1, 3).mean(axis=0)
    off = [np.abs(colour - np.array(wanted)).max() for wanted in PALETTES[family].bare]
    assert min(off) < 25
    assert not painting.heights.height_m[middle].any()


def test_labels_are_those_of_the_map_where_water_covers_a_river(monkeypatch):
    monkeypatch.setattr(f"{__name__}.CLASSES", ("water", "waterway"))
    river = ("waterway", shapely.LineString([(EAST - 45, NORTH), (EAST + 45, NORTH)]), 6.0)
    lake = ("water", shapely.box(EAST, NORTH - 30, EAST + 30, NORTH + 30), np.nan)
    water, line = labels(scene_of((river, lake)), camera())
    assert (line == PRESENT).sum() > 100
    assert not ((line == PRESENT) & (water == PRESENT)).any()


def test_a_picture_made_with_its_labels_is_the_one_made_without():
    scene, view, evening = village(), camera(tilt_deg=30.0), replace(CLEAR, season="autumn", noise=0.01)
    picture, found = render_labelled(scene, view, evening, np.random.default_rng(1))
    np.testing.assert_array_equal(picture, render(scene, view, evening, np.random.default_rng(1)))
    np.testing.assert_array_equal(found, labels(scene, view, season="autumn"))


def test_beyond_its_window_the_ground_mirrors_the_scene_and_is_unlabelled():
    scene, rng = village(), np.random.default_rng(0)
    edge_m = scene.grid.bounds_m[2]
    inside, beyond = (render(scene, camera(east_m=edge_m + far_m), CLEAR, rng) for far_m in (-30.0, 30.0))
    alike, turned = (np.corrcoef(picture.ravel(), beyond.ravel())[0, 1] for picture in (inside[:, ::-1], inside))
    assert alike > 0.8
    assert turned < 0.6
    assert (labels(scene, camera(east_m=edge_m + 60)) == UNKNOWN).all()


@pytest.mark.parametrize("season", SEASONS)
def test_every_season_and_family_gives_a_picture_with_texture(season):
    family = list(PALETTES)[SEASONS.index(season) % 4]
    scene = scene_of(size_m=64.0, family=family)
    picture = render(scene, camera(height_m=60.0), replace(CLEAR, season=season), np.random.default_rng(0))
    assert 40 < picture.mean() < 235
    assert picture.std() > 8


def test_snow_is_bright_night_is_dark_and_haze_is_flat():
    scene, rng = village(), np.random.default_rng(0)
    summer = render(scene, camera(), CLEAR, rng)
    snow = render(scene, camera(), replace(CLEAR, season="snow"), rng)
    night = render(scene, camera(), replace(CLEAR, sun=Sun(elevation_deg=-6.0, azimuth_deg=280.0)), rng)
    haze = render(scene, camera(), replace(CLEAR, visibility_m=300.0), rng)
    assert snow.mean() > summer.mean() + 30
    assert night.mean() < 0.7 * summer.mean()
    assert haze.std() < 0.7 * summer.std()


def test_a_house_keeps_its_style_when_others_come_and_go():
    shed = ("building", shapely.box(EAST - 30, NORTH + 35, EAST - 26, NORTH + 39), np.nan)
    alone, joined = scene_of(VILLAGE), scene_of((*VILLAGE, shed))
    for name in ("roof", "wall", "form", "cover"):
        np.testing.assert_array_equal(getattr(alone.buildings, name)[0], getattr(joined.buildings, name)[0])
    other = scene_of(VILLAGE, place="elsewhere")
    assert not np.array_equal(alone.buildings.roof[0], other.buildings.roof[0])


def test_larger_and_more_crowded_buildings_are_higher_on_average():
    key = np.arange(3000)

    def storeys(area_m2: float, crowded: float) -> float:
        return float(estimate_storeys(np.full(3000, area_m2), np.full(3000, crowded), seed=1, key=key).mean())

    assert storeys(15, 0.1) < storeys(60, 0.1) < storeys(150, 0.1) <= storeys(400, 0.1)
    assert storeys(500, 0.1) < storeys(500, 0.4)
    assert (estimate_storeys(np.full(3000, 600.0), np.full(3000, 0.4), seed=1, key=key) > 8).mean() < 0.08


def test_large_green_areas_are_woods_more_often():
    def share(side_m: float) -> float:
        square, flat = shapely.box(0, 0, side_m, side_m), np.zeros(2000, dtype=bool)
        many = {"geometry": np.array([square] * 2000), "key": np.arange(2000), "width_m": np.full(2000, np.nan)}
        many |= {"level": np.zeros(2000, dtype=int), "is_bridge": flat, "is_sea": flat}
        return float((green_kinds(replace(village().plan.of("green"), **many), 3) == WOOD).mean())

    assert share(20) < share(100) < share(500)


def test_no_two_families_share_a_roof_or_a_soil():
    for part in ("pitched", "flat"):
        colours = [roofing.colour for palette in PALETTES.values() for roofing in getattr(palette, part)]
        assert len(set(colours)) == len(colours)
    assert len({palette.soil for palette in PALETTES.values()}) == len(PALETTES)
    assert set(PALETTES) == {"train", "calibration", "test", "shifted"}


def test_what_cannot_be_rendered_is_refused_in_one_line():
    with pytest.raises(CameraError, match="fly higher"):
        render(village(), camera(height_m=2.0), CLEAR, np.random.default_rng(0))
    with pytest.raises(ShapeError, match="smaller window"):
        scene_of(size_m=10_000.0)
    window = Grid.around(EAST, NORTH, size_m=(50, 50), cell_size_m=0.5, epsg=32633)
    with pytest.raises(ShapeError, match="EPSG:32633"):
        make_scene(features(*VILLAGE), CLASSES, HOUSE, place="a", window=window)


def test_another_look_of_a_place_shares_no_draw_with_it():
    """Grain, tufts and stains of open ground correlate wholly within one look, and not at all between two."""
    rows = [(name, shapely.affinity.translate(shape, 300, 0), width) for name, shape, width in VILLAGE]
    one, again, other = (scene_of(rows, place=name) for name in ("village", "village", "village/survey"))
    colours = [scene.painting("summer").colours[0].mean(axis=2).ravel() for scene in (one, again, other)]
    assert np.corrcoef(colours[0], colours[1])[0, 1] == pytest.approx(1)
    assert abs(np.corrcoef(colours[0], colours[2])[0, 1]) < 0.1
    keys = [set(scene_of(place=name).plan.of("building").key.tolist()) for name in ("village", "village/survey")]
    assert not keys[0] & keys[1]


def test_from_straight_above_no_house_leans_over_the_road_whatever_its_height():
    """Roof and ground keep their colours where they are: the light of the sun aside, only shadows move."""
    window = Grid.around(EAST, NORTH, size_m=(80.0, 80.0), cell_size_m=0.5, epsg=EPSG)
    dull = replace(CLEAR, cloud=1.0)
    flat, high = (
        render_ortho(scene_of(relief=relief), window, dull, np.random.default_rng(1)) for relief in (0.0, 3.0)
    )
    off = np.abs(flat.astype(float) - high).mean(axis=2)
    rows, cols = np.indices(window.shape).reshape(2, -1)
    at_m = window.to_centres_m(np.column_stack([rows, cols]))
    away_m = shapely.distance(shapely.points(at_m), HOUSE).reshape(window.shape)
    assert flat.shape == (160, 160, 3)
    assert off[away_m > 12].max() <= 2  # leaning by 3 storeys would reach farther
