# SPDX-License-Identifier: Apache-2.0
"""Colours of maps and views, as arrays: what is painted where no figure is drawn, and so without matplotlib."""

from typing import Final

import numpy as np
from numpy.typing import NDArray
from PIL import ImageColor

from sasgeo_bench.osm.taxonomy import load_taxonomy
from sasgeo_bench.regions.evidence import UNKNOWN, Evidence
from sasgeo_bench.regions.layers import OUTSIDE, PRESENT
from sasgeo_bench.regions.region import Manifest

PAINT_ORDER: Final = load_taxonomy().painted
GROUND: Final = "#fbfaf5"
HIDDEN: Final = "#9e9e9e"  # of what was not seen
UNMAPPED: Final = ("#d9d9d9", "#c4c4c4")
_STRIPE_CELLS: Final = 12


def rgb_of(colour: str) -> tuple[float, ...]:
    """Return red, green and blue, 0..1, of a colour.

    >>> rgb_of("#ff0033")
    (1.0, 0.0, 0.2)
    """
    return tuple(band / 255 for band in ImageColor.getrgb(colour))


def pooled(layers: NDArray[np.uint8], *, most_cells: int) -> NDArray[np.uint8]:
    """Return coarser layers, at most `most_cells` along a side: present where any cell is, else the largest value.

    Rows and columns that fill no whole cell at the lower and right edge are left out.

    >>> pooled(np.array([[[0, 0, 1, 0]], [[0, 0, 255, 0]]], dtype=np.uint8).repeat(2, axis=1), most_cells=2).tolist()
    [[[0, 1]], [[0, 255]]]
    """
    sides = layers.shape[1:]
    step = max(1, min(-(-max(sides) // most_cells), *sides))
    rows, cols = (side // step for side in sides)
    parts = layers[:, : rows * step, : cols * step].reshape(len(layers), rows, step, cols, step)
    is_there = (parts == PRESENT).any(axis=(2, 4))
    return np.where(is_there, np.uint8(PRESENT), parts.max(axis=(2, 4)))


def paint_overview(manifest: Manifest, overview: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Return the colours of a map, red, green and blue, shape (rows, cols, 3)."""
    rows, cols = overview.shape[1:]
    number = np.zeros((rows, cols), dtype=np.uint8)  # of a colour
    colours = [GROUND]
    for name in PAINT_ORDER:
        if name in manifest.classes:
            number[overview[manifest.classes.index(name)] == PRESENT] = len(colours)
            colours.append(load_taxonomy()[name].colour)
    down, right = np.indices((rows, cols), sparse=True)
    is_stripe = (down + right) // _STRIPE_CELLS % 2 == 0
    outside = overview[0] == OUTSIDE
    number[outside] = (len(colours) + is_stripe)[outside]
    palette = np.rint(255 * np.array([rgb_of(colour) for colour in (*colours, *UNMAPPED)]))
    return np.asarray(palette.astype(np.uint8)[number])


def paint_evidence(evidence: Evidence) -> NDArray[np.float64]:
    """Return colours of a view, shape (rows, cols, 3), 0..1; grey in proportion to the unknown classes."""
    picture = np.empty((*evidence.shape, 3))
    picture[:] = rgb_of(GROUND)
    colours = {item.name: rgb_of(item.colour) for item in load_taxonomy().classes}
    for name in PAINT_ORDER:
        if name in evidence.classes:
            picture[evidence.layer(name) == PRESENT] = colours[name]
    unknown = (evidence.cells == UNKNOWN).mean(axis=0)[..., None]
    return np.asarray(picture * (1 - unknown) + np.array(rgb_of(HIDDEN)) * unknown)
