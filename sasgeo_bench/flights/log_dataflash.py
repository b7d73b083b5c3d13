# SPDX-License-Identifier: Apache-2.0
"""DataFlash, the log of ArduPilot, binary or text.

Which message is read: `GPS` of the first instance with two fixes in three dimensions (`GPS2` of old logs is the
second), height `POS.RelHomeAlt`, attitude `ATT`. https://ardupilot.org/copter/docs/logmessages.html
"""

import os
from array import array
from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from sasgeo_bench.core.errors import ConfigError
from sasgeo_bench.core.paths import plain_file
from sasgeo_bench.flights.leap_seconds import GPS_EPOCH_S, WEEK_S, utc_of_gps
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
    free_stretches,
    known_fields,
    library,
    quaternions_of_angles,
    resets_of,
    seen_at,
    stated_of,
)
from sasgeo_bench.flights.log_units import LEAST_FIX

Floats = NDArray[np.float64]
Columns = Mapping[str, Floats]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Messages:
    """Messages of a DataFlash log by name, a column for each field that is a number."""

    source: LogSource
    messages: dict[str, dict[str, Floats]]
    notes: tuple[str, ...] = ()
    parameters: dict[str, float] = field(default_factory=dict)

    def instances(self, name: str, field: str = "I") -> Iterator[tuple[str, dict[str, Floats]]]:
        """Yield the messages of a name, split by the field that numbers instances, in its order."""
        columns = self.messages.get(name, {})
        numbers = columns.get(field)
        if numbers is None:
            if columns:
                yield name, columns
            return
        found = np.unique(numbers).tolist()
        for number in found:
            is_it = numbers == number if len(found) > 1 else slice(None)
            yield f"{name} {number:.0f}", {key: values[is_it] for key, values in columns.items()}


def read_messages(path: Path, names: Sequence[str], fields: Collection[str] | None = None) -> Messages:
    """Read messages of a DataFlash log, binary or text.

    Parameters
    ----------
    path : Path
        Of 2 GiB at most.
    names : sequence of str
        Messages; others are passed over.
    fields : collection of str, optional
        Fields of any of them; by default all that are numbers.

    Returns
    -------
    Messages
        In the units of the log's documentation: degrees, metres. A file that was cut off is read up to there.

    Raises
    ------
    ConfigError
        If pymavlink is not installed.
    FlightError
        If the file is missing, too large, or no such log.
    """
    try:
        from pymavlink import DFReader  # type: ignore[import-untyped] # noqa: PLC0415 - only where it is installed
    except ImportError as error:
        raise ConfigError("a DataFlash log needs the package pymavlink: pip install 'sasgeo-bench[logs]'") from error
    source = LogSource(path=path, unit="fix")
    source.check_size(MOST_LOG_BYTES)
    with library(source, (Exception,)), _silent():  # which it raises as such
        with plain_file(path).open("rb") as file:
            head = file.read(64)
        if head.startswith(b"ULog"):
            raise source.fault("a ULog by its first bytes, no DataFlash: rename it to .ulg")
        if not head.startswith(bytes((0xA3, 0x95))):
            if b"\0" in head:
                raise source.fault("no DataFlash by its first bytes: copy it anew, or name it by its own suffix")
            reader = DFReader.DFReader_text(str(path))
            return Messages(source=source, messages=_of_text(reader, names, fields), parameters=dict(reader.params))
        with DFReader.DFReader_binary(str(path)) as reader:
            found = {name: columns for name in names if (columns := _of_binary(reader, name, fields))}
            notes, parameters = tuple(_damages(reader)), dict(reader.params)
    return Messages(source=source, messages=found, notes=notes, parameters=parameters)


@contextmanager
def _silent() -> Iterator[None]:
    """Shut the descriptor of errors: the library's compiled part prints a line for each byte that it skips."""
    kept, nothing = os.dup(2), os.open(os.devnull, os.O_WRONLY)
    try:
        os.dup2(nothing, 2)
        yield
    finally:
        os.dup2(kept, 2)
        os.close(kept)
        os.close(nothing)


