# SPDX-License-Identifier: Apache-2.0
"""The figures of a board: each draws a table of `plot_tables` on a page, the same bytes for the same table.

Each function writes a .svg or .png; `shown` are the matchers in the order of their looks.
"""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Final

import numpy as np
import pandas as pd
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure

from sasgeo_bench.canvas import GREY, figure_of, page, panels
from sasgeo_bench.errors import counted
from sasgeo_bench.leaderboard.board_plots import (
    ACROSS,
    FAINT,
    HALVES,
    INTERVALS,
    PRIMARY,
    BoardPage,
    draw_bar_panels,
    draw_line,
    dress_share,
    label_outer,
    line_keys,
    look_of,
    of_which,
    panels_across,
    those_there,
)
from sasgeo_bench.leaderboard.columns import prior_words
from sasgeo_bench.leaderboard.plot_tables import BEYOND_M, LEAST_M, MOST_M, stanford_areas, stanford_cells
from sasgeo_bench.scoring.contrasts import Contrast, PlaceDifference
from sasgeo_bench.scoring.metrics import primary_of
from sasgeo_bench.scoring.protection import ProtectionLevels
from sasgeo_bench.scoring.rejection_rows import AS_DRAWN
from sasgeo_bench.scoring.rows import ALL_SUITES
from sasgeo_bench.scoring.verdicts import Finding

_DODGE: Final = 0.011  # of an axis, between two matchers at one step


# --- success by what was done -----------------------------------------------------------------------------------------


def draw_steps(path: Path, rows: pd.DataFrame, shown: Sequence[str]) -> None:
    """Draw success against strength, from `steps_frame`: panels of kinds and view sizes, lines of matchers."""
    first = rows.iloc[0]
    note = f"Strength 0: the controls, the same places with nothing done to the view. {INTERVALS}"
    title = f"Success against strength: {of_which(first)}"
    _draw_lines(path, rows, shown, title, note, ("strength", str(first["strength_unit"])))


def draw_ages(path: Path, rows: pd.DataFrame, shown: Sequence[str]) -> None:
    """Draw success against the age of the map from `ages_frame`, in panels and lines as in `draw_steps`."""
    note = (
        "A point stands at the mean age of the maps of its step; the grey line at the bottom shows from which to "
        f"which age they are. {INTERVALS}"
    )
    title = f"Success against the age of the map: {of_which(rows.iloc[0])}"
    _draw_lines(path, rows, shown, title, note, ("age_years", "age of the map (years)"))


def _draw_lines(
    path: Path, rows: pd.DataFrame, shown: Sequence[str], title: str, note: str, axis: tuple[str, str]
) -> None:
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


def draw_forest(path: Path, contrast: Contrast, finding: Finding, places: Sequence[PlaceDifference]) -> None:
    """Draw a contrast place by place, from `contrasts.by_place`, and pooled below."""
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


# --- what is known of the answers -------------------------------------------------------------------------------------


def draw_risk(path: Path | None, rows: pd.DataFrame, shown: Sequence[str]) -> Figure:
    """Draw risk against coverage from `risk_frame`: a panel for each matcher and mixture, a line for each rejector.

    Return the figure, written where there is a path.
    """
    names, rejectors = those_there(rows, shown), sorted(set(rows["rejector"]))
    mixtures = list(dict.fromkeys(rows["mixture"]))
    there = set(zip(rows["matcher"], rows["mixture"], strict=True))
    cells = [(name, mixture) for name in names for mixture in mixtures if (name, mixture) in there]
    is_grid = len(mixtures) > 1 and len(cells) == len(names) * len(mixtures)
    columns = len(mixtures) if is_grid else min(ACROSS, len(cells))
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
            chart.set_title(f"{head}\n{_counts(mine)}")
            _risk_lines(chart, mine, rejectors)
            chart.set_xlim(0.0, 1.0)
            chart.set_xticks(HALVES)
            chart.set_ylim(0.0, max(high, 0.02))
            chart.grid(visible=True, color=FAINT, lw=0.6)
            label_outer(chart, number, columns, len(cells), "risk\n(share of accepted)")
    return figure_of(charts[0][0])


def _counts(mine: pd.DataFrame) -> str:
    """Return the number of queries and answers of a panel, of each line where they differ."""
    found = mine.drop_duplicates("rejector")[["n", "answered"]].drop_duplicates().to_numpy().tolist()
    return "; ".join(f"n {n}, {answered} answered" for n, answered in found)


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


def draw_stanford(path: Path, levels: Mapping[tuple[str, str], ProtectionLevels], limit_m: float) -> None:
    """Draw protection levels of one prior group and risk against errors: a panel for each matcher and method."""
    names, methods = (list(dict.fromkeys(key[at] for key in levels)) for at in (0, 1))
    first = next(iter(levels.values()))
    cells = {key: stanford_cells(item) for key, item in levels.items()}
    most = max(int(frame["n"].max()) for frame in cells.values())
    about = BoardPage(
        title=f"Protection levels at risk {first.risk:g}: all suites, localization, {prior_words(first.prior_group)}",
        note=(
            f"Alert limit {limit_m:g} m. Available: error <= level <= limit. Misleading: level < error <= limit. "
            "Hazardous (hazardously misleading): level <= limit < error. Unavailable: level > limit, or none. "
            "Shares of all n queries, absent places among them with infinite error. "
            f"Darker cells hold more queries, the darkest {most}; what is beyond 1 km, or none, lies on the margin."
        ),
        below="position error (m)",
        rows=len(names),
        columns=len(methods),
        panel_inches=(2.25, 2.1),
    )
    with page(path, about) as charts:
        for line, name in zip(charts, names, strict=True):
            for chart, method in zip(line, methods, strict=True):
                item = levels.get((name, method))
                chart.set_title(f"{name}, {method}\n{_available(item, limit_m)}")
                _stanford_axes(chart, limit_m)
                if item is not None:
                    _stanford(chart, item, cells[name, method], limit_m, most)
                chart.tick_params(labelleft=chart is line[0], labelbottom=line is charts[-1])
            line[0].set_ylabel("protection level (m)")


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
