# SPDX-License-Identifier: Apache-2.0
"""Every table of a board as a value: Markdown, LaTeX, a terminal and the site show the same ones."""

import math
import re
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Final, Self

import pandas as pd

from sasgeo_bench.boards.manifests import BoardEntry, MetricRecord, SeedFigure
from sasgeo_bench.boards.tables import (
    ADDED,
    FEW,
    UNSTRESSED,
    Cell,
    Column,
    Field,
    Key,
    Mark,
    Record,
    Shown,
    Table,
    Tie,
    column,
    figure_cell,
    file_stem,
    grid_of,
    interval_text,
    marks_of,
    number_text,
    p_cell,
    page_names,
    plain_cell,
    prior_words,
    rank_cell,
    rank_text,
    records_of,
    sort_key,
    suite_card,
    suite_words,
    table_of,
    tally_text,
    ties_of,
    word,
)
from sasgeo_bench.core.errors import counted
from sasgeo_bench.scoring.compare import LEAST_PLACES, Finding
from sasgeo_bench.scoring.contrasts import AREAS
from sasgeo_bench.scoring.controls import Falsifier, Verdict
from sasgeo_bench.scoring.decisions import PRESENT_SHARES
from sasgeo_bench.scoring.metric import MeanMetric
from sasgeo_bench.scoring.metrics import CEILING, CHANCE, FALSE_ABSENT, LOCALIZATION, RISKS, WITHIN, primary_of
from sasgeo_bench.scoring.rejection_rows import AS_DRAWN, mixture_name
from sasgeo_bench.scoring.requirements import FAILS, NOT_SHOWN, PASSES, is_latency, parse_requirements, stated_metrics
from sasgeo_bench.scoring.rows import ALL_SUITES, base_name, is_unranked
from sasgeo_bench.scoring.score import FIX_M
from sasgeo_bench.scoring.strata import ALL, CONTROL, GROUP, MOST_STEPS, STRESS, is_bin, is_step
from sasgeo_bench.scoring.tables import AS_USED, SCENES
from sasgeo_bench.tasks.query import BY, SEQUENCE

SHOWN_COSTS: Final = (  # and of the table of costs
    *("latency_p50", "latency_p95", "prepare", "peak_memory"),
    *("map", "index", "map_per_km2", "cpu_per_fix", "observation_per_fix"),
)
_SOUND: Final = ("ok", "not applicable")  # all else is a miss
_PRIOR_ALONE: Final = "prior_centre"
_ODOMETER_ALONE: Final = "dead_reckoning"
_OF_FLIGHTS: Final = {  # beside the first, with their titles
    "right_accepted": "right_accepted",
    "false_accepted": "false_accepted",
    "error_p95": "error_p95 (m)",
    "first_fix": "first_fix (m)",
    "longest_without_fix_m": "longest_without_fix_m",
}
_USES: Final[Mapping[str, Mapping[str, str]]] = {  # what an integrator asks, by track, under the names of the field
    LOCALIZATION: {
        "within_10m": "R@10 m",
        "within_5m": "R@5 m",
        "within_5deg": "R@5 deg",
        "success_5m": "R@5 m, 5 deg",
        "position_median": "median error (m)",
        "position_p95": "R95 (m)",
        "yaw_median": "median heading error (deg)",
        "log_scale_median": "median scale error (%)",
    },
    SEQUENCE: {
        "available_30s": "available (30 s)",
        "continuity_60s": "continuity (60 s)",
        "fix_age_p95_s": "age of fix, p95 (s)",
        "fix_age_longest_s": "longest (s)",
        "fix_age_p95_m": "flown since, p95 (m)",
        "right_confirmed": "right, confirmed",
        "false_of_confirmed": "false of confirmed",
        "first_confirmed": "first confirmed (m)",
        "nees": "NEES",
        "nees_in_band": "NEES in band",
        "inside_95": "in 95 % ellipse",
    },
}
_WHOLE: Final = frozenset({ALL, STRESS})  # no kinds
MOST_COLUMNS: Final = 8  # matchers next to each other: as many as a screen of 1280 px holds


