# SPDX-License-Identifier: Apache-2.0
"""A board as a site: tables and cards -> the text of every page. All that comes from a board is shown as text."""

import math
import re
from collections import Counter
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass
from importlib import resources
from typing import Any, Final
from urllib.parse import urlencode

import pandas as pd
from jinja2 import Environment, PackageLoader

from sasgeo_bench.errors import counted
from sasgeo_bench.leaderboard.board_tables import (
    Book,
    Section,
    acceptance_tables,
    control_table,
    cost_table,
    rejection_tables,
    risk_tables,
    risk_tables_by_suite,
    scene_tables,
    sections_of,
    seed_table,
    summary,
)
from sasgeo_bench.leaderboard.cases import MEANINGS as FAILURE_MEANINGS
from sasgeo_bench.leaderboard.manifests import FailedCase
from sasgeo_bench.leaderboard.private_board import sealed_lines, seed_lines
from sasgeo_bench.leaderboard.tables import (
    MARKS,
    MEANINGS,
    NOTE,
    RANKS_NOTE,
    Bar,
    Record,
    Table,
    column,
    file_stem,
    interval_text,
    number_text,
    p_text,
    suite_card,
)
from sasgeo_bench.leaderboard.text import control_lines, map_lines, segmenter_lines, training_lines, warnings_of
from sasgeo_bench.osm.taxonomy import load_taxonomy
from sasgeo_bench.publishing.elsewhere import elsewhere_tables
from sasgeo_bench.publishing.site_pages import OUTCOMES as ANSWER_OUTCOMES
from sasgeo_bench.publishing.site_pages import (
    figures_by_kind,
    matchers_of,
    place_maps,
    protection_tables,
    rate_table,
    region_table,
    suites_of,
)
from sasgeo_bench.publishing.site_source import SiteSource
from sasgeo_bench.scoring.compare import LOWER
from sasgeo_bench.scoring.contrasts import Contrast
from sasgeo_bench.scoring.controls import Verdict
from sasgeo_bench.tasks.query import SEQUENCE, base_of
from sasgeo_bench.texts import plain

_OF_SHARES: Final = frozenset({"primary", "interaction", "shift"})  # metrics whose meaning is a name that all know
_TOLD: Final = frozenset({"decided", "cause open", "decided, small"})  # in which one is better
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
    records = [{str(name): value for name, value in row.items()} for row in source.board.contrasts.to_dict("records")]
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
        because="" if outcome in _TOLD else verdict.partition(": ")[2] or verdict,
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
    if outcome in _TOLD:
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


ASSETS: Final = ("site.css", "site.js")
MAP_ASSETS: Final = ("leaflet.css", "leaflet.js")  # as they came, with their licence
FAILURES: Final = (  # in the order they are shown; others follow
    *("aliased", "aged", "occluded", "absent accepted", "right but not accepted"),
    *("one of several", "also without the stress"),
)
_NAMES: Final = {  # pages that every site has or may have, in the order of the navigation
    "index.html": "Board",
    "kinds-of-place.html": "Kinds of place",
    "suites.html": "Suites",
    "matchers.html": "Matchers",
    "rejection.html": "Rejection",
    "figures.html": "Figures",
    "map.html": "Map",
    "failures.html": "Failures",
    "regions.html": "Regions",
    "ageing.html": "Ageing",
    "method.html": "Method",
}
_BLANK_LINES: Final = re.compile(r"\n\s*\n+")
_FIRM: Final = "\N{NO-BREAK SPACE}"  # within an interval no line ends
_INTERVAL: Final = re.compile(r"\[(-?[\d.]+), (-?[\d.]+)\]")
_INDENTS: Final = re.compile(r"^[ \t]+", re.MULTILINE)


@dataclass(frozen=True, slots=True, kw_only=True)
class Group:
    """Failures of one class."""

    title: str
    stem: str
    cases: tuple[tuple[int, FailedCase], ...]


