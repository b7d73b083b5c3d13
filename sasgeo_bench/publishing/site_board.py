# SPDX-License-Identifier: Apache-2.0
"""The board as a site shows it: which differences are real, whether the controls held, tables with ties."""

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Final, Self

import pandas as pd

from sasgeo_bench.errors import counted
from sasgeo_bench.leaderboard.reproduction import SEEDS_NOTE, seed_table
from sasgeo_bench.leaderboard.text import interval_text, number_text, tally_text
from sasgeo_bench.publishing.site_source import SiteSource
from sasgeo_bench.publishing.site_table import (
    Bar,
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
    page_names,
    plain_cell,
    rank_cell,
    ties_of,
)
from sasgeo_bench.publishing.site_words import column, marks_of, prior_words
from sasgeo_bench.scoring.contrasts import LESS_THAN_MATTERS, Contrast, chosen_rows
from sasgeo_bench.scoring.metrics import CHANCE, FALSE_ABSENT, WITHIN, primary_of
from sasgeo_bench.scoring.rows import ALL_SUITES, is_unranked, name_alone
from sasgeo_bench.scoring.strata import ALL, CONTROL, STRESS

OUTCOMES: Final = ("decided", "cause open", "decided, small", "null", "not decided")  # in the order of the page
_LEAST_P: Final = 5e-4  # less would read as nought
_SOUND: Final = ("ok", "not applicable")  # all else is a miss
_PRIOR_ALONE: Final = "prior_centre"
_GROUP: Final = ("suite", "track", "prior_group")


@dataclass(frozen=True, kw_only=True)
class Book:
    """Figures of a board that take every answer, by whose they are and of which queries; and the pages there are.

    `counted` are the kinds of stress that the first figure of a table counts, `lost` who gave no sound answer, and how
    often; both empty where no scored queries are stored with the board.
    """

    figures: Mapping[tuple[str, ...], Record]
    matchers: Mapping[Key, tuple[str, ...]]
    strata: Mapping[Key, tuple[str, ...]]
    entries: Mapping[str, Mapping[str, Any]]
    matcher_pages: Mapping[str, str]
    suite_pages: Mapping[str, str]
    counted: Mapping[Key, tuple[str, ...]]
    lost: Mapping[Key, str]

    @classmethod
    def of(cls, source: SiteSource) -> Self:
        """Of a site's tables."""
        entries = {str(entry["name"]): entry for entry in source.about.get("entries", ())}
        plain = source.board[source.board["rejector"] == ""] if len(source.board) else source.board
        figures: dict[tuple[str, ...], Record] = {}
        matchers: dict[Key, dict[str, None]] = {}
        strata: dict[Key, dict[str, None]] = {}
        for row in plain.to_dict("records"):
            suite, track, prior = (str(row[name]) for name in _GROUP)
            name, stratum = str(row["matcher"]), str(row["stratum"])
            figures[suite, track, prior, name, stratum, str(row["metric"])] = {str(key): row[key] for key in row}
            if suite != ALL_SUITES:
                matchers.setdefault((suite, track, prior), {})[name] = None
                strata.setdefault((suite, track, prior), {})[stratum] = None
        names = [*entries, *(name for found in matchers.values() for name in found)]
        return cls(
            figures=figures,
            matchers={key: tuple(matchers[key]) for key in sorted(matchers)},
            strata={key: tuple(found) for key, found in strata.items()},
            entries=entries,
            matcher_pages=page_names("matcher", names),
            suite_pages=page_names("suite", [suite for suite, _, _ in sorted(matchers)]),
            counted={key: _counted(rows) for key, rows in _by_group(source.scores)},
            lost={key: _lost(rows) for key, rows in _by_group(source.scores)},
        )

    def pick(self, key: Key, matcher: str, metric: str, stratum: str = ALL) -> Record | None:
        """One figure; None where the board has it not."""
        return self.figures.get((*key, matcher, stratum, metric))

    def main(self, key: Key, matcher: str, metric: str) -> Record | None:
        """The figure under stress, or of all queries where there is no stress."""
        return self.pick(key, matcher, metric, STRESS) or self.pick(key, matcher, metric)

    def name_cell(self, matcher: str) -> Cell:
        """Name of a matcher with its marks; it leads to its page."""
        entry = self.entries.get(matcher, {})
        marks = marks_of(entry, is_control=is_unranked(matcher))
        return Cell(text=matcher, href=self.matcher_pages.get(matcher, ""), marks=marks)

    def suite_cell(self, suite: str) -> Cell:
        """Name of a suite; it leads to its page."""
        return Cell(text=suite, href=self.suite_pages.get(suite, ""))

    def is_apart(self, matcher: str) -> bool:
        """Whether the board sets a contestant apart."""
        return bool(self.entries.get(matcher, {}).get("set_apart"))


