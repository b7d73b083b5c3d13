# SPDX-License-Identifier: Apache-2.0
"""The motion that a video shows, held against a flight log: when it began by the log's clock, and which way is up."""

import math
from dataclasses import dataclass, field
from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

from sasgeo_bench.core.errors import FlightError
from sasgeo_bench.core.texts import plain
from sasgeo_bench.flights.log_points import FlightLog

Floats = NDArray[np.float64]

STEP_S: Final = 0.25  # between frames whose motion is measured
NEAR_S: Final = 60.0  # from where the clocks say: a clock that is set by hand is off by less

_FINE_S: Final = 0.05
_WINDOW_S: Final = 1.0  # over which motion is averaged: logs have a point a second
_WIDTH_PX: Final = 480
_POINTS: Final = 200
_LEAST_POINTS: Final = 12
_LEAST_S: Final = 10.0  # of flight that video and log share
_INDEPENDENT_S: Final = 2.0  # after which motion is another: accelerations of drones last so long
_STANDS_OUT: Final = 5.0  # natural logarithm of the likelihood, over all other times together
_FLAT: Final = 1e-9
_LOWEST_M: Final = 2.0
_MOVES_MPS: Final = 1.0  # below it a course is noise
_SIGMA_S: Final = 0.05  # at the least
_CARRIED_S: Final = 10.0  # for which turns that are seen carry a heading: they drift by a degree or two
_MOST_SIGMA_DEG: Final = 10.0  # of a heading that is worth saying: `locate` takes those of photos for as good
_DEGREE_M: Final = 111_195.0


@dataclass
class MotionSeen:
    """Measures how fast, and how it turned, a camera moved between frames that follow each other.

    Speeds are in widths of the picture per second: of a camera above level ground they are proportional to its own, as
    long as its height stays. Bearings of the way are clockwise from the picture's up, turns clockwise per second.
    """

    time_s: list[float] = field(default_factory=list)
    speed: list[float] = field(default_factory=list)
    bearing_deg: list[float] = field(default_factory=list)
    turn_degps: list[float] = field(default_factory=list)
    _last: tuple[float, NDArray[np.uint8]] | None = None

    def add(self, time_s: float, rgb: NDArray[np.uint8]) -> None:
        """Take the next frame; what cannot be followed from the one before is nan."""
        size = (_WIDTH_PX, max(16, round(_WIDTH_PX * rgb.shape[0] / rgb.shape[1])))
        grey = cv2.resize(cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY), size, interpolation=cv2.INTER_AREA)
        if self._last is not None and time_s > self._last[0]:
            gained_s = time_s - self._last[0]
            moved, bearing_deg, turned_deg = _moved(self._last[1], np.asarray(grey, dtype=np.uint8))
            self.time_s.append(time_s - gained_s / 2)
            self.speed.append(moved / gained_s)
            self.bearing_deg.append(bearing_deg)
            self.turn_degps.append(turned_deg / gained_s)
        self._last = (time_s, np.asarray(grey, dtype=np.uint8))


def _moved(before: NDArray[np.uint8], after: NDArray[np.uint8]) -> tuple[float, float, float]:
    """Return how far the camera moved, in widths; where to, from up clockwise; and how it turned clockwise, degrees."""
    points = cv2.goodFeaturesToTrack(before, maxCorners=_POINTS, qualityLevel=0.01, minDistance=8)
    if points is None or len(points) < _LEAST_POINTS:
        return math.nan, math.nan, math.nan
    there, is_found, _ = cv2.calcOpticalFlowPyrLK(before, after, points, None, winSize=(21, 21), maxLevel=4)  # type: ignore[call-overload]
    followed = is_found.ravel() == 1
    if followed.sum() < _LEAST_POINTS:
        return math.nan, math.nan, math.nan
    matrix, is_in = cv2.estimateAffinePartial2D(points[followed], there[followed], ransacReprojThreshold=2.0)
    if matrix is None or is_in.sum() < max(_LEAST_POINTS, followed.sum() / 3):
        return math.nan, math.nan, math.nan
    middle = np.array([before.shape[1] / 2, before.shape[0] / 2])
    shift = matrix[:, :2] @ middle + matrix[:, 2] - middle
    # What is seen moves and turns against the camera; rows count downwards, so that a positive angle is clockwise.
    turned_deg = -math.degrees(math.atan2(matrix[1, 0], matrix[0, 0]))
    # From halfway between both: the first picture's up turns on.
    bearing_deg = math.degrees(math.atan2(-shift[0], shift[1])) - turned_deg / 2
    return float(np.hypot(*shift)) / before.shape[1], bearing_deg, turned_deg


