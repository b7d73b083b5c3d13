# SPDX-License-Identifier: Apache-2.0
"""The tables behind the figures over many queries at once: pooled arms, ranks, errors, costs.

Each row is of queries that all matchers of its panel were asked; otherwise a matcher would gain by queries it was not
asked.
"""

from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Final, NamedTuple

import numpy as np
import pandas as pd

from sasgeo_bench.leaderboard.plot_tables import JudgedKey, calibrated_parts
from sasgeo_bench.running.prediction_files import StoredAnswers
from sasgeo_bench.scoring.base import Bools, Floats, codes_of
from sasgeo_bench.scoring.contrasts import Contrast, chosen_rows
from sasgeo_bench.scoring.decisions import COST_RATIOS, cost_values, decision_cost
from sasgeo_bench.scoring.draws import seed_of_text
from sasgeo_bench.scoring.intervals import BoardDraws, intervals_of_columns
from sasgeo_bench.scoring.metrics import primary_of, ranks_of
from sasgeo_bench.scoring.pose import Ranks, columns_of, hits, ranks_of_lists
from sasgeo_bench.scoring.rejection_rows import SLOW_DRAWS, answers_of
from sasgeo_bench.scoring.rows import ALL_SUITES
from sasgeo_bench.scoring.score import FIX_M, NOT_APPLICABLE, distances_m
from sasgeo_bench.scoring.strata import ALL, GROUP, STRESS, is_counted
from sasgeo_bench.tasks.query import Truth

Scores = Mapping[str, pd.DataFrame]

RANKS: Final = (1, 2, 3, 5, 10, 20, 50, 100, 200)
WITHIN_M: Final = "within_25m"  # the figure of the board that a curve of errors passes through
LEAST_ERROR_M: Final = 0.1
MOST_ERROR_M: Final = 2000.0
_RADII_M: Final = np.unique(np.concatenate((np.geomspace(LEAST_ERROR_M, MOST_ERROR_M, 87), [5.0, 10.0, FIX_M])))
_RATIOS: Final = np.unique(np.concatenate((np.geomspace(1.0, 200.0, 47), COST_RATIOS)))
_NO_INTERVAL: Final = (np.nan, np.nan)


class _Panel(NamedTuple):
    suite: str
    track: str
    prior_group: str
    stratum: str


class _Figure(NamedTuple):
    n: int
    blocks: int
    value: float
    lo: float
    hi: float


def _figures(rows: pd.DataFrame, table: Floats, text: str) -> list[_Figure]:
    """Return means of columns of values in [0, 1] with intervals as of a board; the same queries share draws."""
    names = (codes_of(rows[name]) for name in ("place", "block", "pair_id"))
    drawn = BoardDraws.of(*names, seed=seed_of_text(text), draws=SLOW_DRAWS)
    found = intervals_of_columns(table.mean(axis=0), drawn.means(table), drawn.trials)
    return [_Figure(len(rows), drawn.by_block.units_count, one.value, one.lo, one.hi) for one in found]


def _alike(frames: Mapping[str, pd.DataFrame]) -> dict[str, pd.DataFrame]:
    """Return the matchers that can answer and were asked the most queries of a pool, the same ones."""
    able = {name: frame for name, frame in frames.items() if _is_able(frame)}
    sorted_ = {name: frame.sort_values("query_id", ignore_index=True) for name, frame in able.items()}
    most = max(sorted_.values(), key=len, default=pd.DataFrame({"query_id": []}))["query_id"]
    return {name: frame for name, frame in sorted_.items() if frame["query_id"].equals(most)}


def _is_able(frame: pd.DataFrame) -> bool:
    """Return whether there is a query that the matcher's card does not exclude."""
    return bool((frame["status"] != NOT_APPLICABLE).any())


