# SPDX-License-Identifier: Apache-2.0
"""A file is replaced whole or not at all, and nothing else is left beside it."""

from pathlib import Path

import pytest

from sasgeo_bench.ageing.files import write_ratebook, write_summary
from sasgeo_bench.core.errors import StoreError
from sasgeo_bench.core.folders import fresh_file


def test_a_file_is_replaced_when_the_block_ends(tmp_path):
    path = tmp_path / "deep" / "a.json"
    for text in ("one", "two"):
        with fresh_file(path, mend="run again") as scratch:
            scratch.write_text(text)
        assert path.read_text() == text
    assert [one.name for one in path.parent.iterdir()] == ["a.json"]


@pytest.mark.parametrize("stop", [KeyboardInterrupt, ValueError, MemoryError])
def test_whatever_ends_the_block_the_old_file_stays_and_no_other(tmp_path, stop):
    path = tmp_path / "a.json"
    path.write_text("old")

    def cut_off():
        with fresh_file(path, mend="run again") as scratch:
            scratch.write_text("half")
            raise stop

    with pytest.raises(stop):
        cut_off()
    assert [(one.name, one.read_text()) for one in tmp_path.iterdir()] == [("a.json", "old")]


def test_a_refusal_of_the_disk_is_one_line_with_its_mend(tmp_path):
    (tmp_path / "file").touch()
    with (
        pytest.raises(StoreError, match=r"a.json cannot be written \(.*\): run again"),
        fresh_file(tmp_path / "file" / "a.json", mend="run again"),
    ):
        pass


@pytest.mark.parametrize("name", [".", "", "..", "folder"])
@pytest.mark.parametrize("write", [write_summary, write_ratebook])
def test_a_folder_is_no_file_to_write(tmp_path, monkeypatch, name, write):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "folder").mkdir()
    with pytest.raises(StoreError, match=r"cannot be written \(Is a directory\): check"):
        write(Path(name), [])
    assert [path.name for path in tmp_path.iterdir()] == ["folder"]
