# SPDX-License-Identifier: Apache-2.0
"""Predictions on disk: parts of a run, which are only added; a file of the same shape is a submission."""

import os
import re
import time
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final

import pyarrow as pa

from sasgeo_bench.errors import StoreError
from sasgeo_bench.files.folders import fresh_file
from sasgeo_bench.files.json import read_json
from sasgeo_bench.files.parquet import read_batches, read_schema, read_table, write_table
from sasgeo_bench.files.paths import given_path
from sasgeo_bench.matching.results import Prediction
from sasgeo_bench.running.prediction_rows import (
    FAR,
    FLOWN_SCHEMA,
    PART_SCHEMA,
    PREDICTION_SCHEMA,
    differing_columns,
    far_fault,
    prediction_row,
    predictions_of,
    row_faults,
    schema_of,
)
from sasgeo_bench.running.run_manifest import RUN, RunManifest
from sasgeo_bench.tasks.task_rows import ASKED, asked_under
from sasgeo_bench.texts import MOST_MESSAGE, json_text, one_line

ROUND: Final = "round.json"  # beside the tasks of a run, while all of it is asked again
_MEND: Final = "write it again, or remove it where it is a part of a run"
_MEND_ROUND: Final = "remove it and enter with --again"
_ROWS_AT_ONCE: Final = 64
_PART: Final = re.compile(r"part-(\d{20})-\d+\.parquet")


def write_part(folder: Path, predictions: Sequence[Prediction], *, asked: Mapping[str, str] | None = None) -> Path:
    """Add rows to a run, in a file of their own that is written whole or not at all.

    `asked` gives the hash that each row carries, by query id (`task_files.read_asked`); without it, the file is one as
    anyone may submit it. Raise `StoreError` if the disk is full or the folder cannot be written.
    """
    path = folder / f"part-{_stamp_ns(folder):020d}-{os.getpid()}.parquet"
    rows = [prediction_row(item) for item in predictions]
    if asked is not None:
        rows = [row | {ASKED: asked[row["query_id"]]} for row in rows]
    table = pa.Table.from_pylist(rows, schema=PREDICTION_SCHEMA if asked is None else PART_SCHEMA)
    with fresh_file(path, mend="free some space and run again, it continues there") as scratch:
        write_table(table, scratch)
    return path


def _stamp_ns(folder: Path) -> int:
    """Return the time now, or just after the last part if a clock was set back: a later name is a newer row."""
    return max(time.time_ns(), 1 + max(map(_written_ns, folder.glob("part-*.parquet")), default=0))


def _written_ns(part: Path) -> int:
    """Return the stamp in the name of a part, 0 if it has none."""
    found = _PART.fullmatch(part.name)
    return int(found[1]) if found else 0


def begin_round(run: Path) -> int:
    """Begin to ask all of a run again, or go on with a round that was cut; return its stamp.

    `run` is the folder of all tasks of a run. Earlier rows stay until newer ones replace them. Raise `StoreError` if
    the record of the round cannot be read or written.
    """
    since_ns = open_round(run)
    if since_ns == 0 and run.is_dir():
        since_ns = max(time.time_ns(), 1 + max(map(_written_ns, run.rglob("part-*.parquet")), default=0))
        with fresh_file(run / ROUND, mend="check your rights and the free space") as scratch:
            scratch.write_text(json_text({"since_ns": since_ns}), encoding="utf-8")
    return since_ns


def open_round(run: Path) -> int:
    """Return the stamp of the round that a run is in, since which rows count; 0 if all rows do. Raise `StoreError`."""
    path = run / ROUND
    if not path.is_file():
        return 0
    content = read_json(path, mend=_MEND_ROUND)
    since_ns = content.get("since_ns") if isinstance(content, dict) else None
    if not isinstance(since_ns, int):
        raise StoreError(f"{path} is damaged (since_ns is {since_ns!r}): {_MEND_ROUND}")
    return since_ns


def end_round(run: Path) -> None:
    """End the round of a run: all its rows count from now on, newer ones first."""
    (run / ROUND).unlink(missing_ok=True)


