# SPDX-License-Identifier: Apache-2.0
"""The search finds what an exhaustive one finds, and scores what Eq. 8 says."""

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.ndimage import map_coordinates

from sasgeo_bench.core.errors import ShapeError
from sasgeo_bench.geometry.grid import Grid
from sasgeo_bench.geometry.pose import Pose, Prior, wrap_deg
from sasgeo_bench.regions.evidence import ABSENT, PRESENT, UNKNOWN, LayerBits, cell_offsets_m, observe
from sasgeo_bench.search.dense import Guess, LevelView, _Peaks
from sasgeo_bench.search.field import FULL, Field, Template, between, squares, warped
from sasgeo_bench.search.find import Search, exhaustive, rank, score_at, search
from sasgeo_bench.search.plan import Mode, Plan, all_around, posterior, thinned

ANYWHERE = Prior(center_m=None, radius_m=None, yaw_deg=None, yaw_sigma_deg=None, scale_sigma=0.0)
AGREE, EXTRA, MISSED = 1.0, 0.6, 0.4


def a_grid(side, cell_m=1.0):
    return Grid(epsg=32632, west_m=1000.0, north_m=2000.0, cell_size_m=cell_m, rows=side, cols=side)


def as_field(grid, layers):
    """A map of PRESENT, ABSENT and, where nothing is known, 255."""
    known = np.where((layers == FULL).any(axis=0), 0, FULL).astype(np.uint8)
    return Field.of(grid=grid, layers=np.where(layers == PRESENT, FULL, 0).astype(np.uint8), known=known)


def as_template(cells, cell_m=1.0):
    present, absent = (cells == PRESENT).astype(np.float32), (cells == ABSENT).astype(np.float32)
    weights = (AGREE + EXTRA) * present - MISSED * absent
    return Template(weights=weights, known=-EXTRA * present.sum(axis=0), cell_size_m=cell_m)


def eq_8(seen, mapped):
    """The sum of Eq. 8 as it is written, cell by cell."""
    gain = {(PRESENT, PRESENT): AGREE, (PRESENT, ABSENT): -EXTRA, (ABSENT, PRESENT): -MISSED}
    return sum(gain.get((z, m), 0.0) for z, m in zip(seen.ravel().tolist(), mapped.ravel().tolist(), strict=True))


