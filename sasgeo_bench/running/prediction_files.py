# SPDX-License-Identifier: Apache-2.0
"""Predictions on disk: parts that are only ever added, and `run.json`; a file of the same shape is a submission."""

import os
import re
import time
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final

import pyarrow as pa

from sasgeo_bench.bounds import one_line
from sasgeo_bench.errors import MatchError, StoreError
from sasgeo_bench.files.json import read_json
from sasgeo_bench.files.parquet import read_schema, read_table, write_table
from sasgeo_bench.matching.learned_file import TrainingRecord
from sasgeo_bench.matching.results import Prediction
from sasgeo_bench.running.prediction_rows import (
    PART_SCHEMA,
    PREDICTION_SCHEMA,
    differing_columns,
    prediction_row,
    predictions_of,
    row_faults,
)
from sasgeo_bench.tasks.task_rows import ASKED, asked_under
from sasgeo_bench.texts import json_text

RUN: Final = "run.json"
_MEND: Final = "write it again, or remove it where it is a part of a run"
_PART: Final = re.compile(r"part-(\d{20})-\d+\.parquet")


def write_part(folder: Path, predictions: Sequence[Prediction], *, asked: Mapping[str, str] | None = None) -> Path:
    """Add some rows to a run, in a file of their own that is there whole or not at all.

    Parameters
    ----------
    folder : Path
        Of the run.
    predictions : sequence of Prediction
        The rows.
    asked : mapping of str to str, optional
        What each of them answers, by query id (`task_files.read_asked`); without, a file as anyone may submit it.

    Raises
    ------
    StoreError
        If the disk is full or the folder cannot be written; what was there before is as it was.
    """
    name = f"part-{_stamp_ns(folder):020d}-{os.getpid()}"
    scratch, path = folder / f".{name}.partial", folder / f"{name}.parquet"
    rows = [prediction_row(item) for item in predictions]
    if asked is not None:
        rows = [row | {ASKED: asked[row["query_id"]]} for row in rows]
    table = pa.Table.from_pylist(rows, schema=PREDICTION_SCHEMA if asked is None else PART_SCHEMA)
    try:
        folder.mkdir(parents=True, exist_ok=True)
        write_table(table, scratch)
        _flush(scratch)
        scratch.rename(path)
    except OSError as error:
        _remove(scratch)
        message = (
            f"{folder} cannot be written ({error.strerror or error}): free some space and run again, it goes on there"
        )
        raise StoreError(message) from error
    return path


def _stamp_ns(folder: Path) -> int:
    """Now, or just after the last part where a clock was set back: the later name is the newer row."""
    before = (_PART.fullmatch(path.name) for path in folder.glob("part-*.parquet"))
    return max(time.time_ns(), 1 + max((int(found[1]) for found in before if found), default=0))


def _remove(path: Path) -> None:
    try:
        path.unlink()
    except OSError:
        return


def _flush(path: Path) -> None:
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def parts_of(path: Path) -> list[Path]:
    """The files of a run's folder in the order they were written, or of all runs in a folder, or the file itself."""
    if path.is_file():
        return [path]
    return sorted(path.glob("part-*.parquet")) or sorted(path.rglob("part-*.parquet"), key=lambda part: part.name)


@dataclass(frozen=True, slots=True)
class Tie:
    """Link of a row to its query: id, status, and hash of the question.

    The hash is empty in files of predictions and in runs of an older program: their rows answer whatever has their id.
    Whoever takes them for answers must know from elsewhere to which queries.
    """

    query_id: str
    status: str
    asked: str

    def answers(self, asked: Mapping[str, str], *, is_tied: bool = True) -> bool:
        """True if the row answers one of these queries as they are now; without a hash it does if `is_tied`.

        Examples
        --------
        >>> [Tie("a", "ok", said).answers({"a": "ff"}) for said in ("ff", "ee", "")]
        [True, False, True]
        """
        now = asked.get(self.query_id)
        return now is not None and (self.asked == now if self.asked else is_tied)


@dataclass(frozen=True, slots=True)
class Answers:
    """Answers of a run's folder to some queries, by id, and how many rows beside them answer others."""

    found: dict[str, Prediction]
    aside: int


