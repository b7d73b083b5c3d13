# SPDX-License-Identifier: Apache-2.0
"""What the graph descriptor adds to a raster score: the view's against that of the map under each pose."""

import math
from dataclasses import dataclass
from functools import cached_property
from typing import Final

import numpy as np
from numpy.typing import NDArray

from sasgeo_baselines.chart import Chart
from sasgeo_baselines.descriptor import Descriptor, components
from sasgeo_bench import ABSENT, PRESENT, UNKNOWN, Pose

# The graph is made of what the raster has seen already, so it gets half the raster's say. Among N poses of which one
# stands out in the raster and all others are alike, it stands N / sqrt(N - 1) > sqrt(N) standard deviations above
# them, and no two graph terms are further apart than sqrt(2 N): below 1 / sqrt(2) = 0.71 the graph never overturns it.
BETA: Final = 0.5
_EQUAL: Final = 1e-9  # distances that differ by less are equal: to standardise would make much of rounding


def blended(scores: NDArray[np.float64], distances: NDArray[np.float64], *, beta: float = BETA) -> NDArray[np.float64]:
    """Add the graph's say to raster scores of one query, shape (N,), both standardised over its list.

    The result is in units of the raster's scores, so that margins keep their meaning: a standard deviation of distances
    counts as `beta` standard deviations of scores; as `beta` itself where the scores are all equal.

    Examples
    --------
    >>> blended(np.array([1.0, 3.0]), np.array([0.25, 0.75])).tolist()
    [1.5, 2.5]
    >>> blended(np.array([1.0, 3.0]), np.array([0.5, 0.5])).tolist()
    [1.0, 3.0]
    """
    if len(scores) == 0 or not np.ptp(distances) > _EQUAL:
        return scores
    unit = scores.std() if np.ptp(scores) > 0 else 1.0
    return np.asarray(scores - beta * unit * (distances - distances.mean()) / distances.std())


@dataclass(frozen=True, kw_only=True)
class Verifier:
    """Descriptors of one view and of the map under its poses.

    Parameters
    ----------
    chart : Chart
        The map.
    bands : ndarray of int64, shape (C,)
        The view's classes among those of the map.
    seen : ndarray of uint8, shape (C, rows, cols)
        ABSENT, PRESENT or UNKNOWN; what is unknown is looked at on neither side.
    cell_size_m : float
        Side of a view cell for scale 1.
    """

    chart: Chart
    bands: NDArray[np.int64]
    seen: NDArray[np.uint8]
    cell_size_m: float

    def distance(self, pose: Pose) -> float:
        """How unlike the descriptors of the view and of the map under a pose are, 0..1.

        The map is cut as the view would show it, so the scale of the pose is that of the distances. Cells that the map
        does not know are looked at on neither side.
        """
        mapped = self._under(pose)
        known = mapped != UNKNOWN
        seen = self._described if known.all() else self._describe((self.seen == PRESENT) & known)
        return seen.distance(self._describe((mapped == PRESENT) & (self.seen != UNKNOWN)))

    def agreement(self, pose: Pose) -> float:
        """Mean over classes of what view and map both hold over what either holds, where both know, 0..1."""
        mapped = self._under(pose)
        known = (mapped != UNKNOWN) & (self.seen != UNKNOWN)
        both, either = (
            (how(self.seen == PRESENT, mapped == PRESENT) & known).sum(axis=(1, 2))
            for how in (np.logical_and, np.logical_or)
        )
        there = either > 0
        return float((both[there] / either[there]).mean()) if there.any() else 0.0

    def _under(self, pose: Pose) -> NDArray[np.uint8]:
        return self.chart.under(pose, self.seen.shape[1:], self.bands, cell_size_m=self.cell_size_m)

    @cached_property
    def _described(self) -> Descriptor:
        return self._describe(self.seen == PRESENT)

    def _describe(self, present: NDArray[np.bool_]) -> Descriptor:
        reach_m = math.hypot(*present.shape[1:]) * self.cell_size_m
        layers = np.where(present, np.uint8(PRESENT), np.uint8(ABSENT))
        return Descriptor.of([components(layer, cell_size_m=self.cell_size_m) for layer in layers], reach_m=reach_m)
