# SPDX-License-Identifier: Apache-2.0
"""Scores of a view on the window of a belief."""

from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

from sasgeo_bench.geometry.grid import Grid
from sasgeo_bench.search.belief import Floats, GridBelief, window_overlap
from sasgeo_bench.search.field import FULL, Field, Template
from sasgeo_bench.search.surface import surface

SCORED_M: Final = 16.0  # largest cell that a view is scored on


def surface_logs(field: Field, template: Template, belief: GridBelief, *, temper: float, scale: float = 1.0) -> Floats:
    """Return tempered scores of a view at the headings in `belief.asked` and each cell, shape (A, rows, cols).

    The map is scored in cells of the belief, on which thin classes are spread, but for cells larger than `SCORED_M`:
    too few of these are in a view, so they are as likely as the mean of their quarters. On cells smaller than those of
    the belief a score is sharper than steps of heading are. Beyond the map a view scores 0: it says nothing there.
    """
    parts = 2 if belief.grid.cell_size_m > SCORED_M and belief.factor > 1 else 1
    found = np.empty((len(belief.asked), *belief.shape), dtype=np.float32)
    # 16 million scores computed at a time: bounds memory where the belief is wide
    step = max(1, 16_000_000 // (belief.mass[0].size * parts**2))
    # Headings at right angles share their work, so they are asked for together.
    order = np.argsort(belief.asked % (len(belief.mass) // 4), kind="stable")
    for first in range(0, len(order), step):
        chosen = order[first : first + step]
        scores = _scores(
            field, template, belief, belief.yaws_deg[belief.asked[chosen]], factor=belief.factor // parts, scale=scale
        )
        found[chosen] = pooled_logs(np.float32(temper) * scores, parts)
    return found


def pooled_logs(logs: Floats, parts: int) -> Floats:
    """Return the logarithm of the mean likelihood of squares of `parts` cells a side, from shape (A, rows, cols).

    >>> pooled_logs(np.log(np.array([[[1.0, 2.0], [3.0, 6.0]]])), 2).round(3) == np.log(3.0).round(3)
    array([[[ True]]])
    """
    if parts == 1:
        return logs
    count, rows, cols = logs.shape
    squares = logs.reshape(count, rows // parts, parts, cols // parts, parts)
    top = squares.max(axis=(2, 4), keepdims=True)
    return np.asarray(np.log(np.exp(squares - top).mean(axis=(2, 4))) + top[:, :, 0, :, 0])


def _scores(
    field: Field, template: Template, belief: GridBelief, yaws_deg: NDArray[np.float64], *, factor: int, scale: float
) -> Floats:
    """Return scores on the window of a belief in cells of `factor` map cells a side, 0 beyond the map."""
    top, left, bottom, right = belief.box
    found = np.zeros((len(yaws_deg), (bottom - top) // factor, (right - left) // factor), dtype=np.float32)
    if bottom <= 0 or right <= 0 or top >= field.grid.rows or left >= field.grid.cols:
        return found
    west_m, south_m, east_m, north_m = belief.grid.bounds_m
    scored = surface(
        field,
        template,
        center_m=((west_m + east_m) / 2, (south_m + north_m) / 2),
        radius_m=max(east_m - west_m, north_m - south_m) / 2,
        yaws_deg=yaws_deg,
        factor=factor,
        scale=scale,
    )
    cell_m = scored.grid.cell_size_m
    down, across = round((north_m - scored.grid.north_m) / cell_m), round((scored.grid.west_m - west_m) / cell_m)
    into, part = window_overlap((found.shape[1], found.shape[2]), scored.grid.shape, down, across)
    found[(slice(None), *into)] = scored.scores[(slice(None), *part)]
    return found


def known_on(field: Field, grid: Grid) -> Floats:
    """Return the share of each cell of a grid that the map knows, shape of the grid; 0 beyond the map.

    The cells of the grid are whole squares of cells of the map, as those of a belief's window or of a surface are.
    """
    cell_m = field.grid.cell_size_m
    step = round(grid.cell_size_m / cell_m)
    down = round((grid.north_m - field.grid.north_m) / cell_m)  # cells of the grid before the map's first, if positive
    right = round((field.grid.west_m - grid.west_m) / cell_m)
    fine = np.zeros((grid.rows * step, grid.cols * step), dtype=np.uint8)
    into, part = window_overlap(fine.shape, field.known.shape, down, right)
    fine[into] = field.known[part]
    shares = cv2.resize(fine, (grid.cols, grid.rows), interpolation=cv2.INTER_AREA)
    return np.asarray(shares, dtype=np.float32) / np.float32(FULL)
