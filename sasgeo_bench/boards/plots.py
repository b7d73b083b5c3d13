# SPDX-License-Identifier: Apache-2.0
"""The figures of a board: each draws a table on a page, the same bytes for the same table.

Each function writes a .svg or .png; `shown` are the matchers in the order of their looks.
"""

from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np
import pandas as pd
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from sasgeo_bench.boards.tables import prior_words
from sasgeo_bench.core.canvas import GREY, Page, broken, figure_of, most_across, page, panels
from sasgeo_bench.core.errors import counted
from sasgeo_bench.regions.region import ATTRIBUTION
from sasgeo_bench.scoring.base import Floats, Ints, codes_of
from sasgeo_bench.scoring.compare import Finding
from sasgeo_bench.scoring.contrasts import Contrast, PlaceDifference
from sasgeo_bench.scoring.decisions import Fixes, aurc, equal_mass_bins, risk_coverage, stanford
from sasgeo_bench.scoring.intervals import effective_count, wilson_share
from sasgeo_bench.scoring.metrics import TRACKS, primary_of
from sasgeo_bench.scoring.protection import ProtectionLevels
from sasgeo_bench.scoring.rejection_rows import AS_DRAWN, answers_of, mixtures_of
from sasgeo_bench.scoring.rows import ALL_SUITES, is_set_apart, is_unranked
from sasgeo_bench.scoring.strata import ALL, CONTROL, GROUP, STRESS, primary_rows
from sasgeo_bench.tasks.query import SEQUENCE

MOST_MATCHERS: Final = 8  # more cannot be distinguished at a glance
ARMS: Final = ("uniform", "hand", "oracle")  # parts of names of matchers that are shown with those of contrasts
AGE: Final = "age_years"  # as measured by truths
_MOST_POINTS: Final = 80  # of a curve: more cannot be seen, and make a file large
_CELLS_PER_DECADE: Final = 8
LEAST_M: Final = 0.1  # what is less is drawn here
MOST_M: Final = 1000.0  # what is more, or infinite, is drawn beyond
BEYOND_M: Final = 1500.0


def ranked_matchers(table: pd.DataFrame) -> list[str]:
    """Return the matchers that are neither controls nor set apart, in the order of the table."""
    return [name for name in dict.fromkeys(table.loc[~is_set_apart(table), "matcher"]) if not is_unranked(name)]


def shown_matchers(table: pd.DataFrame, contrasts: Sequence[Contrast]) -> tuple[str, ...]:
    """Return the matchers that figures show, those of contrasts first, the second of each before the first.

    Controls and entries that are set apart are not shown. Of more than `MOST_MATCHERS` only those of contrasts are, or
    without contrasts the best on single views and the best on flights, and the `ARMS`.

    >>> board = pd.DataFrame({"matcher": ["b", "a", "oracle_pose"], "rejector": "", "stratum": "all", "value": 0.5})
    >>> shown_matchers(board.assign(metric="success_25m"), [Contrast(name="x", first="b", second="a", suites=())])
    ('a', 'b')
    """
    there = ranked_matchers(table)
    sides = [side.partition(" x ")[0] for item in contrasts for side in (item.second, item.first)]
    named = [name for name in dict.fromkeys(sides) if name in there]
    if len(there) <= MOST_MATCHERS:
        return tuple(dict.fromkeys((*named, *sorted(there))))
    if not named:
        flown = primary_of(SEQUENCE).name
        single = {primary_of(track).name for track in TRACKS} - {flown}
        named = [*_best(table, there, single), *_best(table, there, {flown})]
    related = sorted(name for name in there if any(part in name for part in ARMS))
    return tuple(dict.fromkeys((*named, *related)))


def _best(table: pd.DataFrame, there: Sequence[str], metrics: Collection[str]) -> list[str]:
    """Return the matchers that are best by some metrics in the mean of all suites; who has none of them is left out."""
    rows = table[(table["stratum"] == ALL) & table["metric"].isin(metrics)]
    means = rows.groupby("matcher")["value"].mean()
    return sorted((name for name in there if name in means), key=lambda name: (-means[name], name))[:MOST_MATCHERS]


# --- success by what was done -----------------------------------------------------------------------------------------


def ages_frame(steps: pd.DataFrame, queries: pd.DataFrame, measured: Mapping[str, Mapping[str, float]]) -> pd.DataFrame:
    """Return the steps that are ages of a map, with age_years, the mean over their queries, and age_least and age_most.

    `steps` is from `steps_frame`, `queries` from `queries_of`, `measured` the measurements of truths by query id.
    """
    ages = [measured.get(name, {}).get(AGE, np.nan) for name in queries["query_id"]]
    known = queries.assign(age_years=ages)
    known = known[known["age_years"].notna() & known["is_present"].to_numpy(bool)]
    known = known[known["role"].isin([CONTROL, STRESS])]
    found = known.groupby([*GROUP, "strength", "view_cells"])["age_years"].agg(["mean", "min", "max"]).reset_index()
    names = {"mean": "age_years", "min": "age_least", "max": "age_most"}
    keys = [*GROUP, "strength", "view_cells"]
    found = found.rename(columns=names).astype({name: steps[name].dtype for name in keys})  # of no steps: no type yet
    return steps.merge(found, on=keys, how="inner")


