# SPDX-License-Identifier: Apache-2.0
"""Telemetry logs: one vehicle of several, the autopilot's clock, and damaged logs."""

from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from sasgeo_bench.core.errors import FlightError
from sasgeo_bench.flights.log_units import LogFacts
from sasgeo_bench.flights.logs import read_log
from tests.flights.autopilots import BOOT_S, GROUND_M, START_S, Flown, stamps_us, tlog, write, wrong_of_damaged

common = pytest.importorskip("pymavlink.dialects.v20.common", reason="needs the extra [logs]")

FLOWN = Flown()


@pytest.mark.parametrize("is_v1", [False, True], ids=["v2", "v1"])
def test_a_telemetry_log_is_the_flight_by_the_clock_of_the_autopilot(tmp_path: Path, *, is_v1: bool) -> None:
    log = read_log(write(tmp_path / "a.tlog", tlog(FLOWN, is_v1=is_v1)))
    assert log.lon_deg == pytest.approx(FLOWN.lon_deg, abs=1e-9)
    assert log.lat_deg == pytest.approx(FLOWN.lat_deg, abs=1e-9)
    assert log.time_s == pytest.approx(FLOWN.time_s, abs=1e-6)  # though every message came late
    assert log.start_s == pytest.approx(START_S, abs=2e-3)
    assert log.height_m == pytest.approx(FLOWN.height_m, abs=1e-3)
    assert (log.altitude_m, log.altitude_of) == (pytest.approx(GROUND_M + FLOWN.height_m), "geoid")
    assert (log.yaw_deg - FLOWN.yaw_deg + 180) % 360 - 180 == pytest.approx(0, abs=1e-3)
    accuracy = "" if is_v1 else ", accuracy 1.2 m (median)"  # an extension of MAVLink 2
    assert log.notes == (
        f"place: GPS_RAW_INT, fixes, 5 Hz{accuracy}",
        "altitude: above the geoid (the sea)",
        "height: GLOBAL_POSITION_INT.relative_alt, above take-off",
        "attitude: ATTITUDE, yaw from true north",
        "clock: UTC by time_unix_usec of SYSTEM_TIME",
        "not read: GLOBAL_POSITION_INT",
        "vehicle 1, component 1",
    )


def test_of_several_vehicles_one_is_chosen(tmp_path: Path) -> None:
    path = write(tmp_path / "a.tlog", tlog(FLOWN, systems=(7, 3)))
    with pytest.raises(FlightError, match=r"a\.tlog: vehicles 3, 7 send places: say which one, as in --vehicle 3"):
        read_log(path)
    assert read_log(path, LogFacts(vehicle=7)).notes[-1] == "vehicle 7, component 1"
    with pytest.raises(FlightError, match="vehicle 255 sends no places, 3, 7 do: say --vehicle 3"):
        read_log(path, LogFacts(vehicle=255))  # the ground station
    with pytest.raises(FlightError, match=r"a\.csv is no telemetry log: leave out --vehicle"):
        read_log(tmp_path / "a.csv", LogFacts(vehicle=7))


def _messages(*each: tuple[float, object], system: int = 1) -> bytes:
    """Messages and when they were received, in seconds since the start of the flight."""
    link = common.MAVLink(None, srcSystem=system, srcComponent=1)
    stamps = [round((START_S + at) * 1e6).to_bytes(8, "big") for at, _ in each]
    return b"".join(stamp + bytes(one.pack(link)) for stamp, (_, one) in zip(stamps, each, strict=True))


def _gps(stamp_us: int, at: int, *, fix_type: int = 3) -> object:
    lat = round(float(FLOWN.lat_deg[at]) * 1e7)
    return common.MAVLink_gps_raw_int_message(stamp_us, fix_type, lat, 95200000, 500_000, 1, 1, 0, 0, 9)


