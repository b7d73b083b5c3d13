# SPDX-License-Identifier: Apache-2.0
"""`vojir_instance_rays`: ranges and boundaries of the buildings around a place, as rays meet them (Vojir 2020)."""

import json
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import product
from typing import Final, Self

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy import fft, ndimage

from sasgeo_baselines.instance_rays import CLASS, REACH_M, BuildingMap, Floats, Points, Rays, cast
from sasgeo_baselines.learned import read_learned, sound
from sasgeo_baselines.place_matcher import PlaceMatcher, turns_within
from sasgeo_bench import (
    ABSENT,
    Disc,
    MatcherCard,
    Mode,
    Pose,
    Prior,
    Query,
    Region,
    Training,
    rotation,
    thinned,
)

RAYS: Final = 360
INDEXED: Final = 120  # rays of places of the index: three times as fast, and enough for the waves
WAVES: Final = 32  # of each signal
STEP_M: Final = 10.0  # between places
STEPS_M: Final = (5.0, 2.5)  # of a place, one after the other
LEAST_SPREAD: Final = 1e-3
APART_M: Final = 25.0

Bools = NDArray[np.bool_]


def signals(rays: Rays) -> Floats:
    """Return range, boundary and hit of each ray, 0..1, shape (N, 3, rays).

    The range is logarithmic; a boundary is where the next ray meets another building, or none.

    >>> building = np.array([[0, 1, 1, 2]], dtype=np.int32)
    >>> rays = Rays(range_m=np.float32([[80.0, 8.0, 8.0, 0.0]]), building=building, is_censored=building < 0)
    >>> signals(rays)[0].round(3).tolist()
    [[1.0, 0.5, 0.5, 0.0], [1.0, 0.0, 1.0, 1.0], [0.0, 1.0, 1.0, 1.0]]
    """
    far = np.log1p(rays.range_m) / np.log1p(REACH_M)
    changes = rays.building != np.roll(rays.building, -1, axis=1)
    return np.stack([far, changes, rays.building > 0], axis=1).astype(np.float32)


@dataclass(frozen=True, kw_only=True)
class Profiles:
    """Signals of N places, shape (N, 3, rays), and which rays are compared, shape (N, rays)."""

    values: Floats
    is_judged: Bools

    @classmethod
    def of(cls, rays: Rays, *, censors: bool) -> Self:
        """Read rays; those that end where nothing is known are left out, or taken for such without a hit."""
        judged = ~rays.is_censored if censors else np.ones(rays.is_censored.shape, dtype=bool)
        return cls(values=signals(rays), is_judged=judged)

    def compared(self, blur: int) -> Floats:
        """Return the signals as they are compared: boundaries are spread over `blur` rays, all are weighed."""
        values = self.values.copy()
        values[:, 1] = ndimage.maximum_filter1d(values[:, 1], blur, axis=-1, mode="wrap")
        return values * np.array((1.0, 1.0, 1.0), dtype=np.float32)[:, None]  # of range, boundary and hit

    def magnitudes(self) -> Floats:
        """Return magnitudes of the first waves, shape (N, 3 * WAVES): they do not turn with the view.

        Rays that are left out have the mean of the others.
        """
        judged = self.is_judged[:, None]
        count = np.maximum(judged.sum(axis=-1, keepdims=True), 1)
        mean = (self.values * judged).sum(axis=-1, keepdims=True) / count
        waves = np.abs(fft.rfft(np.where(judged, self.values, mean), axis=-1))[..., :WAVES] / self.values.shape[-1]
        return np.asarray(waves.reshape(-1, 3 * WAVES), dtype=np.float32)


def spread_of(parts: Sequence[Floats]) -> Floats:
    """Return the standard deviation of each magnitude over all places, at least `LEAST_SPREAD`, shape (3 * WAVES,)."""
    waves = np.concatenate([np.zeros((0, 3 * WAVES), dtype=np.float32), *parts])
    spread = waves.std(axis=0) if len(waves) else np.ones(3 * WAVES)
    return np.maximum(spread, LEAST_SPREAD).astype(np.float32)


def differences(seen: Profiles, mapped: Profiles, turns: NDArray[np.int64], *, blur: int) -> NDArray[np.float64]:
    """Return mean differences of one view, turned clockwise by whole rays, from places, shape (N, turns).

    They are infinite where less than half of the rays are compared.

    >>> values = np.zeros((1, 3, 8), dtype=np.float32)
    >>> values[0, 0, 2] = 0.8  # a wall on the right of the view; on the map it is in the south
    >>> seen = Profiles(values=values, is_judged=np.ones((1, 8), dtype=bool))
    >>> mapped = Profiles(values=np.roll(values, 2, axis=-1), is_judged=seen.is_judged)
    >>> differences(seen, mapped, np.array([0, 2]), blur=5).round(3).tolist()
    [[0.2, 0.0]]
    """
    mine, theirs = seen.compared(blur), mapped.compared(blur)
    found = np.full((len(theirs), len(turns)), np.inf)
    for at, turn in enumerate(turns.tolist()):
        judged = mapped.is_judged & np.roll(seen.is_judged, turn, axis=-1)
        off = (np.abs(theirs - np.roll(mine, turn, axis=-1)).sum(axis=1) * judged).sum(axis=1)
        count = judged.sum(axis=1)
        # 0.5 of the rays, where some are left out
        np.divide(off, count, out=found[:, at], where=count >= 0.5 * judged.shape[1])
    return found


