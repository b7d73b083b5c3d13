# SPDX-License-Identifier: Apache-2.0
"""`Follower`: a matcher of single views becomes a tracker, asked about each view within what is believed so far."""

import hashlib
import json
import math
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, Final

import numpy as np

from sasgeo_bench.geometry.grid import Grid
from sasgeo_bench.geometry.pose import Pose, Prior, wrap_deg
from sasgeo_bench.matching.controls import reckoning
from sasgeo_bench.matching.controls.blind import middle_m
from sasgeo_bench.matching.controls.reckoning import Covariance, advance, start_of
from sasgeo_bench.matching.matcher import MOST_SAID, Match, Matcher, MatcherCard, check_match, is_followed
from sasgeo_bench.matching.tracker import SIDE, Fix
from sasgeo_bench.regions.region import Region
from sasgeo_bench.tasks.query import Query
from sasgeo_bench.texts import MOST_DIAGNOSTICS

_VERSION: Final = 1
_ANY_DEG: Final = 90.0  # standard deviation of a heading of which nothing is left
_NO_MORE_M: Final = 1e5  # standard deviation of a place, at most
_SHARE: Final = 1e-9  # of its trace, which the least eigenvalue of a covariance exceeds
_SAID: Final = (
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
        After more than `patience` views without an answer that is taken up, the standard deviations of the belief grow
        by the factor `widen` at each view, until they are those of the start.
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
    top_k: int = 5


@dataclass(frozen=True, slots=True, kw_only=True)
class Belief:
    """Estimate of a pose, its covariance (east, north, yaw; m2, m deg, deg2), and views since it was last corrected."""

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


class Follower:
    """Follows a flight with a matcher of single views: a tracker, by odometry and answers that fit it.

    Each view is asked as a localization query whose prior is the belief. An answer that is confident enough and fits
    the belief becomes the new belief; after any other, the odometry is added up and the estimate is not accepted.
    `sasgeo-bench run` does this by itself where a matcher of single views is asked about flights. Derive from it, with
    a card of your own, for other settings (`FollowPlan`) or another covariance (`covariance_of`).

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
            message = f"{self.card.name}: call prepare() with a region before start()"
            raise RuntimeError(message)
        pose, covariance = start_of(prior, self._grid)
        self._limit_m = math.inf if prior.radius_m is None else prior.radius_m
        self._first = self._belief = Belief(pose=pose, covariance=covariance)

    def step(self, query: Query) -> Fix:
        """Ask the matcher about a view, and take its answer up or add the odometry up."""
        if self._belief is None or query.step is None:
            message = f"{self.card.name}: call start() first, and step() with the views of a flight"
            raise RuntimeError(message)
        pose, covariance = advance(self._belief.pose, self._belief.covariance, query.step)
        belief = self._widened(replace(self._belief, pose=pose, covariance=sound(covariance)))
        asked = replace(query, track="localization", prior=self.prior_of(belief, query.prior), step=None)
        found = check_match(self.matcher.match(asked, top_k=self.plan.top_k), asked, top_k=self.plan.top_k)
        own = self.covariance_of(found, query)
        away = distance(belief.pose, found.poses[0], belief.covariance + own) if found.poses else None
        is_good = self._is_good(found, away)
        if is_good:
            self._belief = Belief(pose=found.poses[0], covariance=own)
        else:
            self._belief = replace(belief, idle=belief.idle + 1)
        told = dict(found.diagnostics) | _told(asked.prior, away)
        return Fix(
            pose=self._belief.pose,
            covariance=self._belief.covariance,
            is_accepted=is_good,
            confidence=found.confidence if is_good else None,
            diagnostics=told if len(told) <= MOST_DIAGNOSTICS else {},
        )

    def covariance_of(self, found: Match, query: Query) -> Covariance:
        """Return the covariance of the first pose of an answer: the same for all, unless you know better."""
        del found, query
        return np.diag([self.plan.sigma_m**2, self.plan.sigma_m**2, self.plan.sigma_yaw_deg**2])

    def prior_of(self, belief: Belief, given: Prior) -> Prior:
        """Return a belief as the prior of a single view, with the scale of the view's own."""
        needs, grid = self.matcher.card.needs, self._grid
        whole_m = math.inf if grid is None else math.dist(grid.bounds_m[:2], grid.bounds_m[2:]) / 2
        radius_m = min(max(self.plan.sigmas * belief.spreads_m[1], self.plan.least_radius_m), self._limit_m)
        center_m: tuple[float, float] | None = (belief.pose.easting_m, belief.pose.northing_m)
        if radius_m >= whole_m and grid is not None:
            center_m, radius_m = middle_m(replace(given, center_m=None, radius_m=None), grid), whole_m
        is_anywhere = radius_m >= whole_m and "position" not in needs
        is_any_yaw = belief.yaw_sigma_deg >= _ANY_DEG and "yaw" not in needs
        return Prior(
            center_m=None if is_anywhere else center_m,
            radius_m=None if is_anywhere else radius_m,
            yaw_deg=None if is_any_yaw else belief.pose.yaw_deg,
            yaw_sigma_deg=None if is_any_yaw else belief.yaw_sigma_deg,
            scale_sigma=given.scale_sigma,
        )

    def _widened(self, belief: Belief) -> Belief:
        """Let a belief grow that nothing has corrected for long, up to the start's."""
        if belief.idle <= self.plan.patience or self._first is None:
            return belief
        place_m2 = _grown(belief.spreads_m[0], self._first.spreads_m[0], self.plan.widen)
        yaw_deg2 = _grown(belief.yaw_sigma_deg, self._first.yaw_sigma_deg, self.plan.widen)
        return replace(belief, covariance=belief.covariance + np.diag([place_m2, place_m2, yaw_deg2]))

    def _is_good(self, found: Match, away: float | None) -> bool:
        is_sure = found.confidence is None or found.confidence >= self.plan.least_confidence
        return away is not None and is_sure and away <= self.plan.gate


def _grown(sigma: float, most: float, factor: float) -> float:
    """Return the variance to add so that a standard deviation grows by a factor, but not beyond the most it may be."""
    return max(0.0, min(sigma * factor, most) ** 2 - sigma**2)


def distance(one: Pose, other: Pose, covariance: Covariance) -> float:
    """Return the Mahalanobis distance between two poses, given the covariance of their difference.

    >>> here, there = (Pose(easting_m=0.0, northing_m=0.0, yaw_deg=yaw_deg) for yaw_deg in (359.0, 1.0))
    >>> distance(here, there, np.diag([25.0, 25.0, 4.0]))
    1.0
    """
    east_m, north_m = other.easting_m - one.easting_m, other.northing_m - one.northing_m
    gap = np.array([east_m, north_m, float(wrap_deg(other.yaw_deg - one.yaw_deg))])
    return math.sqrt(max(0.0, float(gap @ np.linalg.solve(covariance, gap))))


def sound(covariance: Covariance) -> Covariance:
    """Return a covariance of a pose that is symmetric, invertible and of finite size, however long odometry was added.

    >>> np.sqrt(np.diag(sound(np.diag([2500.0, 400.0, 1e6])))).round(1).tolist()
    [50.0, 20.0, 103.9]
    """
    spread_m = math.sqrt(max(covariance[0, 0], covariance[1, 1], 0.0))
    spread_deg = math.sqrt(max(covariance[2, 2], 0.0))
    most_deg = reckoning.ANY_YAW_DEG
    place, yaw = min(1.0, _NO_MORE_M / max(spread_m, 1.0)), min(1.0, most_deg / max(spread_deg, 1.0))
    factors = np.diag([place, place, yaw])
    found = factors @ (covariance + covariance.T) @ factors / 2
    floor = _SHARE * float(np.trace(found))
    return np.asarray(found if np.linalg.eigvalsh(found)[0] > floor else found + floor * np.eye(SIDE))


def _told(prior: Prior, away: float | None) -> dict[str, float]:
    """Return numbers for a reader: the radius that was searched, and how far the answer was from the belief."""
    radius = {} if prior.radius_m is None else {"searched_m": prior.radius_m}
    return radius | ({} if away is None else {"mahalanobis": away})


def card_on_flights(card: MatcherCard, plan: FollowPlan | None = None) -> MatcherCard:
    """Return the card of a matcher of single views with a word on how it follows flights."""
    ours = f"{card.ours}; {_SAID.format(**asdict(plan or FollowPlan()))}"
    return replace(card, ours=ours if len(ours) <= MOST_SAID else card.ours, tracks=(*card.tracks, "sequence"))


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
