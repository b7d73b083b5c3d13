# SPDX-License-Identifier: Apache-2.0
"""Commands that run matchers, check their predictions and score them."""

import re
import sys
from pathlib import Path
from typing import Annotated, Final

import pandas as pd
import typer
from rich.table import Table

from sasgeo_bench.boards import ScoreRequest, make_board
from sasgeo_bench.cli.console import EXIT_USER, Bars, Out, RegionFolders, print_table, tell
from sasgeo_bench.errors import ConfigError
from sasgeo_bench.metrics.intervals import DRAWS
from sasgeo_bench.report.text import summary, warnings_of
from sasgeo_bench.run.plan import RunRequest, plan_run
from sasgeo_bench.run.runner import run
from sasgeo_bench.run.worker import Limits
from sasgeo_bench.split import Split, make_split
from sasgeo_bench.store.catalog import find_split_file, list_region_files, read_region_file, read_split_file
from sasgeo_bench.store.rundir import merge_runs
from sasgeo_bench.validate import validate

BOARD_NAME: Final = re.compile(r"[A-Za-z0-9][A-Za-z0-9_-]*")


def run_command(  # noqa: PLR0913 - a command has as many flags as its users need
    *,
    matcher: Annotated[str, typer.Option(help="name from list-matchers, or module:Class")],
    tasks: Annotated[list[Path], typer.Option(help="task folder, OUT/tasks/SUITE/REGION; may be repeated")],
    top_k: Annotated[int, typer.Option(help="poses asked of each query")] = 25,
    jobs: Annotated[int, typer.Option(help="processes at once")] = 1,
    dask: Annotated[
        str | None, typer.Option(help="address of a dask scheduler, or local:N for N processes of this machine")
    ] = None,
    shard: Annotated[str, typer.Option(help="i/n: answer the i-th of n parts of the queries")] = "1/1",
    limit: Annotated[int | None, typer.Option(help="queries of each task at most")] = None,
    match_s: Annotated[float, typer.Option(help="seconds for one query")] = Limits().match_s,
    prepare_s: Annotated[float, typer.Option(help="seconds for one map")] = Limits().prepare_s,
    memory_mb: Annotated[int, typer.Option(help="MiB for all processes of the matcher")] = Limits().memory_bytes
    // 2**20,
    again: Annotated[list[str] | None, typer.Option(help="ask rows of this status again, as in timeout")] = None,
    trusted: Annotated[bool, typer.Option("--trusted", help="do not shut the matcher in; run.json says so")] = False,
    dry_run: Annotated[bool, typer.Option("--dry-run", help="say what is left to do, and stop")] = False,
    out: Out = Path("out"),
) -> None:
    """Ask a matcher every query of some tasks; goes on where an earlier run was cut off."""
    request = RunRequest(
        spec=matcher,
        tasks=tasks,
        out=out,
        top_k=top_k,
        limits=Limits(match_s=match_s, prepare_s=prepare_s, memory_bytes=memory_mb * 2**20),
        jobs=jobs,
        dask=dask,
        shard=_shard(shard),
        limit=limit,
        again=tuple(again or ()),
        is_shut_in=not trusted,
    )
    plan = plan_run(request)
    if dry_run:
        typer.echo(plan.to_text())
        return
    if sys.stderr.isatty():
        with Bars() as bars:
            report = run(plan, tell=tell, progress=bars)
    else:
        report = run(plan, tell=tell)
    counts = ", ".join(f"{count} {status}" for status, count in sorted(report.counts.items())) or "nothing left"
    tell(f"{plan.card.name} {plan.card.version}: {counts}")
    for folder in report.folders:
        typer.echo(str(folder))


def _shard(text: str) -> tuple[int, int]:
    index, _, count = text.partition("/")
    if not (index.isdecimal() and count.isdecimal() and text.isascii()):
        message = f"--shard must be i/n, as in 1/2, got {text!r}"
        raise ConfigError(message)
    return int(index), int(count)


def merge_command(
    *,
    runs: Annotated[list[Path], typer.Option(help="folder of parts, or file; may be repeated")],
    into: Annotated[Path, typer.Option(help="predictions file to write")],
) -> None:
    """Put the parts of a run, shards of several machines included, into one predictions file, sorted by query."""
    count = merge_runs(runs, into)
    typer.echo(f"{into}: {count} predictions")


def validate_command(
    *,
    predictions: Annotated[Path, typer.Option(help="predictions file, or the folder of a run")],
    tasks: Annotated[list[Path], typer.Option(help="task folder; may be repeated")],
) -> None:
    """List everything in which predictions are not what the tasks ask for."""
    count = 0
    for violation in validate(predictions, tasks):
        typer.echo(violation.to_text())
        count += 1
    if count:
        tell(f"{predictions}: {count} violations")
        raise typer.Exit(EXIT_USER)
    typer.echo(f"{predictions}: answers every query of {len(tasks)} tasks, and nothing else")


def score_command(  # noqa: PLR0913 - a command has as many flags as its users need
    *,
    predictions: Annotated[
        list[Path], typer.Option(help="folder with runs in it, or file of predictions; may be repeated")
    ],
    tasks: Annotated[
        list[Path] | None, typer.Option(help="task folder; may be repeated; default: all that are answered")
    ] = None,
    truth: Annotated[
        Path | None, typer.Option(help="folder of the truths, beside the tasks; default: OUT/truth")
    ] = None,
    name: Annotated[str, typer.Option(help="of the board: OUT/boards/NAME")] = "board",
    split: Annotated[str, typer.Option(help="id of a shipped split, or a file of your own (*.toml)")] = "crossfit",
    rejector: Annotated[
        list[str] | None, typer.Option(help="name from list-rejectors, or module:Class; may be repeated")
    ] = None,
    region_folders: RegionFolders = None,
    draws: Annotated[int, typer.Option(min=100, help="of the bootstrap")] = DRAWS,
    out: Out = Path("out"),
) -> None:
    """Hold predictions against the truths and write a board: OUT/boards/NAME/leaderboard.parquet and more."""
    if not BOARD_NAME.fullmatch(name):
        message = f"--name must hold letters, digits, hyphens and underscores, got {name!r}"
        raise ConfigError(message)
    request = ScoreRequest(
        predictions=predictions,
        tasks=tasks or (),
        root=out if truth is None else truth.resolve().parent,
        split=_split(split, region_folders or []),
        rejectors=rejector or (),
        board=out / "boards" / name,
        draws=draws,
    )
    board = make_board(request, tell=tell)
    show_board(board.table)
    typer.echo(str(request.board))


def _split(name: str, folders: list[Path]) -> Split:
    grids = {item: read_region_file(path).grid() for item, path in list_region_files(folders=folders).items()}
    return make_split(read_split_file(find_split_file(name)), grids)


def show_board(table: pd.DataFrame) -> None:
    """Print what a board says in short, one table for each track and prior group."""
    for title, short in summary(table):
        typer.echo(title)
        shown = Table(*map(str, short.columns), box=None, pad_edge=False)
        for row in short.itertuples(index=False):
            shown.add_row(*map(str, row))
        print_table(shown)
    for line in warnings_of(table):
        tell(line)
