# SPDX-License-Identifier: Apache-2.0
"""Local distortions: relief, a stitched mosaic, a rolling shutter, a residual tilt.

Cells no longer overlap with the map, while roads keep their order: a graph should withstand that, a raster cannot.
"""

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import ClassVar, Final

import numpy as np
from numpy.typing import NDArray

from sasgeo_bench.regions.evidence import Evidence
from sasgeo_bench.tasks.perturbations.base import centres, check_ranges, resample

_WAVELENGTH_M: Final = 90.0
_WAVES: Final = 16
_SPREAD: Final = 0.2  # relative spread of the wavelengths around their mean
_ROW_WAVES: Final = 6  # of the shake of a camera
_ALONG_SHARE: Final = 0.2  # of the mean square shift

Floats = NDArray[np.float64]
_ACROSS_M: Final = (40.0, 120.0)  # its wavelengths on the ground: shifts along a row shear and never fold
_ALONG_M: Final = (150.0, 400.0)  # shifts across the rows squeeze the view, so they change slowly


@dataclass(frozen=True, kw_only=True)
class Warp(ABC):
    """Base of warps: they move cells by a displacement field with mean 0.

    `rms_m` is the root mean square length of the displacement, metres; exact in every view.
    """

    moves_cells: ClassVar = True  # so that an unknown cell may become known
    rms_m: float

    def __post_init__(self) -> None:
        check_ranges(self, rms_m=(0, 1e3))

    def __call__(self, evidence: Evidence, rng: np.random.Generator, /) -> Evidence:
        """Warp the view; ground from outside it is unknown."""
        if self.rms_m == 0:
            return evidence
        return warped(evidence, self.field(evidence.shape, evidence.cell_size_m, rng))

    @abstractmethod
    def field(self, shape: tuple[int, int], cell_size_m: float, rng: np.random.Generator) -> Floats:
        """Draw the displacement (right, up) of every cell, shape (2, rows, cols), metres.

        A cell shows the ground that far off. An equal generator gives the field that a call of the warp uses, so that
        vectors can be moved with the cells (`moved`).
        """

    def _scaled(self, field: Floats) -> Floats:
        """Return a field with mean 0 and the length asked for."""
        field = field - field.mean(axis=(1, 2), keepdims=True)
        rms = np.sqrt((field**2).sum(axis=0).mean())
        return np.asarray(field * (self.rms_m / rms if rms > 0 else 0.0))


@dataclass(frozen=True, kw_only=True)
class LocalWarp(Warp):
    """Move cells by a smooth displacement field with a mean wavelength of 90 m.

    Notes
    -----
    Sixteen plane waves in random directions for each component. Where `rms_m` exceeds about a tenth of the wavelength
    the field folds, and some ground is seen twice (`folded_share`): at 5 m nothing, at 10 m 0.005 of the view, at 15 m
    0.08.
    """

    def field(self, shape: tuple[int, int], cell_size_m: float, rng: np.random.Generator) -> Floats:
        """Draw a sum of plane waves."""
        at = centres(shape, cell_size_m)
        return self._scaled(np.stack([self._component(at.right_m.ravel(), at.up_m.ravel(), rng) for _ in range(2)]))

    def _component(self, right_m: Floats, up_m: Floats, rng: np.random.Generator) -> Floats:
        """Return a sum of plane waves; each is a product of a row and a column, so one matrix product gives the sum."""
        wavelengths_m = _WAVELENGTH_M * rng.uniform(1 - _SPREAD, 1 + _SPREAD, size=_WAVES)
        heading, phase = rng.uniform(0, 2 * np.pi, size=(2, _WAVES))
        number = 2 * np.pi / wavelengths_m
        across = np.outer(number * np.cos(heading), right_m)
        along = np.outer(up_m, number * np.sin(heading)) + phase
        rows = np.concatenate((np.cos(along), -np.sin(along)), axis=1)
        # Not `@`: its last digit depends on the number of threads, and the queries of a seed would too.
        return np.asarray(np.einsum("rw,wc->rc", rows, np.concatenate((np.cos(across), np.sin(across)))))


