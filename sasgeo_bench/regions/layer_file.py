# SPDX-License-Identifier: Apache-2.0
"""Read and write `layers.tif`: a cloud-optimized GeoTIFF with one band per class, written window by window."""

from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path
from typing import Final

import numpy as np
import rasterio
from affine import Affine
from numpy.typing import NDArray
from rasterio.enums import Resampling
from rasterio.errors import RasterioError, RasterioIOError
from rasterio.windows import Window

from sasgeo_bench.errors import StoreError
from sasgeo_bench.geometry.grid import Grid
from sasgeo_bench.regions.layers import OUTSIDE
from sasgeo_bench.regions.region import ATTRIBUTION, LICENCE

BLOCK_CELLS: Final = 512
WINDOW_CELLS: Final = 1024  # 13 classes of one window take 14 MB, whatever the size of the region
_CACHE_BYTES: Final = 24 * 2**20
_BIGTIFF_CELLS: Final = 2**31  # compressed, such a file stays far below the 4 GiB that need BigTIFF

PaintWindow = Callable[[Grid], NDArray[np.uint8]]


def overview_factors(grid: Grid) -> tuple[int, ...]:
    """Return factors of the internal overviews: quartered until the raster fits two blocks."""
    longest = max(grid.rows, grid.cols)
    return tuple(4**level for level in range(1, 10) if longest > 2 * BLOCK_CELLS * 4 ** (level - 1))


def write_layers(path: Path, grid: Grid, classes: tuple[str, ...], paint: Callable[[int], PaintWindow]) -> None:
    """Write the layer stack of a region, with one band per class; raise `StoreError` if the file cannot be written.

    `paint` takes an overview factor (1 for the map itself) and returns what burns one window: Grid -> uint8 (C, rows,
    cols).

    A cloud-optimized file holds its overviews before the full raster, smallest first. GDAL's own COG driver writes
    everything twice to get there. Here the empty overviews are laid out first and then every level is burnt from the
    vectors into its place, so memory and time are those of one pass.
    """
    factors = overview_factors(grid)
    options = {"GDAL_CACHEMAX": _CACHE_BYTES, "SPARSE_OK_OVERVIEW": "YES", "GDAL_TIFF_OVR_BLOCKSIZE": BLOCK_CELLS}
    packing = {"COMPRESS_OVERVIEW": "ZSTD", "ZSTD_LEVEL_OVERVIEW": 1}
    try:
        with rasterio.Env(**options, **packing):
            _lay_out(path, grid, classes, factors)
            for level in reversed(range(len(factors))):
                with rasterio.open(path, "r+", overview_level=level) as target:
                    _fill(target, grid.coarsen(factors[level]), paint(factors[level]))
            with rasterio.open(path, "r+") as target:
                _fill(target, grid, paint(1))
    except (RasterioError, RasterioIOError, OSError) as error:
        message = f"{path} cannot be written ({error}): check the free space and the rights of its folder"
        raise StoreError(message) from error


def _lay_out(path: Path, grid: Grid, classes: tuple[str, ...], factors: tuple[int, ...]) -> None:
    """Write the headers of the raster and of its overviews; no block is stored yet."""
    is_big = len(classes) * grid.rows * grid.cols > 16 * _BIGTIFF_CELLS
    with rasterio.open(
        path,
        "w",
        driver="GTiff",
        height=grid.rows,
        width=grid.cols,
        count=len(classes),
        dtype="uint8",
        crs=f"EPSG:{grid.epsg}",
        transform=Affine(*grid.transform),
        nodata=OUTSIDE,
        tiled=True,
        blockxsize=BLOCK_CELLS,
        blockysize=BLOCK_CELLS,
        interleave="band",
        compress="zstd",
        zstd_level=1,
        sparse_ok=True,
        bigtiff="YES" if is_big else "NO",
    ) as target:
        target.descriptions = classes
        target.update_tags(TIFFTAG_COPYRIGHT=ATTRIBUTION, attribution=ATTRIBUTION, licence=LICENCE)
    if factors:
        with rasterio.open(path, "r+") as target:
            target.build_overviews(list(factors), Resampling.nearest)


def _fill(target: rasterio.io.DatasetWriter, grid: Grid, burn: PaintWindow) -> None:
    """Burn a window while GDAL packs the previous one, which needs no interpreter; at most two are held."""
    with ThreadPoolExecutor(max_workers=1) as executor:
        packing: Future[None] | None = None
        for row, col, window in grid.windows(WINDOW_CELLS):
            layers = burn(window)
            if packing is not None:
                packing.result()
            packing = executor.submit(target.write, layers, window=Window(col, row, window.cols, window.rows))
        if packing is not None:
            packing.result()


def read_overview(path: Path, *, longest_cells: int) -> NDArray[np.uint8]:
    """Read the finest level whose longer side has at most `longest_cells`; shape (C, rows, cols)."""
    with rasterio.open(path) as source:
        longest, factors = max(source.height, source.width), source.overviews(1)
    fitting = [level for level, factor in enumerate(factors) if longest / factor <= longest_cells]
    if longest <= longest_cells or not factors:
        return read_layers(path)
    with rasterio.open(path, overview_level=fitting[0] if fitting else len(factors) - 1) as source:
        return np.asarray(source.read(), dtype=np.uint8)


def read_layers(path: Path, *, window: tuple[int, int, int, int] | None = None) -> NDArray[np.uint8]:
    """Read a layer stack, or one window of it (row, col, rows, cols); shape (C, rows, cols), read-only.

    Raise `StoreError` if the file cannot be read.
    """
    try:
        with rasterio.open(path) as source:
            part = Window(window[1], window[0], window[3], window[2]) if window else None
            layers = np.asarray(source.read(window=part), dtype=np.uint8)
    except (RasterioError, RasterioIOError) as error:
        message = f"{path} cannot be read ({error}): build the region again"
        raise StoreError(message) from error
    layers.flags.writeable = False
    return layers


def cog_faults(path: Path) -> list[str]:
    """List the faults found by a validator of cloud-optimized GeoTIFFs; raise `StoreError` if it cannot be read."""
    from rio_cogeo.cogeo import cog_validate  # noqa: PLC0415 - an extra, needed only to write a release

    try:
        is_valid, faults, _ = cog_validate(path, quiet=True)
    except (RasterioError, RasterioIOError) as error:
        message = f"{path} cannot be read ({error}): build the region again"
        raise StoreError(message) from error
    return [] if is_valid else list(faults) or ["not valid"]
