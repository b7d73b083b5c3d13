# SPDX-License-Identifier: Apache-2.0
"""`Follower`: a matcher of single views becomes a tracker, asked about each view within what is believed so far."""

import hashlib
import json
import math
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from sasgeo_bench.core.texts import MOST_DIAGNOSTICS
from sasgeo_bench.geometry.grid import Grid
from sasgeo_bench.geometry.pose import Pose, Prior, wrap_deg
from sasgeo_bench.matching.controls import reckoning
from sasgeo_bench.matching.controls.blind import middle_m
from sasgeo_bench.matching.controls.reckoning import Covariance, advance, start_of
from sasgeo_bench.matching.matcher import MOST_CARD_TEXT, Match, Matcher, MatcherCard, check_match, is_followed
from sasgeo_bench.matching.tracker import SIDE, Fix
from sasgeo_bench.regions.region import Region
from sasgeo_bench.tasks.query import Query, Step

_VERSION: Final = 2
_DESCRIPTION: Final = (
    "on flights, of sasgeo-bench (Follower): each view is asked alone within {sigmas:g} sigma of what is believed, the "
    "first pose is taken up with {sigma_m:g} m and {sigma_yaw_deg:g} deg if its confidence, where there is one, is "
    "{least_confidence:g} and its Mahalanobis distance at most {gate:g}; else odometry is added up"
)


@dataclass(frozen=True, slots=True, kw_only=True)
class FollowPlan:
    """Settings of a `Follower`.

    Parameters
    ----------
    sigma_m, sigma_yaw_deg : float
        Standard deviations of a pose that is taken up: of easting and northing, and of the heading.
    least_confidence : float
        An answer with a lower confidence is not taken up; one without confidence may be.
    gate : float
        Largest Mahalanobis distance between an answer and the belief. 3.5 holds 99 % of right answers in place and
        heading together.
    sigmas, least_radius_m : float
        The searched disc holds so many standard deviations of the belief, and has at least that radius; at most that of
        the prior of the flight, or the whole map without one.
    patience, widen : int, float
        After more than `patience` answers that do not fit, the belief counts as lost: its standard deviations grow by
        the factor `widen` at each view, that of the place until it is the start's, that of the heading until it may be
        any. Views without an answer do not count.
    lost_radius_m : float
        While the belief is lost, the disc may have this radius if the start's is less.
    top_k : int
        Poses asked of the matcher; the first counts.
    """

    sigma_m: float = 5.0
    sigma_yaw_deg: float = 3.0
    least_confidence: float = 0.5
    gate: float = 3.5
    sigmas: float = 3.0
    least_radius_m: float = 50.0
    patience: int = 8
    widen: float = 1.3
    lost_radius_m: float = 0.0
    top_k: int = 5


@dataclass(frozen=True, slots=True, kw_only=True)
class Belief:
    """Estimate of a pose, its covariance (east, north, yaw; m2, m deg, deg2), and answers since that did not fit."""

    pose: Pose
    covariance: Covariance
    idle: int = 0

    @property
    def spreads_m(self) -> tuple[float, float]:
        """Return the least and the largest standard deviation of the place in any direction, metres."""
        least, most = np.sqrt(np.maximum(np.linalg.eigvalsh(self.covariance[:2, :2]), 0.0)).tolist()
        return least, most

    @property
    def yaw_sigma_deg(self) -> float:
        """Return the standard deviation of the heading, degrees."""
        return math.sqrt(max(0.0, float(self.covariance[2, 2])))

    def gap(self, pose: Pose) -> NDArray[np.float64]:
        """Return how far a pose lies from the estimate, shape (3,): east, north, metres, and yaw, degrees.

        >>> here, there = (Pose(easting_m=east_m, northing_m=0.0, yaw_deg=-east_m) for east_m in (0.0, 2.0))
        >>> Belief(pose=here, covariance=np.eye(3)).gap(there).tolist()
        [2.0, 0.0, -2.0]
        """
        east_m, north_m = pose.easting_m - self.pose.easting_m, pose.northing_m - self.pose.northing_m
        return np.array([east_m, north_m, float(wrap_deg(pose.yaw_deg - self.pose.yaw_deg))])

    def distance(self, pose: Pose, covariance: Covariance) -> float:
        """Return the Mahalanobis distance to another estimate, of which the covariance is given.

        >>> here, there = (Pose(easting_m=0.0, northing_m=0.0, yaw_deg=yaw_deg) for yaw_deg in (359.0, 1.0))
        >>> Belief(pose=here, covariance=np.diag([16.0, 16.0, 3.0])).distance(there, np.diag([9.0, 9.0, 1.0]))
        1.0
        """
        gap = self.gap(pose)
        return math.sqrt(max(0.0, float(gap @ np.linalg.solve(self.covariance + covariance, gap))))


