# SPDX-License-Identifier: Apache-2.0
"""Smooth random fields and masks, so that errors are correlated in space; resampling of cells."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from typing import Final, TypeVar

import cv2
import numpy as np
from numpy.typing import NDArray

from sasgeo_bench.geometry.pose import rotation
from sasgeo_bench.regions.evidence import UNKNOWN, Evidence
from sasgeo_bench.tasks.perturbations.streams import Streams

Field = NDArray[np.float32]
Mask = NDArray[np.bool_]

SIGMA: Final = 0.575  # standard deviation of smooth noise: interpolation removes the rest of the variance


def smooth_noise(shape: tuple[int, int], scale_cells: float, rng: np.random.Generator) -> Field:
    """Draw Gaussian noise with features about `scale_cells` wide, shape (rows, cols); mean 0, deviation SIGMA.

    Normal values on a coarse lattice are interpolated linearly twice, since a single step would leave corners. The
    lattice has a random offset, so that it coincides in no two fields.
    """
    scale = max(1.0, float(scale_cells))
    rows, cols = shape
    full = (round(rows + 2 * scale), round(cols + 2 * scale))
    coarse = (max(2, round(full[0] / scale)), max(2, round(full[1] / scale)))
    top, left = rng.integers(0, (full[0] - rows + 1, full[1] - cols + 1))
    nodes = rng.standard_normal(coarse, dtype=np.float32)
    lattice = cv2.resize(nodes, (coarse[1] * 2, coarse[0] * 2), interpolation=cv2.INTER_LINEAR)
    field = cv2.resize(lattice, (full[1], full[0]), interpolation=cv2.INTER_LINEAR)
    return np.ascontiguousarray(field[top : top + rows, left : left + cols], dtype=np.float32)


class NoisePool:
    """Draw smooth fields for many layers of a view as windows of a larger one, which is faster.

    The larger ones come from streams of their own, so that it does not matter which layer asks first.
    """

    def __init__(self, shape: tuple[int, int], streams: Streams) -> None:
        self._shape = shape
        self._streams = streams
        self._fields: dict[float, Field] = {}

    def take(self, scale_cells: float, rng: np.random.Generator) -> Field:
        """Cut a random window of `smooth_noise`, mirrored at random; do not write to it."""
        rows, cols = self._shape
        spare_rows, spare_cols = rows // 3 + 1, cols // 3 + 1
        whole = self._fields.get(scale_cells)
        if whole is None:
            stream = self._streams.of(f"noise {scale_cells:g}")
            whole = smooth_noise((rows + spare_rows, cols + spare_cols), scale_cells, stream)
            self._fields[scale_cells] = whole
        down, right, mirrored = rng.random(3).tolist()
        top, left = int(down * (spare_rows + 1)), int(right * (spare_cols + 1))
        window = whole[top : top + rows, left : left + cols]
        # Flip codes of OpenCV: both axes, vertical, horizontal
        return np.asarray(cv2.flip(window, (-1, 0, 1)[int(mirrored * 3)]), dtype=np.float32).reshape(self._shape)


def top_share(field: Field, share: float) -> Mask:
    """Return the cells with the highest values, exactly a fraction `share` of them if no two are equal."""
    return field >= highest(field.ravel(), share * field.size)


def highest(values: Field, count: float) -> float:
    """Return the threshold that the `count` highest values reach; infinity if `count` rounds to 0."""
    kth = round(count)
    if kth <= 0 or values.size == 0:
        return float("inf")
    if kth >= values.size:
        return float("-inf")
    return float(np.partition(values, values.size - kth)[values.size - kth])


def highest_within(field: Field, mask: Mask, count: float, rng: np.random.Generator) -> float:
    """Return `highest` of a field within a mask; of a sample of rows if the mask is large (to about half a percent)."""
    size = np.count_nonzero(mask)
    step = size // 4096  # values that place a threshold within half a percent
    if step < 2:  # a part must be smaller than the whole
        return highest(field[mask], count)
    first = int(rng.random() * step)
    part = field[first::step][mask[first::step]]
    return highest(part, count * part.size / size)


@dataclass(frozen=True, slots=True, kw_only=True)
class Centres:
    """Centres of a view's cells relative to its middle: `right_m` of shape (1, cols), `up_m` of (rows, 1)."""

    right_m: NDArray[np.float64]
    up_m: NDArray[np.float64]

    def along_and_across(self, direction_deg: float) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return distances along a direction, clockwise from up, and across it, each of shape (rows, cols)."""
        right, up = rotation(direction_deg)[:, 1]
        return self.right_m * right + self.up_m * up, self.right_m * up - self.up_m * right


def centres(shape: tuple[int, int], cell_size_m: float) -> Centres:
    """Return the centres of the cells of a view; the two arrays broadcast to its shape."""
    up, right = (np.linspace(-count / 2, count / 2, 2 * count + 1)[1::2] * cell_size_m for count in shape)
    return Centres(right_m=right[None, :], up_m=-up[:, None])


@lru_cache(maxsize=64)
def disc(radius_cells: float) -> NDArray[np.uint8]:
    """Return the structuring element of a disc."""
    reach = int(radius_cells)
    rows, cols = np.ogrid[-reach : reach + 1, -reach : reach + 1]
    element = np.asarray(rows**2 + cols**2 <= radius_cells**2, dtype=np.uint8)
    element.flags.writeable = False  # it is cached
    return element


def dilated(mask: Mask, radius_cells: float) -> Mask:
    """Grow a mask by a disc."""
    return _morph(cv2.dilate, mask, radius_cells)


def eroded(mask: Mask, radius_cells: float) -> Mask:
    """Shrink a mask by a disc; outside the view it is taken to continue."""
    return _morph(cv2.erode, mask, radius_cells)


def _morph(change: Callable[..., NDArray[np.generic]], mask: Mask, radius_cells: float) -> Mask:
    if radius_cells < 1:
        return mask.copy()
    return np.asarray(change(mask.view(np.uint8), disc(radius_cells))).astype(np.uint8).view(np.bool_)


Value = TypeVar("Value", np.uint8, np.bool_)
Metres = NDArray[np.floating]


def resample(evidence: Evidence, right_m: Metres, up_m: Metres) -> Evidence:
    """Fill each cell from the place (`right_m`, `up_m`) metres from the middle; UNKNOWN if that is outside the view.

    Both places broadcast to shape (rows, cols). Confidence moves with its cell and is 0 outside the view.
    """
    rows, cols = evidence.shape
    col = np.floor(right_m / evidence.cell_size_m + cols / 2).astype(np.intp)
    row = np.floor(rows / 2 - up_m / evidence.cell_size_m).astype(np.intp)
    within = (row >= 0) & (row < rows) & (col >= 0) & (col < cols)
    places = np.where(within, row * cols + col, 0)
    cells = _take(evidence.cells, places, within, UNKNOWN)
    if evidence.confidence is None:
        return evidence.replace(cells)
    return evidence.replace(cells, _take(evidence.confidence, places, within, 0))


def shifted(layer: NDArray[Value], rows: int, cols: int, *, beyond: int) -> NDArray[Value]:
    """Move a layer down and right by whole cells; cells from outside the view get the value `beyond`."""
    height, width = layer.shape
    out = np.full_like(layer, beyond)
    if abs(rows) < height and abs(cols) < width:
        out[max(rows, 0) : height + min(rows, 0), max(cols, 0) : width + min(cols, 0)] = layer[
            max(-rows, 0) : height + min(-rows, 0), max(-cols, 0) : width + min(-cols, 0)
        ]
    return out


def _take(
    stack: NDArray[np.uint8], places: NDArray[np.intp], within: NDArray[np.bool_], beyond: int
) -> NDArray[np.uint8]:
    taken = np.take(stack.reshape(len(stack), -1), places.ravel(), axis=1).reshape(stack.shape)
    if not within.all():
        taken[:, ~within] = beyond
    return taken
