# SPDX-License-Identifier: Apache-2.0
"""Pictures of the weights of a map: of a region, and parts for the picture of a place and its lookalike."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Colormap, Normalize
from matplotlib.figure import Figure
from matplotlib.patches import Patch
from numpy.typing import NDArray

from sasgeo_bench.canvas import PlainFigure
from sasgeo_bench.osm.taxonomy import load_taxonomy
from sasgeo_bench.regions.evidence import ABSENT, PRESENT, UNKNOWN, Evidence
from sasgeo_bench.regions.preview import north_arrow, scale_bar
from sasgeo_bench.regions.region import Manifest
from sasgeo_bench.tasks.sheet import GROUND, HIDDEN, paint

UNIT: Final = "nats for 100 m\u00b2"
_MOST_CELLS: Final = 900  # of a picture's side
_TOP_PERCENTILE: Final = 99.0  # of what is drawn; a few cells beyond it take its colour
_MAP_INCHES: Final = 6.6
_LEAST_INCHES: Final = 4.6
_LEGEND_INCHES: Final = 2.7
_DPI: Final = 110
_GREY: Final = "#444444"


@dataclass(frozen=True, kw_only=True)
class WeightSheet:
    """A region and the weights of its cells.

    `layers` are those of the region; `weights`, shape (rows, cols), are nats for 100 m2, NaN where nothing is known;
    `worth` holds the weight of each class at mean rarity; `top` is the end of the colours (see `top_of`); `facts` is a
    line on age, season and weights.
    """

    manifest: Manifest
    layers: NDArray[np.uint8]
    weights: NDArray[np.float32]
    worth: Mapping[str, float]
    top: float
    facts: str


def top_of(weights: Sequence[NDArray[np.float32]]) -> float:
    """Return a common end of the colours of several maps: a high percentile of all positive weights."""
    drawn = [one[one > 0] for one in weights]
    found = np.concatenate(drawn) if drawn else np.zeros(0)
    return float(np.percentile(found, _TOP_PERCENTILE)) if len(found) else 1.0


def shrunk(layers: NDArray[np.uint8], *, most_cells: int = _MOST_CELLS) -> NDArray[np.uint8]:
    """Return layers, shape (C, rows, cols), of limited size: a class is present where any cell of a square has it."""
    factor = _factor(layers.shape[1:], most_cells)
    known = [np.where(layer == PRESENT, 2, np.where(layer > PRESENT, 0, 1)).astype(np.uint8) for layer in layers]
    most = np.stack([_blocks(layer, factor).max(axis=(1, 3)) for layer in known])
    return np.asarray(np.array([UNKNOWN, ABSENT, PRESENT], dtype=np.uint8)[most], dtype=np.uint8)


def _factor(shape: tuple[int, ...], most_cells: int) -> int:
    return -(-max(shape) // most_cells)


def _blocks(raster: NDArray[np.generic], factor: int) -> NDArray[np.generic]:
    """Return squares of a raster on axes 1 and 3, padded with the edge."""
    padded = np.pad(raster, ((0, -raster.shape[0] % factor), (0, -raster.shape[1] % factor)), mode="edge")
    return padded.reshape(padded.shape[0] // factor, factor, padded.shape[1] // factor, factor)


def weight_colours() -> Colormap:
    """Return the colours of weights: paper for 0, dark for high, grey for unknown."""
    steps = mpl.colormaps["magma_r"](np.linspace(0.04, 1.0, 255))
    colours = mpl.colors.ListedColormap([mpl.colors.to_rgba(GROUND), *steps])
    colours.set_bad(HIDDEN)
    return colours


def draw_weights(path: Path, sheet: WeightSheet) -> None:
    """Write a PNG of the classes of a region and, next to them, the weight of each cell."""
    about = sheet.manifest
    factor = _factor(sheet.weights.shape, _MOST_CELLS)
    filled = np.where(np.isnan(sheet.weights), -1, sheet.weights)
    weights = _blocks(filled, factor).max(axis=(1, 3))
    side_m = (about.cols * about.cell_size_m, about.rows * about.cell_size_m)
    scale = _MAP_INCHES / max(side_m)
    wide, high = max(side_m[0] * scale, 2.2), max(side_m[1] * scale, _LEAST_INCHES)
    total = (2 * wide + _LEGEND_INCHES + 0.75, high + 1.75)
    figure = PlainFigure(figsize=total, dpi=_DPI, facecolor="white")
    FigureCanvasAgg(figure)
    place = Evidence(classes=about.classes, cells=shrunk(sheet.layers), cell_size_m=about.cell_size_m * factor)
    charts = [
        figure.add_axes((left / total[0], 0.75 / total[1], wide / total[0], high / total[1]))
        for left in (0.25, wide + 0.4)
    ]
    picture_of(charts[0], paint(place), side_m, "what is mapped")
    mapped = picture_of(charts[1], np.where(weights < 0, np.nan, weights), side_m, "what it weighs: w", top=sheet.top)
    scale_bar(charts[0], *side_m)
    north_arrow(charts[0], *side_m)
    words(
        figure, f"{about.title} ({about.id}): weight of the evidence", f"map of {about.extract.date}  |  {sheet.facts}"
    )
    bar = figure.add_axes(((wide + 0.4) / total[0], 0.56 / total[1], wide / total[0], 0.13 / total[1]))
    colour_bar(figure, mapped, bar)
    keys = _class_keys({name: f"  {sheet.worth[name]:.2f}" for name in about.classes if about.counts.get(name)})
    if np.isnan(sheet.weights).any():
        keys.append(Patch(facecolor=HIDDEN, edgecolor="#666666", lw=0.4, label="not mapped (unknown)"))
    legend = figure.legend(
        handles=keys,
        loc="upper left",
        bbox_to_anchor=((2 * wide + 0.6) / total[0], (0.75 + high) / total[1]),
        frameon=False,
        fontsize=9,
        title="class, and its weight where\nits surroundings are as rare\nas the map's mean (\u03bd = 1)",
        borderaxespad=0,
        alignment="left",
    )
    legend.get_title().set_fontsize(9)
    note = "w sums over the classes of a cell; each dot is the strongest of its cells"
    figure.text(0.25 / total[0], 0.38 / total[1], note, fontsize=8.5, va="bottom", color=_GREY)
    figure.text(0.25 / total[0], 0.1 / total[1], about.attribution, fontsize=9, va="bottom")
    figure.savefig(
        path, format="png", metadata={"Title": about.title, "Copyright": about.attribution, "Software": None}
    )


def picture_of(
    chart: Axes, picture: NDArray[np.generic], side_m: tuple[float, float], title: str, *, top: float | None = None
) -> ScalarMappable:
    """Draw a raster in metres without ticks; values from 0 to `top` by the colours of weights."""
    box = (0.0, side_m[0], 0.0, side_m[1])
    chart.set_xticks([])
    chart.set_yticks([])
    chart.set_title(title, fontsize=9.5, pad=4, loc="left")
    if top is None:
        return chart.imshow(picture, extent=box, interpolation="nearest")
    return chart.imshow(picture, extent=box, interpolation="nearest", cmap=weight_colours(), norm=Normalize(0, top))


def colour_bar(figure: Figure, mapped: ScalarMappable, bar: Axes) -> None:
    """Draw the colour bar of weights."""
    drawn = figure.colorbar(mapped, cax=bar, orientation="horizontal", extend="max", extendfrac=0.03)
    drawn.ax.tick_params(labelsize=8, length=2, pad=2)
    drawn.set_label(f"w = \u03c3\u03bd, {UNIT} that are mapped and seen", fontsize=8.5, labelpad=1)


def words(figure: Figure, title: str, facts: str) -> None:
    """Write the title and a line of facts."""
    width, height = figure.get_size_inches()
    figure.text(0.25 / width, 1 - 0.12 / height, title, va="top", fontsize=13, fontweight="bold")
    figure.text(0.25 / width, 1 - 0.45 / height, facts, va="top", fontsize=9, color=_GREY)


def _class_keys(values: Mapping[str, str]) -> list[Patch]:
    return [
        Patch(facecolor=item.colour, edgecolor="#666666", lw=0.4, label=item.title + values[item.name])
        for item in load_taxonomy().classes
        if item.name in values
    ]
