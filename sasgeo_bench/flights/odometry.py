# SPDX-License-Identifier: Apache-2.0
"""Odometry of a flight, with drift that lasts: increments between poses, and what the odometer believes of them.

Errors are drawn as processes over the distance flown, and a pose moves by their integrals. So errors of neighbouring
increments are alike, and those of a sum do not average out, as with truth plus white noise they would.
"""

import math
from dataclasses import dataclass
from typing import Final, Literal

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from sasgeo_bench.core.errors import FlightError
from sasgeo_bench.flights.drift_profile import DriftProfile
from sasgeo_bench.flights.trajectory import Trajectory
from sasgeo_bench.geometry.pose import reckon, wrap_deg

Floats = NDArray[np.float64]

_FEW: Final = 1e-3  # of a correlation length; below, closed forms cancel and their series are exact to 1e-9


@dataclass(frozen=True, slots=True, kw_only=True)
class Drawn:
    """A process at N poses, shape (N,), and its mean over each step between them, shape (N - 1,)."""

    values: Floats
    means: Floats


def draw_gauss_markov(steps_m: Floats, *, length_m: float, rng: np.random.Generator) -> Drawn:
    """Draw a stationary process of variance 1, with correlation exp(-distance / length), over steps, shape (N - 1,).

    Notes
    -----
    First-order Gauss-Markov (Ornstein-Uhlenbeck) process. Gillespie, Phys. Rev. E 54 (1996), Eqs. 3.2-3.4: the value
    after a step and the integral over it are jointly normal, given the value before.
    """
    u = steps_m / length_m
    kept, rest = np.exp(-u), -np.expm1(-u)
    value_sd = np.sqrt(-np.expm1(-2 * u))
    # Of the integral over the step, in units of the length: what of it the new value tells, and the remainder.
    explained = np.divide(rest**2, value_sd, out=np.zeros_like(u), where=value_sd > 0)
    remainder = np.where(u > _FEW, 2 * u - 4 * rest - np.expm1(-2 * u) - explained**2, u**3 / 6)
    first, second = rng.standard_normal((2, len(u)))
    values = np.empty(len(u) + 1)
    values[0] = rng.standard_normal()
    for at in range(len(u)):
        values[at + 1] = kept[at] * values[at] + value_sd[at] * first[at]
    integrals = rest * values[:-1] + explained * first + np.sqrt(np.maximum(remainder, 0.0)) * second
    return Drawn(values=values, means=np.divide(integrals, u, out=values[:-1].copy(), where=u > 0))


def draw_walk(steps_m: Floats, *, rng: np.random.Generator) -> Drawn:
    """Draw a random walk that begins at 0, of variance 1 after a metre, over steps, shape (N - 1,)."""
    first, second = rng.standard_normal((2, len(steps_m)))
    change = np.sqrt(steps_m) * first
    values = np.concatenate([[0.0], np.cumsum(change)])
    return Drawn(values=values, means=values[:-1] + change / 2 + np.sqrt(steps_m / 12) * second)


def mean_variance(steps_m: Floats, *, length_m: float) -> Floats:
    """Return the variance of the mean of `draw_gauss_markov` over steps.

    It falls with the step, but the variance of the distance that it displaces grows:

    >>> variance = mean_variance(np.array([1.0, 100.0]), length_m=5.0)
    >>> variance.round(3).tolist(), (variance * np.array([1.0, 100.0]) ** 2).round(1).tolist()
    ([0.937, 0.095], [0.9, 950.0])
    """
    u = np.asarray(steps_m, dtype=np.float64) / length_m
    exact = np.divide(2 * (u + np.expm1(-u)), u**2, out=np.ones_like(u), where=u > _FEW)
    return np.where(u > _FEW, exact, 1 - u / 3)


@dataclass(frozen=True, slots=True, kw_only=True)
class HeadingLaw:
    """Second moments over one step, for a step variance of 1 per metre: of the change, of the mean since the start.

    All have the shape of the steps. `change` is the variance of the change over the step, `mean` that of the mean
    difference to the step's start, `both` their covariance.
    """

    change: Floats
    mean: Floats
    both: Floats


