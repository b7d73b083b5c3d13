# SPDX-License-Identifier: Apache-2.0
"""Fitted rates are those that the views were made with."""

import numpy as np
import pytest
from scipy.ndimage import distance_transform_edt

from sasgeo_bench.core.errors import ConfigError
from sasgeo_bench.regions.evidence import PRESENT
from sasgeo_bench.sasgeo.rates import (
    FAR,
    NOWHERE,
    RINGS_M,
    ClassRates,
    Tally,
    fit_rates,
    hand_rates,
    likeness,
    ring_of,
    rings,
    tally,
)

TRUE = ClassRates(hit=0.88, false_alarm=0.015, missing=0.04, vanish_per_year=0.02, appear_per_year=0.006, mapped=0.12)


def as_tally(seen, missed, *, age_years=0.0, block="a"):
    return Tally(classes=("building",), age_years=age_years, block=block, seen=seen, missed=missed)


def made_up(rates, *, ages_years=(0.0, 2.0, 5.0, 10.0), blocks=24, cells=36_000, seed=10):
    """Views whose cells come in clumps of 100 that stand, vanish or appear together."""
    rng = np.random.default_rng(seed)
    made = []
    for block in range(blocks):
        for age in ages_years:
            mapped = rng.binomial(cells // 100, rates.mapped) * 100
            standing = rng.binomial(mapped // 100, rates.survival(age)) * 100
            came = rng.binomial((cells - mapped) // 100, rates.unmapped(age) if age else 0.0) * 100

            def seen(there, gone):
                return rng.binomial(there, rates.hit) + rng.binomial(gone, rates.false_alarm)

            on, off = seen(standing, mapped - standing), seen(came, cells - mapped - came)
            both = (np.array([[near, 0, 0, 0, far]]) for near, far in ((on, off), (mapped - on, cells - mapped - off)))
            made.append(as_tally(*both, age_years=age, block=str(block)))
    return made


def test_fitted_rates_are_the_true_ones_on_average():
    worlds = [fit_rates(made_up(TRUE, blocks=16, seed=seed))["building"] for seed in range(10)]
    for name in ("hit", "false_alarm", "missing", "vanish_per_year", "appear_per_year"):
        assert np.mean([getattr(one, name) for one in worlds]) == pytest.approx(getattr(TRUE, name), rel=0.1), name


def test_where_nothing_was_seen_the_hand_decides_as_of_ageing_on_a_map_of_one_age():
    nothing = np.zeros((1, FAR + 1), dtype=np.int64)
    fitted = fit_rates([as_tally(nothing, nothing, age_years=5.0)])["building"]
    assert fitted.vanish_per_year == pytest.approx(hand_rates("building").vanish_per_year, rel=1e-3)
    assert likeness([as_tally(nothing, nothing)])[0].tolist() == [1.0, 0.0, 0.0, 0.0, 0.0]
    fitted = fit_rates(made_up(TRUE, ages_years=(0.0,)))["building"]
    assert fitted.hit == pytest.approx(TRUE.hit, abs=0.01)
    assert fitted.false_alarm == pytest.approx(TRUE.false_alarm, rel=0.1)
    assert fitted.vanish_per_year == pytest.approx(hand_rates("building").vanish_per_year, rel=1e-2)


def test_rings_are_metres_from_the_nearest_cell_of_a_class():
    layers = np.zeros((2, 40, 40), dtype=np.uint8)
    layers[0, 20, 20] = PRESENT
    layers[:, :, 35:] = 255
    found = rings(layers, cell_size_m=2.0)
    assert found[0, 20, 20:29].tolist() == [0, 1, 1, 2, 2, 3, 3, FAR, FAR]
    assert found[0, 24, 23] == 3  # 10 m away
    assert (found[:, :, 35:] == NOWHERE).all()
    assert (found[1, :, :35] == FAR).all()


def test_a_map_that_lies_beside_the_world_makes_being_near_alike():
    layers = np.zeros((1, 400, 400), dtype=np.uint8)
    for row in range(20, 380, 40):
        layers[0, row : row + 4] = PRESENT
    under = rings(layers, cell_size_m=1.0)
    straight, shifted = (
        likeness([tally(("building",), np.roll(layers, by, axis=1), under, age_years=0.0, block="a")]) for by in (0, 3)
    )
    assert straight[0, 1] < 0.2
    assert shifted[0, 1] > 0.8


def test_an_empty_train_part_and_classes_that_differ_are_refused():
    one = np.ones((1, 2, 2), dtype=np.uint8)
    tallies = [tally((name,), one, 0 * one, age_years=0.0, block="a") for name in ("building", "railway")]
    for given, words in (([], "train part is empty"), (tallies, "different classes")):
        with pytest.raises(ConfigError, match=words):
            fit_rates(given)


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"hit": 1.2}, "hit is a share"),
        ({"vanish_per_year": -0.1}, "at least 0 a year"),
        ({"appear_per_year": float("nan")}, "at least 0 a year"),
        ({"hit": 0.01, "false_alarm": 0.5}, "rarer than a false alarm"),
    ],
)
def test_what_is_no_rate_is_refused(wrong, message):
    values = {name: getattr(TRUE, name) for name in TRUE.__slots__}
    with pytest.raises(ConfigError, match=message):
        ClassRates(**{**values, **wrong})


@pytest.mark.parametrize("cell_size_m", [0.5, 1.0, 2.0, 3.0, 20.0])  # wide kernels and distances, small ones
def test_rings_are_those_of_exact_distances(cell_size_m):
    is_there = np.random.default_rng(5).random((90, 140)) < 0.004
    distance_m = distance_transform_edt(~is_there) * cell_size_m
    expected = np.digitize(distance_m, [0.0, *RINGS_M], right=True)
    assert np.array_equal(ring_of(is_there, cell_size_m=cell_size_m), expected)
    assert len(np.unique(expected)) > 1
