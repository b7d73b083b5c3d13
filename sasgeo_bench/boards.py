# SPDX-License-Identifier: Apache-2.0
"""Runs, files of predictions and truths -> a board: the order of the steps."""

import platform
import re
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any, Final

import pandas as pd

from sasgeo_bench.errors import ConfigError, MatchError, MetricError, StoreError, counted
from sasgeo_bench.matcher import check_name
from sasgeo_bench.metrics.cost import run_cost
from sasgeo_bench.metrics.draws import DRAWS
from sasgeo_bench.query import CONTROLS, TASK_VERSION, Head, Truth
from sasgeo_bench.region import DATA_VERSION
from sasgeo_bench.rejector import RejectorCard
from sasgeo_bench.report.contrasts import Contrast, Finding, contrast_frame, hold_contrasts
from sasgeo_bench.report.controls import Verdict, hold_controls, is_control, verdict_frame
from sasgeo_bench.report.costs import cost_rows
from sasgeo_bench.report.integrity import integrity_rows
from sasgeo_bench.report.latex import board_latex
from sasgeo_bench.report.rejection import OWN, judge, own_word, rules_of, why_not
from sasgeo_bench.report.rows import is_unranked, to_frame, with_contestants
from sasgeo_bench.report.tables import leaderboard
from sasgeo_bench.report.text import board_markdown
from sasgeo_bench.results import Prediction, one_line
from sasgeo_bench.score import SCORER_VERSION, score_task, settle_not_applicable
from sasgeo_bench.split import Split
from sasgeo_bench.store import rundir, taskdir
from sasgeo_bench.store.boardfile import Extra, check_board, write_board
from sasgeo_bench.store.regiondir import read_manifest
from sasgeo_bench.validate import validate

Tell = Callable[[str], None]

FILE_NAME: Final = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]*")
M2_PER_KM2: Final = 1e6
REPRODUCED: Final = "reproduced"
AS_SUBMITTED: Final = "as submitted"
_LIBRARIES: Final = ("numpy", "scipy", "pandas", "pyarrow", "statsmodels", "scikit-learn")
_CARD: Final = ("name", "version", "title", "source", "licence", "is_calibrated")  # of a rejector, in board.json
_RUN_SAYS: Final = ("hash", "suite", "region", "queries_sha256")


@dataclass(frozen=True, kw_only=True)
class ScoreRequest:
    """What is to be put on a board.

    Parameters
    ----------
    predictions : sequence of Path
        Folders of runs (any folder with runs in it), and files of predictions.
    tasks : sequence of Path
        Task folders; without any, those that the runs and files answer.
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
class Entry:
    """One contestant: a matcher as it was run, or a file of predictions.

    `runs` are what each `run.json` says; `sources` the folder or file of predictions for each of them.
    """

    name: str
    version: str
    hash: str
    how: str
    sources: tuple[Path, ...]
    runs: tuple[Mapping[str, Any], ...] = ()


@dataclass(frozen=True, kw_only=True)
class Board:
    """A board in memory: scored rows by matcher, without those of the controls, and the leaderboard."""

    entries: tuple[Entry, ...]
    scores: dict[str, pd.DataFrame]
    predictions: dict[str, dict[str, Prediction]]
    table: pd.DataFrame
    findings: tuple[Finding, ...] = ()
    verdicts: tuple[Verdict, ...] = ()
    tasks: tuple[dict[str, Any], ...] = field(default=())


def find_entries(paths: Sequence[Path]) -> tuple[Entry, ...]:
    """Who is to be scored.

    Parameters
    ----------
    paths : sequence of Path
        Folders with runs somewhere in them, and files of predictions.

    Returns
    -------
    tuple of Entry
        By name; two versions of one matcher are two entries, with the version in their names, and with the hash where
        that is the same.

    Raises
    ------
    StoreError
        If a path holds no predictions, or a `run.json` does not say whose answers lie beside it.
    ConfigError
        If two files have one name, or one has that of a control.
    """
    by_run: dict[tuple[str, str, str], list[tuple[Path, dict[str, Any]]]] = {}
    files: list[Entry] = []
    seen: set[Path] = set()  # a run that lies in two of the folders, or a file that is named twice, counts once
    for path in paths:
        if path.is_file():
            if _is_new(path, seen):
                files.append(_file_entry(path))
            continue
        found = sorted(path.rglob(rundir.RUN))
        if not found:
            message = f"{path} holds no run: name the folder of a run, one with runs in it, or a predictions file"
            raise StoreError(message)
        for run in found:
            if _is_new(run, seen):
                about = _read_run(run)
                card = about["matcher"]
                by_run.setdefault((card["name"], card["version"], about["hash"]), []).append((run.parent, about))
    names = [name for name, _, _ in by_run]
    versions = [(name, number) for name, number, _ in by_run]

    def shown(name: str, number: str, digest: str) -> str:
        """As short as it can be and still be one contestant's alone."""
        if names.count(name) == 1:
            return name
        return f"{name} {number}" if versions.count((name, number)) == 1 else f"{name} {number} ({digest[:6]})"

    entries = [
        Entry(
            name=shown(name, number, digest),
            version=number,
            hash=digest,
            how=REPRODUCED,
            sources=tuple(folder for folder, _ in found),
            runs=tuple(about for _, about in found),
        )
        for (name, number, digest), found in by_run.items()
    ]
    entries += files
    listed = [entry.name for entry in entries]
    twice = next((name for name in listed if listed.count(name) > 1), None)
    if twice is not None:
        message = f"two contestants are named {twice!r}: rename the file of one"
        raise ConfigError(message)
    return tuple(sorted(entries, key=lambda entry: entry.name))


