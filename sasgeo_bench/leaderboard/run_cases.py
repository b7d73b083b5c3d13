# SPDX-License-Identifier: Apache-2.0
"""A matcher's runs looked at query by query: how each went wrong, and what the picture of any of them shows."""

import difflib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import pandas as pd

from sasgeo_bench.errors import ConfigError, SasgeoError, StoreError, counted
from sasgeo_bench.leaderboard.board_pictures import words_of
from sasgeo_bench.leaderboard.case_panels import Case, read_picture
from sasgeo_bench.leaderboard.case_plot import CasePicture
from sasgeo_bench.leaderboard.cases import find_cases, operating_rejector
from sasgeo_bench.matching.learned_file import TrainingRecord
from sasgeo_bench.matching.results import Prediction
from sasgeo_bench.progress import Tell
from sasgeo_bench.running import prediction_files
from sasgeo_bench.scoring.controls import is_control
from sasgeo_bench.scoring.entries import Entry, find_entries
from sasgeo_bench.scoring.rejection import OWN, judge, own_confidence, rules_of
from sasgeo_bench.scoring.score import score_task, settle_not_applicable
from sasgeo_bench.scoring.scored_tasks import AskedTask, ScoredTask, read_scored_task
from sasgeo_bench.tasks import task_files
from sasgeo_bench.tasks.query import Truth
from sasgeo_bench.tasks.split import Split

_NAMED: Final = 3


@dataclass(frozen=True, kw_only=True)
class RunCases:
    """A matcher's answers, scored.

    Parameters
    ----------
    run : Path
        As it was named.
    entry : Entry
        Who answered.
    root : Path
        Where tasks/, truth/ and regions/ are.
    scores : pandas.DataFrame
        Scored rows of all tasks.
    judged : mapping of (matcher, rejector) to pandas.DataFrame
        What rejectors say of them, its own word among them.
    tasks : mapping of (str, str) to ScoredTask
        By suite and region.
    predictions : mapping of str to Prediction
        By query.
    """

    run: Path
    entry: Entry
    root: Path
    scores: pd.DataFrame
    judged: Mapping[tuple[str, str], pd.DataFrame]
    tasks: Mapping[tuple[str, str], ScoredTask]
    predictions: Mapping[str, Prediction]

    def failures(self) -> pd.DataFrame:
        """Every failure with its class (`cases.COLUMNS`); controls of boards are none."""
        rejector = operating_rejector(self.judged, self.entry.name)
        judged = None if rejector is None else self.judged[self.entry.name, rejector]
        return find_cases(self.scores[~is_control(self.scores)].reset_index(drop=True), self.entry.name, judged)


def root_of(run: Path, out: Path) -> Path:
    """Return the folder of tasks, truths and regions of a run: next to its runs/, unless given."""
    above = (folder.parent for folder in run.resolve().parents if folder.name == "runs")
    return next((root for root in above if (root / "tasks").is_dir()), out)


def is_run(folder: Path) -> bool:
    """Return whether a folder is a run, or holds those of a matcher.

    Examples
    --------
    >>> is_run(Path("nowhere"))
    False
    """
    patterns = (prediction_files.RUN, f"*/*/{prediction_files.RUN}", f"*/*/*/{prediction_files.RUN}")
    return any(next(folder.glob(pattern), None) is not None for pattern in patterns)


def read_run_cases(run: Path, *, out: Path, split: Split | None, rejectors: Sequence[str] = (), tell: Tell) -> RunCases:
    """Score the answers of a run.

    Parameters
    ----------
    run : Path
        Folder of a run, or one with runs of one matcher.
    out : Path
        Root of what is built, for runs that lie elsewhere.
    split : Split, optional
        Says which places calibrate.
    rejectors : sequence of str
        Names, or module:Class; the matcher's own word is always among them.
    tell : callable
        Gets a line for runs that are left out.

    Raises
    ------
    StoreError
        If no task of the run is there as it was asked, or a truth is missing.
    ConfigError
        If the folder holds runs of several matchers.
    """
    entries = find_entries([run])
    if len(entries) > 1:
        names = ", ".join(f"{entry.version}: {entry.sources[0].parents[1]}" for entry in entries[:_NAMED])
        message = f"{run} holds runs of {len(entries)} matchers or versions: name the folder of one ({names})"
        raise ConfigError(message)
    (entry,), root = entries, root_of(run, out)
    predictions: dict[str, Prediction] = {}
    tasks: dict[tuple[str, str], ScoredTask] = {}
    lost: list[SasgeoError] = []
    frames = []
    place_of = {} if split is None else split.place_of
    for source, about in zip(entry.sources, entry.runs, strict=True):
        try:
            mine = _answers(source, about, root / "tasks" / about["suite"] / about["region"])
            task = read_scored_task(root / "tasks" / about["suite"] / about["region"], root / "truth")
        except SasgeoError as error:
            lost.append(error)
            continue
        frames.append(score_task(task.heads, task.truths, mine, place_of=place_of))
        tasks[about["suite"], about["region"]] = task
        predictions |= mine
    if not frames:
        raise lost[0]
    if lost:
        tell(f"left out: {counted(len(lost), 'run')} of {len(entry.sources)}, as {lost[0]}")
    scores = settle_not_applicable(pd.concat(frames, ignore_index=True))
    judged = _judged(entry, scores, predictions, split, rejectors)
    return RunCases(run=run, entry=entry, root=root, scores=scores, judged=judged, tasks=tasks, predictions=predictions)


