# SPDX-License-Identifier: Apache-2.0
"""Figures: panels of one size with a title above and notes below, as SVG or PNG; all texts are plain.

matplotlib's constrained layout places the panels. No caller gives positions: a `Page` says how many panels there are
and how large they are, and the figure gets the size that this takes.
"""

import io
import re
import textwrap
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, contextmanager
from contextvars import ContextVar
from dataclasses import dataclass, field, replace
from pathlib import Path
from types import MappingProxyType
from typing import Any, Final, cast

import matplotlib as mpl
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.backend_bases import RendererBase
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.backends.backend_svg import FigureCanvasSVG
from matplotlib.figure import Figure
from matplotlib.text import Text

from sasgeo_bench.core.errors import ConfigError
from sasgeo_bench.core.texts import plain, plain_lines

GREY: Final = "#555555"
DPI: Final = 110
_NARROW_LEGEND: Final = {"handlelength": 1.0, "fontsize": 7.0, "columnspacing": 1.0, "labelspacing": 0.2}
_EDGE_INCHES: Final = 0.12  # left of title and notes
_LETTERS: Final = 130.0  # on an inch, of a font of one point
_TAGS: Final = re.compile(r"<[^>]+>")  # texts between them hold no bracket, and are not touched
_NUMBERS: Final = re.compile(r' (?:d|x|y|x1|x2|y1|y2|points)="[^"]*"')
_GROUP_NAMES: Final = re.compile(r' id="[A-Za-z2.]+_\d+"')  # nothing refers to them; what is referred to has a hash
_STYLE_OF: Final = re.compile(r' style="([^"]*)"')
_INDENTS: Final = re.compile(r"\n +")
_DIGITS: Final = re.compile(r"(\.\d\d)\d+")
_STYLE: Final[dict[Any, Any]] = {
    "svg.fonttype": "none",  # text stays text, so that it can be searched for
    "svg.hashsalt": "sasgeo-bench",
    "font.family": "sans-serif",
    "font.sans-serif": ["DejaVu Sans"],
    "font.size": 8.5,
    "legend.fontsize": 8.0,
    "axes.titlesize": 8.0,
    "axes.titlelocation": "left",
    "axes.titlepad": 4.0,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.axisbelow": True,
    "figure.constrained_layout.use": True,
    "figure.constrained_layout.w_pad": 0.07,  # inches, as h_pad
    "figure.constrained_layout.h_pad": 0.06,
    "figure.constrained_layout.wspace": 0.0,
    "figure.constrained_layout.hspace": 0.0,
}
# Of a figure on paper, which is printed as large as it is drawn
_SMALL: Final[dict[Any, Any]] = {
    "font.size": 7.0,
    "legend.fontsize": 6.5,
    "axes.titlesize": 7.0,
    "axes.linewidth": 0.6,
    "pdf.fonttype": 42,  # whole fonts: publishers refuse those of type 3
    "figure.constrained_layout.w_pad": 0.03,
    "figure.constrained_layout.h_pad": 0.03,
}
_OF_FILES: Final = ("pdf.fonttype", "svg.fonttype", "svg.hashsalt")  # are read when a figure is written
_SMALLER: Final = 0.82  # of a figure on paper, as its letters are
_MM: Final = 25.4  # of an inch
_LEAST_MM, _MOST_MM = 60.0, 400.0
_PAPER_ACROSS: Final = 2  # panels side by side on paper, at most
_paper_inches: ContextVar[float] = ContextVar("paper_inches", default=0.0)  # the width of figures; 0 is as on a page


@contextmanager
def on_paper(width_mm: float | None) -> Iterator[None]:
    """Draw pages that wide until the block ends, with small letters and panels below each other; None changes nothing.

    Title, facts and note are not drawn: they are the `caption` of the figure. Raise `ConfigError` for a width that no
    paper has.
    """
    if width_mm is not None and not _LEAST_MM <= width_mm <= _MOST_MM:
        raise ConfigError(f"width_mm is from {_LEAST_MM:g} to {_MOST_MM:g}, as 85 for a column, got {width_mm!r}")
    token = _paper_inches.set(0.0 if width_mm is None else width_mm / _MM)
    try:
        yield
    finally:
        _paper_inches.reset(token)


def paper_inches() -> float:
    """Return the width of figures on paper; 0 where they are drawn as on a page."""
    return _paper_inches.get()


def most_across(count: int) -> int:
    """Return how many panels may stand side by side where a page has so many: fewer on paper."""
    return min(count, _PAPER_ACROSS) if _paper_inches.get() else count


