# SPDX-License-Identifier: Apache-2.0
"""The last views of a flight: the way from each to now by odometry, and the poses that a matcher finds for it."""

import math
from collections import deque
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Final, Self

import numpy as np
from numpy.typing import NDArray

import sasgeo_bench as sgb
from sasgeo_baselines.raster import LIMITS, OURS, STABLE, RasterMatcher, Switches

Floats = NDArray[np.float64]

NEAR_M: Final = 25.0  # an estimate that may be relied on is so near in 95 of 100 cases
KNOWN_M: Final = 50.0  # radius of 95 % beyond which one pose that fits does not tell the place
_DRIFT: Final = 0.015  # of the distance flown: errors of neighbouring increments are alike, so they add up
# A wrong pose lies anywhere in the searched disc, so that in a wide one few of them pass a narrow gate.
_SEARCHED_M: Final = 120.0
_NO_WAY: Final = sgb.Pose(easting_m=0.0, northing_m=0.0, yaw_deg=0.0)
ASKED: Final = (
    "the poses of a view, from the raster of this package with stable classes, unknown cells silent, and no graph, "
    "searched within what is believed"
)


class Raster(RasterMatcher):
    """The raster of the variants: classes weigh their stability, and unknown cells are silent; no graph."""

    card = sgb.MatcherCard(
        name="raster_of_trackers",
        version="1",
        title="Raster matching by stability, unknown ignored",
        source="SASGeo paper (Trukhina and Vashkelis), Eqs. 7-8 and variants 4 and 5 of its Section VI, without graph",
        ours=f"{OURS}; {STABLE}; what is unknown in the view is silent",
        licence="Apache-2.0",
        tracks=("localization",),
        limits=LIMITS,
    )
    switches = Switches(is_stable=True, is_unknown_silent=True)


def asking(top_k: int) -> sgb.FollowPlan:
    """Return how a matcher is asked for poses of each view: in a wide disc, and in a far wider one when lost."""
    # 2000 m: radius that is searched when the place is lost
    return sgb.FollowPlan(patience=5, widen=2.0, top_k=top_k, least_radius_m=_SEARCHED_M, lost_radius_m=2000.0)


def radius_95_m(covariance: Floats) -> float:
    """Return the radius that holds 95 % of a place, along the longest axis of its covariance, shape (3, 3), m2.

    >>> round(radius_95_m(np.diag([25.0, 100.0, 1.0])), 1)
    24.5
    """
    # 5.991: 95 percent of chi2 of two dimensions
    return math.sqrt(5.991 * max(0.0, float(np.linalg.eigvalsh(np.asarray(covariance)[:2, :2])[-1])))


