# SPDX-License-Identifier: Apache-2.0
"""Under what conditions a picture is taken: season, sun, clouds, haze, and what the sensor does."""

import datetime as dt
import math
from dataclasses import dataclass
from functools import lru_cache
from typing import Final, Self

import cv2
import numpy as np
from numpy.typing import NDArray

from sasgeo_bench.core.errors import ConfigError
from sasgeo_bench.sensing.rendering.plan import Picture
from sasgeo_bench.sensing.rendering.seasons import SEASONS, Season, season_of
from sasgeo_bench.sensing.rendering.texture import Field

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
    sasgeo_bench.core.errors.ConfigError: cloud lies within 0 and 1, got 2.0
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


_EXACT_STEPS: Final = 8
_EPS_M: Final = 0.12
_STEEPEST: Final = 1.4  # of a surface: the step from a roof to the ground is no slope

Rgb = NDArray[np.float32]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Light:
    """Light on the cells of a scene for one position of the sun.

    `shares` is uint8 of shape (rows, cols, 2): light of the sun (255 where it falls at right angles) and of the sky
    (255 where all of it is seen). `shade_m`, shape (rows, cols), is the height below which a point there is in shadow.
    """

    sun: Sun
    shares: Picture
    shade_m: Field


def cast_light(height_m: Field, cell_size_m: float, sun: Sun) -> Light:
    """Return the light on a height raster, shape (rows, cols)."""
    shade_m = cast_shadows(height_m, cell_size_m, sun)
    lit = (height_m >= shade_m - _EPS_M).astype(np.float32)
    lit = np.asarray(cv2.GaussianBlur(lit, (0, 0), max(0.3 / cell_size_m, 0.4)), dtype=np.float32)
    lit *= _facing(height_m, cell_size_m, sun)
    shares = np.empty((*height_m.shape, 2), dtype=np.uint8)
    shares[..., 0] = np.clip(lit * 255, 0, 255)
    # Share of the sky seen from each cell, 0-255, from how far the surroundings rise above it
    half = cv2.resize(height_m, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA)
    around = cv2.GaussianBlur(half, (0, 0), 1.2 / cell_size_m)
    around = cv2.resize(around, (height_m.shape[1], height_m.shape[0]), interpolation=cv2.INTER_LINEAR)
    above = np.maximum(around - height_m, 0)
    shares[..., 1] = np.asarray(255 * (0.35 + 0.65 / (1 + 0.45 * above)), dtype=np.uint8)
    return Light(sun=sun, shares=shares, shade_m=shade_m)


def _facing(height_m: Field, cell_size_m: float, sun: Sun) -> Field:
    """Return the cosine between the sun and the surface of each cell, not below 0."""
    east, north, up = (np.float32(part) for part in sun.direction)
    scale = 1 / (8 * cell_size_m)
    slope_e = np.clip(cv2.Sobel(height_m, cv2.CV_32F, 1, 0, scale=scale), -_STEEPEST, _STEEPEST)
    slope_n = np.clip(cv2.Sobel(height_m, cv2.CV_32F, 0, 1, scale=-scale), -_STEEPEST, _STEEPEST)
    facing = up - east * slope_e - north * slope_n
    facing /= np.sqrt(1 + slope_e * slope_e + slope_n * slope_n)
    return np.asarray(np.maximum(facing, 0), dtype=np.float32)


