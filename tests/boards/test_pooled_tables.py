# SPDX-License-Identifier: Apache-2.0
"""Figures over many queries: their points are those of the board, and nobody is spared a query."""

import numpy as np
import pandas as pd
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sasgeo_bench.boards.pooled_plots import (
    ablation_frame,
    cost_frame,
    draw_prices,
    draw_recall,
    errors_frame,
    front_of,
    price_frame,
    recall_frame,
)
from sasgeo_bench.geometry.pose import Pose
from sasgeo_bench.matching.matcher import Prediction
from sasgeo_bench.running.prediction_files import StoredAnswers
from sasgeo_bench.scoring.contrasts import Contrast, evaluate_contrasts
from sasgeo_bench.scoring.decisions import COST_RATIOS
from sasgeo_bench.scoring.rejection import own_confidence
from sasgeo_bench.scoring.rejection_rows import integrity_rows
from sasgeo_bench.scoring.rows import FIGURE_SCHEMA
from sasgeo_bench.scoring.tables import leaderboard
from sasgeo_bench.tasks.query import Truth
from tests.scoring.test_tables import scores

COUNT = 60
AT = np.arange(COUNT)


def place(easting_m):
    return Pose(easting_m=float(easting_m), northing_m=0.0, yaw_deg=0.0)


def answered(errors_m, **changes):
    return scores(np.array(errors_m, dtype=float), suite="occlusion", **changes)


def truth_of(name):
    row = {
        "candidate": -1,
        "pair_id": "p",
        "role": "stress",
        "kind": "U1",
        "strength": 0.3,
        "strength_unit": "share",
    }
    row |= {"unknown_share": 0.0, "changed_share": 0.0, "feature_density": 0.1, "alias_index": 0.2, "scene": "urban"}
    return Truth(query_id=name, is_present=True, pose=place(0), block="b", **row)


@pytest.fixture(scope="module")
def listed():
    """Two matchers whose lists hold the right place at their third pose in every second query, and what they scored."""
    first = answered(np.where(AT % 3 == 0, 4.0, 300.0))
    second = answered(np.where(AT % 4 == 0, 4.0, np.inf))
    tables = {"one": first, "two": second}
    answers = {}
    for name, frame in tables.items():
        answers[name] = StoredAnswers.of(
            Prediction(
                query_id=query,
                candidates=((place(error), 9.0), (place(500), 5.0), (place(10 if at % 2 else 600), 1.0))
                if np.isfinite(error)
                else (),
            )
            for at, (query, error) in enumerate(zip(frame["query_id"], frame["position_error_m"], strict=True))
        )
    return tables, answers, {query: truth_of(query) for query in first["query_id"]}


def test_recall_of_the_first_pose_is_the_share_within_25_m_and_it_never_falls(listed):
    tables, answers, truths = listed
    rows = recall_frame(tables, answers, truths, ["one", "two"])
    board = leaderboard(tables, draws=100)
    result = board[(board["metric"] == "within_25m") & (board["stratum"] == "stress")].set_index("matcher")["value"]
    for name, mine in rows.groupby("matcher"):
        assert mine["k"].tolist() == [1, 2, 3]
        assert mine["value"].iloc[0] == pytest.approx(result[name])
        assert mine["value"].is_monotonic_increasing
        assert (mine["lo"] <= mine["value"]).all()
    one = rows[(rows["matcher"] == "one") & (rows["k"] == 3)]["value"].iloc[0]
    assert one == pytest.approx(np.mean((AT % 3 == 0) | (AT % 2 == 1)))  # by hand: at first, or as the third
    assert set(rows["n"]) == {COUNT}  # withheld answers are in the denominator


def test_recall_of_retrieval_is_that_of_the_board(listed):
    _, answers, truths = listed
    right = scores(np.zeros(COUNT), track="retrieval").assign(above=AT % 3, tied=1, right=1, pool=20)
    rows = recall_frame({"one": right}, answers, truths, ["one"])
    board = leaderboard({"one": right}, draws=100)
    result = board[(board["metric"] == "recall_1") & (board["stratum"] == "stress")]["value"].iloc[0]
    assert rows["value"].tolist() == pytest.approx([result, 2 / 3, 1.0])


