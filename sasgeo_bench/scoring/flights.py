# SPDX-License-Identifier: Apache-2.0
"""Scores of flights: the error of every view, and one scored row for each flight.

A flight is the unit of all figures: its views are answered one after the other, and the errors of neighbours are alike.
"""

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Annotated, Final, NamedTuple

import numpy as np
import pandas as pd
from numpy.typing import ArrayLike, NDArray
from scipy.stats import chi2

from sasgeo_bench.core.errors import MetricError
from sasgeo_bench.geometry.pose import reckon, wrap_deg
from sasgeo_bench.matching.matcher import Prediction
from sasgeo_bench.matching.tracker import SIDE
from sasgeo_bench.scoring.base import Bools, Floats
from sasgeo_bench.scoring.frames import Schema, row_columns
from sasgeo_bench.scoring.pose import first_pose
from sasgeo_bench.scoring.rows import LEADERBOARD_SCHEMA
from sasgeo_bench.scoring.score import COLUMNS, FIX_M, MISSING, NOT_APPLICABLE, Score, truths_of
from sasgeo_bench.tasks.query import Head, Truth, base_of

WITHIN_M: Final = (25.0, 10.0, 50.0)  # the first is the primary one
RECKONED_M: Final = (250.0, 500.0, 1000.0, 2000.0)  # flown between two uses of a fix
SOON_M: Final = 500.0  # after a gap, or after the drone was carried
DRIFT_M: Final = 500.0  # of the way on which the odometer's drift is measured
DIVERGED_M: Final = 100.0
_DIVERGED_FOR_M: Final = 500.0
SHARE_INSIDE: Final = 0.95  # of true places, that an honest ellipse of that share holds
_INSIDE: Final = float(chi2.ppf(SHARE_INSIDE, 2))  # squared distance to the rim of that ellipse
# Of an honest covariance NEES lies in this band in 95 % of flights if all views of one share their error, and in more
# if they do not: chi-square with the 3 degrees of freedom of one view (Bar-Shalom et al. 2001, section 5.4.2).
NEES_BAND: Final = tuple(float(chi2.ppf(tail, SIDE)) / SIDE for tail in (0.025, 0.975))
FRESH_S: Final = 30.0  # age up to which a fix is of use: some 300 m flown, of which a fair odometer loses 1 %
HOLDS_S: Final = 60.0  # window of continuity; ICAO's of an approach is 15 s, of a flight en route an hour
_AGE_SHARE: Final = 0.95
AGREEING: Final = 3  # accepted fixes in a row that confirm the last of them
_NEEDED: Final = frozenset({"distance_m", "time_s"})  # measured at each view
_JUMP_M: Final = 1.0  # more between two views than was flown: the drone was carried

Complexes = NDArray[np.complex128]  # east + i north, metres


