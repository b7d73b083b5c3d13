# SPDX-License-Identifier: Apache-2.0
"""Rays from a place to the buildings around it: how far they go, and which building each one meets."""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Final, Self

import cv2
import numpy as np
from numpy.typing import NDArray

import sasgeo_bench as sgb

CLASS: Final = "building"
REACH_M: Final = 80.0  # of a ray: half the side of most views is 96 m, and rays may begin beside the middle
STEP_M: Final = 2.0  # along the rays of a lattice

_NOWHERE: Final = -1  # number of ground of which nothing is known
_TILE: Final = 1024  # cells a side: a map is read tile by tile

Floats = NDArray[np.float32]
Points = NDArray[np.float64]
Numbers = NDArray[np.int32]


@dataclass(frozen=True, kw_only=True)
class Rays:
    """Rays of N places, clockwise from straight ahead or from north, arrays of shape (N, rays).

    `range_m` is how far each goes, `REACH_M` if it meets no building; `building` is the number of that, 0 for none;
    `is_censored` marks rays that end where nothing is known.
    """

    range_m: Floats
    building: Numbers
    is_censored: NDArray[np.bool_]

    @classmethod
    def of(cls, away_m: NDArray[np.floating], met: Numbers) -> Self:
        """Return rays from how far each went, and the number of what it met."""
        range_m = np.where(met > 0, away_m, REACH_M).astype(np.float32)
        return cls(range_m=range_m, building=np.maximum(met, 0), is_censored=met == _NOWHERE)

    def taken(self, chosen: NDArray[np.bool_]) -> Self:
        """Return the rays of some places."""
        return type(self)(
            range_m=self.range_m[chosen], building=self.building[chosen], is_censored=self.is_censored[chosen]
        )


def numbered(states: NDArray[np.uint8]) -> Numbers:
    """Number the buildings of cells that are ABSENT, PRESENT or UNKNOWN: patches of cells that share sides.

    >>> numbered(np.array([[1, 1, 0, 2], [0, 0, 1, 2]], dtype=np.uint8)).tolist()
    [[1, 1, 0, -1], [0, 0, 2, -1]]
    """
    _, found = cv2.connectedComponents((states == sgb.PRESENT).astype(np.uint8), connectivity=4)
    found[states == sgb.UNKNOWN] = _NOWHERE
    return np.asarray(found, dtype=np.int32)


def cast(states: NDArray[np.uint8], places_uv: Points, count: int, *, cell_m: float) -> Rays:
    """Cast rays from places on a raster, shape (N, 2), cells right and down from its upper left corner.

    Beyond the raster nothing is known.

    Examples
    --------
    A house in the north-east of a yard, and the end of what is known in the west:

    >>> states = np.zeros((40, 40), dtype=np.uint8)
    >>> states[:10, 30:], states[:, :5] = sgb.PRESENT, sgb.UNKNOWN
    >>> found = cast(states, np.array([[25.0, 15.0]]), 8, cell_m=1.0)
    >>> found.building[0].tolist(), int(found.is_censored.sum()), found.range_m[0, :2].round().tolist()
    ([0, 1, 0, 0, 0, 0, 0, 0], 7, [80.0, 7.0])
    """
    number = numbered(np.pad(states, 1, constant_values=sgb.UNKNOWN))  # no step leads over the margin
    clear = cv2.distanceTransform((number == 0).astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_5).ravel()
    angle = np.tile(2 * np.pi * np.arange(count) / count, len(places_uv))
    start = np.clip(places_uv + 1, 0.5, np.array(number.shape[::-1]) - 0.5).repeat(count, axis=0)
    ray = np.stack([*start.T, np.sin(angle), -np.cos(angle)])  # where it is, and where it goes
    numbers, cols = number.ravel(), number.shape[1]
    away, met, left = np.zeros(len(angle)), np.zeros(len(angle), dtype=np.int32), np.arange(len(angle))
    while len(left):
        at = ray[1].astype(np.int64) * cols + ray[0].astype(np.int64)
        found = numbers[at]
        goes_on = found == 0
        met[left[~goes_on]] = found[~goes_on]
        # 0.7 cells: half a diagonal, so that no ray passes a corner by much
        # 1.4 cells: distances are those of middles, and cells touch at a corner before that
        step = np.maximum(clear[at] - 1.4, 0.7) * goes_on
        away[left] += step
        ray[:2] += step * ray[2:]
        goes_on &= away[left] < REACH_M / cell_m
        left, ray = left[goes_on], ray[:, goes_on]
    return Rays.of((away * cell_m).reshape(-1, count), met.reshape(-1, count))


