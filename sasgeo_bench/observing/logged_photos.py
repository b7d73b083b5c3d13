# SPDX-License-Identifier: Apache-2.0
"""Poses of photos by the log of the flight on which they were taken, joined by time."""

import datetime as dt
import math
from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from types import MappingProxyType
from typing import Final

import numpy as np
import pyproj

from sasgeo_bench.core.errors import FlightError, PoseError, SasgeoError, counted, named
from sasgeo_bench.core.texts import plain
from sasgeo_bench.flights.log_points import AltitudeOf as LogAltitudeOf
from sasgeo_bench.observing.picture_poses import FLIGHT_LOG, AltitudeOf, PicturePose, PoseTable
from sasgeo_bench.observing.posed_pictures import GPS_SIGMA_M
from sasgeo_bench.observing.tracks import LOOKS_DOWN, Moment, Track, read_track
from sasgeo_bench.sensing.photos import Photo, read_photo

_WGS84: Final = pyproj.Geod(ellps="WGS84")
_SECOND: Final = math.sqrt(1 / 6)  # s, standard deviation of the difference of two times that count whole seconds
_FAR_M: Final = 50.0  # no receiver is as far off
_ALTITUDES: Final[Mapping[LogAltitudeOf, AltitudeOf]] = MappingProxyType(
    {"geoid": "sea", "ellipsoid": "ellipsoid", "unknown": "unstated"}
)


def poses_by_log(log: Path, photos: Mapping[str, Path], *, offset_s: float | None = None) -> PoseTable:
    """Return where photos were when they were taken, by a log; interpolated between its points.

    Parameters
    ----------
    log : Path
        As `import-flight` reads it; names of a table say its units.
    photos : mapping of str to Path
        Files by the names by which they are known.
    offset_s : float, optional
        Seconds of the log at which the first photo was taken. Without it the clocks must be known: the zone of the
        photos (EXIF's OffsetTimeOriginal), and UTC of the log.

    Returns
    -------
    PoseTable
        A photo without a time, before or after the log, or in a gap of it is left out. One that says how its camera
        stood keeps that; others look straight down, their up as the log's drone heads.

    Raises
    ------
    FlightError
        If the log is not sound, or nothing says how the clocks go together.
    PoseError
        If no photo was taken while the log ran.
    """
    track = read_track(log)
    if not track.has_own_clock:
        raise FlightError(f"{plain(log.name)} counts from the begin of a video: name a log")
    left_out: defaultdict[str, list[str]] = defaultdict(list)
    taken: dict[str, Photo] = {}
    for name, path in photos.items():
        try:
            photo = read_photo(path)
        except SasgeoError:
            left_out["that cannot be read"].append(name)
            continue
        if photo.taken_at is None:
            left_out["without a time (EXIF's DateTimeOriginal)"].append(name)
        else:
            taken[name] = photo
    times_s = _in_log(track, taken, offset_s)
    is_coarse = not any(photo.taken_at.microsecond for photo in taken.values() if photo.taken_at is not None)
    if is_coarse and offset_s is None:  # a clock that counts seconds is late by half of one on average
        times_s = {name: time_s + 0.5 for name, time_s in times_s.items()}
    poses, blurs_m = [], []
    for name, time_s in times_s.items():
        moment = track.at(time_s)
        if isinstance(moment, str):
            left_out[moment].append(name)
        else:
            has_gimbal = taken[name].gimbal is not None
            blur_m = _SECOND * _speed_mps(track, time_s) if is_coarse else 0.0
            blurs_m.append(blur_m)
            poses.append(_pose(name, replace(moment, camera=None) if has_gimbal else moment, track, time_s, blur_m))
    if not poses:
        why = "; ".join(f"{named([plain(name) for name in names], 'photo')} {why}" for why, names in left_out.items())
        mend = ": if a clock is wrong, say --offset" if times_s and offset_s is None else ""
        raise PoseError(f"no photo was taken while {plain(log.name)} ran ({why}){mend}")
    first = min(times_s.values())
    how = "as --offset says" if offset_s is not None else "by UTC of both"
    is_looked_up = any(pose.attitude is not None for pose in poses)
    notes = (
        f"the first of {counted(len(times_s), 'photo')} was taken {first:.1f} s after the log begins, {how}",
        *([f"times of photos count whole seconds: places are off by {max(blurs_m):.1f} m more"] if is_coarse else []),
        *_apart(poses, taken),
        *(note for note in track.notes if is_looked_up or note != LOOKS_DOWN),
    )
    out = {why: tuple(names) for why, names in left_out.items()}
    return PoseTable(path=log, kind=FLIGHT_LOG, poses=tuple(poses), left_out=out, notes=notes)


