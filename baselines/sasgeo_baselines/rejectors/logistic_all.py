# SPDX-License-Identifier: Apache-2.0
"""`logistic_all`: logistic regression on all scores and diagnostics of an answer."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final, Self

import numpy as np
from numpy.typing import NDArray
from sklearn.linear_model import LogisticRegression  # type: ignore[import-untyped, unused-ignore]

from sasgeo_baselines.rejectors.leads import (
    MOST,
    answered,
    base_rate,
    entropy,
    margin,
    margin_nms,
    scores_of,
    with_withheld,
)
from sasgeo_bench import Prediction, RejectorCard

_FAR: Final = 10.0  # standard deviations: features are clipped to it


class LogisticAll:
    """Margins, entropy, number of candidates, best score and shared diagnostics, weighed by calibration."""

    card = RejectorCard(
        name="logistic_all",
        version="1",
        title="Logistic regression on all an answer tells",
        source="SASGeo paper (Trukhina and Vashkelis), Section V: what a probability may be calibrated from",
        ours=(
            "scikit-learn's LogisticRegression with its own penalty (C = 1) on standardised features: the margins with "
            "and without suppression, entropy, number of candidates, best score, and every diagnostic that all "
            "answers of calibration give; what an answer lacks is the median of calibration; beyond 10 standard "
            "deviations all is 10; the share of false fixes with one more of each kind where calibration knows one "
            "kind only; withheld answers say 1 and are not learnt from"
        ),
        licence="Apache-2.0",
        limits=(
            "Linear in its features, of which entropy is nearly blind to the lead of the first score; fitted for one "
            "matcher; as good as calibration is like the test"
        ),
    )

    def __init__(self) -> None:
        self._model: _Model | float | None = None

    def fit(self, predictions: Sequence[Prediction], is_false: NDArray[np.bool_]) -> None:
        """Fit the weights."""
        at = answered(predictions)
        truth = np.asarray(is_false, dtype=bool)[at]
        if truth.all() or not truth.any():
            self._model = base_rate(truth)
        else:
            self._model = _Model.of([predictions[index] for index in at], truth)

    def p_false(self, predictions: Sequence[Prediction]) -> NDArray[np.float64]:
        """Return calibrated probabilities of a false fix, shape (N,)."""
        model = self._model
        if model is None:
            raise RuntimeError(f"{self.card.name}: call fit() with answers of calibration blocks before p_false()")
        if isinstance(model, float):
            return with_withheld(predictions, lambda answers: np.full(len(answers), model))
        return with_withheld(predictions, model.p_false)


@dataclass(frozen=True, kw_only=True)
class _Model:
    """Fitted model: names of diagnostics, and median, mean and spread of each feature."""

    names: tuple[str, ...]
    medians: NDArray[np.float64]
    means: NDArray[np.float64]
    spreads: NDArray[np.float64]
    weights: LogisticRegression

    @classmethod
    def of(cls, answers: Sequence[Prediction], is_false: NDArray[np.bool_]) -> Self:
        shared = set.intersection(*(set(item.diagnostics) for item in answers))
        names = tuple(sorted(name for name in shared if any(math.isfinite(item.diagnostics[name]) for item in answers)))
        raw = features(answers, names)
        medians = np.nanmedian(raw, axis=0)
        filled = np.where(np.isnan(raw), medians, raw)
        means, spreads = filled.mean(axis=0), filled.std(axis=0)
        # 1e-150: a smaller spread is zero, so that quotients stay finite
        varies = (np.ptp(filled, axis=0) > 0) & (spreads > 1e-150)
        spreads = np.where(varies, spreads, 1.0)
        weights = LogisticRegression(solver="newton-cholesky", tol=1e-8, max_iter=1000)
        weights.fit(_standardised(filled, means, spreads), is_false)
        return cls(names=names, medians=medians, means=means, spreads=spreads, weights=weights)

    def p_false(self, answers: Sequence[Prediction]) -> NDArray[np.float64]:
        """Return probabilities of a false fix, shape (N,)."""
        raw = features(answers, self.names)
        filled = np.where(np.isnan(raw), self.medians, raw)
        chances = self.weights.predict_proba(_standardised(filled, self.means, self.spreads))
        # 12 decimals of a probability: the last digits of a fit depend on memory alignment
        return np.asarray(chances[:, 1], dtype=np.float64).round(12)


def features(answers: Sequence[Prediction], names: Sequence[str]) -> NDArray[np.float64]:
    """Return margins, entropy, candidate count, best score and diagnostics, shape (N, 5 + names); NaN if missing."""
    rows = [
        [
            margin(item), margin_nms(item), entropy(item), len(item.candidates), scores_of(item)[0],
            *(_finite(item.diagnostics.get(name, math.nan)) for name in names),
        ]
        for item in answers
    ]  # fmt: skip
    return np.array(rows, dtype=np.float64)


def _finite(value: float) -> float:
    return min(max(value, -MOST), MOST) if math.isfinite(value) else math.nan


def _standardised(
    filled: NDArray[np.float64], means: NDArray[np.float64], spreads: NDArray[np.float64]
) -> NDArray[np.float64]:
    return np.asarray(np.clip((filled - means) / spreads, -_FAR, _FAR))
