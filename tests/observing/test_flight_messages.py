# SPDX-License-Identifier: Apache-2.0
"""Messages about a flight: their fields, as pymavlink has them, and when they leave."""

import dataclasses
import datetime as dt
import math

import numpy as np
import pyproj
import pytest

from sasgeo_bench.core.errors import ConfigError
from sasgeo_bench.flights.leap_seconds import week_of_utc
from sasgeo_bench.observing.fix_files import NS
from sasgeo_bench.observing.flight_messages import (
    MESSAGES,
    Origin,
    columns_of,
    departures,
    gps_input,
    message_of,
    origin_of,
    row_of,
)
from tests.observing.flown import SPREAD, START_NS, invented


def vision(flight, at, origin=None):
    sent = departures(flight, has_all=True)
    return message_of(sent[at], "vision_position_estimate", origin or origin_of(sent), START_NS, None)


@pytest.mark.parametrize("kind", MESSAGES)
def test_fields_are_those_of_the_dialect(kind):
    common = pytest.importorskip("pymavlink.dialects.v20.common")
    fields = getattr(common, f"MAVLink_{kind}_message").fieldnames
    assert [field.name for field in dataclasses.fields(MESSAGES[kind])] == fields
    assert len(row_of(vision(invented(), 0), 0)) == len(columns_of("vision_position_estimate"))


def test_a_local_place_lies_where_the_geodesic_from_the_origin_leads():
    found = vision(invented(), 4)
    first, last = invented().fixes[0], invented().fixes[4]
    azimuth_deg, _, length_m = pyproj.Geod(ellps="WGS84").inv(first.lon_deg, first.lat_deg, last.lon_deg, last.lat_deg)
    assert (found.x, found.y) == pytest.approx(
        (length_m * math.cos(math.radians(azimuth_deg)), length_m * math.sin(math.radians(azimuth_deg))), abs=1e-6
    )
    assert found.yaw == pytest.approx(math.radians(30.0))
    assert vision(invented(), 0).yaw == pytest.approx(math.radians(-10.0))
    at_last = Origin(lon_deg=last.lon_deg, lat_deg=last.lat_deg)
    assert (vision(invented(), 4, at_last).x, vision(invented(), 4, at_last).y) == pytest.approx((0.0, 0.0), abs=1e-6)


def test_the_covariance_is_the_upper_triangle_of_north_east_down_in_radians():
    whole = np.zeros((6, 6))
    whole[np.triu_indices(6)] = vision(invented(), 0).covariance
    (ee, en, eh), (_, nn, nh), (_, _, hh) = SPREAD
    rad = math.pi / 180
    assert whole[0, [0, 1, 5]] == pytest.approx([nn, en, nh * rad])
    assert whole[1, [1, 5]] == pytest.approx([ee, eh * rad])
    assert whole[5, 5] == pytest.approx(hh * rad**2)
    # what was not measured is finite, or PX4 uses nothing of it
    assert np.diag(whole)[2:5] == pytest.approx([(ee + nn) / 2, hh * rad**2, hh * rad**2])
    assert np.isnan(vision(invented(covariance=None), 0).covariance).all()


def test_resets_count_the_jumps_up_to_a_fix():
    flight = invented(6, is_jump=[False, True, False, False, True, False])
    assert [vision(flight, at).reset_counter for at in range(6)] == [0, 1, 1, 1, 2, 2]
    thinned = departures(flight, rate_hz=0.5)
    assert [(one.fix.name, one.resets) for one in thinned] == [("view-0", 0), ("view-2", 1), ("view-4", 2)]


def test_a_receiver_has_the_longer_half_axis_and_a_heading_that_is_never_0():
    flight = invented(2, heading_deg=[0.004, 359.0])
    first, second = (gps_input(fix, START_NS, START_NS) for fix in flight.fixes)
    assert (first.yaw, second.yaw) == (36_000, 35_900)
    draws = np.random.default_rng(0).multivariate_normal([0, 0], np.array(SPREAD)[:2, :2], 100_000)
    angles = np.radians(np.arange(0, 180, 0.5))
    widest_m = max(np.std(draws @ [np.cos(one), np.sin(one)]) for one in angles)
    assert first.horiz_accuracy == pytest.approx(widest_m, rel=0.01)
    unknown = gps_input(invented(1, covariance=None).fixes[0], START_NS, None)
    assert unknown.ignore_flags - first.ignore_flags == 64
    assert (unknown.time_week, unknown.time_week_ms) == (0, 0)


def test_a_fix_that_is_not_accepted_is_no_fix_of_a_receiver():
    sent = departures(invented(2, is_accepted=[True, False]), has_all=True)
    assert [message_of(one, "gps_input", origin_of(sent), 0, None).fix_type for one in sent] == [3, 1]


@pytest.mark.parametrize(
    ("moment", "leaps"),
    [((2016, 12, 31, 23, 59, 59), 17), ((2017, 1, 1), 18), ((2026, 5, 1, 10), 18), ((1981, 7, 1), 1)],
)
def test_weeks_of_gps_run_ahead_of_utc_by_the_leap_seconds_of_the_date(moment, leaps):
    utc = dt.datetime(*moment, tzinfo=dt.UTC)
    since = utc - dt.datetime(1980, 1, 6, tzinfo=dt.UTC) + dt.timedelta(seconds=leaps)
    assert week_of_utc(utc.timestamp()) == (since.days // 7, (since.days % 7 * 86_400 + since.seconds) * 1000)


def test_fixes_leave_after_their_delay_and_at_most_so_many_a_second():
    flight = invented(4, delay_s=[0.5, 0.25, 2.5, 1.75])
    assert [one.sent_s for one in departures(flight)] == [0.5, 1.25, 4.5, 4.75]
    assert [one.view_s for one in departures(flight)] == [0.0, 1.0, 2.0, 3.0]
    assert [one.sent_s for one in departures(flight, delay_s=0.0)] == [0.0, 1.0, 2.0, 3.0]
    assert [one.sent_s for one in departures(invented(5), delay_s=1.0, rate_hz=0.5)] == [1.0, 3.0, 5.0]


def test_what_cannot_be_sent_is_refused():
    with pytest.raises(ConfigError, match="none of 5 fixes is accepted: --all takes them "):
        departures(invented(is_accepted=False))
    with pytest.raises(ConfigError, match="how long the answer to view view-0 took: give --delay SECONDS"):
        departures(invented(delay_s=None))
    with pytest.raises(ConfigError, match="--origin is longitude and latitude"):
        Origin(lon_deg=9.5, lat_deg=math.nan)


def test_a_row_tells_when_a_message_was_sent_to_the_nanosecond():
    row = row_of(vision(invented(), 0), 1_777_629_600 * NS + 7)
    assert row[0] == "1777629600.000000007"