def site_pages(source: SiteSource) -> dict[str, str]:
    """Return all pages of a site with its style and script, by file name.

    Pages refer to other hosts only by links, and each can be read without the script.
    """
    templates = environment()
    about = source.board.about
    book = Book.of(source.board.leaderboard, about.entries, source.board.scores, metrics=about.metrics)
    maps, regions = place_maps(source), region_table(source)
    scenes = tuple(scene_tables(source.scenes, book)) if len(source.scenes) else ()
    rejection = rejection_tables(source.board.leaderboard)
    protection = protection_tables(source.board.protection)
    acceptance = acceptance_tables(source.board.acceptance)
    optional = {
        "kinds-of-place.html": scenes,
        "rejection.html": rejection or protection,
        "figures.html": source.figures,
        "map.html": maps,
        "failures.html": source.pictures.cases,
    }
    there = [name for name in _NAMES if optional.get(name, True)]
    suites, matchers, sections = suites_of(source, book), matchers_of(source, book), sections_of(book)
    kinds = figures_by_kind(source.figures)
    common: dict[str, Any] = {
        "source": source,
        "about": about,
        "book": book,
        "there": there,
        "navigation": [(name, _NAMES[name]) for name in there],
        "note": NOTE.format(draws=source.board.about.draws or "?"),
    }
    special = {
        "index.html": _index(source, book, sections),
        "kinds-of-place.html": {"tables": scenes},
        "suites.html": {"suites": suites},
        "matchers.html": {"matchers": matchers, "costs": cost_table(book)},
        "rejection.html": {
            "risks": (*risk_tables(source.board.leaderboard), *risk_tables_by_suite(source.board.leaderboard)),
            "tables": rejection,
            "acceptance": acceptance,
            "protection": protection,
            "kinds": kinds,
            "filters": _filters((*rejection, *acceptance, *protection), "matcher", "rejector"),
        },
        "figures.html": {"kinds": kinds},
        "map.html": {"places": list(maps), "outcomes": ANSWER_OUTCOMES, "classes": load_taxonomy().classes},
        "failures.html": _failures(source, {place.region for place in maps}),
        "regions.html": {"table": regions},
        "ageing.html": {"table": rate_table(source.rates), "kinds": kinds},
        "method.html": {
            "controls": control_table(source.board.verdicts),
            "learned": [*training_lines(source.board.about), *segmenter_lines(source.board.about)],
            "meanings": MEANINGS
            | {one.name: one.to_text() for one in about.metrics}
            | {one.term: one.meaning for one in regions.columns}
            | MARKS,
        },
    }
    pages = {name: _render(templates, name, name, common | special[name]) for name in there}
    for suite in suites:
        pages[suite.page] = _render(templates, "suite.html", suite.page, common | {"suite": suite})
    for matcher in matchers:
        pages[matcher.page] = _render(templates, "matcher.html", matcher.page, common | {"matcher": matcher})
    pages |= {name: templates.get_template(name).render() for name in ASSETS}
    return pages | _map_files(templates, {place.file: script for place, script in maps.items()})


def _map_files(templates: Environment, scripts: Mapping[str, str]) -> dict[str, str]:
    """Return what the page with the map loads; nothing for a board without one."""
    if not scripts:
        return {}
    vendor = resources.files("sasgeo_bench.publishing").joinpath("vendor")
    kept = {name: vendor.joinpath(name).read_text(encoding="utf-8") for name in (*MAP_ASSETS, "LICENSE-leaflet")}
    return {"map.js": templates.get_template("map.js").render(), **kept, **scripts}


def _index(source: SiteSource, book: Book, sections: Sequence[Section]) -> dict[str, Any]:
    """Return what the first page shows."""
    controls = source.board.verdicts
    overview = tuple(table for table in summary(book) if _has_rivals(table))
    contrasts = contrasts_of(source)
    prices = {table.name.replace("summary", "price", 1) for table in overview}
    return {
        "sections": sections,
        "elsewhere": elsewhere_tables(source.board.about.elsewhere),
        "words_of": {item.prior_group: item.prior for item in sections},
        "overview": overview,
        "prices": tuple(item for item in source.figures if item.file.removesuffix(".svg") in prices),
        "ranks_note": RANKS_NOTE,
        "contrasts": contrasts,
        "found": _found_text(contrasts),
        "made_of": _made_of(book),
        "control_lines": control_lines(controls),
        "controls_state": _controls_state(controls),
        "has_controls": bool(controls),
        "seed_line": seed_lines(source.board.about)[0],
        "sealed_lines": sealed_lines(source.board.about.sealed),
        "seeds": seed_table(source.board.about.entries),
        "warnings": [*map_lines(source.board.about), *warnings_of(source.board.leaderboard)],
        "meanings": {one.name: one.meaning for item in sections for one in item.table.columns} | MARKS,
        "size": _size_text(source, book),
    }


def _made_of(book: Book) -> str:
    """Return what the views of a board are made of, as far as this version knows its suites."""
    cards = [suite_card(suite) for suite in book.suite_pages]
    if None in cards:
        return ""
    if any("imagery" in card.needs for card in cards if card is not None):
        return "Views are real aerial pictures, or made from maps: each suite says which."
    return (
        "Views are made from OpenStreetMap, with errors as a detector of classes makes them; what pictures there are, "
        "are rendered. None is a photograph."
    )


