# SPDX-License-Identifier: Apache-2.0
"""Submissions on disk: `submission.json` and one file of predictions, by authors who are not trusted.

Cheap checks come first: names, links, sizes, then hashes, then the shape of the table.
"""

import difflib
import os
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final

import pyarrow as pa

from sasgeo_bench.core.config import check_document
from sasgeo_bench.core.errors import MatchError, SasgeoError, StoreError, counted
from sasgeo_bench.core.folders import check_known, file_record, fresh_folder, is_ours, locked
from sasgeo_bench.core.json import read_json
from sasgeo_bench.core.parquet import open_table, write_table
from sasgeo_bench.core.texts import MOST_CANDIDATES, json_text
from sasgeo_bench.geometry.pose import Pose
from sasgeo_bench.matching.matcher import Prediction
from sasgeo_bench.matching.submission import SCHEMA_VERSION, AnsweredTask, Submission, SubmittedFile
from sasgeo_bench.matching.tracker import check_prediction
from sasgeo_bench.regions.region_files import read_manifest
from sasgeo_bench.running import prediction_files
from sasgeo_bench.running.prediction_files import (
    FLOWN_SCHEMA,
    NO_ROW,
    PREDICTION_SCHEMA,
    RUN_SCHEMA,
    Violation,
    check_lengths,
    differing_columns,
    prediction_of,
    prediction_row,
    row_faults,
    schema_of,
)
from sasgeo_bench.tasks.query import TASK_VERSION, TASK_VERSIONS, Head, PriorGroup
from sasgeo_bench.tasks.split import Split
from sasgeo_bench.tasks.task_files import ASKED, Task

SUBMISSION: Final = "submission.json"
PREDICTIONS: Final = "predictions"
README: Final = "README.md"  # may lie among submissions
MOST_BYTES: Final = 20_000_000  # of the predictions
_MOST_SUBMISSION_BYTES: Final = 5_000_000
_LEVEL: Final = 19


def predictions_name(name: str) -> str:
    """Return the path of the predictions inside a submission."""
    return f"{PREDICTIONS}/{name}.parquet"


def check_submission_folder(folder: Path, name: str) -> None:
    """Raise StoreError if a submission of this name cannot be written to a folder: other things would be lost."""
    if folder.name != name:
        raise StoreError(f"{folder} must be named as the card is, {name!r}: name another folder")
    is_free = not os.path.lexists(folder) or (folder.is_dir() and not folder.is_symlink() and not any(folder.iterdir()))
    if is_free:
        return
    if folder.is_symlink() or not is_ours(folder / SUBMISSION):
        raise StoreError(f"{folder} holds something else than a submission, which would be lost: name another folder")
    check_known(folder, {SUBMISSION, predictions_name(name)}, "a submission")


def write_submission(
    folder: Path, submission: Submission, predictions: Sequence[Prediction], asked: Mapping[str, str]
) -> Submission:
    """Write a submission completely or not at all, and return it with its files; the same answers give the same bytes.

    The folder has the name of the card; an older submission there is replaced. `asked` holds the hash of each answered
    query, by query id. Raise StoreError if the folder holds something else or has another name, the predictions are too
    large, or writing fails; the folder is then unchanged.
    """
    check_submission_folder(folder, submission.card.name)
    rows = [
        {**prediction_row(item), ASKED: asked[item.query_id]}
        for item in sorted(predictions, key=lambda item: item.query_id)
    ]
    name = predictions_name(submission.card.name)
    try:
        with locked(folder), fresh_folder(folder) as scratch:
            (scratch / PREDICTIONS).mkdir()
            schema = schema_of(predictions).append(pa.field(ASKED, pa.string()))
            table = pa.Table.from_pylist(rows, schema=schema)
            write_table(table, scratch / name, compression_level=_LEVEL, write_statistics=False)
            record = file_record(scratch / name)
            _check_bytes(folder / name, record.bytes)
            whole = submission.model_copy(
                update={"files": {name: SubmittedFile(sha256=record.sha256, bytes=record.bytes)}}
            )
            text = json_text(whole.model_dump(mode="json"))
            (scratch / SUBMISSION).write_text(text, encoding="utf-8")
    except SasgeoError:
        raise
    except OSError as error:
        raise StoreError(
            f"{folder} cannot be written ({error.strerror or error}): check your rights and the free space"
        ) from error
    return whole


def _check_bytes(path: Path, size: int) -> None:
    if size > MOST_BYTES:
        raise StoreError(
            f"{path} has {size / 1e6:.1f} MB, {MOST_BYTES / 1e6:g} MB at most: give fewer "
            "candidates to each query (run --top-k)"
        )


def is_submission(folder: Path) -> bool:
    """Return True if a folder holds a `submission.json`."""
    return os.path.lexists(folder / SUBMISSION)


def list_submissions(folder: Path) -> tuple[Path, ...]:
    """Return a submission itself, or all that lies in a folder of them, without hidden files and the README.

    Those of a board may lie in a folder of their own, as in submissions/<board>/<name>. A stray entry beside them is
    returned, too: `read_submission` refuses it. Raise StoreError if there is no such folder, or nothing in it is a
    submission.
    """
    if is_submission(folder):
        return (folder,)
    inner = _visible(folder)
    found = None if inner is None else tuple(path for one in inner for path in _of_board(one) or (one,))
    if found is None or (found and not any(map(is_submission, found))):
        raise StoreError(f"{folder} is no folder of submissions: name one, or a submission itself")
    return found


def _visible(folder: Path) -> list[Path] | None:
    """Return what lies in a folder, without hidden files and the README; None if it is no folder that can be listed."""
    try:
        return [path for path in sorted(folder.iterdir()) if not path.name.startswith(".") and path.name != README]
    except OSError:
        return None


