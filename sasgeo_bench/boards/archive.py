# SPDX-License-Identifier: Apache-2.0
"""A board with all it was made of -> stored results, and stored results -> what a board is made of."""

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from pathlib import Path

from sasgeo_bench.boards.archive_file import (
    MOST_BYTES,
    SCHEMA_VERSION,
    Packed,
    StoredRun,
    check_results,
    is_pack,
    read_pack,
    unpack,
    unpack_tasks,
    write_pack,
)
from sasgeo_bench.boards.board_files import BOARD, read_board_manifest
from sasgeo_bench.boards.build import drawings, make_board
from sasgeo_bench.boards.elsewhere import asked_elsewhere
from sasgeo_bench.boards.manifests import PackManifest
from sasgeo_bench.boards.private_board import check_public
from sasgeo_bench.boards.scored import Scored, ScoreRequest
from sasgeo_bench.core.errors import ConfigError, SasgeoError, StoreError, counted
from sasgeo_bench.core.folders import scratch_folder
from sasgeo_bench.core.plugins import METRICS, check_registered, code_of
from sasgeo_bench.core.progress import tell
from sasgeo_bench.core.room import Room, most_bytes
from sasgeo_bench.core.texts import one_line
from sasgeo_bench.regions.region import LICENCE
from sasgeo_bench.scoring.entries import Entry
from sasgeo_bench.tasks.split import find_split
from sasgeo_bench.tasks.task_files import Task


@dataclass(frozen=True, slots=True, kw_only=True)
class Stored:
    """Result of storing a board."""

    folder: Path
    packed: Packed

    def to_text(self) -> str:
        """Return one line with the size and the bytes of a prediction."""
        size = self.packed
        each = size.prediction_bytes / max(size.predictions, 1)
        return (
            f"{self.folder}: {size.total_bytes / 1e6:.2f} MB, of these {size.prediction_bytes / 1e6:.2f} MB for "
            f"{counted(size.predictions, 'prediction')} ({each:.0f} bytes each)"
        )


def pack_board(scored: Scored, request: ScoreRequest, folder: Path, *, most_bytes: int = MOST_BYTES) -> Stored:
    """Store a board that was just written in a folder, replacing older results there.

    `most_bytes` limits all files together. Raise `ConfigError` if a contestant is a file of predictions, whose author
    is unknown, or if the board is of a private seed; `StoreError` if it would be too large or cannot be written, and
    older results then stay as they were.
    """
    submitted = next((entry.name for entry in scored.entries if not entry.runs), None)
    if submitted is not None:
        raise ConfigError(f"{submitted} is a file of predictions: only boards of runs are stored")
    check_public(scored.board.about.private_seed, str(request.board))
    tasks = [Task.of(about, request.root, truth=request.truth) for about in scored.tasks]
    ids = {task.manifest.name: task.ids() for task in tasks}
    runs = {entry.name: list(_runs_of(entry, scored, ids)) for entry in scored.entries}
    packed = write_pack(
        folder,
        board=request.board,
        tasks=tasks,
        runs=runs,
        settings=_settings_of(request, list(runs), credit=scored.board.about.credit),
        most_bytes=most_bytes,
    )
    return Stored(folder=folder, packed=packed)


def _runs_of(entry: Entry, scored: Scored, ids: Mapping[tuple[str, str], Sequence[str]]) -> Iterator[StoredRun]:
    answers = scored.predictions[entry.name]
    for source, run in zip(entry.sources, entry.runs, strict=True):
        training = run.learned
        asked = ids[run.suite, run.region]
        yield StoredRun(
            manifest=run,
            predictions=[answers[name] for name in asked if name in answers],
            learned=None if training is None or training.file is None else source.parents[1] / training.file,
        )


def _settings_of(request: ScoreRequest, contestants: Sequence[str], *, credit: str) -> PackManifest:
    return PackManifest(
        schema_version=SCHEMA_VERSION,
        split=None if request.split is None else request.split.spec.id,
        rejectors=list(request.rejectors),
        contrasts=list(request.contrasts),
        draws=request.draws,
        by_region=sorted(request.by_region),
        by_block=sorted(request.by_block),
        within=list(request.within),
        require=list(request.require),
        pipeline=request.pipeline,
        contestants=list(contestants),
        dropped="",
        licence=LICENCE,
        attribution=credit,
        files=None,
    )


def stored_settings(predictions: Sequence[Path]) -> PackManifest | None:
    """Read how the stored results among some predictions were scored; None if there are none.

    Raise `ConfigError` if there are two stored results, whose tasks may differ, and `StoreError` if they are damaged.
    """
    stored = [path for path in predictions if is_pack(path)]
    if len(stored) > 1:
        raise ConfigError(
            f"{stored[0]} and {stored[1]} are both stored results: name one, and runs and files of your own"
        )
    return read_pack(stored[0]) if stored else None


