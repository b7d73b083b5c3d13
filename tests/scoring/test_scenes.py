# SPDX-License-Identifier: Apache-2.0
"""Success by kind of place: whose figure it is, of which queries, and that all kinds together are the board's."""

import numpy as np
import pandas as pd
import pytest

from sasgeo_bench.boards.board_tables import Book, scene_tables
from sasgeo_bench.scoring.tables import AS_USED, leaderboard, scene_frame
from sasgeo_bench.tasks.suites.all_suites import EVERY_SUITE
from tests.scoring.test_tables import scores

HIT, MISS = 1.0, 900.0
FIGURE = ["n", "blocks", "places", "value", "lo", "hi", "lo_blocks", "hi_blocks", "interval", "rank_best", "rank_worst"]


def asked(errors_m=(HIT, HIT, MISS, MISS), *, places=8, scenes=("alpine", "coastal,urban"), **changes):
    """One matcher's views of some places in turn, whose kinds alternate: stress and control at each."""
    count = 2 * places
    rows = {
        "suite": "real-age",
        "kind": ["control", "S1"] * places,
        "role": ["control", "stress"] * places,
        "strength": [0.0, 5.0] * places,
        "place": np.repeat([f"place {at}" for at in range(places)], 2),
        "scene": np.repeat([scenes[at % len(scenes)] for at in range(places)], 2),
    }
    return scores(np.resize(errors_m, count), blocks=count, **rows | changes)


def figures(frame, matcher="mine"):
    mine = frame[frame["matcher"] == matcher]
    return dict(zip(mine["stratum"], mine["value"], strict=True))


def test_a_place_counts_in_each_of_its_kinds_and_controls_in_none():
    found = scene_frame({"mine": asked((HIT, HIT, MISS, MISS))}, draws=50)  # found at the alpine places alone
    assert figures(found) == {"all": 0.5, "urban": 0.0, "alpine": 1.0, "coastal": 0.0}
    counts = found.set_index("stratum")[["n", "places"]]
    assert counts.loc["all"].tolist() == [8, 8]
    assert counts.loc["coastal"].tolist() == [4, 4]


def test_all_kinds_together_are_the_boards_own_figure_with_interval_and_ranks():
    both = {"mine": asked(), "other": asked((MISS, HIT)), "random": asked((MISS,))}
    board = leaderboard(both, draws=80)
    board = board[(board["metric"] == "success_25m") & (board["stratum"] == "stress")].set_index("matcher")
    found = scene_frame(both, draws=80)
    whole = found[found["stratum"] == "all"].set_index("matcher")
    assert set(whole.index) == {"mine", "other"}  # a control has no row
    pd.testing.assert_frame_equal(whole[FIGURE], board.loc[whole.index, FIGURE])


def test_of_the_ladder_of_clean_only_the_errors_count_that_a_user_meets():
    strength = [0.5, 1.0, 2.0, 4.0] * 8
    rows = asked((HIT, HIT, MISS, MISS), places=16, suite="clean", kind="perception", role="stress", strength=strength)
    found = scene_frame({"mine": rows}, draws=50)
    assert figures(found)["all"] == 1.0
    assert set(found.loc[found["stratum"] == "all", "n"]) == {8}
    step = leaderboard({"mine": rows}, draws=50).query("stratum == 'perception 1, 192 cells'")
    whole = found[found["stratum"] == "all"]
    assert whole[["value", "lo", "hi"]].to_numpy().tolist() == (
        step.loc[step["metric"] == "success_25m", ["value", "lo", "hi"]].to_numpy().tolist()
    )


@pytest.mark.parametrize(
    "changes",
    [
        {"suite": "topology-twins"},
        {"suite": "aerial+oracle_segmenter"},
        {"suite": "clean", "track": "retrieval", "strength": 1.0, "pool": 10},
        {"is_present": False},
    ],
)
def test_what_no_user_meets_is_left_out(changes):
    assert scene_frame({"mine": asked(**changes)}, draws=50).empty


def test_who_is_set_apart_has_no_row_and_is_nobodys_rival():
    both = {"mine": asked(places=16), "other": asked((HIT,), places=16)}
    found = scene_frame(both, draws=50, excluded={"other"})
    assert set(found["matcher"]) == {"mine"}
    assert set(found["rank_worst"].dropna()) == {1}


def test_kinds_of_few_places_are_marked_and_rank_nobody():
    rows = {"mine": asked(places=10), "other": asked((MISS, HIT), places=10)}
    frame = scene_frame(rows, draws=50)
    (table,) = scene_tables(frame, Book.of(leaderboard(rows, draws=50)))
    assert [column.name for column in table.columns] == ["matcher", "all", "urban", "alpine", "coastal"]
    places, queries, *_ = table.rows
    assert [cell.text for cell in places.cells] == ["places", "10", "5", "5", "5"]
    assert [[mark.text for mark in cell.marks] for cell in places.cells[1:]] == [[], ["few"], ["few"], ["few"]]
    assert [cell.text for cell in queries.cells] == ["queries", "10", "5", "5", "5"]
    assert frame.loc[frame["stratum"] != "all", "rank_best"].isna().all()
    assert table.title.startswith("With a map 2 to 10 years old (real-age): success_25m")


def test_the_suite_of_most_places_comes_first():
    rows = {"mine": pd.concat([asked(places=2, suite="aerial+forest"), asked(places=8)], ignore_index=True)}
    tables = scene_tables(scene_frame(rows, draws=50), Book.of(leaderboard(rows, draws=50)))
    assert [table.title.partition(": ")[0] for table in tables] == [
        "With a map 2 to 10 years old (real-age)",
        "With a picture and a map of the day (aerial+forest)",
    ]


def test_suites_as_used_are_suites_with_the_strength_that_is_named():
    for name, use in AS_USED.items():
        strengths = {item.strength for item in EVERY_SUITE[name].variants if item.role == "stress"}
        assert use.strength is None or use.strength in strengths, name
