# SPDX-License-Identifier: Apache-2.0
"""Modes of many views as tensors of PyTorch: ranked, thinned, and refined on one level of the map."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Final, Self

import numpy as np

from sasgeo_bench.geometry.grid import Grid
from sasgeo_bench.search.dense import LEAST_SCALE

try:
    import torch as torch  # noqa: PLC0414 - for the modules beside
except (ImportError, OSError):  # an extra, or one that does not fit this system
    torch = None

Tensor = Any  # PyTorch is an extra: it is read as untyped wherever it is installed

_CIRCLE_DEG: Final = 360.0
_NOTHING: Final = 1e-9
_SHIFTS: Final = 3  # cells a side of a table of scores: the pose and its neighbours
_MIDDLE: Final = 4  # of such a table, flat


def offsets_m(lattice: Grid) -> Tensor:
    """Return the centres of the cells of a lattice, row by row: right and up, shape (2, rows * cols), metres."""
    cells = np.column_stack([index.ravel() for index in np.indices(lattice.shape)])
    return torch.from_numpy(lattice.to_centres_m(cells).T)


def turn_off_deg(one: Tensor, other: Tensor) -> Tensor:
    """Return by how much two headings differ, 0..180 degrees."""
    return (torch.remainder(one - other + _CIRCLE_DEG / 2, _CIRCLE_DEG) - _CIRCLE_DEG / 2).abs()


def moved(pose: Tensor, right_m: Tensor, up_m: Tensor) -> Tensor:
    """Return poses, shape (..., 4), moved along their own axes."""
    east, north, yaw_deg, scale = pose.unbind(-1)
    yaw = torch.deg2rad(yaw_deg)
    sine, cosine = scale * yaw.sin(), scale * yaw.cos()
    east, north = east + cosine * right_m + sine * up_m, north - sine * right_m + cosine * up_m
    return torch.stack(torch.broadcast_tensors(east, north, yaw_deg, scale), dim=-1)


def positions(pose: Tensor, offsets: Tensor, grid: Grid) -> Tensor:
    """Return where offsets of a view lie on a grid, shape (N, P, 2), -1..1 from edge to edge, for `grid_sample`.

    `pose` has shape (N, 4), `offsets` (2, P). Places are computed in double, offsets from them in single precision.
    """
    east, north, yaw_deg, scale = pose.unbind(-1)
    yaw, size = torch.deg2rad(yaw_deg), 2 / (grid.cell_size_m * torch.tensor([grid.cols, grid.rows]).to(pose))
    sine, cosine = scale * yaw.sin(), scale * yaw.cos()
    place = torch.stack((east - grid.west_m, grid.north_m - north), dim=-1) * size - 1
    across, up = torch.stack((cosine, sine), dim=-1) * size, torch.stack((sine, -cosine), dim=-1) * size
    across, up, place = (part.float()[:, None] for part in (across, up, place))
    right_m, up_m = offsets.float()[:, :, None]
    return torch.addcmul(torch.addcmul(place, across, right_m), up, up_m)


def first_come(near: Tensor, valid: Tensor) -> Tensor:
    """Return which of some ranked items to keep, shape (Q, N): each that is near no better one that is kept.

    `near` has shape (Q, N, N), `valid` (Q, N).

    Examples
    --------
    Of a chain in which each item is near the next, every second one stays:

    >>> at = torch.arange(4)  # doctest: +SKIP
    >>> first_come(((at - at[:, None]).abs() <= 1)[None], torch.ones(1, 4, dtype=torch.bool))  # doctest: +SKIP
    tensor([[ True, False,  True, False]])
    """
    better = near.tril(-1)
    kept = valid
    while True:  # the first N items are right after N rounds; mostly a few are enough
        again = valid & ~(better & kept[:, None]).any(-1)
        if torch.equal(again, kept):
            return kept
        kept = again


@dataclass(frozen=True, kw_only=True)
class Guesses:
    """Modes of each view, best first: `pose`, shape (Q, N, 4), is easting, northing, yaw and scale in double precision.

    `score`, shape (Q, N), is minus infinity where there is no mode.
    """

    pose: Tensor
    score: Tensor

    @classmethod
    def none(cls, views: int, count: int, device: str) -> Self:
        """Return room for modes."""
        pose = torch.zeros((views, count, 4), dtype=torch.float64, device=device)
        pose[..., 3] = 1
        return cls(pose=pose, score=torch.full((views, count), -math.inf, dtype=torch.float64, device=device))

    @classmethod
    def joined(cls, parts: Sequence[Self]) -> Self:
        """Join modes of the same views."""
        return cls(pose=torch.cat([p.pose for p in parts], dim=1), score=torch.cat([p.score for p in parts], dim=1))

    @classmethod
    def stacked(cls, parts: Sequence[Self]) -> Self:
        """Stack modes of different views."""
        most = max(part.score.shape[1] for part in parts)
        even = [part.filled(most) for part in parts]
        return cls(pose=torch.cat([part.pose for part in even]), score=torch.cat([part.score for part in even]))

    def __getitem__(self, some: slice) -> Self:
        return type(self)(pose=self.pose[:, some], score=self.score[:, some])

    def filled(self, count: int) -> Self:
        """Add room up to a number of modes of each view."""
        views, held = self.score.shape
        return self if held == count else self.joined([self, self.none(views, count - held, self.score.device)])

    def ranked(self) -> Self:
        """Sort modes, best first; ties keep their order."""
        score, order = self.score.sort(dim=1, descending=True, stable=True)
        return type(self)(pose=self.pose.gather(1, order[..., None].expand(-1, -1, 4)), score=score)

    def only(self, kept: Tensor) -> Self:
        """Drop modes; the others keep their order."""
        return type(self)(pose=self.pose, score=self.score.where(kept, -math.inf)).ranked()

    def merged(self, apart_m: float, apart_deg: Tensor) -> Self:
        """Drop modes near a better one; `apart_deg` is of each view."""
        yaw_deg = self.pose[..., 2]
        beside = turn_off_deg(yaw_deg[:, :, None], yaw_deg[:, None]) <= apart_deg[:, None, None]
        return self.only(first_come((self._apart_m() <= apart_m) & beside, self.score.isfinite()))

    def thinned(self, apart_m: float) -> Self:
        """Drop modes that lie nearer than a distance to a better one."""
        return self.only(first_come(self._apart_m() < apart_m, self.score.isfinite()))

    def inside(self, discs: Tensor) -> Self:
        """Drop modes outside of the disc of each view."""
        return self.only(_is_inside(self.pose, discs))

    def with_dropped(self, rest: Self) -> Self:
        """Append modes dropped at one level, shifted below the last; the first of `rest` was the last kept there."""
        lowest = self.score.where(self.score.isfinite(), math.inf).amin(1, keepdim=True)
        score = rest.score[:, 1:] + (lowest - rest.score[:, :1])
        below = type(self)(pose=rest.pose[:, 1:], score=score.where(score.isfinite(), -math.inf))
        return self.joined([self, below]).ranked()

    def _apart_m(self) -> Tensor:
        """Return distances between modes of each view, shape (Q, N, N)."""
        east_m, north_m = self.pose[..., 0], self.pose[..., 1]
        return torch.hypot(east_m[:, :, None] - east_m[:, None], north_m[:, :, None] - north_m[:, None])


def _is_inside(pose: Tensor, discs: Tensor) -> Tensor:
    """Return which poses, shape (Q, ..., 4), lie in the disc of their view, shape (Q, 3)."""
    east_m, north_m, radius_m = discs.view(len(discs), *(1,) * (pose.ndim - 2), 3).unbind(-1)
    return torch.hypot(pose[..., 0] - east_m, pose[..., 1] - north_m) <= radius_m


@dataclass(frozen=True, kw_only=True)
class Windows:
    """Views on one level of the map, to be scored pose by pose and at shifts by a cell, as `dense.LevelView` is.

    `cells`, shape (B, rows, cols), are the level; `weights`, shape (Q, 9, P), the bands of each view at each of the
    shifts of a window that is wider by a cell on each side; `offsets`, shape (2, P / B), the cells of that window.
    """

    cells: Tensor
    grid: Grid
    weights: Tensor
    window: Grid
    offsets: Tensor
    cell_m: float
    most_bytes: int

    @classmethod
    def of(cls, *, cells: Tensor, grid: Grid, bands: Tensor, frame: Grid, most_bytes: int) -> Self:
        """Shift the bands of each view, shape (Q, B, rows, cols), on their lattice."""
        window = frame.window(-1, -1, frame.rows + 2, frame.cols + 2)
        at = range(_SHIFTS)
        shifted = [torch.nn.functional.pad(bands, (col, 2 - col, row, 2 - row)).flatten(1) for row in at for col in at]
        return cls(
            cells=cells,
            grid=grid,
            weights=torch.stack(shifted, dim=1),
            window=window,
            offsets=offsets_m(window).to(bands.device),
            cell_m=frame.cell_size_m,
            most_bytes=most_bytes,
        )

    def tables(self, pose: Tensor) -> Tensor:
        """Return scores of poses, shape (Q, N, 4), and their shifts by cells; shape (Q, N, 9)."""
        at_once = max(1, self.most_bytes // (4 * self.weights.shape[0] * self.weights.shape[2]))
        return torch.cat([self._tables(some) for some in pose.split(at_once, dim=1)], dim=1).double()

    def shifted(self, pose: Tensor) -> Tensor:
        """Return poses, shape (..., 4), moved to each of the shifts; shape (..., 9, 4)."""
        steps = self.cell_m * (torch.arange(_SHIFTS, device=pose.device) - 1).to(pose)
        return moved(pose[..., None, :], steps.repeat(_SHIFTS), -steps.repeat_interleave(_SHIFTS))

    def _tables(self, pose: Tensor) -> Tensor:
        views, count = pose.shape[:2]
        where = positions(pose.reshape(-1, 4), self.offsets, self.grid).unflatten(1, self.window.shape)
        cells = self.cells.expand(len(where), *self.cells.shape)
        under = torch.nn.functional.grid_sample(cells, where, align_corners=False)
        return under.view(views, count, -1) @ self.weights.mT


def climbed(windows: Windows, stride: Tensor, guesses: Guesses, discs: Tensor) -> Guesses:
    """Return the best of each guess and its neighbours on one level within a disc; of ties the nearest.

    `stride`, shape (Q, 2), are steps in heading and scale.
    """
    around = _around(guesses.pose, stride)
    table = windows.tables(around.flatten(1, 2)).view(*around.shape[:3], -1)
    poses = windows.shifted(around)
    is_open = _is_inside(poses, discs) & guesses.score.isfinite()[..., None, None]
    flat = table.where(is_open, -math.inf).flatten(2)
    best = flat.argmax(-1, keepdim=True)
    pose = poses.flatten(2, 3).gather(2, best[..., None].expand(-1, -1, -1, 4))[:, :, 0]
    return Guesses(pose=pose, score=flat.gather(2, best)[..., 0])


def _around(pose: Tensor, stride: Tensor) -> Tensor:
    """Return poses and their neighbours in heading and, where any view has steps of it, in scale; (Q, N, T, 4)."""
    signs = [(0, 0), (-1, 0), (0, -1), (1, 0), (0, 1)] if stride[:, 1].any() else [(0, 0), (-1, 0), (1, 0)]
    steps = stride[:, None] * torch.tensor(signs).to(stride)
    around = pose[:, :, None].repeat(1, 1, len(signs), 1)
    around[..., 2:] += steps[:, None]
    around[..., 3].clamp_(min=LEAST_SCALE)
    return around


def polished(windows: Windows, stride: Tensor, guesses: Guesses, discs: Tensor) -> Guesses:
    """Return the vertex of parabolas through neighbours in place, heading and scale, if better and within a disc."""
    around = _around(guesses.pose, stride)
    tables = windows.tables(around.flatten(1, 2)).view(*around.shape[:3], -1)
    table, turned = tables[:, :, 0], tables[..., _MIDDLE]
    here = table[..., _MIDDLE]
    down, right = (_vertex(table[..., _MIDDLE - step], here, table[..., _MIDDLE + step]) for step in (_SHIFTS, 1))
    half = (turned.shape[-1] - 1) // 2
    parts = [_vertex(turned[..., at], here, turned[..., at + half]) for at in range(1, half + 1)]
    steps = torch.stack([*parts, *[torch.zeros_like(here)] * (2 - half)], dim=-1)
    top = moved(guesses.pose, right * windows.cell_m, -down * windows.cell_m)
    top[..., 2:] += steps * stride[:, None]
    top[..., 3].clamp_(min=LEAST_SCALE)
    score = windows.tables(top)[..., _MIDDLE]
    is_better = (score > here) & _is_inside(top, discs)
    found = score.where(is_better, here).where(guesses.score.isfinite(), -math.inf)
    return Guesses(pose=top.where(is_better[..., None], guesses.pose), score=found)


def _vertex(less: Tensor, here: Tensor, more: Tensor) -> Tensor:
    bend = 2 * here - less - more
    return ((more - less) / (2 * bend)).clamp(-0.5, 0.5).where(bend > _NOTHING, 0.0)
