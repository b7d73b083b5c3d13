# SPDX-License-Identifier: Apache-2.0
"""Stored results: scored again they give the same board, they are small, and are there whole or not at all."""

import json
import shutil
from dataclasses import replace
from pathlib import Path

import pandas as pd
import pyarrow.parquet as pq
import pytest

from sasgeo_bench import packing
from sasgeo_bench.boardpictures import pictures_extra
from sasgeo_bench.boards import ScoreRequest
from sasgeo_bench.errors import ConfigError, StoreError
from sasgeo_bench.packing import laid_out, pack_board, score_all, stored_settings
from sasgeo_bench.pipeline import plan_pipeline, run_pipeline
from sasgeo_bench.pipelinefile import PipelineFile
from sasgeo_bench.query import base_of
from sasgeo_bench.report.contrasts import Contrast
from sasgeo_bench.store import packfile
from sasgeo_bench.store.packfile import read_settings
from sasgeo_bench.tomlfile import parse_toml

PIPELINE = """
id = "kept"
title = "Kept"
split = "crossfit"
regions = ["town-suburb", "town-agricultural"]
matchers = ["learners:Counts", "random", "prior_centre"]
rejectors = ["margin_nms"]
draws = 100

[[task]]
suites = ["clean"]
sites = 1

[learning]
suites = ["clean"]
most = 5

[[contrast]]
name = "nothing"
first = "random"
second = "prior_centre"
suites = ["clean"]
"""
TABLES = ("leaderboard", "scores", "contrasts", "falsifiers", "controls")


@pytest.fixture(scope="module")
def kept(tmp_path_factory, few_controls):  # noqa: ARG001
    """A board of a pipeline with its stored results, and what was told."""
    out, lines = tmp_path_factory.mktemp("packing"), []
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(str(Path(__file__).parent / "run"))
        plan = plan_pipeline(parse_toml(PIPELINE, PipelineFile, source="kept.toml"), out=out / "out", tell=lines.append)
        board = run_pipeline(plan, tell=lines.append, results=out / "results")
    return board, plan, out / "results" / "kept", lines


def test_scored_again_stored_results_give_the_same_board(kept, program, tmp_path):
    _, plan, folder, _ = kept
    code, _, err = program("score", "--predictions", folder, "--truth", folder, "--name", "again", "--out", tmp_path)
    assert code == 3, err  # the matcher that learns answers blind views: so says the board itself
    first, again = plan.out / "boards" / "kept", tmp_path / "boards" / "again"
    assert {path.name for path in first.iterdir()} == {path.name for path in again.iterdir()}
    for name in (*(f"{table}.parquet" for table in TABLES), "leaderboard.csv", "leaderboard.md", "board.json"):
        assert (first / name).read_bytes() == (again / name).read_bytes(), name
    for path in (path for kind in ("figures", "pictures") for path in (first / kind).rglob("*.*")):
        assert path.read_bytes() == (again / path.relative_to(first)).read_bytes(), path.name
    assert f"pictures are those that {folder} holds" in err


def test_stored_pictures_are_kept_without_cases_where_none_are_wanted(kept, tmp_path):
    _, _, folder, _ = kept
    lines = []
    files = pictures_extra(kept[0], tell=lines.append, root=tmp_path, kept=folder, has_cases=False).pictures
    assert json.loads(files["pictures.json"])["cases"] == []
    assert {name.partition("/")[0] for name in files} == {"pictures.json", "regions", "suites"}
    bare = shutil.copytree(folder, tmp_path / "bare")
    shutil.rmtree(bare / "pictures")
    assert pictures_extra(kept[0], tell=lines.append, root=tmp_path, kept=bare).pictures == {}
    assert lines[-1] == f"no pictures: {bare} holds none, and no views to draw them of"
    (bare / "pictures").mkdir()
    (bare / "pictures" / "pictures.json").write_text("[", encoding="utf-8")
    with pytest.raises(StoreError, match=r"pictures.json is damaged: remove the folder"):
        pictures_extra(kept[0], tell=lines.append, root=tmp_path, kept=bare, has_cases=False)


