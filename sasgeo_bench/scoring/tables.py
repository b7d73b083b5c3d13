# SPDX-License-Identifier: Apache-2.0
"""The leaderboard from scored rows: metrics with intervals, denominators and ranks."""

import math
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, Final, Self, get_args

import numpy as np
import pandas as pd
from numpy.typing import ArrayLike

from sasgeo_bench.core import progress
from sasgeo_bench.core.errors import MetricError
from sasgeo_bench.regions.region_spec import Scene
from sasgeo_bench.scoring.base import Bools, Floats, Ints, codes_of, weighted_quantile
from sasgeo_bench.scoring.compare import LEAST_PLACES, RankInterval, distinguishable, rank_intervals, sensitivity
from sasgeo_bench.scoring.cost import Costs
from sasgeo_bench.scoring.intervals import (
    DRAWS,
    BoardDraws,
    BoardInterval,
    amount_interval,
    distinct_columns,
    percentile_ends,
    seed_of_text,
    widest_intervals,
    wilson_ends,
)
from sasgeo_bench.scoring.metric import MeanMetric, QuantileMetric
from sasgeo_bench.scoring.metrics import COSTS, means_of, primary_of, quantiles_of
from sasgeo_bench.scoring.rows import ALL_SUITES, FIGURE_SCHEMA, GroupKey, Row, RowKey, bare, in_threads, is_unranked
from sasgeo_bench.scoring.score import MISSING, NOT_APPLICABLE
from sasgeo_bench.scoring.strata import ALL, CONTROL, GROUP, STRESS, is_counted, primary_rows, step_name, strata
from sasgeo_bench.tasks.query import BY

INTERVALS: Final = "intervals of suites"  # what progress is shown of
Parts = Callable[[pd.DataFrame], Iterator[tuple[str, Bools]]]  # queries of a suite -> names and masks of its strata
_WHOLE: Final = frozenset({ALL, STRESS, CONTROL})  # strata that also get quantiles of errors


def leaderboard(
    scored: Mapping[str, pd.DataFrame],
    *,
    draws: int = DRAWS,
    excluded: Collection[str] = (),
    done: Callable[[], None] = lambda: None,
    parts: Parts = strata,
    more: Sequence[MeanMetric] = (),
) -> pd.DataFrame:
    """Return the metrics of every matcher on every suite, track, prior group and stratum, with the columns of `Row`.

    `scored` holds rows of `score.score_task` by matcher, all for the same queries. Matchers in `excluded` have no rank
    and are no rivals; controls never are. `done` is called after each suite, track and prior group. `parts` yields the
    strata of the queries of one of these; `more` are metrics beside those of every board. Raise MetricError if two
    matchers were scored on different queries.
    """
    if not scored:
        return FIGURE_SCHEMA.empty()
    first = next(iter(scored))
    orders = {name: np.argsort(frame["query_id"].to_numpy(object), kind="stable") for name, frame in scored.items()}
    queries = scored[first][["query_id", *GROUP]].iloc[orders[first]]
    for name, frame in scored.items():
        if not np.array_equal(frame["query_id"].to_numpy(object)[orders[name]], queries["query_id"].to_numpy(object)):
            raise MetricError(f"{name} was scored on other queries than {first}: score them together")
    unranked = frozenset({*excluded, *filter(is_unranked, scored)})
    places: Mapping[Any, Any] = queries.groupby(list(GROUP), sort=True).indices

    def rows_of(key: tuple[str, str, str]) -> Iterator[Row]:
        """Yield the rows of one group, whose queries alone are sorted and copied."""
        frames = {name: frame.iloc[orders[name][places[key]]] for name, frame in scored.items()}
        return _rows_of_group(GroupKey(*key), frames, draws, unranked, parts, more)

    return FIGURE_SCHEMA.frame(in_threads(rows_of, sorted(places), done))


