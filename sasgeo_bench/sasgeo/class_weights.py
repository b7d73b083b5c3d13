# SPDX-License-Identifier: Apache-2.0
"""Weights of classes as a map ages, and maps of these weights: Eqs. 5-7 of the SASGeo paper.

Gains are nats a cell. Weights include the scale of the evidence: nats for 100 m2 that are mapped and seen. By hand the
scale is one cell in a hundred.
"""

import difflib
import math
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final, Self

import cv2
import lazy_loader  # type: ignore[import-untyped, unused-ignore]
import numpy as np
import scipy  # its clusters are loaded where they are used
from numpy.typing import NDArray

from sasgeo_bench.core.errors import ConfigError
from sasgeo_bench.osm.taxonomy import load_taxonomy
from sasgeo_bench.regions.evidence import PRESENT
from sasgeo_bench.regions.region import Region
from sasgeo_bench.sasgeo.ablations import Switches
from sasgeo_bench.sasgeo.scorer_model import ScorerModel
from sasgeo_bench.sasgeo.weights import SEASONS, information

if TYPE_CHECKING:
    import pandas as pd
else:  # loaded where a table is made
    pd = lazy_loader.load("pandas")

CELL_M: Final = 4.0  # of a configuration: each sector of a ring holds some cells
RINGS_M: Final = (16.0, 48.0)  # a junction; a junction and the next houses
SECTORS: Final = 8
GROUPS: Final = tuple(load_taxonomy().groups.values())  # classes of a configuration
LEAST: Final = 0.25  # of a weight, in means of the map
MOST: Final = 4.0
_SAMPLES: Final = 6000
_ROUNDS: Final = 12
_NOTHING: Final = 1e-6