@dataclass(frozen=True, slots=True, kw_only=True)
class Begin:
    """When a video began, seconds of the log's clock, with its standard deviation (0 if it was said)."""

    time_s: float
    sigma_s: float = 0.0


def find_begin(seen: MotionSeen, log: FlightLog, name: str, *, stated_s: float | None = None) -> Begin:
    """Return when a video began by a log's clock: where its motion and the log's agree far better than at other times.

    Parameters
    ----------
    seen : MotionSeen
        Of the video, from its begin.
    log : FlightLog
        With times.
    name : str
        Of the log, for messages.
    stated_s : float, optional
        By the clocks of video and log; times within a minute of it are tried alone where the whole log leaves it open.

    Raises
    ------
    FlightError
        If no time stands out, as of a straight flight at an even speed.
    """
    track = _Track.of(log)
    own = _own(seen)
    shared_s = min(len(own[0]) * STEP_S, track.length_s)
    spans = [(track.first_s - len(own[0]) * STEP_S, track.first_s + track.length_s)]
    if stated_s is not None:
        spans.append((stated_s - NEAR_S, stated_s + NEAR_S))
    for low_s, high_s in spans if shared_s >= _LEAST_S else ():
        found = _best(own, track, low_s, high_s, max(_LEAST_S, shared_s / 2))
        if found is not None:
            return found
    by_clock = "" if stated_s is None else f"; by their clocks it is --offset {stated_s:.1f}"
    raise FlightError(
        f"{plain(name)}: the motion that the video shows fits no one time of it (a straight flight at an even speed, "
        f"or another flight): say --offset S, at how many seconds of it the video begins{by_clock}"
    )


@dataclass(frozen=True, kw_only=True, eq=False)
class Headings:
    """Which way a picture's up pointed, degrees from true north, at times of a video; and its standard deviation."""

    time_s: Floats
    heading_deg: Floats
    sigma_deg: float

    def at(self, time_s: float) -> float:
        """Return the heading at a time of the video, degrees in [0, 360)."""
        return float(np.interp(time_s, self.time_s, self.heading_deg)) % 360.0


