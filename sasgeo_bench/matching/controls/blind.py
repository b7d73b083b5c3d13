# SPDX-License-Identifier: Apache-2.0
"""Controls that do not look at the view, `prior_centre` and `random`; poses and ranks that simple matchers share."""

import hashlib
import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from sasgeo_bench.core.texts import MOST_CANDIDATES
from sasgeo_bench.geometry.grid import Grid
from sasgeo_bench.geometry.pose import Pose, Prior
from sasgeo_bench.matching.matcher import WITHHELD, Match, MatcherCard
from sasgeo_bench.regions.evidence import UNKNOWN
from sasgeo_bench.regions.region import Region
from sasgeo_bench.tasks.query import Query


def is_blind(query: Query) -> bool:
    """Return whether a view is wholly unknown."""
    return bool((query.evidence.cells == UNKNOWN).all())


def ranked_candidates(
    query: Query,
    scores: Sequence[float | None],
    *,
    top_k: int,
    poses: Sequence[Pose] | None = None,
    diagnostics: dict[str, float] | None = None,
) -> Match:
    """Rank the candidates of a retrieval query by score, larger is better; ties keep their order.

    Parameters
    ----------
    query : Query
        Of the track retrieval.
    scores : sequence of float or None
        One for each candidate; those with None are dropped.
    top_k : int
        Number of candidates to return.
    poses : sequence of Pose, optional
        One for each candidate, for heading and scale; the place is that of the candidate.
    diagnostics : dict of str to float, optional
        Diagnostics of the answer.
    """
    chosen = [(at, score) for at, score in enumerate(scores) if score is not None]
    chosen = sorted(chosen, key=lambda item: -item[1])[:top_k]
    turned = [
        replace(query.candidates[at], yaw_deg=poses[at].yaw_deg, scale=poses[at].scale)
        if poses is not None
        else query.candidates[at]
        for at, _ in chosen
    ]
    return Match(poses=turned, scores=[float(score) for _, score in chosen], diagnostics=dict(diagnostics or {}))


def offsets_m(points_m: NDArray[np.float64], place_m: tuple[float, float]) -> NDArray[np.float64]:
    """Return distances of places, shape (N, 2), from one place, metres."""
    return np.asarray(np.hypot(points_m[:, 0] - place_m[0], points_m[:, 1] - place_m[1]))


def points_of(poses: Sequence[Pose]) -> NDArray[np.float64]:
    """Return easting and northing of poses, shape (N, 2)."""
    return np.array([(pose.easting_m, pose.northing_m) for pose in poses], dtype=np.float64).reshape(-1, 2)


def middle_m(prior: Prior, grid: Grid) -> tuple[float, float]:
    """Return the centre of the disc of a prior, or of the map if it has none."""
    if prior.center_m is not None:
        return prior.center_m
    west_m, south_m, east_m, north_m = grid.bounds_m
    return (west_m + east_m) / 2, (south_m + north_m) / 2


def at_place(point_m: NDArray[np.float64] | tuple[float, float], prior: Prior) -> Pose:
    """Return the pose at a place with the heading of the prior, north if it has none."""
    return Pose(easting_m=float(point_m[0]), northing_m=float(point_m[1]), yaw_deg=prior.yaw_deg or 0.0)


class PriorCentre:
    """Answers with the centre of the prior's disc, or of the map; of candidates, the one nearest to their mean."""

    card = MatcherCard(
        name="prior_centre",
        version="2",
        title="Control: the middle of the prior",
        source="original",
        ours="All of it",
        licence="Apache-2.0",
        tracks=("retrieval", "localization"),
        limits="A control: looks at neither the view nor the map; withholds only where nothing was seen",
    )

    def __init__(self) -> None:
        self._region: Region | None = None

    def prepare(self, region: Region, learned: str | None) -> None:
        """Keep the map for queries without a disc."""
        del learned
        self._region = region

    def match(self, query: Query, *, top_k: int) -> Match:
        """Return the centre of the prior."""
        if self._region is None:
            raise RuntimeError(f"{self.card.name}: call prepare() with a region before match()")
        if is_blind(query):
            return WITHHELD
        if query.track == "retrieval":
            points_m = points_of(query.candidates)
            center = points_m.mean(axis=0) if len(points_m) else points_m.sum(axis=0)
            away_m = offsets_m(points_m, (float(center[0]), float(center[1])))
            return ranked_candidates(query, (-away_m).tolist(), top_k=top_k)
        poses = [at_place(middle_m(query.prior, self._region.grid), query.prior)][:top_k]
        return Match(poses=poses, scores=[0.0] * len(poses))


class RandomPlaces:
    """Draws places uniformly over the prior's disc, or the map, with headings of the prior; shuffles candidates."""

    card = MatcherCard(
        name="random",
        version="2",
        title="Control: chance",
        source="original",
        ours="All of it; chance comes from the SHA-256 of the query's id",
        licence="Apache-2.0",
        tracks=("retrieval", "localization"),
        limits="A control: looks at neither the view nor the map; withholds only where nothing was seen",
    )

    def __init__(self) -> None:
        self._grid: Grid | None = None

    def prepare(self, region: Region, learned: str | None) -> None:
        """Keep the outline of the map for queries without a disc."""
        del learned
        self._grid = region.grid

    def match(self, query: Query, *, top_k: int) -> Match:
        """Return random poses."""
        if self._grid is None:
            raise RuntimeError(f"{self.card.name}: call prepare() with a region before match()")
        if is_blind(query):
            return WITHHELD
        rng = generator(query.query_id)
        if query.track == "retrieval":
            drawn: dict[tuple[float, float], float] = {}  # one number for each place: equal candidates tie
            places = ((pose.easting_m, pose.northing_m) for pose in query.candidates)
            scores = [drawn.setdefault(place, float(rng.random())) for place in places]
            return ranked_candidates(query, scores, top_k=top_k)
        count = min(top_k, MOST_CANDIDATES)
        poses = [self._guess(query, self._grid, rng) for _ in range(count)]
        return Match(poses=poses, scores=sorted(rng.random(count).tolist(), reverse=True))

    def _guess(self, query: Query, grid: Grid, rng: np.random.Generator) -> Pose:
        prior = query.prior
        (east_m, north_m), chance = middle_m(prior, grid), rng.random(3)
        if prior.radius_m is not None:
            away_m, turn = prior.radius_m * math.sqrt(chance[0]), 2 * math.pi * chance[1]
            east_m, north_m = east_m + away_m * math.sin(turn), north_m + away_m * math.cos(turn)
        else:
            west_m, south_m, right_m, top_m = grid.bounds_m
            east_m, north_m = west_m + (right_m - west_m) * chance[0], south_m + (top_m - south_m) * chance[1]
        yaw_deg = 360 * float(chance[2])
        if prior.yaw_deg is not None and prior.yaw_sigma_deg is not None:
            yaw_deg = prior.yaw_deg + prior.yaw_sigma_deg * float(rng.standard_normal())
        return Pose(easting_m=float(east_m), northing_m=float(north_m), yaw_deg=yaw_deg)


def generator(query_id: str) -> np.random.Generator:
    """Return the random generator of a query; it depends on the id alone."""
    return np.random.default_rng(int.from_bytes(hashlib.sha256(query_id.encode()).digest()[:16], "big"))