def cast_shadows(height_m: Field, cell_size_m: float, sun: Sun) -> Field:
    """Return the height below which a point over each cell is in the shadow of other cells, shape (rows, cols).

    Notes
    -----
    The highest line to the sun over the first eight steps is sought step by step. From then on the reach doubles: what
    shades a cell within 2n steps shades it within n, or shades the cell n steps away within n. So a shadow of 600 cells
    takes 15 passes; the sun's direction is rounded to a cell in each.

    Examples
    --------
    A wall 3 m high, the sun 45 degrees high in the west: two cells east of it, 1 m is still in shadow.

    >>> wall = np.array([[0, 3, 0, 0, 0, 0]], dtype=np.float32)
    >>> cast_shadows(wall, 1.0, Sun(elevation_deg=45.0, azimuth_deg=270.0)).round(1).tolist()
    [[0.0, 0.0, 2.0, 1.0, 0.0, 0.0]]
    """
    east, north, up = sun.direction
    flat = math.hypot(east, north)
    highest_m = float(height_m.max(initial=0.0))
    if up <= 0.02 or flat < 1e-6 or highest_m <= 0:
        return np.zeros_like(height_m) if up > 0.02 else np.full_like(height_m, highest_m + 1)
    fall_m = cell_size_m * up / flat
    reach = min(highest_m / fall_m, 160.0 / cell_size_m)  # m of a shadow; a low sun's shadows fade before
    towards = (-north / flat, east / flat)  # rows, cols
    shade = np.zeros_like(height_m)
    for step in range(1, min(_EXACT_STEPS, math.ceil(reach)) + 1):
        _raise(shade, height_m, (round(step * towards[0]), round(step * towards[1])), step * fall_m)
    step = _EXACT_STEPS
    while step < reach:
        _raise(shade, shade.copy(), (round(step * towards[0]), round(step * towards[1])), step * fall_m)
        step *= 2
    return shade


def _raise(shade: Field, other: Field, shift: tuple[int, int], fall_m: float) -> None:
    """Raise `shade` in place to `other`, seen from a cell at a distance, less a fall."""
    rows, cols = shade.shape
    down, right = shift
    if abs(down) >= rows or abs(right) >= cols:
        return
    here = np.s_[max(0, -down) : rows - max(0, down), max(0, -right) : cols - max(0, right)]
    there = np.s_[max(0, down) : rows - max(0, -down), max(0, right) : cols - max(0, -right)]
    np.maximum(shade[here], other[there] - np.float32(fall_m), out=shade[here])


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Exposure:
    """Colours of the light, linear, already as bright as the camera makes them; `lamp` is that of lamps and windows."""

    sun: Rgb
    sky: Rgb
    air: Rgb
    lamp: Rgb
    dark: float


def expose(conditions: Conditions) -> Exposure:
    """Return the light of the conditions, scaled by a camera that makes level ground as bright as it can.

    The sun reddens and weakens towards the horizon; twilight falls to a hundredth at -8 degrees. The camera follows the
    light for three quarters of its change in stops, so that night-fall is dark, bluish and (`dark` > 0) grainy.
    """
    elevation = conditions.sun.elevation_deg
    up = max(0.0, conditions.sun.direction[2])
    through = math.exp(-0.11 / (up + 0.04)) if up > 0 else 0.0
    red = 1 / (1 + 4.0 * up)
    sun = (
        1.15 * (1 - conditions.cloud) ** 1.5 * through * np.array([1.0 + 0.2 * red, 1.0 - 0.12 * red, 0.95 - 0.5 * red])
    )
    day = min(1.0, 10 ** ((elevation - 6) / 7)) if elevation < 6 else 1.0
    clear = np.array([0.78, 0.93, 1.22]) * (0.16 + 0.12 * up)
    grey = np.array([1.0, 1.0, 1.02]) * (0.18 + 0.62 * up)
    sky = day * ((1 - conditions.cloud) * clear + conditions.cloud * grey)
    level = float((sun * up + sky) @ (0.3, 0.6, 0.1))
    bright = 0.72 if conditions.season == "snow" else 1.0
    gain = bright * 1.5 / level**0.75 * 2**conditions.exposure_ev
    gain = min(gain, 110.0 * 2**conditions.exposure_ev)
    air = gain * (0.42 * sky + 0.22 * sun * up) * np.array([0.95, 1.0, 1.08])
    night = max(0.0, min(1.0, (3.0 - elevation) / 6))
    warm = np.array([1.0 + 0.16 * conditions.warmth, 1.0, 1.0 - 0.16 * conditions.warmth])
    lamp = night * np.array([1.1, 0.78, 0.42]) * 2**conditions.exposure_ev
    parts = (np.asarray(part * warm, dtype=np.float32) for part in (gain * sun, gain * sky, air, lamp))
    return Exposure(
        **dict(zip(("sun", "sky", "air", "lamp"), parts, strict=True)), dark=min(1.0, math.log2(max(1.0, gain)) / 6)
    )


