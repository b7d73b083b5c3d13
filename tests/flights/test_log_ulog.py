# SPDX-License-Identifier: Apache-2.0
"""Logs of PX4: each topic by its version, one instance of it, the clock, and what a file that is damaged gives."""

import os
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from sasgeo_bench.core.errors import FlightError
from sasgeo_bench.flights.log_points import FlightLog
from sasgeo_bench.flights.logs import read_log
from tests.flights import autopilots
from tests.flights.autopilots import (
    BOOT_S,
    GROUND_M,
    START_S,
    Flown,
    gps_rows,
    px4_topics,
    ulog,
    write,
    wrong_of_damaged,
)

pyulog = pytest.importorskip("pyulog", reason="needs the extra [logs]")

# Data that are no part of the repository lie beside the extracts.
SAMPLES = [
    Path(one).resolve().parent / "flights" / "sample_log_small.ulg"
    for one in os.environ.get("SASGEO_EXTRACTS", "").split(os.pathsep)
    if one
]
SAMPLE = next((one for one in SAMPLES if one.is_file()), None)
FLOWN = Flown()
RECEIVER = ("vehicle_gps_position", 0)


def check_flown(log: FlightLog, flown: Flown = FLOWN) -> None:
    """The log is the flight, by all that a receiver and an estimator say."""
    assert log.lon_deg == pytest.approx(flown.lon_deg, abs=1e-9)
    assert log.lat_deg == pytest.approx(flown.lat_deg, abs=1e-9)
    assert log.time_s == pytest.approx(flown.time_s, abs=1e-5)
    assert log.start_s == pytest.approx(START_S, abs=1e-3)
    assert log.height_m == pytest.approx(flown.height_m, abs=0.11)  # at its top between two steps of the estimate
    assert log.altitude_m == pytest.approx(GROUND_M + flown.height_m, abs=1e-3)
    assert log.altitude_of == "geoid"
    turned = (log.yaw_deg - flown.yaw_deg + 180) % 360 - 180
    assert turned == pytest.approx(0, abs=0.02)
    assert log.pitch_deg == pytest.approx(0, abs=1e-4)


@pytest.mark.parametrize("is_new", [True, False], ids=["1.14", "1.13"])
def test_a_ulog_of_either_age_is_the_flight(tmp_path: Path, *, is_new: bool) -> None:
    log = read_log(write(tmp_path / "a.ulg", ulog(px4_topics(FLOWN, is_new=is_new))))
    check_flown(log)
    assert log.notes[:4] == (
        "place: vehicle_gps_position 0, fixes, 5 Hz, accuracy 1.2 m (median)",
        "altitude: above the geoid (the sea)",
        "height: vehicle_local_position 0 less home_position 0, above take-off",
        "attitude: vehicle_attitude 0, yaw from true north",
    )
    assert log.notes[4:] == ("clock: UTC by time_utc_usec of vehicle_gps_position 0",)


def test_the_first_receiver_with_fixes_is_read_and_the_others_are_named(tmp_path: Path) -> None:
    topics = px4_topics(FLOWN)
    fields, rows = topics.pop(RECEIVER)
    blind = [(*row[:-1], 2) for row in rows]  # a fix in two dimensions has no place
    topics |= {("sensor_gps", 2): (fields, rows), ("sensor_gps", 0): (fields, blind), ("sensor_gps", 1): (fields, rows)}
    log = read_log(write(tmp_path / "a.ulg", ulog(topics)))
    check_flown(log)
    assert log.notes[0].startswith("place: sensor_gps 1, fixes")
    assert "not read: sensor_gps 2" in log.notes


def test_messages_without_a_fix_are_no_places_and_are_counted(tmp_path: Path) -> None:
    topics = px4_topics(FLOWN)
    _, rows = topics[RECEIVER]
    rows[:3] = [(*row[:2], 0.0, 0.0, 0.0, 0.0, *row[6:-1], 3) for row in rows[:3]]  # 0, 0 is none either
    rows[3:5] = [(*row[:-1], 1) for row in rows[3:5]]
    with pytest.warns(UserWarning, match=r"a\.ulg: left out 5 points without a fix"):
        log = read_log(write(tmp_path / "a.ulg", ulog(topics)))
    assert log.lat_deg[0] == FLOWN.lat_deg[5]
    assert log.start_s == pytest.approx(START_S + 1.0, abs=1e-3)


def test_an_estimate_is_a_place_only_where_no_receiver_is_logged_and_is_named(tmp_path: Path) -> None:
    topics = px4_topics(FLOWN)
    rows = [(row[0], row[2], row[3], row[4]) for row in topics.pop(RECEIVER)[1]]
    topics["vehicle_global_position", 0] = ("uint64_t timestamp;double lat;double lon;float alt;", rows)
    log = read_log(write(tmp_path / "a.ulg", ulog(topics)))
    assert log.lat_deg == pytest.approx(FLOWN.lat_deg, abs=1e-9)
    assert log.start_s is None
    assert "an estimate that fused the receiver" in log.notes[0]
    assert "clock: seconds of the log's own, UTC is not known" in log.notes
    topics["sensor_gps", 0] = (autopilots.GPS_114, gps_rows(FLOWN, fix_type=0))
    assert read_log(write(tmp_path / "b.ulg", ulog(topics))).notes[0].startswith("place: vehicle_global_position 0")


