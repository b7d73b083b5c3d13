# SPDX-License-Identifier: Apache-2.0
"""Recall and reciprocal rank: ties as in all their orders, misses counted, monotone in k."""

import itertools
import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from sklearn.metrics import label_ranking_average_precision_score, top_k_accuracy_score

from sasgeo_bench.core.errors import MetricError
from sasgeo_bench.geometry.pose import Pose
from sasgeo_bench.matching.matcher import Prediction, candidates_at
from sasgeo_bench.running.prediction_files import Answers
from sasgeo_bench.scoring.base import weighted_mean
from sasgeo_bench.scoring.pose import (
    MISS,
    Rank,
    Ranks,
    hits,
    rank_candidate,
    rank_of,
    reciprocal_ranks,
)

POSSIBLE = st.tuples(st.integers(0, 6), st.integers(1, 6), st.integers(1, 6)).map(
    lambda numbers: Rank(above=numbers[0], tied=max(numbers[1:]), right=min(numbers[1:]))
)
RANKS = st.lists(st.one_of(POSSIBLE, st.just(MISS)), min_size=1, max_size=8)
ANSWER = st.lists(st.tuples(st.integers(0, 2), st.booleans()), min_size=1, max_size=5)


def recall(ranks, k, weights=None):
    return weighted_mean(hits(ranks, k), weights)


def mean_reciprocal_rank(ranks):
    return weighted_mean(reciprocal_ranks(ranks))


def places_in_all_orders(answer: list[tuple[int, bool]]) -> list[float]:
    """Place of the first right pose in every order of the list that its scores allow; infinite without one."""
    return [
        next((at + 1 for at, (_, right) in enumerate(order) if right), math.inf)
        for order in itertools.permutations(answer)
        if all(one[0] >= other[0] for one, other in itertools.pairwise(order))
    ]


@settings(max_examples=30)
@given(answer=ANSWER)
def test_ties_count_as_the_mean_over_all_their_orders(answer) -> None:
    ranks = Ranks.of([rank_of(*zip(*answer, strict=True))])
    places = np.array(places_in_all_orders(answer))
    for k in range(1, len(answer) + 2):
        assert hits(ranks, k)[0] == pytest.approx((places <= k).mean())
    assert reciprocal_ranks(ranks)[0] == pytest.approx((1 / places).mean())


def test_a_table_worked_by_hand() -> None:
    # First; third behind two; one of four tied for the first place; missing from the list.
    ranks = Ranks.of(
        [
            rank_of([3, 2, 1], [True, False, False]),
            rank_of([3, 2, 1], [False, False, True]),
            rank_of([5, 5, 5, 5], [False, True, False, False]),
            rank_of([3, 2, 1], [False, False, False]),
        ]
    )
    assert recall(ranks, 1) == (1 + 0 + 1 / 4 + 0) / 4
    assert recall(ranks, 2) == (1 + 0 + 2 / 4 + 0) / 4
    assert recall(ranks, 5) == 3 / 4
    assert mean_reciprocal_rank(ranks) == pytest.approx((1 + 1 / 3 + (1 + 1 / 2 + 1 / 3 + 1 / 4) / 4) / 4)
    assert recall(ranks, 1, weights=[0, 0, 3, 1]) == 3 / 4 / 4


def test_of_several_right_poses_tied_with_wrong_ones_any_counts() -> None:
    # Two right of four tied: both are left out of the first two in 1 of 6 choices.
    assert hits(Ranks.of([Rank(above=0, tied=4, right=2)]), 2)[0] == pytest.approx(5 / 6)


@given(ranks=RANKS)
def test_recall_is_monotone_in_k_and_ends_at_the_share_that_is_found(ranks) -> None:
    table = Ranks.of(ranks)
    curve = [hits(table, k) for k in range(1, 15)]
    for one, other in itertools.pairwise(curve):
        assert (one <= other).all()
    assert curve[-1].tolist() == [float(rank.right > 0) for rank in ranks]


@given(ranks=RANKS)
def test_the_reciprocal_rank_is_at_least_recall_at_1(ranks) -> None:
    table = Ranks.of(ranks)
    assert recall(table, 1) <= mean_reciprocal_rank(table) + 1e-12 <= 1.0 + 1e-9


@given(ranks=RANKS)
def test_the_order_of_queries_does_not_matter(ranks) -> None:
    table, turned = Ranks.of(ranks), Ranks.of(ranks[::-1])
    assert recall(table, 2) == pytest.approx(recall(turned, 2))
    assert mean_reciprocal_rank(table) == pytest.approx(mean_reciprocal_rank(turned))


