# SPDX-License-Identifier: Apache-2.0
"""The page of one flight that plays: views, map, estimates with their ellipses; one file that needs no server."""

import base64
import math
from collections.abc import Mapping, Sequence
from typing import Final

import cv2
import numpy as np
import pandas as pd
from numpy.typing import NDArray
from scipy.stats import chi2

from sasgeo_bench.boards.site import environment
from sasgeo_bench.core.errors import StoreError
from sasgeo_bench.matching.matcher import Prediction
from sasgeo_bench.osm.taxonomy import load_taxonomy
from sasgeo_bench.regions import region_files
from sasgeo_bench.regions.painting import paint_evidence
from sasgeo_bench.scoring.flights import SHARE_INSIDE
from sasgeo_bench.scoring.relative_pose import relative_errors
from sasgeo_bench.scoring.score import FIX_M
from sasgeo_bench.tasks.query import Query
from sasgeo_bench.tasks.sheet import Ground, bounds_of_m, flight_panels, flight_title
from sasgeo_bench.tasks.task_files import Task

Pixels = NDArray[np.uint8]

MOST_VIEWS: Final = 1000  # on a page; of more every second, third or further one is shown
_SIDE_PX: Final = 112  # of a view
_ACROSS: Final = 20  # views in a row of their sheet
_MAP_PX: Final = 1400
_MOST_BYTES: Final = 3_300_000  # of all pictures, so that a page stays below 5 MB
_BARS_M: Final = (50, 100, 200, 500, 1000, 2000)
_QUALITIES: Final = (80, 60, 45, 30, 20, 10)  # of WebP, best first


def flight_page(task: Task, flight: str, tracker: str, views: pd.DataFrame, answers: Mapping[str, Prediction]) -> str:
    """Return the page of a flight as HTML.

    Parameters
    ----------
    task : Task
        Its map and truths lie below the root that holds it.
    flight : str
        Id of the flight.
    tracker : str
        Name of what answered.
    views : DataFrame
        Rows of `scoring.flights.view_frame`; those of other flights are passed over.
    answers : mapping of str to Prediction
        By the id of the query.

    Raises
    ------
    StoreError
        If the map or the truths are missing, or others than the queries were drawn with.
    """
    manifest = region_files.read_manifest(task.region)
    if not task.manifest.is_of_map(manifest):
        raise StoreError(f"{task.region} was built anew since the queries were drawn: make them again")
    (panel,) = flight_panels(task, flight=flight)
    mine = views[views["sequence_id"] == flight].sort_values("frame")
    step = math.ceil(len(mine) / MOST_VIEWS)
    shown = mine.iloc[::step].reset_index(drop=True)
    ground = Ground.of(task.region, manifest, bounds_of_m([panel]))
    seen = _sheets(task, shown["query_id"].tolist())
    west, east, _, north = ground.extent_m
    rows, cols = ground.picture.shape[:2]
    scale = min(1.0, _MAP_PX / max(rows, cols))
    width, height = max(1, round(cols * scale)), max(1, round(rows * scale))
    painted = cv2.resize(np.rint(255 * ground.picture).astype(np.uint8), (width, height), interpolation=cv2.INTER_AREA)
    per_m = width / (east - west)
    origin = (west, north, per_m)
    return (
        environment()
        .get_template("flight.html")
        .render(
            title=f"{tracker} on {task.manifest.suite} over {task.manifest.region}",
            tracker=tracker,
            flight=flight,
            kind=flight_title(panel.truth),
            what=task.manifest.what,
            left_out=step > 1 and f"One of {step} of the {len(mine)} views is shown.",
            credit=task.manifest.credit,
            facts=_facts(mine),
            keys=[(item.title, item.colour) for item in load_taxonomy().classes if item.name in manifest.classes],
            map_uri=_uri(np.asarray(painted, dtype=np.uint8), 80),
            sheets=seen,
            size=(width, height),
            per_m=per_m,
            bar_m=max((one for one in _BARS_M if one * per_m < width / 3), default=_BARS_M[0]),
            data=_data(shown, answers, origin, panel.prior_m),
            near_m=FIX_M,
        )
    )


def _facts(views: pd.DataFrame) -> list[tuple[str, str]]:
    """Return names and values of what sums up a flight; errors are of all views, infinite without an estimate."""
    errors_m = views["error_m"].to_numpy(float)
    accepted, near = views["is_accepted"].to_numpy(bool), errors_m <= FIX_M
    ate_m = math.sqrt(float(np.mean(errors_m**2)))
    p50_m, p95_m = np.quantile(errors_m, [0.5, 0.95], method="inverted_cdf").tolist()
    return [
        ("views", f"{len(views)}"),
        ("flown", f"{views['distance_m'].iloc[-1]:.0f} m in {views['time_s'].iloc[-1]:.0f} s"),
        (f"estimates within {FIX_M:g} m", f"{near.sum()}"),
        ("accepted fixes", f"{accepted.sum()}, {(accepted & ~near).sum()} of them false"),
        ("error p50, p95", f"{p50_m:.1f} m, {p95_m:.1f} m"),
        ("ATE, nothing aligned", f"{ate_m:.1f} m"),
        *(
            (f"RPE over {one.length_m:g} m", f"{one.position_m:.1f} m, {one.yaw_deg:.1f} deg ({one.pairs} pairs)")
            for one in relative_errors(views)
        ),
    ]


