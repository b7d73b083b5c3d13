# SPDX-License-Identifier: Apache-2.0
"""`prior_centre`: control that answers with the prior alone."""

from sasgeo_bench.matching.controls.answers import (
    at_place,
    is_blind,
    middle_m,
    offsets_m,
    points_of,
    ranked_candidates,
)
from sasgeo_bench.matching.matcher import WITHHELD, Match, MatcherCard
from sasgeo_bench.regions.region import Region
from sasgeo_bench.tasks.query import Query


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
            message = f"{self.card.name}: call prepare() with a region before match()"
            raise RuntimeError(message)
        if is_blind(query):
            return WITHHELD
        if query.track == "retrieval":
            points_m = points_of(query.candidates)
            center = points_m.mean(axis=0) if len(points_m) else points_m.sum(axis=0)
            away_m = offsets_m(points_m, (float(center[0]), float(center[1])))
            return ranked_candidates(query, (-away_m).tolist(), top_k=top_k)
        poses = [at_place(middle_m(query.prior, self._region.grid), query.prior)][:top_k]
        return Match(poses=poses, scores=[0.0] * len(poses))
