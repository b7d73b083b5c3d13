# SPDX-License-Identifier: Apache-2.0
"""Runs, files of predictions and truths -> a board: the order of the steps."""

import platform
from collections.abc import Callable, Collection, Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict, replace
from functools import partial
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any, Final

import pandas as pd

from sasgeo_bench.errors import ConfigError, StoreError
from sasgeo_bench.leaderboard.board import Board, ScoreRequest
from sasgeo_bench.leaderboard.board_files import PROTECTION, Extra, check_board, read_board, write_board
from sasgeo_bench.leaderboard.plot_tables import age_names, ages_frame
from sasgeo_bench.leaderboard.private_board import OnPrivate, hold_private, kept_private, seed_of
from sasgeo_bench.leaderboard.text import board_latex, board_markdown
from sasgeo_bench.matching.matcher import RejectorCard
from sasgeo_bench.matching.results import Prediction
from sasgeo_bench.progress import Lines, Progress, Tell
from sasgeo_bench.regions.region import DATA_VERSION
from sasgeo_bench.running.failures import Failures, log_beside, stops_all
from sasgeo_bench.running.sandbox import joined
from sasgeo_bench.scoring.contestants import (
    EntryAnswers,
    ScoredTask,
    read_entry_answers,
    read_scored_task,
    score_entries,
)
from sasgeo_bench.scoring.contrasts import contrast_frame, hold_contrasts
from sasgeo_bench.scoring.controls import (
    failed_controls,
    falsifier_frame,
    hold_controls,
    hold_falsifiers,
    is_control,
    verdict_frame,
)
from sasgeo_bench.scoring.cost import Costs
from sasgeo_bench.scoring.entries import Entry, find_entries, leave_out, set_apart
from sasgeo_bench.scoring.protection import COLUMNS as PROTECTION_COLUMNS
from sasgeo_bench.scoring.protection import protection_frame
from sasgeo_bench.scoring.rejection import OWN, RejectionTask, Rule, apply_rejectors, remarks_of, rules_of
from sasgeo_bench.scoring.rows import EntryLabel, name_alone, to_frame, with_entry_labels
from sasgeo_bench.scoring.score import SCORER_VERSION
from sasgeo_bench.scoring.strata import GROUP, queries_of, steps_frame
from sasgeo_bench.scoring.tables import cost_rows, leaderboard
from sasgeo_bench.tasks import task_files
from sasgeo_bench.tasks.query import CONTROLS, TASK_VERSION, base_of
from sasgeo_bench.tasks.split import Split

_LIBRARIES: Final = ("numpy", "scipy", "pandas", "pyarrow", "statsmodels", "scikit-learn")
INTERVALS: Final = "intervals of suites"  # what progress is shown of
JUDGED: Final = "rejectors"
_CARD: Final = ("name", "version", "title", "source", "licence", "is_calibrated")  # of a rejector, in board.json


def make_board(request: ScoreRequest, *, tell: Tell, progress: Progress | None = None) -> Board:
    """Score everything, and write and return the board.

    Report lines by `tell`, and the state of intervals and rejectors by `progress`, by default in lines. Raise
    StoreError if predictions, tasks or truths are missing, damaged, or of other versions, or a run that is named by
    itself answers none of the queries; nothing is written. Raise ConfigError if there is nothing to score, or rejectors
    are named without a split.
    """
    progress = progress or Lines(tell)
    check_board(request.board, scorer_version=SCORER_VERSION)
    failures = Failures(log_beside(request.board), tell=lambda _: None)  # told when the board is there, or raised
    while (board := _made(request, failures, tell, progress)) is None:
        tell("scored again without those that failed")
    return board


