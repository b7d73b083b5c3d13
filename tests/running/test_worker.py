# SPDX-License-Identifier: Apache-2.0
"""A matcher may do what it likes: it costs its own rows, and nothing of it is left."""

import os
import re
import shutil
import subprocess
import sys
import time
from dataclasses import replace

import psutil
import pytest

from sasgeo_bench.running import leak_scan, sandbox, worker
from sasgeo_bench.running.worker import Limits, Reach, Worker
from sasgeo_bench.tasks import task_files
from tests.threaded import Threaded

# Only what hangs has to run into its time; on a busy machine all others may take theirs.
PATIENT = Limits(match_s=600.0, memory_bytes=800 * 10**6)
TELLING = b" ".join((b"this", b"tells", b"answers"))  # as `hostile.ReadsAllBeside` looks for it
HASTY = replace(PATIENT, match_s=1.0)
HAS_LANDLOCK = sandbox.landlock_version() > 0
shut_in = pytest.mark.skipif(not HAS_LANDLOCK, reason="this kernel has no Landlock to refuse files with")


def ask(place, task, name, *, limits=PATIENT, times=1, is_sandboxed=True, kind=Worker):
    """The replies of a hostile matcher to the first query, and its worker after its end."""
    query = task_files.query_bytes(next(iter(task_files.read_queries(task))))
    region = place / "out" / "regions" / task.name
    reach = Reach(
        readable=[region], hidden=[place / "out" / "truth", place / "out" / "runs"], is_sandboxed=is_sandboxed
    )
    with kind(spec=f"hostile:{name}", reach=reach, limits=limits) as worker:
        ready = worker.prepare(region)
        if ready.status != "ok":
            return [ready], worker
        return [worker.match(query, top_k=5) for _ in range(times)], worker


@pytest.mark.parametrize(
    ("name", "status", "words"),
    [
        ("Plain", "ok", ""),
        ("Hangs", "timeout", "no answer within 1 s"),
        ("Segfaults", "crash", "died by SIGSEGV"),
        ("DiesByAnySignal", "crash", "died by signal 40"),
        ("Exits", "crash", "ended with exit status 3: last words"),
        ("Leaks", "crash", "more than the 800 MB of memory that are allowed|out of memory"),
        ("Forks", "ok", ""),
        ("Prints", "ok", ""),
        ("MeasuresItself", "invalid", "an answer that is none"),
        ("LeavesAtOnce", "invalid", "hostile:LeavesAtOnce: cannot be made .SystemExit: 0"),
        ("LiesOnTheWire", "crash", "an answer of 2147483647 bytes"),
        ("RaisesWhatNobodyCatches", "crash", "ended with exit status 1"),
        ("AnswersLiars", "crash", "ended with exit status 1"),
    ],
)
def test_whatever_a_matcher_does_to_its_process_becomes_a_status_and_a_line(place, task, name, status, words):
    (reply,), _ = ask(place, task, name, limits=HASTY if name == "Hangs" else PATIENT)
    assert (reply.status, "\n" in reply.message) == (status, False), reply.message
    assert re.search(words, reply.message), reply.message


@pytest.mark.parametrize(
    ("name", "status", "words"),
    [
        ("Raises", "crash", "ValueError: no idea where this is"),
        ("RaisesInPrepare", "crash", "ValueError: no index today"),
        ("ScoresNan", "invalid", "score is nan, expected a finite number"),
        ("SureByWords", "invalid", "confidence is a str, expected a number"),
        ("SureBeyondNumbers", "invalid", "confidence is too large, expected a number within 0..1"),
        ("ReturnsText", "invalid", "match.. returned str, expected"),
        ("ReturnsMany", "invalid", "returned 1000000 poses, expected at most top_k = 5"),
        ("FarAway", "invalid", "an answer that is none: easting_m is 1e.300, expected a finite number within"),
        ("CardOfAList", "invalid", "an answer that is none: "),
        ("OddName", "invalid", "the name .*, expected 1..64 printable characters"),
        ("PoseFarAway", "invalid", "easting_m is 1e.300, expected a finite number within"),
        ("NoMatcher", "invalid", "NoMatcher is not a matcher, it has no prepare and no match"),
        ("NoCard", "invalid", "card is a NoneType, expected a"),
        ("BadCard", "invalid", "licence is empty"),
        ("NoSuchClass", "invalid", "cannot be imported"),
    ],
)
def test_whatever_a_matcher_answers_becomes_a_status_and_a_line(place, task, name, status, words):
    (reply,), _ = ask(place, task, name, kind=Threaded)
    assert (reply.status, "\n" in reply.message) == (status, False), reply.message
    assert re.search(words, reply.message), reply.message


