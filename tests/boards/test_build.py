# SPDX-License-Identifier: Apache-2.0
"""Boards from runs and files: the same figures either way; faults are told in one line and nothing is written."""

import errno
import json
import math
import re
import shutil
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from sasgeo_bench import cli
from sasgeo_bench.boards import score as boards
from sasgeo_bench.boards.board_files import AdditionalFiles, read_board_manifest, read_leaderboard
from sasgeo_bench.boards.build import make_board
from sasgeo_bench.boards.manifests import PipelineRecord
from sasgeo_bench.boards.scored import ScoreRequest
from sasgeo_bench.boards.tables import marks_of
from sasgeo_bench.cli.console import CONTESTANT_FAILED
from sasgeo_bench.core.errors import ConfigError, MatchError, StoreError
from sasgeo_bench.core.progress import reporting
from sasgeo_bench.matching.matcher import Prediction, RejectorCard
from sasgeo_bench.regions.region_spec import find_region_file, read_region_file
from sasgeo_bench.running import prediction_files
from sasgeo_bench.running.failures import Failures
from sasgeo_bench.running.oracle import right_answer
from sasgeo_bench.running.plan import RunRequest, plan_run
from sasgeo_bench.running.prediction_files import RunManifest, mark_packed
from sasgeo_bench.running.runner import run
from sasgeo_bench.scoring import entries, tables
from sasgeo_bench.scoring.contrasts import Contrast
from sasgeo_bench.scoring.controls import Verdict
from sasgeo_bench.scoring.entries import find_entries
from sasgeo_bench.scoring.rejection import JUDGED, why_not
from sasgeo_bench.scoring.score import SCORER_VERSION
from sasgeo_bench.tasks import task_files
from sasgeo_bench.tasks.build import make_tasks
from sasgeo_bench.tasks.split import SplitFile, find_split, find_split_file, make_split, read_split_file
from sasgeo_bench.tasks.task_plan import TaskRequest, plan_requests
from tests.plain_boards import plain_boards
from tests.slow import rest_slow

TOWNS = ("town-riverside", "town-suburb")


class Doubt:
    """Doubts every answer as often as answers were false where it was fitted."""

    card = RejectorCard(name="doubt", version="1", title="Doubt", source="original", ours="all", licence="MIT")

    def fit(self, predictions, is_false):
        assert len(predictions) == len(is_false)
        self.rate = float(np.mean(is_false))

    def p_false(self, predictions):
        return np.full(len(predictions), self.rate)


class Order(Doubt):
    card = replace(Doubt.card, name="order", is_calibrated=False)


class DoubtToo(Doubt):
    """Another rejector of the same name."""


class Own(Doubt):
    card = replace(Doubt.card, name="own")


@pytest.fixture(scope="module")
def built(tmp_path_factory, lay_towns):
    """Two towns, a task each in which every fourth place is made absent, a run of the control that has the truth."""
    out = lay_towns(tmp_path_factory.mktemp("boards") / "out", *TOWNS)
    wanted = TaskRequest(
        suites=("clean",), regions=TOWNS, split="crossfit", count=2, seed=2, out=out, may_be_fewer=True
    )
    for request in plan_requests(wanted):
        make_tasks(request)
    tasks = [out / "tasks" / "clean" / town for town in TOWNS]
    for town in TOWNS:
        folder = out / "truth" / "clean" / town
        truths = [replace(truth, is_present=at % 4 > 0) for at, truth in enumerate(task_files.read_truths(folder))]
        rows = [task_files.truth_row(truth) for truth in truths]
        pq.write_table(pa.Table.from_pylist(rows, schema=task_files.TRUTH_SCHEMA), folder / task_files.TRUTH)
    run(plan_run(RunRequest(spec="oracle_pose", tasks=tasks, out=out)))
    return out


@pytest.fixture
def out(built, tmp_path):
    shutil.copytree(built, tmp_path / "out", symlinks=True)
    return tmp_path / "out"


@pytest.fixture(scope="module")
def split():
    halves = dict.fromkeys(TOWNS, "a") | dict.fromkeys(("town-old-town", "town-industrial"), "b")
    grids = {town: read_region_file(find_region_file(town)).grid() for town in halves}
    spec = read_split_file(find_split_file("crossfit"))
    places = [{"name": f"place-{town}", "regions": [town], "half": half} for town, half in halves.items()]
    values = {"id": "towns", "title": "Towns", "kind": "crossfit", "buffer_m": 0.0, "reach_m": spec.reach_m}
    return make_split(SplitFile.model_validate(values | {"place": places}), grids)


def board_of(out, *predictions, has_texts=False, extras=(), **changes):
    request = ScoreRequest(
        predictions=predictions or [out / "runs"], root=out, board=out / "boards" / "mine", draws=200
    )
    with nullcontext() if has_texts else plain_boards():
        return make_board(replace(request, **changes), extras)


def primary(board, matcher):
    rows = board.board.leaderboard[
        (board.board.leaderboard["matcher"] == matcher) & (board.board.leaderboard["metric"] == "success_25m")
    ]
    return rows[rows["stratum"] == "all"].iloc[0]


def submission(out, path, *, keep=lambda _: True, change=lambda row, query: row):  # noqa: ARG005
    """A file of right answers to some of the queries, changed as is asked."""
    rows = []
    for town in TOWNS:
        truths = {truth.query_id: truth for truth in task_files.read_truths(out / "truth" / "clean" / town)}
        queries = task_files.read_queries(out / "tasks" / "clean" / town)
        rows += [change(right_answer(query, truths[query.query_id]), query) for query in queries]
    part = prediction_files.write_part(path.parent / "parts", [row for at, row in enumerate(rows) if keep(at)])
    shutil.move(part, path)
    return len(rows)


def test_progress_counts_every_group_of_queries_and_every_entry(out):
    begun, done = {}, {}

    class Counts:
        def begin(self, label, total):
            begun[label], done[label] = total, 0

        def advance(self, label, count):
            done[label] += count

    request = ScoreRequest(predictions=[out / "runs"], root=out, board=out / "boards" / "mine", draws=200)
    with reporting(progress=Counts()):
        board = make_board(request)
    groups = board.scores["oracle_pose"][["suite", "track", "prior_group"]].drop_duplicates()
    assert begun == done == {tables.INTERVALS: len(groups), JUDGED: 1}


