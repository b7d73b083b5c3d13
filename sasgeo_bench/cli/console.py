# SPDX-License-Identifier: Apache-2.0
"""The outlets of a command (stdout, stderr, a log file), its progress, and reading of dates."""

import datetime as dt
import math
import os
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from threading import Event, Thread
from types import TracebackType
from typing import Any, Final, Self

import typer
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, TaskID, TextColumn, TimeRemainingColumn
from rich.progress import Progress as RichProgress
from rich.table import Table
from rich.text import Text

from sasgeo_bench.core import progress
from sasgeo_bench.core.errors import ConfigError, StoreError
from sasgeo_bench.core.texts import plain, plain_lines

EXIT_USER: Final = 2  # exit status
CONTESTANT_FAILED: Final = 4
PIPE_WIDTH: Final = 240
LOG: Final = "SASGEO_LOG"  # variable with the file that lines are appended to
_FIRST_S: Final = 3.0  # a command that is silent for longer says that it is at work
_LATE: Final = 1.5  # times the usual pause between two lines of progress
_LONGEST_SILENCE_S: Final = 60.0


class _PlainConsole(Console):
    """A console that shows every text as it is: no markup, no names of emoji, no characters that steer a terminal."""

    def render_str(self, text: str, **options: Any) -> Text:  # noqa: ANN401 - whatever rich asks for
        """Any text on its way to the terminal, cells of tables among them."""
        return super().render_str(plain_lines(text), **{**options, "markup": False, "emoji": False})


errors = _PlainConsole(stderr=True, soft_wrap=True, highlight=False)


@dataclass
class _Heard:
    """What was printed to the user of this process so far."""

    last_s: float = 0.0  # when the last line was printed, if to the log alone
    result: str = ""  # last line of a quiet command's result
    counts: progress.Lines | None = None


_heard = _Heard()


@contextmanager
def outlets() -> Iterator[None]:
    """Restore the outlets in the end, however `open_outlets` changed them, and print what a quiet command held back.

    The settings are variables of the environment, which the processes of `--jobs` inherit.
    """
    before = {name: os.environ.get(name) for name in (progress.QUIET, LOG)}
    try:
        with progress.reporting(tell):
            yield
        if _heard.result:
            typer.echo(_heard.result)
    finally:
        _heard.result, _heard.counts = "", None
        for name, value in before.items():
            os.environ.pop(name, None)
            os.environ.update({} if value is None else {name: value})


def open_outlets(*, quiet: bool, log: Path | None) -> None:
    """Print errors and the last line of the result alone, if it is to be quiet; append every line to a log.

    Raise a `ConfigError` if the log cannot be written.
    """
    os.environ.pop(progress.QUIET, None)  # it may say 0
    if quiet:
        os.environ[progress.QUIET] = "1"
    if log is not None:
        os.environ[LOG] = str(log.absolute())
        note("sasgeo-bench " + " ".join(sys.argv[1:]))


def note(text: str) -> None:
    """Append lines to the log, if there is one, each with its time."""
    _heard.last_s = time.monotonic()
    path = os.environ.get(LOG)
    if not path:
        return
    now = dt.datetime.now(dt.UTC).isoformat(timespec="seconds")
    try:
        with Path(path).open("a", encoding="utf-8") as file:  # one write a line: other processes append to it as well
            file.write("".join(f"{now} {plain(line)}\n" for line in text.splitlines()))
    except OSError as error:
        os.environ.pop(LOG, None)
        raise StoreError(
            f"--log {path} cannot be written ({error.strerror}): name a file in a folder of yours"
        ) from error


@contextmanager
def heartbeat() -> Iterator[None]:
    """Say that the program is at work and how far it is, whenever it is silent.

    That is after three seconds if it has printed nothing yet, else after fifteen; in a longer silence ever more seldom.
    """
    begun_s = _heard.last_s = time.monotonic()
    stop, every_s = Event(), progress.EVERY_S
    beats = Thread(target=_beat, args=(stop, begun_s, every_s), daemon=True)
    if every_s < math.inf:
        beats.start()
    try:
        yield
    finally:
        stop.set()


