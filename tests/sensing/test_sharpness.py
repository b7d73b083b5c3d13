# SPDX-License-Identifier: Apache-2.0
"""Sharpness: after blurring, no plain measure tells which of two pictures was the sharper one."""

import cv2
import numpy as np
import pytest
from scipy.ndimage import gaussian_filter, laplace, shift, zoom

from sasgeo_bench.core.errors import ImageError
from sasgeo_bench.sensing.sharpness import no_sharper
from tests.sensing.test_corruptions import ground

PAIRS = 24


def brightness(picture: np.ndarray) -> np.ndarray:
    return picture.astype(np.float64).mean(axis=2)


def of_laplacian(picture: np.ndarray) -> float:
    return float(laplace(brightness(picture)).var())


def of_high_waves(picture: np.ndarray) -> float:
    waves = np.abs(np.fft.fft2(brightness(picture) * np.outer(*(np.hanning(len(picture)),) * 2))) ** 2
    return float(waves[np.hypot(*np.meshgrid(*(np.fft.fftfreq(len(picture)),) * 2)) > 0.3].sum())


def auc(one: list[float], other: list[float]) -> float:
    """Return the share of pairs in which the first figure is the larger one."""
    return float((np.array(one)[:, None] > np.array(other)[None, :]).mean())


def town(seed: int, side_px: int = 192) -> np.ndarray:
    """Roofs, roads and grass: the same kind of content whatever the seed."""
    rng = np.random.default_rng(seed)
    picture = np.full((side_px, side_px, 3), (70, 95, 60), dtype=np.uint8)
    for _ in range(60):
        (x, y), (wide, high) = rng.integers(0, side_px, 2), rng.integers(8, 28, 2)
        picture[y : y + high, x : x + wide] = rng.integers(60, 220, 3)
    return np.clip(picture + rng.normal(0, 6, picture.shape), 0, 255).astype(np.uint8)


def coarse(picture: np.ndarray, times: int) -> np.ndarray:
    """Show a picture in pixels that are wider by a factor, resampled to its own: as mosaics are delivered."""
    rows, cols = picture.shape[:2]
    mean = picture.reshape(rows // times, times, cols // times, times, 3).astype(float).mean(axis=(1, 3))
    return np.clip(np.rint(zoom(mean, (times, times, 1), order=1)), 0, 255).astype(np.uint8)


def blurred(picture: np.ndarray, sigma_px: float) -> np.ndarray:
    return np.rint(gaussian_filter(picture.astype(float), (sigma_px, sigma_px, 0))).astype(np.uint8)


@pytest.mark.parametrize(
    ("measure", "dulled", "amount"),
    [
        *((of_laplacian, coarse, times) for times in (2, 3, 4)),
        *((of_laplacian, blurred, sigma) for sigma in (1, 2)),
        *((of_high_waves, blurred, sigma) for sigma in (1, 2)),
    ],
)
def test_no_measure_of_the_spectrum_tells_the_coarser_of_two_pictures(measure, dulled, amount):
    sharp = [town(seed) for seed in range(PAIRS)]
    dull = [dulled(town(100 + seed), amount) for seed in range(PAIRS)]
    assert auc([measure(one) for one in sharp], [measure(one) for one in dull]) > 0.95
    pairs = list(zip(sharp, dull, strict=True))
    first = [measure(no_sharper(one, than=other)) for one, other in pairs]
    second = [measure(no_sharper(other, than=one)) for one, other in pairs]
    assert 0.33 < auc(first, second) < 0.67


def test_a_picture_sharpened_by_its_maker_is_brought_down_though_its_pixels_are_as_wide():
    plain = town(1)
    crisp = np.clip(2.0 * plain - gaussian_filter(plain.astype(float), (1, 1, 0)), 0, 255).astype(np.uint8)
    assert of_laplacian(crisp) > 2 * of_laplacian(plain)
    assert of_laplacian(no_sharper(crisp, than=plain)) == pytest.approx(of_laplacian(plain), rel=0.1)


def test_the_coarser_picture_stays_as_it_is_and_the_finer_one_keeps_mean_and_place():
    fine = town(1)
    dull = blurred(fine, 2)
    assert np.abs(no_sharper(dull, than=fine).astype(int) - dull).max() <= 1
    found = no_sharper(fine, than=dull)
    np.testing.assert_allclose(found.mean(axis=(0, 1)), fine.mean(axis=(0, 1)), atol=1.0)
    apart = {
        off: np.corrcoef(shift(brightness(found), off)[8:-8, 8:-8].ravel(), brightness(fine)[8:-8, 8:-8].ravel())[0, 1]
        for off in [(0, 0), (1, 0), (-1, 0), (0, 1), (0, -1)]
    }
    assert max(apart, key=apart.get) == (0, 0)


def test_the_spectrum_is_brought_to_what_a_plain_transform_of_the_other_picture_has():
    one, other = ground(256), cv2.GaussianBlur(ground(256), (0, 0), 1.2)
    found = no_sharper(one, than=other)
    fade = np.outer(*(np.hanning(256),) * 2)
    radius = np.hypot(*np.meshgrid(*(np.fft.fftfreq(256),) * 2))
    for low, high in ((0.05, 0.1), (0.1, 0.2), (0.2, 0.3)):
        ring = (radius >= low) & (radius < high)
        power = [
            (np.abs(np.fft.fft2(fade * (brightness(item) - brightness(item).mean()))) ** 2)[ring].sum()
            for item in (found, other, one)
        ]
        assert power[0] == pytest.approx(power[1], rel=0.25)
    assert power[2] > 2 * power[1]


def test_a_picture_too_small_to_measure_is_refused_in_one_line():
    with pytest.raises(
        ImageError, match="a picture of 40 x 90 pixels is too small to measure its sharpness: expected 64"
    ):
        no_sharper(np.zeros((90, 40, 3), np.uint8), than=town(1))
