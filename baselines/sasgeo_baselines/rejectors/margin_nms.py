# SPDX-License-Identifier: Apache-2.0
"""`margin_nms`: lead of the first candidate over the best one at another place."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from sasgeo_baselines.rejectors.leads import margin_nms, with_withheld
from sasgeo_bench import Prediction, RejectorCard


class MarginNms:
    """Lead over the best candidate at another place, as a number from 0 to 1/2."""

    card = RejectorCard(
        name="margin_nms",
        version="1",
        title="Lead over the best candidate 25 m away or more",
        source="SASGeo paper (Trukhina and Vashkelis), Section VI, with the usual suppression of neighbours",
        ours=(
            "25 m, the widest tolerance of the benchmark; where all candidates lie nearer, the lead over the last one, "
            "as a rival that is not given is no better; 1 / (2 + margin); withheld answers say 1"
        ),
        licence="Apache-2.0",
        limits="Uncalibrated: numbers keep an order and are no probabilities; scores of another scale give others",
        is_calibrated=False,
    )

    def fit(self, predictions: Sequence[Prediction], is_false: NDArray[np.bool_]) -> None:
        """Do nothing."""

    def p_false(self, predictions: Sequence[Prediction]) -> NDArray[np.float64]:
        """Return values that fall with the lead, from 1/2, shape (N,)."""
        return with_withheld(predictions, lambda answers: np.array([1 / (2 + margin_nms(item)) for item in answers]))
