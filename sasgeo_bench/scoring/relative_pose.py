# SPDX-License-Identifier: Apache-2.0
"""Relative pose error of a flight: how far off is what an estimate says of a stretch, wherever the stretch lies."""

from typing import Final, NamedTuple

import numpy as np
import pandas as pd

from sasgeo_bench.geometry.pose import wrap_deg

STRETCHES_M: Final = (100.0, 200.0, 500.0)


class RelativeError(NamedTuple):
    """Root mean square errors of the stretches of one length; `pairs` of views begin and end them."""

    length_m: float
    pairs: int
    position_m: float
    yaw_deg: float


def relative_errors(views: pd.DataFrame, lengths_m: tuple[float, ...] = STRETCHES_M) -> tuple[RelativeError, ...]:
    """Return the relative pose error of one flight by length of the stretch.

    Parameters
    ----------
    views : DataFrame
        Rows of `scoring.flights.view_frame` of one flight, in order.
    lengths_m : tuple of float
        Lengths of the true way: from each view the stretch leads to the first one at least so far on.

    Returns
    -------
    tuple of RelativeError
        One for each length that a pair of views with estimates spans. A stretch over which the drone was carried
        counts none.

    Notes
    -----
    Where the second view lies in the axes of the first, right and up, as estimated less as true: no place on the map
    enters. Sturm et al., A Benchmark for the Evaluation of RGB-D SLAM Systems, IROS 2012, Eqs. 2 and 3, in the plane;
    pairs are chosen along the true way, so that they are the same for every tracker.

    Examples
    --------
    An odometer that is 2 % too long, and one that turns:

    >>> at = np.arange(0.0, 1000.0, 50.0)
    >>> none = np.zeros(len(at))
    >>> names = ("distance_m", "true_east_m", "true_north_m", "true_yaw_deg", "east_m", "north_m", "yaw_deg")
    >>> views = pd.DataFrame(dict(zip(names, (at, none, at, none, none, 1.02 * at, 0.1 * at))))
    >>> [(one.length_m, one.pairs, round(one.yaw_deg, 1)) for one in relative_errors(views)]
    [(100.0, 18, 10.0), (200.0, 16, 20.0), (500.0, 10, 50.0)]
    """
    distance_m = views["distance_m"].to_numpy(float)
    true, found = (
        views[[f"{prefix}{name}" for name in ("east_m", "north_m", "yaw_deg")]].to_numpy(float)
        for prefix in ("true_", "")
    )
    jumps = np.cumsum(views["is_carried"].to_numpy(bool)) if "is_carried" in views else np.zeros(len(views))
    errors = []
    for length_m in lengths_m:
        ends = np.searchsorted(distance_m, distance_m + length_m)
        first = np.flatnonzero(ends < len(views))
        last = ends[first]
        is_whole = np.isfinite(found[first]).all(axis=1) & np.isfinite(found[last]).all(axis=1)
        is_whole &= jumps[first] == jumps[last]
        first, last = first[is_whole], last[is_whole]
        if not len(first):
            continue
        off_m = _step(found[first], found[last]) - _step(true[first], true[last])
        off_deg = wrap_deg((found[last, 2] - found[first, 2]) - (true[last, 2] - true[first, 2]))
        position_m = float(np.sqrt(np.mean(np.abs(off_m) ** 2)))
        yaw_deg = float(np.sqrt(np.mean(np.asarray(off_deg) ** 2)))
        errors.append(RelativeError(length_m, len(first), position_m, yaw_deg))
    return tuple(errors)


def _step(first: np.ndarray, last: np.ndarray) -> np.ndarray:
    """Return where poses (east, north, yaw) lie in the axes of others, right + i up."""
    east_north = (last[:, 0] - first[:, 0]) + 1j * (last[:, 1] - first[:, 1])
    return np.asarray(east_north * np.exp(1j * np.radians(first[:, 2])))