_BANK: Final = 1024


def expose_sensor(
    light: Field, conditions: Conditions, dark: float, rng: np.random.Generator, *, is_flat: bool = False
) -> Picture:
    """Return a picture, uint8 of shape (H, W, 3), of linear light, float32 of the same shape, which is used up.

    `dark` (0 to 1) says how far the sensor had to amplify: noise is up to five times as strong.
    With `is_flat` the lens darkens no corner.

    Notes
    -----
    Values are stored as the square root of the light, as a display's gamma does nearly; there, the noise of counted
    photons has one standard deviation at every brightness.
    """
    blurred = _blurred(light, conditions)
    if not is_flat:
        blurred *= _vignette(*light.shape[:2])
    tone = _curve(np.sqrt(np.maximum(blurred, 0, out=blurred)))
    sigma = conditions.noise * (1 + 4 * dark)
    if sigma > 0:
        tone += _noise(tone.shape[:2], rng) * np.float32(255 * sigma)
    picture = np.clip(tone, 0, 255, out=tone).astype(np.uint8)
    # Picture as JPEG gives it back, or as it is
    if not conditions.jpeg_quality:
        return picture
    _, data = cv2.imencode(
        ".jpg", cv2.cvtColor(picture, cv2.COLOR_RGB2BGR), [cv2.IMWRITE_JPEG_QUALITY, conditions.jpeg_quality]
    )
    stored = np.asarray(cv2.imdecode(data, cv2.IMREAD_COLOR), dtype=np.uint8)
    return np.asarray(cv2.cvtColor(stored, cv2.COLOR_BGR2RGB), dtype=np.uint8)


def _blurred(light: Field, conditions: Conditions) -> Field:
    if conditions.blur_px > 0.2:
        light = np.asarray(cv2.GaussianBlur(light, (0, 0), conditions.blur_px), dtype=np.float32)
    length = round(conditions.motion_px)
    if length > 1:  # the drone flies up the picture
        kernel = np.full((length, 1), 1 / length, dtype=np.float32)
        light = np.asarray(cv2.filter2D(light, -1, kernel, borderType=cv2.BORDER_REPLICATE), dtype=np.float32)
    return light


@lru_cache(maxsize=4)
def _vignette(height_px: int, width_px: int) -> Field:
    """Return the share of the light that reaches each pixel, shape (H, W, 1)."""
    down = np.linspace(-1, 1, height_px, dtype=np.float32)[:, None]
    right = np.linspace(-1, 1, width_px, dtype=np.float32)[None, :]
    # 0.14 of the light is lost in the corners
    return np.asarray(1 - 0.14 / 2 * (down**2 + right**2))[..., None]


def _curve(tone: Field) -> Field:
    """Return values of 0 to 255: a gentle S, and highlights that bend off before they clip."""
    tone *= np.float32(0.96)
    bright = np.maximum(tone - np.float32(0.75), 0)
    tone -= bright * bright * np.float32(0.55)
    tone *= 255
    return tone


@lru_cache(maxsize=1)
def _bank() -> Field:
    """Return noise to cut from, drawn once: cutting at random places is ten times as fast as drawing."""
    rng = np.random.default_rng(4711)
    grey = rng.standard_normal((_BANK, _BANK, 1), dtype=np.float32)
    bank = 0.75 * grey + 0.66 * rng.standard_normal((_BANK, _BANK, 3), dtype=np.float32)
    bank.flags.writeable = False
    return np.asarray(bank)


def _noise(shape: tuple[int, ...], rng: np.random.Generator) -> Field:
    if max(shape) <= _BANK:
        row, col = (int(rng.integers(0, _BANK - count + 1)) for count in shape)
        return _bank()[row : row + shape[0], col : col + shape[1]]
    row, col = rng.integers(0, _BANK, 2).tolist()
    rows, cols = (row + np.arange(shape[0])) % _BANK, (col + np.arange(shape[1])) % _BANK
    return np.asarray(_bank()[rows[:, None], cols[None, :]])