class Follower:
    """Follows a flight with a matcher of single views: a tracker, by odometry and answers that fit it.

    Each view is asked as a localization query whose prior is the belief. An answer that is confident enough and fits
    the belief becomes the new belief; after any other, the odometry is added up and the estimate is not accepted.
    `sasgeo-bench run` does this by itself where a matcher of single views is asked about flights. Derive from it, with
    a card of your own, for other settings (`FollowPlan`), another covariance (`covariance_of`), motion (`moved`), or
    another use of answers (`corrected`).

    Parameters
    ----------
    matcher : Matcher
        Its card has the track "localization".
    plan : FollowPlan, optional
        Settings.
    grid : Grid, optional
        Of the map that the matcher has prepared already; else call `prepare`.

    Examples
    --------
    >>> from sasgeo_bench.matching.plugins import load_matcher
    >>> class Patient(Follower):
    ...     def __init__(self) -> None:
    ...         super().__init__(load_matcher("fft_vote"), FollowPlan(gate=3.0, patience=20))
    >>> Patient().card.tracks
    ('sequence',)
    """

    card: MatcherCard

    def __init__(self, matcher: Matcher, plan: FollowPlan | None = None, *, grid: Grid | None = None) -> None:
        self.matcher = matcher
        self.plan = plan or FollowPlan()
        if not hasattr(type(self), "card"):
            self.card = replace(card_on_flights(matcher.card, self.plan), tracks=("sequence",))
        self._grid = grid
        self._first: Belief | None = None
        self._belief: Belief | None = None

    def prepare(self, region: Region, learned: str | None) -> None:
        """Let the matcher index a map."""
        self.matcher.prepare(region, learned)
        self._grid = region.grid

    def start(self, prior: Prior) -> None:
        """Begin with the middle of the prior."""
        if self._grid is None:
            raise RuntimeError(f"{self.card.name}: call prepare() with a region before start()")
        pose, covariance = start_of(prior, self._grid)
        self._limit_m = math.inf if prior.radius_m is None else prior.radius_m
        self._first = self._belief = Belief(pose=pose, covariance=covariance)

    def step(self, query: Query) -> Fix:
        """Ask the matcher about a view, and take its answer up or add the odometry up."""
        if self._belief is None or query.step is None:
            raise RuntimeError(f"{self.card.name}: call start() first, and step() with the views of a flight")
        belief = _sound(self._widened(self.moved(self._belief, query.step)))
        asked = replace(query, track="localization", prior=self.prior_of(belief, query.prior), step=None)
        found = check_match(self.matcher.match(asked, top_k=self.plan.top_k), asked, top_k=self.plan.top_k)
        corrected, is_accepted = self.corrected(belief, found, query)
        self._belief = _sound(corrected)
        diagnostics = dict(found.diagnostics)
        if asked.prior.radius_m is not None and len(diagnostics) < MOST_DIAGNOSTICS:
            diagnostics["searched_m"] = asked.prior.radius_m
        return Fix(
            pose=self._belief.pose,
            covariance=self._belief.covariance,
            is_accepted=is_accepted,
            confidence=found.confidence if is_accepted else None,
            diagnostics=diagnostics,
        )

    def moved(self, belief: Belief, step: Step) -> Belief:
        """Return a belief after the way to the next view: the odometry is added up."""
        pose, covariance = advance(belief.pose, belief.covariance, step)
        return replace(belief, pose=pose, covariance=covariance)

    def corrected(self, belief: Belief, found: Match, query: Query) -> tuple[Belief, bool]:
        """Return the belief after an answer, and whether its pose may be relied on.

        Here an answer that fits is taken up in place of the belief, and after any other the belief stays.
        """
        covariance = self.covariance_of(found, query)
        is_sure = found.confidence is None or found.confidence >= self.plan.least_confidence
        if found.poses and is_sure and belief.distance(found.poses[0], covariance) <= self.plan.gate:
            return Belief(pose=found.poses[0], covariance=covariance), True
        return replace(belief, idle=belief.idle + bool(found.poses)), False

    def covariance_of(self, found: Match, query: Query) -> Covariance:
        """Return the covariance of the first pose of an answer: the same for all, unless you know better."""
        del found, query
        return np.diag([self.plan.sigma_m**2, self.plan.sigma_m**2, self.plan.sigma_yaw_deg**2])

    def prior_of(self, belief: Belief, given: Prior) -> Prior:
        """Return a belief as the prior of a single view, with the scale of the view's own."""
        needs, grid = self.matcher.card.needs, self._grid
        whole_m = math.inf if grid is None else math.dist(grid.bounds_m[:2], grid.bounds_m[2:]) / 2
        most_m = max(self._limit_m, self.plan.lost_radius_m if self._is_lost(belief) else 0.0)
        radius_m = min(max(self.plan.sigmas * belief.spreads_m[1], self.plan.least_radius_m), most_m)
        center_m: tuple[float, float] | None = (belief.pose.easting_m, belief.pose.northing_m)
        if radius_m >= whole_m and grid is not None:
            center_m, radius_m = middle_m(replace(given, center_m=None, radius_m=None), grid), whole_m
        is_anywhere = radius_m >= whole_m and "position" not in needs
        # 90 degrees: standard deviation of a heading of which nothing is left
        is_any_yaw = belief.yaw_sigma_deg >= 90.0 and "yaw" not in needs
        return Prior(
            center_m=None if is_anywhere else center_m,
            radius_m=None if is_anywhere else radius_m,
            yaw_deg=None if is_any_yaw else belief.pose.yaw_deg,
            yaw_sigma_deg=None if is_any_yaw else belief.yaw_sigma_deg,
            scale_sigma=given.scale_sigma,
        )

    def _is_lost(self, belief: Belief) -> bool:
        return belief.idle > self.plan.patience

    def _widened(self, belief: Belief) -> Belief:
        """Let a lost belief grow, at most to the start's, or to what may be searched then; its heading to any."""
        if not self._is_lost(belief) or self._first is None:
            return belief
        most_m = max(self._first.spreads_m[0], self.plan.lost_radius_m / 2)
        place_m2 = _grown(belief.spreads_m[0], most_m, self.plan.widen)
        yaw_deg2 = _grown(belief.yaw_sigma_deg, reckoning.ANY_YAW_DEG, self.plan.widen)
        return replace(belief, covariance=belief.covariance + np.diag([place_m2, place_m2, yaw_deg2]))


