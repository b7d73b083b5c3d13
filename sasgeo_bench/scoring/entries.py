# SPDX-License-Identifier: Apache-2.0
"""Entries of a board: runs of matchers, files of predictions, and submissions."""

import re
from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass, replace
from itertools import compress
from pathlib import Path
from typing import Any, Final

import pandas as pd

from sasgeo_bench.errors import ConfigError, MatchError, StoreError, named
from sasgeo_bench.files.plugins import ORACLE, shipped_names
from sasgeo_bench.matching.learned_file import TrainingRecord
from sasgeo_bench.matching.matcher import check_identity
from sasgeo_bench.matching.submission import Submission
from sasgeo_bench.progress import tell
from sasgeo_bench.running.failures import Failures
from sasgeo_bench.running.run_manifest import RUN, RunManifest, damaged
from sasgeo_bench.scoring.controls import Verdict, knows_too_much
from sasgeo_bench.scoring.rows import AS_SUBMITTED, PACKED, RUN_HERE, is_unranked
from sasgeo_bench.scoring.submission_files import predictions_name, read_submission
from sasgeo_bench.tasks.query import base_of
from sasgeo_bench.tasks.split import Split
from sasgeo_bench.texts import one_line

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
    def card(self) -> dict[str, Any] | None:
        """Return the card of the matcher or submission; None for a file of predictions."""
        if self.submission is not None:
            return self.submission.card.model_dump(mode="json")
        return self.runs[0].matcher.model_dump(mode="json", exclude_unset=True) if self.runs else None

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

    def learned(self) -> list[dict[str, Any]]:
        """Return each training by the runner once: its source, its training places and the tasks asked under it."""
        found: dict[str, dict[str, Any]] = {}
        for run in self.runs:
            if run.learned is not None:
                fields = run.learned.model_dump(include=set(TrainingRecord.model_fields))
                one = found.setdefault(run.learned.key, fields | {"asked": []})
                one["asked"].append(f"{run.suite}/{run.region}")
        return [one | {"asked": sorted(one["asked"])} for _, one in sorted(found.items())]


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
    sasgeo_bench.errors.ConfigError: card.toml: 'random' is the name of a control of every board: choose another name
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
        reasons = [reason for reason in (knows_too_much(verdicts, entry.name), trained) if reason]
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
