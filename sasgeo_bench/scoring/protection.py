# SPDX-License-Identifier: Apache-2.0
"""Rows of protection levels: Stanford diagrams counted for each method, risk and alert limit."""

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Annotated, Final

import numpy as np
import pandas as pd
from numpy.typing import ArrayLike, NDArray
from statsmodels.stats.proportion import proportion_confint

from sasgeo_bench.core.errors import MetricError
from sasgeo_bench.matching.matcher import Prediction
from sasgeo_bench.sasgeo.conformal import METHODS, RISKS, SCALE, level_name
from sasgeo_bench.scoring.base import Bools, Floats, check_column, codes_of, weighted_mean
from sasgeo_bench.scoring.decisions import stanford
from sasgeo_bench.scoring.frames import MATCHER, PRIOR_GROUP, Schema, Shown, row_columns
from sasgeo_bench.scoring.intervals import LEVEL, Interval, effective_count, wilson_share
from sasgeo_bench.scoring.rejection import turns
from sasgeo_bench.scoring.score import FIX_M, NOT_APPLICABLE
from sasgeo_bench.tasks.split import Split

_DIGITS: Final = 2  # more would claim a precision that counts do not have


@dataclass(frozen=True, slots=True, kw_only=True)
class StanfordCounts:
    """Shares of all queries in the areas of a Stanford diagram, with Wilson's intervals of `trials`.

    Trials are queries, or sites where several queries are of one. Available: the level is within the alert limit;
    unavailable: it is not, or there is no level or no answer. Misleading: available, and the error exceeds the level.
    Hazardous: misleading, and the error exceeds the alert limit too. Exceeded: the error exceeds the level, available
    or not; this share should not exceed the stated risk.
    """

    trials: float
    available: Interval
    unavailable: Interval
    misleading: Interval
    hazardous: Interval
    exceeded: Interval


def stanford_counts(
    protection_level_m: ArrayLike, position_error_m: ArrayLike, alert_limit_m: float, *, trials: float | None = None
) -> StanfordCounts:
    """Count a Stanford diagram; see `calibration.stanford` for parameters and errors.

    `trials` is the effective number of independent trials, N by default; NaN in [0, 1] for no queries.

    Of six queries five have a level of 5 m and errors of 4, 4, 4, 6 and 11 m, one has neither; the limit is 10 m:

    >>> counts = stanford_counts([5, 5, 5, 5, 5, np.inf], [4, 4, 4, 6, 11, np.inf], 10.0)
    >>> [round(6 * getattr(counts, name).value) for name in ("available", "misleading", "hazardous", "exceeded")]
    [5, 2, 1, 2]
    """
    areas = stanford(protection_level_m, position_error_m, alert_limit_m)
    count = float(len(areas.nominal)) if trials is None else trials
    misleading = areas.misleading | areas.hazardous
    masks = {
        "available": areas.nominal | misleading,
        "unavailable": areas.unavailable | areas.unavailable_misleading,
        "misleading": misleading,
        "hazardous": areas.hazardous,
        "exceeded": misleading | areas.unavailable_misleading,
    }
    return StanfordCounts(
        trials=count, **{name: wilson_share(weighted_mean(mask), count) for name, mask in masks.items()}
    )


def supported_risk(failures: float, trials: float) -> float:
    """Return the least risk that counts support: Clopper-Pearson's one-sided upper bound of 95 %; 1 without a trial.

    Counts need not be whole; 0 <= failures <= trials.

    >>> supported_risk(0, 299) < 0.01 < supported_risk(0, 298), supported_risk(0, 0)
    (True, 1.0)
    """
    if failures == trials:
        return 1.0
    return float(proportion_confint(failures, trials, alpha=2.0 * (1.0 - LEVEL), method="beta")[1])