def test_last_words_are_awaited_however_late_they_are_read(place, task, monkeypatch):
    def read_late(stream, printed):
        time.sleep(1.0)
        drain(stream, printed)

    drain = worker._drain
    monkeypatch.setattr(worker, "_drain", read_late)
    (reply,), _ = ask(place, task, "Exits")
    assert reply.message == "ended with exit status 3: last words"


def test_a_map_that_takes_too_long_is_a_timeout(place, task):
    (reply,), _ = ask(place, task, "HangsInPrepare", limits=Limits(prepare_s=1.0))
    assert (reply.status, reply.message) == ("timeout", "no answer within 1 s")


def test_a_sandbox_that_does_not_stand_in_time_is_not_said_to_be_a_slow_answer(place, task, monkeypatch):
    monkeypatch.setattr(worker, "_START_S", -1.0)
    (reply,), _ = ask(place, task, "Plain")
    assert (reply.status, reply.message.split(":")[0]) == ("timeout", "the sandbox did not stand within -1 s")


def test_an_end_between_two_questions_costs_one_and_the_map_is_prepared_again(place, task):
    query = task_files.query_bytes(next(iter(task_files.read_queries(task))))
    region = place / "out" / "regions" / task.name
    with Worker(spec="hostile:Plain", reach=Reach(readable=[region], hidden=[]), limits=PATIENT) as worker:
        assert worker.prepare(region).status == "ok"
        first = worker.match(query, top_k=5)
        worker._process.kill()
        worker._process.wait()
        second, third = (worker.match(query, top_k=5) for _ in range(2))
    assert [reply.status for reply in (first, second, third)] == ["ok", "crash", "ok"]
    assert "died by SIGKILL" in second.message
    assert third.found == first.found


@shut_in
def test_the_truth_is_out_of_reach(place, task):
    (reply,), worker = ask(place, task, "ReadsTruth")
    assert "read the truth" not in reply.message
    (trusted,), _ = ask(place, task, "ReadsTruth", is_sandboxed=False)
    assert "read the truth" in trusted.message  # it looks in the right place
    (listed,), _ = ask(place, task, "ListsFolders")
    assert listed.found.diagnostics["truth files"] == 0
    assert worker.isolation["truth"] != "not protected"


@shut_in
@pytest.mark.parametrize("folder", ["", "checkout"])
def test_truths_of_other_runs_beside_the_code_are_out_of_reach_too(place, task, tmp_path, monkeypatch, folder):
    other = tmp_path / folder / "out" if folder else tmp_path / "out"
    for name in ("tasks", "truth/clean/vaduz", "regions/vaduz"):
        (other / name).mkdir(parents=True)
    (other / "truth" / "clean" / "vaduz" / "truth.parquet").write_bytes(b"answers")
    monkeypatch.syspath_prepend(str(other.parent))
    (reply,), _ = ask(place, task, "ReadsTruth")
    assert "read the truth" not in reply.message
    (trusted,), _ = ask(place, task, "ReadsTruth", is_sandboxed=False)
    assert "read the truth" in trusted.message


TELLS = (
    *("results/base/pack.json", "results/base/predictions/a.parquet", "results/base/more/deep/a.parquet"),
    *(
        "kept/truths.parquet",
        "asked/clean/vaduz/queries.parquet",
        "copied/clean/vaduz/truth.parquet",
        "copied/clean/vaduz/truth.json",
    ),
    *("data/truth/clean/vaduz/truth-test.parquet", "answered/part-1-2.parquet", ".git/objects/ab/cd"),
)
FOLDERS_THAT_TELL = (
    ("board.json", "leaderboard.parquet", "pictures/cases/one.png"),
    ("site.json", "index.html", "cases/one.png"),
    ("release.json", "SHA256SUMS", "truth/clean/vaduz/truth.parquet"),
    ("region.json", "layers.tif"),
    ("submission.json", "predictions/a.parquet"),
)


@shut_in
@pytest.mark.parametrize("depth", ["", "one/two/three/four"])
def test_whatever_beside_the_code_tells_answers_is_out_of_reach(place, task, tmp_path, monkeypatch, depth):
    names = (*TELLS, *(f"other{at}/{name}" for at, names in enumerate(FOLDERS_THAT_TELL) for name in names))
    for name in (*names, "harmless/notes.txt"):
        (tmp_path / depth / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / depth / name).write_bytes(TELLING)
    (tmp_path / "link").symlink_to(place / "out" / "truth")
    (place / "out" / "truth" / "copied").write_bytes(TELLING)
    monkeypatch.syspath_prepend(str(tmp_path))
    monkeypatch.setattr(sys, "path", [str(tmp_path), *sys.path])
    (reply,), worker = ask(place, task, "ReadsAllBeside")
    assert reply.found.diagnostics == {"told": 1}, "the harmless one alone"
    assert "not looked for" not in worker.isolation["truth"]
    (trusted,), _ = ask(place, task, "ReadsAllBeside", is_sandboxed=False)
    assert trusted.found.diagnostics["told"] > len(names) + 1


