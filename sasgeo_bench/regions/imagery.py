# SPDX-License-Identifier: Apache-2.0
"""Aerial imagery of a region: what is known of it, and windows of it at any ground resolution."""

import datetime as dt
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, ClassVar, Final, Self

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, model_validator

from sasgeo_bench.core.config import Document, JsonDocument, Line
from sasgeo_bench.core.errors import ImageryError, StoreError
from sasgeo_bench.core.folders import FileRecord, file_record
from sasgeo_bench.core.geotiff import open_geotiff
from sasgeo_bench.geometry.grid import Grid
from sasgeo_bench.osm.locate import IMAGERY_VARIABLE, PlainName, Sha256, imagery_folders, named_files

ORTHO: Final = "ortho.tif"
MOST_WINDOW_PIXELS: Final = 64_000_000  # 256 MB as colours and mask
BANDS: Final = (1, 2, 3)  # red, green, blue
OFFSET_VERSION: Final = 1  # raised whenever the same imagery and map give another offset

Bounds = tuple[float, float, float, float]
Share = Annotated[float, Field(ge=0, le=1)]
Metres = Annotated[float, Field(ge=0)]


class RenderedRecord(JsonDocument):
    """How a picture was rendered of a map: no photograph is in it.

    `map_sha256` is the hash of the inputs of the dated map that it shows, `made_by` the program.
    """

    family: str
    season: str
    seed: int
    sun_elevation_deg: float
    sun_azimuth_deg: float
    map_sha256: str
    made_by: str


class PictureRecord(JsonDocument):
    """One picture that the imagery was made of; `gsd_m` is its own ground resolution.

    A picture that was rendered has `rendered`: its file, hash and date are those of the extract that it shows.
    """

    without_empty: ClassVar = frozenset({"rendered"})

    file: str
    sha256: str
    bytes: Annotated[int, Field(ge=0)]
    date: dt.date
    licence: str
    attribution: str
    publish: bool
    source: str | None
    gsd_m: Metres
    rendered: RenderedRecord | None = None

    def to_text(self) -> str:
        """Describe in a few words what it is."""
        if self.rendered is None:
            return f"{self.file} of {self.date}"
        look = f"{self.rendered.season}, family {self.rendered.family}, seed {self.rendered.seed}"
        return f"rendered from {self.file} of {self.date} ({look})"


class OffsetRecord(JsonDocument):
    """Measured offset of the imagery against the map: where a roof is seen, less where the map has the building.

    `east_m` and `north_m` with their 95 % intervals are the median of the tiles that show it clearly; `residual_m` is
    the median distance of the offset of such a tile from it, `residual_90_m` the 90th percentile. `tiles` is how many
    they are, `of_tiles` how many have walls; both newer figures are None in files of earlier versions, whose `tiles`
    are all with walls.
    """

    east_m: float
    north_m: float
    east_interval_m: tuple[float, float]
    north_interval_m: tuple[float, float]
    residual_m: Metres
    residual_90_m: Metres | None = None
    tiles: Annotated[int, Field(ge=1)]
    of_tiles: Annotated[int, Field(ge=1)] | None = None

    @model_validator(mode="before")
    @classmethod
    def _of_an_earlier_version(cls, given: Any) -> Any:  # noqa: ANN401 - what a file holds
        """Leave out the height of the one peak of all tiles, which a file of an earlier version states."""
        return {key: given[key] for key in given if key != "sharpness"} if isinstance(given, dict) else given

    def to_text(self) -> str:
        """Describe in one line by how much the imagery is off."""
        (west, east), (south, north) = self.east_interval_m, self.north_interval_m
        most = "" if self.residual_90_m is None else f" (90 % under {self.residual_90_m:.2f})"
        of = "" if self.of_tiles is None else f" of {self.of_tiles}"
        return (
            f"{self.east_m:+.2f} m east ({west:+.2f} to {east:+.2f}), {self.north_m:+.2f} m north ({south:+.2f} to "
            f"{north:+.2f}), residual {self.residual_m:.2f} m{most}, n = {self.tiles}{of}"
        )


