# SPDX-License-Identifier: Apache-2.0
"""Settings and results of a search; the headings, scales and places that a prior allows."""

import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass, replace
from typing import Any, Final, Self

import numpy as np
from numpy.typing import NDArray

from sasgeo_bench.geometry.grid import Grid
from sasgeo_bench.geometry.pose import Pose, Prior

SPREAD: Final = 2.5  # standard deviations of the heading that every search covers: one normal prior in 80 is off


@dataclass(frozen=True, kw_only=True)
class Plan:
    """Settings of a search.

    `cells` is the least number of cells of the coarsest level along the longer side of the view; `beam` are the modes
    kept at the coarsest level, then at each finer one, the last number for all further levels: of 17 km2 of places, and
    more of more (`Search.patches`); `each` candidate starts with so many modes. Headings and scales are searched within
    `spread` standard deviations, modes of a result are `apart_m` from each other, and a view may lie within `around_m`
    of its candidate. The number of `threads` changes the time alone.
    """

    cells: int = 16
    beam: tuple[int, ...] = (80, 24, 10, 6, 5)
    each: int = 2
    spread: float = SPREAD
    apart_m: float = 25.0
    around_m: float = 24.0
    threads: int = 1

    def width(self, depth: int, patches: int = 1) -> int:
        """Return how many modes are kept at a depth of the pyramid, 0 the coarsest, with so many times the beam."""
        return self.beam[min(depth, len(self.beam) - 1)] * patches


@contextmanager
def in_threads(threads: int) -> Iterator[Callable[..., Iterator[Any]]]:
    """Yield a `map` over so many threads; of one it is Python's own, since to hand tasks over takes as long as they.

    >>> with in_threads(2) as mapped:
    ...     list(mapped(pow, (2, 3), (3, 2)))
    [8, 9]
    """
    if threads == 1:
        yield map
        return
    with ThreadPoolExecutor(threads) as pool:
        yield pool.map


@dataclass(frozen=True, slots=True, kw_only=True)
class Mode:
    """A pose and its score."""

    pose: Pose
    score: float


@dataclass(frozen=True, slots=True, kw_only=True)
class Null:
    """Statistics of the coarse scores of all places, each at its best heading and scale; nearly all are wrong."""

    best: float
    mean: float
    deviation: float
    places: int


@dataclass(frozen=True, slots=True, kw_only=True)
class Found:
    """Modes of a search, best first, and statistics of all coarse scores."""

    modes: tuple[Mode, ...]
    null: Null


def place_m(pose: Pose) -> tuple[float, float]:
    """Return easting and northing of a pose."""
    return (pose.easting_m, pose.northing_m)


def thinned(modes: Iterable[Mode], apart_m: float, most: int | None = None) -> list[Mode]:
    """Drop modes that lie nearer than a distance to a better one; `most` are returned, by default all of the others."""
    kept: list[Mode] = []
    for mode in modes:
        if len(kept) == most:
            break
        if all(math.dist(place_m(mode.pose), place_m(other.pose)) >= apart_m for other in kept):
            kept.append(mode)
    return kept


def posterior(scores: Sequence[float], *, null_score: float = 0.0) -> NDArray[np.float64]:
    """Return the probability of each mode and, last, of none of them: a softmax, shape (len(scores) + 1,).

    Scores are logarithms of likelihood ratios.

    Examples
    --------
    >>> posterior([2.0, 0.0]).round(3).tolist()
    [0.787, 0.107, 0.107]
    """
    logs = np.array([*scores, null_score], dtype=np.float64)
    mass = np.exp(logs - logs.max())
    return np.asarray(mass / mass.sum())


_MOST_PLACES: Final = 512  # a side of a tile: bounds the memory of the transforms
_NOTHING: Final = 1e-9


@dataclass(frozen=True, kw_only=True)
class Turns:
    """Headings and scales to try: all poses of `bases`, and `quarters` - 1 others at right angles to each."""

    bases: tuple[Pose, ...]
    quarters: int
    yaw_step_deg: float
    scale_step: float


