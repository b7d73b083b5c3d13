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

VERSION: Final = 3  # of the file: 1 and 2 knew neither countries nor causes
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

    Rates are those over all intervals: of all that vanishes or appears, of what is told to be the world's (`least`),
    and of that and what cannot be told (`most`); `vanished` and `appeared` are the shares of each cause
    (`sasgeo_bench.ageing.causes`). `redrawn_share` (of the older amount) and the median shift compare the first map
    with the last. The shift of an area is that of its centroid, so it means nothing where areas grow: green, farmland,
    water.
    """

    years: Annotated[float, Field(gt=0)]
    n_from: Count
    n_to: Count
    vanish_per_year: Estimate | None = None
    vanish_least_per_year: Estimate | None = None
    vanish_most_per_year: Estimate | None = None
    appear_per_year: Estimate | None = None
    appear_least_per_year: Estimate | None = None
    appear_most_per_year: Estimate | None = None
    vanished: dict[str, Share] = {}
    appeared: dict[str, Share] = {}
    redrawn_share: Share | None = None
    shift_median_m: NotNegative | None = None


class PlaceAgeing(Document):
    """Measurements of one place, its country as the splits name it, and the extracts they come from."""

    name: str
    country: str
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

    @property
    def countries(self) -> tuple[str, ...]:
        """Return the countries of the places, each once."""
        return tuple(dict.fromkeys(place.country for place in self.places))

    def __getitem__(self, name: str) -> PlaceAgeing:
        """Return the place of that name; `KeyError` if there is none."""
        return {place.name: place for place in self.places}[name]

    def country_of(self, extract: str) -> str | None:
        """Return the country of the place that was measured from extracts like this file, or None.

        Files are alike if their names are the same up to the date: rates from Liechtenstein are Vaduz's own.
        """
        stem = _stem(extract)
        return next((place.country for place in self.places if stem in map(_stem, place.extracts)), None)


def _stem(file: str) -> str:
    found = _BEFORE_DATE.match(file)
    return found[1] if found else file


@dataclass(frozen=True, slots=True, kw_only=True)
class PooledClass:
    """Yearly rates at which the world changes in one class, 1/year: the most that several countries leave room for."""

    vanish_per_year: float
    appear_per_year: float


@dataclass(frozen=True, slots=True, kw_only=True)
class PooledRates:
    """Rates by class, and the countries they come from."""

    classes: Mapping[str, PooledClass]
    countries: tuple[str, ...]


def pool_rates(book: RateBook, *, exclude: Collection[str] = ()) -> PooledRates:
    """Pool the rates of the world's change over all countries but those excluded.

    A place must not be aged by what was measured in it, nor by its neighbours: exclude its country, which
    `RateBook.country_of` gives for a measured extract. A country that was not measured may be named, too; "Isle of Man"
    is "isle-of-man".

    Notes
    -----
    The rates are `vanish_most_per_year` and `appear_most_per_year`: what is the world's, and what cannot be told.
    What was mapped late, redrawn or retagged is no change of the world. A place with fewer than `LEAST_THINGS` of a
    class, on the first map for what vanishes and on the last for what appears, is not used for that rate, and neither
    is a rate without bound; a class without both rates is left out. The rate of a country is the median of its places,
    the pooled rate the median of the countries: they differ by far more than the interval of any one of them, so each
    is one sample, and one import must not set the rate of all.
    """
    excluded = {name.lower().replace(" ", "-") for name in exclude}
    places = [place for place in book.places if place.country not in excluded]
    names = dict.fromkeys(name for place in places for name in place.classes)
    pooled = {name: _pooled(name, places) for name in names}
    return PooledRates(
        classes={name: item for name, item in pooled.items() if item is not None},
        countries=tuple(dict.fromkeys(place.country for place in places)),
    )


def _pooled(name: str, places: Sequence[PlaceAgeing]) -> PooledClass | None:
    found = [(place.country, place.classes[name]) for place in places if name in place.classes]
    vanish = [(at, item.vanish_most_per_year) for at, item in found if item.n_from >= LEAST_THINGS]
    appear = [(at, item.appear_most_per_year) for at, item in found if item.n_to >= LEAST_THINGS]
    rates = [_median_rate(side) for side in (vanish, appear)]
    if not all(map(math.isfinite, rates)):
        return None
    return PooledClass(vanish_per_year=rates[0], appear_per_year=rates[1])


def _median_rate(found: Sequence[tuple[str, Estimate | None]]) -> float:
    """Return the median over countries of the median of each; NaN if no place has a rate."""
    by_country: dict[str, list[float]] = {}
    for country, rate in found:
        if rate is not None and math.isfinite(rate.best):
            by_country.setdefault(country, []).append(rate.best)
    return float(np.median([np.median(own) for own in by_country.values()])) if by_country else math.nan


PACKAGED: Final = "ratebook.toml"


@cache
def load_ratebook() -> RateBook:
    """Return the rates of the package, those of `docs/ageing`."""
    text = resources.files("sasgeo_bench.ageing").joinpath(PACKAGED).read_text(encoding="utf-8")
    return parse_toml(text, RateBook, source=PACKAGED)
