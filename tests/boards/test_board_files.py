# SPDX-License-Identifier: Apache-2.0
"""Boards on disk: whole or not at all, whatever lies in the way or ends the process in the middle."""

import errno
import signal
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pandas as pd
import pytest

from sasgeo_bench.boards.board_files import AdditionalFiles, check_board, read_leaderboard, write_board
from sasgeo_bench.boards.manifests import BoardManifest
from sasgeo_bench.core.errors import StoreError

KILLED = """
import os, signal, sys
from pathlib import Path
from tests.boards.test_board_files import put
from sasgeo_bench.boards.board_files import AdditionalFiles

def draw(path):
    path.write_bytes(b"half")
    os.kill(os.getpid(), signal.SIGKILL)

put(Path(sys.argv[1]), 2.0, extras=[AdditionalFiles(figures={"mine.png": draw})])
"""


def put(folder, value, *, extras=(), version=1):
    table = pd.DataFrame({"matcher": ["mine"], "value": [value]})
    write_board(
        folder,
        tables={"leaderboard": table, "scores": table},
        about=BoardManifest(scorer_version=version, entries=[], tasks=[]),
        extras=[AdditionalFiles(texts={"leaderboard.md": f"{value}\n"}), *extras],
    )


def values(folder):
    return read_leaderboard(folder)["value"].tolist()


def contents(folder):
    return {path.name: path.read_bytes() for path in folder.iterdir()}


@pytest.fixture
def board(tmp_path):
    put(tmp_path / "mine", 1.0)
    return tmp_path / "mine"


def test_killed_in_the_middle_the_old_board_stays_and_the_next_one_takes_its_place(board):
    before = contents(board)
    root = Path(__file__).parents[2]
    killed = subprocess.run([sys.executable, "-c", KILLED, str(board)], cwd=root, check=False)  # noqa: S603 - our own
    assert killed.returncode == -signal.SIGKILL
    assert contents(board) == before
    assert (board.parent / ".mine.partial").is_dir()
    put(board, 3.0)
    assert values(board) == [3.0]
    assert sorted(path.name for path in board.parent.iterdir()) == ["mine"]


def test_a_full_disk_is_one_line_and_the_old_board_stays(board):
    before = contents(board)

    def fill(path):
        path.write_bytes(b"half")
        raise OSError(errno.ENOSPC, "No space left on device")

    with pytest.raises(StoreError, match=r"mine cannot be written \(No space left on device\): check the free space"):
        put(board, 2.0, extras=[AdditionalFiles(figures={"mine.png": fill})])
    assert contents(board) == before
    assert sorted(path.name for path in board.parent.iterdir()) == ["mine"]


@pytest.mark.parametrize("name", [".mine.partial", ".mine.replaced"])
@pytest.mark.parametrize("kind", ["file", "folder", "link", "link to nothing"])
def test_what_is_left_beside_a_board_is_not_in_the_way(board, tmp_path, name, kind):
    left, kept = board.parent / name, tmp_path / "kept"
    kept.mkdir()
    (kept / "thesis.txt").write_text("years of work", encoding="utf-8")
    if kind == "file":
        left.write_text("", encoding="utf-8")
    elif kind == "folder":
        left.mkdir()
    else:
        left.symlink_to(kept if kind == "link" else "nowhere")
    put(board, 2.0)
    assert values(board) == [2.0]
    assert not left.exists()
    assert (kept / "thesis.txt").read_text(encoding="utf-8") == "years of work"


@pytest.mark.parametrize("target", ["elsewhere", "nowhere"])
def test_a_link_gives_way_to_a_board_and_what_it_leads_to_stays(tmp_path, target):
    put(tmp_path / "elsewhere", 1.0)
    (tmp_path / "mine").symlink_to(target)
    for value in (2.0, 3.0):
        put(tmp_path / "mine", value)
        assert values(tmp_path / "mine") == [value]
    assert not (tmp_path / "mine").is_symlink()
    assert values(tmp_path / "elsewhere") == [1.0]


def test_two_boards_at_once_in_one_place_are_written_one_after_the_other(board):
    with ThreadPoolExecutor(6) as threads:
        for written in [threads.submit(put, board, float(value)) for value in range(2, 8)]:
            written.result()
    (found,) = values(board)
    assert found in range(2, 8)
    assert (board / "leaderboard.md").read_text(encoding="utf-8") == f"{found}\n"
    assert sorted(path.name for path in board.parent.iterdir()) == ["mine"]


@pytest.mark.parametrize("lost", ["scores.parquet", "leaderboard.parquet"])
def test_any_table_tells_the_scorer_version_of_a_board(board, lost):
    (board / lost).unlink()
    check_board(board, scorer_version=1)
    with pytest.raises(StoreError, match=r"rows of scorer version 1, this one is 2: .* name another one, or move"):
        check_board(board, scorer_version=2)
