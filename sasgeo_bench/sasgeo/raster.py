# SPDX-License-Identifier: Apache-2.0
"""Raster score of the SASGeo paper, Eqs. 7 and 8: map and view prepared for the search, class by class."""

import hashlib
import json
import math
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Final, Self

import cv2
import numpy as np
import shapely
from numpy.typing import NDArray

from sasgeo_bench.core.errors import StoreError
from sasgeo_bench.geometry.grid import Grid
from sasgeo_bench.geometry.pose import Pose
from sasgeo_bench.osm.taxonomy import load_taxonomy
from sasgeo_bench.regions.evidence import ABSENT, PRESENT, UNKNOWN, Evidence
from sasgeo_bench.regions.region import Region
from sasgeo_bench.regions.region_files import FEATURES, LAYERS, read_manifest, read_region
from sasgeo_bench.sasgeo.rates import FAR, RINGS_M, ring_of
from sasgeo_bench.sasgeo.weights import STRATA, Gains, strata, weigh
from sasgeo_bench.search.field import FULL, Cells, Field, Template, between, squares
from sasgeo_bench.search.stored import FACTORS, StoredField, store_levels
from sasgeo_bench.tasks.vectors import as_features

if TYPE_CHECKING:
    import geopandas as gpd

BRIDGE: Final = "bridge"
LEVEL_M: Final = 24.0  # standard deviation of the ground that a class is compared with; from train places
REPEATED: Final = 3e3  # nats2 m2 of a class that say half of what as many independent cells would; from train places
_LEAST: Final = 1e-6
_FIELD_VERSION: Final = 2  # raised whenever the same map and settings give other levels
CELL_M: Final = 2.0  # cells of a search: finer ones cost more and find no more


REACH_M: Final = 4.0  # the paper's tau, by hand: OSM lines lie a few metres off


# 4 m: the paper's tau, by hand: OSM lines lie a few metres off
def likeness_by_hand(classes: Sequence[str], *, reach_m: float = REACH_M) -> NDArray[np.float64]:
    """Return the likeness of cells near a class to cells on it, shape (C, FAR + 1): exp(-D^2 / 2 tau^2) for lines.

    Examples
    --------
    >>> likeness_by_hand(["railway", "water"]).round(2).tolist()
    [[1.0, 0.88, 0.32, 0.04, 0.0], [1.0, 0.0, 0.0, 0.0, 0.0]]
    """
    edges_m = np.array([0.0, *RINGS_M])
    middles_m = (edges_m[:-1] + edges_m[1:]) / 2
    fade = np.exp(-(middles_m**2) / (2 * reach_m**2))
    table = np.zeros((len(classes), FAR + 1))
    table[:, 0] = 1.0
    table[[name in load_taxonomy().lines for name in classes], 1:FAR] = fade
    return table


def read_field(
    region: Region,
    likeness: NDArray[np.float64],
    *,
    trust: NDArray[np.float64] | None = None,
    cell_size_m: float = CELL_M,
) -> Field:
    """Return a map for the search: the degree to which each cell is on a class or near it.

    `likeness`, shape (C, FAR + 1), is that of `rates.likeness` or `likeness_by_hand`; `trust`, shape (C, STRATA), that
    of `weights.fit_trust`, 1 without it. Cells have a whole number of map cells a side, of about `cell_size_m`.
    """
    by_stratum = None if trust is None else trust.tolist()
    kept = region.kept("field", likeness=likeness.tolist(), trust=by_stratum, cell_size_m=cell_size_m)
    with suppress(StoreError):  # removed meanwhile: it is made
        if kept is not None:
            return StoredField.open(kept).field()
    factor = max(1, round(cell_size_m / region.grid.cell_size_m))
    grid = region.grid.coarsen(factor)
    around = ((0, -region.grid.rows % factor), (0, -region.grid.cols % factor))
    known = _share(region.known(), around, grid) > FULL // 2
    stamped = None if trust is None else strata(region)
    cells = Cells.zeros(len(region.classes) + 1, grid.shape)
    cells.band(len(region.classes))[known] = FULL
    for at, name in enumerate(region.classes):
        if trust is None or stamped is None:
            shares, weights = [_share(region.layer(name) == PRESENT, around, grid)], np.ones(1)
        else:
            shares, weights = [_share(stamped[at] == index, around, grid) for index in range(STRATA)], trust[at]
        degree = _degree(shares, weights, likeness[at], grid)
        degree[~known] = 0
        cells.band(at)[:] = degree
    return Field(grid=grid, cells=cells)


