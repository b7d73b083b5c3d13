# SPDX-License-Identifier: Apache-2.0
"""Command `submit`: make a submission of answers."""

from pathlib import Path
from typing import Annotated

import typer

from sasgeo_bench.cli.console import say
from sasgeo_bench.errors import ConfigError
from sasgeo_bench.matching.submission import example_card
from sasgeo_bench.progress import tell
from sasgeo_bench.publishing.submissions import SubmitRequest, make_submission


def submit_command(
    *,
    predictions: Annotated[
        Path | None, typer.Option(help="predictions file, or the folder of a matcher's runs")
    ] = None,
    card: Annotated[Path | None, typer.Option(help="card, a .toml file (--example-card prints one)")] = None,
    board: Annotated[
        Path | None,
        typer.Option(
            "--for",
            help="stored results of the board, as docs/results/systems-objects; leaderboard --results stores some",
        ),
    ] = None,
    into: Annotated[Path | None, typer.Option(help="folder to write; default: submissions/BOARD/NAME")] = None,
    example: Annotated[bool, typer.Option("--example-card", help="print a card to begin with, and stop")] = False,
) -> None:
    """Put predictions, card, versions and hashes into a folder that verify accepts: SUBMISSIONS/NAME."""
    if example:
        typer.echo(example_card(), nl=False)
        return
    if predictions is None or card is None or board is None:
        needed = {"--predictions": predictions, "--card": card, "--for": board}
        lacking = [flag for flag, value in needed.items() if value is None]
        raise ConfigError(
            f"submit needs {' and '.join(lacking)}: name the answers, the card and the stored results of the board"
        )
    folder = make_submission(SubmitRequest(predictions=predictions, card=card, board=board, into=into))
    say(str(folder))
    tell(f"next: verify {folder} --for {board}; then open a pull request with the folder")