def test_an_entry_of_which_some_answers_came_packed_says_so_on_every_board(out, tmp_path):
    shutil.copytree(out / "runs", tmp_path / "runs")
    (run, *_) = sorted((tmp_path / "runs").rglob("run.json"))
    assert {entry.how for entry in find_entries([tmp_path / "runs"])} == {"run here"}
    mark_packed(run.parent, "ab" * 32)
    name = json.loads(run.read_text())["matcher"]["name"]
    values = {entry.name: entry.how for entry in find_entries([tmp_path / "runs"])}
    assert values.pop(name) == "answers came packed"
    assert "answers came packed" not in values.values()


def test_the_truth_scores_as_perfect_and_a_file_scores_as_a_run_does(out, tmp_path):
    submission(out, tmp_path / "mine.parquet")
    board = board_of(out, out / "runs", tmp_path / "mine.parquet")
    for name in ("oracle_pose", "mine"):
        assert primary(board, name)["value"] == 1.0
        absent = board.board.leaderboard[
            (board.board.leaderboard["matcher"] == name) & (board.board.leaderboard["metric"] == "answered_absent")
        ]
        assert set(absent["value"]) == {0.0}
    columns = [name for name in board.scores["mine"].columns if name != "latency_s"]
    pd.testing.assert_frame_equal(board.scores["mine"][columns], board.scores["oracle_pose"][columns])
    about, table = read_board_manifest(out / "boards" / "mine"), read_leaderboard(out / "boards" / "mine")
    assert [(entry.name, entry.how) for entry in about.entries] == [
        ("mine", "as submitted"),
        ("oracle_pose", "run here"),
    ]
    assert about.attribution == "(c) OpenStreetMap contributors, ODbL"
    assert len(table) == len(board.board.leaderboard)
    assert about.libraries["numpy"] == np.__version__
    assert about.pipeline is None
    assert about.rejectors == []
    record = pq.read_schema(out / "boards" / "mine" / "leaderboard.parquet").metadata
    assert record[b"scorer_version"] == str(SCORER_VERSION).encode()
    assert b"OpenStreetMap" in record[b"attribution"]
    read = pd.read_parquet(out / "boards" / "mine" / "leaderboard.parquet")
    assert read.attrs["attribution"] == about.attribution
    assert read.attrs["scorer_version"] == str(SCORER_VERSION)
    assert set(read.attrs) > {"licence", "task_version", "data_version", "made_by"}
    assert str(read["rank_best"].dtype) == "Int64"
    assert read["rank_best"].isna().all()  # of two blocks nobody has a rank
    facts = read.drop_duplicates("matcher").set_index("matcher")[["version", "hash", "is_control"]]
    (entry,) = (entry for entry in board.board.about.entries if entry.name == "oracle_pose")
    assert facts.loc["oracle_pose"].tolist() == [entry.version, entry.hash, True]
    assert facts.loc["mine", ["version", "hash"]].isna().all()
    assert not facts.loc["mine", "is_control"]


def test_predictions_for_half_of_the_queries_are_misses_for_the_rest(out, tmp_path):
    count = submission(out, tmp_path / "half.parquet", keep=lambda at: at % 2 == 0)
    assert count % 2 == 0
    board = board_of(out, tmp_path / "half.parquet", has_texts=True)
    assert len(board.scores["half"]) == count
    row = primary(board, "half")
    assert row["missing"] > 0
    assert row["value"] == pytest.approx(1 - row["missing"] / row["n"])
    text = (out / "boards" / "mine" / "leaderboard.md").read_text(encoding="utf-8")
    assert f"half: {count // 2} queries lack a row and count as misses." in text


def moved(row, query):
    """An answer half a kilometre off, or another candidate; none where there was none."""
    if not row.candidates:
        return row
    ((pose, score),) = row.candidates
    away = replace(pose, easting_m=pose.easting_m + 500)
    others = (item for item in query.candidates if abs(item.easting_m - pose.easting_m) > 1)
    return replace(row, candidates=((next(others, away), score),))


@pytest.mark.parametrize(("is_right", "confidence"), rest_slow([(False, 0.5), (True, 0.5), (True, None)]))
def test_a_board_of_equal_confidences_or_none_and_of_no_false_fix_or_nothing_else(
    out, tmp_path, split, confidence, is_right
):
    def change(row, query):
        row = replace(row, confidence=confidence if row.candidates else None)
        return row if is_right else moved(row, query)

    submission(out, tmp_path / "mine.parquet", change=change)
    rejectors = ["margin", "isotonic_margin", "logistic_all", "entropy"]
    board = board_of(out, tmp_path / "mine.parquet", rejectors=rejectors, split=split)
    assert primary(board, "mine")["value"] == float(is_right)
    rows = board.board.leaderboard[
        (board.board.leaderboard["stratum"] == "as drawn") & (board.board.leaderboard["rejector"] != "")
    ]
    assert set(rows["rejector"]) == {*rejectors} | ({"own"} if confidence else set())
    # What cannot be told apart is accepted together or not at all.
    covered = rows[rows["metric"] == "coverage_at_risk_0.05"]
    assert len(covered) >= len(rejectors)
    for _, row in covered.iterrows():
        assert row["value"] == pytest.approx(row["answered"] / row["n"] if is_right else 0.0)
    assert set(rows[(rows["rejector"] == "own") & (rows["metric"] == "brier")]["value"]) == (
        {0.25} if confidence else set()
    )
    assert len(read_leaderboard(out / "boards" / "mine")) == len(board.board.leaderboard)


def test_a_rejector_is_fitted_on_other_places_and_its_rows_stand_apart(out, tmp_path, split):
    submission(out, tmp_path / "mine.parquet")
    board = board_of(out, tmp_path / "mine.parquet", rejectors=[f"{__name__}:Doubt"], split=split)
    asked = {"pipeline": PipelineRecord(id="mine", sha256="0" * 64), "rejectors": [f"{__name__}:Order"], "split": split}
    order = board_of(out, tmp_path / "mine.parquet", **asked).board.leaderboard
    about = read_board_manifest(out / "boards" / "mine")
    assert about.pipeline == asked["pipeline"]
    assert [(card.name, card.is_calibrated) for card in about.rejectors] == [("order", False)]
    assert not {"brier", "cost_20"} & set(order[order["rejector"] == "order"]["metric"])
    rows = board.board.leaderboard[board.board.leaderboard["rejector"] == "doubt"]
    by_name = {row["metric"]: row for _, row in rows[rows["stratum"] == "as drawn"].iterrows()}
    assert by_name["brier"]["value"] == 0.0  # all answers were right, and none was doubted
    assert by_name["coverage_at_risk_0.01"]["value"] == pytest.approx(
        by_name["aurc"]["answered"] / by_name["aurc"]["n"]
    )
    assert set(board.scores["mine"]["place"]) == {f"place-{town}" for town in TOWNS}
    pooled = rows[rows["suite"] == "all suites"]
    assert {"present 0.9", "present 0.7", "present 0.5"} < set(pooled["stratum"])


