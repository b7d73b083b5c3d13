# SPDX-License-Identifier: Apache-2.0
"""A heading that is not quite what it was said to be: the view turned about its centre."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from sasgeo_bench.geometry.angles import rotation
from sasgeo_bench.regions.evidence import Evidence
from sasgeo_bench.tasks.perturbations.base import check_ranges
from sasgeo_bench.tasks.perturbations.fields import centres
from sasgeo_bench.tasks.perturbations.resample import resample


@dataclass(frozen=True, kw_only=True)
class Rotation:
    """Turn what the view shows by an angle to one side or the other; the corners that come from beyond are unknown.

    Parameters
    ----------
    angle_deg : float
        How far, 0 to 180 degrees.

    Examples
    --------
    >>> cells = np.array([[[0, 1, 0], [0, 0, 0], [0, 0, 0]]], dtype=np.uint8)
    >>> view = Evidence(classes=("water",), cells=cells, cell_size_m=1.0)
    >>> turn = Rotation(angle_deg=90.0)
    >>> turn.draw_deg(np.random.default_rng(1)), turn(view, np.random.default_rng(1)).cells[0, 1].tolist()
    (-90.0, [1, 0, 0])
    """

    NEUTRAL: ClassVar[Mapping[str, float]] = {"angle_deg": 0.0}
    MOVES: ClassVar[bool] = True

    angle_deg: float

    def __post_init__(self) -> None:
        """Refuse an angle out of range."""
        check_ranges(self, angle_deg=(0, 180))

    def draw_deg(self, rng: np.random.Generator) -> float:
        """By how much a call with an equal generator turns the content, clockwise: the true yaw is smaller by this."""
        return self.angle_deg if rng.random() < 0.5 else -self.angle_deg  # noqa: PLR2004 - one side or the other

    def __call__(self, evidence: Evidence, rng: np.random.Generator, /) -> Evidence:
        """Turn the view."""
        if self.angle_deg == 0:
            return evidence
        (xx, xy), (yx, yy) = rotation(-self.draw_deg(rng)).round(12)
        at = centres(evidence.shape, evidence.cell_size_m)
        return resample(evidence, xx * at.right_m + xy * at.up_m, yx * at.right_m + yy * at.up_m)