def read_answers(folder: Path, asked: Mapping[str, str], *, is_tied: bool = True) -> Answers:
    """Answers to some queries out of a run's folder; of two for one query, the one that was written last.

    Parameters
    ----------
    folder : Path
        Of a run; one that was cut off before its first row has none.
    asked : mapping of str to str
        By query id, the hash of what is asked (`task_files.read_asked`). A row must say it, with what `run.json` beside
        it says was learnt.
    is_tied : bool
        Whether rows that do not say so are known to answer these queries.

    Raises
    ------
    StoreError
        If a part cannot be read.
    """
    found: dict[str, Prediction] = {}
    aside: set[Tie] = set()
    under = {parent: asked_in(parent, asked) for parent in {part.parent for part in parts_of(folder)}}
    for part in reversed(parts_of(folder)):
        table = _checked(part)
        ties, asked = _ties_of(table), under[part.parent]
        is_mine = [tie.answers(asked, is_tied=is_tied) for tie in ties]
        aside |= {replace(tie, status="") for tie, mine in zip(ties, is_mine, strict=True) if not mine}
        if not all(is_mine):
            table = table.filter(pa.array(is_mine, pa.bool_()))
        for prediction in predictions_of(table):
            found.setdefault(prediction.query_id, prediction)
    return Answers(found, len(aside))


def asked_in(folder: Path, asked: Mapping[str, str]) -> Mapping[str, str]:
    """Return the hash that each row must carry: of its query, and of what `run.json` says was learnt.

    Parameters
    ----------
    folder : Path
        Of a run.
    asked : mapping of str to str
        By query id (`task_files.read_asked`).

    Raises
    ------
    StoreError
        If `run.json` is damaged.

    Examples
    --------
    >>> asked_in(Path("nowhere"), {"a": "ff"})
    {'a': 'ff'}
    """
    key = read_key(folder)
    return {name: asked_under(one, key) for name, one in asked.items()}


def read_key(folder: Path) -> str | None:
    """Read the hash of the training result from `run.json`; None without training.

    Raises
    ------
    StoreError
        If `run.json` is damaged.
    """
    try:
        said = TrainingRecord.of(read_run(folder) or {})
    except MatchError as error:
        message = f"{folder / RUN} is damaged ({error}): remove it and run again, the parts beside it are kept"
        raise StoreError(message) from error
    return None if said is None else said.key


def read_predictions(path: str | Path) -> Iterator[Prediction]:
    """Predictions of a run's folder or of a file, newest first; of two for one query, the one that was written last.

    A folder holds two where a query was asked again, or was drawn anew and asked: `read_answers` tells them apart.

    Raises
    ------
    StoreError
        If there is none, or a file cannot be read.
    """
    parts = parts_of(Path(path))
    if not parts:
        message = f"{path} holds no predictions: run a matcher first, or name a predictions file"
        raise StoreError(message)
    seen: set[str] = set()
    for part in reversed(parts):
        for prediction in predictions_of(_checked(part)):
            if prediction.query_id not in seen:
                seen.add(prediction.query_id)
                yield prediction


def _checked(part: Path) -> pa.Table:
    """A part that holds the columns of predictions, and rows that are some."""
    table = read_part(part)
    for name, found, expected in differing_columns(table):
        fault = f"{name}: found {found}, expected {expected}"[:200]
        message = f"{part} holds no predictions ({fault}): 'validate' lists all that is missing"
        raise StoreError(message)
    for wrong in row_faults(table):
        fault = one_line(f"{wrong.column}: found {wrong.found}, expected {wrong.expected}")
        message = f"{part}, row {wrong.row}, is no prediction ({fault}): 'validate' says all that is wrong"
        raise StoreError(message)
    return table


def read_part(path: Path) -> pa.Table:
    """A parquet file whole.

    Raises
    ------
    StoreError
        If it is not there, damaged, too large, or no parquet file.
    """
    table = read_table(path, mend=_MEND)
    try:
        table.validate(full=True)  # offsets, and texts that are none, which Arrow takes as they come
    except pa.ArrowException as error:
        message = f"{path} cannot be read ({one_line(str(error))}): {_MEND}"
        raise StoreError(message) from error
    return table


