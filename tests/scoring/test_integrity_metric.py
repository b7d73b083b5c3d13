# SPDX-License-Identifier: Apache-2.0
"""Risk against coverage: ties averaged, silence never better, thresholds from other queries than those scored."""

import itertools
import math
from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from sklearn.metrics import roc_auc_score

from sasgeo_bench.core.errors import MetricError
from sasgeo_bench.scoring.base import check_weights, weighted_mean
from sasgeo_bench.scoring.decisions import (
    Curve,
    Fixes,
    accept,
    augrc,
    aurc,
    choose_threshold,
    drawn_areas,
    excess_aurc,
    false_fix_rate,
    presence_weights,
    risk_coverage,
)

# A row says its confidence or None, whether it is answered, and whether right.
ROW = st.tuples(st.one_of(st.none(), st.integers(0, 3).map(float)), st.booleans(), st.booleans())
ROWS = st.lists(ROW, min_size=1, max_size=10)
AREAS = (aurc, excess_aurc, augrc)


def operate(answers, threshold, weights=None):
    """Coverage and risk at a threshold, and how many answers of positive weight it accepts."""
    mass, taken = check_weights(weights, len(answers)), accept(answers, threshold)
    return SimpleNamespace(
        threshold=threshold,
        coverage=weighted_mean(taken, mass),
        risk=weighted_mean(~answers.is_right[taken], mass[taken]),
        accepted=int((taken & (mass > 0)).sum()),
    )


def coverage_at_risk(calibration, test, risk):
    return operate(test, choose_threshold(calibration, risk))


def answers_of(rows) -> Fixes:
    table = [(math.nan if row[0] is None else row[0], *row[1:]) for row in rows]
    confidence, answered, right = np.array(table, dtype=float).reshape(-1, 3).T
    return Fixes(confidence=confidence, is_answered=answered, is_right=right * answered, is_present=np.ones(len(rows)))


def simple(confidence, right) -> Fixes:
    return answers_of([(one, True, other) for one, other in zip(confidence, right, strict=True)])


def area_of_order(false) -> float:
    """Mean risk of the first 1, 2, ..., N."""
    return float(np.mean(np.cumsum(false) / np.arange(1, len(false) + 1)))


# Areas


@settings(max_examples=30)
@given(rows=st.lists(ROW, min_size=1, max_size=5))
def test_the_area_with_ties_is_the_mean_over_all_their_orders(rows) -> None:
    answers = answers_of(rows)
    orders = [
        list(order)
        for order in itertools.permutations(range(len(rows)))
        if (np.diff(answers.tie[list(order)]) >= 0).all()
    ]
    false = ~answers.is_right
    assert aurc(answers) == pytest.approx(np.mean([area_of_order(false[order]) for order in orders]))
    generalized = [np.mean(np.cumsum(false[order]) - false[order] / 2) / len(rows) for order in orders]
    assert augrc(answers) == pytest.approx(np.mean(generalized))
    best = min(area_of_order(false[list(order)]) for order in itertools.permutations(range(len(rows))))
    assert excess_aurc(answers) == pytest.approx(aurc(answers) - best, abs=1e-12)


@given(rows=ROWS, seed=st.integers(0, 2**32))
def test_areas_of_many_draws_are_those_of_each(rows, seed) -> None:
    answers = answers_of(rows)
    rng = np.random.default_rng(seed)
    weights = rng.integers(0, 3, (4, len(rows))) * rng.choice((1.0, 0.7))
    found = drawn_areas(answers, weights)
    np.testing.assert_allclose(found.aurc, [aurc(answers, row) for row in weights], atol=1e-12)
    np.testing.assert_allclose(found.augrc, [augrc(answers, row) for row in weights], atol=1e-12)