def _made(request: ScoreRequest, failures: Failures, tell: Tell, progress: Progress) -> Board | None:
    """Return the board of all entries that have not failed; None if one fails only now, after it was counted."""
    rules = rules_of(request.rejectors, request.split)
    entries = leave_out(find_entries(request.predictions, request.submissions, failures=failures), request.without)
    names = {name for entry in entries for name in (entry.name, name_alone(entry.name))}
    failures.found |= {name: why for name, why in request.failed.items() if name not in names}
    wanted = [folder for folder in request.tasks if base_of(folder.name) not in request.without]
    told = read_entry_answers(
        entries, wanted, root=request.root, named=request.predictions, tell=tell, failures=failures
    )
    folders = list(dict.fromkeys(wanted)) or sorted({folder for item in told for folder in item.held})
    tasks = [read_scored_task(folder, request.truth or request.root / "truth") for folder in folders]
    seed_of([task.about for task in tasks])
    everything = score_entries(told, tasks, split=request.split, by_region=request.by_region, failures=failures)
    told = [item for item in told if item.entry.name in everything]
    predictions = {item.entry.name: item.predictions for item in told}
    verdicts = hold_controls(everything)
    whole = _asked_whole(told, tasks, tell)
    scores = {name: _ranked(frame, whole[name]) for name, frame in everything.items()}
    scores = {name: frame for name, frame in scores.items() if len(frame)}
    entries = tuple(item.entry for item in told if item.entry.name in scores)
    _check_some(scores)
    apart = set_apart(entries, scores, request.split, verdicts)
    for name, why in apart.items():
        tell(f"{name}: set apart, {why}")
    on_private = _on_private(request, entries, scores, tasks, tell)
    entries = tuple(replace(entry, how=on_private.how(entry)) for entry in entries)
    compare = partial(_leaderboards, whole=whole, draws=request.draws, apart=apart, progress=progress)
    rows = _compared(scores, compare, failures)
    if rows is None:
        return None
    rows += _costs(entries, scores, tasks, failures, tell)
    all_judged, more = _all_judged(
        _judgings(entries, scores, predictions, rules, request.split), request, failures, tell, progress
    )
    rows += more
    _check_rejectors(rules, entries, failures)
    remarks = _remarks(all_judged, tell)
    figures = pd.concat([item for item in rows if len(item)], ignore_index=True)
    table = with_entry_labels(figures, _contestants(entries, apart))
    findings = hold_contrasts(request.contrasts, scores, all_judged, draws=request.draws, failed=failures.found)
    held = [item for item in request.contrasts if {item.first, item.second} <= scores.keys() or not failures.found]
    board = Board(
        entries=entries,
        scores=scores,
        predictions=predictions,
        table=table,
        findings=findings,
        falsifiers=hold_falsifiers(held, scores, draws=request.draws),
        verdicts=verdicts,
        tasks=tuple(task.about for task in tasks),
        remarks=remarks,
        protection=_protection(scores, predictions, request.split, failures),
        judged={key: frame for key, frame in all_judged.items() if len(frame)},
        measured={truth.query_id: truth.measured for task in tasks for truth in task.truths},
        truths={truth.query_id: truth for task in tasks for truth in task.truths},
        everyone=tuple(item.entry for item in told),
        apart=apart,
        on_private=on_private,
        failures=failures,
    )
    _tell_gone(request.board, board.everyone, tell)
    _write(request, board, _extras(request, board, tell), [rule.card for rule in rules.values()])
    return board


Compare = Callable[[Mapping[str, pd.DataFrame]], list[pd.DataFrame]]


def _compared(scores: Mapping[str, pd.DataFrame], compare: Compare, failures: Failures) -> list[pd.DataFrame] | None:
    """Return the figures of all entries together; None if one of them fails, which is noted."""
    try:
        return compare(scores)
    except Exception as error:
        if stops_all(error) or not failures.blame(scores, compare):
            raise
        return None


