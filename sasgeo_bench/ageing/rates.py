# SPDX-License-Identifier: Apache-2.0
"""Estimate yearly rates from shares lost between dates: interval-censored exponential, bootstrap over blocks."""

import hashlib
import math
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

DRAWS: Final = 1000
LEVEL: Final = 0.95
_NEWTON_STEPS: Final = 60
_NEVER_SEEN: Final = 0.05  # probability of no loss at the upper end of a zero rate

Floats = NDArray[np.float64]


@dataclass(frozen=True, slots=True, kw_only=True)
class Rate:
    """A yearly rate and its 95 % interval; NaN if unknown, infinite if nothing is left."""

    per_year: float
    lo: float
    hi: float


def seeded_rng(*purpose: object) -> np.random.Generator:
    """Return a random generator for one purpose (place, class, dates), the same on every machine."""
    text = "/".join(map(str, purpose))
    return np.random.default_rng(int.from_bytes(hashlib.sha256(text.encode()).digest()[:16], "big"))


def loss_rate(lost: Floats, total: Floats, years: Floats) -> Floats:
    """Estimate the yearly rate of an exponential life by maximum likelihood, from amounts lost between dates.

    `lost` and `total` have shape (..., K): amounts lost within each of K intervals of lengths `years`, and amounts at
    their beginnings. The rate, shape (...), is NaN if there was nothing to lose, infinite if all was lost.

    Notes
    -----
    A loss is only known to lie between two dates. The score is sum(lost * t / expm1(rate * t)) - sum(kept * t) = 0. It
    decreases and is convex in the rate, so that Newton's steps from below reach its one root without passing it. One
    interval has the closed form -ln(1 - share) / t.

    Examples
    --------
    >>> loss_rate(np.array([10.0, 19.0]), np.array([100.0, 100.0]), np.array([1.0, 2.0])).round(4).item()
    0.1054
    """
    exposure = total.sum(axis=-1)
    kept = ((total - lost) * years).sum(axis=-1)
    some = lost.sum(axis=-1)
    rate = np.full(exposure.shape, np.nan)
    rate[(exposure > 0) & (some <= 0)] = 0.0
    rate[(exposure > 0) & (kept <= 0)] = np.inf
    solvable = (exposure > 0) & (some > 0) & (kept > 0)
    rate[solvable] = _root(lost[solvable], kept[solvable], some[solvable], years)
    return rate


def _root(lost: Floats, kept: Floats, some: Floats, years: Floats) -> Floats:
    """Solve the score equation, shapes (N, K), (N,), (N,) and (K,)."""
    # 1 / expm1(x) > 1 / x - 1 / 2, so the root of the right hand side lies below the true one.
    rate: Floats = some / (kept + (lost * years).sum(axis=-1) / 2)
    for _ in range(_NEWTON_STEPS):
        grown = np.expm1(rate[:, None] * years)
        score = (lost * years / grown).sum(axis=-1) - kept
        slope = -(lost * years**2 * (grown + 1) / grown**2).sum(axis=-1)
        step = -score / slope
        rate += step
        if (np.abs(step) <= 1e-12 * rate).all():
            break
    return rate


def bootstrap_rate(lost: Floats, total: Floats, years: Floats, *, things: int, rng: np.random.Generator) -> Rate:
    """Estimate a yearly rate with a 95 % interval from resampled spatial blocks.

    `lost` and `total` have shape (B, K): amounts of B blocks in K intervals of lengths `years`. If none of the `things`
    was lost, the bootstrap has no variance, and the upper end is the rate at which losing none has a probability of 5 %
    (the rule of three). The interval is NaN for fewer than two blocks: neighbours change together, so one block is one
    sample.
    """
    best = float(loss_rate(lost.sum(axis=0), total.sum(axis=0), years))
    if math.isnan(best):
        return Rate(per_year=best, lo=best, hi=best)
    if best == 0.0:
        return Rate(per_year=0.0, lo=0.0, hi=float(-np.log(_NEVER_SEEN) / (max(things, 1) * years.mean())))
    blocks = len(total)
    if blocks < 2:  # noqa: PLR2004 - one block cannot differ from itself
        return Rate(per_year=best, lo=math.nan, hi=math.nan)
    weights = rng.multinomial(blocks, np.full(blocks, 1 / blocks), size=DRAWS).astype(np.float64)
    drawn = loss_rate(weights @ lost, weights @ total, years)
    drawn = drawn[~np.isnan(drawn)]  # a draw of empty blocks alone had nothing to lose
    tail = (1 - LEVEL) / 2
    lo, hi = np.quantile(drawn, [tail, 1 - tail], method="inverted_cdf")
    return Rate(per_year=best, lo=float(lo), hi=float(hi))
