# SPDX-License-Identifier: Apache-2.0
"""The rejectors: what they read of an answer, worked by hand; what they learn; and that nothing upsets them."""

import math
import tomllib
from dataclasses import replace
from importlib import import_module
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from sasgeo_baselines.rejectors import leads
from sasgeo_baselines.rejectors.entropy import Entropy
from sasgeo_baselines.rejectors.inliers import Inliers
from sasgeo_baselines.rejectors.isotonic_margin import IsotonicMargin
from sasgeo_baselines.rejectors.ks_gate import KsGate
from sasgeo_baselines.rejectors.logistic_all import LogisticAll
from sasgeo_baselines.rejectors.margin import Margin
from sasgeo_baselines.rejectors.margin_nms import MarginNms
from sasgeo_baselines.rejectors.nearest_score import NearestScore
from sasgeo_baselines.rejectors.ratio_spread import RatioSpread
from sasgeo_baselines.rejectors.score_ratio import ScoreRatio
from sasgeo_baselines.rejectors.similarity_distribution import SimilarityDistribution
from sasgeo_baselines.rejectors.statistical_uncertainty import StatisticalUncertainty
from sasgeo_baselines.rejectors.sue import SLOPES, UNTAUGHT, Sue
from sklearn.isotonic import IsotonicRegression

from sasgeo_bench.geometry.pose import Pose
from sasgeo_bench.matching.matcher import Prediction, check_p_false
from sasgeo_bench.matching.plugins import load_rejector

PROJECT = tomllib.loads((Path(__file__).parents[2] / "baselines" / "pyproject.toml").read_text(encoding="utf-8"))
REGISTERED = PROJECT["project"]["entry-points"]["sasgeo_bench.rejectors"]
OF_SCORES = (RatioSpread, ScoreRatio, SimilarityDistribution, StatisticalUncertainty)
RULES = (
    *(Margin, MarginNms, Entropy, Inliers, KsGate, NearestScore, Sue),
    *OF_SCORES,
)
LEARNERS = (IsotonicMargin, LogisticAll)
WITHHELD = Prediction(query_id="withheld")
SCORES = st.lists(st.floats(allow_nan=False, allow_infinity=False), min_size=1, max_size=12)
DIAGNOSTICS = st.dictionaries(st.sampled_from(("a", "b", "inliers", "ks_share")), st.floats(), max_size=3)


def answer(*scores: float, step_m: float = 30.0, **diagnostics: float) -> Prediction:
    """Candidates in a row, so far apart."""
    poses = [Pose(easting_m=at * step_m, northing_m=0.0, yaw_deg=0.0) for at in range(len(scores))]
    return Prediction(query_id="q", candidates=tuple(zip(poses, scores, strict=True)), diagnostics=diagnostics)


ANSWERS = st.builds(
    lambda scores, step_m, diagnostics: replace(
        answer(*sorted(scores, reverse=True), step_m=step_m), diagnostics=diagnostics
    ),
    SCORES,
    st.sampled_from((0.0, 1.0, 10.0, 30.0, 1e6)),
    DIAGNOSTICS,
)


def toy(count: int = 60, seed: int = 0) -> tuple[list[Prediction], np.ndarray]:
    """Answers of which the right ones lead by more, and see more."""
    rng = np.random.default_rng(seed)
    is_false = rng.random(count) < 0.4
    made = [
        answer(
            2.0,
            2.0 - abs(rng.normal(0.2 if wrong else 0.8, 0.2)),
            0.5,
            seen=rng.normal(0.3 if wrong else 0.7, 0.1),
            noise=rng.normal(),
        )
        for wrong in is_false
    ]
    return made, is_false


# Cards and doors


@pytest.mark.parametrize("name", REGISTERED)
def test_a_rejector_is_registered_under_the_name_of_its_card(name) -> None:
    rejector = load_rejector(REGISTERED[name])
    assert rejector.card.name == name
    assert rejector.card.licence == "Apache-2.0"
    assert rejector.card.limits
    assert rejector.card.is_calibrated == isinstance(rejector, LEARNERS)


def test_every_rejector_is_registered() -> None:
    folder = Path(import_module("sasgeo_baselines.rejectors").__file__).parent
    files = {path.stem for path in folder.glob("*.py")} - {"__init__", "leads"}
    assert set(REGISTERED) == files == {rule.card.name for rule in (*RULES, *LEARNERS)}