def store_field(
    region: Path,
    into: Path,
    likeness: NDArray[np.float64],
    *,
    trust: NDArray[np.float64] | None = None,
    cell_size_m: float = CELL_M,
    factors: tuple[int, ...] = FACTORS,
) -> StoredField:
    """Store what `read_field` makes of a region, in levels on disk: window by window, so that it may be a country.

    `region` is the folder of the region, `into` that of the levels; levels that are there of the same map, settings and
    format are opened. `factors` are as of `store_levels`, the other arguments those of `read_field`. Raise `StoreError`
    if the region is damaged or the folder cannot be written.
    """
    manifest = read_manifest(region)
    factor = max(1, round(cell_size_m / manifest.cell_size_m))
    grid = manifest.grid.coarsen(factor)
    reach_m = math.ceil(RINGS_M[-1] / grid.cell_size_m + 1) * grid.cell_size_m
    settings = [likeness.tolist(), None if trust is None else trust.tolist(), factor, _FIELD_VERSION]
    of_map = {name: record.sha256 for name, record in manifest.files.items() if name in (LAYERS, FEATURES)}
    key = hashlib.sha256(json.dumps([of_map, settings], sort_keys=True).encode()).hexdigest()

    def paint(window: Grid) -> Field | None:
        """Read the map under a window and as far around as it matters, and cut what was made of it."""
        west_m, south_m, east_m, north_m = window.bounds_m
        around_m = (west_m - reach_m, south_m - reach_m, east_m + reach_m, north_m + reach_m)
        part = read_region(region, bounds_m=around_m, with_layers=False)
        if not part.coverage.area:
            return None
        field = read_field(part, likeness, trust=trust, cell_size_m=cell_size_m)
        row, col = (
            round(shift_m / grid.cell_size_m)
            for shift_m in (field.grid.north_m - window.north_m, window.west_m - field.grid.west_m)
        )
        return Field(grid=window, cells=field.cells.cut(row, col, window.shape))

    return store_levels(into, grid, len(manifest.classes), paint, key=key, factors=factors)


def _degree(
    shares: Sequence[NDArray[np.uint8]], weights: NDArray[np.float64], likeness: NDArray[np.float64], grid: Grid
) -> NDArray[np.uint8]:
    """Return the degree to which each cell is on a class or near it, 0..FULL, from shares covered by its parts."""
    on, near = (np.zeros(grid.shape, dtype=np.float32) for _ in range(2))  # in place: a copy of a country takes 0.1 GB
    rest = np.full(grid.shape, FULL, dtype=np.float32)
    nearby = np.concatenate((likeness[1:2], likeness[1:])).astype(np.float32)  # ring 0: partly covered cells
    for share, factor in zip(shares, weights.astype(np.float32), strict=True):
        if share.any():
            on += factor * np.float32(likeness[0]) * share
            rest -= share
            np.maximum(near, (factor * nearby)[ring_of(share > 0, cell_size_m=grid.cell_size_m)], out=near)
    near *= rest
    near += on
    return np.asarray(np.clip(np.rint(near, out=near), 0, FULL, out=near), dtype=np.uint8)


def _share(
    is_there: NDArray[np.bool_], around: tuple[tuple[int, int], tuple[int, int]], grid: Grid
) -> NDArray[np.uint8]:
    """Return the marked share of each cell, 0..FULL."""
    marked = np.pad(is_there.view(np.uint8) * np.uint8(FULL), around)
    return np.asarray(cv2.resize(marked, (grid.cols, grid.rows), interpolation=cv2.INTER_AREA), dtype=np.uint8)


DOUBT_M: Final = 8.0  # around a seen line: a mapped line there may be the same


