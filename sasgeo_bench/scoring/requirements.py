# SPDX-License-Identifier: Apache-2.0
"""Limits and requirements of one's own: the metrics that they add to a board, and which entries pass or fail them."""

import difflib
import math
import re
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from decimal import Decimal
from functools import partial
from typing import Annotated, Final, Literal, NamedTuple, get_args

import numpy as np
import pandas as pd

from sasgeo_bench.core.errors import ConfigError
from sasgeo_bench.scoring.base import Bools, Floats
from sasgeo_bench.scoring.cost import latencies_s
from sasgeo_bench.scoring.flights import (
    ConfirmedKind,
    available_by_flight,
    confirmed_by_flight,
    continuous_by_flight,
    share_within,
)
from sasgeo_bench.scoring.frames import MATCHER, PRIOR_GROUP, REJECTOR, TRACK, Schema, Shown, row_columns
from sasgeo_bench.scoring.intervals import Interval
from sasgeo_bench.scoring.metric import MeanMetric, Metric, QuantileMetric, ThresholdMetric
from sasgeo_bench.scoring.metrics import (
    ANY_DEG,
    LOCALIZATION,
    METRICS,
    RISKS,
    TRACKS,
    within_metric,
    within_name,
)
from sasgeo_bench.scoring.rejection_rows import AS_DRAWN
from sasgeo_bench.scoring.rows import ALL_SUITES, is_unranked
from sasgeo_bench.scoring.strata import ALL, STRESS
from sasgeo_bench.tasks.query import SEQUENCE

Verdict = Literal["passes", "fails", "not shown"]
PASSES: Final[Verdict] = "passes"
FAILS: Final[Verdict] = "fails"
NOT_SHOWN: Final[Verdict] = "not shown"
_SHIPPED: Final[Mapping[str, Metric]] = {metric.name: metric for metric in METRICS}
_FLOWN: Final = "distance_within_"
_IN_TIME: Final = "latency_within_"
_NUMBER: Final = r"(\d+(?:\.\d+)?)"
_LIMIT: Final = re.compile(rf"\s*{_NUMBER}\s*(m|deg)\s*")
_SHARE_WITHIN: Final = re.compile(rf"{_NUMBER}\s*%\s*within\s+(.+)")
_LATENCY: Final = re.compile(rf"p{_NUMBER}\s+latency\s+{_NUMBER}\s*(ms|s)")
_FIGURE: Final = re.compile(rf"([a-z][\w.]*)\s*(<=|>=)\s*{_NUMBER}\s*(\S*)")
_CONFIRMED: Final[tuple[ConfirmedKind, ...]] = get_args(ConfirmedKind)
_OF_FLIGHTS: Final = re.compile(
    rf"(available|continuity)_{_NUMBER}s|({'|'.join(_CONFIRMED)})_([2-9]|[1-9][0-9])x{_NUMBER}m"
)
_FALSE_OF: Final = re.compile(r"false_of_(accepted|confirmed\S*)")
_UNITS: Final = {"": ("1", 1), "%": ("1", 100), "ms": ("s", 1000)}  # as written -> of the metric, and how many make one
_EXAMPLES: Final = (
    "'80% within 50 m', '50% within 5 m and 2 deg', 'p95 latency 400 ms', 'false <= 1%', or a metric as in "
    "'continuity_60s >= 99%'"
)


class OwnMetric(NamedTuple):
    """A metric of one's own for one track; of flights `of_views` gives its value by flight, from rows of their views.

    `values` of that of flights reads a column, which `with_own` adds to scored rows.
    """

    metric: MeanMetric
    of_views: Callable[[pd.DataFrame], Mapping[str, float]] | None = None


