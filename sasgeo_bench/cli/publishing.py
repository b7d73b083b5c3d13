# SPDX-License-Identifier: Apache-2.0
"""The command that publishes a board."""

from pathlib import Path
from typing import Annotated

import typer

from sasgeo_bench.cli.console import tell
from sasgeo_bench.publish import publish


def publish_command(
    *,
    board: Annotated[Path, typer.Option(help="folder of a board (OUT/boards/<name>), or of stored results")],
    into: Annotated[Path | None, typer.Option(help="folder to write; default: site in the board's folder")] = None,
) -> None:
    """Make the static site of a board: plain files that open without a server, to be put on any host."""
    written = publish(board, into, tell=tell)
    tell(written.to_text())
    typer.echo(str(written.folder / "index.html"))
