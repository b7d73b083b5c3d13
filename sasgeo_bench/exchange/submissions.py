# SPDX-License-Identifier: Apache-2.0
"""Answers of others: a submission of predictions and a card, checked against a board and scored with it."""

import difflib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from importlib.metadata import version
from itertools import islice
from pathlib import Path
from typing import Final

from sasgeo_bench.boards.archive import board_of, laid_tasks, request_of, score_all, stored_among
from sasgeo_bench.boards.archive_file import is_pack, read_pack
from sasgeo_bench.boards.board import Board
from sasgeo_bench.boards.board_files import read_board_manifest
from sasgeo_bench.boards.manifests import BoardManifest, PackManifest
from sasgeo_bench.boards.scored import Scored, ScoreRequest
from sasgeo_bench.core.errors import ConfigError, StoreError, counted
from sasgeo_bench.core.progress import tell
from sasgeo_bench.matching.cards import read_card_file
from sasgeo_bench.matching.matcher import Prediction, RejectorCard
from sasgeo_bench.matching.submission import SCHEMA_VERSION, AnsweredTask, Card, Submission
from sasgeo_bench.regions.region import ATTRIBUTION, DATA_VERSION, LICENCE
from sasgeo_bench.running import prediction_files
from sasgeo_bench.running.prediction_files import RUN, RunManifest, Violation
from sasgeo_bench.scoring.entries import check_name
from sasgeo_bench.scoring.rejection import rules_of
from sasgeo_bench.scoring.rows import base_name
from sasgeo_bench.scoring.score import SCORER_VERSION
from sasgeo_bench.scoring.submission_files import (
    is_submission,
    list_submissions,
    read_submission,
    submission_faults,
    validate,
    write_submission,
)
from sasgeo_bench.tasks.query import CONTROLS, TASK_VERSION, base_of
from sasgeo_bench.tasks.split import Split, find_split
from sasgeo_bench.tasks.task_files import Task

FOLDER: Final = Path("submissions")  # the default folder of submissions


@dataclass(frozen=True, kw_only=True)
class SubmitRequest:
    """A request for a submission.

    `predictions` is a file of predictions or the folder of a matcher's runs, `card` a card or a TOML file, `board` the
    stored results of the board, `into` the folder to write (submissions/<board>/<name> by default).
    """

    predictions: Path
    card: Card | Path
    board: Path
    into: Path | None = None


def make_submission(request: SubmitRequest) -> Path:
    """Put predictions and a card into a folder that `verify` accepts, and return it.

    A line tells of misses and of controls that are not answered. Raise `ConfigError` if the card does not fit the
    board or the runs, or the predictions hold faults; `StoreError` if something cannot be read or written.
    """
    card = request.card if isinstance(request.card, Card) else read_card_file(request.card)
    if not is_pack(request.board):
        raise StoreError(
            f"{request.board} holds no stored results: name those of the board, as in --for docs/results/demo"
        )
    split = check_card(card, request.board, source="the card" if isinstance(request.card, Card) else str(request.card))
    with laid_tasks([request.board]) as folders:
        tasks = [Task.open(folder) for folder in folders]
        _check_runs(card, request.predictions, split, tasks)
        _check_rows(request.predictions, tasks)
        rows = _rows_of(request.predictions, tasks)
    submission = Submission(
        schema_version=SCHEMA_VERSION,
        card=card,
        board=board_of([request.board]),
        split=None if split is None else split.spec.id,
        task_version=TASK_VERSION,
        data_version=DATA_VERSION,
        scorer_version=SCORER_VERSION,
        made_by=f"sasgeo-bench {version('sasgeo-bench')}",
        tasks=_answered(tasks, rows, request.predictions),
        files={},
        licence=LICENCE,
        attribution=ATTRIBUTION,
    )
    asked = {name: one for task in tasks for name, one in task.asked.items()}
    folder = request.into or default_folder(submission.board, card.name)
    is_replaced = is_submission(folder)
    write_submission(folder, submission, list(rows.values()), asked)
    if is_replaced:
        tell(f"{folder}: the submission that was there is replaced")
    for line in _remarks(submission):
        tell(line)
    return folder


def default_folder(board: str, name: str) -> Path:
    """Return the folder of a submission unless another is named: one matcher may answer several boards."""
    return FOLDER / board / name


def check_card(card: Card, board: Path, *, source: str) -> Split | None:
    """Return the split of a board, after refusing a card that does not fit it; `source` is where the card stands.

    Raise `ConfigError` if its name is that of another row or of a matcher that ships, or training places are unknown.
    """
    settings = read_pack(board)
    split = _split_of(settings.split)
    check_name(card.name, _names_on(settings), source=source)
    _check_places(card, board, split, source)
    return split


def _split_of(name: str | None) -> Split | None:
    return None if name is None else find_split(name)


def _names_on(settings: PackManifest) -> set[str]:
    """Return the names of the matchers on a board, without their versions."""
    return {base_name(name) for name in settings.contestants}


