# SPDX-License-Identifier: Apache-2.0
"""A leaderboard as Markdown and as lines for a terminal; the parquet is the master, these say a part of it."""

import math
from collections.abc import Iterator, Mapping, Sequence
from typing import Any, Final

import pandas as pd

from sasgeo_bench.errors import counted, named
from sasgeo_bench.leaderboard.reproduction import SEEDS_NOTE, seed_lines, seed_table
from sasgeo_bench.regions.region import ATTRIBUTION
from sasgeo_bench.scoring.compare import LEAST_BLOCKS, RankInterval
from sasgeo_bench.scoring.contrasts import Finding
from sasgeo_bench.scoring.controls import Verdict, verdict_frame
from sasgeo_bench.scoring.falsifiers import Falsifier
from sasgeo_bench.scoring.integrity import AS_DRAWN
from sasgeo_bench.scoring.metrics import ANSWERED, CHANCE, FALSE_ABSENT, WITHIN, primary_of
from sasgeo_bench.scoring.rows import ALL_SUITES, RUN_HERE, is_apart, is_unranked
from sasgeo_bench.scoring.steps import GROUP
from sasgeo_bench.scoring.strata import ALL, CONTROL, STRESS
from sasgeo_bench.texts import markdown, markdown_item

_INTEGRITY: Final = (
    "aurc",
    "coverage_at_risk_0.05",
    "risk_reached_at_0.05",
    "brier",
    "ece",
    "cost_20",
    "cost_20_place",
)
_COSTS: Final = (
    *("latency_p50", "latency_p95", "prepare", "peak_memory"),
    *("map_per_km2", "cpu_per_fix", "observation_per_fix"),
)
DAGGER: Final = "†"  # of an interval that Wilson's reaches beyond the draws
_PRIOR_ALONE: Final = "prior_centre"
_FEW_BLOCKS, _FEW_PLACES = 36, 12  # fewer are too few to speak of other places


def tables_of(board: pd.DataFrame) -> Iterator[tuple[str, pd.DataFrame]]:
    """Tables for people, each with its title: words instead of numbers, best matcher first.

    Parameters
    ----------
    board : pandas.DataFrame
        From `scoring.tables.leaderboard`, with whatever rows were added to it.

    Yields
    ------
    tuple of str, pandas.DataFrame
        One for each suite, track and prior group; then rejectors, then costs; at last the same of what is set apart.
    """
    apart = is_apart(board)
    yield from _tables_of(board[~apart])
    for title, table in _tables_of(board[apart]):
        yield f"Set apart: {title}", table


def _tables_of(board: pd.DataFrame) -> Iterator[tuple[str, pd.DataFrame]]:
    means = board[(board["rejector"] == "") & (board["suite"] != ALL_SUITES)]
    for (suite, track, prior_group), part in means.groupby(["suite", "track", "prior_group"], sort=True):
        primary = primary_of(str(track)).name
        if (part["metric"] == primary).any():  # a suite of absent places alone has no place to be right at
            title = f"{suite}, {track}, prior group {prior_group}{_for_nothing(part, primary)}"
            yield title, _suite_table(part, primary)
    judged = board[(board["rejector"] != "") & (board["suite"] == ALL_SUITES) & (board["stratum"] == AS_DRAWN)]
    for (track, prior_group), part in judged.groupby(["track", "prior_group"], sort=True):
        yield f"Rejection, {track}, prior group {prior_group}, all suites", _judged_table(part)
    costs = board[(board["rejector"] == "") & (board["suite"] == ALL_SUITES)]
    if len(costs):
        yield "Costs", _cost_table(costs)


def _for_nothing(part: pd.DataFrame, primary: str) -> str:
    """What the prior alone and guessing are worth, for a title: nobody's merit, and so said beside every group."""
    told = {
        "the prior alone": _main(part[part["matcher"] == _PRIOR_ALONE], primary),
        "chance": _main(part, CHANCE.name),
    }
    words = [f"{name}: {number_text(row['value'])}" for name, row in told.items() if row is not None]
    return f" ({', '.join(words)})" if words else ""


