# SPDX-License-Identifier: Apache-2.0
"""Lost parts of a view: hidden rectangles, a ragged frame, a narrow field of view, false unknowns."""

from functools import lru_cache
from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

from sasgeo_bench.geometry.pose import rotation
from sasgeo_bench.osm.taxonomy import load_taxonomy
from sasgeo_bench.regions.evidence import PRESENT, UNKNOWN, Evidence
from sasgeo_bench.tasks.perturbations.base import (
    Field,
    Mask,
    NoisePool,
    Occlusion,
    centres,
    dilated,
    highest,
    highest_within,
    smooth_noise,
    top_share,
)
from sasgeo_bench.tasks.perturbations.streams import Streams


class Rectangles(Occlusion):
    """Hide the view behind rectangles that may overlap; exactly `share` of the cells, to the nearest one."""

    def mask(self, evidence: Evidence, rng: np.random.Generator) -> Mask:
        """Return the cells that the rectangles cover, shape (rows, cols)."""
        covered = np.zeros(evidence.shape, dtype=bool)
        target = round(self.share * covered.size)
        left = target
        while left > 0:
            for row, col, height, width in _draw(covered.shape, rng):
                if left == target or not covered[row, col]:
                    left -= _cover(covered[row : row + height, col : col + width], left)
                if left <= 0:
                    return covered
            # Little is free: cover the remaining cells in order instead of drawing more rectangles.
            if left < covered.size * 0.001 or left > 0.97 * (covered.size - target + left):
                covered.ravel()[np.flatnonzero(~covered)[:left]] = True
                return covered
        return covered


def _draw(shape: tuple[int, ...], rng: np.random.Generator) -> list[list[int]]:
    """Draw row, column, height and width of some rectangles; a corner may lie outside the view."""
    side = np.array(shape)
    # 256 rectangles at a time; their sides are 0.08 to 0.35 of the view's
    sizes = np.maximum(1, rng.uniform(0.08, 0.35, size=(256, 2)) * side).astype(int)
    corners = np.floor(rng.uniform(-sizes / 2, side - sizes / 2)).astype(int)
    low = np.maximum(corners, 0)
    rectangles: list[list[int]] = np.hstack((low, sizes + np.minimum(corners, 0))).tolist()
    return rectangles


def _cover(window: Mask, most_cells: int) -> int:
    """Cover a window from its top, row by row, with at most `most_cells` new cells; return the number of new ones."""
    fresh = int(window.size - np.count_nonzero(window))
    if fresh <= most_cells:
        window[:] = True
        return fresh
    by_row = np.cumsum(np.count_nonzero(~window, axis=1))
    rows = int(np.searchsorted(by_row, most_cells, side="right"))
    window[:rows] = True
    spent = int(by_row[rows - 1]) if rows else 0
    last = np.flatnonzero(~window[rows])[: most_cells - spent]
    window[rows, last] = True
    return most_cells


MASKS: Final = 32
_KINDS: Final = 4


class AdversarialMask(Occlusion):
    """Cover the view with that of 32 fixed masks which hides most present cells.

    The masks (spots, bars, clouds, far corners; eight of each) depend on neither the view nor the generator. So no mask
    is fitted to the truth cell by cell, and every method meets the same masks.
    """

    def mask(self, evidence: Evidence, _rng: np.random.Generator) -> Mask:
        """Return the mask that hides most present cells; the first of them if several do."""
        present = np.add.reduce(evidence.cells == PRESENT, axis=0, dtype=np.float32)
        covered = np.einsum("mp,p->m", _halved(evidence.shape, self.share), _half(present).ravel())
        return np.asarray(library(evidence.shape, self.share)[int(np.argmax(covered))])


@lru_cache(maxsize=4)
def library(shape: tuple[int, int], share: float) -> Mask:
    """Return the masks that each cover a share of a view, shape (32, rows, cols)."""
    masks = np.stack([top_share(_score(shape, index), share) for index in range(MASKS)])
    masks.flags.writeable = False
    return masks


@lru_cache(maxsize=4)
def _halved(shape: tuple[int, int], share: float) -> Field:
    return np.stack([_half(mask.astype(np.float32)).ravel() for mask in library(shape, share)])