def _check_places(card: Card, board: Path, split: Split | None, source: str) -> None:
    if not board_of([board]):
        raise ConfigError(f"{board} are stored results of no pipeline: name those of a board that one has made")
    known = () if split is None else tuple(split.blocks)
    unknown = next((place for place in card.places if place not in known), None)
    if unknown is not None:
        raise ConfigError(
            f"{source}: trained_on names {unknown!r}, {_hint(unknown, split)}; what is no place of the split goes into "
            "trained_elsewhere"
        )
    if card.is_by_half and (split is None or not split.half_of):
        raise ConfigError(
            f"{source}: trained_on speaks of halves, and the split of this board has none: list the places"
        )


def _hint(unknown: str, split: Split | None) -> str:
    """Suggest a known place for one that the split does not know."""
    if split is None:
        return "and this board has no split"
    home = split.places_in(unknown)
    near = difflib.get_close_matches(unknown, split.blocks, n=1)
    if home:
        return f"a region of the place {home[0]!r}"
    return f"did you mean {near[0]!r}?" if near else f"there are {', '.join(split.blocks)}"


def _check_runs(card: Card, predictions: Path, split: Split | None, tasks: Sequence[Task]) -> None:
    """Refuse a card that disagrees with the runs on the matcher or its training places."""
    named = {task.manifest.name for task in tasks}
    for run in _runs_in(predictions):
        name, version = run.matcher.name, run.matcher.version
        if (name, version) != (card.name, card.version):
            raise ConfigError(
                f"the card is of {card.name!r} {card.version}, {predictions} holds runs of {name!r} {version}: make "
                "them agree, or name the folder of the runs that the card is of, as in "
                f"{predictions / (run.hash or '<hash>')}"
            )
        if (run.suite, run.region) in named:
            _check_taught(card, run, split)


def _runs_in(predictions: Path) -> Iterator[RunManifest]:
    prediction_files.check_one_matcher([predictions])
    for path in sorted(predictions.rglob(RUN)) if predictions.is_dir() else ():
        run = RunManifest.open(path.parent)
        if run is not None:
            yield run


def _check_taught(card: Card, run: RunManifest, split: Split | None) -> None:
    """Check that the card states the runner's training, for the half it was asked about."""
    places_trained = () if run.learned is None else run.learned.trained_on
    places = () if split is None else split.places_in(base_of(run.region))
    half = split.half_of.get(places[0]) if split is not None and places else None
    lost = sorted(set(places_trained) - set(card.taught(half)))
    if lost:
        raise ConfigError(
            f"the runs on {run.suite}/{run.region} were trained on {lost[0]}, which trained_on of the card "
            f"does not name{'' if half is None else f' for half {half}'}: add it"
        )


def _check_rows(predictions: Path, tasks: Sequence[Task]) -> None:
    faults = [fault for fault in validate(predictions, tasks) if not fault.is_missing_row]
    if faults:
        raise ConfigError(
            f"{predictions} holds {counted(len(faults), 'fault')}: {faults[0].to_text()} ('verify' lists all); "
            "nothing was written"
        )


def _rows_of(predictions: Path, tasks: Sequence[Task]) -> dict[str, Prediction]:
    """Return answers to the board's queries by id; answers of runs to other queries are left out."""
    asked = {name: one for task in tasks for name, one in task.asked.items()}
    if predictions.is_dir():
        return prediction_files.Answers.open(predictions, asked, is_tied=False).found
    return {item.query_id: item for item in prediction_files.read_predictions(predictions)}


def _answered(tasks: Sequence[Task], rows: Mapping[str, Prediction], predictions: Path) -> list[AnsweredTask]:
    """Return all tasks of every suite with an answer: an author may choose suites, but not tasks within them."""
    counts = [(task, sum(name in rows for name in task.asked)) for task in tasks]
    suites = {task.manifest.suite for task, count in counts if count}
    if not suites:
        raise ConfigError(
            f"{predictions} holds no answer to the queries of this board: ask its tasks (docs/howto/matcher.md)"
        )
    return [
        AnsweredTask(
            suite=task.manifest.suite,
            region=task.manifest.region,
            queries_sha256=task.manifest.queries_sha256,
            queries=len(task.asked),
            answered=count,
        )
        for task, count in counts
        if task.manifest.suite in suites
    ]


def _remarks(submission: Submission) -> Iterator[str]:
    """Yield remarks for the author on misses and controls."""
    queries, answered = (sum(getattr(task, name) for task in submission.tasks) for name in ("queries", "answered"))
    asked = counted(queries, "query", "queries")
    yield f"{submission.card.name}: {answered} of {asked} of the board {submission.board} have a row"
    if answered < queries:
        yield f"  {queries - answered} have none and count as misses"
    if CONTROLS not in {task.suite for task in submission.tasks}:
        yield f"  the suite {CONTROLS!r} is not answered: nothing vouches for these answers but their author"


