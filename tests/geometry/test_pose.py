# SPDX-License-Identifier: Apache-2.0
"""Poses and their inverses, and the bounds of poses and priors."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sasgeo_bench.core.errors import PoseError
from sasgeo_bench.geometry.pose import Pose, Prior, inverse, wrap_deg

poses = st.builds(
    Pose,
    easting_m=st.floats(-1e4, 1e4),
    northing_m=st.floats(-1e4, 1e4),
    yaw_deg=st.floats(-720, 720),
    scale=st.floats(0.5, 2.0),
)


@given(poses)
def test_a_pose_and_its_inverse_undo_each_other_either_way(pose):
    offsets = np.array([[1.0, 2.0], [-3.0, 0.5]])
    np.testing.assert_allclose(inverse(pose).to_map(pose.to_map(offsets)), offsets, atol=1e-5)
    np.testing.assert_allclose(pose.to_map(inverse(pose).to_map(offsets)), offsets, atol=1e-5)
    assert abs(wrap_deg(inverse(pose).yaw_deg + pose.yaw_deg)) < 1e-7


def test_ahead_of_a_view_that_looks_east_lies_east():
    east = Pose(easting_m=100.0, northing_m=200.0, yaw_deg=90.0)
    assert east.to_map(np.array([[0.0, 7.0]])).round(9).tolist() == [[107.0, 200.0]]


@pytest.mark.parametrize("wrong", [{"scale": 0.0}, {"scale": -1.0}, {"yaw_deg": float("nan")}, {"easting_m": math.inf}])
def test_what_is_no_pose_is_refused(wrong):
    with pytest.raises(PoseError):
        Pose(**({"easting_m": 0.0, "northing_m": 0.0, "yaw_deg": 0.0} | wrong))


KNOWN = {"center_m": (1.0, 2.0), "radius_m": 500.0, "yaw_deg": 10.0, "yaw_sigma_deg": 5.0, "scale_sigma": 0.03}


@pytest.mark.parametrize(
    ("change", "fault"),
    [
        ({"radius_m": None}, "or neither"),
        ({"center_m": None}, "or neither"),
        ({"yaw_sigma_deg": None}, "or neither"),
        ({"radius_m": -1.0}, "positive"),
        ({"radius_m": 0.0}, "positive"),
        ({"yaw_sigma_deg": float("nan")}, "finite"),
        ({"scale_sigma": -0.1}, "positive"),
        ({"center_m": (float("inf"), 0.0)}, "finite"),
    ],
)
def test_a_prior_with_a_fault_is_refused(change, fault):
    with pytest.raises(PoseError, match=fault):
        Prior(**(KNOWN | change))


def test_a_prior_may_know_nothing():
    assert not Prior(center_m=None, radius_m=None, yaw_deg=None, yaw_sigma_deg=None, scale_sigma=0.15).has_place
