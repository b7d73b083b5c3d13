# SPDX-License-Identifier: Apache-2.0
"""Limits and requirements: what a text asks, what it adds to a board, and what an interval shows of it."""

import math

import numpy as np
import pandas as pd
import pytest

from sasgeo_bench.core.errors import ConfigError
from sasgeo_bench.scoring.cost import Costs
from sasgeo_bench.scoring.flights import score_flights
from sasgeo_bench.scoring.metrics import METRICS
from sasgeo_bench.scoring.rejection import own_confidence
from sasgeo_bench.scoring.rejection_rows import integrity_rows
from sasgeo_bench.scoring.requirements import (
    FAILS,
    NOT_SHOWN,
    PASSES,
    compliance_frame,
    flown_metric,
    own_metrics,
    parse_requirements,
    with_own,
    within_metrics,
)
from sasgeo_bench.scoring.rows import FIGURE_SCHEMA
from sasgeo_bench.scoring.tables import cost_figures, leaderboard
from tests.scoring.test_flights import a_flight, answers
from tests.scoring.test_tables import scores


@pytest.mark.parametrize(
    ("text", "bound", "is_least", "figures"),
    [
        ("80% within 50 m", 0.8, True, {"localization": "within_50m", "sequence": "distance_within_50m"}),
        ("12.5 % within 2.5m", 0.125, True, {"localization": "within_2.5m", "sequence": "distance_within_2.5m"}),
        (
            "50%  within 5 m and 2 deg",
            0.5,
            True,
            {"localization": "success_5m_2deg", "sequence": "distance_within_5m_2deg"},
        ),
        (
            "90% within 25 m and 5 deg",
            0.9,
            True,
            {"localization": "success_25m", "sequence": "distance_within_25m_5deg"},
        ),
        ("90% within 3 deg", 0.9, True, {"localization": "within_3deg", "sequence": "distance_within_3deg"}),
        (
            "p95 latency 400 ms",
            0.95,
            True,
            dict.fromkeys(("localization", "retrieval", "sequence"), "latency_within_0.4s"),
        ),
        (
            "false <= 3%",
            0.03,
            False,
            dict.fromkeys(("localization", "retrieval"), "risk_reached_at_0.01") | {"sequence": "false_of_accepted"},
        ),
        ("continuity_60s >= 99%", 0.99, True, {"sequence": "continuity_60s"}),
        ("available_45s >= 90%", 0.9, True, {"sequence": "available_45s"}),
        ("false_of_confirmed_5x10m <= 1%", 0.01, False, {"sequence": "false_of_confirmed_5x10m"}),
        ("position_p95 <= 30 m", 30.0, False, {"localization": "position_p95"}),
        ("fix_age_p95_s <= 1500 ms", 1.5, False, {"sequence": "fix_age_p95_s"}),
    ],
)
def test_a_text_says_which_figure_must_be_how_large(text, bound, is_least, figures):
    (found,) = parse_requirements([text])
    assert (found.bound, found.is_least, dict(found.figures)) == (pytest.approx(bound), is_least, figures)
    shipped = {metric.name for metric in METRICS}
    assert {own.metric.name for own in found.own} == set(figures.values()) - shipped


@pytest.mark.parametrize(
    ("text", "fault"),
    [
        ("", "--require says '', which is no requirement: say it as in '80% within 50 m'"),
        ("80 within 50 m", "which is no requirement"),
        ("80% within 50", "'50' is no limit, which is metres, degrees or both, as in 50m or 5m,2deg"),
        ("80% within 50 m and 20 m", "is no limit"),
        ("80% within 0 m", "is no limit"),
        ("80% within 200 deg", "is no limit"),
        ("180% within 50 m", "180 is no share, which is above 0 and at most 100 %"),
        ("p95 latency 400", "which is no requirement"),
        ("p95 latency 0 ms", "no answer comes within 0 ms, give a time above 0"),
        ("false >= 1%", "'false' is no metric"),
        ("continuity_60 >= 99%", "'continuity_60' is no metric: did you mean 'continuity_60s'?"),
        ("latency_p95 <= 1 s", "a metric without an interval on each suite"),
        ("aurc <= 10%", "a metric without an interval on each suite"),
        ("position_p95 <= 30%", "position_p95 is in m: give its unit"),
        ("continuity_60s >= 10 s", "continuity_60s is a share, as in 90%: give its unit"),
        ("continuity_60s >= 120%", "continuity_60s lies within 0 and 1: give a bound that it may keep or miss"),
    ],
)
def test_a_text_that_says_none_is_quoted_in_a_line_with_its_fault(text, fault):
    with pytest.raises(ConfigError) as raised:
        parse_requirements([text])
    assert fault in str(raised.value)
    assert "\n" not in str(raised.value)
    assert repr(text) in str(raised.value)