def _by_group(scores: pd.DataFrame) -> Iterator[tuple[Key, pd.DataFrame]]:
    if len(scores):
        for (suite, track, prior), rows in scores.groupby(list(_GROUP), sort=True):
            yield (str(suite), str(track), str(prior)), rows


def _counted(rows: pd.DataFrame) -> tuple[str, ...]:
    """Kinds of stress with the place on the map: of these is the first figure, where there is any."""
    kinds = rows.loc[(rows["role"] == STRESS) & rows["is_present"].astype(bool), "kind"]
    return tuple(sorted(map(str, kinds.unique())))


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
    table: Table
    apart: Table | None = None


def sections_of(book: Book) -> tuple[Section, ...]:
    """Tables of the board; prior groups are never mixed in one."""
    return tuple(_section(book, key) for key in book.matchers)


def _section(book: Book, key: Key) -> Section:
    suite, track, prior_group = key
    names = book.matchers[key]
    apart = [name for name in names if book.is_apart(name)]
    table = group_table(book, key, [name for name in names if name not in apart])
    unasked = [name for name in book.entries if name not in names]
    lost = book.lost.get(key, "")
    lines = [*table.notes, *([f"Without a sound answer, which is a miss: {lost}."] if lost else [])]
    lines += [f"Not on this table, for not asked here: {', '.join(unasked)}."] if unasked else []
    return Section(
        suite=suite,
        track=track,
        prior_group=prior_group,
        prior=prior_words(prior_group),
        suite_page=book.suite_pages[suite],
        counted=", ".join(book.counted.get(key, ())),
        for_nothing=_for_nothing(book, key),
        table=replace(table, notes=tuple(lines)),
        apart=_apart(book, key, apart) if apart else None,
    )


def _apart(book: Book, key: Key, names: Sequence[str]) -> Table:
    table = group_table(book, key, names)
    reasons = tuple(f"{name}: {book.entries[name]['set_apart']}." for name in names)
    title = "Set apart: not to be compared with those above"
    return replace(table, name=f"{table.name}-apart", title=title, notes=reasons)


def group_table(book: Book, key: Key, names: Sequence[str]) -> Table:
    """One table of the board: a matcher a line, the best first, ties marked.

    Parameters
    ----------
    book : Book
        All figures.
    key : (str, str, str)
        Suite, track and prior group.
    names : sequence of str
        Matchers to show; one without a figure is left out.
    """
    suite, track, prior_group = key
    primary = primary_of(track).name
    found = {name: row for name in names if (row := book.main(key, name, primary)) is not None}
    order = sorted(found, key=lambda name: (-_value(found[name]), name))
    ties = ties_of(list(found.values()))
    ranked = sum(not pd.isna(row["rank_best"]) for row in found.values())
    rows = tuple(_row(book, key, found[name], _tie_of(ties, name), ranked) for name in order)
    titles = (primary, "rank", "within_25m", "control", "false fixes", "detectable", "n", "missing", "blocks")
    table = Table(
        name=file_stem("board", suite, track, prior_group),
        title=f"{suite}: {track}, {prior_words(prior_group)}",
        columns=(
            column("matcher", is_number=False),
            *(column(name, order="descending" if name == primary else "none") for name in titles),
        ),
        rows=rows,
        notes=_notes(ties, found, ranked),
    )
    return table.without_empty(WITHIN.name, "false fixes", "control", "detectable", "missing")


def _value(row: Record) -> float:
    value = float(row["value"])
    return -math.inf if math.isnan(value) else value


def _tie_of(ties: Sequence[Tie], name: str) -> int | None:
    """Number of the tie that a matcher is in."""
    return next((number for number, tie in enumerate(ties) if name in tie.names), None)