def statement(failures: float, trials: float, *, risk: float) -> str:
    """Return which risk some counts support, in a line that claims no more than they support.

    Counts need not be whole; 0 <= failures <= trials. Without failures, the line also gives the trials that the risk
    takes. Raise MetricError if the risk is not in (0, 1).

    >>> statement(0, 299, risk=0.01)
    '0 of 299 support below 1 % (95 % confidence)'
    >>> statement(0, 100, risk=0.01)
    '0 of 100 support below 3 % and not below 1 %, which takes 299 without one (95 % confidence)'
    >>> statement(4, 100, risk=0.01)
    '4 of 100 support below 9 % and not below 1 % (95 % confidence)'
    """
    if not 0 < risk < 1:
        raise MetricError(f"risk must lie in (0, 1), got {risk!r}")
    at_most = supported_risk(failures, trials)
    claim = f"{failures:.4g} of {trials:.4g} support below "
    sure = f" ({100 * LEVEL:g} % confidence)"
    if at_most < risk:
        return f"{claim}{100 * risk:g} %{sure}"
    if failures == trials:  # also 0 of 0
        return f"{failures:.4g} of {trials:.4g} support no bound{sure}"
    # Rounded up: below 2.951 % is not below 2.95 %.
    scale = 10.0 ** (_DIGITS - 1 - math.floor(math.log10(100 * at_most)))
    shown = math.ceil(100 * at_most * scale) / scale
    least_trials = math.ceil(math.log(1.0 - LEVEL) / math.log1p(-risk))
    takes = f", which takes {least_trials} without one" if failures == 0 else ""
    return f"{claim}{shown:g} % and not below {100 * risk:g} %{takes}{sure}"


def conformal_factor(position_error_m: ArrayLike, scale_m: ArrayLike, risk: float) -> float:
    """Return the factor on a scale that the error of a new answer exceeds with at most the given risk in (0, 1).

    It is the ceil((N + 1) (1 - risk))-th least ratio of error to scale over N calibration answers; infinite where that
    is more than N, or falls among infinite errors (absent places). The scale is each answer's estimate of its
    uncertainty. Raise MetricError if the risk or a number is out of range.

    Split conformal prediction (Vovk et al. 2005; Lei et al., JASA 2018). It holds on average over calibration sets, for
    answers that are exchangeable with those of calibration; it says nothing about accepted answers.

    >>> conformal_factor([2.0, 4.0, 6.0, 8.0], [2.0, 2.0, 2.0, 2.0], 0.2), conformal_factor([1.0], [1.0], 0.2)
    (4.0, inf)
    """
    error = check_column(position_error_m, "position_error_m")
    scale = check_column(scale_m, "scale_m", len(error))
    if not 0 < risk < 1 or (error < 0).any() or not ((scale > 0) & np.isfinite(scale)).all():
        raise MetricError(
            f"risk must lie in (0, 1), errors be not negative, scales positive and finite, got risk {risk!r}"
        )
    ratios: Floats = np.sort(error / scale)
    rank = math.ceil((len(ratios) + 1) * (1.0 - risk) - 1e-9)
    return float(ratios[rank - 1]) if rank <= len(ratios) else math.inf


ALERT_LIMITS_M: Final = (10.0, FIX_M, 50.0)
CONFORMAL: Final = "conformal"  # the method whose levels are fitted here
Strings = NDArray[np.str_]


@dataclass(frozen=True, slots=True, kw_only=True)
class Protection:
    """How the levels of one method held at one risk and alert limit."""

    matcher: Annotated[str, MATCHER]
    prior_group: Annotated[str, PRIOR_GROUP]
    method: Annotated[str, Shown("How the level is computed")]
    risk: Annotated[float, Shown("How often the error may exceed the level, as was promised")]
    alert_limit_m: Annotated[float, "The error beyond which a fix is of no use"]
    n: Annotated[int, "Queries"]
    sites: Annotated[float, "Their sites, the trials of the intervals"]
    available: Annotated[
        Interval, Shown("Share of queries whose level is within the alert limit, with its 95 % interval")
    ]
    unavailable: Annotated[Interval, "Share of queries whose level is not, or without a level or an answer"]
    misleading: Annotated[
        Interval, Shown("Share that is available and has an error beyond its level, with its 95 % interval")
    ]
    hazardous: Annotated[
        Interval, Shown("Share that is misleading and has an error beyond the alert limit, with its 95 % interval")
    ]
    exceeded: Annotated[
        Interval, Shown("Share with an error beyond the level, available or not, with its 95 % interval")
    ]
    supports: Annotated[str, Shown("Risk that the misleading ones among the available support")]


PROTECTION_SCHEMA: Final = Schema("protection", row_columns(Protection))


def protection_frame(
    matcher: str, scores: pd.DataFrame, predictions: Mapping[str, Prediction], split: Split | None = None
) -> pd.DataFrame:
    """Return how the protection levels of one matcher held, pooled over all suites of localization.

    There is a row for each prior group, method, risk and alert limit; none if no answer has a level in its diagnostics
    (`sasgeo.conformal.PROTECTION`). Shares are of all queries: an answer without a level is unavailable, one at an
    absent place has an infinite error. Intervals are Wilson's over sites. `supports` states which risk the counts
    support. `split` assigns the places that calibrate conformal levels; of a hold-out split the test part counts.
    """
    return PROTECTION_SCHEMA.frame(
        row for levels in protection_levels(scores, predictions, split) for row in _counted(matcher, levels)
    )


