# SPDX-License-Identifier: Apache-2.0
"""Read a dataset's folder of unknown origin: nothing is written, no link leads out, every name and size is bounded."""

import csv
import math
import re
import warnings
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np
import shapely
from rasterio.errors import NotGeoreferencedWarning, RasterioError
from sklearn.cluster import DBSCAN  # type: ignore[import-untyped, unused-ignore]

from sasgeo_bench.core.errors import DatasetError, counted
from sasgeo_bench.core.geotiff import open_geotiff
from sasgeo_bench.core.paths import plain_file
from sasgeo_bench.exchange.importers.items import MOST_ITEMS, Box, Dataset, Item, Position, Role
from sasgeo_bench.geometry.projection import to_lonlat
from sasgeo_bench.osm.regional import regional_extracts_of
from sasgeo_bench.regions.region_spec import RegionFile, list_region_files, read_region_file

IMAGES: Final = (".jpg", ".jpeg", ".png", ".tif", ".tiff", ".bmp", ".webp")
_MOST_BYTES: Final = 100_000_000  # of a table
_MOST_QUOTED: Final = 60  # characters
_NUMBER: Final = re.compile(r"[+-]?([0-9]+(\.[0-9]*)?|\.[0-9]+)([eE][+-]?[0-9]+)?")


class FolderReader:
    """A folder that is only read; `skipped` counts what was left out, by reason.

    `layout` says in a clause what the folder should hold; errors end with it.
    """

    def __init__(self, root: Path, *, layout: str) -> None:
        self.layout = layout
        self.skipped: Counter[str] = Counter()
        if not root.is_dir():
            raise DatasetError(f"there is no folder {root}: {layout}")
        self.root = root.resolve()
        if next(self.root.iterdir(), None) is None:
            raise DatasetError(f"{root} is empty: {layout}")

    def has(self, relative: str) -> bool:
        """Return whether the folder holds a file or folder of a relative path."""
        return (self.root / relative).exists()

    def folders(self, relative: str) -> list[str]:
        """Return the names of the folders in a folder, sorted; raise `DatasetError` if it is missing."""
        return [path.name for path in self._entries(relative) if path.is_dir()]

    def files(self, relative: str) -> list[str]:
        """Return the names of the files in a folder, sorted."""
        return [path.name for path in self._entries(relative) if path.is_file()]

    def images(self, relative: str) -> list[str]:
        """Return the names of the images in a folder, sorted; other files are counted in `skipped`.

        Raise `DatasetError` if the folder is missing, or an image is empty.
        """
        found = []
        for path in self._entries(relative):
            if not path.is_file():
                self.skipped["entry among images that is no file"] += 1
            elif path.suffix.lower() not in IMAGES:
                self.skipped["file that is no image by its name"] += 1
            elif path.stat().st_size == 0:
                raise DatasetError(f"{self._shown(relative, path.name)} is an empty file: copy it again")
            else:
                found.append(path.name)
        return found

    def file(self, relative: str) -> Path:
        """Return the path of a file; raise `DatasetError` if it is missing or leads out of the folder."""
        path = self.root / relative
        self._refuse_way_out(path, relative)
        if not path.is_file():
            raise self.missing(relative)
        return path

    def lines(self, relative: str) -> Iterator[tuple[int, str]]:
        """Yield number and text of each line of a text file that is not blank; the first line is number 1."""
        path = self.file(relative)
        if path.stat().st_size > _MOST_BYTES:
            raise DatasetError(
                f"{relative} has {path.stat().st_size} bytes, {_MOST_BYTES} at most: it is no table of this set"
            )
        try:
            text = plain_file(path).read_text(encoding="utf-8-sig")
        except UnicodeDecodeError as error:
            raise DatasetError(f"{relative} is no text in UTF-8 (byte {error.start}): copy it again") from error
        for number, line in enumerate(text.splitlines(), start=1):
            if line.strip():
                yield number, line

    def rows(self, relative: str, *, columns: tuple[str, ...]) -> Iterator["TableRow"]:
        """Yield the rows of a CSV file with a header; raise `DatasetError` if it lacks one of the columns."""
        found = self.lines(relative)
        head = [name.strip() for name in _split(next(found, (0, ""))[1], where=f"{relative} line 1")]
        lacking = [name for name in columns if name not in head]
        if lacking or len(set(head)) < len(head):
            shown = ", ".join(head)[:_MOST_QUOTED] or "nothing"
            fault = f"no column {lacking[0]!r}" if lacking else "two columns of one name"
            raise DatasetError(f"{relative} has {fault} (its first line: {shown}): expected {','.join(columns)}")
        for number, line in found:
            cells = _split(line, where=f"{relative} line {number}")
            if len(cells) != len(head):
                raise DatasetError(
                    f"{relative} line {number} has {counted(len(cells), 'cell')}, its first line {len(head)}"
                )
            cells = [cell.strip() for cell in cells]
            yield TableRow(where=f"{relative} line {number}", cells=dict(zip(head, cells, strict=True)))

    def missing(self, relative: str) -> DatasetError:
        """Return the error that names a missing file or folder."""
        return DatasetError(f"{self.root} holds no {relative}: {self.layout}")

    def notes(self) -> tuple[str, ...]:
        """Return a line for each reason for which something was left out."""
        return tuple(f"left out {count} x {reason}" for reason, count in sorted(self.skipped.items()))

    def _entries(self, relative: str) -> list[Path]:
        """Return what lies in a folder, sorted by name, without hidden files."""
        folder = self.root / relative
        self._refuse_way_out(folder, relative)
        if not folder.is_dir():
            raise self.missing(relative)
        found = sorted(path for path in folder.iterdir() if not path.name.startswith("."))
        for path in found:
            if not path.name.isprintable():
                raise DatasetError(f"{relative} holds a name that is no printable line, {path.name!a}: rename it")
            if path.is_symlink():
                self._refuse_way_out(path, self._shown(relative, path.name))
        return found

    def _refuse_way_out(self, path: Path, shown: str) -> None:
        try:
            is_inside = path.resolve().is_relative_to(self.root)
        except (OSError, RuntimeError):  # a circle of links
            is_inside = False
        if not is_inside:
            raise DatasetError(f"{shown} is a link that leads out of {self.root}: put the file itself there")

    @staticmethod
    def _shown(relative: str, name: str) -> str:
        return name if relative == "." else f"{relative}/{name}"


