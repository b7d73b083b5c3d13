# SPDX-License-Identifier: Apache-2.0
"""Entries of a board: runs of matchers, files of predictions, and submissions."""

import re
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass, replace
from functools import partial
from itertools import compress
from pathlib import Path
from typing import Final, Self

import pandas as pd

from sasgeo_bench.core.errors import ConfigError, MatchError, StoreError, counted, named
from sasgeo_bench.core.plugins import ORACLE, shipped_names
from sasgeo_bench.core.progress import tell
from sasgeo_bench.core.texts import one_line
from sasgeo_bench.matching.cards import Learned, TrainingRecord
from sasgeo_bench.matching.matcher import check_identity
from sasgeo_bench.matching.submission import Submission
from sasgeo_bench.running.failures import Failures
from sasgeo_bench.running.prediction_files import RUN, Answers, CardRecord, RunManifest, StoredAnswers, damaged
from sasgeo_bench.scoring.controls import Verdict, evaluate_controls, reason_implausible
from sasgeo_bench.scoring.flights import score_flights
from sasgeo_bench.scoring.rows import AS_SUBMITTED, PACKED, RUN_HERE, is_unranked
from sasgeo_bench.scoring.score import Questions, settle_not_applicable, some_rows, with_answers
from sasgeo_bench.scoring.submission_files import predictions_name, read_submission, submission_faults, validate
from sasgeo_bench.tasks.query import CONTROLS, base_of
from sasgeo_bench.tasks.split import Split
from sasgeo_bench.tasks.task_files import QUERIES, TASK, Task, read_batches

FILE_NAME: Final = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]*")

_ByRun = dict[tuple[str, str, str], list[tuple[Path, RunManifest]]]  # folders and manifests by name, version, hash


@dataclass(frozen=True, kw_only=True)
class Entry:
    """One entry of a board: the runs of a matcher, a file of predictions, or a submission.

    `runs` are the manifests of its runs; `sources` the folder or file of predictions for each of them.
    `submission` is the content of `submission.json`.
    """

    name: str
    version: str
    hash: str
    how: str
    sources: tuple[Path, ...]
    runs: tuple[RunManifest, ...] = ()
    submission: Submission | None = None

    @property
    def card(self) -> CardRecord | None:
        """Return the card of the matcher or submission; None for a file of predictions."""
        if self.submission is not None:
            return CardRecord.model_validate(self.submission.card.model_dump(mode="json"))
        return self.runs[0].matcher if self.runs else None

    @property
    def declared(self) -> list[str] | None:
        """Return the training places that the entry declares itself; None if it declares nothing."""
        if self.submission is not None:
            return list(self.submission.card.places)
        places = self.runs[0].matcher.trained_on if self.runs else None
        return list(places) if isinstance(places, list) else None

    @property
    def is_taught(self) -> bool:
        """Return True if the halves of a split were answered after different training."""
        return bool(self.learned()) or (self.submission is not None and self.submission.card.is_by_half)

    def learned(self) -> list[Learned]:
        """Return each training by the runner once: its source, its training places and the tasks asked under it."""
        found: dict[str, TrainingRecord] = {}
        asked: dict[str, list[str]] = {}
        for run in self.runs:
            if run.learned is not None:
                found.setdefault(run.learned.key, run.learned)
                asked.setdefault(run.learned.key, []).append(f"{run.suite}/{run.region}")
        known = set(TrainingRecord.model_fields)
        return [
            Learned.model_validate(one.model_dump(include=known) | {"asked": sorted(asked[key])})
            for key, one in sorted(found.items())
        ]


