# SPDX-License-Identifier: Apache-2.0
"""Metrics of flights: rows of the table of metrics on the track "sequence"."""

from functools import partial
from typing import Any, Final

import numpy as np
import pandas as pd

from sasgeo_bench.scoring.base import Bools, Floats
from sasgeo_bench.scoring.flights import EVERY_M, SOON_M, WITHIN_M
from sasgeo_bench.scoring.metric import MeanMetric, QuantileMetric
from sasgeo_bench.tasks.query import SEQUENCE

_INF: Final = float("inf")


def _column(scores: pd.DataFrame, name: str) -> Floats:
    return scores[name].to_numpy(float)


def _every(scores: pd.DataFrame) -> Bools:
    return np.ones(len(scores), dtype=bool)


def _has_event(scores: pd.DataFrame) -> Bools:
    return scores["reacquired_m"].notna().to_numpy(bool)


def _soon(scores: pd.DataFrame) -> Floats:
    return (scores["reacquired_m"].to_numpy(float) <= SOON_M).astype(float)


def _mean(name: str, meaning: str, **more: Any) -> MeanMetric:  # noqa: ANN401 - other fields of the metric
    fields: dict[str, Any] = {
        "source": "mean over flights",
        "values": partial(_column, name=name),
        "counts": _every,
    } | more
    return MeanMetric(name=name, meaning=meaning, tracks=(SEQUENCE,), **fields)


MEANS: Final = (
    *(
        _mean(
            f"distance_within_{near_m:g}m",
            f"Share of the flown distance with an estimate within {near_m:g} m, accepted or not; a view without one is "
            "beyond",
            better="higher",
            is_primary=near_m == WITHIN_M[0],
        )
        for near_m in WITHIN_M
    ),
    _mean("accepted", "Share of the views with a fix that the tracker says may be relied on", better="higher"),
    _mean("false_accepted", "Share of the views with an accepted fix beyond 25 m"),
    _mean("false_per_km", "Accepted fixes beyond 25 m for each flown kilometre", unit="1/km", bounds=(0.0, _INF)),
    _mean(
        "accepted_per_km",
        "Accepted fixes for each flown kilometre",
        unit="1/km",
        better="higher",
        bounds=(0.0, _INF),
    ),
    _mean(
        "longest_without_fix_m",
        "Longest stretch of a flight without an accepted fix; the whole flight if there is none",
        unit="m",
        bounds=(0.0, _INF),
    ),
    _mean(
        "divergences",
        "Stretches of a flight, more than 500 m long, with accepted fixes that are all more than 100 m off",
        bounds=(0.0, _INF),
    ),
    _mean(
        "reacquired_500m",
        f"Share of the flights with a gap, a stretch off the map, or a carried drone that have an accepted fix within "
        f"25 m at most {SOON_M:g} m after it",
        better="higher",
        values=_soon,
        counts=_has_event,
    ),
    *(
        _mean(
            f"fix_every_{far_m:g}m",
            f"Share of the flown distance within 25 m if an accepted fix is used once in {far_m:g} m at most, and the "
            "odometer alone says the rest",
            better="higher",
        )
        for far_m in EVERY_M
    ),
    _mean(
        "inside_two_sigma",
        "Share of the views with a covariance whose true position lies in the ellipse that should hold 95.4 %",
        better="higher",
    ),
)
_quantile = partial(
    QuantileMetric, track=SEQUENCE, bounds=(0.0, _INF), source="Hyndman and Fan, American Statistician 1996, type 1"
)
QUANTILES: Final = (
    *(
        _quantile(
            name=f"error_{word}",
            meaning=f"Median over flights of the position error that {share} of a flight's views do not exceed",
            unit="m",
            column=f"error_{word}_m",
            share=0.5,
        )
        for word, share in (("p50", "half"), ("p95", "95 %"))
    ),
    _quantile(
        name="ate",
        meaning="Median over flights of the root mean square of the position error, nothing aligned; infinite for a "
        "flight with a view without an estimate",
        source="Sturm et al., IROS 2012, without alignment",
        unit="m",
        column="ate_m",
        share=0.5,
    ),
    _quantile(
        name="first_fix",
        meaning="Median over flights of the distance to the first accepted fix within 25 m; infinite without one",
        unit="m",
        column="first_fix_m",
        share=0.5,
    ),
    _quantile(
        name="first_fix_time",
        meaning="Median over flights of the time to the first accepted fix within 25 m; infinite without one",
        unit="s",
        column="first_fix_s",
        share=0.5,
    ),
    _quantile(
        name="nees",
        meaning="Median over flights of the mean normalized estimation error squared over 3: 1 for an honest "
        "covariance, more for an optimistic one, infinite without any",
        source="Bar-Shalom, Li and Kirubarajan, Estimation with Applications, 2001, section 5.4",
        column="nees",
        share=0.5,
    ),
)
