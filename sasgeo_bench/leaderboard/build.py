# SPDX-License-Identifier: Apache-2.0
"""Runs, files of predictions and truths -> a board: the order of the steps."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Final

import pandas as pd

from sasgeo_bench.errors import StoreError, counted
from sasgeo_bench.files.folders import SITE
from sasgeo_bench.leaderboard.board import Board, ScoreRequest, make_extras, record_of, write_files
from sasgeo_bench.leaderboard.board_files import check_board, read_board_manifest
from sasgeo_bench.leaderboard.private_board import OnPrivate, hold_private, kept_private, seed_of
from sasgeo_bench.progress import tell
from sasgeo_bench.regions.region import DATA_VERSION
from sasgeo_bench.regions.region_files import read_manifest
from sasgeo_bench.running.failures import Failures, log_beside, stops_all
from sasgeo_bench.scoring.contestants import (
    Contest,
    read_entry_answers,
    read_tasks,
    rows_to_rank,
    score_entries,
    scored_rows,
)
from sasgeo_bench.scoring.contrasts import hold_contrasts
from sasgeo_bench.scoring.controls import gains_without_stress, hold_controls, hold_falsifiers
from sasgeo_bench.scoring.cost import COLUMNS as COST_COLUMNS
from sasgeo_bench.scoring.cost import Costs
from sasgeo_bench.scoring.entries import find_entries, leave_out, set_apart
from sasgeo_bench.scoring.protection import PROTECTION_SCHEMA, protection_frame
from sasgeo_bench.scoring.rejection import RejectionResult, RejectionTask, evaluate_rejectors, rules_of
from sasgeo_bench.scoring.rows import EntryLabel, name_alone, with_entry_labels
from sasgeo_bench.scoring.score import SCORER_VERSION, single_views
from sasgeo_bench.scoring.tables import cost_figures, leaderboards
from sasgeo_bench.scoring.verdicts import with_causes
from sasgeo_bench.tasks.query import SEQUENCE, base_of
from sasgeo_bench.tasks.task_files import Task

_M2_PER_KM2: Final = 1e6


def make_board(request: ScoreRequest) -> Board:
    """Score everything, and write and return the board.

    Raise StoreError if predictions, tasks or truths are missing, damaged, or of other versions, or a run that is named
    by itself answers none of the queries; nothing is written. Raise ConfigError if there is nothing to score, or
    rejectors are named without a split.
    """
    check_board(request.board, scorer_version=SCORER_VERSION)
    rules = rules_of(request.rejectors, request.split)
    failures = Failures(log_beside(request.board), is_told=False)  # reported with the board, or raised
    ranks = None
    while ranks is None:  # once more for each time that the comparison of entries fails because of some of them
        contest = _contest(request, failures)
        board = _unranked(request, contest, failures)
        ranks = _ranks(board, request.draws)
    costs = _costs(board, contest.tasks)
    known = set() if request.stored is None else {entry.name for entry in request.stored.about.entries}
    judgings = [
        RejectionTask(
            matcher=entry.name,
            scores=single_views(board.with_calibration[entry.name]),
            predictions=board.predictions[entry.name],
            rules=rules,
            split=request.split,
            is_taught=entry.is_taught,
        )
        for entry in board.entries
        if entry.name not in known
    ]
    is_whole = request.stored is None
    rejection = evaluate_rejectors(
        judgings,
        is_whole=is_whole,
        jobs=request.jobs,
        dask=request.dask,
        failures=failures,
    )
    rejection = rejection if request.stored is None else request.stored.joined(rejection)
    figures = pd.concat([part for part in (*ranks, *costs, *rejection.rows) if len(part)], ignore_index=True)
    labels = {one.name: EntryLabel(one.version, one.hash, one.how, board.apart.get(one.name)) for one in board.entries}
    board = _validated(request, replace(board, table=with_entry_labels(figures, labels)), rejection)
    gone = sorted(_names_before(request.board) - {entry.name for entry in board.everyone})
    if gone:
        names = ", ".join(gone)
        tell(f"{request.board} had rows of {names}, which this board has not; their answers are where they were")
    if (request.board / SITE).is_dir():
        tell(f"{request.board / SITE} is of the older board and is removed with it: publish again")
    extras = make_extras(request, board)
    board = replace(board, about=record_of(request, board, [rule.card for rule in rules.values()]))
    write_files(request, board, extras)
    return board


def _asked_rows(scores: pd.DataFrame, views: pd.DataFrame | None) -> pd.DataFrame:
    """Return a row for each query that was asked; that of a view is answered if its fix is accepted."""
    if views is None:
        return scores
    flown = views.assign(is_answered=views["is_accepted"])
    parts = [frame[[*COST_COLUMNS]] for frame in (single_views(scores), flown)]
    return pd.concat([part for part in parts if len(part)], ignore_index=True)


def _contest(request: ScoreRequest, failures: Failures) -> Contest:
    """Read the answers of all entries that have not failed, and score them."""
    entries = find_entries(request.predictions, request.submissions, failures=failures)
    entries = leave_out(entries, request.without)
    names = {name for entry in entries for name in (entry.name, name_alone(entry.name))}
    failures.found |= {name: why for name, why in request.failed.items() if name not in names}
    folders = [folder for folder in request.tasks if base_of(folder.name) not in request.without]
    answers = read_entry_answers(entries, folders, root=request.root, named=request.predictions, failures=failures)
    tasks = read_tasks(answers, folders, request.truth or request.root / "truth")
    seed_of([task.manifest for task in tasks])  # refuse a mixture of seeds before it is scored
    return score_entries(
        answers, tasks, split=request.split, by_region=request.by_region, by_block=request.by_block, failures=failures
    )


def _unranked(request: ScoreRequest, contest: Contest, failures: Failures) -> Board:
    """Return the board with the entries to rank, which of them are set apart, and how they fared on a private seed."""
    verdicts = hold_controls(contest.scores)
    scored = scored_rows(contest, request.split)
    scores = rows_to_rank(scored, request.split)
    entries = tuple(item.entry for item in contest.answers if item.entry.name in scores)
    apart = set_apart(entries, scores, request.split, verdicts)
    for name, why in apart.items():
        tell(f"{name}: set apart, {why}")
    tasks = tuple(task.manifest for task in contest.tasks)
    if request.private is not None:
        on_private = hold_private(
            request.private,
            entries=entries,
            scores=scores,
            tasks=tasks,
            pipeline=request.pipeline,
            draws=request.draws,
        )
        for name, row in on_private.rows.items():
            tell(f"{name}: {row.verdict} ({row.why})")
    else:
        on_private = OnPrivate() if request.without else kept_private(request.kept, entries, request.root)
    truths = {truth.query_id: truth for task in contest.tasks for truth in task.truths}
    return Board(
        entries=tuple(replace(entry, how=on_private.how(entry)) for entry in entries),
        scores=scores,
        with_calibration=scored,
        predictions={item.entry.name: item.predictions for item in contest.answers},
        table=pd.DataFrame(),
        verdicts=verdicts,
        tasks=tasks,
        measured={name: truth.measured for name, truth in truths.items()} | _of_flights(contest.tasks),
        truths=truths,
        views=_of_rows(contest.views, scores),
        everyone=tuple(item.entry for item in contest.answers),
        apart=apart,
        on_private=on_private,
        failures=failures,
        data_version=(None if request.kept is None else request.kept.data_version) or DATA_VERSION,
    )


def _of_flights(tasks: Sequence[Task]) -> dict[str, Mapping[str, float]]:
    """Return what was measured at the first view of each flight by the flight's id."""
    flown = [task for task in tasks if task.manifest.is_of_flights]
    firsts = {head.query_id: head.sequence_id for task in flown for head in task.heads() if head.frame == 0}
    truths = (truth for task in flown for truth in task.truths)
    return {str(firsts[truth.query_id]): truth.measured for truth in truths if truth.query_id in firsts}


