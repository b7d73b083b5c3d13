# SPDX-License-Identifier: Apache-2.0
"""Publish a board as a site, release its dataset, send and fetch folders: the functions and their commands."""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated

import typer

from sasgeo_bench.boards import publish as build
from sasgeo_bench.boards.archive import board_of
from sasgeo_bench.boards.board import Board
from sasgeo_bench.boards.site_files import Written
from sasgeo_bench.cli.boards import check_controls
from sasgeo_bench.cli.console import read_date, say, shown_progress
from sasgeo_bench.cli.options import ExtractFolders, Options, Out, takes
from sasgeo_bench.cli.seeds import SealedSeedFile, sealed_seed
from sasgeo_bench.core import progress
from sasgeo_bench.core.errors import ConfigError, counted
from sasgeo_bench.core.paths import given_path
from sasgeo_bench.core.progress import tell
from sasgeo_bench.core.storage import Moved, fetch, send, shown
from sasgeo_bench.exchange.release import ReleaseRequest, check_place, make_release
from sasgeo_bench.exchange.release_files import BoardTasks
from sasgeo_bench.exchange.submissions import with_submissions
from sasgeo_bench.experiments.board_queries import BoardRequest, draw_board


@dataclass(frozen=True, kw_only=True)
class PublishOptions(Options):
    """Flags of publish."""

    board: Annotated[Path, typer.Option(help="folder of a board (OUT/boards/<name>), or of stored results")]
    into: Annotated[Path | None, typer.Option(help="folder to write; default: site in the board's folder")] = None
    submissions: Annotated[
        list[Path] | None,
        typer.Option(
            help="a submission, or a folder of them, to be scored with stored results first: OUT/boards/<id>; may be "
            "repeated"
        ),
    ] = None
    jobs: Annotated[int, typer.Option(min=1, help="processes that score stored results")] = 1
    tables_only: Annotated[
        bool,
        typer.Option(
            "--tables-only",
            help="score nothing: a site of the tables as they are, in seconds, without the figures that take answers, "
            "pictures and files",
        ),
    ] = False
    out: Out = Path("out")


@takes(PublishOptions)
def publish(options: PublishOptions) -> Written:
    """Make the static site of a board: plain files that open without a server.

    Submissions that have a fault are left out, with a line about each.

    Returns
    -------
    Written
        `folder` is where the site is; `index.html` in it is the first page.

    Raises
    ------
    StoreError
        If there is no sound board, or the site cannot be written; an older site is then as it was.
    ConfigError
        If the board is of a private seed.

    Examples
    --------
    >>> import sasgeo_bench as sgb
    >>> sgb.publish(board="out/boards/demo", into="out/boards/demo/figures")
    Traceback (most recent call last):
        ...
    sasgeo_bench.core.errors.StoreError: out/boards/demo/figures is the board itself, or would be a strange folder in \
it: name another one with --into
    """
    written, board = _published(options)
    for name, why in board.about.failed.items() if board else ():
        progress.tell(f"failed, and so not on the board: {name}: {why}")
    return written


def _published(options: PublishOptions) -> tuple[Written, Board | None]:
    """Score submissions, if any, with the stored results, and make the site; return it and the board of both."""
    folder, board = options.board, None
    if options.submissions and options.tables_only:
        raise ConfigError("--tables-only scores nothing, and --submissions have to be scored: leave one out")
    if options.submissions:
        folder = options.out / "boards" / (board_of([options.board]) or options.board.resolve().name)
        scored = with_submissions(options.board, options.submissions, folder, root=options.out, jobs=options.jobs)
        board = scored.board
    site = build.publish(folder, options.into, root=options.out, jobs=options.jobs, tables_only=options.tables_only)
    return site, board


def publish_command(options: PublishOptions) -> None:
    """Make the static site of a board: plain files that open without a server, to be put on any host."""
    with shown_progress():
        written, board = _published(replace(options, say=say))
    tell(written.to_text())
    say(written.folder / "index.html")
    if board is not None:
        check_controls(board)


@dataclass(frozen=True, kw_only=True)
class ReleaseOptions(Options):
    """Flags of release."""

    regions: Annotated[list[str] | None, typer.Option("--regions", help="id of a built region; may be repeated")] = None
    board: Annotated[
        Path | None,
        typer.Option(
            help="stored results of a board, as docs/results/systems-objects: draw and release exactly its queries"
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
    suites_text = counted(len(release.suites), "suite")
    say(f"{request.into}: {maps}, {queries} of {suites_text}, {release.bytes / 1e6:.1f} MB")


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


Url = Annotated[str, typer.Argument(help="place of the folder itself, as s3://bucket/regions/vaduz (fsspec)")]


@dataclass(frozen=True, kw_only=True)
class SendOptions(Options):
    """Words of send."""

    folder: Annotated[Path, typer.Argument(help="folder of a region, task, run or board, or all of an OUT")]
    url: Url


@dataclass(frozen=True, kw_only=True)
class FetchOptions(Options):
    """Words of fetch."""

    url: Url
    folder: Annotated[Path, typer.Argument(help="folder to write, in place of an older copy")]


def send_command(options: SendOptions) -> None:
    """Copy a finished folder into object storage; files that are there already are not sent again."""
    moved = send(options.folder, options.url)
    say(f"{shown(options.url)}: {_text(moved, 'sent')}")


def fetch_command(options: FetchOptions) -> None:
    """Copy a folder that was sent out of object storage, each file held against its hash."""
    moved = fetch(options.url, options.folder)
    say(f"{options.folder}: {_text(moved, 'fetched')}")


def _text(moved: Moved, verb: str) -> str:
    hidden = f"; {counted(moved.hidden, 'hidden file')} left out" if moved.hidden else ""
    return f"{counted(moved.files, 'file')}, {moved.bytes / 1e6:.1f} MB, {moved.moved} {verb}{hidden}"
