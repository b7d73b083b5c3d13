# SPDX-License-Identifier: Apache-2.0
"""`sasgeo_logistic`, `sasgeo_boosted`: P(false fix | evidence) of Eq. 14, fitted on calibration blocks."""

import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final, Self

import numpy as np
from numpy.typing import NDArray
from scipy import special

from sasgeo_bench.matching.matcher import Prediction, RejectorCard
from sasgeo_bench.sasgeo.conformal import upper_rate
from sasgeo_bench.sasgeo.integrity import APART_M, EVIDENCE, Diagnostic

if TYPE_CHECKING:
    from sklearn.ensemble import GradientBoostingClassifier  # type: ignore[import-untyped, unused-ignore]

Rows = NDArray[np.float64]

_MOST: Final = 1e100  # numbers are clipped to it, so that squares and differences stay finite
_FAR: Final = 10.0  # standard deviations: features are clipped to it
_SURE: Final = 1e-6  # least distance of a confidence from 0 and 1


def is_none(prediction: Prediction) -> bool:
    """Return whether an answer has no candidate, or its view was wholly unknown."""
    return not prediction.candidates or 1.0 <= prediction.diagnostics.get("unknown_share", 0.0) < math.inf


def lead(prediction: Prediction) -> float:
    """Return the score of the first candidate less that of the best one outside the suppression radius.

    Without one outside, less that of the last candidate: a rival that was not returned scores no better.
    """
    (first, best), *others = prediction.candidates
    away = (
        score
        for pose, score in others
        if math.hypot(pose.easting_m - first.easting_m, pose.northing_m - first.northing_m) >= APART_M
    )
    return _clipped(best) - _clipped(next(away, prediction.candidates[-1][1]))


def _clipped(value: float) -> float:
    return min(max(value, -_MOST), _MOST)


def features(answers: Sequence[Prediction]) -> Rows:
    """Return features of answers, shape (N, 2 + evidence): lead, confidence, then `EVIDENCE`; NaN where missing."""
    rows = [
        [math.asinh(lead(item)), _logit(item.confidence), *(_evidence(item, one) for one in EVIDENCE)]
        for item in answers
    ]
    return np.array(rows, dtype=np.float64).reshape(-1, 2 + len(EVIDENCE))


def _logit(confidence: float | None) -> float:
    if confidence is None or not math.isfinite(confidence):
        return math.nan
    return float(special.logit(min(max(confidence, _SURE), 1.0 - _SURE)))


def _evidence(answer: Prediction, item: Diagnostic) -> float:
    value = answer.diagnostics.get(item.name, math.nan)
    if not math.isfinite(value):
        return math.nan
    return math.asinh(_clipped(value)) if item.is_wide else _clipped(value)


@dataclass(frozen=True, kw_only=True)
class Frame:
    """Medians, flags, means and spreads of calibration, which turn raw features into complete rows."""

    medians: NDArray[np.float64]
    is_flagged: NDArray[np.bool_]
    means: NDArray[np.float64]
    spreads: NDArray[np.float64]

    @classmethod
    def of(cls, raw: Rows) -> Self:
        """Fit to raw features; a feature that all answers lack is 0."""
        gap = np.isnan(raw)
        is_given = np.asarray(~gap.all(axis=0))
        medians = np.zeros(raw.shape[1])
        medians[is_given] = np.nanmedian(raw[:, is_given], axis=0)
        is_flagged = np.asarray(gap.any(axis=0) & is_given)
        rows = cls._with_flags(raw, medians, is_flagged)
        spreads = rows.std(axis=0)
        # A feature that is constant in calibration must not count later: its spread is infinite.
        # 1e-12: a smaller spread is zero
        spreads = np.where((spreads > 1e-12 * np.maximum(1.0, np.abs(rows).max(axis=0))), spreads, np.inf)
        return cls(medians=medians, is_flagged=is_flagged, means=rows.mean(axis=0), spreads=spreads)

    def filled(self, raw: Rows) -> Rows:
        """Return standardised features and flags, shape (N, features + flags)."""
        rows = self._with_flags(raw, self.medians, self.is_flagged)
        return np.asarray(np.clip((rows - self.means) / self.spreads, -_FAR, _FAR))

    @staticmethod
    def _with_flags(raw: Rows, medians: NDArray[np.float64], is_flagged: NDArray[np.bool_]) -> Rows:
        gap = np.isnan(raw)
        return np.hstack((np.where(gap, medians, raw), gap[:, is_flagged].astype(np.float64)))


