# SPDX-License-Identifier: Apache-2.0
"""Find what each pixel of a camera sees first: rays marched over a height raster, all at once."""

from collections.abc import Iterator
from dataclasses import dataclass
from functools import lru_cache
from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

from sasgeo_bench.geometry.grid import Grid
from sasgeo_bench.sensing.camera import Camera
from sasgeo_bench.sensing.intrinsics import Intrinsics
from sasgeo_bench.sensing.rendering.plan import Mask
from sasgeo_bench.sensing.rendering.texture import Field

_STRIDE: Final = 8  # pixels between the rays for which the highest thing is looked up
_STRIP_PX: Final = 96  # a multiple of the stride
_STEP_CELLS: Final = 0.9
_LOW_M: Final = 0.05  # what is lower casts no ray off its way
_CHUNK: Final = 32_768  # rays followed at a time, so that they stay in the cache
_AT_ONCE: Final = 4  # steps
_AHEAD: Final = np.arange(_AT_ONCE, dtype=np.float32)[:, None]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Hits:
    """First surfaces that the pixels of a picture see, all of shape (H, W), float32.

    `col` and `row` are continuous cells of the scene (pixel-is-area), `z_m` the height there, `cells_px` how many cells
    a pixel is wide on the ground, `fall` how steeply a ray falls (sine). `is_side` marks walls and flanks of crowns;
    `is_ground` is False above the horizon. `ahead` (2, H, W) is the direction of the ray in plan, cells (col, row)
    per metre of fall.
    """

    col: Field
    row: Field
    z_m: Field
    cells_px: Field
    fall: Field
    ahead: Field
    is_side: Mask
    is_ground: Mask


class HeightPyramid:
    """A height raster and, for each level, the highest cell in and around every block of 2 ** level cells.

    The raster is taken over, not copied; its border is made level ground.
    """

    def __init__(self, height_m: Field) -> None:
        height_m[[0, -1]] = 0
        height_m[:, [0, -1]] = 0
        self.height_m = height_m
        level = height_m
        levels: list[Field] = []
        while max(level.shape) > 4 or not levels:
            level = _halved(level)
            levels.append(np.asarray(cv2.dilate(level, np.ones((3, 3), np.uint8)), dtype=np.float32))
        self._rows, self._cols = (np.array([1, *(part.shape[axis] for part in levels)], np.int32) for axis in (0, 1))
        self._start = np.cumsum([0, 0, *(part.size for part in levels)], dtype=np.int32)
        self._blocks = np.concatenate([part.ravel() for part in levels])
        self.highest_m = float(levels[-1].max())

    def highest_within(self, col: Field, row: Field, radius: Field) -> Field:
        """Return at least the highest cell within a radius (cells) of each point; far outside, that of the edge."""
        # The exponent of a number x in [1, inf) is the least n with x < 2 ** n.
        level = np.minimum(np.frexp(np.maximum(radius, 1))[1], len(self._rows) - 1)
        rows, cols = self._rows[level], self._cols[level]
        at_row = np.minimum(np.maximum(row, 0).astype(np.int32) >> level, rows - 1)
        at_col = np.minimum(np.maximum(col, 0).astype(np.int32) >> level, cols - 1)
        found = self._blocks.take(self._start[level] + at_row * cols + at_col)
        return np.where(radius <= np.float32(2.0) ** (len(self._rows) - 1), found, np.float32(self.highest_m))


def _halved(values: Field) -> Field:
    if values.shape[0] % 2 or values.shape[1] % 2:
        values = np.pad(values, [(0, count % 2) for count in values.shape])
    rows = np.maximum(values[::2], values[1::2])
    return np.maximum(rows[:, ::2], rows[:, 1::2])


@lru_cache(maxsize=4)
def _slopes(lens: Intrinsics) -> NDArray[np.float32]:
    """Return the slopes of all pixel centres, shape (2, H, W)."""
    down, right = np.mgrid[0 : lens.height_px, 0 : lens.width_px].astype(np.float64) + 0.5
    found = lens.to_slopes(np.stack([right.ravel(), down.ravel()], axis=1))
    slopes = np.ascontiguousarray(found.T.reshape(2, lens.height_px, lens.width_px), dtype=np.float32)
    slopes.flags.writeable = False
    return slopes


def strips(camera: Camera) -> Iterator[slice]:
    """Yield strips of a picture's rows: what is computed strip by strip stays in the cache of a core."""
    for row in range(0, camera.intrinsics.height_px, _STRIP_PX):
        yield slice(row, min(row + _STRIP_PX, camera.intrinsics.height_px))


