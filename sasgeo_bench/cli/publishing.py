# SPDX-License-Identifier: Apache-2.0
"""The command that publishes a board."""

from pathlib import Path
from typing import Annotated

import typer

from sasgeo_bench.cli.console import Out, say, shown_progress, tell
from sasgeo_bench.publishing.archive import board_of
from sasgeo_bench.publishing.build import publish
from sasgeo_bench.publishing.submissions import with_submissions


def publish_command(
    *,
    board: Annotated[Path, typer.Option(help="folder of a board (OUT/boards/<name>), or of stored results")],
    into: Annotated[Path | None, typer.Option(help="folder to write; default: site in the board's folder")] = None,
    submissions: Annotated[
        list[Path] | None,
        typer.Option(
            help="a submission, or a folder of them, to be scored with stored results first: OUT/boards/<id>; may be "
            "repeated"
        ),
    ] = None,
    jobs: Annotated[int, typer.Option(min=1, help="processes that score stored results")] = 1,
    out: Out = Path("out"),
) -> None:
    """Make the static site of a board: plain files that open without a server, to be put on any host."""
    if submissions:
        stored, board = board, out / "boards" / (board_of([board]) or board.resolve().name)
        with_submissions(stored, submissions, board, tell=tell, root=out, jobs=jobs)
    with shown_progress() as progress:
        written = publish(board, into, tell=tell, root=out, jobs=jobs, progress=progress)
    tell(written.to_text())
    say(written.folder / "index.html")
