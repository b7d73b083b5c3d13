# SPDX-License-Identifier: Apache-2.0
"""Exponents come back from choices that were made with them, and nothing is fitted to nothing."""

import numpy as np
import pytest
from scipy.special import softmax

from sasgeo_bench.core.errors import ConfigError
from sasgeo_bench.sasgeo.scorer_model import START, fit_scaling

TRUE = np.array([0.02, 0.007, 0.01])


def chosen(count, *, seed=1, modes=12):
    """Searches in which the right mode is drawn by the true exponents, then put first."""
    rng = np.random.default_rng(seed)
    made = []
    for _ in range(count):
        scores = rng.normal(0, 120, (modes, 3))
        right = rng.choice(modes, p=softmax(scores @ TRUE))
        made.append(np.concatenate((scores[right : right + 1], np.delete(scores, right, axis=0))))
    return made


def test_the_true_exponents_come_back_whatever_is_added_to_a_search_or_overflows():
    assert fit_scaling(chosen(1500)) == pytest.approx(TRUE, rel=0.25)
    searches = chosen(50)
    assert fit_scaling([one + 1e4 for one in searches]) == pytest.approx(fit_scaling(searches), rel=1e-3)
    assert np.isfinite(fit_scaling([np.array([[1e7, 0.0], [0.0, 1e7]])])).all()
    assert fit_scaling([np.ones((1, 4))]) == pytest.approx([START] * 4)


def test_nothing_and_different_classes_are_refused():
    with pytest.raises(ConfigError, match="training part is empty"):
        fit_scaling([])
    with pytest.raises(ConfigError, match="different classes"):
        fit_scaling([np.ones((2, 3)), np.ones((2, 4))])


def test_views_that_any_weight_tells_apart_do_not_run_off():
    separable = [np.array([[30.0, 4.0], [0.0, 0.0], [-5.0, 1.0]])] * 18
    tame, wild = (fit_scaling(separable, start=(0.01, 0.05), common_width=width) for width in (0.5, 3.0))
    assert (wild > 2 * tame).all()
    assert tame[0] / tame[1] == pytest.approx(0.01 / 0.05, rel=0.5)
    assert (tame < 6 * np.array([0.01, 0.05])).all()
