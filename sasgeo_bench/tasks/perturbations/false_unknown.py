# SPDX-License-Identifier: Apache-2.0
"""Perception that says unknown where it was right: an over-cautious detector, class by class."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from sasgeo_bench.regions.evidence import UNKNOWN, Evidence
from sasgeo_bench.tasks.perturbations.base import check_ranges, with_cells
from sasgeo_bench.tasks.perturbations.fields import NoisePool, highest_within


@dataclass(frozen=True, kw_only=True)
class FalseUnknown:
    """Hide patches of each class for itself; the other classes stay known there.

    Parameters
    ----------
    share : float
        Share of the known cells of each class that becomes unknown, 0 to 1.
    patch_m : float
        About how wide the patches are.

    Notes
    -----
    It does not know what perception got right: apply it to the clean view, before `Perception`, which leaves unknown
    cells alone; then no error is hidden by it.

    Examples
    --------
    >>> view = Evidence(classes=("water",), cells=np.zeros((1, 96, 96), dtype=np.uint8), cell_size_m=1.0)
    >>> abs(FalseUnknown(share=0.3)(view, np.random.default_rng(0)).unknown_share - 0.3) < 0.01
    True
    """

    NEUTRAL: ClassVar[Mapping[str, float]] = {"share": 0.0}
    MOVES: ClassVar[bool] = False

    share: float
    patch_m: float = 12.0

    def __post_init__(self) -> None:
        """Refuse values out of range."""
        check_ranges(self, share=(0, 1), patch_m=(0.1, 1e4))

    def __call__(self, evidence: Evidence, rng: np.random.Generator, /) -> Evidence:
        """Cover the patches."""
        if self.share == 0:
            return evidence
        cells, pool = evidence.cells.copy(), NoisePool(evidence.shape)
        for layer in cells:
            noise, known = pool.take(self.patch_m / evidence.cell_size_m, rng), layer != UNKNOWN
            count = np.count_nonzero(known)
            veil = known & (noise >= highest_within(noise, known, self.share * count, rng))
            np.maximum(layer, veil.view(np.uint8) * np.uint8(UNKNOWN), out=layer)
        return with_cells(evidence, cells)
