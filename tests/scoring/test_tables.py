# SPDX-License-Identifier: Apache-2.0
"""The leaderboard: figures worked out by hand, denominators that never move, ranks that say how sure they are."""

import math
import re

import numpy as np
import pandas as pd
import pytest

from sasgeo_bench.boards.board_tables import Book, use_table
from sasgeo_bench.boards.manifests import BoardManifest
from sasgeo_bench.boards.overview import overviews_of
from sasgeo_bench.boards.tables import text_of
from sasgeo_bench.boards.text import MARKDOWN, Contents, board_latex, board_markdown, rows_of, warnings_of
from sasgeo_bench.core.errors import MetricError
from sasgeo_bench.core.texts import markdown
from sasgeo_bench.scoring import tables as of_tables
from sasgeo_bench.scoring.compare import LEAST_BLOCKS
from sasgeo_bench.scoring.contrasts import Contrast, evaluate_contrasts
from sasgeo_bench.scoring.controls import Verdict
from sasgeo_bench.scoring.cost import Costs
from sasgeo_bench.scoring.intervals import wilson
from sasgeo_bench.scoring.rejection import own_confidence
from sasgeo_bench.scoring.rejection_rows import integrity_rows
from sasgeo_bench.scoring.rows import FIGURE_SCHEMA, EntryLabel, with_entry_labels
from sasgeo_bench.scoring.score import COLUMNS as SCORED
from sasgeo_bench.scoring.strata import strata
from sasgeo_bench.scoring.tables import cost_figures, leaderboard

ABOUT = BoardManifest(
    scorer_version=1, task_version=1, made_by="tests", split="crossfit", draws=200, entries=[], tasks=[]
)


def scores(errors_m, *, blocks=4, track="localization", **changes):
    """Rows of one matcher, one for each error; by default all stress, spread over some blocks, headings right."""
    count = len(errors_m)
    errors_m = np.array(errors_m, dtype=float)
    table = pd.DataFrame(
        {
            "query_id": [f"q{at:05d}" for at in range(count)],
            "track": track,
            "suite": "occlusion",
            "suite_version": 1,
            "part": "crossfit",
            "region": "vaduz",
            "place": "",
            "block": [f"b{at % blocks}" for at in range(count)],
            "prior_group": "r500-weak-s3",
            "view_cells": 192,
            "cell_size_m": 1.0,
            "pool": 0,
            "pair_id": [f"p{at:05d}" for at in range(count)],
            "role": "stress",
            "kind": "U1",
            "strength": 0.3,
            "strength_unit": "share",
            "unknown_share": 0.3,
            "changed_share": 0.0,
            "feature_density": 0.1,
            "alias_index": 0.8,
            "scene": "urban",
            "detector": "published",
            "is_present": True,
            "status": "ok",
            "ceiling": 1.0,
            "is_answered": np.isfinite(errors_m),
            "above": 0,
            "tied": 0,
            "right": 0,
            "position_error_m": errors_m,
            "yaw_error_deg": np.where(np.isfinite(errors_m), 0.0, np.inf),
            "log_scale_error": np.where(np.isfinite(errors_m), 0.0, np.inf),
            "is_right": errors_m <= 25,
            "confidence": math.nan,
            "latency_s": 0.1,
        }
    )
    table = table.assign(**changes)
    table = table.assign(place=changes.get("place", "place of " + table["block"]))
    return table.assign(country=changes.get("country", table["place"]))[list(SCORED)]


def column_of(table, term):
    """Texts of a column, from top to bottom."""
    at = [column.term for column in table.columns].index(term)
    return [text_of(row.cells[at]) for row in table.rows]


def pick(board, matcher, metric, stratum="all"):
    rows = board[(board["matcher"] == matcher) & (board["metric"] == metric) & (board["stratum"] == stratum)]
    assert len(rows) == 1
    return rows.iloc[0]


