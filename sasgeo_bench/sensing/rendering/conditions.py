# SPDX-License-Identifier: Apache-2.0
"""Under what conditions a picture is taken: season, sun, clouds, haze, and what the sensor does."""

import datetime as dt
import math
from dataclasses import dataclass
from typing import Final, Self

import numpy as np

from sasgeo_bench.errors import ConfigError
from sasgeo_bench.sensing.rendering.seasons import SEASONS, Season, season_of

_RANGES: Final = {
    "cloud": (0.0, 1.0),
    "visibility_m": (200.0, 1e6),
    "exposure_ev": (-4.0, 4.0),
    "blur_px": (0.0, 20.0),
    "noise": (0.0, 0.2),
    "warmth": (-1.0, 1.0),
}


@dataclass(frozen=True, slots=True, kw_only=True)
class Sun:
    """Where the sun stands: above the horizon, and clockwise from north."""

    elevation_deg: float
    azimuth_deg: float

    @property
    def direction(self) -> tuple[float, float, float]:
        """Return the unit vector towards the sun: east, north, up."""
        high, round_ = math.radians(self.elevation_deg), math.radians(self.azimuth_deg)
        return (math.cos(high) * math.sin(round_), math.cos(high) * math.cos(round_), math.sin(high))


def sun_at(when: dt.datetime, lon_deg: float, lat_deg: float) -> Sun:
    """Return where the sun stands at a time (UTC unless it has a zone), to about half a degree, without refraction.

    Azimuth counts from true north, which differs from grid north by the meridian convergence, at most 3 degrees in UTM
    at middle latitudes: far below what a shadow tells.

    Notes
    -----
    Declination and equation of time by the series of Spencer, *Fourier series representation of the position of the
    sun*, Search 2 (1971), with the fraction of the day in its angle.

    Examples
    --------
    Noon of the longest day at the northern tropic, and sunset of an equinox on the equator:

    >>> round(sun_at(dt.datetime(2024, 6, 20, 12, 2), 0.0, 23.44).elevation_deg)
    90
    >>> evening = sun_at(dt.datetime(2024, 3, 20, 18, 7), 0.0, 0.0)
    >>> round(abs(evening.elevation_deg)), round(evening.azimuth_deg)
    (0, 270)
    """
    moment = when.astimezone(dt.UTC) if when.tzinfo else when.replace(tzinfo=dt.UTC)
    hours = moment.hour + moment.minute / 60 + moment.second / 3600
    day = moment.timetuple().tm_yday - 1 + hours / 24
    g = 2 * math.pi * (day - 0.5) / 365.2425
    declination = (
        *(0.006918, -0.399912 * math.cos(g), 0.070257 * math.sin(g), -0.006758 * math.cos(2 * g)),
        *(0.000907 * math.sin(2 * g), -0.002697 * math.cos(3 * g), 0.00148 * math.sin(3 * g)),
    )
    equation = (
        *(0.000075, 0.001868 * math.cos(g), -0.032077 * math.sin(g)),
        *(-0.014615 * math.cos(2 * g), -0.040849 * math.sin(2 * g)),
    )
    d, latitude = sum(declination), math.radians(lat_deg)
    hour_angle = math.radians(15 * (hours - 12) + lon_deg) + sum(equation)
    up = math.sin(latitude) * math.sin(d) + math.cos(latitude) * math.cos(d) * math.cos(hour_angle)
    east = -math.cos(d) * math.sin(hour_angle)
    north = math.cos(latitude) * math.sin(d) - math.sin(latitude) * math.cos(d) * math.cos(hour_angle)
    return Sun(
        elevation_deg=math.degrees(math.asin(max(-1.0, min(1.0, up)))),
        azimuth_deg=math.degrees(math.atan2(east, north)) % 360,
    )


@dataclass(frozen=True, slots=True, kw_only=True)
class Conditions:
    """Season, light, air and sensor of one picture; raise `ConfigError` for a value out of range.

    `cloud` is 0 (clear) to 1 (no shadows at all); `visibility_m` is that of meteorology; `exposure_ev` in stops about
    the camera's own choice; `blur_px` and `motion_px` are the standard deviation of a Gaussian and the length of a
    streak across the picture; `noise` is a standard deviation, of full scale, of bright pixels in daylight; `warmth`
    shifts the white balance from blue (-1) to orange (1); `jpeg_quality` 0 leaves the picture as it is.

    >>> Conditions(sun=Sun(elevation_deg=40.0, azimuth_deg=150.0), cloud=2.0)
    Traceback (most recent call last):
        ...
    sasgeo_bench.errors.ConfigError: cloud lies within 0 and 1, got 2.0
    """

    sun: Sun = Sun(elevation_deg=45.0, azimuth_deg=150.0)
    season: Season = "summer"
    cloud: float = 0.0
    visibility_m: float = 30_000.0
    exposure_ev: float = 0.0
    blur_px: float = 0.6
    motion_px: float = 0.0
    noise: float = 0.01
    warmth: float = 0.0
    jpeg_quality: int = 88

    def __post_init__(self) -> None:
        if self.season not in SEASONS:
            raise ConfigError(f"season is one of {', '.join(SEASONS)}, got {self.season!r}")
        for name, (low, high) in _RANGES.items():
            value = getattr(self, name)
            if not low <= value <= high:
                raise ConfigError(f"{name} lies within {low:g} and {high:g}, got {value!r}")
        if not (0 <= self.jpeg_quality <= 100 and 0 <= self.motion_px <= 100):
            raise ConfigError(
                f"jpeg_quality and motion_px lie within 0 and 100, got {self.jpeg_quality!r} and {self.motion_px!r}"
            )

    @classmethod
    def at(cls, when: dt.datetime, lon_deg: float, lat_deg: float, *, is_snowy: bool = False) -> Self:
        """Return clear weather at a time and place: the season of its month and the sun where it stands then.

        >>> noon = Conditions.at(dt.datetime(2024, 1, 15, 11, 30), 9.5, 47.1)
        >>> noon.season, round(noon.sun.elevation_deg)
        ('winter', 22)
        """
        season = "snow" if is_snowy else season_of(when.date(), lat_deg)
        return cls(sun=sun_at(when, lon_deg, lat_deg), season=season)


def draw_conditions(rng: np.random.Generator, *, season: Season | None = None) -> Conditions:
    """Draw ordinary conditions of a daylight flight: a sun between 20 and 65 degrees, mostly clear, a decent camera."""
    chosen = season or SEASONS[int(rng.integers(0, 4))]
    return Conditions(
        sun=Sun(elevation_deg=float(rng.uniform(20, 65)), azimuth_deg=float(rng.uniform(90, 270))),
        season=chosen,
        cloud=float(rng.beta(0.6, 1.0)),
        visibility_m=float(10 ** rng.uniform(3.7, 4.7)),
        exposure_ev=float(np.clip(rng.normal(0, 0.3), -1, 1)),
        blur_px=float(rng.uniform(0.4, 1.1)),
        motion_px=float(min(rng.exponential(0.6), 4)),
        noise=float(rng.uniform(0.004, 0.02)),
        warmth=float(np.clip(rng.normal(0, 0.3), -1, 1)),
        jpeg_quality=int(rng.integers(70, 96)),
    )
