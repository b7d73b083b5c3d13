# SPDX-License-Identifier: Apache-2.0
"""Tables of matchers with a rejector: over all suites, and by the kind of absence."""

import math
from collections.abc import Iterator, Mapping
from typing import Any, Final

import pandas as pd

from sasgeo_bench.leaderboard.columns import column, prior_words, words
from sasgeo_bench.leaderboard.overview import short_cell
from sasgeo_bench.leaderboard.tables import (
    Cell,
    Record,
    Row,
    Table,
    figure_cell,
    file_stem,
    plain_cell,
    records_of,
    text_cells,
)
from sasgeo_bench.scoring.decisions import PRESENT_SHARES
from sasgeo_bench.scoring.rejection_rows import AS_DRAWN, mixture_name
from sasgeo_bench.scoring.rows import ALL_SUITES, is_unranked

_REJECTION: Final = (  # metrics of the tables of rejectors
    *("aurc", "e_aurc", "auroc", "coverage_at_risk_0.05", "risk_reached_at_0.05"),
    *("right_at_absent_0.05", "absent_reached_at_0.05", "ece", "cost_20"),
)
SHOWN_RISK: Final = 0.05
COVERED: Final = "coverage_at_risk_0.05"
REACHED: Final = "risk_reached_at_0.05"
_RISK_NOTES: Final = (
    "A matcher stands here with the rejector that orders its answers best on these very places, which flatters it.",
    "Thresholds are of other places.",
    "Rows with different n are of different queries: do not compare them. † marks Wilson's interval over sites.",
)
_BY_SUITE_NOTES: Final = (
    "One threshold for all suites: where a suite is hard, more of its answers are false.",
    "Controls and falsifiers of twins and of alias count, of which nobody can tell the two places apart.",
)
SHOWN_RATIO: Final = 20.0  # of the costs of a false fix and of withholding a right one
_MIXTURES: Final = (AS_DRAWN, *map(mixture_name, PRESENT_SHARES))


def rejection_tables(board: pd.DataFrame) -> tuple[Table, ...]:
    """Return matcher x rejector over all suites, a table for each track and prior group."""
    found = _rejection_rows(board).groupby(["track", "prior_group"], sort=True)
    return tuple(
        _rejection_table(
            part, file_stem("rejection", *map(str, key)), f"Rejection: {key[0]}, {prior_words(str(key[1]))}"
        )
        for key, part in found
    )


def risk_tables(board: pd.DataFrame) -> tuple[Table, ...]:
    """Return what ranked matchers answer where 5 % of the answers may be false, a table for each track and prior group.

    A line is a matcher with the rejector that orders its answers best, by their area; `rejection_tables` have them all.
    """
    found = (_risk_table(best, *named) for best, _, *named in _groups(board, "risk"))
    return tuple(table for table in found if table.rows)


def risk_tables_by_suite(board: pd.DataFrame) -> tuple[Table, ...]:
    """Return how many of the answers of `risk_tables` are false where more places are absent, and in each suite."""
    found = (_risk_by_suite(best, part, *named) for best, part, *named in _groups(board, "risk-by-suite"))
    return tuple(table for table in found if table.rows)


Best = Mapping[tuple[str, str], Mapping[str, Record]]  # figures by matcher and rejector, then by metric


def _groups(board: pd.DataFrame, stem: str) -> Iterator[tuple[Best, pd.DataFrame, str, str]]:
    """Yield by track and prior group the best pairs, the rows of all, the name of a table, and what it is of."""
    rows = board[(board["rejector"] != "") & ~board["matcher"].map(is_unranked).astype(bool)]
    for (track, prior_group), part in rows.groupby(["track", "prior_group"], sort=True):
        where = f"{track}, {prior_words(str(prior_group))}"
        yield _best_pairs(_rejection_rows(part)), part, file_stem(stem, str(track), str(prior_group)), where


