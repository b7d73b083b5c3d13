# SPDX-License-Identifier: Apache-2.0
"""Patches of views and maps: descriptors, their 4-D correlation, consensus of neighbours, and the matches left."""

from dataclasses import dataclass
from itertools import product
from typing import Final, Self

import cv2
import numpy as np
from numpy.typing import NDArray

import sasgeo_bench as sgb

SIDE: Final = 8  # cells a side of a patch
FAR_M: Final = 32.0  # distances are cut there: what is further away does not describe a patch
_LEAST_KNOWN: Final = 0.5  # of the cells of a patch; else the class is not compared there
_LEAST_SPREAD: Final = 0.05  # of a number over patches: a class of one small patch must not outweigh all others

Floats = NDArray[np.float32]
Scores = NDArray[np.float32]  # of shape (rows, cols, rows of the map, cols of the map)


@dataclass(frozen=True, kw_only=True)
class Patches:
    """Patches of a raster: `values` and `known`, shape (rows, cols, D), and `places_m`, (rows, cols, 2).

    The D numbers are the share of each class, then its nearness: 1 less the mean distance in units of `FAR_M`. `known`
    is 1 or 0. Places are (right, up) from the middle of the raster.
    """

    values: Floats
    known: Floats
    places_m: NDArray[np.float64]

    @classmethod
    def of(cls, cells: NDArray[np.uint8], cell_size_m: float) -> Self:
        """Describe the whole patches of three-state cells, shape (C, rows, cols).

        >>> cells = np.zeros((1, 8, 16), dtype=np.uint8)
        >>> cells[0, :, :4] = sgb.PRESENT
        >>> found = Patches.of(cells, 1.0)
        >>> found.values[0, :, 0].tolist(), found.places_m[0, :, 0].tolist()  # a half, then nothing
        ([0.5, 0.0], [-4.0, 4.0])
        """
        height, width = cells.shape[1:]
        present, known = cells == sgb.PRESENT, cells != sgb.UNKNOWN
        near = np.stack([1 - np.minimum(_away(layer) * cell_size_m / FAR_M, 1) for layer in present])
        seen = _means(known)
        shares = _means(present) / np.maximum(seen, _LEAST_KNOWN)
        is_known = (seen >= _LEAST_KNOWN).astype(np.float32)
        values = np.concatenate([shares, _means(near)]).transpose(1, 2, 0)
        down, right = (np.arange(count // SIDE) * SIDE + SIDE / 2 - count / 2 for count in (height, width))
        places = np.stack(np.meshgrid(right, -down), axis=-1) * cell_size_m
        return cls(values=values, known=np.concatenate([is_known, is_known]).transpose(1, 2, 0), places_m=places)

    @property
    def shape(self) -> tuple[int, int]:
        """Return rows and columns."""
        return (self.values.shape[0], self.values.shape[1])


def _away(present: NDArray[np.bool_]) -> Floats:
    if not present.any():
        return np.full(present.shape, np.inf, dtype=np.float32)
    away = cv2.distanceTransform((~present).astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
    return np.asarray(away, dtype=np.float32)


def _means(layers: NDArray[np.generic]) -> Floats:
    """Return means over whole patches, shape (C, rows, cols) of patches."""
    count, height, width = layers.shape
    rows, cols = height // SIDE, width // SIDE
    cut = layers[:, : rows * SIDE, : cols * SIDE].astype(np.float32)
    return np.asarray(cut.reshape(count, rows, SIDE, cols, SIDE).mean(axis=(2, 4)))


def correlation(view: Patches, town: Patches) -> Scores:
    """Return the cosine of each patch of a view with each patch of a map, 0 where it is negative or nothing is known.

    Numbers are centred and scaled by their mean and spread over the map's patches; a cosine is over what both know.
    """
    known, there = (part.known.reshape(-1, part.known.shape[-1]) for part in (view, town))
    weight = np.maximum(there.sum(axis=0), 1)
    mean = (town.values.reshape(there.shape) * there).sum(axis=0) / weight
    spread = np.sqrt((np.square(town.values.reshape(there.shape) - mean) * there).sum(axis=0) / weight)
    scale = np.maximum(spread, _LEAST_SPREAD)
    mine, theirs = (
        (part.values.reshape(mask.shape) - mean) / scale * mask for part, mask in ((view, known), (town, there))
    )
    norms = (np.square(mine) @ there.T) * (known @ np.square(theirs).T)
    cosine = np.divide(mine @ theirs.T, np.sqrt(norms), out=np.zeros_like(norms), where=norms > 0)
    return np.asarray(np.maximum(cosine, 0).reshape(*view.shape, *town.shape), dtype=np.float32)


def soft_mutual(scores: Scores) -> Scores:
    """Weigh scores by their shares in the best of their patch on either side (soft mutual nearest neighbours).

    >>> scores = np.array([[1.0, 0.5], [0.5, 0.5]], dtype=np.float32).reshape(2, 1, 2, 1)
    >>> soft_mutual(scores).reshape(2, 2).tolist()
    [[1.0, 0.25], [0.25, 0.5]]
    """
    best_mine = np.maximum(scores.max(axis=(2, 3), keepdims=True), np.finfo(np.float32).tiny)
    best_theirs = np.maximum(scores.max(axis=(0, 1), keepdims=True), np.finfo(np.float32).tiny)
    return np.asarray(scores * (scores / best_mine) * (scores / best_theirs))


def consensus(scores: Scores) -> Scores:
    """Add to each pair of patches the mean score of the eight pairs at equal offsets from both.

    >>> scores = np.zeros((1, 2, 1, 3), dtype=np.float32)
    >>> scores[0, 0, 0, 1] = scores[0, 1, 0, 2] = 8.0  # neighbours that agree
    >>> scores[0, 0, 0, 0] = 8.0
    >>> consensus(scores)[0, 0, 0].tolist()
    [8.0, 9.0, 0.0]
    """
    total = np.zeros_like(scores)
    offsets = [offset for offset in product((-1, 0, 1), repeat=2) if offset != (0, 0)]
    for offset in offsets:
        into, of = zip(*(_shifted(step) for step in (*offset, *offset)), strict=True)
        total[into] += scores[of]
    return np.asarray(scores + total / len(offsets))


def _shifted(step: int) -> tuple[slice, slice]:
    """Return the part of an axis that has a neighbour `step` further on, and the part of these neighbours."""
    return {-1: (slice(1, None), slice(None, -1)), 0: (slice(None), slice(None)), 1: (slice(None, -1), slice(1, None))}[
        step
    ]


def mutual(scores: Scores) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return the pairs of patches, flat indices, that are each other's best; of equal ones the first is best."""
    rows, cols, *_ = scores.shape
    flat = scores.reshape(rows * cols, -1)
    best = flat.argmax(axis=1)
    mine = np.arange(len(flat))
    is_mutual = (flat.argmax(axis=0)[best] == mine) & (flat[mine, best] > 0)
    return mine[is_mutual], best[is_mutual]


def matches(view: Patches, town: Patches, *, rounds: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return places of matched patches in a view and in a map, shape (M, 2) each, (right, up) of either's middle."""
    scores = soft_mutual(correlation(view, town))
    for _ in range(rounds):
        scores = consensus(scores)
    mine, theirs = mutual(scores)
    return view.places_m.reshape(-1, 2)[mine], town.places_m.reshape(-1, 2)[theirs]
