# SPDX-License-Identifier: Apache-2.0
"""Fig. 1 of the SASGeo paper from a real extract: a view, the map there, its weights, and the place it resembles."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from textwrap import wrap
from typing import Any, Final

import numpy as np
import pandas as pd
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle
from numpy.typing import NDArray

from sasgeo_bench.canvas import PlainFigure
from sasgeo_bench.osm.taxonomy import load_taxonomy
from sasgeo_bench.regions.evidence import Evidence
from sasgeo_bench.regions.preview import scale_bar
from sasgeo_bench.regions.region import ATTRIBUTION
from sasgeo_bench.sasgeo.weight_plot import colour_bar, picture_of, words
from sasgeo_bench.tasks.sheet import paint

_DPI: Final = 130
_SIDE: Final = 2.95  # of a panel, inches
_GAP: Final = 0.12
_LEFT: Final = 0.25
_ROW: Final = 0.175
_WIDTH: Final = 2 * _LEFT + 4 * _SIDE + 3 * _GAP
_GREY: Final = "#444444"
_SHARES: Final = ("share view", "share true place", "share lookalike")
_SCORES: Final = ("score true place", "score lookalike")
_WEIGHTS: Final = 2  # of the panels
_LEAST_SHARE: Final = 5e-4  # that is not 0.0 %
# Right edges of the columns of numbers, inches from the left: shares, weight, scores.
_COLUMNS: Final = (2.3, 3.0, 3.7, 4.3, 5.25, 6.05)
_TERMS_AT: Final = (6.65, 8.75, 9.65, 10.55)  # left edge of the names, right edges of the numbers
_NOTE_CHARS: Final = 100


@dataclass(frozen=True, kw_only=True)
class LookalikeSheet:
    """Content of the picture.

    Parameters
    ----------
    title, facts : str
        The line above, and the one below it.
    view, mapped, lookalike : Evidence
        What is seen; what the map shows there; what it shows at the other place.
    weights : ndarray of float, shape (rows, cols)
        Of the map at the true place, nats for 100 m2.
    top : float
        End of the colours.
    worth : mapping of str to float
        Of each class, where its surroundings are as rare as the map's mean.
    scores, terms : pandas.DataFrame
        As those of `lookalike.Lookalike`.
    panels : tuple of str
        A title for each of the four panels.
    worth_name : str
        What the weight of a class is called.
    note : str
        How the places were chosen.
    """

    title: str
    facts: str
    view: Evidence
    mapped: Evidence
    lookalike: Evidence
    weights: NDArray[np.float32]
    top: float
    worth: Mapping[str, float]
    scores: pd.DataFrame
    terms: pd.DataFrame
    panels: tuple[str, str, str, str]
    worth_name: str
    note: str


def draw_lookalike(path: Path, sheet: LookalikeSheet) -> None:
    """Draw a view, the map there, its weights and the lookalike as PNG, with the scores of both places below."""
    rows = _told(sheet.scores)
    below = 0.5 + _ROW * max(len(rows) + 3, 13)  # colour bar, table, attribution
    height = 0.98 + _SIDE + below
    figure = PlainFigure(figsize=(_WIDTH, height), dpi=_DPI, facecolor="white")
    FigureCanvasAgg(figure)
    words(figure, sheet.title, sheet.facts)
    pictures: tuple[NDArray[np.generic], ...] = (
        *(paint(sheet.view), paint(sheet.mapped)),
        *(sheet.weights, paint(sheet.lookalike)),
    )
    for at, (picture, title) in enumerate(zip(pictures, sheet.panels, strict=True)):
        box = ((_LEFT + at * (_SIDE + _GAP)) / _WIDTH, below / height, _SIDE / _WIDTH, _SIDE / height)
        chart = figure.add_axes(box)
        is_weight = at == _WEIGHTS
        drawn = picture_of(chart, picture, sheet.view.size_m, title, top=sheet.top if is_weight else None)
        if at == 0:
            scale_bar(chart, *sheet.view.size_m)
        if is_weight:
            bar = figure.add_axes((box[0], (below - 0.2) / height, box[2], 0.12 / height))
            colour_bar(figure, drawn, bar)
    _class_rows(figure, sheet, rows, top=below - 0.32)
    _term_rows(figure, sheet, top=below - 0.78)
    _text(figure, _LEFT, 0.1, ATTRIBUTION, fontsize=8.5)
    figure.savefig(path, format="png", metadata={"Title": sheet.title, "Copyright": ATTRIBUTION, "Software": None})


def _told(scores: pd.DataFrame) -> list[str]:
    """Return the classes that cover some ground in view or on the map."""
    return scores.index[(scores[list(_SHARES)] >= _LEAST_SHARE).any(axis=1)].tolist()


def _text(figure: Figure, left: float, up: float, text: str, **look: Any) -> None:  # noqa: ANN401 - of matplotlib
    """Write words at a place in inches from the lower left corner."""
    at = (left / _WIDTH, up / figure.get_figheight())
    figure.text(*at, text, **{"fontsize": 8.0, "va": "baseline", **look})


def _class_rows(figure: Figure, sheet: LookalikeSheet, rows: list[str], *, top: float) -> None:
    """Draw legend and table in one: a row for each class."""
    heads = ("view", "map there", "lookalike", sheet.worth_name, "true place", "lookalike")
    for left, title in ((_COLUMNS[2], "covers, % of the ground"), (_COLUMNS[5], "raster score (Eq. 8), nats")):
        _text(figure, left, top, title, color=_GREY, ha="right")
    for right, head in zip(_COLUMNS, heads, strict=True):
        _text(figure, right, top - _ROW, head, ha="right", color=_GREY)
    titles = {item.name: (item.title, item.colour) for item in load_taxonomy().classes}
    told = sheet.scores.to_dict("index")
    for number, name in enumerate(rows):
        up = top - _ROW * (number + 2)
        said, colour = titles[name]
        box = (_LEFT / _WIDTH, up / figure.get_figheight())
        size = (0.14 / _WIDTH, 0.1 / figure.get_figheight())
        figure.add_artist(Rectangle(box, *size, facecolor=colour, edgecolor="#666666", lw=0.4))
        _text(figure, _LEFT + 0.2, up, said)
        row = told[name]
        values = (
            *(f"{100 * row[column]:.1f}" for column in _SHARES),
            f"{sheet.worth[name]:.2f}",
            *(_signed(row[column]) for column in _SCORES),
        )
        for right, value in zip(_COLUMNS, values, strict=True):
            _text(figure, right, up, value, ha="right")


def _term_rows(figure: Figure, sheet: LookalikeSheet, *, top: float) -> None:
    """Draw the terms of the joint score at both places, and how the places were chosen."""
    left, *rights = _TERMS_AT
    for right, head in zip(rights, (*sheet.terms.columns, "difference"), strict=True):
        _text(figure, right, top, head, ha="right", color=_GREY)
    _text(figure, left, top, "terms of Eq. 11, nats", color=_GREY)
    for number, (name, values) in enumerate(zip(sheet.terms.index, sheet.terms.to_numpy(), strict=True)):
        up = top - _ROW * (number + 1)
        weight = "bold" if number == len(sheet.terms) - 1 else "normal"
        _text(figure, left, up, name, fontweight=weight)
        for right, value in zip(rights, (*values, values[0] - values[1]), strict=True):
            _text(figure, right, up, _signed(value), ha="right", fontweight=weight)
    for number, line in enumerate(wrap(sheet.note, _NOTE_CHARS)):
        _text(figure, left, top - _ROW * (len(sheet.terms) + 1.6 + 0.85 * number), line, fontsize=7.5, color=_GREY)


def _signed(value: float) -> str:
    return f"{value + 0.0:+.1f}" if abs(value) >= 0.05 else "0.0"  # noqa: PLR2004 - half of the last digit
