# SPDX-License-Identifier: Apache-2.0
"""A few small drawn pictures with labels, to try a segmenter on: the same on every machine, and nothing to download."""

from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

from sasgeo_bench.regions.evidence import UNKNOWN
from sasgeo_bench.sensing.camera import Camera, Intrinsics
from sasgeo_bench.sensing.image import AerialImage, LabelledImage, Picture

CLASSES: Final = ("road_minor", "building", "water", "green")
PLACES: Final = ("drawn-east", "drawn-west")
SIZE_PX: Final = (96, 128)  # rows and columns
_SEED: Final = 1  # of the drawings, which never change
_GROUND: Final = (150, 140, 120)
_COLOURS: Final = {
    "road_minor": (100, 100, 105),
    "building": (190, 110, 90),
    "water": (40, 70, 110),
    "green": (70, 110, 60),
}


def tiny_images() -> tuple[LabelledImage, ...]:
    """Return four pictures of two drawn places with roads, houses, a pond and trees; a strip of each has no labels.

    >>> pictures = tiny_images()
    >>> len(pictures), pictures[0].image.shape, sorted({picture.place for picture in pictures})
    (4, (96, 128), ['drawn-east', 'drawn-west'])
    """
    rng = np.random.default_rng(_SEED)
    return tuple(_picture(place, rng) for place in PLACES for _ in range(2))  # pictures of a place


def with_picture(rgb: Picture) -> AerialImage:
    """Return an image of any size, seen straight down from 80 m.

    >>> with_picture(np.zeros((1, 7, 3), dtype=np.uint8)).shape
    (1, 7)
    """
    rows, cols = rgb.shape[:2]
    lens = Intrinsics.from_field_of_view(horizontal_deg=70.0, width_px=cols, height_px=rows)
    camera = Camera.pointed(intrinsics=lens, east_m=0.0, north_m=0.0, height_m=80.0, yaw_deg=0.0)
    return AerialImage(rgb=rgb, camera=camera, height_sigma_m=1.0, attitude_sigma_deg=1.0)


def _picture(place: str, rng: np.random.Generator) -> LabelledImage:
    labels = _drawn(rng)
    rgb = np.empty((*SIZE_PX, 3), dtype=np.float64)
    rgb[:] = _GROUND
    for name in ("green", "water", "road_minor", "building"):
        rgb[labels[CLASSES.index(name)] == 1] = rng.normal(_COLOURS[name], 8)  # spread of a colour between pictures
    # 8: noise of a pixel, in steps of 255
    noisy = np.clip(rgb + rng.normal(scale=8.0, size=rgb.shape), 0, 255).astype(np.uint8)
    labels[:, :, -6:] = UNKNOWN  # pixels: margin at the right edge, which is not labelled
    return LabelledImage(image=with_picture(noisy), classes=CLASSES, labels=labels, place=place)


def _drawn(rng: np.random.Generator) -> NDArray[np.uint8]:
    """Draw where the classes are, shape (C, H, W)."""
    rows, cols = SIZE_PX
    labels = np.zeros((len(CLASSES), rows, cols), dtype=np.uint8)
    road, building, water, green = labels
    across = rng.integers(0, rows, 2).tolist()
    cv2.line(road, (0, across[0]), (cols - 1, across[1]), color=1, thickness=7)
    cv2.line(road, (int(rng.integers(0, cols)), 0), (int(rng.integers(0, cols)), rows - 1), color=1, thickness=5)
    cv2.ellipse(water, _at(rng), (14, 9), float(rng.uniform(0, 180)), 0, 360, color=1, thickness=-1)
    for _ in range(12):
        cv2.circle(green, _at(rng), int(rng.integers(4, 9)), color=1, thickness=-1)
    for _ in range(10):
        sides = tuple(map(float, rng.uniform(9, 20, 2)))
        corners = cv2.boxPoints((_at(rng), sides, float(rng.uniform(0, 90))))
        cv2.fillPoly(building, [np.round(corners).astype(np.int32)], color=1)
    building[road == 1] = 0
    water[(road == 1) | (building == 1)] = 0
    green[(road == 1) | (building == 1) | (water == 1)] = 0
    return labels


def _at(rng: np.random.Generator) -> tuple[int, int]:
    return int(rng.integers(0, SIZE_PX[1])), int(rng.integers(0, SIZE_PX[0]))
