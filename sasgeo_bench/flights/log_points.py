# SPDX-License-Identifier: Apache-2.0
"""Points of a flight log as its file gives them, and what is refused of them; the readers of all formats use it."""

import datetime as dt
import io
import math
import re
import warnings
import zipfile
import zlib
from array import array
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from types import MappingProxyType
from typing import Final, Literal, Self
from xml.etree.ElementTree import Element, ParseError

import numpy as np
import pyproj
from defusedxml import DefusedXmlException  # type: ignore[import-untyped]
from defusedxml.ElementTree import iterparse  # type: ignore[import-untyped]
from numpy.typing import NDArray

from sasgeo_bench.core.errors import FlightError, counted
from sasgeo_bench.core.paths import plain_file
from sasgeo_bench.core.texts import message_of, plain
from sasgeo_bench.flights.leap_seconds import is_date
from sasgeo_bench.flights.log_units import FASTEST_MPS, HIGHEST_M

Floats = NDArray[np.float64]
# What an altitude counts from: the geoid, which is the sea; the ellipsoid of WGS 84; or what the file does not say.
AltitudeOf = Literal["geoid", "ellipsoid", "unknown"]

MOST_BYTES: Final = 256 * 2**20  # of text, where a million points with names and speeds take 200 MB
MOST_POINTS: Final = 1_000_000
BEFORE_FIX: Final = "at 0, 0 before the first fix"

_HIGHEST_ALTITUDE_M: Final = HIGHEST_M + 9_000.0  # above the highest ground
_MOST_SHOWN: Final = 40  # characters of a text out of a file
_ANGLES: Final = {"yaw_deg": 360.0, "pitch_deg": 90.0, "roll_deg": 180.0}
_MOST_NAMES: Final = 12  # in a message
_SPACED_ZONE: Final = re.compile(r"\s+(?=[-+]\d\d(?::?\d\d)?$)")  # ISO 8601 has no space before it
_WGS84: Final = pyproj.Geod(ellps="WGS84")


