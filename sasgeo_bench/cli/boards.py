# SPDX-License-Identifier: Apache-2.0
"""Score predictions and carry out experiments: the function and the commands."""

import os
import re
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Final

import typer

from sasgeo_bench.boards.archive import board_of, request_of, score_all
from sasgeo_bench.boards.archive_file import is_pack
from sasgeo_bench.boards.board import Board
from sasgeo_bench.boards.cases import own_lines
from sasgeo_bench.boards.manifests import SeedRecord
from sasgeo_bench.boards.overview import overview_lines, overviews_of
from sasgeo_bench.boards.pipeline_spec import ArchiveSpec, find_pipeline_file, read_pipeline_file
from sasgeo_bench.boards.private_board import check_public, read_private
from sasgeo_bench.boards.text import (
    TERMINAL,
    Contents,
    contrast_lines,
    control_lines,
    map_lines,
    metric_lines,
    rows_of,
    sandbox_lines,
    segmenter_lines,
    table_text,
    warnings_of,
)
from sasgeo_bench.cli.console import CONTESTANT_FAILED, complain, print_table, read_day, say, shown_progress
from sasgeo_bench.cli.options import Dask, ExtractFolders, Options, Out, RegionFolders, takes
from sasgeo_bench.cli.seeds import SealedSeedFile, SeedFile, private_seed, sealed_seed
from sasgeo_bench.core.errors import ConfigError, StoreError, counted
from sasgeo_bench.core.progress import tell
from sasgeo_bench.exchange.submissions import submissions_for
from sasgeo_bench.experiments.head_start import packed_for, unpack_head_start
from sasgeo_bench.experiments.pipeline import run_pipeline
from sasgeo_bench.experiments.pipeline_plan import board_folder, plan_pipeline
from sasgeo_bench.experiments.sealed import check_day
from sasgeo_bench.running.failures import log_beside
from sasgeo_bench.scoring.intervals import DRAWS
from sasgeo_bench.scoring.requirements import own_metrics, parse_requirements
from sasgeo_bench.tasks.task_files import TRUTH

CONTROL_FAILED: Final = 3  # exit status


def _folder(text: str) -> Path:
    """Refuse an empty name, which would be taken for the folder one is in."""
    if not text:
        raise StoreError("--results names no folder: name one, as in docs/results")
    return Path(text)


Cases = Annotated[
    bool, typer.Option("--cases/--no-cases", help="show queries that went wrong on the board, with their truths")
]
Results = Annotated[
    Path | None,
    typer.Option(
        help="folder to store the board in with all it was made of, at most 24 MB: DIR/<name of the board>/",
        parser=_folder,
        metavar="PATH",
    ),
]
Rejectors = Annotated[
    list[str] | None,
    typer.Option(
        help="name from list rejectors, or module:Class; may be repeated; default: none, or those of stored results"
    ),
]
Metrics = Annotated[
    list[str] | None,
    typer.Option(help="one more than every board has: a name from list metrics, or module:NAME; may be repeated"),
]
Within = Annotated[
    list[str] | None,
    typer.Option(
        help="one more metric: share within metres, degrees or both, as in 5m,2deg; may be repeated; default: none, or "
        "those of stored results"
    ),
]
Require = Annotated[
    list[str] | None,
    typer.Option(
        help="requirements that each entry passes or fails, as in '80% within 50 m, p95 latency 400 ms, false <= 1%'; "
        "may be repeated; default: none, or those of stored results"
    ),
]
Submissions = Annotated[
    list[Path] | None,
    typer.Option(help="a submission, or a folder of them, for stored results; those for their board are scored"),
]
Private = Annotated[
    Path | None,
    typer.Option(
        help="board of a private seed of the same pipeline, OUT/private/boards/<id>: rows that agree are marked as "
        "reproduced"
    ),
]
BOARD_NAME: Final = re.compile(r"[A-Za-z0-9][A-Za-z0-9_-]{0,99}")


@dataclass(frozen=True, kw_only=True)
class ScoreOptions(Options):
    """Flags of score."""

    predictions: Annotated[
        list[Path],
        typer.Option(help="folder with runs in it or of stored results, or file of predictions; may be repeated"),
    ]
    tasks: Annotated[
        list[Path] | None, typer.Option(help="task folder; may be repeated; default: all that are answered")
    ] = None
    truth: Annotated[Path | None, typer.Option(help="folder of the truths of the tasks; default: OUT/truth")] = None
    name: Annotated[str, typer.Option(help="of the board: OUT/boards/NAME")] = "board"
    split: Annotated[
        str | None,
        typer.Option(
            help="id of a shipped split, or a file of your own (*.toml); default: crossfit, or that of stored results"
        ),
    ] = None
    rejector: Rejectors = None
    metric: Metrics = None
    within: Within = None
    require: Require = None
    submissions: Submissions = None
    private: Private = None
    region_files: RegionFolders = None
    without: Annotated[
        list[str] | None, typer.Option(help="region whose queries are left out, on each of its maps; may be repeated")
    ] = None
    draws: Annotated[
        int | None,
        typer.Option(min=100, help=f"of the bootstrap; default: {DRAWS}, or as many as of stored results"),
    ] = None
    jobs: Annotated[int, typer.Option(min=1, help="processes that fit rejectors")] = 1
    dask: Dask = None
    results: Results = None
    cases: Cases = True
    out: Out = Path("out")


