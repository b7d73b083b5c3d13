# SPDX-License-Identifier: Apache-2.0
"""Content of the pages of a site as values: contrasts in words, suites, matchers and measured ageing."""

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np
import pandas as pd
from matplotlib.axes import Axes

from sasgeo_bench.ageing.ratebook import ClassAgeing, Estimate, RateBook
from sasgeo_bench.canvas import page
from sasgeo_bench.errors import counted
from sasgeo_bench.leaderboard.board_figures import FIGURES, OTHERS
from sasgeo_bench.leaderboard.board_tables import SHOWN_COSTS, Book, rejection_of, strata_tables, suite_table
from sasgeo_bench.leaderboard.manifests import BoardEntry, Learned, Picture
from sasgeo_bench.leaderboard.plots import FAINT, BoardPage, line_keys, look_of
from sasgeo_bench.leaderboard.tables import (
    Bar,
    Cell,
    Field,
    Key,
    Record,
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
    records_of,
    suite_card,
    table_of,
    word,
)
from sasgeo_bench.osm.taxonomy import load_taxonomy
from sasgeo_bench.publishing.site_files import SiteFigure, SiteSource
from sasgeo_bench.running.prediction_files import CardRecord
from sasgeo_bench.scoring.compare import LOWER
from sasgeo_bench.scoring.contrasts import Contrast
from sasgeo_bench.scoring.metrics import FALSE_ABSENT, primary_of
from sasgeo_bench.scoring.rows import ALL_SUITES
from sasgeo_bench.scoring.strata import CONTROL
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


def _groups(book: Book) -> dict[tuple[str, str], list[Key]]:
    """Return keys of the board by track and prior group."""
    found: dict[tuple[str, str], list[Key]] = {}
    for key in book.matchers:
        found.setdefault(key[1:], []).append(key)
    return dict(sorted(found.items()))


# --- contrasts -------------------------------------------------------------------------------------------------------


_OF_SHARES: Final = frozenset({"primary", "interaction", "shift"})  # metrics whose meaning is a name that all know
BETTER: Final = frozenset({"decided", "cause open", "decided, small"})  # in which one is better
OUTCOMES: Final = ("decided", "cause open", "decided, small", "null", "not decided", "not tested")  # as on the page


@dataclass(frozen=True, slots=True, kw_only=True)
class ContrastSummary:
    """A registered contrast in plain words.

    `outcome` is one of `OUTCOMES`; `because` says why neither is better, empty where one is. `ends` say who is better
    where the difference is below 0, and where it is above, `side` on which of the two it lies.
    `unstressed` compares both where they should not differ, empty if nothing was measured there; `bar` spans from
    -`reach` to `reach`, with `least` of it on both sides of the middle too small to matter, in per cent.
    """

    name: str
    outcome: str
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
    """Return registered contrasts, decided ones first."""
    records = records_of(source.board.contrasts)
    ends = [abs(float(row[name])) for row in records for name in ("lo", "hi", "difference")]
    reach = max((end for end in ends if math.isfinite(end)), default=1.0) or 1.0
    found = [_summary(row, source, reach) for row in records]
    return tuple(sorted(found, key=lambda item: OUTCOMES.index(item.outcome)))


def _summary(row: Record, source: SiteSource, reach: float) -> ContrastSummary:
    verdict, name = str(row["verdict"]), str(row["name"])
    falsifier = _falsifier_of(source.board.falsifiers, name)
    outcome = str(row["outcome"])
    contrast = next((item for item in source.registered if item.name == name), None)
    figure = next((item.file for item in source.figures if item.file == f"{file_stem('contrast', name)}.svg"), "")
    known = [float(row[end]) for end in ("lo", "hi", "difference")]
    least = float(row["least"])
    bar = None
    if all(map(math.isfinite, known)):
        lo, hi, at = (round(50 + 50 * value / reach, 1) for value in known)
        bar = Bar(lo=lo, hi=hi, at=at)
    return ContrastSummary(
        name=name,
        outcome=outcome,
        headline=_headline(row, verdict, outcome),
        because="" if outcome in BETTER else verdict.partition(": ")[2] or verdict,
        difference=_difference_text(row) if int(row["n"]) else "",
        side=_side(row),
        ends=_ends(row),
        sentence=_sentence(row, least),
        facts=tuple(_contrast_facts(row, source, contrast)),
        unstressed="" if falsifier is None else _unstressed(falsifier),
        why=source.reasons.get(name, ""),
        figure=figure,
        bar=bar,
        least=0.0 if math.isnan(least) else min(50.0, round(50 * least / reach, 1)),
        reach=reach,
    )


def _headline(row: Record, verdict: str, outcome: str) -> str:
    first, second = row["first"], row["second"]
    if outcome in BETTER:
        better, worse = (first, second) if verdict.startswith(f"{first} is better") else (second, first)
        return f"{better} is better than {worse}" + verdict.partition(" is better")[2]
    return f"{first} against {second}"