@dataclass(frozen=True, slots=True, kw_only=True)
class LogSource:
    """A log's file, and what its points are counted by: lines of a table, or points of a track."""

    path: Path
    unit: str = "point"

    def fault(self, text: str, number: int | None = None) -> FlightError:
        """Return the error of a line or point, or of the file."""
        name = self.path.name or str(self.path)
        where = name if number is None else f"{name}, {self.unit} {number}"
        return FlightError(f"{where}: {text}")

    def warn(self, text: str) -> None:
        """Warn of what is not read of the file."""
        warnings.warn(f"{plain(self.path.name)}: {text}", stacklevel=2)

    def number(self, text: str | None, name: str, number: int) -> float:
        """Return a finite number out of the file; raise `FlightError` for anything else."""
        try:
            value = float(text or "nan")
        except ValueError:
            value = math.nan
        # a number beyond is a fault; times in ns are 2e18
        if abs(value) < 1e30 and "_" not in (text or ""):
            return value
        if text is None or not text.strip():
            message = f"{name} is missing: complete the point, or delete it"
        else:
            message = f"{name} is no number, {shown(text)}: mend the value (decimals with a point), or delete the point"
        raise self.fault(message, number)

    def moment(self, text: str | None, number: int) -> float:
        """Return a time as ISO 8601 has it, in seconds since 1970; one without a zone is UTC."""
        try:
            moment = dt.datetime.fromisoformat(_SPACED_ZONE.sub("", (text or "").strip()))
        except ValueError as error:
            message = f"time is no date and time like 2025-05-01T10:00:00Z, {shown(text or '')}: mend it"
            raise self.fault(message, number) from error
        return (moment if moment.tzinfo else moment.replace(tzinfo=dt.UTC)).timestamp()

    def check_size(self, most: int | None = None) -> None:
        """Raise `FlightError` if there is no such file, or if it is larger than so many bytes (256 MiB)."""
        if not self.path.is_file():
            raise FlightError(f"there is no flight log {self.path}: check the path")
        size = self.path.stat().st_size
        most = MOST_BYTES if most is None else most
        if not size:
            raise self.fault("empty: copy it anew, or export more")
        if size > most:
            raise self.fault(f"{size} bytes, at most {most} are read: cut the log first")

    def check_count(self, count: int) -> None:
        """Raise `FlightError` for more points than are read."""
        if count > MOST_POINTS:
            raise self.fault(f"more than {MOST_POINTS} points: cut the log, or thin it out, first")


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class FlightLog:
    """N points of a flight, two at least, in order; None for what the file does not have.

    Parameters
    ----------
    lon_deg, lat_deg : ndarray, shape (N,)
        WGS 84, degrees.
    time_s : ndarray, shape (N,), optional
        Seconds since `start_s`, strictly increasing.
    start_s : float, optional
        Seconds since 1970, UTC, at `time_s` 0; None where the file does not say its zone.
    clock_s : float, optional
        Seconds of the log's own clock at `time_s` 0, which its other messages count by; None where it has no other.
    height_m : ndarray, shape (N,), optional
        Height above the ground or the place of take-off, metres; never one above the sea.
    altitude_m : ndarray, shape (N,), optional
        Altitude, metres.
    altitude_of : {"geoid", "ellipsoid", "unknown"}
        What the altitude counts from: the geoid (the sea), the ellipsoid of WGS 84, or what the file does not say.
    yaw_deg, pitch_deg, roll_deg : ndarray, shape (N,), optional
        Attitude of the body, degrees, yaw from true north; in the order of angles of `sensing.camera.Attitude`.
    notes : tuple of str
        What was read of which column of a table, in which unit; and what of the file was not read.
    """

    lon_deg: Floats
    lat_deg: Floats
    time_s: Floats | None = None
    start_s: float | None = None
    clock_s: float | None = None
    height_m: Floats | None = None
    altitude_m: Floats | None = None
    altitude_of: AltitudeOf = "unknown"
    yaw_deg: Floats | None = None
    pitch_deg: Floats | None = None
    roll_deg: Floats | None = None
    notes: tuple[str, ...] = ()

    @classmethod
    def of(
        cls,
        source: LogSource,
        numbers: Sequence[int],
        columns: Mapping[str, Floats],
        *,
        start_s: float | None = None,
        altitude_of: AltitudeOf = "unknown",
        notes: tuple[str, ...] = (),
        names: Mapping[str, str] = MappingProxyType({}),
    ) -> Self:
        """Return a log of checked columns; `numbers` are the lines or points in the file, for messages.

        `names` tell, for messages too, what the file calls a column, and in which unit.

        Points at 0, 0 before the first fix are left out, and so are points that repeat the time of the point before, or
        its place where there are no times. A warning counts them, and tells of a start that is no date since GPS.

        Raises
        ------
        FlightError
            If fewer than two points are left, a place is none on Earth or 0, 0 (no fix), time goes back, the flight is
            faster than 100 m/s, or a height or an angle is out of range.
        """
        # Index of the first point that is not at 0, 0, and warn of those before; 0 if there is none
        lon_deg = columns["lon_deg"]
        start = int(np.argmax((lon_deg != 0) | (columns["lat_deg"] != 0))) if len(lon_deg) else 0
        if start:
            tell_left_out(source, start, BEFORE_FIX)
        numbers, columns = numbers[start:], {name: column[start:] for name, column in columns.items()}
        _check_places(source, numbers, columns)
        is_new = np.append(True, _gained(columns) != 0)[: len(numbers)]
        if not is_new.all():
            same = "time" if "time_s" in columns else "place"
            tell_left_out(source, int((~is_new).sum()), f"with the {same} of the point before")
            numbers, columns = np.asarray(numbers)[is_new], {name: column[is_new] for name, column in columns.items()}
        if len(numbers) < 2:  # a way
            raise source.fault(f"a flight has two points at least, the log has {len(numbers)}: export more of it")
        _check_times(source, numbers, columns)
        for name, most in {**_ANGLES, "height_m": HIGHEST_M, "altitude_m": _HIGHEST_ALTITUDE_M}.items():
            if name in columns:
                _check_size(source, numbers, columns[name], name, most, names.get(name, name.partition("_")[0]))
        if start_s is not None and not is_date(start_s):
            source.warn("its clock was not set, as it tells no date from 1980 to 2038: UTC is not known")
            start_s = None
        return cls(
            lon_deg=columns["lon_deg"],
            lat_deg=columns["lat_deg"],
            **{name: columns.get(name) for name in ("time_s", "height_m", "altitude_m", *_ANGLES)},
            start_s=start_s,
            clock_s=None,
            altitude_of=altitude_of,
            notes=notes,
        )

    def __len__(self) -> int:
        return len(self.lon_deg)


def steps_m(lon_deg: Floats, lat_deg: Floats) -> Floats:
    """Return the distances between successive points on the ellipsoid, shape (N - 1,), metres."""
    return np.asarray(_WGS84.inv(lon_deg[:-1], lat_deg[:-1], lon_deg[1:], lat_deg[1:])[2])


