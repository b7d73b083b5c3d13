# SPDX-License-Identifier: Apache-2.0
"""The control that is given the truth, an upper bound for all matchers; no plugin can be one."""

import time
from dataclasses import replace
from pathlib import Path
from types import TracebackType
from typing import Final, Self

from sasgeo_bench.core.errors import StoreError
from sasgeo_bench.core.plugins import ORACLE
from sasgeo_bench.matching.matcher import MatcherCard, Prediction
from sasgeo_bench.running.worker import Reply
from sasgeo_bench.tasks.query import SEQUENCE, Query, Truth
from sasgeo_bench.tasks.task_files import TRUTH, query_from, read_truths

CARD: Final = MatcherCard(
    name=ORACLE,
    version="1",
    title="Control: the truth itself",
    source="original",
    ours="all of it",
    licence="Apache-2.0",
    tracks=("retrieval", "localization", "sequence"),
    limits="is no method: it reads the answers, so that whatever does not score it as perfect is at fault",
)
_SURE: Final = (0.01, 0.0, 0.0, 0.0, 0.01, 0.0, 0.0, 0.0, 0.01)  # covariance of an estimate on a flight: a decimetre
ISOLATION: Final = {"truth": "given, as this control needs it"}


class Oracle:
    """Answers with the truths of a task, and withholds where the place is absent; runs in place of a `Worker`."""

    def __init__(self, truth_folder: Path) -> None:
        self.isolation = dict(ISOLATION)
        self.peak_bytes = 0
        self._folder = truth_folder
        self._truths: dict[str, Truth] = {}

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Leave nothing."""

    def end(self) -> None:
        """End nothing: there is no process."""

    def prepare(self, region: Path, learned: str | None = None) -> Reply:
        """Read the truths; raise `StoreError` if they are missing."""
        del region, learned
        if not (self._folder / TRUTH).is_file():
            raise StoreError(f"{self._folder} holds no truths, and {ORACLE} answers with them: run it where they are")
        start = time.perf_counter()
        self._truths = {truth.query_id: truth for truth in read_truths(self._folder)}
        seconds = time.perf_counter() - start
        return Reply(status="ok", seconds=seconds, own_s=seconds, grown_bytes=0)

    def match(self, query: bytes, *, top_k: int) -> Reply:
        """Answer one query."""
        del top_k
        start = time.perf_counter()
        asked = query_from(query)
        truth = self._truths.get(asked.query_id)
        if truth is None:
            raise StoreError(f"{self._folder} holds no truth of query {asked.query_id}: make the queries again")
        return Reply(status="ok", found=right_answer(asked, truth), seconds=time.perf_counter() - start)


def right_answer(query: Query, truth: Truth) -> Prediction:
    """Return the right answer: the true pose, the right candidate with true heading and scale, or none.

    A flight goes on off the map: its oracle knows where, and does not say that it may be relied on.
    """
    pose = truth.pose
    if pose is None or not (truth.is_present or query.track == SEQUENCE):
        pose = None
    elif query.track == "retrieval":
        right = query.candidates[truth.candidate]
        pose = replace(pose, easting_m=right.easting_m, northing_m=right.northing_m)
    found = Prediction(
        query_id=query.query_id,
        candidates=() if pose is None else ((pose, 1.0),),
        confidence=0.0 if pose is None else 1.0,
    )
    return found if query.step is None else replace(found, is_accepted=truth.is_present, covariance=_SURE)
