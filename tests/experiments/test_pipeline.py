# SPDX-License-Identifier: Apache-2.0
"""A pipeline draws, runs and scores; a second time it does only what is not up to date."""

import datetime as dt
import json
from collections import Counter
from dataclasses import replace
from pathlib import Path

import pandas as pd
import pytest
from sasgeo_baselines.rejectors.margin import Margin

from sasgeo_bench.boards.pipeline_spec import (
    LearningSpec,
    PipelineFile,
    find_pipeline_file,
    list_pipeline_files,
    read_pipeline_file,
)
from sasgeo_bench.core.config import parse_toml
from sasgeo_bench.core.errors import ConfigError, MatchError
from sasgeo_bench.core.progress import reporting
from sasgeo_bench.experiments import pipeline, pipeline_plan
from sasgeo_bench.experiments.pipeline import run_pipeline
from sasgeo_bench.experiments.pipeline_plan import TrainingGroups, is_asked, models_by_place, plan_pipeline, plan_runs
from sasgeo_bench.matching.controls.blind import PriorCentre
from sasgeo_bench.tasks import build as tasks
from sasgeo_bench.tasks import task_files
from sasgeo_bench.tasks.build import ensure_tasks, made_tasks
from sasgeo_bench.tasks.query import CONTROLS
from sasgeo_bench.tasks.split import find_split
from tests.handmade import split_file
from tests.threaded import threaded

pytestmark = pytest.mark.usefixtures("in_threads", "without_drawings")

TEXT = """
id = "small"
title = "Small"
split = "crossfit"
regions = ["town-suburb"]
matchers = ["random", "prior_centre"]
draws = 100

[[task]]
suites = ["clean"]
sites = 1

[[contrast]]
name = "nothing"
first = "random"
second = "prior_centre"
suites = ["clean"]
"""

MIRRORED = """
[[contrast]]
name = "mirrored"
first = "prior_centre"
second = "random"
suites = ["clean"]
"""


def small(**changes):
    text = TEXT
    for old, new in changes.items():
        text = text.replace(old, new)
    return parse_toml(text, PipelineFile, source="small.toml")


@pytest.fixture(scope="module")
def made(tmp_path_factory, few_controls, lay_towns):  # noqa: ARG001
    out = lay_towns(tmp_path_factory.mktemp("pipeline") / "out", "town-suburb")
    plan = plan_pipeline(small(), out=out)
    given = plan.to_text().splitlines()
    assert given[1:3] == [
        "  queries: 0 of 1 task up to date, 1 to be drawn (1 not there yet), at most 28 queries",
        "    to be drawn: clean on town-suburb",
    ]
    assert given[3].startswith("  controls: 0 of 1 task up to date, 1 to be drawn (1 not there yet), at most ")
    assert "  run: 4 matchers, 0 answered, 0 to ask" in given
    assert any(
        line.startswith("    fft_vote (controls alone): 0 answered, 0 to ask, and at most ")
        and line.endswith(" to be drawn; 0 answered there before")
        for line in given
    )
    lines = []
    with threaded(), reporting(lines.append):
        return plan, run_pipeline(plan), lines


def test_a_pipeline_ends_with_a_board(made):
    plan, board, lines = made
    count = len(task_files.Task.open(plan.out / "tasks" / "clean" / "town-suburb").ids())
    controls = len(task_files.Task.open(plan.out / "tasks" / "controls" / "town-suburb+controls").ids())
    assert f"random: {count + controls} queries to ask, 0 answered before" in lines
    assert f"fft_vote: {controls} queries to ask, 0 answered before" in lines
    assert {entry.name for entry in board.board.about.entries} == {"random", "prior_centre", "oracle_pose"}
    assert [item.name for item in board.board.findings] == ["nothing"]
    assert (plan.out / "boards" / "small" / "leaderboard.parquet").is_file()
    assert "Registered contrasts" in (plan.out / "boards" / "small" / "leaderboard.md").read_text(encoding="utf-8")


class Middle(PriorCentre):
    """A matcher that is installed nowhere."""

    card = replace(PriorCentre.card, name="middle")


def test_a_contrast_may_name_a_matcher_by_module_and_class(made):
    plan, board, _ = made
    spec = small(**{'id = "small"': 'id = "by-class"', "prior_centre": f"{__name__}:Middle"})
    again = run_pipeline(plan_pipeline(spec, out=plan.out))
    (before,), (found,) = board.board.findings, again.board.findings
    assert (found.first, found.second) == ("random", "middle")
    assert (found.n, found.difference) == (before.n, before.difference)


@pytest.mark.parametrize("where", ["contrast", "learning"])
def test_a_kind_that_nobody_draws_is_refused_before_anything_is_drawn(where, tmp_path):
    learning = '[learning]\nsuites = ["clean"]\nkinds = ["nope"]\n\n[[task]]'
    change = {"[[contrast]]": '[[contrast]]\nkinds = ["nope"]'} if where == "contrast" else {"[[task]]": learning}
    with pytest.raises(ConfigError, match=rf"{where}.* names the kind 'nope', which is not drawn: its suites have "):
        plan_pipeline(small(**change), out=tmp_path)
    assert list(tmp_path.iterdir()) == []


def test_every_board_has_controls_and_figures_without_them(made):
    plan, board, _ = made
    assert {item.matcher for item in board.board.verdicts} == {"random", "prior_centre", "oracle_pose", "fft_vote"}
    assert all(item.holds for item in board.board.verdicts)
    assert set(board.board.leaderboard["suite"]) == {"clean", "all suites"}
    assert "fft_vote" not in set(board.board.leaderboard["matcher"])
    folder = plan.out / "boards" / "small"
    about = json.loads((folder / "board.json").read_text(encoding="utf-8"))
    assert about["pipeline"] == {"id": "small", "sha256": plan.spec.sha256}
    assert len(pd.read_parquet(folder / "controls.parquet")) == len(board.board.verdicts)
    text = (folder / "leaderboard.md").read_text(encoding="utf-8")
    assert f"- Controls: all {len(board.board.verdicts)} held." in text
    assert "## Controls" in text


