# SPDX-License-Identifier: Apache-2.0
"""Weights of features by the time since their last edit, from OSM timestamps (Eq. 5)."""

import datetime as dt
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from sasgeo_bench.regions.evidence import ABSENT, PRESENT
from sasgeo_bench.regions.layers import burn_layers, make_paint
from sasgeo_bench.regions.region import Region

IDLE_YEARS: Final = (1.0, 3.0, 6.0)  # from the last edit to the date of the map
STRATA: Final = len(IDLE_YEARS) + 1
NEVER: Final = STRATA  # no feature of the class

_DAYS_PER_YEAR: Final = 365.25
_CELLS_PER_WITNESS: Final = 200.0  # as for rates
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


def idle_years(edited: pd.Series, date: dt.date) -> NDArray[np.float64]:
    """Return years from the last edit of each feature to the date of a map, shape (N,); 0 without a timestamp."""
    edited = pd.to_datetime(edited, utc=True).dt.tz_localize(None)
    days = (pd.Timestamp(date) - edited).dt.days.to_numpy(dtype=np.float64)
    return np.asarray(np.maximum(np.nan_to_num(days), 0.0) / _DAYS_PER_YEAR)


def strata(region: Region) -> NDArray[np.uint8]:
    """Return the stratum of the feature of each class in each cell, of several the last edited, shape (C, rows, cols).

    i below `IDLE_YEARS[i]`, the last above all, `NEVER` where the class is not.
    """
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
        return np.asarray(((seen == state) & (where == index)).sum(axis=(1, 2)), dtype=np.int64)

    on = np.where(under == 0, stratum, np.uint8(NEVER))
    return StampTally(
        seen=np.stack([count(PRESENT, on, index) for index in range(STRATA)], axis=1),
        missed=np.stack([count(ABSENT, on, index) for index in range(STRATA)], axis=1),
        far_seen=count(PRESENT, under, far),
        far_missed=count(ABSENT, under, far),
    )
