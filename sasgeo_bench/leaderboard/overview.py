# SPDX-License-Identifier: Apache-2.0
"""Who is good at what: all suites of a board in one table for each track and prior group."""

import math
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Final

import pandas as pd

from sasgeo_bench.leaderboard.board_tables import Book
from sasgeo_bench.leaderboard.columns import column, prior_words, suite_words, words
from sasgeo_bench.leaderboard.tables import (
    Cell,
    Column,
    Key,
    Record,
    Row,
    Table,
    file_stem,
    number_cell,
    number_text,
    plain_cell,
    rank_text,
    sort_key,
)
from sasgeo_bench.scoring.metrics import CEILING, CHANCE, FALSE_ABSENT, primary_of
from sasgeo_bench.scoring.rows import is_unranked

AT_MOST: Final = "at most"  # the line of the ceiling


def summary(book: Book, suites: Collection[str] = ()) -> Iterator[Table]:
    """Yield who is good at what, of some suites or of all: a matcher a line, a suite a column, figure and rank.

    Columns of false fixes at absent places follow those of the suites. The first lines say of each suite how many
    queries count, what can be reached and what guessing and the controls reach. Suites with more ranked matchers come
    first, so do matchers that were asked about more of them. A cell leads where its rank may be the first of several.
    """
    keys = [key for key in book.matchers if not suites or key[0] in suites]
    for group in sorted({key[1:] for key in keys}):
        yield _overview(book, [key for key in keys if key[1:] == group])


def _overview(book: Book, keys: Sequence[Key]) -> Table:
    """Return the table of the suites of one track and prior group."""
    track, prior_group = keys[0][1:]
    primary = primary_of(track).name
    names = sorted({name for key in keys for name in book.matchers[key]})
    by_suite = {key: {name: book.main(key, name, primary) for name in names} for key in keys}
    ranked = {key: sum(map(_is_ranked, rows.values())) for key, rows in by_suite.items()}
    shown = sorted((key for key in keys if any(by_suite[key].values())), key=lambda key: (-ranked[key], key))
    absent = [key for key in shown if any(book.pick(key, name, FALSE_ABSENT.name) for name in names)]
    found = {name: [by_suite[key][name] for key in shown] for name in names}
    order = _order(book, found)
    whole = {name for name in order if all(row is not None and row["is_applicable"] for row in found[name])}
    weighed = [at for at, key in enumerate(shown) if ranked[key]]  # the others have too few places
    has_mean = len(weighed) > 1 and len(whole - book.controls) > 1
    rows = _heads(book, shown, absent, primary, has_mean=has_mean)
    for name in order:
        cells = [short_cell(row, is_rivalled=ranked[key] > 1) for key, row in zip(shown, found[name], strict=True)]
        cells += [short_cell(book.pick(key, name, FALSE_ABSENT.name), has_rank=False) for key in absent]
        if has_mean:
            cells.append(number_cell(_mean_value([found[name][at] for at in weighed]) if name in whole else math.nan))
        tone = "head" if name in book.controls else "plain"
        rows.append(Row(cells=(book.short_name(name), *cells), tone=tone))
    columns = (
        *(_suite_column(book, key, primary, has_absent=key in absent) for key in shown),
        *(column("false fixes", title=f"{key[0]}: false fixes") for key in absent),
        *([column("mean")] if has_mean else []),
    )
    return Table(
        name=file_stem("summary", track, prior_group),
        title=f"{primary} [95 %] (rank), {track}, {prior_words(prior_group)}",
        columns=(*words("matcher"), *columns),
        rows=tuple(rows),
        notes=tuple(_notes(primary, rows, has_absent=bool(absent), has_several=len(shown) > 1)),
    )


def _order(book: Book, found: Mapping[str, Sequence[Record | None]]) -> list[str]:
    """Return controls, then matchers: who was asked about more suites first, then who is better on them."""
    means = {name: _mean_value(rows) for name, rows in found.items()}
    return sorted(
        (name for name, rows in found.items() if any(row is not None for row in rows)),
        key=lambda name: (name not in book.controls, -sum(map(bool, found[name])), -means[name], name),
    )