def shown(text: str) -> str:
    r"""Return a text out of a file as messages quote it: short, and without controls.

    >>> shown("12,5\x1b[31m")
    "'12,5?[31m'"
    """
    line = plain(text.strip())
    return repr(line if len(line) <= _MOST_SHOWN else line[: _MOST_SHOWN - 3] + "...")


def altitude_note(altitude_of: AltitudeOf) -> str:
    """Return the line on what altitudes count from.

    >>> altitude_note("geoid")
    'altitude: above the geoid (the sea), no height above the ground'
    """
    base = {
        "geoid": "above the geoid (the sea)",
        "ellipsoid": "above the ellipsoid of WGS 84",
        "unknown": "of a reference that the file does not name",
    }[altitude_of]
    return f"altitude: {base}, no height above the ground"


def has_offset(text: str) -> bool:
    """Return whether a time in ISO 8601 names its zone.

    >>> [has_offset(text) for text in ("2025-05-01T10:00:00Z", "2025-05-01T10:00:00+02:00", "2025-05-01T10:00:00")]
    [True, True, False]
    """
    try:
        return dt.datetime.fromisoformat(text.strip()).tzinfo is not None
    except ValueError:
        return False


def listed(names: Sequence[str]) -> str:
    """Return names as messages list them: the first twelve."""
    more = f", and {len(names) - _MOST_NAMES} more" if len(names) > _MOST_NAMES else ""
    return ", ".join(shown(name) for name in names[:_MOST_NAMES]) + more


def _check(
    source: LogSource,
    numbers: Sequence[int],
    is_right: NDArray[np.bool_],
    text: str | Callable[[int], str],
    *,
    later: int = 0,
) -> None:
    """Raise the error of the first point that is not right; `later` is 1 where rows are steps from point to point."""
    wrong = np.flatnonzero(~is_right)
    if len(wrong):
        at = int(wrong[0])
        raise source.fault(text if isinstance(text, str) else text(at), numbers[at + later])


def _check_size(source: LogSource, numbers: Sequence[int], values: Floats, name: str, most: float, called: str) -> None:
    unit = "degrees" if name in _ANGLES else "m"
    text = "{} is {:g} {}, beyond {:g}: mend the value, or its unit"
    _check(source, numbers, np.abs(values) <= most, lambda at: text.format(called, values[at], unit, most))


def _check_places(source: LogSource, numbers: Sequence[int], columns: Mapping[str, Floats]) -> None:
    lon, lat = columns["lon_deg"], columns["lat_deg"]
    _check(
        source,
        numbers,
        (np.abs(lon) <= 180) & (np.abs(lat) <= 90),  # the globe
        lambda at: (
            f"latitude {lat[at]:.9g}, longitude {lon[at]:.9g} are no degrees on Earth (-90 to 90, -180 to 180): mend "
            "them, or delete the point"
        ),
    )
    text = "latitude and longitude are 0, which is no fix: delete the points without a fix"
    _check(source, numbers, (lon != 0) | (lat != 0), text)


def _check_times(source: LogSource, numbers: Sequence[int], columns: Mapping[str, Floats]) -> None:
    if "time_s" not in columns:
        return
    gained_s = _gained(columns)
    back = "time goes back by {:g} s: sort the points, or keep one flight"
    _check(source, numbers, gained_s > 0, lambda at: back.format(-gained_s[at]), later=1)
    speed_mps = steps_m(columns["lon_deg"], columns["lat_deg"]) / gained_s
    text = "moves at {:.0f} m/s since the point before, {:g} at most: delete points that jump, check the unit of time"
    _check(source, numbers, speed_mps <= FASTEST_MPS, lambda at: text.format(speed_mps[at], FASTEST_MPS), later=1)


def _gained(columns: Mapping[str, Floats]) -> Floats:
    """Return what is new from point to point, seconds, or metres where there are no times."""
    return np.diff(columns["time_s"]) if "time_s" in columns else steps_m(columns["lon_deg"], columns["lat_deg"])


def tell_left_out(source: LogSource, count: int, which: str) -> None:
    """Warn of points that are left out."""
    source.warn(f"left out {counted(count, 'point')} {which}")


_POINTS: Final = ("trkpt", "rtept")  # of a track and of a route
_DEEPEST: Final = 64  # elements in each other
_MOST_ELEMENTS: Final = 10_000_000  # of a file: others than tracks take the time of a million points at most
_LONG_TAG: Final = re.compile(rb"<[^<>]{100000}")  # attributes without end take minutes
# Modes of KML's altitudes; the others are of the sea's floor, or of none.
_ABOVE_GROUND: Final = "relativeToGround"
_ABOVE_SEA: Final = "absolute"  # "vertical datum, i.e. WGS84 EGM96 geoid" (OGC KML 2.3)


