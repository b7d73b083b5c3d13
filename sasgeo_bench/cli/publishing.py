# SPDX-License-Identifier: Apache-2.0
"""Publish a board as a site: the function and its command."""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated

import typer

from sasgeo_bench import progress
from sasgeo_bench.cli.boards import check_controls
from sasgeo_bench.cli.console import say, shown_progress
from sasgeo_bench.cli.options import Options, Out, takes
from sasgeo_bench.leaderboard.board import Board
from sasgeo_bench.progress import tell
from sasgeo_bench.publishing import build
from sasgeo_bench.publishing.archive import board_of
from sasgeo_bench.publishing.site_files import Written
from sasgeo_bench.publishing.submissions import with_submissions


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
    sasgeo_bench.errors.StoreError: out/boards/demo/figures is the board itself, or would be a strange folder in it: \
name another one with --into
    """
    written, board = _published(options)
    for name, why in board.about.failed.items() if board else ():
        progress.tell(f"failed, and so not on the board: {name}: {why}")
    return written


def _published(options: PublishOptions) -> tuple[Written, Board | None]:
    """Score submissions, if any, with the stored results, and make the site; return it and the board of both."""
    folder, board = options.board, None
    if options.submissions:
        folder = options.out / "boards" / (board_of([options.board]) or options.board.resolve().name)
        scored = with_submissions(options.board, options.submissions, folder, root=options.out, jobs=options.jobs)
        board = scored.board
    return build.publish(folder, options.into, root=options.out, jobs=options.jobs), board


def publish_command(options: PublishOptions) -> None:
    """Make the static site of a board: plain files that open without a server, to be put on any host."""
    with shown_progress():
        written, board = _published(replace(options, say=say))
    tell(written.to_text())
    say(written.folder / "index.html")
    if board is not None:
        check_controls(board)
