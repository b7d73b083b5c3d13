# SPDX-License-Identifier: Apache-2.0
"""UAV-VisLoc: frames of flights `NN` with positions, and a satellite map of each, cut into tiles as Game4Loc does."""

import datetime as dt
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Final

from sasgeo_bench.core.errors import DatasetError, counted, named
from sasgeo_bench.exchange.importers.items import Attitude, Box, Dataset, DatasetCard, Item, Position
from sasgeo_bench.exchange.importers.reader import FolderReader, MapSheet, TableRow, cut_tiles, read_size_px

CARD: Final = DatasetCard(
    kind="uav-visloc",
    title="UAV-VisLoc",
    source="https://github.com/IntelliSensing/UAV-VisLoc",
    licence="no licence file; satellite maps of Google",
    attribution="Xu et al.: UAV-VisLoc, arXiv 2405.11936",
)
MAPS: Final = "satellite_coordinates_range.csv"
LAYOUT: Final = f"UAV-VisLoc has {MAPS} and for each flight NN/NN.csv, NN/drone and NN/satelliteNN.tif"

_SPACED: Final = "satellite_ coordinates_range.csv"  # the name in some copies of the set
_MAP_COLUMNS: Final = ("mapname", "LT_lat_map", "LT_lon_map", "RB_lat_map", "RB_lon_map")
_ANGLES: Final = {"heading_deg": "Phi1", "pitch_deg": "Omega", "roll_deg": "Kappa"}
_MAP: Final = re.compile(r"satellite(([0-9]{2})(_[0-9]{2}-[0-9]{2})?)\.tif")
_FLIGHT: Final = re.compile(r"[0-9]{2}")


def read_visloc(reader: FolderReader) -> Dataset:
    """Read the folder of UAV-VisLoc; raise `DatasetError`, which names what is missing.

    Queries are the frames of each flight; the gallery are tiles of its map. No tile needs to be on the disk: the
    importer reads the size of the map, and places the tiles.
    """
    flights = [name for name in reader.folders(".") if _FLIGHT.fullmatch(name)]
    sheets = list(_read_sheets(reader))
    if not flights:
        raise reader.missing("01")
    frames = [frame for flight in flights for frame in _read_frames(reader, flight)]
    there = [sheet for sheet in sheets if sheet.flight in flights]
    tiles = [tile for sheet in there for tile in cut_tiles(_measured(reader, sheet))]
    parted = [_file_of(sheet) for sheet in there if not reader.has(_file_of(sheet))]
    notes = [f"{named(parted, 'map')} in parts: each is read as the mosaic of its parts"] if parted else []
    notes += [*_notes(flights, sheets, frames, tiles), *reader.notes()]
    return Dataset(card=CARD, items=(*frames, *tiles), notes=tuple(notes))


@dataclass(frozen=True, slots=True, kw_only=True)
class _Corners:
    """A row of the table of maps."""

    name: str
    flight: str
    box: Box


def _read_sheets(reader: FolderReader) -> Iterator[_Corners]:
    table = _SPACED if reader.has(_SPACED) and not reader.has(MAPS) else MAPS
    for row in reader.rows(table, columns=_MAP_COLUMNS):
        name = _MAP.fullmatch(row.cells["mapname"])
        if name is None:
            raise DatasetError(f"{row.where}: expected a map named satelliteNN.tif, got {row.cells['mapname'][:60]!r}")
        north, west, south, east = (row.number(column) for column in _MAP_COLUMNS[1:])
        for longitude, latitude in ((west, north), (east, south)):
            _position(row, longitude, latitude)
        try:
            box = Box(west_deg=west, south_deg=south, east_deg=east, north_deg=north)
        except DatasetError as error:
            raise DatasetError(
                f"{row.where}: LT is the north-west corner and RB the south-east one: {error}"
            ) from error
        yield _Corners(name=name[1], flight=name[2], box=box)


def _position(row: TableRow, longitude_deg: float, latitude_deg: float) -> Position:
    try:
        return Position(longitude_deg=longitude_deg, latitude_deg=latitude_deg)
    except DatasetError as error:
        raise DatasetError(f"{row.where}: {error}") from error