def test_answers_of_one_pose_have_no_curve_of_recall(listed):
    tables, answers, truths = listed
    first = {
        name: StoredAnswers.of(Prediction(query_id=query, candidates=one.candidates[:1]) for query, one in mine.items())
        for name, mine in answers.items()
    }
    assert recall_frame(tables, first, truths, ["one", "two"]).empty


def test_a_curve_of_errors_passes_through_the_figure_of_the_board_and_ends_below_one(listed):
    tables, _, _ = listed
    board = leaderboard(tables, draws=100)
    rows = errors_frame(tables, board, ["one", "two"])
    result = board[(board["metric"] == "within_25m") & (board["stratum"] == "stress")].set_index("matcher")
    for name, mine in rows.groupby("matcher"):
        (at,) = mine[mine["radius_m"] == 25.0].to_dict("records")
        assert (at["value"], at["lo"], at["hi"]) == tuple(result.loc[name, ["value", "lo", "hi"]])
        assert mine["value"].is_monotonic_increasing
    two = rows[rows["matcher"] == "two"]
    assert two["value"].iloc[-1] == pytest.approx(np.mean(AT % 4 == 0))  # what is not answered is never near
    assert errors_frame({"one": tables["one"].assign(track="retrieval")}, board, ["one"]).empty


def test_a_curve_of_costs_passes_through_the_figures_of_the_board():
    frame = answered(np.where(AT % 3 == 0, 300.0, 4.0)).assign(is_right=AT % 3 > 0)
    frame = frame.assign(confidence=np.where(AT % 3, 0.97, 0.4), is_answered=True)
    judged = {("one", "own"): own_confidence(frame)}
    board = FIGURE_SCHEMA.frame(list(integrity_rows("one", "own", judged["one", "own"])))
    rows = cost_frame(judged, {("one", "own")}, ["one"])
    for ratio in COST_RATIOS:
        result = board[(board["metric"] == f"cost_{ratio:g}_place") & (board["suite"] == "all suites")]["value"].iloc[0]
        assert rows.loc[rows["ratio"] == ratio, "cost"].tolist() == [pytest.approx(result)]
    at = rows[rows["ratio"] == 5.0].iloc[0]
    assert (at["withhold_all"], at["accept_all"]) == (1.0, pytest.approx(5.0 / 3.0))
    assert cost_frame(judged, set(), ["one"]).empty  # what gives no probabilities has no such cost


def test_a_pool_is_that_of_its_contrasts_and_has_those_who_were_asked_all_of_it():
    one, two = answered(np.where(AT % 3 == 0, 4.0, 300.0)), answered(np.where(AT % 4 == 0, 4.0, 300.0))
    tables = {"one": one, "two": two, "spared": one.iloc[:10]}
    contrasts = [
        Contrast(name=name, first="one", second="two", suites=("occlusion",), kinds=kinds)
        for name, kinds in (("a", ()), ("b", ()), ("c", ("U1",)))
    ]
    (finding, *_) = evaluate_contrasts(contrasts, tables, {}, draws=100)
    rows = ablation_frame(tables, contrasts, ["one", "two", "spared"])
    assert list(dict.fromkeys(rows["pool"])) == ["a, b", "c"]
    mine = rows[rows["pool"] == "a, b"].set_index("matcher")
    assert set(mine.index) == {"one", "two"}
    assert (mine.loc["one", "value"], mine.loc["two", "value"]) == (finding.first_value, finding.second_value)
    assert set(mine["n"]) == {finding.n}
    assert list(dict.fromkeys(ablation_frame(tables, [], ["one", "two"])["pool"])) == ["all suites"]


def test_who_cannot_answer_has_no_bar_and_no_line(listed):
    tables, answers, truths = listed
    unable = {**tables, "two": tables["two"].assign(status="not applicable", is_answered=False)}
    board = leaderboard(tables, draws=100)
    for rows in (
        ablation_frame(unable, [], ["one", "two"]),
        recall_frame(unable, answers, truths, ["one", "two"]),
        errors_frame(unable, board, ["one", "two"]),
        price_frame(board, unable, ["one", "two"]),
    ):
        assert set(rows["matcher"]) == {"one"}


