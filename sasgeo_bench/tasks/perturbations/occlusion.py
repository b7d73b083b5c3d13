# SPDX-License-Identifier: Apache-2.0
"""Rectangles that hide a share of the view: smoke, signs, masts, a lost tile of the image."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar, Final

import numpy as np
from numpy.typing import NDArray

from sasgeo_bench.regions.evidence import Evidence
from sasgeo_bench.tasks.perturbations.base import check_ranges, hide

Mask = NDArray[np.bool_]

_DRAWS: Final = 256  # of (place, size) at a time


@dataclass(frozen=True, kw_only=True)
class Rectangles:
    """Hide a share of the view behind rectangles that may overlap; all classes become unknown there.

    Parameters
    ----------
    share : float
        Share of the view's cells that is covered, 0 to 1. It is reached to within one row of a rectangle.
    smallest, largest : float
        Side of a rectangle, as shares of the view's side.

    Examples
    --------
    >>> view = Evidence(classes=("water",), cells=np.zeros((1, 96, 96), dtype=np.uint8), cell_size_m=1.0)
    >>> seen = Rectangles(share=0.3)(view, np.random.default_rng(0))
    >>> abs(seen.unknown_share - 0.3) < 0.01
    True
    """

    NEUTRAL: ClassVar[Mapping[str, float]] = {"share": 0.0}
    MOVES: ClassVar[bool] = False

    share: float
    smallest: float = 0.08
    largest: float = 0.35

    def __post_init__(self) -> None:
        """Refuse shares that are none."""
        check_ranges(self, share=(0, 1), largest=(0.01, 1))
        check_ranges(self, smallest=(0.01, self.largest))

    def __call__(self, evidence: Evidence, rng: np.random.Generator, /) -> Evidence:
        """Cover the view."""
        if self.share == 0:
            return evidence
        return hide(evidence, self.mask(evidence.shape, rng))

    def mask(self, shape: tuple[int, int], rng: np.random.Generator) -> Mask:
        """What is covered, shape (rows, cols)."""
        covered = np.zeros(shape, dtype=bool)
        wanted = round(self.share * covered.size)
        left = wanted
        while left > 0:
            for row, col, height, width in self._draw(shape, rng):
                if left == wanted or not covered[row, col]:
                    left -= _cover(covered[row : row + height, col : col + width], left)
                if left <= 0:
                    return covered
            # Little is free: what is left is not worth more draws.
            if left < covered.size * 0.001 or left > 0.97 * (covered.size - wanted + left):
                covered.ravel()[np.flatnonzero(~covered)[:left]] = True
                return covered
        return covered

    def _draw(self, shape: tuple[int, int], rng: np.random.Generator) -> list[list[int]]:
        """Row, column, height and width of some rectangles; the corner may lie before the view's own."""
        side = np.array(shape)
        sizes = np.maximum(1, rng.uniform(self.smallest, self.largest, size=(_DRAWS, 2)) * side).astype(int)
        corners = np.floor(rng.uniform(-sizes / 2, side - sizes / 2)).astype(int)
        low = np.maximum(corners, 0)
        rectangles: list[list[int]] = np.hstack((low, sizes + np.minimum(corners, 0))).tolist()
        return rectangles


def _cover(window: Mask, most_cells: int) -> int:
    """Cover a window from its top, row by row, but no more than `most_cells` new cells; how many were new."""
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
