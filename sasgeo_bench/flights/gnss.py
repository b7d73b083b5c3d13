# SPDX-License-Identifier: Apache-2.0
"""A weak receiver along a flight: where it says that each view is, and within how far, by a log or drawn.

A log's receiver is weak beside another one, which is the truth. Drawn errors last, as those of satellites that are
hidden or reflected do: a Gauss-Markov process over time.
"""

import math
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType
from typing import Final

import numpy as np
import pyproj
from numpy.typing import NDArray

from sasgeo_bench.core.errors import FlightError
from sasgeo_bench.flights import log_bags, log_dataflash, log_telemetry, log_ulog
from sasgeo_bench.flights.log_streams import Fixes
from sasgeo_bench.flights.odometry import draw_gauss_markov
from sasgeo_bench.geometry.projection import from_lonlat

Floats = NDArray[np.float64]

SIGMAS: Final = 3.0  # of the accuracy that a receiver states, in the radius of a disc: 99 % of a plane's normal errors
CORRELATION_S: Final = 60.0  # of drawn errors, as PX4's receiver has it in Gazebo (gazebo_gps_plugin)

_ROUNDED_M: Final = 0.1  # of a disc, to which its middle is rounded
_LEAST_M: Final = 1.0  # radius of a disc, whatever is stated
_COPY_M: Final = 0.05  # two receivers differ by more
_READERS: Final = MappingProxyType(
    {".ulg": log_ulog.read_receivers, ".bin": log_dataflash.read_receivers, ".log": log_dataflash.read_receivers}
)
_GEOD: Final = pyproj.Geod(ellps="WGS84")


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class WeakGnss:
    """Fixes of a weak receiver at N views of a flight.

    Parameters
    ----------
    off_m : ndarray, shape (N, 2)
        East and north of the fix less those of the view, metres.
    radius_m : ndarray, shape (N,)
        Of the disc around the fix in which the view is said to lie, metres; NaN without a fix.
    """

    off_m: Floats
    radius_m: Floats

    @property
    def away_m(self) -> Floats:
        """Return how far the views are from the middles of their discs, shape (N,), metres."""
        return np.asarray(np.hypot(*self.off_m.T))

    def disc(
        self, at: int, place_m: tuple[float, float], *, least_m: float = 0.0
    ) -> tuple[tuple[float, float] | None, float | None]:
        """Return middle and radius of the disc of a view, to a decimetre and of a least radius; None without a fix."""
        if not math.isfinite(self.radius_m[at]):
            return None, None
        east_m, north_m = (round(float(one), 1) for one in np.asarray(place_m) + self.off_m[at])
        return (east_m, north_m), round(max(float(self.radius_m[at]), least_m), 1)


def draw_gnss(time_s: Floats, *, radius_m: float, rng: np.random.Generator) -> WeakGnss:
    """Draw the fixes of a weak receiver at moments, shape (N,).

    Parameters
    ----------
    time_s : ndarray, shape (N,)
        Seconds, in order.
    radius_m : float
        Of the disc of each view, metres: three standard deviations of the error of either axis. A fix that is farther
        off, as one in ninety, is drawn to its rim.
    rng : numpy.random.Generator

    Returns
    -------
    WeakGnss
        Errors of the two axes are Gauss-Markov processes with a correlation of exp(-time / 60 s).

    Examples
    --------
    Errors last: of views 5 s apart they are alike.

    >>> gnss = draw_gnss(np.arange(0.0, 600.0, 5.0), radius_m=50.0, rng=np.random.default_rng(2))
    >>> gnss.away_m[:4].round().tolist(), round(gnss.away_m.max())
    ([19.0, 11.0, 14.0, 15.0], 48)
    """
    steps_s = np.diff(time_s)
    axes = [draw_gauss_markov(steps_s, length_m=CORRELATION_S, rng=rng).values for _ in range(2)]
    off_m = radius_m / SIGMAS * np.stack(axes, axis=1)
    away_m = np.hypot(*off_m.T)
    reach_m = radius_m - _ROUNDED_M
    off_m *= np.minimum(1.0, reach_m / np.maximum(away_m, reach_m))[:, None]
    return WeakGnss(off_m=off_m, radius_m=np.full(len(off_m), radius_m))


