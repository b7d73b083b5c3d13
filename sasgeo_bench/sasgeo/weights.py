# SPDX-License-Identifier: Apache-2.0
"""Gains of agreement and contradiction by class, age of the map, season and last edit: Eqs. 5 and 7 of the paper.

Eq. 5 lets a class fade as the map ages. Here features vanish and appear; the gains of Eq. 7 follow as log-likelihood
ratios, which tend to 0 as a class loses its information.
"""

import datetime as dt
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, replace
from typing import TYPE_CHECKING, Final, Self, get_args

import lazy_loader  # type: ignore[import-untyped, unused-ignore]
import numpy as np
from numpy.typing import NDArray

from sasgeo_bench.osm.taxonomy import Season, load_taxonomy
from sasgeo_bench.regions.evidence import ABSENT, LEVELS, PRESENT, SILENT
from sasgeo_bench.regions.region import Region
from sasgeo_bench.sasgeo.rates import ClassRates, Tally

if TYPE_CHECKING:
    import pandas as pd
else:  # loaded where ages of features are read
    pd = lazy_loader.load("pandas")

_LEAST: Final = 1e-4  # least distance of probabilities from 0 and 1


@dataclass(frozen=True, slots=True, kw_only=True)
class Gains:
    """Gains of Eq. 7 for each class, shape (C,): log-likelihood ratios, or the lambdas of the paper.

    `agree` for seen and mapped, `extra` for seen and not mapped, `missed` for mapped and seen to be absent, `quiet` for
    neither (0 in the paper). The first is positive, the next two are negative for an informative class.
    """

    agree: NDArray[np.float64]
    extra: NDArray[np.float64]
    missed: NDArray[np.float64]
    quiet: NDArray[np.float64]

    def only(self, at: int) -> Self:
        """Return the gains of one class."""
        return type(self)(**{item.name: getattr(self, item.name)[at : at + 1] for item in fields(self)})

    def softened(self, shares: NDArray[np.float64]) -> Self:
        """Return the gains with losses for misses reduced to shares, shape (C,): see `rates.missed_share`."""
        return replace(self, missed=self.quiet + shares * (self.missed - self.quiet))


def even_gains(weights: NDArray[np.float64]) -> Gains:
    """Return the gains of Eq. 7 with all lambdas 1, times weights of the classes."""
    return Gains(agree=weights, extra=-weights, missed=-weights, quiet=np.zeros(len(weights)))


def likelihood_gains(rates: Sequence[ClassRates], *, age_years: float, persists: Sequence[float] = ()) -> Gains:
    """Return log-likelihood ratios of the view of each class with and without the map, nats a cell.

    With S the probability that a mapped class still exists, B that it exists where it is not mapped, t and f hit and
    false alarm: P(seen | mapped) = S t + (1 - S) f, P(seen | not mapped) = B t + (1 - B) f, and their mean by the share
    of the ground that is mapped is the reference. `persists`, 0..1, is a seasonal factor of each class on S. A map
    younger than the view has age 0.
    """
    factors = list(persists) or [1.0] * len(rates)
    rows = [_ratios(one, age_years, factor) for one, factor in zip(rates, factors, strict=True)]
    agree, extra, missed, quiet = np.array(rows, dtype=np.float64).reshape(-1, 4).T
    return Gains(agree=agree, extra=extra, missed=missed, quiet=quiet)


def _ratios(rates: ClassRates, age_years: float, persists: float) -> tuple[float, float, float, float]:
    survival, unmapped = rates.survival(age_years) * persists, rates.unmapped(age_years)
    if survival <= unmapped:  # the map has no information on the class
        return 0.0, 0.0, 0.0, 0.0
    mapped, empty = (
        float(np.clip(share * rates.hit + (1 - share) * rates.false_alarm, _LEAST, 1 - _LEAST))
        for share in (survival, unmapped)
    )
    either = rates.mapped * mapped + (1 - rates.mapped) * empty
    agree, extra = np.log([mapped / either, empty / either]).tolist()
    missed, quiet = np.log([(1 - mapped) / (1 - either), (1 - empty) / (1 - either)]).tolist()
    return agree, extra, missed, quiet


