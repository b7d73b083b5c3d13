# SPDX-License-Identifier: Apache-2.0
"""Fly a path: speeds, corners, heights and attitudes over time, within limits and with the tilt of real drones.

The drone is a multirotor. It cruises at a steady speed and slows down where the path bends, so that turn rate, side
force and acceleration keep their limits. Its thrust leans to carry three things: drag of the air (speed less wind),
acceleration, and the centripetal force of a turn (a coordinated turn). Wind is a steady part and gusts; gusts, crab
angle and height are slow Gauss-Markov processes of second order, whose rates are finite.

`RIDE` was set so that flights have the percentiles of real ones (docs/concepts/flights.md shows both).
"""

import math
from dataclasses import dataclass
from typing import Final, Literal, get_args

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.ndimage import gaussian_filter1d

from sasgeo_bench.core.errors import FlightError
from sasgeo_bench.flights.trajectory import Trajectory
from sasgeo_bench.geometry.pose import bearing_deg, wrap_deg

Floats = NDArray[np.float64]
Carriage = Literal["body", "gimbal"]

GRAVITY_MPS2: Final = 9.80665
MOST_POINTS: Final = 1_000_000  # of a path, after it is sampled

_STEP_M: Final = 0.5  # between samples of a path
_EASING_M: Final = 1.5  # standard deviation of the smoothing of a path: curvature begins and ends gradually
_EASING_S: Final = 0.4  # the same of attitudes: a drone does not lean at once
_SHARPEST_DEG: Final = 170.0  # a sharper turn is a way back
_STRAIGHT: Final = 1e-9  # curvature, 1/m: less is none


@dataclass(frozen=True, slots=True, kw_only=True)
class Limits:
    """What a drone may do in the air; raise `FlightError` where a value cannot be.

    Parameters
    ----------
    speed_mps : (float, float)
        Least and most cruising speed, metres a second; a flight draws its own from between.
    corner_mps : float
        Speed in the sharpest corners, metres a second. It decides how widely a path is rounded (`turn_radius_m`).
    turn_rate_deg_s : float
        Most change of course, degrees a second.
    acceleration_mps2 : float
        Most gain or loss of speed, metres a second squared.
    climb_mps : float
        Most climb or descent, metres a second.
    tilt_deg : float
        Most lean of the thrust; it limits the side force in turns.

    Examples
    --------
    A corner at 3 m/s takes a radius of 2.3 m; a drone that keeps 12 m/s needs 33 m:

    >>> round(Limits().turn_radius_m, 1), round(Limits(speed_mps=(12.0, 12.0), corner_mps=12.0).turn_radius_m)
    (2.3, 33)
    """

    speed_mps: tuple[float, float] = (8.0, 12.0)
    corner_mps: float = 3.0
    turn_rate_deg_s: float = 75.0
    acceleration_mps2: float = 2.6
    climb_mps: float = 3.0
    tilt_deg: float = 24.0

    def __post_init__(self) -> None:
        slow, fast = self.speed_mps
        values = (slow, self.corner_mps, self.turn_rate_deg_s, self.acceleration_mps2, self.climb_mps, self.tilt_deg)
        if not all(math.isfinite(value) and value > 0 for value in (*values, fast)):
            raise FlightError(f"limits of a flight are positive numbers, got {self!r}")
        if not self.corner_mps <= slow <= fast:
            raise FlightError(f"corner_mps, and the least and most of speed_mps must not fall, got {self!r}")
        if not self.tilt_deg < 90:  # level
            raise FlightError(f"tilt_deg is less than 90, got {self.tilt_deg!r}")

    @property
    def side_mps2(self) -> float:
        """Return the most acceleration across the path, by the lean of the thrust."""
        return GRAVITY_MPS2 * math.tan(math.radians(self.tilt_deg))

    @property
    def turn_radius_m(self) -> float:
        """Return the radius of the sharpest corner, flown at `corner_mps`."""
        by_rate_m = self.corner_mps / math.radians(self.turn_rate_deg_s)
        return max(by_rate_m, self.corner_mps**2 / self.side_mps2)


