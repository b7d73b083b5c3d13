# SPDX-License-Identifier: Apache-2.0
"""Grid: map metres <-> raster cells; the only file with a half cell in it."""

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Final, Self

import numpy as np
from numpy.typing import NDArray

from sasgeo_bench.core.errors import GridError

Points = NDArray[np.float64]

_SNAP: Final = 1e-6  # of a cell: closer than this to a whole cell counts as that cell, in spite of rounding
_MAX_UTM_DEG: Final = (-80.0, 84.0)


def utm_epsg(lon_deg: float, lat_deg: float) -> int:
    """Return the EPSG code of the plain six-degree UTM zone (WGS 84) around a point; raise `GridError` beyond UTM.

    >>> utm_epsg(9.5, 47.1), utm_epsg(-122.4, 37.8), utm_epsg(18.4, -33.9)
    (32632, 32610, 32734)
    """
    low, high = _MAX_UTM_DEG
    if not (-180 <= lon_deg <= 180 and low <= lat_deg <= high):  # degrees of longitude
        raise GridError(
            f"UTM covers longitudes -180..180 and latitudes {low:g}..{high:g}, got {lon_deg!r}, {lat_deg!r}"
        )
    zone = min(int((lon_deg + 180) // 6) + 1, 60)
    return (32600 if lat_deg >= 0 else 32700) + zone


def _check_cell_size(cell_size_m: float) -> None:
    if not (math.isfinite(cell_size_m) and cell_size_m > 0):
        raise GridError(f"cell_size_m must be positive and finite, got {cell_size_m!r}")


@dataclass(frozen=True, slots=True, kw_only=True)
class Grid:
    """North-up lattice of square cells in one projected CRS.

    Row 0 is the northernmost row. Continuous raster coordinates (u, v) count cells right and down from the outer corner
    of cell (0, 0), whose centre is therefore (0.5, 0.5): pixel-is-area.

    >>> grid = Grid(epsg=32632, west_m=500000.0, north_m=5200000.0, cell_size_m=2.0, rows=100, cols=50)
    >>> grid.bounds_m
    (500000.0, 5199800.0, 500100.0, 5200000.0)
    """

    epsg: int
    west_m: float
    north_m: float
    cell_size_m: float
    rows: int
    cols: int

    def __post_init__(self) -> None:
        _check_cell_size(self.cell_size_m)
        if not (math.isfinite(self.west_m) and math.isfinite(self.north_m)):
            raise GridError(f"west_m and north_m must be finite, got {self.west_m!r}, {self.north_m!r}")
        if self.rows < 1 or self.cols < 1:
            raise GridError(f"a grid has at least one row and one column, got {self.rows!r} x {self.cols!r}")

    @classmethod
    def from_bounds(
        cls, west_m: float, south_m: float, east_m: float, north_m: float, *, cell_size_m: float, epsg: int
    ) -> Self:
        """Return the smallest grid that covers a box and whose edges are whole multiples of the cell size.

        >>> Grid.from_bounds(3.0, 3.0, 9.0, 9.0, cell_size_m=2.0, epsg=32632).bounds_m
        (2.0, 2.0, 10.0, 10.0)
        """
        _check_cell_size(cell_size_m)
        if not (west_m < east_m and south_m < north_m):
            raise GridError(
                f"bounds must grow from west to east and south to north, got {(west_m, south_m, east_m, north_m)!r}"
            )
        left, top = math.floor(west_m / cell_size_m + _SNAP), math.ceil(north_m / cell_size_m - _SNAP)
        right, bottom = math.ceil(east_m / cell_size_m - _SNAP), math.floor(south_m / cell_size_m + _SNAP)
        return cls(
            epsg=epsg,
            west_m=left * cell_size_m,
            north_m=top * cell_size_m,
            cell_size_m=cell_size_m,
            rows=top - bottom,
            cols=right - left,
        )

    @classmethod
    def around(
        cls, easting_m: float, northing_m: float, *, size_m: tuple[float, float], cell_size_m: float, epsg: int
    ) -> Self:
        """Return a grid of a width and height around a point; its edges snap to whole multiples of the cell size.

        >>> Grid.around(100.4, 100.4, size_m=(20.0, 10.0), cell_size_m=1.0, epsg=32632).bounds_m
        (90.0, 95.0, 110.0, 105.0)
        """
        width_m, height_m = size_m
        west = round((easting_m - width_m / 2) / cell_size_m) * cell_size_m
        south = round((northing_m - height_m / 2) / cell_size_m) * cell_size_m
        return cls.from_bounds(west, south, west + width_m, south + height_m, cell_size_m=cell_size_m, epsg=epsg)

    @property
    def shape(self) -> tuple[int, int]:
        """Return rows and columns."""
        return (self.rows, self.cols)

    @property
    def bounds_m(self) -> tuple[float, float, float, float]:
        """Return west, south, east, north, metres."""
        south_m = self.north_m - self.rows * self.cell_size_m
        return (self.west_m, south_m, self.west_m + self.cols * self.cell_size_m, self.north_m)

    @property
    def transform(self) -> tuple[float, float, float, float, float, float]:
        """Return six coefficients in the order of `affine.Affine`: (u, v) -> (easting, northing)."""
        return (self.cell_size_m, 0.0, self.west_m, 0.0, -self.cell_size_m, self.north_m)

    def to_uv(self, en_m: Points) -> Points:
        """Convert easting/northing, shape (N, 2), metres, to (u, v), shape (N, 2), cells."""
        return (en_m - (self.west_m, self.north_m)) / (self.cell_size_m, -self.cell_size_m)

    def to_en_m(self, uv: Points) -> Points:
        """Convert (u, v), shape (N, 2), cells, to easting/northing, metres."""
        return uv * (self.cell_size_m, -self.cell_size_m) + (self.west_m, self.north_m)

    def to_cells(self, en_m: Points) -> NDArray[np.int64]:
        """Convert easting/northing, shape (N, 2), metres, to (row, col) of the cell around each point, shape (N, 2)."""
        return np.floor(self.to_uv(en_m)).astype(np.int64)[:, ::-1]

    def to_centres_m(self, cells: NDArray[np.int64]) -> Points:
        """Convert (row, col), shape (N, 2), to easting/northing of the cells' centres, shape (N, 2), metres."""
        return self.to_en_m(cells[:, ::-1].astype(np.float64) + 0.5)

    def window(self, row: int, col: int, rows: int, cols: int) -> Self:
        """Return the part of the grid that begins at a cell; it may reach beyond."""
        west_m, north_m = self.west_m + col * self.cell_size_m, self.north_m - row * self.cell_size_m
        return replace(self, west_m=west_m, north_m=north_m, rows=rows, cols=cols)

    def windows(self, size_cells: int) -> Iterator[tuple[int, int, Self]]:
        """Tile the grid: yield row, column and window, row by row; the last ones are smaller.

        >>> grid = Grid(epsg=32632, west_m=0.0, north_m=0.0, cell_size_m=1.0, rows=3, cols=5)
        >>> [(row, col, part.shape) for row, col, part in grid.windows(4)]
        [(0, 0, (3, 4)), (0, 4, (3, 1))]
        """
        for row in range(0, self.rows, size_cells):
            for col in range(0, self.cols, size_cells):
                rows, cols = min(size_cells, self.rows - row), min(size_cells, self.cols - col)
                yield row, col, self.window(row, col, rows, cols)

    def coarsen(self, factor: int) -> Self:
        """Return the grid whose cells are `factor` times as large, from the same corner; it covers at least as much."""
        rows, cols = -(-self.rows // factor), -(-self.cols // factor)
        return replace(self, cell_size_m=self.cell_size_m * factor, rows=rows, cols=cols)
