# SPDX-License-Identifier: Apache-2.0
"""Search by mean votes: all places, headings and scales on coarse cells by FFT, the best of them on the map's own."""

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from functools import cache, cached_property
from typing import Final, Self

import numpy as np
from numpy.typing import NDArray
from scipy import fft

from sasgeo_bench.geometry.pose import Pose, Prior
from sasgeo_bench.regions.evidence import ABSENT, PRESENT, UNKNOWN
from sasgeo_bench.search.parts import Parts
from sasgeo_bench.search.plan import SPREAD, Disc, Mode, place_m, thinned
from sasgeo_bench.search.view import NOWHERE, Chart, Patch, Samples, View


@dataclass(frozen=True, kw_only=True)
class VoteGains:
    """Weights of each class, shape (C,), at least 0: its weight times the lambdas of Eq. (7).

    `agree` is gained where a class is seen and mapped, `extra` lost where it is seen and not mapped, `missed` lost
    where it is mapped and seen to be absent. All other cells count 0.
    """

    agree: NDArray[np.float64]
    extra: NDArray[np.float64]
    missed: NDArray[np.float64]

    @classmethod
    def uniform(cls, count: int) -> Self:
        """Return gains of 1 for every class."""
        return cls(agree=np.ones(count), extra=np.ones(count), missed=np.ones(count))


def make_template(
    seen: NDArray[np.uint8],
    gains: VoteGains,
    *,
    near: NDArray[np.float32] | None = None,
    chances: NDArray[np.floating] | None = None,
) -> NDArray[np.float64]:
    """Return the factors of the map in Eq. (8), which is linear in the map, shape (C + 2, rows, cols).

    `seen` has shape (C, rows, cols). C bands are for the degree to which the map holds each class; one for known map
    cells (the loss of what is seen, regained where it is mapped); the last counts the classes known in the view.
    `near`, 0..1, is the proximity of the class in the view: it reduces the loss for mapped cells that are seen to be
    absent. `chances` are `Evidence.probabilities`: a cell then counts P as present and 1 - P as absent.

    Examples
    --------
    >>> make_template(np.array([[[1, 0, 2]]], dtype=np.uint8), VoteGains.uniform(1))[:, 0].tolist()
    [[2.0, -1.0, 0.0], [-1.0, 0.0, 0.0], [1.0, 1.0, 0.0]]
    """
    count = len(seen)
    made = np.zeros((count + 2, *seen.shape[1:]))
    for index, view in enumerate(seen):
        present, absent = (view == PRESENT).astype(np.float64), (view == ABSENT).astype(np.float64)
        if chances is not None:
            is_known = view != UNKNOWN
            present, absent = (np.where(is_known, part, 0.0) for part in (chances[index], 1 - chances[index]))
        if near is not None:
            absent *= 1 - near[index]
        made[index] = (gains.agree[index] + gains.extra[index]) * present - gains.missed[index] * absent
        made[count] -= gains.extra[index] * present
        made[count + 1] += view != UNKNOWN
    return made


@dataclass(frozen=True, slots=True, kw_only=True)
class Spectrum:
    """A template in the Fourier domain: `score` for the layers and for known cells, `counts` for known cells alone."""

    score: NDArray[np.complexfloating]
    counts: NDArray[np.complexfloating]


