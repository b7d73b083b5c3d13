# SPDX-License-Identifier: Apache-2.0
"""Drift of odometry, measured on estimates with truth: relative errors by segment length, resets and lost stretches."""

import itertools
import math
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Final

import numpy as np
import pandas as pd
from numpy.typing import NDArray
from scipy.optimize import nnls
from scipy.stats import chi2

from sasgeo_bench.core.config import check_document
from sasgeo_bench.core.errors import FlightError, counted
from sasgeo_bench.flights.drift_profile import DriftProfile, Dropouts, HeadingDrift, Resets, ScaleDrift, SlipDrift
from sasgeo_bench.flights.odometry import heading_law, lattice_covariance, lattice_heading, path_steps_m
from sasgeo_bench.flights.trajectory import Trajectory

Floats = NDArray[np.float64]
Plane = NDArray[np.complex128]  # east + i north, metres

LENGTHS_M: Final = (10.0, 50.0)
LOST_S: Final = 2.0
DRAWS: Final = 10_000
LEVEL: Final = 0.95
# Mean of the horizontal error, mean of the absolute error of heading, root of the mean square of the error of length.
FIGURES: Final = ("position_pct", "yaw_deg", "scale_pct")
RATES: Final = ("resets_per_km", "lost_per_km")

_JUMP_M: Final = 1.0
_JUMP_SHARE: Final = 0.1
_JUMP_DEG: Final = 10.0
_MOST_TILT_DEG: Final = 10.0
_NODES: Final = 10  # of the shortest segment
_MOST_NODES: Final = 1_000_000  # of a path
LEAST_SPREAD: Final = 0.02  # of points around their mean, in segment lengths, to tell a scale from
_M_PER_KM: Final = 1000.0
_PERCENT: Final = 100.0


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Stretch:
    """Poses without a reset or gap between them: true place, believed place, error of heading, path flown.

    All have shape (N,). `turn_rad` is counter-clockwise, believed less true, without jumps of a full turn.
    """

    flown: Plane
    believed: Plane
    turn_rad: Floats
    path_m: Floats

    def resampled(self, spacing_m: float) -> "Stretch":
        """Return the stretch at equal distances of path; raise `FlightError` if these are too many."""
        if not self.path_m[-1] <= _MOST_NODES * spacing_m:
            raise FlightError(
                f"a path of {self.path_m[-1]:g} m has more than {_MOST_NODES} steps of {spacing_m:g} m, a tenth of the "
                "shortest segment: choose longer ones, and check that positions are in metres"
            )
        path_m = np.arange(0.0, self.path_m[-1] + 1e-9, spacing_m)
        return Stretch(
            flown=_between(path_m, self.path_m, self.flown),
            believed=_between(path_m, self.path_m, self.believed),
            turn_rad=np.interp(path_m, self.path_m, self.turn_rad),
            path_m=path_m,
        )


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PairedRun:
    """One run of an odometer with its truth; runs of one `sequence` (flight) are one cluster."""

    sequence: str
    stretches: tuple[Stretch, ...]
    path_m: float  # tracked
    resets: int
    lost: int
    lost_m: float


