# SPDX-License-Identifier: Apache-2.0
"""The commands that make a submission of answers, and enter a matcher on a published board."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import typer

from sasgeo_bench.boards.elsewhere import elsewhere_lines
from sasgeo_bench.cli.boards import check_controls, show_board
from sasgeo_bench.cli.console import say, shown_progress
from sasgeo_bench.cli.options import ExtractFolders, Options, Out, RegionFolders
from sasgeo_bench.cli.seeds import SealedSeedFile, sealed_seed
from sasgeo_bench.core.errors import ConfigError
from sasgeo_bench.core.progress import tell
from sasgeo_bench.exchange.submissions import SubmitRequest, make_submission
from sasgeo_bench.experiments.entering import EntryRequest, check_entry, cost_lines, enter, failure_lines, plan_entry
from sasgeo_bench.matching.submission import example_card


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


@dataclass(frozen=True, kw_only=True)
class EnterOptions(Options):
    """Flags of enter."""

    board: Annotated[Path, typer.Argument(help="stored results of the board, as docs/results/systems-objects")]
    matcher: Annotated[str, typer.Option(help="name of an installed matcher, or module:Class")]
    into: Annotated[Path | None, typer.Option(help="folder to write; default: submissions/BOARD/NAME")] = None
    pipeline: Annotated[
        Path | None, typer.Option(help="file of the pipeline that made the board; default: the shipped one")
    ] = None
    extracts: ExtractFolders = None
    region_files: RegionFolders = None
    sealed_seed_file: SealedSeedFile = None
    without: Annotated[
        list[str] | None, typer.Option(help="region that is not asked and counts as misses; may be repeated")
    ] = None
    again: Annotated[bool, typer.Option("--again", help="ask queries that were answered before, too")] = False
    jobs: Annotated[int, typer.Option(min=1, help="processes of the matcher")] = 1
    dry_run: Annotated[
        bool, typer.Option("--dry-run", help="check all that can be checked, say what it costs, and stop")
    ] = False
    out: Out = Path("out")


def enter_command(options: EnterOptions) -> None:
    """Enter a board: draw its queries, ask your matcher, show its row, write submissions/BOARD/NAME."""
    request = EntryRequest(
        stored=options.board,
        matcher=options.matcher,
        out=options.out,
        pipeline=options.pipeline,
        extract_folders=tuple(options.extracts or ()),
        region_folders=tuple(options.region_files or ()),
        sealed=sealed_seed(options.sealed_seed_file),
        without=tuple(options.without or ()),
        jobs=options.jobs,
        is_again=options.again,
    )
    entry = plan_entry(request)
    checked = check_entry(entry, into=options.into)
    for line in cost_lines(entry, checked.run):
        (say if options.dry_run else tell)(line)
    if options.dry_run:
        return
    with shown_progress():
        folder, scored = enter(entry, into=options.into)
    show_board(scored.board)
    both = options.out / "boards" / f"{entry.board}-{folder.name}"
    for line in elsewhere_lines(scored.board.about.elsewhere):
        say(line)
    name = checked.run.card.name
    for line in failure_lines(scored.predictions.get(name, {}).values()):
        say(f"{name}: {line}")
    say(folder)
    tell(f"the board of both, without pictures: {both}")
    tell(f"next: look at your row, then open a pull request with {folder}")
    check_controls(scored.board)