@dataclass(frozen=True, kw_only=True)
class Book:
    """Figures of a board that take every answer, by entry and queries; and the names of the pages that show them.

    `controls` are the entries that are never ranked, `metrics` those of other packages by name, `own` those of limits
    that were stated. `counted` names the
    kinds and steps of stress that the first figure of a table counts, `lost` the entries without a sound answer, and
    how often; both are empty without scored queries. `added` are entries that the pipeline does not name.
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
    metrics: Mapping[str, MetricRecord] = field(default_factory=dict)
    own: Mapping[str, MeanMetric] = field(default_factory=dict)
    added: frozenset[str] = frozenset()

    @classmethod
    def of(
        cls,
        board: pd.DataFrame,
        listed: Sequence[BoardEntry] = (),
        scores: pd.DataFrame | None = None,
        *,
        metrics: Sequence[MetricRecord] = (),
        within: Sequence[str] = (),
        require: Sequence[str] = (),
        added: Sequence[str] = (),
    ) -> Self:
        """Index a leaderboard with its entries, which may be listed, scored queries, metrics of others and limits.

        `within` are limits and `require` requirements, as they were stated.
        """
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
            lost={key: ", ".join(_lost(rows)) for key, rows in _by_group(scored)},
            metrics={one.name: one for one in metrics},
            own=stated_metrics(within, parse_requirements(require)),
            added=frozenset(added),
        )

    def pick(self, key: Key, matcher: str, metric: str, stratum: str = ALL) -> Record | None:
        """Return one figure; None where the board does not have it."""
        return self.figures.get((*key, matcher, stratum, metric))

    def main(self, key: Key, matcher: str, metric: str) -> Record | None:
        """Return the figure under stress, or of all queries where nothing is stressed."""
        return self.pick(key, matcher, metric, STRESS) or self.pick(key, matcher, metric)

    def besides(self, track: str) -> tuple[str, ...]:
        """Return the figures that a table shows beside the primary one, of the same queries."""
        own = _OF_FLIGHTS if track == SEQUENCE else (WITHIN.name,)
        others = (name for name, one in self.metrics.items() if track in one.tracks)
        return tuple(dict.fromkeys((*own, *self.asked(track), *others)))

    def asked(self, track: str) -> tuple[str, ...]:
        """Return the shares that limits and requirements ask for, but for the primary one."""
        return tuple(name for name, one in self.own.items() if track in one.tracks and name != primary_of(track).name)

    def column(self, term: str, *, order: str = "none") -> Column:
        """Return the column of a term, which may be a metric of another package."""
        metric, plain = self.metrics.get(term), column(term, order=order)
        if metric is None:
            plain = replace(plain, name=_OF_FLIGHTS.get(term, plain.name))
            return replace(plain, meaning=self.own[term].meaning) if term in self.own else plain
        unit = "" if metric.unit == "1" else f" ({metric.unit})"
        return replace(plain, name=f"{term}{unit}", meaning=metric.to_text())

    def name_cell(self, matcher: str) -> Cell:
        """Return the name of a matcher with its marks and a link to its page."""
        entry = self.entries.get(matcher)
        marks = marks_of(entry or BoardEntry(name=matcher), is_control=matcher in self.controls)
        marks += (ADDED,) if matcher in self.added else ()
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


def _lost(rows: pd.DataFrame) -> list[str]:
    lost = rows[~rows["status"].isin(_SOUND)]
    counts = Counter(zip(lost["matcher"], lost["status"], strict=True))
    return [f"{matcher} {count} ({status})" for (matcher, status), count in sorted(counts.items())]


@dataclass(frozen=True, slots=True, kw_only=True)
class Section:
    """One suite, track and prior group: its table, and that of contestants that are set apart, if any.

    `context` says which queries the table counts, and the success on them without a method.
    """

    suite: str
    track: str
    prior_group: str
    prior: str
    suite_page: str
    context: str
    table: Table
    apart: Table | None = None


def sections_of(book: Book) -> tuple[Section, ...]:
    """Return the tables of a board's suites, those of one contestant last; prior groups are never mixed in one."""
    alone = {key: len(set(names) - book.controls) < 2 for key, names in book.matchers.items()}
    return tuple(_section(book, key) for key in sorted(book.matchers, key=lambda key: (alone[key], key)))


def _section(book: Book, key: Key) -> Section:
    suite, track, prior_group = key
    names = book.matchers[key]
    apart = [name for name in names if book.is_set_apart(name)]
    table = suite_table(book, key, [name for name in names if name not in apart])
    beside = {
        "Without a sound answer, which is a miss": book.lost.get(key, ""),
        "Not asked here": ", ".join(name for name in book.entries if name not in names),
    }
    context = {
        "Stress that is counted": book.counted.get(key, ""),
        "Without looking at the view": _for_nothing(book, key),
        "Attainable": _attainable(book, key),
    }
    set_apart = replace(
        suite_table(book, key, apart),
        name=f"{table.name}-apart",
        title=f"Set apart, not to be compared with those above: {suite}, {track}",
        notes=tuple(f"{name}: {book.entries[name].set_apart}." for name in apart),
    )
    return Section(
        suite=suite,
        track=track,
        prior_group=prior_group,
        prior=prior_words(prior_group),
        suite_page=book.suite_pages[suite],
        context=" ".join(f"{what}: {text}." for what, text in context.items() if text),
        table=replace(table, notes=(*table.notes, *(f"{what}: {text}." for what, text in beside.items() if text))),
        apart=set_apart if apart else None,
    )


def suite_tables(book: Book) -> Iterator[Table]:
    """Yield the tables of `sections_of` as they stand alone, each with what it counts, and those set apart."""
    for section in sections_of(book):
        yield replace(section.table, notes=(*filter(None, (section.context,)), *section.table.notes))
        yield from filter(None, (section.apart,))


def suite_table(book: Book, key: Key, names: Sequence[str]) -> Table:
    """Return the table of one suite, track and prior group: a matcher a line, the best first, ties marked.

    Matchers in `names` without a figure are left out.
    """
    suite, track, prior_group = key
    primary = primary_of(track).name
    found = {name: row for name in names if (row := book.main(key, name, primary)) is not None}
    ties = ties_of(list(found.values()))
    tie_of = {name: number for number, tie in enumerate(ties) for name in tie.names}
    ranked = sum(not pd.isna(row["rank_best"]) for row in found.values())
    tone = {name: "tied" if number % 2 == 0 else "other-tie" for name, number in tie_of.items()}
    tone |= dict.fromkeys(book.controls, "control")
    shares = Mark(text="tie", meaning="shares ranks with others, named below the table")
    beside = book.besides(track)

    def _figure(metric: str, stratum: str = "") -> Callable[[Record], Cell]:
        return lambda row: figure_cell(book.pick(key, row["matcher"], metric, stratum or row["stratum"]))

    def _control(row: Record) -> Cell:
        found = book.pick(key, row["matcher"], primary, CONTROL)
        is_same = found is not None and row["stratum"] == ALL and found["n"] == row["n"]  # nothing is stressed
        return figure_cell(None if is_same else found)

    fields: tuple[Field[Record], ...] = (
        (word("matcher"), lambda row: book.name_cell(row["matcher"])),
        (column(primary, order="descending"), lambda row: figure_cell(row, has_bar=True)),
        (column("rank"), lambda row: rank_cell(row, ranked=ranked, mark=shares if row["matcher"] in tie_of else None)),
        *((book.column(metric), _figure(metric)) for metric in beside),
        (column("control", title=UNSTRESSED), _control),
        (column("false fixes"), _figure(FALSE_ABSENT.name, ALL)),
        (column("detectable"), lambda row: float(row["detectable"])),
        (column("n"), lambda row: int(row["n"])),
        (column("missing"), lambda row: int(row["missing"]) or Cell(text="-", key=0.0)),
        (column("blocks"), _blocks_cell),
    )
    table = table_of(
        file_stem("board", suite, track, prior_group),
        f"{suite}: {track}, {prior_words(prior_group)}",
        sorted(found.values(), key=lambda row: (-_value(row), row["matcher"])),
        fields,
        notes=_notes(book, ties, found, ranked),
        tone=lambda row: tone.get(row["matcher"], "plain"),
    )
    return table.without_empty(*beside, "false fixes", "control", "detectable", "missing")


