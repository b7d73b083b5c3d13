# SPDX-License-Identifier: Apache-2.0
"""Features of the pixels of an aerial image: colour, texture and gradients at scales that are metres on the ground."""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Final, Self

import cv2
import numpy as np
from numpy.typing import NDArray

import sasgeo_bench as sgb

Plane = NDArray[np.float32]

FINEST_M: Final = 0.5  # side of a pixel that features are computed from; a coarser picture keeps its own
_PLAIN_M: Final = (0.5, 4.0)
_SHAPES_M: Final = (1.0, 2.0, 4.0)
_SPREADS_M: Final = (1.0, 2.0, 4.0, 8.0)
_CUT: Final = (2.0, 98.0)  # percentiles that the normalization of colours ignores beyond
_TARGET_SPREAD: Final = 40.0
_EMPTY: Final = (3, 252)  # bytes: all bands below or above are taken for no data
_HOLE_M: Final = 10.0  # radius


def ground_pixel_m(image: sgb.AerialImage) -> float:
    """Return the ground sampling distance in the middle of a picture, metres; NaN where no ground is seen there."""
    middle = np.array([[image.shape[1] / 2, image.shape[0] / 2]])
    return float(image.camera.gsd_m(middle, sgb.Plane())[0])


def working_size(image: sgb.AerialImage) -> tuple[int, int, float]:
    """Return rows, columns and the pixel's side in metres of the picture that features are computed from.

    No pixel is finer than `FINEST_M`; a picture is never enlarged. Where no ground is seen, pixels count as `FINEST_M`.
    """
    gsd_m = ground_pixel_m(image)
    if not np.isfinite(gsd_m) or gsd_m >= FINEST_M:
        return (*image.shape, gsd_m if np.isfinite(gsd_m) else FINEST_M)
    rows, cols = (max(1, round(side * gsd_m / FINEST_M)) for side in image.shape)
    return rows, cols, gsd_m * image.shape[0] / rows


def working_picture(image: sgb.AerialImage) -> tuple[NDArray[np.uint8], float]:
    """Return the picture that features are computed from, and the side of its pixels, metres."""
    rows, cols, pixel_m = working_size(image)
    if (rows, cols) == image.shape:
        return image.rgb, pixel_m
    return np.asarray(cv2.resize(image.rgb, (cols, rows), interpolation=cv2.INTER_AREA), dtype=np.uint8), pixel_m


def reduced_labels(labels: NDArray[np.uint8], shape: tuple[int, int]) -> NDArray[np.uint8]:
    """Return labels of a smaller picture: what covers half of a pixel; unknown where any of it is."""
    if labels.shape == shape:
        return labels
    parts = [
        cv2.resize((labels == state).astype(np.float32), shape[::-1], interpolation=cv2.INTER_AREA)
        for state in (sgb.PRESENT, sgb.UNKNOWN)
    ]
    found = np.asarray(parts[0] >= 0.5, dtype=np.uint8)  # half
    found[parts[1] > 0] = sgb.UNKNOWN
    return found


def enlarged(plane: Plane, shape: tuple[int, int]) -> Plane:
    """Return a plane of the working picture with the rows and columns of the picture."""
    return np.asarray(cv2.resize(plane, shape[::-1], interpolation=cv2.INTER_LINEAR), dtype=np.float32)


def enlarged_mask(mask: NDArray[np.bool_], shape: tuple[int, int]) -> NDArray[np.bool_]:
    """Return a mask of the working picture with the rows and columns of the picture."""
    return np.asarray(cv2.resize(mask.view(np.uint8), shape[::-1], interpolation=cv2.INTER_NEAREST)).view(np.bool_)


def normalized(rgb: NDArray[np.uint8]) -> Plane:
    """Return lightness, green-red and blue-yellow, shape (3, H, W), relative to the picture's own medians and spread.

    Sun, haze, season and sensor move all colours of a picture together: the median of each band becomes 0. One factor
    for lightness and one for both colours bring the spread between percentiles to that of a usual picture, so that
    a grey picture stays grey.
    """
    lab = lab_planes(rgb)
    return ColourBalance.of(lab).balanced(lab)


