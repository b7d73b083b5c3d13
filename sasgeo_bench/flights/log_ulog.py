# SPDX-License-Identifier: Apache-2.0
"""ULog, the log of PX4: where the receiver was, and what the estimator made of it.

Which topic is read, in this order: `vehicle_gps_position`, `sensor_gps`, and only where neither has fixes the estimate
`vehicle_global_position`; of each the first instance with two fixes in three dimensions. Heights count from the home
position, which PX4 sets on take-off. https://docs.px4.io/main/en/dev_log/ulog_file_format.html
"""

import io
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from sasgeo_bench.core.errors import ConfigError, FlightError
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
    free_stretches,
    known_fields,
    library,
    quaternions_of_ned,
    resets_of,
    seen_at,
    stated_of,
)
from sasgeo_bench.flights.log_units import LEAST_FIX

Floats = NDArray[np.float64]
Columns = Mapping[str, NDArray[Any]]

RECEIVERS: Final = ("vehicle_gps_position", "sensor_gps")
_ESTIMATE: Final = "vehicle_global_position"
PLACES: Final = (*RECEIVERS, _ESTIMATE)
_LOCAL: Final = "vehicle_local_position"
_HOME: Final = "home_position"
_LANDED: Final = "vehicle_land_detected"
VISUAL: Final = "vehicle_visual_odometry"
_FLAGS: Final = ("estimator_status_flags", "estimator_status")
# Of a receiver's position, heading and velocity, and of an auxiliary global position, under all their names.
FUSING: Final = ("cs_gps", "cs_gnss_pos", "cs_gps_yaw", "cs_gnss_yaw", "cs_gnss_vel", "cs_aux_gpos")
_FUSING_BITS: Final = (2, 22, 38, 44)  # https://docs.px4.io/main/en/msg_docs/EstimatorStatus
_ATTITUDE: Final = "vehicle_attitude"
TOPICS: Final = (*PLACES, _LOCAL, _HOME, _LANDED, _ATTITUDE)
OF_DRIFT: Final = (*RECEIVERS, _LOCAL, _ATTITUDE, VISUAL, *_FLAGS)
_E7: Final = 1e7


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Topics:
    """Topics of a ULog file by name and instance, and what is to be said of the file."""

    source: LogSource
    topics: dict[tuple[str, int], Columns]
    notes: tuple[str, ...] = ()

    def instances(self, name: str) -> Iterator[tuple[str, Columns]]:
        """Yield the instances of a topic that have messages, with their names."""
        for (topic, number), columns in sorted(self.topics.items()):
            if topic == name and len(columns["timestamp"]):
                yield f"{name} {number}", columns

    def first(self, name: str) -> tuple[str, Columns] | None:
        """Return the first instance of a topic; none if the log has none."""
        return next(self.instances(name), None)


class _Watched(io.BufferedReader):
    """A file that remembers whether it ended within a message; a whole one ends where the next head would be."""

    is_cut = False

    def read(self, size: int | None = -1, /) -> bytes:
        data = super().read(size)
        if size is not None and len(data) < size and (data or size > 3):  # bytes of a head
            self.is_cut = True
        return data


def read_topics(path: Path, names: tuple[str, ...]) -> Topics:
    """Read topics of a ULog file.

    Parameters
    ----------
    path : Path
        Of 2 GiB at most. Topics that are not named are passed over.
    names : tuple of str
        Topics.

    Returns
    -------
    Topics
        A file that was cut off is read as far as it goes, which a note says, as one does of dropouts.

    Raises
    ------
    ConfigError
        If pyulog is not installed.
    FlightError
        If the file is missing, too large, or no ULog.
    """
    try:
        from pyulog import ULog  # type: ignore[import-untyped] # noqa: PLC0415 - only where it is installed
    except ImportError as error:
        raise ConfigError("a ULog needs the package pyulog: pip install 'sasgeo-bench[logs]'") from error
    source = LogSource(path=path, unit="fix")
    source.check_size(MOST_LOG_BYTES)
    with library(source, (Exception,)):  # its own are in no place of all versions
        # Times of dropouts are wrong where topics are chosen (pyulog 1.3.0), so that only their lengths are told of.
        with _Watched(io.FileIO(plain_file(path))) as file:
            log = ULog(file, list(names))
        topics = {(one.name, int(one.multi_id)): one.data for one in log.data_list}
    notes = []
    lengths_s = [one.duration / 1e3 for one in log.dropouts]
    if lengths_s:
        notes.append(
            f"dropouts: {len(lengths_s)}, {sum(lengths_s):.1f} s in all, the longest {max(lengths_s):.1f} s, in which "
            "nothing was logged"
        )
    if file.is_cut:
        notes.append("cut off: the file ends within a message, and is read up to there")
    if log.file_corruption:
        notes.append("damaged: messages that cannot be read are passed over")
    return Topics(source=source, topics=topics, notes=tuple(notes))


