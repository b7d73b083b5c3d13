# SPDX-License-Identifier: Apache-2.0
"""What would be lost with a folder is found before it is replaced, and what cannot be looked into counts as lost."""

import os
from pathlib import Path

import pytest

from sasgeo_bench.core import folders
from sasgeo_bench.core.errors import StoreError
from sasgeo_bench.core.folders import absolute, check_known, check_room, check_site


def test_a_folder_that_cannot_be_looked_into_is_not_replaced(tmp_path, monkeypatch):
    (tmp_path / "site" / "secret").mkdir(parents=True)
    walk = os.walk

    def refused(top, onerror=None):
        onerror(PermissionError(13, "Permission denied", str(Path(top) / "secret")))
        return walk(top)

    monkeypatch.setattr(folders.os, "walk", refused)  # whoever runs the tests may look into everything
    with pytest.raises(StoreError, match=r"secret cannot be looked into \(Permission denied\): check your rights"):
        check_known(tmp_path / "site", (), "a site")


def test_a_folder_that_is_not_there_holds_nothing_and_a_mount_point_is_refused(tmp_path):
    check_known(tmp_path / "none", (), "a site")
    check_site(tmp_path / "none")
    with pytest.raises(StoreError, match="/proc is a mount point"):
        check_room(Path("/proc"))


@pytest.mark.parametrize("name", [".", ".."])
def test_a_folder_has_a_name_however_it_is_given(name, tmp_path, monkeypatch):
    (tmp_path / "a" / "b").mkdir(parents=True)
    monkeypatch.chdir(tmp_path / "a" / "b")
    assert absolute(Path(name)).name == {".": "b", "..": "a"}[name]