def place_of(side, *, seed=0):
    """A made-up place: roads that cross at odd angles, houses, a lake."""
    rng = np.random.default_rng(seed)
    rows, cols = np.indices((side, side))
    layers = np.zeros((3, side, side), dtype=np.uint8)
    for angle, at in zip(rng.uniform(0, math.pi, 9), rng.uniform(0.2, 0.8, 9), strict=True):
        across = (rows - side * at) * math.cos(angle) + (cols - side * at) * math.sin(angle)
        layers[0][np.abs(across) < 2.5] = 1
    for row, col in rng.integers(0, side, (side // 2, 2)):
        layers[1, row : row + 6, col : col + 9] = 1
    row, col = rng.integers(side // 4, side // 2, 2)
    layers[2, row : row + side // 6, col : col + side // 4] = 1
    return layers


@pytest.fixture(scope="module")
def place():
    grid = a_grid(320)
    layers = place_of(320)
    return grid, layers, as_field(grid, layers)


def view_of(place, pose, size=96):
    grid, layers, _ = place
    return observe(LayerBits.of(layers), grid, pose, size_cells=size, cell_size_m=1.0)


def some_poses(grid, count, *, seed=3, margin_m=70.0):
    west, south, east, north = grid.bounds_m
    rng = np.random.default_rng(seed)
    return [
        Pose(
            easting_m=rng.uniform(west + margin_m, east - margin_m),
            northing_m=rng.uniform(south + margin_m, north - margin_m),
            yaw_deg=rng.uniform(0, 360),
        )
        for _ in range(count)
    ]


def off(one, other):
    return (
        math.dist((one.easting_m, one.northing_m), (other.easting_m, other.northing_m)),
        abs(float(wrap_deg(one.yaw_deg - other.yaw_deg))),
    )


@given(seed=st.integers(0, 10_000), rows=st.integers(1, 6), cols=st.integers(1, 6), quarter=st.integers(0, 3))
def test_the_linear_form_is_eq_8_cell_by_cell(seed, rows, cols, quarter):
    rng = np.random.default_rng(seed)
    mapped = rng.choice(np.array([ABSENT, PRESENT, FULL], dtype=np.uint8), (2, 12, 12), p=(0.6, 0.3, 0.1))
    mapped[:, (mapped == FULL).any(axis=0)] = FULL
    seen = rng.integers(0, 3, (2, rows, cols), dtype=np.uint8)
    top, left = rng.integers(-2, 12, 2)
    padded = np.pad(mapped, ((0, 0), (6, 6), (6, 6)), constant_values=FULL)
    height, width = (rows, cols) if quarter % 2 == 0 else (cols, rows)
    under = padded[:, top + 6 : top + 6 + height, left + 6 : left + 6 + width]
    laid = np.rot90(seen, -quarter, (1, 2))  # a heading of 90 degrees lays the top of the view to the east
    pose = Pose(easting_m=1000.0 + left + width / 2, northing_m=2000.0 - top - height / 2, yaw_deg=90.0 * quarter)
    if under.shape == laid.shape:
        assert score_at(as_field(a_grid(12), mapped), as_template(seen), pose) == pytest.approx(
            eq_8(laid, under), abs=1e-3
        )


def test_what_is_unknown_changes_nothing(place):
    grid, layers, field = place
    pose = some_poses(grid, 1)[0]
    seen = view_of(place, pose)
    seen[:, 20:60, 30:70] = UNKNOWN
    wild = layers.copy()
    hidden = score_at(field, as_template(seen), pose)
    west, north = grid.to_uv(np.array([[pose.easting_m, pose.northing_m]]))[0].astype(int)
    wild[:, north - 8 : north + 8, west - 8 : west + 8] ^= 1  # within what the view does not know
    assert score_at(as_field(grid, wild), as_template(seen), pose) == pytest.approx(hidden, abs=1e-3)
    assert score_at(as_field(grid, wild), as_template(view_of(place, pose)), pose) < hidden


@pytest.mark.parametrize("size", [48, 96, 160])
def test_noise_free_views_are_found_between_the_cells(place, size):
    for pose in some_poses(place[0], 3, margin_m=90.0):
        best = search(place[2], as_template(view_of(place, pose, size)), ANYWHERE).modes[0]
        metres, degrees = off(best.pose, pose)
        assert metres < 0.75
        assert degrees < 1.0


def test_the_exhaustive_search_agrees(place):
    for pose in some_poses(place[0], 2, seed=8):
        seen = view_of(place, pose)
        seen[:, :40] = UNKNOWN
        template = as_template(seen)
        reference = exhaustive(place[2], template, yaw_step_deg=2.0)
        metres, degrees = off(search(place[2], template, ANYWHERE).modes[0].pose, reference.pose)
        assert metres < math.sqrt(2)
        assert degrees <= 2.0


def test_scale_is_found_too_and_threads_change_nothing(place):
    pose = replace(some_poses(place[0], 1)[0], scale=1.12)
    prior = replace(ANYWHERE, scale_sigma=0.1)
    best = search(place[2], as_template(view_of(place, pose)), prior).modes[0].pose
    assert off(best, pose)[0] < 1.5
    assert best.scale == pytest.approx(1.12, abs=0.02)
    template = as_template(view_of(place, some_poses(place[0], 1)[0]))
    one, two = (search(place[2], template, ANYWHERE, Plan(threads=threads)) for threads in (1, 2))
    assert one == two


def test_a_prior_is_kept(place):
    grid, _, field = place
    truth, elsewhere = some_poses(grid, 2)
    template = as_template(view_of(place, truth))
    prior = Prior(
        center_m=(elsewhere.easting_m, elsewhere.northing_m),
        radius_m=40.0,
        yaw_deg=truth.yaw_deg,
        yaw_sigma_deg=5.0,
        scale_sigma=0.0,
    )
    found = search(field, template, prior)
    assert found.modes
    for mode in found.modes:
        assert off(mode.pose, elsewhere)[0] < 40.0 + 1.0
        assert off(mode.pose, truth)[1] < 2.5 * 5.0 + 5.0
    near = replace(prior, center_m=(truth.easting_m + 30.0, truth.northing_m))
    assert off(search(field, template, near).modes[0].pose, truth)[0] < 1.0


def test_a_small_disc_still_holds_its_place(place):
    truth = some_poses(place[0], 1)[0]
    for radius_m in (0.01, 5.0):
        prior = replace(ANYWHERE, center_m=(truth.easting_m, truth.northing_m), radius_m=radius_m)
        best = search(place[2], as_template(view_of(place, truth)), prior).modes[0]
        assert off(best.pose, truth)[0] < 1.0


def test_a_prior_off_the_map_or_a_blind_view_finds_nothing(place):
    truth = some_poses(place[0], 1)[0]
    template = as_template(view_of(place, truth))
    far = replace(ANYWHERE, center_m=(0.0, 0.0), radius_m=50.0)
    assert search(place[2], template, far).modes == ()
    blind = as_template(np.full((3, 96, 96), UNKNOWN, dtype=np.uint8))
    assert search(place[2], blind, ANYWHERE).modes == ()
    assert rank(place[2], blind, ANYWHERE, [truth])[0] == [None]


def test_a_view_larger_than_the_map_is_laid_on_it():
    grid = a_grid(64)
    layers = place_of(64)
    field = as_field(grid, layers)
    pose = Pose(easting_m=1035.0, northing_m=1970.0, yaw_deg=0.0)
    seen = observe(LayerBits.of(layers), grid, pose, size_cells=128, cell_size_m=1.0)
    assert off(search(field, as_template(seen), ANYWHERE).modes[0].pose, pose)[0] < 1.0


def test_modes_keep_their_distance_and_their_order(place):
    truth = some_poses(place[0], 1)[0]
    modes = search(place[2], as_template(view_of(place, truth)), ANYWHERE, count=8).modes
    assert len(modes) == 8
    assert [mode.score for mode in modes] == sorted((mode.score for mode in modes), reverse=True)
    for at, mode in enumerate(modes):
        assert all(off(mode.pose, other.pose)[0] >= Plan().apart_m for other in modes[:at])


def test_the_right_candidate_is_first(place):
    grid, _, field = place
    poses = some_poses(grid, 8)
    template = as_template(view_of(place, poses[5]))
    candidates = [replace(pose, easting_m=pose.easting_m + 10.0, yaw_deg=0.0) for pose in poses]
    found, null = rank(field, template, ANYWHERE, candidates)
    scores = [mode.score if mode else -math.inf for mode in found]
    assert int(np.argmax(scores)) == 5
    assert off(found[5].pose, poses[5])[0] < 1.0
    assert null.places > len(poses)
    beyond = Pose(easting_m=0.0, northing_m=0.0, yaw_deg=0.0)
    assert rank(field, template, ANYWHERE, [beyond, *candidates])[0][0] is None


def test_candidates_behind_the_beam_keep_their_order_below_the_others(place):
    poses = some_poses(place[0], 12)
    template = as_template(view_of(place, poses[0]))
    wide, _ = rank(place[2], template, ANYWHERE, poses)
    narrow, _ = rank(place[2], template, ANYWHERE, poses, Plan(beam=(3, 2)))
    assert all(narrow)
    assert narrow[0].pose == wide[0].pose
    assert len({mode.score for mode in narrow}) > 2


def test_copies_of_a_place_do_not_fill_the_beam(place):
    def guesses(owner, easts_m, best):
        poses = [Pose(easting_m=east_m, northing_m=0.0, yaw_deg=float(at)) for at, east_m in enumerate(easts_m)]
        return [Guess(mode=Mode(pose=pose, score=best - at), owner=owner) for at, pose in enumerate(poses)]

    template = as_template(view_of(place, some_poses(place[0], 1)[0]))
    found = Search(field=place[2], template=template, prior=ANYWHERE, plan=Plan(apart_m=25.0))
    crowded = guesses(0, [0.0, 4.0, 8.0, 20.0, 24.9, 26.0, 60.0, 61.0], best=9.0)
    kept, rest = found._cut(crowded, 4)
    assert [guess.mode.pose.easting_m for guess in kept] == [0.0, 4.0, 26.0, 60.0]
    assert rest[0] == kept[-1]
    assert [guess.mode.pose.easting_m for guess in rest[1:]] == [8.0, 20.0, 24.9, 61.0]
    assert max(guess.mode.score for guess in rest) == kept[-1].mode.score
    assert found._cut(crowded, 1)[0] == crowded[:1]
    assert found._cut([], 4) == ([], [])
    of_others = [guess for at in range(4) for guess in guesses(at, [0.0], best=9.0 - at)]
    assert found._cut(of_others, 4) == (of_others, [])  # each candidate has places of its own
    every = replace(found, plan=Plan(apart_m=0.0))
    assert every._cut(crowded, 5)[0] == crowded[:5]


def test_twice_the_ground_has_twice_the_beam_of_a_town():
    layers = place_of(256)
    field, template = as_field(a_grid(256, 25.0), layers), as_template(layers[:, 96:160, 96:160], 25.0)
    discs = [replace(ANYWHERE, center_m=(4200.0, -1200.0), radius_m=radius_m) for radius_m in (10.0, 2700.0, 3300.0)]
    searches = [Search(field=field, template=template, prior=prior, plan=Plan()) for prior in (*discs, ANYWHERE)]
    assert [each.patches for each in searches] == [1, 1, 2, 2]
    assert [Plan().width(depth, 3) for depth in range(6)] == [240, 72, 30, 18, 15, 15]


def test_what_does_not_fit_is_refused():
    cells, view = np.zeros((1, 8, 8), np.uint8), np.zeros((1, 2, 2), np.float32)
    for layers, known, words in ((cells, cells[0, :, :7], "known"), (cells + 0.0, cells[0], "uint8")):
        with pytest.raises(ShapeError, match=words):
            Field.of(grid=a_grid(8), layers=layers, known=known)
    for weights, known, words in ((view + np.nan, view[0], "finite"), (view, np.zeros((3, 2), np.float32), "weights")):
        with pytest.raises(ShapeError, match=words):
            Template(weights=weights, known=known, cell_size_m=1.0)


def test_only_what_is_thin_is_spread_on_large_cells():
    layers = np.zeros((2, 64, 64), dtype=np.uint8)
    layers[0, 32] = layers[1, :, 16:56] = 1
    level = as_field(a_grid(64), layers).level(8)
    road, wood = (level.cells.band(at) / FULL for at in (0, 1))
    assert np.flatnonzero(road[:, 0]).tolist() == [3, 4, 5]
    assert np.flatnonzero(wood[0]).tolist() == [2, 3, 4, 5, 6]
    assert level.thinner.tolist() == pytest.approx([1 / 17, 1.0, 1.0])


def test_peaks_beside_a_better_one_are_dropped():
    rng = np.random.default_rng(0)
    turns = all_around(10.0)
    yaw_deg, row, col = 10.0 * rng.integers(0, 36, 500), rng.integers(0, 12, 500), rng.integers(0, 12, 500)
    score = np.sort(rng.random(500).astype(np.float32))[::-1]
    peaks = _Peaks(score=score, row=row, col=col, yaw_deg=yaw_deg, scale=np.ones(500))
    chosen: list[int] = []
    for at in range(500):
        turned = abs(wrap_deg(yaw_deg[chosen] - yaw_deg[at])) < 15.0
        beside = np.maximum(abs(row[chosen] - row[at]), abs(col[chosen] - col[at])) <= 1
        if not (turned & beside).any():
            chosen.append(at)
    assert peaks.separate(500, turns) == chosen
    assert peaks.separate(7, turns) == chosen[:7]


def test_a_posterior_sums_to_one_and_grows_with_the_score():
    mass = posterior([3.0, 1.0, -2.0])
    assert mass.sum() == pytest.approx(1.0)
    assert mass[0] > mass[1] > mass[3] > mass[2]
    assert posterior([1e6, 0.0]).tolist() == [1.0, 0.0, 0.0]


def test_a_pose_that_is_given_is_followed_where_the_search_would_not_look(place):
    (truth,) = some_poses(place[0], 1)
    template = as_template(view_of(place, truth))
    turned = Prior(center_m=None, radius_m=None, yaw_deg=truth.yaw_deg + 120.0, yaw_sigma_deg=2.0, scale_sigma=0.0)
    near = replace(truth, easting_m=truth.easting_m + 3.0, yaw_deg=truth.yaw_deg + 2.0)
    alone = search(place[2], template, turned).modes[0].pose
    given = search(place[2], template, turned, starts=[near]).modes[0].pose
    assert off(alone, truth)[1] > 60.0
    assert off(given, truth)[0] < 1.0
    assert search(place[2], template, turned, starts=[]).modes[0].pose == alone


def test_thinning_ends_with_the_last_mode_that_is_asked_for():
    asked = []

    def modes():
        for at in range(9):
            asked.append(at)
            yield Mode(pose=Pose(easting_m=10.0 * at, northing_m=0.0, yaw_deg=0.0), score=-float(at))

    assert [mode.score for mode in thinned(modes(), 15.0, 2)] == [0.0, -2.0]
    assert asked == [0, 1, 2, 3]
    assert [mode.score for mode in thinned(modes(), 15.0)] == [0.0, -2.0, -4.0, -6.0, -8.0]


@pytest.mark.parametrize("pose", [(32_950.0, 30.0), (16_000.5, 12.25), (-5.0, 20.0), (90_000.0, 20.0)])
def test_a_map_that_is_longer_than_opencv_warps_is_read_under_the_view(pose):
    rng = np.random.default_rng(4)
    long = rng.integers(0, 256, (64, 33_000, 2), dtype=np.uint8)
    at = Pose(easting_m=pose[0], northing_m=pose[1], yaw_deg=30.0)
    frame = Grid(epsg=0, west_m=-16.0, north_m=16.0, cell_size_m=1.0, rows=32, cols=32)
    found = warped(
        long,
        between(frame, at, Grid(epsg=0, west_m=0.0, north_m=64.0, cell_size_m=1.0, rows=64, cols=33_000)),
        (32, 32),
    )
    left = int(np.clip(pose[0] - 100, 0, 32_700))
    part = Grid(epsg=0, west_m=float(left), north_m=64.0, cell_size_m=1.0, rows=64, cols=300)
    np.testing.assert_array_equal(found, warped(long[:, left : left + 300], between(frame, at, part), (32, 32)))


@pytest.mark.parametrize("pool", range(1, 10))
def test_squares_of_a_view_sum_to_the_last_bit_as_numpy_does(pool):
    bands = np.random.default_rng(pool).standard_normal((3, 37, 41)).astype(np.float32)
    found, frame = squares(bands, pool, cell_size_m=0.5)
    down, across = -37 % pool, -41 % pool
    wide = np.pad(bands, ((0, 0), (down // 2, down - down // 2), (across // 2, across - across // 2)))
    parts = wide.reshape(3, wide.shape[1] // pool, pool, wide.shape[2] // pool, pool)
    assert found.dtype == np.float32
    assert np.array_equal(found, parts.sum(axis=(2, 4)))
    assert found.shape[1:] == frame.shape


def test_scores_around_a_pose_are_sums_over_the_interpolated_map():
    rng = np.random.default_rng(5)
    layers = np.stack([place_of(60, seed=seed)[seed % 3] for seed in range(6)])  # seven bands: two fours
    field = as_field(a_grid(60), layers)
    view = Template(
        weights=rng.normal(size=(6, 12, 9)).astype(np.float32),
        known=rng.normal(size=(12, 9)).astype(np.float32),
        cell_size_m=1.0,
    )
    pose = Pose(easting_m=1028.3, northing_m=1969.6, yaw_deg=33.0, scale=1.1)
    of_level = LevelView.of(field, view, 1)
    table = of_level.scores(pose)
    assert table.std() > 3
    for down, right in np.ndindex(3, 3):
        moved = of_level.shifted(pose, down - 1, right - 1)
        points_m = moved.to_map(cell_offsets_m((12, 9), 1.0).reshape(-1, 2))
        cols, rows = field.grid.to_uv(points_m).T - 0.5
        bands = [*(layers == PRESENT).astype(float), np.ones((60, 60))]
        under = np.stack([map_coordinates(band, [rows, cols], order=1).reshape(12, 9) for band in bands])
        by_hand = float((under * view.bands).sum())
        assert table[down, right] == pytest.approx(by_hand, abs=0.5)  # OpenCV interpolates between 32 steps
        assert of_level.score(moved) == pytest.approx(table[down, right], abs=1e-3)
