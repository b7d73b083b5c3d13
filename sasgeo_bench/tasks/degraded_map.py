# SPDX-License-Identifier: Apache-2.0
"""A map with the faults of mapping from other pictures: roofs that are missing, and outlines a little off."""

from typing import TYPE_CHECKING, Final

import numpy as np
import shapely
from numpy.typing import NDArray
from scipy.ndimage import map_coordinates

from sasgeo_bench.geometry.grid import Grid
from sasgeo_bench.tasks.perturbations.base import SIGMA, smooth_noise

if TYPE_CHECKING:
    import geopandas as gpd

DROPPED: Final = 0.2  # of the buildings
WARP_M: Final = 1.5  # root mean square of the distance by which things are off
_LATTICE_M: Final = 4.0


def degrade(features: "gpd.GeoDataFrame", grid: Grid, rng: np.random.Generator) -> "gpd.GeoDataFrame":
    """Return features without every fifth building, and all of them moved by a smooth field.

    Parameters
    ----------
    features : GeoDataFrame
        Of a region, in its CRS.
    grid : Grid
        Of the region.
    rng : numpy.random.Generator
        Decides which buildings are dropped, and the field.

    Returns
    -------
    GeoDataFrame
        Exactly `DROPPED` of the buildings fewer, rounded; things are off by `WARP_M`, root mean square.
    """
    buildings = np.flatnonzero((features["class"] == "building").to_numpy())
    dropped = rng.choice(buildings, round(DROPPED * len(buildings)), replace=False)
    kept = features.drop(index=features.index[dropped])
    field_m = warp_field(grid, rng)
    return kept.set_geometry(shapely.transform(kept.geometry.to_numpy(), lambda at: _moved(at, field_m, grid)))


def warp_field(grid: Grid, rng: np.random.Generator) -> NDArray[np.float32]:
    """Draw how far ground is off, east and north, shape (2, rows, cols) of a lattice of 4 m; metres."""
    shape = tuple(max(2, round(cells * grid.cell_size_m / _LATTICE_M)) for cells in grid.shape)
    parts = [smooth_noise((shape[0], shape[1]), 60.0 / _LATTICE_M, rng) for _ in range(2)]
    return np.asarray(np.stack(parts) * (WARP_M / SIGMA / np.sqrt(2)), dtype=np.float32)


def _moved(en_m: NDArray[np.float64], field_m: NDArray[np.float32], grid: Grid) -> NDArray[np.float64]:
    """Return points (easting, northing), shape (N, 2), where the field puts them."""
    rows, cols = field_m.shape[1:]
    col, row = (grid.to_uv(en_m) * (cols / grid.cols, rows / grid.rows) - 0.5).T
    by_m = [map_coordinates(part, (row, col), order=1, mode="nearest", output=np.float64) for part in field_m]
    return np.asarray(en_m + np.column_stack(by_m))
