# SPDX-License-Identifier: Apache-2.0
"""Pages for the figures of a board, as SVG or PNG, and the axes, lines and bars that several share."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, Final

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.lines import Line2D

from sasgeo_bench.canvas import Page, broken, page, panels
from sasgeo_bench.errors import counted
from sasgeo_bench.leaderboard.columns import prior_words
from sasgeo_bench.regions.region import ATTRIBUTION
from sasgeo_bench.scoring.base import Floats
from sasgeo_bench.scoring.metrics import primary_of

# Okabe and Ito's colours without the yellow, which is too pale on white; dashes and marks differ, too.
_COLOURS: Final = ("#000000", "#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9")
_DASHES: Final = ("-", "--", "-.", ":")
_MARKS: Final = ("o", "s", "^", "D", "v", "P", "X", "*", "<", ">", "h")
FAINT: Final = "#dddddd"
BoardPage: Final = partial(Page, data=ATTRIBUTION)


@dataclass(frozen=True, slots=True, kw_only=True)
class Look:
    """Colour, dash and marker of one of several things drawn together."""

    colour: str
    dash: str
    mark: str


def look_of(number: int) -> Look:
    """Return the look of the thing of a number; no two of the first 28 have colour and dash in common."""
    return Look(
        colour=_COLOURS[number % len(_COLOURS)],
        dash=_DASHES[number % len(_DASHES)],
        mark=_MARKS[number % len(_MARKS)],
    )


def line_keys(names: Sequence[str], *, has_marks: bool = True) -> list[Line2D]:
    """Return the legend of lines of the looks 0, 1, ..."""
    looks = [(name, look_of(number)) for number, name in enumerate(names)]
    return [
        Line2D(
            [], [], color=look.colour, ls=look.dash, marker=look.mark if has_marks else "", ms=4.5, lw=1.5, label=name
        )
        for name, look in looks
    ]


PRIMARY: Final = {
    "success_25m": "success (share of queries\nwithin 25 m and 5 deg)",
    "distance_within_25m": "share of the flown distance\nwithin 25 m",
    "recall_1": "recall@1\n(share of queries)",
}
INTERVALS: Final = (
    "Bars: 95 % intervals as on the board (places, then blocks, then sites are drawn; never narrower than Wilson's "
    "over sites). n: queries of each point."
)
ACROSS: Final = 4  # panels side by side
_NAME_INCHES: Final = 2.6  # of a name next to its bar, before it is broken
HALVES: Final = (0.0, 0.5, 1.0)


def those_there(rows: pd.DataFrame, shown: Sequence[str]) -> list[str]:
    """Return the matchers that have a row, in the order of their looks."""
    return [name for name in shown if (rows["matcher"] == name).any()]


def of_which(row: Mapping[str, Any] | pd.Series) -> str:
    """Return the suite, track and prior group of a figure in words."""
    return f"{row['suite']}, {row['track']}, {prior_words(str(row['prior_group']))}"


def panels_across(count: int) -> tuple[int, int]:
    """Return rows and columns of so many panels.

    >>> panels_across(3), panels_across(9)
    ((1, 3), (3, 4))
    """
    columns = max(1, min(ACROSS, count))
    return -(-count // columns), columns


def dress_share(chart: Axes) -> None:
    """Set an axis of shares, with room below for numbers of queries."""
    chart.set_ylim(-0.13, 1.04)
    chart.set_yticks([0.0, 0.25, 0.5, 0.75, 1.0])
    chart.grid(visible=True, axis="y", color=FAINT, lw=0.6)


def draw_line(chart: Axes, mine: pd.DataFrame, at: Floats, number: int) -> None:
    """Draw the line of one matcher with an interval at each point; `at` are the places across."""
    if mine.empty:
        return
    look = look_of(number)
    value, lo, hi = (mine[name].to_numpy(float) for name in ("value", "lo", "hi"))
    chart.plot(at, value, color=look.colour, ls=look.dash, marker=look.mark, ms=4, lw=1.3)
    chart.vlines(at, lo, hi, color=look.colour, lw=0.9, alpha=0.75)


def label_outer(chart: Axes, number: int, columns: int, count: int, label: str) -> None:
    """Label the axes of a panel where no other panel stands between them and the edge."""
    is_left = number % columns == 0
    chart.tick_params(labelleft=is_left, labelbottom=number + columns >= count)
    if is_left:
        chart.set_ylabel(label)


def ticks_across(chart: Axes, ticks: Sequence[float], low: float, high: float) -> None:
    """Set a logarithmic axis across from `low` to `high`, with numbers at some ticks."""
    chart.set_xscale("log")
    chart.set_xlim(low, high)
    chart.xaxis.set_ticks(ticks, [f"{tick:g}" for tick in ticks])
    chart.xaxis.set_ticks([], minor=True)


def panel_title(chart: Axes, name: str, row: Mapping[str, Any] | pd.Series) -> None:
    """Write a name and the numbers of queries and blocks of a row above a panel."""
    chart.set_title(f"{name}\nn {row['n']:g}, {counted(int(row['blocks']), 'block')}")


def draw_bar_panels(
    path: Path, rows: pd.DataFrame, shown: Sequence[str], column: str, values: Sequence[str], *, title: str, note: str
) -> None:
    """Draw success as bars with intervals: a panel for each value of a column, a bar for each matcher."""
    names, (down, across) = those_there(rows, shown), panels_across(len(values))
    about = BoardPage(
        title=title,
        note=note,
        below=PRIMARY[primary_of(str(rows["track"].iloc[0])).name].replace("\n", " "),
        rows=down,
        columns=across,
        panel_inches=(1.9, 0.3 + 0.19 * len(names)),
    )
    with page(path, about) as charts:
        for number, chart in panels(charts, len(values)):
            mine = rows[rows[column] == values[number]]
            panel_title(chart, values[number], mine.iloc[0])
            draw_bars(chart, mine, names)
            if number % across:
                chart.set_yticklabels([])


def draw_bars(chart: Axes, mine: pd.DataFrame, names: Sequence[str]) -> None:
    """Draw a bar with its interval for each matcher, the first on top."""
    for at, name in enumerate(names):
        for row in mine[mine["matcher"] == name].to_dict("records"):
            chart.barh(at, row["value"], height=0.72, color=look_of(at).colour, alpha=0.75)
            chart.hlines(at, row["lo"], row["hi"], color="#000000", lw=1.0)
            chart.vlines([row["lo"], row["hi"]], at - 0.18, at + 0.18, color="#000000", lw=1.0)
            chart.text(1.03, at, f"{row['value']:.2f}", fontsize=6.5, va="center")
    chart.set_yticks(range(len(names)), [broken(name, _NAME_INCHES, 8.5) for name in names])
    chart.set_ylim(len(names) - 0.4, -0.6)
    chart.set_xlim(0.0, 1.0)
    chart.set_xticks([0.0, 0.5, 1.0], ["0", "0.5", "1"])
    chart.grid(visible=True, axis="x", color=FAINT, lw=0.6)
    chart.tick_params(axis="y", length=0)


def dodged(values: Floats, number: int, count: int, *, by: float) -> Floats:
    """Shift values on a logarithmic axis a little by the number of a line, so that intervals do not hide others."""
    return np.asarray(values * (1.0 + by) ** (number - (count - 1) / 2))
