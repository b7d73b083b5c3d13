# SPDX-License-Identifier: Apache-2.0
"""A predictions file is the contract of a submission: every violation is named by row and column."""

import shutil
from dataclasses import replace

import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from sasgeo_bench.core.errors import StoreError
from sasgeo_bench.geometry.pose import Pose
from sasgeo_bench.matching.matcher import Prediction
from sasgeo_bench.running import prediction_files
from sasgeo_bench.scoring.submission_files import validate
from sasgeo_bench.tasks import task_files
from sasgeo_bench.tasks.build import make_tasks
from sasgeo_bench.tasks.task_plan import TaskRequest, plan_requests

POSE = Pose(easting_m=299_878.0, northing_m=5_458_887.0, yaw_deg=3.0)  # amid town-riverside


@pytest.fixture(scope="module")
def task(tmp_path_factory):
    out = tmp_path_factory.mktemp("validate")
    wanted = TaskRequest(
        suites=("false-unknown",), regions=("town-riverside",), split="crossfit", count=1, seed=3, out=out
    )
    return make_tasks(plan_requests(wanted)[0])[0].folder


@pytest.fixture
def answers(task):
    return [
        Prediction(query_id=name, candidates=((POSE, 1.0),), confidence=0.5)
        for name in task_files.Task.open(task).ids()
    ]


def faults(tmp_path, task, predictions):
    path = tmp_path / "mine.parquet"
    rows = [prediction_files.prediction_row(item) for item in predictions]
    pq.write_table(pa.Table.from_pylist(rows, schema=prediction_files.PREDICTION_SCHEMA), path)
    return [(item.row, item.column, item.found, item.expected) for item in validate(path, [task_files.Task.open(task)])]


def test_a_sound_file_has_no_violation(tmp_path, task, answers):
    assert faults(tmp_path, task, answers) == []
    withheld = replace(answers[0], candidates=(), confidence=0.0)
    late = replace(answers[1], candidates=(), confidence=None, status="timeout", message="late")
    assert faults(tmp_path, task, [withheld, late, *answers[2:]]) == []


@pytest.mark.parametrize(
    ("change", "column", "found"),
    [
        ({"confidence": 1.5}, "confidence", "confidence is 1.5"),
        ({"confidence": float("nan")}, "confidence", "confidence is nan"),
        ({"candidates": ((POSE, float("inf")),)}, "candidates", "score is inf"),
        ({"candidates": ((POSE, 1.0), (POSE, 2.0))}, "candidates", "scores rise from 1 to 2 at place 1"),
        ({"status": "fine"}, "status", "'fine'"),
        ({"status": "crash"}, "candidates", "1 pose"),
        ({"latency_s": -1.0}, "latency_s", "latency_s is -1"),
        ({"latency_s": float("inf")}, "latency_s", "latency_s is inf"),
        ({"message": "x" * 1_000}, "message", "'" + "x" * 127),
        ({"diagnostics": {"x" * 65: 1.0}}, "diagnostics", f"the name '{'x' * 65}'"),
        ({"query_id": "0" * 24}, "query_id", f"'{'0' * 24}'"),
        ({"diagnostics": {"margin": float("nan")}}, "diagnostics", "diagnostics['margin'] is nan"),
        ({"diagnostics": {"confidence": float("nan")}}, "diagnostics", "diagnostics['confidence'] is nan"),
    ],
)
def test_a_fault_is_named_by_its_row_and_column(tmp_path, task, answers, change, column, found):
    broken = [*answers[:2], replace(answers[2], **change), *answers[3:]]
    listed = faults(tmp_path, task, broken)
    assert listed[0][:3] == (2, column, found)
    assert listed[0][3]


@pytest.mark.parametrize(
    ("change", "column"),
    [
        ({"latency_s": -1.0}, "latency_s"),
        ({"status": "crash"}, "candidates"),
        ({"candidates": ((POSE, 1.0), (POSE, 2.0))}, "candidates"),
    ],
)
def test_a_row_with_an_unknown_or_a_repeated_id_has_all_faults_listed(tmp_path, task, answers, change, column):
    for name in ("f" * 24, answers[0].query_id):
        broken = [*answers[:2], replace(answers[2], query_id=name, **change), *answers[3:]]
        found = [one[1] for one in faults(tmp_path, task, broken) if one[0] == 2]
        assert found == ["query_id", column]