def with_unknown_margins(evidence: Evidence) -> Evidence:
    """Return a view with absent cells near a seen line as unknown: a line mapped there may be the same.

    This complements the distance transform of the map in `likeness_by_hand`.
    """
    cells = evidence.cells.copy()
    for name, layer in zip(evidence.classes, cells, strict=True):
        if name in load_taxonomy().lines and (layer == PRESENT).any():
            off = cv2.distanceTransform((layer != PRESENT).astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
            layer[(layer == ABSENT) & (off * evidence.cell_size_m <= DOUBT_M)] = UNKNOWN
    return evidence.replace(cells, evidence.confidence)


def burnt(vectors: "gpd.GeoDataFrame", evidence: Evidence) -> Evidence | None:
    """Burn perceived vectors on the cells of a view, in the classes that both have; None where they share none.

    Lines have the width of their class (`line_width_m`), areas are areas, and a cell holds what covers its centre, as
    on a map: a river is no line where the view shows water. Cells that are unknown in the view stay unknown, but for
    bridges: where a line runs, it says whether it is on one.

    Examples
    --------
    >>> import shapely
    >>> from sasgeo_bench.tasks.vectors import vector_table
    >>> house = vector_table([("building", 0, False, shapely.box(-2, -1, 0, 1))])
    >>> cells = np.array([[[0, 0, 0, 2]] * 2], dtype=np.uint8)
    >>> burnt(house, Evidence(classes=("building",), cells=cells, cell_size_m=1.0)).cells.tolist()
    [[[1, 1, 0, 2], [1, 1, 0, 2]]]
    """
    import pandas as pd  # noqa: PLC0415 - views without vectors need no tables, and no GDAL

    from sasgeo_bench.regions.layers import burn_layers, make_paint  # noqa: PLC0415

    features = as_features(vectors)
    is_line = features["width_m"].notna().to_numpy()
    seen = {*vectors["class"], *((BRIDGE,) if is_line.any() else ())}
    names = tuple(name for name in evidence.classes if name in seen)
    if not names:
        return None
    (rows, cols), (width_m, height_m) = evidence.shape, evidence.size_m
    cell_m = evidence.cell_size_m
    grid = Grid(epsg=0, west_m=-width_m / 2, north_m=height_m / 2, cell_size_m=cell_m, rows=rows, cols=cols)
    features.loc[is_line, "width_m"] = [line_width_m(name) for name in features.loc[is_line, "class"]]
    on_bridges = features[is_line & features["is_bridge"].to_numpy(bool)].assign(**{"class": BRIDGE})
    paint = make_paint(pd.concat([features, on_bridges], ignore_index=True), names, shapely.box(*grid.bounds_m))
    cells = burn_layers(paint, grid)
    for name, cover in load_taxonomy().covers.items():
        if name in names and cover in evidence.classes:
            cells[names.index(name), evidence.layer(cover) == PRESENT] = ABSENT
    unknown = np.stack([evidence.layer(name) == UNKNOWN for name in names])
    if BRIDGE in names:
        lines = [at for at, name in enumerate(names) if name in load_taxonomy().lines and name != BRIDGE]
        unknown[names.index(BRIDGE)] = ~cells[lines].any(axis=0)
    return Evidence(classes=names, cells=np.where(unknown, np.uint8(UNKNOWN), cells), cell_size_m=cell_m)


@cache
def line_width_m(class_name: str) -> float:
    """Return the median width of the lines of a class in the taxonomy, metres; 0 for a class without lines.

    Vectors name a class and no tag, so the widths by tag value are not at hand.

    Examples
    --------
    >>> line_width_m("road_minor"), line_width_m("railway")
    (5.0, 3.25)
    """
    known = load_taxonomy()
    if class_name not in known.names:
        return 0.0
    widths_m = [width_m for rule in known[class_name].rules for width_m in rule.widths.values()]
    return float(np.median(widths_m)) if widths_m else 0.0


def _around(layers: NDArray[np.float32], is_known: NDArray[np.float32], *, sigma: float) -> NDArray[np.float32]:
    """Return the mean of known cells around each cell, shape (C, rows, cols), weighed by a Gaussian of some cells."""
    rows, cols = layers.shape[1:]
    # 8: coarse cells in it
    step = max(1, round(sigma / 8))  # a mean over tens of cells needs no fine ones
    coarse = max(1, cols // step), max(1, rows // step)

    def summed(layer: NDArray[np.float32]) -> NDArray[np.float32]:
        small = cv2.resize(layer, coarse, interpolation=cv2.INTER_AREA)
        spread = cv2.GaussianBlur(small, (0, 0), sigma / step, borderType=cv2.BORDER_CONSTANT)
        return np.asarray(cv2.resize(spread, (cols, rows), interpolation=cv2.INTER_LINEAR), dtype=np.float32)

    means = np.zeros_like(layers)
    for mean, layer, known in zip(means, layers, is_known, strict=True):
        if layer.any():
            mean[:] = summed(layer) / np.maximum(summed(known), np.float32(_LEAST))
    return means


@dataclass(frozen=True, kw_only=True)
class RasterView:
    """A view weighed by gains, in the classes of a map: factors of layers and of known cells, shape (C, rows, cols)."""

    weights: NDArray[np.float32]
    known: NDArray[np.float32]
    cell_size_m: float

    @classmethod
    def of(cls, evidence: Evidence, classes: Sequence[str], gains: Gains) -> Self:
        """Weigh the classes that a view shares with a map."""
        shape = (len(classes), *evidence.shape)
        weights, known = np.zeros(shape, dtype=np.float32), np.zeros(shape, dtype=np.float32)
        levels = evidence.levels()
        for at, name in enumerate(classes):
            if name in evidence.classes:
                found, known[at] = weigh(levels[[evidence.classes.index(name)]], gains.only(at))
                weights[at] = found[0]
        return cls(weights=weights, known=known, cell_size_m=evidence.cell_size_m)

    def template(self) -> Template:
        """Return the template of all classes, for the search."""
        return Template(weights=self.weights, known=self.known.sum(axis=0), cell_size_m=self.cell_size_m)

    def by_class(self, field: Field, poses: Sequence[Pose]) -> NDArray[np.float64]:
        """Return the score of each class at each pose, shape (M, C); a row sums to `search.find.score_at`."""
        pool = max(1, round(field.grid.cell_size_m / self.cell_size_m))
        active = np.flatnonzero(self.weights.any(axis=(1, 2)) | self.known.any(axis=(1, 2)))
        bands = np.concatenate((self.weights[active], self.known[active]))
        summed, frame = squares(bands, pool, cell_size_m=self.cell_size_m)
        weights, known = summed[: len(active)], summed[len(active) :]
        total = np.zeros((len(poses), len(self.weights)))
        for row, pose in zip(total, poses, strict=True):
            under = field.cells.under(between(frame, pose, field.grid), frame.shape)
            row[active] = np.einsum("cij,ij->c", known, under.band(len(self.weights)).astype(np.float32))
            for at, layer in zip(active.tolist(), weights, strict=True):
                row[at] += np.vdot(layer, under.band(at).astype(np.float32))
        return total / FULL

    def levelled(self) -> Self:
        """Return the view less the mean of each class around each cell, over known cells.

        What is left says where a class lies, not how much of it there is: errors of a class hang together over tens of
        metres, on the map as in the view, and would count once for each cell. Unknown cells still say nothing.
        """
        is_known = ((self.weights != 0) | (self.known != 0)).astype(np.float32)
        sigma = LEVEL_M / self.cell_size_m
        weights, known = (
            layers - is_known * _around(layers, is_known, sigma=sigma) for layers in (self.weights, self.known)
        )
        return replace(self, weights=weights, known=known)

    def damped(self) -> Self:
        """Return the view with each class divided by 1 + E / `REPEATED`, E the sum of its squared weights.

        An error may be common to all of a class in a view. If its share of the evidence is the same for all classes,
        the variance of a score is E + E^2 / `REPEATED`, its mean at the right place E, and the best weight their ratio
        (Fisher's discriminant). So a class says no more than `REPEATED` allows, however much of it there is.
        """
        energy = np.square(self.weights, dtype=np.float64).sum(axis=(1, 2)) / self.cell_size_m**2
        return self.scaled(1 / (1 + energy / REPEATED))

    def scaled(self, scaling: NDArray[np.float64]) -> Self:
        """Return the view with the score of each class scaled."""
        scale = scaling.astype(np.float32)[:, None, None]
        return replace(self, weights=self.weights * scale, known=self.known * scale)

    def halved_with(self, other: Self, classes: Sequence[bool]) -> Self:
        """Return the mean of two views in some classes, shape (C,), and their sum in the rest.

        Where both show a class, each counts half: together they weigh as much as one.
        """
        share = np.where(classes, 0.5, 1.0).astype(np.float32)[:, None, None]
        return replace(self, weights=share * (self.weights + other.weights), known=share * (self.known + other.known))

    def times(self, weight: NDArray[np.float32] | np.float32) -> Self:
        """Return the view with cells times a weight, or times weights of shape (rows, cols): w of Eq. 8."""
        return replace(self, weights=self.weights * weight, known=self.known * weight)