def _found_text(contrasts: Sequence[ContrastSummary]) -> str:
    """Return in one line how many registered differences came out how, and which entries are shown to be better."""
    counts = Counter(item.outcome for item in contrasts)
    said = ", ".join(f"{count} {outcome}" for outcome, count in counts.items())
    told = [f"{item.headline} ({item.name})" for item in contrasts if item.outcome in _TOLD]
    better = f" Shown: {'; '.join(told)}." if told else " Nobody is shown to be better than another."
    return f"Of {counted(len(contrasts), 'difference')} registered before anything was run: {said}.{better}"


def _failures(source: SiteSource, mapped: Collection[str]) -> dict[str, Any]:
    """Return what the page of failures shows; `mapped` are the places with a map of their queries."""
    groups = groups_of(source.pictures.cases)
    numbered = {number: case for group in groups for number, case in group.cases}
    return {
        "groups": groups,
        "total": len(numbered),
        "meanings_of": FAILURE_MEANINGS,
        "links": {number: _on_map(case) for number, case in numbered.items() if base_of(case.region) in mapped},
        "filters": [
            ("Matcher", "matcher", sorted({case.matcher for case in numbered.values()}), {}),
            ("Suite", "suite", sorted({case.suite for case in numbered.values()}), {}),
            ("Class", "class", [group.title for group in groups], {}),
        ],
    }


def _on_map(case: FailedCase) -> str:
    """Return the address of a case on the map of its place."""
    asked = {"place": base_of(case.region), "matcher": case.matcher, "suite": case.suite, "outcome": "failures"}
    return f"map.html?{urlencode(asked | {'query': case.query_id})}"


def _filters(tables: Sequence[Table], *terms: str) -> list[tuple[str, str, list[str], dict[str, str]]]:
    """Return choices of the values of some columns of text, by name."""
    found: dict[str, dict[str, None]] = {term: {} for term in terms}
    for table in tables:
        for at, one in enumerate(table.columns):
            found.get(one.term, {}).update(dict.fromkeys(row.cells[at].text for row in table.rows))
    return [(term.capitalize(), term, sorted(values), {}) for term, values in found.items() if values]


def _has_rivals(table: Table) -> bool:
    return sum(row.tone != "control" for row in table.rows) > 1


def environment() -> Environment:
    """Return what fills in the templates: everything is escaped, and what would not be seen is removed."""
    return Environment(
        loader=PackageLoader("sasgeo_bench.publishing"),
        autoescape=True,
        finalize=_shown,
        trim_blocks=True,
        lstrip_blocks=True,
    )


def _shown(value: object) -> object:
    """Remove characters that a browser would not show or that reverse the direction of text."""
    if not isinstance(value, str) or hasattr(value, "__html__"):
        return value
    return _INTERVAL.sub(rf"[\1,{_FIRM}\2]", plain(value))


def _render(templates: Environment, template: str, page: str, values: Mapping[str, Any]) -> str:
    text = templates.get_template(template).render(**values, page=page)
    return _BLANK_LINES.sub("\n", _INDENTS.sub("", text)) + "\n"


def _controls_state(verdicts: Sequence[Verdict]) -> str:
    """Return the class of the page's box: what failed is the board, or rows of some entries alone."""
    failed = [item for item in verdicts if not item.holds]
    if any(item.is_of_board for item in failed):
        return "failed"
    return "held" if verdicts and not failed else "doubtful"


def _size_text(source: SiteSource, book: Book) -> str:
    """Count matchers, suites, queries and flights, blocks and places of the board."""
    board, scores = source.board.leaderboard, source.board.scores
    asked = scores.drop_duplicates("query_id")["track"] if "query_id" in scores else pd.Series(dtype=object)
    flights = int((asked == SEQUENCE).sum())
    blocks, places = (int(board[name].max()) if len(board) else 0 for name in ("blocks", "places"))
    parts = [
        counted(len(book.matcher_pages), "matcher or control", "matchers and controls"),
        counted(len(book.suite_pages), "suite"),
        *([counted(len(asked) - flights, "query", "queries")] if flights < len(asked) or not flights else []),
        *([counted(flights, "flight")] if flights else []),
    ]
    return f"{', '.join(parts)} in {counted(blocks, 'block')} of {counted(places, 'place')}."


def groups_of(cases: Sequence[FailedCase]) -> tuple[Group, ...]:
    """Return failures by class, numbered through from 1."""
    counts = Counter(case.failure for case in cases)
    names = [name for name in FAILURES if name in counts]
    names += sorted(set(counts) - set(names))
    groups, number = [], 0
    for at, name in enumerate(names):
        own = [case for case in cases if case.failure == name]
        listed = tuple((number + more, case) for more, case in enumerate(own, start=1))
        groups.append(Group(title=name, stem=f"{file_stem('class', name)}-{at}", cases=listed))
        number += len(own)
    return tuple(groups)