def test_stored_results_hold_the_board_and_what_it_was_made_of(kept):
    board, plan, folder, lines = kept
    names = {path.name for path in folder.iterdir()}
    assert names == {
        *(f"{table}.parquet" for table in (*TABLES, "runs", "tasks", "queries", "truths")),
        *("leaderboard.csv.gz", "leaderboard.md", "leaderboard.tex", "board.json", "pack.json"),
        *("figures", "pictures", "predictions", "learned"),
    }
    pd.testing.assert_frame_equal(
        pd.read_csv(folder / "leaderboard.csv.gz"), pd.read_csv(plan.out / "boards" / "kept" / "leaderboard.csv")
    )
    assert "evidence" not in pq.read_schema(folder / "queries.parquet").names
    stored = {path.name.rpartition("-")[0] for path in (folder / "predictions").iterdir()}
    assert stored == {"counts", "random", "prior_centre", "oracle_pose", "fft_vote"}
    assert len(list((folder / "learned").rglob("*.json"))) == 2  # one of each half
    count = sum(len(rows) for rows in board.predictions.values())
    (said,) = [line for line in lines if f"{count} predictions" in line]
    assert said.startswith(f"{folder}: 0.")
    assert read_settings(folder)["dropped"] == ""


def test_stored_results_are_scored_without_a_region(kept, program, tmp_path):
    _, _, folder, _ = kept
    towns = pq.read_table(folder / "tasks.parquet", columns=["region_json"])["region_json"].to_pylist()
    region = json.loads(next(item for item in towns if item))["id"]
    code, _, err = program(
        "score", "--predictions", folder, "--name", "fewer", "--without", region, "--draws", "100", "--out", tmp_path
    )
    assert code in {0, 3}, err
    scores = pd.read_parquet(tmp_path / "boards" / "fewer" / "scores.parquet")
    assert len(scores)
    assert region not in {base_of(name) for name in scores["region"]}


def test_what_is_too_large_is_stored_without_pictures_then_without_headings_or_refused_and_the_old_one_stays(
    kept, tmp_path
):
    board, plan, _, _ = kept
    request = request_of(plan)
    whole = pack_board(board, request, tmp_path / "kept").packed
    bare = pack_board(board, request, tmp_path / "kept", most_bytes=whole.total_bytes - 1).packed
    assert bare.dropped == "pictures of regions, suites and cases"
    assert not (tmp_path / "kept" / "pictures").exists()
    assert bare.prediction_bytes == whole.prediction_bytes
    lean = pack_board(board, request, tmp_path / "kept", most_bytes=bare.total_bytes - 1).packed
    assert lean.total_bytes < bare.total_bytes
    assert lean.dropped.startswith("pictures of regions, suites and cases; heading and scale of all poses")
    pack_board(board, request, tmp_path / "kept", most_bytes=lean.total_bytes - 1)
    assert {path.name.partition(".")[2] for path in (tmp_path / "kept" / "figures").iterdir()} == {"svg.gz"}
    before = (tmp_path / "kept" / "pack.json").read_bytes()
    with pytest.raises(
        StoreError, match=r"would hold 0\.\d MB \(0\.\d MB of predictions\), 0\.001 MB at most: store a"
    ):
        pack_board(board, request, tmp_path / "kept", most_bytes=1000)
    assert (tmp_path / "kept" / "pack.json").read_bytes() == before
    assert [path.name for path in tmp_path.iterdir() if path.suffix != ".lock"] == ["kept"]


