# SPDX-License-Identifier: Apache-2.0
"""A run on disk: rows that are read as they were written, whoever wrote them; what is wrong with a file, in a line."""

import errno
from dataclasses import replace
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sasgeo_bench.core.errors import StoreError
from sasgeo_bench.core.texts import json_text
from sasgeo_bench.geometry.pose import Pose
from sasgeo_bench.matching.matcher import Prediction
from sasgeo_bench.running import prediction_files
from sasgeo_bench.running.prediction_files import RUN, Answers, CardRecord, RunManifest, StoredAnswers, rounded
from sasgeo_bench.tasks.task_files import POSE_FIELDS

POSE = Pose(easting_m=1.0, northing_m=2.0, yaw_deg=3.0, scale=1.1)
FULL = Prediction(
    query_id="b", candidates=((POSE, 0.7), (POSE, 0.1)), confidence=0.5, diagnostics={"margin": 0.6}, latency_s=0.01
)
FAILED = Prediction(query_id="a", status="crash", message="died by SIGSEGV")


@pytest.fixture
def rows(tmp_path):
    """The table of a sound file, to be changed and written by `write`."""
    path = prediction_files.write_part(tmp_path / "sound", [FULL, FAILED])
    return pq.read_table(path)


@pytest.fixture
def write(tmp_path):
    def put(table, name="mine.parquet"):
        pq.write_table(table, tmp_path / name)
        return tmp_path / name

    return put


def refusal(read, *words):
    with pytest.raises(StoreError) as refused:
        read(*words)
    assert "\n" not in str(refused.value)
    return str(refused.value)


def everything(path):
    return list(prediction_files.read_predictions(path))


def with_column(table, name, values):
    return table.set_column(table.column_names.index(name), name, values)


def test_rows_are_read_as_they_were_written(tmp_path):
    folder = tmp_path / "run"
    prediction_files.write_part(folder, [FULL])
    prediction_files.write_part(folder, [FAILED])
    assert sorted(everything(folder), key=lambda item: item.query_id) == [FAILED, FULL]
    assert prediction_files.ids_done(folder, {"a": "", "b": ""}) == {"a", "b"}
    assert prediction_files.ids_done(folder, {"a": "", "b": ""}, again=("crash",)) == {"b"}
    assert {path.suffix for path in folder.iterdir()} == {".parquet"}


@pytest.mark.parametrize("name", prediction_files.PREDICTION_SCHEMA.names)
def test_a_column_that_is_missing_or_of_another_kind_is_refused_wherever_rows_are_read(tmp_path, rows, write, name):
    for table in (rows.drop_columns([name]), with_column(rows, name, pa.array([[True], [False]]))):
        (column, _, _) = prediction_files.differing_columns(table)[0]
        assert column == name
        path = write(table, "part-1.parquet")
        assert f"part-1.parquet holds no predictions ({name}: found " in refusal(everything, path)
        assert "holds no predictions" in refusal(prediction_files.merge_runs, [path], tmp_path / "new.parquet")
        assert "move it out of the run's folder" in refusal(prediction_files.ids_done, tmp_path, {})
    assert not (tmp_path / "new.parquet").exists()


@pytest.mark.parametrize("name", ["query_id", "confidence"])
def test_a_column_that_is_there_twice_is_refused(rows, write, name):
    path = write(rows.append_column(name, rows[name]))
    assert f"({name}: found 2 columns, expected {rows.schema.field(name).type}): 'verify'" in refusal(everything, path)
    same = pa.array([[]] * 2, type=pa.list_(pa.struct([*rows.schema.field("candidates").type.value_type] * 2)))
    assert "(candidates: found list<" in refusal(everything, write(with_column(rows, "candidates", same)))


def test_where_a_clock_was_set_back_the_row_that_was_written_last_still_counts(tmp_path, monkeypatch):
    late = replace(FAILED, status="timeout", message="too late")
    for now_ns, row in ((2_000, late), (1_000, FAILED), (1_500, replace(FAILED, status="ok", message=""))):
        monkeypatch.setattr(prediction_files.time, "time_ns", lambda now_ns=now_ns: now_ns)
        prediction_files.write_part(tmp_path / "run", [row])
    assert [item.status for item in everything(tmp_path / "run")] == ["ok"]
    assert len(prediction_files.parts_of(tmp_path / "run")) == 3
    assert prediction_files.ids_done(tmp_path / "run", {"a": ""}) == {"a"}