def _apart(poses: Sequence[PicturePose], taken: Mapping[str, Photo]) -> list[str]:
    """Return a line where the log puts photos far from where they say that they are: the clocks are off."""
    apart_m = []
    for pose in poses:
        photo = taken[pose.name]
        if photo.lon_deg is not None and photo.lat_deg is not None:
            apart_m.append(_WGS84.inv(*pose.lonlat, photo.lon_deg, photo.lat_deg)[2])
    median_m = float(np.median(apart_m)) if apart_m else 0.0
    if median_m <= _FAR_M:
        return []
    whose = f"{counted(len(apart_m), 'photo')} {median_m:.0f} m (median) from their own positions"
    return [f"the log puts {whose}, which are not used: is the offset right?"]


def _in_log(track: Track, taken: Mapping[str, Photo], offset_s: float | None) -> dict[str, float]:
    """Return when photos were taken by the clock of a log."""
    clock_s = {name: _seconds(photo) for name, photo in taken.items()}
    if not clock_s:
        return {}
    without = [name for name, photo in taken.items() if photo.utc_offset is None]
    if not without:  # cameras may be set to several zones
        ahead_s = {
            name: photo.utc_offset.total_seconds() for name, photo in taken.items() if photo.utc_offset is not None
        }
        clock_s = {name: clock_s[name] - ahead_s[name] for name in clock_s}
    if offset_s is not None:
        first_s = min(clock_s.values())
        return {name: offset_s + (seconds - first_s) for name, seconds in clock_s.items()}
    start_s = track.log.start_s
    lacks = []
    if without:
        lacks.append(f"{named([plain(name) for name in without], 'photo')} without the zone of the clock")
    if start_s is None:
        lacks.append(f"{plain(track.path.name)} does not say UTC")
    if start_s is None or without:
        raise FlightError(f"{', and '.join(lacks)}: say --offset, the seconds of the log at the first photo")
    return {name: seconds - start_s for name, seconds in clock_s.items()}


def _seconds(photo: Photo) -> float:
    assert photo.taken_at is not None  # noqa: S101 - others are left out
    return photo.taken_at.replace(tzinfo=dt.UTC).timestamp()


def _speed_mps(track: Track, time_s: float) -> float:
    """Return how fast the drone was around a time of the log."""
    ends = [one for one in (track.at(time_s - 0.5), track.at(time_s + 0.5)) if not isinstance(one, str)]
    return float(_WGS84.inv(*ends[0].lonlat, *ends[1].lonlat)[2]) if len(ends) > 1 else 0.0


def _pose(name: str, moment: Moment, track: Track, time_s: float, blur_m: float) -> PicturePose:
    log = track.log
    return PicturePose(
        name=name,
        place=moment.lonlat,
        height_m=moment.height_m,
        altitude_m=moment.altitude_m,
        altitude_of=_ALTITUDES[log.altitude_of],
        attitude=moment.camera,
        time_s=time_s if log.start_s is None else log.start_s + time_s,
        clock="own" if log.start_s is None else "utc",
        sigma_m=round(math.hypot(track.sigma_m or GPS_SIGMA_M, blur_m), 2) if blur_m else track.sigma_m,
    )
