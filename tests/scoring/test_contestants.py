# SPDX-License-Identifier: Apache-2.0
"""Answers of entries, as they go to the processes that fit rejectors."""

import pickle

import pytest

from sasgeo_bench.running.prediction_files import Answers
from sasgeo_bench.scoring.contestants import _Room


def test_answers_that_are_kept_in_memory_go_to_other_processes():
    answers = Answers.of([])
    kept = _Room(0).keep(answers, pytest.fail)
    assert pickle.loads(pickle.dumps(kept))().table.equals(answers.table)  # noqa: S301 - written here


def test_answers_without_room_are_read_again():
    assert _Room(-1).keep(Answers.of([]), pytest.fail) is pytest.fail
