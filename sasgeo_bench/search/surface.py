# SPDX-License-Identifier: Apache-2.0
"""Surface of scores: a view at every cell of a disc and at every heading, for filters that keep a belief on a grid."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from sasgeo_bench.errors import PoseError
from sasgeo_bench.geometry.grid import Grid
from sasgeo_bench.geometry.pose import Pose, normalize_deg
from sasgeo_bench.search.correlation import Correlation
from sasgeo_bench.search.field import Field, Template
from sasgeo_bench.search.plan import Disc, Mode, Tile, Turns, tiles_of

_RIGHT_DEG: Final = 90.0
_CIRCLE_DEG: Final = 360.0


@dataclass(frozen=True, kw_only=True)
class Surface:
    """Scores of a view at the centres of cells and at some headings.

    Parameters
    ----------
    grid : Grid
        The cells, north up: a part of the map's grid, or of that grid in larger cells.
    yaws_deg : ndarray of float64, shape (Y,)
        Headings of the view's up direction, degrees clockwise from grid north, [0, 360), in the order asked for.
    scores : ndarray of float32, shape (Y, rows, cols)
        Score of the view with its middle at the centre of each cell: a sum of logarithms of likelihood ratios.
    """

    grid: Grid
    yaws_deg: NDArray[np.float64]
    scores: NDArray[np.float32]

    @property
    def best(self) -> Mode:
        """Return the pose of the highest score."""
        yaw, row, col = np.unravel_index(int(self.scores.argmax()), self.scores.shape)
        easting_m, northing_m = self.grid.to_centres_m(np.array([(row, col)]))[0].tolist()
        pose = Pose(easting_m=easting_m, northing_m=northing_m, yaw_deg=float(self.yaws_deg[yaw]))
        return Mode(pose=pose, score=float(self.scores[yaw, row, col]))


def surface(
    field: Field,
    template: Template,
    *,
    center_m: tuple[float, float],
    radius_m: float,
    yaws_deg: ArrayLike,
    factor: int = 1,
    scale: float = 1.0,
) -> Surface:
    """Score a view at every cell around a place and at every heading, by correlation in the Fourier domain.

    Headings at right angles to each other share their work: a full circle in steps that divide 90 degrees costs least.

    Parameters
    ----------
    field, template : Field, Template
        The map and the view. The map's levels are kept in the field, so one field serves all views.
    center_m : tuple of float
        Easting and northing of the middle of the disc, metres.
    radius_m : float
        Radius of the disc. Scored are all cells of its bounding square that are on the map.
    yaws_deg : array-like, shape (Y,)
        Headings of the view's up direction, degrees clockwise from grid north.
    factor : int
        Side of a scored cell in cells of the field. On larger cells thin classes are spread, so that a place between
        two centres is not missed, and scores are lower than on the map's own cells.
    scale : float
        Scale of the view.

    Returns
    -------
    Surface
        Scores as of `Template`, cell by cell and heading by heading.

    Raises
    ------
    PoseError
        If no heading is given, a number is not finite or not positive, or the square does not meet the map.

    Examples
    --------
    A view cut out of the map and turned by a right angle is found again, in place and heading:

    >>> rng = np.random.default_rng(0)
    >>> town = np.where(rng.random((1, 64, 64)) < 0.1, 255, 0).astype(np.uint8)
    >>> grid = Grid(epsg=32632, west_m=0.0, north_m=64.0, cell_size_m=1.0, rows=64, cols=64)
    >>> field = Field.of(grid=grid, layers=town, known=np.full((64, 64), 255, np.uint8))
    >>> seen = np.rot90(town[:, 20:51, 10:41] / np.float32(255), axes=(1, 2))
    >>> view = Template(weights=2 * seen - 0.5, known=-seen[0], cell_size_m=1.0)
    >>> scored = surface(field, view, center_m=(28.0, 30.0), radius_m=8.0, yaws_deg=[0, 90, 180, 270])
    >>> scored.scores.shape, scored.best.pose
    ((4, 17, 17), Pose(easting_m=25.5, northing_m=28.5, yaw_deg=90.0, scale=1.0))
    """
    yaws = np.atleast_1d(normalize_deg(yaws_deg))
    if not (yaws.ndim == 1 and len(yaws) and np.isfinite(yaws).all()):
        raise PoseError(f"yaws_deg must be at least one finite heading in a row, got an array of shape {yaws.shape}")
    is_finite = all(map(math.isfinite, (*center_m, radius_m, scale)))
    if not (is_finite and radius_m >= 0 and scale > 0):
        raise PoseError(
            "center_m must be finite, radius_m at least 0 and scale positive, "
            f"got {center_m!r}, {radius_m!r} and {scale!r}"
        )
    level = field.level(factor)
    tiles = tiles_of(level.grid, field.grid, Disc(center_m=center_m, radius_m=radius_m))
    if not tiles:
        raise PoseError(
            f"the square of {radius_m!r} m around {center_m!r} does not meet the map, {field.grid.bounds_m!r}"
        )
    # Cells of all tiles, of which the first one is at the top left
    bottom, right = (max(first + side for first, side in _sides(tiles, axis)) for axis in (0, 1))
    grid = level.grid.window(tiles[0].row, tiles[0].col, bottom - tiles[0].row, right - tiles[0].col)
    scores = np.zeros((len(yaws), *grid.shape), dtype=np.float32)
    if len(template.active):
        headings = _Headings.of(yaws, scale)
        votes = Correlation.of(level, template, tiles, headings.turns)
        for base, pose in enumerate(headings.turns.bases):
            spectra = votes.transformed(pose)
            for yaw, quarter in headings.members(base):
                for at, tile in enumerate(tiles):
                    _part(scores[yaw], tiles[0], tile)[:] = votes.score(spectra, at, quarter)
    scores.flags.writeable = False
    return Surface(grid=grid, yaws_deg=yaws, scores=scores)


def _sides(tiles: Sequence[Tile], axis: int) -> list[tuple[int, int]]:
    return [((tile.row, tile.col)[axis], tile.allowed.shape[axis]) for tile in tiles]


def _part(scores: NDArray[np.float32], first: Tile, tile: Tile) -> NDArray[np.float32]:
    (rows, cols), row, col = tile.allowed.shape, tile.row - first.row, tile.col - first.col
    return scores[row : row + rows, col : col + cols]


@dataclass(frozen=True, kw_only=True)
class _Headings:
    """Headings by those that are at right angles to each other.

    `base` and `quarter`, shape (Y,), are the base pose of each heading and the right angles between the two.
    """

    turns: Turns
    base: NDArray[np.int64]
    quarter: NDArray[np.int64]

    @classmethod
    def of(cls, yaws_deg: NDArray[np.float64], scale: float) -> Self:
        """Group headings, beginning after the widest gap: a sector below 90 degrees then needs one transformed map."""
        ordered = np.sort(yaws_deg)
        gaps_deg = np.diff(ordered, prepend=ordered[-1] - _CIRCLE_DEG)
        start_deg = ordered[gaps_deg.argmax()]
        offset_deg = np.mod(yaws_deg - start_deg + 1e-7, _CIRCLE_DEG)  # degrees: closer headings are the same one
        quarter = (offset_deg // _RIGHT_DEG).astype(np.int64)
        rest_deg, base = np.unique((offset_deg - _RIGHT_DEG * quarter).round(6), return_inverse=True)
        poses = (
            Pose(easting_m=0.0, northing_m=0.0, yaw_deg=start_deg + rest, scale=scale) for rest in rest_deg.tolist()
        )
        turns = Turns(bases=tuple(poses), quarters=int(quarter.max()) + 1, yaw_step_deg=0.0, scale_step=0.0)
        return cls(turns=turns, base=base, quarter=quarter)

    def members(self, base: int) -> list[tuple[int, int]]:
        return [(int(yaw), int(self.quarter[yaw])) for yaw in np.flatnonzero(self.base == base)]
