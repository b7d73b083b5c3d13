# SPDX-License-Identifier: Apache-2.0
"""The interface of perturbations, the checks that each must pass, and code that they share."""

import dataclasses
from abc import ABC, abstractmethod
from collections.abc import Mapping
from typing import Any, ClassVar, Protocol, TypeVar

import numpy as np
from numpy.typing import NDArray

from sasgeo_bench.errors import PerturbError
from sasgeo_bench.regions.evidence import UNKNOWN, Evidence

Cells = NDArray[np.uint8]
Mask = NDArray[np.bool_]


class Perturbation(Protocol):
    """A frozen dataclass that makes a view harder; all randomness comes from the generator it is given.

    `NEUTRAL` holds the parameters with which it changes no cell. `MOVES` tells whether cells change their place; where
    they do not, unknown cells stay unknown. The confidence of a cell moves with it.
    """

    NEUTRAL: ClassVar[Mapping[str, float]]
    MOVES: ClassVar[bool]

    def __call__(self, evidence: Evidence, rng: np.random.Generator, /) -> Evidence:
        """Return a harder view without changing the given one."""
        ...


AnyPerturbation = TypeVar("AnyPerturbation", bound=Perturbation)


def neutral(perturbation: AnyPerturbation) -> AnyPerturbation:
    """Return the same perturbation at strength 0: the control of a matched pair."""
    return dataclasses.replace(perturbation, **perturbation.NEUTRAL)  # type: ignore[type-var]


def check_perturbation(perturbation: Perturbation, evidence: Evidence, *, seed: int = 0) -> None:
    """Check on one view that a perturbation keeps the contract of all perturbations.

    Raises
    ------
    PerturbError
        If strength 0 changes a cell, equal seeds differ, shape or classes change, an unknown cell becomes known
        without moving, or the input was modified.
    """
    name, kept = type(perturbation).__name__, evidence.cells.copy()
    first, second = (perturbation(evidence, np.random.default_rng(seed)) for _ in range(2))
    unknown = kept == UNKNOWN
    same_frame = first.classes == evidence.classes and first.cells.shape == kept.shape
    promises = {
        "leaves its input unchanged": np.array_equal(evidence.cells, kept),
        "keeps classes, shape and cell size": same_frame and first.cell_size_m == evidence.cell_size_m,
        "gives the same for the same seed": np.array_equal(first.cells, second.cells),
        "keeps unknown cells unknown": perturbation.MOVES or (same_frame and (first.cells[unknown] == UNKNOWN).all()),
        "changes nothing at strength 0": np.array_equal(
            neutral(perturbation)(evidence, np.random.default_rng(seed)).cells, kept
        ),
    }
    broken = [promise for promise, holds in promises.items() if not holds]
    if broken:
        message = f"{name} breaks the contract of perturbations: that it {'; that it '.join(broken)}"
        raise PerturbError(message)


def check_ranges(owner: object, **ranges: tuple[float, float]) -> None:
    """Raise a PerturbError if a named attribute is not a number within its range, ends included."""
    for name, (low, high) in ranges.items():
        value: Any = getattr(owner, name)
        is_number = isinstance(value, int | float | np.number) and not isinstance(value, bool)
        if not is_number or not low <= value <= high:
            message = f"{type(owner).__name__}: {name} lies between {low:g} and {high:g}, got {value!r}"
            raise PerturbError(message)


def share_changed(before: Evidence, after: Evidence) -> float:
    """Return the fraction of cells, over all classes, that differ."""
    return float((before.cells != after.cells).mean())


def share_hidden(before: Evidence, after: Evidence) -> float:
    """Return the fraction of known cells, over all classes, that became unknown; 0 if none was known."""
    known = before.cells != UNKNOWN
    return float((after.cells[known] == UNKNOWN).mean()) if known.any() else 0.0


def with_cells(evidence: Evidence, cells: Cells) -> Evidence:
    """Return the view with other cells and its own confidence; unknown cells stay unknown."""
    return evidence.replace(np.maximum(cells, evidence.cells & UNKNOWN), evidence.confidence)  # UNKNOWN is the largest


def hide(evidence: Evidence, mask: Mask) -> Evidence:
    """Make the cells of a mask unknown; its shape is (rows, cols) for all classes or (C, rows, cols).

    Examples
    --------
    >>> view = Evidence(classes=("water",), cells=np.array([[[0, 1]]], dtype=np.uint8), cell_size_m=1.0)
    >>> hide(view, np.array([[False, True]])).cells.tolist()
    [[[0, 2]]]
    """
    return evidence.replace(np.maximum(evidence.cells, mask.view(np.uint8) * np.uint8(UNKNOWN)), evidence.confidence)


@dataclasses.dataclass(frozen=True, kw_only=True)
class Occlusion(ABC):
    """Base of the perturbations that make a fraction of the view unknown.

    Parameters
    ----------
    share : float
        Fraction of the cells to hide, 0 to 1.
    """

    NEUTRAL: ClassVar[Mapping[str, float]] = {"share": 0.0}
    MOVES: ClassVar[bool] = False

    share: float

    def __post_init__(self) -> None:
        """Check the range."""
        check_ranges(self, share=(0, 1))

    def __call__(self, evidence: Evidence, rng: np.random.Generator, /) -> Evidence:
        """Hide the cells of `mask`."""
        return evidence if self.share == 0 else hide(evidence, self.mask(evidence, rng))

    @abstractmethod
    def mask(self, evidence: Evidence, rng: np.random.Generator) -> Mask:
        """Return the cells to hide, as `hide` takes them."""