def parts_of(path: Path) -> list[Path]:
    """Return the files of a run in the order they were written, or of all runs in a folder, or the file itself."""
    if path.is_file():
        return [path]
    return sorted(path.glob("part-*.parquet")) or sorted(path.rglob("part-*.parquet"), key=lambda part: part.name)


@dataclass(frozen=True, slots=True)
class Tie:
    """Link of a row to its query: id, status, and hash of the question.

    The hash is empty in files of predictions and in runs of older versions: their rows answer any query of their id.
    A caller must know otherwise which queries these are.
    """

    query_id: str
    status: str
    asked: str

    def answers(self, asked: Mapping[str, str], *, is_tied: bool = True) -> bool:
        """Return whether the row answers one of these queries as they are now; without a hash, return `is_tied`.

        >>> [Tie("a", "ok", asked).answers({"a": "ff"}) for asked in ("ff", "ee", "")]
        [True, False, True]
        """
        now = asked.get(self.query_id)
        return now is not None and (self.asked == now if self.asked else is_tied)


@dataclass(frozen=True, slots=True)
class Answers:
    """Answers of a run to some queries, a row for each, and the number of rows that answer others."""

    table: pa.Table
    aside: int

    @property
    def found(self) -> dict[str, Prediction]:
        """Return the answers by query id."""
        return {item.query_id: item for item in predictions_of(self.table)}


def read_answers(folder: Path, asked: Mapping[str, str], *, is_tied: bool = True) -> Answers:
    """Read answers to some queries from a run's folder; of two for one query, the one that was written last.

    `asked` gives the hash of each query, by id (`task_files.read_asked`); a row must carry it, tied to what `run.json`
    says. `is_tied` states whether rows without a hash are known to answer these queries. A run that was
    killed before its first row has no answers. Raise `StoreError` if a part cannot be read.
    """
    tables: list[pa.Table] = []
    seen: set[str] = set()
    aside: set[Tie] = set()
    under = {parent: asked_in(parent, asked) for parent in {part.parent for part in parts_of(folder)}}
    for part in reversed(parts_of(folder)):
        table = _checked(part, is_own=part != folder)
        ties, asked = _ties_of(table), under[part.parent]
        is_own = [tie.answers(asked, is_tied=is_tied) for tie in ties]
        aside |= {replace(tie, status="") for tie, own in zip(ties, is_own, strict=True) if not own}
        tables.append(
            _newest(table, [tie.query_id if own else None for tie, own in zip(ties, is_own, strict=True)], seen)
        )
    return Answers(_joined(tables), len(aside))


def _newest(table: pa.Table, ids: Sequence[str | None], seen: set[str]) -> pa.Table:
    """Return the last row of each id that is not `seen`, and note these as seen; rows without an id are left out."""
    rows = []
    for at in range(len(ids) - 1, -1, -1):
        name = ids[at]
        if name is not None and name not in seen:
            seen.add(name)
            rows.append(at)
    return table if len(rows) == len(table) else table.take(pa.array(rows, pa.int64()))


def merged_rows(tables: Sequence[pa.Table]) -> pa.Table:
    """Return the rows of several tables; of two for one query that of the table that comes last."""
    seen: set[str] = set()
    return _joined([_newest(table, table["query_id"].to_pylist(), seen) for table in reversed(tables)])


def _joined(tables: Sequence[pa.Table]) -> pa.Table:
    """Return the rows of several tables, of which some may lack columns; an empty one where there are none."""
    plain = PART_SCHEMA.remove_metadata().empty_table()
    some = [table.replace_schema_metadata() for table in tables if len(table)]
    return pa.concat_tables(some, promote_options="permissive") if some else plain


def asked_in(folder: Path, asked: Mapping[str, str]) -> Mapping[str, str]:
    """Return the hash that each row must carry: of its query, and of what `run.json` records.

    Raise `StoreError` if `run.json` is damaged.

    >>> asked_in(Path("nowhere"), {"a": "ff"})
    {'a': 'ff'}
    """
    key = read_key(folder)
    return {name: asked_under(one, key) for name, one in asked.items()}


