# SPDX-License-Identifier: Apache-2.0
"""Intervals hold as often as they say, count blocks instead of queries, and share their draws."""

import math
from itertools import product

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.stats import binomtest, bootstrap

from sasgeo_bench.core.errors import MetricError
from sasgeo_bench.scoring import intervals
from sasgeo_bench.scoring.intervals import (
    BoardDraws,
    ClusterDraws,
    Interval,
    bootstrap_means,
    bootstrap_statistic,
    difference_interval,
    distinct_columns,
    effective_count,
    mean_interval,
    percentile_ends,
    percentile_interval,
    share_interval,
    wilson,
    wilson_mean,
)

BLOCKS = st.lists(st.sampled_from("abcdef"), min_size=2, max_size=15).filter(lambda blocks: len(set(blocks)) > 1)


# Wilson


@pytest.mark.parametrize(
    ("hits", "lo", "hi"), [(129, 0.520, 0.649), (208, 0.907, 0.969), (209, 0.913, 0.972), (210, 0.918, 0.975)]
)
def test_the_intervals_of_the_paper(hits, lo, hi) -> None:
    found = wilson(hits, 220)
    assert (round(found.lo, 3), round(found.hi, 3)) == (lo, hi)


@given(trials=st.integers(1, 400), share=st.floats(0, 1), level=st.sampled_from([0.9, 0.95, 0.99]))
def test_wilson_is_that_of_scipy(trials, share, level) -> None:
    hits = round(share * trials)
    ours = wilson(hits, trials, level=level)
    theirs = binomtest(hits, trials).proportion_ci(level, method="wilson")
    assert (ours.lo, ours.hi) == pytest.approx((theirs.low, theirs.high), abs=1e-9)
    assert ours.lo <= ours.value <= ours.hi


def test_wilson_at_its_ends() -> None:
    # 0 of n: hi = z^2 / (n + z^2).
    assert wilson(0, 10).lo == 0.0
    assert wilson(0, 10).hi == pytest.approx(1.959964**2 / (10 + 1.959964**2), abs=1e-6)
    assert wilson(10, 10).hi == 1.0
    nothing = wilson(0, 0)
    assert math.isnan(nothing.value)
    assert (nothing.lo, nothing.hi) == (0.0, 1.0)
    assert wilson_mean([]).hi == 1.0


def test_none_of_n_reaches_down_to_0_and_all_of_n_up_to_1_without_rounding() -> None:
    ends = [(wilson(0, n).lo, wilson(n, n).hi) for n in range(1, 1001)]
    assert set(ends) == {(0.0, 1.0)}


def test_shared_hits_count_in_proportion() -> None:
    assert wilson_mean([1.0, 0.25, 0.25, 0.5]) == wilson(2, 4)
    with pytest.raises(MetricError, match="shares"):
        wilson_mean([2.0])
    with pytest.raises(MetricError, match="between 0 and the trials"):
        wilson(3, 2)
    with pytest.raises(MetricError, match="level"):
        wilson(1, 2, level=1.0)


# Draws


@given(blocks=BLOCKS, seed=st.integers(0, 2**40))
def test_a_draw_takes_as_many_blocks_as_there_are_and_from_each_as_many_queries_as_it_has(blocks, seed) -> None:
    drawn = ClusterDraws(blocks=blocks, seed=seed, draws=20)
    weights = np.vstack(list(drawn.weights()))
    assert weights.shape == (20, len(blocks))
    names = np.array(blocks)
    copies = np.stack([weights[:, names == name].sum(axis=1) / (names == name).sum() for name in set(blocks)], axis=1)
    assert (copies == np.round(copies)).all()
    assert (copies.sum(axis=1) == len(set(blocks))).all()
    whole = np.vstack(list(ClusterDraws(blocks=blocks, seed=seed, draws=20, draws_within=False).weights()))
    for name in set(blocks):
        assert (np.ptp(whole[:, names == name], axis=1) == 0).all()


