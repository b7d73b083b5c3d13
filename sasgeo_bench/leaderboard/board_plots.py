# SPDX-License-Identifier: Apache-2.0
"""Pages for the figures of a board, as SVG or PNG, and the axes, lines and bars that several share."""

import io
import math
import re
import textwrap
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

import matplotlib as mpl
import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.lines import Line2D

from sasgeo_bench.canvas import PlainFigure
from sasgeo_bench.errors import counted
from sasgeo_bench.regions.region import ATTRIBUTION
from sasgeo_bench.scoring.base import Floats
from sasgeo_bench.scoring.metrics import primary_of

# Okabe and Ito's colours without the yellow, which is too pale on white; dashes and marks differ, too.
_COLOURS: Final = ("#000000", "#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9")
_DASHES: Final = ("-", "--", "-.", ":")
_MARKS: Final = ("o", "s", "^", "D", "v", "P", "X", "*", "<", ">", "h")
GREY: Final = "#555555"
FAINT: Final = "#dddddd"
_DPI: Final = 110
_TAGS: Final = re.compile(r"<[^>]+>")  # texts between them hold no bracket, and are not touched
_NUMBERS: Final = re.compile(r' (?:d|x|y|x1|x2|y1|y2|points)="[^"]*"')
_GROUP_NAMES: Final = re.compile(r' id="[A-Za-z2.]+_\d+"')  # nothing refers to them; what is referred to has a hash
_STYLE_OF: Final = re.compile(r' style="([^"]*)"')
_INDENTS: Final = re.compile(r"\n +")
_DIGITS: Final = re.compile(r"(\.\d\d)\d+")
_TITLE_LETTERS: Final = 30  # of a panel's title, in a line
_LABEL_POINTS: Final = 8.5
_LINE_INCHES: Final = 0.155  # of a note
_KEY_INCHES: Final = 0.2
_LABEL_LETTERS: Final = 13.0  # of a label of axes, on an inch
_LETTERS: Final = 15.5  # of a note, on an inch
_STYLE: Final[dict[Any, Any]] = {
    "svg.fonttype": "none",  # text stays text, so that it can be searched for
    "svg.hashsalt": "sasgeo-bench",
    "font.family": "sans-serif",
    "font.sans-serif": ["DejaVu Sans"],
    "font.size": 8.5,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.axisbelow": True,
}


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


@dataclass(frozen=True, slots=True, kw_only=True)
class Page:
    """Title, notes and size of a figure around its panels.

    `title` and `note` stand above and below, broken into lines; `below` names the axes across, once, under the middle
    of the panels. `rows` and `columns` count panels down and across. `panel_inches` are width and height of a panel,
    `left_inches` and `gap_inches` the room for text left of all panels, and of each but the first column,
    `row_gap_inches` that between rows. `keys` is the legend, above the panels, by the numbers of `look_of`, with marks
    if `has_marks`.
    """

    title: str
    note: str
    below: str
    rows: int = 1
    columns: int = 1
    panel_inches: tuple[float, float] = (2.4, 2.1)
    left_inches: float = 0.75
    gap_inches: float = 0.2
    row_gap_inches: float = 0.55
    keys: Sequence[str] = field(default=())
    has_marks: bool = True


@contextmanager
def page(path: Path, about: Page) -> Iterator[list[list[Axes]]]:
    """Yield the panels of a figure, row by row; write it as .svg or .png when the block ends."""
    wide, high = about.panel_inches
    width = max(6.4, about.left_inches + about.columns * (wide + about.gap_inches) + 0.2)
    title = textwrap.wrap(about.title, int(width * 10.5))
    note = textwrap.wrap(about.note, int(width * _LETTERS))
    across = _keys_across(about.keys, width)
    legend = _KEY_INCHES * math.ceil(len(about.keys) / across) + 0.1 if about.keys else 0.0
    top = 0.14 + 0.2 * len(title) + legend + 0.36
    bottom = 0.62 + _LINE_INCHES * len(note) + 0.3
    height = top + about.rows * high + (about.rows - 1) * about.row_gap_inches + bottom
    with mpl.rc_context(_STYLE):
        figure = PlainFigure(figsize=(width, height), dpi=_DPI, facecolor="white")
        FigureCanvasAgg(figure)
        figure.text(0.12 / width, 1 - 0.1 / height, "\n".join(title), fontsize=10.5, weight="bold", va="top")
        figure.text(
            0.12 / width, 0.26 / height, "\n".join(note), fontsize=7.5, color=GREY, va="bottom", linespacing=1.3
        )
        figure.text(0.12 / width, 0.09 / height, f"Data: {ATTRIBUTION}", fontsize=7.5, color=GREY, va="bottom")
        if about.keys:
            figure.legend(
                handles=[_key(number, name, has_mark=about.has_marks) for number, name in enumerate(about.keys)],
                loc="upper left",
                bbox_to_anchor=(0.06 / width, 1 - (0.14 + 0.2 * len(title)) / height),
                ncols=across,
                frameon=False,
                fontsize=8,
                borderaxespad=0.2,
                handlelength=2.6,
            )
        lefts = [about.left_inches + column * (wide + about.gap_inches) for column in range(about.columns)]
        lows = [height - top - (row + 1) * high - row * about.row_gap_inches for row in range(about.rows)]
        charts = [
            [figure.add_axes((left / width, low / height, wide / width, high / height)) for left in lefts]
            for low in lows
        ]
        middle = about.left_inches + (about.columns * (wide + about.gap_inches) - about.gap_inches) / 2
        label = "\n".join(textwrap.wrap(about.below, int(2 * min(middle, width - middle) * _LABEL_LETTERS)))
        figure.text(middle / width, (bottom - 0.42) / height, label, ha="center", va="center", fontsize=_LABEL_POINTS)
        yield charts
        if path.suffix == ".svg":
            drawn = io.StringIO()
            metadata = {"Date": None, "Creator": None, "Rights": ATTRIBUTION, "Title": about.title}
            figure.savefig(drawn, format="svg", metadata=metadata)
            path.write_text(_rounded(drawn.getvalue()), encoding="utf-8")
        else:
            figure.savefig(path, metadata={"Software": None, "Title": about.title})