def _blocks_cell(row: Record) -> Cell:
    return Cell(text=f"{row['blocks']} in {counted(int(row['places']), 'place')}", key=float(row["blocks"]))


def _value(row: Record) -> float:
    value = float(row["value"])
    return -math.inf if math.isnan(value) else value


def _value_of(row: Record | None) -> float:
    return math.nan if row is None else float(row["value"])


def _notes(book: Book, ties: Sequence[Tie], found: Mapping[str, Record], ranked: int) -> tuple[str, ...]:
    if not found:
        return ("No entry has a value here.",)
    if ranked:
        lines = [f"Tied: {tie.to_text()}." for tie in ties]
        return tuple(lines or (["No two share a rank."] if ranked > 1 else ["One alone is ranked."]))
    if book.controls.issuperset(found):
        return ("Only controls answered.",)
    return ("Sorted by value; entries are not ranked in this table.",)


def _for_nothing(book: Book, key: Key) -> str:
    """Return what the prior alone and guessing reach; of flights the odometer alone."""
    _, track, _ = key
    primary = primary_of(track).name
    what, control = ("the odometer alone", _ODOMETER_ALONE) if track == SEQUENCE else ("the prior alone", _PRIOR_ALONE)
    alone = next((name for name in book.matchers[key] if base_name(name) == control), None)
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


def use_table(book: Book, key: Key) -> Table:
    """Return what an integrator asks beside the first figure: errors; of flights how often fixes come, and how honest.

    There are no rows on a track without such figures; columns that the board does not have are left out.
    """
    suite, track, prior_group = key
    terms = _USES.get(track, {})

    def _figure(term: str) -> Callable[[str], Cell]:
        times = 100.0 if term == "log_scale_median" else 1.0  # a logarithm of 0.01 is 1 %
        return lambda name: figure_cell(_scaled(book.main(key, name, term), times))

    fields = (
        (word("matcher"), book.short_name),
        *((column(term, title=title), _figure(term)) for term, title in terms.items()),
    )
    table = table_of(
        file_stem("use", suite, track, prior_group),
        f"{'Fixes in use' if track == SEQUENCE else 'Errors'}: {suite}, {track}, {prior_words(prior_group)}",
        sorted(book.matchers[key] if terms else (), key=lambda name: (name in book.controls, name)),
        fields,
        tone=lambda name: "control" if name in book.controls else "plain",
    )
    return table.without_empty(*terms)


def use_tables(book: Book) -> Iterator[Table]:
    """Yield `use_table` of each suite, track and prior group."""
    yield from (use_table(book, key) for key in sorted(book.matchers))


def _scaled(row: Record | None, times: float) -> Record | None:
    return row and {**row, **{name: times * float(row[name]) for name in ("value", "lo", "hi")}}


def strata_tables(book: Book, key: Key) -> Iterator[Table]:
    """Yield the primary figure of each part of a suite, a matcher a column, in tables that a screen holds."""
    suite, track, prior_group = key
    primary = primary_of(track).name
    for number, first in enumerate(range(0, len(book.matchers[key]), MOST_COLUMNS), start=1):
        names = book.matchers[key][first : first + MOST_COLUMNS]
        lines: list[Sequence[Shown]] = []
        for part in book.strata[key]:
            rows = [book.pick(key, name, primary, part) for name in names]
            counts = sorted({int(row["n"]) for row in rows if row is not None})
            if counts:
                n = Cell(text="-".join(map(str, counts)), key=float(counts[0]))
                ceiling = _value_of(book.pick(key, names[0], CEILING.name, part))
                lines.append((part, n, ceiling, *map(figure_cell, rows)))
        more = ("", "") if number == 1 else (str(number), f", table {number}")
        yield grid_of(
            file_stem("strata", suite, track, prior_group, more[0]),
            f"{primary} by stratum: {track}, {prior_words(prior_group)}{more[1]}",
            (word("part"), column("n"), column(CEILING.name), *(column(primary, title=name) for name in names)),
            lines,
            notes=[f"Cells: {primary} with its 95 % interval. {column(primary).meaning}."],
        )


