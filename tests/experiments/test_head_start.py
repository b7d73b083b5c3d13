# SPDX-License-Identifier: Apache-2.0
"""What lies packed beside a pipeline file is laid down once, whole, and replaces nothing."""

import io
import tarfile
from pathlib import Path

import pytest

from sasgeo_bench.errors import StoreError
from sasgeo_bench.experiments.head_start import unpack_head_start

PACKED = {
    "regions/one/region.json": b"map",
    "regions/one/layers.tif": b"layers",
    "tasks/clean/one/task.json": b"task",
    "truth/clean/one/truth.json": b"truth",
    "runs/random/abc/run.json": b"run",
    "runs/random/abc/clean/one/predictions.parquet": b"answers",
}


def packed(folder: Path, files: dict[str, bytes]) -> Path:
    file = folder / "mine.toml"
    file.write_text("", encoding="utf-8")
    with tarfile.open(folder / "mine.tar.xz", "w:xz") as archive:
        for name, content in files.items():
            entry = tarfile.TarInfo(name)
            entry.size = len(content)
            archive.addfile(entry, io.BytesIO(content))
    return file


def found(out: Path) -> dict[str, bytes]:
    return {path.relative_to(out).as_posix(): path.read_bytes() for path in out.rglob("*") if path.is_file()}


def test_all_is_laid_down_whole_and_told_once(tmp_path):
    lines: list[str] = []
    for _ in range(2):
        unpack_head_start(packed(tmp_path, PACKED), tmp_path / "out", tell=lines.append)
    assert found(tmp_path / "out") == PACKED
    (line,) = lines
    assert line.startswith("4 maps, tasks, truths and runs were packed in mine.tar.xz")


def test_what_was_there_stays_and_is_not_mixed_with_what_is_packed(tmp_path):
    own = tmp_path / "out/runs/random/abc"
    own.mkdir(parents=True)
    (own / "run.json").write_bytes(b"own")
    unpack_head_start(packed(tmp_path, PACKED), tmp_path / "out", tell=lambda _: None)
    mine = {name: content for name, content in found(tmp_path / "out").items() if name.startswith("runs/")}
    assert mine == {"runs/random/abc/run.json": b"own"}
    assert len(found(tmp_path / "out")) == len(PACKED) - 1


def test_a_pipeline_without_one_begins_with_nothing(tmp_path):
    file = tmp_path / "mine.toml"
    file.write_text("", encoding="utf-8")
    unpack_head_start(file, tmp_path / "out", tell=pytest.fail)
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("fault", ["cut", "no archive", "leads out"])
def test_a_damaged_archive_costs_one_line_and_leaves_nothing(tmp_path, fault):
    file = packed(tmp_path, {"../lost.txt": b"?"} if fault == "leads out" else PACKED)
    archive = tmp_path / "mine.tar.xz"
    if fault != "leads out":
        archive.write_bytes(archive.read_bytes()[:150] if fault == "cut" else b"nothing of the kind")
    with pytest.raises(StoreError, match=r"mine\.tar\.xz is damaged \(.*\): pack it again, or remove it") as caught:
        unpack_head_start(file, tmp_path / "out", tell=lambda _: None)
    assert "\n" not in str(caught.value)
    assert found(tmp_path / "out") == {}
    assert not (tmp_path / "lost.txt").exists()


@pytest.mark.parametrize("name", ["readme.txt", "boards/demo/board.json"])
def test_what_is_no_map_task_or_run_is_refused_before_anything_is_laid_down(tmp_path, name):
    with pytest.raises(StoreError, match=r"mine\.tar\.xz holds '(readme\.txt|boards)': pack the folders regions, runs"):
        unpack_head_start(packed(tmp_path, {**PACKED, name: b"?"}), tmp_path / "out", tell=lambda _: None)
    assert found(tmp_path / "out") == {}


@pytest.mark.parametrize("blocked", ["out", "out/regions", "out/tasks/clean"])
def test_where_one_thing_cannot_be_laid_down_none_is_and_the_line_names_the_folder(tmp_path, blocked):
    (tmp_path / blocked).parent.mkdir(parents=True, exist_ok=True)
    (tmp_path / blocked).write_bytes(b"in the way")
    with pytest.raises(StoreError, match="out") as caught:
        unpack_head_start(packed(tmp_path, PACKED), tmp_path / "out", tell=lambda _: None)
    assert blocked in str(caught.value)
    assert "archive" not in str(caught.value)
    assert [path.read_bytes() for path in (tmp_path / "out").rglob("*") if path.is_file()] in ([], [b"in the way"])


def test_what_a_killed_run_left_is_removed_and_a_folder_of_that_name_is_named(tmp_path):
    left = tmp_path / "out/.head-start-killed/regions"
    left.mkdir(parents=True)
    unpack_head_start(packed(tmp_path, PACKED), tmp_path / "out", tell=lambda _: None)
    assert found(tmp_path / "out") == PACKED
    assert not left.exists()
    (tmp_path / "mine.tar.xz").unlink()
    (tmp_path / "mine.tar.xz").mkdir()
    with pytest.raises(StoreError, match=r"mine\.tar\.xz is no file"):
        unpack_head_start(tmp_path / "mine.toml", tmp_path / "out", tell=lambda _: None)
