# SPDX-License-Identifier: Apache-2.0
"""Glare: soft blobs, on water first, where the sun's reflection leaves nothing to tell."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar, Final

import cv2
import numpy as np

from sasgeo_bench.regions.evidence import PRESENT, Evidence
from sasgeo_bench.tasks.perturbations.base import check_ranges, hide
from sasgeo_bench.tasks.perturbations.fields import smooth_noise

_RIM: Final = 0.3  # a blob of the weakest class is this much larger, of the strongest this much smaller, than the mean


@dataclass(frozen=True, kw_only=True)
class Glare:
    """Hide soft blobs.

    Parameters
    ----------
    share : float
        Share of the cells, over all classes, that is hidden, 0 to 1.
    radius_m : float
        About how large the blobs are.
    water_bonus : float
        How much likelier glare is on water; 0 is nowhere likelier than elsewhere.

    Notes
    -----
    A soft edge in three states: a blob reaches less far for some classes than for others, drawn anew for each view.
    Where the share is more than a third, the largest and the smallest blob come closer, so that the mean stays.

    Examples
    --------
    >>> view = Evidence(classes=("water",), cells=np.zeros((1, 96, 96), dtype=np.uint8), cell_size_m=1.0)
    >>> abs(Glare(share=0.2)(view, np.random.default_rng(0)).unknown_share - 0.2) < 0.01
    True
    """

    NEUTRAL: ClassVar[Mapping[str, float]] = {"share": 0.0}
    MOVES: ClassVar[bool] = False

    share: float
    radius_m: float = 20.0
    water_bonus: float = 1.5

    def __post_init__(self) -> None:
        """Refuse values out of range."""
        check_ranges(self, share=(0, 1), radius_m=(0.1, 1e4), water_bonus=(0, 10))

    def __call__(self, evidence: Evidence, rng: np.random.Generator, /) -> Evidence:
        """Cover the blobs, each class to its own reach."""
        if self.share == 0:
            return evidence
        radius_cells = self.radius_m / evidence.cell_size_m
        strength = smooth_noise(evidence.shape, 2 * radius_cells, rng)
        if "water" in evidence.classes:
            water = (evidence.layer("water") == PRESENT).astype(np.float32)
            reach = max(1, round(radius_cells / 2))
            strength += np.float32(self.water_bonus) * cv2.blur(water, (reach, reach))
        rim = min(_RIM, (1 - self.share) / self.share)
        reaches = self.share * (1 + rim * np.linspace(-1, 1, len(evidence.classes)))
        if len(evidence.classes) == 1:
            reaches[:] = self.share
        ordered = np.sort(strength, axis=None)[::-1]
        counts = (rng.permutation(reaches) * ordered.size).round().astype(int)
        limits = ordered[np.clip(counts - 1, 0, None)]
        return hide(evidence, strength >= limits[:, None, None])
