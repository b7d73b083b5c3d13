# SPDX-License-Identifier: Apache-2.0
"""Times of GPS in UTC: receivers and logs count without the leap seconds that clocks have."""

import datetime as dt
from bisect import bisect_right
from typing import Final

GPS_EPOCH_S: Final = 315_964_800  # 1980-01-06, from which GPS counts, in seconds since 1970
WEEK_S: Final = 604_800

# Days from which UTC is a second further behind GPS: https://hpiers.obspm.fr/iers/bul/bulc/Leap_Second.dat
# (IERS, Bulletin C); none is announced after them.
_LEAPS: Final = tuple(
    dt.datetime(year, month, 1, tzinfo=dt.UTC).timestamp()
    for year, month in (
        *((1981, 7), (1982, 7), (1983, 7), (1985, 7), (1988, 1), (1990, 1), (1991, 1), (1992, 7), (1993, 7)),
        *((1994, 7), (1996, 1), (1997, 7), (1999, 1), (2006, 1), (2009, 1), (2012, 7), (2015, 7), (2017, 1)),
    )
)
_STARTS: Final = tuple(utc_s - GPS_EPOCH_S + count for count, utc_s in enumerate(_LEAPS, start=1))


def utc_of_gps(gps_s: float) -> float:
    """Return seconds since 1970, UTC, of seconds since 1980-01-06 as GPS counts them.

    A time within a leap second is that of the second after it, as clocks of Unix have it.

    Examples
    --------
    A flight in 2014 is 16 seconds behind the count of GPS, one in 2025 by 18:

    >>> [utc_of_gps(week * WEEK_S) - (GPS_EPOCH_S + week * WEEK_S) for week in (1800, 2350)]
    [-16, -18]
    """
    return GPS_EPOCH_S + gps_s - bisect_right(_STARTS, gps_s)


def utc_of_week(week: int, week_s: float) -> float:
    """Return seconds since 1970, UTC, of a week of GPS that is not wrapped and the seconds in it.

    >>> dt.datetime.fromtimestamp(utc_of_week(2350, 86_400.5), tz=dt.UTC).isoformat()
    '2025-01-19T23:59:42.500000+00:00'
    """
    return utc_of_gps(week * WEEK_S + week_s)


def week_of_utc(utc_s: float) -> tuple[int, int]:
    """Return the week of GPS, not wrapped, and the milliseconds in it, of seconds since 1970, UTC.

    >>> week_of_utc(utc_of_week(2350, 86_400.5))
    (2350, 86400500)
    """
    gps_ms = round((utc_s - GPS_EPOCH_S + bisect_right(_LEAPS, utc_s)) * 1000)
    return divmod(gps_ms, WEEK_S * 1000)
