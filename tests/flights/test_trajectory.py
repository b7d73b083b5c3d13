# SPDX-License-Identifier: Apache-2.0
"""Trajectories: attitudes as cameras have them, interpolation, and what is refused."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from sasgeo_bench.core.errors import FlightError
from sasgeo_bench.flights.trajectory import Trajectory
from sasgeo_bench.sensing.camera import Attitude

ANGLES = st.floats(-80.0, 80.0)


def _straight(**changes: object) -> Trajectory:
    given = {"time_s": [0.0, 2.0], "position_m": [[0, 0, 50], [30, 40, 60]], "yaw_deg": [350.0, 10.0]}
    return Trajectory.of_angles(**(given | changes))  # type: ignore[arg-type]


@given(yaw_deg=st.floats(0.0, 359.0), pitch_deg=ANGLES, roll_deg=ANGLES)
def test_angles_are_those_of_a_camera(yaw_deg: float, pitch_deg: float, roll_deg: float) -> None:
    flown = _straight(yaw_deg=[yaw_deg] * 2, pitch_deg=pitch_deg, roll_deg=roll_deg)
    north_east_down = Attitude(roll_deg=roll_deg, pitch_deg=pitch_deg, yaw_deg=yaw_deg).matrix
    forward, right, down = np.eye(3)
    for axis in (forward, right, down):
        north, east, below = north_east_down @ axis
        assert flown.rotation.apply(axis)[0] == pytest.approx([east, north, -below], abs=1e-9)
    assert math.cos(math.radians(flown.yaw_deg[0] - yaw_deg)) == pytest.approx(1)


def test_between_two_poses_position_is_on_the_line_and_yaw_on_the_shorter_way_and_beyond_them_nothing() -> None:
    middle = _straight().at([1.0, 2.0])
    assert middle.position_m.tolist() == [[15, 20, 55], [30, 40, 60]]
    assert np.cos(np.radians(middle.yaw_deg)).tolist() == pytest.approx([1, math.cos(math.radians(10))])
    assert _straight().distance_m.tolist() == [0, 50]  # a climb is no distance
    with pytest.raises(FlightError, match=r"times from -1\.000 to 1\.000 s, the trajectory has 0\.000 to 2\.000 s"):
        _straight().at([-1.0, 1.0])


def test_arrays_are_its_own_and_read_only() -> None:
    times = np.array([0.0, 2.0])
    flown = _straight(time_s=times)
    times[0] = 9
    assert flown.time_s[0] == 0
    with pytest.raises(ValueError, match="read-only"):
        flown.time_s[0] = 1


@pytest.mark.parametrize(
    ("changes", "expected"),
    [
        ({"time_s": [0.0, 0.0]}, "time does not increase after pose 1"),
        ({"position_m": [[0, 0, 0], [math.nan, 0, 0]]}, "position_m of pose 2 is not finite"),
        ({"position_m": [[0, 0], [1, 1]]}, "position_m of 2 poses has shape"),
        ({"time_s": [], "position_m": np.empty((0, 3)), "yaw_deg": []}, "one pose at least"),
    ],
)
def test_impossible_values_are_refused(changes: dict[str, object], expected: str) -> None:
    with pytest.raises(FlightError, match=expected):
        _straight(**changes)


def test_a_quaternion_of_another_order_or_length_is_refused_and_times_since_1970_are_reported_in_full() -> None:
    with pytest.raises(FlightError, match="pose 1 has length 0, not 1: order is x y z w"):
        Trajectory(time_s=np.arange(2.0), position_m=np.zeros((2, 3)), quaternion_xyzw=np.zeros((2, 4)))
    turned = Rotation.from_rotvec([[0, 0, 0], [0, 0, np.pi / 2]]).as_quat()
    flown = Trajectory(time_s=np.arange(2.0), position_m=np.zeros((2, 3)), quaternion_xyzw=turned)
    assert np.sin(np.radians(flown.yaw_deg)).tolist() == pytest.approx([1, 0])
    assert _straight(time_s=[1413393212.25, 1413393214.5]).span_text() == "1413393212.250 to 1413393214.500 s"
