# SPDX-License-Identifier: Apache-2.0
"""Logs held against the libraries' own tools, column by column: ulog2csv, mavlogdump, rosbags-convert, exiftool."""

import csv
import json
import shutil
import sqlite3
import struct
import subprocess
import sys
from collections.abc import Sequence
from contextlib import closing
from pathlib import Path
from typing import Any, Final

import numpy as np
import pytest
from numpy.typing import NDArray

from sasgeo_bench.flights.log_dataflash import read_messages
from sasgeo_bench.flights.log_subtitles import read_srt
from sasgeo_bench.flights.log_telemetry import FIELDS, read_telemetry
from sasgeo_bench.flights.log_ulog import OF_DRIFT, TOPICS, read_topics
from sasgeo_bench.flights.logs import read_log
from tests.flights import autopilots
from tests.flights.autopilots import (
    Flown,
    ardupilot_rows,
    bag,
    dataflash,
    dataflash_text,
    mavros_messages,
    px4_topics,
    stamps_us,
    tlog,
    turn,
    ulog,
    write,
)

FLOWN = Flown(count=60)
Floats = NDArray[np.float64]
Table = dict[str, Floats]
TOOLS: Final = Path(sys.executable).parent


def ran(*words: object) -> str:
    """What a tool prints."""
    done = subprocess.run(list(map(str, words)), capture_output=True, text=True, check=True)  # noqa: S603 - our own
    return done.stdout


def table_of(text: str) -> Table:
    """Columns of a CSV whose cells are numbers."""
    rows = list(csv.DictReader(text.splitlines()))
    return {name: np.array([float(row[name]) for row in rows]) for name in rows[0]}


def wrapped(angle_deg: Floats) -> Floats:
    return (angle_deg + 180) % 360 - 180


# PX4, by ulog2csv

FLAGS = "uint64_t timestamp;bool cs_gps;bool cs_gnss_pos;"
STATUS = "uint64_t timestamp;uint64_t control_mode_flags;"
VISUAL = "uint64_t timestamp;uint8_t pose_frame;float[3] position;float[4] q;"


def _px4(*, is_new: bool) -> bytes:
    """All topics that are read of a ULog, with a receiver that has no fix at first, and a dropout."""
    topics = px4_topics(FLOWN, is_new=is_new)
    receiver = ("vehicle_gps_position", 0)
    fields, rows = topics[receiver]
    topics[receiver] = (fields, [(*row[:-2], 1.0 + 0.01 * at, 3) for at, row in enumerate(rows)])
    stamps = stamps_us(FLOWN.time_s)
    topics["sensor_gps", 1] = (fields, [(*row[:-1], 1) for row in rows])
    topics["estimator_status_flags", 0] = (FLAGS, [(us, at % 2 == 0, at > 9) for at, us in enumerate(stamps)])
    topics["estimator_status", 0] = (STATUS, [(us, 2**44 + at) for at, us in enumerate(stamps)])
    topics["vehicle_visual_odometry", 0] = (VISUAL, [(us, 2, 0.1, at, -3.5, *turn(at)) for at, us in enumerate(stamps)])
    topics["vehicle_land_detected", 0] = ("uint64_t timestamp;bool landed;", [(stamps[0], True), (stamps[5], False)])
    topics["vehicle_global_position", 0] = (
        "uint64_t timestamp;double lat;double lon;float alt;bool lat_lon_valid;",
        [(us, 47.14, 9.52, 500.25, at > 3) for at, us in enumerate(stamps)],
    )
    return ulog(topics, dropouts=[(stamps[20], 250)])


@pytest.fixture(params=[True, False], ids=["1.14", "1.13"])
def px4(request: pytest.FixtureRequest, tmp_path: Path) -> tuple[Path, dict[tuple[str, int], Table]]:
    """A ULog, and what ulog2csv writes of it: by topic and instance."""
    pytest.importorskip("pyulog", reason="needs the extra [logs]")
    path = write(tmp_path / "a.ulg", _px4(is_new=request.param))
    ran(TOOLS / "ulog2csv", path, "-o", tmp_path)
    found = {}
    for file in tmp_path.glob("a_*.csv"):
        name, _, number = file.stem.removeprefix("a_").rpartition("_")
        found[name, int(number)] = table_of(file.read_text())
    return path, found


def test_each_column_of_each_topic_is_what_ulog2csv_writes(px4) -> None:
    path, written = px4
    names = tuple(dict.fromkeys((*TOPICS, *OF_DRIFT)))
    topics = read_topics(path, names).topics
    assert set(topics) == set(written)
    for key, columns in topics.items():
        assert set(columns) == set(written[key])
        for name, values in columns.items():
            # ulog2csv rounds what is single to 8 digits
            assert np.asarray(values, dtype=float) == pytest.approx(written[key][name], rel=1e-7), (key, name)


