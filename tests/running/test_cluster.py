# SPDX-License-Identifier: Apache-2.0
"""A run on a dask cluster of several processes gives the rows of an undisturbed one, also where one is killed."""

import os
import signal
import sys
from dataclasses import replace

import psutil
import pytest

from sasgeo_bench.core import progress
from sasgeo_bench.core.errors import ConfigError, StoreError
from sasgeo_bench.core.progress import reporting
from sasgeo_bench.running import prediction_files, runner
from sasgeo_bench.running.answers import Patience, pool_costs
from sasgeo_bench.running.plan import RunRequest, plan_run
from sasgeo_bench.running.prediction_files import RunManifest
from sasgeo_bench.running.runner import run
from sasgeo_bench.running.worker import Limits
from sasgeo_bench.tasks import task_files
from sasgeo_bench.tasks.query import flight_id, view_id
from tests.threaded import threaded

distributed = pytest.importorskip("distributed", reason="distributed is not installed (make install brings it)")

PATIENT = Limits(match_s=600.0)  # what answers is never late, however busy the machine is


def request_of(task, out, name="Plain", **changes):
    request = RunRequest(spec=f"hostile:{name}", tasks=(task,), out=out, limits=PATIENT)
    return replace(request, **changes)


def rows(folder):
    """All rows by query, without the time they took."""
    return {
        item.query_id: replace(item, latency_s=None, matcher_s=None)
        for item in prediction_files.read_predictions(folder)
    }


@pytest.mark.slow
def test_a_cluster_of_two_processes_gives_what_one_process_does(task, tmp_path):
    alone, spread = (
        plan_run(request_of(task, tmp_path / name, dask=dask)) for name, dask in (("one", None), ("two", "local:2"))
    )
    run(alone)
    lines = []
    with reporting(lines.append):
        report = run(spread)
    assert report.counts == {"ok": len(task_files.Task.open(task).ids())}
    assert rows(spread.parts[0].folder) == rows(alone.parts[0].folder)
    about = RunManifest.open(spread.parts[0].folder)
    assert about.isolation == RunManifest.open(alone.parts[0].folder).isolation
    assert about.prepare_s >= 0
    again = plan_run(request_of(task, tmp_path / "two", dask="local:2"))
    with reporting(lines.append):
        assert run(again).counts == {}
    assert "nothing left" in lines[-1]


@pytest.mark.slow
def test_a_dask_worker_that_is_killed_costs_no_row(place, task, tmp_path):
    with threaded():
        alone = plan_run(request_of(task, tmp_path / "one"))
        run(alone)
    plan = plan_run(request_of(task, tmp_path / "two", name="Held", dask="local:2"))
    part = plan.parts[0]
    (place / "hold").write_text(" ".join(next(iter(runner._chunks(part.left, 2, str)))), encoding="utf-8")
    killed, asked, costs = [], [], []
    with progress.connected("local:2") as client:
        for number, _, cost in runner.answer_on(client, plan, [part]):
            assert number == 0
            costs.append(cost)
            if not killed:  # the first chunk is answered, and both are held at work on another one
                while not asked:  # the process of a matcher, of a dask worker in the middle of a chunk
                    killed = list(client.run(os.getpid).values())[:1]
                    asked = psutil.Process(killed[0]).children(recursive=True)
                os.kill(killed[0], signal.SIGKILL)
                (place / "hold").unlink()
        assert killed[0] not in client.run(os.getpid).values()
    assert len(costs) > 2
    assert asked
    assert not [process for process in asked if process.is_running()]
    assert rows(part.folder) == rows(alone.parts[0].folder)
    assert sum(pool_costs(costs).counts.values()) <= len(rows(part.folder))


def test_a_chunk_asks_only_what_has_no_row(task, tmp_path):
    first = plan_run(request_of(task, tmp_path, limit=3))
    run(first)
    plan = plan_run(request_of(task, tmp_path))
    asked = task_files.Task.open(task).asked
    chunk = replace(plan.parts[0], left=tuple(asked)[:5], asked=asked)
    assert runner._answer_chunk(plan, "one", chunk).counts == {"ok": 2}