def leaderboards(
    scored: Mapping[str, pd.DataFrame], *, draws: int, excluded: Collection[str], more: Sequence[MeanMetric] = ()
) -> list[pd.DataFrame]:
    """Return the `leaderboard` of each set of suites that the same matchers were asked: in most cases one.

    Arguments as of `leaderboard`, but matchers may lack suites.
    """
    keys = {key for frame in scored.values() for key in frame[[*GROUP]].itertuples(index=False)}
    progress.begin(INTERVALS, len(keys))
    return [
        leaderboard(some, draws=draws, excluded=excluded, done=lambda: progress.advance(INTERVALS, 1), more=more)
        for some in asked_alike(scored)
    ]


def asked_alike(scored: Mapping[str, pd.DataFrame]) -> Iterator[dict[str, pd.DataFrame]]:
    """Yield the rows of each set of suites that the same matchers were asked, by matcher."""
    suites_of = {name: set(frame["suite"]) for name, frame in scored.items()}
    asked_by: dict[tuple[str, ...], list[str]] = {}
    for suite in sorted({suite for suites in suites_of.values() for suite in suites}):
        asked_by.setdefault(tuple(name for name in scored if suite in suites_of[name]), []).append(suite)
    for names, suites in asked_by.items():
        yield {
            name: scored[name] if suites_of[name] == set(suites) else scored[name][scored[name]["suite"].isin(suites)]
            for name in names
        }


@dataclass(frozen=True, kw_only=True)
class _Group:
    """Queries of one suite, track and prior group as columns: shape (N,), or (N, M) for M matchers.

    It caches what all strata share: values of metrics by name, errors by column, and codes of blocks, places and sites
    in the order of their names.
    """

    key: GroupKey
    names: tuple[str, ...]
    rivals: tuple[str, ...]  # the ranked ones
    first: pd.DataFrame  # rows of any matcher: query columns are the same for all
    blocks: Ints
    places: Ints
    sites: Ints
    is_answered: Bools
    is_missing: Bools
    measured: dict[str, Floats]
    errors: dict[str, Floats]

    @classmethod
    def of(
        cls,
        key: GroupKey,
        frames: Mapping[str, pd.DataFrame],
        unranked: Collection[str],
        metrics: Sequence[MeanMetric],
    ) -> Self:
        """Return the columns of some matchers' rows; `unranked` matchers are no rivals."""
        first = next(iter(frames.values()))
        columns = dict.fromkeys(quantile.column for quantile in quantiles_of(key.track))
        codes = [codes_of(first[name]) for name in ("block", "place", "pair_id")]

        def stacked(column: Callable[[pd.DataFrame], ArrayLike]) -> Any:  # noqa: ANN401 - of bools or floats
            """Return a column of each matcher, side by side."""
            return np.column_stack([np.asarray(column(frame)) for frame in frames.values()])

        return cls(
            key=key,
            names=tuple(frames),
            rivals=tuple(name for name in frames if name not in unranked),
            first=first,
            blocks=codes[0],
            places=codes[1],
            sites=codes[2],
            is_answered=stacked(lambda frame: frame["is_answered"].to_numpy(bool)),
            is_missing=stacked(lambda frame: (frame["status"] == MISSING).to_numpy(bool)),
            measured={metric.name: stacked(metric.values) for metric in metrics},
            errors={name: stacked(partial(_floats, name=name)) for name in columns},
        )


def _floats(frame: pd.DataFrame, name: str) -> Floats:
    return np.asarray(frame[name].to_numpy(float))


@dataclass(frozen=True, kw_only=True)
class _Cell:
    """Queries of a group: `chosen` are their positions in it."""

    group: _Group
    stratum: str
    chosen: Ints
    draws: int

    @property
    def seed(self) -> int:
        """Return the seed, a function of the queries alone, so that all matchers share draws."""
        return seed_of_text("/".join((*self.group.key, self.stratum)))

    def keys(self) -> list[RowKey]:
        """Return the row key of each matcher."""
        blocks, places = (len(np.unique(codes[self.chosen])) for codes in (self.group.blocks, self.group.places))
        return [
            RowKey(
                **self.group.key._asdict(),
                matcher=name,
                stratum=self.stratum,
                n=len(self.chosen),
                answered=int(self.group.is_answered[self.chosen, at].sum()),
                missing=int(self.group.is_missing[self.chosen, at].sum()),
                blocks=blocks,
                places=places,
            )
            for at, name in enumerate(self.group.names)
        ]