def _is_new(path: Path, seen: set[Path]) -> bool:
    place = path.parent.resolve() / path.name
    is_new = place not in seen
    seen.add(place)
    return is_new


def _file_entry(path: Path) -> Entry:
    if not FILE_NAME.fullmatch(path.stem):
        message = f"{path.name!r}: name the file by letters, digits, hyphens, dots and underscores alone"
        raise ConfigError(message)
    if is_unranked(path.stem):
        message = f"{path.name!r}: {path.stem!r} is the name of a control of every board: rename the file"
        raise ConfigError(message)
    return Entry(name=path.stem, version="", hash="", how=AS_SUBMITTED, sources=(path,))


def _read_run(path: Path) -> dict[str, Any]:
    """What a `run.json` says, after a look at whatever a board takes from it: it may be anyone's."""
    about = rundir.read_run(path.parent) or {}
    card = about.get("matcher")
    said = {"matcher.name": None, "matcher.version": None} | {name: about.get(name) for name in _RUN_SAYS}
    if isinstance(card, dict):
        said |= {f"matcher.{name}": card.get(name) for name in ("name", "version")}
    fault = next((f"{name} is {value!r}" for name, value in said.items() if not value or type(value) is not str), None)
    try:
        check_name(str(said["matcher.name"]))
        run_cost(about)
    except (MatchError, MetricError) as error:
        fault = fault or str(error)
    if fault is not None:
        message = f"{path} is damaged ({one_line(fault)}): remove it and run again, the parts beside it are kept"
        raise StoreError(message)
    return about


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
        If predictions, tasks or truths are missing, damaged, or of other versions; nothing is written.
    ConfigError
        If there is nothing to score, or rejectors are asked for without a split.
    """
    check_board(request.board, scorer_version=SCORER_VERSION)
    rules = rules_of(request.rejectors, request.split)
    entries = find_entries(request.predictions)
    predictions = {entry.name: _predictions(entry) for entry in entries}
    folders = list(request.tasks) or list(_answered(entries, predictions, request.root))
    if not folders:
        message = (
            f"there is nothing to score: no task in {request.root / 'tasks'} is answered "
            "(--out names another root, --tasks the tasks themselves)"
        )
        raise ConfigError(message)
    tasks = [_read_task(folder, request.truth or request.root / "truth") for folder in folders]
    for entry in entries:
        if entry.how == AS_SUBMITTED:
            _check_file(entry.sources[0], folders)
    everything = {entry.name: _scored(entry, predictions[entry.name], tasks, request) for entry in entries}
    verdicts = hold_controls(everything)
    entries = tuple(entry for entry in entries if not _is_for_controls(entry))
    scores = {entry.name: _ranked(everything[entry.name]) for entry in entries}
    if not any(map(len, scores.values())):
        message = f"there is nothing to rank: only queries of the suite {CONTROLS!r} are answered"
        raise ConfigError(message)
    rows = [leaderboard(scores, draws=request.draws)]
    all_judged: dict[tuple[str, str], pd.DataFrame] = {}
    views = {name: size for task in tasks for name, size in task.view_bytes.items()}
    areas = {task.about["region"]: task.area_km2 for task in tasks if task.area_km2 is not None}
    for entry in entries:
        frame = scores[entry.name]
        rows.append(to_frame(list(cost_rows(entry.name, frame, entry.runs, view_bytes=views, area_km2=areas))))
        own = own_word(frame, request.split)
        if len(own):
            all_judged[entry.name, OWN] = own
            rows.append(to_frame(list(integrity_rows(entry.name, OWN, own))))
        for name, rule in rules.items():
            judged = judge(frame, predictions[entry.name], rule.make, rule.split)
            all_judged[entry.name, name] = judged
            if not len(judged):
                tell(f"{name} on {entry.name}: not applied, {why_not(frame)}")
            if len(judged):
                is_calibrated = rule.card.is_calibrated
                rows.append(to_frame(list(integrity_rows(entry.name, name, judged, is_calibrated=is_calibrated))))
        tell(f"{entry.name}: {int(frame['is_answered'].sum())} of {len(frame)} queries answered")
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
    )
    _write(request, board, [make(board) for make in request.extras], [rule.card for rule in rules.values()])
    return board


def _is_for_controls(entry: Entry) -> bool:
    """Whether a matcher was run on the controls alone, as the reference of a board is."""
    return bool(entry.runs) and all(about["suite"] == CONTROLS for about in entry.runs)


def _ranked(scores: pd.DataFrame) -> pd.DataFrame:
    """Scored rows that make figures."""
    return scores[~is_control(scores)].reset_index(drop=True)


def _predictions(entry: Entry) -> dict[str, Prediction]:
    return {item.query_id: item for source in entry.sources for item in _rows_of(source)}


def _rows_of(source: Path) -> Iterator[Prediction]:
    if source.is_dir() and not rundir.parts_of(source):
        return  # a run that was cut off before its first row: all of its queries are missing
    yield from rundir.read_predictions(source)


def _answered(
    entries: Sequence[Entry], predictions: Mapping[str, Mapping[str, Prediction]], root: Path
) -> Iterator[Path]:
    """Task folders that runs were made on, and of which files hold an answer."""
    named = {(about["suite"], about["region"]) for entry in entries for about in entry.runs}
    held = {name for entry in entries if not entry.runs for name in predictions[entry.name]}
    for path in sorted((root / "tasks").glob(f"*/*/{taskdir.TASK}")):
        folder = path.parent
        is_named = (folder.parent.name, folder.name) in named
        if is_named or (held and not held.isdisjoint(taskdir.read_ids(folder))):
            yield folder


def _check_file(path: Path, folders: Sequence[Path]) -> None:
    """Refuse a file of predictions that is not what the tasks ask for; queries without a row are misses, no faults."""
    faults = [fault for fault in validate(path, folders) if not fault.is_missing_row]
    if faults:
        message = f"{path} holds {counted(len(faults), 'fault')}: {faults[0].to_text()} ('validate' lists all)"
        raise ConfigError(message)


@dataclass(frozen=True, kw_only=True)
class _Task:
    """A task as it is scored: read once, for all contestants."""

    folder: Path
    about: dict[str, Any]
    heads: tuple[Head, ...]
    truths: tuple[Truth, ...]
    view_bytes: dict[str, int]
    area_km2: float | None


def _read_task(folder: Path, root: Path) -> _Task:
    """A task and its truths from their own root, after they were held against each other."""
    about = taskdir.read_task(folder)
    truth = root / str(about["suite"]) / str(about["region"])
    taskdir.check_truths(folder, truth)
    heads, truths = tuple(taskdir.read_heads(folder)), tuple(taskdir.read_truths(truth))
    return _Task(
        folder=folder,
        about=about,
        heads=heads,
        truths=truths,
        view_bytes=taskdir.read_view_bytes(folder),
        area_km2=_area_km2(folder.resolve().parents[2] / "regions" / about["region"]),
    )


def _area_km2(region: Path) -> float | None:
    """Mapped area of a region; None where it is not beside the tasks, for scores need no map."""
    try:
        manifest = read_manifest(region)
    except StoreError:
        return None
    west, south, east, north = manifest.bounds_m
    return manifest.coverage.share * (east - west) * (north - south) / M2_PER_KM2


def _check_asked(entry: Entry, task: _Task) -> None:
    """Refuse a run of other queries than the task holds now; a task may have several runs, of one shard each."""
    here = (task.about["suite"], task.about["region"])
    for folder, about in zip(entry.sources, entry.runs, strict=False):  # a file has no run
        is_same = about["queries_sha256"] == task.about["files"][taskdir.QUERIES]["sha256"]
        if (about["suite"], about["region"]) == here and not is_same:
            message = (
                f"{folder} holds answers to other queries than {task.folder} does now: "
                "move it away and run again, or make the old queries again"
            )
            raise StoreError(message)


def _scored(
    entry: Entry, predictions: Mapping[str, Prediction], tasks: Sequence[_Task], request: ScoreRequest
) -> pd.DataFrame:
    """All tasks of one contestant, one row for each query."""
    place_of = {} if request.split is None else request.split.place_of
    frames = []
    for task in tasks:
        _check_asked(entry, task)
        mine = {head.query_id: predictions[head.query_id] for head in task.heads if head.query_id in predictions}
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
        "by_region": sorted(request.by_region),
        "rejectors": [{name: getattr(card, name) for name in _CARD} for card in cards],
        "entries": [
            {
                "name": entry.name,
                "version": entry.version,
                "hash": entry.hash,
                "how": entry.how,
                "card": entry.runs[0]["matcher"] if entry.runs else None,
                "isolation": entry.runs[0].get("isolation") if entry.runs else None,
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
        },
        texts={
            "leaderboard.md": board_markdown(board.table, about, board.findings, board.verdicts),
            "leaderboard.tex": board_latex(board.table, about, board.findings, board.verdicts),
        },
        about=about,
        extras=extras,
    )


def _libraries() -> dict[str, str]:
    """Versions of what figures and fits hang on, Python's among them; of those that are installed."""
    found = {"python": platform.python_version()}
    for name in _LIBRARIES:
        with suppress(PackageNotFoundError):
            found[name] = version(name)
    return found
