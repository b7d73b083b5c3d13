# SPDX-License-Identifier: Apache-2.0
"""Tables of flight logs: units by names and formats, asked for where neither tells them, and never guessed."""

import datetime as dt
import math
import warnings
from collections.abc import Callable
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from sasgeo_bench.core.errors import FlightError
from sasgeo_bench.flights.log_formats import FORMATS, NAMES, QUANTITIES
from sasgeo_bench.flights.log_points import FlightLog, LogSource, steps_m
from sasgeo_bench.flights.log_table import Clock
from sasgeo_bench.flights.log_units import UNITS, WORDS, LogFacts
from sasgeo_bench.flights.logs import read_log

Row = Callable[[float, float, int], str]

STEP_DEG = 6.838e-5  # of longitude, 5 m at 49 degrees north
TOW_S = 433341.5  # of a week of GPS
DJI = "OSD.latitude,OSD.longitude"
QGC = "Timestamp,roll,pitch,heading,altitudeRelative,altitudeAMSL,flightTime,battery0.id,gps.lat,gps.lon,gps2.lat,"
QGC += "gps2.lon,setpoint.roll,setpoint.pitch,setpoint.yaw"
PLAIN = "time_s,lat,lon"
MAV = "time_boot_ms,lat,lon,alt,relative_alt,hdg"
PX4_GPS = "timestamp,time_utc_usec,lat,lon,alt,alt_ellipsoid,eph,heading,fix_type"
GPS = "TimeUS,I,Status,GMS,Lat,Lng,Alt,Yaw,U"
POS = "%  GPST                  latitude(deg) longitude(deg)  height(m)   Q  ns   sdn(m)"
POS_HEAD = f"% program   : RTKPOST ver.2.4.2\n% (lat/lon/height=WGS84/ellipsoidal,Q=1:fix,2:float)\n{POS}"
AIRDATA = "time(millisecond),datetime(utc),latitude,longitude,height_above_takeoff({0}),"
AIRDATA += "height_above_ground_at_drone_location({0}),altitude_above_seaLevel({0}), compass_heading(degrees)"
ROS = "%time,field.header.seq,field.header.stamp,field.status.status,field.latitude,field.longitude,field.altitude"
PHOTOS = (
    "SourceFile,DateTimeOriginal,GPSLatitude,GPSLongitude,AbsoluteAltitude,RelativeAltitude,FlightYawDegree,Latitude"
)


def _e7(value: float) -> int:
    return round(value * 1e7)


def _east(at: int) -> float:
    return round(11.001 + at * STEP_DEG, 7)


def _read(folder: Path, head: str, row: Row, *, name: str = "log.csv", count: int = 6, **facts: object) -> FlightLog:
    """A flight due east at 5 m/s, a line a second."""
    lines = [row(49.005, _east(at), at) for at in range(count)]
    path = folder / name
    path.write_text("\n".join([head, *lines, ""]), encoding="utf-8")
    return read_log(path, LogFacts(**facts))  # type: ignore[arg-type]


def _check(log: FlightLog, *, height_m: float | None = None, yaw_deg: float | None = None, count: int = 6) -> None:
    """Every log of this file is the same flight."""
    assert len(log) == count
    assert log.time_s[-1] == pytest.approx(count - 1, abs=1e-6)
    assert steps_m(log.lon_deg, log.lat_deg) == pytest.approx(5.0, abs=0.02)
    assert log.lat_deg[0] == pytest.approx(49.005, abs=1e-9)
    for values, expected in ((log.height_m, height_m), (log.yaw_deg, yaw_deg)):
        assert (values is None) == (expected is None)
        assert values is None or values == pytest.approx(expected, abs=1e-3)


