# SPDX-License-Identifier: Apache-2.0
"""Decisions to accept or withhold fixes and their cost; calibration of confidences and of protection levels.

Every query counts. A query without an answer (withheld, crash, time-out) is never accepted. Answers without a
confidence rank below all answers with one; if no answer has one, all rank the same.
"""

import math
from dataclasses import dataclass, field
from typing import Final, Literal

import numpy as np
from numpy.typing import ArrayLike
from scipy import special

from sasgeo_bench.errors import MetricError
from sasgeo_bench.scoring.base import Bools, Floats, Ints, check_column, check_weights, weighted_mean

COST_RATIOS: Final = (5.0, 20.0, 100.0)
PRESENT_SHARES: Final = (0.9, 0.7, 0.5)


@dataclass(frozen=True, kw_only=True)
class Fixes:
    """Fixes of N queries of the integrity track, judged; present and absent places mixed; each column has shape (N,).

    `confidence` is the probability that the fix is right, or any other number that increases with trust; NaN if
    missing. It is ignored where `is_answered` is False: there is no fix that could be accepted. `is_right`: the fix is
    within tolerance of a present place. `is_present`: the place is on the searched map. Raise MetricError if shapes
    differ, a confidence is infinite, or a fix is right without an answer or without a place.

    >>> some = Fixes(confidence=[0.9, 0.9, np.nan], is_answered=[1, 1, 0], is_right=[1, 0, 0], is_present=[1, 0, 0])
    >>> some.tie.tolist()
    [0, 0, 1]
    """

    confidence: Floats
    is_answered: Bools
    is_right: Bools
    is_present: Bools
    tie: Ints = field(init=False)  # group of equal confidence, 0 the highest; queries without an answer are the last
    steps: Floats = field(init=False)  # confidence of each group; -inf for answers without one

    def __post_init__(self) -> None:
        """Check the columns and group equal confidences, once for all metrics and draws."""
        count = np.size(self.is_answered)
        for name in ("is_answered", "is_right", "is_present"):
            object.__setattr__(self, name, check_column(getattr(self, name), name, count) > 0)
        given = np.asarray(self.confidence, dtype=np.float64)
        if given.shape != (count,) or np.isinf(given[self.is_answered]).any():
            raise MetricError(f"confidence has shape {given.shape}, expected ({count},), each a finite number or NaN")
        if (self.is_right & ~(self.is_answered & self.is_present)).any():
            raise MetricError("a fix is right only where there is an answer and the place is present: mend is_right")
        key = np.where(self.is_answered, np.nan_to_num(given, nan=-np.inf), -np.inf)
        values, group = np.unique(-key[self.is_answered], return_inverse=True)
        tie = np.full(count, len(values), dtype=np.int64)
        tie[self.is_answered] = group
        object.__setattr__(self, "confidence", np.where(self.is_answered, given, np.nan))
        object.__setattr__(self, "tie", tie)
        object.__setattr__(self, "steps", -values)

    def __len__(self) -> int:
        """Return the number of queries."""
        return len(self.tie)


def presence_weights(is_present: ArrayLike, share: float) -> Floats:
    """Return weights, shape (N,), under which present places make up a given share of the queries; they sum to N.

    Raise MetricError if the share is not in [0, 1], or a side of positive share has no query.

    >>> presence_weights([True, True, True, False], 0.5).round(3).tolist()
    [0.667, 0.667, 0.667, 2.0]
    """
    present = check_column(is_present, "is_present") > 0
    if not 0 <= share <= 1:
        raise MetricError(f"share must lie in [0, 1], got {share!r}")
    target = np.where(present, share, 1.0 - share)
    there = np.where(present, present.sum(), (~present).sum()) / max(len(present), 1)
    for side, part, count in (("present", share, present.sum()), ("absent", 1.0 - share, (~present).sum())):
        if part > 0 and len(present) and not count:
            raise MetricError(
                f"no query has its place {side}, so none can count {part:g}: draw some, or ask for another share"
            )
    return np.asarray(np.divide(target, there, out=np.zeros(len(present)), where=there > 0))


