# SPDX-License-Identifier: Apache-2.0
"""Scratch folders are removed at the end, and those of a program that was killed by the next one."""

import os
import signal
import subprocess
import sys

import pytest

from sasgeo_bench.core.folders import PREFIX, _sweep_once, scratch_folder, sweep

KILLED = """
import os, signal
from sasgeo_bench.core.folders import scratch_folder
with scratch_folder("matcher") as folder:
    (folder / "index.npy").write_bytes(bytes(100))
    os.kill(os.getpid(), signal.SIGKILL)
"""


@pytest.fixture
def root(tmp_path, monkeypatch):
    monkeypatch.setenv("TMPDIR", str(tmp_path))
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    return tmp_path


def test_the_folder_of_a_killed_program_is_swept_by_the_next(root) -> None:
    with scratch_folder("matcher") as live:
        process = subprocess.run([sys.executable, "-c", KILLED], check=False)  # noqa: S603
        assert process.returncode == -signal.SIGKILL
        left = [path for path in root.iterdir() if path != live]
        assert [path.name.startswith(f"{PREFIX}matcher-") for path in left] == [True]
        assert live.is_dir()  # the other program has swept, too
        _sweep_once.cache_clear()  # as in a new program
        with scratch_folder("next") as own:
            assert set(root.iterdir()) == {live, own}
    assert list(root.iterdir()) == []


def test_links_files_and_folders_of_other_names_are_no_scratch_folders(root) -> None:
    (root / "kept").mkdir()
    (root / "kept" / "thesis.tex").write_text("x")
    (root / f"{PREFIX}link").symlink_to(root / "kept")
    (root / f"{PREFIX}file").write_text("x")
    os.mkfifo(root / f"{PREFIX}pipe")
    assert sweep(root) == 0
    assert len(list(root.iterdir())) == 4
    assert (root / "kept" / "thesis.tex").is_file()


def test_a_folder_that_its_plugin_has_locked_up_is_removed(root) -> None:
    with scratch_folder("matcher") as folder:
        (folder / "a" / "b").mkdir(parents=True)
        (folder / "a").chmod(0)
    assert list(root.iterdir()) == []
