# SPDX-License-Identifier: Apache-2.0
"""The two outlets of a command, progress bars, and reading of dates."""

import datetime as dt
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from types import TracebackType
from typing import Any, Final, Self

import typer
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TaskID, TextColumn, TimeRemainingColumn
from rich.table import Table
from rich.text import Text

from sasgeo_bench.errors import ConfigError
from sasgeo_bench.texts import plain, plain_lines

EXIT_USER: Final = 2  # exit status
CONTESTANT_FAILED: Final = 4
PIPE_WIDTH: Final = 200


class _PlainConsole(Console):
    """A console that shows every text as it is: no markup, no names of emoji, no characters that steer a terminal."""

    def render_str(self, text: str, **options: Any) -> Text:  # noqa: ANN401 - whatever rich asks for
        """Any text on its way to the terminal, cells of tables among them."""
        return super().render_str(plain_lines(text), **{**options, "markup": False, "emoji": False})


errors = _PlainConsole(stderr=True, soft_wrap=True, highlight=False)


def read_date(text: str | None) -> dt.date | None:
    """Read the value of --date, None where it was left out."""
    return read_day(text, flag="--date") if text else None


def read_day(text: str, *, flag: str) -> dt.date:
    """Read a day as in 2021-10-28; a refusal names the flag."""
    try:
        return dt.date.fromisoformat(text)
    except ValueError as error:
        message = f"{flag} must be a date as in 2021-10-28, got {text!r}"
        raise ConfigError(message) from error


def tell(line: str) -> None:
    """Print one line to stderr."""
    errors.print(plain(line))


def say(result: object) -> None:
    """Print a result to stdout: a path, or some lines."""
    typer.echo(plain_lines(str(result)))


class Bars:
    """Progress as a bar for each piece of work, for a terminal."""

    def __init__(self) -> None:
        columns = (
            TextColumn("{task.description}", markup=False),
            BarColumn(),
            MofNCompleteColumn(),
            TextColumn("{task.fields[rate]}"),
            TimeRemainingColumn(),
        )
        self._bars = Progress(*columns, console=errors)
        self._tasks: dict[str, TaskID] = {}

    def __enter__(self) -> Self:
        """Show the bars from here on."""
        self._bars.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Leave them as they are."""
        self._bars.stop()

    def begin(self, label: str, total: int) -> None:
        """Add a bar."""
        self._tasks[label] = self._bars.add_task(plain(label), total=total, rate="")

    def advance(self, label: str, count: int) -> None:
        """Move a bar on."""
        task = self._tasks[label]
        self._bars.advance(task, count)
        speed = self._bars.tasks[self._bars.task_ids.index(task)].speed
        self._bars.update(task, rate="" if speed is None else f"{speed:.1f}/s")


@contextmanager
def shown_progress() -> Iterator[Bars | None]:
    """Yield bars on a terminal, None elsewhere: lines do there."""
    if not sys.stderr.isatty():
        yield None
        return
    with Bars() as bars:
        yield bars


def print_table(table: Table) -> None:
    """Print to stdout: as wide as the terminal there, unwrapped into a file or pipe."""
    console = _PlainConsole(highlight=False, width=None if sys.stdout.isatty() else PIPE_WIDTH)
    with console.capture() as captured:
        console.print(table)
    typer.echo("\n".join(line.rstrip() for line in captured.get().splitlines()) + "\n")
