# SPDX-License-Identifier: Apache-2.0
"""Dated states of one place over their common area, from extracts or one full history; lifecycle tags."""

import datetime as dt
import re
from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from shutil import copyfile
from typing import Any, Final, NamedTuple

import geopandas as gpd
import numpy as np
import osmium
import shapely
from numpy.typing import NDArray

from sasgeo_bench.core.errors import ConfigError, CoverageError, ExtractError
from sasgeo_bench.core.folders import scratch_folder
from sasgeo_bench.core.progress import tell
from sasgeo_bench.geometry.grid import Grid, utm_epsg
from sasgeo_bench.geometry.projection import from_lonlat
from sasgeo_bench.osm.coverage import CLOSE_M
from sasgeo_bench.osm.features import SEA
from sasgeo_bench.osm.mapped import box_text, project
from sasgeo_bench.osm.multipolygons import area_relation, kind_keys
from sasgeo_bench.osm.read import Reading, read_extract
from sasgeo_bench.osm.scan import Box, Tally, line_wkb
from sasgeo_bench.osm.snapshot import OBJECTS, elements, is_history, open_snapshot, own_id, read_header
from sasgeo_bench.osm.taxonomy import load_taxonomy

# Prefixes of https://wiki.openstreetmap.org/wiki/Lifecycle_prefix for what is gone, on the keys of our classes.
_PREFIXES: Final = ("demolished", "razed", "removed", "was", "abandoned", "destroyed")
_KEYS: Final = ("building", "highway", "railway", "waterway", "natural", "landuse", "leisure", "amenity", "barrier")
_GONE_KEYS: Final = tuple(f"{prefix}:{key}" for prefix in _PREFIXES for key in _KEYS)
_CONSTRUCTION: Final = tuple((key, "construction") for key in ("landuse", "building", "highway", "railway"))
_CONSTRUCTION_KEYS: Final = ("construction", *(f"construction:{key}" for key in _KEYS))
_START_KEYS: Final = ("start_date", "building:start_date", "opening_date")
_FACTORY: Final = osmium.geom.WKBFactory()

_CENTURY: Final = re.compile(r"c(\d{1,2})")
_DECADE: Final = re.compile(r"(\d{3}0)s")
_DAY: Final = re.compile(r"(\d{4})(?:-(\d{1,2}))?(?:-(\d{1,2}))?")


class ObjectKey(NamedTuple):
    """An OSM object as the feature table names it: "way" or "relation", and its id."""

    osm_type: str
    osm_id: int


class Span(NamedTuple):
    """First and last day that a vague date may mean."""

    first: dt.date
    last: dt.date


@dataclass(frozen=True, slots=True, kw_only=True)
class Lifecycle:
    """Hints of one state, in the CRS of its features.

    `gone` are places tagged as demolished, razed, removed or abandoned, `rising` those of construction, and `started`
    the days on which objects were begun.
    """

    gone: NDArray[np.object_]
    rising: NDArray[np.object_]
    started: dict[ObjectKey, Span]


def read_lifecycle(path: Path, *, epsg: int) -> Lifecycle:
    """Read the hints of ways and areas in one sorted state (`open_snapshot`), projected to `epsg`, metres.

    Nodes have no extent and are left out. osmium raises `RuntimeError` on a damaged file, which `open_snapshot` turns
    into an `ExtractError`.
    """
    gone: list[bytes] = []
    rising: list[bytes] = []
    started: dict[ObjectKey, Span] = {}
    keyed = osmium.filter.KeyFilter(*_GONE_KEYS, *_CONSTRUCTION_KEYS, *_START_KEYS)
    for item, is_relation, identifier in _tagged(path, keyed):
        tags = item.tags
        span = next((span for key in _START_KEYS if (span := parse_start(tags.get(key))) is not None), None)
        if span is not None:
            started[ObjectKey("relation" if is_relation else "way", own_id(identifier))] = span
        is_gone = any(key in tags for key in _GONE_KEYS)
        if (is_gone or any(key in tags for key in _CONSTRUCTION_KEYS)) and (wkb := _wkb(item)) is not None:
            (gone if is_gone else rising).append(wkb)
    _add_outer_dates(path, started)
    for item, _, _ in _tagged(path, osmium.filter.TagFilter(*_CONSTRUCTION)):
        if (wkb := _wkb(item)) is not None:
            rising.append(wkb)
    return Lifecycle(gone=_places(gone, epsg), rising=_places(rising, epsg), started=started)


def _tagged(path: Path, keyed: osmium.BaseFilter) -> Iterator[tuple[Any, bool, int]]:
    """Yield open ways and areas that pass a filter, which runs in C++; a closed way comes as its area alone."""
    processor = osmium.FileProcessor(str(path)).with_locations().with_areas(keyed)
    kinds = osmium.filter.EntityFilter(osmium.osm.WAY | osmium.osm.AREA)
    for item in elements(processor.with_filter(kinds).with_filter(keyed)):
        if item.is_area():
            yield item, not item.from_way(), item.orig_id()
        elif not item.is_closed():
            yield item, False, item.id


