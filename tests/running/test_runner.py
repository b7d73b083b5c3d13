# SPDX-License-Identifier: Apache-2.0
"""A run gives a row for every query, whatever happens to it: cut off, split, on other processes, on a full disk."""

import errno
import os
import random
import signal
import subprocess
import sys
import time
from dataclasses import replace

import pyarrow.parquet as pq
import pytest

from sasgeo_bench.boards.build import make_board
from sasgeo_bench.boards.scored import ScoreRequest
from sasgeo_bench.core.errors import ConfigError, MatchError, StoreError
from sasgeo_bench.matching.matcher import Prediction
from sasgeo_bench.running import answers, prediction_files
from sasgeo_bench.running.plan import RunRequest, plan_run
from sasgeo_bench.running.prediction_files import RunManifest
from sasgeo_bench.running.runner import run
from sasgeo_bench.running.sandbox import PROMISES
from sasgeo_bench.running.worker import Limits
from sasgeo_bench.scoring.submission_files import validate
from sasgeo_bench.tasks import task_files

PATIENT = Limits(match_s=600.0)  # what answers is never late, however busy the machine is
# A run that gets a signal as soon as three rows are written: it comes in the middle, however busy the machine is.
# What is started in the background of a shell does not heed Ctrl-C, nor does what it starts: this one does.
SIGNALLED = """
import os, signal
from sasgeo_bench.cli import main
from sasgeo_bench.running import answers
from sasgeo_bench.running import prediction_files

def write_once(*words, **named):
    prediction_files.write_part = write
    write(*words, **named)
    os.kill(os.getpid(), {number})

answers.PART_ROWS = 3
write, prediction_files.write_part = prediction_files.write_part, write_once
signal.signal(signal.SIGINT, signal.default_int_handler)
main()
"""
UNDISTURBED = "from sasgeo_bench.cli import main; main()"


def request_of(task, out, name="Plain", **changes):
    request = RunRequest(spec=f"hostile:{name}", tasks=(task,), out=out, limits=PATIENT)
    return replace(request, **changes)


def run_all(request):
    plan = plan_run(request)
    report = run(plan)
    return report, plan.parts[0].folder


def table(*paths):
    """All rows by query, without what differs from run to run: the time they took."""
    rows = (item for path in paths for item in prediction_files.read_predictions(path))
    found = {item.query_id: replace(item, latency_s=None, matcher_s=None) for item in rows}
    return [found[name] for name in sorted(found)]


@pytest.fixture(scope="module")
def undisturbed(made, tmp_path_factory):
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(made)
        patch.syspath_prepend(str(made))
        task = made / "out" / "tasks" / "false-unknown" / "town-riverside"
        return run_all(request_of(task, tmp_path_factory.mktemp("undisturbed")))


def test_every_query_has_a_row_and_run_json_says_how(task, undisturbed):
    report, folder = undisturbed
    ids = task_files.Task.open(task).ids()
    assert [item.query_id for item in table(folder)] == sorted(ids)
    assert report.counts == {"ok": len(ids)}
    about = RunManifest.open(folder)
    assert about.matcher.name == "plain"
    assert about.queries_sha256 == task_files.read_task(task)["files"]["queries.parquet"]["sha256"]
    assert about.peak_bytes > 0
    assert about.prepare_s >= 0
    assert all(item.latency_s > 0.009 for item in prediction_files.read_predictions(folder))


def test_two_processes_give_what_one_does(task, undisturbed, tmp_path):
    _, folder = run_all(request_of(task, tmp_path, jobs=2))
    assert table(folder) == table(undisturbed[1])


@pytest.mark.usefixtures("in_threads")
def test_two_shards_merged_give_what_one_run_does(task, undisturbed, tmp_path):
    folders = [run_all(request_of(task, tmp_path / str(index), shard=(index, 2)))[1] for index in (1, 2)]
    assert all(len(table(folder)) < len(table(undisturbed[1])) for folder in folders)
    merged = (tmp_path / "both.parquet", tmp_path / "again.parquet")
    assert prediction_files.merge_runs(folders, merged[0]) == len(task_files.Task.open(task).ids())
    prediction_files.merge_runs(folders[::-1], merged[1])
    assert merged[0].read_bytes() == merged[1].read_bytes()
    assert table(merged[0]) == table(undisturbed[1])


