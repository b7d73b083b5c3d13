# SPDX-License-Identifier: Apache-2.0
"""Content of the pages of a site as values: contrasts in words, suites and matchers."""

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Final

import pandas as pd

from sasgeo_bench.boards.board_figures import FIGURES, OTHERS
from sasgeo_bench.boards.board_tables import SHOWN_COSTS, Book, rejection_of, strata_tables, suite_table, use_table
from sasgeo_bench.boards.manifests import BoardEntry, Picture
from sasgeo_bench.boards.site_files import SiteFigure, SiteSource
from sasgeo_bench.boards.tables import (
    UNSTRESSED,
    Bar,
    Cell,
    Field,
    Key,
    Table,
    column,
    figure_cell,
    file_stem,
    interval_text,
    number_cell,
    number_text,
    p_text,
    prior_words,
    rank_cell,
    suite_card,
    table_of,
    word,
)
from sasgeo_bench.core.errors import counted
from sasgeo_bench.running.prediction_files import CardRecord
from sasgeo_bench.scoring.compare import BETTER, LOWER, Finding, Outcome
from sasgeo_bench.scoring.metrics import FALSE_ABSENT, primary_of
from sasgeo_bench.scoring.rows import ALL_SUITES
from sasgeo_bench.tasks.query import base_of
from sasgeo_bench.tasks.suites.base import SuiteCard

_OTHERS: Final = "Other figures"


def figures_by_kind(figures: Sequence[SiteFigure]) -> dict[str, list[SiteFigure]]:
    """Return figures under the headings of their kinds."""
    headings = {stem: f"{what[0].upper()}{what[1:]}" for stem, what in FIGURES.items() if stem not in OTHERS}
    found: dict[str, list[SiteFigure]] = {heading: [] for heading in (*headings.values(), _OTHERS)}
    for item in figures:
        found[headings.get(item.file.partition("-")[0], _OTHERS)].append(item)
    return {heading: items for heading, items in found.items() if items}


# --- contrasts -------------------------------------------------------------------------------------------------------


_OF_SHARES: Final = frozenset({"primary", "interaction", "shift"})  # metrics whose meaning is a name that all know
OUTCOMES: Final[Mapping[Outcome, str]] = {  # in the order of the page, with their meanings
    "decided": "A difference is shown: its interval and its test, adjusted for all contrasts, leave out 0",
    "cause open": "A difference is shown, but the first is ahead without the stress, too, which need not be the cause",
    "decided, small": "A difference is shown, and one as large as was registered to matter is ruled out",
    "equal": "No difference is shown, and one as large as was registered to matter is ruled out, either way",
    "not decided": "Neither a difference is shown, nor ruled out that there is one that matters",
    "not tested": "No query of this board counts for it",
}


@dataclass(frozen=True, slots=True, kw_only=True)
class ContrastSummary:
    """A registered contrast in plain words.

    `outcome` is one of `OUTCOMES`; `because` says why neither is better, empty where one is. `ends` say who is better
    where the difference is below 0, and where it is above, `side` on which of the two it lies.
    `unstressed` compares both where they should not differ, empty if nothing was measured there; `bar` spans from
    -`reach` to `reach`, with `least` of it on both sides of the middle too small to matter, in per cent.
    """

    name: str
    outcome: Outcome
    headline: str
    because: str
    difference: str
    side: str
    ends: tuple[str, str]
    sentence: str
    facts: tuple[str, ...]
    unstressed: str
    why: str
    figure: str
    bar: Bar | None
    least: float
    reach: float


def contrasts_of(source: SiteSource) -> tuple[ContrastSummary, ...]:
    """Return registered contrasts, decided ones first; stored words are made anew, for older boards have others."""
    findings = source.board.findings
    ends = [abs(end) for item in findings for end in (item.lo, item.hi, item.difference)]
    reach = max((end for end in ends if math.isfinite(end)), default=1.0) or 1.0
    order = list(OUTCOMES)
    return tuple(
        sorted((_summary(item, source, reach) for item in findings), key=lambda found: order.index(found.outcome))
    )


def _summary(item: Finding, source: SiteSource, reach: float) -> ContrastSummary:
    below, above = _ends(item)
    figure = f"{file_stem('contrast', item.name)}.svg"
    known = (item.lo, item.hi, item.difference)
    lo, hi, at = (round(50 + 50 * value / reach, 1) if math.isfinite(value) else math.nan for value in known)
    return ContrastSummary(
        name=item.name,
        outcome=item.outcome,
        headline=item.headline.removesuffix(f": {item.outcome}"),  # which stands beside it
        because="" if item.outcome in BETTER else item.verdict.partition(": ")[2] or item.verdict,
        difference=_difference_text(item) if item.n else "",
        side=f"above 0: {above} ahead" if item.difference >= 0 else f"below 0: {below} ahead",
        ends=(below, above),
        sentence=_sentence(item),
        facts=tuple(_contrast_facts(item, source)),
        unstressed=_unstressed(source.board.falsifiers, item.name),
        why=source.reasons.get(item.name, ""),
        figure=figure if any(one.file == figure for one in source.figures) else "",
        bar=Bar(lo=lo, hi=hi, at=at) if all(map(math.isfinite, known)) else None,
        least=0.0 if math.isnan(item.least) else min(50.0, round(50 * item.least / reach, 1)),
        reach=reach,
    )


