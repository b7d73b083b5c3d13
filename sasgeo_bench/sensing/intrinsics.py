# SPDX-License-Identifier: Apache-2.0
"""Inside of a camera: a pinhole with Brown distortion; the only file where OpenCV's half pixel is added or taken off.

Pixel (row, col) covers [col, col + 1) x [row, row + 1): the picture spans (0, 0) to (width_px, height_px), and its
middle is at half of both. OpenCV counts from the centre of the first pixel, so its principal point is 0.5 smaller.
"""

import math
from dataclasses import dataclass
from typing import Final, Self

import cv2
import numpy as np
from numpy.typing import NDArray

from sasgeo_bench.errors import CameraError

Points = NDArray[np.float64]
Distortion = tuple[float, float, float, float, float]

NO_DISTORTION: Final[Distortion] = (0.0, 0.0, 0.0, 0.0, 0.0)

_HALF_PX: Final = 0.5  # from OpenCV's integer centres to pixel-is-area
_WIDEST_DEG: Final = 170.0  # of a field of view; beyond it a pinhole no longer describes a lens
_MOST_PX: Final = 100_000  # of a side
_STEPS: Final = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 100, 1e-10)  # to take distortion off


@dataclass(frozen=True, slots=True, kw_only=True)
class Intrinsics:
    """Pinhole with Brown distortion; raise `CameraError` if a value cannot be.

    `focal_px` and `centre_px` are (across, down); the centre counts from the outer corner of the first pixel.
    `distortion` is k1, k2, p1, p2, k3 as in OpenCV.

    Examples
    --------
    A picture as wide as it is far away sees 2 * atan(1 / 2) = 53.13 degrees:

    >>> camera = Intrinsics(width_px=800, height_px=600, focal_px=(800.0, 800.0), centre_px=(400.0, 300.0))
    >>> round(camera.horizontal_deg, 2)
    53.13
    """

    width_px: int
    height_px: int
    focal_px: tuple[float, float]
    centre_px: tuple[float, float]
    distortion: Distortion = NO_DISTORTION

    def __post_init__(self) -> None:
        """Check that the values describe a lens."""
        if not (1 <= self.width_px <= _MOST_PX and 1 <= self.height_px <= _MOST_PX):
            raise CameraError(
                f"a picture has 1 to {_MOST_PX} pixels a side, got {self.width_px!r} x {self.height_px!r}"
            )
        numbers = (*self.focal_px, *self.centre_px, *self.distortion)
        if len(numbers) != 2 + 2 + len(NO_DISTORTION) or not all(map(math.isfinite, numbers)):
            raise CameraError(
                f"a camera has two focal lengths, two coordinates of its centre and five coefficients of distortion "
                f"(k1, k2, p1, p2, k3), all finite, got {self.focal_px!r}, {self.centre_px!r}, {self.distortion!r}"
            )
        if not min(self.focal_px) > 0 or self.horizontal_deg > _WIDEST_DEG:
            raise CameraError(
                f"focal_px must be positive and leave a field of view of at most {_WIDEST_DEG:g} degrees, "
                f"got {self.focal_px!r} for {self.width_px} pixels: is it in millimetres?"
            )

    @classmethod
    def from_field_of_view(
        cls, *, horizontal_deg: float, width_px: int, height_px: int, distortion: Distortion = NO_DISTORTION
    ) -> Self:
        """Return a camera with square pixels whose picture is `horizontal_deg` wide; its centre is the picture's.

        >>> Intrinsics.from_field_of_view(horizontal_deg=90.0, width_px=800, height_px=600).focal_px
        (400.0, 400.0)
        """
        if not 0 < horizontal_deg <= _WIDEST_DEG:
            raise CameraError(f"a field of view is above 0 and at most {_WIDEST_DEG:g} degrees, got {horizontal_deg!r}")
        focal_px = round(width_px / 2 / math.tan(math.radians(horizontal_deg) / 2), 9)
        return cls(
            width_px=width_px,
            height_px=height_px,
            focal_px=(focal_px, focal_px),
            centre_px=(width_px / 2, height_px / 2),
            distortion=distortion,
        )

    @classmethod
    def from_matrix(
        cls, matrix: Points, *, width_px: int, height_px: int, distortion: Distortion = NO_DISTORTION
    ) -> Self:
        """Return the camera of a calibration with OpenCV: its matrix, shape (3, 3), counts from pixel centres.

        >>> opencv = np.array([[900.0, 0.0, 399.5], [0.0, 900.0, 299.5], [0.0, 0.0, 1.0]])
        >>> Intrinsics.from_matrix(opencv, width_px=800, height_px=600).centre_px
        (400.0, 300.0)
        """
        matrix = np.asarray(matrix, dtype=np.float64)
        if matrix.shape != (3, 3) or matrix[0, 1] or matrix[1, 0] or matrix[2].tolist() != [0.0, 0.0, 1.0]:
            raise CameraError(
                f"a camera matrix is [[fx, 0, cx], [0, fy, cy], [0, 0, 1]] (no skew), got {matrix.tolist()!r}"
            )
        (fx, _, cx), (_, fy, cy), _ = matrix.tolist()
        return cls(
            width_px=width_px,
            height_px=height_px,
            focal_px=(fx, fy),
            centre_px=(cx + _HALF_PX, cy + _HALF_PX),
            distortion=distortion,
        )

    @property
    def matrix(self) -> Points:
        """Return the camera matrix for OpenCV, shape (3, 3), which counts from pixel centres: undoes `from_matrix`."""
        (fx, fy), (cx, cy) = self.focal_px, self.centre_px
        return np.array([[fx, 0.0, cx - _HALF_PX], [0.0, fy, cy - _HALF_PX], [0.0, 0.0, 1.0]])

    @property
    def horizontal_deg(self) -> float:
        """Return the width of the field of view without distortion, degrees."""
        left, right = self.centre_px[0], self.width_px - self.centre_px[0]
        return math.degrees(math.atan2(left, self.focal_px[0]) + math.atan2(right, self.focal_px[0]))

    def contains(self, points_px: Points) -> NDArray[np.bool_]:
        """Return which points, shape (N, 2), lie in the picture; a NaN does not."""
        return np.asarray(((points_px >= 0) & (points_px < (self.width_px, self.height_px))).all(axis=1))

    def border_px(self, steps: int) -> Points:
        """Return points along the picture's edge, clockwise from its upper left, shape (4 * steps, 2)."""
        along = np.arange(steps) / steps
        none, full = np.zeros(steps), np.ones(steps)
        sides = [(along, none), (full, along), (1 - along, full), (none, 1 - along)]
        return np.concatenate([np.stack(side, axis=1) for side in sides]) * (self.width_px, self.height_px)

    def to_pixels(self, slopes: Points) -> Points:
        """Convert slopes (right / ahead, down / ahead), shape (N, 2), to pixels; NaN where the lens folds over.

        Far outside the picture the polynomial of the distortion turns back, and would bring such points into it.

        >>> lens = Intrinsics.from_field_of_view(horizontal_deg=90.0, width_px=800, height_px=600)
        >>> lens.to_pixels(np.array([[0.0, 0.0], [1.0, 0.5]])).tolist()
        [[400.0, 300.0], [800.0, 500.0]]
        """
        slopes = np.ascontiguousarray(slopes, dtype=np.float64)
        if not any(self.distortion):
            return slopes * self.focal_px + self.centre_px
        # Radius, as a slope, from which the radial polynomial no longer grows; infinite if it always does
        k1, k2, _, _, k3 = self.distortion
        slope = np.array([7 * k3, 5 * k2, 3 * k1, 1.0])  # the derivative of r (1 + k1 r2 + k2 r4 + k3 r6), in r2
        # 1e-15: moves no pixel of any lens; the division of a root by less would overflow
        squares = np.roots(np.where(np.abs(slope) < 1e-15, 0.0, slope))
        real = squares.real[(np.abs(squares.imag) < 1e-12) & (squares.real > 0)]  # rounding of a real root
        outside = ~(np.hypot(*slopes.T) < (float(np.sqrt(real.min())) if len(real) else math.inf))
        safe = np.column_stack([np.where(outside[:, None], 0.0, slopes), np.ones(len(slopes))])
        if not len(safe):
            return slopes
        none = np.zeros(3)
        pixels = cv2.projectPoints(safe, none, none, self.matrix, np.array(self.distortion))[0].reshape(-1, 2)
        return np.where(outside[:, None], np.nan, pixels + _HALF_PX)

    def to_slopes(self, points_px: Points) -> Points:
        """Convert pixels, shape (N, 2), to slopes (right / ahead, down / ahead); NaN where none belongs to it."""
        points_px = np.ascontiguousarray(points_px, dtype=np.float64)
        if not any(self.distortion) or not len(points_px):
            return (points_px - self.centre_px) / self.focal_px
        found = cv2.undistortPointsIter(
            np.nan_to_num(points_px - _HALF_PX).reshape(-1, 1, 2),
            self.matrix,
            np.array(self.distortion),
            np.eye(3),
            np.eye(3),
            _STEPS,
        )
        slopes = np.asarray(found, dtype=np.float64).reshape(-1, 2)
        # 1e-3 pixels: a point whose distortion cannot be undone this well has no ray
        missed = ~(np.abs(self.to_pixels(slopes) - points_px).max(axis=1) < 1e-3)
        return np.where(missed[:, None], np.nan, slopes)