@dataclass(frozen=True, slots=True)
class TableRow:
    """One row of a table: its cells by column, and where it stands, for errors."""

    where: str
    cells: Mapping[str, str]

    def number(self, name: str) -> float:
        """Return a cell as a number; raise `DatasetError` if it is none."""
        return to_number(self.cells[name], where=f"{self.where}, {name}")


def to_number(text: str, *, where: str) -> float:
    """Return a decimal number; raise `DatasetError` for anything else, NaN and infinity too.

    >>> to_number("nan", where="01.csv line 3, lat")
    Traceback (most recent call last):
        ...
    sasgeo_bench.core.errors.DatasetError: 01.csv line 3, lat: expected a number, got 'nan'
    """
    value = float(text) if _NUMBER.fullmatch(text) else float("inf")
    if abs(value) == float("inf"):
        raise DatasetError(f"{where}: expected a number, got {text[:_MOST_QUOTED]!r}")
    return value


def _split(line: str, *, where: str) -> list[str]:
    try:
        return next(csv.reader([line]), [])
    except csv.Error as error:
        raise DatasetError(f"{where} is no row of a table ({error}): copy the file again") from error


@dataclass(frozen=True, slots=True, kw_only=True)
class LabelFolder:
    """A folder of folders, one for each label: its path, and what its items are."""

    relative: str
    role: Role
    view: str
    group: str | None = None
    height_m: float | None = None


def read_labels(reader: FolderReader, folder: LabelFolder, *, digits: int) -> list[Item]:
    """Read `<folder>/<label>/<image>`: an item for each image.

    Raise `DatasetError` if the folder is missing, a label is not of so many digits, or a label has no image. The
    released code reads labels as numbers, by which `7` and `0007` are one; so only the full form is a label here.
    """
    items: list[Item] = []
    for label in reader.folders(folder.relative):
        path = f"{folder.relative}/{label}"
        if not re.fullmatch(rf"[0-9]{{{digits}}}", label):
            raise DatasetError(f"{path} is not named by a label of {digits} digits: remove it or rename it")
        names = reader.images(path)
        if not names:
            raise DatasetError(f"{path} holds no image ({', '.join(IMAGES)}): copy the folder again")
        items += [
            Item(
                item_id=f"{path}/{name}",
                role=folder.role,
                view=folder.view,
                label=label,
                group=folder.group,
                height_m=folder.height_m,
            )
            for name in names
        ]
        if len(items) > MOST_ITEMS:
            raise DatasetError(f"{folder.relative} holds more than {MOST_ITEMS} images: name the folder of one dataset")
    if not items:
        raise DatasetError(f"{folder.relative} holds no folder of a label: {reader.layout}")
    return items


GAP_M: Final = 5_000.0  # items farther apart than this lie in different areas
_RADIUS_M: Final = 6_371_000.0
_M_PER_DEG: Final = 111_320.0
_STEP_DEG: Final = 0.001  # items within such a cell count once when areas are formed


