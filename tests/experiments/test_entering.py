# SPDX-License-Identifier: Apache-2.0
"""A matcher enters a published board: it is asked the board's own queries, and its row stands beside the others."""

import datetime as dt
import os
import re
import sys
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import pandas as pd
import pytest

from sasgeo_bench.boards.manifests import BoardManifest
from sasgeo_bench.boards.pipeline_spec import PipelineFile
from sasgeo_bench.cli import entering as cli_entering
from sasgeo_bench.core.config import parse_toml
from sasgeo_bench.core.errors import ConfigError, MatchError, StoreError
from sasgeo_bench.core.progress import reporting
from sasgeo_bench.exchange import submissions
from sasgeo_bench.exchange.submissions import beside_stored, hold_submission, with_submissions
from sasgeo_bench.experiments import board_queries, entering, entry_cost
from sasgeo_bench.experiments.board_queries import asked_tasks, same_queries
from sasgeo_bench.experiments.entering import EntryRequest, check_entry, cost_lines, enter, plan_entry
from sasgeo_bench.experiments.pipeline import ask, draw_all, run_pipeline
from sasgeo_bench.experiments.pipeline_plan import plan_pipeline, plan_runs
from sasgeo_bench.matching.controls.blind import PriorCentre
from sasgeo_bench.osm.locate import Extract
from sasgeo_bench.regions.region import DATA_VERSION
from sasgeo_bench.scoring.submission_files import read_submission
from sasgeo_bench.tasks.private_seed import PrivateSeed, SealedPlace
from sasgeo_bench.tasks.query import TASK_VERSION
from sasgeo_bench.tasks.task_plan import Request
from tests.experiments.test_pipeline import TEXT as PIPELINE
from tests.threaded import threaded

pytestmark = pytest.mark.usefixtures("in_threads", "without_drawings")

TEXT = PIPELINE.replace(
    "sites = 1", 'sites = 1\nmatchers = ["random", "prior_centre"]'
).replace(  # who enters is asked all the same
    '["town-suburb"]', '["town-suburb", "town-riverside"]\nrejectors = ["margin"]'
)


class Middle(PriorCentre):
    """A matcher that is installed nowhere."""

    card = replace(PriorCentre.card, name="middle", trained_on=("porto", "10,000 views of Zurich"))


class Shipped(PriorCentre):
    """A matcher that takes a name that is taken."""

    card = replace(PriorCentre.card, name="sasgeo")


class Slip(PriorCentre):
    """A matcher whose card has a slip of the pen."""

    card = replace(PriorCentre.card, name="slip", trained_on=("munchen",))


class Lost(PriorCentre):
    """A matcher that has no answer to anything."""

    card = replace(PriorCentre.card, name="lost")

    def match(self, query, *, top_k):  # noqa: ARG002 - of every matcher
        raise KeyError(f"no road\nnear {query.track}")


@pytest.fixture(scope="module")
def request_(tmp_path_factory, few_controls, lay_towns):  # noqa: ARG001
    """A request to enter a board that is stored, with the file of its pipeline."""
    folder = tmp_path_factory.mktemp("entering")
    out = lay_towns(folder / "out", "town-suburb", "town-riverside")
    (folder / "small.toml").write_text(TEXT, encoding="utf-8")
    spec = parse_toml(TEXT, PipelineFile, source="small.toml")
    with threaded():
        run_pipeline(plan_pipeline(spec, out=out), results=folder / "results")
    return EntryRequest(
        stored=folder / "results" / "small",
        matcher=f"{__name__}:Middle",
        out=out,
        pipeline=folder / "small.toml",
    )


@pytest.fixture
def unscored(monkeypatch):
    """Who enters is asked, and not scored: for tests that are about asking."""
    monkeypatch.setattr(entering, "beside_stored", lambda *_, **__: SimpleNamespace(predictions={}))


@pytest.fixture(scope="module")
def entered(request_, tmp_path_factory):
    lines = []
    into = tmp_path_factory.mktemp("submitted") / "middle"
    with threaded(), reporting(lines.append):
        folder, board = enter(plan_entry(request_), into=into)
    return folder, board, lines


def test_what_it_costs_is_said_before(request_):
    first, drawing, asking, scoring, whole = cost_lines(plan_entry(request_))
    assert first.startswith("small: ")
    assert " queries in 3 tasks" in first  # the suite and the controls
    assert drawing == "  nothing is left to draw"
    assert re.match(r"  asking \d+ queries .+, and what the matcher itself takes: no entry of the board is", asking)
    assert scoring.startswith("  scoring ")
    assert whole.startswith("  in all ")
    elsewhere = plan_entry(replace(request_, out=request_.out / "elsewhere"))
    assert " 3 tasks and 3 maps are not there yet, about 6 MB on disk" in [*cost_lines(elsewhere)][1]


