# SPDX-License-Identifier: Apache-2.0
"""Errors of fixes: none clipped, none left out; what lies on a tolerance is within it."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from scipy.integrate import trapezoid

from sasgeo_bench.core.errors import MetricError
from sasgeo_bench.geometry.pose import Pose, inverse, wrap_deg
from sasgeo_bench.matching.matcher import Prediction
from sasgeo_bench.scoring.base import weighted_mean, weighted_quantile
from sasgeo_bench.scoring.pose import (
    MISS,
    PoseErrors,
    area_values,
    columns_of,
    first_pose,
    pose_errors,
    rank_of,
    ranks_of_lists,
    successes,
)

POSES = st.builds(
    Pose,
    easting_m=st.floats(-1e4, 1e4),
    northing_m=st.floats(-1e4, 1e4),
    yaw_deg=st.floats(0, 359.9),
    scale=st.floats(0.5, 2.0),
)
ERRORS_M = arrays(np.float64, st.integers(1, 12), elements=st.one_of(st.floats(0, 120), st.just(math.inf)))


def success_rate(errors, within_m):
    return weighted_mean(successes(errors, within_m))


def success_auc(errors):
    return weighted_mean(area_values(errors))


def only_position(position_m) -> PoseErrors:
    zero = np.zeros(len(position_m))
    return PoseErrors(position_m=np.asarray(position_m, dtype=float), yaw_deg=zero, log_scale=zero)


@given(one=POSES, other=POSES)
def test_errors_are_those_of_the_relative_pose_and_do_not_care_which_is_true(one, other) -> None:
    errors, swapped = (pose_errors(columns_of([a]), columns_of([b])) for a, b in ((one, other), (other, one)))
    offset_m = inverse(other).to_map(np.array([(one.easting_m, one.northing_m)]))
    assert errors.position_m[0] == pytest.approx(np.linalg.norm(offset_m) * other.scale, rel=1e-6, abs=1e-6)
    assert errors.yaw_deg[0] == pytest.approx(abs(wrap_deg(one.yaw_deg - other.yaw_deg)), abs=1e-6)
    assert errors.log_scale[0] == pytest.approx(abs(math.log(one.scale / other.scale)), abs=1e-9)
    for name in ("position_m", "yaw_deg", "log_scale"):
        assert getattr(errors, name)[0] == pytest.approx(getattr(swapped, name)[0])
    assert errors.yaw_deg[0] <= 180.0


def test_errors_worked_by_hand() -> None:
    truth = Pose(easting_m=100.0, northing_m=200.0, yaw_deg=355.0, scale=1.0)
    given_poses = [Pose(easting_m=103.0, northing_m=204.0, yaw_deg=5.0, scale=1.1), truth, None]
    errors = pose_errors(columns_of(given_poses), columns_of([truth] * 3))
    assert errors.position_m.tolist() == [5.0, 0.0, math.inf]
    assert errors.yaw_deg.tolist() == [10.0, 0.0, math.inf]
    np.testing.assert_allclose(errors.log_scale, [math.log(1.1), 0.0, math.inf])


def test_what_lies_on_a_tolerance_is_within_it() -> None:
    errors = PoseErrors(
        position_m=np.array([5.0, np.nextafter(5.0, 6.0), 5.0]),
        yaw_deg=np.array([5.0, 5.0, np.nextafter(5.0, 6.0)]),
        log_scale=np.zeros(3),
    )
    assert successes(errors, 5.0).tolist() == [True, False, False]
    assert successes(errors, 5.0, 180.0).tolist() == [True, False, True]
    assert success_rate(errors, 5.0) == pytest.approx(1 / 3)


def test_a_query_without_an_answer_stays_in_every_denominator() -> None:
    errors = only_position([1.0, 2.0, math.inf, math.inf])
    assert success_rate(errors, 5.0) == 0.5
    assert success_auc(errors) == pytest.approx((0.98 + 0.96) / 4)
    assert weighted_quantile(errors.position_m, 0.5) == 2.0
    assert weighted_quantile(errors.position_m, 0.9) == math.inf


def test_large_errors_are_neither_clipped_nor_dropped() -> None:
    assert weighted_quantile([1.0, 2.0, 1e6], 0.99) == 1e6
    assert weighted_quantile([math.inf] * 3, 0.5) == math.inf


@given(errors_m=ERRORS_M)
def test_the_area_is_that_under_the_success_rate_over_its_tolerance(errors_m) -> None:
    errors = only_position(errors_m)
    # The curve steps at each error, so it is integrated piece by piece, with its value in the middle of the piece.
    edges = np.unique(np.concatenate(([0.0, 50.0], errors_m[errors_m < 50.0])))
    middles = (edges[1:] + edges[:-1]) / 2
    rates = np.array([success_rate(errors, within_m) for within_m in middles])
    assert success_auc(errors) == pytest.approx(float(rates @ np.diff(edges)) / 50.0)
    grid = np.linspace(0.0, 50.0, 2001)
    fine = trapezoid([success_rate(errors, within_m) for within_m in grid[::20]], grid[::20]) / 50.0
    assert success_auc(errors) == pytest.approx(fine, abs=0.011)


@given(errors_m=ERRORS_M)
def test_success_is_monotone_in_the_tolerance(errors_m) -> None:
    errors = only_position(errors_m)
    rates = [success_rate(errors, within_m) for within_m in (0.0, 5.0, 10.0, 25.0, 200.0)]
    assert rates == sorted(rates)
    quantiles = [weighted_quantile(errors_m, share) for share in (0.5, 0.9, 0.99)]
    assert quantiles == sorted(quantiles)


def test_no_queries_have_no_success() -> None:
    nothing = pose_errors(columns_of([]), columns_of([]))
    assert math.isnan(success_rate(nothing, 5.0))
    assert math.isnan(success_auc(nothing))
    assert math.isnan(weighted_quantile(nothing.position_m, 0.5))


def test_what_cannot_be_is_refused() -> None:
    errors = only_position([1.0])
    for within_m in (math.inf, math.nan, -1.0):
        with pytest.raises(MetricError, match="tolerances"):
            successes(errors, within_m)
    with pytest.raises(MetricError, match="0 answers for 1 truths"):
        pose_errors(columns_of([]), columns_of([Pose(easting_m=0.0, northing_m=0.0, yaw_deg=0.0)]))
    with pytest.raises(MetricError, match="not negative"):
        only_position([-1.0])
    with pytest.raises(MetricError, match="NaN"):
        only_position([math.nan])


# Answers of matchers


def at(east_m: float, yaw_deg: float = 0.0) -> Pose:
    return Pose(easting_m=east_m, northing_m=0.0, yaw_deg=yaw_deg)


def answer(*given_poses: tuple[Pose, float]) -> Prediction:
    return Prediction(query_id="q", candidates=given_poses)


def test_the_first_pose_is_the_fix_and_silence_is_none() -> None:
    assert first_pose(answer((at(3.0), 1.0), (at(0.0), 1.0))) == at(3.0)
    assert first_pose(answer()) is None
    assert first_pose(None) is None
    assert first_pose(Prediction(query_id="q", candidates=((at(0.0), 1.0),), status="crash")) is None


@given(
    answers=st.lists(st.lists(st.tuples(st.integers(0, 3), st.booleans()), max_size=6), min_size=1, max_size=5),
)
def test_ranks_of_many_answers_are_those_of_each(answers) -> None:
    row = np.repeat(np.arange(len(answers)), [len(one) for one in answers])
    scores, right = (np.array([pose[at] for one in answers for pose in one]) for at in (0, 1))
    found = ranks_of_lists(row, scores.astype(float), right.astype(bool), len(answers))
    for at, one in enumerate(answers):
        alone = rank_of(*zip(*one, strict=True)) if one else MISS
        assert (found.above[at], found.tied[at], found.right[at]) == (alone.above, alone.tied, alone.right)
