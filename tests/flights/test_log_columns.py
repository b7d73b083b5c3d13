# SPDX-License-Identifier: Apache-2.0
"""Columns of tables of flights that tell what others mean: hemispheres, parts of a second, receivers, heads."""

from collections.abc import Callable
from pathlib import Path

import pytest

from sasgeo_bench.core.errors import FlightError
from sasgeo_bench.flights.log_points import FlightLog
from sasgeo_bench.flights.logs import read_log

Row = Callable[[float, float, int], str]


def _e7(value: float) -> int:
    return round(value * 1e7)


def _read(folder: Path, head: str, row: Row) -> FlightLog:
    """A flight due east at 5 m/s, six lines, one a second."""
    lines = [row(49.005, round(11.001 + at * 6.838e-5, 7), at) for at in range(6)]
    path = folder / "log.csv"
    path.write_text("\n".join([head, *lines, ""]), encoding="utf-8")
    return read_log(path)


def _check(log: FlightLog) -> None:
    assert log.time_s == pytest.approx([0, 1, 2, 3, 4, 5])
    assert log.lat_deg == pytest.approx(49.005, abs=1e-9)


@pytest.mark.parametrize(
    ("head", "row", "sign"),
    [
        ("t_s,LATITUDE,N/S,LONGITUDE,E/W", lambda y, x, s: f"{s},{y},S,{x},W", -1),
        ("t_s,lat,ns,lon,ew", lambda y, x, s: f"{s},{y},s,{x}, w", -1),
        ("t_s,lat,lon,latitude_hemisphere,longitude_hemisphere", lambda y, x, s: f"{s},{y},{x},South,West", -1),
        ("t_s,lat,lon,gps.lat_ref,gps.lon_ref", lambda y, x, s: f"{s},{-y},{-x},S,W", -1),
        ("t_s,lat,N/S,lon,E/W", lambda y, x, s: f"{s},{y},N,{x},E", 1),
        ("t_s,lat,lon,ns", lambda y, x, s: f"{s},{y},{x},15", 1),  # satellites
    ],
)
def test_a_column_of_hemispheres_gives_the_sign(tmp_path: Path, head: str, row: Row, sign: int) -> None:
    log = _read(tmp_path, head, row)
    assert log.lat_deg[0] == pytest.approx(sign * 49.005, abs=1e-9)
    assert log.lon_deg[0] == pytest.approx(sign * 11.001, abs=1e-9)


@pytest.mark.parametrize(
    ("head", "row", "match"),
    [
        ("t_s,lat,side,lon", lambda y, x, s: f"{s},{y},S,{x}", "line 2: 'S' beside latitude: name its column"),
        ("t_s,lat,lon,what", lambda y, x, s: f"{s},{y},{x},W", "line 2: 'W' beside longitude: name its column"),
        ("t_s,lat,lon,lat_hemi", lambda y, x, s: f"{s},{y},{x},-1", "column 'lat_hemi' is '-1', not N or S"),
        ("t_s,lat,N/S,lon", lambda y, x, s: f"{s},{-y},N,{x}", "latitude is negative, column 'N/S' is 'N'"),
        ("time_s,ms,lat,lon", lambda y, x, s: f"{s},{s * 900},{y},{x}", "column 'ms' is no part of a second"),
    ],
)
def test_a_column_beside_that_contradicts_is_refused(tmp_path: Path, head: str, row: Row, match: str) -> None:
    with pytest.raises(FlightError, match=match):
        _read(tmp_path, head, row)


