# SPDX-License-Identifier: Apache-2.0
"""Burn features into one raster per class, by the cell-centre rule; lines have their width in metres."""

from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Final

import numpy as np
import shapely
from numpy.typing import NDArray

from sasgeo_bench.geometry.grid import Grid

if TYPE_CHECKING:
    import geopandas as gpd

PRESENT: Final = 1
OUTSIDE: Final = 255  # unknown: beyond the mapped area

_ARC_SEGMENTS: Final = 2  # per quarter circle at line ends and bends: 3 % of the radius, a few centimetres on a road


@dataclass(frozen=True, kw_only=True)
class Paint:
    """The polygons to burn: for each class, in band order, with the outer ring counter-clockwise."""

    classes: tuple[str, ...]
    areas: tuple[NDArray[np.object_], ...]
    coverage: NDArray[np.object_]

    @cached_property
    def bounds(self) -> tuple[NDArray[np.float64], ...]:
        """Return west, south, east, north of every polygon, shape (N, 4) for each class."""
        return tuple(shapely.bounds(areas).reshape(-1, 4) for areas in self.areas)


def make_paint(
    features: "gpd.GeoDataFrame", classes: tuple[str, ...], coverage: shapely.Geometry, *, least_width_m: float = 0.0
) -> Paint:
    """Turn visible features into polygons for `burn_layers`: lines are buffered to their width, areas stay as they are.

    `classes` gives the band order, `coverage` the mapped area in the CRS of the features. For overviews with large
    cells, lines are at least `least_width_m` wide, so that they do not break, and simplified to an eighth of it.
    """
    seen = features[features["is_visible"].to_numpy()]
    shape = seen.geometry.to_numpy().copy()
    width_m = seen["width_m"].to_numpy(dtype=np.float64)
    is_line = ~np.isnan(width_m)
    half_m = np.maximum(width_m[is_line], least_width_m) / 2
    is_coarse = least_width_m > 0
    lines = shapely.simplify(shape[is_line], least_width_m / 8) if is_coarse else shape[is_line]
    shape[is_line] = shapely.buffer(lines, half_m, quad_segs=1 if is_coarse else _ARC_SEGMENTS)
    names = seen["class"].to_numpy()
    return Paint(
        classes=classes,
        areas=tuple(_oriented(shape[names == name]) for name in classes),
        coverage=_oriented(np.array([coverage], dtype=object)),
    )


def _oriented(areas: NDArray[np.object_]) -> NDArray[np.object_]:
    """Return single polygons, outer rings counter-clockwise, holes clockwise: crossings are summed by sign."""
    parts = shapely.get_parts(areas)
    return np.asarray(shapely.orient_polygons(parts[~shapely.is_empty(parts)], exterior_cw=False))


def burn_layers(paint: Paint, grid: Grid) -> NDArray[np.uint8]:
    """Burn every class on a grid in the CRS of the polygons: PRESENT, ABSENT, or OUTSIDE beyond the mapped area.

    The result is uint8 of shape (C, rows, cols). A window of the region's grid gives exactly that window of the whole.

    >>> grid = Grid(epsg=32632, west_m=0.0, north_m=4.0, cell_size_m=1.0, rows=4, cols=4)
    >>> house = np.array([shapely.box(1, 1, 3, 3)])
    >>> land = np.array([shapely.box(0, 0, 3, 4)])
    >>> burn_layers(Paint(classes=("building",), areas=(house,), coverage=land), grid)[0]
    array([[  0,   0,   0, 255],
           [  0,   1,   1, 255],
           [  0,   1,   1, 255],
           [  0,   0,   0, 255]], dtype=uint8)
    """
    layers = np.zeros((len(paint.classes), grid.rows, grid.cols), dtype=np.uint8)
    mapped = burn(paint.coverage, grid)
    is_whole = bool(mapped.all())
    for band, areas, bounds in zip(layers, paint.areas, paint.bounds, strict=True):
        near = areas[_meets(bounds, grid)]
        if len(near):
            band[...] = burn(near, grid)
        if not is_whole:
            band[~mapped] = OUTSIDE
    return layers


def _meets(bounds: NDArray[np.float64], grid: Grid) -> NDArray[np.bool_]:
    west, south, east, north = grid.bounds_m
    return (bounds[:, 0] < east) & (bounds[:, 2] > west) & (bounds[:, 1] < north) & (bounds[:, 3] > south)


def burn(areas: NDArray[np.object_], grid: Grid) -> NDArray[np.bool_]:
    """Mark the cells whose centre lies within any polygon: GDAL's rule, for all polygons at once; shape (rows, cols).

    Outer rings are counter-clockwise, holes clockwise (`shapely.orient_polygons`). A centre exactly on an edge belongs
    to the polygon south or east of it.

    Notes
    -----
    Each ring edge crosses the centre lines of some rows; downward crossings count +1, upward ones -1. Sorted along the
    raster, their running sum is the number of polygons that cover a cell, and its runs are written out in one go. The
    cells equal those of `rasterio.features.rasterize`, which spends its time on converting every vertex from Python
    (docs/decisions/0007).

    Examples
    --------
    >>> grid = Grid(epsg=32632, west_m=0.0, north_m=3.0, cell_size_m=1.0, rows=3, cols=3)
    >>> burn(np.array([shapely.box(0, 0, 2, 1)]), grid).astype(int)
    array([[0, 0, 0],
           [0, 0, 0],
           [1, 1, 0]])
    """
    row, col, step = _crossings(areas, grid)
    position = row * grid.cols + col
    order = np.argsort(position, kind="stable")
    is_inside = np.cumsum(step[order]) > 0
    edges = np.concatenate(([0], position[order], [grid.rows * grid.cols]))
    runs = np.repeat(np.concatenate(([False], is_inside)), np.diff(edges))
    return np.asarray(runs.reshape(grid.rows, grid.cols))


def _crossings(
    areas: NDArray[np.object_], grid: Grid
) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.int64]]:
    """Return row, first column at or right of the crossing, and sign, for every edge and every row's centre line."""
    rings = shapely.get_rings(areas)
    points, ring = shapely.get_coordinates(rings, return_index=True)
    uv = grid.to_uv(points)
    joined = ring[1:] == ring[:-1]
    start, end = uv[:-1][joined], uv[1:][joined]
    # A row's centre line lies at row + 0.5; an edge crosses those in [upper end, lower end).
    first = np.clip(np.ceil(np.minimum(start[:, 1], end[:, 1]) - 0.5), 0, grid.rows).astype(np.int64)
    last = np.clip(np.ceil(np.maximum(start[:, 1], end[:, 1]) - 0.5), 0, grid.rows).astype(np.int64)
    count = last - first
    edge = np.repeat(np.arange(len(count)), count)
    row = np.arange(len(edge)) - np.repeat(np.cumsum(count) - count, count) + first[edge]
    down = (end - start)[edge]
    u = start[edge, 0] + (row + 0.5 - start[edge, 1]) * down[:, 0] / down[:, 1]
    col = np.clip(np.ceil(u - 0.5), 0, grid.cols).astype(np.int64)
    return row, col, np.where(down[:, 1] > 0, 1, -1)
