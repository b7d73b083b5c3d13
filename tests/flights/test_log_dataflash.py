# SPDX-License-Identifier: Apache-2.0
"""Logs of ArduPilot: receivers by their number, leap seconds by date, and damaged logs."""

import warnings
from pathlib import Path

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from sasgeo_bench.core.errors import FlightError
from sasgeo_bench.flights.logs import read_log
from tests.flights.autopilots import (
    GROUND_M,
    START_S,
    Flown,
    ardupilot_rows,
    dataflash,
    dataflash_text,
    write,
    wrong_of_damaged,
)

pytest.importorskip("pymavlink", reason="needs the extra [logs]")

FLOWN = Flown()


@pytest.mark.parametrize(("name", "lay"), [("a.bin", dataflash), ("a.log", dataflash_text)])
def test_a_log_of_ardupilot_is_the_flight_by_its_first_receiver_with_fixes(tmp_path, name, lay) -> None:
    with warnings.catch_warnings():  # those without a fix are of the other receiver
        warnings.simplefilter("error")
        log = read_log(write(tmp_path / name, lay(ardupilot_rows(FLOWN))))
    assert log.lon_deg == pytest.approx(FLOWN.lon_deg, abs=1e-9)
    assert log.lat_deg == pytest.approx(FLOWN.lat_deg, abs=1e-9)
    assert log.time_s == pytest.approx(FLOWN.time_s, abs=1e-6)
    assert log.start_s == pytest.approx(START_S, abs=2e-3)
    assert log.height_m == pytest.approx(FLOWN.height_m, abs=0.11)
    assert (log.altitude_m, log.altitude_of) == (pytest.approx(GROUND_M + FLOWN.height_m), "geoid")
    assert (log.yaw_deg - FLOWN.yaw_deg + 180) % 360 - 180 == pytest.approx(0, abs=0.02)
    assert log.notes == (
        "place: GPS 1, fixes, 5 Hz, accuracy 1.8 m (median)",
        "altitude: above the geoid (the sea)",
        "height: POS.RelHomeAlt, above take-off",
        "attitude: ATT, yaw from true north",
        "clock: UTC by weeks of GPS 1 less 18 leap seconds",
    )


def test_leap_seconds_are_those_of_the_day(tmp_path: Path) -> None:
    rows = ardupilot_rows(FLOWN)
    years_weeks = 11 * 52  # back into 2014, when GPS was ahead by 16 s
    rows["GPS"] = [(*row[:4], row[4] - years_weeks, *row[5:]) for row in rows["GPS"]]
    log = read_log(write(tmp_path / "a.bin", dataflash(rows)))
    assert log.start_s == pytest.approx(START_S - years_weeks * 604_800 + 2, abs=2e-3)
    assert log.notes[-1].endswith("less 16 leap seconds")


def test_a_receiver_has_no_utc_before_it_knows_its_week(tmp_path: Path) -> None:
    rows = ardupilot_rows(FLOWN)
    rows["GPS"] = [(*row[:4], row[4] if at > 40 else 0, *row[5:]) for at, row in enumerate(rows["GPS"])]
    assert read_log(write(tmp_path / "a.bin", dataflash(rows))).start_s == pytest.approx(START_S, abs=2e-3)
    rows["GPS"] = [(*row[:4], 0, *row[5:]) for row in rows["GPS"]]
    assert read_log(write(tmp_path / "b.bin", dataflash(rows))).start_s is None


def test_utc_is_that_of_the_receiver_that_is_read(tmp_path: Path) -> None:
    # the first one, which pymavlink dates the log by, counts weeks by 10 bits
    rows = ardupilot_rows(FLOWN)
    rows["GPS"] = [(*row[:4], row[4] % 1024 if row[1] == 0 else row[4], *row[5:]) for row in rows["GPS"]]
    log = read_log(write(tmp_path / "a.bin", dataflash(rows)))
    assert log.start_s == pytest.approx(START_S, abs=2e-3)


