# SPDX-License-Identifier: Apache-2.0
"""Contact sheets: the views of queries, the map at the true place, the difference, and the map at a twin or decoy."""

import datetime as dt
import math
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from textwrap import wrap
from typing import Final, NamedTuple, Self

import cv2
import numpy as np
import shapely
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Circle
from numpy.typing import NDArray

from sasgeo_bench.core.canvas import Page, PlainFigure, page, panels, without_ticks
from sasgeo_bench.core.errors import ConfigError, StoreError, counted
from sasgeo_bench.flights.drift_profile import list_profiles, load_profile
from sasgeo_bench.geometry.pose import Pose, reckon
from sasgeo_bench.osm.taxonomy import load_taxonomy
from sasgeo_bench.regions import region_files
from sasgeo_bench.regions.evidence import ABSENT, PRESENT, UNKNOWN, Evidence
from sasgeo_bench.regions.layers import read_layers, read_overview
from sasgeo_bench.regions.painting import GROUND, HIDDEN, paint_evidence, paint_overview, rgb_of
from sasgeo_bench.regions.region import ATTRIBUTION, Manifest
from sasgeo_bench.tasks.build import rebuild_hint
from sasgeo_bench.tasks.flight_sampling import UTC
from sasgeo_bench.tasks.query import (
    PUBLISHED,
    TRUTH_SIGMA,
    TWIN_EAST,
    TWIN_NORTH,
    TWIN_TURN,
    PriorGroup,
    Query,
    Truth,
    flight_id,
)
from sasgeo_bench.tasks.state import State
from sasgeo_bench.tasks.suites.base import changed_share
from sasgeo_bench.tasks.suites.mining import describe, mine
from sasgeo_bench.tasks.suites.rivals import IN_DISC, LEAD, LISTED, RIVALS, TRUTH_LISTED
from sasgeo_bench.tasks.task_files import QUERIES, Task, read_batches

ONLY_SEEN: Final = "#c2185b"
ONLY_MAPPED: Final = "#1565c0"
AGREE: Final = "#d9d9d9"
TWIN: Final = "map at the twin"
DECOY: Final = "map at the hardest decoy"
_OF_TWIN: Final = (TWIN_EAST, TWIN_NORTH, TWIN_TURN, RIVALS, IN_DISC, LISTED, TRUTH_LISTED, LEAD)  # shown in words
_COLUMNS: Final = ("view", "map at the true place", "view against map")
_CELL_INCHES: Final = 2.4
_TEXT_INCHES: Final = 3.0  # width of the text column, readable when the sheet is shown smaller
_DPI: Final = 100
_EVEN: Final = 2  # of 254, the confidence of a class that is as likely as not, but for rounding


@dataclass(frozen=True, kw_only=True)
class Panel:
    """One row of a sheet: a query, its truth, and the map at the true place and at a rival; None without such a place.

    `rival` names the other place: the twin that a suite made of the true place, or a similar decoy.
    """

    query: Query
    truth: Truth
    at_truth: Evidence | None
    at_decoy: Evidence | None
    rival: str = DECOY


def paint_difference(seen: Evidence, mapped: Evidence) -> NDArray[np.float64]:
    """Return colours for cells that view and map share, that only the view has, and that only the map has."""
    known = (seen.cells != UNKNOWN) & (mapped.cells != UNKNOWN)
    one, two = (known & (item.cells == PRESENT) for item in (seen, mapped))
    picture = np.empty((*seen.shape, 3))
    picture[:] = rgb_of(GROUND)
    picture[(one & two).any(axis=0)] = rgb_of(AGREE)
    picture[(two & ~one).any(axis=0)] = rgb_of(ONLY_MAPPED)
    picture[(one & ~two).any(axis=0)] = rgb_of(ONLY_SEEN)
    picture[~known.any(axis=0)] = rgb_of(HIDDEN)
    return picture


def is_one_of_several(seen: Evidence) -> NDArray[np.bool_]:
    """Return where a class is as likely as not, as another one is: shape (C, rows, cols).

    A legend of masks says so of a value that stands for two classes.
    """
    if seen.confidence is None:
        return np.zeros(seen.cells.shape, dtype=bool)
    found = (seen.cells == PRESENT) & (seen.confidence <= _EVEN)
    return np.asarray(found & (found.sum(axis=0) > 1), dtype=bool)


def settled(seen: Evidence, mapped: Evidence) -> Evidence:
    """Return a view in which one of several classes is the one that the map shows, where it shows one of them.

    >>> cells = np.ones((2, 1, 2), dtype=np.uint8)
    >>> roads = ("road_major", "road_minor")
    >>> seen = Evidence(classes=roads, cells=cells, cell_size_m=1.0, confidence=np.zeros_like(cells))
    >>> mapped = Evidence(classes=roads, cells=np.array([[[0, 0]], [[1, 0]]], dtype=np.uint8), cell_size_m=1.0)
    >>> settled(seen, mapped).cells.tolist()
    [[[0, 1]], [[1, 1]]]
    """
    several = is_one_of_several(seen)
    there = mapped.cells == PRESENT
    lost = several & ~there & (several & there).any(axis=0)
    return seen.replace(np.where(lost, ABSENT, seen.cells).astype(np.uint8), seen.confidence)


