# SPDX-License-Identifier: Apache-2.0
"""The picture of one query and its answer; small PNG and WebP pictures for web pages."""

import math
from collections.abc import Collection, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, Self

import cv2
import numpy as np
import shapely
from matplotlib import patheffects
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.patches import Circle, Patch, Rectangle
from numpy.typing import NDArray

from sasgeo_bench.canvas import GREY, Page, new_figure, styled, without_ticks
from sasgeo_bench.errors import SasgeoError, StoreError
from sasgeo_bench.geometry.grid import Grid
from sasgeo_bench.geometry.pose import Pose, wrap_deg
from sasgeo_bench.regions.evidence import Evidence, LayerBits, footprint, observe
from sasgeo_bench.regions.preview import GROUND, class_keys, paint_overview, pooled, scale_bar
from sasgeo_bench.regions.region import Manifest
from sasgeo_bench.scoring.pose import SUCCESS_DEG
from sasgeo_bench.scoring.score import FIX_M
from sasgeo_bench.tasks.query import Query
from sasgeo_bench.tasks.segmented import Segmented
from sasgeo_bench.tasks.sheet import HIDDEN, paint

WEBP: Final = ".webp"
PNG: Final = ".png"
_QUALITIES: Final = (80, 65, 50, 35, 20, 10)
_SCALES: Final = (1.0, 0.75, 0.5)


def pixels_of(figure: Figure) -> NDArray[np.uint8]:
    """Return a figure as pixels, shape (rows, cols, 3), blue first."""
    canvas: Any = FigureCanvasAgg(figure)  # without types
    canvas.draw()
    return np.ascontiguousarray(np.asarray(canvas.buffer_rgba(), dtype=np.uint8)[..., 2::-1])


def fitted(pixels: NDArray[np.uint8], most_bytes: int) -> bytes:
    """Return pixels (blue first) as WebP of at most `most_bytes`, as good and then as large as fits.

    The same pixels give the same bytes. Raise StoreError if even half of its size in the worst quality takes more.
    """
    for scale in _SCALES:
        smaller = np.asarray(cv2.resize(pixels, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA), np.uint8)
        for quality in _QUALITIES:
            data = _encoded(WEBP, smaller, [cv2.IMWRITE_WEBP_QUALITY, quality])
            if len(data) <= most_bytes:
                return data
    raise StoreError(f"a picture of {pixels.shape[1]} x {pixels.shape[0]} pixels does not fit into {most_bytes} bytes")


def write_png(path: Path, pixels: NDArray[np.uint8]) -> None:
    """Write pixels without loss, whole or not at all.

    Raise StoreError if the folder cannot be written.
    """
    scratch = path.with_name(f".{path.name}.partial")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        scratch.write_bytes(_encoded(PNG, pixels, [cv2.IMWRITE_PNG_COMPRESSION, 9]))
        scratch.rename(path)
    except SasgeoError:  # an error with a cause of its own, though it may be an `OSError`
        raise
    except OSError as error:
        raise StoreError(
            f"{path} cannot be written ({error.strerror or error}): check the free space and your rights"
        ) from error


def _encoded(kind: str, pixels: NDArray[np.uint8], settings: list[int]) -> bytes:
    is_done, data = cv2.imencode(kind, pixels, settings)
    if not is_done:
        raise StoreError(f"a picture cannot be written as {kind}")
    return bytes(data)


MOST_MODES: Final = 8  # bars of an answer; a list may be longer
TRUE: Final = "#000000"
ANSWERED: Final = "#d55e00"
_OTHER: Final = "#0072b2"
_SIDE: Final = 1.72  # of a small panel, inches
_MAP: Final = 3.9
_DPI: Final = 100
_MOST_CELLS: Final = 560  # of a piece of a map, along a side: more are no more to see
_HALO: Final = (patheffects.withStroke(linewidth=2.6, foreground="white"),)