def ranks(row):
    return tuple(None if pd.isna(row[name]) else int(row[name]) for name in ("rank_best", "rank_worst"))


def test_figures_are_what_they_are_by_hand():
    board = leaderboard({"mine": scores([1.0, 8.0, 20.0, 40.0, math.inf, 25.0, 25.1, 5.0])}, draws=200)
    assert pick(board, "mine", "success_25m")["value"] == 5 / 8
    assert pick(board, "mine", "success_10m")["value"] == 3 / 8
    assert pick(board, "mine", "success_5m")["value"] == 2 / 8
    areas = [1 - error / 50 for error in (1.0, 8.0, 20.0, 40.0, 25.0, 25.1, 5.0)]
    assert pick(board, "mine", "success_auc_50m")["value"] == pytest.approx(sum(areas) / 8)
    assert pick(board, "mine", "position_median")["value"] == 20.0
    assert pick(board, "mine", "position_p90")["value"] == math.inf
    row = pick(board, "mine", "success_25m")
    assert (row["n"], row["answered"], row["missing"], row["blocks"], row["places"]) == (8, 7, 0, 4, 4)
    assert row["lo"] < row["value"] < row["hi"]
    assert row["interval"] == "places"


def test_a_fix_that_is_near_and_turned_is_no_success_and_yet_within():
    table = scores([1.0, 1.0, 25.0, 26.0], yaw_error_deg=[5.0, 5.1, 180.0, 0.0])
    board = leaderboard({"mine": table}, draws=200)
    assert pick(board, "mine", "success_25m")["value"] == 0.25
    assert pick(board, "mine", "within_25m")["value"] == 0.75 == table["is_right"].mean()
    shown, used = rows_of(Contents(leaderboard=board), MARKDOWN)
    assert column_of(shown, "within_25m")[0].startswith("0.750 [")
    assert column_of(used, "within_5deg")[0].startswith("0.500 [")


def test_errors_are_shown_under_the_names_of_the_field_and_a_scale_in_per_cent():
    table = scores([1.0, 4.0, 30.0, math.inf] * 10, log_scale_error=[0.01, 0.02, 0.03, math.inf] * 10)
    board = leaderboard({"mine": table, "random": table}, draws=200)
    shown = use_table(Book.of(board), ("occlusion", "localization", "r500-weak-s3"))
    assert [row.cells[0].text for row in shown.rows] == ["mine", "random"]
    texts = dict(zip((column.name for column in shown.columns), map(text_of, shown.rows[0].cells), strict=True))
    assert texts["R@5 m"].startswith("0.500 [")
    assert texts["R95 (m)"].startswith("inf [")
    assert texts["median scale error (%)"].startswith("2.000 [")


def test_recall_counts_ties_in_proportion():
    table = scores([math.nan] * 4, track="retrieval", above=[0, 0, 1, 0], tied=[1, 2, 1, 0], right=[1, 1, 1, 0])
    board = leaderboard({"mine": table}, draws=200)
    assert pick(board, "mine", "recall_1")["value"] == (1 + 0.5) / 4
    assert pick(board, "mine", "recall_5")["value"] == 3 / 4
    assert pick(board, "mine", "mrr")["value"] == (1 + (1 + 1 / 2) / 2 + 1 / 2) / 4


def test_the_median_of_errors_has_an_interval_that_holds_it():
    errors = np.random.default_rng(1).exponential(20.0, 400)
    board = leaderboard({"mine": scores(errors, blocks=40)}, draws=500)
    row = pick(board, "mine", "position_median")
    assert row["lo"] < row["value"] < row["hi"]
    assert row["hi"] - row["lo"] < 12
    assert row["lo"] < 20 * math.log(2) < row["hi"]