def find_headings(seen: MotionSeen, log: FlightLog, begin_s: float) -> Headings | None:
    """Return headings by the course that a log has, and the direction in which the picture moved; None if unknown.

    Turns that are seen carry a heading over seconds in which the drone hovers. A camera that looks ahead moves in its
    picture as one that looks down.
    """
    assert log.time_s is not None  # noqa: S101 - by the caller
    if not seen.time_s:
        return None
    times = np.array(seen.time_s)
    at = times + begin_s
    ends = [_metres(log, at + side * _WINDOW_S / 2) for side in (-1, 1)]
    way = ends[1] - ends[0]
    speed_mps = np.hypot(*way.T) / _WINDOW_S
    course_deg = np.degrees(np.arctan2(way[:, 0], way[:, 1]))
    turned_deg = np.concatenate([[0.0], np.cumsum(np.nan_to_num(seen.turn_degps)[:-1] * np.diff(times))])
    offset = np.exp(1j * np.radians(course_deg - np.array(seen.bearing_deg) - turned_deg))
    is_in = (at >= log.time_s[0]) & (at <= log.time_s[-1])
    is_known = np.isfinite(offset) & is_in & (speed_mps >= _MOVES_MPS)
    if is_known.sum() * STEP_S < _LEAST_S / 2:
        return None
    known_s, offset, power = times[is_known], offset[is_known], speed_mps[is_known] ** 2
    mean = np.empty(len(times), dtype=complex)
    sigmas_deg = np.empty(len(times))
    for row, time_s in enumerate(times):
        away_s = np.abs(known_s - time_s)
        weight = power * np.exp((away_s.min() - away_s) / _CARRIED_S)
        weight /= weight.sum()
        mean[row] = (weight * offset).sum()
        spread = math.sqrt(-2 * math.log(min(max(abs(mean[row]), 1e-6), 1 - 1e-9)))
        count = max(1.0, STEP_S / _INDEPENDENT_S / float((weight**2).sum()))
        sigmas_deg[row] = math.degrees(spread / math.sqrt(count))
    sigma_deg = float(np.median(sigmas_deg))
    if not sigma_deg <= _MOST_SIGMA_DEG:
        return None
    heading_deg = np.degrees(np.unwrap(np.angle(mean))) + turned_deg
    return Headings(time_s=times, heading_deg=heading_deg, sigma_deg=round(max(1.0, sigma_deg), 1))


def _metres(log: FlightLog, time_s: Floats) -> Floats:
    """Return places of a log, shape (N, 2), metres to the east and north, but for a factor."""
    lat = np.interp(time_s, log.time_s, log.lat_deg)  # type: ignore[arg-type]
    lon = np.interp(time_s, log.time_s, np.unwrap(log.lon_deg, period=360))  # type: ignore[arg-type]
    return np.column_stack([lon * np.cos(np.radians(log.lat_deg.mean())), lat]) * _DEGREE_M


@dataclass(frozen=True, kw_only=True)
class _Track:
    """Speed and turn rate of a log, every `_FINE_S` from its first point; nan where they are not known."""

    first_s: float
    speed: Floats
    turn_degps: Floats

    @property
    def length_s(self) -> float:
        return len(self.speed) * _FINE_S

    @classmethod
    def of(cls, log: FlightLog) -> "_Track":
        assert log.time_s is not None  # noqa: S101 - by the caller
        time_s = np.arange(log.time_s[0], log.time_s[-1], _FINE_S)
        way = _over_window(_metres(log, time_s)) / _WINDOW_S
        speed_mps = np.hypot(*way.T)
        if log.yaw_deg is not None:
            yaw_deg = np.interp(time_s, log.time_s, np.unwrap(log.yaw_deg, period=360))
        else:
            yaw_deg = np.degrees(np.unwrap(np.arctan2(way[:, 0], way[:, 1])))
            yaw_deg[speed_mps < _MOVES_MPS] = np.nan
        if log.height_m is not None:
            height_m = np.interp(time_s, log.time_s, log.height_m)
            speed_mps = np.where(height_m >= _LOWEST_M, speed_mps / np.maximum(height_m, _LOWEST_M), np.nan)
        turn_degps = _over_window(yaw_deg[:, None])[:, 0] / _WINDOW_S
        return cls(first_s=float(log.time_s[0]), speed=speed_mps, turn_degps=turn_degps)


def _over_window(values: Floats) -> Floats:
    """Return by how much columns change over the window around each row; nan at the ends."""
    half = round(_WINDOW_S / 2 / _FINE_S)
    changes = np.full(values.shape, np.nan)
    if len(values) > 2 * half:
        changes[half:-half] = values[2 * half :] - values[: -2 * half]
    return changes


