# SPDX-License-Identifier: Apache-2.0
"""The tables of a board, listed with where they are shown, and a board as Markdown, LaTeX and lines for a terminal.

A table is written by four functions: `table_text`, `table_markdown`, `table_latex`, and `table` of `parts.html`.
"""

from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, Final, NamedTuple

import pandas as pd
import rich.table

from sasgeo_bench.boards.board_tables import (
    Book,
    acceptance_tables,
    contrast_table,
    control_table,
    cost_table,
    falsifier_table,
    protection_tables,
    rejection_tables,
    requirement_tables,
    risk_tables,
    risk_tables_by_suite,
    scene_tables,
    seed_table,
    step_tables,
    suite_tables,
    use_tables,
)
from sasgeo_bench.boards.manifests import BoardEntry, BoardManifest, MetricRecord
from sasgeo_bench.boards.tables import DAGGER, MEANINGS, NOTE, RANKS_NOTE, TERMS, Table, interval_text, text_of
from sasgeo_bench.core.errors import counted, named
from sasgeo_bench.core.texts import markdown, markdown_item, tex
from sasgeo_bench.regions.region import ATTRIBUTION, DATA_VERSION, MADE_UP, OLD_STYLE_DATA_VERSION
from sasgeo_bench.running.sandbox import is_unguarded
from sasgeo_bench.scoring.compare import Finding
from sasgeo_bench.scoring.controls import ALPHA, Falsifier, Verdict
from sasgeo_bench.scoring.metrics import ANSWERED, FALSE_ABSENT, primary_of
from sasgeo_bench.scoring.strata import ALL
from sasgeo_bench.tasks.private_seed import SealedPlace
from sasgeo_bench.tasks.query import SEQUENCE

_IS_PRIVATE: Final = (
    "Seeds: this board is of a private seed. Its figures may be published; publish none of its files, for they hold "
    "queries, truths and answers."
)
_IS_PUBLIC: Final = (
    "Seeds: the queries of this board are drawn by a public seed, which code can draw again, truths and all. No row "
    "was held against a private one, so none is reproduced."
)
_FLIGHT: Final = primary_of(SEQUENCE).name
_NEW_STYLE: Final = "2017"  # from this year on the tags of multipolygons stand on their relations
_FEW_BLOCKS, _FEW_PLACES = 36, 12  # fewer are too few to speak of other places


def warnings_of(board: pd.DataFrame) -> list[str]:
    """Return what a reader must know before reading on."""
    warnings = []
    if len(board):
        blocks, places = int(board["blocks"].max()), int(board["places"].max())
        if blocks < _FEW_BLOCKS or places < _FEW_PLACES:
            warnings.append(
                f"{counted(blocks, 'block')} in {counted(places, 'place')}: fewer than {_FEW_BLOCKS} in {_FEW_PLACES}, "
                "so intervals speak of these places and little of others."
            )
        # Between them these count every query once: present places, absent ones, and flights.
        whole = board[board["metric"].isin((ANSWERED.name, FALSE_ABSENT.name, _FLIGHT)) & (board["stratum"] == ALL)]
        is_flight = whole["track"] == SEQUENCE
        for rows, names, row in (
            (whole[~is_flight], ("query", "queries"), "a row"),
            (whole[is_flight], ("flight", "flights"), "a row for each view"),
        ):
            for matcher, count in rows.groupby("matcher")["missing"].sum().items():
                if count:
                    rest = f"lacks {row} and counts as a miss" if count == 1 else f"lack {row} and count as misses"
                    warnings.append(f"{matcher}: {counted(count, *names)} {rest}.")
    return warnings


