# SPDX-License-Identifier: Apache-2.0
"""From light to a stored picture: lens, noise, tone curve, JPEG."""

from functools import lru_cache
from typing import Final

import cv2
import numpy as np

from sasgeo_bench.sensing.rendering.conditions import Conditions
from sasgeo_bench.sensing.rendering.plan import Picture
from sasgeo_bench.sensing.rendering.texture import Field

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