def test_of_one_block_the_interval_is_wilsons_over_sites_and_nothing_is_ranked():
    sites = ["one", "one", "other", "other"]
    both = {"a": scores([1.0] * 3 + [99.0], blocks=1, pair_id=sites), "b": scores([99.0] * 4, blocks=1, pair_id=sites)}
    board = leaderboard(both, draws=200)
    row, expected = pick(board, "a", "success_25m"), wilson(0.75 * 2, 2.0)
    assert (row["lo"], row["hi"], row["interval"]) == (expected.lo, expected.hi, "wilson")
    assert {ranks(pick(board, name, "success_25m")) for name in both} == {(None, None)}
    assert math.isnan(row["detectable"])


def test_where_nothing_varies_the_interval_is_as_wide_as_few_sites_make_it():
    sites = [f"s{at % 7}" for at in range(98)]
    row = pick(leaderboard({"mine": scores([1.0] * 98, blocks=5, pair_id=sites)}, draws=200), "mine", "success_25m")
    assert (row["value"], row["lo"]) == (1.0, wilson(7, 7).lo)


def test_ten_queries_of_a_site_say_no_more_of_other_sites_than_one():
    errors = np.where(np.random.default_rng(4).random(36) < 0.6, 1.0, 99.0)
    sites, copies = [f"s{at}" for at in range(36)], 10
    one = scores(errors, blocks=12, pair_id=sites)
    ten = scores(
        np.repeat(errors, copies), pair_id=np.repeat(sites, copies), block=np.repeat(one["block"].to_numpy(), copies)
    )
    boards = [leaderboard({"mine": table}, draws=500) for table in (one, ten)]
    for metric in ("success_25m", "success_auc_50m", "position_median", "position_p90"):
        rows = [pick(board, "mine", metric)[["value", "lo", "hi"]].tolist() for board in boards]
        assert rows[0] == pytest.approx(rows[1])


def test_figures_of_few_sites_keep_their_order_whichever_way_their_ends_were_found():
    sites, kinds = [f"s{at // 10}" for at in range(40)], ["U1"] * 40
    part = np.where(np.arange(40) % 10 < 7, 1.0, 99.0)  # seven of ten at each of four sites
    tables = {name: scores(errors, blocks=2, block=[f"b{at // 20}" for at in range(40)], pair_id=sites, kind=kinds)
              for name, errors in (("all", np.ones(40)), ("part", part))}  # fmt: skip
    board = leaderboard(tables, draws=200)
    all_of_it, part_of_it = (pick(board, name, "success_25m") for name in ("all", "part"))
    assert (part_of_it["lo"], part_of_it["hi"]) == pytest.approx((wilson(2.8, 4).lo, wilson(2.8, 4).hi))
    assert part_of_it["lo"] < all_of_it["lo"]
    assert {all_of_it["interval"], part_of_it["interval"]} == {"wilson"}


def test_a_higher_quantile_has_no_lower_end():
    # Of four sites nine in ten errors are small: p90 is the largest of these, p99 the largest of all.
    errors = [0.1, 0.2, 0.3, 0.5, 1.0, 2.0, 5.0, 20.0, 60.0, 500.0] * 4
    board = leaderboard({"mine": scores(errors, blocks=2, pair_id=[f"s{at // 10}" for at in range(40)])}, draws=200)
    rows = [pick(board, "mine", f"position_{name}") for name in ("median", "p90", "p99")]
    assert [row["value"] for row in rows] == [1.0, 60.0, 500.0]
    assert sorted(row["lo"] for row in rows) == [row["lo"] for row in rows]
    assert sorted(row["hi"] for row in rows) == [row["hi"] for row in rows]


def test_an_infinite_quantile_is_as_unsure_as_any():
    # 12 of 100 without an answer: p90 is infinite, but Wilson's of 90 in 100 begins at 0.826, the 83rd error.
    board = leaderboard({"mine": scores([*range(88), *[math.inf] * 12], blocks=1)}, draws=200)
    row = pick(board, "mine", "position_p90")
    assert wilson(90, 100).lo == pytest.approx(0.8256, abs=1e-4)
    assert (row["value"], row["lo"], row["hi"]) == (math.inf, 82.0, math.inf)


