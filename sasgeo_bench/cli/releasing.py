# SPDX-License-Identifier: Apache-2.0
"""The command that writes a dataset release."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import typer

from sasgeo_bench.cli.console import read_date, say, shown_progress
from sasgeo_bench.cli.options import ExtractFolders, Options, Out
from sasgeo_bench.cli.seeds import SealedSeedFile, sealed_seed
from sasgeo_bench.errors import ConfigError, counted
from sasgeo_bench.experiments.board_queries import BoardRequest, draw_board
from sasgeo_bench.files.paths import given_path
from sasgeo_bench.publishing.release import ReleaseRequest, check_place, make_release
from sasgeo_bench.publishing.release_files import BoardTasks


@dataclass(frozen=True, kw_only=True)
class ReleaseOptions(Options):
    """Flags of release."""

    regions: Annotated[list[str] | None, typer.Option("--regions", help="id of a built region; may be repeated")] = None
    board: Annotated[
        Path | None,
        typer.Option(
            help="stored results of a board, as docs/results/towns: draw its queries and release exactly these"
        ),
    ] = None
    pipeline: Annotated[
        Path | None, typer.Option(help="file of the pipeline that made the board; default: the shipped one")
    ] = None
    extracts: ExtractFolders = None
    sealed_seed_file: SealedSeedFile = None
    jobs: Annotated[int, typer.Option(min=1, help="processes that draw the queries of a board")] = 1
    suites: Annotated[
        list[str] | None,
        typer.Option("--suites", help="name from list suites; may be repeated; default: all there are queries of"),
    ] = None
    split: Annotated[str, typer.Option(help="id or file of the split that the queries were drawn by")] = "crossfit"
    truth: Annotated[bool, typer.Option("--truth", help="put the truths of test queries into it too")] = False
    into: Annotated[Path | None, typer.Option(help="folder of the release; default: OUT/release")] = None
    date: Annotated[str | None, typer.Option(help="day of publication; default: that of the newest map")] = None
    url: Annotated[str | None, typer.Option(help="address where the release will be found")] = None
    out: Out = Path("out")


def release_command(options: ReleaseOptions) -> None:
    """Write regions and queries, or those of a board, as a dataset that others load without this program."""
    day = read_date(options.date)
    _check_flags(options)
    into = given_path(options.into or options.out / "release")
    check_place(into, options.out, url=options.url)
    board = None if options.board is None else _queries_of(options, options.board)
    request = ReleaseRequest(
        regions=tuple(options.regions or ()) if board is None else board.regions,
        suites=tuple(options.suites or ()),
        split=options.split if board is None else board.split,
        with_truth=options.truth,
        out=options.out,
        into=into,
        published=None if day is None else day.isoformat(),
        url=options.url,
        board=board,
    )
    release = make_release(request)
    maps, queries = counted(len(release.maps), "map"), counted(release.queries, "query", "queries")
    suites_said = counted(len(release.suites), "suite")
    say(f"{request.into}: {maps}, {queries} of {suites_said}, {release.bytes / 1e6:.1f} MB")


def _check_flags(options: ReleaseOptions) -> None:
    """Refuse flags that do not go together, before anything is drawn."""
    if (options.board is None) != bool(options.regions) or (options.board and (options.truth or options.suites)):
        raise ConfigError(
            "release takes either --regions, with --suites and --truth, or --board: a board names its queries, and its "
            "truths are in its stored results"
        )


def _queries_of(options: ReleaseOptions, board: Path) -> BoardTasks:
    request = BoardRequest(
        stored=board,
        out=options.out,
        pipeline=options.pipeline,
        extract_folders=tuple(options.extracts or ()),
        sealed=sealed_seed(options.sealed_seed_file),
        jobs=options.jobs,
    )
    with shown_progress():
        return draw_board(request)
