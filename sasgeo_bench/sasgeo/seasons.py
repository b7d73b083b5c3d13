# SPDX-License-Identifier: Apache-2.0
"""Seasonal factors of classes, d_season of Eq. 5 of the SASGeo paper: by hand and fitted to views of known season."""

from collections.abc import Mapping, Sequence
from typing import Final

import numpy as np
from numpy.typing import NDArray

from sasgeo_bench.sasgeo.rates import ClassRates, Tally

# Visible share of a mapped class: our guesses, for want of a source; 1 for classes not named.
HAND: Final[Mapping[str, Mapping[str, float]]] = {
    "leaf_on": {"road_minor": 0.8, "path_track": 0.5, "railway": 0.9, "waterway": 0.7, "field_boundary": 0.8},
    "snow": {
        "road_minor": 0.6,
        "path_track": 0.3,
        "railway": 0.8,
        "water": 0.7,
        "waterway": 0.5,
        "green": 0.6,
        "farmland": 0.6,
        "field_boundary": 0.4,
        "parking": 0.4,
    },
    "low_water": {"water": 0.7, "waterway": 0.6, "coastline": 0.8},
    "harvest": {"farmland": 0.5, "field_boundary": 0.9},
}
SEASONS: Final = tuple(HAND)
_CELLS_PER_WITNESS: Final = 200.0  # as for rates: a house or a piece of road is right or wrong as a whole
_HAND_WITNESSES: Final = 20.0  # weight of a factor by hand


def by_hand(season: str, classes: Sequence[str]) -> NDArray[np.float64]:
    """Return the factors of a season set by hand, shape (C,); 1 for an unknown season."""
    factors = HAND.get(season, {})
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
