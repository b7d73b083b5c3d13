# SPDX-License-Identifier: Apache-2.0
"""Tables of the page of claims: they say what the boards say, and what was not asked is no row."""

import shutil
from pathlib import Path

import pandas as pd
import pytest

from benchmarks.claims import (
    GOALS,
    apart,
    beside,
    claims,
    contrasts,
    goals,
    listed,
    points,
    scenes,
    steps,
    suites,
    tables,
    verdict,
)
from sasgeo_bench.boards.board import read_board
from sasgeo_bench.scoring.compare import Finding

MODULES = Path(__file__).parents[2] / "docs" / "results" / "modules"
SURE = {"n": 800, "places": 80, "p_holm": 0.001, "best": 1.0, "first_value": 0.9, "second_value": 0.7, "least": 0.03}


@pytest.fixture(scope="module")
def board():
    return read_board(MODULES)


def found(**changes):
    return Finding(name="c", first="one", second="two", metric="primary", **SURE | changes)


@pytest.mark.parametrize(
    ("changes", "word"),
    [
        ({"difference": 0.2, "lo": 0.1, "hi": 0.3}, "yes"),
        ({"difference": 0.2, "lo": 0.1, "hi": 0.3, "gains_without_stress": True}, "yes, without the stress, too"),
        ({"difference": -0.2, "lo": -0.3, "hi": -0.1}, "no: the second is better"),
        ({"difference": 0.02, "lo": 0.01, "hi": 0.025}, "smaller than matters"),
        ({"difference": 0.0, "lo": -0.02, "hi": 0.02, "p_holm": 1.0}, "equal within 3 points"),
        ({"difference": 0.1, "lo": -0.1, "hi": 0.3, "p_holm": 1.0}, "not decided"),
        ({"difference": 0.2, "lo": 0.1, "hi": 0.3, "places": 5}, "not decided"),
        ({"difference": 0.2, "lo": 0.1, "hi": 0.3, "lo_countries": -0.1, "hi_countries": 0.4}, "not decided"),
    ],
)
def test_verdicts_are_those_of_the_board_in_words(changes, word):
    assert verdict(found(**changes)) == word


def test_each_contrast_has_a_row_with_the_interval_that_decides(board):
    lines = contrasts(board)
    assert len(lines) == 2 + len(board.findings)
    for line, row in zip(lines[2:], board.contrasts.to_dict("records"), strict=True):
        far = "" if pd.isna(row["lo_countries"]) else "_countries"
        assert points(row["difference"], row[f"lo{far}"], row[f"hi{far}"]) in line
        assert line.startswith(f"| {row['name']} |")


def test_suites_have_the_best_rival_and_goals_their_verdict(board):
    (clean,) = [line for line in suites(board) if line.startswith("| clean |")]
    assert "0.754 [0.64, 0.84] | 1-7 of 7 | `schmidt_segcorr`: 0.786" in clean
    assert [line.rsplit("|", 2)[1].strip() for line in goals(board)[2:]] == ["missed"] * len(GOALS)


def test_steps_are_in_the_order_of_the_suite_and_scenes_have_enough_views(board):
    head, _, *rows = steps(board, "clean")
    assert [part.split(",")[0].strip() for part in head.split("|")[2:-1]] == [
        f"perception {x}" for x in (0.5, 1, 2, 3, 4)
    ]
    assert rows[0].startswith("| `sasgeo_even` |")
    _, _, *of_scenes = scenes(board, ["sasgeo", "schmidt_segcorr"])
    assert all(int(line.split("|")[2].split(",")[0]) >= 20 for line in of_scenes)
    assert sum("poor of features" in line for line in of_scenes) == 1


def test_sealed_places_stand_apart(board):
    (line,) = [line for line in apart(board) if line.startswith("| graph-junctions |")]
    assert line == "| graph-junctions | +16.7; 24, 8 | +29.5; 105, 31 |"


def test_what_is_found_is_listed_and_what_is_listed_is_no_less(board):
    _, _, *rows = listed(board, ["sasgeo", "schmidt_segcorr"])
    assert rows[0] == "| clean, 0.5 | 70 | 1.000, 1.000 | 0.943, 0.900 |"
    pairs = [tuple(map(float, cell.split(","))) for row in rows for cell in row.split("|")[3:-1] if "." in cell]
    assert len(pairs) > 5
    assert all(there >= right for there, right in pairs)


def test_a_claim_has_the_verdict_of_its_contrast_and_none_without_its_board(board):
    assert len(claims({})) == 2
    _, _, *rows = claims({"modules": board})
    (junctions,) = [row for row in rows if "junctions" in row]
    assert "| **yes** | 105, 31 (8) | +29.5 [16.7, 42.1] | `modules` |" in junctions
    assert sum("not decided" in row for row in rows) == 5


def test_a_board_without_answers_has_all_tables_but_that_of_what_is_listed(board, tmp_path):
    copy = tmp_path / "modules"
    shutil.copytree(MODULES, copy, ignore=shutil.ignore_patterns("pack.json", "predictions.parquet"))
    assert set(tables([board])) - set(tables([read_board(copy)])) == {"listed"}


def test_pairs_that_no_contrast_asks_are_counted_view_by_view(board):
    lines = beside(board)
    (twins,) = [line for line in lines if line.startswith("| clean: perception")] or [""]
    assert twins == ""  # `sasgeo_raster` was not asked there
    (bent,) = [line for line in lines if line.startswith("| local-warp: ")]
    rows = board.scores
    rows = rows[rows["kind"].isin(("G1 rows", "G1 tilt")) & rows["matcher"].isin(("sasgeo", "sasgeo_no_graph"))]
    right = rows["position_error_m"].le(25) & rows["yaw_error_deg"].le(5)
    mine, other = (
        set(rows.loc[right & rows["matcher"].eq(name), "query_id"]) for name in ("sasgeo", "sasgeo_no_graph")
    )
    assert f"| {len(mine - other)}, {len(other - mine)} | {rows['query_id'].nunique()}, " in bent
