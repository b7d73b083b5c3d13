# SPDX-License-Identifier: Apache-2.0
"""Submissions: what `submit` writes `validate` accepts; nothing that a stranger puts there is believed or runs away."""

import json
import os
import shutil
from pathlib import Path

import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from sasgeo_bench.boards.archive import laid_tasks, pack_board
from sasgeo_bench.boards.archive_file import read_pack
from sasgeo_bench.boards.board_files import read_board_manifest, read_leaderboard
from sasgeo_bench.boards.build import make_board
from sasgeo_bench.boards.manifests import PipelineRecord
from sasgeo_bench.boards.scored import ScoreRequest
from sasgeo_bench.cli.console import CONTESTANT_FAILED
from sasgeo_bench.cli.publishing import publish
from sasgeo_bench.core.config import parse_toml
from sasgeo_bench.core.errors import ConfigError, StoreError
from sasgeo_bench.core.folders import file_record
from sasgeo_bench.core.progress import reporting
from sasgeo_bench.exchange.submissions import (
    SubmitRequest,
    make_submission,
    submissions_for,
    with_submissions,
)
from sasgeo_bench.matching.submission import Card, example_card
from sasgeo_bench.running.failures import Failures
from sasgeo_bench.running.oracle import right_answer
from sasgeo_bench.running.plan import RunRequest, plan_run
from sasgeo_bench.running.prediction_files import PREDICTION_SCHEMA, prediction_row
from sasgeo_bench.running.runner import run
from sasgeo_bench.scoring.entries import check_submitted, find_entries
from sasgeo_bench.scoring.submission_files import read_submission
from sasgeo_bench.tasks import task_files
from sasgeo_bench.tasks.split import find_split
from tests.threaded import threaded

pytestmark = pytest.mark.usefixtures("without_drawings")

CARD = {
    "name": "mine",
    "version": "1",
    "title": "Mine",
    "source": "original",
    "ours": "all",
    "licence": "MIT",
    "trained_on": "none",
}
A_POSE = {"easting_m": 1.0, "northing_m": 1.0, "yaw_deg": 0.0, "scale": 1.0, "score": 0.0}
SUITES = ("clean", "absent")
ROOT = Path(__file__).parents[2]


def silent(line):
    del line


@pytest.fixture(scope="module")
def stored(tasks, tmp_path_factory):
    """Stored results of a board with one matcher on two suites of one town, and the root that they were made in."""
    out = tmp_path_factory.mktemp("submissions") / "out"
    shutil.copytree(tasks, out, symlinks=True)
    asked = [out / "tasks" / suite / "town-riverside" for suite in SUITES]
    with threaded():
        run(plan_run(RunRequest(spec="prior_centre", tasks=asked, out=out)))
    request = ScoreRequest(
        predictions=[out / "runs"],
        tasks=asked,
        root=out,
        board=out / "boards" / "kept",
        split=find_split("crossfit"),
        draws=100,
        pipeline=PipelineRecord(id="kept", sha256="0"),
    )
    pack_board(make_board(request), request, out.parent / "kept")
    return out.parent / "kept"


@pytest.fixture(scope="module")
def right(stored):
    """Right answers to every query of the board."""
    out, rows = stored.parent / "out", []
    for suite in SUITES:
        truths = {item.query_id: item for item in task_files.read_truths(out / "truth" / suite / "town-riverside")}
        queries = task_files.read_queries(out / "tasks" / suite / "town-riverside")
        rows += [right_answer(query, truths[query.query_id]) for query in queries]
    return rows


def write_rows(path, rows):
    pq.write_table(pa.Table.from_pylist(rows, schema=PREDICTION_SCHEMA), path)
    return path


def write_card(path, **changes):
    values = {**CARD, **changes}
    lines = [f"{name} = {json.dumps(value, ensure_ascii=False)}" for name, value in values.items() if value is not None]
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")
    return path


@pytest.fixture
def rows(right):
    return [prediction_row(item) for item in right]


@pytest.fixture
def files(tmp_path, rows):
    """A file of predictions and a card, as flags of `submit`."""
    return {"predictions": write_rows(tmp_path / "mine.parquet", rows), "card": write_card(tmp_path / "card.toml")}


