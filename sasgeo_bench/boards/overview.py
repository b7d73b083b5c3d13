# SPDX-License-Identifier: Apache-2.0
"""What a board says first, a track and prior group at a time: sentences, and the table that they are made of."""

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Final

import pandas as pd

from sasgeo_bench.boards.board_tables import (
    SHOWN_RATIO,
    SHOWN_RISK,
    Book,
    is_ranked,
    risk_tables,
    risk_tables_by_suite,
    short_cell,
)
from sasgeo_bench.boards.tables import (
    DAGGER,
    Cell,
    Column,
    Key,
    Record,
    Row,
    Table,
    column,
    file_stem,
    interval_text,
    number_cell,
    number_text,
    plain_cell,
    prior_words,
    rank_text,
    records_of,
    suite_words,
    ties_of,
    word,
)
from sasgeo_bench.core.errors import counted
from sasgeo_bench.scoring.compare import LEAST_PLACES
from sasgeo_bench.scoring.controls import EVERY
from sasgeo_bench.scoring.metrics import CEILING, CHANCE, FALSE_ABSENT, primary_of
from sasgeo_bench.scoring.rejection_rows import AS_DRAWN
from sasgeo_bench.scoring.rows import ALL_SUITES
from sasgeo_bench.scoring.strata import ALL, STRESS
from sasgeo_bench.tasks.query import BY, SEQUENCE

AT_MOST: Final = "at most"  # the line of the ceiling
LEAST_QUERIES: Final = 10  # a suite of fewer, or of fewer places, stands apart: nobody should read ranks into it
LEAST_SHOWN_PLACES: Final = 3
FEW_RULE: Final = f"fewer than {LEAST_QUERIES} queries or {LEAST_SHOWN_PLACES} places"
_MOST_NAMES: Final = 3  # in a sentence


@dataclass(frozen=True, slots=True, kw_only=True)
class Headline:
    """A sentence on a family of suites, which differ in the segmenter alone; `page` is that of its first suite."""

    family: str
    text: str
    page: str = ""


