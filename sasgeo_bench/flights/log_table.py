# SPDX-License-Identifier: Apache-2.0
"""CSV logs with latitude and longitude, and position files of RTKLIB: rows, places, times, heights, angles.

A unit is what the name of a column or the format says, else what `LogFacts` says, else it is asked for. It is never
guessed from the size of the values. Latitude and longitude without a unit are degrees.
"""

import csv
import math
import re
from array import array
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from itertools import chain
from pathlib import Path
from types import MappingProxyType
from typing import Final

import numpy as np
from numpy.typing import NDArray

from sasgeo_bench.core.texts import message_of, plain
from sasgeo_bench.flights.leap_seconds import GPS_EPOCH_S, WEEK_S, utc_of_gps
from sasgeo_bench.flights.log_formats import (
    NUMBERING,
    PX4,
    QUANTITIES,
    Column,
    Format,
    Layout,
    find_layout,
    key_of,
    unread,
)
from sasgeo_bench.flights.log_points import (
    BEFORE_FIX,
    FlightLog,
    LogSource,
    altitude_note,
    shown,
    tell_left_out,
)
from sasgeo_bench.flights.log_units import UNITS, WORDS, LogFacts, choices_of

_DAY_S: Final = 86_400.0
_YEAR_FIRST: Final = re.compile(r"(\d{4})[-/:.](\d{1,2})[-/:.](\d{1,2})[ T]+(\d{1,2})(:.+)")
_DAY_TIME: Final = re.compile(r"(\d{1,2}):(\d{2}):(\d{2}(?:[.,]\d+)?)\s*(?:([AaPp])\.?\s?[Mm]\.?)?Z?")
_WEEK: Final = re.compile(r"(\d{3,4}) +(\d+(?:\.\d+)?)")
_SPAN: Final = re.compile(r"(?:(\d+)h\s*)?(?:(\d+)m\s*)?(\d+(?:\.\d+)?)s")
_ZONE: Final = re.compile(r"\s*(?:UTC|GMT)(?=[-+]|$)")  # which a time is in without a word, too
_ZONED: Final = re.compile(r"Z$|UTC|GMT|:\d\d(?:[.,]\d+)?\s*[-+]\d\d(?::?\d\d)?$")
_DATED: Final = re.compile(r"\d{4}\D?\d{1,2}\D?\d{1,2}[T ]")  # of a moment, not a time of day
_DATE: Final = re.compile(r"\d[-/.:]\d+[-/.:]\d|\dT\d")  # of a time that is no number, in any order


@dataclass(slots=True, kw_only=True)
class Clock:
    """Turns the cells of a column of times, one after the other, into seconds.

    A time of day goes on into the next day where the cell of its date changes, or where it falls by half a day.

    >>> from pathlib import Path
    >>> clock = Clock(source=LogSource(path=Path("a.csv"), unit="line"))
    >>> [clock.seconds(text, "", 2) for text in ("11:59:59.5 PM", "12:00:01.5 AM")]
    [86399.5, 86401.5]
    """

    source: LogSource
    days: int = 0
    last_s: float = 0.0
    last_date: str = ""

    def seconds(self, text: str, date: str, number: int) -> float:
        """Return a cell in seconds; raise `FlightError` if it is none of the forms that are read."""
        text = _ZONE.sub("", text.strip())
        if match := _DAY_TIME.fullmatch(text):
            return self._of_day(match, date.strip(), number)
        if match := _WEEK.fullmatch(text):
            return int(match[1]) * WEEK_S + float(match[2])
        if match := _SPAN.fullmatch(text):
            return int(match[1] or 0) * 3600 + int(match[2] or 0) * 60 + float(match[3])
        if match := _YEAR_FIRST.fullmatch(text):
            text = f"{match[1]}-{int(match[2]):02}-{int(match[3]):02}T{int(match[4]):02}{match[5]}"
        return self.source.moment(text, number)

    def _of_day(self, match: "re.Match[str]", date: str, number: int) -> float:
        hours, half = int(match[1]), (match[4] or "").lower()
        if half:
            is_right = 1 <= hours <= 12  # of a clock's face
            hours = hours % 12 + (12 if half == "p" else 0)
        else:
            is_right = hours < 24  # of a day
        seconds = float(match[3].replace(",", "."))
        if not is_right or int(match[2]) > 59 or seconds >= 60:  # minutes and seconds
            message = f"time is no time of day, {match[0]!r}: mend it"
            raise self.source.fault(message, number)
        time_s = hours * 3600 + int(match[2]) * 60 + seconds
        is_next = date != self.last_date if date and self.last_date else time_s < self.last_s - _DAY_S / 2
        self.days += is_next
        self.last_s, self.last_date = time_s, date
        return self.days * _DAY_S + time_s


