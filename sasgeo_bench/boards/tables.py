# SPDX-License-Identifier: Apache-2.0
"""Tables as values, which Markdown, LaTeX, a terminal and the site show: columns, cells, ties, text of numbers."""

import math
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, Final, Self, TypeVar

import pandas as pd

from sasgeo_bench.boards.board_files import SCHEMAS
from sasgeo_bench.boards.manifests import BoardEntry
from sasgeo_bench.core.errors import ConfigError, counted
from sasgeo_bench.regions.region import Provenance
from sasgeo_bench.scoring.compare import LEAST_PLACES, RankInterval
from sasgeo_bench.scoring.metrics import METRICS
from sasgeo_bench.scoring.rows import AS_SUBMITTED, NOT_REPRODUCED, PACKED, REPRODUCED, RUN_HERE, is_unranked
from sasgeo_bench.tasks.query import PriorGroup
from sasgeo_bench.tasks.suites.all_suites import known_suite
from sasgeo_bench.tasks.suites.base import SuiteCard

Record = Mapping[str, Any]  # a row of the leaderboard
Key = tuple[str, str, str]  # suite, track, prior group

DAGGER: Final = "†"  # of an interval that Wilson's reaches beyond the draws
_LEAST_P: Final = 5e-4  # a smaller one would look like zero
_PLAIN: Final = re.compile(r"[^a-z0-9]+")
_MOST_LETTERS: Final = 60  # of a part of a file name


def records_of(frame: pd.DataFrame) -> list[Record]:
    """Return the rows of a table, each a mapping of names to values; a third of the work of `DataFrame.to_dict`.

    >>> records_of(pd.DataFrame({"matcher": ["mine"], "value": [0.5]}))
    [{'matcher': 'mine', 'value': 0.5}]
    """
    names = [str(name) for name in frame.columns]
    columns = (column.tolist() for _, column in frame.items())
    return [dict(zip(names, row, strict=True)) for row in zip(*columns, strict=True)]


def figure_text(row: Record) -> str:
    """Return a figure with its interval, as in "0.63 [0.55, 0.70]"; a dagger where that is Wilson's."""
    mark = DAGGER if row["interval"] == "wilson" else ""
    return interval_text(row["value"], row["lo"], row["hi"]) + mark


def interval_text(value: float, lo: float, hi: float) -> str:
    """Return a figure with the ends of its interval, or alone where it has none.

    >>> interval_text(0.63, 0.55, 0.7), interval_text(0.63, math.nan, math.nan)
    ('0.630 [0.550, 0.700]', '0.630')
    """
    return number_text(value) if math.isnan(lo) else f"{number_text(value)} [{number_text(lo)}, {number_text(hi)}]"


def number_text(value: float) -> str:
    """Return a number with three digits; "-" for NaN."""
    if math.isnan(value):
        return "-"
    if math.isinf(value):
        return "inf"
    return f"{value:.3f}" if abs(value) < 10 else f"{value:.1f}"  # a digit less from ten on


def tally_text(value: float) -> str:
    """Return a count, or an expected count, never as a power of ten.

    >>> tally_text(3072.0), tally_text(3.0), tally_text(0.13636)
    ('3072', '3', '0.136')
    """
    return f"{value:.3g}" if abs(value) < 100 else f"{value:.0f}"  # three digits either way


def rank_text(row: Record) -> str:
    """Return a rank interval; controls have no rank, nor have entries that are set apart."""
    if pd.isna(row["rank_best"]):
        is_set_apart = pd.notna(row.get("set_apart"))
        return "control" if is_unranked(row["matcher"]) else "set apart" if is_set_apart else "-"
    return RankInterval(best=int(row["rank_best"]), worst=int(row["rank_worst"])).text


