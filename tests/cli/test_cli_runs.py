# SPDX-License-Identifier: Apache-2.0
"""The commands around matchers as a user meets them: made, listed, checked, run, merged and validated."""

import json
import shutil
import sys
from functools import partial
from pathlib import Path

import pyarrow.parquet as pq
import pytest

from sasgeo_bench.cli.console import CONTESTANT_FAILED
from sasgeo_bench.core.plugins import MATCHERS
from sasgeo_bench.matching.matcher import Prediction
from sasgeo_bench.running import prediction_files
from sasgeo_bench.running.prediction_files import RunManifest
from sasgeo_bench.running.testing import TOWN, check_matcher
from sasgeo_bench.tasks import task_files

SUITE = "no-priors"
TASK = Path("out") / "tasks" / SUITE / TOWN
GOOD = ("run", "--matcher", "faulty:Good", "--tasks", TASK)
# The control of the runner needs no process of its own, so that these take no time.
ORACLE = ("run", "--matcher", "oracle_pose", "--tasks", TASK)

pytestmark = pytest.mark.usefixtures("without_drawings")


@pytest.fixture
def out(program, tiny, tmp_path, monkeypatch):
    """A root of one's own with a small task, in the working folder; the faulty matchers can be imported."""
    del program  # it goes into the folder
    monkeypatch.syspath_prepend(str(Path(__file__).parents[1]))
    return Path(shutil.copytree(tiny.folder, tmp_path / "out"))


@pytest.fixture
def ids(out):
    return task_files.Task.open(out / "tasks" / SUITE / TOWN).ids()


@pytest.fixture
def mine(ids, tmp_path):
    """Write predictions to mine.parquet; sound ones unless others are given."""

    def write(predictions=None):
        answers = [Prediction(query_id=name) for name in ids] if predictions is None else predictions
        (tmp_path / "mine.parquet").unlink(missing_ok=True)
        prediction_files.write_part(tmp_path / "parts", answers).rename(tmp_path / "mine.parquet")
        return Path("mine.parquet")

    return write


@pytest.fixture
def check(program, out, tiny, monkeypatch):
    """The command check on the place that is there already."""
    del out
    monkeypatch.setattr("sasgeo_bench.running.testing.check_matcher", partial(check_matcher, place=tiny))
    return partial(program, "check")


@pytest.fixture
def run_folder(program, out, monkeypatch):
    """Where the control's rows are, in one part, after a run."""
    del out
    monkeypatch.setattr("sasgeo_bench.running.answers.PART_S", 3600.0)
    code, printed, err = program(*ORACLE)
    assert code == 0, err
    return Path(printed.strip())


def change_task(**changes):
    """Change what task.json says; None takes a key away."""
    path = TASK / "task.json"
    content = json.loads(path.read_text()) | changes
    path.write_text(json.dumps({name: value for name, value in content.items() if value is not None}))


# --- list matchers, new matcher, check ----------------------------------------------------------------------


def test_matchers_are_listed_with_where_they_come_from(program, tmp_path, monkeypatch) -> None:
    about = tmp_path / "site" / "x_own-1.0.dist-info"
    about.mkdir(parents=True)
    (about / "METADATA").write_text("Metadata-Version: 2.1\nName: x-own\nVersion: 1.0\n")
    (about / "entry_points.txt").write_text(f"[{MATCHERS}]\nmine = nowhere.to_be:Found\n")
    monkeypatch.syspath_prepend(str(about.parent))
    code, printed, err = program("list", "matchers")
    assert (code, err) == (0, "")
    head, *rows = (line.split() for line in printed.splitlines() if line)
    assert head == ["matcher", "package", "class"]
    assert ["mine", "x-own", "nowhere.to_be:Found"] in rows
    assert [row[0] for row in rows] == sorted(row[0] for row in rows)
    assert "oracle_pose" in {row[0] for row in rows}


@pytest.mark.parametrize(
    ("kind", "name", "expected"),
    [
        ("matchers", "road_2rit", "title: "),
        ("trackers", "swapf", "source: "),
        ("rejectors", "sue", "is calibrated: "),
        ("segmenters", "colour_thresholds", "classes: "),
        ("matchers", "oracle_pose", "oracle_pose: a control, given the truth, and has no card"),
    ],
)
def test_the_card_of_one_is_shown_field_by_field(kind, name, expected, program) -> None:
    code, printed, err = program("list", kind, name)
    assert (code, err) == (0, "")
    lines = printed.splitlines()
    assert lines[0].startswith(f"name: {name}" if len(lines) > 1 else expected)
    assert any(line.startswith(expected) and len(line) > len(expected) - 1 for line in lines)