@dataclass(frozen=True, slots=True, kw_only=True)
class FlightScore:
    """What a scored row of a flight has besides `Score`; every view is in every figure, unless it says other views."""

    views: Annotated[int, "Number of views"]
    length_m: Annotated[float, "Flown between the first view and the last"]
    distance_within_25m: Annotated[
        float,
        "Share of the flown distance with an estimate within 25 m, accepted or not; a view stands for half the way to "
        "either neighbour",
    ]
    distance_within_10m: Annotated[float, "The same within 10 m"]
    distance_within_50m: Annotated[float, "The same within 50 m"]
    reckoned_250m: Annotated[
        float,
        "Share within 25 m if, of the tracker's accepted fixes, one is used in 250 m at most and the odometer says the "
        "rest; no part before the first fix. The tracker itself was shown every view",
    ]
    reckoned_500m: Annotated[float, "The same with one in 500 m"]
    reckoned_1000m: Annotated[float, "The same with one in 1000 m"]
    reckoned_2000m: Annotated[float, "The same with one in 2000 m"]
    accepted: Annotated[float, "Share of the views with an accepted fix"]
    right_accepted: Annotated[float, "Share of the views with one within 25 m"]
    false_accepted: Annotated[float, "Share of the views with one beyond"]
    false_of_accepted: Annotated[float, "Share of the accepted fixes that are false; 0 where none is accepted"]
    right_confirmed: Annotated[
        float,
        "Share of the views with a confirmed fix within 25 m: one that agrees with the accepted fix before it, which "
        "agrees with the one before. Two agree if the odometer leads from the first to within 25 m of the second",
    ]
    false_confirmed: Annotated[float, "Share of the views with a confirmed fix beyond"]
    false_of_confirmed: Annotated[float, "Share of the confirmed fixes that are false; 0 where none is confirmed"]
    first_confirmed_m: Annotated[float, "Distance to the first confirmed fix within 25 m; infinite without one"]
    right_per_km: Annotated[float, "Accepted fixes within 25 m over kilometres"]
    false_per_km: Annotated[float, "Those beyond over kilometres"]
    longest_without_fix_m: Annotated[
        float, "The longest stretch without an accepted fix within 25 m; the whole flight if there is none"
    ]
    first_fix_m: Annotated[float, "Distance to the first accepted fix within 25 m; infinite without one"]
    first_fix_s: Annotated[float, "Time to it"]
    reacquired_m: Annotated[
        float,
        "The same distance from the first view after being carried, or else after the longest gap or stretch off the "
        "map, of two views at least; NaN where the flight has none, or ends in it",
    ]
    duration_s: Annotated[float, "Time from the first view to the last"]
    fix_age_p95_s: Annotated[
        float,
        "Age of the last accepted fix, right or not, that is not exceeded in 95 % of that time; until the first fix it "
        "counts from the start",
    ]
    fix_age_longest_s: Annotated[float, "The longest such age"]
    fix_age_p95_m: Annotated[float, "The same as fix_age_p95_s in metres flown since, of the way"]
    fix_age_longest_m: Annotated[float, "The most metres flown since"]
    available_30s: Annotated[float, "Share of the time with an accepted fix that is 30 s old at most"]
    continuity_60s: Annotated[
        float,
        "Of the moments with such a fix, 60 s or more before the end, the share from which on there is one all 60 s "
        "long; 0 without such a moment, NaN of a shorter flight",
    ]
    divergences: Annotated[int, "Number of stretches of more than 500 m with accepted fixes all beyond 100 m"]
    ate_m: Annotated[
        float,
        "Root mean square of the position errors of all views, nothing aligned; infinite if a view has no estimate",
    ]
    error_p50_m: Annotated[float, "Median of the position errors of all views"]
    error_p95_m: Annotated[float, "Their 95th percentile"]
    nees: Annotated[
        float,
        "Mean normalized estimation error squared of the views with an estimate, over its 3 degrees of freedom: 1 for "
        "an honest covariance, more for an optimistic one. Infinite if an estimate has no covariance, or one without "
        "an inverse",
    ]
    nees_off: Annotated[float, "Its absolute logarithm: 0 for an honest covariance"]
    nees_in_band: Annotated[
        bool, f"It lies in chi-square's band of 95 % for one view, {NEES_BAND[0]:.2f} to {NEES_BAND[1]:.2f}"
    ]
    inside_95: Annotated[
        float,
        "Share of the views with an estimate whose true position lies in its ellipse of 95 %; without one it does not",
    ]
    odometer_drift: Annotated[
        float,
        "Of the odometer, not of the tracker: its mean error 500 m after a true pose, over the way flown, 1 at most; "
        "of the stretches on which it was not lost and the drone not carried. NaN without such a stretch",
    ]


FLIGHT_COLUMNS: Final = tuple(column.name for column in row_columns(FlightScore))
SCORE_SCHEMA: Final = Schema(
    "scores",
    (*row_columns(Score), *row_columns(FlightScore), LEADERBOARD_SCHEMA["matcher"]),
    needed=("query_id", "matcher", "suite", "track", "kind", "role", "place", "is_present"),
)
_OF_HEAD: Final = ("query_id", "track", "suite", "suite_version", "part", "region", "prior_group", "view_cells")
_OF_TRUTH: Final = ("pair_id", "role", "kind", "strength", "strength_unit", "block", "scene", "detector")
_MEANS: Final = ("unknown_share", "changed_share", "feature_density")


