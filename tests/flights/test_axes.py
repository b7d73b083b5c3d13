# SPDX-License-Identifier: Apache-2.0
"""Axes of trajectories: those of a camera are refused or read, and those that are right are read, whatever the path."""

import warnings
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from sasgeo_bench.core.errors import FlightError
from sasgeo_bench.flights.drift import measure_drift, pair_run
from sasgeo_bench.flights.trajectory import Trajectory, in_axes, read_tum

PATH = Path("run.txt")
AT_M = np.linspace(0, 1000, 501)
LOOP = AT_M / 100


def _flown(position_m, turns: Rotation) -> Trajectory:
    return Trajectory(time_s=AT_M / 10, position_m=np.stack(position_m, axis=1), quaternion_xyzw=turns.as_quat())


def _slalom(*, swing_deg: float = 60.0, turn_deg_m: float = 0.0, long: float = 1.0) -> tuple[np.ndarray, ...]:
    """East, north and believed heading (radians) of a winding way; an odometer's is too long and turns."""
    course = np.radians(swing_deg * np.sin(AT_M / 150))
    believed = course + np.radians(turn_deg_m * AT_M)
    step_m = long * np.diff(AT_M)
    east, north = (np.concatenate([[0], np.cumsum(f(believed[:-1]) * step_m)]) for f in (np.sin, np.cos))
    return east, north, course


def _up(east, north, course, *, ahead: int = 0) -> Trajectory:
    """Third axis up; `ahead` is the body's axis that points along the way: 0 of a drone, 2 of a camera."""
    body = np.roll([[0, 1, 0], [1, 0, 0], [0, 0, -1]], ahead, axis=1)
    return _flown((east, north, 0 * east + 50), Rotation.from_euler("z", -course[:, None]) * Rotation.from_matrix(body))


def _camera(east, north, course) -> Trajectory:
    return _flown((east, 0 * east, north), Rotation.from_euler("y", course[:, None]))


def _still() -> Rotation:
    return Rotation.from_quat(np.tile([0.0, 0, 0, 1], (len(AT_M), 1)))


def test_drift_is_the_same_in_a_cameras_axes_and_as_worked_by_hand() -> None:
    true, odometry = _slalom(), _slalom(turn_deg_m=0.004, long=1.05)
    odometry = (*odometry[:2], odometry[2] + np.radians(0.004 * AT_M))
    # By hand: each 100 m begin at the true place and heading; 0.4 degrees a 100 m, 5 % too long.
    way, believed = (east + 1j * north for east, north, _ in (true, odometry))
    turn = np.exp(1j * np.radians(0.004 * AT_M[:-50:5]))
    errors_m = np.abs((believed[50::5] - believed[:-50:5]) * turn - (way[50::5] - way[:-50:5]))
    for laid, axes in ((_up, None), (_camera, "camera")):
        truth, estimate = (in_axes(laid(*flown), axes, PATH) for flown in (true, odometry))
        figures = measure_drift([pair_run(truth, estimate, sequence="a")], lengths_m=[100.0], draws=10)
        position, yaw = figures["value"][:2]
        assert position == pytest.approx(errors_m.mean(), abs=0.02)
        assert position == pytest.approx(4.97, abs=0.02)
        assert yaw == pytest.approx(0.4, abs=0.01)


@pytest.mark.parametrize("course_deg", [0.0, 37.0, 90.0, 180.0, 271.0])
def test_a_cameras_axes_are_turned_to_the_heading_and_place_that_they_mean(course_deg: float) -> None:
    course = np.full(len(AT_M), np.radians(course_deg))
    flown = in_axes(_camera(AT_M * np.sin(course), AT_M * np.cos(course), course), "camera", PATH)
    up = _up(AT_M * np.sin(course), AT_M * np.cos(course), course)
    np.testing.assert_allclose(flown.position_m[:, :2], up.position_m[:, :2], atol=1e-9)
    np.testing.assert_allclose(flown.rotation.as_matrix(), up.rotation.as_matrix(), atol=1e-9)


@pytest.mark.parametrize(
    "flown",
    [
        _camera(*_slalom()),
        _camera(200 * np.sin(AT_M / 100), 200 * np.cos(AT_M / 100), AT_M / 100 + np.pi / 2),  # a circle
        _flown((AT_M, 0 * AT_M, 9 * np.sin(AT_M / 9)), Rotation.from_euler("y", np.pi / 2 + AT_M[:, None] / 300)),
        # Looks back, as frames of OpenGL do.
        _flown((_slalom()[0], 0 * AT_M, -_slalom()[1]), Rotation.from_euler("y", -_slalom()[2][:, None])),
    ],
)
def test_a_path_whose_third_axis_does_not_point_up_is_refused_with_the_mend(flown: Trajectory) -> None:
    with pytest.raises(FlightError, match=r"run\.txt: the body turns about the second axis .* --axes camera"):
        in_axes(flown, None, PATH)
    assert in_axes(flown, "up", PATH) is flown


def _tilted(down_deg: float) -> Trajectory:
    """A circle, level, in the axes of a first camera that looks down by an angle."""
    down = Rotation.from_euler("x", -down_deg, degrees=True)
    flown = _camera(200 * np.sin(LOOP), 200 * np.cos(LOOP), LOOP + np.pi / 2)
    return _flown(down.inv().apply(flown.position_m.copy()).T, down.inv() * flown.rotation * down)