def read_ulog(path: Path) -> FlightLog:
    """Read the flight of a ULog file; raise `FlightError` if it has no places, or is not sound."""
    topics = read_topics(path, TOPICS)
    try:
        with known_fields(topics.source):
            streams = streams_of(topics)
        return flight_of(topics.source, streams)
    except FlightError as error:
        if topics.notes:  # they may be the cause
            raise FlightError(f"{error} ({'; '.join(topics.notes)})") from error
        raise


def read_receivers(path: Path) -> list[Fixes]:
    """Read the receivers of a ULog file, in the order in which one is taken for the truth."""
    return receivers_of(read_topics(path, RECEIVERS))


def receivers_of(topics: Topics) -> list[Fixes]:
    """Return the receivers of a ULog file, in the order in which one is taken for the truth."""
    with known_fields(topics.source):
        return [_fixes(topics.source, *one) for name in RECEIVERS for one in topics.instances(name)]


def fixes_of(topics: Topics) -> tuple[Fixes, tuple[str, ...]]:
    """Return the fixes of the first receiver that has two, else of the estimate, and a note on the others."""
    source, receivers = topics.source, receivers_of(topics)
    estimates = [_estimated(source, *one) for one in topics.instances(_ESTIMATE)]
    return first_with_fixes(source, [*receivers, *estimates], f"{', '.join(RECEIVERS)} or {_ESTIMATE}")


def streams_of(topics: Topics) -> Streams:
    """Return what a flight is made of, out of the topics of a ULog file."""
    fixes, notes = fixes_of(topics)
    heights = _heights(topics)
    if heights is None:
        notes += (f"no height: neither {_HOME} nor a take-off tells what {_LOCAL} counts from",)
    return Streams(
        fixes=fixes,
        heights=heights,
        attitudes=attitudes_of(topics),
        clock=_clock(topics, fixes.track.name),
        notes=(*notes, *topics.notes),
    )


def seconds(columns: Columns) -> Floats:
    """Return the times of a topic in seconds since the start of the autopilot."""
    return np.asarray(columns["timestamp"], dtype=np.float64) / 1e6


def attitudes_of(topics: Topics) -> Stream | None:
    """Return the attitudes of the vehicle; none if they are not logged."""
    found = topics.first(_ATTITUDE)
    if found is None or "q[3]" not in found[1]:
        return None
    name, columns = found
    turns = quaternions_of_ned(*(columns[f"q[{at}]"] for at in range(4)))
    return Stream.of(topics.source, name, seconds(columns), turns)


def _fixes(source: LogSource, name: str, columns: Columns) -> Fixes:
    """Return the fixes of a receiver: degrees from PX4 1.14 on, before integers of 1e-7 degrees and of millimetres."""
    if "latitude_deg" in columns:
        places = (columns["longitude_deg"], columns["latitude_deg"], columns["altitude_msl_m"])
    else:
        lon, lat, alt = (np.asarray(columns[key], dtype=np.float64) for key in ("lon", "lat", "alt"))
        places = (lon / _E7, lat / _E7, alt / 1e3)
    time_s, is_fix = seconds(columns), np.asarray(columns["fix_type"]) >= LEAST_FIX
    accuracy_m = np.asarray(columns.get("eph", np.full(len(time_s), np.nan)), dtype=np.float64)
    stated = stated_of(source, name, time_s[is_fix], accuracy_m[is_fix])
    return Fixes.of(source, name, time_s, places, is_fix, stated=stated)


def _estimated(source: LogSource, name: str, columns: Columns) -> Fixes:
    is_valid = np.asarray(columns.get("lat_lon_valid", np.ones(len(columns["timestamp"]))), dtype=bool)
    places = (columns["lon"], columns["lat"], columns["alt"])
    return Fixes.of(source, name, seconds(columns), places, is_valid, is_estimate=True)


def _heights(topics: Topics) -> Stream | None:
    """Return heights above the home position, or above where the vehicle took off; none if neither is known."""
    found = topics.first(_LOCAL)
    if found is None:
        return None
    name, columns = found
    time_s, z_m = seconds(columns), np.asarray(columns["z"], dtype=np.float64)
    z_m = np.where(np.asarray(columns.get("z_valid", np.ones(len(z_m))), dtype=bool), z_m, np.nan)
    for other, base in topics.instances(_HOME):
        if "z" in base:
            at = np.searchsorted(seconds(base), time_s, side="right") - 1  # home may be set again
            ground_m = np.asarray(base["z"], dtype=np.float64)[np.maximum(at, 0)]
            return Stream.of(topics.source, f"{name} less {other}", time_s, (ground_m - z_m)[:, None])
    for other, landed in topics.instances(_LANDED):
        starts_s = seconds(landed)[1:][np.diff(np.asarray(landed["landed"], dtype=np.int8)) < 0]
        before = np.flatnonzero(np.isfinite(z_m) & (time_s <= starts_s[0])) if len(starts_s) else starts_s
        if len(before):
            ground_m = z_m[int(before[-1])]
            return Stream.of(topics.source, f"{name} from take-off by {other}", time_s, (ground_m - z_m)[:, None])
    return None


