# SPDX-License-Identifier: Apache-2.0
"""Streams of an autopilot's log: fixes of a receiver, heights and attitudes, each at times of its own, made one flight.

A log of an autopilot has one message for each sensor or estimate. The place of the drone is what its receiver says,
where the log has that: an estimate may be a copy of it, or drift. Everything else is read at the times of the fixes.
"""

import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, redirect_stderr, redirect_stdout
from dataclasses import dataclass, field, replace
from io import StringIO
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation, Slerp

from sasgeo_bench.core.errors import FlightError, counted
from sasgeo_bench.core.texts import message_of
from sasgeo_bench.flights.log_points import AltitudeOf, FlightLog, LogSource, altitude_note, tell_left_out
from sasgeo_bench.flights.log_units import LOWEST_M

Floats = NDArray[np.float64]
Bools = NDArray[np.bool_]

MOST_LOG_BYTES: Final = 2 * 2**30  # its readers keep no more than the streams they need

_MOST_APART_S: Final = 1.0  # from a fix to a height or an attitude that is its own
_BEYOND_S: Final = 0.1  # two clocks of one computer agree so well
_JUMP_S: Final = 1.0  # of a clock; what is written late is less out of order
_SILENT_S: Final = 5.0  # PX4 sends its flags each second, ArduPilot ten times
_STILL_S: Final = 2.0  # by which two clocks of a flight may part
# North, east, down out of east, north, up; forward, right, down out of forward, left, up.
NED_OF_ENU: Final = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])
_FRD_OF_FLU: Final = np.diag([1.0, -1.0, -1.0])


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Stream:
    """Values of one message over time.

    Parameters
    ----------
    name : str
        Message or topic and its instance, for notes.
    time_s : ndarray, shape (N,)
        Seconds of the log's own clock, in order.
    values : ndarray, shape (N, K)
    """

    name: str
    time_s: Floats
    values: Floats

    @classmethod
    def of(cls, source: LogSource, name: str, time_s: Floats, values: Floats) -> "Stream":
        """Return a stream in the order of time; messages of one time keep the first.

        Raises
        ------
        FlightError
            If its clock goes back by more than a second.
        """
        time_s, values = np.asarray(time_s, dtype=np.float64), np.asarray(values, dtype=np.float64)
        is_known = np.isfinite(time_s)
        time_s, values = time_s[is_known], values[is_known]
        back_s = -np.diff(time_s).min(initial=0.0)
        if back_s > _JUMP_S:
            raise source.fault(
                f"the clock of {name} jumps back by {back_s:.1f} s: the autopilot restarted or set its clock, cut the "
                "log there"
            )
        _, first = np.unique(time_s, return_index=True)
        return cls(name=name, time_s=time_s[first], values=values[first])

    def __len__(self) -> int:
        return len(self.time_s)

    @property
    def rate_hz(self) -> float:
        """Return how many values a second has, by the median of the steps; 0 for fewer than two."""
        return 1 / float(np.median(np.diff(self.time_s))) if len(self) > 1 else 0.0

    def knows(self, time_s: Floats) -> Bools:
        """Return which times lie between values that are within a second of each, or just beyond the ends."""
        if not len(self):
            return np.zeros(len(time_s), dtype=bool)
        next_s = self.time_s[np.minimum(np.searchsorted(self.time_s, time_s), len(self) - 1)]
        last_s = self.time_s[np.maximum(np.searchsorted(self.time_s, time_s, side="right") - 1, 0)]
        beyond_s = np.maximum(last_s - time_s, time_s - next_s)
        is_near = (next_s - time_s <= _MOST_APART_S) & (time_s - last_s <= _MOST_APART_S)
        return np.asarray(is_near & (beyond_s <= _BEYOND_S))

    def at(self, time_s: Floats) -> Floats:
        """Return values by lines between those of the stream, the ends' own beyond, shape (times, K).

        >>> climb = Stream(name="POS", time_s=np.array([0.0, 1.0]), values=np.array([[10.0], [20.0]]))
        >>> climb.at(np.array([0.25, 9.0])).tolist(), climb.knows(np.array([0.25, 9.0])).tolist()
        ([[12.5], [20.0]], [True, False])
        """
        return np.stack([np.interp(time_s, self.time_s, column) for column in self.values.T], axis=1)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Fixes:
    """Places of one receiver, or of an estimate where a log has no receiver's.

    Parameters
    ----------
    track : Stream
        Longitude and latitude, degrees, and altitude, metres (NaN where unknown); fixes alone.
    altitude_of : {"geoid", "ellipsoid", "unknown"}
        What altitudes count from.
    left_out : int
        Messages without a fix.
    is_estimate : bool
        Whether an estimator gave them.
    stated : Stream, optional
        Horizontal accuracy that the receiver states, metres, shape (M, 1), at times of its own; None of one that states
        none.
    """

    track: Stream
    altitude_of: AltitudeOf = "geoid"
    left_out: int = 0
    is_estimate: bool = False
    stated: Stream | None = None

    @property
    def accuracy_m(self) -> float:
        """Return the median of the horizontal accuracy that the receiver states, metres; NaN where it states none."""
        return np.nan if self.stated is None else float(np.median(self.stated.values))

    @classmethod
    def of(
        cls,
        source: LogSource,
        name: str,
        time_s: Floats,
        places: tuple[Floats, Floats, Floats],
        is_fix: Bools,
        **others: object,
    ) -> "Fixes":
        """Return the fixes out of all messages; `places` are longitudes, latitudes and altitudes.

        A place that is none on Earth is no fix, nor is 0, 0.
        """
        table = np.column_stack([np.asarray(one, dtype=np.float64) for one in places])
        is_place = np.isfinite(table[:, :2]).all(axis=1) & (table[:, :2] != 0).any(axis=1)
        is_place &= (np.abs(table[:, 0]) <= 180) & (np.abs(table[:, 1]) <= 90) & np.isfinite(time_s) & is_fix
        track = Stream.of(source, name, np.asarray(time_s, dtype=np.float64)[is_place], table[is_place])
        return cls(track=track, left_out=int((~is_place).sum()), **others)  # type: ignore[arg-type]