@pytest.mark.parametrize("count", [1_500, 20_000])
def test_areas_of_merged_answers_are_nearly_those_of_each(count) -> None:
    rng = np.random.default_rng(count)
    confidence = rng.random(count)
    is_present, is_answered = rng.random(count) < 0.8, rng.random(count) < 0.9
    is_right = is_present & is_answered & (rng.random(count) < confidence)
    answers = Fixes(confidence=confidence, is_answered=is_answered, is_right=is_right, is_present=is_present)
    weights = rng.integers(0, 3, (4, count)).astype(float)
    exact, curve = drawn_areas(answers, weights), Curve.of(answers, is_merged=True)
    assert curve.sides.shape[1] <= 3 * 1_537
    found = curve.areas(weights @ curve.sides)
    for name in ("aurc", "e_aurc", "augrc", "auroc"):
        np.testing.assert_allclose(getattr(found, name), getattr(exact, name), atol=3e-5 if count > 1_536 else 1e-12)
    halved = curve.areas(weights @ curve.sides, absent=0.5)
    alike = drawn_areas(answers, weights * np.where(is_present, 1.0, 0.5))
    np.testing.assert_allclose(halved.aurc, alike.aurc, atol=3e-5)
    np.testing.assert_allclose(halved.auroc, alike.auroc, atol=3e-5)


def test_areas_worked_by_hand() -> None:
    # By confidence: right, false, right, false. Risks 0, 1/2, 1/3, 1/2; the best order has 0, 0, 1/3, 1/2.
    answers = simple([0.9, 0.8, 0.7, 0.1], [1, 0, 1, 0])
    assert aurc(answers) == pytest.approx((0 + 1 / 2 + 1 / 3 + 1 / 2) / 4)
    assert excess_aurc(answers) == pytest.approx(1 / 2 / 4)
    # False and accepted, of all: 0, 0, 1/4, 1/4, 1/2; trapezoids of width 1/4.
    assert augrc(answers) == pytest.approx((0 + 1 / 8 + 1 / 4 + 3 / 8) / 4)
    curve = risk_coverage(answers)
    assert curve.threshold.tolist() == [0.9, 0.8, 0.7, 0.1]
    assert curve.coverage.tolist() == [0.25, 0.5, 0.75, 1.0]
    np.testing.assert_allclose(curve.risk, [0, 1 / 2, 1 / 3, 1 / 2])


@given(rows=ROWS)
def test_a_strictly_monotone_map_of_the_confidence_changes_nothing(rows) -> None:
    answers = answers_of(rows)
    mapped = answers_of([(row[0] if row[0] is None else math.exp(row[0]) - 7.0, *row[1:]) for row in rows])
    for figure in AREAS:
        assert figure(mapped) == figure(answers)
    for coverage in (0.3, 0.5, 1.0):
        assert false_fix_rate(mapped, coverage) == false_fix_rate(answers, coverage)
    assert risk_coverage(mapped).risk.tolist() == risk_coverage(answers).risk.tolist()


@given(rows=ROWS, seed=st.integers(0, 99))
def test_the_order_of_queries_changes_nothing(rows, seed) -> None:
    shuffled = [rows[at] for at in np.random.default_rng(seed).permutation(len(rows))]
    for figure in AREAS:
        assert figure(answers_of(shuffled)) == figure(answers_of(rows))


@given(rows=ROWS, data=st.data())
def test_a_weight_is_a_count(rows, data) -> None:
    times = data.draw(st.lists(st.integers(0, 3), min_size=len(rows), max_size=len(rows)))
    repeated = answers_of([row for row, count in zip(rows, times, strict=True) for _ in range(count)])
    answers = answers_of(rows)
    for figure in (*AREAS, lambda *given: false_fix_rate(given[0], 0.5, *given[1:])):
        assert figure(answers, times) == pytest.approx(figure(repeated), nan_ok=True, abs=1e-12)
    weighted, plain = risk_coverage(answers, times), risk_coverage(repeated)
    assert weighted.threshold.tolist() == plain.threshold.tolist()
    np.testing.assert_allclose(weighted.coverage, plain.coverage)
    np.testing.assert_allclose(weighted.risk, plain.risk)


