# SPDX-License-Identifier: Apache-2.0
"""Templates of a view: turned onto the map lattice, sampled, and scored at single poses."""

import math
from contextlib import suppress
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Final, Self, TypeVar

import cv2
import numpy as np
from numpy.typing import NDArray

from sasgeo_bench.core.arrays import map_arrays, save_arrays
from sasgeo_bench.core.errors import StoreError
from sasgeo_bench.geometry.grid import Grid
from sasgeo_bench.geometry.pose import Pose, inverse
from sasgeo_bench.regions.evidence import ABSENT, PRESENT, UNKNOWN, Evidence
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
        kept = region.kept("chart", thin=list(thin), reach_m=reach_m)
        with suppress(StoreError):  # removed meanwhile: it is made
            if kept is not None:
                return cls.open(kept, region)
        known = region.known()
        degree = np.empty((len(region.classes), *region.grid.shape), dtype=np.uint8)
        for name, layer in zip(region.classes, degree, strict=True):
            present = (region.layer(name) == PRESENT) & known
            if name in thin and reach_m > 0:
                faded = np.rint(FULL * fade(present, reach_cells=reach_m / region.grid.cell_size_m))
                layer[:] = np.where(present, FULL, np.minimum(faded, FULL - 1)) * known
            else:
                np.multiply(present, np.uint8(FULL), out=layer)
        return cls(
            grid=region.grid, classes=region.classes, degree=degree, known=np.where(known, np.uint8(FULL), np.uint8(0))
        )

    @classmethod
    def open(cls, folder: Path, region: Region) -> Self:
        """Map what `save` wrote of a region into memory; raise `StoreError` if it is missing or damaged."""
        found = map_arrays(folder, "degree", "known", "totals")
        chart = cls(grid=region.grid, classes=region.classes, degree=found["degree"], known=found["known"])
        vars(chart)["totals"] = found["totals"]  # to sum them again would read all of the map
        return chart

    def save(self, folder: Path) -> None:
        """Write it to a folder."""
        save_arrays(folder, {"degree": self.degree, "known": self.known, "totals": self.totals})

    @cached_property
    def totals(self) -> NDArray[np.int64]:
        """Return the sum of the cells of each class and, last, that of the known ones, shape (C + 1,)."""
        return np.array([layer.sum(dtype=np.int64) for layer in (*self.degree, self.known)], dtype=np.int64)

    def used(self) -> NDArray[np.bool_]:
        """Return which classes the map holds, shape (C,)."""
        return np.asarray(self.totals[:-1] > 0)

    def shares(self) -> NDArray[np.float64]:
        """Return the mean degree of each class over the known cells, 0..1, shape (C,); 0 where none is known."""
        known = max(int(self.totals[-1]) // FULL, 1)
        return np.asarray(self.totals[:-1] / known / FULL)

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


NOWHERE = -math.inf  # score of a pose with too little of the map in view

Number = TypeVar("Number", np.float32, np.uint8)


@dataclass(frozen=True, kw_only=True)
class View:
    """Template of a view (`vote_search.make_template`) and the map bands that it weighs.

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
        """Resample a blurred template onto a north-up lattice around its middle, shape (B, 2 half + 1, 2 half + 1).

        `blurred` has its B bands last, (rows, cols, B): those of a cell are read together. Only heading and scale of
        `pose` matter.
        """
        side = 2 * half + 1
        steps_m, zeros = np.arange(-half, half + 1) * step_m, np.zeros(side)
        back = inverse(Pose(easting_m=0.0, northing_m=0.0, yaw_deg=pose.yaw_deg, scale=pose.scale))
        across_m, along_m = (back.to_map(np.column_stack(at)).T for at in ((steps_m, zeros), (zeros, -steps_m)))
        right_m, up_m = along_m[:, :, None] + across_m[:, None, :]
        col = (right_m - self.grid.west_m) / self.grid.cell_size_m
        row = (up_m - self.grid.north_m) / -self.grid.cell_size_m
        inside = (row >= 0) & (row < self.grid.rows) & (col >= 0) & (col < self.grid.cols)
        at = (np.floor(row[inside]) * self.grid.cols + np.floor(col[inside])).astype(np.int64)
        laid = np.zeros((blurred.shape[-1], side, side), dtype=blurred.dtype)
        laid[:, inside] = blurred.reshape(-1, len(laid)).take(at, axis=0).T
        return laid

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
