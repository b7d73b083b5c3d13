# SPDX-License-Identifier: Apache-2.0
"""Recalibrate what a segmenter says by the shares of the classes on the map: no label is needed."""

from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from sasgeo_bench.files.scratch import scratch_folder
from sasgeo_bench.geometry.grid import Grid
from sasgeo_bench.geometry.pose import Prior
from sasgeo_bench.regions.evidence import PRESENT, UNKNOWN
from sasgeo_bench.regions.region import Region
from sasgeo_bench.sensing.segmentation import Segmentation, tables_of
from sasgeo_bench.tasks.query import Query

Said = tuple[Query, Sequence[Segmentation | None]]  # a query and the segmentations of its frames, None where it failed


def recalibrated(said: Iterable[Said], region: Region) -> Iterator[Said]:
    """Yield queries with their segmentations recalibrated together, as those of one flight over the region.

    The log-odds of a class are shifted by one number for all pictures, so that its mean probability is its share of
    the map within the priors of the queries. One picture alone would tell too little: a wood in a town has no roofs.
    Until all are seen, segmentations lie in a temporary folder.
    """
    totals: dict[str, NDArray[np.int64]] = {}
    with scratch_folder("seen") as folder:
        queries = []
        for at, (query, seen) in enumerate(said):
            queries.append(query)
            for number, one in enumerate(seen):
                if one is not None:
                    _file(folder, at, number).write_bytes(one.to_bytes())
                    for told, count in one.counts().items():
                        totals[told] = totals.get(told, 0) + count
        shares = shares_within([query.prior for query in queries], region)
        tables = tables_of(totals, {told: share for told, share in shares.items() if told in totals})
        for at, query in enumerate(queries):
            yield query, [_read(_file(folder, at, number), tables) for number in range(len(query.frames))]


def _file(folder: Path, at: int, number: int) -> Path:
    return folder / f"{at}-{number}"


def _read(path: Path, tables: dict[str, NDArray[np.uint8]]) -> Segmentation | None:
    return Segmentation.from_bytes(path.read_bytes()).recoded(tables) if path.is_file() else None


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
