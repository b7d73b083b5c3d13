# SPDX-License-Identifier: Apache-2.0
"""Lifecycle tags of an extract: what is being built, what is gone, and when something was begun."""

import datetime as dt
import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np
import osmium
import shapely
from numpy.typing import NDArray

from sasgeo_bench.osm.mapped import project
from sasgeo_bench.osm.scan import Tally, line_wkb
from sasgeo_bench.osm.snapshot import elements

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
            started[ObjectKey("relation" if is_relation else "way", identifier)] = span
        is_gone = any(key in tags for key in _GONE_KEYS)
        if (is_gone or any(key in tags for key in _CONSTRUCTION_KEYS)) and (wkb := _wkb(item)) is not None:
            (gone if is_gone else rising).append(wkb)
    for item, _, _ in _tagged(path, osmium.filter.TagFilter(*_CONSTRUCTION)):
        if (wkb := _wkb(item)) is not None:
            rising.append(wkb)
    return Lifecycle(gone=_places(gone, epsg), rising=_places(rising, epsg), started=started)


def _tagged(path: Path, wanted: osmium.BaseFilter) -> Iterator[tuple[Any, bool, int]]:
    """Yield open ways and areas that pass a filter, which runs in C++; a closed way comes as its area alone."""
    processor = osmium.FileProcessor(str(path)).with_locations().with_areas(wanted)
    kinds = osmium.filter.EntityFilter(osmium.osm.WAY | osmium.osm.AREA)
    for item in elements(processor.with_filter(kinds).with_filter(wanted)):
        if item.is_area():
            yield item, not item.from_way(), item.orig_id()
        elif not item.is_closed():
            yield item, False, item.id


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
