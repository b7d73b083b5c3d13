# SPDX-License-Identifier: Apache-2.0
"""Limit the failure of one entry to its own rows; keep the cause as a line, and the traceback in a log."""

import errno
import traceback
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Final, TypeVar

from sasgeo_bench.core.errors import SasgeoError
from sasgeo_bench.core.progress import tell
from sasgeo_bench.core.texts import message_of, one_line

LOG: Final = "failures.log"  # in the folder of a run; next to that of a board
_DISK: Final = frozenset({errno.ENOSPC, errno.EDQUOT, errno.EROFS, errno.EIO})

Item = TypeVar("Item")


def is_disk_error(error: BaseException | None) -> bool:
    """Return whether an error comes from a disk that is full, read-only or broken, and not from an entry."""
    while error is not None:
        if isinstance(error, OSError) and error.errno in _DISK:
            return True
        error = error.__cause__
    return False


def our_failure(log: Path, name: str, error: Exception) -> str:
    """Log the traceback of an error of our own code, and return the line for its row."""
    write_log(log, name, error)
    return one_line(f"not its own process failed, but ours: {message_of(error)} (see {log.name})")


def write_log(log: Path, name: str, error: BaseException) -> None:
    """Append the traceback of an error to a log, if that can be written."""
    text = "".join(traceback.format_exception(error))[-100_000:]  # characters of one traceback
    with suppress(OSError):
        log.parent.mkdir(parents=True, exist_ok=True)
        with log.open("a", encoding="utf-8", errors="backslashreplace") as target:
            target.write(f"{one_line(name)}\n{text}\n")


def log_beside(board: Path) -> Path:
    """Return the path of a board's log of tracebacks, next to its folder."""
    return board.with_name(f"{board.name}.{LOG}")


class Failures:
    """Failed entries by name, with the cause of each as one line, which is reported; tracebacks are appended to `log`.

    >>> from sasgeo_bench.core.progress import reporting
    >>> failures = Failures(Path("failures.log"))
    >>> with reporting(print), failures.of("graph"):
    ...     raise SasgeoError("it has no card")
    graph failed: it has no card
    >>> failures.found
    {'graph': 'it has no card'}
    """

    def __init__(self, log: Path, *, is_reported: bool = True) -> None:
        self.found: dict[str, str] = {}
        self.errors: dict[str, Exception] = {}
        self.log, self._is_reported = log, is_reported

    @property
    def first(self) -> Exception | None:
        """Return the first error."""
        return next(iter(self.errors.values()), None)

    @contextmanager
    def of(self, name: str, *, but: tuple[type[Exception], ...] = ()) -> Iterator[None]:
        """Record an error of the block and continue after it; raise those in `but` and refusals of the disk."""
        try:
            yield
        except Exception as error:
            if isinstance(error, but) or is_disk_error(error):
                raise
            self.note(name, error)

    def note(self, name: str, error: Exception) -> None:
        """Record a failure; log the traceback of an error that is not a `SasgeoError`."""
        if isinstance(error, SasgeoError):
            line = one_line(str(error))
        else:  # its text may be of a plugin, and fail in turn
            line = f"{message_of(error)} ({self.log.name} says where)"
            write_log(self.log, name, error)
        self.errors.setdefault(name, error)
        line = line.removeprefix(f"{name}: ")
        if self.found.setdefault(name, line) == line and self._is_reported:
            tell(f"{name} failed: {line}")

    def blame(self, items: Mapping[str, Item], work: Callable[[Mapping[str, Item]], object]) -> bool:
        """Record the items with which some work fails alone, after it failed with all; return whether there are any."""
        before = len(self.found)
        for name in items:
            with self.of(name):
                work({name: items[name]})
        return len(self.found) > before
