# SPDX-License-Identifier: Apache-2.0
"""Drift of odometry, measured on estimates with truth: relative errors by segment length, resets and lost stretches."""

import math
import warnings
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Final

import numpy as np
import pandas as pd
from numpy.typing import NDArray
from scipy.stats import chi2

from sasgeo_bench.errors import FlightError, counted
from sasgeo_bench.flights.odometry import path_steps_m
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
            ends[1:] += 0.0 if len(means) > 1 else math.nan  # of one sequence nobody knows how much they differ
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
