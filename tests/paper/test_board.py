# SPDX-License-Identifier: Apache-2.0
"""The paper's experiment as one command: table, trials and figures with the board, drawn once, resampled by seed."""

import json
from dataclasses import replace

import pandas as pd
import pytest
import sasgeo_paper
from sasgeo_paper.board import extra

from sasgeo_bench.boards.board_files import check_board
from sasgeo_bench.boards.pipeline_spec import PipelineFile
from sasgeo_bench.core.config import parse_toml
from sasgeo_bench.core.progress import reporting
from sasgeo_bench.experiments.pipeline import run_pipeline
from sasgeo_bench.experiments.pipeline_plan import board_folder, plan_pipeline
from sasgeo_bench.scoring.score import SCORER_VERSION
from sasgeo_bench.tasks import task_files
from tests.threaded import threaded

pytestmark = [pytest.mark.slow, pytest.mark.usefixtures("in_threads")]

TEXT = """
id = "few"
title = "Few"
matchers = ["random", "oracle_pose", "global_descriptor"]
draws = 200

[paper]
seeds = [42, 43]
trials = 3
crop_readings = ["smaller"]

[[contrast]]
name = "description"
first = "global_descriptor"
second = "random"
suites = ["paper-poc"]
track = "retrieval"
"""
FIGURES = ("ablation", "example", "risk-coverage", "robustness")


def planned(out, text=TEXT):
    return plan_pipeline(parse_toml(text, PipelineFile, source="few.toml"), out=out)


@pytest.fixture(scope="module")
def made(tmp_path_factory, few_controls, without_drawings, lay_towns):  # noqa: ARG001
    """Two seeds, then a board of the first alone from the same trials and answers, without its figures."""
    out = lay_towns(tmp_path_factory.mktemp("paperboard") / "out", "town-suburb")
    with threaded():
        plan = planned(out)
        before = plan.to_text()
        board = run_pipeline(plan)
        lines = []
        one = planned(out, TEXT.replace('id = "few"', 'id = "one"').replace("[42, 43]", "[42]"))
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(sasgeo_paper, "extra", lambda *about, **more: replace(extra(*about, **more), figures={}))
            with reporting(lines.append):
                run_pipeline(one)
    return plan, board, one, lines, before


def test_trials_are_drawn_once_and_asked_once(made):
    plan, _, one, lines, before = made
    assert "3 trials of each seed: 0 of 4 tasks up to date, 4 to be drawn" in before
    assert "3 trials of each seed: 4 of 4 tasks up to date" in plan.to_text()
    assert "to be drawn" not in plan.to_text() + one.to_text()
    asked = [line.split(",")[0] for line in lines if "to ask" in line]
    assert asked == [f"{name}: 0 queries to ask" for name in (*plan.matchers, "fft_vote")]


def test_the_board_holds_table_trials_and_figures(made):
    plan, board, *_ = made
    folder = board_folder(plan)
    trials = pd.read_parquet(folder / "trials.parquet")
    assert len(trials) == 4 * 2 * 3
    assert set(trials["seed"]) == {42, 43}
    truths = {
        truth.query_id: truth
        for seed in (42, 43)
        for truth in task_files.read_truths(plan.out / "truth" / "paper-poc" / f"paper-poc-{seed}")
    }
    for row in trials.to_dict("records"):
        assert {name: row[name] for name in truths[row["query_id"]].measured} == truths[row["query_id"]].measured
        assert row["margin"] == pytest.approx(row["score_first"] - row["score_second"], abs=1e-8, nan_ok=True)
    oracle = trials[trials["matcher"] == "oracle_pose"]
    assert (oracle["rank_best"] == 1).all()
    summary = pd.read_parquet(folder / "paper.parquet")
    assert set(summary["matcher"]) == {entry.name for entry in board.board.about.entries}
    text = (folder / "paper.md").read_text(encoding="utf-8")
    assert "6 trials of 2 seeds (42, 43)" in text
    assert "no OSM data" in text
    assert "| Global descriptor | 0.586 [0.520, 0.649] |" in text
    assert "oracle_pose" in text
    assert list(summary["crop"].unique()) == ["unknown", "smaller"]
    assert "| not in the view, which is smaller | Global descriptor |" in text
    drawn = {path.name for path in (folder / "figures").iterdir()}
    assert drawn == {f"{name}.{kind}" for name in FIGURES for kind in ("png", "svg")}


def test_a_board_can_be_scored_again_where_it_lies(made):
    plan, *_ = made
    check_board(board_folder(plan), scorer_version=SCORER_VERSION)


def test_several_seeds_are_resampled_by_seed_one_by_its_tiles(made):
    plan, board, one, *_ = made
    for name, cluster, blocks in ((plan, "seed", 2), (one, "tile", 3)):
        summary = pd.read_parquet(board_folder(name) / "paper.parquet")
        assert set(summary["cluster"]) == {cluster}
        assert summary["clusters"].max() <= blocks
        record = json.loads((board_folder(name) / "board.json").read_text(encoding="utf-8"))
        assert record["by_region"] == (["paper-poc", "paper-poc-crop-smaller"] if cluster == "seed" else [])
    assert set(board.scores["random"]["block"]) == {"paper-poc-42", "paper-poc-43"}
    rows = board.board.leaderboard[
        (board.board.leaderboard["stratum"] == "all") & (board.board.leaderboard["suite"] == "paper-poc")
    ]
    assert set(rows["blocks"]) == {2}
    assert board.board.findings[0].blocks == 2


def test_figures_are_the_same_bytes_again_and_say_what_they_are_of(made, tmp_path):
    plan, board, *_ = made
    before = {path.name: path.read_bytes() for path in (board_folder(plan) / "figures").iterdir()}
    for name, draw in extra(board, root=plan.out).figures.items():
        draw(tmp_path / name)
        assert (tmp_path / name).read_bytes() == before[name]
    for name in FIGURES:
        assert "Data: procedural regions, no OSM data in them" in before[f"{name}.svg"].decode()
        assert before[f"{name}.png"].startswith(b"\x89PNG")
    assert "ours, n = 6" in before["ablation.svg"].decode()
    assert "by resampling 2 seeds" in before["ablation.svg"].decode()