@dataclass(frozen=True, slots=True, kw_only=True)
class Page:
    """Texts, legend and panels of a figure.

    `title` and a line of `facts` stand above the panels, `note` and whose `data` it is below; `below` names the
    axes across, once. All are broken into lines. `keys` are the handles of the legend above the panels. `rows` and
    `columns` count panels down and across; `panel_inches` are width and height of each. A page that `is_narrow` is as
    wide as a telephone. `dpi` is for PNG.
    """

    title: str
    data: str
    facts: str = ""
    note: str = ""
    below: str = ""
    rows: int = 1
    columns: int = 1
    panel_inches: tuple[float, float] = (2.4, 2.1)
    is_narrow: bool = False
    keys: Sequence[Artist] = field(default=())
    dpi: int = DPI

    @property
    def least_inches(self) -> float:
        """Return the least width: notes are to be read in few lines."""
        return 3.7 if self.is_narrow else 6.4


class PlainFigure(Figure):
    r"""A figure that shows each text letter by letter, dollar signs included, and writes no control characters.

    >>> figure = PlainFigure(figsize=(1, 1))
    >>> text = figure.text(0, 0, r"cost $\nosuchthing$")
    >>> figure.draw_without_rendering()
    >>> text.get_text(), text.get_parse_math()
    ('cost $\\nosuchthing$', False)
    """

    _words: Mapping[Text, str] = MappingProxyType({})  # as given, to be broken into lines of the figure's width
    caption: str = ""  # what a page says around its panels, of a figure on paper

    def draw(self, renderer: RendererBase) -> None:
        """Draw the figure with every text of it, ticks and legends included, as plain text."""
        self._set_texts()
        super().draw(renderer)

    def _set_texts(self) -> None:
        width = self.get_figwidth()
        for text, given in self._words.items():
            x, room = _EDGE_INCHES / width, width - 2 * _EDGE_INCHES
            if text.get_horizontalalignment() == "center":
                x = text.get_position()[0]
                room = 2 * min(x, 1 - x) * width
            points = float(text.get_fontsize()) * (1.2 if text.get_fontweight() == "bold" else 1.0)
            text.set(x=x, text=broken(given, room, points))
        for item in self.findobj(Text):
            if isinstance(item, Text):
                item.set_parse_math(False)
                item.set_text(plain_lines(item.get_text()))

    def framed(self, about: Page) -> Any:  # noqa: ANN401 - a SubFigure, of which matplotlib's own types are unions
        """Write the texts and the legend of a page; return the part of the figure for its panels."""
        body: Any = self.subfigures()
        inner: Any = body.subfigures()
        paper = _paper_inches.get()
        if paper:
            self.caption = plain(" ".join(filter(None, (f"{about.title}.", about.facts, about.note))))
            foot = f"Data: {about.data}"
            self._words = {self.supxlabel(foot, ha="left", fontsize=5.5, color=GREY): foot}
        else:
            foot = f"{about.note}\nData: {about.data}".lstrip()
            self._words = {
                self.suptitle(about.title, ha="left", fontsize=10.5, weight="bold"): about.title,
                self.supxlabel(foot, ha="left", fontsize=7.5, color=GREY, linespacing=1.3): foot,
            }
        if about.facts and not paper:
            self._words[body.suptitle(about.facts, ha="left", fontsize=8.0, color=GREY)] = about.facts
        if about.below:
            self._words[body.supxlabel(about.below, fontsize=mpl.rcParams["font.size"])] = about.below
        if about.keys:
            width = paper or max(about.least_inches, about.columns * about.panel_inches[0])
            # Number of legend entries in a row
            names = [str(key.get_label()) for key in about.keys]
            mark, letter, look = 0.6, 0.075, {"handlelength": 2.6}  # inches that an entry takes
            if paper:
                mark, letter, look = 0.4, 0.052, {"handlelength": 2.6, "columnspacing": 1.0}
            elif about.is_narrow:
                mark, letter, look = 0.25, 0.06, _NARROW_LEGEND
            across = max(1, min(len(names), int(width / (mark + letter * max(map(len, names))))))
            inner.legend(handles=about.keys, loc="outside upper left", ncols=across, frameon=False, **look)
        return inner

    def fit(self, first: Axes, last: Axes, about: Page) -> None:
        """Set the size of the figure so that each panel, from `first` to `last`, is at least as large as asked."""
        self.arrange()
        box, end = (one.get_position(original=True).transformed(one.figure.transSubfigure) for one in (first, last))
        for text in self._words:
            if text.get_horizontalalignment() == "center":
                text.set_x((box.x0 + end.x1) / 2 / self.bbox.width)
        width, height = self.get_size_inches()
        width += about.columns * (about.panel_inches[0] - box.width / self.dpi)
        height += about.rows * (about.panel_inches[1] - box.height / self.dpi)
        self.set_size_inches(_paper_inches.get() or max(width, about.least_inches), height)
        self.arrange()
        if _paper_inches.get():  # of another height axes may have other ticks, whose labels are wider
            self.arrange()
        self.set_layout_engine("none")

    def arrange(self) -> None:
        """Place the panels, and break lines, at the present size of the figure."""
        self._set_texts()
        engine: Any = self.get_layout_engine()
        engine.execute(self)

    def write(self, path: Path, about: Page) -> None:
        """Write the figure as .svg or .png; the same figure gives the same bytes.

        Its layout is done, so the canvas prints it at once: `savefig` would draw everything twice.
        """
        title, data = plain(about.title), plain(about.data)
        if ".svg" in path.suffixes:  # of a file that is not yet in its place, too
            drawn = io.StringIO()
            metadata = {"Date": None, "Creator": None, "Rights": data, "Title": title}
            canvas: Any = FigureCanvasSVG(self)  # whose printing has no types
            canvas.print_svg(drawn, metadata=metadata)
            path.write_text(_rounded(drawn.getvalue()), encoding="utf-8")
        else:
            canvas = FigureCanvasAgg(self)
            canvas.print_png(path, metadata={"Title": title, "Copyright": data, "Software": None})

    def _repr_png_(self) -> bytes:
        shown = io.BytesIO()
        self.savefig(shown, format="png")
        return shown.getvalue()

    def savefig(self, fname: Any, **options: Any) -> None:  # noqa: ANN401 - as the figure's own
        """Write the figure; each entry of its metadata is one line."""
        given = options.pop("metadata", None) or {}
        kept = {name: plain(value) if isinstance(value, str) else value for name, value in given.items()}
        with mpl.rc_context({name: _SMALL.get(name, _STYLE.get(name)) for name in _OF_FILES}):
            super().savefig(fname, metadata=kept, **options)


