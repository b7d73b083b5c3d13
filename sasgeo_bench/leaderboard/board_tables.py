# SPDX-License-Identifier: Apache-2.0
"""Every table of a board as a value: Markdown, LaTeX, a terminal and the site show the same ones."""

import math
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Final, Self

import pandas as pd

from sasgeo_bench.errors import counted
from sasgeo_bench.leaderboard.columns import column, marks_of, prior_words, words
from sasgeo_bench.leaderboard.manifests import BoardEntry
from sasgeo_bench.leaderboard.tables import (
    Cell,
    Key,
    Mark,
    Record,
    Row,
    Table,
    Tie,
    figure_cell,
    file_stem,
    number_cell,
    number_text,
    page_names,
    plain_cell,
    rank_cell,
    records_of,
    ties_of,
)
from sasgeo_bench.scoring.metrics import CEILING, CHANCE, FALSE_ABSENT, WITHIN, primary_of
from sasgeo_bench.scoring.rows import ALL_SUITES, is_unranked, name_alone
from sasgeo_bench.scoring.strata import ALL, CONTROL, GROUP, MOST_STEPS, STRESS, is_bin, is_step
from sasgeo_bench.tasks.query import SEQUENCE

SHOWN_COSTS: Final = (  # and of the table of costs
    *("latency_p50", "latency_p95", "prepare", "peak_memory"),
    *("map", "index", "map_per_km2", "cpu_per_fix", "observation_per_fix"),
)
_SOUND: Final = ("ok", "not applicable")  # all else is a miss
_PRIOR_ALONE: Final = "prior_centre"
_ODOMETER_ALONE: Final = "dead_reckoning"
_OF_FLIGHTS: Final = (
    "right_accepted",
    "false_accepted",
    "error_p95",
    "first_fix",
    "longest_without_fix_m",
)  # beside the first
_WHOLE: Final = frozenset({ALL, STRESS})  # no kinds
MOST_COLUMNS: Final = 8  # matchers next to each other: as many as a screen of 1280 px holds


