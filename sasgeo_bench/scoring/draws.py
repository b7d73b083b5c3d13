# SPDX-License-Identifier: Apache-2.0
"""Bootstrap draws: blocks, then sites within them."""

import hashlib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array

from sasgeo_bench.errors import MetricError
from sasgeo_bench.scoring.base import Floats, Ints, block_codes

DRAWS: Final = 10_000
_CHUNK_CELLS: Final = 2**21  # draws x queries in memory at once: 16 MB per column, about ten columns at most


def seed_of_text(text: str) -> int:
    """Return a seed in [0, 2^64): the first eight bytes of the SHA-256 of a text."""
    return int.from_bytes(hashlib.sha256(text.encode()).digest()[:8], "big")


@dataclass(frozen=True, kw_only=True)
class ClusterDraws:
    """Draws with replacement: first blocks, then sites within each drawn block, with all their queries.

    Parameters
    ----------
    blocks : sequence of str or ndarray of int, length N
        Block of each query. Metrics to compare must have the same queries in the same order.
    sites : sequence of str or ndarray of int, length N, optional
        Site of each query within its block; by default each query is a site. Queries of a site show one place, so they
        are drawn together.
    seed : int
        The same seed, blocks and number of draws give the same draws for every metric.
    draws : int
        Number of draws.
    draws_within : bool
        False draws whole blocks.

    Raises
    ------
    MetricError
        If the number of draws is not positive, or the numbers of sites and blocks differ.

    Notes ----- A block of n sites that is drawn c times gives c n sites, each drawn from its n. Sample sizes differ
    between draws if blocks or sites differ in size; means are ratios of sums and account for that.

    Examples
    --------
    >>> drawn = ClusterDraws(blocks=["a", "a", "b"], seed=1, draws=1000)
    >>> weights = np.vstack(list(drawn.weights()))
    >>> weights.shape, bool((weights.sum(axis=1) >= 2).all()), round(float(weights.mean()), 1)
    ((1000, 3), True, 1.0)

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
            within = rng.integers(0, size, size=int(copies.sum()) * size, dtype=_small(size))
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


def _small(size: int) -> type[np.uint16] | type[np.uint32]:
    return np.uint16 if size <= np.iinfo(np.uint16).max else np.uint32