def _main(rows: pd.DataFrame, metric: str) -> pd.Series | None:
    """The row of a figure under stress, or of all where there is no stress."""
    row = _pick(rows, metric, STRESS)
    return _pick(rows, metric, ALL) if row is None else row


def _suite_table(part: pd.DataFrame, primary: str) -> pd.DataFrame:
    """A matcher a line, by what it reaches under stress."""
    rows = []
    for matcher, mine in part.groupby("matcher", sort=True):
        main = _main(mine, primary)
        if main is None:
            continue
        control, absent = _pick(mine, primary, CONTROL), _pick(mine, FALSE_ABSENT.name, ALL)
        near = _pick(mine, WITHIN.name, str(main["stratum"]))
        rows.append(
            {
                "matcher": matcher,
                "how": main.get("how", RUN_HERE),
                primary: figure_text(main) if main["is_applicable"] else "not applicable",
                "rank": rank_text(main),
                WITHIN.name: "-" if near is None else figure_text(near),
                "control": "-" if control is None else figure_text(control),
                "false fixes": "-" if absent is None else figure_text(absent),
                "detectable": number_text(main["detectable"]),
                "n": str(main["n"]),
                "missing": str(main["missing"]),
                "blocks": f"{main['blocks']} in {counted(main['places'], 'place')}",
                "_key": -math.inf if math.isnan(main["value"]) else main["value"],
            }
        )
    table = pd.DataFrame(rows).sort_values(["_key", "matcher"], ascending=[False, True], kind="stable")
    empty = [name for name in (WITHIN.name, "false fixes") if (table[name] == "-").all()]
    return _without_how(table.drop(columns=["_key", *empty]))


def _without_how(table: pd.DataFrame) -> pd.DataFrame:
    """The table as it is, or without a column that says of all rows that we ran the code and no more."""
    return table.drop(columns="how") if (table["how"] == RUN_HERE).all() else table


def _pick(rows: pd.DataFrame, metric: str, stratum: str) -> pd.Series | None:
    found = rows[(rows["metric"] == metric) & (rows["stratum"] == stratum)]
    return None if found.empty else found.iloc[0]


def _judged_table(part: pd.DataFrame) -> pd.DataFrame:
    rows = []
    for (matcher, rejector), mine in part.groupby(["matcher", "rejector"], sort=True):
        by_name = {str(row["metric"]): row for _, row in mine.iterrows()}
        row = {"matcher": matcher, "rejector": rejector}
        row |= {name: figure_text(by_name[name]) if name in by_name else "-" for name in _INTEGRITY}
        rows.append(row | {"n": str(mine["n"].iloc[0]), "_key": by_name["aurc"]["value"]})
    table = pd.DataFrame(rows).sort_values(["_key", "matcher", "rejector"], kind="stable")
    return table.drop(columns="_key")


def _cost_table(part: pd.DataFrame) -> pd.DataFrame:
    rows = []
    for matcher, mine in part.groupby("matcher", sort=True):
        row = {"matcher": matcher}
        for _, one in mine.iterrows():
            if one["metric"] in _COSTS:
                name = one["metric"] if one["track"] == "all" else f"{one['metric']}, {one['track']}"
                row[f"{name} ({one['unit']})"] = number_text(one["value"])
        rows.append(row)
    return pd.DataFrame(rows).fillna("-")


def figure_text(row: pd.Series | Mapping[str, Any]) -> str:
    """A figure with its interval, as in "0.63 [0.55, 0.70]"; a dagger where that is Wilson's."""
    mark = DAGGER if row["interval"] == "wilson" else ""
    return interval_text(row["value"], row["lo"], row["hi"]) + mark


def interval_text(value: float, lo: float, hi: float) -> str:
    """A figure with the ends of its interval, alone where it has none.

    Examples
    --------
    >>> interval_text(0.63, 0.55, 0.7), interval_text(0.63, math.nan, math.nan)
    ('0.630 [0.550, 0.700]', '0.630')
    """
    return number_text(value) if math.isnan(lo) else f"{number_text(value)} [{number_text(lo)}, {number_text(hi)}]"


def number_text(value: float) -> str:
    """Three digits that say something; "-" where there is no number."""
    if math.isnan(value):
        return "-"
    if math.isinf(value):
        return "inf"
    return f"{value:.3f}" if abs(value) < 10 else f"{value:.1f}"  # noqa: PLR2004 - a digit less from ten on


