# SPDX-License-Identifier: Apache-2.0
"""Random processes over distance flown, exact for any steps: an error at a distance does not depend on the steps.

A process is known at the poses (`values`) and by its means over the steps between them (`means`), which is what
displaces a pose. Both are drawn together from their joint law, so cutting a step in two changes nothing.
"""

import math
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

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
    told = np.divide(rest**2, value_sd, out=np.zeros_like(u), where=value_sd > 0)
    remainder = np.where(u > _FEW, 2 * u - 4 * rest - np.expm1(-2 * u) - told**2, u**3 / 6)
    first, second = rng.standard_normal((2, len(u)))
    values = np.empty(len(u) + 1)
    values[0] = rng.standard_normal()
    for at in range(len(u)):
        values[at + 1] = kept[at] * values[at] + value_sd[at] * first[at]
    integrals = rest * values[:-1] + told * first + np.sqrt(np.maximum(remainder, 0.0)) * second
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
