# SPDX-License-Identifier: Apache-2.0
"""Synthetic ageing of the world that is seen: things vanish, others appear, some are drawn anew a little off.

For places without dated extracts, and with rates measured elsewhere: a place must never be aged by rates of its own,
or the test would ask for the numbers the training was given.
"""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any, ClassVar, Final, Self

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from sasgeo_bench.errors import PerturbError
from sasgeo_bench.osm.taxonomy import load_taxonomy
from sasgeo_bench.regions.evidence import PRESENT, Evidence
from sasgeo_bench.tasks.perturbations.base import check_ranges, with_cells
from sasgeo_bench.tasks.perturbations.fields import NoisePool, dilated
from sasgeo_bench.tasks.perturbations.objects import Objects, find_objects, thin_classes
from sasgeo_bench.tasks.perturbations.resample import shifted

Mask = NDArray[np.bool_]

_BLOCKED_BY: Final = ("building", "water", "railway", "road_major", "road_minor")
_TRIES: Final = 12  # to find a free place for a new thing
_PIECE_M: Final = 40.0  # a line vanishes, appears and is redrawn in pieces about this long
_NEAR_M: Final = 60.0  # a new thing stands within this distance of the one it is like
_MOST_NEW: Final = 150  # of one class in one view
_LARGEST_SHARE: Final = 0.1  # of the view, for a thing to appear a second time
_GROUPS: Final = 4  # of things drawn anew, each with a shift of its own
_CLEARED: Final = {"building": ("green", "farmland"), "parking": ("green", "farmland"), "water": ("green", "farmland")}


@dataclass(frozen=True, slots=True, kw_only=True)
class Rates:
    """Yearly rates of one class: of vanishing per thing there is, of appearing per thing there is by then; 1/year."""

    vanish_per_year: float
    appear_per_year: float

    def __post_init__(self) -> None:
        """Refuse what is no rate."""
        check_ranges(self, vanish_per_year=(0, 5), appear_per_year=(0, 5))


@dataclass(frozen=True, slots=True, kw_only=True)
class AgeingRates:
    """Rates by class, and the places they were measured in.

    Examples
    --------
    >>> rows = [{"class": "building", "vanish_per_year": 0.005, "appear_per_year": 0.02}]
    >>> AgeingRates.from_rows(rows, places=["vaduz"]).classes["building"].appear_per_year
    0.02
    """

    classes: Mapping[str, Rates]
    places: tuple[str, ...]

    @classmethod
    def from_rows(cls, rows: Iterable[Mapping[str, Any]], *, places: Iterable[str]) -> Self:
        """Take a table with the columns class, vanish_per_year and appear_per_year.

        Raises
        ------
        PerturbError
            If a row lacks a column, holds no rate, or a class comes twice.
        """
        classes: dict[str, Rates] = {}
        for row in rows:
            missing = sorted({"class", "vanish_per_year", "appear_per_year"} - set(row))
            if missing or row["class"] in classes:
                fault = f"lacks {missing[0]}" if missing else "names its class a second time"
                message = f"a row of the ageing rates {fault}: {dict(row)!r}"
                raise PerturbError(message)
            classes[row["class"]] = Rates(
                vanish_per_year=row["vanish_per_year"], appear_per_year=row["appear_per_year"]
            )
        return cls(classes=classes, places=tuple(places))

    @classmethod
    def set_by_hand(cls) -> Self:
        """Those of the taxonomy, which were set by hand and so come from no place.

        Examples
        --------
        >>> AgeingRates.set_by_hand().places
        ()
        """
        classes = {
            item.name: Rates(
                vanish_per_year=item.persistence.vanish_per_year, appear_per_year=item.persistence.appear_per_year
            )
            for item in load_taxonomy().classes
        }
        return cls(classes=classes, places=())