def test_a_flight_of_px4_is_what_plain_arithmetic_makes_of_ulog2csv(px4) -> None:
    path, written = px4
    log = read_log(path)
    fixes, home = written["vehicle_gps_position", 0], written["home_position", 0]
    local, turns = written["vehicle_local_position", 0], written["vehicle_attitude", 0]
    is_new = "latitude_deg" in fixes
    lon, lat = (fixes["longitude_deg"], fixes["latitude_deg"]) if is_new else (fixes["lon"] / 1e7, fixes["lat"] / 1e7)
    assert log.lon_deg == pytest.approx(lon, abs=1e-10)
    assert log.lat_deg == pytest.approx(lat, abs=1e-10)
    assert log.altitude_m == pytest.approx(fixes["altitude_msl_m"] if is_new else fixes["alt"] / 1e3)
    assert log.altitude_of == "geoid"
    assert log.time_s == pytest.approx((fixes["timestamp"] - fixes["timestamp"][0]) / 1e6, abs=1e-9)
    assert log.start_s == pytest.approx(fixes["time_utc_usec"][0] / 1e6, abs=1e-3)
    z_m = np.interp(fixes["timestamp"], local["timestamp"], local["z"])
    assert log.height_m == pytest.approx(home["z"][0] - z_m, abs=1e-5)
    w, x, y, z = (turns[f"q[{at}]"] for at in range(4))
    yaw_deg = np.degrees(np.unwrap(np.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))))
    assert wrapped(log.yaw_deg - np.interp(fixes["timestamp"], turns["timestamp"], yaw_deg)) == pytest.approx(
        0, abs=1e-3
    )
    assert f"accuracy {np.median(fixes['eph']):.1f} m (median)" in log.notes[0]


def test_the_table_that_ulog2csv_writes_is_the_same_flight(px4, tmp_path: Path) -> None:
    path, _ = px4
    log, table = read_log(path), read_log(tmp_path / "a_vehicle_gps_position_0.csv")
    for name in ("lon_deg", "lat_deg", "time_s", "altitude_m"):
        assert getattr(table, name) == pytest.approx(getattr(log, name), abs=1e-9), name
    assert (table.altitude_of, table.height_m) == ("geoid", None)


# ArduPilot, by mavlogdump


def dumped(path: Path, *types: str) -> str:
    """What mavlogdump prints of messages, as CSV."""
    return ran(sys.executable, TOOLS / "mavlogdump.py", "--format", "csv", "--types", ",".join(types), path)


def messages_dumped(path: Path, names: Sequence[str]) -> dict[str, list[dict[str, Any]]]:
    """What mavlogdump prints of messages, by their name: its JSON holds those of several, and lists as they are."""
    words = (sys.executable, TOOLS / "mavlogdump.py", "--format", "json", "--types", ",".join(names), path)
    found: dict[str, list[dict[str, Any]]] = {}
    for line in ran(*words).splitlines():
        row = json.loads(line)
        found.setdefault(row["meta"]["type"], []).append(row)
    return found


