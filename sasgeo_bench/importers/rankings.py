# SPDX-License-Identifier: Apache-2.0
"""A ranking file: for each query the gallery items in the order of a method, by the ids of `items.parquet`."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from numpy.typing import NDArray

from sasgeo_bench.errors import DatasetError
from sasgeo_bench.files.parquet import open_table, read_schema
from sasgeo_bench.importers.items import Item

COLUMNS: Final = ("query_id", "gallery_id", "rank")
_MEND: Final = f"write a Parquet file with the columns {', '.join(COLUMNS)}, ranks from 1"

Ints = NDArray[np.int64]


@dataclass(frozen=True, slots=True, kw_only=True)
class Ranking:
    """Answers of a method; items are given by their position in the dataset.

    Parameters
    ----------
    queries : array of int, shape (Q,)
        Answered queries.
    starts : array of int, shape (Q + 1,)
        Where the answers to each query begin in `answers`, and where the last ones end.
    answers : array of int, shape (R,)
        Gallery items, best first.
    """

    queries: Ints
    starts: Ints
    answers: Ints

    @property
    def depth(self) -> int:
        """Return the length of the shortest list."""
        return int(np.diff(self.starts).min())

    @property
    def ranks(self) -> Ints:
        """Return the rank of each answer, from 0, shape (R,)."""
        return np.arange(len(self.answers)) - np.repeat(self.starts[:-1], np.diff(self.starts))

    def first(self, count: int) -> Ints:
        """Return the first answers to each query, shape (Q, count); `count` is at most the depth."""
        return np.asarray(self.answers[self.starts[:-1, None] + np.arange(count)])


def read_ranking(paths: Sequence[Path], items: Sequence[Item]) -> Ranking:
    """Read a ranking of the items of a dataset, from one file or several.

    Raise `StoreError` if a file cannot be read, `DatasetError` if it has other columns, an id that no item of that
    role has, two answers on one rank, one answer twice, or ranks that do not run from 1 without a gap.
    """
    columns = [_read_columns(path, items) for path in paths]
    queries, answers, ranks = (np.concatenate(parts) for parts in zip(*columns, strict=True))
    return _sorted(paths[0], items, (queries, answers, ranks))


def _read_columns(path: Path, items: Sequence[Item]) -> tuple[Ints, Ints, Ints]:
    _check_columns(path, read_schema(path, mend=_MEND))
    # At most 33 million rows of one file
    with open_table(path, mend=_MEND, most_rows=33_000_000, read_dictionary=list(COLUMNS[:2])) as source:
        table = source.read(columns=list(COLUMNS))
    if table.num_rows == 0:
        raise DatasetError(f"{path} has no row: {_MEND}")
    if table["rank"].null_count:
        raise DatasetError(f"{path}, rank: expected whole numbers, found a missing value: {_MEND}")
    queries, answers = (_positions(path, table, name, items) for name in COLUMNS[:2])
    return queries, answers, table["rank"].to_numpy().astype(np.int64)


def _check_columns(path: Path, schema: pa.Schema) -> None:
    """Refuse a table without the columns of a ranking, or with other types."""
    for name in COLUMNS:
        if schema.names.count(name) != 1:
            raise DatasetError(f"{path} has no column {name!r}, or more than one: {_MEND}")
        kind = schema.field(name).type
        kind = kind.value_type if pa.types.is_dictionary(kind) and name != "rank" else kind
        is_text = pa.types.is_string(kind) or pa.types.is_large_string(kind)
        if not (pa.types.is_integer(kind) if name == "rank" else is_text):
            expected = "whole numbers" if name == "rank" else "text"
            raise DatasetError(f"{path}, {name}: expected {expected}, got {kind}: {_MEND}")


def _positions(path: Path, table: pa.Table, column: str, items: Sequence[Item]) -> Ints:
    """Return the position of each id among the items that have its role."""
    role = column.removesuffix("_id")
    values = table[column].combine_chunks()
    values = values if pa.types.is_dictionary(values.type) else values.dictionary_encode()
    known = [at for at, item in enumerate(items) if item.role == role]
    names = pa.array([items[at].item_id for at in known], type=values.type.value_type)
    found = pc.index_in(values.dictionary, value_set=names).take(values.indices)
    if found.null_count:
        wrong = values.filter(pc.is_null(found))[:1].dictionary_decode().cast(pa.binary())[0].as_py()
        shown = "a missing value" if wrong is None else repr(wrong[:100].decode(errors="replace"))
        raise DatasetError(f"{path}, {column}: {shown} is no {role} of the dataset: ids are those of items.parquet")
    return np.asarray(np.array(known, dtype=np.int64)[found.to_numpy()])


def _sorted(path: Path, items: Sequence[Item], columns: tuple[Ints, Ints, Ints]) -> Ranking:
    """Bring rows into the order of queries and ranks; refuse ties, repeats and gaps."""
    queries, answers, ranks = columns
    if ranks.min() >= 1 and ranks.max() <= len(items):
        order = np.argsort(queries * (len(items) + 1) + ranks, kind="stable")  # linear where rows are in order already
        queries, answers, ranks = queries[order], answers[order], ranks[order]
    begins = np.flatnonzero(np.diff(queries, prepend=-1))
    ranking = Ranking(queries=queries[begins], starts=np.append(begins, len(answers)), answers=answers)
    wrong = np.flatnonzero(ranks != ranking.ranks + 1)
    if len(wrong):
        shown = items[queries[wrong[0]]].item_id
        raise DatasetError(f"{path}: the ranks of query {shown!r} do not run from 1 without a gap or a tie: {_MEND}")
    pairs = np.sort(queries * len(items) + answers)
    twice = pairs[1:][pairs[1:] == pairs[:-1]]
    if len(twice):
        query, answer = divmod(int(twice[0]), len(items))
        raise DatasetError(
            f"{path} ranks {items[answer].item_id!r} twice for query {items[query].item_id!r}: keep one of them"
        )
    return ranking
