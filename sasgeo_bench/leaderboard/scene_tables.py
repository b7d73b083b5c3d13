# SPDX-License-Identifier: Apache-2.0
"""Tables of success by kind of place: a matcher a line, a kind a column."""

import math
from collections.abc import Iterator, Mapping
from dataclasses import replace

import pandas as pd

from sasgeo_bench.leaderboard.board_tables import Book
from sasgeo_bench.leaderboard.columns import FEW, column, prior_words, suite_card, suite_words, words
from sasgeo_bench.leaderboard.overview import short_cell
from sasgeo_bench.leaderboard.tables import (
    Cell,
    Column,
    Key,
    Record,
    Row,
    Table,
    file_stem,
    plain_cell,
    records_of,
)
from sasgeo_bench.scoring.scenes import AS_USED, SCENES
from sasgeo_bench.scoring.strata import ALL, GROUP
from sasgeo_bench.scoring.verdicts import LEAST_PLACES
from sasgeo_bench.tasks.query import BY

_Found = Mapping[str, Mapping[str, Record]]  # kind of place -> matcher -> row


def scene_tables(scenes: pd.DataFrame, book: Book) -> Iterator[Table]:
    """Yield success by kind of place, a table for each suite, track and prior group; `scenes` is of `scene_frame`.

    Those of most places come first. The first two lines count places and queries. Kinds with too few places to rank
    anybody are marked.
    """
    groups = sorted(scenes.groupby(list(GROUP)), key=lambda group: (-int(group[1]["places"].max()), group[0]))
    for key, part in groups:
        found: dict[str, dict[str, Record]] = {}
        for row in records_of(part):
            found.setdefault(str(row["stratum"]), {})[str(row["matcher"])] = row
        yield _table((str(key[0]), str(key[1]), str(key[2])), found, book)


def _table(key: Key, found: _Found, book: Book) -> Table:
    suite, track, prior_group = key
    use = AS_USED[suite.partition(BY)[0]]
    kinds = [kind for kind in (ALL, *SCENES) if kind in found]
    primary = str(next(iter(found[ALL].values()))["metric"])
    order = sorted(found[ALL], key=lambda name: (-_value(found[ALL][name]), name))
    rows = [
        Row(
            cells=(
                book.short_name(name),
                *(short_cell(found[kind].get(name), is_rivalled=len(order) > 1) for kind in kinds),
            )
        )
        for name in order
    ]
    return Table(
        name=file_stem("kinds", suite, track, prior_group),
        title=f"With {use.words} ({suite}): {primary} [95 %] (rank), {track}, {prior_words(prior_group)}",
        columns=(*words("matcher"), *(_column(kind, primary) for kind in kinds)),
        rows=(*_heads(found, kinds), *rows),
        notes=tuple(_notes(suite, use.strength)),
    )


def _value(row: Record) -> float:
    return -math.inf if math.isnan(row["value"]) else float(row["value"])


def _column(kind: str, primary: str) -> Column:
    """Return the column of a kind, which says what its figure is a share of."""
    what = column("kind of place")
    return replace(column(primary, title=kind), meaning=f"{what.meaning}. {primary}: {column(primary).meaning}")


def _heads(found: _Found, kinds: list[str]) -> Iterator[Row]:
    """Yield the lines that count places and queries, those with too few places marked."""
    first = [next(iter(found[kind].values())) for kind in kinds]
    places = [
        replace(plain_cell(int(row["places"])), marks=(FEW,) if row["places"] < LEAST_PLACES else ()) for row in first
    ]
    yield Row(cells=(Cell(text="places"), *places), tone="head")
    yield Row(cells=(Cell(text="queries"), *(plain_cell(int(row["n"])) for row in first)), tone="head")


def _notes(suite: str, strength: float | None) -> Iterator[str]:
    """Yield what is done in a suite, and which of its views are meant where these are not all."""
    yield suite_words(suite)
    card = suite_card(suite)
    if card is not None and strength is not None:
        yield f"Only views of strength {strength:g} ({card.strength_unit}), as they are expected in use."