class ScoredFlights(NamedTuple):
    """`flights` has a row for each flight, `views` one for each view (`view_frame`)."""

    flights: pd.DataFrame
    views: pd.DataFrame


def score_flights(
    heads: Iterable[Head],
    truths: Iterable[Truth],
    predictions: Mapping[str, Prediction],
    *,
    place_of: Mapping[str, str] | None = None,
    country_of: Mapping[str, str] | None = None,
) -> ScoredFlights:
    """Score the predictions of one task of flights: a row for each flight with the columns of Score and FlightScore.

    Arguments and errors are as of `score.score_task`. Of the columns of `Score` the query id is that of the flight, a
    flight is answered if one of its fixes was accepted, its errors are the medians over its views, and it is right if
    its median error is within 25 m. Raise MetricError, too, for views without `distance_m` or `time_s`.
    """
    asked = sorted(heads, key=lambda head: head.query_id)  # by flight, then by time
    if not asked:
        raise MetricError("a task holds no flight: make the queries again")
    by_id = truths_of(asked, truths, predictions)
    views = view_frame(asked, [by_id[head.query_id] for head in asked], predictions, place_of)
    ends = _ends(views["sequence_id"].tolist())
    rows = []
    for first, last in pairwise(ends):
        part, head = views.iloc[first:last], asked[first]
        truth = by_id[head.query_id]
        place = str(part["place"].iloc[0])
        known = [by_id[name] for name in part["query_id"]]
        row = {name: getattr(head, name) for name in _OF_HEAD} | {name: getattr(truth, name) for name in _OF_TRUTH}
        row |= {name: float(np.mean([getattr(one, name) for one in known])) for name in _MEANS}
        row |= {"place": place, "country": (country_of or {}).get(place, place), "cell_size_m": head.cell_size_m}
        figures = flight_score(part)
        rows.append(
            row
            | {"query_id": head.sequence_id, "pool": 0, "alias_index": None, "is_present": True, "ceiling": 1.0}
            | {"status": _status(part["status"].tolist()), "is_answered": bool(part["is_accepted"].any())}
            | {"above": 0, "tied": 0, "right": 0, "confidence": math.nan, "log_scale_error": math.nan}
            | {"position_error_m": figures.error_p50_m, "yaw_error_deg": _quantile(part["yaw_error_deg"], 0.5)}
            | {"is_right": figures.error_p50_m <= FIX_M, "latency_s": float(part["latency_s"].mean())}
            | {name: getattr(figures, name) for name in FLIGHT_COLUMNS}
        )
    columns = [*COLUMNS, *FLIGHT_COLUMNS]
    return ScoredFlights(pd.DataFrame(rows, columns=columns), views)


def _status(of_views: Sequence[str]) -> str:
    """Return the status of a flight: the first that is not "ok"; "not applicable" only where all views are.

    >>> _status(["ok", "timeout", "crash"]), _status(["not applicable", "ok"]), _status(["not applicable"] * 2)
    ('timeout', 'missing', 'not applicable')
    """
    if NOT_APPLICABLE in of_views:
        return NOT_APPLICABLE if set(of_views) == {NOT_APPLICABLE} else MISSING
    return next((status for status in of_views if status != "ok"), "ok")


def _ends(names: Sequence[str]) -> list[int]:
    """Return where each run of equal names begins, and the number of names."""
    return [at for at, name in enumerate(names) if at == 0 or name != names[at - 1]] + [len(names)]


VIEW_COLUMNS: Final = (
    *("query_id", "sequence_id", "frame", "track", "suite", "region", "prior_group", "status"),
    *("distance_m", "time_s", "is_seen", "is_present", "is_carried", "is_answered", "is_accepted", "latency_s"),
    *("true_east_m", "true_north_m", "true_yaw_deg", "east_m", "north_m", "yaw_deg", "error_m", "yaw_error_deg"),
    *("nees", "is_inside", "increment", "block", "place"),
)


