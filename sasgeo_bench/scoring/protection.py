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

    Parameters
    ----------
    matcher : str
        Name.
    scores : pandas.DataFrame
        Scored rows.
    predictions : mapping of str to Prediction
        The same answers by query id, with levels in their diagnostics (`sasgeo.protection.PROTECTION`).
    split : Split, optional
        Assigns the places that calibrate conformal levels; without it there are none. Of a hold-out split the test part
        counts.

    Returns
    -------
    pandas.DataFrame
        A row for each prior group, method, risk and alert limit, with the columns `COLUMNS`; empty if no answer has a
        level. Shares are of all queries: an answer without a level is unavailable, one at an absent place has an
        infinite error. Intervals are Wilson's over sites. `supports` states in words which risk the counts support.
    """
    rows = [
        {"matcher": matcher, "prior_group": item.prior_group, **row}
        for item in told_levels(scores, predictions, split)
        for row in _counted(item)
    ]
    return pd.DataFrame(rows, columns=list(COLUMNS))


@dataclass(frozen=True, slots=True, kw_only=True)
class ToldLevels:
    """Protection levels of one method at one risk, with the errors; arrays have shape (N,).

    Parameters
    ----------
    prior_group, method : str
        Prior group of the queries, and method of the levels.
    risk : float
        Risk that the levels are stated for.
    level_m, error_m : ndarray of float
        Metres; infinite if missing, see `protection_frame`.
    sites : ndarray of str
        `pair_id` of each query.
    """

    prior_group: str
    method: str
    risk: float
    level_m: Floats
    error_m: Floats
    sites: Strings


def told_levels(
    scores: pd.DataFrame, predictions: Mapping[str, Prediction], split: Split | None = None
) -> Iterator[ToldLevels]:
    """Yield the protection levels of one matcher per query, for each prior group, risk and method with a level.

    Parameters are those of `protection_frame`.
    """
    usable = scores[(scores["status"] != NOT_APPLICABLE) & (scores["track"] == "localization")]
    for prior_group, group in usable.groupby("prior_group", sort=True):
        yield from _levels_of_group(str(prior_group), group, predictions, split)


def _levels_of_group(
    prior_group: str, group: pd.DataFrame, predictions: Mapping[str, Prediction], split: Split | None
) -> Iterator[ToldLevels]:
    is_holdout = split is not None and split.spec.kind == "holdout"
    is_tested = (group["part"] == "test").to_numpy(bool) if is_holdout else np.ones(len(group), dtype=bool)
    error_m = _errors_m(group)
    sites = group["pair_id"].to_numpy(str)

    def of(method: str, risk: float, level_m: Floats, counts: Bools) -> ToldLevels:
        """Select the queries that count."""
        return ToldLevels(
            prior_group=prior_group,
            method=method,
            risk=risk,
            level_m=level_m[counts],
            error_m=error_m[counts],
            sites=sites[counts],
        )

    for risk in RISKS:
        told = {method: _told(group, predictions, level_name(method, risk)) for method in METHODS}
        for method, level_m in told.items():
            if np.isfinite(level_m).any():
                yield of(method, risk, level_m, is_tested)
        scale_m = _told(group, predictions, SCALE)
        if split is not None and np.isfinite(scale_m).any():
            yield of(CONFORMAL, risk, *_conformal(group, split, scale_m, error_m, risk))


def _errors_m(group: pd.DataFrame) -> Floats:
    """Return the error of each query; infinite without an answer, and for an answer at an absent place."""
    error_m = group["position_error_m"].to_numpy(float)
    return np.where(np.isnan(error_m), np.inf, error_m)


def _told(group: pd.DataFrame, predictions: Mapping[str, Prediction], name: str) -> Floats:
    """Return the level or scale in each answer's diagnostics; infinite if missing or not positive."""
    answered = zip(group["query_id"], group["is_answered"], strict=True)
    told = [predictions[query].diagnostics.get(name, np.inf) if some else np.inf for query, some in answered]
    values = np.array(told, dtype=np.float64)
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


def _counted(told: ToldLevels) -> Iterator[dict[str, Any]]:
    """Yield a row for each alert limit; none without queries."""
    if not len(told.level_m):
        return
    sites = effective_count(np.unique(told.sites, return_inverse=True)[1])
    for limit_m in ALERT_LIMITS_M:
        counts = stanford_counts(told.level_m, told.error_m, limit_m, trials=sites)
        row = {"method": told.method, "risk": told.risk, "alert_limit_m": limit_m}
        row |= {"n": len(told.level_m), "sites": sites}
        yield row | _shares(counts) | {"supports": _supports(counts, told.risk)}


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
