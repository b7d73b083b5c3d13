# SPDX-License-Identifier: Apache-2.0
"""Bags of ROS: topics by their types, clocks of headers and of the recorder, and damaged files."""

import sqlite3
from contextlib import closing
from pathlib import Path

import numpy as np
import pytest

from sasgeo_bench.core.errors import FlightError
from sasgeo_bench.flights.logs import read_log
from tests.flights.autopilots import (
    GROUND_M,
    NAV_SAT,
    START_S,
    Flown,
    bag,
    mavros_messages,
    px4_messages,
    stamp,
    write,
)
from tests.flights.test_log_ulog import check_flown, matrix_of, quaternion_of

rosbags = pytest.importorskip("rosbags", reason="needs the extra [logs]")

FLOWN = Flown()
FORMS = ["a.bag", "a.mcap", "a.db3"]
START_NS = START_S * 10**9


@pytest.mark.parametrize("name", FORMS)
def test_a_bag_of_mavros_is_the_flight_by_the_stamps_of_its_headers(tmp_path: Path, name: str) -> None:
    log = read_log(bag(tmp_path / name, mavros_messages(FLOWN)))
    assert log.lon_deg == pytest.approx(FLOWN.lon_deg, abs=1e-9)
    assert log.lat_deg == pytest.approx(FLOWN.lat_deg, abs=1e-9)  # of the receiver, not of what it was fused into
    assert log.time_s == pytest.approx(FLOWN.time_s, abs=1e-6)
    assert log.start_s == pytest.approx(START_S, abs=1e-6)
    assert log.height_m == pytest.approx(FLOWN.height_m, abs=1e-6)  # recorded late, and without a header
    assert (log.altitude_m, log.altitude_of) == (pytest.approx(GROUND_M + 47 + FLOWN.height_m), "ellipsoid")
    assert (log.yaw_deg - FLOWN.yaw_deg + 180) % 360 - 180 == pytest.approx(0, abs=1e-3)
    assert log.notes == (
        "place: /mavros/global_position/raw/fix, fixes, 5 Hz, accuracy 1.5 m (median)",
        "altitude: above the ellipsoid of WGS 84",
        "height: /mavros/global_position/rel_alt, above take-off",
        "attitude: /mavros/imu/data, yaw from true north",
        "clock: UTC by the computer's clock",
        "not read: /mavros/global_position/global",
        "times: stamps of headers",
    )


def test_attitudes_of_ros_are_turned_from_its_axes(tmp_path: Path) -> None:
    # forward, left, up to east, north, up (REP 103), where ours are forward, right, down to north, east, down
    to_enu, to_flu = np.array([[0, 1, 0], [1, 0, 0], [0, 0, -1]]), np.diag([1, -1, -1])
    w, x, y, z = quaternion_of(to_enu @ matrix_of(30, 10, -20) @ to_flu)
    messages = [
        (*row[:3], row[3] | {"orientation": {"w": w, "x": x, "y": y, "z": z}}) if row[0] == "/mavros/imu/data" else row
        for row in mavros_messages(FLOWN)
    ]
    log = read_log(bag(tmp_path / "a.bag", messages))
    for angles_deg, expected in ((log.yaw_deg, 30), (log.pitch_deg, 10), (log.roll_deg, -20)):
        assert angles_deg == pytest.approx(expected, abs=1e-6)


@pytest.mark.parametrize("is_new", [True, False], ids=["1.14", "1.13"])
def test_a_bag_of_px4_is_read_as_a_ulog_by_the_types_that_it_brings_along(tmp_path: Path, *, is_new: bool) -> None:
    log = read_log(bag(tmp_path / "a.mcap", px4_messages(FLOWN, is_new=is_new)))
    check_flown(log)
    assert log.notes[0].startswith("place: vehicle_gps_position 0, fixes")
    assert "/fmu/out/vehicle_gps_position is vehicle_gps_position 0" in log.notes[-1]


