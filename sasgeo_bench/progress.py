# SPDX-License-Identifier: Apache-2.0
"""Show the progress of long work: as a line now and then, or as a terminal shows it."""

import time
from collections.abc import Callable
from typing import Protocol

EVERY_S = 10.0  # read when progress begins to be shown, so that a test can silence it on a slow machine

Tell = Callable[[str], None]


class Progress(Protocol):
    """Progress of a piece of work; called by one thread at a time."""

    def begin(self, label: str, total: int) -> None:
        """Begin a piece of work with so many items."""
        ...

    def advance(self, label: str, count: int) -> None:
        """Count so many more items as done."""
        ...


class Lines:
    """Progress as a line every ten seconds.

    >>> lines = Lines(lambda line: print(line.split(",")[0]), every_s=0.0)
    >>> lines.begin("rejectors", 16)
    >>> lines.advance("rejectors", 4)
    rejectors: 4 of 16
    """

    def __init__(self, tell: Tell, *, every_s: float | None = None) -> None:
        self._tell, self._every_s = tell, EVERY_S if every_s is None else every_s
        self._begun: dict[str, tuple[float, int]] = {}
        self._done: dict[str, int] = {}
        self._last_s = time.monotonic()

    def begin(self, label: str, total: int) -> None:
        """Begin to count."""
        self._begun[label], self._done[label] = (time.monotonic(), total), 0

    def advance(self, label: str, count: int) -> None:
        """Print progress, speed and time left, if the last line is old enough."""
        now, (begun, total) = time.monotonic(), self._begun[label]
        self._done[label] += count
        if now - self._last_s < self._every_s:
            return
        self._last_s = now
        done = self._done[label]
        rate = done / max(now - begun, 1e-9)
        self._tell(f"{label}: {done} of {total}, {rate:.1f} a second, {(total - done) / rate:.0f} s left")