@takes(ScoreOptions)
def score(options: ScoreOptions) -> Board:
    """Score predictions against the truths and write a board: `out/boards/<name>/leaderboard.parquet` and more.

    Returns
    -------
    Board
        `leaderboard` holds every figure, `scores` the row of each matcher and query, `controls` which of them hold.

    Raises
    ------
    ConfigError
        If a name is not sound, or nothing is left to score.
    StoreError
        If predictions, tasks or truths are missing or damaged.

    Examples
    --------
    >>> import sasgeo_bench as sgb
    >>> board = sgb.score(predictions="out/runs", name="mine", jobs=2)  # doctest: +SKIP
    >>> board.leaderboard[["matcher", "track", "recall_1"]]  # doctest: +SKIP
    """
    _check_names(options.name, options.truth)
    if options.truth is not None and not any(map(is_pack, options.predictions)):  # stored results hold their truths
        _check_truths(options.truth)
    submissions = options.submissions
    submitted = submissions_for(board_of(options.predictions), submissions) if submissions else ()
    usual = request_of(
        options.predictions,
        board=options.out / "boards" / options.name,
        root=options.out if options.truth is None else options.truth.resolve().parent,
        split=options.split,
        folders=options.region_files or (),
        rejectors=options.rejector or (),
    )
    request = replace(
        usual,
        tasks=options.tasks or (),
        metrics=options.metric or (),
        within=options.within or usual.within,
        require=options.require or usual.require,
        truth=options.truth,
        draws=options.draws or usual.draws,
        without=options.without or (),
        submissions=submitted,
        private=options.private,
        jobs=options.jobs,
        dask=options.dask,
    )
    return score_all(request, has_cases=options.cases, results=options.results).board


def score_command(options: ScoreOptions) -> None:
    """Score predictions against the truths and write a board: OUT/boards/NAME/leaderboard.parquet and more."""
    with shown_progress():
        board = score(**vars(options))
    show_board(board)
    folder = options.out / "boards" / options.name
    say(folder)
    tell(_how_to_publish(folder))
    check_controls(board)


def _check_names(name: str, truth: Path | None) -> None:
    if not BOARD_NAME.fullmatch(name):
        raise ConfigError(f"--name must hold letters, digits, hyphens and underscores, 100 at most, got {name!r}")
    if truth is not None and not truth.is_dir():
        raise ConfigError(f"--truth names {truth}, where there is no folder: name the one that holds the truths")


def _check_truths(truth: Path) -> None:
    if next(truth.glob(f"*/*/{TRUTH}"), None) is None:
        raise ConfigError(
            f"--truth names {truth}, which holds no truths (SUITE/REGION/{TRUTH}): "
            "name the folder that make-queries put them into, as out/truth"
        )


@dataclass(frozen=True, kw_only=True)
class LeaderboardOptions(Options):
    """Flags of leaderboard."""

    pipeline: Annotated[str, typer.Argument(help="id of a shipped pipeline, or a file of your own (*.toml)")]
    matcher: Annotated[
        list[str] | None,
        typer.Option(help="in addition to those of the file: a name, or module:Class; may be repeated"),
    ] = None
    extracts: ExtractFolders = None
    region_files: RegionFolders = None
    jobs: Annotated[int, typer.Option(min=1, help="processes of each matcher")] = 1
    dask: Dask = None
    seed_file: SeedFile = None
    sealed_seed_file: SealedSeedFile = None
    opened: Annotated[
        str | None, typer.Option(help="day on which sealed places are opened, as in 2026-11-23; default: today (UTC)")
    ] = None
    within: Within = None
    require: Require = None
    private: Private = None
    results: Results = None
    trusted: Annotated[bool, typer.Option("--trusted", help="run without the sandbox; the board states it")] = False
    dry_run: Annotated[bool, typer.Option("--dry-run", help="say what is up to date and what is left, and stop")] = (
        False
    )
    cases: Cases = True
    out: Out = Path("out")


