# SPDX-License-Identifier: Apache-2.0
"""The figures of a board over many queries at once: each draws a table of `pools` on a page."""

import math
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import Final

import numpy as np
import pandas as pd
from matplotlib.axes import Axes

from sasgeo_bench.errors import counted
from sasgeo_bench.leaderboard.board_plots import (
    FAINT,
    INTERVALS,
    PRIMARY,
    Page,
    dodged,
    draw_bars_of,
    draw_line,
    dress_share,
    look_of,
    page,
    panels_across,
    those_there,
)
from sasgeo_bench.leaderboard.pooled_tables import LEAST_ERROR_M, MOST_ERROR_M, front_of
from sasgeo_bench.scoring.decisions import COST_RATIOS
from sasgeo_bench.scoring.metrics import primary_of
from sasgeo_bench.scoring.rows import ALL_SUITES
from sasgeo_bench.scoring.score import FIX_M

_STRESS: Final = "Present places under stress; of a suite without stresses all of them."
_LETTERS: Final = 30  # of a panel's title, in a line
_MOST_ASKED: Final = (
    "A panel has the matchers that were asked all of its queries; no answer is a miss, and in the denominator."
)


def draw_ablation(path: Path, rows: pd.DataFrame, shown: Sequence[str]) -> None:
    """Draw the arms beside each other, pooled over the suites of each registered contrast, as bars with intervals.

    Parameters
    ----------
    path : Path
        A .svg or .png to write.
    rows : pandas.DataFrame
        From `pooled_tables.ablation_frame`, of one track and prior group.
    shown : sequence of str
        Matchers, in the order of their looks.
    """
    names, pools = those_there(rows, shown), list(dict.fromkeys(rows["pool"]))
    first = rows.iloc[0]
    down, across = panels_across(len(pools))
    suites = "; ".join(f"{pool}: {rows.loc[rows['pool'] == pool, 'suites'].iloc[0]}" for pool in pools)
    about = Page(
        title=f"Arms beside each other: {first['track']}, prior {first['prior_group']}",
        note=(
            f"Pools of the registered contrasts, all queries of a pool weighing the same. {suites}. "
            f"{INTERVALS.replace('each point', 'each bar')} {_MOST_ASKED}"
        ),
        below=PRIMARY[primary_of(str(first["track"])).name].replace("\n", " "),
        rows=down,
        columns=across,
        panel_inches=(1.9, 0.3 + 0.19 * len(names)),
        left_inches=0.35 + 0.075 * max(map(len, names)),
        gap_inches=0.42,
        row_gap_inches=0.62,
    )
    with page(path, about) as charts:
        for number, chart, mine in _panels(charts, rows, "pool", pools):
            _title(chart, pools[number], _counts(mine.iloc[0]))
            draw_bars_of(chart, mine, names)
            if number % across:
                chart.set_yticklabels([])


def _title(chart: Axes, name: str, counts: str) -> None:
    """Return a panel's title: a name cut to the width of the panel, and its number of queries."""
    short = name if len(name) <= _LETTERS else f"{name[: _LETTERS - 3]}..."
    chart.set_title(f"{short}\n{counts}", fontsize=8, loc="left")


def _counts(row: pd.Series) -> str:
    return f"n {row['n']:g}, {counted(int(row['blocks']), 'block')}"


def _suite_page(rows: pd.DataFrame, names: Sequence[str], *, title: str, note: str, below: str) -> Page:
    """Draw a page with a panel for each suite."""
    first = rows.iloc[0]
    down, across = panels_across(rows["suite"].nunique())
    return Page(
        title=f"{title}: {first['track']}, prior {first['prior_group']}",
        note=f"{note} {_STRESS} {_MOST_ASKED}",
        below=below,
        rows=down,
        columns=across,
        keys=names,
        gap_inches=0.25,
        row_gap_inches=0.65,
    )


