# SPDX-License-Identifier: Apache-2.0
"""Costs of entering a published board: what is drawn, asked and scored, and what is missing on this machine."""

import json
import os
import sys
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Final, NamedTuple

from sasgeo_bench.boards.archive_file import RUNS
from sasgeo_bench.boards.board_files import MEND, read_board_manifest, read_scores
from sasgeo_bench.core.errors import ConfigError, ExtractError, StoreError, counted
from sasgeo_bench.core.parquet import read_table
from sasgeo_bench.core.progress import duration_text
from sasgeo_bench.experiments.pipeline_plan import PipelinePlan
from sasgeo_bench.matching.matcher import is_followed
from sasgeo_bench.osm.locate import FOLDERS_VARIABLE, find_extract, find_parts, missing_files
from sasgeo_bench.running import prediction_files
from sasgeo_bench.running.plan import RunPlan
from sasgeo_bench.scoring.rows import is_unranked
from sasgeo_bench.tasks.query import SEQUENCE, TASK_VERSION, base_of
from sasgeo_bench.tasks.task_files import Task

# Seconds of a free processor, measured by entering the board `systems-objects`: a guide, no promise.
_TASK_S: Final = 0.8  # of a task that is drawn
_MAP_S: Final = 0.4  # of a map that is built
_CELLS_S: Final = 0.12  # of a million cells of it
_START_S: Final = 1.0  # of a process of a matcher, one for each map
_SCORE_S: Final = 0.0025  # of a scored row of the board: read, scored, resampled
_SETUP_S: Final = 5.0  # of the program, and of reading the board
_FIT_S: Final = 0.006  # of a query and a rejector
_FAR: Final = 1.5  # times as slow as the middle half: worth a word
_MAP_MB: Final = 2  # of a built map, on average over the shipped regions and their dates


class Span(NamedTuple):
    """Seconds that something takes, at least and at most."""

    least_s: float
    most_s: float

    def to_text(self) -> str:
        """Return it in words.

        >>> [span.to_text() for span in (Span(30.0, 200.0), Span(200.0, 500.0), Span(4.1, 4.2))]
        ['30 s to 3 min', '3 to 8 min', 'about 4 s']
        """
        least, most = duration_text(self.least_s), duration_text(self.most_s)
        (number, unit), other = least.split(), most.split()[1]
        return f"about {least}" if least == most else f"{number if unit == other else least} to {most}"


def busyness(load: float, processors: int, jobs: int) -> float:
    """Return by how much a machine is slower than one with nothing else to do; `load` counts processes at work.

    >>> busyness(0.2, 2, 1), busyness(6.0, 2, 1)
    (1.0, 3.5)
    """
    return max(1.0, (load + jobs) / max(processors, jobs))


@dataclass(frozen=True, kw_only=True)
class OpenTask:
    """A task of a board that is asked here: whether it is drawn, and how many of its queries wait, by track."""

    region: str
    is_drawn: bool
    left: Mapping[str, float]


def open_tasks(plan: PipelinePlan, tasks: Sequence[Task], run: RunPlan | None, *, is_again: bool) -> list[OpenTask]:
    """Return the tasks of a board that can be asked here, with what is left of them.

    `run` is the plan of the matcher's runs, of which each row counts, or with `is_again` those of an open round alone;
    without it nothing is answered.
    """
    places = {item.region.id for item in (*plan.requests, *plan.controls)}
    since_ns = 0 if run is None else prediction_files.open_round(run.run_folder)
    since_ns = since_ns or (sys.maxsize if is_again else 0)
    found = []
    for task in tasks:
        suite, region = task.manifest.name
        if plan.requests and base_of(region) not in places:
            continue
        drawn = _drawn(plan.out / "tasks" / suite / region)
        left = {name for name, asked in task.asked.items() if drawn is None or drawn.get(name) == asked}
        if run is not None:
            folder = run.run_folder / suite / region
            left -= prediction_files.ids_done(folder, prediction_files.asked_in(folder, task.asked), since_ns=since_ns)
        share = len(left) / max(1, len(task.asked))
        counts = {track: count * share for track, count in task.manifest.counts.items()}
        found.append(OpenTask(region=region, is_drawn=drawn is not None, left=counts))
    return found


def _drawn(folder: Path) -> Mapping[str, str] | None:
    """Return the hashes of the queries of a task, None where there is no sound one: it is drawn anew."""
    with suppress(StoreError):
        return Task.open(folder).asked
    return None


