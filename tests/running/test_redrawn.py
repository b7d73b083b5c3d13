# SPDX-License-Identifier: Apache-2.0
"""Tasks that are drawn anew: a query that is the same keeps its answer, one that is not is asked again."""

import json
from dataclasses import replace

import pyarrow.parquet as pq
import pytest

from sasgeo_bench.core.errors import StoreError
from sasgeo_bench.running import answers, prediction_files
from sasgeo_bench.running.plan import RunRequest, plan_run
from sasgeo_bench.running.runner import run
from sasgeo_bench.scoring.submission_files import count_excluded, validate
from sasgeo_bench.tasks import task_files
from sasgeo_bench.tasks.query import PriorGroup
from tests import world

TOWN = "town-riverside"


@pytest.fixture
def draw(own_out):
    """Draw the task in place of whatever was drawn before."""

    def drawn(count=1, seed=0, prior=None):
        group = None if prior is None else PriorGroup.parse(prior)
        suite = "no-priors" if group is None else "clean"
        return world.drawn(own_out, suite, TOWN, count=count, seed=seed, group=group)[0]

    return drawn


def plan_of(task, **changes):
    return plan_run(replace(RunRequest(spec="oracle_pose", tasks=(task,), out=task.parents[2]), **changes))


def ask(task):
    """Ask what is left; the part as it was planned, and how many were asked."""
    plan = plan_of(task)
    report = run(plan)
    return plan.parts[0], sum(report.counts.values())


@pytest.mark.slow
def test_more_sites_fewer_sites_and_another_seed_ask_nothing_twice(draw):
    task = draw()
    few = set(task_files.Task.open(task).ids())
    assert ask(task)[1] == len(few)
    draw(count=2)
    more = set(task_files.Task.open(task).ids())
    assert few < more
    part, asked = ask(task)
    assert (set(part.left), asked) == (more - few, len(more - few))
    draw(seed=1)
    other = set(task_files.Task.open(task).ids())
    part, asked = ask(task)
    assert (asked, part.done, part.excluded) == (len(other), 0, len(more))
    draw()
    part, asked = ask(task)
    assert (part.left, asked, part.done, part.excluded) == ((), 0, len(few), len(more - few) + len(other))
    draw(count=2)
    assert ask(task)[1] == 0
    # All of it is there, and every task is answered by its own.
    assert {row.query_id for row in prediction_files.read_predictions(part.folder)} == more | other
    assert list(validate(part.folder, [task_files.Task.open(task)])) == []
    assert count_excluded(part.folder, [task_files.Task.open(task)]) == len(other)


def test_a_query_whose_content_changed_is_asked_again_and_both_answers_stay(draw, tmp_path):
    task = draw(prior="r500-weak-s3")
    before = task_files.Task.open(task).asked
    folder = ask(task)[0].folder
    draw(prior="r250-known-s3")
    after = task_files.Task.open(task).asked
    assert before.keys() == after.keys()
    assert not set(before.values()) & set(after.values())
    assert len(list(validate(folder, [task_files.Task.open(task)]))) == len(after)
    part, asked = ask(task)
    assert (asked, part.excluded) == (len(after), len(before))
    with pytest.raises(StoreError, match="and to an earlier version of it: name the tasks with --tasks"):
        prediction_files.merge_runs([folder], tmp_path / "both.parquet")
    assert prediction_files.merge_runs([folder], tmp_path / "mine.parquet", asked=after) == len(after)
    assert list(validate(tmp_path / "mine.parquet", [task_files.Task.open(task)])) == []
    found = prediction_files.Answers.open(folder, before)
    assert (found.found.keys(), found.excluded) == (before.keys(), len(after))
    draw(prior="r500-weak-s3")
    assert ask(task)[1] == 0


def test_a_task_that_is_drawn_anew_while_it_is_asked_ends_the_run(draw):
    task = draw(prior="r500-weak-s3")
    plan = plan_of(task)
    draw(prior="r250-known-s3")
    with pytest.raises(StoreError, match="was made anew while it was asked: run again, answers are kept"):
        run(plan)
    assert prediction_files.ids_done(plan.parts[0].folder, task_files.Task.open(task).asked) == set()


@pytest.mark.usefixtures("in_threads")
def test_a_map_that_is_damaged_is_no_failure_of_who_prepares_it(draw, own_out):
    plan = plan_of(draw(), spec="fft_vote")
    layers = own_out / "regions" / TOWN / "layers.tif"
    layers.write_bytes(b"x" * layers.stat().st_size)
    with pytest.raises(StoreError, match=r"layers\.tif is missing, or not what region\.json says: build"):
        run(plan)
    assert not prediction_files.parts_of(plan.parts[0].folder)


def test_another_build_of_the_map_is_another_question(draw, own_out):
    task = draw()
    plan = plan_of(task)
    path = own_out / "regions" / TOWN / "region.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | {"inputs_sha256": "0" * 64}))
    with pytest.raises(StoreError, match="was built anew since the queries"):
        plan_of(task)
    with pytest.raises(StoreError, match="was built anew while it was searched: run again"):
        answers.answer(plan, plan.parts, jobs=1, watch=answers.Watch())
    about = task / "task.json"
    before = task_files.Task.open(task).asked
    (query, *_), record = task_files.Task.open(task).some(set(before)), json.loads(about.read_text())
    assert query[2] == before[query[0].query_id]
    # Of a task of an older program the hashes are reckoned, and say as much of the map as it does.
    strip(task)
    assert task_files.Task.open(task).asked == before
    about.write_text(json.dumps(record | {"map_fingerprint": "0" * 64}))
    assert not set(task_files.Task.open(task).asked.values()) & set(before.values())


def strip(task):
    path = task / task_files.QUERIES
    pq.write_table(pq.read_table(path).drop_columns(["asked_sha256"]), path)
