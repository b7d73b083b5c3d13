# SPDX-License-Identifier: Apache-2.0
"""Print which suites separate today's best from perfect, from stored boards: the tables of docs/unsolved.md.

    .venv/bin/python -m benchmarks.unsolved                         # of the boards in BOARDS
    .venv/bin/python -m benchmarks.unsolved docs/results/modules    # of others
    .venv/bin/python -m benchmarks.unsolved --write                 # and store them: the page, and headroom.json

A suite that several boards asked is shown from the one with the most places, then queries, and from one that can be
entered before any other if it has six places. Of entries that are ranked the best figure counts, whichever segmenter
made the views but the one that is given the truth. Where places are absent there is a second figure,
`right_at_absent_0.05`, of the best matcher with the best rejector; those that accept more than 5 % of the absent
places, as their interval shows, are left out.

A figure is open where its interval (95 %) stays below the ceiling; `saturated` where it does not and less than NEAR is
left; else, and of fewer than six places or ten queries, too few.
"""

import argparse
import json
import re
from collections.abc import Iterable, Iterator, Sequence
from itertools import groupby
from pathlib import Path
from textwrap import wrap

from sasgeo_bench.boards.board_files import read_board_manifest, read_leaderboard
from sasgeo_bench.boards.board_tables import Book
from sasgeo_bench.boards.headroom import FEW, FILE, OPEN, SATURATED, Headroom, State
from sasgeo_bench.boards.tables import Record, interval_text, number_text, prior_words, records_of, suite_card
from sasgeo_bench.core.errors import SasgeoError
from sasgeo_bench.core.plugins import ORACLE_SEGMENTER
from sasgeo_bench.core.texts import markdown, markdown_code
from sasgeo_bench.regions.region import DATA_VERSION
from sasgeo_bench.scoring.compare import LEAST_PLACES
from sasgeo_bench.scoring.metrics import CEILING, primary_of
from sasgeo_bench.scoring.rejection_rows import AS_DRAWN
from sasgeo_bench.scoring.strata import STRESS
from sasgeo_bench.tasks.query import BY, SEQUENCE
from sasgeo_bench.tasks.suites.all_suites import EVERY_SUITE

ROOT = Path(__file__).parents[1]
BOARDS = (  # in docs/results
    *("places", "modules", "systems", "systems-objects", "flights", "pictures", "aerial", "aerial-soft"),
)
PAGE = ROOT / "docs" / "unsolved.md"
STORED = ROOT / "sasgeo_bench" / "boards" / FILE
BEGIN, END = "<!-- made by benchmarks/unsolved.py -->\n", "<!-- end -->\n"

NEAR = 0.1
LEAST_QUERIES = 10
REJECTION, REACHED = "right_at_absent_0.05", "absent_reached_at_0.05"
MOST_ACCEPTED = 0.05
ASKED_OF_SEVERAL = ("no-priors", "real-image")  # prior groups, which their lines name
HEADS = {
    OPEN: "## Open",
    FEW: "## Too few to say",
    SATURATED: "## Saturated: nothing to report",
}
COLUMNS = ("suite", "what it asks", "figure", "to beat [95 %]", "queries (places)", "ceiling", "headroom", "held by")


def rows_of(folder: Path) -> Iterator[Headroom]:
    """Yield the figures of every ranked entry of a board: the first of each suite, and what its rejectors keep."""
    about = read_board_manifest(folder)
    board = read_leaderboard(folder)
    book, source = Book.of(board, about.entries), (folder.name, about.data_version or DATA_VERSION)
    judged: dict[tuple[str, ...], Record] = {}
    for row in records_of(board[(board["stratum"] == AS_DRAWN) & board["metric"].isin((REJECTION, REACHED))]):
        judged[row["suite"], row["track"], row["prior_group"], row["matcher"], row["rejector"], row["metric"]] = row
    for key, names in book.matchers.items():
        metric = primary_of(key[1]).name
        for name in names:
            if name in book.controls or book.is_set_apart(name):
                continue
            found = book.main(key, name, metric)
            # Where every stressed place is absent, the figure of all queries would be of what is not stressed
            if found is not None and (found["stratum"] == STRESS or book.pick(key, name, "answered_absent") is None):
                yield from _row(source, key, name, found, book.pick(key, name, CEILING.name, found["stratum"]))
            for (*where, rejector, one), kept in judged.items():
                if tuple(where) == (*key, name) and one == REJECTION:
                    reached = judged.get((*key, name, rejector, REACHED))
                    if reached is not None and float(reached["lo"]) <= MOST_ACCEPTED:
                        ceiling = book.pick(key, name, CEILING.name)
                        yield from _row(source, key, f"{name} with {rejector}", kept, ceiling)


def _row(
    source: tuple[str, int], key: tuple[str, str, str], matcher: str, row: Record, ceiling: Record | None
) -> Iterator[Headroom]:
    suite, _, perceived = key[0].partition(BY)
    most = 1.0 if ceiling is None else float(ceiling["value"])
    value, lo, hi = (round(float(row[name]), 6) for name in ("value", "lo", "hi"))
    if row["is_applicable"] and lo <= value <= hi and perceived.partition(BY)[0] != ORACLE_SEGMENTER:
        yield Headroom(
            suite=suite,
            track=key[1],
            prior_group=key[2],
            perceived=perceived,
            metric=str(row["metric"]),
            board=source[0],
            data_version=source[1],
            matcher=matcher,
            value=value,
            lo=lo,
            hi=hi,
            n=int(row["n"]),
            places=int(row["places"]),
            ceiling=round(most, 6),
            state=_state(value, hi, most, n=int(row["n"]), places=int(row["places"])),
        )


