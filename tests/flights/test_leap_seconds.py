# SPDX-License-Identifier: Apache-2.0
"""UTC out of the count of GPS: whole seconds apart by the day, as the IERS has published them."""

import datetime as dt

import numpy as np
import pytest

from sasgeo_bench.flights.leap_seconds import GPS_EPOCH_S, WEEK_S, utc_of_gps, week_of_utc

# From which day on GPS is so many seconds ahead of UTC (IERS, Bulletin C 52 and those before; GPS began in step).
AHEAD_S = {
    (1980, 1, 6): 0, (1981, 7, 1): 1, (1982, 7, 1): 2, (1983, 7, 1): 3, (1985, 7, 1): 4, (1988, 1, 1): 5,
    (1990, 1, 1): 6, (1991, 1, 1): 7, (1992, 7, 1): 8, (1993, 7, 1): 9, (1994, 7, 1): 10, (1996, 1, 1): 11,
    (1997, 7, 1): 12, (1999, 1, 1): 13, (2006, 1, 1): 14, (2009, 1, 1): 15, (2012, 7, 1): 16, (2015, 7, 1): 17,
    (2017, 1, 1): 18, (2026, 5, 1): 18,
}  # fmt: skip


@pytest.mark.parametrize(("day", "ahead_s"), AHEAD_S.items())
def test_gps_is_ahead_of_utc_by_the_leap_seconds_of_the_day(day: tuple[int, int, int], ahead_s: int) -> None:
    utc_s = dt.datetime(*day, tzinfo=dt.UTC).timestamp()
    gps_s = utc_s - GPS_EPOCH_S + ahead_s
    found = utc_of_gps(np.array([gps_s, gps_s + 0.25, gps_s + 3600]))
    assert found.tolist() == [utc_s, utc_s + 0.25, utc_s + 3600]
    week, week_ms = week_of_utc(utc_s)
    assert week * WEEK_S + week_ms / 1e3 == gps_s


def test_a_time_within_a_leap_second_is_that_of_the_second_after_it() -> None:
    """As clocks of Unix have it: 23:59:60 and 0:00:00 are one."""
    new_year_s = dt.datetime(2017, 1, 1, tzinfo=dt.UTC).timestamp()
    gps_s = new_year_s - GPS_EPOCH_S + 18 + np.array([-2.0, -1.0, 0.0, 1.0])
    assert (utc_of_gps(gps_s) - new_year_s).tolist() == [-1.0, 0.0, 0.0, 1.0]
