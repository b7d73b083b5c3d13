# SPDX-License-Identifier: Apache-2.0
"""The track of a camera, which says where the pictures of a video or of a camera without a receiver were taken."""

import datetime as dt
import math
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from sasgeo_bench.core.errors import FlightError
from sasgeo_bench.core.texts import plain
from sasgeo_bench.flights.log_points import FlightLog
from sasgeo_bench.flights.log_subtitles import read_srt
from sasgeo_bench.flights.logs import MOST_GAP_S, is_tum, read_log
from sasgeo_bench.observing.posed_pictures import GPS_SIGMA_M
from sasgeo_bench.sensing.camera import Attitude

Floats = NDArray[np.float64]

LOOKS_DOWN: Final = "no angles of the camera: taken as looking straight down, its up as the drone heads"
_ENDS_S: Final = 1.0  # before the first and after the last point of a track whose place is still that of a point
_DEGREE_M: Final = 111_195.0  # of latitude
_DIGITS: Final = 7  # behind the point of a degree that are as good as any


@dataclass(frozen=True, kw_only=True)
class Moment:
    """What a track says of one time; None for what it does not."""

    lonlat: tuple[float, float]
    height_m: float | None = None
    altitude_m: float | None = None
    camera: Attitude | None = None
    film_mm: float | None = None


@dataclass(frozen=True, kw_only=True)
class Track:
    """Where the camera was, by the clock of a video (an SRT), or by one of its own (a log).

    `camera_deg` are yaw, pitch and roll, shape (N, 3); `film_mm` focal lengths as on 35 mm film; `began` is the time by
    the drone's clock at which an SRT begins.
    """

    path: Path
    log: FlightLog
    time_s: Floats
    has_own_clock: bool
    camera_deg: Floats | None = None  # yaw, pitch, roll
    film_mm: Floats | None = None
    began: dt.datetime | None = None  # by the drone's clock
    notes: tuple[str, ...] = ()

    @cached_property
    def sigma_m(self) -> float | None:
        """Return the standard deviation of places that are rounded to metres; None where they are not."""
        for digits in range(2, _DIGITS):
            if all(np.array_equal(np.round(one, digits), one) for one in (self.log.lon_deg, self.log.lat_deg)):
                rounded_m = 10.0**-digits * _DEGREE_M / math.sqrt(12)
                return None if rounded_m < 0.1 * GPS_SIGMA_M else round(math.hypot(GPS_SIGMA_M, rounded_m), 2)
        return None

    def at(self, time_s: float) -> Moment | str:
        """Return what the track says of a time of its clock, or why it says nothing."""
        times = self.time_s
        if not times[0] - _ENDS_S <= time_s <= times[-1] + _ENDS_S:
            return "that the track does not cover"
        after = int(np.clip(np.searchsorted(times, time_s), 1, len(times) - 1))
        if self.has_own_clock and times[after] - times[after - 1] > MOST_GAP_S:  # an SRT repeats what has not changed
            return f"in a gap of more than {MOST_GAP_S:g} s of the track"

        def linear(values: Floats | None, period: float | None = None) -> float | None:
            if values is None:
                return None
            pair = slice(after - 1, after + 1)
            two = np.unwrap(values[pair], period=period) if period else values[pair]
            return float(np.interp(time_s, times[pair], two))

        angles = [linear(column, 360.0) for column in self.camera_deg.T] if self.camera_deg is not None else [None]
        lon, lat = linear(self.log.lon_deg, 360.0), linear(self.log.lat_deg)
        assert lon is not None and lat is not None  # noqa: S101, PT018 - of every log
        return Moment(
            lonlat=((lon + 180.0) % 360.0 - 180.0, lat),
            height_m=linear(self.log.height_m),
            altitude_m=linear(self.log.altitude_m),
            camera=None
            if None in angles
            else Attitude(yaw_deg=angles[0] or 0.0, pitch_deg=angles[1] or 0.0, roll_deg=angles[2] or 0.0),
            film_mm=linear(self.film_mm),
        )


def read_track(path: Path) -> Track:
    """Read an SRT, or a log whose names say their units; raise `FlightError` if it has no places or no times."""
    if is_tum(path):
        raise FlightError(f"{plain(path.name)} has no longitude and latitude: name a track that has")
    if path.suffix.lower() == ".srt":
        said = read_srt(path)
        log, angles, film_mm, began = said.log, said.gimbal_deg, said.film_mm, said.began
    else:
        log, angles, film_mm, began = _read_log(path), None, None, None
    if log.time_s is None:
        raise FlightError(f"{plain(path.name)} has no times: name a track that has")
    notes = list(log.notes)
    if angles is None and log.yaw_deg is not None:
        # The gimbal follows the body's yaw, unless it is turned by hand.
        angles = np.column_stack([log.yaw_deg, np.full(len(log), -90.0), np.zeros(len(log))])
        notes.append(LOOKS_DOWN)
    return Track(
        path=path,
        log=log,
        time_s=log.time_s,
        has_own_clock=path.suffix.lower() != ".srt",
        camera_deg=angles,
        film_mm=film_mm,
        began=began,
        notes=tuple(notes),
    )


def _read_log(path: Path) -> FlightLog:
    try:
        return read_log(path)
    except FlightError as error:
        if "-unit" in str(error):
            raise FlightError(f"{error}; the latter, since units of a video's track are said by its names") from error
        raise