def test_ranks_tell_apart_what_differs_and_nothing_else():
    chance = np.random.default_rng(3)
    good, same, bad = (np.where(chance.random(600) < share, 1.0, 99.0) for share in (0.8, 0.8, 0.2))
    tables = {name: scores(errors, blocks=60) for name, errors in (("good", good), ("same", same), ("bad", bad))}
    board = leaderboard(tables | {"oracle_pose": scores(np.ones(600), blocks=60)}, draws=1000)
    assert {name: ranks(pick(board, name, "success_25m")) for name in tables} == {
        "good": (1, 2),
        "same": (1, 2),
        "bad": (3, 3),
    }
    assert ranks(pick(board, "oracle_pose", "success_25m")) == (None, None)
    assert 0 < pick(board, "good", "success_25m")["detectable"] < 0.2


def test_equal_columns_are_drawn_once_and_come_out_as_drawn_each(monkeypatch):
    chance = np.random.default_rng(5)
    errors = {name: np.where(chance.random(240) < share, 1.0, 99.0) for name, share in (("one", 0.8), ("other", 0.4))}
    errors |= {"same": errors["one"], "none": np.full(240, np.inf)}
    tables = {name: scores(column, blocks=12) for name, column in errors.items()}
    found = leaderboard(tables, draws=400)
    monkeypatch.setattr(of_tables, "distinct_columns", lambda table: (table, np.arange(table.shape[1])))
    pd.testing.assert_frame_equal(found, leaderboard(tables, draws=400), rtol=1e-12)
    one, same = (found[found["matcher"] == name].drop(columns="matcher") for name in ("one", "same"))
    pd.testing.assert_frame_equal(one.reset_index(drop=True), same.reset_index(drop=True), check_exact=True)


def test_what_is_set_apart_has_figures_and_no_rank_and_is_nobodys_rival():
    chance = np.random.default_rng(3)
    best, good, bad = (np.where(chance.random(600) < share, 1.0, 99.0) for share in (0.95, 0.8, 0.2))
    tables = {name: scores(errors, blocks=60) for name, errors in (("best", best), ("good", good), ("bad", bad))}
    board = leaderboard(tables, draws=1000, excluded={"best"})
    alone = leaderboard({name: tables[name] for name in ("good", "bad")}, draws=1000)
    row = pick(board, "best", "success_25m")
    assert ranks(row) == (None, None)
    assert row["value"] > 0.9
    assert math.isnan(row["detectable"])
    for name in ("good", "bad"):
        mine, before = (pick(table, name, "success_25m") for table in (board, alone))
        assert ranks(mine) == ranks(before)
        assert mine["detectable"] == before["detectable"]
    values = {name: EntryLabel("1", "", "as submitted", "for a reason" if name == "best" else None) for name in tables}
    first, apart, _ = rows_of(Contents(leaderboard=with_entry_labels(board, values)), MARKDOWN)
    assert set(column_of(first, "matcher")) == {"good (as submitted)", "bad (as submitted)"}
    assert column_of(apart, "matcher") == ["best (as submitted) (set apart)"]
    assert apart.notes == ("best: for a reason.",)


@pytest.mark.parametrize(("blocks", "expected"), [(5, {(None, None)}), (6, {(1, 1), (2, 2)})])
def test_as_few_blocks_as_decide_no_contrast_rank_nobody(blocks, expected):
    both = {"good": scores([1.0] * 60, blocks=blocks), "bad": scores([99.0] * 60, blocks=blocks)}
    board = leaderboard(both, draws=200)
    rows = [pick(board, name, "success_25m") for name in both]
    assert {ranks(row) for row in rows} == expected
    assert [math.isnan(row["detectable"]) for row in rows] == [blocks < LEAST_BLOCKS] * 2
    contrast = Contrast(name="both", first="good", second="bad", suites=("occlusion",))
    (found,) = evaluate_contrasts([contrast], both, {}, draws=200)
    assert found.verdict.startswith("not decided") == (blocks < LEAST_BLOCKS)


