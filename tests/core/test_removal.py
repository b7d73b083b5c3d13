# SPDX-License-Identifier: Apache-2.0
"""A folder goes with whatever a plugin has made in it: depth, names and rights do not stop that, links are left."""

import os
import subprocess
import sys

import pytest

from sasgeo_bench.core.folders import remove_tree


def dig(folder, depth, name="d"):
    """Nested folders, deeper than any path is long; each made from inside of the one above."""
    here = os.open(folder, os.O_RDONLY)
    for _ in range(depth):
        os.mkdir(name, dir_fd=here)
        os.close(os.open("file", os.O_CREAT, dir_fd=here))
        below = os.open(name, os.O_RDONLY, dir_fd=here)
        os.close(here)
        here = below
    os.close(here)


@pytest.mark.parametrize(("depth", "name"), [(1100, "nested"), (20, "x" * 255)])
def test_nested_folders_are_removed_however_deep_they_are(tmp_path, depth, name):
    (tmp_path / "scratch").mkdir()
    dig(tmp_path / "scratch", depth, name)
    remove_tree(tmp_path / "scratch")
    assert list(tmp_path.iterdir()) == []


def test_what_a_link_leads_to_stays_and_the_link_goes(tmp_path):
    (tmp_path / "mine").mkdir(mode=0o500)
    (tmp_path / "mine2").write_text("mine")
    scratch = tmp_path / "scratch"
    (scratch / "a").mkdir(parents=True)
    for place in (scratch, scratch / "a"):
        (place / "folder").symlink_to(tmp_path / "mine")
        (place / "file").symlink_to(tmp_path / "mine2")
    remove_tree(scratch)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["mine", "mine2"]
    assert (tmp_path / "mine").stat().st_mode & 0o777 == 0o500


TAKES_RIGHTS = """
import os, pathlib, sys
from sasgeo_bench.core.folders import remove_tree
root = pathlib.Path(sys.argv[1])
if os.getuid() == 0:
    os.chown(root, 65534, 65534)
    os.setuid(65534)  # what may do all is stopped by no rights
scratch = root / "scratch"
for name in ("one/two/three", "one/four", "five"):
    (scratch / name).mkdir(parents=True)
    (scratch / name / "file").touch()
for name in ("one/two/three", "one/two", "one/four", "one", "five", "."):
    (scratch / name).chmod(0)
remove_tree(scratch)
sys.exit(scratch.exists())
"""


def test_folders_without_rights_are_removed(tmp_path):
    for place in (tmp_path, *list(tmp_path.parents)[:3]):
        place.chmod(0o755)
    command = [sys.executable, "-c", TAKES_RIGHTS, str(tmp_path)]
    assert subprocess.run(command, check=False).returncode == 0  # noqa: S603 - ours


def test_what_cannot_be_removed_stays_and_the_rest_goes(tmp_path, monkeypatch):
    (tmp_path / "scratch" / "kept").mkdir(parents=True)
    (tmp_path / "scratch" / "gone").mkdir()
    remove = os.rmdir

    def refused(path, *, dir_fd=None):
        if path == "kept":
            raise PermissionError(path)
        remove(path, dir_fd=dir_fd)

    monkeypatch.setattr(os, "rmdir", refused)
    remove_tree(tmp_path / "scratch")
    assert list((tmp_path / "scratch").iterdir()) == [tmp_path / "scratch" / "kept"]
