# SPDX-License-Identifier: Apache-2.0
"""Logs of autopilots as tests write them: one flight, in every format, with what each format has besides."""

import struct
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

LON, LAT = 9.52, 47.14
START_S = 1_746_093_600  # 2025-05-01 10:00 UTC
BOOT_S = 12.5  # since the start of the autopilot, at the first fix
GROUND_M = 480.0

_CODES = {"float": "f", "double": "d", "bool": "?"} | {
    f"{sign}int{bits}_t": code.upper() if sign else code
    for sign in ("", "u")
    for bits, code in ((8, "b"), (16, "h"), (32, "i"), (64, "q"))
}

Floats = NDArray[np.float64]


@dataclass(frozen=True, kw_only=True)
class Flown:
    """A climb to 80 m and a flight to the north-east at about 8 m/s, five fixes a second."""

    count: int = 200
    time_s: Floats = field(init=False)
    lon_deg: Floats = field(init=False)
    lat_deg: Floats = field(init=False)
    height_m: Floats = field(init=False)
    yaw_deg: Floats = field(init=False)

    def __post_init__(self) -> None:
        at = np.arange(self.count)
        for name, values in {
            "time_s": at * 0.2,
            "lon_deg": (LON + at * 1.5e-5).round(7),
            "lat_deg": (LAT + at * 1e-5).round(7),
            "height_m": np.minimum(at * 1.0, 80.0),
            "yaw_deg": (350.0 + at * 0.5) % 360.0,  # over north
        }.items():
            object.__setattr__(self, name, values)


# ULog


def ulog(
    topics: Mapping[tuple[str, int], tuple[str, Sequence[tuple]]],
    *,
    dropouts: Sequence[tuple[int, int]] = (),
) -> bytes:
    """A ULog of topics: (name, instance) -> fields as ULog declares them, rows; dropouts as microseconds, ms."""
    head = b"ULog\x01\x12\x35\x01" + struct.pack("<Q", 0) + _message("B", bytes(40))
    formats = {name: fields for (name, _), (fields, _) in topics.items()}
    head += b"".join(_message("F", f"{name}:{fields}".encode()) for name, fields in formats.items())
    body: list[tuple[int, bytes]] = []
    for number, ((name, instance), (fields, rows)) in enumerate(topics.items()):
        head += _message("A", struct.pack("<BH", instance, number) + name.encode())
        codes = ""
        for one in fields.strip(";").split(";"):
            kind, _, count = one.split(" ")[0].partition("[")
            codes += f"{int(count.strip(']') or 1)}{_CODES[kind]}" if count else _CODES[kind]
        body += [(int(row[0]), _message("D", struct.pack(f"<H{codes}", number, *row))) for row in rows]
    body += [(time_us, _message("O", struct.pack("<H", length_ms))) for time_us, length_ms in dropouts]
    return head + b"".join(data for _, data in sorted(body, key=lambda item: item[0]))


def _message(kind: str, data: bytes) -> bytes:
    return struct.pack("<HB", len(data), ord(kind)) + data


GPS_113 = (
    "uint64_t timestamp;uint64_t time_utc_usec;int32_t lat;int32_t lon;int32_t alt;int32_t alt_ellipsoid;float eph;"
    "uint8_t fix_type;"
)
GPS_114 = (
    "uint64_t timestamp;uint64_t time_utc_usec;double latitude_deg;double longitude_deg;double altitude_msl_m;"
    "double altitude_ellipsoid_m;float eph;uint8_t fix_type;"
)
LOCAL = "uint64_t timestamp;float x;float y;float z;bool xy_valid;bool z_valid;"
HOME = "uint64_t timestamp;double lat;double lon;float alt;float x;float y;float z;float yaw;"
ATTITUDE = "uint64_t timestamp;float[4] q;"


def stamps_us(time_s: Floats) -> list[int]:
    """Microseconds since the start of the autopilot."""
    return [round((BOOT_S + float(one)) * 1e6) for one in time_s]


def gps_rows(flown: Flown, *, is_new: bool = True, fix_type: int = 3) -> list[tuple]:
    """Rows of a receiver, by PX4 1.14 and later or before."""
    rows = []
    for at, stamp in enumerate(stamps_us(flown.time_s)):
        utc_us = (START_S * 1_000_000) + round(float(flown.time_s[at]) * 1e6)
        lon, lat, alt = float(flown.lon_deg[at]), float(flown.lat_deg[at]), GROUND_M + float(flown.height_m[at])
        place = (lat, lon, alt, alt + 47) if is_new else _whole(lat, lon, alt)
        rows.append((stamp, utc_us, *place, 1.2, fix_type))
    return rows


def _whole(lat: float, lon: float, alt: float) -> tuple[int, int, int, int]:
    return round(lat * 1e7), round(lon * 1e7), round(alt * 1e3), round((alt + 47) * 1e3)


