# SPDX-License-Identifier: Apache-2.0
"""`se2_trajectory`: the flown path is laid over the map as a whole, then aligned by parts, then smoothed (NaviLoc)."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy import linalg

import sasgeo_bench as sgb
from sasgeo_baselines.trackers.window import (
    ASKED,
    KNOWN_M,
    NEAR_M,
    Floats,
    Raster,
    Seen,
    Window,
    aligned,
    asking,
    radius_95_m,
)

_ALIKE: Final = 2.0  # neighbouring anchors err alike: as if there were half as many


@dataclass(frozen=True, slots=True, kw_only=True)
class TrajectoryPlan:
    """Settings.

    Parameters
    ----------
    views : int
        The last views that are aligned and smoothed together.
    least_views : int
        Views that are needed to find the place of the path.
    near_m, near_deg : float
        Width of the kernel by which poses of views support a place of the path.
    least_share, least_lead : float
        The best place of the path must be supported by that fraction of its views, and so many times as much as any
        that is 50 m or more away.
    bound_m, bound_deg : float
        Most that an alignment may move and turn the path from where it is believed to be.
    clamp_m : float
        An anchor that lies farther from the aligned path counts for nothing.
    flat : float
        So does one of a view whose best score leads the mean of its others by less than that fraction of the best.
    sigma_m, sigma_deg : float
        Least standard deviations of an anchor.
    """

    views: int = 20
    least_views: int = 5
    near_m: float = 20.0
    near_deg: float = 5.0
    least_share: float = 0.5
    least_lead: float = 1.3
    bound_m: float = 60.0
    bound_deg: float = 20.0
    clamp_m: float = 35.0
    flat: float = 0.05
    sigma_m: float = 3.0
    sigma_deg: float = 2.0


class Se2Trajectory(sgb.Follower):
    """Global alignment of the path, bounded alignment of its last part, and smoothing, of past views alone."""

    card = sgb.MatcherCard(
        name="se2_trajectory",
        version="1",
        title="Path aligned as a whole, then smoothed",
        source=(
            "NaviLoc (2025, by its abstract): SE(2) over a lattice that maximises the similarity summed along the "
            "path; Procrustes over windows of 20 to 40 views with bounds; smoothing of odometry and clamped anchors"
        ),
        ours=(
            f"Similarity is that of {ASKED}; instead of a lattice, each of these poses gives a place of the path to "
            "try, with kernels of 20 m and 5 degrees; the smoother sees past views alone, the last 20, and its last "
            "pose is the answer; headings are smoothed as places are; when it begins, and begins anew; its covariance"
        ),
        licence="Apache-2.0",
        tracks=("sequence",),
        limits=(
            "The path is looked for within the prior's disc; where a map repeats itself it waits; nothing is learned"
        ),
    )

    def __init__(self, matcher: sgb.Matcher | None = None, plan: TrajectoryPlan | None = None) -> None:
        super().__init__(matcher or Raster(), asking(15))
        self.settings = plan or TrajectoryPlan()

    def start(self, prior: sgb.Prior) -> None:
        """Begin with the prior, and without views."""
        super().start(prior)
        self._window = Window(self.settings.views)
        self._is_placed = False

    def corrected(self, belief: sgb.Belief, found: sgb.Match, query: sgb.Query) -> tuple[sgb.Belief, bool]:
        """Place the path if it has no place yet, align and smooth it, and return its last pose."""
        assert query.step is not None  # noqa: S101 - step() has looked
        self._window.add(query.step, found.poses, found.scores)
        views, lost = list(self._window), replace(belief, idle=belief.idle + bool(found.poses))
        is_known = belief.idle <= self.plan.patience and radius_95_m(belief.covariance) <= KNOWN_M
        self._is_placed = self._is_placed and is_known
        placed = belief.pose if self._is_placed else place_of_path(views, self.settings)
        if placed is None:
            return lost, False
        anchors = anchors_of(views, self.settings)
        smooth = smoothed(views, anchors, aligned_within(anchors, placed, self.settings), self.settings)
        self._is_placed = smooth is not None
        if smooth is None:
            return lost, False
        pose, covariance, counts = smooth
        # 6 views of which half must have an anchor that counts, or the estimate is not accepted
        is_anchored = bool(counts[-6:].mean() >= 1 / 2)
        now = sgb.Belief(pose=pose, covariance=covariance, idle=0 if counts[-1] else lost.idle)
        return now, is_anchored and radius_95_m(covariance) <= NEAR_M


def place_of_path(views: Sequence[Seen], plan: TrajectoryPlan) -> sgb.Pose | None:
    """Return the present pose that most views of the path support; None where too few do, or another place as much.

    Every pose that was found for a view leads to a present pose by odometry. Each of these is tried: a view supports it
    by the best of its own poses, by score within the view and nearness.
    """
    reported = [(at, pose, _merit(seen, rank)) for at, seen in enumerate(views) for rank, pose in enumerate(seen.poses)]
    count = sum(bool(seen.poses) for seen in views)
    if count < plan.least_views:
        return None
    now = [views[at].carried(pose) for at, pose, _ in reported]
    points_m = np.array([(pose.easting_m, pose.northing_m) for pose in now])
    yaws_deg = np.array([pose.yaw_deg for pose in now])
    away_m = np.hypot(*(points_m[:, None] - points_m[None]).transpose(2, 0, 1))
    turned_deg = sgb.wrap_deg(yaws_deg[:, None] - yaws_deg[None])
    near = np.exp(-(np.square(away_m / plan.near_m) + np.square(turned_deg / plan.near_deg)) / 2)
    near *= np.array([merit for _, _, merit in reported])
    firsts = np.flatnonzero(np.diff([-1, *(at for at, _, _ in reported)]))
    support = np.maximum.reduceat(near, firsts, axis=1).sum(axis=1)
    best = int(support.argmax())
    rival = float(support[away_m[best] > 50.0].max(initial=0.0))  # 50 m: another place, not the same one again
    is_found = support[best] >= max(plan.least_share * count, plan.least_lead * rival)
    return now[best] if is_found else None


def _merit(seen: Seen, rank: int) -> float:
    """Return the score of a pose within its view: 1 for the best, 0 for the last."""
    best, last = seen.scores[0], seen.scores[-1]
    return 1.0 if best <= last else (seen.scores[rank] - last) / (best - last)


@dataclass(frozen=True, kw_only=True)
class Anchors:
    """Poses of N views that the path is tied to.

    `places_m` (N, 2) are the views' places in the axes of the present view, `points_m` (N, 2) and `yaws_deg` (N,) their
    anchors on the map, `turns_deg` (N,) the headings of the views in the axes of the present one, and `weights` (N,)
    are 0 where there is no anchor, or its view is flat.
    """

    places_m: Floats
    points_m: Floats
    yaws_deg: Floats
    turns_deg: Floats
    weights: Floats


def anchors_of(views: Sequence[Seen], plan: TrajectoryPlan) -> Anchors:
    """Return the best pose of each view; one of a view whose scores are flat counts for nothing."""
    places_m = np.array([seen.place_m for seen in views])
    points_m, yaws_deg, weights = np.zeros((len(views), 2)), np.zeros(len(views)), np.zeros(len(views))
    for at, seen in enumerate(views):
        if seen.poses:
            pose = seen.poses[0]
            points_m[at], yaws_deg[at] = (pose.easting_m, pose.northing_m), pose.yaw_deg
            weights[at] = _is_peaked(seen, plan)
    turns_deg = np.array([-seen.way.yaw_deg for seen in views])
    return Anchors(places_m=places_m, points_m=points_m, yaws_deg=yaws_deg, turns_deg=turns_deg, weights=weights)


def _is_peaked(seen: Seen, plan: TrajectoryPlan) -> bool:
    if len(seen.scores) == 1:
        return True
    return seen.scores[0] - float(np.mean(seen.scores[1:])) > plan.flat * abs(seen.scores[0])


def aligned_within(anchors: Anchors, now: sgb.Pose, plan: TrajectoryPlan) -> sgb.Pose:
    """Return the present pose by weighted Procrustes of the path to its anchors, moved and turned within bounds.

    The end of the path counts most, since odometry bends, and anchors count less the farther they are from the path.
    Where too few are near, or a bound is passed, the pose stays.
    """
    off_m = np.hypot(*(now.to_map(anchors.places_m) - anchors.points_m).T)
    # 0.9: weight of an anchor, against that of the next view
    recent = 0.9 ** np.arange(len(off_m))[::-1] / (1 + np.square(off_m / plan.near_m))
    weights = np.where(off_m <= plan.bound_m, anchors.weights * recent, 0.0)
    laid = aligned(anchors.places_m, anchors.points_m, weights)
    if laid is None or (weights > 0).sum() < plan.least_views:
        return now
    east_m, north_m, turned_deg = sgb.Belief(pose=now, covariance=np.eye(3)).gap(laid)
    return laid if math.hypot(east_m, north_m) <= plan.bound_m and abs(turned_deg) <= plan.bound_deg else now


def smoothed(
    views: Sequence[Seen], anchors: Anchors, laid: sgb.Pose, plan: TrajectoryPlan
) -> tuple[sgb.Pose, Floats, NDArray[np.bool_]] | None:
    """Return the last pose of the smoothed path, its covariance, and which anchors counted.

    Headings first, then places, whose steps are turned by the headings: both minimise squared errors of odometry and of
    anchors, and anchors far from the aligned path count for nothing.
    """
    off_m = np.hypot(*(laid.to_map(anchors.places_m) - anchors.points_m).T)
    off_deg = np.abs(sgb.wrap_deg(anchors.yaws_deg - anchors.turns_deg - laid.yaw_deg))
    counts = (anchors.weights > 0) & (off_m <= plan.clamp_m) & (off_deg <= plan.bound_deg)
    if not counts.any():
        return None
    upto = int(np.flatnonzero(counts)[-1]) + 1  # from the last anchor that counts the odometry leads on
    fits, steps = counts[:upto], [seen.step for seen in views[1:upto]]
    reported = np.array([step.increment for step in steps], dtype=np.float64).reshape(-1, 3)
    own = np.array([step.covariance for step in steps], dtype=np.float64).reshape(-1, 3, 3)
    sigma_m = max(plan.sigma_m, float(np.sqrt(np.mean(np.square(off_m[counts])) / 2)) / 2)
    base_deg = anchors.turns_deg[:upto] + laid.yaw_deg  # differences from it are smoothed: no turn of a circle is lost
    rest_deg = np.asarray(sgb.wrap_deg(anchors.yaws_deg[:upto] - base_deg))[:, None]
    weight_deg = np.where(fits, 1 / (_ALIKE * plan.sigma_deg**2), 0.0)
    headings, heading_deg2 = chain(np.zeros((len(steps), 1)), own[:, 2, 2], rest_deg, weight_deg)
    yaws_deg = base_deg + headings[:, 0]
    moved_m = np.array([sgb.rotation(yaw) @ step[:2] for yaw, step in zip(yaws_deg[:-1], reported, strict=True)])
    flown_m2 = np.square(reported[:, :2]).sum(axis=1)
    # 0.015: drift of a step, besides its covariance: errors of neighbouring steps are alike
    slip_m2 = (own[:, 0, 0] + own[:, 1, 1]) / 2 + flown_m2 * (0.015**2 + np.radians(math.sqrt(heading_deg2)) ** 2)
    weight_m = np.where(fits, 1 / (_ALIKE * sigma_m**2), 0.0)
    places_m, place_m2 = chain(moved_m.reshape(-1, 2), slip_m2, anchors.points_m[:upto], weight_m)
    east_m, north_m = places_m[-1].tolist()
    pose = sgb.Pose(easting_m=east_m, northing_m=north_m, yaw_deg=float(yaws_deg[-1]))
    last, covariance = views[upto - 1], np.diag([place_m2, place_m2, heading_deg2])
    return last.carried(pose), last.carried_covariance(pose, covariance), counts


def chain(steps: Floats, variances: Floats, anchors: Floats, weights: Floats) -> tuple[Floats, float]:
    """Minimise sum |x[k+1] - x[k] - step[k]|^2 / variance[k] + sum weight[k] |x[k] - anchor[k]|^2.

    Steps have shape (N - 1, D), anchors (N, D); at least one weight is positive. Returns x, shape (N, D), and the
    variance of its last row.

    >>> anchors, weights = np.array([[0.0], [9.0], [9.0]]), np.array([1.0, 0.0, 0.0])
    >>> x, variance = chain(np.array([[1.0], [1.0]]), np.ones(2), anchors, weights)
    >>> x.ravel().round(6).tolist(), round(variance, 6)
    ([0.0, 1.0, 2.0], 3.0)
    """
    pull = 1 / np.maximum(variances, 1e-6)
    diagonal = weights + np.pad(pull, (0, 1)) + np.pad(pull, (1, 0))
    bands = np.stack([np.pad(-pull, (1, 0)), diagonal])
    lean = pull[:, None] * steps
    right = weights[:, None] * anchors + np.pad(lean, ((1, 0), (0, 0))) - np.pad(lean, ((0, 1), (0, 0)))
    last = np.zeros((len(anchors), 1))
    last[-1] = 1.0
    solved = linalg.solveh_banded(bands, np.hstack([right, last]))
    return np.asarray(solved[:, :-1]), float(solved[-1, -1])
