# SPDX-License-Identifier: Apache-2.0
"""Measured yearly rates by place and class, their file `ratebook.toml`, and rates pooled over places."""

import math
import re
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from importlib import resources
from typing import Annotated, Final

import numpy as np
from pydantic import Field, field_validator

from sasgeo_bench.core.config import Document, parse_toml
from sasgeo_bench.core.errors import ConfigError

VERSION: Final = 2  # of the file: 1 had no rates of ground
LEAST_THINGS: Final = 20  # a rate of fewer things is too uncertain
_BEFORE_DATE: Final = re.compile(r"^(.+?)[-_.]*\d{4}-\d{2}-\d{2}")

Count = Annotated[int, Field(ge=0)]
Share = Annotated[float, Field(ge=0, le=1)]
NotNegative = Annotated[float, Field(ge=0)]


class Estimate(Document):
    """A yearly rate and its 95 % interval, 1/year; infinite if unbounded, None if no interval is known."""

    best: NotNegative
    lo: NotNegative | None = None
    hi: NotNegative | None = None


class ClassAgeing(Document):
    """Measurements of one class in one place over a number of years; None if there was nothing to measure.

    Rates are those over all intervals: `vanish` and `appear` count things, `ground_lost` and `ground_gained` what the
    class no longer, or newly, covers, so they hold what was redrawn too. `redrawn_share` (of the older amount) and the
    shifts compare the first map with the last. The shift of an area is that of its centroid, so it means nothing where
    areas grow: green, farmland, water.
    """

    years: Annotated[float, Field(gt=0)]
    n_from: Count
    n_to: Count
    vanish_per_year: Estimate | None = None
    appear_per_year: Estimate | None = None
    ground_lost_per_year: Estimate | None = None
    ground_gained_per_year: Estimate | None = None
    redrawn_share: Share | None = None
    shift_median_m: NotNegative | None = None
    shift_p90_m: NotNegative | None = None


class PlaceAgeing(Document):
    """Measurements of one place, and the extracts they come from."""

    name: str
    area_km2: NotNegative
    extracts: list[str]
    classes: dict[str, ClassAgeing] = Field(alias="class")


class RateBook(Document):
    """All measured places; `ratebook.toml`."""

    version: Annotated[int, Field(validate_default=True)] = 1  # the first had no such key
    attribution: str
    licence: str
    places: list[PlaceAgeing] = Field(alias="place")

    @field_validator("version")
    @classmethod
    def _is_current(cls, version: int) -> int:
        if version != VERSION:
            raise ValueError(
                f"write the rate book anew with measure-ageing --compare --rates: this program reads version {VERSION}"
            )
        return version

    @property
    def names(self) -> tuple[str, ...]:
        """Return the names of the places."""
        return tuple(place.name for place in self.places)

    def __getitem__(self, name: str) -> PlaceAgeing:
        """Return the place of that name; `KeyError` if there is none."""
        return {place.name: place for place in self.places}[name]

    def place_of(self, extract: str) -> str | None:
        """Return the place measured from extracts like this file, or None.

        Files are alike if their names are the same up to the date: rates from Liechtenstein are Vaduz's own.
        """
        stem = _stem(extract)
        return next((place.name for place in self.places if stem in map(_stem, place.extracts)), None)


def _stem(file: str) -> str:
    found = _BEFORE_DATE.match(file)
    return found[1] if found else file


@dataclass(frozen=True, slots=True, kw_only=True)
class PooledClass:
    """Rates of one class from several places, 1/year, and how it is re-drawn; None if no place has a value.

    Rates of ground are those of things and of what was redrawn. `redrawn_share` is of the amount `years` before; both
    are medians, as are the shifts in metres.
    """

    vanish_per_year: float
    appear_per_year: float
    ground_lost_per_year: float
    ground_gained_per_year: float
    years: float
    redrawn_share: float | None
    shift_median_m: float | None
    shift_p90_m: float | None


@dataclass(frozen=True, slots=True, kw_only=True)
class PooledRates:
    """Rates by class, and the places they come from."""

    classes: Mapping[str, PooledClass]
    places: tuple[str, ...]


def pool_rates(book: RateBook, *, exclude: Collection[str] = ()) -> PooledRates:
    """Pool the rates of all places but those excluded: a place must not be aged by its own measurements.

    `RateBook.place_of` gives the place of an extract. A place with fewer than `least_things` of a class, on the first
    map for what vanishes and on the last for what appears, is not used for that rate; a class without both rates is
    left out. Raise `ConfigError` if an excluded place is not in the book: a misspelt name would let its rates in.

    Notes
    -----
    The median, not a mean weighted by amount: places differ by far more than the interval of any one of them, so each
    is one sample of how maps age, and one import must not set the rate of all.
    """
    unknown = sorted(set(exclude) - set(book.names))
    if unknown:
        raise ConfigError(
            f"there is no place {unknown[0]!r} to leave out of the ageing rates; known: {', '.join(book.names)}"
        )
    places = [place for place in book.places if place.name not in exclude]
    names = dict.fromkeys(name for place in places for name in place.classes)
    pooled = {name: _pooled([place.classes[name] for place in places if name in place.classes]) for name in names}
    return PooledRates(
        classes={name: item for name, item in pooled.items() if item is not None},
        places=tuple(place.name for place in places),
    )


def _pooled(found: Sequence[ClassAgeing]) -> PooledClass | None:
    olds = [item for item in found if item.n_from >= LEAST_THINGS]
    news = [item for item in found if item.n_to >= LEAST_THINGS]
    sides = {"vanish": olds, "appear": news, "ground_lost": olds, "ground_gained": news}
    rates = {f"{what}_per_year": _median_rate(side, f"{what}_per_year") for what, side in sides.items()}
    if not all(map(math.isfinite, rates.values())):
        return None
    redrawn = [item for item in olds if item.redrawn_share is not None]
    return PooledClass(
        **rates,
        years=float(np.median([item.years for item in redrawn or olds])),
        redrawn_share=_median([item.redrawn_share for item in olds]),
        shift_median_m=_median([item.shift_median_m for item in olds]),
        shift_p90_m=_median([item.shift_p90_m for item in olds]),
    )


def _median_rate(found: Sequence[ClassAgeing], name: str) -> float:
    """Return the median of the best estimates of a rate; NaN if no place has one."""
    known: list[Estimate | None] = [getattr(item, name) for item in found]
    best = _median([rate.best for rate in known if rate is not None])
    return math.nan if best is None else best


def _median(values: Sequence[float | None]) -> float | None:
    known = [value for value in values if value is not None]
    return float(np.median(known)) if known else None


PACKAGED: Final = "ratebook.toml"


@cache
def load_ratebook() -> RateBook:
    """Return the rates of the package, those of `docs/ageing`."""
    text = resources.files("sasgeo_bench.ageing").joinpath(PACKAGED).read_text(encoding="utf-8")
    return parse_toml(text, RateBook, source=PACKAGED)
