# SPDX-License-Identifier: Apache-2.0
"""Controls that follow a flight without its views: `dead_reckoning` by the odometer, `prior_only` by nothing."""

import math
from typing import Final

import numpy as np
from numpy.typing import NDArray

from sasgeo_bench.geometry.grid import Grid
from sasgeo_bench.geometry.pose import Pose, Prior, rotation
from sasgeo_bench.matching.controls.blind import at_place, middle_m
from sasgeo_bench.matching.matcher import MatcherCard
from sasgeo_bench.matching.tracker import SIDE, Fix
from sasgeo_bench.regions.region import Region
from sasgeo_bench.tasks.query import Query, Step

Covariance = NDArray[np.float64]  # (3, 3): east, north, yaw in m2, m deg, deg2

ANY_YAW_DEG: Final = 360.0 / math.sqrt(12)  # standard deviation of a heading of which nothing is known
_LOST_M: Final = 1000.0  # added to a position where the odometer lost its way
_LOST_DEG: Final = 90.0


def start_of(prior: Prior, grid: Grid) -> tuple[Pose, Covariance]:
    """Return the middle of a prior and its covariance: a disc is even, and so is a map without one."""
    pose = at_place(middle_m(prior, grid), prior)
    if prior.radius_m is not None:
        place_m2 = (prior.radius_m**2 / 4, prior.radius_m**2 / 4)
    else:
        west_m, south_m, east_m, north_m = grid.bounds_m
        place_m2 = ((east_m - west_m) ** 2 / 12, (north_m - south_m) ** 2 / 12)
    yaw_deg = ANY_YAW_DEG if prior.yaw_sigma_deg is None else prior.yaw_sigma_deg
    return pose, np.diag([*place_m2, yaw_deg**2])


def advance(pose: Pose, covariance: Covariance, step: Step) -> tuple[Pose, Covariance]:
    """Return a pose and its covariance after the way to the next view, to first order.

    The first view has no way; where the odometer lost it, the pose stays and becomes far less certain. Errors of
    increments count as independent, as most filters take them.

    >>> north = Pose(easting_m=0.0, northing_m=0.0, yaw_deg=90.0)
    >>> step = Step(sequence_id="f", frame=1, increment=(0.0, 50.0, 0.0), covariance=(1, 0, 0, 0, 1, 0, 0, 0, 4))
    >>> pose, covariance = advance(north, np.diag([1.0, 1.0, 1.0]), step)
    >>> round(pose.easting_m), np.sqrt(np.diag(covariance)).round(2).tolist()
    (50, [1.41, 1.66, 2.24])
    """
    if step.increment is None or step.covariance is None:
        lost = np.diag([_LOST_M**2, _LOST_M**2, _LOST_DEG**2]) if step.frame else np.zeros((SIDE, SIDE))
        return pose, covariance + lost
    right_m, up_m, turn_deg = step.increment
    turned = rotation(pose.yaw_deg)
    east_m, north_m = (turned @ [right_m, up_m]).tolist()
    moved = Pose(
        easting_m=pose.easting_m + east_m,
        northing_m=pose.northing_m + north_m,
        yaw_deg=pose.yaw_deg + turn_deg,
        scale=pose.scale,
    )
    by_yaw = np.eye(SIDE)  # a clockwise turn takes (east, north) to (north, -east)
    by_yaw[:2, 2] = np.radians([north_m, -east_m])
    into = np.eye(SIDE)
    into[:2, :2] = turned
    own = np.array(step.covariance).reshape(SIDE, SIDE)
    return moved, by_yaw @ covariance @ by_yaw.T + into @ own @ into.T


class DeadReckoning:
    """Adds up the odometer's increments from the middle of the prior; looks at no view and accepts nothing."""

    card = MatcherCard(
        name="dead_reckoning",
        version="1",
        title="Control: odometry alone",
        source="the role of visual-inertial odometry, as in Qin, Li and Shen, VINS-Mono, T-RO 2018",
        ours="All of it",
        licence="Apache-2.0",
        tracks=("sequence",),
        limits="A control: looks at neither the views nor the map, and never says that its estimate may be relied on",
    )

    def __init__(self) -> None:
        self._region: Region | None = None
        self._belief: tuple[Pose, Covariance] | None = None

    def prepare(self, region: Region, learned: str | None) -> None:
        """Keep the map for flights that may begin anywhere."""
        del learned
        self._region = region

    def start(self, prior: Prior) -> None:
        """Begin in the middle of the prior."""
        if self._region is None:
            raise RuntimeError(f"{self.card.name}: call prepare() with a region before start()")
        self._belief = start_of(prior, self._region.grid)

    def step(self, query: Query) -> Fix:
        """Add the increment to the estimate."""
        if self._belief is None or query.step is None:
            raise RuntimeError(f"{self.card.name}: call start() first, and step() with the views of a flight")
        self._belief = self._moved(*self._belief, query.step)
        pose, covariance = self._belief
        # 1e-6 m2 and deg2: keeps a covariance invertible
        return Fix(pose=pose, covariance=covariance + 1e-6 * np.eye(SIDE), is_accepted=False)

    def _moved(self, pose: Pose, covariance: Covariance, step: Step) -> tuple[Pose, Covariance]:
        return advance(pose, covariance, step)


class PriorOnly(DeadReckoning):
    """Stays in the middle of the prior."""

    card = MatcherCard(
        name="prior_only",
        version="1",
        title="Control: the start, for ever",
        source="original",
        ours="All of it",
        licence="Apache-2.0",
        tracks=("sequence",),
        limits="A control: looks at nothing, and its covariance is that of the start",
    )

    def _moved(self, pose: Pose, covariance: Covariance, step: Step) -> tuple[Pose, Covariance]:
        del step
        return pose, covariance
