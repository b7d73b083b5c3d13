# SPDX-License-Identifier: Apache-2.0
"""Pictures of the weights of the map of a region."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Colormap, Normalize
from matplotlib.patches import Patch
from numpy.typing import NDArray

from sasgeo_bench.core.canvas import Page, page, without_ticks
from sasgeo_bench.regions.evidence import ABSENT, PRESENT, UNKNOWN, Evidence
from sasgeo_bench.regions.painting import GROUND, HIDDEN, paint_evidence
from sasgeo_bench.regions.preview import class_keys, north_arrow, scale_bar
from sasgeo_bench.regions.region import Manifest

UNIT: Final = "nats for 100 m\u00b2"
_MOST_CELLS: Final = 900  # of a picture's side
_MAP_INCHES: Final = 6.6
_LEAST_INCHES: Final = 2.2
_KEYS: Final = "Legend: class, and its weight where its surroundings are as rare as the map's mean (\u03bd = 1)"


@dataclass(frozen=True, kw_only=True)
class WeightSheet:
    """A region and the weights of its cells.

    `layers` are those of the region; `weights`, shape (rows, cols), are nats for 100 m2, NaN where nothing is known;
    `class_weights` holds the weight of each class at mean rarity; `top` is the end of the colours (see `top_of`);
    `facts` is a line on age, season and weights.
    """

    manifest: Manifest
    layers: NDArray[np.uint8]
    weights: NDArray[np.float32]
    class_weights: Mapping[str, float]
    top: float
    facts: str


def top_of(weights: Sequence[NDArray[np.float32]]) -> float:
    """Return a common end of the colours of several maps: a high percentile of all positive weights."""
    drawn = [one[one > 0] for one in weights]
    found = np.concatenate(drawn) if drawn else np.zeros(0)
    # 99: top percentile of what is drawn; a few cells beyond it take its colour
    return float(np.percentile(found, 99.0)) if len(found) else 1.0


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
    region = sheet.manifest
    factor = _factor(sheet.weights.shape, _MOST_CELLS)
    filled = np.where(np.isnan(sheet.weights), -1, sheet.weights)
    weights = _blocks(filled, factor).max(axis=(1, 3))
    side_m = (region.cols * region.cell_size_m, region.rows * region.cell_size_m)
    scale = _MAP_INCHES / max(side_m)
    keys = class_keys(
        {name: f"  {sheet.class_weights[name]:.2f}" for name in region.classes if region.counts.get(name)}
    )
    if np.isnan(sheet.weights).any():
        keys.append(Patch(facecolor=HIDDEN, edgecolor="#666666", lw=0.4, label="not mapped (unknown)"))
    place = Evidence(classes=region.classes, cells=shrunk(sheet.layers), cell_size_m=region.cell_size_m * factor)
    about = Page(
        title=f"{region.title} ({region.id}): weight of the evidence",
        facts=f"map of {region.extract.date}  |  {sheet.facts}\n{_KEYS}",
        note="w sums over the classes of a cell; each dot is the strongest of its cells",
        data=region.attribution,
        columns=2,
        panel_inches=(max(side_m[0] * scale, _LEAST_INCHES), side_m[1] * scale),
        keys=keys,
    )
    with page(path, about) as ((seen, weighed),):
        picture_of(seen, paint_evidence(place), side_m, "what is mapped")
        scale_bar(seen, *side_m)
        north_arrow(seen, *side_m)
        mapped = picture_of(weighed, np.where(weights < 0, np.nan, weights), side_m, "what it weighs: w", top=sheet.top)
        colour_bar(weighed, mapped)


def picture_of(
    chart: Axes, picture: NDArray[np.generic], side_m: tuple[float, float], title: str, *, top: float | None = None
) -> ScalarMappable:
    """Draw a raster in metres without ticks; values from 0 to `top` by the colours of weights."""
    box = (0.0, side_m[0], 0.0, side_m[1])
    without_ticks(chart)
    chart.set_anchor("N")  # next to a panel with a colour bar
    chart.set_title(title)
    if top is None:
        return chart.imshow(picture, extent=box, interpolation="nearest")
    return chart.imshow(picture, extent=box, interpolation="nearest", cmap=weight_colours(), norm=Normalize(0, top))


def colour_bar(chart: Axes, mapped: ScalarMappable) -> None:
    """Draw the colour bar of weights below a panel."""
    drawn = chart.figure.colorbar(mapped, ax=chart, location="bottom", extend="max", aspect=45, panchor=False)
    drawn.set_label(f"w = \u03c3\u03bd, {UNIT} that are mapped and seen")