@dataclass(frozen=True, kw_only=True)
class MapPart:
    """A piece of a map as it is drawn: colours of shape (rows, cols, 3), and its edges in metres."""

    colours: NDArray[np.float64]
    west_m: float
    south_m: float
    east_m: float
    north_m: float

    @classmethod
    def of(cls, layers: NDArray[np.uint8], grid: Grid, manifest: Manifest) -> Self:
        """Paint layers, shape (C, rows, cols), on their grid; at most `_MOST_CELLS` along a side."""
        coarse = pooled(layers, most_cells=_MOST_CELLS)
        step = grid.rows // coarse.shape[1]
        west_m, south_m, east_m, north_m = grid.window(0, 0, *(side * step for side in coarse.shape[1:])).bounds_m
        colours = paint_overview(manifest, coarse)
        return cls(colours=colours, west_m=west_m, south_m=south_m, east_m=east_m, north_m=north_m)


@dataclass(frozen=True, kw_only=True)
class CasePicture:
    """Content of the picture of one query.

    Parameters
    ----------
    title : str
        Whose answer to what, and how it failed.
    view : Evidence
        What was seen.
    part : MapPart
        The map around the places.
    true : Pose, optional
        Where the view was taken; None where that is not on the map.
    is_present : bool
        Whether that place can be found; else it is drawn, and named so.
    modes : sequence of (Pose, float)
        The answer, best first; none where it was withheld.
    at_true, at_answer : Evidence, optional
        What the map shows at the true and at the first place.
    disc : (float, float, float), optional
        Easting, northing and radius of the disc that is searched.
    lines : sequence of str
        Lines on what the answer and the integrity model say.
    attribution : str
        Of the map.
    what, region : str
        Kind and strength of the stress, and the map that is searched.
    picture : ndarray of uint8, shape (H, W, 3), optional
        The newest picture that the evidence was made of, RGB.
    segmented : Segmented, optional
        What a segmenter says of that picture.
    """

    title: str
    view: Evidence
    part: MapPart
    true: Pose | None
    is_present: bool
    modes: Sequence[tuple[Pose, float]]
    at_true: Evidence | None
    at_answer: Evidence | None
    disc: tuple[float, float, float] | None
    lines: Sequence[str]
    attribution: str
    what: str = ""
    region: str = ""
    picture: NDArray[np.uint8] | None = None
    segmented: Segmented | None = None

    @property
    def error_m(self) -> float | None:
        """Return the distance of the first place from the true one; None without either."""
        if self.true is None or not self.modes:
            return None
        first = self.modes[0][0]
        return math.hypot(first.easting_m - self.true.easting_m, first.northing_m - self.true.northing_m)

    @property
    def error_deg(self) -> float | None:
        """Return the difference of the first heading from the true one, 0 to 180; None without either."""
        if self.true is None or not self.modes:
            return None
        return abs(float(wrap_deg(self.modes[0][0].yaw_deg - self.true.yaw_deg)))

    @property
    def is_found(self) -> bool:
        """Return whether the first pose is right: within 25 m and 5 degrees, as `success_25m` counts it."""
        error_m, error_deg = self.error_m, self.error_deg
        if error_m is None or error_deg is None or not self.is_present:
            return False
        return error_m <= FIX_M and error_deg <= SUCCESS_DEG


def disc_of(query: Query) -> tuple[float, float, float] | None:
    """Return the middle and radius of the searched disc, if the search is in a disc."""
    center_m, radius_m = query.prior.center_m, query.prior.radius_m
    return None if center_m is None or radius_m is None or query.candidates else (*center_m, radius_m)


def seen_at(pose: Pose, view: Evidence, layers: LayerBits, grid: Grid, manifest: Manifest) -> Evidence:
    """Return the map at a place as a view of the size and classes of `view`."""
    cells = observe(layers, grid, pose, size_cells=view.shape[0], cell_size_m=view.cell_size_m)
    return view.replace(cells[[manifest.classes.index(name) for name in view.classes]])


def evidence_keys(shown: Collection[str]) -> list[Artist]:
    """Return legend entries of classes, in the order of the taxonomy, of none of them, and of what is unknown."""
    rest = {"none of these classes": GROUND, "unknown": HIDDEN}
    return [
        *class_keys(shown),
        *(Patch(facecolor=colour, edgecolor="#666666", lw=0.4, label=name) for name, colour in rest.items()),
    ]


