# SPDX-License-Identifier: Apache-2.0
"""A perfect view is found where it was cut; errors of sign, half a cell or axes are noticed; ties and silence."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sasgeo_bench.geometry.pose import Pose, Prior, wrap_deg
from sasgeo_bench.matching.controls.fft_vote import FftVote
from sasgeo_bench.matching.matcher import check_match
from sasgeo_bench.search.vote_search import VotePlan, VoteSearch, turns

CELL_M, YAW_STEP_DEG = 1.0, 3.0
POSES = st.builds(
    Pose,
    easting_m=st.floats(1130, 1290),
    northing_m=st.floats(8710, 8870),
    # Along the map's own axes all poses of a cell give one view: there it tells half a cell a side at best.
    yaw_deg=st.builds(lambda quarter, rest: 90.0 * quarter + rest, st.integers(0, 3), st.floats(2, 88)),
    scale=st.floats(0.95, 1.05),
)
SOME = (
    Pose(easting_m=1170.3, northing_m=8801.6, yaw_deg=37.0, scale=1.02),
    Pose(easting_m=1222.8, northing_m=8755.1, yaw_deg=251.0, scale=0.97),
    Pose(easting_m=1241.4, northing_m=8820.9, yaw_deg=121.0, scale=1.0),
)


def prior_near(pose: Pose, *, sigma_deg: float | None = 10.0) -> Prior:
    """A disc that the pose is not in the middle of, a heading that is off."""
    return Prior(
        center_m=(pose.easting_m + 31.0, pose.northing_m - 22.0),
        radius_m=60.0,
        yaw_deg=None if sigma_deg is None else (pose.yaw_deg + 7.0) % 360,
        yaw_sigma_deg=sigma_deg,
        scale_sigma=0.03,
    )


def errors(made, matcher, pose: Pose, *, size_cells: int = 96) -> tuple[float, float]:
    """How far off a perfect view is found, in cells and degrees."""
    region = made.region_of(made.textured(1))
    matcher.prepare(region, None)
    query = made.query_of(made.view_of(region, pose, size_cells=size_cells), prior_near(pose))
    best = check_match(matcher.match(query, top_k=3), query, top_k=3).poses[0]
    away_m = np.hypot(best.easting_m - pose.easting_m, best.northing_m - pose.northing_m)
    return float(away_m / CELL_M), float(abs(wrap_deg(best.yaw_deg - pose.yaw_deg)))


def is_found(found: tuple[float, float]) -> bool:
    return found[0] <= 0.5 and found[1] <= YAW_STEP_DEG / 2


@settings(max_examples=8)
@given(pose=POSES)
def test_a_perfect_view_is_found_within_half_a_cell_and_half_a_yaw_step(made, pose) -> None:
    assert is_found(errors(made, FftVote(), pose))


def test_a_view_is_found_without_any_prior_and_on_cells_of_another_size(made) -> None:
    region = made.region_of(made.textured(2, side=240), cell_size_m=2.0)
    pose = Pose(easting_m=1251.0, northing_m=8733.0, yaw_deg=200.0)
    matcher = FftVote(VotePlan(yaw_step_deg=6.0))
    matcher.prepare(region, None)
    nothing = Prior(center_m=None, radius_m=None, yaw_deg=None, yaw_sigma_deg=None, scale_sigma=0.0)
    query = made.query_of(made.view_of(region, pose, size_cells=128), nothing)
    best = check_match(matcher.match(query, top_k=1), query, top_k=1).poses[0]
    assert np.hypot(best.easting_m - pose.easting_m, best.northing_m - pose.northing_m) <= 1.0


@pytest.mark.parametrize("candidates", [(), SOME])
def test_headings_at_right_angles_may_share_a_template(made, monkeypatch, candidates) -> None:
    region = made.region_of(made.textured(1))
    matcher = FftVote(VotePlan(yaw_step_deg=10.0))
    matcher.prepare(region, None)
    prior = prior_near(SOME[1], sigma_deg=None)
    query = made.query_of(made.view_of(region, SOME[1], size_cells=96), prior, candidates=candidates)
    shared = matcher.match(query, top_k=3)
    monkeypatch.setattr(VoteSearch, "_quarters", lambda *_: 1)
    alone = matcher.match(query, top_k=3)
    assert shared.poses == alone.poses
    assert shared.scores == pytest.approx(alone.scores, abs=1e-6)
    # Cells on an edge, as many are at heading 0, go either way by rounding.
    assert shared.diagnostics == pytest.approx(alone.diagnostics, rel=2e-3)


def test_headings_reach_as_far_as_in_all_searches_and_scales_two_standard_deviations() -> None:
    prior = Prior(center_m=None, radius_m=None, yaw_deg=350.0, yaw_sigma_deg=20.0, scale_sigma=0.03)
    tried = turns(prior, VotePlan())
    yaws = [float(wrap_deg(pose.yaw_deg - 350.0)) for pose in tried]
    assert (min(yaws), max(yaws)) == pytest.approx((-50.0, 50.0))
    assert {round(pose.scale, 2) for pose in tried} == {0.94, 1.0, 1.06}
    assert len(turns(replace(prior, yaw_deg=None, yaw_sigma_deg=None, scale_sigma=0.0), VotePlan())) == 120
