# SPDX-License-Identifier: Apache-2.0
"""A board in memory, the request for one, and its files."""

import platform
from collections.abc import Callable, Collection, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import cache, partial
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Final

import pandas as pd

from sasgeo_bench.leaderboard.board_files import ACCEPTANCE, PROTECTION, Extra, write_board
from sasgeo_bench.leaderboard.board_tables import step_tables
from sasgeo_bench.leaderboard.manifests import (
    BoardEntry,
    BoardManifest,
    BoardTask,
    Elsewhere,
    Learned,
    PipelineRecord,
    RejectorRecord,
)
from sasgeo_bench.leaderboard.plot_tables import age_names, ages_frame
from sasgeo_bench.leaderboard.private_board import OnPrivate, seed_of
from sasgeo_bench.leaderboard.rejection_tables import acceptance_tables
from sasgeo_bench.leaderboard.stored_board import StoredBoard
from sasgeo_bench.leaderboard.text import board_latex, board_markdown
from sasgeo_bench.matching.matcher import RejectorCard
from sasgeo_bench.progress import tell
from sasgeo_bench.regions.region import DATA_VERSION
from sasgeo_bench.running.failures import Failures
from sasgeo_bench.running.prediction_files import StoredAnswers
from sasgeo_bench.running.run_manifest import CardRecord
from sasgeo_bench.running.sandbox import joined
from sasgeo_bench.scoring.contrasts import Contrast
from sasgeo_bench.scoring.controls import CONTROL_SCHEMA, FALSIFIER_SCHEMA, Falsifier, Verdict, failed_controls
from sasgeo_bench.scoring.draws import DRAWS
from sasgeo_bench.scoring.entries import Entry
from sasgeo_bench.scoring.score import SCORER_VERSION
from sasgeo_bench.scoring.strata import queries_of, steps_frame
from sasgeo_bench.scoring.verdicts import CONTRAST_SCHEMA, Finding
from sasgeo_bench.tasks.openings import SealedPlace
from sasgeo_bench.tasks.query import TASK_VERSION, Truth
from sasgeo_bench.tasks.split import Split
from sasgeo_bench.tasks.task_files import TaskManifest

_LIBRARIES: Final = ("numpy", "scipy", "pandas", "pyarrow", "statsmodels", "scikit-learn")