@pytest.mark.parametrize("percent", ["7", "57", "99.9"])
def test_a_share_that_equals_the_bound_passes(percent):
    reached = float(f"{percent}e-2")
    for text in (f"{percent}% within 50 m", f"continuity_60s >= {percent}%", f"p{percent} latency 1 s"):
        (one,) = parse_requirements([text])
        assert one.verdict(reached, reached) == "passes", text


@pytest.mark.parametrize("text", ["", "5", "5m,5m", "m", "5m;2deg", "-5m", "infm"])
def test_a_limit_that_is_none_is_quoted(text):
    with pytest.raises(ConfigError, match="is no limit"):
        within_metrics(text)


def test_commas_part_requirements_and_none_counts_twice():
    found = parse_requirements(["80% within 50 m, 50% within 20 m", "80%  within 50 m"])
    assert [one.text for one in found] == ["80% within 50 m", "50% within 20 m"]
    names = [own.metric.name for own in own_metrics(["50m", "25m"], found)]
    assert names == ["within_50m", "within_20m", "distance_within_20m"]  # others are on every board
    with pytest.raises(ConfigError, match="is named 'within_50m'"):
        own_metrics(["50m"], others={"within_50m"})


def board_of(frames, requirements, views=None):
    """Return the figures of some matchers, with what requirements add to them."""
    own = own_metrics((), requirements)
    ranked = leaderboard(with_own(own, frames, views or {}), draws=200, more=[one.metric for one in own])
    costs = [cost_figures(name, costs_of(frame)) for name, frame in frames.items()]
    return pd.concat([ranked, *costs], ignore_index=True)


def costs_of(frame):
    return Costs(scores=frame, runs=(), view_bytes=dict.fromkeys(frame["query_id"], 1), area_km2={})


def test_a_verdict_is_of_the_worse_end_of_an_interval_and_of_the_better_one():
    rng = np.random.default_rng(3)
    near, mixed = (np.where(rng.random(400) < share, 10.0, 90.0) for share in (0.97, 0.8))
    frames = {
        "near": scores(near, blocks=40),
        "mixed": scores(mixed, blocks=40),
        "far": scores(np.full(400, 90.0), blocks=40),
    }
    requirements = parse_requirements(["80% within 50 m"])
    found = compliance_frame(requirements, board_of(frames, requirements)).set_index("matcher")
    assert found["verdict"].to_dict() == {"near": PASSES, "mixed": NOT_SHOWN, "far": FAILS}
    for name, errors_m in (("near", near), ("mixed", mixed)):
        assert found.loc[name, "figure"] == np.mean(errors_m <= 50)
        lo, hi = found.loc[name, ["figure_lo", "figure_hi"]]
        assert lo < found.loc[name, "figure"] < hi
        assert (lo >= 0.8) == (name == "near")
    assert found["n"].tolist() == [400] * 3
    assert found["accepted"].isna().all()


def test_stress_counts_where_anything_is_stressed_and_controls_of_the_board_are_not_judged():
    table = pd.concat(
        [scores([90.0] * 20), scores([1.0] * 20, role="control", query_id=[f"c{at}" for at in range(20)])]
    )
    requirements = parse_requirements(["50% within 40 m"])
    board = board_of({"mine": table, "random": table}, requirements)
    (row,) = compliance_frame(requirements, board).to_dict("records")
    assert (row["matcher"], row["stratum"], row["n"], row["figure"]) == ("mine", "stress", 20, 0.0)