def test_prices_are_of_the_suites_that_most_were_asked_and_of_the_queries_that_the_first_figure_counts():
    first = answered(np.full(COUNT, 4.0)).assign(role=np.where(AT % 2, "stress", "control"))
    other = first.assign(suite="clean", query_id=[f"x{at}" for at in AT])
    tables = {"one": first, "two": pd.concat([first, other]), "three": other, "four": first}
    rows = price_frame(leaderboard({"one": first}, draws=100), tables, list(tables))
    assert rows["matcher"].tolist() == ["one", "two", "four"]
    assert set(rows["suites"]) == {"occlusion"}
    assert set(rows["n"]) == {COUNT // 2}


def test_prices_are_those_of_the_board_on_the_queries_that_all_were_asked(tmp_path):
    one = answered(np.where(AT % 3 == 0, 4.0, 300.0))
    more = answered(np.full(COUNT, 4.0)).assign(suite="clean", query_id=[f"x{at}" for at in AT])
    tables = {"one": pd.concat([one, more], ignore_index=True), "two": one}
    values = {"rejector": "", "suite": "all suites", "stratum": "all", "prior_group": "all"}
    costs = [
        {"matcher": "one", "track": "localization", "metric": "latency_p50", "value": 0.5, **values},
        {"matcher": "one", "track": "localization", "metric": "latency_p95", "value": np.inf, **values},
        {"matcher": "one", "track": "all", "metric": "map_per_km2", "value": 40.0, **values},
    ]
    rows = price_frame(pd.DataFrame(costs), tables, ["one", "two"])
    assert rows["suites"].tolist() == ["occlusion"] * 2  # `one` alone was asked the easy ones
    assert rows["value"].tolist() == pytest.approx([1 / 3, 1 / 3])
    first, second = rows.to_dict("records")
    assert (first["latency_s"], first["slow_s"], first["map_kb_per_km2"]) == (0.5, np.inf, 40.0)
    assert np.isnan(second["latency_s"])
    for name in ("a.svg", "b.svg"):
        draw_prices(tmp_path / name, rows, ["one", "two"])
    text = (tmp_path / "a.svg").read_text(encoding="utf-8")
    assert (tmp_path / "b.svg").read_text(encoding="utf-8") == text
    assert "latency of two; map of two." in " ".join(text.replace("\n", " ").split())
    draw_prices(tmp_path / "c.svg", rows.assign(latency_s=[0.5, 0.1]), ["one"])
    text = (tmp_path / "c.svg").read_text(encoding="utf-8")
    assert "1 more matcher, named where on the front" in " ".join(text.replace("\n", " ").split())
    assert text.count(">two<") == 1  # as cheap as can be; its map is of unknown size


def test_recall_is_drawn_with_its_n_and_the_same_bytes_each_time(listed, tmp_path):
    tables, answers, truths = listed
    rows = recall_frame(tables, answers, truths, ["one", "two"])
    for name in ("a.svg", "b.svg"):
        draw_recall(tmp_path / name, rows, ["one", "two"])
    text = (tmp_path / "a.svg").read_text(encoding="utf-8")
    assert (tmp_path / "b.svg").read_text(encoding="utf-8") == text
    assert f"n {COUNT}, 4 blocks" in text


@given(st.lists(st.tuples(st.integers(1, 5), st.integers(0, 5)), min_size=1, max_size=9))
def test_what_is_off_the_front_is_beaten_by_something_on_it(points):
    cost, value = (np.array(column, dtype=float) for column in zip(*points, strict=True))
    is_on = front_of(cost, value)
    assert is_on.any()
    for at in np.flatnonzero(~is_on):
        beaten = (cost[is_on] <= cost[at]) & (value[is_on] >= value[at])
        assert beaten.any()
    on = sorted({(c, v) for c, v in zip(cost[is_on], value[is_on], strict=True)})
    assert [v for _, v in on] == sorted(v for _, v in on)  # who costs more is better
