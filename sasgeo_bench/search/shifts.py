# SPDX-License-Identifier: Apache-2.0
"""Search by scores that are no sum of votes: cross-correlations of channels at all places, combined by the matcher.

Intersection over union, mutual information and phase correlation need correlations of single channels before they are
added up. For each heading a matcher gets them (`Overlaps`) and returns a score for each place.
"""

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from typing import Final, Self

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy import fft

from sasgeo_bench.geometry.grid import Grid
from sasgeo_bench.geometry.pose import Pose, Prior, inverse
from sasgeo_bench.search.field import Level, Template, bands_of, between, by_fours, pooled, warped
from sasgeo_bench.search.parts import correlated, map_spectrum
from sasgeo_bench.search.plan import SPREAD, Disc, Mode, Tile, Turns, place_m, thinned, turns_of
from sasgeo_bench.search.view import Chart

Spectra = NDArray[np.complexfloating]

_TILE: Final = 256  # places a side of a tile: bounds the memory of the transforms
_LOW: Final = -np.inf
_FEW: Final = 16  # places a side, up to which matrix products cost less than an inverse transform
_AT_ONCE: Final = 200_000  # values of the spectra of one channel under tiles that are scored together: a cache of 2 MB
_STEPS: Final = 4  # headings on either side of a coarse one, where it is refined


@dataclass(frozen=True, slots=True, kw_only=True)
class ShiftPlan:
    """Settings of a search by shifts.

    All places are tried in cells of `coarse_m`, at headings of at most `yaw_step_deg` from each other within `spread`
    standard deviations; scale is 1. The best `refined` modes, `apart_m` from each other, are refined in cells of
    `fine_m`. A view may lie within `around_m` of its candidate.
    """

    coarse_m: float = 4.0
    fine_m: float = 2.0
    yaw_step_deg: float = 3.0
    spread: float = SPREAD
    apart_m: float = 25.0
    around_m: float = 24.0
    refined: int = 8


@dataclass(frozen=True, kw_only=True)
class Overlaps:
    """A turned view of V channels over a map of M channels, at all places of a tile.

    Parameters
    ----------
    seen : tuple of ndarray of complex64
        Transforms of the view's V channels, conjugate, shape (n, n / 2 + 1) each; equal channels share one.
    mapped : ndarray of complex64
        Transforms of the map's channels, shape (M, n, n / 2 + 1), or (M, T, n, n / 2 + 1) of T tiles.
    places : tuple of int
        Rows and columns of the tile; before them T, of several tiles.
    totals : ndarray of float64, shape (V,)
        Sum of each channel of the view over its cells.

    Examples
    --------
    A view of one cell over a map of two channels reads the map itself, at each of nine places:

    >>> layers = np.zeros((2, 4, 4), dtype=np.float32)
    >>> layers[1, 2, 0] = 1
    >>> overlaps = Overlaps.of(np.ones((1, 1, 1), dtype=np.float32), layers, places=(3, 3))
    >>> (overlaps.sums(0, 1).round(6) + 0.0).tolist()
    [[0.0, 0.0, 0.0], [0.0, 0.0, 0.0], [1.0, 0.0, 0.0]]
    """

    seen: tuple[Spectra, ...]
    mapped: Spectra
    places: tuple[int, ...]
    totals: NDArray[np.float64]

    @classmethod
    def of(cls, seen: NDArray[np.float32], mapped: NDArray[np.float32], *, places: tuple[int, ...]) -> Self:
        """Transform a view, shape (V, h, h), and the map under it at all places, shape (M, h + rows - 1, ...)."""
        size = size_of(max(mapped.shape[1:]))
        return cls.over(seen, map_transform(mapped, size), places=places)

    @classmethod
    def over(cls, seen: NDArray[np.float32], mapped: Spectra, *, places: tuple[int, ...]) -> Self:
        """Transform a view over a map that is transformed already."""
        size = mapped.shape[-2]
        spectra = fft.fft(fft.rfft(seen, n=size, axis=-1), n=size, axis=-2)
        np.conj(spectra, out=spectra)
        totals = seen.sum(axis=(1, 2), dtype=np.float64)
        return cls(seen=tuple(spectra), mapped=mapped, places=places, totals=totals)

    def picked(self, channels: NDArray[np.int64]) -> Self:
        """Return these channels of the view, in this order; they may repeat."""
        seen = tuple(self.seen[channel] for channel in channels.tolist())
        return replace(self, seen=seen, totals=self.totals[channels])

    def holds(self, mapped: int) -> bool:
        """Return whether a channel of the map, which is nowhere negative, has anything near the tile."""
        return bool(self.mapped[mapped, ..., 0, 0].any())  # its sum

    def cross(self, seen: int, mapped: int) -> Spectra:
        """Return the cross-power spectrum of a channel of the view and one of the map, for `back`."""
        return np.asarray(self.seen[seen] * self.mapped[mapped])

    def back(self, spectra: Spectra) -> NDArray[np.float32]:
        """Return the correlations of cross-power spectra, shape (..., n, n / 2 + 1), at each place, (..., *places)."""
        size, (rows, cols) = self.mapped.shape[-2], self.places[-2:]
        if max(rows, cols) <= _FEW:
            down, across = waves(size, rows, cols)
            return np.ascontiguousarray((down @ spectra @ across).real, dtype=np.float32)
        along = fft.ifft(spectra, axis=-2)[..., :rows, :]  # the other rows are not asked for
        return np.asarray(fft.irfft(along, size, axis=-1)[..., :cols], dtype=np.float32)

    def sums(self, seen: int, mapped: int) -> NDArray[np.float32]:
        """Return the sum over cells of a channel of the view times one of the map, float32 of shape `places`."""
        return self.back(self.cross(seen, mapped))