def pair_run(truth: Trajectory, estimate: Trajectory, *, sequence: str, lost_s: float = LOST_S) -> PairedRun:
    """Pair the poses of an estimate with the truth at their times, and cut it where it jumps or is silent.

    Parameters
    ----------
    truth, estimate : Trajectory
        Of the same axes of the body, on one clock; both frames have their third axis up. The truth is straight
        between its poses; estimates outside its time are left out.
    sequence : str
        Flight that the run is of.
    lost_s : float
        Seconds without an estimate that are a lost stretch, if more than 1 m was flown. For keyframes choose more.

    Returns
    -------
    PairedRun
        A reset is a step whose error exceeds 1 m and a tenth of its length, or 10 degrees.

    Raises
    ------
    FlightError
        If the times do not overlap, attitudes differ by more than a turn about the vertical, or most steps are resets.
    """
    is_timed = (estimate.time_s >= truth.time_s[0]) & (estimate.time_s <= truth.time_s[-1])
    if is_timed.sum() < 2:  # one step
        raise FlightError(
            f"{is_timed.sum()} of {counted(len(estimate), 'pose')} of the estimate ({estimate.span_text()}) within the "
            f"time of the truth ({truth.span_text()}), two are needed: give both one clock, in seconds"
        )
    true = truth.at(estimate.time_s[is_timed])
    difference = (estimate.rotation[is_timed] * true.rotation.inv()).as_matrix()
    tilt_deg = float(np.median(np.degrees(np.arccos(np.clip(difference[:, 2, 2], -1, 1)))))
    if tilt_deg > _MOST_TILT_DEG:
        raise FlightError(
            f"estimate and truth differ by {tilt_deg:.0f} degrees of tilt, not by heading alone: "
            "give both the same axes of the body, and frames with their third axis up"
        )
    whole = Stretch(
        flown=_plane(true.position_m),
        believed=_plane(estimate.position_m[is_timed]),
        turn_rad=np.unwrap(
            np.arctan2(difference[:, 1, 0] - difference[:, 0, 1], difference[:, 0, 0] + difference[:, 1, 1])
        ),
        path_m=np.concatenate([[0.0], np.cumsum(path_steps_m(true))]),
    )
    return _cut(whole, np.diff(true.time_s) > lost_s, sequence)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Segments:
    """Errors of all segments of one length in one run, each shape (N,).

    A segment is aligned with the truth at its first pose, by place and heading. `position_pct` is the horizontal error
    at its end in percent of its path; `yaw_deg` the signed error of the turn, clockwise; `scale_pct` the logarithm of
    the scale of its points against the true ones (Umeyama, horizontal), NaN where it hardly moves.
    """

    position_pct: Floats
    yaw_deg: Floats
    scale_pct: Floats


def segment_errors(run: PairedRun, length_m: float, *, spacing_m: float) -> Segments:
    """Return the errors of the segments that begin every `spacing_m` of path, none across a reset or a gap."""
    count = round(length_m / spacing_m)
    parts = [
        _errors_of(part, count, spacing_m)
        for part in (stretch.resampled(spacing_m) for stretch in run.stretches)
        if len(part.path_m) > count
    ]
    empty = Segments(position_pct=np.empty(0), yaw_deg=np.empty(0), scale_pct=np.empty(0))
    joined = {
        name: np.concatenate([getattr(part, name) for part in (*parts, empty)])
        for name in ("position_pct", "yaw_deg", "scale_pct")
    }
    return Segments(**joined)


def spacing_of(lengths_m: Sequence[float]) -> float:
    """Return the spacing of segments, a tenth of the shortest; raise `FlightError` if a length is not positive."""
    if not lengths_m or not all(0 < length < math.inf for length in lengths_m):
        raise FlightError(f"lengths of segments are positive metres, at least one, got {list(lengths_m)}")
    return min(lengths_m) / _NODES