@dataclass(frozen=True, slots=True, kw_only=True)
class Ride:
    """Wind, drag and unsteadiness of a flight; standard deviations (sd) and time constants (tau).

    `drag_per_s` is the drag of the air per mass and speed; `wind_mps` the most likely speed of the steady wind.
    `crab_deg` are mean and sd of course less heading. `gimbal_deg` are the lean of a gimbal ahead and the sd of its
    errors in pitch and roll.
    """

    drag_per_s: float = 0.157
    wind_mps: float = 2.0
    gust_sd_mps: float = 0.8
    gust_tau_s: float = 2.5
    crab_deg: tuple[float, float] = (-1.25, 2.1)
    crab_tau_s: float = 7.0
    gimbal_deg: tuple[float, float] = (4.6, 1.9)
    gimbal_tau_s: float = 4.0
    height_sd_m: float = 0.5
    height_tau_s: float = 8.0


DEFAULT_LIMITS: Final = Limits()
RIDE: Final = Ride()


@dataclass(frozen=True, slots=True, kw_only=True)
class _Motion:
    """A path over time: N samples at even times."""

    time_s: Floats
    en_m: Floats  # (N, 2)
    course_deg: Floats  # unwrapped, clockwise from north
    speed_mps: Floats
    pull_mps2: Floats  # (N, 2) acceleration, east and north


def fly(
    polyline: ArrayLike,
    *,
    height_m: float | tuple[float, float],
    rng: np.random.Generator,
    limits: Limits = DEFAULT_LIMITS,
    carriage: Carriage = "body",
    step_s: float = 0.2,
) -> Trajectory:
    """Fly a path and return its poses over time.

    Parameters
    ----------
    polyline : array_like, shape (N, 2)
        Easting and northing of the path, metres. Corners are rounded by `limits.turn_radius_m`, on their inside.
    height_m : float or (float, float)
        Height above the ground, metres; a pair is the height at the start and at the end, with an even climb between.
    rng : numpy Generator
        Source of cruising speed, wind, gusts, crab angle and heights.
    limits : Limits
        Of speed, turn rate, acceleration, climb and lean.
    carriage : {"body", "gimbal"}
        What carries the camera: the body, which leans to fly, or a gimbal with a few degrees of lean.
    step_s : float
        Seconds between poses.

    Returns
    -------
    Trajectory
        From the first point to the last, in the frame of the polyline, third axis height above the ground. The flight
        begins and ends in the air, at speed.

    Raises
    ------
    FlightError
        If the polyline has fewer than two distinct points, turns back on itself or is too long, or if the climb is
        steeper than the limits allow.

    Examples
    --------
    A street corner: the drone slows down to turn, and its body points along the new street in the end.

    >>> flown = fly([[0, 0], [0, 200], [200, 200]], height_m=80.0, rng=np.random.default_rng(1))
    >>> speed_mps = np.diff(flown.distance_m) / np.diff(flown.time_s)
    >>> speed_mps[0].round().item(), speed_mps.min().round().item(), abs(flown.yaw_deg[-1].item() - 90) < 10
    (10.0, 3.0, True)
    """
    if not (math.isfinite(step_s) and step_s > 0):
        raise FlightError(f"step_s must be positive, got {step_s!r}")
    if carriage not in get_args(Carriage):
        raise FlightError(f"carriage is one of {', '.join(get_args(Carriage))}, got {carriage!r}")
    path_m = _smooth(round_corners(polyline, limits.turn_radius_m))
    cruise_mps = rng.uniform(*limits.speed_mps)
    motion = _move(path_m, cruise_mps, limits, step_s)
    count = len(motion.time_s)
    mean_deg, sd_deg = RIDE.crab_deg
    crab_deg = mean_deg + sd_deg * _wander(rng, count, step_s, RIDE.crab_tau_s)
    yaw_deg = gaussian_filter1d(motion.course_deg, _EASING_S / step_s, mode="nearest") - crab_deg
    up_m = _heights(height_m, motion.time_s, limits, rng)
    is_fixed = carriage == "body"
    pitch_deg, roll_deg = _lean(motion, yaw_deg, limits, rng) if is_fixed else _gimbal(count, step_s, rng)
    position_m = np.column_stack([motion.en_m, up_m])
    return Trajectory.of_angles(
        time_s=motion.time_s, position_m=position_m, yaw_deg=yaw_deg, pitch_deg=pitch_deg, roll_deg=roll_deg
    )


