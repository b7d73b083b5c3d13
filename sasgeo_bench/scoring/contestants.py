# SPDX-License-Identifier: Apache-2.0
"""Entries of a board with their answers to its tasks: read tasks, read and validate answers, score them."""

from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Final, Self

import pandas as pd

from sasgeo_bench.errors import ConfigError, StoreError, counted
from sasgeo_bench.progress import tell
from sasgeo_bench.running.failures import Failures
from sasgeo_bench.running.prediction_files import Answers, StoredAnswers
from sasgeo_bench.running.run_manifest import RunManifest
from sasgeo_bench.scoring.controls import hold_controls
from sasgeo_bench.scoring.entries import Entry
from sasgeo_bench.scoring.flights import score_flights
from sasgeo_bench.scoring.score import Questions, settle_not_applicable, some_rows, with_answers
from sasgeo_bench.scoring.validate import submission_faults, validate
from sasgeo_bench.tasks.query import CONTROLS
from sasgeo_bench.tasks.split import Split
from sasgeo_bench.tasks.task_files import QUERIES, TASK, Task, read_batches

_MOST_KEPT_BYTES: Final = 128 * 1024**2  # of answers: some 120,000 of 25 poses


_HOW_TO_MEND: Final = "run again (existing answers are kept), or make the old queries again"
MOST_NAMED: Final = 3  # skipped runs in a message; the others are counted


@dataclass(frozen=True, kw_only=True)
class EntryAnswers:
    """One entry and its answers to the tasks of a board.

    `asked` are the folders of tasks whose queries it was asked, answered or not; `held` are those it brings to a board
    that names no tasks. A file is asked all tasks and brings those it answers; a submission is asked the tasks it
    names. `entry` holds only the runs that count.
    """

    entry: Entry
    predictions: StoredAnswers
    held: frozenset[Path]
    asked: frozenset[Path]


def read_entry_answers(
    entries: Sequence[Entry],
    folders: Sequence[Path],
    *,
    root: Path,
    named: Sequence[Path],
    split: Split | None = None,
    failures: Failures,
) -> list[EntryAnswers]:
    """Return the answers of all entries, which are validated here; skip runs of other queries, with a line.

    Without `folders`, the tasks are those that runs were made on and that files answer; `root` is the parent of tasks/.
    `named` are the paths that the user named. `failures` records entries whose answers cannot be read, or hold a fault.
    Raise StoreError if a run that the user named answers none of the queries. Raise ConfigError if no entry answers any
    task.
    """
    files: dict[str, Answers] = {}
    for entry in entries:
        with failures.of(entry.name):
            if not entry.runs:
                files[entry.name] = Answers.read(entry.sources[0])  # without runs there is one file
    found = folders or _answered_folders(entries, files.values(), root)
    tasks = [Task.open(folder) for folder in dict.fromkeys(found)]
    task_of = {name: task.folder for task in tasks for name in task.asked}
    room = _Room(_MOST_KEPT_BYTES)
    answers: list[EntryAnswers] = []
    stale: list[Path] = []
    for entry in (entry for entry in entries if entry.name not in failures.found):
        with failures.of(entry.name):
            if entry.name in files:
                item = _answers_of_file(entry, tasks, files[entry.name], task_of)
                if item.asked:
                    check_submitted(entry, tasks, split)
            else:
                item, others = _read_runs(entry, tasks, task_of, room)
                stale += others
            answers += [item] if item.asked else []
    if not answers and failures.first is not None:
        raise failures.first
    refused = next((source for source in stale if source in named), None)
    if tasks and (refused is not None or (stale and not answers)):
        holder = "these tasks do" if folders else "its task does"
        first = refused or stale[0]
        raise StoreError(f"{first} holds answers to other queries than {holder} now: {_HOW_TO_MEND}")
    if not answers:
        raise ConfigError(
            f"there is nothing to score: no task in {root / 'tasks'} is answered "
            "(--out names another root, --tasks the tasks themselves)"
        )
    if stale:
        listed = ", ".join(map(str, stale[:MOST_NAMED])) + (", ..." if len(stale) > MOST_NAMED else "")
        tell(f"left out: {counted(len(stale), 'run')} without an answer to these queries ({listed})")
    return answers