@dataclass(frozen=True, slots=True, kw_only=True)
class ByPlanes:
    """Votes for templates at all shifts by transforms of squares, part by part.

    Templates have shape (T, B + 2, high, high), windows (Q, B + 1, side, side), where side = places + high - 1.
    """

    parts: Parts

    @classmethod
    def of(cls, *, places: int, high: int, bands: int = 1, windows: int = 1) -> Self:
        """Return votes of templates of `high` cells a side and so many bands, at `places` shifts a side of windows."""
        return cls(parts=Parts.cheapest(places=(places, places), high=high, bands=bands, windows=windows))

    def at_once(self, bands: int) -> int:
        """Return how many templates to transform together."""
        del bands
        return 1

    def window(self, layers: NDArray[np.floating]) -> NDArray[np.complexfloating]:
        """Transform squares of the map under each part, once for all templates; shape (Q, P, B + 1, ...)."""
        return np.stack([self.parts.windows(square) for square in layers])

    def templates(self, templates: NDArray[np.floating]) -> Spectrum:
        """Transform templates, once for all windows."""
        bands = self.parts.templates(templates)
        return Spectrum(score=bands[..., :-1, :, :], counts=bands[..., -1, :, :])

    def votes(
        self, window: NDArray[np.complexfloating], templates: Spectrum, least: NDArray[np.floating] | None = None
    ) -> tuple[NDArray[np.floating], NDArray[np.floating]]:
        """Return sums of gains and numbers of known cells, shape (T, Q, places, places) each.

        Gains are not summed, and are 0, in parts where no place has the `least` number of known cells, shape (T,).
        """
        parts = self.parts
        shape = (len(templates.score), len(window), *parts.places)
        total, counted = np.zeros(shape, dtype=np.float32), np.empty(shape, dtype=np.float32)
        for at, square in np.ndindex(*shape[:2]):
            score, counts = templates.score[at], templates.counts[at]
            for part, layers in zip(parts.slices, window[square], strict=True):
                here = (at, square, *part)
                counted[here] = counts[0, 0].real if parts.is_full(layers[-1]) else parts.sums(layers[-1:], [counts])
                held = np.flatnonzero(layers[:, 0, 0])  # sums of layers: the others add nothing here
                if len(held) and (least is None or counted[here].max() >= least[at]):
                    total[here] = parts.sums((layers[band] for band in held), (score[band] for band in held))
        return total, counted