def measure_drift(
    runs: Sequence[PairedRun], *, lengths_m: Sequence[float] = LENGTHS_M, draws: int = DRAWS, seed: int = 0
) -> pd.DataFrame:
    """Measure drift with its intervals.

    Parameters
    ----------
    runs : sequence of PairedRun
        Runs of one odometer; those of one sequence are drawn together.
    lengths_m : sequence of float
        Lengths of segments, metres of path; rounded to a tenth of the shortest.
    draws, seed : int
        Bootstrap draws of sequences, and their seed.

    Returns
    -------
    DataFrame
        A row for each figure and length: `figure`, `length_m`, `value`, `lo`, `hi` (95 %), `sequences`, `segments`.
        Figures: `position_pct` (mean horizontal error), `yaw_deg` (mean absolute), `scale_pct` (root mean square); each
        with a `_rms` row. Then, with length NaN, `resets_per_km` and `lost_per_km` with exact Poisson intervals, and
        `lost_pct` of the path.

    Raises
    ------
    FlightError
        If there is no run, a length is not positive, or a path has more than a million steps of a tenth of the
        shortest. A length that no run reaches has NaN and no segments; of one sequence alone, `lo` and `hi` are NaN.

    Notes
    -----
    Relative errors of Geiger et al. (CVPR 2012) with the yaw-only alignment of Zhang and Scaramuzza (IROS 2018), at the
    first pose of each segment. A figure is the mean over sequences of each one's own; intervals are percentiles of a
    bootstrap over sequences. Segments overlap: their number says nothing of how sure a figure is. They begin and end on
    lines between poses, so poses should be no farther apart than a tenth of the shortest; a warning says if they are.

    Examples
    --------
    An odometer that is 1 % long, on a straight flight of 200 m:

    >>> places = [[2.0 * at, 0.0, 80.0] for at in range(101)]
    >>> flown = Trajectory.of_angles(time_s=np.arange(101.0), position_m=places, yaw_deg=np.zeros(101))
    >>> long = Trajectory.of_angles(time_s=np.arange(101.0), position_m=flown.position_m * 1.01, yaw_deg=np.zeros(101))
    >>> figures = measure_drift([pair_run(flown, long, sequence="a")], lengths_m=[50.0], draws=10)
    >>> figures[["figure", "value"]].head(3).round(3).values.tolist()
    [['position_pct', 1.0], ['yaw_deg', 0.0], ['scale_pct', 0.995]]
    """
    if not runs:
        raise FlightError("drift is measured on one run at least, got none")
    spacing_m = spacing_of(lengths_m)
    # Warn where poses are so far apart that lines between them hide errors
    steps_m = np.concatenate([np.diff(stretch.path_m) for run in runs for stretch in run.stretches])
    if steps_m.any() and (typical_m := float(np.median(steps_m[steps_m > 0]))) > 1.01 * spacing_m:
        message = (
            f"poses are {typical_m:.1f} m apart, farther than a tenth of {_NODES * spacing_m:g} m: "
            "errors over so short segments look smaller than they are, choose longer ones"
        )
        warnings.warn(message, stacklevel=2)
    rng = np.random.default_rng(seed)
    rows = [row for length in lengths_m for row in _length_rows(runs, length, spacing_m, draws, rng)]
    names = ["figure", "length_m", "value", "lo", "hi", "sequences", "segments"]
    return pd.DataFrame([*rows, *_rate_rows(runs)], columns=names)


def poisson_interval(count: int) -> tuple[float, float]:
    """Return the exact interval (95 %) of the mean of a Poisson count (Garwood, Biometrika 1936).

    Nothing seen does not mean never:

    >>> tuple(round(end, 2) for end in poisson_interval(0))
    (0.0, 3.69)
    """
    rest = (1 - LEVEL) / 2
    lo = float(chi2.ppf(rest, 2 * count)) / 2 if count else 0.0
    return lo, float(chi2.ppf(1 - rest, 2 * count + 2)) / 2


def _length_rows(
    runs: Sequence[PairedRun], length_m: float, spacing_m: float, draws: int, rng: np.random.Generator
) -> Iterator[dict[str, object]]:
    by_sequence: dict[str, list[Segments]] = {}
    for run in runs:
        found = segment_errors(run, length_m, spacing_m=spacing_m)
        if len(found.position_pct):
            by_sequence.setdefault(run.sequence, []).append(found)
    columns = {
        name: [np.concatenate([getattr(part, name) for part in parts]) for parts in by_sequence.values()]
        for name in FIGURES
    }
    segments = sum(map(len, columns["position_pct"]))
    for name, rms in [*((name, name == "scale_pct") for name in FIGURES), ("position_pct", True), ("yaw_deg", True)]:
        means = [np.nanmean(x**2 if rms else np.abs(x)) for x in columns[name] if np.isfinite(x).any()]
        figure = f"{name}_rms" if rms and name != "scale_pct" else name
        row: dict[str, object] = {"figure": figure, "length_m": length_m, "sequences": len(means), "segments": segments}
        if means:
            drawn = np.array(means)[rng.integers(len(means), size=(draws, len(means)))].mean(axis=1)
            rest = (1 - LEVEL) / 2
            ends = np.array([np.mean(means), *np.quantile(drawn, [rest, 1 - rest])])
            ends[1:] += 0.0 if len(means) > 1 else math.nan  # one sequence does not show how much they differ
            row |= dict(zip(("value", "lo", "hi"), (np.sqrt(ends) if rms else ends).tolist(), strict=True))
        yield row