def cost_lines(
    plan: PipelinePlan, stored: Path, tasks: Sequence[Task], run: RunPlan | None, *, is_again: bool
) -> Iterator[str]:
    """Yield what it costs to enter a board: how long, as a span, and what on disk; `tasks` are those of the board.

    The least is that of a free machine and a quick matcher, the most that of a slow matcher on this machine, as busy as
    it is now.
    """
    queries = sum(len(task.asked) for task in tasks)
    yield f"{plan.spec.id}: {counted(queries, 'query', 'queries')} in {counted(len(tasks), 'task')}"
    load, processors = os.getloadavg()[0], os.cpu_count() or 1
    busy = busyness(load, processors, plan.jobs)
    whole = open_tasks(plan, tasks, run, is_again=is_again)
    spans = []
    for line, least_s, most_s in (_drawing(plan, whole), _asking(stored, whole, run), _scoring(stored, queries)):
        jobs = 1 if line.startswith("scoring") else plan.jobs
        spans.append(Span(least_s / jobs, busy * most_s / jobs))
        yield f"  {line.format(spans[-1].to_text())}"
    note = f": the longer on this machine, with {load:.1f} processes at work on {counted(processors, 'processor')}"
    yield f"  in all {Span(*map(sum, zip(*spans, strict=True))).to_text()}{note if busy > 1 else ''}"
    if run is not None and run.learns:
        yield "  what it learns before comes on top"


class _Stage(NamedTuple):
    """A stage of an entry: a line with a place for its duration, and seconds of a free processor."""

    line: str
    least_s: float
    most_s: float


def _drawing(plan: PipelinePlan, whole: Sequence[OpenTask]) -> _Stage:
    """Return what it costs to draw the tasks that are not there, and to build their maps."""
    undrawn = [task for task in whole if not task.is_drawn]
    if not undrawn:
        return _Stage("nothing is left to draw", 0.0, 0.0)
    grids = {item.region.id: item.region.grid() for item in (*plan.requests, *plan.controls)}
    lacking = {task.region for task in undrawn if not (plan.out / "regions" / task.region).is_dir()}
    cells = sum(grids[base_of(name)].rows * grids[base_of(name)].cols for name in lacking if base_of(name) in grids)
    seconds = _SETUP_S + _TASK_S * len(undrawn) + _MAP_S * len(lacking) + _CELLS_S * cells / 1e6
    line = (
        f"drawing {{}}: {counted(len(undrawn), 'task')} and {counted(len(lacking), 'map')} are not there yet, about "
        f"{len(lacking) * _MAP_MB} MB on disk"
    )
    return _Stage(line, seconds, seconds)


def _asking(stored: Path, whole: Sequence[OpenTask], run: RunPlan | None) -> _Stage:
    """Return what it costs to ask what is left, as the middle half of a board's entries would take."""
    left: dict[str, float] = {}
    for task in whole:
        left |= {track: left.get(track, 0.0) + count for track, count in task.left.items()}
    count = round(sum(left.values()))
    if count == 0:
        return _Stage("nothing is left to ask: what is drawn here as on the board has answers", 0.0, 0.0)
    maps = len({task.region for task in whole if any(task.left.values())})
    costs = _costs(stored, left, maps, run)
    asking = f"asking {counted(count, 'query', 'queries')}"
    if not costs:
        line = f"{asking} {{}}, and what the matcher itself takes: no entry of the board is like it"
        return _Stage(line, maps * _START_S, maps * _START_S)
    quarter = (len(costs) - 1) // 4
    (least_s, _), (most_s, _), (last_s, slowest) = costs[quarter], costs[-1 - quarter], costs[-1]
    line = f"{asking} {{}}, as the middle half of {counted(len(costs), 'entry', 'entries')} of the board"
    if last_s > _FAR * most_s:
        line += f"; {slowest} took {last_s / most_s:.1f} times as long"
    return _Stage(line, least_s, most_s)


def _scoring(stored: Path, queries: int) -> _Stage:
    """Return what it costs to score one row beside those of a board."""
    rejectors = len(read_board_manifest(stored).rejectors)
    seconds = _SETUP_S + len(read_scores(stored)) * _SCORE_S + queries * (_SCORE_S + _FIT_S * rejectors)
    return _Stage("scoring {}", seconds, seconds)