def test_a_lean_store_gives_the_same_scores(kept, program, tmp_path):
    board, plan, folder, _ = kept
    files = [path for path in folder.rglob("*") if path.is_file() and "pictures" not in path.parts]
    most = sum(path.stat().st_size for path in files) - 1
    pack_board(board, request_of(plan), tmp_path / "kept", most_bytes=most)
    code, _, err = program("score", "--predictions", tmp_path / "kept", "--name", "again", "--out", tmp_path / "out")
    assert code == 3, err
    for name in TABLES:
        first = pd.read_parquet(plan.out / "boards" / "kept" / f"{name}.parquet")
        pd.testing.assert_frame_equal(first, pd.read_parquet(tmp_path / "out" / "boards" / "again" / f"{name}.parquet"))


def test_stored_again_nothing_but_the_board_changes(kept, program, tmp_path):
    board, plan, folder, _ = kept
    program("score", "--predictions", folder, "--name", "kept", "--results", tmp_path / "same", "--out", tmp_path)
    files = {path.relative_to(folder): path.read_bytes() for path in folder.rglob("*") if path.is_file()}
    place = tmp_path / "same" / "kept"
    assert {path.relative_to(place): path.read_bytes() for path in place.rglob("*") if path.is_file()} == files
    lean = tmp_path / "lean" / "kept"  # what is left out stays said
    total = pack_board(board, request_of(plan), lean).packed.total_bytes
    for _ in range(2):  # without pictures, then without headings
        total = pack_board(board, request_of(plan), lean, most_bytes=total - 1).packed.total_bytes
    dropped = read_settings(lean)["dropped"]
    assert "heading and scale" in dropped
    _, _, err = program("score", "--predictions", lean, "--name", "kept", "--results", lean.parent, "--out", tmp_path)
    assert read_settings(lean)["dropped"] == dropped, err


@pytest.mark.parametrize(
    ("flag", "words"),
    [
        ("--without", "a board without some regions is not stored: leave --without or --results away"),
        ("--predictions", r"mine.parquet is a file of predictions: only boards of runs are stored"),
        ("--submissions", "submissions stay apart from the results of their board: leave --sub"),
    ],
)
def test_what_is_no_whole_board_of_runs_is_not_stored(kept, tmp_path, flag, words):
    _, _, folder, _ = kept
    (tmp_path / "mine.parquet").touch()
    more = {"--predictions": {"predictions": [folder, tmp_path / "mine.parquet"]}}.get(
        flag, {flag.removeprefix("--"): ("mine",)}
    )
    asked = ScoreRequest(predictions=[folder], root=tmp_path, board=tmp_path / "board")
    with pytest.raises(ConfigError, match=words):
        score_all(replace(asked, **more), tell=lambda _: None, results=tmp_path / "results")
    assert not (tmp_path / "results").exists()


def request_of(plan):
    return ScoreRequest(
        predictions=[],
        root=plan.out,
        board=plan.out / "boards" / "kept",
        split=plan.requests[0].split,
        rejectors=plan.spec.rejectors,
        contrasts=[Contrast(name="nothing", first="random", second="prior_centre", suites=("clean",))],
        draws=plan.spec.draws,
    )


def test_a_store_that_is_cut_off_leaves_the_old_one_whole(kept, tmp_path, monkeypatch):
    board, plan, _, _ = kept
    pack_board(board, request_of(plan), tmp_path / "kept")
    before = {path.name: path.read_bytes() for path in (tmp_path / "kept").iterdir() if path.is_file()}

    def cut_off(*_, **__):
        raise KeyboardInterrupt

    monkeypatch.setattr(packfile, "_write_predictions", cut_off)
    with pytest.raises(KeyboardInterrupt):
        pack_board(board, request_of(plan), tmp_path / "kept")
    assert {path.name: path.read_bytes() for path in (tmp_path / "kept").iterdir() if path.is_file()} == before


def test_a_folder_of_something_else_is_not_replaced(kept, tmp_path):
    board, plan, _, _ = kept
    (tmp_path / "notes.txt").write_text("mine", encoding="utf-8")
    with pytest.raises(StoreError, match="holds something else than stored results"):
        pack_board(board, request_of(plan), tmp_path)


