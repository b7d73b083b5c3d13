# SPDX-License-Identifier: Apache-2.0
"""Spread long work over processes, and show its progress: as a line now and then, or as a terminal shows it."""

import os
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context, parent_process
from multiprocessing.connection import wait
from signal import SIG_DFL, SIGINT, signal
from threading import Thread
from typing import Protocol, TypeVar

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


Item = TypeVar("Item")
Found = TypeVar("Found")


def spread(work: Callable[[Item], Found], items: Sequence[Item], *, jobs: int = 1) -> Iterator[Found]:
    """Yield `work(item)` for each item, in order, computed by several processes if there are several jobs and items.

    Another process must be able to import `work`, and to receive items and send results. The first error is raised
    here.
    """
    if jobs == 1 or len(items) < 2:  # noqa: PLR2004 - one item is no work to share
        yield from map(work, items)
        return
    with ProcessPoolExecutor(jobs, mp_context=get_context("spawn"), initializer=_end_with_parent) as pool:
        yield from pool.map(work, items)


def _end_with_parent() -> None:
    """End this process at once on an interrupt, or when the program that it works for has gone.

    Files are written whole or not at all, and the next run resumes. Without this a killed program leaves its processes
    waiting for work for ever: each of them holds the other end of the pipe that the others read.
    """
    signal(SIGINT, SIG_DFL)
    parent = parent_process()
    if parent is not None:
        Thread(target=_exit_after, args=(parent.sentinel,), daemon=True).start()


def _exit_after(sentinel: int) -> None:
    wait([sentinel])
    os._exit(1)  # from a thread nothing gentler ends the process
