# SPDX-License-Identifier: Apache-2.0
"""macOS and Windows, as far as Linux can show: `other_system` hides what they lack."""

import json
import os
import subprocess
import sys
from pathlib import Path

import matplotlib as mpl
import pytest

import sasgeo_bench
from sasgeo_bench.core.errors import ConfigError
from sasgeo_bench.running import channel, worker
from sasgeo_bench.running.worker import Reach

DRIVER = Path(__file__).with_name("other_system.py")
SYSTEMS = ("darwin", "win32")
IMPORT_ALL = """
import pkgutil
from importlib import import_module
import sasgeo_bench
found = [one.name for one in pkgutil.walk_packages(sasgeo_bench.__path__, "sasgeo_bench.")]
names = [name for name in found if "__main__" not in name]
for name in names:
    import_module(name)
print(len(names))
"""


def run(system: str, code: str, folder: Path, *arguments: str) -> subprocess.CompletedProcess[str]:
    """Run code as it would run on a system, in a folder."""
    (folder / "given.py").write_text(code, encoding="utf-8")
    fonts = {"MPLCONFIGDIR": mpl.get_cachedir()}  # their list takes seconds to make
    places = fonts | {"PYTHONPATH": str(folder), "XDG_CACHE_HOME": str(folder / "cache"), "SASGEO_EXTRACTS": ""}
    command = [sys.executable, "-P", str(DRIVER), system, "given", *arguments]
    return subprocess.run(command, cwd=folder, env=os.environ | places, capture_output=True, text=True, check=False)  # noqa: S603 - our own


@pytest.mark.parametrize("system", SYSTEMS)
def test_every_module_is_imported_where_what_linux_alone_has_is_hidden(system, tmp_path):
    done = run(system, IMPORT_ALL, tmp_path)
    assert done.returncode == 0, done.stderr
    assert int(done.stdout) == len([*Path(sasgeo_bench.__path__[0]).rglob("*.py")]) - 2  # the package, and __main__


@pytest.mark.parametrize(
    ("code", "words"),
    [
        ("import fcntl", "No module named 'fcntl'"),
        ("import signal; signal.SIGHUP", "has no attribute 'SIGHUP'"),
        ("from os import O_PATH", "cannot import name 'O_PATH'"),
        ("from pathlib import Path; Path('/proc/self/statm').read_text()", "No such file or directory"),
    ],
)
def test_what_windows_lacks_is_hidden_from_us(code, words, tmp_path):
    assert words in run("win32", code, tmp_path).stderr


@pytest.mark.parametrize("system", SYSTEMS)
def test_a_place_is_built_asked_scored_and_published_without_linux(system, tmp_path):
    done = run(system, Path(__file__).with_name("a_place.py").read_text(encoding="utf-8"), tmp_path, str(tmp_path))
    assert done.returncode == 0, done.stderr
    assert "run code that you trust without it, by --trusted" in done.stdout
    (manifest,) = (tmp_path / "out/runs").rglob("run.json")
    about = json.loads(manifest.read_text(encoding="utf-8"))
    assert about["isolation"]["truth"] == "trusted code, not shut in"


def test_the_sandbox_is_refused_in_one_line_where_there_is_none(monkeypatch):
    monkeypatch.setattr(worker.sys, "platform", "darwin")
    with pytest.raises(ConfigError, match="only Linux offers the sandbox"):
        Reach(readable=[], hidden=[])
    assert not Reach(readable=[], hidden=[], is_sandboxed=False).is_sandboxed


def test_a_stranger_at_the_door_of_a_process_is_not_taken_for_it(monkeypatch):
    """It connects first, and shows another key."""
    monkeypatch.setattr(channel, "INHERITS", False)
    code = (
        "import socket, sys; from sasgeo_bench.running.channel import far_end\n"
        "host, _, port = sys.argv[1].rpartition(':')\n"
        "stranger = socket.create_connection((host, int(port))); stranger.sendall(bytes(32))\n"
        "far_end(sys.argv[1]).sendall(b'here')"
    )
    process, ours = channel.start_process([sys.executable, "-c", code], dict(os.environ))
    with ours, process:
        assert ours.recv(4) == b"here"


def test_a_process_that_ends_before_it_connects_leaves_a_closed_socket(monkeypatch):
    monkeypatch.setattr(channel, "INHERITS", False)
    process, ours = channel.start_process([sys.executable, "-c", "raise SystemExit(3)"], dict(os.environ))
    with ours, process:
        assert ours.recv(1) == b""
        assert process.wait() == 3
