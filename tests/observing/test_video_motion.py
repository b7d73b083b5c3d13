# SPDX-License-Identifier: Apache-2.0
"""When a video began by a log's clock: frames of a textured plane that is moved by plain arrays."""

import math
from collections.abc import Callable, Iterator
from dataclasses import replace

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from sasgeo_bench.core.errors import FlightError
from sasgeo_bench.flights.log_points import FlightLog
from sasgeo_bench.observing.video_motion import STEP_S, MotionSeen, find_begin, find_headings

LON, LAT = 9.52, 47.14
HEIGHT_M = 80.0
SIZE = (320, 180)
GROUND_M = 60.0  # across a picture
Flown = Callable[[float], tuple[float, float, float]]  # seconds -> east, north, heading


def winding(time_s: float) -> tuple[float, float, float]:
    """A flight of changing speed that turns now and then, its picture's up ahead."""
    along = 6.0 * time_s + 9.0 * math.sin(time_s / 3.1) + 5.0 * math.sin(time_s / 1.7 + 1.0)
    heading = 70.0 * math.sin(along / 60.0) + 25.0 * math.sin(along / 23.0 + 2.0)
    return along * math.sin(0.4), along * math.cos(0.4), heading


def other(time_s: float) -> tuple[float, float, float]:
    along = 7.0 * time_s + 12.0 * math.sin(time_s / 4.7 + 2.0)
    return along, 20.0 * math.sin(time_s / 6.3), 60.0 * math.sin(time_s / 5.3 + 1.0)


def straight(time_s: float) -> tuple[float, float, float]:
    return 8.0 * time_s, 0.0, 0.0


def log_of(path: Flown, seconds: float, *, yaw: bool = True, noise_m: float = 0.3) -> FlightLog:
    """A point a second, with a receiver's noise."""
    times = np.arange(0.0, seconds)
    east, north, heading = np.array([path(time_s) for time_s in times]).T
    rng = np.random.default_rng(7)
    east, north = east + noise_m * rng.standard_normal(len(times)), north + noise_m * rng.standard_normal(len(times))
    return FlightLog(
        time_s=times,
        lon_deg=LON + east / (111_195.0 * math.cos(math.radians(LAT))),
        lat_deg=LAT + north / 111_195.0,
        yaw_deg=heading % 360 if yaw else None,
    )


def seen_of(path: Flown, begin_s: float, seconds: float) -> MotionSeen:
    """The motion that is seen of a plane from above, from a time of the flight on."""
    seen = MotionSeen()
    for at, rgb in enumerate(seen_frames(path, begin_s, seconds)):
        seen.add(at * STEP_S, rgb)
    return seen


