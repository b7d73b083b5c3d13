# SPDX-License-Identifier: Apache-2.0
"""Pictures from outside -> `ortho.tif`: checked, cut to the region, reprojected, as a cloud-optimized GeoTIFF."""

import math
from collections.abc import Generator, Iterator, Sequence
from contextlib import AbstractContextManager, ExitStack, closing, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np
import rasterio
import rasterio.shutil
from affine import Affine
from numpy.typing import NDArray
from pyproj import CRS, Transformer
from pyproj.exceptions import ProjError
from rasterio.enums import ColorInterp, Resampling
from rasterio.errors import CRSError, RasterioError
from rasterio.vrt import WarpedVRT
from rasterio.windows import Window

from sasgeo_bench.core.errors import GridError, ImageryError
from sasgeo_bench.core.geotiff import is_database, open_geotiff
from sasgeo_bench.core.texts import one_line
from sasgeo_bench.geometry.grid import Grid
from sasgeo_bench.geometry.projection import has_open_datum
from sasgeo_bench.regions.imagery import BANDS, ImageryEntry, PictureRecord
from sasgeo_bench.regions.layers import RGB, Bands, find_bands, selected
from sasgeo_bench.regions.tiles import open_tiled, open_tiles, record_of

MOST_PIXELS: Final = 4_000_000_000  # of a picture
MOST_ORTHO_PIXELS: Final = 2_000_000_000  # of what is cut out of all; what holds no picture counts too
FINEST_M: Final = 0.01
COARSEST_M: Final = 30.0
_WINDOW_PIXELS: Final = 1024
_BLOCK_PIXELS: Final = 512
_CACHE_BYTES: Final = 64 * 2**20
_SNAP: Final = 0.05  # of a pixel: a little coarser will do, rather than a third finer


@dataclass(frozen=True, kw_only=True)
class Picture:
    """A checked picture: its file, its entry in the region file, its bounds in the region's CRS, resolution, bands."""

    path: Path
    entry: ImageryEntry
    bounds_m: tuple[float, float, float, float]
    gsd_m: float
    bands: Bands = RGB

    def record(self) -> PictureRecord:
        """Return what `region.json` says of the picture."""
        entry, found = self.entry, record_of(self.path)
        return PictureRecord(
            file=entry.file,
            sha256=found.sha256,
            bytes=found.bytes,
            date=entry.date,
            licence=entry.licence,
            attribution=entry.attribution,
            publish=entry.publish,
            source=entry.source,
            gsd_m=round(self.gsd_m, 4),
        )


def check_picture(path: Path, entry: ImageryEntry, grid: Grid) -> Picture:
    """Check a picture; no pixel is decoded but some of an alpha band.

    Raises
    ------
    ImageryError
        If it is no GeoTIFF, has no CRS, no 8-bit red, green and blue, too many pixels, or does not show the region.
    """
    try:
        with _opened(path, entry, grid) as source:
            _check_kind(path, source)
            to_grid = Transformer.from_crs(source.crs.to_wkt(), grid.epsg, always_xy=True)
            bounds_m = to_grid.transform_bounds(*_box(source), densify_pts=21, errcheck=True)
            bands = find_bands(path, source)
            # Side of a square with the ground area of the middle pixel, metres in the region's CRS
            col, row = source.width / 2, source.height / 2
            across, down = source.transform @ (np.array([col, col + 1, col]), np.array([row, row, row + 1]))
            (x, across_x, down_x), (y, across_y, down_y) = to_grid.transform(across, down, errcheck=True)
            area_m2 = abs((across_x - x) * (down_y - y) - (across_y - y) * (down_x - x))
            gsd_m = max(math.sqrt(area_m2), entry.gsd_m or 0.0)
    except (CRSError, ProjError) as error:
        raise ImageryError(
            f"{path} cannot be projected to EPSG:{grid.epsg} ({error}): check its coordinate reference system"
        ) from error
    if not FINEST_M <= gsd_m <= COARSEST_M:
        raise ImageryError(
            f"{path} has pixels of {gsd_m:.3g} m, imagery has {FINEST_M:g} to {COARSEST_M:g} m: check its georeference"
        )
    if not _overlaps(bounds_m, grid.bounds_m):
        raise ImageryError(
            f"{path} shows {_text(bounds_m)}, the region is {_text(grid.bounds_m)} (EPSG:{grid.epsg}): leave it out"
        )
    return Picture(path=path, entry=entry, bounds_m=bounds_m, gsd_m=gsd_m, bands=bands)


