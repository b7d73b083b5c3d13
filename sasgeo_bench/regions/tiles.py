# SPDX-License-Identifier: Apache-2.0
"""Open aerial pictures that come in tiles: an MBTiles, a GeoPackage of rasters, or a folder of XYZ tiles."""

import hashlib
import math
import re
import xml.etree.ElementTree as ET
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Final, NamedTuple

from PIL import Image, UnidentifiedImageError
from rasterio.io import DatasetReader, MemoryFile

from sasgeo_bench.core.errors import ImageryError, counted
from sasgeo_bench.core.folders import FileRecord, file_record, sha256_of
from sasgeo_bench.core.geotiff import is_geopackage, open_database
from sasgeo_bench.core.paths import plain_file
from sasgeo_bench.geometry.grid import Grid
from sasgeo_bench.geometry.projection import between, to_lonlat

MERCATOR: Final = 3857
MOST_TILES: Final = 40_000  # of one zoom that lie in a region
_HALF_M: Final = math.pi * 6_378_137.0  # of the equator in Web Mercator: tiles divide twice that
_TILE: Final = re.compile(r"([0-9]{1,2})/([0-9]{1,8})/([0-9]{1,8})\.(png|jpg|jpeg|webp)")
_SIZES: Final = (256, 512)


class _Tile(NamedTuple):
    """One tile: zoom, column from the west, row from the north, file."""

    zoom: int
    col: int
    row: int
    path: Path


def record_of(path: Path) -> FileRecord:
    """Return size and hash of a picture; of a folder those of its tiles.

    The hash of a folder is that of a list of its tiles with their hashes, as `sha256sum` writes it: see
    `docs/howto/imagery.md`.
    """
    if not path.is_dir():
        return file_record(path)
    tiles = sorted((f"./{tile.path.relative_to(path).as_posix()}", tile.path) for tile in _tiles(path, tms=False))
    lines = "".join(f"{sha256_of(file)}  {name}\n" for name, file in tiles)
    size = sum(file.stat().st_size for _, file in tiles)
    return FileRecord(sha256=hashlib.sha256(lines.encode()).hexdigest(), bytes=size)


@contextmanager
def open_tiled(path: Path, layer: str | None) -> Iterator[DatasetReader]:
    """Open an MBTiles, or the one raster of a GeoPackage, or that of a name; rows from the south are turned by GDAL.

    Raise `ImageryError` if there are several rasters and none is named.
    """
    if layer is not None and not is_geopackage(path):
        raise ImageryError(f"{path} is an MBTiles, which has no layers: leave layer = {layer!r} out of its [[imagery]]")
    with open_database(path, layer) as source:
        if source.count == 0:
            names = [name.rpartition(":")[2] for name in source.subdatasets]
            raise ImageryError(
                f"{path} has {counted(len(names), 'raster')} ({', '.join(names[:8])}): name one by layer"
            )
        yield source


@contextmanager
def open_tiles(folder: Path, grid: Grid, *, tms: bool, gsd_m: float | None) -> Iterator[DatasetReader]:
    """Open the tiles of a folder `zoom/column/row.png` that meet a grid, as one picture in Web Mercator.

    The deepest zoom is read, or the coarsest one that is not coarser than `gsd_m`. Rows count from the north, or with
    `tms` from the south. Raise `ImageryError` if no tile meets the grid, or one is no picture of red, green and blue.
    """
    tiles = list(_tiles(folder, tms=tms))
    if not tiles:
        raise ImageryError(f"{folder} holds no tiles zoom/column/row.png (or .jpg, .webp): is it the right folder?")
    zoom = _zoom(sorted({tile.zoom for tile in tiles}), grid, gsd_m)
    found = [tile for tile in tiles if tile.zoom == zoom]
    near = _near(found, grid)
    if not near:
        turned = _near([tile._replace(row=2**zoom - 1 - tile.row) for tile in found], grid)
        hint = "its rows count from the other side: " + ("leave tms out" if tms else "say tms = true")
        raise ImageryError(
            f"{folder} has {counted(len(found), 'tile')} of zoom {zoom}, and none in the region: "
            + (hint if turned else "leave it out")
        )
    if len(near) > MOST_TILES:
        raise ImageryError(
            f"{folder} has {len(near):,} tiles of zoom {zoom} in the region, the most is {MOST_TILES:,}: say a coarser "
            "gsd_m, or make the region smaller"
        )
    with MemoryFile(_mosaic(near), ext=".vrt") as file, file.open(driver="VRT") as source:
        yield source