def case_pixels(case: CasePicture) -> NDArray[np.uint8]:
    """Draw a query and its answer; pixels as of `picture.pixels_of`, the same for the same case."""
    about = Page(title=case.title, data=case.attribution)
    with styled():
        figure = new_figure((3 * _SIDE + _MAP + 0.5, _MAP + 1.2), dpi=_DPI)
        left, right = figure.framed(about).subfigures(1, 2, width_ratios=(3 * _SIDE, _MAP))
        above, below = left.subfigures(2, 1, height_ratios=(_SIDE, _MAP - _SIDE))
        where = "map at the true place" if case.is_present else "map where it was taken"
        panels = [("view", case.view), (where, case.at_true), ("map at the answer", case.at_answer)]
        charts = list(above.subplots(1, len(panels) + (case.picture is not None)))
        if case.picture is not None:
            draw_picture(charts.pop(0), case.picture)
        for chart, (name, evidence) in zip(charts, panels, strict=True):
            draw_panel(chart, name, evidence)
        draw_map(right.subplots(), case)
        modes, text = below.subplots(1, 2)
        _draw_modes(modes, case)
        text.axis("off")
        text.text(0, 1, "\n".join(case.lines), va="top", fontsize=6.8, linespacing=1.32)
        return pixels_of(figure)


def draw_panel(chart: Axes, name: str, evidence: Evidence | None) -> None:
    """Draw evidence, or that there is none."""
    without_ticks(chart)
    chart.set_title(name, fontsize=7.5)
    if evidence is None:
        chart.text(0.5, 0.5, "none", ha="center", va="center", fontsize=8, color=GREY, transform=chart.transAxes)
    else:
        chart.imshow(paint(evidence), interpolation="antialiased")


def draw_picture(chart: Axes, picture: NDArray[np.uint8]) -> None:
    """Draw the newest picture of a query."""
    without_ticks(chart)
    chart.set_title("picture", fontsize=7.5)
    chart.imshow(picture, interpolation="antialiased")


def draw_map(chart: Axes, case: CasePicture) -> None:
    """Draw the map, north up, in metres from the lower left corner."""
    part = case.part
    width_m, height_m = part.east_m - part.west_m, part.north_m - part.south_m
    side_m = max(width_m, height_m)
    chart.imshow(part.colours, extent=(0, width_m, 0, height_m), interpolation="antialiased", alpha=0.75)
    chart.set_xlim(0, side_m)
    chart.set_ylim(0, side_m)
    chart.set_facecolor(HIDDEN)
    chart.add_patch(Rectangle((0, 0), width_m, height_m, color="white", lw=0, zorder=-1))
    without_ticks(chart)
    chart.set_title(f"map, north up, {side_m:.0f} m across:\n{_key(case)}", fontsize=7.5)
    if case.disc is not None:
        easting_m, northing_m, radius_m = case.disc
        middle = (easting_m - part.west_m, northing_m - part.south_m)
        chart.add_patch(Circle(middle, radius_m, fill=False, ec="#555555", lw=0.8, ls=":"))
    for number, (pose, _) in reversed(list(enumerate(case.modes[:MOST_MODES], start=1))[1:]):
        at = _at(pose, part)
        if 0 <= at[0] <= side_m and 0 <= at[1] <= side_m:
            chart.text(*at, str(number), fontsize=6.5, color=_OTHER, ha="center", va="center", path_effects=_HALO)
    size_m = case.view.size_m
    if case.true is not None:
        _outline(chart, case.true, size_m, part, colour=TRUE, dash="-")
    if case.modes:  # last: its dashes leave the true outline to be seen where both agree
        _outline(chart, case.modes[0][0], size_m, part, colour=ANSWERED, dash="--")
    if case.true is not None and case.modes:
        _offset(chart, case, part)
    scale_bar(chart, side_m, side_m)


