# SPDX-License-Identifier: Apache-2.0
"""Rarity of local configurations, Eq. 6 of the SASGeo paper: from their frequency on a map."""

import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final, Self

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.cluster import vq

from sasgeo_bench.regions.evidence import PRESENT

CELL_M: Final = 4.0  # of a configuration: each sector of a ring holds some cells
RINGS_M: Final = (16.0, 48.0)  # a junction; a junction and the next houses
SECTORS: Final = 8
# Classes of a configuration; interchangeable classes form one group.
GROUPS: Final = (
    ("road_major", "road_minor"),
    ("path_track",),
    ("railway",),
    ("building",),
    ("water", "waterway", "coastline"),
    ("green",),
    ("farmland", "field_boundary"),
    ("bridge",),
)
WORDS: Final = 64  # kinds of configurations
EPSILON: Final = 1e-3  # of Eq. 6
LEAST: Final = 0.25  # of a weight, in means of the map
MOST: Final = 4.0
_SAMPLES: Final = 6000
_ROUNDS: Final = 12
_NOTHING: Final = 1e-6


@dataclass(frozen=True, kw_only=True)
class Rarity:
    """Kinds of local configurations of a map and their rarity.

    A configuration is the share of each group of classes in the sectors of two rings around a cell, as magnitudes of
    its Fourier series around the circle, which are invariant to rotation. Kinds are the clusters of k-means.

    Parameters
    ----------
    middle, spread : ndarray of float, shape (D,)
        Mean and standard deviation of configurations.
    words : ndarray of float, shape (W, D)
        Centre of each kind.
    weight : ndarray of float, shape (W,)
        -log(share of the kind + epsilon), Eq. 6, over its mean on the map.
    """

    middle: NDArray[np.float32]
    spread: NDArray[np.float32]
    words: NDArray[np.float32]
    weight: NDArray[np.float32]

    @classmethod
    def of(cls, layers: NDArray[np.uint8], classes: Sequence[str], *, cell_size_m: float) -> Self:
        """Find the kinds of configurations of a map around cells with any class.

        Parameters
        ----------
        layers : ndarray of uint8, shape (C, rows, cols)
            PRESENT, ABSENT, or more where nothing is known.
        classes : sequence of str
            Its bands.
        cell_size_m : float
            Side of a cell, metres.

        Examples
        --------
        A lone crossing on a map of parallel streets is rarer than a street:

        >>> streets = np.zeros((1, 400, 400), dtype=np.uint8)
        >>> streets[0, ::80] = 1
        >>> streets[0, :, 200] = 1
        >>> rarity = Rarity.of(streets, ["road_minor"], cell_size_m=1.0)
        >>> nu = rarity.weights(streets, ["road_minor"], cell_size_m=1.0)
        >>> bool(nu[160, 200] > nu[160, 40])
        True
        """
        found, drawn = _configurations(layers, classes, cell_size_m=cell_size_m)
        rows = found[drawn]
        if len(rows) == 0:
            width = found.shape[-1]
            flat = np.zeros(width, dtype=np.float32)
            return cls(middle=flat, spread=flat + 1, words=flat[None], weight=np.ones(1, dtype=np.float32))
        middle, spread = rows.mean(axis=0), np.maximum(rows.std(axis=0), _NOTHING)
        standard = (rows - middle) / spread
        step = max(1, len(standard) // _SAMPLES)
        few = standard[::step].astype(np.float64)
        starts = np.unique(few, axis=0)
        rng = np.random.default_rng(0)
        starts = starts[np.sort(rng.permutation(len(starts))[:WORDS])]
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # an empty cluster keeps its centre
            words = vq.kmeans2(few, starts, iter=_ROUNDS, minit="matrix")[0].astype(np.float32)
        word = _nearest(standard, words)
        share = np.bincount(word, minlength=len(words)) / len(word)
        weight = -np.log(share + EPSILON)
        mean = float(weight[word].mean())
        relative = np.clip(weight / mean, LEAST, MOST) if mean > _NOTHING else np.ones(len(words))
        return cls(middle=middle, spread=spread, words=words, weight=relative.astype(np.float32))

    def weights(self, layers: NDArray[np.uint8], classes: Sequence[str], *, cell_size_m: float) -> NDArray[np.float32]:
        """Return the rarity around each cell of a map or a view, shape (rows, cols); the mean of the map is 1.

        Cells without any class have rarity 1.
        """
        found, drawn = _configurations(layers, classes, cell_size_m=cell_size_m)
        nu = np.ones(drawn.shape, dtype=np.float32)
        if drawn.any():
            nu[drawn] = self.weight[_nearest((found[drawn] - self.middle) / self.spread, self.words)]
        size = (layers.shape[2], layers.shape[1])
        return np.asarray(cv2.resize(nu, size, interpolation=cv2.INTER_NEAREST), dtype=np.float32)


def _nearest(rows: NDArray[np.float32], words: NDArray[np.float32]) -> NDArray[np.int64]:
    """Return the index of the nearest word of each row."""
    far = (words**2).sum(axis=1) - 2 * rows @ words.T
    return np.asarray(far.argmin(axis=1))


def _configurations(
    layers: NDArray[np.uint8], classes: Sequence[str], *, cell_size_m: float
) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
    """Return configurations around cells of `CELL_M`, shape (rows, cols, D), and which cells hold any class."""
    factor = max(1, round(CELL_M / cell_size_m))
    size = (-(-layers.shape[2] // factor), -(-layers.shape[1] // factor))
    kernels = _sectors(cell_size_m * factor)
    parts, drawn = [], np.zeros(size[::-1], dtype=bool)
    for group in GROUPS:
        mine = [layer for name, layer in zip(classes, layers, strict=True) if name in group]
        present = np.any([layer == PRESENT for layer in mine], axis=0) if mine else np.zeros(layers.shape[1:], bool)
        share = cv2.resize(present.astype(np.float32), size, interpolation=cv2.INTER_AREA)
        drawn |= share > 0
        for ring in kernels:
            around = np.stack([cv2.filter2D(share, -1, kernel, borderType=cv2.BORDER_REPLICATE) for kernel in ring])
            parts.append(np.abs(np.fft.rfft(around, axis=0)).astype(np.float32))
    return np.moveaxis(np.concatenate(parts), 0, -1), drawn


def _sectors(cell_m: float) -> list[list[NDArray[np.float32]]]:
    """Return a mean kernel for each sector of each ring."""
    reach = int(np.ceil(RINGS_M[-1] / cell_m))
    down, right = np.mgrid[-reach : reach + 1, -reach : reach + 1]
    far_m, turn = np.hypot(down, right) * cell_m, np.arctan2(-down, right)
    sector = np.floor((turn / (2 * np.pi) + 0.5 / SECTORS) * SECTORS).astype(int) % SECTORS
    kernels, inner_m = [], 0.0
    for outer_m in RINGS_M:
        ring = (far_m > inner_m) & (far_m <= outer_m)
        kernels.append([_mean_of(ring & (sector == at)) for at in range(SECTORS)])
        inner_m = outer_m
    return kernels


def _mean_of(mask: NDArray[np.bool_]) -> NDArray[np.float32]:
    return np.asarray(mask / max(mask.sum(), 1), dtype=np.float32)
