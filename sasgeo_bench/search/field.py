# SPDX-License-Identifier: Apache-2.0
"""What a map gives and what a view asks: the linear form of Eqs. 7-8 of the SASGeo paper, in cells of any size."""

import math
from dataclasses import dataclass, field
from functools import cached_property
from typing import Final, TypeVar

import cv2
import numpy as np
from numpy.typing import NDArray

from sasgeo_bench.errors import ShapeError
from sasgeo_bench.geometry.grid import Grid
from sasgeo_bench.geometry.pose import Pose

FULL: Final = 255  # of a field: the map has it for certain

_AXES: Final = 3
_THIN: Final = 0.5  # of what a class covers once it is spread: a class of less before is lines or small things
_NOTHING: Final = 1e-9
Value = TypeVar("Value", np.float32, np.uint8)


@dataclass(frozen=True, kw_only=True)
class Level:
    """A field in cells of `factor` of its own, thin classes spread by one: what is near counts as there.

    `cells` is uint8 of shape (rows, cols, K + 1), the last band what is known: all bands of a cell lie together, for
    they are read together. `thinner`, shape (K + 1,), is the share of the spread area that each class had before, 1
    where it is not spread.
    """

    factor: int
    grid: Grid
    cells: NDArray[np.uint8]
    thinner: NDArray[np.float64]

    def window(self, row: int, col: int, shape: tuple[int, int], bands: NDArray[np.int64]) -> NDArray[np.float32]:
        """Cut some bands, 0..1, zeros beyond the map; shape (len(bands), *shape)."""
        cut = np.zeros((len(bands), *shape), dtype=np.float32)
        top, left = max(row, 0), max(col, 0)
        bottom, right = min(row + shape[0], self.grid.rows), min(col + shape[1], self.grid.cols)
        if top < bottom and left < right:
            under = np.moveaxis(self.cells[top:bottom, left:right], -1, 0)
            cut[:, top - row : bottom - row, left - col : right - col] = under[bands]
        cut /= FULL
        return cut


