# SPDX-License-Identifier: Apache-2.0
"""What a matcher takes counts whatever it hides it in, the kernel holds it where it does that, and nothing is left."""

import ctypes
import fcntl
import os
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path
from types import SimpleNamespace

import pytest

from sasgeo_bench.running import memory, worker
from sasgeo_bench.running.memory import Group
from sasgeo_bench.running.worker import Limits, Reach, Worker

MOST = 300 * 10**6
LIMITS = Limits(prepare_s=120.0, memory_bytes=MOST, processes=40)
HAS_SPACES = subprocess.run(["unshare", "-Urm", "true"], capture_output=True, check=False).returncode == 0  # noqa: S607
HAS_GROUPS = (made := Group.make(memory_bytes=MOST, processes=40)) is not None
if made is not None:
    made.remove()
groups = pytest.mark.skipif(not HAS_GROUPS, reason="no control group can be made here")
LACKING = "from sasgeo_bench.running import sandbox; sandbox._enter_namespaces = lambda: 0; "
NO_LANDLOCK = "sandbox.landlock_version = lambda: 0; "
MODES = {
    "all": ("", True),
    "no group": ("", False),
    "no namespaces, no group": (LACKING, False),
}
KEEPS = {
    **MODES,
    "no namespaces": (LACKING, True),
    "no namespaces, no Landlock, no group": (LACKING + NO_LANDLOCK, False),
}


def in_mode(modes):
    """Each mode, if it can be made here."""
    return [pytest.param(*mode, id=name, marks=groups if mode[1] else ()) for name, mode in modes.items()]


def test_a_file_named_as_a_line_of_the_kernel_changes_no_count():
    mapped = "7f00-7f01 rw-s 00000000 00:01 {inode}   /memfd:x{name} (deleted)\nPss:   40 kB\n"
    odd = "".join(mapped.format(inode=7, name=f"{mark}Pss: -900 kB{mark}y") for mark in "\x0b\x0c\x1c\x85\u2028")
    nothing = memory._Shared(sizes={})
    assert memory._mapped_bytes(odd.encode(), nothing) == 5 * 40 * 1024
    assert memory._mapped_bytes(odd.encode(), memory._Shared(sizes={(1, 7): 4096})) == 0


def test_whoever_keeps_us_from_measuring_is_ended(monkeypatch, tmp_path):
    killed = threading.Event()
    monkeypatch.setattr(memory, "_family", lambda _: 1 / 0)
    watch = memory.MemoryWatch(process=SimpleNamespace(pid=0), most_bytes=1, kill=killed.set, scratch=tmp_path)
    watch.start()
    assert killed.wait(60)
    watch.stop()
    assert watch.is_over
    assert watch.why == "its memory could not be looked at (ZeroDivisionError: division by zero)"


def test_who_looks_odd_once_while_it_ends_is_looked_at_again(monkeypatch, tmp_path):
    found = iter([lambda: 1 / 0, lambda: 1 / 0, list])
    monkeypatch.setattr(memory, "_family", lambda _: next(found)())
    watch = memory.MemoryWatch(process=SimpleNamespace(pid=0), most_bytes=1, kill=lambda: None, scratch=tmp_path)
    assert not watch.look()
    assert not watch.is_over


@pytest.mark.parametrize("lists", [False, memory._has_children_lists()])
def test_a_family_holds_what_a_thread_of_a_child_has_started(monkeypatch, lists):
    monkeypatch.setattr(memory, "_has_children_lists", lambda: lists)
    program = (
        "import subprocess, sys, threading\n"
        "start = lambda: print(subprocess.Popen(['sleep', '600'], stdout=subprocess.DEVNULL).pid, flush=True)\n"
        "thread = threading.Thread(target=lambda: (start(), threading.Event().wait()))\n"
        "thread.start()\n"
    )
    with subprocess.Popen([sys.executable, "-c", program], stdout=subprocess.PIPE, text=True) as child:  # noqa: S603 - our own program
        grandchild = int(child.stdout.readline())
        try:
            assert sorted(memory._family(child.pid)) == sorted([child.pid, grandchild])
        finally:
            os.kill(grandchild, signal.SIGKILL)
            child.kill()
    assert grandchild not in memory._family(child.pid)


@pytest.fixture
def lock(tmp_path):
    """A file that a daemon holds as long as it lives."""
    path = tmp_path / "lock"
    path.touch()
    return path


