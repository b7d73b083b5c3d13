# SPDX-License-Identifier: Apache-2.0
"""Buildings as `ouyang_cfbvm_pf` sees them: shapes that turn with the view, and shares of rings."""

import numpy as np
import pytest
from sasgeo_baselines.buildings import RINGS, Buildings, Windows, ring_shares

from sasgeo_bench.geometry.pose import Pose
from sasgeo_bench.regions.evidence import UNKNOWN

CLASSES = ("building",)


@pytest.fixture(scope="module")
def houses(made):
    """A long house, a square one and an L, well apart."""
    layers = np.zeros((1, 400, 400), dtype=np.uint8)
    layers[0, 150:170, 180:240] = 1
    layers[0, 220:240, 150:170] = 1
    layers[0, 200:240, 220:230] = layers[0, 230:240, 220:250] = 1
    return made.region_of(layers, classes=CLASSES)


def test_a_rectangle_is_measured_as_by_hand(houses):
    found = Buildings.of_map(houses)
    assert len(found) == 3
    by_area = found.shape[np.argsort(found.shape[:, 0])]
    assert np.exp(by_area[:, 0]) == pytest.approx([400.0, 600.0, 1200.0])
    square, ell, long = by_area
    assert np.exp(long[1]) == pytest.approx(3.0)
    assert (square[2], long[2]) == pytest.approx((1.0, 1.0))
    assert ell[2] < 0.8
    assert (square[3], long[3]) == pytest.approx((np.pi / 4, np.pi * 1200 / 80**2), rel=0.15)
    assert long[4] == pytest.approx((60**2 + 20**2) / 12 / 1200)
    assert long[6:] == pytest.approx([-0.8, 0.0], abs=1e-9)  # from west to east: twice 90 degrees
    assert np.abs(square[6:]) == pytest.approx([0.0, 0.0], abs=1e-9)


@pytest.mark.parametrize("yaw_deg", [0.0, 37.0, 250.0])
def test_buildings_of_a_view_turn_into_those_of_the_map(yaw_deg, made, houses):
    pose = Pose(easting_m=1200.0, northing_m=8800.0, yaw_deg=yaw_deg)
    seen = Buildings.of_view(made.view_of(houses, pose, size_cells=192))
    mapped = Buildings.of_map(houses)
    assert len(seen) == 3
    for at_m, shape in zip(pose.to_map(seen.middle_m), seen.turned(yaw_deg), strict=True):
        away_m = np.hypot(*(mapped.middle_m - at_m).T)
        assert away_m.min() <= 1.0
        assert shape == pytest.approx(mapped.shape[away_m.argmin()], abs=0.15)


def test_buildings_that_are_cut_off_are_left_out(made, houses):
    seen = made.view_of(houses, Pose(easting_m=1200.0, northing_m=8800.0, yaw_deg=0.0), size_cells=192)
    cells = seen.cells.copy()
    cells[0, :, :80] = UNKNOWN  # the square house, and the end of the long one
    assert len(Buildings.of_view(seen.replace(cells))) == 1
    assert len(Buildings.of_view(seen.replace(np.full_like(cells, UNKNOWN)))) == 0


def test_buildings_of_tiles_are_those_of_the_whole_map(houses, monkeypatch):
    whole = Buildings.of_map(houses)
    monkeypatch.setattr("sasgeo_baselines.buildings._TILE", 160)
    tiled = Buildings.of_map(houses)
    order, other = np.argsort(whole.shape[:, 0]), np.argsort(tiled.shape[:, 0])
    assert tiled.middle_m[other] == pytest.approx(whole.middle_m[order])
    assert tiled.shape[other] == pytest.approx(whole.shape[order])


def test_the_window_under_a_view_is_like_it_whatever_its_heading(made, houses):
    windows = Windows.of(houses)
    at = 8 * 17 + 8
    east_m, north_m = windows.middle_m[at].tolist()
    seen = made.view_of(houses, Pose(easting_m=east_m, northing_m=north_m, yaw_deg=123.0), size_cells=200)
    share = ring_shares(seen)
    assert share == pytest.approx(windows.share[at], abs=0.05)
    nearest = windows.nearest(share, count=2, place_m=(1200.0, 8800.0), radius_m=500.0)
    assert len(nearest) == 2
    assert np.hypot(*(nearest[0] - windows.middle_m[at])) <= 24.0
    unseen = seen.replace(np.full_like(seen.cells, UNKNOWN))
    assert np.isnan(ring_shares(unseen)).sum() == RINGS