def accept(answers: Fixes, threshold: float) -> Bools:
    """Return which fixes are accepted, shape (N,): those with `confidence >= threshold`.

    A threshold of `-inf` accepts every answer, even without a confidence; queries without an answer are never accepted.

    >>> some = Fixes(confidence=[0.9, 0.5, 0.4], is_answered=[1, 1, 0], is_right=[1, 0, 0], is_present=[1, 1, 1])
    >>> accept(some, 0.5).tolist(), accept(some, -np.inf).tolist()
    ([True, True, False], [True, True, False])
    """
    return np.append(answers.steps >= threshold, False)[answers.tie]  # the last group has no answer


def accept_by_cost(answers: Fixes, cost_ratio: float) -> Bools:
    """Return which fixes Eq. (14) accepts, shape (N,): chance of a false fix below 1 / (1 + cost ratio).

    The cost ratio is the cost of a false fix over that of withholding a right one: 5, 20 or 100. False without an
    answer or without a confidence. Raise MetricError if the ratio is not positive, or a confidence is no probability.

    The SASGeo paper, Eqs. (12)-(14), with P(F=1|E) = 1 - confidence; strict, as printed there.

    >>> some = Fixes(confidence=[0.9, 0.8, np.nan], is_answered=[1, 1, 1], is_right=[1, 0, 0], is_present=[1, 1, 1])
    >>> accept_by_cost(some, 5.0).tolist()
    [True, False, False]
    """
    _check_ratio(cost_ratio)
    check_probabilities(answers)
    return np.asarray(1.0 - answers.confidence < 1.0 / (1.0 + cost_ratio))  # NaN compares as False


def _check_ratio(cost_ratio: float) -> None:
    if not 0 < cost_ratio < math.inf:
        raise MetricError(f"cost_ratio must be positive and finite, got {cost_ratio!r}")


def check_probabilities(answers: Fixes) -> None:
    """Check that all confidences lie in [0, 1].

    Raise MetricError with the range found.
    """
    given = answers.confidence[~np.isnan(answers.confidence)]
    if ((given < 0) | (given > 1)).any():
        raise MetricError(
            f"confidences reach from {given.min():g} to {given.max():g}, expected probabilities in [0, 1]"
        )


def cost_values(
    answers: Fixes,
    accepted: ArrayLike,
    cost_ratio: float,
    *,
    charged: Literal["right fix", "place"] = "right fix",
) -> Floats:
    """Return the cost of each query's decision, shape (N,), in units of a wrongly withheld fix: 0, 1 or `cost_ratio`.

    `accepted`, shape (N,), are the accepted fixes; `charged` is what costs 1 when withheld. "right fix" (Eq. (13))
    evaluates the decision alone: a matcher that is never right and withholds everything costs 0. "place" charges every
    present place without a fix and evaluates the whole method. Raise MetricError if the ratio is not positive, or a
    query without an answer is accepted.

    >>> some = Fixes(confidence=[0.9, 0.2], is_answered=[1, 1], is_right=[0, 0], is_present=[1, 1])
    >>> cost_values(some, [True, False], 20.0).tolist()
    [20.0, 0.0]
    >>> cost_values(some, [True, False], 20.0, charged="place").tolist()
    [20.0, 1.0]
    """
    _check_ratio(cost_ratio)
    taken = check_column(accepted, "accepted", len(answers)) > 0
    if (taken & ~answers.is_answered).any():
        raise MetricError("a query without an answer is accepted: decide with accept() or accept_by_cost()")
    missed = ~taken & (answers.is_right if charged == "right fix" else answers.is_present)
    return np.asarray(cost_ratio * (taken & ~answers.is_right) + missed)


def decision_cost(
    answers: Fixes,
    cost_ratio: float,
    weights: ArrayLike | None = None,
    *,
    charged: Literal["right fix", "place"] = "right fix",
) -> float:
    """Return the mean of `cost_values` when fixes are accepted by Eq. (14); NaN for no queries.

    >>> some = Fixes(confidence=[0.9, 0.8], is_answered=[1, 1], is_right=[1, 1], is_present=[1, 1])
    >>> decision_cost(some, 5.0)
    0.5
    """
    accepted = accept_by_cost(answers, cost_ratio)
    return weighted_mean(cost_values(answers, accepted, cost_ratio, charged=charged), weights)


