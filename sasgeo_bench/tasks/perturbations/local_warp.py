# SPDX-License-Identifier: Apache-2.0
"""A smooth local distortion: relief, a stitched mosaic, a drawing that follows no survey.

Cells no longer overlap with the map while roads keep their order: what a graph should withstand, and a raster not.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar, Final

import numpy as np
from numpy.typing import NDArray

from sasgeo_bench.regions.evidence import Evidence
from sasgeo_bench.tasks.perturbations.base import check_ranges
from sasgeo_bench.tasks.perturbations.fields import centres
from sasgeo_bench.tasks.perturbations.resample import resample

_WAVES: Final = 16
_SPREAD: Final = 0.2  # wavelengths lie within this share of the mean one
_STEPS: Final = 30  # each brings a moved point nearer by the field's steepness; ten do for a gentle one


@dataclass(frozen=True, kw_only=True)
class LocalWarp:
    """Move cells by a smooth displacement field with mean 0.

    Parameters
    ----------
    rms_m : float
        Root mean square length of the displacement, metres; exactly this in every view.
    wavelength_m : float
        Mean wavelength, metres.

    Notes
    -----
    Sixteen plane waves in random directions for each component. Where `rms_m` is more than about a tenth of the
    wavelength the field folds in places, and some ground is seen twice; `folded_share` says how much: 10 m fold 0.09
    of the view at 60 m, 0.005 at 90 m and nothing at 120 m, 15 m fold 0.24, 0.08 and 0.01, 5 m nothing.

    Examples
    --------
    >>> view = Evidence(classes=("water",), cells=np.zeros((1, 64, 64), dtype=np.uint8), cell_size_m=2.0)
    >>> warp = LocalWarp(rms_m=5.0, wavelength_m=90.0)
    >>> field = warp.field(view.shape, view.cell_size_m, np.random.default_rng(0))
    >>> round(float(np.sqrt((field**2).sum(axis=0).mean())), 6)
    5.0
    """

    NEUTRAL: ClassVar[Mapping[str, float]] = {"rms_m": 0.0}
    MOVES: ClassVar[bool] = True

    rms_m: float
    wavelength_m: float = 90.0

    def __post_init__(self) -> None:
        """Refuse values out of range."""
        check_ranges(self, rms_m=(0, 1e3), wavelength_m=(1, 1e5))

    def __call__(self, evidence: Evidence, rng: np.random.Generator, /) -> Evidence:
        """Warp the view; ground from beyond it is unknown."""
        if self.rms_m == 0:
            return evidence
        return warped(evidence, self.field(evidence.shape, evidence.cell_size_m, rng))

    def field(self, shape: tuple[int, int], cell_size_m: float, rng: np.random.Generator) -> NDArray[np.float64]:
        """Displacement (right, up) of every cell, shape (2, rows, cols), metres: a cell shows what lies that far off.

        A call of the warp itself draws the same field from an equal generator, so perceived vectors can be moved with
        the cells (`moved`), or left.
        """
        at = centres(shape, cell_size_m)
        field = np.stack([self._component(at.right_m.ravel(), at.up_m.ravel(), rng) for _ in range(2)])
        field -= field.mean(axis=(1, 2), keepdims=True)
        rms = np.sqrt((field**2).sum(axis=0).mean())
        return np.asarray(field * (self.rms_m / rms if rms > 0 else 0.0))

    def _component(
        self, right_m: NDArray[np.float64], up_m: NDArray[np.float64], rng: np.random.Generator
    ) -> NDArray[np.float64]:
        """Sum of plane waves: each is a product of a row and a column, so that all of them are one matrix product."""
        wavelengths_m = self.wavelength_m * rng.uniform(1 - _SPREAD, 1 + _SPREAD, size=_WAVES)
        heading, phase = rng.uniform(0, 2 * np.pi, size=(2, _WAVES))
        number = 2 * np.pi / wavelengths_m
        across = np.outer(number * np.cos(heading), right_m)
        along = np.outer(up_m, number * np.sin(heading)) + phase
        rows = np.concatenate((np.cos(along), -np.sin(along)), axis=1)
        # Not `@`: its last digit depends on how many threads the machine has, and with it what a seed gives.
        return np.asarray(np.einsum("rw,wc->rc", rows, np.concatenate((np.cos(across), np.sin(across)))))


def warped(evidence: Evidence, field_m: NDArray[np.float64]) -> Evidence:
    """Show in each cell what lies `field_m`, shape (2, rows, cols), off."""
    at = centres(evidence.shape, evidence.cell_size_m)
    return resample(evidence, at.right_m + field_m[0], at.up_m + field_m[1])


def moved(points_m: NDArray[np.float64], field_m: NDArray[np.float64], cell_size_m: float) -> NDArray[np.float64]:
    """Where a warp shows points of the view, shape (N, 2), (right, up) from its middle in metres.

    The cell at p shows what lies at p + d(p), so a point q is shown where p + d(p) = q, found by repeating
    p = q - d(p) to within a cell. Where the field folds there are several such places, and this need not end at one.

    Examples
    --------
    >>> shift = np.zeros((2, 8, 8))
    >>> shift[0] = 1.0
    >>> moved(np.array([[0.0, 0.0]]), shift, 1.0).round(6).tolist()
    [[-1.0, 0.0]]
    """
    rows, cols = field_m.shape[1:]
    shown = np.array(points_m, dtype=np.float64)
    for _ in range(_STEPS):
        col = np.clip(np.floor(shown[:, 0] / cell_size_m + cols / 2).astype(np.intp), 0, cols - 1)
        row = np.clip(np.floor(rows / 2 - shown[:, 1] / cell_size_m).astype(np.intp), 0, rows - 1)
        shown += 0.7 * (points_m - field_m[:, row, col].T - shown)  # damped: a steep field would swing
    return shown


def folded_share(field_m: NDArray[np.float64], cell_size_m: float) -> float:
    """Share of the cells where a warp turns the ground over: the determinant of its Jacobian is negative.

    Examples
    --------
    >>> folded_share(np.zeros((2, 8, 8)), 1.0)
    0.0
    """
    (right_by_row, right_by_col), (up_by_row, up_by_col) = (np.gradient(part, cell_size_m) for part in field_m)
    determinant = (1 + right_by_col) * (1 - up_by_row) + right_by_row * up_by_col
    return float((determinant < 0).mean())