def _ends(row: Record) -> tuple[str, str]:
    """Return who is better where first less second is below 0, and where it is above."""
    first, second = str(row["first"]), str(row["second"])
    return (first, second) if row["metric"] in LOWER else (second, first)


def _side(row: Record) -> str:
    below, above = _ends(row)
    return f"above 0: {above} ahead" if float(row["difference"]) >= 0 else f"below 0: {below} ahead"


def _sentence(row: Record, least: float) -> str:
    """Return the difference with its interval, in words that state which direction is good."""
    if not int(row["n"]):
        return "No query of this board counts for it."
    values = f"{number_text(float(row['first_value']))} against {number_text(float(row['second_value']))}"
    below, above = _ends(row)
    metric = str(row["metric"])
    meaning = column(metric).meaning
    what = f"{meaning[0].lower()}{meaning[1:]}" if metric in _OF_SHARES else f"{metric} ({meaning})"
    good = "less is better" if metric in LOWER else "more is better"
    most = number_text(float(row["attainable"]))
    return (
        f"Difference {_difference_text(row)} in the {what}: {values}; {good}. Above 0 {above} is ahead, below 0 "
        f"{below}. At most {most} could be gained. The least difference registered as one that matters is "
        f"{number_text(least)}."
    )


def _difference_text(row: Record) -> str:
    return interval_text(*(float(row[name]) for name in ("difference", "lo", "hi")))


def _falsifier_of(falsifiers: pd.DataFrame, contrast: str) -> Record | None:
    """Return how both sides fare without the stress, all suites together: the first row of a contrast."""
    own = falsifiers[falsifiers["contrast"] == contrast] if len(falsifiers) else falsifiers
    return None if own.empty else {str(name): value for name, value in own.iloc[0].items()}


def _unstressed(row: Record) -> str:
    gained = " What it gains there is not owed to what the contrast is named for." if row["lo"] > 0 else ""
    return (
        f"Without the stress, where they should not differ: {_difference_text(row)}, {row['verdict'].lower()} "
        f"(n = {row['n']}, {counted(int(row['blocks']), 'block')}).{gained}"
    )


def _contrast_facts(row: Record, source: SiteSource, contrast: Contrast | None) -> Iterator[str]:
    p = float(row["p_holm"])
    if not math.isnan(p):
        yield f"adjusted p {p_text(p)} (Holm, {counted(len(source.board.contrasts), 'contrast')})"
    yield f"n = {counted(int(row['n']), 'query', 'queries')}"
    yield counted(int(row["blocks"]), "block")
    yield counted(int(row["places"]), "place")
    if 0 < row.get("countries", 0) < row["places"]:  # older boards do not count them
        yield counted(int(row["countries"]), "country", "countries")
    if row["metric"] == "primary":
        yield f"right by the first alone {row['first_only']}, by the second alone {row['second_only']}"
    detectable = float(row["detectable"])
    if math.isinf(detectable):
        yield "so few places cannot show any difference"
    elif not math.isnan(detectable):
        yield f"least difference that so many places can show {number_text(detectable)}"
    if contrast is not None:
        yield contrast.queries_text()


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
            table for key in keys for table in (suite_table(book, key, book.matchers[key]), *strata_tables(book, key))
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
    results = [_results_table(book, name, group, keys) for group, keys in _groups(book).items()]
    return MatcherPage(
        name=name,
        page=book.matcher_pages[name],
        entry=entry,
        cell=book.name_cell(name),
        card=entry.card,
        trained=_trained(card.trained_on, entry.learned),
        training=tuple(_training(entry)),
        cannot=tuple(_cannot(book, name, card)),
        results=tuple(table for table in results if table.rows),
        rejection=rejection_of(board, name),
        costs=tuple(_costs_of(book, name)),
    )


_NO_PLACE: Final = "no place that its card names"


def _trained(stated: object, learned: Sequence[Learned]) -> str:
    """Return where an entry was trained: by its author on the places that its card names, and by the runner."""
    named = _stated(stated)
    if not learned:
        return named
    runner = f"by the runner, in {counted(len(learned), 'training')} listed below"
    return runner if named == _NO_PLACE else f"{named}; {runner}"


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


