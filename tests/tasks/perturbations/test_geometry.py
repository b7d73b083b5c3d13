# SPDX-License-Identifier: Apache-2.0
"""A warp moves cells where and as far as it says, and brings nothing in from outside the view."""

import math

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sasgeo_bench.regions.evidence import PRESENT, UNKNOWN, Evidence
from sasgeo_bench.tasks.perturbations.base import resample
from sasgeo_bench.tasks.perturbations.local_warp import LocalWarp, RowJitter, Tilt, folded_share, moved, warped


def dots(*places, cell_size_m=1.0, name="building", size=101):
    """Squares of three cells a side around (row, col)."""
    cells = np.zeros((1, size, size), dtype=np.uint8)
    for row, col in places:
        cells[0, row - 1 : row + 2, col - 1 : col + 2] = 1
    return Evidence(classes=(name,), cells=cells, cell_size_m=cell_size_m)


def middle_of(view):
    """Mean row and column of what is present."""
    return np.argwhere(view.cells[0] == PRESENT).mean(axis=0)


@pytest.mark.parametrize("rms_m", [5.0, 10.0, 15.0])
@pytest.mark.parametrize("cell_size_m", [1.0, 2.0])
def test_the_warp_is_as_strong_and_as_long_as_it_says(rms_m, cell_size_m):
    warp = LocalWarp(rms_m=rms_m)
    crossings, lengths = 0, []
    for seed in range(8):
        field = warp.field((192, 192), cell_size_m, np.random.default_rng(seed))
        lengths.append(np.sqrt((field**2).sum(axis=0).mean()))
        assert np.abs(field.mean(axis=(1, 2))).max() < 1e-6
        crossings += (np.diff(np.sign(field), axis=2) != 0).mean()
    assert lengths == pytest.approx([rms_m] * 8)
    # Waves of any heading cross zero along a row 2 / (wavelength * sqrt 2) times a metre (Rice's formula).
    assert crossings / 8 / cell_size_m == pytest.approx(math.sqrt(2) / 90.0, rel=0.25)


@pytest.mark.parametrize("kind", [RowJitter, Tilt])
@pytest.mark.parametrize("rms_m", [5.0, 15.0])
def test_the_other_warps_are_as_strong_as_they_say_and_do_not_fold(kind, rms_m):
    for seed, side in enumerate((96, 192, 384)):
        field = kind(rms_m=rms_m).field((side, side), 1.0, np.random.default_rng(seed))
        assert np.sqrt((field**2).sum(axis=0).mean()) == pytest.approx(rms_m, rel=1e-6)
        assert np.abs(field.mean(axis=(1, 2))).max() < 1e-6
        assert folded_share(field, 1.0) == 0.0


def test_a_rolling_shutter_moves_each_row_as_a_whole():
    field = RowJitter(rms_m=10.0).field((64, 80), 1.0, np.random.default_rng(1))
    assert np.ptp(field, axis=2).max() == 0.0
    assert (field[0] ** 2).mean() == pytest.approx(4 * (field[1] ** 2).mean())


def test_a_tilt_is_a_homography_that_no_place_heading_or_scale_explains():
    field = Tilt(rms_m=10.0).field((65, 65), 1.0, np.random.default_rng(1))
    up, right = np.mgrid[32:-33:-1, -32:33]
    here, off = np.stack((right, up), axis=-1)[::8, ::8].reshape(-1, 2), field[:, ::8, ::8].reshape(2, -1).T
    _, agree = cv2.findHomography(here.astype(float), here + off, cv2.RANSAC, 0.01)
    assert agree.all()
    shown = (right + field[0]) + 1j * (up + field[1])
    by_similarity = (shown.conj() * (right + 1j * up)).mean() / (np.abs(shown) ** 2).mean()
    assert by_similarity == pytest.approx(1.0)


@pytest.mark.parametrize("kind", [LocalWarp, RowJitter, Tilt])
def test_equal_generators_give_the_field_that_the_warp_used(view, kind):
    warp = kind(rms_m=8.0)
    field = warp.field(view.shape, view.cell_size_m, np.random.default_rng(9))
    np.testing.assert_array_equal(warped(view, field).cells, warp(view, np.random.default_rng(9)).cells)


@pytest.mark.parametrize("kind", [LocalWarp, RowJitter, Tilt])
def test_points_move_with_the_cells(kind):
    field = kind(rms_m=5.0).field((101, 101), 1.0, np.random.default_rng(3))
    for row, col in ((30, 40), (50, 50), (70, 35), (60, 75)):
        point = np.array([[col - 50.0, 50.0 - row]])
        seen_row, seen_col = middle_of(warped(dots((row, col)), field))
        assert moved(point, field, 1.0)[0] == pytest.approx((seen_col - 50, 50 - seen_row), abs=1.0)


def test_a_gentle_warp_does_not_fold_and_a_violent_one_does():
    gentle, violent = (LocalWarp(rms_m=rms_m).field((192, 192), 1.0, np.random.default_rng(0)) for rms_m in (5.0, 25.0))
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
