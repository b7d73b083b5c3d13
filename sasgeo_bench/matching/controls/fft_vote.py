# SPDX-License-Identifier: Apache-2.0
"""`fft_vote`: three-state correlation at every place, heading and scale within the prior."""

import numpy as np
from numpy.typing import NDArray

from sasgeo_bench.matching.controls.dense_matcher import DenseMatcher
from sasgeo_bench.matching.matcher import MatcherCard
from sasgeo_bench.regions.evidence import Evidence
from sasgeo_bench.regions.region import Region
from sasgeo_bench.search.chart import Chart
from sasgeo_bench.search.votes import VoteGains, make_template


class FftVote(DenseMatcher):
    """Exhaustive three-state voting, one vote for each class and cell: the reference search of every board."""

    card = MatcherCard(
        name="fft_vote",
        version="2",
        title="Exhaustive three-state voting by FFT",
        source="Template voting of OrienterNet (Sarlin et al., CVPR 2023), on the scores of the SASGeo paper, Eqs. 7-8",
        ours=(
            "One vote a class and cell in place of learned features; division by the cells known on both sides; "
            "scale; half of the view must be on the map; coarse cells of 4 m (8 m beyond 5 km2), then local search"
        ),
        licence="Apache-2.0",
        tracks=("retrieval", "localization"),
        limits=(
            "No class weighs more than another and nothing is learnt; headings and scales beyond two standard "
            "deviations are not searched; candidates that share a place within 24 m cannot be told apart; no confidence"
        ),
    )

    def read(self, region: Region) -> Chart:
        """Return the map unchanged."""
        return Chart.of(region)

    def template(self, evidence: Evidence) -> NDArray[np.float64]:
        """Return the template with gains of 1."""
        return make_template(evidence.cells, VoteGains.uniform(len(evidence.classes)))