def _rate_rows(runs: Sequence[PairedRun]) -> Iterator[dict[str, object]]:
    rest = {"length_m": math.nan, "sequences": len({run.sequence for run in runs}), "segments": 0}
    tracked_km = sum(run.path_m for run in runs) / _M_PER_KM
    lost_km = sum(run.lost_m for run in runs) / _M_PER_KM
    resets, lost = sum(run.resets for run in runs), sum(run.lost for run in runs)
    for figure, count, km in ((RATES[0], resets, tracked_km), (RATES[1], lost, tracked_km + lost_km)):
        lo, hi = poisson_interval(count)
        yield {"figure": figure, **rest} | ({"value": count / km, "lo": lo / km, "hi": hi / km} if km > 0 else {})
    yield {"figure": "lost_pct", **rest, "value": _PERCENT * lost_km / max(lost_km + tracked_km, 1e-9)}


def _errors_of(part: Stretch, count: int, spacing_m: float) -> Segments:
    """Return the errors of all segments of `count` steps in a stretch of equal steps."""
    flown, believed, turn = part.flown - part.flown[0], part.believed - part.believed[0], part.turn_rad
    moved = (believed[count:] - believed[:-count]) * np.exp(-1j * turn[:-count])
    error_m = np.abs(moved - (flown[count:] - flown[:-count]))
    spread = _window_products(flown, flown, count).real
    common = np.abs(_window_products(flown, believed, count))
    is_spread = spread > (count + 1) * (LEAST_SPREAD * count * spacing_m) ** 2
    scale = np.divide(common, spread, out=np.full(len(spread), np.nan), where=is_spread & (common > 0))
    return Segments(
        position_pct=_PERCENT * error_m / (count * spacing_m),
        yaw_deg=-np.degrees(turn[count:] - turn[:-count]),
        scale_pct=_PERCENT * np.log(scale),
    )


def _window_products(first: Plane, second: Plane, count: int) -> Plane:
    """Return the sums of conj(first) second about the means, over each window of count + 1 points."""
    sums = [_window_sums(values, count) for values in (np.conj(first) * second, np.conj(first), second)]
    return np.asarray(sums[0] - sums[1] * sums[2] / (count + 1))


def _window_sums(values: Plane, count: int) -> Plane:
    total = np.concatenate([[0.0], np.cumsum(values)])
    return np.asarray(total[count + 1 :] - total[: -count - 1])


def _between(path_m: Floats, at_m: Floats, values: Plane) -> Plane:
    return np.asarray(np.interp(path_m, at_m, values.real) + 1j * np.interp(path_m, at_m, values.imag))


def _plane(position_m: Floats) -> Plane:
    return np.asarray(position_m[:, 0] + 1j * position_m[:, 1])


