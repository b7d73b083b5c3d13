# SPDX-License-Identifier: Apache-2.0
"""What is still unsolved: rules worked by hand, and the page and the shipped file as the stored boards say."""

import pytest

from benchmarks import unsolved
from sasgeo_bench.boards.headroom import Headroom, headroom_of, read_headroom
from sasgeo_bench.regions.region import DATA_VERSION

RESULTS = unsolved.ROOT / "docs" / "results"


def row(**changes):
    plain = {
        "suite": "clean", "track": "localization", "prior_group": "r500-weak-s3", "perceived": "", "n": 30, "places": 9,
        "metric": "success_25m", "board": "a", "matcher": "m", "value": 0.5, "lo": 0.4, "hi": 0.6, "ceiling": 1.0,
        "state": "open", "data_version": DATA_VERSION,
    }  # fmt: skip
    return Headroom(**plain | changes)


def test_the_page_and_the_shipped_file_are_what_the_command_makes(capsys, monkeypatch, tmp_path):
    """Else run `python -m benchmarks.unsolved --write`."""
    page, stored = tmp_path / "unsolved.md", tmp_path / "headroom.json"
    before = unsolved.PAGE.read_text(encoding="utf-8")
    page.write_text(unsolved.page_of(before, "old"), encoding="utf-8")
    expected = unsolved.STORED.read_text(encoding="utf-8")
    monkeypatch.setattr(unsolved, "PAGE", page)
    monkeypatch.setattr(unsolved, "STORED", stored)
    unsolved.main(["--write"])
    printed = capsys.readouterr().out
    assert page.read_text(encoding="utf-8") == before
    assert printed.rstrip("\n") in before
    assert stored.read_text(encoding="utf-8") == expected


def test_the_board_of_the_most_places_counts_and_there_the_best_of_any_segmenter():
    rows = [
        row(value=0.9, hi=0.95, places=7, board="few"),
        row(value=0.5, matcher="worse"),
        row(value=0.6, hi=0.7, matcher="better", perceived="forest", n=20),
        row(value=0.55, matcher="same queries", board="b"),
        row(value=0.99, hi=1.0, board="fewer queries", n=29),
    ]
    assert [one.matcher for one in unsolved.best_of(rows)] == ["better"]


def test_a_board_that_can_be_entered_counts_before_others_and_they_have_no_command():
    rows = [row(places=30, board="closed", data_version=DATA_VERSION - 1), row(value=0.45)]
    assert [one.board for one in unsolved.best_of(rows)] == ["a"]
    few = unsolved.best_of([rows[0], row(places=5, state="too few")])
    assert [one.board for one in few] == ["closed"]
    text = "\n".join(unsolved.lines(few))
    assert "on [closed](results/closed/leaderboard.md), closed |" in text
    assert "sasgeo-bench enter" not in text


def test_what_is_open_comes_first_the_most_headroom_first():
    rows = [
        row(suite="season", state="saturated", value=0.97),
        row(suite="growth", state="too few", value=0.1),
        row(suite="clean", value=0.8),
        row(suite="alias", value=0.3, ceiling=0.625),
    ]
    best = unsolved.best_of(rows)
    assert [one.suite for one in best] == ["alias", "clean", "growth", "season"]
    assert [one.headroom for one in best] == [0.325, 0.2, 0.9, 0.03]
    text = "\n".join(unsolved.lines(best))
    heads = [line for line in text.splitlines() if line.startswith("## ")]
    assert heads == ["## Open", "## Too few to say", "## Saturated: nothing to report", "## Not asked by these boards"]
    assert text.count("sasgeo-bench enter docs/results/a --matcher my-matcher") == 2  # none for what is saturated


def test_rows_of_a_board_are_of_ranked_entries_and_of_rejectors_that_keep_their_word():
    rows = list(unsolved.rows_of(RESULTS / "modules"))
    names = {one.matcher.partition(" with ")[0] for one in rows}
    assert not names & {"oracle_pose", "random", "prior_centre", "prior_only"}
    kept = [one for one in rows if one.metric == unsolved.REJECTION and one.suite == "absent"]
    assert "sasgeo with margin_nms" in {one.matcher for one in kept}
    assert {one.n for one in kept} == {350}
    found = [one for one in rows if one.suite == "alias" and one.metric == "recall_1"]
    assert {one.ceiling for one in found} == {0.625}


def test_views_of_a_segmenter_that_is_given_the_truth_are_left_out():
    perceived = {one.perceived for one in unsolved.rows_of(RESULTS / "aerial")}
    assert "pixel_forest" in perceived
    assert "oracle_segmenter" not in perceived


def test_a_folder_that_is_no_board_is_reported_in_one_line(tmp_path, capsys):
    with pytest.raises(SystemExit):
        unsolved.main([str(tmp_path)])
    assert f"{tmp_path} holds no board: score some runs first" in capsys.readouterr().err


def test_the_shipped_rows_are_ordered_and_a_suite_has_its_first():
    rows = read_headroom()
    assert list(rows) == sorted(rows, key=lambda one: (*one.order, one.prior_group, one.metric))
    assert headroom_of("real-image") == next(one for one in rows if one.suite == "real-image")
