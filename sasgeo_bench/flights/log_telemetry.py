# SPDX-License-Identifier: Apache-2.0
"""Telemetry logs of MAVLink (.tlog), which ground stations write of any autopilot.

Which message is read: `GPS_RAW_INT`, and only where it has no fixes the estimate `GLOBAL_POSITION_INT`, whose
`relative_alt` is the height; attitude `ATTITUDE`. Times are the autopilot's own in each message, since messages arrive
late. https://mavlink.io/en/messages/common.html
"""

import mmap
import re
import struct
from array import array
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from sasgeo_bench.core.errors import ConfigError
from sasgeo_bench.core.paths import plain_file
from sasgeo_bench.flights.log_points import FlightLog, LogSource
from sasgeo_bench.flights.log_streams import (
    MOST_LOG_BYTES,
    Clock,
    Estimate,
    Fixes,
    LoggedOdometry,
    Stream,
    Streams,
    first_with_fixes,
    flight_of,
    library,
    quaternions_of_angles,
    quaternions_of_ned,
    resets_of,
    stated_of,
)
from sasgeo_bench.flights.log_units import LEAST_FIX

Floats = NDArray[np.float64]
Columns = Mapping[str, Floats]
Rows = dict[tuple[int, int, str], "array[float]"]  # by system, component and message

SYSTEM_TIME: Final = "SYSTEM_TIME"
GPS_RAW: Final = "GPS_RAW_INT"
GPS_SECOND: Final = "GPS2_RAW"
POSITION: Final = "GLOBAL_POSITION_INT"
ATTITUDE: Final = "ATTITUDE"
ODOMETRY: Final = "ODOMETRY"
VISION: Final = "VISION_POSITION_ESTIMATE"

# Of MAV_ESTIMATOR_TYPE: vision, with inertial sensors, lidar. Others fused a receiver, or do not say so.
_WITHOUT_GNSS: Final = (2, 3, 7)
_EPOCH_S: Final = 1e9  # a clock that counts from the start of an autopilot never comes there
_V1, _V2 = 0xFE, 0xFD
_HEADS: Final = re.compile(rb"[\xfd\xfe]")
_FAULTS: Final = (struct.error, ValueError, KeyError, IndexError, TypeError, AttributeError)  # of a damaged packet
_STAMP: Final = 8  # bytes of the time before each packet


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Telemetry:
    """Messages of one vehicle in a telemetry log: by name, their `FIELDS` and `received`, seconds since 1970.

    `odometry` has those of `ODOMETRY` and `VISION_POSITION_ESTIMATE` of every component, which most are a companion's.
    """

    source: LogSource
    messages: dict[str, dict[str, Floats]]
    odometry: dict[tuple[str, int], dict[str, Floats]] = field(default_factory=dict)
    notes: tuple[str, ...] = ()


# Fields that are read of each message, as MAVLink's definitions have them; messages of their own are passed over.
FIELDS: Final[Mapping[str, tuple[str, ...]]] = {
    SYSTEM_TIME: ("time_unix_usec", "time_boot_ms"),
    GPS_RAW: ("time_usec", "fix_type", "lat", "lon", "alt", "h_acc"),
    GPS_SECOND: ("time_usec", "fix_type", "lat", "lon", "alt", "h_acc"),
    POSITION: ("time_boot_ms", "lat", "lon", "alt", "relative_alt"),
    ATTITUDE: ("time_boot_ms", "yaw", "pitch", "roll"),
    ODOMETRY: ("time_usec", "estimator_type", "x", "y", "z", "q[0]", "q[1]", "q[2]", "q[3]", "reset_counter"),
    VISION: ("usec", "x", "y", "z", "roll", "pitch", "yaw", "reset_counter"),
}
_PLACES: Final = (GPS_RAW, POSITION)