def _answered_folders(entries: Sequence[Entry], files: Collection[Answers], root: Path) -> Iterator[Path]:
    """Yield the task folders that runs were made on, then those for which files hold an answer."""
    for suite, region in sorted({(run.suite, run.region) for entry in entries for run in entry.runs}):
        if (root / "tasks" / suite / region / TASK).is_file():
            yield root / "tasks" / suite / region
    held = {name for rows in files for name in rows.table["query_id"].to_pylist()}
    for path in sorted((root / "tasks").glob(f"*/*/{TASK}")) if held else ():
        batches = read_batches(path.parent / QUERIES, ["query_id"])
        if not held.isdisjoint(name for batch in batches for name in batch["query_id"].to_pylist()):
            yield path.parent


def _answers_of_file(
    entry: Entry, tasks: Sequence[Task], answers: Answers, task_of: Mapping[str, Path]
) -> EntryAnswers:
    """Return a file or a submission with its answers; a submission is asked the tasks it names."""
    asked = tasks
    if entry.submission is not None:
        named = {(item.suite, item.region) for item in entry.submission.tasks}
        asked = [task for task in tasks if task.manifest.name in named]
    places: dict[Path | None, list[int]] = {}
    for at, name in enumerate(answers.table["query_id"].to_pylist()):
        places.setdefault(task_of.get(name), []).append(at)
    read = {task.folder: partial(answers.some, places.get(task.folder, [])) for task in tasks}
    held = frozenset(task.folder for task in tasks if task.folder in places)
    stored = StoredAnswers(read, task_of)
    return EntryAnswers(entry=entry, predictions=stored, held=held, asked=frozenset(task.folder for task in asked))


@dataclass(frozen=True, kw_only=True)
class _Shard:
    """Answers of a run to a task: in memory, or, where there is no room, read again wherever they are used."""

    source: Path
    asked: Mapping[str, str]
    is_tied: bool
    kept: Answers | None = None

    def open(self) -> Answers:
        return Answers.open(self.source, self.asked, is_tied=self.is_tied) if self.kept is None else self.kept


def _merged(shards: Sequence[_Shard]) -> Answers:
    return shards[0].open() if len(shards) == 1 else Answers.merged([shard.open() for shard in shards])


class _Room:
    """Memory for answers."""

    def __init__(self, most_bytes: int) -> None:
        self._left = most_bytes

    def takes(self, answers: Answers) -> bool:
        """Return whether there is room, and take it."""
        is_room = bool(answers.table.nbytes <= self._left)
        self._left -= answers.table.nbytes if is_room else 0
        return is_room


def _read_runs(
    entry: Entry, tasks: Sequence[Task], task_of: Mapping[str, Path], room: _Room
) -> tuple[EntryAnswers, list[Path]]:
    """Return an entry with the answers of its runs, and the folders of runs that answer none of the tasks.

    Every answer is checked here; those that find no room are read again where they are used.
    """
    by_name = {task.manifest.name: task for task in tasks}
    shards: dict[Path, list[_Shard]] = {}  # of a task: several as of shards of a run
    runs: list[tuple[Path, RunManifest]] = []
    stale: list[Path] = []
    for source, run in zip(entry.sources, entry.runs, strict=True):
        task = by_name.get((run.suite, run.region))
        if task is None:
            stale.append(source)
            continue
        is_same = run.queries_sha256 == task.manifest.queries_sha256
        shard = _Shard(source=source, asked=task.asked, is_tied=is_same)
        found = shard.open()
        if not (len(found.table) or is_same):
            stale.append(source)
            continue
        shards.setdefault(task.folder, []).append(replace(shard, kept=found) if room.takes(found) else shard)
        runs.append((source, _share_of(run, found)))
    left = replace(entry, sources=tuple(source for source, _ in runs), runs=tuple(run for _, run in runs))
    answers = StoredAnswers({task: partial(_merged, some) for task, some in shards.items()}, task_of)
    asked = frozenset(shards)
    return EntryAnswers(entry=left, predictions=answers, held=asked, asked=asked), stale


def _share_of(run: RunManifest, answers: Answers) -> RunManifest:
    """Return the run record with CPU time scaled to the fraction of answers that count."""
    if not answers.aside or run.cpu_s is None:
        return run
    return run.model_copy(update={"cpu_s": run.cpu_s * len(answers.table) / (len(answers.table) + answers.aside)})