def _cut(whole: Stretch, is_long: NDArray[np.bool_], sequence: str) -> PairedRun:
    """Cut a run at its gaps and jumps; `is_long` tells the steps that took too long."""
    path_m = np.diff(whole.path_m)
    is_lost = is_long & (path_m > 1.0)  # m: path in a gap below which nothing was lost: a hover, or a pose left out
    error_m = np.abs(np.diff(whole.believed) * np.exp(-1j * whole.turn_rad[:-1]) - np.diff(whole.flown))
    is_jump = error_m > _JUMP_M + _JUMP_SHARE * path_m
    is_jump |= np.abs(np.diff(whole.turn_rad)) > math.radians(_JUMP_DEG)
    if is_jump.sum() > max(10, len(is_jump) / 2):  # 10 of a short run; of a longer one, half of its steps
        raise FlightError(
            f"{is_jump.sum()} of {len(is_jump)} steps are off by more than {_JUMP_M:g} m and a tenth of their length, "
            f"or {_JUMP_DEG:g} degrees: check that both files are of one flight, and positions are in metres"
        )
    ends = np.concatenate([[0], np.flatnonzero(is_lost | is_jump) + 1, [len(whole.flown)]])
    stretches = tuple(
        Stretch(
            flown=whole.flown[begin:end],
            believed=whole.believed[begin:end],
            turn_rad=whole.turn_rad[begin:end],
            path_m=whole.path_m[begin:end] - whole.path_m[begin],
        )
        for begin, end in pairwise(ends.tolist())
    )
    lost_m = float(path_m[is_lost].sum())
    return PairedRun(
        sequence=sequence,
        stretches=stretches,
        path_m=float(whole.path_m[-1]) - lost_m,
        resets=int((is_jump & ~is_lost).sum()),
        lost=int(is_lost.sum()),
        lost_m=lost_m,
    )


_Choice = tuple[float, float | None]  # correlation lengths of slip and heading, metres

# What is fitted, with the place of each in a profile.
PARTS: Final = ("slip.sigma_pct", "scale.bias_pct", "heading.walk_deg_at_100m", "heading.rate_deg_at_100m")
_RATE: Final = 3  # of PARTS
_SLIP_M: Final = (1.0, 2.0, 5.0, 10.0, 20.0)
_HEADING_M: Final = (None, 50.0, 100.0, 200.0)
_MOST_SPREAD: Final = 2.0
_SCALE_M: Final = 100.0  # distance at which a profile gives its drift of heading


@dataclass(frozen=True, slots=True, kw_only=True)
class FittedDrift:
    """A profile, and `name`, `value`, `lo`, `hi` (95 %, bootstrap over sequences) of each parameter that is fitted."""

    profile: DriftProfile
    parameters: pd.DataFrame


def fit_profile(
    runs: Sequence[PairedRun],
    *,
    name: str,
    lengths_m: Sequence[float] = LENGTHS_M,
    card: Mapping[str, str] | None = None,
    draws: int = DRAWS // 10,
    seed: int = 0,
) -> FittedDrift:
    """Fit a profile to measured runs.

    Parameters
    ----------
    runs : sequence of PairedRun
        Runs of one odometer, of two sequences at least.
    name : str
        Id of the profile.
    lengths_m : sequence of float
        Lengths of the segments that are fitted, metres of path.
    card : mapping of str to str, optional
        `title`, `source` and `limits` of the profile; by default they say what was measured, and no more.
    draws, seed : int
        Bootstrap draws of sequences for the intervals, and their seed.

    Returns
    -------
    FittedDrift
        Rates of resets and dropouts are those counted; jumps are not fitted but set to 1 m, 1 degree and the spread of
        the scale. A scale that wanders over more than the longest segment looks like a bias, and is part of it.

    Raises
    ------
    FlightError
        If fewer than two sequences have a whole segment.
    ConfigError
        If the name or the card cannot be a profile's, or drift is larger than a profile may have.

    Notes
    -----
    Weights are those of relative errors: 2 % at 10 m and at 50 m weigh the same. A constant rate of heading is the
    part that grows fastest beyond what was measured, so it is 0 unless its interval excludes that. `run_spread` is that
    of the logarithm of each run's error of position over the shortest length, less what chance adds in a run of so many
    segments without overlap.
    """
    squares, designs = _tables(runs, lengths_m)
    if len(squares) < 2:  # to draw from
        raise FlightError(
            f"a profile needs whole segments of two sequences, got {len(squares)}: measure more or longer flights"
        )
    (slip_m, heading_m), design = _best_lengths(designs, _mean(squares))
    picks = np.random.default_rng(seed).integers(0, len(squares), size=(draws, len(squares)))
    rest = (1 - LEVEL) / 2
    for columns in (np.arange(len(PARTS)), np.arange(len(PARTS)) != _RATE):
        variances = _solved(_mean(design), _mean(squares), columns)
        drawn = np.array([_solved(_mean(design[pick]), _mean(squares[pick]), columns) for pick in picks])
        lo, hi = np.sqrt(np.quantile(drawn, [rest, 1 - rest], axis=0))
        if lo[_RATE] > 0:
            break
    values = np.sqrt(variances)
    parameters = pd.DataFrame({"name": PARTS, "value": values, "lo": lo, "hi": hi})
    drift: dict[str, SlipDrift | ScaleDrift | HeadingDrift] = {
        "slip": SlipDrift(sigma_pct=values[0], length_m=slip_m),
        "scale": ScaleDrift(bias_pct=values[1]),
        "heading": HeadingDrift(walk_deg_at_100m=values[2], rate_deg_at_100m=values[3], length_m=heading_m),
    }
    return FittedDrift(profile=_profile(name, runs, drift, lengths_m, card), parameters=parameters)