def heading_law(steps_m: Floats, *, length_m: float | None) -> HeadingLaw:
    """Return the second moments of a heading that walks, or that saturates with a correlation length.

    >>> law = heading_law(np.array([30.0, 3000.0]), length_m=100.0)
    >>> law.change.round(1).tolist()  # 30 for a walk; 100 at most
    [25.9, 100.0]
    """
    steps = np.asarray(steps_m, dtype=np.float64)
    if length_m is None:
        return HeadingLaw(change=steps.copy(), mean=steps / 3, both=steps / 2)
    u = steps / length_m
    share = np.divide(-np.expm1(-u), u, out=np.ones_like(u), where=u > 0)  # correlation of a step's mean with its end
    half = length_m / 2  # variance at one pose
    mean = np.where(u > _FEW, half * (mean_variance(steps, length_m=length_m) + 1 - 2 * share), steps / 3)
    return HeadingLaw(change=-2 * half * np.expm1(-u), mean=mean, both=half * -np.expm1(-u))


def lattice_covariance(count: int, step_m: float, *, length_m: float) -> Floats:
    """Return the covariance of the means of `draw_gauss_markov` over equal steps, shape (count, count)."""
    u = step_m / length_m
    apart = np.abs(np.subtract.outer(np.arange(count), np.arange(count)))
    spread = (math.sinh(u / 2) / (u / 2)) ** 2
    found = spread * np.exp(-u * apart)
    np.fill_diagonal(found, mean_variance(np.array([step_m]), length_m=length_m)[0])
    return np.asarray(found)


def lattice_heading(count: int, step_m: float, *, length_m: float | None) -> Floats:
    """Return the covariance of mean headings over equal steps, each less that at the first pose; variance 1 per metre.

    Shape (count, count). Steps are taken at their middles, which is exact but for a twelfth of a step.
    """
    at = (np.arange(count) + 0.5) * step_m
    if length_m is None:
        return np.asarray(np.minimum.outer(at, at))
    kept = np.exp(-at / length_m)
    among = np.exp(-np.abs(np.subtract.outer(at, at)) / length_m)
    return np.asarray(length_m / 2 * (among - kept[:, None] - kept[None, :] + 1))


Bools = NDArray[np.bool_]
Belief = Literal["honest", "optimistic"]

LOST_M: Final = 1e4  # standard deviations of a lost increment
LOST_DEG: Final = 180.0
_LOST: Final = np.diag([LOST_M**2, LOST_M**2, LOST_DEG**2])
_FLOOR_M: Final = 1e-3  # believed of any increment, drifting or not, so that a covariance can be inverted
_FLOOR_DEG: Final = 1e-3
_SCALE_M: Final = 100.0  # distance at which a profile gives its drift of heading
_M_PER_KM: Final = 1000.0
_PERCENT: Final = 100.0


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Odometry:
    """N - 1 increments between N poses.

    Parameters
    ----------
    right_m, up_m : ndarray, shape (N - 1,)
        Displacement in the axes of the pose before, metres; up is where the body heads. 0 where lost.
    yaw_deg : ndarray, shape (N - 1,)
        Turn, clockwise, [-180, 180) degrees. 0 where lost.
    covariance : ndarray, shape (N - 1, 3, 3)
        Of one increment, in the order right, up, yaw; m2, m deg and deg2. Errors of neighbouring increments are
        correlated, so a sum is worse than its covariances say, as with any odometer.
    is_lost : ndarray of bool, shape (N - 1,)
        True where the odometer says nothing; the covariance is that of 10 km and 180 degrees.

    Raises
    ------
    FlightError
        If shapes do not fit.
    """

    right_m: Floats
    up_m: Floats
    yaw_deg: Floats
    covariance: Floats
    is_lost: Bools

    def __post_init__(self) -> None:
        """Check the shapes; keep own arrays, read-only."""
        count = len(self.right_m)
        shapes = {"right_m": (), "up_m": (), "yaw_deg": (), "covariance": (3, 3), "is_lost": ()}
        for name, rest in shapes.items():
            values = np.array(getattr(self, name))
            if values.shape != (count, *rest):
                raise FlightError(f"{name} of {count} increments has shape {values.shape}")
            values.flags.writeable = False
            object.__setattr__(self, name, values)

    def __len__(self) -> int:
        return len(self.right_m)