def stated_of(source: LogSource, name: str, time_s: Floats, accuracy_m: Floats) -> Stream | None:
    """Return what a receiver states of its fixes, shape (N,), as a stream; None if it states nothing."""
    is_stated = np.isfinite(accuracy_m) & (accuracy_m > 0)
    return Stream.of(source, name, time_s[is_stated], accuracy_m[is_stated][:, None]) if is_stated.any() else None


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Clock:
    """Moments of UTC at times of the log: what a receiver or a computer said."""

    name: str
    time_s: Floats
    utc_s: Floats

    @property
    def offset_s(self) -> float:
        """Return UTC less the time of the log, the median of all moments."""
        return float(np.median(self.utc_s - self.time_s))

    def notes(self) -> Iterator[str]:
        """Yield where UTC is from, and whether it jumps."""
        yield f"clock: UTC by {self.name}"
        off_s = np.abs(self.utc_s - self.time_s - self.offset_s)
        is_off = off_s > _STILL_S
        if is_off.sum() > 0.01 * len(off_s):  # a damaged message is no jump
            yield (
                f"clock: UTC and the log's clock part by {np.median(off_s[is_off]):.1f} s on the way, so one of them "
                "jumps; times are the log's, its start by the median"
            )


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Streams:
    """What a flight is made of.

    Parameters
    ----------
    fixes : Fixes
        Where it was.
    heights : Stream, optional
        Heights above take-off, shape (N, 1), metres.
    attitudes : Stream, optional
        Quaternions x, y, z, w from the body (forward, right, down) to north, east, down.
    clock : Clock, optional
        UTC; none if the log never knew it.
    notes : tuple of str
        What else is to be said: other receivers, dropouts, an end cut off.
    """

    fixes: Fixes
    heights: Stream | None = None
    attitudes: Stream | None = None
    clock: Clock | None = None
    notes: tuple[str, ...] = field(default=())


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Estimate:
    """Poses of an estimator in a log, and when no receiver was fused into them.

    Parameters
    ----------
    poses : Stream
        North, east, down in metres from any place, then quaternions x, y, z, w from the body to that frame, shape
        (N, 7), whose frame may be turned about the vertical; or shape (N, 3) of an estimate whose attitudes are those
        of the vehicle.
    free_s : tuple of pairs of float
        From when to when no receiver was fused, seconds of the log's clock.
    fused : str
        What tells so, for messages: flags, or what kind of estimator it is.
    resets_s : ndarray, shape (R,)
        When the frame of the poses jumped, as the estimator itself counts it.
    """

    poses: Stream
    free_s: tuple[tuple[float, float], ...] = ((-np.inf, np.inf),)
    fused: str = "of a camera"
    resets_s: Floats = field(default_factory=lambda: np.empty(0))

    @property
    def has_attitudes(self) -> bool:
        """Return whether the estimate has attitudes of its own."""
        return bool(self.poses.values.shape[1] > 3)  # a place


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class LoggedOdometry:
    """What a log has of odometry, and of the truth beside it.

    Parameters
    ----------
    source : LogSource
        Of messages.
    fixes : Fixes
        Of a receiver.
    estimate : Estimate
        Without the poses that are not known.
    attitudes : Stream, optional
        Of the vehicle, as `Streams` has them.
    notes : tuple of str
        What else is to be said.
    """

    source: LogSource
    fixes: Fixes
    estimate: Estimate
    attitudes: Stream | None
    notes: tuple[str, ...]

    @classmethod
    def of(
        cls,
        source: LogSource,
        fixes: tuple[Fixes, tuple[str, ...]],
        estimates: Sequence[Estimate],
        attitudes: Stream | None,
        notes: tuple[str, ...],
    ) -> "LoggedOdometry":
        """Return what a log has, of estimates the first; raise `FlightError` if it has none, or none with poses."""
        truth, others = fixes
        if not estimates:
            raise source.fault("holds no odometry: neither poses of a camera nor those of the estimator are logged")
        poses = without_unknown(estimates[0].poses)
        if poses is None:
            raise source.fault(f"{estimates[0].poses.name} has no pose with a place and an attitude: log them")
        return cls(
            source=source,
            fixes=truth,
            estimate=replace(estimates[0], poses=poses),
            attitudes=without_unknown(attitudes),
            notes=(*others, *notes),
        )