def weigh(levels: NDArray[np.uint16], gains: Gains) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Return the linear form of Eq. 8: factors of map classes and of known map cells, as in `search.field.Template`.

    Parameters
    ----------
    levels : ndarray of uint16, shape (C, rows, cols)
        Probabilities of a view, as `Evidence.levels` returns them.
    gains : Gains
        Of the same classes.

    Returns
    -------
    tuple of ndarray of float32
        The first of shape (C, rows, cols), the second (rows, cols). Unknown cells are 0 in both.

    Notes
    -----
    With P the probability that a cell shows the class, its gain is the logarithm of the expected likelihood ratio:
    ln(P exp(agree) + (1 - P) exp(missed)) where the class is mapped, ln(P exp(extra) + (1 - P) exp(quiet)) elsewhere.
    At P = 1 and P = 0 these are the gains of Eq. 7. With gains of `likelihood_gains`, a P that equals the share of all
    cells that are seen present says nothing.

    Examples
    --------
    >>> weights, known = weigh(np.array([[[510, 0, 511, 255]]], dtype=np.uint16), even_gains(np.ones(1)))
    >>> weights[0, 0].round(2)
    array([ 2.  , -1.  ,  0.  ,  0.81], dtype=float32)
    """
    weights = np.zeros(levels.shape, dtype=np.float32)
    known = np.zeros(levels.shape[1:], dtype=np.float32)
    parts = zip(levels, gains.agree, gains.extra, gains.missed, gains.quiet, strict=True)
    for into, (view, agree, extra, missed, quiet) in zip(weights, parts, strict=True):
        mapped, empty = _by_level(agree, missed), _by_level(extra, quiet)
        into[:] = (mapped - empty).astype(np.float32).take(view)
        known += empty.astype(np.float32).take(view)
    return weights, known


def _by_level(present: float, absent: float) -> NDArray[np.float64]:
    """Return the gain of each level of probability, shape (LEVELS + 2,), from those of present and absent cells."""
    chance = np.arange(LEVELS + 1) / LEVELS
    gains = np.zeros(SILENT + 1)
    gains[:SILENT] = np.log(chance * np.exp(present) + (1 - chance) * np.exp(absent))
    gains[0], gains[LEVELS] = absent, present  # exactly: evidence without probabilities is read as it always was
    return gains


def information(rates: ClassRates, *, age_years: float, persists: float = 1.0) -> float:
    """Return the mutual information between the map and the view of a class, nats a cell.

    `persists` is the seasonal factor of the class, as in `likelihood_gains`.
    """
    agree, extra, missed, quiet = _ratios(rates, age_years, persists)
    survival, unmapped = rates.survival(age_years) * persists, rates.unmapped(age_years)
    mapped, empty = (share * rates.hit + (1 - share) * rates.false_alarm for share in (survival, unmapped))
    where_mapped = mapped * agree + (1 - mapped) * missed
    elsewhere = empty * extra + (1 - empty) * quiet
    return rates.mapped * where_mapped + (1 - rates.mapped) * elsewhere


# Visible share of a mapped class, by hand; 1 for classes not named.
SEASON_SHARES: Final[Mapping[str, Mapping[str, float]]] = {
    season: {item.name: item.seen_share[season] for item in load_taxonomy().classes if season in item.seen_share}
    for season in get_args(Season)
}
SEASONS: Final = tuple(SEASON_SHARES)
_CELLS_PER_WITNESS: Final = 200.0  # as for rates: a house or a piece of road is right or wrong as a whole
_HAND_WITNESSES: Final = 20.0  # weight of a factor by hand


def by_hand(season: str, classes: Sequence[str]) -> NDArray[np.float64]:
    """Return the factors of a season set by hand, shape (C,); 1 for an unknown season."""
    factors = SEASON_SHARES.get(season, {})
    return np.array([factors.get(name, 1.0) for name in classes], dtype=np.float64)


def fit_season(season: str, tallies: Sequence[Tally], rates: Sequence[ClassRates]) -> NDArray[np.float64]:
    """Fit the factors of one season: mapped cells that were seen, over those expected without a season.

    Examples
    --------
    >>> rate = ClassRates(
    ...     hit=0.8, false_alarm=0.01, missing=0.0, vanish_per_year=0.0, appear_per_year=0.0, mapped=0.1
    ... )
    >>> seen, missed = np.array([[200_000, 0, 0, 0, 0]]), np.array([[800_000, 0, 0, 0, 0]])
    >>> white = Tally(classes=("path_track",), age_years=0.0, block="a", seen=seen, missed=missed)
    >>> fit_season("snow", [white], [rate]).round(2).tolist()
    [0.25]
    """
    hand = by_hand(season, tallies[0].classes if tallies else ())
    seen, expected = np.zeros(len(hand)), np.zeros(len(hand))
    for one in tallies:
        standing = np.array([rate.survival(one.age_years) for rate in rates])
        hits, alarms = (np.array([getattr(rate, name) for rate in rates]) for name in ("hit", "false_alarm"))
        cells = (one.seen[:, 0] + one.missed[:, 0]) / _CELLS_PER_WITNESS
        seen += one.seen[:, 0] / _CELLS_PER_WITNESS
        expected += cells * (standing * hits + (1 - standing) * alarms)
    return np.clip((seen + _HAND_WITNESSES * hand) / (expected + _HAND_WITNESSES), 0.0, 1.0)


IDLE_YEARS: Final = (1.0, 3.0, 6.0)  # from the last edit to the date of the map
STRATA: Final = len(IDLE_YEARS) + 1
NEVER: Final = STRATA  # no feature of the class

_DAYS_PER_YEAR: Final = 365.25
_WITNESSES: Final = 20.0  # weight of the class mean in the estimate of a stratum
_EDGE: Final = 1e-5


@dataclass(frozen=True, slots=True, kw_only=True)
class StampTally:
    """Counts of cells of one view on each class of the map at the true place, by stratum; shape (C, STRATA) each.

    `far_seen` and `far_missed`, shape (C,), count cells far from the class.
    """

    seen: NDArray[np.int64]
    missed: NDArray[np.int64]
    far_seen: NDArray[np.int64]
    far_missed: NDArray[np.int64]


def idle_years(edited: "pd.Series", date: dt.date) -> NDArray[np.float64]:
    """Return years from the last edit of each feature to the date of a map, shape (N,); 0 without a timestamp."""
    edited = pd.to_datetime(edited, utc=True).dt.tz_localize(None)
    days = (pd.Timestamp(date) - edited).dt.days.to_numpy(dtype=np.float64)
    return np.asarray(np.maximum(np.nan_to_num(days), 0.0) / _DAYS_PER_YEAR)


def strata(region: Region) -> NDArray[np.uint8]:
    """Return the stratum of the feature of each class in each cell, of several the last edited, shape (C, rows, cols).

    i below `IDLE_YEARS[i]`, the last above all, `NEVER` where the class is not.
    """
    from sasgeo_bench.regions.layers import burn_layers, make_paint  # noqa: PLC0415 - imports GDAL

    idle = idle_years(region.features["timestamp"], region.manifest.extract.date)
    stratum = np.searchsorted(IDLE_YEARS, idle, side="right")
    made = np.where(region.layers == PRESENT, np.uint8(STRATA - 1), np.uint8(NEVER))
    for index in range(STRATA - 2, -1, -1):
        some = region.features[stratum == index]
        burnt = burn_layers(make_paint(some, region.classes, region.coverage), region.grid)
        made[(burnt == PRESENT) & (made != NEVER)] = index
    return made


def fit_trust(tallies: Sequence[StampTally]) -> NDArray[np.float64]:
    """Return the trust in each stratum relative to recent edits, 0..1, shape (C, STRATA).

    Like `rates.likeness` for distance: logarithms of the share of cells seen, scaled between the stratum seen most and
    cells far from the class. Strata with few cells are drawn to the mean of their class.
    """
    seen, missed, far_seen, far_missed = (
        np.sum([getattr(one, name) for one in tallies], axis=0) / _CELLS_PER_WITNESS
        for name in ("seen", "missed", "far_seen", "far_missed")
    )
    known = seen + missed
    mean = (seen.sum(axis=1) + _EDGE) / (known.sum(axis=1) + 2 * _EDGE)
    share = (seen + _WITNESSES * mean[:, None]) / (known + _WITNESSES)
    far = (far_seen + _EDGE) / (far_seen + far_missed + 2 * _EDGE)
    logs, low = (np.log(np.clip(values, _EDGE, 1 - _EDGE)) for values in (share, far[:, None]))
    span = logs.max(axis=1, keepdims=True) - low
    return np.asarray(np.clip(np.where(span > _EDGE, (logs - low) / np.maximum(span, _EDGE), 1.0), 0.0, 1.0))


def stamp_tally(seen: NDArray[np.uint8], under: NDArray[np.uint8], stratum: NDArray[np.uint8], far: int) -> StampTally:
    """Count the cells of a view by the stratum of the map under it.

    All arrays have shape (C, rows, cols) on the lattice of the view: `seen` (PRESENT, ABSENT, UNKNOWN), `under`
    (`rates.rings` of the map) and `stratum` (`strata`). `far` is the index of the ring far from a class.

    Examples
    --------
    >>> seen, under = np.array([[[1, 0, 0]]], dtype=np.uint8), np.array([[[0, 0, 4]]], dtype=np.uint8)
    >>> stamp_tally(seen, under, np.array([[[0, 3, 4]]], dtype=np.uint8), 4).seen.tolist()
    [[1, 0, 0, 0]]
    """

    def count(state: int, where: NDArray[np.uint8], index: int) -> NDArray[np.int64]:
        """Count the cells of a state where an index stands, shape (C,)."""
        return np.asarray(((seen == state) & (where == index)).sum(axis=(1, 2)), dtype=np.int64)

    on = np.where(under == 0, stratum, np.uint8(NEVER))
    return StampTally(
        seen=np.stack([count(PRESENT, on, index) for index in range(STRATA)], axis=1),
        missed=np.stack([count(ABSENT, on, index) for index in range(STRATA)], axis=1),
        far_seen=count(PRESENT, under, far),
        far_missed=count(ABSENT, under, far),
    )