def is_clock(text: str) -> bool:
    """Return whether a cell is a time that is no plain number.

    >>> [is_clock(text) for text in ("2025-05-01T10:00:00Z", "1:02:03 PM", "2314 433341.5", "3m 5.2s", "1700000000.5")]
    [True, True, True, True, False]
    """
    forms = (_DAY_TIME, _WEEK, _SPAN)
    return _DATE.search(text) is not None or any(form.fullmatch(text.strip()) for form in forms)


@dataclass(frozen=True, slots=True, kw_only=True)
class Lines:
    """Header of a table, and number and cells of each line below."""

    header: list[str]
    rows: Iterable[tuple[int, list[str]]]


def read_lines(source: LogSource) -> Lines:
    """Return the lines of a table that have any cells."""
    rows = _rows(source)
    _, header = next(rows, (0, []))
    while header and not header[-1].strip():
        header = header[:-1]
    first = next(rows, None)
    if first is None:
        return Lines(header=header, rows=())
    if _is_units(header, first[1]):
        cells = [*first[1], *[""] * len(header)]
        header = [
            f"{name} [{unit.strip(' []()')}]" if unit.strip() else name
            for name, unit in zip(header, cells, strict=False)
        ]
        first = next(rows, None)
    return Lines(header=header, rows=chain([first] if first else [], rows))


def _is_units(header: Sequence[str], cells: Sequence[str]) -> bool:
    """Return whether the cells below a header are units: one at least is, and none is a number."""
    units = {word for known in WORDS.values() for word in known}
    others = [cell for cell in cells if key_of(cell) not in units]
    return bool(header) and len(others) < len(cells) and not any(re.match(r"\s*[-+.]?\d", cell) for cell in others)


def _is_head(comment: Sequence[str], cells: Sequence[str]) -> bool:
    """Return whether a comment has the names of the cells below, as `numpy.savetxt` writes them."""
    starts = [re.match(r"\s*[-+.]?\d", cell) for cell in (*comment, *cells)]
    return len(comment) == len(cells) and not any(starts[: len(comment)]) and any(starts[len(comment) :])


def _rows(source: LogSource) -> Iterator[tuple[int, list[str]]]:
    """Yield number and cells of each line that has any; the first is the header."""
    source.check_size()
    line = 0
    try:
        with source.path.open(encoding="utf-8-sig", newline="") as file:
            head = next((text for text in file if text.strip() and not text.startswith("#")), "")
            separator = re.fullmatch(r'"?sep=(.)"?\s*', head, flags=re.IGNORECASE)
            if separator:
                head = next((text for text in file if text.strip()), "")
            file.seek(0)
            if source.path.suffix.lower() == ".pos" or re.match(r"%\s", head):
                yield from _position_rows(file)
                return
            delimiter = separator[1] if separator else max(",;\t", key=head.count)
            reader = csv.reader(file, delimiter=delimiter, strict=True, skipinitialspace=True)
            skip = separator is not None
            comment, is_begun = (0, [""]), False
            for row in reader:
                line = reader.line_num
                if not any(cell.strip() for cell in row):
                    continue
                if row[0].startswith("#"):
                    comment = (line, [row[0].lstrip("# "), *row[1:]])
                    continue
                if skip:
                    skip = False
                    continue
                if not is_begun and _is_head(comment[1], row):
                    yield comment
                is_begun = True
                yield line, row
    except (OSError, UnicodeDecodeError) as error:
        raise source.fault(f"no text in UTF-8 ({message_of(error)}): save it as CSV in UTF-8") from error
    except csv.Error as error:
        message = f"no sound CSV ({message_of(error)}): mend the line"
        raise source.fault(message, line + 1) from error


