# SPDX-License-Identifier: Apache-2.0
"""The figures of a board over many queries at once: each draws a table on a page.

Each function writes a .svg or .png; `shown` are the matchers in the order of their looks.
"""

import math
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import replace
from itertools import cycle
from pathlib import Path
from typing import Final, NamedTuple

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from sasgeo_bench.boards.plots import (
    FAINT,
    INTERVALS,
    PRIMARY,
    BoardPage,
    JudgedKey,
    calibrated_parts,
    dodged,
    draw_bar_panels,
    draw_line,
    dress_share,
    each_panel,
    line_keys,
    look_of,
    panel_title,
    panels_across,
    those_there,
    ticks_across,
)
from sasgeo_bench.boards.tables import prior_words
from sasgeo_bench.core.canvas import broken, figure_of, page, panels, paper_inches
from sasgeo_bench.core.errors import counted
from sasgeo_bench.running.prediction_files import StoredAnswers
from sasgeo_bench.scoring.base import Bools, Floats, codes_of
from sasgeo_bench.scoring.contrasts import Contrast, chosen_rows
from sasgeo_bench.scoring.decisions import COST_RATIOS, cost_values, decision_cost
from sasgeo_bench.scoring.intervals import BoardDraws, intervals_of_columns, seed_of_text
from sasgeo_bench.scoring.metrics import primary_of, ranks_of
from sasgeo_bench.scoring.pose import Ranks, columns_of, hits, ranks_of_lists
from sasgeo_bench.scoring.rejection_rows import SLOW_DRAWS, answers_of
from sasgeo_bench.scoring.rows import ALL_SUITES, is_unranked
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
_NAMES_OF_PAPER, _PAPER_POINTS = 0.42, 7.0  # share of a column that names may take, and their size


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

    Arguments are as of `plots.reliability_frame`. The columns are track, prior_group, matcher, rejector, n,
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
    mine = {}
    for name in (name for name in shown if name in scores):
        parts = [part[is_counted(part)] for _, part in scores[name].groupby(["suite", "track"], sort=False)]
        mine[name] = pd.concat(parts, ignore_index=True) if parts else scores[name]
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


_CONTROL: Final = "#888888"
_CONTROL_MARKS: Final = ("x", "+", "1", "2", "3", "4")
_STRESS: Final = "Present places under stress; of a suite without stresses all of them."
_MOST_ASKED: Final = (
    "A panel has the matchers that were asked all of its queries; no answer is a miss, and in the denominator."
)


def draw_ablation(path: Path, rows: pd.DataFrame, shown: Sequence[str]) -> None:
    """Draw success pooled over the suites of each contrast, from `ablation_frame`, as bars with intervals."""
    first, pools = rows.iloc[0], list(dict.fromkeys(rows["pool"]))
    suites = "; ".join(f"{pool}: {rows.loc[rows['pool'] == pool, 'suites'].iloc[0]}" for pool in pools)
    title = f"Arms side by side: {first['track']}, {prior_words(str(first['prior_group']))}"
    note = (
        f"Pools of the registered contrasts, all queries of a pool weighing the same. {suites}. "
        f"{INTERVALS.replace('each point', 'each bar')} {_MOST_ASKED}"
    )
    draw_bar_panels(path, rows, shown, "pool", pools, title=title, note=note)


def _suite_panels(
    path: Path, rows: pd.DataFrame, names: Sequence[str], label: str, *, title: str, note: str, below: str
) -> Iterator[tuple[Axes, pd.DataFrame]]:
    """Yield the panel and rows of each suite on a page of shares, with a line for each matcher."""
    first = rows.iloc[0]
    about = BoardPage(
        title=f"{title}: {first['track']}, {prior_words(str(first['prior_group']))}",
        note=f"{note} {_STRESS} {_MOST_ASKED}",
        below=below,
        keys=line_keys(names),
    )
    for chart, suite in each_panel(path, sorted(set(rows["suite"])), about, label):
        mine = rows[rows["suite"] == suite]
        part = mine["stratum"].iloc[0]
        panel_title(chart, suite + ("" if part == "all" else f" {part}"), mine.iloc[0])
        dress_share(chart)
        chart.set_ylim(-0.02, 1.04)
        yield chart, mine