@pytest.fixture(scope="module")
def made(stored, right, tmp_path_factory):
    """A sound submission; copy it before you spoil it."""
    folder = tmp_path_factory.mktemp("made")
    path = write_rows(folder / "mine.parquet", [prediction_row(item) for item in right])
    card = write_card(folder / "card.toml")
    into = folder / "submissions" / "mine"
    return make_submission(SubmitRequest(predictions=path, card=card, board=stored, into=into))


@pytest.fixture
def copied(made, tmp_path):
    return shutil.copytree(made, tmp_path / "submissions" / "mine")


def flags(files, stored):
    return ["submit", "--predictions", files["predictions"], "--card", files["card"], "--for", stored]


def change_said(folder, change):
    """Change what `submission.json` says."""
    path = folder / "submission.json"
    record = json.loads(path.read_text(encoding="utf-8"))
    change(record)
    path.write_text(json.dumps(record), encoding="utf-8")


def put_table(folder, table, **options):
    """Other predictions, with the hash that fits them."""
    path = folder / "predictions" / "mine.parquet"
    pq.write_table(table, path, **options)
    record = file_record(path).model_dump()
    change_said(folder, lambda said: said.update(files={"predictions/mine.parquet": record}))


# --- making one -------------------------------------------------------------------------------------------------------


def test_what_submit_writes_validate_accepts(stored, files, program):
    code, out, err = program(*flags(files, stored))
    assert (code, out) == (0, "submissions/kept/mine\n"), err
    assert "the suite 'controls' is not answered" in err
    code, out, err = program("verify", "submissions/kept/mine", "--for", stored)
    assert code == 0, err
    assert out == "submissions/kept/mine: a sound submission of mine 1 to kept, 2 tasks\n"
    code, out, _ = program("verify", "submissions/kept/mine")
    assert code == 0
    assert "its rows were held against no queries" in out


def test_a_submission_says_versions_tasks_and_hashes_and_is_the_same_bytes_again(stored, files, made, tmp_path):
    into = tmp_path / "again" / "mine"
    make_submission(SubmitRequest(**files, board=stored, into=into))
    for name in ("submission.json", "predictions/mine.parquet"):
        assert (into / name).read_bytes() == (made / name).read_bytes(), name
    record = json.loads((into / "submission.json").read_text(encoding="utf-8"))
    assert record["board"] == "kept"
    assert {"task_version", "data_version", "scorer_version", "made_by"} <= set(record)
    assert {(task["suite"], task["answered"] == task["queries"]) for task in record["tasks"]} == {
        ("absent", True),
        ("clean", True),
    }
    assert record["files"]["predictions/mine.parquet"] == file_record(into / "predictions/mine.parquet").model_dump()
    assert record["attribution"].startswith("(c) OpenStreetMap contributors")


def test_queries_without_a_row_are_misses_and_a_suite_without_any_is_not_asked(stored, files, rows, program):
    clean = set(task_files.Task.open(stored.parent / "out" / "tasks" / "clean" / "town-riverside").ids())
    write_rows(files["predictions"], [row for row in rows if row["query_id"] in clean][:-3])
    code, _, err = program(*flags(files, stored))
    assert code == 0, err
    assert "3 have none and count as misses" in err
    code, out, _ = program("verify", "submissions/kept/mine", "--for", stored)
    assert code == 0
    assert "1 task, 3 queries without a row count as misses" in out


def test_the_runs_of_a_matcher_can_be_submitted_under_its_own_name_and_version(stored, tmp_path):
    runs = stored.parent / "out" / "runs" / "prior_centre"
    card = write_card(tmp_path / "card.toml")
    with pytest.raises(ConfigError, match=r"the card is of 'mine' 1, .* holds runs of 'prior_centre' \d+: make them"):
        make_submission(SubmitRequest(predictions=runs, card=card, board=stored))
    mine = shutil.copytree(runs, tmp_path / "runs")
    for path in mine.rglob("run.json"):
        about = json.loads(path.read_text(encoding="utf-8"))
        about["matcher"] |= {"name": "mine", "version": "1"}
        path.write_text(json.dumps(about), encoding="utf-8")
    into = tmp_path / "submissions" / "mine"
    folder = make_submission(SubmitRequest(predictions=mine, card=card, board=stored, into=into))
    assert all(task.answered == task.queries for task in read_submission(folder).tasks)