def free_stretches(flags: Sequence[tuple[Floats, Bools]]) -> tuple[tuple[float, float], ...]:
    """Return from when to when no instance of an estimator fused a receiver.

    Parameters
    ----------
    flags : sequence of (ndarray, ndarray)
        Of each instance times, seconds, in order, and whether a receiver was fused, both shape (N,).

    Returns
    -------
    tuple of pairs of float
        From the first to the last of flags in a row that say so. Between one that does and one that does not nobody
        knows, nor where none came for five seconds.

    Examples
    --------
    >>> free_stretches([(np.array([0.0, 1.0, 2.0, 3.0, 4.0, 60.0]), np.array([1, 0, 0, 1, 0, 0], dtype=bool))])
    ((1.0, 2.0),)
    """
    time_s = np.unique(np.concatenate([times for times, _ in flags]))
    is_fused = np.zeros(len(time_s), dtype=bool)
    for times, told in flags:  # what an instance said last, and says next
        last = np.maximum(np.searchsorted(times, time_s, side="right") - 1, 0)
        coming = np.minimum(np.searchsorted(times, time_s), len(times) - 1)
        is_fused |= told[last] | told[coming]
    found = []
    edges = np.flatnonzero(np.diff(time_s) > _SILENT_S) + 1
    for part, told in zip(np.split(time_s, edges), np.split(is_fused, edges), strict=True):
        steps = np.diff(np.concatenate([[True], told, [True]]).astype(np.int8))
        starts, ends = np.flatnonzero(steps < 0).tolist(), np.flatnonzero(steps > 0).tolist()
        found += [(float(part[at]), float(part[end - 1])) for at, end in zip(starts, ends, strict=True) if end - at > 1]
    return tuple(found)


def resets_of(time_s: Floats, *counters: Floats) -> Floats:
    """Return when any counter of resets, shape (N,) as the times, changed.

    >>> resets_of(np.array([0.0, 0.1, 0.2]), np.array([3.0, 3.0, 4.0])).tolist()
    [0.2]
    """
    changed = [np.append(False, np.diff(np.asarray(one, dtype=np.float64)) != 0) for one in counters]
    return time_s[np.logical_or.reduce(changed)] if changed else np.empty(0)


