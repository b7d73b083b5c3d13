# SPDX-License-Identifier: Apache-2.0
"""A stored board as a notebook reads it: its tables, its figures, and what it shows of itself."""

import json
import shutil
from pathlib import Path

import pytest
from matplotlib.legend import Legend
from matplotlib.text import Text

import sasgeo_bench as sgb
from sasgeo_bench.boards.plots import ranked_matchers
from sasgeo_bench.core.errors import ConfigError, StoreError
from sasgeo_bench.scoring.rows import is_unranked

TOWNS = Path(__file__).parents[2] / "docs" / "results" / "towns"
GROUP = "r500-weak-s3"


@pytest.fixture(scope="module")
def board():
    return sgb.read_board(TOWNS)


def texts(figure):
    """Every text of a figure."""
    return [item.get_text() for item in figure.findobj(Text)]


def test_a_board_has_its_tables_as_data_frames(board):
    about = json.loads((TOWNS / "board.json").read_text(encoding="utf-8"))
    assert [entry.model_dump() for entry in board.about.entries] == about["entries"]
    assert set(board.leaderboard["matcher"]) == {entry["name"] for entry in about["entries"]}
    assert {"name", "difference", "lo", "hi", "verdict"} <= set(board.contrasts)
    assert {"matcher", "query_id", "is_right"} <= set(board.scores)


def test_the_tradeoff_has_a_panel_for_each_prior_group_and_names_controls_apart(board):
    figure = board.plot_tradeoff("clean")
    asked = board.scores[board.scores["suite"].eq("clean") & board.scores["track"].eq("localization")]
    assert len([chart for chart in figure.axes if chart.get_visible()]) == asked["prior_group"].nunique()
    legend = {label.get_text() for one in figure.findobj(Legend) for label in one.get_texts()}
    ranked = set(ranked_matchers(board.leaderboard))
    controls = {name.removesuffix(" (control)") for name in legend - ranked}
    assert {"prior_centre", "random"} <= controls
    assert all(map(is_unranked, controls))
    assert not controls & set(texts(figure))  # no name beside a mark, where it would lie on its neighbour's


def test_each_control_of_the_tradeoff_has_a_mark_of_its_own(board):
    figure = board.plot_tradeoff("clean")
    (keys,) = [one.legend_handles for one in figure.findobj(Legend)]
    marks = {key.get_label(): key.get_marker() for key in keys if key.get_label().endswith(" (control)")}
    assert len(set(marks.values())) == len(marks) > 1
    drawn = {line.get_marker() for chart in figure.axes for line in chart.lines if len(line.get_xdata())}
    assert set(marks.values()) <= drawn


def test_the_suite_of_the_tradeoff_is_the_one_that_most_matchers_were_asked(board):
    ranked = board.scores[board.scores["matcher"].isin(ranked_matchers(board.leaderboard))]
    counts = ranked[ranked["track"] == "localization"].groupby("suite")["matcher"].nunique()
    (title,) = [text for text in texts(board.plot_tradeoff()) if text.startswith("Success against latency")]
    assert counts[title.removeprefix("Success against latency: ").partition(",")[0]] == counts.max()


def test_every_contrast_with_queries_is_drawn_with_its_sides(board):
    (chart,) = board.plot_contrasts().axes
    drawn = [label.get_text() for label in chart.get_yticklabels()]
    known = board.contrasts[board.contrasts["n"] > 0]
    assert drawn == [f"{row['name']}: {row['first']} - {row['second']}" for _, row in known.iterrows()]


def test_risk_is_drawn_for_matchers_that_give_a_confidence(board):
    sure = board.scores[board.scores["confidence"].notna() & board.scores["prior_group"].eq(GROUP)]
    titles = [chart.get_title(loc="left").partition("\n")[0] for chart in board.plot_risk(GROUP).axes]
    assert {title for title in titles if title} <= set(sure["matcher"])


@pytest.mark.parametrize(
    ("ask", "fault"),
    [
        (lambda board: board.plot_tradeoff("no-such-suite"), r"has no latencies of 'no-such-suite', localization: its"),
        (
            lambda board: board.plot_risk("r1-weak-s3"),
            r"has no confidences on 'all suites', localization, 'r1-we",
        ),
    ],
)
def test_what_a_board_does_not_hold_is_said_in_a_line(board, ask, fault):
    with pytest.raises(ConfigError, match=fault):
        ask(board)


def test_a_folder_without_a_board_is_refused(tmp_path):
    with pytest.raises(StoreError, match="holds no board: score some runs first"):
        sgb.read_board(tmp_path)


def test_what_a_board_shows_of_itself_runs_no_script_of_its_own(tmp_path):
    folder = Path(shutil.copytree(TOWNS, tmp_path / "<img onerror=x>"))
    about = json.loads((folder / "board.json").read_text(encoding="utf-8"))
    about["attribution"] = "<script>alert(1)</script>"
    (folder / "board.json").write_text(json.dumps(about), encoding="utf-8")
    shown = sgb.read_board(folder)._repr_html_()
    assert "&lt;script&gt;alert(1)" in shown
    assert "<script" not in shown
    assert "<img" not in shown