def _of_binary(
    reader: Any,  # noqa: ANN401 - of a library without types
    name: str,
    fields: Collection[str] | None,
) -> dict[str, Floats]:
    """Return all messages of one name at once: the library knows where each lies, and their format."""
    if name not in reader.name_to_id:
        return {}
    number = reader.name_to_id[name]
    layout = reader.formats[number]
    kinds = [f"<{kind}" if kind[-1] != "s" else f"S{kind[:-1]}" for kind in _kinds(layout.msg_struct)]
    row = np.dtype([(column, kind) for column, kind in zip(layout.columns, kinds, strict=True)])
    content = np.frombuffer(reader.data_map, dtype=np.uint8)
    starts = np.array(reader.offsets[number], dtype=np.int64) + 3  # bytes of a head
    starts = starts[starts + row.itemsize <= len(content)]
    if not len(starts):
        return {}
    table = np.lib.stride_tricks.sliding_window_view(content, row.itemsize)[starts].view(row)[:, 0]
    return {
        column: table[column].astype(np.float64) / (1 / factor if factor else 1.0)
        for column, kind, factor in zip(layout.columns, kinds, layout.msg_mults, strict=True)
        if kind[0] != "S" and (fields is None or column in fields)
    }


def _kinds(msg_struct: str) -> list[str]:
    """Return the parts of a `struct` format: '<QB16s' has Q, B and 16s."""
    kinds, digits = [], ""
    for letter in msg_struct.lstrip("<"):
        if letter.isdigit():
            digits += letter
        else:
            kinds.append(digits + letter)
            digits = ""
    return kinds


def _damages(reader: Any) -> Iterator[str]:  # noqa: ANN401 - of a library without types
    """Yield a line if the last message of a log is not whole, and one on bytes between messages."""
    kinds = [at for at, starts in enumerate(reader.offsets) if len(starts)]
    last, number = max((reader.offsets[at][-1], at) for at in kinds)
    end = last + reader.formats[number].len
    rest = bytes(reader.data_map[end:])
    if end > reader.data_len or rest.startswith(bytes((reader.HEAD1, reader.HEAD2))):
        yield "cut off: the file ends within a message, and is read up to there"
    between = end - sum(len(reader.offsets[at]) * reader.formats[at].len for at in kinds)
    if between > 0:
        yield f"damaged: {between} bytes that are no message are passed over"


def _of_text(
    reader: Any,  # noqa: ANN401 - of a library without types
    names: Sequence[str],
    fields: Collection[str] | None,
) -> dict[str, dict[str, Floats]]:
    found: dict[str, array[float]] = {}
    columns: dict[str, list[str]] = {}
    while (message := reader.recv_match(type=list(names))) is not None:
        name = message.get_type()
        if name not in columns:
            wanted = [one for one in message.get_fieldnames() if fields is None or one in fields]
            columns[name] = [one for one in wanted if isinstance(getattr(message, one), int | float)]
        found.setdefault(name, array("d")).extend(float(getattr(message, one)) for one in columns[name])
    return {
        name: dict(zip(columns[name], np.array(values).reshape(-1, len(columns[name])).T, strict=True))
        for name, values in found.items()
    }


FIELDS: Final = frozenset(
    {
        *("TimeUS", "TimeMS", "T", "I", "C", "Status", "GMS", "GWk", "Week", "Lat", "Lng", "Alt", "HAcc", "RelHomeAlt"),
        *("Yaw", "Pitch", "Roll", "PN", "PE", "PD", "SS", "PI", "PX", "PY", "PZ", "R", "P", "Y", "Rst", "CTimeMS"),
        *(f"{what}D{axis}" for what in ("Ang", "Pos") for axis in "XYZ"),
    }
)
OF_DRIFT: Final = ("GPS", "GPS2", "GPA", "ATT", "XKF1", "XKF4", "NKF1", "NKF4", "VISP", "VISO")
# Bits of the status of the filter, and the source that is a receiver: AP_NavEKF, AP_NavEKF_Source of ArduPilot.
_HELD: Final = 7
_USING_GPS: Final = 13
_OF_GPS: Final = 3


