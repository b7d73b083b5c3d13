# SPDX-License-Identifier: Apache-2.0
"""Rejectors of the literature on place recognition: cases worked by hand, and the property that each must have."""

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from sasgeo_baselines.rejectors import leads
from sasgeo_baselines.rejectors.inliers import Inliers
from sasgeo_baselines.rejectors.nearest_score import NearestScore
from sasgeo_baselines.rejectors.ratio_spread import RatioSpread
from sasgeo_baselines.rejectors.score_ratio import ScoreRatio
from sasgeo_baselines.rejectors.similarity_distribution import SimilarityDistribution
from sasgeo_baselines.rejectors.statistical_uncertainty import StatisticalUncertainty
from sasgeo_baselines.rejectors.sue import SLOPES, UNTAUGHT, Sue

from sasgeo_bench.geometry.pose import Pose
from sasgeo_bench.matching.matcher import check_p_false
from sasgeo_bench.matching.results import Prediction

OF_SCORES = (RatioSpread, ScoreRatio, SimilarityDistribution, StatisticalUncertainty)
RULES = (Inliers, NearestScore, *OF_SCORES, Sue)
WITHHELD = Prediction(query_id="withheld")
SCORES = st.lists(st.floats(allow_nan=False, allow_infinity=False), min_size=1, max_size=12)
NOBODY = np.zeros(0, dtype=bool)


def answer(*scores, step_m=30.0, **diagnostics):
    """Candidates in a row, so far apart."""
    poses = [Pose(easting_m=at * step_m, northing_m=0.0, yaw_deg=0.0) for at in range(len(scores))]
    return Prediction(query_id="q", candidates=tuple(zip(poses, scores, strict=True)), diagnostics=diagnostics)


def doubt(rule, *answers, calibration=()):
    rejector = rule()
    rejector.fit(calibration, np.ones(len(calibration), dtype=bool))
    return rejector.p_false(answers).tolist()


@pytest.mark.parametrize("rule", RULES)
@given(scores=SCORES, step_m=st.sampled_from((0.0, 10.0, 1e6)), told=st.floats())
def test_whatever_is_told_makes_a_number_from_0_to_1(rule, scores, step_m, told):
    asked = replace(answer(*sorted(scores, reverse=True), step_m=step_m), diagnostics={"inliers": told})
    rejector = rule()
    rejector.fit([], NOBODY)
    alone = check_p_false(rejector.p_false([asked]), 1)
    both = check_p_false(rejector.p_false([WITHHELD, asked]), 2)
    assert both.tolist() == [1.0, *alone.tolist()]
    assert rejector.p_false([]).shape == (0,)


@pytest.mark.parametrize("rule", [*OF_SCORES, Sue])
def test_one_candidate_alone_says_one_half(rule):
    assert doubt(rule, answer(7.0), answer(-7.0)) == [0.5, 0.5]


@pytest.mark.parametrize("rule", OF_SCORES)
def test_a_tie_says_one_half_and_a_weaker_rival_less(rule):
    tie, near, far = doubt(rule, *(answer(1.0, other, other / 2) for other in (1.0, 0.9, 0.2)))
    assert doubt(rule, answer(1.0, 1.0, 1.0)) == [0.5]
    assert 0.5 >= tie > near > far > 0


@pytest.mark.parametrize("rule", [*OF_SCORES, Sue])
@given(
    scores=st.lists(st.floats(0.01, 100), min_size=2, max_size=6),
    gain=st.floats(0.01, 100),
    sign=st.sampled_from((1, -1)),
)
def test_the_unit_of_scores_does_not_matter(rule, scores, gain, sign):
    ranked = sorted((sign * score for score in scores), reverse=True)
    one, other = (answer(*(unit * score for score in ranked)) for unit in (1.0, gain))
    assert doubt(rule, one, calibration=[one]) == pytest.approx(doubt(rule, other, calibration=[other]), abs=1e-6)


@given(one=st.floats(-1e9, 1e9), more=st.floats(1e-3, 1e9))
def test_a_better_first_score_is_less_doubted(one, more):
    less, larger = doubt(NearestScore, answer(one), answer(one + more, one))
    assert larger <= less


def test_the_first_score_alone_by_hand():
    assert doubt(NearestScore, answer(2.0, 1.9), answer(0.0), answer(-2.0)) == [1 / 4, 1 / 2, 3 / 4]


def test_ratios_by_hand():
    assert doubt(ScoreRatio, answer(4.0, 3.0, 2.9), answer(-1.0, -4.0), answer(4.0, -1.0)) == [3 / 8, 1 / 8, 0.0]
    assert leads.ratios(np.array([0.0, 0.0, -1.0])).tolist() == [1.0, 0.0]


