# SPDX-License-Identifier: Apache-2.0
"""The paper's table of related work, measured: cells from made-up scores, and from a stored board."""

import shutil
from pathlib import Path

import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from benchmarks import related_work

RESULTS = Path(__file__).parents[2] / "docs" / "results"
FLIGHTS = RESULTS / "flights"
GRAPH = related_work.ABILITIES[0]


def view(role, hit, *, pair="a", suite="topology-twins", matcher="m"):
    return {
        "matcher": matcher, "track": "localization", "is_present": True, "suite": suite, "role": role, "hit": hit,
        "pair_id": pair, "view_cells": 192, "strength": 1.0, "place": pair, "block": pair,
    }  # fmt: skip


def test_a_gain_is_over_the_control_of_the_same_site_and_views_without_one_are_left_out():
    rows = [view("stress", 1.0), view("control", 0.0), view("stress", 1.0, pair="b"), view("control", 1.0, pair="b")]
    others = [view("stress", 0.0, pair="c"), view("stress", 0.0, suite="clean"), view("stress", 0.0, matcher="n")]
    found = related_work.views_of(pd.DataFrame([*rows, *others]), "m", GRAPH)
    assert sorted(found["without"]) == [0.0, 1.0]
    assert related_work.cell(found) == "100, +50 (-27 to +50)"  # half is all that there was to gain
    assert related_work.cell(found.iloc[:0]) == "-"


@pytest.mark.parametrize(("hit", "expected"), [(0.0, "0, +0 (+0 to +49)"), (1.0, "100, +0 (-49 to +0)")])
def test_no_difference_on_few_views_leaves_open_what_can_be(hit, expected):
    rows = [view(role, hit, pair=pair) for pair in "abcd" for role in ("stress", "control")]
    found = related_work.views_of(pd.DataFrame(rows), "m", GRAPH)
    assert related_work.cell(found) == expected  # Wilson's: 0 to 49 of 4


def test_the_own_confidence_of_a_system_comes_before_the_margin():
    rows = [("m", "margin", 0.6), ("m", "own", 0.9), ("n", "own", None), ("n", "margin", 0.7), ("o", "sue", 0.8)]
    rows += [("n", "margin_nms", 0.1)]
    table = pd.DataFrame(
        [
            {"matcher": m, "metric": "auroc", "rejector": r, "value": v, "lo": v and v - 0.1, "hi": v and v + 0.05}
            for m, r, v in rows
        ]
    ).astype({"value": float, "lo": float, "hi": float})
    lines = [related_work.figure(table, name, "auroc", related_work.REJECTORS) for name in "mno"]
    assert lines == ["90 (80 to 95)", "70 (60 to 75)", "-"]


@pytest.mark.parametrize(("board", "system", "column"), [("modules", "sasgeo", 2), ("flights", "swapf", 4)])
def test_a_stored_board_has_a_row_for_each_system_and_no_control(board, system, column):
    head, _, *rows = related_work.lines(*related_work.read_board(RESULTS / board))
    cells = {row.split("`")[1]: row.split("|") for row in rows}
    assert not {"random", "prior_centre", "oracle_pose", "prior_only"} & set(cells)
    assert all(len(row) == len(head.split("|")) for row in cells.values())
    assert cells[system][column].strip() != "-"


def test_a_folder_that_is_no_board_is_reported_in_one_line(tmp_path, capsys):
    with pytest.raises(SystemExit):
        related_work.main([str(tmp_path)])
    assert f"{tmp_path} holds no board: score some runs first" in capsys.readouterr().err


def test_rejection_is_of_one_prior_group_that_nearly_all_views_have():
    _, rows = related_work.read_board(RESULTS / "modules")
    assert set(rows["prior_group"]) == {related_work.PRIOR}
    assert not rows.duplicated(["matcher", "metric", "rejector"]).any()


def test_the_tracker_of_a_system_has_its_row_where_the_matcher_was_not_asked():
    _, _, *lines = related_work.lines(*related_work.read_board(FLIGHTS))
    rows = {row.split("`")[1]: row.split("|") for row in lines}
    assert rows["sasgeo_track"][4].strip().startswith("8")
    assert rows["dead_reckoning"][4].strip() == "1"  # nothing is held against it
    assert rows["sasgeo_track"][1] == " SASGeo: `sasgeo_track` "  # `sasgeo` was not asked on this board


