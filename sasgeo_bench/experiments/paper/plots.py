# SPDX-License-Identifier: Apache-2.0
"""The figures of the paper's experiment, each as PNG or SVG: the same bytes for the same figures."""

import math
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Final

import matplotlib as mpl
import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.patches import Patch
from numpy.typing import NDArray

from sasgeo_bench.canvas import PlainFigure
from sasgeo_bench.osm.taxonomy import load_taxonomy
from sasgeo_bench.regions.evidence import UNKNOWN, Evidence
from sasgeo_bench.tasks.sheet import HIDDEN, Panel, paint

# Okabe and Ito's colours, distinct for colour-blind readers; marks and dashes differ too.
_COLOURS: Final = ("#e69f00", "#0072b2", "#009e73", "#cc79a7", "#d55e00", "#56b4e9", "#000000", "#f0e442")
_MARKS: Final = ("o", "s", "^", "D", "v", "P", "X", "*")
_DASHES: Final = ("-", "-", "--", "-.", ":", "-", "--", "-.")
_OURS: Final = "#0072b2"
_PAPER: Final = "#b0b0b0"
_GREY: Final = "#444444"
_SEEN: Final = "#ffffff"
_DPI: Final = 150
_LEAST_RISK: Final = 0.02  # an axis of risk is no shorter: a single false fix should not fill it
_STYLE: Final[dict[Any, Any]] = {
    "svg.fonttype": "none",
    "svg.hashsalt": "sasgeo-bench",
    "font.family": "sans-serif",
    "font.size": 9.0,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.axisbelow": True,
}


@contextmanager
def _page(path: Path, width: float, height: float, title: str, note: str, data: str) -> Iterator[Figure]:
    """Yield a figure with a title above and a note and sources below; it is written when the block ends."""
    with mpl.rc_context(_STYLE):
        figure = PlainFigure(figsize=(width, height), dpi=_DPI, facecolor="white")
        FigureCanvasAgg(figure)
        figure.text(0.15 / width, 1 - 0.12 / height, title, fontsize=11, weight="bold", va="top")
        figure.text(0.15 / width, 0.27 / height, note, fontsize=7.5, color=_GREY, va="bottom", linespacing=1.35)
        figure.text(0.15 / width, 0.09 / height, f"Data: {data}", fontsize=7.5, color=_GREY, va="bottom")
        yield figure
        kind = path.suffix.removeprefix(".")
        plain = {"Date": None, "Creator": None} if kind == "svg" else {"Software": None}
        figure.savefig(path, format=kind, metadata={"Title": title, "Source": data, **plain})


def _wrapped(title: str) -> str:
    """Return a variant's name, in two lines where it is long."""
    first, _, rest = title.partition(" + ")
    return f"{first}\n+ {rest}" if rest and len(title) > 18 else title  # noqa: PLR2004 - letters over a panel


# --- example --------------------------------------------------------------------------------------------------------


def draw_example(path: Path, panel: Panel, *, data: str) -> None:
    """Draw one trial: the view, which of its cells are known, the map at the true place and at the hardest decoy."""
    query, done = panel.query, panel.truth.measured
    rows, cols = query.evidence.shape
    note = (
        f"One trial of {query.region} ({query.query_id[:8]}), chosen by what was done to it: turned by "
        f"{done['rotation_deg']:g} degrees, scale {done['scale']:g}, {done['crop_fraction']:.0%} retained, "
        f"{done['occlusion_share']:.0%} occluded, change probability {done['change_probability']:.2f}.\n"
        f"Views of {rows} x {cols} cells of {query.evidence.cell_size_m:g} m, times the scale; maps are turned and "
        "scaled as the view is. Hardest decoy: of nine, the one whose map differs least from that at the true place."
    )
    with _page(path, 10.0, 3.95, "Example query", note, data) as figure:
        charts = figure.subplots(1, 4)
        figure.subplots_adjust(left=0.012, right=0.988, top=0.83, bottom=0.25, wspace=0.05)
        pictures = (
            ("query: what is seen", paint(query.evidence)),
            ("observability mask", _mask(query.evidence)),
            ("true reference: the map there", None if panel.at_truth is None else paint(panel.at_truth)),
            ("hardest decoy: the map there", None if panel.at_decoy is None else paint(panel.at_decoy)),
        )
        for chart, (name, picture) in zip(charts, pictures, strict=True):
            chart.set_title(name, fontsize=9, pad=4)
            chart.set_xticks([])
            chart.set_yticks([])
            for side in ("top", "right"):
                chart.spines[side].set_visible(True)
            if picture is not None:
                chart.imshow(picture, interpolation="nearest")
        figure.legend(
            handles=_class_keys(query.evidence), loc="lower center", bbox_to_anchor=(0.5, 0.155), ncols=8, frameon=False
        )