def cost_table(book: Book) -> Table:
    """Return the costs of all entries, a metric a column; no rows where the board has none."""
    found = {key: row for key, row in book.figures.items() if key[0] == ALL_SUITES and key[-1] in SHOWN_COSTS}
    kinds = sorted({(SHOWN_COSTS.index(key[-1]), key[-1], key[1]) for key in found})
    by_kind = {(key[3], key[-1], key[1]): row for key, row in found.items()}
    units = {key[-1]: str(row["unit"]) for key, row in found.items()}
    values = {
        name: [_value_of(by_kind.get((name, metric, track))) for _, metric, track in kinds]
        for name in sorted({key[3] for key in found})
    }
    order = sorted(values, key=lambda name: [(math.isnan(value), value) for value in values[name][:1]])
    columns = [
        column(
            metric,
            title=f"{metric}{'' if track == 'all' else f', {track}'} ({units[metric]})",
            order="none" if at else "ascending",
        )
        for at, (_, metric, track) in enumerate(kinds)
    ]
    notes = (
        "Measured once, on the machine that made the board; 1 kB is 1000 bytes, 1 MB a million.",
        "Each was measured on the queries that it was asked: those of other suites do not compare.",
    )
    lines: list[tuple[Shown, ...]] = [(book.name_cell(name), *values[name]) for name in order]
    return grid_of("costs", "What answers cost", (word("matcher"), *columns), lines, notes=notes)


def step_tables(steps: pd.DataFrame, ages: Mapping[tuple[Any, ...], str] | None = None) -> Iterator[Table]:
    """Yield success along each ladder of strengths: a matcher a line, a step a column; strength 0 is the control.

    `steps` is from `strata.steps_frame`; `ages`, from `plots.age_names`, names steps that are ages of a map.
    """
    named = ages or {}
    for key, part in steps.groupby([*GROUP, "kind", "strength_unit"], sort=True) if len(steps) else ():
        suite, track, prior_group, kind, unit = map(str, key)
        records = records_of(part)
        counts: dict[tuple[int, float], int] = {}
        for row in sorted(records, key=lambda row: (row["view_cells"], row["strength"])):
            step = (row["view_cells"], row["strength"])
            counts[step] = max(counts.get(step, 0), int(row["n"]))
        order = part.groupby("matcher")["value"].mean().sort_index().sort_values(ascending=False, kind="stable")
        by_step = {(row["matcher"], row["view_cells"], row["strength"]): row for row in records}
        titles = [
            f"{named.get((suite, track, prior_group, strength, size), f'{strength:g}')}, {size} cells, n = {n}"
            for (size, strength), n in counts.items()
        ]
        yield grid_of(
            file_stem("steps", suite, track, prior_group, kind),
            f"{suite}: {track}, {prior_words(prior_group)}, step by step: {kind} ({unit})",
            (word("matcher"), *(column(primary_of(track).name, title=title) for title in titles)),
            [(name, *(figure_cell(by_step.get((name, *step))) for step in counts)) for name in order.index],
        )


def is_ranked(row: Record | None) -> bool:
    """Return whether a figure has a rank: of an entry that competes, at enough places."""
    return row is not None and not is_unranked(str(row["matcher"])) and not pd.isna(row["rank_best"])


def short_cell(row: Record | None, *, is_rivalled: bool = False, has_rank: bool = True) -> Cell:
    """Return a figure, its interval and its rank as in "0.750 [0.30, 0.95] (2-3)".

    It leads where it `is_rivalled` and may have the first rank.
    """
    if row is None:
        return Cell(text="-")
    if not row["is_applicable"]:
        return Cell(text="n/a")
    value, leads = float(row["value"]), is_rivalled and is_ranked(row) and int(row["rank_best"]) == 1
    ends = [] if math.isnan(row["lo"]) else [f"[{row['lo']:.2f}, {row['hi']:.2f}]"]
    details = (*ends, *([f"({rank_text(row)})"] if has_rank else []))
    return Cell(text=number_text(value), key=sort_key(value), tone="leading" if leads else "plain", details=details)


_REJECTION: Final = (  # metrics of the tables of rejectors
    *("aurc", "e_aurc", "auroc", "coverage_at_risk_0.05", "risk_reached_at_0.05"),
    *("right_at_absent_0.05", "absent_reached_at_0.05", "ece", "cost_20"),
)
SHOWN_RISK: Final = 0.05
COVERED: Final = "coverage_at_risk_0.05"
REACHED: Final = "risk_reached_at_0.05"
_RISK_NOTES: Final = (
    "A matcher stands here with the rejector that orders its answers best on these very places, which flatters it.",
    "Thresholds are of other places.",
    "Rows with different n are of different queries: do not compare them. † marks Wilson's interval over sites.",
)
_BY_SUITE_NOTES: Final = (
    "One threshold for all suites: where a suite is hard, more of its answers are false.",
    "Controls and falsifiers of twins and of alias count, whose two places cannot be told apart.",
)
SHOWN_RATIO: Final = 20.0  # of the costs of a false fix and of withholding a right one
_MIXTURES: Final = (AS_DRAWN, *map(mixture_name, PRESENT_SHARES))


Pair = tuple[str, str]  # matcher and rejector
Best = Mapping[Pair, Mapping[str, Record]]  # figures by metric


def rejection_tables(board: pd.DataFrame) -> Iterator[Table]:
    """Yield matcher x rejector over all suites, a table for each track and prior group."""
    for key, part in _rejection_rows(board).groupby(["track", "prior_group"], sort=True):
        track, prior_group = map(str, key)
        title = f"Rejection: {track}, {prior_words(prior_group)}"
        yield _rejection_table(part, file_stem("rejection", track, prior_group), title)


def rejection_of(board: pd.DataFrame, matcher: str) -> Table | None:
    """Return the rejectors of one matcher over all suites, every track and prior group a line; None without any."""
    rows = _rejection_rows(board)
    mine = rows[rows["matcher"] == matcher]
    return None if mine.empty else _rejection_table(mine, "rejection", "Rejection, all suites", has_queries=True)