@pytest.mark.usefixtures("in_this_process")
def test_no_figure_hangs_on_how_many_processes_judge(out, tmp_path, split):
    rejectors = ["sasgeo_bench.sasgeo.rejectors:SasgeoLogistic", "margin"]
    submission(out, tmp_path / "mine.parquet")
    submission(out, tmp_path / "yours.parquet", keep=lambda at: at % 2)
    files = [tmp_path / name for name in ("mine.parquet", "yours.parquet")]
    one, two = (board_of(out, *files, rejectors=rejectors, split=split, jobs=jobs) for jobs in (1, 2))
    pd.testing.assert_frame_equal(one.board.leaderboard, two.board.leaderboard)
    assert one.judged.keys() == two.judged.keys()
    assert one.board.about.remarks == two.board.about.remarks


@pytest.mark.usefixtures("in_threads")
def test_a_rejector_that_is_not_applied_says_why(out, split):
    lines = []
    run(plan_run(RunRequest(spec="random", tasks=[out / "tasks" / "clean" / TOWNS[0]], out=out)))
    request = ScoreRequest(
        predictions=[out / "runs" / "random"], root=out, board=out / "boards" / "mine", draws=200, split=split,
        rejectors=[f"{__name__}:Doubt"],
    )  # fmt: skip
    with reporting(lines.append):
        board = make_board(request)
    why = "doubt on random: not applied, no other place of the board calibrates"
    assert why in lines
    assert why in board.board.about.remarks
    silent = pd.DataFrame({"is_answered": [False] * 2, "place": ["a", "b"]})
    assert why_not(silent) == "it has no answers to judge"
    half = pd.DataFrame({"is_answered": [False, True], "place": ["a", "b"]})
    assert why_not(half) == "no place that may calibrate another one has an answer"


def test_what_a_rejector_remarks_of_its_fits_is_told_and_kept(out, tmp_path, split):
    submission(out, tmp_path / "mine.parquet")
    rejectors = ["sasgeo_bench.sasgeo.rejectors:SasgeoLogistic", f"{__name__}:Doubt"]
    board, lines = told_by(out, tmp_path / "mine.parquet", rejectors=rejectors, split=split)
    given = [line for line in lines if "ranked by margin" in line]
    assert given == list(board.board.about.remarks)
    assert given[0].startswith("sasgeo_logistic on mine: 0 of ")  # the answers are right, all of them
    assert given[0].endswith(" judged so)")
    assert read_board_manifest(out / "boards" / "mine").remarks == given


def test_protection_levels_are_counted_where_answers_tell_them(out, tmp_path, split):
    levels = {"sigma_m": 2.0, "hpl_gauss_0.01_m": 6.0}
    submission(out, tmp_path / "mine.parquet", change=lambda row, _: replace(row, diagnostics=levels))
    board = board_of(out, tmp_path / "mine.parquet", split=split)
    assert set(board.board.protection["method"]) == {"gauss", "conformal"}
    given = board.board.protection[board.board.protection["method"] == "gauss"]
    assert (given["n"] > 0).all()
    assert (given["misleading"] == 0.0).all()  # the submission knows the truth
    folder = out / "boards" / "mine"
    assert pq.read_table(folder / "protection.parquet").num_rows == len(board.board.protection)
    assert len(pd.read_csv(folder / "protection.csv")) == len(board.board.protection)
    submission(out, tmp_path / "mine.parquet")  # the same without: the tables go
    assert board_of(out, tmp_path / "mine.parquet", split=split).board.protection.empty
    assert not list(folder.glob("protection.*"))


def test_the_own_word_of_a_matcher_stands_beside_its_rejectors_and_needs_no_split(out, tmp_path, split):
    submission(out, tmp_path / "mine.parquet")
    board = board_of(out, tmp_path / "mine.parquet")
    own = board.board.leaderboard[board.board.leaderboard["rejector"] == "own"].set_index("metric")
    assert own.loc["brier", "value"].max() == 0.0  # right, and sure of it
    assert "coverage_at_risk_0.05" not in own.index
    contrast = Contrast(name="own", first="mine x own", second="mine x doubt", suites=("clean",), metric="aurc")
    changes = {"rejectors": [f"{__name__}:Doubt"], "split": split, "contrasts": [contrast]}
    judged = board_of(out, tmp_path / "mine.parquet", **changes)
    assert {"own", "doubt"} < set(judged.board.leaderboard["rejector"])
    assert "coverage_at_risk_0.05" in set(
        judged.board.leaderboard[judged.board.leaderboard["rejector"] == "own"]["metric"]
    )
    assert judged.board.findings[0].n > 0
    with pytest.raises(ConfigError, match="'own' is what a board calls a matcher's own confidence: rename"):
        board_of(out, rejectors=[f"{__name__}:Own"], split=split)


def test_what_was_sent_and_what_maps_take_is_told(out, tmp_path):
    submission(out, tmp_path / "mine.parquet")
    board = board_of(out, out / "runs", tmp_path / "mine.parquet")
    given = board.board.leaderboard.set_index(["matcher", "metric"])["value"]
    sizes = [
        size for town in TOWNS for size in task_files.Task.open(out / "tasks" / "clean" / town).view_bytes().values()
    ]
    fixes = int(board.scores["mine"]["is_answered"].sum())
    assert given["mine", "observation_per_fix"] == pytest.approx(sum(sizes) / 1e3 / fixes)
    assert given["oracle_pose", "map_per_km2"] > 0
    shutil.rmtree(out / "regions")  # scores need no map
    again = board_of(out).board.leaderboard.set_index(["matcher", "metric"])["value"]
    assert math.isnan(again["oracle_pose", "map_per_km2"])


def test_rejectors_need_a_split_and_must_be_known(out, split):
    with pytest.raises(ConfigError, match="name one with --split"):
        board_of(out, rejectors=[f"{__name__}:Doubt"])
    with pytest.raises(MatchError, match="there is no rejector 'duobt'"):
        board_of(out, rejectors=["duobt"], split=split)
    assert not (out / "boards").exists()


