# SPDX-License-Identifier: Apache-2.0
"""Panels of a contact sheet: a query's view, the map at the truth, and the map at its rival."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Final

import numpy as np

from sasgeo_bench.errors import ConfigError, StoreError, counted
from sasgeo_bench.geometry.pose import Pose
from sasgeo_bench.osm.taxonomy import load_taxonomy
from sasgeo_bench.regions import region_files
from sasgeo_bench.regions.evidence import Evidence
from sasgeo_bench.tasks.build import built_anew
from sasgeo_bench.tasks.query import TWIN_EAST, TWIN_NORTH, Query, Truth
from sasgeo_bench.tasks.sheet import TWIN, Panel
from sasgeo_bench.tasks.state import State
from sasgeo_bench.tasks.suites.base import changed_share
from sasgeo_bench.tasks.suites.mining import describe, mine
from sasgeo_bench.tasks.task_files import QUERIES, Task

SOME_IDS: Final = 3  # that the refusal of an unknown id names


def panels(
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
        raise StoreError(built_anew(name))
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
        twin = view(replace(truth.pose, easting_m=easting_m, northing_m=northing_m))
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