@pytest.mark.parametrize(
    ("name", "value", "words"),
    [
        ("query_id", None, "(query_id: found None, expected the id of a query)"),
        ("status", None, "(status: found None, expected ok, timeout"),
        ("candidates", [{"easting_m": None}], "(candidates: found easting_m is nan, expected -1e+08..1e+08)"),
        ("candidates", [{"easting_m": float("nan")}], "easting_m is nan"),
        ("candidates", [{"easting_m": 1e300}], "easting_m is 1e+300"),
        ("candidates", [{"yaw_deg": 1e300}], "yaw_deg is 1e+300, expected -1e+06..1e+06"),
        ("candidates", [{"scale": 0.0}], "(candidates: found scale is 0, expected 0.001..1000)"),
        ("candidates", [None], "(candidates: found a null, expected poses with scores)"),
        ("candidates", None, "(candidates: found null, expected a list, empty where there is no pose)"),
        ("candidates", [{}] * 1001, "(candidates: found 1001 poses, expected at most 1000)"),
        ("confidence", 1.5, "(confidence: found confidence is 1.5, expected 0..1 or null)"),
        ("latency_s", float("inf"), "(latency_s: found latency_s is inf, expected 0..604800 or null)"),
        ("latency_s", -1.0, "latency_s is -1"),
        ("message", "x" * 1_000, "expected a line of at most 300 printable characters)"),
        ("message", "two\nlines", "(message: found 'two\\nlines', expected"),
        ("diagnostics", [("margin", 1.0), ("seen", 2.0), ("margin", 3.0)], "(diagnostics: found 'margin' twice"),
        ("diagnostics", [("margin", None)], "diagnostics['margin'] is nan"),
        ("diagnostics", [("", 1.0)], "found the name '', expected names of 1..64 printable characters"),
        ("diagnostics", [(str(at), 0.0) for at in range(65)], "found 65 numbers, expected at most 64"),
    ],
)
def test_a_row_that_is_no_prediction_is_named(tmp_path, rows, name, value, words):
    row = rows.to_pylist()[0]
    if name == "candidates":
        value = value and [None if item is None else row["candidates"][0] | item for item in value]
    table = pa.Table.from_pylist([rows.to_pylist()[1], row | {name: value}], schema=prediction_files.PREDICTION_SCHEMA)
    pq.write_table(table, tmp_path / "mine.parquet")
    message = refusal(everything, tmp_path / "mine.parquet")
    assert "mine.parquet, row 1, is no prediction (" in message
    assert words in message
    assert message.endswith("'verify' says all that is wrong")


@pytest.mark.parametrize(
    ("name", "value", "words"),
    [
        ("candidates", 4_001, ", row 70, is no prediction (candidates: found 4001 items, expected at most 1000)"),
        ("diagnostics", [(str(at), 0.0) for at in range(257)], "(diagnostics: found 257 items, expected at most 64)"),
        (
            "diagnostics",
            [("a", 0.0), ("x" * 257, 0.0)],
            ", row 70, is no prediction (diagnostics: found 257 bytes in a",
        ),
        ("covariance", [1.0] * 37, ", row 70, is no prediction (covariance: found 37 items, expected at most 9)"),
        ("message", "x" * 1_201, ", row 70, is no prediction (message: found 1201 bytes, expected at most 300)"),
        ("message", "x" * 1_200_000, "bytes of texts in message, 1025200 at most: write it again"),
    ],
)
def test_lists_and_texts_far_beyond_their_bounds_are_refused_before_the_file_is_read(
    tmp_path, rows, monkeypatch, name, value, words
):
    one = rows.to_pylist()[0] | {"covariance": None, "is_accepted": None}
    value = one["candidates"][:1] * value if name == "candidates" else value
    table = pa.Table.from_pylist([one] * 70 + [one | {name: value}], schema=prediction_files.FLOWN_SCHEMA)
    pq.write_table(table, tmp_path / "mine.parquet", row_group_size=50)
    monkeypatch.setattr(prediction_files, "read_table", None)
    assert words in refusal(everything, tmp_path / "mine.parquet")