def test_every_card_is_read_before_the_first_query_is_asked(made, tmp_path, monkeypatch):
    """A name that is taken is told at once, not after the hours of all others."""

    def stop(*_, **__):
        raise ConfigError("here begins the first run")

    (tmp_path / "taken.py").write_text(
        "from sasgeo_bench.matching.controls.fft_vote import FftVote\n\n\nclass Mine(FftVote):\n    pass\n"
    )
    monkeypatch.syspath_prepend(str(tmp_path))
    monkeypatch.setattr(pipeline, "run", stop)
    spec = small().model_copy(update={"matchers": ["random", "taken:Mine"]})
    lines = []
    with pytest.raises(ConfigError, match="here begins the first run"), reporting(lines.append):
        run_pipeline(plan_pipeline(spec, out=made[0].out))
    assert "taken:Mine failed: its card is named 'fft_vote', as a matcher that ships: rename it" in lines


def test_the_command_ends_with_the_board_and_what_to_do_next(made, program, monkeypatch, tmp_path):
    _, board, _ = made
    monkeypatch.setattr("sasgeo_bench.cli.boards.run_pipeline", lambda *_, **__: board)
    (tmp_path / "small.toml").write_text(TEXT, encoding="utf-8")
    code, out, err = program("leaderboard", "small.toml")
    assert code == 0, err
    assert out.splitlines()[-1] == str(Path("out") / "boards" / "small")
    assert err.splitlines()[-1].startswith("next: sasgeo-bench leaderboard small.toml --matcher NAME adds one of yours")


def test_the_board_of_a_pipeline_has_limits_and_requirements_of_ones_own(made):
    plan, _, _ = made
    board = run_pipeline(replace(plan, within=["7m"], require=["80% within 60 m, p95 latency 60 s"])).board
    assert {"within_7m", "within_60m", "latency_within_60s"} <= set(board.leaderboard["metric"])
    assert (board.about.within, board.about.require) == (["7m"], ["80% within 60 m, p95 latency 60 s"])


def test_the_command_takes_limits_and_requirements_as_score_does(made, program, mistake, monkeypatch, tmp_path):
    _, board, _ = made
    plans = []
    monkeypatch.setattr("sasgeo_bench.cli.boards.run_pipeline", lambda plan, **_: plans.append(plan) or board)
    (tmp_path / "small.toml").write_text(TEXT, encoding="utf-8")
    words = ("leaderboard", "small.toml", "--within", "7m", "--require", "80% within 50 m")
    code, _, err = program(*words)
    assert code == 0, err
    assert [(list(plan.within), list(plan.require)) for plan in plans] == [(["7m"], ["80% within 50 m"])]
    assert "'most within 50 m', which is no requirement" in mistake(*words, "--require", "most within 50 m")
    assert "'7 miles' is no limit" in mistake(*words, "--within", "7 miles")
    assert len(plans) == 1


@pytest.mark.parametrize(("words", "is_sandboxed"), [((), True), (("--trusted",), False)])
def test_the_command_trusts_matchers_where_it_is_told_to(made, program, monkeypatch, tmp_path, words, is_sandboxed):
    _, board, _ = made
    plans = []
    monkeypatch.setattr("sasgeo_bench.cli.boards.run_pipeline", lambda plan, **_: plans.append(plan) or board)
    (tmp_path / "small.toml").write_text(TEXT, encoding="utf-8")
    assert program("leaderboard", "small.toml", *words)[0] == 0
    with threaded():
        (run,) = plan_runs(plans[0], "random", [])
    assert run.plan.request.is_sandboxed is is_sandboxed


def test_a_second_time_nothing_is_drawn_and_nothing_is_asked(made):
    plan, board, _ = made
    queries = plan.out / "tasks" / "clean" / "town-suburb" / "queries.parquet"
    before = queries.stat().st_mtime_ns
    lines = []
    with reporting(lines.append):
        again = run_pipeline(plan)
    assert queries.stat().st_mtime_ns == before
    assert [line.split(",")[0] for line in lines if "to ask" in line] == [
        f"{name}: 0 queries to ask" for name in (*plan.matchers, "fft_vote")
    ]
    assert again.board.leaderboard.equals(board.board.leaderboard)
    text = plan.to_text()
    assert "  queries: 1 of 1 task up to date\n  controls: 1 of 1 task up to date\n" in text
    count = len(board.scores["random"]) + len(
        task_files.Task.open(plan.out / "tasks" / "controls" / "town-suburb+controls").ids()
    )
    assert f"    random: {count} answered, 0 to ask\n" in text
    assert "to be drawn" not in text
    assert not any("it is replaced" in line for line in lines)


def test_a_board_of_another_file_with_the_same_id_is_not_replaced_without_a_word(made):
    plan, _, _ = made
    other = plan_pipeline(small(**{'title = "Small"': 'title = "Other"'}), out=plan.out)
    lines = []
    with reporting(lines.append):
        run_pipeline(other)
        run_pipeline(plan)
    folder = plan.out / "boards" / "small"
    told = [line for line in lines if line.startswith(f"{folder} holds the board of another file with the id 'small'")]
    assert len(told) == 2
    assert told[0].endswith("it is replaced; give yours an id of its own to keep both")


def test_what_another_run_drew_meanwhile_is_not_drawn_again(made, monkeypatch):
    request = made[0].requests[0]
    folders = made_tasks(request)
    found = iter((None, folders))
    monkeypatch.setattr(tasks, "made_tasks", lambda _: next(found))
    monkeypatch.setattr(tasks, "_make_tasks", None)
    assert ensure_tasks(request) == folders


