# SPDX-License-Identifier: Apache-2.0
"""The graph descriptor of the SASGeo paper's own experiment: counts of patches, and how far apart they lie.

Kept as the variant "graph_descriptor", beside the correspondences of Eq. 9 that the paper proposes.
"""

from dataclasses import dataclass
from typing import Final, Self

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.distance import pdist

from sasgeo_bench.regions.evidence import PRESENT, UNKNOWN

BINS: Final = 16
LEAST_M2: Final = 9.0  # smaller patches are specks
MOST: Final = 500  # patches of a class, the largest: a view of noise has no end of pairs


@dataclass(frozen=True, slots=True, kw_only=True)
class GraphDescriptor:
    """Patches of each class, counted and by the distances of their pairs; a turn changes neither.

    `counts` has shape (C,); `distances` has shape (C, BINS), each row of sum 1, or 0 where there is no pair.
    """

    counts: NDArray[np.float64]
    distances: NDArray[np.float64]

    @classmethod
    def of(cls, cells: NDArray[np.uint8], *, cell_size_m: float) -> Self:
        """Describe a view, or the map as a view would show it.

        Parameters
        ----------
        cells : ndarray of uint8, shape (C, rows, cols)
            ABSENT, PRESENT or UNKNOWN.
        cell_size_m : float
            Side of a cell.

        Examples
        --------
        >>> layer = np.zeros((1, 16, 16), dtype=np.uint8)
        >>> layer[0, :4, :4] = layer[0, 12:, 12:] = PRESENT
        >>> GraphDescriptor.of(layer, cell_size_m=1.0).counts.tolist()
        [2.0]
        """
        longest_m = float(np.hypot(*cells.shape[1:])) * cell_size_m
        middles_m = [_middles_m(layer == PRESENT, cell_size_m) for layer in cells]
        return cls(
            counts=np.array([len(part) for part in middles_m], dtype=np.float64),
            distances=np.array([_histogram(part, longest_m) for part in middles_m]).reshape(-1, BINS),
        )

    def unlikeness(self, other: Self) -> float:
        """How different two descriptors are, 0..1: half by counts and half by distances, over classes either has.

        Examples
        --------
        >>> none = GraphDescriptor.of(np.zeros((1, 8, 8), dtype=np.uint8), cell_size_m=1.0)
        >>> none.unlikeness(none)
        0.0
        """
        either = (self.counts > 0) | (other.counts > 0)
        if not either.any():
            return 0.0
        by_count = np.abs(self.counts - other.counts) / np.maximum(np.maximum(self.counts, other.counts), 1)
        by_distance = np.abs(self.distances - other.distances).sum(axis=1) / 2
        return float((by_count + by_distance)[either].mean() / 2)


def descriptor_score(seen: NDArray[np.uint8], mapped: NDArray[np.uint8], *, cell_size_m: float) -> float:
    """Likeness of a view and of the map under it, 0..1; what either does not know is looked at on neither side.

    Parameters
    ----------
    seen, mapped : ndarray of uint8, shape (C, rows, cols)
        ABSENT, PRESENT or UNKNOWN, on one lattice.
    cell_size_m : float
        Side of a cell.

    Examples
    --------
    >>> layer = np.zeros((1, 16, 16), dtype=np.uint8)
    >>> layer[0, :4, :4] = PRESENT
    >>> descriptor_score(layer, layer, cell_size_m=1.0), descriptor_score(layer, 0 * layer, cell_size_m=1.0)
    (1.0, 0.5)
    """
    known = (seen != UNKNOWN) & (mapped != UNKNOWN)
    one, two = (
        GraphDescriptor.of(np.where(known, cells, UNKNOWN), cell_size_m=cell_size_m) for cells in (seen, mapped)
    )
    return 1.0 - one.unlikeness(two)


def _middles_m(present: NDArray[np.bool_], cell_size_m: float) -> NDArray[np.float64]:
    """Centroids of the largest patches, shape (N, 2), metres right and down."""
    _, _, stats, middles = cv2.connectedComponentsWithStats(present.astype(np.uint8), connectivity=8)
    area_m2 = stats[1:, cv2.CC_STAT_AREA] * cell_size_m**2
    order = np.argsort(-area_m2, kind="stable")[:MOST]
    return np.asarray(middles[1:][order[area_m2[order] >= LEAST_M2]] * cell_size_m, dtype=np.float64)


def _histogram(places_m: NDArray[np.float64], longest_m: float) -> NDArray[np.float64]:
    if len(places_m) < 2:  # noqa: PLR2004 - a pair
        return np.zeros(BINS)
    counts = np.histogram(pdist(places_m), bins=BINS, range=(0.0, longest_m))[0]
    return np.asarray(counts / max(counts.sum(), 1), dtype=np.float64)
