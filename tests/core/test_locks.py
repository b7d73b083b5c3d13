# SPDX-License-Identifier: Apache-2.0
"""One run at a time writes a folder, and no file of its lock is left."""

import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from threading import Event

import pytest

from sasgeo_bench.core.errors import StoreError
from sasgeo_bench.core.folders import locked
from sasgeo_bench.core.progress import reporting

# Adds 1 to a number in a file, many times: of two at once, which both read the same number, one would be lost.
COUNTING = """
import sys
from pathlib import Path
from sasgeo_bench.core.folders import locked

folder = Path(sys.argv[1])
for _ in range(200):
    with locked(folder):
        count = int((folder / "count").read_text())
        (folder / "count").write_text(str(count + 1))
"""


def test_nothing_is_left_of_a_lock_and_one_that_cannot_be_made_is_a_fault(tmp_path):
    with locked(tmp_path / "site"):
        assert [path.name for path in tmp_path.iterdir()] == [".site.lock"]
    with pytest.raises(KeyError), locked(tmp_path / "site"):
        raise KeyError
    assert not [*tmp_path.iterdir()]
    refused = pytest.raises(StoreError, match="/proc/site cannot be written")
    with reporting(pytest.fail), refused, locked(Path("/proc/site")):
        pass


def test_who_waited_for_a_lock_excludes_who_comes_later(tmp_path):
    """The file that was waited for is removed by then: a lock on it would exclude nobody."""
    waits, holds, ends, late = Event(), Event(), Event(), Event()

    def wait():
        with locked(tmp_path / "site"):
            holds.set()
            assert ends.wait(600)

    def come_later():
        with locked(tmp_path / "site"):
            assert ends.is_set()

    waiting = iter((waits, late))
    with reporting(lambda _: next(waiting).set()), ThreadPoolExecutor(2) as pool:
        with locked(tmp_path / "site"):
            first = pool.submit(wait)
            assert waits.wait(600)
        assert holds.wait(600)
        second = pool.submit(come_later)
        assert late.wait(600)
        ends.set()
        first.result(), second.result()
    assert not [*tmp_path.iterdir()]


def test_several_processes_at_once_lose_no_step(tmp_path):
    (tmp_path / "count").write_text("0")
    command = [sys.executable, "-c", COUNTING, str(tmp_path)]
    both = [subprocess.Popen(command) for _ in range(3)]  # noqa: S603 - our own
    assert [one.wait(600) for one in both] == [0, 0, 0]
    assert (tmp_path / "count").read_text() == "600"