def leaderboard_command(options: LeaderboardOptions) -> None:
    """Carry out an experiment: draw its queries, run its matchers, score them, write OUT/boards/<id>/."""
    file = find_pipeline_file(options.pipeline)
    spec = read_pipeline_file(file)
    opened = None if options.opened is None else read_day(options.opened, flag="--opened")
    own_metrics(options.within or (), parse_requirements(options.require or ()))  # before hours of runs
    _begin(file, spec.archive, options)
    added = [name for name in dict.fromkeys(options.matcher or ()) if name not in spec.matchers]
    plan = plan_pipeline(
        spec.model_copy(update={"matchers": [*dict.fromkeys(spec.matchers), *added]}),
        out=options.out,
        extract_folders=tuple(options.extracts or ()),
        region_folders=tuple(options.region_files or ()),
        private=private_seed(options.seed_file),
        sealed=sealed_seed(options.sealed_seed_file),
    )
    plan = replace(
        plan,
        jobs=options.jobs,
        dask=options.dask,
        within=options.within or (),
        require=options.require or (),
        is_sandboxed=not options.trusted,
        added=added,
    )
    if opened is not None:
        if plan.seal is None or plan.seal.seed is None:
            raise ConfigError(
                "--opened is the day on which sealed places are opened: give --sealed-seed-file, too, or leave it out"
            )
        check_day(opened, plan.seal, plan.seal.openings)
    if options.dry_run:
        tell(f"reading the cards of {counted(len(plan.matchers), 'matcher')}: a second or two each")
        say(plan.to_text())
        return
    processors = os.cpu_count() or 1
    if options.jobs == 1 < processors and options.dask is None:
        tell(f"one process asks each matcher: --jobs {processors} uses the processors of this machine")
    results, private = options.results, options.private
    if plan.private is not None and (results is not None or private is not None):
        seed = SeedRecord(commitment=plan.private.commitment, bits=plan.private.bits)
        check_public(seed, str(board_folder(plan)))
    if private is not None:
        read_private(private, plan.spec.identity)
    with shown_progress():
        board = run_pipeline(plan, results=results, has_cases=options.cases, private=private, opened=opened).board
    show_board(board)
    say(board_folder(plan))
    if plan.private is not None:
        tell(f"next: sasgeo-bench score --predictions docs/results/{spec.id} --private {board_folder(plan)}")
        check_controls(board)
        return
    tell(_how_to_publish(board_folder(plan)))
    if not options.matcher:
        more = f"sasgeo-bench leaderboard {options.pipeline} --matcher NAME"
        tell(f"next: {more} adds one of yours (new matcher begins one)")
    check_controls(board)


def _how_to_publish(folder: Path) -> str:
    return f"next: sasgeo-bench publish --board {folder} makes a site of it"


def check_controls(board: Board) -> None:
    """End with a status that a script sees where a control or a contestant failed; the board is written though."""
    for name, why in board.about.failed.items():
        complain(f"failed, and so not on the board: {name}: {why}")
    unseen = segmenter_lines(board.about)
    for line in unseen:
        complain(line)
    log = log_beside(board.folder)
    if board.about.failed and log.is_file():
        complain(f"where it failed stands in {log}")
    failed = [item for item in board.verdicts if not item.holds]
    if any(item.is_of_board for item in failed):
        raise typer.Exit(CONTROL_FAILED)
    if board.about.failed or failed or unseen:
        raise typer.Exit(CONTESTANT_FAILED)


def _begin(file: Path, stated: ArchiveSpec | None, options: LeaderboardOptions) -> None:
    """Lay down answers packed beside a pipeline file, or say so; queries of a private seed are never packed."""
    if options.seed_file:
        return
    if not options.dry_run:
        unpack_head_start(file, stated, options.out)
        return
    packed = packed_for(file, stated)
    if packed is not None:
        tell(f"{packed.name} beside the file is unpacked first: what it holds counts below as not there yet")


def show_board(board: Board) -> None:
    """Print what a board says in short: who is good at what, and what came of the contrasts; its files say the rest."""
    shown = Contents(
        leaderboard=board.leaderboard,
        within=board.about.within,
        require=board.about.require,
        added=board.about.added,
        requirements=board.requirements,
    )
    for table in rows_of(shown, TERMINAL):
        say(table.title)
        print_table(table_text(table))
    for item in overviews_of(shown.book):
        say(item.shown.title)
        print_table(table_text(item.shown))
        for line in (*overview_lines(item), *filter(None, (item.trust(board.leaderboard, board.acceptance),))):
            say(line)
    for line in contrast_lines(board.findings):
        say(line)
    for line in control_lines(board.verdicts):
        (tell if all(item.holds for item in board.verdicts) else complain)(line)
    turned = own_lines(board.scores)
    about = board.about
    warnings = (*map_lines(about), *sandbox_lines(about), *warnings_of(board.leaderboard), *metric_lines(about))
    for line in (*turned, *warnings):
        tell(line)
