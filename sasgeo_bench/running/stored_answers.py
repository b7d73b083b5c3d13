# SPDX-License-Identifier: Apache-2.0
"""Answers of one entry to many tasks, of which one is in memory at a time."""

from collections.abc import Callable, Iterable, Iterator, Mapping
from functools import partial
from pathlib import Path
from typing import Self

import pyarrow as pa

from sasgeo_bench.matching.results import Prediction
from sasgeo_bench.running.prediction_rows import PREDICTION_SCHEMA, AnswerColumns, predictions_of, table_of


class StoredAnswers(Mapping[str, Prediction]):
    """Answers to the queries of some tasks, read from their files when they are asked for, a task at a time.

    `read` returns the rows of each task, by its folder; `task_of` is the folder of each query. Who asks in the order of
    the tasks reads each of them once.
    """

    def __init__(self, read: Mapping[Path, Callable[[], pa.Table]], task_of: Mapping[str, Path]) -> None:
        self._read, self._task_of = dict(read), task_of
        self._last: tuple[Path | None, dict[str, Prediction]] = (None, {})

    @classmethod
    def of(cls, answers: Iterable[Prediction]) -> Self:
        """Return answers that are in memory, as those of one task."""
        listed = list(answers)
        return cls({Path(): partial(table_of, listed)}, dict.fromkeys((item.query_id for item in listed), Path()))

    def columns(self, query_ids: Iterable[str]) -> Iterator[AnswerColumns]:
        """Yield the answers to all queries of the tasks that some queries belong to, a task at a time."""
        asked = {self._task_of[name] for name in query_ids if name in self._task_of}
        for task, read in self._read.items():
            if task in asked:
                yield AnswerColumns.of(read())

    def rows(self, task: Path) -> pa.Table:
        """Return the rows of one task. Raise `StoreError` if they cannot be read."""
        return self._read[task]()

    def __getitem__(self, query_id: str) -> Prediction:
        """Return one answer; raise KeyError without one."""
        task = self._task_of[query_id]
        if task not in self._read:
            raise KeyError(query_id)
        return self._of(task)[query_id]

    def __iter__(self) -> Iterator[str]:
        """Yield the ids of all queries that are answered."""
        for task in self._read:
            yield from self._of(task)

    def __len__(self) -> int:
        """Return the number of answers."""
        return sum(len(self._of(task)) for task in self._read)

    def _of(self, task: Path) -> dict[str, Prediction]:
        if self._last[0] != task:
            self._last = (task, {item.query_id: item for item in predictions_of(self.rows(task))})
        return self._last[1]

    def lean(self) -> "StoredAnswers":
        """Return the same answers without their candidates, which take far longer to read than all the rest."""
        return StoredAnswers({task: partial(_without_poses, read) for task, read in self._read.items()}, self._task_of)


def _without_poses(read: Callable[[], pa.Table]) -> pa.Table:
    table = read()
    nothing = pa.array([[]] * len(table), PREDICTION_SCHEMA.field("candidates").type)
    return table.set_column(table.column_names.index("candidates"), "candidates", nothing)