def test_more_than_the_matcher_counts_and_a_busy_machine_takes_longer(request_, monkeypatch):
    """Each map takes a process that starts and prepares; a load of 7 with 2 processors takes four times as long."""
    entry = plan_entry(replace(request_, out=request_.out / "elsewhere"))
    tasks, run = asked_tasks(entry.stored), check_entry(entry).run
    whole = entry_cost.open_tasks(entry.plan, tasks, run, is_again=False)
    stages = [entry_cost._drawing(entry.plan, whole), entry_cost._asking(entry.stored, whole, run)]
    maps = len({task.region for task in whole})
    assert stages[0].least_s > maps * (entry_cost._TASK_S + entry_cost._MAP_S)
    assert stages[1].least_s >= maps * entry_cost._START_S
    monkeypatch.setattr(os, "cpu_count", lambda: 2)
    for load, factor in ((0.5, 1.0), (7.0, 4.0)):
        monkeypatch.setattr(os, "getloadavg", lambda load=load: (load, 0.0, 0.0))
        line = [*cost_lines(entry, run)][1]
        assert entry_cost.Span(stages[0].least_s, factor * stages[0].most_s).to_text() in line


def test_entries_of_the_board_tell_how_long_it_takes(request_, monkeypatch):
    """Those that are like the matcher: none that follows flights alone."""
    monkeypatch.setattr(entry_cost, "is_unranked", lambda _: False)
    entry = plan_entry(request_)
    left = {"localization": 100.0, "sequence": 100.0}
    names = [name for _, name in entry_cost._costs(entry.stored, left, 3, check_entry(entry).run)]
    assert {"random", "prior_centre"} <= {*names}
    rows = entry_cost.read_scores(entry.stored)
    flown = rows.assign(track=rows["track"].where(rows["matcher"] != "random", "sequence"), latency_s=1.0)
    monkeypatch.setattr(entry_cost, "read_scores", lambda _: flown)
    costs = {name: seconds for seconds, name in entry_cost._costs(entry.stored, left, 3, None)}
    assert "random" not in costs
    assert costs["prior_centre"] == pytest.approx(200 + 3 * (entry_cost._START_S + 1), abs=0.5)
    line = [*cost_lines(entry)][2]
    assert re.match(r"  asking \d+ queries .+, as the middle half of \d entries of the board", line)


def test_an_entry_that_is_answered_is_said_to_need_scoring_alone(request_, entered):
    del entered
    entry = plan_entry(request_)
    _, drawing, asking, scoring, whole, *_ = cost_lines(entry, check_entry(entry).run)
    assert drawing == "  nothing is left to draw"
    assert asking == "  nothing is left to ask: what is drawn here as on the board has answers"
    assert scoring.removeprefix("  scoring ") == whole.removeprefix("  in all ").partition(":")[0]
    again = replace(entry, is_again=True)
    assert [*cost_lines(again, check_entry(again).run)][2].startswith("  asking ")


def test_the_submission_is_sound_and_answers_every_query(request_, entered):
    folder, _, lines = entered
    submission, faults = hold_submission(folder, [request_.stored])
    assert faults == ()
    assert {task.suite for task in submission.tasks} == {"clean", "controls"}
    assert all(task.answered == task.queries for task in submission.tasks)
    assert any(line.endswith("of the board are drawn as they were") for line in lines)
    assert not any("count as misses" in line for line in lines)


def test_the_card_is_that_of_the_matcher_with_places_apart_from_other_training(entered):
    card = read_submission(entered[0]).card
    assert (card.name, card.source) == ("middle", PriorCentre.card.source)
    assert (card.trained_on, card.trained_elsewhere) == (["porto"], "10,000 views of Zurich")


def test_its_row_stands_beside_the_others_as_submitted(entered):
    _, board, _ = entered
    table = board.board.leaderboard[
        (board.board.leaderboard["metric"] == "within_25m") & (board.board.leaderboard["suite"] == "clean")
    ]
    rows = table.set_index(["matcher", "stratum"])["value"]
    assert rows["middle"].equals(rows["prior_centre"])  # the same answers
    assert {entry.name: entry.how for entry in board.board.about.entries}["middle"] == "as submitted"


