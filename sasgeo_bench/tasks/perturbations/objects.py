# SPDX-License-Identifier: Apache-2.0
"""Single things within a layer: connected components, what may be built where, and which classes are thin."""

from dataclasses import dataclass
from functools import cache

import cv2
import numpy as np
from numpy.typing import NDArray

from sasgeo_bench.osm.taxonomy import load_taxonomy

Mask = NDArray[np.bool_]


@dataclass(frozen=True, slots=True, kw_only=True)
class Objects:
    """The connected things of one layer.

    `labels` is int32 of shape (rows, cols), 0 where there is none; `areas_cells` has one entry per thing, that of
    label 1 first.
    """

    labels: NDArray[np.int32]
    areas_cells: NDArray[np.int64]

    def mask_of(self, chosen: Mask) -> Mask:
        """Cells of the things chosen, one boolean each."""
        return np.concatenate((np.zeros(1, dtype=bool), chosen)).take(self.labels)


def find_objects(mask: Mask) -> Objects:
    """Part a layer into things that touch nowhere, not even at a corner.

    Examples
    --------
    >>> find_objects(np.array([[True, False, True], [True, False, False]])).areas_cells.tolist()
    [2, 1]
    """
    count, labels = cv2.connectedComponents(mask.view(np.uint8), connectivity=8, ltype=cv2.CV_32S)
    areas = np.bincount(labels[mask], minlength=count)
    return Objects(labels=np.asarray(labels, dtype=np.int32), areas_cells=areas[1:])


@cache
def thin_classes() -> frozenset[str]:
    """Classes that are lines: their errors are gaps and shifts, and a cell of tolerance is due to them.

    Examples
    --------
    >>> "path_track" in thin_classes(), "water" in thin_classes()
    (True, False)
    """
    return frozenset(item.name for item in load_taxonomy().classes if item.kind == "line")


def pick_up_to(areas_cells: NDArray[np.int64], budget_cells: float, rng: np.random.Generator) -> Mask:
    """Choose things at random until their area is spent; the last one by lot, so that the mean is the budget.

    Examples
    --------
    >>> pick_up_to(np.array([10, 10, 10]), 20.0, np.random.default_rng(0)).sum()
    np.int64(2)
    """
    order = rng.permutation(len(areas_cells))
    spent = np.cumsum(areas_cells[order])
    chosen = np.zeros(len(order), dtype=bool)
    whole = int(np.searchsorted(spent, budget_cells, side="right"))
    chosen[order[:whole]] = True
    if whole < len(order):
        left = budget_cells - (spent[whole - 1] if whole else 0.0)
        chosen[order[whole]] = rng.random() < left / areas_cells[order[whole]]
    return chosen