@lru_cache(maxsize=8)
def waves(size: int, rows: int, cols: int) -> tuple[Spectra, Spectra]:
    """Return the matrices on either side of a spectrum that give the first rows and columns of its plane.

    Examples
    --------
    >>> plane = np.arange(20.0).reshape(5, 4)[:4]
    >>> down, across = waves(4, 2, 3)
    >>> (down @ fft.rfft2(plane) @ across).real.round(4).tolist()
    [[0.0, 1.0, 2.0], [4.0, 5.0, 6.0]]
    """
    half = size // 2 + 1
    down, across = (
        np.exp(2j * np.pi / size * np.outer(*at)) for at in ((range(rows), range(size)), (range(half), range(cols)))
    )
    # All but the first and, of an even size, the last column of a spectrum stand for their mirror images, too
    across *= np.where(np.arange(half) % (size / 2) == 0, 1, 2)[:, None] / size**2
    return down.astype(np.complex64), across.astype(np.complex64)


Scorer = Callable[[Overlaps], NDArray[np.float32]]


def size_of(side: int) -> int:
    """Return the size of a transform that holds a square of a side."""
    return int(fft.next_fast_len(side, real=True))


def map_transform(layers: NDArray[np.float32], size: int) -> Spectra:
    """Transform channels of a map, shape (M, rows, cols), once for all headings."""
    return np.asarray(fft.rfft2(layers, s=(size, size)))