def _rejection_rows(board: pd.DataFrame) -> pd.DataFrame:
    return board[(board["rejector"] != "") & (board["suite"] == ALL_SUITES) & (board["stratum"] == AS_DRAWN)]


def _rejection_table(part: pd.DataFrame, name: str, title: str, *, has_queries: bool = False) -> Table:
    """Return rejectors, the best first and those of controls last, whose order of answers is arbitrary.

    `has_queries` adds a column of the track and prior group of each line.
    """
    found = {
        tuple(map(str, key)): _by_metric(mine)
        for key, mine in part.groupby(["matcher", "rejector", "track", "prior_group"], sort=True)
    }
    is_control = {key: is_unranked(key[0]) for key in found}
    order = sorted(found, key=lambda key: (is_control[key], _area(found[key]), key))
    columns = [column(metric, order="ascending" if metric == "aurc" else "none") for metric in (*_REJECTION, "n")]
    lines: list[tuple[Shown, ...]] = [
        (
            *key[:2],
            *([f"{key[2]}, {key[3]}"] if has_queries else []),
            *(figure_cell(found[key].get(metric)) for metric in _REJECTION),
            int(next(iter(found[key].values()))["n"]),
        )
        for key in order
    ]
    return grid_of(
        name,
        title,
        (word("matcher"), word("rejector"), *([word("queries")] if has_queries else []), *columns),
        lines,
        notes=("ECE and costs have no interval on this board: they decide nothing.",),
        tones=["control" if is_control[key] else "plain" for key in order],
    )


def _by_metric(part: pd.DataFrame) -> dict[str, Record]:
    return {str(row["metric"]): row for row in records_of(part)}


def _area(by_name: Mapping[str, Record]) -> float:
    """Return the area that orders rejectors, infinite where there is none."""
    area = by_name["aurc"]["value"] if "aurc" in by_name else math.nan
    return math.inf if math.isnan(area) else float(area)


def risk_tables(board: pd.DataFrame) -> Iterator[Table]:
    """Yield what ranked matchers answer where 5 % of the answers may be false, a table for each track and prior group.

    A line is a matcher with the rejector that orders its answers best, by their area; `rejection_tables` have them all.
    """
    answered, reached = column(COVERED, title="answered"), column(REACHED, title="false of these")
    for best, _, track, prior_group in _best_pairs(board):
        yield grid_of(
            file_stem("risk", track, prior_group),
            f"Answers where 5 % of them may be false fixes: {track}, {prior_words(prior_group)}",
            (word("matcher"), word("rejector"), answered, reached, word("risk kept"), column("n")),
            [
                (
                    *pair,
                    figure_cell(by_name.get(COVERED)),
                    figure_cell(by_name.get(REACHED)),
                    _kept(by_name.get(REACHED)),
                    int(by_name["aurc"]["n"]),
                )
                for pair, by_name in best.items()
            ],
            notes=_RISK_NOTES,
        )


def risk_tables_by_suite(board: pd.DataFrame) -> Iterator[Table]:
    """Yield how many of the answers of `risk_tables` are false where more places are absent, and in each suite."""
    shares = {mixture_name(share): f"{100 * (1 - share):.0f} % of places absent" for share in PRESENT_SHARES}
    for best, part, track, prior_group in _best_pairs(board):
        reached = part[part["metric"] == REACHED]
        suites = sorted(set(reached["suite"]) - {ALL_SUITES})
        places = [(ALL_SUITES, mixture) for mixture in shares] + [(suite, AS_DRAWN) for suite in suites]
        keys = zip(*(reached[field] for field in ("matcher", "rejector", "suite", "stratum")), strict=True)
        by_key: dict[tuple[str, ...], Record] = dict(zip(keys, records_of(reached), strict=True))
        titles = (*shares.values(), *suites)
        where = f"{track}, {prior_words(prior_group)}"
        yield grid_of(
            file_stem("risk-by-suite", track, prior_group),
            f"How many of these are false, by share of absent places and by suite: {where}",
            (word("matcher"), word("rejector"), *(column(REACHED, title=title) for title in titles)),
            [(*pair, *(short_cell(by_key.get((*pair, *place)), has_rank=False) for place in places)) for pair in best],
            notes=_BY_SUITE_NOTES,
        )


def _best_pairs(board: pd.DataFrame) -> Iterator[tuple[Best, pd.DataFrame, str, str]]:
    """Yield the matchers, each with the rejector of the least area, by that area, of a track and prior group.

    With them come the rows of all, track and prior group; without a matcher that has an area there is nothing.
    """
    rows = board[(board["rejector"] != "") & ~board["matcher"].map(is_unranked).astype(bool)]
    for (track, prior_group), part in rows.groupby(["track", "prior_group"], sort=True):
        pairs = _rejection_rows(part).groupby(["matcher", "rejector"])
        found = {(str(key[0]), str(key[1])): _by_metric(mine) for key, mine in pairs}
        best: dict[str, Pair] = {}
        for area, key in sorted((_area(by_name), key) for key, by_name in found.items()):
            if area < math.inf:
                best.setdefault(key[0], key)
        if best:
            yield {key: found[key] for key in best.values()}, part, str(track), str(prior_group)


def _kept(row: Record | None) -> str:
    """Return whether the interval of a reached risk shows that it was kept.

    >>> [_kept({"lo": lo, "hi": hi}) for lo, hi in ((0.0, 0.04), (0.03, 0.07), (0.06, 0.2))], _kept(None)
    (['yes', 'open', 'no'], '-')
    """
    if row is None or math.isnan(row["lo"]):
        return "-"
    if row["hi"] <= SHOWN_RISK:
        return "yes"
    return "no" if row["lo"] > SHOWN_RISK else "open"


