# SPDX-License-Identifier: Apache-2.0
"""Registered contrasts: two methods on the same queries, tested as registered before any run."""

import math
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from typing import Final

import numpy as np
import pandas as pd

from sasgeo_bench.errors import ConfigError, counted
from sasgeo_bench.scoring.base import Floats
from sasgeo_bench.scoring.compare import LEAST_BLOCKS, holm, mcnemar_clustered, mcnemar_exact, sensitivity
from sasgeo_bench.scoring.integrity_metric import aurc, drawn_areas
from sasgeo_bench.scoring.intervals import (
    DRAWS,
    ClusterDraws,
    Interval,
    bootstrap_statistic,
    difference_interval,
    effective_count,
    mean_interval,
    percentile_interval,
    seed_of_text,
    wilson_share,
)
from sasgeo_bench.scoring.metrics import primary_of
from sasgeo_bench.scoring.rejection import SLOW_DRAWS, answers_of

ALPHA: Final = 0.05
LESS_THAN_MATTERS: Final = ", by less than would matter"  # suffix of a verdict


@dataclass(frozen=True, slots=True, kw_only=True)
class Contrast:
    """Two methods and the queries they are compared on, as a pipeline file registers it.

    The difference is `first` less `second`: matchers, or for the metric "aurc" each "matcher x rejector". The queries
    are those of `suites`, pooled, on one track; `kinds` are prefixes of the kinds that count, as in "U2", all if empty.
    The metric is "primary", success or recall at 1 on present places, or "aurc", the area under the risk-coverage curve
    on all places. `min_effect` is the least relevant difference: of fractions, or for "aurc" relative to the second
    method.
    """

    name: str
    first: str
    second: str
    suites: tuple[str, ...]
    kinds: tuple[str, ...] = ()
    metric: str = "primary"
    track: str = "localization"
    min_effect: float = 0.03


@dataclass(frozen=True, slots=True, kw_only=True)
class Finding:
    """Result of a contrast.

    The difference is first less second, `lo` and `hi` its paired 95 % interval; NaN without draws. Fewer than
    `LEAST_BLOCKS` blocks decide nothing. `first_only` and `second_only` are the discordant queries; 0 for "aurc".
    `p_exact` is from McNemar's exact test, which assumes independent queries, `p_clustered` from Obuchowski's for
    blocks, and `p_holm` is the latter adjusted by Holm over all registered contrasts. For "aurc" twice the fraction of
    draws on the other side of zero replaces Obuchowski's. `detectable` is the least difference that these queries can
    show; NaN for "aurc" and for too few blocks.
    """

    name: str
    first: str
    second: str
    metric: str
    n: int
    blocks: int
    first_value: float
    second_value: float
    difference: float
    lo: float
    hi: float
    first_only: int
    second_only: int
    p_exact: float
    p_clustered: float
    p_holm: float
    detectable: float
    min_effect: float
    verdict: str


COLUMNS: Final = tuple(field.name for field in fields(Finding))


def hold_contrasts(
    contrasts: Sequence[Contrast],
    scores: Mapping[str, pd.DataFrame],
    rejections: Mapping[tuple[str, str], pd.DataFrame],
    *,
    draws: int = DRAWS,
    failed: Collection[str] = (),
) -> tuple[Finding, ...]:
    """Test every registered contrast, in order; a contrast without queries, or with a failed side, has p = 1.

    `contrasts` are all registered ones and no others: Holm's adjustment covers them. `scores` are scored rows by
    matcher, `rejections` those of `rejection.judge` by matcher and rejector. `failed` names matchers, and "matcher x
    rejector", that failed and so are not on the board. Raise ConfigError if a contrast names a method that is not on
    the board, and none failed.
    """
    there = scores.keys() | {" x ".join(key) for key in rejections}
    found = [
        _tested(contrast, scores, rejections, draws)
        if not failed or {contrast.first, contrast.second} <= there
        else replace(_nothing(contrast), verdict=_undecided(contrast, there, failed))
        for contrast in contrasts
    ]
    adjusted = holm({item.name: 1.0 if math.isnan(item.p_clustered) else item.p_clustered for item in found})
    return tuple(_with_verdict(replace(item, p_holm=adjusted[item.name])) for item in found)


def _undecided(contrast: Contrast, there: Collection[str], failed: Collection[str]) -> str:
    """Return the verdict of a contrast with a side that is not on a board where something failed."""
    side = next(name for name in (contrast.first, contrast.second) if name not in there)
    is_known = side in failed or side.split(" x ", maxsplit=1)[0] in failed
    return f"not decided: {side} {'failed' if is_known else 'is not on the board'}"


def _tested(
    contrast: Contrast,
    scores: Mapping[str, pd.DataFrame],
    rejections: Mapping[tuple[str, str], pd.DataFrame],
    draws: int,
) -> Finding:
    first, second = _pair(contrast, scores, rejections)
    if first.empty:
        return _nothing(contrast)
    is_mean = contrast.metric == "primary"
    return mean_finding(contrast, first, second, draws) if is_mean else _areas(contrast, first, second)


