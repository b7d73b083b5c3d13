# SPDX-License-Identifier: Apache-2.0
"""Exponents come back from choices that were made with them, and nothing is learnt from nothing."""

import numpy as np
import pytest

from sasgeo_bench.errors import ConfigError
from sasgeo_bench.sasgeo.evidence_scaling import START, choice_probability, fit_temper

TRUE = np.array([0.03, 0.002, 0.01])


def chosen(count, *, seed=1, modes=12):
    """Searches in which the right mode is drawn by the true exponents, then put first."""
    rng = np.random.default_rng(seed)
    made = []
    for _ in range(count):
        scores = rng.normal(0, 120, (modes, 3))
        right = rng.choice(modes, p=choice_probability(scores, TRUE))
        made.append(np.concatenate((scores[right : right + 1], np.delete(scores, right, axis=0))))
    return made


def test_the_true_exponents_come_back():
    assert fit_temper(chosen(1500)) == pytest.approx(TRUE, rel=0.25)


def test_probabilities_are_calibrated_on_searches_not_seen():
    temper = fit_temper(chosen(800, seed=2))
    chance = np.array([choice_probability(one, temper) for one in chosen(800, seed=3)])
    best = chance.max(axis=1)
    is_right = chance.argmax(axis=1) == 0
    assert best.mean() == pytest.approx(is_right.mean(), abs=0.04)


def test_the_same_number_added_to_a_search_changes_nothing():
    searches = chosen(50)
    assert fit_temper([one + 1e4 for one in searches]) == pytest.approx(fit_temper(searches), rel=1e-3)


def test_searches_with_one_mode_teach_nothing():
    assert fit_temper([np.ones((1, 4))]) == pytest.approx([START] * 4)


def test_scores_so_large_that_an_exponential_overflows_are_taken():
    assert np.isfinite(fit_temper([np.array([[1e7, 0.0], [0.0, 1e7]])])).all()


def test_nothing_and_different_classes_are_refused():
    with pytest.raises(ConfigError, match="train part is empty"):
        fit_temper([])
    with pytest.raises(ConfigError, match="different classes"):
        fit_temper([np.ones((2, 3)), np.ones((2, 4))])
