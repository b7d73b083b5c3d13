# SPDX-License-Identifier: Apache-2.0
"""Drift profiles fitted to measured runs: mean squares of errors are sums of the profile's variances.

To first order a segment's errors are linear in the errors of its steps, so their mean squares over segments of the true
path are linear in the variances of slip, scale and heading. Non-negative least squares finds these; correlation lengths
come from a short list.
"""

import itertools
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
import pandas as pd
from numpy.typing import NDArray
from scipy.optimize import nnls

from sasgeo_bench.config import check_document
from sasgeo_bench.errors import FlightError
from sasgeo_bench.flights.drift import (
    DRAWS,
    LEAST_SPREAD,
    LENGTHS_M,
    LEVEL,
    PairedRun,
    Stretch,
    segment_errors,
    spacing_of,
)
from sasgeo_bench.flights.drift_profile import DriftProfile, Dropouts, HeadingDrift, Resets, ScaleDrift, SlipDrift
from sasgeo_bench.flights.processes import heading_law, lattice_covariance, lattice_heading

Floats = NDArray[np.float64]
_Choice = tuple[float, float | None]  # correlation lengths of slip and heading, metres

# What is fitted, with the place of each in a profile.
PARTS: Final = ("slip.sigma_pct", "scale.bias_pct", "heading.walk_deg_at_100m", "heading.rate_deg_at_100m")
_RATE: Final = 3  # of PARTS
_SLIP_M: Final = (1.0, 2.0, 5.0, 10.0, 20.0)
_HEADING_M: Final = (None, 50.0, 100.0, 200.0)
_MOST_SPREAD: Final = 2.0
_PERCENT: Final = 100.0
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