def age_names(ages: pd.DataFrame) -> dict[tuple[Any, ...], str]:
    """Return the range of ages of each step of `ages_frame`, by suite, track, prior group, strength and size of view.

    >>> step = {"suite": "real-age", "track": "localization", "prior_group": "r500-weak-s3", "strength": 5.0}
    >>> list(age_names(pd.DataFrame([step | {"view_cells": 192, "age_least": 3.58, "age_most": 6.0}])).values())
    ['3.6 to 6.0 years']
    """
    columns = [ages[name] for name in (*GROUP, "strength", "view_cells", "age_least", "age_most")]
    spans = {tuple(key): (f"{least:.1f}", f"{most:.1f}") for *key, least, most in zip(*columns, strict=True)}
    return {key: f"{' to '.join(dict.fromkeys(ends))} years" for key, ends in spans.items()}


def stress_frame(table: pd.DataFrame, shown: Sequence[str]) -> pd.DataFrame:
    """Return the rows of the primary metric on the stresses of each suite."""
    rows = table[(table["rejector"] == "") & table["matcher"].isin(list(shown)) & table["value"].notna()]
    return primary_rows(rows[rows["stratum"] == STRESS])


# --- what is known of the answers -------------------------------------------------------------------------------------


class JudgedKey(NamedTuple):
    """Whose answers, of which queries, by which rejector."""

    track: str
    prior_group: str
    matcher: str
    rejector: str


def risk_frame(judged: Mapping[tuple[str, str], pd.DataFrame], shown: Sequence[str]) -> pd.DataFrame:
    """Return risk against coverage by matcher and rejector, of each suite with absent places and of all together.

    `judged` is from `rejection.judge` and `rejection.own_confidence`. The columns are suite, track, prior_group,
    mixture, matcher, rejector, n, answered, aurc, coverage and risk: points of a curve by growing coverage. All suites
    together also come in the declared mixtures of present and absent places.
    """
    rows: list[tuple[str | float, ...]] = []
    for key, whole in _parts(judged, shown):
        for suite, part in [(ALL_SUITES, whole), *whole.groupby("suite", sort=True)]:
            is_pooled = suite == ALL_SUITES
            if is_pooled or not part["is_present"].to_numpy(bool).all():
                rows += _curves(str(suite), key, answers_of(part), is_pooled=is_pooled)
    columns = [*GROUP, "mixture", "matcher", "rejector", "n", "answered", "aurc", "coverage", "risk"]
    return pd.DataFrame(rows, columns=columns)


def _curves(suite: str, key: JudgedKey, some: Fixes, *, is_pooled: bool) -> Iterator[tuple[str | float, ...]]:
    """Yield rows of `risk_frame`."""
    for mixture, mass in mixtures_of(some, is_pooled=is_pooled):
        curve = risk_coverage(some, mass)
        about = (suite, key.track, key.prior_group, mixture, key.matcher, key.rejector)
        figures = (len(some), int(some.is_answered.sum()), aurc(some, mass))
        for at in _thinned(curve.coverage):
            yield (*about, *figures, curve.coverage[at], curve.risk[at])


def _thinned(coverage: Floats) -> Ints:
    """Return which points of a curve are drawn: all of a few, else those nearest to even steps, first and last."""
    if len(coverage) <= _MOST_POINTS:
        return np.arange(len(coverage))
    even = np.linspace(0.0, coverage[-1], _MOST_POINTS)
    return np.unique([0, len(coverage) - 1, *np.minimum(np.searchsorted(coverage, even), len(coverage) - 1)])


def reliability_frame(
    judged: Mapping[tuple[str, str], pd.DataFrame], calibrated: Collection[tuple[str, str]], shown: Sequence[str]
) -> pd.DataFrame:
    """Return how often answers are false by stated chance, over all suites of a track and prior group.

    `judged` is as for `risk_frame`, `calibrated` names the matchers and rejectors that give probabilities. The columns
    are track, prior_group, matcher, rejector, predicted, observed, lo, hi, n and sites: bins of equal mass, of the
    answers alone, with Wilson's intervals of as many trials as there are sites.
    """
    rows: list[tuple[str | float, ...]] = []
    for key, part in calibrated_parts(judged, calibrated, shown):
        answered = part[part["is_answered"].to_numpy(bool)]
        p_false = 1.0 - answered["p_right"].to_numpy(float)
        if len(answered) and not np.isnan(p_false).any():
            rows.extend((*key, *one) for one in _bins(answered, p_false))
    return pd.DataFrame(rows, columns=[*JudgedKey._fields, "predicted", "observed", "lo", "hi", "n", "sites"])


