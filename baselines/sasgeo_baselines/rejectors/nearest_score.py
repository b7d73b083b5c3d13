# SPDX-License-Identifier: Apache-2.0
"""`nearest_score`: score of the first candidate alone."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from sasgeo_baselines.rejectors.leads import scores_of, with_withheld
from sasgeo_bench import Prediction, RejectorCard


class NearestScore:
    """Best score, as a number that falls with it."""

    card = RejectorCard(
        name="nearest_score",
        version="1",
        title="Score of the first candidate alone",
        source=(
            "The usual check of place recognition: accept what is near enough in descriptor space; the first of the "
            "retrieval-based estimates in Zaffar, Nan and Kooij, CVPR 2024"
        ),
        ours=(
            "Any score in place of a distance of descriptors: 1 / (2 + score) for positive ones, 1 - 1 / (2 - score) "
            "for others, so that 0 says 1/2; withheld answers say 1"
        ),
        licence="Apache-2.0",
        limits=(
            "Uncalibrated: numbers keep an order and are no probabilities; blind to rivals; scores of one matcher must "
            "be comparable between views"
        ),
        is_calibrated=False,
    )

    def fit(self, predictions: Sequence[Prediction], is_false: NDArray[np.bool_]) -> None:
        """Do nothing."""

    def p_false(self, predictions: Sequence[Prediction]) -> NDArray[np.float64]:
        """Return values that fall with the best score, shape (N,)."""
        return with_withheld(
            predictions, lambda answers: np.array([_doubt(float(scores_of(item)[0])) for item in answers])
        )


def _doubt(score: float) -> float:
    return 1 / (2 + score) if score > 0 else 1 - 1 / (2 - score)