@pytest.mark.parametrize(
    "changes",
    [{"sites = 1": "sites = 2"}, {"crossfit": "SPLIT"}, {"title": "seed = 1\ntitle"}],
)
def test_what_changes_queries_has_them_drawn_anew(made, changes, tmp_path):
    plan, _, _ = made
    assert made_tasks(plan.requests[0]) is not None
    split = split_file(tmp_path, suburb="test", grid="train")
    changes = {old: new.replace("SPLIT", str(split)) for old, new in changes.items()}
    other = plan_pipeline(small(**changes), out=plan.out)
    assert made_tasks(other.requests[0]) is None


def test_a_dry_run_tells_why_tasks_are_drawn_anew_and_how_many_answers_that_leaves(made):
    plan, board, _ = made
    text = plan_pipeline(small(**{"sites = 1": "sites = 2"}), out=plan.out).to_text()
    assert (
        "  queries: 0 of 1 task up to date, 1 to be drawn (1 drawn with sites = 1, now 2), at most 56 queries" in text
    )
    count = len(board.scores["random"])
    assert f"to be drawn; {count} answered there before\n" in text
    assert "answers where they are: those to the same queries count again, the others are set aside\n" in text


def test_a_task_of_its_own_regions_is_drawn_on_these_alone(tmp_path):
    own = '[[task]]\nsuites = ["occlusion"]\nsites = 1\nregions = ["town-grid"]\n[[contrast]]'
    both = {'regions = ["town-suburb"]': 'regions = ["town-suburb", "town-grid"]'}
    plan = plan_pipeline(small(**{"[[contrast]]": own} | both), out=tmp_path)
    found = [(item.suite, item.region.id) for item in plan.requests]
    assert found == [("clean", "town-suburb"), ("clean", "town-grid"), ("occlusion", "town-grid")]


def test_a_task_that_was_touched_is_not_up_to_date(made):
    plan, _, _ = made
    path = plan.out / "tasks" / "clean" / "town-suburb" / "queries.parquet"
    data = path.read_bytes()
    try:
        path.write_bytes(data + b"x")
        assert made_tasks(plan.requests[0]) is None
    finally:
        path.write_bytes(data)
    assert made_tasks(plan.requests[0]) is not None


def test_a_task_whose_truths_are_gone_is_not_up_to_date(made, tmp_path):
    plan, _, _ = made
    path = plan.out / "truth" / "clean" / "town-suburb" / task_files.TRUTH
    path.rename(tmp_path / task_files.TRUTH)
    try:
        assert made_tasks(plan.requests[0]) is None
    finally:
        (tmp_path / task_files.TRUTH).rename(path)
    assert made_tasks(plan.requests[0]) is not None


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"title": "titel"}, "unknown key 'titel', did you mean 'title'"),
        (
            {'second = "prior_centre"': 'second = "nobody"'},
            "contrast 'nothing' names 'nobody', which is not among 'matchers'",
        ),
        (
            {'matchers = ["random", "prior_centre"]': 'matchers = ["random", "random"]'},
            "matcher 'random' is listed twice",
        ),
        ({"sites = 1": "sites = 0"}, "greater than or equal to 1"),
        ({"sites = 1": "sites = -1"}, "greater than or equal to 1, got -1"),
        ({"sites = 1": "sites = 1000000000"}, "less than or equal to 10000"),
        ({'suites = ["clean"]\nsites': "suites = []\nsites"}, "at least 1 item"),
        ({'suites = ["clean"]\nsites': 'suites = ["clean", "clean"]\nsites'}, "suite 'clean' is listed twice"),
        ({'id = "small"': f'id = "{"x" * 300}"'}, "'id': String should match pattern"),
        ({'id = "small"': 'id = "../../small"'}, "'id': String should match pattern"),
        ({'second = "prior_centre"': 'second = "random"'}, "contrast 'nothing' holds 'random' against itself"),
        ({"[[contrast]]": MIRRORED + "[[contrast]]"}, "contrasts 'mirrored' and 'nothing' compare the same"),
        ({'name = "nothing"': 'name = "a|b"'}, "'contrast.0.name': String should match pattern"),
        ({"sites = 1": 'sites = 1\nprior = "r7-known-s3"'}, "is no prior group"),
        ({"sites = 1": "sites = 1\ndetectors = []"}, "at least 1 item"),
        (
            {"sites = 1": 'sites = 1\nregions = ["monaco"]'},
            "draws 'monaco', which is not among 'regions': name it there",
        ),
        ({"sites = 1": 'sites = 1\nregions = ["town-grid", "town-grid"]'}, "region 'town-grid' is listed twice"),
        (
            {
                'regions = ["town-suburb"]': 'regions = ["town-suburb", "atlantis"]',
                "sites = 1": 'sites = 1\nregions = ["town-suburb"]',
            },
            "region 'atlantis' is drawn by no",
        ),
        (
            {"[[contrast]]": '[[contrast]]\ndetectors = ["measured"]'},
            "counts views of measured alone, and its suites",
        ),
        ({"[[contrast]]": "[[contrast]]\npilot = { control = 0.9 }"}, "is for metric = .interaction"),
        ({"[[contrast]]": "[[contrast]]\npilot = { second = -0.3 }"}, "is for metric = .interaction"),
        ({"[[contrast]]": '[[contrast]]\nmetric = "shift"'}, "by shift compares one detector with 'published'"),
        (
            {"[[contrast]]": '[[contrast]]\nmetric = "shift"\ndetectors = ["published"]'},
            r'name the other one alone, such as detectors = \["measured"\]',
        ),
        (
            {
                "[[contrast]]": '[[contrast]]\nmetric = "shift"\ndetectors = ["measured"]',
                "sites = 1": 'sites = 1\ndetectors = ["measured"]',
            },
            r"views of 'published' and 'measured': name both in detectors of the \[\[task\]\] of clean",
        ),
        (
            {"[[contrast]]": "[[contrast]]\nmin_effect = 0.4\npilot = { second = 0.7 }"},
            r"'nothing' cannot be reached: at most 0\.300 can be gained, and 0\.400 is to matter",
        ),
        (
            {"[[contrast]]": '[[contrast]]\nmetric = "interaction"\npilot = { second = 0.2, control = 0.9 }'},
            r"at most 0\.000 can be gained, .*\(second of its pilot is a difference",
        ),
        (
            {"[[contrast]]": '[[contrast]]\nmetric = "aurc"\npilot = { second = 0.3, false_share = 0.78 }'},
            r"a perfect order has an area of 0\.447, so the pilot's second cannot be 0\.3",
        ),
        ({"sites = 1": 'sites = 1\ntracks = ["retrieval"]'}, "is of localization, and no .* draws that track"),
        ({"sites = 1": 'sites = 1\ndetectors = ["mine"]'}, "must be 'published', 'measured'"),
        ({"sites = 1": 'sites = 1\ndetectors = ["measured", "measured"]'}, "detector 'measured' is listed twice"),
        ({'suites = ["clean"]\nsites': 'suites = ["clean", "controls"]\nsites'}, "'controls' is drawn for every board"),
        ({'suites = ["clean"]\nsites': 'suites = ["season"]\nsites'}, "names the suite 'clean', which is not drawn"),
        (
            {'second = "prior_centre"': 'second = "prior_centre"\nmetric = "e_aurc"'},
            "'nothing' by e_aurc is of rejectors: name 'random' as matcher x rejector",
        ),
    ],
)
def test_a_wrong_file_is_refused_in_one_line(changes, words):
    with pytest.raises(ConfigError, match=words) as error:
        small(**changes)
    assert "\n" not in str(error.value)


