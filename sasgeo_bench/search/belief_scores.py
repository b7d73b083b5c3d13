# SPDX-License-Identifier: Apache-2.0
"""Scores of a view on the window of a belief."""

import math
from typing import Final

import numpy as np
from numpy.typing import NDArray

from sasgeo_bench.search.belief import Belief, Floats, overlap
from sasgeo_bench.search.field import FULL, Field, Template
from sasgeo_bench.search.surface import surface

_AT_ONCE: Final = 16_000_000  # scores computed at a time: bounds memory where the belief is wide
_QUARTERS: Final = 4


def surface_logs(field: Field, template: Template, belief: Belief, *, temper: float, scale: float = 1.0) -> Floats:
    """Return tempered scores of a view at the headings in `belief.asked` and each cell, shape (A, rows, cols).

    The map is scored in cells of the belief, on which thin classes are spread: finer cells find the best place in a
    cell, but a heading is then half a step off it. Beyond the map a view scores 0, as where it says nothing.
    """
    found = np.empty((len(belief.asked), *belief.shape), dtype=np.float32)
    step = max(1, _AT_ONCE // belief.mass[0].size)
    # Headings at right angles share their work, so they are asked for together.
    order = np.argsort(belief.asked % (len(belief.mass) // _QUARTERS), kind="stable")
    for first in range(0, len(order), step):
        chosen = order[first : first + step]
        found[chosen] = np.float32(temper) * _scores(
            field, template, belief, belief.yaws_deg[belief.asked[chosen]], scale
        )
    return found


def _scores(field: Field, template: Template, belief: Belief, yaws_deg: NDArray[np.float64], scale: float) -> Floats:
    """Return scores on the window of a belief, shape (len(yaws_deg), rows, cols), 0 beyond the map."""
    found = np.zeros((len(yaws_deg), *belief.shape), dtype=np.float32)
    top, left, bottom, right = belief.box
    if bottom <= 0 or right <= 0 or top >= field.grid.rows or left >= field.grid.cols:
        return found
    if belief.factor == 1:  # the map's own cells are cut out: a level of all of them would double the memory
        field = field.cut(belief.box, math.ceil(template.reach_m / field.grid.cell_size_m) + 1)
    west_m, south_m, east_m, north_m = belief.grid.bounds_m
    scored = surface(
        field,
        template,
        center_m=((west_m + east_m) / 2, (south_m + north_m) / 2),
        radius_m=max(east_m - west_m, north_m - south_m) / 2,
        yaws_deg=yaws_deg,
        factor=belief.factor,
        scale=scale,
    )
    cell_m = scored.grid.cell_size_m
    down, across = round((north_m - scored.grid.north_m) / cell_m), round((scored.grid.west_m - west_m) / cell_m)
    into, part = overlap(belief.shape, scored.grid.shape, down, across)
    found[(slice(None), *into)] = scored.scores[(slice(None), *part)]
    return found


def known_on(field: Field, belief: Belief) -> Floats:
    """Return the share of each cell of a belief's window that the map knows, shape (rows, cols); 0 beyond the map."""
    found = np.zeros(belief.shape, dtype=np.float32)
    rows, cols = belief.shape
    top, left = max(0, belief.row), max(0, belief.col)
    under = field.known[top : belief.row + rows * belief.factor, left : belief.col + cols * belief.factor]
    step = belief.factor
    some = under[: under.shape[0] // step * step, : under.shape[1] // step * step]
    shares = some.reshape(some.shape[0] // step, step, -1, step).mean(axis=(1, 3), dtype=np.float32) / np.float32(FULL)
    down, right = (top - belief.row) // step, (left - belief.col) // step
    found[down : down + shares.shape[0], right : right + shares.shape[1]] = shares
    return found