def _suites(scores: Scores, shown: Sequence[str]) -> Iterator[tuple[_Panel, dict[str, pd.DataFrame]]]:
    """Yield a panel and the rows of its matchers, for each suite, track and prior group."""
    mine = {name: scores[name] for name in shown if name in scores}
    keys = {key for frame in mine.values() for key in zip(*(frame[name] for name in GROUP), strict=True)}
    for key in sorted(keys):
        some = {}
        for name, frame in mine.items():
            is_mine = [frame[column].to_numpy() == value for column, value in zip(GROUP, key, strict=True)]
            rows = frame[np.logical_and.reduce(is_mine)]
            some[name] = rows[is_counted(rows)]
        alike = _alike(some)
        if alike:
            first = next(iter(alike.values()))
            part = STRESS if (first["role"] == STRESS).all() else ALL
            suite, track, prior_group = key
            yield _Panel(suite, track, prior_group, part), alike


# --- arms side by side ------------------------------------------------------------------------------------------------


def ablation_frame(scores: Scores, contrasts: Sequence[Contrast], shown: Sequence[str]) -> pd.DataFrame:
    """Return the primary metric, pooled over the suites of each registered contrast.

    A pool has the matchers that were asked all of it. Contrasts of means make a pool each, two over the same queries
    one; without any, all suites are one pool for each track. The columns are pool, suites, track, prior_group, matcher,
    n, blocks, value, lo and hi: present places under stress.
    """
    rows = []
    for pool in _pools(contrasts, scores):
        some = {name: chosen_rows(pool, scores[name]) for name in shown if name in scores}
        for group in sorted({group for frame in some.values() for group in frame["prior_group"]}):
            alike = _alike({name: frame[frame["prior_group"] == group] for name, frame in some.items()})
            suites = sorted({suite for frame in alike.values() for suite in frame["suite"]})
            for name, frame in alike.items():
                values = primary_of(pool.track).values(frame)[:, None]
                (found,) = _figures(frame, values, f"{pool.name}/{pool.track}/{group}")
                rows.append((pool.name, ", ".join(suites), pool.track, group, name, *found))
    return pd.DataFrame(rows, columns=["pool", "suites", "track", "prior_group", "matcher", *_Figure._fields])


def _pools(contrasts: Sequence[Contrast], scores: Scores) -> Iterator[Contrast]:
    """Yield a contrast for each pool of queries, under the names of all that share them."""
    means = [item for item in contrasts if item.metric == "primary"]
    names: dict[tuple[object, ...], list[Contrast]] = {}
    for item in means:
        names.setdefault((item.suites, item.kinds, item.detectors, item.track), []).append(item)
    for listed in names.values():
        first = listed[0]
        name = ", ".join(item.name for item in listed)
        yield replace(first, name=name, first="", second="")
    if not means:
        tracks = sorted({track for frame in scores.values() for track in frame["track"]})
        suites = tuple(sorted({suite for frame in scores.values() for suite in frame["suite"]}))
        for track in tracks:
            yield Contrast(name=ALL_SUITES, first="", second="", suites=suites, track=track)


# --- the right place within a list, or within metres ------------------------------------------------------------------


def recall_frame(
    scores: Scores,
    predictions: Mapping[str, StoredAnswers],
    truths: Mapping[str, Truth],
    shown: Sequence[str],
) -> pd.DataFrame:
    """Return recall@K: the share of answers with the right place among the first K.

    The columns are suite, track, prior_group, stratum, matcher, k, n, blocks, value, lo and hi; no row where no answer
    has a second pose. Right is the right candidate in retrieval, and in localization a pose within 25 m, whatever the
    heading.
    """
    rows: list[tuple[str | float, ...]] = []
    for panel, frames in _suites(scores, shown):
        lists = {name: _lists(frame, predictions[name], truths) for name, frame in frames.items()}
        longest = max(count for count, _ in lists.values())
        steps = [k for k in RANKS if k <= longest]
        if len(steps) < 2:  # a point is no curve
            continue
        text = "/".join((*panel, "recall"))
        for name, frame in frames.items():
            ranks = ranks_of(frame) if panel.track == "retrieval" else lists[name][1]
            table = np.column_stack([hits(ranks, k) for k in steps])
            found = _figures(frame, table, text)
            rows.extend((*panel, name, k, *one) for k, one in zip(steps, found, strict=True))
    return pd.DataFrame(rows, columns=[*_Panel._fields, "matcher", "k", *_Figure._fields])