def matrix_of(yaw_deg: float, pitch_deg: float, roll_deg: float) -> np.ndarray:
    """Body (forward, right, down) to north, east, down: about down, then the new right, then the new front."""
    (a, b, c), (d, e, f) = (func(np.radians([yaw_deg, pitch_deg, roll_deg])) for func in (np.cos, np.sin))
    yaw = np.array([[a, -d, 0], [d, a, 0], [0, 0, 1]])
    pitch = np.array([[b, 0, e], [0, 1, 0], [-e, 0, b]])
    roll = np.array([[1, 0, 0], [0, c, -f], [0, f, c]])
    return yaw @ pitch @ roll


def quaternion_of(matrix: np.ndarray) -> tuple[float, ...]:
    """w, x, y, z of a rotation that turns by less than half a turn."""
    w = np.sqrt(1 + np.trace(matrix)) / 2
    parts = matrix[[2, 0, 1], [1, 2, 0]] - matrix[[1, 2, 0], [2, 0, 1]]
    return float(w), *(parts / (4 * w)).tolist()


def test_attitudes_are_read_through_three_different_angles(tmp_path: Path) -> None:
    topics = px4_topics(FLOWN)
    fields, rows = topics["vehicle_attitude", 0]
    turned = quaternion_of(matrix_of(30, 10, -20))
    topics["vehicle_attitude", 0] = (fields, [(row[0], *turned) for row in rows])
    log = read_log(write(tmp_path / "a.ulg", ulog(topics)))
    for angles_deg, expected in ((log.yaw_deg, 30), (log.pitch_deg, 10), (log.roll_deg, -20)):
        assert angles_deg == pytest.approx(expected, abs=1e-4)


def test_a_home_that_is_set_again_is_what_heights_count_from(tmp_path: Path) -> None:
    topics = px4_topics(FLOWN)
    fields, rows = topics["home_position", 0]
    middle_us = round((BOOT_S + 20) * 1e6)
    topics["home_position", 0] = (fields, [*rows, (middle_us, 0.0, 0.0, 0.0, 0.0, 0.0, -12.0, 0.0)])
    log = read_log(write(tmp_path / "a.ulg", ulog(topics)))
    lower = FLOWN.height_m - np.where(FLOWN.time_s >= 20, 10, 0)
    assert log.height_m == pytest.approx(lower, abs=0.11)


def test_without_a_home_heights_count_from_where_it_took_off(tmp_path: Path) -> None:
    topics = px4_topics(FLOWN)
    del topics["home_position", 0]
    log = read_log(write(tmp_path / "a.ulg", ulog(topics)))
    assert log.height_m is None
    assert any(line.startswith("no height: neither home_position nor a take-off") for line in log.notes)
    rows = [(0, True), (round(BOOT_S * 1e6), False)]
    topics["vehicle_land_detected", 0] = ("uint64_t timestamp;bool landed;", rows)
    check_flown(read_log(write(tmp_path / "b.ulg", ulog(topics))))


