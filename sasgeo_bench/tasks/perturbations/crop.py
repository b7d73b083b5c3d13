# SPDX-License-Identifier: Apache-2.0
"""Only the middle of the view stays known: a camera with a narrower field of view than was planned for."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from sasgeo_bench.regions.evidence import Evidence
from sasgeo_bench.tasks.perturbations.base import check_ranges, hide
from sasgeo_bench.tasks.perturbations.border import depth
from sasgeo_bench.tasks.perturbations.fields import centres


@dataclass(frozen=True, kw_only=True)
class CentralCrop:
    """Keep a rectangle in the middle, or a disc.

    Parameters
    ----------
    share : float
        Share of the view's cells that is lost, 0 to 1; reached to within one ring of cells.
    is_round : bool
        Keep a disc (an ellipse in a view that is not square) instead of a rectangle of the view's form.

    Examples
    --------
    >>> view = Evidence(classes=("water",), cells=np.zeros((1, 4, 4), dtype=np.uint8), cell_size_m=1.0)
    >>> CentralCrop(share=0.75)(view, np.random.default_rng(0)).cells[0, 1].tolist()
    [2, 0, 0, 2]
    """

    NEUTRAL: ClassVar[Mapping[str, float]] = {"share": 0.0}
    MOVES: ClassVar[bool] = False

    share: float
    is_round: bool = False

    def __post_init__(self) -> None:
        """Refuse a share that is none."""
        check_ranges(self, share=(0, 1))

    def __call__(self, evidence: Evidence, _rng: np.random.Generator, /) -> Evidence:
        """Cover all but the middle."""
        if self.share == 0:
            return evidence
        if not self.is_round:
            return hide(evidence, depth(evidence.shape) < 1 - np.sqrt(1 - self.share))
        at, (rows, cols) = centres(evidence.shape, 2.0), evidence.shape
        distance = np.hypot(at.right_m / cols, at.up_m / rows)
        # The area of a disc of radius r within the square of half side 1 has no handy inverse: take it off the cells.
        limit = np.sort(distance, axis=None)[round((1 - self.share) * distance.size) - 1 :][:1]
        return hide(evidence, distance > (limit if self.share < 1 else -1.0))
