# SPDX-License-Identifier: Apache-2.0
"""Draws of clusters with replacement, for the bootstrap: places, blocks within them, sites within these."""

import hashlib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any, Final

import numpy as np
import pandas as pd
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
                drawn[:, part.sites] = part.weights(rows)
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
                total += part.weights(rows) @ of_sites[part.sites]
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
                drawn[:, group.children.ravel()] = group.picked(rng, times, draws_within=True).weights(rows)
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

    def weights(self, rows: int) -> Floats:
        """Return how often each site is drawn, shape (D, K * size)."""
        if self.within is None:
            return np.repeat(self.copies, self.size, axis=1).astype(np.float64)
        cells = self.copies.ravel() * self.size
        flat = np.repeat(np.arange(len(cells)) * self.size, cells) + self.within
        return np.bincount(flat, minlength=len(cells) * self.size).reshape(rows, -1).astype(np.float64)
