# SPDX-License-Identifier: Apache-2.0
"""One dated state of a place, as suites see it: layers in bits, features and graph on one lattice."""

import datetime as dt
import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Final

import cv2
import numpy as np
import shapely
from numpy.typing import NDArray

from sasgeo_bench.geometry.grid import Grid
from sasgeo_bench.geometry.pose import Pose
from sasgeo_bench.osm.taxonomy import load_taxonomy
from sasgeo_bench.regions import region_files
from sasgeo_bench.regions.evidence import PRESENT, Evidence, LayerBits, observe
from sasgeo_bench.regions.layers import read_bits
from sasgeo_bench.regions.region import Lazy, MapGraph, Region

if TYPE_CHECKING:
    import geopandas as gpd

DRAWN_CLASSES: Final = load_taxonomy().having("drawn")
BLOCK_M: Final = 8.0


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Blocks:
    """A map in square blocks of about `BLOCK_M`: fractions of the mapped cells and of those of each class, 0..1.

    Both have the shape of `grid`.
    """

    grid: Grid
    known: NDArray[np.float32]
    shares: dict[str, NDArray[np.float32]]


@dataclass(frozen=True, kw_only=True)
class State:
    """One dated state of a place: its layers in bits, its features and its graph, on one lattice.

    Features and graph of a stored region are read when they are first asked for.
    """

    region: str
    date: dt.date
    grid: Grid
    classes: tuple[str, ...]
    bits: LayerBits
    features: Lazy["gpd.GeoDataFrame"] = Lazy()  # noqa: RUF009 - no default: a field that may be a function
    graph: Lazy[MapGraph] = Lazy()  # noqa: RUF009
    coverage: shapely.Geometry
    _drawn_shares: dict[tuple[Pose, int, float], float] = field(
        default_factory=dict, init=False, repr=False, compare=False
    )

    @classmethod
    def of(cls, region: Region, name: str | None = None, *, bits: LayerBits | None = None) -> "State":
        """Return the state of a region; `name` is its folder if that differs from its id.

        `bits` are those of its layers, where they have been read: the layers then need not be.
        """
        return cls(
            region=name or region.manifest.id,
            date=region.manifest.extract.date,
            grid=region.grid,
            classes=region.classes,
            bits=LayerBits.of(region.layers) if bits is None else bits,
            features=lambda: region.features,
            graph=lambda: region.graph,
            coverage=region.coverage,
        )

    @classmethod
    def read(cls, folder: Path) -> "State":
        """Return the state of a stored region, named by its folder."""
        region = region_files.read_region(folder, with_layers=False)
        return cls.of(region, name=folder.name, bits=read_bits(folder / region_files.LAYERS))

    def view(self, pose: Pose, *, size_cells: int, cell_size_m: float) -> Evidence:
        """Return what a perfect detector would see from a pose."""
        cells = observe(self.bits, self.grid, pose, size_cells=size_cells, cell_size_m=cell_size_m)
        return Evidence(classes=self.classes, cells=cells, cell_size_m=cell_size_m)

    def drawn_share(self, pose: Pose, *, size_cells: int, cell_size_m: float) -> float:
        """Return the fraction of a view's cells with one of `DRAWN_CLASSES`, or water; each view is counted once."""
        key = (pose, size_cells, cell_size_m)
        if key not in self._drawn_shares:
            view = self.view(pose, size_cells=size_cells, cell_size_m=cell_size_m)
            layers = [view.classes.index(name) for name in (*DRAWN_CLASSES, "water") if name in view.classes]
            self._drawn_shares[key] = share_of((view.cells[layers] == PRESENT).any(axis=0))
        return self._drawn_shares[key]

    @cached_property
    def known(self) -> NDArray[np.bool_]:
        """Return the mapped cells, shape (rows, cols)."""
        return np.asarray(self.bits.bits >> np.uint32(31) == 0)

    def knows(self, pose: Pose) -> bool:
        """Return whether the cell at a place is on the map."""
        row, col = self.grid.to_cells(np.array([(pose.easting_m, pose.northing_m)]))[0].tolist()
        is_within = 0 <= row < self.grid.rows and 0 <= col < self.grid.cols
        return is_within and not bool(self.bits.bits[row, col] >> np.uint32(31))

    def is_mapped(self, en_m: NDArray[np.float64], half_m: float) -> bool:
        """Return whether a square around a place is wholly mapped."""
        row, col = self.grid.to_cells(np.asarray(en_m)[None, :])[0].tolist()
        half = math.ceil(half_m / self.grid.cell_size_m)
        inside = half <= row < self.grid.rows - half and half <= col < self.grid.cols - half
        return inside and bool(self.known[row - half : row + half + 1, col - half : col + half + 1].all())

    def of_classes(self, classes: Sequence[str]) -> "State":
        """Return the state with some of its classes alone, in their order: a view of it shows nothing of the others.

        Raise `ValueError` if it lacks one.
        """
        if tuple(classes) == self.classes:
            return self
        bits = np.where(self.known, np.uint32(0), self.bits.bits & np.uint32(1 << 31))
        for at, name in enumerate(classes):
            bits |= (self.bits.bits >> np.uint32(self.classes.index(name)) & np.uint32(1)) << np.uint32(at)
        bits[~self.known] = np.uint32(1 << 31)
        return replace(self, classes=tuple(classes), bits=LayerBits(bits=bits, count=len(classes)))

    def has(self, class_name: str) -> NDArray[np.bool_]:
        """Return where one class is present, shape (rows, cols)."""
        bit, unknown = 1 << self.classes.index(class_name), 1 << 31
        return np.asarray(self.bits.bits & np.uint32(bit | unknown) == np.uint32(bit))

    @cached_property
    def shares(self) -> NDArray[np.float64]:
        """Return the share of each class on the mapped ground, shape (C,)."""
        return np.array([self.has(name).sum() for name in self.classes]) / max(1, int(self.known.sum()))

    @cached_property
    def blocks(self) -> Blocks:
        """Return the map in blocks."""
        factor = max(1, round(BLOCK_M / self.grid.cell_size_m))
        there, grid = int(np.bitwise_or.reduce(self.bits.bits, axis=None)), self.grid.coarsen(factor)
        nothing = np.zeros(grid.shape, dtype=np.float32)
        return Blocks(
            grid=grid,
            known=_mean_blocks(self.known, factor),
            shares={
                name: _mean_blocks(self.has(name), factor) if there >> at & 1 else nothing
                for at, name in enumerate(self.classes)
            },
        )

    @cached_property
    def drawn(self) -> NDArray[np.bool_]:
        """Return where any of `DRAWN_CLASSES` is present."""
        mask = np.uint32(sum(1 << self.classes.index(name) for name in DRAWN_CLASSES if name in self.classes))
        return np.asarray((self.bits.bits & mask).astype(bool) & self.known)


def share_of(mask: NDArray[np.bool_]) -> float:
    """Return the mean of a mask: to count it takes a quarter of the time."""
    return np.count_nonzero(mask) / mask.size


def _mean_blocks(mask: NDArray[np.bool_], factor: int) -> NDArray[np.float32]:
    """Return the fraction of a mask in square blocks; the last blocks are padded with False."""
    rows, cols = -(-mask.shape[0] // factor), -(-mask.shape[1] // factor)
    padded = np.zeros((rows * factor, cols * factor), dtype=np.uint8)
    np.multiply(mask, np.uint8(255), out=padded[: mask.shape[0], : mask.shape[1]])
    found = cv2.resize(padded, (cols, rows), interpolation=cv2.INTER_AREA)
    return np.asarray(found, dtype=np.float32) / np.float32(255)