@dataclass(frozen=True, kw_only=True)
class Field:
    """What a map gives to each band of a template.

    Parameters
    ----------
    grid : Grid
        Lattice of the map.
    layers : ndarray of uint8, shape (K, rows, cols)
        To what degree the map holds each class, 0..FULL; 0 where nothing is known.
    known : ndarray of uint8, shape (rows, cols)
        FULL where the map says anything, 0 where it does not. Beyond the grid nothing is known.

    Raises
    ------
    ShapeError
        If shapes or types do not fit.

    Examples
    --------
    >>> grid = Grid(epsg=32632, west_m=0.0, north_m=4.0, cell_size_m=1.0, rows=4, cols=4)
    >>> town = Field(grid=grid, layers=np.zeros((2, 4, 4), np.uint8), known=np.full((4, 4), FULL, np.uint8))
    >>> town.level(2).cells.shape
    (2, 2, 3)
    """

    grid: Grid
    layers: NDArray[np.uint8]
    known: NDArray[np.uint8]
    _levels: dict[int, Level] = field(default_factory=dict, init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        """Refuse what is no field; lock the arrays."""
        shapes = (self.layers.shape, self.known.shape)
        if self.layers.ndim != _AXES or not self.layers.shape[1:] == self.known.shape == self.grid.shape:
            message = f"a field has layers (K, rows, cols) and known (rows, cols), {self.grid.shape}, got {shapes}"
            raise ShapeError(message)
        if self.layers.dtype != np.uint8 or self.known.dtype != np.uint8:
            message = f"a field holds uint8, got {self.layers.dtype} and {self.known.dtype}"
            raise ShapeError(message)
        self.layers.flags.writeable = False
        self.known.flags.writeable = False

    def level(self, factor: int) -> Level:
        """Read the map in cells of `factor` of its own a side; each level is made once."""
        if factor not in self._levels:
            self._levels[factor] = _level(self, factor)
        return self._levels[factor]


@dataclass(frozen=True, kw_only=True)
class Template:
    """What a view gives for each class and cell: the linear form of Eqs. 7-8.

    A pose scores the sum over the cells of the view of `weights * layers + known * (whether the map knows)`, the map
    read under the middle of each cell, linearly between its own. With gains l+ for seen and mapped, l- for seen and not
    mapped, l0 for mapped and seen to be absent, `weights` is (l+ + l-) z_present - l0 z_absent, and `known` the sum
    over classes of -l- z_present. What is unknown is 0 in both.

    Parameters
    ----------
    weights : ndarray of float32, shape (K, rows, cols)
        What the map's class is worth at each cell of the view.
    known : ndarray of float32, shape (rows, cols)
        What it is worth that the map knows anything there.
    cell_size_m : float
        Metres a side of a cell of the view, for scale 1.

    Raises
    ------
    ShapeError
        If shapes do not fit, or a weight is not finite.

    Examples
    --------
    >>> seen = Template(weights=np.ones((1, 2, 2), np.float32), known=np.zeros((2, 2), np.float32), cell_size_m=1.0)
    >>> seen.speaking.tolist()
    [0]
    """

    weights: NDArray[np.float32]
    known: NDArray[np.float32]
    cell_size_m: float

    def __post_init__(self) -> None:
        """Refuse what is no template."""
        if self.weights.ndim != _AXES or self.weights.shape[1:] != self.known.shape:
            shapes = (self.weights.shape, self.known.shape)
            message = f"a template has weights (K, rows, cols) and known (rows, cols), got {shapes}"
            raise ShapeError(message)
        if not (np.isfinite(self.weights).all() and np.isfinite(self.known).all()):
            message = "the weights of a template are finite: mend the rates they were made of"
            raise ShapeError(message)

    @property
    def side_m(self) -> float:
        """Longer side at scale 1, metres."""
        return float(max(self.known.shape) * self.cell_size_m)

    @property
    def reach_m(self) -> float:
        """Half a diagonal at scale 1, metres."""
        return math.hypot(*self.known.shape) * self.cell_size_m / 2

    @cached_property
    def bands(self) -> NDArray[np.float32]:
        """Weights and, last, what knowing is worth; shape (K + 1, rows, cols)."""
        return np.concatenate((self.weights, self.known[None])).astype(np.float32, copy=False)

    @cached_property
    def speaking(self) -> NDArray[np.int64]:
        """Bands that say anything at all."""
        return np.flatnonzero(self.bands.any(axis=(1, 2)))


def _level(field: Field, factor: int) -> Level:
    """Spread each thin class by a large cell, then take means."""
    grid = field.grid.coarsen(factor)
    if factor == 1:
        cells = np.stack((*field.layers, field.known), axis=-1)
        return Level(factor=1, grid=grid, cells=cells, thinner=np.ones(cells.shape[-1]))
    kernel = _disc(factor)
    spread = [_spread(band, kernel) for band in field.layers]
    bands, thinner = [*(band for band, _ in spread), field.known], [*(share for _, share in spread), 1.0]
    size, around = (grid.cols, grid.rows), ((0, -field.grid.rows % factor), (0, -field.grid.cols % factor))
    pooled = [cv2.resize(np.pad(band, around), size, interpolation=cv2.INTER_AREA) for band in bands]
    return Level(factor=factor, grid=grid, cells=np.stack(pooled, axis=-1), thinner=np.array(thinner))


def _spread(band: NDArray[np.uint8], kernel: NDArray[np.uint8]) -> tuple[NDArray[np.uint8], float]:
    """Spread a class, and what share of its area it had before.

    What the view shows may lie a cell off, by place and by heading: lines and houses would be missed there. Woods and
    fields hardly would, and with more of them than there is any wood outscores the right place: a class that would not
    grow much stays as it is.
    """
    grown = np.asarray(cv2.dilate(band, kernel), dtype=np.uint8)
    share = float(band.sum(dtype=np.float64) / max(grown.sum(dtype=np.float64), 1.0))
    return (grown, share) if share < _THIN else (band, 1.0)


def _disc(radius: float) -> NDArray[np.uint8]:
    """Kernel of a round spread, cells."""
    reach = math.ceil(radius)
    squares = np.arange(-reach, reach + 1) ** 2
    return (squares[:, None] + squares <= radius**2 + _NOTHING).astype(np.uint8)


def _softened(template: Template, level: Level) -> NDArray[np.float32]:
    """Bands for a map whose thin classes are spread: no blame beside praise, elsewhere as much less as they grew."""
    bands = template.bands[template.speaking]
    if level.factor == 1:
        return bands
    kernel = _disc(level.grid.cell_size_m / template.cell_size_m)
    for band, at in zip(bands, template.speaking.tolist(), strict=True):
        if level.thinner[at] < 1:
            near = cv2.dilate((band > 0).astype(np.uint8), kernel) > 0
            band[band < 0] *= level.thinner[at]
            band[(band < 0) & near] = 0
    return bands


def pooled(template: Template, level: Level, pool: int) -> tuple[NDArray[np.float32], Grid]:
    """Sum the bands for a level over squares of cells of the view, with the lattice of these squares."""
    return squares(_softened(template, level), pool, cell_size_m=template.cell_size_m)


def squares(bands: NDArray[np.float32], pool: int, *, cell_size_m: float) -> tuple[NDArray[np.float32], Grid]:
    """Sum bands of a view, shape (B, rows, cols), over squares of `pool` cells a side, with the lattice of the squares.

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
    summed = padded.reshape(len(bands), high, pool, wide, pool).sum(axis=(2, 4))
    frame = Grid(
        epsg=0,
        west_m=-(cols / 2 + across // 2) * cell_size_m,
        north_m=(rows / 2 + down // 2) * cell_size_m,
        cell_size_m=cell_size_m * pool,
        rows=summed.shape[1],
        cols=summed.shape[2],
    )
    return np.ascontiguousarray(summed), frame


def between(frame: Grid, pose: Pose, grid: Grid) -> NDArray[np.float64]:
    """Affine map, shape (2, 3), from columns and rows of a view's lattice to those of a map's; whole at the middles."""
    corners = frame.to_en_m(np.array([(0.5, 0.5), (1.5, 0.5), (0.5, 1.5)]))
    start, across, down = grid.to_uv(pose.to_map(corners))
    return np.column_stack((across - start, down - start, start - 0.5))


def warped(layer: NDArray[Value], to_layer: NDArray[np.float64], shape: tuple[int, int]) -> NDArray[Value]:
    """Read a raster on another lattice, linearly between its cells, 0 beyond them; `to_layer` as `between` gives it.

    It has a shape of (rows, cols), or (rows, cols, bands).
    """
    flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    return np.asarray(cv2.warpAffine(layer, to_layer, shape[::-1], flags=flags), dtype=layer.dtype)