@pytest.mark.usefixtures("unscored")
def test_a_second_time_nothing_is_asked_again(request_, entered, tmp_path):
    lines = []
    with reporting(lines.append):
        again, _ = enter(plan_entry(request_), into=tmp_path / "middle")
    assert any(line.endswith(" answered before") and ": 0 queries to ask, " in line for line in lines)
    files = read_submission(entered[0]).files
    assert read_submission(again).files == files


def test_a_name_that_is_taken_is_refused_before_anything_is_asked(request_, tmp_path, monkeypatch):
    monkeypatch.setattr(entering, "ask", pytest.fail)
    request = replace(request_, matcher=f"{__name__}:Shipped")
    monkeypatch.setattr(entering, "draw_all", pytest.fail)
    with pytest.raises(MatchError, match="named 'sasgeo', as a matcher that ships: rename it"):
        enter(plan_entry(request), into=tmp_path / "sasgeo")
    assert not (tmp_path / "sasgeo").exists()


def test_a_folder_that_holds_other_things_is_refused_before_anything_is_asked(request_, tmp_path, monkeypatch):
    monkeypatch.setattr(entering, "ask", pytest.fail)
    entry = plan_entry(request_)
    (tmp_path / "middle").mkdir()
    (tmp_path / "middle" / "thesis.tex").write_text("mine", encoding="utf-8")
    with pytest.raises(StoreError, match="holds something else than a submission, which would be lost"):
        enter(entry, into=tmp_path / "middle")
    with pytest.raises(StoreError, match="must be named as the card is, 'middle'"):
        enter(entry, into=tmp_path / "other")


def test_answers_to_another_board_are_not_replaced(request_, entered, monkeypatch):
    folder, _, _ = entered
    monkeypatch.setattr(entering, "ask", pytest.fail)
    entry = plan_entry(request_)
    other = replace(entry, plan=replace(entry.plan, spec=entry.plan.spec.model_copy(update={"id": "other"})))
    with pytest.raises(
        StoreError, match=r"holds answers to the board 'small', .* as in --into submissions/other/middle"
    ):
        enter(other, into=folder)


def test_a_seed_that_did_not_draw_the_board_is_refused(request_, monkeypatch):
    seed = PrivateSeed("3f" * 16, is_sealed=True)
    sealed = {"porto": SealedPlace(drawn_by="ab" * 32, openings=[])}
    about = BoardManifest(scorer_version=6, entries=[], tasks=[], sealed=sealed)
    monkeypatch.setattr(board_queries, "read_board_manifest", lambda _: about)
    with pytest.raises(
        ConfigError, match=f"not drawn by this seed of sealed places, of commitment {seed.commitment[:12]}"
    ):
        plan_entry(replace(request_, sealed=seed))


def test_queries_of_sealed_places_and_of_older_versions_are_told_before(request_, monkeypatch):
    sealed = {"town-suburb": SealedPlace(drawn_by="ab" * 32, openings=[])}
    about = BoardManifest(scorer_version=6, entries=[], tasks=[], sealed=sealed, task_version=3)
    entry = plan_entry(request_)
    assert not any("count as misses" in line for line in cost_lines(entry))
    monkeypatch.setattr(entry_cost, "read_board_manifest", lambda _: about)
    message = "\n".join(cost_lines(entry))
    assert "of task version 3, and this program draws version" in message
    assert "are of sealed places, and count as misses without --sealed-seed-file" in message


def test_a_card_of_a_submission_has_the_authors_of_the_class_and_lines_that_are_cut():
    values = {"authors": ("A. Author",), "code": "https://example.org/mine", "uses": ("imagery",)}
    made = entering._card_of(
        replace(Middle.card, source="word " * 100, limits="word " * 100, **values), [], None, source="mine"
    )
    assert made.source.endswith(" ...")
    assert len(made.limits) <= 300
    assert (made.authors, made.code, made.uses) == (["A. Author"], "https://example.org/mine", ["imagery"])


def test_a_card_that_no_submission_can_have_is_refused_before_anything_is_drawn(request_, monkeypatch):
    monkeypatch.setattr(Middle, "card", replace(Middle.card, licence="long " * 20))
    entry = plan_entry(request_)
    with pytest.raises(ConfigError, match=r"the card of .*:Middle: 'licence': String should have at most 60 char"):
        check_entry(entry)


def test_figures_are_those_of_a_whole_score_to_the_last_bit(request_, entered, tmp_path):
    folder, board, _ = entered
    whole = with_submissions(request_.stored, [folder], tmp_path / "whole", root=request_.out)
    assert {"", "margin"} <= {*board.board.leaderboard["rejector"]}
    pd.testing.assert_frame_equal(board.board.leaderboard, whole.board.leaderboard, check_exact=True)
    pd.testing.assert_frame_equal(board.board.acceptance, whole.board.acceptance, check_exact=True)
    assert repr(board.board.findings) == repr(whole.board.findings)  # NaN is no equal of NaN
    assert {*board.judged} < {*whole.judged}  # nothing of the others was fitted


