# SPDX-License-Identifier: Apache-2.0
"""Rectangles that hide a share of the view: smoke, signs, masts, a lost tile of the image."""

from typing import Final

import numpy as np

from sasgeo_bench.regions.evidence import Evidence
from sasgeo_bench.tasks.perturbations.base import Mask, Occlusion

_DRAWS: Final = 256  # rectangles drawn at a time
_SIDES: Final = (0.08, 0.35)  # smallest and largest side of a rectangle, as fractions of the view's side


class Rectangles(Occlusion):
    """Hide the view behind rectangles that may overlap; exactly `share` of the cells, to the nearest one."""

    def mask(self, evidence: Evidence, rng: np.random.Generator) -> Mask:
        """Return the cells that the rectangles cover, shape (rows, cols)."""
        covered = np.zeros(evidence.shape, dtype=bool)
        wanted = round(self.share * covered.size)
        left = wanted
        while left > 0:
            for row, col, height, width in _draw(covered.shape, rng):
                if left == wanted or not covered[row, col]:
                    left -= _cover(covered[row : row + height, col : col + width], left)
                if left <= 0:
                    return covered
            # Little is free: cover the remaining cells in order instead of drawing more rectangles.
            if left < covered.size * 0.001 or left > 0.97 * (covered.size - wanted + left):
                covered.ravel()[np.flatnonzero(~covered)[:left]] = True
                return covered
        return covered


def _draw(shape: tuple[int, ...], rng: np.random.Generator) -> list[list[int]]:
    """Draw row, column, height and width of some rectangles; a corner may lie outside the view."""
    side = np.array(shape)
    sizes = np.maximum(1, rng.uniform(*_SIDES, size=(_DRAWS, 2)) * side).astype(int)
    corners = np.floor(rng.uniform(-sizes / 2, side - sizes / 2)).astype(int)
    low = np.maximum(corners, 0)
    rectangles: list[list[int]] = np.hstack((low, sizes + np.minimum(corners, 0))).tolist()
    return rectangles


def _cover(window: Mask, most_cells: int) -> int:
    """Cover a window from its top, row by row, with at most `most_cells` new cells; return the number of new ones."""
    fresh = int(window.size - np.count_nonzero(window))
    if fresh <= most_cells:
        window[:] = True
        return fresh
    by_row = np.cumsum(np.count_nonzero(~window, axis=1))
    rows = int(np.searchsorted(by_row, most_cells, side="right"))
    window[:rows] = True
    spent = int(by_row[rows - 1]) if rows else 0
    last = np.flatnonzero(~window[rows])[: most_cells - spent]
    window[rows, last] = True
    return most_cells
