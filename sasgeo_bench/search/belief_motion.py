# SPDX-License-Identifier: Apache-2.0
"""Motion of a belief: the increment of the odometer undone cell by cell, and its covariance as diffusion."""

import math
from dataclasses import replace
from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

from sasgeo_bench.geometry.pose import rotation
from sasgeo_bench.search.belief import (
    BEYOND_M,
    MOST,
    Box,
    Floats,
    GridBelief,
    clipped,
    sizes_of,
    values,
    window_overlap,
)

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
        # Probabilities from each heading to each, for a variance in steps2, shape (count, count)
        count = len(mass)
        variance = covariance[2, 2] / step**2
        share = min(1.0, variance / _SMALL)
        away = np.arange(count)
        away = np.minimum(away, count - away)
        kernel = np.exp(-(away**2) * share / (2 * variance))
        kernel = share * kernel / kernel.sum()
        kernel[0] += 1 - share
        circle = np.asarray(kernel[(np.arange(count)[:, None] - np.arange(count)) % count], dtype=np.float32)
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
