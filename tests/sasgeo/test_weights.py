# SPDX-License-Identifier: Apache-2.0
"""Gains are likelihood ratios: right in sign, silent where a class tells nothing, and summed by the linear form."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sasgeo_bench.regions.evidence import Evidence
from sasgeo_bench.sasgeo.ablations import Switches
from sasgeo_bench.sasgeo.rates import ClassRates
from sasgeo_bench.sasgeo.scorer_model import ScorerModel
from sasgeo_bench.sasgeo.variants import SasgeoSeasonless
from sasgeo_bench.sasgeo.weights import information, likelihood_gains, weigh

HOUSE = ClassRates(hit=0.9, false_alarm=0.02, missing=0.01, vanish_per_year=0.01, appear_per_year=0.005, mapped=0.1)
shares = st.floats(0.001, 0.999)


@given(hit=shares, ratio=shares, missing=shares, mapped=shares, age=st.floats(0, 40))
def test_ratios_average_to_one_and_have_their_signs(hit, ratio, missing, mapped, age):
    rates = replace(HOUSE, hit=hit, false_alarm=hit * ratio, missing=missing, mapped=mapped)
    gains = likelihood_gains([rates], age_years=age)
    assert gains.agree[0] >= -1e-9
    assert gains.extra[0] <= 1e-9
    assert gains.missed[0] <= 1e-9
    assert gains.quiet[0] >= -1e-9
    if gains.agree[0] > 1e-6:  # the map's share of seen cells and the rest make up all that is seen
        assert mapped * np.exp(gains.agree[0]) + (1 - mapped) * np.exp(gains.extra[0]) == pytest.approx(1, rel=1e-6)
        assert mapped * np.exp(gains.missed[0]) + (1 - mapped) * np.exp(gains.quiet[0]) == pytest.approx(1, rel=1e-6)


def test_a_class_that_tells_nothing_is_silent():
    gone = replace(HOUSE, vanish_per_year=1.0, appear_per_year=1.0)
    useless = replace(HOUSE, hit=0.3, false_alarm=0.3)
    for rates, age in ((gone, 60.0), (useless, 0.0)):
        gains = likelihood_gains([rates], age_years=age)
        parts = (gains.agree, gains.extra, gains.missed, gains.quiet)
        assert [float(part[0]) for part in parts] == pytest.approx([0, 0, 0, 0], abs=1e-9)
        assert information(rates, age_years=age) == pytest.approx(0, abs=1e-9)


def test_a_class_out_of_season_counts_for_less():
    whole, half = (likelihood_gains([HOUSE], age_years=0.0, persists=[share]) for share in (1.0, 0.5))
    assert 0 < half.agree[0] < whole.agree[0]
    assert whole.missed[0] < half.missed[0] < 0


def test_who_knows_no_season_weighs_a_view_of_winter_as_any_other():
    model = ScorerModel.by_hand(("building", "green"))
    told, untold = (Switches(knows_season=knows) for knows in (True, False))
    snow, plain = (told.gains(model, age_years=1.0, season=season) for season in ("snow", ""))
    assert snow.agree.tolist() != plain.agree.tolist()
    assert untold.gains(model, age_years=1.0, season="snow").agree.tolist() == plain.agree.tolist()
    assert SasgeoSeasonless.switches == untold


@given(seed=st.integers(0, 9999))
def test_the_linear_form_sums_the_gains_cell_by_cell(seed):
    rng = np.random.default_rng(seed)
    seen, mapped = rng.integers(0, 3, (2, 5, 7), dtype=np.uint8), rng.integers(0, 2, (2, 5, 7), dtype=np.uint8)
    gains = likelihood_gains([HOUSE, replace(HOUSE, hit=0.6)], age_years=3.0)
    view = Evidence(classes=("building", "water"), cells=seen, cell_size_m=1.0)
    weights, known = weigh(view.levels(), gains)
    linear = float((weights * mapped).sum() + known.sum())
    table = {(1, 1): gains.agree, (1, 0): gains.extra, (0, 1): gains.missed, (0, 0): gains.quiet}
    by_hand = sum(
        float(table[int(z), int(m)][at])
        for at in range(2)
        for z, m in zip(seen[at].flat, mapped[at].flat, strict=True)
        if z < 2
    )
    assert linear == pytest.approx(by_hand, abs=1e-3)


@pytest.mark.parametrize("chance", [0.0, 0.1, 0.5, 0.9, 1.0])
def test_a_cell_with_a_probability_has_the_logarithm_of_its_expected_likelihood_ratio(chance):
    gains = likelihood_gains([HOUSE], age_years=3.0)
    view = Evidence.of_probabilities(("building",), np.array([[[chance]]]), cell_size_m=1.0)
    weights, known = weigh(view.levels(), gains)
    kept = view.probabilities()[0, 0, 0]
    agree, extra, missed, quiet = (
        float(np.exp(part[0])) for part in (gains.agree, gains.extra, gains.missed, gains.quiet)
    )
    mapped, empty = kept * agree + (1 - kept) * missed, kept * extra + (1 - kept) * quiet
    assert known[0, 0] == pytest.approx(np.log(empty), abs=1e-6)
    assert weights[0, 0, 0] + known[0, 0] == pytest.approx(np.log(mapped), abs=1e-6)


def test_certain_cells_weigh_the_same_with_confidence_and_without_to_the_last_bit():
    cells = np.random.default_rng(0).integers(0, 3, (2, 9, 9), dtype=np.uint8)
    plain = Evidence(classes=("building", "water"), cells=cells, cell_size_m=1.0)
    sure = plain.replace(plain.cells, np.where(cells < 2, np.uint8(255), np.uint8(0)))
    gains = likelihood_gains([HOUSE, replace(HOUSE, hit=0.6)], age_years=3.0)
    for one, other in zip(weigh(plain.levels(), gains), weigh(sure.levels(), gains), strict=True):
        assert (one == other).all()
    only = float(weigh(np.array([[[510]]], dtype=np.uint16), gains.only(0))[0][0, 0, 0])
    assert only == np.float32(gains.agree[0] - gains.extra[0])


def test_a_probability_that_is_the_share_of_seen_cells_says_nothing():
    gains = likelihood_gains([HOUSE], age_years=0.0)
    share = HOUSE.mapped * HOUSE.hit + (1 - HOUSE.mapped) * (0.01 * HOUSE.hit + 0.99 * HOUSE.false_alarm)
    chances = np.array([[[share, share / 3, 3 * share]]])
    weights = weigh(Evidence.of_probabilities(("building",), chances, cell_size_m=1.0).levels(), gains)[0][0, 0]
    assert abs(weights[0]) < 0.02  # a step of probability
    assert weights[1] < -0.3
    assert weights[2] > 0.3
