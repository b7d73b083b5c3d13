# SPDX-License-Identifier: Apache-2.0
"""Buildings of views and maps: shares of rings, and one vector of shape for each building."""

from dataclasses import dataclass
from typing import Final, Self

import cv2
import numpy as np
from numpy.typing import NDArray

import sasgeo_bench as sgb

CLASS: Final = "building"
RINGS: Final = 6
RADIUS_M: Final = 96.0  # of the outermost ring
CELL_M: Final = 8.0  # of the map for rings
STRIDE: Final = 3  # cells between windows: 24 m
NUMBERS: Final = 8  # of a shape: six that do not turn with the view, and its direction as two

_TILE: Final = 2048  # cells a side: buildings of a large map are found tile by tile

Floats = NDArray[np.float64]


@dataclass(frozen=True, slots=True, kw_only=True)
class Buildings:
    """Buildings by their middles and shapes.

    `middle_m`, shape (B, 2): easting and northing on a map, right and up in a view. `shape`, shape (B, NUMBERS):
    logarithms of area and elongation, fullness (1 for a rectangle), compactness, two more invariants of moments, and
    the direction of the long side as cosine and sine of twice its angle, clockwise from north or up; rounder buildings
    have less of it.
    """

    middle_m: Floats
    shape: Floats

    def __len__(self) -> int:
        return len(self.middle_m)

    @classmethod
    def of(cls, present: NDArray[np.uint8], usable: NDArray[np.bool_], cell_m: float) -> Self:
        """Find the patches of present cells that lie within the usable ones; middles count from the upper left corner.

        A building beside an unusable cell, or at the edge, is cut off: its shape is not known.
        """
        count, labels, stats, _ = cv2.connectedComponentsWithStats(present, connectivity=4)
        is_cut = np.zeros(count, dtype=bool)
        edge = cv2.erode(
            usable.astype(np.uint8), np.ones((3, 3), np.uint8), borderType=cv2.BORDER_CONSTANT, borderValue=0
        )
        is_cut[np.unique(labels[edge == 0])] = True
        is_kept = ~is_cut & (stats[:, cv2.CC_STAT_AREA] * cell_m**2 >= 20.0)  # 20 m2: smaller patches are no buildings
        is_kept[0] = False
        number = np.cumsum(is_kept) - 1
        rows, cols = np.nonzero(is_kept[labels])
        label = number[labels[rows, cols]]
        rims_m = np.bincount(label, weights=_rim(present)[rows, cols] * cell_m, minlength=int(is_kept.sum()))
        rim_m = rims_m.astype(np.float64)
        return cls._measured(label, np.stack([cols + 0.5, -rows - 0.5]) * cell_m, rim_m, cell_m)

    @classmethod
    def _measured(cls, label: NDArray[np.int64], at_m: Floats, rim_m: Floats, cell_m: float) -> Self:
        """Measure buildings by their cells, of shape (2,) + that of `label`, the number of the building of each."""
        cells = np.bincount(label, minlength=len(rim_m)).astype(np.float64)

        def mean(values: Floats) -> Floats:
            return np.asarray(np.bincount(label, weights=values, minlength=len(rim_m)) / cells)

        area_m2 = cells * cell_m**2
        middle_m = np.stack([mean(values) for values in at_m], axis=1)
        x, y = at_m - middle_m[label].T
        xx, yy, xy = mean(x * x) + cell_m**2 / 12, mean(y * y) + cell_m**2 / 12, mean(x * y)
        difference, far = np.hypot(xx - yy, 2 * xy), x * x + y * y
        long, short = (xx + yy + difference) / 2, (xx + yy - difference) / 2
        direction = np.arctan2(2 * xy, yy - xx)  # twice the angle, clockwise from up
        roundness = difference / (xx + yy)
        shape = [
            np.log(area_m2),
            np.log(long / short) / 2,
            area_m2 / np.sqrt(long * short) / 12,
            4 * np.pi * area_m2 / np.maximum(rim_m, cell_m) ** 2,
            (xx + yy) / area_m2,
            np.cbrt(np.hypot(mean(x * far), mean(y * far))) / np.sqrt(area_m2),
            roundness * np.cos(direction),
            roundness * np.sin(direction),
        ]
        return cls(middle_m=middle_m, shape=np.stack(shape, axis=1))

    @classmethod
    def of_view(cls, evidence: sgb.Evidence) -> Self:
        """Find the buildings of a view."""
        if CLASS not in evidence.classes:
            return cls(middle_m=np.empty((0, 2)), shape=np.empty((0, NUMBERS)))
        layer = evidence.layer(CLASS)
        found = cls.of((layer == sgb.PRESENT).astype(np.uint8), layer != sgb.UNKNOWN, evidence.cell_size_m)
        width_m, height_m = evidence.size_m
        return cls(middle_m=found.middle_m + np.array([-width_m / 2, height_m / 2]), shape=found.shape)

    @classmethod
    def of_map(cls, region: sgb.Region) -> Self:
        """Find the buildings of a map, tile by tile."""
        grid, parts = region.grid, []
        if CLASS not in region.classes:
            return cls(middle_m=np.empty((0, 2)), shape=np.empty((0, NUMBERS)))
        # 128 m: margin around a tile; a building that is cut by it is wider than that
        layer, margin = region.layer(CLASS), int(np.ceil(128.0 / grid.cell_size_m))
        for row, col, tile in grid.windows(_TILE):
            top, left = max(row - margin, 0), max(col - margin, 0)
            part = layer[top : row + tile.rows + margin, left : col + tile.cols + margin]
            found = cls.of((part == sgb.PRESENT).astype(np.uint8), part <= sgb.PRESENT, grid.cell_size_m)
            corner_m = (grid.west_m + left * grid.cell_size_m, grid.north_m - top * grid.cell_size_m)
            middle_m = found.middle_m + corner_m
            west_m, south_m, east_m, north_m = tile.bounds_m
            is_own = (middle_m >= (west_m, south_m)).all(axis=1) & (middle_m < (east_m, north_m)).all(axis=1)
            parts.append((middle_m[is_own], found.shape[is_own]))
        middles, shapes = zip(*parts, strict=True)
        return cls(middle_m=np.concatenate(middles), shape=np.concatenate(shapes))

    def turned(self, yaw_deg: float) -> Floats:
        """Return the shapes of a view in the axes of a map, if the view heads so, shape (B, NUMBERS)."""
        turn = np.radians(2 * yaw_deg)
        first, second = self.shape[:, -2], self.shape[:, -1]
        shape = self.shape.copy()
        shape[:, -2] = first * np.cos(turn) - second * np.sin(turn)
        shape[:, -1] = first * np.sin(turn) + second * np.cos(turn)
        return shape