def open_ground(states: NDArray[np.uint8], *, cell_m: float, within_m: float) -> NDArray[np.float64] | None:
    """Return where the rays of a view begin, cells right and down from its upper left corner; None without open ground.

    It is the cell within `within_m` of the middle that lies furthest from what is no open ground, or the nearest one
    that is open where none is within.

    >>> states = np.ones((9, 9), dtype=np.uint8)
    >>> states[:, 3:8] = ABSENT  # a street
    >>> open_ground(states, cell_m=1.0, within_m=16.0).tolist()
    [5.5, 4.5]
    """
    is_open = (states == ABSENT).astype(np.uint8)
    if not is_open.any():
        return None
    rows, cols = np.nonzero(is_open)
    middles = np.column_stack([cols, rows]) + 0.5
    away_m = np.hypot(*(middles - np.array(states.shape[::-1]) / 2).T) * cell_m
    clear = cv2.distanceTransform(is_open, cv2.DIST_L2, cv2.DIST_MASK_PRECISE)[rows, cols]
    near = away_m <= within_m
    order = np.lexsort((away_m, -clear * near)) if near.any() else np.argsort(away_m, kind="stable")
    return np.asarray(middles[order[0]])


@dataclass(frozen=True, kw_only=True)
class PreparedView:
    """A view: its rays as they are compared, its waves, and what is known of its pose.

    `start_m` is where the rays begin, (right, up) of its middle.
    """

    profile: Profiles
    waves: Floats
    start_m: Points
    prior: Prior


