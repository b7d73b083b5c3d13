# SPDX-License-Identifier: Apache-2.0
"""Graph descriptor of a view against that of the map under each pose, and its blend with raster scores."""

import math
from dataclasses import dataclass
from functools import cached_property
from typing import Final

import numpy as np
from numpy.typing import NDArray

from sasgeo_baselines.descriptor import Descriptor, components
from sasgeo_bench import ABSENT, PRESENT, UNKNOWN, Pose, PoseCheck

# The graph is made of what the raster has used already, so it has half its weight. Among N poses of which one leads in
# the raster and all others are equal, it leads by N / sqrt(N - 1) > sqrt(N) standard deviations, and no two graph terms
# differ by more than sqrt(2 N): below 1 / sqrt(2) = 0.71 the graph never overturns it.
BETA: Final = 0.5
_EQUAL: Final = 1e-9  # smaller differences of distances are rounding


def blended(scores: NDArray[np.float64], distances: NDArray[np.float64], *, beta: float = BETA) -> NDArray[np.float64]:
    """Subtract graph distances from raster scores of one query, shape (N,), both standardised over its list.

    The result is in units of the raster scores, so that margins keep their meaning: a standard deviation of distances
    counts as `beta` standard deviations of scores; as `beta` itself where all scores are equal.

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
class GraphCheck:
    """Graph descriptors of a view and of the map under its poses."""

    check: PoseCheck

    def distance(self, pose: Pose) -> float:
        """Return the distance between the descriptors of the view and of the map under a pose, 0..1.

        The map is cut as the view would show it, so the scale of the pose is that of the distances. Cells that are
        unknown to either side are ignored.
        """
        mapped, seen = self.check.mapped(pose), self.check.seen
        known = mapped != UNKNOWN
        view = self._described if known.all() else self._describe((seen == PRESENT) & known)
        return view.distance(self._describe((mapped == PRESENT) & (seen != UNKNOWN)))

    @cached_property
    def _described(self) -> Descriptor:
        return self._describe(self.check.seen == PRESENT)

    def _describe(self, present: NDArray[np.bool_]) -> Descriptor:
        cell_m = self.check.cell_size_m
        layers = np.where(present, np.uint8(PRESENT), np.uint8(ABSENT))
        reach_m = math.hypot(*present.shape[1:]) * cell_m
        return Descriptor.of([components(layer, cell_size_m=cell_m) for layer in layers], reach_m=reach_m)