def edit_json(path, **changes):
    path.write_text(json.dumps(json.loads(path.read_text(encoding="utf-8")) | changes), encoding="utf-8")


def break_task(out):
    edit_json(out / "tasks" / "clean" / TOWNS[0] / "task.json", task_version=0)


def break_truth(out):
    edit_json(out / "truth" / "clean" / TOWNS[0] / "truth.json", queries_sha256="0" * 64)


def cut_truth(out):
    (out / "truth" / "clean" / TOWNS[0] / "truth.json").write_text("{", encoding="utf-8")


def age_truth(out):
    path = out / "truth" / "clean" / TOWNS[0] / "truth.parquet"
    table = pq.read_table(path)
    pq.write_table(table.replace_schema_metadata(table.schema.metadata | {b"task_version": b"0"}), path)


def lose_truth(out):
    (out / "truth" / "clean" / TOWNS[0] / "truth.parquet").unlink()


def age_run(out):
    """Rows as an older program wrote them, of queries that were another file's."""
    for path in (out / "runs").rglob("run.json"):
        edit_json(path, queries_sha256="0" * 64)
    for path in (out / "runs").rglob("part-*.parquet"):
        pq.write_table(pq.read_table(path).drop_columns(["asked_sha256"]), path)


def cut_part(out):
    path = next((out / "runs").rglob("part-*.parquet"))
    path.write_bytes(path.read_bytes()[:200])


@pytest.mark.parametrize(
    ("damage", "words"),
    [
        (break_task, "has task version 0, this version reads 1"),
        (break_truth, "holds the truths of other queries"),
        (cut_truth, r"truth\.json .*(JSON|Expecting)"),
        (lose_truth, "holds no truths of .*: name their folder with --truth, or make the queries again"),
        (age_truth, "holds truths of task version 0, this version reads 1, 2, 3, 4, 5: make the queries again"),
        (age_run, r"holds answers to other queries than its task does now: run again \(.*, or make the old queries"),
        (cut_part, "cannot be read"),
    ],
)
def test_what_does_not_belong_together_is_refused_and_nothing_is_written(out, damage, words):
    damage(out)
    with pytest.raises(StoreError, match=words):
        board_of(out)
    assert not (out / "boards").exists()


def test_a_board_of_another_scorer_version_is_not_replaced(out, monkeypatch):
    board_of(out)
    before = (out / "boards" / "mine" / "leaderboard.parquet").read_bytes()
    board_of(out)  # of the same version it is
    monkeypatch.setattr(boards, "SCORER_VERSION", SCORER_VERSION + 1)
    monkeypatch.setattr(boards, "find_entries", None)  # refused before anything is read
    with pytest.raises(StoreError, match=f"rows of scorer version {SCORER_VERSION}, this one is {SCORER_VERSION + 1}"):
        board_of(out)
    assert (out / "boards" / "mine" / "leaderboard.parquet").read_bytes() == before


def test_truths_may_lie_in_a_folder_of_another_name(out, tmp_path):
    shutil.move(out / "truth", tmp_path / "secret")
    with pytest.raises(StoreError, match="name their folder with --truth"):
        board_of(out)
    assert primary(board_of(out, truth=tmp_path / "secret"), "oracle_pose")["value"] == 1.0


@pytest.mark.slow
def test_rows_that_a_board_has_no_more_are_told(out, tmp_path):
    submission(out, tmp_path / "mine.parquet")
    board = out / "boards" / "twice"
    _, first = told_by(out, out / "runs", tmp_path / "mine.parquet", board=board)
    _, second = told_by(out, out / "runs", board=board)
    _, third = told_by(out, out / "runs", board=board)
    message = f"{board} had rows of mine, which this board has not; their answers are where they were"
    assert [message in lines for lines in (first, second, third)] == [False, True, False]
    (board / "site").mkdir()
    (board / "site" / "site.json").write_text('{"files": []}', encoding="utf-8")
    _, fourth = told_by(out, out / "runs", board=board)
    assert f"{board / 'site'} is of the older board and is removed with it: publish again" in fourth
    assert not (board / "site").exists()


def test_a_folder_with_other_things_is_not_replaced(out):
    folder = out / "boards" / "mine"
    folder.mkdir(parents=True)
    (folder / "thesis.txt").write_text("years of work", encoding="utf-8")
    with pytest.raises(StoreError, match=r"thesis\.txt is no part of a board"):
        board_of(out)
    assert (folder / "thesis.txt").read_text(encoding="utf-8") == "years of work"


def test_a_file_that_validate_refuses_is_not_scored(out, tmp_path):
    submission(out, tmp_path / "mine.parquet")
    table = pq.read_table(tmp_path / "mine.parquet")
    pq.write_table(pa.concat_tables([table, table.slice(0, 1)]), tmp_path / "mine.parquet")
    with pytest.raises(ConfigError, match=r"holds 1 fault: .*each query once.*'verify' lists all"):
        board_of(out, tmp_path / "mine.parquet")
    assert not (out / "boards").exists()


class Raises(Doubt):
    def p_false(self, predictions):
        raise RuntimeError(len(predictions))


class Leaves(Doubt):
    def p_false(self, predictions):
        raise SystemExit(len(predictions) * 0)


class SaysNan(Doubt):
    def p_false(self, predictions):
        return np.full(len(predictions), np.nan)


class LeavesAtOnce(Doubt):
    def __init__(self):
        raise SystemExit(0)


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("Raises", r"rejector 'doubt' failed \(RuntimeError: .*: mend it, or leave it out"),
        ("SaysNan", r"rejector 'doubt' failed \(MatchError: p_false\(\) returned nan in place 0, expected 0..1\)"),
        ("Leaves", r"rejector 'doubt' failed \(SystemExit: 0\)"),
        ("LeavesAtOnce", r"LeavesAtOnce: cannot be made \(SystemExit: 0\)"),
    ],
)
def test_a_rejector_that_fails_or_ends_the_program_is_named_and_nothing_is_written(out, split, name, words):
    with pytest.raises(MatchError, match=words):
        board_of(out, rejectors=[f"{__name__}:{name}"], split=split)
    assert not (out / "boards").exists()


def test_two_rejectors_of_one_name_are_refused_and_one_named_twice_is_one(out, split):
    first, second = (f"{__name__}:{name}" for name in ("Doubt", "DoubtToo"))
    with pytest.raises(ConfigError, match=r"Doubt and .*DoubtToo are both named 'doubt': rename one"):
        board_of(out, rejectors=[first, second], split=split)
    assert set(board_of(out, rejectors=[first, first], split=split).board.leaderboard["rejector"]) >= {"doubt"}


