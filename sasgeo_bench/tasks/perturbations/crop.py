# SPDX-License-Identifier: Apache-2.0
"""Only the middle of the view stays known: a camera with a narrower field of view than planned."""

import numpy as np

from sasgeo_bench.regions.evidence import Evidence
from sasgeo_bench.tasks.perturbations.base import Mask, Occlusion
from sasgeo_bench.tasks.perturbations.border import depth


class CentralCrop(Occlusion):
    """Hide all but a rectangle in the middle; `share` is reached to within one ring of cells.

    Examples
    --------
    >>> view = Evidence(classes=("water",), cells=np.zeros((1, 4, 4), dtype=np.uint8), cell_size_m=1.0)
    >>> CentralCrop(share=0.75)(view, np.random.default_rng(0)).cells[0, 1].tolist()
    [2, 0, 0, 2]
    """

    def mask(self, evidence: Evidence, _rng: np.random.Generator) -> Mask:
        """Return all cells but the middle."""
        return np.asarray(depth(evidence.shape) < 1 - np.sqrt(1 - self.share))