def test_what_a_runner_has_taught_must_stand_on_the_card(stored, tmp_path):
    mine = shutil.copytree(stored.parent / "out" / "runs" / "prior_centre", tmp_path / "runs")
    for path in mine.rglob("run.json"):
        about = json.loads(path.read_text(encoding="utf-8"))
        about["matcher"] |= {"name": "mine", "version": "1"}
        about["learned"] = {"key": "k", "file": None, "trained_on": ["munich"], "pairs": 3}
        path.write_text(json.dumps(about), encoding="utf-8")
    card = write_card(tmp_path / "card.toml", trained_on=["porto"])
    with pytest.raises(ConfigError, match=r"trained on munich, which trained_on of the card does not name for half a"):
        make_submission(SubmitRequest(predictions=mine, card=card, board=stored))


@pytest.mark.parametrize(
    ("changes", "fault"),
    [
        ({"name": "prior_centre"}, "'prior_centre' is the name of a control of every board"),
        ({"name": "sasgeo"}, "'sasgeo' is the name of a matcher that ships"),
        ({"name": "oracle_mine"}, "'oracle_mine' is the name of a control of every board"),
        ({"name": "../mine"}, "'name'"),
        ({"name": "Mine"}, "'name'"),
        ({"name": "-rf"}, "'name'"),
        ({"name": ""}, "'name'"),
        ({"name": "m" * 61}, "'name'"),
        ({"titel": "Mine"}, "unknown key 'titel', did you mean 'title'?"),
        ({"title": None}, "'title' is missing"),
        ({"title": "two\nlines"}, "must be one line of printable characters"),
        ({"title": "turned \u202e round"}, "must be one line of printable characters"),
        ({"title": "m" * 301}, "'title'"),
        ({"version": 1}, "'version'"),
        ({"code": "javascript:alert(1)"}, "'code'"),
        ({"needs": ["luck"]}, "'needs.0'"),
        ({"trained_on": None}, "'trained_on' is missing"),
        ({"trained_on": []}, 'trained_on must be "none", places of the split'),
        ({"trained_on": "porto"}, 'trained_on must be "none", places of the split'),
        ({"trained_on": ["muenich"]}, "trained_on names 'muenich', did you mean 'munich'?"),
        ({"trained_on": ["vaduz"]}, "trained_on names 'vaduz', a region of the place 'liechtenstein'"),
        ({"trained_on": ["zurich"]}, "what is no place of the split goes into trained_elsewhere"),
    ],
)
def test_a_card_that_does_not_say_what_it_must_is_refused(stored, files, mistake, tmp_path, changes, fault):
    write_card(files["card"], **changes)
    assert fault in mistake(*flags(files, stored))
    assert not (tmp_path / "submissions").exists()


def test_a_name_that_is_on_the_board_is_refused(stored, files, mistake, monkeypatch):
    monkeypatch.setattr("sasgeo_bench.scoring.entries.is_unranked", lambda _: False)
    write_card(files["card"], name="prior_centre")
    assert "'prior_centre' is the name of another entry of the board: choose another" in mistake(*flags(files, stored))


@pytest.mark.parametrize(
    ("text", "fault"),
    [
        (b"name = [", "not valid TOML"),
        (b"\xff\xfe\x00", "it is no UTF-8: write a card there, or name one"),
        (b"# " + b"x" * 200_000, "has more than 100000 bytes"),
    ],
)
def test_a_file_that_is_no_card_is_refused(stored, files, mistake, text, fault):
    files["card"].write_bytes(text)
    assert fault.partition(":")[0] in mistake(*flags(files, stored))
    assert "cannot be read (No such file" in mistake(*flags(files | {"card": "nowhere.toml"}, stored))


def moved(metres):
    def change(row):
        for item in row["candidates"]:
            item["easting_m"] += metres

    return change


