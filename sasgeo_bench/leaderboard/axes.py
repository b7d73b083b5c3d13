# SPDX-License-Identifier: Apache-2.0
"""What panels of several figures have in common: axes of shares, lines with intervals, bars."""

from collections.abc import Mapping, Sequence
from typing import Any, Final

import numpy as np
import pandas as pd
from matplotlib.axes import Axes

from sasgeo_bench.leaderboard.board_plots import FAINT, look_of
from sasgeo_bench.scoring.base import Floats

PRIMARY: Final = {
    "success_25m": "success (share of queries\nwithin 25 m and 5 deg)",
    "recall_1": "recall@1\n(share of queries)",
}
INTERVALS: Final = (
    "Bars: 95 % intervals as on the board (blocks, then sites are drawn; never narrower than Wilson's over sites). "
    "n: queries of each point."
)
ACROSS: Final = 4  # panels beside each other
HALVES: Final = (0.0, 0.5, 1.0)


def those_there(rows: pd.DataFrame, shown: Sequence[str]) -> list[str]:
    """Matchers that have a row, in the order of their looks.

    Examples
    --------
    >>> those_there(pd.DataFrame({"matcher": ["b", "a"]}), ["a", "c", "b"])
    ['a', 'b']
    """
    return [name for name in shown if (rows["matcher"] == name).any()]


def of_which(row: Mapping[str, Any] | pd.Series) -> str:
    """Of which queries a figure is.

    Examples
    --------
    >>> of_which({"suite": "clean", "track": "localization", "prior_group": "r500-weak-s3"})
    'clean, localization, prior r500-weak-s3'
    """
    return f"{row['suite']}, {row['track']}, prior {row['prior_group']}"


def panels_across(count: int) -> tuple[int, int]:
    """Rows and columns of so many panels.

    Examples
    --------
    >>> panels_across(3), panels_across(9)
    ((1, 3), (3, 4))
    """
    columns = max(1, min(ACROSS, count))
    return -(-count // columns), columns


def dress_share(chart: Axes) -> None:
    """An axis of shares, with room below for numbers of queries."""
    chart.set_ylim(-0.13, 1.04)
    chart.set_yticks([0.0, 0.25, 0.5, 0.75, 1.0])
    chart.grid(visible=True, axis="y", color=FAINT, lw=0.6)


def draw_line(chart: Axes, mine: pd.DataFrame, at: Floats, number: int) -> None:
    """The line of one matcher with an interval at each point; `at` are the places across."""
    if mine.empty:
        return
    look = look_of(number)
    value, lo, hi = (mine[name].to_numpy(float) for name in ("value", "lo", "hi"))
    chart.plot(at, value, color=look.colour, ls=look.dash, marker=look.mark, ms=4, lw=1.3)
    chart.vlines(at, lo, hi, color=look.colour, lw=0.9, alpha=0.75)


def draw_bars_of(chart: Axes, mine: pd.DataFrame, names: Sequence[str]) -> None:
    """Draw a bar with its interval for each matcher that has a row."""
    for at, name in enumerate(names):
        for row in mine[mine["matcher"] == name].to_dict("records"):
            chart.barh(at, row["value"], height=0.72, color=look_of(at).colour, alpha=0.75)
            chart.hlines(at, row["lo"], row["hi"], color="#000000", lw=1.0)
            chart.vlines([row["lo"], row["hi"]], at - 0.18, at + 0.18, color="#000000", lw=1.0)
            chart.text(1.03, at, f"{row['value']:.2f}", fontsize=6.5, va="center")
    chart.set_yticks(range(len(names)), list(names))
    chart.set_ylim(len(names) - 0.4, -0.6)
    chart.set_xlim(0.0, 1.0)
    chart.set_xticks([0.0, 0.5, 1.0], ["0", "0.5", "1"])
    chart.grid(visible=True, axis="x", color=FAINT, lw=0.6)
    chart.tick_params(axis="y", length=0)


def dodged(values: Floats, number: int, count: int, *, by: float) -> Floats:
    """Places on a logarithmic axis, set apart a little by the number of a line, so that intervals do not hide others.

    Examples
    --------
    >>> dodged(np.array([10.0]), 0, 1, by=0.1).tolist()
    [10.0]
    """
    return np.asarray(values * (1.0 + by) ** (number - (count - 1) / 2))
