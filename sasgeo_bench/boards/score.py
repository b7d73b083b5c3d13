# SPDX-License-Identifier: Apache-2.0
"""Runs, files of predictions and truths -> a scored board: the order of the steps."""

import math
import platform
from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from functools import cache, partial
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Final

import numpy as np
import pandas as pd

from sasgeo_bench.boards.board import Board
from sasgeo_bench.boards.board_files import check_board
from sasgeo_bench.boards.manifests import (
    BoardEntry,
    BoardManifest,
    BoardTask,
    MetricRecord,
    RejectorRecord,
    SeedRecord,
)
from sasgeo_bench.boards.private_board import OnPrivate, score_private, seed_of
from sasgeo_bench.boards.scored import Scored, ScoreRequest
from sasgeo_bench.core.errors import StoreError, counted
from sasgeo_bench.core.progress import tell
from sasgeo_bench.matching.matcher import RejectorCard
from sasgeo_bench.regions.region import DATA_VERSION
from sasgeo_bench.regions.region_files import read_manifest
from sasgeo_bench.running.failures import Failures, is_disk_error, log_beside
from sasgeo_bench.running.prediction_files import StoredAnswers
from sasgeo_bench.running.sandbox import joined
from sasgeo_bench.scoring.compare import CONTRAST_SCHEMA, Finding, with_causes
from sasgeo_bench.scoring.contrasts import evaluate_contrasts
from sasgeo_bench.scoring.controls import (
    CONTROL_SCHEMA,
    FALSIFIER_SCHEMA,
    Falsifier,
    Verdict,
    evaluate_controls,
    evaluate_falsifiers,
    failed_controls,
    gains_without_stress,
)
from sasgeo_bench.scoring.cost import COLUMNS as COST_COLUMNS
from sasgeo_bench.scoring.cost import Costs
from sasgeo_bench.scoring.entries import (
    Entry,
    ScoredEntries,
    find_entries,
    leave_out,
    open_tasks,
    read_entry_answers,
    rows_to_rank,
    score_entries,
    scored_rows,
    set_apart,
)
from sasgeo_bench.scoring.metric import MeanMetric
from sasgeo_bench.scoring.metric_plugins import ForeignMetric, find_metrics, with_metrics
from sasgeo_bench.scoring.protection import PROTECTION_SCHEMA, protection_frame
from sasgeo_bench.scoring.rejection import RejectionResult, RejectionTask, Rule, evaluate_rejectors, rules_of
from sasgeo_bench.scoring.requirements import compliance_frame, own_metrics, parse_requirements, with_own
from sasgeo_bench.scoring.rows import FIGURE_SCHEMA, EntryLabel, base_name, with_entry_labels
from sasgeo_bench.scoring.score import SCORER_VERSION, single_views
from sasgeo_bench.scoring.tables import cost_figures, leaderboards
from sasgeo_bench.tasks.query import SEQUENCE, TASK_VERSION, base_of
from sasgeo_bench.tasks.split import Split
from sasgeo_bench.tasks.task_files import Task, TaskManifest

_M2_PER_KM2: Final = 1e6
_LIBRARIES: Final = ("numpy", "scipy", "pandas", "pyarrow", "statsmodels", "scikit-learn")
_OF_TASKS: Final = ("suite", "suite_version", *BoardTask.model_fields)  # in the order of `board.json`


