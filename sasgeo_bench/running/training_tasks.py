# SPDX-License-Identifier: Apache-2.0
"""Choose the training set: tasks far from all queries of the run, and which of their queries are used."""

import hashlib
import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import zip_longest
from pathlib import Path

from sasgeo_bench.core.errors import ConfigError, StoreError, counted, named
from sasgeo_bench.tasks.query import PUBLISHED, Detector, Truth, base_of
from sasgeo_bench.tasks.split import Block, Split, nearest_blocks
from sasgeo_bench.tasks.task_files import Task, read_truths, truth_sha256


@dataclass(frozen=True, slots=True, kw_only=True)
class Taken:
    """A training task, its map, and the ids of the queries that are used."""

    task: Task
    region: Path
    ids: tuple[str, ...]


@dataclass(frozen=True, kw_only=True)
class TrainingSet:
    """A training set; `sha256` is the hash of its queries, maps and truths."""

    taken: tuple[Taken, ...]
    places: tuple[str, ...]
    sha256: str

    @property
    def count(self) -> int:
        """Pairs of a query and its truth."""
        return sum(len(item.ids) for item in self.taken)

    @property
    def regions(self) -> dict[str, Path]:
        """Maps by the name that queries have for them."""
        return {item.region.name: item.region for item in self.taken}

    def to_text(self) -> str:
        """As in "24 queries of 3 places (monaco, porto, prague)"."""
        return f"{counted(self.count, 'query', 'queries')} of {named(self.places, 'place')}"


@dataclass(frozen=True, slots=True, kw_only=True)
class _Pair:
    """A query that may be used, by what decides whether it is; `hashes` are those of the query and its truth."""

    place: str
    suite: str
    site: str
    query_id: str
    task: Task
    hashes: tuple[str, str]


@dataclass(frozen=True, slots=True, kw_only=True)
class Lessons:
    """The views that may be learned from: of one detector, and under stress only of some kinds, as they begin; or all.

    Where there are more than are used, another `draw` chooses others.

    >>> Lessons(kinds=("S1",)).kinds
    ('S1',)
    """

    detector: Detector = PUBLISHED
    kinds: tuple[str, ...] = ()
    draw: int = 0

    def hold(self, truth: Truth) -> bool:
        """Return whether a view may be learned from; views without stress are of every kind."""
        return truth.detector == self.detector and (truth.role != "stress" or truth.kind.startswith(self.kinds or ""))

    def to_text(self) -> str:
        """Name the views."""
        kinds = f" and kinds {', '.join(self.kinds)}" if self.kinds else ""
        return f"of detector {self.detector!r}{kinds}"


def plan_training(
    train: Sequence[Path],
    *,
    asked: Sequence[Path],
    split: Split | None,
    most: int,
    lessons: Lessons | None = None,
) -> TrainingSet:
    """Choose at most `most` pairs, evenly over places, then suites, then sites, by a hash of their names.

    `train` and `asked` are task folders. `split` defines places and how far apart they must lie; without one, regions
    are places. Only views that `lessons` hold are used, those of the published detector unless given, and their draw
    says which.

    Raises
    ------
    ConfigError
        If there are no queries, a training place is asked too or lies too near to one that is, or two different maps
        have one name.
    StoreError
        If a task, its map or its truths are missing, damaged or do not belong together.
    """
    chosen_by = lessons or Lessons()
    tasks = [Task.open(folder) for folder in {folder.resolve(): folder for folder in train}.values()]
    regions = {base_of(task.manifest.region): task.folder for task in tasks}
    others = {base_of(Task.open(folder).manifest.region): folder for folder in asked}
    check_apart(regions, others, split)
    maps = {task.folder: task.checked_region() for task in tasks}
    _check_names(maps)
    pairs = [pair for task in tasks for pair in _pairs_of(task, split, chosen_by)]
    if not pairs:
        first = tasks[0].folder
        raise ConfigError(
            f"{first}, to learn from, holds no queries {chosen_by.to_text()}: there is nothing to learn from"
        )
    keys = (lambda pair: pair.place, lambda pair: pair.suite, lambda pair: pair.site)
    chosen = spread(pairs, keys, draw=chosen_by.draw)[:most]
    ids: dict[Path, list[str]] = {}
    for pair in chosen:
        ids.setdefault(pair.task.folder, []).append(pair.query_id)
    taken = tuple(
        Taken(task=task, region=maps[task.folder], ids=tuple(sorted(ids[task.folder])))
        for task in sorted(tasks, key=lambda task: task.manifest.name[::-1])
        if task.folder in ids
    )
    hashes = {pair.query_id: pair.hashes for pair in chosen}
    return TrainingSet(
        taken=taken,
        places=tuple(sorted({pair.place for pair in chosen})),
        sha256=_hash_of([hashes[name] for item in taken for name in item.ids]),
    )


def _hash_of(hashes: Sequence[tuple[str, str]]) -> str:
    return hashlib.sha256(json.dumps(hashes).encode()).hexdigest()


