# SPDX-License-Identifier: Apache-2.0
"""Make evidence of the pictures of tasks: a segmenter that learned elsewhere sees them, and tasks of its own result."""

import hashlib
import json
import os
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Final

from sasgeo_bench.core.errors import ConfigError, StoreError, counted, named
from sasgeo_bench.core.paths import plain_file
from sasgeo_bench.core.progress import reporting, spread, tell
from sasgeo_bench.matching.cards import write_learned
from sasgeo_bench.matching.segmenter import check_text
from sasgeo_bench.regions.region_files import read_manifest, read_region
from sasgeo_bench.running.segmenting import LoadedSegmenter, SegmenterRun, SegmentRequest, load_card, train_segmenter
from sasgeo_bench.running.training import SegmentedQuery, recalibrated
from sasgeo_bench.running.training_tasks import Lessons, TrainingSet, plan_training
from sasgeo_bench.running.worker import Limits
from sasgeo_bench.sensing.image import AerialImage, LabelledImage
from sasgeo_bench.sensing.segmentation import Segmentation
from sasgeo_bench.tasks.build import put_task
from sasgeo_bench.tasks.frame_evidence import evidence_of, for_classes
from sasgeo_bench.tasks.frame_files import read_labels
from sasgeo_bench.tasks.query import BY, RECALIBRATED, RENDERED, Query, Truth, base_of, view_id
from sasgeo_bench.tasks.segmented import Segmented, segmented_file, write_segmented
from sasgeo_bench.tasks.split import HALVES, Split
from sasgeo_bench.tasks.task_files import Task, TruthManifest

FOLDER: Final = "segmenters"  # below the root: what segmenters learned
_TRAIN: Final = "train"
_MOST_SHOWN: Final = 3  # failures that are shown


@dataclass(frozen=True, kw_only=True)
class SegmentTasks:
    """Tasks of pictures, and the segmenter that is to see them.

    `tasks` are folders of `out/tasks`. A segmenter that learns does so from `tasks` and `taught` of the other half of a
    cross-fit, or of the train places of a hold-out, never of a sealed place: at most `most` pictures of the ordinary
    look, evenly over places, suites and sites; without a split, as of pictures of one's own, from none.
    `limits.match_s` is for one picture. With `is_recalibrated`, the probabilities of all pictures of a task are shifted
    together, so that the mean of each class is its share of the map within the priors. `jobs` counts the tasks at once.
    """

    spec: str
    tasks: Sequence[Path]
    split: Split | None
    out: Path
    taught: Sequence[Path] = ()
    is_recalibrated: bool = False
    most: int = 80
    limits: Limits = field(default_factory=Limits)
    is_sandboxed: bool = True
    jobs: int = 1

    @property
    def request(self) -> SegmentRequest:
        """Return what its processes are started by."""
        return SegmentRequest(spec=self.spec, out=self.out, limits=self.limits, is_sandboxed=self.is_sandboxed)


@dataclass(frozen=True, kw_only=True)
class _Group:
    """Tasks of places that one training serves, and the tasks that it learns from."""

    name: str
    asked: tuple[Task, ...]
    train: tuple[Task, ...]

    @property
    def is_taught_from(self) -> bool:
        return self.name == _TRAIN


@dataclass(frozen=True, kw_only=True)
class _ReadySegmenter:
    """A segmenter ready to see the pictures of some tasks: its card, and what it learned for them."""

    request: SegmentRequest
    loaded: LoadedSegmenter
    learned: str | None
    is_recalibrated: bool

    @property
    def name(self) -> str:
        """Return what the evidence is named by: the segmenter, and whether it is recalibrated."""
        return segmenter_name(self.loaded.card.name, is_recalibrated=self.is_recalibrated)

    def record(self, task: Task) -> dict[str, str]:
        """Return what the evidence of a task follows from, for its `task.json`."""
        return {
            "name": self.loaded.card.name,
            "version": self.loaded.card.version,
            "code_sha256": self.loaded.code,
            "learned_sha256": "" if self.learned is None else hashlib.sha256(self.learned.encode()).hexdigest(),
            "pictures_sha256": task.manifest.queries_sha256,
            **({"recalibrated_by": "shares of the map"} if self.is_recalibrated else {}),
        }