def _mask(evidence: Evidence) -> NDArray[np.float64]:
    """Return white where any class is known, else the grey of hidden cells."""
    known = (evidence.cells != UNKNOWN).any(axis=0)[..., None]
    white, grey = (np.array(mpl.colors.to_rgb(name)) for name in (_SEEN, HIDDEN))
    return np.asarray(np.where(known, white, grey))


def _class_keys(evidence: Evidence) -> list[Patch]:
    keys = [
        Patch(facecolor=item.colour, edgecolor="#666666", lw=0.4, label=item.title.lower())
        for item in load_taxonomy().classes
        if item.name in evidence.classes
    ]
    return [*keys, Patch(facecolor=HIDDEN, edgecolor="#666666", lw=0.4, label="unknown: cropped or occluded")]


# --- ablation -------------------------------------------------------------------------------------------------------


def draw_ablation(path: Path, summary: pd.DataFrame, *, chance: float, data: str) -> None:
    """Draw Recall@1 of each variant next to the paper's, with intervals.

    `summary` has a row for each variant in drawing order: title, value, lo, hi, n; paper, paper_lo, paper_hi, paper_n,
    NaN where the paper has none; `how` describes the interval in words. `chance` is the rate of guessing.
    """
    count = len(summary)
    note = f"Ours: {summary['how'].iloc[0]}. Paper's: Wilson's 95 % intervals over its 220 trials."
    with _page(
        path, 7.6, 1.75 + 0.62 * count, "Recall@1 of each variant, beside the paper's Table II", note, data
    ) as figure:
        height = figure.get_figheight()
        chart = figure.add_axes((0.225, 1.0 / height, 0.70, (height - 1.75) / height))
        at = np.arange(count, dtype=np.float64)
        _bars(chart, at - 0.2, summary, ("value", "lo", "hi"), _OURS)
        _bars(chart, at + 0.2, summary, ("paper", "paper_lo", "paper_hi"), _PAPER)
        chart.axvline(chance, color="#000000", lw=0.9, ls=":")
        chart.text(chance + 0.008, -0.62, f"chance {chance:g}", fontsize=7.5, va="center")
        chart.set_yticks(at, summary["title"])
        chart.set_ylim(count - 0.5, -0.8)
        chart.set_xlim(0, 1.0)
        chart.set_xlabel("Recall@1 (share of trials with the true candidate first)")
        chart.grid(visible=True, axis="x", color="#dddddd", lw=0.6)
        chart.tick_params(axis="y", length=0)
        ours = sorted(set(summary["n"]))
        n = f"{ours[0]}" if len(ours) == 1 else f"{ours[0]} to {ours[-1]}"
        keys = [Patch(color=_OURS, label=f"ours, n = {n}")]
        if summary["paper"].notna().any():
            keys.append(Patch(color=_PAPER, label="the paper's, n = 220"))
        figure.legend(
            handles=keys, loc="upper right", bbox_to_anchor=(0.985, 1 - 0.33 / height), ncols=2, frameon=False
        )


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
    down = math.ceil(len(names) / across)
    note = (
        "Each point is a quarter of the range of the map-change probability, at the mean of its n trials; whiskers are "
        "Wilson's 95 % intervals, trials taken\nfor independent. The probability is that of the most volatile class; "
        "others change less (docs/concepts/paper.md)."
    )
    width, height = 1.2 + 1.78 * across, 1.75 + 1.95 * down
    with _page(path, max(width, 7.6), height, "Recall@1 against the probability of map change", note, data) as figure:
        charts = figure.subplots(down, across, sharex=True, sharey=True, squeeze=False)
        top, bottom = 1 - 0.72 / height, 1.12 / height
        figure.subplots_adjust(left=0.075, right=0.985, top=top, bottom=bottom, wspace=0.1, hspace=0.42)
        for number, chart in enumerate(charts.flat):
            if number >= len(names):
                chart.set_visible(False)
                continue
            rows = table[table["matcher"] == names[number]]
            _steps(chart, rows, _COLOURS[number % len(_COLOURS)], _MARKS[number % len(_MARKS)])
            chart.set_title(_wrapped(rows["title"].iloc[0]), fontsize=9, pad=5)
        for chart in charts[:, 0]:
            chart.set_ylabel("Recall@1")
        figure.text(0.53, 0.73 / height, "map-change probability", ha="center", fontsize=9)


