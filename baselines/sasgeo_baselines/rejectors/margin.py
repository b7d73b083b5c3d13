# SPDX-License-Identifier: Apache-2.0
"""`margin`: lead of the first candidate over the second."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from sasgeo_baselines.rejectors.leads import margin, with_withheld
from sasgeo_bench import Prediction, RejectorCard


class Margin:
    """Lead over the second candidate, as a number from 0 to 1/2."""

    card = RejectorCard(
        name="margin",
        version="1",
        title="Lead over the second candidate",
        source="SASGeo paper (Trukhina and Vashkelis), the uncalibrated statistic of its Section VI",
        ours="1 / (2 + margin), so that a tie says 1/2; one candidate alone has no lead; withheld answers say 1",
        licence="Apache-2.0",
        limits=(
            "Uncalibrated: the numbers keep an order and are no probabilities; the second candidate may be the same "
            "place; scores of another scale give other numbers"
        ),
        is_calibrated=False,
    )

    def fit(self, predictions: Sequence[Prediction], is_false: NDArray[np.bool_]) -> None:
        """Do nothing."""

    def p_false(self, predictions: Sequence[Prediction]) -> NDArray[np.float64]:
        """Return values that fall with the lead, from 1/2, shape (N,)."""
        return with_withheld(predictions, lambda answers: np.array([1 / (2 + margin(item)) for item in answers]))