@dataclass(frozen=True, kw_only=True)
class Overview:
    """What a board says first of one track and prior group.

    `keys` are the suites with enough queries to rank somebody, those with most ranked matchers first; `few` are the
    others.
    """

    book: Book
    keys: tuple[Key, ...]
    few: tuple[Key, ...]

    @property
    def group(self) -> tuple[str, str]:
        """Return track and prior group."""
        return (self.keys or self.few)[0][1:]

    @property
    def primary(self) -> str:
        """Return the name of the first figure."""
        return primary_of(self.group[0]).name

    @property
    def words(self) -> str:
        """Return track and prior group in words."""
        return f"{self.group[0]}, {prior_words(self.group[1])}"

    @cached_property
    def table(self) -> Table:
        """Return who is good at what: a matcher a line, a suite a column, sorted by the first; no rows without any."""
        return _matrix(self.book, self.keys, file_stem("summary", *self.group), f"{self.primary} [95 %] (rank)")

    @cached_property
    def few_table(self) -> Table:
        """Return the same of suites with too few queries, without ranks."""
        name, title = file_stem("summary", *self.group, "few"), f"Too few to rank ({FEW_RULE}): {self.primary} [95 %]"
        return _matrix(self.book, self.few, name, title, has_ranks=False)

    @property
    def shown(self) -> Table:
        """Return the table, or that of too few queries where there is no other."""
        return self.table if self.table.rows else self.few_table

    @property
    def headlines(self) -> tuple[Headline, ...]:
        """Return a sentence for each family of suites that somebody can be ranked on."""
        families: dict[str, list[Key]] = {}
        for key in self.keys:
            families.setdefault(key[0].partition(BY)[0], []).append(key)
        found = []
        for family, keys in families.items():
            several = len(keys) > 1
            parts = (
                (f"with {key[0].partition(BY)[2] or 'no segmenter'}, " if several else "") + _standing(self.book, key)
                for key in keys
            )
            page = self.book.suite_pages.get(keys[0][0], "")
            found.append(Headline(family=family if several else keys[0][0], text="; ".join(parts), page=page))
        return tuple(found)

    @property
    def few_text(self) -> str:
        """Return the suites with too few queries; "" without any."""
        noun = ("flight", "flights") if self.group[0] == SEQUENCE else ("query", "queries")
        parts = []
        for key in self.few:
            n, places = _size(self.book, key)
            parts.append(f"{key[0]} ({counted(n, *noun)} in {counted(places, 'place')})")
        return ", ".join(parts)

    @property
    def unsolved(self) -> str:
        """Return on which suites most is left to gain, by the highest figure of any ranked entry; "" without any."""
        left = []
        for key in self.keys:
            ranked = _ranked(self.book, key)
            if ranked:
                row = _first_of(self.book, key, CEILING.name)
                most = 1.0 if row is None or math.isnan(row["value"]) else float(row["value"])
                reached = float(ranked[0]["value"])
                left.append((most - reached, key[0], f"{number_text(reached)} of {number_text(most)}"))
        left.sort(key=lambda item: (-item[0], item[1]))
        texts = [f"{suite} ({text})" for gap, suite, text in left if gap > 0][:_MOST_NAMES]
        if not texts:
            return f"Nothing is left on {_listed([suite for _, suite, _ in left])}." if left else ""
        return f"Highest figures are furthest from what is attainable on {_listed(texts)}."

    @property
    def added(self) -> tuple[str, ...]:
        """Return how each entry that was added compares with the one of the highest figure, on the first such suite."""
        return tuple(filter(None, (_compared(self.book, self.keys, name) for name in sorted(self.book.added))))

    def trust(self, leaderboard: pd.DataFrame, acceptance: pd.DataFrame) -> str:
        """Return how much may be trusted, of the matcher of `risk_tables` that was asked most; "" without rejectors.

        `acceptance` is from `rejection.acceptance_frame`: what the same rejector makes of places that are not there.
        """
        name = file_stem("risk", *self.group)
        table = next((table for table in risk_tables(leaderboard) if table.name == name), None)
        if table is None:
            return ""
        row = max(table.rows, key=lambda row: row.cells[-1].key or 0)  # the others were asked less, which may be easier
        matcher, rejector, answered, reached, kept, n = (cell.text.replace(DAGGER, "") for cell in row.cells)
        verdict = {"yes": "the risk is kept", "no": "the risk is not kept"}.get(kept, "the risk may be kept or not")
        who = f"{matcher} with the rejector {rejector}, which orders its answers best,"
        text = (
            f"Where {100 * SHOWN_RISK:.0f} % of its answers may be false, {who} answers {answered} of {n} queries; of "
            f"these {reached} are false{self._worst(leaderboard, matcher, rejector)}: {verdict}."
        )
        return " ".join(filter(None, (text, self._refusal(acceptance, matcher, rejector))))

    def _worst(self, leaderboard: pd.DataFrame, matcher: str, rejector: str) -> str:
        """Return on which suite most of the answers are false, of several; all suites together hide it."""
        name = file_stem("risk-by-suite", *self.group)
        table = next((table for table in risk_tables_by_suite(leaderboard) if table.name == name), None)
        rows = () if table is None else table.rows
        own = next((row for row in rows if [cell.text for cell in row.cells[:2]] == [matcher, rejector]), None)
        if table is None or own is None:
            return ""
        cells = zip(table.columns, own.cells, strict=True)
        suites = {key[0] for key in self.book.matchers}
        shares = [(cell.key, one.name) for one, cell in cells if one.name in suites and cell.key is not None]
        share, suite = max(shares, default=(math.nan, ""))
        return f", on {suite} {number_text(share)}" if len(shares) > 1 else ""

    def _refusal(self, acceptance: pd.DataFrame, matcher: str, rejector: str) -> str:
        """Return how many absent places a rejector refuses; "" if it gives no chances, or no place is absent."""
        track, prior_group = self.group
        for row in records_of(acceptance):
            pair = (row["matcher"], row["rejector"], row["track"], row["prior_group"])
            kind = (row["absence"], row["mixture"], row["cost_ratio"])
            if pair == (matcher, rejector, track, prior_group) and kind == (EVERY, AS_DRAWN, SHOWN_RATIO):
                accepted = [float(row[f"absent_accepted{end}"]) for end in ("", "_hi", "_lo")]
                refused, lo, hi = (1.0 - share for share in accepted)
                return (
                    f"Where a false fix costs {SHOWN_RATIO:g} times as much as no fix, it refuses "
                    f"{interval_text(refused, lo, hi)} of {counted(int(row['absent']), 'absent place')}, and answers "
                    f"{number_text(float(row['right_present']))} of the others, and rightly."
                )
        return ""