BINS: Final = 10


def _have_confidence(answers: Fixes) -> bool:
    return not np.isnan(answers.confidence[answers.is_answered]).any()


def brier(answers: Fixes, weights: ArrayLike | None = None) -> float:
    """Return the Brier score of the confidences: the mean of (confidence - right)^2 over answered queries, in [0, 1].

    NaN without answers, and where any answer has no confidence: otherwise a method could omit unsure confidences to
    look calibrated. Raise MetricError if a confidence is no probability.

    Brier, Monthly Weather Review 1950, for two outcomes: half of his sum.

    >>> brier(Fixes(confidence=[0.5, 1.0], is_answered=[1, 1], is_right=[1, 1], is_present=[1, 1]))
    0.125
    """
    mass = check_weights(weights, len(answers))
    check_probabilities(answers)
    if not _have_confidence(answers):
        return float("nan")
    gap = np.where(answers.is_answered, answers.confidence, 0.0) - answers.is_right
    return weighted_mean(gap**2, mass * answers.is_answered)


def calibration_error(answers: Fixes, weights: ArrayLike | None = None, *, bins: int = BINS) -> float:
    """Return the expected calibration error over at most `bins` bins of equal mass, in [0, 1].

    This is the mean over answers of |mean confidence - fraction right| of their bin. NaN as for `brier`. It is biased
    upwards for few answers. Raise MetricError if a confidence is no probability, or there is no bin.

    Nguyen and O'Connor, EMNLP 2015; for the bias see Roelofs et al., AISTATS 2022.

    >>> some = Fixes(confidence=[0.9, 0.9, 0.1], is_answered=[1] * 3, is_right=[1, 0, 0], is_present=[1] * 3)
    >>> round(calibration_error(some, bins=2), 3)  # (2 |0.9 - 0.5| + |0.1 - 0|) / 3
    0.3
    """
    mass = check_weights(weights, len(answers))
    check_probabilities(answers)
    if bins < 1:
        raise MetricError(f"bins must be at least 1, got {bins!r}")
    counts = answers.is_answered & (mass > 0)
    if not _have_confidence(answers) or not counts.any():
        return float("nan")
    confidence, right, mass = answers.confidence[counts], answers.is_right[counts], mass[counts]
    at = equal_mass_bins(confidence, mass, bins=bins)
    gap = np.bincount(at, weights=mass * (confidence - right), minlength=bins)
    return float(np.abs(gap).sum() / mass.sum())


def equal_mass_bins(confidence: Floats, mass: Floats | None = None, *, bins: int = BINS) -> Ints:
    """Return the bin of each finite confidence, shape (N,), from 0 for the least confident; some bins may be empty.

    Equal confidences share the bin that holds the middle of their mass. `mass` is positive, shape (N,); 1 by default.

    >>> equal_mass_bins(np.array([0.9, 0.1, 0.9, 0.9]), bins=2).tolist()
    [1, 0, 1, 1]
    """
    values, group = np.unique(confidence, return_inverse=True)
    each = np.bincount(group, weights=mass, minlength=len(values))
    middle = (np.cumsum(each) - each / 2) / each.sum()
    return np.asarray(np.minimum((middle * bins).astype(np.int64), bins - 1)[group], dtype=np.int64)


@dataclass(frozen=True, slots=True, kw_only=True)
class Stanford:
    """Areas of the Stanford diagram as masks, each of shape (N,); every query lies in exactly one.

    Available means level <= limit, bounded error <= level.

    - nominal: available and bounded
    - misleading: available, not bounded, harmless (level < error <= limit)
    - hazardous: hazardously misleading (level <= limit < error)
    - unavailable: not available, bounded
    - unavailable_misleading: not available, not bounded (limit < level < error)
    """

    nominal: Bools
    misleading: Bools
    hazardous: Bools
    unavailable: Bools
    unavailable_misleading: Bools


