# SPDX-License-Identifier: Apache-2.0
"""Open GeoTIFF files of anybody, or databases of tiles, and no other file by them.

GDAL takes a file for what it holds, not for what it is called: one of a few lines can name any other file of this
machine as its pixels. So can files beside a GeoTIFF: its overviews, its mask, its metadata.
"""

import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Final

from sasgeo_bench.core.paths import plain_file

if TYPE_CHECKING:
    from rasterio.io import DatasetReader

_SQLITE: Final = b"SQLite format 3\0"
_APPLICATION: Final = slice(68, 71)  # bytes in which an SQLite file says whose it is


@contextmanager
def open_geotiff(path: Path, *, has_more: bool = False, overview_level: int | None = None) -> Iterator["DatasetReader"]:
    """Open a GeoTIFF to read, one of its overviews if `overview_level` counts one.

    Files beside it are passed over, unless it `has_more` of its own: a world file, overviews, a mask. Raise
    `RasterioIOError` if it is no GeoTIFF, or one of these names a file that is none of its own.
    """
    import rasterio  # noqa: PLC0415 - GDAL is slow to import
    from rasterio.errors import RasterioIOError  # noqa: PLC0415

    beside = {} if has_more else {"GDAL_DISABLE_READDIR_ON_OPEN": "EMPTY_DIR"}
    level = {} if overview_level is None else {"overview_level": overview_level}
    with rasterio.Env(**beside), rasterio.open(plain_file(path), driver="GTiff", **level) as source:
        stray = next((name for name in source.files if not _is_own(Path(name), path)), None) if has_more else None
        if stray is not None:
            raise RasterioIOError(f"a file beside it reads {Path(stray).name}, which is none of its own")
        yield source


@contextmanager
def open_database(path: Path, layer: str | None = None) -> Iterator["DatasetReader"]:
    """Open an SQLite database of tiles to read: an MBTiles, or the only raster of a GeoPackage, or that of a name.

    Files beside it are passed over. A GeoPackage of several rasters has no band, and lists them as `subdatasets`. Raise
    `RasterioIOError` if it is neither.
    """
    import rasterio  # noqa: PLC0415 - GDAL is slow to import
    from rasterio.errors import NotGeoreferencedWarning  # noqa: PLC0415

    driver = "GPKG" if is_geopackage(path) else "MBTiles"
    table = {} if layer is None else {"TABLE": layer}
    with rasterio.Env(GDAL_DISABLE_READDIR_ON_OPEN="EMPTY_DIR", GDAL_PAM_ENABLED="NO"):
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", NotGeoreferencedWarning)  # of several rasters, which have no place together
            source = rasterio.open(plain_file(path), driver=driver, **table)
        with source:
            yield source


@contextmanager
def open_png(path: Path) -> Iterator["DatasetReader"]:
    """Open a PNG to read the values that are stored in it, whatever they are shown as; files beside it are passed over.

    Raise `RasterioIOError` if it is none.
    """
    import rasterio  # noqa: PLC0415 - GDAL is slow to import
    from rasterio.errors import NotGeoreferencedWarning  # noqa: PLC0415

    with rasterio.Env(GDAL_DISABLE_READDIR_ON_OPEN="EMPTY_DIR", GDAL_PAM_ENABLED="NO"):
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", NotGeoreferencedWarning)
            source = rasterio.open(plain_file(path), driver="PNG")
        with source:
            yield source


def is_database(path: Path) -> bool:
    """Return whether a file is an SQLite database, as MBTiles and GeoPackages are."""
    with plain_file(path).open("rb") as file:
        return file.read(len(_SQLITE)) == _SQLITE


def is_geopackage(path: Path) -> bool:
    """Return whether an SQLite database says that it is a GeoPackage."""
    with plain_file(path).open("rb") as file:
        return file.read(_APPLICATION.stop)[_APPLICATION] == b"GPK"


def _is_own(name: Path, path: Path) -> bool:
    """Return whether a file lies beside another one and begins with its name."""
    return name.resolve().parent == path.resolve().parent and name.name.startswith(path.stem)