def _rounded(svg: str) -> str:
    """Shorten an SVG: hundredths of a point at most, no indents or names of groups, each style written once.

    This halves the file.
    """
    return _classed(_TAGS.sub(lambda tag: _short(tag[0]), _INDENTS.sub("\n", svg)))


def _short(tag: str) -> str:
    return _NUMBERS.sub(lambda found: _DIGITS.sub(r"\1", found[0]), _GROUP_NAMES.sub("", tag))


def _classed(svg: str) -> str:
    """Replace styles that stand more than once by classes, numbered by first appearance."""
    counts = Counter(style for tag in _TAGS.findall(svg) for style in _STYLE_OF.findall(tag))
    names = {style: f"s{at}" for at, style in enumerate(style for style, count in counts.items() if count > 1)}
    rules = "".join(f".{name}{{{style}}}" for style, name in names.items())
    classes = {f' style="{style}"': f' class="{name}"' for style, name in names.items()}
    short = _TAGS.sub(lambda tag: _STYLE_OF.sub(lambda one: classes.get(one[0], one[0]), tag[0]), svg)
    return short.replace("</style>", f"{rules}</style>", 1)


def _keys_across(keys: Sequence[str], width: float) -> int:
    """Return the number of legend entries in a row."""
    longest = max((len(name) for name in keys), default=1)
    return max(1, min(len(keys), int(width / (0.6 + 0.075 * longest))))


def _key(number: int, name: str, *, has_mark: bool) -> Line2D:
    look = look_of(number)
    return Line2D(
        [], [], color=look.colour, ls=look.dash, marker=look.mark if has_mark else "", ms=4.5, lw=1.5, label=name
    )


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
    """Return the matchers that have a row, in the order of their looks."""
    return [name for name in shown if (rows["matcher"] == name).any()]


def of_which(row: Mapping[str, Any] | pd.Series) -> str:
    """Return the suite, track and prior group of a figure in words."""
    return f"{row['suite']}, {row['track']}, prior {row['prior_group']}"


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


def panels(charts: list[list[Axes]], count: int) -> Iterator[tuple[int, Axes]]:
    """Yield the number and axes of each of `count` panels; hide those beyond."""
    for number, chart in enumerate(chart for line in charts for chart in line):
        if number < count:
            yield number, chart
        else:
            chart.set_visible(False)


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
    chart.set_title(f"{name}\nn {row['n']:g}, {counted(int(row['blocks']), 'block')}", fontsize=8, loc="left")


def cut(name: str) -> str:
    """Return a name cut to the width of a panel."""
    return name if len(name) <= _TITLE_LETTERS else f"{name[: _TITLE_LETTERS - 3]}..."


def draw_bar_panels(
    path: Path, rows: pd.DataFrame, shown: Sequence[str], column: str, values: Sequence[str], *, title: str, note: str
) -> None:
    """Draw success as bars with intervals: a panel for each value of a column, a bar for each matcher."""
    names, (down, across) = those_there(rows, shown), panels_across(len(values))
    about = Page(
        title=title,
        note=note,
        below=PRIMARY[primary_of(str(rows["track"].iloc[0])).name].replace("\n", " "),
        rows=down,
        columns=across,
        panel_inches=(1.9, 0.3 + 0.19 * len(names)),
        left_inches=0.35 + 0.075 * max(map(len, names)),
        gap_inches=0.42,
        row_gap_inches=0.62,
    )
    with page(path, about) as charts:
        for number, chart in panels(charts, len(values)):
            mine = rows[rows[column] == values[number]]
            panel_title(chart, cut(values[number]), mine.iloc[0])
            _draw_bars(chart, mine, names)
            if number % across:
                chart.set_yticklabels([])


def _draw_bars(chart: Axes, mine: pd.DataFrame, names: Sequence[str]) -> None:
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
    """Shift values on a logarithmic axis a little by the number of a line, so that intervals do not hide others."""
    return np.asarray(values * (1.0 + by) ** (number - (count - 1) / 2))
