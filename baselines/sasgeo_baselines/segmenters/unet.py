# SPDX-License-Identifier: Apache-2.0
"""`unet`: a small U-Net, which learns from labelled pictures on one core; needs the extra [torch]."""

from collections.abc import Iterator, Sequence
from functools import lru_cache
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

import sasgeo_bench as sgb
from sasgeo_baselines.segmenters.crops import Crops, LearningPicture, learning_pictures
from sasgeo_baselines.segmenters.features import Plane, enlarged, enlarged_mask, has_data, working_picture
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

_BATCH: Final = 8
_RATE: Final = 2e-3  # of learning, at its highest
_DECAY: Final = 1e-2
_LEAST_PRESENT: Final = 50  # labelled pixels of a class, and as many without it: fewer teach nothing
_LEAST_SHARE: Final = 1e-4  # of a class, that the network begins with
_TILE_PX: Final = 512
_MARGIN_PX: Final = 64  # around a tile, so that its edge has surroundings too


class UNet:
    """Probability of each class at a pixel, from what surrounds it within a hundred metres.

    `weights`, in a class of your own, names a file that the encoder begins with: a learned text of `unet`, or an `.npz`
    of its arrays (`network.encoder_shapes`). `most_crops` bounds the time of learning.

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


def _loss(torch: Any, found: Any, labels: Any) -> Any:  # noqa: ANN401 - tensors
    known = labels != sgb.UNKNOWN
    truth = (labels == sgb.PRESENT).to(found.dtype)
    each = torch.nn.functional.binary_cross_entropy_with_logits(found, truth, reduction="none")
    return (each * known).sum() / known.sum().clamp(min=1)


@lru_cache(maxsize=1)
def _network(learned: str) -> tuple[tuple[str, ...], dict[str, Any]]:
    """Read the learned text; every call of a process gets the same."""
    classes, weights = weights_of(learned)
    torch = torch_module(UNet.card.name)
    return classes, {name: torch.from_numpy(values) for name, values in weights.items()}


def _chances(torch: Any, arrays: dict[str, Any], planes: Plane, classes: int) -> Plane:  # noqa: ANN401 - a module
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