def cast_lattice(number: Numbers, step: int, count: int, *, cell_m: float) -> Rays:
    """Cast rays from the middle of every block of `step` cells a side, row by row, in steps of `STEP_M`.

    `number` has a margin of `margin_of` cells around the blocks. It takes slices of the raster, not one cell after the
    other, and is much faster than `cast`.
    """
    margin = margin_of(step, cell_m)
    rows, cols = ((side - 2 * margin) // step for side in number.shape)
    # Cells that lie alike within their blocks are neighbours: each step of a ray is then one slice for all places.
    phases = np.ascontiguousarray(
        number.reshape(number.shape[0] // step, step, number.shape[1] // step, step).transpose(1, 3, 0, 2)
    )

    def shifted(down: int, right: int) -> Numbers:
        row, col = margin + step // 2 + down, margin + step // 2 + right
        part = phases[row % step, col % step, row // step : row // step + rows, col // step : col // step + cols]
        return np.asarray(part)

    met = np.zeros((count, rows, cols), dtype=np.int32)
    away_m = np.zeros((count, rows, cols), dtype=np.float32)
    for angle, into, far in zip(2 * np.pi * np.arange(count) / count, met, away_m, strict=True):
        for range_m in np.arange(REACH_M - STEP_M, -STEP_M / 2, -STEP_M):  # what is nearer overwrites
            along = range_m / cell_m
            found = shifted(round(-along * np.cos(angle)), round(along * np.sin(angle)))
            ends = found != 0
            np.copyto(into, found, where=ends)
            np.copyto(far, np.float32(range_m), where=ends)
    return Rays.of(away_m.reshape(count, -1).T, np.ascontiguousarray(met.reshape(count, -1).T))


def margin_of(step: int, cell_m: float) -> int:
    """Return the margin that rays of a lattice need: a whole number of its steps, cells."""
    return int(np.ceil(REACH_M / cell_m / step)) * step


@dataclass(frozen=True, kw_only=True)
class BuildingMap:
    """Buildings of a map: `states`, uint8 of shape (rows, cols), ABSENT, PRESENT or UNKNOWN."""

    grid: sgb.Grid
    states: NDArray[np.uint8]

    @classmethod
    def of(cls, region: sgb.Region) -> Self:
        """Read a map; without buildings nothing is known."""
        if CLASS not in region.classes:
            return cls(grid=region.grid, states=np.full(region.grid.shape, sgb.UNKNOWN, dtype=np.uint8))
        layer = region.layer(CLASS)
        return cls(grid=region.grid, states=np.where(layer > sgb.PRESENT, sgb.UNKNOWN, layer).astype(np.uint8))

    def lattice(self, step: int, count: int) -> Iterator[tuple[Points, Rays]]:
        """Yield open ground in the middles of blocks of `step` cells a side, tile by tile, and its rays."""
        cell_m, margin = self.grid.cell_size_m, margin_of(step, self.grid.cell_size_m)
        blocks = self.grid.window(0, 0, self.grid.rows // step * step, self.grid.cols // step * step)
        for row, col, tile in blocks.windows(max(1, _TILE // step) * step):
            window = (row - margin, col - margin, tile.rows + 2 * margin, tile.cols + 2 * margin)
            rays = cast_lattice(numbered(self._window(*window)), step, count, cell_m=cell_m)
            cells = np.indices((tile.rows // step, tile.cols // step)).reshape(2, -1).T * step + step // 2
            is_open = self.states[row + cells[:, 0], col + cells[:, 1]] == sgb.ABSENT
            yield tile.to_centres_m(cells)[is_open], rays.taken(is_open)

    def rays(self, places_m: Points, count: int) -> Rays:
        """Cast rays from places, shape (N, 2)."""
        cell_m = self.grid.cell_size_m
        reach = int(np.ceil(REACH_M / cell_m)) + 1
        cells, uv = self.grid.to_cells(places_m), self.grid.to_uv(places_m)
        range_m, building = (
            np.zeros((len(cells), count), dtype=np.float32),
            np.zeros((len(cells), count), dtype=np.int32),
        )
        is_censored = np.zeros((len(cells), count), dtype=bool)
        tiles, which = np.unique(cells // (_TILE // 2), axis=0, return_inverse=True)
        for tile in range(len(tiles)):
            chosen = np.flatnonzero(which.ravel() == tile)
            top, left = cells[chosen].min(axis=0) - reach
            rows, cols = cells[chosen].max(axis=0) + reach + 1 - (top, left)
            found = cast(self._window(top, left, rows, cols), uv[chosen] - (left, top), count, cell_m=cell_m)
            range_m[chosen], building[chosen] = found.range_m, found.building
            is_censored[chosen] = found.is_censored
        return Rays(range_m=range_m, building=building, is_censored=is_censored)

    def _window(self, row: int, col: int, rows: int, cols: int) -> NDArray[np.uint8]:
        """Cut a window that begins at a cell; beyond the map it is unknown."""
        found = np.full((rows, cols), sgb.UNKNOWN, dtype=np.uint8)
        into, part = sgb.window_overlap((rows, cols), self.grid.shape, -row, -col)
        found[into] = self.states[part]
        return found