PAPER = """
id = "few"
title = "Few"
matchers = ["random", "oracle_pose"]

[paper]
seeds = [42, 43]
trials = 3

[[contrast]]
name = "nothing"
first = "random"
second = "oracle_pose"
suites = ["paper-poc"]
track = "retrieval"
"""


def test_the_paper_needs_no_split_no_region_and_no_task_and_has_its_own_defaults():
    spec = parse_toml(PAPER, PipelineFile, source="few.toml")
    assert (spec.split, spec.regions, spec.task) == (None, [], [])
    text = PAPER.replace("seeds = [42, 43]\n", "").replace("trials = 3\n", "")
    paper = parse_toml(text, PipelineFile, source="few.toml").paper
    assert (paper.seeds, paper.trials) == ([42], 220)


@pytest.mark.parametrize(
    ("name", "sha256"),
    [
        ("paper-poc", "20b81e5725ddcb63b77f4355c80bfe64e3e14945317641430912198b2b39d7be"),
        ("paper-poc-20", "a69a4ef59c144f26211d695895827e5c57dd9af64d64c1e9a356ed4990ab6b77"),
    ],
)
def test_a_file_of_the_paper_keeps_the_hash_that_it_had_before_there_were_readings(name, sha256):
    spec = read_pipeline_file(find_pipeline_file(name))
    assert spec.sha256 == sha256
    read = spec.model_copy(update={"paper": spec.paper.model_copy(update={"crop_readings": ["absent"]})})
    assert read.sha256 != sha256


def test_a_reading_of_the_crop_is_a_suite_that_all_matchers_are_asked_on_and_contrasts_name(tmp_path):
    text = PAPER.replace("trials = 3", 'trials = 3\ncrop_readings = ["absent"]')
    spec = parse_toml(text.replace('["paper-poc"]', '["paper-poc-crop-absent"]'), PipelineFile, source="few.toml")
    given = plan_pipeline(spec, out=tmp_path).to_text()
    assert "3 trials of each seed: 0 of 4 tasks up to date" in given
    for suite in ("paper-poc", "paper-poc-crop-absent"):
        assert f"to be drawn: {suite} on paper-poc-43" in given
    wrong = text.replace('["paper-poc"]', '["paper-poc-crop-absent"]').replace('track = "retrieval"', "")
    with pytest.raises(ConfigError, match="the paper's trials are retrieval"):
        parse_toml(wrong, PipelineFile, source="few.toml")


def test_without_its_package_the_paper_is_refused_in_one_line_before_anything_is_drawn(tmp_path, monkeypatch):
    monkeypatch.setattr("sasgeo_bench.experiments.experiment.list_entry_points", lambda _: {})
    with pytest.raises(
        ConfigError, match=r"^pipeline 'few' draws .* sasgeo-paper, is not installed: install the folder"
    ):
        plan_pipeline(parse_toml(PAPER, PipelineFile, source="few.toml"), out=tmp_path)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("[42, 43]", "[42, 42]", "seed '42' is listed twice"),
        ("[42, 43]", "[-1]", "greater than or equal to 0"),
        ("[42, 43]", "[]", "at least 1 item"),
        ("trials = 3", "trials = 0", "greater than or equal to 1"),
        ("trials = 3", 'crop_readings = ["gone"]', "crop_readings"),
        ("trials = 3", 'crop_readings = ["absent", "absent"]', "suite 'paper-poc-crop-absent' is listed twice"),
        ("trials = 3", "trails = 3", "unknown key 'paper.trails', did you mean 'trials'"),
        ('["paper-poc"]', '["paper-pock"]', "names the suite 'paper-pock', which is not drawn"),
        ('track = "retrieval"', "", "the paper's trials are retrieval"),
        ("[paper]", 'rejectors = ["margin"]\n[paper]', "rejectors are fitted on the calibration places of a split"),
        ("[paper]", 'split = "crossfit"\n[paper]', "for \\[\\[task\\]\\], and there is none: leave them out"),
        ("[paper]\nseeds = [42, 43]\ntrials = 3\n", "", "'task' is missing"),
        ("[paper]", '[[task]]\nsuites = ["clean"]\nsites = 1\n\n[paper]', "'split' is missing"),
    ],
)
def test_a_wrong_file_of_the_paper_is_refused_in_one_line(old, new, words):
    with pytest.raises(ConfigError, match=words) as error:
        parse_toml(PAPER.replace(old, new), PipelineFile, source="few.toml")
    assert "\n" not in str(error.value)


