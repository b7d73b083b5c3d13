# SPDX-License-Identifier: Apache-2.0
"""Pairs of junctions, indexed by distance and directions of their arms."""

from dataclasses import dataclass
from typing import Final, Self

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from sasgeo_bench.geometry.angles import bearing_deg
from sasgeo_bench.sasgeo.kinds import INDEX
from sasgeo_bench.sasgeo.nodes import Floats, Ints, Nodes

Bits = NDArray[np.uint64]

JUNCTIONS: Final = (INDEX["intersection"], INDEX["mask intersection"])
SECTORS: Final = 36  # of 10 degrees, for directions of arms
_ARMS: Final = 3
_ONE: Final = np.uint64(1)
_LAST: Final = np.uint64(SECTORS - 1)
_HALF: Final = np.uint64(SECTORS // 2)
_ALL: Final = np.uint64((1 << SECTORS) - 1)


@dataclass(frozen=True, kw_only=True)
class JunctionPairs:
    """Pairs of junctions of one kind, the nearest first.

    Parameters
    ----------
    ends : ndarray of int64, shape (T, 2)
        Rows of the nodes.
    length_m, bearing_deg : ndarray of float64, shape (T,)
        From the first to the second.
    arms : ndarray of uint64, shape (T, 2)
        Of either end, one bit for each of `SECTORS` with an arm, counted from that bearing.
    """

    ends: Ints
    length_m: Floats
    bearing_deg: Floats
    arms: Bits

    @classmethod
    def of(cls, nodes: Nodes, kind: int, *, range_m: tuple[float, float]) -> Self:
        """Return pairs of junctions with at least three arms within a range of distances, metres."""
        chosen = np.flatnonzero((nodes.kind == kind) & (np.isfinite(nodes.arms_deg).sum(axis=1) >= _ARMS))
        places_m = nodes.places_m[chosen]
        pairs = np.zeros((0, 2), dtype=np.int64)
        if len(chosen):
            pairs = cKDTree(places_m).query_pairs(range_m[1], output_type="ndarray").astype(np.int64)
        along_m = places_m[pairs[:, 1]] - places_m[pairs[:, 0]]
        length_m = np.hypot(*along_m.T)
        order = np.lexsort((pairs[:, 1], pairs[:, 0], length_m))
        order = order[length_m[order] >= range_m[0]]
        ends, bearing = chosen[pairs[order]], bearing_deg(*along_m[order].T)
        arms = _sectors(nodes.arms_deg[ends] - bearing[:, None, None])
        return cls(ends=ends, length_m=length_m[order], bearing_deg=bearing, arms=arms)

    def turned(self) -> Self:
        """Return the pairs from their other ends."""
        arms = self.arms[:, ::-1]
        return type(self)(
            ends=self.ends[:, ::-1],
            length_m=self.length_m,
            bearing_deg=np.mod(self.bearing_deg + 180.0, 360.0),
            arms=((arms << _HALF) | (arms >> _HALF)) & _ALL,
        )

    def like(self, arms: Bits, first: int, last: int) -> Ints:
        """Return rows from `first` to `last` whose arms, shape (2,), agree but for one more or less at each end."""
        theirs = self.arms[first:last]
        common = np.bitwise_count(theirs & _widened(arms))
        count = np.bitwise_count(theirs).astype(np.int64)
        own = np.bitwise_count(arms).astype(np.int64)
        fits = (common >= np.minimum(count, own)) & (np.abs(count - own) <= 1)
        return np.asarray(first + np.flatnonzero(fits.all(axis=1)))


def _sectors(turned_deg: Floats) -> Bits:
    """Return bits of the sectors of angles of shape (..., A), shape (...); NaN has none."""
    finite = np.isfinite(turned_deg)
    share = np.mod(np.where(finite, turned_deg, 0.0), 360.0) / 360.0
    sector = np.minimum((share * SECTORS).astype(np.uint64), _LAST)
    return np.asarray(np.bitwise_or.reduce(np.where(finite, _ONE << sector, np.uint64(0)), axis=-1), dtype=np.uint64)


def _widened(arms: Bits) -> Bits:
    """Return sectors and their neighbours."""
    return np.asarray((arms | (arms << _ONE) | (arms >> _LAST) | (arms >> _ONE) | (arms << _LAST)) & _ALL)
