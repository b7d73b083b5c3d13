# SPDX-License-Identifier: Apache-2.0
"""A log's own odometry as that of its flight: steps of its estimate between moments, held against plain numpy."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from sasgeo_bench.core.errors import FlightError
from sasgeo_bench.flights.drift_profile import load_profile
from sasgeo_bench.flights.logs import FlownPath
from sasgeo_bench.flights.odometry import LOST_M, LoggedSteps, draw_odometry
from sasgeo_bench.flights.trajectory import Trajectory
from tests.flights.autopilots import (
    LEVEL,
    START_S,
    ardupilot_rows,
    dataflash,
    fusing,
    mavros_messages,
    north_east_m,
    px4_drift,
    stamps_us,
    tlog,
    turn,
    ulog,
    write,
)
from tests.flights.autopilots import bag as bag_of

pytest.importorskip("pyulog", reason="needs the extra [logs]")
pytest.importorskip("pymavlink", reason="needs the extra [logs]")

Floats = NDArray[np.float64]
Topics = dict[tuple[str, int], tuple[str, list[Any]]]
FIELDS = "uint64_t timestamp;uint8_t pose_frame;float[3] position;float[4] q;uint8_t reset_counter;"
TURNED_DEG = 70.0  # by which the frame of the camera is turned
SCALE, DRIFT_DEG_PER_S = 1.03, 0.1
MOMENTS_S = np.array([3.05, 9.17, 15.23, 40.0, 46.71, 71.0])


def camera(*, kept: Callable[[float], bool] = bool, reset_s: float = np.inf) -> Topics:
    """A ULog with poses of a camera that are too long, turn on, and may be silent or begin anew."""
    c, s = np.cos(np.radians(TURNED_DEG)), np.sin(np.radians(TURNED_DEG))
    rows = []
    for at, (us, (north, east)) in enumerate(zip(stamps_us(LEVEL.time_s), north_east_m() * SCALE, strict=True)):
        time_s, is_new = float(LEVEL.time_s[at]), float(LEVEL.time_s[at]) >= reset_s
        place = (c * north - s * east + 500 * is_new, s * north + c * east, -80.0)
        yaw_deg = float(LEVEL.yaw_deg[at]) + TURNED_DEG + DRIFT_DEG_PER_S * time_s
        if kept(time_s + 1e-9):
            rows.append((us, 2, *place, *turn(yaw_deg), int(is_new)))
    flags = {("estimator_status", 0): fusing(lambda _: True)}
    return px4_drift(1.0, flags | {("vehicle_visual_odometry", 0): (FIELDS, rows)})


def true_steps(moments_s: Floats) -> tuple[Floats, Floats]:
    """Right and up of each step of the flight by plain numpy, shape (N - 1, 2), and turns."""
    place_m = np.stack([np.interp(moments_s, LEVEL.time_s, one) for one in north_east_m().T], axis=1)
    yaw_deg = np.interp(moments_s, LEVEL.time_s, np.unwrap(LEVEL.yaw_deg, period=360.0))
    found = []
    for at, (north, east) in enumerate(np.diff(place_m, axis=0)):
        a = np.radians(yaw_deg[at])
        found.append((east * np.cos(a) - north * np.sin(a), east * np.sin(a) + north * np.cos(a)))
    return np.array(found), np.diff(yaw_deg)


def steps_of(path: Path, **options: Any) -> LoggedSteps:
    return FlownPath(file=path, **options).own_odometry().steps(MOMENTS_S)


def test_steps_are_those_of_the_camera_in_its_own_metres_and_by_its_own_heading(tmp_path: Path) -> None:
    steps = steps_of(write(tmp_path / "a.ulg", ulog(camera())))
    moved, turns_deg = true_steps(MOMENTS_S)
    # It heads wrong by what it has turned too far since the start: its frame keeps the places.
    wrong = np.radians(DRIFT_DEG_PER_S * MOMENTS_S[:-1])
    led = SCALE * (moved[:, 0] + 1j * moved[:, 1]) * np.exp(1j * wrong)
    assert steps.is_logged.all()
    assert not steps.is_lost.any()
    np.testing.assert_allclose(steps.right_m + 1j * steps.up_m, led, atol=0.02)
    np.testing.assert_allclose(steps.yaw_deg, turns_deg + DRIFT_DEG_PER_S * np.diff(MOMENTS_S), atol=0.01)
    assert LEVEL.yaw_deg[[15, 46]].tolist() == [357.5, 13.0]  # the flight turns over north on the first step


def test_steps_of_an_estimator_are_the_logs_only_where_no_receiver_was_fused(tmp_path: Path) -> None:
    log = px4_drift(1.05, {("estimator_status", 0): fusing(lambda time_s: not 9 <= time_s <= 50)})
    steps = steps_of(write(tmp_path / "a.ulg", ulog(log)))
    assert steps.is_logged.tolist() == [False, True, True, True, False]
    moved, _ = true_steps(MOMENTS_S)
    np.testing.assert_allclose(np.stack([steps.right_m, steps.up_m], axis=1)[1:4], 1.05 * moved[1:4], atol=0.02)
    assert np.isnan(steps.yaw_deg).all()  # headings are the vehicle's, as those of the truth


def test_a_step_over_a_silence_or_a_jump_that_the_camera_tells_is_lost(tmp_path: Path) -> None:
    silent = camera(kept=lambda time_s: not 16 < time_s < 39, reset_s=45.0)
    steps = steps_of(write(tmp_path / "a.ulg", ulog(silent)))
    assert steps.is_logged.tolist() == [True] * 5
    assert steps.is_lost.tolist() == [False, False, True, True, False]
    between_s = np.array([44.0, 44.7, 44.9, 45.1, 46.0])  # poses are at 44.8 and 45: no line leads over the jump
    steps = FlownPath(file=tmp_path / "a.ulg").own_odometry().steps(between_s)
    assert steps.is_lost.tolist() == [False, True, True, False]
    late = camera(kept=lambda time_s: 9 < time_s < 70)
    steps = steps_of(write(tmp_path / "b.ulg", ulog(late)))
    assert steps.is_logged.tolist() == [False, True, True, True, False]


def test_declared_noise_is_the_profiles_law_over_the_way_the_odometer_took_itself_to_go(tmp_path: Path) -> None:
    path = FlownPath(file=write(tmp_path / "a.ulg", ulog(camera(kept=lambda time_s: not 16 < time_s < 39))))
    steps = path.own_odometry().steps(MOMENTS_S)
    north, east = (np.interp(MOMENTS_S, LEVEL.time_s, one) for one in north_east_m().T)
    flown = Trajectory.of_angles(
        time_s=MOMENTS_S, position_m=np.stack([east, north, 80 + 0 * east], axis=1), yaw_deg=0 * east
    )
    profile = load_profile("wheel-poor")
    drawn = draw_odometry(flown, profile, rng=np.random.default_rng(0))
    own = steps.over(drawn, profile)
    np.testing.assert_array_equal(own.is_lost, [False, False, True, False, False])
    assert own.covariance[2, 0, 0] == LOST_M**2
    way_m = SCALE * np.hypot(*np.diff([east, north], axis=1))
    is_told = ~own.is_lost
    ahead = np.stack([own.right_m, own.up_m], axis=1)[is_told] / way_m[is_told, None]
    along_m2 = np.einsum("ni,nij,nj->n", ahead, own.covariance[is_told, :2, :2], ahead)
    # 2 % of scale for the run, and 6 % of slip over 5 m: as the profile has them
    bias, slip = profile.scale.bias_pct / 100, profile.slip.sigma_pct / 100
    u = way_m[is_told] / profile.slip.length_m
    expected = way_m[is_told] ** 2 * (bias**2 + slip**2 * 2 * (u - 1 + np.exp(-u)) / u**2)
    np.testing.assert_allclose(along_m2, expected + 1e-6, rtol=1e-6)
    optimistic = steps.over(drawn, profile, belief="optimistic")
    np.testing.assert_allclose(9 * optimistic.covariance[is_told], own.covariance[is_told])


def test_a_step_that_the_log_has_not_stays_as_it_was_drawn(tmp_path: Path) -> None:
    log = px4_drift(1.05, {("estimator_status", 0): fusing(lambda time_s: not 9 <= time_s <= 50)})
    steps = steps_of(write(tmp_path / "a.ulg", ulog(log)))
    flown = Trajectory.of_angles(
        time_s=MOMENTS_S, position_m=np.outer(MOMENTS_S, [8.0, 6.0, 0.0]), yaw_deg=0 * MOMENTS_S
    )
    drawn = draw_odometry(flown, load_profile("vio-mono"), rng=np.random.default_rng(1))
    own = steps.over(drawn, load_profile("vio-mono"))
    for name in ("right_m", "up_m", "covariance"):
        ours, theirs = getattr(own, name), getattr(drawn, name)
        np.testing.assert_array_equal(ours[[0, 4]], theirs[[0, 4]])
        assert (ours[1:4] != theirs[1:4]).any()
    np.testing.assert_array_equal(own.yaw_deg, drawn.yaw_deg)  # without a heading of its own its turns are drawn


@pytest.mark.parametrize("moved_s", [0.0, 40.0])
def test_the_first_fix_of_the_flight_is_where_its_clock_begins(tmp_path: Path, moved_s: float) -> None:
    """Fixes come later than poses, which count by the same clock."""
    log = camera()
    name = ("vehicle_gps_position", 0)
    log[name] = (log[name][0], [row for row in log[name][1] if row[0] >= stamps_us(np.array([moved_s]))[0]])
    path = FlownPath(file=write(tmp_path / "a.ulg", ulog(log)))
    moments_s = np.array([41.0, 50.0, 60.0])
    moved, _ = true_steps(moments_s)
    steps = path.own_odometry().steps(moments_s - moved_s)
    np.testing.assert_allclose(np.hypot(steps.right_m, steps.up_m), SCALE * np.hypot(*moved.T), atol=0.01)


def test_poses_of_other_autopilots_and_of_a_named_topic_are_read_alike(tmp_path: Path) -> None:
    rows = ardupilot_rows(LEVEL)
    rows["VISP"] = []
    for at, us in enumerate(stamps_us(LEVEL.time_s)):
        north, east = (1.04 * north_east_m()[at]).tolist()
        tail = (0.1, 0.1, 0.1, int(LEVEL.time_s[at] > 43), 90)
        rows["VISP"].append((us, us, us // 1000, north, east, 0.0, 0.0, 0.0, float(LEVEL.yaw_deg[at]), *tail))
    moved, turns_deg = true_steps(MOMENTS_S)
    steps = steps_of(write(tmp_path / "a.bin", dataflash(rows)))
    assert steps.is_lost.tolist() == [False, False, False, True, False]
    is_told = ~steps.is_lost
    np.testing.assert_allclose(np.stack([steps.right_m, steps.up_m], axis=1)[is_told], 1.04 * moved[is_told], atol=0.05)
    np.testing.assert_allclose(steps.yaw_deg[is_told], turns_deg[is_told], atol=0.05)

    pytest.importorskip("rosbags", reason="needs the extra [logs]")
    poses = []
    for at, time_s in enumerate(LEVEL.time_s.tolist()):
        north, east = (0.97 * north_east_m()[at]).tolist()
        ns = round((START_S + time_s) * 1e9)
        half = np.radians(90 - LEVEL.yaw_deg[at]) / 2
        pose = {
            "position": {"x": east, "y": north, "z": 80.0},
            "orientation": {"w": float(np.cos(half)), "x": 0.0, "y": 0.0, "z": float(np.sin(half))},
        }
        header = {"stamp": {"sec": ns // 10**9, "nanosec": ns % 10**9}, "frame_id": "map"}
        poses.append(("/vo/pose", "geometry_msgs/msg/PoseStamped", ns, {"header": header, "pose": pose}))
    path = bag_of(tmp_path / "b.mcap", [*mavros_messages(LEVEL), *poses])
    with pytest.raises(FlightError, match=r"no bag says of poses whether they fused GNSS: say --topic"):
        steps_of(path)
    steps = steps_of(path, topic="/vo/pose")
    np.testing.assert_allclose(np.stack([steps.right_m, steps.up_m], axis=1), 0.97 * moved, atol=0.05)


@pytest.mark.parametrize(
    ("name", "match"),
    [
        ("fused.ulg", r"vehicle_local_position 0 fused GNSS from start to end \(estimator_status\): it is a copy of"),
        ("bare.ulg", r"bare\.ulg has no attitudes, so that its heading is that of its course"),
        ("a.tlog", "neither ODOMETRY nor VISION_POSITION_ESTIMATE was sent"),
        ("a.csv", r"a\.csv is no log with odometry that is read"),
        ("run.tum", r"run\.tum has poses, and no odometry beside them"),
    ],
)
def test_a_log_without_odometry_of_its_own_says_why(tmp_path: Path, name: str, match: str) -> None:
    log = px4_drift(1.02, {("estimator_status", 0): fusing(lambda _: True)})
    write(tmp_path / "fused.ulg", ulog(log))
    del log["vehicle_attitude", 0]
    write(tmp_path / "bare.ulg", ulog(log))
    write(tmp_path / "a.tlog", tlog(LEVEL))
    (tmp_path / "a.csv").write_text("time_s,lat,lon,height_m\n0,47.14,9.52,80\n9,47.141,9.52,80\n")
    (tmp_path / "run.tum").write_text("0 0 0 80 0 0 0 1\n1 9 0 80 0 0 0 1\n")
    with pytest.raises(FlightError, match=match):
        FlownPath(file=tmp_path / name).own_odometry()


def test_a_choice_without_a_meaning_is_refused(tmp_path: Path) -> None:
    path = write(tmp_path / "a.ulg", ulog(camera()))
    with pytest.raises(FlightError, match=r"--topic is of the odometry of a bag, and a\.ulg gives none: leave it out"):
        FlownPath(file=path, topic="/vo")
    with pytest.raises(FlightError, match="--odometry is one of log, drawn, got 'visual'"):
        FlownPath(file=path, odometry="visual")  # type: ignore[arg-type]
    with pytest.raises(FlightError, match="--odometry drawn says so"):
        FlownPath(file=path, odometry="drawn").own_odometry()
