# SPDX-License-Identifier: Apache-2.0
"""A planned pipeline -> queries, runs and a board; steps that are up to date are skipped."""

import datetime as dt
from collections.abc import Mapping, Sequence
from contextlib import nullcontext
from dataclasses import replace
from functools import partial
from pathlib import Path

import pandas as pd

from sasgeo_bench.boards.archive import fits_folder, pack_board
from sasgeo_bench.boards.archive_file import check_results
from sasgeo_bench.boards.board_files import read_board_manifest
from sasgeo_bench.boards.build import drawings, make_board
from sasgeo_bench.boards.scored import Scored, ScoreRequest
from sasgeo_bench.core.errors import ConfigError, StoreError
from sasgeo_bench.core.progress import reporting, silent, tell
from sasgeo_bench.experiments.pipeline_plan import (
    MOST_LINES,
    PipelinePlan,
    Run,
    board_folder,
    count_queries,
    is_train,
    plan_runs,
)
from sasgeo_bench.experiments.sealed import open_seal
from sasgeo_bench.running.failures import Failures, log_beside
from sasgeo_bench.running.runner import run
from sasgeo_bench.running.segment_tasks import SegmentTasks, segment_tasks
from sasgeo_bench.scoring.contrasts import Contrast, Pilot, check_contrasts
from sasgeo_bench.scoring.controls import REFERENCE
from sasgeo_bench.scoring.entries import design_rows, rows_to_rank
from sasgeo_bench.scoring.rejection import rules_of
from sasgeo_bench.sensing.reference_imagery import render_place
from sasgeo_bench.tasks.build import carry_out
from sasgeo_bench.tasks.query import BY, RECALIBRATED, base_of
from sasgeo_bench.tasks.suites.all_suites import is_pictured
from sasgeo_bench.tasks.task_files import Task
from sasgeo_bench.tasks.task_plan import Request


def run_pipeline(
    plan: PipelinePlan,
    *,
    results: Path | None = None,
    has_cases: bool = True,
    private: Path | None = None,
    opened: dt.date | None = None,
) -> Scored:
    """Draw what is missing, run queries without a row, score all of it, and write the board to out/boards/<id>/.

    `results` is a folder to store the board in, with the answers and truths it was made of, as <id>/. `has_cases` shows
    failed queries with their truths on the board. `private` is the board of a private seed of this pipeline, which the
    rows are compared with. `opened` is the day on which sealed places are opened, today unless given. Raise
    `ConfigError` if no region can carry any of the suites, or all that could be ranked is sealed; `StoreError` if the
    board cannot be stored in `results`, or `ConfigError` if two rejectors share a name, before anything is done; and as
    `pack_board` does after the board is written.
    """
    stored = None if results is None else results / plan.spec.id
    if stored is not None:
        check_results(stored, board_folder(plan))
    _tell_of_another(plan)
    rules_of(plan.spec.rejectors, plan.split)
    sealed = {} if plan.seal is None else open_seal(plan.seal, plan.requests, opened=opened, stored=stored)
    tasks, controls = draw_all(plan)
    asked = [task for task in tasks if not is_train(plan, base_of(task.name))]
    if not asked:
        raise ConfigError(f"pipeline {plan.spec.id!r}: no region carries any of its suites")
    contrasts = tuple(item.registered for item in plan.spec.contrast)
    _check_contrasts(plan, contrasts, asked)
    failures = Failures(log_beside(board_folder(plan)))
    folders, names = _run_all(plan, tasks, controls, failures)
    contrasts = tuple(named_on_board(item, names) for item in contrasts)
    request = ScoreRequest(
        predictions=folders,
        tasks=[*asked, *controls],
        root=plan.out,
        board=board_folder(plan),
        split=plan.split,
        rejectors=plan.spec.rejectors,
        metrics=plan.spec.metrics,
        within=plan.within,
        require=plan.require,
        contrasts=contrasts,
        draws=plan.spec.draws,
        pipeline=plan.spec.identity,
        title=plan.spec.title,
        added=[names[one] for one in plan.added if one in names],
        by_region=() if plan.spec.paper is None or len(plan.spec.paper.seeds) == 1 else tuple(plan.spec.paper.crops),
        by_block=() if plan.spec.paper is None else tuple(plan.spec.paper.crops),
        jobs=plan.jobs,
        private=private,
        sealed=sealed,
        failed=failures.found,
        kept_fits=fits_folder(),
    )
    more = () if plan.experiment is None else (partial(plan.experiment.extra, root=plan.out),)
    scored = make_board(request, (*drawings(request, has_cases=has_cases), *more))
    if stored is not None:
        tell(pack_board(scored, request, stored).to_text())
    return scored


def draw_all(plan: PipelinePlan) -> tuple[list[Path], list[Path]]:
    """Draw what is missing of a pipeline's queries and of its controls, and return the folders of both."""
    drawn = _draw(plan.requests, jobs=plan.jobs)
    _render(plan)
    tasks = _with_evidence(plan, drawn)
    if plan.spec.paper is not None and plan.experiment is not None:
        tasks += plan.experiment.draw(plan.spec.paper, out=plan.out, private=plan.private)
    return tasks, _draw(plan.controls, jobs=1)


