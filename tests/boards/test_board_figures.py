# SPDX-License-Identifier: Apache-2.0
"""Figures of a board: they show its own figures, are the same bytes each time, and are drawn where there are data."""

import re
from dataclasses import replace

import numpy as np
import pandas as pd
import pytest

from sasgeo_bench.boards import board_figures
from sasgeo_bench.boards.board import Board
from sasgeo_bench.boards.board_figures import figures_extra
from sasgeo_bench.boards.plots import (
    BEYOND_M,
    MOST_MATCHERS,
    BoardPage,
    ages_frame,
    draw_board_bars,
    draw_steps,
    reliability_frame,
    risk_frame,
    shown_matchers,
    stanford_areas,
    stanford_cells,
)
from sasgeo_bench.boards.scored import Scored
from sasgeo_bench.core.canvas import page
from sasgeo_bench.core.progress import reporting
from sasgeo_bench.matching.matcher import Prediction
from sasgeo_bench.running.failures import Failures
from sasgeo_bench.running.prediction_files import StoredAnswers
from sasgeo_bench.sasgeo.conformal import level_name
from sasgeo_bench.scoring.compare import CONTRAST_SCHEMA
from sasgeo_bench.scoring.contrasts import Contrast, by_place, evaluate_contrasts
from sasgeo_bench.scoring.decisions import calibration_error
from sasgeo_bench.scoring.metrics import primary_of
from sasgeo_bench.scoring.protection import protection_frame, protection_levels
from sasgeo_bench.scoring.rejection_rows import answers_of
from sasgeo_bench.scoring.strata import queries_of, steps_frame
from sasgeo_bench.scoring.tables import leaderboard
from tests.handmade import about_of
from tests.scoring.test_tables import scores

CONTRASTS = (
    Contrast(name="graph", first="graph", second="raster", suites=("real-age",)),
    Contrast(name="doubt", first="graph x sure", second="graph x margin", suites=("real-age",), metric="aurc"),
)
COUNT = 120


def asked(seed):
    """Rows of one matcher: controls and two ages at two sizes of view, every tenth place absent."""
    rng, at = np.random.default_rng(seed), np.arange(COUNT)
    step = np.array([0.0, 5.0, 10.0])[at % 3]
    is_present = at % 10 > 0
    table = scores(
        np.where(is_present, np.where(rng.random(COUNT) < 0.9 - 0.06 * step, 2.0, 80.0), np.inf),
        suite="real-age",
        kind=np.where(step > 0, "S1", "control"),
        role=np.where(step > 0, "stress", "control"),
        strength=step,
        strength_unit="years between map and world",
        view_cells=np.where(at % 2, 96, 192),
        is_present=is_present,
    )
    return table.assign(is_answered=True, position_error_m=table["position_error_m"].where(is_present, np.nan))


NOTHING = StoredAnswers.of([])


@pytest.fixture(scope="module")
def board(tmp_path_factory):
    tables = {"raster": asked(1), "graph": asked(2), "oracle_pose": asked(3)}
    rng = np.random.default_rng(4)
    judged = {
        (matcher, rejector): tables[matcher].assign(
            p_right=np.clip(tables[matcher]["is_right"] * 0.6 + 0.4 * rng.random(COUNT), 0, 1)
        )
        for matcher in ("raster", "graph")
        for rejector in ("margin", "sure")
    }
    table = leaderboard(tables, draws=100)
    values = {"rejector": "sure", "metric": "ece", "suite": "all suites", "stratum": "as drawn", "value": 0.1}
    rows = [table.iloc[[0]].assign(matcher=name, **values) for name in ("raster", "graph")]
    levels = {level_name("gauss", 1e-2): 10.0}
    return Scored(
        board=Board(
            folder=tmp_path_factory.mktemp("board"),
            about=about_of([]),
            leaderboard=pd.concat([table, *rows], ignore_index=True),
            contrasts=CONTRAST_SCHEMA.frame(evaluate_contrasts(CONTRASTS, tables, judged, draws=100)),
        ),
        failures=Failures(tmp_path_factory.mktemp("log") / "failures.log"),
        scores=tables,
        predictions={
            name: StoredAnswers.of(
                Prediction(query_id=one, diagnostics=levels if name == "graph" else {}) for one in rows_of(frame)
            )
            for name, frame in tables.items()
        },
        judged=judged,
        measured={
            one: {"age_years": 1.1 * step}
            for one, step in zip(tables["raster"]["query_id"], tables["raster"]["strength"], strict=True)
        },
    )


