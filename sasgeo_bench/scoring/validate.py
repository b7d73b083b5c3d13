# SPDX-License-Identifier: Apache-2.0
"""Validation of predictions against the tasks they answer: every violation with row, column, found and expected."""

import difflib
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import pyarrow as pa

from sasgeo_bench.errors import MatchError, StoreError, counted
from sasgeo_bench.geometry.pose import Pose
from sasgeo_bench.matching.matcher import Match, check_match
from sasgeo_bench.matching.submission import AnsweredTask, Submission
from sasgeo_bench.regions.region_files import read_manifest
from sasgeo_bench.running import prediction_files
from sasgeo_bench.running.prediction_files import differing_columns, prediction_of, row_faults
from sasgeo_bench.scoring.submission_files import SUBMISSION, predictions_name
from sasgeo_bench.tasks.query import TASK_VERSION, TASK_VERSIONS, Head, PriorGroup
from sasgeo_bench.tasks.split import Split
from sasgeo_bench.tasks.task_files import ASKED, Task
from sasgeo_bench.texts import MOST_CANDIDATES

TaskName = tuple[str, str]  # suite and region
Bounds = tuple[float, float, float, float]  # west, south, east, north, metres

_ANSWERED: Final = "ok"
_NO_ROW: Final = "no row for "


@dataclass(frozen=True, slots=True)
class Violation:
    """One fault: file, row index (-1 for the whole file), column, found and expected."""

    file: str
    row: int
    column: str
    found: str
    expected: str

    @property
    def is_missing_row(self) -> bool:
        """Return True if the fault is a query without a row."""
        return self.found.startswith(_NO_ROW)

    def to_text(self) -> str:
        """Return the fault in one line.

        >>> Violation(file="mine.parquet", row=3, column="confidence", found="1.5", expected="0..1 or null").to_text()
        'mine.parquet, row 3, confidence: found 1.5, expected 0..1 or null'
        """
        where = self.file if self.row < 0 else f"{self.file}, row {self.row}"
        return f"{where}, {self.column}: found {self.found}, expected {self.expected}"


def validate(path: Path, tasks: Sequence[Task]) -> Iterator[Violation]:
    """Yield the violations of predictions in the order of the rows, queries without a row last.

    `path` is a predictions file, or a run's folder of parts, where a newer row replaces an older one. It should answer
    the tasks and no others. Rows of a run's folder that state other queries are skipped (`set_aside` counts them).
    Raise StoreError if a file cannot be read at all, or the folder holds runs of two matchers.
    """
    prediction_files.check_one_matcher([path])
    queries = _asked_of(tasks)
    asked = _asked(tasks)
    seen: dict[str, str] = {}
    files = prediction_files.parts_of(path)
    if not files:
        raise StoreError(f"{path} holds no predictions: name a predictions file, or the folder of a run")
    under = {
        parent: prediction_files.asked_in(parent, asked) for parent in {file.parent for file in files} if path.is_dir()
    }
    unread = 0
    # In a run's folder a query that was asked again has two rows: the newer one counts.
    for file in reversed(files):
        before = frozenset(seen) if path.is_dir() else frozenset()
        table = prediction_files.read_part(file, is_own=path.is_dir())
        differing = differing_columns(table)
        for column, found, expected in differing:
            yield Violation(file.name, -1, column, found, f"a column of {expected}")
        unread += bool(differing)
        wrong = {} if differing else _faults_by_row(file.name, table)
        for row, item in enumerate([] if differing else prediction_files.items_of(table)):
            tie = prediction_files.tie_of(item)
            is_aside = path.is_dir() and bool(tie.asked) and not tie.answers(under[file.parent])
            if item["query_id"] not in before and not is_aside:
                yield from _row_faults(file.name, row, item, queries, seen, wrong.get(row, ()))
    yield from _missing(path.name, [] if unread else queries, seen)