@contextmanager
def _opened(path: Path, entry: ImageryEntry, grid: Grid) -> Iterator[rasterio.io.DatasetReader]:
    """Open a picture of a known kind, and of no other; turn what GDAL says of it into one line."""
    try:
        with rasterio.Env(GDAL_CACHEMAX=_CACHE_BYTES), _source(path, entry, grid) as source:
            yield source
    except (RasterioError, OSError) as error:
        if isinstance(error, ImageryError | CRSError):
            raise
        raise ImageryError(
            f"{path} cannot be read as a GeoTIFF ({str(error)[:200]}): it is damaged (get it again) or of another kind "
            "(make it one with gdal_translate)"
        ) from error


def _source(path: Path, entry: ImageryEntry, grid: Grid) -> AbstractContextManager[rasterio.io.DatasetReader]:
    """Return what opens a folder of tiles, an MBTiles or a GeoPackage, or else a GeoTIFF."""
    if path.is_dir():
        return open_tiles(path, grid, tms=entry.tms, gsd_m=entry.gsd_m)
    if is_database(path):
        return open_tiled(path, entry.layer)
    if entry.layer is not None or entry.tms:
        raise ImageryError(f"{path} is no GeoPackage of rasters or folder of tiles: leave layer and tms out")
    return open_geotiff(path, has_more=True)


def _check_kind(path: Path, source: rasterio.io.DatasetReader) -> None:
    if source.crs is None or source.transform.is_identity:
        raise ImageryError(
            f"{path} says no place (a CRS and a transform): get a georeferenced one, write them (gdal_edit), or warp "
            "by its control points (gdalwarp)"
        )
    crs = CRS.from_wkt(source.crs.to_wkt())
    if not (crs.is_geographic or crs.is_projected):
        raise ImageryError(
            f"{path} has the coordinate reference system {one_line(crs.name)[:60]!r}, which is neither geographic nor "
            "projected, as that of a building site: write the right one into it (gdal_edit.py -a_srs EPSG:...)"
        )
    if has_open_datum(crs):
        raise ImageryError(
            f"{path} has the coordinate reference system {one_line(crs.name)[:60]!r}, which leaves the datum open: it "
            "may lie a hundred metres off; write the right one into it (gdal_edit.py -a_srs EPSG:...)"
        )
    if source.width * source.height > MOST_PIXELS:
        raise ImageryError(
            f"{path} has {source.width} x {source.height} pixels, the most is {MOST_PIXELS:,}: cut it to the region"
        )


def _box(source: rasterio.io.DatasetReader) -> tuple[float, float, float, float]:
    cols, rows = np.array([0, source.width] * 2), np.repeat([0, source.height], 2)
    x, y = source.transform @ (cols, rows)
    return float(x.min()), float(y.min()), float(x.max()), float(y.max())


def _overlaps(one: tuple[float, float, float, float], two: tuple[float, float, float, float]) -> bool:
    return one[0] < two[2] and two[0] < one[2] and one[1] < two[3] and two[1] < one[3]


def _text(bounds_m: Sequence[float]) -> str:
    return ", ".join(f"{value:.0f}" for value in bounds_m)


def ortho_grid(pictures: Sequence[Picture], region: Grid) -> Grid:
    """Return the lattice of the imagery: its edges are edges of map cells, its pixels whole fractions of them.

    The pixels are about as fine as the finest picture, or finer; of pictures coarser than the map a whole multiple of
    its cells. Raise `ImageryError` if it has too many pixels.

    >>> region = Grid(epsg=32632, west_m=0.0, north_m=100.0, cell_size_m=1.0, rows=100, cols=100)
    >>> entry = ImageryEntry.model_construct(file="a.tif")
    >>> picture = Picture(path=Path("a.tif"), entry=entry, bounds_m=(10.5, -50.0, 200.0, 49.5), gsd_m=0.3)
    >>> found = ortho_grid([picture], region)
    >>> found.bounds_m, found.cell_size_m, found.shape
    ((10.0, 0.0, 100.0, 50.0), 0.25, (200, 360))
    """
    bounds = np.array([picture.bounds_m for picture in pictures])
    return lattice_within(bounds, region, finest_m=min(picture.gsd_m for picture in pictures))


