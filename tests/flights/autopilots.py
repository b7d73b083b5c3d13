# SPDX-License-Identifier: Apache-2.0
"""Logs of autopilots as tests write them: one flight, in every format, with what each format has besides."""

import struct
import warnings
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import pyproj
from numpy.typing import NDArray

from sasgeo_bench.core.errors import FlightError
from sasgeo_bench.flights.logs import read_log

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
    """A climb to 80 m, unless it is level there, and a flight to the north-east at about 8 m/s, five fixes a second."""

    count: int = 200
    is_level: bool = False
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
            "height_m": np.full(self.count, 80.0) if self.is_level else np.minimum(at * 1.0, 80.0),
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

_DATAFLASH = {"L": "i", "e": "i", "E": "I", "c": "h", "C": "H", "n": "4s", "N": "16s"}
_PARTS = {"L": 1e7, "e": 100, "E": 100, "c": 100, "C": 100}
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
        body += [(int(row[0]), ", ".join([name, *map(str, row)])) for row in rows[name]]
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


# Bags

NAV_SAT = "sensor_msgs/msg/NavSatFix"
PX4_TYPES = {
    "SensorGps": (
        "uint64 timestamp\nfloat64 latitude_deg\nfloat64 longitude_deg\nfloat64 altitude_msl_m\nfloat32 eph\n"
        "uint8 fix_type\nuint64 time_utc_usec"
    ),
    "VehicleGpsPosition": (
        "uint64 timestamp\nint32 lat\nint32 lon\nint32 alt\nfloat32 eph\nuint8 fix_type\nuint64 time_utc_usec"
    ),
    "VehicleAttitude": "uint64 timestamp\nfloat32[4] q",
    "VehicleLocalPosition": "uint64 timestamp\nfloat32 x\nfloat32 y\nfloat32 z\nbool xy_valid\nbool z_valid",
    "HomePosition": "uint64 timestamp\nfloat32 z",
    "EstimatorStatusFlags": "uint64 timestamp\nbool cs_gps",
}
MORE_TYPES = {
    "foxglove_msgs/msg/LocationFix": (
        "builtin_interfaces/Time timestamp\nstring frame_id\nfloat64 latitude\nfloat64 longitude\nfloat64 altitude"
    ),
    "geographic_msgs/msg/GeoPoint": "float64 latitude\nfloat64 longitude\nfloat64 altitude",
    "geographic_msgs/msg/GeoPointStamped": "std_msgs/Header header\ngeographic_msgs/GeoPoint position",
} | {f"px4_msgs/msg/{name}": text for name, text in PX4_TYPES.items()}

Message = tuple[str, str, int, Mapping[str, object]]  # topic, type, nanoseconds of the recorder, fields


def bag(path: Path, messages: Iterable[Message], *, topics: Sequence[tuple[str, str]] = ()) -> Path:
    """A bag of ROS 1 (.bag), or of ROS 2 as a folder of MCAP (.mcap) or of SQLite (.db3); returns what is read."""
    from rosbags import rosbag1, rosbag2  # noqa: PLC0415 - only where it is installed
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore  # noqa: PLC0415

    is_first = path.suffix == ".bag"
    store = get_typestore(Stores.ROS1_NOETIC if is_first else Stores.ROS2_HUMBLE)
    for name, text in MORE_TYPES.items():
        store.register(get_types_from_msg(text, name))
    plugin = rosbag2.StoragePlugin.MCAP if path.suffix == ".mcap" else rosbag2.StoragePlugin.SQLITE3
    folder = path.with_suffix("")
    writer = rosbag1.Writer(path) if is_first else rosbag2.Writer(folder, version=9, storage_plugin=plugin)
    serialize = store.serialize_ros1 if is_first else store.serialize_cdr
    with writer:
        open_ones = {topic: writer.add_connection(topic, kind, typestore=store) for topic, kind in topics}
        for topic, kind, stamp_ns, fields in messages:
            if topic not in open_ones:
                open_ones[topic] = writer.add_connection(topic, kind, typestore=store)
            writer.write(open_ones[topic], stamp_ns, serialize(_message_of(store, kind, fields), kind))
    return path if is_first else folder


def _message_of(store: object, kind: str, fields: Mapping[str, object]) -> object:
    """A message of a type; fields that are not named are 0, empty, or of their own type."""
    values = {}
    for name, (node, what) in store.fielddefs[kind][1]:  # type: ignore[attr-defined]
        inner = fields.get(name)
        if node == 1 and what[0] != "string":  # a number
            values[name] = 0 if inner is None else inner
        elif node == 1:
            values[name] = inner or ""
        elif node == 2:  # a message
            values[name] = _message_of(store, what, inner or {})  # type: ignore[arg-type]
        else:
            (_, (number, _)), length = what
            values[name] = np.zeros(length, _NUMPY[number]) if inner is None else np.array(inner, _NUMPY[number])
    return store.types[kind](**values)  # type: ignore[attr-defined]


_NUMPY = {"float32": np.float32, "float64": np.float64}