def estimates_of(topics: Topics) -> list[Estimate]:
    """Return what may be odometry: a camera's poses, else the estimator's own.

    Raise `FlightError` if the log does not say when the estimator fused a receiver.
    """
    found = []
    for name, columns in topics.instances(VISUAL):
        is_old = "x" in columns  # before PX4 1.14
        keys = ["x", "y", "z"] if is_old else [f"position[{at}]" for at in range(3)]
        turns = quaternions_of_ned(*(columns[f"q[{at}]"] for at in range(4)))
        poses = np.column_stack([*(columns[key] for key in keys), turns])
        time_s = seconds(columns)
        if "timestamp_sample" in columns:
            time_s = seen_at(time_s, np.asarray(columns["timestamp_sample"], dtype=np.float64) / 1e6)
        stream = Stream.of(topics.source, name, time_s, poses)
        found.append(Estimate(poses=stream, resets_s=_resets(time_s, columns, "reset_counter")))
    local = topics.first(_LOCAL)
    if found or local is None:
        return found
    name, columns = local
    free_s, fused = _without_receiver(topics)
    is_valid = np.asarray(columns.get("xy_valid", np.ones(len(columns["timestamp"]))), dtype=bool)
    poses = np.column_stack([columns[key] for key in ("x", "y", "z")])
    stream = Stream.of(topics.source, name, seconds(columns)[is_valid], poses[is_valid])
    resets_s = _resets(seconds(columns), columns, "xy_reset_counter")
    return [Estimate(poses=stream, free_s=free_s, fused=fused, resets_s=resets_s)]


def _resets(time_s: Floats, columns: Columns, name: str) -> Floats:
    return resets_of(time_s, *([columns[name]] if name in columns else []))


def read_odometry(path: Path) -> LoggedOdometry:
    """Read the odometry of a ULog file; raise `FlightError` if it has none, or no fixes of a receiver."""
    return odometry_of(read_topics(path, OF_DRIFT))


def odometry_of(topics: Topics) -> LoggedOdometry:
    """Return the odometry in the topics `OF_DRIFT`, as `read_odometry` does."""
    with known_fields(topics.source):
        return LoggedOdometry.of(
            topics.source, fixes_of(topics), estimates_of(topics), attitudes_of(topics), topics.notes
        )


def _without_receiver(topics: Topics) -> tuple[tuple[tuple[float, float], ...], str]:
    """Return when no instance of the estimator fused a receiver, and what tells so."""
    found: list[tuple[Floats, NDArray[np.bool_]]] = []
    name = ""
    for name in _FLAGS:
        for _, columns in topics.instances(name):
            if "control_mode_flags" in columns:
                told = np.asarray(columns["control_mode_flags"]).astype(np.uint64)
                is_fused = (told & np.uint64(sum(1 << bit for bit in _FUSING_BITS))) > 0
            else:
                named = [np.asarray(columns[key], dtype=bool) for key in FUSING if key in columns]
                is_fused = np.logical_or.reduce(named) if named else np.ones(len(columns["timestamp"]), dtype=bool)
            found.append((seconds(columns), is_fused))
        if found:
            break
    if not found:
        raise topics.source.fault(
            f"{' and '.join(_FLAGS)} are not logged, so nobody knows when {_LOCAL} fused GNSS: it is no odometry; log "
            "them, or take a profile"
        )
    return free_stretches(found), name


def _clock(topics: Topics, first: str) -> Clock | None:
    """Return UTC by the receiver that is read, else by another; `time_ref_utc` is an offset of the pilot's choice."""
    receivers = dict(one for name in RECEIVERS for one in topics.instances(name))
    for name in sorted(receivers, key=lambda name: name != first):
        utc_us = np.asarray(receivers[name].get("time_utc_usec", np.empty(0)), dtype=np.float64)
        is_known = utc_us > 0
        if is_known.any():
            time_s = seconds(receivers[name])[is_known]
            return Clock(name=f"time_utc_usec of {name}", time_s=time_s, utc_s=utc_us[is_known] / 1e6)
    return None