@pytest.mark.parametrize(
    ("head", "row", "height_m", "yaw_deg"),
    [
        # DJI; other topics have places, too.
        (f"OSD.flyTime [s],{DJI},OSD.height [ft],OSD.yaw", lambda y, x, s: f"{s}.0,{y},{x},328.084,90", 100, 90),
        (f"OSD.flyTime [s],{DJI},OSD.height [m],OSD.yaw [360]", lambda y, x, s: f"{s}.0,{y},{x},30,180", 30, 180),
        (f"OSD.flyTime [s],{DJI},OSD.height [m],", lambda y, x, s: f"{s},{y},{x},0.3,", 0.3, None),
        (f"sep=,\nCUSTOM.updateTime,{DJI},HOME.latitude,HOME.longitude,GIMBAL.yaw,OSD.yaw,OSD.yaw [360]", lambda y, x,
         s: f"2018/07/04 11:19:{s:02d}.123,{y},{x},49,11,5,-90.5,269.5", None, 269.5),
        (f"OSD.flyTime,{DJI}", lambda y, x, s: f"1m {s}.5s,{y},{x}", None, None),
        # MAVLink: integers, by whatever program.
        (MAV, lambda y, x, s: f"{s * 1000},{_e7(y)},{_e7(x)},512000,8000,250", 8, 2.5),
        (MAV, lambda y, x, s: f"{s * 1000},{_e7(y)}.0,{_e7(x)}.0,512000.0,80000.0,9000.0", 80, 90),
        ("timestamp," + ",".join(f"GLOBAL_POSITION_INT.{name}" for name in MAV.split(",")), lambda y, x,
         s: f"{1.7e9 + s:.8f},{s * 1000},{_e7(y)},{_e7(x)},512000,-1500,35999", -1.5, 359.99),
        # PX4: integers or degrees, microseconds, radians.
        (PX4_GPS, lambda y, x, s: f"{s}000007,17,{_e7(y)},{_e7(x)},512000,560000,1,1.5707963,3", None, 90),
        ("timestamp,lat,lon,alt,heading", lambda y, x, s: f"{s}000007,{_e7(y)},{_e7(x)},512000,0.5", None, 28.6479),
        ("timestamp,lat,lon,alt,eph,terrain_alt", lambda y, x, s: f"{s}000007,{y},{x},512,1,nan", None, None),
        ("timestamp,latitude_deg,longitude_deg,altitude_msl_m,heading", lambda y, x,
         s: f"{s}000007,{y},{x},512.3,-0.5", None, -28.6479),
        # ArduPilot: Yaw 0 is none; degrees of mavlogdump, integers of others.
        (GPS, lambda y, x, s: f"{s}000000,0,3,7,{y},{x},512.3,90.5,1", None, 90.5),
        ("timestamp,TimeMS,Lat,Lng,RelAlt", lambda y, x, s: f"{1.7e9 + s},{s}000,{_e7(y)},{_e7(x)},80.5", 80.5, None),
        ("TimeUS,Lat,Lng,Alt,RelHomeAlt", lambda y, x, s: f"{s}000000,{y},{x},512,80", 80, None),
        # RTKLIB, Emlid: heights above the ellipsoid are none.
        ("UTC,latitude(deg),longitude(deg),height(m),Q,ns", lambda y, x,
         s: f"2024-05-17T10:00:0{s}Z,{y},{x},612.3,1,9", None, None),
        ("UTC,latitude(deg),longitude(deg),height(m)", lambda y, x, s: f"2024-05-17T10:00:0{s}Z,{y},{x},612.3", None,
         None),
        (POS_HEAD, lambda y, x, s: f"2024/05/17 10:00:0{s}.000   {y}   {x}   612.3   1  9   0.1", None, None),
        (POS.replace("GPST", "UTC"), lambda y, x, s: f"2314 {TOW_S + s}   {y}   {x}   612.3   1  9   0.1", None, None),
        ("% UTC,latitude(deg),longitude(deg),height(m),Q,ns", lambda y, x, s: f"2314,{TOW_S + s},{y},{x},612.3,1,9",
         None, None),
        # AirData, Litchi (its altitude names no datum), ROS, tables of photos in any order.
        (AIRDATA.format("meters"), lambda y, x, s: f"{s}000,2024-05-17 10:00:00,{y},{x},100.0,90,600,90", 100, 90),
        (AIRDATA.format("feet"), lambda y, x, s: f"{s}000,2024-05-17 10:00:00,{y},{x},328.084,9,2000,90", 100, 90),
        ("latitude,longitude,altitude(feet),time(millisecond),yaw(deg)", lambda y, x, s: f"{y},{x},9,{s}000,90", None,
         90),
        (ROS, lambda y, x, s: f"{17 * 10**17 + s * 10**9},{s},{s},0,{y},{x},560.1", None, None),
        (PHOTOS, lambda _y, _x,
         s: f"""{s},2024:05:17 10:00:0{5 - s},"49 deg 0' 18.00"" N",{_east(5 - s)},9,+80,-9,1""", 80, -9),
        # Others: units in names, below them, decimal commas, a byte order mark, times of day.
        ("time_ms,lat_1e7,lon (1e-7 deg),rel_alt_cm,yaw_cdeg", lambda y, x, s: f"{s}000,{_e7(y)},{_e7(x)},8000,9000",
         80, 90),
        ("\ufefftime_s;lat;lon;height_m", lambda y, x, s: f"{s},0;{y};{x};80,25".replace(".", ","), 80.25, None),
        ('"time","lat","lon","height","Heading (°)"\n[s],[°],[°],[ft],', lambda y, x, s: f"{s},{y},{x},100,-5", 30.48,
         -5),
        ("Date\tTime\tLat\tLon", lambda y, x, s: f"17/5/24\t9:59:0{s}.5 AM\t{y}\t{x}", None, None),
        *(("time_s,lat,lon", lambda _y, _x, s, lat=lat: f'{s},"{lat}",{_east(s)} E', None,
         None) for lat in ("49.005 N", "49 deg 0.3' N", '49° 0\' 18.0"" N', "49°00\u203218.00\u2033N")),
        ("time_s,Latitude [rad],lon (radians),height_agl_m,geoid_height_m", lambda y, x,
         s: f"{s},{math.radians(y):.12f},{math.radians(x):.12f},80,47", 80, None),
        ("timeUs,latitude,longitude,agl_feet", lambda y, x, s: f"{s}000000,{y},{x},10", 3.048, None),
    ],
)  # fmt: skip
def test_a_log_of_any_format_is_the_same_flight(tmp_path, head, row, height_m, yaw_deg) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        log = _read(tmp_path, head, row, name="log.pos" if head.startswith("%  ") else "log.csv")
    _check(log, height_m=height_m, yaw_deg=yaw_deg)


