# SPDX-License-Identifier: Apache-2.0
"""A region as a map with legend, scale, north arrow, date and attribution: `preview.png`, and a figure."""

from collections.abc import Collection, Mapping
from pathlib import Path
from textwrap import wrap
from typing import Any, Final

import cv2
import numpy as np
import shapely
from matplotlib.axes import Axes
from matplotlib.backend_bases import RendererBase
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.image import AxesImage
from matplotlib.lines import Line2D
from matplotlib.patches import Patch, Polygon, Rectangle
from matplotlib.ticker import MaxNLocator
from matplotlib.transforms import Affine2D
from numpy.typing import NDArray

from sasgeo_bench.core.canvas import PlainFigure
from sasgeo_bench.core.errors import check_given
from sasgeo_bench.core.texts import plain
from sasgeo_bench.osm.taxonomy import load_taxonomy
from sasgeo_bench.regions.layers import OUTSIDE
from sasgeo_bench.regions.painting import UNMAPPED, paint_overview, pooled
from sasgeo_bench.regions.region import Manifest, Region

_DPI: Final = 110
_MOST_CELLS: Final = 1024  # of a figure, along a side: more are no more to see
_LEGEND_INCHES: Final = 2.9
_MAP_INCHES: Final = 9.6
_LEAST_INCHES: Final = 4.6
_TITLE_INCHES: Final = 0.85
_LEFT_INCHES: Final = 0.65  # northings
_FOOT_INCHES: Final = 1.35  # eastings, scale and attribution
_STRIP_FROM_INCHES: Final = 0.42
_STRIP_INCHES: Final = 0.5  # under the map, for scale and north
_ARROW_INCHES: Final = 0.3
_EDGE: Final = "#d81b60"


def plot_region(region: Region) -> Figure:
    """Draw the semantic layers of a region, with legend, scale, north arrow, date and attribution.

    A notebook shows the figure; `figure.savefig("town.png")` writes it. Of a large region at most 1024 cells a side are
    drawn, and what is thin stays visible.

    Parameters
    ----------
    region : Region
        A built region, or a part of one (`Region.cuts`).

    Returns
    -------
    matplotlib.figure.Figure
        A figure of its own, unknown to pyplot: nothing has to be closed.

    Raises
    ------
    ConfigError
        If it is no region.

    Examples
    --------
    >>> from tempfile import TemporaryDirectory
    >>> import sasgeo_bench as sgb
    >>> with TemporaryDirectory() as folder:
    ...     figure = plot_region(sgb.tiny_place(Path(folder)).region)
    >>> figure.texts[-1].get_text()
    '(c) OpenStreetMap contributors, ODbL'
    """
    check_given(region, Region, "read_region reads one from its folder")
    return _drawn(region.manifest, pooled(region.layers, most_cells=_MOST_CELLS))


def write_preview(path: Path, *, manifest: Manifest, overview: NDArray[np.uint8]) -> None:
    """Draw a region to a PNG; `overview` is a coarse level of the layers, uint8 of shape (C, rows, cols)."""
    canvas: Any = FigureCanvasAgg(_drawn(manifest, overview))  # whose printing has no types
    del overview  # twice the memory of the picture
    # `savefig` would draw everything twice
    words = {"Title": plain(manifest.title), "Copyright": plain(manifest.attribution), "Software": None}
    canvas.print_png(path, metadata=words)


