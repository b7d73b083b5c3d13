# SPDX-License-Identifier: Apache-2.0
"""Protection levels counted by hand, what counts carry, and conformal levels that hold."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sasgeo_bench.core.errors import MetricError
from sasgeo_bench.scoring.intervals import wilson
from sasgeo_bench.scoring.protection import (
    conformal_factor,
    stanford_counts,
    statement,
    supported_risk,
)

LEVELS = st.lists(st.tuples(st.floats(0, 60), st.floats(0, 60)), min_size=1, max_size=30)


def test_a_stanford_diagram_by_hand():
    # Alert limit 25 m. Bounded; bounded; misleading; hazardous; level beyond the limit and bounded; beyond and
    # exceeded; no answer; a false fix where nothing is right, with a level.
    level_m = [10, 25, 10, 10, 40, 30, math.inf, 12]
    error_m = [5, 25, 20, 30, 35, 45, math.inf, math.inf]
    found = stanford_counts(level_m, error_m, 25.0)
    counts = {"available": 5, "unavailable": 3, "misleading": 3, "hazardous": 2, "exceeded": 4}
    assert {name: getattr(found, name) for name in counts} == {name: wilson(n, 8) for name, n in counts.items()}
    assert found.trials == 8.0


def test_queries_of_a_site_are_worth_one_trial():
    found = stanford_counts([10] * 8, [5] * 6 + [30] * 2, 25.0, trials=4.0)
    assert found.hazardous == wilson(1, 4)


@given(pairs=LEVELS, limit_m=st.floats(1, 50))
def test_every_query_is_available_or_not_and_what_is_hazardous_misleads(pairs, limit_m):
    level_m, error_m = zip(*pairs, strict=True)
    found = stanford_counts(level_m, error_m, limit_m)
    assert found.available.value + found.unavailable.value == pytest.approx(1.0)
    assert found.hazardous.value <= found.misleading.value <= found.available.value
    assert found.misleading.value <= found.exceeded.value <= 1.0
    assert found.exceeded.value == pytest.approx(np.mean(np.array(error_m) > np.array(level_m)))


def test_no_query_says_nothing():
    found = stanford_counts([], [], 25.0)
    assert math.isnan(found.available.value)
    assert (found.available.lo, found.available.hi) == (0.0, 1.0)


@pytest.mark.parametrize(("risk", "count"), [(0.01, 299), (0.001, 2995), (0.05, 59)])
def test_so_many_without_a_failure_support_a_risk_and_one_fewer_does_not(risk, count):
    assert statement(0, count, risk=risk) == f"0 of {count} support below {100 * risk:g} % (95 % confidence)"
    assert f"which takes {count} without one" in statement(0, count - 1, risk=risk)


def test_a_statement_claims_no_more_than_the_counts_carry():
    assert statement(0, 0, risk=0.01) == "0 of 0 support no bound (95 % confidence)"
    assert statement(3, 3, risk=0.01) == "3 of 3 support no bound (95 % confidence)"
    # 0 of 100: 1 - 0.05^(1/100) = 2.951 %, told as 3 % and never as 2.9 %
    assert "below 3 %" in statement(0, 100, risk=0.001)
    assert "takes" not in statement(1, 100, risk=0.01)


@given(failures=st.integers(0, 20), more=st.integers(1, 2000))
def test_a_statement_is_never_below_what_is_supported(failures, more):
    trials = failures + more
    stated = float(statement(failures, trials, risk=1e-6).split("below ")[1].split(" %")[0])
    assert stated / 100 >= supported_risk(failures, trials) - 1e-12
    assert stated / 100 <= 1.1 * supported_risk(failures, trials)


def test_a_conformal_factor_is_a_rank_of_calibration_and_infinite_where_that_is_too_small():
    error_m, scale_m = np.arange(1.0, 100.0), np.ones(99)  # 99 answers: the rank at 1 % is 99
    assert conformal_factor(error_m, scale_m, 0.01) == 99.0
    assert conformal_factor(error_m[:-1], scale_m[:-1], 0.01) == math.inf
    assert conformal_factor(np.append(error_m[:-1], math.inf), scale_m, 0.01) == math.inf
    assert conformal_factor(2 * error_m, 2 * scale_m, 0.5) == 50.0
    assert conformal_factor([], [], 0.1) == math.inf


def test_conformal_levels_are_exceeded_as_often_as_the_risk():
    rng = np.random.default_rng(0)
    scale_m = rng.uniform(1, 9, (300, 400))
    error_m = scale_m * rng.gamma(2.0, 1.0, scale_m.shape)
    exceeded = [
        (error[200:] > conformal_factor(error[:200], scale[:200], 0.1) * scale[200:]).mean()
        for error, scale in zip(error_m, scale_m, strict=True)
    ]
    assert np.mean(exceeded) == pytest.approx(0.1, abs=0.01)


@pytest.mark.parametrize(
    ("call", "words"),
    [
        (lambda: conformal_factor([1.0], [0.0], 0.1), "scales positive"),
        (lambda: conformal_factor([1.0], [1.0], 0.0), r"risk must lie in \(0, 1\)"),
        (lambda: statement(0, 9, risk=0.0), r"risk must lie in \(0, 1\)"),
        (lambda: stanford_counts([1.0], [1.0], 0.0), "alert limit"),
    ],
)
def test_numbers_out_of_range_are_refused(call, words):
    with pytest.raises(MetricError, match=words):
        call()