FEW: Final = 5  # least number of right and of false answers for a fit
_FOLDS: Final = 4


# From complete rows of features, shape (N, F), to log-odds of a false fix, shape (N,).
LogOdds = Callable[[Rows], NDArray[np.float64]]


@dataclass(frozen=True, kw_only=True)
class Linear:
    """Log-odds that are linear in features: a weight for each, shape (F,), and what they are where all are 0."""

    weights: NDArray[np.float64]
    intercept: float

    def __call__(self, rows: Rows) -> NDArray[np.float64]:
        """Return the log-odds of rows, shape (N,)."""
        return np.asarray(rows @ self.weights + self.intercept)


@dataclass(frozen=True, kw_only=True)
class FittedModel:
    """Log-odds of a false fix, fitted on so many answers of calibration."""

    frame: Frame
    log_odds: LogOdds
    answers: int

    def p_false(self, answers: Sequence[Prediction]) -> NDArray[np.float64]:
        """Return the probability of a false fix, shape (N,)."""
        chance = special.expit(self.log_odds(self.frame.filled(features(answers))))
        return np.asarray((self.answers * chance + 1.0) / (self.answers + 2.0))


class _Fitted(ABC):
    """Base of both rules: choice of calibration answers, and a fallback where no fit is possible."""

    card: RejectorCard

    def __init__(self, rule: FittedModel | None = None) -> None:
        self.remark = ""
        self.rule: FittedModel | Counted | None = rule

    @abstractmethod
    def learn(self, rows: Rows, is_false: NDArray[np.bool_]) -> LogOdds:
        """Fit the model."""

    def fit(self, predictions: Sequence[Prediction], is_false: NDArray[np.bool_]) -> None:
        """Fit to answers of calibration blocks, without withheld ones and views wholly unknown."""
        at = [index for index, item in enumerate(predictions) if not is_none(item)]
        answers = [predictions[index] for index in at]
        truth = np.asarray(is_false, dtype=bool)[at]
        false = int(truth.sum())
        self.remark = ""
        if min(false, len(truth) - false) < FEW:
            self.rule = Counted(margins=np.sort([lead(item) for item in answers]), false=false)
            self.remark = (
                f"{false} of {len(truth)} calibration answers are false, a fit needs {FEW} of each kind: "
                "ranked by margin, with the bounds that the counts support"
            )
        else:
            raw = features(answers)
            frame = Frame.of(raw)
            self.rule = FittedModel(frame=frame, log_odds=self.learn(frame.filled(raw), truth), answers=len(truth))

    def p_false(self, predictions: Sequence[Prediction]) -> NDArray[np.float64]:
        """Return the probability of a false fix, shape (N,); 1 where there is no answer."""
        if self.rule is None:
            raise RuntimeError(f"{self.card.name}: call fit() with answers of calibration blocks before p_false()")
        found = np.ones(len(predictions))
        at = [index for index, item in enumerate(predictions) if not is_none(item)]
        if at:
            # 12 decimals of a probability: the last digits of a fit depend on memory alignment
            found[at] = self.rule.p_false([predictions[index] for index in at]).round(12)
        return found


_LIMITS: Final = (
    "fitted for one matcher; as good as calibration is like the test; takes answers for independent, those of one "
    "block are not"
)
_OURS: Final = (
    "Evidence by the names of sasgeo.integrity.EVIDENCE, beside the lead over the best candidate 25 m away and the "
    "matcher's confidence, wide ones by their inverse hyperbolic sine; what is missing or not finite is the median of "
    "calibration, and a flag; P is drawn towards 1/2 as by one more answer of each kind (Laplace), so n answers never "
    "say less than 1 / (n + 2); with fewer than 5 false or 5 right answers, the margin's order with Clopper-Pearson's "
    "upper end of no false one in as many; withheld answers and views of which all is unknown say 1"
)


class SasgeoLogistic(_Fitted):
    """Logistic regression on the evidence."""

    card = RejectorCard(
        name="sasgeo_logistic",
        version="1",
        title="SASGeo evidence, logistic",
        source="SASGeo paper (Trukhina and Vashkelis), Section V, Eqs. 12-14",
        ours=f"scikit-learn's LogisticRegression (C = 1) on standardised features. {_OURS}",
        licence="Apache-2.0",
        limits=f"Linear in its features; {_LIMITS}",
    )

    def learn(self, rows: Rows, is_false: NDArray[np.bool_]) -> LogOdds:
        """Fit the weights."""
        return _logistic(rows, is_false)


