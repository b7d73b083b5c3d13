# SPDX-License-Identifier: Apache-2.0
"""Figures of flights on a board, with their tables: error along the way, how far odometers carry fixes, and drift.

Each figure has a line for each matcher, and a panel for each kind of flight of a suite; of drift for each suite.
"""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Final

import cv2
import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from numpy.typing import NDArray

from sasgeo_bench.boards.cases import MapPart, window_around
from sasgeo_bench.boards.plots import (
    FAINT,
    INTERVALS,
    BoardPage,
    dodged,
    draw_line,
    dress_share,
    each_panel,
    line_keys,
    look_of,
    of_which,
    those_there,
    ticks_across,
)
from sasgeo_bench.core.canvas import (
    Page,
    figure_of,
    new_figure,
    on_paper,
    page,
    panels,
    paper_inches,
    styled,
    without_ticks,
)
from sasgeo_bench.core.errors import ConfigError, StoreError, check_given, counted
from sasgeo_bench.core.folders import scratch_folder
from sasgeo_bench.flights.trajectory import Trajectory
from sasgeo_bench.regions import region_files
from sasgeo_bench.regions.painting import HIDDEN
from sasgeo_bench.regions.preview import scale_bar
from sasgeo_bench.regions.region import Region
from sasgeo_bench.scoring.flights import DRIFT_M, RECKONED_M
from sasgeo_bench.scoring.score import FIX_M
from sasgeo_bench.scoring.strata import CONTROL, DRIFT, GROUP, primary_rows
from sasgeo_bench.tasks.sheet import TRUE, Ground, bounds_of_m, draw_flight, flight_keys, flight_panels, flight_title
from sasgeo_bench.tasks.task_files import Task

MOST_TRACKERS: Final = 6
_ACROSS: Final = 3
_INCHES: Final = 3.4
_ONE_INCHES: Final = 6.4  # of a panel alone
_RIGHT, _FALSE, _WITHHELD = "#00897b", "#d50000", "#5c6bc0"


def shown_flight(scores: Mapping[str, pd.DataFrame], suite: str, regions: Sequence[str]) -> tuple[str, str] | None:
    """Return region and id of the flight of a suite that a board shows: the one on which its trackers differ most.

    Stressed flights come first; of those that differ as much the first by id. None if there is no flight.
    """
    parts = [frame[(frame["suite"] == suite) & frame["region"].isin(list(regions))] for frame in scores.values()]
    rows = pd.concat([part for part in parts if len(part)] or [pd.DataFrame()])
    if rows.empty:
        return None
    is_stress = rows["role"] == "stress"
    some = rows[is_stress] if is_stress.any() else rows
    spread = some.groupby(["region", "query_id"])["distance_within_25m"].agg(lambda values: values.max() - values.min())
    at = int(spread.sort_index().to_numpy().argmax())
    region, flight = spread.sort_index().index.to_list()[at]
    return str(region), str(flight)


