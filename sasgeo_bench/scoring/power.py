# SPDX-License-Identifier: Apache-2.0
"""Statistical power of a suite: correlation within blocks, and the least difference it can detect."""

import math
from collections.abc import Sequence
from functools import cache
from typing import Final

import numpy as np
from numpy.typing import ArrayLike
from scipy.stats import norm

from sasgeo_bench.errors import MetricError
from sasgeo_bench.scoring.base import Ints, block_codes, check_column

ALPHA: Final = 0.05
POWER: Final = 0.8
_NOTHING: Final = 1e-12  # a smaller spread is a rounding error


def intraclass_correlation(values: ArrayLike, blocks: Sequence[str] | Ints) -> float:
    """Return how much more alike values of one block are than values of different blocks, at most 1.

    Negative where values of a block are less alike than chance. NaN for fewer than two blocks, without a block of two
    queries, or where nothing varies. For two methods, pass the difference of their hits per query.

    Raises
    ------
    MetricError
        If a value is not finite.

    Notes
    -----
    The analysis-of-variance estimator for blocks of unequal size (Donner, International Statistical Review 1986):
    (B - W) / (B + (n0 - 1) W), with B and W the mean squares between and within K blocks and
    n0 = (N - sum n_k^2 / N) / (K - 1).

    Examples
    --------
    >>> intraclass_correlation([1.0, 1.0, 0.0, 0.0], ["a", "a", "b", "b"])
    1.0
    """
    column = check_column(values, "values")
    if not np.isfinite(column).all():
        message = "values holds infinity: correlate hits or differences of hits"
        raise MetricError(message)
    sizes, code = block_codes(blocks, len(column))
    count, total = len(sizes), len(column)
    if count < 2 or total == count:  # noqa: PLR2004 - nothing within or nothing between
        return math.nan
    means = np.bincount(code, weights=column) / sizes
    between = float((sizes * (means - column.mean()) ** 2).sum()) / (count - 1)
    within = float(((column - means[code]) ** 2).sum()) / (total - count)
    size = (total - float((sizes**2).sum()) / total) / (count - 1)
    spread = between + (size - 1) * within
    return (between - within) / spread if spread > _NOTHING else math.nan


def design_effect(sizes: ArrayLike, correlation: float) -> float:
    """Return how many times more queries blocks need than independent ones, at least 1.

    `sizes`, shape (K,), are the queries of each block; a negative correlation counts as 0.

    Raises
    ------
    MetricError
        If there is no block, a block is empty, or the correlation exceeds 1.

    Notes
    -----
    Kish 1965: 1 + (m - 1) rho, with m = sum n_k^2 / sum n_k the size of the block of a random query, which for equal
    blocks is their size.

    Examples
    --------
    >>> round(design_effect([50] * 36, 0.05), 2)
    3.45
    """
    column = check_column(sizes, "sizes")
    if not len(column) or not (column >= 1).all() or not correlation <= 1:
        message = f"expected blocks with queries in them and a correlation of at most 1, got {correlation!r}"
        raise MetricError(message)
    size = float((column**2).sum() / column.sum())
    return 1.0 + (size - 1.0) * max(correlation, 0.0)


@cache
def _deviates(alpha: float, power: float) -> tuple[float, float]:
    if not (0 < alpha < 1 and 0.5 <= power < 1):  # noqa: PLR2004 - below, the quadratic's other root would hold
        message = f"alpha must lie in (0, 1) and power in [0.5, 1), got {alpha!r} and {power!r}"
        raise MetricError(message)
    return float(norm.isf(alpha / 2)), float(norm.ppf(power))


def detectable_difference(
    pairs: float, discordant_share: float, *, alpha: float = ALPHA, power: float = POWER
) -> float:
    """Return the least difference of two shares that McNemar's test finds with some independent pairs.

    Infinite if even a difference of `discordant_share` would be missed.

    Parameters
    ----------
    pairs : float
        Independent pairs: queries divided by the design effect.
    discordant_share : float
        Share of queries that just one of the two methods gets right, in [0, 1].
    alpha : float
        Two-sided level.
    power : float
        Chance to find the difference, in [0.5, 1).

    Raises
    ------
    MetricError
        If a number is out of range.

    Notes
    -----
    Connor, Biometrics 1987: n = (z_a sqrt(p) + z_b sqrt(p - d^2))^2 / d^2, solved for the difference d:
    d = sqrt(p) (z_a sqrt(n) + z_b sqrt(n + z_b^2 - z_a^2)) / (n + z_b^2).

    Examples
    --------
    >>> round(detectable_difference(521, 0.06), 4)
    0.03
    """
    low, high = _deviates(alpha, power)
    if not pairs >= 0 or not 0 <= discordant_share <= 1:
        message = f"expected pairs >= 0 and a discordant share in [0, 1], got {pairs!r} and {discordant_share!r}"
        raise MetricError(message)
    # Even if all discordant pairs point one way, d = p: n p^2 must reach (z_a sqrt(p) + z_b sqrt(p - p^2))^2.
    least = low + high * math.sqrt(1.0 - discordant_share)
    if pairs * discordant_share < least**2:
        return math.inf
    root = low * math.sqrt(pairs) + high * math.sqrt(pairs + high**2 - low**2)
    return math.sqrt(discordant_share) * root / (pairs + high**2)


def sensitivity(first: ArrayLike, second: ArrayLike, blocks: Sequence[str] | Ints) -> float:
    """Return the minimum detectable difference of two methods on a suite; infinite if even the largest would be missed.

    `first` and `second` are hits in [0, 1], shape (N,), for the same queries. A correlation that cannot be estimated
    counts as 0.

    Raises
    ------
    MetricError
        If there is no query, or numbers differ.

    Examples
    --------
    >>> blocks = [str(at // 50) for at in range(1800)]
    >>> round(sensitivity([at % 32 == 0 for at in range(1800)], [at % 32 == 1 for at in range(1800)], blocks), 4)
    0.0166
    """
    ours = check_column(first, "first")
    gaps = ours - check_column(second, "second", len(ours))
    sizes, _ = block_codes(blocks, len(ours))
    if not len(sizes):
        message = "no queries, so no difference can be detected: draw some first"
        raise MetricError(message)
    correlation = intraclass_correlation(gaps, blocks)
    effect = design_effect(sizes, 0.0 if math.isnan(correlation) else correlation)
    return detectable_difference(len(ours) / effect, float(np.abs(gaps).mean()))