LEARNING = """
id = "taught"
title = "Taught"
split = "crossfit"
regions = ["town-suburb", "town-agricultural"]
matchers = ["learners:Counts", "learners:Oracle", "prior_centre"]
draws = 100

[[task]]
suites = ["clean"]
sites = 1

[learning]
suites = ["clean"]
most = 5
oracles = ["learners:Oracle"]
"""


@pytest.mark.slow
@pytest.mark.usefixtures("few_controls")
def test_each_half_is_asked_after_learning_from_the_other_and_an_oracle_from_itself(tmp_path, monkeypatch, lay_towns):
    lay_towns(tmp_path, "town-suburb", "town-agricultural")
    monkeypatch.syspath_prepend(str(Path(__file__).parents[1] / "running"))
    plan = plan_pipeline(parse_toml(LEARNING, PipelineFile, source="taught.toml"), out=tmp_path)
    board = run_pipeline(plan)
    assert {item.diagnostics["pairs"] for item in board.predictions["counts"].values()} == {5.0}
    about = json.loads((tmp_path / "boards" / "taught" / "board.json").read_text(encoding="utf-8"))
    learned = {entry["name"]: entry["learned"] for entry in about["entries"]}
    assert learned["prior_centre"] == []
    assert {tuple(one["trained_on"]): one["asked"] for one in learned["counts"]} == {
        ("town-agricultural",): ["clean/town-suburb", "controls/town-suburb+controls"],
        ("town-suburb",): ["clean/town-agricultural"],
    }
    assert {tuple(one["trained_on"]): one["asked"] for one in learned["oracle_counts"]} == {
        ("town-suburb",): ["clean/town-suburb", "controls/town-suburb+controls"],
        ("town-agricultural",): ["clean/town-agricultural"],
    }
    assert board.board.leaderboard.loc[board.board.leaderboard["matcher"] == "oracle_counts", "is_control"].all()
    text = (tmp_path / "boards" / "taught" / "leaderboard.md").read_text(encoding="utf-8")
    assert "trained on 5 queries of 1 place (town-suburb)." in text
    lines = plan.to_text().splitlines()
    assert "  learning: each half is asked after learning from the other (clean, at most 5 queries)" in lines
    assert "    learners:Oracle: from the half itself, never ranked" in lines
    assert "      half a: trained on 5 queries of 1 place (town-agricultural)" in lines
    assert "      half b: trained on 5 queries of 1 place (town-suburb)" in lines


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ('["clean"]\nmost', '["season"]\nmost', "learning names the suite 'season', which no"),
        ('["clean"]\nmost', '["controls"]\nmost', "learning names the suite 'controls', which no"),
        ('["clean"]\nmost', '["clean", "clean"]\nmost', "suite to learn from 'clean' is listed twice"),
        ("most = 5", "most = 0", "greater than or equal to 1"),
        (
            'oracles = ["learners:Oracle"]',
            'oracles = ["oracle_x"]',
            "learning names the oracle 'oracle_x', which is not among 'matchers'",
        ),
        ('"crossfit"', '"holdout"', r"\[learning\] has no region of a train place of the hold-out 'holdout'"),
    ],
)
def test_learning_that_makes_no_sense_is_refused_in_one_line(tmp_path, old, new, words):
    with pytest.raises(ConfigError, match=words) as error:
        plan_pipeline(
            parse_toml(LEARNING.replace(old, new).replace('"town-suburb", ', ""), PipelineFile, source="taught.toml"),
            out=tmp_path,
        )
    assert "\n" not in str(error.value)


def test_an_oracle_with_a_contestants_name_is_refused(tmp_path, monkeypatch):
    monkeypatch.syspath_prepend(str(Path(__file__).parents[1] / "running"))
    text = LEARNING.replace('["learners:Oracle"]', '["learners:Counts"]')
    plan = plan_pipeline(parse_toml(text, PipelineFile, source="taught.toml"), out=tmp_path)
    with pytest.raises(ConfigError, match="the names of oracles begin with oracle_, so that no board ranks them"):
        plan.to_text()


def test_a_half_without_a_place_is_told_before_anything_is_asked(tmp_path):
    both = plan_pipeline(taught_by(""), out=tmp_path)
    assert "has no place here" not in "\n".join(both.training_groups.lines(both.requests))
    one = plan_pipeline(taught_by("", LEARNING.replace('"town-suburb", ', "")), out=tmp_path)
    given = one.training_groups.lines(one.requests)
    assert [line for line in given if "has no place here" in line] == [
        "    half a has no place here: none learns for half b"
    ]


def test_of_several_models_each_is_asked_in_countries_of_its_own():
    split, crossfit = find_split("world"), find_split("crossfit")
    tasks = [Path("out/tasks/clean") / name for name in split.spec.region_ids]
    learning = LearningSpec(suites=["clean"], models=3)
    found = TrainingGroups(split=split, controls=crossfit, learning=learning).of(tasks, tasks, is_oracle=False)
    assert [group.name for group in found][:3] == [f"held out, model {at} of 3" for at in (1, 2, 3)]
    assert len({group.train for group in found if group.name.startswith("held out")}) == 1
    model_of = models_by_place(split, 3)
    of_country = {(split.country_of[name], model) for name, model in model_of.items()}
    assert len(of_country) == len(set(split.country_of.values()))  # one model each
    for part in ("calibration", "test"):
        sizes = Counter(model for name, model in model_of.items() if split.part_of(name) == part)
        assert len(sizes) == 3
        assert min(sizes.values()) > sum(sizes.values()) / 6
    asked = [task for group in found if group.name.startswith("held out") for task in group.asked]
    assert len(asked) == len(set(asked))
    one = TrainingGroups(split=split, controls=crossfit, learning=LearningSpec(suites=["clean"]))
    assert set(one.of(tasks, tasks, is_oracle=False)[0].asked) == set(asked)


