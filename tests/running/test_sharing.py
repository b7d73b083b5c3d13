# SPDX-License-Identifier: Apache-2.0
"""Tasks on one map share a process, and nothing else: rows, costs and failures are those of each task."""

import json
import shutil
import sys
import threading
import time
from dataclasses import replace
from types import SimpleNamespace

import pytest

from sasgeo_bench.core.folders import locked
from sasgeo_bench.core.progress import Lines, reporting
from sasgeo_bench.running import answers, prediction_files, runner, sandbox
from sasgeo_bench.running.plan import RunRequest, by_map, plan_run
from sasgeo_bench.running.prediction_files import RunManifest
from sasgeo_bench.running.runner import run
from sasgeo_bench.running.worker import Limits

TOWN, COPY = "town-riverside", "town-copy"
PATIENT = Limits(match_s=600.0)  # what answers is never late, however busy the machine is
HAS_LANDLOCK = sandbox.landlock_version() > 0


@pytest.fixture
def pair(place):
    """Two tasks on one map."""
    return tuple(place / "out" / "tasks" / suite / TOWN for suite in ("false-unknown", "clean"))


@pytest.fixture
def elsewhere(place, pair):
    """The second of them once more, on a map of its own."""
    copy = pair[1].with_name(COPY)
    for folder in (pair[1], place / "out" / "regions" / TOWN):
        shutil.copytree(folder, folder.with_name(COPY))
    about = json.loads((copy / "task.json").read_text())
    (copy / "task.json").write_text(json.dumps(about | {"region": COPY}))
    yield copy
    for folder in (copy, place / "out" / "regions" / COPY):
        shutil.rmtree(folder)


def plan_of(tasks, out, name="TellsProcess", **changes):
    request = RunRequest(spec=f"hostile:{name}", tasks=tasks, out=out, limits=PATIENT, limit=2)
    return plan_run(replace(request, **changes))


def rows(part):
    return {
        item.query_id: replace(item, latency_s=None, matcher_s=None)
        for item in prediction_files.read_predictions(part.folder)
    }


def told(part, name):
    return {row.diagnostics[name] for row in rows(part).values()}


def quiet(_):
    return None


@pytest.mark.parametrize("jobs", [1, 2])
def test_tasks_on_one_map_share_a_process_and_no_process_has_two_maps(pair, elsewhere, tmp_path, jobs):
    plan = plan_of((pair[0], elsewhere, pair[1]), tmp_path, jobs=jobs)
    assert run(plan).counts == {"ok": 6}
    for part in plan.parts:
        assert set(rows(part)) == set(part.task.ids()[:2])
        assert told(part, "maps") == {1.0}
        assert told(part, "readable maps") == {1.0} or not HAS_LANDLOCK
        about = RunManifest.open(part.folder)
        assert (about.suite, about.region) == part.task.manifest.name
        assert about.prepare_s > 0
        assert about.peak_bytes > 0
        assert about.isolation["truth"]
    first, other, second = (told(part, "process") for part in plan.parts)
    assert len(first) == 1
    assert first == second != other


def test_processor_seconds_are_those_of_a_tasks_own_queries(pair, tmp_path):
    plan = plan_of(pair, tmp_path, name="Works", limit=1)
    run(plan)
    for part in plan.parts:  # each query takes 0.2 s of a processor; one was asked twice, and counts once
        assert 0.2 <= RunManifest.open(part.folder).cpu_s < 0.39
    before = RunManifest.open(plan.parts[0].folder).cpu_s
    run(plan_of(pair[:1], tmp_path, name="Works", limit=2))
    assert RunManifest.open(plan.parts[0].folder).cpu_s >= before + 0.2


def test_a_crash_costs_one_row_of_one_task(pair, tmp_path):
    plan = plan_of(pair, tmp_path, name="ExitsOnce")
    report = run(plan)
    assert report.counts == {"ok": 3, "crash": 1}
    assert report.messages == {"crash": "ended with exit status 3"}
    crashed, fine = (rows(part) for part in plan.parts)
    assert [crashed[name].status for name in plan.parts[0].left] == ["ok", "crash"]
    assert {row.status for row in fine.values()} == {"ok"}
    assert told(plan.parts[1], "maps") == {1.0}  # by a fresh process, which had prepared the map again
    assert not told(plan.parts[1], "process") & {crashed[plan.parts[0].left[0]].diagnostics["process"]}