def view_frame(
    heads: Sequence[Head],
    truths: Sequence[Truth],
    predictions: Mapping[str, Prediction],
    place_of: Mapping[str, str] | None = None,
) -> pd.DataFrame:
    """Return a row for each view of flights, in order, with the columns `VIEW_COLUMNS`.

    `truths` are those of `heads`, in the same order. Errors are infinite and places NaN without an estimate. `nees` is
    infinite and `is_inside` False without a covariance, or with one without an inverse. `increment` is what the
    odometer says of the way to the view (`Step`). `is_carried` marks the first
    view after the drone was carried. The estimate of a method that does not say whether it is accepted is accepted.
    """
    answers = [predictions.get(head.query_id) for head in heads]
    poses = [first_pose(answer) for answer in answers]
    nothing = (math.nan,) * SIDE
    found = np.array([nothing if one is None else (one.easting_m, one.northing_m, one.yaw_deg) for one in poses])
    true = np.array([_true_pose(truth) for truth in truths])
    gaps = np.column_stack([(found - true).reshape(-1, SIDE)[:, :2], wrap_deg((found - true).reshape(-1, SIDE)[:, 2])])
    is_answered = np.array([pose is not None for pose in poses], dtype=bool)
    nees, in_plane = _normalized(gaps, [None if one is None else one.covariance for one in answers])
    measured, places = [truth.measured for truth in truths], place_of or {}
    lost = next((truth.query_id for truth in truths if not truth.measured.keys() >= _NEEDED), None)
    if lost is not None:
        raise MetricError(
            f"view {lost} was drawn by an older program: remove its task and truths, and make the queries again"
        )
    distance_m = np.array([one["distance_m"] for one in measured])
    frame = np.array([head.frame or 0 for head in heads])
    jump_m = np.hypot(*np.diff(true[:, :2], axis=0, prepend=true[:1, :2]).T)
    table = {
        **{name: [getattr(head, name) for head in heads] for name in ("query_id", "sequence_id", "track", "suite")},
        **{name: [getattr(head, name) for head in heads] for name in ("region", "prior_group")},
        "frame": frame,
        "status": [MISSING if answer is None else answer.status for answer in answers],
        "distance_m": distance_m,
        "time_s": [one["time_s"] for one in measured],
        "is_seen": [one.get("is_seen", 1.0) > 0 for one in measured],
        "is_present": [truth.is_present for truth in truths],
        "is_carried": (frame > 0) & (jump_m > np.diff(distance_m, prepend=distance_m[:1]) + _JUMP_M),
        "is_answered": is_answered,
        "is_accepted": is_answered & np.array([one is not None and one.is_accepted is not False for one in answers]),
        "latency_s": [math.nan if one is None or one.latency_s is None else one.latency_s for one in answers],
        **dict(zip(("true_east_m", "true_north_m", "true_yaw_deg"), true.T, strict=True)),
        **dict(zip(("east_m", "north_m", "yaw_deg"), found.reshape(-1, SIDE).T, strict=True)),
        "error_m": np.where(is_answered, np.hypot(gaps[:, 0], gaps[:, 1]), np.inf),
        "yaw_error_deg": np.where(is_answered, np.abs(gaps[:, 2]), np.inf),
        "nees": nees,
        "is_inside": in_plane <= _INSIDE,
        "increment": [head.increment for head in heads],
        "block": [truth.block for truth in truths],
        "place": [places.get(truth.block, base_of(head.region)) for truth, head in zip(truths, heads, strict=True)],
    }
    return pd.DataFrame(table, columns=list(VIEW_COLUMNS))


def _true_pose(truth: Truth) -> tuple[float, float, float]:
    if truth.pose is None:
        raise MetricError(f"view {truth.query_id} of a flight has no true pose: make the queries again")
    return truth.pose.easting_m, truth.pose.northing_m, truth.pose.yaw_deg


