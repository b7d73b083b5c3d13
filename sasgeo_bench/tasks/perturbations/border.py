# SPDX-License-Identifier: Apache-2.0
"""A ragged frame around the view that is unknown: vignetting, a mount or rotor in the picture, a failed warp's edge."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from sasgeo_bench.regions.evidence import Evidence
from sasgeo_bench.tasks.perturbations.base import check_ranges, hide
from sasgeo_bench.tasks.perturbations.fields import Field, centres, smooth_noise, top_share


@dataclass(frozen=True, kw_only=True)
class Border:
    """Hide a frame.

    Parameters
    ----------
    share : float
        Share of the view's cells in the frame, 0 to 1.
    raggedness : float
        How much the frame's width varies, as a share of half the view's side; 0 is a clean frame.

    Examples
    --------
    >>> view = Evidence(classes=("water",), cells=np.zeros((1, 4, 4), dtype=np.uint8), cell_size_m=1.0)
    >>> Border(share=0.75, raggedness=0.0)(view, np.random.default_rng(0)).cells[0]
    array([[2, 2, 2, 2],
           [2, 0, 0, 2],
           [2, 0, 0, 2],
           [2, 2, 2, 2]], dtype=uint8)
    """

    NEUTRAL: ClassVar[Mapping[str, float]] = {"share": 0.0}
    MOVES: ClassVar[bool] = False

    share: float
    raggedness: float = 0.04

    def __post_init__(self) -> None:
        """Refuse shares that are none."""
        check_ranges(self, share=(0, 1), raggedness=(0, 1))

    def __call__(self, evidence: Evidence, rng: np.random.Generator, /) -> Evidence:
        """Cover the frame."""
        if self.share == 0:
            return evidence
        nearness = -depth(evidence.shape)
        if self.raggedness > 0:
            side = min(evidence.shape)
            nearness += self.raggedness * smooth_noise(evidence.shape, side / 12, rng)
        return hide(evidence, top_share(nearness, self.share))


def depth(shape: tuple[int, int]) -> Field:
    """How far each cell lies from the nearest edge, 0 at the edge to 1 in the middle.

    Examples
    --------
    >>> depth((4, 4))[0].tolist(), float(depth((4, 4))[1, 1])
    ([0.25, 0.25, 0.25, 0.25], 0.75)
    """
    at = centres(shape, 2.0)
    rows, cols = 1 - np.abs(at.up_m) / shape[0], 1 - np.abs(at.right_m) / shape[1]
    return np.minimum(rows, cols).astype(np.float32)