@dataclass(frozen=True, slots=True, kw_only=True)
class ByRows:
    """The same votes as `ByPlanes` for `places` shifts a side, by transforms of rows alone: less work for few places.

    All rows of a template at all places they may have are one matrix product for each frequency.
    """

    places: int
    high: int

    @classmethod
    def of(cls, *, places: int, high: int, bands: int = 1, windows: int = 1) -> Self:
        """Return votes as `ByPlanes.of` does."""
        del bands, windows
        return cls(places=places, high=high)

    @property
    def size(self) -> int:
        """Return columns of a transform."""
        return int(fft.next_fast_len(self.places + self.high - 1, real=True))

    def at_once(self, bands: int) -> int:
        """Return how many templates to transform together: as many as stay small."""
        # At most 4 million values of transformed templates at a time
        return max(1, 4_000_000 // (bands * self.high * self.size))

    def window(self, layers: NDArray[np.floating]) -> NDArray[np.complexfloating]:
        """Transform squares of the map, once for all templates."""
        return np.asarray(fft.rfft(layers, n=self.size, axis=-1))

    def templates(self, templates: NDArray[np.floating]) -> Spectrum:
        """Conjugate rows of templates, shapes (frequencies, (B + 1) * high, T) and (frequencies, high, T)."""
        rows = np.conj(fft.rfft(templates, n=self.size, axis=-1).transpose(3, 1, 2, 0), order="C")
        rows = rows.reshape(len(rows), -1, len(templates))
        return Spectrum(score=rows[:, : -self.high], counts=rows[:, -self.high :])

    def votes(
        self, window: NDArray[np.complexfloating], templates: Spectrum, least: NDArray[np.floating] | None = None
    ) -> tuple[NDArray[np.floating], NDArray[np.floating]]:
        """Return sums of gains and numbers of known cells, shape (T, Q, places, places) each."""
        del least  # a product of all places costs less than to choose them
        # Map rows under a template at each place: frequencies first, then Q * places, then (B + 1) * high.
        under = np.lib.stride_tricks.sliding_window_view(window, self.high, axis=2).transpose(3, 0, 2, 1, 4)
        under = under.reshape(len(under), len(window) * self.places, -1)
        products = (under @ templates.score, under[:, :, -self.high :] @ templates.counts)
        total, counted = (fft.irfft(product, n=self.size, axis=0)[: self.places] for product in products)
        shape = (self.places, -1, self.places, total.shape[-1])
        return total.reshape(shape).transpose(3, 1, 2, 0), counted.reshape(shape).transpose(3, 1, 2, 0)


_FEW: Final = 32  # places a side: more cost less by transforms of planes
_MARGIN_M: Final = 12.0  # a mode may move so far while it is refined
_WIDEN: Final = 0.05  # its scale may exceed the searched ones by so much


@dataclass(frozen=True, slots=True, kw_only=True)
class VotePlan:
    """Settings of a search by votes.

    A coarse cell has a side of `coarse_m`, for areas beyond `wide_m2` of `coarse_wide_m`. Headings and scales are
    searched in steps of at most `yaw_step_deg` and `scale_step`. Modes lie `apart_m` from each other, and the map must
    know a share `least_overlap` of the cells known to the view. `modes` are refined on coarse cells, and `finals` of
    them on the map's own. A view may lie within `around_m` of its candidate.
    """

    coarse_m: float = 4.0
    coarse_wide_m: float = 8.0
    wide_m2: float = 5e6
    yaw_step_deg: float = 3.0
    scale_step: float = 0.06
    apart_m: float = 25.0
    least_overlap: float = 0.5
    modes: int = 12
    finals: int = 6
    around_m: float = 24.0


@dataclass(frozen=True, slots=True, kw_only=True)
class Voted:
    """Result of a search by votes: modes, best first, or one for each candidate, None where the map shows too little.

    `null_score` is the lead of the best coarse score over distant places, which are wrong if it is right, in their
    standard deviations; 0 where there are none.
    """

    modes: list[Mode | None]
    null_score: float


@dataclass(frozen=True, kw_only=True)
class _Tile:
    """Square of places, row by row, and the map under all views from there.

    `layers` has shape (B + 1, side, side), `points_m` (n * n, 2); `allowed`, shape (n * n,), marks searched places.
    """

    layers: NDArray[np.float32]
    points_m: NDArray[np.float64]
    allowed: NDArray[np.bool_]


@dataclass(frozen=True, kw_only=True)
class _Votes:
    """Best score of each place of a tile, and the index of its turn (heading and scale)."""

    score: NDArray[np.float64]
    turn: NDArray[np.int64]


def turns(prior: Prior, plan: VotePlan) -> tuple[Pose, ...]:
    """Return headings and scales to search, as poses at the origin."""
    # 2: standard deviations of the scale: at 0.03 three scales, between which modes are refined
    scales = [1 + offset for offset in _steps(min(2.0 * prior.scale_sigma, 0.9), plan.scale_step)]
    yaws_deg = _yaws_deg(prior, plan)
    return tuple(Pose(easting_m=0.0, northing_m=0.0, yaw_deg=yaw, scale=scale) for scale in scales for yaw in yaws_deg)


def _is_any_heading(prior: Prior) -> bool:
    return prior.yaw_sigma_deg is None or SPREAD * prior.yaw_sigma_deg >= 180


def _yaws_deg(prior: Prior, plan: VotePlan) -> list[float]:
    """Return headings to search; of all headings, each has three others at right angles."""
    if prior.yaw_deg is None or prior.yaw_sigma_deg is None or _is_any_heading(prior):
        count = 4 * math.ceil(90 / plan.yaw_step_deg)
        return [360 * index / count for index in range(count)]
    return [prior.yaw_deg + offset for offset in _steps(SPREAD * prior.yaw_sigma_deg, plan.yaw_step_deg)]


def _steps(reach: float, step: float) -> list[float]:
    """Return -reach to reach through 0 in equal steps of at most `step`."""
    count = math.ceil(reach / step - 1e-9)
    return [reach * index / count for index in range(-count, count + 1)] if count else [0.0]


@dataclass(frozen=True, kw_only=True)
class _Level:
    """One pass of refinement: samples of the view, first steps (m, degrees, 1), and number of halvings."""

    samples: Samples
    steps: tuple[float, float, float]
    halvings: int


@dataclass(frozen=True, kw_only=True)
class VoteSearch:
    """Search for one view on one map."""

    chart: Chart
    view: View
    prior: Prior
    plan: VotePlan

    def places(self, count: int) -> Voted:
        """Find the best modes within the prior; none where no pose shows enough of the map."""
        plan, factor = self.plan, self._factor()
        tiles = self._tiles_of_prior(factor)
        votes, points_m = _joined(tiles, self._vote(tiles, factor))
        coarse = self._peaks(votes, points_m, most=max(plan.modes, 2 * count))
        limit = self._limit(factor)
        rough = ranked(self._rough(mode, limit) for mode in coarse)
        fine = ranked(self._fine(mode, limit) for mode in rough[: max(plan.finals, count + 1)])
        null_score = above_others(votes.score, points_m, apart_m=plan.apart_m)
        return Voted(modes=[*thinned(fine, plan.apart_m)], null_score=null_score)

    def candidates(self, poses: Sequence[Pose]) -> Voted:
        """Score every candidate by the best pose near it.

        Candidates behind the first `plan.modes` of the coarse search keep their order, below all refined ones.
        """
        factor = self._cells(self.plan.coarse_m)
        tiles = [self._tile_around(pose, factor) for pose in poses]
        votes = self._vote(tiles, factor)
        rough = [self._best(tile, part) for tile, part in zip(tiles, votes, strict=True)]
        order = sorted((mode.score for mode in rough if mode), reverse=True)
        cut = order[min(self.plan.modes, len(order)) - 1] if order else NOWHERE
        fine: dict[int, Mode] = {}
        for at, mode in enumerate(rough):
            if mode is not None and mode.score >= cut:
                disc = Disc(center_m=place_m(poses[at]), radius_m=self.plan.around_m)
                fine[at] = self._fine(self._rough(mode, disc), disc)
        lowest = min((mode.score for mode in fine.values()), default=0.0)
        modes = [
            fine.get(at, mode and replace(mode, score=lowest - (cut - mode.score))) for at, mode in enumerate(rough)
        ]
        joined, points_m = _joined(tiles, votes)
        return Voted(modes=modes, null_score=above_others(joined.score, points_m, apart_m=self.plan.apart_m))

    # Where

    def _cells(self, size_m: float) -> int:
        return max(1, round(size_m / self.chart.grid.cell_size_m))

    def _factor(self) -> int:
        top, left, bottom, right = self._box()
        area_m2 = max(bottom - top, 0) * max(right - left, 0) * self.chart.grid.cell_size_m**2
        return self._cells(self.plan.coarse_wide_m if area_m2 > self.plan.wide_m2 else self.plan.coarse_m)

    def _box(self) -> tuple[int, int, int, int]:
        """Return the top, left, bottom and right cell of the searched places: the box of the disc, or the whole map."""
        rows, cols = self.chart.grid.shape
        if self.prior.center_m is None or self.prior.radius_m is None:
            return 0, 0, rows, cols
        row, col = self.chart.grid.to_cells(np.array([self.prior.center_m]))[0].tolist()
        reach = math.ceil(self.prior.radius_m / self.chart.grid.cell_size_m)
        return max(row - reach, 0), max(col - reach, 0), min(row + reach + 1, rows), min(col + reach + 1, cols)

    def _limit(self, factor: int) -> Disc:
        around_m = factor * self.chart.grid.cell_size_m
        return Disc(center_m=self.prior.center_m, radius_m=(self.prior.radius_m or 0.0) + around_m)

    def _half(self, factor: int) -> int:
        largest = self._turns[-1].scale
        return math.ceil(self.view.reach_m * largest / (factor * self.chart.grid.cell_size_m)) + 1

    def _tiles_of_prior(self, factor: int) -> list[_Tile]:
        top, left, bottom, right = self._box()
        if top >= bottom or left >= right:
            return []
        # 256 places a side of a tile: larger ones take more memory and save no time
        count = min(256, -(-max(bottom - top, right - left) // factor))
        limit = self._limit(factor)
        starts = [
            (row, col) for row in range(top, bottom, count * factor) for col in range(left, right, count * factor)
        ]
        return [self._tile(row, col, count, factor, limit) for row, col in starts]

    def _tile_around(self, pose: Pose, factor: int) -> _Tile:
        """Return places around a candidate, on a lattice tied to it: equal maps give equal votes anywhere."""
        row, col = self.chart.grid.to_cells(np.array([place_m(pose)]))[0].tolist()
        reach = math.ceil(self.plan.around_m / (factor * self.chart.grid.cell_size_m))
        back = reach * factor + factor // 2
        disc = Disc(center_m=place_m(pose), radius_m=self.plan.around_m)
        return self._tile(row - back, col - back, 2 * reach + 1, factor, disc)

    def _tile(self, row: int, col: int, count: int, factor: int, disc: Disc) -> _Tile:
        """Return a tile of `count` coarse cells a side that begins at a cell of the map."""
        half = self._half(factor)
        side = count + 2 * half
        layers = self.chart.pooled(row - half * factor, col - half * factor, side, factor, self.view.bands)
        cells = np.column_stack([index.ravel() for index in np.indices((count, count))])
        points_m = self.chart.grid.window(row, col, count * factor, count * factor).coarsen(factor).to_centres_m(cells)
        west_m, south_m, east_m, north_m = self.chart.grid.bounds_m
        on_map = (points_m >= (west_m, south_m)).all(axis=1) & (points_m <= (east_m, north_m)).all(axis=1)
        return _Tile(layers=layers, points_m=points_m, allowed=disc.holds(points_m) & on_map)

    # Coarse

    @cached_property
    def _turns(self) -> tuple[Pose, ...]:
        return turns(self.prior, self.plan)

    def _vote(self, tiles: Sequence[_Tile], factor: int) -> list[_Votes]:
        """Return the best score and turn of every place; each template is transformed once for all tiles."""
        if not tiles:
            return []
        best = [np.full(len(tile.points_m), NOWHERE, dtype=np.float32) for tile in tiles]
        turn = [np.zeros(len(tile.points_m), dtype=np.int64) for tile in tiles]
        step_m = factor * self.chart.grid.cell_size_m
        half = self._half(factor)
        places, high = math.isqrt(len(tiles[0].points_m)), 2 * half + 1
        # Classes that the map lacks here add nothing
        held = [any(tile.layers[band].any() for tile in tiles) for band in range(len(self.view.bands))]
        blurred = np.ascontiguousarray(self.view.blurred(step_m)[[*held, True, True]].transpose(1, 2, 0))
        quarters = self._quarters(places, len(tiles))
        how = (ByRows if places <= _FEW else ByPlanes).of(
            places=places, high=high, bands=blurred.shape[-1], windows=quarters * len(tiles)
        )
        windows = [how.window(_turned_back(tile.layers[[*held, True]], quarters)) for tile in tiles]
        for some in self._batches(quarters, how.at_once(blurred.shape[-1])):
            templates = np.stack(
                [self.view.turned(blurred, self._turns[at], half=half, step_m=step_m) for at in some[:, 0]]
            )
            known = templates[:, -1].sum(axis=(1, 2), dtype=np.float64)
            least = np.where(known > 0, self.plan.least_overlap * known, math.inf).astype(np.float32)
            spectrum = how.templates(templates)
            for tile, window, top, which in zip(tiles, windows, best, turn, strict=True):
                score, counted = how.votes(window, spectrum, least)
                is_unknown = counted < least[:, None, None, None]
                score /= np.maximum(counted, 1e-6, out=counted)  # known cells: less is rounding of the transform
                np.copyto(score, NOWHERE, where=is_unknown)
                for k in range(1, quarters):
                    score[:, k] = np.rot90(score[:, k], -k, (1, 2))
                score = score.reshape(some.size, -1)
                highest = score.max(axis=0) if some.size > 1 else score[0]
                better = tile.allowed & (highest > top)
                np.copyto(top, highest, where=better)
                which[better] = some.ravel()[score[:, better].argmax(axis=0)] if some.size > 1 else some[0, 0]
        return [_Votes(score=top.astype(np.float64), turn=which) for top, which in zip(best, turn, strict=True)]

    def _quarters(self, places: int, tiles: int) -> int:
        """Return how many headings share a template: 4 if all are searched and windows take little memory, else 1."""
        return 4 if _is_any_heading(self.prior) and (places <= _FEW or tiles == 1) else 1

    def _batches(self, quarters: int, at_once: int) -> list[NDArray[np.int64]]:
        """Return indices of turns, shape (some, quarters): each with those at right angles to it."""
        index = np.arange(len(self._turns)).reshape(-1, quarters, len(_yaws_deg(self.prior, self.plan)) // quarters)
        together = index.transpose(0, 2, 1).reshape(-1, quarters)
        return np.split(together, range(at_once, len(together), at_once))

    def _best(self, tile: _Tile, votes: _Votes) -> Mode | None:
        """Return the best place of a tile, if there is any."""
        at = int(np.argmax(votes.score))
        return self._mode(tile.points_m[at], votes, at) if votes.score[at] > NOWHERE else None

    def _mode(self, point_m: NDArray[np.float64], votes: _Votes, at: int) -> Mode:
        turn = self._turns[votes.turn[at]]
        pose = replace(turn, easting_m=float(point_m[0]), northing_m=float(point_m[1]))
        return Mode(pose=pose, score=float(votes.score[at]))

    def _peaks(self, votes: _Votes, points_m: NDArray[np.float64], *, most: int) -> list[Mode]:
        """Return the best modes, none nearer to a better one than `apart_m`."""
        left = votes.score.copy()
        easting_m, northing_m = points_m.T.copy()
        found: list[Mode] = []
        while len(found) < min(most, len(left)):
            at = int(np.argmax(left))
            if not left[at] > NOWHERE:
                break
            found.append(self._mode(points_m[at], votes, at))
            away_m2 = (easting_m - easting_m[at]) ** 2 + (northing_m - northing_m[at]) ** 2
            left[away_m2 < self.plan.apart_m**2] = NOWHERE
        return found

    # Fine

    @cached_property
    def _levels(self) -> tuple[_Level, _Level, _Level]:
        """Return the passes of refinement: blurred squares, then some cells of the view on the map, then all."""
        cell_m, blur_m = self.chart.grid.cell_size_m, self.plan.coarse_m
        yaw_deg, scale = self.plan.yaw_step_deg, self.plan.scale_step
        blurred = self.view.samples(
            self.view.blurred(blur_m), stride=max(1, round(blur_m / self.view.grid.cell_size_m))
        )
        # 96 cells a side: enough for the first steps
        some = self.view.samples(self.view.template, stride=max(1, round(max(self.view.grid.shape) / 96)))
        every = self.view.samples(self.view.template, stride=1)
        return (
            _Level(samples=blurred, steps=(blur_m / 2, yaw_deg / 2, scale / 2), halvings=2),
            _Level(samples=some, steps=(cell_m, yaw_deg / 4, scale / 4), halvings=2),
            _Level(samples=every, steps=(cell_m / 4, yaw_deg / 16, scale / 16), halvings=1),
        )

    def _rough(self, mode: Mode, disc: Disc) -> Mode:
        patch = self._patch(mode, factor=self._cells(self.plan.coarse_m / 2))
        return self._climbed(mode, self._levels[0], patch, disc)

    def _fine(self, mode: Mode, disc: Disc) -> Mode:
        patch = self._patch(mode, factor=1)
        for level in self._levels[1:]:
            mode = self._climbed(mode, level, patch, disc)
        return mode

    def _patch(self, mode: Mode, *, factor: int) -> Patch:
        half_m = self.view.reach_m * (self._turns[-1].scale + _WIDEN) + 2 * _MARGIN_M
        return Patch.around(self.chart, self.view.bands, place_m(mode.pose), half_m, factor=factor)

    def _climbed(self, mode: Mode, level: _Level, patch: Patch, disc: Disc) -> Mode:
        low, high = self._turns[0].scale - _WIDEN, self._turns[-1].scale + _WIDEN
        near = Disc(center_m=place_m(mode.pose), radius_m=_MARGIN_M)

        @cache
        def score_of(pose: Pose) -> float:
            """Score a pose; return NOWHERE beyond the neighbourhood. Some poses are visited twice."""
            if not (low <= pose.scale <= high and near.has(pose) and disc.has(pose)):
                return NOWHERE
            return patch.score(level.samples, pose, least_overlap=self.plan.least_overlap)

        best = replace(mode, score=patch.score(level.samples, mode.pose, least_overlap=self.plan.least_overlap))
        for halving in range(level.halvings):
            best = _climb(best, score_of, tuple(step / 2**halving for step in level.steps))
        return best


def _turned_back(layers: NDArray[np.float32], quarters: int) -> NDArray[np.float32]:
    """Turn squares counter-clockwise by 0, 1, .. right angles, in place of turning the template clockwise."""
    return np.stack([np.rot90(layers, k, (1, 2)) for k in range(quarters)])


def _joined(tiles: Sequence[_Tile], parts: Sequence[_Votes]) -> tuple[_Votes, NDArray[np.float64]]:
    score = np.concatenate([np.zeros(0), *(part.score for part in parts)])
    turn = np.concatenate([np.zeros(0, dtype=np.int64), *(part.turn for part in parts)])
    points_m = np.concatenate([np.zeros((0, 2)), *(tile.points_m for tile in tiles)])
    return _Votes(score=score, turn=turn), points_m


def above_others(score: NDArray[np.float64], points_m: NDArray[np.float64], *, apart_m: float) -> float:
    """Return the lead of the best score over those at least `apart_m` away, in their standard deviations; else 0.

    Examples
    --------
    >>> above_others(np.array([5.0, 4.0, 1.0, -1.0]), np.array([(0.0, 0), (1, 0), (9, 0), (-9, 0)]), apart_m=2.0)
    5.0
    """
    if not len(score):
        return 0.0
    at = int(np.argmax(score))
    others = score[(score > NOWHERE) & (np.hypot(*(points_m - points_m[at]).T) >= apart_m)]
    spread = float(others.std()) if len(others) > 1 else 0.0
    return float(score[at] - others.mean()) / spread if spread > 0 else 0.0


def _climb(best: Mode, score_of: Callable[[Pose], float], steps: Sequence[float]) -> Mode:
    """Step along place, heading and scale, one at a time, while the score improves."""
    metres, degrees, scale = steps
    for _ in range(8):  # rounds of steps of one size
        before = best
        for name, step in (("easting_m", metres), ("northing_m", metres), ("yaw_deg", degrees), ("scale", scale)):
            for sign in (1, -1):
                pose = replace(best.pose, **{name: getattr(best.pose, name) + sign * step})
                score = score_of(pose)
                if score > best.score:
                    best = Mode(pose=pose, score=score)
                    break
        if best is before:
            break
    return best


def ranked(modes: Iterable[Mode]) -> list[Mode]:
    """Sort modes, best first; ties keep their order."""
    return sorted((mode for mode in modes if mode.score > NOWHERE), key=lambda mode: -mode.score)