@dataclass(frozen=True, kw_only=True)
class Rarity:
    """Kinds of local configurations of a map and their rarity.

    A configuration is the share of each group of classes in the sectors of two rings around a cell, as magnitudes of
    its Fourier series around the circle, which are invariant to rotation. Kinds are the clusters of k-means; `words`,
    shape (W, D), are their centres, after scaling by `middle` and `spread`, shape (D,). `weight`, shape (W,), is
    -log(share of the kind + epsilon), Eq. 6, over its mean on the map.
    """

    middle: NDArray[np.float32]
    spread: NDArray[np.float32]
    words: NDArray[np.float32]
    weight: NDArray[np.float32]

    @classmethod
    def of(cls, layers: NDArray[np.uint8], classes: Sequence[str], *, cell_size_m: float) -> Self:
        """Find the kinds of configurations of a map, layers of shape (C, rows, cols), around cells with any class.

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
            flat = np.zeros(found.shape[-1], dtype=np.float32)
            return cls(middle=flat, spread=flat + 1, words=flat[None], weight=np.ones(1, dtype=np.float32))
        middle, spread = rows.mean(axis=0), np.maximum(rows.std(axis=0), _NOTHING)
        standard = (rows - middle) / spread
        step = max(1, len(standard) // _SAMPLES)
        few = standard[::step].astype(np.float64)
        starts = np.unique(few, axis=0)
        rng = np.random.default_rng(0)
        starts = starts[np.sort(rng.permutation(len(starts))[:64])]  # kinds of configurations
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # an empty cluster keeps its centre
            words = scipy.cluster.vq.kmeans2(few, starts, iter=_ROUNDS, minit="matrix")[0].astype(np.float32)
        word = _nearest(standard, words)
        share = np.bincount(word, minlength=len(words)) / len(word)
        weight = -np.log(share + 1e-3)  # epsilon of Eq. 6
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
        own = [layer == PRESENT for name, layer in zip(classes, layers, strict=True) if name in group]
        present = np.any(own, axis=0) if own else np.zeros(layers.shape[1:], bool)
        share = cv2.resize(present.astype(np.float32), size, interpolation=cv2.INTER_AREA)
        drawn |= share > 0
        for ring in kernels:
            around = np.stack([cv2.filter2D(share, -1, kernel, borderType=cv2.BORDER_REPLICATE) for kernel in ring])
            parts.append(np.abs(np.fft.rfft(around, axis=0)).astype(np.float32))
    return np.moveaxis(np.concatenate(parts), 0, -1), drawn


def _sectors(cell_m: float) -> list[list[NDArray[np.float32]]]:
    reach = int(np.ceil(RINGS_M[-1] / cell_m))
    down, right = np.mgrid[-reach : reach + 1, -reach : reach + 1]
    far_m, turn = np.hypot(down, right) * cell_m, np.arctan2(-down, right)
    sector = np.floor((turn / (2 * np.pi) + 0.5 / SECTORS) * SECTORS).astype(int) % SECTORS
    kernels, inner_m = [], 0.0
    for outer_m in RINGS_M:
        ring = (far_m > inner_m) & (far_m <= outer_m)
        masks = [ring & (sector == at) for at in range(SECTORS)]
        kernels.append([np.asarray(mask / max(mask.sum(), 1), dtype=np.float32) for mask in masks])
        inner_m = outer_m
    return kernels


AGES_YEARS: Final = (0.0, 2.0, 5.0, 10.0, 20.0)
AREA_M2: Final = 100.0
GAINS: Final = ("agree", "extra", "missed", "quiet")


def check_age(age_years: float) -> float:
    """Return the age of a map, or raise ConfigError if it is negative or not finite."""
    if not (math.isfinite(age_years) and age_years >= 0):
        raise ConfigError(f"the age of a map is at least 0 years and finite, got {age_years!r}")
    return age_years


def check_season(season: str) -> str:
    """Return the name of a season, "" for none, or raise ConfigError."""
    if season and season not in SEASONS:
        near = difflib.get_close_matches(season, SEASONS, n=1)
        hint = f", did you mean {near[0]!r}?" if near else ""
        raise ConfigError(f"there is no season {season!r}{hint} ({', '.join(SEASONS)})")
    return season


def check_classes(model: ScorerModel, classes: Sequence[str] = ()) -> ScorerModel:
    """Return a model in the order of the classes of a map, or in its own order without a map.

    Raises
    ------
    ConfigError
        If the taxonomy lacks a class of the model, or the model a class of the map.
    """
    strange = [name for name in (*model.classes, *classes) if name not in load_taxonomy().names]
    if strange:
        raise ConfigError(f"this version has no class {strange[0]!r}: use one taxonomy for map, learning and program")
    lacking = [name for name in classes if name not in model.classes]
    if lacking:
        raise ConfigError(f"the model lacks the map's class {lacking[0]!r}: train it on maps that have it")
    return model.of_classes(classes) if classes else model


def class_weights_of(model: ScorerModel, *, age_years: float, season: str = "") -> NDArray[np.float64]:
    """Return the weight of each class in nats for 100 m2 that are mapped and seen, shape (C,).

    Examples
    --------
    By hand, on a map of today and on one of 50 years ago:

    >>> railway = ScorerModel.by_hand(["railway"])
    >>> [class_weights_of(railway, age_years=age).round(2).item() for age in (0.0, 50.0)]
    [2.3, 1.37]
    """
    agree = Switches().gains(model, age_years=age_years, season=season).agree
    return np.asarray(AREA_M2 * model.scaling * agree)


def class_weight_table(
    model: ScorerModel, *, ages_years: Sequence[float] = AGES_YEARS, season: str = ""
) -> "pd.DataFrame":
    """Return weights, gains and information of each class as the map ages, a row for each class and age.

    Columns: class, age_years; weight (see `class_weights_of`); agree, extra, missed, quiet (see `Gains`) and
    information (see `weights.information`), nats a cell.
    """
    persists = model.persists(season)
    parts = []
    for age in ages_years:
        gains = Switches().gains(model, age_years=age, season=season)
        nats = [
            information(rates, age_years=age, persists=float(factor))
            for rates, factor in zip(model.rates, persists, strict=True)
        ]
        about = {"class": model.classes, "age_years": float(age), "order": range(len(model.classes))}
        weights = class_weights_of(model, age_years=age, season=season)
        columns = {name: getattr(gains, name) for name in GAINS}
        parts.append(pd.DataFrame(about | {"weight": weights} | columns | {"information": nats}))
    rows = pd.concat(parts).sort_values(["order", "age_years"], kind="stable", ignore_index=True)
    return rows.drop(columns="order")


def rarity_map(region: Region) -> NDArray[np.float32]:
    """Return the rarity of the surroundings of each cell, nu of Eq. 6 over its mean on the map, shape (rows, cols)."""
    cell_m = region.grid.cell_size_m
    rarity = Rarity.of(region.layers, region.classes, cell_size_m=cell_m)
    return rarity.weights(region.layers, region.classes, cell_size_m=cell_m)


def weight_map(
    layers: NDArray[np.uint8], weights: NDArray[np.float64], rarity: NDArray[np.float32]
) -> NDArray[np.float32]:
    """Return the weight of every cell of a map: w = sigma nu, summed over its classes as in Eq. 8.

    `layers` have shape (C, rows, cols), `weights` (`class_weights_of`) shape (C,), `rarity` (`rarity_map`) and the
    result (rows, cols). Nats for 100 m2; 0 where nothing is mapped, NaN where nothing is known.

    Examples
    --------
    >>> row = np.array([[[1, 0, 255]]], dtype=np.uint8)
    >>> weight_map(row, np.array([0.5]), np.full((1, 3), 3.0, dtype=np.float32)).tolist()
    [[1.5, 0.0, nan]]
    """
    total = np.zeros(layers.shape[1:], dtype=np.float32)
    for layer, value in zip(layers, weights, strict=True):
        total[layer == PRESENT] += np.float32(value)
    total *= rarity
    total[(layers > PRESENT).any(axis=0)] = np.nan
    return total


def side_by_side(tables: "Mapping[str, pd.DataFrame]", column: str) -> "pd.DataFrame":
    """Join one column of several tables: a row for each class, a column for each table and age."""
    wide = {
        name: table.pivot_table(index="class", columns="age_years", values=column, sort=False)
        for name, table in tables.items()
    }
    return pd.concat(wide, axis=1)