def within_metrics(text: str) -> tuple[OwnMetric, ...]:
    """Return the metrics of a limit such as "5m", "2deg" or "5m,2deg"; none that are on every board.

    Of single views they are shares of queries, of flights shares of the way. Raise `ConfigError` if the text is no
    limit.

    >>> [own.metric.name for own in within_metrics("5m,2deg")]
    ['success_5m_2deg', 'distance_within_5m_2deg']
    >>> [own.metric.name for own in within_metrics("25 m")]
    []
    """
    return _near_metrics(*_limits(text, text.split(","), what=f"--within says {text!r}"))


def _limits(text: str, parts: Sequence[str], *, what: str) -> tuple[float, float]:
    """Return metres and degrees, each of them once at most, infinite or 180 where they are not limited."""
    found: dict[str, float] = {}
    for part in parts:
        match = _LIMIT.fullmatch(part)
        value = 0.0 if match is None else float(match[1])
        if match is None or not value > 0 or match[2] in found or (match[2] == "deg" and value >= ANY_DEG):
            raise ConfigError(f"{what}: {text!r} is no limit, which is metres, degrees or both, as in 50m or 5m,2deg")
        found[match[2]] = value
    return found.get("m", math.inf), found.get("deg", ANY_DEG)


def _near_metrics(within_m: float, within_deg: float) -> tuple[OwnMetric, ...]:
    near = within_metric(within_m, within_deg)
    name = _flown_name(within_m, within_deg)
    limits = name.removeprefix(_FLOWN).replace("_", " and ")
    flown = MeanMetric(
        name=name,
        meaning=f"Share of the flown distance with an estimate within {limits}, accepted or not",
        source="mean over flights",
        better="higher",
        tracks=(SEQUENCE,),
        values=partial(_read, name=name),
    )
    both = (
        OwnMetric(near),
        OwnMetric(flown, partial(share_within, within_m=within_m, within_deg=within_deg)),
    )
    return tuple(own for own in both if own.metric.name not in _SHIPPED)


def _flown_name(within_m: float, within_deg: float) -> str:
    limits = (("m", within_m, math.inf), ("deg", within_deg, ANY_DEG))
    return _FLOWN + "_".join(f"{value:g}{unit}" for unit, value, most in limits if value < most)


def _read(scores: pd.DataFrame, name: str) -> Floats:
    return scores[_key(name)].to_numpy(float)


def _key(name: str) -> str:
    return f"own {name}"  # no column of scores has a space


def latency_metrics(within_s: float) -> tuple[OwnMetric, ...]:
    """Return the shares of queries, and of views of flights, whose answer came within some seconds.

    They bound a quantile: 95 % of the latencies are 0.4 s at most if at least 0.95 came within it, and a share has an
    interval. Without an answer in time, be it by a time-out, a crash or a missing row, a query is a miss; an answer
    that was withheld in time is none.
    """
    name = f"{_IN_TIME}{within_s:g}s"
    usual = MeanMetric(
        name=name,
        meaning=f"Share of queries, or of views, whose answer came within {within_s:g} s; a time-out, a crash or a "
        "missing row is a miss",
        source="share of queries",
        better="higher",
        tracks=tuple(track for track in TRACKS if track != SEQUENCE),
        values=partial(_in_time, within_s=within_s),
    )
    flown = MeanMetric(
        name=name,
        meaning=usual.meaning,
        source="mean over flights",
        better="higher",
        tracks=(SEQUENCE,),
        values=partial(_read, name=name),
    )
    return OwnMetric(usual), OwnMetric(flown, partial(_views_in_time, within_s=within_s))


