# SPDX-License-Identifier: Apache-2.0
"""Centre lines of roads, railways and waterways from masks, so that a mask has a graph as vectors have."""

from typing import Final

import cv2
import geopandas as gpd
import numpy as np
import shapely
from numpy.typing import NDArray
from skimage.morphology import skeletonize

from sasgeo_bench.regions.evidence import PRESENT, Evidence, cell_offsets_m
from sasgeo_bench.sasgeo.kinds import ROADS
from sasgeo_bench.tasks.vectors import vector_table

# Classes thinned together, and the class of their lines: crossings do not depend on the class of a road.
LAYERS: Final = {"road_minor": ROADS, "railway": ("railway",), "waterway": ("waterway",)}
SPUR_M: Final = 8.0  # shorter branches are corners of a broad line
_ROUGH_CELLS: Final = 0.75  # tolerance of the simplification of stairs
_FORK: Final = 3


def lines_of_mask(evidence: Evidence) -> gpd.GeoDataFrame:
    """Return the centre lines of `LAYERS` in a view as `Query.vectors`: (right, up) from its middle, metres.

    Examples
    --------
    >>> cells = np.zeros((1, 64, 64), dtype=np.uint8)
    >>> cells[0, 30:34] = cells[0, :30, 20:24] = 1
    >>> view = Evidence(classes=("road_minor",), cells=cells, cell_size_m=1.0)
    >>> len(lines_of_mask(view))  # a fork and its three arms
    3
    """
    rows = []
    for name, classes in LAYERS.items():
        layers = [evidence.layer(one) == PRESENT for one in classes if one in evidence.classes]
        if layers and np.any(layers):
            rows += [(name, 0, False, line) for line in middle_lines(np.any(layers, axis=0), evidence.cell_size_m)]
    return vector_table(rows)


def middle_lines(present: NDArray[np.bool_], cell_size_m: float) -> NDArray[np.object_]:
    """Return the centre lines of a mask in (right, up) from its middle, metres; they end at forks.

    Examples
    --------
    >>> row = np.zeros((9, 40), dtype=bool)
    >>> row[3:6] = True
    >>> len(middle_lines(row, 1.0))
    1
    """
    closed = cv2.morphologyEx(present.astype(np.uint8), cv2.MORPH_CLOSE, np.ones((3, 3), dtype=np.uint8))
    thin = np.asarray(skeletonize(closed > 0), dtype=np.bool_)
    places_m = cell_offsets_m((present.shape[0], present.shape[1]), cell_size_m)
    ends = _links(thin)
    if not len(ends):
        return np.empty(0, dtype=object)
    lines = _merged(shapely.linestrings(places_m[ends]))
    lines = _merged(lines[~_is_spur(lines)])
    return np.asarray(shapely.simplify(lines, _ROUGH_CELLS * cell_size_m), dtype=object)


def _links(thin: NDArray[np.bool_]) -> NDArray[np.int64]:
    """Return pairs of neighbouring cells by number, row by row, shape (E, 2).

    Diagonal neighbours are linked only where no common neighbour is set: else each fork would be a triangle.
    """
    number = np.arange(thin.size).reshape(thin.shape)
    falls = thin[:-1, :-1] & thin[1:, 1:] & ~thin[:-1, 1:] & ~thin[1:, :-1]
    rises = thin[:-1, 1:] & thin[1:, :-1] & ~thin[:-1, :-1] & ~thin[1:, 1:]
    across, down = thin[:, :-1] & thin[:, 1:], thin[:-1] & thin[1:]
    parts = (
        (number[:, :-1][across], number[:, 1:][across]),
        (number[:-1][down], number[1:][down]),
        (number[:-1, :-1][falls], number[1:, 1:][falls]),
        (number[:-1, 1:][rises], number[1:, :-1][rises]),
    )
    return np.concatenate([np.column_stack(part) for part in parts])


def _merged(lines: NDArray[np.object_]) -> NDArray[np.object_]:
    """Merge lines where exactly two ends meet."""
    if not len(lines):
        return lines
    return np.asarray(shapely.get_parts(shapely.line_merge(shapely.multilinestrings(lines))), dtype=object)


def _is_spur(lines: NDArray[np.object_]) -> NDArray[np.bool_]:
    """Return which lines are short, with one free end and one at a fork."""
    tips_m = np.stack([shapely.get_coordinates(shapely.get_point(lines, at)) for at in (0, -1)], axis=1)
    _, tip = np.unique(tips_m.reshape(-1, 2), axis=0, return_inverse=True)
    tip = tip.reshape(-1, 2)
    ends = np.sort(np.bincount(tip.ravel())[tip], axis=1)
    return np.asarray((shapely.length(lines) < SPUR_M) & (ends[:, 0] == 1) & (ends[:, 1] >= _FORK))