def _add_outer_dates(path: Path, started: dict[ObjectKey, Span]) -> None:
    """Date multipolygons of the old style by their outer ways, which hold their tags."""
    keys, typed = kind_keys(load_taxonomy().keys), osmium.filter.KeyFilter("type")
    relations = osmium.FileProcessor(str(path), osmium.osm.RELATION).with_filter(typed)
    for item in elements(relations) if started else ():
        relation = area_relation(item, lambda _: (), keys)
        ways = [ObjectKey("way", own_id(ref)) for ref in (() if relation is None else relation.outer)]
        spans = [started[way] for way in ways if way in started]
        if spans:
            started.setdefault(ObjectKey("relation", own_id(item.id)), spans[0])


def _wkb(item: Any) -> bytes | None:  # noqa: ANN401
    if not item.is_area():
        return line_wkb(item, Tally())
    try:
        return bytes.fromhex(_FACTORY.create_multipolygon(item))
    except RuntimeError:  # osmium's geometry_error: the rings were too broken to assemble
        return None


def _places(wkb: list[bytes], epsg: int) -> NDArray[np.object_]:
    places = project(shapely.from_wkb(np.array(wkb, dtype=object)), epsg)
    return np.asarray(shapely.make_valid(places), dtype=object)


def parse_start(text: str | None) -> Span | None:
    """Parse a `start_date` tag into the days that it may mean; None if it cannot be understood.

    It reads "2015", "2015-06", "2015-06-12", "1990s", "C19", "before 1950", and "~2015" (two years either way).

    >>> [str(day) for day in parse_start("2015-06")]
    ['2015-06-01', '2015-06-30']
    >>> [str(day) for day in parse_start("before 1950")]
    ['0001-01-01', '1950-12-31']
    >>> parse_start("when grandfather was young") is None
    True
    """
    words = (text or "").strip().lower()
    is_before = words.startswith("before ")
    slack = 2 if words.startswith(("~", "ca ", "c. ", "circa ")) else 0
    core = re.sub(r"^(before |~|ca |c\. |circa )\s*", "", words)
    span = _span(core)
    if span is None:
        return None
    first = dt.date.min if is_before else _moved(span.first, -slack)
    return Span(first, _moved(span.last, slack))


def _span(text: str) -> Span | None:
    if match := _CENTURY.fullmatch(text):
        return _years(100 * int(match[1]) - 99, 100 * int(match[1]))
    if match := _DECADE.fullmatch(text):
        return _years(int(match[1]), int(match[1]) + 9)
    match = _DAY.fullmatch(text)
    if match is None:
        return None
    if match[2] is None:
        return _years(int(match[1]), int(match[1]))
    return _within_a_year(int(match[1]), int(match[2]), int(match[3]) if match[3] else None)


