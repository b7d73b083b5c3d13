# SPDX-License-Identifier: Apache-2.0
"""Scored rows of some matchers -> the leaderboard: figures with intervals, denominators and ranks."""

import hashlib
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
import pandas as pd

from sasgeo_bench.errors import MetricError
from sasgeo_bench.metrics.base import Bools, Floats
from sasgeo_bench.metrics.compare import RankInterval, distinguishable, rank_intervals
from sasgeo_bench.metrics.intervals import (
    DRAWS,
    ClusterDraws,
    Interval,
    bootstrap_means,
    percentile_interval,
    wilson,
)
from sasgeo_bench.metrics.pose import error_quantile
from sasgeo_bench.metrics.power import sensitivity
from sasgeo_bench.report.measures import MEASURES, QUANTILE_MEASURES, Measure, Quantile, primary_of
from sasgeo_bench.report.rows import Row, Told, bare, to_frame
from sasgeo_bench.report.strata import ALL, CONTROL, STRESS, strata
from sasgeo_bench.score import NOT_APPLICABLE

GROUP: Final = ("suite", "track", "prior_group")
UNRANKED: Final = frozenset(
    {"oracle_pose", "random", "prior_centre", "map_density_prior"}
)  # controls: beside the ranks
_WHOLE: Final = frozenset({ALL, STRESS, CONTROL})  # strata that also get quantiles of errors


def leaderboard(scored: Mapping[str, pd.DataFrame], *, draws: int = DRAWS) -> pd.DataFrame:
    """Figures of every matcher on every suite, track, prior group and stratum.

    Parameters
    ----------
    scored : mapping of str to pandas.DataFrame
        By matcher, from `score.score_task`; all hold the same queries.
    draws : int
        Of the bootstrap.

    Returns
    -------
    pandas.DataFrame
        Columns as the fields of `Row`.

    Raises
    ------
    MetricError
        If two matchers were scored on different queries.
    """
    frames = _aligned(scored)
    return to_frame([row for group, parts in _groups(frames) for row in _rows_of_group(group, parts, draws)])


def _aligned(scored: Mapping[str, pd.DataFrame]) -> dict[str, pd.DataFrame]:
    """The frames with their rows in one order."""
    frames = {name: frame.sort_values("query_id", ignore_index=True) for name, frame in scored.items()}
    first = next(iter(frames.values()), None)
    for name, frame in frames.items():
        if first is not None and not frame["query_id"].equals(first["query_id"]):
            message = f"{name} was scored on other queries than {next(iter(frames))}: score them together"
            raise MetricError(message)
    return frames


def _groups(frames: Mapping[str, pd.DataFrame]) -> Iterator[tuple[tuple[str, str, str], dict[str, pd.DataFrame]]]:
    """Suite, track and prior group, with the rows of each matcher."""
    if not frames:
        return
    first = next(iter(frames.values()))
    keys = list(zip(*(first[name] for name in GROUP), strict=True))
    for suite, track, prior_group in sorted(set(keys)):
        index = [at for at, key in enumerate(keys) if key == (suite, track, prior_group)]
        yield (suite, track, prior_group), {name: frame.iloc[index] for name, frame in frames.items()}


@dataclass(frozen=True, kw_only=True)
class _Cell:
    """Rows of all matchers in one stratum."""

    group: tuple[str, str, str]
    stratum: str
    frames: dict[str, pd.DataFrame]
    draws: int

    @property
    def seed(self) -> int:
        """Of these queries alone, so that all matchers are drawn alike."""
        text = "/".join((*self.group, self.stratum))
        return int.from_bytes(hashlib.sha256(text.encode()).digest()[:8], "big")

    def counted(self, chosen: Bools) -> "_Cell":
        """Only some of the rows."""
        frames = {name: frame[chosen] for name, frame in self.frames.items()}
        return _Cell(group=self.group, stratum=self.stratum, frames=frames, draws=self.draws)

    @property
    def first(self) -> pd.DataFrame:
        """Rows of any matcher: what they say of the queries is the same in all."""
        return next(iter(self.frames.values()))


def _rows_of_group(group: tuple[str, str, str], frames: dict[str, pd.DataFrame], draws: int) -> Iterator[Row]:
    able = {name: frame for name, frame in frames.items() if not (frame["status"] == NOT_APPLICABLE).all()}
    for name in frames.keys() - able.keys():
        yield _not_applicable(name, group, frames[name])
    if not able:
        return
    for stratum, chosen in strata(next(iter(able.values()))):
        parts = {name: frame[chosen] for name, frame in able.items()}
        yield from _rows_of_cell(_Cell(group=group, stratum=stratum, frames=parts, draws=draws))


def _not_applicable(name: str, group: tuple[str, str, str], frame: pd.DataFrame) -> Row:
    """The one row of a matcher that cannot."""
    primary = primary_of(group[1])
    told = _told(name, group, ALL, frame)
    return told.row(primary.name, primary.unit, primary.better, bare(math.nan), is_applicable=False)


def _told(name: str, group: tuple[str, str, str], stratum: str, frame: pd.DataFrame) -> Told:
    suite, track, prior_group = group
    return Told.of(frame, matcher=name, suite=suite, track=track, prior_group=prior_group, stratum=stratum)


def _rows_of_cell(cell: _Cell) -> Iterator[Row]:
    """Every figure of every matcher in one stratum."""
    track = cell.group[1]
    by_count: dict[bytes, list[Measure]] = {}
    masks: dict[bytes, Bools] = {}
    for measure in MEASURES[track]:
        mask = measure.counts(cell.first)
        if mask.any():
            by_count.setdefault(mask.tobytes(), []).append(measure)
            masks[mask.tobytes()] = mask
    for key, measures in by_count.items():
        yield from _mean_rows(cell.counted(masks[key]), measures)