def round_corners(polyline: ArrayLike, radius_m: float) -> Floats:
    """Replace corners of a polyline by arcs on their inside; where sides are short, by narrower ones.

    Turns of less than 15 degrees are left: they belong to curves. Raise `FlightError` for a polyline that has fewer
    than two distinct points, is not finite, or turns back on itself.

    >>> corner = round_corners([[0, 0], [0, 100], [100, 100]], 10.0)
    >>> corner[1].round(6).tolist(), corner[-2].round(6).tolist()
    ([0.0, 90.0], [10.0, 100.0])
    """
    line_m = _checked(polyline)
    sides = np.diff(line_m, axis=0)
    lengths_m = np.hypot(*sides.T)
    ahead = sides / lengths_m[:, None]
    turns = np.arctan2(_cross(ahead[:-1], ahead[1:]), (ahead[:-1] * ahead[1:]).sum(axis=1))
    back = np.flatnonzero(np.abs(turns) > math.radians(_SHARPEST_DEG))
    if len(back):
        raise FlightError(
            f"the path turns back on itself at point {back[0] + 2}: add points, so that it has room to turn"
        )
    parts = [line_m[:1]]
    for at, turn in enumerate(turns):
        corner_m, half_m = line_m[at + 1], min(lengths_m[at], lengths_m[at + 1]) / 2
        # 15 degrees: a smaller turn at a vertex belongs to a curve, and the smoothing takes it
        if abs(turn) < math.radians(15.0):
            parts.append(corner_m[None])
            continue
        tangent = math.tan(abs(turn) / 2)
        real_m = min(radius_m, half_m / tangent)
        start_m = corner_m - real_m * tangent * ahead[at]
        inward = math.copysign(1.0, turn) * np.array([-ahead[at, 1], ahead[at, 0]])
        angles = np.linspace(0.0, abs(turn), max(2, math.ceil(abs(turn) * real_m / _STEP_M) + 1))[:, None]
        parts.append(start_m + real_m * (np.sin(angles) * ahead[at] + (1 - np.cos(angles)) * inward))
    return np.asarray(np.concatenate([*parts, line_m[-1:]]))


def length_m(polyline: ArrayLike) -> float:
    """Return the length of a polyline, shape (N, 2), metres."""
    return float(np.hypot(*np.diff(np.asarray(polyline, dtype=np.float64), axis=0).T).sum())


def tilt_deg(flown: Trajectory) -> Floats:
    """Return the angle between the body's down and straight down at each pose, degrees.

    >>> level = Trajectory.of_angles(time_s=[0.0], position_m=[[0, 0, 80]], yaw_deg=[0.0], pitch_deg=-3.0, roll_deg=4.0)
    >>> tilt_deg(level).round(1).tolist()
    [5.0]
    """
    down = flown.rotation.apply([0.0, 0.0, 1.0])
    return np.asarray(np.degrees(np.arccos(np.clip(-down[:, 2], -1.0, 1.0))))


def yaw_rate_deg_s(flown: Trajectory) -> Floats:
    """Return how fast the heading changes between poses, shape (N - 1,), degrees a second, not negative."""
    return np.asarray(np.abs(wrap_deg(np.diff(flown.yaw_deg))) / np.diff(flown.time_s))


def crab_deg(flown: Trajectory) -> Floats:
    """Return course less heading halfway between poses, shape (N - 1,), degrees in [-180, 180)."""
    steps = np.diff(flown.position_m[:, :2], axis=0)
    half = wrap_deg(np.diff(flown.yaw_deg)) / 2
    return wrap_deg(bearing_deg(steps[:, 0], steps[:, 1]) - flown.yaw_deg[:-1] - half)


