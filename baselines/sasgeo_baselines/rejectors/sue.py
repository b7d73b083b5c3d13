# SPDX-License-Identifier: Apache-2.0
"""`sue`: spread of the places of the first ten candidates (spatial uncertainty estimation)."""

from collections.abc import Sequence
from typing import Final

import numpy as np
from numpy.typing import NDArray
from sklearn.metrics import roc_auc_score  # type: ignore[import-untyped, unused-ignore]

from sasgeo_baselines.rejectors.leads import APART_M, Firsts, answered, with_withheld
from sasgeo_bench import Prediction, RejectorCard

MOST: Final = 10  # candidates, as in the source
SLOPES: Final = (1.0, 3.0, 10.0, 30.0)  # per usual standard deviation of the first ten scores
UNTAUGHT: Final = 10.0  # the slope where calibration knows one kind only


class Sue:
    """Variance of the places of the best candidates, as a number from 0 to 1."""

    card = RejectorCard(
        name="sue",
        version="2",
        title="Spread of the places of the first ten candidates",
        source=(
            "SUE: Zaffar, Nan and Kooij, On the Estimation of Image-matching Uncertainty in Visual Place Recognition, "
            "CVPR 2024, and its published code: weighted variance of the places of the ten nearest references, mean of "
            "both axes, offsets cut at 500 m, weights that fall exponentially with the distance of descriptors, by a "
            "slope that is set by hand for each data set"
        ),
        ours=(
            "Weights fall exponentially with the score's distance from the first; of the slopes "
            f"{', '.join(f'{slope:g}' for slope in SLOPES)} for each usual standard deviation of the first ten scores "
            "(the median over answers of calibration with any), the one that best tells false fixes there, by the area "
            f"under the ROC curve, and {UNTAUGHT:g} where calibration knows one kind only; offsets cut on both sides; "
            "as many candidates as are given, if fewer than ten; v / (v + 25 m squared), 25 m being the widest "
            "tolerance of the benchmark; one candidate alone has no spread and says 1/2; withheld answers say 1"
        ),
        licence="Apache-2.0",
        limits=(
            "Uncalibrated: calibration chooses the slope alone; measures the spacing of candidates, too: most matchers "
            "give none within 25 m of another, and none beyond the disc of the prior"
        ),
        is_calibrated=False,
    )

    def __init__(self) -> None:
        self.remark = ""
        self._slope: float | None = None

    def fit(self, predictions: Sequence[Prediction], is_false: NDArray[np.bool_]) -> None:
        """Choose the slope."""
        at = answered(predictions)
        firsts = Firsts.of([predictions[index] for index in at], MOST)
        truth = np.asarray(is_false, dtype=bool)[at]
        unit = _usual_spread(firsts)
        self.remark = ""
        if truth.all() or not truth.any():
            self._slope = UNTAUGHT / unit
            self.remark = f"answers of calibration are of one kind only: the slope is {UNTAUGHT:g}, not chosen"
            return
        areas = [roc_auc_score(truth, _doubts(firsts, slope / unit)) for slope in SLOPES]
        self._slope = SLOPES[int(np.argmax(areas))] / unit

    def p_false(self, predictions: Sequence[Prediction]) -> NDArray[np.float64]:
        """Return values that grow with the spread, shape (N,)."""
        slope = self._slope
        if slope is None:
            raise RuntimeError(f"{self.card.name}: call fit() with answers of calibration blocks before p_false()")
        return with_withheld(predictions, lambda answers: _doubts(Firsts.of(answers, MOST), slope))


def _usual_spread(firsts: Sequence[Firsts]) -> float:
    """Return the median of the standard deviations of the first scores, of answers with any; 1 if none has."""
    spreads = np.concatenate([np.empty(0), *(some.scores.std(axis=1) for some in firsts)])
    some = spreads[spreads > 1e-150]  # a smaller spread is none, so that quotients stay finite
    return float(np.median(some)) if len(some) else 1.0


def _doubts(firsts: Sequence[Firsts], slope: float) -> NDArray[np.float64]:
    found = np.empty(sum(len(some.at) for some in firsts))
    for some in firsts:
        # 500 m: as in the source: what is further away counts as that far
        variance_m2 = some.spreads_m2(slope=slope, far_m=500.0)
        is_alone = some.scores.shape[1] == 1
        found[some.at] = 1 / 2 if is_alone else variance_m2 / (variance_m2 + APART_M**2)
    return found