def _position_rows(lines: Iterable[str]) -> Iterator[tuple[int, list[str]]]:
    """Yield the rows of a position file: the last line with "%" before the data has the names."""
    names: list[str] = []
    is_begun = False
    for number, text in enumerate(lines, start=1):
        if text.startswith("%"):
            names = names if is_begun else _words(text[1:])
        elif text.strip():
            if not is_begun:
                is_begun = True
                yield number - 1, names
            cells = _words(text)
            if len(cells) == len(names) + 1:  # date and time of day, or week and seconds of the week
                cells = [f"{cells[0]} {cells[1]}", *cells[2:]]
            yield number, cells


def _words(text: str) -> list[str]:
    return [word.strip() for word in text.split(",")] if "," in text else text.split()


Floats = NDArray[np.float64]

_MAY_LACK: Final = ("height", "yaw", "pitch", "roll")
_UNKNOWN: Final = frozenset({"", "nan", "null", "none", "na", "n/a", "-", "--", "--.--"})
_LETTERED: Final = re.compile(
    r"(\d+(?:\.\d+)?)\s*(?:deg|°)?\s*(?:([0-5]?\d(?:\.\d+)?)\s*['\u2032]\s*)?(?:([0-5]?\d(?:\.\d+)?)\s*[\"\u2033]\s*)?([NSEW])"
)
_SIGNS: Final = MappingProxyType(
    {
        "latitude": {"N": 1, "NORTH": 1, "S": -1, "SOUTH": -1},
        "longitude": {"E": 1, "EAST": 1, "W": -1, "WEST": -1},
    }
)
_ZERO: Final = re.compile(r"[-+]?0+(?:[.,]0*)?(?:[eE][-+]?\d+)?")
_HALF_TURN: Final = 180.0


@dataclass(frozen=True, slots=True, kw_only=True)
class _Table:
    """Values of the lines that are points, in the units of the file; NaN where one is unknown."""

    numbers: "array[int]" = field(default_factory=lambda: array("q"))
    values: "dict[str, array[float]]"
    has_dates: bool = False
    first_time: str = ""


