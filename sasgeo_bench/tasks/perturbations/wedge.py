# SPDX-License-Identifier: Apache-2.0
"""The far side of an oblique view: seen at too flat an angle to recognize anything, so unknown."""

from typing import Final

import numpy as np

from sasgeo_bench.regions.evidence import Evidence
from sasgeo_bench.tasks.perturbations.base import Mask, Occlusion
from sasgeo_bench.tasks.perturbations.fields import centres, top_share

_SPREAD: Final = 0.4  # weight of the sides against the far end: 0 cuts straight across, 1 cuts a corner of 90 degrees


class TiltWedge(Occlusion):
    """Hide the far end of the view in a random direction of lean."""

    def mask(self, evidence: Evidence, rng: np.random.Generator) -> Mask:
        """Return the cells that lie farthest in the direction of the lean."""
        return far_side(evidence, self.share, rng.uniform(0, 360))


def far_side(evidence: Evidence, share: float, direction_deg: float) -> Mask:
    """Return the cells that lie farthest in a direction, clockwise from the view's up."""
    along, across = centres(evidence.shape, evidence.cell_size_m).along_and_across(direction_deg)
    return top_share((along + _SPREAD * np.abs(across)).astype(np.float32), share)