@dataclass(frozen=True, kw_only=True)
class Book:
    """Figures of a board that take every answer, by entry and queries; and the names of the pages that show them.

    `controls` are the entries that are never ranked. `counted` names the kinds and steps of stress that the
    first figure of a table counts, `lost` the entries without a sound answer, and how often; both are empty without
    scored queries.
    """

    figures: Mapping[tuple[str, ...], Record]
    matchers: Mapping[Key, tuple[str, ...]]
    strata: Mapping[Key, tuple[str, ...]]
    entries: Mapping[str, BoardEntry]
    controls: frozenset[str]
    matcher_pages: Mapping[str, str]
    suite_pages: Mapping[str, str]
    counted: Mapping[Key, str]
    lost: Mapping[Key, str]

    @classmethod
    def of(cls, board: pd.DataFrame, listed: Sequence[BoardEntry] = (), scores: pd.DataFrame | None = None) -> Self:
        """Index a leaderboard with its entries, which may be listed, and its scored queries."""
        entries = {entry.name: entry for entry in listed}
        for row in records_of(board.drop_duplicates("matcher")) if "set_apart" in board else ():
            reason: str | None = None if pd.isna(row["set_apart"]) else row["set_apart"]
            entries.setdefault(row["matcher"], BoardEntry(name=row["matcher"], how=row["how"], set_apart=reason))
        scored = pd.DataFrame() if scores is None else scores
        plain = board[board["rejector"] == ""] if len(board) else board
        figures: dict[tuple[str, ...], Record] = {}
        matchers: dict[Key, dict[str, None]] = {}
        strata: dict[Key, dict[str, None]] = {}
        for row in records_of(plain):
            suite, track, prior = (str(row[name]) for name in GROUP)
            name, stratum = str(row["matcher"]), str(row["stratum"])
            figures[suite, track, prior, name, stratum, str(row["metric"])] = row
            if suite != ALL_SUITES:
                matchers.setdefault((suite, track, prior), {})[name] = None
                strata.setdefault((suite, track, prior), {})[stratum] = None
        names = [*entries, *(name for found in matchers.values() for name in found)]
        return cls(
            figures=figures,
            matchers={key: tuple(matchers[key]) for key in sorted(matchers)},
            strata={key: tuple(found) for key, found in strata.items()},
            entries=entries,
            controls=frozenset(filter(is_unranked, {*entries, *(key[3] for key in figures)})),
            matcher_pages=page_names("matcher", names),
            suite_pages=page_names("suite", [suite for suite, _, _ in sorted(matchers)]),
            counted={key: _counted(rows) for key, rows in _by_group(scored)},
            lost={key: _lost(rows) for key, rows in _by_group(scored)},
        )

    def pick(self, key: Key, matcher: str, metric: str, stratum: str = ALL) -> Record | None:
        """Return one figure; None where the board does not have it."""
        return self.figures.get((*key, matcher, stratum, metric))

    def main(self, key: Key, matcher: str, metric: str) -> Record | None:
        """Return the figure under stress, or of all queries where nothing is stressed."""
        return self.pick(key, matcher, metric, STRESS) or self.pick(key, matcher, metric)

    def name_cell(self, matcher: str) -> Cell:
        """Return the name of a matcher with its marks and a link to its page."""
        entry = self.entries.get(matcher)
        marks = marks_of(entry or BoardEntry(name=matcher), is_control=matcher in self.controls)
        return Cell(text=matcher, href=self.matcher_pages.get(matcher, ""), marks=marks)

    def short_name(self, matcher: str) -> Cell:
        """Return the name of a matcher with its link, and of its marks those that praise or warn, or name a control."""
        cell = self.name_cell(matcher)
        return replace(cell, marks=tuple(one for one in cell.marks if one.tone != "plain" or matcher in self.controls))

    def suite_cell(self, suite: str) -> Cell:
        """Return the name of a suite with a link to its page."""
        return Cell(text=suite, href=self.suite_pages.get(suite, ""))

    def is_set_apart(self, matcher: str) -> bool:
        """Return whether the board sets an entry apart."""
        return matcher in self.entries and bool(self.entries[matcher].set_apart)


def _by_group(scores: pd.DataFrame) -> Iterator[tuple[Key, pd.DataFrame]]:
    if len(scores):
        for (suite, track, prior), rows in scores.groupby(list(GROUP), sort=True):
            yield (str(suite), str(track), str(prior)), rows


def _counted(rows: pd.DataFrame) -> str:
    """Return the kinds of stress that the first figure counts, if there are any, with the steps that it pools.

    As in "S1 at 2, 5, 10 (years between map and world)".
    """
    some = rows[(rows["role"] == STRESS) & rows["is_present"].astype(bool)]
    kinds = {str(kind): sorted(set(mine.get("strength", ()))) for kind, mine in some.groupby("kind", sort=True)}
    ladders = {kind: steps for kind, steps in kinds.items() if 1 < len(steps) <= MOST_STEPS}
    texts = (
        f"{kind} at {', '.join(f'{step:g}' for step in ladders[kind])}" if kind in ladders else kind for kind in kinds
    )
    units = sorted({re.split("[:;]", str(unit))[0] for unit in some["strength_unit"]}) if ladders else []
    return "; ".join(texts) + (f" ({', '.join(units)})" if units else "")


def _lost(rows: pd.DataFrame) -> str:
    counts = rows.loc[~rows["status"].isin(_SOUND), ["matcher", "status"]].value_counts(sort=False).sort_index()
    named = (f"{key[0]} {count} ({key[1]})" for key, count in counts.items() if isinstance(key, tuple))
    return ", ".join(named)