def test_chunks_of_a_run_give_up_a_matcher_that_hangs_together_and_another_run_does_not(task, tmp_path, monkeypatch):
    monkeypatch.setattr(Patience.__init__, "__kwdefaults__", {"most_late": 3})
    plan = plan_run(request_of(task, tmp_path, name="Hangs", limits=Limits(match_s=0.01)))
    asked = task_files.Task.open(task).asked
    chunks = [replace(plan.parts[0], left=tuple(asked)[at : at + 2], asked=asked) for at in (0, 2, 4)]
    with threaded():
        costs = [runner._answer_chunk(plan, token, chunk) for token, chunk in zip(("a", "a", "b"), chunks, strict=True)]
    assert [cost.messages["timeout"].startswith("given up after 3") for cost in costs] == [False, True, False]


@pytest.mark.parametrize(
    ("address", "words"),
    [
        ("local:0", "local:N with N from 1 to 1000"),
        ("local:two", "local:N with N from 1 to 1000"),
        ("local:" + "9" * 5000, "local:N with N from 1 to 1000"),
        ("tcp://127.0.0.1:9", "no dask scheduler answers at 'tcp://127.0.0.1:9'"),
        ("", "as tcp://host:port, got ''"),
        ("ftp://127.0.0.1:9", "as tcp://host:port, got 'ftp://127.0.0.1:9'"),
        ("tcp://127.0.0.1", "as tcp://host:port, got 'tcp://127.0.0.1'"),
        ("tcp://127.0.0.1:nine", "as tcp://host:port, got 'tcp://127.0.0.1:nine'"),
    ],
)
def test_a_cluster_that_is_not_there_is_reported_in_one_line(task, tmp_path, monkeypatch, address, words):
    monkeypatch.setattr(progress, "_CONNECT_S", 0.5)
    plan = plan_run(request_of(task, tmp_path, dask=address))
    with pytest.raises(ConfigError, match=words):
        run(plan)
    assert not plan.parts[0].folder.exists()


def test_without_the_extra_the_way_to_it_is_told(monkeypatch):
    monkeypatch.setitem(sys.modules, "distributed", None)
    with pytest.raises(ConfigError, match=r"pip install 'sasgeo-bench\[dask\]'"), progress.connected("local:2"):
        pass


def test_jobs_and_a_cluster_are_not_asked_for_together(task, tmp_path):
    with pytest.raises(ConfigError, match="leave one of them out"):
        plan_run(request_of(task, tmp_path, dask="local:2", jobs=2))


def test_chunks_hold_every_id_once_and_are_neither_tiny_nor_huge():
    for count, threads in ((1, 4), (60, 2), (5000, 2), (100_000, 64)):
        ids = tuple(map(str, range(count)))
        chunks = list(runner._chunks(ids, threads, str))
        assert tuple(name for chunk in chunks for name in chunk) == ids
        assert all(8 <= len(chunk) <= 256 for chunk in chunks[:-1])


def test_no_chunk_ends_in_the_middle_of_a_flight():
    ids = tuple(view_id(f"{flight:018x}", frame) for flight in range(7) for frame in range(30))
    chunks = list(runner._chunks(ids, 2, flight_id))
    assert tuple(name for chunk in chunks for name in chunk) == ids
    assert len(chunks) > 1
    assert all(len(chunk) % 30 == 0 for chunk in chunks)


def test_workers_that_die_over_and_over_end_the_run_with_one_line(task, tmp_path, monkeypatch):
    class Future:
        def result(self):
            raise distributed.KilledWorker(*("chunk", None, 3))

    class Client:
        def nthreads(self):
            return {"a": 1}

        def map(self, *_, **__):
            return [Future()]

    monkeypatch.setattr("distributed.as_completed", iter)
    plan = plan_run(request_of(task, tmp_path))
    with pytest.raises(StoreError, match="died over and over"):
        list(runner.answer_on(Client(), plan, plan.parts))