def quaternions_of_ned(w: Floats, x: Floats, y: Floats, z: Floats) -> Floats:
    """Return quaternions as streams have them, those of no length as not a number, shape (N, 4)."""
    table = np.column_stack([x, y, z, w]).astype(np.float64)
    length = np.linalg.norm(table, axis=1, keepdims=True)
    return np.asarray(np.divide(table, length, out=np.full_like(table, np.nan), where=np.abs(length - 1) < 0.1))


def quaternions_of_enu(w: Floats, x: Floats, y: Floats, z: Floats) -> Floats:
    """Return quaternions as streams have them out of those of ROS: forward, left, up to east, north, up (REP 103).

    Level and heading east:

    >>> yaw_deg = yaws_deg(quaternions_of_enu(*np.array([[1.0], [0.0], [0.0], [0.0]])))
    >>> yaw_deg.round(6).tolist()
    [90.0]
    """
    table = quaternions_of_ned(w, x, y, z)
    is_known = np.isfinite(table).all(axis=1)
    turns = Rotation.from_quat(table[is_known]).as_matrix() if is_known.any() else np.empty((0, 3, 3))
    turned = np.full_like(table, np.nan)
    if len(turns):
        turned[is_known] = Rotation.from_matrix(NED_OF_ENU @ turns @ _FRD_OF_FLU).as_quat()
    return turned


def quaternions_of_angles(yaw_deg: Floats, pitch_deg: Floats, roll_deg: Floats) -> Floats:
    """Return quaternions as streams have them, shape (N, 4)."""
    angles = np.column_stack([yaw_deg, pitch_deg, roll_deg]).astype(np.float64)
    is_known = np.isfinite(angles).all(axis=1)
    table = np.full((len(angles), 4), np.nan)
    if is_known.any():
        table[is_known] = Rotation.from_euler("ZYX", angles[is_known], degrees=True).as_quat()
    return table


def yaws_deg(quaternion_xyzw: Floats) -> Floats:
    """Return headings clockwise from north, [0, 360), shape (N,)."""
    return np.asarray(Rotation.from_quat(quaternion_xyzw).as_euler("ZYX", degrees=True)[:, 0] % 360.0)


def turned_at(attitudes: Stream, time_s: Floats) -> Rotation:
    """Return attitudes by the shortest turn between those of a stream, those at its ends beyond."""
    whole = Rotation.from_quat(attitudes.values)
    if len(attitudes) == 1:
        return Rotation.from_quat(np.repeat(attitudes.values, len(time_s), axis=0))
    return Slerp(attitudes.time_s, whole)(np.clip(time_s, attitudes.time_s[0], attitudes.time_s[-1]))


def without_unknown(stream: Stream | None) -> Stream | None:
    """Return a stream without the values that are not finite; none if none is left."""
    if stream is None:
        return None
    is_known = np.isfinite(stream.values).all(axis=1)
    if not is_known.any():
        return None
    return Stream(name=stream.name, time_s=stream.time_s[is_known], values=stream.values[is_known])


def flight_of(source: LogSource, streams: Streams) -> FlightLog:
    """Return the flight at the times of its fixes.

    A height or an attitude belongs to a fix between two of its values within a second of it. Where they are
    missing of less than half of the fixes, these are left out and counted; where of more, the quantity is not read.

    Raises
    ------
    FlightError
        If fewer than two fixes are left, or they are no flight (`FlightLog.of`).
    """
    fixes = streams.fixes
    if fixes.left_out:
        tell_left_out(source, fixes.left_out, "without a fix")
    notes = [_place_note(fixes)]
    read, is_kept = _beside(source, streams, notes)
    time_s, table = fixes.track.time_s[is_kept], fixes.track.values[is_kept]
    source.check_count(len(time_s))
    columns: dict[str, Floats] = {"lon_deg": table[:, 0], "lat_deg": table[:, 1], "time_s": time_s - time_s[:1]}
    if np.isfinite(table[:, 2]).all():
        columns["altitude_m"] = table[:, 2]
        notes.append(altitude_note(fixes.altitude_of).partition(",")[0])
    if (heights := read.get("height")) is not None:
        columns["height_m"] = heights.at(time_s)[:, 0]
        notes.append(f"height: {heights.name}, above take-off")
        if (highest_m := columns["height_m"].max(initial=0.0)) < LOWEST_M:
            notes.append(f"the drone stays on the ground: never higher than {highest_m:.1f} m above take-off")
    if (attitudes := read.get("attitude")) is not None:
        columns |= dict(zip(("yaw_deg", "pitch_deg", "roll_deg"), angles_at(attitudes, time_s), strict=True))
        notes.append(f"attitude: {attitudes.name}, yaw from true north")
    start_s = None
    if streams.clock is None or not len(time_s):
        notes.append("clock: seconds of the log's own, UTC is not known")
    else:
        notes += streams.clock.notes()
        start_s = streams.clock.offset_s + float(time_s[0])
    log = FlightLog.of(
        source,
        range(1, len(time_s) + 1),
        columns,
        start_s=start_s,
        altitude_of=fixes.altitude_of,
        notes=(*notes, *streams.notes),
    )
    return replace(log, clock_s=float(time_s[0]))