@dataclass(frozen=True, slots=True, kw_only=True)
class Bar:
    """An interval as a picture next to its numbers: ends, and the figure between them, in per cent of the cell."""

    lo: float
    hi: float
    at: float | None = None

    @classmethod
    def of_share(cls, row: Record) -> Self | None:
        """Return the bar of a share with an interval; None for other figures."""
        ends = tuple(float(row[name]) for name in ("lo", "hi", "value"))
        if row.get("unit") != "1" or not all(0 <= end <= 1 for end in ends):
            return None
        lo, hi, at = (round(100 * end, 1) for end in ends)
        return cls(lo=lo, hi=hi, at=at)


@dataclass(frozen=True, slots=True, kw_only=True)
class Mark:
    """A word next to a name, and its meaning."""

    text: str
    meaning: str
    tone: str = "plain"


@dataclass(frozen=True, slots=True, kw_only=True)
class Cell:
    """Text of one cell, and `details` that may stand below it; `key` is its sort key where that is not its text.

    `tone` says how it looks: plain, leading.
    """

    text: str
    key: float | None = None
    href: str = ""
    marks: tuple[Mark, ...] = ()
    bar: Bar | None = None
    tone: str = "plain"
    details: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True, kw_only=True)
class Column:
    """A column: the term that it is looked up by, its name in the table, its meaning.

    `order` is how the table is sorted by it, in the words of `aria-sort`.
    """

    term: str
    name: str
    meaning: str
    is_number: bool = True
    order: str = "none"


@dataclass(frozen=True, slots=True, kw_only=True)
class Row:
    """A line of a table; the first cell is its head.

    `tone` says how it looks: plain, control, tied, other-tie; head stays above all others, however they are sorted,
    and foot, of controls, below them.
    """

    cells: tuple[Cell, ...]
    tone: str = "plain"


@dataclass(frozen=True, slots=True, kw_only=True)
class Table:
    """A table with its title; `notes` stand below it."""

    name: str
    title: str
    columns: tuple[Column, ...]
    rows: tuple[Row, ...]
    notes: tuple[str, ...] = ()

    def without_empty(self, *terms: str) -> "Table":
        """Return the table without those of the named columns that are "-" in every row."""
        lost = {
            at
            for at, column in enumerate(self.columns)
            if column.term in terms and all(row.cells[at].text == "-" for row in self.rows)
        }
        keep = [at for at in range(len(self.columns)) if at not in lost]
        return replace(
            self,
            columns=tuple(self.columns[at] for at in keep),
            rows=tuple(Row(cells=tuple(row.cells[at] for at in keep), tone=row.tone) for row in self.rows),
        )


def text_of(cell: Cell) -> str:
    """Return a cell as plain text; a mark that praises or warns stands in brackets.

    >>> text_of(Cell(text="mine", marks=(Mark(text="as submitted", meaning="", tone="warn"),)))
    'mine (as submitted)'
    """
    marks = (f"({mark.text})" for mark in cell.marks if mark.tone != "plain")
    return " ".join(filter(None, (cell.text, *cell.details, *marks)))


def sort_key(value: float) -> float | None:
    """Return a number as the key of a cell; None for NaN."""
    return None if math.isnan(value) else value


def plain_cell(value: object) -> Cell:
    """Return a cell of a text or a whole number; "-" where there is none.

    >>> plain_cell(3), plain_cell("").text
    (Cell(text='3', key=3.0, href='', marks=(), bar=None, tone='plain', details=()), '-')
    """
    is_number = isinstance(value, int | float) and not isinstance(value, bool)
    return Cell(text=str(value) if value not in ("", None) else "-", key=float(str(value)) if is_number else None)


def number_cell(value: float, unit: str = "") -> Cell:
    """Return a cell of one number, with its unit if it has one.

    >>> number_cell(12.345, "s").text, number_cell(math.nan).text
    ('12.3 s', '-')
    """
    if math.isnan(value):
        return Cell(text="-")
    return Cell(text=f"{number_text(value)} {unit}".strip(), key=value)


Shown = Cell | str | int | float | None
T = TypeVar("T")
Field = tuple[Column, Callable[[T], Shown]]  # a column, and what it shows of the thing that a line is of