class VojirInstanceRays(PlaceMatcher[PreparedView]):
    """Nearest places by waves of rays, then the turn and the place by the rays themselves."""

    open_numbers = {
        "start_m": (0.0, 8.0, 16.0),  # from the middle of a view: rays of 80 m from there lie within a view of 192 m
        "shortlist": (200, 1000),  # places whose rays are compared
    }
    chosen = {"start_m": 16.0, "shortlist": 1000}

    card = MatcherCard(
        name="vojir_instance_rays",
        version="1",
        title="Ranges and boundaries of the buildings around a place",
        source=(
            "Vojir, Budvytis and Cipolla, Efficient Large-Scale Semantic Visual Localization in 2D Maps, ACCV 2020, by "
            "its abstract: panoramas from the ground, of which depth and instances of buildings are embedded and then "
            "looked up among places rendered from a map"
        ),
        ours=(
            "All but that idea, carried over to views from above: 360 rays of 80 m (a view of 192 m shows no more) "
            f"through the patches of buildings, from the most open ground within {chosen['start_m']:g} m of the middle "
            "of a view, and from open ground 10 m apart on a map, not from its roads; of each ray the logarithm of "
            "its range, whether the next one meets another building or none, and whether it meets any. For the "
            "network, magnitudes of the first 32 waves of each (of 120 rays, in steps of 2 m on the map), divided by "
            f"their spread over training places, or over the map without training; of the {chosen['shortlist']:g} "
            "nearest the mean absolute differences at each turn within 2.5 standard deviations of the prior, "
            "boundaries spread over 5 rays, all three weighing the same; the best 12 are moved in steps of 5, then "
            "2.5 m. Minus the difference is the score. By default rays that end where nothing is known count as such "
            "without a hit; the flag `censors` of the class leaves them out"
        ),
        licence="Apache-2.0",
        tracks=("retrieval", "localization"),
        limits=(
            "The source sees walls from a street, here a view sees roofs. Buildings that touch are one patch, so that "
            "the boundary between them, which the source learns from, is not seen. Withheld where no ray meets a "
            "building; all else of a map says nothing; what lies behind the first building is not compared, so that "
            "one that is missed or made up changes all rays through it; in narrow yards a place of the lattice, up to "
            "7 m off, already sees other walls; occlusion, and the edge of a view of less than 192 m, look like open "
            "ground; scale is 1, no confidence"
        ),
    )

    def __init__(self, *, censors: bool = False, **numbers: float) -> None:
        super().__init__(**numbers)
        self.censors = censors

    def learn(self, training: Training) -> str:
        """Return the spread of the magnitudes over places of training maps."""
        parts = []
        for name in dict.fromkeys(query.region for query, _ in training.pairs):
            # 50 m between places of a training map
            parts += [waves for _, waves in self._described(BuildingMap.of(training.regions[name]), 50.0)]
        return json.dumps({"spread": [round(value, 6) for value in spread_of(parts).tolist()]})

    def read(self, region: Region, learned: str | None) -> None:
        """Describe places of a map."""
        taught = None if learned is None else read_learned(self.card.name, learned, _spread)
        self._map = BuildingMap.of(region)
        grid = region.grid
        # At most 400_000 places: on a larger map they lie further apart
        least_m = float(np.sqrt(grid.rows * grid.cols / 400_000)) * grid.cell_size_m
        places_m, waves = zip(*self._described(self._map, max(STEP_M, least_m)), strict=True)
        self._places_m = np.concatenate(places_m)
        self._spread = spread_of(waves) if taught is None else taught
        self._waves = np.concatenate(waves) / self._spread

    def look(self, query: Query) -> PreparedView | None:
        """Cast rays from open ground at the middle of a view; None where they meet nothing."""
        seen = query.evidence
        if CLASS not in seen.classes:
            return None
        start = open_ground(seen.layer(CLASS), cell_m=seen.cell_size_m, within_m=self.numbers["start_m"])
        if start is None:
            return None
        rays = cast(seen.layer(CLASS), start[None], RAYS, cell_m=seen.cell_size_m)
        if not (rays.building > 0).any():
            return None
        profile = Profiles.of(rays, censors=self.censors)
        start_m = (start - np.array(seen.shape[::-1]) / 2) * (seen.cell_size_m, -seen.cell_size_m)
        few = cast(seen.layer(CLASS), start[None], INDEXED, cell_m=seen.cell_size_m)  # as on the map, for boundaries
        waves = Profiles.of(few, censors=self.censors).magnitudes()[0]
        return PreparedView(profile=profile, waves=waves, start_m=start_m, prior=query.prior)

    def modes(self, view: PreparedView, disc: Disc, *, count: int) -> list[Mode]:
        """Return the poses with the least differences, from places with similar waves."""
        near = np.flatnonzero(disc.wider(float(np.hypot(*view.start_m)) + STEP_M).holds(self._places_m))
        away = np.square(self._waves[near] - view.waves / self._spread).sum(axis=1)
        shortlist = near[np.argsort(away, kind="stable")[: int(self.numbers["shortlist"])]]
        best = thinned(_ranked(self._turned(view, self._places_m[shortlist]), disc.wider(STEP_M)), APART_M)
        refined = self._refined(view, best[: max(12, count)])  # places that are refined
        return thinned(_ranked(refined, disc.wider(STEPS_M[0])), APART_M, count)

    def _described(self, buildings: BuildingMap, step_m: float) -> Iterator[tuple[Points, Floats]]:
        grid = buildings.grid
        step = min(max(1, round(step_m / grid.cell_size_m)), grid.rows, grid.cols)
        for places_m, rays in buildings.lattice(step, INDEXED):
            yield places_m, Profiles.of(rays, censors=self.censors).magnitudes()

    def _turned(self, view: PreparedView, places_m: Points) -> list[Mode]:
        """Return the best pose whose rays begin at each place; minus infinity is the score of one that is not known."""
        turns = turns_within(view.prior, RAYS)
        mapped = Profiles.of(self._map.rays(places_m, RAYS), censors=self.censors)
        # 5 rays over which a boundary is spread: a degree off, it still overlaps
        found = differences(view.profile, mapped, turns, blur=5)
        best = found.argmin(axis=1)
        yaws_deg, least = turns[best] * (360.0 / RAYS), found[np.arange(len(found)), best]
        modes = []
        for place_m, yaw_deg, off in zip(places_m, yaws_deg.tolist(), least.tolist(), strict=True):
            east_m, north_m = (place_m - rotation(yaw_deg) @ view.start_m).tolist()
            modes.append(Mode(pose=Pose(easting_m=east_m, northing_m=north_m, yaw_deg=yaw_deg), score=-off))
        return modes

    def _refined(self, view: PreparedView, modes: list[Mode]) -> list[Mode]:
        """Move each mode to the best place around it, in smaller and smaller steps."""
        for step_m in STEPS_M:
            around_m = step_m * np.array([(0, 0), *(way for way in product((-1, 0, 1), repeat=2) if any(way))])
            starts_m = np.array([mode.pose.to_map(view.start_m[None])[0] for mode in modes]).reshape(-1, 2)
            found = self._turned(view, (starts_m[:, None] + around_m).reshape(-1, 2))
            modes = [
                max(found[at : at + len(around_m)], key=lambda mode: mode.score)
                for at in range(0, len(found), len(around_m))
            ]
        return modes


def _ranked(modes: Sequence[Mode], disc: Disc) -> list[Mode]:
    return sorted(
        (mode for mode in modes if np.isfinite(mode.score) and disc.has(mode.pose)), key=lambda mode: -mode.score
    )


def _spread(saved: dict[str, list[float]]) -> Floats:
    """Return the learned spread; raise where it is none."""
    found = np.array(saved["spread"], dtype=np.float32)
    return sound(found, is_sound=found.ndim == 1 and bool((np.isfinite(found) & (found > 0)).all()))