def styled() -> AbstractContextManager[None]:
    """Apply the style of all figures until the block ends."""
    return mpl.rc_context(_STYLE | _SMALL if _paper_inches.get() else _STYLE)


def new_figure(size_inches: tuple[float, float], *, dpi: int = DPI) -> PlainFigure:
    """Return an empty figure; call it, and draw, inside `styled`."""
    figure = PlainFigure(figsize=size_inches, dpi=dpi, facecolor="white")
    FigureCanvasAgg(figure)
    return figure


@contextmanager
def page(path: Path | None, about: Page) -> Iterator[list[list[Axes]]]:
    """Yield the panels of a figure, row by row; write it as .svg or .png, if there is a path, when the block ends."""
    paper = _paper_inches.get()
    if paper:  # its letters are smaller, and so may its panels be
        wide = paper / about.columns - 0.5
        about = replace(about, panel_inches=(wide, _SMALLER * about.panel_inches[1]))
    wide, high = about.panel_inches
    with styled():
        # Larger than needed: `fit` makes it smaller, and too small a figure has no room for panels.
        across = paper or about.columns * (wide + 0.5) + 4.0
        figure = new_figure((across, about.rows * (high + 1.0) + 6.0), dpi=about.dpi)
        charts = figure.framed(about).subplots(about.rows, about.columns, squeeze=False)
        yield charts.tolist()
        for chart in charts.flat:
            title = chart.get_title("left").replace(" %", "\0%") if paper else chart.get_title("left")
            chart.set_title(broken(title, wide, mpl.rcParams["axes.titlesize"]).replace("\0", " "))
        figure.fit(charts[0, 0], charts[-1, -1], about)
        if path is not None:
            figure.write(path, about)


def figure_of(chart: Axes) -> Figure:
    """Return the whole figure that a panel is part of."""
    return cast("Figure", chart.get_figure(root=True))


def panels(charts: Sequence[Sequence[Axes]], count: int) -> Iterator[tuple[int, Axes]]:
    """Yield the number and axes of each of `count` panels; hide those beyond."""
    for number, chart in enumerate(chart for line in charts for chart in line):
        if number < count:
            yield number, chart
        else:
            chart.set_visible(False)


def without_ticks(chart: Axes) -> None:
    """Frame a panel that holds a picture, and leave out its ticks."""
    chart.set(xticks=[], yticks=[])
    chart.spines[:].set_visible(True)


def broken(text: str, width_inches: float, points: float) -> str:
    r"""Break each line of a text where it is wider than that many inches, in a font of so many points.

    >>> broken("one two\nthree", 0.5, 8.0)
    'one two\nthree'
    """
    letters = max(1, int(width_inches * _LETTERS / points))
    return "\n".join(textwrap.fill(line, letters, break_on_hyphens=False) for line in text.split("\n"))


def _rounded(svg: str) -> str:
    """Shorten an SVG: hundredths of a point at most, no indents or names of groups, each style written once."""
    # This halves the file.
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