def law_figures(profile: DriftProfile, runs: Sequence[PairedRun], *, lengths_m: Sequence[float]) -> pd.DataFrame:
    """Return the root mean squares that a profile has on the true paths of runs: `figure`, `length_m`, `modelled`.

    Segments span no reset and no dropout, so these have no part in it.
    """
    heading = profile.heading
    lengths = _Lengths(slip_m=(profile.slip.length_m,), heading_m=(heading.length_m,), wander_m=profile.scale.length_m)
    design = _mean(np.array(list(_by_sequence(runs, lambda run: _design(run, lengths_m, lengths)).values())))
    values = np.array(
        [
            *(profile.slip.sigma_pct, profile.scale.bias_pct, profile.scale.wander_pct),
            *(heading.walk_deg_at_100m, heading.rate_deg_at_100m),
        ]
    )
    names = ("position_pct_rms", "yaw_deg_rms", "scale_pct")
    rows = [(name, float(length)) for length in lengths_m for name in names]
    return pd.DataFrame(rows, columns=["figure", "length_m"]).assign(modelled=np.sqrt(design @ values**2))


@dataclass(frozen=True, slots=True, kw_only=True)
class _Lengths:
    """Correlation lengths, metres. Columns of a design: each of slip, bias, wander, each of heading, rate."""

    slip_m: tuple[float, ...]
    heading_m: tuple[float | None, ...]
    wander_m: float


def _by_sequence(runs: Sequence[PairedRun], table_of: Callable[[PairedRun], Floats]) -> dict[str, Floats]:
    found: dict[str, list[Floats]] = {}
    for run in runs:
        found.setdefault(run.sequence, []).append(table_of(run))
    return {name: _mean(np.array(tables)) for name, tables in found.items()}


def _tables(runs: Sequence[PairedRun], lengths_m: Sequence[float]) -> tuple[Floats, dict[_Choice, Floats]]:
    """Return mean squares by sequence, shape (K, R), and designs of `PARTS` by lengths, shape (K, R, 4)."""
    # Rows are position, heading and scale of each length. Sequences without a segment are left out.
    lengths = _Lengths(slip_m=_SLIP_M, heading_m=_HEADING_M, wander_m=max(lengths_m))
    squares = _by_sequence(runs, lambda run: _squares(run, lengths_m))
    kept = [name for name, values in squares.items() if np.isfinite(values).any()]
    whole = _by_sequence([run for run in runs if run.sequence in kept], lambda run: _design(run, lengths_m, lengths))
    bias, walks = len(_SLIP_M), len(_SLIP_M) + 2
    designs = {
        (slip_m, heading_m): np.array([whole[name][:, [slip, bias, walks + walk, -1]] for name in kept])
        for (slip, slip_m), (walk, heading_m) in itertools.product(enumerate(_SLIP_M), enumerate(_HEADING_M))
    }
    return np.array([squares[name] for name in kept]).reshape(len(kept), -1), designs


def _mean(values: Floats) -> Floats:
    """Return the mean over the first axis of what is known, NaN where nothing is."""
    is_known = np.isfinite(values)
    total = np.where(is_known, values, 0.0).sum(axis=0)
    count = is_known.sum(axis=0)
    return np.asarray(np.divide(total, count, out=np.full(total.shape, np.nan), where=count > 0))