def find_entries(
    paths: Sequence[Path], submissions: Sequence[Path] = (), *, failures: Failures | None = None
) -> tuple[Entry, ...]:
    """Return the entries found in folders of runs, files of predictions and submissions, by name.

    Runs may lie at any depth. Two versions of one matcher are two entries, with the version in their names, and the
    hash if versions agree. `failures` records runs and submissions that cannot be read, and submissions whose name
    another entry has; without it, the first one raises. Raise StoreError if a path holds no predictions, a `run.json`
    does not identify its matcher, or a submission is damaged. Raise ConfigError if two files share a name, or one has
    that of a run or a control.
    """
    runs: list[Path] = []
    files: list[Entry] = []
    seen: set[Path] = set()  # a run or file that is given twice counts once
    for path in paths:
        if path.is_file():
            if _is_new(path, seen):
                files.append(_file_entry(path))
            continue
        found = sorted(path.rglob(RUN))
        for folder in sorted({part.parent for part in path.rglob("part-*.parquet")} - {run.parent for run in found}):
            with _noted(failures, str(folder)):
                raise StoreError(f"{folder} holds answers and no {RUN}: run the matcher again, they are kept")
        if not found:
            raise StoreError(
                f"{path} holds no run: name the folder of a run, one with runs in it, or a predictions file"
            )
        runs += [run for run in found if _is_new(run, seen)]
    entries = [*_entries_of_runs(_by_run(runs, failures)), *files]
    listed = [entry.name for entry in entries]
    twice = next((name for name in listed if listed.count(name) > 1), None)
    if twice is not None:
        raise ConfigError(f"two entries are named {twice!r}: rename the file of one")
    # A submission may not have the name of a matcher shown as several versions: readers would confuse them.
    taken = {*listed, *(entry.runs[0].matcher.name for entry in entries if entry.runs)}
    entries += _submitted(submissions, taken, failures)
    return tuple(sorted(entries, key=lambda entry: entry.name))


def leave_out(entries: tuple[Entry, ...], regions: Collection[str]) -> tuple[Entry, ...]:
    """Return the entries without runs on some regions and their modified maps; drop entries without runs.

    Raise ConfigError if no run is on one of the regions, all runs are, or an entry is a file, which does not name
    regions.
    """
    if not regions:
        return entries
    file = next((entry for entry in entries if not entry.runs), None)
    if file is not None:
        raise ConfigError(
            f"{file.sources[0]} is a file of predictions, of which no region can be left out: name runs alone"
        )
    known = {base_of(run.region) for entry in entries for run in entry.runs}
    unknown = sorted(set(regions) - known)
    if unknown:
        raise ConfigError(f"no run is on {unknown[0]!r}: regions that can be left out are {', '.join(sorted(known))}")
    if known <= set(regions):
        raise ConfigError(
            "there is nothing to score: every run is on a region that is left out, leave fewer out (--without)"
        )
    kept = [[base_of(run.region) not in regions for run in entry.runs] for entry in entries]
    return tuple(
        replace(entry, sources=tuple(compress(entry.sources, keep)), runs=tuple(compress(entry.runs, keep)))
        for entry, keep in zip(entries, kept, strict=True)
        if any(keep)
    )


def _entries_of_runs(by_run: _ByRun) -> list[Entry]:
    """Return an entry for each name, version and hash, under the shortest name that no other has."""
    names = [name for name, _, _ in by_run]
    versions = [(name, number) for name, number, _ in by_run]
    entries = []
    for (name, number, digest), found in by_run.items():
        shown = name if names.count(name) == 1 else f"{name} {number}"
        if versions.count((name, number)) > 1:
            shown = f"{name} {number} ({digest[:6]})"
        entries.append(
            Entry(
                name=shown,
                version=number,
                hash=digest,
                how=PACKED if any(run.packed for _, run in found) else RUN_HERE,
                sources=tuple(folder for folder, _ in found),
                runs=tuple(run for _, run in found),
            )
        )
    return entries


def _by_run(paths: Sequence[Path], failures: Failures | None) -> _ByRun:
    """Return runs by name, version and hash; skip matchers with an unreadable run, which would be ranked on a part."""
    read: dict[Path, RunManifest] = {}
    for path in paths:
        with _noted(failures, str(path.parent)):
            read[path] = _read_run(path)
    lost = {_root_of(path) for path in paths if path not in read}
    found: _ByRun = {}
    for path, run in read.items():
        if _root_of(path) not in lost:
            found.setdefault((run.matcher.name, run.matcher.version, run.hash), []).append((path.parent, run))
    return found


def _root_of(run: Path) -> Path:
    """Return the folder of all runs of a matcher with one hash, above suite and region."""
    return list(run.resolve().parents)[:3][-1]


def _noted(failures: Failures | None, name: str) -> AbstractContextManager[None]:
    return nullcontext() if failures is None else failures.of(name)


def _is_new(path: Path, seen: set[Path]) -> bool:
    place = path.parent.resolve() / path.name
    is_new = place not in seen
    seen.add(place)
    return is_new


