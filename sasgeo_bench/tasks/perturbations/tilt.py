# SPDX-License-Identifier: Apache-2.0
"""An attitude error that the rectification did not know of: the ground plane seen through the wrong homography."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar, Final

import numpy as np

from sasgeo_bench.geometry.angles import rotation
from sasgeo_bench.regions.evidence import Evidence
from sasgeo_bench.tasks.perturbations.base import check_ranges
from sasgeo_bench.tasks.perturbations.fields import centres
from sasgeo_bench.tasks.perturbations.resample import resample

_BEYOND: Final = 1e9  # metres: no view reaches that far


@dataclass(frozen=True, kw_only=True)
class Tilt:
    """Lean the camera without telling the rectification.

    Parameters
    ----------
    tilt_deg : float
        Angle between the true and the assumed optical axis, 0 to 45 degrees.
    height_m : float
        Height above the ground plane.
    direction_deg : float, optional
        Where the camera leans to, clockwise from the view's up direction; any direction unless given.
    keeps_centre : bool
        Whether the middle of the view still shows what it should, so that its pose stays right. If not, all of it is
        off by `height_m * tan(tilt_deg)`, an error that no method can see.

    Notes
    -----
    A cell at the distance a along the lean, and c across, shows the ground at h (a cos t + h sin t) / w along and
    h c / w across, with w = h cos t - a sin t: a plane seen by a pinhole that was taken to look straight down.

    Examples
    --------
    >>> row = np.arange(5, dtype=np.uint8)[None, None] % 2
    >>> view = Evidence(classes=("water",), cells=row, cell_size_m=10.0)
    >>> lean = Tilt(tilt_deg=20.0, height_m=50.0, direction_deg=90.0, keeps_centre=False)
    >>> lean(view, np.random.default_rng(0)).cells[0, 0].tolist()
    [0, 1, 0, 2, 2]
    """

    NEUTRAL: ClassVar[Mapping[str, float]] = {"tilt_deg": 0.0}
    MOVES: ClassVar[bool] = True

    tilt_deg: float
    height_m: float = 150.0
    direction_deg: float | None = None
    keeps_centre: bool = True

    def __post_init__(self) -> None:
        """Refuse values out of range."""
        check_ranges(self, tilt_deg=(0, 45), height_m=(1, 1e5))
        if self.direction_deg is not None:
            check_ranges(self, direction_deg=(-360, 360))

    def __call__(self, evidence: Evidence, rng: np.random.Generator, /) -> Evidence:
        """Show the ground through the wrong homography; beyond the view, or the horizon, is unknown."""
        if self.tilt_deg == 0:
            return evidence
        direction_deg = rng.uniform(0, 360) if self.direction_deg is None else self.direction_deg
        at, (right, up) = centres(evidence.shape, evidence.cell_size_m), rotation(direction_deg)[:, 1]
        along, across = at.right_m * right + at.up_m * up, at.right_m * up - at.up_m * right
        sine, cosine = np.sin(np.radians(self.tilt_deg)), np.cos(np.radians(self.tilt_deg))
        below = self.height_m * cosine - along * sine
        stretch = self.height_m / np.where(below > 0, below, 1.0)
        shown = stretch * (along * cosine + self.height_m * sine)
        if self.keeps_centre:
            shown = shown - self.height_m * sine / cosine
        shown = np.where(below > 0, np.minimum(shown, _BEYOND), _BEYOND)
        aside = np.clip(stretch * across, -_BEYOND, _BEYOND)
        return resample(evidence, shown * right + aside * up, shown * up - aside * right)