def test_nothing_to_score_is_told(out, tmp_path):
    prediction_files.write_part(tmp_path / "foreign", [Prediction(query_id="f" * 24)])
    (part,) = prediction_files.parts_of(tmp_path / "foreign")
    with pytest.raises(ConfigError, match=r"nothing to score: no task in .*/out/tasks is answered \(--out names"):
        board_of(out, part)
    with pytest.raises(StoreError, match="holds no run"):
        board_of(out, tmp_path / "foreign")


def copy_run(out, name, towns, *, asked=None):
    """Runs of another matcher with the control's answers, to queries as they are, or as they once were."""
    folders = []
    for town in towns:
        (run,) = (path for path in (out / "runs" / "oracle_pose").glob(f"*/clean/{town}"))
        folder = out / "runs" / name / "0123456789ab" / "clean" / town
        hashes = task_files.Task.open(out / "tasks" / "clean" / town).asked if asked is None else asked
        rows = list(prediction_files.read_predictions(run))
        prediction_files.write_part(folder, rows, asked={row.query_id: hashes[row.query_id] for row in rows})
        about = RunManifest.open(run)
        other = {"matcher": about.matcher.model_copy(update={"name": name}), "hash": "0123456789ab"}
        about.model_copy(update=other | ({} if asked is None else {"queries_sha256": "0" * 64})).save(folder)
        folders.append(folder)
    return folders


def told_by(out, *predictions, **changes):
    lines = []
    request = ScoreRequest(predictions=predictions, root=out, board=out / "boards" / "mine", draws=200)
    with plain_boards(), reporting(lines.append):
        return make_board(replace(request, **changes)), lines


class Once(dict):
    def __missing__(self, key):
        return "0" * 64


def test_a_run_of_other_queries_is_left_out_among_many_and_refused_by_itself(out):
    stale = copy_run(out, "stale", TOWNS, asked=Once())
    board, lines = told_by(out, out / "runs")
    assert [entry.name for entry in board.board.about.entries] == ["oracle_pose"]
    assert lines[0] == f"left out: 2 runs without an answer to these queries ({stale[0]}, {stale[1]})"
    for named in (stale[0], out / "runs" / "stale"):
        with pytest.raises(StoreError, match="holds answers to other queries than its task does now: run again"):
            told_by(out, named)
    with pytest.raises(StoreError, match="holds answers to other queries than these tasks do now"):
        told_by(out, out / "runs" / "stale", tasks=[out / "tasks" / "clean" / TOWNS[1]])


def test_rows_to_other_queries_beside_the_answers_are_never_scored(out):
    (run,) = (out / "runs" / "oracle_pose").glob(f"*/clean/{TOWNS[0]}")
    before, _ = told_by(out, run)
    rows = [replace(row, candidates=()) for row in prediction_files.read_predictions(run)]
    strangers = [*rows, Prediction(query_id="f" * 24)]
    prediction_files.write_part(run, strangers, asked=dict.fromkeys([row.query_id for row in strangers], "0" * 64))
    after, _ = told_by(out, run)
    pd.testing.assert_frame_equal(before.scores["oracle_pose"], after.scores["oracle_pose"])
    (entry,) = after.entries
    share = (len(rows)) / (len(rows) + len(strangers))
    assert entry.runs[0].cpu_s == pytest.approx(share * RunManifest.open(run).cpu_s)


def test_who_was_asked_nothing_of_a_task_is_not_on_the_board_of_its_suite(out):
    copy_run(out, "partly", TOWNS[:1])
    board, lines = told_by(out, out / "runs")
    assert "partly: not on the board of clean, for it was not asked all tasks there" in lines
    assert set(board.scores) == {"oracle_pose"}
    board, lines = told_by(out, out / "runs", tasks=[out / "tasks" / "clean" / TOWNS[0]])
    assert set(board.scores) == set(board.board.leaderboard["matcher"]) == {"oracle_pose", "partly"}
    assert not board.board.leaderboard["missing"].any()
    present = board.scores["partly"]["is_present"].to_numpy(bool)
    count = len(present)
    assert f"partly: {present.sum()} of {count} queries answered, {count - present.sum()} withheld" in lines
    with pytest.raises(ConfigError, match=r"nothing to rank: .* no suite has a matcher that was asked all"):
        told_by(out, out / "runs" / "partly", tasks=[out / "tasks" / "clean" / town for town in TOWNS])


def test_tasks_of_train_places_alone_are_refused_as_what_they_are():
    trained = SimpleNamespace(parts=lambda: {"train"})
    loaded = entries.ScoredEntries(answers=(), tasks=(trained,), scores={}, views={})
    with pytest.raises(ConfigError, match="nothing to rank: all tasks are of train places of split 'holdout'"):
        entries.scored_rows(loaded, find_split("holdout"))


def test_a_region_that_is_left_out_is_as_if_it_had_never_been_asked(out):
    alone, _ = told_by(out, out / "runs", tasks=[out / "tasks" / "clean" / TOWNS[0]])
    board, lines = told_by(out, out / "runs", without=[TOWNS[1]])
    pd.testing.assert_frame_equal(alone.board.leaderboard, board.board.leaderboard)
    assert not any("left out" in line for line in lines)
    record = json.loads((out / "boards" / "mine" / "board.json").read_text())
    assert record["without"] == [TOWNS[1]]
    assert [task["region"] for task in record["tasks"]] == [TOWNS[0]]


def test_what_cannot_be_left_out_is_told(out, tmp_path):
    with pytest.raises(ConfigError, match=f"no run is on 'nowhere': regions that can be left out are {TOWNS[0]}, "):
        told_by(out, out / "runs", without=["nowhere"])
    with pytest.raises(ConfigError, match="every run is on a region that is left out"):
        told_by(out, out / "runs", without=TOWNS)
    submission(out, tmp_path / "mine.parquet")
    with pytest.raises(ConfigError, match=r"mine.parquet is a file of predictions, of which no region can be left out"):
        told_by(out, tmp_path / "mine.parquet", without=TOWNS[:1])


