# SPDX-License-Identifier: Apache-2.0
"""Several dated extracts of one place, or one full history cut at several dates, read over their common area."""

import datetime as dt
import re
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from shutil import copyfile
from tempfile import TemporaryDirectory
from typing import Final

import geopandas as gpd
import numpy as np
import osmium
import pyproj
import shapely

from sasgeo_bench.errors import ConfigError, CoverageError, ExtractError
from sasgeo_bench.geometry.grid import Grid, utm_epsg
from sasgeo_bench.osm.coverage import CLOSE_M
from sasgeo_bench.osm.features import SEA
from sasgeo_bench.osm.lifecycle import Lifecycle, read_lifecycle
from sasgeo_bench.osm.mapped import box_text, project
from sasgeo_bench.osm.read import Reading, read_extract
from sasgeo_bench.osm.scan import Box
from sasgeo_bench.osm.snapshot import OBJECTS, elements, is_history, open_snapshot, read_header

MARGIN_M: Final = CLOSE_M / 2  # an estimated coverage reaches this far beyond the edge of the cut
CELL_M: Final = 10.0  # of the grid that frames the reading; nothing is burnt into it
_EDGE_DEG: Final = 0.01  # spacing of corners: a box's straight sides in degrees bend when projected
_LEAST_STATES: Final = 2
_NAMED_DATE: Final = re.compile(r"(?<!\d)(\d{4}-\d{2}-\d{2})(?!\d)")
_SILENT: Final[Callable[[str], None]] = lambda _: None  # noqa: E731 - a default


@dataclass(frozen=True, slots=True, kw_only=True)
class DatedExtract:
    """An extract and its date; for a full history, the date to cut it at."""

    path: Path
    on: dt.date


@dataclass(frozen=True, slots=True, kw_only=True)
class State:
    """One dated state of the common area: features with whole geometries, and hints from lifecycle tags."""

    source: str
    on: dt.date
    features: gpd.GeoDataFrame
    lifecycle: Lifecycle


@dataclass(frozen=True, slots=True, kw_only=True)
class History:
    """States of one place, oldest first, and the area that all of them map, in the CRS `epsg`."""

    states: tuple[State, ...]
    area: shapely.Geometry
    epsg: int


def date_extracts(paths: Sequence[Path], *, at: Sequence[dt.date] = ()) -> tuple[DatedExtract, ...]:
    """Date every extract, and sort them by date.

    Full histories (`.osh.*`) are cut at every date of `at`. Without a full history, `at` dates the files in their
    order; if it is empty, a file is dated by its header, else by the last YYYY-MM-DD in its name, else by its newest
    element.

    Raise `ConfigError` if the dates do not fit the files, two states have one date, or there are fewer than two states,
    and `ExtractError` if a file is missing, damaged or has no date.

    >>> [str(item.on) for item in date_extracts([Path("a.osh.pbf")], at=[dt.date(2016, 1, 1), dt.date(2014, 1, 1)])]
    ['2014-01-01', '2016-01-01']
    """
    histories = [path for path in paths if is_history(path)]
    if histories:
        if not at:
            message = f"{histories[0].name} is a full history: give the dates to cut it at with --at"
            raise ConfigError(message)
        dated = [DatedExtract(path=path, on=day) for path in histories for day in at]
        dated += [DatedExtract(path=path, on=_own_date(path)) for path in paths if not is_history(path)]
    elif at:
        if len(at) != len(paths):
            message = f"--at dates the extracts in their order: got {len(at)} for {len(paths)} extracts, give one each"
            raise ConfigError(message)
        dated = [DatedExtract(path=path, on=day) for path, day in zip(paths, at, strict=True)]
    else:
        dated = [DatedExtract(path=path, on=_own_date(path)) for path in paths]
    return _checked(dated)


def _checked(dated: Sequence[DatedExtract]) -> tuple[DatedExtract, ...]:
    if len(dated) < _LEAST_STATES:
        message = f"ageing needs at least {_LEAST_STATES} dated states, got {len(dated)}: name another with --extract"
        raise ConfigError(message)
    twice = [day for day, count in Counter(item.on for item in dated).items() if count > 1]
    if twice:
        names = ", ".join(sorted(item.path.name for item in dated if item.on == twice[0]))
        message = f"two states have the date {twice[0]} ({names}): leave one out, or date them with --at"
        raise ConfigError(message)
    return tuple(sorted(dated, key=lambda item: item.on))


def _own_date(path: Path) -> dt.date:
    header = read_header(path)
    if header.replicated_at is not None:
        return header.replicated_at.date()
    named: list[str] = _NAMED_DATE.findall(path.name)
    for text in reversed(named):
        try:
            return dt.date.fromisoformat(text)
        except ValueError:
            continue
    with open_snapshot(path) as snapshot:
        every = elements(osmium.FileProcessor(str(snapshot.path), OBJECTS))
        newest = max((item.timestamp for item in every), default=None)
    if newest is None or newest.year <= 1970:  # noqa: PLR2004 - osmium returns 1970 if a file has no times
        message = f"{path.name} does not say what day it is of: date it with --at, or put YYYY-MM-DD into its name"
        raise ExtractError(message)
    return dt.date(newest.year, newest.month, newest.day)