def tally_text(value: float) -> str:
    """A count, or what is expected of one, never as a power of ten.

    Examples
    --------
    >>> tally_text(3072.0), tally_text(3.0), tally_text(0.13636)
    ('3072', '3', '0.136')
    """
    return f"{value:.3g}" if abs(value) < 100 else f"{value:.0f}"  # noqa: PLR2004 - three digits either way


def rank_text(row: pd.Series | Mapping[str, Any]) -> str:
    """A rank or ranks that cannot be told apart; controls have none, nor has what is set apart."""
    if pd.isna(row["rank_best"]):
        is_beside = pd.notna(row.get("set_apart"))
        return "control" if is_unranked(row["matcher"]) else "set apart" if is_beside else "-"
    return RankInterval(best=int(row["rank_best"]), worst=int(row["rank_worst"])).text


def warnings_of(board: pd.DataFrame) -> list[str]:
    """What a reader must know before reading on."""
    said = []
    if len(board):
        blocks, places = int(board["blocks"].max()), int(board["places"].max())
        if blocks < _FEW_BLOCKS or places < _FEW_PLACES:
            said.append(
                f"{counted(blocks, 'block')} in {counted(places, 'place')}: fewer than {_FEW_BLOCKS} in {_FEW_PLACES}, "
                "so intervals speak of these places and little of others."
            )
        # Between them these two count every query once: present places, and absent ones.
        whole = board[board["metric"].isin((ANSWERED.name, FALSE_ABSENT.name)) & (board["stratum"] == ALL)]
        for matcher, count in whole.groupby("matcher")["missing"].sum().items():
            if count:
                rest = "has no row and counts as a miss" if count == 1 else "have no row and count as misses"
                said.append(f"{matcher}: {counted(count, 'query', 'queries')} {rest}.")
    return said


_NOTE: Final = (
    "Intervals are 95 %: a bootstrap over blocks, then sites ({draws} draws), and never narrower than Wilson's of as "
    f"many trials as there are sites; {DAGGER} marks those that Wilson's reaches farther out. "
    "A rank is an interval: matchers that share one cannot be told apart. Nothing is ranked across prior groups. "
    "What each column says is told at the end."
)
_TERMS: Final = {  # docs/scoring.md says the same at more length
    "success_25m, recall_1": "share of the stressed queries whose pose is within 25 m and 5 deg; whose first candidate "
    "is the right one, ties counted in proportion. Without an answer a query is a miss",
    "within_25m": "the same as success_25m whatever the heading: what counts as a fix that is not false",
    "control": "the same figure at the same places without the stress; under `rank`, a matcher that is no rival",
    "false fixes": "share of absent places that were answered",
    DAGGER: "Wilson: of a few sites, or where all answers are right, draws alone would be too narrow",
    "-": "nothing to tell: no such query, no rank, nobody to compare with",
    "the prior alone": "in a title, what `prior_centre` reaches, which looks at nothing: it answers with the middle of "
    "the prior's disc, or of the map without one; of candidates with the one nearest to the middle of all",
    "chance": "in a title, what guessing among the candidates reaches",
    "rank": "ranks a matcher can have, all pairs at once; `-` where there are fewer than "
    f"{LEAST_BLOCKS} blocks: they rank nobody, as they decide no contrast",
    "how": "`run here`: we ran the code, on queries of a public seed, which code can draw again; `reproduced`: on a "
    "private seed of 128 bits too, where no figure is shown to be worse; `not reproduced`: where one is; "
    "`as submitted`: the answers came from its author, and nobody else ran it",
    "set apart": "in no rank, for a place that it was trained on is among those it is tested on",
    "detectable": "least difference from the best other matcher that these queries would show; inf where none would, "
    "`-` where nobody is ranked",
    "n, missing, blocks": "queries counted; those of them without a row; pieces of ground they come from, which are "
    "what intervals count",
    "prior group": "what is known before: radius in m (rnone: anywhere), heading known to 5, 20 or 360 deg, scale in %",
    "contrast, first, second, difference": "a pair that was named before anything was run; what each reaches; the "
    "first less the second, on the same queries",
    "p (Holm)": "chance of a difference as large if there were none, counting blocks, adjusted by Holm for how many "
    "contrasts were registered",
    "discordant": "queries that only the first method got right, and only the second",
    "verdict": "which is better at 5 %; `null` where neither is shown to be, with or without ruling out a difference "
    f"that matters; `not decided` with fewer than {LEAST_BLOCKS} blocks",
    "rejector": "says of each answer how likely it is false; `own` is the matcher's own confidence, fitted to nothing",
    "aurc": "mean share of false fixes (beyond 25 m, whatever the heading, on both tracks) among the "
    "surest 1, 2, ..., all queries; lower is better",
    "coverage_at_risk_0.05, risk_reached_at_0.05": "share of queries accepted by the threshold that kept false fixes "
    "at 5 % on other places, and the share of false fixes among them here",
    "brier, ece": "how far the stated chances are from what came true: mean square; mean distance by bins of equal "
    "mass. `-`, as of the costs, for a rejector that keeps an order and states no chances",
    "cost_20, cost_20_place": "mean cost of a query if a fix is accepted where its chance to be false is below "
    "1 / (1 + 20) and a false fix costs 20: withheld right fixes cost 1 each, or every present place without an "
    "accepted fix does. By the first compare rejectors on one matcher, by the second whole methods. "
    "Where there is no answer the first is 0, for nothing right was withheld",
    "latency, prepare, peak_memory, cpu_per_fix": "of `match` alone; of a map once; of all its processes; processor "
    "seconds of all queries over answered ones",
    "map_per_km2, observation_per_fix": "files of the maps and what the matcher added to them over the mapped area; "
    "views of all queries, packed and not compressed, over answered ones (1 kB = 1000 bytes, 1 MB = 10^6)",
}