def name_of(suite: str, segmenter: str) -> str:
    """Return the name of a suite's tasks whose evidence a segmenter made.

    >>> name_of("aerial", "pixel_forest")
    'aerial+pixel_forest'
    """
    return f"{suite}{BY}{segmenter}"


def segmenter_name(segmenter: str, *, is_recalibrated: bool) -> str:
    """Return the name of a segmenter as suites are named by it.

    >>> segmenter_name("pixel_forest", is_recalibrated=True)
    'pixel_forest+shares'
    """
    return f"{segmenter}{RECALIBRATED}" if is_recalibrated else segmenter


def segment_tasks(wanted: SegmentTasks) -> tuple[Path, ...]:
    """Segment the pictures of tasks that are not up to date, and return the folders of the tasks that result.

    Raises
    ------
    ConfigError
        If a task has no pictures, the split does not speak of it, or there is nothing to learn from.
    MatchError
        If the segmenter cannot be loaded. A picture that it fails at has no evidence; it is reported, counted in the
        `task.json` that results, and tried again by the next call.
    StoreError
        If a task, its truths or labels, or what was learned, are missing or damaged, or training fails.
    """
    groups = _groups(wanted)
    request = wanted.request
    loaded = load_card(request)
    made: list[Path] = []
    for group in groups:
        if group.is_taught_from and loaded.learns:
            left = named(sorted(task.folder.name for task in group.asked), "train place")
            tell(f"left out: {left}, which {loaded.card.name} learns from")
            continue
        ready = _ReadySegmenter(
            request=request,
            loaded=loaded,
            learned=_learned(wanted, loaded, group) if loaded.learns else None,
            is_recalibrated=wanted.is_recalibrated,
        )
        work, label = partial(_segmented, ready), f"{ready.name}, {group.name}"
        for folder, lines in spread(work, group.asked, jobs=wanted.jobs, label=label):
            made.append(folder)
            for line in lines:
                tell(line)
    return tuple(made)


def _pictured(folder: Path) -> Task:
    """Open a task; refuse one without pictures, or with evidence already."""
    task = Task.open(folder)
    if not task.manifest.frames:
        raise ConfigError(f"{folder} holds no pictures: draw a suite that has some, as in make-queries --suite aerial")
    if task.manifest.segmenter:
        raise ConfigError(f"{folder} has its evidence from a segmenter: name the task of the pictures, without '+'")
    return task


def _groups(wanted: SegmentTasks) -> list[_Group]:
    split = wanted.split
    tasks = {folder: _pictured(folder) for folder in dict.fromkeys((*wanted.tasks, *wanted.taught))}
    if split is None:
        return [_Group(name="no split", asked=tuple(tasks[folder] for folder in dict.fromkeys(wanted.tasks)), train=())]
    region = {folder: base_of(task.manifest.region) for folder, task in tasks.items()}
    group = {folder: _group_of(region[folder], split) for folder in tasks}
    strange = next((task for task, name in group.items() if name is None), None)
    if strange is not None:
        raise ConfigError(
            f"{strange}: split {split.spec.id!r} does not hold its region: name one that does with --split"
        )
    names: tuple[str, ...] = HALVES if split.half_of else ("held out", _TRAIN)
    found = []
    for name in names:
        asked = tuple(tasks[folder] for folder in dict.fromkeys(wanted.tasks) if group[folder] == name)
        others = [folder for folder in group if group[folder] != name and not split.sealed_place(region[folder])]
        train = () if name == _TRAIN else tuple(tasks[folder] for folder in others)
        found.append(_Group(name=name, asked=asked, train=train))
    return [one for one in found if one.asked]


def _group_of(region: str, split: Split) -> str | None:
    place = next(iter(split.places_in(region)), None)
    if place is None:
        return None
    if split.half_of:
        return split.half_of.get(place)
    return _TRAIN if split.part_of(place) == "train" else "held out"