@dataclass(frozen=True, slots=True, kw_only=True)
class ColourBalance:
    """Median of each Lab band of a picture, and the factor that brings its spread to the usual one; shape (3,) each."""

    middle: NDArray[np.float64]
    factor: NDArray[np.float64]

    @classmethod
    def of(cls, lab: Plane) -> Self:
        """Measure the bands of a picture, shape (3, H, W)."""
        some = lab.reshape(3, -1)[:, :: max(1, lab[0].size // 50_000)]  # 50_000 pixels, for percentiles
        low, middle, high = np.percentile(some, [_CUT[0], 50, _CUT[1]], axis=1)
        # 4: least spread of 0..255: a picture of one colour is not stretched to a pattern
        spread = np.maximum(high - low, 4.0)
        spread[1:] = spread[1:].max()
        return cls(middle=middle, factor=np.array([4.0, 1.0, 1.0]) * _TARGET_SPREAD / spread)

    def balanced(self, lab: Plane) -> Plane:
        """Return the bands of a picture, or of a part of it, relative to its medians and spread."""
        relative = (lab - self.middle[:, None, None]) * self.factor[:, None, None]
        return np.ascontiguousarray(relative, dtype=np.float32)


def lab_planes(rgb: NDArray[np.uint8]) -> Plane:
    """Return lightness (0..255), green-red and blue-yellow as they are, shape (3, H, W)."""
    lab = cv2.cvtColor(np.asarray(rgb, dtype=np.float32) / 255, cv2.COLOR_RGB2LAB).transpose(2, 0, 1)
    lab[0] *= 2.55
    return np.ascontiguousarray(lab, dtype=np.float32)


def features(rgb: NDArray[np.uint8], pixel_m: float) -> tuple[tuple[str, ...], Plane]:
    """Return the names of F features and their values, shape (F, H, W).

    Most are of colours relative to the picture, which travel between cameras; a few are of the colours as they are,
    without which a picture of a lake alone would look like one of a field alone.
    """
    named = [*_named(normalized(rgb), pixel_m), *_plain(lab_planes(rgb), pixel_m)]
    return tuple(name for name, _ in named), np.stack([plane for _, plane in named])


def _named(bands: Plane, pixel_m: float) -> Iterator[tuple[str, Plane]]:
    light = bands[0]
    yield from (("light", light), ("green_red", bands[1]), ("blue_yellow", bands[2]))
    for sigma_m in (0.5, 1.0, 2.0, 4.0, 8.0):  # standard deviations of the Gaussians
        for name, band in zip(("light", "green_red", "blue_yellow"), bands, strict=True):
            yield f"{name}_{sigma_m:g}", blurred(band, sigma_m / pixel_m)
    for sigma_m in _SHAPES_M:
        smooth = blurred(light, sigma_m / pixel_m)
        yield from ((f"{name}_{sigma_m:g}", plane) for name, plane in _shape(smooth, sigma_m / pixel_m))
    for sigma_m in _SPREADS_M:
        for name, band in (("light", light), ("green_red", bands[1])):
            mean = blurred(band, sigma_m / pixel_m)
            square = blurred(band * band, sigma_m / pixel_m)
            yield f"{name}_spread_{sigma_m:g}", np.sqrt(np.maximum(square - mean * mean, 0))
    for reach_m in (1.5, 3.0, 6.0):  # radii of openings and closings: roofs, roads, shadows beside them
        # Mask of a disc, at least 3 pixels wide
        reach = max(1, round(reach_m / pixel_m))
        side = np.arange(-reach, reach + 1)
        kernel = (side[:, None] ** 2 + side**2 <= (reach + 0.5) ** 2).astype(np.uint8)
        yield f"bright_{reach_m:g}", light - cv2.morphologyEx(light, cv2.MORPH_OPEN, kernel)
        yield f"dark_{reach_m:g}", cv2.morphologyEx(light, cv2.MORPH_CLOSE, kernel) - light
        yield f"darkest_{reach_m:g}", cv2.erode(light, kernel) - light


def _plain(lab: Plane, pixel_m: float) -> Iterator[tuple[str, Plane]]:
    for sigma_m in _PLAIN_M:
        for name, band in zip(("light", "green_red", "blue_yellow"), lab, strict=True):
            yield f"plain_{name}_{sigma_m:g}", blurred(band, sigma_m / pixel_m)


def blurred(band: Plane, sigma_px: float) -> Plane:
    """Return a band after a Gaussian, of a smaller picture where it is wide."""
    if sigma_px < 0.3:  # pixels; it would move nothing
        return band
    shrink = int(sigma_px // 4.0)  # pixels: a wider blur is computed on a smaller picture
    if shrink < 2 or min(band.shape) < 2 * shrink:  # nothing to gain
        return np.asarray(cv2.GaussianBlur(band, (0, 0), sigma_px, borderType=cv2.BORDER_REFLECT), dtype=np.float32)
    size = (-(-band.shape[1] // shrink), -(-band.shape[0] // shrink))
    small = cv2.resize(band, size, interpolation=cv2.INTER_AREA)
    small = cv2.GaussianBlur(small, (0, 0), sigma_px / shrink, borderType=cv2.BORDER_REFLECT)
    return np.asarray(cv2.resize(small, band.shape[::-1], interpolation=cv2.INTER_LINEAR), dtype=np.float32)


def _shape(smooth: Plane, sigma_px: float) -> Iterator[tuple[str, Plane]]:
    """Yield strength of the gradient, how far it keeps to one direction, and both curvatures; none has a heading."""
    across, along = (cv2.Sobel(smooth, cv2.CV_32F, *order, ksize=3, scale=1 / 8) for order in ((1, 0), (0, 1)))
    yield "gradient", np.hypot(across, along) * np.float32(max(sigma_px, 1))
    around = 2 * sigma_px
    xx, yy, xy = (blurred(product, around) for product in (across * across, along * along, across * along))
    apart = np.sqrt((xx - yy) ** 2 + 4 * xy * xy)
    yield "edges", np.sqrt(np.maximum(xx + yy, 0)) * np.float32(max(sigma_px, 1))
    yield "one_way", apart / (xx + yy + np.float32(0.1))
    second = [cv2.Sobel(smooth, cv2.CV_32F, *order, ksize=3) for order in ((2, 0), (0, 2), (1, 1))]
    half, turn = (second[0] + second[1]) / 2, np.hypot((second[0] - second[1]) / 2, second[2])
    factor = np.float32(max(sigma_px, 1) ** 2)
    yield "ridge", np.asarray((half + turn) * factor, dtype=np.float32)
    yield "valley", np.asarray((half - turn) * factor, dtype=np.float32)


def has_data(rgb: NDArray[np.uint8], pixel_m: float) -> NDArray[np.bool_]:
    """Return where a picture shows something, shape (H, W): not a hole of pure black or white, as mosaics have.

    A roof may be overexposed; a hole is larger, so a disc of `_HOLE_M` must fit into it.
    """
    is_empty = np.asarray((rgb.max(axis=2) <= _EMPTY[0]) | (rgb.min(axis=2) >= _EMPTY[1]))
    shallow = np.asarray(_distance(is_empty) * pixel_m < _HOLE_M, dtype=np.bool_)
    return shallow if shallow.all() else np.asarray(_distance(shallow) * pixel_m > _HOLE_M)


def _distance(mask: NDArray[np.bool_]) -> Plane:
    """Return how far each pixel of a mask lies from the rest, pixels."""
    return np.asarray(cv2.distanceTransform(mask.view(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_5), dtype=np.float32)
