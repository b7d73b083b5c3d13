# SPDX-License-Identifier: Apache-2.0
"""Best modes of all places: peaks of the correlations; local refinement of the modes."""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import product
from threading import Lock
from typing import Final, Self

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from sasgeo_bench.core.errors import PoseError
from sasgeo_bench.geometry.grid import Grid
from sasgeo_bench.geometry.pose import Pose, normalize_deg
from sasgeo_bench.search.field import FOUR, FULL, Cells, Field, Level, Levels, Template, between, fours_of, pooled
from sasgeo_bench.search.plan import Disc, Mode, Null, Tile, Turns, in_threads, tiles_of
from sasgeo_bench.search.shifts import Correlation

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
    _check(center_m, radius_m, yaws, scale)
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


def _check(center_m: tuple[float, float], radius_m: float, yaws: NDArray[np.float64], scale: float) -> None:
    if not (yaws.ndim == 1 and len(yaws) and np.isfinite(yaws).all()):
        raise PoseError(f"yaws_deg must be at least one finite heading in a row, got an array of shape {yaws.shape}")
    is_finite = all(map(math.isfinite, (*center_m, radius_m, scale)))
    if not (is_finite and radius_m >= 0 and scale > 0):
        raise PoseError(
            "center_m must be finite, radius_m at least 0 and scale positive, "
            f"got {center_m!r}, {radius_m!r} and {scale!r}"
        )


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


SPARE: Final = 4  # peaks of one heading for each requested mode, since neighbours are dropped
_LOW: Final = np.float32(-1e30)  # score of a place that is not allowed
NEXT: Final = 1.5  # steps within which peaks are neighbours
_NOTHING: Final = 1e-9


def dense(
    level: Level, template: Template, tiles: Sequence[Tile], turns: Turns, *, most: int, threads: int
) -> tuple[list[list[Mode]], Null]:
    """Return the best modes of every tile, no two of them neighbours, and statistics of all places."""
    if not len(template.active) or not any(tile.allowed.any() for tile in tiles):
        return [[] for _ in tiles], Null(best=0.0, mean=0.0, deviation=0.0, places=0)
    votes = Correlation.of(level, template, tiles, turns)
    highest = [np.full(tile.allowed.shape, _LOW, dtype=np.float32) for tile in tiles]
    locks = [Lock() for _ in tiles]

    def peaks_of(base: Pose) -> list[tuple[int, _Peaks]]:
        found = []
        for at, turn, score in votes.scores(base):
            score[~tiles[at].allowed] = _LOW
            with locks[at]:
                np.maximum(highest[at], score, out=highest[at])
            found.append((at, _Peaks.of(score, turn, most=SPARE * most)))
        return found

    with in_threads(threads) as mapped:
        parts = [part for some in mapped(peaks_of, turns.bases) for part in some]
    modes = []
    for at, tile in enumerate(tiles):
        peaks = _Peaks.joined([peaks for owner, peaks in parts if owner == at])
        chosen = peaks.separate(most, turns)
        cells = np.column_stack((peaks.row[chosen] + tile.row, peaks.col[chosen] + tile.col))
        points_m = level.grid.to_centres_m(cells)
        modes.append([peaks.mode(i, point_m) for i, point_m in zip(chosen, points_m.tolist(), strict=True)])
    return modes, _null(np.concatenate([score[tile.allowed] for tile, score in zip(tiles, highest, strict=True)]))


def _null(scores: NDArray[np.float32]) -> Null:
    wide = scores.astype(np.float64)
    return Null(best=float(wide.max()), mean=float(wide.mean()), deviation=float(wide.std()), places=len(wide))