def draw_odometry(
    flown: Trajectory, profile: DriftProfile, *, belief: Belief = "honest", rng: np.random.Generator
) -> Odometry:
    """Draw what an odometer says of a flight.

    Parameters
    ----------
    flown : Trajectory
        N poses, two at least; increments lie between them.
    profile : DriftProfile
        Drift over the path flown, in which climbs count.
    belief : {"honest", "optimistic"}
        Covariances that fit the errors of single increments over many runs, or standard deviations a third of these.
    rng : numpy.random.Generator
        Source of all errors; the same state gives the same odometry.

    Returns
    -------
    Odometry
        N - 1 increments.

    Raises
    ------
    FlightError
        If there is one pose alone, or the belief is unknown.

    Notes
    -----
    A step z = right + i up becomes z exp(a - i (h + c)): a is the mean error of the logarithm of length over the step,
    c that of the course, h the mean error of heading that has come up since the step began. Heading errors before the
    step do not matter: the increment is in the axes that the odometer believes in. All are integrals of processes
    over distance (`sasgeo_bench.flights.odometry`), so twice as many poses have the same drift after the same
    distance. Nothing drifts while hovering.

    An odometer knows of its own resets: their increment has the covariance of the jump.

    Examples
    --------
    One kilometre north in steps of 10 m. The error is no noise of single steps: a run that is 1.5 % long stays so, and
    heading walks away.

    >>> from sasgeo_bench.flights.drift_profile import load_profile
    >>> places = [[0.0, 10.0 * step, 80.0] for step in range(101)]
    >>> flown = Trajectory.of_angles(time_s=np.arange(101.0), position_m=places, yaw_deg=np.zeros(101))
    >>> steps = draw_odometry(flown, load_profile("wheel-poor"), rng=np.random.default_rng(7))
    >>> steps.up_m[[0, 50, 99]].round(2).tolist()
    [10.15, 10.15, 10.15]
    >>> dead_reckon(flown, steps).yaw_deg[[25, 50, 100]].round(1).tolist()
    [0.9, 359.3, 354.2]
    """
    if len(flown) == 1 or belief not in ("honest", "optimistic"):
        raise FlightError(
            f"odometry needs two poses and the belief 'honest' or 'optimistic', got {len(flown)} and {belief!r}"
        )
    steps_m = path_steps_m(flown)
    step, law = _true_steps(flown), _Law(profile=profile, steps_m=steps_m)
    drift = law.draw(rng)
    is_lost = _draw_lost(steps_m, profile, rng)
    moved = step * np.exp(drift.log_length - 1j * drift.course_rad) + drift.jump_m
    # Of what the odometer takes for its way: covariances of the true steps would tell their length.
    believed = _Law(profile=profile, steps_m=np.abs(moved))
    # 3: an optimistic odometer believes a third of its standard deviations
    covariance = believed.covariance(moved, drift.resets) / (3.0**2 if belief == "optimistic" else 1.0)
    covariance[is_lost] = _LOST
    yaw_deg = wrap_deg(wrap_deg(np.diff(flown.yaw_deg)) + np.degrees(drift.turn_rad) + drift.jump_deg)
    return Odometry(
        right_m=np.where(is_lost, 0.0, moved.real),
        up_m=np.where(is_lost, 0.0, moved.imag),
        yaw_deg=np.where(is_lost, 0.0, yaw_deg),
        covariance=covariance,
        is_lost=is_lost,
    )


