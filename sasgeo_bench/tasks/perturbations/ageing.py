# SPDX-License-Identifier: Apache-2.0
"""Synthetic ageing of the seen world: objects vanish, appear, or are redrawn slightly off.

For places without dated extracts, with rates measured elsewhere. A place is never aged by its own rates, since a method
may have been trained on them.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
import scipy
from numpy.typing import NDArray

from sasgeo_bench.core.errors import PerturbError
from sasgeo_bench.osm.taxonomy import load_taxonomy
from sasgeo_bench.regions.evidence import PRESENT, Evidence
from sasgeo_bench.tasks.perturbations.base import (
    Mask,
    NoisePool,
    Objects,
    check_ranges,
    dilated,
    find_objects,
    shifted,
    with_cells,
)
from sasgeo_bench.tasks.perturbations.streams import Streams

_TRIES: Final = 12  # to find a free place for a new object
_MOST_NEW: Final = 150  # of one class in one view
_GROUPS: Final = 4  # of redrawn objects, each with its own shift
_CLEARED: Final = dict.fromkeys(load_taxonomy().having("clears"), load_taxonomy().covering("land"))


@dataclass(frozen=True, slots=True, kw_only=True)
class Rates:
    """Yearly rates of one class, 1/year: of vanishing and appearing per present object, and of the ground.

    Ground is lost and gained where objects vanish and appear, and where they are redrawn beside their place, so its
    rates are higher. With None nothing is redrawn, and the number of new objects decides how much ground they gain.
    """

    vanish_per_year: float
    appear_per_year: float
    ground_lost_per_year: float | None = None
    ground_gained_per_year: float | None = None

    def __post_init__(self) -> None:
        ground = [
            name for name in ("ground_lost_per_year", "ground_gained_per_year") if getattr(self, name) is not None
        ]
        check_ranges(self, **dict.fromkeys(("vanish_per_year", "appear_per_year", *ground), (0, 5)))


def rates_by_hand() -> dict[str, Rates]:
    """Return the rates of the taxonomy by class, which were set by hand and come from no place."""
    items = ((item.name, item.persistence) for item in load_taxonomy().classes)
    return {
        name: Rates(vanish_per_year=item.vanish_per_year, appear_per_year=item.appear_per_year) for name, item in items
    }


_LARGEST_SHARE: Final = 0.1  # of the view, for an object to be copied


@dataclass(frozen=True, kw_only=True)
class Ageing:
    """Let years pass between the map and the view.

    `rates` are by class; a class without them does not age. The view is in `place`, the rates were measured in
    `measured_in`. Objects are redrawn with standard deviation `shift_m` in each direction.

    Raises
    ------
    PerturbError
        If the rates were measured in this place, or a value is out of range.

    Notes
    -----
    An object is a connected component; lines, which all connect, are cut into pieces of about 40 m. The sea (water that
    touches a coastline) stays. An object vanishes with probability 1 - exp(-vanish * years). Of the others so many are
    redrawn that 1 - exp(-ground_lost * years) of the ground is lost in the mean; where all of them would lose less, the
    shifts are doubled. New objects appear until exp(ground_gained * years) - 1 of the ground that stayed is gained;
    without a rate of ground their number is Poisson with mean (exp(appear * years) - 1) * objects. Each is a rotated
    copy of one of its class, placed nearby where no building, water, road or railway is. One without a free place after
    twelve tries is dropped, so dense places grow less, and areas that fill the view neither shift nor grow as they
    should. Ground cover below new objects is lost besides.
    """

    years: float
    rates: Mapping[str, Rates]
    place: str
    measured_in: tuple[str, ...] = ()
    shift_m: float = 2.0

    def __post_init__(self) -> None:
        check_ranges(self, years=(0, 200), shift_m=(0, 100))
        if self.place in self.measured_in:
            raise PerturbError(f"Ageing: the rates come from {self.place!r} itself, take those of other places")

    def __call__(self, evidence: Evidence, rng: np.random.Generator, /) -> Evidence:
        """Remove and shift objects of all classes first, then add new ones on free ground."""
        if self.years == 0:
            return evidence
        streams = Streams(rng)
        pool = NoisePool(evidence.shape, streams)
        layers = dict(zip(evidence.classes, evidence.cells == PRESENT, strict=True))
        sea = _sea(layers)
        if sea is not None:
            layers["water"] &= ~sea
        objects = {
            name: _objects_of(name, mask, pool, evidence.cell_size_m, streams.of(name))
            for name, mask in layers.items()
            if name in self.rates and mask.any()
        }
        before = dict(layers)
        for name, found in objects.items():
            layers[name] = self._older(name, layers[name], found, evidence.cell_size_m, streams.of(name))
        growth = {name: self._growth(name, found, before[name], layers[name]) for name, found in objects.items()}
        if sea is not None:
            layers["water"] |= sea
        for name, item in growth.items():
            self._appear(name, layers, item, evidence.cell_size_m, streams.of(name))
        return with_cells(evidence, np.stack(list(layers.values())).view(np.uint8))

    def _older(self, name: str, mask: Mask, found: Objects, cell_size_m: float, rng: np.random.Generator) -> Mask:
        """Return the class without the vanished objects, and with some of the others shifted."""
        rates, count = self.rates[name], len(found.areas_cells)
        gone = rng.random(count) < 1 - np.exp(-rates.vanish_per_year * self.years)
        lot, group = rng.random(count), rng.integers(0, _GROUPS, size=count)
        kept = mask & ~found.mask_of(gone)
        more = 0.0 if rates.ground_lost_per_year is None else rates.ground_lost_per_year - rates.vanish_per_year
        lose_cells = (1 - np.exp(-max(more, 0.0) * self.years)) * int(kept.sum())
        if lose_cells == 0:
            return kept
        groups = [found.mask_of(~gone & (group == index)) for index in range(_GROUPS)]
        shifts_m = rng.normal(0, self.shift_m, size=(_GROUPS, 2))
        shifts, lost_cells = _far_enough(groups, shifts_m / cell_size_m, lose_cells)
        anew = ~gone & (lot * lost_cells < lose_cells)
        after = kept & ~found.mask_of(anew)
        for index, (rows, cols) in enumerate(shifts):
            after |= _beside(found.mask_of(anew & (group == index)), rows, cols)
        return after

    def _growth(self, name: str, found: Objects, before: Mask, after: Mask) -> "_Growth":
        """Return how much ground new objects of a class are to gain: what redrawing has not gained already."""
        per_year = self.rates[name].ground_gained_per_year
        if per_year is None:
            return _Growth(objects=found)
        redrawn = int((after & ~before).sum())
        gain = float(np.expm1(per_year * self.years)) * int((after & before).sum())
        return _Growth(objects=found, cells=max(0.0, gain - redrawn), lost=before & ~after)

    def _appear(
        self, name: str, layers: dict[str, Mask], growth: "_Growth", cell_size_m: float, rng: np.random.Generator
    ) -> None:
        """Add new objects in place, and clear the ground cover below them."""
        found = growth.objects
        # 0.1: largest share of the view, for an object to be copied
        usable = np.flatnonzero(found.areas_cells <= _LARGEST_SHARE * found.labels.size)
        mean = np.expm1(self.rates[name].appear_per_year * self.years) * len(found.areas_cells)
        count = _MOST_NEW if growth.cells is not None else min(int(rng.poisson(mean)), _MOST_NEW)
        if not count or not len(usable):
            return
        boxes = scipy.ndimage.find_objects(found.labels)
        taken = _taken(name, layers)
        if growth.lost is not None:
            taken |= growth.lost
        left = np.inf if growth.cells is None else growth.cells
        for source in rng.choice(usable, size=count).tolist():
            box = boxes[source]
            footprint = _turned(found.labels[box] == source + 1, rng)
            window = _free_window(footprint, box, taken, cell_size_m, rng)
            if window is None:
                continue
            new = int((footprint & ~layers[name][window]).sum())
            if new > left and rng.random() * new >= left:  # the last by lot, so that the mean is what is to be gained
                return
            left -= new
            layers[name][window] |= footprint
            taken[window] |= footprint & (name not in load_taxonomy().lines)
            for below in _CLEARED.get(name, ()):
                if below in layers:
                    layers[below][window] &= ~footprint
            if left <= 0:
                return


@dataclass(frozen=True, slots=True, kw_only=True)
class _Growth:
    """Objects that new ones are copies of.

    `cells` is the ground to be gained, None where the number of objects decides; none of it is ground that was lost.
    """

    objects: Objects
    cells: float | None = None
    lost: Mask | None = None


def _far_enough(
    groups: Sequence[Mask], shifts_cells: NDArray[np.float64], lose_cells: float
) -> tuple[list[list[int]], int]:
    """Round shifts (groups, 2) to cells, doubled until they lose that much ground; return what they lose, too."""
    for doubling in range(6):  # up to 5 doublings of shifts that are too small to lose as much ground as is to be lost
        shifts: list[list[int]] = (shifts_cells * 2**doubling).round().astype(int).tolist()
        lost = sum(int((mask & ~_beside(mask, *shift)).sum()) for mask, shift in zip(groups, shifts, strict=True))
        if lost >= lose_cells:
            break
    return shifts, lost


def _beside(mask: Mask, rows: int, cols: int) -> Mask:
    """Move a mask by whole cells; what crosses the edge of the view goes on beyond it."""
    by = max(abs(rows), abs(cols))
    return shifted(np.pad(mask, by, mode="edge"), rows, cols, beyond=False)[
        by : by + mask.shape[0], by : by + mask.shape[1]
    ]


def _sea(layers: Mapping[str, Mask]) -> Mask | None:
    """Return water that touches a coastline and does not age; None without any."""
    water, coast = layers.get("water"), layers.get("coastline")
    if water is None or coast is None or not coast.any():
        return None
    bodies, count = scipy.ndimage.label(water)
    return np.isin(bodies, np.setdiff1d(np.unique(bodies[dilated(coast, 1.5)]), [0])) if count else None


_PIECE_M: Final = 40.0  # length of the pieces in which lines vanish, appear and are redrawn


def _objects_of(name: str, mask: Mask, pool: NoisePool, cell_size_m: float, rng: np.random.Generator) -> Objects:
    """Return the components of an area class, or the pieces of a line class between sign changes of smooth noise."""
    if name not in load_taxonomy().lines:
        return find_objects(mask)
    hills = pool.take(_PIECE_M / cell_size_m, rng) > 0
    high, low = find_objects(mask & hills), find_objects(mask & ~hills)
    labels = np.where(low.labels > 0, low.labels + len(high.areas_cells), high.labels)
    return Objects(
        labels=np.asarray(labels, dtype=np.int32), areas_cells=np.concatenate((high.areas_cells, low.areas_cells))
    )


def _taken(name: str, layers: Mapping[str, Mask]) -> Mask:
    """Return where no new object of a class may stand; a line may cross roads."""
    known = load_taxonomy()
    blockers = known.having("blocks_lines") if name in known.lines else (*known.having("blocks_areas"), name)
    taken = np.zeros(layers[name].shape, dtype=bool)
    for blocker in blockers:
        if blocker in layers:
            taken |= layers[blocker]
    return dilated(taken, 1.5)


def _turned(footprint: Mask, rng: np.random.Generator) -> Mask:
    quarters, mirrored = rng.integers(0, (4, 2)).tolist()
    return np.rot90(footprint[:, ::-1] if mirrored else footprint, quarters)


_NEAR_M: Final = 60.0  # largest distance of a new object from the one it copies


def _free_window(
    footprint: Mask, box: tuple[slice, ...], taken: Mask, cell_size_m: float, rng: np.random.Generator
) -> tuple[slice, slice] | None:
    """Return a window near a box in which the object overlaps nothing; None if none was found."""
    height, width = footprint.shape
    size = np.array(footprint.shape)
    middle = np.array([(part.start + part.stop) / 2 for part in box])
    away = size.max() + rng.uniform(0, _NEAR_M / cell_size_m, size=(_TRIES, 1))
    heading = rng.uniform(0, 2 * np.pi, size=_TRIES)
    corners = middle + away * np.column_stack((np.sin(heading), np.cos(heading))) - size / 2
    for row, col in corners.astype(int).tolist():
        window = (slice(row, row + height), slice(col, col + width))
        is_inside = row >= 0 and col >= 0 and row + height <= taken.shape[0] and col + width <= taken.shape[1]
        if is_inside and not (taken[window] & footprint).any():
            return window
    return None