def _costs(
    entries: Sequence[Entry],
    scores: Mapping[str, pd.DataFrame],
    tasks: Sequence[ScoredTask],
    failures: Failures,
    tell: Tell,
) -> list[pd.DataFrame]:
    """Return the costs of each entry, and report how many answers it gave."""
    views = {name: size for task in tasks for name, size in task.view_bytes.items()}
    areas = {task.about["region"]: task.area_km2 for task in tasks if task.area_km2 is not None}
    rows = []
    for entry in entries:
        frame = scores[entry.name]
        with failures.of(f"costs of {entry.name}"):
            costs = Costs(scores=frame, runs=entry.runs, view_bytes=views, area_km2=areas)
            rows.append(to_frame(list(cost_rows(entry.name, costs))))
        tell(f"{entry.name}: {_in_words(frame)}")
    return rows


Judgement = dict[tuple[str, str], pd.DataFrame]


def _all_judged(
    judgings: Sequence[RejectionTask], request: ScoreRequest, failures: Failures, tell: Tell, progress: Progress
) -> tuple[Judgement, list[pd.DataFrame]]:
    """Return the results of rejectors by matcher and rejector, and their rows of the board."""
    said: Judgement = {}
    rows: list[pd.DataFrame] = []
    progress.begin(JUDGED, len(judgings))
    for judged in apply_rejectors(judgings, jobs=request.jobs):
        rows += judged.rows
        progress.advance(JUDGED, 1)
        said |= {(judged.matcher, name): frame for name, frame in judged.by_rejector.items()}
        for line in judged.skipped:
            tell(line)
        for name, fault in judged.failed.items():
            failures.note(f"{judged.matcher} x {name}", fault)
    return said, rows


def _extras(request: ScoreRequest, board: Board, tell: Tell) -> list[Extra]:
    """Return the additional files; leave out what cannot be made, and figures that cannot be drawn."""
    if request.extras:
        tell("drawing figures and pictures")
    found: list[Extra] = []
    for make in request.extras:
        with board.failures.of("more of the board"):
            extra = make(board)
            guarded = {name: partial(_draw, draw, name, board.failures) for name, draw in extra.figures.items()}
            found.append(replace(extra, figures=guarded))
    return found


def _draw(draw: Callable[[Path], object], name: str, failures: Failures, path: Path) -> None:
    """Draw a figure; of one that fails nothing is left."""
    with failures.of(f"figure {name}"):
        draw(path)
        return
    path.unlink(missing_ok=True)


def _check_rejectors(rules: Mapping[str, Rule], entries: Sequence[Entry], failures: Failures) -> None:
    """Raise the error of a rejector that fails with every entry: it is at fault, not their answers."""
    for name in rules:
        errors = [failures.errors.get(f"{entry.name} x {name}") for entry in entries]
        if errors and errors[0] is not None and None not in errors:
            raise errors[0]


def _tell_gone(folder: Path, everyone: Sequence[Entry], tell: Tell) -> None:
    """Report rows of an older board of that name that are missing now: their authors may look for them."""
    try:
        about, _ = read_board(folder)
        had = [str(entry["name"]) for entry in about["entries"]]
    except (StoreError, KeyError, TypeError):  # none, or nothing that can be read
        return
    gone = sorted(set(had) - {entry.name for entry in everyone})
    if gone:
        tell(f"{folder} had rows of {', '.join(gone)}, which this board has not; their answers are where they were")


def _judgings(
    entries: Sequence[Entry],
    scores: Mapping[str, pd.DataFrame],
    predictions: Mapping[str, Mapping[str, Prediction]],
    rules: Mapping[str, Rule],
    split: Split | None,
) -> list[RejectionTask]:
    """Return the answers of each entry that rejectors estimate."""
    return [
        RejectionTask(
            matcher=entry.name,
            scores=scores[entry.name],
            predictions=predictions[entry.name],
            rules=rules,
            split=split,
            is_taught=entry.is_taught,
        )
        for entry in entries
    ]


def _on_private(
    request: ScoreRequest,
    entries: Sequence[Entry],
    scores: Mapping[str, pd.DataFrame],
    tasks: Sequence[ScoredTask],
    tell: Tell,
) -> OnPrivate:
    """Return the rows of the private board that is named, or those that stored results keep."""
    if request.private is None:
        return OnPrivate() if request.without else kept_private(request.kept, entries, request.root)
    found = hold_private(
        request.private,
        entries=entries,
        scores=scores,
        tasks=[task.about for task in tasks],
        pipeline=request.pipeline,
        draws=request.draws,
        tell=tell,
    )
    for name, row in found.rows.items():
        tell(f"{name}: {row['verdict']} ({row['why']})")
    return found