def _pair(
    contrast: Contrast, scores: Mapping[str, pd.DataFrame], rejections: Mapping[tuple[str, str], pd.DataFrame]
) -> tuple[pd.DataFrame, pd.DataFrame]:
    """Return rows of both sides for the same queries in the same order."""
    known = scores if contrast.metric == "primary" else {" x ".join(key): rows for key, rows in rejections.items()}
    return both_on(contrast, known, _counted(contrast))


def both_on(
    contrast: Contrast, known: Mapping[str, pd.DataFrame], chosen: Callable[[pd.DataFrame], "pd.Series[bool]"]
) -> tuple[pd.DataFrame, pd.DataFrame]:
    """Return rows of both sides on a contrast's suites, track and kinds, for the same queries in the same order.

    `known` holds scored rows by the names of sides; `chosen` selects the rows that count, shape (N,). Raise ConfigError
    if a side is not on the board.
    """
    frames = []
    for name in (contrast.first, contrast.second):
        if name not in known:
            there = ", ".join(sorted(known)) or "nothing of the kind"
            message = f"contrast {contrast.name!r} names {name!r}, which is not on the board: there is {there}"
            raise ConfigError(message)
        frames.append(_rows_of(contrast, known[name], chosen))
    shared = sorted(set(frames[0]["query_id"]) & set(frames[1]["query_id"]))
    first, second = (frame.set_index("query_id", drop=False).loc[shared] for frame in frames)
    return first, second


@dataclass(frozen=True, slots=True, kw_only=True)
class PlaceDifference:
    """Difference of a contrast at one place, first less second, with its 95 % interval and sample sizes."""

    place: str
    n: int
    blocks: int
    difference: float
    lo: float
    hi: float


def by_place(
    contrast: Contrast,
    scores: Mapping[str, pd.DataFrame],
    rejections: Mapping[tuple[str, str], pd.DataFrame],
    *,
    draws: int = SLOW_DRAWS,
) -> tuple[PlaceDifference, ...]:
    """Return the difference of a contrast at each place, by name; exploratory, not part of the registered test.

    Parameters and errors are those of `hold_contrasts`; draws are resampled within each place.
    """
    first, second = _pair(contrast, scores, rejections)
    places = first["place"].to_numpy(str)
    return tuple(
        _at_place(contrast, first[places == place], second[places == place], str(place), draws)
        for place in np.unique(places)
    )


def _at_place(contrast: Contrast, first: pd.DataFrame, second: pd.DataFrame, place: str, draws: int) -> PlaceDifference:
    drawn = _drawn(contrast, first, draws)
    if contrast.metric == "primary":
        interval = _mean_interval(*_hits(contrast, first, second), drawn)
    else:
        both = [answers_of(frame) for frame in (first, second)]
        sides = (aurc(both[0]), aurc(both[1]))
        areas = [np.concatenate([drawn_areas(some, row).aurc for row in drawn.weights()]) for some in both]
        interval = _guarded(percentile_interval(sides[0] - sides[1], areas[0] - areas[1]), sides, drawn)
    return PlaceDifference(
        place=place,
        n=len(first),
        blocks=drawn.blocks_count,
        difference=interval.value,
        lo=interval.lo,
        hi=interval.hi,
    )


def chosen_rows(contrast: Contrast, frame: pd.DataFrame) -> pd.DataFrame:
    """Return the scored rows that a contrast counts: its suites, kinds and track."""
    return _rows_of(contrast, frame, _counted(contrast))


def _rows_of(
    contrast: Contrast, frame: pd.DataFrame, chosen: Callable[[pd.DataFrame], "pd.Series[bool]"]
) -> pd.DataFrame:
    """Return chosen rows on a contrast's suites, track and kinds; rows without stress belong to all kinds."""
    rows = frame[frame["suite"].isin(contrast.suites) & (frame["track"] == contrast.track)]
    rows = rows[chosen(rows).to_numpy(bool)]
    is_kind = (rows["role"] != "stress") | rows["kind"].str.startswith(contrast.kinds or "")
    return rows[is_kind.to_numpy(bool)]


def _counted(contrast: Contrast) -> Callable[[pd.DataFrame], "pd.Series[bool]"]:
    """Return a function that masks the rows a contrast counts: present places under stress, or all but falsifiers."""
    if contrast.metric == "primary":
        return lambda rows: rows["is_present"].astype(bool) & (rows["role"] == "stress")
    return lambda rows: rows["role"] != "falsifier"


def _nothing(contrast: Contrast) -> Finding:
    return Finding(
        name=contrast.name,
        first=contrast.first,
        second=contrast.second,
        metric=contrast.metric,
        min_effect=contrast.min_effect,
        n=0,
        blocks=0,
        first_only=0,
        second_only=0,
        verdict="",
        **dict.fromkeys(_NUMBERS, math.nan),
    )


_NUMBERS: Final = (
    *("first_value", "second_value", "difference", "lo", "hi"),
    *("p_exact", "p_clustered", "p_holm", "detectable"),
)


