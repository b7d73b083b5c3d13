# SPDX-License-Identifier: Apache-2.0
"""Times of GPS in UTC: receivers and logs count without the leap seconds that clocks have."""

import datetime as dt
from bisect import bisect_right
from typing import Final

import numpy as np
from numpy.typing import NDArray

GPS_EPOCH_S: Final = 315_964_800  # 1980-01-06, from which GPS counts, in seconds since 1970
WEEK_S: Final = 604_800
_END_S: Final = 2**31  # in 2038, to which stamps of ROS go

# Days from which UTC is a second further behind GPS: https://hpiers.obspm.fr/iers/bul/bulc/Leap_Second.dat
# (IERS, Bulletin C); none is announced after them.
_LEAPS: Final = tuple(
    dt.datetime(year, month, 1, tzinfo=dt.UTC).timestamp()
    for year, month in (
        *((1981, 7), (1982, 7), (1983, 7), (1985, 7), (1988, 1), (1990, 1), (1991, 1), (1992, 7), (1993, 7)),
        *((1994, 7), (1996, 1), (1997, 7), (1999, 1), (2006, 1), (2009, 1), (2012, 7), (2015, 7), (2017, 1)),
    )
)
_STARTS: Final = np.array([utc_s - GPS_EPOCH_S + count for count, utc_s in enumerate(_LEAPS, start=1)])


def utc_of_gps(gps_s: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return seconds since 1970, UTC, of seconds since 1980-01-06 as GPS counts them, of any shape.

    A time within a leap second is that of the second after it, as clocks of Unix have it.

    Examples
    --------
    A flight in 2014 is 16 seconds behind the count of GPS, one in 2025 by 18:

    >>> weeks = np.array([1800.0, 2350.0])
    >>> (utc_of_gps(weeks * WEEK_S) - (GPS_EPOCH_S + weeks * WEEK_S)).tolist()
    [-16.0, -18.0]
    """
    return np.asarray(GPS_EPOCH_S + gps_s - np.searchsorted(_STARTS, gps_s, side="right"))


def is_date(utc_s: float) -> bool:
    """Return whether seconds since 1970, UTC, may be a date of a flight; a clock that was never set tells none.

    >>> is_date(1_777_629_600.0), is_date(10.0), is_date(1e15)
    (True, False, False)
    """
    return GPS_EPOCH_S <= utc_s < _END_S


def week_of_utc(utc_s: float) -> tuple[int, int]:
    """Return the week of GPS, not wrapped, and the milliseconds in it, of seconds since 1970, UTC.

    >>> week, week_ms = week_of_utc(dt.datetime(2025, 1, 19, 23, 59, 42, 500_000, tzinfo=dt.UTC).timestamp())
    >>> week, week_ms, utc_of_gps(np.array(week * WEEK_S + week_ms / 1000)).item() - GPS_EPOCH_S - week * WEEK_S
    (2350, 86400500, 86382.5)
    """
    gps_ms = round((utc_s - GPS_EPOCH_S + bisect_right(_LEAPS, utc_s)) * 1000)
    return divmod(gps_ms, WEEK_S * 1000)
