# SPDX-License-Identifier: Apache-2.0
"""What moves cells moves them where and as far as it says, and brings nothing in from beyond the view."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sasgeo_bench.regions.evidence import PRESENT, UNKNOWN, Evidence
from sasgeo_bench.tasks.perturbations.line_width import LayerOffset, LineWidth
from sasgeo_bench.tasks.perturbations.local_warp import LocalWarp, folded_share, moved, warped
from sasgeo_bench.tasks.perturbations.resample import resample
from sasgeo_bench.tasks.perturbations.rotation import Rotation
from sasgeo_bench.tasks.perturbations.scale import Scale
from sasgeo_bench.tasks.perturbations.tilt import Tilt


def dots(*places, cell_size_m=1.0, name="building", size=101):
    """Squares of three cells a side around (row, col)."""
    cells = np.zeros((1, size, size), dtype=np.uint8)
    for row, col in places:
        cells[0, row - 1 : row + 2, col - 1 : col + 2] = 1
    return Evidence(classes=(name,), cells=cells, cell_size_m=cell_size_m)


def middle_of(view):
    """Mean row and column of what is present."""
    return np.argwhere(view.cells[0] == PRESENT).mean(axis=0)


def test_a_turn_is_as_large_as_it_says_and_clockwise_where_it_says_so():
    for seed in range(4):
        turn = Rotation(angle_deg=30.0)
        angle_deg = turn.draw_deg(np.random.default_rng(seed))
        row, col = middle_of(turn(dots((20, 50)), np.random.default_rng(seed)))
        assert abs(angle_deg) == 30.0
        assert col - 50 == pytest.approx(30 * math.sin(math.radians(angle_deg)), abs=0.6)
        assert 50 - row == pytest.approx(30 * math.cos(math.radians(angle_deg)), abs=0.6)


def test_both_ways_of_turning_and_of_scaling_come_up():
    rngs = [np.random.default_rng(seed) for seed in range(20)]
    assert {Rotation(angle_deg=5.0).draw_deg(rng) for rng in rngs} == {-5.0, 5.0}
    assert {Scale(excess=0.25).draw_factor(rng) for rng in rngs} == {0.8, 1.25}


def test_a_magnified_view_shows_things_farther_from_the_centre_and_a_shrunk_one_an_unknown_rim():
    for seed in range(4):
        zoom = Scale(excess=0.25)
        factor = zoom.draw_factor(np.random.default_rng(seed))
        seen = zoom(dots((30, 50)), np.random.default_rng(seed))
        assert 50 - middle_of(seen)[0] == pytest.approx(20 * factor, abs=0.6)
        assert (seen.unknown_share > 0) == (factor < 1)


@pytest.mark.parametrize("tilt_deg", [1.0, 5.0, 15.0])
def test_a_lean_of_the_camera_displaces_the_ground_as_the_pinhole_says(tilt_deg):
    lean = Tilt(tilt_deg=tilt_deg, height_m=100.0, direction_deg=90.0, keeps_centre=False)
    seen = lean(dots((50, 80)), np.random.default_rng(0))
    # The ground 30 m to the right lies at atan(0.3) off the vertical, so at that less the tilt off the leaning axis.
    expected = 100 * math.tan(math.atan(0.3) - math.radians(tilt_deg))
    row, col = middle_of(seen)
    assert col - 50 == pytest.approx(expected, abs=0.7)
    assert row == pytest.approx(50, abs=0.2)


def test_a_tilt_that_keeps_the_centre_keeps_it_and_shrinks_what_lies_ahead():
    lean = Tilt(tilt_deg=10.0, height_m=100.0, direction_deg=0.0)
    assert middle_of(lean(dots((50, 50)), np.random.default_rng(0))) == pytest.approx((50, 50), abs=0.6)
    ahead, behind = (middle_of(lean(dots((row, 50)), np.random.default_rng(0)))[0] for row in (20, 80))
    assert 50 - ahead < 28
    assert behind - 50 > 30


def test_what_lies_beyond_the_horizon_is_unknown():
    low = Tilt(tilt_deg=45.0, height_m=10.0, direction_deg=0.0, keeps_centre=False)
    assert low(dots((50, 50)), np.random.default_rng(0)).cells[0, 0, 50] == UNKNOWN


@pytest.mark.parametrize("wavelength_m", [60.0, 90.0, 120.0])
@pytest.mark.parametrize("rms_m", [5.0, 10.0, 15.0])
@pytest.mark.parametrize("cell_size_m", [1.0, 2.0])
def test_the_warp_is_as_strong_and_as_long_as_it_says(rms_m, wavelength_m, cell_size_m):
    warp = LocalWarp(rms_m=rms_m, wavelength_m=wavelength_m)
    crossings, lengths = 0, []
    for seed in range(8):
        field = warp.field((192, 192), cell_size_m, np.random.default_rng(seed))
        lengths.append(np.sqrt((field**2).sum(axis=0).mean()))
        assert np.abs(field.mean(axis=(1, 2))).max() < 1e-6
        crossings += (np.diff(np.sign(field), axis=2) != 0).mean()
    assert lengths == pytest.approx([rms_m] * 8)
    # Waves of any heading cross zero along a row 2 / (wavelength * sqrt 2) times a metre (Rice's formula).
    assert crossings / 8 / cell_size_m == pytest.approx(math.sqrt(2) / wavelength_m, rel=0.25)


def test_equal_generators_give_the_field_that_the_warp_used(view):
    warp = LocalWarp(rms_m=8.0, wavelength_m=100.0)
    field = warp.field(view.shape, view.cell_size_m, np.random.default_rng(9))
    np.testing.assert_array_equal(warped(view, field).cells, warp(view, np.random.default_rng(9)).cells)


def test_points_move_with_the_cells():
    field = LocalWarp(rms_m=5.0, wavelength_m=120.0).field((101, 101), 1.0, np.random.default_rng(3))
    for row, col in ((30, 40), (50, 50), (70, 35), (60, 75)):
        point = np.array([[col - 50.0, 50.0 - row]])
        seen_row, seen_col = middle_of(warped(dots((row, col)), field))
        assert moved(point, field, 1.0)[0] == pytest.approx((seen_col - 50, 50 - seen_row), abs=1.0)


def test_a_gentle_warp_does_not_fold_and_a_violent_one_does():
    gentle, violent = (
        LocalWarp(rms_m=rms_m, wavelength_m=wavelength_m).field((192, 192), 1.0, np.random.default_rng(0))
        for rms_m, wavelength_m in ((5.0, 90.0), (15.0, 60.0))
    )
    assert folded_share(gentle, 1.0) == 0.0
    assert folded_share(violent, 1.0) > 0.1


@given(right=st.integers(-12, 12), up=st.integers(-12, 12), seed=st.integers(0, 99))
def test_a_shift_by_whole_cells_there_and_back_loses_only_what_left_the_view(right, up, seed):
    cells = np.random.default_rng(seed).integers(0, 2, size=(2, 10, 8), dtype=np.uint8)
    view = Evidence(classes=("water", "green"), cells=cells, cell_size_m=1.0, confidence=cells * 100)
    rights, ups = np.meshgrid(np.arange(8) - 3.5, 4.5 - np.arange(10))
    back = resample(resample(view, rights + right, ups + up), rights - right, ups - up)
    known = back.cells != UNKNOWN
    assert known.sum() == 2 * max(0, 8 - abs(right)) * max(0, 10 - abs(up))
    assert (back.cells[known] == cells[known]).all()
    assert (back.confidence[known] == 100 * cells[known]).all()
    assert (back.confidence[~known] == 0).all()


def test_lines_grow_and_narrow_by_metres_whatever_the_cell_and_areas_do_not():
    for cell_size_m, extra in ((1.0, 4), (2.0, 2)):
        cells = np.zeros((2, 40, 40), dtype=np.uint8)
        cells[:, :, 15:25] = 1
        road = Evidence(classes=("road_minor", "green"), cells=cells, cell_size_m=cell_size_m)
        for sign in (1, -1):
            seen = LineWidth(grow_m=2.0 * sign)(road, np.random.default_rng(0))
            assert seen.cells[0, 20].sum() == 10 + sign * extra
            assert (seen.cells[1] == cells[1]).all()


def test_narrowing_breaks_no_line(view):
    seen = LineWidth(grow_m=-2.0)(view, np.random.default_rng(0))
    for name in ("path_track", "waterway", "road_minor"):
        assert (seen.layer(name) <= view.layer(name)).all()
        assert (seen.layer(name) == PRESENT).sum() > 0.2 * (view.layer(name) == PRESENT).sum()


def test_each_layer_is_off_by_the_same_length_in_its_own_direction():
    square = dots((50, 50)).cells
    both = Evidence(classes=("building", "road_minor"), cells=np.repeat(square, 2, axis=0), cell_size_m=1.0)
    seen = LayerOffset(offset_m=10.0)(both, np.random.default_rng(1))
    offsets = [np.argwhere(layer == PRESENT).mean(axis=0) - 50 for layer in seen.cells]
    assert [np.hypot(*offset) for offset in offsets] == pytest.approx([10, 10], abs=0.8)
    assert np.hypot(*(offsets[0] - offsets[1])) > 2
    stays = LayerOffset(offset_m=10.0, thin_only=True)(both, np.random.default_rng(1))
    assert (stays.cells[0] == square[0]).all()
