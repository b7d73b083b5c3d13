# SPDX-License-Identifier: Apache-2.0
"""`score_ratio`: ratio of the scores of the second and the first candidate."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from sasgeo_baselines.rejectors.leads import ratios, scores_of, with_withheld
from sasgeo_bench import Prediction, RejectorCard


class ScoreRatio:
    """Ratio of the second score to the first, as a number from 0 to 1/2."""

    card = RejectorCard(
        name="score_ratio",
        version="1",
        title="Ratio of the first two scores",
        source=(
            "Lowe, IJCV 2004, for features; for place recognition as the ratio of the first two distances, one of the "
            "retrieval-based estimates in Zaffar, Nan and Kooij, CVPR 2024 (its PA-score)"
        ),
        ours=(
            "Half the ratio of the second score to the first, or of the distances where scores are negative; a second "
            "score that is not positive, beside a first that is, counts as 0; one candidate alone is taken for a tie; "
            "withheld answers say 1"
        ),
        licence="Apache-2.0",
        limits=(
            "Uncalibrated; needs scores with a meaningful zero: of logarithms of likelihoods a ratio says little; the "
            "second candidate may be the same place"
        ),
        is_calibrated=False,
    )

    def fit(self, predictions: Sequence[Prediction], is_false: NDArray[np.bool_]) -> None:
        """Do nothing."""

    def p_false(self, predictions: Sequence[Prediction]) -> NDArray[np.float64]:
        """Return values that grow with the ratio, to 1/2, shape (N,)."""
        return with_withheld(
            predictions,
            lambda answers: np.array([max(ratios(scores_of(item)[:2]), default=1.0) / 2 for item in answers]),
        )
