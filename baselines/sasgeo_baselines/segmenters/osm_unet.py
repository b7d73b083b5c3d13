# SPDX-License-Identifier: Apache-2.0
"""`osm_unet`: a small U-Net that ships with weights, taught with OpenStreetMap as labels; runs on OpenCV alone."""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import Final, Self

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.special import expit

import sasgeo_bench as sgb
from sasgeo_baselines.segmenters.features import Plane, enlarged, enlarged_mask, ground_pixel_m, has_data
from sasgeo_baselines.segmenters.network import card_with

# Written by benchmarks/train_segmenter.py: taught by every picture that may teach, and by those of train places alone.
WEIGHTS: Final = Path(__file__).with_suffix(".onnx")
HELD_OUT_WEIGHTS: Final = Path(__file__).with_name("osm_unet_held_out.onnx")
CLASSES: Final = (
    *("building", "road_major", "road_minor", "path_track", "railway"),
    *("water", "green", "farmland", "parking", "bare"),
)
PIXEL_M: Final = 0.5  # that it was taught at
MULTIPLE: Final = 32  # rows and columns that the network sees are multiples of this
_MOST_ENLARGED: Final = 2.0  # what a coarser picture lacks, more pixels do not bring back
_STEP_PX: Final = 2  # a side of the cells that it answers, in pixels that it sees
_TILE_PX: Final = 1024
_MARGIN_PX: Final = 192  # around a tile: what an answer depends on lies nearer
_LEAST_SPREAD: Final = 1.0  # of 0..255: a picture of one colour is not stretched to a pattern


@dataclass(frozen=True, slots=True)
class Exposure:
    """Means of the bands, shape (3, 1, 1), and the spread of all, of one picture or of many by the same camera."""

    means: Plane
    spread: float

    @classmethod
    def of(cls, pixels: NDArray[np.uint8]) -> Self:
        """Measure pixels, shape (N, 3); raise `ValueError` if there is none."""
        values = pixels.astype(np.float32)
        means = values.mean(axis=0)
        return cls(means.reshape(3, 1, 1), max(float(np.sqrt(((values - means) ** 2).mean())), _LEAST_SPREAD))


def normalized(rgb: NDArray[np.uint8], exposure: Exposure | None = None) -> Plane:
    """Return what the network sees of a picture, shape (3, H, W): each band less its mean, by one spread for all.

    Sun, haze and sensor move the bands of a picture together, so no camera needs a calibration. Without `exposure`,
    that of the picture is taken.

    Examples
    --------
    >>> seen = normalized(np.array([[[0, 100, 50], [100, 200, 150]]], dtype=np.uint8))
    >>> seen[:, 0, 0].tolist(), seen[:, 0, 1].tolist()
    ([-1.0, -1.0, -1.0], [1.0, 1.0, 1.0])
    """
    by = exposure or Exposure.of(rgb.reshape(-1, 3))
    return np.asarray((np.moveaxis(rgb, 2, 0) - by.means) / np.float32(by.spread), dtype=np.float32)


class OsmUNet:
    """Probability of each class from a network that was taught before: nothing is learned in a run."""

    card = sgb.SegmenterCard(
        name="osm_unet",
        version="1",
        title="Small U-Net taught on pictures labelled by OpenStreetMap",
        source="Ronneberger et al., U-Net, MICCAI 2015; domain randomization as Tobin et al., IROS 2017",
        ours=(
            "Five levels from 1 to 16 m, 0.97 million weights, a sigmoid for each class; the bands of a picture less "
            "their means, by one spread; labels are OpenStreetMap's layers as they are, edges and ground without any "
            "area weighed less; data, figures and limits: docs/concepts/osm-unet.md"
        ),
        licence="Apache-2.0",
        classes=CLASSES,
        limits=(
            "Pixels of 0.3 to 1 m, seen from above; parking, bare ground and fields are guessed more than seen; "
            "steep valleys, deserts and snow were not taught"
        ),
        trained_on=("pardubice", "banepa", "chateaugiron", "koeln"),
    )

    def __init__(self, weights: Path = WEIGHTS, *, exposure: Exposure | None = None, is_mirrored: bool = False) -> None:
        self._weights, self._exposure, self._is_mirrored = weights, exposure, is_mirrored
        self.card = card_with(type(self).card, weights)

    def segment(self, image: sgb.AerialImage, *, learned: str | None) -> sgb.Segmentation:
        """Return probabilities at every pixel; silent on patches of pure black or white."""
        del learned  # it learns nothing
        small, pixel_m = _working_picture(image)
        is_known = has_data(small, pixel_m)
        exposure = self._exposure or Exposure.of(small[is_known] if is_known.any() else small.reshape(-1, 3))
        odds = _log_odds(_network(self._weights), normalized(small, exposure), is_mirrored=self._is_mirrored)
        found = np.empty((len(odds), *image.shape), dtype=np.float32)
        is_silent = ~enlarged_mask(is_known, image.shape)
        for plane, of_class in zip(found, odds, strict=True):
            plane[:] = enlarged(expit(of_class), image.shape)
            plane[is_silent] = np.nan
        return sgb.Segmentation.of_probabilities(CLASSES, found)