def test_absent_places_are_no_part_of_success_and_are_counted_apart():
    table = scores([1.0, 1.0, math.nan, math.nan], is_present=[True, True, False, False], is_answered=[1, 1, 1, 0])
    board = leaderboard({"mine": table}, draws=200)
    assert pick(board, "mine", "success_25m")[["value", "n"]].tolist() == [1.0, 2]
    assert pick(board, "mine", "answered_absent")[["value", "n"]].tolist() == [0.5, 2]


def test_a_suite_a_matcher_cannot_has_a_row_without_a_figure_and_no_rank():
    tables = {"a": scores([1.0, 99.0] * 3, blocks=6), "b": scores([math.inf] * 6, blocks=6, status="not applicable")}
    board = leaderboard(tables, draws=200)
    row = pick(board, "b", "success_25m")
    assert not row["is_applicable"]
    assert math.isnan(row["value"])
    assert ranks(pick(board, "a", "success_25m")) == (1, 1)


def test_prior_groups_are_never_ranked_together():
    groups = ["r500-weak-s3", "rnone-unknown-s15"] * 20
    tables = {
        name: scores(errors, prior_group=groups) for name, errors in (("a", [1.0, 99.0] * 20), ("b", [99.0, 1.0] * 20))
    }
    board = leaderboard(tables, draws=500)
    main = board[(board["metric"] == "success_25m") & (board["stratum"] == "all")]
    assert len(main) == 4
    assert set(main["n"]) == {20}


def test_matchers_scored_on_other_queries_are_refused():
    with pytest.raises(MetricError, match="b was scored on other queries than a"):
        leaderboard({"a": scores([1.0, 2.0]), "b": scores([1.0])}, draws=200)


def test_the_same_scores_give_the_same_board_in_any_order():
    table = scores(np.random.default_rng(5).exponential(30, 80))
    forth = leaderboard({"a": table}, draws=300)
    back = leaderboard({"a": table.sample(frac=1, random_state=1)}, draws=300)
    pd.testing.assert_frame_equal(forth, back)


def test_every_query_is_in_each_way_to_cut_a_suite():
    table = scores(
        np.ones(40), kind=["U1", "U2"] * 20, strength=[0.2, 0.4, 0.4, 0.2] * 10, view_cells=[96] * 20 + [192] * 20
    )
    found = dict(strata(table))
    assert found["all"].all()
    assert (found["U1"] ^ found["U2"]).all()
    steps = [mask for name, mask in found.items() if "cells" in name]
    assert (np.sum(steps, axis=0) == 1).all()
    bins = [mask for name, mask in found.items() if name.startswith("unknown_share")]
    assert (np.sum(bins, axis=0) == 1).all()


def test_a_strength_drawn_from_a_range_has_no_steps():
    table = scores(np.ones(40), kind="trial", strength=np.arange(40) / 100)
    assert not [name for name, _ in strata(table) if "cells" in name]
    assert len([name for name, _ in strata(table.iloc[:24]) if "cells" in name]) == 24