def _steps(chart: Axes, rows: pd.DataFrame, colour: str, mark: str) -> None:
    value, lo, hi = (rows[name].to_numpy(float) for name in ("value", "lo", "hi"))
    chart.errorbar(
        rows["mean"], value, yerr=[value - lo, hi - value], color=colour, marker=mark, ms=5, lw=1.3, capsize=3
    )
    edges = sorted({*rows["low"], *rows["high"]})
    for edge in edges:
        chart.axvline(edge, color="#eeeeee", lw=0.7, zorder=0)
    for middle, count in zip((rows["low"] + rows["high"]) / 2, rows["n"], strict=True):
        chart.text(middle, 0.02, f"n {count}", fontsize=6, ha="center", color=_GREY)
    chart.set_xticks(edges, [f"{edge:g}" for edge in edges], fontsize=7.5)
    chart.set_ylim(0, 1.03)
    chart.grid(visible=True, axis="y", color="#dddddd", lw=0.6)


# --- risk and coverage ----------------------------------------------------------------------------------------------


def draw_risk(path: Path, table: pd.DataFrame, *, data: str) -> None:
    """Draw risk against coverage of every variant, all of it and the lower part again, from a table of `risk_frame`."""
    names = list(dict.fromkeys(table["matcher"]))
    note = (
        "Answers are accepted from the largest margin down; margin: score of the first candidate less that of the "
        "second, uncalibrated. Risk: false fixes among\nthe accepted; coverage: accepted among all n trials. AURC: "
        "area under the curve, small is good. Curves of few false fixes move in steps of one trial."
    )
    most = {name: float(table.loc[table["matcher"] == name, "risk"].max()) for name in names}
    low = sorted(most.values())[max(0, len(names) - 2)]  # the second largest: of all but the worst
    with _page(path, 9.0, 4.6, "Risk against coverage, accepting by margin", note, data) as figure:
        charts = figure.subplots(1, 2)
        figure.subplots_adjust(left=0.07, right=0.985, top=0.9, bottom=0.35, wspace=0.17)
        for number, name in enumerate(names):
            rows = table[table["matcher"] == name]
            first = rows.iloc[0]
            for chart in charts:
                chart.plot(
                    [0, *rows["coverage"]],
                    [first["risk"], *rows["risk"]],
                    color=_COLOURS[number % len(_COLOURS)],
                    ls=_DASHES[number % len(_DASHES)],
                    lw=1.6,
                    drawstyle="steps-pre",
                    label=f"{first['title']} (AURC {first['aurc']:.4f}, n {first['n']})",
                )
        for chart, top in zip(charts, (max(most.values()), low), strict=True):
            chart.set_xlim(0, 1)
            chart.set_ylim(0, max(_LEAST_RISK, 1.08 * top))
            chart.set_xlabel("coverage (share of trials accepted)")
            chart.grid(visible=True, color="#e2e2e2", lw=0.6)
        charts[0].set_ylabel("risk (share of false fixes)")
        charts[1].set_title("the same, its lower part", fontsize=8.5, loc="left", color=_GREY)
        handles, labels = charts[0].get_legend_handles_labels()
        figure.legend(
            handles, labels, loc="lower center", bbox_to_anchor=(0.5, 0.125), ncols=3, frameon=False, fontsize=8
        )
