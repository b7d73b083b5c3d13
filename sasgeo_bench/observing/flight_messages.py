# SPDX-License-Identifier: Apache-2.0
"""What a companion computer would tell an autopilot about a flight, and when: messages of MAVLink's common dialect.

Fields are named and counted as https://mavlink.io/en/messages/common.html has them. What unknown ones hold follows from
what ArduPilot and PX4 do with them; `docs/howto/replay.md` says which.
"""

import math
from collections.abc import Sequence
from dataclasses import astuple, dataclass, fields
from functools import lru_cache
from typing import Final, Literal

import numpy as np
import pyproj

from sasgeo_bench.core.errors import ConfigError, counted
from sasgeo_bench.flights.leap_seconds import week_of_utc
from sasgeo_bench.matching.tracker import SIDE
from sasgeo_bench.observing.fix_files import NS, PlacedFix
from sasgeo_bench.observing.flight_fixes import FlightFixes

Kind = Literal["vision_position_estimate", "gps_input"]

NO_FIX, FIX_3D = 1, 3  # GPS_FIX_TYPE
# GPS_INPUT_IGNORE_FLAGS: altitude, VDOP, velocities, accuracies of speed and height; all but place, HDOP and heading
_IGNORED: Final = 1 | 4 | 8 | 16 | 32 | 128
_NO_ACCURACY: Final = 64  # the same, of the place
# ArduPilot does not arm with a larger HDOP (GPS_HDOP_GOOD) or fewer satellites (EK3_GPS_CHECK).
_HDOP: Final = 1.0
_SATELLITES: Final = 10
_TURN_CDEG: Final = 36_000
_RESETS: Final = 256  # of a counter of one byte


@dataclass(frozen=True, kw_only=True)
class GpsInput:
    """A fix as the message of a receiver, GPS_INPUT (232)."""

    time_usec: int
    gps_id: int = 0
    ignore_flags: int = _IGNORED
    time_week_ms: int = 0
    time_week: int = 0
    fix_type: int
    lat: int
    lon: int
    alt: float = 0.0
    hdop: float = _HDOP
    vdop: float = 0.0
    vn: float = 0.0
    ve: float = 0.0
    vd: float = 0.0
    speed_accuracy: float = 0.0
    horiz_accuracy: float
    vert_accuracy: float = 0.0
    satellites_visible: int = _SATELLITES
    yaw: int


@dataclass(frozen=True, kw_only=True)
class VisionPositionEstimate:
    """A fix as a pose in a local frame of north, east, down: VISION_POSITION_ESTIMATE (102)."""

    usec: int
    x: float
    y: float
    z: float = 0.0
    roll: float = 0.0
    pitch: float = 0.0
    yaw: float
    covariance: tuple[float, ...]
    reset_counter: int


Message = GpsInput | VisionPositionEstimate
MESSAGES: Final[dict[Kind, type[Message]]] = {
    "vision_position_estimate": VisionPositionEstimate,
    "gps_input": GpsInput,
}


@dataclass(frozen=True, kw_only=True)
class Origin:
    """Origin of the local frame: WGS84, and metres above sea level. Raise `ConfigError` where there is none."""

    lon_deg: float
    lat_deg: float
    alt_m: float = 0.0

    def __post_init__(self) -> None:
        if not (abs(self.lon_deg) <= 180 and abs(self.lat_deg) < 90 and -500 <= self.alt_m <= 10_000):
            raise ConfigError(
                "--origin is longitude and latitude, degrees, and metres above the sea, got "
                f"{self.lon_deg:g},{self.lat_deg:g},{self.alt_m:g}"
            )


@dataclass(frozen=True, kw_only=True)
class Departure:
    """A fix that is sent; `view_s` and `sent_s` count from the first view of the flight, `resets` jumps until now."""

    fix: PlacedFix
    view_s: float
    sent_s: float
    resets: int


def departures(
    flight: FlightFixes, *, delay_s: float | None = None, rate_hz: float | None = None, has_all: bool = False
) -> tuple[Departure, ...]:
    """Return which fixes of a flight are sent, and when, in the order of sending.

    Parameters
    ----------
    flight : FlightFixes
        The fixes.
    delay_s : float, optional
        From each view until its fix is sent; by default as it was measured.
    rate_hz : float, optional
        Most fixes in a second; those that come sooner are left out.
    has_all : bool
        Whether fixes that are not accepted are sent as well.

    Raises
    ------
    ConfigError
        If no fix is left, or the delay of one was not measured and none is given.

    Examples
    --------
    >>> fix = {"lon_deg": 9.5, "lat_deg": 47.1, "east_m": 0.0, "north_m": 0.0, "heading_deg": 0.0, "yaw_deg": 0.0}
    >>> fixes = tuple(PlacedFix(name="a", is_accepted=at != 1, time_ns=at * NS, delay_s=0.25, **fix) for at in range(3))
    >>> flight = FlightFixes(flight="f", fixes=fixes, views=3, begin_ns=0, clock="flight", epsg=32632)
    >>> [(one.view_s, one.sent_s) for one in departures(flight)]
    [(0.0, 0.25), (2.0, 2.25)]
    """
    fixes = flight.fixes if has_all else flight.accepted
    if not fixes:
        none_of = f"none of {counted(len(flight.fixes), 'fix', 'fixes')} is accepted"
        raise ConfigError(f"{none_of}: --all takes them (a file, or --as gps_input)")
    found: list[Departure] = []
    resets, next_s = 0, -math.inf
    for fix in fixes:
        resets += fix.is_jump
        delay = fix.delay_s if delay_s is None else delay_s
        if delay is None:
            raise ConfigError(f"the run does not say how long the answer to view {fix.name} took: give --delay SECONDS")
        view_s = ((fix.time_ns or 0) - flight.begin_ns) / NS
        if view_s + delay < next_s - 1e-9:
            continue
        next_s = view_s + delay + (0.0 if rate_hz is None else 1 / rate_hz)
        found.append(Departure(fix=fix, view_s=view_s, sent_s=view_s + delay, resets=resets % _RESETS))
    return tuple(found)