def trace_down(pixels: Grid, grid: Grid) -> Hits:
    """Return what vertical rays through the pixels of one lattice see of a raster on another; heights are left at 0."""
    rows, cols = np.indices(pixels.shape).reshape(2, -1)
    uv = grid.to_uv(pixels.to_centres_m(np.column_stack([rows, cols])))
    col, row = uv.astype(np.float32).T.reshape(2, *pixels.shape)
    flat = np.zeros_like(col)
    return Hits(
        col=col,
        row=row,
        z_m=flat,
        cells_px=np.full_like(col, pixels.cell_size_m / grid.cell_size_m),
        fall=np.ones_like(col),
        ahead=np.zeros((2, *col.shape), dtype=np.float32),
        is_side=np.zeros(col.shape, dtype=bool),
        is_ground=np.ones(col.shape, dtype=bool),
    )


def trace(camera: Camera, grid: Grid, heights: HeightPyramid, rows: slice) -> Hits:
    """Return what some rows of pixels see of a height raster on a grid; the ground plane is at 0.

    Notes
    -----
    A point of a ray is linear in its height z. For blocks of 8 x 8 pixels a pyramid of maxima bounds the highest thing
    that their rays can meet; from there rays go down in steps of about a cell (or of a pixel, if that is wider) until
    the raster is above them. Rays over open ground need no step at all.
    """
    right, down = _slopes(camera.intrinsics)[:, rows]
    matrix = camera.matrix.astype(np.float32)
    east, north, up = (right * matrix[0, axis] + down * matrix[1, axis] + matrix[2, axis] for axis in range(3))
    flat = np.hypot(east, north)
    is_ground = up < -0.035 * np.maximum(flat, 1e-6)  # 0.035: a ray that falls less than this per metre sees no ground
    falling = np.where(is_ground, -up, 1.0).astype(np.float32)
    cell = np.float32(grid.cell_size_m)
    ahead = np.stack([east / falling / cell, -north / falling / cell])
    fall = falling / np.sqrt(flat * flat + up * up)
    at = grid.to_uv(np.array([[camera.east_m, camera.north_m]]))[0]
    height = np.float32(camera.height_m)
    col, row = (np.float32(at[axis]) + ahead[axis] * height for axis in (0, 1))
    col, row = (np.clip(part, -1e6, 1e6) for part in (col, row))
    return _march(
        Hits(
            col=col,
            row=row,
            z_m=np.zeros_like(col),
            cells_px=_pixel_cells(col, row),
            fall=fall,
            ahead=ahead,
            is_side=np.zeros(col.shape, dtype=bool),
            is_ground=is_ground,
        ),
        heights,
    )


def _pixel_cells(col: Field, row: Field) -> Field:
    """Return the width of a pixel on the ground plane in cells: the mean of its two sides."""
    small = [
        cv2.resize(part, None, fx=1 / _STRIDE, fy=1 / _STRIDE, interpolation=cv2.INTER_NEAREST) for part in (col, row)
    ]
    if min(small[0].shape) < 2:
        return np.ones_like(col)
    down, right = (np.hypot(np.gradient(small[0], axis=axis), np.gradient(small[1], axis=axis)) for axis in (0, 1))
    size = ((down + right) / 2 / _STRIDE).astype(np.float32)
    return np.asarray(cv2.resize(size, (col.shape[1], col.shape[0]), interpolation=cv2.INTER_LINEAR))