def _answers(source: Path, about: Mapping[str, Any], folder: Path) -> dict[str, Prediction]:
    """Answers of a run to the queries as they are now."""
    task = AskedTask.of(folder)
    is_same = about["queries_sha256"] == task.about["files"][task_files.QUERIES]["sha256"]
    found = prediction_files.read_answers(source, task.asked, is_tied=is_same)
    if not (found.found or is_same):
        message = (
            f"{source} holds answers to other queries than {folder} does now: run again, or make the old ones again"
        )
        raise StoreError(message)
    return found.found


def _judged(
    entry: Entry,
    scores: pd.DataFrame,
    predictions: Mapping[str, Prediction],
    split: Split | None,
    rejectors: Sequence[str],
) -> dict[tuple[str, str], pd.DataFrame]:
    """Return the results of the matcher's own confidence and of some rejectors, where they apply."""
    usable = scores[~is_control(scores)].reset_index(drop=True)
    is_taught = any(TrainingRecord.of(about) is not None for about in entry.runs)
    found = {OWN: own_confidence(usable, split, is_taught=is_taught)}
    for name, rule in rules_of(rejectors, split).items():
        found[name] = judge(usable, predictions, rule.make, rule.split, is_taught=is_taught)
    return {(entry.name, name): frame for name, frame in found.items() if len(frame)}


def picture_of(cases: RunCases, query: str) -> tuple[str, CasePicture]:
    """Id of a query and what its picture shows.

    Parameters
    ----------
    cases : RunCases
        The run.
    query : str
        The beginning of an id.

    Raises
    ------
    ConfigError
        If no query, or more than one, begins so.
    StoreError
        If the query was drawn anew since it was asked, or its map is missing or another one.
    """
    query_id = _find(cases, query)
    row = cases.scores[cases.scores["query_id"] == query_id].iloc[0]
    task = cases.tasks[row["suite"], row["region"]]
    (found,) = list(task_files.read_some(task.folder, {query_id}))
    failures = cases.failures().set_index("query_id")["failure"]
    words = {key: frame.set_index("query_id") for key, frame in cases.judged.items()}
    case = Case(
        matcher=cases.entry.name,
        failure=str(failures.get(query_id, "")),
        query=found[0],
        truth=_truth(task, query_id),
        prediction=cases.predictions.get(query_id),
        **words_of(words, cases.entry.name, query_id),
    )
    return query_id, read_picture(case, cases.root / "regions" / row["region"], task.about)


def _truth(task: ScoredTask, query_id: str) -> Truth:
    return next(truth for truth in task.truths if truth.query_id == query_id)


def _find(cases: RunCases, query: str) -> str:
    """The one id that begins so."""
    if not query:
        message = f"--query is empty: name the beginning of an id, as 'inspect {cases.run}' lists some"
        raise ConfigError(message)
    known = sorted(cases.scores["query_id"])
    found = [name for name in known if name.startswith(query)]
    if len(found) > 1:
        message = f"{counted(len(found), 'query', 'queries')} begin with {query!r} ({', '.join(found[:_NAMED])}, ...)"
        message = f"{message}: name more of the id"
        raise ConfigError(message)
    answered = {tie.query_id for source in cases.entry.sources for tie in prediction_files.read_ties(source)}
    is_old = found and found[0] in answered and found[0] not in cases.predictions
    if is_old or (not found and any(name.startswith(query) for name in answered)):
        message = (
            f"query {query!r} was drawn anew since {cases.run} answered it: run again, or make the old queries again"
        )
        raise StoreError(message)
    if not found:
        near = difflib.get_close_matches(query, known, n=1)
        hint = f"did you mean {near[0]}?" if near else f"'inspect {cases.run}' lists some that went wrong"
        message = f"{cases.run} was asked no query {query!r}; {hint}"
        raise ConfigError(message)
    return str(found[0])