@pytest.mark.parametrize("moved", [{"easting_m": 301_400.0}, {"northing_m": 5_457_365.0}, {"easting_m": 11.65}])
def test_a_pose_outside_of_the_region_is_named(tmp_path, task, answers, moved):
    # The map is 1024 m wide; a disc of 500 m that holds a place of it ends 1000 m beyond its rim.
    away = replace(answers[2], candidates=((POSE, 1.0), (replace(POSE, **moved), 0.5)))
    ((row, column, found, expected),) = faults(tmp_path, task, [*answers[:2], away, *answers[3:]])
    assert (row, column) == (2, "candidates")
    assert "outside of town-riverside" in found
    assert expected == "eastings of 298366..301390 m and northings of 5457375..5460399 m"
    near = replace(answers[2], candidates=((replace(POSE, easting_m=301_380.0), 1.0),))
    assert faults(tmp_path, task, [*answers[:2], near, *answers[3:]]) == []


def test_without_a_map_beside_the_tasks_nobody_says_what_is_outside(tmp_path, task, answers):
    alone = tmp_path / "alone" / "tasks" / "false-unknown" / "town-riverside"
    shutil.copytree(task, alone)
    away = replace(answers[0], candidates=((replace(POSE, easting_m=0.0), 1.0),))
    assert faults(tmp_path, alone, [away, *answers[1:]]) == []


def test_a_pose_without_a_place_is_named(tmp_path, task, answers):
    path = tmp_path / "mine.parquet"
    rows = [prediction_files.prediction_row(item) for item in answers]
    rows[1]["candidates"][0]["easting_m"] = float("nan")
    rows[2]["candidates"][0]["score"] = None
    pq.write_table(pa.Table.from_pylist(rows, schema=prediction_files.PREDICTION_SCHEMA), path)
    listed = [(item.row, item.column) for item in validate(path, [task_files.Task.open(task)])]
    assert listed == [(1, "candidates"), (2, "candidates")]
    (fault, _) = validate(path, [task_files.Task.open(task)])
    assert fault.to_text() == "mine.parquet, row 1, candidates: found easting_m is nan, expected -1e+08..1e+08"


def test_missing_and_double_rows_are_named(tmp_path, task, answers):
    listed = faults(tmp_path, task, [*answers[1:], answers[1]])
    assert [item[:2] for item in listed] == [(len(answers) - 1, "query_id"), (-1, "query_id")]
    assert answers[0].query_id in listed[1][2]


def test_columns_that_are_missing_or_of_another_kind_are_named(tmp_path, task, answers):
    path = tmp_path / "mine.parquet"
    full = pa.Table.from_pylist(
        [prediction_files.prediction_row(item) for item in answers], schema=prediction_files.PREDICTION_SCHEMA
    )
    pq.write_table(full.drop_columns(["confidence"]), path)
    assert ("confidence", "nothing") in [
        (item.column, item.found) for item in validate(path, [task_files.Task.open(task)])
    ]
    pq.write_table(full.set_column(0, "query_id", pa.array(range(len(answers)))), path)
    assert ("query_id", "int64") in [(item.column, item.found) for item in validate(path, [task_files.Task.open(task)])]


@pytest.mark.parametrize("change", [{"query_id": None}, {"status": None}])
def test_a_null_where_something_must_stand_is_named(tmp_path, task, answers, change):
    listed = faults(tmp_path, task, [replace(answers[0], **change), *answers[1:]])
    assert listed[0][:3] == (0, *change, "None")


def test_more_columns_in_any_order_do_no_harm(tmp_path, task, answers):
    path = tmp_path / "mine.parquet"
    rows = [prediction_files.prediction_row(item) for item in answers]
    full = pa.Table.from_pylist(rows, schema=prediction_files.PREDICTION_SCHEMA)
    pq.write_table(full.select(full.column_names[::-1]).append_column("rank", pa.array(range(len(rows)))), path)
    assert list(validate(path, [task_files.Task.open(task)])) == []
    candidates = pa.array([[item | {"rank": 1} for item in row["candidates"]] for row in rows])
    pq.write_table(full.set_column(1, "candidates", candidates), path)
    assert list(validate(path, [task_files.Task.open(task)])) == []
    assert {item.candidates for item in prediction_files.read_predictions(path)} == {((POSE, 1.0),)}


def test_a_truncated_file_gets_one_line(tmp_path, task, answers):
    faults(tmp_path, task, answers)
    path = tmp_path / "mine.parquet"
    path.write_bytes(path.read_bytes()[:-100])
    with pytest.raises(StoreError, match="cannot be read"):
        list(validate(path, [task_files.Task.open(task)]))
    with pytest.raises(StoreError, match="holds no predictions"):
        list(prediction_files.read_predictions(tmp_path / "nowhere"))
