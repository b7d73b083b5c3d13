# SPDX-License-Identifier: Apache-2.0
"""Belief over place and heading on a window of cells: moved by odometry, spread, weighed by a view, and summed up."""

import math
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Final, Self

import cv2
import numpy as np
from numpy.typing import NDArray

from sasgeo_bench.geometry.grid import Grid
from sasgeo_bench.geometry.pose import Prior, wrap_deg
from sasgeo_bench.search.field import Field

Floats = NDArray[np.float32]
Box = tuple[int, int, int, int]  # top, left, bottom, right in cells of the map
Slices = tuple[slice, slice]

FACTORS: Final = (1, 2, 4, 8)  # sides of a cell of the belief, in cells of the map
UNIT: Final = FACTORS[-1]  # windows begin at whole cells of every size
COARSEST_M: Final = 32.0  # largest cell
FINE_YAWS: Final = 72
COARSE_YAWS: Final = 36
MOST: Final = 2_500_000  # values of a belief before its cells become larger
TAIL: Final = 1e-4  # mass that a window may lose at each side
BEYOND_M: Final = 500.0  # a drone may leave the map so far
_CIRCLE_DEG: Final = 360.0


@dataclass(frozen=True, kw_only=True)
class GridBelief:
    """Probability of each heading and cell of a window.

    Parameters
    ----------
    mapped : Grid
        Cells of the map.
    factor : int
        Side of a cell of the belief in cells of the map.
    row, col : int
        Cell of the map at the window's top left; multiples of `UNIT`, and negative beyond the map.
    mass : ndarray of float32, shape (Y, rows, cols)
        Sums to 1. Heading k is 360 k / Y degrees.
    """

    mapped: Grid
    factor: int
    row: int
    col: int
    mass: Floats

    @classmethod
    def of(cls, prior: Prior, mapped: Grid) -> Self:
        """Return an even belief over the disc of a prior, or over the map if it has none; heading as it says."""
        reach_m = math.hypot(*mapped.shape) * mapped.cell_size_m if prior.radius_m is None else prior.radius_m
        middle_m = prior.center_m or _middle_m(mapped)
        row, col = mapped.to_cells(np.array([middle_m]))[0].tolist()
        reach = math.ceil(reach_m / mapped.cell_size_m) + 1
        box = clipped((row - reach, col - reach, row + reach, col + reach), mapped)
        sizes = sizes_of(mapped)
        factor = next((size for size in sizes if values(box, mapped, size) <= MOST), sizes[-1])
        empty = cls.blank(mapped, factor, box)
        inside = np.hypot(*(empty.places_m - middle_m).T).reshape(empty.shape) <= reach_m
        if not inside.any():
            inside[:] = True
        chance = _about(empty.yaws_deg, prior.yaw_deg, prior.yaw_sigma_deg)
        return replace(empty, mass=chance[:, None, None] * (inside / np.float32(inside.sum()))).normalised()

    @classmethod
    def blank(cls, mapped: Grid, factor: int, box: Box) -> Self:
        """Return a belief without mass on a window: top, left, bottom and right in cells of the map."""
        top, left, bottom, right = box
        shape = (yaw_count(mapped, factor), (bottom - top) // factor, (right - left) // factor)
        return cls(mapped=mapped, factor=factor, row=top, col=left, mass=np.zeros(shape, dtype=np.float32))

    @property
    def shape(self) -> tuple[int, int]:
        """Return rows and columns of the window."""
        return (self.mass.shape[1], self.mass.shape[2])

    @property
    def box(self) -> Box:
        """Return top, left, bottom and right of the window in cells of the map."""
        rows, cols = self.shape
        return (self.row, self.col, self.row + rows * self.factor, self.col + cols * self.factor)

    @cached_property
    def grid(self) -> Grid:
        """Return the cells of the window."""
        rows, cols = self.shape
        return self.mapped.window(self.row, self.col, rows * self.factor, cols * self.factor).coarsen(self.factor)

    @property
    def yaws_deg(self) -> NDArray[np.float64]:
        """Return the headings, shape (Y,)."""
        return np.arange(len(self.mass), dtype=np.float64) * self.yaw_step_deg

    @property
    def yaw_step_deg(self) -> float:
        """Return the step between headings."""
        return _CIRCLE_DEG / len(self.mass)

    @cached_property
    def places_m(self) -> NDArray[np.float64]:
        """Return the centres of the cells, row by row, shape (rows * cols, 2)."""
        cells = np.column_stack([index.ravel() for index in np.indices(self.shape)])
        return np.asarray(self.grid.to_centres_m(cells), dtype=np.float64)

    @cached_property
    def asked(self) -> NDArray[np.int64]:
        """Return indices of headings that are not all but excluded."""
        # 1e-7: mass of a heading below which no view is asked about it
        return np.flatnonzero(self.mass.sum(axis=(1, 2)) > 1e-7)

    def normalised(self) -> Self:
        """Return the belief with a sum of 1; without any mass it is even."""
        total = float(self.mass.sum(dtype=np.float64))
        if not (total > 0 and math.isfinite(total)):
            return replace(self, mass=np.full_like(self.mass, 1.0 / self.mass.size))
        return replace(self, mass=self.mass / np.float32(total))

    def weighed(self, logs: Floats, *, doubt: float) -> Self:
        """Multiply by a likelihood of which `logs` are the logarithms at the headings in `asked`, up to a constant.

        With probability `doubt` a view says nothing, whatever it shows: it never makes a place less likely than that
        share of the likeliest one. So one view, however sure, excludes nothing.
        """
        found = np.float32(doubt) * self.mass
        found[self.asked] += self.mass[self.asked] * np.exp(logs - logs.max()) * np.float32(1 - doubt)
        return replace(self, mass=found).normalised()

    def fitted(self) -> Self:
        """Cut the window to nearly all of the mass, and make its cells as large or small as its size asks for."""
        found = self.cut(self._held())
        while found.mass.size > MOST and found.factor < sizes_of(found.mapped)[-1]:
            found = found.coarser()
        # 400_000 values below which they become smaller
        while found.factor > 1 and values(found.box, found.mapped, found.factor // 2) <= 400_000:
            found = found.finer()
        return found

    def _held(self) -> Box:
        plane = self.mass.sum(axis=0, dtype=np.float64)
        sides = []
        for axis in (1, 0):
            share = np.cumsum(plane.sum(axis=axis)) / plane.sum()
            sides.append((int(np.searchsorted(share, TAIL)), int(np.searchsorted(share, 1 - TAIL)) + 1))
        (top, bottom), (left, right) = ((first * self.factor, last * self.factor) for first, last in sides)
        return (self.row + top, self.col + left, self.row + bottom, self.col + right)

    def cut(self, box: Box) -> Self:
        """Return the belief on another window, widened to whole units and cut at some way beyond the map."""
        found = self.blank(self.mapped, self.factor, clipped(box, self.mapped, beyond_m=BEYOND_M))
        down, right = (self.row - found.row) // self.factor, (self.col - found.col) // self.factor
        into, part = window_overlap(found.shape, self.shape, down, right)
        found.mass[(slice(None), *into)] = self.mass[(slice(None), *part)]
        return found.normalised()

    def coarser(self) -> Self:
        """Return the belief on cells twice as large."""
        yaws, rows, cols = self.mass.shape
        mass = self.mass.reshape(yaws, rows // 2, 2, cols // 2, 2).sum(axis=(2, 4))
        if yaw_count(self.mapped, 2 * self.factor) < yaws:
            mass = mass[::2] + (mass[1::2] + np.roll(mass[1::2], 1, axis=0)) / 2
        return replace(self, factor=2 * self.factor, mass=mass)

    def finer(self) -> Self:
        """Return the belief on cells half as large, interpolated linearly."""
        yaws, rows, cols = self.mass.shape
        mass = np.stack([cv2.resize(one, (2 * cols, 2 * rows), interpolation=cv2.INTER_LINEAR) for one in self.mass])
        if yaw_count(self.mapped, self.factor // 2) > yaws:
            mass = np.stack((mass, (mass + np.roll(mass, -1, axis=0)) / 2), axis=1).reshape(
                2 * yaws, 2 * rows, 2 * cols
            )
        return replace(self, factor=self.factor // 2, mass=mass).normalised()


def sizes_of(mapped: Grid) -> tuple[int, ...]:
    """Return the sizes that a cell of a belief may have, in cells of the map: up to `COARSEST_M`.

    >>> [sizes_of(Grid(epsg=0, west_m=0, north_m=0, cell_size_m=side, rows=8, cols=8)) for side in (4.0, 16.0)]
    [(1, 2, 4, 8), (1, 2)]
    """
    return tuple(size for size in FACTORS if size == 1 or size * mapped.cell_size_m <= COARSEST_M)


def yaw_count(mapped: Grid, factor: int) -> int:
    """Return the number of headings on cells of a size."""
    # 8 m: largest cell with FINE_YAWS headings; larger ones have COARSE_YAWS
    return FINE_YAWS if factor * mapped.cell_size_m <= 8.0 else COARSE_YAWS


def values(box: Box, mapped: Grid, factor: int) -> int:
    """Return the number of values of a belief on a window."""
    top, left, bottom, right = box
    return (bottom - top) * (right - left) // factor**2 * yaw_count(mapped, factor)


def clipped(box: Box, mapped: Grid, *, beyond_m: float = 0.0) -> Box:
    """Return a box widened to whole units, and no wider than the map; at least one unit."""
    beyond = math.ceil(beyond_m / mapped.cell_size_m)
    low, high = np.array([-beyond, -beyond]), np.array(mapped.shape) + beyond
    first = np.clip(box[:2], low, high - 1) // UNIT * UNIT
    last = -(-np.clip(box[2:], first + 1, high) // UNIT) * UNIT
    return (*first.tolist(), *last.tolist())


def window_overlap(into: tuple[int, int], part: tuple[int, int], down: int, right: int) -> tuple[Slices, Slices]:
    """Return the common cells of two windows, in each of them; the second begins `down` and `right` of the first.

    >>> window_overlap((4, 4), (3, 3), 2, -1)
    ((slice(2, 4, None), slice(0, 2, None)), (slice(0, 2, None), slice(1, 3, None)))
    """
    sides = []
    for whole, size, offset in zip(into, part, (down, right), strict=True):
        first, last = max(offset, 0), min(offset + size, whole)
        sides.append((slice(first, max(first, last)), slice(first - offset, max(first, last) - offset)))
    (rows, from_rows), (cols, from_cols) = sides
    return (rows, cols), (from_rows, from_cols)


def _middle_m(grid: Grid) -> tuple[float, float]:
    west_m, south_m, east_m, north_m = grid.bounds_m
    return (west_m + east_m) / 2, (south_m + north_m) / 2


def _about(yaws_deg: NDArray[np.float64], yaw_deg: float | None, sigma_deg: float | None) -> Floats:
    if yaw_deg is None or sigma_deg is None:
        return np.full(len(yaws_deg), 1 / len(yaws_deg), dtype=np.float32)
    step_deg = _CIRCLE_DEG / len(yaws_deg)
    away_deg = np.abs(wrap_deg(yaws_deg - yaw_deg))
    chance = np.exp(-(away_deg**2) / (2 * (sigma_deg**2 + step_deg**2 / 12)))
    return np.asarray(chance / chance.sum(), dtype=np.float32)


def prepare_levels(field: Field) -> Field:
    """Return a map with the larger cells that beliefs on it may have, made now instead of during a flight."""
    for factor in sizes_of(field.grid)[1:]:
        field.level(factor)
    return field