def _tiles(folder: Path, *, tms: bool) -> Iterator[_Tile]:
    for path in folder.glob("*/*/*"):
        found = _TILE.fullmatch(path.relative_to(folder).as_posix())
        if found is not None:
            zoom, col, row = (int(text) for text in found.groups()[:3])
            yield _Tile(zoom, col, 2**zoom - 1 - row if tms else row, path)


def _zoom(zooms: list[int], grid: Grid, gsd_m: float | None) -> int:
    """Return the zoom to read of those at hand; pixels of 256 a tile are as wide on the ground as Mercator says."""
    if gsd_m is None:
        return zooms[-1]
    west, south, east, north = grid.bounds_m
    latitude_deg = to_lonlat(grid.epsg).transform((west + east) / 2, (south + north) / 2)[1]
    width_m = 2 * _HALF_M * math.cos(math.radians(latitude_deg)) / _SIZES[0]
    return next((zoom for zoom in zooms if width_m / 2**zoom <= gsd_m), zooms[-1])


def _near(tiles: list[_Tile], grid: Grid) -> list[_Tile]:
    west, south, east, north = between(grid.epsg, MERCATOR).transform_bounds(*grid.bounds_m, densify_pts=21)
    side = 2 * _HALF_M / 2 ** tiles[0].zoom
    first, last = math.floor((west + _HALF_M) / side), math.floor((east + _HALF_M) / side)
    top, bottom = math.floor((_HALF_M - north) / side), math.floor((_HALF_M - south) / side)
    return [tile for tile in tiles if first <= tile.col <= last and top <= tile.row <= bottom]


def _mosaic(tiles: list[_Tile]) -> bytes:
    """Return a virtual raster of tiles: red, green, blue, and alpha, which is opaque in tiles without one."""
    size = _checked_size(tiles)
    side = str(size)
    left, top = min(tile.col for tile in tiles), min(tile.row for tile in tiles)
    cols, rows = max(tile.col for tile in tiles) - left + 1, max(tile.row for tile in tiles) - top + 1
    side_m = 2 * _HALF_M / 2 ** tiles[0].zoom
    root = ET.Element("VRTDataset", rasterXSize=str(cols * size), rasterYSize=str(rows * size))
    ET.SubElement(root, "SRS").text = f"EPSG:{MERCATOR}"
    place = (left * side_m - _HALF_M, side_m / size, 0.0, _HALF_M - top * side_m, 0.0, -side_m / size)
    ET.SubElement(root, "GeoTransform").text = ", ".join(map(repr, place))
    for number, (colour, band) in enumerate((("Red", "1"), ("Green", "2"), ("Blue", "3"), ("Alpha", "mask,1")), 1):
        entry = ET.SubElement(root, "VRTRasterBand", dataType="Byte", band=str(number))
        ET.SubElement(entry, "ColorInterp").text = colour
        for tile in tiles:
            source = ET.SubElement(entry, "SimpleSource")
            ET.SubElement(source, "SourceFilename", relativeToVRT="0").text = str(tile.path.resolve())
            ET.SubElement(source, "SourceBand").text = band
            raster = {"RasterXSize": side, "RasterYSize": side, "BlockXSize": side, "BlockYSize": "1"}
            ET.SubElement(source, "SourceProperties", raster | {"DataType": "Byte"})
            ET.SubElement(source, "SrcRect", {"xOff": "0", "yOff": "0", "xSize": side, "ySize": side})
            at = {"xOff": str((tile.col - left) * size), "yOff": str((tile.row - top) * size)}
            ET.SubElement(source, "DstRect", at | {"xSize": side, "ySize": side})
    return ET.tostring(root)


def _checked_size(tiles: list[_Tile]) -> int:
    """Return the side of the tiles, pixels, after a look at the head of each: GDAL would open what it names."""
    sizes = set()
    for tile in tiles:
        try:
            with Image.open(plain_file(tile.path), formats=("PNG", "JPEG", "WEBP")) as picture:
                mode, size = picture.mode, picture.size
        except (OSError, UnidentifiedImageError, ValueError, Image.DecompressionBombError) as error:
            raise ImageryError(f"{tile.path} is no PNG, JPEG or WebP: get it again, or remove it") from error
        sizes.add(size)
        if mode not in ("RGB", "RGBA"):
            raise ImageryError(
                f"{tile.path} is a picture of mode {mode!r}, imagery is 8-bit red, green and blue, with or without "
                "alpha: render the tiles so"
            )
    if len(sizes) > 1 or not sizes <= {(side, side) for side in _SIZES}:
        raise ImageryError(
            f"{tiles[0].path.parents[2]} has tiles of {', '.join(f'{w} x {h}' for w, h in sorted(sizes)[:4])} pixels, "
            "expected 256 x 256 or 512 x 512 throughout: render them so"
        )
    return sizes.pop()[0]