@pytest.mark.parametrize(
    ("head", "row", "expected", "left_out"),
    [
        (
            "TimeUS,I,Status,Lat,Lng",  # two receivers 2 m apart
            lambda y, x, s: f"{s}000000,0,3,{y},{x}\n{s}100000,1,3,{y + 2e-5},{x}",
            {},
            ["left out 6 points of other receivers than I = 0"],
        ),
        (GPS, lambda y, x, s: f"{s}000000,0,1,7,{y},{x},512,0,1", None, ["left out 6 points without a fix"]),
        (GPS, lambda y, x, s: f"{s}000000,0,{1 if s < 1 else 3},7,{y if s else 0},{x if s else 0},512,0,1",
         {"count": 5}, ["left out 1 point without a fix", "no line has a yaw: read without"]),
        ("time_usec,fix_type,lat,lon,alt,eph", lambda y, x,
         s: f"{s}000000,{min(s, 3)},{_e7(y) * (s > 1)},{_e7(x) * (s > 1)},512000,1", {"count": 3},
         ["left out 3 points without a fix"]),
        (  # what is logged before the first fix tells no decimals, no dates, and need be no number
            "utc;lat;lon;height_m",
            lambda y, x, s: f"2024-05-17T10:00:0{s}Z;{y};{x};80,25".replace(".", ",") if s else ";0;0,0;0,0\n;0;0;x",
            {"height_m": 80.25, "count": 5},
            ["left out 2 points at 0, 0 before the first fix"],
        ),
        (POS, lambda y, x, s: f"2314 {TOW_S + s} {y} {x} 612.3 {s > 1:d} 9 0.1", {"count": 4},
         ["left out 2 points without a fix"]),
        (ROS, lambda y, x, s: f"{s * 10**9},{s},{s},{-(s < 1)},{y},{x},560", {"count": 5},
         ["left out 1 point without a fix"]),
        (
            "timestamp,GPS.TimeUS,GPS.Lat,GPS.Lng,ATT.TimeUS,ATT.Roll",  # rows of two messages
            lambda y, x, s: f"17,,,,{s}000000,5\n17,{s}000000,{y},{x},,",
            {},
            ["left out 6 points without a place"],
        ),
        (MAV, lambda y, x, s: f"{s}000,{_e7(y)},{_e7(x)},9,8000,65535", {"height_m": 8},
         ["no line has a yaw: read without"]),
        (MAV, lambda y, x, s: f"{s}000,{_e7(y)},{_e7(x)},9,8000,{65535 if s < 2 else 9000}", {"height_m": 8,
         "yaw_deg": 90, "count": 4}, ["left out 2 points without a yaw"]),
        ("timestamp,lat,lon,alt,heading", lambda y, x, s: f"{s}000007,{_e7(y)},{_e7(x)},9,nan", {},
         ["no line has a yaw: read without"]),
        ("time_s,lat,lon,yaw,pitch,height", lambda y, x, s: f"{s},{y},{x},NaN,3,", {},
         ["no line has a height: read without", "no line has a yaw: read without"]),
    ],
)  # fmt: skip
def test_what_is_no_place_or_no_value_is_left_out_with_a_word(tmp_path, head, row, expected, left_out) -> None:
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        if expected is None:
            with pytest.raises(FlightError, match="two points at least, the log has 0"):
                _read(tmp_path, head, row)
        else:
            _check(_read(tmp_path, head, row, name="a.pos" if head == POS else "log.csv"), **expected)
    assert [str(one.message).partition(": ")[2] for one in caught] == left_out


