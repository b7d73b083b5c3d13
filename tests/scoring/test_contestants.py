# SPDX-License-Identifier: Apache-2.0
"""Answers of entries, as they go to the processes that fit rejectors."""

import pickle
from pathlib import Path

from sasgeo_bench.running.prediction_files import Answers
from sasgeo_bench.scoring.entries import _Room, _Shard


def test_answers_that_are_kept_in_memory_go_to_other_processes():
    answers = Answers.of([])
    assert _Room(0).takes(answers)
    kept = _Shard(source=Path("nowhere"), asked={}, is_tied=True, kept=answers)
    assert pickle.loads(pickle.dumps(kept)).open().table.equals(answers.table)  # noqa: S301 - written here


def test_answers_without_room_are_read_again(monkeypatch):
    assert not _Room(-1).takes(Answers.of([]))
    monkeypatch.setattr(Answers, "open", lambda *asked, **more: (asked, more))
    shard = _Shard(source=Path("there"), asked={"a": "b"}, is_tied=True)
    assert shard.open() == ((Path("there"), {"a": "b"}), {"is_tied": True})