def test_only_runs_of_one_matcher_version_and_settings_are_merged(tmp_path, rows, write):
    folders = [tmp_path / name for name in ("one", "two", "three")]
    for folder, found in zip(folders, ("aa", "aa", "bb"), strict=True):
        prediction_files.write_part(folder, [FULL])
        RunManifest(hash=found, matcher=CardRecord(name="mine", version=found[0])).save(folder)
    into = tmp_path / "all.parquet"
    assert prediction_files.merge_runs(folders[:2], into) == 1
    assert prediction_files.merge_runs([folders[2], write(rows)], into) == 2  # a file does not say whose it is
    whole = into.read_bytes()
    assert "never mixed" in refusal(prediction_files.merge_runs, folders[1:], into)
    message = refusal(prediction_files.merge_runs, folders, into)
    assert f"{folders[2]} holds answers of mine b (bb), {folders[0]} those of mine a (aa)" in message
    (folders[2] / RUN).write_text('{"hash": "cc"}')
    assert "an unknown matcher (cc)" in refusal(prediction_files.merge_runs, folders, into)
    assert into.read_bytes() == whole


@pytest.mark.parametrize("text", ["", "{", "[]", "null", "3", "[" * 100_000, "\x00", '{"a": NaN}', '{"a": 1, "a": 2}'])
def test_a_damaged_run_json_is_reported_in_one_line(tmp_path, text):
    (tmp_path / RUN).write_text(text)
    line = refusal(RunManifest.open, tmp_path)
    assert "run.json is damaged (" in line
    assert line.endswith("remove it and run again, its parts are kept")


def test_what_a_run_says_of_itself_is_read_back_and_replaced_whole(tmp_path):
    assert RunManifest.open(tmp_path) is None
    for about in (RunManifest(hash="aa"), RunManifest(hash="bb", title="Köln")):
        about.save(tmp_path / "run")
        assert RunManifest.open(tmp_path / "run") == about
    assert [path.name for path in (tmp_path / "run").iterdir()] == [RUN]


def test_what_a_run_does_not_state_is_not_written_and_what_nobody_knows_is_kept(tmp_path):
    text = json_text({"matcher": {"name": "mine"}, "hash": "aa", "learned": None, "cpu_s": 3, "new": [1]})
    (tmp_path / RUN).write_text(text)
    RunManifest.open(tmp_path).save(tmp_path)
    assert (tmp_path / RUN).read_text() == text


def test_a_folder_that_cannot_be_written_is_reported_in_one_line(tmp_path):
    (tmp_path / "file").write_text("mine")
    for folder in (tmp_path / "file", tmp_path / "file" / "deep"):
        assert f"{folder}/run.json cannot be written (" in refusal(RunManifest().save, folder)
        part = refusal(prediction_files.write_part, folder, [FULL])
        assert part.startswith(f"{folder}/part-")
        assert " cannot be written (" in part
    assert (tmp_path / "file").read_text() == "mine"


def test_a_full_disk_leaves_the_run_json_that_was_there(tmp_path, monkeypatch):
    RunManifest(hash="aa").save(tmp_path)

    def full(self, text, **_):
        self.write_bytes(text[:4].encode())
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(Path, "write_text", full)
    assert "No space left on device" in refusal(RunManifest(hash="bb").save, tmp_path)
    assert RunManifest.open(tmp_path) == RunManifest(hash="aa")
    assert [path.name for path in tmp_path.iterdir()] == [RUN]


# Rows in tables


def test_the_last_row_of_a_query_counts_in_a_table_too_whatever_like_types_its_parts_have(tmp_path, rows):
    folder = tmp_path / "run"
    folder.mkdir()
    texts = with_column(rows, "status", rows["status"].cast(pa.large_string()))
    poses = [[item | {"rank": 1.0} for item in listed] for listed in rows["candidates"].to_pylist()]
    more = pa.struct([pa.field(name, pa.float32()) for name in ("rank", "score", *POSE_FIELDS[::-1])])
    ranked = with_column(rows, "candidates", pa.array(poses, pa.large_list(more)))
    single = with_column(rows, "confidence", rows["confidence"].cast(pa.float32()))
    timed = rows.append_column("matcher_s", pa.array([0.1, None]))
    for at, table in enumerate((rows, texts, ranked, single, timed)):
        pq.write_table(table, folder / f"part-{at:020d}-1.parquet")
    found = Answers.open(folder, {"a": "", "b": ""})
    assert found.found == {item.query_id: item for item in everything(folder)}
    assert sorted(Answers.read(folder).table["query_id"].to_pylist()) == ["a", "b"]
    assert Answers.open(folder, {"a": ""}).table["query_id"].to_pylist() == ["a"]


