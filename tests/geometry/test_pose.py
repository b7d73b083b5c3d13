# SPDX-License-Identifier: Apache-2.0
"""Poses form a group, and Log and Exp undo each other."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sasgeo_bench.errors import PoseError
from sasgeo_bench.geometry.angles import wrap_deg
from sasgeo_bench.geometry.pose import Pose, Prior, compose, exp, inverse, log

poses = st.builds(
    Pose,
    easting_m=st.floats(-1e4, 1e4),
    northing_m=st.floats(-1e4, 1e4),
    yaw_deg=st.floats(-720, 720),
    scale=st.floats(0.5, 2.0),
)
IDENTITY = Pose(easting_m=0.0, northing_m=0.0, yaw_deg=0.0)


def assert_same(one: Pose, other: Pose) -> None:
    assert abs(one.easting_m - other.easting_m) < 1e-5
    assert abs(one.northing_m - other.northing_m) < 1e-5
    assert abs(wrap_deg(one.yaw_deg - other.yaw_deg)) < 1e-7
    assert abs(one.scale - other.scale) < 1e-9


@given(poses)
def test_a_pose_and_its_inverse_are_the_identity_either_way(pose):
    assert_same(compose(pose, inverse(pose)), IDENTITY)
    assert_same(compose(inverse(pose), pose), IDENTITY)


@given(poses, poses, poses)
def test_composing_is_associative(a, b, c):
    assert_same(compose(compose(a, b), c), compose(a, compose(b, c)))


@given(poses)
def test_exp_of_log_is_the_pose(pose):
    if abs(wrap_deg(pose.yaw_deg)) < 179.9:  # a half turn has two logarithms
        assert_same(exp(log(pose)), pose)


@given(st.tuples(st.floats(-1e3, 1e3), st.floats(-1e3, 1e3), st.floats(-179, 179), st.floats(-0.7, 0.7)))
def test_log_of_exp_is_the_tangent(tangent):
    np.testing.assert_allclose(log(exp(np.array(tangent))), tangent, atol=1e-6)


@given(poses, poses)
def test_composing_maps_offsets_one_after_the_other(a, b):
    offsets = np.array([[1.0, 2.0], [-3.0, 0.5]])
    np.testing.assert_allclose(compose(a, b).to_map(offsets), a.to_map(b.to_map(offsets)), atol=1e-5)


def test_ahead_of_a_view_that_looks_east_lies_east():
    east = Pose(easting_m=100.0, northing_m=200.0, yaw_deg=90.0)
    assert east.to_map(np.array([[0.0, 7.0]])).round(9).tolist() == [[107.0, 200.0]]


def test_a_quarter_turn_along_an_arc_ends_where_the_circle_says():
    # A quarter of a circle of radius r to the right has the length r pi / 2 and ends r ahead and r to the right.
    radius_m = 10.0
    end = exp(np.array([0.0, radius_m * math.pi / 2, 90.0, 0.0]))
    assert_same(end, Pose(easting_m=radius_m, northing_m=radius_m, yaw_deg=90.0))


@pytest.mark.parametrize("wrong", [{"scale": 0.0}, {"scale": -1.0}, {"yaw_deg": float("nan")}, {"easting_m": math.inf}])
def test_what_is_no_pose_is_refused(wrong):
    with pytest.raises(PoseError):
        Pose(**({"easting_m": 0.0, "northing_m": 0.0, "yaw_deg": 0.0} | wrong))


def test_a_tangent_of_another_shape_is_refused():
    with pytest.raises(PoseError, match=r"\(3,\)"):
        exp(np.zeros(3))


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
