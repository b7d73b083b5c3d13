# SPDX-License-Identifier: Apache-2.0
"""Rejection on a board: a matcher's own confidence as a rejector, and answers that leave nothing to choose."""

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from sasgeo_bench.core.errors import MatchError
from sasgeo_bench.geometry.grid import Grid
from sasgeo_bench.geometry.pose import Pose
from sasgeo_bench.matching.matcher import Prediction, RejectorCard
from sasgeo_bench.running.prediction_files import Answers, StoredAnswers
from sasgeo_bench.scoring import rejection
from sasgeo_bench.scoring.decisions import COST_RATIOS, aurc
from sasgeo_bench.scoring.intervals import ClusterDraws, bootstrap_statistic, percentile_interval, wilson
from sasgeo_bench.scoring.rejection import OWN, RejectionTask, Rule, judge, own_confidence, turns, why_not
from sasgeo_bench.scoring.rejection_rows import answers_of, integrity_rows
from sasgeo_bench.scoring.rows import FIGURE_SCHEMA
from sasgeo_bench.tasks.split import SplitFile, make_split
from tests.scoring.test_tables import scores as one_place_a_block

ERRORS = np.where(np.arange(120) % 3 > 0, 1.0, 99.0)  # two of three are right


def scores(errors_m, **changes):
    """Rows of two places by turns, unless other places are given."""
    table = one_place_a_block(errors_m, **changes)
    return table if "place" in changes else table.assign(place=[f"place{at % 2}" for at in range(len(table))])


def rows_of(table, split=None):
    return FIGURE_SCHEMA.frame(list(integrity_rows("mine", OWN, own_confidence(table, split))))


def pooled(table, split=None):
    rows = rows_of(table, split)
    rows = rows[(rows["suite"] == "all suites") & (rows["stratum"] == "as drawn")]
    return {row["metric"]: row for _, row in rows.iterrows()}


def split_of(kind):
    names = ("place0", "place1", "place2", "place3")[: 2 if kind == "holdout" else 4]
    grids = {
        name: Grid(epsg=32632, west_m=5e5 + 1e5 * at, north_m=5.2e6, cell_size_m=1.0, rows=1000, cols=1000)
        for at, name in enumerate(names)
    }
    parts = (
        [{"part": part} for part in ("calibration", "test")]
        if kind == "holdout"
        else [{"half": half} for half in "aabb"]
    )
    places = [{"name": name, "regions": [name]} | part for name, part in zip(names, parts, strict=True)]
    values = {"id": "two", "title": "Two", "kind": kind, "buffer_m": 0.0, "place": places}
    return make_split(SplitFile.model_validate(values), grids)


def test_the_own_word_of_a_matcher_needs_no_split():
    sure = np.where(ERRORS < 25, 0.75, 0.25)
    found = pooled(scores(ERRORS, confidence=sure))
    assert found["e_aurc"]["value"] == 0.0  # every right fix before every false one
    assert found["brier"]["value"] == found["ece"]["value"] ** 2 == 0.0625
    assert found["aurc"]["lo"] < found["aurc"]["value"] < found["aurc"]["hi"]
    assert found["aurc"]["n"] == 120
    assert "coverage_at_risk_0.05" not in found


def test_its_intervals_are_those_of_any_figure():
    table = own_confidence(scores(ERRORS, confidence=np.random.default_rng(1).random(120)))
    found = pooled(table.drop(columns="p_right"))["aurc"]
    rows = rows_of(table)
    assert (rows[(rows["suite"] == "all suites") & (rows["metric"] == "aurc")]["value"] == found["value"]).all()
    some = answers_of(table)
    drawn = ClusterDraws(blocks=table["block"].tolist(), seed=1, draws=1000)
    slow = percentile_interval(aurc(some), bootstrap_statistic(lambda mass: aurc(some, mass), drawn))
    assert (found["lo"], found["hi"]) == pytest.approx((slow.lo, slow.hi), abs=0.02)


def test_equal_confidences_are_worth_as_much_as_chance():
    found = pooled(scores(ERRORS, confidence=0.5))
    assert found["aurc"]["value"] == pytest.approx(1 / 3)  # the share of false fixes at each coverage
    assert found["ece"]["value"] == pytest.approx(2 / 3 - 0.5)
    assert found["cost_20"]["value"] == pytest.approx(2 / 3)  # none is sure enough: two of three right ones withheld
    assert found["cost_20_place"]["value"] == 1.0