def stamp(time_s: float, *, start_ns: int = START_S * 10**9) -> dict[str, int]:
    """A time of a header."""
    total_ns = start_ns + round(time_s * 1e9)
    return {"sec": total_ns // 10**9, "nanosec": total_ns % 10**9}


def mavros_messages(flown: Flown, *, late_s: float = 0.03, status: int = 0) -> list[Message]:
    """What mavros publishes of a flight, each message recorded late."""
    messages: list[Message] = []
    for at, time_s in enumerate(flown.time_s.tolist()):
        lon, lat, up = float(flown.lon_deg[at]), float(flown.lat_deg[at]), float(flown.height_m[at])
        recorded_ns = START_S * 10**9 + round((time_s + late_s) * 1e9)
        header = {"stamp": stamp(time_s)}
        place = {"latitude": lat, "longitude": lon, "altitude": GROUND_M + 47 + up}
        fix = {"header": header, "status": {"status": status}, **place, "position_covariance_type": 2}
        fix["position_covariance"] = [2.25, 0, 0, 0, 2.25, 0, 0, 0, 9]
        half = np.radians(90 - flown.yaw_deg[at]) / 2  # counter-clockwise from east
        turn_of = {"w": float(np.cos(half)), "x": 0.0, "y": 0.0, "z": float(np.sin(half))}
        messages += [
            ("/mavros/global_position/raw/fix", NAV_SAT, recorded_ns, fix),
            ("/mavros/global_position/global", NAV_SAT, recorded_ns, fix | {"latitude": lat + 1e-4}),
            ("/mavros/global_position/rel_alt", "std_msgs/msg/Float64", recorded_ns, {"data": up}),
            ("/mavros/imu/data", "sensor_msgs/msg/Imu", recorded_ns, {"header": header, "orientation": turn_of}),
        ]
    return messages


_PX4_FIELDS = {line.split()[1] for text in PX4_TYPES.values() for line in text.splitlines()}


def px4_messages(flown: Flown, *, is_new: bool = True) -> list[Message]:
    """What PX4 publishes over its bridge, stamped by its own clock."""
    kind = "SensorGps" if is_new else "VehicleGpsPosition"
    topics = px4_topics(flown, is_new=is_new)
    messages: list[Message] = []
    tables = {
        "vehicle_gps_position": kind,
        "vehicle_attitude": "VehicleAttitude",
        "vehicle_local_position": "VehicleLocalPosition",
        "home_position": "HomePosition",
    }
    for topic, name in tables.items():
        fields, rows = topics[topic, 0]
        columns = [one.split(" ")[1] for one in fields.strip(";").split(";")]
        for row in rows:
            values = dict(zip(columns, [row[0], row[1:]] if name == "VehicleAttitude" else row, strict=True))
            kept = {key: value for key, value in values.items() if key in _PX4_FIELDS}
            messages.append((f"/fmu/out/{topic}", f"px4_msgs/msg/{name}", START_S * 10**9 + int(row[0]) * 1000, kept))
    return sorted(messages, key=lambda one: one[2])


# Drift

LEVEL = Flown(count=600, is_level=True)  # 950 m
STATUS = "uint64_t timestamp;uint32_t control_mode_flags;"
_GPS_BIT = 1 << 2
OTHERS = 1 << 0 | 1 << 1 | 1 << 7 | 1 << 12  # aligned, in the air, with poses of a camera


def north_east_m(flown: Flown = LEVEL) -> Floats:
    """North and east of the first fix by geodesics, shape (N, 2), metres."""
    count = len(flown.time_s)
    first = [np.full(count, flown.lon_deg[0]), np.full(count, flown.lat_deg[0])]
    azimuth_deg, _, way_m = pyproj.Geod(ellps="WGS84").inv(*first, flown.lon_deg, flown.lat_deg)
    return np.stack([way_m * np.cos(np.radians(azimuth_deg)), way_m * np.sin(np.radians(azimuth_deg))], axis=1)


def px4_drift(scale: float, flags: Mapping, *, fix_type: int = 3, **more) -> dict:
    """A ULog whose estimate is too long by a scale, with flags of its own."""
    place_m = north_east_m() * scale
    stamps = stamps_us(LEVEL.time_s)
    local = [
        (us, north, east, -float(up), True, True)
        for us, (north, east), up in zip(stamps, place_m.tolist(), LEVEL.height_m, strict=True)
    ]
    attitude = [(us, *turn(yaw)) for us, yaw in zip(stamps, LEVEL.yaw_deg.tolist(), strict=True)]
    return {
        ("vehicle_gps_position", 0): (GPS_114, gps_rows(LEVEL, fix_type=fix_type)),
        ("vehicle_local_position", 0): (LOCAL, local),
        ("vehicle_attitude", 0): (ATTITUDE, attitude),
        **flags,
        **more,
    }


def fusing(is_fused: Callable[[float], bool], *, every_s: float = 0.5) -> tuple[str, list[tuple]]:
    """Flags of an estimator that fuses GNSS, or does not, at times of the flight."""
    times_s = np.arange(0, LEVEL.time_s[-1], every_s)
    rows = [(us, OTHERS | _GPS_BIT * is_fused(one)) for us, one in zip(stamps_us(times_s), times_s, strict=True)]
    return STATUS, rows


def wrong_of_damaged(path: Path, data: bytes, *, seed: int, part: float) -> list[str]:
    """Change five bytes of a log, cut it, and read it; return what is wrong with what is read, or with the refusal."""
    changed, rng = bytearray(data), np.random.default_rng(seed)
    for at in rng.integers(len(data), size=5):
        changed[at] = rng.integers(256)
    path.write_bytes(bytes(changed[: round(len(data) * part)]))
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            log = read_log(path)
    except FlightError as fault:
        line = str(fault)
        return [] if path.name in line and line.isprintable() else [line]
    most = {"lon_deg": 180, "lat_deg": 90, "height_m": 1e4, "altitude_m": 1.9e4, "yaw_deg": 360, "pitch_deg": 90}
    columns = {name: getattr(log, name) for name in most if getattr(log, name) is not None}
    wrong = [name for name, values in columns.items() if not (np.abs(values) <= most[name]).all()]
    wrong += [name for name, values in columns.items() if len(values) != len(log)]
    return wrong if log.time_s is not None and (np.diff(log.time_s) > 0).all() else [*wrong, "time_s"]