def acceptance_tables(acceptance: pd.DataFrame) -> Iterator[Table]:
    """Yield risk and coverage by the kind of absence, a table for each track and prior group, the least risk first.

    `acceptance` is from `rejection.acceptance_frame`. One cost ratio is shown, and no controls.
    """
    if not len(acceptance):
        return
    shown = acceptance[(acceptance["cost_ratio"] == SHOWN_RATIO) & ~acceptance["matcher"].map(is_unranked).astype(bool)]
    shares = (AS_DRAWN, *(f"{100 * (1 - share):.0f} % absent" for share in PRESENT_SHARES))
    columns = [
        column(term, title=f"{term.split()[0]}, {share}") for share in shares for term in ("risk of fixes", "coverage")
    ]
    for (track, prior_group), part in shown.groupby(["track", "prior_group"], sort=True):
        found = {
            tuple(map(str, key)): {str(row["mixture"]): row for row in records_of(mine)}
            for key, mine in part.groupby(["matcher", "rejector", "absence"], sort=True)
        }
        risks = {key: float(rows[AS_DRAWN]["risk"]) for key, rows in found.items() if AS_DRAWN in rows}
        whole = {key[:2]: risk for key, risk in risks.items() if key[2] == "all" and not math.isnan(risk)}
        lines: list[tuple[Shown, ...]] = [
            (
                *key,
                int(next(iter(rows.values()))["absent"]),
                *(share_cell(rows.get(mixture), name) for mixture in _MIXTURES for name in ("risk", "coverage")),
            )
            for key, rows in sorted(found.items(), key=lambda item: (whole.get(item[0][:2], math.inf), item[0]))
        ]
        yield grid_of(
            file_stem("acceptance", str(track), str(prior_group)),
            f"Risk and coverage by kind of absence: {track}, {prior_words(str(prior_group))}",
            (word("matcher"), word("rejector"), word("absence"), column("absent"), *columns),
            lines,
            notes=(
                f"Fixes accepted by Eq. 14 at costs of {SHOWN_RATIO:g} to 1; acceptance.parquet holds other costs.",
            ),
        )


def share_cell(row: Record | None, name: str) -> Cell:
    """Return a cell of a share of a table whose ends have its name, as in `risk`, `risk_lo`, `risk_hi`."""
    if row is None:
        return figure_cell(None)
    value, lo, hi = (float(row[f"{name}{end}"]) for end in ("", "_lo", "_hi"))
    return figure_cell({"value": value, "lo": lo, "hi": hi, "unit": "1", "interval": "", "is_applicable": True})


_AREAS: Final = ("available", "misleading", "hazardous", "exceeded")


def protection_tables(protection: pd.DataFrame) -> Iterator[Table]:
    """Yield the results of protection levels at one alert limit, a table for each prior group."""
    limits = sorted(set(protection["alert_limit_m"])) if len(protection) else ()
    shown_m = FIX_M if FIX_M in limits else next(iter(limits), FIX_M)
    others = " and ".join(f"{limit:g}" for limit in limits if limit != shown_m)
    columns = (word("matcher"), word("method"), column("risk", order="ascending"), *map(column, (*_AREAS, "n")))
    shown = protection[protection["alert_limit_m"] == shown_m] if limits else protection
    for prior_group, part in shown.groupby("prior_group", sort=True) if limits else ():
        order = part.sort_values(["risk", "available", "matcher", "method"], ascending=[True, False, True, True])
        yield grid_of(
            file_stem("protection", str(prior_group)),
            f"Alert limit {shown_m:g} m, {prior_words(str(prior_group))}",
            (*columns, word("supports")),
            [
                (
                    *(str(row["matcher"]), str(row["method"]), float(row["risk"])),
                    *(share_cell(row, area) for area in _AREAS),
                    *(int(row["n"]), str(row["supports"])),
                )
                for row in records_of(order)
            ],
            notes=[f"Alert limits of {others} m: protection.parquet holds them."] if others else (),
        )


_REQUIREMENT_NOTES: Final = (
    "Passes: the worse end of the 95 % interval meets the requirement. Fails: the better end does not. Else not shown.",
    "Figures are of the queries that the first figure counts.",
    "Those of accepted answers are of all queries of the suite, with thresholds that were chosen at other places.",
)
_RISK_REACHED: Final = frozenset(f"risk_reached_at_{risk:g}" for risk in RISKS)
_TONE_OF: Final[Mapping[str, str]] = {PASSES: "passes", FAILS: "fails", NOT_SHOWN: "plain"}


def requirement_tables(requirements: pd.DataFrame, book: Book) -> Iterator[Table]:
    """Yield which entries pass the requirements, a table for each suite, track and prior group.

    A line is an entry, with each of its rejectors where a requirement is about accepted answers; `requirements` are of
    `requirements.compliance_frame`.
    """
    parts = requirements.groupby(["suite", "track", "prior_group"], sort=True) if len(requirements) else ()
    for at, ((suite, track, prior_group), part) in enumerate(parts):
        by_name: dict[str, dict[str, dict[str, Record]]] = {}
        for row in records_of(part):
            by_name.setdefault(row["matcher"], {}).setdefault(row["rejector"], {})[row["requirement"]] = row
        asked = list(dict.fromkeys(part["requirement"]))
        lines: list[tuple[Shown, ...]] = []
        for name, found in by_name.items():
            for rejector in [one for one in found if one] or [""]:
                rows = found.get("", {}) | found.get(rejector, {})
                verdicts = {row["verdict"] for row in rows.values()}
                whole = next((one for one in (FAILS, NOT_SHOWN) if one in verdicts), PASSES)
                cells = (_requirement_cell(rows.get(one)) for one in asked)
                counts = sorted({int(row["n"]) for row in rows.values()} - {0}) or [0]
                n = Cell(text="-".join(map(str, counts)), key=float(counts[0]))
                lines.append(
                    (book.short_name(name), rejector or "-", Cell(text=whole, tone=_TONE_OF[whole]), *cells, n)
                )
        yield grid_of(
            file_stem("requirements", str(suite), str(track), str(prior_group)),
            f"Requirements: {suite}, {track}, {prior_words(str(prior_group))}",
            (
                word("matcher"),
                word("rejector"),
                column("requirement", title="all"),
                *(column("requirement", title=one) for one in asked),
                column("n"),
            ),
            lines,
            notes=() if at else _REQUIREMENT_NOTES,
        ).without_empty("rejector")


