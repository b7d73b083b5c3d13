# SPDX-License-Identifier: Apache-2.0
"""Predictions held against the tasks they answer: every violation by row and column, found and expected."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import pyarrow as pa

from sasgeo_bench.errors import MatchError, PoseError, StoreError
from sasgeo_bench.matcher import MOST_CANDIDATES, Match, check_match
from sasgeo_bench.query import Query
from sasgeo_bench.results import STATUSES
from sasgeo_bench.store import rundir, taskdir

_ANSWERED: Final = "ok"


@dataclass(frozen=True, slots=True, kw_only=True)
class Violation:
    """One fault: the file, the row's number in it (from 0; -1 for the whole file), the column, found and expected."""

    file: str
    row: int
    column: str
    found: str
    expected: str

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
        Task folders that it should answer, and no others.

    Yields
    ------
    Violation
        In the order of the rows; queries without a row come last.

    Raises
    ------
    StoreError
        If a file cannot be read at all.
    """
    queries = {query.query_id: query for task in tasks for query in taskdir.read_queries(task)}
    seen: dict[str, str] = {}
    files = rundir.parts_of(path)
    if not files:
        message = f"{path} holds no predictions: name a predictions file, or the folder of a run"
        raise StoreError(message)
    # In a run's folder a query stands twice where it was asked again: the newer row counts.
    for file in reversed(files):
        before = frozenset(seen) if path.is_dir() else frozenset()
        table = rundir.read_part(file)
        faults = list(_schema_faults(file.name, table))
        yield from faults
        if any(fault.expected.startswith("a column") for fault in faults):
            continue
        for row, item in enumerate(table.to_pylist()):
            if item["query_id"] not in before:
                yield from _row_faults(file.name, row, item, queries, seen)
    missing = [name for name in queries if name not in seen]
    for name in missing:
        yield Violation(
            file=path.name, row=-1, column="query_id", found=f"no row for {name}", expected="one for every query"
        )


def _schema_faults(file: str, table: pa.Table) -> Iterator[Violation]:
    for field in rundir.PREDICTION_SCHEMA:
        if field.name not in table.column_names:
            yield Violation(file=file, row=-1, column=field.name, found="nothing", expected=f"a column of {field.type}")
        elif not _is_like(table.schema.field(field.name).type, field.type):
            found = str(table.schema.field(field.name).type)
            yield Violation(file=file, row=-1, column=field.name, found=found, expected=f"a column of {field.type}")


def _is_like(found: pa.DataType, wanted: pa.DataType) -> bool:
    """Whether a column can be read as another: any float for a float, any string for a string, null for anything."""
    if pa.types.is_null(found) or found.equals(wanted):
        return True
    if pa.types.is_floating(wanted):
        return bool(pa.types.is_floating(found) or pa.types.is_integer(found))
    if pa.types.is_string(wanted):
        return bool(pa.types.is_string(found) or pa.types.is_large_string(found))
    if pa.types.is_list(wanted):
        is_list = pa.types.is_list(found) or pa.types.is_large_list(found)
        return is_list and pa.types.is_struct(found.value_type) and _has_fields(found.value_type, wanted.value_type)
    return bool(pa.types.is_map(wanted) and pa.types.is_map(found))


def _has_fields(found: pa.StructType, wanted: pa.StructType) -> bool:
    names = {field.name for field in found}
    return all(field.name in names and _is_like(found.field(field.name).type, field.type) for field in wanted)


def _row_faults(
    file: str, row: int, item: Mapping[str, Any], queries: Mapping[str, Query], seen: dict[str, str]
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
                file=file, row=row, column="candidates", found=f"{count} poses", expected=f"none with {item['status']}"
            )
        return
    yield from _answer_faults(file, row, item, queries[name])


def _answer_faults(file: str, row: int, item: Mapping[str, Any], query: Query) -> Iterator[Violation]:
    """What is wrong with the answer itself."""
    empty = next((at for at, one in enumerate(item["candidates"] or ()) if one is None or None in one.values()), None)
    if empty is not None:
        yield Violation(file=file, row=row, column="candidates", found=f"null in place {empty}", expected="numbers")
        return
    try:
        prediction = rundir.prediction_of(item)
        match = Match(
            poses=[pose for pose, _ in prediction.candidates],
            scores=[score for _, score in prediction.candidates],
            confidence=prediction.confidence,
            diagnostics=prediction.diagnostics,
        )
        check_match(match, query, top_k=MOST_CANDIDATES)
    except (MatchError, PoseError) as error:
        text = str(error)
        column = "confidence" if "confidence" in text else "diagnostics" if "diagnostics" in text else "candidates"
        found, _, expected = text.partition(", expected ")
        yield Violation(file=file, row=row, column=column, found=found, expected=expected or "an answer")
