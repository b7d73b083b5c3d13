# SPDX-License-Identifier: Apache-2.0
"""Power: the design's own figures, and the estimator of how alike the queries of a block are."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.stats import f_oneway, norm

from sasgeo_bench.core.errors import MetricError
from sasgeo_bench.scoring.compare import (
    design_effect,
    detectable_difference,
    intraclass_correlation,
    mcnemar_exact,
    sensitivity,
)


def test_the_figures_of_the_design() -> None:
    # Three points with 6 % discordant pairs need 521 pairs; 50 a block with correlation 0.05 multiply by 3.45.
    assert design_effect([50] * 36, 0.05) == pytest.approx(3.45)
    assert 521 * 3.45 < 36 * 50
    assert detectable_difference(36 * 50 / 3.45, 0.06) == pytest.approx(0.03, abs=3e-5)


@given(share=st.floats(0.01, 1.0), part=st.floats(0.05, 1.0))
def test_the_detectable_difference_solves_the_equation_of_connor(share, part) -> None:
    difference = share * part
    root = norm.isf(0.025) * math.sqrt(share) + norm.ppf(0.8) * math.sqrt(share - difference**2)
    pairs = (root / difference) ** 2
    assert detectable_difference(pairs * (1 + 1e-9), share) == pytest.approx(difference, rel=1e-6)


def test_the_power_is_what_a_trial_finds() -> None:
    # 521 independent pairs, 6 % discordant, 3 points apart: 4.5 % for the first, 1.5 % for the second.
    rng = np.random.default_rng(1)
    found = 0
    for _ in range(300):
        lot = rng.random(521)
        found += mcnemar_exact(lot < 0.045, (lot >= 0.045) & (lot < 0.06)).p_value < 0.05
    assert 0.65 < found / 300 < 0.87  # the exact test is a little more careful than Connor's equation


def test_where_too_few_disagree_nothing_can_be_found() -> None:
    assert detectable_difference(1000, 0.0) == math.inf
    assert detectable_difference(50, 0.06) == math.inf
    assert detectable_difference(0, 0.5) == math.inf


def test_the_correlation_is_that_of_the_analysis_of_variance() -> None:
    rng = np.random.default_rng(2)
    groups = [rng.normal(rng.normal(), 1.0, size) for size in (3, 8, 5, 12, 4, 9)]
    sizes = np.array([len(group) for group in groups])
    values = np.concatenate(groups)
    blocks = np.repeat(list("abcdef"), sizes)
    ratio = f_oneway(*groups).statistic  # of the mean squares between and within
    size = (sizes.sum() - (sizes**2).sum() / sizes.sum()) / 5
    assert intraclass_correlation(values, list(blocks)) == pytest.approx((ratio - 1) / (ratio + size - 1))


def test_the_correlation_is_found_again() -> None:
    rng = np.random.default_rng(3)
    values = rng.normal(size=(400, 10)) * math.sqrt(0.8) + rng.normal(size=(400, 1)) * math.sqrt(0.2)
    blocks = np.repeat([str(at) for at in range(400)], 10)
    assert intraclass_correlation(values.ravel(), list(blocks)) == pytest.approx(0.2, abs=0.04)


def test_correlations_worked_by_hand() -> None:
    assert intraclass_correlation([1, 1, 0, 0], list("aabb")) == 1.0
    # Blocks alike, all variance within: B = 0, W = 4 (1/4) / (4 - 2) = 1/2, n0 = 2, so (0 - W) / (0 + W) = -1.
    assert intraclass_correlation([1, 0, 1, 0], list("aabb")) == -1.0
    assert design_effect([2, 2], -1.0) == 1.0
    # Sizes 1 and 3: a query's block has (1 + 9) / 4 = 2.5 on average.
    assert design_effect([1, 3], 0.5) == pytest.approx(1 + 1.5 * 0.5)


@pytest.mark.parametrize(
    ("values", "blocks"), [([1, 0], "aa"), ([1, 0], "ab"), ([1, 1, 1, 1], "aabb"), ([], "")], ids=str
)
def test_a_correlation_that_cannot_be_known_is_not(values, blocks) -> None:
    assert math.isnan(intraclass_correlation(values, list(blocks)))


def test_what_a_suite_can_tell() -> None:
    # 36 blocks of 50; 6 % discordant, two of three for the first, spread evenly: no correlation to speak of.
    lot = np.random.default_rng(4).permutation(1800)
    blocks = [str(at // 50) for at in range(1800)]
    first, second = lot < 72, (lot >= 72) & (lot < 108)
    correlation = intraclass_correlation(first.astype(float) - second, blocks)
    assert abs(correlation) < 0.03
    found = sensitivity(first, second, blocks)
    effect = design_effect([50] * 36, correlation)
    assert found == pytest.approx(detectable_difference(1800 / effect, 0.06))
    # The same disagreements in few blocks detect less.
    at = np.arange(1800)
    assert sensitivity(at < 72, (at >= 72) & (at < 108), blocks) > 2 * found


def test_two_methods_that_never_disagree_cannot_be_told_apart() -> None:
    assert sensitivity([1, 0, 1, 0], [1, 0, 1, 0], list("aabb")) == math.inf


def test_what_cannot_be_is_refused() -> None:
    with pytest.raises(MetricError, match="discordant share"):
        detectable_difference(10, 1.5)
    for sizes in ([], [0]):
        with pytest.raises(MetricError, match="blocks with queries"):
            design_effect(sizes, 0.1)
    with pytest.raises(MetricError, match="infinity"):
        intraclass_correlation([math.inf, 1.0], ["a", "b"])
    with pytest.raises(MetricError, match="no queries"):
        sensitivity([], [], [])
