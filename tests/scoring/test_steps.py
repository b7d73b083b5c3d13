# SPDX-License-Identifier: Apache-2.0
"""Ladders as tables: a matcher a line, a step a column, and only where a kind has several steps."""

import numpy as np

from sasgeo_bench.boards.board_tables import step_tables
from sasgeo_bench.boards.plots import age_names, ages_frame
from sasgeo_bench.scoring.strata import queries_of, steps_frame, strata
from sasgeo_bench.scoring.tables import leaderboard
from tests.scoring.test_tables import scores

COUNT = 120
STRENGTHS = np.array([0.0, 0.2, 0.4])[np.arange(COUNT) % 3]


def frame(errors_m, strengths=STRENGTHS):
    roles = np.where(strengths == 0, "control", "stress")
    return scores(errors_m, blocks=12, role=roles, kind=np.where(strengths == 0, "control", "U1"), strength=strengths)


def steps_of(**by_matcher):
    board = leaderboard(by_matcher, draws=200)
    return steps_frame(board, queries_of(by_matcher), sorted(by_matcher))


def names_of(table):
    return [column.name for column in table.columns]


def test_a_ladder_is_a_table_with_a_column_for_each_step_and_the_best_first():
    near, far = np.where(STRENGTHS < 0.4, 1.0, 99.0), np.where(STRENGTHS < 0.2, 1.0, 99.0)
    (table,) = step_tables(steps_of(plain=frame(far), better=frame(near)))
    assert table.title.startswith(
        "occlusion: localization, searched: disc of 500 m, heading +-20 deg, scale +-3 %, step by"
    )
    assert names_of(table) == ["matcher", *(f"{step}, 192 cells, n = 40" for step in ("0", "0.2", "0.4"))]
    assert [[cell.text.split()[0] for cell in row.cells] for row in table.rows] == [
        ["better", "1.000", "1.000", "0.000"],
        ["plain", "1.000", "0.000", "0.000"],
    ]


def test_steps_that_are_ages_of_a_map_are_named_by_the_ages_that_maps_have():
    """The dates of maps are the nearest there are to 2 and 5 years: a column must not say 5 where they are 3.6."""
    steps = steps_of(mine=frame(np.ones(COUNT)))
    queries = queries_of({"mine": frame(np.ones(COUNT))})
    years = {0.0: (0.0, 0.0), 0.2: (1.9, 2.2), 0.4: (3.58, 6.0)}
    at = np.arange(COUNT) // 3 % 2
    measured = {
        name: {"age_years": years[strength][one]}
        for name, strength, one in zip(queries["query_id"], queries["strength"], at, strict=True)
    }
    (table,) = step_tables(steps, age_names(ages_frame(steps, queries, measured)))
    names = ("0.0 years", "1.9 to 2.2 years", "3.6 to 6.0 years")
    assert names_of(table) == ["matcher", *(f"{name}, 192 cells, n = 40" for name in names)]


def test_detectors_are_strata_where_there_are_several():
    table = frame(np.ones(COUNT)).assign(detector="published")
    assert not [name for name, _ in strata(table) if name.startswith("detector")]
    table.loc[::3, "detector"] = "measured"
    found = dict(strata(table))
    assert found["detector measured"].sum() == COUNT // 3
    np.testing.assert_array_equal(found["detector published"], ~found["detector measured"])


def test_a_change_of_real_maps_is_named_for_what_it_mostly_is():
    table = frame(np.ones(COUNT)).assign(changed_share=0.3)
    mapped, made = (dict(strata(table.assign(suite=suite))) for suite in ("real-age", "growth"))
    assert "changed_share (mostly mapping) 0.2-0.4" in mapped
    assert "changed_share 0.2-0.4" in made


def test_a_kind_of_one_step_has_no_table():
    one = np.where(STRENGTHS == 0, 0.0, 0.2)
    assert list(step_tables(steps_of(mine=frame(np.ones(COUNT), one)))) == []


def test_a_matcher_that_was_not_asked_has_a_dash():
    steps = steps_of(plain=frame(np.ones(COUNT)), better=frame(np.ones(COUNT)))
    lost = steps[~((steps["matcher"] == "plain") & np.isclose(steps["strength"], 0.4))]
    (table,) = step_tables(lost)
    assert {row.cells[0].text: row.cells[-1].text for row in table.rows}["plain"] == "-"
