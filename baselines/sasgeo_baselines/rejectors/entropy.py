# SPDX-License-Identifier: Apache-2.0
"""`entropy`: spread of the scores over places."""

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from sasgeo_baselines.rejectors.leads import entropy, with_withheld
from sasgeo_bench import Prediction, RejectorCard


class Entropy:
    """One less the inverse of the effective number of candidates."""

    card = RejectorCard(
        name="entropy",
        version="1",
        title="Entropy over candidates",
        source="SASGeo paper (Trukhina and Vashkelis), Section V: posterior entropy",
        ours=(
            "Softmax of the scores over their standard deviation, entropy H; 1 - exp(-H), which is 1 - 1/n for n "
            "equals; one candidate alone is taken for two that tie; withheld answers say 1"
        ),
        licence="Apache-2.0",
        limits=(
            "Uncalibrated: the softmax has no fitted temperature; blind to the scale of the scores and so, "
            "nearly, to the lead of the first; the number of candidates that a matcher gives moves it"
        ),
        is_calibrated=False,
    )

    def fit(self, predictions: Sequence[Prediction], is_false: NDArray[np.bool_]) -> None:
        """Do nothing."""

    def p_false(self, predictions: Sequence[Prediction]) -> NDArray[np.float64]:
        """Return values that grow with the entropy, shape (N,)."""
        return with_withheld(predictions, lambda answers: np.array([-math.expm1(-entropy(item)) for item in answers]))