def submission_faults(
    folder: Path, submission: Submission, tasks: Sequence[Task] | None, split: Split | None
) -> Iterator[Violation]:
    """Yield the violations of a submission against the tasks of a board: card, rows, then missing rows.

    Tasks that the submission does not name are skipped; without tasks, rows are not checked. `split` is that of the
    board. Files and hashes are checked by `read_submission`. Raise StoreError if a file cannot be read.
    """
    yield from _record_faults(submission, split)
    if tasks is None or submission.task_version not in TASK_VERSIONS:
        return
    named = {(item.suite, item.region) for item in submission.tasks}
    mine = {task.manifest.name: task for task in tasks if task.manifest.name in named}
    yield from _task_faults(submission, mine)
    queries, by_task = _asked_of([*mine.values()]), {name: task.asked for name, task in mine.items()}
    asked = {query: digest for one in by_task.values() for query, digest in one.items()}
    seen: dict[str, str] = {}
    file = folder / predictions_name(submission.card.name)
    table = prediction_files.read_part(file, is_own=True)  # its lengths were looked at when its record was read
    wrong = _faults_by_row(file.name, table)
    for row, item in enumerate(prediction_files.items_of(table)):
        name = item["query_id"]
        yield from _row_faults(file.name, row, item, queries, seen, wrong.get(row, ()))
        if name in asked and item[ASKED] != asked[name]:
            yield Violation(
                file.name,
                row,
                ASKED,
                f"an answer to query {name} as it was drawn otherwise",
                f"{asked[name]}: run and submit again",
            )
    yield from _count_faults(submission, by_task, seen)
    yield from _missing(file.name, queries, seen)


def _record_faults(submission: Submission, split: Split | None) -> Iterator[Violation]:
    """Yield the fields of a submission that fit no board, or not its split."""
    if submission.task_version not in TASK_VERSIONS:
        yield Violation(
            SUBMISSION, -1, "task_version", str(submission.task_version), f"{TASK_VERSION}: run and submit again"
        )
    expected = None if split is None else split.spec.id
    if submission.split != expected:
        yield Violation(
            SUBMISSION, -1, "split", repr(submission.split), f"{expected!r}, the split of the board: submit again"
        )
    places = () if split is None else split.blocks
    for place in submission.card.places:
        if place not in places:
            near = difflib.get_close_matches(place, places, n=1)
            hint = f", did you mean {near[0]!r}?" if near else ": other training data belongs into trained_elsewhere"
            yield Violation(SUBMISSION, -1, "trained_on", repr(place), f"places of the split{hint}")


def _task_faults(submission: Submission, tasks: Mapping[TaskName, Task]) -> Iterator[Violation]:
    """Yield tasks of the record that the board lacks, that it lists twice, or of other queries."""
    counts = Counter((item.suite, item.region) for item in submission.tasks)
    for name in sorted(counts.keys() - tasks.keys()):
        yield Violation(SUBMISSION, -1, "tasks", "/".join(name), "tasks that the board holds")
    for item in submission.tasks:
        name = (item.suite, item.region)
        count = counts.pop(name, 1)
        if count > 1:
            yield _task_fault(item, f"{count} times", "each task once")
        digest = tasks[name].manifest.queries_sha256 if name in tasks else None
        if digest not in (None, item.queries_sha256):
            yield _task_fault(item, f"with queries_sha256 {item.queries_sha256}", f"{digest}, of the board's queries")


def _count_faults(
    submission: Submission, asked: Mapping[TaskName, Mapping[str, str]], seen: Mapping[str, str]
) -> Iterator[Violation]:
    """Yield tasks whose queries, or those with a row (`seen`), the record counts wrongly."""
    for item in submission.tasks:
        ids = asked.get((item.suite, item.region))
        if ids is None:
            continue
        answered = len(ids.keys() & seen.keys())
        if item.queries != len(ids):
            yield _task_fault(item, f"with queries {item.queries}", f"{len(ids)}, as the board has")
        if item.answered != answered:
            yield _task_fault(item, f"with answered {item.answered}", f"{answered}, which have a row")


def _task_fault(item: AnsweredTask, found: str, expected: str) -> Violation:
    return Violation(SUBMISSION, -1, "tasks", f"{item.suite}/{item.region} {found}", f"{expected}: submit again")


def _missing(file: str, queries: Iterable[str], seen: Mapping[str, str]) -> Iterator[Violation]:
    for name in queries:
        if name not in seen:
            yield Violation(file, -1, "query_id", f"{_NO_ROW}{name}", "one for every query")


def set_aside(path: Path, tasks: Sequence[Task]) -> int:
    """Return how many answers of a run's folder are to queries that the tasks do not hold in this form.

    Raise StoreError if a file cannot be read.
    """
    asked = _asked(tasks)
    found: set[tuple[str, str]] = set()
    for parent in {part.parent for part in prediction_files.parts_of(path)} if path.is_dir() else ():
        under = prediction_files.asked_in(parent, asked)
        found |= {
            (tie.query_id, tie.asked)
            for tie in prediction_files.read_ties(parent)
            if tie.asked and not tie.answers(under)
        }
    return len(found)