def _normalized(gaps: Floats, covariances: Sequence[tuple[float, ...] | None]) -> tuple[Floats, Floats]:
    """Return normalized squared errors over three degrees of freedom, and squared ones of the position alone.

    Both are infinite without a covariance, and where one from a file has no inverse or is not positive.
    """
    blank = (math.nan,) * SIDE**2
    table = np.array([blank if one is None else one for one in covariances], dtype=float).reshape(-1, SIDE, SIDE)
    table = (table + table.transpose(0, 2, 1)) / 2
    nees, in_plane = np.full(len(table), np.inf), np.full(len(table), np.inf)
    is_given = np.isfinite(table).all(axis=(1, 2)) & np.isfinite(gaps).all(axis=1)
    is_given[is_given] = np.linalg.eigvalsh(table[is_given])[:, 0] > 0
    for size, into in ((SIDE, nees), (2, in_plane)):
        some, part = gaps[is_given][:, :size, None], table[is_given][:, :size, :size]
        into[is_given] = (some * np.linalg.solve(part, some)).sum(axis=(1, 2))
    return nees / SIDE, in_plane


def flight_score(views: pd.DataFrame) -> FlightScore:
    """Return the figures of one flight from the rows of its views."""
    column = {name: views[name].to_numpy() for name in VIEW_COLUMNS}
    distance_m, error_m = column["distance_m"].astype(float), column["error_m"].astype(float)
    accepted = column["is_accepted"].astype(bool)
    right = accepted & (error_m <= FIX_M)
    false = accepted & (error_m > FIX_M)
    way_m = _ways_m(distance_m)
    length_m = float(distance_m[-1] - distance_m[0])
    per_km = 1000.0 / length_m if length_m > 0 else 0.0  # of a flight that never moved
    first_fix_m = _first(distance_m - distance_m[0], right)
    event = _event(column["is_seen"] & column["is_present"], column["is_carried"])
    reckoned, answered = _Reckoned.of(views), column["is_answered"].astype(bool)
    confirmed = reckoned.confirmed(AGREEING, FIX_M)
    nees = float(column["nees"][answered].mean()) if answered.any() else math.inf
    time_s = column["time_s"].astype(float)
    return FlightScore(
        views=len(views),
        length_m=length_m,
        **{f"distance_within_{near_m:g}m": _share(way_m, error_m <= near_m) for near_m in WITHIN_M},
        **{f"reckoned_{far_m:g}m": _share(way_m, reckoned.error_m(far_m) <= FIX_M) for far_m in RECKONED_M},
        accepted=float(accepted.mean()),
        right_accepted=float(right.mean()),
        false_accepted=float(false.mean()),
        false_of_accepted=float(false.sum() / max(1, accepted.sum())),
        right_confirmed=float((confirmed & right).mean()),
        false_confirmed=float((confirmed & false).mean()),
        false_of_confirmed=float((confirmed & false).sum() / max(1, confirmed.sum())),
        first_confirmed_m=_first(distance_m - distance_m[0], confirmed & right),
        right_per_km=float(right.sum()) * per_km,
        false_per_km=float(false.sum()) * per_km,
        longest_without_fix_m=_longest(distance_m, right),
        first_fix_m=first_fix_m,
        first_fix_s=_first(time_s, right),
        reacquired_m=math.nan if event is None else _first(distance_m[event:] - distance_m[event], right[event:]),
        duration_s=float(time_s[-1] - time_s[0]),
        fix_age_p95_s=age_quantile(time_s, accepted),
        fix_age_longest_s=_longest(time_s, accepted),
        fix_age_p95_m=age_quantile(distance_m, accepted),
        fix_age_longest_m=_longest(distance_m, accepted),
        available_30s=availability(time_s, accepted, FRESH_S),
        continuity_60s=continuity(time_s, accepted, FRESH_S, HOLDS_S),
        divergences=_divergences(distance_m, accepted & (error_m > DIVERGED_M), accepted),
        ate_m=float(np.sqrt(np.mean(error_m**2))),
        error_p50_m=_quantile(error_m, 0.5),
        error_p95_m=_quantile(error_m, 0.95),
        nees=nees,
        nees_off=abs(math.log(nees)) if 0 < nees < math.inf else math.inf,
        nees_in_band=NEES_BAND[0] <= nees <= NEES_BAND[1],
        inside_95=float(column["is_inside"][answered].mean()) if answered.any() else 0.0,
        odometer_drift=reckoned.drift(),
    )


