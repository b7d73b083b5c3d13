# SPDX-License-Identifier: Apache-2.0
"""Shape and proximity of many geometries at once: bends of lines, orientation, groups and neighbours."""

from dataclasses import dataclass
from typing import Final

import numpy as np
import shapely
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import Delaunay

from sasgeo_bench.geometry.pairs import overlapping as overlapping  # noqa: PLC0414 - for `network`

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
Shapes = NDArray[np.object_]

PLANE: Final = 2
RING_CORNERS: Final = 5  # of a closed rectangle
TRIANGLE: Final = 3


@dataclass(frozen=True, slots=True, kw_only=True)
class Bends:
    """Bends of lines."""

    en_m: Floats  # shape (N, 2): place on the line, metres
    line: Ints  # shape (N,): number of the line
    at_m: Floats  # shape (N,): distance along it, metres
    inward: Floats  # shape (N, 2): direction of the bisector of the two arms, towards the inside; any length


def find_bends(
    en_m: Floats, at_m: Floats, first: Ints, *, step_m: float, smoothing_m: float, window_m: float, turn_deg: float
) -> Bends:
    """Find where lines turn most, at most once within half a window; lines shorter than the window have no bend.

    `en_m` and `at_m`, shapes (P, 2) and (P,), are the vertices of all lines, one line after the other, and the distance
    of each along its line; `first`, shape (L + 1,), is the row where each line begins, and P. `step_m` is the spacing
    of the samples, `smoothing_m` the length of the moving average, `window_m` the length within which a bend turns by
    `turn_deg`.

    >>> corner = np.array([[0.0, 0.0], [200.0, 0.0], [200.0, 200.0]])
    >>> rules = {"step_m": 10.0, "smoothing_m": 60.0, "window_m": 120.0, "turn_deg": 45.0}
    >>> find_bends(corner, np.array([0.0, 200.0, 400.0]), np.array([0, 3]), **rules).en_m.tolist()
    [[200.0, 0.0]]
    """
    length_m = at_m[first[1:] - 1]
    chosen = np.flatnonzero(length_m >= window_m)
    if not len(chosen):
        none = np.empty((0, PLANE))
        return Bends(en_m=none, line=chosen, at_m=none[:, 0], inward=none)
    # Equal steps, so that a line read backwards has the same samples.
    steps = np.maximum(np.rint(length_m[chosen] / step_m).astype(np.int64), 1)
    line = np.repeat(chosen, steps + 1)
    start = np.repeat(np.cumsum(steps + 1) - steps - 1, steps + 1)
    last = start + np.repeat(steps, steps + 1)
    row = np.arange(len(line))
    sample_m = (row - start) * np.repeat(length_m[chosen] / steps, steps + 1)
    # One axis for all lines: each begins a metre after the end of the one before.
    shift_m = np.cumsum(length_m + 1.0) - length_m
    axis_m = at_m + np.repeat(shift_m, np.diff(first))
    place = np.column_stack([np.interp(sample_m + shift_m[line], axis_m, part) for part in en_m.T]).reshape(-1, PLANE)

    reach = round(smoothing_m / step_m / 2)
    near = np.clip(row[:, None] + np.arange(-reach, reach + 1), start[:, None], last[:, None])
    smooth = (place[near] - place[:, None]).mean(axis=1) + place
    ahead = smooth[np.minimum(row + 1, last)] - smooth
    behind = smooth - smooth[np.maximum(row - 1, start)]
    turn = np.arctan2(behind[:, 0] * ahead[:, 1] - behind[:, 1] * ahead[:, 0], (behind * ahead).sum(axis=1))

    reach = round(window_m / step_m / 2)
    offset = np.arange(-reach, reach + 1)
    near = row[:, None] + offset
    is_on_line = (near >= start[:, None]) & (near <= last[:, None])
    near = np.clip(near, start[:, None], last[:, None])
    turns = np.where(is_on_line, turn[near], 0.0)
    # A sharp corner turns the same in every window that holds it; the weights draw the peak to its middle.
    # Rounded, so that the first of two equal samples is the peak in spite of rounding errors.
    score = np.abs(turns @ (1.0 - np.abs(offset) / (reach + 1))).round(6)
    rivals = np.where(is_on_line, score[near], -1.0)
    is_peak = (rivals.argmax(axis=1) == reach) & (np.abs(turns.sum(axis=1)) >= np.radians(turn_deg))
    peak = np.flatnonzero(is_peak)
    arms = smooth[near[peak][:, [0, -1]]] - smooth[peak, None]
    inward = (arms / np.maximum(np.linalg.norm(arms, axis=2, keepdims=True), np.finfo(float).tiny)).sum(axis=1)
    return Bends(en_m=place[peak], line=line[peak], at_m=sample_m[peak], inward=inward)


def centroids(shapes: Shapes) -> Floats:
    """Return the centroid of each shape, shape (N, 2), metres; it need not lie inside."""
    centre = shapely.centroid(shapes)
    return np.column_stack([shapely.get_x(centre), shapely.get_y(centre)])