@dataclass(frozen=True, kw_only=True)
class ScoreRequest:
    """A request for a board, written to the folder `board`.

    `predictions` are folders of runs, with runs at any depth, and files of predictions; `submissions` are folders that
    are scored as files are, with more checks (`validate.submission_faults`). `tasks` are task folders; without any,
    those that the runs and files answer. A matcher that was asked nothing of one of them has no figures on its suite.
    `root` holds tasks/ and truth/, `truth` is the folder of the truths where it is another one.

    `split` assigns blocks to places, and names those that calibrate; rejectors (names, or module:Class) need it.
    `contrasts` are the registered ones. `draws` counts those of the bootstrap; suites in `by_region` are resampled by
    region, not by block; in suites of `by_block` each block is a place. `without` are regions to leave out, with all of
    their maps. `jobs` processes fit rejectors, or workers of the cluster at `dask`. `extras` make, from the finished
    board, files that are written with it.

    `pipeline` is name and hash of the pipeline that requests the board, if one does, `title` its title. `private` is a
    board of a private seed of the same pipeline to compare rows with. `kept` is the manifest of stored results: it
    keeps the version of their maps, their title and their sealed places, and their results on a private seed where no
    private board is named. `sealed` are the sealed places (`openings.sealed_record`). `failed` names entries that
    failed before scoring, and why. `stored` is a board whose entries are not fitted again, `elsewhere` rows of other
    boards that asked the same queries.
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
    by_block: Collection[str] = ()
    pipeline: PipelineRecord | None = None
    title: str = ""
    extras: Sequence[Callable[["Board"], Extra]] = ()
    without: Collection[str] = ()
    submissions: Sequence[Path] = ()
    jobs: int = 1
    dask: str | None = None
    private: Path | None = None
    kept: BoardManifest | None = None
    sealed: Mapping[str, SealedPlace] = field(default_factory=dict)
    failed: Mapping[str, str] = field(default_factory=dict)
    stored: StoredBoard | None = None
    elsewhere: Sequence[Elsewhere] = ()


@dataclass(frozen=True, kw_only=True)
class Board:
    """A board in memory: scored rows by matcher, without those of the controls, and the leaderboard.

    `with_calibration` also holds rows of the calibration places of a hold-out split, which no figure counts.
    `remarks` are on the fits of rejectors and on where they are not applied; `protection` has no row where no answer
    has a protection level, `acceptance` none where no place is absent.
    `judged` are the results of rejectors by matcher and rejector, `measured` the measurements of truths by query id,
    of flights those of their first view, `views` the rows of views of flights by matcher (`flights.view_frame`), and
    `truths` all truths, those of controls included. `everyone` also holds entries that were asked only controls; so
    does `predictions`. `apart` are the reasons for excluding entries from ranks, `on_private` the results on a private
    seed, `failures` the entries that failed, and why. `data_version` is that of the maps that were asked about, `about`
    the manifest.
    """

    entries: tuple[Entry, ...]
    scores: dict[str, pd.DataFrame]
    predictions: Mapping[str, StoredAnswers]
    table: pd.DataFrame
    failures: Failures
    with_calibration: Mapping[str, pd.DataFrame] = field(default_factory=dict)
    findings: tuple[Finding, ...] = ()
    falsifiers: tuple[Falsifier, ...] = ()
    verdicts: tuple[Verdict, ...] = ()
    tasks: tuple[TaskManifest, ...] = ()
    remarks: tuple[str, ...] = ()
    protection: pd.DataFrame = field(default_factory=pd.DataFrame)
    acceptance: pd.DataFrame = field(default_factory=pd.DataFrame)
    judged: Mapping[tuple[str, str], pd.DataFrame] = field(default_factory=dict)
    measured: Mapping[str, Mapping[str, float]] = field(default_factory=dict)
    views: Mapping[str, pd.DataFrame] = field(default_factory=dict)
    truths: Mapping[str, Truth] = field(default_factory=dict)
    everyone: tuple[Entry, ...] = ()
    apart: Mapping[str, str] = field(default_factory=dict)
    on_private: OnPrivate = field(default_factory=OnPrivate)
    about: BoardManifest = field(default_factory=lambda: BoardManifest(scorer_version=0, entries=[], tasks=[]))
    data_version: int = DATA_VERSION


def make_extras(request: ScoreRequest, board: Board) -> list[Extra]:
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


def write_files(request: ScoreRequest, board: Board, extras: Sequence[Extra]) -> None:
    """Write a board with its tables, texts and additional files."""
    about = board.about
    scores = pd.concat([frame.assign(matcher=name) for name, frame in board.scores.items()], ignore_index=True)
    queries = queries_of(board.scores)
    steps = steps_frame(board.table, queries, sorted(board.scores))
    write_board(
        request.board,
        tables={
            "leaderboard": board.table,
            "scores": scores,
            "contrasts": CONTRAST_SCHEMA.frame(board.findings),
            "falsifiers": FALSIFIER_SCHEMA.frame(board.falsifiers),
            "controls": CONTROL_SCHEMA.frame(board.verdicts),
            **({PROTECTION: board.protection} if len(board.protection) else {}),
            **({ACCEPTANCE: board.acceptance} if len(board.acceptance) else {}),
        },
        texts={
            "leaderboard.md": board_markdown(
                board.table,
                about,
                findings=board.findings,
                verdicts=board.verdicts,
                falsifiers=board.falsifiers,
                others=(
                    *acceptance_tables(board.acceptance),
                    *step_tables(steps, age_names(ages_frame(steps, queries, board.measured))),
                ),
            ),
            "leaderboard.tex": board_latex(board.table, about, findings=board.findings, verdicts=board.verdicts),
        },
        about=about,
        failed=board.failures.found,
        extras=extras,
    )


def record_of(request: ScoreRequest, board: Board, cards: Sequence[RejectorCard]) -> BoardManifest:
    """Return the manifest of a board."""
    kept = request.kept or BoardManifest(scorer_version=SCORER_VERSION, entries=[], tasks=[])
    return BoardManifest(
        scorer_version=SCORER_VERSION,
        task_version=max((item.task_version for item in board.tasks), default=TASK_VERSION),
        data_version=board.data_version,
        made_by=f"sasgeo-bench {version('sasgeo-bench')}",
        libraries=dict(_libraries()),
        pipeline=request.pipeline,
        title=request.title or kept.title,
        private_seed=seed_of(board.tasks),
        private=board.on_private.seed,
        sealed=dict(request.sealed or kept.sealed),
        split=None if request.split is None else request.split.spec.id,
        draws=request.draws,
        contrasts=list(request.contrasts),
        by_region=sorted(request.by_region),
        by_block=sorted(request.by_block),
        without=sorted(set(request.without)),
        rejectors=[
            RejectorRecord(
                name=card.name,
                version=card.version,
                title=card.title,
                source=card.source,
                licence=card.licence,
                is_calibrated=card.is_calibrated,
            )
            for card in cards
        ],
        remarks=list(board.remarks),
        elsewhere=list(request.elsewhere),
        failed=dict(board.failures.found),
        entries=[_entry_of(entry, board) for entry in board.entries],
        tasks=[
            BoardTask(
                suite=item.suite,
                suite_version=item.suite_version,
                region=item.region,
                map_date=item.map_date,
                queries_sha256=item.queries_sha256,
                map_fingerprint=item.map_fingerprint,
                failed_pictures=item.failed_pictures,
            )
            for item in board.tasks
        ],
    )


def _entry_of(entry: Entry, board: Board) -> BoardEntry:
    return BoardEntry(
        name=entry.name,
        version=entry.version,
        hash=entry.hash,
        how=entry.how,
        card=None if entry.card is None else CardRecord.model_validate(entry.card),
        trained_on=entry.declared,
        set_apart=board.apart.get(entry.name),
        isolation=joined(run.isolation or {} for run in entry.runs) if entry.runs else None,
        learned=[Learned.model_validate(one) for one in entry.learned()],
        private=board.on_private.rows.get(entry.name),
        failed_controls=[item.to_text() for item in failed_controls(board.verdicts, entry.name)],
    )


@cache
def _libraries() -> Mapping[str, str]:
    """Return the versions of Python and of installed libraries that affect results, looked up once."""
    found = {"python": platform.python_version()}
    for name in _LIBRARIES:
        with suppress(PackageNotFoundError):
            found[name] = version(name)
    return found