@pytest.mark.parametrize(
    ("flown", "off"),
    [
        (_tilted(45), "45 degrees"),
        # Real part first: heading becomes a turn about the first axis.
        (_flown((AT_M, AT_M, 0 * AT_M), Rotation.from_euler("x", np.pi - AT_M[:, None] / 200)), "90 degrees"),
    ],
)
def test_a_frame_of_other_axes_is_refused_with_its_tilt(flown: Trajectory, off: str) -> None:
    match = rf"turns about an axis {off} off the third .*: turn the frame first, or say --axes up .* qx qy qz qw"
    with pytest.raises(FlightError, match=match):
        in_axes(flown, None, PATH)
    with pytest.raises(FlightError, match="an axis 45 degrees off the third"):
        in_axes(_tilted(45), "camera", PATH)
    with warnings.catch_warnings():  # straight down is down
        warnings.simplefilter("error")
        in_axes(_tilted(90), None, PATH)


def test_axes_that_are_named_wrongly_are_refused() -> None:
    with pytest.raises(FlightError, match=r"turn the frame first, or say --axes up"):
        in_axes(_up(*_slalom()), "camera", PATH)
    with pytest.raises(FlightError, match="axes must be one of up, camera, got 'ned'"):
        in_axes(_up(*_slalom()), "ned", PATH)  # type: ignore[arg-type]


@pytest.mark.parametrize(
    "flown",
    [
        _up(*_slalom()),
        _up(*_slalom(), ahead=2),  # a body whose third axis looks ahead, as that of EuRoC
        _up(AT_M, 0 * AT_M, 0 * AT_M + np.pi / 2),  # straight
        _flown((*_slalom()[:2], AT_M / 3), Rotation.from_euler("z", -_slalom()[2][:, None])),  # a climb, nearly flat
        _flown((200 * np.sin(LOOP), 200 * np.cos(LOOP), 90 * np.sin(LOOP)), Rotation.from_euler("z", -LOOP[:, None])),
        _up(AT_M, 0 * AT_M, 0 * AT_M + np.pi / 2, ahead=2),
        _flown((90 * np.sin(LOOP), 20 * np.sin(LOOP), 90 * np.cos(LOOP)), _still()),  # a circle before a front, level
        _flown((0 * AT_M, 0 * AT_M, 90 * np.sin(LOOP)), Rotation.from_euler("z", LOOP[:, None])),  # up and down
        _flown((9 * np.cos(LOOP), 9 * np.sin(LOOP), AT_M), Rotation.from_euler("z", LOOP[:, None])),  # a screw upwards
        _flown((0 * AT_M, 0 * AT_M, 0 * AT_M), _still()),
        _flown((0 * AT_M, AT_M, 0 * AT_M), Rotation.from_euler("x", -np.abs(np.sin(LOOP))[:, None] * 1.5)),  # a gimbal
    ],
)
def test_a_path_with_its_third_axis_up_is_read_without_a_word(flown: Trajectory) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert in_axes(flown, None, PATH) is flown


@pytest.mark.parametrize(
    "flown",
    [
        _flown((0 * AT_M, 0 * AT_M, AT_M), _still()),  # straight up, or straight ahead
        _flown((0 * AT_M, 0 * AT_M, 90 * np.sin(LOOP)), _still()),
        _flown((90 * np.sin(LOOP), 0 * AT_M, 90 * np.cos(LOOP)), _still()),  # a circle before a front, or level
        _flown((90 * np.sin(LOOP), 0 * AT_M, 90 * np.cos(LOOP)), Rotation.from_euler("y", LOOP[:, None])),  # a loop
        # The same with heights, as of a camera that looks sideways.
        _flown((90 * np.sin(LOOP), 20 * np.sin(LOOP), 90 * np.cos(LOOP)), Rotation.from_euler("y", LOOP[:, None])),
    ],
)
def test_a_path_that_may_be_of_either_axes_is_read_with_a_word(flown: Trajectory) -> None:
    with pytest.warns(UserWarning, match=r"lies along the third axis, which is read as up, .* say --axes camera"):
        assert in_axes(flown, None, PATH) is flown
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert in_axes(flown, "up", PATH) is flown
        ahead = in_axes(flown, "camera", PATH)
    assert ahead.position_m[:, 1].tolist() == flown.position_m[:, 2].tolist()


def test_a_tum_file_is_read_in_the_axes_that_are_said(tmp_path: Path) -> None:
    flown = _camera(*_slalom())
    np.savetxt(tmp_path / "orb.txt", np.column_stack([flown.time_s, flown.position_m, flown.quaternion_xyzw]))
    with pytest.raises(FlightError, match=r"orb\.txt: .* say --axes camera"):
        read_tum(tmp_path / "orb.txt")
    assert read_tum(tmp_path / "orb.txt", axes="camera").position_m[:, 2] == pytest.approx(0)
    np.savetxt(tmp_path / "kitti.txt", np.eye(3, 4).reshape(1, 12))
    with pytest.raises(FlightError, match=r"line 1: 12 numbers, a pose of KITTI without its time .* --axes camera"):
        read_tum(tmp_path / "kitti.txt")