def open_tasks(answers: Sequence[EntryAnswers], folders: Sequence[Path], truth: Path) -> list[Task]:
    """Open the tasks of a board, whose truths lie in `truth`; without `folders`, those that the entries bring.

    Raise StoreError if a task or its truths are missing or damaged, or do not belong together.
    """
    chosen = dict.fromkeys(folders) or sorted({folder for item in answers for folder in item.held})
    tasks = [Task.open(folder, truth=truth) for folder in chosen]
    for task in tasks:
        task.check_truths()
    return tasks


@dataclass(frozen=True, kw_only=True)
class Contest:
    """Entries with their answers, the tasks, and all scored rows by entry, including those of controls.

    `views` are the rows of the views of flights by entry (`flights.view_frame`), of entries that were asked any.
    """

    answers: tuple[EntryAnswers, ...]
    tasks: tuple[Task, ...]
    scores: dict[str, pd.DataFrame]
    views: dict[str, pd.DataFrame]


def score_entries(
    answers: Sequence[EntryAnswers],
    tasks: Sequence[Task],
    *,
    split: Split | None,
    by_region: Collection[str],
    by_block: Collection[str] = (),
    failures: Failures,
) -> Contest:
    """Score the answers of all entries; `failures` records entries that cannot be scored, and they are left out.

    `split` assigns blocks to places. Suites in `by_region` are resampled by region instead of by block; in suites of
    `by_block`, whose blocks are drawn independently, each is a place. Raise the first fault, a StoreError or
    ConfigError, if no entry is left.
    """
    parts: dict[str, list[_Part]] = {item.entry.name: [] for item in answers}
    for task in tasks:  # the candidates of a task are in memory at once
        asked = _Asked.of(task, split, by_region, by_block)
        for item in answers:
            name = item.entry.name
            if name in parts and task.folder in item.asked:
                with failures.of(name):
                    parts[name].append(_scored(item, asked))
                    continue
                del parts[name]
    scores: dict[str, pd.DataFrame] = {}
    views: dict[str, pd.DataFrame] = {}
    shared: dict[tuple[int, ...], pd.DataFrame] = {}
    for name, listed in parts.items():
        with failures.of(name):
            scored = settle_not_applicable(_joined(listed, shared))
            hold_controls({name: scored})  # so that an error names the entry
            scores[name] = scored
            seen = [part.views for part in listed if part.views is not None]
            views |= {name: pd.concat(seen, ignore_index=True)} if seen else {}
    if not scores and failures.first is not None:
        raise failures.first
    left = tuple(item for item in answers if item.entry.name in scores)
    return Contest(answers=left, tasks=tuple(tasks), scores=scores, views=views)


def scored_rows(contest: Contest, split: Split | None) -> dict[str, pd.DataFrame]:
    """Return by entry the scored rows of the suites of which it was asked every task, without those of controls.

    Train places of a hold-out `split` do not count. Entries without such a suite are missing, with a line
    about the other suites of an entry. Raise ConfigError if no entry is left.
    """
    unused = {"train"} if split is not None and split.spec.kind == "holdout" else set()
    tasks = [task for task in contest.tasks if not task.parts() <= unused]
    found = {}
    for item in contest.answers:
        asked = {task.manifest.suite for task in tasks if task.folder in item.asked}
        lacking = {CONTROLS} | {task.manifest.suite for task in tasks if task.folder not in item.asked}
        lost = sorted(asked & lacking - {CONTROLS})
        if lost:
            tell(f"{item.entry.name}: not on the board of {', '.join(lost)}, for it was not asked all tasks there")
        scores = contest.scores[item.entry.name]
        is_used = scores["suite"].isin(asked - lacking) & ~scores["part"].isin(unused)
        rows = some_rows(scores, is_used.to_numpy(bool))
        if len(rows):
            found[item.entry.name] = rows
    if not found:
        raise ConfigError(
            f"there is nothing to rank: but for the suite {CONTROLS!r} no suite has a matcher that was asked all of "
            "its tasks (--tasks names some)"
        )
    return found