def _drawn(manifest: Manifest, overview: NDArray[np.uint8]) -> PlainFigure:
    rows, cols = overview.shape[1:]
    scale = _MAP_INCHES / max(rows, cols)
    width, height = max(cols * scale, 2.0), max(rows * scale, _LEAST_INCHES)
    across = _LEFT_INCHES + width + _LEGEND_INCHES + 0.3
    total = (max(across, 7.4), height + _TITLE_INCHES + _FOOT_INCHES)  # the line of facts is about as long
    figure = PlainFigure(figsize=total, dpi=_DPI, facecolor="white")
    FigureCanvasAgg(figure)
    chart = figure.add_axes((_LEFT_INCHES / total[0], _FOOT_INCHES / total[1], width / total[0], height / total[1]))
    side_m = (cols * _cell_m(manifest, overview), rows * _cell_m(manifest, overview))
    west_m, _, _, north_m = manifest.bounds_m
    extent = (west_m, west_m + side_m[0], north_m - side_m[1], north_m)  # what fills no whole cell lies south and east
    picture = _Picture(chart, extent=extent)
    picture.set_data(cv2.cvtColor(paint_overview(manifest, overview), cv2.COLOR_RGB2RGBA))
    picture.set_clip_path(chart.patch)
    chart.add_image(picture)
    chart.set_aspect("equal", anchor="NW")
    west, south, east, north = manifest.bounds_m
    frame = shapely.boundary(shapely.box(west, south, east, north))
    edge = shapely.difference(shapely.boundary(shapely.from_wkt(manifest.coverage.wkt)), shapely.buffer(frame, 0.5))
    for line in shapely.get_parts(edge):
        chart.plot(*shapely.get_coordinates(line).T, color=_EDGE, lw=1.0)
    chart.set(xlim=(west, east), ylim=(south, north))
    # Label the map with its coordinates, a few round ones a side, as a GIS shows them
    for axis in (chart.xaxis, chart.yaxis):
        axis.set_major_locator(MaxNLocator(nbins=4, steps=[1, 2, 5, 10]))
    chart.ticklabel_format(style="plain", useOffset=False)
    chart.tick_params(labelsize=8)
    chart.set_xlabel(f"easting (m, EPSG:{manifest.epsg})", fontsize=8)
    chart.set_ylabel("northing (m)", fontsize=8)
    for label in chart.get_yticklabels():
        label.set(rotation=90, va="center")
    m_per_inch = max(side_m[0] / width, side_m[1] / height)
    _draw_strip(figure, total, width_m=side_m[0], m_per_inch=m_per_inch)
    _words(figure, manifest, total)
    _legend(figure, manifest, overview, left=(_LEFT_INCHES + width + 0.15) / total[0], top=1 - _TITLE_INCHES / total[1])
    return figure


class _Picture(AxesImage):
    """A picture that is resampled as bytes: matplotlib does it in floats, and takes fifteen times its memory."""

    def make_image(
        self,
        renderer: RendererBase,
        magnification: float = 1.0,
        unsampled: bool = False,  # noqa: FBT001, FBT002 - as in matplotlib
    ) -> tuple[NDArray[Any], float, float, Affine2D]:
        """Return the picture in pixels of the figure, and its lower left corner there."""
        picture, frame = np.asarray(self.get_array()), np.array(self.axes.bbox.size) * magnification
        extents = np.array(self.get_window_extent(renderer).extents) * magnification
        left, bottom, right, top = np.rint(extents).astype(int).tolist()
        size = (max(right - left, 1), max(top - bottom, 1))
        if size[0] > 2 * frame[0] or size[1] > 2 * frame[1]:  # of a part alone, there is no need of all pixels
            return super().make_image(renderer, magnification, unsampled)
        rule = cv2.INTER_AREA if size[0] < picture.shape[1] else cv2.INTER_NEAREST
        return cv2.resize(picture, size, interpolation=rule)[::-1], left, bottom, Affine2D()


def _draw_strip(figure: Figure, total: tuple[float, float], *, width_m: float, m_per_inch: float) -> None:
    """Draw scale bar and north arrow under the map, at its scale, so that they hide nothing of it."""
    width = width_m / m_per_inch
    strip = figure.add_axes(
        (_LEFT_INCHES / total[0], _STRIP_FROM_INCHES / total[1], width / total[0], _STRIP_INCHES / total[1])
    )
    strip.axis("off")
    strip.set_zorder(-1)  # its white ground must not hide the frame of the map
    height_m = _STRIP_INCHES * m_per_inch
    strip.set(xlim=(0, width_m), ylim=(0, height_m))
    scale_bar(strip, width_m, height_m)
    north_arrow(strip, width_m, height_m, size_m=_ARROW_INCHES * m_per_inch)


def _cell_m(manifest: Manifest, overview: NDArray[np.uint8]) -> float:
    """Return the size of an overview cell: overviews are coarser by a whole factor."""
    return manifest.cell_size_m * round(manifest.cols / overview.shape[2]) if overview.shape[2] else 1.0


def scale_bar(chart: Axes, width_m: float, height_m: float) -> None:
    """Draw a bar of a round length, about a fifth of the width, in the lower left corner of a chart in metres."""
    goal = width_m / 4
    power = 10.0 ** np.floor(np.log10(goal))
    length_m = float(max(step * power for step in (1, 2, 5) if step * power <= goal))
    left, bottom, thick = 0.03 * width_m, 0.03 * height_m, 0.008 * max(width_m, height_m)
    pad = 0.015 * max(width_m, height_m)
    chart.add_patch(
        Rectangle((left - pad, bottom - pad), length_m + 2 * pad, thick + 4.2 * pad, color="white", alpha=0.85, lw=0)
    )
    for number in range(4):
        colour = "black" if number % 2 == 0 else "white"
        box = Rectangle(
            (left + number * length_m / 4, bottom), length_m / 4, thick, facecolor=colour, edgecolor="black", lw=0.6
        )
        chart.add_patch(box)
    kilometre_m = 1000
    text = f"{length_m / kilometre_m:g} km" if length_m >= kilometre_m else f"{length_m:g} m"
    chart.text(left + length_m / 2, bottom + thick + 0.4 * pad, text, ha="center", va="bottom", fontsize=9)


