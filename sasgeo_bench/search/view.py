# SPDX-License-Identifier: Apache-2.0
"""Templates of a view: turned onto the map lattice, sampled, and scored at single poses."""

import math
from dataclasses import dataclass
from typing import Self, TypeVar

import cv2
import numpy as np
from numpy.typing import NDArray

from sasgeo_bench.geometry.grid import Grid
from sasgeo_bench.geometry.pose import Pose, inverse
from sasgeo_bench.regions.evidence import Evidence
from sasgeo_bench.search.chart import Chart
from sasgeo_bench.search.field import FULL

NOWHERE = -math.inf  # score of a pose with too little of the map in view

Number = TypeVar("Number", np.float32, np.uint8)


@dataclass(frozen=True, kw_only=True)
class View:
    """Template of a view (`votes.make_template`) and the map bands that it weighs.

    `template` is float32 of shape (B + 2, rows, cols), `grid` the lattice of the view with its origin in the middle
    (right and up as east and north), `bands` the indices of its classes among those of the map, shape (B,).
    """

    template: NDArray[np.float32]
    grid: Grid
    bands: NDArray[np.int64]

    @classmethod
    def of(cls, evidence: Evidence, template: NDArray[np.float64], bands: NDArray[np.int64]) -> Self:
        """Make the lattice of a view for its template, of the classes in `bands`."""
        (rows, cols), (width_m, height_m) = evidence.shape, evidence.size_m
        cell_m = evidence.cell_size_m
        grid = Grid(epsg=0, west_m=-width_m / 2, north_m=height_m / 2, cell_size_m=cell_m, rows=rows, cols=cols)
        return cls(template=template.astype(np.float32), grid=grid, bands=bands)

    @property
    def reach_m(self) -> float:
        """Return half a diagonal at scale 1, metres."""
        return math.hypot(self.grid.rows, self.grid.cols) * self.grid.cell_size_m / 2

    def blurred(self, size_m: float) -> NDArray[np.float32]:
        """Return means of the template over squares of about a size, shape (B + 2, rows, cols)."""
        size = 2 * round(size_m / self.grid.cell_size_m / 2) + 1
        return np.stack([cv2.blur(band, (size, size), borderType=cv2.BORDER_CONSTANT) for band in self.template])

    def turned(self, blurred: NDArray[np.float32], pose: Pose, *, half: int, step_m: float) -> NDArray[np.float32]:
        """Resample a blurred template onto a north-up lattice around its middle, shape (B + 2, 2 half + 1, 2 half + 1).

        Only heading and scale of `pose` matter.
        """
        side = 2 * half + 1
        steps_m, zeros = np.arange(-half, half + 1) * step_m, np.zeros(side)
        back = inverse(Pose(easting_m=0.0, northing_m=0.0, yaw_deg=pose.yaw_deg, scale=pose.scale))
        across_m, along_m = (back.to_map(np.column_stack(at)).T for at in ((steps_m, zeros), (zeros, -steps_m)))
        right_m, up_m = along_m[:, :, None] + across_m[:, None, :]
        col = (right_m - self.grid.west_m) / self.grid.cell_size_m
        row = (up_m - self.grid.north_m) / -self.grid.cell_size_m
        inside = (row >= 0) & (row < self.grid.rows) & (col >= 0) & (col < self.grid.cols)
        at = np.where(inside, np.floor(row) * self.grid.cols + np.floor(col), 0).astype(np.int64).ravel()
        laid = blurred.reshape(len(blurred), -1).take(at, axis=1)
        laid *= inside.ravel()
        return laid.reshape(-1, side, side)

    def samples(self, template: NDArray[np.float32], *, stride: int) -> "Samples":
        """Return every `stride`-th cell of a template, one at least, with its place in the view."""
        top, left = (min(stride // 2, count - 1) for count in self.grid.shape)
        rows, cols = np.arange(top, self.grid.rows, stride), np.arange(left, self.grid.cols, stride)
        zeros = np.zeros(1, dtype=np.int64)
        up_m = self.grid.to_centres_m(np.column_stack((rows, zeros.repeat(len(rows)))))[:, 1]
        right_m = self.grid.to_centres_m(np.column_stack((zeros.repeat(len(cols)), cols)))[:, 0]
        chosen = template[:, top::stride, left::stride]
        counts = np.ascontiguousarray(chosen[-1])
        return Samples(
            up_m=up_m,
            right_m=right_m,
            weights=_interleaved(chosen[:-1]),
            counts=counts,
            known=float(counts.sum(dtype=np.float64)),
        )


@dataclass(frozen=True, kw_only=True)
class Samples:
    """Cells of a template: offsets from the middle of the view, weights, and the number of known classes in each.

    `weights` are interleaved as the cells of a `Patch` are; `counts` has their first two axes.
    """

    up_m: NDArray[np.float64]
    right_m: NDArray[np.float64]
    weights: NDArray[np.float32]
    counts: NDArray[np.float32]
    known: float


@dataclass(frozen=True, kw_only=True)
class Patch:
    """Square of the map, cell after cell: `cells` has shape (rows * cols, bands), `known_band` marks known cells.

    A cell holds `full` where a class is certain: cells of the map's own size stay uint8.
    """

    cells: NDArray[np.float32] | NDArray[np.uint8]
    full: float
    known_band: int
    grid: Grid

    @classmethod
    def around(
        cls, chart: Chart, bands: NDArray[np.int64], place_m: tuple[float, float], half_m: float, *, factor: int = 1
    ) -> Self:
        """Read the square of at least `half_m` to each side of a place, in cells of `factor` map cells a side.

        Cells larger than those of the map are means of the nine cells around each.
        """
        row, col = chart.grid.to_cells(np.array([place_m]))[0].tolist()
        half = math.ceil(half_m / chart.grid.cell_size_m / factor)
        side, back = 2 * half + 1, half * factor + factor // 2
        cells: NDArray[np.float32] | NDArray[np.uint8]
        if factor == 1:
            cells, full = _interleaved(chart.steps(row - back, col - back, side, bands)), float(FULL)
        else:
            pooled = chart.pooled(row - back, col - back, side, factor, bands)
            cells, full = _interleaved(np.stack([cv2.blur(band, (3, 3)) for band in pooled])), 1.0
        grid = chart.grid.window(row - back, col - back, side * factor, side * factor).coarsen(factor)
        return cls(cells=cells.reshape(-1, cells.shape[-1]), full=full, known_band=len(bands), grid=grid)

    def score(self, samples: Samples, pose: Pose, *, least_overlap: float) -> float:
        """Return Eq. (8) of a pose, summed over the samples of a view and divided by the number of known cells.

        `NOWHERE` where the map knows less than a share of the cells that the view knows. The square must hold the view.
        """
        # A pose is an affine map, so three points give it, and each sample lies at a sum of two numbers.
        corners = pose.to_map(np.array([(0.0, 0.0), (1.0, 0.0), (0.0, 1.0)]))
        middle, right, up = self.grid.to_uv(corners)
        along = middle[:, None] + (up - middle)[:, None] * samples.up_m
        across = (right - middle)[:, None] * samples.right_m
        total = counted = 0.0
        for rows in _blocks(*samples.counts.shape):
            # No index is negative, so truncation rounds down.
            col, row = (along[:, rows, None] + across[:, None, :]).astype(np.int32)
            found = self.cells.take(row * self.grid.cols + col, axis=0).astype(np.float32, copy=False)
            total += float(np.vdot(found, samples.weights[rows]))
            counted += float(np.vdot(found[..., self.known_band], samples.counts[rows]))
        total, counted = total / self.full, counted / self.full
        if counted < max(least_overlap * samples.known, 1.0 / samples.counts.size):
            return NOWHERE
        return total / counted


def _blocks(rows: int, cols: int) -> list[slice]:
    step = max(1, 16384 // cols)  # 16384 samples
    return [slice(start, start + step) for start in range(0, rows, step)]


def _interleaved(bands: NDArray[Number]) -> NDArray[Number]:
    """Interleave bands, shape (rows, cols, B'), padded with zeros to a power of two, which NumPy looks up faster."""
    spare: int = (1 << (len(bands) - 1).bit_length()) - len(bands)
    merged = cv2.merge([*bands, *np.zeros((spare, *bands.shape[1:]), dtype=bands.dtype)])
    return np.asarray(merged, dtype=bands.dtype).reshape(*bands.shape[1:], -1)