def cell_of(value: Shown) -> Cell:
    """Return what a column shows as a cell.

    >>> [cell_of(value).text for value in ("mine", 3, 0.25, math.nan, None)]
    ['mine', '3', '0.250', '-', '-']
    """
    if isinstance(value, Cell):
        return value
    if isinstance(value, str):
        return Cell(text=value)
    return number_cell(value) if isinstance(value, float) else plain_cell(value)


def table_of(
    name: str,
    title: str,
    things: Iterable[T],
    fields: Sequence[Field[T]],
    *,
    notes: Iterable[str] = (),
    tone: Callable[[T], str] = lambda _: "plain",
) -> Table:
    """Return a table of some things, one a line; each of `fields` is a column, with what it shows of a thing."""
    lines, tones = [], []
    for one in things:
        lines.append([shown(one) for _, shown in fields])
        tones.append(tone(one))
    return grid_of(name, title, [column for column, _ in fields], lines, notes=notes, tones=tones)


def grid_of(
    name: str,
    title: str,
    columns: Iterable[Column],
    lines: Sequence[Sequence[Shown]],
    *,
    notes: Iterable[str] = (),
    tones: Sequence[str] = (),
) -> Table:
    """Return a table whose lines are given as they are shown; `tones` say how they look."""
    rows = [
        Row(cells=tuple(map(cell_of, line)), tone=tone)
        for line, tone in zip(lines, tones or ["plain"] * len(lines), strict=True)
    ]
    return Table(name=name, title=title, columns=tuple(columns), rows=tuple(rows), notes=tuple(notes))


def p_text(p: float) -> str:
    """Return a p value with three digits, never 0.000; "-" for NaN.

    >>> p_text(0.0001), p_text(0.04), p_text(math.nan)
    ('below 0.001', '0.040', '-')
    """
    return "below 0.001" if p < _LEAST_P else number_text(p)


def p_cell(p: float) -> Cell:
    """Return a cell of a p value."""
    return Cell(text=p_text(p), key=sort_key(p))


def figure_cell(row: Record | None, *, has_bar: bool = False) -> Cell:
    """Return a cell of a figure with its interval; "-" for none, in words where the matcher cannot."""
    if row is None:
        return Cell(text="-")
    if not row["is_applicable"]:
        return Cell(text="not applicable")
    value = float(row["value"])
    bar = Bar.of_share(row) if has_bar else None
    return Cell(text=figure_text(row), key=None if math.isnan(value) else value, bar=bar)


def rank_cell(row: Record, *, ranked: int, mark: Mark | None = None) -> Cell:
    """Return a cell of a rank interval, with a bar of the ranks it covers unless one matcher alone is ranked.

    >>> row = {"matcher": "mine", "rank_best": 1, "rank_worst": 1}
    >>> rank_cell(row, ranked=2).bar, rank_cell(row, ranked=1).bar
    (Bar(lo=0.0, hi=50.0, at=None), None)
    """
    text = rank_text(row)
    if pd.isna(row["rank_best"]) or is_unranked(str(row["matcher"])):
        return Cell(text=text)
    best, worst = int(row["rank_best"]), int(row["rank_worst"])
    bar = Bar(lo=round(100 * (best - 1) / ranked, 1), hi=round(100 * worst / ranked, 1)) if ranked > 1 else None
    return Cell(text=text, key=best + worst / 1e4, bar=bar, marks=() if mark is None else (mark,))


def file_stem(*parts: str) -> str:
    """Return parts as letters, digits and hyphens alone.

    >>> file_stem("matcher", "<script>alert(1)</script>")
    'matcher-script-alert-1-script'
    """
    words = (_PLAIN.sub("-", part.lower()).strip("-")[:_MOST_LETTERS].strip("-") for part in parts)
    return "-".join(word for word in words if word) or "page"