def flown_metric(name: str) -> OwnMetric | None:
    """Return a metric of flights whose name holds constants of one's own; None for any other name.

    `available_45s` asks for fixes that are 45 s old at most, `continuity_120s` for one all along the next 120 s (of 30
    s at most), `right_confirmed_5x10m`, `false_confirmed_5x10m` and `false_of_confirmed_5x10m` for 5 accepted fixes in
    a row that agree within 10 m.

    >>> found = [flown_metric(name) for name in ("available_45s", "right_confirmed_5x10m", "available_long")]
    >>> [own and own.metric.name for own in found]
    ['available_45s', 'right_confirmed_5x10m', None]
    """
    match = _OF_FLIGHTS.fullmatch(name)
    if match is None or not float(match[2] or match[5]) > 0:
        return None
    kind, seconds, count, metres = match[1] or match[3], match[2], match[4], match[5]
    of_views: Callable[[pd.DataFrame], Mapping[str, float]]
    if kind == "available":
        like, says = "available_30s", f"with fixes that are {seconds} s old at most"
        of_views = partial(available_by_flight, age_s=float(seconds))
    elif kind == "continuity":
        like, says = "continuity_60s", f"over the next {seconds} s; shorter flights are not counted"
        of_views = partial(continuous_by_flight, holds_s=float(seconds))
    else:
        like, says = kind, f"confirmed by {count} accepted ones in a row that agree within {metres} m"
        what = next(one for one in _CONFIRMED if one == kind)
        of_views = partial(confirmed_by_flight, count=int(count), near_m=float(metres), kind=what)
    shipped = _SHIPPED[like]
    assert isinstance(shipped, MeanMetric)  # noqa: S101 - by their table
    values, counts = partial(_read, name=name), partial(_is_known, name=name)
    return OwnMetric(replace(shipped, name=name, meaning=f"As {like}, {says}", values=values, counts=counts), of_views)


def _is_known(scores: pd.DataFrame, name: str) -> Bools:
    return scores[_key(name)].notna().to_numpy(bool)


def is_latency(name: str) -> bool:
    """Return whether a metric of that name is one of `latency_metrics`."""
    return name.startswith(_IN_TIME)


def _in_time(scores: pd.DataFrame, within_s: float) -> Floats:
    return (latencies_s(scores) <= within_s).astype(float)


def _views_in_time(views: pd.DataFrame, within_s: float) -> dict[str, float]:
    shares = pd.Series(_in_time(views, within_s)).groupby(views["sequence_id"].to_numpy()).mean()
    return {str(name): float(share) for name, share in shares.items()}


def with_own(
    found: Sequence[OwnMetric], scores: Mapping[str, pd.DataFrame], views: Mapping[str, pd.DataFrame]
) -> dict[str, pd.DataFrame]:
    """Return scored rows by matcher with a column for each metric of flights; `views` are their views, by matcher."""
    frames = dict(scores)
    for own in found:
        if own.of_views is not None:
            for name, frame in frames.items():
                of_flight = own.of_views(views[name]) if name in views else {}
                values = [of_flight.get(query, math.nan) for query in frame["query_id"]]
                frames[name] = frame.assign(**{_key(own.metric.name): values})
    return frames


def own_metrics(
    within: Sequence[str], requirements: Sequence["Requirement"] = (), *, others: Collection[str] = ()
) -> tuple[OwnMetric, ...]:
    """Return the metrics of limits and of requirements, each once; `others` are names that they must not have."""
    found = [own for text in within for own in within_metrics(text)] + [own for one in requirements for own in one.own]
    taken = next((own.metric.name for own in found if own.metric.name in others), None)
    if taken is not None:
        raise ConfigError(f"a metric of another package is named {taken!r}, as a limit or a requirement is: rename it")
    return tuple({(own.metric.name, own.metric.tracks): own for own in found}.values())


def stated_metrics(within: Sequence[str], requirements: Sequence["Requirement"] = ()) -> dict[str, MeanMetric]:
    """Return by name the shares that limits and requirements ask for, also those that are on every board.

    >>> list(stated_metrics(["10m,5deg"], parse_requirements(["80% within 50 m, p95 latency 400 ms"])))
    ['success_10m', 'distance_within_10m_5deg', 'within_50m', 'distance_within_50m']
    """
    limits = [_limits(text, text.split(","), what=f"--within says {text!r}") for text in within]
    names = [name for near in limits for name in (within_name(*near), _flown_name(*near))]
    names += [name for one in requirements for name in one.figures.values() if not is_latency(name)]
    own = {one.metric.name: one.metric for one in own_metrics(within, requirements)}
    found = ((name, own.get(name, _SHIPPED.get(name))) for name in dict.fromkeys(names))
    return {name: metric for name, metric in found if isinstance(metric, MeanMetric)}