def overviews_of(book: Book) -> tuple[Overview, ...]:
    """Return the overviews of a board, those of more suites that somebody is ranked on first."""
    groups: dict[tuple[str, ...], list[Key]] = {}
    for key in sorted(book.matchers, key=lambda key: (-len(_ranked(book, key)), key)):
        if any(_main(book, key, name) for name in book.matchers[key]):
            groups.setdefault(key[1:], []).append(key)
    found = []
    for keys in groups.values():
        few = [key for key in keys if _is_few(book, key)]
        found.append(Overview(book=book, keys=tuple(key for key in keys if key not in few), few=tuple(few)))
    return tuple(sorted(found, key=lambda item: (-len(item.keys), item.group)))


def overview_lines(item: Overview) -> Iterator[str]:
    """Yield the sentences of an overview for a terminal."""
    yield from (f"{one.family}: {one.text}." for one in item.headlines)
    if item.few:
        yield f"Too few to rank: {item.few_text}."
    yield from item.added


# --- sentences --------------------------------------------------------------------------------------------------------


def _main(book: Book, key: Key, name: str) -> Record | None:
    return book.main(key, name, primary_of(key[1]).name)


def _ranked(book: Book, key: Key) -> list[Record]:
    """Return the rows of ranked entries, the highest figure first."""
    rows = (_main(book, key, name) for name in book.matchers[key] if not book.is_set_apart(name))
    found = [row for row in rows if row is not None and is_ranked(row)]
    return sorted(found, key=lambda row: (-float(row["value"]), str(row["matcher"])))


def _first_of(book: Book, key: Key, metric: str) -> Record | None:
    """Return a figure of the queries alone, which all entries share."""
    return next(filter(None, (book.main(key, name, metric) for name in book.matchers[key])), None)


def _size(book: Book, key: Key) -> tuple[int, int]:
    """Return how many queries, or flights, the first figure counts, and in how many places."""
    rows = filter(None, (_main(book, key, name) for name in book.matchers[key]))
    return _count(book, key, primary_of(key[1]).name), max((int(row["places"]) for row in rows), default=0)


def _is_few(book: Book, key: Key) -> bool:
    n, places = _size(book, key)
    return n < LEAST_QUERIES or places < LEAST_SHOWN_PLACES


def _standing(book: Book, key: Key) -> str:
    """Return who shares the first rank, and who is behind."""
    ranked = _ranked(book, key)
    if not ranked:
        if book.controls.issuperset(book.matchers[key]):
            return "asked of controls alone"
        _, places = _size(book, key)
        why = f": {counted(places, 'place')}, {LEAST_PLACES} are needed" if places < LEAST_PLACES else ""
        return f"nobody is ranked{why}"
    values = {str(row["matcher"]): number_text(row["value"]) for row in ranked}
    first = [str(row["matcher"]) for row in ranked if int(row["rank_best"]) == 1]
    behind = [name for name in values if name not in first]
    if len(ranked) == 1:
        return f"{first[0]} ({values[first[0]]}) is ranked without a rival"
    if len(first) == 1:
        alone = next(row for row in ranked if row["matcher"] == first[0])["rank_worst"] == 1
        text = f"{first[0]} ({values[first[0]]}) {'has the first rank alone' if alone else 'alone may be first'}"
    else:
        ends = dict.fromkeys((values[first[-1]], values[first[0]]))
        count = ("both" if len(first) == 2 else f"all {len(first)}") if not behind else str(len(first))
        text = f"{count} share the first rank ({' to '.join(ends)}): {_names(first)}"
    if not behind:
        return text
    # Ranks are of pairs: who is behind one of those that share the first rank need not be behind each.
    if len(first) > 1:
        return f"{text}; behind at least one: {_names(behind)}"
    return f"{text}; {_names(behind)} {'is' if len(behind) == 1 else 'are'} behind"


def _names(names: Sequence[str]) -> str:
    """Return some names, the first few of many.

    >>> _names(["a", "b", "c", "d"]), _names(list("abcde"))
    ('a, b, c and d', 'a, b, c and 2 more')
    """
    more = len(names) - _MOST_NAMES
    return _listed(names if more <= 1 else [*names[:_MOST_NAMES], f"{more} more"])