@dataclass(frozen=True, slots=True, kw_only=True)
class SecondReceiver:
    """A receiver of a log beside the one that the truth is of.

    Parameters
    ----------
    fixes : Fixes
        With what it states of its accuracy.
    clock_s : float
        Seconds of the log's clock at time 0 of the flight.
    """

    fixes: Fixes
    clock_s: float

    @property
    def name(self) -> str:
        """Return the message or topic of its fixes."""
        return self.fixes.track.name

    def along(self, time_s: Floats, place_m: Floats, *, epsg: int) -> WeakGnss:
        """Return what it says of the views of the flight at moments, shape (N,), and places in a CRS, shape (N, 2).

        Places are by lines between its fixes, within a second of one on either side; accuracies likewise.
        """
        at_s, track, stated = time_s + self.clock_s, self.fixes.track, self.fixes.stated
        assert stated is not None  # noqa: S101 - by `second_receiver`
        lon, lat = track.at(at_s).T[:2]
        en_m = np.stack(from_lonlat(epsg).transform(lon, lat), axis=1)
        is_known = track.knows(at_s) & stated.knows(at_s)
        radius_m = np.maximum(SIGMAS * stated.at(at_s)[:, 0], _LEAST_M)
        return WeakGnss(off_m=en_m - place_m, radius_m=np.where(is_known, radius_m, np.nan))


def second_receiver(path: Path, *, clock_s: float, vehicle: int | None = None) -> SecondReceiver:
    """Read the receiver of a log that is a weaker one beside that of the truth.

    Parameters
    ----------
    path : Path
        ULog, DataFlash, telemetry or a bag.
    clock_s : float
        Seconds of the log's clock at time 0 of its flight.
    vehicle : int, optional
        System id of the vehicle in telemetry of several.

    Raises
    ------
    FlightError
        If there is none: each other receiver is named, and whether it is the truth itself under another name, states no
        accuracy, or a better one than the truth.
    """
    if log_bags.is_bag(path):
        receivers = log_bags.read_receivers(path)
    elif path.suffix.lower() == ".tlog":
        receivers = log_telemetry.read_receivers(path, vehicle=vehicle)
    elif path.suffix.lower() in _READERS:
        receivers = _READERS[path.suffix.lower()](path)
    else:
        raise FlightError(f"{path.name} has one receiver, which is the truth")
    receivers = [one for one in receivers if len(one.track) >= 2]
    if not receivers:
        raise FlightError(f"{path.name} has no receiver, but an estimate")
    truth, refused = receivers[0], []
    for one in receivers[1:]:
        why = _why_not(one, truth)
        if why is None:
            return SecondReceiver(fixes=one, clock_s=clock_s)
        refused.append(f"{one.track.name} {why}")
    only = f"{path.name} has one receiver, {truth.track.name}, which is the truth"
    raise FlightError("; ".join(refused) or only)


def _why_not(one: Fixes, truth: Fixes) -> str | None:
    """Return why a receiver is no weak one beside the truth; None if it is."""
    time_s = one.track.time_s[truth.track.knows(one.track.time_s)]
    if not len(time_s):
        return f"has no fix while {truth.track.name} has"
    lon, lat = one.track.at(time_s).T[:2]
    true_lon, true_lat = truth.track.at(time_s).T[:2]
    apart_m = np.asarray(_GEOD.inv(lon, lat, true_lon, true_lat)[2])
    if float(np.median(apart_m)) < _COPY_M:
        return f"is {truth.track.name} under another name, which is the truth"
    if one.stated is None:
        return "does not state its accuracy"
    if one.accuracy_m <= truth.accuracy_m:
        return f"states {one.accuracy_m:.1f} m, no worse than {truth.track.name}, which is the truth"
    return None
