# SPDX-License-Identifier: Apache-2.0
"""Whether claims hold: probabilities that are to be right as often as they say, and levels that are to bound errors."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import ArrayLike

from sasgeo_bench.errors import MetricError
from sasgeo_bench.scoring.base import Bools, Floats, Ints, check_column, check_weights, weighted_mean
from sasgeo_bench.scoring.decisions import Answers, check_probabilities

BINS: Final = 10
LEAST_ANSWERS: Final = 50


def squared_errors(answers: Answers) -> Floats:
    """(confidence - right)^2 of each answered query, 0 for the others; weighted by `is_answered`, its mean is `brier`.

    Parameters
    ----------
    answers : Answers
        With confidences that are probabilities.

    Returns
    -------
    ndarray of float, shape (N,)
        In [0, 1].

    Raises
    ------
    MetricError
        If a confidence is no probability, or an answer has none.

    Examples
    --------
    >>> some = Answers(confidence=[0.5, 0.0], is_answered=[1, 0], is_right=[1, 0], is_present=[1, 1])
    >>> squared_errors(some).tolist()
    [0.25, 0.0]
    """
    check_probabilities(answers)
    if not _all_say(answers):
        message = "an answer has no confidence, so nothing can be said of its calibration: give one, or use brier()"
        raise MetricError(message)
    gap = np.where(answers.is_answered, answers.confidence, 0.0) - answers.is_right
    return np.asarray(gap**2)


def _all_say(answers: Answers) -> bool:
    """Whether every answer has a confidence."""
    return not np.isnan(answers.confidence[answers.is_answered]).any()


def brier(answers: Answers, weights: ArrayLike | None = None) -> float:
    """Brier score of the confidences: mean of (confidence - right)^2.

    Parameters
    ----------
    answers : Answers
        With confidences that are probabilities. Only answered queries count: without a fix there is no probability
        that it is right.
    weights : array_like, shape (N,), optional
        Not negative.

    Returns
    -------
    float
        In [0, 1]; NaN for no answers, and where some answer has no confidence: were it left out, a method could be
        silent about the unsure ones and look calibrated.

    Notes
    -----
    Brier, Monthly Weather Review 1950, for two outcomes, the half of his sum.

    Examples
    --------
    >>> brier(Answers(confidence=[0.5, 1.0], is_answered=[1, 1], is_right=[1, 1], is_present=[1, 1]))
    0.125
    """
    mass = check_weights(weights, len(answers))
    check_probabilities(answers)
    if not _all_say(answers):
        return float("nan")
    return weighted_mean(squared_errors(answers), mass * answers.is_answered)


def calibration_error(answers: Answers, weights: ArrayLike | None = None, *, bins: int = BINS) -> float:
    """Expected calibration error with bins of equal mass.

    Parameters
    ----------
    answers : Answers
        With confidences that are probabilities; only answered queries count, as in `brier`.
    weights : array_like, shape (N,), optional
        Not negative.
    bins : int
        How many at most. Equal confidences share a bin: the one in which the middle of their mass falls.

    Returns
    -------
    float
        In [0, 1]: mean over answers of |mean confidence - share of right fixes| of their bin. NaN as for `brier`. With
        few answers it is biased upwards.

    Raises
    ------
    MetricError
        If a confidence is no probability, or there is no bin.

    Notes
    -----
    Nguyen and O'Connor, EMNLP 2015; for the bias see Roelofs et al., AISTATS 2022.

    Examples
    --------
    >>> some = Answers(confidence=[0.9, 0.9, 0.1], is_answered=[1] * 3, is_right=[1, 0, 0], is_present=[1] * 3)
    >>> round(calibration_error(some, bins=2), 3)  # (2 |0.9 - 0.5| + |0.1 - 0|) / 3
    0.3
    """
    mass = check_weights(weights, len(answers))
    check_probabilities(answers)
    if bins < 1:
        message = f"bins must be at least 1, got {bins!r}"
        raise MetricError(message)
    counts = answers.is_answered & (mass > 0)
    if not _all_say(answers) or not counts.any():
        return float("nan")
    confidence, right, mass = answers.confidence[counts], answers.is_right[counts], mass[counts]
    at = equal_mass_bins(confidence, mass, bins=bins)
    gap = np.bincount(at, weights=mass * (confidence - right), minlength=bins)
    return float(np.abs(gap).sum() / mass.sum())


def equal_mass_bins(confidence: Floats, mass: Floats | None = None, *, bins: int = BINS) -> Ints:
    """Bin of each confidence, shape (N,): bins of equal mass, of which some may be empty.

    Parameters
    ----------
    confidence : ndarray of float, shape (N,)
        Finite.
    mass : ndarray of float, shape (N,), optional
        Positive; 1 unless given.
    bins : int
        How many at most. Equal confidences share the one in which the middle of their mass falls.

    Returns
    -------
    ndarray of int, shape (N,)
        From 0, the least confident first.

    Examples
    --------
    >>> equal_mass_bins(np.array([0.9, 0.1, 0.9, 0.9]), bins=2).tolist()
    [1, 0, 1, 1]
    """
    values, group = np.unique(confidence, return_inverse=True)
    each = np.bincount(group, weights=mass, minlength=len(values))
    middle = (np.cumsum(each) - each / 2) / each.sum()
    return np.asarray(np.minimum((middle * bins).astype(np.int64), bins - 1)[group], dtype=np.int64)


@dataclass(frozen=True, slots=True, kw_only=True)
class GroupValue:
    """A figure of one group; the name is empty where no group has enough answers."""

    group: str
    value: float
    answers: int


def worst_calibration_error(
    answers: Answers,
    groups: Sequence[str],
    weights: ArrayLike | None = None,
    *,
    bins: int = BINS,
    least: int = LEAST_ANSWERS,
) -> GroupValue:
    """Largest calibration error of a group, as a region.

    Parameters
    ----------
    answers : Answers
        Of N queries.
    groups : sequence of str, length N
        Group of each query.
    weights : array_like, shape (N,), optional
        Not negative.
    bins : int
        As in `calibration_error`.
    least : int
        A group with fewer answers is not looked at: its error would be mostly chance.

    Returns
    -------
    GroupValue
        The worst group; of equal ones the first by name. NaN where no group has enough answers.

    Raises
    ------
    MetricError
        If there are more or fewer groups than queries.

    Examples
    --------
    >>> some = Answers(confidence=[0.9, 0.9], is_answered=[1, 1], is_right=[1, 0], is_present=[1, 1])
    >>> worst_calibration_error(some, ["vaduz", "monaco"], least=1)
    GroupValue(group='monaco', value=0.9, answers=1)
    """
    mass = check_weights(weights, len(answers))
    if len(groups) != len(answers):
        message = f"{len(groups)} groups for {len(answers)} queries, expected one each"
        raise MetricError(message)
    names = np.asarray(groups, dtype=str)
    worst = GroupValue(group="", value=float("nan"), answers=0)
    for name in np.unique(names):
        inside = np.where(names == name, mass, 0.0)
        count = int((answers.is_answered & (inside > 0)).sum())
        value = calibration_error(answers, inside, bins=bins) if count >= max(least, 1) else float("nan")
        if value > worst.value or (math.isnan(worst.value) and not math.isnan(value)):
            worst = GroupValue(group=str(name), value=value, answers=count)
    return worst


@dataclass(frozen=True, slots=True, kw_only=True)
class Stanford:
    """Areas of the Stanford diagram, each of shape (N,); every query lies in exactly one.

    Parameters
    ----------
    nominal : ndarray of bool
        Available and bounded: error <= level <= limit.
    misleading : ndarray of bool
        Available, not bounded, harmless: level < error <= limit.
    hazardous : ndarray of bool
        Hazardously misleading: level <= limit < error.
    unavailable : ndarray of bool
        Not available, bounded: limit < level, error <= level.
    unavailable_misleading : ndarray of bool
        Not available, not bounded: limit < level < error.
    """

    nominal: Bools
    misleading: Bools
    hazardous: Bools
    unavailable: Bools
    unavailable_misleading: Bools

    def shares(self, weights: ArrayLike | None = None) -> dict[str, float]:
        """Share of all queries in each area; NaN for no queries."""
        names = ("nominal", "misleading", "hazardous", "unavailable", "unavailable_misleading")
        return {name: weighted_mean(getattr(self, name), weights) for name in names}


def stanford(protection_level_m: ArrayLike, position_error_m: ArrayLike, alert_limit_m: float) -> Stanford:
    """Sort queries into the areas of the Stanford diagram.

    Parameters
    ----------
    protection_level_m : array_like, shape (N,)
        What the method says the error does not exceed; infinite where it gives no level or no fix.
    position_error_m : array_like, shape (N,)
        What the error is; infinite for a fix where the place is absent.
    alert_limit_m : float
        Largest error that may be flown with, metres.

    Returns
    -------
    Stanford
        One area for each query.

    Raises
    ------
    MetricError
        If a value is negative or NaN, or the limit is not positive and finite.

    Notes
    -----
    Tossaint et al., "The Stanford-ESA integrity diagram", NAVIGATION 2007; a level or error on a border is within it.

    Examples
    --------
    >>> stanford([5.0, 5.0, 5.0, 20.0], [4.0, 6.0, 11.0, 11.0], 10.0).shares()
    {'nominal': 0.25, 'misleading': 0.25, 'hazardous': 0.25, 'unavailable': 0.25, 'unavailable_misleading': 0.0}
    """
    level = check_column(protection_level_m, "protection_level_m")
    error = check_column(position_error_m, "position_error_m", len(level))
    if not 0 < alert_limit_m < math.inf or (level < 0).any() or (error < 0).any():
        message = f"levels and errors are not negative, the alert limit is positive and finite, got {alert_limit_m!r}"
        raise MetricError(message)
    is_available, is_bounded = level <= alert_limit_m, error <= level
    return Stanford(
        nominal=is_available & is_bounded,
        misleading=is_available & ~is_bounded & (error <= alert_limit_m),
        hazardous=is_available & (error > alert_limit_m),
        unavailable=~is_available & is_bounded,
        unavailable_misleading=~is_available & ~is_bounded,
    )
