# SPDX-License-Identifier: Apache-2.0
"""Exhaustive search: a view, turned and scaled, against every place of a map by normalized cross-correlation."""

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Final, Self

import numpy as np
from numpy.typing import NDArray

import sasgeo_bench as sgb
from sasgeo_baselines.global_descriptor import separate
from sasgeo_baselines.image.view_image import ViewImage, side_of, view_image

Planes = NDArray[np.float32]
Spectra = NDArray[np.complex64]
Bounds = tuple[int, int, int, int]  # first row and column, last row and column, excluded

SPREAD: Final = 2.5  # standard deviations of heading and scale that are searched
APART_M: Final = 25.0  # between two places of an answer
AROUND_M: Final = 24.0  # a view may lie so far from its candidate
MOST_PLACES: Final = 10  # of an answer
_NOTHING: Final = 1e-3  # of the greatest energy: places below have no texture


@dataclass(frozen=True, kw_only=True)
class Stack:
    """Channels of a picture, float32 of shape (C, rows, cols), 0 where it is not known, and where it is."""

    channels: Planes
    is_known: NDArray[np.bool_]


@dataclass(frozen=True, kw_only=True)
class Field:
    """The best score of each place of a lattice, -inf where there is none, and which of `turns` has it."""

    grid: sgb.Grid
    scores: Planes
    which: NDArray[np.int32]
    turns: tuple[sgb.Pose, ...]

    def mode(self, row: int, col: int) -> sgb.Mode:
        """Return the best pose at a place, and its score."""
        turn = self.turns[int(self.which[row, col])]
        east_m, north_m = self.grid.to_centres_m(np.array([[row, col]]))[0].tolist()
        pose = sgb.Pose(easting_m=east_m, northing_m=north_m, yaw_deg=turn.yaw_deg, scale=turn.scale)
        return sgb.Mode(pose=pose, score=float(self.scores[row, col]))

    def best(self, disc: sgb.Disc, *, most: int) -> list[sgb.Mode]:
        """Return the best places within a disc, at least `APART_M` from each other, best first."""
        cells, points_m = self._places()
        allowed = disc.holds(points_m) & np.isfinite(self.scores.ravel())
        cells, points_m = cells[allowed], points_m[allowed]
        if not len(cells):
            return []
        scores = self.scores[cells[:, 0], cells[:, 1]].astype(np.float64)
        chosen = separate(points_m, scores, apart_m=APART_M, most=most)
        return [self.mode(*cells[at].tolist()) for at in chosen]

    def near(self, candidates: Sequence[sgb.Pose]) -> list[sgb.Mode | None]:
        """Return the best pose near each candidate; None where no place of the lattice has a score."""
        return [next(iter(self.best(_around(pose), most=1)), None) for pose in candidates]

    def peak(self) -> float:
        """Return by how many standard deviations of all places the best one lies above their mean, 0 if by none."""
        known = self.scores[np.isfinite(self.scores)]
        return float((known.max() - known.mean()) / known.std()) if len(known) and known.std() > 0 else 0.0

    def _places(self) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
        cells = np.column_stack([index.ravel() for index in np.indices(self.grid.shape)]).astype(np.int64)
        return cells, self.grid.to_centres_m(cells)


def _around(pose: sgb.Pose) -> sgb.Disc:
    return sgb.Disc(center_m=(pose.easting_m, pose.northing_m), radius_m=AROUND_M)


def disc_of(prior: sgb.Prior) -> sgb.Disc:
    """Return the places that a prior allows."""
    return sgb.Disc(center_m=prior.center_m, radius_m=prior.radius_m or 0.0)


def turns_for(query: sgb.Query, *, reach_m: float, step_m: float) -> tuple[sgb.Pose, ...]:
    """Return headings and scales so dense that what is `reach_m` from the middle is off by at most half of `step_m`."""
    turns = sgb.turns_of(query.prior, spread=SPREAD, step=step_m / reach_m)
    return tuple(
        sgb.Pose(easting_m=0.0, northing_m=0.0, yaw_deg=base.yaw_deg + 360.0 * at / turns.quarters, scale=base.scale)
        for at in range(turns.quarters)
        for base in turns.bases
    )


def bounds_of(query: sgb.Query, grid: sgb.Grid) -> Bounds:
    """Return the places that a query leaves open."""
    if query.track == "retrieval":
        points_m, reach_m = sgb.points_of(query.candidates), AROUND_M
        if not len(points_m):
            return 0, 0, 0, 0
    elif query.prior.center_m is not None:
        points_m, reach_m = np.array([query.prior.center_m]), query.prior.radius_m or 0.0
    else:
        return 0, 0, *grid.shape
    cells, reach = grid.to_cells(points_m), math.ceil(reach_m / grid.cell_size_m)
    (top, left), (bottom, right) = cells.min(axis=0) - reach, cells.max(axis=0) + reach + 1
    return max(int(top), 0), max(int(left), 0), min(int(bottom), grid.rows), min(int(right), grid.cols)


@dataclass(frozen=True, kw_only=True)
class Question:
    """A query to a dense search: its picture, the places that it leaves open, the headings and scales to try."""

    seen_image: ViewImage
    bounds: Bounds
    turns: tuple[sgb.Pose, ...]

    @classmethod
    def of(cls, query: sgb.Query, grid: sgb.Grid, *, gsd_m: float, step_m: float) -> Self | None:
        """Return it for a picture with pixels of `gsd_m` whose edge moves by `step_m` from turn to turn.

        None if the picture shows too little, or the query leaves no place of the lattice open.
        """
        seen_image, bounds = view_image(query, gsd_m=gsd_m), bounds_of(query, grid)
        if seen_image is None or bounds[0] >= bounds[2] or bounds[1] >= bounds[3]:
            return None
        turns = turns_for(query, reach_m=side_of(query) / 2, step_m=step_m)
        return cls(seen_image=seen_image, bounds=bounds, turns=turns)