def score_board(request: ScoreRequest) -> Scored:
    """Load the entries and their tasks, score each answer, and compare the entries; nothing is drawn or written.

    Raise StoreError if predictions, tasks or truths are missing, damaged, or of other versions, or a run that is named
    by itself answers none of the queries. Raise ConfigError if there is nothing to score, or rejectors are named
    without a split, or a limit or a requirement is none, MatchError or MetricError if a metric of another package
    cannot be found, or fails.
    """
    check_board(request.board, scorer_version=SCORER_VERSION)
    rules, metrics = rules_of(request.rejectors, request.split), find_metrics(request.metrics)
    requirements = parse_requirements(request.require)
    own = own_metrics(request.within, requirements, others={item.metric.name for item in metrics})
    failures = Failures(log_beside(request.board), is_reported=False)  # reported with the board, or raised
    ranks = None
    # Entries are compared together: those that this fails for are noted as failed, and not loaded again.
    while ranks is None:
        loaded = _scored_entries(request, failures)
        controls = evaluate_controls(loaded.scores)
        with_calibration = scored_rows(loaded, request.split)
        scores = rows_to_rank(with_calibration, request.split)
        entries = [item.entry for item in loaded.answers if item.entry.name in scores]
        excluded = set_apart(entries, scores, request.split, controls)
        tasks = tuple(task.manifest for task in loaded.tasks)
        on_private = score_private(request, entries=entries, scores=scores, tasks=tasks)
        views = _views_of(loaded.views, scores)
        frames, more = with_metrics(metrics, scores)
        asked = (*more, *(one.metric for one in own))
        ranks = _ranks(with_own(own, frames, views), asked, excluded, request.draws, failures)
    predictions = {item.entry.name: item.predictions for item in loaded.answers}
    costs = _costs(entries, scores, views, loaded.tasks, failures)
    rejection = _rejection(request, rules, entries, with_calibration, predictions, failures)
    falsifiers, findings = _falsifiers_and_findings(request, scores, rejection, failures)
    protection = _protection(with_calibration, scores, predictions, request.split, failures)
    records = [_entry_record(entry, excluded.get(entry.name), on_private, controls) for entry in entries]
    leaderboard = with_entry_labels(
        pd.concat([part for part in (*ranks, *costs, *rejection.rows) if len(part)], ignore_index=True),
        {one.name: EntryLabel(one.version or "", one.hash or "", one.how or "", one.set_apart) for one in records},
    )
    board = Board(
        folder=request.board,
        about=_manifest_of(
            request,
            tasks,
            records,
            private=on_private.seed,
            plugins=([rule.card for rule in rules.values()], [_metric_of(item) for item in metrics]),
            remarks=rejection.remarks,
            failed=failures.found,
        ),
        leaderboard=leaderboard,
        scores=pd.concat([frame.assign(matcher=name) for name, frame in scores.items()], ignore_index=True),
        contrasts=CONTRAST_SCHEMA.frame(findings),
        controls=CONTROL_SCHEMA.frame(controls),
        falsifiers=FALSIFIER_SCHEMA.frame(falsifiers),
        acceptance=rejection.acceptance,
        protection=protection,
        requirements=compliance_frame(requirements, leaderboard),
    )
    truths = {truth.query_id: truth for task in loaded.tasks for truth in task.truths}
    return Scored(
        board=board,
        entries=tuple(item.entry for item in loaded.answers),
        tasks=tasks,
        predictions=predictions,
        scores=scores,
        with_calibration=with_calibration,
        views=views,
        judged={key: frame for key, frame in rejection.judged.items() if len(frame)},
        falsifiers=falsifiers,
        truths=truths,
        measured={name: truth.measured for name, truth in truths.items()} | _measured_of_flights(loaded.tasks),
        failures=failures,
    )


def _scored_entries(request: ScoreRequest, failures: Failures) -> ScoredEntries:
    """Load the entries that have not failed, and their tasks, and score every answer."""
    entries = leave_out(find_entries(request.predictions, request.submissions, failures=failures), request.without)
    names = {name for entry in entries for name in (entry.name, base_name(entry.name))}
    failures.found |= {name: why for name, why in request.failed.items() if name not in names}
    folders = [folder for folder in request.tasks if base_of(folder.name) not in request.without]
    answers = read_entry_answers(
        entries, folders, root=request.root, named=request.predictions, split=request.split, failures=failures
    )
    tasks = open_tasks(answers, folders, request.truth or request.root / "truth")
    seed_of([task.manifest for task in tasks])  # refuse a mixture of seeds before it is scored
    return score_entries(
        answers, tasks, split=request.split, by_region=request.by_region, by_block=request.by_block, failures=failures
    )