def read_csv(path: Path, facts: LogFacts | None = None) -> FlightLog:
    r"""Read a CSV log, or a position file of RTKLIB (.pos).

    The separator is a comma, a semicolon or a tab, or what a first line such as "sep=;" says. Decimals have a comma
    where the separator is none. Empty lines, and lines that begin with "#", are skipped; a line of units below the
    header belongs to the names. Altitudes above the sea or the ellipsoid are no heights.

    Raises
    ------
    FlightError
        If the table is not sound, a unit is open, or it is open what a column is.

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
    facts = facts or LogFacts()
    source = LogSource(path=path, unit="line")
    lines = read_lines(source)
    layout = find_layout(source, lines.header, facts)
    table = _read(source, layout, lines)
    values = {name: np.array(column) for name, column in table.values.items()}
    numbers = np.array(table.numbers)
    layout = layout if table.has_dates else _as_px4(layout, values)
    numbers, values = _known(source, layout.format, numbers, values)
    values = _with_altitude(layout, values)
    whole = values.get("time", np.empty(0))[:1]
    values = _with_parts(source, layout, values, in_seconds=table.has_dates or facts.time_unit == "s")
    start_s = _start_s(layout, whole, values, table)
    columns, notes = _converted(source, layout, facts, values, has_dates=table.has_dates)
    if not layout.format.is_sorted and "time_s" in columns:
        order = np.argsort(columns["time_s"], kind="stable")
        numbers, columns = numbers[order], {name: column[order] for name, column in columns.items()}
        start_s = None if start_s is None else start_s + float(columns["time_s"][0])
        columns["time_s"] = columns["time_s"] - columns["time_s"][:1]
    lines_of = {line.partition(":")[0]: line.replace(": ", ", column ", 1) + "," for line in notes}
    names = {{"height": "height_m"}.get(name, f"{name}_deg"): line for name, line in lines_of.items()}
    notes += unread(lines.header, layout, values, has_dates=table.has_dates)
    return FlightLog.of(
        source,
        numbers.tolist(),
        columns,
        start_s=start_s,
        altitude_of=layout.altitude_of,
        notes=notes,
        names=names,
    )


# Values


def _read(source: LogSource, layout: Layout, lines: Lines) -> _Table:
    """Return the values of the lines that are points; warn of those that are none."""
    layout, rows = _checked_receiver(layout, lines.rows)
    table = _Table(values={name: array("d") for name in (*layout.fields, *(["part"] if layout.part else []))})
    gate, clock = _Gate(layout=layout), Clock(source=source)
    time = layout.fields.get("time")
    # The first point tells.
    has_dates: bool | None = False if time is None or time.unit is not None else None
    decimal = first_time = ""
    for number, cells in rows:
        row = _trimmed(source, cells, len(lines.header), number)
        if not gate.lets(row):
            continue
        table.numbers.append(number)
        source.check_count(len(table.numbers))
        places = [row[layout.fields[name].at] for name in ("latitude", "longitude")]
        decimal = decimal or ("," if any("," in text for text in places) else ".")
        if has_dates is None and time is not None:
            has_dates, first_time = is_clock(row[time.at]), row[time.at]
        for name, column in layout.fields.items():
            text = row[column.at]
            if name == "time" and has_dates:
                value = clock.seconds(text, row[layout.date.at] if layout.date else "", number)
            else:
                value = _value(source, text, name, number, decimal)
            if name in _SIGNS:
                value *= _sign(source, layout, row, name, number, value)
            table.values[name].append(value)
        if layout.part is not None:
            table.values["part"].append(_number(source, row[layout.part.at], layout.part.name, number, decimal))
    for which, count in gate.left.items():
        tell_left_out(source, count, which)
    return replace(table, has_dates=bool(has_dates), first_time=first_time)


@dataclass(slots=True, kw_only=True)
class _Gate:
    """Lets lines through that are points of one receiver, and counts the others by reason."""

    layout: Layout
    is_begun: bool = False  # what is logged before the first fix tells nothing, of units neither
    receiver: str | None = None
    left: "Counter[str]" = field(default_factory=Counter)

    def lets(self, row: Sequence[str]) -> bool:
        """Return whether a line is a point: it has a fix, a place, and the receiver of the first point."""
        reason = self._reason(row)
        if reason:
            self.left[reason] += 1
        self.is_begun = self.is_begun or not reason
        return not reason

    def _reason(self, row: Sequence[str]) -> str:
        fields, receiver = self.layout.fields, self.layout.receiver
        if _has_no_fix(self.layout, row):
            return "without a fix"
        places = [row[fields[name].at].strip() for name in ("latitude", "longitude")]
        if all(map(_is_unknown, places)):
            return "without a place"
        if not self.is_begun and all(map(_ZERO.fullmatch, places)):
            return BEFORE_FIX
        if receiver is not None:
            cell = row[receiver.at].strip()
            self.receiver = cell if self.receiver is None else self.receiver
            if cell != self.receiver:
                return f"of other receivers than {plain(receiver.name)} = {plain(self.receiver)}"
        return ""


def _value(source: LogSource, text: str, name: str, number: int, decimal: str) -> float:
    """Return the number in a cell; NaN where a height or an angle is unknown, or an altitude is no number."""
    if name == "altitude":  # no place depends on it
        try:
            return float(text.replace(",", ".") if decimal == "," else text)
        except ValueError:
            return math.nan
    if name in _MAY_LACK and _is_unknown(text):
        return math.nan
    return _number(source, text, name, number, decimal)


def _with_altitude(layout: Layout, values: dict[str, Floats]) -> dict[str, Floats]:
    """Return the values without altitudes where not all points have one, or their unit is open."""
    altitude = values.get("altitude")
    if altitude is None:
        return values
    # What is scaled of a message is scaled by its reader's taste; places of PX4 in degrees have altitudes in metres.
    is_open = layout.format.counts and layout.fields["altitude"].unit == "mm" and not _is_count(values)
    if np.isfinite(altitude).all() and is_open and layout.format is PX4:
        return {**values, "altitude": altitude * 1e3}
    if is_open or not np.isfinite(altitude).all():
        return {name: column for name, column in values.items() if name != "altitude"}
    return values


def _start_s(layout: Layout, whole: Floats, values: dict[str, Floats], table: _Table) -> float | None:
    """Return the first time in seconds since 1970, UTC; None if the file does not say in which zone it counts."""
    time = layout.fields.get("time")
    if time is None or not len(whole):
        return None
    # `whole` is the time before its parts of a second were added, and what was whole taken off
    first, key, text = float(whole[0]), layout.keys[time.at], table.first_time.strip()
    first += float(values["time"][0]) if values["time"][0] != first else 0.0
    if not table.has_dates:
        first *= UNITS["time"][time.unit or "s"]
        # 1e9: a clock that has never been set counts from its start
        return first if key in layout.format.epoch and first > 1e9 else None
    if _WEEK.fullmatch(text):
        return float(utc_of_gps(np.array(first)))
    if not _DATED.match(text):
        return None
    if key in layout.format.gps:
        return float(utc_of_gps(np.array(first - GPS_EPOCH_S)))
    return first if _ZONED.search(text) or "utc" in key.split("_") else None


def _trimmed(source: LogSource, cells: list[str], count: int, number: int) -> list[str]:
    """Return as many cells as the header has; empty ones beyond are trailing separators."""
    if len(cells) < count or any(cell.strip() for cell in cells[count:]):
        message = f"{len(cells)} cells, the head has {count}: mend the line"
        raise source.fault(message, number)
    return cells[:count]


def _has_no_fix(layout: Layout, row: Sequence[str]) -> bool:
    if layout.fix is None:
        return False
    try:
        return float(row[layout.fix.at]) < layout.least_fix
    except ValueError:
        return False


def _is_unknown(text: str) -> bool:
    return text.strip().lower() in _UNKNOWN


def _number(source: LogSource, text: str, name: str, number: int, decimal: str) -> float:
    match = _LETTERED.fullmatch(text.strip()) if name in _SIGNS else None
    if match:
        degrees = float(match[1]) + float(match[2] or 0) / 60 + float(match[3] or 0) / 3600
        if (match[4] in "NS") != (name == "latitude"):
            message = f"{name} is {shown(text)}: check which column is which"
            raise source.fault(message, number)
        return -degrees if match[4] in "SW" else degrees
    if decimal == ",":
        if "." in text:
            message = f"{name} is {shown(text)} where others have a decimal comma: write all alike"
            raise source.fault(message, number)
        text = text.replace(",", ".")
    return source.number(text, name, number)


def _sign(source: LogSource, layout: Layout, row: Sequence[str], name: str, number: int, value: float) -> int:
    """Return the factor to a latitude or longitude out of its column of N or S, E or W; 1 if there is none."""
    signs, column = _SIGNS[name], layout.hemispheres.get(name)
    if column is None:
        at = layout.fields[name].at
        for beside in (at - 1, at + 1):
            if 0 <= beside < len(row) and signs.get(row[beside].strip().upper(), 1) < 0:
                message = f"{shown(row[beside])} beside {name}: name its column {name}_hemisphere, or delete it"
                raise source.fault(message, number)
        return 1
    text = row[column.at].strip().upper()
    if text not in signs:
        if re.fullmatch(r"[-+]?[\d.]+", text) and "hemi" not in column.name.lower():  # as NS, a count of satellites
            return 1
        letters = " or ".join(word for word in signs if len(word) == 1)
        message = f"column {shown(column.name)} is {shown(text)}, not {letters}: mend the cell, or delete the column"
        raise source.fault(message, number)
    if value < 0 < signs[text]:
        message = f"{name} is negative, column {shown(column.name)} is {shown(text)}: mend one of them"
        raise source.fault(message, number)
    return 1 if value < 0 else signs[text]


def _checked_receiver(
    layout: Layout, rows: Iterable[tuple[int, list[str]]]
) -> tuple[Layout, Iterable[tuple[int, list[str]]]]:
    """Return the layout without a column that numbers lines: it tells receivers only if its values recur."""
    if layout.receiver is None or layout.keys[layout.receiver.at] not in NUMBERING:
        return layout, rows
    at, kept = layout.receiver.at, list(rows)
    count = len({cells[at].strip() for _, cells in kept if at < len(cells)})
    return (layout if 2 * count <= len(kept) else replace(layout, receiver=None)), kept


def _with_parts(source: LogSource, layout: Layout, values: dict[str, Floats], *, in_seconds: bool) -> dict[str, Floats]:
    """Return times with the parts of a second that another column holds, unless they have their own."""
    part, time = values.pop("part", None), layout.fields.get("time")
    if part is None or layout.part is None or time is None or not (in_seconds or time.unit == "s"):
        return values
    whole = values["time"]
    if (whole != np.floor(whole)).any():
        return values
    parts_s = part * UNITS["time"][layout.part.unit or "s"]
    if ((parts_s < 0) | (parts_s >= 1)).any():
        raise source.fault(
            f"column {shown(layout.part.name)} is no part of a second, and {shown(time.name)} has whole seconds: "
            "keep the one that is the time"
        )
    return {**values, "time": whole - whole[:1] + parts_s}


def _as_px4(layout: Layout, values: dict[str, Floats]) -> Layout:
    """Return the layout of PX4 for a few of its columns: `timestamp` first, and all of the message's integers."""
    # PX4 counts from its start, so times that count from 1970 are of another format, whose unit is open.
    time = layout.fields.get("time")
    if time is None:
        return layout
    # 1e14: three years: no PX4 runs for longer, so later times count from 1970
    is_boot_time = float(values["time"].max(initial=0)) < 1e14
    if layout.format is PX4 and not is_boot_time:
        return replace(layout, fields={**layout.fields, "time": replace(time, unit=None)})
    is_px4 = (
        not layout.format.name
        and is_boot_time
        and time.unit is None
        and layout.keys[0] == "timestamp"
        and {"lat", "lon", "alt"} <= set(layout.keys)
        and _is_count(values)
        and bool((values["time"] == np.rint(values["time"])).all())
    )
    if not is_px4:
        return layout
    units = {"time": "us", **dict.fromkeys(("yaw", "pitch", "roll"), "rad")}
    fields = {name: replace(column, unit=column.unit or units.get(name)) for name, column in layout.fields.items()}
    return replace(layout, format=PX4, fields=fields)