def _row(book: Book, key: Key, main: Record, tie: int | None, ranked: int) -> Row:
    name, stratum = str(main["matcher"]), str(main["stratum"])
    primary = str(main["metric"])
    mark = None if tie is None else Mark(text="tie", meaning="shares ranks with others, named below the table")
    tone = "control" if is_unranked(name) else "plain" if tie is None else ("tied" if tie % 2 == 0 else "other-tie")
    places = counted(int(main["places"]), "place")
    return Row(
        cells=(
            book.name_cell(name),
            figure_cell(main, has_bar=True),
            rank_cell(main, ranked=ranked, mark=mark),
            figure_cell(book.pick(key, name, WITHIN.name, stratum)),
            figure_cell(book.pick(key, name, primary, CONTROL)),
            figure_cell(book.pick(key, name, FALSE_ABSENT.name)),
            number_cell(float(main["detectable"])),
            plain_cell(int(main["n"])),
            plain_cell(int(main["missing"])) if main["missing"] else Cell(text="-", key=0.0),
            Cell(text=f"{main['blocks']} in {places}", key=float(main["blocks"])),
        ),
        tone=tone,
    )


def _notes(ties: Sequence[Tie], found: Mapping[str, Record], ranked: int) -> tuple[str, ...]:
    if not found:
        return ("Nobody has a figure here.",)
    if ranked:
        lines = [f"Tied: {tie.to_text()}." for tie in ties]
        return tuple(lines or (["No two share a rank."] if ranked > 1 else ["One alone is ranked."]))
    rivals = [name for name in found if not is_unranked(name)]
    if not rivals:
        return ("Only controls answered.",)
    return ("Nobody is ranked here: the order is that of the figure, and decides nothing.",)


def _for_nothing(book: Book, key: Key) -> str:
    """What the prior alone and guessing are worth."""
    _, track, _ = key
    primary = primary_of(track).name
    alone = next((name for name in book.matchers[key] if name_alone(name) == _PRIOR_ALONE), None)
    told = {
        "the prior alone": None if alone is None else book.main(key, alone, primary),
        "chance": book.main(key, book.matchers[key][0], CHANCE.name),
    }
    words = [f"{name} {number_text(row['value'])} (n = {row['n']})" for name, row in told.items() if row is not None]
    return ", ".join(words)


@dataclass(frozen=True, slots=True, kw_only=True)
class Told:
    """A registered contrast in plain words.

    `outcome` is one of `OUTCOMES`; the cause of a gain is open where the falsifiers of the contrast gain, too.
    `unstressed` says how both fare where they should not differ, empty where nobody looked; `bar` spans from -`reach`
    to `reach`, with `least` of it on both sides of the middle too small to matter, in per cent.
    """

    name: str
    outcome: str
    headline: str
    sentence: str
    facts: tuple[str, ...]
    unstressed: str
    why: str
    figure: str
    bar: Bar | None
    least: float
    reach: float


def contrasts_of(source: SiteSource) -> tuple[Told, ...]:
    """Registered contrasts, what is decided first."""
    records = [{str(name): value for name, value in row.items()} for row in source.contrasts.to_dict("records")]
    ends = [abs(float(row[name])) for row in records for name in ("lo", "hi", "difference")]
    reach = max((end for end in ends if math.isfinite(end)), default=1.0) or 1.0
    told = [_told(row, source, reach) for row in records]
    return tuple(sorted(told, key=lambda item: OUTCOMES.index(item.outcome)))