def test_of_a_place_the_first_regions_are_drawn_and_never_two_lists_of_them(tmp_path):
    places = "".join(
        f'[[place]]\nname = "{name}"\nhalf = "{half}"\nregions = {regions}\n'
        for name, half, regions in (
            ("one", "a", '["town-suburb", "town-grid"]'),
            ("two", "b", '["town-agricultural"]'),
            ("three", "a", '["town-riverside"]'),
            ("four", "b", '["town-industrial"]'),
        )
    )
    split = tmp_path / "few.toml"
    head = 'id = "few"\ntitle = "Few"\nkind = "crossfit"\nbuffer_m = 0.0\nblock_m = 500.0\nreach_m = 100.0\n'
    split.write_text(head + places, encoding="utf-8")
    text = TEXT.replace('split = "crossfit"', f'split = "{split}"')
    text = "\n".join(line for line in text.splitlines() if not line.startswith("regions"))
    found = {}
    for line in ("", "regions_of_a_place = 1", "regions_of_a_place = 2"):
        plan = plan_pipeline(parse_toml(f"{line}\n{text}", PipelineFile, source="few.toml"), out=tmp_path / "out")
        found[line] = [request.region.id for request in plan.requests]
    assert "town-grid" in found[""]
    assert found["regions_of_a_place = 1"] == [name for name in found[""] if name != "town-grid"]
    assert found["regions_of_a_place = 2"] == found[""]
    with pytest.raises(ConfigError, match="'regions_of_a_place' bounds what is drawn of a split"):
        parse_toml(f"regions_of_a_place = 1\n{TEXT}", PipelineFile, source="few.toml")


def test_of_several_models_in_a_cross_fit_each_half_has_its_own():
    split = find_split("crossfit")
    tasks = [Path("out/tasks/clean") / name for name in split.spec.region_ids]
    groups = TrainingGroups(split=split, controls=split, learning=LearningSpec(suites=["clean"], models=2))
    found = groups.of(tasks, tasks, is_oracle=False)
    assert [group.name for group in found] == [f"half {half}, model {at} of 2" for half in "ab" for at in (1, 2)]
    assert [group.model for group in found] == [0, 1, 0, 1]
    assert sorted(task for group in found for task in group.asked) == sorted(tasks)
    oracle = groups.of(tasks, tasks, is_oracle=True)
    assert [group.name for group in oracle] == ["half a", "half b"]


def test_a_key_that_is_newer_than_a_file_leaves_its_hash_as_it_was():
    assert small().sha256 == "9776e35b91281bb01fef8fc443a2ccf8787e231e33617e88657f853beb9acb0e"
    metric = '[[contrast]]\nmetric = "interaction"'
    one, other = (
        small(**{"[[contrast]]": f"{metric}\npilot = {{ {each} }}"}) for each in ("second = -0.3", "control = 1")
    )
    assert one.sha256 == "7ba551d4b9660e7e2e58a49f80793bdcc86237fabf73b57b3e155363bb0c8f0b"
    changed = [
        small(**{"sites = 1": f"sites = 1\n{key}"}) for key in ("views_cells = [192]", 'detectors = ["measured"]')
    ]
    assert len({spec.sha256 for spec in (small(), one, other, *changed)}) == 5
    both = LEARNING.replace("[[task]]", '[[task]]\ndetectors = ["published", "measured"]')
    usual = ("", 'detector = "published"', "kinds = []", "models = 1")
    others = ('detector = "measured"', 'kinds = ["S1"]', "models = 2")
    taught = [taught_by(line, both).sha256 for line in (*usual, *others)]
    assert len(set(taught[: len(usual)])) == 1
    assert len(set(taught)) == 1 + len(others)


def test_who_learns_of_a_detector_needs_views_of_it():
    with pytest.raises(ConfigError, match="from views of 'measured', and its suites are drawn with published"):
        taught_by('detector = "measured"')


def taught_by(line, text=LEARNING):
    """Return the file with another line below [learning]."""
    return parse_toml(text.replace("[learning]", f"[learning]\n{line}"), PipelineFile, source="taught.toml")


def test_the_detectors_of_a_task_reach_its_queries(tmp_path):
    text = LEARNING.replace("[[task]]", '[[task]]\ndetectors = ["published", "measured"]')
    plan = plan_pipeline(taught_by("", text), out=tmp_path)
    assert {request.choice.detectors for request in plan.requests} == {("published", "measured")}