def draw_recall(path: Path, rows: pd.DataFrame, shown: Sequence[str]) -> None:
    """Draw Recall@K against K from `recall_frame`: a panel for each suite, a line for each matcher."""
    names, steps = those_there(rows, shown), sorted(set(rows["k"]))
    is_retrieval = rows["track"].iloc[0] == "retrieval"
    what = "the right candidate" if is_retrieval else f"a pose within {FIX_M:g} m, whatever the heading,"
    note = f"Share of queries with {what} among the first K of the answer; ties count in every order. {INTERVALS}"
    below, label = "K (poses of an answer, best first)", "recall@K (share of queries)"
    for chart, mine in _suite_panels(path, rows, names, label, title="Recall against K", note=note, below=below):
        ticks_across(chart, steps, 0.75, 1.35 * steps[-1])
        for at, name in enumerate(names):
            line_of = mine[mine["matcher"] == name].sort_values("k")
            draw_line(chart, line_of, dodged(line_of["k"].to_numpy(float), at, len(names), by=0.025), at)


def draw_errors(path: Path, rows: pd.DataFrame, shown: Sequence[str]) -> None:
    """Draw the distribution of errors from `errors_frame`: a panel for each suite, a line for each matcher."""
    names = those_there(rows, shown)
    note = (
        f"Share of all n queries whose fix is that near, whatever the heading; an answer that is none is never near. "
        f"Dashed: {FIX_M:g} m, beyond which a fix is false; bars there: 95 % intervals as on the board (within_25m)."
    )
    title, below, label = "Distribution of errors", "position error (m)", "share of queries\nwithin that error"
    for chart, mine in _suite_panels(path, rows, names, label, title=title, note=note, below=below):
        ticks_across(chart, [0.1, 1.0, 10.0, 100.0, 1000.0], LEAST_ERROR_M, MOST_ERROR_M)
        chart.axvline(FIX_M, color="#999999", lw=0.8, ls="--")
        for at, name in enumerate(names):
            _error_line(chart, mine[mine["matcher"] == name], at, len(names))


def _error_line(chart: Axes, mine: pd.DataFrame, number: int, count: int) -> None:
    look = look_of(number)
    chart.plot(mine["radius_m"], mine["value"], color=look.colour, ls=look.dash, lw=1.3)
    known = mine[mine["lo"].notna()]
    if len(known):
        at = dodged(known["radius_m"].to_numpy(float), number, count, by=0.12)
        chart.vlines(at, known["lo"], known["hi"], color=look.colour, lw=0.9, alpha=0.75)
        chart.plot(at, known["value"], color=look.colour, marker=look.mark, ms=4, ls="")


def draw_costs(path: Path, rows: pd.DataFrame, shown: Sequence[str]) -> None:
    """Draw the cost of a query against that of a false fix, from `cost_frame`: a panel for each matcher."""
    names, rejectors = those_there(rows, shown), sorted(set(rows["rejector"]))
    first = rows.iloc[0]
    about = BoardPage(
        title=f"Cost of a query: {ALL_SUITES}, {first['track']}, {prior_words(str(first['prior_group']))}",
        note=(
            "A fix is accepted where the rejector says that its chance to be false is below 1 / (1 + C) (Eq. 14). A "
            "false fix costs C, a present place without an accepted fix 1, all else nothing: cost_5_place, "
            "cost_20_place and cost_100_place of the board, and all ratios between. Grey: dashed, all is withheld; "
            "dotted, all answers are accepted. A rejector that helps lies below both. n: queries, absent places among "
            "them."
        ),
        below="C: cost of a false fix (places without a fix)",
        keys=line_keys(rejectors, has_marks=False),
    )
    high = 1.25 * max(float(rows["withhold_all"].max()), float(rows["cost"].quantile(0.9)))
    for chart, name in each_panel(path, names, about, "mean cost of a query\n(places without a fix)"):
        mine = rows[rows["matcher"] == name]
        counts = ", ".join(f"{count:g}" for count in sorted(set(mine["n"])))
        chart.set_title(f"{name}\nn {counts}")
        _cost_lines(chart, mine, rejectors)
        ticks_across(chart, [1.0, *COST_RATIOS], float(mine["ratio"].min()), float(mine["ratio"].max()))
        chart.set_ylim(0.0, high)
        chart.grid(visible=True, color=FAINT, lw=0.6)


