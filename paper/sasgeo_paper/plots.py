# SPDX-License-Identifier: Apache-2.0
"""The figures of the paper's experiment, each as PNG or SVG: the same bytes for the same figures."""

import math
from pathlib import Path
from typing import Any, Final

import matplotlib as mpl
import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from numpy.typing import NDArray

from sasgeo_bench.core.canvas import GREY, Page, page, panels, without_ticks
from sasgeo_bench.regions.evidence import UNKNOWN, Evidence
from sasgeo_bench.regions.painting import HIDDEN, paint_evidence
from sasgeo_bench.regions.preview import class_keys
from sasgeo_bench.tasks.sheet import Panel

# Okabe and Ito's colours, distinct for colour-blind readers; marks and dashes differ too.
_COLOURS: Final = ("#e69f00", "#0072b2", "#009e73", "#cc79a7", "#d55e00", "#56b4e9", "#000000", "#f0e442")
_MARKS: Final = ("o", "s", "^", "D", "v", "P", "X", "*")
_DASHES: Final = ("-", "-", "--", "-.", ":", "-", "--", "-.")
_OURS: Final = "#0072b2"
_PAPER: Final = "#b0b0b0"
_SEEN: Final = "#ffffff"
_DPI: Final = 150
_LEAST_RISK: Final = 0.02  # an axis of risk is no shorter: a single false fix should not fill it


# --- example --------------------------------------------------------------------------------------------------------


def draw_example(path: Path, panel: Panel, *, data: str) -> None:
    """Draw one trial: the view, which of its cells are known, the map at the true place and at the hardest decoy."""
    query, done = panel.query, panel.truth.measured
    rows, cols = query.evidence.shape
    note = (
        f"One trial of {query.region} ({query.query_id[:8]}), chosen by what was done to it: turned by "
        f"{done['rotation_deg']:g} degrees, scale {done['scale']:g}, {done['crop_fraction']:.0%} retained, "
        f"{done['occlusion_share']:.0%} occluded, change probability {done['change_probability']:.2f}. "
        f"Views of {rows} x {cols} cells of {query.evidence.cell_size_m:g} m, times the scale; maps are turned and "
        "scaled as the view is. Hardest decoy: of nine, the one whose map differs least from that at the true place."
    )
    about = Page(
        title="Example query",
        note=note,
        data=data,
        columns=4,
        panel_inches=(2.3, 2.3),
        keys=[
            *class_keys(query.evidence.classes),
            Patch(facecolor=HIDDEN, edgecolor="#666666", lw=0.4, label="unknown: cropped or occluded"),
        ],
        dpi=_DPI,
    )
    with page(path, about) as charts:
        pictures = (
            ("query: what is seen", paint_evidence(query.evidence)),
            ("observability mask", _mask(query.evidence)),
            ("true reference: the map there", None if panel.at_truth is None else paint_evidence(panel.at_truth)),
            ("hardest decoy: the map there", None if panel.at_decoy is None else paint_evidence(panel.at_decoy)),
        )
        for chart, (name, picture) in zip(charts[0], pictures, strict=True):
            chart.set_title(name)
            without_ticks(chart)
            if picture is not None:
                chart.imshow(picture, interpolation="nearest")


def _mask(evidence: Evidence) -> NDArray[np.float64]:
    """Return white where any class is known, else the grey of hidden cells."""
    known = (evidence.cells != UNKNOWN).any(axis=0)[..., None]
    white, grey = (np.array(mpl.colors.to_rgb(name)) for name in (_SEEN, HIDDEN))
    return np.asarray(np.where(known, white, grey))


# --- ablation -------------------------------------------------------------------------------------------------------


def draw_ablation(path: Path, summary: pd.DataFrame, *, chance: float, data: str) -> None:
    """Draw Recall@1 of each variant next to the paper's, with intervals.

    `summary` has a row for each variant in drawing order: title, value, lo, hi, n; paper, paper_lo, paper_hi, paper_n,
    NaN where the paper has none; `how` describes the interval in words. `chance` is the rate of guessing.
    """
    count = len(summary)
    note = f"Ours: {summary['how'].iloc[0]}. Paper's: Wilson's 95 % intervals over its 220 trials."
    ours = sorted(set(summary["n"]))
    n = f"{ours[0]}" if len(ours) == 1 else f"{ours[0]} to {ours[-1]}"
    keys = [Patch(color=_OURS, label=f"ours, n = {n}")]
    if summary["paper"].notna().any():
        keys.append(Patch(color=_PAPER, label="the paper's, n = 220"))
    about = Page(
        title="Recall@1 of each variant, and in Table II of the paper",
        note=note,
        data=data,
        below="Recall@1 (share of trials with the true candidate first)",
        panel_inches=(5.3, 0.62 * count),
        keys=keys,
        dpi=_DPI,
    )
    with page(path, about) as charts:
        chart = charts[0][0]
        at = np.arange(count, dtype=np.float64)
        _bars(chart, at - 0.2, summary, ("value", "lo", "hi"), _OURS)
        _bars(chart, at + 0.2, summary, ("paper", "paper_lo", "paper_hi"), _PAPER)
        chart.axvline(chance, color="#000000", lw=0.9, ls=":")
        chart.text(chance + 0.008, -0.62, f"chance {chance:g}", fontsize=7.5, va="center")
        chart.set_yticks(at, summary["title"])
        chart.set_ylim(count - 0.5, -0.8)
        chart.set_xlim(0, 1.0)
        chart.grid(visible=True, axis="x", color="#dddddd", lw=0.6)
        chart.tick_params(axis="y", length=0)