def map_lines(about: BoardManifest) -> list[str]:
    """Return what is wrong with the maps of a board that an earlier data version read; empty if nothing is.

    >>> from sasgeo_bench.boards.manifests import BoardTask
    >>> maps = ("bayreuth", "bayreuth+alias", "krems")
    >>> tasks = [BoardTask(suite="clean", region=name, map_date="2014-11-04") for name in maps]
    >>> board = BoardManifest(scorer_version=6, data_version=2, entries=[], tasks=tasks)
    >>> print(*map_lines(board))  # doctest: +NORMALIZE_WHITESPACE
    Old maps: its 2 maps of before 2017 were read with old-style multipolygons as areas of their outer ways (yards and
    clearings filled, areas of several open ways missing); maps of data version 3 and later have them right.
    >>> map_lines(board.model_copy(update={"data_version": 3}))
    []
    """
    if (about.data_version or DATA_VERSION) >= OLD_STYLE_DATA_VERSION:
        return []
    old = {
        task.region.split("+")[0]
        for task in about.tasks
        if (task.map_date or _NEW_STYLE) < _NEW_STYLE and not task.region.startswith(MADE_UP)
    }
    if not old:
        return []
    line = (
        f"Old maps: its {counted(len(old), 'map')} of before {_NEW_STYLE} {'was' if len(old) == 1 else 'were'} read "
        "with old-style multipolygons as areas of their outer ways (yards and clearings filled, areas of several open "
        f"ways missing); maps of data version {OLD_STYLE_DATA_VERSION} and later have them right."
    )
    return [line]


def sandbox_lines(about: BoardManifest) -> list[str]:
    """Return which matchers answered outside the sandbox; empty if all answered within, or do not say where.

    >>> trusted = BoardEntry(name="mine", isolation={"truth": "trusted code, not shut in"})
    >>> sandbox_lines(BoardManifest(scorer_version=6, entries=[trusted], tasks=[]))
    ['Without the sandbox (--trusted), so that nothing kept the truths from it: mine.']
    """
    names = [entry.name for entry in about.entries if is_unguarded(entry.isolation or {})]
    if not names:
        return []
    whom = "it" if len(names) == 1 else "them"
    return [f"Without the sandbox (--trusted), so that nothing kept the truths from {whom}: {', '.join(names)}."]


def control_lines(verdicts: Sequence[Verdict]) -> list[str]:
    """Return whether the controls of a board held, failures one by one.

    >>> control_lines([])
    ['Controls: none were drawn for this board, so nothing vouches for it (a pipeline draws them).']
    """
    if not verdicts:
        return ["Controls: none were drawn for this board, so nothing vouches for it (a pipeline draws them)."]
    idle = sum(not item.can_fail for item in verdicts)
    powerless = (
        f"{counted(idle, 'control')} could not fail: {'its' if idle == 1 else 'their'} queries are so few that guesses "
        f"are right on all of them with a probability above {ALPHA:g}."
    )
    return [*_held_lines(verdicts), *([powerless] if idle else [])]


def _held_lines(verdicts: Sequence[Verdict]) -> list[str]:
    """Return how many controls held, and those that did not."""
    failed = [item for item in verdicts if not item.holds]
    lines = [item.to_text() for item in failed]
    of_board = sum(item.is_of_board for item in failed)
    if of_board:
        return [f"CONTROLS FAILED, {of_board} of {len(verdicts)}: do not trust this board.", *lines]
    rivals = list(dict.fromkeys(item.matcher for item in failed))
    if not rivals:
        return [f"Controls: all {len(verdicts)} held."]
    head = f"Controls: {len(verdicts) - len(failed)} of {len(verdicts)} held."
    more = "; if these share no code, the queries may reveal the truth" if len(rivals) > 1 else ""
    return [f"{head} Do not trust the rows of {', '.join(rivals)}{more}:", *lines]


def contrast_lines(findings: Sequence[Finding]) -> list[str]:
    """Return what came of each registered contrast, with its difference, or why it is open.

    >>> found = Finding(name="age", first="with", second="without", metric="primary", n=90, blocks=30, places=18,
    ...     best=1.0, second_value=0.6, difference=0.0, lo=-0.02, hi=0.02, p_holm=1.0, least=0.03)
    >>> contrast_lines([found])
    ['age: with and without are equal (within 0.03): difference 0.000 [-0.020, 0.020]']
    """
    lines = []
    for item in findings:
        why = item.verdict.removeprefix(f"{item.outcome}: ") if item.outcome.startswith("not ") else ""
        difference = f"difference {interval_text(item.difference, item.lo, item.hi)}" if item.n else ""
        lines.append(": ".join(filter(None, (item.name, item.headline, why, difference))))
    return lines


