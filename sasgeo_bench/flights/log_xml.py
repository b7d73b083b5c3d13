# SPDX-License-Identifier: Apache-2.0
"""GPX and KML: one track of a file, without document types or entities, point by point."""

import io
import re
from array import array
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final
from xml.etree.ElementTree import Element, ParseError

import numpy as np
from defusedxml import DefusedXmlException  # type: ignore[import-untyped]
from defusedxml.ElementTree import iterparse  # type: ignore[import-untyped]

from sasgeo_bench.errors import FlightError
from sasgeo_bench.files.paths import plain_file
from sasgeo_bench.flights.log_points import FlightLog, LogSource, shown
from sasgeo_bench.texts import message_of

_POINTS: Final = ("trkpt", "rtept")  # of a track and of a route
_DEEPEST: Final = 64  # elements in each other
_MOST_ELEMENTS: Final = 3_000_000  # of a file: others than tracks take the time of a million points at most
_LONG_TAG: Final = re.compile(rb"<[^<>]{100000}")  # attributes without end take minutes
_ABOVE_GROUND: Final = "relativeToGround"  # of KML's altitudes; the others count from the sea, or are none


@dataclass(frozen=True, slots=True, kw_only=True)
class _Track:
    """What was read of a file so far."""

    source: LogSource
    lon_deg: "array[float]" = field(default_factory=lambda: array("d"))
    lat_deg: "array[float]" = field(default_factory=lambda: array("d"))
    moments: "array[float]" = field(default_factory=lambda: array("d"))
    heights_m: "array[float]" = field(default_factory=lambda: array("d"))
    unread: list[str] = field(default_factory=list)

    def log(self) -> FlightLog:
        """Return the log; times are of all points or of none."""
        count = len(self)
        if self.moments and len(self.moments) != count:
            raise self.source.fault(f"{len(self.moments)} of {count} points have a time: give each one, or none")
        columns = {"lon_deg": np.array(self.lon_deg), "lat_deg": np.array(self.lat_deg)}
        if self.moments:
            columns["time_s"] = (np.array(self.moments) - self.moments[0]).round(6)
        if self.heights_m:
            columns["height_m"] = np.array(self.heights_m)
        told = (f"not read: {', '.join(self.unread)}",) if self.unread else ()
        return FlightLog.of(self.source, range(1, count + 1), columns, told=told)

    def leave(self, what: str) -> None:
        """Note what is not read, once."""
        if what not in self.unread:
            self.unread.append(what)

    def __len__(self) -> int:
        return len(self.lat_deg)


def read_gpx(path: Path) -> FlightLog:
    """Read the track of a GPX file, or its route where it has no track; raise `FlightError` if it is not sound.

    Segments of the track follow each other. Elevations are above the sea, and are not read.
    """
    track, route = _Track(source=LogSource(path=path)), _Track(source=LogSource(path=path))
    counts = Counter[str]()
    for event, element, parent in _elements(track.source):
        name = _name(element)
        counts[name] += event == "start" and name in ("trk", "rte")
        if event == "start" and name in _POINTS:
            _add_place(track if name == _POINTS[0] else route, [element.get("lon"), element.get("lat")])
        elif event == "end" and name == "time" and parent in _POINTS:
            _add_time(track if parent == _POINTS[0] else route, element.text)
        elif event == "end" and name == "ele" and parent in _POINTS:
            (track if parent == _POINTS[0] else route).leave("elevations, which are above the sea")
    kind, read = ("trk", track) if len(track) or not len(route) else ("rte", route)
    if counts[kind] > 1:
        raise track.source.fault(f"more than one {'track' if kind == 'trk' else 'route'}: keep the one that is meant")
    return read.log()