@pytest.mark.filterwarnings("ignore:.*no line has a yaw")
@pytest.mark.parametrize(
    ("head", "row", "match", "facts", "expected"),
    [
        ("timestamp,lat,lon", lambda y, x, s: f"{1.7e9 + s},{y},{x}",
         "'timestamp' states no unit: say --time-unit s, ms, us, ns or none", {"time_unit": "s"}, {}),
        ("t,lat,lon", lambda y, x, s: f"{s}000,{y},{x}", "'t' states no unit: say --time-unit", {"time_unit": "ms"},
         {}),
        ("timestamp,lat,lon,alt", lambda y, x, s: f"{17 * 10**17 + s * 10**9},{y},{x},9", "'timestamp' states no unit",
         {"time_unit": "ns"}, {}),
        (PX4_GPS, lambda y, x, s: f"{17 * 10**17 + s * 10**9},1,{y},{x},9,9,1,nan,3", "'timestamp' states no unit",
         {"time_unit": "ns", "angle_unit": "none"}, {}),
        (f"{PLAIN},height", lambda y, x, s: f"{s},{y},{x},20000",
         "'height' states no unit: say --height-unit m, cm, mm, ft or none, or name it as in height_m",
         {"height_unit": "mm"}, {"height_m": 20}),
        (f"{PLAIN},altitudeRelative", lambda y, x, s: f"{s},{y},{x},10", "'altitudeRelative' states no unit",
         {"height_unit": "ft"}, {"height_m": 3.048}),
        (f"{PLAIN},relative_alt", lambda y, x, s: f"{s},{y},{x},8000", "'relative_alt' states no unit",
         {"height_unit": "none"}, {}),
        (QGC, lambda y, x, s: f"2024-05-17 10:00:0{s}.123,1,2,90,80,560,00:00:0{s},{s},{y},{x},--.--,--.--,5,6,7",
         "'altitudeRelative' states no unit", {"height_unit": "m"}, {"height_m": 80, "yaw_deg": 90}),
        # gpsd has names of PX4, and times since 1970.
        ("timestamp,lat,lon,alt,eph,epv", lambda y, x, s: f"{1.7e9 + s},{y},{x},9,1,1", "'timestamp' states no unit",
         {"time_unit": "s"}, {}),
        # Scaled by its reader: a message of MAVLink has integers.
        (MAV, lambda y, x, s: f"{s}000,{y},{x},512,8.0,90", "'relative_alt' states no unit", {"height_unit": "m",
         "angle_unit": "deg"}, {"height_m": 8, "yaw_deg": 90}),
        (f"{PLAIN},yaw", lambda y, x, s: f"{s},{y},{x},9000",
         "'yaw' states no unit: say --angle-unit deg, cdeg, rad or none", {"angle_unit": "cdeg"}, {"yaw_deg": 90}),
        (f"{PLAIN},heading", lambda y, x, s: f"{s},{y},{x},1.5", "'heading' states no unit", {"angle_unit": "deg"},
         {"yaw_deg": 1.5}),
        (PLAIN, lambda y, x, s: f"{s},{_e7(y)},{_e7(x)}",
         "'lat' holds whole numbers that are no degrees: say --place-unit e7", {"place_unit": "e7"}, {}),
        ("Zeit,lat,lon,alt", lambda y, x, s: f"{s},{y},{x},9",
         "no column of time is known, it may be one of 'Zeit': name it", {"time_unit": "none"}, None),
        ("lat,lon,height_m,flightClock", lambda y, x, s: f"{y},{x},9,{s}", "it may be one of 'flightClock'",
         {"time_unit": "none"}, None),
        ("Date,lat,lon", lambda y, x, _s: f"17/5/24,{y},{x}", "it may be one of 'Date'", {"time_unit": "none"}, None),
    ],
)  # fmt: skip
def test_what_neither_name_nor_format_tells_is_asked_for_in_one_line(
    tmp_path, head, row, match, facts, expected
) -> None:
    with pytest.raises(FlightError, match=match) as fault:
        _read(tmp_path, head, row)
    assert "\n" not in str(fault.value)
    log = _read(tmp_path, head, row, **facts)
    if expected is None:
        assert log.time_s is None
    else:
        _check(log, **expected)