def _tell_of_another(plan: PipelinePlan) -> None:
    """Say that a board is replaced which another file, or an earlier state of this one, has made."""
    folder = board_folder(plan)
    try:
        there = read_board_manifest(folder).pipeline
    except StoreError:  # there is none, or none that can be read
        return
    if there != plan.spec.identity:
        tell(
            f"{folder} holds the board of another file with the id {plan.spec.id!r}, or of this one as it was: it is "
            "replaced; give yours an id of its own to keep both"
        )


def _check_contrasts(plan: PipelinePlan, contrasts: Sequence[Contrast], tasks: Sequence[Path]) -> None:
    """Report what the registered contrasts could show on the drawn queries; refuse one that cannot be reached."""
    if not contrasts:
        return
    opened = [Task.open(folder, plan.out) for folder in tasks]
    for task in opened:
        task.check_truths()
    frames = [design_rows(task, plan.split) for task in opened]
    design = rows_to_rank({plan.spec.id: pd.concat(frames, ignore_index=True)}, plan.split)[plan.spec.id]
    pilots = {item.name: Pilot(**item.pilot.model_dump()) for item in plan.spec.contrast if item.pilot is not None}
    check_contrasts(contrasts, pilots, design)


def _run_all(
    plan: PipelinePlan,
    tasks: list[Path],
    controls: list[Path],
    failures: Failures,
) -> tuple[list[Path], dict[str, str]]:
    """Run every matcher, and return the folders of all runs, and by matcher of the file the name of its card.

    Raise the first failure if all fail.
    """
    runs: dict[str, list[Run]] = {}
    for spec in dict.fromkeys((*plan.matchers, REFERENCE)):  # all cards are read before the first query is asked
        with failures.of(spec, but=(ConfigError,)):
            runs[spec] = plan_runs(plan, spec, [*tasks, *controls] if spec in plan.matchers else controls)
    folders: list[Path] = []
    for spec, found in runs.items():
        with failures.of(spec, but=(ConfigError,)):
            folders += ask(spec, found)
    if not folders and failures.first is not None:
        raise failures.first
    return folders, {spec: found[0].plan.card.name for spec, found in runs.items()}


def named_on_board(contrast: Contrast, names: Mapping[str, str]) -> Contrast:
    """Return a contrast whose sides are named by the cards of their matchers, as a board names its rows.

    >>> side = {"name": "mine", "suites": ("clean",)}
    >>> found = named_on_board(Contrast(first="my:Own x margin", second="fft_vote", **side), {"my:Own": "own"})
    >>> found.first, found.second
    ('own x margin', 'fft_vote')
    """
    sides = (side.split(" x ", maxsplit=1) for side in (contrast.first, contrast.second))
    first, second = (" x ".join((names.get(matcher, matcher), *rejector)) for matcher, *rejector in sides)
    return replace(contrast, first=first, second=second)


def ask(spec: str, runs: Sequence[Run]) -> list[Path]:
    """Run one matcher on all queries without a row, and return the folders of its runs."""
    folders: list[Path] = []
    for one in runs:
        left, done = count_queries([one])
        label = f"{spec}, {one.name}" if one.name else spec
        tell(f"{label}: {left} queries to ask, {done} answered before")
        for line in () if one.plan.training_set is not None else one.lines():
            tell(f"{label}: {line}")
        with nullcontext() if left else reporting(silent):
            run(one.plan)
        folders += [part.folder for part in one.plan.parts]
    return folders


def _draw(requests: Sequence[Request], *, jobs: int) -> list[Path]:
    """Draw every request that a region carries, unless it is up to date, and return the task folders."""
    tasks: list[Path] = []
    lacking: list[str] = []
    for drawn in carry_out(requests, jobs=jobs):
        for line in drawn.lines:
            tell(line)
        tasks += drawn.folders
        lacking += [] if drawn.lack is None else [drawn.lack]
    for line in lacking[:MOST_LINES]:
        tell(f"left out: {line}")
    if len(lacking) > MOST_LINES:
        tell(f"left out: {len(lacking) - MOST_LINES} more")
    return tasks


def _render(plan: PipelinePlan) -> None:
    """Render the reference imagery of the file, unless it is up to date."""
    settings = plan.spec.reference_imagery
    if settings is None:
        return
    for request in plan.imaged:
        date = settings.date_of({item.date for item in request.region.extract})
        render_place(
            request.region,
            look=settings.look,
            date=date,
            out=plan.out,
            extract_folders=request.extract_folders,
        )


def _with_evidence(plan: PipelinePlan, tasks: Sequence[Path]) -> list[Path]:
    """Return tasks with those of pictures replaced by what each segmenter of the file made of them."""
    pictured = [task for task in tasks if BY not in task.parent.name and is_pictured(task.parent.name)]
    found = [task for task in tasks if task not in pictured]
    if plan.split is None:
        return found
    asked: dict[str, list[Path]] = {}
    for spec in plan.spec.task:
        for segmenter in spec.segmenters:
            asked.setdefault(segmenter, []).extend(
                task
                for task in pictured
                if task.parent.name in spec.suites and (not spec.regions or base_of(task.name) in spec.regions)
            )
    for segmenter, own in asked.items():
        wanted = SegmentTasks(
            spec=segmenter.removesuffix(RECALIBRATED),
            tasks=own,
            taught=pictured,
            split=plan.split,
            out=plan.out,
            is_recalibrated=segmenter.endswith(RECALIBRATED),
            jobs=plan.jobs,
        )
        found += segment_tasks(wanted)
    return found