def read_telemetry(path: Path, *, vehicle: int | None = None) -> Telemetry:
    """Read the messages of one vehicle out of a telemetry log.

    Parameters
    ----------
    path : Path
        Packets of MAVLink 1 or 2, each behind the time at which it was received, of 2 GiB at most.
    vehicle : int, optional
        System id; needed where several vehicles send places.

    Returns
    -------
    Telemetry
        Of the component that sends places: the autopilot, if it does.

    Raises
    ------
    ConfigError
        If pymavlink is not installed.
    FlightError
        If the file is missing, too large or no such log, or it holds several vehicles and none is chosen.
    """
    try:
        from pymavlink.dialects.v20 import common  # type: ignore[import-untyped] # noqa: PLC0415 - only where installed
    except ImportError as error:
        raise ConfigError("a telemetry log needs the package pymavlink: pip install 'sasgeo-bench[logs]'") from error
    source = LogSource(path=path, unit="fix")
    source.check_size(MOST_LOG_BYTES)
    numbers = {getattr(common, f"MAVLINK_MSG_ID_{name}"): name for name in FIELDS}
    attributes = {name: dict.fromkeys(one.partition("[")[0] for one in fields) for name, fields in FIELDS.items()}
    link = common.MAVLink(None)
    rows: Rows = {}
    damaged = 0
    with library(source, (OSError,)), _mapped(path) as content:
        packets = _Packets(content)
        for stamp_us, packet, number, system, component in packets:
            name = numbers.get(number)
            if name is None:
                continue
            try:
                message = link.decode(bytearray(packet))
            except (common.MAVError, *_FAULTS):
                damaged += 1
                continue
            values = [getattr(message, one) for one in attributes[name]]
            row = rows.setdefault((system, component, name), array("d"))
            row.append(stamp_us / 1e6)
            for value in values:
                row.extend(value) if isinstance(value, list) else row.append(value)
    system, component = _vehicle_of(source, rows, vehicle)
    tables = {(name, by): _columns(name, row) for (one, by, name), row in rows.items() if one == system}
    messages = {name: columns for (name, by), columns in tables.items() if by == component}
    odometry = {key: columns for key, columns in sorted(tables.items()) if key[0] in (ODOMETRY, VISION)}
    notes: tuple[str, ...] = (f"vehicle {system}, component {component}",)
    if damaged or packets.skipped:
        notes += (f"damaged: {damaged} messages and {packets.skipped} bytes beside that are passed over",)
    if packets.is_cut:
        notes += ("cut off: the file ends within a message, and is read up to there",)
    return Telemetry(source=source, messages=messages, odometry=odometry, notes=notes)


def _columns(name: str, row: "array[float]") -> dict[str, Floats]:
    fields = ("received", *FIELDS[name])
    return dict(zip(fields, np.array(row).reshape(-1, len(fields)).T, strict=True))


@contextmanager
def _mapped(path: Path) -> Iterator[mmap.mmap | bytes]:
    """Map a file, so that no more of it is in memory than the system likes; an empty one cannot be."""
    with plain_file(path).open("rb") as file:
        if not path.stat().st_size:
            yield b""
            return
        with mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as content:
            yield content


def _vehicle_of(source: LogSource, rows: Rows, vehicle: int | None) -> tuple[int, int]:
    """Return system and component of the vehicle that is read: the one that sends places, or the one that is chosen."""
    systems = sorted({system for system, _, name in rows if name in _PLACES})
    if not systems:
        raise source.fault(f"no place: no message of {' or '.join(_PLACES)}: a flight needs fixes of a receiver")
    there = ", ".join(map(str, systems))
    if vehicle is None and len(systems) > 1:
        raise source.fault(f"vehicles {there} send places: say which one, as in --vehicle {systems[0]}")
    if vehicle is not None and vehicle not in systems:
        raise source.fault(f"vehicle {vehicle} sends no places, {there} do: say --vehicle {systems[0]}")
    system = systems[0] if vehicle is None else vehicle
    return system, min(component for one, component, name in rows if one == system and name in _PLACES)