@pytest.mark.parametrize(
    ("head", "row", "facts", "match"),
    [
        (f"{PLAIN},height_ft", lambda y, x, s: f"{s},{y},{x},9", {"height_unit": "m"},
         "'height_ft' is in ft, not in m: leave out --height-unit"),
        ("utc,lat,lon", lambda y, x, s: f"2024-05-17T10:00:0{s}Z,{y},{x}", {"time_unit": "s"},
         "'utc' is in dates, not in s"),
        ("time,lat,lon", lambda y, x, s: f"01/05/2024 10:00:0{s},{y},{x}", {}, "line 2: time is no date and time"),
        ("utc_hour,utc_minute,utc_second,lat,lon", lambda y, x, s: f"10,{s},{s},{y},{x}", {},
         "the time is in parts, columns 'utc_hour', 'utc_minute', 'utc_second': join them"),
        *(
            (
                f"{PLAIN},Height [m],{beside}",
                lambda y, x, s: f"{s},{y},{x},612.3,1",
                {"height_unit": "m"},
                "'Height .m.' may count from the ellipsoid, as .* tells: say --height-unit none, or name it height_agl",
            )
            for beside in ("Undulation [m]", "hMSL", "geoid_separation_m", "sdn")
        ),
        ("time,lat,lon", lambda y, x, s: f"25:00:0{s},{y},{x}", {}, "line 2: time is no time of day, '25:00:00'"),
        ("time,lat,lon", lambda y, x, s: f"13:00:0{s} PM,{y},{x}", {}, "line 2: time is no time of day"),
        ("GPS.TimeUS,GPS.Lat,GPS.Lng,GPS2.Lat,GPS2.Lng", lambda y, x, s: f"{s},{y},{x},{y},{x}", {},
         "latitude is ambiguous, columns 'GPS.Lat', 'GPS2.Lat'"),
        ("time_s;lat;lon;height_m", lambda _y, _x, s: f"{s};49,005;11,0{s};1.234", {},
         "line 2: height is '1.234' where others have a decimal comma"),
        ("time_s,lat,lon", lambda _y, x, s: f"""{s},"11 deg 0' 18.00"" E",{x}""", {},
         "line 2: latitude is .* check which column is which"),
        ("time_s,lat,lon", lambda y, x, s: f"{s},{y},{x},9", {}, "line 2: 4 cells, the head has 3"),
        ("%  GPST  x-ecef(m) y-ecef(m) Q ns", lambda _y, _x, s: f"2314 {s} 1 2 1 9", {},
         "no column of latitude and longitude, found 'GPST', 'x-ecef"),
    ],
)  # fmt: skip
def test_what_contradicts_or_may_be_two_things_is_refused(tmp_path, head, row, facts, match) -> None:
    with pytest.raises(FlightError, match=match):
        _read(tmp_path, head, row, **facts)