def request_of(
    predictions: Sequence[Path],
    *,
    board: Path,
    root: Path,
    split: str | None = None,
    folders: Sequence[Path] = (),
    rejectors: Sequence[str] = (),
) -> ScoreRequest:
    """Return the request for a board, with the settings of stored results among its predictions, if any.

    `predictions` are runs, files of predictions, and at most one folder of stored results; `folders` hold region files
    of one's own. `split` replaces that of the stored results ("crossfit" if there are none), `rejectors` replace
    theirs, which must be registered. Raise as `stored_settings` does, `ConfigError` if there is no such split, and
    `MatchError` if no installed package registers a stored rejector.

    >>> request_of([Path("nowhere")], board=Path("board"), root=Path("out")).split.spec.id
    'crossfit'
    """
    settings, stored = stored_settings(predictions), stored_among(predictions)
    if settings is None or stored is None:
        chosen = find_split(split or "crossfit", folders=folders)
        return ScoreRequest(
            predictions=predictions,
            root=root,
            split=chosen,
            rejectors=rejectors,
            board=board,
            kept_fits=fits_folder(),
        )
    if not rejectors:
        check_registered(settings.rejectors, source=str(stored))
    name = split or settings.split
    failed: dict[str, str] = {}  # contrasts may name entries that failed when results were stored
    if (stored / BOARD).is_file():
        failed = read_board_manifest(stored).failed
    return ScoreRequest(
        predictions=predictions,
        root=root,
        split=None if name is None else find_split(name, folders=folders),
        contrasts=settings.contrasts,
        rejectors=rejectors or settings.rejectors,
        board=board,
        draws=settings.draws,
        by_region=settings.by_region,
        by_block=settings.by_block,
        within=settings.within,
        require=settings.require,
        pipeline=settings.pipeline,
        failed=failed,
        elsewhere=asked_elsewhere(stored),
        kept_fits=fits_folder(),
    )


def fits_folder() -> Path | None:
    """Return the folder of the user's cache that keeps what rejectors made of answers; None where nothing is kept."""
    with suppress(StoreError):
        return Room.of_user().fits if most_bytes() else None
    return None


def score_all(request: ScoreRequest, *, has_cases: bool = True, results: Path | None = None) -> Scored:
    """Score a request, stored results laid out, and write the board with its figures and pictures.

    `has_cases` shows failed queries with their truths. With `results`, store the board under its name in that folder,
    with all it was made of. Raise `ConfigError` or `StoreError` as `laid_out`, `make_board` and `pack_board` do, or if
    the board to be stored is of a part of the queries.
    """
    if results is not None:
        _check_whole(request)
        check_results(results / request.board.name, request.board)
    with laid_out(request) as laid:
        # they need what was fitted for every entry
        extras = drawings(request, has_cases=has_cases) if request.stored is None else ()
        scored = make_board(laid, extras)
        if results is not None:
            tell(pack_board(scored, laid, results / laid.board.name).to_text())
        return scored


def _check_whole(request: ScoreRequest) -> None:
    """Refuse, before scoring, a request whose board cannot be stored: of some queries, or not of runs alone."""
    if request.without:
        raise ConfigError("a board without some regions is not stored: leave --without or --results away")
    if request.submissions:
        raise ConfigError("the results of a board hold no submissions: leave --submissions or --results away")
    submitted = next((path for path in request.predictions if path.is_file()), None)
    if submitted is not None:
        raise ConfigError(f"{submitted} is a file of predictions: only boards of runs are stored")


def stored_among(predictions: Sequence[Path]) -> Path | None:
    """Return the stored results among some predictions, or None."""
    return next((path for path in predictions if is_pack(path)), None)


@contextmanager
def laid_out(request: ScoreRequest) -> Iterator[ScoreRequest]:
    """Yield the request with its stored results laid out as runs, tasks and truths until the block ends.

    Raise `ConfigError` if tasks are named together with stored results, which hold their own; `StoreError` if the
    results are damaged.
    """
    stored = stored_among(request.predictions)
    if stored is None:
        yield request
        return
    if request.tasks:
        raise ConfigError(f"{stored} are stored results, which hold their own tasks: leave --tasks away")
    with scratch_folder("answers") as folder:
        found = unpack(stored, folder)
        others = [path for path in request.predictions if path != stored]
        kept = read_board_manifest(stored)
        named = {":".join(code_of(spec, METRICS)) for spec in request.metrics}
        lost = [one.code for one in kept.metrics if one.code not in named]
        if lost:
            flags = " ".join(f"--metric {one}" for one in lost)
            tell(f"{stored} has metrics of other packages, which are left out here: {flags} adds them")
        with _attributed(stored, found.root):
            yield replace(
                request,
                predictions=[*found.runs, *others],
                tasks=found.tasks,
                root=found.root,
                truth=found.root / "truth",
                kept=kept,
            )


@contextmanager
def _attributed(stored: Path, root: Path) -> Iterator[None]:
    """Attribute errors in a temporary folder to the stored results that were laid out there."""
    try:
        yield
    except SasgeoError as error:
        if str(root) not in str(error):
            raise
        fault = one_line(str(error).replace(f"{root}/", ""))
        raise StoreError(f"{stored} holds no sound stored results ({fault}): fetch them again") from error


@contextmanager
def laid_tasks(paths: Sequence[Path]) -> Iterator[tuple[Path, ...]]:
    """Yield task folders: those named, and the tasks of stored results, laid out until the block ends.

    Raise `StoreError` if results are damaged.
    """
    with scratch_folder("answers") as folder:
        tasks: list[Path] = []
        for number, path in enumerate(paths):
            tasks += unpack_tasks(path, folder / str(number)) if is_pack(path) else [path]
        with _attributed(next(filter(is_pack, paths), Path()), folder):
            yield tuple(tasks)


def board_of(paths: Sequence[Path]) -> str:
    """Return the id of the board of stored results among some paths; empty if there are none, or of no pipeline.

    Raise as `stored_settings` does.
    """
    settings = stored_settings(paths)
    return "" if settings is None or settings.pipeline is None else settings.pipeline.id
