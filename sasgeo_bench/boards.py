# SPDX-License-Identifier: Apache-2.0
"""Runs, files of predictions and truths -> a board: the order of the steps."""

import platform
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass, field, replace
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any, Final

import pandas as pd

from sasgeo_bench.boardtasks import AskedTask, ScoredTask, held_tasks, read_scored_task
from sasgeo_bench.entries import AS_SUBMITTED, Entry, find_entries
from sasgeo_bench.errors import ConfigError, StoreError, counted
from sasgeo_bench.metrics.draws import DRAWS
from sasgeo_bench.query import CONTROLS, TASK_VERSION
from sasgeo_bench.region import DATA_VERSION
from sasgeo_bench.rejector import RejectorCard
from sasgeo_bench.report.contrasts import Contrast, Finding, contrast_frame, hold_contrasts
from sasgeo_bench.report.controls import Verdict, hold_controls, is_control, verdict_frame
from sasgeo_bench.report.costs import cost_rows
from sasgeo_bench.report.integrity import integrity_rows
from sasgeo_bench.report.latex import board_latex
from sasgeo_bench.report.protection import protection_frame
from sasgeo_bench.report.rejection import OWN, judge, own_word, remarks_of, rules_of, why_not
from sasgeo_bench.report.rows import to_frame, with_contestants
from sasgeo_bench.report.tables import leaderboard
from sasgeo_bench.report.text import board_markdown
from sasgeo_bench.results import Prediction
from sasgeo_bench.score import SCORER_VERSION, score_task, settle_not_applicable
from sasgeo_bench.split import Split
from sasgeo_bench.store import rundir, taskdir
from sasgeo_bench.store.boardfile import PROTECTION, Extra, check_board, write_board
from sasgeo_bench.store.learnedfile import LearnedSaid
from sasgeo_bench.validate import validate

Tell = Callable[[str], None]

MOST_NAMED: Final = 3  # runs that are left out; the others are counted
_LIBRARIES: Final = ("numpy", "scipy", "pandas", "pyarrow", "statsmodels", "scikit-learn")
_CARD: Final = ("name", "version", "title", "source", "licence", "is_calibrated")  # of a rejector, in board.json


@dataclass(frozen=True, kw_only=True)
class ScoreRequest:
    """What is to be put on a board.

    Parameters
    ----------
    predictions : sequence of Path
        Folders of runs (any folder with runs in it), and files of predictions.
    tasks : sequence of Path
        Task folders; without any, those that the runs and files answer. A matcher that was asked nothing of one of them
        has no figures on its suite.
    root : Path
        Where tasks/ and truth/ are.
    truth : Path, optional
        Folder of the truths, where it is another one.
    split : Split, optional
        Says which blocks are one place, and which calibrate; needed for rejectors.
    contrasts : sequence of Contrast
        Those that were registered.
    rejectors : sequence of str
        Names, or module:Class.
    board : Path
        Folder to write.
    draws : int
        Of the bootstrap.
    by_region : collection of str
        Suites whose regions are resampled, not their blocks: those of which each region is a draw of its own.
    pipeline : mapping of str to str
        Name and hash of the pipeline that asks for it; none for a board of `score`.
    extras : sequence of callable
        Each makes, of the finished board, files that are written with it.
    """

    predictions: Sequence[Path]
    root: Path
    board: Path
    tasks: Sequence[Path] = ()
    truth: Path | None = None
    split: Split | None = None
    contrasts: Sequence[Contrast] = ()
    rejectors: Sequence[str] = ()
    draws: int = DRAWS
    by_region: Collection[str] = ()
    pipeline: Mapping[str, str] = field(default_factory=dict)
    extras: Sequence[Callable[["Board"], Extra]] = ()


