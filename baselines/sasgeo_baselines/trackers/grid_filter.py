# SPDX-License-Identifier: Apache-2.0
"""Base of filters that keep a belief on a grid: predict, weigh, sum up."""

from abc import ABC, abstractmethod
from typing import ClassVar, Final

import numpy as np
from numpy.typing import NDArray

import sasgeo_bench as sgb

Floats = NDArray[np.float32]

LEAST: Final = 0.9  # mass within 25 m of an estimate that is accepted


class GridFilter(ABC):
    """Follows a flight by a belief over place and heading; a method says how likely a view is where."""

    card: ClassVar[sgb.MatcherCard]
    diffuses: ClassVar[bool] = True  # by the covariance of the increments
    outlier_probability: ClassVar[float]  # share of views that say nothing

    def __init__(self) -> None:
        self._grid: sgb.Grid | None = None
        self._belief: sgb.GridBelief | None = None

    @abstractmethod
    def read(self, region: sgb.Region, learned: str | None) -> sgb.Grid:
        """Index a map, and return the cells on which a belief may lie."""

    @abstractmethod
    def logs(self, query: sgb.Query, belief: sgb.GridBelief) -> Floats:
        """Return the log-likelihood of a view, up to a constant, at `belief.asked` and each cell: (A, rows, cols)."""

    @property
    def belief(self) -> sgb.GridBelief:
        """Return the belief after the last view."""
        if self._belief is None:
            raise RuntimeError(f"{self.card.name}: call prepare() with a region, then start(), before step()")
        return self._belief

    def prepare(self, region: sgb.Region, learned: str | None) -> None:
        """Index a map."""
        self._grid = self.read(region, learned)

    def start(self, prior: sgb.Prior) -> None:
        """Begin with an even belief over the prior."""
        if self._grid is None:
            raise RuntimeError(f"{self.card.name}: call prepare() with a region before start()")
        self._belief = sgb.GridBelief.of(prior, self._grid)

    def step(self, query: sgb.Query) -> sgb.Fix:
        """Move the belief by the odometer, multiply it by the view, and sum it up."""
        if query.step is None:
            raise RuntimeError(f"{self.card.name}: step() needs the views of a flight")
        belief = sgb.followed(self.belief, query.step, diffuses=self.diffuses)
        if not sgb.is_blind(query):
            belief = belief.weighed(self.logs(query, belief), outlier_probability=self.outlier_probability)
        self._belief = belief.fitted()
        return sgb.fix_of(self._belief, least=LEAST)