@pytest.mark.parametrize("name", ["a.mcap", "a.db3"])
def test_the_file_of_a_bag_is_read_as_its_folder_is(tmp_path: Path, name: str) -> None:
    folder = bag(tmp_path / name, mavros_messages(Flown(count=20)))
    (path,) = folder.glob("*" + Path(name).suffix)
    assert read_log(path).lat_deg.tolist() == read_log(folder).lat_deg.tolist()


def _fixes(topic: str, *, count: int = 20, start_ns: int = START_NS, recorded_ns: int = START_NS, **fields) -> list:
    rows = []
    for at in range(count):
        place = {"latitude": 47.0 + at * 1e-5, "longitude": 9.5, "altitude": 500.0}
        time = {"header": {"stamp": stamp(at * 0.2, start_ns=start_ns)}}
        rows.append((topic, NAV_SAT, recorded_ns + at * 200_000_000, time | place | fields))
    return rows


def test_the_topic_with_the_most_fixes_is_read_and_an_estimate_only_where_there_is_no_other(tmp_path: Path) -> None:
    log = read_log(
        bag(tmp_path / "a.mcap", [*_fixes("/b"), *_fixes("/a", count=9), *_fixes("/gps/filtered", count=40)])
    )
    assert log.notes[0].startswith("place: /b, fixes")
    assert "not read: /a, /gps/filtered" in log.notes
    blind = _fixes("/b", status={"status": -1})
    log = read_log(bag(tmp_path / "b.mcap", [*blind, *_fixes("/gps/filtered")]))
    assert log.notes[0].startswith("place: /gps/filtered, an estimate that fused the receiver")


def test_a_clock_of_a_simulator_is_no_utc(tmp_path: Path) -> None:
    log = read_log(bag(tmp_path / "a.mcap", _fixes("/fix", start_ns=2 * 10**9)))
    assert log.start_s is None
    assert log.time_s == pytest.approx(np.arange(20) * 0.2)
    assert "clock: seconds of the log's own, UTC is not known" in log.notes


def test_without_stamps_times_are_the_recorders(tmp_path: Path) -> None:
    messages = [(*row[:3], row[3] | {"header": {}}) for row in _fixes("/fix")]
    log = read_log(bag(tmp_path / "a.mcap", messages))
    assert log.time_s == pytest.approx(np.arange(20) * 0.2)
    assert log.start_s == pytest.approx(START_S)
    assert log.notes[-1] == "times: the recorder's, as /fix has none of its own"


def test_messages_out_of_order_are_sorted_and_a_clock_that_jumps_back_is_refused(tmp_path: Path) -> None:
    rows = _fixes("/fix")
    swapped = [*rows[:5], rows[6], rows[5], *rows[7:]]  # each written at a time of its own
    swapped = [(*row[:2], rows[at][2], row[3]) for at, row in enumerate(swapped)]
    log = read_log(bag(tmp_path / "a.mcap", swapped))
    assert log.lat_deg == pytest.approx(47.0 + np.arange(20) * 1e-5)
    later = _fixes("/fix", start_ns=START_NS - 60 * 10**9, recorded_ns=START_NS + 10**10)
    with pytest.raises(FlightError, match=r"b: the clock of /fix jumps back by 63\.8 s"):
        read_log(bag(tmp_path / "b.mcap", [*rows, *later]))


