# SPDX-License-Identifier: Apache-2.0
"""Flights among pictures of a user's own, and the odometers that say how the camera moved from one to the next."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import ClassVar, Final, Literal, NamedTuple

import numpy as np

from sasgeo_bench.core.errors import counted
from sasgeo_bench.flights.drift_profile import load_profile
from sasgeo_bench.flights.odometry import Odometry, draw_odometry
from sasgeo_bench.flights.trajectory import Trajectory
from sasgeo_bench.geometry.pose import reckon, wrap_deg
from sasgeo_bench.observing.pictures import Sight
from sasgeo_bench.observing.posed_pictures import PosedPicture
from sasgeo_bench.sensing.visual_odometry import relative_motion

GAP_S: Final = 30.0  # between two pictures, which ends a flight
LEAST_FRAMES: Final = 3
DRIFT: Final = "vio-mono"  # measured profile of the odometer that is drawn
_FASTEST_MPS: Final = 40.0  # of a drone between two pictures
_LEAST_WAY_M: Final = 1.0  # to which an error is compared

OdometerName = Literal["drawn", "visual"]


class Increment(NamedTuple):
    """Right and up, metres, and the turn, degrees clockwise, in the axes of the view before; 3 x 3 covariance."""

    increment: tuple[float, float, float]
    covariance: tuple[float, ...]


def flights_of(pictures: Sequence[PosedPicture]) -> list[list[PosedPicture]]:
    """Return the flights among pictures, each in order of time, of `LEAST_FRAMES` at least.

    A flight ends where the next picture is `GAP_S` later, is of another camera, or could not be reached in time.
    """
    timed = sorted((one for one in pictures if one.time_s is not None), key=lambda one: (one.time_s or 0.0, one.name))
    found: list[list[PosedPicture]] = []
    for one in timed:
        last = found[-1][-1] if found else None
        if last is None or not _follows(one, last):
            found.append([one])
        elif one.time_s != last.time_s:  # clocks of cameras count seconds: of two pictures in one the first is taken
            found[-1].append(one)
    return [flight for flight in found if len(flight) >= LEAST_FRAMES]


def _follows(one: PosedPicture, last: PosedPicture) -> bool:
    after_s = (one.time_s or 0.0) - (last.time_s or 0.0)
    way_m = math.dist(one.position_m[:2], last.position_m[:2])
    return after_s < GAP_S and one.lens == last.lens and way_m <= _FASTEST_MPS * max(after_s, 1.0)


def trajectory_of(pictures: Sequence[PosedPicture]) -> Trajectory:
    """Return the way of the middles of views, as an odometer of the views sees it."""
    begin_s = pictures[0].time_s or 0.0
    return Trajectory.of_angles(
        time_s=[(one.time_s or 0.0) - begin_s for one in pictures],
        position_m=[[one.pose.easting_m, one.pose.northing_m, one.position_m[2]] for one in pictures],
        yaw_deg=[one.pose.yaw_deg for one in pictures],
    )


@dataclass(slots=True)
class DrawnOdometer:
    """An odometer that looks at no picture: its increments are the truth with drawn errors of the profile `DRIFT`."""

    words: ClassVar[str] = f"The odometer drifts as {DRIFT} was measured to."  # in a task

    _steps: Odometry | None = None

    def begin(self, pictures: Sequence[PosedPicture], rng: np.random.Generator) -> None:
        """Take up a flight."""
        self._steps = draw_odometry(trajectory_of(pictures), load_profile(DRIFT), rng=rng)

    def increment(self, frame: int, before: Sight | None, after: Sight | None) -> Increment | None:  # noqa: ARG002
        """Return how the middle of the view moved to a frame of the flight; None where the way is lost."""
        assert self._steps is not None  # noqa: S101 - by `begin`
        steps, at = self._steps, frame - 1
        if steps.is_lost[at]:
            return None
        moved = (float(steps.right_m[at]), float(steps.up_m[at]), float(steps.yaw_deg[at]))
        return Increment(moved, tuple(steps.covariance[at].ravel().tolist()))

    def report(self) -> str:
        """Return nothing: its errors are those of its profile."""
        return ""


@dataclass(slots=True)
class VisualOdometer:
    """An odometer that looks at both pictures; their places only serve to say how far it was off."""

    words: ClassVar[str] = "The odometer is visual: matches of ORB features between each picture and the next."

    _pictures: Sequence[PosedPicture] = ()
    _pairs: int = 0
    _errors: list[tuple[float, float]] = field(default_factory=list)  # a fraction of the way, and degrees

    def begin(self, pictures: Sequence[PosedPicture], rng: np.random.Generator) -> None:  # noqa: ARG002
        """Take up a flight."""
        self._pictures = pictures

    def increment(self, frame: int, before: Sight | None, after: Sight | None) -> Increment | None:
        """Return how the middle of the view moved to a frame of the flight; None where the pictures do not match."""
        self._pairs += 1
        motion = None if before is None or after is None else relative_motion(before.image, after.image)
        if before is None or after is None or motion is None:
            return None
        motion = motion.of_points(before.middle_m, after.middle_m)
        moved = (motion.right_m, motion.up_m, motion.turn_deg)
        there, here = self._pictures[frame - 1].pose, self._pictures[frame].pose
        led_m = reckon([there.easting_m, there.northing_m], there.yaw_deg, [moved])[1]
        off_m = math.dist(led_m, (here.easting_m, here.northing_m))
        way_m = math.dist((there.easting_m, there.northing_m), (here.easting_m, here.northing_m))
        off_deg = abs(float(wrap_deg(there.yaw_deg + motion.turn_deg - here.yaw_deg)))
        self._errors.append((off_m / max(way_m, _LEAST_WAY_M), off_deg))
        return Increment(moved, motion.covariance)

    def report(self) -> str:
        """Return how many pairs of pictures were lost, and how far it was off what the files say."""
        lost = self._pairs - len(self._errors)
        line = f"visual odometry: {lost} of {counted(self._pairs, 'pair')} of pictures lost ({lost / self._pairs:.0%})"
        if not self._errors:
            return f"{line}: they show too little in common"
        off, off_deg = np.median(self._errors, axis=0).tolist()
        return f"{line}; off the files' positions by {off:.1%} of the way, and their headings by {off_deg:.1f} degrees"


Odometer = DrawnOdometer | VisualOdometer
ODOMETERS: Final = MappingProxyType({"drawn": DrawnOdometer, "visual": VisualOdometer})
