# SPDX-License-Identifier: Apache-2.0
"""`map_density_prior`: control that answers with the fullest places of the map and ignores the view."""

import numpy as np

from sasgeo_baselines.global_descriptor import Sums, lattice_m, separate
from sasgeo_bench import (
    WITHHELD,
    Match,
    MatcherCard,
    Query,
    Region,
    at_place,
    is_blind,
    load_taxonomy,
    points_of,
    ranked_candidates,
)


class MapDensityPrior:
    """Ranks places within the prior by cells of roads, buildings, railways, streams and boundaries."""

    card = MatcherCard(
        name="map_density_prior",
        version="2",
        title="Control: where the map is fullest",
        source="original",
        ours="All of it: cells of drawn classes in upright squares of the view's side, on a lattice of 16 m",
        licence="Apache-2.0",
        tracks=("retrieval", "localization"),
        limits=(
            "A control: does not look at the view, but for its side; heading is the prior's; withholds only where "
            "nothing was seen"
        ),
    )

    def __init__(self) -> None:
        self._sums: Sums | None = None

    def prepare(self, region: Region, learned: str | None) -> None:
        """Sum the drawn classes of the map."""
        del learned
        self._sums = Sums.of(region, load_taxonomy().having("drawn"))
        self._grid = region.grid

    def match(self, query: Query, *, top_k: int) -> Match:
        """Return the fullest places."""
        if self._sums is None:
            raise RuntimeError(f"{self.card.name}: call prepare() with a region before match()")
        if is_blind(query):
            return WITHHELD
        side_m = max(query.evidence.size_m)
        if query.track == "retrieval":
            drawn = self._sums.squares(points_of(query.candidates), side_m)[:-1].sum(axis=0)
            return ranked_candidates(query, drawn.astype(np.float64).tolist(), top_k=top_k)
        points_m = lattice_m(query.prior, self._grid, step_m=16.0)
        drawn = self._sums.squares(points_m, side_m)[:-1].sum(axis=0).astype(np.float64)
        chosen = separate(points_m, drawn, apart_m=25.0, most=top_k)
        poses = [at_place(points_m[at], query.prior) for at in chosen]
        return Match(poses=poses, scores=[float(drawn[at]) for at in chosen])
