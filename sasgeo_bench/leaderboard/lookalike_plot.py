# SPDX-License-Identifier: Apache-2.0
"""Fig. 1 of the SASGeo paper from a real extract: a view, the map there, its weights, and the place it resembles."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from numpy.typing import NDArray

from sasgeo_bench.canvas import GREY, Page, new_figure, styled
from sasgeo_bench.osm.taxonomy import load_taxonomy
from sasgeo_bench.regions.evidence import Evidence
from sasgeo_bench.regions.preview import scale_bar
from sasgeo_bench.regions.region import ATTRIBUTION
from sasgeo_bench.sasgeo.weight_plot import colour_bar, picture_of
from sasgeo_bench.tasks.sheet import paint

_DPI: Final = 130
_SIDE: Final = 2.95  # of a panel, inches
_ROW: Final = 0.175  # of a table, inches
_SHARES: Final = ("share view", "share true place", "share lookalike")
_SCORES: Final = ("score true place", "score lookalike")
_LEAST_SHARE: Final = 5e-4  # that is not 0.0 %
# Left edges of a table's columns of words, right edges of those of numbers; shares of its width.
_CLASS_COLUMNS: Final = ((0.0, 0.03), (0.4, 0.52, 0.64, 0.75, 0.87, 0.98))
_TERM_COLUMNS: Final = ((0.05,), (0.48, 0.66, 0.84))


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
    class_weights : mapping of str to float
        Of each class, where its surroundings are as rare as the map's mean.
    scores, terms : pandas.DataFrame
        As those of `lookalike.Lookalike`.
    panels : tuple of str
        A title for each of the four panels.
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
    class_weights: Mapping[str, float]
    scores: pd.DataFrame
    terms: pd.DataFrame
    panels: tuple[str, str, str, str]
    note: str


def draw_lookalike(path: Path, sheet: LookalikeSheet) -> None:
    """Draw a view, the map there, its weights and the lookalike as PNG, with the scores of both places below."""
    shown = _shown(sheet.scores)
    about = Page(title=sheet.title, data=ATTRIBUTION, facts=sheet.facts, note=sheet.note, dpi=_DPI)
    tables = _ROW * (len(shown) + 2)
    mosaic = (("view", "mapped", "weights", "lookalike"), ("classes", "classes", "terms", "terms"))
    with styled():
        figure = new_figure((4 * (_SIDE + 0.15), _SIDE + tables + 2.3), dpi=_DPI)
        charts = figure.framed(about).subplot_mosaic(mosaic, height_ratios=(_SIDE, tables))
        pictures: tuple[NDArray[np.generic], ...] = (
            paint(sheet.view),
            paint(sheet.mapped),
            sheet.weights,
            paint(sheet.lookalike),
        )
        for name, picture, title in zip(mosaic[0], pictures, sheet.panels, strict=True):
            top = sheet.top if name == "weights" else None
            drawn = picture_of(charts[name], picture, sheet.view.size_m, title, top=top)
            if top is not None:
                colour_bar(charts[name], drawn)
        scale_bar(charts["view"], *sheet.view.size_m)
        for name in ("classes", "terms"):
            charts[name].axis("off")
            charts[name].set(xlim=(0, 1), ylim=(len(shown) + 1.5, -0.5))
        _draw_classes(charts["classes"], sheet, shown)
        _draw_terms(charts["terms"], sheet.terms)
        figure.write(path, about)


def _shown(scores: pd.DataFrame) -> list[str]:
    """Return the classes that cover some ground in view or on the map."""
    return scores.index[(scores[list(_SHARES)] >= _LEAST_SHARE).any(axis=1)].tolist()


def _draw_row(
    chart: Axes,
    number: int,
    texts: Sequence[str],
    columns: tuple[Sequence[float], Sequence[float]],
    **look: Any,  # noqa: ANN401 - of matplotlib
) -> None:
    """Write a row of a table: words to the right of their edges, numbers to the left."""
    lefts, rights = columns
    sides = [*(("left", at) for at in lefts), *(("right", at) for at in rights)]
    for (side, at), text in zip(sides, texts, strict=True):
        chart.text(at, number, text, ha=side, va="center", **look)


def _draw_classes(chart: Axes, sheet: LookalikeSheet, shown: Sequence[str]) -> None:
    """Draw legend and table in one: a row for each class."""
    groups = ("", "", "", "", "covers, % of the ground", "", "", "raster score (Eq. 8), nats")
    heads = ("", "", "view", "map there", "lookalike", "weight", "true place", "lookalike")
    for number, row in enumerate((groups, heads)):
        _draw_row(chart, number, row, _CLASS_COLUMNS, color=GREY)
    classes = {item.name: item for item in load_taxonomy().classes}
    all_scores = sheet.scores.to_dict("index")
    for number, name in enumerate(shown, start=2):
        scores = all_scores[name]
        numbers = (
            *(f"{100 * scores[column]:.1f}" for column in _SHARES),
            f"{sheet.class_weights[name]:.2f}",
            *(_signed(scores[column]) for column in _SCORES),
        )
        _draw_row(chart, number, ("", classes[name].title, *numbers), _CLASS_COLUMNS)
        chart.plot(0.01, number, marker="s", ms=6.5, color=classes[name].colour, mec="#666666", mew=0.4)


def _draw_terms(chart: Axes, terms: pd.DataFrame) -> None:
    """Draw the terms of the joint score at both places."""
    _draw_row(chart, 1, ("terms of Eq. 11, nats", *terms.columns, "difference"), _TERM_COLUMNS, color=GREY)
    for number, (name, values) in enumerate(zip(terms.index, terms.to_numpy(), strict=True), start=2):
        weight = "bold" if number == len(terms) + 1 else "normal"
        numbers = [_signed(value) for value in (*values, values[0] - values[1])]
        _draw_row(chart, number, (name, *numbers), _TERM_COLUMNS, fontweight=weight)


def _signed(value: float) -> str:
    return f"{value + 0.0:+.1f}" if abs(value) >= 0.05 else "0.0"  # noqa: PLR2004 - half of the last digit
