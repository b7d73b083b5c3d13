# SPDX-License-Identifier: Apache-2.0
"""The far side of an oblique view: seen at too flat an angle to tell, so unknown."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from sasgeo_bench.geometry.angles import rotation
from sasgeo_bench.regions.evidence import Evidence
from sasgeo_bench.tasks.perturbations.base import check_ranges, hide
from sasgeo_bench.tasks.perturbations.fields import centres, top_share


@dataclass(frozen=True, kw_only=True)
class TiltWedge:
    """Hide what lies far off in the direction the camera leans to.

    Parameters
    ----------
    share : float
        Share of the view's cells that is hidden, 0 to 1.
    direction_deg : float, optional
        Where the camera leans to, clockwise from the view's up direction; any direction unless given.
    spread : float
        How much of the sides goes with the far end: 0 cuts straight across, 1 cuts a corner of 90 degrees.

    Examples
    --------
    >>> view = Evidence(classes=("water",), cells=np.zeros((1, 4, 4), dtype=np.uint8), cell_size_m=1.0)
    >>> TiltWedge(share=0.5, direction_deg=90.0, spread=0.0)(view, np.random.default_rng(0)).cells[0, 0].tolist()
    [0, 0, 2, 2]
    """

    NEUTRAL: ClassVar[Mapping[str, float]] = {"share": 0.0}
    MOVES: ClassVar[bool] = False

    share: float
    direction_deg: float | None = None
    spread: float = 0.4

    def __post_init__(self) -> None:
        """Refuse values out of range."""
        check_ranges(self, share=(0, 1), spread=(0, 1))
        if self.direction_deg is not None:
            check_ranges(self, direction_deg=(-360, 360))

    def __call__(self, evidence: Evidence, rng: np.random.Generator, /) -> Evidence:
        """Cover the far end."""
        if self.share == 0:
            return evidence
        direction_deg = rng.uniform(0, 360) if self.direction_deg is None else self.direction_deg
        at, (right, up) = centres(evidence.shape, evidence.cell_size_m), rotation(direction_deg)[:, 1]
        along, across = at.right_m * right + at.up_m * up, at.right_m * up - at.up_m * right
        distance = (along + self.spread * np.abs(across)).astype(np.float32)
        return hide(evidence, top_share(distance, self.share))