def control_lines(verdicts: Sequence[Verdict]) -> list[str]:
    """Whether the controls of a board held, failures one by one.

    Examples
    --------
    >>> control_lines([])
    ['Controls: none were drawn for this board, so nothing vouches for it (a pipeline draws them).']
    """
    if not verdicts:
        return ["Controls: none were drawn for this board, so nothing vouches for it (a pipeline draws them)."]
    failed = [item.to_text() for item in verdicts if not item.holds]
    if not failed:
        return [f"Controls: all {len(verdicts)} held."]
    return [f"CONTROLS FAILED, {len(failed)} of {len(verdicts)}: do not trust this board.", *failed]


def training_lines(about: Mapping[str, Any]) -> list[str]:
    """Whose rows are set apart, and who of a board has learnt from which places.

    Examples
    --------
    >>> said = {"file": "learned/ab.json", "trained_on": ["monaco", "porto"], "pairs": 24, "asked": ["clean/vaduz"]}
    >>> training_lines({"entries": [{"name": "mine", "learned": [said]}]})
    ['mine: for 1 task (clean/vaduz) learnt from 24 queries of 2 places (monaco, porto).']
    """
    apart = [
        f"{entry['name']} is set apart: {entry['set_apart']}. It is in no rank; its figures stand in tables apart."
        for entry in about.get("entries", ())
        if entry.get("set_apart")
    ]
    return apart + [
        f"{entry['name']}: for {named(one['asked'], 'task')} {'learnt' if one['file'] else 'could not learn'} from "
        f"{counted(one['pairs'], 'query', 'queries')} of {named(one['trained_on'], 'place')}."
        for entry in about.get("entries", ())
        for one in entry.get("learned", ())
    ]


