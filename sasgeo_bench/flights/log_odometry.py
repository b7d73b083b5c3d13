# SPDX-License-Identifier: Apache-2.0
"""Odometry out of logs: estimates of an autopilot that fused no receiver, beside what the receiver says.

An estimate that fused GNSS is a copy of the truth, and no odometry: it is refused by name. What is left are the poses
of a camera, and the estimator's own over stretches in which its flags say that no receiver was fused though it was
logged.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType
from typing import Final

import numpy as np
import pyproj
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from sasgeo_bench.core.errors import FlightError, counted
from sasgeo_bench.flights import log_bags, log_dataflash, log_telemetry, log_ulog
from sasgeo_bench.flights.drift import LOST_S, PairedRun, pair_run
from sasgeo_bench.flights.log_streams import NED_OF_ENU, LoggedOdometry, Stream, turned_at, yaws_deg
from sasgeo_bench.flights.odometry import LoggedSteps
from sasgeo_bench.flights.trajectory import Trajectory
from sasgeo_bench.geometry.pose import wrap_deg

Floats = NDArray[np.float64]

_READERS: Final = MappingProxyType(
    {
        ".ulg": log_ulog.read_odometry,
        ".bin": log_dataflash.read_odometry,
        ".log": log_dataflash.read_odometry,
    }
)
_TELEMETRY: Final = ".tlog"


@dataclass(frozen=True, slots=True, kw_only=True)
class LoggedRuns:
    """Runs of the odometry of one log against its receiver.

    Parameters
    ----------
    runs : tuple of PairedRun
        One for each stretch, all of one sequence, the log.
    has_yaw : bool
        Whether the odometry has headings of its own. Otherwise it is turned as the vehicle is, by its compass, so that
        errors of heading are none, and those of position count along true north.
    accuracy_m : float
        Median of the horizontal accuracy that the receiver states, metres, which shortest segments measure; NaN where
        it states none.
    notes : tuple of str
        What was read.
    """

    runs: tuple[PairedRun, ...]
    has_yaw: bool
    accuracy_m: float
    notes: tuple[str, ...]


def read_runs(
    path: Path, *, lost_s: float = LOST_S, vehicle: int | None = None, topic: str | None = None
) -> LoggedRuns:
    """Read the odometry of a log with the truth of its receiver.

    Parameters
    ----------
    path : Path
        ULog, DataFlash, telemetry, or a bag.
    lost_s : float
        As `drift.pair_run` takes it.
    vehicle : int, optional
        System id of the vehicle in telemetry of several.
    topic : str, optional
        Topic of a bag with poses that fused no receiver, which their type does not say.

    Returns
    -------
    LoggedRuns
        Poses are those at the times of the fixes.

    Raises
    ------
    FlightError
        If the log has no fixes of a receiver, no odometry, or none that fused no receiver; the message names what it
        has, and the flags that tell.
    """
    log = _read(path, vehicle, topic)
    poses = log.estimate.poses
    has_yaw = log.estimate.has_attitudes
    if log.attitudes is None and has_yaw:
        raise log.source.fault(
            f"{poses.name} has headings, and the log no attitudes to tell what they are turned by: log them"
        )
    stretches = _stretches(log)
    runs = [pair_run(truth, own, sequence=str(path.resolve()), lost_s=lost_s) for truth, own in stretches]
    if not runs:
        raise log.source.fault(_why_none(log))
    of = f"{counted(len(runs), 'stretch', 'stretches')} of {sum(run.path_m for run in runs):.0f} m"
    notes = [
        f"truth: {log.fixes.track.name}, fixes, {log.fixes.track.rate_hz:.3g} Hz",
        f"odometry: {poses.name}, {of} without GNSS ({log.estimate.fused})",
    ]
    if not has_yaw:
        notes.append("headings: the vehicle's own, so no drift of heading is measured")
    return LoggedRuns(runs=tuple(runs), has_yaw=has_yaw, accuracy_m=log.fixes.accuracy_m, notes=(*notes, *log.notes))


@dataclass(frozen=True, slots=True, kw_only=True)
class OwnOdometry:
    """The odometry of a log, as that of the flight in it.

    Parameters
    ----------
    log : LoggedOdometry
        With attitudes of the vehicle.
    clock_s : float
        Seconds of the log's clock at time 0 of the flight.
    """

    log: LoggedOdometry
    clock_s: float

    @property
    def name(self) -> str:
        """Return the message or topic that the poses are of."""
        return self.log.estimate.poses.name

    @property
    def told(self) -> str:
        """Return what tells when no receiver was fused."""
        return self.log.estimate.fused

    def steps(self, time_s: Floats) -> LoggedSteps:
        """Return what the log says of the steps between moments of the flight, shape (N,), in order.

        Both ends of a step lie in one stretch without GNSS, between the first and the last pose of the estimate. It is
        lost where poses are silent for more than two seconds on the way, none is within a second of an end, or the
        estimate says that its frame jumped. Places at the moments are by lines between the poses, headings by the
        shortest turn; both are the estimate's own, and so is the length of its metre. Only axes of places without
        attitudes are the vehicle's.
        """
        estimate, attitudes = self.log.estimate, self.log.attitudes
        assert attitudes is not None  # noqa: S101 - by `read_own`
        at_s, poses = time_s + self.clock_s, estimate.poses
        turns = _quaternions(poses) if estimate.has_attitudes else attitudes
        yaw_deg = yaws_deg(turned_at(turns, at_s).as_quat())
        place_m = poses.at(at_s)
        moved = np.diff(place_m[:, 1] + 1j * place_m[:, 0]) * np.exp(1j * np.radians(yaw_deg[:-1]))
        begin_s, end_s, posed_s = at_s[:-1], at_s[1:], poses.time_s
        is_logged = np.zeros(len(moved), dtype=bool)
        for free_s, fused_s in estimate.free_s:
            is_logged |= (begin_s >= max(free_s, posed_s[0])) & (end_s <= min(fused_s, posed_s[-1]))
        is_known = poses.knows(at_s) & turns.knows(at_s)
        is_lost = ~(is_known[:-1] & is_known[1:])
        anew = np.searchsorted(posed_s, estimate.resets_s)  # nothing leads from the pose before to one of these
        silent = np.flatnonzero(np.diff(posed_s) > LOST_S) + 1
        for at in np.concatenate([silent, anew[(anew > 0) & (anew < len(posed_s))]]):
            is_lost |= (begin_s < posed_s[at]) & (end_s > posed_s[at - 1])
        return LoggedSteps(
            right_m=moved.real,
            up_m=moved.imag,
            yaw_deg=wrap_deg(np.diff(yaw_deg)) if estimate.has_attitudes else np.full(len(moved), np.nan),
            is_logged=is_logged,
            is_lost=is_lost & is_logged,
        )

    def where(self, steps: LoggedSteps) -> str:
        """Return in words how many steps are the log's, and what tells so."""
        lost = f", lost in {steps.is_lost.sum()} of these" if steps.is_lost.any() else ""
        return f"of the log ({self.name}) in {steps.is_logged.sum()} of {counted(len(steps.right_m), 'step')}{lost}"