@dataclass(frozen=True, kw_only=True)
class Board:
    """A board in memory: scored rows by matcher, without those of the controls, and the leaderboard.

    `remarks` are what rejectors said of their fits; `protection` has no row where no answer tells a protection level.
    `judged` is what rejectors say of answers, by matcher and rejector, `measured` what was done to each query, by id.
    `everyone` are the entries with those who were asked nothing but controls; so are the predictions.
    """

    entries: tuple[Entry, ...]
    scores: dict[str, pd.DataFrame]
    predictions: dict[str, dict[str, Prediction]]
    table: pd.DataFrame
    findings: tuple[Finding, ...] = ()
    verdicts: tuple[Verdict, ...] = ()
    tasks: tuple[dict[str, Any], ...] = field(default=())
    remarks: tuple[str, ...] = ()
    protection: pd.DataFrame = field(default_factory=pd.DataFrame)
    judged: Mapping[tuple[str, str], pd.DataFrame] = field(default_factory=dict)
    measured: Mapping[str, Mapping[str, float]] = field(default_factory=dict)
    everyone: tuple[Entry, ...] = ()


def make_board(request: ScoreRequest, *, tell: Tell) -> Board:
    """Score everything and write the board.

    Parameters
    ----------
    request : ScoreRequest
        What is asked for.
    tell : callable
        Gets a line now and then.

    Returns
    -------
    Board
        What was written.

    Raises
    ------
    StoreError
        If predictions, tasks or truths are missing, damaged, or of other versions, or a run that is named by itself
        answers none of the queries; nothing is written.
    ConfigError
        If there is nothing to score, or rejectors are asked for without a split.
    """
    check_board(request.board, scorer_version=SCORER_VERSION)
    rules = rules_of(request.rejectors, request.split)
    told = _read_told(request, find_entries(request.predictions), tell)
    folders = list(dict.fromkeys(request.tasks)) or sorted({folder for item in told for folder in item.held})
    tasks = [read_scored_task(folder, request.truth or request.root / "truth") for folder in folders]
    for item in told:
        if item.entry.how == AS_SUBMITTED:
            _check_file(item.entry.sources[0], folders)
    everything = {item.entry.name: _scored(item, tasks, request) for item in told}
    predictions = {item.entry.name: item.predictions for item in told}
    verdicts = hold_controls(everything)
    whole = _asked_whole(told, tasks, tell)
    scores = {name: _ranked(frame, whole[name]) for name, frame in everything.items()}
    scores = {name: frame for name, frame in scores.items() if len(frame)}
    entries = tuple(item.entry for item in told if item.entry.name in scores)
    _check_some(scores)
    rows = list(_leaderboards(scores, whole, request.draws))
    all_judged: dict[tuple[str, str], pd.DataFrame] = {}
    views = {name: size for task in tasks for name, size in task.view_bytes.items()}
    areas = {task.about["region"]: task.area_km2 for task in tasks if task.area_km2 is not None}
    for entry in entries:
        frame = scores[entry.name]
        rows.append(to_frame(list(cost_rows(entry.name, frame, entry.runs, view_bytes=views, area_km2=areas))))
        is_taught = bool(_learned(entry))
        own = own_word(frame, request.split, is_taught=is_taught)
        if len(own):
            all_judged[entry.name, OWN] = own
            rows.append(to_frame(list(integrity_rows(entry.name, OWN, own))))
        for name, rule in rules.items():
            judged = judge(frame, predictions[entry.name], rule.make, rule.split, is_taught=is_taught)
            all_judged[entry.name, name] = judged
            if not len(judged):
                tell(f"{name} on {entry.name}: not applied, {why_not(frame, is_taught=is_taught)}")
            if len(judged):
                is_calibrated = rule.card.is_calibrated
                rows.append(to_frame(list(integrity_rows(entry.name, name, judged, is_calibrated=is_calibrated))))
        tell(f"{entry.name}: {_in_words(frame)}")
    remarks = _remarks(all_judged, tell)
    figures = pd.concat([item for item in rows if len(item)], ignore_index=True)
    table = with_contestants(figures, {entry.name: (entry.version, entry.hash) for entry in entries})
    findings = hold_contrasts(request.contrasts, scores, all_judged, draws=request.draws)
    board = Board(
        entries=entries,
        scores=scores,
        predictions=predictions,
        table=table,
        findings=findings,
        verdicts=verdicts,
        tasks=tuple(task.about for task in tasks),
        remarks=remarks,
        protection=_protection(scores, predictions, request.split),
        judged={key: frame for key, frame in all_judged.items() if len(frame)},
        measured={truth.query_id: truth.measured for task in tasks for truth in task.truths},
        everyone=tuple(item.entry for item in told),
    )
    _write(request, board, [make(board) for make in request.extras], [rule.card for rule in rules.values()])
    return board