def _drawn(contrast: Contrast, rows: pd.DataFrame, draws: int) -> ClusterDraws:
    seed = seed_of_text(contrast.name)
    return ClusterDraws(blocks=rows["block"].tolist(), sites=rows["pair_id"].tolist(), seed=seed, draws=draws)


def _hits(contrast: Contrast, first: pd.DataFrame, second: pd.DataFrame) -> tuple[Floats, Floats]:
    """Return the primary metric of both sides per query, shape (N,) each."""
    metric = primary_of(contrast.track)
    return metric.values(first), metric.values(second)


def _mean_interval(ours: Floats, theirs: Floats, drawn: ClusterDraws) -> Interval:
    gaps = ours - theirs
    sides = (float(np.maximum(gaps, 0.0).mean()), float(np.maximum(-gaps, 0.0).mean()))
    return _guarded(mean_interval(gaps, drawn), sides, drawn)


def mean_finding(contrast: Contrast, first: pd.DataFrame, second: pd.DataFrame, draws: int) -> Finding:
    """Return the finding by success or recall on the same queries in the same order, without a verdict."""
    ours, theirs = _hits(contrast, first, second)
    blocks, drawn = first["block"].tolist(), _drawn(contrast, first, draws)
    interval = _mean_interval(ours, theirs, drawn)
    won = [(values == 1).astype(float) for values in (ours, theirs)]  # a shared tie is no win
    exact, clustered = mcnemar_exact(won[0], won[1]), mcnemar_clustered(won[0], won[1], blocks)
    return replace(
        _nothing(contrast),
        n=len(ours),
        blocks=drawn.blocks_count,
        first_value=float(ours.mean()),
        second_value=float(theirs.mean()),
        difference=interval.value,
        lo=interval.lo,
        hi=interval.hi,
        first_only=exact.first_only,
        second_only=exact.second_only,
        p_exact=exact.p_value,
        p_clustered=clustered.p_value,
        detectable=sensitivity(ours, theirs, blocks) if drawn.blocks_count >= LEAST_BLOCKS else math.nan,
    )


def _areas(contrast: Contrast, first: pd.DataFrame, second: pd.DataFrame) -> Finding:
    ours, theirs = (answers_of(frame) for frame in (first, second))
    drawn = _drawn(contrast, first, SLOW_DRAWS)
    values = (aurc(ours), aurc(theirs))
    draws = (
        bootstrap_statistic(lambda mass: aurc(ours, mass) - aurc(theirs, mass), drawn)
        if drawn.blocks_count > 1
        else np.empty(0)
    )
    interval = _guarded(percentile_interval(values[0] - values[1], draws), values, drawn)
    return replace(
        _nothing(contrast),
        n=len(first),
        blocks=drawn.blocks_count,
        first_value=values[0],
        second_value=values[1],
        difference=interval.value,
        lo=interval.lo,
        hi=interval.hi,
        p_clustered=_p_of_draws(draws),
    )


def _guarded(found: Interval, sides: tuple[float, float], drawn: ClusterDraws) -> Interval:
    """Return an interval no narrower than Wilson's over sites where draws say little: few blocks, or nothing varies.

    `sides` are two fractions whose difference it is: of queries won and lost, or two areas.
    """
    if drawn.blocks_count >= LEAST_BLOCKS and found.lo < found.hi:
        return found
    trials = effective_count(drawn.blocks if drawn.sites is None else drawn.sites)
    won, lost = (wilson_share(side, trials) for side in sides)
    wide = difference_interval(won, lost)
    return Interval(value=found.value, lo=float(np.fmin(found.lo, wide.lo)), hi=float(np.fmax(found.hi, wide.hi)))


def _p_of_draws(draws: Floats) -> float:
    """Return twice the share of draws on the rarer side of zero, with one draw added; NaN without draws."""
    if not len(draws):
        return math.nan
    rarer = min(int((draws <= 0).sum()), int((draws >= 0).sum()))
    return min(1.0, 2 * (rarer + 1) / (len(draws) + 1))


def _with_verdict(found: Finding) -> Finding:
    """Return a finding with its verdict; a null is a result."""
    is_mean = found.metric == "primary"
    least = found.min_effect * (1.0 if is_mean else abs(found.second_value))
    if not found.n:
        verdict = found.verdict or "not tested: no query"
    elif found.blocks < LEAST_BLOCKS:
        verdict = f"not decided: {counted(found.blocks, 'block')}, at least {LEAST_BLOCKS} are needed"
    elif found.p_holm <= ALPHA and (found.lo > 0 or found.hi < 0):
        is_better = found.difference > 0 if is_mean else found.difference < 0
        verdict = f"{found.first if is_better else found.second} is better" + (
            "" if abs(found.difference) >= least else LESS_THAN_MATTERS
        )
    elif -least < found.lo and found.hi < least:
        verdict = "null: any difference is smaller than would matter"
    else:
        verdict = "null: no difference shown, and one that matters is not ruled out"
    return replace(found, verdict=verdict)


def contrast_frame(findings: Sequence[Finding]) -> pd.DataFrame:
    """Return findings as a table with a column per field."""
    return pd.DataFrame(list(findings), columns=list(COLUMNS))