def _ranks(
    frames: Mapping[str, pd.DataFrame],
    more: Sequence[MeanMetric],
    excluded: Mapping[str, str],
    draws: int,
    failures: Failures,
) -> list[pd.DataFrame] | None:
    """Return the figures of all entries together; None if one of them fails, which is noted."""
    compare = partial(leaderboards, draws=draws, excluded=excluded, more=more)
    try:
        return compare(frames)
    except Exception as error:
        if is_disk_error(error) or not failures.blame(frames, compare):
            raise
    tell("scored again without those that failed")
    return None


def _rejection(
    request: ScoreRequest,
    rules: Mapping[str, Rule],
    entries: Sequence[Entry],
    scored: Mapping[str, pd.DataFrame],
    predictions: Mapping[str, StoredAnswers],
    failures: Failures,
) -> RejectionResult:
    """Evaluate rejectors on each entry, but for those of a stored board, whose results stand as they are."""
    stored = request.stored
    known = () if stored is None else {entry.name for entry in stored.about.entries}
    tasks = [
        RejectionTask(
            matcher=entry.name,
            scores=single_views(scored[entry.name]),
            predictions=predictions[entry.name],
            rules=rules,
            split=request.split,
            is_taught=entry.is_taught,
            kept=request.kept_fits if request.dask is None else None,  # its workers are elsewhere
        )
        for entry in entries
        if entry.name not in known
    ]
    mine = evaluate_rejectors(tasks, is_whole=stored is None, jobs=request.jobs, dask=request.dask, failures=failures)
    if stored is None:
        return mine
    # They depend on the answers of one entry alone. Ranks do not: a new entry changes them, and they are made anew.
    rows = stored.leaderboard.loc[stored.leaderboard["rejector"] != "", list(FIGURE_SCHEMA.names)]
    acceptance = [part for part in (stored.acceptance, mine.acceptance) if len(part)]
    return replace(
        mine,
        rows=[_by_name([rows, *mine.rows])],
        acceptance=_by_name(acceptance) if acceptance else mine.acceptance,
        remarks=(*stored.about.remarks, *mine.remarks),
    )


def _falsifiers_and_findings(
    request: ScoreRequest, scores: Mapping[str, pd.DataFrame], rejection: RejectionResult, failures: Failures
) -> tuple[tuple[Falsifier, ...], tuple[Finding, ...]]:
    """Return the falsifiers and the registered contrasts; those of a stored board stand as they are."""
    failed, draws = failures.found, request.draws
    complete = [item for item in request.contrasts if {item.first, item.second} <= scores.keys() or not failed]
    falsifiers = evaluate_falsifiers(complete, scores, draws=draws)
    if request.stored is not None:
        return falsifiers, request.stored.findings
    findings = evaluate_contrasts(request.contrasts, scores, rejection.judged, draws=draws, failed=failed)
    return falsifiers, with_causes(findings, gains_without_stress(falsifiers))


def _costs(
    entries: Sequence[Entry],
    scores: Mapping[str, pd.DataFrame],
    flown: Mapping[str, pd.DataFrame],
    tasks: Sequence[Task],
    failures: Failures,
) -> list[pd.DataFrame]:
    """Return the costs of each entry, and report how many queries it answered, and the status of the others."""
    views = {name: size for task in tasks for name, size in task.view_bytes().items()}
    areas = {task.manifest.region: area for task in tasks if (area := _area_km2(task.region)) is not None}
    found = []
    for entry in entries:
        with failures.of(f"costs of {entry.name}"):
            costs = Costs(
                scores=_asked_rows(scores[entry.name], flown.get(entry.name)),
                runs=entry.runs,
                view_bytes=views,
                area_km2=areas,
            )
            found.append(cost_figures(entry.name, costs))
        tell(f"{entry.name}: {_answered_text(scores[entry.name])}")
    return found


