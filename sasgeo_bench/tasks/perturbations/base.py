# SPDX-License-Identifier: Apache-2.0
"""The interface of perturbations, and code that they share."""

from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sasgeo_bench.errors import PerturbError
from sasgeo_bench.regions.evidence import UNKNOWN, Evidence

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
    return float((before.cells != after.cells).mean())


def share_hidden(before: Evidence, after: Evidence) -> float:
    """Return the fraction of known cells, over all classes, that became unknown; 0 if none was known."""
    known = before.cells != UNKNOWN
    return float((after.cells[known] == UNKNOWN).mean()) if known.any() else 0.0


def with_cells(evidence: Evidence, cells: NDArray[np.uint8]) -> Evidence:
    """Return the view with other cells and its own confidence; unknown cells stay unknown."""
    return evidence.replace(np.maximum(cells, evidence.cells & UNKNOWN), evidence.confidence)  # UNKNOWN is the largest


def hide(evidence: Evidence, mask: Mask) -> Evidence:
    """Make the cells of a mask unknown; its shape is (rows, cols) for all classes or (C, rows, cols)."""
    return evidence.replace(np.maximum(evidence.cells, mask.view(np.uint8) * np.uint8(UNKNOWN)), evidence.confidence)


@dataclass(frozen=True, kw_only=True)
class Occlusion(ABC):
    """Base of the perturbations that make a fraction `share` of the view unknown."""

    share: float

    def __post_init__(self) -> None:
        check_ranges(self, share=(0, 1))

    def __call__(self, evidence: Evidence, rng: np.random.Generator, /) -> Evidence:
        """Hide the cells of `mask`."""
        return evidence if self.share == 0 else hide(evidence, self.mask(evidence, rng))

    @abstractmethod
    def mask(self, evidence: Evidence, rng: np.random.Generator) -> Mask:
        """Return the cells to hide, as `hide` takes them."""