def _learned(wanted: SegmentTasks, loaded: LoadedSegmenter, group: _Group) -> str | None:
    """Return what a segmenter learned for a group, out of its file or by training; None with nothing to learn from."""
    if not group.train:
        if "training" in loaded.card.needs and wanted.split is None:
            raise ConfigError(
                f"{loaded.card.name} needs training, and these tasks have no split: name one with --split"
            )
        if "training" in loaded.card.needs and wanted.split is not None:
            raise ConfigError(
                f"{loaded.card.name} needs training, and all tasks are of one half or part of split "
                f"{wanted.split.spec.id!r}: name tasks of the other one, too"
            )
        return None
    assert wanted.split is not None  # noqa: S101 - without one there is nothing to learn from
    chosen = plan_training(
        [task.folder for task in group.train],
        asked=[task.folder for task in group.asked],
        split=wanted.split,
        most=wanted.most,
        lessons=Lessons(detector=RENDERED),
    )
    code = json.dumps([wanted.spec, loaded.card.version, loaded.code])
    own = f"{loaded.card.name}-{hashlib.sha256(code.encode()).hexdigest()[:12]}"
    folder = wanted.out / FOLDER / own
    kept = next(iter(sorted(folder.glob(f"{chosen.sha256}-*.txt"))), None)
    if kept is not None:
        return _kept_text(kept)
    result = train_segmenter(wanted.request, _lessons_of(chosen))
    if result.learned is None:
        raise StoreError(
            f"{loaded.card.name} could not learn from {chosen.to_text()}: {result.message} ({result.status})"
        )
    path = folder / f"{chosen.sha256}-{_digest(result.learned)}.txt"
    write_learned(path, result.learned)
    tell(f"{loaded.card.name}: trained on the pictures of {chosen.to_text()}, {path}")
    return result.learned


def _digest(text: str) -> str:
    return hashlib.sha256(text.encode()).hexdigest()[:16]  # hexadecimal digits of the text in the name of its file


def _kept_text(path: Path) -> str:
    """Read what a segmenter learned; raise `StoreError` if it is not what its name says: evidence would be lost."""
    try:
        text = plain_file(path).read_bytes().decode()
    except (OSError, UnicodeDecodeError):
        text = ""
    if path.stem.rpartition("-")[2] != _digest(text):
        raise StoreError(f"{path} is damaged: remove this file and segment again, which learns anew")
    return check_text(text)


def _lessons_of(chosen: TrainingSet) -> Iterator[LabelledImage]:
    """Yield the newest picture of each chosen query with its labels: of all classes that any of the maps knows of."""
    classes = tuple(dict.fromkeys(name for item in chosen.taken for name in read_manifest(item.region).classes))
    for item in chosen.taken:
        ids = frozenset(item.ids)
        queries = {query.query_id: query for query in item.task.queries() if query.query_id in ids}
        for query_id, number, found in read_labels(item.task.truth):
            query = queries.get(query_id)
            if query is not None and number == len(query.frames) - 1:
                yield found.labelled(_image(query, number), item.region.name, classes)


def _image(query: Query, number: int) -> AerialImage:
    return query.frames[number].image(observed_on=query.observed_on, season=query.season)


def _segmented(ready: _ReadySegmenter, task: Task) -> tuple[Path, list[str]]:
    """Segment one task unless that is done already; return the folder of the task that results, and what to tell."""
    # what is printed is relative where the task was named so
    about, root = task.manifest, task.root if task.folder.is_absolute() else Path(os.path.relpath(task.root))
    suite, record = name_of(about.suite, ready.name), ready.record(task)
    folder = root / "tasks" / suite / about.region
    if _is_made(folder, record, root):
        return folder, []
    task.check_queries()
    task.check_truths()
    faults: list[str] = []
    lines: list[str] = []
    done = _seen_by(ready, task, suite, faults)
    new = {"suite": suite, "segmenter": record, **({"failed_pictures": len(faults)} if faults else {})}
    origin = about.origin.model_copy(update=new)
    with reporting(lines.append):
        made = put_task(done.pairs, origin, TruthManifest.read(task.truth), out=root)
    write_segmented(segmented_file(root, made.manifest.queries_sha256), done.pictures)
    lines.append(f"{suite} on {about.region}: {counted(made.manifest.queries, 'query', 'queries')} in {made.folder}")
    if faults:
        total = counted(sum(len(query.frames) for query, _ in done.pairs), "picture")
        failed = f"{ready.loaded.card.name} failed at {len(faults)} of {total}"
        lines.append(f"  {failed}, whose evidence is unknown: {'; '.join(faults[:_MOST_SHOWN])}")
    return made.folder, lines