def _squares(run: PairedRun, lengths_m: Sequence[float]) -> Floats:
    """Return the mean squares of position, heading and scale for each length, NaN where there is no segment."""
    found = []
    for length in lengths_m:
        errors = segment_errors(run, length, spacing_m=spacing_of(lengths_m))
        found += [_mean(values**2) for values in (errors.position_pct, errors.yaw_deg, errors.scale_pct)]
    return np.array(found, dtype=np.float64)


def _design(run: PairedRun, lengths_m: Sequence[float], lengths: _Lengths) -> Floats:
    """Return what unit variances do to the mean squares of a run; a row for each, columns as `_Lengths` has them."""
    spacing_m = spacing_of(lengths_m)
    stretches = [stretch.resampled(spacing_m) for stretch in run.stretches]
    rows = []
    for length in lengths_m:
        count = round(length / spacing_m)
        law = _unit_law(count, spacing_m, lengths)
        parts = [_segment_design(part, count, law, spacing_m) for part in stretches if len(part.path_m) > count]
        rows.append(_mean(np.concatenate(parts)) if parts else np.full((3, len(law.turn)), np.nan))
    return np.concatenate(rows)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _UnitLaw:
    """Covariances of the steps of a segment for unit variances: along, and across; and of the turn at its end."""

    along: Floats  # (P, count, count), of the logarithm of length
    across: Floats  # (P, count, count), of the course, radians
    turn: Floats  # (P,), square degrees


def _unit_law(count: int, spacing_m: float, lengths: _Lengths) -> _UnitLaw:
    slips = [lattice_covariance(count, spacing_m, length_m=each) / _PERCENT**2 for each in lengths.slip_m]
    wander = lattice_covariance(count, spacing_m, length_m=lengths.wander_m) / _PERCENT**2
    one, none = np.ones((count, count)) / _PERCENT**2, np.zeros((count, count))
    unit = math.radians(1) ** 2 / _SCALE_M
    walks = [unit * lattice_heading(count, spacing_m, length_m=each) for each in lengths.heading_m]
    at = (np.arange(count) + 0.5) * spacing_m * math.radians(1) / _SCALE_M
    whole = np.array([count * spacing_m])
    turns = [heading_law(whole, length_m=each).change[0] / _SCALE_M for each in lengths.heading_m]
    return _UnitLaw(
        along=np.array([*slips, one, wander, *[none] * len(walks), none]),
        across=np.array([*slips, none, none, *walks, np.multiply.outer(at, at)]),
        turn=np.array([*[0.0] * len(slips), 0.0, 0.0, *turns, (whole[0] / _SCALE_M) ** 2]),
    )


def _segment_design(part: Stretch, count: int, law: _UnitLaw, spacing_m: float) -> Floats:
    """Return the squares of each segment for unit variances, shape (S, 3, P)."""
    # At most 60 segments of a stretch, evenly: neighbours overlap
    begins = np.unique(np.linspace(0, len(part.path_m) - count - 1, 60).astype(int))
    windows = part.flown[begins[:, None] + np.arange(count + 1)]
    steps = np.diff(windows, axis=1)
    end = _PERCENT**2 / (count * spacing_m) ** 2
    position = end * _quadratic(law.along + law.across, steps)
    points = windows - windows.mean(axis=1, keepdims=True)
    spread = (np.abs(points) ** 2).sum(axis=1)
    # The scale of the points is that of their errors along the vectors from the mean: step k moves all after it.
    after = np.cumsum(np.conj(points)[:, ::-1], axis=1)[:, ::-1][:, 1:] * steps
    scale = _PERCENT**2 * (_quadratic(law.along, after.real) + _quadratic(law.across, after.imag))
    least = (count + 1) * (LEAST_SPREAD * count * spacing_m) ** 2  # the scale of less is not measured
    scale = np.divide(scale, spread[:, None] ** 2, out=np.full(scale.shape, np.nan), where=spread[:, None] > least)
    return np.stack([position, np.broadcast_to(law.turn, position.shape), scale], axis=1)