def page_names(kind: str, names: Iterable[str]) -> dict[str, str]:
    """Name -> name of its page, no two alike, whatever the names are.

    >>> page_names("matcher", ["raster", "raster!", "raster-2"])
    {'raster': 'matcher-raster.html', 'raster!': 'matcher-raster-3.html', 'raster-2': 'matcher-raster-2.html'}
    """
    listed = list(dict.fromkeys(names))
    own = {name: file_stem(kind, name) for name in listed}
    taken = {stem for name, stem in own.items() if stem == f"{kind}-{name}"}  # names that are plain keep theirs
    found = {}
    for name, stem in own.items():
        free, number = stem, 1
        while stem != f"{kind}-{name}" and free in taken:
            number += 1
            free = f"{stem}-{number}"
        taken.add(free)
        found[name] = f"{free}.html"
    return found


@dataclass(frozen=True, slots=True, kw_only=True)
class Tie:
    """Matchers whose ranks overlap one another's in a chain, best first, and from which rank to which."""

    names: tuple[str, ...]
    best: int
    worst: int

    def to_text(self) -> str:
        """Return the tie in a line."""
        return f"{', '.join(self.names)} share ranks {self.best} to {self.worst}"


def ties_of(rows: Sequence[Record]) -> tuple[Tie, ...]:
    """Return the ties among the ranked rows of one table; rows without a rank are left out.

    >>> ranked = [("a", 1, 2), ("b", 1, 2), ("c", 3, 3)]
    >>> ties_of([dict(zip(("matcher", "rank_best", "rank_worst"), row)) for row in ranked])
    (Tie(names=('a', 'b'), best=1, worst=2),)
    """
    known = [row for row in rows if not pd.isna(row["rank_best"]) and not is_unranked(str(row["matcher"]))]
    ranked = sorted((int(row["rank_best"]), int(row["rank_worst"]), str(row["matcher"])) for row in known)
    chains: list[list[tuple[int, int, str]]] = []
    for item in ranked:
        if chains and item[0] <= max(worst for _, worst, _ in chains[-1]):
            chains[-1].append(item)
        else:
            chains.append([item])
    return tuple(
        Tie(names=tuple(name for _, _, name in chain), best=chain[0][0], worst=max(worst for _, worst, _ in chain))
        for chain in chains
        if len(chain) > 1
    )


_UNKNOWN: Final = "no meaning is written down for this column"
_HEADS: Final = {one.head: one.meaning for schema in SCHEMAS.values() for one in schema.columns if one.head}


def _meanings(*heads: str) -> dict[str, str]:
    """Return what the schemas of tables say of some columns, by the titles of these."""
    return {head: _HEADS[head] for head in heads}


