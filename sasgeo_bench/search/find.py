# SPDX-License-Identifier: Apache-2.0
"""Search by sums of likelihoods: the whole prior on coarse cells, the best modes on ever finer ones."""

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial
from itertools import product
from typing import Final

import numpy as np

from sasgeo_bench.geometry.grid import Grid
from sasgeo_bench.geometry.pose import Pose, Prior, wrap_deg
from sasgeo_bench.search.dense import Guess, LevelView, Stride, climbed, dense, polished
from sasgeo_bench.search.field import Levels, Template
from sasgeo_bench.search.plan import (
    NO_PLACE,
    Disc,
    Found,
    Mode,
    Null,
    Plan,
    Tile,
    Turns,
    all_around,
    in_threads,
    place_m,
    thinned,
    tiles_of,
    turns_of,
)

PATCH_KM2: Final = 17.0  # of places: a town, for which the beam was chosen
_NOTHING: Final = 1e-9
_CORNER: Final = math.sqrt(0.5)  # cells from the middle of one to its corner
_HEADINGS: Final = 2  # guesses that a beam keeps of one place: on large cells the best heading is often a wrong one
_SPARE: Final = 1.5  # times the beam, of guesses to choose from


def search(
    field: Levels,
    template: Template,
    prior: Prior,
    plan: Plan | None = None,
    *,
    count: int = 10,
    starts: Sequence[Pose] = (),
) -> Found:
    """Find the best modes within a prior, coarse to fine: at most `count`, best first.

    Poses in `starts` are refined like those of the search if they score as well. Modes lie at least `plan.apart_m` from
    each other; there are none for an empty template or a prior beyond the map. Modes that the beam dropped keep the
    order of a coarser level, below all refined ones.

    Examples
    --------
    >>> import numpy as np
    >>> from sasgeo_bench.search.field import FULL, Field
    >>> rng = np.random.default_rng(0)
    >>> town = np.where(rng.random((1, 64, 64)) < 0.1, FULL, 0).astype(np.uint8)
    >>> grid = Grid(epsg=32632, west_m=0.0, north_m=64.0, cell_size_m=1.0, rows=64, cols=64)
    >>> field = Field.of(grid=grid, layers=town, known=np.full((64, 64), FULL, np.uint8))
    >>> seen = (town[:, 20:52, 10:42] / FULL).astype(np.float32)
    >>> view = Template(weights=2 * seen - 0.5, known=-seen[0], cell_size_m=1.0)
    >>> where = Prior(center_m=None, radius_m=None, yaw_deg=0.0, yaw_sigma_deg=2.0, scale_sigma=0.0)
    >>> best = search(field, view, where).modes[0].pose
    >>> round(best.easting_m), round(best.northing_m)
    (26, 28)
    """
    return Search(field=field, template=template, prior=prior, plan=plan or Plan()).places(count, starts)


def rank(
    field: Levels, template: Template, prior: Prior, poses: Sequence[Pose], plan: Plan | None = None
) -> tuple[list[Mode | None], Null]:
    """Return the best mode near each candidate, None where there is none, and statistics of coarse scores.

    Candidates that the beam drops keep their order, below all refined ones.
    """
    return Search(field=field, template=template, prior=prior, plan=plan or Plan()).candidates(poses)


def exhaustive(field: Levels, template: Template, *, yaw_step_deg: float, threads: int = 1) -> Mode:
    """Return the best mode over all cells and headings on the map's own cells: a slow reference."""
    tiles = tiles_of(field.grid, field.grid, Disc(center_m=None, radius_m=0.0))
    found, _ = dense(field.level(1), template, tiles, all_around(yaw_step_deg), most=1, threads=threads)
    return max((mode for modes in found for mode in modes), key=lambda mode: mode.score)


def score_at(field: Levels, template: Template, pose: Pose) -> float:
    """Return the score of one pose on the map's own cells, as `Template` defines it."""
    return LevelView.of(field, template, 1).score(pose)