def lattice_within(bounds: NDArray[np.float64], region: Grid, *, finest_m: float) -> Grid:
    """Return the lattice of the part of a region that some boxes cover, shape (N, 4); see `ortho_grid`."""
    cell_m = region.cell_size_m
    if finest_m <= cell_m:
        gsd_m = cell_m / math.ceil(cell_m / finest_m - _SNAP)
    else:
        gsd_m = cell_m * math.floor(finest_m / cell_m + _SNAP)
    edges_m = np.array(region.bounds_m)
    low, high = np.maximum(bounds[:, :2].min(axis=0), edges_m[:2]), np.minimum(bounds[:, 2:].max(axis=0), edges_m[2:])
    cells = Grid.from_bounds(*low.tolist(), *high.tolist(), cell_size_m=max(cell_m, gsd_m), epsg=region.epsg)
    west, south, east, north = cells.bounds_m
    rows, cols = round((north - south) / gsd_m), round((east - west) / gsd_m)
    if rows * cols > MOST_ORTHO_PIXELS:
        raise ImageryError(
            f"the imagery of the region has {cols:,} x {rows:,} pixels of {gsd_m:.3g} m, the most is "
            f"{MOST_ORTHO_PIXELS:,}: make the region smaller, or its gsd_m coarser"
        )
    return Grid(epsg=region.epsg, west_m=west, north_m=north, cell_size_m=gsd_m, rows=rows, cols=cols)


def write_ortho(path: Path, pictures: Sequence[Picture], grid: Grid) -> None:
    """Write the pictures on one lattice, later ones over earlier ones, with a mask of what none of them shows.

    Raise `ImageryError` if a picture is damaged, none shows any ground of the region, or the file cannot be written.
    """
    who = "; ".join(dict.fromkeys(item.entry.attribution for item in pictures))
    licence = "; ".join(dict.fromkeys(item.entry.licence for item in pictures))
    if not write_tiles(path, grid, _warped_tiles(pictures, grid), attribution=who, licence=licence):
        raise ImageryError(
            f"{', '.join(item.entry.file for item in pictures)}: no pixel lies in the region: leave it out"
        )


@dataclass(frozen=True, kw_only=True)
class OrthoTile:
    """One window of an ortho image from (row, col) on: `rgb` (3, rows, cols), and where it is known (rows, cols)."""

    row: int
    col: int
    rgb: NDArray[np.uint8]
    is_known: NDArray[np.bool_]


def write_tiles(path: Path, grid: Grid, tiles: Generator[OrthoTile], *, attribution: str, licence: str) -> bool:
    """Write an ortho image tile by tile; return False, and write no file, if no pixel of it is known.

    The file is a cloud-optimized GeoTIFF with JPEG tiles, a mask and overviews; parts without a picture take no space.
    Raise `ImageryError` if it cannot be written.
    """
    draft = path.with_name(f".{path.name}.draft")
    try:
        if not _write_draft(draft, grid, tiles, attribution=attribution, licence=licence):
            return False
        with rasterio.Env(GDAL_CACHEMAX=_CACHE_BYTES):
            rasterio.shutil.copy(
                draft,
                path,
                driver="COG",
                compress="JPEG",
                quality=90,
                blocksize=_BLOCK_PIXELS,
                overview_resampling="AVERAGE",
                sparse_ok=True,
            )
        return True  # noqa: TRY300 - the errors below are those of both steps
    except (RasterioError, OSError, GridError) as error:
        if isinstance(error, ImageryError):
            raise
        raise ImageryError(
            f"{path} cannot be written ({str(error)[:200]}): check the free space and the pictures"
        ) from error
    finally:
        draft.unlink(missing_ok=True)


def _write_draft(path: Path, grid: Grid, tiles: Generator[OrthoTile], *, attribution: str, licence: str) -> bool:
    """Write colours and mask tile by tile; return whether any pixel is known."""
    is_any = False
    with (
        rasterio.Env(GDAL_CACHEMAX=_CACHE_BYTES, GDAL_TIFF_INTERNAL_MASK=True),
        closing(tiles),  # here, for it holds pictures open that need GDAL
        rasterio.open(path, "w", **_draft_profile(grid)) as target,
    ):
        target.update_tags(TIFFTAG_COPYRIGHT=attribution, attribution=attribution, licence=licence)
        for tile in tiles:
            if tile.is_known.any():
                is_any = True
                rows, cols = tile.is_known.shape
                window = Window(tile.col, tile.row, cols, rows)
                target.write(tile.rgb * tile.is_known, window=window)
                target.write_mask(tile.is_known, window=window)
    return is_any


def _warped_tiles(pictures: Sequence[Picture], grid: Grid) -> Generator[OrthoTile]:
    with ExitStack() as stack:
        views = [_Warped(item, stack, grid) for item in pictures]
        for row, col, part in grid.windows(_WINDOW_PIXELS):
            window = Window(col, row, part.cols, part.rows)
            rgb = np.zeros((3, *part.shape), dtype=np.uint8)
            is_known = np.zeros(part.shape, dtype=bool)
            for view in views:
                view.lay(window, part, rgb, is_known)
            yield OrthoTile(row=row, col=col, rgb=rgb, is_known=is_known)