@dataclass(frozen=True, kw_only=True)
class RowJitter(Warp):
    """Shift each row as a whole, as a rolling shutter does on a platform that shakes while the rows are read.

    Notes
    -----
    Rows are read from the top of the view, along the heading. Roll shifts a row sideways, with wavelengths of 40 to 120
    m on the ground; pitch and speed shift it along the heading, a fifth of the mean square, with 150 to 400 m. The
    wavelengths are guesses. The field does not depend on the column, so it hardly folds (`folded_share`).
    """

    def field(self, shape: tuple[int, int], cell_size_m: float, rng: np.random.Generator) -> Floats:
        """Draw a sum of sines over the rows for each component."""
        up_m = centres(shape, cell_size_m).up_m
        shares = (1 - _ALONG_SHARE, _ALONG_SHARE)
        shakes = []
        # Its wavelengths on the ground: shifts along a row shear and never fold
        # Shifts across the rows squeeze the view, so they change slowly
        for lengths_m, share in zip((_ACROSS_M, _ALONG_M), shares, strict=True):
            phase = rng.uniform(0, 2 * np.pi, _ROW_WAVES)
            shake = np.sin(2 * np.pi * up_m / rng.uniform(*lengths_m, _ROW_WAVES) + phase).sum(axis=1, keepdims=True)
            shake -= shake.mean()
            shakes.append(shake * np.sqrt(share / max((shake**2).mean(), 1e-12)))
        return self._scaled(np.stack([np.broadcast_to(shake, shape) for shake in shakes]))


@dataclass(frozen=True, kw_only=True)
class Tilt(Warp):
    """See the ground under a tilt that was not removed: a homography, less the similarity that fits it best.

    Notes
    -----
    The cell at p shows p / (1 - t.p) for a tilt t in a random direction, whose length gives the displacement asked for.
    What place, heading and scale would explain is taken away, so that the true pose stays the best one. A camera at
    height H that leans by an angle a has |t| = tan(a) / H: in a view of 192 m from 137 m, 5 m rms are about 7 degrees,
    15 m about 20. A camera fixed to the body leans by 9.6 degrees (median) to 21.5 (95 %) on survey flights at 80 m.
    The field never folds.
    """

    def field(self, shape: tuple[int, int], cell_size_m: float, rng: np.random.Generator) -> Floats:
        """Draw a direction and find the tilt by bisection: a larger tilt moves cells farther."""
        at = centres(shape, cell_size_m)
        turn = rng.uniform(0, 2 * np.pi)
        ahead_m = at.right_m * np.cos(turn) + at.up_m * np.sin(turn)
        ground = at.right_m + 1j * at.up_m
        # 0.9 of the tilt at which the horizon reaches the view
        low, high = 0.0, 0.9 / max(float(ahead_m.max()), cell_size_m)
        for _ in range(40):  # halvings of the interval that holds a tilt
            middle = (low + high) / 2
            left_m = _without_similarity(ground / (1 - middle * ahead_m), ground)
            is_more = float((np.abs(left_m) ** 2).mean()) > self.rms_m**2
            low, high = (low, middle) if is_more else (middle, high)
        left_m = _without_similarity(ground / (1 - low * ahead_m), ground)
        return self._scaled(np.stack((left_m.real, left_m.imag)))  # a tilt near the horizon may fall short


def _without_similarity(shown: NDArray[np.complex128], ground: NDArray[np.complex128]) -> NDArray[np.complex128]:
    off = shown - shown.mean()
    spread = float((np.abs(off) ** 2).mean())
    factor = (off.conj() * ground).mean() / spread if spread > 0 else 1.0
    return np.asarray(factor * off - (ground - ground.mean()))


def warped(evidence: Evidence, field_m: Floats) -> Evidence:
    """Show in each cell the ground `field_m` off, shape (2, rows, cols)."""
    at = centres(evidence.shape, evidence.cell_size_m)
    return resample(evidence, at.right_m + field_m[0], at.up_m + field_m[1])


def moved(points_m: Floats, field_m: Floats, cell_size_m: float) -> Floats:
    """Return where a warp shows points of the view, shape (N, 2), (right, up) from its middle in metres.

    The cell at p shows the ground at p + d(p), so a point q is shown at the p with p + d(p) = q. The iteration p = q -
    d(p) finds it to within a cell; where the field folds there are several solutions, and it may not converge.
    """
    rows, cols = field_m.shape[1:]
    shown = np.array(points_m, dtype=np.float64)
    for _ in range(30):  # steps of the iteration; ten suffice for a gentle field
        col = np.clip(np.floor(shown[:, 0] / cell_size_m + cols / 2).astype(np.intp), 0, cols - 1)
        row = np.clip(np.floor(rows / 2 - shown[:, 1] / cell_size_m).astype(np.intp), 0, rows - 1)
        shown += 0.7 * (points_m - field_m[:, row, col].T - shown)  # damped: a steep field would swing
    return shown


def folded_share(field_m: Floats, cell_size_m: float) -> float:
    """Return the fraction of cells where the warp folds: the determinant of its Jacobian is negative."""
    (right_by_row, right_by_col), (up_by_row, up_by_col) = (np.gradient(part, cell_size_m) for part in field_m)
    determinant = (1 + right_by_col) * (1 - up_by_row) + right_by_row * up_by_col
    return float((determinant < 0).mean())