@pytest.mark.usefixtures("in_threads")
def test_what_another_run_answered_meanwhile_is_not_asked_again(task, tmp_path):
    plans = [plan_run(request_of(task, tmp_path, limit=count)) for count in (2, 2, 3)]
    reports = [run(plan) for plan in plans]
    assert [report.counts for report in reports] == [{"ok": 2}, {}, {"ok": 1}]
    assert (
        sum(
            len(prediction_files.read_part(part, is_own=True))
            for part in prediction_files.parts_of(plans[0].parts[0].folder)
        )
        == 3
    )


@pytest.mark.usefixtures("in_threads")
def test_rows_of_a_status_are_asked_again_on_demand(task, tmp_path):
    _, folder = run_all(request_of(task, tmp_path, name="Raises", limit=2))
    assert {item.status for item in table(folder)} == {"crash"}
    assert plan_run(request_of(task, tmp_path, name="Raises", limit=2)).parts[0].left == ()
    again = plan_run(request_of(task, tmp_path, name="Raises", limit=2, again=("crash",)))
    assert len(again.parts[0].left) == 2
    # Asked again, with another outcome: the newer row counts, for readers, for merging and for validating.
    prediction_files.write_part(folder, [Prediction(query_id=name) for name in again.parts[0].left])
    assert {item.status for item in table(folder)} == {"ok"}
    prediction_files.merge_runs([folder], tmp_path / "merged.parquet")
    assert {item.status for item in table(tmp_path / "merged.parquet")} == {"ok"}
    assert not [fault for fault in validate(folder, [task_files.Task.open(task)]) if "again" in fault.found]


@pytest.mark.usefixtures("in_threads")
@pytest.mark.parametrize("jobs", [1, 2])
def test_a_matcher_that_hangs_on_ten_queries_in_a_row_is_given_up(task, tmp_path, jobs):
    count = len(task_files.Task.open(task).ids())
    hanging = Limits(match_s=0.01)  # it never answers, however long one waits
    report, folder = run_all(request_of(task, tmp_path, name="Hangs", limits=hanging, jobs=jobs))
    assert report.counts == {"timeout": count}
    words = "given up after 10 queries in a row without an answer in time (no answer within 0.01 s)"
    messages = [item.message for item in table(folder)]
    assert count - 10 - (jobs - 1) <= messages.count(words) <= count - 10
    assert set(messages) == {words, "no answer within 0.01 s"}
    assert report.messages == {"timeout": words}


def command_of(program, task, out, *words):
    command = [sys.executable, "-c", program, "run", "--matcher", "hostile:Slow", "--tasks", str(task)]
    return [*command, "--out", str(out), "--match-s", "600", *words]


@pytest.mark.slow
@pytest.mark.parametrize("kills", [1, 20])
def test_killed_once_or_at_random_moments_a_run_ends_with_the_same_rows(place, task, undisturbed, tmp_path, kills):
    folder = plan_run(request_of(task, tmp_path, name="Slow")).parts[0].folder
    killed = command_of(SIGNALLED.format(number=int(signal.SIGKILL)), task, tmp_path, "--jobs", "2")
    command = command_of(UNDISTURBED, task, tmp_path, "--jobs", "2")
    process = subprocess.run(killed, cwd=place, env=env_with(place), capture_output=True, text=True)  # noqa: S603, PLW1510
    assert process.returncode == -signal.SIGKILL, process.stderr
    every, asked = len(task_files.Task.open(task).ids()), task_files.Task.open(task).asked
    assert 0 < len(prediction_files.ids_done(folder, asked)) < every
    chance = random.Random(7)  # noqa: S311 - moments, no secrets
    for _ in range(kills - 1):
        (folder / "run.json").unlink(missing_ok=True)
        process = subprocess.Popen(command, cwd=place, env=env_with(place), stderr=subprocess.DEVNULL)  # noqa: S603
        while process.poll() is None and not (folder / "run.json").is_file():
            time.sleep(0.05)
        time.sleep(chance.uniform(0.0, 2.0))
        process.kill()
        process.wait()
        if len(prediction_files.ids_done(folder, asked)) == every:
            for part in prediction_files.parts_of(folder):
                part.unlink()  # done already: begin anew, so that there is something to kill
    finished = subprocess.run(command, cwd=place, env=env_with(place), capture_output=True, text=True)  # noqa: S603, PLW1510
    assert finished.returncode == 0, finished.stderr
    assert table(folder) == table(undisturbed[1])


def env_with(place):
    return os.environ | {"PYTHONPATH": f"{place}:{os.environ.get('PYTHONPATH', '')}"}


