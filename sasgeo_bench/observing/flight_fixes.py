# SPDX-License-Identifier: Apache-2.0
"""The fixes of one flight, out of the answers of a run or the results of `locate`: what is replayed and written."""

import csv
import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final, Literal, Self

import numpy as np
from numpy.typing import NDArray

from sasgeo_bench.core.errors import ConfigError, StoreError, counted
from sasgeo_bench.core.paths import plain_file
from sasgeo_bench.core.progress import tell
from sasgeo_bench.geometry.pose import normalize_deg, reckon, rotation
from sasgeo_bench.geometry.projection import to_lonlat, true_north_deg
from sasgeo_bench.matching.matcher import Prediction
from sasgeo_bench.matching.tracker import SIDE
from sasgeo_bench.observing.fix_files import NS, PlacedFix
from sasgeo_bench.observing.locate import ANSWERS, read_answers
from sasgeo_bench.observing.results import TABLE, placed
from sasgeo_bench.regions.region import ATTRIBUTION
from sasgeo_bench.regions.region_files import read_manifest
from sasgeo_bench.running.prediction_files import RUN, Answers, RunManifest
from sasgeo_bench.tasks.flight_sampling import UTC
from sasgeo_bench.tasks.query import Head, Truth
from sasgeo_bench.tasks.task_files import TASK, Task

Floats = NDArray[np.float64]
Clock = Literal["utc", "camera", "flight"]

_JUMP_SIGMAS: Final = 3.0  # between what two fixes and the odometer say, in standard deviations of the fixes
_JUMP_M: Final = 25.0  # the same where a fix has no covariance: what counts as the right place
_NAMED: Final = 4


@dataclass(frozen=True, kw_only=True)
class FlightFixes:
    """The fixes of one flight in the order of time, accepted or not; views without an answer are counted alone.

    Parameters
    ----------
    flight : str
        Its id, or the name of a folder of pictures.
    fixes : tuple of PlacedFix
        At least one.
    views : int
        How many there are, with those that have no answer.
    begin_ns : int
        Time of the first view, on the clock of the fixes.
    clock : {"utc", "camera", "flight"}
        What the times of the fixes count from: 1970 by UTC, 1970 by a camera's clock, or the first view.
    epsg : int, optional
        CRS of the map; the results of `locate` do not name it.
    credit : str
        Whose map data it is.
    """

    flight: str
    fixes: tuple[PlacedFix, ...]
    views: int
    begin_ns: int
    clock: Clock
    epsg: int | None
    credit: str = ATTRIBUTION

    @property
    def accepted(self) -> tuple[PlacedFix, ...]:
        """Return the accepted fixes."""
        return tuple(fix for fix in self.fixes if fix.is_accepted)

    @property
    def start_ns(self) -> int | None:
        """Return when the first view was taken, nanoseconds since 1970; None where that is not known."""
        return None if self.clock == "flight" else self.begin_ns

    def starting(self, start_ns: int) -> Self:
        """Return the same flight, begun at another time: nanoseconds since 1970, UTC."""
        later_ns = start_ns - self.begin_ns
        fixes = tuple(replace(fix, time_ns=(fix.time_ns or 0) + later_ns) for fix in self.fixes)
        return replace(self, fixes=fixes, begin_ns=start_ns, clock="utc")


def read_flight_fixes(folder: Path, *, flight: str | None = None, tasks: Path | None = None) -> FlightFixes:
    """Read the fixes of one flight.

    Parameters
    ----------
    folder : Path
        Of a run, with its `run.json` or above it, or the results of `locate`.
    flight : str, optional
        How the id of the flight begins; needed where there are several.
    tasks : Path, optional
        Folder of the task that was answered; by default where `run` found it, below the same root.

    Returns
    -------
    FlightFixes
        Times are those of the views, by UTC where the flight has a log that tells it. The delay of a fix is its
        measured latency and the wait for the answers before it, since one computer gives them one by one.

    Raises
    ------
    ConfigError
        If there are several runs or flights and none is chosen, the run is of single views, or it has no fix.
    StoreError
        If the run, its task or its truths are missing or damaged.
    """
    if (folder / TABLE).is_file():
        if flight is not None or tasks is not None:
            raise ConfigError(
                f"{folder} holds located pictures, one flight and no task: leave out --flight and --tasks"
            )
        return _located(folder)
    run = _run_in(folder)
    manifest = RunManifest.open(run) or RunManifest()
    root = list(run.resolve().parents)[:5][-1]  # above runs/NAME/HASH/SUITE
    task_folder = tasks or root / "tasks" / manifest.suite / manifest.region
    if not (task_folder / TASK).is_file():
        raise StoreError(f"{task_folder} holds no task that {run} answers: name its folder by --tasks")
    task = Task.open(task_folder)
    if not task.manifest.is_of_flights:
        raise ConfigError(
            f"{run} answers single views of suite {task.manifest.suite}, and no flight: draw one, as with make-queries "
            "--suite flight-clean, and run a tracker or a matcher on it"
        )
    task.check_truths()
    answers = Answers.open(run, task.asked).found
    if not answers:
        raise ConfigError(f"{run} answers no query of {task_folder}: run the matcher again")
    return _of_task(task, answers, flight, run)


