# SPDX-License-Identifier: Apache-2.0
"""`foundloc_ransac`: odometry laid over the retrieved places of the last views, without those that do not fit."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np
from sklearn.cluster import DBSCAN  # type: ignore[import-untyped, unused-ignore]

import sasgeo_bench as sgb
from sasgeo_baselines.trackers.window import ASKED, NEAR_M, Floats, Raster, Seen, Window, aligned, asking, radius_95_m


@dataclass(frozen=True, slots=True, kw_only=True)
class RansacPlan:
    """Settings.

    Parameters
    ----------
    views : int
        The last views that are laid over the map.
    top_k : int
        Places retrieved for each of them.
    cluster_m, least_members : float, int
        Of DBSCAN: reach, and places within it that make a cluster.
    fits_m : float
        A view fits an alignment if its place lies so near.
    baseline_m : float
        Two views this far from each other give an alignment.
    least_views, least_ratio : int, float
        An alignment needs so many views that fit, and that fraction of all.
    sigma_m : float
        Least standard deviation of a place that fits.
    """

    views: int = 12
    top_k: int = 20
    cluster_m: float = 50.0
    least_members: int = 3
    fits_m: float = 20.0
    baseline_m: float = 60.0
    least_views: int = 5
    least_ratio: float = 0.5
    sigma_m: float = 3.0


class FoundlocRansac(sgb.Follower):
    """Retrieval, clusters, RANSAC and Procrustes over a window of views."""

    card = sgb.MatcherCard(
        name="foundloc_ransac",
        version="1",
        title="Odometry aligned with retrieved places",
        source=(
            "FoundLoc (He et al., arXiv 2310.16299): the best places of each image by retrieval, outliers removed, "
            "Procrustes of visual-inertial odometry to what is left"
        ),
        ours=(
            f"Places are {ASKED} instead of tiles by features of images; those of the last 12 views are carried to now "
            "by odometry and clustered by DBSCAN over 50 m; of places in the upper half of a view's scores; every pair "
            "of views gives an alignment in place of random pairs; the ratio of views that fit is the confidence; "
            "covariance of least squares, as if half of the views counted"
        ),
        licence="Apache-2.0",
        tracks=("sequence",),
        limits=(
            "Odometry is taken as rigid over the window, so fast drift of heading leaves few views that fit; needs a "
            "baseline, so hovering tells nothing; no weights are learned"
        ),
    )

    def __init__(self, matcher: sgb.Matcher | None = None, plan: RansacPlan | None = None) -> None:
        self.settings = plan or RansacPlan()
        super().__init__(matcher or Raster(), asking(self.settings.top_k))

    def start(self, prior: sgb.Prior) -> None:
        """Begin with the prior, and without views."""
        super().start(prior)
        self._window = Window(self.settings.views)
        self._ratio = 0.0

    def step(self, query: sgb.Query) -> sgb.Fix:
        """Answer the next view; the confidence is the ratio of views that fit."""
        return replace(super().step(query), confidence=self._ratio)

    def corrected(self, belief: sgb.Belief, found: sgb.Match, query: sgb.Query) -> tuple[sgb.Belief, bool]:
        """Lay the last views over their places; accept if enough of them fit."""
        assert query.step is not None  # noqa: S101 - step() has looked
        self._window.add(query.step, *_upper_half(found))
        views = list(self._window)
        laid = laid_over(_members(views, self.settings), self.settings)
        self._ratio = 0.0 if laid is None else len(laid.views) / len(views)
        if laid is None or len(laid.views) < self.settings.least_views or self._ratio < self.settings.least_ratio:
            return replace(belief, idle=belief.idle + bool(found.poses)), False
        covariance = _covariance(laid, self.settings)
        return sgb.Belief(pose=laid.pose, covariance=covariance), radius_95_m(covariance) <= NEAR_M


@dataclass(frozen=True, kw_only=True)
class _Laid:
    """An alignment: the pose of the present view, the N views that fit it, their places in its axes, and residuals."""

    pose: sgb.Pose
    views: tuple[Seen, ...]
    places_m: Floats
    rest_m: Floats


def _upper_half(found: sgb.Match) -> tuple[Sequence[sgb.Pose], Sequence[float]]:
    """Drop places of low similarity: those in the lower half of the view's range of scores."""
    if not found.poses:
        return (), ()
    least = (found.scores[0] + found.scores[-1]) / 2
    kept = [(pose, score) for pose, score in zip(found.poses, found.scores, strict=True) if score >= least]
    return [pose for pose, _ in kept], [score for _, score in kept]


