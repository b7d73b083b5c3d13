# SPDX-License-Identifier: Apache-2.0
"""Weights are checked, infinity is honoured, and what cannot be counted is refused in one line."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sasgeo_bench.core.errors import MetricError, SasgeoError
from sasgeo_bench.scoring.base import block_codes, check_weights, codes_of, weighted_mean, weighted_quantile

ROWS = st.lists(st.tuples(st.floats(-100, 100), st.integers(0, 4)), min_size=1, max_size=12)


@given(rows=ROWS)
def test_a_weight_is_a_count(rows) -> None:
    values, weights = map(list, zip(*rows, strict=True))
    repeated = [value for value, times in rows for _ in range(times)]
    assert weighted_mean(values, weights) == pytest.approx(weighted_mean(repeated), nan_ok=True)
    for share in (0.5, 0.9, 1.0):
        assert weighted_quantile(values, share, weights) == pytest.approx(
            weighted_quantile(repeated, share), nan_ok=True
        )


@given(rows=ROWS, factor=st.sampled_from([0.125, 2.0, 64.0]))
def test_means_and_quantiles_do_not_ask_what_weights_sum_to(rows, factor) -> None:
    values, weights = np.array(rows).T
    assert weighted_mean(values, weights * factor) == pytest.approx(weighted_mean(values, weights), nan_ok=True)
    assert weighted_quantile(values, 0.5, weights * factor) == pytest.approx(
        weighted_quantile(values, 0.5, weights), nan_ok=True
    )


def test_infinity_counts_where_it_has_weight() -> None:
    assert weighted_mean([1.0, math.inf]) == math.inf
    assert weighted_mean([1.0, math.inf], [1.0, 0.0]) == 1.0
    assert weighted_quantile([1.0, math.inf], 1.0) == math.inf
    assert weighted_quantile([1.0, math.inf], 1.0, [1.0, 0.0]) == 1.0


def test_nothing_has_no_mean() -> None:
    for weights in (None, []):
        assert math.isnan(weighted_mean([], weights))
        assert math.isnan(weighted_quantile([], 0.5, weights))
    assert math.isnan(weighted_mean([1.0], [0.0]))
    assert math.isnan(weighted_quantile([1.0], 0.5, [0.0]))


@pytest.mark.parametrize(
    ("weights", "words"), [([1.0, -1.0], "-1"), ([1.0, math.inf], "inf"), ([1.0], "shape"), ([1.0, math.nan], "NaN")]
)
def test_weights_that_cannot_be_are_refused(weights, words) -> None:
    with pytest.raises(MetricError, match=words) as caught:
        check_weights(weights, 2)
    assert isinstance(caught.value, SasgeoError)
    assert "\n" not in str(caught.value)


def test_a_value_that_is_missing_is_refused() -> None:
    with pytest.raises(MetricError, match="place 1"):
        weighted_mean([1.0, math.nan])
    with pytest.raises(MetricError, match=r"\(0, 1\]"):
        weighted_quantile([1.0], 0.0)
    with pytest.raises(MetricError, match="2 blocks for 1"):
        block_codes(["a", "b"], 1)


@pytest.mark.parametrize("kind", [np.int8, np.int64])
def test_codes_are_the_places_of_names_in_their_order_whatever_their_type_and_gaps(kind):
    for names in ([7, 3, 7], [127, 0, 127], list(range(127, 0, -2)), [-2, 5, -2], [0], []):
        expected = [sorted(set(names)).index(name) for name in names]
        assert codes_of(np.array(names, dtype=kind)).tolist() == expected
