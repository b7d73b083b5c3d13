# SPDX-License-Identifier: Apache-2.0
"""Belief over place and heading on a window of cells: moved by odometry, spread, weighed by a view, and summed up."""

import math
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Final, Self

import cv2
import numpy as np
from numpy.typing import NDArray

from sasgeo_bench.geometry.grid import Grid
from sasgeo_bench.geometry.pose import Prior, rotation, wrap_deg
from sasgeo_bench.search.dense import surface
from sasgeo_bench.search.field import FULL, Field, Template

Floats = NDArray[np.float32]
Box = tuple[int, int, int, int]  # top, left, bottom, right in cells of the map
Slices = tuple[slice, slice]

FACTORS: Final = (1, 2, 4, 8)  # sides of a cell of the belief, in cells of the map
UNIT: Final = FACTORS[-1]  # windows begin at whole cells of every size
COARSEST_M: Final = 32.0  # largest cell
FINE_YAWS: Final = 72
COARSE_YAWS: Final = 36
MOST: Final = 2_500_000  # values of a belief before its cells become larger
TAIL: Final = 1e-4  # mass that a window may lose at each side
BEYOND_M: Final = 500.0  # a drone may leave the map so far
_CIRCLE_DEG: Final = 360.0


@dataclass(frozen=True, kw_only=True)
class GridBelief:
    """Probability of each heading and cell of a window.

    Parameters
    ----------
    mapped : Grid
        Cells of the map.
    factor : int
        Side of a cell of the belief in cells of the map.
    row, col : int
        Cell of the map at the window's top left; multiples of `UNIT`, and negative beyond the map.
    mass : ndarray of float32, shape (Y, rows, cols)
        Sums to 1. Heading k is 360 k / Y degrees.
    """

    mapped: Grid
    factor: int
    row: int
    col: int
    mass: Floats

    @classmethod
    def of(cls, prior: Prior, mapped: Grid) -> Self:
        """Return an even belief over the disc of a prior, or over the map if it has none; heading as it says."""
        reach_m = math.hypot(*mapped.shape) * mapped.cell_size_m if prior.radius_m is None else prior.radius_m
        middle_m = prior.center_m or _middle_m(mapped)
        row, col = mapped.to_cells(np.array([middle_m]))[0].tolist()
        reach = math.ceil(reach_m / mapped.cell_size_m) + 1
        box = clipped((row - reach, col - reach, row + reach, col + reach), mapped)
        sizes = sizes_of(mapped)
        factor = next((size for size in sizes if values(box, mapped, size) <= MOST), sizes[-1])
        empty = cls.blank(mapped, factor, box)
        inside = np.hypot(*(empty.places_m - middle_m).T).reshape(empty.shape) <= reach_m
        if not inside.any():
            inside[:] = True
        chance = _about(empty.yaws_deg, prior.yaw_deg, prior.yaw_sigma_deg)
        return replace(empty, mass=chance[:, None, None] * (inside / np.float32(inside.sum()))).normalised()

    @classmethod
    def blank(cls, mapped: Grid, factor: int, box: Box) -> Self:
        """Return a belief without mass on a window: top, left, bottom and right in cells of the map."""
        top, left, bottom, right = box
        shape = (yaw_count(mapped, factor), (bottom - top) // factor, (right - left) // factor)
        return cls(mapped=mapped, factor=factor, row=top, col=left, mass=np.zeros(shape, dtype=np.float32))

    @property
    def shape(self) -> tuple[int, int]:
        """Return rows and columns of the window."""
        return (self.mass.shape[1], self.mass.shape[2])

    @property
    def box(self) -> Box:
        """Return top, left, bottom and right of the window in cells of the map."""
        rows, cols = self.shape
        return (self.row, self.col, self.row + rows * self.factor, self.col + cols * self.factor)

    @cached_property
    def grid(self) -> Grid:
        """Return the cells of the window."""
        rows, cols = self.shape
        return self.mapped.window(self.row, self.col, rows * self.factor, cols * self.factor).coarsen(self.factor)

    @property
    def yaws_deg(self) -> NDArray[np.float64]:
        """Return the headings, shape (Y,)."""
        return np.arange(len(self.mass), dtype=np.float64) * self.yaw_step_deg

    @property
    def yaw_step_deg(self) -> float:
        """Return the step between headings."""
        return _CIRCLE_DEG / len(self.mass)

    @cached_property
    def places_m(self) -> NDArray[np.float64]:
        """Return the centres of the cells, row by row, shape (rows * cols, 2)."""
        cells = np.column_stack([index.ravel() for index in np.indices(self.shape)])
        return np.asarray(self.grid.to_centres_m(cells), dtype=np.float64)

    @cached_property
    def asked(self) -> NDArray[np.int64]:
        """Return indices of headings that are not all but excluded."""
        # 1e-7: mass of a heading below which no view is asked about it
        return np.flatnonzero(self.mass.sum(axis=(1, 2)) > 1e-7)

    def normalised(self) -> Self:
        """Return the belief with a sum of 1; without any mass it is even."""
        total = float(self.mass.sum(dtype=np.float64))
        if not (total > 0 and math.isfinite(total)):
            return replace(self, mass=np.full_like(self.mass, 1.0 / self.mass.size))
        return replace(self, mass=self.mass / np.float32(total))

    def weighed(self, logs: Floats, *, outlier_probability: float) -> Self:
        """Multiply by a likelihood of which `logs` are the logarithms at the headings in `asked`, up to a constant.

        With `outlier_probability` a view says nothing, whatever it shows: it never makes a place less likely than that
        share of the likeliest one. So one view, however sure, excludes nothing.
        """
        found = np.float32(outlier_probability) * self.mass
        found[self.asked] += self.mass[self.asked] * np.exp(logs - logs.max()) * np.float32(1 - outlier_probability)
        return replace(self, mass=found).normalised()

    def fitted(self) -> Self:
        """Cut the window to nearly all of the mass, and make its cells as large or small as its size asks for."""
        found = self.cut(self._held())
        while found.mass.size > MOST and found.factor < sizes_of(found.mapped)[-1]:
            found = found.coarser()
        # 400_000 values below which they become smaller
        while found.factor > 1 and values(found.box, found.mapped, found.factor // 2) <= 400_000:
            found = found.finer()
        return found

    def _held(self) -> Box:
        plane = self.mass.sum(axis=0, dtype=np.float64)
        sides = []
        for axis in (1, 0):
            share = np.cumsum(plane.sum(axis=axis)) / plane.sum()
            sides.append((int(np.searchsorted(share, TAIL)), int(np.searchsorted(share, 1 - TAIL)) + 1))
        (top, bottom), (left, right) = ((first * self.factor, last * self.factor) for first, last in sides)
        return (self.row + top, self.col + left, self.row + bottom, self.col + right)

    def cut(self, box: Box) -> Self:
        """Return the belief on another window, widened to whole units and cut at some way beyond the map."""
        found = self.blank(self.mapped, self.factor, clipped(box, self.mapped, beyond_m=BEYOND_M))
        down, right = (self.row - found.row) // self.factor, (self.col - found.col) // self.factor
        into, part = window_overlap(found.shape, self.shape, down, right)
        found.mass[(slice(None), *into)] = self.mass[(slice(None), *part)]
        return found.normalised()

    def coarser(self) -> Self:
        """Return the belief on cells twice as large."""
        yaws, rows, cols = self.mass.shape
        mass = self.mass.reshape(yaws, rows // 2, 2, cols // 2, 2).sum(axis=(2, 4))
        if yaw_count(self.mapped, 2 * self.factor) < yaws:
            mass = mass[::2] + (mass[1::2] + np.roll(mass[1::2], 1, axis=0)) / 2
        return replace(self, factor=2 * self.factor, mass=mass)

    def finer(self) -> Self:
        """Return the belief on cells half as large, interpolated linearly."""
        yaws, rows, cols = self.mass.shape
        mass = np.stack([cv2.resize(one, (2 * cols, 2 * rows), interpolation=cv2.INTER_LINEAR) for one in self.mass])
        if yaw_count(self.mapped, self.factor // 2) > yaws:
            mass = np.stack((mass, (mass + np.roll(mass, -1, axis=0)) / 2), axis=1).reshape(
                2 * yaws, 2 * rows, 2 * cols
            )
        return replace(self, factor=self.factor // 2, mass=mass).normalised()


def sizes_of(mapped: Grid) -> tuple[int, ...]:
    """Return the sizes that a cell of a belief may have, in cells of the map: up to `COARSEST_M`.

    >>> [sizes_of(Grid(epsg=0, west_m=0, north_m=0, cell_size_m=side, rows=8, cols=8)) for side in (4.0, 16.0)]
    [(1, 2, 4, 8), (1, 2)]
    """
    return tuple(size for size in FACTORS if size == 1 or size * mapped.cell_size_m <= COARSEST_M)


def yaw_count(mapped: Grid, factor: int) -> int:
    """Return the number of headings on cells of a size."""
    # 8 m: largest cell with FINE_YAWS headings; larger ones have COARSE_YAWS
    return FINE_YAWS if factor * mapped.cell_size_m <= 8.0 else COARSE_YAWS


def values(box: Box, mapped: Grid, factor: int) -> int:
    """Return the number of values of a belief on a window."""
    top, left, bottom, right = box
    return (bottom - top) * (right - left) // factor**2 * yaw_count(mapped, factor)


def clipped(box: Box, mapped: Grid, *, beyond_m: float = 0.0) -> Box:
    """Return a box widened to whole units, and no wider than the map; at least one unit."""
    beyond = math.ceil(beyond_m / mapped.cell_size_m)
    low, high = np.array([-beyond, -beyond]), np.array(mapped.shape) + beyond
    first = np.clip(box[:2], low, high - 1) // UNIT * UNIT
    last = -(-np.clip(box[2:], first + 1, high) // UNIT) * UNIT
    return (*first.tolist(), *last.tolist())


def window_overlap(into: tuple[int, int], part: tuple[int, int], down: int, right: int) -> tuple[Slices, Slices]:
    """Return the common cells of two windows, in each of them; the second begins `down` and `right` of the first.

    >>> window_overlap((4, 4), (3, 3), 2, -1)
    ((slice(2, 4, None), slice(0, 2, None)), (slice(0, 2, None), slice(1, 3, None)))
    """
    sides = []
    for whole, size, offset in zip(into, part, (down, right), strict=True):
        first, last = max(offset, 0), min(offset + size, whole)
        sides.append((slice(first, max(first, last)), slice(first - offset, max(first, last) - offset)))
    (rows, from_rows), (cols, from_cols) = sides
    return (rows, cols), (from_rows, from_cols)


def _middle_m(grid: Grid) -> tuple[float, float]:
    west_m, south_m, east_m, north_m = grid.bounds_m
    return (west_m + east_m) / 2, (south_m + north_m) / 2


def _about(yaws_deg: NDArray[np.float64], yaw_deg: float | None, sigma_deg: float | None) -> Floats:
    if yaw_deg is None or sigma_deg is None:
        return np.full(len(yaws_deg), 1 / len(yaws_deg), dtype=np.float32)
    step_deg = _CIRCLE_DEG / len(yaws_deg)
    away_deg = np.abs(wrap_deg(yaws_deg - yaw_deg))
    chance = np.exp(-(away_deg**2) / (2 * (sigma_deg**2 + step_deg**2 / 12)))
    return np.asarray(chance / chance.sum(), dtype=np.float32)


def prepare_levels(field: Field) -> Field:
    """Return a map with the larger cells that beliefs on it may have, made now instead of during a flight."""
    for factor in sizes_of(field.grid)[1:]:
        field.level(factor)
    return field


LOST: Final = np.diag([1000.0**2, 1000.0**2, 90.0**2])  # m2, m2, deg2: where the odometer lost its way
_SIGMAS: Final = 3.5  # of a spread that a window holds
_SMALL: Final = 0.5  # variance in cells2 below which a Gaussian is mixed with no move at all
_TINY: Final = 1e-4  # variance in cells2 that is none

Matrix = NDArray[np.float64]


def moved(
    belief: GridBelief,
    increment: tuple[float, float, float] | None,
    covariance: Matrix | None,
    *,
    diffuses: bool = True,
) -> GridBelief:
    """Return a belief after a step of the drone.

    Parameters
    ----------
    belief : GridBelief
        Before the step.
    increment : tuple of float, optional
        Right and up, metres, and the turn, degrees clockwise, in the axes of the pose before. Without one the belief
        stays, and spreads by 1 km and 90 degrees.
    covariance : ndarray of float64, shape (3, 3), optional
        Of the increment, m2, m deg and deg2.
    diffuses : bool
        Whether the belief spreads by the covariance of an increment.
    """
    if increment is None or covariance is None:
        increment, covariance = (0.0, 0.0, 0.0), LOST
    elif not diffuses:
        covariance = np.zeros((3, 3))
    spread_m = _SIGMAS * math.sqrt(max(covariance[0, 0], covariance[1, 1]))
    box = _around(belief, math.hypot(*increment[:2]) + spread_m)
    while values(box, belief.mapped, belief.factor) > MOST and belief.factor < sizes_of(belief.mapped)[-1]:
        belief = belief.coarser()
    shifted = _moved(belief, increment, spread_m=spread_m)
    return _spread(shifted, covariance).normalised()


def _around(belief: GridBelief, reach_m: float) -> Box:
    reach = math.ceil(reach_m / belief.mapped.cell_size_m)
    top, left, bottom, right = belief.box
    return clipped((top - reach, left - reach, bottom + reach, right + reach), belief.mapped, beyond_m=BEYOND_M)


def _moved(belief: GridBelief, increment: tuple[float, float, float], *, spread_m: float) -> GridBelief:
    """Move every cell and heading by an increment in its own axes, linear between cells and headings."""
    # The new window has a margin for what spreads from it afterwards.
    right_m, up_m, turn_deg = increment
    before = np.arange(len(belief.mass)) - turn_deg / belief.yaw_step_deg  # the heading of each, in steps
    low = np.floor(before).astype(np.int64)
    high_share = (before - low).astype(np.float32)
    low %= len(belief.mass)
    high = (low + 1) % len(belief.mass)
    has_mass = np.asarray(belief.mass.any(axis=(1, 2)))
    kept = np.flatnonzero(has_mass[low] | has_mass[high])
    turns = (rotation(float(yaw)) @ (right_m, up_m) for yaw in before[kept] * belief.yaw_step_deg)
    shift = np.array([(-north_m, east_m) for east_m, north_m in turns]) / belief.grid.cell_size_m  # down, right
    low_shift, high_shift = np.floor(shift.min(axis=0)), np.ceil(shift.max(axis=0)) + 1
    margin = math.ceil(spread_m / belief.mapped.cell_size_m)
    first = belief.box[:2] + low_shift.astype(int) * belief.factor - margin
    last = belief.box[2:] + high_shift.astype(int) * belief.factor + margin
    box = clipped((*first.tolist(), *last.tolist()), belief.mapped, beyond_m=BEYOND_M)
    found = belief.blank(belief.mapped, belief.factor, box)
    off = np.array([belief.row - found.row, belief.col - found.col]) // belief.factor
    for yaw, (down, right) in zip(kept.tolist(), shift + off, strict=True):
        part = (1 - high_share[yaw]) * belief.mass[low[yaw]] + high_share[yaw] * belief.mass[high[yaw]]
        _add(found.mass[yaw], part, float(down), float(right))
    return found


def _add(into: Floats, part: Floats, down: float, right: float) -> None:
    """Add a part at a fraction of a cell: four copies, each with its share."""
    row, col = math.floor(down), math.floor(right)
    by_row, by_col = down - row, right - col
    for at_row, high in ((row, 1 - by_row), (row + 1, by_row)):
        for at_col, wide in ((col, 1 - by_col), (col + 1, by_col)):
            if high * wide > 0:
                to, cut = window_overlap((into.shape[0], into.shape[1]), (part.shape[0], part.shape[1]), at_row, at_col)
                into[to] += np.float32(high * wide) * part[cut]


def _spread(belief: GridBelief, covariance: Matrix) -> GridBelief:
    """Diffuse a belief by the covariance of an increment, in the axes of each heading."""
    # Errors of place and heading count as independent.
    mass = belief.mass
    step = belief.yaw_step_deg
    if covariance[2, 2] > _TINY * step**2:
        circle = _turning(len(mass), covariance[2, 2] / step**2)
        mass = (circle @ mass.reshape(len(mass), -1)).reshape(mass.shape)
    planar = covariance[:2, :2] / belief.grid.cell_size_m**2
    widest = float(np.linalg.eigvalsh(planar)[-1])
    if widest > _TINY:
        mass = mass.copy() if mass is belief.mass else mass
        for layer, yaw_deg in zip(mass, belief.yaws_deg.tolist(), strict=True):
            if layer.any():
                turned = rotation(yaw_deg) @ planar @ rotation(yaw_deg).T
                # 5: standard deviation in cells from which a Gaussian is three boxes one after the other
                layer[:] = _boxed(layer, np.trace(planar) / 2) if widest > 5.0**2 else _blurred(layer, turned)
    return replace(belief, mass=mass)


def _turning(count: int, variance: float) -> Floats:
    """Return the probabilities from each heading to each, for a variance in steps2, shape (count, count)."""
    share = min(1.0, variance / _SMALL)
    away = np.arange(count)
    away = np.minimum(away, count - away)
    kernel = np.exp(-(away**2) * share / (2 * variance))
    kernel = share * kernel / kernel.sum()
    kernel[0] += 1 - share
    return np.asarray(kernel[(np.arange(count)[:, None] - np.arange(count)) % count], dtype=np.float32)


def _blurred(layer: Floats, covariance: Matrix) -> Floats:
    """Convolve with a Gaussian of a covariance of (east, north), cells2."""
    # A Gaussian much narrower than a cell cannot be sampled: a wider one is mixed with no move, which has the same
    # variance.
    values_, vectors = np.linalg.eigh(covariance)
    share = min(1.0, float(values_[-1]) / _SMALL)
    wide = np.maximum(values_ / share, _SMALL)
    reach = math.ceil(_SIGMAS * math.sqrt(float(wide[-1])))
    east, north = np.meshgrid(np.arange(-reach, reach + 1), np.arange(reach, -reach - 1, -1))
    along = np.stack((east, north), axis=-1) @ vectors
    kernel = np.exp(-(along**2 / (2 * wide)).sum(axis=-1))
    kernel *= share / kernel.sum()
    kernel[reach, reach] += 1 - share
    return np.asarray(cv2.filter2D(layer, -1, kernel.astype(np.float32), borderType=cv2.BORDER_CONSTANT))


def _boxed(layer: Floats, variance: float) -> Floats:
    """Convolve with about a Gaussian of the same variance in both axes, cells2: three boxes in a row."""
    side = 2 * round((math.sqrt(4 * variance + 1) - 1) / 2) + 1
    for _ in range(3):
        layer = np.asarray(cv2.blur(layer, (side, side), borderType=cv2.BORDER_CONSTANT))
    return layer


SCORED_M: Final = 16.0  # largest cell that a view is scored on


def surface_logs(
    field: Field, template: Template, belief: GridBelief, *, exponent_scale: float, scale: float = 1.0
) -> Floats:
    """Return tempered scores of a view at the headings in `belief.asked` and each cell, shape (A, rows, cols).

    The map is scored in cells of the belief, on which thin classes are spread, but for cells larger than `SCORED_M`:
    too few of these are in a view, so they are as likely as the mean of their quarters. On cells smaller than those of
    the belief a score is sharper than steps of heading are. Beyond the map a view scores 0: it says nothing there.
    """
    parts = 2 if belief.grid.cell_size_m > SCORED_M and belief.factor > 1 else 1
    found = np.empty((len(belief.asked), *belief.shape), dtype=np.float32)
    # 16 million scores computed at a time: bounds memory where the belief is wide
    step = max(1, 16_000_000 // (belief.mass[0].size * parts**2))
    # Headings at right angles share their work, so they are asked for together.
    order = np.argsort(belief.asked % (len(belief.mass) // 4), kind="stable")
    for first in range(0, len(order), step):
        chosen = order[first : first + step]
        scores = _scores(
            field, template, belief, belief.yaws_deg[belief.asked[chosen]], factor=belief.factor // parts, scale=scale
        )
        found[chosen] = pooled_logs(np.float32(exponent_scale) * scores, parts)
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
    field: Field, template: Template, belief: GridBelief, yaws_deg: NDArray[np.float64], *, factor: int, scale: float
) -> Floats:
    """Return scores on the window of a belief in cells of `factor` map cells a side, 0 beyond the map."""
    top, left, bottom, right = belief.box
    found = np.zeros((len(yaws_deg), (bottom - top) // factor, (right - left) // factor), dtype=np.float32)
    if bottom <= 0 or right <= 0 or top >= field.grid.rows or left >= field.grid.cols:
        return found
    west_m, south_m, east_m, north_m = belief.grid.bounds_m
    scored = surface(
        field,
        template,
        center_m=((west_m + east_m) / 2, (south_m + north_m) / 2),
        radius_m=max(east_m - west_m, north_m - south_m) / 2,
        yaws_deg=yaws_deg,
        factor=factor,
        scale=scale,
    )
    cell_m = scored.grid.cell_size_m
    down, across = round((north_m - scored.grid.north_m) / cell_m), round((scored.grid.west_m - west_m) / cell_m)
    into, part = window_overlap((found.shape[1], found.shape[2]), scored.grid.shape, down, across)
    found[(slice(None), *into)] = scored.scores[(slice(None), *part)]
    return found


def known_on(field: Field, grid: Grid) -> Floats:
    """Return the share of each cell of a grid that the map knows, shape of the grid; 0 beyond the map.

    The cells of the grid are whole squares of cells of the map, as those of a belief's window or of a surface are.
    """
    cell_m = field.grid.cell_size_m
    step = round(grid.cell_size_m / cell_m)
    down = round((grid.north_m - field.grid.north_m) / cell_m)  # cells of the grid before the map's first, if positive
    right = round((field.grid.west_m - grid.west_m) / cell_m)
    fine = np.zeros((grid.rows * step, grid.cols * step), dtype=np.uint8)
    into, part = window_overlap(fine.shape, field.known.shape, down, right)
    fine[into] = field.known[part]
    shares = cv2.resize(fine, (grid.cols, grid.rows), interpolation=cv2.INTER_AREA)
    return np.asarray(shares, dtype=np.float32) / np.float32(FULL)