def draw_recall(path: Path, rows: pd.DataFrame, shown: Sequence[str]) -> None:
    """Draw Recall@K against K: a panel for each suite, a line for each matcher.

    Parameters
    ----------
    path : Path
        A .svg or .png to write.
    rows : pandas.DataFrame
        From `pooled_tables.recall_frame`, of one track and prior group.
    shown : sequence of str
        Matchers, in the order of their looks.
    """
    names, suites = those_there(rows, shown), sorted(set(rows["suite"]))
    track = str(rows["track"].iloc[0])
    what = "the right candidate" if track == "retrieval" else f"a pose within {FIX_M:g} m, whatever the heading,"
    note = f"Share of queries with {what} among the first K of the answer; ties count in every order. {INTERVALS}"
    below = "K (poses of an answer, best first)"
    about = _suite_page(rows, names, title="Recall against K", note=note, below=below)
    steps = sorted(set(rows["k"]))
    with page(path, about) as charts:
        for number, chart, mine in _panels(charts, rows, "suite", suites):
            _head_of(chart, mine)
            chart.set_xscale("log")
            chart.set_xlim(0.75, 1.35 * steps[-1])
            chart.xaxis.set_ticks(steps, [str(step) for step in steps])
            chart.xaxis.set_ticks([], minor=True)
            chart.set_ylim(-0.02, 1.04)
            chart.set_yticks([0.0, 0.25, 0.5, 0.75, 1.0])
            chart.grid(visible=True, axis="y", color=FAINT, lw=0.6)
            for at, name in enumerate(names):
                line_of = mine[mine["matcher"] == name].sort_values("k")
                places = dodged(line_of["k"].to_numpy(float), at, len(names), by=0.025)
                draw_line(chart, line_of, places, at)
            _outer(chart, number, about, len(suites), "recall@K (share of queries)")


def _panels(
    charts: Iterable[Iterable[Axes]], rows: pd.DataFrame, column: str, names: Sequence[str]
) -> Iterator[tuple[int, Axes, pd.DataFrame]]:
    """Yield number, axes and rows of the panel of each name in a column; panels beyond the names are hidden."""
    for number, chart in enumerate(chart for line in charts for chart in line):
        if number < len(names):
            yield number, chart, rows[rows[column] == names[number]]
        else:
            chart.set_visible(False)


def _head_of(chart: Axes, mine: pd.DataFrame) -> None:
    """Title of a suite's panel."""
    counts = mine.iloc[0]
    part = "" if counts["stratum"] == "all" else f" {counts['stratum']}"
    _title(chart, f"{counts['suite']}{part}", _counts(counts))


def _outer(chart: Axes, number: int, about: Page, count: int, label: str) -> None:
    """Numbers and names of axes where no other panel stands between them and the edge."""
    is_left, is_low = number % about.columns == 0, number + about.columns >= count
    chart.tick_params(labelleft=is_left, labelbottom=is_low)
    if is_left:
        chart.set_ylabel(label)


def draw_errors(path: Path, rows: pd.DataFrame, shown: Sequence[str]) -> None:
    """Draw the distribution of errors: a panel for each suite, a line for each matcher.

    Parameters
    ----------
    path : Path
        A .svg or .png to write.
    rows : pandas.DataFrame
        From `pooled_tables.errors_frame`, of one track and prior group.
    shown : sequence of str
        Matchers, in the order of their looks.
    """
    names, suites = those_there(rows, shown), sorted(set(rows["suite"]))
    note = (
        f"Share of all n queries whose fix is that near, whatever the heading; an answer that is none is never near. "
        f"Dashed: {FIX_M:g} m, beyond which a fix is false; bars there: 95 % intervals as on the board (within_25m)."
    )
    about = _suite_page(rows, names, title="Distribution of errors", note=note, below="position error (m)")
    ticks = [0.1, 1.0, 10.0, 100.0, 1000.0]
    with page(path, about) as charts:
        for number, chart, mine in _panels(charts, rows, "suite", suites):
            _head_of(chart, mine)
            chart.set_xscale("log")
            chart.set_xlim(LEAST_ERROR_M, MOST_ERROR_M)
            chart.xaxis.set_ticks(ticks, [f"{tick:g}" for tick in ticks])
            chart.xaxis.set_ticks([], minor=True)
            chart.axvline(FIX_M, color="#999999", lw=0.8, ls="--")
            chart.set_ylim(-0.02, 1.04)
            chart.set_yticks([0.0, 0.25, 0.5, 0.75, 1.0])
            chart.grid(visible=True, axis="y", color=FAINT, lw=0.6)
            for at, name in enumerate(names):
                _error_line(chart, mine[mine["matcher"] == name], at, len(names))
            _outer(chart, number, about, len(suites), "share of queries\nwithin that error")


