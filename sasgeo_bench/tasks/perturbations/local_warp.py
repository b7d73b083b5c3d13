# SPDX-License-Identifier: Apache-2.0
"""A smooth local distortion: relief, a stitched mosaic, an inaccurate drawing.

Cells no longer overlap with the map, while roads keep their order: a graph should withstand that, a raster cannot.
"""

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from sasgeo_bench.regions.evidence import Evidence
from sasgeo_bench.tasks.perturbations.base import check_ranges
from sasgeo_bench.tasks.perturbations.fields import centres, resample

_WAVELENGTH_M: Final = 90.0
_WAVES: Final = 16
_SPREAD: Final = 0.2  # relative spread of the wavelengths around their mean
_STEPS: Final = 30  # of the iteration; ten suffice for a gentle field


@dataclass(frozen=True, kw_only=True)
class LocalWarp:
    """Move cells by a smooth displacement field with mean 0 and a mean wavelength of 90 m.

    `rms_m` is the root mean square length of the displacement, metres; exact in every view.

    Notes
    -----
    Sixteen plane waves in random directions for each component. Where `rms_m` exceeds about a tenth of the wavelength
    the field folds, and some ground is seen twice (`folded_share`): at 5 m nothing, at 10 m 0.005 of the view, at 15 m
    0.08.
    """

    rms_m: float

    def __post_init__(self) -> None:
        """Check the range."""
        check_ranges(self, rms_m=(0, 1e3))

    def __call__(self, evidence: Evidence, rng: np.random.Generator, /) -> Evidence:
        """Warp the view; ground from outside it is unknown."""
        if self.rms_m == 0:
            return evidence
        return warped(evidence, self.field(evidence.shape, evidence.cell_size_m, rng))

    def field(self, shape: tuple[int, int], cell_size_m: float, rng: np.random.Generator) -> NDArray[np.float64]:
        """Draw the displacement (right, up) of every cell, shape (2, rows, cols), metres.

        A cell shows the ground that far off. An equal generator gives the field that a call of the warp uses, so that
        vectors can be moved with the cells (`moved`).
        """
        at = centres(shape, cell_size_m)
        field = np.stack([self._component(at.right_m.ravel(), at.up_m.ravel(), rng) for _ in range(2)])
        field -= field.mean(axis=(1, 2), keepdims=True)
        rms = np.sqrt((field**2).sum(axis=0).mean())
        return np.asarray(field * (self.rms_m / rms if rms > 0 else 0.0))

    def _component(
        self, right_m: NDArray[np.float64], up_m: NDArray[np.float64], rng: np.random.Generator
    ) -> NDArray[np.float64]:
        """Return a sum of plane waves; each is a product of a row and a column, so one matrix product gives the sum."""
        wavelengths_m = _WAVELENGTH_M * rng.uniform(1 - _SPREAD, 1 + _SPREAD, size=_WAVES)
        heading, phase = rng.uniform(0, 2 * np.pi, size=(2, _WAVES))
        number = 2 * np.pi / wavelengths_m
        across = np.outer(number * np.cos(heading), right_m)
        along = np.outer(up_m, number * np.sin(heading)) + phase
        rows = np.concatenate((np.cos(along), -np.sin(along)), axis=1)
        # Not `@`: its last digit depends on the number of threads, and the queries of a seed would too.
        return np.asarray(np.einsum("rw,wc->rc", rows, np.concatenate((np.cos(across), np.sin(across)))))


def warped(evidence: Evidence, field_m: NDArray[np.float64]) -> Evidence:
    """Show in each cell the ground `field_m` off, shape (2, rows, cols)."""
    at = centres(evidence.shape, evidence.cell_size_m)
    return resample(evidence, at.right_m + field_m[0], at.up_m + field_m[1])


def moved(points_m: NDArray[np.float64], field_m: NDArray[np.float64], cell_size_m: float) -> NDArray[np.float64]:
    """Return where a warp shows points of the view, shape (N, 2), (right, up) from its middle in metres.

    The cell at p shows the ground at p + d(p), so a point q is shown at the p with p + d(p) = q. The iteration p = q -
    d(p) finds it to within a cell; where the field folds there are several solutions, and it may not converge.
    """
    rows, cols = field_m.shape[1:]
    shown = np.array(points_m, dtype=np.float64)
    for _ in range(_STEPS):
        col = np.clip(np.floor(shown[:, 0] / cell_size_m + cols / 2).astype(np.intp), 0, cols - 1)
        row = np.clip(np.floor(rows / 2 - shown[:, 1] / cell_size_m).astype(np.intp), 0, rows - 1)
        shown += 0.7 * (points_m - field_m[:, row, col].T - shown)  # damped: a steep field would swing
    return shown


def folded_share(field_m: NDArray[np.float64], cell_size_m: float) -> float:
    """Return the fraction of cells where the warp folds: the determinant of its Jacobian is negative."""
    (right_by_row, right_by_col), (up_by_row, up_by_col) = (np.gradient(part, cell_size_m) for part in field_m)
    determinant = (1 + right_by_col) * (1 - up_by_row) + right_by_row * up_by_col
    return float((determinant < 0).mean())
