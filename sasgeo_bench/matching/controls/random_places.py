# SPDX-License-Identifier: Apache-2.0
"""`random`: control that guesses, seeded by the id of the query."""

import hashlib
import math

import numpy as np

from sasgeo_bench.bounds import MOST_CANDIDATES
from sasgeo_bench.geometry.grid import Grid
from sasgeo_bench.geometry.pose import Pose
from sasgeo_bench.matching.controls.answers import is_blind, middle_m, ranked_candidates
from sasgeo_bench.matching.matcher import WITHHELD, Match, MatcherCard
from sasgeo_bench.regions.region import Region
from sasgeo_bench.tasks.query import Query


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
            message = f"{self.card.name}: call prepare() with a region before match()"
            raise RuntimeError(message)
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