def _read_frames(reader: FolderReader, flight: str) -> Iterator[Item]:
    """Yield the frames of a flight; columns are found by name, for flights differ in how many they have."""
    table = f"{flight}/{flight}.csv"
    rows = list(reader.rows(table, columns=("filename", "lat", "lon", "height")))
    there, named_rows = set(reader.images(f"{flight}/drone")), set()
    for row in rows:
        name = row.cells["filename"]
        if name in named_rows:
            raise DatasetError(f"{row.where}: {name[:60]!r} has a row already: remove one")
        if name not in there:
            raise DatasetError(f"{flight}/drone holds no {name[:60]!r}, which {row.where} names: copy the images again")
        named_rows.add(name)
        yield _frame(row, flight)
    if not rows:
        raise DatasetError(f"{table} names no frame: copy it again")
    if len(named_rows) < len(there):
        reader.skipped[f"image of {flight}/drone without a row in {table}"] += len(there) - len(named_rows)


def _frame(row: TableRow, flight: str) -> Item:
    angles = {name: row.number(column) for name, column in _ANGLES.items() if row.cells.get(column)}
    return Item(
        item_id=f"{flight}/drone/{row.cells['filename']}",
        role="query",
        view="drone",
        group=flight,
        position=_position(row, row.number("lon"), row.number("lat")),
        height_m=row.number("height"),
        attitude=Attitude(**angles) if angles else None,
        taken_on=_day(row.cells.get("date", "")),
    )


def _day(text: str) -> dt.date | None:
    """Return the day of a date or time in ISO form, None for anything else."""
    try:
        return dt.datetime.fromisoformat(text).date()
    except ValueError:
        return None


def _file_of(corners: _Corners) -> str:
    return f"{corners.flight}/satellite{corners.name}.tif"


def _measured(reader: FolderReader, corners: _Corners) -> MapSheet:
    """Measure a map; one that the table has as a whole, and the folder in a grid of parts, is their mosaic."""
    relative = _file_of(corners)
    parts = {} if reader.has(relative) else _parts(reader, corners)
    if parts:
        width_px, height_px = _mosaic_px(parts, relative)
    else:
        width_px, height_px = read_size_px(reader.file(relative), shown=relative)
    return MapSheet(name=corners.name, flight=corners.flight, box=corners.box, width_px=width_px, height_px=height_px)


def _mosaic_px(parts: Mapping[tuple[int, int], tuple[int, int]], relative: str) -> tuple[int, int]:
    """Return width and height of a grid of parts; raise `DatasetError` if one is missing or does not fit."""
    rows, cols = (range(1, max(at[axis] for at in parts) + 1) for axis in (0, 1))
    grid = [(row, col) for row in rows for col in cols]
    lacking = [f"_{row:02}-{col:02}" for row, col in grid if (row, col) not in parts]
    if lacking:
        raise DatasetError(f"{relative} is in parts, and {named(lacking, 'part')} is missing: copy all of them")
    if any(parts[at][0] != parts[1, at[1]][0] or parts[at][1] != parts[at[0], 1][1] for at in grid):
        raise DatasetError(f"{relative} is in parts of sizes that make no grid: copy them again")
    return sum(parts[1, col][0] for col in cols), sum(parts[row, 1][1] for row in rows)


def _parts(reader: FolderReader, corners: _Corners) -> dict[tuple[int, int], tuple[int, int]]:
    """Return width and height of each part `satelliteNN_RR-CC.tif` of a map by its row and column, from 1 on."""
    part = re.compile(rf"satellite{corners.name}_((?!00)[0-9]{{2}})-((?!00)[0-9]{{2}})\.tif")
    found = [part.fullmatch(name) for name in reader.files(corners.flight)]
    return {
        (int(name[1]), int(name[2])): read_size_px(
            reader.file(f"{corners.flight}/{name[0]}"), shown=f"{corners.flight}/{name[0]}"
        )
        for name in found
        if name is not None
    }


def _notes(
    flights: Sequence[str], sheets: Sequence[_Corners], frames: Sequence[Item], tiles: Sequence[Item]
) -> Iterator[str]:
    extra = [f"satellite{sheet.name}.tif" for sheet in sheets if sheet.flight not in flights]
    if extra:
        yield f"left out {named(extra, 'map')} of flights without a folder"
    cut = {tile.group for tile in tiles}
    bare = [flight for flight in flights if flight not in cut]
    if bare:
        yield f"{named(bare, 'flight')} without a map of 512 pixels or more: their frames have no tile to find"
    straight = sorted({str(item.group) for item in frames if item.attitude is None})
    if straight:
        yield f"{named(straight, 'flight')} with frames without angles: heading, pitch and roll are null there"
    undated = sum(item.taken_on is None for item in frames)
    if undated:
        yield f"{counted(undated, 'frame')} without a date in ISO form: null there"
