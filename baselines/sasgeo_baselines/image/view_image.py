# SPDX-License-Identifier: Apache-2.0
"""The picture of a query as seen from above, heading up; the imagery of a map on one lattice."""

import math
from dataclasses import dataclass
from typing import Final, Self

import cv2
import numpy as np
from numpy.typing import NDArray

import sasgeo_bench as sgb

Pixels = NDArray[np.uint8]
Plane = NDArray[np.float32]


# Texts that the cards share.
PICTURE: Final = (
    "the newest picture of the query, brought onto level ground by its believed camera; the imagery where it lies, not "
    "moved by its measured offset"
)
LIMITS: Final = (
    "needs imagery of the map; knows neither classes nor seasons; one picture of the query; leaning roofs and relief "
    "are not modelled; no confidence; withholds where the picture is flat or shows less than a tenth of the view"
)


MASKED: Final = (
    "without what lies under roofs of the map or within 2 m of one: roofs lean and are seen from elsewhere, roads and "
    "fields are where the map has them"
)
_EAVES_M: Final = 2.0


@dataclass(frozen=True, kw_only=True)
class ViewImage:
    """A picture on a square lattice: `rgb`, uint8 of shape (n, n, 3), and where it shows something, shape (n, n)."""

    rgb: Pixels
    is_seen: NDArray[np.bool_]
    gsd_m: float

    @property
    def grey(self) -> Pixels:
        """Return the brightness, shape (n, n); that of the mean where nothing is seen."""
        return grey_of(self.rgb, self.is_seen)

    def turned(self, turn: sgb.Pose, size_px: int) -> Self:
        """Return the picture north up, if its heading and scale are those of `turn`; the middle stays where it is.

        >>> rgb = np.zeros((3, 3, 3), dtype=np.uint8)
        >>> rgb[0, 1] = 255  # ahead
        >>> east = sgb.Pose(easting_m=0.0, northing_m=0.0, yaw_deg=90.0)
        >>> ViewImage(rgb=rgb, is_seen=np.ones((3, 3), dtype=bool), gsd_m=1.0).turned(east, 3).rgb[:, :, 0].tolist()
        [[0, 0, 0], [0, 0, 255], [0, 0, 0]]
        """
        along, across = (how(math.radians(turn.yaw_deg)) / turn.scale for how in (math.cos, math.sin))
        turning = np.array([[along, across], [-across, along]])
        from_middle, to_middle = (size_px - 1) / 2, (len(self.rgb) - 1) / 2
        shift = to_middle - turning @ (from_middle, from_middle)
        matrix = np.column_stack([turning, shift])

        seen = self.is_seen.astype(np.float32)
        rgb, share = (cv2.warpAffine(plane, matrix, (size_px, size_px), flags=_HOW) for plane in (self.rgb, seen))
        # 0.99 of a warped pixel must be known
        return type(self)(rgb=np.asarray(rgb, dtype=np.uint8), is_seen=np.asarray(share) > 0.99, gsd_m=self.gsd_m)


_HOW: Final = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP


def under_roofs(region: sgb.Region, grid: sgb.Grid) -> NDArray[np.bool_]:
    """Return which pixels of a lattice lie under buildings of the map or within `_EAVES_M` of one, (rows, cols)."""
    if "building" not in region.classes:
        return np.zeros(grid.shape, dtype=bool)
    is_roof = (region.layer("building") == sgb.PRESENT).astype(np.uint8)
    reach = 2 * round(_EAVES_M / region.grid.cell_size_m) + 1
    is_roof = np.pad(np.asarray(cv2.dilate(is_roof, np.ones((reach, reach), dtype=np.uint8))), 1)
    # Both lattices have their north up: a row of one is a row of the other.
    across, down = np.arange(grid.cols) + 0.5, np.arange(grid.rows) + 0.5
    cols = region.grid.to_cells(grid.to_en_m(np.column_stack((across, np.zeros_like(across)))))[:, 1]
    rows = region.grid.to_cells(grid.to_en_m(np.column_stack((np.zeros_like(down), down))))[:, 0]
    at = np.ix_(*(np.clip(cells + 1, 0, most - 1) for cells, most in zip((rows, cols), is_roof.shape, strict=True)))
    return np.asarray(is_roof[at] > 0)


def side_of(query: sgb.Query) -> float:
    """Return the side of the view of a query, metres."""
    return float(query.evidence.cells.shape[-1] * query.evidence.cell_size_m)


def view_image(query: sgb.Query, *, gsd_m: float, size_px: int | None = None) -> ViewImage | None:
    """Return the newest picture of a query over its view, heading up; None if it shows too little to go by."""
    if not query.frames:
        return None
    frame = query.frames[-1]
    size_px = size_px or 2 * int(side_of(query) / gsd_m / 2) + 1
    rgb = sgb.rectify(
        np.maximum(frame.image().rgb, 1),  # black is where nothing is seen
        frame.camera,
        sgb.Plane(),
        size_cells=size_px,
        cell_size_m=gsd_m,
        pose=sgb.Pose(easting_m=0.0, northing_m=0.0, yaw_deg=0.0),
    )
    seen_image = ViewImage(rgb=rgb, is_seen=np.asarray(rgb.max(axis=2) > 0), gsd_m=gsd_m)
    # 2: standard deviation of the grey of a view, of 255: a flatter one shows nothing
    if seen_image.is_seen.mean() < 0.1 or seen_image.grey[seen_image.is_seen].std() < 2.0:  # 0.1: least seen of a view
        return None
    return seen_image


def grey_of(rgb: Pixels, is_known: NDArray[np.bool_]) -> Pixels:
    """Return the brightness, shape (rows, cols); that of the mean where nothing is known."""
    grey = np.asarray(cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY))
    mean = grey[is_known].mean() if is_known.any() else 0.0
    return np.where(is_known, grey, round(float(mean))).astype(np.uint8)


@dataclass(frozen=True, kw_only=True)
class Ortho:
    """The imagery of a whole map: `rgb`, uint8 of shape (rows, cols, 3), and where it is known."""

    grid: sgb.Grid
    rgb: Pixels
    is_known: NDArray[np.bool_]

    @classmethod
    def of(cls, region: sgb.Region, *, gsd_m: float) -> Self | None:
        """Read the imagery of a region block by block; None if it has none."""
        imagery = region.imagery
        if imagery is None:
            return None
        grid = sgb.Grid.from_bounds(*imagery.record.bounds_m, cell_size_m=gsd_m, epsg=imagery.epsg)
        rgb, is_known = np.zeros((*grid.shape, 3), dtype=np.uint8), np.zeros(grid.shape, dtype=bool)
        for row, col, part in grid.windows(2048):  # pixels: block of imagery read at once
            west_m, south_m, east_m, north_m = part.bounds_m
            hair_m = gsd_m / 100  # a block ends at its last pixel, whatever rounding says
            window = imagery.read((west_m + hair_m, south_m + hair_m, east_m - hair_m, north_m - hair_m), gsd_m=gsd_m)
            rgb[row : row + part.rows, col : col + part.cols] = window.rgb
            is_known[row : row + part.rows, col : col + part.cols] = window.is_known
        return cls(grid=grid, rgb=rgb, is_known=is_known)
