# SPDX-License-Identifier: Apache-2.0
"""How a search is done, and what it comes back with."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sasgeo_bench.geometry.pose import Pose


@dataclass(frozen=True, kw_only=True)
class Plan:
    """How a search is done.

    Parameters
    ----------
    cells : int
        Least cells of the coarsest level along the view's longer side.
    beam : tuple of int
        Modes that are kept at the coarsest level, and how many of them at each finer one; the last for all that follow.
    each : int
        Modes that each candidate begins with.
    spread : float
        Standard deviations of heading and scale that are searched.
    apart_m : float
        Least distance between two of the modes that are given.
    around_m : float
        How far around a candidate the view may lie.
    threads : int
        Threads of one search; they change nothing but its time.
    """

    cells: int = 16
    beam: tuple[int, ...] = (160, 48, 16, 8, 6)
    each: int = 2
    spread: float = 2.5
    apart_m: float = 25.0
    around_m: float = 24.0
    threads: int = 1

    def width(self, depth: int) -> int:
        """How many modes are kept at a depth of the pyramid, 0 the coarsest."""
        return self.beam[min(depth, len(self.beam) - 1)]


@dataclass(frozen=True, slots=True, kw_only=True)
class Mode:
    """A pose and its score."""

    pose: Pose
    score: float


@dataclass(frozen=True, slots=True, kw_only=True)
class Null:
    """Coarse scores of all places, each with its best heading and scale; nearly all of them are wrong."""

    best: float
    mean: float
    deviation: float
    places: int


@dataclass(frozen=True, slots=True, kw_only=True)
class Found:
    """What a search comes back with: modes, best first, and the coarse scores they stand out from."""

    modes: tuple[Mode, ...]
    null: Null


def posterior(scores: Sequence[float], *, temper: float, null_score: float = 0.0) -> NDArray[np.float64]:
    """Probability of each mode and, last, that it is none of them: a softmax of tempered scores.

    Parameters
    ----------
    scores : sequence of float
        Scores of modes, logarithms of likelihood ratios.
    temper : float
        What they are multiplied with: neighbouring cells say the same thing more than once.
    null_score : float
        Score of there being none.

    Returns
    -------
    ndarray of float, shape (len(scores) + 1,)
        They sum to 1.

    Examples
    --------
    >>> posterior([2.0, 0.0], temper=1.0).round(3).tolist()
    [0.787, 0.107, 0.107]
    """
    logs = temper * np.array([*scores, null_score], dtype=np.float64)
    mass = np.exp(logs - logs.max())
    return np.asarray(mass / mass.sum())