@dataclass(frozen=True, kw_only=True)
class Search:
    """Search for one view on one map; its headings, and scales, lie at most `yaw_step_deg` apart."""

    field: Levels
    template: Template
    prior: Prior
    plan: Plan
    yaw_step_deg: float = math.inf

    def places(self, count: int, starts: Sequence[Pose]) -> Found:
        """Return the best modes within the prior."""
        guesses, null = self._begun(self.tiles, most=math.ceil(_SPARE * self.plan.width(0, self.patches)))
        guesses = _ranked([*(replace(guess, owner=0) for guess in guesses), *self._proposed(starts)])
        followed = self._followed(guesses, [self.disc], patches=self.patches)
        near = self.within(1)  # dropped modes were limited by larger cells
        inside = (guess.mode for guess in followed if near.holds(np.array([place_m(guess.mode.pose)]))[0])
        return Found(modes=tuple(thinned(inside, self.plan.apart_m, count)), null=null)

    def _proposed(self, starts: Sequence[Pose]) -> list[Guess]:
        if not starts or not len(self.template.active):
            return []
        level_view = LevelView.of(self.field, self.template, self.factor)
        return [Guess(mode=Mode(pose=pose, score=level_view.score(pose)), owner=0) for pose in starts]

    def candidates(self, poses: Sequence[Pose]) -> tuple[list[Mode | None], Null]:
        """Return the best mode near each pose."""
        discs = [Disc(center_m=place_m(pose), radius_m=self.plan.around_m) for pose in poses]
        wide = [disc.wider(_CORNER * self._coarse_m) for disc in discs]
        tiles = [(tiles_of(self._coarse_grid, self.field.grid, disc) or [NO_PLACE])[0] for disc in wide]
        guesses, null = self._begun(tiles, most=self.plan.each)
        best: list[Mode | None] = [None] * len(poses)
        for guess in reversed(self._followed(guesses, discs)):
            best[guess.owner] = guess.mode
        return best, null

    @cached_property
    def factor(self) -> int:
        """Return map cells a side of the largest cell that leaves `plan.cells` along the side of the view."""
        most = self.template.side_m / (self.plan.cells * self.field.grid.cell_size_m)
        return 1 << max(0, math.floor(math.log2(max(most, 1.0)) + _NOTHING))

    @property
    def disc(self) -> Disc:
        """Return the disc of the prior."""
        return Disc(center_m=self.prior.center_m, radius_m=self.prior.radius_m or 0.0)

    def within(self, factor: int) -> Disc:
        """Return the disc of the prior, wider by the corner of a cell of a level."""
        return self.disc.wider(_CORNER * factor * self.field.grid.cell_size_m)

    @cached_property
    def tiles(self) -> list[Tile]:
        """Return the places of the coarsest level that the prior allows."""
        return tiles_of(self._coarse_grid, self.field.grid, self.within(self.factor))

    @property
    def _coarse_grid(self) -> Grid:
        return self.field.grid.coarsen(self.factor)

    @property
    def _coarse_m(self) -> float:
        return self._coarse_grid.cell_size_m

    @property
    def patches(self) -> int:
        """Return how many times the beam of `PATCH_KM2` is kept for the places that the prior allows, one at least.

        With the power 3/4 of the area: over Liechtenstein the best of seven views score as those of a beam for each
        patch do, or 0.03 nats less, in half of its time.
        """
        allowed = sum(int(tile.allowed.sum()) for tile in self.tiles)
        # 0.75: growth of the beam with the area
        return max(1, round(math.pow(allowed * (self._coarse_m / 1000) ** 2 / PATCH_KM2, 0.75)))

    @cached_property
    def turns(self) -> Turns:
        """Return headings and scales whose neighbours differ by at most a coarse cell at the side of the view."""
        step = min(self._coarse_m / (self.template.side_m / 2), math.radians(self.yaw_step_deg))
        return turns_of(self.prior, spread=self.plan.spread, step=step)

    def _begun(self, tiles: Sequence[Tile], *, most: int) -> tuple[list[Guess], Null]:
        level = self.field.level(self.factor)
        found, null = dense(level, self.template, tiles, self.turns, most=most, threads=self.plan.threads)
        return _ranked(Guess(mode=mode, owner=owner) for owner, modes in enumerate(found) for mode in modes), null

    def _followed(self, guesses: list[Guess], discs: Sequence[Disc], *, patches: int = 1) -> list[Guess]:
        """Refine the best to the map's own cells and between them; best first, then dropped ones."""
        stride = Stride(yaw_deg=self.turns.yaw_step_deg, scale=self.turns.scale_step)
        kept, rest = self._cut(guesses, self.plan.width(0, patches))
        behind, factor = [rest], self.factor
        with in_threads(self.plan.threads) as mapped:
            while factor > 1:
                factor, stride = factor // 2, stride.half()
                step = partial(climbed, LevelView.of(self.field, self.template, factor), stride)
                near = [disc.wider(_CORNER * factor * self.field.grid.cell_size_m) for disc in discs]
                moved = _ranked(mapped(step, kept, [near[guess.owner] for guess in kept]))
                merged = _merged(moved, factor * self.field.grid.cell_size_m, stride.yaw_deg)
                kept, rest = self._cut(merged, self.plan.width(len(behind), patches))
                behind.append(rest)
            near = [disc.wider(_CORNER * self.field.grid.cell_size_m) for disc in discs]
            level_view = LevelView.of(self.field, self.template, 1)
            for move in (climbed, climbed, polished):
                kept = _ranked(mapped(partial(move, level_view, stride), kept, [near[guess.owner] for guess in kept]))
                stride = stride.half()
        for rest in reversed(behind):
            kept = [*kept, *_below(kept, rest)]
        return kept

    def _cut(self, guesses: Sequence[Guess], width: int) -> tuple[list[Guess], list[Guess]]:
        """Return the best guesses, few of each place, so that copies of one do not fill the beam; and all others.

        The latter begin with the last that is kept, and none counts for more than it.
        """
        kept: list[Guess] = []
        rest: list[Guess] = []
        near: dict[tuple[int, int, int], list[Guess]] = {}
        side_m = max(self.plan.apart_m, _NOTHING)
        for guess in guesses:
            place = place_m(guess.mode.pose)
            row, col = (math.floor(at_m / side_m) for at_m in place)
            around = product((row - 1, row, row + 1), (col - 1, col, col + 1), (guess.owner,))
            others = (other for key in around for other in near.get(key, ()))
            alike = sum(math.dist(place, place_m(other.mode.pose)) < self.plan.apart_m for other in others)
            if len(kept) < width and alike < _HEADINGS:
                kept.append(guess)
                near.setdefault((row, col, guess.owner), []).append(guess)
            else:
                rest.append(guess)
        if not rest:
            return kept, []
        last = kept[-1].mode.score
        lower = (replace(guess.mode, score=min(last, guess.mode.score)) for guess in rest)
        return kept, [kept[-1], *(replace(guess, mode=mode) for guess, mode in zip(rest, lower, strict=True))]


def _ranked(guesses: Iterable[Guess]) -> list[Guess]:
    """Sort guesses, best first; ties keep their order. Guesses outside of their disc are dropped."""
    return sorted((guess for guess in guesses if math.isfinite(guess.mode.score)), key=lambda guess: -guess.mode.score)


def _merged(guesses: Sequence[Guess], apart_m: float, apart_deg: float) -> list[Guess]:
    kept: list[Guess] = []
    for guess in guesses:
        pose, owner = guess.mode.pose, guess.owner
        others = (other.mode.pose for other in kept if other.owner == owner)
        if not any(
            math.dist(place_m(pose), place_m(other)) <= apart_m
            and abs(wrap_deg(pose.yaw_deg - other.yaw_deg)) <= apart_deg
            for other in others
        ):
            kept.append(guess)
    return kept


def _below(kept: Sequence[Guess], rest: Sequence[Guess]) -> list[Guess]:
    if not kept or not rest:
        return []
    down = min(guess.mode.score for guess in kept) - rest[0].mode.score
    return [replace(guess, mode=replace(guess.mode, score=guess.mode.score + down)) for guess in rest[1:]]
