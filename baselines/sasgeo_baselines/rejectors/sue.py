# SPDX-License-Identifier: Apache-2.0
"""`sue`: spread of the places of the first ten candidates (spatial uncertainty estimation)."""

from collections.abc import Sequence
from typing import Final

import numpy as np
from numpy.typing import NDArray

from sasgeo_baselines.rejectors.leads import APART_M, spread_m2, with_withheld
from sasgeo_bench import Prediction, RejectorCard

MOST: Final = 10  # candidates, as in the source
FAR_M: Final = 500.0  # as in the source: what is further away counts as that far


class Sue:
    """Variance of the places of the best candidates, as a number from 0 to 1."""

    card = RejectorCard(
        name="sue",
        version="1",
        title="Spread of the places of the first ten candidates",
        source=(
            "SUE: Zaffar, Nan and Kooij, On the Estimation of Image-matching Uncertainty in Visual Place Recognition, "
            "CVPR 2024, and its published code: weighted variance of the places of the ten nearest references, mean of "
            "both axes, offsets cut at 500 m, weights that fall exponentially with the distance of descriptors"
        ),
        ours=(
            "Weights by a softmax of the scores over their standard deviation, in place of a slope that is chosen for "
            "each data set; offsets cut on both sides; as many candidates as are given, if fewer than ten; v / (v + 25 "
            "m squared), 25 m being the widest tolerance of the benchmark; one candidate alone has no spread and says "
            "1/2; withheld answers say 1"
        ),
        licence="Apache-2.0",
        limits=(
            "Uncalibrated; measures the spacing of candidates, too: most matchers give none within 25 m of another, "
            "and none beyond the disc of the prior"
        ),
        is_calibrated=False,
    )

    def fit(self, predictions: Sequence[Prediction], is_false: NDArray[np.bool_]) -> None:
        """Do nothing."""

    def p_false(self, predictions: Sequence[Prediction]) -> NDArray[np.float64]:
        """Return values that grow with the spread, shape (N,)."""
        return with_withheld(predictions, lambda answers: np.array([_doubt(item) for item in answers]))


def _doubt(item: Prediction) -> float:
    if len(item.candidates) == 1:
        return 1 / 2
    variance_m2 = spread_m2(item, most=MOST, far_m=FAR_M)
    return variance_m2 / (variance_m2 + APART_M**2)