def seed_lines(about: BoardManifest) -> list[str]:
    """Return whether the rows of a board were compared with a private seed, and the result of each."""
    if about.private_seed is not None:
        return [_IS_PRIVATE]
    seed = about.private
    if seed is None:
        return [_IS_PUBLIC]
    words = f"a private seed of {seed.bits} bits, commitment {seed.commitment[:12]}"
    rows = [(entry.name, entry.private) for entry in about.entries]
    return [
        f"Seeds: rows were held against the same pipeline on {words}.",
        *(f"{name}: {row.verdict} ({row.why})." for name, row in rows if row is not None),
    ]


def sealed_lines(sealed: Mapping[str, SealedPlace]) -> list[str]:
    """Return whether the board holds the sealed places, and when they were opened: a line for those of one state.

    >>> sealed_lines({name: SealedPlace(drawn_by=None, openings=[]) for name in ("porto", "monaco")})
    ['Sealed places porto, monaco: not opened, and so not on this board.']
    """
    places: dict[str, list[str]] = {}
    for place, item in sealed.items():
        places.setdefault(_sealed_state(item), []).append(place)
    return [
        f"Sealed place{'s' if len(names) > 1 else ''} {', '.join(names)}: {state}." for state, names in places.items()
    ]


def _sealed_state(item: SealedPlace) -> str:
    days = {one.commitment: f"{one.opened} by a seed of commitment {one.commitment[:12]}" for one in item.openings}
    if not days:
        return "not opened, and so not on this board"
    first = next(iter(days))
    if item.drawn_by is None:
        return f"opened on {days[first]}, and not on this board"
    if item.drawn_by == first:
        return f"opened on {days[first]}"
    number = list(days).index(item.drawn_by) + 1
    return (
        f"opened on {days[item.drawn_by]}; this is opening {number}, after {days[first]}, so the place was no "
        "longer unseen"
    )


def training_lines(about: BoardManifest) -> list[str]:
    """Return which rows are set apart, and which entries were trained on which places.

    >>> from sasgeo_bench.matching.cards import Learned
    >>> one = Learned(file="learned/ab.json", trained_on=["monaco", "porto"], pairs=24, asked=["clean/vaduz"])
    >>> mine = BoardEntry(name="mine", learned=[one])
    >>> training_lines(BoardManifest(scorer_version=6, entries=[mine], tasks=[]))
    ['mine: for 1 task (clean/vaduz) trained on 24 queries of 2 places (monaco, porto).']
    """
    set_apart = [
        f"{entry.name} is set apart: {entry.set_apart}. It has no rank; its figures stand in other tables."
        for entry in about.entries
        if entry.set_apart
    ]
    return set_apart + [
        f"{entry.name}: for {named(one.asked, 'task')} {'trained on' if one.file else 'could not train on'} "
        f"{counted(one.pairs, 'query', 'queries')} of {named(one.trained_on, 'place')}."
        for entry in about.entries
        for one in entry.learned
    ]


def segmenter_lines(about: BoardManifest) -> list[str]:
    """Return at how many pictures segmenters failed, suite by suite.

    >>> from sasgeo_bench.boards.manifests import BoardTask
    >>> tasks = [BoardTask(suite="aerial+mine", region=name, failed_pictures=2) for name in ("monaco", "vaduz")]
    >>> segmenter_lines(BoardManifest(scorer_version=6, entries=[], tasks=tasks))
    ['aerial+mine: the segmenter failed at 4 pictures of 2 tasks (monaco, vaduz), whose evidence is unknown.']
    """
    regions: dict[str, list[str]] = {}
    counts: Counter[str] = Counter()
    for task in about.tasks:
        if task.failed_pictures:
            regions.setdefault(task.suite, []).append(task.region)
            counts[task.suite] += task.failed_pictures
    return [
        f"{suite}: the segmenter failed at {counted(counts[suite], 'picture')} of {named(names, 'task')}, whose "
        "evidence is unknown."
        for suite, names in regions.items()
    ]


def metric_lines(about: BoardManifest) -> list[str]:
    """Return which metrics are of other packages, and whose code they are."""
    return [f"{one.name}: {one.to_text()}." for one in about.metrics]