def test_a_log_that_was_cut_off_is_read_up_to_the_cut(tmp_path: Path) -> None:
    whole = ulog(px4_topics(FLOWN))
    log = read_log(write(tmp_path / "a.ulg", whole[: len(whole) * 2 // 3]))
    assert 100 < len(log) < 150
    assert log.lat_deg == pytest.approx(FLOWN.lat_deg[: len(log)], abs=1e-9)
    assert "cut off: the file ends within a message, and is read up to there" in log.notes
    assert not any("cut off" in line for line in read_log(write(tmp_path / "b.ulg", whole)).notes)


def test_dropouts_are_told_by_their_lengths(tmp_path: Path) -> None:
    # pyulog gives them the time of the last topic that was kept, so their times are no part of it
    data = ulog(px4_topics(FLOWN), dropouts=[(14_000_000, 250), (15_000_000, 1_200)])
    log = read_log(write(tmp_path / "a.ulg", data))
    assert log.notes[-1] == "dropouts: 2, 1.4 s in all, the longest 1.2 s, in which nothing was logged"


def test_a_receiver_whose_utc_jumps_is_told_and_one_that_goes_back_is_refused(tmp_path: Path) -> None:
    topics = px4_topics(FLOWN)
    fields, rows = topics[RECEIVER]
    leap = [(row[0], row[1] + 18_000_000 * (at < 20), *row[2:]) for at, row in enumerate(rows)]
    log = read_log(write(tmp_path / "a.ulg", ulog(topics | {RECEIVER: (fields, leap)})))
    assert log.start_s == pytest.approx(START_S, abs=1e-3)  # by the median
    assert any("part by 18.0 s on the way" in line for line in log.notes)
    again = [(row[0] - 10_000_000 * (at > 100), *row[1:]) for at, row in enumerate(rows)]
    data = bytearray(ulog(topics | {RECEIVER: (fields, [])}))
    data += b"".join(_data(0, row) for row in again)
    with pytest.raises(FlightError, match=r"a\.ulg: the clock of vehicle_gps_position 0 jumps back by 9\.8 s"):
        read_log(write(tmp_path / "a.ulg", bytes(data)))


def _data(number: int, row: tuple) -> bytes:
    lone = ulog({("x", 0): (autopilots.GPS_114, [row])})
    length = 3 + 2 + 8 * 6 + 4 + 1
    return lone[-length : -length + 3] + number.to_bytes(2, "little") + lone[-length + 5 :]


def test_a_flight_that_never_leaves_the_ground_is_told(tmp_path: Path) -> None:
    topics = px4_topics(FLOWN)
    fields, rows = topics["vehicle_local_position", 0]
    low = [(*row[:3], -2.0 - 0.01 * at % 3, *row[4:]) for at, row in enumerate(rows)]
    log = read_log(write(tmp_path / "a.ulg", ulog(topics | {("vehicle_local_position", 0): (fields, low)})))
    assert any(line.startswith("the drone stays on the ground: never higher than 3.0 m") for line in log.notes)


@pytest.mark.parametrize(
    ("data", "match"),
    [
        (b"", "empty: copy it anew"),
        (b"ULog\x01\x12\x35\x01" + bytes(8), "no place: no message of vehicle_gps_position, sensor_gps or vehicle_gl"),
        (b"PK" * 99, "cannot be read as such a log"),
        (ulog({RECEIVER: (autopilots.GPS_114, gps_rows(FLOWN, fix_type=2))}), "no place: 200 messages without a fix"),
        (
            ulog({RECEIVER: (autopilots.GPS_114, gps_rows(FLOWN, fix_type=2))})[:-5],
            r"without a fix: .* \(cut off: the file",
        ),
        (ulog({RECEIVER: (autopilots.GPS_114, gps_rows(FLOWN)[:1])}), "a flight needs two fixes of a receiver"),
        (ulog({RECEIVER: ("uint64_t timestamp;double lat;", [(1, 2.0), (2, 3.0)])}), "no field 'lon', so its vers"),
    ],
)
def test_a_file_that_is_no_flight_is_refused_in_one_line(tmp_path: Path, data: bytes, match: str) -> None:
    with pytest.raises(FlightError, match=match) as fault:
        read_log(write(tmp_path / "a.ulg", data))
    assert str(fault.value).isprintable()


@settings(deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(seed=st.integers(0, 2**32 - 1), part=st.floats(0, 1))
def test_bytes_that_changed_are_read_or_refused(tmp_path: Path, seed: int, part: float) -> None:
    assert wrong_of_damaged(tmp_path / "a.ulg", ulog(px4_topics(Flown(count=20))), seed=seed, part=part) == []


@pytest.mark.real
@pytest.mark.skipif(SAMPLE is None, reason="a real log of PX4: no folder flights beside that of SASGEO_EXTRACTS")
def test_a_real_ulog_is_what_ulog2csv_of_the_library_writes(tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    from pyulog.ulog2csv import convert_ulog2csv  # noqa: PLC0415 - only where it is installed

    log = read_log(SAMPLE)
    convert_ulog2csv(
        str(SAMPLE), "vehicle_gps_position,vehicle_attitude,vehicle_local_position", str(tmp_path), ",", 0, 0
    )
    capsys.readouterr()
    table = pd.read_csv(tmp_path / "sample_log_small_vehicle_gps_position_0.csv")
    assert len(log) == len(table) == 32
    assert log.lat_deg == pytest.approx(table["lat"] / 1e7, abs=1e-12)
    assert log.lon_deg == pytest.approx(table["lon"] / 1e7, abs=1e-12)
    assert log.altitude_m == pytest.approx(table["alt"] / 1e3)
    assert log.time_s == pytest.approx((table["timestamp"] - table["timestamp"][0]) / 1e6)
    assert log.start_s == pytest.approx(table["time_utc_usec"][0] / 1e6, abs=0.05)
    turns = pd.read_csv(tmp_path / "sample_log_small_vehicle_attitude_0.csv")
    w, x, y, z = (turns[f"q[{at}]"] for at in range(4))
    yaw_deg = np.degrees(np.unwrap(np.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))))
    assert log.yaw_deg == pytest.approx(np.interp(table["timestamp"], turns["timestamp"], yaw_deg) % 360, abs=0.01)
    local = pd.read_csv(tmp_path / "sample_log_small_vehicle_local_position_0.csv")
    rise_m = -np.interp(table["timestamp"], local["timestamp"], local["z"])
    assert np.diff(log.height_m) == pytest.approx(np.diff(rise_m), abs=1e-5)
