# SPDX-License-Identifier: Apache-2.0
"""Commands for authors of answers: validate them against tasks, and make a submission of them."""

from collections.abc import Iterable
from pathlib import Path
from typing import Annotated, Final

import typer

from sasgeo_bench.cli.console import EXIT_USER, complain, say, tell
from sasgeo_bench.errors import ConfigError, counted
from sasgeo_bench.matching.submission import example_card
from sasgeo_bench.publishing.archive import laid_tasks
from sasgeo_bench.publishing.submissions import SubmitRequest, hold_submission, make_submission
from sasgeo_bench.running.prediction_files import parts_of
from sasgeo_bench.scoring.submission_files import SUBMISSION, is_submission
from sasgeo_bench.scoring.validate import Violation, set_aside, validate
from sasgeo_bench.tasks.task_files import Task

MOST_MISSING: Final = 5  # queries without a row that are named; the others are counted

BoardTasks = Annotated[
    list[Path] | None,
    typer.Option("--tasks", "--for", help="task folder, or stored results of a board; may be repeated"),
]


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
    """Put predictions, card, versions and hashes into a folder that validate accepts: SUBMISSIONS/NAME."""
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
    tell(f"next: validate --predictions {folder} --for {board}; then open a pull request with the folder")


def validate_command(
    *,
    predictions: Annotated[Path, typer.Option(help="predictions file, the folder of a run, or a submission")],
    tasks: BoardTasks = None,
) -> None:
    """List everything in which predictions are not what the tasks ask for, and count queries without a row."""
    if is_submission(predictions):
        _validate_submission(predictions, tasks or [])
        return
    if not predictions.exists():
        raise ConfigError(
            f"there is no file or folder {predictions}: name a predictions file, the folder of a run, or a submission"
        )
    if not parts_of(predictions):
        raise ConfigError(
            f"{predictions} holds neither a run (part-*.parquet) nor a submission ({SUBMISSION}): name the folder of "
            "one, a predictions file, or make a submission by 'submit'"
        )
    if not tasks:
        raise ConfigError("validate needs --tasks: name task folders, or the stored results of a board")
    with laid_tasks(tasks) as folders:
        asked = [Task.open(folder) for folder in folders]
        _show(validate(predictions, asked), predictions)
        aside = set_aside(predictions, asked)
    rest = f"{counted(aside, 'answer')} to other queries set aside" if aside else "and nothing else"
    say(f"{predictions}: answers every query of {counted(len(folders), 'task')}, {rest}")


def _show(faults: Iterable[Violation], predictions: Path) -> None:
    """Print faults, of many queries without a row the first, and end if there are any."""
    count = missing = 0
    for violation in faults:
        count += 1
        missing += violation.is_missing_row
        if missing <= MOST_MISSING or not violation.is_missing_row:
            say(violation.to_text())
    if missing > MOST_MISSING:
        more = counted(missing - MOST_MISSING, "more query", "more queries")
        say(f"{predictions.name}, query_id: found no row for {more}, expected one for every query")
    if count:
        complain(f"{predictions}: {counted(count, 'violation')}")
        raise typer.Exit(EXIT_USER)


def _validate_submission(folder: Path, tasks: list[Path]) -> None:
    """Validate a submission: queries without a row are no faults but misses, which are reported."""
    submission, found = hold_submission(folder, tasks)
    _show([fault for fault in found if not fault.is_missing_row], folder)
    missing = len(found)
    misses = f", {counted(missing, 'query', 'queries')} without a row count as misses" if missing else ""
    against = "" if tasks else "; its rows were held against no queries (--for names the stored results of its board)"
    say(
        f"{folder}: a sound submission of {submission.card.name} {submission.card.version} to {submission.board}, "
        f"{counted(len(submission.tasks), 'task')}{misses}{against}"
    )
