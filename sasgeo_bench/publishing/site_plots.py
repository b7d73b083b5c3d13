# SPDX-License-Identifier: Apache-2.0
"""Figures that a site has besides those of its board: maps of its places, and rates of ageing.

Coastlines: Natural Earth, 1:110m physical vectors (land), public domain.
"""

import json
from collections.abc import Sequence
from importlib import resources
from pathlib import Path
from typing import Final

import numpy as np
from matplotlib.axes import Axes

from sasgeo_bench.ageing.ratebook import Estimate, RateBook
from sasgeo_bench.canvas import GREY, page
from sasgeo_bench.leaderboard.board_plots import FAINT, BoardPage, line_keys, look_of
from sasgeo_bench.osm.taxonomy import load_taxonomy
from sasgeo_bench.publishing.site_pages import PlaceOnMap

_FEATURE: Final = json.loads(resources.files("sasgeo_bench.publishing").joinpath("coast.geojson").read_text("utf-8"))
# Longitude and latitude of each line, shape (N, 2), degrees.
COASTS: Final = tuple(np.array(line, dtype=float) for line in _FEATURE["geometry"]["coordinates"])


_EUROPE: Final = (-25.0, 45.0, 34.0, 72.0)  # west, east, south, north; degrees
_MARGIN_DEG: Final = 3.0
_RATES: Final = (0.05, 100.0)  # % a year; what lies beyond is drawn at the edge
_STEP: Final = 0.13  # between two places of a class
_LABEL_POINTS: Final = 6.5


def draw_places(path: Path, places: Sequence[PlaceOnMap]) -> None:
    """Draw the places of a board on a map into a .svg or .png; Europe also alone where some lie elsewhere."""
    parts = sorted({item.part for item in places})
    near = [item for item in places if _is_near(item)]
    panels = [("all places", list(places))]
    if 1 < len(near) < len(places):
        panels.append(("those in Europe", near))
    about = BoardPage(
        title="Places of this board",
        note="Numbers: as in the table. Hollow: made-up towns, which lie where they lie only so that they have "
        "coordinates. Plain longitude and latitude; coasts: Natural Earth.",
        below="longitude (deg)",
        columns=len(panels),
        panel_inches=(3.6, 2.9) if len(panels) > 1 else (5.4, 3.2),
        keys=line_keys([_part_name(part) for part in parts]),
    )
    with page(path, about) as charts:
        for chart, (title, some) in zip(charts[0], panels, strict=True):
            chart.set_title(f"{title} (n = {len(some)})")
            _draw_spots(chart, some, parts)
        charts[0][0].set_ylabel("latitude (deg)")


def _is_near(place: PlaceOnMap) -> bool:
    west, east, south, north = _EUROPE
    return west <= place.longitude_deg <= east and south <= place.latitude_deg <= north


def _part_name(part: str) -> str:
    if not part:
        return "no part"
    return f"half {part}" if len(part) == 1 else part


def _draw_spots(chart: Axes, places: Sequence[PlaceOnMap], parts: Sequence[str]) -> None:
    lon, lat = (np.array([getattr(item, name) for item in places]) for name in ("longitude_deg", "latitude_deg"))
    for item in places:
        look = look_of(parts.index(item.part))
        fill = "white" if item.is_made_up else look.colour
        at = (item.longitude_deg, item.latitude_deg)
        chart.plot(*at, marker=look.mark, ms=5, mec=look.colour, mfc=fill, ls="")
        chart.annotate(
            str(item.number), at, xytext=(3.5, 3.0), textcoords="offset points", fontsize=_LABEL_POINTS, color=GREY
        )
    for line in COASTS:
        chart.plot(line[:, 0], line[:, 1], color=GREY, lw=0.5, alpha=0.6, zorder=1)
    for values, limits in ((lon, chart.set_xlim), (lat, chart.set_ylim)):
        limits(float(values.min()) - _MARGIN_DEG, float(values.max()) + _MARGIN_DEG)
    chart.grid(visible=True, color=FAINT, lw=0.6)


def draw_rates(path: Path, book: RateBook) -> None:
    """Draw into a .svg or .png what vanishes and what appears in a year, by class, a mark for each measured place."""
    titles = {item.name: item.title for item in load_taxonomy().classes}
    names = [name for name in titles if any(name in place.classes for place in book.places)]
    about = BoardPage(
        title=f"How fast maps grow old: {len(book.places)} places",
        note="Bars: 95 % intervals, from blocks of 1 km. Rates beyond the scale lie at its edge. What appears is "
        "mostly mapping that catches up. How many things each rate is of stands in the table.",
        below="per cent a year",
        columns=2,
        panel_inches=(3.1, 0.3 + 0.29 * len(names)),
        keys=line_keys(book.names),
    )
    with page(path, about) as charts:
        for chart, (column, title) in zip(
            charts[0],
            (("vanish_per_year", "vanishes, of the older map"), ("appear_per_year", "appears, of the newer map")),
            strict=True,
        ):
            for at, name in enumerate(names):
                for number, place in enumerate(book.places):
                    found = place.classes.get(name)
                    rate = None if found is None else getattr(found, column)
                    if rate is not None:
                        _draw_rate(chart, rate, at + _STEP * (number - (len(book.places) - 1) / 2), number)
            chart.set_title(title)
            chart.set_xscale("log")
            chart.set_xlim(_RATES[0] * 0.8, _RATES[1] * 1.2)
            chart.set_xticks([0.1, 1.0, 10.0, 100.0], ["0.1", "1", "10", "100"])
            chart.set_ylim(len(names) - 0.5, -0.5)
            chart.set_yticks(range(len(names)), [titles[name] for name in names])
            chart.tick_params(axis="y", length=0)
            chart.grid(visible=True, axis="x", color=FAINT, lw=0.6)
        charts[0][1].set_yticklabels([])


def _draw_rate(chart: Axes, rate: Estimate, at: float, number: int) -> None:
    look = look_of(number)
    if rate.lo is not None and rate.hi is not None:
        chart.hlines(at, _within(rate.lo), _within(rate.hi), color=look.colour, lw=0.9)
    chart.plot(_within(rate.best), at, marker=look.mark, ms=3.2, color=look.colour, ls="")


def _within(per_year: float) -> float:
    """Return a rate in per cent, clipped to the axis."""
    return float(np.clip(100 * per_year, *_RATES))
