# SPDX-License-Identifier: Apache-2.0
"""Read the heights of a ground out of a GeoTIFF; apart from the ground, which is asked for without any raster."""

from pathlib import Path
from typing import Final

import numpy as np
import pyproj
import rasterio
from pyproj.exceptions import ProjError
from rasterio._err import CPLE_BaseError
from rasterio.enums import Resampling
from rasterio.errors import RasterioError
from rasterio.vrt import WarpedVRT

from sasgeo_bench.core.errors import CameraError
from sasgeo_bench.core.geotiff import open_geotiff
from sasgeo_bench.core.texts import one_line
from sasgeo_bench.geometry.grid import Grid
from sasgeo_bench.geometry.projection import has_open_datum
from sasgeo_bench.sensing.ground import Dem

_UNITS_M: Final = dict.fromkeys(("m", "metre", "meter", "metres", "meters"), 1.0) | {
    **dict.fromkeys(("ft", "foot", "feet", "international foot"), 0.3048),
    **dict.fromkeys(("us survey foot", "us_survey_foot", "us-ft", "ftus", "us foot", "foot_us"), 1200 / 3937),
}
_MOST_CELLS: Final = 400_000_000


def read_dem(path: Path, grid: Grid) -> Dem:
    """Read heights out of a GeoTIFF, brought onto a lattice; raise `CameraError` if that cannot be done whole.

    Heights are in metres or feet, with the scale and offset that the file states; it may be in any CRS that GDAL knows,
    and is resampled bilinearly. A file without CRS, with several bands, or one that does not cover the lattice is
    refused.
    """
    if grid.rows * grid.cols > _MOST_CELLS:
        raise CameraError(
            f"a ground of {grid.rows} x {grid.cols} cells is too large: cut a smaller lattice, or larger cells"
        )
    try:
        with open_geotiff(path, has_more=True) as source:
            _check_source(path, source, grid.epsg)
            unit_m, scale, offset = _unit_m(path, source), source.scales[0], source.offsets[0]
            with WarpedVRT(
                source,
                crs=f"EPSG:{grid.epsg}",
                transform=rasterio.Affine(*grid.transform),
                width=grid.cols,
                height=grid.rows,
                resampling=Resampling.bilinear,
                dtype="float32",
                nodata=np.nan,
            ) as warped:
                cells_m = warped.read(1)
    except CPLE_BaseError as error:  # of GDAL where no operation leads from one CRS to the other: no `RasterioError`
        raise CameraError(
            f"{path} cannot be transformed to EPSG:{grid.epsg}: no operation leads there from its CRS; name a file in "
            "a geographic or projected CRS of the Earth"
        ) from error
    except (RasterioError, OSError, ValueError) as error:
        if isinstance(error, CameraError):
            raise
        raise CameraError(f"{path} cannot be read as a GeoTIFF of heights ({error}): check the file") from error
    unknown = float(np.mean(~np.isfinite(cells_m)))
    if unknown:
        west_m, south_m, east_m, north_m = grid.bounds_m
        raise CameraError(
            f"{path} does not cover {west_m:g} {south_m:g} {east_m:g} {north_m:g} (EPSG:{grid.epsg}): {unknown:.2%} "
            "has no height; name a file that reaches beyond it on every side"
        )
    if (scale, offset, unit_m) != (1.0, 0.0, 1.0):
        cells_m = ((cells_m * scale + offset) * unit_m).astype(np.float32)
    return Dem(grid=grid, cells_m=cells_m)


def _unit_m(path: Path, source: rasterio.DatasetReader) -> float:
    """Return the unit of a file's heights in metres; files that name none are in metres."""
    unit = (source.units[0] or "metre").strip().lower()
    if unit not in _UNITS_M:
        raise CameraError(
            f"{path} has heights in {unit[:40]!r}, metres or feet are read: convert it (gdal_calc.py, gdal_edit.py)"
        )
    return _UNITS_M[unit]


def _check_source(path: Path, source: rasterio.DatasetReader, epsg: int) -> None:
    if source.crs is None:
        raise CameraError(f"{path} has no CRS: write one into it (gdal_edit.py -a_srs EPSG:...), or name another file")
    if has_open_datum(pyproj.CRS.from_wkt(source.crs.to_wkt())):
        raise CameraError(
            f"{path} has a coordinate reference system that leaves the datum open, so that it may lie a hundred metres "
            "off: write the right one into it (gdal_edit.py -a_srs EPSG:...)"
        )
    try:
        pyproj.Transformer.from_crs(source.crs.to_wkt(), epsg)
    except ProjError as error:
        raise CameraError(
            f"{path} has the coordinate reference system {one_line(source.crs.to_wkt())[:60]!r}, from which no way "
            f"leads to EPSG:{epsg}: write the right one into it (gdal_edit.py -a_srs EPSG:...)"
        ) from error
    if source.count != 1 or np.dtype(source.dtypes[0]).kind not in "iuf":
        raise CameraError(
            f"{path} is no file of heights: it has {source.count} bands of {source.dtypes[0]}, one of numbers is needed"
        )