def _costs(stored: Path, left: Mapping[str, float], maps: int, run: RunPlan | None) -> list[tuple[float, str]]:
    """Return how long each ranked entry of a board that answers what is asked would take, the quickest first.

    A process asks one query of each map twice. Who is asked single views and is no tracker takes as long for a view of
    a flight.
    """
    card = None if run is None else run.card
    follows = card is not None and is_followed(card)
    mine = {track: count for track, count in left.items() if card is None or follows or track in card.tracks}
    main = max(mine, key=lambda track: (track != SEQUENCE, mine[track]), default=None)
    scores = read_scores(stored)
    ranked = scores[~scores["matcher"].map(is_unranked).astype(bool)]
    prepare_s = _prepare_s(stored)
    costs = []
    for name, rows in ranked.groupby("matcher"):
        means = rows.groupby("track")["latency_s"].mean().to_dict()
        if main in means and means[main] > 0:
            match_s = sum(count * means.get(track, means[main]) for track, count in mine.items())
            start_s = maps * (_START_S + prepare_s.get(str(name), 0.0) + means[main])
            costs.append((match_s + start_s, str(name)))
    return sorted(costs)


def _prepare_s(stored: Path) -> dict[str, float]:
    """Return how long each entry of a board took to prepare a map, on average."""
    table = read_table(stored / RUNS, mend=MEND)
    found: dict[str, list[float]] = {}
    for name, about in zip(table["contestant"].to_pylist(), table["about"].to_pylist(), strict=True):
        found.setdefault(str(name), []).append(float(json.loads(about).get("prepare_s") or 0.0))
    return {name: sum(seconds) / len(seconds) for name, seconds in found.items()}


def lost_lines(plan: PipelinePlan, stored: Path, tasks: Sequence[Task]) -> Iterator[str]:
    """Yield which queries of a board will have no answer: of older versions, sealed, or of regions left out."""
    about, seal = read_board_manifest(stored), plan.seal
    if about.task_version != TASK_VERSION:
        yield (
            f"  the board is of task version {about.task_version}, and this program draws version "
            f"{TASK_VERSION}: those that changed in between, if any, are not asked and count as misses"
        )
    closed = set(about.sealed) if seal is None or seal.seed is None else set()
    drawn = {item.region.id for item in (*plan.requests, *plan.controls)}
    places = {base_of(task.manifest.region): 0 for task in tasks}
    for task in tasks:
        places[base_of(task.manifest.region)] += len(task.asked)
    sealed = sum(count for place, count in places.items() if place in closed)
    if sealed:
        yield f"  {sealed} of the queries are of sealed places, and count as misses without --sealed-seed-file"
    out = {name: count for name, count in places.items() if name not in closed | drawn} if plan.requests else {}
    if out:
        names = ", ".join(sorted(out))
        yield f"  a partial entry: {sum(out.values())} of the queries count as misses, of regions left out ({names})"
    yield from (f"  {line.strip()}" for line in (() if seal is None else seal.lines()))


def missing_extracts(plan: PipelinePlan) -> tuple[str, ...]:
    """Return the names of extracts that the queries are drawn from and this machine lacks."""
    requests = (*plan.requests, *plan.controls)
    extracts = [extract for request in requests for extract in request.extracts]
    return missing_files(extracts, folders=plan.requests[0].extract_folders if plan.requests else ())


def fetch_extracts(plan: PipelinePlan, *, mend: str = "") -> None:
    """Download missing extracts where a server has them.

    Raise `ConfigError` that names all that are still missing; `mend` is what else can be done.
    """
    lost = set(missing_extracts(plan))
    folders = plan.requests[0].extract_folders if plan.requests else ()
    named = {one.file: one for request in plan.requests for one in request.extracts if one.town is None} if lost else {}
    failed: set[str] = set()
    for extract in named.values():
        names = {extract.file, *(part.file for part in extract.also)} & lost
        if not names:
            continue
        try:
            find_extract(extract, folders=folders)
            find_parts(extract, folders=folders)
        except ExtractError:
            failed |= names
    if failed:
        raise ConfigError(missing_text(sorted(failed)) + mend)


def missing_text(names: Sequence[str]) -> str:
    """Return which extracts are missing, and where to put them.

    >>> missing_text(["a.osm.pbf"])
    'missing extracts: a.osm.pbf: put them into a folder that --extracts or SASGEO_EXTRACTS names'
    """
    return f"missing extracts: {', '.join(names)}: put them into a folder that --extracts or {FOLDERS_VARIABLE} names"