@pytest.mark.usefixtures("in_threads")
def test_a_run_that_breaks_off_in_its_second_task_goes_on_there(pair, tmp_path):
    class Breaks(Lines):
        count = 0

        def advance(self, label, count):
            super().advance(label, count)
            self.count += count
            if self.count == 3:
                raise KeyboardInterrupt

    plan = plan_of(pair, tmp_path, name="Plain")
    with pytest.raises(KeyboardInterrupt), reporting(progress=Breaks(quiet)):
        run(plan)
    assert [len(rows(part)) for part in plan.parts] == [2, 1]
    assert all(RunManifest.open(part.folder).prepare_s is not None for part in plan.parts)
    again = plan_of(pair, tmp_path, name="Plain")
    assert [len(part.left) for part in again.parts] == [0, 1]
    run(again)
    whole = plan_of(pair, tmp_path / "undisturbed", name="Plain")
    run(whole)
    assert [rows(part) for part in again.parts] == [rows(part) for part in whole.parts]


@pytest.mark.usefixtures("in_threads")
def test_rows_are_written_while_the_next_query_hangs(pair, tmp_path, monkeypatch):
    monkeypatch.setattr(answers, "PART_S", 0.05)
    plan = plan_of(pair[:1], tmp_path, name="HangsLater")
    found = []

    def hang(_):
        while not prediction_files.parts_of(plan.parts[0].folder):
            time.sleep(0.01)

    monkeypatch.setattr(sys.modules["hostile"], "time", SimpleNamespace(sleep=hang))

    class Looks(answers.Watch):
        def advance(self, part):
            # The first row is in its file when the second one comes.
            found.append(len(prediction_files.ids_done(part.folder, part.asked)))

    answers.answer(plan, plan.parts, jobs=1, watch=Looks())
    assert found == [0, 1]
    assert [rows(plan.parts[0])[name].status for name in plan.parts[0].left] == ["ok", "ok"]


def test_a_second_run_waits_for_the_folders_of_the_first(pair, tmp_path):
    plan = plan_run(RunRequest(spec="oracle_pose", tasks=pair, out=tmp_path, limit=1))
    lines, is_reported = [], threading.Event()

    def tell(line):
        lines.append(line)
        is_reported.set()

    second = threading.Thread(target=run, args=(plan,))
    with reporting(tell):
        with locked(plan.parts[1].folder):
            second.start()
            assert is_reported.wait(600)
            assert not plan.parts[0].folder.exists()
        second.join()
    assert lines == [f"{plan.parts[1].folder} is being written by another run, waiting for it"]
    assert [len(rows(part)) for part in plan.parts] == [1, 1]


def test_the_control_that_is_given_the_truth_is_given_that_of_one_task(pair, tmp_path):
    plan = plan_run(RunRequest(spec="oracle_pose", tasks=pair, out=tmp_path))
    assert [len(group) for group in by_map("oracle_pose", plan.parts)] == [1, 1]
    assert [len(group) for group in by_map("hostile:Plain", plan.parts)] == [2]


def test_only_so_many_tasks_are_locked_at_once_and_those_of_a_map_together(monkeypatch):
    monkeypatch.setattr(runner, "MOST_LOCKED", 3)
    groups = [["a", "b"], ["c"], ["d", "e", "f", "g"], ["h"]]
    assert list(runner._batches(groups)) == [["a", "b", "c"], ["d", "e", "f", "g"], ["h"]]
    assert list(runner._batches([])) == []


def test_other_maps_are_hidden_and_all_of_them_where_only_the_card_is_read(pair, elsewhere, place, tmp_path):
    plan = plan_of((pair[0], elsewhere), tmp_path)
    regions = place / "out" / "regions"
    reach = answers.reach_of(plan.request, (plan.parts[0].region,))
    assert regions / COPY in reach.hidden
    assert regions / TOWN not in reach.hidden
    assert place / "out" / "tasks" in reach.hidden  # a query comes to whom it is asked
    assert {regions / COPY, regions / TOWN} <= set(answers.reach_of(plan.request, ()).hidden)