def test_all_is_scored_anew_where_the_scorer_is_another_one(request_, entered, tmp_path, monkeypatch):
    monkeypatch.setattr(submissions, "why_anew", lambda *_: "the board is of scorer version 5, this program of 6")
    lines = []
    with reporting(lines.append):
        beside_stored(request_.stored, entered[0], tmp_path / "both", root=request_.out)
    assert "all entries are scored anew: the board is of scorer version 5, this program of 6" in lines


def test_queries_of_another_version_are_not_asked(request_):
    entry = plan_entry(request_)
    tasks, controls = draw_all(entry.plan)
    same = same_queries(request_.stored, [*tasks, *controls])
    lost = sorted(same)[::3]
    only = {name: "drawn otherwise" if name in lost else one for name, one in same.items()}
    runs = plan_runs(replace(entry.plan, only=only, since_ns=sys.maxsize), entry.matcher, [*tasks, *controls])
    left = [name for run in runs for part in run.plan.parts for name in part.left]
    assert sorted(left) == sorted({*same} - {*lost})


@pytest.mark.usefixtures("unscored")
def test_all_is_asked_again_on_demand_and_a_changed_matcher_is_told(request_, entered, tmp_path, monkeypatch):
    del entered
    lines = []
    with reporting(lines.append):
        enter(plan_entry(replace(request_, is_again=True)), into=tmp_path / "middle")
    assert any(" queries to ask, 0 answered before" in line for line in lines)
    assert not any("asked anew" in line for line in lines)
    monkeypatch.setattr(Middle, "card", replace(Middle.card, version="9"))
    with reporting(lines.append):
        enter(plan_entry(request_), into=tmp_path / "middle")
    assert any(": all is asked anew, as " in line for line in lines)


@pytest.mark.usefixtures("unscored")
def test_a_round_that_was_cut_goes_on_where_it_was(request_, entered, tmp_path, monkeypatch):
    del entered
    entry, lines = plan_entry(replace(request_, is_again=True)), []
    asked = []

    def cut(spec, runs, **words):
        plan = runs[0].plan
        asked.extend(plan.parts[0].left)
        ask(spec, [replace(runs[0], plan=replace(plan, parts=plan.parts[:1]))], **words)
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(entering, "ask", cut)
        with pytest.raises(KeyboardInterrupt):
            enter(entry, into=tmp_path / "middle")
    whole = sum(len(task.asked) for task in asked_tasks(request_.stored))
    assert 0 < len(asked) < whole
    with reporting(lines.append):
        enter(entry, into=tmp_path / "middle")
    assert any(f": {whole - len(asked)} queries to ask, {len(asked)} answered before" in line for line in lines)


def test_who_fails_on_every_query_has_no_submission_and_an_example_of_it_on_one_line(request_, tmp_path):
    request = replace(request_, matcher=f"{__name__}:Lost")
    with pytest.raises(MatchError) as caught:
        enter(plan_entry(request), into=tmp_path / "lost")
    why = r"lost failed on all (\d+) queries \(\1 ended as crash, the first with the message [\"'].*no road.*near \w+.*"
    assert re.fullmatch(
        rf"{why}\): mend it, raise its version and enter again; \S+lost is as it was", str(caught.value)
    )
    assert not (tmp_path / "lost").exists()


def test_a_board_that_is_not_there_is_named_with_one_that_is(request_):
    beside = request_.stored.parent
    with pytest.raises(StoreError, match=f"is no folder here: did you mean {request_.stored}"):
        plan_entry(replace(request_, stored=beside / f"{request_.stored.name}x"))
    with pytest.raises(StoreError, match="holds no stored results: name those of a board"):
        plan_entry(replace(request_, stored=beside))


def test_extracts_that_are_missing_are_listed_at_once(request_, monkeypatch):
    entry = plan_entry(request_)
    lost = Extract(file="nowhere.osm.pbf", date=dt.date(2020, 1, 1), sha256=("0" * 64,))
    monkeypatch.setattr(Request, "extracts", (lost, lost.model_copy(update={"file": "gone.osm.pbf"})))
    monkeypatch.setattr(entering, "draw_all", pytest.fail)
    assert "missing extracts: gone.osm.pbf, nowhere.osm.pbf" in "".join(cost_lines(entry))
    with pytest.raises(ConfigError, match=r"missing extracts: gone\.osm\.pbf, nowhere\.osm\.pbf: .* by --without"):
        enter(entry)