def _requirement_cell(row: Record | None) -> Cell:
    """Return a verdict, with the figure, its interval and the share that was accepted, or confirmed, if these count."""
    if row is None:
        return Cell(text="-")
    value, lo, hi, accepted = (float(row[name]) for name in ("figure", "figure_lo", "figure_hi", "accepted"))
    done = "confirmed" if "confirmed" in str(row["metric"]) else "accepted"
    if accepted == 0:
        details = [f"nothing {done}"]
    elif math.isnan(value):
        details = ["no threshold" if row["metric"] in _RISK_REACHED else "not measured"]
    else:
        details = [_amount_text(value, lo, hi, unit=str(row["unit"]))]
        details += ["in time"] if is_latency(str(row["metric"])) else []
        details += [] if math.isnan(accepted) else [f"of {100 * accepted:.3g} % {done}"]
    verdict = str(row["verdict"])
    return Cell(text=verdict, key=sort_key(value), tone=_TONE_OF[verdict], details=tuple(details))


def _amount_text(value: float, lo: float, hi: float, *, unit: str) -> str:
    """Return a figure with its interval, a share in per cent.

    >>> _amount_text(0.8123, 0.7, 0.9, unit="1"), _amount_text(31.0, math.nan, math.nan, unit="s")
    ('81.2 % [70.0, 90.0]', '31.0 s')
    """
    scale, shown = (100.0, "%") if unit == "1" else (1.0, unit)
    ends = "" if math.isnan(lo) else f" [{_tenth(scale * lo)}, {_tenth(scale * hi)}]"
    return f"{_tenth(scale * value)} {shown}{ends}"


def _tenth(value: float) -> str:
    return "inf" if math.isinf(value) else f"{value:.1f}"


def scene_tables(scenes: pd.DataFrame, book: Book) -> Iterator[Table]:
    """Yield success by kind of place, a table for each suite, track and prior group; `scenes` is of `scene_frame`.

    Those of most places come first. The first two lines count places and queries. Kinds with too few places to rank
    anybody are marked.
    """
    parts = scenes.groupby(list(GROUP)) if len(scenes) else ()
    for key, part in sorted(parts, key=lambda group: (-int(group[1]["places"].max()), group[0])):
        suite, track, prior_group = map(str, key)
        found: dict[str, dict[str, Record]] = {}
        for row in records_of(part):
            found.setdefault(str(row["stratum"]), {})[str(row["matcher"])] = row
        use, card = AS_USED[suite.partition(BY)[0]], suite_card(suite)
        kinds = [kind for kind in (ALL, *SCENES) if kind in found]
        primary = str(next(iter(found[ALL].values()))["metric"])
        order = sorted(found[ALL], key=lambda name: (-_value(found[ALL][name]), name))
        first = [next(iter(found[kind].values())) for kind in kinds]
        places = [
            replace(plain_cell(int(row["places"])), marks=(FEW,) if row["places"] < LEAST_PLACES else ())
            for row in first
        ]
        figures = [[short_cell(found[kind].get(name), is_rivalled=len(order) > 1) for kind in kinds] for name in order]
        meaning = f"{column('kind of place').meaning}. {primary}: {column(primary).meaning}"
        notes = [suite_words(suite)]
        if card is not None and use.strength is not None:
            notes.append(
                f"Only views of strength {use.strength:g} ({card.strength_unit}), as they are expected in use."
            )
        yield grid_of(
            file_stem("kinds", suite, track, prior_group),
            f"With {use.words} ({suite}): {primary} [95 %] (rank), {track}, {prior_words(prior_group)}",
            (word("matcher"), *(replace(column(primary, title=kind), meaning=meaning) for kind in kinds)),
            [
                ("places", *places),
                ("queries", *(int(row["n"]) for row in first)),
                *((book.short_name(name), *line) for name, line in zip(order, figures, strict=True)),
            ],
            notes=notes,
            tones=["head", "head", *["plain"] * len(order)],
        )


_CONTROLS_NOTE: Final = (
    "The right score of these queries is known beforehand. At chance: views of a shuffled map, of a map turned by "
    "half, and of one of two places that are the same."
)
_SEEDS_NOTE: Final = (
    "The same matchers, by version and hash, on the same pipeline drawn by a private seed. The sites differ, so no "
    "query pairs with another: draws resample blocks of ground with the queries of both seeds that lie in them. All "
    "intervals of a matcher hold at once (95 %). Shown are the figures over all suites, and whatever is worse on the "
    "private seed."
)
_FALSIFIERS_NOTE: Final = (
    "The entries of each contrast where the difference between them is taken away: at the same places without the "
    "stress (`control`), and on the falsifiers of each suite. A gain here as well is not caused by what the contrast "
    "is named for."
)


