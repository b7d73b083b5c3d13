# SPDX-License-Identifier: Apache-2.0
"""Layers of a region as degrees of presence, read as squares in cells of any size."""

import math
from dataclasses import dataclass
from typing import Final, Self

import cv2
import numpy as np
from numpy.typing import NDArray

from sasgeo_bench.geometry.grid import Grid
from sasgeo_bench.geometry.pose import Pose
from sasgeo_bench.regions.evidence import ABSENT, PRESENT, UNKNOWN
from sasgeo_bench.regions.region import Region
from sasgeo_bench.search.field import FULL

_NOTHING: Final = 6.5  # times the reach: less than 1e-9 remains


@dataclass(frozen=True, kw_only=True)
class Chart:
    """Layers of a map as a dense matcher reads them.

    `degree`, uint8 of shape (C, rows, cols), is 0 where a class is absent or the map is unknown, `FULL` where it is
    present. `known`, uint8 of shape (rows, cols), is `FULL` where the map is known, else 0.
    """

    grid: Grid
    classes: tuple[str, ...]
    degree: NDArray[np.uint8]
    known: NDArray[np.uint8]

    @classmethod
    def of(cls, region: Region, *, thin: tuple[str, ...] = (), reach_m: float = 0.0) -> Self:
        """Read a region; the classes in `thin` fade with the distance to the nearest cell, as in `fade`."""
        known = region.known()
        degree = np.empty((len(region.classes), *region.grid.shape), dtype=np.uint8)
        for name, kept in zip(region.classes, degree, strict=True):
            present = (region.layer(name) == PRESENT) & known
            if name in thin and reach_m > 0:
                faded = np.rint(FULL * fade(present, reach_cells=reach_m / region.grid.cell_size_m))
                kept[:] = np.where(present, FULL, np.minimum(faded, FULL - 1)) * known
            else:
                np.multiply(present, np.uint8(FULL), out=kept)
        return cls(
            grid=region.grid, classes=region.classes, degree=degree, known=np.where(known, np.uint8(FULL), np.uint8(0))
        )

    def used(self) -> NDArray[np.bool_]:
        """Return which classes the map holds, shape (C,)."""
        return np.asarray(self.degree.reshape(len(self.degree), -1).max(axis=1) > 0)

    def square(self, row: int, col: int, size: int, bands: NDArray[np.int64]) -> NDArray[np.float32]:
        """Read a square of classes and, last, known cells, 0..1, shape (bands + 1, size, size); 0 beyond the map.

        Its first cell is (row, col) of the map.
        """
        return np.divide(self.steps(row, col, size, bands), np.float32(FULL), dtype=np.float32)

    def steps(self, row: int, col: int, size: int, bands: NDArray[np.int64]) -> NDArray[np.uint8]:
        """Read a `square` as stored, 0..`FULL`."""
        return np.stack([_window(layer, row, col, size) for layer in self._layers(bands)])

    def pooled(self, row: int, col: int, size: int, factor: int, bands: NDArray[np.int64]) -> NDArray[np.float32]:
        """Return means over blocks of `factor` cells a side, shape (bands + 1, size, size)."""
        if factor == 1:
            return self.square(row, col, size, bands)
        cuts = (_window(layer, row, col, size * factor) / np.float32(FULL) for layer in self._layers(bands))
        return np.stack([cv2.resize(cut, (size, size), interpolation=cv2.INTER_AREA) for cut in cuts])

    def under(
        self, pose: Pose, shape: tuple[int, int], bands: NDArray[np.int64], *, cell_size_m: float
    ) -> NDArray[np.uint8]:
        """Return a perfect view of some classes from a pose, as `evidence.observe` does, shape (B, rows, cols).

        `shape` is that of the view, `cell_size_m` the side of its cells at scale 1. Beyond the map all is UNKNOWN.
        """
        place = self.grid.to_uv(np.array([(pose.easting_m, pose.northing_m)]))[0]
        whole = np.floor(place)
        turn = Pose(easting_m=0.0, northing_m=0.0, yaw_deg=pose.yaw_deg, scale=pose.scale)
        right, up = turn.to_map(np.eye(2) * cell_size_m) / (self.grid.cell_size_m, -self.grid.cell_size_m)
        across, along = (np.arange(count) + 0.5 - count / 2 for count in (shape[1], shape[0]))
        # 6 decimals of a place within its cell: the same on every copy of a piece of map
        uv = (place - whole).round(6)[:, None, None] + np.multiply.outer(right, across)[:, None, :]
        moved = np.floor(uv - np.multiply.outer(up, along)[:, :, None]).astype(np.int64)
        cols, rows = moved + whole.astype(np.int64)[:, None, None]
        inside = (rows >= 0) & (rows < self.grid.rows) & (cols >= 0) & (cols < self.grid.cols)
        at = np.where(inside, rows * self.grid.cols + cols, 0)
        unknown = ~(inside & (self.known.ravel().take(at) == FULL))
        shown = np.empty((len(bands), *shape), dtype=np.uint8)
        for band, layer in zip(bands, shown, strict=True):
            np.equal(self.degree[band].ravel().take(at), FULL, out=layer)
        shown[:, unknown] = UNKNOWN
        return shown

    def _layers(self, bands: NDArray[np.int64]) -> list[NDArray[np.uint8]]:
        return [*(self.degree[band] for band in bands), self.known]

    def blocks(self, row: int, col: int, size: int, factor: int, bands: NDArray[np.int64]) -> NDArray[np.uint8]:
        """Read classes and, last, known cells in blocks of `factor` cells a side: 1 where any cell of a block has it.

        The result has shape (bands + 1, size, size) and begins at (row, col) of the map. Lines stay connected; houses
        closer than a block merge.
        """
        windows = (_window(layer, row, col, size * factor) for layer in self._layers(bands))
        return np.stack([np.minimum(block_max(window, factor), 1) for window in windows])