def _is_count(values: dict[str, Floats]) -> bool:
    """Return whether places are whole numbers that are no degrees."""
    places = np.concatenate([values["latitude"], values["longitude"]])
    return bool((places == np.rint(places)).all()) and float(np.abs(places).max(initial=0)) > _HALF_TURN


def _known(
    source: LogSource, log_format: Format, numbers: NDArray[np.int64], values: dict[str, Floats]
) -> tuple[NDArray[np.int64], dict[str, Floats]]:
    """Return points of which all is known: a column that says nothing is left out, else the points without a value."""
    if log_format.no_yaw is not None and "yaw" in values:
        values["yaw"] = np.where(values["yaw"] == log_format.no_yaw, np.nan, values["yaw"])
    for name in _MAY_LACK:
        if name in ("pitch", "roll") and "yaw" not in values:
            values.pop(name, None)  # no attitude without a heading
        elif name in values and len(numbers) and np.isnan(values[name]).all():
            source.warn(f"no line has a {name}: read without")
            del values[name]
    for name in _MAY_LACK:
        is_known = ~np.isnan(values[name]) if name in values else np.ones(len(numbers), dtype=bool)
        if not is_known.all():
            tell_left_out(source, int((~is_known).sum()), f"without a {name}")
            numbers, values = numbers[is_known], {key: column[is_known] for key, column in values.items()}
    return numbers, values


