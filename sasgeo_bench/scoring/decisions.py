# SPDX-License-Identifier: Apache-2.0
"""Decisions to accept or withhold fixes and their cost; calibration of confidences and of protection levels.

Every query counts. A query without an answer (withheld, crash, time-out) is never accepted. Answers without a
confidence rank below all answers with one; if no answer has one, all rank the same.
"""

import math
from dataclasses import dataclass, field
from typing import Final, Literal, Self

import numpy as np
from numpy.typing import ArrayLike
from scipy import special
from scipy.sparse import csr_array
from scipy.special import digamma

from sasgeo_bench.core.errors import MetricError
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


_CACHED: Final = 2**16  # numbers that fit a core's cache: larger tables take twice the time
_FIRST: Final = 512  # groups of one answer each, where groups are merged: an area weighs its first answers most
_OTHERS: Final = 1024


@dataclass(frozen=True, slots=True, kw_only=True)
class RiskCoverage:
    """Operating points of all thresholds, each of shape (G,), the most confident first."""

    threshold: Floats
    coverage: Floats
    risk: Floats


def _masses(answers: Fixes, weights: ArrayLike | None) -> tuple[Floats, Floats]:
    """Return the mass of each group of equal confidence and its false part, shape (G + 1,); no answers come last."""
    mass = check_weights(weights, len(answers))
    count = len(answers.steps) + 1
    return (
        np.asarray(np.bincount(answers.tie, weights=mass, minlength=count), dtype=np.float64),
        np.asarray(np.bincount(answers.tie, weights=mass * ~answers.is_right, minlength=count), dtype=np.float64),
    )


def risk_coverage(answers: Fixes, weights: ArrayLike | None = None) -> RiskCoverage:
    """Return risk (false / accepted) at each coverage (accepted / all) that a threshold can reach.

    There is one point per distinct confidence; the last coverage is the share of answered queries.

    >>> facts = {"is_answered": [1, 1, 1, 0], "is_right": [1, 0, 1, 0], "is_present": [1] * 4}
    >>> curve = risk_coverage(Fixes(confidence=[0.9, 0.8, 0.8, np.nan], **facts))
    >>> curve.coverage.tolist(), curve.risk.round(3).tolist()
    ([0.25, 0.75], [0.0, 0.333])
    """
    group, false = _masses(answers, weights)
    reached = group[:-1] > 0
    accepted, wrong = np.cumsum(group)[:-1][reached], np.cumsum(false)[:-1][reached]
    return RiskCoverage(
        threshold=answers.steps[reached],
        coverage=np.asarray(accepted / max(float(group.sum()), np.finfo(float).tiny)),
        risk=np.asarray(wrong / accepted),
    )


def aurc(answers: Fixes, weights: ArrayLike | None = None) -> float:
    """Return the area under the risk-coverage curve: the mean risk of the 1, 2, ..., N most confident queries.

    In [0, 1]; NaN for no queries. `weights`, shape (N,), are counts: they may be fractions, but should sum to about N.

    Geifman and El-Yaniv, NeurIPS 2017, and the SASGeo paper, Sec. V. For tied confidences it is the expected area under
    a random order, so strictly monotone maps of the confidence leave it unchanged. After j of t tied queries with f
    false ones, j f / t false ones are expected. With F false of A accepted before, the sum over j of (F + j f / t) / (A
    + j) is f + (F - A f / t) (psi(A + t + 1) - psi(A + 1)), where psi is the digamma function; this also holds for
    fractional weights.

    The third of three is false, (0 + 0 + 1/3) / 3; all three tied, 1/3 at each coverage:

    >>> facts = {"is_answered": [1, 1, 1], "is_right": [1, 1, 0], "is_present": [1, 1, 1]}
    >>> round(aurc(Fixes(confidence=[0.9, 0.8, 0.1], **facts)), 4)
    0.1111
    >>> round(aurc(Fixes(confidence=[0.5, 0.5, 0.5], **facts)), 4)
    0.3333
    """
    group, false = _masses(answers, weights)
    return _area(group[group > 0], false[group > 0])


