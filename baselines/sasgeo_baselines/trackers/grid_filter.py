# SPDX-License-Identifier: Apache-2.0
"""Base of filters that keep a belief on a grid: predict, weigh, sum up; and a view's scores on the belief's window."""

import math
from abc import ABC, abstractmethod
from typing import ClassVar, Final

import numpy as np
from numpy.typing import NDArray

import sasgeo_bench as sgb
from sasgeo_baselines.trackers.belief import Belief, Box, Floats, overlap, sizes_of
from sasgeo_baselines.trackers.motion import followed
from sasgeo_baselines.trackers.summary import fix_of

LEAST: Final = 0.9  # mass within 25 m of an estimate that is accepted
SCORED_M: Final = 16.0  # largest cell that a view is scored on
_AT_ONCE: Final = 16_000_000  # scores computed at a time: bounds memory where the belief is wide
_QUARTERS: Final = 4


class GridFilter(ABC):
    """Follows a flight by a belief over place and heading; a method says how likely a view is where."""

    card: ClassVar[sgb.MatcherCard]
    diffuses: ClassVar[bool] = True  # by the covariance of the increments
    doubt: ClassVar[float]  # share of views that say nothing

    def __init__(self) -> None:
        self._grid: sgb.Grid | None = None
        self._belief: Belief | None = None

    @abstractmethod
    def read(self, region: sgb.Region, learned: str | None) -> sgb.Grid:
        """Index a map, and return the cells on which a belief may lie."""

    @abstractmethod
    def logs(self, query: sgb.Query, belief: Belief) -> Floats:
        """Return the log-likelihood of a view, up to a constant, at `belief.asked` and each cell: (A, rows, cols)."""

    @property
    def belief(self) -> Belief:
        """Return the belief after the last view."""
        if self._belief is None:
            message = f"{self.card.name}: call prepare() with a region, then start(), before step()"
            raise RuntimeError(message)
        return self._belief

    def prepare(self, region: sgb.Region, learned: str | None) -> None:
        """Index a map."""
        self._grid = self.read(region, learned)

    def start(self, prior: sgb.Prior) -> None:
        """Begin with an even belief over the prior."""
        if self._grid is None:
            message = f"{self.card.name}: call prepare() with a region before start()"
            raise RuntimeError(message)
        self._belief = Belief.of(prior, self._grid)

    def step(self, query: sgb.Query) -> sgb.Fix:
        """Move the belief by the odometer, multiply it by the view, and sum it up."""
        if query.step is None:
            message = f"{self.card.name}: step() needs the views of a flight"
            raise RuntimeError(message)
        belief = followed(self.belief, query.step, diffuses=self.diffuses)
        if not sgb.is_blind(query):
            belief = belief.weighed(self.logs(query, belief), doubt=self.doubt)
        self._belief = belief.fitted()
        return fix_of(self._belief, least=LEAST)


def prepared(field: sgb.Field) -> sgb.Field:
    """Return a map with the larger cells that beliefs on it may have, made now instead of during a flight."""
    for factor in sizes_of(field.grid)[1:]:
        field.level(factor)
    return field


def surface_logs(field: sgb.Field, template: sgb.Template, belief: Belief, *, temper: float) -> Floats:
    """Return tempered scores of a view at the headings in `belief.asked` and each cell, shape (A, rows, cols).

    The map is scored in cells of the belief, on which thin classes are spread, but for cells larger than `SCORED_M`:
    too few of these are in a view, so they are as likely as the mean of their quarters. On cells smaller than those of
    the belief a score is sharper than steps of heading are. Beyond the map a view scores 0: it says nothing there.
    """
    parts = 2 if belief.grid.cell_size_m > SCORED_M and belief.factor > 1 else 1
    found = np.empty((len(belief.asked), *belief.shape), dtype=np.float32)
    step = max(1, _AT_ONCE // (belief.mass[0].size * parts**2))
    # Headings at right angles share their work, so they are asked for together.
    order = np.argsort(belief.asked % (len(belief.mass) // _QUARTERS), kind="stable")
    for first in range(0, len(order), step):
        chosen = order[first : first + step]
        scores = _scores(field, template, belief, belief.yaws_deg[belief.asked[chosen]], factor=belief.factor // parts)
        found[chosen] = pooled_logs(np.float32(temper) * scores, parts)
    return found


def pooled_logs(logs: Floats, parts: int) -> Floats:
    """Return the logarithm of the mean likelihood of squares of `parts` cells a side, from shape (A, rows, cols).

    >>> pooled_logs(np.log(np.array([[[1.0, 2.0], [3.0, 6.0]]])), 2).round(3) == np.log(3.0).round(3)
    array([[[ True]]])
    """
    if parts == 1:
        return logs
    count, rows, cols = logs.shape
    squares = logs.reshape(count, rows // parts, parts, cols // parts, parts)
    top = squares.max(axis=(2, 4), keepdims=True)
    return np.asarray(np.log(np.exp(squares - top).mean(axis=(2, 4))) + top[:, :, 0, :, 0])


def _scores(
    field: sgb.Field, template: sgb.Template, belief: Belief, yaws_deg: NDArray[np.float64], *, factor: int
) -> Floats:
    """Return scores on the window of a belief in cells of `factor` map cells a side, 0 beyond the map."""
    top, left, bottom, right = belief.box
    found = np.zeros((len(yaws_deg), (bottom - top) // factor, (right - left) // factor), dtype=np.float32)
    if bottom <= 0 or right <= 0 or top >= field.grid.rows or left >= field.grid.cols:
        return found
    if factor == 1:  # the map's own cells are cut out: a level of all of them would double the memory
        field = _cut(field, belief.box, math.ceil(template.reach_m / field.grid.cell_size_m) + 1)
    west_m, south_m, east_m, north_m = belief.grid.bounds_m
    scored = sgb.surface(
        field,
        template,
        center_m=((west_m + east_m) / 2, (south_m + north_m) / 2),
        radius_m=max(east_m - west_m, north_m - south_m) / 2,
        yaws_deg=yaws_deg,
        factor=factor,
    )
    cell_m = scored.grid.cell_size_m
    down, across = round((north_m - scored.grid.north_m) / cell_m), round((scored.grid.west_m - west_m) / cell_m)
    into, part = overlap((found.shape[1], found.shape[2]), scored.grid.shape, down, across)
    found[(slice(None), *into)] = scored.scores[(slice(None), *part)]
    return found


def _cut(field: sgb.Field, box: Box, reach: int) -> sgb.Field:
    """Return the part of a map that views in a box may show."""
    top, left = max(0, box[0] - reach), max(0, box[1] - reach)
    bottom, right = min(field.grid.rows, box[2] + reach), min(field.grid.cols, box[3] + reach)
    return sgb.Field(
        grid=field.grid.window(top, left, bottom - top, right - left),
        layers=field.layers[:, top:bottom, left:right],
        known=field.known[top:bottom, left:right],
    )