@pytest.mark.parametrize(
    ("name", "words"),
    [("pack.json", "holds no sound stored results"), ("truths.parquet", "holds no sound stored results")],
)
def test_damaged_results_are_told_in_a_line(kept, tmp_path, name, words, program):
    board, plan, _, _ = kept
    pack_board(board, request_of(plan), tmp_path / "kept")
    (tmp_path / "kept" / name).write_bytes(b"{")
    code, _, err = program("score", "--predictions", tmp_path / "kept", "--out", tmp_path / "out")
    assert code == 2
    assert words in err
    assert len(err.splitlines()) == 1


@pytest.mark.parametrize("name", ["mischief:Rejector", "no_such_rejector"])
def test_stored_results_have_no_code_imported_that_no_package_registers(kept, program, tmp_path, monkeypatch, name):
    stored = shutil.copytree(kept[2], tmp_path / "stored")
    said = json.loads((stored / "pack.json").read_text(encoding="utf-8"))
    said["rejectors"] = ["margin_nms", name]
    (stored / "pack.json").write_text(json.dumps(said), encoding="utf-8")
    (tmp_path / "mischief.py").write_text("import pathlib; pathlib.Path('imported').touch()", encoding="utf-8")
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(str(tmp_path))
    code, _, err = program("score", "--predictions", "stored", "--out", "out")
    assert code == 2
    (line,) = err.strip().splitlines()
    assert line == (
        f"sasgeo-bench: stored names the rejector {name!r}, and data may name registered ones only (list-rejectors "
        "shows all): name each that is to judge with --rejector, and code only if you trust it"
    )
    assert not (tmp_path / "imported").exists()
    assert not (tmp_path / "out").exists()


def test_named_on_the_command_line_code_judges_stored_results(kept):
    folder = kept[2]
    asked = packing.request_of([folder], board=Path("board"), root=Path("out"), rejectors=["mine:Rejector"])
    assert asked.rejectors == ["mine:Rejector"]


def test_a_name_that_leads_out_is_refused(kept, tmp_path):
    board, plan, _, _ = kept
    pack_board(board, request_of(plan), tmp_path / "kept")
    table = pq.read_table(tmp_path / "kept" / "tasks.parquet")
    rows = table.to_pylist()
    rows[0]["task_json"] = json.dumps(json.loads(rows[0]["task_json"]) | {"region": "../../out"})
    pq.write_table(table.from_pylist(rows, schema=table.schema), tmp_path / "kept" / "tasks.parquet")
    with (
        pytest.raises(StoreError, match="is no name of a folder"),
        laid_out(ScoreRequest(predictions=[tmp_path / "kept"], root=tmp_path, board=tmp_path / "board")),
    ):
        pass


def test_stored_results_hold_their_own_tasks_and_stand_alone(kept, tmp_path):
    _, _, folder, _ = kept
    with (
        pytest.raises(ConfigError, match="hold their own tasks: leave --tasks away"),
        laid_out(ScoreRequest(predictions=[folder], tasks=[tmp_path], root=tmp_path, board=tmp_path / "board")),
    ):
        pass
    with pytest.raises(ConfigError, match="are both stored results"):
        stored_settings([folder, folder])
    assert [item.name for item in stored_settings([folder]).contrasts] == ["nothing"]


def test_answers_of_ones_own_are_scored_beside_stored_results(kept, program, tmp_path):
    _, _, folder, _ = kept
    mine = next((folder / "predictions").glob("random-*.parquet"))
    shutil.copyfile(mine, tmp_path / "mine.parquet")
    args = ("--predictions", folder, "--predictions", tmp_path / "mine.parquet", "--out", tmp_path, "--draws", 100)
    code, _, err = program("score", *args)
    assert code == 3, err
    table = pd.read_parquet(tmp_path / "boards" / "board" / "leaderboard.parquet")
    rows = table[(table["metric"] == "success_25m") & (table["stratum"] == "all")].set_index("matcher")["value"]
    assert rows["mine"] == rows["random"]