def test_two_files_of_one_name_are_refused(out, tmp_path):
    for name in ("a", "b"):
        (tmp_path / name).mkdir()
        submission(out, tmp_path / name / "mine.parquet")
    with pytest.raises(ConfigError, match="name the file by letters"):
        find_entries([shutil.copy(tmp_path / "a" / "mine.parquet", tmp_path / "a|b.parquet")])
    with pytest.raises(ConfigError, match="two entries are named 'mine'"):
        find_entries([tmp_path / "a" / "mine.parquet", tmp_path / "b" / "mine.parquet"])


@pytest.mark.parametrize("name", ["oracle_pose", "prior_centre", "random"])
def test_a_file_may_not_pass_for_a_control(out, tmp_path, name):
    submission(out, tmp_path / f"{name}.parquet")
    with pytest.raises(ConfigError, match=f"'{name}' is the name of a control of every board: choose another name"):
        find_entries([tmp_path / f"{name}.parquet"])


def test_answers_without_their_run_are_named_and_cost_themselves_alone(out, tmp_path):
    run = next((out / "runs").rglob("run.json"))
    run.unlink()
    with pytest.raises(StoreError, match=r"holds answers and no run.json: run the matcher again, they are kept"):
        find_entries([out / "runs"])
    lines = []
    failures = Failures(tmp_path / "failures.log")
    with reporting(lines.append):
        (entry,) = find_entries([out / "runs"], failures=failures)
    assert (entry.name, len(entry.sources)) == ("oracle_pose", len(TOWNS) - 1)
    assert str(run.parent) in lines[0]


def test_what_is_named_twice_counts_once(out, tmp_path):
    submission(out, tmp_path / "mine.parquet")
    file, runs = tmp_path / "mine.parquet", out / "runs"
    (tmp_path / "again").symlink_to(runs)
    entries = find_entries([runs, file, runs / "oracle_pose", file, tmp_path / "again"])
    assert [(entry.name, len(entry.sources)) for entry in entries] == [("mine", 1), ("oracle_pose", len(TOWNS))]


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"matcher": None}, "matcher.name is None"),
        ({"matcher": {"name": "a|b", "version": "1"}}, r"name 'a\|b' may hold lower-case letters"),
        ({"matcher": {"name": "../../x", "version": "1"}}, "may hold lower-case letters"),
        ({"matcher": {"name": "x", "version": 1}}, "matcher.version is 1"),
        ({"spec": "mine:Cheat"}, "it has the name of the control oracle_pose, and was run as 'mine:Cheat'"),
        ({"hash": ["x"]}, r"hash is \['x'\]"),
        ({"suite": None}, "suite is None"),
        ({"region": ""}, "region is ''"),
        ({"queries_sha256": {}}, "queries_sha256 is {}"),
        ({"cpu_s": "long"}, "cpu_s of a run is 'long', expected a number"),
        ({"cpu_s": 1e308}, r"cpu_s of a run is 1e\+308, expected a number from 0 to 1e\+18"),
        ({"index_bytes": 10**30}, "index_bytes of a run is 10*, expected a number from 0 to"),
        ({"isolation": {"truth": 1}}, "isolation.truth is 1: Input should be a valid string"),
        ({"isolation": ["x"]}, r"isolation is \['x'\]: Input should be a valid dictionary"),
        ({"matcher": {"name": "x", "version": "1", "title": [1]}}, r"matcher.title is \[1\]: Input should be"),
        (
            {"matcher": {"name": "x", "version": "1", "tracks": "x"}},
            "matcher.tracks is 'x': Input should be a valid list",
        ),
        ({"learned": {"key": "x"}}, r"learned is \{'key': 'x'\}, expected key, file, trained_on and pairs"),
        ({"learned": {"key": "x", "trained_on": [], "pairs": 1}}, "expected key, file, trained_on and pairs"),
    ],
)
def test_a_run_that_does_not_say_whose_it_is_gets_one_line(out, changes, words):
    path = next((out / "runs").rglob("run.json"))
    edit_json(path, **changes)
    with pytest.raises(StoreError, match=rf"run\.json is damaged \(.*{words}.*\): remove it and run again"):
        board_of(out)
    assert not (out / "boards").exists()


@pytest.mark.parametrize("place", ["before", "zz"])
def test_of_several_runs_of_a_task_those_of_its_queries_count_in_either_order(out, tmp_path, place):
    """Shards of two machines are two runs of one task; what answers older queries is left out wherever it stands."""
    stale = Path(shutil.copytree(out / "runs", tmp_path / place))
    for path in stale.rglob("run.json"):
        edit_json(path, queries_sha256="0" * 64)
    for path in stale.rglob("part-*.parquet"):
        table = pq.read_table(path)
        asked = pa.array(["0" * 64] * len(table))
        pq.write_table(table.set_column(table.column_names.index("asked_sha256"), "asked_sha256", asked), path)
    both = [stale, out / "runs"] if place == "before" else [out / "runs", stale]
    board, lines = told_by(out, *both)
    assert lines[0].startswith(f"left out: {len(TOWNS)} runs without an answer to these queries ({stale}")
    assert primary(board, "oracle_pose")["value"] == 1.0
    assert len(board.entries[0].runs) == len(TOWNS)


def test_the_program_prints_the_board_and_where_it_is(out, monkeypatch, capsys):
    words = ("score", "--predictions", str(out / "runs"), "--out", str(out), "--name", "mine", "--draws", "200")
    monkeypatch.setattr("sys.argv", ["sasgeo-bench", *words])
    with pytest.raises(SystemExit) as left:
        cli.main()
    assert left.value.code == 0
    printed = capsys.readouterr()
    assert printed.out.splitlines()[-1] == str(out / "boards" / "mine")
    assert re.search(r"oracle_pose  1\.000 \[0\.\d\d, 1\.00\] \(control\)", printed.out)
    assert "fewer than 36 in 12" in printed.err
    assert sorted(path.name for path in Path(printed.out.splitlines()[-1]).iterdir()) == [
        "acceptance.parquet",
        "board.json",
        "contrasts.parquet",
        "controls.parquet",
        "falsifiers.parquet",
        "leaderboard.csv",
        "leaderboard.md",
        "leaderboard.parquet",
        "leaderboard.tex",
        "pictures",
        "scores.parquet",
    ]


def test_a_board_may_not_be_named_like_a_path(out, monkeypatch, capsys):
    monkeypatch.setattr("sys.argv", ["sasgeo-bench", "score", "--predictions", str(out / "runs"), "--name", "../x"])
    with pytest.raises(SystemExit) as left:
        cli.main()
    assert left.value.code == 2
    assert "--name must hold letters" in capsys.readouterr().err