@dataclass(frozen=True, slots=True, kw_only=True)
class Seen:
    """One view of the past.

    Parameters
    ----------
    step : Step
        The step to it.
    way : Pose
        Pose of the present view in its axes: right and up in metres, turn in degrees.
    covariance : ndarray of float64, shape (3, 3)
        Of the way; m2, m deg, deg2.
    flown_m : float
        Length of the way along the flight.
    poses, scores : tuple
        What a matcher found for it, best first.
    searched_m : float
        Radius of the disc that was searched.
    """

    step: sgb.Step
    way: sgb.Pose
    covariance: Floats
    flown_m: float
    poses: tuple[sgb.Pose, ...] = ()
    scores: tuple[float, ...] = ()
    searched_m: float = math.inf

    def moved(self, step: sgb.Step) -> Self:
        """Return the view after another step of the drone."""
        way, covariance = sgb.advance(self.way, self.covariance, step)
        flown_m = self.flown_m + (math.hypot(*step.increment[:2]) if step.increment else 0.0)
        return replace(self, way=way, covariance=covariance, flown_m=flown_m)

    @property
    def place_m(self) -> Floats:
        """Return its place in the axes of the present view, shape (2,): right, up, metres."""
        back = sgb.inverse(self.way)
        return np.array([back.easting_m, back.northing_m])

    def carried(self, pose: sgb.Pose) -> sgb.Pose:
        """Return the present pose if a pose of this view is right.

        >>> step = sgb.Step(sequence_id="f", frame=1, increment=(0.0, 50.0, 10.0), covariance=(0.0,) * 9)
        >>> seen = Seen(step=step, way=_NO_WAY, covariance=np.zeros((3, 3)), flown_m=0.0).moved(step)
        >>> there = seen.carried(sgb.Pose(easting_m=100.0, northing_m=100.0, yaw_deg=90.0))
        >>> round(there.easting_m), round(there.northing_m), there.yaw_deg
        (150, 100, 100.0)
        """
        east_m, north_m = sgb.rotation(pose.yaw_deg) @ [self.way.easting_m, self.way.northing_m]
        return sgb.Pose(
            easting_m=pose.easting_m + float(east_m),
            northing_m=pose.northing_m + float(north_m),
            yaw_deg=pose.yaw_deg + self.way.yaw_deg,
            scale=pose.scale,
        )

    def carried_covariance(self, pose: sgb.Pose, own: Floats) -> Floats:
        """Return the covariance of a carried pose, given that of the pose: the way's, its drift, and the heading's."""
        into = np.eye(3)
        into[:2, :2] = sgb.rotation(pose.yaw_deg)
        east_m, north_m = into[:2, :2] @ [self.way.easting_m, self.way.northing_m]
        by_yaw = np.eye(3)
        by_yaw[:2, 2] = np.radians([north_m, -east_m])
        drift_m2 = (_DRIFT * self.flown_m) ** 2
        carried = by_yaw @ own @ by_yaw.T + into @ self.covariance @ into.T
        return np.asarray(carried + np.diag([drift_m2, drift_m2, 0.0]))


def aligned(places_m: Floats, points_m: Floats, weights: Floats) -> sgb.Pose | None:
    """Return the pose whose axes take places, shape (N, 2), to points, shape (N, 2): weighted Procrustes, no scale.

    None where the places do not tell a heading.

    >>> pose = aligned(np.array([[0.0, 0.0], [0.0, -50.0]]), np.array([[10.0, 0.0], [-40.0, 0.0]]), np.ones(2))
    >>> round(pose.easting_m), round(pose.northing_m), pose.yaw_deg
    (10, 0, 90.0)
    """
    total = weights.sum()
    if len(places_m) == 0 or total <= 0:
        return None
    place_m, point_m = weights @ places_m / total, weights @ points_m / total
    from_m, into_m = places_m - place_m, points_m - point_m
    along = float(weights @ (from_m * into_m).sum(axis=1))
    across = float(weights @ (from_m[:, 1] * into_m[:, 0] - from_m[:, 0] * into_m[:, 1]))
    if math.hypot(along, across) <= 25.0 * total:  # m2: less spread of places tells no heading
        return None
    yaw_deg = math.degrees(math.atan2(across, along))  # clockwise, from the axes to the map
    east_m, north_m = point_m - sgb.rotation(yaw_deg) @ place_m
    return sgb.Pose(easting_m=float(east_m), northing_m=float(north_m), yaw_deg=yaw_deg)


class Window:
    """The last `most` views, the present one last; none from before the odometer lost its way."""

    def __init__(self, most: int) -> None:
        self._views: deque[Seen] = deque(maxlen=most)

    def __iter__(self) -> Iterator[Seen]:
        return iter(self._views)

    def __len__(self) -> int:
        return len(self._views)

    def add(
        self, step: sgb.Step, poses: Sequence[sgb.Pose], scores: Sequence[float], *, searched_m: float | None = None
    ) -> None:
        """Move on by a step, and add what was found for the view there, within a radius; None for the whole map."""
        if step.increment is None:
            self._views.clear()
        moved = [seen.moved(step) for seen in self._views]
        self._views.clear()
        now = Seen(
            step=step,
            way=_NO_WAY,
            covariance=np.zeros((3, 3)),
            flown_m=0.0,
            poses=tuple(poses),
            scores=tuple(scores),
            searched_m=math.inf if searched_m is None else searched_m,
        )
        self._views.extend([*moved, now])