def _suite_column(book: Book, key: Key, primary: str, *, has_absent: bool) -> Column:
    """Return the column of a suite, which says what is done in it, and what its figure pools: places on the map."""
    counted = book.counted.get(key)
    texts = (suite_words(key[0]), f"Counted, each query alike: {counted}" if counted else "")
    meaning = " ".join(filter(None, texts)).removesuffix(".")
    plain = column(primary, title=f"{key[0]}: on the map" if has_absent else key[0])
    return replace(plain, meaning=meaning or plain.meaning)


def _notes(primary: str, rows: Sequence[Row], *, has_absent: bool, has_several: bool) -> Iterator[str]:
    """Yield what the figures and the lines above the matchers are."""
    yield f"{primary}: {column(primary).meaning}. Higher is better."
    if has_several:
        yield (
            "Columns do not compare with each other: each pools all stresses of its suite, weak and strong ones, of "
            "its own places."
        )
    if has_absent:
        yield (
            f"false fixes: {column('false fixes').meaning}. The figure of the suite itself is of its places that are "
            "on the map."
        )
    if any(row.cells[0].text == AT_MOST for row in rows):
        yield (
            f"{AT_MOST}: what can be expected of a matcher that sees the view alone, as 1 in k where k places are the "
            "same. An oracle is told the answer and passes it."
        )


def _is_ranked(row: Record | None) -> bool:
    return row is not None and not is_unranked(str(row["matcher"])) and not pd.isna(row["rank_best"])


def _mean_value(rows: Sequence[Record | None]) -> float:
    values = [float(row["value"]) for row in rows if row is not None and not math.isnan(row["value"])]
    return sum(values) / len(values) if values else -1.0


def _heads(book: Book, keys: Sequence[Key], absent: Sequence[Key], primary: str, *, has_mean: bool) -> list[Row]:
    """Return lines above the matchers: how many queries count, and a ceiling below 1 and chance where there is one."""
    lines = {"queries": [plain_cell(_count(book, key, primary)) for key in keys]}
    beside = {"queries": [plain_cell(_count(book, key, FALSE_ABSENT.name)) for key in absent]}
    for title, metric in ((AT_MOST, CEILING.name), ("chance", CHANCE.name)):
        rows = [next(filter(None, (book.main(key, name, metric) for name in book.matchers[key])), None) for key in keys]
        lines[title] = [number_cell(math.nan if row is None else float(row["value"])) for row in rows]
    nothing = [Cell(text="-")]
    return [
        Row(
            cells=(Cell(text=title), *cells, *beside.get(title, nothing * len(absent)), *nothing * has_mean),
            tone="head",
        )
        for title, cells in lines.items()
        if any(cell.text not in ("-", "1.000") for cell in cells)
    ]


def _figure(book: Book, key: Key, matcher: str, metric: str) -> Record | None:
    """Return a figure: false fixes are of all absent places, whichever stress made them so."""
    return book.pick(key, matcher, metric) if metric == FALSE_ABSENT.name else book.main(key, matcher, metric)


def _count(book: Book, key: Key, metric: str) -> int:
    """Return how many queries count: a matcher that does not answer the track has a row of all, stressed or not."""
    rows = [row for name in book.matchers[key] if (row := _figure(book, key, name, metric)) is not None]
    return max(int(row["n"]) for row in [row for row in rows if row["is_applicable"]] or rows)


def short_cell(row: Record | None, *, is_rivalled: bool = False, has_rank: bool = True) -> Cell:
    """Return a figure, its interval and its rank as in "0.750 [0.30, 0.95] (2-3)".

    It leads where it `is_rivalled` and may have the first rank.
    """
    if row is None:
        return Cell(text="-")
    if not row["is_applicable"]:
        return Cell(text="n/a")
    value, leads = float(row["value"]), is_rivalled and _is_ranked(row) and int(row["rank_best"]) == 1
    ends = [] if math.isnan(row["lo"]) else [f"[{row['lo']:.2f}, {row['hi']:.2f}]"]
    details = (*ends, *([f"({rank_text(row)})"] if has_rank else []))
    return Cell(text=number_text(value), key=sort_key(value), tone="leading" if leads else "plain", details=details)