def board_markdown(
    board: pd.DataFrame,
    about: Mapping[str, Any],
    findings: Sequence[Finding] = (),
    falsifiers: Sequence[Falsifier] = (),
    verdicts: Sequence[Verdict] = (),
    steps: pd.DataFrame | None = None,
    ages: Mapping[tuple[Any, ...], str] | None = None,
) -> str:
    """The board as a document; `steps` are those of `steps.steps_frame`, `ages` of `plot_tables.age_names`."""
    lines = [
        f"# Board: scorer version {about['scorer_version']}, task version {about['task_version']}",
        "",
        f"Made by {markdown(about['made_by'])}. Split: {markdown(about['split'] or 'none')}. Data: {ATTRIBUTION}.",
        "",
        _NOTE.format(draws=about["draws"]),
        "",
        *(
            f"- {markdown_item(line)}"
            for line in (*control_lines(verdicts), *seed_lines(about), *warnings_of(board), *training_lines(about))
        ),
        *(
            f"- {markdown_item(f'Failed, and not on this board: {name}: {why}')}"
            for name, why in about.get("failed", {}).items()
        ),
        "",
    ]
    seeds = seed_table(about)
    if len(seeds):
        lines += ["## Public and private seed", "", SEEDS_NOTE, "", *markdown_table(seeds), ""]
    if findings:
        lines += ["## Registered contrasts", "", *markdown_table(finding_table(findings)), ""]
    if falsifiers:
        lines += ["## Falsifiers", "", _FALSIFIERS_NOTE, "", *markdown_table(falsifier_table(falsifiers)), ""]
    for title, table in tables_of(board):
        lines += [f"## {markdown(title)}", "", *markdown_table(table), ""]
    for title, table in step_tables(steps, ages) if steps is not None else ():
        lines += [f"## {markdown(title)}", "", *markdown_table(table), ""]
    if verdicts:
        lines += ["## Controls", "", _CONTROLS_NOTE, "", *markdown_table(control_table(verdicts)), ""]
    lines += ["## How to read", "", *(f"- **{term}**: {meaning}." for term, meaning in _TERMS.items()), ""]
    return "\n".join(lines)


def step_tables(
    steps: pd.DataFrame, ages: Mapping[tuple[Any, ...], str] | None = None
) -> Iterator[tuple[str, pd.DataFrame]]:
    """Success along each ladder of strengths, each with its title: a matcher a line, a step a column.

    Parameters
    ----------
    steps : pandas.DataFrame
        From `steps.steps_frame`.
    ages : mapping, optional
        From `plot_tables.age_names`: steps that are ages of a map are named by the ages that their maps have.

    Yields
    ------
    tuple of str, pandas.DataFrame
        Figures with intervals; strength 0 is the control.
    """
    named = ages or {}
    for key, part in steps.groupby([*GROUP, "kind", "strength_unit"], sort=True):
        suite, track, prior_group, kind, unit = map(str, key)
        most = part.groupby(["view_cells", "strength"], sort=True)["n"].max().reset_index()
        counts = list(zip(most["view_cells"], most["strength"], most["n"], strict=True))
        rows = []
        for matcher, mine in part.groupby("matcher", sort=True):
            at = {(row["view_cells"], row["strength"]): row for _, row in mine.iterrows()}
            cells = {
                f"{named.get((*key[:3], strength, size), f'{strength:g}')}, {size} cells, n = {n}": figure_text(
                    at[size, strength]
                )
                if (size, strength) in at
                else "-"
                for size, strength, n in counts
            }
            rows.append({"matcher": str(matcher), **cells, "_key": -mine["value"].mean()})
        table = pd.DataFrame(rows).sort_values(["_key", "matcher"], kind="stable").drop(columns="_key")
        yield f"{suite}, {track}, prior group {prior_group}, step by step: {kind} ({unit})", table


_FALSIFIERS_NOTE: Final = (
    "The arms of each contrast where what should separate them is taken away: at the same places without the stress "
    "(`control`), and on the falsifiers of each suite. What the first arm gains here as well is not owed to what the "
    "contrast is named for."
)
_CONTROLS_NOTE: Final = (
    "Queries whose right score is known beforehand. At chance: views of a shuffled map, of a map turned by half, and "
    "of one of two places that are the same; `expected` is what guessing among the candidates or in the prior's disc "
    "is worth, `p` the chance of finding as many or more by it (a control fails below 0.0001)."
)


def control_table(verdicts: Sequence[Verdict]) -> pd.DataFrame:
    """Verdicts in words."""
    table = verdict_frame(verdicts)
    words = {name: table[name].map(tally_text) for name in ("found", "expected")}
    p, holds = table["p"].map(number_text), table["holds"].map({True: "held", False: "FAILED"})
    return table.assign(**words, p=p, holds=holds).rename(columns={"holds": "verdict"})


