# SPDX-License-Identifier: Apache-2.0
"""Regions and tasks -> a dataset release that others load: what is refused, and the order of the steps."""

import datetime as dt
import os
import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from importlib.metadata import version
from importlib.util import find_spec
from pathlib import Path
from typing import Final

from sasgeo_bench.boards.private_board import check_public, seed_of
from sasgeo_bench.core.errors import ConfigError, StoreError, counted
from sasgeo_bench.core.progress import tell
from sasgeo_bench.core.texts import FOLDER, one_line
from sasgeo_bench.exchange.release_files import (
    BoardTasks,
    Release,
    ReleaseMap,
    ReleaseTask,
    check_target,
    copy_data,
    count_parts,
    has_images,
    open_release,
    read_records,
    write_index,
    write_sums,
    write_texts,
)
from sasgeo_bench.exchange.release_metadata import (
    CARD,
    DATASHEET,
    card_text,
    datasheet_text,
    write_croissant,
    write_stac,
    write_zenodo,
)
from sasgeo_bench.regions import region_files
from sasgeo_bench.regions.imagery import ORTHO
from sasgeo_bench.regions.layers import cog_faults
from sasgeo_bench.regions.region import LICENCE, Manifest
from sasgeo_bench.regions.region_spec import find_region_file
from sasgeo_bench.tasks.build import is_of_region, rebuild_hint
from sasgeo_bench.tasks.private_seed import LEAST_BITS
from sasgeo_bench.tasks.query import CONTROLS
from sasgeo_bench.tasks.split import SplitFile, find_split_file, read_split_file
from sasgeo_bench.tasks.suites.all_suites import SUITES, find_suite
from sasgeo_bench.tasks.task_files import TASK, Task, TruthManifest

HIDDEN_PARTS: Final = ("test", "crossfit")  # whose truths are left out unless asked for
_EXTRA: Final = {
    "huggingface_hub": "huggingface-hub",
    "mlcroissant": "mlcroissant",
    "pystac": "pystac",
    "rio_cogeo": "rio-cogeo",
}
_ADDRESS: Final = re.compile(r"https?://[A-Za-z0-9._~:/?#\[\]@!$&()*+,;=%-]+")  # no quotes and brackets of markup


@dataclass(frozen=True, kw_only=True)
class ReleaseRequest:
    """A request for a release of built regions.

    Empty `suites` are all that were drawn on the regions, controls left out. `split` is the id or file of the split of
    the queries. `with_truth` includes the truths of test queries. `out` is the root of what is built, `into` the folder
    of the release. `published` is the day of publication, as in 2026-01-31, by default the newest date of a map; `url`
    the address where the release will be found. `board` has the queries of a published board instead: it names the
    tasks, and no truths are included.
    """

    regions: tuple[str, ...]
    suites: tuple[str, ...]
    split: str
    with_truth: bool
    out: Path
    into: Path
    published: str | None = None
    url: str | None = None
    board: BoardTasks | None = None


def make_release(request: ReleaseRequest) -> Release:
    """Write a release, whole or not at all; the same regions and tasks give the same bytes.

    Raise `SasgeoError` if anything is refused (see `plan_release`) or cannot be
    written; an older release then stays as it was.
    """
    planned = plan_release(request)
    with open_release(request.into) as folder:
        tell(f"copying {counted(len(planned.maps), 'map')} and {counted(len(planned.tasks), 'task')}")
        copy_data(folder, planned)
        release = replace(planned, files=read_records(folder, planned))
        tell("writing the STAC catalog, Croissant metadata, the card and the datasheet")
        write_stac(folder, release)
        write_croissant(folder, release)
        write_zenodo(folder, release)
        write_index(folder, release)
        write_texts(folder, release, {CARD: card_text(release), DATASHEET: datasheet_text(release)})
        write_sums(folder, release.files)
    return release