def read_own(path: Path, *, clock_s: float, vehicle: int | None = None, topic: str | None = None) -> OwnOdometry:
    """Read the odometry of a log for its own flight, whose time 0 is `clock_s` on the log's clock.

    Raises
    ------
    FlightError
        If the log has none, or none that fused no receiver, or no attitudes; the message names what it has.
    """
    log = _read(path, vehicle, topic)
    if log.attitudes is None:
        raise log.source.fault("has no attitudes, so that nobody knows in which axes its odometry moves: log them")
    if not log.estimate.free_s:
        raise log.source.fault(_why_none(log))
    return OwnOdometry(log=log, clock_s=clock_s)


def _read(path: Path, vehicle: int | None, topic: str | None) -> LoggedOdometry:
    suffix = path.suffix.lower()
    if topic is not None and not log_bags.is_bag(path):
        raise FlightError(f"{path.name} is no bag: leave out --topic")
    if vehicle is not None and suffix != _TELEMETRY:
        raise FlightError(f"{path.name} is no telemetry log: leave out --vehicle")
    if log_bags.is_bag(path):
        return log_bags.read_odometry(path, topic=topic)
    if suffix == _TELEMETRY:
        return log_telemetry.read_odometry(path, vehicle=vehicle)
    if suffix not in _READERS:
        suffixes = ", ".join((*_READERS, _TELEMETRY, *log_bags.BAGS))
        raise FlightError(
            f"{path.name or path} is no log with odometry that is read: {suffixes} are; trajectories in TUM files go "
            "by --truth and --estimate"
        )
    return _READERS[suffix](path)


def _why_none(log: LoggedOdometry) -> str:
    """Return why no stretch is left."""
    name, told = log.estimate.poses.name, log.estimate.fused
    if not log.estimate.free_s:
        return (
            f"{name} fused GNSS from start to end ({told}): it is a copy of the truth, and no odometry; fly with a "
            "receiver that is logged and not fused, or take a profile"
        )
    return f"{name} and {log.fixes.track.name} have no two moments in common while no GNSS was fused ({told})"


def _stretches(log: LoggedOdometry) -> Iterator[tuple[Trajectory, Trajectory]]:
    """Yield the truth and the estimate of each stretch, at the fixes within it."""
    track, poses = log.fixes.track, log.estimate.poses
    lon, lat, up = track.values.T
    true_m = _plane_m(lon, lat)
    is_known = poses.knows(track.time_s)
    is_known &= log.attitudes is None or log.attitudes.knows(track.time_s)
    for start_s, end_s in log.estimate.free_s:
        at = np.flatnonzero(is_known & (track.time_s >= start_s) & (track.time_s <= end_s))
        if len(at) < 2:  # a way
            continue
        time_s = track.time_s[at]
        level = Rotation.from_quat(np.tile([0.0, 0.0, 0.0, 1.0], (len(at), 1)))
        turned = level if log.attitudes is None else turned_at(log.attitudes, time_s)
        truth = _trajectory(time_s, np.column_stack([true_m[at], np.nan_to_num(up[at])]), turned)
        north, east, down = poses.at(time_s)[:, :3].T
        own = turned_at(_quaternions(poses), time_s) if log.estimate.has_attitudes else turned
        yield truth, _trajectory(time_s, np.column_stack([east, north, -down]), own)


def _quaternions(poses: Stream) -> Stream:
    return Stream(name=poses.name, time_s=poses.time_s, values=poses.values[:, 3:])


def _trajectory(time_s: Floats, position_m: Floats, of_ned: Rotation) -> Trajectory:
    turns = Rotation.from_matrix(NED_OF_ENU.T @ of_ned.as_matrix())
    return Trajectory(time_s=time_s, position_m=position_m, quaternion_xyzw=turns.as_quat())


def _plane_m(lon_deg: Sequence[float] | Floats, lat_deg: Sequence[float] | Floats) -> Floats:
    """Return east and north of places in metres without a scale, from the middle of them, shape (N, 2)."""
    middle = f"+proj=aeqd +lon_0={np.median(lon_deg)} +lat_0={np.median(lat_deg)} +datum=WGS84"
    return np.column_stack(pyproj.Proj(middle)(lon_deg, lat_deg))