def rows_of(frame):
    return frame["query_id"].tolist()


def of_table(board, table):
    """The board with these figures and without contrasts."""
    return replace(board, board=replace(board.board, leaderboard=table, contrasts=CONTRAST_SCHEMA.empty()))


def unanswered(board):
    """The board as if nobody had answered: then nobody tells a protection level."""
    return replace(board, scores={name: frame.assign(is_answered=False) for name, frame in board.scores.items()})


@pytest.mark.slow
def test_every_figure_is_drawn_and_has_the_same_bytes_each_time(board, tmp_path):
    lines = []
    with reporting(lines.append):
        figures = figures_extra(board, contrasts=CONTRASTS).figures
    assert set(figures) == {
        "age-real-age-localization-r500-weak-s3.svg",
        "stress-localization-r500-weak-s3.svg",
        "ablation-localization-r500-weak-s3.svg",
        "errors-localization-r500-weak-s3.svg",
        "cost-localization-r500-weak-s3.svg",
        "contrast-graph.svg",
        "contrast-doubt.svg",
        "risk-real-age-localization-r500-weak-s3.svg",
        "risk-all-suites-localization-r500-weak-s3.svg",
        "reliability-localization-r500-weak-s3.svg",
        "stanford-0.01-r500-weak-s3.svg",
    }
    (line,) = lines
    assert line == (
        "figures left out, for nothing on this board is seen in them: success against strength; error along the "
        "way; how far the odometer carries a fix; recall against K; success against cost; success against the drift of "
        "odometers"
    )
    for name, draw in figures.items():
        draw(tmp_path / name)
        text = (tmp_path / name).read_text(encoding="utf-8")
        assert "Data: (c) OpenStreetMap contributors, ODbL</text>" in text
        assert "oracle_pose" not in text  # the control that has the truth is no curve
        assert re.search(r">(n |.*\(n |.*, n )\d", text), name
        assert "<dc:date>" not in text
        draw(tmp_path / "again.svg")
        assert (tmp_path / "again.svg").read_bytes() == (tmp_path / name).read_bytes()


def test_a_board_without_data_has_no_figures_and_says_so(board):
    lines = []
    bare = replace(
        of_table(board, board.board.leaderboard),
        judged={},
        measured={},
        predictions=dict.fromkeys(board.scores, StoredAnswers.of([])),
    )
    with reporting(lines.append):
        assert set(figures_extra(unanswered(bare)).figures) == {
            "strength-real-age-localization-r500-weak-s3.svg",
            "stress-localization-r500-weak-s3.svg",
            "ablation-localization-r500-weak-s3.svg",
            "errors-localization-r500-weak-s3.svg",
        }
    (line,) = lines
    assert line.partition(": ")[2].split("; ") == [
        "registered contrasts, place by place",
        "success against the age of the map",
        "error along the way",
        "how far the odometer carries a fix",
        "risk against coverage",
        "reliability",
        "protection levels against errors",
        "recall against K",
        "success against cost",
        "the cost of decisions",
        "success against the drift of odometers",
    ]


def test_points_are_those_of_the_board_at_the_ages_that_maps_had(board):
    queries = queries_of(board.scores)
    steps = steps_frame(board.board.leaderboard, queries, ["graph"])
    assert sorted(set(zip(steps["strength"], steps["view_cells"], strict=True))) == [
        (step, size) for step in (0.0, 5.0, 10.0) for size in (96, 192)
    ]
    mine = board.scores["graph"]
    mine = mine[(mine["strength"] == 5.0) & (mine["view_cells"] == 96) & mine["is_present"]]
    (row,) = steps[(steps["strength"] == 5.0) & (steps["view_cells"] == 96)].to_dict("records")
    assert (row["n"], row["value"]) == (len(mine), primary_of("localization").values(mine).mean())
    ages = ages_frame(steps, queries, board.measured)
    assert ages["age_years"].tolist() == pytest.approx((1.1 * ages["strength"]).tolist())
    assert len(ages_frame(steps, queries, {})) == 0