# --- requirements -----------------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True, kw_only=True)
class Requirement:
    """A bound that a figure must keep: at least `bound` if `is_least`, else at most.

    `figures` names the metric of each track that it asks about, `own` are those that a board has for its sake.
    """

    text: str
    bound: float
    is_least: bool
    figures: Mapping[str, str]
    own: tuple[OwnMetric, ...] = field(default=(), repr=False)

    def verdict(self, lo: float, hi: float) -> Verdict:
        """Return what an interval shows; nothing without one, whose ends are NaN.

        >>> some = parse_requirements(["80% within 50 m"])[0]
        >>> some.verdict(0.80, 0.95), some.verdict(0.6, 0.79), some.verdict(0.7, 0.9), some.verdict(math.nan, math.nan)
        ('passes', 'fails', 'not shown', 'not shown')
        """
        worse, better = (lo, hi) if self.is_least else (hi, lo)
        if self._is_met(worse):
            return PASSES
        return FAILS if not math.isnan(better) and not self._is_met(better) else NOT_SHOWN

    def _is_met(self, value: float) -> bool:
        return value >= self.bound if self.is_least else value <= self.bound


def parse_requirements(texts: Sequence[str]) -> tuple[Requirement, ...]:
    """Return the requirements of texts, in each of which a comma parts them; one that is said twice counts once.

    Raise `ConfigError`, quoting the part that is none, or if its metric or unit is unknown.

    >>> [(one.text, one.bound) for one in parse_requirements(["80% within 50 m, false <= 1%"])]
    [('80% within 50 m', 0.8), ('false <= 1%', 0.01)]
    >>> parse_requirements(["mostly within 50 m"])
    Traceback (most recent call last):
        ...
    sasgeo_bench.core.errors.ConfigError: --require says 'mostly within 50 m', which is no requirement: say it as in
    '80% within 50 m', '50% within 5 m and 2 deg', 'p95 latency 400 ms', 'false <= 1%', or a metric as in
    'continuity_60s >= 99%'
    """
    parts = [" ".join(part.split()) for text in texts for part in text.split(",")]
    return tuple(map(_requirement, dict.fromkeys(parts)))


def _requirement(text: str) -> Requirement:
    what = f"--require says {text!r}"
    if (match := _SHARE_WITHIN.fullmatch(text)) is not None:
        within_m, within_deg = _limits(match[2], match[2].split(" and "), what=what)
        own = _near_metrics(within_m, within_deg)
        figures = {LOCALIZATION: within_name(within_m, within_deg), SEQUENCE: _flown_name(within_m, within_deg)}
        return Requirement(text=text, bound=_share(match[1], what), is_least=True, figures=figures, own=own)
    if (match := _LATENCY.fullmatch(text)) is not None:
        if not float(match[2]) > 0:
            raise ConfigError(f"{what}: no answer comes within {match[2]} {match[3]}, give a time above 0")
        own = latency_metrics(_divided(match[2], 1000 if match[3] == "ms" else 1))
        figures = dict.fromkeys(TRACKS, own[0].metric.name)
        return Requirement(text=text, bound=_share(match[1], what), is_least=True, figures=figures, own=own)
    if (match := _FIGURE.fullmatch(text)) is None:
        raise ConfigError(f"{what}, which is no requirement: say it as in {_EXAMPLES}")
    name, is_least, unit = match[1], match[2] == ">=", match[4]
    if name == "false" and not is_least and unit == "%":
        return _of_false(text, _share(match[3], what))
    own_one = None if name in _SHIPPED else flown_metric(name)
    metric = _SHIPPED.get(name) if own_one is None else own_one.metric
    if not isinstance(metric, MeanMetric | QuantileMetric | ThresholdMetric):
        near = difflib.get_close_matches(name, _SHIPPED, n=1)
        known = f"did you mean {near[0]!r}?" if metric is None and near else f"say it as in {_EXAMPLES}"
        fault = "no metric" if metric is None else "a metric without an interval on each suite"
        raise ConfigError(f"{what}, and {name!r} is {fault}: {known}")
    asked, parts = _UNITS.get(unit, (unit, 1))
    if asked != metric.unit:
        right = "a share, as in 90%" if metric.unit == "1" else f"in {metric.unit}"
        raise ConfigError(f"{what}, and {name} is {right}: give its unit")
    bound = _divided(match[3], parts)
    if not metric.bounds[0] <= bound <= metric.bounds[1]:
        least, most = metric.bounds
        raise ConfigError(
            f"{what}, and {name} lies within {least:g} and {most:g}: give a bound that it may keep or miss"
        )
    tracks = metric.tracks if isinstance(metric, MeanMetric) else _tracks_of(metric)
    own = () if own_one is None else (own_one, *filter(None, map(flown_metric, _beside(name))))
    return Requirement(text=text, bound=bound, is_least=is_least, figures=dict.fromkeys(tracks, name), own=own)