def plot_flight(flown: Trajectory, region: Region, *, width_mm: float | None = None) -> Figure:
    """Draw a flight over the map around it, and its height and speed over time.

    Parameters
    ----------
    flown : Trajectory
        In the region's CRS, as of `read_flight`.
    region : Region
        The map below it.
    width_mm : float, optional
        Width on paper, as 85 for a column; by default as a page has it.

    Returns
    -------
    matplotlib.figure.Figure
        A figure of its own, with the attribution of the map. A notebook shows it.

    Raises
    ------
    ConfigError
        If these are no flight and no region, or the flight lies beside the map.

    Examples
    --------
    >>> from tempfile import TemporaryDirectory
    >>> import sasgeo_bench as sgb
    >>> with TemporaryDirectory() as folder:
    ...     region = sgb.tiny_place(Path(folder)).region
    >>> west, south, east, north = region.manifest.bounds_m
    >>> corners = [[west, south, 100.0], [east, north, 100.0]]
    >>> figure = Trajectory.of_angles(time_s=[0.0, 30.0], position_m=corners, yaw_deg=[0.0, 0.0]).plot(region)
    >>> [chart.get_title("left") for chart in figure.axes]
    ['map, north up', 'third axis (m)', 'speed (m/s)']
    """
    check_given(flown, Trajectory, "read_flight reads one from a log")
    check_given(region, Region, "read_region reads one from its folder")
    place_m = flown.position_m[:, :2]
    if not ((place_m >= region.grid.bounds_m[:2]) & (place_m <= region.grid.bounds_m[2:])).all(axis=1).any():
        raise ConfigError(
            f"the flight lies beside the map {region.manifest.id}: read the region that it was flown over"
        )
    low, high = place_m.min(axis=0), place_m.max(axis=0)
    row, col, rows, cols = window_around(region.grid, (low + high) / 2, max(200.0, 0.6 * float((high - low).max())))
    layers = region.layers[:, row : row + rows, col : col + cols]
    part = MapPart.of(layers, region.grid.window(row, col, rows, cols), region.manifest)
    about = Page(
        title=f"Flight over {region.manifest.title}",
        facts=f"{flown.distance_m[-1]:.0f} m in {np.ptp(flown.time_s):.0f} s, {counted(len(flown), 'pose')}. Map of "
        f"{region.manifest.extract.date}.",
        data=region.manifest.attribution,
    )
    time_s = flown.time_s - flown.time_s[0]
    speed_mps = np.hypot(*np.diff(place_m, axis=0).T) / np.diff(flown.time_s)
    with on_paper(width_mm), styled():
        wide = paper_inches()
        figure = new_figure((wide, 1.7 * wide) if wide else (1.7 * _ONE_INCHES, _ONE_INCHES + 1.2))
        frame = figure.framed(about)
        if wide:
            charts = frame.subplot_mosaic([["map"], ["height"], ["speed"]], height_ratios=(4, 1, 1))
        else:
            charts = frame.subplot_mosaic([["map", "height"], ["map", "speed"]], width_ratios=(3, 2))
        chart = charts["map"]
        width_m, height_m = part.east_m - part.west_m, part.north_m - part.south_m
        chart.imshow(part.colours, extent=(0, width_m, 0, height_m), interpolation="antialiased", alpha=0.75)
        at_m = place_m - (part.west_m, part.south_m)
        chart.plot(*at_m.T, color="white", lw=3.0)
        chart.plot(*at_m.T, color=TRUE, lw=1.2)
        chart.plot(*at_m[0], "^", ms=7, mfc=TRUE, mec="white")
        chart.plot(*at_m[-1], "s", ms=5.5, mfc=TRUE, mec="white")
        chart.set(xlim=(0, width_m), ylim=(0, height_m), aspect="equal", facecolor=HIDDEN)
        without_ticks(chart)
        scale_bar(chart, width_m, height_m)
        chart.set_title("map, north up", fontsize=8.0)
        charts["height"].plot(time_s, flown.position_m[:, 2], color=TRUE, lw=1.1)
        charts["height"].set_title("third axis (m)", fontsize=8.0)
        charts["speed"].plot((time_s[:-1] + time_s[1:]) / 2, speed_mps, color=TRUE, lw=1.1)
        charts["speed"].set_title("speed (m/s)", fontsize=8.0)
        charts["speed"].set_xlabel("time (s)")
        for name in ("height", "speed"):
            charts[name].grid(visible=True, color=FAINT, lw=0.6)
        figure.arrange()
    return figure