def _ceiling(hits: Hits, heights: HeightPyramid) -> Field:
    """Return a height above everything that the ray of each pixel can meet, shape (H, W)."""
    middle = np.s_[_STRIDE // 2 :: _STRIDE, _STRIDE // 2 :: _STRIDE]
    if min(hits.col.shape) <= _STRIDE:
        return np.full_like(hits.col, heights.highest_m)
    col, row, size = hits.col[middle], hits.row[middle], hits.cells_px[middle]
    ahead = hits.ahead[:, *middle]
    run = np.hypot(ahead[0], ahead[1])
    ceiling = np.full(col.shape, heights.highest_m, dtype=np.float32)
    for _ in range(4):
        half = ceiling / 2
        radius = 0.8 * _STRIDE * size + run * half
        ceiling = np.minimum(ceiling, heights.highest_within(col - ahead[0] * half, row - ahead[1] * half, radius))
    whole = np.repeat(np.repeat(ceiling, _STRIDE, axis=0), _STRIDE, axis=1)
    rows, cols = hits.col.shape
    return np.pad(whole, ((0, max(0, rows - whole.shape[0])), (0, max(0, cols - whole.shape[1]))), mode="edge")[
        :rows, :cols
    ]


def _march(hits: Hits, heights: HeightPyramid) -> Hits:
    """Follow the rays that may meet something down to it; fill in column, row, height and side of what they meet."""
    ceiling = np.where(hits.is_ground, _ceiling(hits, heights), 0)
    pixel = np.flatnonzero(ceiling > _LOW_M)
    top = ceiling.ravel()[pixel]
    for part in (0.0, 0.5, 0.5):  # now for each ray alone: its whole way, then the upper half of it
        col, row, ahead_col, ahead_row = _rays(hits, pixel)
        middle, half = top * np.float32((1 + part) / 2), top * np.float32((1 - part) / 2)
        radius = np.hypot(ahead_col, ahead_row) * half + 1
        found = heights.highest_within(col - ahead_col * middle, row - ahead_row * middle, radius)
        top = np.clip(found, top * np.float32(part), top)
        if not part:
            pixel, top = pixel[top > _LOW_M], top[top > _LOW_M]
    for start in range(0, len(pixel), _CHUNK):
        _follow(hits, heights.height_m, pixel[start : start + _CHUNK], top[start : start + _CHUNK])
    return hits


def _rays(hits: Hits, pixel: NDArray[np.int64]) -> tuple[Field, Field, Field, Field]:
    """Return where rays meet the ground plane, column and row, and how far they go per metre of fall."""
    ahead_col, ahead_row = hits.ahead[0].ravel()[pixel], hits.ahead[1].ravel()[pixel]
    return hits.col.ravel()[pixel], hits.row.ravel()[pixel], ahead_col, ahead_row


def _follow(hits: Hits, raster: Field, pixel: NDArray[np.int64], top: Field) -> None:
    """Follow some rays down from a height, a few steps at a time."""
    ground_col, ground_row, ahead_col, ahead_row = _rays(hits, pixel)
    size = np.maximum(_STEP_CELLS, 0.75 * hits.cells_px.ravel()[pixel])
    fall = top / (np.ceil(np.hypot(ahead_col, ahead_row) * top / size) + 1)
    rays = np.stack([ground_col, ground_row, ahead_col, ahead_row, top, fall])
    scratch = _Scratch(len(pixel))
    while len(pixel):
        z_m, found = scratch.look(raster, rays)
        met = found >= z_m
        has_met = np.logical_or.reduce(met, axis=0)
        chosen = np.flatnonzero(has_met)
        step, ended = met[:, chosen].argmax(axis=0), rays.take(chosen, axis=1)
        here_m = np.maximum(z_m[step, chosen], 0)  # the ground plane, where the last step went below it
        at = pixel[chosen]
        hits.col.ravel()[at] = ended[0] - ended[2] * here_m
        hits.row.ravel()[at] = ended[1] - ended[3] * here_m
        hits.z_m.ravel()[at] = here_m
        # 0.6 m: higher above the point that a ray meets, a cell shows its flank there
        hits.is_side.ravel()[at] = found[step, chosen] - here_m > ended[5] + np.float32(0.6)
        left = np.flatnonzero(~has_met)
        pixel, rays = pixel[left], rays.take(left, axis=1)
        rays[4] -= _AT_ONCE * rays[5]


class _Scratch:
    """Memory for the steps of at most `count` rays, used again for each few steps: fresh memory costs as much."""

    def __init__(self, count: int) -> None:
        self._fields = np.empty((3, _AT_ONCE * count), dtype=np.float32)
        self._numbers = np.empty((2, _AT_ONCE * count), dtype=np.int32)

    def look(self, raster: Field, rays: Field) -> tuple[Field, Field]:
        """Return heights of the next steps of rays, shape (steps, N), and the heights of the cells under them."""
        # Beyond the raster those are 0, as its border is level ground.
        (rows, cols), count = raster.shape, rays.shape[1]
        z_m, col, row = self._fields[:, : _AT_ONCE * count].reshape(3, _AT_ONCE, count)
        cell, at_col = self._numbers[:, : _AT_ONCE * count].reshape(2, _AT_ONCE, count)
        ground_col, ground_row, ahead_col, ahead_row, top, fall = rays
        np.multiply(_AHEAD, fall, out=z_m)
        np.subtract(top, z_m, out=z_m)
        np.multiply(ahead_col, z_m, out=col)
        np.subtract(ground_col, col, out=col)
        np.multiply(ahead_row, z_m, out=row)
        np.subtract(ground_row, row, out=row)
        if col.min() < 0 or row.min() < 0 or col.max() >= cols or row.max() >= rows:
            np.clip(col, 0, cols - 1, out=col)
            np.clip(row, 0, rows - 1, out=row)
        np.copyto(cell, row, casting="unsafe")
        np.copyto(at_col, col, casting="unsafe")
        cell *= np.int32(cols)
        cell += at_col
        return z_m, raster.ravel().take(cell, out=col, mode="clip")  # "clip" spares numpy a copy: all cells are inside
