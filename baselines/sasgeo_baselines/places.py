# SPDX-License-Identifier: Apache-2.0
"""Lattices of places within a prior, their best, and sums over squares of the map."""

from dataclasses import dataclass
from typing import Final, Self

import numpy as np
from numpy.typing import NDArray

from sasgeo_bench import PRESENT, Grid, Prior, Region, middle_m, offsets_m

_POOLED_M: Final = 4.0  # a cell of the sums; finer ones take memory and add nothing


def lattice_m(prior: Prior, grid: Grid, *, step_m: float) -> NDArray[np.float64]:
    """Return places on the map within the disc of a prior, on multiples of a step, north to south, shape (N, 2).

    The centre of the disc if there is none.

    Examples
    --------
    >>> small = Prior(center_m=(0.0, 0.0), radius_m=5.0, yaw_deg=None, yaw_sigma_deg=None, scale_sigma=0.03)
    >>> grid = Grid(epsg=32632, west_m=-8.0, north_m=8.0, cell_size_m=1.0, rows=16, cols=16)
    >>> lattice_m(small, grid, step_m=5.0).tolist()
    [[0.0, 5.0], [-5.0, 0.0], [0.0, 0.0], [5.0, 0.0], [0.0, -5.0]]
    """
    west_m, south_m, east_m, north_m = grid.bounds_m
    center_m = middle_m(prior, grid)
    if prior.radius_m is not None:
        west_m, east_m = max(west_m, center_m[0] - prior.radius_m), min(east_m, center_m[0] + prior.radius_m)
        south_m, north_m = max(south_m, center_m[1] - prior.radius_m), min(north_m, center_m[1] + prior.radius_m)
    eastings = np.arange(np.ceil(west_m / step_m), np.floor(east_m / step_m) + 1) * step_m
    northings = np.arange(np.floor(north_m / step_m), np.ceil(south_m / step_m) - 1, -1) * step_m
    points = np.column_stack((np.tile(eastings, len(northings)), np.repeat(northings, len(eastings))))
    if prior.radius_m is not None:
        points = points[offsets_m(points, center_m) <= prior.radius_m]
    return points if len(points) else np.array([center_m])


@dataclass(frozen=True, kw_only=True)
class Sums:
    """Summed-area table of a map: cells of each class and, last, known cells.

    `below` is int64 of shape (C + 1, rows + 1, cols + 1): sums over all coarse cells above and left.
    """

    grid: Grid
    below: NDArray[np.int64]

    @classmethod
    def of(cls, region: Region, classes: tuple[str, ...] | None = None) -> Self:
        """Sum the layers of a region, or of some of its classes."""
        factor = max(1, round(_POOLED_M / region.grid.cell_size_m))
        bands = [band for band, name in enumerate(region.classes) if classes is None or name in classes]
        known = np.ones(region.grid.shape, dtype=bool)
        for layer in region.layers:
            known &= layer <= PRESENT
        grid = region.grid.coarsen(factor)
        below = np.zeros((len(bands) + 1, grid.rows + 1, grid.cols + 1), dtype=np.int64)
        for into, layer in zip(
            below, (*((region.layers[band] == PRESENT) & known for band in bands), known), strict=True
        ):
            padded = np.zeros((grid.rows * factor, grid.cols * factor), dtype=bool)
            padded[: layer.shape[0], : layer.shape[1]] = layer
            blocks = padded.reshape(grid.rows, factor, grid.cols, factor).sum(axis=(1, 3), dtype=np.int64)
            into[1:, 1:] = blocks.cumsum(axis=0).cumsum(axis=1)
        return cls(grid=grid, below=below)

    def squares(self, points_m: NDArray[np.float64], side_m: float) -> NDArray[np.int64]:
        """Return cells of each class and, last, known cells in upright squares around places, shape (C + 1, N)."""
        corners = (points_m - side_m / 2, points_m + side_m / 2)
        (left, bottom), (right, top) = (np.rint(self.grid.to_uv(corner)).astype(np.int64).T for corner in corners)
        left, right = (np.clip(edge, 0, self.grid.cols) for edge in (left, right))
        top, bottom = (np.clip(edge, 0, self.grid.rows) for edge in (top, bottom))
        sums = self.below
        return np.asarray(sums[:, bottom, right] - sums[:, top, right] - sums[:, bottom, left] + sums[:, top, left])


def first_apart(points_m: NDArray[np.float64], scores: NDArray[np.float64], *, apart_m: float, most: int) -> list[int]:
    """Return indices of the best places, none nearer to a better one than a distance; ties keep their order.

    Examples
    --------
    >>> first_apart(np.array([(0.0, 0.0), (1.0, 0.0), (9.0, 0.0)]), np.array([1.0, 2.0, 0.0]), apart_m=5.0, most=2)
    [1, 2]
    """
    left = scores.astype(np.float64)
    chosen: list[int] = []
    while len(chosen) < most:
        at = int(np.argmax(left))
        if not np.isfinite(left[at]):
            break
        chosen.append(at)
        left[offsets_m(points_m, (points_m[at, 0], points_m[at, 1])) < apart_m] = -np.inf
    return chosen