def seen_frames(path: Flown, begin_s: float, seconds: float) -> Iterator[NDArray[np.uint8]]:
    """The frames of a plane from above, one every `STEP_S`."""
    rng = np.random.default_rng(3)
    texture = cv2.resize(rng.integers(0, 256, (150, 150), dtype=np.uint8), (900, 900), interpolation=cv2.INTER_CUBIC)
    metres = GROUND_M / SIZE[0]
    for time_s in np.arange(0.0, seconds, STEP_S).tolist():
        east, north, heading = path(begin_s + time_s)
        turn = math.radians(heading)
        # The texture repeats, so that the flight may be long; its rows count to the south.
        cols, rows = np.meshgrid(np.arange(SIZE[0]) - SIZE[0] / 2, np.arange(SIZE[1]) - SIZE[1] / 2)
        right, ahead = cols * metres, -rows * metres
        x = east + right * math.cos(turn) + ahead * math.sin(turn)
        y = north - right * math.sin(turn) + ahead * math.cos(turn)
        at = np.stack([x / metres, -y / metres]).astype(np.float32)
        grey = cv2.remap(texture, at[0], at[1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_WRAP)
        yield np.repeat(grey[..., None], 3, axis=2)


@pytest.fixture(scope="module")
def wound() -> MotionSeen:
    return seen_of(winding, 33.3, 40.0)


def test_turns_and_speeds_are_those_of_the_camera(wound: MotionSeen) -> None:
    for time_s, speed, turn in list(zip(wound.time_s, wound.speed, wound.turn_degps, strict=True))[::7]:
        (east, north, before), (east_after, north_after, after) = (
            winding(33.3 + time_s + side * STEP_S / 2) for side in (-1, 1)
        )
        assert turn == pytest.approx((after - before) / STEP_S, abs=0.6)
        assert speed == pytest.approx(math.hypot(east_after - east, north_after - north) / STEP_S / GROUND_M, abs=0.006)


@pytest.mark.parametrize("yaw", [True, False])
def test_the_begin_is_found_in_a_long_log(wound, yaw):
    found = find_begin(wound, log_of(winding, 300.0, yaw=yaw), "a.gpx")
    assert found.time_s == pytest.approx(33.3, abs=max(0.15, 3 * found.sigma_s))
    assert found.sigma_s < 0.3


def test_a_camera_that_was_mounted_another_way_is_found_as_well(wound: MotionSeen) -> None:
    log = log_of(winding, 300.0)
    assert log.yaw_deg is not None
    turned = replace(log, yaw_deg=(log.yaw_deg + 143.0) % 360)
    assert find_begin(wound, turned, "a.gpx").time_s == pytest.approx(33.3, abs=0.3)


def test_a_video_that_begins_before_the_log_is_found_too() -> None:
    found = find_begin(seen_of(winding, 0.0, 60.0), replace_start(log_of(winding, 120.0), 12.0), "a.gpx")
    assert found.time_s == pytest.approx(-12.0, abs=0.3)


def replace_start(log: FlightLog, from_s: float) -> FlightLog:
    """The log from a time on, counted from there."""
    assert log.time_s is not None
    assert log.yaw_deg is not None
    kept = log.time_s >= from_s
    return FlightLog(
        time_s=log.time_s[kept] - from_s,
        lon_deg=log.lon_deg[kept],
        lat_deg=log.lat_deg[kept],
        yaw_deg=log.yaw_deg[kept],
    )


def test_headings_are_the_course_less_the_way_that_is_seen(wound: MotionSeen) -> None:
    """The picture's up swings by some hundred degrees about a course that stays, in which no log says a heading."""
    found = find_headings(wound, log_of(winding, 300.0, yaw=False), 33.3)
    assert found is not None
    assert found.sigma_deg < 5.0
    for time_s in (3.0, 10.0, 20.0, 30.0, 38.0):
        off_deg = (found.at(time_s) - winding(33.3 + time_s)[2] + 180) % 360 - 180
        assert off_deg == pytest.approx(0.0, abs=max(3 * found.sigma_deg, 6.0))


def test_turns_carry_a_heading_over_a_hover() -> None:
    def flown(time_s: float) -> tuple[float, float, float]:
        """To the east for 10 s, then a turn by 90 degrees on the spot."""
        return 7.0 * min(time_s, 10.0), 0.0, 90.0 + 9.0 * min(max(time_s - 12.0, 0.0), 10.0)

    found = find_headings(seen_of(flown, 0.0, 26.0), log_of(flown, 40.0, yaw=False, noise_m=0.1), 0.0)
    assert found is not None
    assert found.at(5.0) == pytest.approx(90.0, abs=4.0)
    assert found.at(25.0) == pytest.approx(180.0, abs=5.0)


def test_where_nothing_moves_no_heading_is_known() -> None:
    log = log_of(lambda _: (0.0, 0.0, 0.0), 60.0)
    assert find_headings(seen_of(lambda _: (0.0, 0.0, 0.0), 0.0, 20.0), log, 0.0) is None
    assert find_headings(MotionSeen(), log, 0.0) is None


@pytest.mark.parametrize(
    ("flown", "logged"), [(straight, straight), (winding, other), (other, straight)], ids=["straight", "other", "none"]
)
def test_where_no_time_stands_out_one_line_asks(flown: Flown, logged: Flown) -> None:
    seen = seen_of(flown, 20.0, 30.0)
    with pytest.raises(FlightError, match=r"fits no one time of it .* say --offset S") as error:
        find_begin(seen, log_of(logged, 200.0), "a.gpx", stated_s=12.0)
    assert "by their clocks it is --offset 12.0" in str(error.value)


def test_a_still_picture_or_a_short_video_tells_nothing() -> None:
    log = log_of(winding, 100.0)
    still = MotionSeen()
    for at in range(80):
        still.add(at * STEP_S, np.full((90, 160, 3), 90, dtype=np.uint8))
    for seen in (still, MotionSeen(), seen_of(winding, 20.0, 5.0)):
        with pytest.raises(FlightError, match="fits no one time"):
            find_begin(seen, log, "a.gpx")


def test_of_a_flight_that_repeats_itself_the_clocks_choose(wound: MotionSeen) -> None:
    """Twice the same way: the whole log leaves it open, and a minute around the clocks' time does not."""
    once = log_of(winding, 120.0)
    assert once.time_s is not None
    assert once.yaw_deg is not None
    twice = FlightLog(
        time_s=np.append(once.time_s, once.time_s + 600.0),
        lon_deg=np.append(once.lon_deg, once.lon_deg),
        lat_deg=np.append(once.lat_deg, once.lat_deg),
        yaw_deg=np.append(once.yaw_deg, once.yaw_deg),
    )
    with pytest.raises(FlightError, match="fits no one time"):
        find_begin(wound, twice, "a.gpx")
    assert find_begin(wound, twice, "a.gpx", stated_s=630.0).time_s == pytest.approx(633.3, abs=0.3)