@dataclass(frozen=True, slots=True, kw_only=True)
class _Track:
    """What was read of a file so far."""

    source: LogSource
    lon_deg: "array[float]" = field(default_factory=lambda: array("d"))
    lat_deg: "array[float]" = field(default_factory=lambda: array("d"))
    moments: "array[float]" = field(default_factory=lambda: array("d"))
    heights_m: "array[float]" = field(default_factory=lambda: array("d"))
    altitudes_m: "array[float]" = field(default_factory=lambda: array("d"))
    unread: list[str] = field(default_factory=list)

    def log(self, *, altitude_of: AltitudeOf, has_zone: bool = True) -> FlightLog:
        """Return the log; times are of all points or of none, and so are altitudes."""
        count = len(self)
        if self.moments and len(self.moments) != count:
            raise self.source.fault(f"{len(self.moments)} of {count} points have a time: give each one, or none")
        columns = {"lon_deg": np.array(self.lon_deg), "lat_deg": np.array(self.lat_deg)}
        if self.moments:
            columns["time_s"] = (np.array(self.moments) - self.moments[0]).round(6)
        if self.heights_m:
            columns["height_m"] = np.array(self.heights_m)
        if self.altitudes_m:
            altitude_m = np.array(self.altitudes_m)
            if len(altitude_m) == count and np.isfinite(altitude_m).all():
                columns["altitude_m"] = altitude_m
            else:
                self.leave("altitudes, which are not those of all points")
        notes = (altitude_note(altitude_of),) if "altitude_m" in columns else ()
        return FlightLog.of(
            self.source,
            range(1, count + 1),
            columns,
            start_s=self.moments[0] if self.moments and has_zone else None,
            altitude_of=altitude_of,
            notes=(*notes, *((f"not read: {', '.join(self.unread)}",) if self.unread else ())),
        )

    def leave(self, what: str) -> None:
        """Note what is not read, once."""
        if what not in self.unread:
            self.unread.append(what)

    def __len__(self) -> int:
        return len(self.lat_deg)


def read_gpx(path: Path) -> FlightLog:
    """Read the track of a GPX file, or its route where it has no track; raise `FlightError` if it is not sound.

    Segments of the track follow each other. Times are UTC, as GPX has them. Elevations are altitudes: the format does
    not say from which sea, and phones write both.
    """
    track, route = _Track(source=LogSource(path=path)), _Track(source=LogSource(path=path))
    counts = Counter[str]()
    lines = dict(zip(_POINTS, (track, route), strict=True))
    for event, element, name, parent in _elements(track.source):
        if event == "start":
            if name in lines:
                _add_place(lines[name], (element.get("lon"), element.get("lat")))
            else:
                counts[name] += 1
        elif parent in lines:
            if name == "time":
                _add_time(lines[parent], element.text)
            elif name == "ele":
                _add_altitude(lines[parent], element.text)
    kind, read = ("trk", track) if len(track) or not len(route) else ("rte", route)
    if not len(read):
        raise track.source.fault("holds no track or route: export that of the flight, or name the file by what it is")
    if counts[kind] > 1:
        raise track.source.fault(f"more than one {'track' if kind == 'trk' else 'route'}: keep the one that is meant")
    return read.log(altitude_of="unknown")


def read_kml(path: Path) -> FlightLog:
    """Read the one line or track of a KML file or of a KMZ's; raise `FlightError` if it is not sound.

    A `LineString` has no times, a `gx:Track` has. Altitudes are heights where they are relative to the ground, and
    count from the geoid where they are absolute; others are not read, nor are angles.
    """
    source = LogSource(path=path)
    lines: list[_Track] = []
    has_zone = True
    opened = ""  # times and places of other elements are not of the line
    texts: dict[str, str] = {}
    for event, element, name, parent in _elements(source):
        text = element.text or ""
        if event == "start":
            if name in ("LineString", "Track"):
                lines.append(_Track(source=source))
                opened, texts = name, {}
        elif not opened:
            continue
        elif parent == opened and name in ("altitudeMode", "coordinates"):
            texts[name] = text
        elif parent == opened and name in ("when", "coord"):
            has_zone &= name != "when" or has_offset(text)
            _add(lines[-1], name, text)
        elif parent == opened and name == "angles":
            lines[-1].leave("angles")
        elif name == opened:
            _close(lines[-1], texts.get("coordinates", ""), texts.get("altitudeMode", "").strip())
            opened = ""
    if len(lines) != 1:
        none = "holds no line or track: export that of the flight, or name the file by what it is"
        several = f"{len(lines)} lines or tracks, one is read: keep the one that is meant"
        raise source.fault(several if lines else none)
    return lines[0].log(altitude_of="geoid", has_zone=has_zone)