def angles_at(attitudes: Stream, time_s: Floats) -> tuple[Floats, Floats, Floats]:
    """Return yaw in [0, 360), pitch and roll at times, degrees, in the order of `sensing.camera.Attitude`."""
    with warnings.catch_warnings():  # nose up or down yaw and roll are one angle, and scipy says so
        warnings.simplefilter("ignore", UserWarning)
        angles = turned_at(attitudes, time_s).as_euler("ZYX", degrees=True)
    return angles[:, 0] % 360.0, angles[:, 1], angles[:, 2]


def _beside(source: LogSource, streams: Streams, notes: list[str]) -> tuple[dict[str, Stream], Bools]:
    """Return the streams that are read at the fixes, and which fixes have a value of each."""
    time_s = streams.fixes.track.time_s
    is_kept = np.ones(len(time_s), dtype=bool)
    read: dict[str, Stream] = {}
    for name, whole in (("height", streams.heights), ("attitude", streams.attitudes)):
        stream = without_unknown(whole)
        if stream is None:
            continue
        is_known = stream.knows(time_s)
        if 2 * is_known.sum() <= len(time_s):
            notes.append(f"not read: {stream.name}, which {len(time_s) - is_known.sum()} of {len(time_s)} fixes lack")
            continue
        if (is_kept & ~is_known).any():
            tell_left_out(source, int((is_kept & ~is_known).sum()), f"without a value of {stream.name}")
        is_kept &= is_known
        read[name] = stream
    return read, is_kept


def _place_note(fixes: Fixes) -> str:
    kind = "an estimate that fused the receiver, as the log has no fixes of it" if fixes.is_estimate else "fixes"
    accuracy = f", accuracy {fixes.accuracy_m:.1f} m (median)" if np.isfinite(fixes.accuracy_m) else ""
    return f"place: {fixes.track.name}, {kind}, {fixes.track.rate_hz:.3g} Hz{accuracy}"


def first_with_fixes(source: LogSource, candidates: Sequence[Fixes], what: str) -> tuple[Fixes, tuple[str, ...]]:
    """Return the first candidate that has two fixes, and a note on the receivers that are not read.

    Raises
    ------
    FlightError
        If none has: `what` names the messages that were looked for.
    """
    read = next((one for one in candidates if len(one.track) >= 2), None)
    if read is None:
        tried = sum(one.left_out for one in candidates)
        why = f"{counted(tried, 'message')} without a fix" if tried else f"no message of {what}"
        raise source.fault(f"no place: {why}: a flight needs two fixes of a receiver at least")
    others = [one.track.name for one in candidates if one is not read and len(one.track)]
    return read, ((f"not read: {', '.join(others)}",) if others else ())


@contextmanager
def library(
    source: LogSource, faults: tuple[type[Exception], ...], *, mend: str = "copy or download it anew"
) -> Iterator[None]:
    """Keep a library quiet, which prints what it meets, and turn its faults into one line."""
    try:
        with redirect_stdout(StringIO()), redirect_stderr(StringIO()):
            yield
    except FlightError:
        raise
    except faults as error:
        raise source.fault(f"cannot be read as such a log ({message_of(error)}): {mend}") from error


@contextmanager
def known_fields(source: LogSource) -> Iterator[None]:
    """Turn a field that a message lacks into one line: messages change from version to version."""
    try:
        yield
    except KeyError as error:
        raise source.fault(f"a message has no field {error}, so its version is not known: export it as CSV") from error
