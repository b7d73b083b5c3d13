# SPDX-License-Identifier: Apache-2.0
"""A board as a site: tables and cards -> the text of every page. All that comes from a board is shown as text."""

import re
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final

from jinja2 import Environment, PackageLoader

from sasgeo_bench.leaderboard.board_tables import Book, cost_table, rejection_tables, sections_of
from sasgeo_bench.leaderboard.columns import MARKS, MEANINGS, NOTE
from sasgeo_bench.leaderboard.reproduction import seed_lines
from sasgeo_bench.leaderboard.tables import file_stem
from sasgeo_bench.leaderboard.text import control_lines, training_lines, warnings_of
from sasgeo_bench.leaderboard.validity_tables import control_table, seed_table
from sasgeo_bench.publishing.site_board import contrasts_of
from sasgeo_bench.publishing.site_pages import (
    figures_by_kind,
    matchers_of,
    protection_tables,
    rate_table,
    region_table,
    suites_of,
)
from sasgeo_bench.publishing.site_source import Case, SiteSource
from sasgeo_bench.scoring.controls import Verdict
from sasgeo_bench.texts import plain

ASSETS: Final = ("site.css", "site.js")
FAILURES: Final = (  # in the order they are shown; others follow
    *("aliased", "aged", "occluded", "absent accepted", "right but withheld", "also without the stress"),
)
_NAMES: Final = {  # pages that every site has or may have, in the order of the navigation
    "index.html": "Board",
    "suites.html": "Suites",
    "matchers.html": "Matchers",
    "rejection.html": "Rejection",
    "figures.html": "Figures",
    "failures.html": "Failures",
    "regions.html": "Regions",
    "ageing.html": "Ageing",
    "method.html": "Method",
}
_BLANK_LINES: Final = re.compile(r"\n\s*\n+")
_INDENTS: Final = re.compile(r"^[ \t]+", re.MULTILINE)


@dataclass(frozen=True, slots=True, kw_only=True)
class Group:
    """Failures of one class."""

    title: str
    stem: str
    cases: tuple[tuple[int, Case], ...]


def site_pages(source: SiteSource) -> dict[str, str]:
    """All pages of a site with its style and script, by file name.

    Parameters
    ----------
    source : SiteSource
        The board and all that is shown with it.

    Returns
    -------
    dict of str to str
        No page names another host but as a link, and each can be read without the script.
    """
    templates = _environment()
    book = Book.of(source.board, source.about, source.scores)
    rejection = rejection_tables(source.board)
    protection = protection_tables(source.protection)
    there = set(_NAMES)
    there -= set() if rejection or protection else {"rejection.html"}
    there -= set() if source.figures else {"figures.html"}
    there -= set() if source.pictures.cases else {"failures.html"}
    suites, matchers, sections = suites_of(source, book), matchers_of(source, book), sections_of(book)
    kinds = figures_by_kind(source.figures)
    common: dict[str, Any] = {
        "source": source,
        "about": source.about,
        "book": book,
        "navigation": [(page, title) for page, title in _NAMES.items() if page in there],
        "note": NOTE.format(draws=source.about.get("draws", "?")),
    }
    controls = _verdicts(source)
    special: dict[str, dict[str, Any]] = {
        "index.html": {
            "sections": sections,
            "contrasts": contrasts_of(source),
            "control_lines": control_lines(controls),
            "controls_held": bool(controls) and all(item.holds for item in controls),
            "has_controls": bool(controls),
            "seed_line": seed_lines(source.about)[0],
            "seeds": seed_table(source.about),
            "warnings": warnings_of(source.board),
            "meanings": {one.name: one.meaning for item in sections for one in item.table.columns} | MARKS,
            "counts": _counts(source, book),
        },
        "suites.html": {"suites": suites},
        "matchers.html": {"matchers": matchers, "costs": cost_table(book)},
        "rejection.html": {"tables": rejection, "protection": protection, "kinds": kinds},
        "figures.html": {"kinds": kinds},
        "failures.html": {"groups": groups_of(source.pictures.cases), "total": len(source.pictures.cases)},
        "regions.html": {"table": region_table(source)},
        "ageing.html": {"table": rate_table(source.rates), "kinds": kinds},
        "method.html": {
            "controls": control_table(source.controls),
            "learned": training_lines(source.about),
            "meanings": MEANINGS | MARKS,
        },
    }
    pages = {name: _render(templates, name, name, common | special[name]) for name in _NAMES if name in there}
    for suite in suites:
        pages[suite.page] = _render(templates, "suite.html", suite.page, common | {"suite": suite})
    for matcher in matchers:
        pages[matcher.page] = _render(templates, "matcher.html", matcher.page, common | {"matcher": matcher})
    return pages | {name: templates.get_template(name).render() for name in ASSETS}


def _environment() -> Environment:
    return Environment(
        loader=PackageLoader("sasgeo_bench.publishing"),
        autoescape=True,
        finalize=_shown,
        trim_blocks=True,
        lstrip_blocks=True,
    )


def _shown(value: object) -> object:
    """Remove characters that a browser would not show or that reverse the direction of text."""
    return plain(value) if isinstance(value, str) and not hasattr(value, "__html__") else value


def _render(templates: Environment, template: str, page: str, values: Mapping[str, Any]) -> str:
    text = templates.get_template(template).render(**values, page=page)
    return _BLANK_LINES.sub("\n", _INDENTS.sub("", text)) + "\n"


def _verdicts(source: SiteSource) -> list[Verdict]:
    return [
        Verdict(
            control=str(row["control"]),
            matcher=str(row["matcher"]),
            n=int(row["n"]),
            found=float(row["found"]),
            expected=float(row["expected"]),
            p=float(row["p"]),
            holds=bool(row["holds"]),
        )
        for row in source.controls.to_dict("records")
    ]


def _counts(source: SiteSource, book: Book) -> dict[str, int]:
    """Count matchers, suites, queries, blocks and places of the board."""
    board, scores = source.board, source.scores
    queries = scores["query_id"].nunique() if "query_id" in scores else 0
    return {
        "matchers": len(book.matcher_pages),
        "suites": len(book.suite_pages),
        "queries": int(queries),
        "blocks": int(board["blocks"].max()) if len(board) else 0,
        "places": int(board["places"].max()) if len(board) else 0,
    }


def groups_of(cases: Sequence[Case]) -> tuple[Group, ...]:
    """Failures by class, numbered through from 1.

    Examples
    --------
    >>> said = {"query_id": "q", "matcher": "m", "file": "a.png", "alt": ""}
    >>> cases = [Case(failure=name, **said) for name in ("other", "occluded", "aliased")]
    >>> [(group.title, group.cases[0][0]) for group in groups_of(cases)]
    [('aliased', 1), ('occluded', 2), ('other', 3)]
    """
    counts = Counter(case.failure for case in cases)
    names = [name for name in FAILURES if name in counts]
    names += sorted(set(counts) - set(names))
    groups, number = [], 0
    for at, name in enumerate(names):
        mine = [case for case in cases if case.failure == name]
        listed = tuple((number + more, case) for more, case in enumerate(mine, start=1))
        groups.append(Group(title=name, stem=f"{file_stem('class', name)}-{at}", cases=listed))
        number += len(mine)
    return tuple(groups)