@pytest.mark.parametrize(
    ("old", "new"),
    [
        (["list-matchers", "random"], ["list", "matchers", "random"]),
        (["check-tracker", "x"], ["check", "--kind", "tracker", "x"]),
        (["propose-regions", "no.toml", "--jobs", "2"], ["new-region", "--manifest", "no.toml", "--jobs", "2"]),
        (["locate-dataset", "--kind", "dense-uav", "x"], ["import-dataset", "--where", "--kind", "dense-uav", "x"]),
    ],
)
def test_the_names_of_before_still_work(old, new, program) -> None:
    assert program(*old) == program(*new)


def test_a_region_has_no_card_to_be_shown(mistake) -> None:
    assert "a region has no card: sasgeo-bench inspect vaduz shows a built one" in mistake("list", "regions", "vaduz")


def test_a_name_that_nothing_has_is_not_checked(check, mistake) -> None:
    del check
    kinds = "matcher, tracker, segmenter, suite, metric or perturbation"
    assert f"there is no {kinds} 'raster_uniformm', did you mean 'raster_uniform'?" in mistake(
        "check", "raster_uniformm"
    )


def test_a_new_matcher_is_written_and_the_next_step_is_told(program, tmp_path, monkeypatch) -> None:
    pip = tmp_path.parent / f"{tmp_path.name}-bin" / "pip"  # an environment may have been made without one
    pip.parent.mkdir()
    pip.touch(mode=0o755)
    monkeypatch.setattr(sys, "executable", str(pip.with_name("python")))
    monkeypatch.setenv("PATH", str(pip.parent))
    code, printed, err = program("new", "matcher", "my-matcher")
    assert code == 0
    assert "enter docs/results/systems-objects --matcher my-matcher" in err
    assert printed == "my-matcher: 6 files; next: pip install -e my-matcher && sasgeo-bench check my-matcher\n"
    assert (tmp_path / "my-matcher" / "src" / "my_matcher" / "matcher.py").is_file()
    monkeypatch.setenv("PATH", "")  # a pip that would install for another Python is not named
    code, printed, _ = program("new", "matcher", "other", "--into", "deep/er")
    assert f"next: {pip} install -e deep/er && " in printed
    assert (code, printed.split(":")[0]) == (0, "deep/er")
    assert (tmp_path / "deep" / "er" / "pyproject.toml").is_file()


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        (("My Matcher",), "lower-case letters, digits, hyphens and underscores"),
        (("../x",), "lower-case letters, digits, hyphens and underscores"),
        (("numpy",), "cannot be a package: it is taken"),
        (("oracle_pose",), "is a matcher of sasgeo-bench itself"),
        (("mine", "--into", "full"), "full is there already and not empty"),
        (("mine", "--into", "full/file"), "full/file is there already and not empty"),
        (("mine", "--into", "full/file/deep"), "full/file/deep cannot be written"),
    ],
)
def test_a_matcher_that_cannot_be_made_gets_one_line_and_nothing_is_written(mistake, tmp_path, words, expected) -> None:
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "file").write_text("")
    assert expected in mistake("new", "matcher", *words)
    assert sorted(path.name for path in tmp_path.rglob("*")) == ["file", "full"]


def test_a_good_matcher_gets_a_table_and_exit_0(check) -> None:
    code, given, err = check("faulty:Good")
    assert (code, err) == (0, "")
    assert given.splitlines()[0].split() == ["check", "outcome", "found"]
    assert " fail " not in given
    assert given.count(" pass ") == 13


@pytest.mark.parametrize(
    ("spec", "words"),
    [
        ("faulty:NoCard", "faulty:NoCard: card is a NoneType, expected a sasgeo_bench.matching.matcher.MatcherCard"),
        ("sasgeo_bench.matching.controls.reckoning:DeadReckoning", "it follows flights: check it as a tracker"),
    ],
)
def test_a_matcher_with_a_fault_gets_its_row_a_line_on_stderr_and_exit_2(check, spec, words) -> None:
    code, given, err = check(spec)
    assert code == 2
    assert [line for line in given.splitlines() if " fail " in line and words in line]
    assert err == f"{spec}: 1 check failed\n"


# --- run ------------------------------------------------------------------------------------------------------------