def _listed(texts: Sequence[str]) -> str:
    return " and ".join(filter(None, (", ".join(texts[:-1]), texts[-1])))


def _compared(book: Book, keys: Sequence[Key], name: str) -> str:
    """Return how an entry compares with the highest figure among the others; "" where nobody can be compared."""
    for key in keys:
        ranked = {str(row["matcher"]): row for row in _ranked(book, key)}
        mine, other = ranked.pop(name, None), next(iter(ranked.values()), None)
        if mine is None or other is None:
            continue
        is_apart = mine["rank_best"] > other["rank_worst"] or other["rank_best"] > mine["rank_worst"]
        verdict = "their ranks do not meet" if is_apart else "they share ranks, so neither is shown to be better"
        mine_text, other_text = (f"{number_text(row['value'])}, rank {rank_text(row)}" for row in (mine, other))
        return f"Added here: {name} on {key[0]} ({mine_text}) against {other['matcher']} ({other_text}): {verdict}."
    return ""


# --- the table --------------------------------------------------------------------------------------------------------


def _matrix(book: Book, keys: Sequence[Key], stem: str, title: str, *, has_ranks: bool = True) -> Table:
    """Return a table of success: a matcher a line, a suite a column, in the order of the first, controls below.

    Columns of false fixes at absent places follow those of the suites. The first lines say of each suite how many
    queries count, what can be reached, and what guessing reaches. Ties are those of the first suite. A cell leads where
    its rank may be the first of several.
    """
    if not keys:
        return Table(name=stem, title=title, columns=(), rows=())
    track, prior_group = keys[0][1:]
    primary = primary_of(track).name
    names = sorted({name for key in keys for name in book.matchers[key]})
    by_suite = {key: {name: _main(book, key, name) for name in names} for key in keys}
    rivals = {key: len(_ranked(book, key)) if has_ranks else 0 for key in keys}
    absent = [key for key in keys if any(book.pick(key, name, FALSE_ABSENT.name) for name in names)]
    found = {name: own for name in names if any(own := [by_suite[key][name] for key in keys])}
    order = sorted(found, key=lambda name: (name in book.controls, *map(_descending, found[name]), name))
    limits = [(key, name) for key in keys for name in book.asked(track)]
    rows = _heads(book, keys, absent, primary, empty=len(limits))
    tones = _tones(_ranked(book, keys[0])) if has_ranks else {}
    for name in order:
        tone = "foot" if name in book.controls else tones.get(name, "plain")
        cells = [
            short_cell(by_suite[key][name], is_rivalled=rivals[key] > 1, has_rank=tone == "foot" or has_ranks)
            for key in keys
        ]
        cells += [short_cell(book.pick(key, name, FALSE_ABSENT.name), has_rank=False) for key in absent]
        cells += [short_cell(book.main(key, name, limit), has_rank=False) for key, limit in limits]
        rows.append(Row(cells=(book.short_name(name), *cells), tone=tone))
    columns = (
        *(
            replace(_suite_column(book, key, primary, has_absent=key in absent), order="none" if at else "descending")
            for at, key in enumerate(keys)
        ),
        *(column("false fixes", title=f"{key[0]}: false fixes") for key in absent),
        *(replace(book.column(limit), name=limit if len(keys) == 1 else f"{key[0]}: {limit}") for key, limit in limits),
    )
    return Table(
        name=stem,
        title=f"{title}, {track}, {prior_words(prior_group)}",
        columns=(word("matcher"), *columns),
        rows=tuple(rows),
        notes=tuple(_notes(primary, rows, has_absent=bool(absent), has_several=len(keys) > 1)),
    )


def _descending(row: Record | None) -> float:
    """Return the sort key of a figure: the highest first, none last."""
    return math.inf if row is None or math.isnan(row["value"]) else -float(row["value"])


def _tones(ranked: Sequence[Record]) -> Mapping[str, str]:
    """Return how lines look, by matcher: those of a tie alike, neighbouring ties not."""
    looks = ("tied", "other-tie")
    return {name: looks[at % 2] for at, tie in enumerate(ties_of(ranked)) for name in tie.names}


