# SPDX-License-Identifier: Apache-2.0
"""A height that is not quite what it was said to be: the view magnified or shrunk about its centre."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from sasgeo_bench.regions.evidence import Evidence
from sasgeo_bench.tasks.perturbations.base import check_ranges
from sasgeo_bench.tasks.perturbations.fields import centres
from sasgeo_bench.tasks.perturbations.resample import resample


@dataclass(frozen=True, kw_only=True)
class Scale:
    """Magnify what the view shows by a factor, or shrink it by as much; what comes from beyond the view is unknown.

    Parameters
    ----------
    excess : float
        The factor is 1 + excess, or one over it; 0 to 3.

    Examples
    --------
    >>> cells = np.array([[[0, 1, 0, 0, 1, 0]]], dtype=np.uint8)
    >>> view = Evidence(classes=("water",), cells=cells, cell_size_m=1.0)
    >>> zoom = Scale(excess=0.25)
    >>> zoom.draw_factor(np.random.default_rng(1)), zoom(view, np.random.default_rng(1)).cells[0, 0].tolist()
    (0.8, [2, 1, 0, 0, 1, 2])
    """

    NEUTRAL: ClassVar[Mapping[str, float]] = {"excess": 0.0}
    MOVES: ClassVar[bool] = True

    excess: float

    def __post_init__(self) -> None:
        """Refuse a factor out of range."""
        check_ranges(self, excess=(0, 3))

    def draw_factor(self, rng: np.random.Generator) -> float:
        """By what a call with an equal generator magnifies; the true scale of the pose is one over it."""
        return 1 + self.excess if rng.random() < 0.5 else 1 / (1 + self.excess)  # noqa: PLR2004 - one or the other

    def __call__(self, evidence: Evidence, rng: np.random.Generator, /) -> Evidence:
        """Magnify or shrink the view."""
        if self.excess == 0:
            return evidence
        factor = self.draw_factor(rng)
        at = centres(evidence.shape, evidence.cell_size_m)
        zero = np.zeros(evidence.shape)
        return resample(evidence, at.right_m / factor + zero, at.up_m / factor + zero)