def _run_in(folder: Path) -> Path:
    """Return the one run in a folder; raise what says which there are."""
    if not folder.is_dir():
        raise StoreError(f"there is no folder {folder}: name that of a run, as run prints it, or of locate")
    found = sorted(path.parent for path in folder.rglob(RUN))
    if len(found) == 1:
        return found[0]
    if not found:
        raise StoreError(f"{folder} holds no run and no {TABLE}: name the folder of a run, as run prints it")
    shown = ", ".join(map(str, found[:_NAMED])) + (", ..." if len(found) > _NAMED else "")
    raise ConfigError(f"{folder} holds {len(found)} runs, name one: {shown}")


def _of_task(task: Task, answers: Mapping[str, Prediction], flight: str | None, run: Path) -> FlightFixes:
    flights: dict[str, list[tuple[Head, Truth]]] = {}
    for head, truth in zip(sorted(task.heads(), key=lambda head: head.query_id), task.truths, strict=True):
        flights.setdefault(head.sequence_id or "", []).append((head, truth))
    flights = {name: views for name, views in flights.items() if any(head.query_id in answers for head, _ in views)}
    name = _chosen(flights, flight, run)
    views = flights[name]
    missing = next((truth.query_id for _, truth in views if "time_s" not in truth.measured), None)
    if missing is not None:
        raise StoreError(f"view {missing} has no time, it was drawn by an older program: make the queries again")
    # every truth of a logged flight tells UTC, or none
    is_utc = all(UTC in truth.measured for _, truth in views)
    times_ns = [round(truth.measured[UTC if is_utc else "time_s"] * 1000) * (NS // 1000) for _, truth in views]
    epsg = task.manifest.epsg or read_manifest(task.region).epsg
    fixes = _placed([head for head, _ in views], [answers.get(head.query_id) for head, _ in views], times_ns, epsg)
    if not fixes:
        raise ConfigError(
            f"none of the {counted(len(views), 'view')} of flight {name} has an answer: see inspect {run}"
        )
    return FlightFixes(
        flight=name,
        fixes=tuple(fixes),
        views=len(views),
        begin_ns=times_ns[0],
        clock="utc" if is_utc else "flight",
        epsg=epsg,
        credit=task.manifest.credit,
    )


def _chosen(flights: Mapping[str, Sequence[tuple[Head, Truth]]], flight: str | None, run: Path) -> str:
    """Return the flight whose id begins so, or the only one; raise what lists them."""
    found = [name for name in flights if name.startswith(flight or "")]
    if len(found) == 1:
        return found[0]
    # Several flights follow one log: with odometers of several kinds, and as their control.
    listed = [
        f"{name} ({flights[name][0][1].kind}, {counted(len(flights[name]), 'view')})" for name in found or flights
    ]
    shown = ", ".join(listed[:_NAMED]) + (", ..." if len(listed) > _NAMED else "")
    if flight is None:
        raise ConfigError(f"{run} answers {len(flights)} flights, name one by --flight: {shown}")
    fault = f"{len(found)} flights begin with {flight!r}" if found else f"no flight begins with {flight!r}"
    raise ConfigError(f"{fault}: name one of {shown}")


def _placed(
    heads: Sequence[Head], found: Sequence[Prediction | None], times_ns: Sequence[int], epsg: int
) -> list[PlacedFix]:
    """Return the fixes among the answers to the views of one flight, in order."""
    # A view without an answer stays in its place: the odometer led past it.
    answers = [
        one or Prediction(query_id=head.query_id, status="crash") for head, one in zip(heads, found, strict=True)
    ]
    # What failed or hung is no part of a fix's delay: the runner ended it.
    latencies_s = [0.0 if answer.status != "ok" else answer.latency_s for answer in answers]
    delays_s = _delays_s(latencies_s, times_ns)
    at = [index for index, answer in enumerate(answers) if answer.status == "ok" and answer.candidates]
    poses = [answers[index].candidates[0][0] for index in at]
    if not poses:
        return []
    en_m = np.array([(pose.easting_m, pose.northing_m) for pose in poses])
    lon_deg, lat_deg = (np.asarray(one) for one in to_lonlat(epsg).transform(*en_m.T))
    north_deg = true_north_deg(lon_deg, lat_deg, epsg)
    heading_deg = normalize_deg([pose.yaw_deg for pose in poses] - north_deg)
    fixes: list[PlacedFix] = []
    last: int | None = None  # index of the accepted fix before
    for row, index in enumerate(at):
        answer = answers[index]
        is_accepted = answer.is_accepted is not False
        is_jump = False
        if is_accepted:
            is_jump = last is not None and _is_jump(heads, answers, last, index)
            last = index
        fixes.append(
            PlacedFix(
                name=answer.query_id,
                lon_deg=float(lon_deg[row]),
                lat_deg=float(lat_deg[row]),
                east_m=float(en_m[row, 0]),
                north_m=float(en_m[row, 1]),
                heading_deg=float(heading_deg[row]),
                yaw_deg=poses[row].yaw_deg,
                is_accepted=is_accepted,
                p_false=None if answer.confidence is None else 1.0 - answer.confidence,
                covariance=None if answer.covariance is None else _turned(answer.covariance, float(north_deg[row])),
                time_ns=times_ns[index],
                delay_s=delays_s[index],
                is_jump=is_jump,
            )
        )
    return fixes


def _delays_s(latencies_s: Sequence[float | None], times_ns: Sequence[int]) -> list[float | None]:
    """Return how long after each view its answer is there, if one computer answers them in order.

    None from the first answer on whose latency is not known.
    """
    found: list[float | None] = []
    free_s = -math.inf
    for latency_s, time_ns in zip(latencies_s, times_ns, strict=True):
        if latency_s is None:
            break
        view_s = (time_ns - times_ns[0]) / NS
        free_s = max(view_s, free_s) + latency_s
        found.append(free_s - view_s)
    return [*found, *[None] * (len(times_ns) - len(found))]


def _turned(covariance: Sequence[float], north_deg: float) -> tuple[float, ...]:
    """Return a covariance of east, north and yaw in the grid as one against true north, at this bearing in it."""
    turn = np.eye(SIDE)
    turn[:2, :2] = rotation(-north_deg)
    return tuple((turn @ np.reshape(covariance, (SIDE, SIDE)) @ turn.T).ravel().tolist())


def _is_jump(heads: Sequence[Head], answers: Sequence[Prediction], before: int, now: int) -> bool:
    """Return whether a fix lies elsewhere than the odometer leads to from the fix before."""
    increments = [head.increment for head in heads[before + 1 : now + 1]]
    known = [one for one in increments if one is not None]
    if len(known) < len(increments):
        return True
    (old, _), (new, _) = answers[before].candidates[0], answers[now].candidates[0]
    reckoned_m = reckon([old.easting_m, old.northing_m], old.yaw_deg, known)[-1]
    off_m = math.dist(reckoned_m, (new.easting_m, new.northing_m))
    spreads = [one.covariance for one in (answers[before], answers[now])]
    variances = [one[0] + one[SIDE + 1] for one in spreads if one is not None]
    return off_m > (_JUMP_SIGMAS * math.sqrt(sum(variances)) if len(variances) == len(spreads) else _JUMP_M)


def _located(folder: Path) -> FlightFixes:
    """Return the fixes of the last call of `locate` into a folder, of pictures whose cameras told the time."""
    with plain_file(folder / TABLE).open(encoding="utf-8", newline="") as file:
        rows = {(row.get("file"), row.get("lon"), row.get("lat")) for row in csv.DictReader(file)}
    known = [placed(fix) for fix in read_answers(folder / ANSWERS).values()]
    # Answers of earlier calls are kept beside: the table says which are of the last one.
    of_last = [fix for fix in known if fix is not None and (fix.name, str(fix.lon_deg), str(fix.lat_deg)) in rows]
    fixes = list({fix.name: fix for fix in of_last}.values())
    timed = sorted((fix for fix in fixes if fix.time_ns is not None), key=lambda fix: (fix.time_ns or 0, fix.name))
    if not timed:
        why = "its cameras told no time" if fixes else f"{TABLE} lists no place"
        raise ConfigError(f"{folder} has no fix that can be replayed: {why}")
    if len(timed) < len(fixes):
        tell(f"{counted(len(fixes) - len(timed), 'picture')} without a time: left out")
    times_ns = [fix.time_ns or 0 for fix in timed]
    delays_s = _delays_s([fix.delay_s for fix in timed], times_ns)
    timed = [replace(fix, delay_s=delay_s) for fix, delay_s in zip(timed, delays_s, strict=True)]
    return FlightFixes(
        flight=re.sub(r"[^\w.-]+", "-", folder.name) or "pictures",
        fixes=tuple(timed),
        views=len(rows),
        begin_ns=times_ns[0],
        clock="camera",
        epsg=None,
    )