def _data(
    views: pd.DataFrame,
    answers: Mapping[str, Prediction],
    origin: tuple[float, float, float],
    prior_m: tuple[float, float, float] | None,
) -> dict[str, object]:
    """Return what the page's script shows, places in pixels of the map, right and down."""
    west, north, per_m = origin

    def across(values: NDArray[np.float64]) -> list[float | None]:
        return _numbers((values - west) * per_m, 1)

    def down(values: NDArray[np.float64]) -> list[float | None]:
        return _numbers((north - values) * per_m, 1)

    column = {name: views[name].to_numpy(float) for name in views.columns if views[name].dtype.kind in "fiub"}
    ellipses = [ellipse_of(answers.get(name), per_m) for name in views["query_id"]]
    confidences = [answers[name].confidence if name in answers else None for name in views["query_id"]]
    return {
        "frame": views["frame"].astype(int).tolist(),
        "time": _numbers(column["time_s"], 1),
        "flown": _numbers(column["distance_m"], 0),
        "trueX": across(column["true_east_m"]),
        "trueY": down(column["true_north_m"]),
        "trueYaw": _numbers(column["true_yaw_deg"], 1),
        "x": across(column["east_m"]),
        "y": down(column["north_m"]),
        "yaw": _numbers(column["yaw_deg"], 1),
        "error": _numbers(column["error_m"], 1),
        "yawError": _numbers(column["yaw_error_deg"], 1),
        "accepted": views["is_accepted"].astype(int).tolist(),
        "confidence": [None if one is None else round(one, 3) for one in confidences],
        "status": views["status"].tolist(),
        "ellipse": ellipses,
        "prior": None
        if prior_m is None
        else [round(at * per_m, 1) for at in (prior_m[0] - west, north - prior_m[1], prior_m[2])],
    }


def _numbers(values: NDArray[np.float64], digits: int) -> list[float | None]:
    return [round(value, digits) if math.isfinite(value) else None for value in values.tolist()]


def ellipse_of(answer: Prediction | None, per_m: float) -> tuple[float, float, float] | None:
    """Return half axes and turn of the ellipse that holds the true place in 95 %, in pixels and degrees.

    The turn is that of the longer axis from the right, clockwise, as SVG turns what is drawn. None without a
    covariance that is positive.

    >>> ellipse_of(Prediction(query_id="", covariance=(4.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0)), 1.0)
    (4.9, 2.45, 0.0)
    """
    if answer is None or answer.covariance is None:
        return None
    in_plane = np.array(answer.covariance).reshape(3, 3)[:2, :2]
    if not np.isfinite(in_plane).all():
        return None
    spreads, axes = np.linalg.eigh(in_plane)
    if not spreads[0] > 0:
        return None
    half = np.sqrt(spreads * chi2.ppf(SHARE_INSIDE, 2)) * per_m
    east, north = axes[:, 1]
    turn_deg = math.degrees(math.atan2(-north, east))
    turn_deg = (turn_deg + 90.0) % 180.0 - 90.0
    return (round(float(half[1]), 2), round(float(half[0]), 2), round(turn_deg, 1) + 0.0)


def _sheets(task: Task, ids: Sequence[str]) -> list[dict[str, object]]:
    """Return sheets of small views, in their order: what was seen, and the pictures if there are any."""
    at = {name: number for number, name in enumerate(ids)}
    size = (-(-len(ids) // _ACROSS) * _SIDE_PX, min(len(ids), _ACROSS) * _SIDE_PX)
    seen, pictures = (np.full((*size, 3), 158, dtype=np.uint8) for _ in range(2))
    has_pictures = False
    for query, _, _ in task.some(at):
        row, col = divmod(at[query.query_id], _ACROSS)
        cut = np.s_[row * _SIDE_PX : (row + 1) * _SIDE_PX, col * _SIDE_PX : (col + 1) * _SIDE_PX]
        seen[cut] = _small(np.rint(255 * paint_evidence(query.evidence)).astype(np.uint8))
        if query.frames:
            has_pictures = True
            pictures[cut] = _newest(query)
    named = [("what was seen", seen), *([("picture", pictures)] if has_pictures else [])]
    for quality in _QUALITIES:
        uris = [(title, _uri(sheet, quality)) for title, sheet in named]
        if sum(len(uri) for _, uri in uris) <= _MOST_BYTES:
            break
    rows, cols = size[0] // _SIDE_PX, size[1] // _SIDE_PX
    return [{"title": title, "uri": uri, "rows": rows, "cols": cols} for title, uri in uris]


def _small(rgb: Pixels) -> Pixels:
    how = cv2.INTER_AREA if min(rgb.shape[:2]) > _SIDE_PX else cv2.INTER_NEAREST
    return np.asarray(cv2.resize(rgb, (_SIDE_PX, _SIDE_PX), interpolation=how), dtype=np.uint8)


def _newest(query: Query) -> Pixels:
    """Return the middle square of the newest picture."""
    rgb = query.frames[-1].image().rgb
    side = min(rgb.shape[:2])
    top, left = ((length - side) // 2 for length in rgb.shape[:2])
    return _small(np.ascontiguousarray(rgb[top : top + side, left : left + side]))


def _uri(rgb: Pixels, quality: int) -> str:
    _, data = cv2.imencode(".webp", rgb[..., ::-1], [cv2.IMWRITE_WEBP_QUALITY, quality])
    return f"data:image/webp;base64,{base64.b64encode(data.tobytes()).decode()}"