class OrthoRecord(JsonDocument):
    """The imagery of a region as `region.json` holds it: its pictures, lattice and offset against the map.

    `bounds_m` are west, south, east, north; `share` is the fraction of the mapped ground that it shows.
    `offset_version` is `OFFSET_VERSION` of the program that measured the offset, 0 in files of earlier ones.
    """

    without_empty: ClassVar = frozenset({"offset_version"})

    pictures: Annotated[tuple[PictureRecord, ...], Field(min_length=1)]
    gsd_m: Annotated[float, Field(gt=0)]
    bounds_m: Bounds
    rows: Annotated[int, Field(ge=1)]
    cols: Annotated[int, Field(ge=1)]
    share: Share
    offset: OffsetRecord | None
    offset_version: Annotated[int, Field(ge=0)] = 0

    @property
    def is_publishable(self) -> bool:
        """Return whether every picture may be passed on."""
        return all(picture.publish for picture in self.pictures)

    @property
    def is_rendered(self) -> bool:
        """Return whether it was rendered of a map, so that nothing in it is a photograph."""
        return any(picture.rendered is not None for picture in self.pictures)

    @property
    def attribution(self) -> str:
        """Return the attributions of all pictures with their licences, each once."""
        return "; ".join(dict.fromkeys(f"{item.attribution} ({item.licence})" for item in self.pictures))

    def to_text(self) -> str:
        """Describe in one line what there is, how far it is off the map, and whether it may be passed on."""
        files = ", ".join(item.to_text() for item in self.pictures)
        unknown = "on the map that it shows" if self.is_rendered else "its offset is not known"
        off = f"off the map by {self.offset.to_text()}" if self.offset else unknown
        rights = "may be passed on" if self.is_publishable else "must not be passed on"
        shown = f"pixels of {self.gsd_m:.3f} m show {self.share:.1%} of the mapped ground"
        return f"{files}; {shown}, {off}; {self.attribution}, {rights}"

    @classmethod
    def unmeasured(cls, pictures: tuple[PictureRecord, ...], grid: Grid) -> Self:
        """Return the record of an image on a lattice before its share and offset are measured."""
        return cls(
            pictures=pictures,
            gsd_m=grid.cell_size_m,
            bounds_m=grid.bounds_m,
            rows=grid.rows,
            cols=grid.cols,
            share=0.0,
            offset=None,
        )

    def grid(self, *, epsg: int) -> Grid:
        """Return the lattice of the pixels."""
        west_m, _, _, north_m = self.bounds_m
        return Grid(epsg=epsg, west_m=west_m, north_m=north_m, cell_size_m=self.gsd_m, rows=self.rows, cols=self.cols)


@dataclass(frozen=True, kw_only=True)
class ImageryWindow:
    """A part of the imagery: `rgb`, uint8 of shape (rows, cols, 3), and where it holds a picture, (rows, cols)."""

    grid: Grid
    rgb: NDArray[np.uint8]
    is_known: NDArray[np.bool_]


@dataclass(frozen=True, kw_only=True)
class Imagery:
    """Aerial imagery of a region on disk; nothing is read before a window is asked for.

    `file` is what `region.json` says of the file; a different one is refused at the first window.

    Examples
    --------
    `read_region("out/regions/zanzibar").imagery.read((553000.0, 9332000.0, 553064.0, 9332064.0), gsd_m=0.25)` gives
    256 x 256 pixels around a place, and `imagery.record.offset` how far they are off the map.
    """

    path: Path
    file: FileRecord
    record: OrthoRecord
    epsg: int

    @property
    def grid(self) -> Grid:
        """Return the lattice of the pixels."""
        return self.record.grid(epsg=self.epsg)

    @property
    def off_m(self) -> tuple[float, float]:
        """Return how far east and north of its place on the map a thing is seen, metres; 0 where not measured."""
        offset = self.record.offset
        return (offset.east_m, offset.north_m) if offset else (0.0, 0.0)

    def check(self) -> None:
        """Raise `StoreError` if the file is missing or differs from its record in `region.json`."""
        if not self.path.is_file() or file_record(self.path) != self.file:
            raise StoreError(f"{self.path} is missing, or not what region.json says: build the region again")

    def read(self, bounds_m: Bounds, *, gsd_m: float | None = None) -> ImageryWindow:
        """Read the smallest window that covers west, south, east, north, metres in the region's CRS.

        Its pixels are `gsd_m` wide, by default those of the file; coarser ones are averaged. Beyond the imagery
        nothing is known, and `rgb` is 0.

        Raises
        ------
        ImageryError
            If the window has more than `MOST_WINDOW_PIXELS` pixels.
        StoreError
            If the file is missing or damaged.
        GridError
            If the bounds or the resolution define no lattice.
        """
        grid = Grid.from_bounds(*bounds_m, cell_size_m=gsd_m or self.record.gsd_m, epsg=self.epsg)
        if grid.rows * grid.cols > MOST_WINDOW_PIXELS:
            raise ImageryError(
                f"a window of {grid.rows} x {grid.cols} pixels is too large, the most is {MOST_WINDOW_PIXELS:,}: read "
                "a smaller one, or a coarser gsd_m"
            )
        return read_window(self.path, grid, is_coarser=grid.cell_size_m > self.record.gsd_m)