def _error_line(chart: Axes, mine: pd.DataFrame, number: int, count: int) -> None:
    look = look_of(number)
    chart.plot(mine["radius_m"], mine["value"], color=look.colour, ls=look.dash, lw=1.3)
    told = mine[mine["lo"].notna()]
    if len(told):
        at = dodged(told["radius_m"].to_numpy(float), number, count, by=0.12)
        chart.vlines(at, told["lo"], told["hi"], color=look.colour, lw=0.9, alpha=0.75)
        chart.plot(at, told["value"], color=look.colour, marker=look.mark, ms=4, ls="")


def draw_costs(path: Path, rows: pd.DataFrame, shown: Sequence[str]) -> None:
    """Draw the cost of a query against the cost of a false fix: a panel for each matcher, a line for each rejector.

    Parameters
    ----------
    path : Path
        A .svg or .png to write.
    rows : pandas.DataFrame
        From `pooled_tables.cost_frame`, of one track and prior group.
    shown : sequence of str
        Matchers.
    """
    names, rejectors = those_there(rows, shown), sorted(set(rows["rejector"]))
    first = rows.iloc[0]
    down, across = panels_across(len(names))
    about = Page(
        title=f"Cost of a query: {ALL_SUITES}, {first['track']}, prior {first['prior_group']}",
        note=(
            "A fix is accepted where the rejector says that its chance to be false is below 1 / (1 + C) (Eq. 14). A "
            "false fix costs C, a present place without an accepted fix 1, all else nothing: cost_5_place, "
            "cost_20_place and cost_100_place of the board, and all ratios between. Grey: dashed, all is withheld; "
            "dotted, all answers are accepted. A rejector that helps lies below both. n: queries, absent places among "
            "them."
        ),
        below="C: cost of a false fix (places without a fix)",
        rows=down,
        columns=across,
        keys=rejectors,
        has_marks=False,
        gap_inches=0.25,
        row_gap_inches=0.65,
    )
    ticks = [1.0, *COST_RATIOS]
    high = 1.25 * max(float(rows["withhold_all"].max()), float(rows["cost"].quantile(0.9)))
    with page(path, about) as charts:
        for number, chart, mine in _panels(charts, rows, "matcher", names):
            counts = sorted(set(mine["n"]))
            _title(chart, names[number], "n " + ", ".join(f"{count:g}" for count in counts))
            _cost_lines(chart, mine, rejectors)
            chart.set_xscale("log")
            chart.set_xlim(float(mine["ratio"].min()), float(mine["ratio"].max()))
            chart.xaxis.set_ticks(ticks, [f"{tick:g}" for tick in ticks])
            chart.xaxis.set_ticks([], minor=True)
            chart.set_ylim(0.0, high)
            chart.grid(visible=True, color=FAINT, lw=0.6)
            _outer(chart, number, about, len(names), "mean cost of a query\n(places without a fix)")