def test_the_texts_say_the_figures_and_what_is_missing():
    tables = {
        "mine": scores([1.0, 99.0, math.inf, math.inf], status=["ok", "ok", "missing", "missing"]),
        "random": scores([99.0] * 4),
    }
    board = leaderboard(tables, draws=200)
    text = board_markdown(ABOUT, Contents(leaderboard=board))
    assert "| mine | 0.250 [" in text
    assert "mine: 2 queries lack a row and count as misses." in text
    assert "4 blocks in 4 places: fewer than 36 in 12" in text
    assert "(c) OpenStreetMap contributors" in text
    latex = board_latex(ABOUT, Contents(leaderboard=board))
    assert latex.count(r"\begin{table}") == latex.count(r"\end{table}") == 1
    assert "success_25m" not in latex.replace(r"\_", "~")
    (short,) = (item.shown for item in overviews_of(Book.of(board)))
    assert short.title.startswith(
        "Too few to rank (fewer than 10 queries or 3 places): success_25m [95 %], localization, searched: disc of 500 m"
    )
    none = wilson(0, 4)
    assert [column.name for column in short.columns] == ["matcher", "occlusion"]
    shown = [text_of(row.cells[1]) for row in short.rows]  # queries stand above, controls below
    assert (shown[0], shown[2]) == ("4", f"0.000 [0.00, {none.hi:.2f}] (control)")
    assert re.fullmatch(r"0\.250 \[0\.\d\d, 0\.\d\d\]", shown[1])  # nobody is ranked
    assert f"| {none.value:.3f} [0.000, {none.hi:.3f}]† |" in text
    assert len(warnings_of(board)) == 2


def test_the_head_of_a_suite_counts_the_queries_of_its_figures_whoever_does_not_answer_them():
    values = {"role": ["stress", "control"] * 4}
    able = scores([1.0, 99.0] * 4, **values)
    board = leaderboard({"able": able, "not": scores([math.inf] * 8, status="not applicable", **values)}, draws=200)
    (short,) = (item.shown for item in overviews_of(Book.of(board)))
    assert short.rows[0].cells[1].text == "4"
    (alone,) = (item.shown for item in overviews_of(Book.of(board[board["matcher"] == "not"])))
    assert alone.rows[0].cells[1].text == "8"


def test_two_versions_of_a_control_are_controls_both():
    names = ("oracle_pose 1 (aaaaaa)", "oracle_pose 1 (bbbbbb)", "mine")
    board = leaderboard({name: scores([1.0, 99.0] * 10, blocks=6) for name in names}, draws=200)
    found = {name: ranks(pick(board, name, "success_25m")) for name in names}
    assert found == {names[0]: (None, None), names[1]: (None, None), "mine": (1, 1)}
    (short,) = (item.shown for item in overviews_of(Book.of(board)))
    shown = [text_of(row.cells[1]).partition("] ")[2] for row in short.rows[1:]]
    assert shown == ["(1)", "(control)", "(control)"]


def test_no_name_breaks_a_table():
    name = r"mine 1|2 <b> \$ {x} ~ ^"
    board = leaderboard({name: scores([1.0, 99.0])}, draws=200)
    lines = board_markdown(ABOUT, Contents(leaderboard=board)).splitlines()
    at, _ = (at for at, line in enumerate(lines) if "mine 1" in line)
    assert r"mine 1\|2 &lt;b>" in lines[at]
    assert lines[at].replace(r"\|", "").count("|") == lines[at - 1].count("|")  # of the rule below the head
    assert "[U+2122]" in board_latex(
        ABOUT, Contents(leaderboard=leaderboard({"mine \u2122": scores([1.0])}, draws=200))
    )
    expected = r"mine 1$|$2 $<$b$>$ \textbackslash{}\$ \{x\} \textasciitilde{} \textasciicircum{}"
    assert expected in board_latex(ABOUT, Contents(leaderboard=board))


def test_the_board_says_what_each_of_its_columns_is():
    tables = {"mine": scores([1.0, 99.0] * 20, confidence=[0.9, 0.1] * 20, is_present=[True] * 30 + [False] * 10)}
    tables["mine"]["is_right"] &= tables["mine"]["is_present"]
    views = dict.fromkeys(tables["mine"]["query_id"], 1)
    costs = cost_figures("mine", Costs(scores=tables["mine"], runs=[], view_bytes=views, area_km2={}))
    rows = FIGURE_SCHEMA.frame(list(integrity_rows("mine", "own", own_confidence(tables["mine"]))))
    board = pd.concat([leaderboard(tables, draws=200), costs, rows], ignore_index=True)
    text = board_markdown(ABOUT, Contents(leaderboard=board)).split("## How to read")[1]
    terms = {line.split("**")[1] for line in text.splitlines() if line}
    shown = {column.term for table in rows_of(Contents(leaderboard=board), MARKDOWN) for column in table.columns}
    assert {markdown(name) for name in shown} <= terms
    assert {"rejector", "false fixes", "latency_p50"} <= shown
    assert "no meaning" not in text