def calibrated_parts(
    judged: Mapping[tuple[str, str], pd.DataFrame], calibrated: Collection[tuple[str, str]], shown: Sequence[str]
) -> Iterator[tuple[JudgedKey, pd.DataFrame]]:
    """Yield the answers with probabilities by track and prior group, with their keys."""
    yield from _parts({key: frame for key, frame in judged.items() if key in calibrated}, shown)


def _parts(
    judged: Mapping[tuple[str, str], pd.DataFrame], shown: Sequence[str]
) -> Iterator[tuple[JudgedKey, pd.DataFrame]]:
    for (matcher, rejector), frame in judged.items():
        if matcher in shown:
            for (track, prior_group), part in frame.groupby(["track", "prior_group"], sort=True):
                yield JudgedKey(str(track), str(prior_group), matcher, rejector), part


def _bins(answered: pd.DataFrame, p_false: Floats) -> Iterator[tuple[float, ...]]:
    """Yield predicted, observed, lo, hi, n and sites of each bin."""
    is_false = ~answered["is_right"].to_numpy(bool)
    sites = codes_of(answered["pair_id"])
    at = equal_mass_bins(1.0 - p_false)
    for number in np.unique(at):
        mine = at == number
        share, trials = float(is_false[mine].mean()), effective_count(sites[mine])
        found = wilson_share(share, trials)
        predicted = float(p_false[mine].mean())
        yield predicted, share, found.lo, found.hi, int(mine.sum()), trials


# --- protection levels ------------------------------------------------------------------------------------------------


def stanford_cells(levels: ProtectionLevels) -> pd.DataFrame:
    """Count queries in cells of error_m and level_m, eight to a decade on each side; n of each middle of a cell.

    Values that exceed `MOST_M` are at `BEYOND_M`.
    """
    cells = pd.DataFrame({"error_m": _middles(levels.error_m), "level_m": _middles(levels.level_m)})
    return cells.groupby(["error_m", "level_m"]).size().rename("n").reset_index()


def _middles(values_m: Floats) -> Floats:
    """Return the middle of the cell of each value."""
    within = np.log10(np.clip(values_m, LEAST_M, MOST_M))
    step = np.minimum(np.floor(within * _CELLS_PER_DECADE), round(np.log10(MOST_M) * _CELLS_PER_DECADE) - 1)
    middles = 10 ** ((step + 0.5) / _CELLS_PER_DECADE)
    return np.asarray(np.where(values_m > MOST_M, BEYOND_M, middles))


def stanford_areas(levels: ProtectionLevels, limit_m: float) -> dict[str, int]:
    """Count queries that are available, unavailable, misleading and hazardously misleading.

    Misleading ones are those within the alert limit, so that the four add up.
    """
    areas = stanford(levels.level_m, levels.error_m, limit_m)
    return {
        "available": int(areas.nominal.sum()),
        "unavailable": int((areas.unavailable | areas.unavailable_misleading).sum()),
        "misleading": int(areas.misleading.sum()),
        "hazardous": int(areas.hazardous.sum()),
    }


# Okabe and Ito's colours without the yellow, which is too pale on white; dashes and marks differ, too.
_COLOURS: Final = ("#000000", "#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9")
_DASHES: Final = ("-", "--", "-.", ":")
_MARKS: Final = ("o", "s", "^", "D", "v", "P", "X", "*", "<", ">", "h")
FAINT: Final = "#dddddd"
BoardPage: Final = partial(Page, data=ATTRIBUTION)


@dataclass(frozen=True, slots=True, kw_only=True)
class Look:
    """Colour, dash and marker of one of several things drawn together."""

    colour: str
    dash: str
    mark: str


def look_of(number: int) -> Look:
    """Return the look of the thing of a number; no two of the first 28 have colour and dash in common."""
    return Look(
        colour=_COLOURS[number % len(_COLOURS)],
        dash=_DASHES[number % len(_DASHES)],
        mark=_MARKS[number % len(_MARKS)],
    )


def line_keys(names: Sequence[str], *, has_marks: bool = True) -> list[Line2D]:
    """Return the legend of lines of the looks 0, 1, ..."""
    looks = [(name, look_of(number)) for number, name in enumerate(names)]
    return [
        Line2D(
            [], [], color=look.colour, ls=look.dash, marker=look.mark if has_marks else "", ms=4.5, lw=1.5, label=name
        )
        for name, look in looks
    ]