@pytest.mark.parametrize(
    ("change", "fault"),
    [
        (lambda row: row.update(confidence=1.5), "confidence: found confidence is 1.5, expected 0..1"),
        (lambda row: row.update(confidence=float("nan")), "confidence is nan"),
        (moved(5000.0), "outside of town-riverside, expected eastings of"),
        (lambda row: row.update(query_id="0" * 24), "expected the id of a query of the tasks"),
        (lambda row: row.update(status="fine"), "status: found 'fine'"),
        (lambda row: row["candidates"][0].update(score=float("inf")), "score is inf"),
    ],
)
def test_predictions_with_faults_are_not_submitted(stored, files, rows, mistake, tmp_path, change, fault):
    out = stored.parent / "out"
    queries = task_files.read_queries(out / "tasks" / "clean" / "town-riverside")
    name = next(query.query_id for query in queries if query.track == "localization" and query.prior.radius_m)
    change(next(row for row in rows if row["query_id"] == name))
    write_rows(files["predictions"], rows)
    line = mistake(*flags(files, stored))
    assert fault in line
    assert "holds 1 fault" in line
    assert not (tmp_path / "submissions").exists()


def test_a_query_that_is_answered_twice_is_not_submitted(stored, files, rows, mistake):
    write_rows(files["predictions"], [*rows, rows[0]])
    assert "expected each query once" in mistake(*flags(files, stored))


def test_answers_to_other_queries_are_not_submitted(stored, files, mistake):
    write_rows(files["predictions"], [])
    assert "holds no answer to the queries of this board" in mistake(*flags(files, stored))
    assert "holds no stored results: name those of the board" in mistake(*flags(files, stored.parent / "out"))


def test_a_folder_of_something_else_is_not_replaced_and_the_name_is_the_cards(stored, files, mistake, tmp_path):
    (tmp_path / "elsewhere" / "mine").mkdir(parents=True)
    (tmp_path / "elsewhere" / "mine" / "notes.txt").write_text("mine", encoding="utf-8")
    words = [*flags(files, stored), "--into"]
    assert "holds something else than a submission" in mistake(*words, tmp_path / "elsewhere" / "mine")
    assert (tmp_path / "elsewhere" / "mine" / "notes.txt").read_text(encoding="utf-8") == "mine"
    assert "must be named as the card is, 'mine'" in mistake(*words, tmp_path / "elsewhere" / "other")


def test_a_submission_with_files_of_ones_own_is_not_replaced(stored, files, program, mistake, tmp_path):
    words, mine = [*flags(files, stored), "--into"], tmp_path / "sent" / "mine"
    assert program(*words, mine)[0] == 0
    assert program(*words, mine)[0] == 0  # a submission alone is replaced
    (mine / "method.py").write_text("years of work", encoding="utf-8")
    assert "1 file (method.py) that would be lost and are not part of a submission" in mistake(*words, mine)
    (mine / "method.py").unlink()
    (mine / "submission.json").write_text('{"of": "another program"}', encoding="utf-8")
    assert "holds something else than a submission" in mistake(*words, mine)
    (tmp_path / "link").mkdir()
    (tmp_path / "link" / "mine").symlink_to(mine)
    assert "holds something else than a submission" in mistake(*words, tmp_path / "link" / "mine")


def test_submit_says_what_it_lacks_and_prints_a_card_that_is_one(program, mistake):
    assert mistake("submit", "--card", "card.toml").startswith("sasgeo-bench: submit needs --predictions and --for")
    code, out, _ = program("submit", "--example-card")
    assert code == 0
    assert out == example_card()
    assert parse_toml(out, Card, source="card.toml").places == ()


# --- one of a stranger ------------------------------------------------------------------------------------------------


def spoil_bytes(folder):
    path = folder / "predictions" / "mine.parquet"
    path.write_bytes(path.read_bytes()[:-9] + b"123456789")


def truncate(folder):
    path = folder / "predictions" / "mine.parquet"
    path.write_bytes(path.read_bytes()[:500])
    change_said(folder, lambda said: said["files"].update({"predictions/mine.parquet": file_record(path).model_dump()}))


def link_table(folder):
    path = folder / "predictions" / "mine.parquet"
    path.rename(folder.parents[1] / "kept.parquet")
    path.symlink_to(folder.parents[1] / "kept.parquet")


