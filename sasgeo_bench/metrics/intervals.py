# SPDX-License-Identifier: Apache-2.0
"""How sure a figure is: Wilson's interval within a region, a bootstrap over blocks and queries across regions.

Intervals of the bootstrap are percentile intervals: they keep to the range of the figure, they do not change when the
figure is mapped monotonically, and the same draws serve every figure and every difference. BCa intervals would need an
acceleration from leaving out blocks, which with a few dozen blocks of unequal size is noise itself; studentised ones
would need a standard error within each draw. A percentile interval is somewhat narrow for few blocks; drawing queries
within drawn blocks as well makes it somewhat wide (Davison and Hinkley 1997, Sec. 3.8), the more so the less queries
of a block are alike: up to the factor sqrt(2) if they are not alike at all.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from typing import Final

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.sparse import csr_array
from statsmodels.stats.proportion import proportion_confint

from sasgeo_bench.errors import MetricError
from sasgeo_bench.metrics.base import Floats, Ints, block_codes, check_column, check_weights, weighted_mean

LEVEL: Final = 0.95
DRAWS: Final = 10_000
_CHUNK_CELLS: Final = 2**21  # draws times queries held at once: 16 MB a column of numbers, some ten columns at most

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


@dataclass(frozen=True, kw_only=True)
class ClusterDraws:
    """Draws of queries, with replacement: first blocks, then queries within each block as often as it was drawn.

    Parameters
    ----------
    blocks : sequence of str or ndarray of int, length N
        Block of each query. Figures that are to be compared are given for the same queries in the same order.
    seed : int
        The same seed, blocks and number of draws give the same draws, whatever is computed from them.
    draws : int
        How many.
    draws_queries : bool
        False draws whole blocks, with the queries they hold.

    Raises
    ------
    MetricError
        If the number of draws is not positive.

    Notes
    -----
    A block of n queries that is drawn c times gives c n queries, each drawn from its n. Numbers of queries differ
    between draws if blocks differ in size; means are ratios of sums and take that into account.

    Examples
    --------
    >>> drawn = ClusterDraws(blocks=["a", "a", "b"], seed=1, draws=1000)
    >>> weights = np.vstack(list(drawn.weights()))
    >>> weights.shape, bool((weights.sum(axis=1) >= 2).all()), round(float(weights.mean()), 1)
    ((1000, 3), True, 1.0)
    """

    blocks: Sequence[str] | Ints
    seed: int
    draws: int = DRAWS
    draws_queries: bool = True
    count: int = field(init=False)  # of queries
    blocks_count: int = field(init=False)
    _sizes: tuple[tuple[int, Ints, Ints], ...] = field(init=False, repr=False)  # size, blocks (K,), queries (K, size)

    def __post_init__(self) -> None:
        """Gather blocks of equal size, so that drawing goes by few large steps."""
        if self.draws < 1:
            message = f"draws must be at least 1, got {self.draws!r}"
            raise MetricError(message)
        sizes, code = block_codes(self.blocks, len(self.blocks))
        order = np.argsort(code, kind="stable")
        first = np.cumsum(sizes) - sizes
        grouped = []
        for size in np.unique(sizes):
            same = np.flatnonzero(sizes == size)
            grouped.append((int(size), same, order[first[same][:, None] + np.arange(size)]))
        object.__setattr__(self, "count", len(code))
        object.__setattr__(self, "blocks_count", len(sizes))
        object.__setattr__(self, "_sizes", tuple(grouped))

    def weights(self) -> Iterator[Floats]:
        """How often each query is drawn, shape (D, N), some draws at a time; all of them hold `draws` rows."""
        for rows, parts in self._chunks():
            drawn = np.empty((rows, self.count))
            for part in parts:
                drawn[:, part.queries] = part.weights(rows)
            yield drawn

    def sums(self, table: Floats) -> Iterator[Floats]:
        """Sums of the columns of a table, shape (N, M), over the queries of each draw, shape (D, M), some at a time.

        The same as `weights() @ table` to the last digits, and some times faster: no weight is ever written down.
        """
        for rows, parts in self._chunks():
            total = np.zeros((rows, table.shape[1]))
            for part in parts:
                total += part.picks(rows) @ table[part.queries]
            yield total

    def _chunks(self) -> Iterator[tuple[int, Iterator["_Picked"]]]:
        """How many draws at a time, and what each of them takes from the blocks of each size."""
        rng = np.random.default_rng(self.seed)
        step = max(1, _CHUNK_CELLS // max(self.count, 1))
        for begin in range(0, self.draws if self.count else 0, step):
            rows = min(step, self.draws - begin)
            yield rows, self._some(rng, rows)

    def _some(self, rng: np.random.Generator, rows: int) -> Iterator["_Picked"]:
        """Draw blocks, then queries in them."""
        blocks = self.blocks_count
        shifted = rng.integers(0, blocks, size=(rows, blocks))
        shifted += blocks * np.arange(rows)[:, None]
        times = np.bincount(shifted.ravel(), minlength=rows * blocks).reshape(rows, blocks)
        for size, which, queries in self._sizes:
            copies = times[:, which]
            if size == 1 or not self.draws_queries:
                yield _Picked(size=size, queries=queries.ravel(), copies=copies, within=None)
                continue
            # Of each draw and block so many queries are drawn from `size`.
            within = rng.integers(0, size, size=int(copies.sum()) * size, dtype=_small(size))
            yield _Picked(size=size, queries=queries.ravel(), copies=copies, within=within)


@dataclass(frozen=True, slots=True, kw_only=True)
class _Picked:
    """What some draws take from K blocks of one size.

    `queries`, shape (K * size,), are those of the blocks, one block after the other; `copies`, shape (D, K), says how
    often each block is drawn; `within` which of its queries, draw after draw and block after block: each of them as
    often as its block where it is None.
    """

    size: int
    queries: Ints
    copies: Ints
    within: NDArray[np.integer] | None

    def weights(self, rows: int) -> Floats:
        """How often each query is taken, shape (D, K * size)."""
        if self.within is None:
            return np.repeat(self.copies, self.size, axis=1).astype(np.float64)
        cells = self.copies.ravel() * self.size
        flat = np.repeat(np.arange(len(cells)) * self.size, cells) + self.within
        return np.bincount(flat, minlength=len(cells) * self.size).reshape(rows, -1).astype(np.float64)

    def picks(self, rows: int) -> csr_array | Floats:
        """The same, as a table with one entry for each query that is taken."""
        if self.within is None and self.size > 1:
            return self.weights(rows)
        first = np.arange(self.copies.shape[1], dtype=np.int32) * self.size
        column = np.repeat(np.tile(first, rows), self.copies.ravel() * self.size)
        if self.within is not None:
            column += self.within
        ends = np.concatenate(([0], np.cumsum(self.copies.sum(axis=1) * self.size)))
        return csr_array((np.ones(len(column)), column, ends), shape=(rows, len(self.queries)))


def _small(size: int) -> type[np.uint16] | type[np.uint32]:
    """Give the type that draws numbers below a size fastest."""
    return np.uint16 if size <= np.iinfo(np.uint16).max else np.uint32


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