def _of_rows(views: Mapping[str, pd.DataFrame], scores: Mapping[str, pd.DataFrame]) -> dict[str, pd.DataFrame]:
    """Return the views of the flights that are among scored rows."""
    return {
        name: frame[frame["sequence_id"].isin(scores[name]["query_id"])].reset_index(drop=True)
        for name, frame in views.items()
        if name in scores
    }


def _ranks(board: Board, draws: int) -> list[pd.DataFrame] | None:
    """Return the figures of all entries together; None if one of them fails, which is noted."""
    compare = partial(leaderboards, draws=draws, excluded=board.apart)
    try:
        return compare(board.scores)
    except Exception as error:
        if stops_all(error) or not board.failures.blame(board.scores, compare):
            raise
    tell("scored again without those that failed")
    return None


def _costs(board: Board, tasks: Sequence[Task]) -> list[pd.DataFrame]:
    """Return the costs of each entry, and report how many queries it answered, and the status of the others."""
    views = {name: size for task in tasks for name, size in task.view_bytes().items()}
    areas = {task.manifest.region: area for task in tasks if (area := _area_km2(task.region)) is not None}
    found = []
    for entry in board.entries:
        scores = board.scores[entry.name]
        with board.failures.of(f"costs of {entry.name}"):
            costs = Costs(
                scores=_asked_rows(scores, board.views.get(entry.name)),
                runs=entry.runs,
                view_bytes=views,
                area_km2=areas,
            )
            found.append(cost_figures(entry.name, costs))
        tell(f"{entry.name}: {_answered_text(scores)}")
    return found


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


def _validated(request: ScoreRequest, board: Board, rejection: RejectionResult) -> Board:
    """Return the board with results of rejectors, contrasts, falsifiers and protection levels."""
    failed, scores, draws = board.failures.found, board.scores, request.draws
    held = [item for item in request.contrasts if {item.first, item.second} <= scores.keys() or not failed]
    falsifiers = hold_falsifiers(held, scores, draws=draws)
    if request.stored is None:
        findings = hold_contrasts(request.contrasts, scores, rejection.judged, draws=draws, failed=failed)
        findings = with_causes(findings, gains_without_stress(falsifiers))
    else:
        findings = request.stored.findings()
    levels = []
    for name in scores:
        with board.failures.of(f"protection levels of {name}"):
            rows = single_views(board.with_calibration[name])
            levels.append(protection_frame(name, rows, board.predictions[name].lean(), request.split))
    some = [frame for frame in levels if len(frame)]
    return replace(
        board,
        judged={key: frame for key, frame in rejection.judged.items() if len(frame)},
        remarks=rejection.remarks,
        acceptance=rejection.acceptance,
        findings=findings,
        falsifiers=falsifiers,
        protection=pd.concat(some, ignore_index=True) if some else PROTECTION_SCHEMA.empty(),
    )


def _names_before(folder: Path) -> set[str]:
    """Return the entries of an older board, whose authors may look for their rows; none if it cannot be read."""
    try:
        return {entry.name for entry in read_board_manifest(folder).entries}
    except StoreError:
        return set()