def _own(seen: MotionSeen) -> tuple[Floats, Floats]:
    """Return speed and turn rate of the video every `STEP_S` from its begin, averaged as those of the log are."""
    if not seen.time_s:
        return np.empty(0), np.empty(0)
    at = np.arange(0, seen.time_s[-1], STEP_S)
    window = np.ones(round(_WINDOW_S / STEP_S) + 1)  # of an odd length, so that it moves nothing
    window[[0, -1]] = 0.5
    found = []
    for values in (np.array(seen.speed), np.array(seen.turn_degps)):
        is_known = np.isfinite(values)
        if is_known.sum() < 2:
            found.append(np.full(len(at), np.nan))
            continue
        times = np.array(seen.time_s)
        even = np.interp(at, times[is_known], values[is_known])
        after = np.searchsorted(times[is_known], at).clip(1, is_known.sum() - 1)
        nearest = np.minimum(*(np.abs(times[is_known][side] - at) for side in (after - 1, after)))
        smooth = np.convolve(even, window / window.sum(), mode="same")
        found.append(np.where(nearest <= _WINDOW_S, smooth, np.nan))
    return found[0], found[1]


def _best(own: tuple[Floats, Floats], track: _Track, low_s: float, high_s: float, least_s: float) -> Begin | None:
    """Return the time in a span at which motions agree; None if it does not stand out among all of the span."""
    coarse = np.arange(low_s, high_s, STEP_S)
    scores = np.array([_agreement(own, track, begin_s, least_s) for begin_s in coarse])
    if not len(scores) or not np.isfinite(scores).any():
        return None
    best_s = float(coarse[np.nanargmax(scores)])
    others = scores[(np.abs(coarse - best_s) > 2 * _INDEPENDENT_S) & np.isfinite(scores)]
    # All others together: that each of them is a chance of its own makes a long log no safer than a short one.
    rivals = math.log(1 + np.exp(others).sum() * STEP_S / _INDEPENDENT_S)
    if np.nanmax(scores) - rivals < _STANDS_OUT:
        return None
    fine = best_s + np.arange(-20, 21) * _FINE_S
    values = np.array([_agreement(own, track, begin_s, least_s) for begin_s in fine])
    top = int(np.nanargmax(values))
    near = slice(max(0, top - 8), top + 9)
    bend = np.polyfit(fine[near] - fine[top], values[near], 2) if np.isfinite(values[near]).all() else np.zeros(3)
    if bend[0] >= 0:
        return Begin(time_s=round(float(fine[top]), 2), sigma_s=_WINDOW_S)
    shift_s = float(np.clip(-bend[1] / (2 * bend[0]), -0.5, 0.5))
    sigma_s = max(_SIGMA_S, math.sqrt(-1 / (2 * bend[0])))
    return Begin(time_s=round(float(fine[top]) + shift_s, 2), sigma_s=round(sigma_s, 2))


def _agreement(own: tuple[Floats, Floats], track: _Track, begin_s: float, least_s: float) -> float:
    """Return the logarithm of how much likelier the video's motion is with the log's, than without; nan if unknown."""
    at = np.rint((begin_s - track.first_s + np.arange(len(own[0])) * STEP_S) / _FINE_S).astype(int)
    is_in = (at >= 0) & (at < len(track.speed))
    total = math.nan
    for seen, flown in zip(own, (track.speed, track.turn_degps), strict=True):
        one, other = seen[is_in], flown[at[is_in]]
        is_known = np.isfinite(one) & np.isfinite(other)
        if is_known.sum() * STEP_S < least_s:
            continue
        one, other = one[is_known] - one[is_known].mean(), other[is_known] - other[is_known].mean()
        power = math.sqrt(float((one**2).sum() * (other**2).sum()))
        share = max(0.0, float((one * other).sum()) / power) if power > _FLAT else 0.0
        count = is_known.sum() * STEP_S / _INDEPENDENT_S
        total = (0.0 if math.isnan(total) else total) - count / 2 * math.log(max(1 - share**2, 1e-6))
    return total