def _members(views: Sequence[Seen], plan: RansacPlan) -> list[tuple[Seen, sgb.Pose]]:
    """Return a place of each view in the cluster that most views have a place in: the best one of each."""
    reported = [(at, pose) for at, seen in enumerate(views) for pose in seen.poses]
    if not reported:
        return []
    now = [views[at].carried(pose) for at, pose in reported]
    points_m = np.array([(pose.easting_m, pose.northing_m) for pose in now])
    labels = DBSCAN(eps=plan.cluster_m, min_samples=plan.least_members).fit_predict(points_m)
    clusters: dict[int, dict[int, sgb.Pose]] = {}
    for (at, pose), label in zip(reported, labels.tolist(), strict=True):
        if label >= 0:
            clusters.setdefault(label, {}).setdefault(at, pose)  # poses of a view are best first
    chosen = max(clusters.values(), key=len, default={})
    return [(views[at], pose) for at, pose in chosen.items()]


def laid_over(members: Sequence[tuple[Seen, sgb.Pose]], plan: RansacPlan) -> _Laid | None:
    """Return the alignment that most members fit, of those that two of them give, refined with all that fit."""
    places_m = np.array([seen.place_m for seen, _ in members]).reshape(-1, 2)
    points_m = np.array([(pose.easting_m, pose.northing_m) for _, pose in members]).reshape(-1, 2)

    def away_m(pose: sgb.Pose) -> Floats:
        return np.asarray(np.hypot(*(pose.to_map(places_m) - points_m).T))

    pairs = [list(pair) for pair in combinations(range(len(members)), 2)]
    far = [pair for pair in pairs if math.dist(*places_m[pair]) >= plan.baseline_m]
    tried = (aligned(places_m[pair], points_m[pair], np.ones(2)) for pair in far)
    best = min((pose for pose in tried if pose), default=None, key=lambda pose: _misfit(away_m(pose), plan))
    for _ in range(3):  # times that the alignment is refined with the views that fit it
        if best is not None:
            fits = away_m(best) <= plan.fits_m
            best = aligned(places_m[fits], points_m[fits], np.ones(int(fits.sum())))
    if best is None:
        return None
    fits = away_m(best) <= plan.fits_m
    kept = tuple(seen for (seen, _), is_in in zip(members, fits.tolist(), strict=True) if is_in)
    return _Laid(pose=best, views=kept, places_m=places_m[fits], rest_m=best.to_map(places_m[fits]) - points_m[fits])


def _misfit(away_m: Floats, plan: RansacPlan) -> tuple[int, float]:
    """Return what is least for the best alignment: members that do not fit, then the distance of those that do."""
    return int((away_m > plan.fits_m).sum()), float(np.minimum(away_m, plan.fits_m).sum())


def _covariance(laid: _Laid, plan: RansacPlan) -> Floats:
    """Return the covariance of the pose by least squares, and of the way from the last view that fits to now."""
    count = len(laid.views)
    variance_m2 = max(float(np.square(laid.rest_m).sum()) / max(2 * count - 3, 1), plan.sigma_m**2)
    turned = laid.places_m @ sgb.rotation(laid.pose.yaw_deg).T
    information = np.zeros((3, 3))
    for east_m, north_m in turned:
        by_pose = np.array([[1.0, 0.0, np.radians(north_m)], [0.0, 1.0, np.radians(-east_m)]])
        # 2: neighbouring residuals are alike: as if there were half as many
        information += by_pose.T @ by_pose / (2.0 * variance_m2)
    # Odometry is no rigid body: the pose is that of the views' middle, and drifts from there on as odometry does.
    middle = laid.views[(2 * count) // 3]
    return np.asarray(np.linalg.inv(information) + middle.carried_covariance(laid.pose, np.zeros((3, 3))))
