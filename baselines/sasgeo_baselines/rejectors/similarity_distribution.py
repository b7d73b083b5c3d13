# SPDX-License-Identifier: Apache-2.0
"""`similarity_distribution`: how far the first score stands out from all others."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from sasgeo_baselines.rejectors.leads import scores_of, with_withheld
from sasgeo_bench import Prediction, RejectorCard


class SimilarityDistribution:
    """Lead over the mean of the others, in their standard deviations, as a number from 0 to 1/2."""

    card = RejectorCard(
        name="similarity_distribution",
        version="2",
        title="Lead of the first score over the distribution of the others",
        source=(
            "Similarity Distribution of Miller, Milford, Hafez, Ramchurn and Ehsan, Through the Lens of Doubt, arXiv "
            "2510.13464, 2025, as its abstract describes it: the separation of the scores of the candidates, without "
            "training. Claxton et al., Improving Visual Place Recognition Based Robot Navigation By Verifying "
            "Localization Estimates, 2024, learn a verifier from statistics of all match distances"
        ),
        ours=(
            "The formula, which the abstract does not give: d is the lead of the first score over the mean of the "
            "others, over their standard deviation, which is at least a hundredth of the largest score in size; "
            "1 / (2 + d); a tie, or fewer than three candidates, says 1/2; withheld answers say 1"
        ),
        licence="Apache-2.0",
        limits=(
            "Uncalibrated; others are the candidates that the matcher gives, the best places, not all of a map; their "
            "number moves it; where they nearly tie, scores need a meaningful zero"
        ),
        is_calibrated=False,
    )

    def fit(self, predictions: Sequence[Prediction], is_false: NDArray[np.bool_]) -> None:
        """Do nothing."""

    def p_false(self, predictions: Sequence[Prediction]) -> NDArray[np.float64]:
        """Return values that fall as the first score stands out, from 1/2, shape (N,)."""
        return with_withheld(predictions, lambda answers: np.array([_doubt(item) for item in answers]))


def _doubt(item: Prediction) -> float:
    return 1 / (2 + distinctness(scores_of(item)))


def distinctness(scores: NDArray[np.float64]) -> float:
    """Return the lead of the first score over the mean of the others, in their standard deviations; 0 for too few.

    >>> distinctness(np.array([6.0, 3.0, 1.0])), round(distinctness(np.array([1.0, 0.99, 0.99])), 6)
    (4.0, 1.0)
    """
    if len(scores) < 3:  # candidates: of two, the rest has no spread
        return 0.0
    scaled = scores / max(float(np.abs(scores).max()), 1e-300)  # squares of large scores overflow
    first, others = scaled[0], scaled[1:]
    # 0.01: least spread of the largest score in size: where the others tie, a small lead is no certainty
    return max(float(first - others.mean()), 0.0) / max(float(others.std()), 0.01)
