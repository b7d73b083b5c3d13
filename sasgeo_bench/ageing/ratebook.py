# SPDX-License-Identifier: Apache-2.0
"""Measured yearly rates for others to use: places -> classes -> rates, and one set of rates from all but one place."""

import math
import re
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from typing import Annotated, Final

import numpy as np
from pydantic import Field

from sasgeo_bench.config import Document
from sasgeo_bench.errors import ConfigError

LEAST_THINGS: Final = 20  # a rate of fewer things is that of a few accidents
_BEFORE_DATE: Final = re.compile(r"^(.+?)[-_.]*\d{4}-\d{2}-\d{2}")

Count = Annotated[int, Field(ge=0)]
Share = Annotated[float, Field(ge=0, le=1)]
NotNegative = Annotated[float, Field(ge=0)]


class Estimate(Document):
    """A yearly rate and its 95 % interval, 1/year; infinite without bound, None where no interval can be told."""

    best: NotNegative
    lo: NotNegative | None = None
    hi: NotNegative | None = None


class ClassAgeing(Document):
    """What was measured of one class in one place, `years` apart; None where there was nothing to measure.

    Rates are those over all intervals; `redrawn_share` (of the older amount) and the shifts compare the first map with
    the last. Of areas the shift is that of the centroid, so it says nothing where areas grow: green, farmland, water.
    """

    years: Annotated[float, Field(gt=0)]
    n_from: Count
    n_to: Count
    vanish_per_year: Estimate | None = None
    appear_per_year: Estimate | None = None
    redrawn_share: Share | None = None
    shift_median_m: NotNegative | None = None
    shift_p90_m: NotNegative | None = None


class PlaceAgeing(Document):
    """What was measured in one place, and the extracts it was measured from."""

    name: str
    area_km2: NotNegative
    extracts: list[str]
    classes: dict[str, ClassAgeing] = Field(alias="class")


class RateBook(Document):
    """All places that were measured; `ratebook.toml`.

    Examples
    --------
    >>> RateBook(attribution="", licence="", place=[]).names
    ()
    """

    attribution: str
    licence: str
    places: list[PlaceAgeing] = Field(alias="place")

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the places."""
        return tuple(place.name for place in self.places)

    def __getitem__(self, name: str) -> PlaceAgeing:
        """Return the place of that name; `KeyError` if there is none."""
        return {place.name: place for place in self.places}[name]

    def place_of(self, extract: str) -> str | None:
        """Which place was measured from extracts like this file; None if none was.

        Files are alike when their names are the same up to the date: rates from Liechtenstein are Vaduz's own.

        Examples
        --------
        >>> andorra = PlaceAgeing.model_validate(
        ...     {"name": "Andorra", "area_km2": 1.0, "extracts": ["andorra-2013-05-28.osm.pbf"], "class": {}}
        ... )
        >>> book = RateBook(attribution="", licence="", place=[andorra])
        >>> book.place_of("andorra-2025-01-19.osm.pbf"), book.place_of("prague-2020-01-05.osm.pbf")
        ('Andorra', None)
        """
        stem = _stem(extract)
        return next((place.name for place in self.places if stem in map(_stem, place.extracts)), None)


def _stem(file: str) -> str:
    found = _BEFORE_DATE.match(file)
    return found[1] if found else file


@dataclass(frozen=True, slots=True, kw_only=True)
class PooledClass:
    """Rates of one class from several places, 1/year, and how it is re-drawn; None where no place tells of that.

    `redrawn_share` is of what there was `years` before; both are medians, as are the shifts in metres.
    """

    vanish_per_year: float
    appear_per_year: float
    years: float
    redrawn_share: float | None
    shift_median_m: float | None
    shift_p90_m: float | None


@dataclass(frozen=True, slots=True, kw_only=True)
class PooledRates:
    """Rates by class, and the places they come from."""

    classes: Mapping[str, PooledClass]
    places: tuple[str, ...]


def pool_rates(book: RateBook, *, besides: Collection[str] = (), least_things: int = LEAST_THINGS) -> PooledRates:
    """One set of rates from all places but some: a place must not be aged by what was measured in it.

    Parameters
    ----------
    book : RateBook
        The measured places.
    besides : collection of str
        Names of places to leave out; `RateBook.place_of` tells which place an extract belongs to.
    least_things : int
        A place with fewer things of a class, on the first map for what vanishes and on the last for what appears, has
        no say in that rate.

    Returns
    -------
    PooledRates
        Medians over the places. A class is left out if no place can tell both of its rates.

    Raises
    ------
    ConfigError
        If a place to leave out is not in the book: a misspelt name would let its rates in.

    Notes
    -----
    The median, not a mean weighted by amount: places differ by far more than the interval of any one of them, so each
    is one draw of how maps age, and one import must not set the rate of all. A mean weighted by amount would be that of
    the largest place.

    Examples
    --------
    >>> def place(name, rate):
    ...     seen = {"years": 9.0, "n_from": 50, "n_to": 60, "vanish_per_year": {"best": rate}}
    ...     found = {"building": seen | {"appear_per_year": {"best": 10 * rate}}}
    ...     return PlaceAgeing.model_validate({"name": name, "area_km2": 1.0, "extracts": [], "class": found})
    >>> places = [place("north", 0.001), place("south", 0.002), place("west", 0.009)]
    >>> book = RateBook(attribution="", licence="", place=places)
    >>> pool_rates(book).classes["building"].vanish_per_year
    0.002
    >>> pool_rates(book, besides=["north"]).classes["building"].appear_per_year
    0.055
    """
    unknown = sorted(set(besides) - set(book.names))
    if unknown:
        message = f"there is no place {unknown[0]!r} to leave out of the ageing rates; known: {', '.join(book.names)}"
        raise ConfigError(message)
    places = [place for place in book.places if place.name not in besides]
    names = dict.fromkeys(name for place in places for name in place.classes)
    pooled = {
        name: _pooled([place.classes[name] for place in places if name in place.classes], least_things)
        for name in names
    }
    return PooledRates(
        classes={name: item for name, item in pooled.items() if item is not None},
        places=tuple(place.name for place in places),
    )


def _pooled(found: Sequence[ClassAgeing], least_things: int) -> PooledClass | None:
    olds = [item for item in found if item.n_from >= least_things]
    vanish = _median([item.vanish_per_year.best for item in olds if item.vanish_per_year])
    news = [item for item in found if item.n_to >= least_things]
    appear = _median([item.appear_per_year.best for item in news if item.appear_per_year])
    if vanish is None or appear is None or not math.isfinite(vanish + appear):
        return None
    redrawn = [item for item in olds if item.redrawn_share is not None]
    return PooledClass(
        vanish_per_year=vanish,
        appear_per_year=appear,
        years=float(np.median([item.years for item in redrawn or olds])),
        redrawn_share=_median([item.redrawn_share for item in olds]),
        shift_median_m=_median([item.shift_median_m for item in olds]),
        shift_p90_m=_median([item.shift_p90_m for item in olds]),
    )


def _median(values: Sequence[float | None]) -> float | None:
    known = [value for value in values if value is not None]
    return float(np.median(known)) if known else None
