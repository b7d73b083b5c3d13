# SPDX-License-Identifier: Apache-2.0
"""The interface of perturbations, and code that they share."""

from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from typing import Any, Final, TypeVar

import cv2
import numpy as np
from numpy.typing import NDArray

from sasgeo_bench.core.errors import PerturbError
from sasgeo_bench.core.texts import typed
from sasgeo_bench.geometry.pose import rotation
from sasgeo_bench.regions.evidence import UNKNOWN, Evidence
from sasgeo_bench.tasks.perturbations.streams import Streams

Mask = NDArray[np.bool_]
# A frozen dataclass that makes a view harder. It does not change the given view, at strength 0 it changes no cell, and
# all randomness comes from the generator. Unknown cells stay unknown unless cells change their place; the confidence of
# a cell moves with it.
Perturbation = Callable[[Evidence, np.random.Generator], Evidence]


def check_ranges(owner: object, **ranges: tuple[float, float]) -> None:
    """Raise a PerturbError if a named attribute is not a number within its range, ends included."""
    for name, (low, high) in ranges.items():
        value: Any = getattr(owner, name)
        is_number = isinstance(value, int | float | np.number) and not isinstance(value, bool)
        if not is_number or not low <= value <= high:
            raise PerturbError(f"{type(owner).__name__}: {name} lies between {low:g} and {high:g}, got {value!r}")


def share_changed(before: Evidence, after: Evidence) -> float:
    """Return the fraction of cells, over all classes, that differ."""
    return np.count_nonzero(before.cells != after.cells) / before.cells.size  # which is faster than their mean


def share_hidden(before: Evidence, after: Evidence) -> float:
    """Return the fraction of known cells, over all classes, that became unknown; 0 if none was known."""
    known = before.cells != UNKNOWN
    return float((after.cells[known] == UNKNOWN).mean()) if known.any() else 0.0


def with_cells(evidence: Evidence, cells: NDArray[np.uint8]) -> Evidence:
    """Return the view with other cells and its own confidence; unknown cells stay unknown."""
    return evidence.replace(np.maximum(cells, evidence.cells & UNKNOWN), evidence.confidence)  # UNKNOWN is the largest


def hide(evidence: Evidence, mask: Mask) -> Evidence:
    """Make the cells of a mask unknown; its shape is (rows, cols) for all classes or (C, rows, cols).

    Raise `PerturbError` if it is of another shape, or no array of bool.
    """
    shapes = (evidence.shape, evidence.cells.shape)
    given: object = mask
    if not isinstance(given, np.ndarray) or given.dtype != bool or given.shape not in shapes:
        what = f"{given.dtype} of shape {given.shape}" if isinstance(given, np.ndarray) else typed(given)
        raise PerturbError(
            f"the mask of what to hide is {what}, expected an array of bool of shape {shapes[0]}, or {shapes[1]} for "
            "each class its own"
        )
    return evidence.replace(np.maximum(evidence.cells, mask.view(np.uint8) * np.uint8(UNKNOWN)), evidence.confidence)


@dataclass(frozen=True, kw_only=True)
class Occlusion(ABC):
    """Base of the perturbations that make a fraction `share` of the view unknown."""

    share: float

    def __post_init__(self) -> None:
        check_ranges(self, share=(0, 1))

    def __call__(self, evidence: Evidence, rng: np.random.Generator, /) -> Evidence:
        """Hide the cells of `mask`."""
        if self.share == 0:
            return evidence
        try:
            return hide(evidence, self.mask(evidence, rng))
        except PerturbError as error:
            raise PerturbError(f"{type(self).__name__}: {error}") from error

    @abstractmethod
    def mask(self, evidence: Evidence, rng: np.random.Generator) -> Mask:
        """Return the cells to hide, as `hide` takes them."""


Field = NDArray[np.float32]

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


def _take(
    stack: NDArray[np.uint8], places: NDArray[np.intp], within: NDArray[np.bool_], beyond: int
) -> NDArray[np.uint8]:
    taken = np.take(stack.reshape(len(stack), -1), places.ravel(), axis=1).reshape(stack.shape)
    if not within.all():
        taken[:, ~within] = beyond
    return taken


@dataclass(frozen=True, slots=True, kw_only=True)
class Objects:
    """The connected objects of one layer.

    `labels` is int32 of shape (rows, cols), 0 for the background; `areas_cells` holds the area of label 1 first.
    """

    labels: NDArray[np.int32]
    areas_cells: NDArray[np.int64]

    def mask_of(self, chosen: Mask) -> Mask:
        """Return the cells of the objects that a boolean for each object selects."""
        return np.concatenate((np.zeros(1, dtype=bool), chosen)).take(self.labels)


def find_objects(mask: Mask) -> Objects:
    """Label the objects of a layer; cells that touch at a corner belong together."""
    count, labels = cv2.connectedComponents(mask.view(np.uint8), connectivity=8, ltype=cv2.CV_32S)
    areas = np.bincount(labels[mask], minlength=count)
    return Objects(labels=np.asarray(labels, dtype=np.int32), areas_cells=areas[1:])


def pick_up_to(areas_cells: NDArray[np.int64], budget_cells: float, rng: np.random.Generator) -> Mask:
    """Choose objects at random until their area is used up; the last one by lot, so that the mean is the budget."""
    order = rng.permutation(len(areas_cells))
    spent = np.cumsum(areas_cells[order])
    chosen = np.zeros(len(order), dtype=bool)
    whole = int(np.searchsorted(spent, budget_cells, side="right"))
    chosen[order[:whole]] = True
    if whole < len(order):
        left = budget_cells - (spent[whole - 1] if whole else 0.0)
        chosen[order[whole]] = rng.random() < left / areas_cells[order[whole]]
    return chosen