@dataclass(frozen=True, kw_only=True)
class _Peaks:
    """Local maxima of scores: score, row and column of a tile, heading and scale; shape (N,) each."""

    score: NDArray[np.float32]
    row: NDArray[np.int64]
    col: NDArray[np.int64]
    yaw_deg: NDArray[np.float64]
    scale: NDArray[np.float64]

    @classmethod
    def of(cls, score: NDArray[np.float32], turn: Pose, *, most: int) -> Self:
        is_peak = (score == cv2.dilate(score, np.ones((3, 3), dtype=np.uint8))) & (score > _LOW)
        row, col = np.nonzero(is_peak)
        if len(row) > most:
            best = np.sort(np.argpartition(-score[row, col], most)[:most])
            row, col = row[best], col[best]
        same = np.ones(len(row))
        return cls(score=score[row, col], row=row, col=col, yaw_deg=same * turn.yaw_deg, scale=same * turn.scale)

    @classmethod
    def joined(cls, parts: Sequence[Self]) -> Self:
        """Join and sort peaks, best first; ties by place, heading and scale, so that threads change nothing."""
        names = ("score", "row", "col", "yaw_deg", "scale")
        score, row, col, yaw_deg, scale = (np.concatenate([getattr(part, name) for part in parts]) for name in names)
        order = np.lexsort((scale, yaw_deg, col, row, -score))
        return cls(score=score[order], row=row[order], col=col[order], yaw_deg=yaw_deg[order], scale=scale[order])

    def separate(self, most: int, turns: Turns) -> list[int]:
        """Return indices of the best peaks, none next to a better one in place, heading and scale at once."""
        turn_deg, step = NEXT * turns.yaw_step_deg + _NOTHING, NEXT * turns.scale_step + _NOTHING
        chosen: list[int] = []
        at_cell: dict[tuple[int, int], list[tuple[float, float]]] = {}
        columns = (column.tolist() for column in (self.row, self.col, self.yaw_deg, self.scale))
        for at, (row, col, yaw_deg, scale) in enumerate(zip(*columns, strict=True)):
            if len(chosen) == most:
                break
            cells = product((row - 1, row, row + 1), (col - 1, col, col + 1))
            if not any(
                abs((yaw_deg - other_deg + 180) % 360 - 180) < turn_deg and abs(scale - other) < step
                for cell in cells
                for other_deg, other in at_cell.get(cell, ())
            ):
                chosen.append(at)
                at_cell.setdefault((row, col), []).append((yaw_deg, scale))
        return chosen

    def mode(self, at: int, point_m: tuple[float, float]) -> Mode:
        """Return a peak as a mode at a place in metres."""
        easting_m, northing_m = point_m
        pose = Pose(
            easting_m=easting_m, northing_m=northing_m, yaw_deg=float(self.yaw_deg[at]), scale=float(self.scale[at])
        )
        return Mode(pose=pose, score=float(self.score[at]))


LEAST_SCALE: Final = 0.05
_AT_ONCE: Final = 40_000  # cells of all fours that are scored together: more leave the cache, and take twice the time