def _window(layer: NDArray[np.uint8], row: int, col: int, size: int) -> NDArray[np.uint8]:
    """Cut a square of one layer, 0 beyond it."""
    found = np.zeros((size, size), dtype=np.uint8)
    rows, cols = layer.shape
    top, left, bottom, right = max(row, 0), max(col, 0), min(row + size, rows), min(col + size, cols)
    if top < bottom and left < right:
        found[top - row : bottom - row, left - col : right - col] = layer[top:bottom, left:right]
    return found


def block_max(layer: NDArray[np.uint8], factor: int) -> NDArray[np.uint8]:
    """Return the largest value of each block of `factor` cells a side; incomplete blocks are dropped.

    Examples
    --------
    >>> block_max(np.array([[0, 1, 0, 0, 1], [0, 0, 0, 0, 1]], dtype=np.uint8), 2).tolist()
    [[1, 0]]
    """
    rows, cols = (count // factor * factor for count in layer.shape)
    found = np.zeros((rows // factor, cols // factor), dtype=np.uint8)
    for down, right in np.ndindex(factor, factor):
        np.maximum(found, layer[down:rows:factor, right:cols:factor], out=found)
    return found


def fade(present: NDArray[np.bool_], *, reach_cells: float) -> NDArray[np.float32]:
    """Return exp(-D^2 / (2 reach^2)) of the distance D to the nearest present cell; 0 without any."""
    if not present.any():
        return np.zeros(present.shape, dtype=np.float32)
    distance = cv2.distanceTransform(
        np.where(present, ABSENT, PRESENT).astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_PRECISE
    )
    # D^2 is whole, so a table holds all values; rounding in NumPy's exp depends on memory alignment.
    squared = np.rint(np.minimum(distance, _NOTHING * reach_cells) ** 2).astype(np.int64)
    table = [math.exp(-k / (2 * reach_cells**2)) for k in range(int(squared.max()) + 1)]
    return np.asarray(np.array(table, dtype=np.float32)[squared], dtype=np.float32)
