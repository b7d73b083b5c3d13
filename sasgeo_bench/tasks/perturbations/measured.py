# SPDX-License-Identifier: Apache-2.0
"""The detector "measured": recall and precision from confusions that were measured, and errors of another structure.

It shares no error with the detector "published". Ground that shows nothing becomes building and road, small things are
missed more often than large ones, fields are confused as a whole, outlines bulge and shrink over tens of metres, and a
bad view is bad for all classes.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Annotated, Final

import cv2
import numpy as np
from numpy.typing import NDArray
from pydantic import Field as Limits

from sasgeo_bench.core.config import Document
from sasgeo_bench.osm.taxonomy import MeasuredErrors, load_taxonomy
from sasgeo_bench.regions.evidence import PRESENT, UNKNOWN, Evidence
from sasgeo_bench.tasks.perturbations.base import (
    SIGMA,
    Field,
    Mask,
    NoisePool,
    check_ranges,
    dilated,
    disc,
    find_objects,
    hide,
    highest_within,
    with_cells,
)
from sasgeo_bench.tasks.perturbations.streams import Streams

MEASURED: Final[Mapping[str, MeasuredErrors]] = {item.name: item.measured for item in load_taxonomy().classes}

QUALITY: Final = 0.35  # spread of the logarithm of the error over views, common to all classes
CLASS_SPREAD: Final = 0.15  # spread beside it of each class in each view
GROUND_M: Final = 60.0  # width of patches of ground that are called another class
BAND_M: Final = (12.0, 60.0)  # lengths of false lines
YARD_M: Final = 4.5  # from a road or building
FAR_SHARE: Final = 0.02  # how much rarer false roads and buildings are on ground farther away; a guess
_PINHOLE_CELLS: Final = 1.5
_MOST_ERROR: Final = 0.95
_MOST_GROUND: Final = 0.5
# Deviation of the waves of silence, of the logarithm of the distance to an outline. Of a withheld and a given answer of
# `osm_unet_held_out` the withheld one is nearer to an outline in 0.8 to 0.9 of all pairs (20 views), and so it is here.
DOUBT: Final = 0.5
_TRIES: Final = 5  # draws of a false object for each that is expected

Share = Annotated[float, Limits(ge=0, le=1)]


class Silence(Document):
    """Shares of a detector's answers on one class that it withholds, by what these are.

    Of the class where it is seen (`found`) and where it is not (`missed`), and of other ground where the class is seen
    (`alarm`) and where it is not (`absent`).
    """

    found: Share
    missed: Share
    alarm: Share
    absent: Share


@dataclass(frozen=True, kw_only=True)
class MeasuredPerception:
    """See a clean view with the errors of the detector "measured", or of a segmenter's profile.

    `error_factor` multiplies the errors of every class; 0 is a perfect detector. At most 0.95 of a class is lost, and
    at most half of the yards, or of the ground, becomes one class. `errors` are those of each class, by default those
    of the taxonomy; a class without any is seen as it is. Those of a segmenter come from its profile:
    `read_profile(path).perception()`. With the `silence` of a class a share of its cells, right and wrong, is unknown
    after all errors are drawn: the errors are the same with it and without it.

    Notes
    -----
    A class loses what is called another class, then small objects, then bites of its outline or stretches of a line.
    It gains what others are called, then bulges of its outline, then objects of its own shape: blocks for buildings,
    bands for lines, patches for areas. False buildings and roads lie on empty ground, mostly beside others.
    Unknown cells lie along the outlines of what is seen, each class by itself, as those of `osm_unet_held_out` do.
    The tests hold recall, precision and the fractions of the yards to the table, pooled over views of towns.
    """

    error_factor: float = 1.0
    errors: Mapping[str, MeasuredErrors] = field(default_factory=lambda: MEASURED, repr=False, hash=False)
    silence: Mapping[str, Silence] = field(default_factory=dict, repr=False, hash=False)

    def __post_init__(self) -> None:
        check_ranges(self, error_factor=(0, 20))

    def __call__(self, evidence: Evidence, rng: np.random.Generator, /) -> Evidence:
        """Lose cells of each class, then gain: a class first gains what another one is called."""
        if self.error_factor == 0:
            return evidence
        streams = Streams(rng)
        view = _View.of(evidence, self.errors, streams)
        factors = self.error_factor * _spread(evidence.classes, streams)
        seen: dict[str, Mask] = {}
        called: dict[str, list[Mask]] = {}
        for name, mask, factor in zip(evidence.classes, view.masks, factors, strict=True):
            seen[name] = view.lose(name, mask, float(factor), called, streams.of(name))
        for name, mask, factor in zip(evidence.classes, view.masks, factors, strict=True):
            view.gain(name, mask, seen[name], float(factor), streams.of(name))
            for taken in called.get(name, ()):
                np.logical_or(seen[name], taken & ~view.unknown[view.at[name]], out=seen[name])
        after = with_cells(evidence, np.stack(list(seen.values())).view(np.uint8))
        silent = np.zeros_like(view.masks)
        for name, shares in self.silence.items():
            if name in seen:
                silent[view.at[name]] = view.silent(name, seen[name], shares, streams.of(f"silence of {name}"))
        return hide(after, silent)


def _spread(classes: Sequence[str], streams: Streams) -> NDArray[np.float64]:
    """Draw factors of the errors with mean 1: one of the view, common to all classes, times one of each class."""
    whole = streams.view.lognormal(-(QUALITY**2) / 2, QUALITY)
    own = [streams.of(name).lognormal(-(CLASS_SPREAD**2) / 2, CLASS_SPREAD) for name in classes]
    return whole * np.array(own)


OUTLINE_M: Final = 25.0  # length of the stretches over which outlines bulge or shrink


HIDDEN_M: Final = 30.0  # length of hidden stretches of lines


ALARM_M2: Final = 30.0  # median area of a false building


_ROUNDED_M: Final = 0.8  # corners are rounded by a blur of this deviation


PATCH_M: Final = 35.0  # width of false patches of area classes


@dataclass(frozen=True, slots=True, kw_only=True)
class _View:
    """One clean view; `ground` is where no class, or bare ground, is; `yards` the part beside roads and buildings."""

    cell_m: float
    masks: NDArray[np.bool_]
    unknown: NDArray[np.bool_]
    at: Mapping[str, int]
    ground: Mask
    yards: Mask
    pool: NoisePool
    errors: Mapping[str, MeasuredErrors]
    outlines: dict[str, Field] = field(default_factory=dict)

    @classmethod
    def of(cls, evidence: Evidence, errors: Mapping[str, MeasuredErrors], streams: Streams) -> "_View":
        masks, unknown = evidence.cells == PRESENT, evidence.cells == UNKNOWN
        shows = [not (name in errors and errors[name].is_ground) for name in evidence.classes]
        ground = ~(masks | unknown)[shows].any(axis=0)
        built = [index for index, name in enumerate(evidence.classes) if name in load_taxonomy().having("built")]
        beside = dilated(masks[built].any(axis=0), YARD_M / evidence.cell_size_m)
        return cls(
            cell_m=evidence.cell_size_m,
            masks=masks,
            unknown=unknown,
            at={name: index for index, name in enumerate(evidence.classes)},
            ground=ground,
            yards=ground & beside,
            pool=NoisePool(evidence.shape, streams),
            errors=errors,
        )

    def noise(self, width_m: float, rng: np.random.Generator) -> Field:
        """Draw smooth noise of deviation 1."""
        return self.pool.take(width_m / self.cell_m, rng) / np.float32(SIGMA)

    def outline(self, name: str, rng: np.random.Generator) -> Field:
        """Return the noise of a class's outline: it bulges where this is high, and shrinks where it is low."""
        if name not in self.outlines:
            self.outlines[name] = self.noise(OUTLINE_M, rng)
        return self.outlines[name]

    def any_of(self, names: tuple[str, ...]) -> Mask:
        found = [self.masks[self.at[name]] for name in names if name in self.at]
        return np.any(found, axis=0) if found else np.zeros_like(self.ground)

    def lose(
        self, name: str, mask: Mask, factor: float, called: dict[str, list[Mask]], rng: np.random.Generator
    ) -> Mask:
        """Return what is still seen of a class; add to `called` what is seen as another one."""
        errors, total = self.errors.get(name), np.count_nonzero(mask)
        if errors is None or total == 0:
            return mask.copy()
        lost = min(factor * (1 - errors.recall), _MOST_ERROR)
        kept = mask.copy()
        for other, share in errors.called.items():
            confused = self._confused(kept, lost * share / (1 - errors.recall) * total, rng)
            called.setdefault(other, []).append(confused)
            kept &= ~confused
        for other, share in errors.also.items():
            both = self._confused(kept, min(factor * share, _MOST_ERROR) * total, rng)
            called.setdefault(other, []).append(both)
        budget = lost * total - (total - np.count_nonzero(kept))
        limit = errors.small_share * max(budget, 1.0)
        kept &= ~self._small(kept, errors.small_m2, min(factor, 1.0), limit, rng)
        if name in load_taxonomy().lines:
            score = self.noise(HIDDEN_M, rng)
        else:
            kept &= _rounded(mask, _ROUNDED_M * min(factor, 2.0) / self.cell_m)
            score = -errors.bulge_m * self.outline(name, rng) - self._depth_m(mask)
        rest = lost * total - (total - np.count_nonzero(kept))
        return kept & (score < highest_within(score, kept, rest, rng)) if rest > 0 else kept

    def _confused(self, mask: Mask, count: float, rng: np.random.Generator) -> Mask:
        """Return about `count` cells that look like another class: small objects as a whole, parts of large ones."""
        objects, looks = find_objects(mask), self.noise(GROUND_M, rng)
        # 2: how far objects differ in what they look like, in deviations of the noise within them
        own = np.concatenate((np.zeros(1), 2.0 * rng.standard_normal(len(objects.areas_cells))))
        is_small = objects.areas_cells * self.cell_m**2 < (GROUND_M / 2) ** 2
        share = count / max(1, int(np.count_nonzero(mask)))
        chosen = objects.mask_of(is_small & (rng.random(len(is_small)) < share))
        large = objects.mask_of(~is_small)
        looks = np.asarray(looks + own.astype(np.float32)[objects.labels], dtype=np.float32)
        return chosen | (large & (looks >= highest_within(looks, large, share * np.count_nonzero(large), rng)))

    def _small(self, mask: Mask, small_m2: float, most: float, limit: float, rng: np.random.Generator) -> Mask:
        """Return objects to miss: the smaller, the more likely, up to `most`; on average at most `limit` cells."""
        objects = find_objects(mask)
        areas = objects.areas_cells
        chance = np.asarray(most / (1 + (areas * self.cell_m**2 / small_m2) ** 1.5), dtype=np.float64)
        expected = float((chance * areas).sum())
        if expected > 0:
            chance = chance * min(1.0, limit / expected)
        return objects.mask_of(rng.random(len(areas)) < chance)

    def _depth_m(self, mask: Mask) -> Field:
        """Return how deep each cell of a mask lies inside, metres; outside the view it is taken to continue."""
        padded = np.pad(mask.view(np.uint8), 1, mode="edge")
        depth = cv2.distanceTransform(padded, cv2.DIST_L2, cv2.DIST_MASK_5)[1:-1, 1:-1]
        return np.asarray(np.minimum(depth, sum(mask.shape)) * self.cell_m, dtype=np.float32)

    def gain(self, name: str, mask: Mask, seen: Mask, factor: float, rng: np.random.Generator) -> None:
        """Add false alarms to the seen cells of a class, in place."""
        errors = self.errors.get(name)
        if errors is None:
            return
        free = ~(self.unknown[self.at[name]] | mask)
        budget = self._alarms(errors, int(np.count_nonzero(mask)), factor)
        if errors.of_ground is not None or errors.of_yards is not None:
            free &= self.ground
        if errors.alarms_on == "roads":
            free &= self.any_of(load_taxonomy().having("street"))
        if budget < 1 or not free.any():
            return
        before = np.count_nonzero(seen)
        if seen.any():
            score = errors.bulge_m * self.outline(name, rng) - self._depth_m(~seen)
            near = free & ~seen
            seen |= near & (score >= highest_within(score, near, errors.outline * budget, rng))
            if name not in load_taxonomy().lines:
                seen |= mask & _closed(seen)  # a bulge leaves no moat where the outline was
        left = budget - (np.count_nonzero(seen) - before)
        if left < 1:
            return
        if name == "building":
            self._add_blocks(seen, free, left, rng)
        elif name in load_taxonomy().lines and errors.alarms_on == "ground":
            self._add_bands(seen, free, left, errors.width_m, rng)
        else:
            patch, beyond = self.noise(PATCH_M, rng), free & ~seen
            seen |= beyond & (patch >= highest_within(patch, beyond, left, rng))

    def _alarms(self, errors: MeasuredErrors, count: int, factor: float) -> float:
        """Return the expected number of false cells of a class that has `count` true ones."""
        ground = int(np.count_nonzero(self.ground))
        if errors.of_ground is not None:
            return min(factor * errors.of_ground, _MOST_GROUND) * ground
        if errors.of_yards is not None:
            yards = int(np.count_nonzero(self.yards))
            return min(factor * errors.of_yards, _MOST_GROUND) * (yards + FAR_SHARE * (ground - yards))
        return factor * errors.recall / errors.precision * (1 - errors.precision) * count

    def _add_blocks(self, seen: Mask, free: Mask, budget: float, rng: np.random.Generator) -> None:
        """Add false buildings, of any direction and smaller than most houses."""
        median = ALARM_M2 / self.cell_m**2
        tries = int(_TRIES * budget / median) + 1
        areas = median * rng.lognormal(0.0, 0.7, size=tries)
        slim = rng.uniform(0.7, 1.0, size=tries)
        shapes = np.sqrt(areas)[:, None] * np.stack((slim, 1 / slim), axis=1)
        places, turns = self._places(free, tries, rng), rng.uniform(0, 180, size=tries)
        corners = [
            cv2.boxPoints((place, size, turn)).round().astype(np.int32)
            for place, size, turn in zip(places.tolist(), shapes.tolist(), turns.tolist(), strict=True)
        ]
        self._add(seen, free, budget, [(outline, 0) for outline in corners], rng)

    def _add_bands(self, seen: Mask, free: Mask, budget: float, width_m: float, rng: np.random.Generator) -> None:
        """Add false lines, straight or bent once: drives, yards, edges of fields."""
        mean = sum(BAND_M) / 2 * width_m / self.cell_m**2
        tries = int(_TRIES * budget / mean) + 1
        places, turns = self._places(free, tries, rng), rng.uniform(0, 2 * np.pi, size=tries)
        angles = np.stack((turns, turns + rng.normal(0, 0.6, size=tries)), axis=1)
        steps = np.stack((np.cos(angles), np.sin(angles)), axis=2)
        steps *= rng.uniform(*BAND_M, size=(tries, 1, 1)) / 2 / self.cell_m
        lines = np.concatenate((places[:, None], places[:, None] + np.cumsum(steps, axis=1)), axis=1).round()
        # OpenCV draws even thicknesses one cell wider.
        thickness = max(1, 2 * int(width_m / self.cell_m / 2 + 0.25))
        self._add(seen, free, budget, [(line, thickness) for line in lines.astype(np.int32)], rng)

    def silent(self, name: str, seen: Mask, shares: Silence, rng: np.random.Generator) -> Mask:
        """Return where a class is unknown: mostly along the outlines of what is seen, in waves."""
        mask, known = self.masks[self.at[name]], ~self.unknown[self.at[name]]
        depth = np.where(seen, self._depth_m(seen), self._depth_m(~seen))
        doubt = DOUBT * self.noise(OUTLINE_M, rng) - np.log(depth)
        silent: Mask = np.zeros_like(mask)
        for is_there, is_seen, share in (
            (mask, seen, shares.found),
            (mask, ~seen, shares.missed),
            (~mask, seen, shares.alarm),
            (~mask, ~seen, shares.absent),
        ):
            part = known & is_there & is_seen
            silent |= part & (doubt >= highest_within(doubt, part, share * np.count_nonzero(part), rng))
        return silent

    def _places(self, free: Mask, count: int, rng: np.random.Generator) -> NDArray[np.float64]:
        """Draw free cells (col, row), shape (count, 2), mostly of yards."""
        cells = np.flatnonzero(free & (self.yards | (rng.random(free.shape, dtype=np.float32) < FAR_SHARE)))
        cells = cells if len(cells) else np.arange(free.size)
        row, col = np.divmod(rng.choice(cells, size=count), free.shape[1])
        return np.column_stack((col, row)).astype(np.float64)

    @staticmethod
    def _add(
        seen: Mask, free: Mask, budget: float, shapes: list[tuple[NDArray[np.int32], int]], rng: np.random.Generator
    ) -> None:
        """Draw shapes onto free cells until the budget is spent, the last one by lot, so the mean is the budget."""
        # A shape is a polygon if its thickness is 0, else a line.
        for points, thickness in shapes:
            drawn = np.zeros(seen.shape, dtype=np.uint8)
            if thickness:
                cv2.polylines(drawn, [points], isClosed=False, color=1, thickness=thickness)
            else:
                cv2.fillPoly(drawn, [points], color=1)
            new = drawn.view(np.bool_) & free & ~seen
            count = np.count_nonzero(new)
            if count > budget and rng.random() * count > budget:
                return
            seen |= new
            budget -= count
            if budget <= 0:
                return


def _closed(mask: Mask) -> Mask:
    return np.asarray(cv2.morphologyEx(mask.view(np.uint8), cv2.MORPH_CLOSE, disc(_PINHOLE_CELLS))).view(np.bool_)


def _rounded(mask: Mask, sigma_cells: float) -> Mask:
    if sigma_cells < 0.3:  # a blur that moves no cell
        return mask.copy()
    blurred = cv2.GaussianBlur(mask.astype(np.float32), (0, 0), sigma_cells, borderType=cv2.BORDER_REPLICATE)
    return np.asarray(blurred > 0.5)  # the outline
