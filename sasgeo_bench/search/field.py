# SPDX-License-Identifier: Apache-2.0
"""Map fields and view templates: the linear form of Eqs. 7-8 of the SASGeo paper, in cells of any size."""

import math
from collections.abc import Iterable
from dataclasses import dataclass, field, replace
from functools import cached_property, reduce
from typing import Final, Protocol, Self, TypeVar

import cv2
import numpy as np
from numpy.typing import NDArray

from sasgeo_bench.core.errors import ShapeError
from sasgeo_bench.geometry.grid import Grid
from sasgeo_bench.geometry.pose import Pose

FULL: Final = 255  # of a field: the class is certain

_AXES: Final = 3
_NOTHING: Final = 1e-9
Value = TypeVar("Value", np.float32, np.uint8)

FOUR: Final = 4  # bands that lie together: OpenCV resamples four at once in a tenth of the time that five take


@dataclass(frozen=True, kw_only=True)
class Cells:
    """Bands of a raster, by fours.

    `fours` is uint8 of shape (G, rows, cols, 4): band b is `fours[b // 4, :, :, b % 4]`, and those from `count` on are
    0. Bands of a cell lie together, since a search reads them together.

    Examples
    --------
    >>> cells = Cells.zeros(5, (2, 3))
    >>> cells.band(4)[1, 2] = 7
    >>> cells.fours.shape, cells.fours[1, 1, 2].tolist(), cells.cut(1, 2, (1, 1)).band(4).tolist()
    ((2, 2, 3, 4), [7, 0, 0, 0], [[7]])
    """

    fours: NDArray[np.uint8]
    count: int

    @classmethod
    def zeros(cls, count: int, shape: tuple[int, int]) -> Self:
        """Return bands of zeros, to be filled."""
        return cls(fours=np.zeros((fours_of(count), *shape, FOUR), dtype=np.uint8), count=count)

    @property
    def shape(self) -> tuple[int, int]:
        """Return rows and columns."""
        return self.fours.shape[1], self.fours.shape[2]

    def band(self, at: int) -> NDArray[np.uint8]:
        """Return a band, shape (rows, cols): a view."""
        return self.fours[at // FOUR, :, :, at % FOUR]

    def cut(self, row: int, col: int, shape: tuple[int, int]) -> Self:
        """Return a window: a view."""
        return replace(self, fours=self.fours[:, row : row + shape[0], col : col + shape[1]])

    def under(self, to_cells: NDArray[np.float64], shape: tuple[int, int]) -> Self:
        """Resample all bands linearly, 0 beyond the raster; `to_cells` from `between`."""
        fours = np.empty((len(self.fours), *shape, FOUR), dtype=np.uint8)
        for into, four in zip(fours, self.fours, strict=True):
            warped(four, to_cells, shape, into=into)
        return replace(self, fours=fours)


def fours_of(count: int) -> int:
    """Return in how many fours so many bands lie."""
    return -(-count // FOUR)


def by_fours(bands: NDArray[Value]) -> NDArray[Value]:
    """Return bands, shape (B, rows, cols), by fours, shape (G, rows, cols, 4), with zeros in place of missing ones.

    >>> fours = by_fours(np.arange(10.0, dtype=np.float32).reshape(5, 1, 2))
    >>> fours.shape, fours[1, 0, 0].tolist(), bands_of(fours, 5)[4].tolist()
    ((2, 1, 2, 4), [8.0, 0.0, 0.0, 0.0], [[8.0, 9.0]])
    """
    fours = np.zeros((fours_of(len(bands)), *bands.shape[1:], FOUR), dtype=bands.dtype)
    for at, band in enumerate(bands):
        fours[at // FOUR, :, :, at % FOUR] = band
    return fours


def bands_of(fours: NDArray[Value], count: int) -> NDArray[Value]:
    """Return the first bands of fours, one after the other."""
    return fours.transpose(0, 3, 1, 2).reshape(-1, *fours.shape[1:3])[:count]


@dataclass(frozen=True, kw_only=True)
class Level:
    """A field in cells of `factor` of its own, with thin classes spread by one cell.

    `cells` has K + 1 bands, the last one known cells. `thinner`, shape (K + 1,), is the area of each class over its
    spread area, 1 without spreading.
    """

    factor: int
    grid: Grid
    cells: Cells
    thinner: NDArray[np.float64]

    def window(self, row: int, col: int, shape: tuple[int, int], bands: NDArray[np.int64]) -> NDArray[np.float32]:
        """Cut a window of some bands, 0..1, zeros beyond the map; shape (len(bands), *shape)."""
        cut = np.zeros((len(bands), *shape), dtype=np.float32)
        top, left = max(row, 0), max(col, 0)
        bottom, right = min(row + shape[0], self.grid.rows), min(col + shape[1], self.grid.cols)
        if top < bottom and left < right:
            inside = np.s_[top - row : bottom - row, left - col : right - col]
            for into, at in zip(cut, bands.tolist(), strict=True):
                into[inside] = self.cells.band(at)[top:bottom, left:right]
        cut /= FULL
        return cut


class Levels(Protocol):
    """What a search needs of a map: its own cells, and itself in larger ones."""

    @property
    def grid(self) -> Grid:
        """Return the map's own cells."""
        ...

    def level(self, factor: int) -> Level:
        """Return the map in cells of `factor` of its own a side."""
        ...


@dataclass(frozen=True, kw_only=True)
class Field:
    """Layers of a map for the bands of a template.

    `cells` are the degrees to which the map holds each of K classes, 0..FULL; 0 where it is unknown. The last band,
    K, is FULL where the map is known, else 0. Beyond the grid it is unknown.

    Raises
    ------
    ShapeError
        If shapes or types do not fit.
    """

    grid: Grid
    cells: Cells
    _levels: dict[int, Level] = field(default_factory=dict, init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        """Check shape and type; lock the cells."""
        fours, shape = self.cells.fours, (fours_of(self.cells.count), *self.grid.shape, FOUR)
        if fours.shape != shape or fours.dtype != np.uint8:
            raise ShapeError(f"a field has cells of {shape} in uint8, got {fours.shape} in {fours.dtype}")
        fours.flags.writeable = False

    @classmethod
    def of(cls, *, grid: Grid, layers: NDArray[np.uint8], known: NDArray[np.uint8]) -> Self:
        """Return the field of layers, shape (K, rows, cols), and of known cells, (rows, cols); raise `ShapeError`."""
        shapes = (layers.shape, known.shape)
        if layers.ndim != _AXES or not layers.shape[1:] == known.shape == grid.shape:
            raise ShapeError(f"a field has layers (K, rows, cols) and known (rows, cols), {grid.shape}, got {shapes}")
        if not layers.dtype == known.dtype == np.uint8:
            raise ShapeError(f"a field holds uint8, got {layers.dtype} and {known.dtype}")
        cells = Cells.zeros(len(layers) + 1, grid.shape)
        for at, band in enumerate((*layers, known)):
            cells.band(at)[:] = band
        return cls(grid=grid, cells=cells)

    @property
    def layers(self) -> NDArray[np.uint8]:
        """Return the degrees to which the map holds each class, shape (K, rows, cols): a copy."""
        bands = [self.cells.band(at) for at in range(self.cells.count - 1)]
        return np.stack(bands) if bands else np.zeros((0, *self.grid.shape), dtype=np.uint8)

    @property
    def known(self) -> NDArray[np.uint8]:
        """Return FULL where the map is known, else 0, shape (rows, cols): a view of the cells."""
        return self.cells.band(self.cells.count - 1)

    def add_levels(self, made: Iterable[Level]) -> None:
        """Take levels that were made of it before, as `level` makes them."""
        self._levels.update({level.factor: level for level in made})

    def level(self, factor: int) -> Level:
        """Return the map in cells of `factor` of its own a side; each level is made once."""
        if factor not in self._levels:
            self._levels[factor] = _level(self, factor)
        return self._levels[factor]


@dataclass(frozen=True, kw_only=True)
class Template:
    """Weights of a view for each class and cell: the linear form of Eqs. 7-8.

    The score of a pose sums `weights * layers + known * (map is known)` over the cells of the view, with the map
    interpolated linearly at their centres; `weights` have shape (K, rows, cols), `known` (rows, cols). With gains l+
    for seen and mapped, l- for seen and not mapped, l0 for mapped and seen to be absent, `weights` is (l+ + l-)
    z_present - l0 z_absent, and `known` the sum over classes of -l- z_present. Unknown cells are 0 in both.

    Raises
    ------
    ShapeError
        If shapes do not fit, or a weight is not finite.
    """

    weights: NDArray[np.float32]
    known: NDArray[np.float32]
    cell_size_m: float

    def __post_init__(self) -> None:
        if self.weights.ndim != _AXES or self.weights.shape[1:] != self.known.shape:
            shapes = (self.weights.shape, self.known.shape)
            raise ShapeError(f"a template has weights (K, rows, cols) and known (rows, cols), got {shapes}")
        if not (np.isfinite(self.weights).all() and np.isfinite(self.known).all()):
            raise ShapeError("the weights of a template must be finite: correct the rates they were made of")

    @property
    def side_m(self) -> float:
        """Return the longer side at scale 1, metres."""
        return float(max(self.known.shape) * self.cell_size_m)

    @property
    def reach_m(self) -> float:
        """Return half a diagonal at scale 1, metres."""
        return math.hypot(*self.known.shape) * self.cell_size_m / 2

    @cached_property
    def bands(self) -> NDArray[np.float32]:
        """Return weights and, last, factors of known cells; shape (K + 1, rows, cols)."""
        return np.concatenate((self.weights, self.known[None])).astype(np.float32, copy=False)

    @cached_property
    def active(self) -> NDArray[np.int64]:
        """Return indices of bands that are not all 0."""
        return np.flatnonzero(self.bands.any(axis=(1, 2)))


def _level(field: Field, factor: int) -> Level:
    """Spread each thin class by a large cell, then average."""
    grid, own = field.grid.coarsen(factor), field.cells
    if factor == 1:
        return Level(factor=1, grid=grid, cells=own, thinner=np.ones(own.count))
    kernel, cells = round_kernel(factor), Cells.zeros(own.count, grid.shape)
    grown = [dilated(four, kernel) for four in own.fours]
    before, after = (np.concatenate([cv2.sumElems(four) for four in fours]) for fours in (own.fours, grown))
    thinner = thinner_of(before[: own.count], after[: own.count])
    thin = np.resize(thinner < 1, len(grown) * FOUR).reshape(-1, FOUR)  # spare bands are zeros either way
    for into, four, spread, chosen in zip(cells.fours, own.fours, grown, thin, strict=True):
        into[:] = averaged(np.where(chosen, spread, four), factor)
    return Level(factor=factor, grid=grid, cells=cells, thinner=thinner)


def averaged(four: NDArray[np.uint8], factor: int) -> NDArray[np.uint8]:
    """Return means of squares of cells, those at the edge with zeros beyond it."""
    rows, cols = (-(-side // factor) for side in four.shape[:2])
    padded = np.pad(four, ((0, -four.shape[0] % factor), (0, -four.shape[1] % factor), (0, 0)))
    return np.asarray(cv2.resize(padded, (cols, rows), interpolation=cv2.INTER_AREA), dtype=np.uint8)


def thinner_of(before: NDArray[np.float64], after: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the `Level.thinner` of bands from their sums as they are and spread; the last one, known cells, is 1."""
    # A coarse pose may be off by a cell, which misses lines and houses but hardly woods and fields. Spread woods would
    # outscore the right place, so a class that grows little stays unchanged.
    share = before / np.maximum(after, 1.0)
    share[-1] = 1.0
    return np.where(share < 0.5, share, 1.0)  # 0.5: share of its spread area below which a class counts as thin


_MANY: Final = 8  # cells of a radius from which a kernel costs less row by row


def dilated(band: NDArray[np.uint8], kernel: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Return the largest value under a `round_kernel` around each cell of a band, or of four, as `cv2.dilate` does.

    A large kernel costs less row by row: its rows are runs, and a wider run is a run of the next narrower one.

    Examples
    --------
    >>> dot = np.zeros((41, 41), dtype=np.uint8)
    >>> dot[20, 20] = 1
    >>> np.array_equal(dilated(dot, round_kernel(16))[4:37, 4:37], round_kernel(16))
    True
    """
    reach, rows = len(kernel) // 2, len(band)
    if reach < _MANY:
        return np.asarray(cv2.dilate(band, kernel), dtype=np.uint8)
    run, width, grown = np.pad(band, ((reach, reach), *[(0, 0)] * (band.ndim - 1))), 1, np.zeros_like(band)
    for down, wider in enumerate(kernel[: reach + 1].sum(axis=1, dtype=int).tolist(), start=-reach):
        if wider > width:
            run, width = np.asarray(cv2.dilate(run, np.ones((1, wider - width + 1), dtype=np.uint8))), wider
        for shift in {down, -down} if wider else ():
            cv2.max(grown, run[reach + shift : reach + shift + rows], dst=grown)
    return grown


def round_kernel(radius: float) -> NDArray[np.uint8]:
    """Return a round kernel."""
    reach = math.ceil(radius)
    squares = np.arange(-reach, reach + 1) ** 2
    return (squares[:, None] + squares <= radius**2 + _NOTHING).astype(np.uint8)


def _softened(template: Template, level: Level) -> NDArray[np.float32]:
    """Return bands for spread classes: no loss near gains, elsewhere losses reduced by the growth of the class."""
    bands = template.bands[template.active]
    if level.factor == 1:
        return bands
    kernel = round_kernel(level.grid.cell_size_m / template.cell_size_m)
    for band, at in zip(bands, template.active.tolist(), strict=True):
        if level.thinner[at] < 1:
            near = dilated((band > 0).astype(np.uint8), kernel) > 0
            band[band < 0] *= level.thinner[at]
            band[(band < 0) & near] = 0
    return bands


def pooled(template: Template, level: Level, pool: int) -> tuple[NDArray[np.float32], Grid]:
    """Return the bands for a level summed over squares of view cells, and the lattice of the squares."""
    return squares(_softened(template, level), pool, cell_size_m=template.cell_size_m)


def squares(bands: NDArray[np.float32], pool: int, *, cell_size_m: float) -> tuple[NDArray[np.float32], Grid]:
    """Return bands of a view, shape (B, rows, cols), summed over squares of `pool` cells a side, and their lattice.

    The origin of the lattice is the middle of the view, right and up are its east and north.

    Examples
    --------
    >>> summed, frame = squares(np.ones((1, 4, 4), np.float32), 2, cell_size_m=1.0)
    >>> summed[0].tolist(), frame.bounds_m
    ([[4.0, 4.0], [4.0, 4.0]], (-2.0, -2.0, 2.0, 2.0))
    """
    rows, cols = bands.shape[1:]
    down, across = -rows % pool, -cols % pool
    around = ((0, 0), (down // 2, down - down // 2), (across // 2, across - across // 2))
    padded = np.pad(bands, around) if down or across else bands
    high, wide = padded.shape[1] // pool, padded.shape[2] // pool
    summed = _summed(padded.reshape(len(bands), high, pool, wide, pool))
    frame = Grid(
        epsg=0,
        west_m=-(cols / 2 + across // 2) * cell_size_m,
        north_m=(rows / 2 + down // 2) * cell_size_m,
        cell_size_m=cell_size_m * pool,
        rows=summed.shape[1],
        cols=summed.shape[2],
    )
    return np.ascontiguousarray(summed), frame


def _summed(parts: NDArray[np.float32]) -> NDArray[np.float32]:
    """Sum over the third and the last axis, as numpy does to the last bit, in a tenth of its time."""
    pool = parts.shape[-1]
    if pool >= 8:  # where numpy sums in another order, and is as fast
        return np.asarray(parts.sum(axis=(2, 4)))
    across = reduce(np.add, (parts[..., at] for at in range(pool)))
    return np.asarray(reduce(np.add, (across[:, :, at] for at in range(pool))))


def between(frame: Grid, pose: Pose, grid: Grid) -> NDArray[np.float64]:
    """Return the affine map, shape (2, 3), from columns and rows of a view to those of a map; centres are whole."""
    # In plain numbers: a search asks for it at every pose that it tries
    yaw, cell_m = math.radians(pose.yaw_deg), grid.cell_size_m
    cosine, sine = pose.scale * math.cos(yaw), pose.scale * math.sin(yaw)
    right_m, up_m = frame.west_m + frame.cell_size_m / 2, frame.north_m - frame.cell_size_m / 2  # of the first cell
    col = (pose.easting_m + cosine * right_m + sine * up_m - grid.west_m) / cell_m - 0.5
    row = (grid.north_m - pose.northing_m + sine * right_m - cosine * up_m) / cell_m - 0.5
    step = frame.cell_size_m / cell_m
    return np.array([[step * cosine, -step * sine, col], [step * sine, step * cosine, row]])


def warped(
    layer: NDArray[Value],
    to_layer: NDArray[np.float64],
    shape: tuple[int, int],
    *,
    into: NDArray[Value] | None = None,
) -> NDArray[Value]:
    """Resample a raster, (rows, cols) or (rows, cols, bands), linearly, 0 beyond it; `to_layer` from `between`.

    `into`, of the shape and type of the result, is written to.
    """
    flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    if max(layer.shape[:2]) > 32_766:  # 32_766 cells: OpenCV warps no larger raster
        # Part of a raster that lies under a view, and the affine map to it
        far = np.array([(col, row, 1.0) for row in (0, shape[0] - 1) for col in (0, shape[1] - 1)]) @ to_layer.T
        most = np.array(layer.shape[1::-1])
        first = np.clip(np.floor(far.min(axis=0)).astype(np.int64) - 1, 0, most - 1)
        last = np.clip(np.ceil(far.max(axis=0)).astype(np.int64) + 2, first + 1, most)
        moved = to_layer - np.column_stack((np.zeros((2, 2)), first))
        layer, to_layer = layer[first[1] : last[1], first[0] : last[0]], moved
    return np.asarray(cv2.warpAffine(layer, to_layer, shape[::-1], dst=into, flags=flags), dtype=layer.dtype)