def test_an_answer_in_time_is_one_that_was_read_in_time_and_without_a_clock_nothing_is_shown():
    table = scores([1.0, 2.0, math.inf, math.inf, 3.0, 4.0] * 20, blocks=20)
    late = table.assign(
        latency_s=[0.4, 0.41, 0.1, 0.3, math.nan, 0.2] * 20,
        status=["ok", "ok", "ok", "timeout", "crash", "ok"] * 20,
    )
    requirements = parse_requirements(["p30 latency 400 ms"])
    board = board_of({"late": late, "unknown": table.assign(latency_s=math.nan)}, requirements)
    found = compliance_frame(requirements, board).set_index("matcher")
    assert found.loc["late", "figure"] == 0.5
    assert found.loc["late", "verdict"] == PASSES
    assert (found.loc["unknown", "verdict"], math.isnan(found.loc["unknown", "figure"])) == (NOT_SHOWN, True)


def test_false_fixes_are_of_the_accepted_answers_of_each_rejector_and_nothing_accepted_shows_nothing():
    columns = {name: scores([1.0])[name].iloc[0] for name in ("suite", "track", "prior_group")}
    base = pd.DataFrame([columns | {"matcher": "mine", "is_applicable": True, "unit": "1", "n": 50}] * 6)
    board = base.assign(
        rejector=["own", "own", "margin", "margin", "", ""],
        stratum=["as drawn"] * 4 + ["all"] * 2,
        metric=["risk_reached_at_0.01", "coverage_at_risk_0.01"] * 2 + ["success_25m", "latency_p50"],
        value=[0.02, 0.4, math.nan, 0.0, 0.5, 0.1],
        lo=[0.0, 0.3, math.nan, 0.0, 0.4, math.nan],
        hi=[0.1, 0.5, math.nan, 0.1, 0.6, math.nan],
    )
    found = compliance_frame(parse_requirements(["false <= 1%"]), board).set_index("rejector")
    assert found["verdict"].to_dict() == {"own": NOT_SHOWN, "margin": NOT_SHOWN}
    assert found["accepted"].to_dict() == {"own": 0.4, "margin": 0.0}
    better, worse = (board.assign(**ends) for ends in ({"hi": 0.01}, {"lo": 0.011}))
    verdicts = [
        compliance_frame(parse_requirements(["false <= 1%"]), one).set_index("rejector").loc["own", "verdict"]
        for one in (better, worse)
    ]
    assert verdicts == [PASSES, FAILS]


def test_thresholds_of_a_real_rejector_are_read_as_the_board_has_them():
    table = scores([5.0] * 60 + [90.0] * 20, blocks=8, confidence=[0.9] * 60 + [0.1] * 20)
    rows = FIGURE_SCHEMA.frame(integrity_rows("mine", "own", own_confidence(table)))
    requirements = parse_requirements(["false <= 5%"])
    found = compliance_frame(requirements, pd.concat([board_of({"mine": table}, requirements), rows]))
    assert len(found) == 1  # without a split no threshold was chosen
    assert (found["verdict"].iloc[0], found["n"].iloc[0]) == (NOT_SHOWN, 0)


def test_limits_of_flights_are_of_the_way_and_of_all_views_of_a_flight():
    flights = [a_flight(21, f"f{at:02}") for at in range(12)]
    heads, truths = ([one for flight in flights for one in flight[part]] for part in (0, 1))
    off_m = np.random.default_rng(1).uniform(0.0, 40.0, len(truths))
    given = answers(truths, off_m=off_m.tolist())
    scored = score_flights(heads, truths, given)
    requirements = parse_requirements(["50% within 20 m, 90% within 15 m and 1 deg, p99 latency 500 ms, false <= 60%"])
    board = board_of({"mine": scored.flights}, requirements, {"mine": scored.views})
    found = compliance_frame(requirements, board).set_index("requirement")
    weights = np.tile(np.r_[0.5, np.ones(19), 0.5] / 20, 12)
    for text, limit_m in (("50% within 20 m", 20.0), ("90% within 15 m and 1 deg", 15.0)):
        assert found.loc[text, "figure"] == pytest.approx((weights * (off_m <= limit_m)).sum() / 12)
    assert found.loc["90% within 15 m and 1 deg", "verdict"] == FAILS
    assert (found.loc["p99 latency 500 ms", "figure"], found["n"].unique().tolist()) == (1.0, [12])
    assert found.loc["false <= 60%", "figure"] == pytest.approx(np.mean(off_m > 25))
    assert found.loc["false <= 60%", "accepted"] == pytest.approx(1.0)