@dataclass(frozen=True, kw_only=True)
class LevelView:
    """A view in cells about as large as those of a level, and the level, to be scored pose by pose.

    `parts` are cells of the level and sums over squares of the view, shape (G, rows, 1, 1, 4 * cols), by fours alike;
    `frame` is the lattice of the squares.
    """

    level: Level
    parts: tuple[tuple[Cells, NDArray[np.float32]], ...]
    frame: Grid

    @classmethod
    def of(cls, field: Levels, template: Template, factor: int) -> Self:
        """Prepare a view for one level of a map."""
        level = field.level(factor)
        pool = max(1, round(level.grid.cell_size_m / template.cell_size_m))
        summed, frame = pooled(template, level, pool)
        bands = np.zeros((fours_of(level.cells.count), *frame.shape, FOUR), dtype=np.float32)
        for at, band in zip(template.active.tolist(), summed, strict=True):
            bands[at // FOUR, :, :, at % FOUR] = band
        by_row, cells = bands.reshape(len(bands), frame.rows, 1, 1, -1), level.cells
        at_once = max(1, _AT_ONCE // (frame.rows * frame.cols))
        parts = (slice(first, first + at_once) for first in range(0, len(bands), at_once))
        pairs = tuple((replace(cells, fours=cells.fours[part]), by_row[part]) for part in parts)
        return cls(level=level, parts=pairs, frame=frame)

    def scores(self, pose: Pose, *, reach: int = 1) -> NDArray[np.float64]:
        """Return scores of a pose and its shifts by cells; [i, j] is that of `shifted(pose, i - reach, j - reach)`."""
        (rows, cols), side = self.frame.shape, 2 * reach + 1
        to_level = between(self.frame, pose, self.level.grid)
        to_level[:, 2] -= reach * to_level[:, :2].sum(axis=1)
        found = np.zeros((side, side))
        for cells, bands in self.parts:
            under = cells.under(to_level, (rows + 2 * reach, cols + 2 * reach)).fours.astype(np.float32)
            of_four, of_row, of_cell, of_band = under.strides
            # Each row of the view over the map at each shift, summed in one call; shifts last: a row stays in the
            # cache. A bare array, since numpy's `as_strided` takes as long as the sums of a small view.
            shape, strides = (len(under), rows, side, side, FOUR * cols), (of_four, of_row, of_row, of_cell, of_band)
            shifted = np.ndarray(shape, np.float32, under, 0, strides)
            found += np.vecdot(shifted, bands).sum(axis=(0, 1), dtype=np.float64)
        return found / FULL

    def score(self, pose: Pose) -> float:
        """Return the score of a pose."""
        return float(self.scores(pose, reach=0)[0, 0])

    def shifted(self, pose: Pose, down: float, right: float) -> Pose:
        """Return a pose moved by cells of the frame."""
        cell_m = self.frame.cell_size_m
        easting_m, northing_m = pose.to_map(np.array([(right * cell_m, -down * cell_m)]))[0].tolist()
        return replace(pose, easting_m=easting_m, northing_m=northing_m)


@dataclass(frozen=True, slots=True, kw_only=True)
class Guess:
    """A mode under refinement, and the index of the disc that limits it."""

    mode: Mode
    owner: int


@dataclass(frozen=True, slots=True, kw_only=True)
class Stride:
    """Steps of one level in heading and scale."""

    yaw_deg: float
    scale: float

    def half(self) -> Self:
        """Return half the steps."""
        return replace(self, yaw_deg=self.yaw_deg / 2, scale=self.scale / 2)

    def moved(self, pose: Pose, *, yaw: float = 0.0, scale: float = 0.0) -> Pose:
        """Return a pose turned and scaled by some steps."""
        larger = max(pose.scale + scale * self.scale, LEAST_SCALE)
        return replace(pose, yaw_deg=pose.yaw_deg + yaw * self.yaw_deg, scale=larger)

    def around(self, pose: Pose) -> Iterator[Pose]:
        """Yield a pose and its neighbours in heading or scale."""
        yield pose
        for sign in (-1, 1):
            if self.yaw_deg:
                yield self.moved(pose, yaw=sign)
            if self.scale:
                yield self.moved(pose, scale=sign)


def climbed(level_view: LevelView, stride: Stride, guess: Guess, disc: Disc) -> Guess:
    """Return the best of a guess and its neighbours on one level within a disc; of ties the nearest."""
    best = replace(guess, mode=replace(guess.mode, score=-math.inf))
    for pose in stride.around(guess.mode.pose):
        table = level_view.scores(pose)
        for at in np.argsort(-table, axis=None, kind="stable"):
            down, right = divmod(int(at), table.shape[1])
            score = float(table[down, right])
            if score <= best.mode.score:
                break
            moved = level_view.shifted(pose, down - 1, right - 1)
            if disc.holds(np.array([(moved.easting_m, moved.northing_m)]))[0]:
                best = replace(guess, mode=Mode(pose=moved, score=score))
                break
    return best


def polished(level_view: LevelView, stride: Stride, guess: Guess, disc: Disc) -> Guess:
    """Return the vertex of parabolas through neighbours in place, heading and scale, if better and within a disc."""
    pose = guess.mode.pose
    table = level_view.scores(pose)
    here = float(table[1, 1])
    down, right = _vertex(table[0, 1], here, table[2, 1]), _vertex(table[1, 0], here, table[1, 2])
    turned = [stride.moved(pose, yaw=sign) for sign in (-1, 1)]
    scaled = [stride.moved(pose, scale=sign) for sign in (-1, 1)]
    yaw, scale = (_vertex(level_view.score(less), here, level_view.score(more)) for less, more in (turned, scaled))
    top = stride.moved(level_view.shifted(pose, down, right), yaw=yaw, scale=scale)
    score = level_view.score(top)
    is_better = score > here and disc.holds(np.array([(top.easting_m, top.northing_m)]))[0]
    return replace(guess, mode=Mode(pose=top, score=score) if is_better else Mode(pose=pose, score=here))


def _vertex(less: float, here: float, more: float) -> float:
    bend = 2 * here - less - more
    return float(np.clip((more - less) / (2 * bend), -0.5, 0.5)) if bend > _NOTHING else 0.0
