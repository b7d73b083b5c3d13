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