def _quadratic(covariances: Floats, vectors: NDArray[np.complex128] | Floats) -> Floats:
    """Return v^H K v for each vector, shape (S, n), and each covariance, shape (P, n, n): shape (S, P)."""
    return np.stack([((vectors.conj() @ each) * vectors).sum(axis=1).real for each in covariances], axis=1)


def _solved(design: Floats, target: Floats, columns: NDArray[np.int64] | NDArray[np.bool_]) -> Floats:
    """Return the variances of `PARTS` that explain mean squares, each row relative to its own; 0 of other columns."""
    is_known = np.isfinite(target) & (target > 0) & np.isfinite(design).all(axis=1)
    found = np.zeros(design.shape[1])
    if is_known.any():
        relative = design[is_known] / target[is_known, None]
        found[columns] = nnls(relative[:, columns], np.ones(len(relative)))[0]
    return found


def _best_lengths(designs: Mapping[_Choice, Floats], target: Floats) -> tuple[_Choice, Floats]:
    # 0.9: gain of the misfit, for a heading that saturates to be preferred to one that walks
    misfits = {
        choice: _misfit(_mean(design), target) * (0.9 if choice[1] is None else 1.0)
        for choice, design in designs.items()
    }
    best = min(misfits, key=lambda choice: misfits[choice])
    return best, designs[best]


def _misfit(design: Floats, target: Floats) -> float:
    is_known = np.isfinite(target) & (target > 0)
    modelled = design @ _solved(design, target, np.arange(len(PARTS)))
    return float(np.mean((modelled[is_known] / target[is_known] - 1) ** 2)) if is_known.any() else 0.0


def _profile(
    name: str,
    runs: Sequence[PairedRun],
    drift: Mapping[str, SlipDrift | ScaleDrift | HeadingDrift],
    lengths_m: Sequence[float],
    card: Mapping[str, str] | None,
) -> DriftProfile:
    km = sum(run.path_m for run in runs) / 1000
    resets, lost = sum(run.resets for run in runs), sum(run.lost for run in runs)
    flights = f"{len(runs)} runs of {len({run.sequence for run in runs})} sequences"
    shown = ", ".join(f"{length:g}" for length in lengths_m)
    about = {
        "title": f"Fitted to {flights}",
        "source": f"Measured: {flights}, {km:.2f} km, segments of {shown} m.",
        "limits": f"Nothing is known beyond {max(lengths_m):g} m.",
    }
    # A reset ends the scale of the run: another of the same spread follows.
    scale_pct = drift["scale"].model_dump()["bias_pct"]
    jumps = Resets(per_km=resets / km, position_m=1.0, yaw_deg=1.0, scale_pct=scale_pct) if resets else Resets()
    lost_m = sum(run.lost_m for run in runs)
    gaps = Dropouts(per_km=lost / (km + lost_m / 1000), length_m=lost_m / lost) if lost else Dropouts()
    content = {"id": name, **about, **(card or {}), "run_spread": _run_spread(runs, min(lengths_m)), **drift}
    return check_document(content | {"resets": jumps, "dropouts": gaps}, DriftProfile, source=f"profile {name}")


def _run_spread(runs: Sequence[PairedRun], length_m: float) -> float:
    """Return the spread of the logarithm of the runs' errors that chance within runs does not explain."""
    logs, chance = [], []
    for run in runs:
        errors = segment_errors(run, length_m, spacing_m=length_m / 10).position_pct
        if len(errors) and errors.any():
            logs.append(math.log(float(np.mean(errors**2))) / 2)
            # The square of a plane's normal error has a relative variance of 1; its root's logarithm has a quarter.
            chance.append(length_m / (4 * max(run.path_m, length_m)))
    if len(logs) < 2:  # a spread needs two
        return 0.0
    return min(math.sqrt(max(float(np.var(logs, ddof=1)) - float(np.mean(chance)), 0.0)), _MOST_SPREAD)
