# SPDX-License-Identifier: Apache-2.0
"""Best modes of all places: peaks of the correlations; local refinement of the modes."""

import math
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from itertools import product
from threading import Lock
from typing import Final, Self

import cv2
import numpy as np
from numpy.typing import NDArray

from sasgeo_bench.geometry.grid import Grid
from sasgeo_bench.geometry.pose import Pose
from sasgeo_bench.search.correlation import Correlation
from sasgeo_bench.search.field import FULL, Level, Levels, Template, between, pooled, warped
from sasgeo_bench.search.plan import Disc, Mode, Null, Tile, Turns

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

    with ThreadPoolExecutor(threads) as pool:
        parts = [part for some in pool.map(peaks_of, turns.bases) for part in some]
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


@dataclass(frozen=True, kw_only=True)
class LevelView:
    """A view in cells about as large as those of a level, and the level, to be scored pose by pose.

    `bands`, shape (rows, cols, K + 1) as the cells of the level, are sums over squares of the view, `frame` is
    their lattice.
    """

    level: Level
    bands: NDArray[np.float32]
    frame: Grid

    @classmethod
    def of(cls, field: Levels, template: Template, factor: int) -> Self:
        """Prepare a view for one level of a map."""
        level = field.level(factor)
        pool = max(1, round(level.grid.cell_size_m / template.cell_size_m))
        summed, frame = pooled(template, level, pool)
        bands = np.zeros((*frame.shape, level.cells.shape[-1]), dtype=np.float32)
        bands[..., template.active] = np.moveaxis(summed, 0, -1)
        return cls(level=level, bands=bands, frame=frame)

    def scores(self, pose: Pose, *, reach: int = 1) -> NDArray[np.float64]:
        """Return scores of a pose and its shifts by cells; [i, j] is that of `shifted(pose, i - reach, j - reach)`."""
        rows, cols = self.frame.shape
        wide = self.frame.window(-reach, -reach, rows + 2 * reach, cols + 2 * reach)
        under = warped(self.level.cells, between(wide, pose, self.level.grid), wide.shape).astype(np.float32)
        shifts = range(2 * reach + 1)
        windows = ((under[row : row + rows, col : col + cols] for col in shifts) for row in shifts)
        return np.array([[np.einsum("ijb,ijb", cut, self.bands) for cut in row] for row in windows]) / FULL

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