def test_a_run_says_what_is_left_is_cut_off_goes_on_and_is_validated_and_merged(program, out, ids) -> None:
    code, printed, err = program(*GOOD, "--dry-run")
    assert (code, err) == (0, "")
    assert "good 1 (" in printed
    assert f"{len(ids)} queries left, 0 done" in printed
    assert not (out / "runs").exists()
    code, printed, err = program(*GOOD, "--limit", "2")
    assert (code, err) == (0, "good, version 1: 2 ok\n")
    folder = Path(printed.strip())
    assert folder.parts[:3] == ("out", "runs", "good")
    code, printed, err = program("validate", "--predictions", folder, "--tasks", TASK)
    assert (code, err) == (2, f"{folder}: {len(ids) - 2} violations\n")
    assert all(line.endswith("expected one for every query") for line in printed.splitlines())
    code, printed, err = program(*GOOD, "--jobs", "2")
    assert (code, printed, err) == (0, f"{folder}\n", f"good, version 1: {len(ids) - 2} ok\n")
    code, printed, err = program("validate", "--predictions", folder, "--tasks", TASK)
    assert (code, printed, err) == (0, f"{folder}: answers every query of 1 task, and nothing else\n", "")
    code, printed, err = program("merge", "--runs", folder, "--into", "all.parquet")
    assert (code, printed, err) == (0, f"all.parquet: {len(ids)} predictions\n", "")


def test_a_second_run_says_that_nothing_is_left(program, run_folder, ids) -> None:
    code, printed, err = program(*ORACLE)
    assert (code, printed) == (0, f"{run_folder}\n")
    assert f"{run_folder}: nothing left, {len(ids)} done" in err
    code, printed, _ = program(*ORACLE, "--dry-run")
    assert f"0 queries left, {len(ids)} done" in printed


def test_several_tasks_are_run_and_validated_at_once(program, out) -> None:
    del out
    tasks = ("--tasks", TASK, "--tasks", TASK.parent.parent / "clean" / TOWN)
    code, printed, _ = program("run", "--matcher", "oracle_pose", *tasks)
    folders = printed.splitlines()
    assert (code, len(folders)) == (0, 2)
    merged = (word for folder in folders for word in ("--runs", folder))
    assert program("merge", *merged, "--into", "all.parquet")[0] == 0
    code, printed, _ = program("validate", "--predictions", "all.parquet", *tasks)
    assert (code, printed) == (0, "all.parquet: answers every query of 2 tasks, and nothing else\n")


def test_a_run_without_a_sound_row_ends_with_a_status_that_a_script_sees(program, out, ids) -> None:
    code, printed, err = program("run", "--matcher", "faulty:RaisesInPrepare", "--tasks", TASK)
    assert code == CONTESTANT_FAILED
    assert f"{len(ids)} crash" in err
    assert err.splitlines()[-1] == "no query was answered, so the command ends with status 4; the rows are kept"
    assert len(prediction_files.read_ties(out.parent / printed.strip())) == len(ids)
    again = program("run", "--matcher", "faulty:RaisesInPrepare", "--tasks", TASK)
    assert again[0] == 0, again[2]  # nothing was left to ask
    assert f": {len(ids)} earlier queries ended as crash; --again crash asks again\n" in again[2]
    assert (
        f": {len(ids)} crash"
        in program("run", "--matcher", "faulty:RaisesInPrepare", "--tasks", TASK, "--again", "crash")[2]
    )


def test_of_many_tasks_the_first_are_named_and_the_rest_counted(program, run_folder, ids, monkeypatch) -> None:
    monkeypatch.setattr("sasgeo_bench.running.plan.MOST_LINES", 1)
    monkeypatch.setattr("sasgeo_bench.running.runner.MOST_LINES", 0)
    other = TASK.parent.parent / "clean" / TOWN
    more = len(task_files.Task.open(other).ids())
    code, printed, _ = program(*ORACLE, "--tasks", other, "--dry-run")
    assert (code, printed.splitlines()[1:]) == (
        0,
        [
            f"  {run_folder}: 0 queries left, {len(ids)} done",
            f"  1 more tasks: {more} queries left, 0 done",
            f"  all 2 tasks: {more} queries left, {len(ids)} done",
        ],
    )
    code, _, err = program(*ORACLE, "--tasks", other)
    assert (code, err.splitlines()[0]) == (0, "oracle_pose: nothing left in 1 of 2 tasks")