@pytest.mark.slow
@pytest.mark.parametrize("jobs", [1, 2])
def test_an_interrupt_stops_a_run_in_the_middle_and_it_goes_on_there(place, task, undisturbed, tmp_path, jobs):
    folder = plan_run(request_of(task, tmp_path, name="Slow")).parts[0].folder
    command = command_of(SIGNALLED.format(number=int(signal.SIGINT)), task, tmp_path, "--jobs", str(jobs))
    process = subprocess.run(command, cwd=place, env=env_with(place), capture_output=True, text=True)  # noqa: S603, PLW1510
    assert process.returncode == 130, process.stderr
    assert "interrupted; answers so far are kept" in process.stderr.splitlines()[-1]
    assert (
        0
        < len(prediction_files.ids_done(folder, task_files.Task.open(task).asked))
        < len(task_files.Task.open(task).ids())
    )
    run_all(request_of(task, tmp_path, name="Slow"))
    assert table(folder) == table(undisturbed[1])


def test_a_run_without_isolation_is_another_run_and_says_what_it_lacked(task, tmp_path):
    _, shut_in = run_all(request_of(task, tmp_path, limit=1))
    report, trusted = run_all(request_of(task, tmp_path, name="Raises", limit=1, is_sandboxed=False))
    assert shut_in.parent != trusted.parent
    given = RunManifest.open(trusted).isolation
    assert set(given) == set(RunManifest.open(shut_in).isolation) == set(PROMISES)
    assert {words for name, words in given.items() if name != "memory"} == {"trusted code, not shut in"}
    assert list(report.messages) == ["crash"]
    same = plan_run(request_of(task, tmp_path, limit=1, is_sandboxed=False)).parts[0].folder
    assert same != shut_in


@pytest.mark.usefixtures("in_threads")
def test_a_full_disk_is_told_and_what_was_written_stays(task, tmp_path, monkeypatch):
    _, folder = run_all(request_of(task, tmp_path, limit=2))
    before = table(folder)

    def full(*_, **__):
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(prediction_files, "write_table", full)
    with pytest.raises(StoreError, match=r"No space left on device.*it continues there"):
        run_all(request_of(task, tmp_path, limit=4))
    monkeypatch.undo()
    assert table(folder) == before
    assert not [path for path in folder.iterdir() if path.name.endswith(".partial")]


@pytest.mark.usefixtures("in_threads")
@pytest.mark.parametrize(("name", "message"), [("WantsImages", "no image"), ("WantsImagery", "no imagery")])
def test_what_a_card_says_it_cannot_is_not_applicable(task, tmp_path, name, message):
    report, folder = run_all(request_of(task, tmp_path, name=name, limit=3))
    assert report.counts == {"not applicable": 3}
    assert {item.message for item in table(folder)} == {message}


@pytest.mark.usefixtures("in_threads")
@pytest.mark.parametrize(
    ("changes", "error", "words"),
    [
        ({"shard": (3, 2)}, ConfigError, "--shard must be i/n"),
        ({"jobs": 0}, ConfigError, "--jobs must lie between 1 and 1000, got 0"),
        ({"top_k": 0}, ConfigError, "--top-k must be at least 1"),
        ({"top_k": 1001}, ConfigError, "--top-k must be at most 1000, the bound of an answer, got 1001"),
        ({"spec": "hostile:NoCard"}, MatchError, "card is a NoneType"),
        (
            {"spec": "hostile:ClaimsToBeTheOracle"},
            MatchError,
            "its card is named 'oracle_pose', as a matcher",
        ),
        ({"spec": "no_such_matcher"}, MatchError, "there is no matcher"),
        ({"spec": "no_such_module:Class"}, MatchError, "cannot be imported"),
    ],
)
def test_what_makes_no_sense_is_refused_before_anything_is_written(task, tmp_path, changes, error, words):
    with pytest.raises(error, match=words):
        plan_run(request_of(task, tmp_path, **changes))
    assert list(tmp_path.iterdir()) == []


@pytest.mark.usefixtures("in_threads")
def test_rows_of_an_older_program_are_taken_for_the_task_that_its_run_json_names_and_for_no_other(task, tmp_path):
    _, folder = run_all(request_of(task, tmp_path, limit=2))
    for part in prediction_files.parts_of(folder):  # how many there are depends on how fast the machine is
        pq.write_table(pq.read_table(part).drop_columns(["asked_sha256"]), part)
    assert plan_run(request_of(task, tmp_path, limit=2)).parts[0].left == ()
    RunManifest.open(folder).model_copy(update={"queries_sha256": "0" * 64}).save(folder)
    with pytest.raises(
        StoreError, match=r"answers of an older version, and not to the queries that .* holds now: move"
    ):
        plan_run(request_of(task, tmp_path, limit=2))