def _ways_m(distance_m: Floats) -> Floats:
    """Return the way that each view stands for: half of that from the view before and of that to the next.

    Views of a flight that never moved stand for the same.

    >>> _ways_m(np.array([0.0, 10.0, 40.0])).tolist()
    [5.0, 20.0, 15.0]
    """
    if not distance_m[-1] > distance_m[0]:
        return np.ones(len(distance_m))
    step_m = np.diff(distance_m)
    return np.asarray((np.append(0.0, step_m) + np.append(step_m, 0.0)) / 2)


def _share(way_m: Floats, mask: Bools) -> float:
    """Return a share of the way, 1 for all of it to the last digit."""
    return float((way_m * mask).sum() / way_m.sum())


def _quantile(values: ArrayLike, share: float) -> float:
    """Return the least value that a share of the views does not exceed, which may be infinite."""
    return float(np.quantile(np.asarray(values, dtype=float), share, method="inverted_cdf"))


def _first(at: Floats, is_right: Bools) -> float:
    """Return the first of some increasing values that is right; infinite without one."""
    return float(at[np.argmax(is_right)]) if is_right.any() else math.inf


def _longest(distance_m: Floats, is_fix: Bools) -> float:
    """Return the longest stretch between fixes, the start and the end.

    >>> _longest(np.array([0.0, 50.0, 100.0, 300.0]), np.array([False, True, True, False]))
    200.0
    """
    known = np.concatenate([distance_m[:1], distance_m[is_fix], distance_m[-1:]])
    return float(np.diff(known).max())


def age_quantile(at: Floats, is_fix: Bools, share: float = _AGE_SHARE) -> float:
    """Return the age of the last fix that is not exceeded during a share of the way or time, in its unit.

    `at`, shape (N,), are places or moments of views in ascending order; until the first fix the age counts from the
    start. Between views it grows, so that of a gap of length g a part of g - a is older than a; the gaps together hold
    1 - share of the whole at the age sought, which is the most that the longest k gaps ask for, over all k.

    Gaps of 10 and 30 s: of 40 s the last 2 s of the longer one are older than 28 s.

    >>> round(age_quantile(np.array([0.0, 10.0, 20.0, 40.0]), np.array([True, True, False, False])), 6)
    28.0
    """
    known = np.concatenate([at[:1], at[is_fix], at[-1:]])
    gaps = np.sort(np.diff(known))[::-1]
    rest = (1.0 - share) * (at[-1] - at[0])
    return float(max(0.0, ((np.cumsum(gaps) - rest) / np.arange(1, len(gaps) + 1)).max()))


def availability(time_s: Floats, is_fix: Bools, age_s: float) -> float:
    """Return the share of the time with a fix that is `age_s` old at most; there is none before the first.

    >>> availability(np.array([0.0, 10.0, 60.0, 100.0]), np.array([False, True, True, False]), 30.0)
    0.6
    """
    known = np.append(time_s[is_fix], time_s[-1])
    whole_s = float(time_s[-1] - time_s[0])
    return float(np.minimum(np.diff(known), age_s).sum() / whole_s) if whole_s > 0 else float(is_fix.any())


def continuity(time_s: Floats, is_fix: Bools, age_s: float, holds_s: float) -> float:
    """Return the chance that a fix of `age_s` at most is there for `holds_s` more, given that there is one.

    It is over all moments with such a fix that lie `holds_s` or more before the end; 0 without any, NaN if the flight
    is shorter.

    ICAO Annex 10, volume I, attachment D: the probability that a service that is there at the beginning
    of an operation is there until its end.

    There is a fix for 30 s, of which the first 10 s have it 20 s later:

    >>> continuity(np.array([0.0, 100.0]), np.array([True, False]), 30.0, 20.0)
    0.3333333333333333
    """
    last_s = float(time_s[-1]) - holds_s
    if not last_s > time_s[0]:
        return math.nan
    fixes_s = time_s[is_fix]
    if not len(fixes_s):
        return 0.0
    is_parted = np.diff(fixes_s) > age_s
    since_s = fixes_s[np.append(np.array([True]), is_parted)]
    until_s = fixes_s[np.append(is_parted, np.array([True]))] + age_s
    whole_s = np.maximum(np.minimum(until_s, last_s) - since_s, 0.0).sum()
    held_s = np.maximum(np.minimum(until_s - holds_s, last_s) - since_s, 0.0).sum()
    return float(held_s / whole_s) if whole_s > 0 else 0.0