class SasgeoBoosted(_Fitted):
    """Gradient-boosted trees on the evidence, recalibrated on answers that they did not see."""

    card = RejectorCard(
        name="sasgeo_boosted",
        version="1",
        title="SASGeo evidence, gradient-boosted",
        source="SASGeo paper (Trukhina and Vashkelis), Section V, Eqs. 12-14; Friedman, Annals of Statistics 2001",
        ours=(
            "scikit-learn's GradientBoostingClassifier (60 trees of depth 2, rate 0.08, leaves of 10 answers or more), "
            "one for each of 4 parts left out; their mean log-odds, by a line fitted on the parts left out (Platt). "
            f"{_OURS}"
        ),
        licence="Apache-2.0",
        limits=f"Parts are drawn over answers, not over blocks; {_LIMITS}",
    )

    def learn(self, rows: Rows, is_false: NDArray[np.bool_]) -> LogOdds:
        """Fit each tree to three of four parts, and the line that recalibrates them to the parts left out."""
        fold = np.empty(len(rows), dtype=np.int64)
        for kind in (False, True):  # stratified by kind
            at = np.flatnonzero(is_false == kind)
            fold[at] = np.arange(len(at)) % _FOLDS
        trees = [_trees(rows[fold != part], is_false[fold != part]) for part in range(_FOLDS)]
        unseen = np.empty(len(rows))
        for part, tree in enumerate(trees):
            unseen[fold == part] = tree.decision_function(rows[fold == part])
        line = _logistic(unseen[:, None], is_false)
        slope, shift = float(line.weights[0]), line.intercept
        return lambda new: np.asarray(slope * np.mean([tree.decision_function(new) for tree in trees], axis=0) + shift)


@dataclass(frozen=True, kw_only=True)
class Counted:
    """Order by margin where no model can be fitted.

    `margins` are those of calibration, ascending. Where nearly all of calibration was right, and errors fall with the
    margin, an answer with a larger margin than m of them is false at most as often as those: at most Clopper-Pearson's
    upper bound. Where nearly all was false, the probability of being right is that of one more of each kind at most,
    and falls with the margin.
    """

    margins: NDArray[np.float64]
    false: int

    def p_false(self, answers: Sequence[Prediction]) -> NDArray[np.float64]:
        """Return the probability of a false fix, shape (N,)."""
        return self.chance(np.array([lead(item) for item in answers]))

    def chance(self, margins: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the probability of a false fix by margin, shape (N,); it never falls for a smaller one."""
        count = len(self.margins)
        if not count:
            return np.ones(len(margins))
        # Number of calibration answers with at most this margin, interpolated so that the order is kept.
        distinct, first = np.unique(self.margins, return_index=True)
        passed = np.interp(margins, distinct, np.append(first[1:], count).astype(np.float64), left=0.0)
        if 2 * self.false > count:
            return np.asarray(1.0 - passed / count * (count - self.false + 1.0) / (count + 2.0))
        return np.array([upper_rate(min(self.false, below), below) for below in passed.tolist()])


# scikit-learn is loaded where something is fitted: it takes most of a second, and 90 MB.


def _logistic(rows: Rows, is_false: NDArray[np.bool_]) -> Linear:
    from sklearn.linear_model import LogisticRegression  # type: ignore[import-untyped, unused-ignore]  # noqa: PLC0415

    found = LogisticRegression(solver="newton-cholesky", tol=1e-8, max_iter=1000).fit(rows, is_false)
    return Linear(weights=found.coef_[0], intercept=float(found.intercept_[0]))


def _trees(rows: Rows, is_false: NDArray[np.bool_]) -> "GradientBoostingClassifier":
    from sklearn import config_context  # type: ignore[import-untyped, unused-ignore]  # noqa: PLC0415
    from sklearn.ensemble import GradientBoostingClassifier  # noqa: PLC0415

    # 500 answers of one tree at most: more cost time and gain nothing at this depth
    trees = GradientBoostingClassifier(
        n_estimators=60,
        learning_rate=0.08,
        max_depth=2,
        min_samples_leaf=10,
        subsample=min(1.0, 500 / len(rows)),
        random_state=0,
    )
    with config_context(skip_parameter_validation=True):  # of each of the trees: a tenth of the time
        return trees.fit(rows, is_false)