def _results_table(book: Book, name: str, group: tuple[str, str], keys: Sequence[Key]) -> Table:
    track, prior_group = group
    primary = primary_of(track).name
    mains = {key: book.main(key, name, primary) for key in keys if name in book.matchers[key]}
    found = {key: row for key, row in mains.items() if row is not None}

    def rank(key: Key) -> Cell:
        rivals = (book.main(key, other, primary) for other in book.matchers[key])
        return rank_cell(found[key], ranked=sum(row is not None and not pd.isna(row["rank_best"]) for row in rivals))

    fields: tuple[Field[Key], ...] = (
        (word("suite"), lambda key: book.suite_cell(key[0])),
        (column(primary), lambda key: figure_cell(found[key], has_bar=True)),
        (column("rank"), rank),
        (column("control"), lambda key: figure_cell(book.pick(key, name, primary, CONTROL))),
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


# --- measured ageing --------------------------------------------------------------------------------------------------


def rate_table(book: RateBook) -> Table:
    """Return measured yearly rates with their intervals, a row for each class of a place."""
    titles = {item.name: item.title for item in load_taxonomy().classes}
    found = [
        (titles[name], place.name, place.classes[name])
        for name in titles
        for place in book.places
        if name in place.classes
    ]
    fields: tuple[Field[tuple[str, str, ClassAgeing]], ...] = (
        (word("class"), lambda row: row[0]),
        (word("compared at", title="place"), lambda row: row[1]),
        (column("years"), lambda row: _short_cell(row[2].years)),
        (column("things"), lambda row: Cell(text=f"{row[2].n_from} to {row[2].n_to}", key=float(row[2].n_from))),
        (column("vanishes", title="vanishes (%/year)"), lambda row: _rate_cell(row[2].vanish_per_year)),
        (column("appears", title="appears (%/year)"), lambda row: _rate_cell(row[2].appear_per_year)),
        (column("re-drawn", title="re-drawn (%)"), lambda row: _short_cell(row[2].redrawn_share, per=100)),
        (column("moved", title="moved (m)"), lambda row: _short_cell(row[2].shift_median_m)),
    )
    note = "Of few things a rate says little. What appears is mostly mapping that catches up, not new building."
    return table_of("rates", "Yearly rates by class and place", found, fields, notes=[note])


def _rate_cell(rate: Estimate | None) -> Cell:
    if rate is None:
        return Cell(text="-")
    ends = [math.nan if end is None else 100 * end for end in (rate.lo, rate.hi)]
    return Cell(text=interval_text(100 * rate.best, *ends), key=rate.best)


def _short_cell(value: float | None, *, per: int = 1) -> Cell:
    return Cell(text="-") if value is None else Cell(text=f"{per * value:.1f}", key=per * value)


_RATES: Final = (0.05, 100.0)  # % a year; what lies beyond is drawn at the edge
_STEP: Final = 0.13  # between two places of a class


def draw_rates(path: Path, book: RateBook) -> None:
    """Draw into a .svg or .png what vanishes and what appears in a year, by class, a mark for each measured place."""
    titles = {item.name: item.title for item in load_taxonomy().classes}
    names = [name for name in titles if any(name in place.classes for place in book.places)]
    about = BoardPage(
        title=f"How fast maps grow old: {len(book.places)} places",
        note="Bars: 95 % intervals, from blocks of 1 km. Rates beyond the scale lie at its edge. What appears is "
        "mostly mapping that catches up. How many things each rate is of stands in the table.",
        below="per cent a year",
        columns=2,
        panel_inches=(3.1, 0.3 + 0.29 * len(names)),
        keys=line_keys(book.names),
    )
    with page(path, about) as charts:
        for chart, (column, title) in zip(
            charts[0],
            (("vanish_per_year", "vanishes, of the older map"), ("appear_per_year", "appears, of the newer map")),
            strict=True,
        ):
            for at, name in enumerate(names):
                for number, place in enumerate(book.places):
                    found = place.classes.get(name)
                    rate = None if found is None else getattr(found, column)
                    if rate is not None:
                        _draw_rate(chart, rate, at + _STEP * (number - (len(book.places) - 1) / 2), number)
            chart.set_title(title)
            chart.set_xscale("log")
            chart.set_xlim(_RATES[0] * 0.8, _RATES[1] * 1.2)
            chart.set_xticks([0.1, 1.0, 10.0, 100.0], ["0.1", "1", "10", "100"])
            chart.set_ylim(len(names) - 0.5, -0.5)
            chart.set_yticks(range(len(names)), [titles[name] for name in names])
            chart.tick_params(axis="y", length=0)
            chart.grid(visible=True, axis="x", color=FAINT, lw=0.6)
        charts[0][1].set_yticklabels([])


def _draw_rate(chart: Axes, rate: Estimate, at: float, number: int) -> None:
    look = look_of(number)
    if rate.lo is not None and rate.hi is not None:
        chart.hlines(at, _within(rate.lo), _within(rate.hi), color=look.colour, lw=0.9)
    chart.plot(_within(rate.best), at, marker=look.mark, ms=3.2, color=look.colour, ls="")


def _within(per_year: float) -> float:
    """Return a rate in per cent, clipped to the axis."""
    return float(np.clip(100 * per_year, *_RATES))
