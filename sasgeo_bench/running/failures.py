# SPDX-License-Identifier: Apache-2.0
"""Limit the failure of one entry to its own rows; keep the cause as a line, and the traceback in a log."""

import errno
import traceback
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Final, TypeVar

from sasgeo_bench.bounds import message_of, one_line
from sasgeo_bench.errors import SasgeoError

LOG: Final = "failures.log"  # in the folder of a run; beside that of a board
_DISK: Final = frozenset({errno.ENOSPC, errno.EDQUOT, errno.EROFS, errno.EIO})
_MOST_LOGGED: Final = 100_000  # characters of one traceback

Item = TypeVar("Item")


def stops_all(error: BaseException | None) -> bool:
    """True if an error comes from a disk that is full, read-only or broken, and from no entry.

    Examples
    --------
    >>> stops_all(OSError(errno.ENOSPC, "No space left on device")), stops_all(ValueError("an answer of mine"))
    (True, False)
    """
    while error is not None:
        if isinstance(error, OSError) and error.errno in _DISK:
            return True
        error = error.__cause__
    return False


def write_log(log: Path, name: str, error: BaseException) -> None:
    """Add the traceback of an error to a log; where that cannot be written there is none."""
    text = "".join(traceback.format_exception(error))[-_MOST_LOGGED:]
    with suppress(OSError):
        log.parent.mkdir(parents=True, exist_ok=True)
        with log.open("a", encoding="utf-8", errors="backslashreplace") as target:
            target.write(f"{one_line(name)}\n{text}\n")


def log_beside(board: Path) -> Path:
    """Return the path of a board's log of tracebacks.

    Examples
    --------
    >>> log_beside(Path("out/boards/mine")).name
    'mine.failures.log'
    """
    return board.with_name(f"{board.name}.{LOG}")


class Failures:
    """Failed entries by name, and the cause of each as one line.

    Parameters
    ----------
    log : Path
        Where tracebacks go; it is made when there is one.
    tell : callable
        Gets each line.

    Examples
    --------
    >>> failures = Failures(Path("failures.log"), tell=print)
    >>> with failures.of("mine"):
    ...     raise SasgeoError("it has no card")
    mine failed: it has no card
    >>> failures.found
    {'mine': 'it has no card'}
    """

    def __init__(self, log: Path, *, tell: Callable[[str], None]) -> None:
        self.found: dict[str, str] = {}
        self.errors: dict[str, Exception] = {}
        self.log, self._tell = log, tell

    @property
    def first(self) -> Exception | None:
        """Return the error that was raised first."""
        return next(iter(self.errors.values()), None)

    @contextmanager
    def of(self, name: str, *, but: tuple[type[Exception], ...] = ()) -> Iterator[None]:
        """Note any error but some, and go on after the block; a disk's refusal is raised."""
        try:
            yield
        except Exception as error:
            if isinstance(error, but) or stops_all(error):
                raise
            self.note(name, error)

    def note(self, name: str, error: Exception) -> None:
        """Note a failure; of an error that nobody has put in words the log keeps where it was raised."""
        line = (
            one_line(str(error))
            if isinstance(error, SasgeoError)
            else f"{message_of(error)} ({self.log.name} says where)"
        )
        if not isinstance(error, SasgeoError):
            write_log(self.log, name, error)
        self.errors.setdefault(name, error)
        line = line.removeprefix(f"{name}: ")
        if self.found.setdefault(name, line) == line:
            self._tell(f"{name} failed: {line}")

    def blame(self, items: Mapping[str, Item], work: Callable[[Mapping[str, Item]], object]) -> bool:
        """Note those with which alone some work fails that failed with all; whether there is any."""
        before = len(self.found)
        for name in items:
            with self.of(name):
                work({name: items[name]})
        return len(self.found) > before