def hold_submission(folder: Path, tasks: Sequence[Path]) -> tuple[Submission, tuple[Violation, ...]]:
    """Check a submission against itself and against tasks, task folders or stored results, if any.

    Return its record and all faults, queries without a row among them. The split is that of the board, or the one that
    the record names where no board is given. Raise `StoreError` if its files differ from its record or something cannot
    be read, and `ConfigError` if the record is wrong in itself, or of another board, or its name is that of another
    row.
    """
    submission = read_submission(folder)
    stored = stored_among(tasks)
    settings = None if stored is None else read_pack(stored)
    check_name(submission.card.name, () if settings is None else _names_on(settings), source=str(folder))
    split = _split_of(submission.split if settings is None else settings.split)
    if not tasks:
        return submission, tuple(submission_faults(folder, submission, None, split))
    board = board_of(tasks)
    if board and board != submission.board:
        raise ConfigError(
            f"{folder} answers the board {submission.board!r}, and {board!r} is the board of {tasks[0]}: name the "
            f"results of {submission.board!r} by --for"
        )
    with laid_tasks(tasks) as folders:
        return submission, tuple(submission_faults(folder, submission, [*map(Task.open, folders)], split))


def submissions_for(board: str, paths: Sequence[Path]) -> tuple[Path, ...]:
    """Return the submissions for a board id, in `paths` or folders of them; report how many are for others.

    What cannot be read is among them: the board reports and loses it alone. Raise `StoreError` if a path is neither a
    submission nor a folder of them, and `ConfigError` if `board` is empty.
    """
    if not board:
        raise ConfigError("submissions are scored with the stored results of a board: name them with --predictions")
    listed = (folder for path in paths for folder in list_submissions(path))
    found = {folder.parent.resolve() / folder.name: folder for folder in listed}  # a link may lead to itself
    boards = {folder: _board_named(folder, board) for folder in found.values()}
    others = sorted({name for name in boards.values() if name != board})
    if others:
        count = sum(name != board for name in boards.values())
        tell(f"left out: {counted(count, 'submission')} for other boards ({', '.join(islice(others, 3))})")
    return tuple(folder for folder, name in boards.items() if name == board)


def _board_named(folder: Path, board: str) -> str:
    """Return the board that a submission names; an unreadable one fails on this board, which reports it."""
    try:
        return read_submission(folder).board
    except (StoreError, ConfigError, OSError):
        return board


def with_submissions(
    stored: Path, submissions: Sequence[Path], board: Path, *, root: Path = Path("out"), jobs: int = 1
) -> Scored:
    """Score stored results again together with submissions, and write the board of both.

    `submissions` are submissions and folders of them; those for other boards are left out. `root` holds regions/,
    tasks/ and truth/ for pictures, `jobs` counts the processes that fit rejectors. Rows of submissions are marked `as
    submitted`. A submission that is damaged or does not fit is left out, among the `failures` of the board. Raise
    `StoreError` or `ConfigError` if results are damaged or no folder holds submissions; nothing is written then.
    """
    return score_all(_request(stored, submissions, board, root=root, jobs=jobs))


def _request(stored: Path, submissions: Sequence[Path], board: Path, *, root: Path, jobs: int) -> ScoreRequest:
    if not is_pack(stored):
        raise StoreError(f"{stored} holds no stored results: name a folder that 'leaderboard --results' has written")
    found = submissions_for(board_of([stored]), submissions)
    return replace(request_of([stored], board=board, root=root), submissions=found, jobs=jobs)


def why_anew(about: BoardManifest, cards: Sequence[RejectorCard]) -> str | None:
    """Return why the figures of a stored board are no longer those of this program, None if they are.

    `about` is its manifest, `cards` those of the rejectors here. The version of tasks does not matter:
    answers are scored against the stored queries, whichever others are drawn today.

    >>> why_anew(BoardManifest(scorer_version=1, entries=[], tasks=[]), [])
    'the board is of scorer version 1, this program of 6'
    """
    if about.scorer_version != SCORER_VERSION:
        return f"the board is of scorer version {about.scorer_version}, this program of {SCORER_VERSION}"
    stored, here = ({(str(one.name), str(one.version)) for one in some} for some in (about.rejectors, cards))
    changed = sorted({name for name, _ in stored ^ here})  # another version fits otherwise
    return f"the rejector {changed[0]} has another version here" if changed else None


def beside_stored(stored: Path, submission: Path, board: Path, *, root: Path = Path("out"), jobs: int = 1) -> Scored:
    """Score one submission beside stored results, whose own rejectors and contrasts stand as they are.

    Its figures are those of `with_submissions`, to the last bit; ranks are of all entries together. Figures and
    pictures are left out. If the stored figures are those of another scorer or rejector, a line says why, and all
    is scored anew. Arguments and errors as of `with_submissions`.
    """
    request = _request(stored, [submission], board, root=root, jobs=jobs)
    request = replace(request, added=[submission.resolve().name])  # the name of its matcher, too
    reason = why_anew(
        read_board_manifest(stored), [rule.card for rule in rules_of(request.rejectors, request.split).values()]
    )
    if reason is not None:
        tell(f"all entries are scored anew: {reason}")
        return score_all(request)
    return score_all(replace(request, stored=Board.open(stored)))
