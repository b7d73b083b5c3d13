# SPDX-License-Identifier: Apache-2.0
"""The table of metrics, from which boards, Markdown, LaTeX, the site and the documentation are made.

To add a metric, write its function and add one row to `METRICS`.
"""

from dataclasses import replace
from functools import partial
from operator import attrgetter
from typing import Any, Final

import numpy as np
import pandas as pd

from sasgeo_bench.scoring import cost
from sasgeo_bench.scoring.base import Bools, Floats
from sasgeo_bench.scoring.decisions import (
    COST_RATIOS,
    augrc,
    aurc,
    auroc,
    brier,
    calibration_error,
    decision_cost,
    excess_aurc,
    false_fix_rate,
)
from sasgeo_bench.scoring.flights import (
    AGREEING,
    FRESH_S,
    HOLDS_S,
    NEES_BAND,
    RECKONED_M,
    SHARE_INSIDE,
    SOON_M,
    WITHIN_M,
)
from sasgeo_bench.scoring.metric import (
    CostMetric,
    MeanMetric,
    Metric,
    QuantileMetric,
    RejectionMetric,
    ThresholdMetric,
)
from sasgeo_bench.scoring.pose import SUCCESS_DEG, PoseErrors, Ranks, area_values, hits, reciprocal_ranks, successes
from sasgeo_bench.tasks.query import SEQUENCE, TRUTH_SIGMA

_INF: Final = float("inf")


def _column(scores: pd.DataFrame, name: str) -> Floats:
    return scores[name].to_numpy(float)


def _is_longer(scores: pd.DataFrame, than_m: float) -> Bools:
    return (scores["length_m"] > than_m).to_numpy(bool)


def _has_event(scores: pd.DataFrame) -> Bools:
    return scores["reacquired_m"].notna().to_numpy(bool)


def _lasts(scores: pd.DataFrame) -> Bools:
    return scores["continuity_60s"].notna().to_numpy(bool)


def _soon(scores: pd.DataFrame) -> Floats:
    return (scores["reacquired_m"].to_numpy(float) <= SOON_M).astype(float)


def _off_inside(scores: pd.DataFrame) -> Floats:
    return np.abs(scores["inside_95"].to_numpy(float) - SHARE_INSIDE)


def _flight_mean(name: str, meaning: str, **more: Any) -> MeanMetric:  # noqa: ANN401 - other fields of the metric
    usual = MeanMetric(
        name=name,
        meaning=meaning,
        source="mean over flights",
        tracks=(SEQUENCE,),
        values=partial(_column, name=name),
    )
    return replace(usual, **more)


