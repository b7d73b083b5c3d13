# SPDX-License-Identifier: Apache-2.0
"""The matcher kept-matcher: here is where your method goes."""

import numpy as np

from sasgeo_bench import PRESENT, UNKNOWN, WITHHELD, LayerBits, Match, Pose, Query, Region, observe, read_card

STEPS = 9  # places a side of the lattice that is searched when no candidates are given


class KeptMatcher:
    """Ranks places by how many seen cells the map has there too. A place to start from, no method to win with."""

    card = read_card(__file__)  # card.toml, beside this file

    def prepare(self, region: Region, learned: str | None) -> None:
        """Keep the map; called once for each one. `learned` is the text that its own `learn` returned."""
        self.region = region
        self.layers = LayerBits.of(region.layers)

    def match(self, query: Query, *, top_k: int) -> Match:
        """Score the candidates, or the places of a lattice over the prior's disc; best first."""
        if (query.evidence.cells == UNKNOWN).all():
            return WITHHELD
        places = query.candidates or self.lattice(query)
        scored = sorted(((self.score(query, pose), -at, pose) for at, pose in enumerate(places)), reverse=True)[:top_k]
        return Match(poses=[pose for _, _, pose in scored], scores=[score for score, _, _ in scored])

    def lattice(self, query: Query) -> list[Pose]:
        """Places spread over the prior's disc."""
        x, y = query.prior.center_m
        yaw_deg = query.prior.yaw_deg or 0.0
        steps = np.linspace(-1, 1, STEPS) * query.prior.radius_m
        return [
            Pose(easting_m=x + right, northing_m=y + up, yaw_deg=yaw_deg)
            for right in steps
            for up in steps
            if np.hypot(right, up) <= query.prior.radius_m
        ]

    def score(self, query: Query, pose: Pose) -> float:
        """Share of what is seen, class by class, that the map shows at a pose; unknown cells are left out."""
        seen = query.evidence
        there = observe(self.layers, self.region.grid, pose, size_cells=seen.shape[0], cell_size_m=seen.cell_size_m)
        order = [self.region.classes.index(name) for name in seen.classes]
        both_known = (seen.cells != UNKNOWN) & (there[order] != UNKNOWN)
        agree = both_known & (seen.cells == PRESENT) & (there[order] == PRESENT)
        either = both_known & ((seen.cells == PRESENT) | (there[order] == PRESENT))
        return float(agree.sum() / max(1, either.sum()))
