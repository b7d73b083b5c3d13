# SPDX-License-Identifier: Apache-2.0
"""`isotonic_margin`: the margin, calibrated by isotonic regression."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from sklearn.isotonic import IsotonicRegression  # type: ignore[import-untyped, unused-ignore]

from sasgeo_baselines.rejectors.leads import answered, base_rate, margin, with_withheld
from sasgeo_bench import Prediction, RejectorCard


class IsotonicMargin:
    """Share of false fixes at a margin, never rising with it."""

    card = RejectorCard(
        name="isotonic_margin",
        version="1",
        title="Margin, calibrated by isotonic regression",
        source="Zadrozny and Elkan, KDD 2002, on the margin of the SASGeo paper (Trukhina and Vashkelis)",
        ours=(
            "scikit-learn's IsotonicRegression, linear between knots and clipped beyond them; equal margins are "
            "averaged; the share of false fixes with one more of each kind where calibration knows one kind only; "
            "withheld answers say 1 and are not learnt from"
        ),
        licence="Apache-2.0",
        limits="Orders answers as the margin does, up to ties: the curve of risk over coverage gains nothing",
    )

    def __init__(self) -> None:
        self._curve: IsotonicRegression | float | None = None

    def fit(self, predictions: Sequence[Prediction], is_false: NDArray[np.bool_]) -> None:
        """Fit the share of false fixes by margin."""
        at = answered(predictions)
        truth = np.asarray(is_false, dtype=bool)[at]
        if truth.all() or not truth.any():
            self._curve = base_rate(truth)
            return
        margins = [margin(predictions[index]) for index in at]
        curve = IsotonicRegression(y_min=0.0, y_max=1.0, increasing=False, out_of_bounds="clip")
        self._curve = curve.fit(margins, truth.astype(np.float64))

    def p_false(self, predictions: Sequence[Prediction]) -> NDArray[np.float64]:
        """Return calibrated shares of false fixes, shape (N,)."""
        curve = self._curve
        if curve is None:
            raise RuntimeError(f"{self.card.name}: call fit() with answers of calibration blocks before p_false()")
        if isinstance(curve, float):
            return with_withheld(predictions, lambda answers: np.full(len(answers), curve))
        return with_withheld(predictions, lambda answers: np.asarray(curve.predict([margin(item) for item in answers])))