def test_a_matcher_that_says_nothing_has_no_own_word():
    assert own_confidence(scores(ERRORS)).empty
    assert rows_of(scores(ERRORS)).empty
    assert rows_of(scores(ERRORS), split_of("crossfit")).empty


def test_answers_without_a_confidence_are_trusted_least_and_leave_calibration_open():
    sure = np.where(ERRORS < 25, 0.9, math.nan)
    found = pooled(scores(ERRORS, confidence=sure))
    assert found["e_aurc"]["value"] == 0.0
    assert math.isnan(found["brier"]["value"])
    assert math.isnan(found["ece"]["value"])


def test_only_tracks_in_which_it_speaks_are_told():
    both = scores(ERRORS, track=["localization", "retrieval"] * 60, confidence=[0.5, math.nan] * 60)
    assert set(rows_of(both)["track"]) == {"localization"}


@pytest.mark.parametrize("error_m", [1.0, 99.0])
def test_nothing_but_right_or_nothing_but_false_fixes_is_told_plainly(error_m):
    is_right = error_m < 25
    table = scores(np.full(120, error_m), confidence=np.random.default_rng(2).random(120))
    found = pooled(table, split_of("crossfit"))
    assert found["aurc"]["value"] == (0.0 if is_right else 1.0)
    expected = wilson(0 if is_right else 120, 120)
    assert (found["aurc"]["lo"], found["aurc"]["hi"], found["aurc"]["interval"]) == (expected.lo, expected.hi, "wilson")
    assert found["e_aurc"]["value"] == 0.0
    assert found["coverage_at_risk_0.05"]["value"] == pytest.approx(1.0 if is_right else 0.0, abs=0.1)
    reached = found["risk_reached_at_0.05"]["value"]
    assert reached == 0.0 if is_right else math.isnan(reached)


def test_ten_queries_of_a_site_are_one_place_to_rejection_too():
    sure = np.random.default_rng(3).random(30)
    one = scores(ERRORS[:30], confidence=sure)
    ten = scores(
        np.repeat(ERRORS[:30], 10),
        confidence=np.repeat(sure, 10),
        **{name: np.repeat(one[name], 10).to_numpy() for name in ("pair_id", "block", "place")},
    )
    for name in ("augrc", "coverage_at_risk_0.05"):
        rows = [pooled(table, split_of("crossfit"))[name][["value", "lo", "hi"]].tolist() for table in (one, ten)]
        assert rows[0] == pytest.approx(rows[1])


def test_thresholds_of_a_split_are_chosen_on_other_places():
    # Place 0 says 0.9 of its right fixes and 0.1 of the false ones; place 1 the other way round.
    at = np.arange(120)
    is_first, is_right = at % 2 == 0, ERRORS < 25
    table = scores(ERRORS, confidence=np.where(is_first == is_right, 0.9, 0.1), block=[f"b{one % 8}" for one in at])
    found = pooled(table, split_of("crossfit"))
    assert found["risk_reached_at_0.05"]["value"] == 1.0
    held = pooled(table.assign(part=np.where(is_first, "calibration", "test")), split_of("holdout"))
    assert held["aurc"]["n"] == 60
    assert held["risk_reached_at_0.01"]["value"] == 1.0
    one_place = table.assign(place="place0")
    assert "coverage_at_risk_0.05" not in pooled(one_place, split_of("crossfit"))


def fitted_by(rejectors):
    """Return what each of some rejectors was fitted on, and asked."""
    return [(sorted(set(one.fitted)), sorted(set(one.asked))) for one in rejectors]


def test_a_threshold_is_set_on_countries_that_its_fit_has_not_seen():
    def fits_on(table):
        made = []
        fits = rejection._Fits(rows=table, answers=table["place"].to_numpy(object), make=lambda: Heard(made))
        assert (fits.held_back(table["part"].to_numpy() == "calibration") == 0.5).all()
        return fitted_by(made)

    places = [f"place{at % 4}" for at in range(120)]
    part = np.where(np.arange(120) < 100, "calibration", "test")
    table = scores(ERRORS).assign(place=places, country=[f"land{at % 2}" for at in range(120)], part=part)
    lands = [["place1", "place3"], ["place0", "place2"]]
    assert fits_on(table) == [(lands[0], lands[1]), (lands[1], lands[0])]
    every = [f"place{at}" for at in range(4)]
    assert fits_on(table.assign(country="land0")) == [([name for name in every if name != one], [one]) for one in every]
    one_place = table.assign(country="land0", place="place0", block=[f"b{at % 2}" for at in range(120)])
    assert fits_on(one_place) == [(["place0"], ["place0"])] * 2
    assert fits_on(one_place.assign(block="b0")) == [(["place0"], ["place0"])]


