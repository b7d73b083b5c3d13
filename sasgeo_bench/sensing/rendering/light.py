# SPDX-License-Identifier: Apache-2.0
"""Light on the ground: cast shadows, slopes towards and away from the sun, less sky beside walls."""

import math
from dataclasses import dataclass
from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

from sasgeo_bench.sensing.rendering.conditions import Conditions, Sun
from sasgeo_bench.sensing.rendering.plan import Picture
from sasgeo_bench.sensing.rendering.texture import Field

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
    # Cosine between the sun and the surface of each cell, not below 0
    east, north, up = (np.float32(part) for part in sun.direction)
    scale = 1 / (8 * cell_size_m)
    slope_e = np.clip(cv2.Sobel(height_m, cv2.CV_32F, 1, 0, scale=scale), -_STEEPEST, _STEEPEST)
    slope_n = np.clip(cv2.Sobel(height_m, cv2.CV_32F, 0, 1, scale=-scale), -_STEEPEST, _STEEPEST)
    facing = up - east * slope_e - north * slope_n
    facing /= np.sqrt(1 + slope_e * slope_e + slope_n * slope_n)
    lit *= np.asarray(np.maximum(facing, 0), dtype=np.float32)
    shares = np.empty((*height_m.shape, 2), dtype=np.uint8)
    shares[..., 0] = np.clip(lit * 255, 0, 255)
    # Share of the sky seen from each cell, 0-255, from how far the surroundings rise above it
    half = cv2.resize(height_m, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA)
    around = cv2.GaussianBlur(half, (0, 0), 1.2 / cell_size_m)
    around = cv2.resize(around, (height_m.shape[1], height_m.shape[0]), interpolation=cv2.INTER_LINEAR)
    above = np.maximum(around - height_m, 0)
    shares[..., 1] = np.asarray(255 * (0.35 + 0.65 / (1 + 0.45 * above)), dtype=np.uint8)
    return Light(sun=sun, shares=shares, shade_m=shade_m)


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