def _cost_lines(chart: Axes, mine: pd.DataFrame, rejectors: Sequence[str]) -> None:
    base = mine[mine["rejector"] == mine["rejector"].iloc[0]]
    for column, dash in (("withhold_all", "--"), ("accept_all", ":")):
        chart.plot(base["ratio"], base[column], color="#999999", lw=1.0, ls=dash)
    for number, name in enumerate(rejectors):
        points = mine[mine["rejector"] == name]
        look = look_of(number)
        chart.plot(points["ratio"], points["cost"], color=look.colour, ls=look.dash, lw=1.3)


def draw_prices(path: Path, rows: pd.DataFrame, shown: Sequence[str]) -> None:
    """Draw accuracy against cost from `price_frame`, with the front that no other matcher beats.

    Those of `shown` have a look each; of the others, who are grey, those on the front have their name beside them.
    """
    names = those_there(rows, shown)
    first, others = rows.iloc[0], len(rows) - len(names)
    grey = f" Grey points: {counted(others, 'more matcher')}, named where on the front." if others else ""
    axes = [(name, label) for name, label in _PRICES.items() if np.isfinite(rows[name].to_numpy(float)).any()]
    about = BoardPage(
        title=f"Success against cost: {first['track']}, {prior_words(str(first['prior_group']))}",
        note=(
            f"Suites {first['suites']}: those that all of these matchers were asked; n {first['n']:g} queries, "
            f"{counted(int(first['blocks']), 'block')}. Upright bars: 95 % intervals; level bars: from the median "
            "latency to the 95th percentile, all suites of the track. Grey line: the front, where no other matcher is "
            "both cheaper and "
            f"better.{grey}{_left_out(rows)}"
        ),
        below="",
        columns=len(axes),
        keys=line_keys(names),
        panel_inches=(3.0, 2.5),
    )
    with page(path, about) as charts:
        for chart, (column, label) in zip(charts[0], axes, strict=True):
            chart.set_title(f"n {first['n']:g}")
            _prices(chart, rows, names, column)
            chart.set_xlabel(label, fontsize=8.5)
            dress_share(chart)
            chart.set_ylim(-0.03, 1.04)
            chart.grid(visible=True, color=FAINT, lw=0.6)
            chart.tick_params(labelleft=chart is charts[0][0])
        charts[0][0].set_ylabel(PRIMARY[primary_of(str(first["track"])).name])


_PRICES: Final = {
    "latency_s": "latency of an answer (s), median to 95th percentile",
    "map_kb_per_km2": "map and index (kB for each km2)",
}


def _left_out(rows: pd.DataFrame) -> str:
    """Return the matchers without a point, because the cost of their answers is unknown."""
    lacking = [
        f"{label.partition(' ')[0]} of {', '.join(rows.loc[~np.isfinite(rows[name].to_numpy(float)), 'matcher'])}"
        for name, label in _PRICES.items()
        if not np.isfinite(rows[name].to_numpy(float)).all()
    ]
    return f" Not known or without bounds: {'; '.join(lacking)}." if lacking else ""