def test_the_same_seed_gives_the_same_draws_and_another_seed_others(monkeypatch) -> None:
    blocks = list("aabbbc")
    one, same, other = (ClusterDraws(blocks=blocks, seed=seed, draws=50) for seed in (7, 7, 8))
    values = np.arange(6.0)
    assert bootstrap_means(values, one).tolist() == bootstrap_means(values, same).tolist()
    assert bootstrap_means(values, one).tolist() == bootstrap_means(values, one).tolist()
    assert bootstrap_means(values, one).tolist() != bootstrap_means(values, other).tolist()
    monkeypatch.setattr(intervals, "_CHUNK_CELLS", 6 * 8)
    chunks = list(one.weights())
    assert [len(chunk) for chunk in chunks] == [8] * 6 + [2]
    assert not np.array_equal(chunks[0], chunks[1])


@pytest.mark.parametrize("cells", [1, 7, 2**16])
def test_weights_count_every_site_as_often_as_it_is_drawn_however_many_are_counted_at_once(cells, monkeypatch) -> None:
    monkeypatch.setattr(intervals, "_CACHED_CELLS", cells)
    blocks = np.repeat(np.arange(9), np.arange(9) % 3 + 2)  # blocks of two, three and four queries
    drawn = ClusterDraws(blocks=blocks, places=blocks // 2, seed=3, draws=40)
    ((rows, parts),) = drawn._chunks()
    plain = np.zeros((rows, len(blocks)))
    for part in parts:
        picked = iter(part.within.tolist())
        for draw, at in product(range(rows), range(part.copies.shape[1])):
            for _ in range(part.size * part.copies[draw, at]):
                plain[draw, part.sites[at * part.size + next(picked)]] += 1
        assert next(picked, None) is None
    assert plain.sum() > 0
    assert np.array_equal(np.vstack(list(drawn.weights())), plain)


def test_ends_are_the_draws_in_their_order_with_a_fortieth_beyond_either() -> None:
    table = np.random.default_rng(4).normal(size=(400, 3)).round(1)  # many are equal
    table[::3, 1] = math.nan
    table[:, 2] = math.nan
    lo, hi = percentile_ends(table)
    for at, column in enumerate(table.T.tolist()[:2]):
        known = sorted(value for value in column if not math.isnan(value))
        tail = math.ceil(len(known) / 40) - 1
        assert (lo[at], hi[at]) == (known[tail], known[math.ceil(len(known) * 39 / 40) - 1])
    assert math.isnan(lo[2])
    assert math.isnan(hi[2])


@given(blocks=BLOCKS, draws_within=st.booleans())
def test_sums_are_those_of_the_weights_and_numbers_serve_as_names(blocks, draws_within) -> None:
    drawn = ClusterDraws(blocks=blocks, seed=5, draws=20, draws_within=draws_within)
    table = np.random.default_rng(6).random((len(blocks), 3))
    sums = np.vstack(list(drawn.sums(table)))
    np.testing.assert_allclose(sums, np.vstack(list(drawn.weights())) @ table, rtol=1e-12)
    hits = (table > 0.5).astype(float)  # whole numbers come out whole
    assert np.array_equal(np.vstack(list(drawn.sums(hits))), np.vstack(list(drawn.weights())) @ hits)
    numbers = np.unique(blocks, return_inverse=True)[1]
    same = ClusterDraws(blocks=numbers, seed=5, draws=20, draws_within=draws_within)
    assert np.array_equal(np.vstack(list(same.sums(table))), sums)


@pytest.mark.parametrize("draws_within", [True, False])
def test_the_spread_of_means_is_what_theory_says(draws_within) -> None:
    # B equal blocks of n: variance of block means / B, and with queries drawn the mean variance within / (B n).
    rng = np.random.default_rng(2)
    values = rng.normal(size=(12, 9)) + rng.normal(size=(12, 1))
    blocks = np.repeat([f"block {at}" for at in range(12)], 9)
    drawn = ClusterDraws(blocks=list(blocks), seed=3, draws=20_000, draws_within=draws_within)
    means = bootstrap_means(values.ravel(), drawn)
    expected = values.mean(axis=1).var() / 12
    if draws_within:
        expected += values.var(axis=1).mean() / (12 * 9)
    assert means.var() == pytest.approx(expected, rel=0.05)
    assert means.mean() == pytest.approx(values.mean(), abs=4 * math.sqrt(expected / 20_000))


@given(sites=st.lists(st.integers(0, 9), min_size=1, max_size=25), seed=st.integers(0, 2**40))
def test_the_queries_of_a_site_are_drawn_together_as_one_of_its_block(sites, seed) -> None:
    names = list(dict.fromkeys(sites))
    blocks = [f"block {site % 3}" for site in sites]
    drawn = ClusterDraws(blocks=blocks, sites=[f"site {site}" for site in sites], seed=seed, draws=20)
    weights = np.vstack(list(drawn.weights()))
    alone = ClusterDraws(blocks=[f"block {site % 3}" for site in names], seed=seed, draws=20)
    of_site = np.vstack(list(alone.weights()))
    assert np.array_equal(weights, of_site[:, [names.index(site) for site in sites]])
    table = np.random.default_rng(6).random((len(sites), 3))
    np.testing.assert_allclose(np.vstack(list(drawn.sums(table))), weights @ table, rtol=1e-12)


def test_a_name_of_a_site_in_two_blocks_is_two_sites() -> None:
    drawn = ClusterDraws(blocks=["a", "b"], sites=["p", "p"], seed=1, draws=100)
    weights = np.vstack(list(drawn.weights()))
    assert not np.array_equal(weights[:, 0], weights[:, 1])
    with pytest.raises(MetricError, match="1 blocks for 2 queries"):
        ClusterDraws(blocks=["a", "b"], sites=["p"], seed=1)


@given(blocks=BLOCKS)
def test_the_fast_way_and_the_slow_way_agree(blocks) -> None:
    rng = np.random.default_rng(4)
    drawn = ClusterDraws(blocks=blocks, seed=1, draws=30)
    values, weights = rng.random(len(blocks)), rng.integers(0, 2, len(blocks))
    fast = bootstrap_means(values, drawn, weights)

    def mean(mass: np.ndarray) -> float:
        mass = mass * weights
        return float(mass @ values / mass.sum()) if mass.sum() else math.nan

    np.testing.assert_allclose(bootstrap_statistic(mean, drawn), fast)


def test_two_methods_share_their_draws() -> None:
    rng = np.random.default_rng(5)
    blocks = [f"{at % 7}" for at in range(60)]
    ours, theirs = rng.random(60), rng.random(60)
    drawn = ClusterDraws(blocks=blocks, seed=1, draws=500)
    apart = bootstrap_means(ours - theirs, drawn)
    np.testing.assert_allclose(bootstrap_means(ours, drawn) - bootstrap_means(theirs, drawn), apart)
    side_by_side = bootstrap_means(np.column_stack((ours, theirs)), drawn)
    np.testing.assert_allclose(side_by_side[:, 0] - side_by_side[:, 1], apart)
    found = mean_interval(ours - theirs, drawn)
    assert (found.lo, found.hi) == tuple(np.quantile(apart, [0.025, 0.975], method="inverted_cdf"))
    assert mean_interval(ours - ours, drawn) == Interval(value=0.0, lo=0.0, hi=0.0)
    # A difference that holds for every query is seen however much the queries vary.
    assert mean_interval(ours + 0.01 - ours, drawn).lo == pytest.approx(0.01)


def test_with_a_block_for_each_query_the_interval_is_that_of_scipy() -> None:
    values = np.random.default_rng(6).exponential(size=80)
    ours = mean_interval(values, ClusterDraws(blocks=[str(at) for at in range(80)], seed=1))
    theirs = bootstrap((values,), np.mean, method="percentile", rng=np.random.default_rng(9)).confidence_interval
    assert (ours.lo, ours.hi) == pytest.approx((theirs.low, theirs.high), rel=0.02)


def test_intervals_hold_as_often_as_they_say_and_only_if_blocks_are_counted() -> None:
    rng = np.random.default_rng(8)
    blocks = [f"{at // 10}" for at in range(300)]
    alone = [str(at) for at in range(300)]
    held, naive = 0, 0
    for trial in range(150):
        values = (rng.normal(size=(30, 10)) + rng.normal(size=(30, 1))).ravel()  # mean 0, correlation 1/2
        for names in (blocks, alone):
            found = mean_interval(values, ClusterDraws(blocks=names, seed=trial, draws=400))
            is_held = found.lo <= 0.0 <= found.hi
            held, naive = held + (is_held and names is blocks), naive + (is_held and names is alone)
    assert 0.90 <= held / 150 <= 0.99
    assert naive / 150 < 0.75


# Figures with intervals


def test_a_figure_of_one_block_has_no_interval() -> None:
    found = mean_interval([1.0, 0.0], ClusterDraws(blocks=["a", "a"], seed=1, draws=50))
    assert found.value == 0.5
    assert math.isnan(found.lo)
    assert math.isnan(found.hi)
    nothing = mean_interval([], ClusterDraws(blocks=[], seed=1, draws=50))
    assert math.isnan(nothing.value)
    assert math.isnan(nothing.hi)


def test_draws_without_a_query_that_counts_are_left_out() -> None:
    drawn = ClusterDraws(blocks=["a", "b"], seed=1, draws=200)
    means = bootstrap_means([1.0, 0.0], drawn, [1.0, 0.0])
    assert 0.15 < np.isnan(means).mean() < 0.35  # block b twice
    assert percentile_interval(1.0, means) == Interval(value=1.0, lo=1.0, hi=1.0)
    assert math.isnan(percentile_interval(1.0, [math.nan]).lo)


def test_what_cannot_be_is_refused() -> None:
    drawn = ClusterDraws(blocks=["a", "b"], seed=1, draws=5)
    for values in ([1.0], [1.0, math.inf], [1.0, math.nan], 1.0, [[[1.0]], [[1.0]]]):
        with pytest.raises(MetricError, match="finite"):
            bootstrap_means(values, drawn)
    with pytest.raises(MetricError, match="shape"):
        mean_interval([1.0], drawn)
    with pytest.raises(MetricError, match="draws"):
        ClusterDraws(blocks=["a"], seed=1, draws=0)
    with pytest.raises(MetricError, match="weights"):
        bootstrap_means([1.0, 0.0], drawn, [1.0, -1.0])


# Few sites


def test_sites_count_by_their_mass() -> None:
    assert effective_count(["p", "q", "p", "q", "r", "r"]) == pytest.approx(3)
    # Masses 9 and 1: 100 / 82.
    assert effective_count([0] * 9 + [1]) == pytest.approx(100 / 82)
    assert effective_count(["p", "q", "r"], [1.0, 1.0, 0.0]) == 2
    assert effective_count([]) == effective_count(["p"], [0.0]) == 0


def test_an_interval_is_the_wider_of_both_at_each_end() -> None:
    # z^2 = 3.8415: of 3 in 4 Wilson's is (0.75 + 0.4802 -+ 1.96 sqrt(0.1875 / 4 + 0.0600)) / 1.9604.
    lo, hi = 0.30064, 0.95441
    narrow, wide = np.array([0.7, 0.75, 0.8]), np.linspace(0.2, 1.0, 1001)
    few = share_interval(0.75, (narrow, narrow), 4)
    assert (few.lo, few.hi, few.how) == (pytest.approx(lo, abs=1e-4), pytest.approx(hi, abs=1e-4), "wilson")
    by_place = share_interval(0.75, (wide, narrow), 4)
    assert (by_place.lo, by_place.hi, by_place.how) == (pytest.approx(0.22), pytest.approx(0.98), "places")
    assert (by_place.lo_blocks, by_place.hi_blocks) == (few.lo, few.hi)
    by_block = share_interval(0.75, (narrow, wide), 4)
    assert (by_block.lo, by_block.hi, by_block.how) == (by_place.lo, by_place.hi, "blocks")
    one_sided = share_interval(0.75, (np.linspace(0.5, 1.0, 1001), narrow), 4)
    assert (one_sided.lo, one_sided.hi) == (pytest.approx(lo, abs=1e-4), pytest.approx(0.9875))
    assert one_sided.how == "wilson"
    alone = share_interval(0.75, ([], []), 4)
    assert (alone.lo, alone.hi, alone.how) == (wilson(3, 4).lo, wilson(3, 4).hi, "wilson")
    nothing = share_interval(math.nan, ([math.nan], [math.nan]), 4)
    assert math.isnan(nothing.lo)
    assert nothing.how == ""


@given(
    sites=st.lists(st.integers(0, 6), min_size=2, max_size=40),
    seed=st.integers(0, 2**30),
    shares=st.tuples(st.floats(0, 1), st.floats(0, 1)),
)
def test_who_is_right_wherever_another_one_is_has_no_lower_end(sites, seed, shares) -> None:
    lot = np.random.default_rng(seed).random(len(sites))
    table = np.column_stack([lot < share for share in sorted(shares)] + [np.ones(len(sites))]).astype(float)
    places = [str(site % 2) for site in sites]
    drawn = BoardDraws.of(places, [str(site % 4) for site in sites], sites, seed=seed, draws=50)
    means = drawn.means(table)
    values = table.mean(axis=0)
    ends = [share_interval(values[at], (means[0][:, at], means[1][:, at]), drawn.trials) for at in range(3)]
    assert sorted(end.lo for end in ends) == [end.lo for end in ends]
    assert sorted(end.hi for end in ends) == [end.hi for end in ends]


def test_a_difference_of_shares_has_both_their_doubts() -> None:
    ours, theirs = Interval(value=0.5, lo=0.2, hi=0.8), Interval(value=0.1, lo=0.0, hi=0.5)
    found = difference_interval(ours, theirs)
    assert (found.value, found.lo, found.hi) == pytest.approx((0.4, 0.4 - 0.5, 0.4 + math.hypot(0.3, 0.1)))


# Places


@given(
    places=st.lists(st.integers(0, 4), min_size=1, max_size=12),
    seed=st.integers(0, 2**40),
)
def test_a_draw_takes_as_many_places_as_there_are_and_from_each_as_many_blocks_as_it_has(places, seed) -> None:
    blocks = np.repeat(np.arange(len(places)), 2)  # two queries a block
    of_query = np.array(places)[blocks]
    drawn = ClusterDraws(blocks=blocks, places=of_query, seed=seed, draws=20)
    weights = np.vstack(list(drawn.weights()))
    assert drawn.units_count == len(set(places))
    copies = np.stack([weights[:, of_query == one].sum(axis=1) / (of_query == one).sum() for one in set(places)])
    assert (copies == np.round(copies)).all()
    assert (copies.sum(axis=0) == len(set(places))).all()
    table = np.random.default_rng(6).random((len(blocks), 2))
    np.testing.assert_allclose(np.vstack(list(drawn.sums(table))), weights @ table, rtol=1e-12)


def test_places_that_differ_widen_what_their_blocks_make_narrow() -> None:
    # Four places of ten blocks, right everywhere in two of them and nowhere in the others.
    places, blocks = np.repeat(np.arange(4), 10), np.arange(40)
    hits = (places < 2).astype(float)[:, None]
    by_place, by_block = BoardDraws.of(places, blocks, blocks, seed=1, draws=2000).means(hits)
    assert by_place.std() == pytest.approx(0.25, abs=0.02)  # sqrt(1/4 / 4)
    assert by_block.std() == pytest.approx(0.079, abs=0.02 * 0.4)  # sqrt(1/4 / 40)
    with pytest.raises(MetricError, match="two places"):
        ClusterDraws(blocks=["a", "a"], places=["p", "q"], seed=1)


@given(
    rows=st.integers(1, 5).flatmap(
        lambda count: st.lists(st.tuples(*[st.sampled_from([0.0, 0.5, 1.0])] * count), min_size=1, max_size=9)
    )
)
def test_distinct_columns_are_each_once_and_make_up_the_table(rows) -> None:
    table = np.array(rows)
    columns, code = distinct_columns(table)
    np.testing.assert_array_equal(columns[:, code], table)
    assert len({*map(tuple, columns.T)}) == columns.shape[1]
    assert sorted({*code.tolist()}) == list(range(columns.shape[1]))
