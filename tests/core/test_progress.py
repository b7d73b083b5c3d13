# SPDX-License-Identifier: Apache-2.0
"""Work that is spread over processes ends with the program that spreads it."""

import os
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import psutil
import pytest

from sasgeo_bench.core.errors import ConfigError, StoreError
from sasgeo_bench.core.progress import reported, reporting, spread, tell

PROGRAM = """
from pathlib import Path
from sasgeo_bench.core.progress import spread
from tests.core.test_progress import note_and_wait

if __name__ == "__main__":
    list(spread(note_and_wait, [Path(name) for name in ("one", "two", "three")], jobs=2))
"""
LONG_S = 600.0  # a process that is left over sleeps as long


def note_and_wait(path: Path) -> None:
    path.with_suffix(".part").write_text(str(os.getpid()), encoding="ascii")
    path.with_suffix(".part").replace(path)
    time.sleep(LONG_S)


def told(name):
    tell(f"{name} told")
    return name.upper()


def die(number):
    """End the process as the kernel does for want of memory."""
    os.kill(os.getpid(), signal.SIGKILL)
    return number


def test_a_process_that_dies_is_reported_in_one_line() -> None:
    with pytest.raises(StoreError, match=r"one of 2 processes died.*ask for fewer --jobs"):
        list(spread(die, [1, 2], jobs=2))


@pytest.mark.parametrize("jobs", [0, -1, 10**8])
def test_more_processes_than_a_computer_starts_are_refused(jobs) -> None:
    with pytest.raises(ConfigError, match=f"--jobs must lie between 1 and 1000, got {jobs}"):
        list(spread(abs, [1], jobs=jobs))


def test_results_come_in_order_from_several_processes():
    assert list(spread(abs, [-3, 2, -1], jobs=2)) == [3, 2, 1]


def first_alone(number):
    if number:
        threading.Event().wait()


@pytest.mark.parametrize("_", range(3))  # without the mend, two of three fail
def test_who_is_interrupted_while_the_processes_end_too_hears_of_nothing_else(_):
    """As where a system stops all at once; a thread that fails makes a test fail."""
    found = spread(first_alone, range(8), jobs=2)
    next(found)
    for process in psutil.Process().children():
        if "spawn_main" in " ".join(process.cmdline()):
            process.terminate()
    with pytest.raises(KeyboardInterrupt):
        found.throw(KeyboardInterrupt())


def test_a_killed_program_leaves_no_process_behind(tmp_path):
    """As `kill -9` or a lack of memory ends it: nothing of its own can run any more."""
    (tmp_path / "program.py").write_text(PROGRAM, encoding="utf-8")
    root = Path(__file__).parents[2]
    program = subprocess.Popen(
        [sys.executable, "program.py"], cwd=tmp_path, env={**os.environ, "PYTHONPATH": str(root)}
    )
    notes = [tmp_path / "one", tmp_path / "two"]
    while not all(path.exists() for path in notes):
        assert program.poll() is None
        time.sleep(0.05)
    left = [psutil.Process(int(path.read_text(encoding="ascii"))) for path in notes]
    program.kill()
    program.wait()
    _, alive = psutil.wait_procs(left, timeout=LONG_S / 2)
    assert alive == []


@pytest.mark.parametrize("jobs", [1, 2])
@pytest.mark.parametrize("is_bound", [True, False])
def test_lines_of_other_processes_reach_whoever_listens_here(jobs, is_bound):
    lines = []
    with reporting(lines.append if is_bound else lambda line: lines.append(line)):  # noqa: PLW0108 - no bound method
        assert list(spread(reported(told), ["a", "b", "c"], jobs=jobs)) == ["A", "B", "C"]
    assert lines == ["a told", "b told", "c told"]