def _ends(item: Finding) -> tuple[str, str]:
    """Return who is better where first less second is below 0, and where it is above."""
    return (item.first, item.second) if item.metric in LOWER else (item.second, item.first)


def _sentence(item: Finding) -> str:
    """Return the difference with its interval, in words that state which direction is good."""
    if not item.n:
        return "No query of this board counts for it."
    values = f"{number_text(item.first_value)} against {number_text(item.second_value)}"
    below, above = _ends(item)
    meaning = column(item.metric).meaning
    what = f"{meaning[0].lower()}{meaning[1:]}" if item.metric in _OF_SHARES else f"{item.metric} ({meaning})"
    good = "less is better" if item.metric in LOWER else "more is better"
    return (
        f"Difference {_difference_text(item)} in the {what}: {values}; {good}. Above 0 {above} is ahead, below 0 "
        f"{below}. At most {number_text(item.attainable)} could be gained. The least difference registered as one that "
        f"matters is {number_text(item.least)}."
    )


def _difference_text(item: Finding) -> str:
    return interval_text(item.difference, item.lo, item.hi)


def _unstressed(falsifiers: pd.DataFrame, contrast: str) -> str:
    """Return how both sides fare without the stress, all suites together: the first row of a contrast."""
    own = falsifiers[falsifiers["contrast"] == contrast] if len(falsifiers) else falsifiers
    if own.empty:
        return ""
    row = own.iloc[0]
    gained = " What it gains there is not owed to what the contrast is named for." if row["lo"] > 0 else ""
    difference = interval_text(*(float(row[name]) for name in ("difference", "lo", "hi")))
    return (
        f"Without the stress, where they should not differ: {difference}, {row['verdict'].lower()} "
        f"(n = {row['n']}, {counted(int(row['blocks']), 'block')}).{gained}"
    )


def _contrast_facts(item: Finding, source: SiteSource) -> Iterator[str]:
    if not math.isnan(item.p_holm):
        yield f"adjusted p {p_text(item.p_holm)} (Holm, {counted(len(source.board.contrasts), 'contrast')})"
    yield f"n = {counted(item.n, 'query', 'queries')}"
    yield counted(item.blocks, "block")
    yield counted(item.places, "place")
    if 0 < item.countries < item.places:  # older boards do not count them
        yield counted(item.countries, "country", "countries")
    if item.metric == "primary":
        yield f"right by the first alone {item.first_only}, by the second alone {item.second_only}"
    if math.isinf(item.detectable):
        yield "so few places cannot show any difference"
    elif not math.isnan(item.detectable):
        yield f"least difference that so many places can show {number_text(item.detectable)}"
    yield from (one.queries_text() for one in source.registered if one.name == item.name)


# --- suites -----------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, kw_only=True)
class SuitePage:
    """A suite: its card where this version knows it, results, figures and example pictures."""

    name: str
    page: str
    card: SuiteCard | None
    tables: tuple[Table, ...]
    figures: tuple[SiteFigure, ...]
    pictures: tuple[Picture, ...]
    regions: tuple[str, ...]


def suites_of(source: SiteSource, book: Book) -> tuple[SuitePage, ...]:
    """Return a page for each suite on the board."""
    return tuple(_suite(name, page, source, book) for name, page in book.suite_pages.items())


def _suite(name: str, page: str, source: SiteSource, book: Book) -> SuitePage:
    keys = [key for key in book.matchers if key[0] == name]
    starts = tuple(f"{file_stem(kind, name, track)}-" for kind in FIGURES for _, track, _ in keys)
    regions = sorted({base_of(task.region) for task in source.board.about.tasks if task.suite == name})
    return SuitePage(
        name=name,
        page=page,
        card=suite_card(name),
        tables=tuple(
            table
            for key in keys
            for table in (suite_table(book, key, book.matchers[key]), use_table(book, key), *strata_tables(book, key))
        ),
        figures=tuple(item for item in source.figures if item.file.startswith(starts)),
        pictures=tuple(
            item
            for item in (*source.pictures.suites, *source.pictures.strips, *source.pictures.flights)
            if item.suite == name
        ),
        regions=tuple(regions),
    )


# --- matchers ---------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, kw_only=True)
class MatcherPage:
    """A contestant: its card, results, limits and costs."""

    name: str
    page: str
    entry: BoardEntry
    cell: Cell
    card: CardRecord | None
    trained: str
    training: tuple[str, ...]
    cannot: tuple[str, ...]
    results: tuple[Table, ...]
    rejection: Table | None
    costs: tuple[tuple[str, str, str], ...]