def rows_to_rank(scored: Mapping[str, pd.DataFrame], split: Split | None) -> dict[str, pd.DataFrame]:
    """Return by entry the rows of `scored_rows` that figures and ranks count: in a hold-out `split` of test places.

    Entries without any are missing. Raise ConfigError if no entry is left.
    """
    if split is None or split.spec.kind != "holdout":
        return dict(scored)
    counted_rows = {
        name: some_rows(rows, (rows["part"] != "calibration").to_numpy(bool)) for name, rows in scored.items()
    }
    found = {name: rows for name, rows in counted_rows.items() if len(rows)}
    if not found:
        raise ConfigError(f"there is nothing to rank: no query is of a test place of the hold-out {split.spec.id!r}")
    return found


def check_submitted(entry: Entry, tasks: Sequence[Task], split: Split | None) -> None:
    """Check a file or submission against the tasks; a query without a row is a miss, not a fault.

    Raise ConfigError with the first fault, and the number of faults. Raise StoreError if it cannot be read.
    """
    path = entry.sources[0]
    if entry.submission is None:
        found = validate(path, tasks)
    else:
        path = path.parents[1]
        found = submission_faults(path, entry.submission, tasks, split)
    faults = [fault for fault in found if not fault.is_missing_row]
    if faults:
        raise ConfigError(f"{path} holds {counted(len(faults), 'fault')}: {faults[0].to_text()} ('verify' lists all)")


def _places(split: Split | None) -> dict[str, Mapping[str, str]]:
    return {} if split is None else {"place_of": split.place_of, "country_of": split.country_of}


def design_rows(task: Task, split: Split | None) -> pd.DataFrame:
    """Return a row for each query or flight of one task, scored without an answer; raise as `score_task` does."""
    return _Asked.of(task, split).scored(Answers.of([])).whole


def _scored(item: EntryAnswers, asked: "_Asked") -> "_Part":
    return asked.scored(item.predictions.of_task(asked.task.folder))


@dataclass(frozen=True, slots=True, kw_only=True)
class _Part:
    """Scored rows of one entry at one task: columns of its queries, which entries share, and of its answers.

    Of flights `questions` is None and `answers` holds all columns; `views` are the rows of their views.
    """

    questions: pd.DataFrame | None
    answers: pd.DataFrame
    views: pd.DataFrame | None = None

    @property
    def whole(self) -> pd.DataFrame:
        """Return rows with all columns."""
        return self.answers if self.questions is None else with_answers(self.questions, self.answers)


def _joined(parts: Sequence[_Part], shared: dict[tuple[int, ...], pd.DataFrame]) -> pd.DataFrame:
    """Return the rows of all parts; `shared` keeps the columns of queries for entries that were asked the same."""
    questions = [part.questions for part in parts if part.questions is not None]
    if len(questions) < len(parts):
        return pd.concat([part.whole for part in parts], ignore_index=True)
    key = tuple(map(id, questions))
    if key not in shared:
        shared[key] = pd.concat(questions, ignore_index=True)
    return with_answers(shared[key], pd.concat([part.answers for part in parts], ignore_index=True))


@dataclass(frozen=True, kw_only=True)
class _Asked:
    """The queries of a task, read once for all entries, and what their rows are drawn by."""

    task: Task
    questions: Questions
    columns: pd.DataFrame
    split: Split | None
    is_by_region: bool
    is_by_block: bool

    @classmethod
    def of(
        cls, task: Task, split: Split | None, by_region: Collection[str] = (), by_block: Collection[str] = ()
    ) -> Self:
        questions = Questions.of(tuple(task.heads()), task.truths, **_places(split))
        suite = task.manifest.suite
        found = cls(
            task=task,
            questions=questions,
            columns=questions.frame,
            split=split,
            is_by_region=suite in by_region,
            is_by_block=suite in by_block,
        )
        return replace(found, columns=found.resampled(questions.frame))

    def scored(self, answers: Answers) -> _Part:
        """Score the answers of one entry."""
        if not self.task.manifest.is_of_flights:
            return _Part(questions=self.columns, answers=self.questions.answered(answers))
        found = score_flights(self.questions.heads, self.questions.truths, answers.found, **_places(self.split))
        return _Part(questions=None, answers=self.resampled(found.flights), views=found.views)

    def resampled(self, frame: pd.DataFrame) -> pd.DataFrame:
        """Return rows with the blocks and places that they are drawn by."""
        frame = frame.assign(block=frame["region"]) if self.is_by_region else frame
        return frame.assign(place=frame["block"], country=frame["block"]) if self.is_by_block else frame
