# SPDX-License-Identifier: Apache-2.0
"""Scores of many views at all places and headings of one level, by PyTorch, and their best peaks."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, Final, Self

import numpy as np
from scipy import fft

from sasgeo_bench.geometry.grid import Grid
from sasgeo_bench.geometry.pose import Pose, inverse
from sasgeo_bench.search.correlation import around_of, blur_width, squares_across
from sasgeo_bench.search.dense import NEXT, SPARE
from sasgeo_bench.search.field import Level, Template, round_kernel, squares
from sasgeo_bench.search.plan import Null, Tile, Turns
from sasgeo_bench.search.torch_modes import Guesses, first_come, offsets_m, positions, torch, turn_off_deg

Tensor = Any

_LOW: Final = -1e30  # score of a place that is not allowed
_NOTHING: Final = 1e-9


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