def _check_some(scores: Mapping[str, pd.DataFrame]) -> None:
    if not scores:
        message = (
            f"there is nothing to rank: but for the suite {CONTROLS!r} no suite has a matcher that was asked all of "
            "its tasks (--tasks names some)"
        )
        raise ConfigError(message)


def _remarks(all_judged: Mapping[tuple[str, str], pd.DataFrame], tell: Tell) -> tuple[str, ...]:
    """What rejectors said of their fits; told, too."""
    judged = ((key, frame) for key, frame in all_judged.items() if key[1] != OWN)
    said = tuple(f"{name} on {matcher}: {item}" for (matcher, name), frame in judged for item in remarks_of(frame))
    for remark in said:
        tell(remark)
    return said


def _protection(
    scores: Mapping[str, pd.DataFrame], predictions: Mapping[str, Mapping[str, Prediction]], split: Split | None
) -> pd.DataFrame:
    """Protection levels of all contestants; empty where none tells any."""
    frames = [protection_frame(name, frame, predictions[name], split) for name, frame in scores.items()]
    told = [frame for frame in frames if len(frame)]
    return pd.concat(told, ignore_index=True) if told else frames[0]


def _in_words(scores: pd.DataFrame) -> str:
    """How many queries of a contestant have a fix, and what became of the others."""
    answered = scores["is_answered"].to_numpy(bool)
    rest = scores.loc[~answered, "status"].replace("ok", "withheld").value_counts()
    others = "".join(f", {count} {status}" for status, count in sorted(rest.items()))
    return f"{int(answered.sum())} of {len(scores)} queries answered{others}"


def _ranked(scores: pd.DataFrame, suites: Collection[str]) -> pd.DataFrame:
    """Scored rows that make figures: those of some suites, and of no control."""
    return scores[scores["suite"].isin(list(suites)) & ~is_control(scores)].reset_index(drop=True)


def _asked_whole(told: Sequence["_Told"], tasks: Sequence[ScoredTask], tell: Tell) -> dict[str, frozenset[str]]:
    """By contestant the suites of which it was asked every task; who was not would be ranked by what it was spared."""
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
    scores: Mapping[str, pd.DataFrame], whole: Mapping[str, Collection[str]], draws: int
) -> Iterator[pd.DataFrame]:
    """Figures of suites by those who were asked all of them: in most cases one table of everything."""
    asked_by: dict[tuple[str, ...], set[str]] = {}
    for suite in sorted({suite for frame in scores.values() for suite in frame["suite"]}):
        asked_by.setdefault(tuple(name for name in scores if suite in whole[name]), set()).add(suite)
    for names, suites in asked_by.items():
        yield leaderboard({name: _ranked(scores[name], suites) for name in names}, draws=draws)


@dataclass(frozen=True, kw_only=True)
class _Told:
    """One contestant and its answers to the tasks of a board.

    `asked` are the folders of tasks whose queries it was asked, answered or not, `held` those that it brings along: a
    file is asked all tasks, and brings those that it holds an answer to. `entry` has only the runs that count.
    """

    entry: Entry
    predictions: dict[str, Prediction]
    held: frozenset[Path]
    asked: frozenset[Path]