def _grown(sigma: float, most: float, factor: float) -> float:
    """Return the variance to add so that a standard deviation grows by a factor, but not beyond the most it may be."""
    return max(0.0, min(sigma * factor, most) ** 2 - sigma**2)


def _sound(belief: Belief) -> Belief:
    """Make a covariance symmetric, invertible and of finite size, however long odometry was added."""
    covariance = (belief.covariance + belief.covariance.T) / 2
    spread_m, spread_deg = math.sqrt(max(covariance[0, 0], covariance[1, 1], 0.0)), belief.yaw_sigma_deg
    # 1e5 m: standard deviation of a place, at most
    place, yaw = min(1.0, 1e5 / max(spread_m, 1.0)), min(1.0, reckoning.ANY_YAW_DEG / max(spread_deg, 1.0))
    factors = np.diag([place, place, yaw])
    found = factors @ covariance @ factors
    floor = 1e-9 * float(np.trace(found))  # of its trace, which the least eigenvalue of a covariance exceeds
    is_low = np.linalg.eigvalsh(found)[0] <= floor
    return replace(belief, covariance=found + floor * np.eye(SIDE) if is_low else found)


def card_on_flights(card: MatcherCard, plan: FollowPlan | None = None) -> MatcherCard:
    """Return the card of a matcher of single views with a word on how it follows flights."""
    ours = f"{card.ours}; {_DESCRIPTION.format(**asdict(plan or FollowPlan()))}"
    return replace(card, ours=ours if len(ours) <= MOST_CARD_TEXT else card.ours, tracks=(*card.tracks, "sequence"))


def follower_record(card: MatcherCard) -> dict[str, Any] | None:
    """Return what `run.json` says of flights that a matcher of single views is asked: settings, and a hash of code.

    None for a tracker, and for a matcher that finds no places.
    """
    if not is_followed(card):
        return None
    settings = {"version": _VERSION, **asdict(FollowPlan())}
    digest = hashlib.sha256(json.dumps(settings, sort_keys=True).encode())
    for module in (__file__, str(reckoning.__file__)):
        digest.update(b"\0" + Path(module).read_bytes())
    return {"hash": digest.hexdigest(), **settings}