def _rim(present: NDArray[np.uint8]) -> Floats:
    """Return the part of each present cell in the length of the rim, in cells, whatever its direction (Crofton)."""
    padded = np.pad(present, 1)
    rows, cols = present.shape
    total = np.zeros(present.shape)
    for down, right in ((0, 1), (1, 0), (1, 1), (1, -1)):
        for sign in (-1, 1):
            top, left = 1 + sign * down, 1 + sign * right
            absent = padded[top : top + rows, left : left + cols] == 0
            total += absent / np.hypot(down, right)
    return np.asarray(np.where(present > 0, total * np.pi / 8, 0.0))


@dataclass(frozen=True, kw_only=True)
class Windows:
    """Shares of building area in rings around places of a map: `middle_m`, shape (W, 2), `share`, shape (W, RINGS)."""

    middle_m: Floats
    share: NDArray[np.float32]
    mean: NDArray[np.float32]
    spread: NDArray[np.float32]

    @classmethod
    def of(cls, region: sgb.Region) -> Self:
        """Measure rings around places 24 m apart."""
        grid = region.grid
        west_m, south_m, east_m, north_m = grid.bounds_m
        cols, rows = max(1, round((east_m - west_m) / CELL_M)), max(1, round((north_m - south_m) / CELL_M))
        share = np.zeros((rows, cols), dtype=np.float32)
        if CLASS in region.classes:
            present = (region.layer(CLASS) == sgb.PRESENT).astype(np.uint8) * np.uint8(255)
            share = cv2.resize(present, (cols, rows), interpolation=cv2.INTER_AREA).astype(np.float32) / 255
        at = (np.arange(2 * round(RADIUS_M / CELL_M) + 1) - round(RADIUS_M / CELL_M)) * CELL_M
        ring = np.floor(np.hypot(at[:, None], at[None, :]) / RADIUS_M * RINGS)
        kernels = [(ring == number).astype(np.float32) for number in range(RINGS)]
        rings = [
            cv2.filter2D(share, -1, kernel / kernel.sum(), borderType=cv2.BORDER_CONSTANT)[::STRIDE, ::STRIDE]
            for kernel in kernels
        ]
        east_m_, north_m_ = np.meshgrid(
            west_m + (np.arange(cols)[::STRIDE] + 0.5) * CELL_M, north_m - (np.arange(rows)[::STRIDE] + 0.5) * CELL_M
        )
        stacked = np.stack([np.asarray(part, dtype=np.float32).ravel() for part in rings], axis=1)
        return cls(
            middle_m=np.stack([east_m_.ravel(), north_m_.ravel()], axis=1),
            share=stacked,
            mean=stacked.mean(axis=0),
            spread=np.maximum(stacked.std(axis=0), np.float32(1e-3)),
        )

    def nearest(
        self, share: NDArray[np.float64], *, count: int, place_m: tuple[float, float], radius_m: float
    ) -> Floats:
        """Return the middles of the windows whose rings are most like those of a view, shape (<= count, 2).

        Only windows within a disc are compared, and rings that are known (not NaN), by the distance of z-scores.
        """
        within = np.flatnonzero(sgb.offsets_m(self.middle_m, place_m) <= radius_m)
        known = ~np.isnan(share)
        away = ((self.share[within] - share) / self.spread)[:, known]
        best = np.argsort(np.square(away).sum(axis=1), kind="stable")[:count]
        return self.middle_m[within[best]]


def ring_shares(evidence: sgb.Evidence) -> Floats:
    """Return the share of building area in each ring of a view, NaN where too little is known."""
    height, width = evidence.shape
    down_m = (np.arange(height) + 0.5 - height / 2) * evidence.cell_size_m
    right_m = (np.arange(width) + 0.5 - width / 2) * evidence.cell_size_m
    away_m = np.hypot(down_m[:, None], right_m[None, :])
    inside = away_m < RADIUS_M
    ring = np.floor(away_m[inside] / RADIUS_M * RINGS).astype(np.int64)
    layer = evidence.layer(CLASS)[inside] if CLASS in evidence.classes else np.full(len(ring), sgb.UNKNOWN)
    known = np.bincount(ring, weights=layer != sgb.UNKNOWN, minlength=RINGS)
    present = np.bincount(ring, weights=layer == sgb.PRESENT, minlength=RINGS)
    area = np.pi * np.square(np.arange(1, RINGS + 1) * RADIUS_M / RINGS)
    cells = np.diff(area, prepend=0.0) / evidence.cell_size_m**2
    # 0.25 of a ring; else it is not compared
    return np.asarray(np.where(known >= 0.25 * cells, present / np.maximum(known, 1), np.nan))