def stanford(protection_level_m: ArrayLike, position_error_m: ArrayLike, alert_limit_m: float) -> Stanford:
    """Return the area of the Stanford diagram that each query lies in.

    The protection level, shape (N,), is the stated upper bound of the error; infinite without a level or an answer. The
    position error, shape (N,), is infinite for an answer where the place is absent. The alert limit is the largest
    error that is safe to use. Raise MetricError if a value is negative or NaN, or the limit is not positive and finite.

    Tossaint et al., "The Stanford-ESA integrity diagram", NAVIGATION 2007. Equality counts as within.

    >>> areas = stanford([5.0, 5.0, 5.0, 20.0], [4.0, 6.0, 11.0, 11.0], 10.0)
    >>> areas.misleading.tolist(), areas.hazardous.tolist()
    ([False, True, False, False], [False, False, True, False])
    """
    level = check_column(protection_level_m, "protection_level_m")
    error = check_column(position_error_m, "position_error_m", len(level))
    if not 0 < alert_limit_m < math.inf or (level < 0).any() or (error < 0).any():
        raise MetricError(
            f"levels and errors are not negative, the alert limit is positive and finite, got {alert_limit_m!r}"
        )
    is_available, is_bounded = level <= alert_limit_m, error <= level
    return Stanford(
        nominal=is_available & is_bounded,
        misleading=is_available & ~is_bounded & (error <= alert_limit_m),
        hazardous=is_available & (error > alert_limit_m),
        unavailable=~is_available & is_bounded,
        unavailable_misleading=~is_available & ~is_bounded,
    )


# --- chances at a declared share of absent places ---------------------------------------------------------------------
# A rejector learns from a pool in which some share of the places is absent. Where that share differs, its chances are
# wrong in a known direction: the features of an absent place look the same, but there are more of them. Reweighting the
# calibration places to the declared share and fitting a line to the log-odds corrects for it.
_EDGE: Final = 1e-6  # least distance of a chance from 0 and 1
_WEAK: Final = 100.0  # inverse strength of the prior on the slope: it matters for a handful of answers alone


def at_share(calibration: Fixes, present_share: float, p_right: Floats) -> Floats:
    """Return chances of a right fix at a declared share of present places, shape (N,); NaN stays NaN.

    `calibration` are answers with the chances that a rejector gave them without having seen them, `p_right` its chances
    for other answers. The line through the log-odds is fitted to the calibration answers, weighted so that present
    places have the declared share; a falling line counts as flat. All NaN where the calibration lacks present or absent
    places, or right or false answers.

    Notes
    -----
    Prior shift with known class conditionals: Saerens, Latinne and Decaestecker, Neural Computation 2002. What shifts
    here is the share of absent places, and a false fix is one there or a wrong one at a present place, so the shift is
    fitted by weights instead of by their closed form; the line is that of Platt (1999).

    Half of the calibration places are absent; where one in ten is, the same evidence is more reassuring:

    >>> rng = np.random.default_rng(1)
    >>> is_present = np.arange(400) % 2 == 0
    >>> chance = special.expit(np.where(is_present, 1.5, -1.5) + rng.normal(size=400))
    >>> known = Fixes(confidence=chance, is_answered=np.ones(400), is_right=is_present, is_present=is_present)
    >>> at_share(known, 0.9, np.array([0.5])).round(1).tolist()
    [0.9]
    """
    # Slow to import, and most processes judge no rejector.
    from sklearn.linear_model import LogisticRegression  # type: ignore[import-untyped, unused-ignore]  # noqa: PLC0415

    given = calibration.is_answered & ~np.isnan(calibration.confidence)
    right, present = calibration.is_right[given], calibration.is_present[given]
    if right.all() or not right.any() or present.all():
        return np.full(len(p_right), np.nan)
    mass = presence_weights(calibration.is_present, present_share)[given]
    line = LogisticRegression(C=_WEAK).fit(_log_odds(calibration.confidence[given]), right, sample_weight=mass)
    slope, shift = float(line.coef_[0, 0]), float(line.intercept_[0])
    if slope < 0:
        slope, shift = 0.0, float(special.logit(np.average(right, weights=mass)))
    found = np.full(len(p_right), np.nan)
    known = ~np.isnan(p_right)
    found[known] = special.expit(slope * _log_odds(p_right[known])[:, 0] + shift)
    return found


def _log_odds(chances: Floats) -> Floats:
    return np.asarray(special.logit(np.clip(chances, _EDGE, 1 - _EDGE)))[:, None]
