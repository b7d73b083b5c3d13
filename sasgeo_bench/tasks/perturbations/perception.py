# SPDX-License-Identifier: Apache-2.0
"""A detector's errors: whole objects missed, ragged edges, gaps in roads, false patches, classes confused.

Errors are correlated in space, as a network's are; no cell is flipped independently. Their number follows from the F1
score that the detector reaches on each class.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from importlib import resources
from statistics import NormalDist
from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

from sasgeo_bench.core.errors import ConfigError
from sasgeo_bench.osm.taxonomy import ClassErrors, load_taxonomy
from sasgeo_bench.regions.evidence import PRESENT, UNKNOWN, Evidence
from sasgeo_bench.tasks.perturbations.base import (
    SIGMA,
    Field,
    Mask,
    NoisePool,
    Perturbation,
    check_ranges,
    dilated,
    eroded,
    find_objects,
    highest_within,
    pick_up_to,
    smooth_noise,
    with_cells,
)
from sasgeo_bench.tasks.perturbations.measured import MeasuredPerception
from sasgeo_bench.tasks.perturbations.perception_profile import PerceptionProfile, read_profile
from sasgeo_bench.tasks.perturbations.streams import Streams
from sasgeo_bench.tasks.query import PROFILE, SILENT, Detector

TOLERANCE_CELLS: Final = 1.5  # the eight neighbours
EDGE_M: Final = 4.0  # width of ragged edges
PATCH_M: Final = 12.0  # width of patches
SPREAD: Final = 0.3  # coefficient of variation of the error over views and classes
SEEN_ANYWHERE: Final = 0.2  # fraction of the false alarms that occur whether or not the class is in view


ERRORS: Final[Mapping[str, ClassErrors]] = {item.name: item.published for item in load_taxonomy().classes}

_MOST_ERROR: Final = 0.95
_SECOND_RING: Final = 0.8  # the noise must be stronger by this for a cell two from the edge than for one at the edge
_MOST_TAKEN: Final = 0.6  # most of a class's false alarms that come from what other classes lose to it
_FLAWLESS: Final = ClassErrors(recall=1.0, precision=1.0)


@dataclass(frozen=True, kw_only=True)
class Perception:
    """See a clean view with a detector's errors.

    The detector "published". `error_factor` multiplies the errors of every class: 0 is a perfect detector, 1 one in its
    own domain, 1.5 to 2 one in another domain. At most 0.95 of a class goes wrong. Each class has a stream of its own:
    a class more or less changes no other one, but what it is taken for.

    Notes
    -----
    Of the cells of a class, a fraction 1 - recall is lost, and recall / precision - recall as many are seen in the
    wrong place. Only the F1 scores are published, so recall and precision are both taken to be F1. Objects, edges and
    confusion use this budget first, patches and false lines the rest. The tests hold the measured F1 to within 0.06 of
    the target, pooled over views of towns, for classes that cover a third of their `usual_share` or more. For rarer
    ones, `SEEN_ANYWHERE` makes it lower.
    """

    error_factor: float = 1.0

    def __post_init__(self) -> None:
        check_ranges(self, error_factor=(0, 20))

    def __call__(self, evidence: Evidence, rng: np.random.Generator, /) -> Evidence:
        """Lose cells, then gain: a class first gains what another one lost to it."""
        if self.error_factor == 0:
            return evidence
        streams = Streams(rng)
        looks = self._looks(evidence, streams)
        lost_to: dict[str | None, list[Mask]] = {}
        seen = []
        for look in looks:
            kept, taken = look.lose(streams.of(look.name))
            seen.append(kept)
            if taken is not None:
                lost_to.setdefault(look.errors.confused_with, []).append(taken)
        for look, kept in zip(looks, seen, strict=True):
            look.gain(kept, lost_to.get(look.name, ()), streams.of(look.name))
        return with_cells(evidence, np.stack(seen).view(np.uint8))

    def _looks(self, evidence: Evidence, streams: Streams) -> list["_Look"]:
        """Return each class with the fraction of it that goes wrong."""
        pool = NoisePool(evidence.shape, streams)
        errors = [ERRORS.get(name, _FLAWLESS) for name in evidence.classes]
        shares = self.error_factor * np.array([(item.lost, item.gained) for item in errors])
        if SPREAD > 0:
            shares *= [[streams.of(name).gamma(SPREAD**-2, SPREAD**2)] for name in evidence.classes]
        lost, gained = np.minimum(shares, _MOST_ERROR).T
        present, unknown = evidence.cells == PRESENT, evidence.cells == UNKNOWN
        # Noise wider than the patches: most objects are confused as a whole or not at all.
        mixed_up = smooth_noise(evidence.shape, 3 * PATCH_M / evidence.cell_size_m, streams.view)
        return [
            _Look(
                name=name,
                mask=present[index],
                unknown=unknown[index],
                errors=errors[index],
                lost=float(lost[index]),
                gained=float(gained[index]),
                cell_size_m=evidence.cell_size_m,
                pool=pool,
                mixed_up=mixed_up,
            )
            for index, name in enumerate(evidence.classes)
        ]


GAP_M: Final = 12.0  # width of gaps along lines


STUB_M: Final = 25.0  # mean length of a false line


@dataclass(frozen=True, slots=True, kw_only=True)
class _Look:
    """One class in one view, and the errors that the detector makes on it."""

    name: str
    mask: Mask
    unknown: Mask
    errors: ClassErrors
    lost: float
    gained: float
    cell_size_m: float
    pool: NoisePool
    mixed_up: Field

    def noise(self, width_m: float, rng: np.random.Generator) -> Field:
        return self.pool.take(width_m / self.cell_size_m, rng)

    @property
    def is_thin(self) -> bool:
        return self.name in load_taxonomy().lines

    def lose(self, rng: np.random.Generator) -> tuple[Mask, Mask | None]:
        """Miss the fraction that goes wrong; return what is still seen, and what is taken for another class."""
        mask, budget_cells = self.mask, self.lost * np.count_nonzero(self.mask)
        if budget_cells == 0:
            return mask.copy(), None
        lose = self._lose_line if self.is_thin else self._lose_area
        kept, lost = lose(mask, budget_cells, rng)
        if self.errors.confused == 0:
            return kept, None
        limit = NormalDist(sigma=SIGMA).inv_cdf(min(self.errors.confused, 1 - 1e-9))
        return kept, lost & (self.mixed_up < limit)

    def _lose_area(self, mask: Mask, budget_cells: float, rng: np.random.Generator) -> tuple[Mask, Mask]:
        """Lose whole objects, then edges, then patches; return what is left, and what went elsewhere than at edges."""
        kept = mask & ~_drop(mask, self.errors.dropped * budget_cells, rng)
        edge = _inner_edge(kept, self.noise(EDGE_M, rng), self.errors.frayed * budget_cells, rng)
        kept &= ~edge
        rest = budget_cells - np.count_nonzero(mask) + np.count_nonzero(kept)
        if rest > 0:
            noise = self.noise(PATCH_M, rng)
            kept &= noise < highest_within(noise, kept, rest, rng)
        return kept, mask & ~kept & ~edge

    def _lose_line(self, mask: Mask, budget_cells: float, rng: np.random.Generator) -> tuple[Mask, Mask]:
        """Cut gaps, then move the rest by a cell here and there; return what is left and the gaps."""
        noise = self.noise(GAP_M, rng)
        # A gap counts only where no line is left within the tolerance, so its ends do not: rank the weakest noise
        # around each cell instead of its own.
        around = cv2.erode(np.ascontiguousarray(noise), np.ones((3, 3), dtype=np.uint8))
        lost = mask & (noise >= highest_within(np.asarray(around, dtype=np.float32), mask, budget_cells, rng))
        return _nudged(mask & ~lost, self.noise(PATCH_M, rng)), lost

    def gain(self, seen: Mask, taken: Sequence[Mask], rng: np.random.Generator) -> None:
        """Add false alarms to the seen cells of the class, in place."""
        was = self.mask
        usual_cells = self.errors.usual_share * was.size
        expected = (1 - SEEN_ANYWHERE) * np.count_nonzero(was) + SEEN_ANYWHERE * usual_cells
        budget_cells = self.gained * expected
        if budget_cells < 1:
            return
        free = ~(self.unknown | was)
        for lost in taken:
            new = lost & free & ~seen
            count = np.count_nonzero(new)
            if count > _MOST_TAKEN * budget_cells:
                whole = self.noise(PATCH_M, rng)
                new &= whole >= highest_within(whole, new, _MOST_TAKEN * budget_cells, rng)
                count = np.count_nonzero(new)
            np.logical_or(seen, new, out=seen)
            budget_cells -= count
        if self.is_thin:
            self._add_stubs(seen, free, budget_cells, rng)
        else:
            self._add_patches(seen, free, budget_cells, rng)

    def _add_patches(self, seen: Mask, free: Mask, budget_cells: float, rng: np.random.Generator) -> None:
        """Add ragged outer edges, then false patches away from them."""
        if seen.any():
            edge = _outer_edge(seen, free, self.noise(EDGE_M, rng), self.errors.frayed * budget_cells, rng)
            np.logical_or(seen, edge, out=seen)
            budget_cells -= np.count_nonzero(edge)
        if budget_cells >= 1:
            noise = self.noise(PATCH_M, rng)
            away = free & ~seen
            np.logical_or(seen, away & (noise >= highest_within(noise, away, budget_cells, rng)), out=seen)

    def _add_stubs(self, seen: Mask, free: Mask, budget_cells: float, rng: np.random.Generator) -> None:
        """Add short false lines; every second one branches off a seen line."""
        # OpenCV draws thickness 1 one cell wide and even thicknesses one cell wider, diagonals included.
        thickness = max(1, 2 * int(self.errors.width_m / self.cell_size_m / 2 + 0.25))
        width_cells = thickness + (thickness > 1)
        length_cells = STUB_M / self.cell_size_m
        # 0.85 of the cells of a false line; the others are present already or outside the view
        per_stub = 0.85 * (length_cells + width_cells / 2) * width_cells
        count = int(budget_cells / per_stub + rng.random())  # random rounding, so that the mean is the budget
        if count > 0:
            stubs = np.zeros(seen.shape, dtype=np.uint8)
            lines = _bent_lines(_begins(seen, count, rng), length_cells, rng)
            cv2.polylines(stubs, list(lines), isClosed=False, color=1, thickness=thickness)
            np.logical_or(seen, stubs.view(np.bool_) & free, out=seen)


def _drop(mask: Mask, budget_cells: float, rng: np.random.Generator) -> Mask:
    """Return whole objects to miss; never a large one."""
    objects = find_objects(mask)
    # 0.25: an object larger than this fraction of its class in view is frayed rather than dropped
    small = objects.areas_cells <= 0.25 * np.count_nonzero(mask)
    chosen = np.zeros(len(small), dtype=bool)
    chosen[small] = pick_up_to(objects.areas_cells[small], budget_cells, rng)
    return objects.mask_of(chosen)


def _inner_edge(mask: Mask, noise: Field, budget_cells: float, rng: np.random.Generator) -> Mask:
    first = eroded(mask, TOLERANCE_CELLS)
    second = eroded(first, TOLERANCE_CELLS)
    ring = mask & ~first
    limit = highest_within(noise, ring, 0.8 * budget_cells, rng)
    return (ring & (noise >= limit)) | (first & ~second & (noise >= limit + _SECOND_RING))


def _outer_edge(mask: Mask, free: Mask, noise: Field, budget_cells: float, rng: np.random.Generator) -> Mask:
    first = dilated(mask, TOLERANCE_CELLS)
    ring = first & free & ~mask
    limit = highest_within(noise, ring, 0.8 * budget_cells, rng)
    second = dilated(first, TOLERANCE_CELLS) & ~first & free
    return (ring & (noise >= limit)) | (second & (noise >= limit + _SECOND_RING))


def _nudged(mask: Mask, noise: Field) -> Mask:
    """Move the line by a cell where the noise is strong: right or down, by the sign of the noise."""
    strong = 0.5
    moved = mask & (np.abs(noise) < strong)
    right, left = mask & (noise >= strong), mask & (noise <= -strong)
    moved[:, 1:] |= right[:, :-1]
    moved[1:, :] |= left[:-1, :]
    return moved


def _begins(seen: Mask, count: int, rng: np.random.Generator) -> NDArray[np.float64]:
    """Return (col, row) of the starts of false lines: anywhere, and every second one on the class itself."""
    rows, cols = seen.shape
    begins = rng.uniform((0, 0), (cols, rows), size=(count, 2))
    on_line = np.flatnonzero(seen) if count > 1 else ()
    if len(on_line):
        row, col = np.divmod(rng.choice(on_line, size=count // 2), cols)
        begins[1::2] = np.column_stack((col, row))
    return begins


def _bent_lines(begins: NDArray[np.float64], length_cells: float, rng: np.random.Generator) -> NDArray[np.int32]:
    """Return the three corners (col, row) of each line, shape (N, 3, 2): any direction, slightly bent."""
    count = len(begins)
    first = rng.uniform(0, 2 * np.pi, size=count)
    angles = np.column_stack((first, first + rng.normal(0, 0.4, size=count)))
    half = length_cells / 2 * rng.uniform(0.4, 1.6, size=(count, 1, 1))
    steps = np.stack((np.cos(angles), np.sin(angles)), axis=2) * half
    corners = np.concatenate((begins[:, None], begins[:, None] + np.cumsum(steps, axis=1)), axis=1)
    return np.asarray(corners.round(), dtype=np.int32)


NO_PROFILE: Final = "detector 'profile' needs a perception profile: name its file with make-queries --profile FILE"


def _published(error_factor: float) -> Perturbation:
    return Perception(error_factor=error_factor)


def _measured(error_factor: float) -> Perturbation:
    return MeasuredPerception(error_factor=error_factor)


@cache
def silent_profile() -> PerceptionProfile:
    """Return the profile of the detector "silent", which ships.

    >>> silent_profile().segmenter, silent_profile().silence
    ('osm_unet_held_out', 0.05)
    """
    with resources.as_file(resources.files(__package__) / "silent.toml") as path:
        return read_profile(path)


DETECTORS: Final[Mapping[Detector, Callable[[float], Perturbation]]] = {
    "published": _published,
    "measured": _measured,
    SILENT: lambda error_factor: silent_profile().perception(error_factor),
}


def perception_of(
    detector: Detector, *, error_factor: float = 1.0, profile: PerceptionProfile | None = None
) -> Perturbation:
    """Return the errors of a detector, or of a segmenter's profile for the detector "profile".

    Raise `ConfigError` if that detector has no profile.

    >>> perception_of("measured", error_factor=2.0)
    MeasuredPerception(error_factor=2.0)
    """
    if detector != PROFILE:
        return DETECTORS[detector](error_factor)
    if profile is None:
        raise ConfigError(NO_PROFILE)
    return profile.perception(error_factor)
