# SPDX-License-Identifier: Apache-2.0
"""Confidence intervals: a bootstrap over places, blocks and sites, never narrower than Wilson's interval of the sites.

Places are the unit: blocks of one town share its mappers, its streets and its detector's luck, so a claim about other
towns is as sure as its towns are many. Intervals over blocks alone stand beside, for the towns that were asked.

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
from dataclasses import dataclass, field, replace
from typing import Any, Final, Self

import numpy as np
import pandas as pd
from numpy.typing import ArrayLike, NDArray
from scipy.sparse import csr_array
from statsmodels.stats.proportion import proportion_confint

from sasgeo_bench.core.errors import MetricError
from sasgeo_bench.scoring.base import Floats, Ints, block_codes, check_column, check_weights, weighted_mean

DRAWS: Final = 10_000
_CHUNK_CELLS: Final = 2**21  # draws x queries in memory at once, 16 MB; another number would give other draws
_CACHED_CELLS: Final = 2**16  # draws x sites that are counted at once: fewer than fit a core's cache


def seed_of_text(text: str) -> int:
    """Return a seed in [0, 2^64): the first eight bytes of the SHA-256 of a text."""
    return int.from_bytes(hashlib.sha256(text.encode()).digest()[:8], "big")


@dataclass(frozen=True, kw_only=True)
class ClusterDraws:
    """Draws with replacement: places, blocks within each drawn place, sites within each drawn block, with all queries.

    Metrics with the same seed, places, blocks, sites and number of draws share draws. `blocks` holds the block of each
    of N queries, `places` the place of each block; without it, blocks are drawn first. `sites` holds the site within
    the block; by default each query is a site. Queries of a site show one place, so they are drawn together. Without
    `draws_within`, whole blocks are drawn. A block of n sites that is drawn c times gives c n sites, each drawn from
    its n, and a place likewise. Sample sizes differ between draws if clusters differ in size; means are ratios of sums
    and account for that. `units_count` counts what is drawn first. Raise MetricError if the number of draws is not
    positive, the numbers of places, sites and blocks differ, or a block is in two places.

    Two queries of one site are drawn together:

    >>> drawn = ClusterDraws(blocks=["a", "a", "b"], sites=["p", "p", "q"], seed=1, draws=1000)
    >>> all((some[:, 0] == some[:, 1]).all() for some in drawn.weights())
    True

    With one place of two, both blocks of it come from that place:

    >>> drawn = ClusterDraws(blocks=["a", "b", "c"], places=["vaduz", "vaduz", "monaco"], seed=1, draws=1000)
    >>> sorted({(int(row[0] + row[1]), int(row[2])) for some in drawn.weights() for row in some})
    [(0, 2), (2, 1), (4, 0)]
    """

    blocks: Sequence[str] | Ints
    seed: int
    sites: Sequence[str] | Ints | None = None
    places: Sequence[str] | Ints | None = None
    draws: int = DRAWS
    draws_within: bool = True
    count: int = field(init=False)  # of queries
    blocks_count: int = field(init=False)
    units_count: int = field(init=False)  # places, or blocks without places
    _sites_count: int = field(init=False, repr=False)
    _site: Ints | None = field(init=False, repr=False)  # site of each query; None if each has its own
    _sites_of: tuple["_Group", ...] = field(init=False, repr=False)  # sites of each block
    _blocks_of: tuple["_Group", ...] = field(init=False, repr=False)  # blocks of each place; empty without places

    def __post_init__(self) -> None:
        """Group blocks by size, so that drawing takes few vectorized steps."""
        if self.draws < 1:
            raise MetricError(f"draws must be at least 1, got {self.draws!r}")
        sizes, block = block_codes(self.blocks, len(self.blocks))
        site, first_of = _numbered(block, self.sites)
        place = np.arange(len(sizes)) if self.places is None else _place_of(self.places, block, len(sizes))
        object.__setattr__(self, "count", len(block))
        object.__setattr__(self, "_site", None if len(first_of) == len(block) else site)
        object.__setattr__(self, "_sites_count", len(first_of))
        object.__setattr__(self, "blocks_count", len(sizes))
        object.__setattr__(self, "units_count", int(place.max(initial=-1)) + 1)
        object.__setattr__(self, "_sites_of", tuple(_grouped(block[first_of])))
        object.__setattr__(self, "_blocks_of", () if self.places is None else tuple(_grouped(place)))

    def weights(self) -> Iterator[Floats]:
        """Yield how often each query is drawn, shape (D, N), in chunks that sum to `draws` rows."""
        for rows, parts in self._chunks():
            drawn = np.empty((rows, self._sites_count))
            for part in parts:
                drawn[:, part.sites] = part.weights()
            yield drawn if self._site is None else drawn[:, self._site]

    def sums(self, table: Floats | csr_array) -> Iterator[Floats]:
        """Yield the sums of a table's columns, shape (N, M), over the queries of each draw, shape (D, M), in chunks.

        Equals `weights() @ table` up to rounding, without a weight for each query of a site.
        """
        of_sites: Any = table
        if self._site is not None:
            cells = (np.ones(self.count), (self._site, np.arange(self.count)))
            of_sites = csr_array(cells, shape=(self._sites_count, self.count)) @ table
        for rows, parts in self._chunks():
            total = np.zeros((rows, table.shape[1]))
            for part in parts:
                total += part.weights() @ of_sites[part.sites]
            yield total

    def _chunks(self) -> Iterator[tuple[int, Iterator["_Picked"]]]:
        """Yield the number of draws of a chunk, and its picks from the blocks of each size."""
        rng = np.random.default_rng(self.seed)
        step = max(1, _CHUNK_CELLS // max(self.count, 1))
        for begin in range(0, self.draws if self.count else 0, step):
            rows = min(step, self.draws - begin)
            yield rows, self._some(rng, rows)

    def _some(self, rng: np.random.Generator, rows: int) -> Iterator["_Picked"]:
        """Draw places, then blocks in them, then sites in these."""
        times = _times(rng, rows, self.units_count)
        if self._blocks_of:
            drawn = np.empty((rows, self.blocks_count), dtype=np.int64)
            for group in self._blocks_of:
                drawn[:, group.children.ravel()] = group.picked(rng, times, draws_within=True).weights()
            times = drawn
        for group in self._sites_of:
            yield group.picked(rng, times, draws_within=self.draws_within)


def _times(rng: np.random.Generator, rows: int, count: int) -> Ints:
    """Draw `count` of `count` units with replacement; return how often each is drawn, shape (rows, count)."""
    shifted = rng.integers(0, count, size=(rows, count))
    shifted += count * np.arange(rows)[:, None]
    return np.bincount(shifted.ravel(), minlength=rows * count).reshape(rows, count)


@dataclass(frozen=True, slots=True, kw_only=True)
class _Group:
    """Clusters of one size: their indices, shape (K,), and those of their children, shape (K, size)."""

    clusters: Ints
    children: Ints

    def picked(self, rng: np.random.Generator, times: Ints, *, draws_within: bool) -> "_Picked":
        """Draw as many children as a cluster has, times its copies; `times` counts the copies, shape (D, clusters)."""
        copies, size = times[:, self.clusters], self.children.shape[1]
        within = None
        if size > 1 and draws_within:
            dtype = np.uint16 if size <= np.iinfo(np.uint16).max else np.uint32
            within = rng.integers(0, size, size=int(copies.sum()) * size, dtype=dtype)
        return _Picked(size=size, sites=self.children.ravel(), copies=copies, within=within)


def _grouped(parent: Ints) -> Iterator[_Group]:
    """Yield clusters by size, from the cluster of each child, shape (N,)."""
    sizes, code = block_codes(parent, len(parent))
    order = np.argsort(code, kind="stable")
    first = np.cumsum(sizes) - sizes
    for size in np.unique(sizes):
        same = np.flatnonzero(sizes == size)
        yield _Group(clusters=same, children=order[first[same][:, None] + np.arange(size)])


def _place_of(places: Sequence[str] | Ints, block: Ints, count: int) -> Ints:
    """Return the place of each block, shape (count,)."""
    _, code = block_codes(places, len(block))
    place = np.zeros(count, dtype=np.int64)
    place[block] = code
    if (place[block] != code).any():
        raise MetricError("a block is in two places: name blocks by their region")
    return place


def _numbered(block: Ints, sites: Sequence[str] | Ints | None) -> tuple[Ints, Ints]:
    """Return each query's site by first appearance, shape (N,), and the first query of each site, shape (S,)."""
    if sites is None:
        return np.arange(len(block)), np.arange(len(block))
    _, code = block_codes(sites, len(block))
    within = block * (1 + int(code.max(initial=0))) + code  # a site in two blocks counts as two
    site, names = pd.factorize(within)  # in the order of their appearance
    first = np.empty(len(names), dtype=np.int64)
    first[site[::-1]] = np.arange(len(site))[::-1]
    return np.asarray(site, dtype=np.int64), first


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

    def weights(self) -> Floats:
        """Return how often each site is drawn, shape (D, K * size)."""
        if self.within is None:
            return np.repeat(self.copies, self.size, axis=1).astype(np.float64)
        found = np.empty((len(self.copies), len(self.sites)))
        step, end = max(1, _CACHED_CELLS // len(self.sites)), 0
        for first in range(0, len(found), step):
            some = slice(first, first + step)
            cells = self.copies[some].ravel() * self.size
            begin, end = end, end + int(cells.sum())
            site = np.repeat(np.arange(0, len(cells) * self.size, self.size), cells)
            site += self.within[begin:end]
            found[some] = np.bincount(site, minlength=len(cells) * self.size).reshape(-1, len(self.sites))
        return found


LEVEL: Final = 0.95
LEAST_CLUSTERS: Final = 6  # of an interval by draws alone: of fewer they are too narrow
_Names = Sequence[str] | Ints


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
        raise MetricError(f"successes must lie between 0 and the trials, got {successes!r} of {trials!r}")
    if trials == 0:
        return Interval(value=float("nan"), lo=0.0, hi=1.0)
    lo, hi = _wilson_ends(np.array([successes / trials]), np.array([trials]), level=level)[0].tolist()
    return Interval(value=successes / trials, lo=lo, hi=hi)


def _wilson_ends(shares: Floats, trials: Floats, *, level: float = LEVEL) -> Floats:
    """Return the ends of Wilson's intervals of M shares, shape (M, 2); 0 and 1 without trials."""
    is_bare = trials == 0
    counts = np.where(is_bare, 1.0, trials)
    lo, hi = proportion_confint(shares * counts, counts, alpha=1.0 - level, method="wilson")
    # Rounding moves the ends of 0 of n and n of n slightly inwards.
    is_least, is_most = is_bare | (shares == 0), is_bare | (shares == 1)
    return np.column_stack((np.where(is_least, 0.0, lo), np.where(is_most, 1.0, hi)))


def _check_level(level: float) -> None:
    if not 0 < level < 1:
        raise MetricError(f"level must lie in (0, 1), got {level!r}")


def wilson_mean(values: ArrayLike) -> Interval:
    """Return Wilson's interval of a mean of values in [0, 1], shape (N,), as hits with ties.

    Values between 0 and 1 vary less than successes and failures, so the interval is not too narrow. Raise MetricError
    if a value lies outside [0, 1].

    >>> wilson_mean([1.0, 0.5, 0.5, 0.0]) == wilson(2, 4)
    True
    """
    column = check_column(values, "values")
    if ((column < 0) | (column > 1)).any():
        raise MetricError(f"values reach from {column.min():g} to {column.max():g}, expected shares in [0, 1]")
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
        raise MetricError(
            f"values have shape {table.shape}, expected ({drawn.count},) or ({drawn.count}, M), all finite"
        )
    mass = check_weights(weights, drawn.count)
    columns = np.column_stack((table.reshape(len(table), -1) * mass[:, None], mass))
    sums = np.concatenate(list(drawn.sums(columns)) or [np.full((drawn.draws, columns.shape[1]), 0.0)])
    total = sums[:, -1:]
    means = np.divide(sums[:, :-1], total, out=np.full(sums[:, :-1].shape, np.nan), where=total > 0)
    return np.asarray(means[:, 0] if table.ndim == 1 else means)


def distinct_columns(table: Floats) -> tuple[Floats, Ints]:
    """Return the distinct columns of a table, shape (N, K), and which of them each column is, shape (M,).

    Many metrics of many methods agree on every query, and what is drawn of equal columns is equal.

    >>> columns, code = distinct_columns(np.array([[1.0, 0.0, 1.0], [1.0, 0.0, 1.0]]))
    >>> columns.T.tolist(), code.tolist()
    ([[1.0, 1.0], [0.0, 0.0]], [0, 1, 0])
    """
    found: dict[bytes, int] = {}
    names = (column.tobytes() for column in np.ascontiguousarray(table.T))
    code = np.array([found.setdefault(name, len(found)) for name in names], dtype=np.int64)
    return table[:, np.unique(code, return_index=True)[1]], code


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
    lo, hi = percentile_ends(np.reshape(draws, (-1, 1)), level=level)
    return Interval(value=value, lo=float(lo[0]), hi=float(hi[0]))


def percentile_ends(draws: ArrayLike, *, level: float = LEVEL) -> tuple[Floats, Floats]:
    """Return the ends of `percentile_interval` for each column of draws, shape (D, M), as two arrays of shape (M,).

    >>> [ends.tolist() for ends in percentile_ends([[3.0, math.nan], [1.0, 5.0], [2.0, 5.0]])]
    [[1.0, 5.0], [3.0, 5.0]]
    """
    _check_level(level)
    columns = np.ascontiguousarray(np.transpose(np.asarray(draws, dtype=np.float64)))
    counts = np.count_nonzero(~np.isnan(columns), axis=1)
    tail = (1.0 - level) / 2
    last = np.maximum(counts - 1, 0)
    at = [np.clip(np.ceil(counts * share - 1.0).astype(np.int64), 0, last) for share in (tail, 1.0 - tail)]
    if not columns.size:
        return np.full(len(columns), np.nan), np.full(len(columns), np.nan)
    columns.sort(axis=1)  # NaN last; a third of the time that partitions at both ends take
    lo, hi = (columns[np.arange(len(columns)), place] for place in at)
    return lo, hi


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


@dataclass(frozen=True, slots=True, kw_only=True)
class BoardInterval:
    """A value with its 95 % interval by places and, beside it, by blocks; NaN where unknown.

    `how` says which of "places", "blocks" and "wilson" lies farthest out at either end; "" without an interval.
    """

    value: float
    lo: float = math.nan
    hi: float = math.nan
    lo_blocks: float = math.nan
    hi_blocks: float = math.nan
    how: str = ""

    def mapped(self, change: Callable[[float], float], value: float) -> Self:
        """Return another value with the ends changed by a monotone function."""
        lo, hi, lo_blocks, hi_blocks = map(change, (self.lo, self.hi, self.lo_blocks, self.hi_blocks))
        return replace(self, value=value, lo=lo, hi=hi, lo_blocks=lo_blocks, hi_blocks=hi_blocks)


def share_interval(value: float, drawn: tuple[ArrayLike, ArrayLike], trials: float) -> BoardInterval:
    """Return the 95 % intervals of a metric in [0, 1]; NaN for a value of NaN.

    `drawn` are its bootstrap draws over places and over blocks, shape (D,) each, empty for a single one; `trials` is
    the effective number of independent trials, as sites by `effective_count`. The ends by blocks are percentiles of
    their draws, but never inside Wilson's interval; those by places are never inside either.

    A mean of values in [0, 1] varies at most as much as a proportion, so Wilson's interval of as many sites is wide
    enough if blocks add no correlation. Draws alone are too narrow for few clusters, and a point where all answers are
    right. The wider end keeps the order: a method that is right wherever another one is has both ends at least as high.

    Four sites, all found:

    >>> found = share_interval(1.0, (np.ones(100), np.ones(100)), 4)
    >>> round(found.lo, 2), found.hi, found.how
    (0.51, 1.0, 'wilson')
    """
    places, blocks = (np.reshape(one, (-1, 1)) for one in drawn)
    return intervals_of_columns([value], (places, blocks), trials)[0]


def intervals_of_columns(
    values: ArrayLike, drawn: tuple[ArrayLike, ArrayLike], trials: ArrayLike
) -> list[BoardInterval]:
    """Return `share_interval` of each of M metrics, from draws of shape (D, M); far faster than one by one.

    >>> draws = np.array([[0.0, 1.0], [0.5, 1.0]])
    >>> [round(found.lo, 2) for found in intervals_of_columns([0.25, 1.0], (draws, draws), 4.0)]
    [0.0, 0.51]
    """
    places, blocks = (np.transpose(percentile_ends(one)) for one in drawn)
    return widest_intervals(values, (places, blocks), wilson_ends(values, trials))


def wilson_ends(values: ArrayLike, trials: ArrayLike) -> Floats:
    """Return the ends of Wilson's intervals of M shares, which may be NaN, shape (M, 2); `trials` as `share_interval`.

    >>> wilson_ends([1.0, 0.0], 4.0).round(2).tolist()
    [[0.51, 1.0], [0.0, 0.49]]
    """
    figures = np.asarray(values, dtype=np.float64)
    counts = np.broadcast_to(np.asarray(trials, dtype=np.float64), figures.shape)
    return _wilson_ends(np.clip(np.nan_to_num(figures), 0.0, 1.0), counts)


def widest_intervals(values: ArrayLike, ends: tuple[Floats, Floats], exact: Floats) -> list[BoardInterval]:
    """Return `intervals_of_columns` from the percentiles of the draws and `wilson_ends`, shape (M, 2) each."""
    columns = (np.asarray(one, np.float64).tolist() for one in (values, *ends, exact))
    return [
        BoardInterval(value=value) if math.isnan(value) else _outermost(value, *parts)
        for value, *parts in zip(*columns, strict=True)
    ]


def _outermost(value: float, places: list[float], blocks: list[float], exact: list[float]) -> BoardInterval:
    """Return the interval of the ends that lie farthest out; NaN counts as inside."""
    parts = {"places": places, "blocks": blocks, "wilson": exact}
    lows, highs = zip(*parts.values(), strict=True)
    lo, hi = (pick(end for end in ends if not math.isnan(end)) for pick, ends in ((min, lows), (max, highs)))
    rest = "wilson" if exact[0] == lo or exact[1] == hi else "blocks"
    return BoardInterval(
        value=value,
        lo=lo,
        hi=hi,
        lo_blocks=min(exact[0], blocks[0]),  # keeps the first where the second is NaN
        hi_blocks=max(exact[1], blocks[1]),
        how=next((name for name, one in parts.items() if one == [lo, hi]), rest),
    )


def amount_interval(value: float, drawn: tuple[ArrayLike, ArrayLike], clusters: int) -> BoardInterval:
    """Return the 95 % intervals of a mean of values without an upper bound, such as a count for each kilometre.

    Arguments are as of `share_interval`, but for trials: no distribution is known that would widen draws of few
    clusters (blocks), so there is no interval of fewer than `LEAST_CLUSTERS`, nor where nothing varies.

    >>> found = amount_interval(2.0, (np.linspace(1.0, 3.0, 101), np.full(101, 2.0)), 8)
    >>> round(found.lo, 2), round(found.hi, 2), found.how
    (1.04, 2.96, 'places')
    """
    places, blocks = (percentile_interval(value, one) for one in drawn)
    if clusters < LEAST_CLUSTERS or math.isnan(value) or not (places.lo < places.hi or blocks.lo < blocks.hi):
        return BoardInterval(value=value)
    lo, hi = float(np.fmin(places.lo, blocks.lo)), float(np.fmax(places.hi, blocks.hi))
    return BoardInterval(
        value=value,
        lo=lo,
        hi=hi,
        lo_blocks=blocks.lo,
        hi_blocks=blocks.hi,
        how="places" if (places.lo, places.hi) == (lo, hi) else "blocks",
    )


@dataclass(frozen=True, kw_only=True)
class BoardDraws:
    """Draws of the same queries by places and, beside them, by blocks; sites are drawn within either.

    `trials` is the effective number of sites, for Wilson's interval.

    >>> rows = {"place": ["a", "a", "b"], "block": ["a/0", "a/1", "b/0"], "site": ["p", "q", "r"]}
    >>> drawn = BoardDraws.of(rows["place"], rows["block"], rows["site"], seed=1, draws=500)
    >>> [means.shape for means in drawn.means(np.eye(3))]
    [(500, 3), (500, 3)]
    """

    by_place: ClusterDraws
    by_block: ClusterDraws
    trials: float

    @classmethod
    def of(cls, places: _Names, blocks: _Names, sites: _Names, *, seed: int, draws: int = DRAWS) -> Self:
        """Draw N queries by their places, blocks and sites, shape (N,) each."""
        by_place = ClusterDraws(places=places, blocks=blocks, sites=sites, seed=seed, draws=draws)
        by_block = ClusterDraws(blocks=blocks, sites=sites, seed=seed, draws=draws)
        return cls(by_place=by_place, by_block=by_block, trials=effective_count(sites))

    @property
    def both(self) -> tuple[ClusterDraws, ClusterDraws]:
        """Return the draws by places and those by blocks."""
        return self.by_place, self.by_block

    def means(self, table: ArrayLike, weights: ArrayLike | None = None) -> tuple[Floats, Floats]:
        """Return `bootstrap_means` by places and by blocks; without rows for a single cluster."""
        return self.of_both(lambda drawn: bootstrap_means(table, drawn, weights))

    def of_both(self, statistic: Callable[[ClusterDraws], Floats]) -> tuple[Floats, Floats]:
        """Return a statistic of each draw by places and by blocks; without rows for a single cluster."""
        first, second = (
            statistic(one) if one.units_count > 1 else statistic(replace(one, draws=1))[:0] for one in self.both
        )
        return first, second


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
