# SPDX-License-Identifier: Apache-2.0
"""`unet`: a small U-Net, which learns from labelled pictures on one core; needs the extra [torch]."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, Self

import cv2
import numpy as np
from numpy.typing import NDArray

import sasgeo_bench as sgb
from sasgeo_baselines.segmenters.features import (
    ColourBalance,
    Plane,
    enlarged,
    enlarged_mask,
    has_data,
    lab_planes,
    reduced_labels,
    working_picture,
)
from sasgeo_baselines.segmenters.network import (
    MULTIPLE,
    Weights,
    card_with,
    drawn_weights,
    input_planes,
    log_odds,
    read_encoder,
    torch_module,
    weights_of,
    weights_text,
)

if TYPE_CHECKING:
    from torch import Tensor

Pixels = NDArray[np.uint8]

CROP_PX: Final = 128
_LEAST_PX: Final = 2 * CROP_PX  # side of what is kept of a picture, however many there are
_LARGER: Final = 1.3  # at most, and as much smaller
_LUMA: Final = np.array([0.299, 0.587, 0.114])


_BATCH: Final = 8
_RATE: Final = 2e-3  # of learning, at its highest
_DECAY: Final = 1e-2
_LEAST_PRESENT: Final = 50  # labelled pixels of a class, and as many without it: fewer teach nothing
_LEAST_SHARE: Final = 1e-4  # of a class, that the network begins with
_TILE_PX: Final = 512
_MARGIN_PX: Final = 64  # around a tile, so that its edge has surroundings too


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


class UNet:
    """Probability of each class at a pixel, from what surrounds it within a hundred metres.

    `weights`, in a class of your own, names a file that the encoder begins with: a learned text of `unet`, or an `.npz`
    of its arrays (`graph.encoder_shapes`). `most_crops` bounds the time of learning.

    >>> UNet().card.name
    'unet'
    """

    card = sgb.SegmenterCard(
        name="unet",
        version="1",
        title="Small U-Net",
        source="U-Net: Ronneberger et al., MICCAI 2015; group normalization: Wu and He, ECCV 2018",
        ours=(
            "Five levels of 1 to 16 m on the ground, 1.6 million weights; Lab colours relative to each picture and as "
            "they are; binary cross-entropy for each class; crops of 64 m, turned, flipped, scaled, blurred, in other "
            "light; no weights from elsewhere"
        ),
        licence="Apache-2.0",
        needs=("training",),
        limits="Needs the extra [torch]; the same text on one machine and thread, others may round differently",
    )
    weights: Path | None = None
    most_crops: int = 4800  # more make it surer of rendered pictures, and worse on real ones

    def __init__(self) -> None:
        self.card = card_with(type(self).card, self.weights)

    def learn(self, training: sgb.ImageTraining) -> str:
        """Return the weights that the pictures teach, as text."""
        torch = torch_module(self.card.name)
        rng = np.random.default_rng(1)
        pictures = learning_pictures(training.images, rng)
        shares = _shares(pictures, len(training.classes))
        if not shares:
            raise ValueError(
                f"no class has {_LEAST_PRESENT} labelled pixels of either kind: give more pictures, or larger ones"
            )
        weights = drawn_weights(len(shares), rng)
        if self.weights is not None:
            weights |= read_encoder(self.weights)
        odds = np.clip(list(shares.values()), _LEAST_SHARE, 1 - _LEAST_SHARE)
        weights["head.shift"] = np.repeat(np.log(odds / (1 - odds)), 4).astype(np.float32)
        crops = Crops(pictures=pictures, classes=tuple(shares))
        steps = max(min(self.most_crops, 180 * len(pictures)) // _BATCH, 1)  # 180 crops each of a picture, on average
        fitted = _fit(torch, weights, crops, steps=steps, rng=rng)
        return weights_text(tuple(training.classes[at] for at in shares), fitted)

    def segment(self, image: sgb.AerialImage, *, learned: str | None) -> sgb.Segmentation:
        """Return probabilities at every pixel; silent on patches of pure black or white."""
        if learned is None:
            raise ValueError(f"{self.card.name} needs training: learn from labelled pictures first")
        torch = torch_module(self.card.name)
        classes, arrays = _network(learned)
        small, pixel_m = working_picture(image)
        chances = _chances(torch, arrays, input_planes(small), len(classes))
        found = np.stack([enlarged(plane, image.shape) for plane in chances])
        found[:, ~enlarged_mask(has_data(small, pixel_m), image.shape)] = np.nan
        return sgb.Segmentation.of_probabilities(classes, found)


def _shares(pictures: Sequence[LearningPicture], classes: int) -> dict[int, float]:
    """Return the share of each class in what is labelled, by its index; of those that can be learned."""
    counts = np.array(
        [[(picture.labels[at] == state).sum() for picture in pictures] for at in range(classes) for state in _STATES]
    )
    absent, present = counts.sum(axis=1).reshape(classes, 2).T
    usable = np.flatnonzero(np.minimum(absent, present) >= _LEAST_PRESENT)
    return {int(at): float(present[at] / (absent[at] + present[at])) for at in usable}


_STATES: Final = (sgb.ABSENT, sgb.PRESENT)


def _fit(torch: Any, weights: Weights, crops: Crops, *, steps: int, rng: np.random.Generator) -> Weights:  # noqa: ANN401
    """Minimize the cross-entropy of crops by AdamW; the rate rises, then falls as a cosine."""
    arrays = {name: torch.tensor(values, requires_grad=True) for name, values in weights.items()}
    kernels = [values for name, values in arrays.items() if name.endswith(".kernel")]
    others = [values for name, values in arrays.items() if not name.endswith(".kernel")]
    groups = [{"params": kernels, "weight_decay": _DECAY}, {"params": others, "weight_decay": 0.0}]
    optimizer = torch.optim.AdamW(groups, lr=_RATE)
    for step in range(steps):
        done = step / steps
        for group in optimizer.param_groups:
            # 0.05 of all steps, in which the rate rises
            group["lr"] = _RATE * min((step + 1) / (0.05 * steps + 1), (1 + np.cos(np.pi * done)) / 2)
        # 0.6 of all steps, in which rare classes are drawn more often
        planes, labels = crops.batch(_BATCH, rng, is_by_class=done < 0.6)
        loss = _loss(torch, log_odds(torch, arrays, torch.from_numpy(planes)), torch.from_numpy(labels))
        optimizer.zero_grad(set_to_none=True)
        loss.backward()
        optimizer.step()
    return {name: np.asarray(values.detach().numpy(), dtype=np.float32) for name, values in arrays.items()}


def _loss(torch: Any, found: "Tensor", labels: "Tensor") -> "Tensor":  # noqa: ANN401 - a module
    known = labels != sgb.UNKNOWN
    truth = (labels == sgb.PRESENT).to(found.dtype)
    each = torch.nn.functional.binary_cross_entropy_with_logits(found, truth, reduction="none")
    return (each * known).sum() / known.sum().clamp(min=1)


@lru_cache(maxsize=1)
def _network(learned: str) -> tuple[tuple[str, ...], dict[str, "Tensor"]]:
    """Read the learned text; every call of a process gets the same."""
    classes, weights = weights_of(learned)
    torch = torch_module(UNet.card.name)
    return classes, {name: torch.from_numpy(values) for name, values in weights.items()}


def _chances(torch: Any, arrays: dict[str, "Tensor"], planes: Plane, classes: int) -> Plane:  # noqa: ANN401 - a module
    """Return the probability of each class, shape (classes, H, W), tile by tile."""
    found = np.empty((classes, *planes.shape[1:]), dtype=np.float32)
    with torch.inference_mode():
        for inner, outer, cut in _tiles(*planes.shape[1:]):
            part = _padded(planes[:, *outer])
            odds = log_odds(torch, arrays, torch.from_numpy(part[None]))
            found[:, *inner] = torch.sigmoid(odds)[0].numpy()[:, *cut]
    return found


Window = tuple[slice, slice]


def _tiles(rows: int, cols: int) -> Iterator[tuple[Window, Window, Window]]:
    for row in range(0, rows, _TILE_PX):
        for col in range(0, cols, _TILE_PX):
            top, left = max(row - _MARGIN_PX, 0), max(col - _MARGIN_PX, 0)
            bottom, right = min(row + _TILE_PX, rows), min(col + _TILE_PX, cols)
            outer = np.s_[top : bottom + _MARGIN_PX, left : right + _MARGIN_PX]
            yield np.s_[row:bottom, col:right], outer, np.s_[row - top : bottom - top, col - left : right - left]


def _padded(planes: NDArray[np.float32]) -> NDArray[np.float32]:
    rows, cols = planes.shape[1:]
    return np.pad(planes, ((0, 0), (0, -rows % MULTIPLE), (0, -cols % MULTIPLE)), mode="symmetric")
