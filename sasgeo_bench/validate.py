# SPDX-License-Identifier: Apache-2.0
"""Predictions held against the tasks they answer: every violation by row and column, found and expected."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from sasgeo_bench.errors import MatchError, PoseError, StoreError, counted
from sasgeo_bench.matcher import MOST_CANDIDATES, Match, check_match
from sasgeo_bench.query import Head
from sasgeo_bench.results import STATUSES
from sasgeo_bench.store import rundir, taskdir
from sasgeo_bench.store.runrows import differing_columns, prediction_of

_ANSWERED: Final = "ok"
_NO_ROW: Final = "no row for "


@dataclass(frozen=True, slots=True, kw_only=True)
class Violation:
    """One fault: the file, the row's number in it (from 0; -1 for the whole file), the column, found and expected."""

    file: str
    row: int
    column: str
    found: str
    expected: str

    @property
    def is_missing_row(self) -> bool:
        """Whether it says that a query has no row."""
        return self.found.startswith(_NO_ROW)

    def to_text(self) -> str:
        """One line.

        Examples
        --------
        >>> Violation(file="mine.parquet", row=3, column="confidence", found="1.5", expected="0..1 or null").to_text()
        'mine.parquet, row 3, confidence: found 1.5, expected 0..1 or null'
        """
        where = self.file if self.row < 0 else f"{self.file}, row {self.row}"
        return f"{where}, {self.column}: found {self.found}, expected {self.expected}"


def validate(path: Path, tasks: Sequence[Path]) -> Iterator[Violation]:
    """Hold predictions against tasks.

    Parameters
    ----------
    path : Path
        A predictions file, or a run's folder of parts, newest first; there a query may have been asked again.
    tasks : sequence of Path
        Task folders that it should answer, and no others; rows of a run's folder that say they answer something else
        are passed over (`set_aside` counts them).

    Yields
    ------
    Violation
        In the order of the rows; queries without a row come last, unless a file could not be read by its columns.

    Raises
    ------
    StoreError
        If a file cannot be read at all, a task is of another version, or the folder holds runs of two matchers.
    """
    rundir.check_one_matcher([path])
    queries = {query.query_id: query for task in tasks for query in _queries(task)}
    asked = _asked(tasks)
    seen: dict[str, str] = {}
    files = rundir.parts_of(path)
    if not files:
        message = f"{path} holds no predictions: name a predictions file, or the folder of a run"
        raise StoreError(message)
    under = {parent: rundir.asked_in(parent, asked) for parent in {file.parent for file in files} if path.is_dir()}
    unread = 0
    # In a run's folder a query stands twice where it was asked again: the newer row counts.
    for file in reversed(files):
        before = frozenset(seen) if path.is_dir() else frozenset()
        table = rundir.read_part(file)
        differing = differing_columns(table)
        for column, found, expected in differing:
            yield Violation(file=file.name, row=-1, column=column, found=found, expected=f"a column of {expected}")
        unread += bool(differing)
        for row, item in enumerate([] if differing else table.to_pylist()):
            tie = rundir.tie_of(item)
            is_aside = path.is_dir() and bool(tie.asked) and not tie.answers(under[file.parent])
            if item["query_id"] not in before and not is_aside:
                yield from _row_faults(file.name, row, item, queries, seen)
    missing = [] if unread else [name for name in queries if name not in seen]
    for name in missing:
        yield Violation(
            file=path.name, row=-1, column="query_id", found=f"{_NO_ROW}{name}", expected="one for every query"
        )


def set_aside(path: Path, tasks: Sequence[Path]) -> int:
    """How many answers of a run's folder are to queries that the tasks do not hold, or do not hold as they were.

    Raises
    ------
    StoreError
        If a file cannot be read.
    """
    asked = _asked(tasks)
    found: set[tuple[str, str]] = set()
    for parent in {part.parent for part in rundir.parts_of(path)} if path.is_dir() else ():
        under = rundir.asked_in(parent, asked)
        found |= {(tie.query_id, tie.asked) for tie in rundir.read_ties(parent) if tie.asked and not tie.answers(under)}
    return len(found)


def _asked(tasks: Sequence[Path]) -> dict[str, str]:
    return {name: said for task in tasks for name, said in taskdir.read_asked(task).items()}


def _queries(task: Path) -> Iterator[Head]:
    """Queries of a task that this program can read; what was seen is no matter, and stored results hold none of it."""
    taskdir.read_task(task)
    yield from taskdir.read_heads(task)


def _row_faults(
    file: str, row: int, item: Mapping[str, Any], queries: Mapping[str, Head], seen: dict[str, str]
) -> Iterator[Violation]:
    name = item["query_id"]
    if name not in queries:
        yield Violation(
            file=file, row=row, column="query_id", found=repr(name), expected="the id of a query of the tasks"
        )
        return
    if name in seen:
        yield Violation(
            file=file, row=row, column="query_id", found=f"{name} again ({seen[name]})", expected="each query once"
        )
        return
    seen[name] = f"{file}, row {row}"
    if item["status"] not in STATUSES:
        yield Violation(file=file, row=row, column="status", found=repr(item["status"]), expected=", ".join(STATUSES))
        return
    latency_s = item["latency_s"]
    if latency_s is not None and not latency_s >= 0:
        yield Violation(file=file, row=row, column="latency_s", found=str(latency_s), expected="0 or more, or null")
    if item["status"] != _ANSWERED:
        if item["candidates"]:
            count = len(item["candidates"])
            yield Violation(
                file=file,
                row=row,
                column="candidates",
                found=counted(count, "pose"),
                expected=f"none with {item['status']}",
            )
        return
    yield from _answer_faults(file, row, item, queries[name])


def _answer_faults(file: str, row: int, item: Mapping[str, Any], query: Head) -> Iterator[Violation]:
    """What is wrong with the answer itself."""
    empty = next((at for at, one in enumerate(item["candidates"] or ()) if one is None or None in one.values()), None)
    if empty is not None:
        yield Violation(file=file, row=row, column="candidates", found=f"null in place {empty}", expected="numbers")
        return
    try:
        prediction = prediction_of(item)
        match = Match(
            poses=[pose for pose, _ in prediction.candidates],
            scores=[score for _, score in prediction.candidates],
            confidence=prediction.confidence,
            diagnostics=prediction.diagnostics,
        )
        check_match(match, query, top_k=MOST_CANDIDATES)
    except PoseError as error:
        expected, _, found = str(error).partition(", got ")
        yield Violation(file=file, row=row, column="candidates", found=found, expected=expected)
    except MatchError as error:
        found, _, expected = str(error).partition(", expected ")
        column = next((name for name in ("diagnostics", "confidence") if name in found), "candidates")
        yield Violation(file=file, row=row, column=column, found=found, expected=expected or "an answer")