def _is_made(folder: Path, record: Mapping[str, str], root: Path) -> bool:
    """Return whether a task was made of these pictures by this segmenter with what it has learned."""
    # Pictures that it failed at are tried again: it may have been late on a busy machine.
    try:
        task = Task.open(folder)
        task.check_queries()
    except StoreError:
        return False
    about = task.manifest
    is_whole = segmented_file(root, about.queries_sha256).is_file()
    return is_whole and about.segmenter == record and about.failed_pictures is None


@dataclass(frozen=True, kw_only=True)
class _Seen:
    """What a segmenter made of a task: queries with evidence and their truths by id, and pictures to look at."""

    pairs: list[tuple[Query, Truth]]
    pictures: dict[str, Segmented]


def _seen_by(ready: _ReadySegmenter, task: Task, suite: str, faults: list[str]) -> _Seen:
    """Segment the pictures of a task; `faults` gets a line for each picture that failed."""
    truths = {item.query_id: item for item in task.truths}
    pairs: list[tuple[Query, Truth]] = []
    pictures: dict[str, Segmented] = {}
    with SegmenterRun(ready.request, ready.loaded, learned=ready.learned) as run:
        segmented = _segmentations(run, task, faults)
        if ready.is_recalibrated:
            segmented = recalibrated(segmented, read_region(task.root / "regions" / task.folder.name))
        for query, seen in segmented:
            pairs.append(_with_evidence(query, truths[query.query_id], suite, ready.name, seen))
            if seen and seen[-1] is not None:
                pictures[pairs[-1][0].query_id] = Segmented.of(seen[-1])
    return _Seen(pairs=sorted(pairs, key=lambda pair: pair[0].query_id), pictures=pictures)


def _segmentations(run: SegmenterRun, task: Task, faults: list[str]) -> Iterator[SegmentedQuery]:
    """Yield queries with what the segmenter says of their pictures; `faults` gets a line for each that failed."""
    rows = read_labels(task.truth)
    for query in task.queries():
        seen: list[Segmentation | None] = []
        for number in range(len(query.frames)):
            # Labels of a frame, which are the next ones of the file; raise `StoreError` if they are not
            query_id = query.query_id
            found = next(rows, None)
            if found is None or found[:2] != (query_id, number):
                raise StoreError(f"the labels of query {query_id} are missing or out of order: make the queries again")
            of_frame = found[2]
            reply = run.segment(of_frame.labelled(_image(query, number), task.folder.name))
            faults += [] if reply.found else [f"{query.query_id}: {reply.message} ({reply.status})"]
            seen.append(reply.found)
        yield query, seen


def _with_evidence(
    query: Query, truth: Truth, suite: str, segmenter: str, seen: Sequence[Segmentation | None]
) -> tuple[Query, Truth]:
    """Return a query with the evidence of its pictures, under an id of its own, and its truth."""
    # A query without pictures keeps the evidence of its model of perception.
    evidence = query.evidence
    if query.frames:
        size_cells, cell_size_m = evidence.shape[0], evidence.cell_size_m
        found = evidence_of(query.frames, seen, size_cells=size_cells, cell_size_m=cell_size_m)
        evidence = for_classes(found, evidence)
    asked = _renamed(query, segmenter)
    return (
        replace(asked, suite=suite, evidence=evidence),
        replace(truth, query_id=asked.query_id, unknown_share=evidence.unknown_share),
    )


def _renamed(query: Query, segmenter: str) -> Query:
    """Return a query with an id that follows from its own and the segmenter; views of a flight keep their order."""
    step = query.step
    old = query.query_id if step is None else step.sequence_id
    new = hashlib.sha256(f"{old}/{segmenter}".encode()).hexdigest()[: len(old)]
    if step is None:
        return replace(query, query_id=new)
    return replace(query, query_id=view_id(new, step.frame), step=replace(step, sequence_id=new))
