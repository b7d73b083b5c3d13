# SPDX-License-Identifier: Apache-2.0
"""Scores of a view at all places and headings: correlations of classes in the Fourier domain."""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Final, Self

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy import fft

from sasgeo_bench.geometry.grid import Grid
from sasgeo_bench.geometry.pose import Pose, inverse
from sasgeo_bench.search.field import Level, Template, between, pooled, warped
from sasgeo_bench.search.plan import Tile, Turns
from sasgeo_bench.search.votes import correlated, map_spectrum

_HALF_TURN: Final = 2  # right angles


def around_of(template: Template, grid: Grid, turns: Turns) -> Grid:
    """Return cells of a level around the middle of a view, as many as its largest scale and any heading need."""
    step_m, largest = grid.cell_size_m, max(base.scale for base in turns.bases)
    half = math.ceil(template.reach_m * largest / step_m) + 1
    reach_m, side = (half + 0.5) * step_m, 2 * half + 1
    return Grid(epsg=0, west_m=-reach_m, north_m=reach_m, cell_size_m=step_m, rows=side, cols=side)


def squares_across(template: Template, grid: Grid) -> int:
    """Return how many cells of a view make the side of a square to be resampled onto a level."""
    # 3 squares of the view across a coarse cell before rotation: odd, so that nothing is shifted
    return max(1, round(grid.cell_size_m / template.cell_size_m / 3))


def blur_width(frame: Grid, grid: Grid) -> int:
    """Return how many squares of a view, an odd number, are averaged before they are resampled onto a level."""
    return 2 * math.floor(grid.cell_size_m / frame.cell_size_m / 2) + 1


@dataclass(frozen=True, kw_only=True)
class Correlation:
    """Transforms of the map under each tile, as it is and turned by a right angle, and the template to correlate.

    `bands` of the view on `frame` are resampled onto `around`, cells of the level around its middle. A template is
    transformed once for up to `quarters` headings at right angles to each other.
    """

    bands: NDArray[np.float32]
    frame: Grid
    around: Grid
    size: int
    quarters: int
    shapes: tuple[tuple[int, int], ...]
    spectra: tuple[tuple[NDArray[np.complex64], ...], ...]

    @classmethod
    def of(cls, level: Level, template: Template, tiles: Sequence[Tile], turns: Turns) -> Self:
        """Transform the windows of all tiles once, padded by the reach of the largest template."""
        around = around_of(template, level.grid, turns)
        half = around.rows // 2
        shapes = tuple((tile.allowed.shape[0], tile.allowed.shape[1]) for tile in tiles)
        size = int(fft.next_fast_len(max(max(shape) for shape in shapes) + 2 * half, real=True))
        windows = [
            level.window(tile.row - half, tile.col - half, (rows + 2 * half, cols + 2 * half), template.active)
            for tile, (rows, cols) in zip(tiles, shapes, strict=True)
        ]
        is_used = [any(window[at].any() for window in windows) for at in range(len(template.active))]
        used = np.flatnonzero(is_used) if any(is_used) else np.arange(1)
        spectra = []
        for window in windows:
            turned = (np.rot90(window[used], quarter, (1, 2)) for quarter in range(min(turns.quarters, _HALF_TURN)))
            spectra.append(tuple(map_spectrum(each, (size, size)) for each in turned))
        bands, frame = pooled(template, level, squares_across(template, level.grid))
        bands = bands[used]  # classes that the map lacks here add nothing
        width = blur_width(frame, level.grid)
        bands = np.stack([cv2.blur(band, (width, width), borderType=cv2.BORDER_CONSTANT) for band in bands])
        return cls(
            bands=bands,
            frame=frame,
            around=around,
            size=size,
            quarters=turns.quarters,
            shapes=shapes,
            spectra=tuple(spectra),
        )

    def scores(self, base: Pose) -> Iterator[tuple[int, Pose, NDArray[np.float32]]]:
        """Score all places of every tile for a heading and those at right angles to it."""
        spectra = self.transformed(base)
        for at in range(len(self.shapes)):
            for quarter in range(self.quarters):
                yield at, replace(base, yaw_deg=base.yaw_deg + 90 * quarter), self.score(spectra, at, quarter)

    def transformed(self, base: Pose) -> tuple[NDArray[np.complex64], NDArray[np.complex64]]:
        """Transform the template at the heading and scale of a pose; the second one reads it backwards."""
        # The rows below the template are zeros: half of the work is never done.
        spectrum = fft.fft(fft.rfft(self._laid(base), n=self.size), n=self.size, axis=-2)
        return spectrum, np.conj(spectrum)

    def score(
        self, spectra: tuple[NDArray[np.complex64], NDArray[np.complex64]], at: int, quarter: int
    ) -> NDArray[np.float32]:
        """Score all places of a tile at some right angles from the heading of a transformed template."""
        # A template turned by half a turn is read backwards: the result is shifted by its last cell.
        halves, turned = divmod(quarter, _HALF_TURN)
        first = halves * (self.around.rows - 1)
        high, wide = self.shapes[at][::-1] if turned else self.shapes[at]
        score = correlated(self.spectra[at][turned], spectra[halves], (self.size, self.size))
        return np.ascontiguousarray(np.rot90(score[first : first + high, first : first + wide], -turned))

    def _laid(self, base: Pose) -> NDArray[np.float32]:
        """Resample the view onto cells of the level, rotated and scaled; sums are preserved."""
        to_view = between(self.around, inverse(base), self.frame)
        laid = np.stack([warped(band, to_view, self.around.shape) for band in self.bands])
        return laid * np.float32((self.around.cell_size_m / (base.scale * self.frame.cell_size_m)) ** 2)