@dataclass(frozen=True, slots=True, kw_only=True)
class Section:
    """One suite, track and prior group: its table, and that of contestants that are set apart, if any."""

    suite: str
    track: str
    prior_group: str
    prior: str
    suite_page: str
    counted: str
    for_nothing: str
    attainable: str
    table: Table
    apart: Table | None = None

    @property
    def context(self) -> str:
        """Return which queries the table counts, and the success on them without a method."""
        texts = [f"Stress that is counted: {self.counted}."] if self.counted else []
        texts += [f"Without looking at the view: {self.for_nothing}."] if self.for_nothing else []
        texts += [f"Attainable: {self.attainable}."] if self.attainable else []
        return " ".join(texts)


def sections_of(book: Book) -> tuple[Section, ...]:
    """Return the tables of a board's suites, those of one contestant last; prior groups are never mixed in one."""
    alone = {key: len(set(names) - book.controls) < 2 for key, names in book.matchers.items()}
    return tuple(_section(book, key) for key in sorted(book.matchers, key=lambda key: (alone[key], key)))


def _section(book: Book, key: Key) -> Section:
    suite, track, prior_group = key
    names = book.matchers[key]
    apart = [name for name in names if book.is_set_apart(name)]
    table = suite_table(book, key, [name for name in names if name not in apart])
    unasked = [name for name in book.entries if name not in names]
    lost = book.lost.get(key, "")
    lines = [*table.notes, *([f"Without a sound answer, which is a miss: {lost}."] if lost else [])]
    lines += [f"Not asked here: {', '.join(unasked)}."] if unasked else []
    return Section(
        suite=suite,
        track=track,
        prior_group=prior_group,
        prior=prior_words(prior_group),
        suite_page=book.suite_pages[suite],
        counted=book.counted.get(key, ""),
        for_nothing=_for_nothing(book, key),
        attainable=_attainable(book, key),
        table=replace(table, notes=tuple(lines)),
        apart=_apart(book, key, apart) if apart else None,
    )


def _apart(book: Book, key: Key, names: Sequence[str]) -> Table:
    table = suite_table(book, key, names)
    reasons = tuple(f"{name}: {book.entries[name].set_apart}." for name in names)
    title = f"Set apart, not to be compared with those above: {key[0]}, {key[1]}"
    return replace(table, name=f"{table.name}-apart", title=title, notes=reasons)


def suite_table(book: Book, key: Key, names: Sequence[str]) -> Table:
    """Return the table of one suite, track and prior group: a matcher a line, the best first, ties marked.

    Matchers in `names` without a figure are left out.
    """
    suite, track, prior_group = key
    primary = primary_of(track).name
    found = {name: row for name in names if (row := book.main(key, name, primary)) is not None}
    order = sorted(found, key=lambda name: (-_value(found[name]), name))
    ties = ties_of(list(found.values()))
    tie_of = {name: number for number, tie in enumerate(ties) for name in tie.names}
    ranked = sum(not pd.isna(row["rank_best"]) for row in found.values())
    rows = tuple(_row(book, key, found[name], tie_of.get(name), ranked) for name in order)
    titles = (primary, "rank", *_besides(track), "control", "false fixes", "detectable", "n", "missing", "blocks")
    table = Table(
        name=file_stem("board", suite, track, prior_group),
        title=f"{suite}: {track}, {prior_words(prior_group)}",
        columns=(
            column("matcher", is_number=False),
            *(column(name, order="descending" if name == primary else "none") for name in titles),
        ),
        rows=rows,
        notes=_notes(book, ties, found, ranked),
    )
    return table.without_empty(*_besides(track), "false fixes", "control", "detectable", "missing")


def _besides(track: str) -> tuple[str, ...]:
    """Return the figures that a table shows beside the primary one, of the same queries."""
    return _OF_FLIGHTS if track == SEQUENCE else (WITHIN.name,)


def _value(row: Record) -> float:
    value = float(row["value"])
    return -math.inf if math.isnan(value) else value