def _contestants(entries: Sequence[Entry], apart: Mapping[str, str]) -> dict[str, EntryLabel]:
    return {entry.name: EntryLabel(entry.version, entry.hash, entry.how, apart.get(entry.name)) for entry in entries}


def _check_some(scores: Mapping[str, pd.DataFrame]) -> None:
    if not scores:
        message = (
            f"there is nothing to rank: but for the suite {CONTROLS!r} no suite has a matcher that was asked all of "
            "its tasks (--tasks names some)"
        )
        raise ConfigError(message)


def _remarks(all_judged: Mapping[tuple[str, str], pd.DataFrame], tell: Tell) -> tuple[str, ...]:
    """Return and report remarks of rejectors on their fits."""
    judged = ((key, frame) for key, frame in all_judged.items() if key[1] != OWN)
    said = tuple(f"{name} on {matcher}: {item}" for (matcher, name), frame in judged for item in remarks_of(frame))
    for remark in said:
        tell(remark)
    return said


def _protection(
    scores: Mapping[str, pd.DataFrame],
    predictions: Mapping[str, Mapping[str, Prediction]],
    split: Split | None,
    failures: Failures,
) -> pd.DataFrame:
    """Return the protection levels of all entries; empty if none has any."""
    frames = []
    for name, frame in scores.items():
        with failures.of(f"protection levels of {name}"):
            frames.append(protection_frame(name, frame, predictions[name], split))
    told = [frame for frame in frames if len(frame)]
    return pd.concat(told, ignore_index=True) if told else pd.DataFrame(columns=list(PROTECTION_COLUMNS))


def _in_words(scores: pd.DataFrame) -> str:
    """Return how many queries of an entry have a fix, and the status of the others."""
    answered = scores["is_answered"].to_numpy(bool)
    rest = scores.loc[~answered, "status"].replace("ok", "withheld").value_counts()
    others = "".join(f", {count} {status}" for status, count in sorted(rest.items()))
    return f"{int(answered.sum())} of {len(scores)} queries answered{others}"


def _ranked(scores: pd.DataFrame, suites: Collection[str]) -> pd.DataFrame:
    """Return the scored rows of some suites, without controls."""
    return scores[scores["suite"].isin(list(suites)) & ~is_control(scores)].reset_index(drop=True)


def _asked_whole(told: Sequence[EntryAnswers], tasks: Sequence[ScoredTask], tell: Tell) -> dict[str, frozenset[str]]:
    """Return for each entry the suites of which it was asked every task."""
    suites = {task.about["suite"] for task in tasks}
    found = {}
    for item in told:
        spared = {task.about["suite"] for task in tasks if task.folder not in item.asked}
        found[item.entry.name] = frozenset(suites - spared)
        lost = sorted({task.about["suite"] for task in tasks if task.folder in item.asked} & spared - {CONTROLS})
        if lost:
            tell(f"{item.entry.name}: not on the board of {', '.join(lost)}, for it was not asked all tasks there")
    return found


def _leaderboards(
    scores: Mapping[str, pd.DataFrame],
    *,
    whole: Mapping[str, Collection[str]],
    draws: int,
    apart: Collection[str],
    progress: Progress,
) -> list[pd.DataFrame]:
    """Return the figures of suites for the entries that were asked all of them: in most cases one table."""
    asked_by: dict[tuple[str, ...], set[str]] = {}
    progress.begin(
        INTERVALS, len({key for frame in scores.values() for key in frame[[*GROUP]].itertuples(index=False)})
    )
    for suite in sorted({suite for frame in scores.values() for suite in frame["suite"]}):
        asked_by.setdefault(tuple(name for name in scores if suite in whole[name]), set()).add(suite)
    return [
        leaderboard(
            {name: _ranked(scores[name], suites) for name in names},
            draws=draws,
            excluded=apart,
            done=lambda: progress.advance(INTERVALS, 1),
        )
        for names, suites in asked_by.items()
    ]


