# SPDX-License-Identifier: Apache-2.0
"""Rows of protection levels: Stanford diagrams counted for each method, risk and alert limit."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from sasgeo_bench.matching.results import Prediction
from sasgeo_bench.sasgeo.protection import METHODS, RISKS, SCALE, level_name
from sasgeo_bench.scoring.base import Bools, Floats
from sasgeo_bench.scoring.intervals import effective_count
from sasgeo_bench.scoring.protection_metric import StanfordCounts, conformal_factor, stanford_counts, statement
from sasgeo_bench.scoring.rejection import turns
from sasgeo_bench.scoring.score import FIX_M, NOT_APPLICABLE
from sasgeo_bench.tasks.split import Split

ALERT_LIMITS_M: Final = (10.0, FIX_M, 50.0)
CONFORMAL: Final = "conformal"  # the method whose levels are fitted here
Strings = NDArray[np.str_]

_AREAS: Final = ("available", "unavailable", "misleading", "hazardous", "exceeded")
COLUMNS: Final = (
    *("matcher", "prior_group", "method", "risk", "alert_limit_m", "n", "sites"),
    *(f"{area}{end}" for area in _AREAS for end in ("", "_lo", "_hi")),
    "supports",
)


def protection_frame(
    matcher: str, scores: pd.DataFrame, predictions: Mapping[str, Prediction], split: Split | None = None
) -> pd.DataFrame:
    """Return how the protection levels of one matcher held, pooled over all suites of localization.

    There is a row for each prior group, method, risk and alert limit; none if no answer has a level in its diagnostics
    (`sasgeo.protection.PROTECTION`). Shares are of all queries: an answer without a level is unavailable, one at an
    absent place has an infinite error. Intervals are Wilson's over sites. `supports` states which risk the counts
    support. `split` assigns the places that calibrate conformal levels; of a hold-out split the test part counts.
    """
    rows = [
        {"matcher": matcher, "prior_group": item.prior_group, **row}
        for item in protection_levels(scores, predictions, split)
        for row in _counted(item)
    ]
    return pd.DataFrame(rows, columns=list(COLUMNS))


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
    """Yield the protection levels of one matcher per query, for each prior group, risk and method with a level.

    Parameters are those of `protection_frame`.
    """
    usable = scores[(scores["status"] != NOT_APPLICABLE) & (scores["track"] == "localization")]
    for prior_group, group in usable.groupby("prior_group", sort=True):
        yield from _levels_of_group(str(prior_group), group, predictions, split)


def _levels_of_group(
    prior_group: str, group: pd.DataFrame, predictions: Mapping[str, Prediction], split: Split | None
) -> Iterator[ProtectionLevels]:
    is_holdout = split is not None and split.spec.kind == "holdout"
    is_tested = (group["part"] == "test").to_numpy(bool) if is_holdout else np.ones(len(group), dtype=bool)
    error_m = _errors_m(group)
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

    for risk in RISKS:
        levels = {method: _diagnostic(group, predictions, level_name(method, risk)) for method in METHODS}
        for method, level_m in levels.items():
            if np.isfinite(level_m).any():
                yield of(method, risk, level_m, is_tested)
        scale_m = _diagnostic(group, predictions, SCALE)
        if split is not None and np.isfinite(scale_m).any():
            yield of(CONFORMAL, risk, *_conformal(group, split, scale_m, error_m, risk))


def _errors_m(group: pd.DataFrame) -> Floats:
    """Return the error of each query; infinite without an answer, and for an answer at an absent place."""
    error_m = group["position_error_m"].to_numpy(float)
    return np.where(np.isnan(error_m), np.inf, error_m)


def _diagnostic(group: pd.DataFrame, predictions: Mapping[str, Prediction], name: str) -> Floats:
    """Return the level or scale in each answer's diagnostics; infinite if missing or not positive."""
    answered = zip(group["query_id"], group["is_answered"], strict=True)
    levels = [predictions[query].diagnostics.get(name, np.inf) if some else np.inf for query, some in answered]
    values = np.array(levels, dtype=np.float64)
    return np.asarray(np.where(values > 0, values, np.inf))


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


def _counted(levels: ProtectionLevels) -> Iterator[dict[str, Any]]:
    """Yield a row for each alert limit; none without queries."""
    if not len(levels.level_m):
        return
    sites = effective_count(np.unique(levels.sites, return_inverse=True)[1])
    for limit_m in ALERT_LIMITS_M:
        counts = stanford_counts(levels.level_m, levels.error_m, limit_m, trials=sites)
        row = {"method": levels.method, "risk": levels.risk, "alert_limit_m": limit_m}
        row |= {"n": len(levels.level_m), "sites": sites}
        yield row | _shares(counts) | {"supports": _supports(counts, levels.risk)}


def _shares(counts: StanfordCounts) -> dict[str, float]:
    found: dict[str, float] = {}
    for area in _AREAS:
        interval = getattr(counts, area)
        found |= {area: interval.value, f"{area}_lo": interval.lo, f"{area}_hi": interval.hi}
    return found


def _supports(counts: StanfordCounts, risk: float) -> str:
    """Return what the misleading ones among the available support, both counted in sites."""
    available = counts.available.value * counts.trials
    return statement(min(counts.misleading.value * counts.trials, available), available, risk=risk)