def north_arrow(chart: Axes, width_m: float, height_m: float, *, size_m: float | None = None) -> None:
    """Draw an arrow with an N in the upper right corner of a chart in metres."""
    size = size_m or 0.05 * max(width_m, height_m)
    x, y = width_m - 0.9 * size, height_m - 1.5 * size
    chart.add_patch(
        Rectangle((x - 0.55 * size, y - 0.25 * size), 1.1 * size, 1.6 * size, color="white", alpha=0.85, lw=0)
    )
    arrow = [
        (x, y + 0.75 * size),
        (x - 0.28 * size, y - 0.1 * size),
        (x, y + 0.1 * size),
        (x + 0.28 * size, y - 0.1 * size),
    ]
    chart.add_patch(Polygon(arrow, closed=True, color="black"))
    chart.text(x, y + 0.8 * size, "N", ha="center", va="bottom", fontsize=10, fontweight="bold")


def _words(figure: Figure, manifest: Manifest, total: tuple[float, float]) -> None:
    """Write the title, the facts below it, and the attribution at the foot."""
    per_inch = 9.0
    title = wrap(f"{manifest.title} ({manifest.id})", int(per_inch * 0.9 * (total[0] - 0.6)))
    figure.text(0.3 / total[0], 1 - 0.16 / total[1], title[0], ha="left", va="top", fontsize=14, fontweight="bold")
    facts = (
        f"map of {manifest.extract.date}",
        ", ".join(manifest.scenes),
        f"cells of {manifest.cell_size_m:g} m, EPSG:{manifest.epsg}",
        f"mapped: {manifest.coverage.share:.1%} ({manifest.coverage.source})",
    )
    whole = "  |  ".join(fact.replace(" ", "\N{NO-BREAK SPACE}") for fact in facts)  # a line ends between two facts
    lines = "\n".join(wrap(whole, int(1.35 * per_inch * (total[0] - 0.6))))
    figure.text(0.3 / total[0], 1 - 0.48 / total[1], lines, ha="left", va="top", fontsize=9, color="#444444")
    figure.text(0.3 / total[0], 0.14 / total[1], manifest.attribution, ha="left", va="bottom", fontsize=9)


def class_keys(shown: Collection[str]) -> list[Patch]:
    """Return the legend entries of classes by their titles, in the order of the taxonomy.

    Where `shown` maps names to texts, these follow the titles.

    >>> [key.get_label() for key in class_keys({"building": " (9)", "road_major": " (1)"})]
    ['major road (1)', 'building (9)']
    """
    more = shown if isinstance(shown, Mapping) else {}
    return [
        Patch(facecolor=item.colour, edgecolor="#666666", lw=0.4, label=item.title + more.get(item.name, ""))
        for item in load_taxonomy().classes
        if item.name in shown
    ]


def _legend(figure: Figure, manifest: Manifest, overview: NDArray[np.uint8], *, left: float, top: float) -> None:
    """Draw the classes that occur, with their number of objects, and explain the hatching."""
    found = {name: manifest.counts.get(name, 0) for name in manifest.classes}
    entries: list[Patch | Line2D] = [*class_keys({name: f"  ({count:,})" for name, count in found.items() if count})]
    if len(manifest.classes) < len(load_taxonomy().classes):
        entries.append(Patch(facecolor="none", edgecolor="none", label="all other classes: unknown"))
    if (overview[0] == OUTSIDE).any():
        hatched = Patch(
            facecolor=UNMAPPED[0], edgecolor=UNMAPPED[1], hatch="////", lw=0.4, label="not mapped (unknown)"
        )
        entries.append(hatched)
        entries.append(Line2D([], [], color=_EDGE, lw=1.0, label=f"edge of the map ({manifest.coverage.source})"))
    if not entries:
        figure.text(left, top, "no element of any class", fontsize=9, va="top")
        return
    legend = figure.legend(
        handles=entries,
        loc="upper left",
        bbox_to_anchor=(left, top),
        frameon=False,
        fontsize=9,
        title="class  (objects)",
        borderaxespad=0,
        handlelength=1.4,
        handleheight=1.1,
    )
    legend.get_title().set_fontsize(9)
