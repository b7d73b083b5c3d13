# SPDX-License-Identifier: Apache-2.0
"""Odometry out of logs: estimates of an autopilot that fused no receiver, beside what the receiver says.

An estimate that fused GNSS is a copy of the truth, and no odometry: it is refused by name. What is left are the poses
of a camera, and the estimator's own over stretches in which its flags say that no receiver was fused though it was
logged.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pyproj
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from sasgeo_bench.core.errors import counted
from sasgeo_bench.flights.drift import LOST_S, PairedRun, pair_run
from sasgeo_bench.flights.log_streams import NED_OF_ENU, LoggedOdometry, turned_at
from sasgeo_bench.flights.own_odometry import quaternions_of, read_logged, why_none
from sasgeo_bench.flights.trajectory import Trajectory

Floats = NDArray[np.float64]


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
    log = read_logged(path, vehicle=vehicle, topic=topic)
    poses = log.estimate.poses
    has_yaw = log.estimate.has_attitudes
    if log.attitudes is None and has_yaw:
        raise log.source.fault(
            f"{poses.name} has headings, and the log no attitudes to tell what they are turned by: log them"
        )
    stretches = _stretches(log)
    runs = [pair_run(truth, own, sequence=str(path.resolve()), lost_s=lost_s) for truth, own in stretches]
    if not runs:
        raise log.source.fault(why_none(log))
    of = f"{counted(len(runs), 'stretch', 'stretches')} of {sum(run.path_m for run in runs):.0f} m"
    notes = [
        f"truth: {log.fixes.track.name}, fixes, {log.fixes.track.rate_hz:.3g} Hz",
        f"odometry: {poses.name}, {of} without GNSS ({log.estimate.fused})",
    ]
    if not has_yaw:
        notes.append("headings: the vehicle's own, so no drift of heading is measured")
    return LoggedRuns(runs=tuple(runs), has_yaw=has_yaw, accuracy_m=log.fixes.accuracy_m, notes=(*notes, *log.notes))


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
        own = turned_at(quaternions_of(poses), time_s) if log.estimate.has_attitudes else turned
        yield truth, _trajectory(time_s, np.column_stack([east, north, -down]), own)


def _trajectory(time_s: Floats, position_m: Floats, of_ned: Rotation) -> Trajectory:
    turns = Rotation.from_matrix(NED_OF_ENU.T @ of_ned.as_matrix())
    return Trajectory(time_s=time_s, position_m=position_m, quaternion_xyzw=turns.as_quat())


def _plane_m(lon_deg: Sequence[float] | Floats, lat_deg: Sequence[float] | Floats) -> Floats:
    """Return east and north of places in metres without a scale, from the middle of them, shape (N, 2)."""
    middle = f"+proj=aeqd +lon_0={np.median(lon_deg)} +lat_0={np.median(lat_deg)} +datum=WGS84"
    return np.column_stack(pyproj.Proj(middle)(lon_deg, lat_deg))