_OTHER_COLUMNS: Final = {  # all but the metrics, which bring their own
    **_meanings("matcher"),
    "rank": "Ranks that the matcher can have, all pairs compared at once. Matchers that share a rank cannot be "
    f"distinguished. With fewer than {LEAST_PLACES} places no entry is ranked (-)",
    "control": "The same figure at the same places without the stress (stratum control)",
    "false fixes": "Share of absent places that were answered; each such answer is a false fix. Lower is better",
    **_meanings("detectable", "n"),
    **_meanings("missing", "blocks", "suite", "part", "kind"),
    "risk kept": "Whether at most 5 % of all answers are false: yes or no where the whole interval says so, else open",
    **_meanings("rejector", "track", "contrast", "first", "second", "difference"),
    "by blocks": "The interval of the difference if blocks, not places, are resampled: of these places alone",
    "by countries": "The interval of the difference if countries are resampled, then places in them",
    **_meanings("attainable", "matters", "p (Holm)"),
    "discordant": "Queries that only the first got right, and only the second",
    **_meanings("verdict", "control query", "outcome", "found", "expected", "p"),
    "fails at": "How many right ones fail the control; never: even if all were right, guessing could have done it",
    "figure": "Success or recall under stress, or false fixes at absent places",
    "public": "The figure on the public seed of this board",
    "private": "The same on a private seed, whose queries only its holder can draw",
    "private less public": "Difference with its interval; all intervals of a matcher hold at once (95 %)",
    "shown": "Whether the private figure is shown to be worse",
    "class": "Semantic class of the map",
    "place": "Regions so near each other that they count as one: places are resampled, and kept apart by the split",
    "compared at": "Where maps of several dates were compared",
    "queries": "Track of the queries, and what was known of the pose before",
    "years": "From the first map to the last",
    "things": "Things of the class on the first map and on the last",
    "vanishes": "Share of what the map shows that is gone after a year, with its 95 % interval, over all dates",
    "appears": "Share of a newer map that one a year older lacks, with its 95 % interval; late mapping is in it",
    "world": "Of what vanishes or appears in a year: what is told to be a change of the world, and what cannot be told",
    "re-drawn": "Of the older amount: kept, but moved by more than 1 m between the first map and the last",
    "moved": "How far what was kept moved, median; of areas that of the centroid",
    "no.": "As on the map above",
    "half or part": "What the split keeps apart: one half trains and calibrates for the other, or train, calibration "
    "and test",
    "regions": "Maps of this board that lie there",
    "dates": "Dates of the maps",
    "suites": "Suites that were drawn there",
    "scenes": "Kind of place, as its region file says",
    "kind of place": "Places of one kind, as their region files say; a place with several kinds counts in each",
    **_meanings(
        "method",
        "absence",
        "absent",
        "coverage",
        "risk of fixes",
        "risk",
        "available",
        "misleading",
        "hazardous",
        "exceeded",
        "supports",
        "requirement",
    ),
}
_OF_CONTRASTS: Final = {  # metrics of registered contrasts alone
    "primary": "Share of queries that are right",
    "interaction": "Share of queries that are right under stress, less that on the controls of the same sites: what "
    "the stress adds to the difference",
    "shift": "Share of queries that are right, less that on the views of the same sites by the detector `published`: "
    "what another detector adds to the difference",
}
_OF_PLACES: Final = {str(line.title): str(line.description) for line in Provenance.model_fields.values()}
MEANINGS: Final = {metric.name: metric.meaning for metric in METRICS} | _OTHER_COLUMNS | _OF_CONTRASTS
NOTE: Final = (
    "Intervals are 95 %: a bootstrap over places, then blocks, then sites ({draws} draws), never narrower than over "
    f"blocks alone, nor than Wilson's with as many trials as there are sites; {DAGGER} marks those where Wilson's is "
    "wider."
)
RANKS_NOTE: Final = (
    "The first figure of a suite counts the stressed queries, or all where nothing is stressed; matchers are ranked by "
    "it. A rank is an interval: matchers that share one cannot be distinguished. Nothing is ranked across prior groups."
    " Ranks compare all matchers of one suite; what a registered contrast says is adjusted for all contrasts of the "
    "board, so that it may leave open what ranks tell apart."
)
TERMS: Final = {  # what tables show that is no column
    DAGGER: "Wilson's interval: of a few sites, or where all answers are right, draws alone would be too narrow",
    "-": "nothing to show: no such query, no rank, no other to compare with",
    "the prior alone": "what `prior_centre` reaches, which looks at nothing: it answers with the middle of the prior's "
    "disc, or of the map without one; of candidates with the one nearest to the middle of all",
    "the odometer alone": "what `dead_reckoning` reaches: it adds up the odometer's steps from the middle of the prior",
    "chance": "what guessing among the candidates reaches",
    "prior group": "what is known before: radius in m (rnone: anywhere), heading known to 5, 20 or 360 deg, scale in %",
}
FAILED_CONTROL: Final = "failed a control"
MARKS: Final[dict[str, str]] = {  # words next to names and ranks
    RUN_HERE: "the matcher's code was run here, on queries of a public seed, which code can draw again",
    REPRODUCED: "it was run on a private seed of 128 bits too, and no figure is shown to be worse there",
    NOT_REPRODUCED: "it was run on a private seed too, and is shown to be worse there: do not trust the row",
    AS_SUBMITTED: "a file of answers; its code was not run here",
    PACKED: "answers of an archive that lay beside the pipeline file; what is not in it was asked here",
    "trained on": "the places that its parameters come from",
    "set apart": "in a table of its own and in no rank, for the reason stated there",
    FAILED_CONTROL: "it fails a control of the board, whose right score is known beforehand: do not trust the row",
    "added": "it was asked in addition to the matchers of the pipeline",
    "tie": "shares ranks with others, who are named below the table; neighbouring ties differ in colour",
}
CONTROL: Final = Mark(text="control", meaning="no rival: its right outcome is known beforehand")
UNSTRESSED: Final = "unstressed"  # the stratum of controls, in words that are not those of a board's controls
ADDED: Final = Mark(text="added", meaning=MARKS["added"], tone="added")
FEW: Final = Mark(
    text="few",
    meaning=f"fewer than {LEAST_PLACES} places: no entry is ranked, and other places of the kind may well differ",
    tone="warn",
)
_TONES: Final = {RUN_HERE: "plain", REPRODUCED: "good", NOT_REPRODUCED: "warn", AS_SUBMITTED: "warn", PACKED: "warn"}