def _cost_lines(chart: Axes, mine: pd.DataFrame, rejectors: Sequence[str]) -> None:
    base = mine[mine["rejector"] == mine["rejector"].iloc[0]]
    for column, dash in (("withhold_all", "--"), ("accept_all", ":")):
        chart.plot(base["ratio"], base[column], color="#999999", lw=1.0, ls=dash)
    for number, name in enumerate(rejectors):
        points = mine[mine["rejector"] == name]
        look = look_of(number)
        chart.plot(points["ratio"], points["cost"], color=look.colour, ls=look.dash, lw=1.3)


def draw_prices(path: Path, rows: pd.DataFrame, shown: Sequence[str]) -> None:
    """Draw what answers are worth against what they take, with the front that no other matcher beats.

    Parameters
    ----------
    path : Path
        A .svg or .png to write.
    rows : pandas.DataFrame
        From `pooled_tables.price_frame`, of one track and prior group.
    shown : sequence of str
        Matchers, in the order of their looks.
    """
    names = those_there(rows, shown)
    first = rows.iloc[0]
    axes = [(name, label) for name, label in _PRICES.items() if np.isfinite(rows[name].to_numpy(float)).any()]
    about = Page(
        title=f"What answers are worth, and what they take: {first['track']}, prior {first['prior_group']}",
        note=(
            f"Suites {first['suites']}: those that all of these matchers were asked; n {first['n']:g} present places, "
            f"{counted(int(first['blocks']), 'block')}. Upright bars: 95 % intervals; level bars: from the median "
            "latency to the 95th percentile, all suites of the track. Grey line: the front, where no other matcher is "
            "both cheaper and "
            f"better.{_left_out(rows)}"
        ),
        below="",
        columns=len(axes),
        keys=names,
        panel_inches=(3.0, 2.5),
        gap_inches=0.3,
    )
    with page(path, about) as charts:
        for chart, (column, label) in zip(charts[0], axes, strict=True):
            chart.set_title(f"n {first['n']:g}", fontsize=8, loc="left")
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


def _prices(chart: Axes, rows: pd.DataFrame, names: Sequence[str], column: str) -> None:
    cost, value = rows[column].to_numpy(float), rows["value"].to_numpy(float)
    front = rows[front_of(cost, value)].sort_values(column)
    chart.step(front[column], front["value"], where="post", color="#999999", lw=1.2)
    for number, name in enumerate(names):
        (row,) = rows[rows["matcher"] == name].to_dict("records")
        if not np.isfinite(row[column]):
            continue
        look = look_of(number)
        chart.vlines(row[column], row["lo"], row["hi"], color=look.colour, lw=0.9, alpha=0.75)
        if column == "latency_s" and np.isfinite(row["slow_s"]):
            chart.hlines(row["value"], row[column], row["slow_s"], color=look.colour, lw=0.9, alpha=0.75)
        chart.plot(row[column], row["value"], color=look.colour, marker=look.mark, ms=6, ls="")
    known = cost[np.isfinite(cost)]
    if known.min() > 0:
        chart.set_xscale("log")
        ends = np.concatenate((known, rows["slow_s"].to_numpy(float))) if column == "latency_s" else known
        ends = ends[np.isfinite(ends)]
        lo, hi = float(ends.min()) / 1.6, float(ends.max()) * 1.6
        chart.set_xlim(lo, hi)
        ticks = _round_numbers(lo, hi)
        chart.xaxis.set_ticks(ticks, [f"{tick:g}" for tick in ticks])
        chart.xaxis.set_ticks([], minor=True)


def _round_numbers(lo: float, hi: float) -> list[float]:
    """Ticks of a logarithmic axis: powers of ten, and where there are few, 2 and 5 times these or simple fractions."""
    powers = [10.0**power for power in range(math.floor(math.log10(lo)), math.ceil(math.log10(hi)) + 1)]
    for steps in ((1,), (1, 2, 5), (1, 1.5, 2, 3, 4, 5, 6, 8)):
        found = [step * power for power in powers for step in steps if lo <= step * power <= hi]
        if len(found) > 2:  # noqa: PLR2004 - two ends and something between
            return found
    return found