def share_within(views: pd.DataFrame, within_m: float, within_deg: float) -> dict[str, float]:
    """Return by flight the share of its way with an estimate within metres and degrees, accepted or not.

    `views` are rows of `view_frame`; an error equal to a limit is within it.
    """
    is_near = (views["error_m"] <= within_m) & (views["yaw_error_deg"] <= within_deg)
    return {
        name: _share(_ways_m(part["distance_m"].to_numpy(float)), part["is_near"].to_numpy(bool))
        for name, part in flights_in(views.assign(is_near=is_near))
    }


def flights_in(views: pd.DataFrame) -> Iterator[tuple[str, pd.DataFrame]]:
    """Yield the views of each flight, out of rows of `view_frame`, with the id of the flight."""
    names = views["sequence_id"].tolist()
    for first, last in pairwise(_ends(names)):
        yield names[first], views.iloc[first:last]


def available_by_flight(views: pd.DataFrame, age_s: float) -> dict[str, float]:
    """Return `availability` by flight, of accepted fixes; `views` are rows of `view_frame`."""
    return {name: availability(*_accepted_at(part), age_s) for name, part in flights_in(views)}


def continuous_by_flight(views: pd.DataFrame, holds_s: float) -> dict[str, float]:
    """Return `continuity` by flight, of accepted fixes that are 30 s old at most; `views` are rows of `view_frame`."""
    return {name: continuity(*_accepted_at(part), FRESH_S, holds_s) for name, part in flights_in(views)}


def _accepted_at(views: pd.DataFrame) -> tuple[Floats, Bools]:
    return views["time_s"].to_numpy(float), views["is_accepted"].to_numpy(bool)


def confirmed_by_flight(views: pd.DataFrame, *, count: int, near_m: float, is_false: bool) -> dict[str, float]:
    """Return by flight what a rule of `count` accepted fixes in a row gives that agree within `near_m` metres.

    It is the share of its views with a confirmed fix within 25 m, or of its confirmed fixes that are beyond
    (`is_false`), 0 where none is confirmed. `views` are rows of `view_frame`.
    """
    found = {}
    for name, part in flights_in(views):
        confirmed, is_right = _Reckoned.of(part).confirmed(count, near_m), part["error_m"].to_numpy(float) <= FIX_M
        beyond = float((confirmed & ~is_right).sum() / max(1, confirmed.sum()))
        found[name] = beyond if is_false else float((confirmed & is_right).mean())
    return found


def _event(is_sighted: Bools, is_carried: Bools) -> int | None:
    """Return the first view after the drone was carried, or else after the longest stretch of views without a place.

    Views that show nothing one by one are no gap: the event takes two in a row.
    """
    if is_carried.any():
        return int(np.argmax(is_carried))
    ends = np.flatnonzero(np.diff(np.concatenate([[True], is_sighted, [True]]).astype(int)))
    runs = ends.reshape(-1, 2)
    long = runs[(np.diff(runs, axis=1)[:, 0] > 1) & (runs[:, 1] < len(is_sighted))]
    return int(long[np.argmax(np.diff(long, axis=1)[:, 0]), 1]) if len(long) else None


def _divergences(distance_m: Floats, is_far: Bools, accepted: Bools) -> int:
    """Count the stretches of more than 500 m whose accepted fixes are all far off; other views do not end one."""
    claimed = np.flatnonzero(accepted)
    far, at_m = is_far[claimed], distance_m[claimed]
    ends = np.flatnonzero(np.diff(np.concatenate([[False], far, [False]]).astype(int))).reshape(-1, 2)
    return sum(bool(at_m[last - 1] - at_m[first] > _DIVERGED_FOR_M) for first, last in ends)


