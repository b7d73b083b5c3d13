# SPDX-License-Identifier: Apache-2.0
"""Ground of a region that its imagery shows: pictures of it, and what kind of ground they show."""

import math
from dataclasses import dataclass
from functools import cached_property
from typing import Final

import cv2
import numpy as np
import shapely
from numpy.typing import NDArray

from sasgeo_bench.geometry.pose import Pose
from sasgeo_bench.regions.evidence import PRESENT, UNKNOWN
from sasgeo_bench.regions.imagery import MOST_WINDOW_PIXELS, Imagery, ImageryWindow
from sasgeo_bench.tasks.state import State

BUILT: Final = "built"
MIXED: Final = "mixed"
OPEN: Final = "open"
GROUNDS: Final = (BUILT, MIXED, OPEN)
BUILT_SHARE: Final = 0.10  # of a view, under buildings: rows of houses with gardens have 12 to 18 %
MIXED_BUILDINGS: Final = 0.02
MIXED_DRAWN: Final = 0.08  # under buildings, roads, rails and the like: two roads that cross a view of 192 m have 5 %
_PROBES: Final = 64  # along each side of a view
_MASK_M: Final = 1.0
_UNKNOWN_BIT: Final = np.uint32(1 << 31)

Floats = NDArray[np.float64]


@dataclass(frozen=True, kw_only=True)
class PicturedGround:
    """A map, and the imagery of the same region.

    Places are given in coordinates of the map; where the offset of the imagery against it is known, the imagery is
    read at the place at which it shows them. Raise `StoreError` where the imagery is missing or damaged.

    Examples
    --------
    `PicturedGround(state=State.of(region), imagery=region.imagery).ground(pose, 192.0)` says "built" of a square of
    192 m in a town, and `.shown_share(pose, 192.0)` 0.5 where the rim of the picture runs through its middle.
    """

    state: State
    imagery: Imagery

    @property
    def off_m(self) -> tuple[float, float]:
        """Return how far east and north of its place on the map a thing is seen, metres; 0 where not measured."""
        return self.imagery.off_m

    @property
    def own_gsd_m(self) -> float:
        """Return the ground resolution of the coarsest picture; the imagery may have finer pixels than it."""
        return max(picture.gsd_m for picture in self.imagery.record.pictures)

    @cached_property
    def _shown(self) -> ImageryWindow:
        west, south, east, north = bounds_m = self.imagery.record.bounds_m
        coarsest_m = math.sqrt((east - west + _MASK_M) * (north - south + _MASK_M) / MOST_WINDOW_PIXELS)
        return self.imagery.read(bounds_m, gsd_m=max(_MASK_M, self.imagery.record.gsd_m, 1.1 * coarsest_m))

    @cached_property
    def _buildings(self) -> NDArray[np.bool_]:
        if "building" not in self.state.classes:
            return np.zeros_like(self.state.drawn)
        return self.state.has("building")

    def shows(self, places_m: Floats) -> NDArray[np.bool_]:
        """Return at which places (easting, northing), shape (N, 2), there is a picture."""
        return _looked_up(self._shown.is_known, self._shown.grid.to_cells(places_m + self.off_m))

    def shown_share(self, pose: Pose, side_m: float) -> float:
        """Return the fraction of a square view that the imagery shows; the pose's scale widens the view."""
        return float(self.shows(_probes_m(pose, side_m)).mean())

    def shows_corners(self, pose: Pose, side_m: float) -> bool:
        """Return whether the four corners of a view are on the picture: beyond its rim one of them is not."""
        corners = np.array([(right, ahead) for right in (-0.5, 0.5) for ahead in (-0.5, 0.5)]) * side_m
        return bool(self.shows(pose.to_map(corners)).all())

    def ground(self, pose: Pose, side_m: float) -> str:
        """Return what kind of ground a view shows by the map, one of `GROUNDS`.

        "built" has 10 % of it or more under buildings; "mixed" 2 % or more, or 8 % under roads, rails and buildings
        together; all else is "open": farmland and forest, lawns, bare ground and water.
        """
        buildings = self._share(self._buildings, pose, side_m)
        if buildings >= BUILT_SHARE:
            return BUILT
        is_mixed = buildings >= MIXED_BUILDINGS or self.drawn_share(pose, side_m) >= MIXED_DRAWN
        return MIXED if is_mixed else OPEN

    def drawn_share(self, pose: Pose, side_m: float) -> float:
        """Return the fraction of a view under buildings, roads and other drawn things of the map."""
        return self._share(self.state.drawn, pose, side_m)

    def cut(self, pose: Pose, side_m: float, width_px: int) -> "Cut":
        """Return the square picture around a pose, `side_m` wide at scale 1, with what the map says of its pixels."""
        right = ((np.arange(width_px) + 0.5) / width_px - 0.5) * side_m
        across, ahead = np.meshgrid(right, -right)
        # Easting and northing of each pixel, shape (H, W, 2)
        ground_m = pose.to_map(np.stack((across.ravel(), ahead.ravel()), axis=1)).reshape(width_px, width_px, 2)
        rgb, is_known = _pixels(self.imagery, ground_m + self.off_m)
        labels = _labels(self.state, ground_m, is_known)
        return Cut(rgb=rgb, is_known=is_known, labels=labels, pixel_m=side_m / width_px)

    @property
    def footprint(self) -> shapely.Polygon:
        """Return the rectangle of the map within which the imagery lies, in the region's CRS."""
        west, south, east, north = self.imagery.record.bounds_m
        off_east_m, off_north_m = self.off_m
        return shapely.box(west - off_east_m, south - off_north_m, east - off_east_m, north - off_north_m)

    def _share(self, mask: NDArray[np.bool_], pose: Pose, side_m: float) -> float:
        return float(_looked_up(mask, self.state.grid.to_cells(_probes_m(pose, side_m))).mean())