def write_sheet(path: Path, *, title: str, panels: Sequence[Panel], credit: str = ATTRIBUTION) -> None:
    """Write a contact sheet as PNG; `credit` says whose the map is."""
    figure = sheet_figure(title, panels, credit=credit)
    FigureCanvasAgg(figure)
    figure.savefig(path, format="png", metadata={"Title": title, "Copyright": credit, "Software": None})


def sheet_figure(title: str, panels: Sequence[Panel], *, dpi: int = _DPI, credit: str = ATTRIBUTION) -> Figure:
    """Draw a contact sheet as a figure."""
    has_vectors = any(panel.query.vectors is not None for panel in panels)
    rivals = list(dict.fromkeys(panel.rival for panel in panels)) or [DECOY]
    has_pictures = any(panel.query.frames for panel in panels)
    columns = (
        *(("newest picture",) if has_pictures else ()),
        *(*_COLUMNS, " / ".join(rivals)),
        *(("perceived vectors",) if has_vectors else ()),
    )
    width, height = _TEXT_INCHES + 0.1 + _CELL_INCHES * len(columns), 1.2 + (_CELL_INCHES + 0.1) * len(panels)
    figure = PlainFigure(figsize=(width, height), dpi=dpi, facecolor="white")
    figure.text(0.15 / width, 1 - 0.12 / height, title, va="top", fontsize=13, fontweight="bold")
    legend = "view against map   pink: only seen   blue: only mapped   light grey: both   white: none   grey: unknown"
    if any(is_one_of_several(panel.query.evidence).any() for panel in panels):
        legend += "   one of two classes: in the colour of one, both if either is mapped"
    figure.text(0.15 / width, 1 - 0.45 / height, legend, va="top", fontsize=9.5, color="#444444")
    _draw_legend(figure, width, height, {name for panel in panels for name in panel.query.evidence.classes})
    for at, panel in enumerate(panels):
        bottom = height - 1.15 - (_CELL_INCHES + 0.1) * at - _CELL_INCHES + 0.1
        text = "\n".join(line for part in _text(panel) for line in wrap(part, 36))  # letters per line of text
        figure.text(0.15 / width, (bottom + _CELL_INCHES - 0.15) / height, text, va="top", fontsize=10)
        pictures = (*((_photo(panel.query),) if has_pictures else ()), *_pictures(panel), None)[: len(columns)]
        for place, (name, picture) in enumerate(zip(columns, pictures, strict=True)):
            left = _TEXT_INCHES + _CELL_INCHES * place
            box = (left / width, bottom / height, (_CELL_INCHES - 0.1) / width, (_CELL_INCHES - 0.1) / height)
            chart = figure.add_axes(box)
            chart.set(xticks=[], yticks=[])
            if picture is not None:
                chart.imshow(picture, interpolation="nearest")
            elif name == "perceived vectors" and panel.query.vectors is not None:
                _draw_vectors(chart, panel.query)
            else:
                chart.text(0.5, 0.5, "none", ha="center", va="center", fontsize=9, transform=chart.transAxes)
            if at == 0:
                chart.set_title(name, fontsize=10, pad=3)
    figure.text(0.15 / width, 0.06 / height, credit, fontsize=8)
    return figure


def _draw_legend(figure: Figure, width: float, height: float, classes: Collection[str]) -> None:
    left = 0.15
    for item in (one for one in load_taxonomy().classes if one.name in classes):
        name = item.name.replace("_", " ")
        figure.text(left / width, 1 - 0.66 / height, "\u25a0", va="top", fontsize=11, color=item.colour)
        figure.text((left + 0.15) / width, 1 - 0.67 / height, name, va="top", fontsize=8.5, color="#444444")
        left += 0.28 + 0.075 * len(name)


