# SPDX-License-Identifier: Apache-2.0
"""`ks_gate`: the Kolmogorov-Smirnov test of the rings of `polar_vsc`, at the first candidate."""

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from sasgeo_baselines.polar_vsc import PolarVsc
from sasgeo_baselines.rejectors.leads import with_withheld
from sasgeo_bench import Prediction, RejectorCard


class KsGate:
    """Share of rings that pass the test and least p-value, as a number from 0 to 1."""

    card = RejectorCard(
        name="ks_gate",
        version="1",
        title="Kolmogorov-Smirnov test of rings",
        source=(
            "Visual semantic context, NAVIGATION 71(1), navi.634, by its abstract: a Kolmogorov-Smirnov test rejects "
            "unlikely candidates"
        ),
        ours=(
            "The test as a rejector: 1 - (ks_share + ks_p) / 2 of the diagnostics of polar_vsc, which lies below 1/2 "
            f"where all rings pass at alpha {PolarVsc.chosen['alpha']:g}, and above it where one fails; answers "
            "without them, those of other matchers, say 1/2; withheld answers say 1"
        ),
        licence="Apache-2.0",
        limits=(
            "Uncalibrated: the numbers keep an order and are no probabilities; looks at the first candidate alone, and "
            "not at its rivals: where a map is alike at many places, all of them pass"
        ),
        is_calibrated=False,
    )

    def fit(self, predictions: Sequence[Prediction], is_false: NDArray[np.bool_]) -> None:
        """Do nothing."""

    def p_false(self, predictions: Sequence[Prediction]) -> NDArray[np.float64]:
        """Return values that fall with the share of rings that pass and with the least p-value, shape (N,)."""
        return with_withheld(predictions, lambda answers: np.array([gate(item) for item in answers]))


def gate(prediction: Prediction) -> float:
    """Return 1 - (ks_share + ks_p) / 2, and 1/2 where one of them is missing or no number from 0 to 1.

    >>> gate(Prediction(query_id="q", diagnostics={"ks_share": 1.0, "ks_p": 0.5}))
    0.25
    >>> gate(Prediction(query_id="q"))
    0.5
    """
    reported = [prediction.diagnostics.get(name, math.nan) for name in ("ks_share", "ks_p")]
    return 1 - sum(reported) / 2 if all(0 <= value <= 1 for value in reported) else 0.5
