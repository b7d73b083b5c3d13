# SPDX-License-Identifier: Apache-2.0
"""CSV logs with latitude and longitude, as PX4 and ArduPilot are exported: names of columns, and rules for units.

A name is compared without its topic ("GPS." of "GPS.Lat"), in small letters, everything else than letters and digits
as "_". Names decide units; where they do not, these rules do, and what they leave open is refused:

- latitude and longitude are degrees; if all are whole numbers and one is beyond 180, they are 1e-7 degrees;
- time: dates are ISO 8601; numbers are in the one unit of s, ms, us and ns by which the flight has a mean speed of
  0.1 to 100 m/s, of which there is one at most;
- heights are metres; whole numbers of which one is beyond 10,000 are millimetres, as in MAVLink;
- angles are degrees if one is beyond 2 pi; whole numbers of which one is beyond 360 are 0.01 degrees, as in MAVLink.
"""

import csv
import math
import re
from array import array
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from types import MappingProxyType
from typing import Final

import numpy as np
from numpy.typing import NDArray

from sasgeo_bench.flights.log_points import FASTEST_MPS, FlightLog, LogSource, first_fix, shown, steps_m
from sasgeo_bench.texts import message_of

Floats = NDArray[np.float64]

_FOOT_M: Final = 0.3048
_DEG: Final = math.degrees(1.0)  # of a radian
_AXES: Final = ("yaw", "pitch", "roll")
_SLOWEST_MPS: Final = FASTEST_MPS / 1000  # a thousandth: units lie a factor of 1000 apart, so one fits at most
_TIME_UNITS: Final = (1.0, 1e-3, 1e-6, 1e-9)
_DATE: Final = re.compile(r"\d[-/.:]\d+[-/.:]\d|\dT\d")  # of a time that is no number, in any order
_MOST_NAMES: Final = 12  # of columns in a message
_HIGHEST_M: Final = 10_000.0  # whole numbers beyond are no metres

# Field -> name -> factor to s, m or degrees; None where the rules decide.
COLUMNS: Final = MappingProxyType(
    {
        "latitude": dict.fromkeys(("lat", "latitude", "lat_deg", "latitude_deg", "latitude_degrees")),
        "longitude": dict.fromkeys(
            ("lon", "lng", "long", "longitude", "lon_deg", "lng_deg", "longitude_deg", "longitude_degrees")
        ),
        "time": dict.fromkeys(("time", "timestamp", "datetime", "date_time", "datetime_utc", "utc", "gps_time"))
        | dict.fromkeys(("time_s", "timestamp_s", "time_sec", "seconds", "elapsed_s"), 1.0)
        | dict.fromkeys(("time_ms", "timems", "timestamp_ms", "time_boot_ms", "time_millisecond"), 1e-3)
        | dict.fromkeys(("time_us", "timeus", "timestamp_us", "time_usec"), 1e-6),
        "height": dict.fromkeys(("relative_alt", "rel_alt", "alt_rel", "relalt", "altituderelative", "height", "agl"))
        | dict.fromkeys(("relative_alt_m", "height_m", "height_agl_m", "height_above_takeoff_m", "agl_m"), 1.0)
        | dict.fromkeys(("relative_alt_mm",), 1e-3)
        | dict.fromkeys(("height_above_takeoff_feet", "height_ft", "agl_ft"), _FOOT_M),
        "yaw": dict.fromkeys(("yaw", "heading", "hdg", "compass_heading"))
        | dict.fromkeys(("yaw_deg", "heading_deg", "hdg_deg", "compass_heading_degrees"), 1.0)
        | dict.fromkeys(("yaw_rad", "heading_rad"), _DEG),
        **{
            axis: {axis: None, f"{axis}_deg": 1.0, f"{axis}_degrees": 1.0, f"{axis}_rad": _DEG}
            for axis in ("pitch", "roll")
        },
    }
)