# Units


def _converted(
    source: LogSource, layout: Layout, facts: LogFacts, values: dict[str, Floats], *, has_dates: bool
) -> tuple[dict[str, Floats], tuple[str, ...]]:
    """Return the columns of a log in seconds, metres and degrees, and a line on each."""
    counts = layout.format.counts and _is_count(values)
    columns, notes = {}, []
    for name, column in values.items():
        quantity = QUANTITIES[name]
        at = layout.fields[name]
        if name == "time" and has_dates:
            _check_stated_unit(source, at, "dates", facts.time_unit, "time")
            columns["time_s"] = (column - column[:1]).round(6)
            notes.append(f"time: {shown(at.name)}, as dates or clocks have it")
            continue
        if name == "altitude":
            columns["altitude_m"] = column * UNITS["height"][at.unit or "m"]
            notes.append(f"{altitude_note(layout.altitude_of)} ({shown(at.name)}, {at.unit})")
            continue
        if quantity == "place":
            unit = _place_unit(source, at, facts, values, counts=counts)
            if unit == "e7" and (column != np.rint(column)).any():
                mend = "say --place-unit deg" if at.unit is None else "name it by its unit"
                raise source.fault(
                    f"column {shown(at.name)} has decimals, and is no count of 1e-7 degrees: {mend}, or mend it"
                )
        else:
            # What is scaled of a message is scaled by its reader's taste.
            is_open = layout.format.counts and at.unit in ("mm", "cdeg") and not counts
            unit = _unit(source, replace(at, unit=None) if is_open else at, quantity, facts)
        factor = UNITS[quantity][unit]
        if quantity == "place":
            # As the nearest numbers to what is meant: 0.1 times 3 is not 0.3.
            columns[f"{name[:3]}_deg"] = (column * factor).round(7) if unit == "e7" else column * factor
        else:
            base = column - column[:1] if name == "time" else column
            columns[{"time": "time_s", "height": "height_m"}.get(name, f"{name}_deg")] = base * factor
        notes.append(f"{name}: {shown(at.name)}, {unit}" + (f" ({layout.format.name})" if layout.format.name else ""))
    return columns, tuple(notes)


