# SPDX-License-Identifier: Apache-2.0
"""The figures a board prints: what each is of, its unit, which way is good."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Final, Literal

import numpy as np
import pandas as pd

from sasgeo_bench.scoring.base import Bools, Floats
from sasgeo_bench.scoring.pose import PoseErrors, area_values, successes
from sasgeo_bench.scoring.ranking import Ranks, hits, reciprocal_ranks

SUCCESS_M: Final = (25.0, 10.0, 5.0)
RECALL_AT: Final = (1, 5)
QUANTILES: Final = (("median", 0.5), ("p90", 0.9), ("p99", 0.99))


@dataclass(frozen=True, slots=True, kw_only=True)
class Measure:
    """A figure that is a mean over queries.

    Parameters
    ----------
    name, unit : str
        As on the board; the unit is "1" where there is none.
    better : {"higher", "lower"}
        Which way is good.
    values : callable
        Scored rows -> one finite value for each.
    counts : callable
        Scored rows -> which of them are counted: the denominator, the same for every matcher.
    is_primary : bool
        Whether matchers are ranked by it.
    """

    name: str
    unit: str
    better: Literal["higher", "lower"]
    values: Callable[[pd.DataFrame], Floats]
    counts: Callable[[pd.DataFrame], Bools]
    is_primary: bool = False


@dataclass(frozen=True, slots=True, kw_only=True)
class Quantile:
    """A figure that is a quantile of an error, infinite errors among them."""

    name: str
    unit: str
    column: str
    share: float


def errors_of(scores: pd.DataFrame) -> PoseErrors:
    """Errors of scored rows; where there is nothing to be right about they are infinite, and never counted."""
    columns = (scores[name].to_numpy(float) for name in ("position_error_m", "yaw_error_deg", "log_scale_error"))
    position_m, yaw_deg, log_scale = (np.where(np.isnan(column), np.inf, column) for column in columns)
    return PoseErrors(position_m=position_m, yaw_deg=yaw_deg, log_scale=log_scale)


def ranks_of(scores: pd.DataFrame) -> Ranks:
    """Ranks of scored rows."""
    above, tied, right = (scores[name].to_numpy(np.int64) for name in ("above", "tied", "right"))
    return Ranks(above=above, tied=tied, right=right)


def is_present(scores: pd.DataFrame) -> Bools:
    """Which rows have a place to be right about."""
    return scores["is_present"].to_numpy(bool)


def is_absent(scores: pd.DataFrame) -> Bools:
    """Which rows have none: any answer is a false fix."""
    return ~is_present(scores)


def is_any(scores: pd.DataFrame) -> Bools:
    """All rows."""
    return np.ones(len(scores), dtype=bool)


def _success(within_m: float) -> Measure:
    return Measure(
        name=f"success_{within_m:g}m",
        unit="1",
        better="higher",
        values=lambda scores: successes(errors_of(scores), within_m).astype(float),
        counts=is_present,
        is_primary=within_m == SUCCESS_M[0],
    )


def _recall(k: int) -> Measure:
    return Measure(
        name=f"recall_{k}",
        unit="1",
        better="higher",
        values=lambda scores: hits(ranks_of(scores), k),
        counts=is_present,
        is_primary=k == RECALL_AT[0],
    )


ANSWERED: Final = Measure(
    name="answered",
    unit="1",
    better="higher",
    values=lambda scores: scores["is_answered"].to_numpy(float),
    counts=is_present,
)
FALSE_ABSENT: Final = Measure(
    name="answered_absent",
    unit="1",
    better="lower",
    values=lambda scores: scores["is_answered"].to_numpy(float),
    counts=is_absent,
)
WITHIN: Final = Measure(  # beside the primary figure: what a heading that is off takes away
    name="within_25m",
    unit="1",
    better="higher",
    values=lambda scores: successes(errors_of(scores), SUCCESS_M[0], 180.0).astype(float),
    counts=is_present,
)
CHANCE: Final = Measure(  # the same for every matcher, so that a board says what guessing is worth
    name="chance_1",
    unit="1",
    better="higher",
    values=lambda scores: 1.0 / np.maximum(scores["pool"].to_numpy(float), 1.0),
    counts=is_present,
)
MEASURES: Final[dict[str, tuple[Measure, ...]]] = {
    "localization": (
        *map(_success, SUCCESS_M),
        WITHIN,
        Measure(
            name="success_auc_50m",
            unit="1",
            better="higher",
            values=lambda scores: area_values(errors_of(scores)),
            counts=is_present,
        ),
        ANSWERED,
        FALSE_ABSENT,
    ),
    "retrieval": (
        *map(_recall, RECALL_AT),
        CHANCE,
        Measure(
            name="mrr",
            unit="1",
            better="higher",
            values=lambda scores: reciprocal_ranks(ranks_of(scores)),
            counts=is_present,
        ),
        ANSWERED,
        FALSE_ABSENT,
    ),
}
QUANTILE_MEASURES: Final = (
    *(Quantile(name=f"position_{name}", unit="m", column="position_error_m", share=share) for name, share in QUANTILES),
    Quantile(name="yaw_median", unit="deg", column="yaw_error_deg", share=0.5),
    Quantile(name="log_scale_median", unit="1", column="log_scale_error", share=0.5),
)


def primary_of(track: str) -> Measure:
    """The measure that matchers are ranked by.

    Examples
    --------
    >>> primary_of("retrieval").name
    'recall_1'
    """
    return next(measure for measure in MEASURES[track] if measure.is_primary)
