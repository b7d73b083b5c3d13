# SPDX-License-Identifier: Apache-2.0
"""ORB features of a picture, and of the imagery of a map tile by tile."""

from dataclasses import dataclass
from typing import Final, Self

import cv2
import numpy as np
from numpy.typing import NDArray

import sasgeo_bench as sgb
from sasgeo_baselines.image.view_image import Ortho, ViewImage, grey_of

PIXEL_M: Final = 0.5
BITS: Final = 256  # of a descriptor
_BYTES: Final = BITS // 8
_TILE_PX: Final = 256
_MARGIN_PX: Final = 48  # around a tile, so that its edge has features too
_RIM_PX: Final = 20  # of what is known, without features
_PER_TILE: Final = 300  # features of 128 x 128 m
_HALF: Final = 0.5


@dataclass(frozen=True, kw_only=True)
class Features:
    """Places, shape (N, 2), and descriptors, uint8 of shape (N, 32)."""

    points: NDArray[np.float64]
    descriptors: NDArray[np.uint8]

    def __len__(self) -> int:
        return len(self.points)

    def chosen(self, which: NDArray[np.bool_]) -> Self:
        """Return some of the features."""
        return type(self)(points=self.points[which], descriptors=self.descriptors[which])


def detect(grey: NDArray[np.uint8], is_known: NDArray[np.bool_], *, most: int) -> Features:
    """Return the strongest ORB features of a picture; places are (u, v), pixels from its upper left corner."""
    if min(grey.shape) <= 2 * _RIM_PX:  # OpenCV cannot make a pyramid of so few pixels
        return Features(points=np.zeros((0, 2)), descriptors=np.zeros((0, _BYTES), dtype=np.uint8))
    inside = cv2.erode(
        cv2.copyMakeBorder(is_known.astype(np.uint8), 1, 1, 1, 1, cv2.BORDER_CONSTANT, value=1),
        np.ones((2 * _RIM_PX + 1,) * 2, dtype=np.uint8),
    )[1:-1, 1:-1]
    orb = cv2.ORB.create(nfeatures=most, scaleFactor=1.2, nlevels=6, edgeThreshold=19, fastThreshold=7)
    smooth = cv2.GaussianBlur(grey, (0, 0), 1.5)  # 1.5 pixels: less noise, fewer corners
    found, descriptors = orb.detectAndCompute(smooth, np.ascontiguousarray(inside) * 255)
    if descriptors is None or not len(found):
        return Features(points=np.zeros((0, 2)), descriptors=np.zeros((0, _BYTES), dtype=np.uint8))
    points = np.array([point.pt for point in found], dtype=np.float64) + _HALF  # OpenCV counts from pixel centres
    return Features(points=points, descriptors=np.asarray(descriptors, dtype=np.uint8))


def view_features(seen_image: ViewImage, *, side_m: float) -> Features:
    """Return the features of a view, as many to the area as the imagery has; places are (right, up), metres."""
    most = max(round(_PER_TILE * (side_m / (_TILE_PX * PIXEL_M)) ** 2 * 1.5), 100)
    found = detect(seen_image.grey, seen_image.is_seen, most=most)
    middle = len(seen_image.rgb) / 2
    return Features(
        points=(found.points - middle) * (seen_image.gsd_m, -seen_image.gsd_m) + 0.0, descriptors=found.descriptors
    )


def map_features(region: sgb.Region) -> tuple[Features, sgb.Grid] | None:
    """Return the features of the imagery of a region, places as easting and northing; None if it has no imagery."""
    ortho = Ortho.of(region, gsd_m=PIXEL_M)
    if ortho is None:
        return None
    parts = [_of_tile(ortho, row, col) for row, col, _ in ortho.grid.windows(_TILE_PX)]
    points = ortho.grid.to_en_m(np.concatenate([part.points for part in parts]))
    descriptors = np.concatenate([part.descriptors for part in parts])
    return Features(points=points, descriptors=descriptors), ortho.grid


def _of_tile(ortho: Ortho, row: int, col: int) -> Features:
    """Return the features within a tile; its surroundings are looked at too."""
    top, left = max(row - _MARGIN_PX, 0), max(col - _MARGIN_PX, 0)
    cut = (slice(top, row + _TILE_PX + _MARGIN_PX), slice(left, col + _TILE_PX + _MARGIN_PX))
    around = ((_TILE_PX + 2 * _MARGIN_PX) / _TILE_PX) ** 2
    known = ortho.is_known[cut]
    found = detect(grey_of(ortho.rgb[cut], known), known, most=round(_PER_TILE * around))
    points = found.points + np.array([left, top])
    within = ((points >= (col, row)) & (points < (col + _TILE_PX, row + _TILE_PX))).all(axis=1)
    return Features(points=points, descriptors=found.descriptors).chosen(within)