def _tracks_of(metric: QuantileMetric | ThresholdMetric) -> tuple[str, ...]:
    return (metric.track,) if isinstance(metric, QuantileMetric) else tuple(set(TRACKS) - {SEQUENCE})


def _share(text: str, what: str) -> float:
    if not 0 < float(text) <= 100:
        raise ConfigError(f"{what}: {text} is no share, which is above 0 and at most 100 %")
    return _divided(text, 100)


def _divided(text: str, parts: int) -> float:
    """Return the number nearest to a part of a decimal; 57 * 0.01 is more than 0.57, which a share of 57 % misses."""
    return float(Decimal(text) / parts)


def _of_false(text: str, bound: float) -> Requirement:
    """Return a bound of false fixes among accepted ones, by the laxest threshold that was chosen for no more."""
    risk = max((one for one in RISKS if one <= bound), default=min(RISKS))
    figures = {track: f"risk_reached_at_{risk:g}" for track in TRACKS if track != SEQUENCE}
    return Requirement(text=text, bound=bound, is_least=False, figures=figures | {SEQUENCE: "false_of_accepted"})


@dataclass(frozen=True, slots=True, kw_only=True)
class Compliance:
    """What the figure of an entry says of a requirement."""

    matcher: Annotated[str, MATCHER]
    rejector: Annotated[str, REJECTOR] = ""
    suite: Annotated[str, "Suite of the queries"]
    track: Annotated[str, TRACK]
    prior_group: Annotated[str, PRIOR_GROUP]
    requirement: Annotated[str, "As it was stated"]
    metric: Annotated[str, "The figure that it bounds"]
    unit: Annotated[str, "Its unit; 1 for a share"]
    stratum: Annotated[str, "Which queries of the suite: those under stress, or all where nothing is stressed"]
    n: Annotated[int, "Queries, or flights"]
    bound: Annotated[float, "The bound"]
    is_least: Annotated[bool, "The figure must be the bound at least, and not at most"]
    figure: Annotated[Interval, "The figure; NaN where the board has none"]
    accepted: Annotated[
        float, "Share of the queries, or views, that are accepted or confirmed; NaN where all answers count"
    ]
    verdict: Annotated[
        str,
        Shown(
            "passes: the worse end of the 95 % interval meets the requirement; fails: the better end does not; not "
            "shown: the interval holds the bound, or there is none, or nothing was accepted, or it is a figure of "
            "single views asked of flights, or the other way round",
            "requirement",
        ),
    ]