@dataclass(frozen=True, kw_only=True)
class Search:
    """Spectra of a part of a map: `place` is the lattice of the places that are asked about.

    `channels` are the numbers of those channels that say anything in this part, `windows` their spectra under each of
    the `parts`, then those of energy and of known cells.
    """

    place: sgb.Grid
    parts: sgb.Parts
    channels: list[int]
    windows: Spectra
    least_energy: float

    @classmethod
    def of(cls, stack: Stack, grid: sgb.Grid, bounds: Bounds, *, margin: int) -> Self:
        """Cut out the places of `bounds` with `margin` cells around them, half the side of a view."""
        top, left, bottom, right = bounds
        cut = tuple(slice(max(at - margin, 0), to + margin) for at, to in ((top, bottom), (left, right)))
        before = [(max(margin - at, 0), 0) for at in (top, left)]
        channels = np.pad(stack.channels[:, *cut], [(0, 0), *before])
        known = np.pad(stack.is_known[cut], before).astype(np.float32)
        energy = (channels**2).sum(axis=0)
        used = [at for at, channel in enumerate(channels) if channel.any()]
        places = (bottom - top, right - left)
        parts = sgb.Parts.cheapest(places=places, high=2 * margin + 1, bands=len(used) + 1)
        beyond = [(0, side + 2 * margin - have) for side, have in zip(places, known.shape, strict=True)]
        return cls(
            place=grid.window(top, left, *places),
            parts=parts,
            channels=used,
            windows=parts.windows(np.pad(np.stack([*channels[used], energy, known]), [(0, 0), *beyond])),
            least_energy=_NOTHING * float(energy.mean()),
        )

    def scores(self, view: Stack) -> Planes:
        """Return the cosine of view and map at every place, -1..1; -inf where half of the view is off the map."""
        mask = view.is_known.astype(np.float32)
        weight, power = float(mask.sum()), float((view.channels**2).sum())
        found = np.full(self.place.shape, -np.inf, dtype=np.float32)
        if weight == 0 or power == 0:
            return found
        both = [(at, channel) for at, channel in enumerate(self.channels) if view.channels[channel].any()]
        *seen, under = self.parts.templates(np.stack([*(view.channels[channel] for _, channel in both), mask]))
        floor = max(self.least_energy * weight, 1e-12)
        for part, (*mapped, energies, known) in zip(self.parts.slices, self.windows, strict=True):
            shared = np.float32(weight) if self.parts.is_full(known) else self.parts.sums([known], [under])
            is_shared = shared > 0.5 * weight - 0.25  # half of a view must lie on known imagery; cells are whole
            if not is_shared.any():
                continue
            cosine = np.zeros(self.parts.shape, dtype=np.float32)
            if seen:
                energy = self.parts.sums([energies], [under])
                cosine = self.parts.sums([mapped[at] for at, _ in both], seen)
                cosine /= np.sqrt(power * np.maximum(energy, floor))
                cosine[energy <= floor] = 0
            found[part] = np.where(is_shared, cosine, -np.inf)
        return found

    def field(self, turns: Sequence[sgb.Pose], views: Iterable[Stack]) -> Field:
        """Return the best of all headings and scales, each with its view, at every place; of equal ones the first."""
        best = np.full(self.place.shape, -np.inf, dtype=np.float32)
        which = np.zeros(self.place.shape, dtype=np.int32)
        for at, (_, view) in enumerate(zip(turns, views, strict=True)):
            scores = self.scores(view)
            better = scores > best
            np.copyto(best, scores, where=better)
            np.copyto(which, at, where=better)
        return Field(grid=self.place, scores=best, which=which, turns=tuple(turns))


def size_for(turns: Sequence[sgb.Pose], side_cells: float) -> int:
    """Return the odd number of cells a side that holds a view at its largest scale."""
    return 2 * math.ceil(side_cells / 2 * max(turn.scale for turn in turns)) + 1


def answer_places(modes: Sequence[sgb.Mode], *, top_k: int, diagnostics: dict[str, float]) -> sgb.Match:
    """Return the best modes of a localization query, and the margin of the best over the next."""
    ordered = sorted(modes, key=lambda mode: -mode.score)
    given = ordered[:top_k]
    return sgb.Match(
        poses=[mode.pose for mode in given],
        scores=[mode.score for mode in given],
        diagnostics=diagnostics | margin_of(ordered),
    )


def answer_candidates(
    query: sgb.Query, found: Sequence[sgb.Mode | None], *, top_k: int, diagnostics: dict[str, float]
) -> sgb.Match:
    """Rank the candidates of a retrieval query by the mode found near each."""
    ordered = sorted((mode for mode in found if mode is not None), key=lambda mode: -mode.score)
    return sgb.ranked_candidates(
        query,
        [mode.score if mode else None for mode in found],
        top_k=top_k,
        poses=[mode.pose if mode else pose for pose, mode in zip(query.candidates, found, strict=True)],
        diagnostics=diagnostics | margin_of(ordered),
    )


def margin_of(ordered: Sequence[sgb.Mode]) -> dict[str, float]:
    """Return the number of modes and the margin of the best over the next, 0 where there is none."""
    margin = ordered[0].score - ordered[1].score if len(ordered) > 1 else 0.0
    return {"margin": margin, "modes": float(len(ordered))}
