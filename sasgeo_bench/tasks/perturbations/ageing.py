# SPDX-License-Identifier: Apache-2.0
"""Synthetic ageing of the seen world: objects vanish and appear.

For places without dated extracts, with rates measured elsewhere. A place is never aged by its own rates, since a method
may have been trained on them.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final

import numpy as np
import scipy

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
    with_cells,
)
from sasgeo_bench.tasks.perturbations.streams import Streams

_TRIES: Final = 12  # to find a free place for a new object
_MOST_NEW: Final = 150  # of one class in one view
_CLEARED: Final = dict.fromkeys(load_taxonomy().having("clears"), load_taxonomy().covering("land"))


@dataclass(frozen=True, slots=True, kw_only=True)
class Rates:
    """Yearly rates of one class, 1/year: of vanishing and appearing per present object."""

    vanish_per_year: float
    appear_per_year: float

    def __post_init__(self) -> None:
        check_ranges(self, vanish_per_year=(0, 5), appear_per_year=(0, 5))


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

    `rates` are by class; a class without them does not age. The view is in `place` (a place or its country), the rates
    were measured in `measured_in`.

    Raises
    ------
    PerturbError
        If the rates were measured in this place, or a value is out of range.

    Notes
    -----
    An object is a connected component; lines, which all connect, are cut into pieces of about 40 m. The sea (water that
    touches a coastline) stays. An object vanishes with probability 1 - exp(-vanish * years). The number of new ones is
    Poisson with mean (exp(appear * years) - 1) * objects. Each is a rotated copy of one of its class, placed nearby
    where no building, water, road or railway is. One without a free place after twelve tries is dropped, so dense
    places grow less, and areas that fill the view do not grow as they should. Ground cover below new objects is lost
    besides.
    """

    years: float
    rates: Mapping[str, Rates]
    place: str
    measured_in: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        check_ranges(self, years=(0, 200))
        if self.place in self.measured_in:
            raise PerturbError(f"Ageing: the rates come from {self.place!r} itself, take those of other places")

    def __call__(self, evidence: Evidence, rng: np.random.Generator, /) -> Evidence:
        """Remove objects of all classes first, then add new ones on free ground."""
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
        for name, found in objects.items():
            layers[name] = self._older(name, layers[name], found, streams.of(name))
        if sea is not None:
            layers["water"] |= sea
        for name, found in objects.items():
            self._appear(name, layers, found, evidence.cell_size_m, streams.of(name))
        return with_cells(evidence, np.stack(list(layers.values())).view(np.uint8))

    def _older(self, name: str, mask: Mask, found: Objects, rng: np.random.Generator) -> Mask:
        """Return the class without the vanished objects."""
        count = len(found.areas_cells)
        gone = rng.random(count) < 1 - np.exp(-self.rates[name].vanish_per_year * self.years)
        # Drawn for nothing since objects are not redrawn any more: so the queries of other suites stay as they are.
        rng.random(count), rng.integers(0, 4, size=count)
        return mask & ~found.mask_of(gone)

    def _appear(
        self, name: str, layers: dict[str, Mask], found: Objects, cell_size_m: float, rng: np.random.Generator
    ) -> None:
        """Add new objects in place, and clear the ground cover below them."""
        # 0.1: largest share of the view, for an object to be copied
        usable = np.flatnonzero(found.areas_cells <= _LARGEST_SHARE * found.labels.size)
        mean = np.expm1(self.rates[name].appear_per_year * self.years) * len(found.areas_cells)
        count = min(int(rng.poisson(mean)), _MOST_NEW)
        if not count or not len(usable):
            return
        boxes = scipy.ndimage.find_objects(found.labels)
        taken = _taken(name, layers)
        for source in rng.choice(usable, size=count).tolist():
            box = boxes[source]
            footprint = _turned(found.labels[box] == source + 1, rng)
            window = _free_window(footprint, box, taken, cell_size_m, rng)
            if window is None:
                continue
            layers[name][window] |= footprint
            taken[window] |= footprint & (name not in load_taxonomy().lines)
            for below in _CLEARED.get(name, ()):
                if below in layers:
                    layers[below][window] &= ~footprint


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