def _checked(polyline: ArrayLike) -> Floats:
    """Return a polyline without repeated points."""
    line_m = np.asarray(polyline, dtype=np.float64)
    if line_m.ndim != 2 or line_m.shape[1:] != (2,) or not np.isfinite(line_m).all():  # a table of pairs
        raise FlightError(f"a path has finite eastings and northings, shape (N, 2), got shape {line_m.shape}")
    # 1e-3 m, at least, between vertices
    kept = np.append(True, np.hypot(*np.diff(line_m, axis=0).T) > 1e-3)[: len(line_m)]
    line_m = np.asarray(line_m[kept])
    if len(line_m) < 2:  # a side
        raise FlightError(f"a path has two distinct points at least, got {len(line_m)}")
    if length_m(line_m) > _STEP_M * MOST_POINTS:
        raise FlightError(
            f"a path has {_STEP_M * MOST_POINTS / 1000:g} km at most, got {length_m(line_m) / 1000:g} km: cut it"
        )
    return line_m


def _smooth(line_m: Floats) -> Floats:
    """Return samples half a metre apart of a path whose curvature has no jumps."""
    along_m = np.append(0.0, np.cumsum(np.hypot(*np.diff(line_m, axis=0).T)))
    count = max(4, math.ceil(along_m[-1] / _STEP_M))
    even_m = np.linspace(0.0, along_m[-1], count + 1)
    path_m = np.stack([np.interp(even_m, along_m, axis) for axis in line_m.T], axis=1)
    reach = min(count, math.ceil(4 * _EASING_M / _STEP_M))
    padded = np.pad(path_m, ((reach, reach), (0, 0)), mode="reflect", reflect_type="odd")
    sigma = _EASING_M / (along_m[-1] / count)
    return np.asarray(gaussian_filter1d(padded, sigma, axis=0, truncate=4.0)[reach:-reach])


def _move(path_m: Floats, cruise_mps: float, limits: Limits, step_s: float) -> _Motion:
    from scipy.interpolate import CubicSpline  # noqa: PLC0415 - slow to import, and most processes fly nothing

    along_m = np.append(0.0, np.cumsum(np.hypot(*np.diff(path_m, axis=0).T)))
    curve = CubicSpline(along_m, path_m)
    first, second = curve(along_m, 1), curve(along_m, 2)
    bend = np.maximum(np.abs(_cross(first, second)), _STRAIGHT)
    speed_mps = np.minimum(math.radians(limits.turn_rate_deg_s) / bend, np.sqrt(limits.side_mps2 / bend))
    # 0.5 m/s: a path with a sharper bend than any drone flies is crept round
    speed_mps = np.clip(speed_mps, 0.5, cruise_mps)
    # Lower speeds so that none is reached or left faster than the acceleration allows
    squares, gains = (speed_mps**2).tolist(), (2 * limits.acceleration_mps2 * np.diff(along_m)).tolist()
    for at, gain in enumerate(gains):
        squares[at + 1] = min(squares[at + 1], squares[at] + gain)
    for at in range(len(gains) - 1, -1, -1):
        squares[at] = min(squares[at], squares[at + 1] + gains[at])
    speed_mps = np.asarray(np.sqrt(squares))
    spent_s = np.append(0.0, np.cumsum(2 * np.diff(along_m) / (speed_mps[1:] + speed_mps[:-1])))
    count = max(2, math.floor(spent_s[-1] / step_s) + 1)
    time_s = np.arange(count) * min(step_s, spent_s[-1])
    # Between samples of the path the acceleration is even.
    part = np.minimum(np.searchsorted(spent_s, time_s, side="right"), len(spent_s) - 1) - 1
    gain_mps2 = (np.diff(speed_mps**2) / np.diff(along_m) / 2)[part]
    now_mps = speed_mps[part] + gain_mps2 * (time_s - spent_s[part])
    at_m = along_m[part] + (speed_mps[part] + now_mps) / 2 * (time_s - spent_s[part])
    ahead, bent = curve(at_m, 1), curve(at_m, 2)
    return _Motion(
        time_s=time_s,
        en_m=curve(at_m),
        course_deg=np.degrees(np.unwrap(np.arctan2(ahead[:, 0], ahead[:, 1]))),
        speed_mps=now_mps,
        pull_mps2=gain_mps2[:, None] * ahead + now_mps[:, None] ** 2 * bent,
    )