@given(rows=ROWS)
def test_to_say_nothing_instead_of_something_false_is_never_worse_and_instead_of_something_right_never_better(
    rows,
) -> None:
    answers = answers_of(rows)
    for at in range(len(rows)):
        silent = answers_of([(row[0], row[1] and index != at, row[2]) for index, row in enumerate(rows)])
        for figure in (aurc, augrc):
            if answers.is_right[at]:
                assert figure(silent) >= figure(answers) - 1e-12
            else:
                assert figure(silent) <= figure(answers) + 1e-12


def test_to_answer_nothing_at_all_has_the_worst_area() -> None:
    silent = answers_of([(None, False, False)] * 5)
    assert aurc(silent) == 1.0
    assert augrc(silent) == 0.5
    assert risk_coverage(silent).coverage.tolist() == []


def test_without_a_false_fix_risk_is_zero_everywhere() -> None:
    answers = simple([0.1, 0.5, 0.5, 0.9], [1, 1, 1, 1])
    assert [figure(answers) for figure in AREAS] == [0.0, 0.0, 0.0]
    assert false_fix_rate(answers, 0.5) == 0.0
    assert choose_threshold(answers, 0.01) == 0.1
    assert operate(answers, 0.1).coverage == 1.0


def test_with_nothing_but_false_fixes_nothing_is_accepted() -> None:
    answers = simple([0.1, 0.5, 0.5, 0.9], [0, 0, 0, 0])
    assert aurc(answers) == pytest.approx(1.0)
    assert excess_aurc(answers) == pytest.approx(0.0, abs=1e-12)
    assert augrc(answers) == pytest.approx(0.5)
    assert false_fix_rate(answers, 0.5) == 1.0
    assert choose_threshold(answers, 0.05) == math.inf
    point = operate(answers, math.inf)
    assert (point.coverage, point.accepted) == (0.0, 0)
    assert math.isnan(point.risk)


@pytest.mark.parametrize("confidence", [0.5, None])
def test_with_equal_confidences_risk_is_the_same_at_every_coverage(confidence) -> None:
    answers = answers_of([(confidence, True, at < 3) for at in range(4)])
    assert aurc(answers) == pytest.approx(1 / 4)
    assert augrc(answers) == pytest.approx(1 / 8)
    assert [false_fix_rate(answers, coverage) for coverage in (0.1, 0.5, 1.0)] == pytest.approx([1 / 4] * 3)
    curve = risk_coverage(answers)
    assert (curve.coverage.tolist(), curve.risk.tolist()) == ([1.0], [0.25])
    assert choose_threshold(answers, 0.25) == (0.5 if confidence else -math.inf)
    assert choose_threshold(answers, 0.2) == math.inf


def test_no_query_and_one_query() -> None:
    nothing = answers_of([])
    assert all(math.isnan(figure(nothing)) for figure in AREAS)
    assert math.isnan(false_fix_rate(nothing, 0.5))
    assert risk_coverage(nothing).risk.tolist() == []
    assert choose_threshold(nothing, 0.05) == math.inf
    assert math.isnan(operate(nothing, 0.5).coverage)
    right, wrong = simple([0.5], [1]), simple([0.5], [0])
    assert [figure(right) for figure in AREAS] == [0.0, 0.0, 0.0]
    assert [figure(wrong) for figure in AREAS] == pytest.approx([1.0, 0.0, 0.5])


def test_augrc_is_what_scikit_learn_says_of_the_roc_curve() -> None:
    rng = np.random.default_rng(4)
    right = rng.random(300) < 0.7
    confidence = np.round(right * 0.2 + rng.random(300), 1)  # many ties
    weights = rng.integers(1, 4, 300).astype(float)
    answers = simple(confidence, right)
    for mass in (None, weights):
        share = np.average(right, weights=mass)
        ranked = roc_auc_score(right, confidence, sample_weight=mass)
        expected = (1 - ranked) * share * (1 - share) + (1 - share) ** 2 / 2  # Traub et al. 2024
        assert augrc(answers, mass) == pytest.approx(expected)