def _read_told(request: ScoreRequest, entries: Sequence[Entry], tell: Tell) -> list[_Told]:
    """Answers of all contestants; runs of other queries are left out, and refused where they are named themselves."""
    files = {entry.name: _rows_of_file(entry) for entry in entries if not entry.runs}
    folders = list(request.tasks) or _named(entries, request.root)
    folders = list(dict.fromkeys([*folders, *(() if request.tasks else held_tasks(files.values(), request.root))]))
    tasks = [AskedTask.of(folder) for folder in folders]
    told: list[_Told] = []
    stale: list[Path] = []
    for entry in entries:
        if entry.runs:
            item, others = _read_runs(entry, tasks)
            stale += others
        else:
            rows = files[entry.name]
            held = frozenset(task.folder for task in tasks if not rows.keys().isdisjoint(task.asked))
            item = _Told(entry=entry, predictions=rows, held=held, asked=frozenset(folders))
        if item.asked:
            told.append(item)
    named = next((source for source in stale if source in request.predictions), None)
    if named is not None or (stale and not told):
        holder = "these tasks do" if request.tasks else "its task does"
        message = (
            f"{named or stale[0]} holds answers to other queries than {holder} now: "
            "run again (what is answered already is kept), or make the old queries again"
        )
        raise StoreError(message)
    if not told:
        message = (
            f"there is nothing to score: no task in {request.root / 'tasks'} is answered "
            "(--out names another root, --tasks the tasks themselves)"
        )
        raise ConfigError(message)
    if stale:
        listed = ", ".join(map(str, stale[:MOST_NAMED])) + (", ..." if len(stale) > MOST_NAMED else "")
        tell(f"left out: {counted(len(stale), 'run')} without an answer to these queries ({listed})")
    return told


def _rows_of_file(entry: Entry) -> dict[str, Prediction]:
    return {item.query_id: item for source in entry.sources for item in rundir.read_predictions(source)}


def _read_runs(entry: Entry, tasks: Sequence[AskedTask]) -> tuple[_Told, list[Path]]:
    """Answers of a matcher's runs; the folders of those that answer none of the tasks."""
    by_name = {(task.about["suite"], task.about["region"]): task for task in tasks}
    rows: dict[str, Prediction] = {}
    runs: list[tuple[Path, Mapping[str, Any]]] = []
    asked: set[Path] = set()
    stale: list[Path] = []
    for source, about in zip(entry.sources, entry.runs, strict=True):
        task = by_name.get((about["suite"], about["region"]))
        is_same = task is not None and about["queries_sha256"] == task.about["files"][taskdir.QUERIES]["sha256"]
        found = rundir.Answers({}, 0) if task is None else rundir.read_answers(source, task.asked, is_tied=is_same)
        if task is None or not (found.found or is_same):
            stale.append(source)
            continue
        rows |= found.found
        asked.add(task.folder)
        runs.append((source, _share_of(about, found)))
    mine = replace(entry, sources=tuple(source for source, _ in runs), runs=tuple(about for _, about in runs))
    return _Told(entry=mine, predictions=rows, held=frozenset(asked), asked=frozenset(asked)), stale


def _share_of(about: Mapping[str, Any], answers: rundir.Answers) -> Mapping[str, Any]:
    """What a run took, of its processor seconds the share of the answers that count."""
    if not answers.aside or not isinstance(about.get("cpu_s"), int | float):
        return about
    return {**about, "cpu_s": about["cpu_s"] * len(answers.found) / (len(answers.found) + answers.aside)}


def _named(entries: Sequence[Entry], root: Path) -> list[Path]:
    """Task folders that runs were made on."""
    names = sorted({(about["suite"], about["region"]) for entry in entries for about in entry.runs})
    folders = [root / "tasks" / suite / region for suite, region in names]
    return [folder for folder in folders if (folder / taskdir.TASK).is_file()]


