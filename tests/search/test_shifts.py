# SPDX-License-Identifier: Apache-2.0
"""Search by overlaps: correlations against sums that are written out, and poses of views cut from a map."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from sasgeo_bench.geometry.pose import Pose, Prior
from sasgeo_bench.search.shifts import Overlaps, ShiftPlan, ShiftSearch
from sasgeo_bench.search.view import Chart
from tests.made_up import region_of, textured, view_of

CELLS = arrays(np.float32, (2, 3, 3), elements=st.floats(-2, 2, width=32))
MAPS = arrays(np.float32, (2, 6, 7), elements=st.floats(-2, 2, width=32))


@given(CELLS, MAPS)
def test_sums_are_those_of_a_view_laid_on_the_map(seen, mapped):
    overlaps = Overlaps.of(seen, mapped, places=(4, 5))
    for view, layer in np.ndindex(2, 2):
        expected = [
            [float((seen[view] * mapped[layer, row : row + 3, col : col + 3]).sum()) for col in range(5)]
            for row in range(4)
        ]
        np.testing.assert_allclose(overlaps.sums(view, layer), expected, atol=1e-4)
    np.testing.assert_allclose(overlaps.totals, seen.sum(axis=(1, 2)), atol=1e-5)


def added(overlaps):
    """Score by the sum of like channels."""
    return overlaps.sums(0, 0) + overlaps.sums(1, 1)


@pytest.fixture(scope="module")
def chart():
    return Chart.of(region_of(textured(3, 700)))


def search_of(chart, pose, prior, *, plan=None, score=added):
    region = region_of((chart.degree > 0).astype(np.uint8))
    cells = view_of(region, pose, size_cells=128).cells[:2]
    channels = (cells == 1) - (cells == 1).mean(axis=(1, 2), keepdims=True)
    return ShiftSearch(
        chart=chart,
        bands=np.array([0, 1]),
        channels=channels.astype(np.float32),
        cell_size_m=1.0,
        score=score,
        prior=prior,
        plan=plan or ShiftPlan(),
    )


def off(mode, pose):
    return np.hypot(mode.pose.easting_m - pose.easting_m, mode.pose.northing_m - pose.northing_m)


@pytest.mark.parametrize("yaw_deg", [0.0, 90.0, 141.0, 333.0])
def test_a_view_is_found_where_it_was_cut_and_its_heading(chart, yaw_deg):
    pose = Pose(easting_m=1330.0, northing_m=8690.0, yaw_deg=yaw_deg)
    prior = Prior(center_m=(1400.0, 8640.0), radius_m=150.0, yaw_deg=yaw_deg + 7.0, yaw_sigma_deg=5.0, scale_sigma=0.03)
    best, *others = search_of(chart, pose, prior).places(5)
    assert off(best, pose) < 2
    assert abs((best.pose.yaw_deg - yaw_deg + 180) % 360 - 180) < 1
    assert all(off(mode, best.pose) >= 25 for mode in others)
    assert [mode.score for mode in others] == sorted((mode.score for mode in others), reverse=True)


def test_without_a_prior_the_whole_map_and_circle_are_searched(chart):
    pose = Pose(easting_m=1180.0, northing_m=8450.0, yaw_deg=200.0)
    anywhere = Prior(center_m=None, radius_m=None, yaw_deg=None, yaw_sigma_deg=None, scale_sigma=0.0)
    plan = ShiftPlan(coarse_m=6.0, yaw_step_deg=6.0)
    (best,) = search_of(chart, pose, anywhere, plan=plan).places(1)
    assert off(best, pose) < 3
    assert abs(best.pose.yaw_deg - 200.0) < 2


def test_the_best_pose_near_each_candidate_is_found_and_none_off_the_map(chart):
    pose = Pose(easting_m=1330.0, northing_m=8690.0, yaw_deg=30.0)
    prior = Prior(center_m=None, radius_m=None, yaw_deg=30.0, yaw_sigma_deg=2.0, scale_sigma=0.0)
    near, far, beyond = (
        replace(pose, easting_m=pose.easting_m + 12),
        replace(pose, northing_m=8500.0),
        replace(pose, easting_m=9e4),
    )
    found = search_of(chart, pose, prior).candidates([near, far, beyond])
    assert off(found[0], pose) < 4
    assert found[0].score > 1.5 * found[1].score
    assert off(found[1], far) <= 24
    assert found[2] is None


def test_a_disc_off_the_map_holds_no_place_and_scores_may_rule_places_out(chart):
    pose = Pose(easting_m=1330.0, northing_m=8690.0, yaw_deg=30.0)
    away = Prior(center_m=(5e4, 5e4), radius_m=100.0, yaw_deg=30.0, yaw_sigma_deg=2.0, scale_sigma=0.0)
    assert search_of(chart, pose, away).places(3) == []
    here = replace(away, center_m=(1330.0, 8690.0))
    assert search_of(chart, pose, here, score=lambda overlaps: added(overlaps) - np.inf).places(3) == []


def test_places_of_large_maps_are_searched_tile_by_tile(chart, monkeypatch):
    pose = Pose(easting_m=1330.0, northing_m=8690.0, yaw_deg=0.0)
    prior = Prior(center_m=(1350.0, 8650.0), radius_m=300.0, yaw_deg=0.0, yaw_sigma_deg=3.0, scale_sigma=0.0)
    whole = search_of(chart, pose, prior).places(3)
    monkeypatch.setattr("sasgeo_bench.search.shifts._TILE", 40)
    parts = search_of(chart, pose, prior).places(3)
    assert whole[0].pose == parts[0].pose
    assert parts[0].score == pytest.approx(whole[0].score, rel=1e-4)