@pytest.mark.usefixtures("undrawn")
def test_a_control_that_fails_is_told_first_and_ends_with_its_own_status(out, monkeypatch, capsys):
    verdict = Verdict(
        control="shuffled map at chance", matcher="random", n=8, found=8.0, expected=0.8, p=1e-8, holds=False
    )
    monkeypatch.setattr(boards, "evaluate_controls", lambda _: (verdict,))
    words = ("score", "--predictions", str(out / "runs"), "--out", str(out), "--name", "mine", "--draws", "200")
    monkeypatch.setattr("sys.argv", ["sasgeo-bench", *words])
    with pytest.raises(SystemExit) as left:
        cli.main()
    assert left.value.code == 3
    printed = capsys.readouterr()
    assert "CONTROLS FAILED, 1 of 1: do not trust this board." in printed.err
    assert verdict.to_text() in printed.err
    assert printed.out.splitlines()[-1] == str(out / "boards" / "mine")  # written all the same
    text = (out / "boards" / "mine" / "leaderboard.md").read_text(encoding="utf-8")
    assert text.index("CONTROLS FAILED") < text.index("## ")


@pytest.mark.usefixtures("undrawn")
def test_a_rival_that_knows_too_much_is_set_apart_and_the_board_stands(out, tmp_path, monkeypatch, program):
    submission(out, tmp_path / "mine.parquet")
    chance = {"n": 8, "found": 8.0, "expected": 0.8, "p": 1e-8}
    failed = Verdict(control="shuffled map at chance", matcher="mine", holds=False, **chance)
    monkeypatch.setattr(boards, "evaluate_controls", lambda _: (failed, replace(failed, matcher="random", holds=True)))
    given = ("--predictions", out / "runs", "--predictions", tmp_path / "mine.parquet")
    code, _, err = program("score", *given, "--out", out, "--name", "both", "--draws", "200", "--no-cases")
    assert code == CONTESTANT_FAILED
    assert "Controls: 1 of 2 held. Do not trust the rows of mine:" in err
    why = 'right 8 of 8 times at the control "shuffled map at chance", where guessing is right 0.8 times'
    assert f"mine: set apart, {why}" in err
    about, table = read_board_manifest(out / "boards" / "both"), read_leaderboard(out / "boards" / "both")
    mine, oracle = about.entries
    assert mine.set_apart == why
    assert mine.failed_controls == [failed.to_text()]
    assert not oracle.failed_controls
    assert table.loc[table["matcher"] == "mine", "rank_best"].isna().all()
    text = (out / "boards" / "both" / "leaderboard.md").read_text(encoding="utf-8")
    assert "do not trust this board" not in text
    assert "mine is set apart: right 8 of 8 times" in text
    marks = [mark.text for mark in marks_of(mine, is_control=False)]
    assert marks == ["as submitted", "failed a control", "set apart"]


# --- one contestant that fails ----------------------------------------------------------------------------------------


class Picky(Doubt):
    """Cannot be fitted on answers that say too little; all of those of some are."""

    card = replace(Doubt.card, name="picky")

    def fit(self, predictions, is_false):
        super().fit(predictions, is_false)
        assert all("told" in item.diagnostics for item in predictions)


def rewrite(path, column, value):
    """Put a value into the first row of a file of predictions, as its author may."""
    table = pq.read_table(path)
    rows = table.to_pylist()
    rows[0][column] = value
    pq.write_table(pa.Table.from_pylist(rows, schema=table.schema), path)


@pytest.fixture
def both(out, tmp_path):
    """A good file beside a bad one; a contrast of the two."""
    for name, each in (("good", 1.0), ("bad", 2.0)):
        told_of = {"told": each}
        submission(out, tmp_path / f"{name}.parquet", change=lambda row, _, of=told_of: replace(row, diagnostics=of))
    return [tmp_path / "good.parquet", tmp_path / "bad.parquet"]


@pytest.fixture(scope="module")
def alone(built, tmp_path_factory):
    """The board of the good file alone."""
    folder = tmp_path_factory.mktemp("alone")
    submission(built, folder / "good.parquet", change=lambda row, _: replace(row, diagnostics={"told": 1.0}))
    return board_of(built, folder / "good.parquet", board=folder / "board")


CONTRAST = Contrast(name="which", first="good", second="bad", suites=("clean",))


FAULTS = [
    ("diagnostics", [("a", 1.0), ("a", 2.0)], "'a' twice"),
    ("query_id", "0" * 24, "the id of a query"),
    ("latency_s", math.inf, "latency_s is inf"),
    ("candidates", None, "found null"),
    ("message", "x" * 1_000, "a line of at most 300"),
    ("candidates", [{"easting_m": 0.0, "northing_m": 0.0, "yaw_deg": 1e300, "scale": 1.0, "score": 0.0}], r"1e\+300"),
]


@pytest.mark.parametrize(("column", "value", "why"), FAULTS)
def test_answers_that_are_none_are_refused_by_themselves(out, both, column, value, why):
    rewrite(both[1], column, value)
    with pytest.raises((ConfigError, StoreError), match=why):
        board_of(out, both[1])


@pytest.mark.parametrize(("column", "value", "why"), FAULTS[:2])  # found as a file is read, and as it is validated
def test_answers_that_are_none_cost_their_author_alone(out, both, alone, column, value, why):
    rewrite(both[1], column, value)
    board = board_of(out, *both, has_texts=True, contrasts=[CONTRAST])
    assert [entry.name for entry in board.board.about.entries] == ["good"]
    pd.testing.assert_frame_equal(board.scores["good"], alone.scores["good"])
    pd.testing.assert_frame_equal(board.board.leaderboard, alone.board.leaderboard)
    assert why in board.failures.found["bad"]
    assert [finding.verdict for finding in board.board.findings] == ["not decided: bad failed"]
    about = read_board_manifest(out / "boards" / "mine")
    assert about.failed == board.failures.found
    text = (out / "boards" / "mine" / "leaderboard.md").read_text(encoding="utf-8")
    assert "- Failed, and not on this board: bad: " in text