def read_key(folder: Path) -> str | None:
    """Read what rows are tied to besides their queries from `run.json`. Raise as `RunManifest.open` does."""
    return (RunManifest.open(folder) or RunManifest()).key


def read_predictions(path: str | Path) -> Iterator[Prediction]:
    """Read predictions of a run's folder or a file, newest first; of two for one query, the one written last.

    A folder holds two where a query was asked again, or was drawn anew and asked: `read_answers` separates them.

    Raises
    ------
    StoreError
        If there is none, or a file cannot be read.
    """
    for table in _tables_of(given_path(path)):
        yield from predictions_of(table)


def read_rows(path: Path) -> pa.Table:
    """Read the rows of a run's folder or a file, one for each query. Raise as `read_predictions` does."""
    return _joined(list(_tables_of(path)))


def _tables_of(path: Path) -> Iterator[pa.Table]:
    parts = parts_of(path)
    if not parts:
        raise StoreError(f"{path} holds no predictions: run a matcher first, or name a predictions file")
    seen: set[str] = set()
    for part in reversed(parts):
        table = _checked(part, is_own=part != path)
        yield _newest(table, table["query_id"].to_pylist(), seen)


def _checked(part: Path, *, is_own: bool) -> pa.Table:
    """Read a part; refuse other columns than those of predictions, and rows outside their bounds."""
    table = read_part(part, is_own=is_own)
    for name, found, expected in differing_columns(table):
        fault = f"{name}: found {found}, expected {expected}"[:200]
        raise StoreError(f"{part} holds no predictions ({fault}): 'validate' lists all that is missing")
    for wrong in row_faults(table):
        fault = one_line(f"{wrong.column}: found {wrong.found}, expected {wrong.expected}")
        raise StoreError(f"{part}, row {wrong.row}, is no prediction ({fault}): 'validate' says all that is wrong")
    return table


def read_part(path: Path, *, is_own: bool) -> pa.Table:
    """Read a whole parquet file; raise `StoreError` if it is missing, damaged, too large, or no parquet file.

    `is_own` is True of a part of a run, whose answers were held to their bounds before they were written: the lengths
    of others are looked at first, which takes as long as reading them.
    """
    if not is_own:
        check_lengths(path, mend=_MEND)
    table = read_table(path, mend=_MEND)
    try:
        table.validate(full=True)  # offsets, and texts that are no UTF-8, which Arrow reads unchecked
    except pa.ArrowException as error:
        raise StoreError(f"{path} cannot be read ({one_line(str(error))}): {_MEND}") from error
    return table


def check_lengths(path: Path, *, mend: str) -> None:
    """Raise `StoreError` if a list or text of a file is far beyond its bound, before the file is read as a whole.

    A small file may unpack to lists and texts that no memory holds.
    """
    before = 0
    batches = read_batches(
        path, mend=mend, rows=_ROWS_AT_ONCE, columns=PART_SCHEMA.names, text_bytes=FAR * MOST_MESSAGE
    )
    for batch in batches:
        far = far_fault(batch)
        if far is not None:
            fault = f"{far.column}: found {far.found}, expected {far.expected}"
            raise StoreError(f"{path}, row {before + far.row}, is no prediction ({fault}): {mend}")
        before += len(batch)


def items_of(table: pa.Table) -> Iterator[dict[str, Any]]:
    """Yield the rows of a table, few of them at once as objects of Python, which are far larger."""
    for batch in table.to_batches(max_chunksize=_ROWS_AT_ONCE):
        yield from batch.to_pylist()


