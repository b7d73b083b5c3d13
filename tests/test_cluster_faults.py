# SPDX-License-Identifier: Apache-2.0
"""Work that a cluster shares out is the work of one process, byte for byte, whatever happens to its workers."""

import os
import random
import resource
import shutil
import signal
import threading
from contextlib import contextmanager, nullcontext, suppress
from dataclasses import replace
from functools import partial

import pytest

import sasgeo_bench as sgb
from sasgeo_bench.core.errors import StoreError
from sasgeo_bench.core.progress import reporting, spread

distributed = pytest.importorskip("distributed", reason="distributed is not installed (make install brings it)")
dask = pytest.importorskip("dask")

WORKERS = 8
TOWNS = tuple(f"demo-{kind}-{at}" for kind in ("agricultural", "grid", "industrial", "suburb") for at in (1, 2, 3))


@pytest.fixture
def cluster():
    """A scheduler on this machine and its workers; one that says nothing for 20 s counts as lost."""
    config = {"distributed.scheduler.worker-ttl": "20 s", "distributed.scheduler.allowed-failures": 1000}
    with (
        dask.config.set(config),
        distributed.LocalCluster(
            n_workers=WORKERS, threads_per_worker=1, processes=True, dashboard_address="127.0.0.1:0", silence_logs=50
        ) as found,
    ):
        yield found


def contents(root):
    """Every file below a folder but locks, by its path."""
    return {
        path.relative_to(root).as_posix(): path.read_bytes()
        for path in sorted(root.rglob("*"))
        if path.is_file() and not path.name.endswith(".lock")
    }


def fill_disk():
    """From here on this process can write no file of more than a few bytes: to it the disk is full."""
    signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    resource.setrlimit(resource.RLIMIT_FSIZE, (64, resource.getrlimit(resource.RLIMIT_FSIZE)[1]))


def square(number):
    return number * number


def square_unless_full(folder, number):
    """Write a file and square a number; where the disk is full the first fails."""
    (folder / f"{number}.txt").write_text("x" * 1000, encoding="utf-8")
    return number * number


def drawn(out, where):
    """Build the towns and draw queries on them."""
    sgb.build_region(list(TOWNS), out=out, dask=where)
    return sgb.make_tasks(
        suite=["clean", "absent"], regions=list(TOWNS), split="demo", n=1, up_to=True, out=out, dask=where
    )


def answered(out, where):
    """Ask two matchers all that was drawn; their answers without what they cost, which differs from run to run."""
    for matcher in ("random", "prior_centre"):
        sgb.run(matcher=matcher, tasks=sorted(out.glob("tasks/*/*")), out=out, dask=where)
    found = {}
    for run in sorted(out.glob("runs/*/*/*/*")):
        matcher = run.relative_to(out / "runs").parts[0]
        rows = (replace(row, latency_s=None, matcher_s=None) for row in sgb.read_predictions(run))
        found |= {(matcher, row.query_id): row for row in rows}
    return found


def scored(out, where):
    """Score all answers, with a rejector; the tables of the board as they lie in its folder."""
    name = "alone" if where is None else "shared"
    sgb.score(
        predictions=out / "runs",
        name=name,
        rejector=["margin"],
        split="demo",
        draws=200,
        cases=False,
        dask=where,
        out=out,
    )
    return {path.name: path.read_bytes() for path in sorted((out / "boards" / name).glob("*.parquet"))}


@contextmanager
def disturbed(cluster):
    """While entered, one worker stalls, one can write nothing, and of the others one is killed every 3 seconds."""
    ended, killed, chance = threading.Event(), [], random.Random(0)  # noqa: S311 - which worker is killed
    with distributed.Client(cluster.scheduler_address) as client:
        numbers = client.run(os.getpid)
        stalled, full, *others = sorted(numbers)
        os.kill(numbers[stalled], signal.SIGSTOP)
        client.run(fill_disk, workers=[full])

        def kill_some():
            while not ended.wait(3.0):
                killed.append(numbers[chance.choice(others)])
                try:
                    os.kill(killed[-1], signal.SIGKILL)
                except ProcessLookupError:  # killed before: its nanny has started another one in its place
                    continue

        killer = threading.Thread(target=kill_some)
        killer.start()
        try:
            yield
        finally:
            ended.set()
            killer.join()
            with suppress(ProcessLookupError):  # the scheduler has given it up, and its nanny has ended it
                os.kill(numbers[stalled], signal.SIGCONT)
    assert killed


@pytest.mark.slow
def test_workers_that_are_killed_stalled_or_full_change_no_byte(cluster, tmp_path):
    drawn(tmp_path / "one", None)
    with disturbed(cluster):
        folders = drawn(tmp_path / "eight", cluster.scheduler_address)
    assert len(folders) == 2 * len(TOWNS)
    one, eight = contents(tmp_path / "one"), contents(tmp_path / "eight")
    assert sorted(eight) == sorted(one)
    assert [name for name in one if one[name] != eight[name]] == []


@pytest.mark.slow
def test_workers_that_are_killed_stalled_or_full_change_no_answer_and_no_figure(cluster, tmp_path):
    drawn(tmp_path / "one", None)
    shutil.copytree(tmp_path / "one", tmp_path / "eight")
    alone = answered(tmp_path / "one", None)
    figures = scored(tmp_path / "one", None)
    with disturbed(cluster):
        shared = answered(tmp_path / "eight", cluster.scheduler_address)
        assert scored(tmp_path / "one", cluster.scheduler_address) == figures
    assert len(alone) > 100
    assert shared == alone


@pytest.mark.slow
def test_an_item_that_one_worker_cannot_write_is_given_to_another(cluster, tmp_path):
    with distributed.Client(cluster.scheduler_address) as client:
        full = sorted(client.scheduler_info(n_workers=-1)["workers"])[: WORKERS - 1]
        client.run(fill_disk, workers=full)
        work = partial(square_unless_full, tmp_path)
        assert list(spread(work, range(20), dask=cluster.scheduler_address)) == [at * at for at in range(20)]
        client.run(fill_disk)
        with pytest.raises(OSError, match="File too large"):
            list(spread(work, range(20, 22), dask=cluster.scheduler_address))


def test_results_come_in_order_from_a_cluster_and_counts_are_told():
    class Counts:
        done = 0

        def begin(self, label, total):
            self.label, self.total = label, total

        def advance(self, _, count):
            self.done += count

    counts = Counts()
    with reporting(progress=counts):
        found = list(spread(square, range(9), dask="local:2", label="squares"))
    assert found == [at * at for at in range(9)]
    assert (counts.label, counts.total, counts.done) == ("squares", 9, 9)


def test_workers_that_die_over_and_over_end_the_work_with_one_line(monkeypatch):
    class Future:
        def result(self):
            raise distributed.KilledWorker(*("item", None, 3))

    class Client:
        def map(self, *_, **__):
            return [Future()]

    monkeypatch.setattr("distributed.as_completed", iter)
    monkeypatch.setattr("sasgeo_bench.core.progress.connected", lambda _: nullcontext(Client()))
    with pytest.raises(StoreError, match="died over and over on the same item"):
        list(spread(square, range(1), dask="tcp://here:1"))