def matchers_of(source: SiteSource, book: Book) -> tuple[MatcherPage, ...]:
    """Return a page for each entry of the board."""
    return tuple(_matcher(name, book, source.board.leaderboard) for name in book.matcher_pages)


def _matcher(name: str, book: Book, board: pd.DataFrame) -> MatcherPage:
    entry = book.entries.get(name) or BoardEntry(name=name)
    card = entry.card or CardRecord()
    trained = _stated(card.trained_on)
    if entry.learned:
        runner = f"by the runner, in {counted(len(entry.learned), 'training')} listed below"
        trained = runner if trained == _NO_PLACE else f"{trained}; {runner}"
    results = (_results_table(book, name, *group) for group in sorted({key[1:] for key in book.matchers}))
    return MatcherPage(
        name=name,
        page=book.matcher_pages[name],
        entry=entry,
        cell=book.name_cell(name),
        card=entry.card,
        trained=trained,
        training=tuple(_training(entry)),
        cannot=tuple(_cannot(book, name, card)),
        results=tuple(table for table in results if table.rows),
        rejection=rejection_of(board, name),
        costs=tuple(_costs_of(book, name)),
    )


_NO_PLACE: Final = "no place that its card names"


def _stated(places: object) -> str:
    """Return the training places that a card names: "none", some, or some for each half."""
    if isinstance(places, Mapping):
        return "; ".join(f"half {half}: {_stated(some)}" for half, some in places.items())
    named = [] if isinstance(places, str) or not isinstance(places, Sequence) else list(map(str, places))
    return ", ".join(named) or _NO_PLACE


def _training(entry: BoardEntry) -> Iterator[str]:
    """Yield the training of an entry by the runner, and the regions it was then tested on: tasks are hundreds."""
    for one in entry.learned:
        verb = "Trained on" if one.file else "Could not be trained on"
        regions = sorted({base_of(task.partition("/")[2]) for task in one.asked})
        yield (
            f"{verb} {counted(one.pairs, 'query', 'queries')} of {', '.join(one.trained_on)}; then tested in "
            f"{counted(len(one.asked), 'task')} on {', '.join(regions)}."
        )


def _cannot(book: Book, name: str, card: CardRecord) -> Iterator[str]:
    """Yield the limits that an entry states, and those that the board shows."""
    if card.limits:
        yield card.limits
    if card.needs:
        yield f"Needs {', '.join(card.needs)}; where a query lacks that it is not applicable"
    tracks = card.tracks
    yield from (f"Does not answer {track}" for track in ("localization", "retrieval") if tracks and track not in tracks)
    rows = [(key, book.main(key, name, primary_of(key[1]).name)) for key in book.matchers if name in book.matchers[key]]
    out = [f"{key[0]} ({key[1]})" for key, row in rows if row is not None and not row["is_applicable"]]
    if out:
        yield f"Not applicable to {', '.join(out)}"
    unasked = [suite for suite in book.suite_pages if not any(key[0] == suite for key, _ in rows)]
    if unasked:
        yield f"Not asked on {', '.join(unasked)}"


def _results_table(book: Book, name: str, track: str, prior_group: str) -> Table:
    primary = primary_of(track).name
    keys = [key for key, names in book.matchers.items() if key[1:] == (track, prior_group) and name in names]
    mains = {key: book.main(key, name, primary) for key in keys}
    found = {key: row for key, row in mains.items() if row is not None}

    def _rank(key: Key) -> Cell:
        rivals = (book.main(key, other, primary) for other in book.matchers[key])
        return rank_cell(found[key], ranked=sum(row is not None and not pd.isna(row["rank_best"]) for row in rivals))

    fields: tuple[Field[Key], ...] = (
        (word("suite"), lambda key: book.suite_cell(key[0])),
        (column(primary), lambda key: figure_cell(found[key], has_bar=True)),
        (column("rank"), _rank),
        (column("control", title=UNSTRESSED), lambda key: figure_cell(book.pick(key, name, primary, "control"))),
        (column("false fixes"), lambda key: figure_cell(book.pick(key, name, FALSE_ABSENT.name))),
        (column("n"), lambda key: int(found[key]["n"])),
        (column("missing"), lambda key: int(found[key]["missing"])),
        (column("blocks"), lambda key: int(found[key]["blocks"])),
    )
    table = table_of(file_stem("results", track, prior_group), f"{track}, {prior_words(prior_group)}", found, fields)
    return table.without_empty("control", "false fixes")


def _costs_of(book: Book, name: str) -> Iterator[tuple[str, str, str]]:
    """Yield the costs of answers: metric, value with unit, meaning."""
    for key, row in book.figures.items():
        suite, track, _, matcher, _, metric = key
        if suite == ALL_SUITES and matcher == name and metric in SHOWN_COSTS:
            cell = number_cell(float(row["value"]), str(row["unit"]))
            yield (metric if track == "all" else f"{metric}, {track}", cell.text, column(metric).meaning)