def _best_pairs(part: pd.DataFrame) -> Best:
    """Return the figures of each matcher with the rejector of the least area, in the order of that area."""
    found = {(str(key[0]), str(key[1])): _by_metric(mine) for key, mine in part.groupby(["matcher", "rejector"])}
    order = sorted((_area(by_name), key) for key, by_name in found.items())
    best: dict[str, tuple[str, str]] = {}
    for area, key in order:
        if area < math.inf:
            best.setdefault(key[0], key)
    return {key: found[key] for key in best.values()}


def _risk_table(best: Best, name: str, where: str) -> Table:
    rows = [
        Row(
            cells=(
                *text_cells(*key),
                *(figure_cell(by_name.get(metric)) for metric in (COVERED, REACHED)),
                Cell(text=_kept(by_name.get(REACHED))),
                plain_cell(int(by_name["aurc"]["n"])),
            )
        )
        for key, by_name in best.items()
    ]
    figures = (column(COVERED, title="answered"), column(REACHED, title="false of these"))
    return Table(
        name=name,
        title=f"Answers where 5 % of them may be false fixes: {where}",
        columns=(*words("matcher", "rejector"), *figures, *words("risk kept"), column("n")),
        rows=tuple(rows),
        notes=_RISK_NOTES,
    )


def _kept(row: Record | None) -> str:
    """Return whether the interval of a reached risk shows that it was kept.

    >>> [_kept({"lo": lo, "hi": hi}) for lo, hi in ((0.0, 0.04), (0.03, 0.07), (0.06, 0.2))], _kept(None)
    (['yes', 'open', 'no'], '-')
    """
    if row is None or math.isnan(row["lo"]):
        return "-"
    if row["hi"] <= SHOWN_RISK:
        return "yes"
    return "no" if row["lo"] > SHOWN_RISK else "open"


def _risk_by_suite(best: Best, part: pd.DataFrame, name: str, where: str) -> Table:
    reached = part[part["metric"] == REACHED]
    suites = sorted(set(reached["suite"]) - {ALL_SUITES})
    shares = {mixture_name(share): f"{100 * (1 - share):.0f} % of places absent" for share in PRESENT_SHARES}
    places = [(ALL_SUITES, mixture) for mixture in shares] + [(suite, AS_DRAWN) for suite in suites]
    keys = zip(*(reached[field] for field in ("matcher", "rejector", "suite", "stratum")), strict=True)
    by_key: dict[tuple[Any, ...], Any] = dict(zip(keys, reached.to_dict("records"), strict=True))
    titles = [*(shares[mixture] for mixture in shares), *suites]
    return Table(
        name=name,
        title=f"How many of these are false, by share of absent places and by suite: {where}",
        columns=(*words("matcher", "rejector"), *(column(REACHED, title=title) for title in titles)),
        rows=tuple(
            Row(
                cells=(*text_cells(*key), *(short_cell(by_key.get((*key, *place)), has_rank=False) for place in places))
            )
            for key in best
        ),
        notes=_BY_SUITE_NOTES,
    )


def _by_metric(part: pd.DataFrame) -> dict[str, Record]:
    """Return the rows of one matcher and rejector by their metric."""
    return {str(row["metric"]): row for row in records_of(part)}


def _area(by_name: Mapping[str, Record]) -> float:
    """Return the area that orders rejectors, infinite where there is none."""
    area = by_name["aurc"]["value"] if "aurc" in by_name else math.nan
    return math.inf if math.isnan(area) else float(area)


def rejection_of(board: pd.DataFrame, matcher: str) -> Table | None:
    """Return the rejectors of one matcher over all suites, every track and prior group a line; None without any."""
    rows = _rejection_rows(board)
    mine = rows[rows["matcher"] == matcher]
    return None if mine.empty else _rejection_table(mine, "rejection", "Rejection, all suites", has_queries=True)


def _rejection_rows(board: pd.DataFrame) -> pd.DataFrame:
    return board[(board["rejector"] != "") & (board["suite"] == ALL_SUITES) & (board["stratum"] == AS_DRAWN)]