@dataclass(frozen=True, kw_only=True)
class ShiftSearch:
    """Search for one view on one map by a score of its overlaps.

    Parameters
    ----------
    chart : Chart
        The map. Its channels for the scorer are those of `bands`, 0..1, and last the known cells.
    bands : ndarray of int64, shape (B,)
        Classes of the chart that the scorer reads.
    channels : ndarray of float32, shape (V, rows, cols)
        The view as the scorer reads it.
    cell_size_m : float
        Side of its cells.
    score : callable
        Returns the score of each place from `Overlaps`, float32; minus infinity where there is none. It is asked about
        several tiles at once, and about the same view at many headings.
    prior : Prior
        What is known of the pose.
    plan : ShiftPlan
        Settings.
    """

    chart: Chart
    bands: NDArray[np.int64]
    channels: NDArray[np.float32]
    cell_size_m: float
    score: Scorer
    prior: Prior
    plan: ShiftPlan

    def places(self, count: int) -> list[Mode]:
        """Return up to `count` poses within the prior, best first, `apart_m` from each other."""
        plan, disc = self.plan, Disc(center_m=self.prior.center_m, radius_m=self.prior.radius_m or 0.0)
        factor = self._factor(plan.coarse_m)
        tiles = list(self._tiles(factor, disc))
        found = [mode for modes in self._best(tiles, factor, self._yaws_deg) for mode in modes]
        best = thinned(_ranked(found), plan.apart_m, max(plan.refined, count))
        return thinned(_ranked(self._refined(best, disc)), plan.apart_m, count)

    def candidates(self, poses: Sequence[Pose]) -> list[Mode | None]:
        """Return the best pose near each candidate; None where the map shows nothing."""
        factor = self._factor(self.plan.coarse_m)
        discs = [Disc(center_m=place_m(pose), radius_m=self.plan.around_m) for pose in poses]
        tiles = [
            self._around(place_m(pose), self.plan.around_m, factor, disc)
            for pose, disc in zip(poses, discs, strict=True)
        ]
        return [next(iter(modes), None) for modes in self._best(tiles, factor, self._yaws_deg)]

    @property
    def _yaws_deg(self) -> list[float]:
        turns = turns_of(replace(self.prior, scale_sigma=0.0), spread=self.plan.spread, step=self._step)
        return [base.yaw_deg + 90.0 * quarter for base in turns.bases for quarter in range(turns.quarters)]

    @property
    def _step(self) -> float:
        return math.radians(self.plan.yaw_step_deg)

    def _factor(self, size_m: float) -> int:
        return max(1, round(size_m / self.chart.grid.cell_size_m))

    def _cell(self, point_m: tuple[float, float]) -> tuple[int, int]:
        row, col = self.chart.grid.to_cells(np.array([point_m]))[0].tolist()
        return row, col

    def _half(self, factor: int) -> int:
        step_m = factor * self.chart.grid.cell_size_m
        return math.ceil(math.hypot(*self.channels.shape[1:]) * self.cell_size_m / 2 / step_m) + 1

    def _tiles(self, factor: int, disc: Disc) -> Iterator["_Tile"]:
        """Yield squares of places that hold the disc, or the whole map."""
        rows, cols = self.chart.grid.shape
        top, left, bottom, right = 0, 0, rows, cols
        if disc.center_m is not None:
            row, col = self._cell(disc.center_m)
            reach = math.ceil(disc.radius_m / self.chart.grid.cell_size_m)
            top, left, bottom, right = max(row - reach, 0), max(col - reach, 0), row + reach + 1, col + reach + 1
            bottom, right = min(bottom, rows), min(right, cols)
        if top >= bottom or left >= right:
            return
        count = min(_TILE, -(-max(bottom - top, right - left) // factor))
        for row in range(top, bottom, count * factor):
            for col in range(left, right, count * factor):
                yield self._tile(row, col, count, factor, disc.wider(factor * self.chart.grid.cell_size_m))

    def _around(self, point_m: tuple[float, float], reach_m: float, factor: int, disc: Disc) -> "_Tile":
        reach = math.ceil(reach_m / (factor * self.chart.grid.cell_size_m))
        row, col = self._cell(point_m)
        back = reach * factor + factor // 2
        return self._tile(row - back, col - back, 2 * reach + 1, factor, disc)

    def _tile(self, row: int, col: int, count: int, factor: int, disc: Disc) -> "_Tile":
        """Return a square of `count` places a side, which begins at a cell of the map."""
        half = self._half(factor)
        layers = self.chart.pooled(row - half * factor, col - half * factor, count + 2 * half, factor, self.bands)
        grid = self.chart.grid
        cells_m = (np.arange(count) + 0.5) * factor * grid.cell_size_m
        east_m = grid.west_m + col * grid.cell_size_m + cells_m
        north_m = grid.north_m - row * grid.cell_size_m - cells_m
        points_m = np.stack(np.broadcast_arrays(east_m[None, :], north_m[:, None]), axis=-1)
        west_m, south_m, most_east_m, most_north_m = grid.bounds_m
        on_map = ((points_m >= (west_m, south_m)) & (points_m <= (most_east_m, most_north_m))).all(axis=-1)
        allowed = on_map & disc.holds(points_m.reshape(-1, 2)).reshape(on_map.shape)
        mapped = map_transform(layers, size_of(layers.shape[1]))
        return _Tile(mapped=mapped, points_m=points_m, allowed=allowed)

    def _best(self, tiles: Sequence["_Tile"], factor: int, yaws_deg: Sequence[float]) -> list[list[Mode]]:
        """Return the best places of each tile, best first, `apart_m` from each other, each at its best heading."""
        if not tiles:
            return []
        # Tiles of one search are of one size
        at_once = max(1, _AT_ONCE // math.prod(tiles[0].mapped.shape[1:]))
        groups = [tiles[first : first + at_once] for first in range(0, len(tiles), at_once)]
        return self._best_of(groups, factor, [yaws_deg] * len(groups))

    def _best_of(
        self, groups: Sequence[Sequence["_Tile"]], factor: int, yaws_deg: Sequence[Sequence[float]]
    ) -> list[list[Mode]]:
        """Return the `_best` places of each tile in groups that are scored together, each group at its own headings.

        A view is turned and transformed once for all groups that ask for a heading.
        """
        mapped = [np.stack([tile.mapped for tile in group], axis=1) for group in groups]
        allowed = [np.stack([tile.allowed for tile in group]) for group in groups]
        high = [np.full(places.shape, _LOW, dtype=np.float32) for places in allowed]
        which = [np.zeros(places.shape, dtype=np.int64) for places in allowed]
        asked: dict[float, list[tuple[int, int]]] = {}
        for group, yaws in enumerate(yaws_deg):
            for at, yaw_deg in enumerate(yaws):
                asked.setdefault(round(yaw_deg, 9), []).append((group, at))
        fours = self._fours(factor)
        for yaw_deg, askers in asked.items():
            seen = self._laid(fours, yaw_deg, factor)
            overlaps = Overlaps.over(seen, mapped[0], places=allowed[0].shape).picked(self._distinct[1])
            for group, at in askers:
                places, top, turn = allowed[group], high[group], which[group]
                scores = self.score(replace(overlaps, mapped=mapped[group], places=places.shape))
                better = places & (scores > top)
                np.copyto(top, scores, where=better)
                np.copyto(turn, at, where=better)
        return [
            list(self._peaks(*item, yaws))
            for group, tops, turns, yaws in zip(groups, high, which, yaws_deg, strict=True)
            for item in zip(tops, turns, group, strict=True)
        ]

    def _peaks(
        self, high: NDArray[np.float32], which: NDArray[np.int64], tile: "_Tile", yaws_deg: Sequence[float]
    ) -> Iterator[Mode]:
        left = high.copy()
        for _ in range(self.plan.refined):
            at = np.unravel_index(int(left.argmax()), left.shape)
            if not left[at] > _LOW:
                return
            east_m, north_m = tile.points_m[at].tolist()
            pose = Pose(easting_m=east_m, northing_m=north_m, yaw_deg=yaws_deg[int(which[at])])
            yield Mode(pose=pose, score=float(left[at]))
            left[self.plan.apart_m > np.hypot(*(tile.points_m - (east_m, north_m)).T).T] = _LOW

    @cached_property
    def _distinct(self) -> tuple[NDArray[np.float32], NDArray[np.int64]]:
        """Return the channels that differ, and which of them each channel is."""
        at = {channel.tobytes(): index for index, channel in enumerate(self.channels)}
        chosen = sorted(at.values())
        which = [chosen.index(at[channel.tobytes()]) for channel in self.channels]
        return self.channels[chosen], np.array(which, dtype=np.int64)

    def _fours(self, factor: int) -> NDArray[np.float32]:
        """Return the channels that differ, by fours, averaged over squares as large as a cell."""
        fours = by_fours(self._distinct[0])
        size = 2 * round((factor * self.chart.grid.cell_size_m / self.cell_size_m - 1) / 2) + 1
        if size <= 1:
            return fours
        return np.stack([cv2.blur(four, (size, size), borderType=cv2.BORDER_CONSTANT) for four in fours])

    def _laid(self, fours: NDArray[np.float32], yaw_deg: float, factor: int) -> NDArray[np.float32]:
        """Resample a view onto a north-up lattice around its middle, means over its cells, shape (D, side, side)."""
        step_m, half = factor * self.chart.grid.cell_size_m, self._half(factor)
        side, reach_m = 2 * half + 1, (half + 0.5) * step_m
        around = Grid(epsg=0, west_m=-reach_m, north_m=reach_m, cell_size_m=step_m, rows=side, cols=side)
        rows, cols = self.channels.shape[1:]
        frame = Grid(
            epsg=0,
            west_m=-cols * self.cell_size_m / 2,
            north_m=rows * self.cell_size_m / 2,
            cell_size_m=self.cell_size_m,
            rows=rows,
            cols=cols,
        )
        to_view = between(around, inverse(Pose(easting_m=0.0, northing_m=0.0, yaw_deg=yaw_deg)), frame)
        return bands_of(np.stack([warped(four, to_view, around.shape) for four in fours]), len(self._distinct[0]))

    def _refined(self, modes: Sequence[Mode], disc: Disc) -> list[Mode]:
        """Return the best mode near each, on fine cells."""
        if not modes:
            return []
        coarse_m, factor = self.plan.coarse_m, self._factor(self.plan.fine_m)
        tiles = [self._around(place_m(mode.pose), coarse_m, factor, disc.wider(coarse_m)) for mode in modes]
        offsets_deg = self.plan.yaw_step_deg / _STEPS * np.arange(-_STEPS, _STEPS + 1)
        yaws_deg = [(mode.pose.yaw_deg + offsets_deg).tolist() for mode in modes]
        # By heading, so that of equal scores each has that of its first heading, whoever shares it
        order = sorted(range(len(modes)), key=lambda at: yaws_deg[at])
        found = self._best_of([[tiles[at]] for at in order], factor, [yaws_deg[at] for at in order])
        best = dict(zip(order, found, strict=True))
        return [best[at][0] if best[at] else replace(mode, score=_LOW) for at, mode in enumerate(modes)]


@dataclass(frozen=True, kw_only=True)
class _Tile:
    """Square of places, the transformed map under all views from there, and which places are searched."""

    mapped: Spectra
    points_m: NDArray[np.float64]
    allowed: NDArray[np.bool_]


def _ranked(modes: "Iterator[Mode] | Sequence[Mode]") -> list[Mode]:
    """Sort modes, best first; ties keep their order, and what has no score is left out."""
    return sorted((mode for mode in modes if mode.score > _LOW), key=lambda mode: -mode.score)


_HALF_TURN: Final = 2  # right angles


def around_of(template: Template, grid: Grid, turns: Turns) -> Grid:
    """Return cells of a level around the middle of a view, as many as its largest scale and any heading need."""
    step_m, largest = grid.cell_size_m, max(base.scale for base in turns.bases)
    half = math.ceil(template.reach_m * largest / step_m) + 1
    reach_m, side = (half + 0.5) * step_m, 2 * half + 1
    return Grid(epsg=0, west_m=-reach_m, north_m=reach_m, cell_size_m=step_m, rows=side, cols=side)


def squares_across(template: Template, grid: Grid) -> int:
    """Return how many cells of a view make the side of a square to be resampled onto a level."""
    # 3 squares of the view across a coarse cell before rotation: odd, so that nothing is shifted
    return max(1, round(grid.cell_size_m / template.cell_size_m / 3))


def blur_width(frame: Grid, grid: Grid) -> int:
    """Return how many squares of a view, an odd number, are averaged before they are resampled onto a level."""
    return 2 * math.floor(grid.cell_size_m / frame.cell_size_m / 2) + 1


@dataclass(frozen=True, kw_only=True)
class Correlation:
    """Transforms of the map under each tile, as it is and turned by a right angle, and the template to correlate.

    `bands` of the view on `frame` are resampled onto `around`, cells of the level around its middle. A template is
    transformed once for up to `quarters` headings at right angles to each other.
    """

    bands: NDArray[np.float32]
    frame: Grid
    around: Grid
    size: int
    quarters: int
    shapes: tuple[tuple[int, int], ...]
    spectra: tuple[tuple[NDArray[np.complex64], ...], ...]

    @classmethod
    def of(cls, level: Level, template: Template, tiles: Sequence[Tile], turns: Turns) -> Self:
        """Transform the windows of all tiles once, padded by the reach of the largest template."""
        around = around_of(template, level.grid, turns)
        half = around.rows // 2
        shapes = tuple((tile.allowed.shape[0], tile.allowed.shape[1]) for tile in tiles)
        size = int(fft.next_fast_len(max(max(shape) for shape in shapes) + 2 * half, real=True))
        windows = [
            level.window(tile.row - half, tile.col - half, (rows + 2 * half, cols + 2 * half), template.active)
            for tile, (rows, cols) in zip(tiles, shapes, strict=True)
        ]
        is_used = [any(window[at].any() for window in windows) for at in range(len(template.active))]
        used = np.flatnonzero(is_used) if any(is_used) else np.arange(1)
        spectra = []
        for window in windows:
            turned = (np.rot90(window[used], quarter, (1, 2)) for quarter in range(min(turns.quarters, _HALF_TURN)))
            spectra.append(tuple(map_spectrum(each, (size, size)) for each in turned))
        bands, frame = pooled(template, level, squares_across(template, level.grid))
        bands = bands[used]  # classes that the map lacks here add nothing
        width = blur_width(frame, level.grid)
        bands = np.stack([cv2.blur(band, (width, width), borderType=cv2.BORDER_CONSTANT) for band in bands])
        return cls(
            bands=bands,
            frame=frame,
            around=around,
            size=size,
            quarters=turns.quarters,
            shapes=shapes,
            spectra=tuple(spectra),
        )

    def scores(self, base: Pose) -> Iterator[tuple[int, Pose, NDArray[np.float32]]]:
        """Score all places of every tile for a heading and those at right angles to it."""
        spectra = self.transformed(base)
        for at in range(len(self.shapes)):
            for quarter in range(self.quarters):
                yield at, replace(base, yaw_deg=base.yaw_deg + 90 * quarter), self.score(spectra, at, quarter)

    def transformed(self, base: Pose) -> tuple[NDArray[np.complex64], NDArray[np.complex64]]:
        """Transform the template at the heading and scale of a pose; the second one reads it backwards."""
        # The rows below the template are zeros: half of the work is never done.
        spectrum = fft.fft(fft.rfft(self._laid(base), n=self.size), n=self.size, axis=-2)
        return spectrum, np.conj(spectrum)

    def score(
        self, spectra: tuple[NDArray[np.complex64], NDArray[np.complex64]], at: int, quarter: int
    ) -> NDArray[np.float32]:
        """Score all places of a tile at some right angles from the heading of a transformed template."""
        # A template turned by half a turn is read backwards: the result is shifted by its last cell.
        halves, turned = divmod(quarter, _HALF_TURN)
        first = halves * (self.around.rows - 1)
        high, wide = self.shapes[at][::-1] if turned else self.shapes[at]
        score = correlated(self.spectra[at][turned], spectra[halves], (self.size, self.size))
        return np.ascontiguousarray(np.rot90(score[first : first + high, first : first + wide], -turned))

    def _laid(self, base: Pose) -> NDArray[np.float32]:
        """Resample the view onto cells of the level, rotated and scaled; sums are preserved."""
        to_view = between(self.around, inverse(base), self.frame)
        laid = np.stack([warped(band, to_view, self.around.shape) for band in self.bands])
        return laid * np.float32((self.around.cell_size_m / (base.scale * self.frame.cell_size_m)) ** 2)
