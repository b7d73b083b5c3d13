# SPDX-License-Identifier: Apache-2.0
"""P(false fix | evidence): calibrated where the truth is known, modest where little was seen, and never upset."""

import math
import tomllib
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sasgeo_bench.matching.matcher import Prediction, check_p_false, remark_of
from sasgeo_bench.matching.plugins import load_rejector
from sasgeo_bench.sasgeo.integrity import EVIDENCE_NAMES
from sasgeo_bench.sasgeo.rejectors import FEW, Counted, SasgeoBoosted, SasgeoLogistic, features, lead, upper_rate
from sasgeo_bench.scoring.decisions import Fixes, aurc, calibration_error
from tests.sasgeo.simulated import simulate

PROJECT = tomllib.loads((Path(__file__).parents[2] / "pyproject.toml").read_text(encoding="utf-8"))
REGISTERED = PROJECT["project"]["entry-points"]["sasgeo_bench.rejectors"]
RULES = (SasgeoLogistic, SasgeoBoosted)
WITHHELD = Prediction(query_id="withheld", confidence=0.0)


@pytest.fixture(scope="module")
def calibration():
    return simulate(400, seed=1)


@pytest.fixture(scope="module")
def asked():
    return simulate(2000, seed=2)


@pytest.fixture(scope="module", params=RULES)
def fitted(request, calibration):
    rejector = request.param()
    rejector.fit(calibration.answers, calibration.is_false)
    return rejector


def answers_of(p_false, is_false):
    everywhere = np.ones(len(p_false))
    return Fixes(confidence=1 - p_false, is_answered=everywhere, is_right=~is_false, is_present=everywhere)


@pytest.mark.parametrize("name", REGISTERED)
def test_a_rejector_is_registered_under_the_name_of_its_card(name):
    card = load_rejector(REGISTERED[name]).card
    assert card.name == name
    assert card.is_calibrated
    assert card.limits
    assert set(REGISTERED) == {rule.card.name for rule in RULES}


def test_it_is_calibrated_where_the_chance_is_known_and_better_than_the_margin(fitted, asked):
    found = fitted.p_false(asked.answers)
    some = answers_of(found, asked.is_false)
    assert fitted.remark == ""
    assert calibration_error(some) < 0.05
    assert np.abs(found - asked.chance).mean() < 0.12
    by_margin = answers_of(1 / (2 + np.array([lead(item) for item in asked.answers])), asked.is_false)
    assert aurc(some) < aurc(by_margin) - 0.005


def test_an_answer_is_judged_alone_and_a_second_fit_says_the_same(fitted, calibration, asked):
    again = type(fitted)()
    again.fit(asked.answers[:100], asked.is_false[:100])
    again.fit(calibration.answers, calibration.is_false)
    whole = fitted.p_false(asked.answers[:40])
    assert again.p_false(asked.answers[:40]).tolist() == whole.tolist()
    np.testing.assert_allclose([fitted.p_false([item])[0] for item in asked.answers[:40]], whole, atol=1e-9)


def test_withheld_answers_and_views_wholly_unknown_are_false_whatever_was_learnt(fitted, calibration):
    blind = replace(calibration.answers[0], diagnostics=calibration.answers[0].diagnostics | {"unknown_share": 1.0})
    assert fitted.p_false([WITHHELD, blind, replace(WITHHELD, status="timeout")]).tolist() == [1.0] * 3
    few = type(fitted)()
    few.fit([blind, WITHHELD], np.array([False, False]))
    assert few.p_false([blind, WITHHELD]).tolist() == [1.0, 1.0]
    assert fitted.p_false([]).shape == (0,)


def test_no_probability_is_nearer_to_certainty_than_the_answers_carry(fitted, calibration, asked):
    found = fitted.p_false(asked.answers)
    assert found.min() >= 1 / (len(calibration.answers) + 2)
    assert found.max() <= 1 - 1 / (len(calibration.answers) + 2)


def test_what_is_missing_or_no_number_is_taken_for_the_median(fitted, asked):
    whole = asked.answers[1]
    bare = replace(whole, confidence=None, diagnostics={})
    broken = replace(whole, confidence=math.nan, diagnostics=dict.fromkeys(EVIDENCE_NAMES, math.nan))
    endless = replace(broken, diagnostics=dict.fromkeys(EVIDENCE_NAMES, math.inf))
    found = fitted.p_false([bare, broken, endless])
    assert found[0] == found[1] == found[2]
    assert 0 < found[0] < 1