def merge_runs(runs: Sequence[Path], into: Path, *, asked: Mapping[str, str] | None = None) -> int:
    """Write the predictions of folders and files into one file, sorted by query; return their number.

    Of two for one query the first counts, in the order of `runs`. The same predictions give the same file, whatever
    parts they came in. With `asked`, only answers to these queries (`task_files.read_asked`) are taken from folders.
    Answers of trackers keep `is_accepted` and `covariance`.

    Raises
    ------
    StoreError
        If there are none, the folders are of different matchers, versions or settings, two rows answer different
        queries of one id, a file cannot be read, or the new one cannot be written.
    """
    check_one_matcher(runs)
    if asked is None:
        _check_one_query(runs)
    if into.exists() and not _is_ours(into):
        raise StoreError(f"{into} is no predictions file and would be lost: name another one")
    found: dict[str, Prediction] = {}
    for path in runs:
        for prediction in _to_merge(path, asked):
            found.setdefault(prediction.query_id, prediction)
    rows = [prediction_row(found[name]) for name in sorted(found)]
    with fresh_file(into, mend="check your rights and the free space") as scratch:
        write_table(pa.Table.from_pylist(rows, schema=schema_of(found.values())), scratch)
    return len(rows)


def _to_merge(path: Path, asked: Mapping[str, str] | None) -> Iterable[Prediction]:
    """Read all rows of a file, or the answers of a folder to the requested queries."""
    if asked is None or not path.is_dir() or not parts_of(path):
        return read_predictions(path)
    return read_answers(path, asked).found.values()


def check_one_matcher(runs: Sequence[Path]) -> None:
    """Raise `StoreError` if the `run.json` of two folders name different matchers, versions or settings."""
    folders = [run.parent for path in runs if path.is_dir() for run in sorted(path.rglob(RUN))]
    known = [(path, run) for path in folders if (run := RunManifest.open(path)) is not None]
    for path, run in known[1:]:
        first, other = known[0]
        if run.hash != other.hash:
            raise StoreError(
                f"{path} holds answers of {_who(run)}, {first} those of {_who(other)}: "
                "two matchers, versions or settings are never mixed, name the folder of one"
            )


def _check_one_query(runs: Sequence[Path]) -> None:
    """Refuse answers to two versions of a query, which a file of predictions could not separate."""
    found: dict[str, str] = {}
    for path in runs:
        for tie in read_ties(path) if path.is_dir() else []:
            if tie.asked and found.setdefault(tie.query_id, tie.asked) != tie.asked:
                raise StoreError(
                    f"{path} holds answers to query {tie.query_id} and to an earlier version of it: "
                    "name the tasks with --tasks"
                )


def _who(run: RunManifest) -> str:
    return f"{run.matcher.name or 'an unknown matcher'} {run.matcher.version} ({run.hash})"


def _is_ours(path: Path) -> bool:
    try:
        known = (PREDICTION_SCHEMA.names, FLOWN_SCHEMA.names)
        return path.is_file() and read_schema(path, mend=_MEND).names in known
    except StoreError:
        return False


def read_ties(folder: Path, *, since_ns: int = 0) -> list[Tie]:
    """Read the links of a run's rows to their queries, as written; raise `StoreError` if a part cannot be read.

    Parts that were written before the stamp `since_ns` are left out.
    """
    found: list[Tie] = []
    for part in parts_of(folder):
        if _written_ns(part) < since_ns:
            continue
        table = read_part(part, is_own=True)
        if differing_columns(table):
            raise StoreError(f"{part} holds no predictions: move it out of the run's folder")
        found += _ties_of(table)
    return found


def _ties_of(table: pa.Table) -> list[Tie]:
    columns = [name for name in ("query_id", "status", ASKED) if name in table.column_names]
    return [tie_of(row) for row in table.select(columns).to_pylist()]


def tie_of(row: Mapping[str, Any]) -> Tie:
    """Return the link of one row to its query."""
    return Tie(str(row["query_id"]), str(row["status"]), str(row.get(ASKED) or ""))


def ids_done(folder: Path, asked: Mapping[str, str], *, again: Iterable[str] = (), since_ns: int = 0) -> set[str]:
    """Return the ids of queries that a run has answered as they are now.

    Rows with a status in `again` do not count, nor those that were written before the stamp `since_ns`. `asked` must
    include the training (`asked_in`). Raise `StoreError` if a part cannot be read.
    """
    ties = read_ties(folder, since_ns=since_ns) if folder.is_dir() else []
    return {tie.query_id for tie in ties if tie.status not in set(again) and tie.answers(asked)}