def split_of_countries():
    """Return a split of five places, of which the first two are of one country and so calibrate neither of both."""
    sides = {"place0": "a", "place1": "a", "place2": "a", "place3": "b", "place4": "b"}
    countries = {"place0": "north", "place1": "north"}
    grids = {
        name: Grid(epsg=32632, west_m=5e5 + 1e5 * at, north_m=5.2e6, cell_size_m=1.0, rows=1000, cols=1000)
        for at, name in enumerate(sides)
    }
    places = [
        {"name": name, "regions": [name], "half": half, "country": countries.get(name, name)}
        for name, half in sides.items()
    ]
    values = {"id": "five", "title": "Five", "kind": "crossfit", "buffer_m": 0.0, "place": places}
    return make_split(SplitFile.model_validate(values), grids)


def judged_table():
    """Rows of five places, a seventh of them absent, and an answer to each."""
    pose = Pose(easting_m=0.0, northing_m=0.0, yaw_deg=0.0)
    table = scores(ERRORS).assign(query_id=[f"q{at}" for at in range(120)], country="land")
    table = table.assign(place=[f"place{at // 2 % 5}" for at in range(120)])
    is_present = np.arange(120) % 7 > 0
    table = table.assign(is_present=is_present, is_right=table["is_right"] & is_present)
    found = [Prediction(query_id=name, candidates=((pose, at % 7),)) for at, name in enumerate(table["query_id"])]
    return table, {item.query_id: item for item in found}


def test_answers_are_read_once_for_all_rejectors_and_judged_as_one_by_one():
    """Rows of two tracks, and each rejector alone with all answers, as a plain loop would."""
    table, answers = judged_table()
    table = table.assign(prior_group=["r500", "r50"] * 60)
    stored, read = Answers.of(answers.values()), []

    def reading():
        read.append(1)
        return stored

    predictions = StoredAnswers({Path(): reading}, dict.fromkeys(table["query_id"], Path()))
    rules = {
        name: Rule(card=replace(Score.card, name=name), make=Score, split=split_of_countries())
        for name in ("one", "two", "broken")
    }
    rules["broken"] = replace(rules["broken"], make=Broken)
    task = RejectionTask(
        matcher="mine", scores=table, predictions=predictions, rules=rules, split=split_of_countries(), is_taught=False
    )
    found = rejection._judged_by_all(task)
    assert len(read) == 2  # of each prior group, and not of each rejector
    plain = judge(table, answers, Score, split_of_countries())
    assert len(plain) == 120
    for name in ("one", "two"):
        both = (frame.set_index("query_id").sort_index() for frame in (found[name], plain))
        pd.testing.assert_frame_equal(*both)
    assert isinstance(found["broken"], MatchError)
    assert rejection._judged_by_all(replace(task, rules={})) == {}
    nothing = rejection._judged_by_all(replace(task, scores=table[:0]))
    assert nothing["one"].columns.tolist() == plain.columns.tolist()
    assert nothing["one"].empty
    unread = rejection._judged_by_all(replace(task, predictions=StoredAnswers({}, {})))
    assert all(isinstance(error, KeyError) for error in unread.values())


def plainly_fitted(known, answers):
    """Return a rejector that is fitted on the answers of some rows."""
    rejector = Score()
    rejector.fit([answers[name] for name in known["query_id"]], ~known["is_right"].to_numpy(bool))
    return rejector


def plainly_judged(turn, table, answers):
    """Return what a turn says of its rows by itself, each fit made anew: `p_right`, and what is decided."""
    known, asked = table[turn.calibration], table[turn.test]
    p_right = 1.0 - plainly_fitted(known, answers).p_false([answers[name] for name in asked["query_id"]])
    unit = "place" if len(set(known["place"])) > 1 else "block"  # all are of one country
    names = sorted(set(known[unit]))
    held_back = known.assign(p_right=math.nan)
    for part in range(5):
        mine = known[unit].isin(names[part::5])
        if mine.any():
            found = plainly_fitted(known[~mine], answers).p_false([answers[name] for name in known[mine]["query_id"]])
            held_back.loc[mine, "p_right"] = 1.0 - found
    return p_right, rejection._decided(held_back, asked.assign(p_right=p_right))