def _draw_lost(steps_m: Floats, profile: DriftProfile, rng: np.random.Generator) -> Bools:
    """Draw which steps are lost: any that touches a dropout."""
    ends = np.cumsum(steps_m)
    begins = np.sort(rng.uniform(0, ends[-1], size=rng.poisson(profile.dropouts.per_km * ends[-1] / _M_PER_KM)))
    lengths = rng.exponential(profile.dropouts.length_m, size=len(begins))
    first, after = np.searchsorted(ends, begins, side="right"), np.searchsorted(ends - steps_m, begins + lengths)
    edges = np.zeros(len(steps_m) + 1, dtype=np.int64)
    np.add.at(edges, first, 1)
    np.add.at(edges, after, -1)
    return np.asarray(np.cumsum(edges[:-1]) > 0)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class LoggedSteps:
    """What the odometer of a log says of the N - 1 steps between N moments of a flight, in its own metres.

    Parameters
    ----------
    right_m, up_m : ndarray, shape (N - 1,)
        Displacement in the axes of the pose before, as of `Odometry`; any number where it says nothing.
    yaw_deg : ndarray, shape (N - 1,)
        Turn, clockwise, degrees; NaN of an odometer without headings of its own.
    is_logged : ndarray of bool, shape (N - 1,)
        Whether the log has odometry of the step: no receiver was fused, and the odometer ran.
    is_lost : ndarray of bool, shape (N - 1,)
        Of those that are logged, where the odometer was silent or began anew.
    """

    right_m: Floats
    up_m: Floats
    yaw_deg: Floats
    is_logged: Bools
    is_lost: Bools

    def over(self, drawn: Odometry, profile: DriftProfile, *, belief: Belief = "honest") -> Odometry:
        """Return odometry that is the log's where it has some, and elsewhere that which was drawn.

        Parameters
        ----------
        drawn : Odometry
            By a profile, of the same steps. Its turns stay where the log's odometer has no headings of its own: those
            of the vehicle are the truth's, and would be turns without an error.
        profile : DriftProfile
            The noise that the odometer declares of each step.
        belief : {"honest", "optimistic"}
            As `draw_odometry` takes it.

        Returns
        -------
        Odometry
            Its covariances are the profile's law over the way that the odometer took itself to go, never what was
            measured against the receiver on this flight: the receiver is the truth, and an odometer that knows how far
            it is off in this very hour has looked at it. So they may be too small, or too large, for this drone.

        Examples
        --------
        An odometer that is 2 % long on the first of two steps, and silent on the other:

        >>> from sasgeo_bench.flights.drift_profile import load_profile
        >>> flown = Trajectory.of_angles(
        ...     time_s=[0.0, 5.0, 10.0], position_m=[[0, 0, 80], [0, 50, 80], [0, 100, 80]], yaw_deg=[0.0, 0.0, 0.0]
        ... )
        >>> profile = load_profile("perfect")
        >>> drawn = draw_odometry(flown, profile, rng=np.random.default_rng(0))
        >>> own = LoggedSteps(
        ...     right_m=np.zeros(2),
        ...     up_m=np.array([51.0, np.nan]),
        ...     yaw_deg=np.zeros(2),
        ...     is_logged=np.array([True, False]),
        ...     is_lost=np.zeros(2, dtype=bool),
        ... )
        >>> own.over(drawn, profile).up_m.tolist()
        [51.0, 50.0]
        """
        moved = np.where(self.is_logged & ~self.is_lost, self.right_m + 1j * self.up_m, 0.0)
        law = _Law(profile=profile, steps_m=np.abs(moved))
        # 3: as of what is drawn
        declared = law.covariance(moved, np.zeros(len(moved), dtype=np.int64)) / (
            3.0**2 if belief == "optimistic" else 1.0
        )
        declared[self.is_lost] = _LOST
        turned = np.where(np.isfinite(self.yaw_deg), self.yaw_deg, drawn.yaw_deg)
        is_lost = np.where(self.is_logged, self.is_lost, drawn.is_lost)
        return Odometry(
            right_m=np.where(self.is_logged, moved.real, drawn.right_m),
            up_m=np.where(self.is_logged, moved.imag, drawn.up_m),
            yaw_deg=np.where(is_lost, 0.0, np.where(self.is_logged, turned, drawn.yaw_deg)),
            covariance=np.where(self.is_logged[:, None, None], declared, drawn.covariance),
            is_lost=is_lost,
        )

    def off(self, flown: Trajectory) -> tuple[float, float]:
        """Return the medians of how far the log's steps are off a flight: percent of the way, and degrees.

        NaN where no step is compared; steps of less than a metre are not.
        """
        true, is_told = _true_steps(flown), self.is_logged & ~self.is_lost
        is_way = is_told & (np.abs(true) > 1.0)
        off_pct = _PERCENT * np.abs(self.right_m + 1j * self.up_m - true)[is_way] / np.abs(true)[is_way]
        off_deg = np.abs(wrap_deg(self.yaw_deg - np.diff(flown.yaw_deg)))[is_told & np.isfinite(self.yaw_deg)]
        return _median(off_pct), _median(off_deg)


