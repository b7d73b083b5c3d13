# SPDX-License-Identifier: Apache-2.0
"""Ground that a camera looks at: a level plane, or heights on a lattice."""

from dataclasses import dataclass, replace
from typing import Final, Self

import numpy as np
import scipy  # its parts are loaded where they are used: what only plans or carries pictures starts without them
from numpy.typing import NDArray

from sasgeo_bench.core.errors import CameraError
from sasgeo_bench.geometry.grid import Grid

Points = NDArray[np.float64]

_MARGIN_M: Final = 0.01  # above the highest and under the lowest ground, against rounding
_LOWEST_M, _HIGHEST_M = -12_000.0, 9_000.0  # what is outside is no height of a ground in metres
_CHUNK: Final = 200_000  # rays followed at a time


@dataclass(frozen=True, slots=True, kw_only=True)
class Plane:
    """Level ground at a height above the datum.

    >>> Plane(height_m=5.0).meet(np.array([0.0, 0.0, 105.0]), np.array([[0.5, 0.0, -1.0], [0.0, 1.0, 0.0]])).tolist()
    [[50.0, 0.0, 5.0], [nan, nan, nan]]
    """

    height_m: float = 0.0

    def __post_init__(self) -> None:
        if not _LOWEST_M <= self.height_m <= _HIGHEST_M:
            raise CameraError(f"the ground lies {_LOWEST_M:g} to {_HIGHEST_M:g} m high, got {self.height_m!r}")

    def heights_m(self, en_m: Points) -> Points:
        """Return the height under each point, shape (N, 2) -> (N,), metres."""
        return np.full(len(en_m), self.height_m)

    def meet(self, origin_m: Points, directions: Points) -> Points:
        """Return where rays from one origin, (3,), in directions (N, 3) meet the plane from above; NaN where never."""
        with np.errstate(divide="ignore", invalid="ignore"):
            along = (self.height_m - origin_m[2]) / directions[:, 2]
            along = np.where((along > 0) & (directions[:, 2] < 0) & np.isfinite(along), along, np.nan)
            points_m = origin_m + along[:, None] * directions
        points_m[np.isfinite(along), 2] = self.height_m
        return points_m


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Dem:
    """Heights at the centres of a lattice, linear between them (bilinear); NaN where unknown and beyond the lattice.

    `grid` counts in the frame of the cameras that look at it; `cells_m`, shape (rows, cols), is made read-only.
    """

    grid: Grid
    cells_m: NDArray[np.float32]

    def __post_init__(self) -> None:
        """Check shape and heights; lock the array."""
        if self.cells_m.shape != self.grid.shape:
            raise CameraError(f"heights for {self.grid.shape} cells have that shape, got {self.cells_m.shape}")
        known = self.cells_m[np.isfinite(self.cells_m)]
        if not len(known) or known.min() < _LOWEST_M or known.max() > _HIGHEST_M:
            found = f"{known.min():g} to {known.max():g}" if len(known) else "none"
            raise CameraError(
                f"heights of a ground lie within {_LOWEST_M:g} and {_HIGHEST_M:g} m, got {found}: "
                "is there a nodata value that the file does not name?"
            )
        self.cells_m.flags.writeable = False

    def relative_to(self, east_m: float, north_m: float, height_m: float = 0.0) -> Self:
        """Return the same ground in a frame whose origin is at a point of this one."""
        grid = replace(self.grid, west_m=self.grid.west_m - east_m, north_m=self.grid.north_m - north_m)
        return replace(self, grid=grid, cells_m=(self.cells_m - np.float32(height_m)))

    def heights_m(self, en_m: Points) -> Points:
        """Return the height under each point, shape (N, 2) -> (N,), metres; NaN off the lattice.

        Half a cell along its edge, where no four centres surround a point, takes the height of the edge's centres.

        >>> grid = Grid(epsg=32632, west_m=0.0, north_m=10.0, cell_size_m=10.0, rows=1, cols=2)
        >>> hill = Dem(grid=grid, cells_m=np.array([[100.0, 110.0]], dtype=np.float32))
        >>> hill.heights_m(np.array([[5.0, 5.0], [10.0, 5.0], [12.0, 5.0], [21.0, 5.0]])).tolist()
        [100.0, 105.0, 107.0, nan]
        """
        uv = self.grid.to_uv(en_m)
        with np.errstate(invalid="ignore"):
            within: NDArray[np.bool_] = np.all((uv >= 0) & (uv <= (self.grid.cols, self.grid.rows)), axis=1)
        at = np.where(within[:, None], uv - 0.5, 0.0)  # the lattice of centres
        found = scipy.ndimage.map_coordinates(self.cells_m, at[:, ::-1].T, order=1, mode="nearest", output=np.float64)
        return np.where(within, found, np.nan)

    def meet(self, origin_m: Points, directions: Points) -> Points:
        """Return where rays from one origin, (3,), in directions (N, 3) first meet the ground from above.

        A ray is followed in steps of half a cell between the highest and the lowest ground, and the step that goes
        under ground is narrowed down; so a ridge thinner than half a cell can be missed. NaN where
        a ray rises, starts under ground, or comes to an unknown height or off the lattice below the highest ground.
        """
        parts = [
            self._meet(np.asarray(origin_m, dtype=np.float64), directions[first : first + _CHUNK])
            for first in range(0, len(directions), _CHUNK)
        ]
        return np.concatenate(parts) if parts else np.empty((0, 3))

    def _meet(self, origin_m: Points, directions: Points) -> Points:
        lowest_m, highest_m = float(np.nanmin(self.cells_m)) - _MARGIN_M, float(np.nanmax(self.cells_m)) + _MARGIN_M
        with np.errstate(divide="ignore", invalid="ignore"):
            start = np.maximum((highest_m - origin_m[2]) / directions[:, 2], 0.0)
            end = (lowest_m - origin_m[2]) / directions[:, 2]
            step = self.grid.cell_size_m / 2 / np.hypot(directions[:, 0], directions[:, 1])
        falling = (directions[:, 2] < 0) & (end > 0)
        step = np.where(falling, np.minimum(step, end - start), 1.0)
        at, found = np.where(falling, start, np.nan), np.full(len(directions), np.nan)
        is_open = falling & (self._clearance_m(origin_m, directions, at) >= 0)
        for _ in range(4_000):  # at most 4_000 steps of one cell each
            rays = np.flatnonzero(is_open)
            if not len(rays):
                break
            clearance_m = self._clearance_m(origin_m, directions[rays], at[rays] + step[rays])
            is_under = clearance_m <= 0
            found[rays[is_under]] = at[rays[is_under]]
            at[rays] += step[rays]
            is_open[rays] = (clearance_m > 0) & (at[rays] <= end[rays] + step[rays])
        return self._narrow(origin_m, directions, found, step)

    def _clearance_m(self, origin_m: Points, directions: Points, along: Points) -> Points:
        """Return how high above ground each ray is at a length along it; NaN where the ground is unknown."""
        points_m = origin_m + along[:, None] * directions
        return points_m[:, 2] - self.heights_m(points_m[:, :2])

    def _narrow(self, origin_m: Points, directions: Points, above: Points, step: Points) -> Points:
        """Halve the step that begins above ground and ends under it."""
        rays = np.flatnonzero(np.isfinite(above))
        low, high, directions_met = above[rays], above[rays] + step[rays], directions[rays]
        for _ in range(8):  # halvings of the step in which a ray met the ground, before the rest is taken for straight
            middle = (low + high) / 2
            is_under = self._clearance_m(origin_m, directions_met, middle) <= 0
            low, high = np.where(is_under, low, middle), np.where(is_under, middle, high)
        # What is left of the step is so short that the ground in it is straight.
        over_m, under_m = (self._clearance_m(origin_m, directions_met, along) for along in (low, high))
        drop_m = np.maximum(over_m - under_m, np.finfo(float).tiny)
        met = np.full((len(directions), 3), np.nan)
        met[rays] = origin_m + (low + (high - low) * over_m / drop_m)[:, None] * directions_met
        return met


Ground = Plane | Dem
