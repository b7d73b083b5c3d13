# SPDX-License-Identifier: Apache-2.0
"""Counts of protection levels that hold, the risk they support, and conformal levels."""

import math
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import ArrayLike
from statsmodels.stats.proportion import proportion_confint

from sasgeo_bench.errors import MetricError
from sasgeo_bench.scoring.base import Floats, check_column, weighted_mean
from sasgeo_bench.scoring.calibration import stanford
from sasgeo_bench.scoring.intervals import LEVEL, Interval, wilson

_DIGITS: Final = 2  # more would claim a precision that counts do not have


@dataclass(frozen=True, slots=True, kw_only=True)
class StanfordCounts:
    """Shares of all queries in the areas of a Stanford diagram, with Wilson's intervals.

    Parameters
    ----------
    trials : float
        Trials of the intervals: queries, or sites where several queries are of one.
    available : Interval
        The level is within the alert limit.
    unavailable : Interval
        It is not, or there is no level or no answer.
    misleading : Interval
        Available, and the error exceeds the level.
    hazardous : Interval
        Misleading, and the error exceeds the alert limit too: level <= limit < error.
    exceeded : Interval
        The error exceeds the level, available or not: this share should not exceed the stated risk.
    """

    trials: float
    available: Interval
    unavailable: Interval
    misleading: Interval
    hazardous: Interval
    exceeded: Interval


def stanford_counts(
    protection_level_m: ArrayLike,
    position_error_m: ArrayLike,
    alert_limit_m: float,
    *,
    trials: float | None = None,
    level: float = LEVEL,
) -> StanfordCounts:
    """Count a Stanford diagram; see `calibration.stanford` for parameters and errors.

    `trials` is the effective number of independent trials, N by default; NaN in [0, 1] for no queries.

    Examples
    --------
    Of six queries five have a level of 5 m and errors of 4, 4, 4, 6 and 11 m, one has neither; the limit is 10 m:

    >>> counts = stanford_counts([5, 5, 5, 5, 5, np.inf], [4, 4, 4, 6, 11, np.inf], 10.0)
    >>> [round(6 * getattr(counts, name).value) for name in ("available", "misleading", "hazardous", "exceeded")]
    [5, 2, 1, 2]
    """
    areas = stanford(protection_level_m, position_error_m, alert_limit_m)
    count = float(len(areas.nominal)) if trials is None else trials

    def share(which: ArrayLike) -> Interval:
        value = weighted_mean(which)
        return wilson(0.0, 0.0) if math.isnan(value) else wilson(min(value * count, count), count, level=level)

    misleading = areas.misleading | areas.hazardous
    return StanfordCounts(
        trials=count,
        available=share(areas.nominal | misleading),
        unavailable=share(areas.unavailable | areas.unavailable_misleading),
        misleading=share(misleading),
        hazardous=share(areas.hazardous),
        exceeded=share(misleading | areas.unavailable_misleading),
    )


def supported_risk(failures: float, trials: float, *, confidence: float = LEVEL) -> float:
    """Return the least risk that counts support, Clopper-Pearson's one-sided upper bound; 1 without a trial.

    Counts need not be whole; 0 <= failures <= trials.

    Examples
    --------
    >>> supported_risk(0, 299) < 0.01 < supported_risk(0, 298), supported_risk(0, 0)
    (True, 1.0)
    """
    if failures == trials:
        return 1.0
    return float(proportion_confint(failures, trials, alpha=2.0 * (1.0 - confidence), method="beta")[1])


def statement(failures: float, trials: float, *, risk: float, confidence: float = LEVEL) -> str:
    """Return which risk some counts support, in a line that claims no more than they support.

    The bound is Clopper-Pearson's upper end, one-sided. Without failures, the line also gives the trials that the risk
    takes.

    Raises
    ------
    MetricError
        If the risk or the confidence is not in (0, 1).
    ConfigError
        If not 0 <= failures <= trials.

    Examples
    --------
    >>> statement(0, 299, risk=0.01)
    '0 of 299 support below 1 % (95 % confidence)'
    >>> statement(0, 100, risk=0.01)
    '0 of 100 support below 3 % and not below 1 %, which takes 299 without one (95 % confidence)'
    >>> statement(4, 100, risk=0.01)
    '4 of 100 support below 9 % and not below 1 % (95 % confidence)'
    """
    if not (0 < risk < 1 and 0 < confidence < 1):
        message = f"risk and confidence must lie in (0, 1), got {risk!r} and {confidence!r}"
        raise MetricError(message)
    at_most = supported_risk(failures, trials, confidence=confidence)
    claim = f"{failures:.4g} of {trials:.4g} support below "
    sure = f" ({100 * confidence:g} % confidence)"
    if at_most < risk:
        return f"{claim}{100 * risk:g} %{sure}"
    if failures == trials:  # also 0 of 0
        return f"{failures:.4g} of {trials:.4g} support no bound{sure}"
    # Rounded up: below 2.951 % is not below 2.95 %.
    scale = 10.0 ** (_DIGITS - 1 - math.floor(math.log10(100 * at_most)))
    shown = math.ceil(100 * at_most * scale) / scale
    least_trials = math.ceil(math.log(1.0 - confidence) / math.log1p(-risk))
    takes = f", which takes {least_trials} without one" if failures == 0 else ""
    return f"{claim}{shown:g} % and not below {100 * risk:g} %{takes}{sure}"


def conformal_factor(position_error_m: ArrayLike, scale_m: ArrayLike, risk: float) -> float:
    """Return the factor on a scale that the error of a new answer exceeds with at most the given risk in (0, 1).

    It is the ceil((N + 1) (1 - risk))-th least ratio of error to scale over N calibration answers; infinite where that
    is more than N, or falls among infinite errors (absent places). The scale is each answer's estimate of its
    uncertainty.

    Raises
    ------
    MetricError
        If the risk or a number is out of range.

    Notes
    -----
    Split conformal prediction (Vovk et al. 2005; Lei et al., JASA 2018). It holds on average over calibration sets, for
    answers that are exchangeable with those of calibration; it says nothing about accepted answers.

    Examples
    --------
    >>> conformal_factor([2.0, 4.0, 6.0, 8.0], [2.0, 2.0, 2.0, 2.0], 0.2), conformal_factor([1.0], [1.0], 0.2)
    (4.0, inf)
    """
    error = check_column(position_error_m, "position_error_m")
    scale = check_column(scale_m, "scale_m", len(error))
    if not 0 < risk < 1 or (error < 0).any() or not ((scale > 0) & np.isfinite(scale)).all():
        message = f"risk must lie in (0, 1), errors be not negative, scales positive and finite, got risk {risk!r}"
        raise MetricError(message)
    ratios: Floats = np.sort(error / scale)
    rank = math.ceil((len(ratios) + 1) * (1.0 - risk) - 1e-9)
    return float(ratios[rank - 1]) if rank <= len(ratios) else math.inf