def test_a_detector_whose_errors_are_in_a_file_is_refused_before_anything_is_made(tmp_path):
    spec = small(**{"sites = 1": 'sites = 1\ndetectors = ["profile"]'})
    with pytest.raises(ConfigError, match=r"\[\[task\]\] 1 of 1: detector 'profile' needs a perception profile"):
        plan_pipeline(spec, out=tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_tasks_of_the_detector_silent_are_drawn_again_when_its_profile_changes(tmp_path, monkeypatch):
    spec = small(**{"sites = 1": 'sites = 1\ndetectors = ["published", "silent"]'})
    (request,) = (one for one in plan_pipeline(spec, out=tmp_path).requests if one.suite == "clean")
    before = tasks._request_sha256(request)
    other = tasks.silent_profile().model_copy(update={"images": 1})
    monkeypatch.setattr(tasks, "silent_profile", lambda: other)
    assert tasks._request_sha256(request) != before


def test_an_unknown_suite_region_or_split_is_refused_before_anything_is_made(tmp_path):
    for old, new in (("claen", "clean"), ("town-suburbia", "town-suburb"), ("crosfit", "crossfit")):
        spec = parse_toml(TEXT.replace(f'"{new}"', f'"{old}"'), PipelineFile, source="small.toml")
        with pytest.raises(ConfigError, match=f"did you mean '{new}'"):
            plan_pipeline(spec, out=tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_a_choice_that_leaves_nothing_names_the_pipeline_and_the_task(tmp_path):
    spec = small(**{"sites = 1": "sites = 1\nviews_cells = [191]"})
    with pytest.raises(
        ConfigError, match=r"^pipeline 'small', \[\[task\]\] 1 of 1: suite 'clean' has nothing of views_cells 191"
    ):
        plan_pipeline(spec, out=tmp_path / "out")


@pytest.mark.parametrize(("old", "new"), [("random", "randon"), ("prior_centre", "prior_center")])
def test_a_matcher_that_nobody_has_is_refused_before_anything_is_made(tmp_path, old, new):
    spec = parse_toml(TEXT.replace(f'"{old}"', f'"{new}"'), PipelineFile, source="small.toml")
    with pytest.raises(MatchError, match=f"there is no matcher '{new}', did you mean '{old}'"):
        plan_pipeline(spec, out=tmp_path / "out")
    assert not (tmp_path / "out").exists()


class MarginToo(Margin):
    """Another rejector of the same name."""


def test_two_rejectors_of_one_name_are_refused_before_anything_is_drawn(tmp_path):
    spec = small(**{"[[task]]": f'rejectors = ["margin", "{__name__}:MarginToo"]\n[[task]]'})
    plan = plan_pipeline(spec, out=tmp_path / "out")
    with pytest.raises(ConfigError, match=r"^margin and .*:MarginToo are both named 'margin': rename one"):
        run_pipeline(plan)
    assert not (tmp_path / "out").exists()


def shipped():
    """Yield the names of shipped pipelines; those that take all regions of a split that are there need extracts."""
    for name, path in sorted(list_pipeline_files().items()):
        spec = read_pipeline_file(path)
        takes_all = not spec.regions and any(not task.regions for task in spec.task)
        yield pytest.param(name, marks=pytest.mark.real if takes_all else ())


@pytest.mark.parametrize("name", list(shipped()))
def test_every_shipped_pipeline_can_be_planned(name, tmp_path):
    spec = read_pipeline_file(find_pipeline_file(name))
    assert spec.id == name
    plan = plan_pipeline(spec, out=tmp_path)
    assert plan.requests or plan.spec.paper is not None
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("small", "large", "may_differ"),
    [
        ("paper-poc", "paper-poc-20", {"id", "title", "paper"}),
    ],
)
def test_a_rehearsal_asks_what_the_experiment_asks(small, large, may_differ):
    one, other = (read_pipeline_file(find_pipeline_file(name)).model_dump() for name in (small, large))
    for each in (one, other):
        for item in each["task"]:
            item.pop("sites")
    assert {name for name in one if one[name] != other[name]} <= may_differ
    assert one["contrast"]


def with_tasks(*tasks, **changes):
    spec = {"id": "mine", "title": "Mine", "split": "crossfit", "matchers": ["random", "fft_vote"]}
    return PipelineFile.model_validate(spec | {"task": list(tasks)} | changes)


def test_matchers_of_a_task_are_asked_there_alone():
    both = {"suites": ["clean"], "sites": 2}
    one = {"suites": ["alias"], "sites": 2, "matchers": ["fft_vote"]}
    spec = with_tasks(both, one)
    assert spec.suites_of("random") == {"clean"}
    assert spec.suites_of("fft_vote") == {"clean", "alias"}


@pytest.mark.parametrize(
    ("tasks", "changes", "fault"),
    [
        ([{"suites": ["clean"], "sites": 2, "matchers": ["nobody"]}], {}, "asks 'nobody'"),
        ([{"suites": ["clean"], "sites": 2, "matchers": ["random"]}], {}, "'fft_vote' is asked on no suite"),
        (
            [
                {"suites": ["clean"], "sites": 2},
                {"suites": ["alias"], "sites": 2, "matchers": ["random"]},
            ],
            {"contrast": [{"name": "one", "first": "fft_vote", "second": "random", "suites": ["clean", "alias"]}]},
            "'fft_vote', which is not asked on 'alias'",
        ),
    ],
)
def test_matchers_of_a_task_that_nobody_asks_are_refused(tasks, changes, fault):
    with pytest.raises(ValueError, match=fault):
        with_tasks(*tasks, **changes)


BROKEN = """
class Broken:
    def __init__(self):
        raise ValueError("no weights here")
"""


def test_a_matcher_that_cannot_be_made_costs_nobody_the_board(made, tmp_path, monkeypatch):
    (tmp_path / "broken_here.py").write_text(BROKEN, encoding="utf-8")
    monkeypatch.syspath_prepend(str(tmp_path))
    plan, board, _ = made
    spec = plan.spec.model_copy(
        update={
            "id": "beside",
            "matchers": ["broken_here:Broken", *plan.spec.matchers],
            "contrast": [item.model_copy(update={"second": "broken_here:Broken"}) for item in plan.spec.contrast],
        }
    )
    other = plan_pipeline(spec, out=plan.out)
    assert "    broken_here:Broken: cannot be asked (broken_here:Broken: cannot be made (" in other.to_text()
    lines = []
    with reporting(lines.append):
        beside = run_pipeline(other)
    figures, before = (
        item[item["unit"] == "1"].reset_index(drop=True) for item in (beside.board.leaderboard, board.board.leaderboard)
    )
    assert figures.equals(before)  # what the runs took, in seconds and bytes, other tests add to
    assert list(beside.failures.found) == ["broken_here:Broken"]
    assert "no weights here" in beside.failures.found["broken_here:Broken"]
    assert [item.verdict for item in beside.board.findings] == ["not decided: broken_here:Broken failed"]
    assert any(line.startswith("broken_here:Broken failed: ") for line in lines)
    assert json.loads((plan.out / "boards" / "beside" / "board.json").read_text())["failed"] == beside.failures.found


def test_a_mistake_of_ours_about_one_matcher_leaves_the_others(made, monkeypatch):
    plan, board, _ = made
    work = pipeline_plan.plan_run

    def broken(request):
        if request.spec == "random":
            raise KeyError("a mistake of ours")
        return work(request)

    monkeypatch.setattr(pipeline_plan, "plan_run", broken)
    beside = run_pipeline(plan)
    assert set(beside.scores) == set(board.scores) - {"random"}
    assert [item.verdict for item in beside.board.findings] == ["not decided: random failed"]
    assert "in broken" in (plan.out / "boards" / "small.failures.log").read_text(encoding="utf-8")


PICTURED = {
    '[[task]]\nsuites = ["clean"]': '[reference_imagery]\nage_years = 10\nseason = "snow"\ngsd_m = 1.0\n\n[[task]]\n'
    'suites = ["aerial"]\nsegmenters = ["oracle_segmenter"]',
    'suites = ["clean"]\n': 'suites = ["aerial+oracle_segmenter"]\n',
}


@pytest.mark.parametrize(
    ("regions", "seen"),
    [([], {"town-suburb", "town-grid", "town-grid+x"}), (["town-grid"], {"town-grid", "town-grid+x"})],
)
def test_segmenters_see_the_pictures_of_the_regions_of_their_task_and_learn_from_all(
    tmp_path, monkeypatch, regions, seen
):
    plan = plan_pipeline(small(**PICTURED), out=tmp_path)
    (task,) = plan.spec.task
    chosen = task.model_copy(update={"regions": regions})
    plan = replace(plan, spec=plan.spec.model_copy(update={"task": [chosen]}))
    wanted = []
    monkeypatch.setattr(pipeline, "segment_tasks", lambda request: wanted.append(request) or ())
    drawn = [tmp_path / "tasks" / "aerial" / name for name in ("town-suburb", "town-grid", "town-grid+x")]
    assert pipeline._with_evidence(plan, drawn) == []
    (request,) = wanted
    assert {folder.name for folder in request.tasks} == seen
    assert set(request.taught) == set(drawn)


def test_reference_imagery_shows_the_map_nearest_in_age_of_each_place(tmp_path, monkeypatch):
    plan = plan_pipeline(small(**PICTURED), out=tmp_path)
    assert "  reference imagery: 1 region, rendered (snow, family calibration, seed 0, 10 years older)" in (
        plan.to_text().splitlines()
    )
    asked = []
    monkeypatch.setattr(pipeline, "render_place", lambda spec, **said: asked.append((spec.id, said)))
    pipeline._render(plan)
    ((region, said),) = asked
    assert (region, said["date"], said["out"]) == ("town-suburb", dt.date(2014, 1, 1), tmp_path)
    assert (said["look"].season, said["look"].gsd_m) == ("snow", 1.0)


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ('season = "snow"', 'family = "train"', "of family 'train', and so are pictures of queries on town-suburb"),
        ('season = "snow"', 'season = "monsoon"', "season"),
        ('season = "snow"', "gsd_m = 0.01", "gsd_m"),
        (
            'suites = ["aerial"]\nsegmenters = ["oracle_segmenter"]',
            'suites = ["clean"]',
            "has reference_imagery, and draws no suite of pictures: leave it out",
        ),
    ],
)
def test_reference_imagery_that_tells_nothing_or_too_much_is_refused(tmp_path, old, new, words):
    text = TEXT
    for before, after in PICTURED.items():
        text = text.replace(before, after)
    text = text.replace("gsd_m = 1.0\n", "").replace(old, new)
    if "clean" in new:
        text = text.replace("aerial+oracle_segmenter", "clean")
    with pytest.raises(ConfigError, match=words) as error:
        plan_pipeline(parse_toml(text, PipelineFile, source="small.toml"), out=tmp_path)
    assert "\n" not in str(error.value)