def test_the_spread_of_places_by_hand():
    """Two that tie 50 m apart: 25 m from their mean, in one of two axes."""
    found = doubt(Sue, answer(1.0, 1.0, step_m=50.0), answer(1.0, 1.0, step_m=0.0), answer(1.0, 1.0, step_m=1e5))
    half = 25.0**2 / 2
    assert found[:2] == pytest.approx([half / (half + 25.0**2), 0.0])
    assert found[2] == pytest.approx(500.0**2 / 2 / (500.0**2 / 2 + 25.0**2))


def test_places_that_score_less_spread_less_and_the_eleventh_not_at_all():
    assert doubt(Sue, answer(1.0, 0.2, 0.1)) < doubt(Sue, answer(1.0, 1.0, 1.0))
    ten = [1.0 - 0.01 * at for at in range(10)]
    assert doubt(Sue, answer(*ten)) == pytest.approx(doubt(Sue, answer(*ten, 0.9)))


def led(lead):
    """One candidate that leads eight, which tie, from the middle of their row."""
    made = answer(1.0, *[1.0 - lead] * 8)
    (first, score), *others = made.candidates
    return replace(made, candidates=((replace(first, easting_m=135.0), score), *others))


@given(lead=st.floats(0.0, 0.9), more=st.floats(0.01, 0.1))
def test_a_larger_lead_at_equal_places_spreads_less(lead, more):
    less, larger = doubt(Sue, led(lead), led(lead + more), calibration=[led(0.5)])
    assert larger < less


def test_the_slope_is_the_one_that_best_tells_false_fixes_of_calibration():
    """A place that ties tells a false fix: at any slope if it is far off, else not at the gentlest."""
    right, far, near = answer(1.0, 0.0, 0.0), answer(1.0, 1.0, 0.0, step_m=100.0), answer(1.0, 1.0, 0.0)
    usual = float(np.std([1.0, 0.0, 0.0]))
    rejector = Sue()
    rejector.fit([right, right, far], np.array([False, False, True]))
    assert (rejector._slope, rejector.remark) == (SLOPES[0] / usual, "")
    rejector.fit([right, right, near], np.array([False, False, True]))
    assert rejector._slope == SLOPES[1] / usual
    rejector.fit([right, right], np.array([True, True]))
    assert rejector._slope == UNTAUGHT / usual
    assert "one kind" in rejector.remark


def test_how_far_the_first_stands_out_by_hand():
    """The others have mean 2 and deviation 1: a lead of 4 is four deviations."""
    assert doubt(SimilarityDistribution, answer(6.0, 3.0, 1.0), answer(6.0, 3.0)) == pytest.approx([1 / 6, 1 / 2])


def test_a_small_lead_over_others_that_tie_is_no_certainty():
    """Their deviation counts as 0.01 of the first score: leads of one and of fifty such."""
    assert doubt(SimilarityDistribution, answer(1.0, 0.99, 0.99), answer(1.0, 0.5, 0.5)) == pytest.approx(
        [1 / 3, 1 / 52]
    )


def test_the_product_of_both_by_hand():
    """A lead of four deviations, and ratios 1/2 and 1/6: 1/2 and 5/6 from the first."""
    ratios = math.sqrt((1 / 4 + 25 / 36) / 2)
    found = doubt(StatisticalUncertainty, answer(6.0, 3.0, 1.0), answer(6.0, 3.0), answer(1.0, 0.99, 0.99))
    assert found == pytest.approx([1 / (2 + 4 * ratios), 1 / 2, 1 / 2.01])


def test_the_spread_of_ratios_by_hand():
    """Ratios 0.4 and 0.2 are 0.6 and 0.8 from the first: root mean square 0.7071."""
    assert doubt(RatioSpread, answer(10.0, 4.0, 2.0)) == pytest.approx([(1 - math.sqrt(0.5)) / 2])


def test_inliers_are_those_of_the_first_diagnostic_that_is_given():
    found = doubt(
        Inliers,
        answer(1.0, inliers=8.0, inlier_ratio=0.1),
        answer(1.0, inliers=math.nan, inlier_ratio=0.5),
        answer(1.0, features=9.0),
        answer(1.0, inliers=-3.0),
    )
    assert found == [1 / 10, 1 / 2.5, 1 / 2, 1 / 2]


@pytest.mark.parametrize("rule", RULES)
def test_a_card_says_that_it_is_not_calibrated(rule):
    assert not rule.card.is_calibrated
    assert rule.card.limits