def long_sides(shapes: Shapes) -> Floats:
    """Return the vector along the long side of each minimum rotated rectangle, shape (N, 2), metres; or NaN."""
    boxes = np.asarray(shapely.oriented_envelope(shapes), dtype=object)
    found = np.flatnonzero(shapely.get_num_coordinates(boxes) == RING_CORNERS)
    sides = np.full((len(boxes), PLANE), np.nan)
    corners = shapely.get_coordinates(boxes[found]).reshape(-1, RING_CORNERS, PLANE)
    side = corners[:, 1:3] - corners[:, 0:2]
    sides[found] = side[np.arange(len(found)), np.linalg.norm(side, axis=2).argmax(axis=1)]
    return sides


def groups_within(shapes: Shapes, gap_m: float) -> Ints:
    """Number the groups of shapes, shape (N,): shapes at most `gap_m` from each other share one.

    >>> groups_within(shapely.box([0, 20, 99], 0, [9, 29, 109], 9), 15.0).tolist()
    [0, 0, 1]
    """
    if not len(shapes):
        return np.empty(0, dtype=np.int64)
    left, right = _near_pairs(shapes, gap_m).T
    is_near = shapely.dwithin(shapes[left], shapes[right], gap_m)
    links = coo_array((is_near, (left, right)), shape=(len(shapes), len(shapes)))
    links.eliminate_zeros()
    return np.asarray(connected_components(links, directed=False)[1], dtype=np.int64)


def touching_pairs(shapes: Shapes) -> Ints:
    """Return rows of shapes that touch or overlap, shape (K, 2), smaller row first.

    >>> touching_pairs(shapely.box([0, 9, 99], 0, [9, 29, 109], 9)).tolist()
    [[0, 1]]
    """
    pairs = _near_pairs(shapes, 0.0)
    shapely.prepare(shapes)
    return np.asarray(pairs[shapely.intersects(shapes[pairs[:, 0]], shapes[pairs[:, 1]])])


def _near_pairs(shapes: Shapes, gap_m: float) -> Ints:
    grown = shapely.box(*(shapely.bounds(shapes) + np.array([-gap_m, -gap_m, gap_m, gap_m])).T)
    pairs = overlapping(grown, shapes).T
    return np.asarray(pairs[pairs[:, 0] < pairs[:, 1]], dtype=np.int64)


def delaunay_pairs(en_m: Floats, longest_m: float) -> Ints:
    """Return Delaunay neighbours no further apart than `longest_m`, shape (K, 2), smaller row first.

    An edge that depends on the choice of the algorithm (a diagonal of four corners on one circle, as among houses on a
    lattice) is left out, so that the pairs turn with the places.

    >>> delaunay_pairs(np.array([[0.0, 0.0], [9.0, 0.0], [9.0, 9.0], [0.0, 9.0]]), 60.0).tolist()
    [[0, 1], [0, 3], [1, 2], [2, 3]]
    """
    count = len(en_m)
    if count < PLANE:
        return np.empty((0, PLANE), dtype=np.int64)
    centred = en_m - en_m.mean(axis=0)
    _, spread, axes = np.linalg.svd(centred, full_matrices=False)
    if count < TRIANGLE or spread[1] <= 1e-9 * spread[0]:
        order = np.argsort(centred @ axes[0], kind="stable")  # all on one line: each next to the next
        pairs = np.sort(np.column_stack([order[:-1], order[1:]]), axis=1)
    else:
        pairs = _strict_pairs(centred)
    length_m = np.linalg.norm(en_m[pairs[:, 0]] - en_m[pairs[:, 1]], axis=1)
    pairs = pairs[length_m <= longest_m]
    return np.asarray(pairs[np.lexsort([pairs[:, 1], pairs[:, 0]])], dtype=np.int64)


def _strict_pairs(en_m: Floats) -> Ints:
    """Return edges of the triangulation whose two opposite angles sum to less than a half turn."""
    corners = Delaunay(en_m).simplices.astype(np.int64)
    tip = corners.ravel()
    base = np.sort(np.stack([np.roll(corners, -1, axis=1), np.roll(corners, -2, axis=1)], axis=2).reshape(-1, PLANE))
    arms = en_m[base] - en_m[tip][:, None]
    twice_area = np.abs(arms[:, 0, 0] * arms[:, 1, 1] - arms[:, 0, 1] * arms[:, 1, 0])
    with np.errstate(over="ignore"):  # the cotangent of a flat corner is infinite
        cotangent = (arms[:, 0] * arms[:, 1]).sum(axis=1) / np.maximum(twice_area, np.finfo(float).tiny)
    _, first, edge, uses = np.unique(
        base[:, 0] * len(en_m) + base[:, 1], return_index=True, return_inverse=True, return_counts=True
    )
    is_hull = uses == 1
    is_strict = np.bincount(edge, weights=cotangent) > 1e-6  # sum of two cotangents that counts as 0, dimensionless
    return np.asarray(base[first][is_hull | is_strict])
