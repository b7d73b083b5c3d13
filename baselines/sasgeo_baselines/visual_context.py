# SPDX-License-Identifier: Apache-2.0
"""Visual semantic context: shares of groups of classes in rings and sectors around a view, and around places of a map.

The groups, the disc and its cells are those of `polar`.
"""

from dataclasses import dataclass
from typing import Final, Self

import cv2
import numpy as np
from numpy.typing import NDArray

import sasgeo_bench as sgb
from sasgeo_baselines.polar import CELL_M, GROUPS, RADIUS_M, SIDE, coarse_groups, sector_weights, view_planes

RINGS: Final = 12
SECTORS: Final = 36  # the first begins straight ahead, on a map in the north; clockwise
STRIDE: Final = 4  # cells between places of a map: 16 m
AREAS_M2: Final = np.pi * np.diff(np.square(np.arange(RINGS + 1) * RADIUS_M / RINGS))

_LEAST_KNOWN: Final = 0.25  # of a ring or sector; else it is not compared
_FULL: Final = 255

Floats = NDArray[np.float32]


@dataclass(frozen=True, kw_only=True)
class Shares:
    """Shares of groups of classes in parts of a view or a map, and how much of each part is known.

    `value` has shape (..., G, RINGS) or (..., G, RINGS, SECTORS); `known` too, or 1 for G where groups are known alike.
    Where too little is known both are 0.
    """

    value: Floats
    known: Floats

    @classmethod
    def of(cls, present: Floats, known: Floats) -> Self:
        """Divide what is present by what is known, where that is at least a quarter.

        >>> found = Shares.of(np.float32([0.2, 0.1]), np.float32([0.8, 0.2]))
        >>> found.value.tolist(), found.known.round(1).tolist()
        ([0.25, 0.0], [0.800000011920929, 0.0])
        """
        is_known = known >= _LEAST_KNOWN
        value = np.where(is_known, present / np.maximum(known, _LEAST_KNOWN), 0)
        return cls(value=value.astype(np.float32), known=np.where(is_known, known, 0).astype(np.float32))


@dataclass(frozen=True, kw_only=True)
class Context:
    """Rings, shape (..., G, RINGS), and sectors, shape (..., G, RINGS, SECTORS), of a view or of places of a map."""

    rings: Shares
    sectors: Shares

    @classmethod
    def of(cls, present: Floats, known: Floats) -> Self:
        """Describe squares around places by the shares of their cells, shape (..., G, SIDE^2)."""
        rings, sectors = (
            Shares.of(*(averaged(cells, sectors=count) for cells in (present, known))) for count in (1, SECTORS)
        )
        return cls(rings=Shares(value=rings.value[..., 0], known=rings.known[..., 0]), sectors=sectors)

    @classmethod
    def of_view(cls, evidence: sgb.Evidence, is_used: NDArray[np.bool_]) -> Self:
        """Describe a view by the groups that are used, shape (G,); the others count as unknown."""
        present, known = view_planes(evidence) * is_used[:, None]
        return cls.of(present, known)


def averaged(cells: Floats, *, sectors: int) -> Floats:
    """Return means of cells of squares, shape (..., SIDE^2), over rings and sectors, shape (..., RINGS, sectors).

    Ground straight ahead of a view lies in the first and the last of four sectors:

    >>> cells = np.zeros((SIDE, SIDE), dtype=np.float32)
    >>> cells[: SIDE // 2] = 1.0
    >>> averaged(cells.ravel(), sectors=4)[-1].round(3).tolist()
    [1.0, 0.0, 0.0, 1.0]
    """
    flat = cells.reshape(-1, SIDE * SIDE)
    means = (sector_weights(RINGS, sectors) @ flat.T).T
    return np.asarray(means.reshape(*cells.shape[:-1], RINGS, sectors), dtype=np.float32)