def read_kml(path: Path) -> FlightLog:
    """Read the one line or track of a KML file; raise `FlightError` if it is not sound.

    A `LineString` has no times, a `gx:Track` has. Altitudes are heights where they are relative to the ground; others
    are not read, nor are angles.
    """
    source = LogSource(path=path)
    lines: list[_Track] = []
    opened = ""  # times and places of other elements are not of the line
    texts: dict[str, str] = {}
    for event, element, parent in _elements(source):
        name, text = _name(element), element.text or ""
        if event == "start":
            if name in ("LineString", "Track"):
                lines.append(_Track(source=source))
                opened, texts = name, {}
        elif not opened:
            continue
        elif parent == opened and name in ("altitudeMode", "coordinates"):
            texts[name] = text
        elif parent == opened and name in ("when", "coord"):
            _add(lines[-1], name, text)
        elif parent == opened and name == "angles":
            lines[-1].leave("angles")
        elif name == opened:
            _close(lines[-1], texts.get("coordinates", ""), texts.get("altitudeMode", "").strip())
            opened = ""
    if len(lines) != 1:
        raise source.fault(f"{len(lines)} lines or tracks, one is read: keep the one that is meant")
    return lines[0].log()


def _add(line: _Track, name: str, text: str) -> None:
    """Add a time or a place of a gx:Track, which lists all of the one kind before the other."""
    if name == "when":
        _add_time(line, text)
    else:
        _add_place(line, text.split())


def _close(line: _Track, coordinates: str, mode: str) -> None:
    """Read the points of a LineString; keep heights if all points have one, above the ground."""
    for place in coordinates.split():
        _add_place(line, place.split(","))
    if mode != _ABOVE_GROUND or len(line.heights_m) != len(line):
        if line.heights_m:
            why = "not relative to the ground" if mode != _ABOVE_GROUND else "not those of all points"
            line.leave(f"altitudes, which are {why}")
        del line.heights_m[:]


def _add_time(line: _Track, text: str | None) -> None:
    number = len(line.moments) + 1
    line.source.check_count(number)
    line.moments.append(line.source.moment(text, number))


def _add_place(line: _Track, parts: Sequence[str | None]) -> None:
    number = len(line) + 1
    line.source.check_count(number)
    if len(parts) not in (2, 3):
        message = f"{shown(' '.join(map(str, parts)))} is no longitude, latitude and altitude: mend the coordinates"
        raise line.source.fault(message, number)
    lon_deg, lat_deg, *height_m = (
        line.source.number(text, name, number)
        for text, name in zip(parts, ("longitude", "latitude", "altitude"), strict=False)
    )
    line.lon_deg.append(lon_deg)
    line.lat_deg.append(lat_deg)
    line.heights_m.extend(height_m)


def _elements(source: LogSource) -> Iterator[tuple[str, Element, str]]:
    """Yield elements, with the name of what they stand in, as they begin and end; keep none of them in memory."""
    # Refuse document types and entities, what is larger or nests deeper than any track, and what is no XML.
    open_ones: list[Element] = []
    count = 0
    try:
        for event, element in iterparse(io.BytesIO(_content(source)), events=("start", "end"), forbid_dtd=True):
            if event == "end":
                open_ones.pop()
            yield event, element, _name(open_ones[-1]) if open_ones else ""
            if event == "start":
                open_ones.append(element)
                count += 1
            elif open_ones:
                open_ones[-1].remove(element)
            if len(open_ones) > _DEEPEST or count > _MOST_ELEMENTS:
                raise source.fault(
                    f"more than {_MOST_ELEMENTS} elements, or {_DEEPEST} in each other: keep the track alone"
                )
    except FlightError:
        raise
    except DefusedXmlException as error:
        raise source.fault(
            "has a document type or entities, which are not read: export it anew without them"
        ) from error
    except (ParseError, ValueError, LookupError) as error:
        raise source.fault(f"no sound XML ({message_of(error)}): export it anew") from error


def _content(source: LogSource) -> bytes:
    source.check_size()
    try:
        content = plain_file(source.path).read_bytes()
    except OSError as error:
        raise source.fault(f"cannot be read ({message_of(error)}): check its rights") from error
    if _LONG_TAG.search(content):
        raise source.fault("a tag has more than 100000 characters: export it anew")
    return content


def _name(element: Element) -> str:
    """Return the name of an element without its namespace."""
    return str(element.tag).rpartition("}")[2]
