# SPDX-License-Identifier: Apache-2.0
"""The search of `find` for many views at once, by PyTorch on a processor or a GPU."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from dataclasses import field as made
from typing import Any, Final, Self

import numpy as np
from numpy.typing import NDArray
from scipy import fft

from sasgeo_bench.core.errors import ConfigError, ShapeError
from sasgeo_bench.geometry.grid import Grid
from sasgeo_bench.geometry.pose import Pose, Prior, inverse
from sasgeo_bench.search.dense import LEAST_SCALE, NEXT, SPARE
from sasgeo_bench.search.field import FULL, Field, Level, Template, round_kernel, squares
from sasgeo_bench.search.find import Search
from sasgeo_bench.search.plan import Found, Mode, Null, Plan, Tile, Turns
from sasgeo_bench.search.shifts import around_of, blur_width, squares_across

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


_LOW: Final = -1e30  # score of a place that is not allowed


@dataclass(frozen=True, kw_only=True)
class Views:
    """Views of one shape, such as `template`: `bands`, shape (Q, B, rows, cols), of the classes `active` in any."""

    template: Template
    bands: Tensor
    active: list[int]

    @classmethod
    def of(cls, templates: Sequence[Template], device: str) -> Self:
        """Copy views to a device."""
        count, rows, cols = templates[0].weights.shape
        bands = np.empty((len(templates), count + 1, rows, cols), dtype=np.float32)
        for row, template in zip(bands, templates, strict=True):
            row[:-1], row[-1] = template.weights, template.known
        held = torch.from_numpy(bands).to(device)
        active = (held != 0).any(0).flatten(1).any(1).nonzero()[:, 0].tolist()
        return cls(template=templates[0], bands=held[:, active], active=active)

    def some(self, at: Sequence[int]) -> Self:
        """Return some of the views."""
        return self if len(at) == len(self.bands) else replace(self, bands=self.bands[at])

    def pooled(self, level: Level, pool: int) -> tuple[Tensor, Grid]:
        """Return bands for a level summed over squares of view cells, as `field.pooled` does, and their lattice."""
        _, frame = squares(self.template.known[None], pool, cell_size_m=self.template.cell_size_m)
        rows, cols = self.bands.shape[2:]
        down, across = frame.rows * pool - rows, frame.cols * pool - cols
        around = (across // 2, across - across // 2, down // 2, down - down // 2)
        padded = torch.nn.functional.pad(self._softened(level), around)
        return torch.nn.functional.avg_pool2d(padded, pool, divisor_override=1), frame

    def _softened(self, level: Level) -> Tensor:
        """Return bands for spread classes: no loss near gains, elsewhere losses reduced by the growth of the class."""
        if level.factor == 1:
            return self.bands
        kernel = torch.from_numpy(round_kernel(level.grid.cell_size_m / self.template.cell_size_m)).to(self.bands)
        gains = (self.bands > 0).to(kernel.dtype).flatten(0, 1)[:, None]
        # 0.5 of a cell, where whole cells are counted
        near = torch.nn.functional.conv2d(gains, kernel[None, None], padding="same").view(self.bands.shape) > 0.5
        thinner = torch.from_numpy(level.thinner[self.active]).to(self.bands)[:, None, None]
        return (self.bands * thinner * ~near).where((self.bands < 0) & (thinner < 1), self.bands)


@dataclass(frozen=True, kw_only=True)
class Coarse:
    """Views of one prior, to be laid on the coarsest level `cells`, shape (B, rows, cols), at all headings and scales.

    `bands`, shape (Q, B, rows, cols), lie on `frame`; `around` are cells of the level around the middle of a view.
    """

    cells: Tensor
    grid: Grid
    bands: Tensor
    frame: Grid
    around: Grid
    turns: Turns
    most_bytes: int

    @classmethod
    def of(cls, *, cells: Tensor, level: Level, views: Views, turns: Turns, most_bytes: int) -> Self:
        """Blur the bands of the views as `Correlation` does."""
        bands, frame = views.pooled(level, squares_across(views.template, level.grid))
        width = blur_width(frame, level.grid)
        return cls(
            cells=cells,
            grid=level.grid,
            bands=torch.nn.functional.avg_pool2d(bands, width, stride=1, padding=width // 2),
            frame=frame,
            around=around_of(views.template, level.grid, turns),
            turns=turns,
            most_bytes=most_bytes,
        )

    def found(self, tiles: Sequence[Tile], *, most: int) -> tuple[Guesses, list[Null]]:
        """Return the best modes of each tile, no two of them neighbours, and statistics of all places."""
        guesses, highest = zip(*(self._tile(tile, most) for tile in tiles), strict=True)
        return Guesses.joined(guesses).ranked(), _nulls(torch.cat(highest, dim=1))

    def _tile(self, tile: Tile, most: int) -> tuple[Guesses, Tensor]:
        """Return at most `most` modes of a tile, and the highest score of each of its places, shape (Q, places)."""
        board = Board.of(self, tile)
        quarters = self.turns.quarters
        # 5 arrays as large as the transformed scores that are alive at once
        planes = max(1, self.most_bytes // (5 * board.bytes_a_plane))
        bases = max(1, min(planes // quarters, len(self.turns.bases)))
        modes, best = [], []
        for first in range(0, len(self.turns.bases), bases):
            lay = self.lay(self.turns.bases[first : first + bases])
            some = self.bands.split(max(1, planes // (bases * quarters)))
            highest, peaks = zip(*(board.peaks(lay.laid(bands), lay.turned, most=most) for bands in some), strict=True)
            best.append(torch.cat(highest))
            modes.append(Guesses.stacked(peaks))
        found = self._separate(Guesses.joined(modes).ranked(), most)
        found.pose[..., :2] += found.pose.new_tensor([tile.row, tile.col])
        return self._placed(found), torch.stack(best).amax(0)

    def lay(self, bases: Sequence[Pose]) -> "Lay":
        """Return how to lay views at some headings and scales."""
        back = [inverse(base) for base in bases]
        rows = [(pose.easting_m, pose.northing_m, pose.yaw_deg, pose.scale) for pose in back]
        where = positions(_double(rows, self.bands), offsets_m(self.around).to(self.bands.device), self.frame)
        shares = [(self.around.cell_size_m / (base.scale * self.frame.cell_size_m)) ** 2 for base in bases]
        quarters = range(self.turns.quarters)
        turned = [replace(base, yaw_deg=base.yaw_deg + 90 * quarter) for quarter in quarters for base in bases]
        poses = [(pose.yaw_deg, pose.scale) for pose in turned]
        order = sorted(range(len(poses)), key=poses.__getitem__)
        return Lay(
            where=where.view(1, -1, self.around.cols, 2),
            shares=_double(shares, self.bands).float()[:, None, None, None],
            quarters=self.turns.quarters,
            order=torch.tensor(order, device=self.bands.device),
            turned=_double([poses[at] for at in order], self.bands),
        )

    def _separate(self, peaks: Guesses, most: int) -> Guesses:
        """Return the best peaks, none next to a better one in place, heading and scale at once."""
        row, col, yaw_deg, scale = (part[:, :, None] for part in peaks.pose.unbind(-1))
        beside = ((row - row.mT).abs() <= 1) & ((col - col.mT).abs() <= 1)
        is_turned = turn_off_deg(yaw_deg, yaw_deg.mT) >= NEXT * self.turns.yaw_step_deg + _NOTHING
        is_scaled = (scale - scale.mT).abs() >= NEXT * self.turns.scale_step + _NOTHING
        return peaks.only(first_come(beside & ~is_turned & ~is_scaled, peaks.score.isfinite()))[:most].filled(most)

    def _placed(self, peaks: Guesses) -> Guesses:
        """Return peaks at rows and columns as modes in metres."""
        cells = peaks.pose[..., :2].long().flatten(0, 1).cpu().numpy()
        places = torch.from_numpy(self.grid.to_centres_m(cells)).to(peaks.pose)
        return replace(peaks, pose=torch.cat((places.view_as(peaks.pose[..., :2]), peaks.pose[..., 2:]), dim=-1))


@dataclass(frozen=True, kw_only=True)
class Lay:
    """Headings and scales, `turned` of shape (H, 2), in the order in which equal scores are ranked.

    `where` are the cells of a level in a view for those of the first quarter turn, `shares` the areas of its cells.
    """

    where: Tensor
    shares: Tensor
    quarters: int
    order: Tensor
    turned: Tensor

    def laid(self, bands: Tensor) -> Tensor:
        """Resample views onto cells of the level, shape (Q, H, B, side, side)."""
        laid = torch.nn.functional.grid_sample(bands, self.where.expand(len(bands), -1, -1, -1), align_corners=False)
        laid = laid.unflatten(2, (len(self.shares), -1)).transpose(1, 2) * self.shares
        return torch.cat([torch.rot90(laid, -quarter, (3, 4)) for quarter in range(self.quarters)], dim=1)[
            :, self.order
        ]


@dataclass(frozen=True, kw_only=True)
class Board:
    """A tile of a level on which laid views are scored at all places.

    The map is transformed along its rows alone: `spectrum`, shape (F, 2, rows + side - 1, B), real and imaginary parts.
    So for each frequency the scores of all rows are one product of matrices: the rows of the map, each with those below
    it as far as a view reaches, times the rows of the views. `waves`, shape (F, 2, 2, side), transforms a row of a view
    into its factors of both parts of the map in both parts of a score. Both are in half precision on a GPU.
    """

    allowed: Tensor
    spectrum: Tensor
    waves: Tensor
    size: int
    most_bytes: int

    @classmethod
    def of(cls, coarse: Coarse, tile: Tile) -> Self:
        """Transform the map under a tile, padded by the reach of a view."""
        rows, cols = tile.allowed.shape
        side, half = coarse.around.rows, coarse.around.rows // 2
        size = int(fft.next_fast_len(cols + side - 1, real=True))
        padded = torch.nn.functional.pad(coarse.cells, (half, half, half, half))
        window = padded[:, tile.row : tile.row + rows + side - 1, tile.col : tile.col + cols + side - 1]
        turns = torch.arange(size // 2 + 1)[:, None] * torch.arange(side)
        waves = torch.polar(torch.ones(turns.shape), 2 * math.pi / size * (turns % size))
        real, imag = waves.real, waves.imag  # of the conjugate, since a correlation is wanted
        factors = torch.stack((torch.stack((real, -imag), dim=1), torch.stack((imag, real), dim=1)), dim=1)
        is_gpu = coarse.cells.is_cuda
        kind = torch.float16 if is_gpu else torch.float32
        spectrum = torch.view_as_real(torch.fft.rfft(window, n=size)).permute(2, 3, 1, 0)
        if is_gpu:  # matrices of the tensor cores have rows of multiples of 16 bytes
            spectrum = torch.nn.functional.pad(spectrum, (0, -spectrum.shape[-1] % 4))
            factors = torch.nn.functional.pad(factors, (0, -side % 8))
        return cls(
            allowed=torch.from_numpy(tile.allowed).to(coarse.cells.device),
            spectrum=spectrum.to(kind, memory_format=torch.contiguous_format),
            waves=factors.to(coarse.cells.device, kind),
            size=size,
            most_bytes=coarse.most_bytes,
        )

    @property
    def bytes_a_plane(self) -> int:
        """Return the bytes of the transformed scores of one view at one heading."""
        return 8 * len(self.spectrum) * int(self.spectrum.shape[2])

    def scores(self, laid: Tensor) -> Tensor:
        """Score laid views, shape (Q, H, B, side, side), at all places, times `size`; shape (rows, Q, H, size).

        Columns beyond those of the tile hold nothing.
        """
        rows = len(self.allowed)
        views, headings, bands, side, _ = laid.shape
        aligned = (0, self.waves.shape[-1] - side, 0, 0, 0, self.spectrum.shape[-1] - bands)
        laid = torch.nn.functional.pad(laid.to(self.waves.dtype), aligned)
        wide = rows * 2 * side * self.spectrum.shape[-1] * self.spectrum.element_size()
        at_once, parts = max(1, self.most_bytes // (4 * wide)), []
        for spectrum, waves in zip(self.spectrum.split(at_once), self.waves.split(at_once), strict=True):
            under = spectrum.unfold(2, side, 1).permute(0, 2, 1, 4, 3).flatten(2)
            factors = torch.einsum("foid,qhbrd->fqhoirb", waves, laid)
            # Products of matrices, summed and kept in single precision
            other = factors.reshape(len(waves), views * headings * 2, -1).mT
            product = torch.bmm(under, other, out_dtype=torch.float32) if under.is_cuda else torch.bmm(under, other)
            parts.append(product)
        sums = parts[0] if len(parts) == 1 else torch.cat(parts)
        sums = torch.view_as_complex(sums.view(len(sums), rows, views * headings, 2))
        scores = torch.fft.irfft(sums, n=self.size, dim=0, norm="forward")
        return scores.permute(1, 2, 0).unflatten(1, (views, headings))

    def peaks(self, laid: Tensor, turned: Tensor, *, most: int) -> tuple[Tensor, Guesses]:
        """Return the highest score of each allowed place, and the best local maxima at any heading.

        Among the highest scores of all places, peaks are peaks at their heading too: so no others below the worst of
        enough of them can be among the best. Peaks have row, column, heading and scale for a pose.
        """
        unit = laid.abs().flatten(1).amax(1).clamp(min=_NOTHING)  # of half precision
        scores = self.scores(laid / unit[:, None, None, None, None])
        unit = unit / self.size
        highest = scores.amax(2)[..., : self.allowed.shape[1]].transpose(0, 1).where(self.allowed, _LOW).contiguous()
        is_top = (highest == torch.nn.functional.max_pool2d(highest, 3, 1, 1)) & self.allowed
        flat, enough = highest.flatten(1), min(SPARE * most, self.allowed.numel())
        least = highest.where(is_top, _LOW).flatten(1).topk(enough).values[:, -1]
        # 64 places for each requested mode whose headings are looked through
        places = flat.topk(min(64 * most, flat.shape[1])).indices.sort(1).values
        row, col = places // self.allowed.shape[1], places % self.allowed.shape[1]
        values = scores[row, torch.arange(len(laid), device=laid.device)[:, None], :, col]
        is_high = (values >= least[:, None, None]) & self.allowed[row, col][..., None]
        view, place, turn = is_high.nonzero().unbind(1)
        row, col, score = row[view, place], col[view, place], values[view, place, turn]
        is_peak = torch.ones_like(score, dtype=torch.bool)
        for down, right in ((-1, -1), (-1, 0), (-1, 1), (0, -1), (0, 1), (1, -1), (1, 0), (1, 1)):
            there = (row + down).clamp(0, self.allowed.shape[0] - 1), (col + right).clamp(0, self.allowed.shape[1] - 1)
            is_peak &= ~self.allowed[there] | (score >= scores[there[0], view, turn, there[1]])
        view, row, col, turn, score = (part[is_peak] for part in (view, row, col, turn, score))
        pose = torch.cat((torch.stack((row, col), dim=1).double(), turned[turn]), dim=1)
        # 8 peaks for each requested mode: far more than their better neighbours can drop
        return flat[:, self.allowed.flatten()] * unit[:, None], _padded(
            view, pose, score.double() * unit[view], (len(laid), 8 * most)
        )


def _padded(view: Tensor, pose: Tensor, score: Tensor, shape: tuple[int, int]) -> Guesses:
    """Return the best of peaks in any order of score, sorted by view, as a table of at most that shape."""
    order = score.argsort(descending=True, stable=True)
    order = order[view[order].argsort(stable=True)]
    view, pose, score = view[order], pose[order], score[order]
    counts = view.bincount(minlength=shape[0])
    at = torch.arange(len(view), device=view.device) - (counts.cumsum(0) - counts)[view]
    table = Guesses.none(shape[0], min(shape[1], int(counts.max())), score.device)
    kept = at < table.score.shape[1]
    table.pose[view[kept], at[kept]], table.score[view[kept], at[kept]] = pose[kept], score[kept]
    return table


def _double(rows: Sequence[Any], like: Tensor) -> Tensor:
    return torch.tensor(rows, dtype=torch.float64, device=like.device)


def _nulls(highest: Tensor) -> list[Null]:
    """Return statistics of scores, shape (Q, places)."""
    wide = highest.double()
    rows = torch.stack((wide.amax(1), wide.mean(1), wide.std(1, correction=0)), dim=1).tolist()
    return [Null(best=best, mean=mean, deviation=deviation, places=wide.shape[1]) for best, mean, deviation in rows]


DEVICES: Final = ("cpu", "cuda")
_AT_ONCE: Final = 64  # views: bounds the memory of what is held for each
MOST_BYTES: Final = {"cpu": 2**29, "cuda": 2**33}  # of what is made for a part of the views, headings or modes
_NONE: Final = Found(modes=(), null=Null(best=0.0, mean=0.0, deviation=0.0, places=0))


def search_batch(
    field: Field,
    templates: Sequence[Template],
    priors: Sequence[Prior],
    plan: Plan | None = None,
    *,
    count: int = 10,
    device: str = "cpu",
) -> list[Found]:
    """Find the best modes of several views on one map: what `find.search` finds for each, to rounding.

    Parameters
    ----------
    field : Field
        The map.
    templates, priors : sequences of equal length
        A view and its prior for each search. Views of one shape are refined together; those that also have one prior
        share the transforms of the map.
    plan : Plan, optional
        Settings of the search; its `threads` are those of `find` alone.
    count : int
        Most modes of a view.
    device : str
        "cpu", or "cuda" for a GPU.

    Returns
    -------
    list of Found
        One for each view, with no modes for an empty template or a prior beyond the map.

    Raises
    ------
    ConfigError
        If PyTorch or the device is missing.
    ShapeError
        If numbers of views, priors or classes differ.

    Notes
    -----
    Positions on the map are not rounded to 1/32 of a cell, nor its values to 1/255, as OpenCV does. On a GPU the
    coarsest level is scored in half precision, summed in single. So scores differ by some 0.1 %, and modes that score
    alike may change places.

    Examples
    --------
    Two views cut out of one map, one laid with its top to the north, one with its top to the south:

    >>> import numpy as np
    >>> from sasgeo_bench.geometry.grid import Grid
    >>> town = np.where(np.random.default_rng(0).random((1, 64, 64)) < 0.1, FULL, 0).astype(np.uint8)
    >>> grid = Grid(epsg=32632, west_m=0.0, north_m=64.0, cell_size_m=1.0, rows=64, cols=64)
    >>> field = Field.of(grid=grid, layers=town, known=np.full((64, 64), FULL, np.uint8))
    >>> seen = (town[:, 20:52, 10:42] / FULL).astype(np.float32)
    >>> views = [Template(weights=2 * s - 0.5, known=-s[0], cell_size_m=1.0) for s in (seen, seen[:, ::-1, ::-1])]
    >>> anywhere = Prior(center_m=None, radius_m=None, yaw_deg=None, yaw_sigma_deg=None, scale_sigma=0.0)
    >>> poses = [found.modes[0].pose for found in search_batch(field, views, [anywhere] * 2)]  # doctest: +SKIP
    >>> [(round(pose.easting_m), round(pose.northing_m), round(pose.yaw_deg) % 360) for pose in poses]  # doctest: +SKIP
    [(26, 28, 0), (26, 28, 180)]
    """
    return BatchSearch(field=field, plan=plan or Plan(), device=device).places(templates, priors, count=count)


@dataclass(frozen=True, kw_only=True)
class BatchSearch:
    """A map held on a device for searches: each of its levels is copied there once, as 4 bytes a cell and class.

    Headings lie at most `yaw_step_deg` apart, and scales likewise. See `search_batch` for the rest.
    """

    field: Field
    plan: Plan = made(default_factory=Plan)
    device: str = "cpu"
    yaw_step_deg: float = math.inf
    _searches: dict[tuple[object, ...], Search] = made(default_factory=dict, init=False, repr=False, compare=False)
    _levels: dict[int, Tensor] = made(default_factory=dict, init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        if torch is None:
            raise ConfigError("search_batch needs PyTorch: pip install 'sasgeo-bench[torch]'")
        if self.device not in DEVICES:
            raise ConfigError(f"device must be one of {', '.join(DEVICES)}, got {self.device!r}")
        if self.device == "cuda" and not torch.cuda.is_available():
            raise ConfigError(
                "PyTorch finds no GPU for device 'cuda': use 'cpu', or install a build of PyTorch for this GPU"
            )

    def places(self, templates: Sequence[Template], priors: Sequence[Prior], *, count: int = 10) -> list[Found]:
        """Return the best modes of each view within its prior: at most `count`, best first."""
        if len(templates) != len(priors):
            raise ShapeError(f"each view has a prior, got {len(templates)} templates and {len(priors)} priors")
        groups: dict[tuple[object, ...], list[int]] = {}
        for at, template in enumerate(templates):
            if len(template.bands) != self.field.cells.count:
                raise ShapeError(
                    f"templates[{at}] has {len(template.weights)} classes, the map {self.field.cells.count - 1}"
                )
            if len(template.active):
                patches = self._search(template, priors[at]).patches
                groups.setdefault((template.weights.shape, template.cell_size_m, patches), []).append(at)
        found = [_NONE] * len(templates)
        with torch.inference_mode():
            for group in groups.values():
                for start in range(0, len(group), _AT_ONCE):
                    part = group[start : start + _AT_ONCE]
                    some = self._together([templates[at] for at in part], [priors[at] for at in part], count)
                    for at, one in zip(part, some, strict=True):
                        found[at] = one
        return found

    def _together(self, templates: Sequence[Template], priors: Sequence[Prior], count: int) -> list[Found]:
        """Search for views of one shape, in areas of about one size."""
        views, searches = Views.of(templates, self.device), [self._search(templates[0], prior) for prior in priors]
        guesses, nulls = self.begun(views, searches)
        found = self.followed(views, searches, guesses)[:count]
        rows = zip(found.pose.cpu().numpy(), found.score.cpu().numpy(), nulls, strict=True)
        return [Found(modes=_modes(poses, scores), null=null) for poses, scores, null in rows]

    def _search(self, template: Template, prior: Prior) -> Search:
        """Return the settings of a search for any view of one shape; those of the last priors are kept."""
        key = (template.known.shape, template.cell_size_m, prior)
        if key not in self._searches:
            if len(self._searches) >= _AT_ONCE:
                self._searches.clear()
            self._searches[key] = Search(
                field=self.field, template=template, prior=prior, plan=self.plan, yaw_step_deg=self.yaw_step_deg
            )
        return self._searches[key]

    def _coarse(self, views: Views, search: Search) -> Coarse:
        level = self.field.level(search.factor)
        return Coarse.of(
            cells=self._cells(views, search.factor),
            level=level,
            views=views,
            turns=search.turns,
            most_bytes=MOST_BYTES[self.device],
        )

    def begun(self, views: Views, searches: Sequence[Search]) -> tuple[Guesses, list[Null]]:
        """Return modes of the coarsest level, best first, and statistics of its scores, for each view."""
        groups: dict[Prior, list[int]] = {}
        for at, search in enumerate(searches):
            groups.setdefault(search.prior, []).append(at)
        guesses, nulls = Guesses.none(len(searches), 1, self.device), [_NONE.null] * len(searches)
        for group in groups.values():
            search = searches[group[0]]
            tiles = [tile for tile in search.tiles if tile.allowed.any()]
            if tiles:
                found, some = self._coarse(views.some(group), search).found(
                    tiles, most=self.plan.width(0, search.patches)
                )
                most = max(found.score.shape[1], guesses.score.shape[1])
                guesses, found = guesses.filled(most), found.filled(most)
                guesses.pose[group], guesses.score[group] = found.pose, found.score
                for at, null in zip(group, some, strict=True):
                    nulls[at] = null
        return guesses, nulls

    def followed(self, views: Views, searches: Sequence[Search], guesses: Guesses) -> Guesses:
        """Refine modes to the map's own cells and between them; best first, then dropped ones."""
        plan, factor, cell_m = self.plan, searches[0].factor, self.field.grid.cell_size_m
        patches = searches[0].patches
        stride = self._tensor([(each.turns.yaw_step_deg, each.turns.scale_step) for each in searches])
        width = plan.width(0, patches)
        kept, behind = guesses[:width], [guesses[width - 1 :]]
        while factor > 1:
            factor, stride = factor // 2, stride / 2
            moved = climbed(self._level_views(views, factor), stride, kept, self._discs(searches, factor)).ranked()
            merged = moved.merged(factor * cell_m, stride[:, 0])
            width = plan.width(len(behind), patches)
            kept, behind = merged[:width], [*behind, merged[width - 1 :]]
        level_views, near = self._level_views(views, 1), self._discs(searches, 1)
        for move in (climbed, climbed, polished):
            kept, stride = move(level_views, stride, kept, near).ranked(), stride / 2
        for rest in reversed(behind):
            kept = kept.with_dropped(rest)
        return kept.inside(near).thinned(plan.apart_m)

    def _cells(self, views: Views, factor: int) -> Tensor:
        """Return the bands of a level that views need, 0..1, shape (B, rows, cols)."""
        if factor not in self._levels:
            cells = self.field.level(factor).cells
            fours = torch.from_numpy(cells.fours).to(self.device).permute(0, 3, 1, 2).flatten(0, 1)
            self._levels[factor] = fours[: cells.count].to(torch.float32) / FULL
        cells = self._levels[factor]
        return cells if len(cells) == len(views.active) else cells[views.active]

    def _level_views(self, views: Views, factor: int) -> Windows:
        """Prepare views for one level, as `dense.LevelView` does."""
        level = self.field.level(factor)
        bands, frame = views.pooled(level, max(1, round(level.grid.cell_size_m / views.template.cell_size_m)))
        return Windows.of(
            cells=self._cells(views, factor),
            grid=level.grid,
            bands=bands,
            frame=frame,
            most_bytes=MOST_BYTES[self.device],
        )

    def _discs(self, searches: Sequence[Search], factor: int) -> Tensor:
        """Return easting, northing and radius of where each view may lie, shape (Q, 3); infinite without a prior."""
        discs = [search.within(factor) for search in searches]
        return self._tensor(
            [(*disc.center_m, disc.radius_m) if disc.center_m else (0.0, 0.0, math.inf) for disc in discs]
        )

    def _tensor(self, rows: Sequence[tuple[float, ...]]) -> Tensor:
        return torch.tensor(rows, dtype=torch.float64, device=self.device)


def _modes(poses: NDArray[np.float64], scores: NDArray[np.float64]) -> tuple[Mode, ...]:
    rows = zip(poses.tolist(), scores.tolist(), strict=True)
    return tuple(
        Mode(pose=Pose(easting_m=row[0], northing_m=row[1], yaw_deg=row[2], scale=row[3]), score=score)
        for row, score in rows
        if math.isfinite(score)
    )