@pytest.mark.parametrize("name", FORMS)
def test_messages_of_one_recorded_time_go_by_their_stamps_and_without_these_the_first_is_read(tmp_path, name) -> None:
    rows = _fixes("/fix")
    burst = [(*row[:2], START_NS, row[3]) for row in reversed(rows)]  # in the file in reverse
    log = read_log(bag(tmp_path / f"1{name}", burst))
    assert log.lat_deg == pytest.approx(47.0 + np.arange(20) * 1e-5)
    assert log.time_s == pytest.approx(np.arange(20) * 0.2)
    pairs = [(*row[:2], START_NS + at // 2 * 10**9, row[3] | {"header": {}}) for at, row in enumerate(rows)]
    log = read_log(bag(tmp_path / f"2{name}", pairs))
    assert log.lat_deg == pytest.approx(47.0 + np.arange(0, 20, 2) * 1e-5)
    assert log.time_s == pytest.approx(np.arange(10))


def test_places_of_other_types_are_read(tmp_path: Path) -> None:
    place = {"latitude": 47.0, "longitude": 9.5, "altitude": 500.0}
    found = [
        ("/at", "foxglove_msgs/msg/LocationFix", START_NS + at * 10**9,
         {"timestamp": stamp(at), **place, "latitude": 47 + at * 1e-5})
        for at in range(5)
    ]  # fmt: skip
    log = read_log(bag(tmp_path / "a.mcap", found))
    assert log.lat_deg == pytest.approx(47 + np.arange(5) * 1e-5)
    assert (log.altitude_of, log.start_s) == ("ellipsoid", START_S)
    geo = [
        ("/pose", "geographic_msgs/msg/GeoPointStamped", START_NS + at * 10**9,
         {"header": {"stamp": stamp(at)}, "position": place | {"latitude": 47 + at * 1e-5}})
        for at in range(5)
    ]  # fmt: skip
    log = read_log(bag(tmp_path / "b.bag", geo))
    assert log.lat_deg == pytest.approx(47 + np.arange(5) * 1e-5)
    assert "an estimate" in log.notes[0]


@pytest.mark.parametrize("name", FORMS)
def test_a_bag_without_places_is_refused(tmp_path: Path, name: str) -> None:
    height = [("/mavros/global_position/rel_alt", "std_msgs/msg/Float64", START_NS, {"data": 1.0})]
    for messages, topics in ((height, ()), ([], [("/fix", NAV_SAT)])):  # the library counts an empty bag from 2^63 - 1
        path = tmp_path / f"{len(messages)}{name}"
        with pytest.raises(FlightError, match="no place: no message of NavSatFix"):
            read_log(bag(path, messages, topics=topics))


@pytest.mark.parametrize("name", FORMS)
def test_a_bag_that_was_cut_off_is_refused_with_the_tool_that_mends_it(tmp_path: Path, name: str) -> None:
    whole = bag(tmp_path / name, mavros_messages(FLOWN))
    file = whole if whole.is_file() else next(whole.glob("*" + Path(name).suffix))
    path = write(tmp_path / f"cut{file.suffix}", file.read_bytes()[: file.stat().st_size // 2])
    with pytest.raises(
        FlightError, match=r"cut\.\w+: cannot be read as such a log .*: mend a bag that was cut off"
    ) as fault:
        read_log(path)
    assert str(fault.value).isprintable()


def test_a_bag_that_lost_the_messages_which_it_counts_is_refused_in_one_line(tmp_path: Path) -> None:
    folder = bag(tmp_path / "folder.db3", mavros_messages(FLOWN))
    with closing(sqlite3.connect(next(folder.glob("*.db3")))) as file:
        file.execute("DELETE FROM messages")
        file.commit()
    with pytest.raises(FlightError, match=r"says that '/mavros/.*' has messages, and holds none: mend a bag"):
        read_log(folder)


@pytest.mark.parametrize("data", [b"", b"#ROSBAG V2.0\n", b"\x89MCAP0\r\n", b"PK" * 99])
@pytest.mark.parametrize("suffix", [".bag", ".mcap", ".db3"])
def test_a_file_that_is_no_bag_is_refused_in_one_line(tmp_path: Path, suffix: str, data: bytes) -> None:
    with pytest.raises(FlightError, match=r"cannot be read as such a log|no place|empty") as fault:
        read_log(write(tmp_path / f"a{suffix}", data))
    assert str(fault.value).isprintable()


def test_a_folder_that_is_no_bag_is_refused(tmp_path: Path) -> None:
    with pytest.raises(FlightError, match="is no flight log that is read"):
        read_log(tmp_path)
    (tmp_path / "metadata.yaml").write_text("a: [")
    with pytest.raises(FlightError, match="cannot be read as such a log"):
        read_log(tmp_path)