def _ardupilot() -> dict[str, list[tuple]]:
    """All messages that are read of a DataFlash log, with numbers of their own in every column."""
    rows = ardupilot_rows(FLOWN)
    for at, us in enumerate(stamps_us(FLOWN.time_s)):
        angles, metres = (0.1 * at, -0.25 * at, 90.5), (1.5 * at, -2.5, 0.125 * at)
        rows.setdefault("XKF1", []).append((us, 1, *angles, *metres, 0.5, *metres, 0.1, 0.2, 0.3, 7.25))
        rows.setdefault("XKF4", []).append((us, 1, *[0.25] * 5, 0.5, *metres[:2], at, 3, 8191, 40, 1))
        rows.setdefault("VISP", []).append((us, us, us // 1000, *metres, *angles, 0.1, 0.2, 0.3, 0, 90))
    return rows


OF_DATAFLASH = ("GPS", "GPA", "POS", "ATT", "XKF1", "XKF4", "VISP")


@pytest.mark.parametrize(("file", "lay"), [("a.bin", dataflash), ("a.log", dataflash_text)])
def test_each_column_of_dataflash_is_what_mavlogdump_prints(tmp_path: Path, file: str, lay) -> None:
    pytest.importorskip("pymavlink", reason="needs the extra [logs]")
    path = write(tmp_path / file, lay(_ardupilot()))
    printed, messages = messages_dumped(path, OF_DATAFLASH), read_messages(path, OF_DATAFLASH).messages
    assert set(printed) == set(messages) == set(OF_DATAFLASH)
    for name, columns in messages.items():
        assert {column for row in printed[name] for column in row["data"]} == set(columns), name
        for column, values in columns.items():
            expected = [float(row["data"][column]) for row in printed[name]]
            assert values == pytest.approx(expected, rel=1e-6), (name, column)


def _telemetry() -> bytes:
    """Telemetry with a second receiver, and with poses of a companion in both messages that carry them."""
    from pymavlink.dialects.v20 import common  # type: ignore[import-untyped] # noqa: PLC0415 - only where installed

    link = common.MAVLink(None, srcSystem=1, srcComponent=197)
    autopilot = common.MAVLink(None, srcSystem=1, srcComponent=1)
    nan, packets = [float("nan")] * 21, tlog(FLOWN, late_s=0)
    for at, us in enumerate(stamps_us(FLOWN.time_s)):
        place, more = (1.5 * at, -0.5 * at, -80.25), (*[0.0] * 6, nan, nan, 0, 3, 0)
        lat, lon = 471_400_000 + 7 * at, 95_200_000 - 3 * at
        receiver = common.MAVLink_gps2_raw_message(
            us, 3, lat, lon, 560_000, 80, 90, 800, 4500, 9, 0, 0, h_acc=4000 + at
        )
        for sender, one in (
            (autopilot, receiver),
            (link, common.MAVLink_odometry_message(us, 20, 12, *place, list(turn(at)), *more)),
            (link, common.MAVLink_vision_position_estimate_message(us, *place, 0.125, -0.25, 0.01 * at)),
        ):
            received_us = autopilots.START_S * 1_000_000 + round(float(FLOWN.time_s[at]) * 1e6)
            packets += received_us.to_bytes(8, "big") + bytes(one.pack(sender))
    return packets


def test_each_column_of_telemetry_is_what_mavlogdump_prints(tmp_path: Path) -> None:
    pytest.importorskip("pymavlink", reason="needs the extra [logs]")
    path = write(tmp_path / "a.tlog", _telemetry())
    read, printed = read_telemetry(path), messages_dumped(path, tuple(FIELDS))
    assert set(printed) == set(FIELDS)
    for name, rows in printed.items():
        columns = read.messages.get(name) or read.odometry[name, 197]
        assert len(rows) == len(columns["received"]) == len(FLOWN.time_s), name
        assert columns["received"] == pytest.approx([row["meta"]["timestamp"] for row in rows], abs=1e-5), name
        for column in FIELDS[name]:
            title, _, at = column.rstrip("]").partition("[")
            cells = [row["data"][title] for row in rows]
            values = [float(cell[int(at)] if at else cell) for cell in cells]
            assert columns[column] == pytest.approx(values, rel=1e-6), (name, column)


# Message, its file; the places in it: degrees of a DataFlash log, counts of 1e-7 degrees of telemetry.
DUMPED = [("GPS", "a.bin"), ("GPS", "a.log"), ("GLOBAL_POSITION_INT", "a.tlog"), ("GPS_RAW_INT", "a.tlog")]


@pytest.mark.parametrize(("name", "file"), DUMPED)
@pytest.mark.filterwarnings("ignore:.*without a fix", "ignore:.*no line has a yaw")
def test_the_table_that_mavlogdump_prints_is_the_same_flight_in_its_own_unit(
    tmp_path: Path, name: str, file: str
) -> None:
    pytest.importorskip("pymavlink", reason="needs the extra [logs]")
    rows = _ardupilot()
    rows["GPS"] = [
        (*row[:2], min(row[2], 2 + at // 9), *row[3:]) for at, row in enumerate(rows["GPS"])
    ]  # at first of 2D
    data = tlog(FLOWN) if file == "a.tlog" else (dataflash if file == "a.bin" else dataflash_text)(rows)
    path = write(tmp_path / file, data)
    (tmp_path / "dumped.csv").write_text(dumped(path, name))
    table, log = read_log(tmp_path / "dumped.csv"), read_log(path)
    assert table.lon_deg == pytest.approx(log.lon_deg, abs=1e-9)
    assert table.lat_deg == pytest.approx(log.lat_deg, abs=1e-9)
    assert table.time_s == pytest.approx(log.time_s, abs=1e-3)
    assert len(log) == len(FLOWN.time_s) - (4 if name == "GPS" else 0)
    assert (table.altitude_m, table.altitude_of) == (pytest.approx(log.altitude_m), "geoid")
    assert table.yaw_deg is None  # 0 of a receiver and 65535 of MAVLink are unknown
    if name == "GLOBAL_POSITION_INT":
        assert table.height_m == pytest.approx(FLOWN.height_m)


# ROS, by rosbags-convert


class _Cdr:
    """Numbers out of a message as ROS 2 serializes it: little-endian, each at a multiple of its size."""

    def __init__(self, data: bytes) -> None:
        assert data[:4] == b"\0\1\0\0"
        self.data, self.at = data[4:], 0

    def take(self, kind: str) -> float:
        size = struct.calcsize(kind)
        self.at += -self.at % size
        (value,) = struct.unpack_from(f"<{kind}", self.data, self.at)
        self.at += size
        return float(value)

    def header_s(self) -> float:
        seconds, nanoseconds = self.take("i"), self.take("I")
        self.at += int(self.take("I"))  # the name of a frame
        return seconds + nanoseconds / 1e9


def test_a_flight_of_ros_is_what_plain_bytes_of_rosbags_convert_say(tmp_path: Path) -> None:
    pytest.importorskip("rosbags", reason="needs the extra [logs]")
    first = bag(tmp_path / "a.bag", mavros_messages(FLOWN))
    folder = tmp_path / "again"
    ran(TOOLS / "rosbags-convert", "--src", first, "--dst", folder, "--dst-storage", "sqlite3",
        "--dst-typestore", "ros2_humble")  # fmt: skip
    with closing(sqlite3.connect(next(folder.glob("*.db3")))) as file:
        query = "SELECT name, timestamp, data FROM messages JOIN topics ON topics.id = topic_id ORDER BY timestamp"
        messages = file.execute(query).fetchall()
    fixes, heights, turns = [], [], []
    for name, recorded_ns, data in messages:
        one = _Cdr(data)
        if name.endswith("raw/fix"):
            time_s, status, _ = one.header_s(), one.take("b"), one.take("H")
            lat, lon, alt = (one.take("d") for _ in range(3))
            fixes.append((time_s, status, lat, lon, alt, one.take("d")))
        elif name.endswith("rel_alt"):
            heights.append((recorded_ns / 1e9, one.take("d")))
        elif name.endswith("imu/data"):
            turns.append((one.header_s(), *(one.take("d") for _ in range(4))))
    time_s, status, lat, lon, alt, variance_m2 = np.array(fixes).T
    _, x, y, z, w = np.array(turns).T
    east_deg = np.degrees(np.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z)))  # counter-clockwise from east
    assert (status == 0).all()
    for log in (read_log(first), read_log(folder)):
        assert log.lat_deg.tolist() == lat.tolist()
        assert log.lon_deg.tolist() == lon.tolist()
        assert log.time_s == pytest.approx(time_s - time_s[0], abs=1e-6)
        assert log.start_s == pytest.approx(time_s[0], abs=1e-6)
        assert (log.altitude_m, log.altitude_of) == (pytest.approx(alt), "ellipsoid")
        assert log.height_m == pytest.approx(np.array(heights)[:, 1])
        assert wrapped(log.yaw_deg - (90 - east_deg)) == pytest.approx(0, abs=1e-6)
        assert f"accuracy {np.sqrt(np.median(variance_m2)):.1f} m (median)" in log.notes[0]


# Subtitles, by exiftool

SAID = "F/2.8, SS 206.14, ISO 150, EV 0, GPS ({:.4f}, {:.4f}, 10), D 2.80m, H {:.2f}m, H.S 3.00m/s, V.S 4.00m/s"


def test_subtitles_are_what_exiftool_reads_of_the_video_that_holds_them(tmp_path: Path) -> None:
    tools = [shutil.which(name) for name in ("ffmpeg", "exiftool")]
    if None in tools:
        pytest.skip("needs ffmpeg and exiftool")
    ffmpeg, exiftool = tools
    said = [SAID.format(-82.6669 + at * 1e-4, 27.7713 - at * 1e-4, at - 1.2) for at in range(5)]
    blocks = [f"{at + 1}\n00:00:0{at},000 --> 00:00:0{at + 1},000\n{text}\n" for at, text in enumerate(said)]
    subtitles = tmp_path / "a.srt"
    subtitles.write_text("\n".join(blocks))
    video = ["-f", "lavfi", "-i", "color=size=32x32:rate=1:duration=5", "-i", subtitles, "-c:s", "mov_text"]
    ran(ffmpeg, "-loglevel", "error", *video, "-map", "0:v", "-map", "1", tmp_path / "a.mp4")
    # exiftool looks for places in tracks of texts alone, as drones have them
    data = (tmp_path / "a.mp4").read_bytes().replace(b"sbtl", b"text")
    path = write(tmp_path / "b.mp4", data)
    print_each = "$SampleTime $GPSLongitude $GPSLatitude $GPSAltitude"
    lines = ran(exiftool, "-q", "-q", "-ee", "-n", "-m", "-f", "-p", print_each, path).splitlines()
    rows = np.array([list(map(float, line.split())) for line in lines if "-" not in line.split()])
    found = read_srt(subtitles).log
    assert len(rows) == len(found) == 5
    for column, expected in zip((found.time_s, found.lon_deg, found.lat_deg, found.height_m), rows.T, strict=True):
        assert column == pytest.approx(expected, abs=1e-9)
