# SPDX-License-Identifier: Apache-2.0
"""Gains of agreement and contradiction by class, age of the map and season: Eqs. 5 and 7 of the SASGeo paper.

Eq. 5 lets a class fade as the map ages. Here features vanish and appear; the gains of Eq. 7 follow as log-likelihood
ratios, which tend to 0 as a class loses its information.
"""

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from typing import Final, Self

import numpy as np
from numpy.typing import NDArray

from sasgeo_bench.osm.taxonomy import load_taxonomy
from sasgeo_bench.regions.evidence import ABSENT, PRESENT
from sasgeo_bench.sasgeo.rates import ClassRates

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


def hand_gains(classes: Sequence[str], *, age_years: float, persists: Sequence[float] = ()) -> Gains:
    """Return the gains of Eqs. 5 and 7 as written: lambdas of 1, times prior, decay by age and season by hand.

    Examples
    --------
    >>> hand_gains(["railway"], age_years=0.0).agree.tolist()
    [0.97]
    """
    taxonomy = load_taxonomy()
    hand = [taxonomy[name].persistence for name in classes]
    decay = np.array([one.prior * np.exp(-one.vanish_per_year * max(age_years, 0.0)) for one in hand], dtype=np.float64)
    return even_gains(decay * (np.array(persists, dtype=np.float64) if persists else 1.0))


def weigh(cells: NDArray[np.uint8], gains: Gains) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Return the linear form of Eq. 8: factors of map classes and of known map cells, as in `search.field.Template`.

    `cells` and the first factors have shape (C, rows, cols), the second (rows, cols). Unknown cells are 0 in both.

    Examples
    --------
    >>> weights, known = weigh(np.array([[[1, 0, 2]]], dtype=np.uint8), hand_gains(["railway"], age_years=0.0))
    >>> weights[0, 0]
    array([ 1.94, -0.97,  0.  ], dtype=float32)
    """
    weights = np.zeros(cells.shape, dtype=np.float32)
    known = np.zeros(cells.shape[1:], dtype=np.float32)
    parts = zip(cells, gains.agree, gains.extra, gains.missed, gains.quiet, strict=True)
    for into, (view, agree, extra, missed, quiet) in zip(weights, parts, strict=True):
        values = np.zeros((2, 3), dtype=np.float32)
        values[:, PRESENT], values[:, ABSENT] = (agree - extra, extra), (missed - quiet, quiet)
        into[:] = values[0][view]
        known += values[1][view]
    return weights, known


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