def check_apart(train: Mapping[str, Path], asked: Mapping[str, Path], split: Split | None) -> None:
    """Raise `ConfigError` if regions share a name or place, have blocks nearer than the buffer, or one is sealed.

    `train` and `asked` give for each region a task on it that an error can name.
    """
    both = next((name for name in train if name in asked), None)
    if both is not None:
        folders = f"{train[both]}, to learn from, is of region {both!r}, and so is {asked[both]}"
        raise ConfigError(f"{folders}, which is asked: leave one out")
    if split is None:
        return
    sealed = next((name for name in train if split.sealed_place(name)), None)
    if sealed is not None:
        place = split.sealed_place(sealed)
        raise ConfigError(
            f"{train[sealed]}, to learn from, is of the sealed place {place!r}, which never trains: leave it out"
        )
    places = {place: name for name in train for place in split.places_in(name)}
    shared = next(((place, name) for name in asked for place in split.places_in(name) if place in places), None)
    if shared is not None:
        place, name = shared
        folders = f"{train[places[place]]}, to learn from, is of place {place!r}, and so is {asked[name]}"
        raise ConfigError(f"{folders}, which is asked: leave one out")
    parts = {part: _blocks_of(names, split) for part, names in (("train", train), ("asked", asked))}
    least_m = split.spec.buffer_m + 2 * split.spec.reach_m
    near = nearest_blocks(parts, within_m=least_m)
    if near is not None and near.gap_m < least_m:
        raise ConfigError(
            f"blocks {near.first} and {near.second}, one for training and one that is asked, are "
            f"{near.gap_m:.0f} m apart, split {split.spec.id!r} needs {least_m:.0f} m: leave one of the regions out"
        )


def _blocks_of(regions: Mapping[str, Path], split: Split) -> list[Block]:
    return [block for name in regions for block in split.blocks_in(name)]


def root_of(task: Path) -> Path:
    """Return the output folder that holds a task."""
    return task.resolve().parent.parent.parent


def _check_names(maps: Mapping[Path, Path]) -> None:
    """Refuse two maps of one name: queries hold the name alone."""
    seen: dict[str, Path] = {}
    for task, region in maps.items():
        if seen.setdefault(region.name, region) != region:
            raise ConfigError(
                f"{task}, to learn from, lies on {region}, another task on {seen[region.name]}: leave one of them out"
            )


def _pairs_of(task: Task, split: Split | None, lessons: Lessons) -> Iterator[_Pair]:
    """Yield every query of a task that may be learned from, with what decides whether it is used."""
    if not task.has_truths:
        raise StoreError(
            f"{task.truth} holds no truths of {task.folder}, which training needs: "
            "make the queries here, or leave it out"
        )
    task.check_queries()
    task.check_truths()
    place_of = {} if split is None else split.place_of
    for item in read_truths(task.truth):
        if not lessons.hold(item):
            continue
        yield _Pair(
            place=place_of.get(item.block, base_of(task.manifest.region)),
            suite=task.manifest.suite,
            site=item.pair_id,
            query_id=item.query_id,
            task=task,
            hashes=(task.asked[item.query_id], truth_sha256(item)),
        )


def spread(pairs: Sequence[_Pair], by: Sequence[Callable[[_Pair], str]], *, draw: int = 0) -> list[_Pair]:
    """Order pairs so that every beginning is spread evenly, first by the first key; hashes of names break ties.

    Another `draw` has other hashes.
    """
    salt = f"draw {draw}/" if draw else ""
    if not by:
        return sorted(pairs, key=lambda pair: _rank(salt + pair.query_id))
    groups: dict[str, list[_Pair]] = {}
    for pair in pairs:
        groups.setdefault(by[0](pair), []).append(pair)
    names = sorted(groups, key=lambda name: _rank(salt + name))
    lines = [spread(groups[name], by[1:], draw=draw) for name in names]
    return [pair for row in zip_longest(*lines) for pair in row if pair is not None]


def _rank(name: str) -> bytes:
    return hashlib.sha256(name.encode()).digest()


def read_pairs(training_set: TrainingSet) -> list[tuple[bytes, Truth]]:
    """Read queries as they are sent, with their truths, in the order of maps, suites and ids.

    Raise `StoreError` if a task was made anew since the training set was planned.
    """
    found: list[tuple[bytes, Truth]] = []
    hashes: list[tuple[str, str]] = []
    for item in training_set.taken:
        truths = {truth.query_id: truth for truth in read_truths(item.task.truth)}
        for query, blob, asked in item.task.some(frozenset(item.ids)):
            if query.query_id in truths:
                found.append((blob, truths[query.query_id]))
                hashes.append((asked, truth_sha256(truths[query.query_id])))
    if _hash_of(hashes) != training_set.sha256:
        raise StoreError(
            f"{training_set.taken[0].task.folder} or another task to learn from was made anew meanwhile: run again"
        )
    return found