@dataclass(frozen=True, kw_only=True)
class ContextMap:
    """Rings around places of a map, and its cells, of which the sectors of any place are read.

    `cells`, uint8 of shape (G + 1, rows, cols), are shares of the groups and, last, of known ground, 0..255, with a
    margin of half a square. `rings`, of shape (P, G + 1, RINGS), are their means around `places_m`, shape (P, 2).
    `mean`, shape (G,), is the share of each group over the map, `is_used` whether the map has a class of it.
    """

    corner_m: tuple[float, float]
    cells: NDArray[np.uint8]
    places_m: NDArray[np.float64]
    rings: NDArray[np.uint8]
    mean: Floats
    is_used: NDArray[np.bool_]

    @classmethod
    def of(cls, region: sgb.Region) -> Self:
        """Describe a map at places 16 m apart, corners of cells, from its north-western corner."""
        west_m, _, _, north_m = region.grid.bounds_m
        half = SIDE // 2
        groups = coarse_groups(region, above=half, beside=half)
        inner = (slice(half, groups.shape[1] - half), slice(half, groups.shape[2] - half))
        known = np.zeros_like(groups[0])
        rows, cols = known[inner].shape
        known[inner] = cv2.resize(
            region.known().astype(np.uint8) * np.uint8(_FULL), (cols, rows), interpolation=cv2.INTER_AREA
        )
        cells = np.concatenate([groups, known[None]])
        rings = np.stack([_rings_of(layer) for layer in cells], axis=-2)
        down, right = (np.arange(count) * STRIDE * CELL_M for count in rings.shape[:2])
        east_m, north_m_ = np.meshgrid(west_m + right, north_m - down)
        total = cells[:-1][(slice(None), *inner)].mean(axis=(1, 2), dtype=np.float64)
        return cls(
            corner_m=(west_m, north_m),
            cells=cells,
            places_m=np.stack([east_m.ravel(), north_m_.ravel()], axis=1),
            rings=rings.reshape(-1, *rings.shape[2:]),
            mean=(total / max(1.0, float(known[inner].mean()))).astype(np.float32),
            is_used=np.array([any(name in region.classes for name in names) for names in GROUPS]),
        )

    def rings_at(self, rows: NDArray[np.int64]) -> Shares:
        """Return rings of places by number, shape (N, G, RINGS)."""
        found = self.rings[rows].astype(np.float32) / np.float32(_FULL)
        return Shares.of(found[:, :-1], found[:, -1:])

    def at(self, places_m: NDArray[np.float64]) -> Context:
        """Describe the corners of cells next to places; beyond the map nothing is known."""
        offset = (places_m - self.corner_m) * (1 / CELL_M, -1 / CELL_M)
        windows = np.lib.stride_tricks.sliding_window_view(self.cells, (SIDE, SIDE), axis=(1, 2))
        most = np.array(windows.shape[2:0:-1]) - 1
        right, down = np.clip(np.rint(offset).astype(np.int64), 0, most).T
        found = windows[:, down, right].reshape(len(self.cells), len(places_m), SIDE * SIDE).transpose(1, 0, 2)
        squares = found.astype(np.float32) / np.float32(_FULL)
        return Context.of(squares[:, :-1], squares[:, -1:])


def _rings_of(layer: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Return means over rings around every STRIDE-th corner of the cells within a margin, (rows, cols, RINGS)."""
    half = SIDE // 2
    inside = (slice(half, layer.shape[0] - half + 1, STRIDE), slice(half, layer.shape[1] - half + 1, STRIDE))
    found = np.zeros((*layer[inside].shape, RINGS), dtype=np.uint8)
    if layer.any():
        values = layer.astype(np.float32)
        for ring, weights in enumerate(sector_weights(RINGS, 1).toarray().reshape(RINGS, SIDE, SIDE)):
            means = cv2.filter2D(values, -1, weights, anchor=(half, half), borderType=cv2.BORDER_CONSTANT)
            found[..., ring] = np.clip(np.rint(means[inside]), 0, _FULL)
    return found
