# SPDX-License-Identifier: Apache-2.0
"""Rows of trackers: covariances that are none are named, and a submission keeps what a tracker says of its fixes."""

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from sasgeo_bench.core.config import parse_toml
from sasgeo_bench.geometry.pose import Pose
from sasgeo_bench.matching.matcher import Prediction
from sasgeo_bench.matching.submission import AnsweredTask, Card, Submission, example_card
from sasgeo_bench.running import prediction_files
from sasgeo_bench.running.prediction_files import FLOWN_SCHEMA, prediction_row, row_faults
from sasgeo_bench.scoring.submission_files import predictions_name, read_submission, write_submission

SURE = tuple(np.diag([4.0, 4.0, 1.0]).ravel().tolist())
HERE = Pose(easting_m=0.0, northing_m=0.0, yaw_deg=0.0)


def fix(query_id="a", **changes):
    given = {"candidates": ((HERE, 1.0),), "is_accepted": False, "covariance": SURE} | changes
    return Prediction(query_id=query_id, **given)


def faults(covariance):
    row = prediction_row(fix()) | {"covariance": covariance}
    return list(row_faults(pa.Table.from_pylist([prediction_row(fix()), row], schema=FLOWN_SCHEMA)))


@pytest.mark.parametrize(
    ("covariance", "found", "expected"),
    [
        ([1.0] * 8, "8 numbers", "9 numbers, or null"),
        ([], "0 numbers", "9 numbers, or null"),
        ([*SURE[:8], float("inf")], "a number beyond that", "numbers within 1e+12"),
        ([*SURE[:8], float("nan")], "a number beyond that", "numbers within 1e+12"),
        ([*SURE[:8], None], "a number beyond that", "numbers within 1e+12"),
        ([0.0] * 9, "a matrix that is none", "a symmetric and positive definite matrix"),
        ([1.0] * 9, "a matrix that is none", "a symmetric and positive definite matrix"),
        ([4.0, 9.0, 0.0, 0.0, 4.0, 0.0, 0.0, 0.0, 1.0], "a matrix that is none", "a symmetric"),
        ([-4.0, 0.0, 0.0, 0.0, 4.0, 0.0, 0.0, 0.0, 1.0], "a matrix that is none", "a symmetric"),
    ],
)
def test_a_covariance_that_is_none_is_named(covariance, found, expected) -> None:
    (fault,) = faults(covariance)
    assert (fault.row, fault.column, fault.found) == (1, "covariance", found)
    assert fault.expected.startswith(expected)


@pytest.mark.parametrize("covariance", [None, list(SURE)])
def test_a_covariance_and_none_at_all_are_sound(covariance) -> None:
    assert faults(covariance) == []


def test_a_submission_keeps_what_a_tracker_says_of_its_fixes(tmp_path) -> None:
    asked = AnsweredTask(suite="flight-clean", region="here", queries_sha256="0" * 64, queries=2, answered=2)
    submission = Submission(
        schema_version=1,
        card=parse_toml(example_card("mine"), Card, source="card"),
        board="demo",
        split="crossfit",
        task_version=1,
        data_version=1,
        scorer_version=1,
        made_by="sasgeo-bench test",
        tasks=[asked],
        files={},
        licence="ODbL-1.0",
        attribution="OpenStreetMap",
    )
    given = [fix("a"), fix("b", is_accepted=True, covariance=None)]
    write_submission(tmp_path / "mine", submission, given, {"a": "0", "b": "1"})
    path = tmp_path / "mine" / predictions_name("mine")
    assert read_submission(tmp_path / "mine").card.name == "mine"
    found = {item.query_id: item for item in prediction_files.read_predictions(path)}
    assert [(found[name].is_accepted, found[name].covariance) for name in "ab"] == [(False, SURE), (True, None)]
    single = [fix(name, is_accepted=None, covariance=None) for name in "ab"]
    write_submission(tmp_path / "mine", submission, single, {"a": "0", "b": "1"})
    assert "is_accepted" not in pq.read_schema(path).names