def _key(case: CasePicture) -> str:
    """Describe what is drawn on the map."""
    shown = [("true place solid" if case.is_present else "where it was taken solid", case.true is not None)]
    shown += [("answer dashed", bool(case.modes)), ("search dotted", case.disc is not None)]
    return ", ".join(name for name, is_there in shown if is_there)


def _at(pose: Pose, part: MapPart) -> tuple[float, float]:
    return (pose.easting_m - part.west_m, pose.northing_m - part.south_m)


def _outline(chart: Axes, pose: Pose, size_m: tuple[float, float], part: MapPart, *, colour: str, dash: str) -> None:
    """Draw the footprint of a view, with a notch at its top."""
    ring = shapely.get_coordinates(footprint(pose, size_m=size_m)) - (part.west_m, part.south_m)
    width = 2.6 if dash == "-" else 1.4
    halo = _HALO if dash == "-" else ()
    chart.plot(ring[:, 0], ring[:, 1], color=colour, ls=dash, lw=width, path_effects=halo)
    up = np.array([(0.0, 0.5), (0.0, 0.36)]) * size_m[1]
    top = pose.to_map(up) - (part.west_m, part.south_m)
    chart.plot(top[:, 0], top[:, 1], color=colour, lw=1.6, path_effects=_HALO)
    chart.plot(*_at(pose, part), color=colour, marker="o", ms=3.5, path_effects=_HALO)


def _offset(chart: Axes, case: CasePicture, part: MapPart) -> None:
    """Draw a line between both places, with its length."""
    if case.true is None:
        return
    ends = np.array([_at(case.true, part), _at(case.modes[0][0], part)])
    chart.plot(ends[:, 0], ends[:, 1], color="#000000", lw=0.7)
    middle = ends.mean(axis=0)
    text = f"{float(np.hypot(*(ends[1] - ends[0]))):.0f} m"
    chart.text(
        float(middle[0]),
        float(middle[1]),
        text,
        fontsize=7.5,
        ha="center",
        va="bottom",
        weight="bold",
        path_effects=_HALO,
    )


def _draw_modes(chart: Axes, case: CasePicture) -> None:
    """Draw the scores of the modes as bars from the least, each named by its distance from the true place."""
    chart.set_title("scores of the modes", fontsize=7.5)
    modes = list(case.modes[:MOST_MODES])
    chart.set_yticks([])
    if not modes:
        chart.set_xticks([])
        chart.text(0.5, 0.5, "no answer", ha="center", va="center", fontsize=8, color=GREY, transform=chart.transAxes)
        return
    scores = np.array([score for _, score in modes])
    least = min(0.0, float(scores.min())) if float(scores.min()) < 0 <= float(scores.max()) else float(scores.min())
    room = (float(scores.max()) - least) or 1.0
    base = least - 0.12 * room if least == float(scores.min()) else least
    places = np.arange(len(modes))
    colours = [ANSWERED if at == 0 else _OTHER for at in places]
    chart.barh(places, scores - base, left=base, height=0.7, color=colours)
    chart.set_yticks(places, [_away(case, pose, at + 1) for at, (pose, _) in enumerate(modes)], fontsize=6.3)
    chart.set_ylim(len(modes) - 0.4, -0.6)
    chart.set_xlim(base, float(scores.max()) + 0.04 * room)
    ends = sorted({float(scores.min()), float(scores.max())})
    chart.set_xticks(ends, [f"{end:.4g}" for end in ends], fontsize=6.3)
    chart.tick_params(axis="y", length=0, pad=2)
    rest = len(case.modes) - len(modes)
    unit = "score (the matcher's own unit)" + (f"; {rest} more" if rest > 0 else "")
    chart.set_xlabel(unit, fontsize=6.3, labelpad=1)


def _away(case: CasePicture, pose: Pose, number: int) -> str:
    """Return the number of a mode, and its distance from the true place."""
    if case.true is None:
        return str(number)
    away_m = np.hypot(pose.easting_m - case.true.easting_m, pose.northing_m - case.true.northing_m)
    return f"{number}: {away_m:.0f} m"
