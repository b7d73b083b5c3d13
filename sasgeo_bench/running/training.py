# SPDX-License-Identifier: Apache-2.0
"""Train a matcher before the first query: once for each training set, in its own process, kept as a text."""

from collections.abc import Iterable, Iterator, Sequence
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from sasgeo_bench.core.folders import locked, scratch_folder
from sasgeo_bench.core.progress import tell
from sasgeo_bench.core.texts import one_line
from sasgeo_bench.geometry.grid import Grid
from sasgeo_bench.geometry.pose import Prior
from sasgeo_bench.matching.cards import read_learned, write_learned
from sasgeo_bench.regions.evidence import PRESENT, UNKNOWN
from sasgeo_bench.regions.region import Region
from sasgeo_bench.running.plan import PackedTraining, RunPlan, reach_of, with_training_result
from sasgeo_bench.running.training_tasks import TrainingSet, read_pairs
from sasgeo_bench.running.worker import AnyCard, Found, PluginReply, Reply, Worker, guarded
from sasgeo_bench.sensing.segmentation import Segmentation, tables_of
from sasgeo_bench.tasks.query import Query


def trained(plan: RunPlan) -> RunPlan:
    """Train a matcher, if there is a training set, a pending query, and no earlier result. Tell its outcome.

    After a failed training, every query gets its cause for an answer.

    Raises
    ------
    StoreError
        If a task was made anew meanwhile, or the learned text cannot be stored.
    """
    given, path = plan.training_set, plan.learned_file
    is_pending = plan.training_result is None and any(part.left for part in plan.parts)
    if isinstance(given, PackedTraining) or given is None or path is None or not is_pending:
        return plan
    with locked(path):
        text = read_learned(path)
        if text is None:
            reply = _learn(plan, given)
            if reply.status != "ok" or reply.learned is None:
                failed = failed_training(reply)
                tell(f"{plan.card.name}: {failed.message} ({failed.status}), learning from {given.to_text()}")
                return with_training_result(plan, failed)
            write_learned(path, reply.learned)
            text = reply.learned
            tell(f"{plan.card.name}: trained on {given.to_text()} in {reply.seconds or 0.0:.1f} s, {path}")
    return with_training_result(plan, Reply(status="ok", learned=text))


def _learn(plan: RunPlan, training_set: TrainingSet) -> Reply:
    """Train in a process of its own, which may read the maps and is sent the truths."""
    request, regions = plan.request, training_set.regions
    pairs = read_pairs(training_set)
    reach = reach_of(request, tuple(regions.values()))
    with Worker(spec=request.spec, reach=reach, limits=request.limits) as worker:
        return guarded(partial(worker.learn, regions, pairs), plan.run_folder, plan.card.name)


def failed_training(reply: PluginReply[AnyCard, Found]) -> PluginReply[AnyCard, Found]:
    """Return the reply to a failed training, whose message all rows get."""
    if reply.status == "ok":
        return PluginReply(status="invalid", message="while learning: no text in an answer")
    return PluginReply(status=reply.status, message=one_line(f"while learning: {reply.message}"))


# A query and the segmentations of its frames, None where it failed
SegmentedQuery = tuple[Query, Sequence[Segmentation | None]]


def recalibrated(segmented: Iterable[SegmentedQuery], region: Region) -> Iterator[SegmentedQuery]:
    """Yield queries with their segmentations recalibrated together, as those of one flight over the region.

    The log-odds of a class are shifted by one number for all pictures, so that its mean probability is its share of
    the map within the priors of the queries. One picture alone would tell too little: a wood in a town has no roofs.
    Until all are seen, segmentations lie in a temporary folder.
    """
    totals: dict[str, NDArray[np.int64]] = {}
    with scratch_folder("seen") as folder:
        queries = []
        for at, (query, seen) in enumerate(segmented):
            queries.append(query)
            for number, one in enumerate(seen):
                if one is not None:
                    _file(folder, at, number).write_bytes(one.to_bytes())
                    for name, count in one.counts().items():
                        totals[name] = totals.get(name, 0) + count
        shares = shares_within([query.prior for query in queries], region)
        tables = tables_of(totals, {name: share for name, share in shares.items() if name in totals})
        for at, query in enumerate(queries):
            files = (_file(folder, at, number) for number in range(len(query.frames)))
            yield (
                query,
                [Segmentation.from_bytes(one.read_bytes()).recoded(tables) if one.is_file() else None for one in files],
            )


def _file(folder: Path, at: int, number: int) -> Path:
    return folder / f"{at}-{number}"


def shares_within(priors: Sequence[Prior], region: Region) -> dict[str, float]:
    """Return the fraction of the mapped ground that each class covers, over the discs of priors.

    Without a disc the whole map counts. A class of which nothing is mapped there is left out.
    """
    weights = sum((_within(prior, region.grid) for prior in priors), np.zeros(region.grid.shape, dtype=np.int64))
    found = {}
    for name, layer in zip(region.classes, region.layers, strict=True):
        mapped = float(weights[layer != UNKNOWN].sum())
        if mapped > 0:
            found[name] = float(weights[layer == PRESENT].sum()) / mapped
    return found


def _within(prior: Prior, grid: Grid) -> NDArray[np.int64]:
    if prior.center_m is None or prior.radius_m is None:
        return np.ones(grid.shape, dtype=np.int64)
    east, north = prior.center_m
    cols_m = grid.west_m + (np.arange(grid.cols) + 0.5) * grid.cell_size_m - east
    rows_m = grid.north_m - (np.arange(grid.rows) + 0.5) * grid.cell_size_m - north
    return np.asarray(rows_m[:, None] ** 2 + cols_m[None, :] ** 2 <= prior.radius_m**2, dtype=np.int64)