def _asked_rows(scores: pd.DataFrame, views: pd.DataFrame | None) -> pd.DataFrame:
    """Return a row for each query that was asked; that of a view is answered if its fix is accepted."""
    if views is None:
        return scores
    flown = views.assign(is_answered=views["is_accepted"])
    parts = [frame[[*COST_COLUMNS]] for frame in (single_views(scores), flown)]
    return pd.concat([part for part in parts if len(part)], ignore_index=True)


def _area_km2(region: Path) -> float | None:
    """Return the mapped area of a region; None if its map is missing, since scores need no map."""
    try:
        manifest = read_manifest(region)
    except StoreError:
        return None
    west, south, east, north = manifest.bounds_m
    return manifest.coverage.share * (east - west) * (north - south) / _M2_PER_KM2


def _answered_text(scores: pd.DataFrame) -> str:
    """Say how many queries were answered, why the others were not, and how many flights have an accepted fix or failed.

    >>> rows = {"is_answered": [True, False, True], "status": ["ok", "ok", "ok"]}
    >>> _answered_text(pd.DataFrame({**rows, "track": ["localization", "localization", "sequence"]}))
    '1 of 2 queries answered, 1 withheld; 1 of 1 flight with an accepted fix'
    >>> _answered_text(pd.DataFrame({"is_answered": [True], "status": ["timeout"], "track": ["sequence"]}))
    '1 of 1 flight with an accepted fix, 1 not answered to the end (1 timeout)'
    """
    views, parts = single_views(scores), []
    if len(views):
        answered = views["is_answered"].to_numpy(bool)
        rest = views.loc[~answered, "status"].replace("ok", "withheld").value_counts()
        others = "".join(f", {count} {status}" for status, count in sorted(rest.items()))
        parts.append(f"{int(answered.sum())} of {counted(len(views), 'query', 'queries')} answered{others}")
    flights = scores[(scores["track"] == SEQUENCE).to_numpy(bool)]
    if len(flights):
        accepted = int(flights["is_answered"].sum())
        failed = flights.loc[flights["status"] != "ok", "status"].value_counts()
        causes = ", ".join(f"{count} {status}" for status, count in sorted(failed.items()))
        rest = f", {failed.sum()} not answered to the end ({causes})" if causes else ""
        parts.append(f"{accepted} of {counted(len(flights), 'flight')} with an accepted fix{rest}")
    return "; ".join(parts)


def _by_name(parts: Sequence[pd.DataFrame]) -> pd.DataFrame:
    whole = pd.concat([part for part in parts if len(part)] or parts[:1], ignore_index=True)
    return whole.iloc[np.argsort(whole["matcher"].to_numpy(str), kind="stable")].reset_index(drop=True)


def _protection(
    scored: Mapping[str, pd.DataFrame],
    names: Iterable[str],
    predictions: Mapping[str, StoredAnswers],
    split: Split | None,
    failures: Failures,
) -> pd.DataFrame:
    """Return how the protection levels of each entry held."""
    levels = []
    for name in names:
        with failures.of(f"protection levels of {name}"):
            levels.append(protection_frame(name, single_views(scored[name]), predictions[name].lean(), split))
    some = [frame for frame in levels if len(frame)]
    return pd.concat(some, ignore_index=True) if some else PROTECTION_SCHEMA.empty()


def _measured_of_flights(tasks: Sequence[Task]) -> dict[str, Mapping[str, float]]:
    """Return what was measured at the first view of each flight by the flight's id."""
    flown = [task for task in tasks if task.manifest.is_of_flights]
    firsts = {head.query_id: head.sequence_id for task in flown for head in task.heads() if head.frame == 0}
    truths = (truth for task in flown for truth in task.truths)
    return {str(firsts[truth.query_id]): truth.measured for truth in truths if truth.query_id in firsts}