def _rows_of_group(
    key: GroupKey,
    frames: dict[str, pd.DataFrame],
    draws: int,
    unranked: Collection[str],
    parts: Parts,
    more: Sequence[MeanMetric],
) -> Iterator[Row]:
    able = {name: frame for name, frame in frames.items() if not (frame["status"] == NOT_APPLICABLE).all()}
    for name, frame in frames.items():
        if name not in able:
            row_key = RowKey.of(frame, key, matcher=name, stratum=ALL)
            yield row_key.row(primary_of(key.track), bare(math.nan), is_applicable=False)
    if not able:
        return
    ours, others = means_of(key.track), [metric for metric in more if key.track in metric.tracks]
    group = _Group.of(key, able, unranked, (*ours, *others))
    counted = {metric.name: metric.counts(group.first) for metric in (*ours, *others)}
    for stratum, inside in parts(group.first):
        # Those of other packages by themselves: not a digit of ours may depend on them
        for asked in (ours, others):
            by_count: dict[bytes, list[MeanMetric]] = {}
            for metric in asked:
                mask = inside & counted[metric.name]
                if mask.any():
                    by_count.setdefault(mask.tobytes(), []).append(metric)
            for key_of_mask, metrics in by_count.items():
                chosen = np.flatnonzero(np.frombuffer(key_of_mask, dtype=bool))
                yield from _mean_rows(_Cell(group=group, stratum=stratum, chosen=chosen, draws=draws), metrics)


def _mean_rows(cell: _Cell, metrics: Sequence[MeanMetric]) -> Iterator[Row]:
    """Yield rows of means that share a denominator and draws."""
    group, count = cell.group, len(cell.group.names)
    keys, chosen = cell.keys(), cell.chosen
    below = list(_thresholds(cell, metrics))
    columns = [group.measured[metric.name][chosen] for metric in metrics]
    table = np.column_stack((*columns, *(item.is_below for item in below)))
    names = (group.places[chosen], group.blocks[chosen], group.sites[chosen])
    drawn = BoardDraws.of(*names, seed=cell.seed, draws=cell.draws)
    means_of_all = [column.mean() for column in table.T[: len(metrics) * count]]
    figures = np.array(means_of_all + [item.quantile.share for item in below])
    distinct, code = distinct_columns(table)
    by_place, by_block = drawn.means(distinct)
    means = _Means(
        figures=figures,
        table=table,
        drawn=(by_place, by_block),
        ends=(np.transpose(percentile_ends(by_place)), np.transpose(percentile_ends(by_block))),
        code=code,
        exact=wilson_ends(figures, drawn.trials),
        clusters=drawn.by_block.units_count,
    )
    for number, metric in enumerate(metrics):
        yield from _ranked(cell, keys, metric, means.some(slice(number * count, (number + 1) * count)))
    shares = means.some(slice(len(metrics) * count, None)).intervals()
    for item, found in zip(below, shares, strict=True):
        errors = group.errors[item.quantile.column][chosen, item.matcher]
        yield keys[item.matcher].row(item.quantile, found.mapped(partial(_inverse, errors), item.value))


@dataclass(frozen=True, kw_only=True)
class _Means:
    """Columns of values, shape (N, M), with the means that rows state, shape (M,), and the ends of Wilson's intervals.

    `drawn` are the means of K distinct columns in draws by places and by blocks, shape (D, K), and `ends` their
    percentiles, shape (K, 2); `code` is the distinct column that each column is.
    """

    figures: Floats
    table: Floats
    drawn: tuple[Floats, Floats]
    ends: tuple[Floats, Floats]
    code: Ints
    exact: Floats
    clusters: int

    def some(self, columns: slice) -> Self:
        """Return some columns."""
        return replace(
            self,
            figures=self.figures[columns],
            table=self.table[:, columns],
            code=self.code[columns],
            exact=self.exact[columns],
        )

    def intervals(self, *, is_share: bool = True) -> list[BoardInterval]:
        """Return the intervals of the means of all columns; values of a share lie in [0, 1]."""
        if is_share:
            by_place, by_block = (ends[self.code] for ends in self.ends)
            return widest_intervals(self.figures, (by_place, by_block), self.exact)
        both = zip(*(means.T[self.code] for means in self.drawn), strict=True)
        pairs = zip(self.figures.tolist(), both, strict=True)
        return [amount_interval(figure, one, self.clusters) for figure, one in pairs]


