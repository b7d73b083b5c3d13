# SPDX-License-Identifier: Apache-2.0
"""A board as a site: tables and cards -> the text of every page. All that comes from a board is shown as text."""

import re
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from importlib import resources
from typing import Final, NamedTuple
from urllib.parse import urlencode

import pandas as pd
from jinja2 import Environment, PackageLoader

from sasgeo_bench.boards.board_tables import Book, sections_of
from sasgeo_bench.boards.elsewhere import elsewhere_tables
from sasgeo_bench.boards.manifests import FailedCase
from sasgeo_bench.boards.overview import FEW_RULE, overviews_of
from sasgeo_bench.boards.site_files import SiteFigure, SiteSource
from sasgeo_bench.boards.site_maps import OUTCOMES, PlaceMap, place_maps, rate_table, region_table
from sasgeo_bench.boards.site_pages import OUTCOMES as CONTRAST_OUTCOMES
from sasgeo_bench.boards.site_pages import (
    MatcherPage,
    SuitePage,
    contrasts_of,
    figures_by_kind,
    matchers_of,
    suites_of,
)
from sasgeo_bench.boards.tables import MARKS, MEANINGS, NOTE, RANKS_NOTE, Table, file_stem, suite_card
from sasgeo_bench.boards.text import (
    Contents,
    control_lines,
    map_lines,
    sandbox_lines,
    sealed_lines,
    seed_lines,
    segmenter_lines,
    tables_of,
    training_lines,
    warnings_of,
)
from sasgeo_bench.core.errors import counted
from sasgeo_bench.core.texts import plain
from sasgeo_bench.osm.taxonomy import load_taxonomy
from sasgeo_bench.tasks.query import SEQUENCE, base_of

ASSETS: Final = ("site.css", "site.js")
MAP_ASSETS: Final = ("leaflet.css", "leaflet.js", "LICENSE-leaflet")  # as they came
FAILURES: Final = (  # in the order they are shown; others follow
    *("aliased", "aged", "occluded", "absent accepted", "right but not accepted"),
    *("one of several", "also without the stress"),
)
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


@dataclass(frozen=True, kw_only=True)
class Site:
    """A board as its pages show it: `tables` by page and kind, `kinds` of figures, `maps` with their scripts."""

    source: SiteSource
    book: Book
    tables: Mapping[str, Mapping[str, tuple[Table, ...]]]
    kinds: Mapping[str, Sequence[SiteFigure]]
    maps: Mapping[PlaceMap, str]
    suites: tuple[SuitePage, ...]
    matchers: tuple[MatcherPage, ...]


class Page(NamedTuple):
    """A page of every site, or of one that has something for it; what else its template shows than tables."""

    file: str
    name: str
    more: Callable[[Site], Mapping[str, object]] = lambda _: {}
    is_there: Callable[[Site], object] = lambda _: True


def site_pages(source: SiteSource) -> dict[str, str]:
    """Return all pages of a site with its style and script, by file name.

    Pages refer to other hosts only by links, and each can be read without the script.
    """
    board = source.board
    contents = Contents(
        leaderboard=board.leaderboard,
        entries=board.about.entries,
        scores=board.scores,
        verdicts=board.verdicts,
        acceptance=board.acceptance,
        protection=board.protection,
        scenes=source.scenes,
        metrics=board.about.metrics,
        within=board.about.within,
        require=board.about.require,
        added=board.about.added,
        requirements=board.requirements,
    )
    site = Site(
        source=source,
        book=contents.book,
        tables={page.file: tables_of(contents, page.file) for page in PAGES},
        kinds=figures_by_kind(source.figures),
        maps=place_maps(source),
        suites=suites_of(source, contents.book),
        matchers=matchers_of(source, contents.book),
    )
    there = [page for page in PAGES if page.is_there(site)]
    templates = environment()
    templates.globals.update(
        site=site,
        source=source,
        about=board.about,
        further_sources=board.about.further_sources,
        book=site.book,
        there={page.file: page.name for page in there},
        note=NOTE.format(draws=board.about.draws or "?"),
    )
    shown = {page.file: (page.file, {"tables": site.tables[page.file], **page.more(site)}) for page in there}
    shown |= {suite.page: ("suite.html", {"suite": suite}) for suite in site.suites}
    shown |= {matcher.page: ("matcher.html", {"matcher": matcher}) for matcher in site.matchers}
    pages = {}
    for name, (template, values) in shown.items():
        text = templates.get_template(template).render(values, page=name)
        pages[name] = _BLANK_LINES.sub("\n", _INDENTS.sub("", text)) + "\n"
    pages |= {name: templates.get_template(name).render() for name in ASSETS}
    if site.maps:
        vendor = resources.files("sasgeo_bench.boards").joinpath("vendor")
        pages |= {name: vendor.joinpath(name).read_text(encoding="utf-8") for name in MAP_ASSETS}
        pages |= {"map.js": templates.get_template("map.js").render()}
    return pages | {place.file: script for place, script in site.maps.items()}