def read_dataflash(path: Path) -> FlightLog:
    """Read the flight of a DataFlash log; raise `FlightError` if it has no places, or is not sound."""
    return flight_of(*_read(path))  # the messages are let go before


def _read(path: Path) -> tuple[LogSource, Streams]:
    messages = read_messages(path, ("GPS", "GPS2", "GPA", "POS", "ATT"), FIELDS)
    with known_fields(messages.source):
        return messages.source, _streams_of(messages)


def seconds(columns: Columns) -> Floats:
    """Return the times of a message in seconds since the start of the autopilot; T of old logs, in milliseconds."""
    return columns["TimeUS"] / 1e6 if "TimeUS" in columns else columns["T" if "T" in columns else "TimeMS"] / 1e3


def attitudes_of(messages: Messages) -> Stream | None:
    """Return the attitudes of the vehicle; none if they are not logged."""
    columns = messages.messages.get("ATT")
    if columns is None:
        return None
    turns = quaternions_of_angles(columns["Yaw"], columns["Pitch"], columns["Roll"])
    return Stream.of(messages.source, "ATT", seconds(columns), turns)


def fixes_of(messages: Messages) -> tuple[Fixes, tuple[str, ...]]:
    """Return the fixes of the first receiver that has two, and a note on the others."""
    return first_with_fixes(messages.source, receivers_of(messages), "GPS")


def read_receivers(path: Path) -> list[Fixes]:
    """Read the receivers of a DataFlash log, in the order in which one is taken for the truth."""
    messages = read_messages(path, ("GPS", "GPS2", "GPA"), FIELDS)
    with known_fields(messages.source):
        return receivers_of(messages)


def receivers_of(messages: Messages) -> list[Fixes]:
    """Return the receivers of a DataFlash log, in the order in which one is taken for the truth."""
    source, accuracies = messages.source, dict(messages.instances("GPA"))
    found = []
    for name, columns in (*messages.instances("GPS"), *messages.instances("GPS2")):
        places = (columns["Lng"], columns["Lat"], columns["Alt"])
        of_name = name.replace("GPS", "GPA")
        own = accuracies.get(of_name, {})
        stated = stated_of(source, f"{of_name}.HAcc", seconds(own), own["HAcc"]) if "HAcc" in own else None
        is_fix = columns["Status"] >= LEAST_FIX
        found.append(Fixes.of(source, name, seconds(columns), places, is_fix, stated=stated))
    return found


def estimates_of(messages: Messages) -> list[Estimate]:
    """Return what may be odometry: a camera's poses (`VISP`, else `VISO` summed up), else the estimator's own.

    Raise `FlightError` if the log does not say when the estimator fused a receiver.
    """
    source = messages.source
    if (columns := messages.messages.get("VISP")) is not None:
        turns = quaternions_of_angles(columns["Y"], columns["P"], columns["R"])
        poses = np.column_stack([*(columns[key] for key in ("PX", "PY", "PZ")), turns])
        time_s = seen_at(seconds(columns), columns["CTimeMS"] / 1e3)
        resets_s = resets_of(time_s, columns["Rst"]) if "Rst" in columns else np.empty(0)
        return [Estimate(poses=Stream.of(source, "VISP", time_s, poses), resets_s=resets_s)]
    if (columns := messages.messages.get("VISO")) is not None:
        return [Estimate(poses=Stream.of(source, "VISO", seconds(columns), _summed(columns)))]
    for poses_of, flags_of in (("XKF1", "XKF4"), ("NKF1", "NKF4")):
        cores = dict(messages.instances(poses_of, "C"))
        if not cores:
            continue
        flags = messages.messages.get(flags_of)
        if flags is None or "SS" not in flags:
            raise source.fault(
                f"{flags_of} is not logged, so nobody knows when {poses_of} fused GNSS: it is no odometry; log it, or "
                "take a profile"
            )
        # the core that flew most of the way
        primary = f"{poses_of} {np.median(flags['PI']):.0f}" if "PI" in flags else ""
        name = primary if primary in cores else next(iter(cores))
        _check_sources(messages, name)
        told = [(seconds(one), _is_fused(one["SS"])) for _, one in messages.instances(flags_of, "C")]
        columns = cores[name]
        poses = np.column_stack([columns[key] for key in ("PN", "PE", "PD")])
        stream = Stream.of(source, name, seconds(columns), poses)
        return [Estimate(poses=stream, free_s=free_stretches(told), fused=f"{flags_of}.SS")]
    return []


