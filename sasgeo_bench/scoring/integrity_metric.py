# SPDX-License-Identifier: Apache-2.0
"""Risk against coverage: areas, operating points, and thresholds that are chosen on calibration blocks.

Where a curve has to go on to full coverage, queries without an answer come last and count as false, so that silence is
never a way to a better area.
"""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike
from scipy.special import digamma

from sasgeo_bench.errors import MetricError
from sasgeo_bench.scoring.base import Floats, check_weights
from sasgeo_bench.scoring.decisions import Answers


@dataclass(frozen=True, slots=True, kw_only=True)
class RiskCoverage:
    """The operating points a threshold can reach, each of shape (G,), the most confident first."""

    threshold: Floats
    coverage: Floats
    risk: Floats


def _masses(answers: Answers, weights: ArrayLike | None) -> tuple[Floats, Floats]:
    """Mass of each group of equal confidence, and its false part, shape (G + 1,); the last group has no answer."""
    mass = check_weights(weights, len(answers))
    count = len(answers.steps) + 1
    return (
        np.asarray(np.bincount(answers.tie, weights=mass, minlength=count), dtype=np.float64),
        np.asarray(np.bincount(answers.tie, weights=mass * ~answers.is_right, minlength=count), dtype=np.float64),
    )


def risk_coverage(answers: Answers, weights: ArrayLike | None = None) -> RiskCoverage:
    """Risk (false / accepted) at each coverage (accepted / all) that a threshold can reach.

    Parameters
    ----------
    answers : Answers
        Of N queries.
    weights : array_like, shape (N,), optional
        Not negative.

    Returns
    -------
    RiskCoverage
        One point for each confidence that occurs; equal confidences are accepted together, since no threshold can part
        them. It ends at the share of queries that were answered. Empty where nothing was answered.

    Examples
    --------
    >>> facts = {"is_answered": [1, 1, 1, 0], "is_right": [1, 0, 1, 0], "is_present": [1] * 4}
    >>> curve = risk_coverage(Answers(confidence=[0.9, 0.8, 0.8, np.nan], **facts))
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


def aurc(answers: Answers, weights: ArrayLike | None = None) -> float:
    """Area under the risk-coverage curve: mean risk of the 1, 2, ..., N most confident queries.

    Parameters
    ----------
    answers : Answers
        Of N queries.
    weights : array_like, shape (N,), optional
        Counts: weight 2 is a query that is there twice. They need not be whole, but should sum to about N.

    Returns
    -------
    float
        In [0, 1]; NaN for no queries. 0 where all are right; 1 where none is.

    Notes
    -----
    Geifman and El-Yaniv, NeurIPS 2017, and the SASGeo paper, Sec. V. Where confidences tie, it is the expected area
    under a random order, so that any strictly monotone map of the confidence leaves it as it is: after j of t tied
    queries of which f are false, j f / t false ones are expected. The sum over j of (F + j f / t) / (A + j), with F
    false of A accepted before, is f + (F - A f / t) (psi(A + t + 1) - psi(A + 1)), with psi the digamma function; it
    holds for weights that are not whole, too. Queries without an answer come last and are false.

    Examples
    --------
    The third of three is false, (0 + 0 + 1/3) / 3; all three tied, 1/3 at each coverage:

    >>> facts = {"is_answered": [1, 1, 1], "is_right": [1, 1, 0], "is_present": [1, 1, 1]}
    >>> round(aurc(Answers(confidence=[0.9, 0.8, 0.1], **facts)), 4)
    0.1111
    >>> round(aurc(Answers(confidence=[0.5, 0.5, 0.5], **facts)), 4)
    0.3333
    """
    group, false = _masses(answers, weights)
    return _area(group[group > 0], false[group > 0])


def _area(group: Floats, false: Floats) -> float:
    """AURC of groups of equal confidence with positive masses, the most confident first."""
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
    """`aurc` and `augrc` of D draws, each of shape (D,); NaN for a draw of no queries."""

    aurc: Floats
    augrc: Floats


def drawn_areas(answers: Answers, weights: Floats) -> DrawnAreas:
    """Areas of many draws at once: the same as `aurc` and `augrc` with each row of weights, and some times faster.

    Parameters
    ----------
    answers : Answers
        Of N queries.
    weights : ndarray of float, shape (D, N)
        Of each draw, finite and not negative, as from `ClusterDraws.weights`.

    Returns
    -------
    DrawnAreas
        One of each for each draw.

    Examples
    --------
    >>> some = Answers(confidence=[0.9, 0.8], is_answered=[1, 1], is_right=[1, 0], is_present=[1, 1])
    >>> found = drawn_areas(some, np.array([[1.0, 1.0], [2.0, 0.0]]))
    >>> found.aurc.tolist(), found.augrc.tolist()
    ([0.25, 0.0], [0.125, 0.0])
    """
    order = np.argsort(answers.tie, kind="stable")
    if not len(order):
        return DrawnAreas(aurc=np.full(len(weights), np.nan), augrc=np.full(len(weights), np.nan))
    first = np.flatnonzero(np.diff(answers.tie[order], prepend=-1))
    sorted_mass = weights[:, order]
    group, false = sorted_mass, sorted_mass * ~answers.is_right[order]
    if len(first) < len(order):
        group, false = (np.add.reduceat(each, first, axis=1) for each in (group, false))
    accepted = np.cumsum(group, axis=1)
    total, after = accepted[:, -1], np.cumsum(false, axis=1)
    harmonic = np.diff(digamma(accepted + 1.0), axis=1, prepend=digamma(1.0))
    slope = np.divide(false, group, out=np.zeros_like(group), where=group > 0)
    area = (false + (after - false - (accepted - group) * slope) * harmonic).sum(axis=1)
    undetected = (group * (after - false / 2)).sum(axis=1)
    some = np.where(total > 0, total, np.nan)
    return DrawnAreas(aurc=np.clip(area / some, 0.0, 1.0), augrc=np.asarray(undetected / some**2))


def excess_aurc(answers: Answers, weights: ArrayLike | None = None) -> float:
    """E-AURC: how much larger the AURC is than that of the best order of the same answers.

    Parameters
    ----------
    answers : Answers
        Of N queries.
    weights : array_like, shape (N,), optional
        Counts, as in `aurc`.

    Returns
    -------
    float
        In [0, 1]; 0 where every right fix is more confident than every false one, and where all are right or all
        false. NaN for no queries.

    Notes
    -----
    Geifman, Uziel and El-Yaniv, ICLR 2019. They subtract r + (1 - r) ln(1 - r), the limit for many queries; we
    subtract the exact area of the best order of N, so that a perfect order has 0 whatever N is.

    Examples
    --------
    >>> facts = {"is_answered": [1, 1], "is_right": [1, 0], "is_present": [1, 1]}
    >>> excess_aurc(Answers(confidence=[0.9, 0.1], **facts)), excess_aurc(Answers(confidence=[0.1, 0.9], **facts))
    (0.0, 0.5)
    """
    group, false = _masses(answers, weights)
    wrong = float(false.sum())
    best = np.array([group.sum() - wrong, wrong])
    kept = best > 0
    least = _area(best[kept], np.array([0.0, wrong])[kept])
    return float(max(_area(group[group > 0], false[group > 0]) - least, 0.0)) if len(answers) else float("nan")


def augrc(answers: Answers, weights: ArrayLike | None = None) -> float:
    """Area under the generalized risk-coverage curve: the chance of an undetected false fix, mean over coverages.

    Parameters
    ----------
    answers : Answers
        Of N queries.
    weights : array_like, shape (N,), optional
        Not negative.

    Returns
    -------
    float
        In [0, 1/2]; NaN for no queries.

    Notes
    -----
    Traub et al., NeurIPS 2024: false and accepted / all, over accepted / all. With ties averaged the curve is made of
    straight pieces, and its area is (1 - AUROC) a (1 - a) + (1 - a)^2 / 2, with a the share of right fixes.

    Examples
    --------
    One false fix of two, taken last or first: (0 + 1/2) / 2 / 2 and (1/2 + 1/2 + 1/2) / 2 / 2.

    >>> facts = {"is_answered": [1, 1], "is_right": [1, 0], "is_present": [1, 1]}
    >>> augrc(Answers(confidence=[0.9, 0.1], **facts)), augrc(Answers(confidence=[0.1, 0.9], **facts))
    (0.125, 0.375)
    """
    group, false = _masses(answers, weights)
    total = float(group.sum())
    if total == 0:
        return float("nan")
    after = np.cumsum(false)
    return float((group * (after - false / 2)).sum() / total**2)


def false_fix_rate(answers: Answers, coverage: float, weights: ArrayLike | None = None) -> float:
    """Risk among a given share of the queries, the most confident ones.

    Parameters
    ----------
    answers : Answers
        Of N queries.
    coverage : float
        In (0, 1], as 0.5 or 0.8.
    weights : array_like, shape (N,), optional
        Not negative.

    Returns
    -------
    float
        In [0, 1]; NaN for no queries. Where the coverage falls among equal confidences, or within a query, false ones
        are counted in proportion; queries without an answer come last and count as false.

    Raises
    ------
    MetricError
        If the coverage is out of range.

    Examples
    --------
    >>> facts = {"is_answered": [1] * 4, "is_right": [1, 1, 0, 0], "is_present": [1] * 4}
    >>> false_fix_rate(Answers(confidence=[0.9, 0.8, 0.8, 0.1], **facts), 0.5)
    0.25
    """
    if not 0 < coverage <= 1:
        message = f"coverage must lie in (0, 1], got {coverage!r}"
        raise MetricError(message)
    group, false = _masses(answers, weights)
    total = float(group.sum())
    if total == 0:
        return float("nan")
    accepted = np.concatenate(([0.0], np.cumsum(group)))
    wrong = np.concatenate(([0.0], np.cumsum(false)))
    return float(np.interp(coverage * total, accepted, wrong) / (coverage * total))


def choose_threshold(calibration: Answers, risk: float, weights: ArrayLike | None = None) -> float:
    """Threshold with the largest coverage whose risk on calibration blocks is at most the wanted one.

    Parameters
    ----------
    calibration : Answers
        Of queries from calibration blocks; never those that are scored.
    risk : float
        In [0, 1].
    weights : array_like, shape (N,), optional
        Not negative.

    Returns
    -------
    float
        One of the confidences that occur; `-inf` where all answers may be accepted and some have no confidence; `inf`
        where no coverage keeps the risk, as with no queries or nothing but false fixes.

    Raises
    ------
    MetricError
        If the risk is out of range.

    Notes
    -----
    The risk is the empirical one, without a margin: what is reached on test blocks is told beside it.

    Examples
    --------
    >>> facts = {"is_answered": [1] * 3, "is_right": [1, 1, 0], "is_present": [1] * 3}
    >>> choose_threshold(Answers(confidence=[0.9, 0.8, 0.1], **facts), 0.05)
    0.8
    """
    if not 0 <= risk <= 1:
        message = f"risk must lie in [0, 1], got {risk!r}"
        raise MetricError(message)
    curve = risk_coverage(calibration, weights)
    allowed = np.flatnonzero(curve.risk <= risk)
    return float(curve.threshold[allowed[-1]]) if len(allowed) else math.inf
