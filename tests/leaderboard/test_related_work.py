# SPDX-License-Identifier: Apache-2.0
"""The paper's table of related work, measured: cells from made-up scores, and from a stored board."""

from pathlib import Path

import pandas as pd
import pytest

from benchmarks import related_work

RESULTS = Path(__file__).parents[2] / "docs" / "results"
FLIGHTS = RESULTS / "flights"
GRAPH = related_work.ABILITIES[1]


def view(role, hit, *, pair="a", suite="topology-twins", matcher="m"):
    return {
        "matcher": matcher, "track": "localization", "is_present": True, "suite": suite, "role": role, "hit": hit,
        "pair_id": pair, "view_cells": 192, "strength": 1.0, "place": pair, "block": pair,
    }  # fmt: skip


def test_a_gain_is_over_the_control_of_the_same_site_and_views_without_one_are_left_out():
    rows = [view("stress", 1.0), view("control", 0.0), view("stress", 1.0, pair="b"), view("control", 1.0, pair="b")]
    others = [view("stress", 0.0, pair="c"), view("stress", 0.0, suite="clean"), view("stress", 0.0, matcher="n")]
    found = related_work.views_of(pd.DataFrame([*rows, *others]), "m", GRAPH)
    assert sorted(found["gain"]) == [0.0, 1.0]
    assert related_work.cell(found, is_compared=True) == "100 (-27 to +100)"  # two sites leave nearly all open
    assert related_work.cell(found.iloc[:0], is_compared=True) == "-"


@pytest.mark.parametrize("hit", [0.0, 1.0])
def test_no_difference_on_few_views_leaves_both_signs_open(hit):
    rows = [view(role, hit, pair=pair) for pair in "abcd" for role in ("stress", "control")]
    found = related_work.views_of(pd.DataFrame(rows), "m", GRAPH)
    assert related_work.cell(found, is_compared=True) == f"{100 * hit:.0f} (-49 to +49)"  # Wilson's: 0 to 49 of 4


def test_the_own_confidence_of_a_system_comes_before_the_margin():
    rows = [("m", "margin", 0.6), ("m", "own", 0.9), ("n", "own", None), ("n", "margin", 0.7), ("o", "sue", 0.8)]
    rows += [("n", "margin_nms", 0.1)]
    table = pd.DataFrame(
        [{"matcher": m, "rejector": r, "value": v, "lo": v and v - 0.1, "hi": v and v + 0.05} for m, r, v in rows]
    )
    assert related_work.rejection(table, "m") == "90 (80 to 95)"
    assert related_work.rejection(table, "n") == "70 (60 to 75)"
    assert related_work.rejection(table, "o") == "-"


@pytest.mark.parametrize(("board", "system", "column"), [("claims", "sasgeo", 2), ("flights", "swapf", 4)])
def test_a_stored_board_has_a_row_for_each_system_and_no_control(board, system, column):
    head, _, *rows = related_work.lines(*related_work.read_board(RESULTS / board))
    cells = {row.split("`")[1]: row.split("|") for row in rows}
    assert not {"random", "prior_centre", "oracle_pose", "prior_only"} & set(cells)
    assert all(len(row) == len(head.split("|")) for row in cells.values())
    assert cells[system][column].strip() != "-"


def test_a_folder_that_is_no_board_is_told_in_one_line(tmp_path, capsys):
    with pytest.raises(SystemExit):
        related_work.main([str(tmp_path)])
    assert f"{tmp_path} holds no board: score some runs first" in capsys.readouterr().err


def test_rejection_is_of_one_prior_group_that_nearly_all_views_have():
    _, rows = related_work.read_board(RESULTS / "leaderboard")
    assert set(rows["prior_group"]) == {related_work.PRIOR}
    assert not rows.duplicated(["matcher", "rejector"]).any()


def test_the_tracker_of_a_system_has_its_row_where_the_matcher_was_not_asked():
    _, _, *lines = related_work.lines(*related_work.read_board(FLIGHTS))
    rows = {row.split("`")[1]: row.split("|") for row in lines}
    assert rows["sasgeo"][4].strip().startswith("8")
    assert rows["dead_reckoning"][4].strip() == "1 (0 to 5)"  # its own share: nothing is held against it
