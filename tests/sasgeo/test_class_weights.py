# SPDX-License-Identifier: Apache-2.0
"""Weights of classes: gains and exponents, and the weight of each cell of a map."""

from dataclasses import replace

import numpy as np
import pytest

from sasgeo_bench.core.errors import ConfigError
from sasgeo_bench.osm.taxonomy import load_taxonomy
from sasgeo_bench.sasgeo.ablations import Switches
from sasgeo_bench.sasgeo.class_weights import (
    check_age,
    check_classes,
    check_season,
    class_weight_table,
    class_weights_of,
    side_by_side,
    weight_map,
)
from sasgeo_bench.sasgeo.rates import ClassRates
from sasgeo_bench.sasgeo.scorer_model import ScorerModel
from sasgeo_bench.sasgeo.weights import information

NAMES = load_taxonomy().names
HOUSE = ClassRates(hit=0.9, false_alarm=0.02, missing=0.01, vanish_per_year=0.01, appear_per_year=0.005, mapped=0.1)


def test_gains_and_information_shrink_as_the_map_ages():
    model = replace(ScorerModel.by_hand(["building"]), rates=(HOUSE,))
    table = class_weight_table(model)
    for column in ("weight", "agree", "information"):
        assert table[column].is_monotonic_decreasing
    assert table["missed"].is_monotonic_increasing


def test_a_fitted_table_holds_the_gains_of_the_arm_and_its_exponents():
    model = replace(
        ScorerModel.by_hand(NAMES), scaling=np.linspace(0.001, 0.02, len(NAMES)), missed_share=np.full(len(NAMES), 0.4)
    )
    table = class_weight_table(model, ages_years=[3.0], season="leaf_on")
    gains = Switches().gains(model, age_years=3.0, season="leaf_on")
    assert table["class"].tolist() == list(NAMES)
    assert table["missed"].to_numpy() == pytest.approx(gains.missed)
    assert table["weight"].to_numpy() == pytest.approx(100 * model.scaling * gains.agree)
    assert class_weights_of(model, age_years=3.0, season="leaf_on") == pytest.approx(table["weight"].to_numpy())
    assert 0 < information(HOUSE, age_years=1.0, persists=0.5) < information(HOUSE, age_years=1.0)  # out of season


def test_tables_stand_side_by_side_in_the_order_of_the_classes():
    tables = {name: class_weight_table(ScorerModel.by_hand(NAMES), ages_years=[0.0, 5.0]) for name in ("a", "b")}
    wide = side_by_side(tables, "weight")
    assert wide.index.tolist() == list(NAMES)
    assert wide.columns.tolist() == [("a", 0.0), ("a", 5.0), ("b", 0.0), ("b", 5.0)]


def test_a_cell_weighs_the_sum_of_its_classes_times_its_rarity():
    layers = np.array([[[1, 1, 0, 255]], [[0, 1, 0, 255]]], dtype=np.uint8)
    rarity = np.array([[2.0, 3.0, 5.0, 7.0]], dtype=np.float32)
    weights = weight_map(layers, np.array([0.5, 0.25]), rarity)
    assert weights[0, :3].tolist() == [1.0, 2.25, 0.0]
    assert np.isnan(weights[0, 3])


def test_what_is_no_age_no_season_or_no_class_is_refused():
    for age in (-1.0, float("nan"), float("inf")):
        with pytest.raises(ConfigError, match="at least 0 years"):
            check_age(age)
    with pytest.raises(ConfigError, match=r"no season 'spring' \(leaf_on"):
        check_season("spring")
    with pytest.raises(ConfigError, match="no class 'lamp'"):
        check_classes(ScorerModel.by_hand(["water"]), ["lamp"])
    with pytest.raises(ConfigError, match="the model lacks the map's class 'railway'"):
        check_classes(ScorerModel.by_hand(["water"]), ["water", "railway"])