def flight_map_pixels(task: Task, flight: str, views: Mapping[str, pd.DataFrame]) -> NDArray[np.uint8]:
    """Draw a flight with the estimates of some trackers, a map for each; pixels have blue first.

    Parameters
    ----------
    task : Task
        Its map and truths lie below the root that holds it.
    flight : str
        Id of the flight.
    views : mapping of str to DataFrame
        Rows of `scoring.flights.view_frame` by tracker, in the order in which they are drawn.
    """
    about, folder = task.manifest, task.region
    (panel,) = flight_panels(task, flight=flight)
    ground = Ground.of(folder, region_files.read_manifest(folder), bounds_of_m([panel]))
    mine = {name: frame[frame["sequence_id"] == flight] for name, frame in views.items()}
    names = list(mine)
    truth = panel.truth
    across = min(_ACROSS, len(names))
    sheet = Page(
        title=f"{about.title}: {about.region}",
        facts=f"One flight, {flight_title(truth)}. {about.what}",
        note="North is up." + (" Trackers differ most on this flight of the suite." if len(names) > 1 else ""),
        data=about.provenance.credit,
        rows=-(-len(names) // across),
        columns=across,
        panel_inches=(_ONE_INCHES, _ONE_INCHES) if len(names) == 1 else (_INCHES, _INCHES),
        keys=[*flight_keys([panel]), *_keys(list(mine.values()))],
    )
    with scratch_folder("flight") as scratch:
        path = scratch / "flight.png"
        with page(path, sheet) as charts:
            for number, chart in panels(charts, len(names)):
                draw_flight(chart, panel, ground)
                _draw_estimates(chart, mine[names[number]])
                facts = "\n".join(_facts(mine[names[number]], ground.bounds_m))
                chart.set_title(f"{names[number]}\n{facts}")
        pixels = cv2.imread(str(path))
    if pixels is None:
        raise StoreError(f"the map of flight {flight} cannot be drawn: free some space where temporary files lie")
    return np.asarray(pixels, dtype=np.uint8)


def _keys(shown: Sequence[pd.DataFrame]) -> list[Line2D]:
    """Return the handles of the legend, of the estimates that are drawn."""
    views = pd.concat(shown)
    accepted, is_near = _judged(views)
    is_posed = views["east_m"].notna().to_numpy(bool)
    kinds = (
        (is_posed, Line2D([], [], color=_WITHHELD, lw=1.0, label="estimates, in order")),
        (accepted & is_near, _dot(f"accepted, within {FIX_M:g} m", "o", _RIGHT, "white", 6)),
        (accepted & ~is_near, _dot(f"accepted, beyond {FIX_M:g} m", "X", _FALSE, "white", 7)),
        (is_posed & ~accepted, _dot("not accepted", "o", _WITHHELD, "none", 4)),
    )
    return [key for marked, key in kinds if marked.any()]


def _dot(label: str, marker: str, fill: str, edge: str, points: float) -> Line2D:
    return Line2D([], [], color="none", marker=marker, mfc=fill, mec=edge, ms=points, label=label)


def _judged(views: pd.DataFrame) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """Return which views have an accepted estimate, and which one within `FIX_M`."""
    return views["is_accepted"].to_numpy(bool), views["error_m"].to_numpy(float) <= FIX_M


def _draw_estimates(chart: Axes, views: pd.DataFrame) -> None:
    place_m = views[["east_m", "north_m"]].to_numpy(float)
    accepted, is_near = _judged(views)
    chart.plot(*place_m.T, color=_WITHHELD, lw=0.9, marker=".", ms=3, zorder=7)
    chart.plot(*place_m[accepted & is_near].T, "o", ms=4.2, mfc=_RIGHT, mec="white", mew=0.4, zorder=8)
    chart.plot(*place_m[accepted & ~is_near].T, "X", ms=6.0, mfc=_FALSE, mec="white", mew=0.5, zorder=9)


def _facts(views: pd.DataFrame, bounds_m: tuple[float, float, float, float]) -> list[str]:
    """Return lines: how many views have a near estimate, an accepted fix and a false one; and which cannot be seen.

    `bounds_m` are west, east, south and north of the map that is drawn.
    """
    accepted, is_near = _judged(views)
    false = int((accepted & ~is_near).sum())
    facts = [f"{len(views)} views: {is_near.sum()} within {FIX_M:g} m, {accepted.sum()} accepted, {false} false"]
    failed = views[views["status"] != "ok"]
    if len(failed):
        first = failed.iloc[0]
        facts.append(f"{counted(len(failed), 'view')} without an answer: {first['status']} at frame {first['frame']}")
    east_m, north_m = (views[name].dropna().to_numpy(float) for name in ("east_m", "north_m"))
    west, east, south, north = bounds_m
    beyond = int(((east_m < west) | (east_m > east) | (north_m < south) | (north_m > north)).sum())
    if beyond:
        facts.append(f"{counted(beyond, 'estimate')} beyond the edge of this map")
    return facts


_BIN_M: Final = 250.0
_LEAST_FLIGHTS: Final = 2  # of a point: one flight is no distribution
_SHARES: Final = {"half": 0.5, "most": 0.9}
_LEAST_ERROR_M: Final = 1.0
_MOST_ERROR_M: Final = 10_000.0
_ERROR_TICKS_M: Final = (1.0, 10.0, 100.0, 1000.0, 10_000.0)
_ALL: Final = 100.0  # percent
_METRICS: Final = {f"reckoned_{far_m:g}m": far_m for far_m in RECKONED_M}
_WITHIN_LABEL: Final = f"share of the way\nwithin {FIX_M:g} m"
DISTANCE_COLUMNS: Final = (*GROUP, "kind", "matcher", "distance_m", "flights", *_SHARES)
INTERVAL_COLUMNS: Final = (*GROUP, "kind", "matcher", "every_m", "n", "blocks", "value", "lo", "hi")
DRIFT_COLUMNS: Final = (*GROUP, "kind", "matcher", "drift", "n", "blocks", "value", "lo", "hi")


def distance_frame(
    views: Mapping[str, pd.DataFrame], scores: Mapping[str, pd.DataFrame], shown: Sequence[str]
) -> pd.DataFrame:
    """Return the error of the estimate along the way, with the columns `DISTANCE_COLUMNS`.

    `half` and `most` are the errors that 50 % and 90 % of the flights stay below at a distance from the start: of a
    flight its largest error in each 250 m, infinite without an estimate. A distance that fewer than two flights reach
    has no row.
    """
    parts = []
    for name in (name for name in shown if name in views):
        kinds = scores[name].set_index("query_id")["kind"]
        seen = views[name]
        bins = (seen["distance_m"] // _BIN_M + 0.5) * _BIN_M
        mine = seen.assign(kind=seen["sequence_id"].map(kinds), at_m=bins)
        worst = mine.groupby([*GROUP, "kind", "sequence_id", "at_m"], as_index=False)["error_m"].max()
        for key, some in worst.groupby([*GROUP, "kind", "at_m"], sort=True):
            if len(some) >= _LEAST_FLIGHTS:
                errors_m = some["error_m"].to_numpy(float)
                found = [np.quantile(errors_m, share, method="inverted_cdf") for share in _SHARES.values()]
                parts.append((*key[:-1], name, key[-1], len(some), *found))
    return pd.DataFrame(parts, columns=list(DISTANCE_COLUMNS))


def interval_frame(
    table: pd.DataFrame, kinds: Mapping[tuple[str, ...], Sequence[str]], shown: Sequence[str]
) -> pd.DataFrame:
    """Return how much of the way stays within 25 m if fixes are used rarely, with the columns `INTERVAL_COLUMNS`.

    `table` is the leaderboard; `kinds` are the strata of a suite, track and prior group that have a panel.
    """
    rows = table[table["metric"].isin(list(_METRICS)) & table["matcher"].isin(list(shown)) & (table["rejector"] == "")]
    is_kind = [
        stratum in kinds.get(key, ())
        for *key_list, stratum in rows[[*GROUP, "stratum"]].itertuples(index=False)
        for key in [tuple(key_list)]
    ]
    some = rows[np.array(is_kind, dtype=bool)]
    found = some.assign(every_m=some["metric"].map(_METRICS), kind=some["stratum"])
    return found[[*INTERVAL_COLUMNS]].reset_index(drop=True)


def drift_frame(table: pd.DataFrame, shown: Sequence[str]) -> pd.DataFrame:
    """Return the share of the way within 25 m by the odometer's drift, with the columns `DRIFT_COLUMNS`.

    `drift` is a bin of `FlightScore.odometer_drift`, as "0.02-0.04"; `kind` is the suite, whose controls are left out.
    """
    is_bin = table["stratum"].str.startswith(f"{DRIFT} ") & (table["rejector"] == "")
    rows = primary_rows(table[is_bin & table["matcher"].isin(list(shown)) & table["value"].notna()])
    found = rows.assign(drift=rows["stratum"].str.removeprefix(f"{DRIFT} "), kind=rows["suite"])
    return found[[*DRIFT_COLUMNS]].reset_index(drop=True)


def kinds_of(scores: Mapping[str, pd.DataFrame]) -> dict[tuple[str, ...], list[str]]:
    """Return the strata that have a panel, by suite, track and prior group: the controls, and each kind of stress."""
    found: dict[tuple[str, ...], list[str]] = {}
    for frame in scores.values():
        for key, part in frame.groupby(list(GROUP), sort=True):
            stress = sorted(set(part.loc[part["role"] == "stress", "kind"]))
            found[tuple(map(str, key))] = [CONTROL, *stress]
    return found


def draw_distance(path: Path, rows: pd.DataFrame, shown: Sequence[str]) -> None:
    """Draw the error along the way from `distance_frame`."""
    names, kinds = those_there(rows, shown), list(dict.fromkeys(rows["kind"]))
    note = (
        f"Error of the estimate, accepted or not: of a flight the largest in each {_BIN_M:g} m, of the flights the "
        f"median (line) and the 90th percentile (pale). At the top: no estimate. Dashed: {FIX_M:g} m. A distance that "
        "fewer than two flights reach is not drawn."
    )
    title = f"Error along the way: {of_which(rows.iloc[0])}"
    about = BoardPage(title=title, note=note, below="flown from the start (km)", keys=line_keys(names))
    for chart, kind in each_panel(path, kinds, about, "error of the estimate (m)"):
        mine = rows[rows["kind"] == kind]
        flights = int(mine["flights"].max())
        chart.set_title(f"{kind}\n{counted(flights, 'flight')} at most")
        chart.axhline(FIX_M, color="#999999", lw=0.8, ls="--")
        chart.set_yscale("log")
        chart.set_ylim(_LEAST_ERROR_M, _MOST_ERROR_M)
        chart.yaxis.set_ticks(_ERROR_TICKS_M, [f"{tick:g}" for tick in _ERROR_TICKS_M])
        chart.yaxis.set_ticks([], minor=True)
        chart.grid(visible=True, axis="y", color=FAINT, lw=0.6)
        for at, name in enumerate(names):
            line = mine[mine["matcher"] == name].sort_values("distance_m")
            look, far_km = look_of(at), line["distance_m"].to_numpy(float) / 1000
            half, most = (np.clip(line[column].to_numpy(float), _LEAST_ERROR_M, _MOST_ERROR_M) for column in _SHARES)
            chart.plot(far_km, half, color=look.colour, ls=look.dash, lw=1.4)
            chart.plot(far_km, most, color=look.colour, ls=look.dash, lw=0.8, alpha=0.45)
        chart.tick_params(labelbottom=True)


def draw_intervals(path: Path | None, rows: pd.DataFrame, shown: Sequence[str]) -> Figure:
    """Draw how far the odometer carries a fix from `interval_frame`."""
    names, kinds = those_there(rows, shown), list(dict.fromkeys(rows["kind"]))
    note = (
        f"Share of the flown distance within {FIX_M:g} m if of the accepted fixes one is used in so many metres at "
        "most and the odometer alone says the rest; nothing is known before the first fix. Of flights twice as long. "
        f"The tracker itself was shown every view. Dashed: 95 %. {INTERVALS}"
    ).replace("n: queries of each point.", "")
    title = f"How far the odometer carries a fix: {of_which(rows.iloc[0])}"
    about = BoardPage(title=title, note=note, below="flown between two uses of a fix (m)", keys=line_keys(names))
    for chart, kind in each_panel(path, kinds, about, _WITHIN_LABEL):
        mine = rows[rows["kind"] == kind]
        many = (counted(int(mine[name].iloc[0]), word) for name, word in (("n", "flight"), ("blocks", "block")))
        chart.set_title(f"{kind}\n{', '.join(many)}")
        ticks_across(chart, list(RECKONED_M), RECKONED_M[0] / 1.35, RECKONED_M[-1] * 1.35)
        dress_share(chart)
        chart.set_ylim(-0.03, 1.04)
        chart.axhline(0.95, color="#999999", lw=0.8, ls="--")
        for at, name in enumerate(names):
            line = mine[mine["matcher"] == name].sort_values("every_m")
            draw_line(chart, line, dodged(line["every_m"].to_numpy(float), at, len(names), by=0.03), at)
    return figure_of(chart)


def draw_drift(path: Path, rows: pd.DataFrame, shown: Sequence[str]) -> None:
    """Draw the share of the way within 25 m against the odometer's drift from `drift_frame`."""
    names, kinds, bins = those_there(rows, shown), sorted(set(rows["kind"])), sorted(set(rows["drift"]))
    note = (
        f"Share of the flown distance within {FIX_M:g} m, of flights whose odometer drifts so far: its mean error "
        f"{DRIFT_M:g} m after a true pose, over the way flown. Stress and falsifiers. {INTERVALS}"
    ).replace("n: queries of each point.", "")
    title = "Success against the drift of the odometer"
    about = BoardPage(title=title, note=note, below="drift of the odometer (% of the way)", keys=line_keys(names))
    for chart, kind in each_panel(path, kinds, about, _WITHIN_LABEL):
        mine = rows[rows["kind"] == kind]
        chart.set_title(f"{kind}\n{counted(int(mine['n'].min()), 'flight')} at least")
        chart.set_xlim(-0.5, len(bins) - 0.5)
        chart.xaxis.set_ticks(range(len(bins)), [_percent(one) for one in bins])
        dress_share(chart)
        chart.set_ylim(-0.03, 1.04)
        for at, name in enumerate(names):
            line = mine[mine["matcher"] == name].sort_values("drift")
            offset = 0.06 * (at - (len(names) - 1) / 2)
            draw_line(chart, line, np.array([bins.index(one) for one in line["drift"]]) + offset, at)


def _percent(name: str) -> str:
    """Return a bin of shares in percent.

    >>> _percent("0.01-0.02"), _percent("0.08-1")
    ('1 to 2', '8 and more')
    """
    low, high = (100 * float(end) for end in name.split("-"))
    return f"{low:g} to {high:g}" if high < _ALL else f"{low:g} and more"