def _draft_profile(grid: Grid) -> dict[str, object]:
    return {
        "driver": "GTiff",
        "height": grid.rows,
        "width": grid.cols,
        "count": len(BANDS),
        "dtype": "uint8",
        "crs": f"EPSG:{grid.epsg}",
        "transform": Affine(*grid.transform),
        "photometric": "RGB",
        "tiled": True,
        "blockxsize": _BLOCK_PIXELS,
        "blockysize": _BLOCK_PIXELS,
        "compress": "zstd",
        "zstd_level": 1,
        "sparse_ok": True,
        "bigtiff": "IF_SAFER",
    }


class _Warped:
    """One picture on the lattice of the imagery, read window by window."""

    def __init__(self, picture: Picture, stack: ExitStack, grid: Grid) -> None:
        self._picture = picture
        source = stack.enter_context(_opened(picture.path, picture.entry, grid))
        view = selected(source, picture.bands)
        if view is not None:
            source = stack.enter_context(rasterio.open(view, driver="VRT"))
        self._view = stack.enter_context(
            WarpedVRT(
                source,
                crs=f"EPSG:{grid.epsg}",
                transform=Affine(*grid.transform),
                height=grid.rows,
                width=grid.cols,
                resampling=Resampling.cubic,
                add_alpha=ColorInterp.alpha not in source.colorinterp,
                init_dest_nodata=False,  # else alpha, too, is that value where there is no picture
                warp_mem_limit=64,
            )
        )
        self._alpha = self._view.colorinterp.index(ColorInterp.alpha) + 1

    def lay(self, window: Window, part: Grid, rgb: NDArray[np.uint8], is_known: NDArray[np.bool_]) -> None:
        """Write the picture's pixels of a window over what is there; arrays of shape (3, rows, cols), (rows, cols)."""
        if not _overlaps(self._picture.bounds_m, part.bounds_m):
            return
        empty, margin = self._picture.entry.empty_rgb, 0
        if empty is not None:
            # 10 m: a disc of one colour this wide is no roof, but a hole in a mosaic
            margin = math.ceil(10.0 / part.cell_size_m)
        top, left = min(margin, int(window.row_off)), min(margin, int(window.col_off))
        wide = Window(
            window.col_off - left,
            window.row_off - top,
            min(left + part.cols + margin, self._view.width - window.col_off + left),
            min(top + part.rows + margin, self._view.height - window.row_off + top),
        )
        try:
            bands = self._view.read((*BANDS, self._alpha), window=wide)  # at once: each call warps anew
        except RasterioError as error:
            raise ImageryError(f"{self._picture.path} is damaged ({str(error)[:200]}): get it again") from error
        colours, mask = bands[:3], bands[3] > 0
        if empty is not None:
            mask = mask & ~is_empty(colours, empty, diameter_px=margin)
        here = (slice(top, top + part.rows), slice(left, left + part.cols))
        shown = mask[here]
        rgb[:, shown] = colours[:, *here][:, shown]
        is_known |= shown


def is_empty(rgb: NDArray[np.uint8], colour: Sequence[int], *, diameter_px: int) -> NDArray[np.bool_]:
    """Return where a whole disc has one colour, within what JPEG does to it; `rgb` is of shape (3, rows, cols).

    A disc of an even diameter is taken a pixel wider: it has no middle pixel, and OpenCV would shift what it finds.

    >>> mosaic = np.zeros((3, 9, 9), dtype=np.uint8)
    >>> mosaic[:, :, :5], mosaic[:, 4, 7] = 254, 254
    >>> is_empty(mosaic, (255, 255, 255), diameter_px=3)[4].astype(int)
    array([1, 1, 1, 1, 1, 0, 0, 0, 0])
    """
    import cv2  # noqa: PLC0415 - 25 MB that few regions need: most have no imagery

    target = np.array(colour, dtype=np.int16)[:, None, None]
    # 4 empty levels by which JPEG changes that colour
    is_near = (np.abs(rgb.astype(np.int16) - target) <= 4).all(axis=0)
    odd_px = diameter_px | 1
    kernel = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (odd_px, odd_px))
    opened = cv2.morphologyEx(is_near.view(np.uint8), cv2.MORPH_OPEN, kernel, borderType=cv2.BORDER_REPLICATE)
    return np.asarray(opened > 0)