@pytest.mark.usefixtures("in_threads")
def test_another_version_of_a_matcher_has_a_folder_of_its_own(place, task, tmp_path):
    first = plan_run(request_of(task, tmp_path)).parts[0].folder
    source = place / "hostile.py"
    text = source.read_text(encoding="utf-8")
    try:
        source.write_text(text + "\n# only a comment\n", encoding="utf-8")
        assert plan_run(request_of(task, tmp_path)).parts[0].folder == first
        source.write_text(text + "\nCHANGED = True\n", encoding="utf-8")
        second = plan_run(request_of(task, tmp_path)).parts[0].folder
    finally:
        source.write_text(text, encoding="utf-8")
    assert first != second
    assert plan_run(request_of(task, tmp_path)).parts[0].folder == first


HOSTILE = {
    "OddName": ("invalid", "expected 1..64 printable characters"),
    "FarAway": ("invalid", "an answer that is none"),
    "DigsDeep": ("ok", ""),
    "RaisesWhatNobodyCatches": ("crash", "ended with exit status 1"),
}


@pytest.mark.slow
def test_hostile_matchers_cost_their_own_rows_from_the_run_to_the_board(task, undisturbed, tmp_path):
    folders = {"Plain": undisturbed[1]}
    for name, (status, words) in HOSTILE.items():
        report, folders[name] = run_all(request_of(task, tmp_path, name=name, limit=2))
        assert report.counts == {status: 2}
        assert all(words in item.message for item in table(folders[name]))
    request = ScoreRequest(
        predictions=[*folders.values()], root=task.parents[2], board=tmp_path / "boards" / "b", draws=100
    )
    board = make_board(request)
    hashes = {RunManifest.open(folder).hash: name for name, folder in folders.items()}
    assert {entry.hash for entry in board.board.about.entries} == set(hashes)
    assert board.failures.found == {}
    entries = board.board.about.entries
    answered = {hashes[entry.hash]: board.scores[entry.name]["status"].value_counts() for entry in entries}
    assert answered.pop("Plain").to_dict() == {"ok": len(task_files.Task.open(task).ids())}
    for name, (status, _) in HOSTILE.items():
        assert answered[name][status] == 2


@pytest.mark.usefixtures("in_threads")
def test_a_mistake_of_ours_about_one_answer_costs_its_row_and_the_log_says_where(task, tmp_path, monkeypatch):
    work, count = answers.check_prediction, iter(range(100))

    def broken(*words, **more):
        if next(count) == 1:
            raise KeyError("a mistake of ours")
        return work(*words, **more)

    monkeypatch.setattr(answers, "check_prediction", broken)
    report, folder = run_all(request_of(task, tmp_path, limit=3))
    assert report.counts == {"ok": 2, "crash": 1}
    assert report.messages == {
        "crash": "not its own process failed, but ours: KeyError: 'a mistake of ours' (see failures.log)"
    }
    log = (folder.parents[1] / "failures.log").read_text(encoding="utf-8")
    assert "Traceback" in log
    assert "in broken" in log


def test_where_no_process_can_be_started_for_lack_of_room_the_run_stops_in_one_line(task, tmp_path, monkeypatch):
    plan = plan_run(request_of(task, tmp_path, limit=1))

    def full(**_):
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr("tempfile.mkdtemp", full)
    with pytest.raises(StoreError, match=r"no process of a plugin can be started .*No space left"):
        run(plan)


def test_rows_say_what_the_runner_and_what_the_matcher_measured_and_older_rows_are_read(task, tmp_path):
    _, folder = run_all(request_of(task, tmp_path, name="SetsItsClock", limit=1))
    (row,) = prediction_files.read_predictions(folder)
    assert row.latency_s >= 0.3  # it sleeps so long
    assert row.matcher_s == 0.0
    (part,) = prediction_files.parts_of(folder)
    pq.write_table(pq.read_table(part).drop_columns(["matcher_s"]), part)
    assert list(prediction_files.read_predictions(folder)) == [replace(row, matcher_s=None)]
    assert plan_run(request_of(task, tmp_path, name="SetsItsClock", limit=1)).parts[0].left == ()
    prediction_files.merge_runs([folder], tmp_path / "merged.parquet")
    assert "matcher_s" not in pq.read_schema(tmp_path / "merged.parquet").names