@pytest.mark.parametrize(
    ("facts", "match"),
    [
        ({"time_unit": "min"}, "time_unit must be one of s, ms, us, ns, none, got 'min'"),
        ({"place_unit": "none"}, "place_unit must be one of deg, rad, e7, got 'none'"),
        ({"axes": "ned"}, "axes must be one of up, camera, got 'ned'"),
        ({"speed_mps": float("nan")}, "--speed-mps must be a number from 0.1 to 100, got nan"),
    ],
)
def test_facts_that_cannot_be_are_refused_and_units_are_not_said_of_files_that_state_them(
    facts, match, tmp_path
) -> None:
    with pytest.raises(FlightError, match=match):
        LogFacts(**facts)
    (tmp_path / "a.gpx").write_text("<gpx/>")
    with pytest.raises(FlightError, match=r"a\.gpx is no table, and its units are known: leave out --height-unit"):
        read_log(tmp_path / "a.gpx", LogFacts(height_unit="ft"))


@given(st.sampled_from(sorted(UNITS["time"])), st.integers(-3, 3))
def test_the_unit_of_a_time_is_that_of_its_name_at_any_speed(tmp_path_factory, unit, power) -> None:
    ticks = 10.0**power / UNITS["time"][unit]  # a step may last a millisecond or a quarter of an hour
    path = tmp_path_factory.mktemp("times") / "log.csv"
    rows = [f"{at * ticks!r},47.14,{9 + at * 1e-7}\n" for at in range(4)]
    path.write_text(f"timestamp_{unit},lat,lon\n{''.join(rows)}", encoding="utf-8")
    log = read_log(path)
    assert log.time_s == pytest.approx([at * 10.0**power for at in range(4)])


def test_a_time_of_day_goes_on_over_midnight_by_its_date_or_without() -> None:
    source = LogSource(path=Path("a.csv"), unit="line")
    for dates in (("", "", ""), ("5/17/2024", "5/18/2024", "5/18/2024")):
        clock = Clock(source=source)
        cells = zip(("11:59:59.5 PM", "12:00:00.5 AM", "12:00:01.5 a.m."), dates, strict=True)
        seconds = [clock.seconds(text, date, 2) for text, date in cells]
        assert seconds == [86399.5, 86400.5, 86401.5]


def test_no_name_stands_for_two_fields_and_every_unit_has_a_factor() -> None:
    names = [name for field in NAMES for name in NAMES[field]]
    assert len(names) == len(set(names))
    assert all(set(WORDS[quantity].values()) <= set(UNITS[quantity]) for quantity in UNITS)
    for one in FORMATS:
        for field, columns in one.columns.items():
            assert set(columns.values()) - {None} <= set(UNITS[QUANTITIES[field]])


# When it starts, and altitudes


NOON_S = dt.datetime(2025, 5, 1, 12, tzinfo=dt.UTC).timestamp()
WEEK, WEEK_S = 2364, 4 * 86_400 + 43_218  # of GPS, 18 s ahead of noon