def test_stored_answers_are_those_of_their_tasks_a_task_at_a_time(rows):
    tasks = {Path("first"): rows.slice(0, 1), Path("second"): rows.slice(1, 1), Path("other"): rows.slice(0, 0)}
    read = []

    def reading(task):
        def rows_of():
            read.append(task)
            return Answers(tasks[task])

        return rows_of

    first, second = rows["query_id"].to_pylist()
    task_of = {first: Path("first"), second: Path("second"), "asked": Path("second"), "elsewhere": Path("far")}
    answers = StoredAnswers({task: reading(task) for task in tasks}, task_of)
    assert dict(answers) == {item.query_id: item for item in (FULL, FAILED)}
    assert len(answers) == 2
    read.clear()
    assert [answers.get(name) for name in (first, first, second, "asked", "elsewhere", "nobody")].count(None) == 3
    assert read == [Path("first"), Path("second")]
    read.clear()
    assert answers.some([second, first, second]) == {item.query_id: item for item in (FULL, FAILED)}
    assert answers.some([second]).keys() == {second}
    assert sorted(read) == [Path("first"), Path("second"), Path("second")]
    with pytest.raises(KeyError, match="asked"):
        answers.some([second, "asked"])
    lean = answers.lean()
    assert {name: replace(item, candidates=()) for name, item in answers.items()} == dict(lean)
    assert not any(item.candidates for item in lean.values())


def poses_of(yaw_deg, easts):
    return tuple(
        (Pose(easting_m=east, northing_m=-east, yaw_deg=(yaw_deg + at) % 360, scale=1.0 + at / 7), 0.1 * east)
        for at, east in enumerate(easts)
    )


@given(
    st.lists(st.tuples(st.floats(0, 359.9999), st.lists(st.floats(-1e6, 1e6), max_size=3)), max_size=4), st.booleans()
)
def test_answers_are_rounded_once_and_only_where_no_figure_shows_it(drawn, is_flown):
    spread = np.diag([1e-3, 2e4, 1.7]) + 0.99 * np.outer(*[np.sqrt([1e-3, 2e4, 1.7])] * 2)
    answers = [
        Prediction(
            query_id=str(number),
            candidates=poses_of(yaw_deg, easts),
            confidence=yaw_deg / 3,
            diagnostics={"ratio": yaw_deg / 7},
            latency_s=0.1 * number,
            matcher_s=0.01 * number,
            is_accepted=True if is_flown else None,
            covariance=tuple(spread.ravel().tolist()) if is_flown and number % 2 else None,
        )
        for number, (yaw_deg, easts) in enumerate(drawn)
    ]
    read = Answers.of(answers)
    assert rounded(read.table).equals(read.table)
    for exact in answers:
        found = read.found[exact.query_id]
        same = {"candidates": exact.candidates, "covariance": exact.covariance}
        assert replace(found, **same) == exact
        assert found.covariance == (exact.covariance and pytest.approx(exact.covariance, rel=2**-16))
        for (pose, score), (given_, exact_score) in zip(found.candidates, exact.candidates, strict=True):
            assert (score, pose.scale) == (exact_score, given_.scale)
            assert (pose.easting_m, pose.northing_m) == pytest.approx((given_.easting_m, given_.northing_m), abs=2**-8)
            assert abs((pose.yaw_deg - given_.yaw_deg + 180) % 360 - 180) <= 2**-8


def test_a_covariance_that_would_be_none_when_it_is_rounded_is_kept():
    narrow = np.array([[1.0, 1 - 1e-9, 0.0], [1 - 1e-9, 1.0, 0.0], [0.0, 0.0, 1 / 3]])
    item = Prediction(query_id="a", candidates=(), is_accepted=False, covariance=tuple(narrow.ravel().tolist()))
    assert Answers.of([item]).found["a"].covariance == item.covariance


def test_a_column_of_nulls_without_a_type_is_read(rows, write):
    nothing = pa.nulls(len(rows))
    path = write(rows.append_column("is_accepted", nothing).append_column("covariance", nothing))
    assert Answers.read(path).found["b"] == Answers.of([FULL]).found["b"]