def _is_fused(status: Floats) -> NDArray[np.bool_]:
    """Return whether a receiver is fused, or the estimate is held in place, which is no odometry either."""
    return np.asarray(status.astype(np.uint32) & (1 << _USING_GPS | 1 << _HELD)) > 0


def read_odometry(path: Path) -> LoggedOdometry:
    """Read the odometry of a DataFlash log; raise `FlightError` if it has none, or no fixes of a receiver."""
    messages = read_messages(path, OF_DRIFT, FIELDS)
    with known_fields(messages.source):
        return LoggedOdometry.of(
            messages.source, fixes_of(messages), estimates_of(messages), attitudes_of(messages), messages.notes
        )


def _check_sources(messages: Messages, name: str) -> None:
    """Raise `FlightError` if the velocity of a receiver is fused where its position is not: no flag tells so."""
    for number in (1, 2, 3):
        place, speed = (messages.parameters.get(f"EK3_SRC{number}_{what}") for what in ("POSXY", "VELXY"))
        if speed == _OF_GPS and place not in (_OF_GPS, None):
            raise messages.source.fault(
                f"{name} fused the velocity of the receiver (EK3_SRC{number}_VELXY 3), and is a copy of the truth in "
                "part, no odometry: take a profile"
            )


def _summed(columns: Columns) -> Floats:
    """Return poses out of steps in the axes of the body before each, from a level one that heads north."""
    turn, place_m = Rotation.identity(), np.zeros(3)
    poses = []
    steps = np.column_stack([columns[f"PosD{axis}"] for axis in "XYZ"])
    angles = Rotation.from_rotvec(np.column_stack([columns[f"AngD{axis}"] for axis in "XYZ"]))
    for at, step_m in enumerate(steps):
        place_m = place_m + turn.apply(step_m)
        turn = turn * angles[at]
        poses.append([*place_m, *turn.as_quat()])
    return np.array(poses)


def _streams_of(messages: Messages) -> Streams:
    fixes, notes = fixes_of(messages)
    height = messages.messages.get("POS", {})
    heights = None
    if "RelHomeAlt" in height:
        heights = Stream.of(messages.source, "POS.RelHomeAlt", seconds(height), height["RelHomeAlt"][:, None])
    return Streams(
        fixes=fixes,
        heights=heights,
        attitudes=attitudes_of(messages),
        clock=_clock(messages, fixes.track.name),
        notes=(*notes, *messages.notes),
    )


def _clock(messages: Messages, first: str) -> Clock | None:
    """Return UTC by weeks of the receiver that is read, else of another; one without a week does not know it yet."""
    receivers = dict((*messages.instances("GPS"), *messages.instances("GPS2")))
    for name in sorted(receivers, key=lambda name: name != first):
        columns = receivers[name]
        week, ms = (columns.get(new, columns.get(old)) for new, old in (("GWk", "Week"), ("GMS", "TimeMS")))
        if week is None or ms is None or not (week > 0).any():
            continue
        gps_s = week[week > 0] * WEEK_S + ms[week > 0] / 1e3
        utc_s = utc_of_gps(gps_s)
        leaps = round(float(GPS_EPOCH_S + gps_s[0] - utc_s[0]))
        called = f"weeks of {name} less {leaps} leap seconds"
        return Clock(name=called, time_s=seconds(columns)[week > 0], utc_s=utc_s)
    return None