def _row(book: Book, key: Key, main: Record, tie: int | None, ranked: int) -> Row:
    name, stratum = str(main["matcher"]), str(main["stratum"])
    primary = str(main["metric"])
    mark = None if tie is None else Mark(text="tie", meaning="shares ranks with others, named below the table")
    tone = "control" if name in book.controls else "plain" if tie is None else ("tied" if tie % 2 == 0 else "other-tie")
    places = counted(int(main["places"]), "place")
    return Row(
        cells=(
            book.name_cell(name),
            figure_cell(main, has_bar=True),
            rank_cell(main, ranked=ranked, mark=mark),
            *(figure_cell(book.pick(key, name, metric, stratum)) for metric in _besides(key[1])),
            figure_cell(book.pick(key, name, primary, CONTROL)),
            figure_cell(book.pick(key, name, FALSE_ABSENT.name)),
            number_cell(float(main["detectable"])),
            plain_cell(int(main["n"])),
            plain_cell(int(main["missing"])) if main["missing"] else Cell(text="-", key=0.0),
            Cell(text=f"{main['blocks']} in {places}", key=float(main["blocks"])),
        ),
        tone=tone,
    )


def _notes(book: Book, ties: Sequence[Tie], found: Mapping[str, Record], ranked: int) -> tuple[str, ...]:
    if not found:
        return ("Nobody has a figure here.",)
    if ranked:
        lines = [f"Tied: {tie.to_text()}." for tie in ties]
        return tuple(lines or (["No two share a rank."] if ranked > 1 else ["One alone is ranked."]))
    if book.controls.issuperset(found):
        return ("Only controls answered.",)
    return ("Nobody is ranked here: the order is that of the figure, and decides nothing.",)


def _for_nothing(book: Book, key: Key) -> str:
    """Return what the prior alone and guessing reach; of flights the odometer alone."""
    _, track, _ = key
    primary = primary_of(track).name
    what, control = ("the odometer alone", _ODOMETER_ALONE) if track == SEQUENCE else ("the prior alone", _PRIOR_ALONE)
    alone = next((name for name in book.matchers[key] if name_alone(name) == control), None)
    found = {
        what: None if alone is None else book.main(key, alone, primary),
        "chance": book.main(key, book.matchers[key][0], CHANCE.name),
    }
    texts = [f"{name} {number_text(row['value'])} (n = {row['n']})" for name, row in found.items() if row is not None]
    return ", ".join(texts)


def _attainable(book: Book, key: Key) -> str:
    """Return the ceiling of the first figure, and that of each part with another one; "" if all is attainable.

    It is that of any matcher: it depends on the queries alone.
    """
    name = book.matchers[key][0]
    whole = book.main(key, name, CEILING.name)
    if whole is None:
        return ""
    kinds = [part for part in book.strata[key] if not (part in _WHOLE or is_bin(part) or is_step(part))]
    found = {part: book.pick(key, name, CEILING.name, part) for part in kinds}
    lower = {part: row for part, row in found.items() if row is not None and float(row["value"]) < 1}
    if not lower and float(whole["value"]) == 1:
        return ""
    parts = "; ".join(f"{part} {number_text(float(row['value']))}" for part, row in lower.items())
    return f"{number_text(float(whole['value']))} of the first figure" + (f" ({parts})" if parts else "")