def column(term: str, *, is_number: bool = True, order: str = "none", title: str = "") -> Column:
    """Return the column of a term with its meaning; `title` where it is shown under another name.

    >>> column("n").meaning
    'Queries, or flights, in the denominator. Rows with different n do not compare: they are of different ones'
    """
    meaning = MEANINGS.get(term) or _OF_PLACES.get(term, _UNKNOWN)
    return Column(term=term, name=title or term, meaning=meaning, is_number=is_number, order=order)


word: Final = partial(column, is_number=False)  # a column of text


def prior_words(name: str) -> str:
    """Return a prior group in words, or its name where that is none of ours.

    >>> prior_words("r500-weak-s3")
    'searched: disc of 500 m, heading +-20 deg, scale +-3 %'
    >>> prior_words("rnone-unknown-s15"), prior_words("another")
    ('searched: whole map, heading unknown, scale +-15 %', 'another')
    """
    try:
        return PriorGroup.parse(name).words
    except ConfigError:
        return name


def suite_card(suite: str) -> SuiteCard | None:
    """Return the card of a suite of this version, whichever segmenter made its evidence; None for any other."""
    found = known_suite(suite)
    return None if found is None else found.card


def suite_words(suite: str) -> str:
    """Return the title of a suite and what is done in it; "" for one that this version does not know.

    >>> suite_words("aerial+pixel_forest").partition(". ")[0]
    'Pictures from straight above (P1)'
    """
    card = suite_card(suite)
    return "" if card is None else f"{card.title}. {card.what}"


def marks_of(entry: BoardEntry, *, is_control: bool) -> tuple[Mark, ...]:
    """Return the words next to an entry's name: control, how its answers were made, what it was trained on.

    >>> mine = BoardEntry(name="mine", how="as submitted", trained_on=["porto"])
    >>> [mark.text for mark in marks_of(mine, is_control=False)]
    ['as submitted', 'trained on 1 place']
    """
    how = entry.how or ""
    how = RUN_HERE if how == REPRODUCED and entry.private is None else how  # older boards had no private seed
    marks = [Mark(text=how, meaning=MARKS.get(how, "as the board says"), tone=_TONES.get(how, "plain"))] if how else []
    if is_control:
        return (CONTROL, *(mark for mark in marks if how == PACKED))
    if entry.trained_on:
        meaning = f"its parameters come from {', '.join(entry.trained_on)}"
        marks.append(Mark(text=f"trained on {counted(len(entry.trained_on), 'place')}", meaning=meaning))
    if entry.failed_controls:
        marks.append(Mark(text=FAILED_CONTROL, meaning="; ".join(entry.failed_controls), tone="warn"))
    if entry.set_apart:
        marks.append(Mark(text="set apart", meaning=entry.set_apart, tone="warn"))
    return tuple(marks)