def make_pipe(folder):
    (folder / "submission.json").unlink()
    os.mkfifo(folder / "submission.json")  # whoever opens it waits for ever


def many_rows(folder):
    table = pq.read_table(folder / "predictions" / "mine.parquet")
    empty = pa.table({field.name: pa.nulls(1_000_001, field.type) for field in table.schema}, schema=table.schema)
    put_table(folder, empty, compression="zstd")


def long_text(folder):
    table = pq.read_table(folder / "predictions" / "mine.parquet")
    texts = pa.array(["x" * 3_000_000] * len(table), pa.string())
    put_table(folder, table.set_column(table.schema.get_field_index("message"), "message", texts), compression="zstd")


def long_lists(folder):
    change_rows(folder, lambda rows: [row.update(candidates=[A_POSE] * 30_000) for row in rows[:3]])


def more_columns(folder):
    table = pq.read_table(folder / "predictions" / "mine.parquet")
    put_table(folder, table.append_column("note", pa.nulls(len(table), pa.string())))


def rename_folder(folder):
    folder.rename(folder.with_name("yours"))
    shutil.copytree(folder.with_name("yours"), folder)
    change_said(folder, lambda said: said["card"].update(name="yours"))


@pytest.mark.parametrize(
    ("spoil", "fault"),
    [
        (spoil_bytes, "is not what submission.json says"),
        (truncate, "cannot be read"),
        (link_table, "mine.parquet is a link, or no plain file: a submission holds files alone"),
        (make_pipe, "submission.json is a link, or no plain file"),
        (many_rows, "holds 1000001 rows, 1000000 at most"),
        (long_text, "bytes of texts in message, "),
        (long_lists, "row 0, is no prediction (candidates: found 30000 items, expected at most 1000): submit again"),
        (more_columns, "(note is not as it must be)"),
        (rename_folder, "holds the submission 'yours': name the folder so"),
        (lambda at: (at / "run.sh").write_text("true", encoding="utf-8"), "run.sh is no part of a submission"),
        (lambda at: (at / "predictions" / "mine.parquet").unlink(), "mine.parquet is missing"),
        (lambda at: os.truncate(at / "predictions" / "mine.parquet", 30_000_000), "has 30.0 MB, 20 MB at most"),
        (lambda at: (at / "submission.json").write_text("[" * 100_000, encoding="utf-8"), "is nested too deep"),
        (lambda at: (at / "submission.json").write_text("[1]", encoding="utf-8"), "states no schema version"),
        (lambda at: os.truncate(at / "submission.json", 6_000_000), "has more than 5000000 bytes"),
        (lambda at: change_said(at, lambda said: said.update(schema_version=2)), "has schema version 2"),
        (lambda at: change_said(at, lambda said: said.pop("card")), "'card' is missing"),
        (lambda at: change_said(at, lambda said: said.update(rank=1)), "unknown key 'rank'"),
        (lambda at: change_said(at, lambda said: said["card"].update(rank=1)), "unknown key 'card.rank'"),
        (lambda at: change_said(at, lambda said: said["card"].update(title="a\nb")), "one line of printable"),
        (
            lambda at: change_said(at, lambda said: said.update(files={"../../x": said["files"].popitem()[1]})),
            "../../x",
        ),
    ],
)
def test_a_folder_that_is_not_what_it_says_is_refused(copied, stored, mistake, tmp_path, spoil, fault):
    spoil(copied)
    line = mistake("verify", copied, "--for", stored)
    assert fault in line
    failures = Failures(tmp_path / "log")
    assert find_entries([], [copied], failures=failures) == ()
    assert fault in str(failures.first) or fault.startswith("holds the submission")


def change_rows(folder, change):
    table = pq.read_table(folder / "predictions" / "mine.parquet")
    rows = table.to_pylist()
    change(rows)
    put_table(folder, pa.Table.from_pylist(rows, schema=table.schema))


def state_task(**fields):
    return lambda folder: change_said(folder, lambda said: said["tasks"][0].update(fields))