def test_fixes_that_count_from_1970_come_onto_the_clock_of_the_autopilot(tmp_path: Path) -> None:
    # ... whose attitudes are half a second away where they are taken for 1970's
    each = []
    for at in range(20):
        time_s = at * 0.2
        yaw = common.MAVLink_attitude_message(round((BOOT_S + time_s) * 1e3), 0.0, 0.0, at * 0.1, 0.0, 0.0, 0.0)
        each += [(time_s, _gps(round((START_S + time_s) * 1e6), at)), (time_s, yaw)]
    log = read_log(write(tmp_path / "a.tlog", _messages(*each)))
    assert log.time_s == pytest.approx(FLOWN.time_s[:20], abs=1e-5)
    assert log.yaw_deg == pytest.approx(np.degrees(np.arange(20) * 0.1), abs=0.01)
    assert log.start_s == pytest.approx(START_S, abs=1e-3)
    assert "clock: UTC by the ground station, as it received messages" in log.notes


def test_a_fix_in_two_dimensions_is_no_place(tmp_path: Path) -> None:
    each = [(at * 0.2, _gps(round((BOOT_S + at * 0.2) * 1e6), at, fix_type=2 + (at > 4))) for at in range(20)]
    with pytest.warns(UserWarning, match="left out 5 points without a fix"):
        log = read_log(write(tmp_path / "a.tlog", _messages(*each)))
    assert log.lat_deg[0] == pytest.approx(FLOWN.lat_deg[5], abs=1e-9)
    assert (log.height_m, log.yaw_deg, log.start_s) == (None, None, None)


def test_a_heading_of_65535_is_none(tmp_path: Path) -> None:
    log = read_log(write(tmp_path / "a.tlog", tlog(FLOWN)))  # GLOBAL_POSITION_INT.hdg is 65535 throughout
    assert log.yaw_deg.max() < 360


@pytest.mark.filterwarnings("ignore:a.tlog. left out 1 point without a value of")  # the last, before its attitude
def test_a_log_that_was_cut_off_or_damaged_is_read_for_the_rest(tmp_path: Path) -> None:
    whole = tlog(FLOWN)
    log = read_log(write(tmp_path / "a.tlog", whole[: len(whole) * 2 // 3 + 5]))
    assert 120 < len(log) < 140
    assert log.notes[-1] == "cut off: the file ends within a message, and is read up to there"
    log = read_log(write(tmp_path / "b.tlog", whole[:20_000] + bytes(range(200)) + whole[20_000:]))
    assert 195 < len(log) <= 200
    assert log.notes[-1].startswith("damaged: ")
    flipped = bytearray(whole)
    stamp_us = stamps_us(FLOWN.time_s)[50]
    flipped[whole.index(stamp_us.to_bytes(8, "little"))] ^= 0xFF
    log = read_log(write(tmp_path / "c.tlog", bytes(flipped)))
    assert log.notes[-1] == "damaged: 1 messages and 0 bytes beside that are passed over"


@pytest.mark.parametrize("data", [b"PK" * 99, bytes(99), (0).to_bytes(8, "big") + b"\xfd"])
def test_a_file_that_is_no_log_is_refused_in_one_line(tmp_path: Path, data: bytes) -> None:
    with pytest.raises(FlightError, match=r"a\.tlog: no place: no message of GPS_RAW_INT or GLOBAL_POSITION_INT"):
        read_log(write(tmp_path / "a.tlog", data))


def test_an_autopilot_that_restarted_is_refused(tmp_path: Path) -> None:
    one = tlog(FLOWN)
    with pytest.raises(FlightError, match=r"the clock of GPS_RAW_INT jumps back by 39\.8 s: the autopilot restarted"):
        read_log(write(tmp_path / "a.tlog", one + one))


@settings(deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(seed=st.integers(0, 2**32 - 1), part=st.floats(0, 1))
def test_bytes_that_changed_are_read_or_refused(tmp_path: Path, seed: int, part: float) -> None:
    assert wrong_of_damaged(tmp_path / "a.tlog", tlog(Flown(count=20)), seed=seed, part=part) == []
