# SPDX-License-Identifier: Apache-2.0
"""Fixes: what is refused, each in one line, and what a sound one becomes."""

import math

import numpy as np
import pytest

from sasgeo_bench.core.errors import MatchError
from sasgeo_bench.geometry.pose import Pose, Prior
from sasgeo_bench.matching.controls.reckoning import DeadReckoning, advance
from sasgeo_bench.matching.plugins import load_method, load_tracker
from sasgeo_bench.matching.tracker import Fix, Tracker, check_fix, match_of
from sasgeo_bench.tasks.query import Step

HERE = Pose(easting_m=1.0, northing_m=2.0, yaw_deg=3.0)


@pytest.mark.parametrize(
    ("fix", "expected"),
    [
        ("a text", "step() returned str"),
        (Fix(pose=None), "say is_accepted=False"),
        (Fix(pose=HERE, is_accepted="yes"), "is_accepted is a str"),
        (Fix(pose=(1.0, 2.0)), "a pose is a tuple"),
        (Fix(pose=HERE, covariance=np.zeros((3, 3))), "not symmetric and positive definite"),
        (Fix(pose=HERE, covariance=[[1, 5, 0], [0, 1, 0], [0, 0, 1]]), "not symmetric and positive definite"),
        (Fix(pose=HERE, covariance=np.eye(2)), "shape (2, 2)"),
        (Fix(pose=HERE, covariance=math.nan * np.eye(3)), "covariance holds nan, expected numbers of 1e+12 at most"),
        (Fix(pose=HERE, covariance="wide"), "covariance is a str"),
        (Fix(pose=HERE, covariance=[["1", "0", "0"], [0, 1, 0], [0, 0, 1]]), "covariance is a list, expected 3 x 3"),
        (Fix(pose=HERE, covariance=np.array(list("100010001"), dtype=object)), "(TypeError: they are no numbers)"),
        (Fix(pose=HERE, covariance=np.eye(3) * (1 + 0j)), "covariance is a ndarray, expected 3 x 3 numbers"),
        (Fix(pose=HERE, covariance=[[10**400, 0, 0], [0, 1, 0], [0, 0, 1]]), "expected 3 x 3 numbers (OverflowError"),
        (Fix(pose=HERE, covariance=np.ma.masked_array(np.eye(3), np.eye(3) > 0)), "mask of a masked array would be"),
        (Fix(pose=HERE, modes=[HERE]), "pairs of a pose and a weight"),
        (Fix(pose=HERE, modes=[(HERE, 2.0)]), "scores rise from 1 to 2"),
        (Fix(pose=HERE, modes=[(HERE, -0.5)]), "weights of modes lie in 0..1"),
        (Fix(pose=HERE, modes=[(HERE, 0.5)] * 5), "returned 6 poses, expected at most top_k = 5"),
        (Fix(pose=HERE, confidence=7.0), "confidence is 7"),
    ],
)
def test_a_fix_that_is_none_is_refused(fix, expected):
    with pytest.raises(MatchError) as caught:
        check_fix(fix, top_k=5)
    assert expected in str(caught.value)
    assert "\n" not in str(caught.value)


def test_a_sound_fix_keeps_its_modes_behind_the_estimate():
    fix = check_fix(Fix(pose=HERE, covariance=np.eye(3), modes=[(HERE, 0.6), (HERE, 0.1)]), top_k=5)
    assert fix.is_accepted is True
    assert match_of(fix).scores == (1.0, 0.6, 0.1)
    assert check_fix(Fix(pose=None, is_accepted=False), top_k=5).pose is None


def test_a_name_is_that_of_a_matcher_or_of_a_tracker():
    assert isinstance(load_method("dead_reckoning"), Tracker)
    assert not isinstance(load_method("random"), Tracker)
    reckoning = "sasgeo_bench.matching.controls.reckoning:DeadReckoning"
    assert isinstance(load_method(reckoning), DeadReckoning)
    with pytest.raises(MatchError, match="is not a tracker, it has no start and no step"):
        load_tracker("sasgeo_bench.matching.controls.blind:PriorCentre")


def test_the_covariance_of_many_steps_is_that_of_drawn_ones():
    """To first order: the spread of drawn ways is what `advance` says, in place, heading, and between them."""
    rng = np.random.default_rng(3)
    step_cov = np.diag([0.5, 1.0, 0.25])
    lines = tuple(step_cov.ravel().tolist())
    count = 20
    pose, covariance = HERE, np.diag([4.0, 4.0, 1.0])
    for frame in range(1, count + 1):
        step = Step(sequence_id="f", frame=frame, increment=(2.0, 30.0, 5.0), covariance=lines)
        pose, covariance = advance(pose, covariance, step)
    start = rng.normal(size=(3, 20_000)) * np.sqrt([[4.0], [4.0], [1.0]])
    place, yaw_deg = HERE.easting_m + start[0] + 1j * (HERE.northing_m + start[1]), HERE.yaw_deg + start[2]
    for _ in range(count):
        right_m, up_m, turn_deg = rng.normal(size=start.shape) * np.sqrt(np.diag(step_cov))[:, None]
        place = place + (2.0 + right_m + 1j * (30.0 + up_m)) * np.exp(-1j * np.radians(yaw_deg))
        yaw_deg = yaw_deg + 5.0 + turn_deg
    drawn = np.array([place.real, place.imag, yaw_deg])
    assert np.cov(drawn) == pytest.approx(covariance, rel=0.15, abs=0.15 * covariance[2, 2])


def test_a_lost_step_keeps_the_place_and_widens_it_and_a_control_must_be_prepared():
    pose, covariance = advance(HERE, np.eye(3), Step(sequence_id="f", frame=4))
    assert pose == HERE
    assert covariance[0, 0] > 1e5
    assert (advance(HERE, np.eye(3), Step(sequence_id="f", frame=0))[1] == np.eye(3)).all()
    with pytest.raises(RuntimeError, match="call prepare"):
        DeadReckoning().start(Prior(center_m=None, radius_m=None, yaw_deg=None, yaw_sigma_deg=None, scale_sigma=0.0))