@dataclass(frozen=True, kw_only=True)
class Ageing:
    """Let years pass between the map and the view.

    Parameters
    ----------
    years : float
        How much newer the world is than the map.
    rates : AgeingRates
        By class; one that has none does not age.
    place : str
        Where the view is.
    redrawn : float
        Share of what stays that is seen a little off, because it was drawn anew; only where years pass.
    shift_m : float
        Standard deviation of that shift in each direction, metres.

    Raises
    ------
    PerturbError
        If the rates were measured in this place, or a value is out of range.

    Notes
    -----
    A thing is a connected component; lines, which all connect, go and come in pieces of about 40 m. The sea, which is
    water that reaches a coastline, stays as it is. A thing vanishes
    with probability 1 - exp(-vanish * years). As many appear as a Poisson draw of mean
    (exp(appear * years) - 1) * things says, which is what measured rates of appearing mean, each a turned copy of one
    of its class, set down nearby where no building, water, road or railway is. One that finds no free place in twelve
    tries is left out, so dense places grow less than asked.

    Examples
    --------
    >>> view = Evidence(classes=("building",), cells=np.eye(64, dtype=np.uint8)[None], cell_size_m=1.0)
    >>> Ageing(years=5.0, rates=AgeingRates.from_rows([], places=["vaduz"]), place="vaduz")
    Traceback (most recent call last):
    sasgeo_bench.errors.PerturbError: Ageing: the rates come from 'vaduz' itself, take those of other places
    """

    NEUTRAL: ClassVar[Mapping[str, float]] = {"years": 0.0}
    MOVES: ClassVar[bool] = False

    years: float
    rates: AgeingRates
    place: str
    redrawn: float = 0.0
    shift_m: float = 2.0

    def __post_init__(self) -> None:
        """Refuse values out of range, and a place's own rates."""
        check_ranges(self, years=(0, 200), redrawn=(0, 1), shift_m=(0, 100))
        if self.place in self.rates.places:
            message = f"Ageing: the rates come from {self.place!r} itself, take those of other places"
            raise PerturbError(message)

    def __call__(self, evidence: Evidence, rng: np.random.Generator, /) -> Evidence:
        """Let things vanish and move in all classes first, then let new ones appear on what is free by then."""
        if self.years == 0:
            return evidence
        pool = NoisePool(evidence.shape)
        layers = dict(zip(evidence.classes, evidence.cells == PRESENT, strict=True))
        sea = _sea(layers)
        if sea is not None:
            layers["water"] &= ~sea
        things = {
            name: _things(name, mask, pool, evidence.cell_size_m, rng)
            for name, mask in layers.items()
            if name in self.rates.classes and mask.any()
        }
        for name, found in things.items():
            layers[name] = self._older(name, layers[name], found, evidence.cell_size_m, rng)
        if sea is not None:
            layers["water"] |= sea
        for name, found in things.items():
            self._appear(name, layers, found, evidence.cell_size_m, rng)
        return with_cells(evidence, np.stack(list(layers.values())).view(np.uint8))

    def _older(self, name: str, mask: Mask, found: Objects, cell_size_m: float, rng: np.random.Generator) -> Mask:
        """The class without what vanished, and with some of the rest a little off."""
        count = len(found.areas_cells)
        gone = rng.random(count) < 1 - np.exp(-self.rates.classes[name].vanish_per_year * self.years)
        anew = ~gone & (rng.random(count) < self.redrawn)
        kept = mask & ~found.mask_of(gone | anew)
        group = rng.integers(0, _GROUPS, size=count)
        for index in range(_GROUPS if anew.any() else 0):
            rows, cols = (rng.normal(0, self.shift_m, size=2) / cell_size_m).round().astype(int).tolist()
            kept |= shifted(found.mask_of(anew & (group == index)), rows, cols, beyond=False)
        return kept

    def _appear(
        self, name: str, layers: dict[str, Mask], found: Objects, cell_size_m: float, rng: np.random.Generator
    ) -> None:
        """Set new things down in place, and clear what grew there."""
        usable = np.flatnonzero(found.areas_cells <= _LARGEST_SHARE * found.labels.size)
        mean = np.expm1(self.rates.classes[name].appear_per_year * self.years) * len(found.areas_cells)
        count = min(int(rng.poisson(mean)), _MOST_NEW)
        if not count or not len(usable):
            return
        boxes = ndimage.find_objects(found.labels)
        taken = _taken(name, layers)
        for source in rng.choice(usable, size=count).tolist():
            box = boxes[source]
            stamp = _turned(found.labels[box] == source + 1, rng)
            window = _free_window(stamp, box, taken, cell_size_m, rng)
            if window is None:
                continue
            layers[name][window] |= stamp
            taken[window] |= stamp & (name not in thin_classes())
            for below in _CLEARED.get(name, ()):
                if below in layers:
                    layers[below][window] &= ~stamp


def _sea(layers: Mapping[str, Mask]) -> Mask | None:
    """Water that reaches a coastline, which does not age as ponds do; None without one."""
    water, coast = layers.get("water"), layers.get("coastline")
    if water is None or coast is None or not coast.any():
        return None
    bodies, count = ndimage.label(water)
    return np.isin(bodies, np.setdiff1d(np.unique(bodies[dilated(coast, 1.5)]), [0])) if count else None


def _things(name: str, mask: Mask, pool: NoisePool, cell_size_m: float, rng: np.random.Generator) -> Objects:
    """Components of an area class; of a line, the pieces between the changes of sign of smooth noise."""
    if name not in thin_classes():
        return find_objects(mask)
    hills = pool.take(_PIECE_M / cell_size_m, rng) > 0
    high, low = find_objects(mask & hills), find_objects(mask & ~hills)
    labels = np.where(low.labels > 0, low.labels + len(high.areas_cells), high.labels)
    return Objects(
        labels=np.asarray(labels, dtype=np.int32), areas_cells=np.concatenate((high.areas_cells, low.areas_cells))
    )


def _taken(name: str, layers: Mapping[str, Mask]) -> Mask:
    """Where nothing new of a class may stand: a line may cross roads, nothing else may."""
    blockers = ("building", "water") if name in thin_classes() else (*_BLOCKED_BY, name)
    taken = np.zeros(layers[name].shape, dtype=bool)
    for blocker in blockers:
        if blocker in layers:
            taken |= layers[blocker]
    return dilated(taken, 1.5)


def _turned(stamp: Mask, rng: np.random.Generator) -> Mask:
    """The thing turned by quarters and mirrored at random."""
    quarters, mirrored = rng.integers(0, (4, 2)).tolist()
    return np.rot90(stamp[:, ::-1] if mirrored else stamp, quarters)


def _free_window(
    stamp: Mask, box: tuple[slice, ...], taken: Mask, cell_size_m: float, rng: np.random.Generator
) -> tuple[slice, slice] | None:
    """A window near a box in which the thing meets nothing; None where none was found."""
    height, width = stamp.shape
    size = np.array(stamp.shape)
    middle = np.array([(part.start + part.stop) / 2 for part in box])
    away = size.max() + rng.uniform(0, _NEAR_M / cell_size_m, size=(_TRIES, 1))
    heading = rng.uniform(0, 2 * np.pi, size=_TRIES)
    corners = middle + away * np.column_stack((np.sin(heading), np.cos(heading))) - size / 2
    for row, col in corners.astype(int).tolist():
        window = (slice(row, row + height), slice(col, col + width))
        is_inside = row >= 0 and col >= 0 and row + height <= taken.shape[0] and col + width <= taken.shape[1]
        if is_inside and not (taken[window] & stamp).any():
            return window
    return None