def _mean_rows(cell: _Cell, measures: Sequence[Measure]) -> Iterator[Row]:
    """Means that share a denominator, by the same draws."""
    names = list(cell.frames)
    blocks, sites = cell.first["block"].tolist(), cell.first["pair_id"].tolist()
    table = np.column_stack([measure.values(frame) for measure in measures for frame in cell.frames.values()])
    drawn = ClusterDraws(blocks=blocks, seed=cell.seed, draws=cell.draws)
    below = _thresholds(cell, measures)
    if below:
        table = np.column_stack((table, *(column for *_, column in below)))
    means = bootstrap_means(table, drawn) if drawn.blocks_count > 1 else np.full((0, table.shape[1]), np.nan)
    for number, measure in enumerate(measures):
        columns = slice(number * len(names), (number + 1) * len(names))
        yield from _ranked(cell, measure, table[:, columns], means[:, columns])
    offset = len(measures) * len(names)
    for at, (name, quantile, value, column) in enumerate(below):
        found, how = mean_with_interval(column, sites, means[:, offset + at])
        errors = cell.frames[name][quantile.column].to_numpy(float)
        lo, hi = (_inverse(errors, share) for share in (found.lo, found.hi))
        told = _told(name, cell.group, cell.stratum, cell.frames[name])
        yield told.row(quantile.name, quantile.unit, "lower", Interval(value=value, lo=lo, hi=hi), how)


def _thresholds(cell: _Cell, measures: Sequence[Measure]) -> list[tuple[str, Quantile, float, Floats]]:
    """For quantiles of errors: matcher, quantile, its value, and which errors do not exceed it (Woodruff 1952)."""
    is_pose = cell.group[1] == "localization" and any(measure.is_primary for measure in measures)
    if not is_pose or cell.stratum not in _WHOLE:
        return []
    found = []
    for name, frame in cell.frames.items():
        for quantile in QUANTILE_MEASURES:
            errors = frame[quantile.column].to_numpy(float)
            value = error_quantile(errors, quantile.share)
            found.append((name, quantile, value, (errors <= value).astype(float)))
    return found


def _inverse(errors: Floats, share: float) -> float:
    """Least error that a share of the queries does not exceed; 0 and infinity beyond the shares there are."""
    if math.isnan(share):
        return math.nan
    return error_quantile(errors, min(share, 1.0)) if share > 0 else 0.0


def _ranked(cell: _Cell, measure: Measure, table: Floats, means: Floats) -> Iterator[Row]:
    """Rows of one measure; of the primary one with ranks."""
    names, blocks, sites = list(cell.frames), cell.first["block"].tolist(), cell.first["pair_id"].tolist()
    found = [mean_with_interval(table[:, at], sites, means[:, at]) for at in range(len(names))]
    ranks = _ranks(names, [interval.value for interval, _ in found], means, measure) if measure.is_primary else {}
    for at, name in enumerate(names):
        interval, how = found[at]
        told = _told(name, cell.group, cell.stratum, cell.frames[name])
        rank = ranks.get(name, RankInterval(best=0, worst=0))
        detectable = _detectable(name, names, table, blocks) if measure.is_primary else math.nan
        yield told.row(
            measure.name,
            measure.unit,
            measure.better,
            interval,
            how,
            rank_best=rank.best,
            rank_worst=rank.worst,
            detectable=detectable,
        )


def _ranks(names: Sequence[str], values: Sequence[float], means: Floats, measure: Measure) -> dict[str, RankInterval]:
    """Rank intervals of all but the controls; none where there are not two blocks to draw from."""
    chosen = [at for at, name in enumerate(names) if name not in UNRANKED]
    if not chosen:
        return {}
    if not len(means):
        return {}
    better = distinguishable([values[at] for at in chosen], means[:, chosen], better=measure.better)
    return {names[at]: rank for at, rank in zip(chosen, rank_intervals(better), strict=True)}


def _detectable(name: str, names: Sequence[str], table: Floats, blocks: Sequence[str]) -> float:
    """Least difference from the best other matcher that would be found; controls are nobody's rivals."""
    others = [at for at, other in enumerate(names) if other != name and other not in UNRANKED]
    if not others or name in UNRANKED or len(set(blocks)) < 2:  # noqa: PLR2004 - one block says nothing of others
        return math.nan
    best = max(others, key=lambda at: float(table[:, at].mean()))
    return sensitivity(table[:, names.index(name)], table[:, best], blocks).detectable


def mean_with_interval(values: Floats, sites: Sequence[str], draws: Floats) -> tuple[Interval, str]:
    """A mean of values in [0, 1] with its interval, and how it was found.

    Parameters
    ----------
    values : ndarray of float, shape (N,)
        One for each query.
    sites : sequence of str, length N
        Site of each: the queries of one site show one place.
    draws : ndarray of float, shape (D,)
        Means of the bootstrap; none where there are fewer than two blocks.

    Returns
    -------
    Interval, str
        By the bootstrap where there are two blocks or more and something varies. Of one block, or where all values are
        0 or all are 1, the draws say nothing: then Wilson's interval, as if each site were one trial.

    Examples
    --------
    >>> found, how = mean_with_interval(np.ones(40), ["a"] * 20 + ["b"] * 20, np.ones(100))
    >>> round(found.lo, 2), found.hi, how
    (0.34, 1.0, 'wilson')
    """
    value = float(values.mean())
    if not len(draws) or value in {0.0, 1.0}:
        count = len(set(sites))
        return wilson(value * count, count), "wilson"
    return percentile_interval(value, draws), "blocks"