_amount = partial(_flight_mean, bounds=(0.0, _INF))
MEANS: Final = (
    *(
        _flight_mean(
            f"distance_within_{near_m:g}m",
            f"Share of the flown distance with an estimate within {near_m:g} m, accepted or not; a view without one is "
            "beyond",
            better="higher",
            is_primary=near_m == WITHIN_M[0],
        )
        for near_m in WITHIN_M
    ),
    _flight_mean("right_accepted", "Share of the views with an accepted fix within 25 m", better="higher"),
    _flight_mean("false_accepted", "Share of the views with an accepted fix beyond 25 m", read_with="right_accepted"),
    _flight_mean(
        "false_of_accepted",
        "Share of a flight's accepted fixes that are beyond 25 m; 0 where none is accepted",
        read_with="right_accepted",
    ),
    _amount(
        "right_per_km",
        "Accepted fixes within 25 m for each flown kilometre, of about 20 views",
        unit="1/km",
        better="higher",
    ),
    _amount(
        "false_per_km",
        "Accepted fixes beyond 25 m for each flown kilometre, of about 20 views",
        unit="1/km",
        read_with="right_per_km",
    ),
    _amount(
        "longest_without_fix_m",
        "Longest stretch of a flight without an accepted fix within 25 m; the whole flight if there is none",
        unit="m",
    ),
    _amount(
        "divergences",
        "Stretches of a flight, more than 500 m long, with accepted fixes that are all more than 100 m off. A tracker "
        "that accepts nothing has none",
        read_with="right_accepted",
    ),
    _flight_mean(
        "reacquired_500m",
        "Of the flights with a carried drone, a gap or a stretch off the map, the share with an accepted fix within "
        f"25 m at most {SOON_M:g} m after its first view; one such fix is enough",
        better="higher",
        values=_soon,
        counts=_has_event,
    ),
    *(
        _flight_mean(
            f"reckoned_{far_m:g}m",
            f"Share of the flown distance within 25 m if of the accepted fixes one is used in {far_m:g} m at most and "
            "the odometer alone says the rest; of flights twice as long. The tracker was shown every view",
            better="higher",
            counts=partial(_is_longer, than_m=2 * far_m),
        )
        for far_m in RECKONED_M
    ),
    _flight_mean(
        "inside_95_off",
        "How far the share of true positions within the covariance's ellipse of 95 % is from 0.95, of the views "
        "with an estimate; without a covariance it holds none",
        values=_off_inside,
    ),
    _flight_mean(
        "inside_95",
        "Share of the true positions within the covariance's ellipse of 95 %, of the views with an estimate: 0.95 for "
        "an honest covariance, less for one that is too small",
        better="higher",
    ),
    _flight_mean(
        "nees_in_band",
        f"Share of the flights whose NEES lies between {NEES_BAND[0]:.2f} and {NEES_BAND[1]:.2f}, chi-square's band of "
        "95 % for a single view. As views of a flight share errors, that of an honest covariance is 0.95 at least",
        source="Bar-Shalom, Li and Kirubarajan, Estimation with Applications, 2001, section 5.4.2",
        better="higher",
    ),
    _flight_mean(
        "right_confirmed",
        f"Share of the views with a confirmed fix within 25 m: the last of {AGREEING} accepted ones in a row of which "
        "the odometer leads from each to within 25 m of the next",
        better="higher",
    ),
    _flight_mean("false_confirmed", "Share of the views with a confirmed fix beyond 25 m", read_with="right_confirmed"),
    _flight_mean(
        "false_of_confirmed",
        "Share of a flight's confirmed fixes that are beyond 25 m; 0 where none is confirmed",
        read_with="right_confirmed",
    ),
    _flight_mean(
        "available_30s",
        f"Availability: share of the time with an accepted fix, right or not, that is {FRESH_S:g} s old at most. There "
        "is none before the first",
        source="ICAO Annex 10, volume I, attachment D, with the age as the requirement",
        better="higher",
    ),
    _flight_mean(
        "continuity_60s",
        f"Continuity: given an accepted fix that is {FRESH_S:g} s old at most, the chance that there is one all along "
        f"the next {HOLDS_S:g} s; 0 for a flight that never has one. Flights of {HOLDS_S:g} s or less are not counted",
        source="ICAO Annex 10, volume I, attachment D, with this age and this window",
        better="higher",
        counts=_lasts,
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
FLIGHT_QUANTILES: Final = (
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
    _quantile(
        name="first_confirmed",
        meaning="Median over flights of the distance to the first confirmed fix within 25 m, which comes later than "
        f"first_fix by the delay of confirmation; infinite without one{_LOWER}",
        unit="m",
        column="first_confirmed_m",
    ),
    _quantile(
        name="nees",
        meaning="Median over flights of NEES itself, the mean normalized estimation error squared over 3: 1 for an "
        "honest covariance, 4 for one whose standard deviations are half of what they should be; infinite if an "
        f"estimate has none{_LOWER}",
        source="Bar-Shalom, Li and Kirubarajan, Estimation with Applications, 2001, section 5.4",
        column="nees",
    ),
    *(
        _quantile(
            name=f"fix_age_{word}_{unit}",
            meaning=f"Median over flights of {what}; until the first fix it counts from the start{_LOWER}",
            source="age of information: Kaul, Yates and Gruteser, INFOCOM 2012",
            unit=unit,
            column=f"fix_age_{word}_{unit}",
        )
        for word, unit, what in (
            ("p95", "s", "the age of the last accepted fix, right or not, that is not exceeded in 95 % of the time"),
            ("longest", "s", "the longest age of the last accepted fix, right or not"),
            ("p95", "m", "the metres flown since the last accepted fix that are not exceeded on 95 % of the way"),
            ("longest", "m", "the most metres flown since the last accepted fix, right or not"),
        )
    ),
)


RISKS: Final = (0.01, 0.05)  # of a false fix among accepted answers; thresholds are chosen for them
ABSENT_RATES: Final = (0.01, 0.05)  # of absent places that are accepted; thresholds are chosen for them
LOCALIZATION: Final = "localization"
TRACKS: Final = (LOCALIZATION, "retrieval", SEQUENCE)
_SINGLE: Final = TRACKS[:2]  # tracks of views alone
SUCCESS_M: Final = (25.0, 10.0, 5.0)
RECALL_AT: Final = (1, 5)
COVERAGES: Final = (0.5, 0.8)


def errors_of(scores: pd.DataFrame) -> PoseErrors:
    """Return the errors of scored rows; infinite where there is no right pose, which is never counted."""
    columns = (scores[name].to_numpy(float) for name in ("position_error_m", "yaw_error_deg", "log_scale_error"))
    position_m, yaw_deg, log_scale = (np.where(np.isnan(column), np.inf, column) for column in columns)
    return PoseErrors(position_m=position_m, yaw_deg=yaw_deg, log_scale=log_scale)


def ranks_of(scores: pd.DataFrame) -> Ranks:
    """Return the ranks of scored rows."""
    above, tied, right = (scores[name].to_numpy(np.int64) for name in ("above", "tied", "right"))
    return Ranks(above=above, tied=tied, right=right)


def is_present(scores: pd.DataFrame) -> Bools:
    """Return a mask of the rows whose place is present."""
    return scores["is_present"].to_numpy(bool)


def _successes(scores: pd.DataFrame, within_m: float, within_deg: float = SUCCESS_DEG) -> Floats:
    return successes(errors_of(scores), within_m, within_deg).astype(float)


def _is_sharp(scores: pd.DataFrame, within_m: float) -> Bools:
    """Return a mask of the present places whose truth is known to half a tolerance or better."""
    is_fuzzy = scores["strength_unit"].eq(TRUTH_SIGMA) & (2 * scores["strength"] > within_m)  # two sigmas: 95 %
    return is_present(scores) & ~is_fuzzy.to_numpy(bool)


def _hits(scores: pd.DataFrame, k: int) -> Floats:
    return hits(ranks_of(scores), k)


def _answers(scores: pd.DataFrame) -> Floats:
    return scores["is_answered"].to_numpy(float)


_mean = partial(MeanMetric, better="higher", counts=is_present)
ANSWERED: Final = _mean(
    name="answered",
    meaning="Share of present places that were answered, rightly or not",
    source="share of queries",
    tracks=_SINGLE,
    values=_answers,
)
FALSE_ABSENT: Final = MeanMetric(
    name="answered_absent",
    meaning="Share of absent places that were answered; each such answer is a false fix",
    source="share of queries",
    tracks=_SINGLE,
    values=_answers,
    counts=lambda scores: ~is_present(scores),  # any answer is a false fix
)
WITHIN: Final = _mean(  # shows the effect of wrong headings on the primary metric
    name="within_25m",
    meaning="Share of queries with a fix within 25 m of the place, whatever the heading and whichever candidate: what "
    "counts as a fix that is not false",
    source="the SASGeo paper, Eq. (12)",
    tracks=_SINGLE,
    values=lambda scores: scores["is_right"].to_numpy(float),
    counts=partial(_is_sharp, within_m=SUCCESS_M[0]),
)
ANY_DEG: Final = 180.0  # of a heading that does not count


def within_name(within_m: float = _INF, within_deg: float = ANY_DEG) -> str:
    """Return the name of the share of queries within metres, degrees, or both.

    >>> within_name(50.0), within_name(within_deg=2.0), within_name(25.0, 5.0), within_name(5.0, 2.0)
    ('within_50m', 'within_2deg', 'success_25m', 'success_5m_2deg')
    """
    if within_deg == ANY_DEG:
        return f"within_{within_m:g}m"
    if within_m == _INF:
        return f"within_{within_deg:g}deg"
    return f"success_{within_m:g}m" + ("" if within_deg == SUCCESS_DEG else f"_{within_deg:g}deg")


def within_metric(within_m: float = _INF, within_deg: float = ANY_DEG) -> MeanMetric:
    """Return the share of queries whose fix is within metres, whose heading is within degrees, or both.

    Places whose truth is not known to half of the metres do not count.

    >>> near = within_metric(5.0)
    >>> near.name, near.values(pd.DataFrame({"position_error_m": [5.0, np.inf], "yaw_error_deg": [90.0, np.inf]}))
    ('within_5m', array([1., 0.]))
    """
    near = f"whose position is within {within_m:g} m, whatever the heading"
    if within_m == _INF:
        near = f"whose heading is within {within_deg:g} deg, wherever the fix is"
    elif within_deg != ANY_DEG:
        near = f"whose pose is within {within_m:g} m and {within_deg:g} deg"
    return _mean(
        name=within_name(within_m, within_deg),
        meaning=f"Share of queries {near}. No answer is a miss",
        source="recall at metres and degrees, as in Sarlin et al., CVPR 2023",
        tracks=(LOCALIZATION,),
        values=partial(_near, within_m=within_m, within_deg=within_deg),
        counts=partial(_is_sharp, within_m=within_m),
    )


def _near(scores: pd.DataFrame, within_m: float, within_deg: float) -> Floats:
    is_near = (_column(scores, "position_error_m") <= within_m) & (_column(scores, "yaw_error_deg") <= within_deg)
    return is_near.astype(float)


CEILING: Final = _mean(  # the same for every matcher
    name="ceiling",
    meaning="The most that a matcher can expect of the first figure: 1 in k where k places are the same",
    source="measured by the suite",
    tracks=_SINGLE,
    values=lambda scores: scores["ceiling"].to_numpy(float),
)
CHANCE: Final = _mean(  # the same for every matcher
    name="chance_1",
    meaning="What guessing among the candidates reaches",
    source="1 / number of candidates",
    tracks=_SINGLE[1:],
    values=lambda scores: 1.0 / np.maximum(scores["pool"].to_numpy(float), 1.0),
)
_MEANS: Final = (
    *(
        _mean(
            name=f"success_{within_m:g}m",
            meaning=f"Share of queries whose pose is within {within_m:g} m and 5 deg. No answer is a miss",
            source="share of all queries within metres and 5 deg",
            tracks=(LOCALIZATION,),
            values=partial(_successes, within_m=within_m),
            counts=partial(_is_sharp, within_m=within_m),
            is_primary=within_m == SUCCESS_M[0],
        )
        for within_m in SUCCESS_M
    ),
    WITHIN,
    *(within_metric(within_m) for within_m in SUCCESS_M[1:]),
    within_metric(within_deg=SUCCESS_DEG),
    CEILING,
    _mean(
        name="success_auc_50m",
        meaning="Area under the success rate over its tolerance, up to 50 m",
        source="exact area of a step function",
        tracks=(LOCALIZATION,),
        values=lambda scores: area_values(errors_of(scores)),
    ),
    *(
        _mean(
            name=f"recall_{k}",
            meaning=f"Share of queries whose right candidate is among the first {k}. Ties count in proportion, no "
            "answer is a miss",
            source="ties as in McSherry and Najork, ECIR 2008",
            tracks=_SINGLE[1:],
            values=partial(_hits, k=k),
            is_primary=k == RECALL_AT[0],
        )
        for k in RECALL_AT
    ),
    CHANCE,
    _mean(
        name="mrr",
        meaning="Mean of one over the rank of the right candidate",
        source="Voorhees, TREC-8 1999; ties as in McSherry and Najork, ECIR 2008",
        tracks=_SINGLE[1:],
        values=lambda scores: reciprocal_ranks(ranks_of(scores)),
    ),
    ANSWERED,
    FALSE_ABSENT,
    *MEANS,
)
_error = partial(QuantileMetric, bounds=(0.0, _INF), source="Hyndman and Fan, American Statistician 1996, type 1")
QUANTILES: Final = (
    *(
        _error(
            name=f"position_{word}",
            meaning=f"Position error that {100 * share:g} % of the queries do not exceed{also}; infinite without an "
            "answer",
            unit="m",
            column="position_error_m",
            share=share,
        )
        for word, share, also in (
            *(("median", 0.5, ""), ("p90", 0.9, "")),
            *(("p95", 0.95, ": R95, a radius"), ("p99", 0.99, "")),
        )
    ),
    _error(
        name="yaw_median",
        meaning="Median heading error; infinite without an answer",
        unit="deg",
        column="yaw_error_deg",
        share=0.5,
    ),
    _error(
        name="log_scale_median",
        meaning="Median of the absolute logarithm of estimated over true scale; infinite without an answer",
        column="log_scale_error",
        share=0.5,
    ),
    *FLIGHT_QUANTILES,
)
REJECTION: Final = (
    RejectionMetric(
        name="aurc",
        meaning="Area under the risk-coverage curve: mean share of false fixes (beyond 25 m, whatever the heading, on "
        "both tracks) among the surest 1, 2, ..., all queries",
        source="Geifman and El-Yaniv, NeurIPS 2017; ties averaged",
        compute=aurc,
        has_interval=True,
    ),
    RejectionMetric(
        name="e_aurc",
        meaning="AURC less that of the best order of the same answers",
        source="Geifman et al., ICLR 2019; exact for N",
        compute=excess_aurc,
        has_interval=True,
    ),
    RejectionMetric(
        name="auroc",
        meaning="Chance that a right fix is surer than a false one; 0.5 for a guess, whatever the share of false ones",
        source="Hanley and McNeil, Radiology 1982; ties count half",
        better="higher",
        compute=auroc,
        has_interval=True,
    ),
    RejectionMetric(
        name="augrc",
        meaning="Area under the generalized risk-coverage curve: the chance of an undetected false fix, averaged over "
        "coverages",
        source="Traub et al., NeurIPS 2024",
        bounds=(0.0, 0.5),
        compute=augrc,
        has_interval=True,
    ),
    *(
        RejectionMetric(
            name=f"false_fix_at_coverage_{share:g}",
            meaning=f"Share of false fixes among the surest {100 * share:g} % of the queries",
            source="risk at a coverage; ties in proportion",
            compute=partial(false_fix_rate, coverage=share),
        )
        for share in COVERAGES
    ),
    RejectionMetric(
        name="brier",
        meaning="Mean square of stated chance less truth, of rejectors that state chances",
        source="Brier, Monthly Weather Review 1950",
        compute=brier,
        needs_chances=True,
    ),
    RejectionMetric(
        name="ece",
        meaning="Mean distance of stated chance and truth over bins with equally many answers, of rejectors that state "
        "chances",
        source="Nguyen and O'Connor, EMNLP 2015; bins of equal mass",
        compute=calibration_error,
        needs_chances=True,
    ),
    *(
        RejectionMetric(
            name=f"cost_{ratio:g}",
            meaning=f"Mean cost of a query where a false fix costs {ratio:g} and withholding a right one costs 1, if a "
            f"fix is accepted where its chance to be false is below 1 / (1 + {ratio:g}). Compares rejectors on one "
            "matcher",
            source="the SASGeo paper, Eqs. (12)-(14)",
            bounds=(0.0, ratio),
            compute=partial(decision_cost, cost_ratio=ratio),
            needs_chances=True,
        )
        for ratio in COST_RATIOS
    ),
    *(
        RejectionMetric(
            name=f"cost_{ratio:g}_place",
            meaning=f"The same as cost_{ratio:g}, but every present place without an accepted fix costs 1. Compares "
            "whole methods",
            source="the SASGeo paper, Eqs. (12)-(14)",
            bounds=(0.0, ratio),
            compute=partial(decision_cost, cost_ratio=ratio, charged="place"),
            needs_chances=True,
        )
        for ratio in COST_RATIOS
    ),
)
_threshold = partial(ThresholdMetric, source="threshold chosen on other places")
_absent = partial(_threshold, is_of_absent=True)
THRESHOLDS: Final = tuple(
    metric
    for risk, rate in zip(RISKS, ABSENT_RATES, strict=True)
    for metric in (
        _threshold(
            name=f"coverage_at_risk_{risk:g}",
            meaning=f"Share of queries accepted by the threshold that kept false fixes at {100 * risk:g} % on "
            "calibration places",
            better="higher",
            limit=risk,
            what="covered",
        ),
        _threshold(
            name=f"risk_reached_at_{risk:g}",
            meaning=f"Share of false fixes among those accepted so, here. Broken where the interval is above {risk:g}",
            limit=risk,
            what="risk",
        ),
        _absent(
            name=f"right_at_absent_{rate:g}",
            meaning=f"Share of present places whose fix is right and accepted, by the threshold that accepted "
            f"{100 * rate:g} % of the absent calibration places",
            better="higher",
            limit=rate,
            what="right",
        ),
        _absent(
            name=f"absent_reached_at_{rate:g}",
            meaning=f"Share of absent places accepted so, here. Broken where the interval is above {rate:g}",
            limit=rate,
            what="absent",
        ),
    )
)
_cost = partial(CostMetric, bounds=(0.0, _INF), source="measured by the runner")
COSTS: Final = (
    *(
        _cost(
            name=f"latency_p{100 * share:g}",
            meaning=f"Seconds from sending a query until its answer is read; {100 * share:g} % of the answers take no "
            "longer. A time-out counts as infinite",
            unit="s",
            compute=partial(cost.latency_quantile, share=share),
            is_by_track=True,
        )
        for share in (0.5, 0.95)
    ),
    _cost(
        name="prepare",
        meaning="Seconds to make a map ready, once; the longest of all maps",
        unit="s",
        compute=partial(cost.most, measured=attrgetter("prepare_s")),
    ),
    _cost(
        name="peak_memory",
        meaning="Memory of all processes of the matcher together, the most of all maps (1 MB = 10^6 bytes)",
        unit="MB",
        compute=partial(cost.most, measured=attrgetter("peak_bytes"), unit=cost.BYTES_PER_MB),
    ),
    _cost(
        name="index",
        meaning="Memory that preparing a map adds to the matcher's process, the most of all maps",
        unit="MB",
        compute=partial(cost.most, measured=attrgetter("index_bytes"), unit=cost.BYTES_PER_MB),
    ),
    _cost(
        name="map",
        meaning="Files of a map, the most of all maps",
        unit="MB",
        compute=partial(cost.most, measured=attrgetter("map_bytes"), unit=cost.BYTES_PER_MB),
    ),
    _cost(
        name="map_per_km2",
        meaning="Files of the maps and the memory that preparing them adds, over their mapped area (1 kB = 1000 bytes)",
        unit="kB/km2",
        compute=cost.map_kb_per_km2,
    ),
    _cost(
        name="cpu_per_fix",
        meaning="Processor seconds of all queries over those answered",
        unit="s",
        compute=cost.cpu_s_per_fix,
    ),
    _cost(
        name="observation_per_fix",
        meaning="Views of all queries, packed and not compressed, over those answered: what a drone would have to send",
        unit="kB",
        compute=cost.sent_kb_per_fix,
    ),
)
METRICS: Final[tuple[Metric, ...]] = (*_MEANS, *QUANTILES, *REJECTION, *THRESHOLDS, *COSTS)


def means_of(track: str) -> tuple[MeanMetric, ...]:
    """Return the metrics of a track that are means over queries.

    >>> [metric.name for metric in means_of("retrieval")]
    ['within_25m', 'ceiling', 'recall_1', 'recall_5', 'chance_1', 'mrr', 'answered', 'answered_absent']
    """
    return tuple(metric for metric in _MEANS if track in metric.tracks)


def quantiles_of(track: str) -> tuple[QuantileMetric, ...]:
    """Return the quantiles of errors that are printed on a track; none where candidates are ranked."""
    return tuple(metric for metric in QUANTILES if metric.track == track)


def mean_of(track: str, name: str) -> MeanMetric:
    """Return the metric of a name; a track without it has none of that name.

    >>> mean_of("sequence", "false_accepted").better
    'lower'
    """
    return next(metric for metric in means_of(track) if metric.name == name)


def primary_of(track: str) -> MeanMetric:
    """Return the metric that ranks matchers on a track."""
    return next(metric for metric in means_of(track) if metric.is_primary)
