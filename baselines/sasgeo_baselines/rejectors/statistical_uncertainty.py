# SPDX-License-Identifier: Apache-2.0
"""`statistical_uncertainty`: `similarity_distribution` and `ratio_spread` together."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from sasgeo_baselines.rejectors.leads import scores_of, with_withheld
from sasgeo_baselines.rejectors.ratio_spread import spread_of_ratios
from sasgeo_baselines.rejectors.similarity_distribution import distinctness
from sasgeo_bench import Prediction, RejectorCard


class StatisticalUncertainty:
    """Lead over the others in their standard deviations, times the spread of ratios, as a number from 0 to 1/2."""

    card = RejectorCard(
        name="statistical_uncertainty",
        version="1",
        title="Lead of the first score times the spread of ratios",
        source=(
            "Statistical Uncertainty of Miller, Milford, Hafez, Ramchurn and Ehsan, Through the Lens of Doubt, arXiv "
            "2510.13464, 2025, as its abstract describes it: Similarity Distribution and Ratio Spread combined, so "
            "that no validation data are needed to choose between them"
        ),
        ours=(
            "The formula: the abstract says only that the two are combined, here by the product s of d of "
            "similarity_distribution and r of ratio_spread; 1 / (2 + s); a tie, or fewer than three candidates, says "
            "1/2; withheld answers say 1"
        ),
        licence="Apache-2.0",
        limits=(
            "Uncalibrated; needs scores with a meaningful zero; blind to where the places lie; the number of "
            "candidates that a matcher gives moves it"
        ),
        is_calibrated=False,
    )

    def fit(self, predictions: Sequence[Prediction], is_false: NDArray[np.bool_]) -> None:
        """Do nothing."""

    def p_false(self, predictions: Sequence[Prediction]) -> NDArray[np.float64]:
        """Return values that fall as the first score stands out, from 1/2, shape (N,)."""
        return with_withheld(predictions, lambda answers: np.array([_doubt(item) for item in answers]))


def _doubt(item: Prediction) -> float:
    scores = scores_of(item)
    return 1 / (2 + distinctness(scores) * spread_of_ratios(scores))
