# SPDX-License-Identifier: Apache-2.0
"""Weights of classes as a map ages, and maps of these weights: Eqs. 5-7 of the SASGeo paper.

Gains are nats a cell. Weights include the scale of the evidence and are nats for 100 m2 that are mapped and seen; by
hand that is sigma of Eq. 5, since the scale is one cell in a hundred.
"""

import difflib
import math
from collections.abc import Mapping, Sequence
from typing import Final

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from sasgeo_bench.errors import ConfigError
from sasgeo_bench.osm.taxonomy import load_taxonomy
from sasgeo_bench.regions.evidence import PRESENT
from sasgeo_bench.regions.region import Region
from sasgeo_bench.sasgeo.ablations import Switches
from sasgeo_bench.sasgeo.distinct import Rarity
from sasgeo_bench.sasgeo.learnt import ScorerModel
from sasgeo_bench.sasgeo.seasons import SEASONS
from sasgeo_bench.sasgeo.weights import information

AGES_YEARS: Final = (0.0, 2.0, 5.0, 10.0, 20.0)
AREA_M2: Final = 100.0
HAND: Final = Switches(weights="hand")
FITTED: Final = Switches(weights="fitted")
GAINS: Final = ("agree", "extra", "missed", "quiet")


def check_age(age_years: float) -> float:
    """Return the age of a map, or raise ConfigError if it is negative or not finite."""
    if not (math.isfinite(age_years) and age_years >= 0):
        message = f"the age of a map is at least 0 years and finite, got {age_years!r}"
        raise ConfigError(message)
    return age_years


def check_season(season: str) -> str:
    """Return the name of a season, "" for none, or raise ConfigError.

    Examples
    --------
    >>> check_season("snw")
    Traceback (most recent call last):
        ...
    sasgeo_bench.errors.ConfigError: there is no season 'snw', did you mean 'snow'? (leaf_on, snow, low_water, harvest)
    """
    if season and season not in SEASONS:
        near = difflib.get_close_matches(season, SEASONS, n=1)
        hint = f", did you mean {near[0]!r}?" if near else ""
        message = f"there is no season {season!r}{hint} ({', '.join(SEASONS)})"
        raise ConfigError(message)
    return season


def check_classes(model: ScorerModel, classes: Sequence[str] = ()) -> ScorerModel:
    """Return a model in the order of the classes of a map, or in its own order without a map.

    Raises
    ------
    ConfigError
        If the taxonomy lacks a class of the model, or the model a class of the map.

    Examples
    --------
    >>> check_classes(ScorerModel.by_hand(["water", "railway"]), ["railway"]).classes
    ('railway',)
    """
    strange = [name for name in (*model.classes, *classes) if name not in load_taxonomy().names]
    if strange:
        message = f"this version has no class {strange[0]!r}: use one taxonomy for map, learning and program"
        raise ConfigError(message)
    lacking = [name for name in classes if name not in model.classes]
    if lacking:
        message = f"the model lacks the map's class {lacking[0]!r}: train it on maps that have it"
        raise ConfigError(message)
    return model.of_classes(classes) if classes else model


def worth_of(model: ScorerModel, arm: Switches, *, age_years: float, season: str = "") -> NDArray[np.float64]:
    """Return the weight of each class in nats for 100 m2 that are mapped and seen, shape (C,).

    Examples
    --------
    By hand it is sigma of Eq. 5, here a prior of 0.97 at the half-life of 231 years:

    >>> worth_of(ScorerModel.by_hand(["railway"]), HAND, age_years=231.0).round(3).tolist()
    [0.485]
    """
    agree = arm.gains(model, age_years=age_years, season=season).agree
    return np.asarray(AREA_M2 * model.scaling * agree)


def worth_table(
    model: ScorerModel, arm: Switches, *, ages_years: Sequence[float] = AGES_YEARS, season: str = ""
) -> pd.DataFrame:
    """Return weights, gains and information of each class as the map ages, a row for each class and age.

    Parameters
    ----------
    model : ScorerModel
        Rates of the classes.
    arm : Switches
        Weights by hand or fitted.
    ages_years : sequence of float
        Of the map.
    season : str
        Season of the view, "" if unknown.

    Returns
    -------
    pandas.DataFrame
        class, age_years; worth (see `worth_of`); agree, extra, missed, quiet (see `weights.Gains`), nats a cell;
        information (see `weights.information`), nats a cell.

    Examples
    --------
    >>> table = worth_table(ScorerModel.by_hand(["railway"]), HAND, ages_years=[0.0])
    >>> table.loc[0, ["worth", "agree", "missed"]].tolist()
    [0.97, 0.97, -0.97]
    """
    persists = model.persists(season)
    parts = []
    for age in ages_years:
        gains = arm.gains(model, age_years=age, season=season)
        nats = [
            information(rates, age_years=age, persists=float(factor))
            for rates, factor in zip(model.rates, persists, strict=True)
        ]
        about = {"class": model.classes, "age_years": float(age), "order": range(len(model.classes))}
        worth = worth_of(model, arm, age_years=age, season=season)
        parts.append(
            pd.DataFrame(
                about | {"worth": worth} | {name: getattr(gains, name) for name in GAINS} | {"information": nats}
            )
        )
    rows = pd.concat(parts).sort_values(["order", "age_years"], kind="stable", ignore_index=True)
    return rows.drop(columns="order")


def rarity_map(region: Region) -> NDArray[np.float32]:
    """Return the rarity of the surroundings of each cell, nu of Eq. 6 over its mean on the map, shape (rows, cols)."""
    cell_m = region.grid.cell_size_m
    rarity = Rarity.of(region.layers, region.classes, cell_size_m=cell_m)
    return rarity.weights(region.layers, region.classes, cell_size_m=cell_m)


def weight_map(
    layers: NDArray[np.uint8], worth: NDArray[np.float64], rarity: NDArray[np.float32]
) -> NDArray[np.float32]:
    """Return the weight of every cell of a map: w = sigma nu, summed over its classes as in Eq. 8.

    Parameters
    ----------
    layers : ndarray of uint8, shape (C, rows, cols)
        PRESENT, ABSENT, or more where nothing is known.
    worth : ndarray of float, shape (C,)
        From `worth_of`.
    rarity : ndarray of float, shape (rows, cols)
        From `rarity_map`.

    Returns
    -------
    ndarray of float32, shape (rows, cols)
        Nats for 100 m2; 0 where nothing is mapped, NaN where nothing is known.

    Examples
    --------
    >>> row = np.array([[[1, 0, 255]]], dtype=np.uint8)
    >>> weight_map(row, np.array([0.5]), np.full((1, 3), 3.0, dtype=np.float32)).tolist()
    [[1.5, 0.0, nan]]
    """
    total = np.zeros(layers.shape[1:], dtype=np.float32)
    for layer, value in zip(layers, worth, strict=True):
        total[layer == PRESENT] += np.float32(value)
    total *= rarity
    total[(layers > PRESENT).any(axis=0)] = np.nan
    return total


def side_by_side(tables: Mapping[str, pd.DataFrame], column: str) -> pd.DataFrame:
    """Join one column of several tables: a row for each class, a column for each table and age.

    Examples
    --------
    >>> table = worth_table(ScorerModel.by_hand(["railway"]), HAND, ages_years=[0.0])
    >>> side_by_side({"hand": table}, "worth").columns.tolist()
    [('hand', 0.0)]
    """
    wide = {
        name: table.pivot_table(index="class", columns="age_years", values=column, sort=False)
        for name, table in tables.items()
    }
    return pd.concat(wide, axis=1)