@pytest.mark.parametrize("rule", [*RULES, *LEARNERS])
def test_withheld_answers_are_false_and_nobody_asked_is_nobody_answered(rule) -> None:
    rejector = rule()
    rejector.fit(*toy())
    assert rejector.p_false([WITHHELD, replace(WITHHELD, status="timeout")]).tolist() == [1.0, 1.0]
    assert rejector.p_false([WITHHELD, answer(1.0, 0.0)])[1] < 1.0
    assert rejector.p_false([]).shape == (0,)


@pytest.mark.parametrize("rule", [*RULES, *LEARNERS])
@given(calibration=st.lists(st.tuples(ANSWERS, st.booleans()), max_size=8), asked=st.lists(ANSWERS, max_size=4))
def test_whatever_is_told_makes_a_probability(rule, calibration, asked) -> None:
    rejector = rule()
    rejector.fit([item for item, _ in calibration], np.array([wrong for _, wrong in calibration], dtype=bool))
    check_p_false(rejector.p_false([*asked, WITHHELD]), len(asked) + 1)


@pytest.mark.parametrize("rule", [*RULES, *LEARNERS])
def test_an_answer_is_judged_alone_and_a_second_fit_says_the_same(rule) -> None:
    answers, is_false = toy()
    first, second = rule(), rule()
    first.fit(answers, is_false)
    second.fit(*toy(seed=5))
    second.fit(answers, is_false)
    whole = first.p_false(answers)
    assert second.p_false(answers).tolist() == whole.tolist()
    np.testing.assert_allclose([first.p_false([item])[0] for item in answers], whole, atol=1e-9)


# By hand


def test_the_margin_is_the_lead_over_the_second() -> None:
    assert leads.margin(answer(5.0, 3.0, 2.0)) == 2.0
    assert leads.margin(answer(5.0)) == 0.0
    assert Margin().p_false([answer(5.0, 3.0), answer(1.0, 1.0), answer(7.0)]).tolist() == [1 / 4, 1 / 2, 1 / 2]


def test_a_rival_is_another_place() -> None:
    assert leads.margin_nms(answer(5.0, 4.0, 3.0, 1.0, step_m=12.5)) == 2.0  # 12.5 m away is the same, 25 m is not
    assert leads.margin_nms(answer(5.0, 4.0, 3.0, step_m=1.0)) == 2.0  # none given is one: no better than the last
    assert leads.margin_nms(answer(5.0)) == 0.0
    assert MarginNms().p_false([answer(5.0, 4.0, 3.0, step_m=12.5)]).tolist() == [1 / 4]


def test_entropy_is_that_of_a_softmax_over_standardised_scores() -> None:
    # Scores 4, 1, 1: mean 2, deviation sqrt(2); z = 1.414, -0.707, -0.707.
    weights = np.exp([math.sqrt(2), -math.sqrt(0.5), -math.sqrt(0.5)])
    shares = weights / weights.sum()
    assert leads.entropy(answer(4.0, 1.0, 1.0)) == pytest.approx(-(shares * np.log(shares)).sum())
    found = Entropy().p_false([answer(3.0, 3.0, 3.0, 3.0), answer(3.0), answer(4.0, 1.0, 1.0)])
    np.testing.assert_allclose(found[:2], [3 / 4, 1 / 2])
    assert found[2] < 2 / 3


@given(scores=st.lists(st.integers(-50, 50), min_size=2, max_size=9), gain=st.floats(0.01, 100))
def test_entropy_knows_no_scale_and_is_greatest_for_equals(scores, gain) -> None:
    ranked = sorted(map(float, scores), reverse=True)
    found = leads.entropy(answer(*ranked))
    assert leads.entropy(answer(*(gain * score + 3 for score in ranked))) == pytest.approx(found, abs=1e-6)
    assert 0 <= found <= math.log(len(scores)) + 1e-12


@pytest.mark.parametrize("rule", [Margin, MarginNms])
@given(one=st.floats(0, 1e6), more=st.floats(1e-6, 1e6))
def test_a_larger_lead_is_a_smaller_number(rule, one, more) -> None:
    less, larger = rule().p_false([answer(0.0, -one), answer(0.0, -one - more)])
    assert 0 < larger < less <= 1 / 2


# Learnt


@pytest.mark.parametrize("learner", [*LEARNERS, Sue])
def test_a_learner_says_that_it_must_be_fitted(learner) -> None:
    with pytest.raises(RuntimeError, match="fit"):
        learner().p_false([WITHHELD])