def _check_file(path: Path, folders: Sequence[Path]) -> None:
    """Refuse a file of predictions that is not what the tasks ask for; queries without a row are misses, no faults."""
    faults = [fault for fault in validate(path, folders) if not fault.is_missing_row]
    if faults:
        message = f"{path} holds {counted(len(faults), 'fault')}: {faults[0].to_text()} ('validate' lists all)"
        raise ConfigError(message)


def _scored(told: _Told, tasks: Sequence[ScoredTask], request: ScoreRequest) -> pd.DataFrame:
    """All tasks that one contestant was asked, one row for each query."""
    place_of = {} if request.split is None else request.split.place_of
    frames = []
    for task in tasks:
        if task.folder not in told.asked:
            continue
        names = [head.query_id for head in task.heads]
        mine = {name: told.predictions[name] for name in names if name in told.predictions}
        frame = score_task(task.heads, task.truths, mine, place_of=place_of)
        frames.append(frame.assign(block=frame["region"]) if task.about["suite"] in request.by_region else frame)
    return settle_not_applicable(pd.concat(frames, ignore_index=True))


def _write(request: ScoreRequest, board: Board, extras: Sequence[Extra], cards: Sequence[RejectorCard]) -> None:
    about = {
        "scorer_version": SCORER_VERSION,
        "task_version": TASK_VERSION,
        "data_version": DATA_VERSION,
        "made_by": f"sasgeo-bench {version('sasgeo-bench')}",
        "libraries": _libraries(),
        "pipeline": dict(request.pipeline) or None,
        "split": None if request.split is None else request.split.spec.id,
        "draws": request.draws,
        "contrasts": [asdict(item) for item in request.contrasts],
        "by_region": sorted(request.by_region),
        "rejectors": [{name: getattr(card, name) for name in _CARD} for card in cards],
        "remarks": list(board.remarks),
        "entries": [
            {
                "name": entry.name,
                "version": entry.version,
                "hash": entry.hash,
                "how": entry.how,
                "card": entry.runs[0]["matcher"] if entry.runs else None,
                "isolation": entry.runs[0].get("isolation") if entry.runs else None,
                "learned": _learned(entry),
            }
            for entry in board.entries
        ],
        "tasks": [
            {
                "suite": item["suite"],
                "suite_version": item.get("suite_version"),
                "region": item["region"],
                "map_date": item.get("map_date"),
                "queries_sha256": item["files"][taskdir.QUERIES]["sha256"],
                "map_fingerprint": item["map_fingerprint"],
            }
            for item in board.tasks
        ],
    }
    scores = pd.concat([frame.assign(matcher=name) for name, frame in board.scores.items()], ignore_index=True)
    write_board(
        request.board,
        tables={
            "leaderboard": board.table,
            "scores": scores,
            "contrasts": contrast_frame(board.findings),
            "controls": verdict_frame(board.verdicts),
            **({PROTECTION: board.protection} if len(board.protection) else {}),
        },
        texts={
            "leaderboard.md": board_markdown(board.table, about, board.findings, board.verdicts),
            "leaderboard.tex": board_latex(board.table, about, board.findings, board.verdicts),
        },
        about=about,
        extras=extras,
    )


def _learned(entry: Entry) -> list[dict[str, Any]]:
    """What a contestant has learnt: each text once, where it comes from, and the tasks that were asked under it."""
    found: dict[str, dict[str, Any]] = {}
    for about in entry.runs:
        said = LearnedSaid.of(about)
        if said is not None:
            one = found.setdefault(said.key, {**asdict(said), "trained_on": list(said.trained_on), "asked": []})
            one["asked"].append(f"{about['suite']}/{about['region']}")
    return [one | {"asked": sorted(one["asked"])} for _, one in sorted(found.items())]


def _libraries() -> dict[str, str]:
    """Versions of what figures and fits hang on, Python's among them; of those that are installed."""
    found = {"python": platform.python_version()}
    for name in _LIBRARIES:
        with suppress(PackageNotFoundError):
            found[name] = version(name)
    return found