@dataclass(frozen=True, kw_only=True)
class _Below:
    """A quantile of the errors of one matcher (its index), and which errors lie below it.

    Errors equal to it count in proportion, so that the mean is the quantile's share even where many are infinite.
    """

    matcher: int
    quantile: QuantileMetric
    value: float
    is_below: Floats


def _thresholds(cell: _Cell, metrics: Sequence[MeanMetric]) -> Iterator[_Below]:
    """Yield quantiles of errors; their intervals invert those of the share below them (Woodruff 1952)."""
    if cell.stratum not in _WHOLE or not any(metric.is_primary for metric in metrics):
        return
    for at in range(len(cell.group.names)):
        for quantile in quantiles_of(cell.group.key.track):
            errors = cell.group.errors[quantile.column][cell.chosen, at]
            value = weighted_quantile(errors, quantile.share)
            is_below, is_equal = errors < value, errors == value
            part = np.clip((quantile.share - is_below.mean()) / is_equal.mean(), 0.0, 1.0)
            yield _Below(matcher=at, quantile=quantile, value=value, is_below=is_below + part * is_equal)


def _inverse(errors: Floats, share: float) -> float:
    """Return the least error that a share of the queries does not exceed; 0 and infinity beyond the range of shares."""
    if math.isnan(share):
        return math.nan
    return weighted_quantile(errors, min(share, 1.0)) if share > 0 else 0.0


def _ranked(cell: _Cell, keys: Sequence[RowKey], metric: MeanMetric, means: _Means) -> Iterator[Row]:
    """Yield the rows of one metric, with ranks for the primary one."""
    names, places, table = cell.group.names, cell.group.places[cell.chosen], means.table
    is_share = metric.bounds == (0.0, 1.0)
    found = means.intervals(is_share=is_share)
    is_decidable = metric.is_primary and keys[0].places >= LEAST_PLACES
    ranks = _ranks(cell.group, means.figures.tolist(), means.drawn[0][:, means.code], metric) if is_decidable else {}
    for at, name in enumerate(names):
        rank = ranks.get(name)
        detectable = _detectable(name, cell.group, table, places) if is_decidable else math.nan
        yield keys[at].row(
            metric,
            found[at],
            rank_best=None if rank is None else rank.best,
            rank_worst=None if rank is None else rank.worst,
            detectable=detectable,
        )


def _ranks(group: _Group, values: Sequence[float], means: Floats, metric: MeanMetric) -> dict[str, RankInterval]:
    """Return the rank intervals of all rivals."""
    chosen = [group.names.index(name) for name in group.rivals]
    if not chosen:
        return {}
    better = distinguishable([values[at] for at in chosen], means[:, chosen], better=metric.better)
    return {group.names[at]: rank for at, rank in zip(chosen, rank_intervals(better), strict=True)}


def _detectable(name: str, group: _Group, table: Floats, places: Ints) -> float:
    """Return the detectable difference from the best other rival."""
    others = [group.names.index(other) for other in group.rivals if other != name]
    if not others or name not in group.rivals:
        return math.nan
    best = max(others, key=lambda at: float(table[:, at].mean()))
    return sensitivity(table[:, group.names.index(name)], table[:, best], places)


def cost_figures(matcher: str, costs: Costs) -> pd.DataFrame:
    """Return every cost metric of one matcher, of each track or of all tracks together, with the columns of `Row`."""
    rows = []
    by_track = {str(track): part for track, part in costs.scores.groupby("track", sort=True)}
    for track, part in [*by_track.items(), ("all", costs.scores)]:
        mine = replace(costs, scores=part)
        key = RowKey.of(part, GroupKey(ALL_SUITES, track, "all"), matcher=matcher, stratum="all")
        rows += [key.row(one, bare(one.compute(mine))) for one in COSTS if one.is_by_track == (track != "all")]
    return FIGURE_SCHEMA.frame(rows)


