# SPDX-License-Identifier: Apache-2.0
"""A process is shut in as well as the system allows, and what the system lacks is said; each lack is tried here."""

import json
import os
import subprocess
import sys

import pytest

from sasgeo_bench.run import sandbox

HAS_SPACES = subprocess.run(["unshare", "-Urm", "true"], capture_output=True, check=False).returncode == 0  # noqa: S607
HAS_LANDLOCK = sandbox.landlock_version() > 0
spaces = pytest.mark.skipif(not HAS_SPACES, reason="this system allows no namespaces")
landlock = pytest.mark.skipif(not HAS_LANDLOCK, reason="this kernel has no Landlock")

SCRIPT = """
import ctypes, json, os, sys
from sasgeo_bench.run import sandbox

def reads(path):
    try:
        with open(path, "rb") as file:
            return bool(file.read())
    except OSError:
        return False

for name, value in json.loads(sys.argv[1]).items():
    setattr(sandbox, name, lambda *_, value=value: value)
folder, hidden, others, readable = sys.argv[2], json.loads(sys.argv[3]), sys.argv[4], sys.argv[5]
policy = sandbox.Policy(
    readable=[readable, *sys.path], writable=[], hidden=hidden, memory_bytes=2**40, file_bytes=2**20, unsearched=""
)
outside = os.readlink("/proc/self/ns/mnt")
said = sandbox.enter(policy).to_dict()
# Never without a namespace of its own: as root these would be the mounts of the machine that runs the tests.
if os.readlink("/proc/self/ns/mnt") != outside:
    libc = ctypes.CDLL(None)
    for path in (*hidden, "/proc"):
        libc.umount2(os.fsencode(path), 2)
    if libc.unshare(sandbox.CLONE_NEWUSER | sandbox.CLONE_NEWNS) == 0:
        for path in (*hidden, "/proc"):
            libc.umount2(os.fsencode(path), 2)
said["reads"] = [reads(path) for path in (*hidden, *(path + "/answers" for path in hidden))]
said["sees others"] = reads(f"/proc/{others}/cmdline")
said["own"] = [reads("/proc/self/statm"), reads("/proc/cpuinfo"), reads("/proc/meminfo"), reads("/proc/stat")]
said["harmless"] = reads(folder + "/harmless")
print(json.dumps(said))
"""
NO_SPACES = {"_enter_namespaces": 0}
NO_LANDLOCK = {"landlock_version": 0}
NO_PROC = {"_mount_proc": False}
OURS = "a namespace of their own, all end together"


def shut_in(tmp_path, lacking, *, readable=""):
    """What a process says that lacks some of the ways to shut it in, takes covers off, and reads what it may not."""
    (tmp_path / "truth").mkdir()
    for name in ("truth/answers", "answers.parquet", "harmless"):
        (tmp_path / name).write_text("x", encoding="utf-8")
    hidden = json.dumps([str(tmp_path / "truth"), str(tmp_path / "answers.parquet")])
    command = [sys.executable, "-c", SCRIPT, json.dumps(lacking), str(tmp_path), hidden, str(os.getpid())]
    command.append(readable or str(tmp_path))
    done = subprocess.run(command, capture_output=True, text=True, check=False)  # noqa: S603 - ours
    assert done.returncode == 0, done.stderr
    said = json.loads(done.stdout)
    assert said["own"] == [True] * 4
    assert said["harmless"]
    return said


@spaces
@landlock
@pytest.mark.parametrize("lacking", [{}, NO_PROC], ids=["all", "no /proc of its own"])
def test_with_namespaces_and_landlock_nothing_hidden_is_read(tmp_path, lacking):
    said = shut_in(tmp_path, lacking)
    assert not any(said["reads"])
    assert not said["sees others"]
    assert said["truth"] == "covered by an empty mount, refused by Landlock"
    ways = "/proc of others is refused by Landlock" if lacking else "/proc shows no others"
    assert said["processes"] == f"{OURS}; {ways}"


@landlock
def test_without_namespaces_landlock_refuses_what_is_hidden_and_what_others_do(tmp_path):
    said = shut_in(tmp_path, NO_SPACES)
    assert not any(said["reads"])
    assert not said["sees others"]
    assert said["truth"] == "refused by Landlock"
    assert said["processes"] == "not apart; /proc of others is refused by Landlock"


@spaces
def test_without_landlock_covers_cannot_be_taken_off(tmp_path):
    said = shut_in(tmp_path, NO_LANDLOCK)
    assert not any(said["reads"])
    assert not said["sees others"]
    assert said["truth"] == "covered by an empty mount; copies that lie elsewhere can be read"
    assert said["processes"] == f"{OURS}; /proc shows no others"


@spaces
def test_without_landlock_and_a_proc_of_its_own_others_are_seen_and_that_is_said(tmp_path):
    said = shut_in(tmp_path, NO_LANDLOCK | NO_PROC)
    assert said["sees others"]
    assert said["processes"] == f"{OURS}; /proc of others can be read, command lines too"


def test_without_both_nothing_is_protected_and_that_is_said(tmp_path):
    said = shut_in(tmp_path, NO_SPACES | NO_LANDLOCK)
    assert said["truth"] == "not protected"
    assert any(said["reads"])
    assert said["sees others"]
    assert said["processes"] == "not apart; /proc of others can be read, command lines too"


@landlock
def test_whoever_works_in_the_root_of_all_folders_does_not_read_what_others_do_either(tmp_path):
    said = shut_in(tmp_path, NO_PROC, readable="/")
    assert not any(said["reads"])
    assert not said["sees others"]


@landlock
def test_what_a_link_leads_to_beside_something_hidden_is_not_read(tmp_path):
    inside, elsewhere = tmp_path / "inside", tmp_path / "elsewhere"
    (inside / "truth").mkdir(parents=True)
    elsewhere.mkdir()
    (inside / "link").symlink_to(elsewhere)
    found = [path for path, _ in sandbox.around(str(inside), [str(inside / "truth")])]
    assert found == [str(inside)]
