# SPDX-License-Identifier: Apache-2.0
"""`fft_vote`: every place, heading and scale within the prior, voted for by three-state correlation."""

import numpy as np
from numpy.typing import NDArray

from sasgeo_baselines.chart import Chart
from sasgeo_baselines.dense_matcher import DenseMatcher
from sasgeo_baselines.voting import Gains, make_template
from sasgeo_bench import Evidence, MatcherCard, Region


class FftVote(DenseMatcher):
    """Exhaustive three-state voting, one for every class and cell: the reference that others are held against."""

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
        """Take the map as it is."""
        return Chart.of(region)

    def template(self, evidence: Evidence) -> NDArray[np.float64]:
        """Three states, one vote each."""
        return make_template(evidence.cells, Gains.uniform(len(evidence.classes)))