def _suite_column(book: Book, key: Key, primary: str, *, has_absent: bool) -> Column:
    """Return the column of a suite, which says what is done in it, and what its figure pools: places on the map."""
    counted = book.counted.get(key)
    texts = (suite_words(key[0]), f"Counted, each query alike: {counted}" if counted else "")
    meaning = " ".join(filter(None, texts)).removesuffix(".")
    plain = column(primary, title=f"{key[0]}: on the map" if has_absent else key[0])
    return replace(plain, meaning=meaning or plain.meaning)


def _notes(primary: str, rows: Sequence[Row], *, has_absent: bool, has_several: bool) -> Iterator[str]:
    """Yield what the figures and the lines above the matchers are."""
    yield f"{primary}: {column(primary).meaning}. Higher is better."
    if has_several:
        yield (
            "Columns do not compare with each other: each pools all stresses of its suite, weak and strong ones, of "
            "its own places."
        )
    if has_absent:
        yield (
            f"false fixes, without a rejector: {column('false fixes').meaning}. The figure of the suite itself is of "
            "its places that are on the map."
        )
    if any(row.cells[0].text == AT_MOST for row in rows):
        yield (
            f"{AT_MOST}: what can be expected of a matcher that sees the view alone, as 1 in k where k places are the "
            "same. An oracle gets the answer and passes it."
        )


def _heads(book: Book, keys: Sequence[Key], absent: Sequence[Key], primary: str, *, empty: int) -> list[Row]:
    """Return lines above the matchers: how many queries count, and a ceiling below 1 and chance where there is one.

    Their last `empty` columns say nothing.
    """
    what = "queries"
    if keys[0][1] == SEQUENCE:
        what = "flights under stress" if any(STRESS in book.strata[key] for key in keys) else "flights"
    lines = {what: [plain_cell(_count(book, key, primary)) for key in keys]}
    beside = {what: [plain_cell(_count(book, key, FALSE_ABSENT.name)) for key in absent]}
    for title, metric in ((AT_MOST, CEILING.name), ("chance", CHANCE.name)):
        rows = [_first_of(book, key, metric) for key in keys]
        lines[title] = [number_cell(math.nan if row is None else float(row["value"])) for row in rows]
    nothing = [Cell(text="-")]
    return [
        Row(
            cells=(Cell(text=title), *cells, *beside.get(title, nothing * len(absent)), *nothing * empty),
            tone="head",
        )
        for title, cells in lines.items()
        if any(cell.text not in ("-", "1.000") for cell in cells)
    ]


def _count(book: Book, key: Key, metric: str) -> int:
    """Return how many queries count: a matcher that does not answer the track has a row of all, stressed or not.

    False fixes are of all absent places, whichever stress made them so.
    """
    pick = book.pick if metric == FALSE_ABSENT.name else book.main
    rows = [row for name in book.matchers[key] if (row := pick(key, name, metric)) is not None]
    return max(int(row["n"]) for row in [row for row in rows if row["is_applicable"]] or rows)


# --- accuracy against time --------------------------------------------------------------------------------------------


def times_frame(item: Overview) -> pd.DataFrame:
    """Return success on the first suite against latency, as `pooled_plots.draw_tradeoff` takes it, the best first.

    Figures are those of the table, latencies those of all suites of the track; who has none of these is left out.
    """
    suite, track, prior_group = key = (item.keys or item.few)[0]
    times = {
        (name, metric): float(row["value"])
        for (all_suites, tracks, _, name, stratum, metric), row in item.book.figures.items()
        if all_suites == ALL_SUITES and tracks == track and stratum == ALL and metric.startswith("latency_")
    }
    rows = [
        (
            *(suite, track, prior_group, name),
            *(row[field] for field in ("n", "blocks", "value", "lo", "hi")),
            *(times.get((name, metric), math.nan) for metric in ("latency_p50", "latency_p95")),
        )
        for name in item.book.matchers[key]
        if name not in item.book.controls and (row := _main(item.book, key, name)) is not None and row["is_applicable"]
    ]
    names = ("suites", "track", "prior_group", "matcher", "n", "blocks", "value", "lo", "hi", "latency_s", "slow_s")
    found = pd.DataFrame(rows, columns=list(names)).sort_values(["value", "matcher"], ascending=[False, True])
    return found[found["latency_s"].map(math.isfinite).astype(bool)]