class OsmUNetHeldOut(OsmUNet):
    """The same network, taught in the same way without the pictures over Chateaugiron and Koeln, to be asked there."""

    card = replace(
        OsmUNet.card,
        name="osm_unet_held_out",
        title="osm_unet, taught without two of its four pictures",
        trained_on=("pardubice", "banepa"),
    )

    def __init__(self, weights: Path = HELD_OUT_WEIGHTS) -> None:
        super().__init__(weights)


def _working_picture(image: sgb.AerialImage) -> tuple[NDArray[np.uint8], float]:
    """Return the picture with pixels of `PIXEL_M`, and their side; where no ground is seen they stay as they are."""
    gsd_m = ground_pixel_m(image)
    factor = min(gsd_m / PIXEL_M, _MOST_ENLARGED) if np.isfinite(gsd_m) else 1.0
    rows, cols = (max(1, round(side * factor)) for side in image.shape)
    if (rows, cols) == image.shape:
        return image.rgb, PIXEL_M
    how = cv2.INTER_AREA if factor < 1 else cv2.INTER_LINEAR
    return np.asarray(cv2.resize(image.rgb, (cols, rows), interpolation=how), dtype=np.uint8), gsd_m / factor


@lru_cache(maxsize=1)
def _network(weights: Path) -> cv2.dnn.Net:
    try:
        return cv2.dnn.readNetFromONNX(str(weights))
    except cv2.error as error:
        raise ValueError(f"{weights} holds no network that OpenCV reads: name an ONNX file") from error


def _log_odds(network: cv2.dnn.Net, planes: Plane, *, is_mirrored: bool) -> Plane:
    """Return the log-odds of each class in cells of `_STEP_PX` pixels a side, or their mean with the mirror image's."""
    rows, cols = planes.shape[1:]
    padded = np.pad(planes, ((0, 0), (0, -rows % MULTIPLE), (0, -cols % MULTIPLE)), mode="symmetric")
    found = _by_tiles(network, padded)
    if is_mirrored:
        found += _by_tiles(network, padded[:, :, ::-1])[:, :, ::-1]
        found /= 2
    # Cells of padding are cut, but for one that a picture of odd sides shares with it.
    return found[:, : -(-rows // _STEP_PX), : -(-cols // _STEP_PX)]


def _by_tiles(network: cv2.dnn.Net, planes: Plane) -> Plane:
    height, width = (side // _STEP_PX for side in planes.shape[1:])
    found = np.empty((len(CLASSES), height, width), dtype=np.float32)
    for outer, inner, cut in _tiles(*planes.shape[1:]):
        network.setInput(np.ascontiguousarray(planes[None, :, *outer]))
        found[:, *inner] = network.forward()[0][:, *cut]
    return found


Window = tuple[slice, slice]


def _tiles(rows: int, cols: int) -> Iterator[tuple[Window, Window, Window]]:
    """Yield what is seen of each tile, pixels; where its answer belongs, and what of the answer that is, cells."""
    for row in range(0, rows, _TILE_PX):
        for col in range(0, cols, _TILE_PX):
            top, left = max(row - _MARGIN_PX, 0), max(col - _MARGIN_PX, 0)
            bottom, right = min(row + _TILE_PX, rows), min(col + _TILE_PX, cols)
            outer = np.s_[top : min(bottom + _MARGIN_PX, rows), left : min(right + _MARGIN_PX, cols)]
            inner = np.s_[row // _STEP_PX : bottom // _STEP_PX, col // _STEP_PX : right // _STEP_PX]
            cut = np.s_[
                (row - top) // _STEP_PX : (bottom - top) // _STEP_PX,
                (col - left) // _STEP_PX : (right - left) // _STEP_PX,
            ]
            yield outer, inner, cut
