# SPDX-License-Identifier: Apache-2.0
"""Silence is never a fix, and Eq. (14) accepts where accepting costs less."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sasgeo_bench.core.errors import MetricError
from sasgeo_bench.scoring.decisions import (
    COST_RATIOS,
    Fixes,
    accept,
    accept_by_cost,
    cost_values,
    decision_cost,
    presence_weights,
)

# A row says its confidence or None, whether it is answered, whether right if present, and whether present.
ROW = st.tuples(st.one_of(st.none(), st.integers(0, 4).map(lambda n: n / 4)), *(st.booleans(),) * 3)
ROWS = st.lists(ROW, min_size=1, max_size=12)


def answers_of(rows) -> Fixes:
    table = [(math.nan if row[0] is None else row[0], *row[1:]) for row in rows]
    confidence, answered, right, present = np.array(table, dtype=float).reshape(-1, 4).T
    return Fixes(confidence=confidence, is_answered=answered, is_right=right * answered * present, is_present=present)


@given(rows=ROWS, threshold=st.sampled_from([-math.inf, 0.0, 0.4, 0.5, math.inf]))
def test_a_query_without_an_answer_is_never_accepted(rows, threshold) -> None:
    answers = answers_of(rows)
    accepted = accept(answers, threshold)
    assert not accepted[~answers.is_answered].any()
    assert set(cost_values(answers, accepted, 20.0)) <= {0.0, 1.0, 20.0}


_JUNK = (0.0, True, False, True)


def test_the_cost_of_every_kind_of_query() -> None:
    rows = [
        (0.9, True, True, True),  # right, accepted
        (0.9, True, False, True),  # wrong, accepted
        (0.9, True, False, False),  # absent, accepted
        (0.1, True, True, True),  # right, withheld
        (0.1, True, False, True),  # wrong, withheld
        (0.1, True, False, False),  # absent, withheld
        (None, False, False, True),  # no answer where one was to be had
        (None, False, False, False),  # no answer where there was none
    ]
    answers = answers_of(rows)
    # Ratio 20: two false fixes at 20, a right one withheld at 1; by place rows 4 and 6, present and not fixed, too.
    assert cost_values(answers, accept(answers, 0.5), 20.0).tolist() == [0.0, 20.0, 20.0, 1.0, 0.0, 0.0, 0.0, 0.0]
    assert cost_values(answers, accept(answers, 0.5), 20.0, charged="place").sum() == 43.0


def test_an_answer_without_a_confidence_comes_after_all_that_have_one() -> None:
    answers = answers_of([(None, True, True, True), (0.0, True, True, True), (None, False, False, True)])
    assert answers.tie.tolist() == [1, 0, 2]
    assert accept(answers, 0.0).tolist() == [False, True, False]
    assert accept(answers, -math.inf).tolist() == [True, True, False]
    assert accept(answers, math.inf).tolist() == [False, False, False]


def test_if_no_answer_has_a_confidence_all_are_tied() -> None:
    assert answers_of([(None, True, True, True)] * 3).tie.tolist() == [0, 0, 0]


@pytest.mark.parametrize(("ratio", "bound"), [(5.0, 0.167), (20.0, 0.048), (100.0, 0.0099)])
def test_fixes_are_accepted_below_the_risk_of_equation_14(ratio, bound) -> None:
    risk = 1.0 / (1.0 + ratio)
    assert risk == pytest.approx(bound, abs=5e-4)
    answers = answers_of([(1.0 - 0.99 * risk, True, True, True), (1.0 - 1.01 * risk, True, True, True)])
    assert accept_by_cost(answers, ratio).tolist() == [True, False]


def test_equal_costs_withhold() -> None:
    # P(F) = 1/4 = C_MR / (C_FF + C_MR) at ratio 3: Eq. (14) is strict.
    assert accept_by_cost(answers_of([(0.75, True, True, True)]), 3.0).tolist() == [False]


@given(rows=ROWS, ratio=st.sampled_from(COST_RATIOS))
def test_with_true_probabilities_no_threshold_costs_less(rows, ratio) -> None:
    # Each answer stands for a right and a false one, weighted by its confidence: the expected cost of every rule.
    confidence = np.array([row[0] if row[0] is not None else 0.5 for row in rows])
    both = np.tile(confidence, 2)
    right = np.repeat([1, 0], len(rows))
    ones = np.ones(2 * len(rows))
    answers = Fixes(confidence=both, is_answered=ones, is_right=right, is_present=ones)
    weights = np.where(right == 1, both, 1 - both)
    least = decision_cost(answers, ratio, weights)
    for threshold in (-math.inf, *both, math.inf):
        values = cost_values(answers, accept(answers, threshold), ratio)
        assert least <= values @ weights / weights.sum() + 1e-12


def test_the_cost_of_withholding_everything_is_the_share_that_could_be_had() -> None:
    answers = answers_of([(0.0, True, True, True), (0.0, True, False, True), (0.0, True, False, False)])
    assert decision_cost(answers, 5.0) == pytest.approx(1 / 3)
    assert decision_cost(answers, 5.0, charged="place") == pytest.approx(2 / 3)
    silent = answers_of([(None, False, False, True)] * 2)
    assert decision_cost(silent, 5.0) == 0.0
    assert decision_cost(silent, 5.0, charged="place") == 1.0


def test_an_answer_withheld_costs_as_much_as_junk_that_nobody_trusts() -> None:
    withheld, junk = (answers_of([(0.9, True, True, True), last]) for last in ((None, False, False, True), _JUNK))
    for charged in ("right fix", "place"):
        costs = [decision_cost(some, 20.0, charged=charged) for some in (withheld, junk)]
        assert costs[0] == costs[1]


@given(rows=ROWS, share=st.sampled_from([0.9, 0.7, 0.5]))
def test_places_are_present_as_often_as_is_asked_for(rows, share) -> None:
    present = np.array([row[3] for row in rows])
    if present.all() or not present.any():
        with pytest.raises(MetricError, match="no query has its place"):
            presence_weights(present, share)
        return
    weights = presence_weights(present, share)
    assert weights.sum() == pytest.approx(len(rows))
    assert weights[present].sum() / weights.sum() == pytest.approx(share)
    assert np.ptp(weights[present]) < 1e-12


def test_reweighting_needs_no_side_that_does_not_count() -> None:
    assert presence_weights([True, True], 1.0).tolist() == [1.0, 1.0]
    assert presence_weights([False], 0.0).tolist() == [1.0]
    assert presence_weights([], 0.5).tolist() == []
    with pytest.raises(MetricError, match=r"\[0, 1\]"):
        presence_weights([True], 1.5)


def test_nothing_to_decide_has_no_shares() -> None:
    nothing = answers_of([])
    assert len(nothing) == 0
    assert math.isnan(decision_cost(nothing, 5.0))


def test_what_cannot_be_is_refused() -> None:
    one = np.ones(1)
    with pytest.raises(MetricError, match="is right only where"):
        Fixes(confidence=one, is_answered=one, is_right=one, is_present=0 * one)
    with pytest.raises(MetricError, match="is right only where"):
        Fixes(confidence=one, is_answered=0 * one, is_right=one, is_present=one)
    with pytest.raises(MetricError, match="finite"):
        Fixes(confidence=one * math.inf, is_answered=one, is_right=one, is_present=one)
    with pytest.raises(MetricError, match="shape"):
        Fixes(confidence=np.ones(2), is_answered=one, is_right=one, is_present=one)
    with pytest.raises(MetricError, match="probabilities"):
        accept_by_cost(Fixes(confidence=2 * one, is_answered=one, is_right=one, is_present=one), 5.0)
    silent = answers_of([(None, False, False, True)])
    with pytest.raises(MetricError, match="without an answer is accepted"):
        cost_values(silent, [True], 20.0)
    with pytest.raises(MetricError, match="cost_ratio"):
        decision_cost(silent, 0.0)
