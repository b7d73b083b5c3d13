# SPDX-License-Identifier: Apache-2.0
"""Share maps among threads: one map each first, then help for the map with most pending queries."""

import threading
import time
from collections.abc import Callable, Iterator, Sequence
from typing import Final, Generic, TypeVar

Item = TypeVar("Item")

# Help begins with a start and a map to prepare: 1.6 s of a core, or far more. While nobody knows what a query takes,
# 10 ms or 10 s, fewer than this for each process are not worth one; chunks for a cluster are no smaller either.
LEAST_ITEMS: Final = 8


def pays(*, left: int, askers: int, start_s: float, pace_s: float | None) -> bool:
    """True if one more process is worth its start: its share of the queries must take at least as long.

    Parameters
    ----------
    left : int
        Queries that nobody was given yet.
    askers : int
        Processes that work on them.
    start_s : float
        What the start of a process takes, the map included.
    pace_s : float or None
        What a query takes; None while nobody knows, and the share must then be of `LEAST_ITEMS` queries.

    Examples
    --------
    >>> pays(left=40, askers=1, start_s=2.0, pace_s=0.01), pays(left=40, askers=1, start_s=2.0, pace_s=1.0)
    (False, True)
    """
    share = left / (askers + 1)
    return share >= LEAST_ITEMS if pace_s is None else share * pace_s >= start_s


class Schedule(Generic[Item]):
    """Queries of several maps, for some threads to share out among them.

    Parameters
    ----------
    lines : sequence of tuple of iterator and int
        For each map its queries, and how many these are.
    clock : callable
        Seconds.

    Examples
    --------
    >>> schedule = Schedule([(iter("ab"), 2), (iter("c"), 1)])
    >>> while (number := schedule.take()) is not None:
    ...     print(number, *schedule.items(number))
    0 a b
    1 c
    """

    def __init__(
        self, lines: Sequence[tuple[Iterator[Item], int]], *, clock: Callable[[], float] = time.monotonic
    ) -> None:
        self._lines = [_Line(items, count) for items, count in lines]
        self._clock = clock
        self._changed = threading.Condition()
        self._is_stopped = False

    @property
    def is_stopped(self) -> bool:
        """True if no more work is given."""
        return self._is_stopped

    def take(self) -> int | None:
        """The map to work on next, or None when nothing is left; waits as long as nobody knows whether help pays."""
        with self._changed:
            while not self._is_stopped:
                line = next((line for line in self._lines if line.askers == 0), None) or self._in_need()
                if line is not None:
                    line.askers += 1
                    return self._lines.index(line)
                if not any(line.left for line in self._lines):
                    return None
                self._changed.wait()
        return None

    def _in_need(self) -> "_Line[Item] | None":
        """Return the map where help pays and that has most pending queries per worker."""
        in_need = (line for line in self._lines if line.pays())
        return max(in_need, key=lambda line: line.left / (line.askers + 1), default=None)

    def items(self, number: int) -> Iterator[Item]:
        """Queries of a map, each to one of those who ask; the time until the next one is asked for is noted."""
        line, is_first = self._lines[number], True
        while not self._is_stopped:
            item = line.draw()
            if item is None:
                break
            begun = self._clock()
            yield item
            with self._changed:
                line.note(self._clock() - begun, is_first=is_first)
                self._changed.notify_all()
            is_first = False
        with self._changed:
            self._changed.notify_all()

    def wait_for_stop(self, seconds: float) -> bool:
        """True if no more work is given, now or within some seconds."""
        with self._changed:
            return self._changed.wait_for(lambda: self._is_stopped, timeout=seconds)

    def stop(self) -> None:
        """Give no more work, and wake all waiting threads."""
        with self._changed:
            self._is_stopped = True
            self._changed.notify_all()


class _Line(Generic[Item]):
    """Queries of one map, and what is known of the time they take."""

    def __init__(self, items: Iterator[Item], count: int) -> None:
        self.left = count
        self.askers = 0
        self._items = items
        self._lock = threading.Lock()
        self._start_s = 0.0
        self._spent_s, self._count = 0.0, 0

    def draw(self) -> Item | None:
        """The next one; None when there is none."""
        with self._lock:
            item = next(self._items, None)
            self.left = 0 if item is None else self.left - 1
            return item

    def note(self, seconds: float, *, is_first: bool) -> None:
        """Take note of what one took; the first of a process takes its start too and says nothing of the pace."""
        if is_first:
            self._start_s = max(self._start_s, seconds)
        else:
            self._spent_s, self._count = self._spent_s + seconds, self._count + 1

    def pays(self) -> bool:
        """True if help is worth its start."""
        pace_s = self._spent_s / self._count if self._count else None
        return self.left > 0 and pays(left=self.left, askers=self.askers, start_s=self._start_s, pace_s=pace_s)