def read_history(
    dated: Sequence[DatedExtract],
    *,
    bounds: Box | None = None,
    margin_m: float = MARGIN_M,
    tell: Callable[[str], None] = _SILENT,
) -> History:
    """Read dated extracts over the area that all of them map, in a UTM zone; `tell` takes a line about each.

    `bounds` (west, south, east, north, degrees) limits the area. `margin_m` is cut off along estimated edges: two
    extracts of a country are seldom cut along one line, and what lies between their lines would vanish or appear in a
    day. States of one file share one edge, so nothing is cut off. Raise `CoverageError` if extracts and bounds have no
    area in common, `ExtractError` if a file is missing, damaged or of an unknown format.
    """
    boxes = {path: _frame(path) for path in dict.fromkeys(item.path for item in dated)}
    frame = _common_frame(boxes, bounds)
    west, south, east, north = frame
    epsg = utm_epsg((west + east) / 2, (south + north) / 2)
    grid = _grid_around(frame, epsg)
    is_one_file = len(boxes) == 1
    states: list[State] = []
    area = _projected_box(frame, epsg)
    for item in dated:
        with _one_state(item) as plain:
            reading = read_extract(plain, grid)
            with open_snapshot(plain) as snapshot:
                lifecycle = read_lifecycle(snapshot.path, epsg=epsg)
        area = shapely.intersection(area, _inner(reading, grid, margin_m=0.0 if is_one_file else margin_m))
        # The sea is not a mapped object: its changes are those of the coastline.
        objects = reading.features[(reading.features["osm_type"] != SEA).to_numpy()]
        states.append(State(source=item.path.name, on=item.on, features=objects, lifecycle=lifecycle))
        tell(_line(item, reading))
    if shapely.area(area) <= 0:
        message = (
            f"the extracts map no area in common that lies {margin_m:g} m within their estimated edges: "
            "choose extracts of one place, other --bounds, or a smaller --margin-m"
        )
        raise CoverageError(message)
    return History(states=tuple(states), area=area, epsg=epsg)


def _inner(reading: Reading, grid: Grid, *, margin_m: float) -> shapely.Geometry:
    """Return the coverage less a margin along its own estimated edges; the grid's edges do not count."""
    if reading.coverage_source != "estimated" or margin_m <= 0:
        return reading.coverage
    beyond = shapely.difference(shapely.box(*grid.bounds_m), reading.coverage)
    return shapely.difference(reading.coverage, shapely.buffer(beyond, margin_m))


def _line(item: DatedExtract, reading: Reading) -> str:
    km2 = shapely.area(reading.coverage) / 1e6
    notes = "".join(f"; {warning}" for warning in reading.warnings)
    return f"{item.path.name} of {item.on}: {len(reading.features)} features, {km2:.1f} km2 mapped{notes}"


@contextmanager
def _one_state(item: DatedExtract) -> Iterator[Path]:
    """Yield a file with one state: the extract itself, or a full history cut once for both passes."""
    if not is_history(item.path):
        yield item.path
        return
    with TemporaryDirectory(prefix="sasgeo-") as scratch:
        cut = Path(scratch) / f"{item.path.name.split('.')[0]}-at-{item.on}.osm.pbf"
        with open_snapshot(item.path, at=item.on) as snapshot:
            copyfile(snapshot.path, cut)
        yield cut


def _frame(path: Path) -> Box:
    """Return the box of a file's header, else of its nodes, degrees."""
    box = read_header(path).box_lonlat
    if box is not None:
        return box
    with open_snapshot(path, at=dt.date.max if is_history(path) else None) as snapshot:
        nodes = elements(osmium.FileProcessor(str(snapshot.path), osmium.osm.NODE))
        places = np.array([(node.lon, node.lat) for node in nodes if node.location.valid()]).reshape(-1, 2)
    if len(places) == 0:
        message = f"{path.name} holds no node: is it an extract of map data?"
        raise CoverageError(message)
    low, high = places.min(axis=0), places.max(axis=0)
    return (float(low[0]), float(low[1]), float(high[0]), float(high[1]))


def _common_frame(boxes: dict[Path, Box], bounds: Box | None) -> Box:
    frame = (-180.0, -90.0, 180.0, 90.0) if bounds is None else bounds
    for path, box in boxes.items():
        frame = (max(frame[0], box[0]), max(frame[1], box[1]), min(frame[2], box[2]), min(frame[3], box[3]))
        if not (frame[0] < frame[2] and frame[1] < frame[3]):
            what = "the bounds" if bounds is not None and len(boxes) == 1 else "the other extracts or the bounds"
            message = (
                f"{path.name} covers {box_text(box)} (west, south, east, north) and has nothing in common with {what}"
            )
            raise CoverageError(message)
    return frame


def _projected_box(frame: Box, epsg: int) -> shapely.Geometry:
    return project(shapely.segmentize(shapely.box(*frame), _EDGE_DEG), epsg)


def _grid_around(frame: Box, epsg: int) -> Grid:
    to_metres = pyproj.Transformer.from_crs(4326, epsg, always_xy=True)
    west_m, south_m, east_m, north_m = to_metres.transform_bounds(*frame, densify_pts=21)
    return Grid.from_bounds(west_m, south_m, east_m, north_m, cell_size_m=CELL_M, epsg=epsg)