COMPLIANCE_SCHEMA: Final = Schema("requirements", row_columns(Compliance))
_KEY: Final = ["suite", "track", "prior_group", "matcher"]


def compliance_frame(requirements: Sequence[Requirement], board: pd.DataFrame) -> pd.DataFrame:
    """Return what the figures of a board say of requirements, with the columns of `Compliance`.

    There is a row for each entry that is no control, each of its suites, tracks and prior groups, and each requirement;
    of accepted answers one for each rejector. Figures are those of the tables of suites:
    under stress, or of all queries where nothing is stressed; thresholds are of all queries of a suite.
    """
    if not requirements:
        return COMPLIANCE_SCHEMA.empty()
    some = board[(board["suite"] != ALL_SUITES) & board["is_applicable"].astype(bool)]
    rows = some[~some["matcher"].map(is_unranked).astype(bool)]
    timed = board[(board["metric"] == "latency_p50") & board["value"].notna()]
    is_timed = {(str(track), str(name)) for track, name in zip(timed["track"], timed["matcher"], strict=True)}
    found = []
    for key, part in rows.groupby(_KEY, sort=True):
        for one in requirements:
            found += list(_of_entry(one, part, is_timed=(str(key[1]), str(key[3])) in is_timed))
    return COMPLIANCE_SCHEMA.frame(found)


def _of_entry(requirement: Requirement, part: pd.DataFrame, *, is_timed: bool) -> Iterator[Compliance]:
    """Yield the rows of one requirement, from all figures of an entry on a suite, track and prior group."""
    suite, track, prior_group, matcher = (str(part[name].iloc[0]) for name in _KEY)
    name = requirement.figures.get(track, "")
    if not name and track not in (
        LOCALIZATION,
        SEQUENCE,
    ):  # of ranks alone, which no requirement in metres or seconds is about
        return
    mine = part[part["metric"] == name]
    is_threshold = isinstance(_SHIPPED.get(name), ThresholdMetric)
    main = mine[mine["stratum"].isin([AS_DRAWN] if is_threshold else [STRESS, ALL])]
    if not is_threshold:  # under stress, if anything is
        main = main.sort_values("stratum", ascending=False, kind="stable").iloc[:1]
    if is_latency(name) and not is_timed:
        main = main.iloc[:0]
    for row in main.to_dict("records") or [{}]:
        rejector = str(row.get("rejector", ""))
        accepted = _accepted(part, name, rejector, str(row.get("stratum", ALL)))
        figure = Interval(**{end: float(row.get(end, math.nan)) for end in ("value", "lo", "hi")})
        verdict = NOT_SHOWN if accepted == 0 else requirement.verdict(figure.lo, figure.hi)
        yield Compliance(
            matcher=matcher,
            rejector=rejector,
            suite=suite,
            track=track,
            prior_group=prior_group,
            requirement=requirement.text,
            metric=name or "none of this track",
            unit=str(row.get("unit", "1")),
            stratum=str(row.get("stratum", "")),
            n=int(row.get("n", 0)),
            bound=requirement.bound,
            is_least=requirement.is_least,
            figure=figure,
            accepted=accepted,
            verdict=verdict,
        )


def _beside(name: str) -> tuple[str, ...]:
    """Return the shares that add up to that of the accepted answers which a figure is of; none if it is of all."""
    if name.startswith("risk_reached_at_"):
        return (name.replace("risk_reached_at_", "coverage_at_risk_"),)
    match = _FALSE_OF.fullmatch(name)
    return () if match is None else (f"right_{match[1]}", f"false_{match[1]}")


def _accepted(part: pd.DataFrame, name: str, rejector: str, stratum: str) -> float:
    """Return the share of accepted answers where a figure is of these alone, else NaN."""
    beside = _beside(name)
    rows = part[part["metric"].isin(beside) & (part["rejector"] == rejector) & (part["stratum"] == stratum)]
    return float(np.sum(rows["value"])) if len(rows) else math.nan