def _lists(frame: pd.DataFrame, answers: StoredAnswers, truths: Mapping[str, Truth]) -> tuple[int, Ranks]:
    """Return the length of the longest list of poses, and the rank of the best pose near each truth.

    Headings do not count: stored results may lack them.
    """
    place = {name: at for at, name in enumerate(frame["query_id"])}
    longest, found = 0, np.zeros((3, len(frame)), dtype=np.int64)
    for columns in answers.columns(place):
        at = np.array([place.get(name, -1) for name in columns.query_id], dtype=np.int64)
        mine = at[columns.row] >= 0
        if not mine.any():
            continue
        poses = [truths[name].pose if name in place else None for name in columns.query_id]
        near = distances_m(columns.poses[:, :2], columns_of(poses)[columns.row, :2]) <= FIX_M
        is_right = mine & columns.is_ok[columns.row] & near
        ranks = ranks_of_lists(columns.row, columns.scores, is_right, len(at))
        found[:, at[at >= 0]] = np.array([ranks.above, ranks.tied, ranks.right])[:, at >= 0]
        longest = max(longest, int(np.bincount(columns.row[mine], minlength=1).max()))
    return longest, Ranks(above=found[0], tied=found[1], right=found[2])


def errors_frame(scores: Scores, table: pd.DataFrame, shown: Sequence[str]) -> pd.DataFrame:
    """Return the share of all queries whose fix is within some metres; localization alone.

    The columns are suite, track, prior_group, stratum, matcher, radius_m, n, blocks, value, lo and hi. The ends are
    those of the leaderboard `table` at 25 m, elsewhere NaN. A query without an answer is within no distance, and in the
    denominator.
    """
    rows = []
    within = table[(table["metric"] == WITHIN_M) & (table["rejector"] == "")]
    keys = zip(*(within[name] for name in (*GROUP, "stratum", "matcher")), strict=True)
    both = zip(within["lo"].to_numpy(float), within["hi"].to_numpy(float), strict=True)
    ends = dict(zip(keys, both, strict=True))
    for panel, frames in _suites(scores, shown):
        if panel.track == "retrieval":
            continue
        for name, frame in frames.items():
            errors_m = np.sort(frame["position_error_m"].fillna(np.inf).to_numpy(float))
            shares = np.searchsorted(errors_m, _RADII_M, side="right") / len(errors_m)
            blocks = int(frame["block"].nunique())
            end = ends.get((*panel, name), _NO_INTERVAL)
            for radius_m, value in zip(_RADII_M.tolist(), shares.tolist(), strict=True):
                lo, hi = end if radius_m == FIX_M else _NO_INTERVAL
                rows.append((*panel, name, radius_m, len(frame), blocks, value, lo, hi))
    return pd.DataFrame(rows, columns=[*_Panel._fields, "matcher", "radius_m", *_Figure._fields])


# --- what decisions and answers cost ----------------------------------------------------------------------------------


def cost_frame(
    judged: Mapping[tuple[str, str], pd.DataFrame], calibrated: Collection[tuple[str, str]], shown: Sequence[str]
) -> pd.DataFrame:
    """Return the mean cost of a query against the cost of a false fix, when fixes are accepted by Eq. (14).

    Arguments are as of `plot_tables.reliability_frame`. The columns are track, prior_group, matcher, rejector, n,
    ratio, cost, accept_all and withhold_all: all suites together. As `cost_20_place` of a board: a present place
    without an accepted fix costs 1, a false fix `ratio`.
    """
    rows = []
    for key, part in calibrated_parts(judged, calibrated, shown):
        some = answers_of(part)
        withhold = float(some.is_present.mean())
        for ratio in _RATIOS.tolist():
            cost = decision_cost(some, ratio, charged="place")
            all_accepted = float(cost_values(some, some.is_answered, ratio, charged="place").mean())
            rows.append((*key, len(some), ratio, cost, all_accepted, withhold))
    columns = [*JudgedKey._fields, "n", "ratio", "cost", "accept_all", "withhold_all"]
    return pd.DataFrame(rows, columns=columns)