def plan_release(request: ReleaseRequest) -> Release:
    """Return the content of a release; everything that can be refused is refused here, before anything is written.

    Raise `ConfigError` if a region, suite, split or address is wrong, there are no tasks, or the extra packages are
    missing; `StoreError` if a region is not built, states no licence, has imagery that must not be passed on, or its
    rasters are no valid COG, if a task is of another map or split, holds pictures or lacks its truths, or if the folder
    holds something else.
    """
    check_place(request.into, request.out, url=request.url)
    split = read_split_file(find_split_file(request.split))
    regions = tuple(dict.fromkeys(request.regions))
    if request.board is None:
        for name in regions:
            _check_region(name, split, request.out)
    tasks = _tasks(regions, request) if request.board is None else _tasks_of_board(request.board)
    names = sorted({*regions, *(task.map_name for task in tasks)})
    maps = tuple(_map(request.out / "regions" / name) for name in names)
    manifests = {item.name: item.manifest for item in maps}
    for task in tasks:
        _check_task(task.source, manifests[task.map_name], split)
        if task.released:
            task.source.check_truths()
    if request.board is None:
        _warn_of_seeds(tasks)
    return Release(
        regions=regions,
        split=split,
        maps=maps,
        tasks=tasks,
        with_truth=request.with_truth,
        published=_published(request.published, maps),
        url=request.url,
        made_by=f"sasgeo-bench {version('sasgeo-bench')}",
        board=None if request.board is None else request.board.name,
        lost=0 if request.board is None else request.board.lost,
    )


def check_installed() -> None:
    """Raise `ConfigError` where the packages that describe a release are not installed."""
    missing = [shown for module, shown in _EXTRA.items() if find_spec(module) is None]
    if missing:
        raise ConfigError(f"a release needs {', '.join(missing)}: pip install 'sasgeo-bench[publish]'")


def check_place(into: Path, out: Path, *, url: str | None = None) -> None:
    """Refuse, before anything is drawn, a folder that a release cannot replace, and an address that is none.

    Raise `ConfigError` for a folder that others read, an address, or missing packages; `StoreError` for a folder that
    holds something else, or cannot be written.
    """
    check_installed()
    _check_address(url)
    place = Path(os.path.realpath(into))  # `Path.resolve` raises where links form a circle
    others = (out / name for name in ("regions", "tasks", "truth", "runs", "boards", "segmenters", "private"))
    inside = next((folder for folder in others if place.is_relative_to(folder.resolve())), None)
    if inside is not None:
        raise ConfigError(f"{into} lies inside {inside}, which others read: name another folder with --into")
    check_target(into)


def _check_region(name: str, split: SplitFile, out: Path) -> None:
    if not is_of_region(name, name):
        raise ConfigError(
            f"--regions takes ids as in 'vaduz', got {name!r}: maps that queries need are added automatically"
        )
    if not (out / "regions" / name / region_files.MANIFEST).is_file():
        find_region_file(name)  # an unknown one is named with the nearest there is
        raise StoreError(f"{out / 'regions'} holds no map of {name}: sasgeo-bench build-region {name}")
    if name not in split.region_ids:
        raise ConfigError(
            f"split {split.id!r} does not speak of region {name!r}: name the split of its queries with --split"
        )


def _tasks(regions: Sequence[str], request: ReleaseRequest) -> tuple[ReleaseTask, ...]:
    """Return the tasks of the regions and of their older and edited maps, by suite and map."""
    suites = [find_suite(name).card.name for name in dict.fromkeys(request.suites)] or list(SUITES)
    found = []
    for suite in sorted(suites):
        folders = sorted(path.parent for path in (request.out / "tasks" / suite).glob(f"*/{TASK}"))
        own = {name: [one for one in folders if is_of_region(one.name, name)] for name in regions}
        lacking = [name for name in regions if not own[name]]
        if request.suites and len(lacking) == len(regions):
            raise _no_queries(suite, regions, request.out)
        if request.suites and lacking:
            tell(f"{suite}: no queries on {', '.join(lacking)}, left out")
        found += [_task(folder, request) for name in regions for folder in own[name]]
    bare = [name for name in regions if not any(is_of_region(task.map_name, name) for task in found)]
    if bare:
        fault = _no_queries("any suite", bare, request.out)
        raise fault
    return tuple(sorted(found, key=lambda task: (task.suite, task.map_name)))


