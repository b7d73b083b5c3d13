# SPDX-License-Identifier: Apache-2.0
"""A detector's errors: whole objects missed, ragged edges, gaps in roads, false patches, one class taken for another.

Errors lie together, as a network's do; no cell is flipped for itself. How many there are is set by class, as the F1
score the detector reaches.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from statistics import NormalDist
from typing import ClassVar, Final

import cv2
import numpy as np
from numpy.typing import NDArray

from sasgeo_bench.regions.evidence import PRESENT, UNKNOWN, Evidence
from sasgeo_bench.tasks.perturbations.base import check_ranges, with_cells
from sasgeo_bench.tasks.perturbations.detector import TOLERANCE_CELLS, ClassErrors, PerceptionSettings
from sasgeo_bench.tasks.perturbations.fields import (
    SIGMA,
    Field,
    NoisePool,
    dilated,
    eroded,
    highest_within,
    smooth_noise,
)
from sasgeo_bench.tasks.perturbations.objects import find_objects, pick_up_to, thin_classes

Mask = NDArray[np.bool_]

_MOST_ERROR: Final = 0.95
_SECOND_RING: Final = 0.8  # a cell two from the edge goes over where the noise is this much stronger than at the edge
_DROPPABLE: Final = 0.25  # an object that is more than this share of its class in view is frayed rather than dropped
_MOST_TAKEN: Final = 0.6  # of a class's false alarms: what other classes lose to it comes first, but not alone
_FLAWLESS: Final = ClassErrors(f1=1.0)
_STUB_SPENDS: Final = 0.85  # of the cells of a false line: the rest lies on what is there already or beyond the view


@dataclass(frozen=True, kw_only=True)
class Perception:
    """See a clean view with a detector's errors.

    Parameters
    ----------
    error_factor : float
        Multiplies 1 - F1 of every class: 0 is a perfect detector, 1 one in its own domain, 1.5 to 2 one that was taken
        to another place. At most 0.95 of a class goes wrong.
    settings : PerceptionSettings
        How it fails.

    Notes
    -----
    For an error of x = 1 - F1, a share x of the cells of a class is lost and as many are seen in the wrong place, so
    that precision and recall are both F1. Objects, edges and confusion spend this budget first, patches and false lines
    what is left. `detector.measured_f1` says what came out; the tests hold it to within 0.06 of the target, pooled over
    views of towns, for classes that cover a third of their `usual_share` or more. For one that is hardly there, what is
    seen anywhere makes it worse than that.

    Examples
    --------
    >>> from sasgeo_bench.tasks.perturbations.detector import measured_f1
    >>> house = np.zeros((1, 40, 40), dtype=np.uint8)
    >>> house[0, 10:30, 10:30] = 1
    >>> view = Evidence(classes=("building",), cells=house, cell_size_m=1.0)
    >>> seen = Perception(error_factor=1.0)(view, np.random.default_rng(1))
    >>> 0.5 < measured_f1(view, seen, "building") < 1
    True
    """

    NEUTRAL: ClassVar[Mapping[str, float]] = {"error_factor": 0.0}
    MOVES: ClassVar[bool] = False

    error_factor: float = 1.0
    settings: PerceptionSettings = field(default_factory=PerceptionSettings)

    def __post_init__(self) -> None:
        """Refuse a factor out of range."""
        check_ranges(self, error_factor=(0, 20))

    def __call__(self, evidence: Evidence, rng: np.random.Generator, /) -> Evidence:
        """Lose, then gain: a class gains first what another one lost to it."""
        if self.error_factor == 0:
            return evidence
        looks = self._looks(evidence, rng)
        taken_for: dict[str | None, list[Mask]] = {}
        seen = []
        for look in looks:
            loss = look.lose(rng)
            seen.append(loss.kept)
            if loss.taken is not None:
                taken_for.setdefault(look.errors.confused_with, []).append(loss.taken)
        for look, kept in zip(looks, seen, strict=True):
            look.gain(kept, taken_for.get(look.name, ()), rng)
        return with_cells(evidence, np.stack(seen).view(np.uint8))

    def _looks(self, evidence: Evidence, rng: np.random.Generator) -> list["_Look"]:
        """Each class, and the share of it that goes wrong; classes without settings are seen as they are."""
        settings, pool = self.settings, NoisePool(evidence.shape)
        errors = [settings.classes.get(name, _FLAWLESS) for name in evidence.classes]
        shares = self.error_factor * np.array([1 - item.f1 for item in errors])
        if settings.spread > 0:
            shares *= rng.gamma(settings.spread**-2, settings.spread**2, size=len(shares))
        present, unknown = evidence.cells == PRESENT, evidence.cells == UNKNOWN
        # Wider noise than that of the patches: most things are taken for something else as a whole or not at all.
        mixed_up = smooth_noise(evidence.shape, 3 * settings.patch_m / evidence.cell_size_m, rng)
        return [
            _Look(
                name=name,
                mask=present[index],
                unknown=unknown[index],
                errors=errors[index],
                settings=settings,
                share=min(float(shares[index]), _MOST_ERROR),
                cell_size_m=evidence.cell_size_m,
                pool=pool,
                mixed_up=mixed_up,
            )
            for index, name in enumerate(evidence.classes)
        ]


@dataclass(frozen=True, slots=True, kw_only=True)
class _Loss:
    """What is still seen of a class, and what is taken for another one."""

    kept: Mask
    taken: Mask | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class _Look:
    """One class in one view, before and on its way through the detector."""

    name: str
    mask: Mask
    unknown: Mask
    errors: ClassErrors
    settings: PerceptionSettings
    share: float
    cell_size_m: float
    pool: NoisePool
    mixed_up: Field

    def noise(self, width_m: float, rng: np.random.Generator) -> Field:
        """Smooth noise as large as the view."""
        return self.pool.take(width_m / self.cell_size_m, rng)

    @property
    def is_thin(self) -> bool:
        """Whether the class is a line."""
        return self.name in thin_classes()

    def lose(self, rng: np.random.Generator) -> _Loss:
        """Miss the share that goes wrong."""
        mask, budget_cells = self.mask, self.share * np.count_nonzero(self.mask)
        if budget_cells == 0:
            return _Loss(kept=mask.copy())
        kept, lost = (
            self._lose_line(mask, budget_cells, rng) if self.is_thin else self._lose_area(mask, budget_cells, rng)
        )
        if self.errors.confused == 0:
            return _Loss(kept=kept)
        limit = NormalDist(sigma=SIGMA).inv_cdf(min(self.errors.confused, 1 - 1e-9))
        return _Loss(kept=kept, taken=lost & (self.mixed_up < limit))

    def _lose_area(self, mask: Mask, budget_cells: float, rng: np.random.Generator) -> tuple[Mask, Mask]:
        """Whole objects, then the edge, then patches; what is left, and what went besides the edge."""
        kept = mask & ~_drop(mask, self.errors.dropped * budget_cells, rng)
        edge = _inner_edge(kept, self.noise(self.settings.edge_m, rng), self.errors.frayed * budget_cells, rng)
        kept &= ~edge
        rest = budget_cells - np.count_nonzero(mask) + np.count_nonzero(kept)
        if rest > 0:
            noise = self.noise(self.settings.patch_m, rng)
            kept &= noise < highest_within(noise, kept, rest, rng)
        return kept, mask & ~kept & ~edge

    def _lose_line(self, mask: Mask, budget_cells: float, rng: np.random.Generator) -> tuple[Mask, Mask]:
        """Gaps along the line, then the rest of it a cell to the side here and there."""
        noise = self.noise(self.settings.gap_m, rng)
        # A gap is missed only where no line is left within the tolerance, so its ends do not count: rank the weakest
        # noise around each cell instead of its own.
        around = cv2.erode(np.ascontiguousarray(noise), np.ones((3, 3), dtype=np.uint8))
        lost = mask & (noise >= highest_within(np.asarray(around, dtype=np.float32), mask, budget_cells, rng))
        return _nudged(mask & ~lost, self.noise(self.settings.patch_m, rng)), lost

    def gain(self, seen: Mask, taken: Sequence[Mask], rng: np.random.Generator) -> None:
        """Add false alarms to what is seen of the class, in place."""
        settings, was = self.settings, self.mask
        usual_cells = self.errors.usual_share * was.size
        expected = (1 - settings.seen_anywhere) * np.count_nonzero(was) + settings.seen_anywhere * usual_cells
        budget_cells = self.share * expected
        if budget_cells < 1:
            return
        free = ~(self.unknown | was)
        for lost in taken:
            new = lost & free & ~seen
            count = np.count_nonzero(new)
            if count > _MOST_TAKEN * budget_cells:
                whole = self.noise(settings.patch_m, rng)
                new &= whole >= highest_within(whole, new, _MOST_TAKEN * budget_cells, rng)
                count = np.count_nonzero(new)
            np.logical_or(seen, new, out=seen)
            budget_cells -= count
        if self.is_thin:
            self._add_stubs(seen, free, budget_cells, rng)
        else:
            self._add_patches(seen, free, budget_cells, rng)

    def _add_patches(self, seen: Mask, free: Mask, budget_cells: float, rng: np.random.Generator) -> None:
        """Ragged outer edges, then false patches away from them."""
        if seen.any():
            edge = _outer_edge(
                seen, free, self.noise(self.settings.edge_m, rng), self.errors.frayed * budget_cells, rng
            )
            np.logical_or(seen, edge, out=seen)
            budget_cells -= np.count_nonzero(edge)
        if budget_cells >= 1:
            noise = self.noise(self.settings.patch_m, rng)
            away = free & ~seen
            np.logical_or(seen, away & (noise >= highest_within(noise, away, budget_cells, rng)), out=seen)

    def _add_stubs(self, seen: Mask, free: Mask, budget_cells: float, rng: np.random.Generator) -> None:
        """Short false lines, every other one a branch of what is seen."""
        # OpenCV draws thickness 1 one cell wide and the even ones one cell wider than they say, diagonals included.
        thickness = max(1, 2 * int(self.errors.width_m / self.cell_size_m / 2 + 0.25))
        width_cells = thickness + (thickness > 1)
        length_cells = self.settings.stub_m / self.cell_size_m
        per_stub = _STUB_SPENDS * (length_cells + width_cells / 2) * width_cells
        count = int(budget_cells / per_stub + rng.random())  # by lot, so that the mean is the budget
        if count > 0:
            stubs = np.zeros(seen.shape, dtype=np.uint8)
            lines = _bent_lines(_begins(seen, count, rng), length_cells, rng)
            cv2.polylines(stubs, list(lines), isClosed=False, color=1, thickness=thickness)
            np.logical_or(seen, stubs.view(np.bool_) & free, out=seen)


def _drop(mask: Mask, budget_cells: float, rng: np.random.Generator) -> Mask:
    """Whole objects to miss; large ones are never missed as a whole."""
    objects = find_objects(mask)
    small = objects.areas_cells <= _DROPPABLE * np.count_nonzero(mask)
    chosen = np.zeros(len(small), dtype=bool)
    chosen[small] = pick_up_to(objects.areas_cells[small], budget_cells, rng)
    return objects.mask_of(chosen)


def _inner_edge(mask: Mask, noise: Field, budget_cells: float, rng: np.random.Generator) -> Mask:
    """Cells one or two from the edge where the noise is strong."""
    first = eroded(mask, TOLERANCE_CELLS)
    second = eroded(first, TOLERANCE_CELLS)
    ring = mask & ~first
    limit = highest_within(noise, ring, 0.8 * budget_cells, rng)
    return (ring & (noise >= limit)) | (first & ~second & (noise >= limit + _SECOND_RING))


def _outer_edge(mask: Mask, free: Mask, noise: Field, budget_cells: float, rng: np.random.Generator) -> Mask:
    """Free cells one or two beyond the edge where the noise is strong."""
    first = dilated(mask, TOLERANCE_CELLS)
    ring = first & free & ~mask
    limit = highest_within(noise, ring, 0.8 * budget_cells, rng)
    second = dilated(first, TOLERANCE_CELLS) & ~first & free
    return (ring & (noise >= limit)) | (second & (noise >= limit + _SECOND_RING))


def _nudged(mask: Mask, noise: Field) -> Mask:
    """The line, a cell to the side where the noise is strong: right or left by its sign, or down or up further on."""
    strong = 0.5
    moved = mask & (np.abs(noise) < strong)
    right, left = mask & (noise >= strong), mask & (noise <= -strong)
    moved[:, 1:] |= right[:, :-1]
    moved[1:, :] |= left[:-1, :]
    return moved


def _begins(seen: Mask, count: int, rng: np.random.Generator) -> NDArray[np.float64]:
    """(col, row) where false lines begin: anywhere, and every other one on the class itself."""
    rows, cols = seen.shape
    begins = rng.uniform((0, 0), (cols, rows), size=(count, 2))
    on_line = np.flatnonzero(seen) if count > 1 else ()
    if len(on_line):
        row, col = np.divmod(rng.choice(on_line, size=count // 2), cols)
        begins[1::2] = np.column_stack((col, row))
    return begins


def _bent_lines(begins: NDArray[np.float64], length_cells: float, rng: np.random.Generator) -> NDArray[np.int32]:
    """Three corners (col, row) each, shape (N, 3, 2), of lines in any direction with a slight bend."""
    count = len(begins)
    first = rng.uniform(0, 2 * np.pi, size=count)
    angles = np.column_stack((first, first + rng.normal(0, 0.4, size=count)))
    half = length_cells / 2 * rng.uniform(0.4, 1.6, size=(count, 1, 1))
    steps = np.stack((np.cos(angles), np.sin(angles)), axis=2) * half
    corners = np.concatenate((begins[:, None], begins[:, None] + np.cumsum(steps, axis=1)), axis=1)
    return np.asarray(corners.round(), dtype=np.int32)