def _index(site: Site) -> dict[str, object]:
    """Return what the first page shows."""
    source, book, about, controls = site.source, site.book, site.source.board.about, site.source.board.verdicts
    sections, contrasts = sections_of(book), contrasts_of(source)
    failed = [item for item in controls if not item.holds]  # the board, or rows of some entries alone
    is_board = any(item.is_of_board for item in failed)
    found = Counter(item.outcome for item in contrasts)
    counts = {outcome: found[outcome] for outcome in CONTRAST_OUTCOMES}
    return {
        "sections": sections,
        "elsewhere": elsewhere_tables(about.elsewhere),
        "words_of": {item.prior_group: item.prior for item in sections},
        "overviews": overviews_of(book),
        "few_rule": FEW_RULE,
        "leaderboard": source.board.leaderboard,
        "acceptance": source.board.acceptance,
        "ranks_note": RANKS_NOTE,
        "contrasts": contrasts,
        "outcomes": {outcome: count for outcome, count in counts.items() if count},
        "outcome_meanings": CONTRAST_OUTCOMES,
        "made_of": _made_of(book),
        "control_lines": control_lines(controls),
        "controls_state": "failed" if is_board else "held" if controls and not failed else "doubtful",
        "has_controls": bool(controls),
        "seed_line": seed_lines(about)[0],
        "sealed_lines": sealed_lines(about.sealed),
        "warnings": [
            *(f"With a metric of another package: {one.name} ({one.code})." for one in about.metrics),
            *map_lines(about),
            *sandbox_lines(about),
            *warnings_of(source.board.leaderboard),
        ],
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


def _failures(site: Site) -> dict[str, object]:
    """Return what the page of failures shows; those of a place with a map lead there."""
    mapped = {place.region for place in site.maps}

    def _on_map(case: FailedCase) -> str:
        asked = {"place": base_of(case.region), "matcher": case.matcher, "suite": case.suite, "outcome": "failures"}
        return f"map.html?{urlencode(asked | {'query': case.query_id})}"

    groups = groups_of(site.source.pictures.cases)
    numbered = {number: case for group in groups for number, case in group.cases}
    return {
        "groups": groups,
        "total": len(numbered),
        "meanings_of": OUTCOMES,
        "links": {number: _on_map(case) for number, case in numbered.items() if base_of(case.region) in mapped},
        "filters": [
            ("Matcher", "matcher", sorted({case.matcher for case in numbered.values()}), {}),
            ("Suite", "suite", sorted({case.suite for case in numbered.values()}), {}),
            ("Class", "class", [group.title for group in groups], {}),
        ],
    }


def _rejection(site: Site) -> dict[str, object]:
    """Return choices of the matchers and rejectors of the tables of rejection, by name."""
    tables = site.tables["rejection.html"]
    found: dict[str, set[str]] = {"matcher": set(), "rejector": set()}
    for table in (*tables["rejection"], *tables["acceptance"], *tables["protection"]):
        for at, one in enumerate(table.columns):
            if one.term in found:
                found[one.term].update(row.cells[at].text for row in table.rows)
    return {"filters": [(term.capitalize(), term, sorted(values), {}) for term, values in found.items() if values]}


def _method(site: Site) -> dict[str, object]:
    about = site.source.board.about
    of_others = {one.name: one.to_text() for one in about.metrics}
    of_regions = {one.term: one.meaning for one in region_table(site.source).columns}
    return {
        "learned": [*training_lines(about), *segmenter_lines(about)],
        "meanings": MEANINGS | of_others | of_regions | MARKS,
    }


PAGES: Final = (  # in the order of the navigation
    Page("index.html", "Board", _index),
    Page(
        "kinds-of-place.html",
        "Kinds of place",
        lambda site: {"made_of": _made_of(site.book)},
        is_there=lambda site: site.tables["kinds-of-place.html"]["kinds"],
    ),
    Page("suites.html", "Suites"),
    Page("matchers.html", "Matchers"),
    Page(
        "rejection.html",
        "Rejection",
        _rejection,
        lambda site: any(site.tables["rejection.html"][kind] for kind in ("rejection", "protection")),
    ),
    Page("figures.html", "Figures", is_there=lambda site: site.source.figures),
    Page(
        "map.html", "Map", lambda _: {"outcomes": OUTCOMES, "classes": load_taxonomy().classes}, lambda site: site.maps
    ),
    Page("failures.html", "Failures", _failures, lambda site: site.source.pictures.cases),
    Page("regions.html", "Regions", lambda site: {"table": region_table(site.source)}),
    Page("ageing.html", "Ageing", lambda site: {"table": rate_table(site.source.rates)}),
    Page("method.html", "Method", _method),
)


def environment() -> Environment:
    """Return what fills in the templates: everything is escaped, and what would not be seen is removed."""
    return Environment(
        loader=PackageLoader("sasgeo_bench.boards"),
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
