# SPDX-License-Identifier: Apache-2.0
"""Who answered the very same queries on another stored board: a good row here may be a poor one there."""

from collections.abc import Iterator, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Final

from sasgeo_bench.boards.archive_file import is_pack
from sasgeo_bench.boards.board_files import MEND, read_board_manifest, read_leaderboard
from sasgeo_bench.boards.board_tables import Book
from sasgeo_bench.boards.manifests import Elsewhere, ElsewhereRow
from sasgeo_bench.boards.tables import (
    Field,
    Key,
    Table,
    column,
    figure_cell,
    file_stem,
    interval_text,
    table_of,
    word,
)
from sasgeo_bench.core.errors import SasgeoError
from sasgeo_bench.core.parquet import read_table
from sasgeo_bench.scoring.metrics import primary_of

_MOST: Final = 7  # rows of one board
_ASKED: Final = ("suite", "track", "prior_group", "asked_sha256")
_QUERIES: Final = "queries.parquet"
_OF_A_SHARE: Final = {"unit": "1", "interval": "", "is_applicable": True}


def asked_elsewhere(stored: Path) -> tuple[Elsewhere, ...]:
    """Return the best rows of the stored boards beside one that asked the same queries, for its `board.json`.

    The hashes of all queries of a suite, track and prior group must be equal. Controls, entries that are set apart and
    those that the board itself has are left out, and so is a board that cannot be read.
    """
    mine, own = _asked(stored), _book(stored)
    found: list[Elsewhere] = []
    for other in sorted(stored.resolve().parent.glob("*")):
        if is_pack(other) and other != stored.resolve():
            with suppress(SasgeoError, KeyError, TypeError, ValueError):
                theirs = _asked(other)
                same = [key for key, asked in mine.items() if theirs.get(key) == asked]
                found += _best(other.name, _book(other), same, own) if same else []
    return tuple(found)


def _asked(stored: Path) -> dict[Key, frozenset[str]]:
    """Return the hashes of the queries of a stored board, by suite, track and prior group."""
    columns = read_table(stored / _QUERIES, mend=MEND, columns=list(_ASKED)).to_pydict()
    found: dict[Key, set[str]] = {}
    for suite, track, prior_group, asked in zip(*(columns[name] for name in _ASKED), strict=True):
        found.setdefault((suite, track, prior_group), set()).add(asked or "")
    return {key: frozenset(asked) for key, asked in found.items() if "" not in asked}


def _book(stored: Path) -> Book:
    return Book.of(read_leaderboard(stored), read_board_manifest(stored).entries)


def _best(board: str, book: Book, keys: Sequence[Key], own: Book) -> Iterator[Elsewhere]:
    for key in keys:
        suite, track, prior_group = key
        metric = primary_of(track).name
        names = {*book.matchers.get(key, ())} - {*own.matchers.get(key, ())} - book.controls
        rows = [(name, book.main(key, name, metric)) for name in sorted(names) if not book.is_set_apart(name)]
        known = [(name, row) for name, row in rows if row is not None and row["is_applicable"]]
        known.sort(key=lambda item: (-float(item[1]["value"]), item[0]))
        best = [
            ElsewhereRow(
                matcher=name, n=int(row["n"]), value=float(row["value"]), lo=float(row["lo"]), hi=float(row["hi"])
            )
            for name, row in known[:_MOST]
        ]
        if best:
            yield Elsewhere(board=board, suite=suite, track=track, prior_group=prior_group, metric=metric, rows=best)


def elsewhere_lines(found: Sequence[Elsewhere]) -> Iterator[str]:
    """Yield a line for each table of a board whose queries another board asked, too.

    >>> row = ElsewhereRow(matcher="graph", n=155, value=0.81, lo=0.7, hi=0.9)
    >>> key = {"suite": "clean", "track": "localization", "prior_group": "r500-weak-s3"}
    >>> print(*elsewhere_lines([Elsewhere(board="systems", **key, metric="success_25m", rows=[row])]))
    clean, localization: the same 155 queries on the board systems, success_25m: graph 0.810 [0.700, 0.900]
    """
    for item in found:
        rows = ", ".join(f"{row.matcher} {interval_text(row.value, row.lo, row.hi)}" for row in item.rows)
        where = f"the same {item.rows[0].n} queries on the board {item.board}, {item.metric}"
        yield f"{item.suite}, {item.track}: {where}: {rows}"


def elsewhere_tables(listed: Sequence[Elsewhere]) -> dict[Key, tuple[Table, ...]]:
    """Return the same as tables, by suite, track and prior group."""
    found: dict[Key, tuple[Table, ...]] = {}
    for item in listed:
        key = (item.suite, item.track, item.prior_group)
        fields: tuple[Field[ElsewhereRow], ...] = (
            (word("matcher"), lambda row: row.matcher),
            (column(item.metric, order="descending"), lambda row: figure_cell(row.model_dump() | _OF_A_SHARE)),
        )
        title = f"The same {item.rows[0].n} queries on the board {item.board}: its best rows, not ranked here"
        table = table_of(file_stem("elsewhere", *key, item.board), title, item.rows, fields)
        found[key] = (*found.get(key, ()), table)
    return found