def test_without_ties_figures_are_those_of_scikit_learn() -> None:
    rng = np.random.default_rng(5)
    scores, right = rng.random((40, 12)), rng.integers(0, 12, 40)
    is_right = np.arange(12) == right[:, None]
    table = Ranks.of([rank_of(*pair) for pair in zip(scores, is_right, strict=True)])
    for k in (1, 2, 5, 10):
        assert recall(table, k) == pytest.approx(top_k_accuracy_score(right, scores, k=k, labels=range(12)))
    assert mean_reciprocal_rank(table) == pytest.approx(label_ranking_average_precision_score(is_right, scores))


def test_a_matcher_that_ties_everything_is_at_chance() -> None:
    table = Ranks.of([rank_of([1.0] * 50, np.arange(50) == at) for at in (0, 7, 49)])
    assert recall(table, 1) == pytest.approx(1 / 50)
    assert recall(table, 5) == pytest.approx(5 / 50)


def test_no_queries_have_no_recall_and_one_has() -> None:
    nothing = Ranks.of([])
    assert math.isnan(recall(nothing, 1))
    assert math.isnan(mean_reciprocal_rank(nothing))
    assert recall(Ranks.of([MISS]), 200) == 0.0
    assert recall(Ranks.of([Rank(above=0, tied=1, right=1)]), 1) == 1.0


# Answers of matchers


def pose(east_m: float) -> Pose:
    return Pose(easting_m=east_m, northing_m=0.0, yaw_deg=0.0)


CANDIDATES = [pose(1000.0 * at) for at in range(5)]


def answer(*given: tuple[int, float], **more: object) -> Prediction:
    return Prediction(query_id="q", candidates=tuple((CANDIDATES[at], score) for at, score in given), **more)


def test_an_answer_that_is_taken_for_a_candidate_is_one_when_it_is_read(truth_of) -> None:
    rng = np.random.default_rng(0)
    for angle, gap_m, (east_m, north_m) in zip(
        rng.uniform(0, 2 * math.pi, 200), rng.uniform(0.04, 0.05, 200), rng.uniform(0, 1000, (200, 2)), strict=True
    ):
        one = Pose(easting_m=east_m, northing_m=north_m, yaw_deg=0.0)
        near = Pose(
            easting_m=east_m + gap_m * math.cos(angle), northing_m=north_m + gap_m * math.sin(angle), yaw_deg=0.0
        )
        read = Answers.of([Prediction(query_id="q", candidates=((near, 1.0),))]).found["q"]
        assert candidates_at(near, [one]) == [0]
        assert rank_candidate(read, truth_of(candidate=0), [one]).right == 1


def test_the_right_candidate_is_found_by_its_place(truth_of) -> None:
    found = rank_candidate(answer((2, 9.0), (4, 8.0), (3, 8.0)), truth_of(candidate=3), CANDIDATES)
    assert found == Rank(above=1, tied=2, right=1)
    refined = Prediction(query_id="q", candidates=((Pose(easting_m=3000.01, northing_m=0.0, yaw_deg=7.0), 1.0),))
    assert rank_candidate(refined, truth_of(candidate=3), CANDIDATES) == Rank(above=0, tied=1, right=1)


def test_two_candidates_on_one_spot_are_two(truth_of) -> None:
    twins = [pose(0.0), pose(0.0), pose(9000.0)]
    both = Prediction(query_id="q", candidates=((twins[0], 2.0), (twins[1], 1.0)))
    assert rank_candidate(both, truth_of(candidate=0), twins) == Rank(above=0, tied=1, right=1)
    assert rank_candidate(both, truth_of(candidate=1), twins) == Rank(above=1, tied=1, right=1)


@pytest.mark.parametrize(
    "prediction",
    [None, answer(), answer((1, 1.0)), answer((3, 1.0), status="crash"), answer((3, 1.0), status="timeout")],
    ids=["no row", "withheld", "truth not in the list", "crash", "timeout"],
)
def test_whatever_gives_no_right_pose_is_a_miss(prediction, truth_of) -> None:
    assert rank_candidate(prediction, truth_of(candidate=3), CANDIDATES) == MISS


def test_an_absent_place_is_no_query_of_recall(truth_of) -> None:
    with pytest.raises(MetricError, match="leave absent places out"):
        rank_candidate(answer((1, 1.0)), truth_of(candidate=-1), CANDIDATES)


def test_what_cannot_be_is_refused() -> None:
    with pytest.raises(MetricError, match="at least 1"):
        hits(Ranks.of([MISS]), 0)
    with pytest.raises(MetricError, match="right <= tied"):
        Rank(above=0, tied=1, right=2)
    with pytest.raises(MetricError, match="shape"):
        rank_of([1.0, 2.0], [True])
