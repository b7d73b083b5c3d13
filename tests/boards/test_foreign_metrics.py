# SPDX-License-Identifier: Apache-2.0
"""A metric of another package on a board: its rows and columns, whose it is, and the board without it."""

import json
import re
import sys
import tomllib

import pandas as pd
import pytest

import sasgeo_bench as sgb
from sasgeo_bench.boards.archive import pack_board
from sasgeo_bench.boards.pipeline_spec import PipelineFile
from sasgeo_bench.boards.publish import publish
from sasgeo_bench.core.config import ConfigError
from sasgeo_bench.core.errors import MatchError, MetricError
from sasgeo_bench.core.plugins import plugin_code
from sasgeo_bench.core.progress import reporting
from sasgeo_bench.experiments.pipeline_plan import plan_pipeline
from sasgeo_bench.scoring.metric_testing import metric_files
from tests import world

TOWN = "town-agricultural"
SPEC = "nearness_of_mine:METRIC"
CLEAN = "clean: localization, searched: disc of 500 m, heading +-20 deg, scale +-3 %"


@pytest.fixture(scope="module")
def answered(tmp_path_factory, lay_towns):
    """A root with two controls that were asked a few clean views."""
    out = lay_towns(tmp_path_factory.mktemp("metrics") / "out", TOWN)
    tasks = world.drawn(out, "clean", TOWN, may_be_fewer=True)
    for matcher in ("oracle_pose", "prior_centre"):
        world.answered(out, matcher, tasks)
    return out


@pytest.fixture
def written(tmp_path, monkeypatch):
    """Write a module with the metric of the scaffold, some of its words replaced."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", [*sys.path])

    def write(old="", new=""):
        text = metric_files("nearness")["src/nearness/metric.py"]
        assert old in text
        (tmp_path / "nearness_of_mine.py").write_text(text.replace(old, new) if old else text)
        sys.modules.pop("nearness_of_mine", None)

    yield write
    sys.modules.pop("nearness_of_mine", None)


@pytest.mark.usefixtures("plain_site")
def test_it_has_rows_a_column_and_a_name_and_the_board_lives_without_it(answered, tmp_path, written):
    written("Nearness of", "Nearness <b> *of")
    plain, _ = world.scored(answered, "plain")
    scored, request = world.scored(answered, "more", metrics=[SPEC])
    board = sgb.read_board(answered / "boards" / "more")
    mine = board.leaderboard["metric"] == "nearness"
    pd.testing.assert_frame_equal(board.leaderboard[~mine].reset_index(drop=True), plain.board.leaderboard)
    assert list(board.scores) == list(plain.board.scores)
    values = board.leaderboard[mine & (board.leaderboard["stratum"] == "all")].set_index("matcher")["value"]
    assert values["oracle_pose"] == 1.0
    assert 0.0 <= values["prior_centre"] < 0.5

    (about,) = json.loads((board.folder / "board.json").read_text())["metrics"]
    assert (about["code"], about["sha256"]) == (SPEC, plugin_code(SPEC))
    assert {"name", "meaning", "unit", "better", "least", "greatest", "tracks", "source"} < set(about)
    assert "metrics" not in json.loads((answered / "boards" / "plain" / "board.json").read_text())
    whose = f"a metric of {SPEC} ({about['sha256'][:12]}), not of sasgeo-bench"
    for name in ("leaderboard.md", "leaderboard.tex"):
        assert "nearness" in (board.folder / name).read_text()
    text = (board.folder / "leaderboard.md").read_text()
    head = next(line for line in text.partition(f"## {CLEAN}")[2].splitlines() if line.startswith("| matcher"))
    assert "| within_25m | nearness |" in head
    assert text.count(whose) == 2  # above, and where columns are told
    assert text.count(r"Nearness &lt;b> \*of") == 2

    (tmp_path / "nearness_of_mine.py").unlink()  # as on a machine without it
    sys.modules.pop("nearness_of_mine")
    site = publish(board.folder, tmp_path / "site").folder
    for page in ("index.html", "suite-clean.html", "method.html"):
        assert whose in (site / page).read_text()
    assert f"<li>With a metric of another package: nearness ({SPEC}).</li>" in (site / "index.html").read_text()
    with pytest.raises(MatchError, match=f"^{SPEC}: cannot be imported"):
        world.scored(answered, "later", metrics=[SPEC])
    stored = tmp_path / "stored"
    pack_board(scored, request, stored)
    lines = []
    with reporting(lines.append):
        again = sgb.score(predictions=stored, out=tmp_path, cases=False, draws=100, tell=lines.append)
    assert not (again.leaderboard["metric"] == "nearness").any()
    assert f"{stored} has metrics of other packages, which are left out here: --metric {SPEC} adds them" in lines


@pytest.mark.parametrize(
    ("old", "new", "fault"),
    [
        ("    return np.where", "    return near[:1]\n    return np.where", "values have shape (1,), expected"),
        ("0.0, 1.0)\n", "0.0, 9.0)\n", "expected a finite number between 0 and 1"),
        ('scores["is_present"], near', 'scores["is_right"], near', "counts for"),
        ('scores["position_error_m"]', 'scores["position_error"]', "KeyError: 'position_error'"),
    ],
)
def test_one_that_fails_is_named_in_a_line_and_leaves_no_board(answered, written, old, new, fault, mistake):
    written(old, new)
    with pytest.raises(MetricError, match=re.escape(fault)) as raised:
        world.scored(answered, "odd", metrics=[SPEC])
    assert str(raised.value).startswith(SPEC)
    assert not (answered / "boards" / "odd").exists()
    flags = ("--predictions", answered / "runs", "--name", "odd", "--out", answered, "--metric", SPEC)
    assert fault in mistake("score", *flags)
    assert not (answered / "boards" / "odd").exists()


PIPELINE = """
id = "mine"
title = "Mine"
split = "crossfit"
matchers = ["random"]
task = [{suites = ["clean"], sites = 2}]
"""


def test_a_pipeline_file_may_name_metrics_and_keeps_its_hash_without_any(tmp_path):
    plain = PipelineFile.model_validate(tomllib.loads(PIPELINE))
    empty = PipelineFile.model_validate(tomllib.loads(PIPELINE.replace("task", "metrics = []\ntask")))
    more = PipelineFile.model_validate(tomllib.loads(PIPELINE.replace("task", f'metrics = ["{SPEC}"]\ntask')))
    assert plain.sha256 == empty.sha256 != more.sha256
    with pytest.raises(MatchError, match=f"^{SPEC}: cannot be imported"):
        plan_pipeline(more, out=tmp_path)
    with pytest.raises((ValueError, ConfigError), match=f"metric '{SPEC}' is listed twice"):
        PipelineFile.model_validate(tomllib.loads(PIPELINE) | {"metrics": [SPEC, SPEC]})
