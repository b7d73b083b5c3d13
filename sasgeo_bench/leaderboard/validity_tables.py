# SPDX-License-Identifier: Apache-2.0
"""Tables of what a board can be trusted for: contrasts, falsifiers, controls, public and private seed."""

import math
from collections.abc import Sequence
from typing import Final

from sasgeo_bench.errors import counted
from sasgeo_bench.leaderboard.columns import column, words
from sasgeo_bench.leaderboard.manifests import BoardEntry
from sasgeo_bench.leaderboard.private_board import SEEDS_NOTE
from sasgeo_bench.leaderboard.tables import (
    Cell,
    Row,
    Table,
    interval_text,
    number_cell,
    number_text,
    p_cell,
    plain_cell,
    sort_key,
    tally_text,
    text_cells,
)
from sasgeo_bench.scoring.contrasts import AREAS
from sasgeo_bench.scoring.controls import Falsifier, Verdict
from sasgeo_bench.scoring.rows import ALL_SUITES
from sasgeo_bench.scoring.verdicts import Finding

_CONTROLS_NOTE: Final = (
    "The right score of these queries is known beforehand. At chance: views of a shuffled map, of a map turned by "
    "half, and of one of two places that are the same."
)
_FALSIFIERS_NOTE: Final = (
    "The entries of each contrast where the difference between them is taken away: at the same places without the "
    "stress (`control`), and on the falsifiers of each suite. A gain here as well is not caused by what the contrast "
    "is named for."
)


def seed_table(entries: Sequence[BoardEntry]) -> Table | None:
    """Return figures on the public and on a private seed: of all suites, and whatever is shown to be worse.

    None where no row was compared with a private seed.
    """
    rows = [
        Row(
            cells=text_cells(
                entry.name,
                item.suite,
                item.track,
                item.metric,
                number_text(item.public),
                number_text(item.private),
                interval_text(item.difference, item.lo, item.hi),
                f"{item.n_public} and {item.n_private}",
                f"{item.blocks_public} and {item.blocks_private}, {item.blocks_shared} in both",
                "worse" if item.is_worse else "not shown to be worse",
            )
        )
        for entry in entries
        for item in (() if entry.private is None else entry.private.figures)
        if item.suite == ALL_SUITES or item.is_worse
    ]
    if not rows:
        return None
    numbers = tuple(map(column, ("public", "private", "private less public", "n", "blocks")))
    columns = (*words("matcher", "suite", "track", "figure"), *numbers, *words("shown"))
    title = "Public and private seed"
    return Table(name="seeds", title=title, columns=columns, rows=tuple(rows), notes=(SEEDS_NOTE,))


def control_table(verdicts: Sequence[Verdict]) -> Table | None:
    """Return every control of every matcher; None where none was drawn."""
    if not verdicts:
        return None
    rows = tuple(
        Row(
            cells=(
                *text_cells(item.control, item.matcher),
                plain_cell(item.n),
                Cell(text=tally_text(item.found), key=item.found),
                Cell(text=tally_text(item.expected), key=item.expected),
                p_cell(item.p),
                _limit_cell(item),
                Cell(text="held" if item.holds else "FAILED"),
            )
        )
        for item in verdicts
    )
    first = column("control query", is_number=False, title="control")
    columns = (first, *words("matcher"), *map(column, ("n", "found", "expected", "p", "fails at")), *words("outcome"))
    return Table(name="controls", title="Controls, one by one", columns=columns, rows=rows, notes=(_CONTROLS_NOTE,))


def _limit_cell(verdict: Verdict) -> Cell:
    """Return how many right answers fail a control against chance."""
    if math.isnan(verdict.p):
        return Cell(text="-")
    limit = verdict.fails_at
    return Cell(text="never") if limit is None else plain_cell(limit)


def contrast_table(findings: Sequence[Finding]) -> Table:
    """Return the registered contrasts; intervals by countries where places share some."""
    has_countries = any(not math.isnan(item.lo_countries) for item in findings)
    rows = tuple(
        Row(
            cells=(
                Cell(text=item.name),
                *_sides(item),
                Cell(text=_ends_text(item.lo_blocks, item.hi_blocks)),
                *((Cell(text=_ends_text(item.lo_countries, item.hi_countries)),) if has_countries else ()),
                number_cell(item.attainable),
                number_cell(item.least),
                p_cell(item.p_holm),
                Cell(text="-" if item.metric in AREAS else f"{item.first_only} and {item.second_only}"),
                number_cell(item.detectable),
                Cell(text=_counts_text(item), key=float(item.n)),
                Cell(text=item.verdict),
            )
        )
        for item in findings
    )
    names = (
        *("first", "second", "difference", "by blocks", *(("by countries",) if has_countries else ())),
        *("attainable", "matters", "p (Holm)", "discordant", "detectable", "n"),
    )
    columns = (*words("contrast"), *map(column, names), *words("verdict"))
    return Table(name="contrasts", title="Registered contrasts", columns=columns, rows=rows)


def falsifier_table(found: Sequence[Falsifier]) -> Table:
    """Return the entries of each contrast where they should not differ."""
    rows = tuple(
        Row(
            cells=(
                *text_cells(item.contrast, item.suite, item.kind),
                *_sides(item.finding),
                Cell(text=f"{item.finding.first_only} and {item.finding.second_only}"),
                Cell(text=_counts_text(item.finding), key=float(item.finding.n)),
                Cell(text=item.verdict),
            )
        )
        for item in found
    )
    numbers = tuple(map(column, ("first", "second", "difference", "discordant", "n")))
    columns = (*words("contrast", "suite", "kind"), *numbers, *words("verdict"))
    return Table(name="falsifiers", title="Falsifiers", columns=columns, rows=rows, notes=(_FALSIFIERS_NOTE,))


def _sides(item: Finding) -> tuple[Cell, ...]:
    """Return what both entries of a contrast reach, and their difference."""
    return (
        Cell(text=f"{item.first}: {number_text(item.first_value)}", key=sort_key(item.first_value)),
        Cell(text=f"{item.second}: {number_text(item.second_value)}", key=sort_key(item.second_value)),
        Cell(text=interval_text(item.difference, item.lo, item.hi), key=sort_key(item.difference)),
    )


def _ends_text(lo: float, hi: float) -> str:
    """Return an interval by other clusters than places; "-" for none."""
    return "-" if math.isnan(lo) else f"[{number_text(lo)}, {number_text(hi)}]"


def _counts_text(item: Finding) -> str:
    where = f"{item.n} in {counted(item.blocks, 'block')}, {counted(item.places, 'place')}"
    return f"{where}, {counted(item.countries, 'country', 'countries')}" if 0 < item.countries < item.places else where
