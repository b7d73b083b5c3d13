# SPDX-License-Identifier: Apache-2.0
"""Graph descriptor of the paper: numbers of objects of each kind, and their distances from each other."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Final, Self

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.distance import pdist

BINS: Final = 16  # of distances, from 0 to the longest possible
LEAST_M2: Final = 9.0  # smaller patches are noise
MOST_THINGS: Final = 1000  # of a kind, the largest: bounds the number of pairs
_CENTRE: Final = 0.5  # of a cell: OpenCV counts from the middle of the first one


@dataclass(frozen=True, kw_only=True)
class Descriptor:
    """Counts of objects by kind, shape (K,), and histograms of the distances of their pairs; invariant to rotation.

    `spread` has shape (K, BINS); each row sums to 1, or is 0 where there is no pair.
    """

    counts: NDArray[np.float64]
    spread: NDArray[np.float64]

    @classmethod
    def of(cls, things_m: Sequence[NDArray[np.float64]], *, reach_m: float) -> Self:
        """Describe places of objects of each kind, shape (N, 2) each, metres; `reach_m` is the longest distance.

        Examples
        --------
        >>> two = np.array([(0.0, 0.0), (8.0, 0.0)])
        >>> found = Descriptor.of([two], reach_m=15.0)
        >>> found.counts.tolist(), found.spread[0].argmax().item()
        ([2.0], 8)
        """
        counts = np.array([len(places_m) for places_m in things_m], dtype=np.float64)
        spread = [distances(places_m, reach_m=reach_m) for places_m in things_m]
        return cls(counts=counts, spread=np.array(spread, dtype=np.float64).reshape(-1, BINS))

    def scaled(self, shares: NDArray[np.float64]) -> Self:
        """Return the descriptor with counts scaled to shares of the area, kind by kind."""
        return replace(self, counts=self.counts * shares)

    def distance(self, other: Self) -> float:
        """Return the distance of two descriptors, 0..1: the mean over kinds of counts and histograms.

        Counts n and m differ by |n - m| / (n + m + 1), so that one of few counts little; histograms by half their L1
        distance.

        Examples
        --------
        >>> one, four = (Descriptor(counts=np.array([n]), spread=np.zeros((1, BINS))) for n in (1.0, 4.0))
        >>> one.distance(four)
        0.25
        """
        if not len(self.counts):
            return 0.0
        by_count = np.abs(self.counts - other.counts) / (self.counts + other.counts + 1)
        by_spread = np.abs(self.spread - other.spread).sum(axis=1) / 2
        return float((by_count + by_spread).mean() / 2)


def distances(places_m: NDArray[np.float64], *, reach_m: float) -> NDArray[np.float64]:
    """Return the histogram of the distances of all pairs, shape (BINS,), of sum 1; zeros where there is no pair.

    Each distance is split between its two nearest bins, so that small moves make small differences.

    Examples
    --------
    >>> distances(np.array([(0.0, 0.0), (0.5, 0.0)]), reach_m=15.0)[:3].tolist()
    [0.5, 0.5, 0.0]
    """
    made = np.zeros(BINS)
    if len(places_m) > 1:
        at = np.minimum(pdist(places_m) * ((BINS - 1) / reach_m), BINS - 1)
        low = np.minimum(at.astype(np.int64), BINS - 2)
        upper = at - low
        made += np.bincount(low, weights=1 - upper, minlength=BINS)
        made += np.bincount(low + 1, weights=upper, minlength=BINS)
        made /= len(at)
    return made


def components(present: NDArray[np.uint8], *, cell_size_m: float) -> NDArray[np.float64]:
    """Return centroids of the connected patches of a layer, metres right and down from its corner, shape (N, 2).

    Cells that touch at a corner are connected. Patches under `LEAST_M2` are dropped; at most `MOST_THINGS` are kept,
    the largest.

    Examples
    --------
    >>> layer = np.zeros((8, 8), dtype=np.uint8)
    >>> layer[:3, :3] = layer[4:8, 4:8] = layer[0, 7] = 1
    >>> components(layer, cell_size_m=1.0).tolist()
    [[6.0, 6.0], [1.5, 1.5]]
    """
    if not present.any():
        return np.zeros((0, 2))
    _, _, stats, centroids = cv2.connectedComponentsWithStats(present, connectivity=8)
    areas = stats[1:, cv2.CC_STAT_AREA]
    order = np.argsort(-areas, kind="stable")[:MOST_THINGS]
    kept = order[areas[order] * cell_size_m**2 >= LEAST_M2]
    return np.asarray((centroids[1:][kept] + _CENTRE) * cell_size_m, dtype=np.float64)