@pytest.mark.parametrize(
    ("spoil", "fault"),
    [
        (lambda at: change_said(at, lambda said: said.update(task_version=99)), "task_version: found 99, expected"),
        (lambda at: change_said(at, lambda said: said["card"].update(trained_on=["mars"])), "trained_on: found 'mars'"),
        (
            lambda at: change_said(at, lambda said: said.update(split=None)),
            "split: found None, expected 'crossfit', the",
        ),
        (lambda at: change_said(at, lambda said: said.update(split="holdout")), "split: found 'holdout', expected 'cr"),
        (lambda at: change_said(at, lambda said: said.update(split="nowhere")), "split: found 'nowhere', expected 'cr"),
        (
            lambda at: change_said(at, lambda said: said["tasks"][0].update(suite="alias")),
            "tasks: found alias/town-riverside, expected tasks that the board holds",
        ),
        (
            state_task(queries_sha256="0" * 64),
            f"tasks: found clean/town-riverside with queries_sha256 {'0' * 64}, expec",
        ),
        (state_task(queries=10**9), "tasks: found clean/town-riverside with queries 1000000000, expected"),
        (state_task(answered=10**9), "tasks: found clean/town-riverside with answered 1000000000, expected"),
        (
            lambda at: change_said(at, lambda said: said["tasks"].append(said["tasks"][0])),
            "tasks: found clean/town-riverside 2 times, expected each task once: submit again",
        ),
        (
            lambda at: change_rows(at, lambda rows: rows[0].update(asked_sha256="0" * 64)),
            "as it was drawn otherwise, expected",
        ),
        (lambda at: change_rows(at, lambda rows: rows.append(rows[0])), "expected each query once"),
        (lambda at: change_rows(at, lambda rows: rows[0].update(query_id=None)), "query_id: found None"),
        (lambda at: change_rows(at, lambda rows: rows[1].update(confidence=-0.5)), "confidence is -0.5"),
    ],
)
def test_rows_and_versions_that_do_not_fit_the_board_are_listed_and_never_scored(copied, stored, program, spoil, fault):
    spoil(copied)
    code, out, _ = program("verify", copied, "--for", stored)
    assert code == 2
    assert fault in out
    (entry,) = find_entries([], [copied])
    with laid_tasks([stored]) as folders, pytest.raises(ConfigError) as refused:
        check_submitted(entry, [*map(task_files.Task.open, folders)], find_split(read_pack(stored).split))
    assert fault in str(refused.value)


def test_a_submission_with_a_fault_costs_nobody_the_board(copied, stored, program, tmp_path):
    change_rows(copied, lambda rows: rows[1].update(confidence=-0.5))
    words = ("score", "--predictions", stored, "--submissions", copied.parent, "--name", "both", "--out", tmp_path)
    code, _, err = program(*words)
    assert code == CONTESTANT_FAILED
    assert "failed, and so not on the board: mine: " in err
    assert "confidence is -0.5" in err
    about = read_board_manifest(tmp_path / "boards" / "both")
    assert list(about.failed) == ["mine"]
    assert about.entries
    assert "mine" not in {entry.name for entry in about.entries}


def test_a_submission_for_another_board_is_left_out_and_said(copied, stored, program, tmp_path):
    change_said(copied, lambda said: said.update(board="other"))
    code, out, err = program("verify", copied, "--for", stored)
    assert (code, out) == (2, "")
    assert f"answers the board 'other', and 'kept' is the board of {stored}: name the results of 'other' by" in err
    lines = []
    with reporting(lines.append):
        assert submissions_for("kept", [tmp_path / "submissions"]) == ()
    assert lines == ["left out: 1 submission for other boards (other)"]


def test_a_matcher_may_answer_several_boards_each_in_a_folder_of_its_own(copied, tmp_path):
    root = tmp_path / "submissions"
    for board in ("kept", "other"):
        shutil.copytree(copied, root / board / "mine")
    shutil.rmtree(copied)
    change_said(root / "other" / "mine", lambda said: said.update(board="other"))
    assert submissions_for("kept", [root]) == (root / "kept" / "mine",)


def loop(path):
    path.symlink_to(path.name)


