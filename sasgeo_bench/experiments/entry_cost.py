# SPDX-License-Identifier: Apache-2.0
"""Costs of entering a published board: what is drawn, asked and scored, and what is missing on this machine."""

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Final

from sasgeo_bench.errors import ConfigError, ExtractError, counted
from sasgeo_bench.experiments.pipeline_plan import PipelinePlan
from sasgeo_bench.leaderboard.board_files import read_board, read_scores
from sasgeo_bench.osm.locate import FOLDERS_VARIABLE, find_extract, find_parts, missing_files
from sasgeo_bench.progress import duration_text
from sasgeo_bench.scoring.contestants import AskedTask
from sasgeo_bench.scoring.rows import is_unranked
from sasgeo_bench.tasks import task_files
from sasgeo_bench.tasks.query import TASK_VERSION, base_of

# Measured with the boards `towns` and `modules` on one shared core: a guide, no promise.
_DRAW_S: Final = 0.1  # of a query
_BUILD_S: Final = 2.0  # of a map
_SCORE_S: Final = 0.002  # of a scored row of the board: read, scored, resampled
_FIT_S: Final = 0.006  # of a query and a rejector
_MAP_MB: Final = 2  # of a built map, on average over the shipped regions and their dates


def cost_lines(plan: PipelinePlan, stored: Path, tasks: Sequence[AskedTask]) -> Iterator[str]:
    """Yield what it costs to enter a board, and which of its queries are lost; `tasks` are those of the board.

    Asking takes as long as the fastest and the slowest row of the board took, on the machine where it was made.
    """
    queries = sum(len(task.asked) for task in tasks)
    yield f"{plan.spec.id}: {counted(queries, 'query', 'queries')} in {counted(len(tasks), 'task')}"
    names = {(str(task.about["suite"]), str(task.about["region"])): len(task.asked) for task in tasks}
    left = {name: count for name, count in names.items() if not _is_there(plan.out / "tasks", *name)}
    maps = sum(not (plan.out / "regions" / region).is_dir() for region in {region for _, region in names})
    count = sum(left.values())
    yield (
        f"  drawing about {duration_text(count * _DRAW_S + maps * _BUILD_S)}: {counted(count, 'query', 'queries')} and "
        f"{counted(maps, 'map')} are not there yet, about {maps * _MAP_MB} MB on disk"
    )
    scores = read_scores(stored)
    ranked = scores[~scores["matcher"].map(is_unranked).astype(bool)]
    means = sorted((float(some.mean()), str(name)) for name, some in ranked.groupby("matcher")["latency_s"])
    if means and means[-1][0] > 0:
        (fast_s, fast), (slow_s, slow) = means[0], means[-1]
        fast_text, slow_text = (duration_text(queries * seconds) for seconds in (fast_s, slow_s))
        yield f"  asking about {fast_text} at the speed of {fast}, {slow_text} at that of {slow}; --jobs divides it"
    seconds = len(scores) * _SCORE_S + queries * (_SCORE_S + _FIT_S * len(read_board(stored)[0].get("rejectors", ())))
    yield f"  scoring about {duration_text(seconds)}"


def lost_lines(plan: PipelinePlan, stored: Path, tasks: Sequence[AskedTask]) -> Iterator[str]:
    """Yield which queries of a board will have no answer: of older versions, sealed, or of regions left out."""
    about, seal = read_board(stored)[0], plan.seal
    if about.get("task_version") != TASK_VERSION:
        yield (
            f"  the board is of task version {about.get('task_version')}, and this program draws version "
            f"{TASK_VERSION}: those that changed in between, if any, are not asked and count as misses"
        )
    closed = set(about.get("sealed", {})) if seal is None or seal.seed is None else set()
    drawn = {item.region.id for item in (*plan.requests, *plan.controls)}
    places = {base_of(str(task.about["region"])): 0 for task in tasks}
    for task in tasks:
        places[base_of(str(task.about["region"]))] += len(task.asked)
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


def _is_there(tasks: Path, suite: str, region: str) -> bool:
    return (tasks / suite / region / task_files.TASK).is_file()