def _bars(chart: Axes, at: NDArray[np.float64], table: pd.DataFrame, names: tuple[str, str, str], colour: str) -> None:
    """Draw bars with whiskers, the figure written in each."""
    for place, (value, lo, hi) in zip(at, table[list(names)].to_numpy(float), strict=True):
        if math.isnan(value):
            continue
        chart.barh(place, value, height=0.36, color=colour)
        if not math.isnan(lo):
            chart.errorbar(value, place, xerr=[[value - lo], [hi - value]], color="#000000", lw=1.1, capsize=3)
        text = f"{value:.3f}"
        chart.text(0.012, place, text, fontsize=8, va="center", color="#ffffff" if colour == _OURS else "#000000")


# --- robustness -----------------------------------------------------------------------------------------------------


def draw_robustness(path: Path, table: pd.DataFrame, *, data: str) -> None:
    """Draw Recall@1 against map-change probability, a panel for each variant of a table from `robustness_frame`."""
    names = list(dict.fromkeys(table["matcher"]))
    across = min(len(names), 5)
    note = (
        "Each point is a quarter of the range of the map-change probability, at the mean of its n trials; whiskers are "
        "Wilson's 95 % intervals, trials taken for independent. The probability is that of the most volatile class; "
        "others change less (docs/concepts/paper.md)."
    )
    about = Page(
        title="Recall@1 against the probability of map change",
        note=note,
        data=data,
        below="map-change probability",
        rows=math.ceil(len(names) / across),
        columns=across,
        panel_inches=(1.7, 1.5),
        dpi=_DPI,
    )
    with page(path, about) as charts:
        for number, chart in panels(charts, len(names)):
            rows = table[table["matcher"] == names[number]]
            _steps(chart, rows, _COLOURS[number % len(_COLOURS)], _MARKS[number % len(_MARKS)])
            chart.set_title(rows["title"].iloc[0])
            chart.tick_params(labelleft=number % across == 0, labelbottom=number + across >= len(names))
        for line in charts:
            line[0].set_ylabel("Recall@1")


def _steps(chart: Axes, rows: pd.DataFrame, colour: str, mark: str) -> None:
    value, lo, hi = (rows[name].to_numpy(float) for name in ("value", "lo", "hi"))
    chart.errorbar(
        rows["mean"], value, yerr=[value - lo, hi - value], color=colour, marker=mark, ms=5, lw=1.3, capsize=3
    )
    edges = sorted({*rows["low"], *rows["high"]})
    for edge in edges:
        chart.axvline(edge, color="#eeeeee", lw=0.7, zorder=0)
    for middle, count in zip((rows["low"] + rows["high"]) / 2, rows["n"], strict=True):
        chart.text(middle, 0.02, f"n {count}", fontsize=6, ha="center", color=GREY)
    chart.set_xticks(edges, [f"{edge:g}" for edge in edges], fontsize=7.5)
    chart.set_ylim(0, 1.03)
    chart.grid(visible=True, axis="y", color="#dddddd", lw=0.6)


# --- risk and coverage ----------------------------------------------------------------------------------------------


def draw_risk(path: Path, table: pd.DataFrame, *, data: str) -> None:
    """Draw risk against coverage of every variant, all of it and the lower part again, from a table of `risk_frame`."""
    names = list(dict.fromkeys(table["matcher"]))
    note = (
        "Answers are accepted from the largest margin down; margin: score of the first candidate less that of the "
        "second, uncalibrated. Risk: false fixes among the accepted; coverage: accepted among all n trials. AURC: "
        "area under the curve, small is good. Curves of few false fixes move in steps of one trial."
    )
    most = {name: float(table.loc[table["matcher"] == name, "risk"].max()) for name in names}
    low = sorted(most.values())[max(0, len(names) - 2)]  # the second largest: of all but the worst
    curves: list[tuple[list[float], list[float], dict[str, Any]]] = []
    for number, name in enumerate(names):
        rows = table[table["matcher"] == name]
        first = rows.iloc[0]
        look: dict[str, Any] = {
            "color": _COLOURS[number % len(_COLOURS)],
            "ls": _DASHES[number % len(_DASHES)],
            "lw": 1.6,
            "label": f"{first['title']} (AURC {first['aurc']:.4f}, n {first['n']})",
        }
        curves.append(([0.0, *rows["coverage"]], [first["risk"], *rows["risk"]], look))
    about = Page(
        title="Risk against coverage, accepting by margin",
        note=note,
        data=data,
        below="coverage (share of trials accepted)",
        columns=2,
        panel_inches=(3.9, 2.3),
        keys=[Line2D([], [], **look) for _, _, look in curves],
        dpi=_DPI,
    )
    with page(path, about) as ((whole, lower),):
        for chart, top in ((whole, max(most.values())), (lower, low)):
            for coverage, risk, look in curves:
                chart.plot(coverage, risk, drawstyle="steps-pre", **look)
            chart.set_xlim(0, 1)
            chart.set_ylim(0, max(_LEAST_RISK, 1.08 * top))
            chart.grid(visible=True, color="#e2e2e2", lw=0.6)
        whole.set_ylabel("risk (share of false fixes)")
        lower.set_title("the same, its lower part")