@pytest.fixture
def taker(monkeypatch, tmp_path):
    """A worker whose process runs one of the takers."""

    def make(spec, lacking="", has_group=True):  # noqa: FBT002 - as the modes have it
        monkeypatch.setattr(worker, "_ANSWERS", (str(Path(__file__).with_name("takers.py")),))
        monkeypatch.setattr(worker, "PROGRAM", worker.PROGRAM.replace("from", lacking + "from", 1))
        if not has_group:
            monkeypatch.setattr(worker.Group, "make", lambda **_: None)
        return Worker(spec=spec, reach=Reach(readable=[Path(__file__).parent, tmp_path], hidden=[]), limits=LIMITS)

    return make


@pytest.mark.parametrize(
    ("spec", "lacking", "has_group"),
    [
        pytest.param(spec, *mode, id=f"{spec} {name}", marks=groups if mode[1] else ())
        for name, mode in MODES.items()
        for spec in ("holds", "dribbles", "memory_file", "shared_mapping", "scratch", "children")
        if spec != "scratch" or (HAS_SPACES and not mode[0])  # else it lies on a disc
    ],
)
def test_memory_counts_wherever_it_is_hidden(taker, spec, lacking, has_group):
    with taker(spec, lacking, has_group) as hostile:
        reply = hostile.load()
    assert (reply.status, reply.message) == ("crash", "takes more than the 300 MB of memory that are allowed")
    assert hostile.peak_bytes > 0.9 * MOST
    words = "held by the kernel (cgroup v" if has_group else "looked at every 50 ms; processes are not counted"
    assert words in hostile.isolation["memory"]


@pytest.mark.parametrize(("lacking", "has_group"), in_mode(MODES))
def test_memory_that_several_processes_share_counts_once(taker, lacking, has_group):
    with taker("shares", lacking, has_group) as honest:
        assert honest.load().message == "ready"
        assert not honest._memory.look()
        assert 150 * 2**20 < honest.peak_bytes < MOST


@pytest.mark.parametrize(("lacking", "has_group"), in_mode(KEEPS))
def test_a_daemon_does_not_outlive_its_run(taker, lock, lacking, has_group):
    with taker(f"daemon {lock}", lacking, has_group) as hostile, lock.open("rb") as file:
        assert hostile.load().message == "ready"
        with pytest.raises(BlockingIOError):
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        hostile.end()
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)


@groups
def test_there_are_no_more_processes_than_allowed(taker):
    with taker("forks") as hostile:
        reply = hostile.load()
    assert reply.status == "refused"
    assert 20 < int(reply.message) < 40


RUNNER = """
import sys, time
from pathlib import Path
from sasgeo_bench.running import worker
worker._ANSWERS = (sys.argv[1],)
worker.PROGRAM = worker.PROGRAM.replace("from", sys.argv[2] + "from", 1)
reach = worker.Reach(readable=[Path(sys.argv[1]).parent, Path(sys.argv[3]).parent], hidden=[])
hostile = worker.Worker(spec=f"daemon {sys.argv[3]}", reach=reach, limits=worker.Limits())
print(hostile.load().message, flush=True)
time.sleep(1000)
"""


@pytest.mark.parametrize("lacking", ["", LACKING], ids=["all", "no namespaces"])
def test_nothing_is_left_where_the_runner_is_killed(lock, lacking):
    command = [sys.executable, "-c", RUNNER, str(Path(__file__).with_name("takers.py")), lacking, str(lock)]
    with subprocess.Popen(command, stdout=subprocess.PIPE) as runner, lock.open("rb") as file:  # noqa: S603 - ours
        assert runner.stdout.readline() == b"ready\n"
        with pytest.raises(BlockingIOError):
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        runner.kill()
        runner.wait()
        for _ in range(600):  # the kernel tells the keeper, and that one ends the rest: soon, but not at once
            try:
                fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
                break
            except BlockingIOError:
                time.sleep(0.1)
        else:
            pytest.fail("the daemon lives on")
    group = Group.make(memory_bytes=MOST, processes=40)
    if group is not None:
        group.remove()
        left = [path.name for folder in group.folders for path in folder.parent.glob(f"*-{runner.pid}-*")]
        assert left == []


