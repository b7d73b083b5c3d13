# SPDX-License-Identifier: Apache-2.0
"""Contact sheets: the views of queries, the map at the true place, the difference, and the map at a twin or decoy."""

import math
from collections.abc import Collection, Sequence
from dataclasses import dataclass
from pathlib import Path
from textwrap import wrap
from typing import Final

import cv2
import numpy as np
import shapely
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure
from numpy.typing import NDArray

from sasgeo_bench.canvas import PlainFigure
from sasgeo_bench.osm.taxonomy import load_taxonomy
from sasgeo_bench.regions.evidence import PRESENT, UNKNOWN, Evidence
from sasgeo_bench.regions.preview import GROUND, PAINT_ORDER
from sasgeo_bench.regions.region import ATTRIBUTION
from sasgeo_bench.tasks.query import PUBLISHED, TWIN_EAST, TWIN_NORTH, PriorGroup, Query, Truth
from sasgeo_bench.tasks.suites.rivals import IN_DISC, LEAD, LISTED, RIVALS, TRUTH_LISTED

HIDDEN: Final = "#9e9e9e"
ONLY_SEEN: Final = "#c2185b"
ONLY_MAPPED: Final = "#1565c0"
AGREE: Final = "#d9d9d9"
TWIN: Final = "map at the twin"
DECOY: Final = "map at the hardest decoy"
_OF_TWIN: Final = (TWIN_EAST, TWIN_NORTH, RIVALS, IN_DISC, LISTED, TRUTH_LISTED, LEAD)  # told in words
_COLUMNS: Final = ("view", "map at the true place", "view against map")
_CELL_INCHES: Final = 2.4
_TEXT_INCHES: Final = 3.0  # width of the text column, readable when the sheet is shown smaller
_DPI: Final = 100


@dataclass(frozen=True, kw_only=True)
class Panel:
    """One row of a sheet: a query, its truth, and the map at the true place and at a rival; None without such a place.

    `rival` names the other place: the twin that a suite made of the true place, or a similar decoy.
    """

    query: Query
    truth: Truth
    at_truth: Evidence | None
    at_decoy: Evidence | None
    rival: str = DECOY


def paint(evidence: Evidence) -> NDArray[np.float64]:
    """Return colours of a view, shape (rows, cols, 3), 0..1; grey in proportion to the unknown classes."""
    picture = np.empty((*evidence.shape, 3))
    picture[:] = to_rgb(GROUND)
    colours = {item.name: to_rgb(item.colour) for item in load_taxonomy().classes}
    for name in PAINT_ORDER:
        if name in evidence.classes:
            picture[evidence.layer(name) == PRESENT] = colours[name]
    unknown = (evidence.cells == UNKNOWN).mean(axis=0)[..., None]
    return np.asarray(picture * (1 - unknown) + np.array(to_rgb(HIDDEN)) * unknown)


def paint_difference(seen: Evidence, mapped: Evidence) -> NDArray[np.float64]:
    """Return colours for cells that view and map share, that only the view has, and that only the map has."""
    known = (seen.cells != UNKNOWN) & (mapped.cells != UNKNOWN)
    one, two = (known & (item.cells == PRESENT) for item in (seen, mapped))
    picture = np.empty((*seen.shape, 3))
    picture[:] = to_rgb(GROUND)
    picture[(one & two).any(axis=0)] = to_rgb(AGREE)
    picture[(two & ~one).any(axis=0)] = to_rgb(ONLY_MAPPED)
    picture[(one & ~two).any(axis=0)] = to_rgb(ONLY_SEEN)
    picture[~known.any(axis=0)] = to_rgb(HIDDEN)
    return picture


def write_sheet(path: Path, *, title: str, panels: Sequence[Panel]) -> None:
    """Write a contact sheet as PNG."""
    figure = sheet_figure(title, panels)
    FigureCanvasAgg(figure)
    figure.savefig(path, format="png", metadata={"Title": title, "Copyright": ATTRIBUTION, "Software": None})