def turn(yaw_deg: float) -> tuple[float, float, float, float]:
    """w, x, y, z of a level body that heads there, to north, east, down."""
    half = np.radians(yaw_deg) / 2
    return float(np.cos(half)), 0.0, 0.0, float(np.sin(half))


def px4_topics(flown: Flown, *, is_new: bool = True) -> dict[tuple[str, int], tuple[str, list[tuple]]]:
    """What PX4 logs of a flight, each topic at a rate of its own; the home position lies at z = -2 m."""
    often_s = np.arange(flown.time_s[0] - 0.5, flown.time_s[-1] + 0.5, 0.1)
    height_m = np.interp(often_s, flown.time_s, flown.height_m)
    yaw_deg = np.interp(often_s, flown.time_s, np.unwrap(flown.yaw_deg, period=360.0))
    often_us = stamps_us(often_s)
    local = [(us, 0.0, 0.0, -2.0 - up, True, True) for us, up in zip(often_us, height_m.tolist(), strict=True)]
    attitude = [(us, *turn(yaw)) for us, yaw in zip(often_us, yaw_deg.tolist(), strict=True)]
    return {
        ("vehicle_gps_position", 0): (GPS_114 if is_new else GPS_113, gps_rows(flown, is_new=is_new)),
        ("vehicle_local_position", 0): (LOCAL, local),
        ("home_position", 0): (HOME, [(often_us[0], LAT, LON, GROUND_M, 0.0, 0.0, -2.0, 0.0)]),
        ("vehicle_attitude", 0): (ATTITUDE, attitude),
    }


def write(path: Path, data: bytes) -> Path:
    """Write bytes, and return where."""
    path.write_bytes(data)
    return path


# DataFlash

_DATAFLASH = {"Q": "Q", "B": "B", "I": "I", "H": "H", "L": "i", "e": "i", "c": "h", "C": "H", "f": "f", "n": "4s"}
_PARTS = {"L": 1e7, "e": 100, "c": 100, "C": 100}
# Message -> number, format and columns, as ArduPilot 4.5 declares them (GPS without its last columns).
MESSAGES = {
    "GPS": (200, "QBBIHBcLLeffffB", "TimeUS,I,Status,GMS,GWk,NSats,HDop,Lat,Lng,Alt,Spd,GCrs,VZ,Yaw,U"),
    "GPA": (201, "QBCCCCfBIHfHH", "TimeUS,I,VDop,HAcc,VAcc,SAcc,YAcc,VV,SMS,Delta,Und,RTCMFU,RTCMFD"),
    "POS": (202, "QLLfff", "TimeUS,Lat,Lng,Alt,RelHomeAlt,RelOriginAlt"),
    "ATT": (203, "QccccCCCCB", "TimeUS,DesRoll,Roll,DesPitch,Pitch,DesYaw,Yaw,ErrRP,ErrYaw,AEKF"),
    "XKF1": (204, "QBccCfffffffccce", "TimeUS,C,Roll,Pitch,Yaw,VN,VE,VD,dPD,PN,PE,PD,GX,GY,GZ,OH"),
    "XKF4": (205, "QBcccccfffHBIHb", "TimeUS,C,SV,SP,SH,SM,SVT,errRP,OFN,OFE,FS,TS,SS,GPS,PI"),
    "VISP": (206, "QQIfffffffffBb", "TimeUS,RTimeUS,CTimeMS,PX,PY,PZ,R,P,Y,PErr,AErr,VErr,Rst,Q"),
}


def dataflash(rows: Mapping[str, Sequence[tuple]], messages: Mapping[str, tuple] = MESSAGES) -> bytes:
    """A binary log of messages: name -> rows in the units of their columns, the first of which is microseconds."""
    head = bytes((0xA3, 0x95))
    fmt = (128, 89, b"FMT", b"BBnNZ", b"Type,Length,Name,Format,Columns")
    data = head + struct.pack("<BBB4s16s64s", 128, *fmt)
    body: list[tuple[int, bytes]] = []
    for name in rows:
        number, form, columns = messages[name]
        codes = "<" + "".join(_DATAFLASH.get(letter, letter) for letter in form)
        size = struct.calcsize(codes) + 3
        data += head + struct.pack("<BBB4s16s64s", 128, number, size, name.encode(), form.encode(), columns.encode())
        for row in rows[name]:
            cells = [round(cell * _PARTS[at]) if at in _PARTS else cell for at, cell in zip(form, row, strict=True)]
            body.append((int(row[0]), head + bytes((number,)) + struct.pack(codes, *cells)))
    return data + b"".join(part for _, part in sorted(body, key=lambda item: item[0]))