@groups
def test_groups_of_runs_that_live_and_of_other_namespaces_stay():
    ours, others = (Group.make(memory_bytes=MOST, processes=40) for _ in range(2))
    foreign = ours.pids.parent / "sasgeo-bench-1-1-1-0"
    foreign.mkdir()
    try:
        Group.make(memory_bytes=MOST, processes=40).remove()
        assert all(folder.is_dir() for folder in (*ours.folders, *others.folders, foreign))
    finally:
        foreign.rmdir()
        ours.remove()
        others.remove()
    assert not any(folder.exists() for folder in (*ours.folders, *others.folders))


@pytest.mark.parametrize(
    ("own", "mounts", "expected"),
    [
        ("0::/user/mine.scope", "1 2 0:1 / {root} rw - cgroup2 cgroup2 rw", [(2, "user", "user")]),
        ("0::/mine.scope", "1 2 0:1 / {root} rw - cgroup2 cgroup2 rw", []),
        ("0::/pod/user/mine.scope", "1 2 0:1 /pod {root} rw - cgroup2 cgroup2 rw", [(2, "user", "user")]),
        ("0::/elsewhere/mine", "1 2 0:1 /pod {root} rw - cgroup2 cgroup2 rw", []),
        (
            "5:pids:/a\n4:cpu,memory:/b\n0::/",
            "1 2 0:1 / {root}/m rw shared:1 - cgroup cgroup rw,cpu,memory\n1 2 0:1 / {root}/p rw - cgroup c rw,pids",
            [(1, "m/b", "p/a")],
        ),
        ("4:memory:/b", "1 2 0:1 / {root}/m rw - cgroup cgroup rw,memory", []),
        ("", "", []),
    ],
    ids=["version 2", "no controllers", "namespace", "out of reach", "version 1", "one controller", "none"],
)
def test_groups_are_made_where_the_system_lets_us(tmp_path, monkeypatch, own, mounts, expected):
    (tmp_path / "user/mine.scope").mkdir(parents=True)
    (tmp_path / "user/cgroup.subtree_control").write_text("cpu memory pids", encoding="utf-8")
    (tmp_path / "own").write_text(own, encoding="utf-8")
    (tmp_path / "mounts").write_text(mounts.format(root=tmp_path), encoding="utf-8")
    monkeypatch.setattr(memory, "_OWN", tmp_path / "own")
    monkeypatch.setattr(memory, "_MOUNTS", tmp_path / "mounts")
    assert [(version, *map(str, places)) for version, places in memory._places()] == [
        (version, str(tmp_path / memory), str(tmp_path / pids)) for version, memory, pids in expected
    ]


def test_where_scratch_lies_is_looked_up_once(monkeypatch, tmp_path):
    """While a process enters its root the same path leads to memory and to the disk by turns."""
    opened, system = [], {"open": os.open, "stat": os.stat}

    def look(name):
        def found(path, *more, **words):
            if str(path).startswith("/proc/7/"):
                opened.append((name, str(path)))
                return system[name](tmp_path, *more, **words)
            return system[name](path, *more, **words)

        return found

    monkeypatch.setattr(memory.os, "open", look("open"))
    monkeypatch.setattr(memory.os, "stat", look("stat"))
    assert memory._scratch_in_memory(7, tmp_path) == (-1, 0)  # the disk's used space is not memory
    assert opened == [("open", f"/proc/7/root{tmp_path}")]


KEPT = """
import psutil
from sasgeo_bench.running.memory import be_lean
{first}
for size in (30, 24):  # the C library learns from the first one to keep the second
    before, block = psutil.Process().memory_info().rss, b"x" * (size * 2**20)
    del block
print((psutil.Process().memory_info().rss - before) // 2**20)
"""


@pytest.mark.skipif(not hasattr(ctypes.CDLL(None), "mallopt"), reason="the C library has no mallopt")
@pytest.mark.parametrize(
    ("first", "more", "is_kept"), [("", {}, True), ("be_lean()", {}, False), ("", memory.LEAN, False)]
)
def test_a_lean_process_keeps_nothing_large_that_it_freed(first, more, is_kept):
    plain = {name: value for name, value in os.environ.items() if not name.startswith("MALLOC_")}
    code = KEPT.format(first=first)
    ended = subprocess.run([sys.executable, "-c", code], env=plain | more, capture_output=True, text=True, check=True)  # noqa: S603 - our own
    assert (int(ended.stdout) > 12) == is_kept
