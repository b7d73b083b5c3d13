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
from sasgeo_bench.regions.region import ATTRIBUTION
from sasgeo_bench.scoring.base import Floats

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
    """The look of the thing of a number; no two of the first 28 have colour and dash in common.

    >>> look_of(0).colour, look_of(7).dash
    ('#000000', ':')
    """
    return Look(
        colour=_COLOURS[number % len(_COLOURS)],
        dash=_DASHES[number % len(_DASHES)],
        mark=_MARKS[number % len(_MARKS)],
    )


@dataclass(frozen=True, slots=True, kw_only=True)
class Page:
    """Title, notes and size of a figure around its panels.

    Parameters
    ----------
    title, note : str
        Above and below; both are broken into lines.
    below : str
        What the axes across are of; written once, under the middle of the panels.
    rows, columns : int
        Panels down and across.
    panel_inches : (float, float)
        Width and height of a panel.
    left_inches, gap_inches : float
        Room for what is written left of the panels, and of each but the first column.
    row_gap_inches : float
        Room between rows: for a panel's title, and where each has its own axis, for that.
    keys : sequence of str
        Legend, by the numbers of `look_of`; above the panels, never over them.
    has_marks : bool
        Whether the legend shows marks on its lines.
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
    """Yield the panels of a figure, row by row; it is written when the block ends.

    Parameters
    ----------
    path : Path
        A .svg or .png to write.
    about : Page
        What is around the panels.
    """
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
        charts = []
        for row in range(about.rows):
            low = height - top - (row + 1) * high - row * about.row_gap_inches
            boxes = [
                (about.left_inches + column * (wide + about.gap_inches), low, wide, high)
                for column in range(about.columns)
            ]
            charts.append([figure.add_axes(_share_of(box, width, height)) for box in boxes])
        middle = about.left_inches + (about.columns * (wide + about.gap_inches) - about.gap_inches) / 2
        label = "\n".join(textwrap.wrap(about.below, int(2 * min(middle, width - middle) * _LABEL_LETTERS)))
        figure.text(middle / width, (bottom - 0.42) / height, label, ha="center", va="center", fontsize=_LABEL_POINTS)
        yield charts
        if path.suffix == ".svg":
            drawn = io.StringIO()
            said = {"Date": None, "Creator": None, "Rights": ATTRIBUTION, "Title": about.title}
            figure.savefig(drawn, format="svg", metadata=said)
            path.write_text(_rounded(drawn.getvalue()), encoding="utf-8")
        else:
            figure.savefig(path, metadata={"Software": None, "Title": about.title})


def _rounded(svg: str) -> str:
    """An SVG with hundredths of a point at most, without indents and names of groups, and each style written once.

    Half of what is drawn with says no more.
    """
    return _classed(_TAGS.sub(lambda tag: _short(tag[0]), _INDENTS.sub("\n", svg)))


def _short(tag: str) -> str:
    return _NUMBERS.sub(lambda found: _DIGITS.sub(r"\1", found[0]), _GROUP_NAMES.sub("", tag))


def _classed(svg: str) -> str:
    """Styles that stand more than once as classes, numbered as they first stand."""
    counts = Counter(style for tag in _TAGS.findall(svg) for style in _STYLE_OF.findall(tag))
    names = {style: f"s{at}" for at, style in enumerate(style for style, count in counts.items() if count > 1)}
    rules = "".join(f".{name}{{{style}}}" for style, name in names.items())
    classes = {f' style="{style}"': f' class="{name}"' for style, name in names.items()}
    short = _TAGS.sub(lambda tag: _STYLE_OF.sub(lambda one: classes.get(one[0], one[0]), tag[0]), svg)
    return short.replace("</style>", f"{rules}</style>", 1)


def _share_of(box: tuple[float, float, float, float], width: float, height: float) -> tuple[float, float, float, float]:
    """Inches -> shares of a figure."""
    left, low, wide, high = box
    return (left / width, low / height, wide / width, high / height)


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
    """Matchers that have a row, in the order of their looks.

    >>> those_there(pd.DataFrame({"matcher": ["b", "a"]}), ["a", "c", "b"])
    ['a', 'b']
    """
    return [name for name in shown if (rows["matcher"] == name).any()]


def of_which(row: Mapping[str, Any] | pd.Series) -> str:
    """Of which queries a figure is.

    >>> of_which({"suite": "clean", "track": "localization", "prior_group": "r500-weak-s3"})
    'clean, localization, prior r500-weak-s3'
    """
    return f"{row['suite']}, {row['track']}, prior {row['prior_group']}"


def panels_across(count: int) -> tuple[int, int]:
    """Rows and columns of so many panels.

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

    >>> dodged(np.array([10.0]), 0, 1, by=0.1).tolist()
    [10.0]
    """
    return np.asarray(values * (1.0 + by) ** (number - (count - 1) / 2))
