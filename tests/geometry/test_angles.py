# SPDX-License-Identifier: Apache-2.0
"""Which way yaw turns, by hand-worked landmarks."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from sasgeo_bench.geometry.pose import bearing_deg, normalize_deg, rotation, wrap_deg

angles = st.floats(-1e4, 1e4)


@given(angles)
def test_wrapped_and_normalized_angles_point_the_same_way_and_stay_in_range(angle):
    assert normalize_deg(-1e-20) == 0.0  # and not 360
    assert 0 <= normalize_deg(angle) < 360
    assert -180 <= wrap_deg(angle) < 180
    for other in (normalize_deg(angle), wrap_deg(angle)):
        np.testing.assert_allclose(np.exp(1j * np.radians(other)), np.exp(1j * np.radians(angle)), atol=1e-9)


@given(st.floats(0, 359.9))
def test_the_up_direction_of_a_view_has_the_bearing_of_its_yaw(yaw):
    east, north = rotation(yaw) @ np.array([0.0, 1.0])
    assert abs(wrap_deg(bearing_deg(east, north) - yaw)) < 1e-9


def test_a_landmark_due_east_seen_with_yaw_90_is_at_the_top_and_one_due_north_at_the_left():
    seen = np.array([[100.0, 0.0], [0.0, 100.0]]) @ rotation(90.0)
    assert seen.round(9).tolist() == [[0.0, 100.0], [-100.0, 0.0]]
