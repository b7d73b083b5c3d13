# SPDX-License-Identifier: Apache-2.0
"""Factors of a season come back from views made with them; by hand where nothing was seen."""

import numpy as np
import pytest

from sasgeo_bench.osm.taxonomy import load_taxonomy
from sasgeo_bench.sasgeo.rates import FAR, ClassRates, Tally
from sasgeo_bench.sasgeo.weights import SEASON_SHARES, by_hand, fit_season

RATES = ClassRates(hit=0.9, false_alarm=0.01, missing=0.01, vanish_per_year=0.03, appear_per_year=0.01, mapped=0.1)


def winters(factor, *, views, cells=40_000, age_years=5.0, seed=3):
    """Views that see what is mapped as often as rates and factor say."""
    rng = np.random.default_rng(seed)
    standing = RATES.survival(age_years)
    chance = factor * (standing * RATES.hit + (1 - standing) * RATES.false_alarm)
    made = []
    for _ in range(views):
        counts = np.zeros((2, 1, FAR + 1), dtype=np.int64)
        counts[0, 0, 0] = rng.binomial(cells, chance)
        counts[1, 0, 0] = cells - counts[0, 0, 0]
        made.append(Tally(classes=("path_track",), age_years=age_years, block="a", seen=counts[0], missed=counts[1]))
    return made


@pytest.mark.parametrize("factor", [0.1, 0.5, 1.0])
def test_the_true_factor_comes_back(factor):
    assert fit_season("snow", winters(factor, views=60), [RATES])[0] == pytest.approx(factor, abs=0.03)


def test_where_little_was_seen_the_hand_decides_and_a_season_that_nobody_tells_changes_nothing():
    (few,) = fit_season("snow", winters(1.0, views=1, cells=20), [RATES])
    assert few == pytest.approx(SEASON_SHARES["snow"]["path_track"], abs=0.03)
    classes = load_taxonomy().names
    assert (by_hand("", classes) == 1.0).all()
    assert (by_hand("monsoon", classes) == 1.0).all()
