# SPDX-License-Identifier: Apache-2.0
"""`ekf_loose`: fixes of a matcher of single views, loosely coupled with odometry in an extended Kalman filter."""

import math
from collections import deque
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from scipy import stats

import sasgeo_bench as sgb
from sasgeo_baselines.trackers.window import ASKED, KNOWN_M, NEAR_M, Floats, Raster, Seen, Window, asking, radius_95_m

_BELOW: Final = 3  # rows of the state that are the pose: east, north, yaw; the scale of the odometer follows


@dataclass(frozen=True, slots=True, kw_only=True)
class EkfPlan:
    """Settings of the filter.

    Parameters
    ----------
    gate : float
        Largest Mahalanobis distance of a fix that is taken; 3.37 holds 99 % in three dimensions.
    scale_sigma, scale_m : float
        Standard deviation of the odometer's scale, and the distance over which it forgets it.
    least_m, most_m, least_deg, most_deg : float
        Bounds of the standard deviations of fixes, which follow the innovations.
    memory : int
        Innovations that they follow.
    among, by_chance : int, float
        The filter begins, and begins anew, where poses of the last `among` views agree by odometry so often that wrong
        poses, anywhere in the searched discs, would do so with this probability.
    quality : float
        Fraction of the last six fixes that must have passed the gate for an estimate to be accepted.
    """

    gate: float = 3.37
    scale_sigma: float = 0.02
    scale_m: float = 500.0
    least_m: float = 2.0
    most_m: float = 8.0
    least_deg: float = 1.0
    most_deg: float = 4.0
    memory: int = 20
    among: int = 8
    by_chance: float = 1e-4
    quality: float = 0.5


class EkfLoose(sgb.Follower):
    """Extended Kalman filter over place, heading and the odometer's scale."""

    card = sgb.MatcherCard(
        name="ekf_loose",
        version="1",
        title="Kalman filter on gated fixes",
        source=(
            "Textbook extended Kalman filter with a Mahalanobis gate (Bar-Shalom, Li and Kirubarajan, 2001) and "
            "covariances from innovations (Mehra, 1970)"
        ),
        ours=(
            f"All else: fixes are {ASKED}; the scale of the odometer is part of the state; the filter begins, and "
            "begins anew, where poses of the last 8 views agree by odometry more than by chance; accepted while 95 % "
            "of its belief lie within 25 m and half of the last six fixes passed the gate"
        ),
        licence="Apache-2.0",
        tracks=("sequence",),
        limits=(
            "One hypothesis at a time: where a map repeats itself it may follow the wrong copy, and be sure of it; no "
            "weights are learned"
        ),
    )

    def __init__(self, matcher: sgb.Matcher | None = None, plan: EkfPlan | None = None) -> None:
        super().__init__(matcher or Raster(), asking(5))
        self.filter = plan or EkfPlan()

    def start(self, prior: sgb.Prior) -> None:
        """Begin with the prior, and without a fix."""
        super().start(prior)
        self._window = Window(self.filter.among)
        self._is_begun = False
        self._scale = _ScaleState(value=0.0, variance=self.filter.scale_sigma**2, cross=np.zeros(_BELOW))
        self._gaps: deque[Floats] = deque(maxlen=self.filter.memory)
        self._passed: deque[bool] = deque(maxlen=6)

    def moved(self, belief: sgb.Belief, step: sgb.Step) -> sgb.Belief:
        """Predict: add the increment up, stretched by the scale that the filter believes in."""
        pose, covariance, self._scale = predicted(belief, self._scale, step, self.filter)
        return replace(belief, pose=pose, covariance=covariance)

    def corrected(self, belief: sgb.Belief, found: sgb.Match, query: sgb.Query) -> tuple[sgb.Belief, bool]:
        """Correct by the first pose if it passes the gate; else look for views that agree on another place."""
        assert query.step is not None  # noqa: S101 - step() has looked
        searched_m = self.prior_of(belief, query.prior).radius_m
        self._window.add(query.step, found.poses, found.scores, searched_m=searched_m)
        self._is_begun = self._is_begun and radius_95_m(belief.covariance) <= KNOWN_M
        own = self.covariance_of(found, query)
        passed = self._is_begun and bool(found.poses) and belief.distance(found.poses[0], own) <= self.filter.gate
        if found.poses:
            self._passed.append(passed)
        if passed:
            belief = self._updated(belief, found.poses[0], own)
        else:
            again = agreed(self._window, own, self.filter) if found.poses else None
            missed = replace(belief, idle=belief.idle + bool(found.poses))
            belief = missed if again is None else self._restarted(again, own)
        is_lost = belief.idle > self.plan.patience
        self._is_begun = self._is_begun and not is_lost
        is_good = sum(self._passed) >= self.filter.quality * len(self._passed)
        return belief, self._is_begun and is_good and radius_95_m(belief.covariance) <= NEAR_M

    def covariance_of(self, found: sgb.Match, query: sgb.Query) -> Floats:
        """Return the covariance of fixes: mean square of the last innovations less what the belief explains of them."""
        del found, query
        plan = self.filter
        least, most = (np.square([place, place, yaw]) for place, yaw in _bounds(plan))
        start = np.square([plan.most_m / 2, plan.most_m / 2, plan.most_deg / 2])
        weight = len(self._gaps) / plan.memory
        seen = np.mean(list(self._gaps), axis=0) if self._gaps else start
        place_m2 = float(seen[:2].mean())  # a view has no direction in which it is measured better
        return np.diag(np.clip((1 - weight) * start + weight * np.array([place_m2, place_m2, seen[2]]), least, most))

    def _updated(self, belief: sgb.Belief, fix: sgb.Pose, own: Floats) -> sgb.Belief:
        gap = belief.gap(fix)
        self._gaps.append(np.square(gap) - np.diag(belief.covariance))
        joint = np.block(
            [[belief.covariance, self._scale.cross[:, None]], [self._scale.cross[None, :], self._scale.variance]]
        )
        gain = np.linalg.solve(joint[:_BELOW, :_BELOW] + own, joint[:_BELOW]).T
        change = gain @ gap
        left = np.eye(_BELOW + 1) - gain @ np.eye(_BELOW, _BELOW + 1)
        joint = left @ joint @ left.T + gain @ own @ gain.T
        limit = 3 * self.filter.scale_sigma
        self._scale = _ScaleState(
            value=float(np.clip(self._scale.value + change[_BELOW], -limit, limit)),
            variance=float(joint[_BELOW, _BELOW]),
            cross=joint[:_BELOW, _BELOW],
        )
        return sgb.Belief(pose=shifted(belief.pose, change, scale=fix.scale), covariance=joint[:_BELOW, :_BELOW])

    def _restarted(self, pose: sgb.Pose, own: Floats) -> sgb.Belief:
        self._is_begun = True
        self._scale = replace(self._scale, cross=np.zeros(_BELOW))
        self._passed.clear()
        return sgb.Belief(pose=pose, covariance=own)