@pytest.mark.parametrize(
    "lay",
    [
        lambda at: at.write_text("notes", encoding="utf-8"),
        lambda at: at.mkdir(),
        lambda at: (at / "predictions").mkdir(parents=True),
        lambda at: at.symlink_to("nowhere"),
        loop,
        os.mkfifo,  # whoever opens it waits for ever
        lambda at: shutil.copytree(at.with_name("mine"), at / "deep" / "mine"),
    ],
)
def test_a_stray_entry_beside_submissions_costs_nobody_else_the_board(copied, tmp_path, lay):
    stray = copied.with_name("random")  # a name of a control, which must not go with it
    lay(stray)
    found = submissions_for("kept", [copied.parent])
    assert found == (copied, stray)
    lines = []
    failures = Failures(tmp_path / "log")
    with reporting(lines.append):
        assert [entry.name for entry in find_entries([], found, failures=failures)] == ["mine"]
    why = f"{stray} is no submission, for it holds no submission.json: remove it, or make it by 'submit'"
    assert failures.found == {str(stray): why}
    assert lines == [f"{stray} failed: {why}"]


def test_what_is_named_must_be_a_submission_or_a_folder_of_them(copied):
    (copied.parent / "README.md").write_text("how to", encoding="utf-8")
    assert submissions_for("kept", [copied.parent, copied]) == (copied,)
    for path in (copied / "predictions", copied / "submission.json", copied.with_name("nowhere")):
        with pytest.raises(StoreError, match=f"{path} is no folder of submissions: name one, or a submission itself"):
            submissions_for("kept", [path])
    with pytest.raises(ConfigError, match="with the stored results of a board: name them with --predictions"):
        submissions_for("", [copied])


# --- on a board -------------------------------------------------------------------------------------------------------


def test_submissions_stand_beside_what_was_run_and_say_so(copied, stored, tmp_path):
    change_said(copied, lambda said: said["card"].update(title="<script>alert(1)</script>"))
    with_submissions(stored, [copied.parent], tmp_path / "both")
    about, table = read_board_manifest(tmp_path / "both"), read_leaderboard(tmp_path / "both")
    said = {entry.name: entry for entry in about.entries}
    assert {name: entry.how for name, entry in said.items()} == {
        "mine": "as submitted",
        "prior_centre": "run here",
    }
    assert said["mine"].card.source == "original"
    assert (said["mine"].trained_on, said["mine"].set_apart) == ([], None)
    rows = table[(table["matcher"] == "mine") & (table["metric"] == "success_25m") & (table["stratum"] == "all")]
    assert set(rows["value"]) == {1.0}
    assert set(rows["how"]) == {"as submitted"}
    before = pd.read_parquet(stored / "leaderboard.parquet")
    again = table[table["matcher"] == "prior_centre"].drop(columns="detectable").reset_index(drop=True)
    pd.testing.assert_frame_equal(again, before.drop(columns="detectable"))
    text = (tmp_path / "both" / "leaderboard.md").read_text(encoding="utf-8")
    assert "| mine (as submitted) |" in text
    assert "<script>" not in text


@pytest.mark.parametrize(
    ("trained_on", "why"),
    [
        (["munich"], None),
        (["munich", "town-riverside"], "trained on town-riverside, which it is tested on"),
        ({"a": ["munich"], "b": ["town-riverside"]}, None),
        ({"a": ["munich", "town-riverside"], "b": []}, "trained on town-riverside, which it is tested on"),
    ],
)
def test_who_was_taught_by_a_test_place_is_set_apart(copied, stored, tmp_path, trained_on, why):
    change_said(copied, lambda said: said["card"].update(trained_on=trained_on))
    lines = []
    with reporting(lines.append):
        with_submissions(stored, [copied], tmp_path / "both")
    (entry,) = [one for one in read_board_manifest(tmp_path / "both").entries if one.name == "mine"]
    assert entry.set_apart == why
    assert set(entry.trained_on) <= {"munich", "town-riverside"}
    text = (tmp_path / "both" / "leaderboard.md").read_text(encoding="utf-8")
    assert ("## Set apart, not to be compared with those above: clean, localization" in text) == (why is not None)
    assert (f"- mine is set apart: {why}." in text) == (why is not None)
    assert (f"mine: set apart, {why}" in lines) == (why is not None)