@dataclass(frozen=True, slots=True, kw_only=True)
class _Column:
    """A column that is read."""

    at: int
    name: str  # as in the file
    factor: float | None
    is_date: bool = False

    def value(self, source: LogSource, field: str, row: Sequence[str], number: int) -> float:
        """Return what a line has in this column."""
        text = row[self.at]
        return source.moment(text, number) if self.is_date else source.number(text, field, number)


def read_csv(path: Path) -> FlightLog:
    r"""Read a CSV log; raise `FlightError` if it is not sound, or a column or its unit is ambiguous.

    The separator is a comma, a semicolon or a tab. Empty lines, and lines that begin with "#", are skipped. Columns
    that no name stands for, altitudes above the sea among them, are not read.

    Examples
    --------
    Integers of 1e-7 degrees, as ArduPilot logs them, and time in microseconds by its name:

    >>> import tempfile
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     path = Path(folder, "flight.csv")
    ...     _ = path.write_text("TimeUS,GPS.Lat,GPS.Lng\n5000000,471400000,95200000\n6000000,471401000,95200000\n")
    ...     log = read_csv(path)
    >>> log.lat_deg.tolist(), log.time_s.tolist()
    ([47.14, 47.1401], [0.0, 1.0])
    """
    source = LogSource(path=path, unit="line")
    rows = _rows(source)
    _, header = next(rows, (0, []))
    found = _find(source, header)
    numbers = array("q")
    values = {field: array("d") for field in found}
    for number, row in rows:
        if len(row) != len(header):
            message = f"{len(row)} cells, the head has {len(header)}: mend the line"
            raise source.fault(message, number)
        if not numbers and "time" in found:
            found["time"] = _dated(found["time"], row)
        numbers.append(number)
        source.check_count(len(numbers))
        for field, column in found.items():
            values[field].append(column.value(source, field, row, number))
    # Before the unit of time is found by the speed: from 0, 0 it is a long way.
    places = (np.array(values[field]) for field in ("longitude", "latitude"))
    start = first_fix(source, *places)
    columns = _converted(source, found, {field: np.array(column[start:]) for field, column in values.items()})
    return FlightLog.of(source, numbers[start:], columns)


def _rows(source: LogSource) -> Iterator[tuple[int, list[str]]]:
    """Yield number and cells of each line that has any."""
    source.check_size()
    line = 0
    try:
        with source.path.open(encoding="utf-8-sig", newline="") as file:
            head = next((text for text in file if text.strip() and not text.startswith("#")), "")
            file.seek(0)
            reader = csv.reader(file, delimiter=max(",;\t", key=head.count), strict=True)
            for row in reader:
                line = reader.line_num
                if any(cell.strip() for cell in row) and not row[0].startswith("#"):
                    yield line, row
    except (OSError, UnicodeDecodeError) as error:
        message = f"no text in UTF-8 ({message_of(error)}): export it anew"
        raise source.fault(message) from error
    except csv.Error as error:
        message = f"no sound CSV ({message_of(error)}): mend the line"
        raise source.fault(message, line + 1) from error


def _find(source: LogSource, header: Sequence[str]) -> dict[str, _Column]:
    """Return the column of each field; one whose name has a unit goes before one without."""
    keys = [re.sub(r"[^a-z0-9]+", "_", name.strip().lower().rpartition(".")[2]).strip("_") for name in header]
    found = {}
    for field, names in COLUMNS.items():
        matches = [_Column(at=at, name=header[at], factor=names[key]) for at, key in enumerate(keys) if key in names]
        stated = [column for column in matches if column.factor is not None] or matches
        if len(stated) > 1:
            message = f"{field} is ambiguous, columns {_listed([item.name for item in stated])}: keep one of them"
            raise source.fault(message)
        if stated:
            found[field] = stated[0]
    lacking = [field for field in ("latitude", "longitude") if field not in found]
    if lacking:
        names_text = _listed(header) if header else "none"
        message = f"no column of {' and '.join(lacking)}, found {names_text}: name them lat and lon"
        raise source.fault(message)
    return found if "yaw" in found else {field: found[field] for field in found if field not in _AXES}


