# SPDX-License-Identifier: Apache-2.0
"""`similarity_distribution`: how far the first score stands out from all others."""

from collections.abc import Sequence
from typing import Final

import numpy as np
from numpy.typing import NDArray

from sasgeo_baselines.rejectors.leads import scores_of, with_withheld
from sasgeo_bench import Prediction, RejectorCard

FEWEST: Final = 3  # candidates: of two, the rest has no spread


class SimilarityDistribution:
    """Lead over the mean of the others, in their standard deviations, as a number from 0 to 1/2."""

    card = RejectorCard(
        name="similarity_distribution",
        version="1",
        title="Lead of the first score over the distribution of the others",
        source=(
            "Similarity Distribution of Miller, Milford, Hafez, Ramchurn and Ehsan, Through the Lens of Doubt, arXiv "
            "2510.13464, 2025, as its abstract describes it: the separation of the scores of the candidates, without "
            "training. Claxton et al., Improving Visual Place Recognition Based Robot Navigation By Verifying "
            "Localization Estimates, 2024, learn a verifier from statistics of all match distances"
        ),
        ours=(
            "The formula, which the abstract does not give: d is the lead of the first score over the mean of the "
            "others, over their standard deviation; 1 / (2 + d); a tie, or fewer than three candidates, says 1/2; "
            "withheld answers say 1"
        ),
        licence="Apache-2.0",
        limits=(
            "Uncalibrated; others are the candidates that the matcher gives, the best places, not all of a map; their "
            "number moves it"
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
    if len(scores) < FEWEST:
        return 1 / 2
    scores = scores / max(float(np.abs(scores).max()), 1e-300)  # squares of large scores overflow
    first, others = scores[0], scores[1:]
    lead, spread = float(first - others.mean()), float(others.std())
    return spread / (2 * spread + lead) if lead > 0 else 1 / 2
