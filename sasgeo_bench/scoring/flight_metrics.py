# SPDX-License-Identifier: Apache-2.0
"""Metrics of flights: rows of the table of metrics on the track "sequence"."""

from functools import partial
from typing import Any, Final

import numpy as np
import pandas as pd

from sasgeo_bench.scoring.base import Bools, Floats
from sasgeo_bench.scoring.flights import RECKONED_M, SHARE_INSIDE, SOON_M, WITHIN_M
from sasgeo_bench.scoring.metric import MeanMetric, QuantileMetric
from sasgeo_bench.tasks.query import SEQUENCE

_INF: Final = float("inf")


def _column(scores: pd.DataFrame, name: str) -> Floats:
    return scores[name].to_numpy(float)


def _every(scores: pd.DataFrame) -> Bools:
    return np.ones(len(scores), dtype=bool)


def _is_longer(scores: pd.DataFrame, than_m: float) -> Bools:
    return (scores["length_m"] > than_m).to_numpy(bool)


def _has_event(scores: pd.DataFrame) -> Bools:
    return scores["reacquired_m"].notna().to_numpy(bool)


def _soon(scores: pd.DataFrame) -> Floats:
    return (scores["reacquired_m"].to_numpy(float) <= SOON_M).astype(float)


def _off_inside(scores: pd.DataFrame) -> Floats:
    return np.abs(scores["inside_95"].to_numpy(float) - SHARE_INSIDE)


def _mean(name: str, meaning: str, **more: Any) -> MeanMetric:  # noqa: ANN401 - other fields of the metric
    fields: dict[str, Any] = {"source": "mean over flights", "values": partial(_column, name=name), "counts": _every}
    return MeanMetric(name=name, meaning=meaning, tracks=(SEQUENCE,), **(fields | more))


_amount = partial(_mean, bounds=(0.0, _INF))
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
    _mean("right_accepted", "Share of the views with an accepted fix within 25 m", better="higher"),
    _mean("false_accepted", "Share of the views with an accepted fix beyond 25 m"),
    _mean("false_of_accepted", "Share of a flight's accepted fixes that are beyond 25 m; 0 where none is accepted"),
    _amount(
        "right_per_km",
        "Accepted fixes within 25 m for each flown kilometre, of about 20 views",
        unit="1/km",
        better="higher",
    ),
    _amount("false_per_km", "Accepted fixes beyond 25 m for each flown kilometre, of about 20 views", unit="1/km"),
    _amount(
        "longest_without_fix_m",
        "Longest stretch of a flight without an accepted fix within 25 m; the whole flight if there is none",
        unit="m",
    ),
    _amount(
        "divergences",
        "Stretches of a flight, more than 500 m long, with accepted fixes that are all more than 100 m off. A tracker "
        "that accepts nothing has none",
    ),
    _mean(
        "reacquired_500m",
        "Of the flights with a carried drone, a gap or a stretch off the map, the share with an accepted fix within "
        f"25 m at most {SOON_M:g} m after its first view; one such fix is enough",
        better="higher",
        values=_soon,
        counts=_has_event,
    ),
    *(
        _mean(
            f"reckoned_{far_m:g}m",
            f"Share of the flown distance within 25 m if of the accepted fixes one is used in {far_m:g} m at most and "
            "the odometer alone says the rest; of flights twice as long. The tracker was shown every view",
            better="higher",
            counts=partial(_is_longer, than_m=2 * far_m),
        )
        for far_m in RECKONED_M
    ),
    _mean(
        "inside_95_off",
        "How far the share of true positions within the covariance's ellipse of 95 % is from 0.95, of the views "
        "with an estimate; without a covariance it holds none",
        values=_off_inside,
    ),
)
_LOWER: Final = "; of an even number of flights the lower middle"
_quantile = partial(
    QuantileMetric,
    track=SEQUENCE,
    bounds=(0.0, _INF),
    share=0.5,
    source="Hyndman and Fan, American Statistician 1996, type 1",
)
QUANTILES: Final = (
    *(
        _quantile(
            name=f"error_{word}",
            meaning=f"Median over flights of the position error that {share} of a flight's views do not exceed{_LOWER}",
            unit="m",
            column=f"error_{word}_m",
        )
        for word, share in (("p50", "half"), ("p95", "95 %"))
    ),
    _quantile(
        name="heading_p50",
        meaning=f"Median over flights of the median heading error of a flight's views{_LOWER}",
        unit="deg",
        column="yaw_error_deg",
    ),
    _quantile(
        name="ate",
        meaning="Median over flights of the root mean square of the position error over views, nothing aligned; "
        f"infinite for a flight with a view without an estimate{_LOWER}",
        source="Sturm et al., IROS 2012, without alignment",
        unit="m",
        column="ate_m",
    ),
    _quantile(
        name="first_fix",
        meaning="Median over flights of the distance to the first accepted fix within 25 m, whatever was accepted "
        f"before; infinite without one{_LOWER}",
        unit="m",
        column="first_fix_m",
    ),
    _quantile(
        name="first_fix_time",
        meaning=f"Median over flights of the time to that fix{_LOWER}",
        unit="s",
        column="first_fix_s",
    ),
    _quantile(
        name="nees_off",
        meaning="Median over flights of the absolute logarithm of NEES, the mean normalized estimation error squared "
        "over 3 of the views with an estimate: 0 for an honest covariance, 0.7 for one that is twice too large or too "
        f"small in each direction; infinite if an estimate has none{_LOWER}",
        source="Bar-Shalom, Li and Kirubarajan, Estimation with Applications, 2001, section 5.4",
        column="nees_off",
    ),
)
