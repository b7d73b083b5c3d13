# SPDX-License-Identifier: Apache-2.0
"""Calibration of confidences, and the Stanford diagram of protection levels."""

import math
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import ArrayLike

from sasgeo_bench.errors import MetricError
from sasgeo_bench.scoring.base import Bools, Floats, Ints, check_column, check_weights, weighted_mean
from sasgeo_bench.scoring.decisions import Answers, check_probabilities

BINS: Final = 10


def _have_confidence(answers: Answers) -> bool:
    return not np.isnan(answers.confidence[answers.is_answered]).any()


def brier(answers: Answers, weights: ArrayLike | None = None) -> float:
    """Return the Brier score of the confidences: the mean of (confidence - right)^2 over answered queries, in [0, 1].

    NaN without answers, and where any answer has no confidence: otherwise a method could omit unsure confidences to
    look calibrated. Raise MetricError if a confidence is no probability.

    Brier, Monthly Weather Review 1950, for two outcomes: half of his sum.

    >>> brier(Answers(confidence=[0.5, 1.0], is_answered=[1, 1], is_right=[1, 1], is_present=[1, 1]))
    0.125
    """
    mass = check_weights(weights, len(answers))
    check_probabilities(answers)
    if not _have_confidence(answers):
        return float("nan")
    gap = np.where(answers.is_answered, answers.confidence, 0.0) - answers.is_right
    return weighted_mean(gap**2, mass * answers.is_answered)


def calibration_error(answers: Answers, weights: ArrayLike | None = None, *, bins: int = BINS) -> float:
    """Return the expected calibration error over at most `bins` bins of equal mass, in [0, 1].

    This is the mean over answers of |mean confidence - fraction right| of their bin. NaN as for `brier`. It is biased
    upwards for few answers. Raise MetricError if a confidence is no probability, or there is no bin.

    Nguyen and O'Connor, EMNLP 2015; for the bias see Roelofs et al., AISTATS 2022.

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