PRIMARY: Final = {
    "success_25m": "success (share of queries\nwithin 25 m and 5 deg)",
    "distance_within_25m": "share of the flown distance\nwithin 25 m",
    "recall_1": "recall@1\n(share of queries)",
}
INTERVALS: Final = (
    "Bars: 95 % intervals as on the board (places, then blocks, then sites are drawn; never narrower than Wilson's "
    "over sites). n: queries of each point."
)
ACROSS: Final = 4  # panels side by side
_NAME_INCHES: Final = 2.6  # of a name next to its bar, before it is broken
HALVES: Final = (0.0, 0.5, 1.0)


def those_there(rows: pd.DataFrame, shown: Sequence[str]) -> list[str]:
    """Return the matchers that have a row, in the order of their looks."""
    return [name for name in shown if (rows["matcher"] == name).any()]


def of_which(row: Mapping[str, Any] | pd.Series) -> str:
    """Return the suite, track and prior group of a figure in words."""
    return f"{row['suite']}, {row['track']}, {prior_words(str(row['prior_group']))}"


def panels_across(count: int) -> tuple[int, int]:
    """Return rows and columns of so many panels.

    >>> panels_across(3), panels_across(9)
    ((1, 3), (3, 4))
    """
    columns = max(1, min(most_across(ACROSS), count))
    return -(-count // columns), columns


def dress_share(chart: Axes) -> None:
    """Set an axis of shares, with room below for numbers of queries."""
    chart.set_ylim(-0.13, 1.04)
    chart.set_yticks([0.0, 0.25, 0.5, 0.75, 1.0])
    chart.grid(visible=True, axis="y", color=FAINT, lw=0.6)


def draw_line(chart: Axes, mine: pd.DataFrame, at: Floats, number: int) -> None:
    """Draw the line of one matcher with an interval at each point; `at` are the places across."""
    if mine.empty:
        return
    look = look_of(number)
    value, lo, hi = (mine[name].to_numpy(float) for name in ("value", "lo", "hi"))
    chart.plot(at, value, color=look.colour, ls=look.dash, marker=look.mark, ms=4, lw=1.3)
    chart.vlines(at, lo, hi, color=look.colour, lw=0.9, alpha=0.75)


def label_outer(chart: Axes, number: int, columns: int, count: int, label: str) -> None:
    """Label the axes of a panel where no other panel stands between them and the edge."""
    is_left = number % columns == 0
    chart.tick_params(labelleft=is_left, labelbottom=number + columns >= count)
    if is_left:
        chart.set_ylabel(label)


def ticks_across(chart: Axes, ticks: Sequence[float], low: float, high: float) -> None:
    """Set a logarithmic axis across from `low` to `high`, with numbers at some ticks."""
    chart.set_xscale("log")
    chart.set_xlim(low, high)
    chart.xaxis.set_ticks(ticks, [f"{tick:g}" for tick in ticks])
    chart.xaxis.set_ticks([], minor=True)


def panel_title(chart: Axes, name: str, row: Mapping[str, Any] | pd.Series) -> None:
    """Write a name and the numbers of queries and blocks of a row above a panel."""
    chart.set_title(f"{name}\nn {row['n']:g}, {counted(int(row['blocks']), 'block')}")


def each_panel(path: Path | None, names: Sequence[str], about: Page, label: str = "") -> Iterator[tuple[Axes, str]]:
    """Yield a panel for each name, with a `label` if it stands at the edge; the page is written when all are drawn."""
    down, across = panels_across(len(names))
    with page(path, replace(about, rows=down, columns=across)) as charts:
        for number, chart in panels(charts, len(names)):
            if label:
                label_outer(chart, number, across, len(names), label)
            yield chart, names[number]


def draw_bar_panels(
    path: Path, rows: pd.DataFrame, shown: Sequence[str], column: str, values: Sequence[str], *, title: str, note: str
) -> None:
    """Draw success as bars with intervals: a panel for each value of a column, a bar for each matcher."""
    names, across = those_there(rows, shown), panels_across(len(values))[1]
    about = BoardPage(
        title=title,
        note=note,
        below=PRIMARY[primary_of(str(rows["track"].iloc[0])).name].replace("\n", " "),
        panel_inches=(1.9, 0.3 + 0.19 * len(names)),
    )
    for chart, value in each_panel(path, values, about):
        mine = rows[rows[column] == value]
        panel_title(chart, value, mine.iloc[0])
        draw_board_bars(chart, mine, names)
        if values.index(value) % across:
            chart.set_yticklabels([])


def draw_board_bars(chart: Axes, mine: pd.DataFrame, names: Sequence[str]) -> None:
    """Draw a bar with its interval for each matcher, the first on top."""
    for at, name in enumerate(names):
        for row in mine[mine["matcher"] == name].to_dict("records"):
            chart.barh(at, row["value"], height=0.72, color=look_of(at).colour, alpha=0.75)
            chart.hlines(at, row["lo"], row["hi"], color="#000000", lw=1.0)
            chart.vlines([row["lo"], row["hi"]], at - 0.18, at + 0.18, color="#000000", lw=1.0)
            chart.text(1.03, at, f"{row['value']:.2f}", fontsize=6.5, va="center")
    chart.set_yticks(range(len(names)), [broken(name, _NAME_INCHES, 8.5) for name in names])
    chart.set_ylim(len(names) - 0.4, -0.6)
    chart.set_xlim(0.0, 1.0)
    chart.set_xticks([0.0, 0.5, 1.0], ["0", "0.5", "1"])
    chart.grid(visible=True, axis="x", color=FAINT, lw=0.6)
    chart.tick_params(axis="y", length=0)


def dodged(values: Floats, number: int, count: int, *, by: float) -> Floats:
    """Shift values on a logarithmic axis a little by the number of a line, so that intervals do not hide others."""
    return np.asarray(values * (1.0 + by) ** (number - (count - 1) / 2))


_DODGE: Final = 0.011  # of an axis, between two matchers at one step


# --- success by what was done -----------------------------------------------------------------------------------------


def draw_steps(path: Path | None, rows: pd.DataFrame, shown: Sequence[str]) -> Figure:
    """Draw success against strength, from `steps_frame`: panels of kinds and view sizes, lines of matchers."""
    first = rows.iloc[0]
    note = f"Strength 0: the controls, the same places with nothing done to the view. {INTERVALS}"
    title = f"Success against strength: {of_which(first)}"
    return _draw_lines(path, rows, shown, title, note, ("strength", str(first["strength_unit"])))


def draw_ages(path: Path | None, rows: pd.DataFrame, shown: Sequence[str]) -> Figure:
    """Draw success against the age of the map from `ages_frame`, in panels and lines as in `draw_steps`."""
    note = (
        "A point stands at the mean age of the maps of its step; the grey line at the bottom shows from which to "
        f"which age they are. {INTERVALS}"
    )
    title = f"Success against the age of the map: {of_which(rows.iloc[0])}"
    return _draw_lines(path, rows, shown, title, note, ("age_years", "age of the map (years)"))


def _draw_lines(
    path: Path | None, rows: pd.DataFrame, shown: Sequence[str], title: str, note: str, axis: tuple[str, str]
) -> Figure:
    column, label = axis
    names = those_there(rows, shown)
    kinds, sizes = (sorted(set(rows[name])) for name in ("kind", "view_cells"))
    grid: list[list[tuple[str, float] | None]] = [[(kind, size) for size in sizes] for kind in kinds]
    if len(sizes) == 1:  # kinds side by side, not in a tower
        _, across = panels_across(len(kinds))
        flat = [line[0] for line in grid]
        flat += [None] * (-len(flat) % across)
        grid = [flat[at : at + across] for at in range(0, len(flat), across)]
    about = BoardPage(title=title, note=note, below=label, rows=len(grid), columns=len(grid[0]), keys=line_keys(names))
    measure = PRIMARY[primary_of(str(rows["track"].iloc[0])).name]
    high = max(1.0, float(rows[column].max()))
    with page(path, about) as charts:
        for line, keys in zip(charts, grid, strict=True):
            for chart, key in zip(line, keys, strict=True):
                mine = rows.iloc[:0] if key is None else rows[(rows["kind"] == key[0]) & (rows["view_cells"] == key[1])]
                if key is not None:
                    chart.set_title(f"{key[0]}, view of {key[1]:g} cells")
                chart.set_xlim(-0.1 * high, 1.1 * high)
                dress_share(chart)
                if chart is not line[0]:
                    chart.tick_params(labelleft=False)
                if mine.empty:  # not every kind is drawn at every size
                    chart.set_visible(False)
                for number, name in enumerate(names):
                    shift = _DODGE * high * (number - (len(names) - 1) / 2)
                    line_of = mine[mine["matcher"] == name].sort_values(column)
                    draw_line(chart, line_of, line_of[column].to_numpy(float) + shift, number)
                _write_counts(chart, mine, column)
            line[0].set_ylabel(measure)
    return figure_of(charts[0][0])


def _write_counts(chart: Axes, mine: pd.DataFrame, column: str) -> None:
    """Write the number of queries of each step at the foot of a panel."""
    for at, part in mine.groupby(column, sort=True):
        counts = sorted(set(part["n"]))
        text = f"n {counts[0]:g}" if len(counts) == 1 else f"n {counts[0]:g}-{counts[-1]:g}"
        chart.text(float(str(at)), -0.115, text, fontsize=5.5, ha="center", color=GREY)
        if column == "age_years":
            ends = part.iloc[0]
            chart.plot([ends["age_least"], ends["age_most"]], [-0.045, -0.045], color="#999999", lw=2.2)


def draw_bars(path: Path, rows: pd.DataFrame, shown: Sequence[str]) -> None:
    """Draw the success of each matcher on the stresses of each suite, from `stress_frame`, as bars with intervals."""
    first = rows.iloc[0]
    title = f"Success under stress, suite by suite: {first['track']}, {prior_words(str(first['prior_group']))}"
    note = INTERVALS.replace("each point", "each bar")
    draw_bar_panels(path, rows, shown, "suite", sorted(set(rows["suite"])), title=title, note=note)


def draw_forest(path: Path | None, contrast: Contrast, finding: Finding, places: Sequence[PlaceDifference]) -> Figure:
    """Draw a contrast place by place, from `contrasts.by_place`, and pooled below; return it as `draw_risk` does."""
    is_primary = contrast.metric == "primary"
    what = PRIMARY[primary_of(contrast.track).name].replace("\n", " ") if is_primary else contrast.metric
    better = f"{'left' if finding.is_lower_better else 'right'} of 0: {contrast.first} is better"
    least = finding.least
    labels = [f"{one.place} (n {one.n}, {counted(one.blocks, 'block')})" for one in places]
    labels.append(f"all places (n {finding.n}, {counted(finding.places, 'place')})")
    about = BoardPage(
        title=f"Contrast {contrast.name}: {contrast.first} less {contrast.second}",
        note=(
            f"Of {contrast.queries_text()}; {contrast.track}. Lines: paired 95 % intervals; those of few "
            "blocks are no narrower than by Wilson's over sites. Grey band: differences smaller than would matter, "
            f"{least:.3g} either way. The registered test is of all places together: {finding.verdict} "
            f"(adjusted p {finding.p_holm:.3g}). Single places are no tests."
        ),
        below=f"difference of {what}\n{better}",
        panel_inches=(4.6, 0.3 + 0.2 * len(labels)),
    )
    with page(path, about) as charts:
        chart = charts[0][0]
        chart.axvspan(-least, least, color="#eeeeee", lw=0)
        chart.axvline(0.0, color="#000000", lw=0.8)
        for at, one in enumerate(places):
            chart.hlines(at, one.lo, one.hi, color=look_of(1).colour, lw=1.3)
            chart.plot(one.difference, at, marker="s", color=look_of(1).colour, ms=4.5, ls="")
        foot = len(places) + 0.35
        chart.hlines(foot, finding.lo, finding.hi, color="#000000", lw=2.0)
        chart.plot(finding.difference, foot, marker="D", color="#000000", ms=6.5, ls="")
        chart.axhline(len(places) - 0.3, color=FAINT, lw=0.8)
        chart.set_yticks([*range(len(places)), foot], labels)
        chart.set_ylim(foot + 0.6, -0.7)
        drawn = [(one.lo, one.hi, one.difference) for one in places]
        drawn.append((finding.lo, finding.hi, finding.difference))
        ends = [abs(end) for three in drawn for end in three if np.isfinite(end)]
        chart.set_xlim(-1.06 * max([*ends, least]), 1.06 * max([*ends, least]))
        chart.tick_params(axis="y", length=0)
        chart.grid(visible=True, axis="x", color=FAINT, lw=0.6)
    return figure_of(chart)


# --- what is known of the answers -------------------------------------------------------------------------------------


def draw_risk(path: Path | None, rows: pd.DataFrame, shown: Sequence[str]) -> Figure:
    """Draw risk against coverage from `risk_frame`: a panel for each matcher and mixture, a line for each rejector.

    Return the figure, written where there is a path.
    """
    names, rejectors = those_there(rows, shown), sorted(set(rows["rejector"]))
    mixtures = list(dict.fromkeys(rows["mixture"]))
    there = set(zip(rows["matcher"], rows["mixture"], strict=True))
    cells = [(name, mixture) for name in names for mixture in mixtures if (name, mixture) in there]
    is_grid = 1 < len(mixtures) <= most_across(len(mixtures)) and len(cells) == len(names) * len(mixtures)
    columns = len(mixtures) if is_grid else panels_across(len(cells))[1]
    pooled = " Present 0.9: present and absent places reweighted to nine in ten present." if len(mixtures) > 1 else ""
    about = BoardPage(
        title=f"Risk against coverage: {of_which(rows.iloc[0])}",
        note=(
            "Answers are accepted from the surest down, by each rejector; what it says of a place was fitted on other "
            "places. Risk: false fixes among the accepted; coverage: accepted among all n queries, absent places among "
            f"them; a line ends where all answers are accepted.{pooled} Areas under the lines: leaderboard.md."
        ),
        below="coverage (share of queries accepted)",
        rows=-(-len(cells) // columns),
        columns=columns,
        keys=line_keys(rejectors, has_marks=False),
        panel_inches=(2.1, 1.7),
    )
    high = min(1.02, 1.08 * float(rows["risk"].max()))
    with page(path, about) as charts:
        for number, chart in panels(charts, len(cells)):
            matcher, mixture = cells[number]
            mine = rows[(rows["matcher"] == matcher) & (rows["mixture"] == mixture)]
            head = matcher if mixture == AS_DRAWN else f"{matcher}, {mixture}"
            counts = mine.drop_duplicates("rejector")[["n", "answered"]].drop_duplicates().to_numpy().tolist()
            chart.set_title(f"{head}\n{'; '.join(f'n {n}, {answered} answered' for n, answered in counts)}")
            _risk_lines(chart, mine, rejectors)
            chart.set_xlim(0.0, 1.0)
            chart.set_xticks(HALVES)
            chart.set_ylim(0.0, max(high, 0.02))
            chart.locator_params(axis="y", nbins=4)  # whatever the height, so that labels keep the width that is left
            chart.grid(visible=True, color=FAINT, lw=0.6)
            label_outer(chart, number, columns, len(cells), "risk (share of accepted)")
    return figure_of(charts[0][0])


def _risk_lines(chart: Axes, mine: pd.DataFrame, rejectors: Sequence[str]) -> None:
    for number, name in enumerate(rejectors):
        points = mine[mine["rejector"] == name]
        if points.empty:
            continue
        look = look_of(number)
        coverage, risk = points["coverage"].to_numpy(float), points["risk"].to_numpy(float)
        chart.plot(coverage, risk, color=look.colour, ls=look.dash, lw=1.3)
        if len(points) == 1:  # all answers are equally sure: one point that can be reached
            chart.plot(coverage, risk, color=look.colour, marker=look.mark, ms=4, ls="")


def draw_reliability(path: Path, rows: pd.DataFrame, shown: Sequence[str]) -> None:
    """Draw how often answers are false by stated chance, from `reliability_frame`: a panel a matcher and rejector."""
    names, rejectors = those_there(rows, shown), sorted(set(rows["rejector"]))
    first = rows.iloc[0]
    about = BoardPage(
        title=f"Reliability of P(false fix): {ALL_SUITES}, {first['track']}, {prior_words(str(first['prior_group']))}",
        note=(
            "Answers alone, in at most ten bins of equally many; equal P share a bin. n: answers; next to a point, "
            "where there is room, those of its bin. Lines: Wilson's 95 % intervals of as many trials as the bin has "
            "sites. On the diagonal answers are false as often as stated; above it more often."
        ),
        below="stated to be false (P, mean of the bin)",
        rows=len(names),
        columns=len(rejectors),
        panel_inches=(2.0, 1.9),
    )
    with page(path, about) as charts:
        for line, name in zip(charts, names, strict=True):
            for chart, rejector in zip(line, rejectors, strict=True):
                mine = rows[(rows["matcher"] == name) & (rows["rejector"] == rejector)]
                chart.set_title(f"{name} x {rejector}\n{_bin_counts(mine)}")
                chart.plot([0, 1], [0, 1], color="#999999", lw=0.8)
                _reliable(chart, mine)
                chart.set_xlim(-0.03, 1.03)
                chart.set_ylim(-0.03, 1.03)
                chart.set_xticks(HALVES)
                chart.set_yticks(HALVES)
                chart.grid(visible=True, color=FAINT, lw=0.6)
                chart.tick_params(labelleft=chart is line[0], labelbottom=line is charts[-1])
            line[0].set_ylabel("false (share of answers)")


def _bin_counts(mine: pd.DataFrame) -> str:
    """Return the number of answers, in all and in each bin."""
    counts = mine["n"]
    return f"n {counts.sum():g}, {counts.min():g}-{counts.max():g} in each of {len(mine)} bins" if len(mine) else ""


def _reliable(chart: Axes, mine: pd.DataFrame) -> None:
    if mine.empty:
        chart.text(0.5, 0.5, "not applied", ha="center", color=GREY, transform=chart.transAxes)
        return
    colour = look_of(1).colour
    chart.vlines(mine["predicted"], mine["lo"], mine["hi"], color=colour, lw=0.9)
    chart.plot(mine["predicted"], mine["observed"], color=colour, marker="o", ms=3.5, lw=0.8)
    before = -1.0
    for row in mine.sort_values("predicted").to_dict("records"):
        is_close = row["predicted"] - before < 0.07  # of an axis: numbers would run into each other
        before = before if is_close else row["predicted"]
        if not is_close:
            chart.annotate(
                f"{row['n']:g}",
                (row["predicted"], row["observed"]),
                (3, -7),
                textcoords="offset points",
                fontsize=5.5,
                color=GREY,
            )


# --- protection levels ------------------------------------------------------------------------------------------------


def draw_stanford(path: Path | None, levels: Mapping[tuple[str, str], ProtectionLevels], limit_m: float) -> Figure:
    """Draw protection levels of one prior group and risk against errors: a panel for each matcher and method.

    Return the figure, written where there is a path.
    """
    names, methods = (list(dict.fromkeys(key[at] for key in levels)) for at in (0, 1))
    first = next(iter(levels.values()))
    cells = {key: stanford_cells(item) for key, item in levels.items()}
    most = max(int(frame["n"].max()) for frame in cells.values())
    drawn = [(name, method) for name in names for method in methods]
    columns = most_across(len(methods))
    about = BoardPage(
        title=f"Protection levels at risk {first.risk:g}: all suites, localization, {prior_words(first.prior_group)}",
        note=(
            f"Alert limit {limit_m:g} m. Available: error <= level <= limit. Misleading: level < error <= limit. "
            "Hazardous (hazardously misleading): level <= limit < error. Unavailable: level > limit, or none. "
            "Shares of all n queries, absent places among them with infinite error. "
            f"Darker cells hold more queries, the darkest {most}; what is beyond 1 km, or none, lies on the margin."
        ),
        below="position error (m)",
        rows=-(-len(drawn) // columns),
        columns=columns,
        panel_inches=(2.25, 2.1),
    )
    with page(path, about) as charts:
        for number, chart in panels(charts, len(drawn)):
            key = drawn[number]
            item = levels.get(key)
            chart.set_title(f"{', '.join(key)}\n{_available(item, limit_m)}")
            _stanford_axes(chart, limit_m)
            if item is not None:
                _stanford(chart, item, cells[key], limit_m, most)
            label_outer(chart, number, columns, len(drawn), "protection level (m)")
    return figure_of(charts[0][0])


def _available(item: ProtectionLevels | None, limit_m: float) -> str:
    """Return the number of queries, and of those with a level that holds and is available."""
    if item is None:
        return "tells none"
    total, count = len(item.level_m), stanford_areas(item, limit_m)["available"]
    return f"n {total}, available {count} ({count / max(total, 1):.1%})"


def _stanford_axes(chart: Axes, limit_m: float) -> None:
    end = BEYOND_M * 1.25
    chart.set_xscale("log")
    chart.set_yscale("log")
    chart.set_xlim(LEAST_M, end)
    chart.set_ylim(LEAST_M, end)
    ticks = [0.1, 1.0, 10.0, 100.0, MOST_M]
    for axis in (chart.xaxis, chart.yaxis):
        axis.set_ticks(ticks, [f"{tick:g}" for tick in ticks])
        axis.set_ticks([], minor=True)
    chart.fill_between([LEAST_M, limit_m], [LEAST_M, LEAST_M], [LEAST_M, limit_m], color="#fbe8d3", lw=0)
    chart.fill_between([limit_m, end], LEAST_M, limit_m, color="#f5c9ae", lw=0)
    chart.axhspan(limit_m, end, color="#ededed", lw=0)
    chart.plot([LEAST_M, end], [LEAST_M, end], color="#000000", lw=0.7)
    chart.axhline(limit_m, color="#000000", lw=0.7, ls="--")
    chart.plot([limit_m, limit_m], [LEAST_M, limit_m], color="#000000", lw=0.7, ls="--")


def _stanford(chart: Axes, item: ProtectionLevels, cells: pd.DataFrame, limit_m: float, most: int) -> None:
    chart.scatter(
        cells["error_m"],
        cells["level_m"],
        c=cells["n"],
        cmap=colormaps["Blues"],
        norm=LogNorm(vmin=0.4, vmax=max(most, 2)),
        marker="s",
        s=13,
        linewidths=0,
        rasterized=True,  # thousands of squares, each with a style of its own, are most of a site else
    )
    total = len(item.level_m)
    at = {"unavailable": (0.04, 0.93), "misleading": (0.3, 0.03), "hazardous": (0.99, 0.3)}
    counts = stanford_areas(item, limit_m)
    for area, place in at.items():
        count = counts[area]
        chart.text(
            *place,
            f"{area} {count}\n({count / max(total, 1):.1%})",
            transform=chart.transAxes,
            fontsize=5.8,
            va="top" if area == "unavailable" else "bottom",
            ha="right" if area == "hazardous" else "left",
            bbox={"facecolor": "white", "alpha": 0.7, "lw": 0, "pad": 0.8},
        )