def _within_a_year(year: int, month: int, day: int | None) -> Span | None:
    try:
        if day is not None:
            return Span(dt.date(year, month, day), dt.date(year, month, day))
        following = dt.date(year + month // 12, month % 12 + 1, 1)
        return Span(dt.date(year, month, 1), following - dt.timedelta(days=1))
    except ValueError:  # a thirteenth month, a thirtieth of February
        return None


def _years(first: int, last: int) -> Span | None:
    if not 1 <= first <= last <= dt.MAXYEAR:
        return None
    return Span(dt.date(first, 1, 1), dt.date(last, 12, 31))


def _moved(day: dt.date, years: int) -> dt.date:
    """Return the same day some years later; the 28th replaces a 29th of February that does not exist."""
    year = min(max(day.year + years, dt.MINYEAR), dt.MAXYEAR)
    return dt.date(year, day.month, min(day.day, 28)) if years else day


MARGIN_M: Final = CLOSE_M / 2  # an estimated coverage reaches this far beyond the edge of the cut
_LEAST_STATES: Final = 2
_NAMED_DATE: Final = re.compile(r"(?<!\d)(\d{4}-\d{2}-\d{2})(?!\d)")


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

    Full histories are cut at every date of `at`. Without a full history, `at` dates the files in their order; if it is
    empty, a file is dated by its header, else by the last YYYY-MM-DD in its name, else by its newest element.

    Raise `ConfigError` if the dates do not fit the files, two states have one date, or there are fewer than two states,
    and `ExtractError` if a file is missing, damaged or has no date.

    >>> date_extracts([Path("nowhere.osm.pbf")])
    Traceback (most recent call last):
        ...
    sasgeo_bench.core.errors.ExtractError: no extract at nowhere.osm.pbf: check the path
    """
    histories = [path for path in paths if is_history(path)]
    if histories:
        if not at:
            raise ConfigError(f"{histories[0].name} is a full history: give the dates to cut it at with --at")
        dated = [DatedExtract(path=path, on=day) for path in histories for day in at]
        dated += [DatedExtract(path=path, on=_own_date(path)) for path in paths if path not in histories]
    elif at:
        if len(at) != len(paths):
            raise ConfigError(
                f"--at dates the extracts in their order: got {len(at)} for {len(paths)} extracts, give one each"
            )
        dated = [DatedExtract(path=path, on=day) for path, day in zip(paths, at, strict=True)]
    else:
        dated = [DatedExtract(path=path, on=_own_date(path)) for path in paths]
    return _checked(dated)


def _checked(dated: Sequence[DatedExtract]) -> tuple[DatedExtract, ...]:
    if len(dated) < _LEAST_STATES:
        raise ConfigError(
            f"ageing needs at least {_LEAST_STATES} dated states, got {len(dated)}: name another with --extract"
        )
    twice = [day for day, count in Counter(item.on for item in dated).items() if count > 1]
    if twice:
        names = ", ".join(sorted(item.path.name for item in dated if item.on == twice[0]))
        raise ConfigError(f"two states have the date {twice[0]} ({names}): leave one out, or date them with --at")
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
    if newest is None or newest.year <= 1970:  # osmium returns 1970 if a file has no times
        raise ExtractError(
            f"{path.name} does not say what day it is of: date it with --at, or put YYYY-MM-DD into its name"
        )
    return dt.date(newest.year, newest.month, newest.day)


def read_history(
    dated: Sequence[DatedExtract],
    *,
    bounds: Box | None = None,
    margin_m: float = MARGIN_M,
) -> History:
    """Read dated extracts over the area that all of them map, in a UTM zone, with a line about each.

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
    # 0.01 degrees: spacing of corners: a box's straight sides in degrees bend when projected
    area = project(shapely.segmentize(shapely.box(*frame), 0.01), epsg)
    for item in dated:
        with _one_state(item) as plain:
            reading = read_extract(plain, grid, at=item.on)
            with open_snapshot(plain) as snapshot:
                lifecycle = read_lifecycle(snapshot.path, epsg=epsg)
        area = shapely.intersection(area, _inner(reading, grid, margin_m=0.0 if is_one_file else margin_m))
        # The sea is not a mapped object: its changes are those of the coastline.
        objects = reading.features[(reading.features["osm_type"] != SEA).to_numpy()]
        states.append(State(source=item.path.name, on=item.on, features=objects, lifecycle=lifecycle))
        tell(_line(item, reading))
    if shapely.area(area) <= 0:
        raise CoverageError(
            f"the extracts map no area in common that lies {margin_m:g} m within their estimated edges: "
            "choose extracts of one place, other --bounds, or a smaller --margin-m"
        )
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
    with scratch_folder("map") as scratch:
        cut = scratch / f"{item.path.name.split('.')[0]}-at-{item.on}.osm.pbf"
        with open_snapshot(item.path, at=item.on) as snapshot:
            copyfile(snapshot.path, cut)
        yield cut


def _frame(path: Path) -> Box:
    """Return the box of a file's header, else of its nodes, degrees."""
    boxes = read_header(path).boxes_lonlat
    if boxes:
        west, south, east, north = shapely.total_bounds([shapely.box(*box) for box in boxes]).tolist()
        return (west, south, east, north)
    with open_snapshot(path, at=dt.date.max if is_history(path) else None) as snapshot:
        nodes = elements(osmium.FileProcessor(str(snapshot.path), osmium.osm.NODE))
        places = np.array([(node.lon, node.lat) for node in nodes if node.location.valid()]).reshape(-1, 2)
    if len(places) == 0:
        raise CoverageError(f"{path.name} holds no node: is it an extract of map data?")
    low, high = places.min(axis=0), places.max(axis=0)
    return (float(low[0]), float(low[1]), float(high[0]), float(high[1]))


def _common_frame(boxes: dict[Path, Box], bounds: Box | None) -> Box:
    frame = (-180.0, -90.0, 180.0, 90.0) if bounds is None else bounds
    for path, box in boxes.items():
        frame = (max(frame[0], box[0]), max(frame[1], box[1]), min(frame[2], box[2]), min(frame[3], box[3]))
        if not (frame[0] < frame[2] and frame[1] < frame[3]):
            what = "the bounds" if bounds is not None and len(boxes) == 1 else "the other extracts or the bounds"
            raise CoverageError(
                f"{path.name} covers {box_text(box)} (west, south, east, north) and has nothing in common with {what}"
            )
    return frame


def _grid_around(frame: Box, epsg: int) -> Grid:
    west_m, south_m, east_m, north_m = from_lonlat(epsg).transform_bounds(*frame, densify_pts=21)
    # 10 m: cell of the grid that frames the reading; nothing is burnt into it
    return Grid.from_bounds(west_m, south_m, east_m, north_m, cell_size_m=10.0, epsg=epsg)
