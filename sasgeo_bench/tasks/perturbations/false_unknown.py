# SPDX-License-Identifier: Apache-2.0
"""Perception reports unknown where it was right: an over-cautious detector, class by class."""

from typing import Final

import numpy as np

from sasgeo_bench.regions.evidence import UNKNOWN, Evidence
from sasgeo_bench.tasks.perturbations.base import Mask, Occlusion
from sasgeo_bench.tasks.perturbations.fields import NoisePool, highest_within

_PATCH_M: Final = 12.0


class FalseUnknown(Occlusion):
    """Hide patches of each class separately; `share` is that of the known cells of each class."""

    def mask(self, evidence: Evidence, rng: np.random.Generator) -> Mask:
        """Return the patches of each class, shape (C, rows, cols)."""
        pool, patches = NoisePool(evidence.shape), []
        for layer in evidence.cells:
            noise, known = pool.take(_PATCH_M / evidence.cell_size_m, rng), layer != UNKNOWN
            count = np.count_nonzero(known)
            patches.append(known & (noise >= highest_within(noise, known, self.share * count, rng)))
        return np.stack(patches)
