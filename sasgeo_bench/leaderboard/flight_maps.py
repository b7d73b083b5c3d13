# SPDX-License-Identifier: Apache-2.0
"""Maps of a flight, one for each tracker: the true path, the estimates, and which of them were accepted."""

from collections.abc import Mapping, Sequence
from typing import Any, Final

import cv2
import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.lines import Line2D
from numpy.typing import NDArray

from sasgeo_bench.canvas import Page, page, panels
from sasgeo_bench.errors import StoreError, counted
from sasgeo_bench.files.scratch import scratch_folder
from sasgeo_bench.regions import region_files
from sasgeo_bench.regions.region import ATTRIBUTION
from sasgeo_bench.scoring.score import FIX_M
from sasgeo_bench.tasks.flight_sheet import Ground, bounds_of_m, draw_flight, flight_keys, flight_panels
from sasgeo_bench.tasks.task_files import Task

MOST_TRACKERS: Final = 6
_ACROSS: Final = 3
_INCHES: Final = 3.4
_ONE_INCHES: Final = 6.4  # of a panel alone
_RIGHT, _FALSE, _WITHHELD = "#00897b", "#d50000", "#5c6bc0"
_LINE: Final[dict[str, Any]] = {"color": _WITHHELD, "lw": 1.0}
_IS_RIGHT: Final[dict[str, Any]] = {"color": "none", "marker": "o", "mfc": _RIGHT, "mec": "white", "ms": 6}
_IS_FALSE: Final[dict[str, Any]] = {"color": "none", "marker": "X", "mfc": _FALSE, "mec": "white", "ms": 7}
_IS_WITHHELD: Final[dict[str, Any]] = {"color": "none", "marker": "o", "mfc": _WITHHELD, "mec": "none", "ms": 4}


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
        facts=f"One flight, {truth.role}: {truth.kind}. {about.what}",
        note="North is up." + (" Trackers differ most on this flight of the suite." if len(names) > 1 else ""),
        data=ATTRIBUTION,
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
        (is_posed, "estimates, in order", _LINE),
        (accepted & is_near, f"accepted, within {FIX_M:g} m", _IS_RIGHT),
        (accepted & ~is_near, f"accepted, beyond {FIX_M:g} m", _IS_FALSE),
        (is_posed & ~accepted, "not accepted", _IS_WITHHELD),
    )
    return [Line2D([], [], label=label, **style) for marked, label, style in kinds if marked.any()]


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