@dataclass(slots=True)
class _Packets:
    """Packets of a telemetry log, with time, message, system and component; what is none is skipped and counted."""

    content: mmap.mmap | bytes
    skipped: int = 0
    is_cut: bool = False

    def __iter__(self) -> Iterator[tuple[int, bytes, int, int, int]]:
        content, at, end = self.content, 0, len(self.content)
        while at + _STAMP < end:
            start = at + _STAMP
            length = _length(content, start)
            after = start + length
            # one that is followed by no other is none, but at the end
            if not length or (after < end and not _begins(content, after)):
                following = _HEADS.search(content, start + 1)
                begin = end - _STAMP if following is None else following.start() - _STAMP
                at, self.skipped = begin, self.skipped + begin - at
                continue
            if after > end:
                self.is_cut = True
                return
            packet = content[start:after]
            stamp_us = int.from_bytes(content[at:start], "big")
            if packet[0] == _V1:
                yield stamp_us, packet, packet[5], packet[3], packet[4]
            else:
                yield stamp_us, packet, int.from_bytes(packet[7:10], "little"), packet[5], packet[6]
            at = after
        self.is_cut = at < end


def _length(content: mmap.mmap | bytes, start: int) -> int:
    """Return how many bytes the packet at a place has; 0 if none begins there."""
    if content[start] == _V1:
        return content[start + 1] + 8 if start + 1 < len(content) else 8
    if content[start] == _V2:
        if start + 2 >= len(content):
            return 12
        return content[start + 1] + 12 + 13 * (content[start + 2] & 1)  # bytes of a signature
    return 0


def _begins(content: mmap.mmap | bytes, at: int) -> bool:
    """Return whether a packet begins behind a time there, or the log ends within it."""
    return at + _STAMP >= len(content) or content[at + _STAMP] in (_V1, _V2)


def read_tlog(path: Path, *, vehicle: int | None = None) -> FlightLog:
    """Read the flight of one vehicle of a telemetry log; raise `FlightError` as `read_telemetry` does."""
    telemetry = read_telemetry(path, vehicle=vehicle)
    return flight_of(telemetry.source, streams_of(telemetry))


def streams_of(telemetry: Telemetry) -> Streams:
    """Return what a flight is made of, out of the messages of a vehicle."""
    source, messages = telemetry.source, telemetry.messages
    found = _receivers(telemetry)
    position, heights = messages.get(POSITION), None
    if position is not None:
        time_s = position["time_boot_ms"] / 1e3
        places = (position["lon"] / 1e7, position["lat"] / 1e7, position["alt"] / 1e3)
        found.append(Fixes.of(source, POSITION, time_s, places, np.ones(len(time_s), dtype=bool), is_estimate=True))
        name = f"{POSITION}.relative_alt"
        heights = Stream.of(source, name, time_s, position["relative_alt"][:, None] / 1e3)
    fixes, notes = first_with_fixes(source, found, " or ".join(_PLACES))
    return Streams(
        fixes=fixes,
        heights=heights,
        attitudes=attitudes_of(telemetry),
        clock=_utc(messages),
        notes=(*notes, *telemetry.notes),
    )


def _receivers(telemetry: Telemetry) -> list[Fixes]:
    source, found = telemetry.source, []
    for name in (GPS_RAW, GPS_SECOND):
        if (gps := telemetry.messages.get(name)) is None:
            continue
        time_s = _on_boot(telemetry.messages, gps["time_usec"] / 1e6, gps["received"])
        places = (gps["lon"] / 1e7, gps["lat"] / 1e7, gps["alt"] / 1e3)
        is_fix = gps["fix_type"] >= LEAST_FIX
        stated = stated_of(source, name, time_s[is_fix], gps["h_acc"][is_fix] / 1e3)
        found.append(Fixes.of(source, name, time_s, places, is_fix, stated=stated))
    return found


def read_receivers(path: Path, *, vehicle: int | None = None) -> list[Fixes]:
    """Read the receivers of a vehicle, in the order in which one is taken for the truth."""
    return _receivers(read_telemetry(path, vehicle=vehicle))


def fixes_of(telemetry: Telemetry) -> tuple[Fixes, tuple[str, ...]]:
    """Return the fixes of the receiver; raise `FlightError` if there are none."""
    return first_with_fixes(telemetry.source, _receivers(telemetry), GPS_RAW)