def _listed(names: Sequence[str]) -> str:
    more = ", ..." if len(names) > _MOST_NAMES else ""
    return ", ".join(shown(name) for name in names[:_MOST_NAMES]) + more


def _dated(column: _Column, row: Sequence[str]) -> _Column:
    """Return a column of time as that of dates, if its first cell is one."""
    is_date = column.factor is None and _DATE.search(row[column.at]) is not None
    return replace(column, is_date=True, factor=1.0) if is_date else column


def _converted(source: LogSource, found: dict[str, _Column], values: dict[str, Floats]) -> dict[str, Floats]:
    """Return the columns of a log in seconds, metres and degrees."""
    lat, lon = values["latitude"], values["longitude"]
    columns = {"lon_deg": lon, "lat_deg": lat}
    if _is_whole(lat, lon) and max(np.abs(lat).max(initial=0), np.abs(lon).max(initial=0)) > 180:  # noqa: PLR2004
        # As the nearest numbers to what is meant: 0.1 times 3 is not 0.3.
        columns = {name: (column * 1e-7).round(7) for name, column in columns.items()}
    if "time" in found:
        columns["time_s"] = _times(source, found["time"], values["time"], columns)
    if "height" in found:
        height, factor = values["height"], found["height"].factor
        is_mm = _is_whole(height) and np.abs(height).max(initial=0) > _HIGHEST_M
        columns["height_m"] = height * (factor or (1e-3 if is_mm else 1.0))
    if "yaw" in found:
        axes = [axis for axis in _AXES if axis in found]
        factor = _angle_factor(source, [found[axis] for axis in axes], [values[axis] for axis in axes])
        columns |= {f"{axis}_deg": values[axis] * (found[axis].factor or factor) for axis in axes}
    return columns


def _is_whole(*columns: Floats) -> bool:
    return all(bool((column == np.rint(column)).all()) for column in columns)


def _times(source: LogSource, column: _Column, ticks: Floats, places: dict[str, Floats]) -> Floats:
    """Return seconds since the first point."""
    ticks = ticks - ticks[:1]
    if column.is_date:
        return ticks.round(6)
    if column.factor is not None or not ticks[-1:].any() or (np.diff(ticks) < 0).any():  # refused as they are
        return ticks * (column.factor or 1.0)
    with np.errstate(all="ignore"):  # places are checked later, what is none on Earth has no distance
        per_tick = float(np.nansum(steps_m(places["lon_deg"], places["lat_deg"]))) / float(ticks[-1])
    fitting = [unit for unit in _TIME_UNITS if _SLOWEST_MPS <= per_tick / unit < FASTEST_MPS]
    if not fitting:
        message = (
            f"column {shown(column.name)} fits no unit of time, by which the mean speed would be {_SLOWEST_MPS:g} to "
            f"{FASTEST_MPS:g} m/s: name it time_s, time_ms or time_us"
        )
        raise source.fault(message)
    return ticks * fitting[0]


def _angle_factor(source: LogSource, columns: Sequence[_Column], angles: Sequence[Floats]) -> float:
    """Return the factor to degrees of the columns whose names state no unit; they share one."""
    open_ones = [at for at, column in enumerate(columns) if column.factor is None]
    most = max((float(np.abs(angles[at]).max(initial=0)) for at in open_ones), default=math.inf)
    if most > 360 and open_ones and _is_whole(*(angles[at] for at in open_ones)):  # noqa: PLR2004 - a turn
        return 0.01
    if most <= 2 * math.pi:
        names = _listed([columns[at].name for at in open_ones])
        message = f"angles may be radians or degrees, columns {names}: name them like yaw_deg or yaw_rad"
        raise source.fault(message)
    return 1.0