def test_a_tracker_that_accepts_nothing_is_not_shown_to_be_right():
    heads, truths = ([one for at in range(12) for one in a_flight(11, f"f{at:02}")[part]] for part in (0, 1))
    scored = score_flights(heads, truths, answers(truths, accepted=[False] * len(truths)))
    requirements = parse_requirements(["false <= 50%"])
    (row,) = compliance_frame(requirements, board_of({"mine": scored.flights}, requirements)).to_dict("records")
    assert (row["figure"], row["accepted"], row["verdict"]) == (0.0, 0.0, NOT_SHOWN)
    assert row["figure_hi"] < 0.5  # of the interval alone it would pass


def flights(seed=0):
    """Rows of two flights' views by hand: times, fixes, the true way due north, and an exact odometer."""
    rng = np.random.default_rng(seed)
    rows = []
    for name, count in (("a", 60), ("b", 40)):
        for frame in range(count):
            off_m = float(rng.choice([0.0, 12.0, 60.0]))
            rows.append(
                {"sequence_id": name, "time_s": 5.0 * frame, "distance_m": 50.0 * frame, "is_carried": False}
                | {"is_accepted": bool(rng.random() < 0.6), "true_east_m": 0.0, "true_north_m": 50.0 * frame}
                | {"true_yaw_deg": 0.0, "east_m": off_m, "north_m": 50.0 * frame, "yaw_deg": 0.0, "error_m": off_m}
                | {"increment": None if frame == 0 else (0.0, 50.0, 0.0)}
            )
    return pd.DataFrame(rows)


def test_constants_of_ones_own_are_those_of_the_name_of_a_figure():
    views = flights()
    values = {name: flown_metric(name).of_views(views) for name in ("available_12s", "continuity_25s")}
    for name, part in views.groupby("sequence_id"):
        fixes_s = part.loc[part["is_accepted"], "time_s"].to_numpy()
        moments_s = np.arange(0, part["time_s"].max(), 0.01) + 0.005

        def age(at_s, fixes_s=fixes_s):
            at = np.searchsorted(fixes_s, at_s, side="right") - 1
            return np.where(at >= 0, at_s - fixes_s[np.maximum(at, 0)], np.inf)

        assert values["available_12s"][name] == pytest.approx(np.mean(age(moments_s) <= 12), abs=1e-3)
        early_s = moments_s[moments_s <= part["time_s"].max() - 25]
        has = age(early_s) <= 30
        holds = np.all([age(early_s + more) <= 30 for more in np.arange(0, 25.01, 0.25)], axis=0)
        assert values["continuity_25s"][name] == pytest.approx(np.mean(holds[has]), abs=0.01)


@pytest.mark.parametrize(("count", "near_m"), [(2, 5), (3, 25), (4, 13)])
def test_a_rule_of_ones_own_confirms_fixes_in_a_row_that_agree(count, near_m):
    views = flights(1)
    right = flown_metric(f"right_confirmed_{count}x{near_m}m").of_views(views)
    false = flown_metric(f"false_of_confirmed_{count}x{near_m}m").of_views(views)
    for name, part in views.groupby("sequence_id"):
        fixes = [(at, row.east_m) for at, row in enumerate(part.itertuples()) if row.is_accepted]
        # The odometer is exact and all head north: fixes agree if they are off alike.
        confirmed = [
            fixes[last]
            for last in range(count - 1, len(fixes))
            if all(abs(fixes[at][1] - fixes[at + 1][1]) <= near_m for at in range(last - count + 1, last))
        ]
        wrong = sum(off_m > 25 for _, off_m in confirmed)
        assert right[name] == pytest.approx((len(confirmed) - wrong) / len(part))
        assert false[name] == pytest.approx(wrong / max(1, len(confirmed)))


@pytest.mark.parametrize(
    "text", ["right_confirmed_1x5m >= 1%", "available_0s >= 1%", "false_of_confirmed_3x0m <= 1%", "available_s >= 1%"]
)
def test_a_constant_that_is_none_is_no_metric(text):
    with pytest.raises(ConfigError, match="is no metric"):
        parse_requirements([text])
