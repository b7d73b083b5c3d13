# SPDX-License-Identifier: Apache-2.0
"""How sure a figure is: a bootstrap over blocks and sites, never narrower than Wilson's interval of as many sites.

Intervals of the bootstrap are percentile intervals: they keep to the range of the figure, they do not change when the
figure is mapped monotonically, and the same draws serve every figure and every difference. BCa intervals would need an
acceleration from leaving out blocks, which with a few dozen blocks of unequal size is noise itself; studentised ones
would need a standard error within each draw. A percentile interval is somewhat narrow for few blocks; drawing sites
within drawn blocks as well makes it somewhat wide (Davison and Hinkley 1997, Sec. 3.8), the more so the less sites
of a block are alike: up to the factor sqrt(2) if they are not alike at all. Of few sites the draws say too little, and
where all answers are right nothing: `share_interval` holds them against Wilson's.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import ArrayLike
from statsmodels.stats.proportion import proportion_confint

from sasgeo_bench.errors import MetricError
from sasgeo_bench.scoring.base import Floats, Ints, block_codes, check_column, check_weights, weighted_mean
from sasgeo_bench.scoring.draws import ClusterDraws

LEVEL: Final = 0.95

Statistic = Callable[[Floats], float]


@dataclass(frozen=True, slots=True, kw_only=True)
class Interval:
    """A figure and its interval; NaN where nothing can be said."""

    value: float
    lo: float
    hi: float


def wilson(successes: float, trials: float, *, level: float = LEVEL) -> Interval:
    """Wilson's score interval of a proportion.

    Parameters
    ----------
    successes, trials : float
        0 <= successes <= trials; need not be whole, as with hits shared among tied poses or with weights.
    level : float
        In (0, 1).

    Returns
    -------
    Interval
        In [0, 1]; all of it where there is no trial.

    Raises
    ------
    MetricError
        If a number is out of range.

    Notes
    -----
    Wilson, JASA 1927, without a correction for continuity. The trials must be independent: across blocks use the
    bootstrap.

    Examples
    --------
    The SASGeo paper's Recall@1 of 0.586 in 220 trials:

    >>> found = wilson(129, 220)
    >>> round(found.lo, 3), round(found.hi, 3)
    (0.52, 0.649)
    """
    _check_level(level)
    if not 0 <= successes <= trials < np.inf:
        message = f"successes must lie between 0 and the trials, got {successes!r} of {trials!r}"
        raise MetricError(message)
    if trials == 0:
        return Interval(value=float("nan"), lo=0.0, hi=1.0)
    lo, hi = proportion_confint(successes, trials, alpha=1.0 - level, method="wilson")
    # Rounding leaves 0 of n and n of n a little inside their exact ends.
    lo, hi = (0.0 if successes == 0 else float(lo)), (1.0 if successes == trials else float(hi))
    return Interval(value=successes / trials, lo=lo, hi=hi)


def _check_level(level: float) -> None:
    if not 0 < level < 1:
        message = f"level must lie in (0, 1), got {level!r}"
        raise MetricError(message)


def wilson_mean(values: ArrayLike, weights: ArrayLike | None = None, *, level: float = LEVEL) -> Interval:
    """Wilson's interval of a mean of values in [0, 1], as hits with ties or with weights.

    Parameters
    ----------
    values : array_like, shape (N,)
        In [0, 1]. Values between 0 and 1 vary less than successes and failures do, so the interval is not too narrow.
    weights : array_like, shape (N,), optional
        Not negative; they count as (sum w)^2 / sum w^2 trials (Kish 1965), N for equal weights.
    level : float
        In (0, 1).

    Returns
    -------
    Interval
        In [0, 1].

    Raises
    ------
    MetricError
        If a value lies outside [0, 1].

    Examples
    --------
    >>> wilson_mean([1.0, 0.5, 0.5, 0.0]) == wilson(2, 4)
    True
    """
    column = check_column(values, "values")
    mass = check_weights(weights, len(column))
    if ((column < 0) | (column > 1)).any():
        message = f"values reach from {column.min():g} to {column.max():g}, expected shares in [0, 1]"
        raise MetricError(message)
    squared = float((mass**2).sum())
    trials = float(mass.sum()) ** 2 / squared if squared > 0 else 0.0
    share = weighted_mean(column, mass)
    return wilson(min(share * trials, trials) if trials else 0.0, trials, level=level)


def bootstrap_means(values: ArrayLike, drawn: ClusterDraws, weights: ArrayLike | None = None) -> Floats:
    """Weighted means of every draw, of one or of several figures.

    Parameters
    ----------
    values : array_like, shape (N,) or (N, M)
        One finite value for each query; M methods or figures side by side share the draws.
    drawn : ClusterDraws
        Of N queries.
    weights : array_like, shape (N,), optional
        Not negative; as of `presence_weights`, or 0 for queries that do not count.

    Returns
    -------
    ndarray of float, shape (D,) or (D, M)
        NaN where a draw holds no query that counts.

    Raises
    ------
    MetricError
        If a value is not finite, or their number is not that of the queries.

    Examples
    --------
    >>> drawn = ClusterDraws(blocks=["a", "b"], seed=1, draws=4000)
    >>> means = bootstrap_means([[0.0, 1.0], [1.0, 0.0]], drawn)
    >>> means.shape, round(float((means[:, 0] == 1).mean()), 2)
    ((4000, 2), 0.25)
    """
    table = np.asarray(values, dtype=np.float64)
    if table.ndim not in {1, 2} or len(table) != drawn.count or not np.isfinite(table).all():
        message = f"values have shape {table.shape}, expected ({drawn.count},) or ({drawn.count}, M), all finite"
        raise MetricError(message)
    mass = check_weights(weights, drawn.count)
    columns = np.column_stack((table.reshape(len(table), -1) * mass[:, None], mass))
    sums = np.concatenate(list(drawn.sums(columns)) or [np.full((drawn.draws, columns.shape[1]), 0.0)])
    total = sums[:, -1:]
    means = np.divide(sums[:, :-1], total, out=np.full(sums[:, :-1].shape, np.nan), where=total > 0)
    return np.asarray(means[:, 0] if table.ndim == 1 else means)


def bootstrap_statistic(statistic: Statistic, drawn: ClusterDraws, weights: ArrayLike | None = None) -> Floats:
    """Any figure of every draw, through the weights it gives to queries; slower than `bootstrap_means`.

    Parameters
    ----------
    statistic : callable
        Weights, shape (N,) -> float, as in `lambda weights: aurc(answers, weights)`.
    drawn : ClusterDraws
        Of N queries.
    weights : array_like, shape (N,), optional
        Not negative; the draws are multiplied with them.

    Returns
    -------
    ndarray of float, shape (D,)
        One figure for each draw.

    Examples
    --------
    >>> drawn = ClusterDraws(blocks=["a", "a", "b", "b"], seed=1, draws=50)
    >>> values = np.array([1.0, 0.0, 1.0, 1.0])
    >>> slow = bootstrap_statistic(lambda weights: weighted_mean(values, weights), drawn)
    >>> bool(np.allclose(slow, bootstrap_means(values, drawn)))
    True
    """
    mass = check_weights(weights, drawn.count)
    return np.array([statistic(row * mass) for some in drawn.weights() for row in some], dtype=np.float64)


def percentile_interval(value: float, draws: ArrayLike, *, level: float = LEVEL) -> Interval:
    """Interval between two percentiles of the draws.

    Parameters
    ----------
    value : float
        The figure itself.
    draws : array_like, shape (D,)
        The figure of each draw; draws without one (NaN) are left out.
    level : float
        In (0, 1).

    Returns
    -------
    Interval
        NaN at both ends where no draw has a figure.

    Examples
    --------
    >>> percentile_interval(0.5, np.linspace(0.0, 1.0, 1001))
    Interval(value=0.5, lo=0.025, hi=0.975)
    """
    _check_level(level)
    column = np.asarray(draws, dtype=np.float64)
    column = column[~np.isnan(column)]
    if not len(column):
        return Interval(value=value, lo=float("nan"), hi=float("nan"))
    tail = (1.0 - level) / 2
    lo, hi = np.quantile(column, [tail, 1.0 - tail], method="inverted_cdf")
    return Interval(value=value, lo=float(lo), hi=float(hi))


def effective_count(groups: Sequence[str] | Ints, weights: ArrayLike | None = None) -> float:
    """How many groups of equal mass some queries are worth, as sites.

    Parameters
    ----------
    groups : sequence of str or ndarray of int, length N
        Group of each query.
    weights : array_like, shape (N,), optional
        Not negative; a query of weight 0 does not count.

    Returns
    -------
    float
        (sum m)^2 / sum m^2 of the groups' masses m (Kish 1965): their number where all weigh the same; 0 for nothing.

    Examples
    --------
    >>> effective_count(["a", "a", "b", "b"]), effective_count(["a", "a", "a", "b"])
    (2.0, 1.6)
    """
    sizes, code = block_codes(groups, len(groups))
    mass = np.bincount(code, weights=check_weights(weights, len(code)), minlength=len(sizes))
    squared = float((mass**2).sum())
    return float(mass.sum()) ** 2 / squared if squared > 0 else 0.0


def share_interval(value: float, draws: ArrayLike, trials: float, *, level: float = LEVEL) -> tuple[Interval, str]:
    """Interval of a figure in [0, 1]: between percentiles of its draws, and never narrower than Wilson's.

    Parameters
    ----------
    value : float
        The figure itself.
    draws : array_like, shape (D,)
        The figure of each draw; none for a single block, which says nothing of others.
    trials : float
        How many trials the queries are worth at least, as the sites by `effective_count`.
    level : float
        In (0, 1).

    Returns
    -------
    Interval, str
        And how it was found: "blocks" where the draws decide both ends, "wilson" where Wilson's lies farther out at
        one. NaN for a figure that is none.

    Notes
    -----
    A mean of values in [0, 1] varies at most as much as a share does, so of as many sites Wilson's is wide enough if
    blocks add nothing. Draws alone are too narrow for a few sites, and a point where all are right. The wider end of
    both keeps the order: a method that is right wherever another one is has both ends at least as high.

    Examples
    --------
    Four sites that were all found, and four that were all found but for one query of ten at one of them:

    >>> found, how = share_interval(1.0, np.ones(100), 4)
    >>> round(found.lo, 2), found.hi, how
    (0.51, 1.0, 'wilson')
    >>> round(share_interval(0.975, np.array([0.95, 0.975, 1.0]), 4)[0].lo, 2)
    0.49
    """
    if math.isnan(value):
        return Interval(value=value, lo=value, hi=value), ""
    exact = wilson(min(max(value * trials, 0.0), trials), trials, level=level)
    drawn = percentile_interval(value, draws, level=level)
    ends = Interval(value=value, lo=float(np.fmin(drawn.lo, exact.lo)), hi=float(np.fmax(drawn.hi, exact.hi)))
    return ends, "blocks" if (ends.lo, ends.hi) == (drawn.lo, drawn.hi) else "wilson"


def difference_interval(first: Interval, second: Interval) -> Interval:
    """Interval of a difference, first less second, from those of both sides.

    Parameters
    ----------
    first, second : Interval
        Of figures that are independent, or vary against each other no more than parts of one whole do.

    Returns
    -------
    Interval
        The distances to the ends, squared and added (Newcombe 1998; Zou and Donner, Statistics in Medicine 2008).

    Examples
    --------
    No query of four was won by either of two methods:

    >>> found = difference_interval(wilson(0, 4), wilson(0, 4))
    >>> found.value, round(found.lo, 2), round(found.hi, 2)
    (0.0, -0.49, 0.49)
    """
    value = first.value - second.value
    return Interval(
        value=value,
        lo=value - math.hypot(first.value - first.lo, second.hi - second.value),
        hi=value + math.hypot(first.hi - first.value, second.value - second.lo),
    )


def _told(value: float, draws: Callable[[], Floats], drawn: ClusterDraws, level: float) -> Interval:
    """Interval of a figure; none for fewer than two blocks, since one says nothing of others."""
    _check_level(level)
    if drawn.blocks_count < 2:  # noqa: PLR2004 - one block cannot differ from itself
        return Interval(value=value, lo=float("nan"), hi=float("nan"))
    return percentile_interval(value, draws(), level=level)


def mean_interval(
    values: ArrayLike, drawn: ClusterDraws, weights: ArrayLike | None = None, *, level: float = LEVEL
) -> Interval:
    """Weighted mean with an interval that counts blocks, not queries.

    Parameters
    ----------
    values : array_like, shape (N,)
        One finite value for each query.
    drawn : ClusterDraws
        Of N queries.
    weights : array_like, shape (N,), optional
        Not negative.
    level : float
        In (0, 1).

    Returns
    -------
    Interval
        NaN at both ends for fewer than two blocks. It shrinks to a point where all values are equal: 0 of n says
        nothing of the spread, print `wilson_mean` beside it.

    Examples
    --------
    >>> mean_interval([1.0, 0.0, 1.0, 1.0], ClusterDraws(blocks=["a", "a", "b", "b"], seed=1, draws=500))
    Interval(value=0.75, lo=0.25, hi=1.0)
    """
    column = check_column(values, "values", drawn.count)
    value = weighted_mean(column, weights)
    return _told(value, lambda: bootstrap_means(column, drawn, weights), drawn, level)


def mean_difference(
    first: ArrayLike,
    second: ArrayLike,
    drawn: ClusterDraws,
    weights: ArrayLike | None = None,
    *,
    level: float = LEVEL,
) -> Interval:
    """Difference of two methods' means, first less second, on the same queries and the same draws.

    Parameters
    ----------
    first, second : array_like, shape (N,)
        Values of two methods for the same queries in the same order.
    drawn : ClusterDraws
        Of N queries.
    weights : array_like, shape (N,), optional
        Not negative.
    level : float
        In (0, 1).

    Returns
    -------
    Interval
        As of `mean_interval`.

    Examples
    --------
    >>> drawn = ClusterDraws(blocks=["a", "b", "c"], seed=1, draws=500)
    >>> mean_difference([1.0, 1.0, 0.0], [0.0, 0.0, 0.0], drawn).value.__round__(3)
    0.667
    """
    ours, theirs = (check_column(side, "values", drawn.count) for side in (first, second))
    return mean_interval(ours - theirs, drawn, weights, level=level)


def statistic_interval(
    statistic: Statistic, drawn: ClusterDraws, weights: ArrayLike | None = None, *, level: float = LEVEL
) -> Interval:
    """Any figure with an interval that counts blocks, not queries.

    Parameters
    ----------
    statistic : callable
        Weights, shape (N,) -> float. The difference of two methods is a figure, too:
        `lambda weights: aurc(ours, weights) - aurc(theirs, weights)`.
    drawn : ClusterDraws
        Of N queries.
    weights : array_like, shape (N,), optional
        Not negative.
    level : float
        In (0, 1).

    Returns
    -------
    Interval
        NaN at both ends for fewer than two blocks.

    Examples
    --------
    >>> values = np.array([1.0, 2.0, 4.0])
    >>> drawn = ClusterDraws(blocks=["a", "b", "c"], seed=1, draws=200)
    >>> statistic_interval(lambda weights: weighted_mean(values, weights), drawn) == mean_interval(values, drawn)
    True
    """
    value = statistic(check_weights(weights, drawn.count))
    return _told(value, lambda: bootstrap_statistic(statistic, drawn, weights), drawn, level)
