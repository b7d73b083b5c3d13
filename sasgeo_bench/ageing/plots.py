# SPDX-License-Identifier: Apache-2.0
"""Draw `ageing.svg`: yearly rates of each class with their intervals, and the result of comparing ids instead."""

from functools import partial
from pathlib import Path
from typing import Final

import matplotlib as mpl
import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.lines import Line2D
from matplotlib.ticker import FixedLocator, FuncFormatter, NullLocator

from sasgeo_bench.ageing.measure import Ageing
from sasgeo_bench.core.canvas import Page, page
from sasgeo_bench.osm.taxonomy import load_taxonomy
from sasgeo_bench.regions.region import ATTRIBUTION

_RANGE: Final = (0.01, 100.0)  # %/year: values beyond are drawn at the edges
_TICKS: Final = (0.01, 0.1, 1.0, 10.0, 100.0)
_POOLED: Final = "#000000"
_WHOLE: Final = "#d55e00"
_BY_ID: Final = "#0072b2"
_LATE: Final = 0.8  # of viridis: beyond, its yellow is too pale on white
_NOTE: Final = (
    "What appears may be mapping that catches up. Rates beyond the scale lie on its edges. "
    "Amount: ground or length; number and id: things."
)


def draw_ageing(path: Path, ageing: Ageing) -> None:
    """Draw the measurements of one place as an SVG; the same table gives the same bytes."""
    titles = {item.name: item.title for item in load_taxonomy().classes}
    names = list(dict.fromkeys(ageing.table["class"]))
    first, last = ageing.table["date_from"].min(), ageing.table["date_to"].max()
    about = Page(
        title=f"{ageing.place}: how the map aged",
        facts=f"{len(ageing.sources)} maps from {first:%Y-%m-%d} to {last:%Y-%m-%d}, {ageing.area_km2:,.1f} km2",
        note=_NOTE,
        data=ATTRIBUTION,
        columns=3,
        panel_inches=(3.1, 0.42 * len(names)),
        keys=_keys(),
    )
    with page(path, about) as ((vanished, appeared, gone),):
        _draw_rates(vanished, ageing.table, names, "vanish_per_year", "vanishes, % of the older map a year")
        _draw_rates(appeared, ageing.table, names, "appear_per_year", "appears, % of the newer map a year")
        _draw_shares(gone, ageing.table, names)
        for chart in (vanished, appeared, gone):
            chart.set_yticks(range(len(names)), [titles[name] for name in names])
            chart.tick_params(labelleft=chart is vanished)
            chart.set_ylim(len(names) - 0.5, -0.5)


def _draw_rates(chart: Axes, table: pd.DataFrame, names: list[str], column: str, title: str) -> None:
    rows = {name: number for number, name in enumerate(names)}
    chart.set_xscale("log")
    chart.set_xlim(_RANGE[0] * 0.75, _RANGE[1] * 1.3)
    middles = (table["date_from"] + (table["date_to"] - table["date_from"]) / 2).astype("int64").to_numpy()
    age = (middles - middles.min()) / max(np.ptp(middles), 1)
    shade = mpl.colormaps["viridis"]
    facts = zip(
        table["class"], table["span"], *(100 * table[f"{column}{end}"] for end in ("", "_lo", "_hi")), strict=True
    )
    for number, (name, span, value, *ends) in enumerate(facts):
        at = rows[name]
        if np.isnan(value):
            continue
        if span == "interval":
            colour = shade(_LATE * age[number])
            chart.plot(_within(value), at + 0.22, marker="o", color=colour, ms=4, ls="", mec="none", clip_on=False)
        elif span == "whole":
            chart.plot(_within(value), at, marker="D", color="none", mec=_WHOLE, ms=7, ls="", mew=1.4, zorder=4)
        else:
            chart.plot([_within(end) for end in ends], [at, at], color=_POOLED, lw=1.6, zorder=3)
            chart.plot(_within(value), at, marker="o", color=_POOLED, ms=5, ls="", zorder=5)
    chart.xaxis.set_major_locator(FixedLocator(_TICKS))
    chart.xaxis.set_minor_locator(NullLocator())
    chart.xaxis.set_major_formatter(FuncFormatter(_tick))
    if table[column].isna().all():
        chart.text(0.5, 0.5, "too short a time\nfor yearly rates", ha="center", va="center", transform=chart.transAxes)
    _dress(chart, title, len(names))


def _tick(value: float, _: object) -> str:
    beyond = {_RANGE[0]: "\u2264 ", _RANGE[1]: "\u2265 "}
    return f"{beyond.get(value, '')}{value:g}"


def _within(percent: float) -> float:
    """Clip a rate to the axis; NaN stays NaN and is not drawn."""
    return float(np.clip(percent, *_RANGE))


def _draw_shares(chart: Axes, table: pd.DataFrame, names: list[str]) -> None:
    """Draw what is gone by id, by geometry and by number, first map against last."""
    whole = table[table["span"] == "whole"].set_index("class").loc[names]
    columns = ("id_vanished_share", "vanished_share", "vanished_number_share")
    for at, (by_id, by_place, by_number) in enumerate(zip(*(100 * whole[name] for name in columns), strict=True)):
        ends = [end.reduce([by_id, by_place, by_number]) for end in (np.fmin, np.fmax)]
        chart.plot(ends, [at, at], color="#bbbbbb", lw=1.5, zorder=1)
        chart.plot(by_id, at, marker="s", color=_BY_ID, ms=6, ls="", zorder=3)
        chart.plot(by_number, at, marker="o", color="none", mec=_WHOLE, ms=5, ls="", mew=1.4, zorder=4)
        chart.plot(by_place, at, marker="D", color="white", mec=_WHOLE, ms=7, ls="", mew=1.4, zorder=2)
    chart.set_xlim(-3, 103)
    _dress(chart, "gone from first map to last, %", len(names))


def _dress(chart: Axes, title: str, rows: int) -> None:
    chart.set_title(title)
    chart.grid(visible=True, axis="x", color="#dddddd", lw=0.7)
    for at in range(0, rows, 2):
        chart.axhspan(at - 0.5, at + 0.5, color="#f6f6f6", lw=0, zorder=0)
    chart.tick_params(axis="y", length=0)
    chart.spines["left"].set_visible(False)


def _keys() -> list[Line2D]:
    mark = partial(Line2D, [], [], ls="", marker="o")
    return [
        Line2D([], [], color=_POOLED, marker="o", ms=5, lw=1.6, label="rate over all intervals, 95 %"),
        mark(color=mpl.colormaps["viridis"](0.0), ms=4, label="one interval, early"),
        mark(color=mpl.colormaps["viridis"](_LATE), ms=4, label="one interval, late"),
        Line2D(
            [],
            [],
            color="white",
            mec=_WHOLE,
            ls="",
            marker="D",
            ms=7,
            mew=1.4,
            label="first map to last, by geometry (amount)",
        ),
        mark(color="none", mec=_WHOLE, ms=5, mew=1.4, label="the same, by number"),
        Line2D([], [], color=_BY_ID, marker="s", ms=6, ls="", label="by id"),
    ]
