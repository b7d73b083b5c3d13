# SPDX-License-Identifier: Apache-2.0
"""Terms of the joint score: what is not seen has no say, and no weight turns a term around."""

import numpy as np
import pytest

from sasgeo_bench.core.errors import ConfigError
from sasgeo_bench.sasgeo.joint import HALF_NODES, Blend, columns, contradiction


@pytest.mark.parametrize(("name", "value"), [("alpha", -1.0), ("beta", float("nan")), ("eta", float("inf"))])
def test_weights_that_turn_a_term_around_are_refused(name, value):
    with pytest.raises(ConfigError, match=name):
        Blend(**{name: value})


def test_by_hand_contradiction_is_never_covered_up():
    terms = columns(
        np.array([[2.0, -4.0], [1.0, 0.5]]), np.array([3.0, -1.0]), Blend(alpha=2.0, beta=0.5, eta=0.25), nodes=2
    )
    share = 2 / (2 + HALF_NODES)
    assert terms == pytest.approx(np.array([[4.0, -8.0, 1.5 * share, -1.0], [2.0, 1.0, -0.5 * share, 0.0]]))
    assert not columns(np.ones((3, 2)), np.array([5.0, -5.0, 0.0]), Blend(), nodes=0)[:, 2].any()
    by_class = np.array([[2.0, -4.0], [1.0, 0.5]])
    assert (columns(by_class, None, Blend(), nodes=9) == by_class).all()  # without a graph
    assert contradiction(np.array([[100.0, -3.0], [0.0, 0.0]])).tolist() == [3.0, 0.0]