@dataclass(frozen=True, slots=True, kw_only=True)
class Extent:
    """One area of a dataset.

    Parameters
    ----------
    box : Box
        Its items, with a margin.
    items : int
        How many items lie in it.
    groups : tuple of str
        Their groups, such as flights.
    width_km, height_km : float
        Size of the box.
    covered_by, touched_by : tuple of str
        Region files whose ground covers the box, or meets it in part.
    extracts : tuple of str
        Names of regional extracts whose boxes hold the area, smallest first; the first may be a neighbour's.
    """

    box: Box
    items: int
    groups: tuple[str, ...]
    width_km: float
    height_km: float
    covered_by: tuple[str, ...]
    touched_by: tuple[str, ...]
    extracts: tuple[str, ...]


def find_extents(dataset: Dataset, *, folders: Sequence[Path] = ()) -> tuple[Extent, ...]:
    """Return the areas of a dataset, from west to east, and what covers each.

    Items lie in one area if steps of at most 5 km lead from one to the other; each area gets a margin of 500 m.
    `folders` hold region files of the user's own. Raise `DatasetError` if no item has a place.
    """
    placed = [item for item in dataset.items if item.position is not None]
    if not placed:
        raise DatasetError(f"{dataset.card.title} has no coordinates: no extract can be named for it")
    grounds = _region_grounds(folders)
    extents = [_extent(members, grounds) for members in _clusters(placed)]
    return tuple(sorted(extents, key=lambda extent: (extent.box.west_deg, extent.box.south_deg)))


def _extent(members: Sequence[Item], grounds: dict[str, shapely.Geometry]) -> Extent:
    box = _box_of(members)
    area = shapely.box(box.west_deg, box.south_deg, box.east_deg, box.north_deg)
    covering = [name for name, ground in grounds.items() if ground.covers(area)]
    touching = [name for name, ground in grounds.items() if name not in covering and ground.intersects(area)]
    per_lon_m = _M_PER_DEG * math.cos(math.radians(box.centre.latitude_deg))
    return Extent(
        box=box,
        items=len(members),
        groups=tuple(sorted({item.group for item in members if item.group is not None})),
        width_km=(box.east_deg - box.west_deg) * per_lon_m / 1000,
        height_km=(box.north_deg - box.south_deg) * _M_PER_DEG / 1000,
        covered_by=tuple(covering),
        touched_by=tuple(touching),
        extracts=tuple(item.name for item in regional_extracts_of(area)),
    )


def _clusters(items: Sequence[Item]) -> list[list[Item]]:
    """Group items that steps of `GAP_M` connect."""
    lonlat = np.array([(item.position.longitude_deg, item.position.latitude_deg) for item in items if item.position])
    cells, member = np.unique(np.round(lonlat / _STEP_DEG), axis=0, return_inverse=True)
    places = np.radians(cells[:, ::-1] * _STEP_DEG)
    search = DBSCAN(eps=GAP_M / _RADIUS_M, min_samples=1, metric="haversine", algorithm="ball_tree")
    labels = search.fit_predict(places)[member.ravel()]
    return [[items[int(at)] for at in np.flatnonzero(labels == label)] for label in np.unique(labels)]


def _box_of(items: Sequence[Item]) -> Box:
    places = [item.position for item in items if item.position is not None]
    longitudes, latitudes = [place.longitude_deg for place in places], [place.latitude_deg for place in places]
    north_deg = 500.0 / _M_PER_DEG  # m: a view reaches beyond its centre
    east_deg = north_deg / math.cos(math.radians(sum(latitudes) / len(latitudes)))
    return Box(
        west_deg=min(longitudes) - east_deg,
        south_deg=min(latitudes) - north_deg,
        east_deg=max(longitudes) + east_deg,
        north_deg=max(latitudes) + north_deg,
    )


def _region_grounds(folders: Sequence[Path]) -> dict[str, shapely.Geometry]:
    """Return the ground of each region file, degrees; made-up towns have none."""
    specs = {name: read_region_file(path) for name, path in sorted(list_region_files(folders=folders).items())}
    return {name: _ground(spec) for name, spec in specs.items() if not all(item.town for item in spec.extract)}


def _ground(spec: RegionFile) -> shapely.Geometry:
    """Return what a region's extract is known to map: its coverage if it is stated, else the region itself."""
    if spec.coverage_lonlat is not None:
        return shapely.Polygon(spec.coverage_lonlat)
    grid = spec.grid()
    return shapely.box(*to_lonlat(grid.epsg).transform_bounds(*grid.bounds_m))


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
