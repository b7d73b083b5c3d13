# SPDX-License-Identifier: Apache-2.0
"""Pairs of shapes that overlap, in bounded memory."""

from typing import Final, Literal

import numpy as np
import shapely
from numpy.typing import NDArray

from sasgeo_bench.core.errors import ShapeError

Ints = NDArray[np.int64]
Shapes = NDArray[np.object_]
Predicate = Literal["intersects", "crosses"]
MOST_PAIRS: Final = 5_000_000  # of shapes that overlap, or
PAIRS_EACH: Final = 50  # times as many as there are shapes
_AT_ONCE: Final = 10_000_000  # pairs that one step may find


def overlapping(these: Shapes, others: Shapes, *, predicate: Predicate | None = None) -> Ints:
    """Return rows of shapes, of which bounding boxes meet or a predicate holds, shape (2, K), in the order of `these`.

    Shapes of a place overlap few others. Where each overlaps each, as one that is drawn thousands of times does, the
    pairs would fill the memory: raise `ShapeError` if there are more than `MOST_PAIRS` and `PAIRS_EACH` for each shape.

    >>> overlapping(shapely.box([0, 20], 0, [9, 29], 9), shapely.box([5, 50], 0, [6, 51], 9)).tolist()
    [[0], [0]]
    """
    tree, count = shapely.STRtree(others), max(len(these), len(others))
    step, most, found, total = max(1, _AT_ONCE // max(count, 1)), max(MOST_PAIRS, PAIRS_EACH * count), [], 0
    for start in range(0, max(len(these), 1), step):
        pairs = tree.query(these[start : start + step], predicate=predicate) + np.array([[start], [0]])
        total += pairs.shape[1]
        found.append(pairs)
        if total > most:
            raise ShapeError(
                f"more than {most} pairs of {len(these)} and {len(others)} shapes overlap: is one thing drawn many "
                "times over? Take it out of the map"
            )
    return np.concatenate(found, axis=1)