def sheet_figure(title: str, panels: Sequence[Panel], *, dpi: int = _DPI) -> Figure:
    """Draw a contact sheet as a figure."""
    has_vectors = any(panel.query.vectors is not None for panel in panels)
    rivals = list(dict.fromkeys(panel.rival for panel in panels)) or [DECOY]
    has_pictures = any(panel.query.frames for panel in panels)
    columns = (
        *(("newest picture",) if has_pictures else ()),
        *(*_COLUMNS, " / ".join(rivals)),
        *(("perceived vectors",) if has_vectors else ()),
    )
    width, height = _TEXT_INCHES + 0.1 + _CELL_INCHES * len(columns), 1.2 + (_CELL_INCHES + 0.1) * len(panels)
    figure = PlainFigure(figsize=(width, height), dpi=dpi, facecolor="white")
    figure.text(0.15 / width, 1 - 0.12 / height, title, va="top", fontsize=13, fontweight="bold")
    legend = "view against map   pink: only seen   blue: only mapped   light grey: both   white: none   grey: unknown"
    figure.text(0.15 / width, 1 - 0.45 / height, legend, va="top", fontsize=9.5, color="#444444")
    _draw_legend(figure, width, height, {name for panel in panels for name in panel.query.evidence.classes})
    for at, panel in enumerate(panels):
        bottom = height - 1.15 - (_CELL_INCHES + 0.1) * at - _CELL_INCHES + 0.1
        text = "\n".join(line for part in _text(panel) for line in wrap(part, 36))  # letters per line of text
        figure.text(0.15 / width, (bottom + _CELL_INCHES - 0.15) / height, text, va="top", fontsize=10)
        pictures = (*((_photo(panel.query),) if has_pictures else ()), *_pictures(panel), None)[: len(columns)]
        for place, (name, picture) in enumerate(zip(columns, pictures, strict=True)):
            left = _TEXT_INCHES + _CELL_INCHES * place
            box = (left / width, bottom / height, (_CELL_INCHES - 0.1) / width, (_CELL_INCHES - 0.1) / height)
            chart = figure.add_axes(box)
            chart.set(xticks=[], yticks=[])
            if picture is not None:
                chart.imshow(picture, interpolation="nearest")
            elif name == "perceived vectors" and panel.query.vectors is not None:
                _draw_vectors(chart, panel.query)
            else:
                chart.text(0.5, 0.5, "none", ha="center", va="center", fontsize=9, transform=chart.transAxes)
            if at == 0:
                chart.set_title(name, fontsize=10, pad=3)
    figure.text(0.15 / width, 0.06 / height, ATTRIBUTION, fontsize=8)
    return figure


def _draw_legend(figure: Figure, width: float, height: float, classes: Collection[str]) -> None:
    left = 0.15
    for item in (one for one in load_taxonomy().classes if one.name in classes):
        name = item.name.replace("_", " ")
        figure.text(left / width, 1 - 0.66 / height, "\u25a0", va="top", fontsize=11, color=item.colour)
        figure.text((left + 0.15) / width, 1 - 0.67 / height, name, va="top", fontsize=8.5, color="#444444")
        left += 0.28 + 0.075 * len(name)