def _lean(motion: _Motion, yaw_deg: Floats, limits: Limits, rng: np.random.Generator) -> tuple[Floats, Floats]:
    """Return pitch and roll of a body whose thrust carries drag, acceleration and turns."""
    count, step_s = len(motion.time_s), float(motion.time_s[1] - motion.time_s[0])
    steady_mps, turn = rng.rayleigh(RIDE.wind_mps), rng.uniform(0.0, 2 * np.pi)
    gusts = np.stack([_wander(rng, count, step_s, RIDE.gust_tau_s) for _ in range(2)], axis=1)
    wind_mps = steady_mps * np.array([math.sin(turn), math.cos(turn)]) + RIDE.gust_sd_mps * gusts
    course = np.radians(motion.course_deg)
    ground_mps = motion.speed_mps[:, None] * np.stack([np.sin(course), np.cos(course)], axis=1)
    force_mps2 = motion.pull_mps2 + RIDE.drag_per_s * (ground_mps - wind_mps)
    force_mps2 = gaussian_filter1d(force_mps2, _EASING_S / step_s, axis=0, mode="nearest")
    strength = np.hypot(*force_mps2.T)
    force_mps2 *= np.minimum(1.0, limits.side_mps2 / np.maximum(strength, _STRAIGHT))[:, None]
    yaw = np.radians(yaw_deg)
    ahead = (force_mps2 * np.stack([np.sin(yaw), np.cos(yaw)], axis=1)).sum(axis=1)
    right = (force_mps2 * np.stack([np.cos(yaw), -np.sin(yaw)], axis=1)).sum(axis=1)
    # The thrust points along (ahead, right, up) = (-sin pitch cos roll, sin roll, cos pitch cos roll).
    total = np.sqrt(ahead**2 + right**2 + GRAVITY_MPS2**2)
    return np.degrees(np.arctan2(-ahead, GRAVITY_MPS2)), np.degrees(np.arcsin(right / total))


def _gimbal(count: int, step_s: float, rng: np.random.Generator) -> tuple[Floats, Floats]:
    lean_deg, sd_deg = RIDE.gimbal_deg
    pitch, roll = (sd_deg * _wander(rng, count, step_s, RIDE.gimbal_tau_s) for _ in range(2))
    return lean_deg + pitch, roll


def _heights(height_m: float | tuple[float, float], time_s: Floats, limits: Limits, rng: np.random.Generator) -> Floats:
    """Return heights above the ground; the unsteadiness takes what the climb leaves of the limit."""
    first_m, last_m = height_m if isinstance(height_m, tuple) else (height_m, height_m)
    if not all(math.isfinite(value) and value > 0 for value in (first_m, last_m)):
        raise FlightError(f"height_m is above the ground, in metres, got {height_m!r}")
    climb_mps = abs(last_m - first_m) / time_s[-1]
    if climb_mps > limits.climb_mps:
        most_m = limits.climb_mps * time_s[-1]
        raise FlightError(
            f"from {first_m:g} to {last_m:g} m is too steep: this path leaves time for {most_m:.0f} m of climb"
        )
    step_s = float(time_s[1] - time_s[0])
    wander_m = RIDE.height_sd_m * _wander(rng, len(time_s), step_s, RIDE.height_tau_s)
    fastest_mps = float(np.abs(np.diff(wander_m)).max()) / step_s
    share = min(1.0, (limits.climb_mps - climb_mps) / max(fastest_mps, _STRAIGHT))
    return np.asarray(np.linspace(first_m, last_m, len(time_s)) + share * wander_m)


def _wander(rng: np.random.Generator, count: int, step_s: float, tau_s: float) -> Floats:
    """Return a stationary Gauss-Markov process of second order, critically damped, with a standard deviation of 1."""
    # Two equal filters of first order in a row; their joint gain is (1 + a^2) / (1 - a^2)^3.
    from scipy.signal import lfilter  # noqa: PLC0415 - slow to import, and most processes fly nothing

    keep = math.exp(-step_s / tau_s)
    before = math.ceil(12.0 * tau_s / step_s)  # time constants before the start, after which a process is stationary
    gain = math.sqrt((1 - keep**2) ** 3 / (1 + keep**2))
    noise = gain * rng.standard_normal(before + count)
    return np.asarray(lfilter([1.0], [1.0, -2 * keep, keep**2], noise)[before:])


def _cross(left: Floats, right: Floats) -> Floats:
    return np.asarray(left[:, 0] * right[:, 1] - left[:, 1] * right[:, 0])