def test_prior_groups_are_never_in_one_figure(board):
    other = {
        name: frame.assign(prior_group="rnone-weak-s3", query_id="x" + frame["query_id"])
        for name, frame in board.scores.items()
    }
    both = {name: pd.concat([board.scores[name], frame], ignore_index=True) for name, frame in other.items()}
    table = leaderboard(both, draws=100)
    apart = replace(of_table(board, table), scores=both, judged={}, predictions=dict.fromkeys(both, NOTHING))
    both_named = [name for name in figures_extra(unanswered(apart)).figures if "stress" in name]
    assert both_named == ["stress-localization-r500-weak-s3.svg", "stress-localization-rnone-weak-s3.svg"]
    steps = steps_frame(table, queries_of(both), ["graph"])
    assert set(steps.groupby(["suite", "track", "prior_group"]).size().index.get_level_values(2)) == {
        "r500-weak-s3",
        "rnone-weak-s3",
    }


def test_many_matchers_are_cut_to_those_of_contrasts_and_a_few_beside_them():
    names = [*(f"m{at:02d}" for at in range(20)), "raster_uniform", "sasgeo_hand", "sasgeo_oracle", "oracle_pose"]
    table = pd.DataFrame({"matcher": names, "rejector": "", "stratum": "all", "metric": "success_25m"})
    table["value"] = np.linspace(0, 1, len(names))
    contrasts = [Contrast(name="x", first="m07 x margin", second="m03 x margin", suites=())]
    arms = ("raster_uniform", "sasgeo_hand", "sasgeo_oracle")
    assert shown_matchers(table, contrasts) == ("m03", "m07", *arms)
    best = shown_matchers(table, [])
    assert best[:2] == ("sasgeo_oracle", "sasgeo_hand")
    assert len(best) == MOST_MATCHERS
    assert shown_matchers(table.head(3), contrasts) == ("m00", "m01", "m02")
    flown = table.assign(metric="distance_within_25m", matcher="t" + table["matcher"]).iloc[:20]
    both = shown_matchers(pd.concat([table, flown]), [])
    assert both == (*best, *(f"tm{at:02d}" for at in range(19, 19 - MOST_MATCHERS, -1)))


def test_bins_of_a_reliability_figure_make_up_the_calibration_error(board):
    rows = reliability_frame(board.judged, {("graph", "sure")}, ["graph"])
    assert rows["n"].sum() == COUNT
    error = (rows["n"] * (rows["predicted"] - rows["observed"]).abs()).sum() / COUNT
    assert error == pytest.approx(calibration_error(answers_of(board.judged["graph", "sure"])))
    assert (rows["lo"] <= rows["observed"]).all()
    assert (rows["observed"] <= rows["hi"]).all()


def test_a_curve_ends_where_all_answers_are_accepted_and_mixtures_are_of_all_suites(board):
    rows = risk_frame(board.judged, ["graph"])
    assert set(rows.loc[rows["suite"] == "real-age", "mixture"]) == {"as drawn"}
    whole = rows[(rows["suite"] == "all suites") & (rows["rejector"] == "sure")]
    assert list(dict.fromkeys(whole["mixture"])) == ["as drawn", "present 0.9", "present 0.7", "present 0.5"]
    drawn = whole[whole["mixture"] == "as drawn"]
    assert drawn["coverage"].iloc[-1] == 1.0
    assert drawn["risk"].iloc[-1] == pytest.approx((~board.scores["graph"]["is_right"]).mean())
    assert drawn["coverage"].is_monotonic_increasing


def test_areas_of_a_stanford_figure_are_those_of_the_board(board):
    answers, table = board.predictions["graph"], board.scores["graph"]
    (given,) = protection_levels(table, answers)
    areas = stanford_areas(given, 25.0)
    assert sum(areas.values()) == stanford_cells(given)["n"].sum() == COUNT
    frame = protection_frame("graph", table, answers)
    (row,) = frame[frame["alert_limit_m"] == 25.0].to_dict("records")
    assert areas["hazardous"] == round(COUNT * row["hazardous"])
    assert areas["misleading"] == round(COUNT * (row["misleading"] - row["hazardous"]))
    cells = stanford_cells(given)
    absent = int((~table["is_present"]).sum())  # an error without end
    assert cells.loc[cells["error_m"] == BEYOND_M, "n"].sum() == absent


