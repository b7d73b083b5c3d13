# SPDX-License-Identifier: Apache-2.0
"""A ragged unknown frame: vignetting, a mount or rotor in the picture, the edge of a failed warp."""

from typing import Final

import numpy as np

from sasgeo_bench.regions.evidence import Evidence
from sasgeo_bench.tasks.perturbations.base import Mask, Occlusion
from sasgeo_bench.tasks.perturbations.fields import Field, centres, smooth_noise, top_share

_RAGGEDNESS: Final = 0.04  # variation of the frame's width, in halves of the view's side


class Border(Occlusion):
    """Hide a ragged frame around the view."""

    def mask(self, evidence: Evidence, rng: np.random.Generator) -> Mask:
        """Return the cells nearest to the edge."""
        nearness = -depth(evidence.shape)
        nearness += _RAGGEDNESS * smooth_noise(evidence.shape, min(evidence.shape) / 12, rng)
        return top_share(nearness, self.share)


def depth(shape: tuple[int, int]) -> Field:
    """Return the distance of each cell from the nearest edge, 0 at the edge to 1 in the middle."""
    at = centres(shape, 2.0)
    rows, cols = 1 - np.abs(at.up_m) / shape[0], 1 - np.abs(at.right_m) / shape[1]
    return np.minimum(rows, cols).astype(np.float32)