@shut_in
def test_a_matcher_that_lies_among_stored_results_runs_and_does_not_read_them(place, task, tmp_path, monkeypatch):
    shutil.copy(place / "hostile.py", tmp_path / "hostile.py")
    for name in ("pack.json", "truths.parquet", "predictions/a.parquet"):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_bytes(TELLING)
    monkeypatch.chdir(tmp_path)
    (reply,), worker = ask(place, task, "ReadsAllBeside")
    assert reply.message == ""
    assert reply.found.diagnostics == {"told": 0}
    assert worker.isolation["truth"] != "not protected"


@shut_in
def test_where_not_all_was_searched_the_run_says_so(place, task, monkeypatch):
    monkeypatch.setattr(leak_scan, "walk_code", lambda code: leak_scan.walk([*map(str, code)], most_entries=3))
    monkeypatch.setattr("sasgeo_bench.running.worker.walk_code", leak_scan.walk_code)
    _, worker = ask(place, task, "Plain")
    assert "stored results beyond 3 files next to the code were not looked for" in worker.isolation["truth"]


@shut_in
def test_command_lines_of_others_are_out_of_reach(place, task):
    command = [sys.executable, "-c", "import time; time.sleep(1000)", "my-secret-seed"]
    with subprocess.Popen(command) as other:  # noqa: S603 - ours
        try:
            (reply,), worker = ask(place, task, "ReadsCommandLines")
            (trusted,), _ = ask(place, task, "ReadsCommandLines", is_sandboxed=False)
        finally:
            other.kill()
    assert reply.found.diagnostics["secrets"] == 0
    assert reply.found.diagnostics["own"] > 0
    assert trusted.found.diagnostics["secrets"] >= 1  # others on this machine may run this test at the same time
    assert "can be read" not in worker.isolation["processes"]


def test_the_memory_of_a_map_is_that_of_the_matchers_own_process(place, task):
    region = place / "out" / "regions" / task.name
    with Worker(spec="hostile:Holds", reach=Reach(readable=[region], hidden=[]), limits=PATIENT) as worker:
        assert worker.prepare(region).grown_bytes > 50 * 2**20


@shut_in
def test_results_cannot_be_written(place, task):
    (reply,), _ = ask(place, task, "WritesResults")
    assert reply.status == "refused"
    assert not (place / "out" / "tasks" / "mine").exists()


@shut_in
def test_there_is_no_network(place, task):
    (reply,), worker = ask(place, task, "Connects")
    assert reply.status in {"refused", "crash"}
    assert worker.isolation["network"] != "not cut"


def test_the_environment_says_nothing_of_where_it_runs(place, task, monkeypatch):
    monkeypatch.setenv("SASGEO_OUT", str(place))
    monkeypatch.setenv("MY_SECRET", "1")
    (reply,), _ = ask(place, task, "TellsEnvironment")
    assert {"HOME", "PATH"} <= set(reply.found.diagnostics)
    assert not {"SASGEO_OUT", "SASGEO_EXTRACTS", "MY_SECRET", "PYTHONPATH"} & set(reply.found.diagnostics)


@pytest.mark.parametrize("name", ["Forks", "Hangs", "Plain"])
def test_nothing_is_left_of_a_matcher(place, task, name):
    before = {child.pid for child in psutil.Process(os.getpid()).children(recursive=True)}
    _, worker = ask(place, task, name, limits=HASTY if name == "Hangs" else PATIENT)
    after = psutil.Process(os.getpid()).children(recursive=True)
    assert [child for child in after if child.pid not in before] == []
    assert worker.peak_bytes > 50 * 2**20


def test_an_answer_that_came_before_its_question_is_refused_and_the_process_is_replaced(place, task):
    replies, worker = ask(place, task, "AnswersInAdvance", limits=PATIENT, times=3)
    assert [reply.status for reply in replies] == ["ok", "invalid", "ok"]
    assert "reply does not belong to this query" in replies[1].message
    assert worker.starts == 2


def test_the_runners_clock_counts_whatever_a_process_says_of_its_own(place, task):
    (reply,), _ = ask(place, task, "SetsItsClock", limits=PATIENT)
    assert reply.own_s == 0.0
    assert reply.seconds >= 0.3  # it sleeps so long
    assert reply.cpu_s <= reply.seconds * os.cpu_count() + 0.2


def test_nothing_is_left_of_a_scratch_folder_however_deep_it_is(place, task, monkeypatch, tmp_path):
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    (reply,), _ = ask(place, task, "DigsDeep", limits=PATIENT)
    assert reply.status == "ok", reply.message
    assert list(tmp_path.iterdir()) == []
