# SPDX-License-Identifier: Apache-2.0
"""Answers of matchers that look at rendered imagery are tied to it; those of all others are not."""

import shutil
from dataclasses import replace

import pytest

from sasgeo_bench.running.plan import RunRequest, plan_run
from sasgeo_bench.running.prediction_files import RunManifest
from sasgeo_bench.running.runner import run
from sasgeo_bench.scoring.submission_files import validate
from sasgeo_bench.sensing.reference_imagery import Look, render_imagery
from sasgeo_bench.tasks.suites.base import Choice
from sasgeo_bench.tasks.task_files import Task
from tests import world

TOWN = "town-riverside"
LOOK = Look(gsd_m=2.0)


@pytest.fixture
def draw(own_out):
    """Draw a site's queries of a suite, and return the task."""

    def drawn(suite, *kinds):
        return world.drawn(own_out, suite, TOWN, choice=Choice(kinds=kinds))[0]

    return drawn


def plan_of(task, spec):
    return plan_run(RunRequest(spec=spec, tasks=(task,), out=task.parents[2]))


def ask(task, spec):
    """Ask what is left; the statuses of what was asked."""
    return run(plan_of(task, spec)).counts


def about(task, spec):
    plan = plan_of(task, spec)
    return RunManifest.open(plan.parts[0].folder)


@pytest.mark.slow
@pytest.mark.usefixtures("in_threads")
def test_only_who_looks_at_imagery_is_asked_again_after_it_was_rendered_anew(draw):
    plain, seen = draw("clean"), draw("aerial", "P1 height")
    folder = plain.parents[2] / "regions" / TOWN
    ask(plain, "oracle_pose")
    bare = about(plain, "oracle_pose").map_bytes
    (count,) = ask(seen, "orb_vlad").values()
    assert about(seen, "orb_vlad").model_fields_set == about(plain, "oracle_pose").model_fields_set
    assert about(seen, "orb_vlad").rendered_imagery is about(plain, "oracle_pose").rendered_imagery is None

    render_imagery(folder, folder, LOOK)
    assert not ask(plain, "oracle_pose")
    assert ask(plain.parents[1] / "clean" / TOWN, "prior_centre")
    assert about(plain, "prior_centre").map_bytes < bare + 5_000  # region.json says a little more
    assert ask(seen, "orb_vlad") == {"ok": count}
    assert not ask(seen, "orb_vlad")
    first = about(seen, "orb_vlad")
    kept = shutil.copytree(folder, folder.parents[1] / "kept")
    assert first.map_bytes > bare + 50_000
    assert first.rendered_imagery == plan_of(seen, "orb_vlad").parts[0].imagery
    assert not list(validate(plan_of(seen, "orb_vlad").parts[0].folder, [Task.open(seen)]))

    render_imagery(folder, folder, replace(LOOK, seed=1))
    assert plan_of(seen, "orb_vlad").parts[0].excluded == 2 * count
    assert ask(seen, "orb_vlad") == {"ok": count}
    assert not ask(plain, "oracle_pose")
    shutil.rmtree(folder)
    kept.rename(folder)
    assert not ask(seen, "orb_vlad")  # the first imagery again: its answers count again


def test_a_damaged_hash_of_imagery_is_refused():
    with pytest.raises(ValueError, match="rendered_imagery is 7, expected a hash"):
        RunManifest.model_validate({"rendered_imagery": 7})
