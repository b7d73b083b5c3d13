# SPDX-License-Identifier: Apache-2.0
"""The odometry of a log as that of its own flight: steps of its estimate where no receiver was fused into it."""

from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType
from typing import Final

import numpy as np
from numpy.typing import NDArray

from sasgeo_bench.core.errors import FlightError, counted
from sasgeo_bench.flights import log_bags, log_dataflash, log_telemetry, log_ulog
from sasgeo_bench.flights.log_streams import LoggedOdometry, Stream, turned_at, yaws_deg
from sasgeo_bench.flights.odometry import LoggedSteps
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
_LOST_S: Final = 2.0  # without a pose, in which an odometer has lost its way


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
        turns = quaternions_of(poses) if estimate.has_attitudes else attitudes
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
        silent = np.flatnonzero(np.diff(posed_s) > _LOST_S) + 1
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
    log = read_logged(path, vehicle=vehicle, topic=topic)
    if log.attitudes is None:
        raise log.source.fault("has no attitudes, so that nobody knows in which axes its odometry moves: log them")
    if not log.estimate.free_s:
        raise log.source.fault(why_none(log))
    return OwnOdometry(log=log, clock_s=clock_s)


def read_logged(path: Path, *, vehicle: int | None = None, topic: str | None = None) -> LoggedOdometry:
    """Read what a log has of odometry, by its suffix; raise `FlightError` if it has none, or is of another kind."""
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


def why_none(log: LoggedOdometry) -> str:
    """Return why no stretch is left."""
    name, told = log.estimate.poses.name, log.estimate.fused
    if not log.estimate.free_s:
        return (
            f"{name} fused GNSS from start to end ({told}): it is a copy of the truth, and no odometry; fly with a "
            "receiver that is logged and not fused, or take a profile"
        )
    return f"{name} and {log.fixes.track.name} have no two moments in common while no GNSS was fused ({told})"


def quaternions_of(poses: Stream) -> Stream:
    """Return the attitudes of poses."""
    return Stream(name=poses.name, time_s=poses.time_s, values=poses.values[:, 3:])