def attitudes_of(telemetry: Telemetry) -> Stream | None:
    """Return the attitudes of the vehicle; none if it sent none."""
    attitude = telemetry.messages.get(ATTITUDE)
    if attitude is None:
        return None
    turns = quaternions_of_angles(*(np.degrees(attitude[name]) for name in ("yaw", "pitch", "roll")))
    return Stream.of(telemetry.source, ATTITUDE, attitude["time_boot_ms"] / 1e3, turns)


def estimates_of(telemetry: Telemetry) -> list[Estimate]:
    """Return what may be odometry: poses that a camera's or a lidar's estimator sent.

    Raise `FlightError` if all that was sent fused a receiver, or does not say that it did not.
    """
    found, refused = [], []
    for (name, component), columns in telemetry.odometry.items():
        called = f"{name} of component {component}"
        if name == ODOMETRY:
            is_free = np.isin(columns["estimator_type"], _WITHOUT_GNSS)
            if not is_free.all():
                refused.append(f"{called} (estimator_type {columns['estimator_type'][~is_free][0]:.0f})")
                continue
            turns = quaternions_of_ned(*(columns[f"q[{at}]"] for at in range(4)))
        else:
            turns = quaternions_of_angles(*(np.degrees(columns[key]) for key in ("yaw", "pitch", "roll")))
        own_s = columns["time_usec" if name == ODOMETRY else "usec"] / 1e6
        time_s = _on_boot(telemetry.messages, own_s, columns["received"], is_own=False)
        poses = np.column_stack([columns["x"], columns["y"], columns["z"], turns])
        stream = Stream.of(telemetry.source, called, time_s, poses)
        found.append(Estimate(poses=stream, resets_s=resets_of(time_s, columns["reset_counter"])))
    if not found:
        why = f"{', '.join(refused)} may have fused GNSS" if refused else f"neither {ODOMETRY} nor {VISION} was sent"
        raise telemetry.source.fault(
            f"no odometry: {why}, and telemetry does not say when the autopilot did: take its own log"
        )
    return found


def read_odometry(path: Path, *, vehicle: int | None = None) -> LoggedOdometry:
    """Read the odometry that a vehicle's companion sent; raise `FlightError` if there is none, or no fixes."""
    telemetry = read_telemetry(path, vehicle=vehicle)
    return LoggedOdometry.of(
        telemetry.source, fixes_of(telemetry), estimates_of(telemetry), attitudes_of(telemetry), telemetry.notes
    )


def _booted(messages: Mapping[str, Columns]) -> tuple[Floats, Floats]:
    """Return when messages were received, and the autopilot's own time in them, seconds, in order."""
    pairs = [(one["received"], one["time_boot_ms"] / 1e3) for one in messages.values() if "time_boot_ms" in one]
    received, boot = (np.concatenate([pair[at] for pair in pairs] or [np.empty(0)]) for at in (0, 1))
    order = np.argsort(received, kind="stable")
    return received[order], boot[order]


def _on_boot(messages: Mapping[str, Columns], own_s: Floats, received: Floats, *, is_own: bool = True) -> Floats:
    """Return times on the autopilot's own clock, which messages count by, or from 1970, or by a clock of their own."""
    others, boot_s = _booted(messages)
    if not len(others):
        return own_s if (own_s > 0).all() else received
    arrived_s = np.interp(received, others, boot_s)
    if not (own_s > 0).all():
        return arrived_s
    is_other = not is_own or (own_s > _EPOCH_S).all()
    return own_s - float(np.median(own_s - arrived_s)) if is_other else own_s


def _utc(messages: Mapping[str, Columns]) -> Clock | None:
    """Return UTC by the autopilot, which has it of its receiver; else by the ground station's clock."""
    told = messages.get(SYSTEM_TIME)
    if told is not None and (is_told := told["time_unix_usec"] > _EPOCH_S * 1e6).any():
        return Clock(
            name=f"time_unix_usec of {SYSTEM_TIME}",
            time_s=told["time_boot_ms"][is_told] / 1e3,
            utc_s=told["time_unix_usec"][is_told] / 1e6,
        )
    received, boot_s = _booted(messages)
    if not len(received):
        return None
    return Clock(name="the ground station, as it received messages", time_s=boot_s, utc_s=received)