def _views_of(views: Mapping[str, pd.DataFrame], scores: Mapping[str, pd.DataFrame]) -> dict[str, pd.DataFrame]:
    """Return the views of the flights that are among scored rows."""
    return {
        name: frame[frame["sequence_id"].isin(scores[name]["query_id"])].reset_index(drop=True)
        for name, frame in views.items()
        if name in scores
    }


# --- the manifest ----------------------------------------------------------------------------------------------------


def _manifest_of(
    request: ScoreRequest,
    tasks: Sequence[TaskManifest],
    entries: Sequence[BoardEntry],
    *,
    private: SeedRecord | None,
    plugins: tuple[Sequence[RejectorCard], list[MetricRecord]],
    remarks: Sequence[str],
    failed: Mapping[str, str],
) -> BoardManifest:
    """Return the manifest of a board; `private` is the seed that its rows were held against, `remarks` are on fits."""
    cards, metrics = plugins
    return BoardManifest(
        scorer_version=SCORER_VERSION,
        task_version=max((item.task_version for item in tasks), default=TASK_VERSION),
        data_version=request.kept.data_version or DATA_VERSION,
        made_by=f"sasgeo-bench {version('sasgeo-bench')}",
        libraries=dict(_libraries()),
        pipeline=request.pipeline,
        title=request.title or request.kept.title,
        private_seed=seed_of(tasks),
        private=private,
        sealed=dict(request.sealed or request.kept.sealed),
        split=None if request.split is None else request.split.spec.id,
        draws=request.draws,
        contrasts=list(request.contrasts),
        by_region=sorted(request.by_region),
        by_block=sorted(request.by_block),
        without=sorted(set(request.without)),
        rejectors=[
            RejectorRecord(**{name: getattr(card, name) for name in RejectorRecord.model_fields}) for card in cards
        ],
        metrics=metrics,
        within=list(request.within),
        require=list(request.require),
        added=sorted(request.added),
        remarks=list(remarks),
        elsewhere=list(request.elsewhere),
        failed=dict(failed),
        entries=list(entries),
        tasks=[BoardTask(**{name: getattr(item, name) for name in _OF_TASKS}) for item in tasks],
    )


def _metric_of(found: ForeignMetric) -> MetricRecord:
    """Return what a board says of a metric of another package."""
    metric = found.metric
    least, greatest = (float(end) if math.isfinite(end) else None for end in metric.bounds)
    words = {name: getattr(metric, name) for name in ("name", "meaning", "source", "unit", "better")}
    tracks = list(metric.tracks)
    return MetricRecord(**words, code=found.code, sha256=found.sha256, least=least, greatest=greatest, tracks=tracks)


def _entry_record(
    entry: Entry, set_apart: str | None, on_private: OnPrivate, controls: Sequence[Verdict]
) -> BoardEntry:
    """Return what a board says of an entry: why it is set apart, if it is, and how it fared on a private seed."""
    return BoardEntry(
        name=entry.name,
        version=entry.version,
        hash=entry.hash,
        how=on_private.how(entry),
        card=entry.card,
        trained_on=entry.declared,
        set_apart=set_apart,
        isolation=joined(run.isolation or {} for run in entry.runs) if entry.runs else None,
        learned=entry.learned(),
        private=on_private.rows.get(entry.name),
        failed_controls=[item.to_text() for item in failed_controls(controls, entry.name)],
    )


@cache
def _libraries() -> Mapping[str, str]:
    """Return the versions of Python and of installed libraries that affect results, looked up once."""
    found = {"python": platform.python_version()}
    for name in _LIBRARIES:
        with suppress(PackageNotFoundError):
            found[name] = version(name)
    return found