def turns_of(prior: Prior, *, spread: float, step: float) -> Turns:
    """Return headings and scales that a prior allows, in steps of at most `step` (radians of heading, and scale)."""
    offsets, scale_step = _steps(min(spread * prior.scale_sigma, 0.9), step)
    scales = [1 + offset for offset in offsets]
    if prior.yaw_deg is None or prior.yaw_sigma_deg is None or spread * prior.yaw_sigma_deg >= 180:
        return all_around(math.degrees(step), scales, scale_step)
    yaws_deg, yaw_step_deg = _steps(spread * prior.yaw_sigma_deg, math.degrees(step))
    bases = tuple(_turn(prior.yaw_deg + yaw_deg, scale) for scale in scales for yaw_deg in yaws_deg)
    return Turns(bases=bases, quarters=1, yaw_step_deg=yaw_step_deg, scale_step=scale_step)


def all_around(step_deg: float, scales: Sequence[float] = (1.0,), scale_step: float = 0.0) -> Turns:
    """Return all headings in equal steps of at most `step_deg`."""
    count = math.ceil(90 / step_deg - _NOTHING)
    bases = tuple(_turn(90 * at / count, scale) for scale in scales for at in range(count))
    return Turns(bases=bases, quarters=4, yaw_step_deg=90 / count, scale_step=scale_step)


def _turn(yaw_deg: float, scale: float) -> Pose:
    return Pose(easting_m=0.0, northing_m=0.0, yaw_deg=yaw_deg, scale=scale)


def _steps(reach: float, step: float) -> tuple[list[float], float]:
    """Cut -reach to reach into equal parts of at most `step`; return their middles and their size."""
    count = math.ceil(2 * reach / step - _NOTHING)
    return ([reach * (2 * at + 1 - count) / count for at in range(count)], 2 * reach / count) if count else ([0.0], 0.0)


@dataclass(frozen=True, slots=True, kw_only=True)
class Disc:
    """Disc of places where a view may lie; all places, if it has no centre."""

    center_m: tuple[float, float] | None
    radius_m: float

    def holds(self, points_m: NDArray[np.float64]) -> NDArray[np.bool_]:
        """Return which places, shape (N, 2), lie within."""
        if self.center_m is None:
            return np.ones(len(points_m), dtype=bool)
        return np.asarray(np.hypot(*(points_m - self.center_m).T) <= self.radius_m)

    def has(self, pose: Pose) -> bool:
        """Return whether a pose lies within."""
        return self.center_m is None or math.dist((pose.easting_m, pose.northing_m), self.center_m) <= self.radius_m

    def wider(self, by_m: float) -> Self:
        """Return the disc with a larger radius."""
        return replace(self, radius_m=self.radius_m + by_m)


@dataclass(frozen=True, kw_only=True)
class Tile:
    """Rectangle of places, cells of one level: its first cell, and which are allowed, shape (rows, cols)."""

    row: int
    col: int
    allowed: NDArray[np.bool_]


NO_PLACE: Final = Tile(row=0, col=0, allowed=np.zeros((1, 1), dtype=np.bool_))


def tiles_of(grid: Grid, ground: Grid, disc: Disc) -> list[Tile]:
    """Return the places of a level within a disc and on the map, in tiles of limited size."""
    top, left, bottom, right = 0, 0, grid.rows, grid.cols
    if disc.center_m is not None:
        row, col = grid.to_cells(np.array([disc.center_m]))[0].tolist()
        reach = math.ceil(disc.radius_m / grid.cell_size_m)
        top, left = max(row - reach, top), max(col - reach, left)
        bottom, right = min(row + reach + 1, bottom), min(col + reach + 1, right)
    west_m, south_m, east_m, north_m = ground.bounds_m
    tiles = []
    for row in range(top, bottom, _MOST_PLACES):
        for col in range(left, right, _MOST_PLACES):
            part = grid.window(row, col, min(_MOST_PLACES, bottom - row), min(_MOST_PLACES, right - col))
            points_m = part.to_centres_m(np.column_stack([index.ravel() for index in np.indices(part.shape)]))
            inside = (points_m >= (west_m, south_m)).all(axis=1) & (points_m <= (east_m, north_m)).all(axis=1)
            tiles.append(Tile(row=row, col=col, allowed=(inside & disc.holds(points_m)).reshape(part.shape)))
    return tiles
