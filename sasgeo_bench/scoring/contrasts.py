# SPDX-License-Identifier: Apache-2.0
"""Registered contrasts: two methods on the same queries, tested as was written down before anything was run."""

import hashlib
import math
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from functools import partial
from typing import Final

import numpy as np
import pandas as pd

from sasgeo_bench.errors import ConfigError, counted
from sasgeo_bench.scoring.base import Floats
from sasgeo_bench.scoring.compare import LEAST_BLOCKS, holm, mcnemar_clustered, mcnemar_exact
from sasgeo_bench.scoring.decisions import Answers
from sasgeo_bench.scoring.draws import DRAWS, ClusterDraws
from sasgeo_bench.scoring.integrity import SLOW_DRAWS
from sasgeo_bench.scoring.integrity_metric import aurc, drawn_areas
from sasgeo_bench.scoring.intervals import (
    Interval,
    difference_interval,
    effective_count,
    mean_difference,
    percentile_interval,
    statistic_interval,
    wilson,
)
from sasgeo_bench.scoring.metrics import primary_of
from sasgeo_bench.scoring.power import sensitivity
from sasgeo_bench.scoring.rejection import answers_of

ALPHA: Final = 0.05
LESS_THAN_MATTERS: Final = ", by less than would matter"  # ends a verdict


@dataclass(frozen=True, slots=True, kw_only=True)
class Contrast:
    """Two methods and the queries they are compared on, as a pipeline file registers it.

    Parameters
    ----------
    name : str
        As in "graph".
    first, second : str
        Matchers; the difference is first less second. For "aurc" each is "matcher x rejector".
    suites : tuple of str
        Whose queries count, all of them together.
    kinds : tuple of str
        Only kinds that begin with one of these, as in "U2"; empty for all stresses.
    metric : {"primary", "aurc"}
        Success or recall at 1 on present places; or the area under risk against coverage on all of them.
    track : str
        Of the queries.
    min_effect : float
        Least difference that would matter: of shares, or of "aurc" relative to the second.
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
    """What came of a contrast.

    Parameters
    ----------
    first_value, second_value, difference, lo, hi : float
        Figures of both, first less second, and the paired 95 % interval; NaN where nothing could be drawn.
    n, blocks : int
        Queries and blocks they are from; fewer than `LEAST_BLOCKS` decide nothing.
    first_only, second_only : int
        Discordant queries; 0 for "aurc".
    p_exact, p_clustered, p_holm : float
        McNemar's exact test (queries taken for independent), Obuchowski's for blocks, and that one adjusted by Holm
        over all registered contrasts; of "aurc" the share of draws on the other side of zero, twice.
    detectable : float
        Least difference these queries would show; NaN for "aurc", and of too few blocks.
    verdict : str
        In words.
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
    judged: Mapping[tuple[str, str], pd.DataFrame],
    *,
    draws: int = DRAWS,
    failed: Collection[str] = (),
) -> tuple[Finding, ...]:
    """Test every registered contrast.

    Parameters
    ----------
    contrasts : sequence of Contrast
        All that were registered, and no others: Holm's adjustment is over them.
    scores : mapping of str to pandas.DataFrame
        Scored rows by matcher.
    judged : mapping of (matcher, rejector) to pandas.DataFrame
        From `rejection.judge`.
    draws : int
        Of the bootstrap.
    failed : collection of str
        Matchers, and "matcher x rejector", that failed and so are not on the board.

    Returns
    -------
    tuple of Finding
        In the same order. A contrast without a query has p = 1 and says so; so has one with a side that failed.

    Raises
    ------
    ConfigError
        If a contrast names a method that is not on the board, and none failed.
    """
    there = scores.keys() | {" x ".join(key) for key in judged}
    found = [
        _tested(contrast, scores, judged, draws)
        if not failed or {contrast.first, contrast.second} <= there
        else replace(_nothing(contrast), verdict=_undecided(contrast, there, failed))
        for contrast in contrasts
    ]
    adjusted = holm({item.name: 1.0 if math.isnan(item.p_clustered) else item.p_clustered for item in found})
    return tuple(_with_verdict(replace(item, p_holm=adjusted[item.name])) for item in found)


def _undecided(contrast: Contrast, there: Collection[str], failed: Collection[str]) -> str:
    """Why a contrast is not decided, one side of which is not on a board where something failed."""
    side = next(name for name in (contrast.first, contrast.second) if name not in there)
    is_known = side in failed or side.split(" x ", maxsplit=1)[0] in failed
    return f"not decided: {side} {'failed' if is_known else 'is not on the board'}"


def _tested(
    contrast: Contrast,
    scores: Mapping[str, pd.DataFrame],
    judged: Mapping[tuple[str, str], pd.DataFrame],
    draws: int,
) -> Finding:
    first, second = _pair(contrast, scores, judged)
    if first.empty:
        return _nothing(contrast)
    is_mean = contrast.metric == "primary"
    return mean_finding(contrast, first, second, draws) if is_mean else _areas(contrast, first, second)