def dataflash_text(rows: Mapping[str, Sequence[tuple]]) -> bytes:
    """The same log as text, as Mission Planner converts it."""
    lines = ["FMT, 128, 89, FMT, BBnNZ, Type,Length,Name,Format,Columns"]
    body: list[tuple[int, str]] = []
    for name in rows:
        number, form, columns = MESSAGES[name]
        lines.append(f"FMT, {number}, 99, {name}, {form}, {columns}")
        body += [(int(row[0]), ", ".join([name, *map(repr, row)])) for row in rows[name]]
    return "\n".join([*lines, *(line for _, line in sorted(body, key=lambda item: item[0])), ""]).encode()


GPS_LEAPS_S = 18
_GPS_S = START_S - 315_964_800 + GPS_LEAPS_S


def ardupilot_rows(flown: Flown) -> dict[str, list[tuple]]:
    """What ArduPilot logs of a flight: two receivers, of which the first has no fix at all."""
    rows: dict[str, list[tuple]] = {"GPS": [], "GPA": [], "POS": [], "ATT": []}
    for at, stamp in enumerate(stamps_us(flown.time_s)):
        lon, lat, up = float(flown.lon_deg[at]), float(flown.lat_deg[at]), float(flown.height_m[at])
        ms, week = round((_GPS_S % 604_800 + float(flown.time_s[at])) * 1e3), _GPS_S // 604_800
        for receiver, status in ((0, 1), (1, 3)):
            tail = (9, 0.8, lat, lon, GROUND_M + up, 8.0, 45.0, 0.0, 0.0, 1)
            rows["GPS"].append((stamp, receiver, status, ms, week, *tail))
            rows["GPA"].append((stamp, receiver, 1.0, 0.75 + receiver, 1.0, 0.1, 0.0, 1, 0, 200, 47.0, 0, 0))
    often_s = np.arange(flown.time_s[0] - 0.5, flown.time_s[-1] + 0.5, 0.1)
    height_m = np.interp(often_s, flown.time_s, flown.height_m).tolist()
    yaw_deg = (np.interp(often_s, flown.time_s, np.unwrap(flown.yaw_deg, period=360.0)) % 360).tolist()
    for stamp, up, yaw in zip(stamps_us(often_s), height_m, yaw_deg, strict=True):
        rows["POS"].append((stamp, LAT, LON, GROUND_M + up, up, up + 3))
        rows["ATT"].append((stamp, 0.0, 0.0, 0.0, 0.0, 0.0, yaw, 0.0, 0.0, 1))
    return rows


# Telemetry


def tlog(flown: Flown, *, systems: Sequence[int] = (1,), is_v1: bool = False, late_s: float = 0.05) -> bytes:
    """A telemetry log as a ground station writes it, each message received late."""
    from pymavlink.dialects.v10 import common as before  # type: ignore[import-untyped] # noqa: PLC0415
    from pymavlink.dialects.v20 import common as now  # type: ignore[import-untyped] # noqa: PLC0415

    common, more = (before, ()) if is_v1 else (now, (1250,))
    packets: list[tuple[int, bytes]] = []
    for system in systems:
        link = common.MAVLink(None, srcSystem=system, srcComponent=1)
        for at, stamp in enumerate(stamps_us(flown.time_s)):
            lon, lat = round(float(flown.lon_deg[at]) * 1e7), round(float(flown.lat_deg[at]) * 1e7)
            up, ms = float(flown.height_m[at]), stamp // 1000
            alt = round((GROUND_M + up) * 1e3)
            yaw = float(np.radians((flown.yaw_deg[at] + 180) % 360 - 180))
            utc_us = START_S * 1_000_000 + round(float(flown.time_s[at]) * 1e6)
            messages = (
                common.MAVLink_gps_raw_int_message(
                    stamp, 3, lat, lon, alt, 80, 90, 800, 4500, 9, *(alt + 47000 for _ in more), *more
                ),
                common.MAVLink_global_position_int_message(ms, lat, lon, alt, round(up * 1e3), 0, 0, 0, 65535),
                common.MAVLink_attitude_message(ms, 0.0, 0.0, yaw, 0.0, 0.0, 0.0),
                common.MAVLink_system_time_message(utc_us, ms),
                common.MAVLink_heartbeat_message(2, 3, 0, 0, 4, 3),
            )
            received_us = utc_us + round(late_s * 1e6) * (1 + at % 3)
            packets += [(received_us, bytes(one.pack(link))) for one in messages]
    station = common.MAVLink(None, srcSystem=255, srcComponent=190)
    packets.append((packets[0][0], bytes(common.MAVLink_heartbeat_message(6, 8, 0, 0, 4, 3).pack(station))))
    return b"".join(stamp.to_bytes(8, "big") + one for stamp, one in sorted(packets, key=lambda item: item[0]))