@dataclass(frozen=True, slots=True, kw_only=True)
class ProtectionLevels:
    """Protection levels of one method at one risk, with the errors; arrays have shape (N,).

    Levels and errors in metres are infinite if missing; `sites` is the `pair_id` of each query.
    """

    prior_group: str
    method: str
    risk: float
    level_m: Floats
    error_m: Floats
    sites: Strings


def protection_levels(
    scores: pd.DataFrame, predictions: Mapping[str, Prediction], split: Split | None = None
) -> Iterator[ProtectionLevels]:
    """Yield the levels of one matcher per query, for each prior group, risk and method; see `protection_frame`."""
    usable = scores[(scores["status"] != NOT_APPLICABLE) & (scores["track"] == "localization")]
    for prior_group, group in usable.groupby("prior_group", sort=True):
        yield from _levels_of_group(str(prior_group), group, predictions, split)


def _levels_of_group(
    prior_group: str, group: pd.DataFrame, predictions: Mapping[str, Prediction], split: Split | None
) -> Iterator[ProtectionLevels]:
    is_holdout = split is not None and split.spec.kind == "holdout"
    is_tested = (group["part"] == "test").to_numpy(bool) if is_holdout else np.ones(len(group), dtype=bool)
    error_m = group["position_error_m"].fillna(np.inf).to_numpy(float)
    sites = group["pair_id"].to_numpy(str)

    def of(method: str, risk: float, level_m: Floats, counts: Bools) -> ProtectionLevels:
        """Select the queries that count."""
        return ProtectionLevels(
            prior_group=prior_group,
            method=method,
            risk=risk,
            level_m=level_m[counts],
            error_m=error_m[counts],
            sites=sites[counts],
        )

    found = _reported(group, predictions, [SCALE, *(level_name(method, risk) for risk in RISKS for method in METHODS)])
    scale_m = found[SCALE]
    for risk in RISKS:
        for method in METHODS:
            level_m = found[level_name(method, risk)]
            if np.isfinite(level_m).any():
                yield of(method, risk, level_m, is_tested)
        if split is not None and np.isfinite(scale_m).any():
            yield of(CONFORMAL, risk, *_conformal(group, split, scale_m, error_m, risk))


def _reported(group: pd.DataFrame, predictions: Mapping[str, Prediction], names: Sequence[str]) -> dict[str, Floats]:
    """Return levels or scales in each answer's diagnostics, by name; infinite if missing or not positive."""
    answered = zip(group["query_id"], group["is_answered"], strict=True)
    levels = [
        [reported.get(name, np.inf) for name in names]
        for reported in (predictions[query].diagnostics if some else {} for query, some in answered)
    ]
    values = np.array(levels, dtype=np.float64).reshape(-1, len(names))
    return dict(zip(names, np.where(values > 0, values, np.inf).T, strict=True))


def _conformal(
    group: pd.DataFrame, split: Split, scale_m: Floats, error_m: Floats, risk: float
) -> tuple[Floats, Bools]:
    """Return levels by a factor fitted on other places, and a mask of the queries with a fit."""
    level_m, is_fitted = np.full(len(group), np.inf), np.zeros(len(group), dtype=bool)
    for turn in turns(group, split):
        known = turn.calibration & np.isfinite(scale_m)
        if known.any():
            is_fitted |= turn.test
            level_m[turn.test] = conformal_factor(error_m[known], scale_m[known], risk) * scale_m[turn.test]
    return level_m, is_fitted


def _counted(matcher: str, levels: ProtectionLevels) -> Iterator[Protection]:
    """Yield a row for each alert limit; none without queries."""
    if not len(levels.level_m):
        return
    sites = effective_count(codes_of(levels.sites))
    for limit_m in ALERT_LIMITS_M:
        counts = stanford_counts(levels.level_m, levels.error_m, limit_m, trials=sites)
        # The misleading among the available, both counted in sites.
        available = counts.available.value * sites
        misleading = min(counts.misleading.value * sites, available)
        yield Protection(
            matcher=matcher,
            prior_group=levels.prior_group,
            method=levels.method,
            risk=levels.risk,
            alert_limit_m=limit_m,
            n=len(levels.level_m),
            sites=sites,
            available=counts.available,
            unavailable=counts.unavailable,
            misleading=counts.misleading,
            hazardous=counts.hazardous,
            exceeded=counts.exceeded,
            supports=statement(misleading, available, risk=levels.risk),
        )
