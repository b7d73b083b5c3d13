# SPDX-License-Identifier: Apache-2.0
"""Differences: exact and clustered tests, Holm's steps, and ranks no surer than the draws."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.stats import binomtest, chi2
from statsmodels.stats.contingency_tables import mcnemar

from sasgeo_bench.core.errors import MetricError
from sasgeo_bench.scoring.compare import (
    RankInterval,
    distinguishable,
    holm,
    mcnemar_clustered,
    mcnemar_exact,
    rank_intervals,
)
from sasgeo_bench.scoring.intervals import ClusterDraws, bootstrap_means

PAIRS = st.lists(st.tuples(st.booleans(), st.booleans()), min_size=1, max_size=30)


@given(pairs=PAIRS)
def test_the_exact_test_is_a_fair_coin_for_each_discordant_query(pairs) -> None:
    ours, theirs = zip(*pairs, strict=True)
    found = mcnemar_exact(ours, theirs)
    gained, lost = pairs.count((True, False)), pairs.count((False, True))
    assert (found.first_only, found.second_only) == (gained, lost)
    assert found.p_value == pytest.approx(binomtest(gained, gained + lost).pvalue if gained + lost else 1.0)
    assert mcnemar_exact(theirs, ours).p_value == found.p_value


def test_an_exact_test_worked_by_hand() -> None:
    # 1 of 8 discordant for the second: 2 (1 + 8) / 2^8.
    found = mcnemar_exact([1] * 7 + [0] + [1] * 5, [0] * 7 + [1] + [1] * 5)
    assert found.p_value == pytest.approx(2 * 9 / 256)


@given(pairs=PAIRS.filter(lambda pairs: len(pairs) > 1 and any(one != other for one, other in pairs)))
def test_with_a_block_for_each_query_the_clustered_test_is_the_plain_one(pairs) -> None:
    ours, theirs = map(list, zip(*pairs, strict=True))
    found = mcnemar_clustered(ours, theirs, [str(at) for at in range(len(pairs))])
    table = np.histogram2d(ours, theirs, bins=[[0, 0.5, 1]] * 2)[0]
    plain = mcnemar(table, exact=False, correction=False)
    assert found.p_value == pytest.approx(chi2.sf(plain.statistic * (len(pairs) - 1) / len(pairs), 1))


def test_a_clustered_test_worked_by_hand() -> None:
    # Differences 2, 1 and -1 of three blocks: (2/3) 2^2 / (4 + 1 + 1) = 4/9; P(chi2 > 4/9) = 0.505.
    found = mcnemar_clustered([1, 1, 1, 0, 0], [0, 0, 0, 1, 0], ["a", "a", "b", "c", "c"])
    assert (found.first_only, found.second_only) == (3, 1)
    assert found.p_value == pytest.approx(0.505, abs=5e-4)


def test_the_same_queries_over_and_over_make_nothing_surer() -> None:
    ours, theirs, blocks = [1, 1, 1, 0], [0, 0, 0, 0], ["a", "b", "c", "d"]
    once = mcnemar_clustered(ours, theirs, blocks)
    often = mcnemar_clustered(ours * 20, theirs * 20, blocks * 20)
    assert often.p_value == pytest.approx(once.p_value)
    assert mcnemar_exact(ours * 20, theirs * 20).p_value < 1e-6


def test_without_discordant_queries_or_blocks_nothing_is_found() -> None:
    assert mcnemar_exact([1, 0], [1, 0]).p_value == 1.0
    assert mcnemar_exact([], []).p_value == 1.0
    assert mcnemar_clustered([1, 0], [1, 0], ["a", "b"]).p_value == 1.0
    assert mcnemar_clustered([1, 0], [0, 1], ["a", "b"]).p_value == 1.0
    assert math.isnan(mcnemar_clustered([1, 1], [0, 0], ["a", "a"]).p_value)
    assert math.isnan(mcnemar_clustered([], [], []).p_value)


def test_the_clustered_test_rejects_as_often_as_it_says() -> None:
    rng = np.random.default_rng(1)
    blocks = [str(at // 20) for at in range(36 * 20)]
    rejected, naive = 0, 0
    for _ in range(200):
        lean = rng.choice([0.1, 0.9], 36).repeat(20)  # in each block one of the two is better, by lot
        discordant = rng.random(720) < 0.3
        first = rng.random(720) < lean
        ours, theirs = discordant & first, discordant & ~first
        rejected += mcnemar_clustered(ours, theirs, blocks).p_value < 0.05
        naive += mcnemar_exact(ours, theirs).p_value < 0.05
    assert 0.01 <= rejected / 200 <= 0.09
    assert naive / 200 > 0.2


def test_holm_steps_down() -> None:
    # Sorted 0.01, 0.02, 0.03, 0.2 times 4, 3, 2, 1, never falling: 0.04, 0.06, 0.06, 0.2.
    found = holm({"c": 0.03, "a": 0.01, "d": 0.2, "b": 0.02})
    assert list(found) == ["c", "a", "d", "b"]
    assert [found[name] for name in "abcd"] == pytest.approx([0.04, 0.06, 0.06, 0.2])
    assert holm({"a": 0.9, "b": 0.8}) == {"a": 1.0, "b": 1.0}
    assert holm({}) == {}
    for wrong in (math.nan, 1.5):
        with pytest.raises(MetricError, match="'a'"):
            holm({"a": wrong})


def test_ties_are_decided_before_a_test() -> None:
    with pytest.raises(MetricError, match="decide ties"):
        mcnemar_exact([0.5], [1.0])
    with pytest.raises(MetricError, match="shape"):
        mcnemar_exact([1], [1, 0])
    with pytest.raises(MetricError, match="1 blocks for 2"):
        mcnemar_clustered([1, 0], [1, 0], ["a"])


# Ranks


def draws_of(*means: float, spread: float = 0.01, count: int = 2000) -> tuple[np.ndarray, np.ndarray]:
    values = np.array(means)
    return values, values + np.random.default_rng(1).normal(0.0, spread, (count, len(values)))


def test_far_methods_have_a_rank_each_and_near_ones_share_theirs() -> None:
    values, draws = draws_of(0.9, 0.5, 0.501, 0.1)
    ranks = rank_intervals(distinguishable(values, draws, better="higher"))
    assert [rank.text for rank in ranks] == ["1", "2-3", "2-3", "4"]
    ranks = rank_intervals(distinguishable(values, draws, better="lower"))
    assert [rank.text for rank in ranks] == ["4", "2-3", "2-3", "1"]


def test_a_chain_whose_neighbours_cannot_be_told_apart() -> None:
    # Only the ends differ, so the middle one can have any rank.
    values, draws = draws_of(0.50, 0.53, 0.56)
    ranks = rank_intervals(distinguishable(values, draws, better="higher"))
    assert [rank.text for rank in ranks] == ["2-3", "1-3", "1-2"]


def test_identical_methods_tie_and_a_constant_gain_does_not() -> None:
    hits = np.random.default_rng(2).random(100)
    drawn = ClusterDraws(blocks=[str(at % 9) for at in range(100)], seed=1, draws=500)
    table = np.column_stack((hits, hits, hits + 0.02))
    better = distinguishable(table.mean(axis=0), bootstrap_means(table, drawn), better="higher")
    assert [rank.text for rank in rank_intervals(better)] == ["2-3", "2-3", "1"]
    # 0.1 + 0.2 exceeds 0.3 by rounding only.
    rounded = [0.3, 0.1 + 0.2]
    assert not distinguishable(rounded, np.tile(rounded, (9, 1)), better="higher").any()


def test_the_level_holds_for_all_pairs_at_once() -> None:
    rng = np.random.default_rng(3)
    found = 0
    for _ in range(60):  # ten methods that are equally good, each with its own chance
        chance = rng.normal(0.0, 1.0, 10)
        draws = chance + rng.normal(0.0, 1.0, (400, 10))
        found += bool(distinguishable(chance, draws, better="higher").any())
    assert found <= 60 * 0.15


@given(order=st.permutations(range(5)))
def test_ranks_go_with_their_methods(order) -> None:
    values, draws = draws_of(0.2, 0.4, 0.41, 0.42, 0.6)
    ranks = rank_intervals(distinguishable(values, draws, better="higher"))
    turned = rank_intervals(distinguishable(values[order], draws[:, order], better="higher"))
    assert [ranks[at] for at in order] == list(turned)


def test_one_method_has_the_first_rank_and_none_has_none() -> None:
    assert rank_intervals(distinguishable([0.5], np.zeros((3, 1)), better="higher")) == (RankInterval(best=1, worst=1),)
    assert rank_intervals(np.zeros((0, 0))) == ()


def test_figures_that_do_not_fit_are_refused() -> None:
    with pytest.raises(MetricError, match=r"\(M,\)"):
        distinguishable([0.5], np.zeros((3, 2)), better="higher")
    with pytest.raises(MetricError, match="not finite"):
        distinguishable([0.5, math.inf], np.zeros((3, 2)), better="higher")
    with pytest.raises(MetricError, match="not finite"):
        distinguishable([0.5, 0.1], np.full((3, 2), math.nan), better="higher")
    with pytest.raises(MetricError, match="better than each other"):
        rank_intervals([[0, 1], [1, 0]])