@contextmanager
def _complaining() -> Iterator[None]:
    """Print an error of a thread, which would not be caught otherwise, as a line."""
    try:
        yield
    except StoreError as error:
        complain(f"sasgeo-bench: {error}")


def _beat(stop: Event, begun_s: float, every_s: float) -> None:
    pause_s, heard_s = min(_FIRST_S, every_s), begun_s
    while not stop.wait(max(_heard.last_s + pause_s - time.monotonic(), 0.1)):
        if _heard.last_s != heard_s:
            pause_s, heard_s = _LATE * every_s, _heard.last_s
        if time.monotonic() - heard_s < pause_s:
            continue
        state = _heard.counts.state() if _heard.counts is not None else ""
        with _complaining():
            tell(f"at work for {progress.duration_text(time.monotonic() - begun_s)}" + (f"; {state}" if state else ""))
        heard_s, pause_s = _heard.last_s, min(2 * pause_s, _LONGEST_SILENCE_S)


def read_date(text: str | None) -> dt.date | None:
    """Read the value of --date, None where it was left out."""
    return read_day(text, flag="--date") if text else None


def read_day(text: str, *, flag: str) -> dt.date:
    """Read a day as in 2021-10-28; a refusal names the flag."""
    try:
        return dt.date.fromisoformat(text)
    except ValueError as error:
        raise ConfigError(f"{flag} must be a date as in 2021-10-28, got {text!r}") from error


def tell(line: str) -> None:
    """Print one line to stderr, unless the command is quiet."""
    if progress.QUIET in os.environ:
        note(line)
    else:
        complain(line)


def complain(line: str) -> None:
    """Print one line on what went wrong to stderr; a quiet command does so, too."""
    errors.print(plain(line))
    note(line)


def say(result: object) -> None:
    """Print a result to stdout: a path, or some lines; the last one alone, and in the end, if the command is quiet."""
    text = plain_lines(str(result))
    if progress.QUIET in os.environ:
        _heard.result = next((line for line in reversed(text.splitlines()) if line.strip()), _heard.result)
    else:
        typer.echo(text)
    note(text)


class Bars(progress.Lines):
    """Progress as a bar for each piece of work, for a terminal; as lines in the log."""

    def __init__(self) -> None:
        super().__init__(note)
        columns = (
            TextColumn("{task.description}", markup=False),
            BarColumn(),
            MofNCompleteColumn(),
            TextColumn("{task.fields[rate]}"),
            TimeRemainingColumn(),
        )
        self._bars = RichProgress(*columns, console=errors)
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
        super().begin(label, total)
        self._tasks[label] = self._bars.add_task(plain(label), total=total, rate="")

    def advance(self, label: str, count: int) -> None:
        """Move a bar on."""
        super().advance(label, count)
        task = self._tasks[label]
        self._bars.advance(task, count)
        speed = self._bars.tasks[self._bars.task_ids.index(task)].speed
        self._bars.update(task, rate="" if speed is None else f"{speed:.1f}/s")


@contextmanager
def shown_progress() -> Iterator[None]:
    """Show the progress of what is done inside: as bars on a terminal, as lines elsewhere."""
    if not sys.stderr.isatty() or progress.QUIET in os.environ:
        _heard.counts = progress.Lines(tell)
        with progress.reporting(tell, _heard.counts):
            yield
        return
    with Bars() as bars, progress.reporting(tell, bars):
        _heard.counts = bars
        yield


@contextmanager
def said_after() -> Iterator[Callable[[object], None]]:
    """Show progress, and print what is said meanwhile once its bars are gone: they redirect stdout to stderr."""
    lines: list[object] = []
    with shown_progress():
        yield lines.append
    for line in lines:
        say(line)


def print_table(table: Table) -> None:
    """Print to stdout: as wide as the terminal there, unwrapped into a file or pipe."""
    console = _PlainConsole(highlight=False, width=None if sys.stdout.isatty() else PIPE_WIDTH)
    with console.capture() as captured:
        console.print(table)
    say("\n".join(line.rstrip() for line in captured.get().splitlines()) + "\n")