def test_one_query_of_a_kind_and_none_of_another_are_told_as_they_are():
    kinds = ["U1"] * 7 + ["U2"]
    board = leaderboard({"mine": scores([1.0] * 7 + [99.0], kind=kinds, strength=[0.2, 0.4] * 4)}, draws=200)
    row = pick(board, "mine", "success_25m", "U2")
    assert (row["n"], row["blocks"], row["value"], row["interval"]) == (1, 1, 0.0, "wilson")
    assert (row["lo"], row["hi"]) == (0.0, wilson(0, 1).hi)
    assert ranks(row) == (None, None)
    assert math.isnan(row["detectable"])
    assert "U3" not in set(board["stratum"])
    assert "answered_absent" not in set(board["metric"])  # no place was absent


def test_one_of_something_is_reported_in_the_singular():
    board = leaderboard({"mine": scores([1.0], blocks=1, place="here", status="missing")}, draws=200)
    assert warnings_of(board)[0].startswith("1 block in 1 place: fewer than 36 in 12")
    assert warnings_of(board)[1] == "mine: 1 query lacks a row and counts as a miss."
    assert "| 1 in 1 place |" in board_markdown(ABOUT, Contents(leaderboard=board))


def test_a_board_of_nothing_is_an_empty_table():
    assert FIGURE_SCHEMA.frame([]).empty
    assert leaderboard({}).empty
    assert warnings_of(leaderboard({})) == []


def test_of_candidates_a_board_says_what_guessing_is_worth():
    found = {"above": [0, 1, 0, 0], "tied": 1, "right": 1}
    board = leaderboard({"mine": scores([math.nan] * 4, track="retrieval", pool=[10, 10, 50, 50], **found)}, draws=200)
    assert pick(board, "mine", "chance_1")["value"] == pytest.approx((0.1 + 0.02) / 2)
    assert "chance 0.060 (n = 4)" in board_markdown(ABOUT, Contents(leaderboard=board))
    (short,) = (item.shown for item in overviews_of(Book.of(board)))
    heads = [[cell.text for cell in row.cells] for row in short.rows if row.tone == "head"]
    assert heads == [["queries", "4"], ["chance", "0.060"]]


def test_a_paper_gets_contrasts_controls_labels_and_where_data_are_from():
    tables = {"mine": scores([1.0, 99.0] * 4), "other": scores([99.0] * 8)}
    contrast = Contrast(name="first_one", first="mine", second="other", suites=("occlusion",))
    findings = evaluate_contrasts([contrast], tables, {}, draws=200)
    verdict = Verdict(control="twins", matcher="mine", n=4, found=2.0, expected=2.0, p=math.nan, holds=True)
    latex = board_latex(
        ABOUT, Contents(leaderboard=leaderboard(tables, draws=200), findings=findings, verdicts=[verdict])
    )
    labels = re.findall(r"label{tab:(.*)}", latex)
    assert labels == ["contrasts", "board-occlusion-localization-r500-weak-s3", "controls"]
    captions = [line for line in latex.splitlines() if line.startswith(r"\caption")]
    assert all("(c) OpenStreetMap contributors, ODbL" in line for line in captions)
    assert [r"$^\dagger$ Wilson" in line for line in captions] == [False, True, False]
    assert r"first\_one" in latex
    assert "booktabs" in latex.split(r"\begin{table}")[0]
    assert "resizebox" in latex.split(r"\begin{table}")[0]