def test_a_log_of_before_2015_counts_its_own_milliseconds_beside_those_of_the_week(tmp_path: Path) -> None:
    messages = {
        "GPS": (200, "BIHBcLLeeEefI", "Status,TimeMS,Week,NSats,HDop,Lat,Lng,RelAlt,Alt,Spd,GCrs,VZ,T"),
        "ATT": (203, "IccccCC", "TimeMS,DesRoll,Roll,DesPitch,Pitch,DesYaw,Yaw"),
    }
    rows = ardupilot_rows(FLOWN)
    old = {
        "GPS": [
            (3, row[3], row[4], 9, 0.8, row[7], row[8], 0.0, row[9], 8.0, 45.0, 0.0, row[0] // 1000)
            for row in rows["GPS"]
            if row[1]
        ],
        "ATT": [(row[0] // 1000, *row[1:7]) for row in rows["ATT"]],
    }
    log = read_log(write(tmp_path / "a.bin", dataflash(old, messages)))
    assert log.lat_deg == pytest.approx(FLOWN.lat_deg, abs=1e-9)
    assert log.time_s == pytest.approx(FLOWN.time_s, abs=1e-3)
    assert log.start_s == pytest.approx(START_S, abs=2e-3)
    assert (log.yaw_deg - FLOWN.yaw_deg + 180) % 360 - 180 == pytest.approx(0, abs=0.02)


def test_angles_of_attitude_keep_their_order(tmp_path: Path) -> None:
    rows = ardupilot_rows(FLOWN)
    rows["ATT"] = [(row[0], 0.0, -20.0, 0.0, 10.0, 0.0, 30.0, 0.0, 0.0, 1) for row in rows["ATT"]]
    log = read_log(write(tmp_path / "a.bin", dataflash(rows)))
    for angles_deg, expected in ((log.yaw_deg, 30), (log.pitch_deg, 10), (log.roll_deg, -20)):
        assert angles_deg == pytest.approx(expected)


def test_a_log_without_fixes_heights_or_attitudes_says_so(tmp_path: Path) -> None:
    rows = ardupilot_rows(FLOWN)
    log = read_log(write(tmp_path / "a.bin", dataflash({"GPS": rows["GPS"]})))
    assert (log.height_m, log.yaw_deg) == (None, None)
    blind = [(*row[:2], 2, *row[3:]) for row in rows["GPS"]]
    with pytest.raises(FlightError, match=r"b\.bin: no place: 400 messages without a fix"):
        read_log(write(tmp_path / "b.bin", dataflash({"GPS": blind})))
    with pytest.raises(FlightError, match=r"c\.bin: no place: no message of GPS"):
        read_log(write(tmp_path / "c.bin", dataflash({"ATT": rows["ATT"]})))
    with pytest.raises(FlightError, match=r"d\.bin: a ULog by its first bytes, no DataFlash: rename it to \.ulg"):
        read_log(write(tmp_path / "d.bin", b"ULog\x01\x12\x35\x01" + bytes(80)))
    with pytest.raises(FlightError, match=r"e\.bin: no DataFlash by its first bytes"):
        read_log(write(tmp_path / "e.bin", bytes(range(80))))


@pytest.mark.filterwarnings("ignore:a.bin. left out 1 point without a value of")  # the last, before its attitude
@pytest.mark.parametrize("part", [0.5, 0.61, 0.73])
def test_a_log_that_was_cut_off_is_read_up_to_the_cut(tmp_path: Path, part: float) -> None:
    whole = dataflash(ardupilot_rows(FLOWN))
    log = read_log(write(tmp_path / "a.bin", whole[: round(len(whole) * part)]))
    assert len(log) == pytest.approx(200 * part, abs=6)
    assert log.lat_deg == pytest.approx(FLOWN.lat_deg[: len(log)], abs=1e-9)
    assert log.notes[-1].startswith("cut off: the file ends within a message")


def test_a_log_that_ends_in_the_rest_of_a_page_is_whole(tmp_path: Path) -> None:
    log = read_log(write(tmp_path / "a.bin", dataflash(ardupilot_rows(FLOWN)) + bytes(100)))
    assert (len(log), log.notes[-1]) == (200, "clock: UTC by weeks of GPS 1 less 18 leap seconds")


def test_bytes_between_messages_are_passed_over_and_counted(tmp_path: Path, capfd: pytest.CaptureFixture) -> None:
    whole = dataflash(ardupilot_rows(FLOWN))
    start = whole.rindex(b"\xa3\x95", 0, len(whole) // 2)
    log = read_log(write(tmp_path / "a.bin", whole[:start] + bytes(range(256)) * 8 + whole[start:]))
    assert (len(log), log.start_s) == (200, pytest.approx(START_S, abs=2e-3))
    assert log.notes[-1] == "damaged: 2048 bytes that are no message are passed over"
    assert capfd.readouterr().err == ""


def test_an_autopilot_that_restarted_is_refused(tmp_path: Path) -> None:
    rows = ardupilot_rows(FLOWN)
    whole = dataflash({"GPS": rows["GPS"]})
    with pytest.raises(FlightError, match=r"a\.bin: the clock of GPS 1 jumps back by 39\.8 s: the autopilot restarted"):
        read_log(write(tmp_path / "a.bin", whole + whole))


@pytest.mark.parametrize("data", [b"", b"\xa3\x95", b"PK" * 99, b"no log\n" * 9, bytes((0xA3, 0x95, 200)) * 50])
@pytest.mark.parametrize("name", ["a.bin", "a.log"])
def test_a_file_that_is_no_log_is_refused_in_one_line(tmp_path: Path, name: str, data: bytes, capfd) -> None:
    with pytest.raises(FlightError, match=r"a\.(bin|log): (cannot be read as such a log|no place|empty)") as fault:
        read_log(write(tmp_path / name, data))
    assert str(fault.value).isprintable()
    assert capfd.readouterr() == ("", "")  # the library prints what it meets


@settings(deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(seed=st.integers(0, 2**32 - 1), part=st.floats(0, 1))
def test_bytes_that_changed_are_read_or_refused(tmp_path: Path, seed: int, part: float) -> None:
    assert wrong_of_damaged(tmp_path / "a.bin", dataflash(ardupilot_rows(Flown(count=20))), seed=seed, part=part) == []