def _half(values: Field) -> Field:
    rows, cols = (max(1, count // 2) for count in values.shape)
    return np.asarray(cv2.resize(values, (cols, rows), interpolation=cv2.INTER_AREA), dtype=np.float32)


def _score(shape: tuple[int, int], index: int) -> NDArray[np.float32]:
    """Return how early a mask covers each cell, shape (rows, cols); lengths are in halves of the view's side."""
    rng = np.random.default_rng((20251, index))
    at = centres(shape, 2 / max(shape))
    kind = index % _KINDS
    along, across = at.along_and_across(float(rng.uniform(0, 360)))
    if kind == 0:
        spots = rng.uniform(-0.8, 0.8, size=(int(rng.integers(1, 5)), 2))
        score = np.max([-np.hypot(at.right_m - x, at.up_m - y) for x, y in spots], axis=0)
    elif kind == 1:
        offsets = rng.uniform(-0.7, 0.7, size=int(rng.integers(1, 4)))
        score = np.max([-np.abs(across - offset) for offset in offsets], axis=0)
    elif kind == 2:  # the third kind
        score = smooth_noise(shape, max(shape) / float(rng.uniform(3, 6)), rng).astype(np.float64)
    else:
        score = along + rng.uniform(0, 0.8) * np.abs(across)
    return np.asarray(score, dtype=np.float32)


HIDDEN: Final = tuple(name for name in load_taxonomy().lines if name in load_taxonomy().having("drawn"))
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


_OVERHANG_M: Final = 4.0  # of crowns over the edge of green


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


_RADIUS_M: Final = 20.0


class Glare(Occlusion):
    """Hide soft blobs; `share` is that of the cells of each class.

    A soft edge in three states: here and there a blob reaches less far for some classes than for others, at random in
    each view.
    """

    def mask(self, evidence: Evidence, rng: np.random.Generator) -> Mask:
        """Return the blobs, shape (C, rows, cols)."""
        streams, radius_cells = Streams(rng), _RADIUS_M / evidence.cell_size_m
        strength = smooth_noise(evidence.shape, 2 * radius_cells, streams.view)
        if "water" in evidence.classes:
            water = (evidence.layer("water") == PRESENT).astype(np.float32)
            reach = max(1, round(radius_cells / 2))
            # 1.5: added to the strength of glare where all is water; the strength has a deviation of 0.575
            strength += np.float32(1.5) * cv2.blur(water, (reach, reach))
        pool = NoisePool(evidence.shape, streams)
        rims = (pool.take(2 * radius_cells, streams.of(name)) for name in evidence.classes)
        # 0.15: weight of a class's own noise: a tenth of what is hidden for one class is seen for another
        return np.stack([top_share(strength + np.float32(0.15) * rim, self.share) for rim in rims])


class TiltWedge(Occlusion):
    """Hide the far end of the view in a random direction of lean."""

    def mask(self, evidence: Evidence, rng: np.random.Generator) -> Mask:
        """Return the cells that lie farthest in the direction of the lean."""
        return far_side(evidence, self.share, rng.uniform(0, 360))


def far_side(evidence: Evidence, share: float, direction_deg: float) -> Mask:
    """Return the cells that lie farthest in a direction, clockwise from the view's up."""
    along, across = centres(evidence.shape, evidence.cell_size_m).along_and_across(direction_deg)
    # 0.4: weight of the sides against the far end: 0 cuts straight across, 1 cuts a corner of 90 degrees
    return top_share((along + 0.4 * np.abs(across)).astype(np.float32), share)


class Border(Occlusion):
    """Hide a ragged frame around the view."""

    def mask(self, evidence: Evidence, rng: np.random.Generator) -> Mask:
        """Return the cells nearest to the edge."""
        nearness = -depth(evidence.shape)
        # 0.04: variation of the frame's width, in halves of the view's side
        nearness += 0.04 * smooth_noise(evidence.shape, min(evidence.shape) / 12, rng)
        return top_share(nearness, self.share)


def depth(shape: tuple[int, int]) -> Field:
    """Return the distance of each cell from the nearest edge, 0 at the edge to 1 in the middle."""
    at = centres(shape, 2.0)
    rows, cols = 1 - np.abs(at.up_m) / shape[0], 1 - np.abs(at.right_m) / shape[1]
    return np.minimum(rows, cols).astype(np.float32)


class CentralCrop(Occlusion):
    """Hide all but a rectangle in the middle; `share` is reached to within one ring of cells."""

    def mask(self, evidence: Evidence, _rng: np.random.Generator) -> Mask:
        """Return all cells but the middle."""
        return np.asarray(depth(evidence.shape) < 1 - np.sqrt(1 - self.share))


_FALSE_PATCH_M: Final = 12.0


class FalseUnknown(Occlusion):
    """Hide patches of each class separately; `share` is that of the known cells of each class."""

    def mask(self, evidence: Evidence, rng: np.random.Generator) -> Mask:
        """Return the patches of each class, shape (C, rows, cols)."""
        streams = Streams(rng)
        pool, patches = NoisePool(evidence.shape, streams), []
        for name, layer in zip(evidence.classes, evidence.cells, strict=True):
            own, known = streams.of(name), layer != UNKNOWN
            noise = pool.take(_FALSE_PATCH_M / evidence.cell_size_m, own)
            count = np.count_nonzero(known)
            patches.append(known & (noise >= highest_within(noise, known, self.share * count, own)))
        return np.stack(patches)