def test_a_figure_writes_each_style_once_and_a_long_label_whole(tmp_path):
    label = "share of the view that is hidden; in U3 of where trees and shadows hide thin classes, and more words"
    with page(tmp_path / "one.svg", BoardPage(title="One", note="", below=label)) as charts:
        charts[0][0].plot([0, 1], [0, 1])
    text = (tmp_path / "one.svg").read_text(encoding="utf-8")
    styles = re.findall(r' style="([^"]*)"', text)
    assert len(styles) == len(set(styles))
    assert {name for names in re.findall(r' class="([^"]*)"', text) for name in names.split()} == set(
        re.findall(r"\.(s\d+)\{", text)
    )
    lines = [line for line in re.findall(r">([^<>]{4,})</t", text) if line in label]
    assert len(lines) > 1  # broken, where one line would begin left of the page
    assert " ".join(lines) == label


def test_kinds_of_one_size_stand_beside_each_other(tmp_path):
    rows = pd.DataFrame({"matcher": "graph", "kind": list("abcde"), "view_cells": 192, "strength": 1.0, "n": 6})
    rows = rows.assign(suite="occlusion", track="localization", prior_group="r500", strength_unit="m", value=0.5)
    draw_steps(tmp_path / "a.svg", rows.assign(lo=0.4, hi=0.6), ["graph"])
    draw_steps(tmp_path / "b.svg", rows.assign(lo=0.4, hi=0.6, view_cells=[96, 192, 192, 192, 192]), ["graph"])
    wide, tall = ((tmp_path / name).read_text(encoding="utf-8") for name in ("a.svg", "b.svg"))
    size = re.compile(r'width="([\d.]+)pt" height="([\d.]+)pt"')
    width, height = map(float, size.search(wide).groups())
    assert width > height
    width, height = map(float, size.search(tall).groups())
    assert width < height


def test_a_stanford_figure_is_of_few_matchers_those_of_contrasts_first(board, monkeypatch):
    answers = dict.fromkeys(board.scores, board.predictions["graph"])
    both = replace(board, predictions=answers)
    name = "stanford-0.01-r500-weak-s3.svg"

    def rows(contrasts=CONTRASTS):
        drawn = figures_extra(both, contrasts=contrasts).figures[name]
        return {matcher for matcher, _ in drawn.keywords["levels"]}

    assert rows() == {"raster", "graph"}
    monkeypatch.setattr(board_figures, "MOST_STANFORD", 1)
    assert rows() == {CONTRASTS[0].second}


@pytest.mark.parametrize("contrast", CONTRASTS, ids=lambda item: item.name)
def test_a_contrast_at_one_place_is_that_of_a_board_of_the_place(board, contrast):
    places = by_place(contrast, board.scores, board.judged, draws=100)
    assert [one.place for one in places] == sorted({place for one in board.scores.values() for place in one["place"]})
    for one in places:
        here = {name: frame[frame["place"] == one.place] for name, frame in board.scores.items()}
        judged = {key: frame[frame["place"] == one.place] for key, frame in board.judged.items()}
        (alone,) = evaluate_contrasts([contrast], here, judged, draws=100)
        assert (one.n, one.blocks) == (alone.n, alone.blocks)
        assert one.difference == pytest.approx(alone.difference)
        assert one.lo <= one.difference <= one.hi


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("name", ["m" * 121, "m" * 60 + " " + "m" * 60])
def test_the_widest_names_leave_room_for_their_bars(tmp_path, name):
    mine = pd.DataFrame({"matcher": [name, "sasgeo"], "value": [0.3, 0.5], "lo": [0.1, 0.2], "hi": [0.5, 0.8]})
    with page(tmp_path / "bars.svg", BoardPage(title="Bars", panel_inches=(3.0, 0.8))) as ((chart,),):
        draw_board_bars(chart, mine, [name, "sasgeo"])
    assert chart.bbox.width / chart.get_figure(root=True).dpi > 2.9  # inches