def _rejection_table(part: pd.DataFrame, name: str, title: str, *, has_queries: bool = False) -> Table:
    """Return rejectors, the best first and those of controls last, whose order of answers nobody earned.

    `has_queries` adds a column of the track and prior group of each line.
    """
    rows = []
    for key, mine in part.groupby(["matcher", "rejector", "track", "prior_group"], sort=True):
        matcher, rejector, track, prior_group = map(str, key)
        by_name = _by_metric(mine)
        queries = text_cells(f"{track}, {prior_group}") if has_queries else ()
        figures = [figure_cell(by_name.get(metric)) for metric in _REJECTION]
        cells = (*text_cells(matcher, rejector), *queries, *figures, plain_cell(int(mine["n"].iloc[0])))
        is_control = is_unranked(matcher)
        row = Row(cells=cells, tone="control" if is_control else "plain")
        rows.append((is_control, _area(by_name), matcher, rejector, row))
    rows.sort(key=lambda row: row[:4])
    return Table(
        name=name,
        title=title,
        columns=(
            *words("matcher", "rejector"),
            *(words("queries") if has_queries else ()),
            *(column(metric, order="ascending" if metric == "aurc" else "none") for metric in (*_REJECTION, "n")),
        ),
        rows=tuple(row for *_, row in rows),
        notes=("ECE and costs have no interval on this board: they decide nothing.",),
    )


def acceptance_tables(acceptance: pd.DataFrame) -> tuple[Table, ...]:
    """Return risk and coverage by the kind of absence, a table for each track and prior group; none without any.

    `acceptance` is from `acceptance.acceptance_frame`. One cost ratio is shown, and no controls.
    """
    if not len(acceptance):
        return ()
    shown = acceptance[(acceptance["cost_ratio"] == SHOWN_RATIO) & ~acceptance["matcher"].map(is_unranked).astype(bool)]
    return tuple(
        _acceptance_table(part, str(track), str(prior_group))
        for (track, prior_group), part in shown.groupby(["track", "prior_group"], sort=True)
    )


def _acceptance_table(part: pd.DataFrame, track: str, prior_group: str) -> Table:
    """Return risk and coverage, who has the least risk over all absences first, and an absence a line."""
    rows: dict[tuple[str, ...], Row] = {}
    risks: dict[tuple[str, ...], float] = {}
    for names, mine in part.groupby(["matcher", "rejector", "absence"], sort=True):
        key = tuple(map(str, names))
        by_mixture = {str(row["mixture"]): row for row in records_of(mine)}
        some = next(iter(by_mixture.values()))
        absent = plain_cell(int(some["absent"]))
        cells = [_cell(by_mixture.get(mixture), name) for mixture in _MIXTURES for name in ("risk", "coverage")]
        rows[key] = Row(cells=(*text_cells(*key), absent, *cells))
        if AS_DRAWN in by_mixture and not math.isnan(by_mixture[AS_DRAWN]["risk"]):
            risks[key] = float(by_mixture[AS_DRAWN]["risk"])
    order = sorted(rows, key=lambda key: (risks.get((*key[:2], "all"), math.inf), key))
    titles = [
        (term, f"{term.split()[0]}, {mixture if mixture == AS_DRAWN else f'{100 * (1 - share):.0f} % absent'}")
        for mixture, share in zip(_MIXTURES, (math.nan, *PRESENT_SHARES), strict=True)
        for term in ("risk of fixes", "coverage")
    ]
    return Table(
        name=file_stem("acceptance", track, prior_group),
        title=f"Risk and coverage by kind of absence: {track}, {prior_words(prior_group)}",
        columns=(
            *words("matcher", "rejector", "absence"),
            column("absent"),
            *(column(term, title=title) for term, title in titles),
        ),
        rows=tuple(rows[key] for key in order),
        notes=(f"Fixes accepted by Eq. 14 at costs of {SHOWN_RATIO:g} to 1; acceptance.parquet holds other costs.",),
    )


def _cell(row: Mapping[Any, Any] | None, name: str) -> Cell:
    if row is None:
        return figure_cell(None)
    value, lo, hi = (float(row[f"{name}{end}"]) for end in ("", "_lo", "_hi"))
    return figure_cell({"value": value, "lo": lo, "hi": hi, "unit": "1", "interval": "", "is_applicable": True})
