# SPDX-License-Identifier: Apache-2.0
"""Tree crowns over lines and the shadows of buildings: lines are unknown there, other classes are not."""

from typing import Final

import cv2
import numpy as np

from sasgeo_bench.geometry.angles import rotation
from sasgeo_bench.regions.evidence import PRESENT, Evidence
from sasgeo_bench.tasks.perturbations.base import Mask, Occlusion
from sasgeo_bench.tasks.perturbations.fields import dilated, highest, smooth_noise

HIDDEN: Final = ("road_major", "road_minor", "path_track", "railway", "waterway", "field_boundary")
_OVERHANG_M: Final = 4.0  # of crowns over the edge of green
_SHADOW_M: Final = 8.0  # length of a building's shadow
_PATCH_M: Final = 8.0  # width of a crown, or of a gap between crowns


class CanopyAndShadow(Occlusion):
    """Make lines unknown under trees and in shadows; `share` is that of the shaded cells.

    The sun stands anywhere. A hidden cell is unknown for every line class, whether a line runs there or not: unknown
    cells must not show where roads are.
    """

    def mask(self, evidence: Evidence, rng: np.random.Generator) -> Mask:
        """Return the part of the shade where the noise is strongest, for the line classes."""
        shade = shaded(evidence, rng.uniform(0, 360))
        noise = smooth_noise(evidence.shape, _PATCH_M / evidence.cell_size_m, rng)
        hidden = shade & (noise >= highest(noise[shade], self.share * np.count_nonzero(shade)))
        return np.asarray(hidden & np.isin(evidence.classes, HIDDEN)[:, None, None])


def shaded(evidence: Evidence, sun_deg: float) -> Mask:
    """Return where crowns and shadows can fall, shape (rows, cols); `sun_deg` is clockwise from the view's up."""
    shade = np.zeros(evidence.shape, dtype=bool)
    if "green" in evidence.classes:
        shade |= dilated(evidence.layer("green") == PRESENT, _OVERHANG_M / evidence.cell_size_m)
    if "building" in evidence.classes and evidence.cell_size_m <= _SHADOW_M:
        building = evidence.layer("building") == PRESENT
        shade |= shadow(building, sun_deg, _SHADOW_M / evidence.cell_size_m)
        shade &= ~building
    return shade


def shadow(building: Mask, sun_deg: float, length_cells: float) -> Mask:
    """Extend buildings away from the sun."""
    reach = int(np.ceil(length_cells))
    right, up = rotation(sun_deg)[:, 1]
    # A cell is in shadow if a building stands between it and the sun, so the element points towards the sun.
    element = np.zeros((2 * reach + 1, 2 * reach + 1), dtype=np.uint8)
    end = (reach + round(length_cells * right), reach - round(length_cells * up))
    cv2.line(element, (reach, reach), end, color=1, thickness=1)
    return np.asarray(cv2.dilate(building.view(np.uint8), element), dtype=np.uint8).view(np.bool_)
