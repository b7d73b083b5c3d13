# SPDX-License-Identifier: Apache-2.0
"""Crops that a network learns from: cut out of labelled pictures, turned and scaled, in other light and focus."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final, Self

import cv2
import numpy as np
from numpy.typing import NDArray

import sasgeo_bench as sgb
from sasgeo_baselines.segmenters.features import (
    ColourBalance,
    Plane,
    has_data,
    lab_planes,
    reduced_labels,
    working_picture,
)
from sasgeo_baselines.segmenters.network import input_planes

Pixels = NDArray[np.uint8]

CROP_PX: Final = 128
_LEAST_PX: Final = 2 * CROP_PX  # side of what is kept of a picture, however many there are
_LARGER: Final = 1.3  # at most, and as much smaller
_LUMA: Final = np.array([0.299, 0.587, 0.114])


@dataclass(frozen=True, slots=True, kw_only=True)
class LearningPicture:
    """A picture at working size: `rgb` (H, W, 3), `labels` (C, H, W), and `sample` (N, 3), some of its pixels."""

    rgb: Pixels
    labels: NDArray[np.uint8]
    sample: Pixels

    @classmethod
    def of(cls, labelled: sgb.LabelledImage, *, most_px: int, rng: np.random.Generator) -> Self:
        """Bring a picture to its working size, and keep a drawn part of it if it is larger than `most_px` a side."""
        rgb, pixel_m = working_picture(labelled.image)
        labels = np.stack([reduced_labels(plane, rgb.shape[:2]) for plane in labelled.labels])
        labels[:, ~has_data(rgb, pixel_m)] = sgb.UNKNOWN
        # 4000 pixels that tell the colours of a picture
        sample = rgb.reshape(-1, 3)[rng.integers(0, rgb[:, :, 0].size, 4000)]
        top, left = (int(rng.integers(0, max(side - most_px, 0) + 1)) for side in rgb.shape[:2])
        part = np.s_[top : top + most_px, left : left + most_px]
        return cls(rgb=rgb[part].copy(), labels=labels[:, *part].copy(), sample=sample)


def learning_pictures(images: Sequence[sgb.LabelledImage], rng: np.random.Generator) -> list[LearningPicture]:
    """Read pictures one after the other; of many, or of large ones, a part of each is kept."""
    most_px = max(int(np.sqrt(40_000_000 / len(images))), _LEAST_PX)  # pixels of all pictures together
    return [LearningPicture.of(labelled, most_px=most_px, rng=rng) for labelled in images]


@dataclass(frozen=True, slots=True, kw_only=True)
class Crops:
    """Pictures to cut crops out of, and the indices of the classes that are learned."""

    pictures: Sequence[LearningPicture]
    classes: Sequence[int]

    def batch(self, count: int, rng: np.random.Generator, *, is_by_class: bool) -> tuple[Plane, NDArray[np.uint8]]:
        """Draw crops: what the network sees, shape (count, BANDS, CROP_PX, CROP_PX), and labels (count, C, ...).

        With `is_by_class` half of them have a pixel of a drawn class in the middle, so that rare classes are seen.
        """
        drawn = [self._crop(rng, is_by_class=is_by_class and bool(at % 2)) for at in range(count)]
        return np.stack([planes for planes, _ in drawn]), np.stack([labels for _, labels in drawn])

    def _crop(self, rng: np.random.Generator, *, is_by_class: bool) -> tuple[Plane, NDArray[np.uint8]]:
        picture = self.pictures[int(rng.integers(len(self.pictures)))]
        middle = rng.uniform(0, picture.rgb.shape[:2])
        if is_by_class:
            middle = self._place_of_a_class(picture, rng, middle)
        rows, cols = _turned_lattice(middle, rng)
        rgb = cv2.remap(picture.rgb, cols, rows, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REFLECT)
        # Labels at places of a picture; unknown beyond it
        height, width = picture.rgb.shape[:2]
        row, col = (np.rint(at).astype(np.int64) for at in (rows, cols))
        inside = (row >= 0) & (row < height) & (col >= 0) & (col < width)
        found = picture.labels[list(self.classes)][:, row.clip(0, height - 1), col.clip(0, width - 1)]
        found[:, ~inside] = sgb.UNKNOWN
        labels = np.asarray(found, dtype=np.uint8)
        light = Light.drawn(rng)
        balance = ColourBalance.of(lab_planes(light.on(picture.sample[None])))
        return input_planes(_blurred(light.on(np.asarray(rgb, dtype=np.uint8)), rng), balance), labels

    def _place_of_a_class(
        self, picture: LearningPicture, rng: np.random.Generator, otherwise: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        shown = [at for at in self.classes if (picture.labels[at] == sgb.PRESENT).any()]
        if not shown:
            return otherwise
        places = np.flatnonzero(picture.labels[shown[int(rng.integers(len(shown)))]] == sgb.PRESENT)
        return np.array(np.divmod(places[int(rng.integers(len(places)))], picture.rgb.shape[1]), dtype=np.float64)


def _turned_lattice(middle: NDArray[np.float64], rng: np.random.Generator) -> tuple[Plane, Plane]:
    """Return rows and columns, shape (CROP_PX, CROP_PX), of a crop of any heading and size, flipped or not."""
    turn, scale = rng.uniform(0, 2 * np.pi), np.exp(rng.uniform(-np.log(_LARGER), np.log(_LARGER)))
    flip = 1 if rng.random() < 0.5 else -1
    side = np.arange(CROP_PX) - (CROP_PX - 1) / 2
    down, right = np.meshgrid(side * scale, side * scale * flip, indexing="ij")
    rows = middle[0] + np.cos(turn) * down - np.sin(turn) * right
    cols = middle[1] + np.sin(turn) * down + np.cos(turn) * right
    return rows.astype(np.float32), cols.astype(np.float32)


@dataclass(frozen=True, slots=True, kw_only=True)
class Light:
    """Another light: exponent, factor for each band, haze and saturation; all colours of a picture change together."""

    gamma: float
    gains: NDArray[np.float64]
    haze: float
    saturation: float

    @classmethod
    def drawn(cls, rng: np.random.Generator) -> Self:
        """Draw a light."""
        return cls(
            gamma=float(np.exp(rng.normal(0, 0.2))),
            gains=np.exp(rng.normal(0, 0.15) + rng.normal(0, 0.06, 3)),
            haze=float(max(rng.uniform(-0.2, 0.25), 0)),
            saturation=float(rng.uniform(0.5, 1.4)),
        )

    def on(self, rgb: Pixels) -> Pixels:
        """Return pixels, shape (..., 3), in this light."""
        bands = (rgb / 255) ** self.gamma * self.gains
        grey = (bands @ _LUMA)[..., None]
        bands = (grey + (bands - grey) * self.saturation) * (1 - self.haze) + 0.8 * self.haze
        return np.asarray(np.rint(np.clip(bands, 0, 1) * 255), dtype=np.uint8)


def _blurred(rgb: Pixels, rng: np.random.Generator) -> Pixels:
    """Return a crop out of focus, if so drawn, and with noise."""
    sigma_px, noise = rng.uniform(-1.0, 1.2), rng.uniform(0, 8)
    soft = cv2.GaussianBlur(rgb, (0, 0), sigma_px) if sigma_px > 0.3 else rgb  # less moves nothing
    return np.rint(np.clip(soft + rng.normal(0, noise, rgb.shape), 0, 255)).astype(np.uint8)