def finding_table(findings: Sequence[Finding]) -> pd.DataFrame:
    """Registered contrasts in words."""
    rows = [
        {
            "contrast": item.name,
            "first": f"{item.first}: {number_text(item.first_value)}",
            "second": f"{item.second}: {number_text(item.second_value)}",
            "difference": interval_text(item.difference, item.lo, item.hi),
            "p (Holm)": number_text(item.p_holm),
            "discordant": f"{item.first_only} and {item.second_only}",
            "detectable": number_text(item.detectable),
            "n": f"{item.n} in {counted(item.blocks, 'block')}",
            "verdict": item.verdict,
        }
        for item in findings
    ]
    return pd.DataFrame(rows)


def falsifier_table(found: Sequence[Falsifier]) -> pd.DataFrame:
    """Falsifiers in words."""
    rows = [
        {
            "contrast": item.contrast,
            "suite": item.suite,
            "kind": item.kind,
            "first": f"{item.finding.first}: {number_text(item.finding.first_value)}",
            "second": f"{item.finding.second}: {number_text(item.finding.second_value)}",
            "difference": interval_text(item.finding.difference, item.finding.lo, item.finding.hi),
            "discordant": f"{item.finding.first_only} and {item.finding.second_only}",
            "n": f"{item.finding.n} in {counted(item.finding.blocks, 'block')}",
            "verdict": item.verdict,
        }
        for item in found
    ]
    return pd.DataFrame(rows)


def markdown_table(table: pd.DataFrame) -> Iterator[str]:
    r"""Lines of a table of plain texts; see `texts.markdown`.

    Examples
    --------
    >>> list(markdown_table(pd.DataFrame({"matcher": ["mine 1|2"]})))[-1]
    '| mine 1\\|2 |'
    """
    yield "| " + " | ".join(map(markdown, table.columns)) + " |"
    yield "|" + "---|" * len(table.columns)
    for row in table.itertuples(index=False):
        yield "| " + " | ".join(map(markdown, row)) + " |"


def summary(board: pd.DataFrame, *, names: Sequence[str] = ()) -> Iterator[tuple[str, pd.DataFrame]]:
    """What a terminal shows: by track and prior group a matcher a line, a suite a column, figure, interval and rank.

    Parameters
    ----------
    board : pandas.DataFrame
        The leaderboard.
    names : sequence of str
        Suites to show; without any, all.
    """
    means = board[(board["rejector"] == "") & (board["suite"] != ALL_SUITES)]
    means = means[means["suite"].isin(names)] if names else means
    for (track, prior_group), part in means.groupby(["track", "prior_group"], sort=True):
        primary = primary_of(str(track)).name
        rows = []
        for matcher, mine in part.groupby("matcher", sort=True):
            row = {"matcher": str(matcher), "how": mine["how"].iloc[0] if "how" in mine else RUN_HERE}
            total = []
            for suite, one in mine.groupby("suite", sort=True):
                shown = _main(one, primary)
                if shown is not None:
                    row[_heading(str(suite), one, shown)] = _cell(shown)
                    total.append(shown["value"])
            numbers = [value for value in total if not math.isnan(value)]
            rows.append(row | {"_key": sum(numbers) / len(numbers) if numbers else -1.0})
        table = pd.DataFrame(rows).sort_values(["_key", "matcher"], ascending=[False, True], kind="stable")
        title = f"{primary} [95 %] (rank), {track}, prior group {prior_group}"
        yield title, _without_how(table.drop(columns="_key").fillna("-"))


def _heading(suite: str, rows: pd.DataFrame, shown: pd.Series) -> str:
    """A suite with its queries, and what guessing among candidates is worth."""
    chance = _main(rows, CHANCE.name)
    return f"{suite}, n = {shown['n']}" + ("" if chance is None else f", chance {number_text(chance['value'])}")


def _cell(row: pd.Series) -> str:
    """As in "0.750 [0.30, 0.95] (2-3)"."""
    if not row["is_applicable"]:
        return "n/a"
    ends = "" if math.isnan(row["lo"]) else f" [{row['lo']:.2f}, {row['hi']:.2f}]"
    return f"{number_text(row['value'])}{ends} ({rank_text(row)})"