@pytest.mark.parametrize("learner", LEARNERS)
@pytest.mark.parametrize(("wrong", "expected"), [(True, 4 / 5), (False, 1 / 5)])
def test_calibration_of_one_kind_says_one_number_that_is_not_certain(learner, wrong, expected) -> None:
    rejector = learner()
    rejector.fit([answer(2.0, lead) for lead in (0.0, 1.0, 1.5)] + [WITHHELD], np.array([wrong] * 3 + [not wrong]))
    assert rejector.p_false([answer(9.0, 0.0), answer(0.0, 0.0), WITHHELD]).tolist() == [expected, expected, 1.0]


@pytest.mark.parametrize("learner", LEARNERS)
def test_calibration_of_nothing_says_one_half(learner) -> None:
    rejector = learner()
    rejector.fit([], np.zeros(0, dtype=bool))
    assert rejector.p_false([answer(1.0, 0.0)]).tolist() == [0.5]


def test_isotonic_agrees_with_scikit_learn_and_averages_ties() -> None:
    answers, is_false = toy()
    answers, is_false = [*answers, answer(1.0, 0.7), answer(1.0, 0.7)], np.array([*is_false, True, False])
    rejector = IsotonicMargin()
    rejector.fit(answers, is_false)
    margins = np.array([leads.margin(item) for item in answers])
    curve = IsotonicRegression(increasing=False, out_of_bounds="clip").fit(margins, is_false)
    np.testing.assert_allclose(rejector.p_false(answers), curve.predict(margins))
    beyond = rejector.p_false([answer(99.0, 0.0), answer(0.0, 0.0)])
    np.testing.assert_allclose(beyond, curve.predict([margins.max(), margins.min()]))
    order = np.argsort(margins)
    assert (np.diff(rejector.p_false(answers)[order]) <= 0).all()


def test_logistic_learns_from_a_diagnostic_that_no_score_tells() -> None:
    seen = np.linspace(0, 1, 40)
    rejector = LogisticAll()
    rejector.fit([answer(1.0, 0.5, seen=value) for value in seen], seen < 0.5)
    low, lacking, high = rejector.p_false([answer(1.0, 0.5, seen=0.1), answer(1.0, 0.5), answer(1.0, 0.5, seen=0.9)])
    assert low > 0.9
    assert lacking == pytest.approx(0.5, abs=0.05)  # as the median of calibration
    assert high < 0.1


def test_logistic_takes_the_diagnostics_that_all_of_calibration_give() -> None:
    answers = [answer(1.0, 0.5, both=float(at), one=1.0 if at else math.nan) for at in range(4)]
    answers[3] = replace(answers[3], diagnostics={"both": 3.0})
    rejector = LogisticAll()
    rejector.fit([*answers, WITHHELD], np.array([True, False, True, False, True]))
    assert rejector._model.names == ("both",)


def test_a_feature_that_never_changed_in_calibration_says_nothing_later() -> None:
    rejector = LogisticAll()
    rejector.fit([answer(1.0, lead, still=0.1) for lead in (0.1, 0.2, 0.8, 0.9)], np.array([False, False, True, True]))
    same, other = rejector.p_false([answer(1.0, 0.5, still=0.1), answer(1.0, 0.5, still=1e9)])
    assert same == pytest.approx(other, abs=1e-6)


# Of the literature on place recognition


def doubt(rule, *answers, calibration=()):
    rejector = rule()
    rejector.fit(calibration, np.ones(len(calibration), dtype=bool))
    return rejector.p_false(answers).tolist()


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


def test_spreads_of_many_answers_are_those_of_each_by_itself():
    """Answers of one to twelve candidates; weights, mean place and variance in plain numpy, one by one."""
    rng, slope, expected = np.random.default_rng(0), 3.0, []
    some = [answer(*rng.random(count), step_m=float(rng.uniform(1.0, 200.0))) for count in rng.integers(1, 13, 40)]
    rejector = Sue()
    rejector._slope = slope
    for item in some:
        first = item.candidates[:10]
        weights = np.exp(slope * np.array([score for _, score in first]))
        places = np.array([(pose.easting_m, pose.northing_m) for pose, _ in first])
        away = np.minimum(np.abs(places - np.average(places, axis=0, weights=weights)), 500.0)
        variance = np.average(away**2, axis=0, weights=weights).mean()
        expected.append(0.5 if len(first) == 1 else variance / (variance + 25.0**2))
    assert rejector.p_false(some) == pytest.approx(expected)
    assert rejector.p_false(some[::-1]).tolist() == rejector.p_false(some)[::-1].tolist()


def test_how_far_the_first_stands_out_by_hand():
    """The others have mean 2 and deviation 1: a lead of 4 is four deviations."""
    assert doubt(SimilarityDistribution, answer(6.0, 3.0, 1.0), answer(6.0, 3.0)) == pytest.approx([1 / 6, 1 / 2])


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