def _place_unit(source: LogSource, at: Column, facts: LogFacts, values: dict[str, Floats], *, counts: bool) -> str:
    """Return the unit of places: degrees, unless the format counts or they are stated."""
    if at.unit is None and facts.place_unit is None:
        if counts:
            return "e7"
        if _is_count(values):
            raise source.fault(
                f"column {shown(at.name)} holds whole numbers that are no degrees: say --place-unit e7, or mend them"
            )
        return "deg"
    return _unit(source, at, "place", facts)


def _unit(source: LogSource, at: Column, quantity: str, facts: LogFacts) -> str:
    """Return the unit that a name, a format or the user states; raise `FlightError` if none does, or both differ."""
    stated = facts.unit(quantity)
    if at.unit is not None:
        _check_stated_unit(source, at, at.unit, stated, quantity)
        return at.unit
    if stated is None:
        choices = choices_of(quantity)
        listed = f"{', '.join(choices[:-1])} or {choices[-1]}"
        example = {"time": "time_s", "height": "height_m", "angle": "yaw_deg"}.get(quantity, "lat_deg")
        raise source.fault(
            f"column {shown(at.name)} states no unit: say --{quantity}-unit {listed}, or name it as in {example}"
        )
    return stated


def _check_stated_unit(source: LogSource, at: Column, unit: str, stated: str | None, quantity: str) -> None:
    if stated is not None and stated != unit:
        raise source.fault(f"column {shown(at.name)} is in {unit}, not in {stated}: leave out --{quantity}-unit")