def _photo(query: Query) -> NDArray[np.float64] | None:
    """Return the newest picture of a query, colours 0..1, about as fine as it is shown; None without one."""
    if not query.frames:
        return None
    rgb = query.frames[-1].image().rgb
    step = max(1, round(rgb.shape[0] / (_CELL_INCHES * _DPI)))
    return np.asarray(cv2.resize(rgb, (rgb.shape[1] // step, rgb.shape[0] // step), interpolation=cv2.INTER_AREA) / 255)


def _pictures(panel: Panel) -> tuple[NDArray[np.float64] | None, ...]:
    seen, mapped, decoy = panel.query.evidence, panel.at_truth, panel.at_decoy
    return (
        paint_evidence(seen.of_known_classes()),
        None if mapped is None else paint_evidence(mapped),
        None if mapped is None else paint_difference(settled(seen, mapped), mapped),
        None if decoy is None else paint_evidence(decoy),
    )


def _draw_vectors(chart: Axes, query: Query) -> None:
    """Draw lines and outlines in the colours of their classes; bridges are dotted."""
    colours = {item.name: item.colour for item in load_taxonomy().classes}
    vectors = query.vectors
    if vectors is None:
        return
    for name, is_bridge, shape in zip(vectors["class"], vectors["is_bridge"], vectors.geometry, strict=True):
        for line in shapely.get_parts(shapely.boundary(shape) if shapely.get_dimensions(shape) > 1 else shape):
            at = shapely.get_coordinates(line)
            chart.plot(at[:, 0], at[:, 1], color=colours[name], linewidth=1.0, linestyle=":" if is_bridge else "-")
    rows, cols = query.evidence.shape
    half_m = query.evidence.cell_size_m / 2
    chart.set(xlim=(-cols * half_m, cols * half_m), ylim=(-rows * half_m, rows * half_m), aspect="equal")


def strength_text(truth: Truth) -> str:
    """Return the strength of a query; for an older map its true age, since its date is only the nearest to the step.

    Of a user's own picture it is how well its place is known.

    Examples
    --------
    >>> from types import SimpleNamespace
    >>> strength_text(SimpleNamespace(strength=5.0, strength_unit="years", measured={"age_years": 3.58}))
    'map 3.6 years old (step 5)'
    """
    age_years = truth.measured.get("age_years")
    if truth.strength_unit == TRUTH_SIGMA:
        return f"place known to {truth.strength:g} m (standard deviation)"
    if age_years is None:
        return f"strength {truth.strength:g} ({truth.strength_unit})"
    return f"map {age_years:.1f} years old (step {truth.strength:g})"


def flight_title(truth: Truth) -> str:
    """Return what a flight is, with the odometer that drifts on it where its kind names one by its profile.

    >>> from types import SimpleNamespace
    >>> flight_title(SimpleNamespace(title="stress: F1 vio-stereo"))
    'stress: F1 vio-stereo (its odometer: Visual-inertial odometry, stereo)'
    """
    profile = truth.title.rpartition(" ")[2]
    if profile not in list_profiles():
        return truth.title
    return f"{truth.title} (its odometer: {load_profile(profile).title})"


def rival_text(truth: Truth) -> str:
    """Return how far the twin of a place is and what a plain search lists; empty without a twin.

    Examples
    --------
    >>> from types import SimpleNamespace
    >>> measured = {"twin_east_m": 300.0, "twin_north_m": -400.0, "rivals": 1, "rivals_listed": 1, "truth_listed": 0}
    >>> rival_text(SimpleNamespace(measured=measured))
    'twin 500 m away; a plain search lists the twin alone'
    """
    measured = truth.measured
    if TWIN_EAST not in measured:
        return ""
    away = f"twin {math.hypot(measured[TWIN_EAST], measured[TWIN_NORTH]):.0f} m away"
    if RIVALS not in measured:
        return away
    is_rival, is_truth = measured[LISTED] == measured[RIVALS], measured[TRUTH_LISTED] == 1
    both = {(True, True): "both", (True, False): "the twin alone", (False, True): "the place alone"}
    return f"{away}; a plain search lists {both.get((is_rival, is_truth), 'neither')}"


def _known_text(query: Query) -> str:
    """Return what a query tells besides its view: its place in a flight, or its priors, candidates and vectors."""
    if query.step is not None:
        known = f", {PriorGroup.parse(query.prior_group).words}" if query.step.frame == 0 else ""
        return f"view {query.step.frame} of flight {query.step.sequence_id}{known}"
    vectors = f", {len(query.vectors)} vectors" if query.vectors is not None else ""
    return f"{PriorGroup.parse(query.prior_group).words}; {len(query.candidates)} candidates{vectors}"


def _value(name: str, value: float) -> str:
    if name == UTC:
        return f"{dt.datetime.fromtimestamp(value, tz=dt.UTC):%Y-%m-%d %H:%M:%S}"
    return f"{value:.3g}"


def _text(panel: Panel) -> tuple[str, ...]:
    query, truth = panel.query, panel.truth
    rows, cols = query.evidence.shape
    alias = "" if truth.alias_index is None else f", alias {truth.alias_index:.2f}"
    shown = {name: value for name, value in truth.measured.items() if name not in _OF_TWIN}
    measured = ", ".join(f"{name} {_value(name, value)}" for name, value in shown.items())
    return (
        truth.title + (f", detector {truth.detector}" if truth.detector != PUBLISHED else ""),
        strength_text(truth),
        f"{query.track}, {rows} x {cols} cells of {query.evidence.cell_size_m:g} m",
        _known_text(query),
        "present" if truth.is_present else "ABSENT",
        f"unknown {truth.unknown_share:.2f}, changed {truth.changed_share:.2f}{alias}",
        rival_text(truth),
        f"measured: {measured}" if measured else "",
        f"{truth.block}, {query.query_id[:8]}",
    )


SOME_IDS: Final = 3  # that the refusal of an unknown id names


def panels_of(
    task: Task,
    *,
    count: int = 12,
    query_id: str | None = None,
    choose: Callable[[Sequence[Truth]], Sequence[Truth]] | None = None,
) -> tuple[Panel, ...]:
    """Choose up to `count` queries of a task for a contact sheet: each kind and strength of a site, site by site.

    With `query_id` only the query whose id begins so is shown; `choose` selects and
    orders the truths instead.

    Raises
    ------
    StoreError
        If a file is missing, the truths are those of other queries, or the map has been rebuilt since.
    ConfigError
        If there is no such query.
    """
    name = task.manifest.region
    region = region_files.read_region(task.region)
    if not task.manifest.is_of_map(region.manifest):
        raise StoreError(rebuild_hint(name))
    state = State.of(region, name=name)
    truths = {truth.query_id: truth for truth in task.truths}
    strangers = StoreError(f"{task.truth} does not hold the truths of {task.folder}: make the queries again")
    chosen = _for_sheet(list(truths.values()), count) if choose is None else list(choose(list(truths.values())))
    if query_id is not None:
        chosen = [truth for truth in truths.values() if truth.query_id.startswith(query_id)][:1]
        if not chosen:
            raise _no_query(task.folder, query_id, sorted(truths))
    ids = {truth.query_id for truth in chosen}
    queries = {}
    rivals: dict[Pose, tuple[Pose, ...]] = {}
    poses = {truth.pose for truth in chosen}
    for query in task.queries():
        truth = truths.get(query.query_id)
        if truth is None:
            raise strangers
        if query.query_id in ids:
            queries[query.query_id] = query
        if query.candidates and truth.pose in poses and truth.pose is not None:
            rivals.setdefault(truth.pose, _others(query, truth))
    if ids != set(queries):
        raise strangers
    return tuple(_panel(queries[truth.query_id], truth, state, rivals) for truth in chosen)


def _no_query(task_folder: Path, query_id: str, known: Sequence[str]) -> ConfigError:
    message = (
        f"{task_folder} holds no query {query_id!r}: it has {counted(len(known), 'query', 'queries')}, "
        f"as {', '.join(known[:SOME_IDS])}; the column query_id of {QUERIES} lists all"
    )
    return ConfigError(message)


def _for_sheet(truths: Sequence[Truth], count: int) -> list[Truth]:
    """Return queries of as few sites as needed to show every variant, then more; controls first."""
    first = {truth.pair_id: truth.block for truth in sorted(truths, key=lambda item: item.pair_id)}
    rank = {"control": 0, "falsifier": 1, "stress": 2}
    order = sorted(
        truths, key=lambda item: (list(first).index(item.pair_id), rank[item.role], item.kind, item.strength)
    )
    seen: set[tuple[str, float, float, str]] = set()
    chosen = []
    for truth in order:
        blank = round(truth.unknown_share, 0) if truth.role == "falsifier" else 0.0
        variant = (truth.kind, truth.strength, blank, truth.detector)
        if variant not in seen:
            seen.add(variant)
            chosen.append(truth)
    rest = [truth for truth in order if truth not in chosen]
    return (chosen + rest)[:count]


def _others(query: Query, truth: Truth) -> tuple[Pose, ...]:
    return tuple(pose for at, pose in enumerate(query.candidates) if at != truth.candidate)


def _panel(query: Query, truth: Truth, state: State, rivals: Mapping[Pose, tuple[Pose, ...]]) -> Panel:
    """Return a panel with the map at the truth and at its twin; without a twin, at the most similar candidate."""
    # A query without candidates takes those of another one at the same place, or mined ones.
    if truth.pose is None:
        return Panel(query=query, truth=truth, at_truth=None, at_decoy=None)
    size, cell_m = query.evidence.shape[0], query.evidence.cell_size_m

    def view(pose: Pose) -> Evidence:
        return _only(state.view(pose, size_cells=size, cell_size_m=cell_m), query.evidence.classes)

    at_truth = view(truth.pose)
    if TWIN_EAST in truth.measured:
        easting_m = truth.pose.easting_m + truth.measured[TWIN_EAST]
        northing_m = truth.pose.northing_m + truth.measured[TWIN_NORTH]
        yaw_deg = truth.pose.yaw_deg + truth.measured.get(TWIN_TURN, 0.0)
        twin = view(replace(truth.pose, easting_m=easting_m, northing_m=northing_m, yaw_deg=yaw_deg % 360))
        return Panel(query=query, truth=truth, at_truth=at_truth, at_decoy=twin, rival=TWIN)
    near = _others(query, truth) or rivals.get(truth.pose, ())
    places = [(pose.easting_m, pose.northing_m) for pose in near]
    if not places:
        center_m, side_m = (truth.pose.easting_m, truth.pose.northing_m), size * cell_m
        mined = mine(describe(state, side_m=side_m, clear_m=side_m * float(np.sqrt(0.5))), center_m, count=1).points_m
        places = [(float(x), float(y)) for x, y in mined]
    views = [view(replace(truth.pose, easting_m=x, northing_m=y)) for x, y in places]
    hardest = min(views, key=lambda other: changed_share(_drawn(at_truth), _drawn(other)), default=None)
    return Panel(query=query, truth=truth, at_truth=at_truth, at_decoy=hardest)


def _drawn(evidence: Evidence) -> Evidence:
    """Return roads, buildings and water without the ground cover that fills most of a view."""
    return _only(evidence, [name for name in evidence.classes if name in load_taxonomy().having("compared")])


def _only(evidence: Evidence, classes: Sequence[str]) -> Evidence:
    cells = evidence.cells[[evidence.classes.index(name) for name in classes]]
    return Evidence(classes=tuple(classes), cells=cells, cell_size_m=evidence.cell_size_m)


Floats = NDArray[np.float64]
Bools = NDArray[np.bool_]

TRUE: Final = "#111111"
RECKONED: Final = "#d6006c"
PRIOR: Final = "#1f5fbf"
LOST: Final = "#7b2fa0"
OFF_MAP: Final = "#ffc928"
COPY: Final = "#00796b"
_PANEL_INCHES: Final = 3.4
_ONE_INCHES: Final = 8.0  # of a flight that is drawn alone
_DRAWN_CELLS: Final = 900
_PALE: Final = 0.6  # of the map's colours that is white
_IN_A_ROW: Final = "Flights of a row are of one site. "
_RANK: Final = {"control": 0, "stress": 1, "falsifier": 2}


@dataclass(frozen=True, kw_only=True, eq=False)
class FlightPanel:
    """One flight of N views: what its truths and queries say.

    `increments` are right, up and turn of the steps to each view but the first, NaN where the odometer says nothing.
    `prior_m` is the disc of the start (easting, northing, radius), None if it may be anywhere.
    """

    flight: str
    truth: Truth  # of the first view
    place_m: Floats  # (N, 2)
    yaw_deg: Floats
    is_seen: Bools
    is_on_map: Bools
    copy_m: Floats  # (N, 2), where the map shows the same; NaN where it does not
    increments: Floats  # (N - 1, 3)
    prior_m: tuple[float, float, float] | None

    @property
    def is_copied(self) -> Bools:
        """Return which views the map shows a second time."""
        return np.asarray(~np.isnan(self.copy_m[:, 0]))

    @property
    def reckoned_m(self) -> Floats:
        """Return where the odometer alone would lead from the true start, shape (N, 2); it stays where it is lost."""
        return reckon(self.place_m[0], float(self.yaw_deg[0]), self.increments)

    @property
    def lost(self) -> NDArray[np.int64]:
        """Return the views to which the odometer lost its way."""
        return np.flatnonzero(np.isnan(self.increments[:, 0])) + 1

    @property
    def carried_to(self) -> int | None:
        """Return the view to which the drone was carried, the one after its longest step; None if it was not."""
        if "carried_m" not in self.truth.measured:
            return None
        return int(np.argmax(np.hypot(*np.diff(self.place_m, axis=0).T))) + 1


class _View(NamedTuple):
    """Columns of a view of a flight."""

    query_id: str
    increment: list[float] | None
    prior_easting_m: float
    prior_northing_m: float
    prior_radius_m: float | None  # None: it may be anywhere


def flight_panels(task: Task, *, count: int = 12, flight: str | None = None) -> tuple[FlightPanel, ...]:
    """Choose the flights of as many whole sites as `count` panels hold, one site at least; a site's control first.

    With `flight`, only the one whose id begins so.

    Raises
    ------
    StoreError
        If a file is missing or damaged, or the truths are those of other queries.
    ConfigError
        If there is no such flight.
    """
    truths: dict[str, list[Truth]] = {}
    for truth in task.truths:
        truths.setdefault(flight_id(truth.query_id), []).append(truth)
    if flight is None:
        chosen = _of_sites(truths, count)
    else:
        chosen = [name for name in truths if name.startswith(flight)][:1]
        if not chosen:
            raise ConfigError(
                f"{task.folder} holds no flight {flight!r}: it has {counted(len(truths), 'flight')}, as "
                f"{', '.join(list(truths)[:3])}"
            )
    views: dict[str, list[_View]] = {name: [] for name in chosen}
    for batch in read_batches(task.folder / QUERIES, _View._fields):
        for row in batch.to_pylist():
            views.get(flight_id(row["query_id"]), []).append(_View(**row))
    for name in chosen:
        if [view.query_id for view in views[name]] != [truth.query_id for truth in truths[name]]:
            raise StoreError(f"{task.truth} does not hold the truths of {task.folder}: make the queries again")
    return tuple(_flight_panel(name, truths[name], views[name]) for name in chosen)


def _of_sites(truths: Mapping[str, Sequence[Truth]], count: int) -> list[str]:
    sites: dict[str, list[str]] = {}
    for name, (first, *_) in sorted(truths.items(), key=lambda item: item[1][0].pair_id):
        sites.setdefault(first.pair_id, []).append(name)
    most = max(map(len, sites.values()), default=1)
    chosen = list(sites.values())[: max(1, count // most)]
    return [name for names in chosen for name in sorted(names, key=lambda name: _order(truths[name][0]))]


def _order(truth: Truth) -> tuple[int, float, str, str]:
    return (_RANK[truth.role], truth.strength, truth.kind, truth.detector)


def _flight_panel(name: str, truths: Sequence[Truth], views: Sequence[_View]) -> FlightPanel:
    poses = [truth.pose for truth in truths if truth.pose is not None]
    place_m = np.array([(pose.easting_m, pose.northing_m) for pose in poses])
    _, _, easting_m, northing_m, radius_m = views[0]
    return FlightPanel(
        flight=name,
        truth=truths[0],
        place_m=place_m,
        yaw_deg=np.array([pose.yaw_deg for pose in poses]),
        is_seen=np.array([truth.measured.get("is_seen", 1.0) > 0 for truth in truths]),
        is_on_map=np.array([truth.is_present for truth in truths]),
        copy_m=place_m
        + np.array([[truth.measured.get(name, np.nan) for name in (TWIN_EAST, TWIN_NORTH)] for truth in truths]),
        increments=np.array([view.increment or [np.nan] * 3 for view in views[1:]], dtype=np.float64).reshape(-1, 3),
        prior_m=None if radius_m is None else (easting_m, northing_m, radius_m),
    )


def write_flight_sheet(path: Path, task: Task, shown: Sequence[FlightPanel]) -> None:
    """Write the maps of flights of a task as PNG, a row for each site.

    Raise `StoreError` if the map has been rebuilt since the queries were drawn.
    """
    about, manifest = task.manifest, region_files.read_manifest(task.region)
    if not about.is_of_map(manifest):
        raise StoreError(rebuild_hint(about.region))
    places = list(_places(shown))
    row_is_site = len({panel.truth.pair_id for panel in shown}) < len(shown)
    across = 1 + max((column for _, column in places), default=0)
    inches = _ONE_INCHES if len(shown) == 1 else _PANEL_INCHES
    sheet = Page(
        title=f"{about.title}: {about.region}",
        facts=f"{about.what} {_IN_A_ROW if row_is_site else ''}Number of a stress: {about.strength_unit}.",
        note="North is up. inspect --query ID draws one flight alone, or the sheet of one view by its whole id.",
        data=manifest.attribution,
        rows=1 + max((row for row, _ in places), default=0),
        columns=across,
        panel_inches=(inches, inches),
        keys=flight_keys(shown),
    )
    with page(path, sheet) as charts:
        for _ in panels(charts, 0):
            pass
        grounds: dict[str, Ground] = {}
        for (row, column), panel in zip(places, shown, strict=True):
            charts[row][column].set_visible(True)
            site = panel.truth.pair_id
            if site not in grounds:
                bounds_m = bounds_of_m([other for other in shown if other.truth.pair_id == site])
                grounds = {site: Ground.of(task.region, manifest, bounds_m)}
            draw_flight(charts[row][column], panel, grounds[site])
            charts[row][column].set_title("\n".join(_words(panel)))


def _places(shown: Sequence[FlightPanel]) -> Iterator[tuple[int, int]]:
    """Yield row and column of each panel: a site begins a row, and takes a second one if it has many variants."""
    # Where each site has one panel alone, rows are filled.
    sizes: dict[str, int] = {}
    for panel in shown:
        sizes[panel.truth.pair_id] = sizes.get(panel.truth.pair_id, 0) + 1
    if len(sizes) == len(shown):
        yield from (divmod(at, 3) for at in range(len(shown)))  # panels, where each site has one
        return
    begin = 0
    for size in sizes.values():
        lines = -(-size // 4)  # panels; a site with more variants takes two rows
        across = -(-size // lines)
        yield from ((begin + at // across, at % across) for at in range(size))
        begin += lines


def bounds_of_m(shown: Sequence[FlightPanel]) -> tuple[float, float, float, float]:
    """Return the square that the panels of a site show: west, east, south, north."""
    true = np.concatenate([panel.place_m for panel in shown] + [panel.copy_m[panel.is_copied] for panel in shown])
    low, high = true.min(axis=0), true.max(axis=0)
    # 0.35 of the extent of the true paths, by which reckoned ones may widen a panel
    reach_m = 0.35 * float((high - low).max())
    reckoned = np.clip(np.concatenate([panel.reckoned_m for panel in shown]), low - reach_m, high + reach_m)
    low, high = np.minimum(low, reckoned.min(axis=0)), np.maximum(high, reckoned.max(axis=0))
    # 0.12 of the extent of the paths, left free around them
    half_m = max(300.0, (0.5 + 0.12) * float((high - low).max()))  # 300 m: half a panel
    east_m, north_m = ((low + high) / 2).tolist()
    return (east_m - half_m, east_m + half_m, north_m - half_m, north_m + half_m)


@dataclass(frozen=True, kw_only=True, eq=False)
class Ground:
    """The pale map under the panels of a site: west, east, south and north of it, and of the panels."""

    picture: Floats
    extent_m: tuple[float, float, float, float]
    bounds_m: tuple[float, float, float, float]

    @classmethod
    def of(cls, folder: Path, manifest: Manifest, bounds_m: tuple[float, float, float, float]) -> Self:
        """Read the map below the panels; where it is large, as coarsely as it is drawn."""
        west, south, east, north = manifest.bounds_m
        cell_m, path = manifest.cell_size_m, folder / region_files.LAYERS
        left, right = (int(np.clip((at - west) // cell_m, 0, manifest.cols)) for at in bounds_m[:2])
        bottom, top = (int(np.clip((north - at) // cell_m, 0, manifest.rows)) for at in bounds_m[2:])
        # 3000 cells on a side of a panel, up to which the map is read as it is
        if max(right - left, bottom - top) > 3000:
            # 4000 cells of the whole map, where it is not
            layers, extent_m = read_overview(path, longest_cells=4000), (west, east, south, north)
        else:
            layers = read_layers(path, window=(top, left, bottom - top, right - left))
            extent_m = (west + left * cell_m, west + right * cell_m, north - bottom * cell_m, north - top * cell_m)
        step = max(1, max(layers.shape[1:]) // _DRAWN_CELLS)
        picture = _PALE + (1 - _PALE) * (paint_overview(manifest, layers[:, ::step, ::step]) / 255)
        return cls(picture=picture, extent_m=extent_m, bounds_m=bounds_m)


def draw_flight(chart: Axes, panel: FlightPanel, ground: Ground) -> None:
    """Draw one flight over its map: the true path and views, and where the odometer alone would lead."""
    chart.imshow(ground.picture, extent=ground.extent_m, interpolation="antialiased")
    if panel.prior_m is not None:
        chart.add_patch(Circle(panel.prior_m[:2], panel.prior_m[2], fill=False, ec=PRIOR, lw=1.2, ls=(0, (4, 2))))
    reckoned, place, jump = panel.reckoned_m, panel.place_m, panel.carried_to
    for part in np.split(np.arange(len(place)), [] if jump is None else [jump]):
        chart.plot(*place[part].T, color="white", lw=3.2, zorder=2)
        chart.plot(*place[part].T, color=TRUE, lw=1.1, zorder=3.6)  # above the odometer, which may be without errors
    if jump is not None:
        ahead = {"arrowstyle": "-|>", "color": LOST, "lw": 1.4, "ls": "--", "shrinkA": 0, "shrinkB": 0}
        chart.annotate("", place[jump], place[jump - 1], arrowprops=ahead, zorder=6)
    # 120 views: their dots are smaller
    chart.plot(*place[panel.is_seen].T, ".", ms=3.5 if len(place) < 120 else 2.0, color=TRUE, zorder=4)
    chart.plot(*panel.copy_m.T, color="white", lw=3.2, zorder=2)
    chart.plot(*panel.copy_m.T, ".-", color=COPY, lw=1.1, ms=4, zorder=3)
    chart.plot(*place[~panel.is_on_map].T, "D", ms=3.8, mfc=OFF_MAP, mec=TRUE, mew=0.7, zorder=5)
    chart.plot(*place[~panel.is_seen].T, "o", ms=3.6, mfc="white", mec=TRUE, mew=0.7, zorder=5)
    chart.plot(*reckoned.T, color="white", lw=2.4, zorder=3.4)
    chart.plot(*reckoned.T, color=RECKONED, lw=1.2, zorder=3.5)
    chart.plot(*reckoned[-1], "s", ms=5, mfc=RECKONED, mec="white", mew=0.8, zorder=6)
    chart.plot(*place[panel.lost].T, "x", ms=7, mew=2, color=LOST, zorder=7)
    chart.plot(*place[0], "^", ms=7, mfc=TRUE, mec="white", mew=0.9, zorder=7)
    chart.plot(*place[-1], "s", ms=5.5, mfc=TRUE, mec="white", mew=0.9, zorder=5.5)
    chart.set(xlim=ground.bounds_m[:2], ylim=ground.bounds_m[2:], aspect="equal", facecolor="#e8e8e8")
    without_ticks(chart)
    _draw_bar(chart, ground.bounds_m)


def _draw_bar(chart: Axes, bounds_m: tuple[float, float, float, float]) -> None:
    west, east, south, _ = bounds_m
    length_m = max(step for step in (100, 200, 500, 1000, 2000, 5000) if step <= max(100.0, (east - west) / 4))
    left_m, bottom_m = west + 0.04 * (east - west), south + 0.04 * (east - west)
    chart.plot([left_m, left_m + length_m], [bottom_m] * 2, color="white", lw=5, solid_capstyle="butt", zorder=8)
    chart.plot([left_m, left_m + length_m], [bottom_m] * 2, color="black", lw=2.2, solid_capstyle="butt", zorder=9)
    box = {"facecolor": "white", "alpha": 0.8, "edgecolor": "none", "pad": 1.0}
    text = f"{length_m / 1000:g} km" if length_m >= 1000 else f"{length_m} m"  # metres in a kilometre
    middle_m = (left_m + length_m / 2, bottom_m + 0.02 * (east - west))
    chart.text(*middle_m, text, ha="center", va="bottom", fontsize=7.5, bbox=box, zorder=9)


def _words(panel: FlightPanel) -> tuple[str, ...]:
    """Return the title of a panel: what the flight is, how long, and how far off reckoning ends."""
    truth = panel.truth
    age_years = truth.measured.get("age_years", 0.0)
    step = f", map {age_years:.1f} years old" if age_years else f": {truth.strength:g}"
    steps_m = np.hypot(*np.diff(panel.place_m, axis=0).T)
    length_km = (steps_m.sum() - truth.measured.get("carried_m", 0.0)) / 1000
    unseen = int((~panel.is_seen).sum())
    facts = [f"{length_km:.1f} km", f"{len(panel.place_m)} views"]
    facts += [f"{unseen} see nothing"] if unseen else []
    copied = int(panel.is_copied.sum())
    facts += [f"{copied} that the map shows twice"] if copied else []
    facts += [f"{(~panel.is_on_map).sum()} off the map"] if not panel.is_on_map.all() else []
    facts += [f"carried {truth.measured['carried_m']:.0f} m"] if "carried_m" in truth.measured else []
    off_m = float(np.hypot(*(panel.reckoned_m[-1] - panel.place_m[-1])))
    return (
        f"{truth.title}{step if truth.role == 'stress' else ''}"
        + (f", detector {truth.detector}" if truth.detector != PUBLISHED else ""),
        ", ".join(facts),
        f"odometer alone ends {off_m:.0f} m off",
        f"flight {panel.flight}",
    )


def flight_keys(shown: Sequence[FlightPanel]) -> list[Artist]:
    """Return the handles of the legend, of what is drawn."""
    line = partial(Line2D, [], [])
    mark = partial(line, color="none")
    kinds = [
        (True, line(label="true path and views", color=TRUE, lw=1.2, marker=".", ms=5)),
        (True, mark(label="start", marker="^", mfc=TRUE, mec="white", ms=8)),
        (True, mark(label="end", marker="s", mfc=TRUE, mec="white", ms=7)),
        (
            any(not panel.is_seen.all() for panel in shown),
            mark(label="view that sees nothing", marker="o", mfc="white", mec=TRUE, ms=5),
        ),
        (
            any(not panel.is_on_map.all() for panel in shown),
            mark(label="view off the map", marker="D", mfc=OFF_MAP, mec=TRUE, ms=5),
        ),
        (
            any(panel.is_copied.any() for panel in shown),
            line(label="the map shows the same here", color=COPY, lw=1.2, marker=".", ms=5),
        ),
        (True, line(label="odometer from the true start", color=RECKONED, lw=1.4, marker="s", ms=5)),
        (
            any(len(panel.lost) for panel in shown),
            mark(label="odometer lost on the way here", marker="x", mec=LOST, mew=2, ms=7),
        ),
        (any(panel.carried_to for panel in shown), line(label="carried", color=LOST, lw=1.4, ls="--")),
        (
            any(panel.prior_m is not None for panel in shown),
            line(label="disc of the start (prior)", color=PRIOR, lw=1.2, ls="--"),
        ),
    ]
    return [handle for is_drawn, handle in kinds if is_drawn]
