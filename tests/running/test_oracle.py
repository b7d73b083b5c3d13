# SPDX-License-Identifier: Apache-2.0
"""The control that is given the truth is right wherever there is something to be right about."""

import re
import shutil
from dataclasses import replace

import pytest

from sasgeo_bench.core.errors import StoreError
from sasgeo_bench.core.progress import Lines
from sasgeo_bench.matching.tracker import check_prediction
from sasgeo_bench.running import prediction_files
from sasgeo_bench.running.oracle import right_answer
from sasgeo_bench.running.plan import RunRequest, plan_run
from sasgeo_bench.running.prediction_files import RunManifest
from sasgeo_bench.running.runner import run
from sasgeo_bench.tasks import task_files


@pytest.fixture
def truths(place, task):
    folder = place / "out" / "truth" / task.relative_to(place / "out" / "tasks")
    return {truth.query_id: truth for truth in task_files.read_truths(folder)}


def test_every_answer_is_the_true_pose(task, truths, tmp_path):
    plan = plan_run(RunRequest(spec="oracle_pose", tasks=(task,), out=tmp_path))
    report = run(plan)
    assert report.counts == {"ok": len(truths)}
    answers = list(prediction_files.read_predictions(plan.parts[0].folder))
    assert {item.query_id for item in answers} == set(truths)
    for item in answers:
        ((pose, score),) = item.candidates
        assert (pose, score, item.confidence) == (truths[item.query_id].pose, 1.0, 1.0)
    about = RunManifest.open(plan.parts[0].folder)
    assert about.matcher.name == "oracle_pose"
    assert about.isolation == {"truth": "given, as this control needs it"}


def test_an_absent_place_is_withheld_and_a_right_candidate_is_chosen(task, truths):
    query = next(task_files.read_queries(task))
    truth = truths[query.query_id]
    absent = right_answer(query, replace(truth, is_present=False))
    assert (absent.candidates, absent.confidence) == ((), 0.0)
    assert not right_answer(query, replace(truth, pose=None)).candidates
    near = [replace(truth.pose, easting_m=truth.pose.easting_m + off, yaw_deg=0.0) for off in (400.0, 3.0, -700.0)]
    choice = replace(query, track="retrieval", candidates=tuple(near))
    found = check_prediction(right_answer(choice, replace(truth, candidate=1)), choice, top_k=1)
    assert found.candidates == ((replace(truth.pose, easting_m=near[1].easting_m), 1.0),)


def test_without_truths_the_control_says_what_it_needs(place, task, tmp_path):
    root = tmp_path / "out"
    for name in ("regions", "tasks"):
        shutil.copytree(place / "out" / name, root / name)
    moved = root / "tasks" / task.relative_to(place / "out" / "tasks")
    plan = plan_run(RunRequest(spec="oracle_pose", tasks=(moved,), out=root))
    with pytest.raises(StoreError, match="holds no truths, and oracle_pose answers with them"):
        run(plan)


def test_a_line_of_progress_says_how_many_and_how_long():
    lines = []
    progress = Lines(lines.append, every_s=0.0)
    progress.begin("clean/vaduz", 4)
    for _ in range(4):
        progress.advance("clean/vaduz", 1)
    assert [line.split(",")[0] for line in lines] == [
        f"clean/vaduz: {count} of 4" for count in range(1, 4)
    ]  # the end needs no line
    assert all(re.fullmatch(r"about \d+ s left", line.split(", ")[1]) for line in lines[1:])
    assert lines[0] == "clean/vaduz: 1 of 4"  # the first waits for what starts
    assert progress.state() == ""
