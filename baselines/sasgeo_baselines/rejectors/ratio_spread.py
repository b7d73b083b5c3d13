# SPDX-License-Identifier: Apache-2.0
"""`ratio_spread`: how far the ratios of the further scores to the first spread from it."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from sasgeo_baselines.rejectors.leads import ratios, scores_of, with_withheld
from sasgeo_bench import Prediction, RejectorCard


class RatioSpread:
    """Spread of the ratios of the first ten scores to the best, as a number from 0 to 1/2."""

    card = RejectorCard(
        name="ratio_spread",
        version="1",
        title="Spread of the ratios of scores to the first",
        source=(
            "Ratio Spread of Miller, Milford, Hafez, Ramchurn and Ehsan, Through the Lens of Doubt, arXiv 2510.13464, "
            "2025, as its abstract describes it: how much the top-scoring places compete, from scores alone and "
            "without training"
        ),
        ours=(
            "The formula, which the abstract does not give: r is the root mean square of 1 less the ratios of the "
            "further scores to the first, among the first ten; (1 - r) / 2, so that a tie of all says 1/2; ratios as "
            "in score_ratio; one candidate alone is taken for a tie; withheld answers say 1"
        ),
        licence="Apache-2.0",
        limits=(
            "Uncalibrated; needs scores with a meaningful zero; blind to where the places lie, so that neighbours of "
            "the right place count as rivals; the number of candidates that a matcher gives moves it"
        ),
        is_calibrated=False,
    )

    def fit(self, predictions: Sequence[Prediction], is_false: NDArray[np.bool_]) -> None:
        """Do nothing."""

    def p_false(self, predictions: Sequence[Prediction]) -> NDArray[np.float64]:
        """Return values that fall as the ratios spread, from 1/2, shape (N,)."""
        return with_withheld(predictions, lambda answers: np.array([_doubt(item) for item in answers]))


def _doubt(item: Prediction) -> float:
    return (1 - spread_of_ratios(scores_of(item))) / 2


def spread_of_ratios(scores: NDArray[np.float64]) -> float:
    """Return the root mean square of 1 less the ratios of the further scores to the first, 0..1; 0 for one score.

    >>> spread_of_ratios(np.array([4.0, 3.0, 3.0])), spread_of_ratios(np.array([4.0, 4.0]))
    (0.25, 0.0)
    """
    gaps = 1 - ratios(scores[:10])  # 10 candidates that compete: as many as `sue` looks at
    return float(np.sqrt(np.square(gaps).mean())) if len(gaps) else 0.0
