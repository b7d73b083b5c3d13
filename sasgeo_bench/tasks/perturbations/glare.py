# SPDX-License-Identifier: Apache-2.0
"""Glare: soft blobs, on water first, where the sun's reflection hides everything."""

from typing import Final

import cv2
import numpy as np

from sasgeo_bench.regions.evidence import PRESENT, Evidence
from sasgeo_bench.tasks.perturbations.base import Mask, Occlusion
from sasgeo_bench.tasks.perturbations.fields import smooth_noise

_RADIUS_M: Final = 20.0
_WATER_BONUS: Final = 1.5  # added to the strength of glare where all is water; the strength has a deviation of 0.575
_RIM: Final = 0.3  # relative difference from the mean size of the largest and smallest blobs, those of two classes


class Glare(Occlusion):
    """Hide soft blobs; `share` is that of the cells over all classes.

    A soft edge in three states: a blob reaches less far for some classes than for others, at random in each view. If
    the share exceeds 1 / 1.3, the sizes of blobs differ less, so that the mean stays.
    """

    def mask(self, evidence: Evidence, rng: np.random.Generator) -> Mask:
        """Return the blobs, shape (C, rows, cols)."""
        radius_cells = _RADIUS_M / evidence.cell_size_m
        strength = smooth_noise(evidence.shape, 2 * radius_cells, rng)
        if "water" in evidence.classes:
            water = (evidence.layer("water") == PRESENT).astype(np.float32)
            reach = max(1, round(radius_cells / 2))
            strength += np.float32(_WATER_BONUS) * cv2.blur(water, (reach, reach))
        rim = min(_RIM, (1 - self.share) / self.share)
        reaches = self.share * (1 + rim * np.linspace(-1, 1, len(evidence.classes)))
        if len(evidence.classes) == 1:
            reaches[:] = self.share
        ordered = np.sort(strength, axis=None)[::-1]
        counts = (rng.permutation(reaches) * ordered.size).round().astype(int)
        limits = ordered[np.clip(counts - 1, 0, None)]
        return np.asarray(strength >= limits[:, None, None])