@pytest.mark.parametrize("beside", [(), ("town-suburb",)])  # one that is known hides no other
def test_a_region_that_the_board_has_not_cannot_be_left_out(request_, beside):
    with pytest.raises(ConfigError, match="--without names vaduz, and the board asks about no such region"):
        plan_entry(replace(request_, without=("vaduz", *beside)))


def test_a_partial_entry_is_said_to_be_one(request_):
    entry = plan_entry(request_)
    other = entry.plan.requests[0].region.model_copy(update={"id": "elsewhere"})
    entry = replace(
        entry, plan=replace(entry.plan, requests=(replace(entry.plan.requests[0], region=other),), controls=())
    )
    assert any(line.startswith("  a partial entry: ") for line in cost_lines(entry))


def test_another_text_of_the_pipeline_is_refused(request_, tmp_path):
    (tmp_path / "small.toml").write_text(TEXT.replace("sites = 1", "sites = 2"), encoding="utf-8")
    words = r"made by another text of the pipeline 'small'.* \(sasgeo-bench .*, task version \d+\), or name the file by"
    with pytest.raises(ConfigError, match=words):
        plan_entry(replace(request_, pipeline=tmp_path / "small.toml"))


def test_a_board_on_other_maps_is_refused_at_once_by_the_version_that_made_it(request_, monkeypatch):
    monkeypatch.setattr(board_queries, "DATA_VERSION", DATA_VERSION + 1)
    made_by = rf"made by sasgeo-bench \S+, data version {DATA_VERSION}, task version {TASK_VERSION}, and this is "
    with pytest.raises(ConfigError, match=rf"{made_by}sasgeo-bench \S+, data version {DATA_VERSION + 1}, task version"):
        plan_entry(request_)


def test_a_board_of_tasks_of_another_version_is_told(request_, monkeypatch):
    monkeypatch.setattr(board_queries, "TASK_VERSION", TASK_VERSION + 1)
    lines: list[str] = []
    with reporting(lines.append):
        plan_entry(request_)
    assert [line for line in lines if f"task version {TASK_VERSION}, this is sasgeo-bench" in line]


def test_queries_that_are_drawn_otherwise_are_refused_before_anything_is_asked(request_, tmp_path, monkeypatch):
    entry = plan_entry(request_)
    other = plan_pipeline(entry.plan.spec.model_copy(update={"seed": 5}), out=tmp_path / "out")
    monkeypatch.setattr(entering, "ask", pytest.fail)
    with pytest.raises(ConfigError, match=r"none of the \d+ queries of .* is drawn here as it was: .* version that"):
        enter(replace(entry, plan=other), into=tmp_path / "middle")
    assert not (tmp_path / "middle").exists()


def test_the_command_says_what_it_costs_and_stops(request_, program):
    words = ("enter", request_.stored, "--matcher", request_.matcher, "--pipeline", request_.pipeline)
    code, out, err = program(*words, "--dry-run", "--out", request_.out)
    assert (code, err) == (0, "")
    assert out.splitlines()[0].startswith("small: ")


def test_the_command_says_who_answered_the_same_queries_elsewhere(program, monkeypatch):
    entry = SimpleNamespace(board="small", run=SimpleNamespace(card=SimpleNamespace(name="mine")))
    board = SimpleNamespace(about=SimpleNamespace(elsewhere="small-mine"))
    scored = SimpleNamespace(predictions={}, board=board)
    for name in ("plan_entry", "check_entry"):
        monkeypatch.setattr(cli_entering, name, lambda *_, **__: entry)
    for name in ("cost_lines", "failure_lines"):
        monkeypatch.setattr(cli_entering, name, lambda *_: ())
    for name in ("show_board", "check_controls"):
        monkeypatch.setattr(cli_entering, name, lambda _: None)
    monkeypatch.setattr(cli_entering, "enter", lambda *_, **__: (Path("sent/mine"), scored))
    monkeypatch.setattr(cli_entering, "elsewhere_lines", lambda found: [f"the same queries, of {found}"])
    assert program("enter", "small", "--matcher", "mine")[1].splitlines() == [
        "the same queries, of small-mine",
        "sent/mine",
    ]


def test_a_slip_in_a_training_place_does_not_untrain_a_matcher(request_):
    entry = plan_entry(replace(request_, matcher=f"{__name__}:Slip"))
    with pytest.raises(ConfigError, match=r"names 'munchen', no place of the split: did you mean 'munich'\?"):
        check_entry(entry)