def _of_board(folder: Path) -> list[Path]:
    """Return what lies in a folder of submissions; nothing of any other folder, of a link, or of a file."""
    inner = [] if folder.is_symlink() or is_submission(folder) else _visible(folder) or []
    return inner if any(map(is_submission, inner)) else []


def read_submission(folder: Path) -> Submission:
    """Read a submission after checking its folder.

    Raise StoreError if a file is missing, unknown, a link, too large, differs from its hash, or holds no predictions.
    Raise ConfigError if a field of `submission.json` is wrong; all faults on one line.
    """
    if not is_submission(folder):
        raise StoreError(f"{folder} is no submission, for it holds no {SUBMISSION}: remove it, or make it by 'submit'")
    _check_names(folder, {SUBMISSION, PREDICTIONS})
    submission = _read_document(folder / SUBMISSION)
    name = predictions_name(submission.card.name)
    if folder.resolve().name != submission.card.name:
        raise StoreError(f"{folder} holds the submission {submission.card.name!r}: name the folder so")
    if list(submission.files) != [name]:
        listed = ", ".join(submission.files) or "none"
        raise StoreError(f"{folder / SUBMISSION} lists the files {listed}, expected {name}: submit again")
    _check_names(folder / PREDICTIONS, {Path(name).name})
    _check_file(folder / name, submission.files[name])
    _check_table(folder / name)
    return submission


def _check_names(folder: Path, expected: set[str]) -> None:
    """Refuse a folder with other names than expected, and every link: it may lead anywhere."""
    if folder.is_symlink() or not folder.is_dir():
        raise StoreError(f"{folder} is no folder of a submission: make it by 'submit'")
    with os.scandir(folder) as entries:
        found = {entry.name: _is_plain(entry) for entry in entries}
    odd = next((name for name, is_plain in sorted(found.items()) if not is_plain), None)
    if odd is not None:
        raise StoreError(f"{folder / odd} is a link, or no plain file: a submission holds files alone")
    wrong = sorted(set(found) ^ expected)
    if wrong:
        fault = "is missing" if wrong[0] in expected else "is no part of a submission"
        raise StoreError(f"{folder / wrong[0]} {fault}: a submission is made by 'submit', and nothing is added to it")


def _is_plain(entry: os.DirEntry[str]) -> bool:
    """Return True for a file or the predictions folder, False for a link, pipe or device."""
    is_folder = entry.name == PREDICTIONS
    return entry.is_dir(follow_symlinks=False) if is_folder else entry.is_file(follow_symlinks=False)


def _read_document(path: Path) -> Submission:
    content = read_json(path, mend="submit again", most_bytes=_MOST_SUBMISSION_BYTES)
    version = content.get("schema_version") if isinstance(content, dict) else None
    if version != SCHEMA_VERSION:
        stated = "states no schema version" if version is None else f"has schema version {version!r}"
        raise StoreError(f"{path} {stated}, this version reads {SCHEMA_VERSION}: submit again")
    return check_document(content, Submission, source=str(path))


def _check_file(path: Path, expected: SubmittedFile) -> None:
    _check_bytes(path, path.stat().st_size)
    found = file_record(path)
    if (found.sha256, found.bytes) != (expected.sha256, expected.bytes):
        raise StoreError(
            f"{path} is not what {SUBMISSION} says: {found.bytes} bytes, SHA-256 {found.sha256}, "
            f"expected {expected.bytes} bytes, {expected.sha256}: submit again"
        )


def _check_table(path: Path) -> None:
    """Refuse a table of another shape, and one that unpacks to overlong lists or texts."""
    with open_table(path, mend="submit again") as source:
        _check_schema(path, source.schema_arrow)
    check_lengths(path, mend="submit again")


def _check_schema(path: Path, schema: pa.Schema) -> None:
    plain = pa.schema(
        [
            field.with_type(field.type.value_type) if pa.types.is_dictionary(field.type) else field
            for field in schema.remove_metadata()
        ]
    )
    asked = pa.field(ASKED, pa.string())
    allowed = [known.append(asked).remove_metadata() for known in (PREDICTION_SCHEMA, FLOWN_SCHEMA)]
    if plain not in allowed:
        wrong = sorted(set(plain.names) ^ set(RUN_SCHEMA.names)) or ["the types of its columns"]
        raise StoreError(
            f"{path} holds no predictions as 'submit' writes them ({wrong[0]} is not as it must be): submit again"
        )


TaskName = tuple[str, str]  # suite and region
Bounds = tuple[float, float, float, float]  # west, south, east, north, metres

_ANSWERED: Final = "ok"


def validate(path: Path, tasks: Sequence[Task]) -> Iterator[Violation]:
    """Yield the violations of predictions in the order of the rows, queries without a row last.

    `path` is a predictions file, or a run's folder of parts, where a newer row replaces an older one. It should answer
    the tasks and no others. Rows of a run's folder that state other queries are skipped (`count_excluded` counts them).
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
            is_excluded = path.is_dir() and bool(tie.asked) and not tie.answers(under[file.parent])
            if item["query_id"] not in before and not is_excluded:
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
            yield Violation(file, -1, "query_id", f"{NO_ROW}{name}", "one for every query")


def count_excluded(path: Path, tasks: Sequence[Task]) -> int:
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
        found.setdefault(one.row, []).append(replace(one, file=file))
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
        head = None if query is None else query.head
        found = check_prediction(prediction_of(item), head, top_k=MOST_CANDIDATES)
        if query is not None:
            _check_inside([pose for pose, _ in found.candidates], query)
    except MatchError as error:
        fault, _, expected = str(error).partition(", expected ")
        yield Violation(file, row, "candidates", fault, expected or "an answer")


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