def _about(request: ScoreRequest, board: Board, cards: Sequence[RejectorCard]) -> dict[str, Any]:
    """Return the content of `board.json`."""
    seed = seed_of(board.tasks)
    return {
        "scorer_version": SCORER_VERSION,
        "task_version": max((item["task_version"] for item in board.tasks), default=TASK_VERSION),
        "data_version": request.kept.get("data_version") or DATA_VERSION,  # of the maps that were asked about
        "made_by": f"sasgeo-bench {version('sasgeo-bench')}",
        "libraries": _libraries(),
        "pipeline": dict(request.pipeline) or None,
        **{name: said for name, said in ((task_files.PRIVATE, seed), ("private", board.on_private.seed)) if said},
        "split": None if request.split is None else request.split.spec.id,
        "draws": request.draws,
        "contrasts": [asdict(item) for item in request.contrasts],
        "by_region": sorted(request.by_region),
        "without": sorted(set(request.without)),
        "rejectors": [{name: getattr(card, name) for name in _CARD} for card in cards],
        "remarks": list(board.remarks),
        "failed": board.failures.found,  # what fails while figures are drawn is added until the file is written
        "entries": [
            {
                "name": entry.name,
                "version": entry.version,
                "hash": entry.hash,
                "how": entry.how,
                "card": entry.card,
                "trained_on": entry.declared,
                "set_apart": board.apart.get(entry.name),
                "isolation": joined(run.get("isolation") or {} for run in entry.runs) if entry.runs else None,
                "learned": entry.learned(),
                **({"private": board.on_private.rows[entry.name]} if entry.name in board.on_private.rows else {}),
                **({"failed_controls": failed} if (failed := _failed_controls(board, entry)) else {}),
            }
            for entry in board.entries
        ],
        "tasks": [
            {
                "suite": item["suite"],
                "suite_version": item.get("suite_version"),
                "region": item["region"],
                "map_date": item.get("map_date"),
                "queries_sha256": item["files"][task_files.QUERIES]["sha256"],
                "map_fingerprint": item["map_fingerprint"],
            }
            for item in board.tasks
        ],
    }


def _failed_controls(board: Board, entry: Entry) -> list[str]:
    return [item.to_text() for item in failed_controls(board.verdicts, entry.name)]


def _write(request: ScoreRequest, board: Board, extras: Sequence[Extra], cards: Sequence[RejectorCard]) -> None:
    about = _about(request, board, cards)
    scores = pd.concat([frame.assign(matcher=name) for name, frame in board.scores.items()], ignore_index=True)
    queries = queries_of(board.scores)
    steps = steps_frame(board.table, queries, sorted(board.scores))
    write_board(
        request.board,
        tables={
            "leaderboard": board.table,
            "scores": scores,
            "contrasts": contrast_frame(board.findings),
            "falsifiers": falsifier_frame(board.falsifiers),
            "controls": verdict_frame(board.verdicts),
            **({PROTECTION: board.protection} if len(board.protection) else {}),
        },
        texts={
            "leaderboard.md": board_markdown(
                board.table,
                about,
                findings=board.findings,
                verdicts=board.verdicts,
                falsifiers=board.falsifiers,
                steps=steps,
                ages=age_names(ages_frame(steps, queries, board.measured)),
            ),
            "leaderboard.tex": board_latex(board.table, about, findings=board.findings, verdicts=board.verdicts),
        },
        about=about,
        extras=extras,
    )


def _libraries() -> dict[str, str]:
    """Return the versions of Python and of installed libraries that affect results."""
    found = {"python": platform.python_version()}
    for name in _LIBRARIES:
        with suppress(PackageNotFoundError):
            found[name] = version(name)
    return found