@pytest.mark.usefixtures("plain_site")
def test_one_command_publishes_stored_results_and_submissions_and_says_what_it_left_out(
    copied, stored, program, tmp_path
):
    stray = copied.with_name("notes.txt")
    stray.write_text("notes", encoding="utf-8")
    lost = f"failed, and so not on the board: {stray}: "
    into, lines = tmp_path / "site", []
    with reporting(lines.append):
        publish(board=stored, submissions=copied.parent, into=into, out=tmp_path)
    assert sum(line.startswith(lost) for line in lines) == 1
    words = ("--submissions", copied.parent, "--into", into, "--out", tmp_path)
    code, out, err = program("publish", "--board", stored, *words)
    assert code == CONTESTANT_FAILED
    assert err.count(lost) == 1
    assert out.split()[-1] == str(into / "index.html")
    page = (into / "index.html").read_text(encoding="utf-8")
    assert "as submitted" in page
    assert "run here" in page
    code, _, err = program("publish", "--board", tmp_path, *words)
    assert code == 2
    assert "holds no stored results" in err


def test_one_command_scores_stored_results_and_submissions(copied, stored, program, tmp_path):
    words = ("score", "--predictions", stored, "--submissions", copied.parent, "--name", "both", "--out", tmp_path)
    code, out, err = program(*words)
    assert code == 0, err
    assert "as submitted" in out
    assert read_board_manifest(tmp_path / "boards" / "both").entries[0].name == "mine"


def test_of_submissions_that_share_a_name_none_is_scored_and_the_others_are(copied, tmp_path):
    twin = shutil.copytree(copied, copied.parent / "kept" / "mine")
    other = shutil.copytree(copied, copied.with_name("other"))
    change_said(other, lambda said: rename_said(other, said))
    failures = Failures(tmp_path / "log")
    found = submissions_for("kept", [copied.parent])
    assert [entry.name for entry in find_entries([], found, failures=failures)] == ["other"]
    assert failures.found == {
        str(one): f"{one} and {another} have one name, 'mine': remove or rename a submission"
        for one, another in ((copied, twin), (twin, copied))
    }
    with pytest.raises(ConfigError, match="have one name, 'mine'"):
        find_entries([], found)


@pytest.mark.parametrize(
    ("name", "whose"), [("random", "a control of every board"), ("sasgeo", "a matcher that ships")]
)
def test_a_name_that_is_not_free_is_refused_by_whoever_validates_and_whoever_scores(
    copied, stored, tmp_path, mistake, name, whose
):
    folder = copied.rename(copied.with_name(name))
    change_said(folder, lambda said: rename_said(folder, said))
    fault = f"{folder}: {name!r} is the name of {whose}: choose another name"
    assert fault in mistake("verify", folder, "--for", stored)
    failures = Failures(tmp_path / "log")
    assert find_entries([], [folder], failures=failures) == ()
    assert failures.found == {str(folder): fault.removeprefix(f"{folder}: ")}


def rename_said(folder, said):
    name = folder.name
    said["card"]["name"] = name
    said["files"] = {f"predictions/{name}.parquet": said["files"].popitem()[1]}
    (folder / "predictions" / "mine.parquet").rename(folder / "predictions" / f"{name}.parquet")


def test_a_submission_that_has_the_name_of_another_entry_is_left_out(copied, stored, tmp_path, rows, program):
    path = write_rows(tmp_path / "mine.parquet", rows)
    words = ("score", "--predictions", stored, "--predictions", path, "--submissions", copied, "--out", tmp_path)
    code, _, err = program(*words)
    assert code == CONTESTANT_FAILED
    assert f"{copied}: 'mine' is the name of another entry of the board: choose another name" in err
    assert [entry.name for entry in read_board_manifest(tmp_path / "boards" / "board").entries].count("mine") == 1


@pytest.mark.slow
def test_every_submission_of_the_repository_is_sound_for_its_board(program):
    records = sorted(ROOT.glob("submissions/*/*/submission.json"))
    assert len(records) >= 3
    for record in records:
        stored = ROOT / "docs" / "results" / record.parts[-3]
        code, _, err = program("verify", record.parent, "--for", stored)
        assert code == 0, err