def test_features_are_lead_confidence_and_evidence_and_gaps_are_gaps():
    (answer,) = simulate(1).answers
    rows = features([answer, replace(answer, confidence=None, diagnostics={"null_z": 2.0})])
    assert rows.shape == (2, 2 + len(EVIDENCE_NAMES))
    lines = [name in answer.diagnostics for name in EVIDENCE_NAMES]
    assert np.isfinite(rows[0]).tolist() == [True, True, *lines]
    assert np.flatnonzero(np.isfinite(rows[1])).tolist() == [0, 2 + EVIDENCE_NAMES.index("null_z")]


def test_a_gap_that_means_something_is_learnt_from(calibration):
    # The graph is told of right answers alone: its absence says more than any value of it.
    made = [
        replace(item, diagnostics={"null_z": 1.0} | ({} if wrong else {"graph_consistency": 0.5}))
        for item, wrong in zip(calibration.answers, calibration.is_false, strict=True)
    ]
    rejector = SasgeoLogistic()
    rejector.fit(made, calibration.is_false)
    found = rejector.p_false(made)
    assert found[calibration.is_false].min() > found[~calibration.is_false].max()


# Too little to learn from


@pytest.mark.parametrize("rule", RULES)
def test_without_a_false_fix_or_with_nothing_else_no_more_is_claimed_than_the_counts_carry(rule, calibration):
    rejector = rule()
    rejector.fit(calibration.answers[:300], np.zeros(300, dtype=bool))
    found = rejector.p_false(calibration.answers)
    assert found.min() == pytest.approx(upper_rate(0, 300))  # about 3 / 300
    leads = np.array([lead(item) for item in calibration.answers])
    assert (np.diff(found[np.argsort(-leads)]) >= 0).all()
    result = remark_of(rejector)
    assert result.startswith("0 of 300 calibration answers are false")
    assert "ranked by margin" in result
    rejector.fit(calibration.answers[:50], np.ones(50, dtype=bool))
    assert rejector.p_false(calibration.answers).min() == pytest.approx(51 / 52)
    assert remark_of(rejector).startswith("50 of 50 calibration answers are false")


@pytest.mark.parametrize("rule", RULES)
def test_a_remark_goes_with_the_next_fit_and_nothing_at_all_says_one(rule, calibration):
    rejector = rule()
    rejector.fit([], np.zeros(0, dtype=bool))
    assert rejector.p_false(calibration.answers[:3]).tolist() == [1.0] * 3
    assert rejector.remark
    rejector.fit(calibration.answers, calibration.is_false)
    assert rejector.remark == ""
    with pytest.raises(RuntimeError, match="call fit"):
        rule().p_false([WITHHELD])


@given(
    margins=st.lists(st.integers(0, 9), min_size=1, max_size=12),
    false=st.integers(0, 12),
    asked=st.lists(st.floats(-2, 12), min_size=2, max_size=6),
)
def test_counted_chances_keep_the_order_of_margins_and_are_chances(margins, false, asked):
    rule = Counted(margins=np.sort(np.array(margins, dtype=float)), false=min(false, len(margins)))
    found = rule.chance(np.sort(asked))
    assert (np.diff(found) <= 1e-12).all()
    assert ((found >= 0) & (found <= 1)).all()
    clean = Counted(margins=np.sort(np.array(margins, dtype=float)), false=0)
    assert clean.chance(np.array([99.0]))[0] == pytest.approx(upper_rate(0, len(margins)))


@pytest.mark.parametrize("rule", RULES)
@settings(max_examples=8)
@given(data=st.data())
def test_whatever_is_told_makes_a_probability(rule, data):
    count = 2 * FEW
    numbers = st.floats(width=64)
    diagnostics = st.dictionaries(st.sampled_from(EVIDENCE_NAMES), numbers, max_size=4)
    made = [
        replace(item, confidence=data.draw(st.none() | numbers), diagnostics=data.draw(diagnostics))
        for item in simulate(count).answers
    ]
    rejector = rule()
    rejector.fit(made, np.arange(count) % 2 == 0)
    check_p_false(rejector.p_false([*made, WITHHELD]), count + 1)
