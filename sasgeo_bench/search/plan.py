# SPDX-License-Identifier: Apache-2.0
"""Settings and results of a search."""

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sasgeo_bench.geometry.pose import Pose


@dataclass(frozen=True, kw_only=True)
class Plan:
    """Settings of a search.

    Parameters
    ----------
    cells : int
        Least number of cells of the coarsest level along the longer side of the view.
    beam : tuple of int
        Modes kept at the coarsest level, then at each finer one; the last number holds for all further levels.
    each : int
        Modes that each candidate starts with.
    spread : float
        Searched range of heading and scale, standard deviations.
    apart_m : float
        Least distance between two modes of a result.
    around_m : float
        Radius around a candidate within which the view may lie.
    threads : int
        Threads of one search; they change its time alone.
    """

    cells: int = 16
    beam: tuple[int, ...] = (160, 48, 16, 8, 6)
    each: int = 2
    spread: float = 2.5
    apart_m: float = 25.0
    around_m: float = 24.0
    threads: int = 1

    def width(self, depth: int) -> int:
        """Return how many modes are kept at a depth of the pyramid, 0 the coarsest."""
        return self.beam[min(depth, len(self.beam) - 1)]


@dataclass(frozen=True, slots=True, kw_only=True)
class Mode:
    """A pose and its score."""

    pose: Pose
    score: float


@dataclass(frozen=True, slots=True, kw_only=True)
class Null:
    """Statistics of the coarse scores of all places, each at its best heading and scale; nearly all are wrong."""

    best: float
    mean: float
    deviation: float
    places: int


@dataclass(frozen=True, slots=True, kw_only=True)
class Found:
    """Modes of a search, best first, and statistics of all coarse scores."""

    modes: tuple[Mode, ...]
    null: Null


def place_m(pose: Pose) -> tuple[float, float]:
    """Return easting and northing of a pose."""
    return (pose.easting_m, pose.northing_m)


def thinned(modes: Iterable[Mode], apart_m: float) -> list[Mode]:
    """Drop modes that lie nearer than a distance to a better one."""
    kept: list[Mode] = []
    for mode in modes:
        if all(math.dist(place_m(mode.pose), place_m(other.pose)) >= apart_m for other in kept):
            kept.append(mode)
    return kept


def posterior(scores: Sequence[float], *, null_score: float = 0.0) -> NDArray[np.float64]:
    """Return the probability of each mode and, last, of none of them: a softmax, shape (len(scores) + 1,).

    Parameters
    ----------
    scores : sequence of float
        Scores of modes, logarithms of likelihood ratios.
    null_score : float
        Score of none of them.

    Examples
    --------
    >>> posterior([2.0, 0.0]).round(3).tolist()
    [0.787, 0.107, 0.107]
    """
    logs = np.array([*scores, null_score], dtype=np.float64)
    mass = np.exp(logs - logs.max())
    return np.asarray(mass / mass.sum())