def _add(line: _Track, name: str, text: str) -> None:
    """Add a time or a place of a gx:Track, which lists all of the one kind before the other."""
    if name == "when":
        _add_time(line, text)
    else:
        _add_place(line, text.split())


def _close(line: _Track, coordinates: str, mode: str) -> None:
    """Read the points of a LineString; keep heights if all points have one, above the ground or the sea."""
    for place in coordinates.split():
        _add_place(line, place.split(","))
    if mode != _ABOVE_GROUND or len(line.heights_m) != len(line):
        if mode == _ABOVE_SEA:
            line.altitudes_m.extend(line.heights_m)
        elif line.heights_m:
            why = "not those of all points" if mode == _ABOVE_GROUND else "neither relative to the ground nor absolute"
            line.leave(f"altitudes, which are {why}")
        del line.heights_m[:]


def _add_time(line: _Track, text: str | None) -> None:
    number = len(line.moments) + 1
    if number > MOST_POINTS:
        line.source.check_count(number)
    line.moments.append(line.source.moment(text, number))


def _add_altitude(line: _Track, text: str | None) -> None:
    """Add the altitude of the point that is open; one that is no number is none of that point."""
    try:
        line.altitudes_m.append(float(text or "nan"))
    except ValueError:
        line.altitudes_m.append(math.nan)


def _add_place(line: _Track, parts: Sequence[str | None]) -> None:
    number = len(line) + 1
    if number > MOST_POINTS:
        line.source.check_count(number)
    if len(parts) not in (2, 3):
        message = f"{shown(' '.join(map(str, parts)))} is no longitude, latitude and altitude: mend the coordinates"
        raise line.source.fault(message, number)
    line.lon_deg.append(line.source.number(parts[0], "longitude", number))
    line.lat_deg.append(line.source.number(parts[1], "latitude", number))
    if len(parts) > 2:  # with a height
        line.heights_m.append(line.source.number(parts[2], "altitude", number))


def _elements(source: LogSource) -> Iterator[tuple[str, Element, str, str]]:
    """Yield elements, with their names and those of what they stand in, as they begin and end; keep none in memory."""
    # Refuse document types and entities, what is larger or nests deeper than any track, and what is no XML.
    open_ones: list[tuple[Element, str]] = []
    parent = ""
    names: dict[str, str] = {}  # of tags, without their namespaces
    count = 0
    try:
        for event, element in iterparse(io.BytesIO(_content(source)), events=("start", "end"), forbid_dtd=True):
            if event == "start":
                tag = element.tag
                name = names.get(tag) or names.setdefault(tag, tag.rpartition("}")[2])
                yield event, element, name, parent
                open_ones.append((element, name))
                parent = name
                count += 1
                if len(open_ones) > _DEEPEST or count > _MOST_ELEMENTS:
                    raise source.fault(
                        f"more than {_MOST_ELEMENTS} elements, or {_DEEPEST} in each other: keep the track alone"
                    )
                continue
            _, name = open_ones.pop()
            parent = open_ones[-1][1] if open_ones else ""
            yield event, element, name, parent
            if open_ones:
                open_ones[-1][0].remove(element)
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
    if source.path.suffix.lower() == ".kmz":
        content = _unzipped(source, content)
    if _LONG_TAG.search(content):
        raise source.fault("a tag has more than 100000 characters: export it anew")
    return content


def _unzipped(source: LogSource, content: bytes) -> bytes:
    """Return the KML of a KMZ: the first in its root (OGC KML 2.3, annex C), of `MOST_BYTES` at most."""
    try:
        with zipfile.ZipFile(io.BytesIO(content)) as archive:
            names = [name for name in archive.namelist() if name.lower().endswith(".kml") and "/" not in name]
            if not names:
                raise source.fault("holds no KML in its root: export it anew")
            with archive.open(names[0]) as file:
                unzipped = file.read(MOST_BYTES + 1)
    except (zipfile.BadZipFile, NotImplementedError, RuntimeError, EOFError, OSError, zlib.error) as error:
        raise source.fault(f"no sound KMZ ({message_of(error)}): export it anew") from error
    if len(unzipped) > MOST_BYTES:
        raise source.fault(f"more than {MOST_BYTES} bytes unpacked: keep the track alone")
    return unzipped
