# SPDX-License-Identifier: Apache-2.0
"""Descriptors of `lsvl_belief`: shares of the classes in the parts of a view, and of a map around every cell."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final, Self

import cv2
import numpy as np
from numpy.typing import NDArray

import sasgeo_bench as sgb
from sasgeo_baselines.trackers.grid_filter import Floats

CELL_M: Final = 16.0  # of the map
SIDE: Final = 4  # parts of a view along each of its sides

_LEAST_KNOWN: Final = 0.25  # share of a part below which it says nothing
_HALF: Final = 0.5
_FULL: Final = 255


@dataclass(frozen=True, kw_only=True)
class Parts:
    """Descriptor of a view: of each part, the square roots of the shares of the classes.

    `roots` and `known` have shape (P, C), `known` is 1 where enough of the part is known to have a share; `places_m`,
    shape (P, 2), are the middles of the parts, right and up, metres.
    """

    roots: Floats
    known: Floats
    places_m: NDArray[np.float64]

    @classmethod
    def of(cls, evidence: sgb.Evidence, classes: Sequence[str]) -> Self:
        """Describe a view in the classes of a map; classes that it lacks are unknown."""
        rows, cols = (count // SIDE * SIDE for count in evidence.shape)
        roots, known = np.zeros((SIDE**2, len(classes))), np.zeros((SIDE**2, len(classes)))
        for at, name in enumerate(classes):
            if name in evidence.classes:
                layer = evidence.layer(name)[:rows, :cols].reshape(SIDE, rows // SIDE, SIDE, cols // SIDE)
                seen = (layer != sgb.UNKNOWN).mean(axis=(1, 3)).ravel()
                present = (layer == sgb.PRESENT).mean(axis=(1, 3)).ravel()
                known[:, at] = seen >= _LEAST_KNOWN
                roots[:, at] = np.sqrt(present / np.maximum(seen, _LEAST_KNOWN)) * known[:, at]
        width_m, height_m = evidence.size_m
        middles = (np.arange(SIDE) + _HALF) / SIDE - _HALF
        up, right = np.meshgrid(-middles * height_m, middles * width_m, indexing="ij")
        return cls(
            roots=roots.astype(np.float32),
            known=known.astype(np.float32),
            places_m=np.column_stack((right.ravel(), up.ravel())),
        )


@dataclass(frozen=True, kw_only=True)
class Shares:
    """Shares of cells that a map's classes cover, uint8 of shape (C, rows, cols), 0..255, and shares that are known."""

    grid: sgb.Grid
    classes: tuple[str, ...]
    present: NDArray[np.uint8]
    known: NDArray[np.uint8]

    @classmethod
    def of(cls, region: sgb.Region) -> Self:
        """Read a map in cells of a whole number of its own, of about `CELL_M`."""
        factor = max(1, round(CELL_M / region.grid.cell_size_m))
        grid = region.grid.coarsen(factor)
        is_known = region.known()
        classes = tuple(name for name in region.classes if (region.layer(name) == sgb.PRESENT).any())
        present = np.zeros((len(classes), *grid.shape), dtype=np.uint8)
        for name, into in zip(classes, present, strict=True):
            into[:] = _share((region.layer(name) == sgb.PRESENT) & is_known, grid, factor)
        return cls(grid=grid, classes=classes, present=present, known=_share(is_known, grid, factor))

    def described(self, part_m: float) -> "Described":
        """Average over discs as large as a part of a view, so that the heading does not matter."""
        # Round kernel with a sum of 1
        radius = part_m / math.sqrt(math.pi) / self.grid.cell_size_m
        reach = math.ceil(radius)
        away = np.arange(-reach, reach + 1) ** 2
        kernel = np.clip(radius + _HALF - np.sqrt(away[:, None] + away), 0.0, 1.0).astype(np.float32)
        disc = np.asarray(kernel / kernel.sum())
        known = _averaged(self.known, disc)
        roots = np.zeros(self.present.shape, dtype=np.float32)
        for present, into in zip(self.present, roots, strict=True):
            into[:] = np.sqrt(_averaged(present, disc) / np.maximum(known, _HALF))
        return Described(
            grid=self.grid, classes=self.classes, roots=roots, known=(known >= _HALF).astype(np.float32), part_m=part_m
        )