def read_window(path: Path, grid: Grid, *, is_coarser: bool) -> ImageryWindow:
    """Read a window of an ortho image on a lattice in its CRS; raise `StoreError` if the file cannot be read."""
    from affine import Affine  # noqa: PLC0415
    from rasterio.enums import Resampling  # noqa: PLC0415
    from rasterio.errors import RasterioError  # noqa: PLC0415
    from rasterio.vrt import WarpedVRT  # noqa: PLC0415

    try:
        with open_geotiff(path) as whole:
            fitting = [factor for factor in whole.overviews(1) if factor * whole.res[0] <= grid.cell_size_m]
        level = len(fitting) - 1 if fitting else None
        with (
            open_geotiff(path, overview_level=level) as source,
            WarpedVRT(
                source,
                crs=source.crs,
                transform=Affine(*grid.transform),
                height=grid.rows,
                width=grid.cols,
                resampling=Resampling.average if is_coarser else Resampling.bilinear,
                add_alpha=True,
            ) as view,
        ):
            bands = view.read()  # at once: each call warps anew
    except (RasterioError, OSError) as error:
        raise StoreError(f"{path} cannot be read ({error}): build the region again") from error
    rgb, is_known = bands[:-1], np.asarray(bands[-1] > 0)
    return ImageryWindow(
        grid=grid, rgb=np.moveaxis(rgb, 0, -1) * is_known[..., None].astype(np.uint8), is_known=is_known
    )


_FLAG: Final = "--imagery"
Level = Annotated[int, Field(ge=0, le=255)]


class ImageryEntry(Document):
    """One `[[imagery]]` of a region file: a GeoTIFF of aerial pictures, an MBTiles, a GeoPackage, a folder of tiles.

    `publish` says whether the picture, or what is cut out of it, may be passed on. `empty_rgb` is the colour of areas
    without a picture, in files that say so by no mask. `gsd_m` is a coarser ground resolution than the file has.
    `layer` names one of several rasters of a GeoPackage; `tms` says that rows of a folder of tiles count from the
    south.

    >>> from sasgeo_bench.core.config import parse_toml
    >>> text = '''
    ... file = "mosaic.tif"
    ... sha256 = ["0000000000000000000000000000000000000000000000000000000000000000"]
    ... date = 2024-01-01
    ... licence = "CC-BY-4.0"
    ... attribution = "OpenAerialMap contributors"
    ... '''
    >>> parse_toml(text, ImageryEntry, source="[[imagery]]")
    Traceback (most recent call last):
        ...
    sasgeo_bench.core.errors.ConfigError: [[imagery]]: 'publish' is missing
    """

    without_empty: ClassVar = frozenset({"layer", "tms"})

    file: PlainName
    sha256: Annotated[tuple[Sha256, ...], Field(strict=False, min_length=1)]
    date: dt.date
    licence: Line
    attribution: Line
    publish: bool
    source: Line | None = None
    layer: Line | None = None
    tms: bool = False
    empty_rgb: Annotated[tuple[Level, Level, Level], Field(strict=False)] | None = None
    gsd_m: Annotated[float, Field(gt=0, le=100)] | None = None


def find_imagery(entry: ImageryEntry, *, folders: Sequence[Path] = (), extracts: Sequence[Path] = ()) -> Path:
    """Find a picture by name and SHA-256; `folders` come first, then those of `imagery_folders`.

    Pictures are never downloaded. Raise `ImageryError` if no folder holds it; the message says where to put it.
    """
    from sasgeo_bench.regions.tiles import record_of  # noqa: PLC0415 - GDAL is slow to import

    places = imagery_folders(folders, extracts=extracts)
    wrong: list[str] = []
    for path in named_files(entry.file, places, has_folders=True):
        found = record_of(path).sha256
        if found in entry.sha256:
            return path
        wrong.append(f"{path} has SHA-256 {found}, which is none of those accepted")
    because = f" ({'; '.join(wrong)})" if wrong else ""
    where = ", ".join(map(str, dict.fromkeys(places))) or "a folder"
    raise ImageryError(
        f"{entry.file} (SHA-256 {' or '.join(entry.sha256)}) was not found{because}: put it into {where}, or name its "
        f"folder with {_FLAG} or {IMAGERY_VARIABLE}"
    )