@dataclass(frozen=True, kw_only=True)
class Cut:
    """A picture of some ground, uint8 of shape (H, W, 3), with pixels `pixel_m` wide.

    `is_known` says where the imagery shows anything, (H, W); `labels` what the map says, (C, H, W), of ABSENT, PRESENT
    and UNKNOWN.
    """

    rgb: NDArray[np.uint8]
    is_known: NDArray[np.bool_]
    labels: NDArray[np.uint8]
    pixel_m: float

    def share(self, classes: tuple[str, ...], name: str) -> float:
        """Return the share of a class on the picture; 0 where the map does not know of it."""
        return float((self.labels[classes.index(name)] == PRESENT).mean()) if name in classes else 0.0


def _pixels(imagery: Imagery, seen_m: Floats) -> tuple[NDArray[np.uint8], NDArray[np.bool_]]:
    """Return the colours of places of the imagery, (H, W, 2), shape (H, W, 3), and which of them it shows, (H, W)."""
    pixel_m = float(np.hypot(*(seen_m[0, 1] - seen_m[0, 0])))
    low, high = seen_m.min(axis=(0, 1)) - 2 * pixel_m, seen_m.max(axis=(0, 1)) + 2 * pixel_m
    bounds_m = (float(low[0]), float(low[1]), float(high[0]), float(high[1]))
    window = imagery.read(bounds_m, gsd_m=max(pixel_m, imagery.record.gsd_m))
    uv = (window.grid.to_uv(seen_m.reshape(-1, 2)) - 0.5).astype(np.float32).reshape(seen_m.shape)
    rgb = cv2.remap(window.rgb, uv[..., 0], uv[..., 1], cv2.INTER_LINEAR)
    known = cv2.remap(window.is_known.view(np.uint8), uv[..., 0], uv[..., 1], cv2.INTER_NEAREST)
    return np.asarray(rgb, dtype=np.uint8), np.asarray(known > 0)


def _labels(state: State, ground_m: Floats, is_known: NDArray[np.bool_]) -> NDArray[np.uint8]:
    """Return what the map says of each pixel, shape (C, H, W): UNKNOWN beyond its ground or the imagery."""
    row, col = state.grid.to_cells(ground_m.reshape(-1, 2)).T
    inside = (row >= 0) & (row < state.grid.rows) & (col >= 0) & (col < state.grid.cols)
    bits = np.full(len(row), _UNKNOWN_BIT)
    bits[inside] = state.bits.bits[row[inside], col[inside]]
    states = [(bits >> np.uint32(at) & np.uint32(1)).astype(np.uint8) for at in range(len(state.classes))]
    found = np.stack(states).reshape(-1, *is_known.shape)
    found[:, ((bits & _UNKNOWN_BIT) > 0).reshape(is_known.shape) | ~is_known] = UNKNOWN
    return found


def _probes_m(pose: Pose, side_m: float) -> Floats:
    """Return places spread evenly over a view, (easting, northing), shape (N, 2)."""
    at = ((np.arange(_PROBES) + 0.5) / _PROBES - 0.5) * side_m
    right, ahead = np.meshgrid(at, at)
    return pose.to_map(np.column_stack((right.ravel(), ahead.ravel())))


def _looked_up(mask: NDArray[np.bool_], cells: NDArray[np.int64]) -> NDArray[np.bool_]:
    """Return the values of a mask at cells (row, col), shape (N, 2); False beyond it."""
    row, col = cells.T
    inside = (row >= 0) & (row < mask.shape[0]) & (col >= 0) & (col < mask.shape[1])
    found = np.zeros(len(row), dtype=bool)
    found[inside] = mask[row[inside], col[inside]]
    return found
