# SPDX-License-Identifier: Apache-2.0
"""Tree crowns over roads and the shadows of buildings: where they fall, lines cannot be told, all else can."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar, Final

import cv2
import numpy as np
from numpy.typing import NDArray

from sasgeo_bench.geometry.angles import rotation
from sasgeo_bench.regions.evidence import PRESENT, Evidence
from sasgeo_bench.tasks.perturbations.base import check_ranges, hide
from sasgeo_bench.tasks.perturbations.fields import dilated, highest, smooth_noise

Mask = NDArray[np.bool_]

HIDDEN: Final = ("road_major", "road_minor", "path_track", "railway", "waterway", "field_boundary")


@dataclass(frozen=True, kw_only=True)
class CanopyAndShadow:
    """Make lines unknown under trees and in shadows.

    Parameters
    ----------
    share : float
        Share of what lies in or beside green, or in a shadow, that is hidden, 0 to 1.
    reach_m : float
        How far crowns hang over the edge of green.
    shadow_m : float
        Length of a building's shadow.
    sun_deg : float, optional
        Where the sun stands, clockwise from the view's up direction; anywhere unless given. Shadows fall away from it.
    patch_m : float
        About how wide a crown, or a gap between crowns, is.

    Notes
    -----
    A hidden cell is unknown for all lines whether one runs there or not: what is unknown must not tell where roads are.

    Examples
    --------
    >>> cells = np.zeros((2, 1, 6), dtype=np.uint8)
    >>> cells[1, 0, 2] = 1
    >>> view = Evidence(classes=("road_minor", "building"), cells=cells, cell_size_m=1.0)
    >>> CanopyAndShadow(share=1.0, shadow_m=2.0, sun_deg=270.0)(view, np.random.default_rng(0)).cells[:, 0].tolist()
    [[0, 0, 0, 2, 2, 0], [0, 0, 1, 0, 0, 0]]
    """

    NEUTRAL: ClassVar[Mapping[str, float]] = {"share": 0.0}
    MOVES: ClassVar[bool] = False

    share: float
    reach_m: float = 4.0
    shadow_m: float = 8.0
    sun_deg: float | None = None
    patch_m: float = 8.0

    def __post_init__(self) -> None:
        """Refuse values out of range."""
        check_ranges(self, share=(0, 1), reach_m=(0, 100), shadow_m=(0, 200), patch_m=(0.1, 1e3))
        if self.sun_deg is not None:
            check_ranges(self, sun_deg=(-360, 360))

    def __call__(self, evidence: Evidence, rng: np.random.Generator, /) -> Evidence:
        """Cover the share of the shade where the noise is strongest."""
        if self.share == 0:
            return evidence
        sun_deg = rng.uniform(0, 360) if self.sun_deg is None else self.sun_deg
        shade = self.shade(evidence, sun_deg)
        noise = smooth_noise(evidence.shape, self.patch_m / evidence.cell_size_m, rng)
        hidden = shade & (noise >= highest(noise[shade], self.share * np.count_nonzero(shade)))
        return hide(evidence, hidden, HIDDEN)

    def shade(self, evidence: Evidence, sun_deg: float) -> Mask:
        """Where crowns and shadows can fall, shape (rows, cols)."""
        shade = np.zeros(evidence.shape, dtype=bool)
        if "green" in evidence.classes:
            shade |= dilated(evidence.layer("green") == PRESENT, self.reach_m / evidence.cell_size_m)
        if "building" in evidence.classes and self.shadow_m >= evidence.cell_size_m:
            building = evidence.layer("building") == PRESENT
            shade |= shadow(building, sun_deg, self.shadow_m / evidence.cell_size_m)
            shade &= ~building
        return shade


def shadow(building: Mask, sun_deg: float, length_cells: float) -> Mask:
    """Buildings drawn out away from the sun.

    Examples
    --------
    >>> shadow(np.array([[False, True, False, False]]), 270.0, 1.0).tolist()
    [[False, True, True, False]]
    """
    reach = int(np.ceil(length_cells))
    right, up = rotation(sun_deg)[:, 1]
    # A cell is in shadow if a building stands towards the sun of it: the element points there.
    element = np.zeros((2 * reach + 1, 2 * reach + 1), dtype=np.uint8)
    end = (reach + round(length_cells * right), reach - round(length_cells * up))
    cv2.line(element, (reach, reach), end, color=1, thickness=1)
    return np.asarray(cv2.dilate(building.view(np.uint8), element), dtype=np.uint8).view(np.bool_)