def _asked(tasks: Sequence[Task]) -> dict[str, str]:
    return {name: digest for task in tasks for name, digest in task.asked.items()}


@dataclass(frozen=True, slots=True, kw_only=True)
class _Asked:
    """A query and the bounds of its answers; None for retrieval, which is checked by candidates, or without a map."""

    head: Head
    bounds_m: Bounds | None


def _asked_of(tasks: Sequence[Task]) -> dict[str, _Asked]:
    return {asked.head.query_id: asked for task in tasks for asked in _queries(task)}


def _queries(task: Task) -> Iterator[_Asked]:
    """Yield the queries of a task; views are not read, since stored results lack them."""
    bounds_m = _bounds_m(task.region)
    by_group: dict[str, Bounds] = {}
    for head in task.heads():
        group = head.prior_group
        if bounds_m is not None and head.track == "localization" and group not in by_group:
            by_group[group] = _reach_m(bounds_m, PriorGroup.parse(group))
        yield _Asked(head=head, bounds_m=by_group.get(group) if head.track == "localization" else None)


def _bounds_m(region: Path) -> Bounds | None:
    """Return the bounds of a region; None if its map is missing."""
    try:
        return read_manifest(region).bounds_m
    except StoreError:
        return None


def _reach_m(bounds_m: Bounds, group: PriorGroup) -> Bounds:
    """Return the bounds of a region, extended by the diameter of the prior's disc."""
    more_m = 2 * (group.radius_m or 0.0)
    west, south, east, north = bounds_m
    return west - more_m, south - more_m, east + more_m, north + more_m


def _faults_by_row(file: str, table: pa.Table) -> dict[int, list[Violation]]:
    """Return numbers, names and texts out of their bounds, by row."""
    found: dict[int, list[Violation]] = {}
    for one in row_faults(table):
        wrong = Violation(file, one.row, one.column, one.found, one.expected)
        found.setdefault(one.row, []).append(wrong)
    return found


def _row_faults(
    file: str,
    row: int,
    item: Mapping[str, Any],
    queries: Mapping[str, _Asked],
    seen: dict[str, str],
    wrong: Sequence[Violation],
) -> Iterator[Violation]:
    """Yield all faults of a row; of one with an unknown id, all that show without the query."""
    name = item["query_id"]
    query = queries.get(name)
    if query is None:
        yield Violation(file, row, "query_id", repr(name), "the id of a query of the tasks")
        wrong = [fault for fault in wrong if fault.column != "query_id"]
    elif name in seen:
        yield Violation(file, row, "query_id", f"{name} again ({seen[name]})", "each query once")
    else:
        seen[name] = f"{file}, row {row}"
    if wrong:
        yield from wrong
        return
    if item["status"] != _ANSWERED:
        if item["candidates"]:
            count = len(item["candidates"])
            yield Violation(file, row, "candidates", counted(count, "pose"), f"none with {item['status']}")
        return
    yield from _answer_faults(file, row, item, query)


def _answer_faults(file: str, row: int, item: Mapping[str, Any], query: _Asked | None) -> Iterator[Violation]:
    """Yield the faults of the answer itself; without its query, its place and candidates are not checked."""
    try:
        prediction = prediction_of(item)
        match = Match(
            poses=[pose for pose, _ in prediction.candidates],
            scores=[score for _, score in prediction.candidates],
            confidence=prediction.confidence,
            diagnostics=prediction.diagnostics,
        )
        check_match(match, None if query is None else query.head, top_k=MOST_CANDIDATES)
        if query is not None:
            _check_inside(match.poses, query)
    except MatchError as error:
        found, _, expected = str(error).partition(", expected ")
        yield Violation(file, row, "candidates", found, expected or "an answer")


def _check_inside(poses: Sequence[Pose], query: _Asked) -> None:
    """Refuse a position outside the region and the reach of the prior's disc: another map or CRS."""
    if query.bounds_m is None:
        return
    west, south, east, north = query.bounds_m
    for pose in poses:
        if not (west <= pose.easting_m <= east and south <= pose.northing_m <= north):
            raise MatchError(
                f"candidates hold ({pose.easting_m:.1f}, {pose.northing_m:.1f}), outside of {query.head.region}, "
                f"expected eastings of {west:.0f}..{east:.0f} m and northings of {south:.0f}..{north:.0f} m"
            )