@dataclass(frozen=True, kw_only=True)
class _Reckoned:
    """The way of a flight by its odometer, its accepted fixes, and the truth.

    Places are complex numbers, east + i north. A heading is clockwise, and so turns by exp(-i yaw).
    """

    distance_m: Floats
    true: Complexes
    true_yaw: Floats  # radians
    fixes: Complexes
    fix_yaw: Floats  # radians
    accepted: Bools
    has_step: Bools  # the odometer says what lies between the view and the one before
    is_lost: Bools  # on the way to the view: by the odometer, or since the drone was carried
    way: Complexes
    turn: Floats  # radians

    @classmethod
    def of(cls, views: pd.DataFrame) -> "_Reckoned":
        """Add up the increments to the views of one flight; a lost one counts as no movement."""
        increments = views["increment"].tolist()
        steps = np.array([(0.0, 0.0, 0.0) if one is None else one for one in increments], dtype=float)
        way_m = reckon((0.0, 0.0), 0.0, steps[1:])
        column = {name: views[name].to_numpy(float) for name in ("true_east_m", "true_north_m", "east_m", "north_m")}
        return cls(
            distance_m=views["distance_m"].to_numpy(float),
            true=column["true_east_m"] + 1j * column["true_north_m"],
            true_yaw=np.radians(views["true_yaw_deg"].to_numpy(float)),
            fixes=column["east_m"] + 1j * column["north_m"],
            fix_yaw=np.radians(views["yaw_deg"].to_numpy(float)),
            accepted=views["is_accepted"].to_numpy(bool),
            has_step=np.array([one is not None for one in increments]),
            is_lost=np.array([one is None for one in increments]) | views["is_carried"].to_numpy(bool),
            way=way_m[:, 0] + 1j * way_m[:, 1],
            turn=np.cumsum(np.radians(steps[:, 2])),
        )

    def drift(self) -> float:
        """Return `FlightScore.odometer_drift`."""
        last = np.searchsorted(self.distance_m, self.distance_m + DRIFT_M)
        lost = np.append(np.cumsum(self.is_lost), -1)
        first = np.flatnonzero(lost[last] == lost[:-1])  # a stretch that the flight does not hold ends at -1
        if not len(first):
            return math.nan
        last = last[first]
        turned = np.exp(-1j * (self.true_yaw[first] - self.turn[first]))
        off = np.abs(self.true[first] + (self.way[last] - self.way[first]) * turned - self.true[last])
        return min(1.0, float(np.mean(off / (self.distance_m[last] - self.distance_m[first]))))

    def confirmed(self, count: int, near_m: float) -> Bools:
        """Return which views have an accepted fix that the ones before confirm: so many in a row agree.

        Two agree if the odometer, which knows nothing of being carried, leads from the first to within some metres of
        the second. It cannot where it lost its way.
        """
        at = np.flatnonzero(self.accepted)
        first, second = at[:-1], at[1:]
        turned = np.exp(-1j * (self.fix_yaw[first] - self.turn[first]))
        off_m = np.abs(self.fixes[first] + (self.way[second] - self.way[first]) * turned - self.fixes[second])
        steps = np.cumsum(self.has_step)
        agree = (off_m <= near_m) & (steps[second] - steps[first] == second - first)
        found = np.zeros(len(self.accepted), dtype=bool)
        in_a_row = count - 1
        if len(agree) >= in_a_row:
            found[at[in_a_row:]] = np.convolve(agree, np.ones(in_a_row), "valid") == in_a_row
        return found

    def error_m(self, every_m: float) -> Floats:
        """Return the error of every view if a fix is used once in some metres at most, and the odometer then."""
        last = np.full(len(self.way), -1)
        used_m = -math.inf
        for at in np.flatnonzero(self.accepted).tolist():
            if self.distance_m[at] - used_m >= every_m:
                last[at:], used_m = at, self.distance_m[at]
        known = last >= 0
        base = np.maximum(last, 0)
        turned = np.exp(-1j * (self.fix_yaw[base] - self.turn[base]))
        reached = self.fixes[base] + (self.way - self.way[base]) * turned
        return np.where(known, np.abs(reached - self.true), np.inf)
