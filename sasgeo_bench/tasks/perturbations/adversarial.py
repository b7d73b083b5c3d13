# SPDX-License-Identifier: Apache-2.0
"""Adversarial occlusion: the mask of a fixed library that hides most of a view."""

from functools import lru_cache
from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

from sasgeo_bench.regions.evidence import PRESENT, Evidence
from sasgeo_bench.tasks.perturbations.base import Mask, Occlusion
from sasgeo_bench.tasks.perturbations.fields import Field, centres, smooth_noise, top_share

MASKS: Final = 32
_KINDS: Final = 4


class AdversarialMask(Occlusion):
    """Cover the view with that of 32 fixed masks which hides most present cells.

    The masks (spots, bars, clouds, far corners; eight of each) depend on neither the view nor the generator. So no mask
    is fitted to the truth cell by cell, and every method meets the same masks.
    """

    def mask(self, evidence: Evidence, _rng: np.random.Generator) -> Mask:
        """Return the mask that hides most present cells; the first of them if several do."""
        present = np.add.reduce(evidence.cells == PRESENT, axis=0, dtype=np.float32)
        covered = np.einsum("mp,p->m", _halved(evidence.shape, self.share), _half(present).ravel())
        return np.asarray(library(evidence.shape, self.share)[int(np.argmax(covered))])


@lru_cache(maxsize=4)
def library(shape: tuple[int, int], share: float) -> Mask:
    """Return the masks that each cover a share of a view, shape (32, rows, cols)."""
    masks = np.stack([top_share(_score(shape, index), share) for index in range(MASKS)])
    masks.flags.writeable = False
    return masks


@lru_cache(maxsize=4)
def _halved(shape: tuple[int, int], share: float) -> Field:
    return np.stack([_half(mask.astype(np.float32)).ravel() for mask in library(shape, share)])


def _half(values: Field) -> Field:
    rows, cols = (max(1, count // 2) for count in values.shape)
    return np.asarray(cv2.resize(values, (cols, rows), interpolation=cv2.INTER_AREA), dtype=np.float32)


def _score(shape: tuple[int, int], index: int) -> NDArray[np.float32]:
    """Return how early a mask covers each cell, shape (rows, cols); lengths are in halves of the view's side."""
    rng = np.random.default_rng((20251, index))
    at = centres(shape, 2 / max(shape))
    kind = index % _KINDS
    along, across = at.along_and_across(float(rng.uniform(0, 360)))
    if kind == 0:
        spots = rng.uniform(-0.8, 0.8, size=(int(rng.integers(1, 5)), 2))
        score = np.max([-np.hypot(at.right_m - x, at.up_m - y) for x, y in spots], axis=0)
    elif kind == 1:
        offsets = rng.uniform(-0.7, 0.7, size=int(rng.integers(1, 4)))
        score = np.max([-np.abs(across - offset) for offset in offsets], axis=0)
    elif kind == 2:  # noqa: PLR2004 - the third kind
        score = smooth_noise(shape, max(shape) / float(rng.uniform(3, 6)), rng).astype(np.float64)
    else:
        score = along + rng.uniform(0, 0.8) * np.abs(across)
    return np.asarray(score, dtype=np.float32)