def _state(value: float, hi: float, ceiling: float, *, n: int, places: int) -> State:
    """Return what a figure says of what is left to gain.

    >>> [_state(value, 0.98, 1.0, n=30, places=9) for value in (0.97, 0.7)]
    ['open', 'open']
    >>> [_state(value, 1.0, 1.0, n=30, places=9) for value in (0.97, 0.7)]
    ['saturated', 'too few']
    >>> _state(0.5, 0.6, 1.0, n=300, places=3)
    'too few'
    """
    if places < LEAST_PLACES or n < LEAST_QUERIES:
        return FEW
    if hi < round(ceiling, 6):
        return OPEN
    return SATURATED if ceiling - value < NEAR else FEW


def best_of(rows: Iterable[Headroom]) -> list[Headroom]:
    """Return the best row of each suite, track, prior group and figure, in the order in which they are listed.

    The boards that asked it at the most places, then with the most queries, count; see `_weight`.
    """
    listed: dict[tuple[str, ...], list[Headroom]] = {}
    for row in rows:
        listed.setdefault((row.suite, row.track, row.prior_group, row.metric), []).append(row)
    best = []
    for found in listed.values():
        most = max(map(_weight, found))
        boards = {row.board for row in found if _weight(row) == most}
        counted = [row for row in found if row.board in boards and row.places == most[1]]
        best.append(min(counted, key=lambda row: (-row.value, -row.n, row.matcher)))
    return sorted(best, key=lambda row: (*row.order, row.prior_group, row.metric))


def _weight(row: Headroom) -> tuple[bool, int, int]:
    """Return what a board counts for: whether it can be entered and is no trifle, its places and its queries."""
    return row.data_version == DATA_VERSION and row.places >= LEAST_PLACES, row.places, row.n


def lines(rows: Sequence[Headroom]) -> Iterator[str]:
    """Yield the tables in Markdown, with the command that enters each board."""
    for state, found in groupby(rows, key=lambda row: row.state):
        yield from (HEADS[state], "", _line(COLUMNS), _line("---" for _ in COLUMNS))
        shown = list(found)
        yield from (_line(_cells(row)) for row in shown)
        yield ""
        commands = list(_commands(shown))
        if state != SATURATED and commands:
            yield from ("```bash", *commands, "```", "")
    never = [name for name in EVERY_SUITE if name != "controls" and not any(row.suite == name for row in rows)]
    if never:
        names = ", ".join(map(markdown_code, never))
        yield from ("## Not asked by these boards", "", *wrap(names, 120, break_on_hyphens=False), "")


def _line(cells: Iterable[str]) -> str:
    return f"| {' | '.join(cells)} |"


def _cells(row: Headroom) -> Iterator[str]:
    card = suite_card(row.suite)
    about = markdown(row.suite if card is None else card.title)
    if row.suite in ASKED_OF_SEVERAL:
        about += f" ({markdown(prior_words(row.prior_group).partition(': ')[2])})"
    yield markdown_code(row.suite)
    yield about
    yield markdown_code(row.metric)
    yield interval_text(row.value, row.lo, row.hi)
    yield f"{row.n} ({row.places})"
    yield number_text(row.ceiling)
    yield number_text(row.headroom)
    matcher, _, rejector = row.matcher.partition(" with ")
    by = f", views by {markdown_code(row.perceived)}" if row.perceived else ""
    own = markdown_code(matcher) + (f" with {markdown_code(rejector)}" if rejector else "")
    closed = "" if row.data_version == DATA_VERSION else ", closed"
    yield f"{own}{by} on [{row.board}](results/{row.board}/leaderboard.md){closed}"


def _commands(rows: Sequence[Headroom]) -> Iterator[str]:
    """Yield a command for each board that can be entered, with the suites that are shown from there."""
    for board in dict.fromkeys(row.board for row in rows if row.data_version == DATA_VERSION):
        mine = [row for row in rows if row.board == board]
        plugin = "my-tracker" if {row.track for row in mine} == {SEQUENCE} else "my-matcher"
        seed = Path("docs", "results", f"{board}-sealed-seed.txt")
        sealed = f" --sealed-seed-file {board}.seed" if (ROOT / seed).exists() else ""
        yield f"# {', '.join(dict.fromkeys(row.suite for row in mine))}"
        if sealed:
            yield f"install -m 600 {seed} {board}.seed"
        yield f"sasgeo-bench enter docs/results/{board} --matcher {plugin} --extracts ~/osm{sealed}"


def to_json(rows: Iterable[Headroom]) -> str:
    """Return the rows as a JSON list, one a line."""
    return "[\n" + ",\n".join(json.dumps(row.model_dump()) for row in rows) + "\n]\n"


def page_of(text: str, tables: str) -> str:
    """Return a page with its tables replaced."""
    pattern = f"{re.escape(BEGIN)}.*{re.escape(END)}"
    return re.sub(pattern, lambda _: f"{BEGIN}\n{tables}\n{END}", text, flags=re.DOTALL)


def main(words: Sequence[str] | None = None) -> None:
    """Print the tables of some boards, and store them if that is asked for."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("boards", nargs="*", type=Path, default=[ROOT / "docs" / "results" / name for name in BOARDS])
    parser.add_argument("--write", action="store_true", help=f"into {PAGE.name} and {FILE}, too")
    options = parser.parse_args(words)
    try:
        rows = best_of(row for board in options.boards for row in rows_of(board))
    except SasgeoError as error:
        parser.error(str(error))
    tables = "\n".join(lines(rows)).rstrip("\n")
    print(tables)
    if options.write:
        STORED.write_text(to_json(rows), encoding="utf-8")
        PAGE.write_text(page_of(PAGE.read_text(encoding="utf-8"), tables), encoding="utf-8")


if __name__ == "__main__":
    main()
