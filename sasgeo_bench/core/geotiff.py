# SPDX-License-Identifier: Apache-2.0
"""Open GeoTIFF files of anybody, and no other file by them.

GDAL takes a file for what it holds, not for what it is called: one of a few lines can name any other file of this
machine as its pixels. So can files beside a GeoTIFF: its overviews, its mask, its metadata.
"""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

from sasgeo_bench.core.paths import plain_file

if TYPE_CHECKING:
    from rasterio.io import DatasetReader


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


def _is_own(name: Path, path: Path) -> bool:
    """Return whether a file lies beside another one and begins with its name."""
    return name.resolve().parent == path.resolve().parent and name.name.startswith(path.stem)