@pytest.mark.parametrize(
    ("head", "digits"),
    [
        ("header.stamp.sec,header.stamp.nanosec", 9),
        ("secs,nsecs", 9),
        ("stamp.secs,stamp.nsecs", 9),
        ("time_s,ms", 3),
        ("time_s,time_us", 6),
        ("timestamp_sec,timestamp_nanosec", 9),
    ],
)
def test_parts_of_a_second_are_added(tmp_path: Path, head: str, digits: int) -> None:
    def row(y: float, x: float, s: int) -> str:
        return f"{1715940000 + s * 9 // 10},{s * 9 % 10 * 10 ** (digits - 1)},{y},{x}"

    log = _read(tmp_path, f"{head},lat,lon", row)
    assert log.time_s == pytest.approx([0, 0.9, 1.8, 2.7, 3.6, 4.5], abs=1e-6)
    # With their own part, or as clocks.
    log = _read(tmp_path, "time_s,ms,lat,lon", lambda y, x, s: f"{s * 0.9:.1f},{s * 900 % 1000},{y},{x}")
    assert log.time_s == pytest.approx([0, 0.9, 1.8, 2.7, 3.6, 4.5], abs=1e-6)
    log = _read(tmp_path, "time,ms,lat,lon", lambda y, x, s: f"10:00:0{s * 9 // 10},{s * 900 % 1000},{y},{x}")
    assert log.time_s == pytest.approx([0, 0.9, 1.8, 2.7, 3.6, 4.5], abs=1e-6)


@pytest.mark.parametrize("name", ["instance", "device_id", "sysid", "antenna", "uav", "Sensor ID", "id"])
def test_the_first_of_several_receivers_is_read(tmp_path: Path, name: str) -> None:
    def row(y: float, x: float, s: int) -> str:
        return f"{s},7,{y},{x}\n{s}.1,8,{y + 2e-5},{x}"

    with pytest.warns(UserWarning, match=f"left out 6 points of other receivers than {name} = 7"):
        log = _read(tmp_path, f"time_s,{name},lat,lon", row)
    _check(log)
    _check(_read(tmp_path, f"time_s,{name},lat,lon", lambda y, x, s: f"{s},7,{y},{x}"))
    _check(_read(tmp_path, "time_s,id,lat,lon", lambda y, x, s: f"{s},{s},{y},{x}"))  # numbers lines


@pytest.mark.parametrize("head", ["TimeUS,Lat,Lng,RelHomeAlt,Yaw", "TimeUS,GPS.Lat,GPS.Lng,POS.RelHomeAlt,ATT.Yaw"])
def test_a_heading_of_0_is_north_but_in_the_message_of_gps(tmp_path: Path, head: str) -> None:
    log = _read(tmp_path, head, lambda y, x, s: f"{s * 1000000},{_e7(y)},{_e7(x)},80,0")
    _check(log)
    assert log.height_m == pytest.approx(80)
    assert log.yaw_deg == pytest.approx(0)


@pytest.mark.parametrize("topic", ["gimbal", "a.Camera", "MNT", "cam1"])
def test_angles_of_what_turns_by_itself_are_none_of_the_body(tmp_path: Path, topic: str) -> None:
    head = f"time_s,drone.lat,drone.lon,drone.yaw_deg,{topic}.yaw_deg,{topic}.pitch_deg,{topic}.roll_deg"
    log = _read(tmp_path, head, lambda y, x, s: f"{s},{y},{x},90,45,-90,1")
    assert log.yaw_deg == pytest.approx(90)
    assert (log.pitch_deg, log.roll_deg) == (None, None)
    log = _read(tmp_path, head.replace("drone.yaw", "none.x"), lambda y, x, s: f"{s},{y},{x},90,45,-90,1")
    assert log.yaw_deg is None


def test_a_comment_above_the_numbers_is_the_head(tmp_path: Path) -> None:
    log = _read(tmp_path, "# made by numpy\n# time_s,lat,lon,height_m", lambda y, x, s: f"{s},{y},{x},80")
    _check(log)
    assert log.height_m == pytest.approx(80)
    log = _read(tmp_path, "# a,b,c,d\ntime_s,lat,lon,height_m", lambda y, x, s: f"{s},{y},{x},80")
    _check(log)
    assert log.height_m == pytest.approx(80)