def _file_entry(path: Path) -> Entry:
    if not FILE_NAME.fullmatch(path.stem):
        raise ConfigError(f"{path.name!r}: name the file by letters, digits, hyphens, dots and underscores alone")
    if is_unranked(path.stem):
        raise ConfigError(f"{path.name!r}: {path.stem!r} is the name of a control of every board: choose another name")
    return Entry(name=path.stem, version="", hash="", how=AS_SUBMITTED, sources=(path,))


def check_name(name: str, taken: Collection[str] = (), *, source: str) -> None:
    """Refuse the name of a submission whose row would be taken for that of another; `source` is where the name stands.

    `taken` are names of matchers on the board. Raise `ConfigError`.

    >>> check_name("random", source="card.toml")
    Traceback (most recent call last):
        ...
    sasgeo_bench.core.errors.ConfigError: card.toml: 'random' is the name of a control of every board: choose another
    name
    """
    kinds = {
        "a control of every board": is_unranked(name),
        "another entry of the board": name in taken,
        "a matcher that ships": name in shipped_names(),
    }
    whose = next((kind for kind, is_taken in kinds.items() if is_taken), None)
    if whose is not None:
        raise ConfigError(f"{source}: {name!r} is the name of {whose}: choose another name")


def _submitted(folders: Sequence[Path], taken: Collection[str], failures: Failures | None) -> list[Entry]:
    """Return the submissions with a name of their own; `taken` are names of entries of other kinds.

    A refused one is recorded by its path: under its name it would take an entry of that name with it.
    """
    read: dict[Path, Submission] = {}
    for folder in folders:
        with _noted(failures, one_line(str(folder))):
            submission = read_submission(folder)
            check_name(submission.card.name, taken, source=str(folder))
            read[folder] = submission
    found = []
    for folder, submission in read.items():
        name = submission.card.name
        twins = [str(other) for other, one in read.items() if one.card.name == name and other != folder]
        with _noted(failures, one_line(str(folder))):
            if twins:
                raise ConfigError(
                    f"{folder} and {', '.join(twins)} have one name, {name!r}: remove or rename a submission"
                )
            found.append(_entry_of(folder, submission))
    return found


def _entry_of(folder: Path, submission: Submission) -> Entry:
    return Entry(
        name=submission.card.name,
        version=submission.card.version,
        hash="",
        how=AS_SUBMITTED,
        sources=(folder / predictions_name(submission.card.name),),
        submission=submission,
    )


def _read_run(path: Path) -> RunManifest:
    """Read a `run.json` that must identify its matcher and queries: its author is not trusted."""
    run = RunManifest.open(path.parent) or RunManifest()
    name, version = run.matcher.name, run.matcher.version
    stated = {"matcher.name": name, "matcher.version": version, "hash": run.hash, "suite": run.suite}
    stated |= {"region": run.region, "queries_sha256": run.queries_sha256}
    fault = next((f"{field} is {value!r}" for field, value in stated.items() if not value), None)
    try:
        check_identity(name, version)
    except MatchError as error:
        fault = fault or str(error)
    if name == ORACLE != (run.spec or ORACLE):
        fault = f"it has the name of the control {ORACLE}, and was run as {run.spec!r}"
    if fault is not None:
        raise damaged(path, fault)
    return run


def set_apart(
    entries: Sequence[Entry],
    scores: Mapping[str, pd.DataFrame],
    split: Split | None,
    verdicts: Sequence[Verdict] = (),
) -> dict[str, str]:
    """Return by entry why its rows are excluded from ranks, with a line; other entries are missing.

    Rows are excluded if the answers about a place come from training on that place, or if the entry is right more often
    than chance explains where nothing but the truth could help. Controls are unranked anyway. `scores` has the columns
    suite, region and place of every query the entry was asked; `split` assigns the half of each place.
    """
    found = {}
    for entry in entries:
        if is_unranked(entry.name):
            continue
        places = sorted(set(_overlaps(entry, scores[entry.name], split)))
        what = places[0] if len(places) == 1 else named(places, "place")
        trained = f"trained on {what}, which it is tested on" if places else None
        reasons = [reason for reason in (reason_implausible(verdicts, entry.name), trained) if reason]
        if reasons:
            found[entry.name] = "; ".join(reasons)
            tell(f"{entry.name}: set apart, {found[entry.name]}")
    return found