def strata_tables(book: Book, key: Key) -> Iterator[Table]:
    """Yield the primary figure of each part of a suite, a matcher a column, in tables that a screen holds."""
    names = book.matchers[key]
    for first in range(0, len(names), MOST_COLUMNS):
        yield _strata_table(book, key, names[first : first + MOST_COLUMNS], number=first // MOST_COLUMNS + 1)


def _strata_table(book: Book, key: Key, names: Sequence[str], *, number: int) -> Table:
    suite, track, prior_group = key
    primary = primary_of(track).name
    more = "" if number == 1 else f", table {number}"
    rows = []
    for stratum in book.strata[key]:
        found = {name: book.pick(key, name, primary, stratum) for name in names}
        counts = sorted({int(row["n"]) for row in found.values() if row is not None})
        if counts:
            first = Cell(text=stratum)
            n = Cell(text="-".join(map(str, counts)), key=float(counts[0]))
            most = book.pick(key, names[0], CEILING.name, stratum)
            ceiling = number_cell(math.nan if most is None else float(most["value"]))
            rows.append(Row(cells=(first, n, ceiling, *(figure_cell(row) for row in found.values()))))
    meaning = column(primary).meaning
    columns = [column(primary, title=name) for name in names]
    return Table(
        name=file_stem("strata", suite, track, prior_group, "" if number == 1 else str(number)),
        title=f"{primary} by stratum: {track}, {prior_words(prior_group)}{more}",
        columns=(column("part", is_number=False), column("n"), column(CEILING.name), *columns),
        rows=tuple(rows),
        notes=(f"Cells: {primary} with its 95 % interval. {meaning}.",),
    )


def cost_table(book: Book) -> Table:
    """Return the costs of all entries, a metric a column; no rows where the board has none."""
    found = {key: row for key, row in book.figures.items() if key[0] == ALL_SUITES and key[-1] in SHOWN_COSTS}
    kinds = sorted({(SHOWN_COSTS.index(key[-1]), key[-1], key[1]) for key in found})
    by_kind = {(key[3], key[-1], key[1]): row for key, row in found.items()}
    units = {key[-1]: str(row["unit"]) for key, row in found.items()}
    values = {
        name: [_cost(by_kind.get((name, metric, track))) for _, metric, track in kinds]
        for name in sorted({key[3] for key in found})
    }
    order = sorted(values, key=lambda name: [(math.isnan(value), value) for value in values[name][:1]])
    rows = [Row(cells=(book.name_cell(name), *map(number_cell, values[name]))) for name in order]
    columns = [
        column(
            metric,
            title=f"{metric}{'' if track == 'all' else f', {track}'} ({units[metric]})",
            order="ascending" if at == 0 else "none",
        )
        for at, (_, metric, track) in enumerate(kinds)
    ]
    notes = (
        "Measured once, on the machine that made the board; 1 kB is 1000 bytes, 1 MB a million.",
        "Each was measured on the queries that it was asked: those of other suites do not compare.",
    )
    first = column("matcher", is_number=False)
    return Table(name="costs", title="What answers cost", columns=(first, *columns), rows=tuple(rows), notes=notes)


def _cost(row: Record | None) -> float:
    return math.nan if row is None else float(row["value"])


def step_tables(steps: pd.DataFrame, ages: Mapping[tuple[Any, ...], str] | None = None) -> Iterator[Table]:
    """Yield success along each ladder of strengths: a matcher a line, a step a column; strength 0 is the control.

    `steps` is from `strata.steps_frame`; `ages`, from `plot_tables.age_names`, names steps that are ages of a map.
    """
    named = ages or {}
    for key, part in steps.groupby([*GROUP, "kind", "strength_unit"], sort=True):
        suite, track, prior_group, kind, unit = map(str, key)
        records = records_of(part)
        counts: dict[tuple[int, float], int] = {}
        for row in sorted(records, key=lambda row: (row["view_cells"], row["strength"])):
            step = (row["view_cells"], row["strength"])
            counts[step] = max(counts.get(step, 0), int(row["n"]))
        order = part.groupby("matcher")["value"].mean().sort_index().sort_values(ascending=False, kind="stable")
        by_step = {(row["matcher"], row["view_cells"], row["strength"]): row for row in records}
        rows = tuple(
            Row(cells=(Cell(text=str(name)), *(figure_cell(by_step.get((name, *step))) for step in counts)))
            for name in order.index
        )
        titles = [
            f"{named.get((suite, track, prior_group, strength, size), f'{strength:g}')}, {size} cells, n = {n}"
            for (size, strength), n in counts.items()
        ]
        primary = primary_of(track).name
        yield Table(
            name=file_stem("steps", suite, track, prior_group, kind),
            title=f"{suite}: {track}, {prior_words(prior_group)}, step by step: {kind} ({unit})",
            columns=(*words("matcher"), *(column(primary, title=title) for title in titles)),
            rows=rows,
        )
