# SPDX-License-Identifier: Apache-2.0
"""Tasks as a board reads them: hashes of the queries, and queries with truths."""

from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, Self

from sasgeo_bench.errors import StoreError
from sasgeo_bench.matching.results import Prediction
from sasgeo_bench.regions.region_files import read_manifest
from sasgeo_bench.tasks import task_files
from sasgeo_bench.tasks.query import Head, Truth

M2_PER_KM2: Final = 1e6


@dataclass(frozen=True, kw_only=True)
class AskedTask:
    """A task to compare runs against: the hash of each query."""

    folder: Path
    about: Mapping[str, Any]
    asked: Mapping[str, str]

    @classmethod
    def of(cls, folder: Path) -> Self:
        """Read it from its folder.

        Raises
        ------
        StoreError
            If the folder holds no valid task.
        """
        return cls(folder=folder, about=task_files.read_task(folder), asked=task_files.read_asked(folder))


def held_tasks(files: Collection[Mapping[str, Prediction]], root: Path) -> Iterator[Path]:
    """Yield the task folders for which files hold an answer."""
    held = {name for rows in files for name in rows}
    for path in sorted((root / "tasks").glob(f"*/*/{task_files.TASK}")) if held else ():
        if not held.isdisjoint(task_files.read_ids(path.parent)):
            yield path.parent


@dataclass(frozen=True, kw_only=True)
class ScoredTask:
    """A task with truths, read once for all entries."""

    folder: Path
    about: dict[str, Any]
    heads: tuple[Head, ...]
    truths: tuple[Truth, ...]
    view_bytes: dict[str, int]
    area_km2: float | None


def read_scored_task(folder: Path, root: Path) -> ScoredTask:
    """Read a task and its truths from their own root, and check that they match.

    Raises
    ------
    StoreError
        If either is missing or damaged, or they do not belong together.
    """
    about = task_files.read_task(folder)
    truth = root / str(about["suite"]) / str(about["region"])
    task_files.check_truths(folder, truth)
    heads, truths = tuple(task_files.read_heads(folder)), tuple(task_files.read_truths(truth))
    return ScoredTask(
        folder=folder,
        about=about,
        heads=heads,
        truths=truths,
        view_bytes=task_files.read_view_bytes(folder),
        area_km2=_area_km2(folder.resolve().parents[2] / "regions" / about["region"]),
    )


def _area_km2(region: Path) -> float | None:
    """Return the mapped area of a region; None if its map is missing, since scores need no map."""
    try:
        manifest = read_manifest(region)
    except StoreError:
        return None
    west, south, east, north = manifest.bounds_m
    return manifest.coverage.share * (east - west) * (north - south) / M2_PER_KM2