def _area(group: Floats, false: Floats) -> float:
    """Return the AURC of groups of equal confidence with positive masses, the most confident first."""
    if not len(group):
        return float("nan")
    accepted = np.concatenate(([0.0], np.cumsum(group)))
    wrong = np.cumsum(false) - false
    slope = false / group
    harmonic = np.diff(digamma(accepted + 1.0))
    area = (false + (wrong - accepted[:-1] * slope) * harmonic).sum() / accepted[-1]
    return float(np.clip(area, 0.0, 1.0))  # rounding of digamma can leave [0, 1] by 1e-16


@dataclass(frozen=True, slots=True, kw_only=True)
class DrawnAreas:
    """Areas of D draws, each of shape (D,), by the functions of their names; NaN where a draw has none."""

    aurc: Floats
    e_aurc: Floats
    augrc: Floats
    auroc: Floats


@dataclass(frozen=True, slots=True, kw_only=True)
class Curve:
    """Answers in groups of equal confidence, to weigh them in many draws at once.

    `sides`, shape (N, 3 G) for G groups, the most confident first, holds a 1 for each query: in the first G columns for
    a right fix, in the next for a false one of a present place, in the last for one of an absent place. A query without
    an answer counts as false and is of the last group. `is_given`, shape (G,), is False of that group.
    """

    sides: csr_array
    is_given: Bools

    @classmethod
    def of(cls, answers: Fixes, *, is_merged: bool) -> Self:
        """Return the groups of some answers; with `is_merged`, of more than 1,536 answers neighbours tie.

        The first 512 keep their order, the others lie in 1,024 groups of nearly as many answers. Areas of draws change
        by less than 3e-5, a small part of their spread, and take no longer for a million answers.

        >>> facts = {"is_answered": [1] * 4, "is_right": [1, 0, 0, 1], "is_present": [1] * 4}
        >>> Curve.of(Fixes(confidence=[0.9, 0.8, 0.7, 0.7], **facts), is_merged=True).sides.toarray().argmax(axis=1)
        array([0, 4, 5, 2])
        """
        tie, last = answers.tie, len(answers.steps)  # the last group has no answer
        if is_merged and last > _FIRST + _OTHERS:
            sizes = np.bincount(tie, minlength=last + 1)
            before = np.cumsum(sizes) - sizes
            others = np.linspace(_FIRST, before[-1], _OTHERS, endpoint=False)
            edges = np.concatenate((np.arange(_FIRST), others, before[-1:]))
            tie, last = (np.searchsorted(edges, before, side="right") - 1)[tie], len(edges) - 1
        groups, group = np.unique(tie, return_inverse=True)
        side = np.where(answers.is_right, 0, np.where(answers.is_present, 1, 2))
        cells = (np.ones(len(tie)), side * len(groups) + group, np.arange(len(tie) + 1))
        return cls(sides=csr_array(cells, shape=(len(tie), 3 * len(groups))), is_given=groups < last)

    def areas(self, masses: Floats, *, present: float = 1.0, absent: float = 1.0) -> DrawnAreas:
        """Return all areas for the masses of D draws, shape (D, 3 G), with factors of present and absent places.

        `weights @ sides` are the masses of weights of shape (D, N).
        """
        if not len(self.is_given):
            none = np.full(len(masses), np.nan)
            return DrawnAreas(aurc=none, e_aurc=none, augrc=none, auroc=none)
        parts = np.array_split(masses, 1 + masses.size // _CACHED)
        found = [self._areas(part, present, absent) for part in parts]
        return DrawnAreas(**{name: np.concatenate([part[name] for part in found]) for name in found[0]})

    def _areas(self, masses: Floats, present: float, absent: float) -> dict[str, Floats]:
        right, missed, unseen = np.hsplit(masses, 3)
        right = right * present
        false = missed * present + unseen * absent
        group = right + false
        accepted, after = np.cumsum(group, axis=1), np.cumsum(false, axis=1)
        total, wrong = accepted[:, -1], after[:, -1]
        harmonic = np.diff(digamma(accepted + 1.0), axis=1, prepend=digamma(1.0))
        slope = np.divide(false, group, out=np.zeros_like(group), where=group > 0)
        area = (false + (after - false - (accepted - group) * slope) * harmonic).sum(axis=1)
        least = wrong - (total - wrong) * (digamma(total + 1.0) - digamma(total - wrong + 1.0))
        undetected = (group * (after - false / 2)).sum(axis=1)
        some = np.where(total > 0, total, np.nan)
        aurc_ = np.clip(area / some, 0.0, 1.0)
        lost = false * self.is_given  # the last group may hold queries without an answer
        above = np.cumsum(right, axis=1) - right / 2
        pairs = right.sum(axis=1) * lost.sum(axis=1)
        return {
            "aurc": aurc_,
            "e_aurc": np.maximum(aurc_ - least / some, 0.0),
            "augrc": undetected / some**2,
            "auroc": (lost * above).sum(axis=1) / np.where(pairs > 0, pairs, np.nan),
        }


def drawn_areas(answers: Fixes, weights: Floats) -> DrawnAreas:
    """Return all areas for each row of weights, shape (D, N); several times faster than one by one.

    >>> some = Fixes(confidence=[0.9, 0.8], is_answered=[1, 1], is_right=[1, 0], is_present=[1, 1])
    >>> found = drawn_areas(some, np.array([[1.0, 1.0], [2.0, 0.0]]))
    >>> found.aurc.tolist(), found.augrc.tolist(), found.auroc.tolist()
    ([0.25, 0.0], [0.125, 0.0], [1.0, nan])
    """
    curve = Curve.of(answers, is_merged=False)
    return curve.areas(weights @ curve.sides)


def auroc(answers: Fixes, weights: ArrayLike | None = None) -> float:
    """Return the chance that a right answer is more confident than a false one; ties count half.

    In [0, 1]; NaN without answers of both kinds. Queries without an answer do not count. It does not depend on the
    share of false answers, so it compares rejectors where that share is large, too.

    Hanley and McNeil, Radiology 1982.

    >>> facts = {"is_answered": [1] * 4, "is_right": [1, 0, 1, 0], "is_present": [1] * 4}
    >>> auroc(Fixes(confidence=[0.9, 0.8, 0.8, 0.1], **facts))
    0.875
    """
    mass = check_weights(weights, len(answers))
    return float(drawn_areas(answers, mass[None]).auroc[0])


def excess_aurc(answers: Fixes, weights: ArrayLike | None = None) -> float:
    """Return the E-AURC: the AURC less that of the best order of the same answers, in [0, 1]; NaN for no queries.

    Geifman, Uziel and El-Yaniv, ICLR 2019. They subtract r + (1 - r) ln(1 - r), the limit for many queries. This
    function subtracts the exact area of the best order of N, so a perfect order has 0 for every N.

    >>> facts = {"is_answered": [1, 1], "is_right": [1, 0], "is_present": [1, 1]}
    >>> excess_aurc(Fixes(confidence=[0.9, 0.1], **facts)), excess_aurc(Fixes(confidence=[0.1, 0.9], **facts))
    (0.0, 0.5)
    """
    group, false = _masses(answers, weights)
    wrong = float(false.sum())
    best = np.array([group.sum() - wrong, wrong])
    kept = best > 0
    least = _area(best[kept], np.array([0.0, wrong])[kept])
    return float(max(_area(group[group > 0], false[group > 0]) - least, 0.0)) if len(answers) else float("nan")


def augrc(answers: Fixes, weights: ArrayLike | None = None) -> float:
    """Return the area under the generalized risk-coverage curve, in [0, 1/2]; NaN for no queries.

    It is the chance of an undetected false fix, averaged over coverages.

    Traub et al., NeurIPS 2024: false and accepted / all, over accepted / all. With ties averaged the curve is piecewise
    linear, and its area is (1 - AUROC) a (1 - a) + (1 - a)^2 / 2, with a the share of right fixes.

    One false fix of two, taken last or first: (0 + 1/2) / 2 / 2 and (1/2 + 1/2 + 1/2) / 2 / 2.

    >>> facts = {"is_answered": [1, 1], "is_right": [1, 0], "is_present": [1, 1]}
    >>> augrc(Fixes(confidence=[0.9, 0.1], **facts)), augrc(Fixes(confidence=[0.1, 0.9], **facts))
    (0.125, 0.375)
    """
    group, false = _masses(answers, weights)
    total = float(group.sum())
    if total == 0:
        return float("nan")
    after = np.cumsum(false)
    return float((group * (after - false / 2)).sum() / total**2)


def false_fix_rate(answers: Fixes, coverage: float, weights: ArrayLike | None = None) -> float:
    """Return the risk among the most confident share `coverage` in (0, 1] of the queries; NaN for no queries.

    Where the coverage falls among tied confidences or within a query, false ones count in proportion. Queries without
    an answer come last and count as false. Raise MetricError if the coverage is out of range.

    >>> facts = {"is_answered": [1] * 4, "is_right": [1, 1, 0, 0], "is_present": [1] * 4}
    >>> false_fix_rate(Fixes(confidence=[0.9, 0.8, 0.8, 0.1], **facts), 0.5)
    0.25
    """
    if not 0 < coverage <= 1:
        raise MetricError(f"coverage must lie in (0, 1], got {coverage!r}")
    group, false = _masses(answers, weights)
    total = float(group.sum())
    if total == 0:
        return float("nan")
    accepted = np.concatenate(([0.0], np.cumsum(group)))
    wrong = np.concatenate(([0.0], np.cumsum(false)))
    return float(np.interp(coverage * total, accepted, wrong) / (coverage * total))


def choose_absent_threshold(calibration: Fixes, rate: float) -> float:
    """Return the threshold of largest coverage that accepts at most a share `rate` of the absent calibration places.

    The result is as that of `choose_threshold`; NaN without an absent place. Raise MetricError if the rate is not in
    [0, 1].

    >>> facts = {"is_answered": [1] * 3, "is_right": [1, 0, 1], "is_present": [1, 0, 1]}
    >>> choose_absent_threshold(Fixes(confidence=[0.9, 0.8, 0.1], **facts), 0.05)
    0.9
    """
    _check_share(rate, "rate")
    absent = ~calibration.is_present
    if not absent.any():
        return math.nan
    accepted = np.cumsum(np.bincount(calibration.tie, weights=absent, minlength=len(calibration.steps) + 1))[:-1]
    allowed = np.flatnonzero(accepted / absent.sum() <= rate)
    return float(calibration.steps[allowed[-1]]) if len(allowed) else math.inf


def _check_share(value: float, name: str) -> None:
    if not 0 <= value <= 1:
        raise MetricError(f"{name} must lie in [0, 1], got {value!r}")


def choose_threshold(calibration: Fixes, risk: float) -> float:
    """Return the threshold of largest coverage whose risk on calibration blocks is at most `risk`.

    The result is one of the confidences; `-inf` accepts all answers, some without a confidence; `inf` means that no
    coverage keeps the risk. The risk is empirical, without a margin; boards report the risk reached on test blocks.
    Raise MetricError if the risk is not in [0, 1].

    >>> facts = {"is_answered": [1] * 3, "is_right": [1, 1, 0], "is_present": [1] * 3}
    >>> choose_threshold(Fixes(confidence=[0.9, 0.8, 0.1], **facts), 0.05)
    0.8
    """
    _check_share(risk, "risk")
    curve = risk_coverage(calibration)
    allowed = np.flatnonzero(curve.risk <= risk)
    return float(curve.threshold[allowed[-1]]) if len(allowed) else math.inf
