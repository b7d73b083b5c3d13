# SPDX-License-Identifier: Apache-2.0
"""The queries of a published board as a release: exactly these, without truths, answered by a program of anybody's."""

import json
import re
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import pyarrow.parquet as pq
import pytest

from sasgeo_bench.boards.pipeline_spec import PipelineFile
from sasgeo_bench.core.config import parse_toml
from sasgeo_bench.core.errors import ConfigError
from sasgeo_bench.exchange.release import ReleaseRequest, make_release
from sasgeo_bench.exchange.submissions import SubmitRequest, hold_submission, make_submission
from sasgeo_bench.experiments import board_queries
from sasgeo_bench.experiments.board_queries import BoardRequest, asked_tasks, draw_board, plan_board
from sasgeo_bench.experiments.pipeline import run_pipeline
from sasgeo_bench.experiments.pipeline_plan import plan_pipeline
from sasgeo_bench.matching.submission import Card, example_card
from sasgeo_bench.tasks.suites.all_suites import find_suite
from sasgeo_bench.tasks.task_plan import Request
from tests.experiments.test_pipeline import TEXT as PIPELINE
from tests.threaded import threaded

PAGE = Path(__file__).parents[2] / "docs" / "howto" / "any-language.md"
TEXT = PIPELINE.replace('"crossfit"', '"places"')  # controls of every board are of crossfit


@pytest.fixture(scope="module")
def request_(tmp_path_factory, few_controls, lay_towns):  # noqa: ARG001
    folder = tmp_path_factory.mktemp("board")
    out = lay_towns(folder / "out", "town-suburb")
    (folder / "small.toml").write_text(TEXT, encoding="utf-8")
    spec = parse_toml(TEXT, PipelineFile, source="small.toml")
    with threaded(), pytest.MonkeyPatch.context() as patch:
        patch.setattr("sasgeo_bench.boards.build.make_extras", lambda *_: [])
        run_pipeline(plan_pipeline(spec, out=out), results=folder / "results")
    return BoardRequest(stored=folder / "results" / "small", out=out, pipeline=folder / "small.toml")


@pytest.fixture(scope="module")
def board(request_):
    return draw_board(request_)


def release(request_, board, into):
    wanted = ReleaseRequest(
        regions=board.regions,
        suites=(),
        split=board.split,
        with_truth=False,
        out=request_.out,
        into=into,
        board=board,
    )
    return make_release(wanted)


@pytest.fixture(scope="module")
def released(request_, board, tmp_path_factory):
    into = tmp_path_factory.mktemp("released") / "queries"
    release(request_, board, into)
    return into


def hashes_in(folder):
    rows = [row for path in folder.glob("tasks/*/*/*.parquet") for row in pq.read_table(path).to_pylist()]
    return {row["query_id"]: row["asked_sha256"] for row in rows}


def test_a_release_of_a_board_holds_its_queries_and_no_others(request_, released):
    stored = {name: one for task in asked_tasks(request_.stored) for name, one in task.asked.items()}
    assert hashes_in(released) == stored
    index = json.loads((released / "release.json").read_text())
    assert {task["suite"]: task["split"] for task in index["tasks"]} == {"clean": "places", "controls": "crossfit"}
    assert index["board"] == {"id": "small", "queries_left_out": 0}


def test_no_truth_is_in_it_and_every_file_has_its_hash(released):
    assert not (released / "truth").exists()
    assert "in the stored results of the board small" in (released / "README.md").read_text()
    subprocess.run(["sha256sum", "--check", "--quiet", "SHA256SUMS"], cwd=released, check=True)  # noqa: S607


def test_queries_that_are_drawn_otherwise_are_left_out_and_counted(request_, board, tmp_path):
    lost = sorted(board.asked)[::4]
    some = {name: "another hash" if name in lost else one for name, one in board.asked.items()}
    found = release(request_, replace(board, asked=some, lost=len(lost)), tmp_path / "some")
    assert sorted(hashes_in(tmp_path / "some")) == sorted({*board.asked} - {*lost})
    assert found.queries == len(board.asked) - len(lost)
    assert json.loads((tmp_path / "some" / "release.json").read_text())["board"]["queries_left_out"] == len(lost)


def test_the_program_of_the_page_answers_without_this_package(request_, released, tmp_path):
    (code,) = re.findall(r"^```python\n(.*?)^```$", PAGE.read_text(encoding="utf-8"), re.MULTILINE | re.DOTALL)
    (tmp_path / "answer.py").write_text('import sys\nsys.modules["sasgeo_bench"] = None\n' + code, encoding="utf-8")
    subprocess.run([sys.executable, "answer.py", released, "mine.parquet"], cwd=tmp_path, check=True)  # noqa: S603 - of our page
    card = parse_toml(example_card("mine"), Card, source="card.toml")
    asked = SubmitRequest(
        predictions=tmp_path / "mine.parquet", card=card, board=request_.stored, into=tmp_path / "mine"
    )
    submission, faults = hold_submission(make_submission(asked), [request_.stored])
    assert faults == ()
    assert all(task.answered == task.queries for task in submission.tasks)


def test_a_board_on_maps_of_another_version_is_refused_with_those_beside_it_that_are_open(tmp_path):
    stored = PAGE.parents[1] / "results" / "towns"
    with pytest.raises(ConfigError, match=r"data version 2, .* enter a board of this one \(.*\bsystems-objects\b.*\)$"):
        plan_board(BoardRequest(stored=stored, out=tmp_path))


def test_a_board_of_pictures_is_refused_before_anything_is_drawn(request_, monkeypatch):
    monkeypatch.setattr(Request, "found", find_suite("aerial"))
    monkeypatch.setattr(board_queries, "draw_all", pytest.fail)
    with pytest.raises(ConfigError, match="'small' asks about pictures, which a release does not hold: its queries"):
        draw_board(request_)


@pytest.mark.parametrize("words", [(), ("--board", "x", "--regions", "vaduz"), ("--board", "x", "--truth")])
def test_flags_that_do_not_go_together_are_refused_in_one_line(program, words):
    code, out, err = program("release", *words)
    assert (code, out) == (2, "")
    assert "release takes either --regions, with --suites and --truth, or --board" in err