def _overlaps(entry: Entry, scores: pd.DataFrame, split: Split | None) -> Iterator[str]:
    """Yield places that the answers about them were trained on."""
    for place in dict.fromkeys(scores["place"]):
        if place in _declared(entry, str(place), split):
            yield str(place)
    for run in entry.runs:
        is_mine = (scores["suite"] == run.suite) & (scores["region"] == run.region)
        yield from set() if run.learned is None else set(scores.loc[is_mine, "place"]) & set(run.learned.trained_on)


def _declared(entry: Entry, place: str, split: Split | None) -> Sequence[str]:
    """Return the declared training places of the answers about a place."""
    if entry.submission is None:
        return entry.declared or ()
    return entry.submission.card.taught(None if split is None else split.half_of.get(place))


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


def _same(answers: Answers) -> Answers:
    return answers


def _merged(shards: Sequence[Callable[[], Answers]]) -> Answers:
    return shards[0]() if len(shards) == 1 else Answers.merged([read() for read in shards])


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
    shards: dict[Path, list[Callable[[], Answers]]] = {}  # of a task: several as of shards of a run
    runs: list[tuple[Path, RunManifest]] = []
    stale: list[Path] = []
    for source, run in zip(entry.sources, entry.runs, strict=True):
        task = by_name.get((run.suite, run.region))
        if task is None:
            stale.append(source)
            continue
        is_same = run.queries_sha256 == task.manifest.queries_sha256
        read = partial(Answers.open, source, task.asked, is_tied=is_same)
        found = read()
        if not (len(found.table) or is_same):
            stale.append(source)
            continue
        shards.setdefault(task.folder, []).append(partial(_same, found) if room.takes(found) else read)
        runs.append((source, _share_of(run, found)))
    left = replace(entry, sources=tuple(source for source, _ in runs), runs=tuple(run for _, run in runs))
    answers = StoredAnswers({task: partial(_merged, some) for task, some in shards.items()}, task_of)
    asked = frozenset(shards)
    return EntryAnswers(entry=left, predictions=answers, held=asked, asked=asked), stale


def _share_of(run: RunManifest, answers: Answers) -> RunManifest:
    """Return the run record with CPU time scaled to the fraction of answers that count."""
    if not answers.excluded or run.cpu_s is None:
        return run
    return run.model_copy(update={"cpu_s": run.cpu_s * len(answers.table) / (len(answers.table) + answers.excluded)})


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
class ScoredEntries:
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
) -> ScoredEntries:
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
                    parts[name].append(asked.scored(item.predictions.of_task(task.folder)))
                    continue
                del parts[name]
    scores: dict[str, pd.DataFrame] = {}
    views: dict[str, pd.DataFrame] = {}
    shared: dict[tuple[int, ...], pd.DataFrame] = {}
    for name, listed in parts.items():
        with failures.of(name):
            scored = settle_not_applicable(_joined(listed, shared))
            evaluate_controls({name: scored})  # so that an error names the entry
            scores[name] = scored
            seen = [part.views for part in listed if part.views is not None]
            views |= {name: pd.concat(seen, ignore_index=True)} if seen else {}
    if not scores and failures.first is not None:
        raise failures.first
    left = tuple(item for item in answers if item.entry.name in scores)
    return ScoredEntries(answers=left, tasks=tuple(tasks), scores=scores, views=views)


def scored_rows(loaded: ScoredEntries, split: Split | None) -> dict[str, pd.DataFrame]:
    """Return by entry the scored rows of the suites of which it was asked every task, without those of controls.

    Train places of a hold-out `split` do not count. Entries without such a suite are missing, with a line
    about the other suites of an entry. Raise ConfigError if no entry is left.
    """
    unused = {"train"} if split is not None and split.spec.kind == "holdout" else set()
    tasks = [task for task in loaded.tasks if not task.parts() <= unused]
    if split is not None and loaded.tasks and not tasks:
        raise ConfigError(
            f"there is nothing to rank: all tasks are of train places of split {split.spec.id!r}, which no board "
            "counts: draw some of calibration and test places"
        )
    found = {}
    for item in loaded.answers:
        asked = {task.manifest.suite for task in tasks if task.folder in item.asked}
        lacking = {CONTROLS} | {task.manifest.suite for task in tasks if task.folder not in item.asked}
        lost = sorted(asked & lacking - {CONTROLS})
        if lost:
            tell(f"{item.entry.name}: not on the board of {', '.join(lost)}, for it was not asked all tasks there")
        scores = loaded.scores[item.entry.name]
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