COSTS: Final = {"latency_p50": "latency_s", "latency_p95": "slow_s", "map_per_km2": "map_kb_per_km2"}


def price_frame(table: pd.DataFrame, scores: Scores, shown: Sequence[str]) -> pd.DataFrame:
    """Return accuracy against cost: a row for each matcher that was asked the suites that most were asked.

    The columns are suites, track, prior_group, matcher, n, blocks, value, lo, hi, latency_s, slow_s (95th percentile)
    and map_kb_per_km2, from the leaderboard `table`; NaN where a cost is unknown. The queries are those that the
    first figure counts, of the suites of the track that all of these matchers were asked.
    """
    rows = []
    mine = {name: _counted(scores[name]) for name in shown if name in scores}
    groups = {key for one in mine.values() for key in zip(one["track"], one["prior_group"], strict=True)}
    for track, prior_group in sorted(groups):
        some = {
            name: frame[(frame["track"] == track) & (frame["prior_group"] == prior_group)]
            for name, frame in mine.items()
        }
        some = {name: frame for name, frame in some.items() if _is_able(frame)}
        some, shared = _of_most(some)
        suites = ", ".join(sorted(shared))
        for name, frame in _alike({name: one[one["suite"].isin(shared)] for name, one in some.items()}).items():
            values = primary_of(track).values(frame)[:, None]
            (found,) = _figures(frame, values, f"{suites}/{track}/{prior_group}")
            rows.append((suites, track, prior_group, name, *found, *_costs_of(table, name, track)))
    columns = ["suites", "track", "prior_group", "matcher", *_Figure._fields, *COSTS.values()]
    return pd.DataFrame(rows, columns=columns)


def _counted(frame: pd.DataFrame) -> pd.DataFrame:
    """Return the rows that the first figure of each suite counts, of places that are on the map."""
    parts = [part[is_counted(part)] for _, part in frame.groupby(["suite", "track"], sort=False)]
    return pd.concat(parts, ignore_index=True) if parts else frame


def _of_most(frames: Scores) -> tuple[dict[str, pd.DataFrame], set[str]]:
    """Return the matchers of the suite that most were asked, the first of several, and all suites that they share."""
    suites = {name: set(frame["suite"]) for name, frame in frames.items()}
    every = sorted(set().union(*suites.values()))
    most = max(every, key=lambda suite: sum(suite in own for own in suites.values()), default="")
    chosen = {name: frame for name, frame in frames.items() if most in suites[name]}
    return chosen, set.intersection(*(suites[name] for name in chosen)) if chosen else set()


def _costs_of(table: pd.DataFrame, matcher: str, track: str) -> list[float]:
    """Return the `COSTS` of one matcher from the leaderboard."""
    costs = table[(table["matcher"] == matcher) & table["track"].isin([track, "all"]) & (table["suite"] == ALL_SUITES)]
    known = dict(zip(costs["metric"], costs["value"], strict=True))
    return [float(known.get(metric, np.nan)) for metric in COSTS]


def front_of(cost: Floats, value: Floats) -> Bools:
    """Return the Pareto front, shape (N,): methods that no other one beats in cost and accuracy.

    A cost that is NaN or infinite is on no front.

    >>> front_of(np.array([1.0, 2.0, 3.0, np.nan]), np.array([0.5, 0.4, 0.9, 1.0])).tolist()
    [True, False, True, False]
    """
    known = np.isfinite(cost)
    cheaper, better = cost[None, :] <= cost[:, None], value[None, :] >= value[:, None]
    strictly = (cost[None, :] < cost[:, None]) | (value[None, :] > value[:, None])
    return np.asarray(known & ~(known[None, :] & cheaper & better & strictly).any(axis=1))