def origin_of(sent: Sequence[Departure]) -> Origin:
    """Return the place of the first fix, which is the origin where none is chosen."""
    return Origin(lon_deg=sent[0].fix.lon_deg, lat_deg=sent[0].fix.lat_deg)


def message_of(one: Departure, kind: Kind, origin: Origin, stamp_ns: int, utc_ns: int | None) -> Message:
    """Return the message about a fix.

    `stamp_ns` is the time of the view on the clock that stamps count by, `utc_ns` the same by UTC where it is known.
    """
    if kind == "gps_input":
        return gps_input(one.fix, stamp_ns, utc_ns)
    return vision_position_estimate(one, origin, stamp_ns)


def gps_input(fix: PlacedFix, stamp_ns: int, utc_ns: int | None) -> GpsInput:
    """Return a fix as that of a receiver with a heading; its accuracy is the longer half axis of the ellipse, 1 sigma.

    >>> fix = {"lon_deg": 9.5, "lat_deg": 47.1, "east_m": 0.0, "north_m": 0.0, "heading_deg": 0.0, "yaw_deg": 0.0}
    >>> spread = (9.0, 0.0, 0.0, 0.0, 4.0, 0.0, 0.0, 0.0, 1.0)
    >>> found = gps_input(PlacedFix(name="a", is_accepted=True, covariance=spread, **fix), 1_500_000, None)
    >>> found.time_usec, found.lat, found.lon, found.horiz_accuracy, found.yaw
    (1500, 471000000, 95000000, 3.0, 36000)
    """
    week, week_ms = (0, 0) if utc_ns is None else week_of_utc(utc_ns / NS)
    variance_m2 = None if fix.covariance is None else float(np.linalg.eigvalsh(_matrix(fix.covariance)[:2, :2])[-1])
    return GpsInput(
        time_usec=stamp_ns // 1000,
        ignore_flags=_IGNORED | (_NO_ACCURACY if variance_m2 is None else 0),
        time_week=week,
        time_week_ms=week_ms,
        fix_type=FIX_3D if fix.is_accepted else NO_FIX,
        lat=round(fix.lat_deg * 1e7),
        lon=round(fix.lon_deg * 1e7),
        horiz_accuracy=0.0 if variance_m2 is None else math.sqrt(max(variance_m2, 0.0)),
        yaw=round(fix.heading_deg * 100) % _TURN_CDEG or _TURN_CDEG,  # 0 says that there is none
    )


def vision_position_estimate(one: Departure, origin: Origin, stamp_ns: int) -> VisionPositionEstimate:
    """Return a fix in the local frame of an origin: metres along WGS84 in the direction seen from there."""
    east_m, north_m = _plane(origin)(one.fix.lon_deg, one.fix.lat_deg)
    return VisionPositionEstimate(
        usec=stamp_ns // 1000,
        x=north_m,
        y=east_m,
        yaw=math.remainder(math.radians(one.fix.heading_deg), math.tau),
        covariance=_triangle(one.fix.covariance),
        reset_counter=one.resets,
    )


@lru_cache(maxsize=8)
def _plane(origin: Origin) -> pyproj.Proj:
    return pyproj.Proj(proj="aeqd", lon_0=origin.lon_deg, lat_0=origin.lat_deg, ellps="WGS84")


def _matrix(covariance: Sequence[float]) -> np.ndarray[tuple[int, ...], np.dtype[np.float64]]:
    return np.reshape(covariance, (SIDE, SIDE))


def _triangle(covariance: Sequence[float] | None) -> tuple[float, ...]:
    """Return the upper triangle of the covariance of x, y, z, roll, pitch and yaw, row by row; all NaN if unknown."""
    whole = np.full((6, 6), math.nan)
    if covariance is not None:
        to_rad = math.radians(1.0)
        measured = _matrix(covariance) * np.outer([1.0, 1.0, to_rad], [1.0, 1.0, to_rad])
        whole[:] = 0.0
        whole[np.ix_([1, 0, 5], [1, 0, 5])] = measured  # east is y, north is x
        # What was not measured is no better than what was: with a NaN or a large number there, PX4 or ArduPilot would
        # not use the others.
        whole[2, 2] = (whole[0, 0] + whole[1, 1]) / 2
        whole[3, 3] = whole[4, 4] = whole[5, 5]
    return tuple(whole[np.triu_indices(6)].tolist())


def columns_of(kind: Kind) -> tuple[str, ...]:
    """Return the columns of a table of messages: when each was sent, seconds since 1970, and its fields.

    >>> columns_of("vision_position_estimate")[-3:]
    ('covariance[19]', 'covariance[20]', 'reset_counter')
    """
    found = ["timestamp"]
    for field in fields(MESSAGES[kind]):
        found += [f"covariance[{at}]" for at in range(21)] if field.name == "covariance" else [field.name]
    return tuple(found)


def row_of(message: Message, sent_ns: int) -> tuple[object, ...]:
    """Return the row of a message in such a table."""
    found: list[object] = [f"{sent_ns // NS}.{sent_ns % NS:09d}"]
    for value in astuple(message):
        found += value if isinstance(value, tuple) else (value,)
    return tuple(found)