def _median(values: Floats) -> float:
    return float(np.median(values)) if len(values) else math.nan


def dead_reckon(flown: Trajectory, steps: Odometry) -> Trajectory:
    """Return the trajectory that an odometer believes in, from the true first pose.

    Positions and headings follow from the increments, heights and tilt are those of the flight. Poses within a lost
    stretch are left out, and after it the odometer goes on from where it was: it never learns how far it went.
    """
    yaw_deg = flown.yaw_deg[0] + np.concatenate([[0.0], np.cumsum(steps.yaw_deg)])
    increments = np.stack([steps.right_m, steps.up_m, steps.yaw_deg], axis=1)
    place_m = reckon(flown.position_m[0, :2], float(flown.yaw_deg[0]), increments)
    position_m = np.column_stack([place_m, flown.position_m[:, 2]])
    turn = Rotation.from_euler("z", -wrap_deg(yaw_deg - flown.yaw_deg)[:, None], degrees=True)
    is_kept = ~np.concatenate([[False], steps.is_lost[:-1] & steps.is_lost[1:], [False]])
    return Trajectory(
        time_s=flown.time_s[is_kept],
        position_m=position_m[is_kept],
        quaternion_xyzw=(turn * flown.rotation).as_quat()[is_kept],
    )


def path_steps_m(flown: Trajectory) -> Floats:
    """Return the distances between successive poses, shape (N - 1,), metres; climbs count."""
    return np.asarray(np.linalg.norm(np.diff(flown.position_m, axis=0), axis=1))


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Drift:
    """Errors of each step; `resets` counts those until the step, its own included."""

    log_length: Floats
    course_rad: Floats
    turn_rad: Floats
    jump_m: NDArray[np.complex128]
    jump_deg: Floats
    resets: NDArray[np.int64]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Law:
    """A profile over the steps of one flight."""

    profile: DriftProfile
    steps_m: Floats

    def draw(self, rng: np.random.Generator) -> _Drift:
        profile, steps_m = self.profile, self.steps_m
        # Mean square 1: what a profile gives are standard deviations over all runs.
        factor = math.exp(rng.normal(-(profile.run_spread**2), profile.run_spread))
        is_reset = rng.random(len(steps_m)) < -np.expm1(-profile.resets.per_km * steps_m / _M_PER_KM)
        resets = np.cumsum(is_reset, dtype=np.int64)
        wander = draw_gauss_markov(steps_m, length_m=profile.scale.length_m, rng=rng).means
        along, across = (draw_gauss_markov(steps_m, length_m=profile.slip.length_m, rng=rng).means for _ in range(2))
        heading, rate = profile.heading, rng.standard_normal()
        # Saturating or not, the walk has the same variance per metre at first.
        scale = math.radians(heading.walk_deg_at_100m) / math.sqrt(_SCALE_M)
        if heading.length_m is None:
            walk = draw_walk(steps_m, rng=rng)
        else:
            walk = draw_gauss_markov(steps_m, length_m=heading.length_m, rng=rng)
            scale *= math.sqrt(heading.length_m / 2)
        bend = math.radians(heading.rate_deg_at_100m) / _SCALE_M * rate
        biases = np.concatenate(
            [[factor * profile.scale.bias_pct], np.full(int(resets[-1]), profile.resets.scale_pct)]
        ) * rng.standard_normal(int(resets[-1]) + 1)
        slip = profile.slip.sigma_pct / _PERCENT
        # A reset ends its step: the new scale begins with the next one.
        bias = biases[resets - is_reset] / _PERCENT
        jumps = rng.standard_normal((3, len(steps_m))) * is_reset
        return _Drift(
            log_length=bias + factor * (profile.scale.wander_pct / _PERCENT * wander + slip * along),
            course_rad=factor * (slip * across + scale * (walk.means - walk.values[:-1]) + bend * steps_m / 2),
            turn_rad=factor * (scale * np.diff(walk.values) + bend * steps_m),
            jump_m=profile.resets.position_m * (jumps[0] + 1j * jumps[1]),
            jump_deg=profile.resets.yaw_deg * jumps[2],
            resets=resets,
        )

    def covariance(self, step: NDArray[np.complex128], resets: NDArray[np.int64]) -> Floats:
        """Return the covariances of the increments over many runs, shape (N - 1, 3, 3); resets are known."""
        profile, steps_m = self.profile, self.steps_m
        is_reset = np.diff(resets, prepend=0) > 0
        bias = np.where(resets - is_reset > 0, profile.resets.scale_pct, profile.scale.bias_pct) / _PERCENT
        slip = (profile.slip.sigma_pct / _PERCENT) ** 2 * mean_variance(steps_m, length_m=profile.slip.length_m)
        wander = mean_variance(steps_m, length_m=profile.scale.length_m) * (profile.scale.wander_pct / _PERCENT) ** 2
        law = heading_law(steps_m, length_m=profile.heading.length_m)
        walk = math.radians(profile.heading.walk_deg_at_100m) ** 2 / _SCALE_M
        bend = (math.radians(profile.heading.rate_deg_at_100m) / _SCALE_M) ** 2 * steps_m**2
        # Errors of the logarithm of length, of the course and of the turn; the first is independent of the others.
        inner = np.zeros((len(steps_m), 3, 3))
        inner[:, 0, 0] = bias**2 + wander + slip
        inner[:, 1, 1] = slip + walk * law.mean + bend / 4
        inner[:, 1, 2] = inner[:, 2, 1] = walk * law.both + bend / 2
        inner[:, 2, 2] = walk * law.change + bend
        into = np.zeros((len(steps_m), 3, 3))
        into[:, 0, 0], into[:, 1, 0] = step.real, step.imag
        into[:, 0, 1], into[:, 1, 1] = step.imag, -step.real  # a clockwise turn of (right, up)
        into[:, 2, 2] = math.degrees(1.0)
        floor = np.diag([_FLOOR_M**2, _FLOOR_M**2, _FLOOR_DEG**2])
        jump = np.diag([profile.resets.position_m**2, profile.resets.position_m**2, profile.resets.yaw_deg**2])
        return np.asarray(into @ inner @ into.transpose(0, 2, 1) + floor + is_reset[:, None, None] * jump)


def _true_steps(flown: Trajectory) -> NDArray[np.complex128]:
    """Return right + i up of each step in the axes of the pose before, metres."""
    moved = np.diff(flown.position_m[:, :2], axis=0)
    return np.asarray((moved[:, 0] + 1j * moved[:, 1]) * np.exp(1j * np.radians(flown.yaw_deg[:-1])))