def seed_table(entries: Sequence[BoardEntry]) -> Table:
    """Return figures on the public and on a private seed: of all suites, and whatever is shown to be worse.

    No rows where none was compared with a private seed.
    """
    shown = [
        (entry.name, item)
        for entry in entries
        for item in (() if entry.private is None else entry.private.figures)
        if item.suite == ALL_SUITES or item.is_worse
    ]
    fields: tuple[Field[tuple[str, SeedFigure]], ...] = (
        (word("matcher"), lambda one: one[0]),
        (word("suite"), lambda one: one[1].suite),
        (word("track"), lambda one: one[1].track),
        (word("figure"), lambda one: one[1].metric),
        (column("public"), lambda one: number_text(one[1].public)),
        (column("private"), lambda one: number_text(one[1].private)),
        (column("private less public"), lambda one: interval_text(one[1].difference, one[1].lo, one[1].hi)),
        (column("n"), lambda one: f"{one[1].n_public} and {one[1].n_private}"),
        (column("blocks"), lambda one: _blocks_text(one[1])),
        (word("shown"), lambda one: "worse" if one[1].is_worse else "not shown to be worse"),
    )
    return table_of("seeds", "Public and private seed", shown, fields, notes=(_SEEDS_NOTE,))


def _blocks_text(item: SeedFigure) -> str:
    return f"{item.blocks_public} and {item.blocks_private}, {item.blocks_shared} in both"


def _limit_cell(verdict: Verdict) -> Cell:
    """Return how many right answers fail a control against chance."""
    if math.isnan(verdict.p):
        return Cell(text="-")
    limit = verdict.fails_at
    return Cell(text="never") if limit is None else plain_cell(limit)


_OF_CONTROLS: Final[tuple[Field[Verdict], ...]] = (
    (word("control query", title="control"), lambda item: item.control),
    (word("matcher"), lambda item: item.matcher),
    (column("n"), lambda item: item.n),
    (column("found"), lambda item: Cell(text=tally_text(item.found), key=item.found)),
    (column("expected"), lambda item: Cell(text=tally_text(item.expected), key=item.expected)),
    (column("p"), lambda item: p_cell(item.p)),
    (column("fails at"), _limit_cell),
    (word("outcome"), lambda item: "held" if item.holds else "FAILED"),
)


def control_table(verdicts: Sequence[Verdict]) -> Table:
    """Return every control of every matcher."""
    return table_of("controls", "Controls, one by one", verdicts, _OF_CONTROLS, notes=(_CONTROLS_NOTE,))


def _side(name: str, value: float) -> Cell:
    return Cell(text=f"{name}: {number_text(value)}", key=sort_key(value))


def _difference(item: Finding) -> Cell:
    return Cell(text=interval_text(item.difference, item.lo, item.hi), key=sort_key(item.difference))


_BY_COUNTRIES: Final = "by countries"
_OF_CONTRASTS: Final[tuple[Field[Finding], ...]] = (
    (word("contrast"), lambda item: item.name),
    (column("first"), lambda item: _side(item.first, item.first_value)),
    (column("second"), lambda item: _side(item.second, item.second_value)),
    (column("difference"), _difference),
    (column("by blocks"), lambda item: _ends_text(item.lo_blocks, item.hi_blocks)),
    (column(_BY_COUNTRIES), lambda item: _ends_text(item.lo_countries, item.hi_countries)),
    (column("attainable"), lambda item: item.attainable),
    (column("matters"), lambda item: item.least),
    (column("p (Holm)"), lambda item: p_cell(item.p_holm)),
    (column("discordant"), lambda item: "-" if item.metric in AREAS else _discordant_text(item)),
    (column("detectable"), lambda item: item.detectable),
    (column("n"), lambda item: Cell(text=_counts_text(item), key=float(item.n))),
    (word("verdict"), lambda item: item.verdict),
)


_OF_FALSIFIERS: Final[tuple[Field[Falsifier], ...]] = (
    (word("contrast"), lambda item: item.contrast),
    (word("suite"), lambda item: item.suite),
    (word("kind"), lambda item: item.kind),
    (column("first"), lambda item: _side(item.finding.first, item.finding.first_value)),
    (column("second"), lambda item: _side(item.finding.second, item.finding.second_value)),
    (column("difference"), lambda item: _difference(item.finding)),
    (column("discordant"), lambda item: _discordant_text(item.finding)),
    (column("n"), lambda item: Cell(text=_counts_text(item.finding), key=float(item.finding.n))),
    (word("verdict"), lambda item: item.verdict),
)


def contrast_table(findings: Sequence[Finding]) -> Table:
    """Return the registered contrasts; intervals by countries where places share some."""
    return table_of("contrasts", "Registered contrasts", findings, _OF_CONTRASTS).without_empty(_BY_COUNTRIES)


def falsifier_table(found: Sequence[Falsifier]) -> Table:
    """Return the entries of each contrast where they should not differ."""
    return table_of("falsifiers", "Falsifiers", found, _OF_FALSIFIERS, notes=(_FALSIFIERS_NOTE,))


def _discordant_text(item: Finding) -> str:
    return f"{item.first_only} and {item.second_only}"


def _ends_text(lo: float, hi: float) -> str:
    """Return an interval by other clusters than places; "-" for none."""
    return "-" if math.isnan(lo) else f"[{number_text(lo)}, {number_text(hi)}]"


def _counts_text(item: Finding) -> str:
    where = f"{item.n} in {counted(item.blocks, 'block')}, {counted(item.places, 'place')}"
    return f"{where}, {counted(item.countries, 'country', 'countries')}" if 0 < item.countries < item.places else where