def test_shards_of_a_run_in_several_folders_are_one_run(out, tmp_path):
    whole = board_of(out)
    for number, keep in enumerate((lambda at: at % 2 == 0, lambda at: at % 2 == 1)):
        for path in sorted((out / "runs").rglob("run.json")):
            shard = tmp_path / f"shard{number}" / path.parent.relative_to(out / "runs")
            rows = list(prediction_files.read_predictions(path.parent))
            asked = task_files.Task.open(out / "tasks" / shard.parent.name / shard.name).asked
            prediction_files.write_part(shard, [row for at, row in enumerate(rows) if keep(at)], asked=asked)
            shutil.copyfile(path, shard / "run.json")
    board = board_of(out, tmp_path / "shard0", tmp_path / "shard1")
    pd.testing.assert_frame_equal(board.scores["oracle_pose"], whole.scores["oracle_pose"])
    assert (board.scores["oracle_pose"]["status"] == "ok").all()
    assert len(board.predictions["oracle_pose"]) == len(whole.predictions["oracle_pose"])


def test_a_file_without_a_row_misses_everything_and_costs_nobody_else(out, both, alone, tmp_path):
    empty = pq.read_table(both[0]).slice(0, 0)
    pq.write_table(empty.set_column(0, "query_id", pa.array([], pa.string())), tmp_path / "empty.parquet")
    board = board_of(out, both[0], tmp_path / "empty.parquet")
    assert board.failures.found == {}
    assert set(board.scores["empty"]["status"]) == {"missing"}
    pd.testing.assert_frame_equal(board.scores["good"], alone.scores["good"])


@pytest.mark.slow
def test_answers_that_find_no_room_in_memory_are_read_again_and_score_alike(out, both, split, monkeypatch):
    asked = {"split": split, "rejectors": (f"{__name__}:Doubt",)}
    whole = board_of(out, out / "runs", *both, **asked)
    monkeypatch.setattr(entries, "_MOST_KEPT_BYTES", 0)
    board = board_of(out, out / "runs", *both, **asked)
    pd.testing.assert_frame_equal(board.board.leaderboard, whole.board.leaderboard)
    pd.testing.assert_frame_equal(board.judged["good", "doubt"], whole.judged["good", "doubt"])
    assert dict(board.predictions["oracle_pose"]) == dict(whole.predictions["oracle_pose"])


def fails_with(monkeypatch, name, is_bad):
    """A mistake of ours that only what one contestant says brings about."""
    room = {"scored": entries._Asked, "evaluate_controls": entries, "leaderboard": tables}.get(name, boards)
    work = getattr(room, name)

    def broken(*words, **more):
        if is_bad(*words, **more):
            raise KeyError("a mistake of ours")
        return work(*words, **more)

    monkeypatch.setattr(room, name, broken)


@pytest.mark.parametrize(
    ("step", "is_bad"),
    [
        ("scored", lambda _, answers: any(row.diagnostics["told"] == 2.0 for row in answers.found.values())),
        ("evaluate_controls", lambda scored: "bad" in scored),
        ("leaderboard", lambda scores, **_: "bad" in scores),
    ],
)
def test_a_mistake_of_ours_costs_the_contestant_it_is_about_and_the_log_says_where(
    out, both, alone, monkeypatch, step, is_bad
):
    fails_with(monkeypatch, step, is_bad)
    board = board_of(out, *both, contrasts=[CONTRAST])
    assert board.failures.found == {"bad": "KeyError: 'a mistake of ours' (mine.failures.log says where)"}
    pd.testing.assert_frame_equal(board.board.leaderboard, alone.board.leaderboard)
    assert [finding.verdict for finding in board.board.findings] == ["not decided: bad failed"]
    log = (out / "boards" / "mine.failures.log").read_text(encoding="utf-8")
    assert "Traceback" in log
    assert "in broken" in log


@pytest.mark.parametrize(
    ("step", "is_bad", "what"),
    [
        ("cost_figures", lambda name, *_, **__: name == "bad", "costs of bad"),
        ("protection_frame", lambda name, *_: name == "bad", "protection levels of bad"),
    ],
)
def test_a_figure_that_cannot_be_made_is_left_out_and_said(out, both, monkeypatch, step, is_bad, what):
    fails_with(monkeypatch, step, is_bad)
    board = board_of(out, *both)
    assert list(board.failures.found) == [what]
    assert set(board.board.leaderboard["matcher"]) == {"good", "bad"}


def test_a_figure_that_cannot_be_drawn_leaves_the_others(out, both):
    def drawn(path):
        path.write_text("<svg/>", encoding="utf-8")

    def broken(path):
        drawn(path)
        raise ValueError(path.name)

    board = board_of(out, *both, extras=[lambda _: AdditionalFiles(figures={"age.svg": drawn, "risk.svg": broken})])
    assert list(board.failures.found) == ["figure risk.svg"]
    assert [path.name for path in (out / "boards" / "mine" / "figures").iterdir()] == ["age.svg"]
    assert list(read_board_manifest(out / "boards" / "mine").failed) == ["figure risk.svg"]


def test_a_rejector_that_fails_with_one_judges_the_others(out, both, split):
    submission(out, both[1])  # says nothing beside its answers
    contrast = replace(CONTRAST, first="good x picky", second="bad x picky", metric="aurc")
    asked = {"split": split, "rejectors": (f"{__name__}:Picky", f"{__name__}:Doubt"), "contrasts": [contrast]}
    board = board_of(out, *both, **asked)
    assert set(board.judged) == {
        ("good", "own"),
        ("bad", "own"),
        ("good", "picky"),
        ("good", "doubt"),
        ("bad", "doubt"),
    }
    assert list(board.failures.found) == ["bad x picky"]
    assert [finding.verdict for finding in board.board.findings] == ["not decided: bad x picky failed"]
    with pytest.raises(MatchError, match="rejector 'picky' failed"):
        board_of(out, both[1], **asked | {"contrasts": []})


@pytest.mark.usefixtures("undrawn")
def test_the_program_says_who_failed_and_ends_with_a_status_of_its_own(out, both, program):
    rewrite(both[1], "latency_s", math.inf)
    words = ("--out", out, "--name", "mine", "--draws", "200", "--no-cases")
    code, printed, err = program("score", *(word for path in both for word in ("--predictions", path)), *words)
    assert code == CONTESTANT_FAILED
    assert printed.splitlines()[-1] == str(out / "boards" / "mine")
    assert "Traceback" not in err
    (line,) = [line for line in err.splitlines() if line.startswith("failed, and so not on the board: bad: ")]
    assert "latency_s is inf" in line


def test_a_disk_that_is_full_stops_everything(out, both, monkeypatch):
    def full(*_, **__):
        raise StoreError("cannot be written") from OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(entries._Asked, "scored", full)
    with pytest.raises(StoreError, match="cannot be written"):
        board_of(out, *both)
    assert not (out / "boards" / "mine").exists()
