# SPDX-License-Identifier: Apache-2.0
"""Odometry out of logs: only over stretches without GNSS, refused by name elsewhere, measured against the receiver."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from sasgeo_bench.core.errors import FlightError
from sasgeo_bench.flights.drift import measure_drift
from sasgeo_bench.flights.log_odometry import LoggedRuns, read_runs
from sasgeo_bench.flights.log_streams import free_stretches
from tests.flights import autopilots
from tests.flights.autopilots import (
    LEVEL as FLOWN,
)
from tests.flights.autopilots import (
    START_S,
    ardupilot_rows,
    bag,
    dataflash,
    dataflash_text,
    fusing,
    gps_rows,
    mavros_messages,
    north_east_m,
    px4_drift,
    stamp,
    stamps_us,
    tlog,
    turn,
    ulog,
    write,
)

pytest.importorskip("pyulog", reason="needs the extra [logs]")
pytest.importorskip("pymavlink", reason="needs the extra [logs]")

LENGTH_M = 100.0
FLAGS = "uint64_t timestamp;bool cs_gnss_pos;bool cs_gnss_vel;bool cs_ev_pos;"
VISUAL = "uint64_t timestamp;uint8_t pose_frame;float[3] position;float[4] q;"


def figure(logged: LoggedRuns, name: str) -> float:
    table = measure_drift(logged.runs, lengths_m=[LENGTH_M], draws=10).set_index("figure")["value"]
    return float(table[name])


def _middle(time_s: float) -> bool:
    """GNSS is fused but between 30 and 100 s."""
    return not 30 <= time_s <= 100


# PX4


@pytest.mark.parametrize("scale", [1.02, 0.95])
def test_drift_is_that_of_the_estimator_while_no_gnss_was_fused(tmp_path: Path, scale: float) -> None:
    log = px4_drift(scale, {("estimator_status", 0): fusing(_middle)})
    # elsewhere it is a copy of the truth
    fields, rows = log["vehicle_local_position", 0]
    true_m = north_east_m()
    rows = [
        (*row[:1], *true_m[at].tolist(), *row[3:]) if _middle(FLOWN.time_s[at]) else row for at, row in enumerate(rows)
    ]
    logged = read_runs(write(tmp_path / "a.ulg", ulog(log | {("vehicle_local_position", 0): (fields, rows)})))
    assert len(logged.runs) == 1
    way_m = float(np.hypot(*np.diff(north_east_m(), axis=0).T)[150:500].sum())
    assert logged.runs[0].path_m == pytest.approx(way_m, abs=0.1)
    assert figure(logged, "position_pct") == pytest.approx(100 * abs(scale - 1), abs=0.01)
    assert figure(logged, "scale_pct") == pytest.approx(100 * abs(np.log(scale)), abs=0.01)
    assert (logged.has_yaw, logged.accuracy_m) == (False, pytest.approx(1.2))
    assert logged.notes == (
        "truth: vehicle_gps_position 0, fixes, 5 Hz",
        f"odometry: vehicle_local_position 0, 1 stretch of {way_m:.0f} m without GNSS (estimator_status)",
        "headings: the vehicle's own, so no drift of heading is measured",
    )


def test_stretches_lie_between_flags_that_agree_of_every_instance_under_all_their_names(tmp_path: Path) -> None:
    rows = [(us, False, at == 40, True) for at, us in enumerate(stamps_us(np.arange(0, 119.0)))]
    both = {("estimator_status_flags", 0): (FLAGS, rows), ("estimator_status", 0): fusing(lambda _: True)}
    logged = read_runs(write(tmp_path / "a.ulg", ulog(px4_drift(1.02, both))))
    assert [run.path_m > 0 for run in logged.runs] == [True, True]  # the one name goes before the other
    other = {("estimator_status_flags", 1): (FLAGS, [(us, at < 80, *rest) for at, (us, _, *rest) in enumerate(rows)])}
    logged = read_runs(write(tmp_path / "b.ulg", ulog(px4_drift(1.02, both | other))))
    assert logged.runs[0].path_m == pytest.approx(
        float(np.hypot(*np.diff(north_east_m(), axis=0).T)[400:590].sum()), abs=1
    )


@pytest.mark.parametrize(
    ("flags", "more", "match"),
    [
        ({("estimator_status", 0): fusing(lambda _: True)}, {},
         r"vehicle_local_position 0 fused GNSS from start to end \(estimator_status\): it is a copy of the truth"),
        ({}, {}, "estimator_status_flags and estimator_status are not logged, so nobody knows when vehicle_local_pos"),
        ({("estimator_status", 0): fusing(lambda time_s: time_s < 119.69, every_s=0.05)}, {},
         "vehicle_local_position 0 and vehicle_gps_position 0 have no two moments in common"),
        ({("estimator_status", 0): fusing(_middle)}, {"fix_type": 2}, "no place: 600 messages without a fix"),
    ],
)  # fmt: skip
def test_an_estimate_that_fused_gnss_is_refused_by_name(tmp_path: Path, flags, more, match) -> None:
    with pytest.raises(FlightError, match=match):
        read_runs(write(tmp_path / "a.ulg", ulog(px4_drift(1.02, flags, **more))))


# https://docs.px4.io/main/en/msg_docs/EstimatorStatus and EstimatorStatusFlags: whatever comes of a receiver, or as one
@pytest.mark.parametrize("bit", [2, 22, 38, 44])
def test_each_bit_that_a_receiver_is_fused_by_counts(tmp_path: Path, bit: int) -> None:
    rows = [(us, autopilots.OTHERS | 1 << bit) for us in stamps_us(np.arange(0, 119.0))]
    flags = {("estimator_status", 0): ("uint64_t timestamp;uint64_t control_mode_flags;", rows)}
    with pytest.raises(FlightError, match="vehicle_local_position 0 fused GNSS from start to end"):
        read_runs(write(tmp_path / "a.ulg", ulog(px4_drift(1.02, flags))))


@pytest.mark.parametrize("name", ["cs_gps", "cs_gnss_pos", "cs_gnss_vel", "cs_gps_yaw", "cs_gnss_yaw", "cs_aux_gpos"])
def test_each_flag_that_a_receiver_is_fused_by_counts(tmp_path: Path, name: str) -> None:
    rows = [(us, False, True) for us in stamps_us(np.arange(0, 119.0))]
    flags = {("estimator_status_flags", 0): (f"uint64_t timestamp;bool cs_ev_pos;bool {name};", rows)}
    with pytest.raises(FlightError, match="vehicle_local_position 0 fused GNSS from start to end"):
        read_runs(write(tmp_path / "a.ulg", ulog(px4_drift(1.02, flags))))


def test_a_global_estimate_is_no_truth(tmp_path: Path) -> None:
    log = px4_drift(1.02, {("estimator_status", 0): fusing(_middle)})
    rows = [(row[0], *row[2:5]) for row in log.pop(("vehicle_gps_position", 0))[1]]
    log["sensor_gps", 0] = (autopilots.GPS_114, gps_rows(FLOWN, fix_type=0))
    log["vehicle_global_position", 0] = ("uint64_t timestamp;double lat;double lon;float alt;", rows)
    with pytest.raises(FlightError, match="no place: 600 messages without a fix"):
        read_runs(write(tmp_path / "a.ulg", ulog(log)))


def _visual(scale: float, turned_deg: float, drift_deg_per_s: float) -> list[tuple]:
    """Poses of a camera whose frame is turned, and turns on."""
    rows = []
    place_m = north_east_m() * scale
    for at, us in enumerate(stamps_us(FLOWN.time_s)):
        off_deg = turned_deg + drift_deg_per_s * FLOWN.time_s[at]
        c, s = np.cos(np.radians(turned_deg)), np.sin(np.radians(turned_deg))
        north, east = place_m[at]
        place = (c * north - s * east, s * north + c * east, -float(FLOWN.height_m[at]))
        rows.append((us, 2, *place, *turn(float(FLOWN.yaw_deg[at]) + off_deg)))
    return rows


def test_poses_of_a_camera_are_odometry_with_headings_in_any_frame_whatever_was_fused(tmp_path: Path) -> None:
    flags = {("estimator_status", 0): fusing(lambda _: True)}
    camera = {("vehicle_visual_odometry", 0): (VISUAL, _visual(1.03, 70.0, 0.0))}
    logged = read_runs(write(tmp_path / "a.ulg", ulog(px4_drift(1.0, flags | camera))))
    assert logged.has_yaw
    assert figure(logged, "position_pct") == pytest.approx(3, abs=0.01)
    assert figure(logged, "yaw_deg") == pytest.approx(0, abs=0.01)
    camera = {("vehicle_visual_odometry", 0): (VISUAL, _visual(1.0, 70.0, 0.1))}
    logged = read_runs(write(tmp_path / "b.ulg", ulog(px4_drift(1.0, flags | camera))))
    way_m = float(np.hypot(*np.diff(north_east_m(), axis=0).T).sum())
    assert figure(logged, "yaw_deg") == pytest.approx(0.1 * LENGTH_M / way_m * FLOWN.time_s[-1], rel=0.02)
    assert logged.notes[1].startswith("odometry: vehicle_visual_odometry 0, 1 stretch of")


def test_poses_of_a_camera_without_attitudes_are_refused(tmp_path: Path) -> None:
    nan = float("nan")
    rows = [(*row[:5], nan, nan, nan, nan) for row in _visual(1.03, 70.0, 0.0)]
    log = px4_drift(1.0, {("vehicle_visual_odometry", 0): (VISUAL, rows)})
    with pytest.raises(FlightError, match="vehicle_visual_odometry 0 has no pose with a place and an attitude"):
        read_runs(write(tmp_path / "a.ulg", ulog(log)))
    log = px4_drift(1.0, {("vehicle_visual_odometry", 0): (VISUAL, _visual(1.03, 70.0, 0.0)[:9] + rows[9:])})
    assert read_runs(write(tmp_path / "b.ulg", ulog(log))).runs[0].path_m < 20
    del log["vehicle_attitude", 0]
    with pytest.raises(FlightError, match="vehicle_visual_odometry 0 has headings, and the log no attitudes"):
        read_runs(write(tmp_path / "c.ulg", ulog(log)))


def test_a_bag_of_px4_has_the_odometry_of_its_ulog(tmp_path: Path) -> None:
    pytest.importorskip("rosbags", reason="needs the extra [logs]")
    log = px4_drift(1.02, {})
    receiver = [one.split()[1] for one in autopilots.PX4_TYPES["SensorGps"].splitlines()]
    fields = [one.split(" ")[1] for one in autopilots.GPS_114.strip(";").split(";")]
    gps = log["vehicle_gps_position", 0][1]
    of = {
        "SensorGps": [{key: value for key, value in zip(fields, row, strict=True) if key in receiver} for row in gps],
        "VehicleLocalPosition": [
            dict(zip(("timestamp", "x", "y", "z", "xy_valid", "z_valid"), row, strict=True))
            for row in log["vehicle_local_position", 0][1]
        ],
        "VehicleAttitude": [{"timestamp": row[0], "q": row[1:]} for row in log["vehicle_attitude", 0][1]],
        "EstimatorStatusFlags": [{"timestamp": us, "cs_gps": False} for us in stamps_us(np.arange(0, 119.0))],
    }
    topics = {
        "SensorGps": "/fmu/out/vehicle_gps_position",
        "VehicleLocalPosition": "/fmu/out/vehicle_local_position_v1",
        "VehicleAttitude": "/fmu/out/vehicle_attitude",
        "EstimatorStatusFlags": "/fmu/out/estimator_status_flags",
    }
    messages = [
        (topics[kind], f"px4_msgs/msg/{kind}", START_S * 10**9 + row["timestamp"] * 1000, row)
        for kind, rows in of.items()
        for row in rows
    ]
    logged = read_runs(bag(tmp_path / "a.mcap", sorted(messages, key=lambda one: one[2])))
    assert figure(logged, "position_pct") == pytest.approx(2, abs=0.01)


def _odometry(topic: str, scale: float = 1.03) -> list:
    """Poses of a camera in axes of ROS, in a frame that is turned, beside what mavros publishes."""
    place_m = north_east_m() * scale
    messages = mavros_messages(FLOWN, late_s=0.0)
    turned = np.radians(70.0)
    for at, time_s in enumerate(FLOWN.time_s.tolist()):
        north, east = place_m[at]
        x, y = np.cos(turned) * east - np.sin(turned) * north, np.sin(turned) * east + np.cos(turned) * north
        half = (np.radians(90 - FLOWN.yaw_deg[at]) + turned) / 2  # counter-clockwise from east
        pose = {
            "position": {"x": float(x), "y": float(y), "z": 80.0},
            "orientation": {"w": float(np.cos(half)), "x": 0.0, "y": 0.0, "z": float(np.sin(half))},
        }
        fields = {"header": {"stamp": stamp(time_s)}, "pose": {"pose": pose}}
        messages.append((topic, "nav_msgs/msg/Odometry", START_S * 10**9 + round(time_s * 1e9), fields))
    return messages


@pytest.mark.parametrize("name", ["a.bag", "a.mcap"])
def test_a_topic_of_a_bag_is_odometry_where_it_is_said_to_have_fused_no_gnss(tmp_path: Path, name: str) -> None:
    pytest.importorskip("rosbags", reason="needs the extra [logs]")
    path = bag(tmp_path / name, _odometry("/vio/odometry"))
    with pytest.raises(
        FlightError, match=r"no bag says of poses whether .*: say --topic, one of '/vio/odometry', if it"
    ):
        read_runs(path)
    with pytest.raises(FlightError, match="has no poses on '/vio': say --topic, one of '/vio/odometry'"):
        read_runs(path, topic="/vio")
    logged = read_runs(path, topic="/vio/odometry")
    assert figure(logged, "position_pct") == pytest.approx(3, abs=0.02)
    assert figure(logged, "yaw_deg") == pytest.approx(0, abs=0.02)
    assert logged.notes[1].endswith(" without GNSS (as --topic says)")
    with pytest.raises(FlightError, match=r"a\.ulg is no bag: leave out --topic"):
        read_runs(tmp_path / "a.ulg", topic="/vio/odometry")


@pytest.mark.parametrize(
    "topic", ["/mavros/local_position/odom", "/mavros/global_position/local", "/odometry/filtered"]
)
def test_a_topic_that_fused_gnss_is_refused_by_its_name(tmp_path: Path, topic: str) -> None:
    pytest.importorskip("rosbags", reason="needs the extra [logs]")
    path = bag(tmp_path / "a.mcap", _odometry(topic))
    with pytest.raises(FlightError, match=f"{topic} is what the autopilot or a filter made of the receiver: a copy of"):
        read_runs(path, topic=topic)


def test_odometry_beside_no_receiver_is_refused(tmp_path: Path) -> None:
    pytest.importorskip("rosbags", reason="needs the extra [logs]")
    messages = [one for one in _odometry("/vio") if not one[0].endswith("raw/fix")]
    with pytest.raises(FlightError, match="/mavros/global_position/global is an estimate, and no truth"):
        read_runs(bag(tmp_path / "a.mcap", messages), topic="/vio")
    with pytest.raises(FlightError, match="say --topic, of poses, of which it has none"):
        read_runs(bag(tmp_path / "b.mcap", mavros_messages(FLOWN)))


# ArduPilot

USING_GPS = 1 << 13
FLYING = 0b111111  # of the filter: attitude, velocities and positions are valid


def ardupilot(scale: float, is_fused: Callable[[float], bool], **more) -> dict:
    """A DataFlash log whose second core is the one that flies, and is too long by a scale."""
    rows = ardupilot_rows(FLOWN)
    del rows["POS"]
    place_m = north_east_m() * scale
    rows |= {"XKF1": [], "XKF4": []}
    for at, us in enumerate(stamps_us(FLOWN.time_s)):
        north, east = place_m[at].tolist()
        status = FLYING | USING_GPS * is_fused(FLOWN.time_s[at])
        for core in (0, 1):
            away = 0.0 if core else 50.0 * np.sin(at)
            rows["XKF1"].append((us, core, *[0.0] * 7, north + away, east, 0.0, 0.0, 0.0, 0.0, 0.0))
            rows["XKF4"].append((us, core, *[0.0] * 8, 0, 0, status, 0, 1))
    return rows | more


@pytest.mark.parametrize(("name", "lay"), [("a.bin", dataflash), ("a.log", dataflash_text)])
def test_drift_of_ardupilot_is_that_of_the_core_that_flew(tmp_path, name, lay) -> None:
    logged = read_runs(write(tmp_path / name, lay(ardupilot(1.02, _middle))))
    assert figure(logged, "position_pct") == pytest.approx(2, abs=0.01)
    assert logged.notes[1].startswith("odometry: XKF1 1, 1 stretch of ")
    assert logged.notes[1].endswith(" without GNSS (XKF4.SS)")
    with pytest.raises(
        FlightError, match=r"XKF1 1 fused GNSS from start to end \(XKF4.SS\): it is a copy of the truth"
    ):
        read_runs(write(tmp_path / name, lay(ardupilot(1.02, lambda _: True))))
    rows = ardupilot(1.02, _middle)
    del rows["XKF4"]
    with pytest.raises(FlightError, match="XKF4 is not logged, so nobody knows when XKF1 fused GNSS"):
        read_runs(write(tmp_path / name, lay(rows)))
    with pytest.raises(FlightError, match="holds no odometry: neither poses of a camera nor those of the estimator"):
        read_runs(write(tmp_path / name, lay({"GPS": rows["GPS"], "ATT": rows["ATT"]})))


def test_an_estimate_that_is_held_in_place_is_no_odometry(tmp_path: Path) -> None:
    rows = ardupilot(1.02, lambda _: False)
    rows["XKF4"] = [(*row[:12], row[12] | 1 << 7, *row[13:]) for row in rows["XKF4"]]
    with pytest.raises(FlightError, match="XKF1 1 fused GNSS from start to end"):
        read_runs(write(tmp_path / "a.bin", dataflash(rows)))


@pytest.mark.parametrize(("place", "is_refused"), [(6.0, True), (3.0, False)])
def test_a_receivers_velocity_that_is_fused_beside_another_position_is_refused(tmp_path, place, is_refused) -> None:
    messages = autopilots.MESSAGES | {"PARM": (207, "QNff", "TimeUS,Name,Value,Default")}
    rows = ardupilot(1.02, _middle)
    rows["PARM"] = [
        (1000, b"EK3_SRC1_POSXY", place, 3.0),
        (1001, b"EK3_SRC1_VELXY", 3.0, 3.0),
        (1002, b"EK3_SRC2_VELXY", 0.0, 0.0),
    ]
    path = write(tmp_path / "a.bin", dataflash(rows, messages))
    if is_refused:
        with pytest.raises(FlightError, match=r"XKF1 1 fused the velocity of the receiver \(EK3_SRC1_VELXY 3\)"):
            read_runs(path)
    else:
        assert figure(read_runs(path), "position_pct") == pytest.approx(2, abs=0.01)


def test_poses_of_a_camera_of_ardupilot_are_odometry(tmp_path: Path) -> None:
    rows = ardupilot(1.0, lambda _: True)
    rows["VISP"] = []
    place_m = north_east_m() * 1.04
    for at, us in enumerate(stamps_us(FLOWN.time_s)):
        north, east = place_m[at].tolist()
        yaw = float(FLOWN.yaw_deg[at])
        rows["VISP"].append((us, us, us // 1000, north, east, 0.0, 0.0, 0.0, yaw, 0.1, 0.1, 0.1, 0, 90))
    logged = read_runs(write(tmp_path / "a.bin", dataflash(rows)))
    assert logged.has_yaw
    assert figure(logged, "position_pct") == pytest.approx(4, abs=0.02)


def test_steps_of_a_camera_are_summed_in_the_axes_of_the_body(tmp_path: Path) -> None:
    messages = autopilots.MESSAGES | {"VISO": (208, "Qffffffff", "TimeUS,dt,AngDX,AngDY,AngDZ,PosDX,PosDY,PosDZ,conf")}
    rows = ardupilot(1.0, lambda _: True)
    rows["VISO"] = []
    yaw_rad = np.unwrap(np.radians(FLOWN.yaw_deg))
    place_m = north_east_m() * 1.02
    for at, us in enumerate(stamps_us(FLOWN.time_s)):
        north, east = place_m[at] - place_m[max(at - 1, 0)]
        before = yaw_rad[max(at - 1, 0)]
        ahead = np.cos(before) * north + np.sin(before) * east
        right = -np.sin(before) * north + np.cos(before) * east
        rows["VISO"].append((us, 0.2, 0.0, 0.0, yaw_rad[at] - before, ahead, right, 0.0, 90.0))
    logged = read_runs(write(tmp_path / "a.bin", dataflash(rows, messages)))
    assert figure(logged, "position_pct") == pytest.approx(2, abs=0.02)
    assert figure(logged, "yaw_deg") == pytest.approx(0, abs=0.02)


# Telemetry


def _with_odometry(*, scale: float = 1.03, estimator_type: int = 3, system: int = 1, is_old: bool = False) -> bytes:
    """Telemetry of a flight with poses that a companion sent, counted by its own clock, in a frame that is turned."""
    from pymavlink.dialects.v20 import common  # type: ignore[import-untyped] # noqa: PLC0415 - only where installed

    link = common.MAVLink(None, srcSystem=system, srcComponent=197)
    packets = tlog(FLOWN, systems=(1, 2) if system == 2 else (1,), late_s=0)
    nan = [float("nan")] * 21
    place_m = north_east_m() * scale
    turned = np.radians(40.0)
    for at, time_s in enumerate(FLOWN.time_s.tolist()):
        north, east = place_m[at].tolist()
        x, y = np.cos(turned) * north - np.sin(turned) * east, np.sin(turned) * north + np.cos(turned) * east
        own_us = 5_000_000_000 + round(time_s * 1e6)
        yaw_deg = float(FLOWN.yaw_deg[at]) + 40.0
        if is_old:
            yaw = float(np.radians((yaw_deg + 180) % 360 - 180))
            one = common.MAVLink_vision_position_estimate_message(own_us, x, y, -80.0, 0.0, 0.0, yaw)
        else:
            one = common.MAVLink_odometry_message(
                own_us, 20, 12, x, y, -80.0, list(turn(yaw_deg)), *[0.0] * 6, nan, nan, 0, estimator_type, 0
            )
        received = START_S * 1_000_000 + round(time_s * 1e6)
        packets += received.to_bytes(8, "big") + bytes(one.pack(link))
    return packets


@pytest.mark.parametrize("is_old", [False, True], ids=["ODOMETRY", "VISION_POSITION_ESTIMATE"])
def test_poses_that_a_companion_sent_are_odometry(tmp_path: Path, *, is_old: bool) -> None:
    logged = read_runs(write(tmp_path / "a.tlog", _with_odometry(is_old=is_old)))
    assert figure(logged, "position_pct") == pytest.approx(3, abs=0.02)
    assert figure(logged, "yaw_deg") == pytest.approx(0, abs=0.02)
    assert " of component 197, 1 stretch of " in logged.notes[1]


@pytest.mark.parametrize("estimator_type", [0, 4, 5, 8])  # unknown, GPS, with inertial sensors, the autopilot's own
def test_odometry_that_may_have_fused_gnss_is_refused_by_its_kind(tmp_path: Path, estimator_type: int) -> None:
    path = write(tmp_path / "a.tlog", _with_odometry(estimator_type=estimator_type))
    match = rf"no odometry: ODOMETRY of component 197 \(estimator_type {estimator_type}\) may have fused GNSS"
    with pytest.raises(FlightError, match=match):
        read_runs(path)
    with pytest.raises(FlightError, match="no odometry: neither ODOMETRY nor VISION_POSITION_ESTIMATE was sent"):
        read_runs(write(tmp_path / "b.tlog", tlog(FLOWN)))


def test_of_several_vehicles_the_odometry_of_one_is_measured(tmp_path: Path) -> None:
    path = write(tmp_path / "a.tlog", _with_odometry(system=2))
    with pytest.raises(FlightError, match="vehicles 1, 2 send places: say which one"):
        read_runs(path)
    assert figure(read_runs(path, vehicle=2), "position_pct") == pytest.approx(3, abs=0.02)
    with pytest.raises(FlightError, match="neither ODOMETRY nor VISION_POSITION_ESTIMATE was sent"):
        read_runs(path, vehicle=1)
    with pytest.raises(FlightError, match=r"a\.ulg is no telemetry log: leave out --vehicle"):
        read_runs(tmp_path / "a.ulg", vehicle=1)


# Flags


@pytest.mark.parametrize(
    ("told", "expected"),
    [
        ([0, 0, 0, 0], ((0.0, 3.0),)),
        ([1, 1, 1, 1], ()),
        ([0, 1, 0, 1], ()),  # one flag alone is no stretch
        ([0, 0, 1, 0], ((0.0, 1.0),)),
        ([1, 0, 0, 0], ((1.0, 3.0),)),
    ],
)
def test_a_stretch_lies_between_two_flags_that_say_so(told: list[int], expected: tuple) -> None:
    assert free_stretches([(np.arange(4.0), np.array(told, dtype=bool))]) == expected


def test_a_slow_instance_that_fused_is_not_passed_over_between_its_flags() -> None:
    slow = (np.array([0.0, 2.0, 4.0]), np.array([True, True, False]))
    often = (np.arange(0.0, 4.1, 0.25), np.zeros(17, dtype=bool))
    assert free_stretches([slow, often]) == ()


@pytest.mark.parametrize("name", ["a.gpx", "a.csv", "a"])
def test_a_file_that_has_no_odometry_is_refused(tmp_path: Path, name: str) -> None:
    with pytest.raises(FlightError, match=r"is no log with odometry that is read: .ulg, .bin, .log, .tlog, .bag"):
        read_runs(tmp_path / name)