def _photo(query: Query) -> NDArray[np.float64] | None:
    """Return the newest picture of a query, colours 0..1, about as fine as it is shown; None without one."""
    if not query.frames:
        return None
    rgb = query.frames[-1].image().rgb
    step = max(1, round(rgb.shape[0] / (_CELL_INCHES * _DPI)))
    return np.asarray(cv2.resize(rgb, (rgb.shape[1] // step, rgb.shape[0] // step), interpolation=cv2.INTER_AREA) / 255)


def _pictures(panel: Panel) -> tuple[NDArray[np.float64] | None, ...]:
    seen, mapped, decoy = panel.query.evidence, panel.at_truth, panel.at_decoy
    return (
        paint(seen),
        None if mapped is None else paint(mapped),
        None if mapped is None else paint_difference(seen, mapped),
        None if decoy is None else paint(decoy),
    )


def _draw_vectors(chart: Axes, query: Query) -> None:
    """Draw lines and outlines in the colours of their classes; bridges are dotted."""
    colours = {item.name: item.colour for item in load_taxonomy().classes}
    vectors = query.vectors
    if vectors is None:
        return
    for name, is_bridge, shape in zip(vectors["class"], vectors["is_bridge"], vectors.geometry, strict=True):
        for line in shapely.get_parts(shapely.boundary(shape) if shapely.get_dimensions(shape) > 1 else shape):
            at = shapely.get_coordinates(line)
            chart.plot(at[:, 0], at[:, 1], color=colours[name], linewidth=1.0, linestyle=":" if is_bridge else "-")
    rows, cols = query.evidence.shape
    half_m = query.evidence.cell_size_m / 2
    chart.set(xlim=(-cols * half_m, cols * half_m), ylim=(-rows * half_m, rows * half_m), aspect="equal")


def strength_text(truth: Truth) -> str:
    """Return the strength of a query; for an older map its true age, since its date is only the nearest to the step.

    Examples
    --------
    >>> from types import SimpleNamespace
    >>> strength_text(SimpleNamespace(strength=5.0, strength_unit="years", measured={"age_years": 3.58}))
    'map 3.6 years old (step 5)'
    """
    age_years = truth.measured.get("age_years")
    if age_years is None:
        return f"strength {truth.strength:g} ({truth.strength_unit})"
    return f"map {age_years:.1f} years old (step {truth.strength:g})"


def rival_text(truth: Truth) -> str:
    """Return how far the twin of a place is and what a plain search lists; empty without a twin.

    Examples
    --------
    >>> from types import SimpleNamespace
    >>> told = {"twin_east_m": 300.0, "twin_north_m": -400.0, "rivals": 1, "rivals_listed": 1, "truth_listed": 0}
    >>> rival_text(SimpleNamespace(measured=told))
    'twin 500 m away; a plain search lists the twin alone'
    """
    told = truth.measured
    if TWIN_EAST not in told:
        return ""
    away = f"twin {math.hypot(told[TWIN_EAST], told[TWIN_NORTH]):.0f} m away"
    if RIVALS not in told:
        return away
    is_rival, is_truth = told[LISTED] == told[RIVALS], told[TRUTH_LISTED] == 1
    both = {(True, True): "both", (True, False): "the twin alone", (False, True): "the place alone"}
    return f"{away}; a plain search lists {both.get((is_rival, is_truth), 'neither')}"


def _known_text(query: Query) -> str:
    """Return what a query tells besides its view: its place in a flight, or its priors, candidates and vectors."""
    if query.step is not None:
        known = f", {PriorGroup.parse(query.prior_group).words}" if query.step.frame == 0 else ""
        return f"view {query.step.frame} of flight {query.step.sequence_id}{known}"
    vectors = f", {len(query.vectors)} vectors" if query.vectors is not None else ""
    return f"{PriorGroup.parse(query.prior_group).words}; {len(query.candidates)} candidates{vectors}"


def _text(panel: Panel) -> tuple[str, ...]:
    query, truth = panel.query, panel.truth
    rows, cols = query.evidence.shape
    alias = "" if truth.alias_index is None else f", alias {truth.alias_index:.2f}"
    measured = ", ".join(f"{name} {value:.3g}" for name, value in truth.measured.items() if name not in _OF_TWIN)
    return (
        f"{truth.role}: {truth.kind}" + (f", detector {truth.detector}" if truth.detector != PUBLISHED else ""),
        strength_text(truth),
        f"{query.track}, {rows} x {cols} cells of {query.evidence.cell_size_m:g} m",
        _known_text(query),
        "present" if truth.is_present else "ABSENT",
        f"unknown {truth.unknown_share:.2f}, changed {truth.changed_share:.2f}{alias}",
        rival_text(truth),
        f"measured: {measured}" if measured else "",
        f"{truth.block}, {query.query_id[:8]}",
    )
