# SPDX-License-Identifier: Apache-2.0
"""Lines drawn wider or narrower than they are seen, and layers that lie beside where they should."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from sasgeo_bench.regions.evidence import PRESENT, UNKNOWN, Evidence
from sasgeo_bench.tasks.perturbations.base import check_ranges, with_cells
from sasgeo_bench.tasks.perturbations.fields import dilated, eroded
from sasgeo_bench.tasks.perturbations.objects import thin_classes
from sasgeo_bench.tasks.perturbations.resample import shifted

Mask = NDArray[np.bool_]


@dataclass(frozen=True, kw_only=True)
class LineWidth:
    """Widen or narrow all thin classes on both sides.

    Parameters
    ----------
    grow_m : float
        Metres on each side, -50 to 50; below 0 narrows. Less than a cell does nothing. A line never goes altogether:
        where narrowing would leave nothing, it stays as it is.

    Examples
    --------
    >>> view = Evidence(classes=("road_minor",), cells=np.array([[[0, 0, 1, 0, 0]]], dtype=np.uint8), cell_size_m=1.0)
    >>> LineWidth(grow_m=1.0)(view, np.random.default_rng(0)).cells[0, 0].tolist()
    [0, 1, 1, 1, 0]
    >>> LineWidth(grow_m=-1.0)(view, np.random.default_rng(0)).cells[0, 0].tolist()
    [0, 0, 1, 0, 0]
    """

    NEUTRAL: ClassVar[Mapping[str, float]] = {"grow_m": 0.0}
    MOVES: ClassVar[bool] = False

    grow_m: float

    def __post_init__(self) -> None:
        """Refuse a width out of range."""
        check_ranges(self, grow_m=(-50, 50))

    def __call__(self, evidence: Evidence, _rng: np.random.Generator, /) -> Evidence:
        """Draw the lines anew."""
        radius_cells = abs(self.grow_m) / evidence.cell_size_m
        if radius_cells < 1:
            return evidence
        cells = evidence.cells.copy()
        for name, layer in zip(evidence.classes, cells, strict=True):
            if name in thin_classes():
                mask = layer == PRESENT
                layer[:] = dilated(mask, radius_cells) if self.grow_m > 0 else _narrowed(mask, radius_cells)
        return with_cells(evidence, cells)


@dataclass(frozen=True, kw_only=True)
class LayerOffset:
    """Shift each class for itself, in a direction of its own: layers of a map that were drawn from different pictures.

    Parameters
    ----------
    offset_m : float
        How far, metres, to the nearest whole cell.
    thin_only : bool
        Whether areas stay where they are.

    Examples
    --------
    >>> view = Evidence(classes=("road_minor",), cells=np.eye(9, dtype=np.uint8)[None], cell_size_m=1.0)
    >>> bool((LayerOffset(offset_m=3.0)(view, np.random.default_rng(0)).cells != view.cells).any())
    True
    """

    NEUTRAL: ClassVar[Mapping[str, float]] = {"offset_m": 0.0}
    MOVES: ClassVar[bool] = True

    offset_m: float
    thin_only: bool = False

    def __post_init__(self) -> None:
        """Refuse an offset out of range."""
        check_ranges(self, offset_m=(0, 1e3))

    def __call__(self, evidence: Evidence, rng: np.random.Generator, /) -> Evidence:
        """Shift the layers; what comes from beyond the view is unknown."""
        if self.offset_m == 0:
            return evidence
        cells = evidence.cells.copy()
        confidence = None if evidence.confidence is None else evidence.confidence.copy()
        offset_cells = self.offset_m / evidence.cell_size_m
        for index, heading in enumerate(rng.uniform(0, 2 * np.pi, size=len(cells))):
            if self.thin_only and evidence.classes[index] not in thin_classes():
                continue
            rows, cols = round(-offset_cells * np.cos(heading)), round(offset_cells * np.sin(heading))
            cells[index] = shifted(evidence.cells[index], rows, cols, beyond=UNKNOWN)
            if confidence is not None and evidence.confidence is not None:
                confidence[index] = shifted(evidence.confidence[index], rows, cols, beyond=0)
        return evidence.replace(cells, confidence)


def _narrowed(mask: Mask, radius_cells: float) -> Mask:
    """The mask shrunk, and as it was where nothing is left."""
    inner = eroded(mask, radius_cells)
    return inner | (mask & ~dilated(inner, radius_cells + 1))