def draw_tradeoff(path: Path | None, rows: pd.DataFrame, shown: Sequence[str], *, is_short: bool = False) -> Figure:
    """Draw success against the median latency from `price_frame`: a panel for each prior group, controls in grey.

    Those of `shown` have a look each, the others are grey points. A figure that `is_short` is as wide as a telephone,
    and leaves the note and the controls to the page around it. Return the figure, written where there is a path.
    """
    rows = rows[np.isfinite(rows["latency_s"].to_numpy(float))]
    is_free = rows["matcher"].map(is_unranked).to_numpy(bool)
    names, groups = those_there(rows[~is_free], shown), sorted(set(rows["prior_group"]))
    controls = [] if is_short else _control_keys(sorted(set(rows.loc[is_free, "matcher"])))
    down, across = panels_across(len(groups))
    about = BoardPage(
        title="" if is_short else f"Success against latency: {rows['suites'].iloc[0]}, {rows['track'].iloc[0]}",
        note=""
        if is_short
        else (
            "The queries that the first figure of the suite counts. Upright bars: 95 % intervals; level "
            "bars: from the median latency to the 95th percentile, all suites of the track, as measured where each "
            "matcher ran. Grey line: the front, where no other matcher is both faster and better. Controls "
            "do not compete."
        ),
        below="latency of an answer (s)" if is_short else "latency of an answer (s), median to 95th percentile",
        rows=down,
        columns=across,
        keys=[*(_marks(names) if is_short else line_keys(names)), *controls],
        panel_inches=(3.0, 1.1) if is_short else (3.4, 2.6),
        is_narrow=is_short,
    )
    with page(path, about) as charts:
        for number, chart in panels(charts, len(groups)):
            is_here = (rows["prior_group"] == groups[number]).to_numpy(bool)
            mine, free = rows[is_here & ~is_free], rows[is_here & is_free]
            if not is_short:
                panel_title(chart, prior_words(groups[number]), rows[is_here].iloc[0])
            if len(mine):
                _prices(chart, mine, [name for name in names if (mine["matcher"] == name).any()], "latency_s")
            _controls(chart, free, controls)
            _cost_axis(chart, rows.loc[is_here, ["latency_s", "slow_s"]].to_numpy(float))
            dress_share(chart)
            chart.grid(visible=True, color=FAINT, lw=0.6)
            chart.tick_params(labelleft=number % across == 0)
        what = PRIMARY[primary_of(str(rows["track"].iloc[0])).name]
        charts[0][0].set_ylabel(what.partition(" (")[0] if is_short else what)
    return figure_of(charts[0][0])


def _marks(names: Sequence[str]) -> list[Line2D]:
    """Return a legend of points."""
    looks = map(look_of, range(len(names)))
    return [
        Line2D([], [], color=look.colour, marker=look.mark, ms=6, ls="", label=name)
        for look, name in zip(looks, names, strict=True)
    ]


def _control_keys(names: Sequence[str]) -> list[Line2D]:
    """Return the legend of controls: a grey mark each, since names beside marks would lie on each other."""
    return [
        Line2D([], [], color=_CONTROL, marker=mark, ms=6, ls="", label=f"{name} (control)")
        for name, mark in zip(names, cycle(_CONTROL_MARKS), strict=False)
    ]


def _controls(chart: Axes, rows: pd.DataFrame, keys: Sequence[Line2D]) -> None:
    """Draw the controls of a panel in the looks of their legend."""
    for key in keys:
        mine = rows[rows["matcher"] == str(key.get_label()).removesuffix(" (control)")]
        chart.plot(mine["latency_s"], mine["value"], color=_CONTROL, marker=key.get_marker(), ms=6, ls="", zorder=1)


_SHOWN: Final = ("decided", "cause open", "decided, small")
_EQUAL: Final = ("equal", "null")  # boards of before version 6 have the latter


