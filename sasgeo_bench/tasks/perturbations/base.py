# SPDX-License-Identifier: Apache-2.0
"""What every perturbation is and keeps to, and how much one did."""

import dataclasses
from collections.abc import Iterable, Mapping
from typing import Any, ClassVar, Protocol, TypeVar

import numpy as np
from numpy.typing import NDArray

from sasgeo_bench.errors import PerturbError
from sasgeo_bench.regions.evidence import UNKNOWN, Evidence

Cells = NDArray[np.uint8]
Mask = NDArray[np.bool_]


class Perturbation(Protocol):
    """A frozen dataclass that makes a view harder; all that is random comes from the generator it is given.

    `NEUTRAL` holds the parameters that make it do nothing: with them it returns the same cells. `MOVES` says whether
    cells change their place; where they do not, what was unknown stays unknown. A stored confidence stays with its
    cell.
    """

    NEUTRAL: ClassVar[Mapping[str, float]]
    MOVES: ClassVar[bool]

    def __call__(self, evidence: Evidence, rng: np.random.Generator, /) -> Evidence:
        """Return a harder view; the given one stays as it was."""
        ...


AnyPerturbation = TypeVar("AnyPerturbation", bound=Perturbation)


def apply(perturbations: Iterable[Perturbation], evidence: Evidence, rng: np.random.Generator) -> Evidence:
    """Perturb a view by each in turn.

    Each draws from a generator of its own, so that the strength of one changes nothing in what the next one draws.

    Examples
    --------
    >>> view = Evidence(classes=("road_minor",), cells=np.ones((1, 4, 4), dtype=np.uint8), cell_size_m=1.0)
    >>> apply([], view, np.random.default_rng(0)) is view
    True
    """
    perturbations = tuple(perturbations)
    for perturb, own_rng in zip(perturbations, rng.spawn(len(perturbations)), strict=True):
        evidence = perturb(evidence, own_rng)
    return evidence


def neutral(perturbation: AnyPerturbation) -> AnyPerturbation:
    """Return the same perturbation at strength 0: the control of a matched pair."""
    return dataclasses.replace(perturbation, **perturbation.NEUTRAL)  # type: ignore[type-var]


def check_perturbation(perturbation: Perturbation, evidence: Evidence, *, seed: int = 0) -> None:
    """Hold a perturbation, also one of a user's own, to what all of them promise, on one view.

    Raises
    ------
    PerturbError
        If strength 0 changes a cell, equal seeds differ, shape or classes change, something unknown becomes known
        without having moved, or the input was written to.
    """
    name, kept = type(perturbation).__name__, evidence.cells.copy()
    first, second = (perturbation(evidence, np.random.default_rng(seed)) for _ in range(2))
    unknown = kept == UNKNOWN
    same_frame = first.classes == evidence.classes and first.cells.shape == kept.shape
    promises = {
        "leaves its input as it was": np.array_equal(evidence.cells, kept),
        "keeps classes, shape and cell size": same_frame and first.cell_size_m == evidence.cell_size_m,
        "gives the same for the same seed": np.array_equal(first.cells, second.cells),
        "keeps unknown what is unknown": perturbation.MOVES or (same_frame and (first.cells[unknown] == UNKNOWN).all()),
        "changes nothing at strength 0": np.array_equal(
            neutral(perturbation)(evidence, np.random.default_rng(seed)).cells, kept
        ),
    }
    broken = [promise for promise, holds in promises.items() if not holds]
    if broken:
        message = f"{name} breaks what every perturbation promises: that it {'; that it '.join(broken)}"
        raise PerturbError(message)


def check_ranges(owner: object, **ranges: tuple[float, float]) -> None:
    """Refuse, in one line, a parameter that is no number or lies outside its range (ends included).

    Raises
    ------
    PerturbError
        Naming the perturbation, the parameter, the range and what was given.
    """
    for name, (low, high) in ranges.items():
        value: Any = getattr(owner, name)
        is_number = isinstance(value, int | float | np.number) and not isinstance(value, bool)
        if not is_number or not low <= value <= high:
            message = f"{type(owner).__name__}: {name} lies between {low:g} and {high:g}, got {value!r}"
            raise PerturbError(message)


def share_changed(before: Evidence, after: Evidence) -> float:
    """Share of the cells, over all classes, that differ.

    Examples
    --------
    >>> view = Evidence(classes=("water",), cells=np.zeros((1, 2, 2), dtype=np.uint8), cell_size_m=1.0)
    >>> share_changed(view, view.replace(np.array([[[0, 0], [0, 1]]], dtype=np.uint8)))
    0.25
    """
    return float((before.cells != after.cells).mean())


def share_hidden(before: Evidence, after: Evidence) -> float:
    """Share of what was known, over all classes, that became unknown; 0 where nothing was known.

    Examples
    --------
    >>> view = Evidence(classes=("water",), cells=np.array([[[0, 1], [2, 2]]], dtype=np.uint8), cell_size_m=1.0)
    >>> share_hidden(view, view.replace(np.array([[[0, 2], [2, 2]]], dtype=np.uint8)))
    0.5
    """
    known = before.cells != UNKNOWN
    return float((after.cells[known] == UNKNOWN).mean()) if known.any() else 0.0


def with_cells(evidence: Evidence, cells: Cells) -> Evidence:
    """The view with other cells and the confidence it had; what was unknown is so again.

    UNKNOWN is the largest state, so one maximum does it.
    """
    return evidence.replace(np.maximum(cells, evidence.cells & UNKNOWN), evidence.confidence)


def hide(evidence: Evidence, mask: Mask, class_names: Iterable[str] | None = None) -> Evidence:
    """Make the cells of a mask, shape (rows, cols) or (C, rows, cols), unknown, for all classes or those named.

    Examples
    --------
    >>> view = Evidence(classes=("water",), cells=np.array([[[0, 1]]], dtype=np.uint8), cell_size_m=1.0)
    >>> hide(view, np.array([[False, True]])).cells.tolist()
    [[[0, 2]]]
    """
    veil = mask.view(np.uint8) * np.uint8(UNKNOWN)
    if class_names is None:
        return evidence.replace(np.maximum(evidence.cells, veil), evidence.confidence)
    cells = evidence.cells.copy()
    for index in (evidence.classes.index(name) for name in class_names if name in evidence.classes):
        np.maximum(cells[index], veil, out=cells[index])
    return evidence.replace(cells, evidence.confidence)