def _told(row: Record, source: SiteSource, reach: float) -> Told:
    verdict, name = str(row["verdict"]), str(row["name"])
    falsifier = _falsifier_of(source.falsifiers, name)
    outcome = _outcome(row, falsifier)
    contrast = next((item for item in source.registered if item.name == name), None)
    figure = next((item.file for item in source.figures if item.file == f"{file_stem('contrast', name)}.svg"), "")
    known = [float(row[end]) for end in ("lo", "hi", "difference")]
    least = float(row["min_effect"]) * (1.0 if row["metric"] == "primary" else abs(float(row["second_value"])))
    bar = None
    if all(map(math.isfinite, known)):
        lo, hi, at = (round(50 + 50 * value / reach, 1) for value in known)
        bar = Bar(lo=lo, hi=hi, at=at)
    return Told(
        name=name,
        outcome=outcome,
        headline=_headline(row, verdict, outcome),
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
    if outcome not in {"null", "not decided"}:
        better, worse = (first, second) if verdict.startswith(f"{first} is better") else (second, first)
        return f"{better} is better than {worse}" + verdict.partition(" is better")[2]
    return f"{first} against {second}: {verdict.partition(': ')[2] or verdict}"


def _sentence(row: Record, least: float) -> str:
    """What was seen, with its interval, in words that say which way is good."""
    if not int(row["n"]):
        return "No query of this board counts for it."
    difference = interval_text(*(float(row[name]) for name in ("difference", "lo", "hi")))
    values = f"{number_text(float(row['first_value']))} against {number_text(float(row['second_value']))}"
    what = "share of queries that are right" if row["metric"] == "primary" else "area under risk (lower is better)"
    return f"Difference {difference} in the {what}: {values}. A difference from {number_text(least)} on was to matter."


def _falsifier_of(falsifiers: pd.DataFrame, contrast: str) -> Record | None:
    """How both sides fare without the stress, all suites together: the first row of a contrast."""
    mine = falsifiers[falsifiers["contrast"] == contrast] if len(falsifiers) else falsifiers
    return None if mine.empty else {str(name): value for name, value in mine.iloc[0].items()}


def _outcome(row: Record, falsifier: Record | None) -> str:
    verdict = str(row["verdict"])
    if verdict.startswith(("not decided", "not tested")):
        return "not decided"
    if verdict.startswith("null"):
        return "null"
    if verdict.endswith(LESS_THAN_MATTERS):
        return "decided, small"
    is_gained = falsifier is not None and falsifier["lo"] > 0 and verdict.startswith(f"{row['first']} is better")
    return "cause open" if is_gained else "decided"


def _unstressed(row: Record) -> str:
    difference = interval_text(*(float(row[name]) for name in ("difference", "lo", "hi")))
    gained = " What it gains there is not owed to what the contrast is named for." if row["lo"] > 0 else ""
    return (
        f"Without the stress, where they should not differ: {difference}, {row['verdict'].lower()} "
        f"(n = {row['n']}, {counted(int(row['blocks']), 'block')}).{gained}"
    )


def _contrast_facts(row: Record, source: SiteSource, contrast: Contrast | None) -> Iterator[str]:
    p = float(row["p_holm"])
    if not math.isnan(p):
        shown = "below 0.001" if p < _LEAST_P else number_text(p)
        yield f"adjusted p {shown} (Holm, {counted(len(source.contrasts), 'contrast')})"
    yield f"n = {counted(int(row['n']), 'query', 'queries')}"
    yield counted(int(row["blocks"]), "block")
    places = 0 if contrast is None else places_of(contrast, source.scores, int(row["n"]))
    if places:
        yield counted(places, "place")
    if row["metric"] == "primary":
        yield f"right by the first alone {row['first_only']}, by the second alone {row['second_only']}"
    detectable = float(row["detectable"])
    if not math.isnan(detectable):
        yield f"least difference these queries would show {number_text(detectable)}"
    if contrast is not None:
        yield f"suites {', '.join(contrast.suites)}"


def places_of(contrast: Contrast, scores: pd.DataFrame, n: int) -> int:
    """How many places the queries of a contrast are from; 0 where the scored rows are not those that were tested."""
    if not len(scores) or "matcher" not in scores:
        return 0
    whose = [side.partition(" x ")[0] for side in (contrast.first, contrast.second)]
    rows = [chosen_rows(contrast, scores[scores["matcher"] == name]) for name in whose]
    shared = rows[0][rows[0]["query_id"].isin(rows[1]["query_id"])]
    return int(shared["place"].nunique()) if len(shared) == n else 0


def seeds_of(about: Mapping[str, Any]) -> Table | None:
    """Figures on the public and on a private seed; None where no row was held against a private one."""
    found = seed_table(about).rename(columns={"verdict": "shown"})
    if not len(found):
        return None
    texts = {"matcher", "suite", "track", "figure", "shown"}
    return Table(
        name="seeds",
        title="Public and private seed",
        columns=tuple(column(str(name), is_number=name not in texts) for name in found.columns),
        rows=tuple(Row(cells=tuple(Cell(text=str(value)) for value in row)) for row in found.itertuples(index=False)),
        notes=(SEEDS_NOTE,),
    )


def control_table(controls: pd.DataFrame) -> Table | None:
    """Every control of every matcher; None where none was drawn."""
    if not len(controls):
        return None
    rows = []
    for row in controls.to_dict("records"):
        word = "held" if row["holds"] else "FAILED"
        cells = (
            Cell(text=str(row["control"])),
            Cell(text=str(row["matcher"])),
            plain_cell(int(row["n"])),
            Cell(text=tally_text(float(row["found"])), key=float(row["found"])),
            Cell(text=tally_text(float(row["expected"])), key=float(row["expected"])),
            number_cell(float(row["p"])),
            Cell(text=word),
        )
        rows.append(Row(cells=cells))
    columns = (
        column("verdict", is_number=False, title="control"),
        column("matcher", is_number=False),
        *(column(name) for name in ("n", "found", "expected", "p")),
        column("verdict", is_number=False),
    )
    return Table(name="controls", title="Controls, one by one", columns=columns, rows=tuple(rows))