def _tasks_of_board(board: BoardTasks) -> tuple[ReleaseTask, ...]:
    """Return the tasks of a board with its queries alone; those that are not drawn as they were are left out."""
    found = []
    for folder in board.folders:
        task = Task.open(folder)
        own = frozenset(name for name, asked in task.asked.items() if board.asked.get(name) == asked)
        only = None if len(own) == len(task.asked) else own
        if own:
            found.append(ReleaseTask(source=task, parts=count_parts(task, only), only=only))
    return tuple(sorted(found, key=lambda task: (task.suite, task.map_name)))


def _no_queries(suite: str, regions: Sequence[str], out: Path) -> StoreError:
    mend = f"sasgeo-bench make-queries --regions {regions[0]}"
    return StoreError(f"{out / 'tasks'} holds no queries of {suite} on {', '.join(regions)}: {mend}")


def _task(folder: Path, request: ReleaseRequest) -> ReleaseTask:
    task = Task.open(folder, request.out)
    parts = count_parts(task)
    odd = next((name for name in (folder.name, *parts) if not re.fullmatch(FOLDER, name)), None)
    if odd is not None:
        raise StoreError(
            f"{folder} speaks of {odd[:80]!r}, which cannot be part of a file's name: make the queries again"
        )
    released = frozenset(part for part in parts if request.with_truth or part not in HIDDEN_PARTS)
    return ReleaseTask(source=task, parts=parts, released=released)


def _map(folder: Path) -> ReleaseMap:
    """Read a map, after checking its licences and its rasters."""
    manifest = region_files.read_manifest(folder)
    path = folder / region_files.MANIFEST
    stray = next((name for name in manifest.files if Path(name).name != name), None)
    if stray is not None:
        raise StoreError(f"{path} is damaged (it names the file {stray!r}): build the region again")
    if not manifest.licence.strip() or not manifest.attribution.strip():
        raise StoreError(f"{path} says no licence or no attribution, and a release must: build the region again")
    if manifest.licence != LICENCE:
        raise StoreError(
            f"{path} says licence {manifest.licence!r}: a release holds data under {LICENCE} alone, leave it out"
        )
    region_files.check_publishable(folder, manifest)
    for name in (region_files.LAYERS, *([ORTHO] if manifest.imagery else [])):
        faults = cog_faults(folder / name)
        if faults:
            raise StoreError(f"{folder / name} is no cloud-optimized GeoTIFF ({faults[0]}): build the region again")
    return ReleaseMap(folder=folder, manifest=manifest)


def _check_task(task: Task, manifest: Manifest, split: SplitFile) -> None:
    about = task.manifest
    check_public(seed_of([about]), str(task.folder))
    if not about.is_of_map(manifest):
        raise StoreError(rebuild_hint(about.region))
    if about.split != split.id and about.suite != CONTROLS:  # controls of every board have a split of theirs
        raise StoreError(
            f"{task.folder} was drawn by split {about.split!r}, not by {split.id!r}: name it with --split, "
            "or make the queries again"
        )
    if has_images(task):
        raise StoreError(
            f"{task.folder} holds pictures, and a release holds none so far: name the other suites with --suites, and "
            "pass this folder on by itself if the licence of its pictures allows it (rendered ones have the map's)"
        )


def _warn_of_seeds(tasks: Sequence[ReleaseTask]) -> None:
    """Report withheld truths that could be drawn again by trying a few seeds."""
    hiding = [task for task in tasks if set(task.parts) - task.released]
    seeds = [TruthManifest.read(task.source.truth).seed for task in hiding]
    guessable = sum(seed is not None and abs(seed) < 2**LEAST_BITS for seed in seeds)
    if guessable:
        tell(
            f"warning: truths of {counted(guessable, 'task')} are kept back, but their seed is so small that anyone "
            "can find it and draw them again: make the queries with a --seed of 20 random digits or more"
        )


def _check_address(url: str | None) -> None:
    if url is not None and not _ADDRESS.fullmatch(url):
        raise ConfigError(
            f"--url is {one_line(url)[:80]!r}: the address of a release begins with https:// or http://, and holds "
            "letters, digits and the signs of addresses alone"
        )


def _published(published: str | None, maps: Sequence[ReleaseMap]) -> str:
    if published is None:
        return max(item.manifest.extract.date for item in maps).isoformat()
    return dt.date.fromisoformat(published).isoformat()
