# SPDX-License-Identifier: Apache-2.0
"""Draw how time and memory grow: a chart for each, a line for each kind of run."""

from collections.abc import Mapping, Sequence
from pathlib import Path

Lines = Mapping[str, Sequence[tuple[float, float]]]  # label -> size and what it took


def draw(path: Path, charts: Mapping[str, Lines], *, xlabel: str) -> None:
    """Draw charts by their titles side by side, as SVG; the same numbers give the same file."""
    import matplotlib as mpl  # noqa: PLC0415 - what is measured has its memory, too

    mpl.use("svg")
    from matplotlib import pyplot as plt  # noqa: PLC0415

    plt.rcParams |= {"svg.hashsalt": "growth", "svg.fonttype": "none", "font.size": 8}
    figure, axes = plt.subplots(1, len(charts), figsize=(6.4, 2.6), layout="constrained")
    for chart, (title, lines) in zip(axes, charts.items(), strict=True):
        for marker, (label, points) in zip("sDov", lines.items(), strict=False):
            chart.plot(*zip(*points, strict=True), f"{marker}-", label=label)
        highest = max(value for points in lines.values() for _, value in points)
        chart.set(xlabel=xlabel, ylabel=title, ylim=(0, 1.1 * highest), xlim=(0, None))
    axes[0].legend()
    figure.savefig(path, metadata={"Date": None})