def test_answers_to_what_a_query_was_are_set_aside_by_validate_and_merge(program, mistake, run_folder, ids) -> None:
    prediction_files.write_part(run_folder, [Prediction(query_id=ids[0])], asked={ids[0]: "0" * 64})
    code, printed, err = program("validate", "--predictions", run_folder, "--tasks", TASK)
    assert (code, err) == (0, "")
    assert printed == f"{run_folder}: answers every query of 1 task, 1 answer to other queries set aside\n"
    code, printed, _ = program(*ORACLE, "--dry-run")
    assert f"0 queries left, {len(ids)} done, 1 answer to other queries set aside" in printed
    words = ("merge", "--runs", run_folder, "--into", "mine.parquet")
    assert mistake(*words).endswith("name the tasks with --tasks")
    code, printed, _ = program(*words, "--tasks", TASK)
    assert (code, printed) == (0, f"mine.parquet: {len(ids)} predictions\n")
    assert all(
        item.candidates or item.query_id != ids[0] for item in prediction_files.read_predictions(Path("mine.parquet"))
    )


@pytest.mark.parametrize("text", ["", "1/", "-1/2", "1/2/3", "1/2 ", "²/2"])
def test_a_shard_that_is_none_gets_one_line(mistake, out, text) -> None:
    assert f"--shard must be i/n, as in 1/2, got {text!r}" in mistake(*ORACLE, f"--shard={text}")
    assert not (out / "runs").exists()


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        (("--shard", "0/2"), "--shard must be i/n with 1 <= i <= n, got 0/2"),
        (("--limit", "-1"), "--limit must be at least 1, got -1"),
        (("--match-s", "30s"), "'--match-s': give the number alone, no unit"),
        (("--match-s", "nan"), "--match-s must be seconds between 0 and 604800, got nan"),
        (("--memory-mb", "1"), "--memory-mb must lie between 64 and 4000000, got 1"),
        (("--scratch-mb", "0"), "--scratch-mb must lie between 1 and 4000000, got 0"),
        (
            ("--again", "late"),
            "--again must be one of ok, timeout, crash, invalid, refused, not applicable, got 'late'",
        ),
        (("--most-trained", "0"), "--most-trained must lie between 1 and 2000, got 0"),
        (("--tasks", "nowhere"), "there is no folder nowhere: make the queries first (make-queries, "),
        (("--tasks", f"{TASK}x"), f"there is no folder {TASK}x: did you mean {TASK}?"),
        (("--tasks", str(Path(TASK).parent)), f"holds no task.json: name a task in it, as {TASK}, or all by a *"),
        (("--out", "a-file"), "cannot be written (Not a directory)"),
    ],
)
def test_a_run_that_makes_no_sense_gets_one_line_and_nothing_is_written(mistake, out, words, expected) -> None:
    Path("a-file").write_text("")
    assert expected in mistake(*ORACLE, *words)
    assert not (out / "runs").exists()


def test_a_matcher_that_does_not_learn_says_so(program, out) -> None:
    del out
    code, printed, err = program(*ORACLE, "--train", TASK, "--dry-run")
    assert (code, err) == (0, "")
    assert printed.splitlines()[1] == "  has no learn(): training data are ignored"


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"map_fingerprint": "0" * 64}, "was built anew since the queries of"),
        ({"region": "elsewhere"}, "elsewhere holds no region.json: build the region first"),
        ({"region": "../../.."}, "is damaged (task.json: 'region'"),
    ],
)
def test_a_task_that_cannot_be_asked_gets_one_line(mistake, out, changes, words) -> None:
    change_task(**changes)
    assert words in mistake(*ORACLE)
    assert not (out / "runs").exists()


def edit_run(folder: Path, **card: str) -> None:
    """Make a run one of another matcher."""
    about = RunManifest.open(folder)
    about.model_copy(update={"hash": "0" * 12, "matcher": about.matcher.model_copy(update=card)}).save(folder)


# --- merge ----------------------------------------------------------------------------------------------------------


def test_what_cannot_be_merged_gets_one_line_and_nothing_is_written(mistake, mine, out) -> None:
    del out
    Path("notes.txt").write_text("hello")
    rows = mine()
    for file, words in (
        ("nowhere", "nowhere holds no predictions: run a matcher first, or name a predictions file"),
        ("notes.txt", "notes.txt cannot be read ("),
        (TASK / task_files.QUERIES, "holds no predictions (candidates: found list"),
    ):
        assert words in mistake("merge", "--runs", rows, "--runs", file, "--into", "new.parquet")
    for into, words in (
        ("notes.txt", "notes.txt is no predictions file and would be lost: name another one"),
        (TASK / task_files.QUERIES, "is no predictions file and would be lost"),
        ("notes.txt/new.parquet", "notes.txt/new.parquet cannot be written ("),
    ):
        assert words in mistake("merge", "--runs", rows, "--into", into)
    assert Path("notes.txt").read_text() == "hello"
    assert sorted(path.name for path in Path().glob("*.parquet*")) == ["mine.parquet"]


