# SPDX-License-Identifier: Apache-2.0
"""Times of a table that are no plain numbers: dates, times of day, GPS weeks, minutes and seconds."""

import re
from dataclasses import dataclass
from typing import Final

from sasgeo_bench.flights.log_points import LogSource

_DAY_S: Final = 86_400.0
_WEEK_S: Final = 604_800.0
_YEAR_FIRST: Final = re.compile(r"(\d{4})[-/:.](\d{1,2})[-/:.](\d{1,2})[ T]+(\d{1,2})(:.+)")
_DAY_TIME: Final = re.compile(r"(\d{1,2}):(\d{2}):(\d{2}(?:[.,]\d+)?)\s*(?:([AaPp])\.?\s?[Mm]\.?)?Z?")
_WEEK: Final = re.compile(r"(\d{3,4}) +(\d+(?:\.\d+)?)")
_SPAN: Final = re.compile(r"(?:(\d+)h\s*)?(?:(\d+)m\s*)?(\d+(?:\.\d+)?)s")
_ZONE: Final = re.compile(r"\s*(?:UTC|GMT)(?=[-+]|$)")  # which a time is in without a word, too
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
            return int(match[1]) * _WEEK_S + float(match[2])
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
