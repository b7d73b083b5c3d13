# SPDX-License-Identifier: Apache-2.0
"""Tiles of a map without georeference: names, places and ground as Game4Loc cuts them, without touching a pixel."""

import math
import warnings
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from rasterio.errors import NotGeoreferencedWarning, RasterioError

from sasgeo_bench.errors import DatasetError
from sasgeo_bench.files.geotiff import open_geotiff
from sasgeo_bench.importers.items import Box, Item, Position

TILE_PX: Final = 256
_MOST_PX: Final = 200_000  # a side


@dataclass(frozen=True, slots=True, kw_only=True)
class MapSheet:
    """A map whose pixels are linear in longitude and latitude: name, flight, ground, width and height in pixels."""

    name: str
    flight: str
    box: Box
    width_px: int
    height_px: int


def read_size_px(path: Path, *, shown: str) -> tuple[int, int]:
    """Return width and height of a TIFF from its head; raise `DatasetError` if it is none. No pixel is decoded."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", NotGeoreferencedWarning)
            with open_geotiff(path, has_more=True) as source:
                width, height = int(source.width), int(source.height)
    except (RasterioError, OSError) as error:
        raise DatasetError(f"{shown} is no TIFF that can be read: copy it again") from error
    if not (0 < width <= _MOST_PX and 0 < height <= _MOST_PX):
        raise DatasetError(f"{shown} has {width} x {height} pixels, {_MOST_PX} a side at most")
    return width, height


def cut_tiles(sheet: MapSheet) -> Iterator[Item]:
    """Yield the tiles of a map as gallery items, named `<map>_<zoom>_<column>_<row>.png`.

    A pyramid of powers of two ends where the longer side fits one tile; its third- and second-last zooms are kept, so
    tiles of 1024 and 512 pixels of the map. The last ones of a row reach beyond the map, and their centres may, too.

    Game4Loc (`tile_center_latlon`, `tile_satellite`); it renames nothing, so its rankings fit as they are.

    >>> sheet = MapSheet(name="07", flight="07", box=Box(west_deg=115.79, south_deg=40.33, east_deg=115.8,
    ...                  north_deg=40.34), width_px=1024, height_px=600)
    >>> [(tile.item_id, round(tile.position.latitude_deg, 4)) for tile in cut_tiles(sheet)]
    [('07_0_000_000.png', 40.3315), ('07_1_000_000.png', 40.3357), ('07_1_000_001.png', 40.3272),
     ('07_1_001_000.png', 40.3357), ('07_1_001_001.png', 40.3272)]
    """
    last = max(0, math.ceil(math.log2(max(sheet.width_px, sheet.height_px) / TILE_PX)))
    for zoom in range(last + 1)[-3:-1]:
        scale = 2 ** (last - zoom)
        width, height = math.ceil(sheet.width_px / scale), math.ceil(sheet.height_px / scale)
        for column in range(math.ceil(width / TILE_PX)):
            for row in range(math.ceil(height / TILE_PX)):
                yield _tile(sheet, f"{sheet.name}_{zoom}_{column:03}_{row:03}.png", (column, row), (width, height))


def _tile(sheet: MapSheet, name: str, at: tuple[int, int], size_px: tuple[int, int]) -> Item:
    """Place a tile: its column and row in a map of a size in pixels at its zoom."""
    box = sheet.box
    step_east = (box.east_deg - box.west_deg) * TILE_PX / size_px[0]
    step_south = (box.north_deg - box.south_deg) * TILE_PX / size_px[1]
    west, north = box.west_deg + at[0] * step_east, box.north_deg - at[1] * step_south
    return Item(
        item_id=name,
        role="gallery",
        view="satellite",
        group=sheet.flight,
        position=Position(longitude_deg=west + step_east / 2, latitude_deg=north - step_south / 2),
        box=Box(west_deg=west, south_deg=north - step_south, east_deg=west + step_east, north_deg=north),
    )