# --- validate -------------------------------------------------------------------------------------------------------


def test_missing_double_and_foreign_rows_get_a_line_each_and_exit_2(program, mine, ids) -> None:
    names = [*ids[1:], ids[1], "feedfeed"]
    count = len(ids)
    path = mine([Prediction(query_id=name) for name in names])
    code, printed, err = program("validate", "--predictions", path, "--tasks", TASK)
    assert (code, err) == (2, "mine.parquet: 3 violations\n")
    found = f"{ids[1]} again (mine.parquet, row 0)"
    assert printed.splitlines() == [
        f"mine.parquet, row {count - 1}, query_id: found {found}, expected each query once",
        f"mine.parquet, row {count}, query_id: found 'feedfeed', expected the id of a query of the tasks",
        f"mine.parquet, query_id: found no row for {ids[0]}, expected one for every query",
    ]


def test_of_many_queries_without_a_row_some_are_named_and_the_rest_counted(program, mine, ids, monkeypatch) -> None:
    monkeypatch.setattr("sasgeo_bench.cli.verifying.MOST_MISSING", 2)
    path = mine([Prediction(query_id=ids[0])])
    code, printed, err = program("validate", "--predictions", path, "--tasks", TASK)
    assert (code, err) == (2, f"mine.parquet: {len(ids) - 1} violations\n")
    *named, last = printed.splitlines()
    assert [line.split()[6].rstrip(",") for line in named] == ids[1:3]
    assert last.startswith(f"mine.parquet, query_id: found no row for {len(ids) - 3} more quer")


def test_a_column_that_is_missing_is_told_once_and_not_for_every_query(program, mine) -> None:
    path = mine()
    pq.write_table(pq.read_table(path).drop_columns(["latency_s", "query_id"]), path)
    code, printed, err = program("validate", "--predictions", path, "--tasks", TASK)
    assert (code, err) == (2, "mine.parquet: 2 violations\n")
    assert printed.splitlines() == [
        "mine.parquet, query_id: found nothing, expected a column of string",
        "mine.parquet, latency_s: found nothing, expected a column of double",
    ]


@pytest.mark.parametrize(
    ("version", "words"), [(0, "has task version 0, this version reads"), (None, "'task_version' is missing")]
)
def test_predictions_for_a_task_of_another_version_are_not_validated(mistake, mine, version, words) -> None:
    path = mine()
    change_task(task_version=version)
    given = mistake("validate", "--predictions", path, "--tasks", TASK)
    assert words in given
    assert given.endswith("make the queries again")


def test_a_path_that_no_disk_takes_gets_one_line(mistake, mine) -> None:
    path, name = mine(), "x" * 300
    for words in (
        ("score", "--predictions", name),
        ("validate", "--predictions", name, "--tasks", TASK),
        ("validate", "--predictions", path, "--tasks", name),
        ("leaderboard", f"{name}.toml"),
    ):
        given = mistake(*words)
        assert "File name too long; check the path, your rights and the free space: xxx" in given
    for truth, fault in (("nowhere", "where there is no folder"), ("out/tasks", "which holds no truths")):
        assert f"--truth names {truth}, {fault}" in mistake("score", "--predictions", path, "--truth", truth)
    assert "--name must hold letters" in mistake("score", "--predictions", path, "--name", name)


def test_the_runs_of_two_matchers_are_not_validated_as_one(mistake, run_folder) -> None:
    other = Path(shutil.copytree(run_folder, run_folder.parents[3] / "other" / "x" / SUITE / TOWN))
    edit_run(other, name="other")
    given = mistake("validate", "--predictions", run_folder.parents[3], "--tasks", TASK)
    assert given.endswith("two matchers, versions or settings are never mixed, name the folder of one")


def test_what_cannot_be_validated_at_all_gets_one_line(mistake, mine) -> None:
    path = mine()
    words = ("validate", "--predictions")
    assert "there is no folder nowhere: make the queries first" in mistake(*words, path, "--tasks", "nowhere")
    for more in ((), ("--tasks", TASK)):  # what is wrong with the answers is told first
        assert "there is no region, task, split or run 'nowhere'" in mistake(*words, "nowhere", *more)
    assert "mine.parquet holds answers: name --tasks, task folders or the stored results" in mistake(*words, path)
    path.write_bytes(path.read_bytes()[:-100])
    assert "mine.parquet cannot be read (" in mistake(*words, path, "--tasks", TASK)
    queries = TASK / task_files.QUERIES
    queries.write_bytes(queries.read_bytes()[:-100])
    assert "queries.parquet cannot be read (" in mistake(*words, path, "--tasks", TASK)