def test_a_contrast_on_flights_names_their_track(tmp_path):
    text = TEXT.replace('suites = ["clean"]', 'suites = ["flight-gap"]')
    assert text != TEXT
    with pytest.raises(ConfigError, match="has track 'localization', and suite 'flight-gap' is of flights, say track"):
        plan_pipeline(parse_toml(text, PipelineFile, source="small.toml"), out=tmp_path)
    other = TEXT.replace("[[contrast]]", '[[contrast]]\ntrack = "sequence"', 1)
    with pytest.raises(ConfigError, match="has track 'sequence', and suite 'clean' has no flights"):
        plan_pipeline(parse_toml(other, PipelineFile, source="small.toml"), out=tmp_path)


def test_trackers_are_asked_on_flights_alone_and_of_the_controls_the_oracle(tmp_path):
    text = TEXT.replace('["random", "prior_centre"]', '["random", "prior_only"]').replace(
        '"prior_centre"', '"prior_only"'
    )
    text = text.replace('suites = ["clean"]', 'suites = ["clean", "flight-gap"]', 1)
    plan = plan_pipeline(parse_toml(text, PipelineFile, source="small.toml"), out=tmp_path)
    asked = {
        name: [suite for suite in ("clean", "flight-gap", CONTROLS) if is_asked(plan, name, suite, "town-suburb")]
        for name in plan.matchers
    }
    assert asked == {
        "oracle_pose": ["clean", "flight-gap", CONTROLS],
        "prior_centre": ["clean", CONTROLS],
        "random": ["clean", "flight-gap", CONTROLS],
        "prior_only": ["flight-gap"],
    }


def test_a_contrast_by_false_fixes_is_of_flights():
    text = TEXT.replace("[[contrast]]", '[[contrast]]\nmetric = "false_accepted"', 1)
    with pytest.raises(ConfigError, match="by false_accepted is of flights: say track"):
        parse_toml(text, PipelineFile, source="small.toml")
