# SPDX-License-Identifier: Apache-2.0
"""A stored board as a notebook reads it: its tables, its figures, and what it shows of itself."""

import json
import shutil
from dataclasses import replace
from functools import cache
from pathlib import Path

import pytest
from matplotlib.colors import to_hex
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


def test_a_contrast_has_the_interval_that_decides_and_the_colour_of_its_verdict():
    places = sgb.read_board(TOWNS.parent / "places")
    (chart,) = places.plot_contrasts().axes
    spans = [(each.get_segments()[0], to_hex(each.get_color()[0])) for each in chart.collections]
    colours = {}
    for (span, colour), row in zip(spans, places.contrasts.to_dict("records"), strict=True):
        assert span[:, 0].tolist() == [row["lo_countries"], row["hi_countries"]]
        colours.setdefault(colour, set()).add(row["outcome"])
    assert sorted(map(sorted, colours.values())) == [["cause open", "decided"], ["not decided"], ["null"]]


def test_risk_is_drawn_for_matchers_that_give_a_confidence(board):
    sure = board.scores[board.scores["confidence"].notna() & board.scores["prior_group"].eq(GROUP)]
    titles = [chart.get_title(loc="left").partition("\n")[0] for chart in board.plot_risk(GROUP).axes]
    assert {title for title in titles if title} <= set(sure["matcher"])


# --- on paper ---------------------------------------------------------------------------------------------------------

ON_PAPER = {
    "tradeoff": lambda board: board("towns").plot_tradeoff("clean", width_mm=85),
    "contrasts": lambda board: board("towns").plot_contrasts(width_mm=85),
    "forest": lambda board: board("towns").plot_forest(_first_contrast(board("towns")), width_mm=85),
    "risk": lambda board: board("towns").plot_risk(GROUP, width_mm=85),
    "age": lambda board: board("modules").plot_steps("real-age", GROUP, width_mm=85),
    "strength": lambda board: board("modules").plot_steps("occlusion", GROUP, width_mm=85),
    "distance": lambda board: board("flights").plot_distance("flight-gap", GROUP, width_mm=85),
    "stanford": lambda board: board("modules").plot_stanford(GROUP, matcher="sasgeo", width_mm=85),
}


@cache
def stored(name):
    return sgb.read_board(TOWNS.with_name(name))


def _first_contrast(board):
    return next(one.name for one in board.findings if one.n)


@pytest.mark.parametrize("name", ON_PAPER)
def test_a_figure_on_paper_is_a_column_wide_and_all_its_letters_can_be_read(name, tmp_path):
    figure = ON_PAPER[name](stored)
    wide, high = figure.get_size_inches() * 25.4
    assert wide == pytest.approx(85)
    assert 30 < high < 250
    figure.draw_without_rendering()
    shown = [one for one in figure.findobj(Text) if one.get_visible() and one.get_text().strip()]
    assert min(one.get_fontsize() for one in shown) >= 5.5
    drawn, (across, up) = figure.get_tightbbox(), figure.get_size_inches()  # a tick beyond its axis is not drawn
    assert min(drawn.x0, drawn.y0, across - drawn.x1, up - drawn.y1) > -0.01
    assert len(figure.caption) > 50
    assert "OpenStreetMap" in " ".join(one.get_text() for one in shown)
    for kind in ("svg", "pdf"):
        figure.savefig(tmp_path / f"figure.{kind}")
    assert b"/Subtype /Type3" not in (tmp_path / "figure.pdf").read_bytes()
    assert ">Data: " in (tmp_path / "figure.svg").read_text(encoding="utf-8")  # letters, not outlines


def test_a_figure_on_a_page_is_as_it_was_after_one_on_paper(board):
    before = board.plot_contrasts()
    board.plot_contrasts(width_mm=85)
    after = board.plot_contrasts()
    assert before.get_size_inches().tolist() == after.get_size_inches().tolist()
    assert texts(before) == texts(after)
    assert after.caption == ""


@pytest.mark.parametrize("width_mm", [0, 20, float("nan"), 5000])
def test_a_width_that_no_paper_has_is_refused(board, width_mm):
    with pytest.raises(ConfigError, match="width_mm is from 60 to 400, as 85 for a column"):
        board.plot_contrasts(width_mm=width_mm)


@pytest.mark.parametrize(
    ("ask", "fault"),
    [
        (lambda board: board.plot_forest("no-such"), r"has no answered contrast 'no-such': it has "),
        (lambda board: board.plot_steps("no-such", GROUP), r"has no steps of 'no-such', localization, 'r500-weak-s3'"),
        (lambda board: board.plot_distance("clean", GROUP), r"has no flights of 'clean', 'r500-weak-s3': the columns"),
        (lambda board: board.plot_stanford("r1-weak-s3"), r"has no protection levels at risk 0.01 of any matcher"),
        (
            lambda board: replace(board, folder=Path("nowhere")).plot_stanford(GROUP),
            r"nowhere holds a board alone, and this figure needs truths and answers",
        ),
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
