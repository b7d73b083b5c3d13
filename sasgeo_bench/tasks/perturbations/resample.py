# SPDX-License-Identifier: Apache-2.0
"""Resampling of the cells of a view, the last step of geometric perturbations."""

from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from sasgeo_bench.regions.evidence import UNKNOWN, Evidence

Value = TypeVar("Value", np.uint8, np.bool_)
Metres = NDArray[np.floating]


def resample(evidence: Evidence, right_m: Metres, up_m: Metres) -> Evidence:
    """Fill each cell from the place (`right_m`, `up_m`) metres from the middle; UNKNOWN if that is outside the view.

    Both places broadcast to shape (rows, cols). Confidence moves with its cell and is 0 outside the view.

    Examples
    --------
    >>> view = Evidence(classes=("water",), cells=np.array([[[0, 1]]], dtype=np.uint8), cell_size_m=1.0)
    >>> resample(view, np.array([[0.5, 1.5]]), np.zeros((1, 2))).cells.tolist()
    [[[1, 2]]]
    """
    rows, cols = evidence.shape
    col = np.floor(right_m / evidence.cell_size_m + cols / 2).astype(np.intp)
    row = np.floor(rows / 2 - up_m / evidence.cell_size_m).astype(np.intp)
    within = (row >= 0) & (row < rows) & (col >= 0) & (col < cols)
    places = np.where(within, row * cols + col, 0)
    cells = _take(evidence.cells, places, within, UNKNOWN)
    if evidence.confidence is None:
        return evidence.replace(cells)
    return evidence.replace(cells, _take(evidence.confidence, places, within, 0))


def shifted(layer: NDArray[Value], rows: int, cols: int, *, beyond: int) -> NDArray[Value]:
    """Move a layer down and right by whole cells; cells from outside the view get the value `beyond`.

    Examples
    --------
    >>> shifted(np.array([[1, 0], [0, 0]], dtype=np.uint8), 0, 1, beyond=2).tolist()
    [[2, 1], [2, 0]]
    """
    height, width = layer.shape
    out = np.full_like(layer, beyond)
    if abs(rows) < height and abs(cols) < width:
        out[max(rows, 0) : height + min(rows, 0), max(cols, 0) : width + min(cols, 0)] = layer[
            max(-rows, 0) : height + min(-rows, 0), max(-cols, 0) : width + min(-cols, 0)
        ]
    return out


def _take(
    stack: NDArray[np.uint8], places: NDArray[np.intp], within: NDArray[np.bool_], beyond: int
) -> NDArray[np.uint8]:
    taken = np.take(stack.reshape(len(stack), -1), places.ravel(), axis=1).reshape(stack.shape)
    if not within.all():
        taken[:, ~within] = beyond
    return taken