@dataclass(frozen=True, slots=True, kw_only=True)
class _ScaleState:
    """Belief about the scale of the odometer: true over reported, less 1; variance, and covariance with the pose.

    `cross` has shape (3,), in m, m and deg.
    """

    value: float
    variance: float
    cross: Floats


def _bounds(plan: EkfPlan) -> tuple[tuple[float, float], tuple[float, float]]:
    return (plan.least_m, plan.least_deg), (plan.most_m, plan.most_deg)


def shifted(pose: sgb.Pose, change: Floats, *, scale: float) -> sgb.Pose:
    """Return a pose moved by east, north (metres) and yaw (degrees), with another scale."""
    return sgb.Pose(
        easting_m=pose.easting_m + float(change[0]),
        northing_m=pose.northing_m + float(change[1]),
        yaw_deg=pose.yaw_deg + float(change[2]),
        scale=scale,
    )


def predicted(
    belief: sgb.Belief, scale: _ScaleState, step: sgb.Step, plan: EkfPlan
) -> tuple[sgb.Pose, Floats, _ScaleState]:
    """Return pose, covariance and scale after a step; the increment counts (1 + scale) times."""
    if step.increment is None or step.covariance is None:
        pose, covariance = sgb.advance(belief.pose, belief.covariance, step)
        return pose, covariance, replace(scale, cross=np.zeros(_BELOW) if step.frame else scale.cross)
    right_m, up_m, turn_deg = step.increment
    stretch = 1.0 + scale.value
    reported = replace(step, increment=(stretch * right_m, stretch * up_m, turn_deg))
    pose, covariance = sgb.advance(belief.pose, belief.covariance, reported)
    by_scale = np.array([*(sgb.rotation(belief.pose.yaw_deg) @ [right_m, up_m]), 0.0])
    by_yaw = np.eye(_BELOW)  # as in advance: a clockwise turn takes (east, north) to (north, -east)
    by_yaw[:2, 2] = np.radians([by_scale[1], -by_scale[0]]) * stretch
    keep = math.exp(-math.hypot(right_m, up_m) / plan.scale_m)
    cross = by_yaw @ scale.cross
    covariance = covariance + np.outer(cross, by_scale) + np.outer(by_scale, cross)
    covariance = covariance + scale.variance * np.outer(by_scale, by_scale)
    variance = keep**2 * scale.variance + (1 - keep**2) * plan.scale_sigma**2
    moved = _ScaleState(value=keep * scale.value, variance=variance, cross=keep * (cross + scale.variance * by_scale))
    return pose, covariance, moved


def agreed(window: Window, own: Floats, plan: EkfPlan) -> sgb.Pose | None:
    """Return the pose of the present view that most of the last views agree with by odometry, None if it may be chance.

    A view agrees if one of its poses, carried on by the odometry, lies within the gate. The best poses of views are
    compared first, then all.
    """
    *past, now = window
    for most in (1, len(now.poses)):
        views = [replace(seen, poses=seen.poses[:most]) for seen in past if seen.poses]
        reach_m = plan.gate * math.sqrt(2 * own[0, 0])
        alike = [min(1.0, len(seen.poses) * (reach_m / seen.searched_m) ** 2) for seen in views]
        tried = [
            [gap for seen in views if (gap := _nearest(seen, pose, own)) <= plan.gate] for pose in now.poses[:most]
        ]
        best = max(range(len(tried)), key=lambda at: (len(tried[at]), -sum(tried[at])))
        chance = float(stats.binom.sf(len(tried[best]) - 1, len(views), np.mean(alike))) if tried[best] else 1.0
        if chance * len(tried) <= plan.by_chance:
            return now.poses[best]
    return None


def _nearest(seen: Seen, pose: sgb.Pose, own: Floats) -> float:
    carried = (
        sgb.Belief(pose=seen.carried(item), covariance=seen.carried_covariance(item, own)) for item in seen.poses
    )
    return min((item.distance(pose, own) for item in carried), default=math.inf)
