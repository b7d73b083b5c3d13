# SPDX-License-Identifier: Apache-2.0
"""Confidence intervals: a bootstrap over blocks and sites, never narrower than Wilson's interval of as many sites.

Bootstrap intervals are percentile intervals: they keep to the range of the metric, commute with monotone maps, and the
same draws serve every metric and difference. BCa intervals need an acceleration from leaving out blocks, which is
noise for a few dozen blocks of unequal size; studentised ones need a standard error within each draw. Percentile
intervals are somewhat narrow for few blocks. Drawing sites within drawn blocks makes them somewhat wide (Davison and
Hinkley 1997, Sec. 3.8), by up to sqrt(2) if sites of a block are independent. For few sites draws say too little, and
nothing where all answers are right, so `share_interval` compares them with Wilson's.
"""

import hashlib
import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from typing import Final

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.sparse import csr_array
from statsmodels.stats.proportion import proportion_confint

from sasgeo_bench.errors import MetricError
from sasgeo_bench.scoring.base import Floats, Ints, block_codes, check_column, check_weights, weighted_mean

DRAWS: Final = 10_000
_CHUNK_CELLS: Final = 2**21  # draws x queries in memory at once: 16 MB per column, about ten columns at most


def seed_of_text(text: str) -> int:
    """Return a seed in [0, 2^64): the first eight bytes of the SHA-256 of a text."""
    return int.from_bytes(hashlib.sha256(text.encode()).digest()[:8], "big")


