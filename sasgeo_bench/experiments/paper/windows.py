# SPDX-License-Identifier: Apache-2.0
"""Candidate crops: a lattice of windows in every tile, their global descriptors, and ten that are alike."""

from dataclasses import dataclass
from typing import Final, Self

import numpy as np
from numpy.typing import NDArray

from sasgeo_bench.experiments.paper.tiles import CELL_M, CLASSES, TILE_M, TILES, tile_centre_m
from sasgeo_bench.regions.layers import PRESENT
from sasgeo_bench.regions.region import Region

WINDOW_CELLS: Final = 96
WINDOW_M: Final = WINDOW_CELLS * CELL_M
MARGIN_M: Final = 80.0  # from a window's middle to the edge of its tile: half a diagonal at scale 1.15 is 78.1 m
STEP_M: Final = 16.0
CANDIDATES: Final = 10


@dataclass(frozen=True, kw_only=True)
class Windows:
    """All candidate crops.

    `points_m` is the middle of each, easting and northing, shape (N, 2), `tile` the number of its tile, and `counts`,
    shape (N, 5), its global semantic descriptor: in how many of its cells each of `CLASSES` is present.
    """

    points_m: NDArray[np.float64]
    tile: NDArray[np.int64]
    counts: NDArray[np.int64]

    @classmethod
    def of(cls, region: Region) -> Self:
        """Describe every window of a region made of tiles."""
        points_m, tile = lattice_m()
        rows, cols = np.rint(region.grid.to_uv(points_m)[:, ::-1]).astype(np.int64).T
        half = WINDOW_CELLS // 2
        counts = np.empty((len(points_m), len(CLASSES)), dtype=np.int64)
        for into, name in zip(counts.T, CLASSES, strict=True):
            below = np.zeros(np.add(region.grid.shape, 1), dtype=np.int64)
            below[1:, 1:] = (region.layer(name) == PRESENT).cumsum(axis=0).cumsum(axis=1)
            top, bottom, left, right = rows - half, rows + half, cols - half, cols + half
            into[:] = below[bottom, right] - below[top, right] - below[bottom, left] + below[top, left]
        return cls(points_m=points_m, tile=tile, counts=counts)

    def alike(self, anchor: int, count: int = CANDIDATES) -> NDArray[np.int64]:
        """Numbers of a window and of those with the nearest descriptors, no two of which share ground; nearest first.

        Examples
        --------
        >>> row = np.array([(0.0, 0.0), (16.0, 0.0), (96.0, 0.0), (192.0, 0.0)])
        >>> counts = np.array([[10], [10], [30], [20]])
        >>> Windows(points_m=row, tile=np.zeros(4, dtype=np.int64), counts=counts).alike(0, 3).tolist()
        [0, 3, 2]
        """
        # Squares of whole numbers: no rounding decides which of two windows is nearer.
        squared = ((self.counts - self.counts[anchor]) ** 2).sum(axis=1)
        squared[anchor] = -1  # before a window that is quite alike
        found: list[int] = []
        for index in np.argsort(squared, kind="stable").tolist():
            if not self.meets(index, found).any():
                found.append(index)
            if len(found) == count:
                break
        return np.array(found, dtype=np.int64)

    def meets(self, index: int, others: list[int]) -> NDArray[np.bool_]:
        """Return whether a window overlaps each of some others."""
        apart_m = np.abs(self.points_m[others] - self.points_m[index]).max(axis=1)
        return np.asarray(apart_m < WINDOW_M)


def lattice_m() -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Middles of all windows, tile by tile, shape (N, 2), metres, and the number of the tile of each.

    Examples
    --------
    >>> points_m, tile = lattice_m()
    >>> len(points_m), len(points_m) // TILES
    (1470, 49)
    """
    reach_m = TILE_M / 2 - MARGIN_M
    steps_m = np.arange(-reach_m, reach_m + STEP_M / 2, STEP_M)
    offsets_m = np.stack(np.meshgrid(steps_m, -steps_m), axis=-1).reshape(-1, 2)
    centres_m = np.array([tile_centre_m(tile) for tile in range(TILES)])
    points_m = (centres_m[:, None] + offsets_m).reshape(-1, 2)
    return points_m, np.repeat(np.arange(TILES), len(offsets_m))