def merge_runs(runs: Sequence[Path], into: Path, *, asked: Mapping[str, str] | None = None) -> int:
    """Write the predictions of several folders or files into one file, sorted by query; how many there are.

    Of two for one query the first counts, in the order of `runs`. The same predictions give the same file, whatever
    parts they came in.

    Parameters
    ----------
    runs : sequence of Path
        Folders and files.
    into : Path
        File to write.
    asked : mapping of str to str, optional
        Of folders only answers to these queries (`task_files.read_asked`); without, all there are.

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
        message = f"{into} is no predictions file and would be lost: name another one"
        raise StoreError(message)
    found: dict[str, Prediction] = {}
    for path in runs:
        for prediction in _to_merge(path, asked):
            found.setdefault(prediction.query_id, prediction)
    rows = [prediction_row(found[name]) for name in sorted(found)]
    scratch = into.with_name(f".{into.name}.partial")
    try:
        into.parent.mkdir(parents=True, exist_ok=True)
        write_table(pa.Table.from_pylist(rows, schema=PREDICTION_SCHEMA), scratch)
        _flush(scratch)
        scratch.rename(into)
    except OSError as error:
        _remove(scratch)
        message = f"{into} cannot be written ({error.strerror or error}): check your rights and the free space"
        raise StoreError(message) from error
    return len(rows)


def _to_merge(path: Path, asked: Mapping[str, str] | None) -> Iterable[Prediction]:
    """Read all rows of a file, or the requested rows of a folder."""
    if asked is None or not path.is_dir() or not parts_of(path):
        return read_predictions(path)
    return read_answers(path, asked).found.values()


def check_one_matcher(runs: Sequence[Path]) -> None:
    """Refuse folders whose `run.json` say different things of who answered; files say nothing of it.

    Raises
    ------
    StoreError
        If two folders are of different matchers, versions or settings, or a `run.json` is damaged.

    Examples
    --------
    >>> check_one_matcher([Path("mine.parquet")])
    """
    folders = [run.parent for path in runs if path.is_dir() for run in sorted(path.rglob(RUN))]
    said = [(path, read_run(path)) for path in folders]
    known = [(path, about) for path, about in said if about is not None]
    for path, about in known[1:]:
        first, other = known[0]
        if about.get("hash") != other.get("hash"):
            message = (
                f"{path} holds answers of {_who(about)}, {first} those of {_who(other)}: "
                "two matchers, versions or settings are never mixed, name the folder of one"
            )
            raise StoreError(message)


def _check_one_query(runs: Sequence[Path]) -> None:
    """Refuse answers to a query and to what it was once: a file of predictions could not tell them apart."""
    found: dict[str, str] = {}
    for path in runs:
        for tie in read_ties(path) if path.is_dir() else []:
            if tie.asked and found.setdefault(tie.query_id, tie.asked) != tie.asked:
                message = (
                    f"{path} holds answers to query {tie.query_id} and to what it was when it was drawn otherwise: "
                    "name the tasks with --tasks"
                )
                raise StoreError(message)


def _who(about: Mapping[str, Any]) -> str:
    card = about.get("matcher")
    name, version = (card.get("name"), card.get("version")) if isinstance(card, dict) else (None, None)
    return f"{name} {version} ({about.get('hash')})"


def _is_ours(path: Path) -> bool:
    try:
        return path.is_file() and read_schema(path, mend=_MEND).names == PREDICTION_SCHEMA.names
    except StoreError:
        return False


def read_ties(folder: Path) -> list[Tie]:
    """Read which queries the rows of a run's folder answer, in the order they were written.

    Raises
    ------
    StoreError
        If a part cannot be read, or is none.
    """
    found: list[Tie] = []
    for part in parts_of(folder):
        table = read_part(part)
        if differing_columns(table):
            message = f"{part} holds no predictions: move it out of the run's folder"
            raise StoreError(message)
        found += _ties_of(table)
    return found


def _ties_of(table: pa.Table) -> list[Tie]:
    columns = [name for name in ("query_id", "status", ASKED) if name in table.column_names]
    return [tie_of(row) for row in table.select(columns).to_pylist()]


def tie_of(row: Mapping[str, Any]) -> Tie:
    """Return the link of one row to its query."""
    return Tie(str(row["query_id"]), str(row["status"]), str(row.get(ASKED) or ""))


def ids_done(folder: Path, asked: Mapping[str, str], *, again: Iterable[str] = ()) -> set[str]:
    """Ids of those queries that a run has answered as they are now; rows with a status in `again` do not count.

    What is asked is taken as it is given: whoever runs a matcher knows what it has learnt.

    Raises
    ------
    StoreError
        If a part cannot be read, or is none.
    """
    left_out = set(again)
    ties = read_ties(folder) if folder.is_dir() else []
    return {tie.query_id for tie in ties if tie.status not in left_out and tie.answers(asked)}


def write_run(folder: Path, about: Mapping[str, Any]) -> None:
    """Write `run.json`, in place of an older one.

    Raises
    ------
    StoreError
        If the folder cannot be written.
    """
    scratch = folder / f".{RUN}.{os.getpid()}"
    try:
        folder.mkdir(parents=True, exist_ok=True)
        scratch.write_text(json_text(dict(about)), encoding="utf-8")
        scratch.rename(folder / RUN)
    except OSError as error:
        _remove(scratch)
        message = f"{folder} cannot be written ({error.strerror or error}): check your rights and the free space"
        raise StoreError(message) from error


def read_run(folder: Path) -> dict[str, Any] | None:
    """Read `run.json`; None where there is none.

    Raises
    ------
    StoreError
        If it is damaged.
    """
    path = folder / RUN
    if not path.is_file():
        return None
    mend = "remove it and run again, the parts beside it are kept"
    content = read_json(path, mend=mend)
    if not isinstance(content, dict):
        message = f"{path} is damaged (it says {str(content)[:40]!r}): {mend}"
        raise StoreError(message)
    return content
