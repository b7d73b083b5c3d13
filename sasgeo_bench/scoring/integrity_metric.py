# SPDX-License-Identifier: Apache-2.0
"""Risk against coverage: areas, operating points, and thresholds chosen on calibration blocks.

At full coverage, queries without an answer come last and count as false, so that withholding never improves an area.
"""

import math
from dataclasses import dataclass
from typing import Final, Self

import numpy as np
from numpy.typing import ArrayLike
from scipy.sparse import csr_array
from scipy.special import digamma

from sasgeo_bench.errors import MetricError
from sasgeo_bench.scoring.base import Bools, Floats, check_weights
from sasgeo_bench.scoring.decisions import Fixes

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