def test_for_many_queries_the_best_area_is_the_limit_of_geifman() -> None:
    right = np.arange(20_000) >= 6_000
    risk = 0.3
    assert aurc(simple(right.astype(float), right)) == pytest.approx(risk + (1 - risk) * math.log(1 - risk), rel=0.02)
    ordered = simple(np.arange(20_000.0), right)
    assert excess_aurc(ordered) == pytest.approx(0.0, abs=1e-12)
    assert aurc(ordered) == pytest.approx(risk + (1 - risk) * math.log(1 - risk), abs=1e-4)


# Operating points


def test_a_coverage_between_two_queries_counts_in_proportion() -> None:
    answers = simple([0.9, 0.8, 0.7], [1, 0, 1])
    assert false_fix_rate(answers, 0.5) == pytest.approx(0.5 / 1.5)  # one and a half queries, half a false one
    assert false_fix_rate(answers, 1.0) == pytest.approx(1 / 3)
    silent = answers_of([(0.9, True, True), (None, False, False)])
    assert false_fix_rate(silent, 0.5) == 0.0
    assert false_fix_rate(silent, 0.8) == pytest.approx(0.3 / 0.8)


def test_the_threshold_comes_from_calibration_and_the_risk_from_test() -> None:
    # Calibration: the three most confident are right, so 0.6 keeps the risk at 0; at 0.5 it is 1/4.
    calibration = simple([0.9, 0.8, 0.6, 0.5], [1, 1, 1, 0])
    test = simple([0.95, 0.7, 0.6, 0.55, 0.1], [1, 0, 1, 1, 1])
    point = coverage_at_risk(calibration, test, 0.05)
    assert (point.threshold, point.coverage, point.accepted) == (0.6, 3 / 5, 3)
    assert point.risk == pytest.approx(1 / 3)
    # What the test queries are can never move the threshold.
    other = coverage_at_risk(calibration, simple([0.61, 0.59], [0, 0]), 0.05)
    assert (other.threshold, other.coverage, other.risk) == (0.6, 0.5, 1.0)


def test_of_several_coverages_that_keep_the_risk_the_largest_is_chosen() -> None:
    # Risks 1, 1/2, 1/3, 1/4, 1/5: only the last keeps 20 %.
    assert choose_threshold(simple([5, 4, 3, 2, 1], [0, 1, 1, 1, 1]), 0.2) == 1.0


@given(rows=ROWS, risk=st.sampled_from([0.0, 0.01, 0.05, 0.3, 1.0]))
def test_on_calibration_itself_the_risk_is_kept(rows, risk) -> None:
    answers = answers_of(rows)
    point = coverage_at_risk(answers, answers, risk)
    assert math.isnan(point.risk) or point.risk <= risk
    curve = risk_coverage(answers)
    assert point.coverage == pytest.approx(max(curve.coverage[curve.risk <= risk], default=0.0))


def test_equal_confidences_are_accepted_together() -> None:
    assert choose_threshold(simple([0.9, 0.5, 0.5], [1, 1, 0]), 0.0) == 0.9
    assert operate(simple([0.9, 0.5, 0.5], [1, 1, 0]), 0.5).accepted == 3


def test_reweighting_changes_the_risk_as_it_must() -> None:
    # Half present and right, half absent: at 0.9 present, a tenth of what is accepted is false.
    present = np.array([1, 1, 0, 0])
    answers = Fixes(confidence=np.full(4, 0.5), is_answered=np.ones(4), is_right=present, is_present=present)
    for share in (0.9, 0.7, 0.5):
        weights = presence_weights(present, share)
        assert operate(answers, 0.5, weights).risk == pytest.approx(1 - share)
        assert false_fix_rate(answers, 0.8, weights) == pytest.approx(1 - share)
        assert aurc(answers, weights) == pytest.approx(1 - share)


def test_what_cannot_be_is_refused() -> None:
    answers = simple([0.5], [1])
    with pytest.raises(MetricError, match="coverage"):
        false_fix_rate(answers, 0.0)
    with pytest.raises(MetricError, match="risk"):
        choose_threshold(answers, 1.5)
    with pytest.raises(MetricError, match="shape"):
        aurc(answers, [1.0, 1.0])
