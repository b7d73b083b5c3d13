# SPDX-License-Identifier: Apache-2.0
"""Probabilities and protection levels against what came of them."""

import math
from dataclasses import fields

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from sklearn.calibration import calibration_curve
from sklearn.metrics import brier_score_loss

from sasgeo_bench.core.errors import MetricError
from sasgeo_bench.scoring.decisions import (
    Fixes,
    brier,
    calibration_error,
    stanford,
)

ROWS = st.lists(st.tuples(st.integers(0, 8).map(lambda n: n / 8), st.booleans()), min_size=1, max_size=15)
METRES = st.one_of(st.integers(0, 4).map(float), st.just(math.inf))


def simple(confidence, right) -> Fixes:
    count = len(right)
    return Fixes(
        confidence=np.asarray(confidence, dtype=float),
        is_answered=np.ones(count),
        is_right=np.asarray(right),
        is_present=np.ones(count),
    )


def some(count: int, seed: int) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    confidence = rng.permutation(np.linspace(0.01, 0.99, count))
    return confidence, rng.random(count) < confidence**2


def test_the_brier_score_is_that_of_scikit_learn() -> None:
    confidence, right = some(200, 1)
    weights = np.random.default_rng(2).random(200)
    answers = simple(confidence, right)
    assert brier(answers) == pytest.approx(brier_score_loss(right, confidence))
    assert brier(answers, weights) == pytest.approx(brier_score_loss(right, confidence, sample_weight=weights))


def test_with_distinct_confidences_bins_are_those_of_scikit_learn() -> None:
    confidence, right = some(200, 3)
    reached, result = calibration_curve(right, confidence, n_bins=10, strategy="quantile")
    assert len(reached) == 10  # of 20 each
    assert calibration_error(simple(confidence, right), bins=10) == pytest.approx(np.abs(reached - result).mean())


@given(rows=ROWS)
def test_the_order_of_answers_and_the_sum_of_weights_do_not_matter(rows) -> None:
    confidence, right = map(list, zip(*rows, strict=True))
    answers, turned = simple(confidence, right), simple(confidence[::-1], right[::-1])
    assert calibration_error(answers) == pytest.approx(calibration_error(turned))
    assert calibration_error(answers, [4.0] * len(rows)) == pytest.approx(calibration_error(answers))
    assert abs(np.mean(confidence) - np.mean(right)) - 1e-12 <= calibration_error(answers) <= 1.0
    assert calibration_error(answers, bins=1) == pytest.approx(abs(np.mean(confidence) - np.mean(right)))


def test_a_calibration_error_worked_by_hand() -> None:
    # Two bins of two: |0.15 - 1/2| and |0.85 - 1|, halved each.
    answers = simple([0.1, 0.2, 0.8, 0.9], [1, 0, 1, 1])
    assert calibration_error(answers, bins=2) == pytest.approx(0.35 / 2 + 0.15 / 2)
    # Weight 0 takes the last answer out: bins {0.1}, {0.2, 0.8} by the middles 1/6, 1/2, 5/6 of their masses.
    answers = simple([0.1, 0.2, 0.8, 0.9], [1, 0, 0, 1])
    assert calibration_error(answers, [1, 1, 1, 0], bins=2) == pytest.approx((0.9 + 0.2 + 0.8) / 3)


def test_equal_confidences_share_a_bin() -> None:
    # Were they split by place in the file, each bin would be off by 1/2.
    answers = simple([0.5] * 4, [1, 1, 0, 0])
    assert calibration_error(answers, bins=2) == 0.0
    assert brier(answers) == 0.25


def test_queries_without_an_answer_do_not_count_and_a_missing_confidence_gives_nan() -> None:
    facts = {"is_right": np.array([1, 0]), "is_present": np.ones(2)}
    silent = Fixes(confidence=np.array([0.5, np.nan]), is_answered=np.array([1, 0]), **facts)
    assert brier(silent) == 0.25
    assert calibration_error(silent) == 0.5
    unsaid = Fixes(confidence=np.array([0.5, np.nan]), is_answered=np.ones(2), **facts)
    assert math.isnan(brier(unsaid))
    assert math.isnan(calibration_error(unsaid))


def test_no_answer_and_one_answer() -> None:
    nothing = simple([], [])
    assert math.isnan(brier(nothing))
    assert math.isnan(calibration_error(nothing))
    one = simple([0.75], [True])
    assert (brier(one), calibration_error(one)) == (0.0625, 0.25)


def test_what_is_no_probability_is_refused() -> None:
    for figure in (brier, calibration_error):
        with pytest.raises(MetricError, match="probabilities"):
            figure(simple([1.5], [1]))
    with pytest.raises(MetricError, match="bins"):
        calibration_error(simple([0.5], [1]), bins=0)


# Protection levels


def areas_of(found) -> dict[str, np.ndarray]:
    return {field.name: getattr(found, field.name) for field in fields(found)}


@given(rows=st.lists(st.tuples(METRES, METRES), min_size=1, max_size=10))
def test_every_query_lies_in_one_area_of_the_diagram(rows) -> None:
    level, error = zip(*rows, strict=True)
    found = stanford(level, error, 2.0)
    assert (np.stack(list(areas_of(found).values())).sum(axis=0) == 1).all()


@pytest.mark.parametrize(
    ("level", "error", "area"),
    [
        (5.0, 5.0, "nominal"),
        (10.0, 10.0, "nominal"),
        (5.0, 6.0, "misleading"),
        (5.0, 10.0, "misleading"),
        (5.0, 10.1, "hazardous"),
        (10.0, math.inf, "hazardous"),
        (10.1, 10.1, "unavailable"),
        (math.inf, math.inf, "unavailable"),
        (11.0, 12.0, "unavailable_misleading"),
    ],
)
def test_a_level_and_an_error_lie_in_the_area_of_their_own(level, error, area) -> None:
    assert [name for name, inside in areas_of(stanford([level], [error], 10.0)).items() if inside.any()] == [area]


def test_the_diagram_refuses_negative_levels_and_limits_out_of_range() -> None:
    for level, limit in ((-1.0, 5.0), (1.0, math.inf), (1.0, 0.0)):
        with pytest.raises(MetricError, match="not negative"):
            stanford([level], [1.0], limit)