SCENES: Final[tuple[str, ...]] = get_args(Scene)


@dataclass(frozen=True, slots=True, kw_only=True)
class Use:
    """A suite as a user meets it: in words, and at which strength alone; None for all."""

    words: str
    strength: float | None = None


# Suites whose maps are searched as a user would: nothing is copied, bent, hidden or taken away for the test. The ladder
# of `clean` goes from half to four times the errors that were measured, of which a user meets the measured ones.
AS_USED: Final[Mapping[str, Use]] = {
    "clean": Use(words="a map of the day", strength=1.0),
    "real-age": Use(words="a map 2 to 10 years old"),
    "aerial": Use(words="a picture and a map of the day"),
    "real-image": Use(words="a real picture"),
    "flight-clean": Use(words="a flight and a map of the day"),
    "flight-real-age": Use(words="a flight and a map 2 to 10 years old"),
}
_RETRIEVAL: Final = "retrieval"  # a user has no candidates of which one is right


def scene_frame(scores: Mapping[str, pd.DataFrame], *, draws: int, excluded: Collection[str] = ()) -> pd.DataFrame:
    """Return the primary metric of the ranked matchers by kind of place, with the columns of `rows.Row`.

    `scores` are scored rows by matcher. The column `stratum` is the kind, or "all" for all of them together: there the
    figure and its interval are those of the board. A place with several kinds counts in each. Only suites of `AS_USED`
    count, neither of candidates nor with a segmenter that knows the truth. Matchers in `excluded`, and controls, have
    no row.
    """
    ranked = {name: rows for name, rows in scores.items() if not is_unranked(name) and name not in excluded}
    some = {name: rows[is_as_used(rows)] for name, rows in ranked.items()}
    found = [leaderboard(alike, draws=draws, parts=scene_parts) for alike in asked_alike(some)]
    rows = primary_rows(pd.concat(found, ignore_index=True)) if found else FIGURE_SCHEMA.empty()
    return rows.assign(stratum=rows["stratum"].where(rows["stratum"].isin(SCENES), ALL)).reset_index(drop=True)


def is_as_used(scores: pd.DataFrame) -> Bools:
    """Return a mask of the scored rows of suites that are searched as a user would, shape (N,).

    >>> suites = ["real-age", "alias", "aerial+pixel_forest", "aerial+oracle_segmenter"]
    >>> is_as_used(pd.DataFrame({"suite": suites, "track": "localization"})).tolist()
    [True, False, True, False]
    """
    suites = scores["suite"].str.partition(BY)
    is_used = suites[0].isin(AS_USED) & ~suites[2].map(is_unranked).astype(bool)
    return np.asarray(is_used & (scores["track"] != _RETRIEVAL), dtype=bool)


def scene_parts(queries: pd.DataFrame) -> Iterator[tuple[str, Bools]]:
    """Yield names and masks, shape (N,), of the queries of one suite that count, and of those of each kind of place.

    The first has the name of that stratum on a board, so that both share their draws.

    >>> table = {"suite": "real-age", "role": ["stress", "stress", "control"], "is_present": True, "kind": "S1"}
    >>> table |= {"strength": [5.0, 2.0, 0.0], "view_cells": 192, "scene": ["alpine", "coastal,urban", "alpine"]}
    >>> [(name, mask.tolist()) for name, mask in scene_parts(pd.DataFrame(table))][:2]
    [('stress', [True, True, False]), ('urban', [False, True, False])]
    """
    counts = is_counted(queries)
    strength = AS_USED[str(queries["suite"].iloc[0]).partition(BY)[0]].strength
    name = STRESS if (queries.loc[counts, "role"] == STRESS).any() else ALL
    if strength is not None:
        counts = counts & (queries["strength"] == strength).to_numpy(bool)
        steps = queries.loc[counts, ["kind", "view_cells"]].drop_duplicates()
        name = "; ".join(step_name(str(kind), strength, int(cells)) for kind, cells in steps.to_numpy())
    tags = queries["scene"].str.split(",")
    yield name, counts
    for scene in SCENES:
        inside = counts & tags.map(lambda own, scene=scene: scene in own).to_numpy(bool)
        if inside.any():
            yield scene, inside