# --- the tables -------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, kw_only=True)
class Contents:
    """What the tables of a board are made of; of what is empty there is no table.

    `scores` are the scored queries, `steps` the steps of stress (`strata.steps_frame`), `ages` their names where they
    are ages of a map (`plots.age_names`), `scenes` success by kind of place (`tables.scene_frame`), `metrics`
    those of other packages, `within` and `require` the limits and requirements that were stated, `requirements` what
    came of the latter, and `added` the entries that the pipeline does not name.
    """

    leaderboard: pd.DataFrame
    entries: Sequence[BoardEntry] = ()
    scores: pd.DataFrame = field(default_factory=pd.DataFrame)
    findings: Sequence[Finding] = ()
    falsifiers: Sequence[Falsifier] = ()
    verdicts: Sequence[Verdict] = ()
    acceptance: pd.DataFrame = field(default_factory=pd.DataFrame)
    protection: pd.DataFrame = field(default_factory=pd.DataFrame)
    steps: pd.DataFrame = field(default_factory=pd.DataFrame)
    ages: Mapping[tuple[Any, ...], str] = field(default_factory=dict)
    scenes: pd.DataFrame = field(default_factory=pd.DataFrame)
    metrics: Sequence[MetricRecord] = ()
    within: Sequence[str] = ()
    require: Sequence[str] = ()
    added: Sequence[str] = ()
    requirements: pd.DataFrame = field(default_factory=pd.DataFrame)

    @cached_property
    def book(self) -> Book:
        """Return the figures that take every answer, by entry and queries."""
        stated = {"within": self.within, "require": self.require, "added": self.added}
        return Book.of(self.leaderboard, self.entries, self.scores, metrics=self.metrics, **stated)


class TableKind(NamedTuple):
    """Tables of one kind: where they are shown, and what makes them."""

    name: str
    shown: str
    make: Callable[[Contents], Iterable[Table]]


TERMINAL: Final = "terminal"
MARKDOWN: Final = "leaderboard.md"
LATEX: Final = "leaderboard.tex"
TABLES: Final = (  # of a whole board, in the order in which any outlet shows them
    TableKind(
        "requirements",
        "terminal leaderboard.md leaderboard.tex index.html",
        lambda of: requirement_tables(of.requirements, of.book),
    ),
    TableKind("seeds", "leaderboard.md leaderboard.tex index.html", lambda of: [seed_table(of.entries)]),
    TableKind("contrasts", "leaderboard.md leaderboard.tex", lambda of: [contrast_table(of.findings)]),
    TableKind("falsifiers", "leaderboard.md", lambda of: [falsifier_table(of.falsifiers)]),
    TableKind("suites", "leaderboard.md leaderboard.tex", lambda of: suite_tables(of.book)),
    TableKind("use", "leaderboard.md", lambda of: use_tables(of.book)),
    TableKind("kinds", "kinds-of-place.html", lambda of: scene_tables(of.scenes, of.book)),
    TableKind("risk", "rejection.html", lambda of: risk_tables(of.leaderboard)),
    TableKind("risk by suite", "rejection.html", lambda of: risk_tables_by_suite(of.leaderboard)),
    TableKind(
        "rejection", "leaderboard.md leaderboard.tex rejection.html", lambda of: rejection_tables(of.leaderboard)
    ),
    TableKind("costs", "leaderboard.md leaderboard.tex matchers.html", lambda of: [cost_table(of.book)]),
    TableKind("acceptance", "leaderboard.md rejection.html", lambda of: acceptance_tables(of.acceptance)),
    TableKind("protection", "rejection.html", lambda of: protection_tables(of.protection)),
    TableKind("steps", "leaderboard.md", lambda of: step_tables(of.steps, of.ages)),
    TableKind("controls", "leaderboard.md leaderboard.tex method.html", lambda of: [control_table(of.verdicts)]),
)


def tables_of(of: Contents, outlet: str) -> dict[str, tuple[Table, ...]]:
    """Return the tables that an outlet shows, by their kind."""
    return {kind.name: tuple(kind.make(of)) for kind in TABLES if outlet in kind.shown.split()}


def rows_of(of: Contents, outlet: str) -> list[Table]:
    """Return the tables that an outlet shows, without those that have no row."""
    return [table for tables in tables_of(of, outlet).values() for table in tables if table.rows]