@dataclass(frozen=True, kw_only=True)
class Described:
    """A map by the square roots of the shares of its classes around each cell, float32 of shape (C, rows, cols).

    `known`, shape (rows, cols), is 1 where at least half of what is around is known. `part_m` is the side of the parts
    of views to compare it with.
    """

    grid: sgb.Grid
    classes: tuple[str, ...]
    roots: Floats
    known: Floats
    part_m: float

    def compared(self, view: Parts, cells: sgb.Grid) -> "Compared":
        """Compare the parts of a view with the map around each of some cells of its grid, on the map or beyond."""
        reach = math.ceil(float(np.hypot(*view.places_m.T).max()) / self.grid.cell_size_m) + 1
        wide = cells.window(-reach, -reach, cells.rows + 2 * reach, cells.cols + 2 * reach)
        corner = self.grid.to_uv(np.array([(wide.west_m, wide.north_m)]))[0]
        into, part = sgb.window_overlap(wide.shape, self.grid.shape, -round(float(corner[1])), -round(float(corner[0])))
        roots, known = self.roots[(slice(None), *part)], self.known[part]
        sums = np.zeros((len(view.roots), *wide.shape), dtype=np.float32)
        counts = np.zeros_like(sums)
        for total, count, own, mask in zip(sums, counts, view.roots, view.known, strict=True):
            total[into] = np.einsum("c,cij->ij", mask, (roots - own[:, None, None]) ** 2) * known
            count[into] = mask.sum() * known
        return Compared(view=view, cells=cells, reach=reach, sums=sums, counts=counts)


@dataclass(frozen=True, kw_only=True)
class Compared:
    """Squared distances between each part of a view and the map around each cell, summed over `counts` classes.

    Both have shape (P, rows + 2 reach, cols + 2 reach). Descriptors of all headings follow by moving the parts: the map
    is averaged over discs, which a turn does not change.
    """

    view: Parts
    cells: sgb.Grid
    reach: int
    sums: Floats
    counts: Floats

    def distances(self, yaw_deg: float) -> Floats:
        """Return root mean square distances of descriptors at a heading, shape (rows, cols); NaN where none is known.

        Places of parts are rounded to whole cells.
        """
        rows, cols = self.cells.shape
        total, count = np.zeros((2, rows, cols), dtype=np.float32)
        shifts = self.view.places_m @ sgb.rotation(yaw_deg).T / self.cells.cell_size_m
        for (east, north), sums, counts in zip(
            shifts.round().astype(int).tolist(), self.sums, self.counts, strict=True
        ):
            row, col = self.reach - north, self.reach + east
            total += sums[row : row + rows, col : col + cols]
            count += counts[row : row + rows, col : col + cols]
        return np.sqrt(total / np.where(count > 0, count, np.float32(np.nan)))


def _share(layer: NDArray[np.bool_], grid: sgb.Grid, factor: int) -> NDArray[np.uint8]:
    """Return the share of each cell of a coarser grid, 0..255."""
    around = [(0, count * factor - size) for count, size in zip(grid.shape, layer.shape, strict=True)]
    marked = np.pad(layer.view(np.uint8) * np.uint8(_FULL), around)
    return np.asarray(cv2.resize(marked, (grid.cols, grid.rows), interpolation=cv2.INTER_AREA), dtype=np.uint8)


def _averaged(shares: NDArray[np.uint8], kernel: Floats) -> Floats:
    """Return shares, 0..1, averaged over a kernel."""
    layer = shares.astype(np.float32) / np.float32(_FULL)
    return np.asarray(cv2.filter2D(layer, -1, kernel, borderType=cv2.BORDER_CONSTANT), dtype=np.float32)
