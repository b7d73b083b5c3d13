# SPDX-License-Identifier: Apache-2.0
"""Protection levels of a matcher as rows: what counts, what is unavailable, and levels fitted on other places."""

import math

import numpy as np
import pytest

from sasgeo_bench.boards.board_tables import protection_tables
from sasgeo_bench.matching.matcher import Prediction
from sasgeo_bench.sasgeo.conformal import METHODS, RISKS, SCALE, level_name
from sasgeo_bench.scoring.intervals import wilson
from sasgeo_bench.scoring.protection import ALERT_LIMITS_M, CONFORMAL, protection_frame
from tests.scoring.test_integrity import split_of
from tests.scoring.test_tables import scores

ERRORS = np.array([1.0, 4.0, 15.0, 60.0] * 30)  # of these one in four is a false fix


def told(table, **diagnostics):
    """Answers of all queries with the same diagnostics."""
    return {name: Prediction(query_id=name, diagnostics=diagnostics) for name in table["query_id"]}


def only(frame, method, risk=1e-2, limit_m=25.0):
    (row,) = frame[(frame["method"] == method) & (frame["risk"] == risk) & (frame["alert_limit_m"] == limit_m)].to_dict(
        "records"
    )
    return row


def test_a_row_by_hand():
    table = scores(ERRORS)
    frame = protection_frame("mine", table, told(table, **{level_name("gauss", 1e-2): 10.0}))
    assert frame["alert_limit_m"].tolist() == list(
        ALERT_LIMITS_M
    )  # one method, at one risk: what is not told has no row
    row = only(frame, "gauss")
    assert (row["matcher"], row["n"], row["sites"]) == ("mine", 120, 120.0)
    assert (row["available"], row["unavailable"]) == (1.0, 0.0)
    for area, count in (("misleading", 60), ("hazardous", 30), ("exceeded", 60)):
        expected = wilson(count, 120)
        assert [row[area], row[f"{area}_lo"], row[f"{area}_hi"]] == [expected.value, expected.lo, expected.hi]
    assert row["supports"].startswith("60 of 120 support below ")


def test_no_level_no_answer_and_an_absent_place():
    table = scores([1.0, 1.0, math.inf, math.nan], is_present=[True, True, True, False])
    table["is_answered"] = [True, True, False, True]
    answers = told(table, **{level_name("density", 1e-2): 10.0})
    answers["q00001"] = Prediction(query_id="q00001", diagnostics={level_name("density", 1e-2): math.nan})
    row = only(protection_frame("mine", table, answers), "density")
    # Bounded; no level; no answer; a false fix of infinite error that says 10 m.
    assert (row["available"], row["unavailable"], row["hazardous"], row["exceeded"]) == (0.5, 0.5, 0.25, 0.25)


def test_queries_of_one_site_are_one_trial():
    table = scores(ERRORS, pair_id=np.repeat([f"p{at}" for at in range(12)], 10))
    row = only(protection_frame("mine", table, told(table, **{level_name("gauss", 1e-2): 99.0})), "gauss", limit_m=50.0)
    assert row["sites"] == 12.0
    assert row["unavailable_lo"] == wilson(12, 12).lo


def test_nothing_is_told_where_no_answer_tells_a_level_or_of_another_track():
    table = scores(ERRORS)
    assert protection_frame("mine", table, told(table, margin=1.0), split_of("crossfit")).empty
    retrieval = scores(ERRORS, track="retrieval")
    levels = {level_name(method, risk): 9.0 for method in METHODS for risk in RISKS}
    assert protection_frame("mine", retrieval, told(retrieval, **levels)).empty


def test_conformal_levels_are_fitted_on_other_places():
    # Place 0 errs by 2 m everywhere, place 1 by 20 m: each has the level of the other one.
    names = {"block": [f"b{at % 8}" for at in range(400)], "place": [f"place{at % 2}" for at in range(400)]}
    table = scores(np.where(np.arange(400) % 2, 20.0, 2.0), **names)
    answers = told(table, **{SCALE: 4.0})
    assert protection_frame("mine", table, answers).empty
    frame = protection_frame("mine", table, answers, split_of("crossfit"))
    assert set(frame["method"]) == {CONFORMAL}
    row = only(frame, CONFORMAL)
    assert (row["n"], row["available"], row["exceeded"]) == (400, 1.0, 0.5)
    assert only(frame, CONFORMAL, risk=1e-3)["available"] == 0.0  # 200 answers carry no level at 0.1 %
    held = table.assign(part=np.where(np.arange(400) % 2, "test", "calibration"))
    row = only(protection_frame("mine", held, answers, split_of("holdout")), CONFORMAL)
    assert (row["n"], row["exceeded"]) == (200, 1.0)


@pytest.mark.parametrize("kind", ["crossfit", "holdout"])
def test_without_another_place_there_is_no_conformal_level(kind):
    table = scores(ERRORS, place="place0", part="test")
    assert protection_frame("mine", table, told(table, **{SCALE: 4.0}), split_of(kind)).empty


def test_a_page_shows_one_alert_limit_and_says_where_the_others_are():
    table = scores(ERRORS)
    frame = protection_frame("mine", table, told(table, **{level_name("gauss", 1e-2): 10.0}))
    (shown,) = protection_tables(frame)
    assert shown.title.startswith("Alert limit 25 m, ")
    (row,) = shown.rows
    assert [cell.text.split()[0] for cell in row.cells[:3]] == ["mine", "gauss", "0.010"]
    assert shown.notes == ("Alert limits of 10 and 50 m: protection.parquet holds them.",)
    (alone,) = protection_tables(frame[frame["alert_limit_m"] == 50.0])
    assert (alone.title[:18], alone.notes) == ("Alert limit 50 m, ", ())
    assert not list(protection_tables(frame[:0]))
