# SPDX-License-Identifier: Apache-2.0
"""Objects of a layer as connected components."""

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

Mask = NDArray[np.bool_]


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
