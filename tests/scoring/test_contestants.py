# SPDX-License-Identifier: Apache-2.0
"""Answers of entries, as they go to the processes that fit rejectors."""

import pickle
from functools import partial
from pathlib import Path

from sasgeo_bench.matching.matcher import Prediction
from sasgeo_bench.running.prediction_files import Answers, StoredAnswers
from sasgeo_bench.scoring.entries import _merged, _Room, _same


def test_answers_that_are_kept_in_memory_go_to_other_processes():
    kept = partial(_merged, [partial(_same, Answers.of([Prediction(query_id="a")]))])
    stored = StoredAnswers({Path("there"): kept}, {"a": Path("there")})
    assert pickle.loads(pickle.dumps(stored))["a"] == Prediction(query_id="a")  # noqa: S301 - written here


def test_there_is_room_for_answers_until_it_is_taken():
    assert _Room(0).takes(Answers.of([]))
    assert not _Room(-1).takes(Answers.of([]))