def _pair(
    contrast: Contrast, scores: Mapping[str, pd.DataFrame], judged: Mapping[tuple[str, str], pd.DataFrame]
) -> tuple[pd.DataFrame, pd.DataFrame]:
    """Rows of both sides, the same queries in the same order."""
    is_mean = contrast.metric == "primary"
    known: Mapping[str, pd.DataFrame] = scores if is_mean else {" x ".join(key): item for key, item in judged.items()}
    return both_on(contrast, known, _stressed if is_mean else _unfalsified)


def both_on(
    contrast: Contrast, known: Mapping[str, pd.DataFrame], chosen: Callable[[pd.DataFrame], "pd.Series[bool]"]
) -> tuple[pd.DataFrame, pd.DataFrame]:
    """Rows of both sides on the suites, track and kinds of a contrast, the same queries in the same order.

    Parameters
    ----------
    contrast : Contrast
        Says which sides, and on what.
    known : mapping of str to pandas.DataFrame
        Scored rows by the names of sides.
    chosen : callable
        Says of rows which of them count, shape (N,).

    Raises
    ------
    ConfigError
        If a side is not on the board.
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
    """A contrast at one place: first less second with its 95 % interval, and of how much it is."""

    place: str
    n: int
    blocks: int
    difference: float
    lo: float
    hi: float


def by_place(
    contrast: Contrast,
    scores: Mapping[str, pd.DataFrame],
    judged: Mapping[tuple[str, str], pd.DataFrame],
    *,
    draws: int = SLOW_DRAWS,
) -> tuple[PlaceDifference, ...]:
    """A contrast place by place, to see whether few of them make it; no test, and no part of the registered one.

    Parameters
    ----------
    contrast, scores, judged
        As of `hold_contrasts`.
    draws : int
        Of the bootstrap within each place.

    Returns
    -------
    tuple of PlaceDifference
        By name of the place.

    Raises
    ------
    ConfigError
        As `hold_contrasts` does.
    """
    first, second = _pair(contrast, scores, judged)
    places = first["place"].to_numpy(str)
    return tuple(
        _at_place(contrast, first[places == place], second[places == place], str(place), draws)
        for place in np.unique(places)
    )


def _at_place(contrast: Contrast, first: pd.DataFrame, second: pd.DataFrame, place: str, draws: int) -> PlaceDifference:
    blocks, sites = first["block"].tolist(), first["pair_id"].tolist()
    drawn = ClusterDraws(blocks=blocks, sites=sites, seed=_seed(contrast), draws=draws)
    if contrast.metric == "primary":
        ours, theirs = (primary_of(contrast.track).values(frame) for frame in (first, second))
        apart = ours - theirs
        sides = (float(np.maximum(apart, 0.0).mean()), float(np.maximum(-apart, 0.0).mean()))
        found = mean_difference(ours, theirs, drawn)
    else:
        both = [answers_of(frame) for frame in (first, second)]
        sides = (aurc(both[0]), aurc(both[1]))
        areas = [np.concatenate([drawn_areas(some, row).aurc for row in drawn.weights()]) for some in both]
        found = percentile_interval(sides[0] - sides[1], areas[0] - areas[1])
    interval = _guarded(found, sides, drawn, effective_count(sites))
    return PlaceDifference(
        place=place,
        n=len(first),
        blocks=len(set(blocks)),
        difference=interval.value,
        lo=interval.lo,
        hi=interval.hi,
    )


def chosen_rows(contrast: Contrast, frame: pd.DataFrame) -> pd.DataFrame:
    """The scored rows that a contrast counts: stresses of its suites and kinds on its track."""
    return _rows_of(contrast, frame, _stressed if contrast.metric == "primary" else _unfalsified)


def _rows_of(
    contrast: Contrast, frame: pd.DataFrame, chosen: Callable[[pd.DataFrame], "pd.Series[bool]"]
) -> pd.DataFrame:
    """Some rows on the suites, track and kinds of a contrast; what is no stress is about all kinds."""
    rows = frame[frame["suite"].isin(contrast.suites) & (frame["track"] == contrast.track)]
    rows = rows[chosen(rows).to_numpy(bool)]
    is_kind = (rows["role"] != "stress") | rows["kind"].str.startswith(contrast.kinds or "")
    return rows[is_kind.to_numpy(bool)]


def _stressed(rows: pd.DataFrame) -> "pd.Series[bool]":
    return rows["is_present"].astype(bool) & (rows["role"] == "stress")


def _unfalsified(rows: pd.DataFrame) -> "pd.Series[bool]":
    return rows["role"] != "falsifier"


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


def _seed(contrast: Contrast) -> int:
    return int.from_bytes(hashlib.sha256(contrast.name.encode()).digest()[:8], "big")


def mean_finding(contrast: Contrast, first: pd.DataFrame, second: pd.DataFrame, draws: int) -> Finding:
    """Two sides by success or recall, on the same queries in the same order; without a verdict."""
    measure = primary_of(contrast.track)
    ours, theirs = measure.values(first), measure.values(second)
    blocks, sites = first["block"].tolist(), first["pair_id"].tolist()
    drawn = ClusterDraws(blocks=blocks, sites=sites, seed=_seed(contrast), draws=draws)
    apart = ours - theirs
    sides = (float(np.maximum(apart, 0.0).mean()), float(np.maximum(-apart, 0.0).mean()))
    interval = _guarded(mean_difference(ours, theirs, drawn), sides, drawn, effective_count(sites))
    won = [(values == 1).astype(float) for values in (ours, theirs)]  # a tie that is shared is no win
    exact, clustered = mcnemar_exact(won[0], won[1]), mcnemar_clustered(won[0], won[1], blocks)
    return replace(
        _nothing(contrast),
        n=len(ours),
        blocks=len(set(blocks)),
        first_value=float(ours.mean()),
        second_value=float(theirs.mean()),
        difference=interval.value,
        lo=interval.lo,
        hi=interval.hi,
        first_only=exact.first_only,
        second_only=exact.second_only,
        p_exact=exact.p_value,
        p_clustered=clustered.p_value,
        detectable=sensitivity(ours, theirs, blocks).detectable if len(set(blocks)) >= LEAST_BLOCKS else math.nan,
    )


def _areas(contrast: Contrast, first: pd.DataFrame, second: pd.DataFrame) -> Finding:
    ours, theirs = (answers_of(frame) for frame in (first, second))
    blocks, sites = first["block"].tolist(), first["pair_id"].tolist()
    drawn = ClusterDraws(blocks=blocks, sites=sites, seed=_seed(contrast), draws=SLOW_DRAWS)
    apart = partial(_apart, ours, theirs)
    everyone = np.ones(len(first))
    values = (aurc(ours, everyone), aurc(theirs, everyone))
    interval = _guarded(statistic_interval(apart, drawn), values, drawn, effective_count(sites))
    return replace(
        _nothing(contrast),
        n=len(first),
        blocks=len(set(blocks)),
        first_value=values[0],
        second_value=values[1],
        difference=interval.value,
        lo=interval.lo,
        hi=interval.hi,
        p_clustered=_p_of_draws(apart, drawn),
    )


def _guarded(found: Interval, sides: tuple[float, float], drawn: ClusterDraws, trials: float) -> Interval:
    """Where draws say little, of few blocks or where nothing varies, no narrower than by Wilson's over sites.

    `sides` are two shares whose difference it is: of queries won and lost, or two areas.
    """
    if drawn.blocks_count >= LEAST_BLOCKS and found.lo < found.hi:
        return found
    won, lost = (wilson(min(side * trials, trials), trials) for side in sides)
    wide = difference_interval(won, lost)
    return Interval(value=found.value, lo=float(np.fmin(found.lo, wide.lo)), hi=float(np.fmax(found.hi, wide.hi)))


def _apart(ours: Answers, theirs: Answers, mass: Floats) -> float:
    """The difference of both areas under the same weights."""
    return aurc(ours, mass) - aurc(theirs, mass)


def _p_of_draws(apart: Callable[[Floats], float], drawn: ClusterDraws) -> float:
    """Twice the share of draws on the rarer side of zero, one draw added; NaN for fewer than two blocks."""
    if drawn.blocks_count < 2:  # noqa: PLR2004 - one block cannot differ from itself
        return math.nan
    values = np.array([apart(row) for some in drawn.weights() for row in some])
    rarer = min(int((values <= 0).sum()), int((values >= 0).sum()))
    return min(1.0, 2 * (rarer + 1) / (len(values) + 1))


def _with_verdict(found: Finding) -> Finding:
    """Say in words what came of it; a null is a result."""
    if not found.n:
        return replace(found, verdict=found.verdict or "not tested: no query")
    if found.blocks < LEAST_BLOCKS:
        return replace(
            found, verdict=f"not decided: {counted(found.blocks, 'block')}, at least {LEAST_BLOCKS} are needed"
        )
    least = found.min_effect * (1.0 if found.metric == "primary" else abs(found.second_value))
    is_better = found.difference > 0 if found.metric == "primary" else found.difference < 0
    if found.p_holm <= ALPHA and (found.lo > 0 or found.hi < 0):
        size = "" if abs(found.difference) >= least else LESS_THAN_MATTERS
        return replace(found, verdict=f"{found.first if is_better else found.second} is better{size}")
    if -least < found.lo and found.hi < least:
        return replace(found, verdict="null: any difference is smaller than would matter")
    return replace(found, verdict="null: no difference shown, and one that matters is not ruled out")


def contrast_frame(findings: Sequence[Finding]) -> pd.DataFrame:
    """Findings as a table.

    Examples
    --------
    >>> contrast_frame([]).columns[0]
    'name'
    """
    return pd.DataFrame([{name: getattr(item, name) for name in COLUMNS} for item in findings], columns=list(COLUMNS))
