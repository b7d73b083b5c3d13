# SPDX-License-Identifier: Apache-2.0
"""Masks out of a fixed library, the one that hurts most in each view: the worst that an honest occlusion can do."""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache
from typing import ClassVar, Final

import cv2
import numpy as np
from numpy.typing import NDArray

from sasgeo_bench.geometry.angles import rotation
from sasgeo_bench.regions.evidence import PRESENT, Evidence
from sasgeo_bench.tasks.perturbations.base import check_ranges, hide
from sasgeo_bench.tasks.perturbations.fields import Field, centres, smooth_noise, top_share

Mask = NDArray[np.bool_]

MASKS: Final = 32
_KINDS: Final = 4


@dataclass(frozen=True, kw_only=True)
class AdversarialMask:
    """Hide what is present, as far as one of 32 fixed masks covers it.

    The masks (spots, bars, clouds, far corners; eight of each) do not depend on the view or the generator, only which
    one is taken does; so nothing is fitted to the truth cell by cell, and every method meets the same masks.

    Parameters
    ----------
    share : float
        Share of the view's cells that the mask covers, 0 to 1.

    Examples
    --------
    >>> cells = np.zeros((1, 64, 64), dtype=np.uint8)
    >>> cells[0, :20, :20] = 1
    >>> view = Evidence(classes=("building",), cells=cells, cell_size_m=1.0)
    >>> seen = AdversarialMask(share=0.3)(view, np.random.default_rng(0))
    >>> bool((seen.cells[cells == 1] == 2).mean() > 0.6)
    True
    """

    NEUTRAL: ClassVar[Mapping[str, float]] = {"share": 0.0}
    MOVES: ClassVar[bool] = False

    share: float

    def __post_init__(self) -> None:
        """Refuse a share that is none."""
        check_ranges(self, share=(0, 1))

    def __call__(self, evidence: Evidence, _rng: np.random.Generator, /) -> Evidence:
        """Cover the view with the mask that hides most present cells; the first of them where several do."""
        if self.share == 0:
            return evidence
        present = np.add.reduce(evidence.cells == PRESENT, axis=0, dtype=np.float32)
        covered = np.einsum("mp,p->m", _halved(evidence.shape, self.share), _half(present).ravel())
        return hide(evidence, library(evidence.shape, self.share)[int(np.argmax(covered))])


@lru_cache(maxsize=4)
def library(shape: tuple[int, int], share: float) -> Mask:
    """Masks for views of a shape that each cover a share of it, boolean of shape (32, rows, cols).

    Examples
    --------
    >>> library((64, 64), 0.25).mean(axis=(1, 2)).round(2).tolist() == [0.25] * 32
    True
    """
    masks = np.stack([top_share(_score(shape, index), share) for index in range(MASKS)])
    masks.flags.writeable = False
    return masks


@lru_cache(maxsize=4)
def _halved(shape: tuple[int, int], share: float) -> Field:
    """The library at half its resolution, to weigh the masks with, shape (32, cells)."""
    return np.stack([_half(mask.astype(np.float32)).ravel() for mask in library(shape, share)])


def _half(values: Field) -> Field:
    """Means over two by two cells."""
    rows, cols = (max(1, count // 2) for count in values.shape)
    return np.asarray(cv2.resize(values, (cols, rows), interpolation=cv2.INTER_AREA), dtype=np.float32)


def _score(shape: tuple[int, int], index: int) -> NDArray[np.float32]:
    """What a mask covers first, shape (rows, cols); lengths are in halves of the view's side."""
    rng = np.random.default_rng((20251, index))
    at = centres(shape, 2 / max(shape))
    kind = index % _KINDS
    right, up = rotation(float(rng.uniform(0, 360)))[:, 1]
    along, across = at.right_m * right + at.up_m * up, at.right_m * up - at.up_m * right
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