def test_columns_of_the_board_have_its_own_intervals():
    board = RESULTS / "modules"
    _, figures = related_work.read_board(board)
    row = pd.read_parquet(board / "leaderboard.parquet").query(
        "metric == 'within_25m' and suite == 'clean' and stratum == 'stress' and matcher == 'sasgeo'"
    )
    value, lo, hi = (100 * row[name].item() for name in ("value", "lo", "hi"))
    assert related_work.figure(figures, "sasgeo", "within_25m") == f"{value:.0f} ({lo:.0f} to {hi:.0f})"


def test_a_flight_without_an_answer_counts_as_missed():
    flights = [
        {"query_id": query, "matcher": name, "track": "sequence", "role": "stress", related_work.WAY: way}
        for query, name, way in [
            ("a", "m", 0.8),
            ("b", "m", None),
            ("a", "dead_reckoning", 0.0),
            ("b", "dead_reckoning", 0.0),
        ]
    ]
    assert related_work.flights_of(pd.DataFrame(flights), "m")["hit"].tolist() == [0.8, 0.0]


def damaged(folder, table, change):
    """A copy of a stored board with one table changed, but for its versions."""
    shutil.copytree(RESULTS / "systems-objects", folder)
    path = folder / f"{table}.parquet"
    found = pq.read_table(path)
    changed = pa.Table.from_pandas(change(found.to_pandas()), preserve_index=False)
    pq.write_table(changed.replace_schema_metadata({**changed.schema.metadata, **found.schema.metadata}), path)
    return folder


@pytest.mark.parametrize(
    ("table", "change", "expected"),
    [
        ("scores", lambda rows: rows.drop(columns="strength"), "scores.parquet has no column 'strength'"),
        ("scores", lambda rows: rows.drop(columns="role"), "scores.parquet has no column 'role'"),
        (
            "scores",
            lambda rows: rows.assign(position_error_m="far"),
            "scores.parquet: position_error_m holds something",
        ),
        (
            "scores",
            lambda rows: rows.assign(position_error_m=-np.inf),
            "scores.parquet: position_error_m holds something",
        ),
        ("scores", lambda rows: rows.assign(pair_id=None), "scores.parquet: pair_id holds something else"),
        ("scores", lambda rows: rows.assign(matcher=None), "scores.parquet: matcher holds something else"),
        ("scores", lambda rows: rows.iloc[:0], "scores.parquet holds no view and no flight"),
        ("leaderboard", lambda rows: rows.drop(columns="lo"), "leaderboard.parquet has no column 'lo'"),
        ("leaderboard", lambda rows: pd.concat((rows, rows)), "leaderboard.parquet says one figure twice"),
    ],
)
def test_a_damaged_table_is_reported_in_one_line(table, change, expected, tmp_path, capsys):
    with pytest.raises(SystemExit) as stop:
        related_work.main([str(damaged(tmp_path / "board", table, change))])
    assert stop.value.code == 2
    last = capsys.readouterr().err.splitlines()[-1]
    assert expected in last
    assert last.endswith("score it again")


def test_names_from_outside_are_text_in_the_table(tmp_path, capsys):
    evil = "a|b\n| forged | 100 |\x1b[31m `x` <b>"
    board = damaged(
        tmp_path / "board", "scores", lambda rows: rows.assign(matcher=rows["matcher"].replace("road_2rit", evil))
    )
    related_work.main([str(board)])
    head, _, *rows = capsys.readouterr().out.splitlines()
    (row,) = (one for one in rows if "forged" in one)
    assert row.replace("\\|", "").count("|") == head.count("|")
    assert row.isprintable()
    assert "<b>" not in row
    assert "`x`" not in row.replace("\\`", "")


def test_a_missing_number_of_the_board_is_no_figure():
    rows = pd.DataFrame([{"matcher": "m", "metric": "auroc", "rejector": "own", "value": 0.9, "lo": np.nan, "hi": 1.0}])
    assert related_work.figure(rows, "m", "auroc", ("own",)) == "-"