def board_markdown(about: BoardManifest, of: Contents) -> str:
    """Return the board as a document."""
    tables = rows_of(of, MARKDOWN)
    lines = [
        *control_lines(of.verdicts),
        *seed_lines(about),
        *sealed_lines(about.sealed),
        *map_lines(about),
        *sandbox_lines(about),
        *warnings_of(of.leaderboard),
        *training_lines(about),
        *segmenter_lines(about),
        *metric_lines(about),
        *(f"Failed, and not on this board: {name}: {why}" for name, why in about.failed.items()),
    ]
    made_by = markdown(about.made_by or "?")
    columns = {column.term: column.meaning for table in tables for column in table.columns}
    ours = set(MEANINGS.values())  # which may hold code
    escaped = {term: meaning if meaning in ours else markdown(meaning) for term, meaning in columns.items()}
    return "\n".join(
        (
            f"# Board: scorer version {about.scorer_version}, task version {about.task_version}",
            "",
            f"Made by {made_by}. Split: {markdown(about.split or 'none')}. Data: {markdown(about.credit)}.",
            "",
            f"{NOTE.format(draws=about.draws)} {RANKS_NOTE}",
            "",
            *(f"- {markdown_item(line)}" for line in lines),
            "",
            *(line for table in tables for line in table_markdown(table)),
            "## How to read",
            "",
            *(f"- **{markdown(term)}**: {meaning}." for term, meaning in (escaped | TERMS).items()),
            "",
        )
    )


def table_text(table: Table) -> rich.table.Table:
    """Return a table for a terminal."""
    shown = rich.table.Table(*(column.name for column in table.columns), box=None, pad_edge=False)
    for row in table.rows:
        shown.add_row(*map(text_of, row.cells))
    return shown


def table_markdown(table: Table) -> Iterator[str]:
    """Yield the lines of a table with its title and notes."""
    yield from (f"## {markdown(table.title)}", "")
    yield from markdown_table(
        [column.name for column in table.columns], [map(text_of, row.cells) for row in table.rows]
    )
    yield from ("", *(f"- {markdown_item(note)}" for note in table.notes), *([""] if table.notes else []))


def markdown_table(header: Iterable[str], rows: Iterable[Iterable[str]]) -> Iterator[str]:
    r"""Yield the lines of a table of plain texts; see `texts.markdown`.

    >>> list(markdown_table(["matcher"], [["mine 1|2"]]))[-1]
    '| mine 1\\|2 |'
    """
    names = [markdown(name) for name in header]
    yield "| " + " | ".join(names) + " |"
    yield "|" + "---|" * len(names)
    for row in rows:
        yield "| " + " | ".join(map(markdown, row)) + " |"


_HEAD: Final = (
    r"% \usepackage{booktabs} for the rules. A table too wide for its column: table* spans two columns,",
    r"% \resizebox{\linewidth}{!}{...} (package graphicx) around a tabular shrinks it, sidewaystable (rotating)",
    r"% turns it; or leave out columns, the figures are all in leaderboard.parquet.",
)


def board_latex(about: BoardManifest, of: Contents) -> str:
    """Return the tables of a board for a paper, which needs the package booktabs."""
    head = f"% {tex(about.made_by or '?')}, scorer version {about.scorer_version}; {tex(about.credit)}"
    return (
        "\n".join(
            (head, *_HEAD, *(line for table in rows_of(of, LATEX) for line in table_latex(table, credit=about.credit)))
        )
        + "\n"
    )


def table_latex(table: Table, *, credit: str = ATTRIBUTION) -> Iterator[str]:
    """Yield the lines of a table; its label is its name."""
    rows = [" & ".join(tex(text_of(cell)) for cell in row.cells) + r" \\" for row in table.rows]
    dagger = f" {tex(DAGGER)} Wilson's interval over sites." if any(tex(DAGGER) in row for row in rows) else ""
    yield r"\begin{table}"
    yield rf"\caption{{{tex(table.title)}.{dagger} Data: {tex(credit)}.}}"
    yield rf"\label{{tab:{table.name}}}"
    yield rf"\begin{{tabular}}{{{'l' * len(table.columns)}}}"
    yield r"\toprule"
    yield " & ".join(tex(column.name) for column in table.columns) + r" \\"
    yield r"\midrule"
    yield from rows
    yield r"\bottomrule"
    yield r"\end{tabular}"
    yield r"\end{table}"