def test_turns_share_fits_on_the_same_rows_and_come_out_as_each_by_itself():
    table, answers = judged_table()
    split, made = split_of_countries(), []
    heard = judge(table, answers, lambda: Heard(made, Score()), split)
    fitted = [frozenset(item.query_id for item in one.fitted) for one in made]
    assert len(fitted) == len(set(fitted))  # none is fitted twice on the same rows
    found = judge(table, answers, Score, split)
    pd.testing.assert_frame_equal(heard, found)
    assert len(found) == len(table)
    for turn in turns(table, split):
        p_right, decided = plainly_judged(turn, table, answers)
        mine = found[found["query_id"].isin(table[turn.test]["query_id"])]
        assert mine["p_right"].tolist() == p_right.tolist()
        for name, values in decided.items():
            np.testing.assert_array_equal(mine[name].to_numpy(float), values)
        assert mine["is_own_calibration"].all()
        assert mine["is_calibrated"].all()


class Heard:
    """Keeps what it is fitted on and asked; says 1/2, or what another rejector says."""

    def __init__(self, made, other=None):
        self.card, self.other, self.asked = Score.card, other, []
        made.append(self)

    def fit(self, predictions, is_false):
        self.fitted = predictions
        if self.other:
            self.other.fit(predictions, is_false)

    def p_false(self, predictions):
        self.asked += predictions
        return self.other.p_false(predictions) if self.other else np.full(len(predictions), 0.5)


class Score:
    """Trusts an answer by its score, and learns which share is false."""

    card = RejectorCard(name="score", version="1", title="Score", source="test", ours="all", licence="Apache-2.0")

    def fit(self, predictions, is_false):
        self.share = float(is_false.mean())
        assert len(predictions) == len(is_false)

    def p_false(self, predictions):
        return np.array([self.share * (1 - item.candidates[0][1] / 10) for item in predictions])


class Broken(Score):
    def p_false(self, predictions):
        raise ValueError(f"no value for {len(predictions)} answers")


def test_what_the_test_place_taught_calibrates_nobody():
    table = scores(ERRORS, confidence=0.5)  # place0 and place1, of one half
    apart = table.assign(place=table["place"].replace("place1", "place2"))  # of two halves
    split = split_of("crossfit")
    for rows, is_taught, expected in (
        (table, False, [True, True]),
        (table, True, [True, True]),
        (apart, False, [False, False]),
        (apart, True, [True, True]),
    ):
        found = list(turns(rows, split, is_taught=is_taught))
        assert [turn.is_own for turn in found] == expected
        assert all(turn.calibration.any() for turn in found) == (rows is table or not is_taught)
        assert not any((turn.test & turn.calibration).any() for turn in found)
    assert "half" in why_not(apart, is_taught=True)


def test_withholding_all_is_no_cost_by_right_fixes_and_the_whole_one_by_places():
    found = pooled(scores(np.full(120, 99.0), confidence=0.0))
    for ratio in COST_RATIOS:
        assert found[f"cost_{ratio:g}"]["value"] == 0.0
        assert found[f"cost_{ratio:g}_place"]["value"] == 1.0


def test_without_an_answer_a_query_is_false_at_full_coverage_and_no_part_of_calibration():
    # Half of the answers are withheld or missing, the others right and sure: risk is 0 up to half of the coverage.
    is_there = np.arange(120) % 2 == 0
    status = np.where(is_there, "ok", np.where(np.arange(120) % 4 == 1, "ok", "missing"))
    table = scores(np.where(is_there, 1.0, math.inf), confidence=np.where(is_there, 0.96, math.nan), status=status)
    found = {name: row["value"] for name, row in pooled(table).items()}
    false = np.arange(1, 61)
    assert found["aurc"] == pytest.approx((false / (60 + false)).sum() / 120)
    assert (found["brier"], found["ece"]) == pytest.approx((0.04**2, 0.04))
    assert (found["cost_20"], found["cost_20_place"]) == (0.0, 0.5)


def test_an_order_that_is_no_probability_has_no_figures_that_judge_one():
    judged = own_confidence(scores(ERRORS, confidence=np.where(ERRORS < 25, 0.75, 0.25)))
    given, bare = (
        {row.metric for row in integrity_rows("mine", "margin", judged, is_calibrated=is_calibrated)}
        for is_calibrated in (True, False)
    )
    costs = {f"cost_{ratio:g}{kind}" for ratio in COST_RATIOS for kind in ("", "_place")}
    assert given - bare == {"brier", "ece", *costs}
    assert {"aurc", "e_aurc", "augrc"} < bare