@dataclass(frozen=True, kw_only=True)
class ClusterDraws:
    """Draws with replacement: first blocks, then sites within each drawn block, with all their queries.

    Metrics with the same seed, blocks, sites and number of draws share draws. `blocks` holds the block of each of N
    queries, `sites` the site within its block; by default each query is a site. Queries of a site show one place, so
    they are drawn together. Without `draws_within`, whole blocks are drawn. A block of n sites that is drawn c times
    gives c n sites, each drawn from its n. Sample sizes differ between draws if blocks or sites differ in size; means
    are ratios of sums and account for that. Raise MetricError if the number of draws is not positive, or the numbers of
    sites and blocks differ.

    Two queries of one site are drawn together:

    >>> drawn = ClusterDraws(blocks=["a", "a", "b"], sites=["p", "p", "q"], seed=1, draws=1000)
    >>> all((some[:, 0] == some[:, 1]).all() for some in drawn.weights())
    True
    """

    blocks: Sequence[str] | Ints
    seed: int
    sites: Sequence[str] | Ints | None = None
    draws: int = DRAWS
    draws_within: bool = True
    count: int = field(init=False)  # of queries
    blocks_count: int = field(init=False)
    _sites_count: int = field(init=False, repr=False)
    _site: Ints | None = field(init=False, repr=False)  # site of each query; None if each has its own
    _sizes: tuple[tuple[int, Ints, Ints], ...] = field(init=False, repr=False)  # size, blocks (K,), sites (K, size)

    def __post_init__(self) -> None:
        """Group blocks by size, so that drawing takes few vectorized steps."""
        if self.draws < 1:
            message = f"draws must be at least 1, got {self.draws!r}"
            raise MetricError(message)
        _, block = block_codes(self.blocks, len(self.blocks))
        site, first_of = _numbered(block, self.sites)
        sizes, code = block_codes(block[first_of], len(first_of))
        order = np.argsort(code, kind="stable")
        first = np.cumsum(sizes) - sizes
        grouped = []
        for size in np.unique(sizes):
            same = np.flatnonzero(sizes == size)
            grouped.append((int(size), same, order[first[same][:, None] + np.arange(size)]))
        object.__setattr__(self, "count", len(block))
        object.__setattr__(self, "_site", None if len(first_of) == len(block) else site)
        object.__setattr__(self, "_sites_count", len(first_of))
        object.__setattr__(self, "blocks_count", len(sizes))
        object.__setattr__(self, "_sizes", tuple(grouped))

    def weights(self) -> Iterator[Floats]:
        """Yield how often each query is drawn, shape (D, N), in chunks that sum to `draws` rows."""
        for rows, parts in self._chunks():
            drawn = np.empty((rows, self._sites_count))
            for part in parts:
                drawn[:, part.sites] = part.weights(rows)
            yield drawn if self._site is None else drawn[:, self._site]

    def sums(self, table: Floats) -> Iterator[Floats]:
        """Yield the sums of a table's columns, shape (N, M), over the queries of each draw, shape (D, M), in chunks.

        Equals `weights() @ table` up to rounding, but is several times faster: no weights are stored.
        """
        if self._site is not None:
            order = np.argsort(self._site, kind="stable")
            table = np.add.reduceat(table[order], np.flatnonzero(np.diff(self._site[order], prepend=-1)))
        for rows, parts in self._chunks():
            total = np.zeros((rows, table.shape[1]))
            for part in parts:
                total += part.picks(rows) @ table[part.sites]
            yield total

    def _chunks(self) -> Iterator[tuple[int, Iterator["_Picked"]]]:
        """Yield the number of draws of a chunk, and its picks from the blocks of each size."""
        rng = np.random.default_rng(self.seed)
        step = max(1, _CHUNK_CELLS // max(self.count, 1))
        for begin in range(0, self.draws if self.count else 0, step):
            rows = min(step, self.draws - begin)
            yield rows, self._some(rng, rows)

    def _some(self, rng: np.random.Generator, rows: int) -> Iterator["_Picked"]:
        """Draw blocks, then sites in them."""
        blocks = self.blocks_count
        shifted = rng.integers(0, blocks, size=(rows, blocks))
        shifted += blocks * np.arange(rows)[:, None]
        times = np.bincount(shifted.ravel(), minlength=rows * blocks).reshape(rows, blocks)
        for size, which, sites in self._sizes:
            copies = times[:, which]
            if size == 1 or not self.draws_within:
                yield _Picked(size=size, sites=sites.ravel(), copies=copies, within=None)
                continue
            # For each draw and block, as many sites are drawn as the block has, times its copies.
            dtype = np.uint16 if size <= np.iinfo(np.uint16).max else np.uint32
            within = rng.integers(0, size, size=int(copies.sum()) * size, dtype=dtype)
            yield _Picked(size=size, sites=sites.ravel(), copies=copies, within=within)


def _numbered(block: Ints, sites: Sequence[str] | Ints | None) -> tuple[Ints, Ints]:
    """Return each query's site by first appearance, shape (N,), and the first query of each site, shape (S,)."""
    if sites is None:
        return np.arange(len(block)), np.arange(len(block))
    _, code = block_codes(sites, len(block))
    within = block * (1 + int(code.max(initial=0))) + code  # a site in two blocks counts as two
    _, first, inverse = np.unique(within, return_index=True, return_inverse=True)
    return np.argsort(np.argsort(first))[inverse], np.sort(first)


@dataclass(frozen=True, slots=True, kw_only=True)
class _Picked:
    """Draws from K blocks of one size.

    `sites`, shape (K * size,), are those of the blocks, one block after the other; `copies`, shape (D, K), counts how
    often each block is drawn. `within` are the drawn positions in the block, by draw and block; None takes each site as
    often as its block.
    """

    size: int
    sites: Ints
    copies: Ints
    within: NDArray[np.integer] | None

    def weights(self, rows: int) -> Floats:
        """Return how often each site is drawn, shape (D, K * size)."""
        if self.within is None:
            return np.repeat(self.copies, self.size, axis=1).astype(np.float64)
        cells = self.copies.ravel() * self.size
        flat = np.repeat(np.arange(len(cells)) * self.size, cells) + self.within
        return np.bincount(flat, minlength=len(cells) * self.size).reshape(rows, -1).astype(np.float64)

    def picks(self, rows: int) -> csr_array | Floats:
        """Return the same as a sparse table with one entry per drawn site."""
        if self.within is None and self.size > 1:
            return self.weights(rows)
        first = np.arange(self.copies.shape[1], dtype=np.int32) * self.size
        column = np.repeat(np.tile(first, rows), self.copies.ravel() * self.size)
        if self.within is not None:
            column += self.within
        ends = np.concatenate(([0], np.cumsum(self.copies.sum(axis=1) * self.size)))
        return csr_array((np.ones(len(column)), column, ends), shape=(rows, len(self.sites)))


LEVEL: Final = 0.95


@dataclass(frozen=True, slots=True, kw_only=True)
class Interval:
    """A value and its interval; NaN where unknown."""

    value: float
    lo: float
    hi: float


def wilson(successes: float, trials: float, *, level: float = LEVEL) -> Interval:
    """Return Wilson's score interval of a proportion; [0, 1] without trials.

    `successes` and `trials` may be fractions, as for hits shared among tied poses or with weights. Raise MetricError if
    not 0 <= successes <= trials, or the level is not in (0, 1).

    Wilson, JASA 1927, without continuity correction. The trials must be independent: across blocks use the bootstrap.

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
    # Rounding moves the ends of 0 of n and n of n slightly inwards.
    lo, hi = (0.0 if successes == 0 else float(lo)), (1.0 if successes == trials else float(hi))
    return Interval(value=successes / trials, lo=lo, hi=hi)


def _check_level(level: float) -> None:
    if not 0 < level < 1:
        message = f"level must lie in (0, 1), got {level!r}"
        raise MetricError(message)


def wilson_mean(values: ArrayLike) -> Interval:
    """Return Wilson's interval of a mean of values in [0, 1], shape (N,), as hits with ties.

    Values between 0 and 1 vary less than successes and failures, so the interval is not too narrow. Raise MetricError
    if a value lies outside [0, 1].

    >>> wilson_mean([1.0, 0.5, 0.5, 0.0]) == wilson(2, 4)
    True
    """
    column = check_column(values, "values")
    if ((column < 0) | (column > 1)).any():
        message = f"values reach from {column.min():g} to {column.max():g}, expected shares in [0, 1]"
        raise MetricError(message)
    return wilson_share(weighted_mean(column), len(column))


def wilson_share(share: float, trials: float, *, level: float = LEVEL) -> Interval:
    """Return Wilson's interval of a share of some trials, which need not be whole; of a NaN that of no trials."""
    return wilson(0.0, 0.0) if math.isnan(share) else wilson(min(share * trials, trials), trials, level=level)


def bootstrap_means(values: ArrayLike, drawn: ClusterDraws, weights: ArrayLike | None = None) -> Floats:
    """Return weighted means of every draw, shape (D,) or (D, M); NaN where a draw has no weight.

    `values` has shape (N,), or (N, M) for M methods or metrics that share the draws. Raise MetricError if a value is
    not finite, or their number is not that of the queries.

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


def bootstrap_statistic(statistic: Callable[[Floats], float], drawn: ClusterDraws) -> Floats:
    """Return a statistic of every draw, shape (D,); slower than `bootstrap_means`.

    `statistic` maps weights, shape (N,), to a number, as `lambda weights: aurc(answers, weights)`.
    """
    return np.array([statistic(row) for some in drawn.weights() for row in some], dtype=np.float64)


def percentile_interval(value: float, draws: ArrayLike, *, level: float = LEVEL) -> Interval:
    """Return the interval between percentiles of the draws, shape (D,), without NaN; NaN where none is left.

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
    """Return the effective number of groups, as sites: (sum m)^2 / sum m^2 of the groups' masses m (Kish 1965).

    Groups of equal mass count 1 each; 0 for nothing.

    >>> effective_count(["a", "a", "b", "b"]), effective_count(["a", "a", "a", "b"])
    (2.0, 1.6)
    """
    sizes, code = block_codes(groups, len(groups))
    mass = np.bincount(code, weights=check_weights(weights, len(code)), minlength=len(sizes))
    squared = float((mass**2).sum())
    return float(mass.sum()) ** 2 / squared if squared > 0 else 0.0


def share_interval(value: float, draws: ArrayLike, trials: float) -> tuple[Interval, str]:
    """Return the 95 % interval of a metric in [0, 1], and how it was found; NaN gives NaN and "".

    `draws`, shape (D,), are its bootstrap draws, empty for a single block; `trials` is the effective number of
    independent trials, as sites by `effective_count`. The ends are percentiles of the draws, but never inside Wilson's
    interval. "blocks" means that draws decide both ends, "wilson" that Wilson's lies farther out at one.

    A mean of values in [0, 1] varies at most as much as a proportion, so Wilson's interval of as many sites is wide
    enough if blocks add no correlation. Draws alone are too narrow for few sites, and a point where all answers are
    right. The wider end keeps the order: a method that is right wherever another one is has both ends at least as high.

    Four sites, all found:

    >>> found, how = share_interval(1.0, np.ones(100), 4)
    >>> round(found.lo, 2), found.hi, how
    (0.51, 1.0, 'wilson')
    """
    if math.isnan(value):
        return Interval(value=value, lo=value, hi=value), ""
    exact = wilson_share(max(value, 0.0), trials)
    drawn = percentile_interval(value, draws)
    ends = Interval(value=value, lo=float(np.fmin(drawn.lo, exact.lo)), hi=float(np.fmax(drawn.hi, exact.hi)))
    return ends, "blocks" if (ends.lo, ends.hi) == (drawn.lo, drawn.hi) else "wilson"


def difference_interval(first: Interval, second: Interval) -> Interval:
    """Return the interval of first less second from those of both sides.

    The sides are independent, or vary against each other no more than parts of one whole. Distances to the ends are
    added in quadrature (Newcombe 1998; Zou and Donner, Statistics in Medicine 2008).
    """
    value = first.value - second.value
    return Interval(
        value=value,
        lo=value - math.hypot(first.value - first.lo, second.hi - second.value),
        hi=value + math.hypot(first.hi - first.value, second.value - second.lo),
    )


def mean_interval(values: ArrayLike, drawn: ClusterDraws) -> Interval:
    """Return a mean with its bootstrap interval over blocks; NaN ends for fewer than two blocks.

    `values`, shape (N,), are finite; the difference of two methods per query gives a paired interval. The interval is a
    point where all values are equal: compare `wilson_mean`.

    >>> mean_interval([1.0, 0.0, 1.0, 1.0], ClusterDraws(blocks=["a", "a", "b", "b"], seed=1, draws=500))
    Interval(value=0.75, lo=0.25, hi=1.0)
    """
    column = check_column(values, "values", drawn.count)
    draws = bootstrap_means(column, drawn) if drawn.blocks_count > 1 else np.empty(0)
    return percentile_interval(weighted_mean(column), draws)