def draw_contrasts(path: Path | None, contrasts: pd.DataFrame) -> Figure:
    """Draw the difference of each registered contrast with its 95 % interval, in the order of the table.

    Return the figure, written where there is a path.
    """
    rows = contrasts[contrasts["n"] > 0].to_dict("records")
    labels = [f"{row['name']}: {row['first']} - {row['second']}" for row in rows]
    wide = _NAMES_OF_PAPER * paper_inches()
    if wide:  # the pair stands below the name
        labels = [broken(label.replace(": ", ":\n", 1), wide, _PAPER_POINTS) for label in labels]
    lines = max((label.count("\n") + 1 for label in labels), default=1)
    about = BoardPage(
        title="Registered contrasts",
        note=(
            "First less second on the same queries, with its 95 % interval by countries where they are enough, else by "
            "places. Blue: a difference is shown, adjusted by Holm; orange: equal, the interval is within the grey "
            "band of differences that were registered not to matter; grey: not decided."
        ),
        below="difference (shares; of other metrics in their unit)",
        panel_inches=(4.6, 0.4 + max(0.28, 0.15 * lines) * len(rows)),
    )
    with page(path, about) as charts:
        chart = charts[0][0]
        for at, row in enumerate(rows):
            chart.barh(at, 2 * row["least"], left=-row["least"], height=0.8, color="#eeeeee")
            known = [
                look_of(number).colour for number, some in enumerate((_SHOWN, _EQUAL), 1) if row["outcome"] in some
            ]
            colour, by = (known or ["#999999"])[0], "" if math.isnan(row["lo_countries"]) else "_countries"
            chart.hlines(at, row[f"lo{by}"], row[f"hi{by}"], color=colour, lw=1.6)
            chart.plot(row["difference"], at, marker="s", color=colour, ms=4.5, ls="")
        chart.axvline(0.0, color="#000000", lw=0.8)
        chart.set_yticks(range(len(rows)), labels)
        chart.set_ylim(len(rows) - 0.4, -0.6)
        chart.tick_params(axis="y", length=0)
        chart.grid(visible=True, axis="x", color=FAINT, lw=0.6)
    return figure_of(chart)


def _prices(chart: Axes, rows: pd.DataFrame, names: Sequence[str], column: str) -> None:
    cost, value = rows[column].to_numpy(float), rows["value"].to_numpy(float)
    front = rows[front_of(cost, value)].sort_values(column)
    chart.step(front[column], front["value"], where="post", color="#999999", lw=1.2)
    others = rows[~rows["matcher"].isin(names) & np.isfinite(cost)]
    chart.plot(others[column], others["value"], color="#999999", marker="o", ms=4, ls="", zorder=1)
    named = others[others["matcher"].isin(front["matcher"])].sort_values(column)
    for number, row in enumerate(named.to_dict("records")):
        at, away = (row[column], row["value"]), (3, 3 if number % 2 else -9)  # names of neighbours lie apart
        chart.annotate(row["matcher"], at, away, textcoords="offset points", fontsize=6.5, color="#555555")
    for number, name in enumerate(names):
        (row,) = rows[rows["matcher"] == name].to_dict("records")
        if not np.isfinite(row[column]):
            continue
        look = look_of(number)
        chart.vlines(row[column], row["lo"], row["hi"], color=look.colour, lw=0.9, alpha=0.75)
        if column == "latency_s" and np.isfinite(row["slow_s"]):
            chart.hlines(row["value"], row[column], row["slow_s"], color=look.colour, lw=0.9, alpha=0.75)
        chart.plot(row[column], row["value"], color=look.colour, marker=look.mark, ms=6, ls="")
    _cost_axis(chart, rows[[column, "slow_s"] if column == "latency_s" else [column]].to_numpy(float))


def _cost_axis(chart: Axes, costs: Floats) -> None:
    """Set a logarithmic axis around costs, of which some may be unknown; a linear one where one is 0."""
    ends = costs[np.isfinite(costs)]
    if ends.min() > 0:
        lo, hi = float(ends.min()) / 1.6, float(ends.max()) * 1.6
        ticks_across(chart, _round_numbers(lo, hi), lo, hi)


def _round_numbers(lo: float, hi: float) -> list[float]:
    """Return ticks of a logarithmic axis: powers of ten, and where there are few, 2 and 5 times these."""
    powers = [10.0**power for power in range(math.floor(math.log10(lo)), math.ceil(math.log10(hi)) + 1)]
    for steps in ((1,), (1, 2, 5), (1, 1.5, 2, 3, 4, 5, 6, 8)):
        found = [step * power for power in powers for step in steps if lo <= step * power <= hi]
        if len(found) > 2:  # two ends and something between
            return found
    return found