@pytest.mark.parametrize(
    ("head", "row", "start_s"),
    [
        ("time,lat,lon", lambda y, x, s: f"2025-05-01T12:00:0{s}Z,{y},{x}", NOON_S),
        ("time,lat,lon", lambda y, x, s: f"2025-05-01T14:00:0{s}+02:00,{y},{x}", NOON_S),
        ("time,lat,lon", lambda y, x, s: f"2025-05-01 14:00:0{s}+02,{y},{x}", NOON_S),  # as PostgreSQL writes it
        ("time,lat,lon", lambda y, x, s: f"2025-05-01 08:00:0{s}.0 -04,{y},{x}", NOON_S),
        ("time,lat,lon", lambda y, x, s: f"2025-05-01 12:00:0{s} UTC,{y},{x}", NOON_S),
        ("datetime(utc),lat,lon", lambda y, x, s: f"2025-05-01 12:00:0{s},{y},{x}", NOON_S),
        ("time,lat,lon", lambda y, x, s: f"2025-05-01 12:00:0{s},{y},{x}", None),  # of no zone
        ("time_utc,lat,lon", lambda y, x, s: f"12:00:0{s},{y},{x}", None),  # of no day
        ("time_s,lat,lon", lambda y, x, s: f"{NOON_S + s},{y},{x}", None),  # of no origin
        (ROS, lambda y, x, s: f"{int(NOON_S + s)}250000000,1,2,0,{y},{x},500", NOON_S + 0.25),
        (ROS, lambda y, x, s: f"{s}250000000,1,2,0,{y},{x},500", None),  # of a simulator
        ("GPST,latitude(deg),longitude(deg),height(m),Q,ns", lambda y, x, s:
         f"2025/05/01 12:00:{18 + s}.000,{y},{x},500,1,9", NOON_S),
        ("UTC,latitude(deg),longitude(deg),height(m),Q,ns", lambda y, x, s:
         f"2025/05/01 12:00:0{s}.000,{y},{x},500,1,9", NOON_S),
        ("GPST,latitude(deg),longitude(deg),height(m),Q,ns", lambda y, x, s:
         f"{WEEK} {WEEK_S + s}.000,{y},{x},500,1,9", NOON_S),
        ("time_usec,fix_type,lat,lon,alt", lambda y, x, s:
         f"{int(NOON_S + s)}000000,3,{_e7(y)},{_e7(x)},500000", NOON_S),
        ("time_usec,fix_type,lat,lon,alt", lambda y, x, s: f"{s}000000,3,{_e7(y)},{_e7(x)},500000", None),
        ("time_utc,ms,lat,lon", lambda y, x, s: f"2025-05-01T12:00:0{s},250,{y},{x}", NOON_S + 0.25),
    ],
)  # fmt: skip
def test_a_log_starts_at_a_moment_where_its_file_says_in_which_zone(
    tmp_path: Path, head: str, row: Row, start_s: float | None
) -> None:
    log = _read(tmp_path, head, row)
    assert log.time_s == pytest.approx([0, 1, 2, 3, 4, 5])
    assert log.start_s == (None if start_s is None else pytest.approx(start_s, abs=1e-3))


@pytest.mark.parametrize(
    ("head", "row", "altitude_m", "altitude_of"),
    [
        (f"{PLAIN},alt_m", lambda y, x, s: f"{s},{y},{x},480.5", 480.5, "unknown"),
        (f"{PLAIN},altitude(feet),altitude_amsl_ft", lambda y, x, s: f"{s},{y},{x},9,1000", 304.8, "geoid"),
        (f"{PLAIN},alt_ellipsoid_mm", lambda y, x, s: f"{s},{y},{x},527500", 527.5, "ellipsoid"),
        (f"{PLAIN},alt", lambda y, x, s: f"{s},{y},{x},480", None, "unknown"),  # of no unit
        (f"{PLAIN},alt_m,elevation_m", lambda y, x, s: f"{s},{y},{x},480,470", None, "unknown"),  # of two meanings
        (f"{PLAIN},alt_m", lambda y, x, s: f"{s},{y},{x}," + ("" if s == 3 else "480"), None, "unknown"),
        (ROS, lambda y, x, s: f"{s}000000000,1,2,0,{y},{x},527.5", 527.5, "ellipsoid"),
        ("time_boot_ms,lat,lon,alt,relative_alt,hdg", lambda y, x, s: f"{s}000,{_e7(y)},{_e7(x)},480500,80000,9000",
         480.5, "geoid"),
        ("timestamp,latitude_deg,longitude_deg,altitude_msl_m", lambda y, x, s: f"{s}000000,{y},{x},480.5",
         480.5, "geoid"),
        ("timestamp,lat,lon,alt,alt_ellipsoid", lambda y, x, s: f"{s}000000,{_e7(y)},{_e7(x)},480500,527500",
         480.5, "geoid"),
        ("timestamp,lat,lon,alt,terrain_alt", lambda y, x, s: f"{s}000000,{y},{x},480.5,400", 480.5, "geoid"),
        ("TimeUS,Lat,Lng,Alt,RelHomeAlt", lambda y, x, s: f"{s}000000,{y},{x},480.5,80", 480.5, "geoid"),
    ],
)  # fmt: skip
def test_altitudes_are_apart_from_heights_and_say_what_they_count_from(
    tmp_path: Path, head: str, row: Row, altitude_m: float | None, altitude_of: str
) -> None:
    log = _read(tmp_path, head, row)
    assert log.altitude_of == altitude_of
    assert log.altitude_m == (None if altitude_m is None else pytest.approx(altitude_m))
    assert log.height_m is None or log.height_m == pytest.approx(80)
    assert len(log) == 6  # none is left out for want of an altitude
