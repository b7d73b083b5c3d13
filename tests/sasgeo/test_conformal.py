# SPDX-License-Identifier: Apache-2.0
"""Promised thresholds: they hold as often as is said, over simulated splits, and are not given for nothing."""

import numpy as np
import pytest

from sasgeo_bench.core.errors import ConfigError
from sasgeo_bench.sasgeo.conformal import risk_threshold, upper_rate
from sasgeo_bench.scoring.protection import supported_risk

ALPHA, DELTA, SPLITS = 0.05, 0.1, 200


def rate(p_false):
    """What is true of answers of which 0.3 is said to be false: more, and not in order."""
    return np.clip(1.6 * p_false + 0.02 * np.sin(40 * p_false), 0, 1)


def test_the_promise_holds_over_splits():
    rng = np.random.default_rng(0)
    whole = rng.beta(0.5, 3.0, 200_000)
    truth = rate(whole)
    violated, promised = 0, 0
    for _ in range(SPLITS):
        p_false = rng.choice(whole, 500)
        bound = risk_threshold(p_false, rng.random(500) < rate(p_false), alpha=ALPHA, delta=DELTA)
        promised += bound.is_promised
        violated += bound.is_promised and truth[whole < bound.threshold].mean() > ALPHA
    assert promised > 0.5 * SPLITS
    assert violated / SPLITS <= DELTA + 2 * np.sqrt(DELTA * (1 - DELTA) / SPLITS)


def test_by_block_the_promise_holds_where_whole_blocks_go_wrong():
    # In 6 % of the blocks all is false, however sure it is said to be, so every promise of 5 % is broken.
    rng = np.random.default_rng(1)
    blocks = np.repeat(np.arange(120), 10).astype(str)
    alone, together, sure = 0, 0, 0.004
    for _ in range(SPLITS):
        wrong_block = rng.random(120) < 0.06
        is_false = np.repeat(wrong_block, 10)
        p_false = np.full(1200, sure)
        by_block = risk_threshold(p_false, is_false, alpha=ALPHA, delta=DELTA, blocks=blocks)
        together += by_block.is_promised
        alone += risk_threshold(p_false, is_false, alpha=ALPHA, delta=DELTA).is_promised
    assert together / SPLITS <= DELTA
    assert alone / SPLITS > DELTA  # taking the answers of a block for independent promises too much, too often


def test_answers_without_a_false_one_promise_from_the_count_on_and_where_none_can_nothing_is_accepted():
    for count, is_promised in ((76, False), (77, True)):  # 0.95^77 < 0.1 / 5
        for blocks in (None, [str(at) for at in range(count)]):
            bound = risk_threshold(np.full(count, 0.001), np.zeros(count), alpha=ALPHA, delta=DELTA, blocks=blocks)
            assert bound.is_promised == is_promised
            assert (bound.accepted, bound.false, bound.units) == ((count, 0, count) if is_promised else (0, 0, 0))
            assert bound.is_by_block == (blocks is not None)
    for p_false, is_false in ((np.full(500, 0.01), np.ones(500)), (np.ones(500), np.zeros(500)), ([], [])):
        bound = risk_threshold(p_false, is_false, alpha=ALPHA, delta=DELTA)
        assert bound.threshold == 0.0
        assert not bound.is_promised
        assert "none can be promised" in bound.to_text()


def test_a_threshold_goes_as_far_as_it_holds_and_is_said_in_words():
    p_false = np.concatenate((np.full(400, 0.01), np.full(400, 0.3)))
    is_false = np.concatenate((np.zeros(400), np.arange(400) % 3 == 0))
    bound = risk_threshold(p_false, is_false, alpha=ALPHA, delta=DELTA)
    assert 0.01 < bound.threshold <= 0.301
    assert (bound.accepted, bound.false) == (400, 0)
    assert "at most 0.05 of accepted answers are false, with confidence 0.9" in bound.to_text()
    blocks = [f"b{at % 100}" for at in range(800)]
    text = risk_threshold(p_false, is_false, alpha=ALPHA, delta=DELTA, blocks=blocks).to_text()
    assert "of a new block's accepted answers are false" in text
    assert "from 100 blocks" in text


def test_the_bound_of_counts_is_that_of_the_figures():
    for failures, trials in ((0, 1), (0, 299), (3, 40), (40, 40), (0, 0)):
        assert upper_rate(failures, trials) == pytest.approx(supported_risk(failures, trials))
    assert upper_rate(0, 100) == pytest.approx(0.03, abs=1e-3)


@pytest.mark.parametrize(
    ("given", "words"),
    [
        ({"p_false": [0.5, np.nan]}, "no probabilities"),
        ({"is_false": [True]}, r"is_false \(1,\)"),
        ({"blocks": ["a"]}, "blocks 1"),
        ({"alpha": 0.0}, "alpha and delta"),
        ({"delta": 1.0}, "alpha and delta"),
    ],
)
def test_what_no_promise_can_be_made_of_is_refused(given, words):
    sound = {"p_false": [0.5, 0.5], "is_false": [True, False], "alpha": 0.1, "delta": 0.1}
    with pytest.raises(ConfigError, match=words):
        risk_threshold(**(sound | given))
    with pytest.raises(ConfigError, match="failures <= trials"):
        upper_rate(2, 1)
