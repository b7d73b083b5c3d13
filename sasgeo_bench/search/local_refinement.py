# SPDX-License-Identifier: Apache-2.0
"""Local refinement of modes: steps to the best neighbour, and between cells."""

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Final, Self

import numpy as np
from numpy.typing import NDArray

from sasgeo_bench.geometry.grid import Grid
from sasgeo_bench.geometry.pose import Pose
from sasgeo_bench.search.field import FULL, Field, Level, Template, between, pooled, warped
from sasgeo_bench.search.plan import Mode
from sasgeo_bench.search.space import Disc

_LEAST_SCALE: Final = 0.05
_NOTHING: Final = 1e-9


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
    def of(cls, field: Field, template: Template, factor: int) -> Self:
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
        larger = max(pose.scale + scale * self.scale, _LEAST_SCALE)
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
    """Return the vertex of a parabola through three neighbours, in steps from the middle one, within half a step."""
    bend = 2 * here - less - more
    return float(np.clip((more - less) / (2 * bend), -0.5, 0.5)) if bend > _NOTHING else 0.0
