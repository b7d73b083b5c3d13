# SPDX-License-Identifier: Apache-2.0
"""Apply a function to many items in several processes."""

from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from signal import SIG_DFL, SIGINT, signal
from typing import TypeVar

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
    # An interrupt ends the processes at once: files are written whole or not at all, and the next run resumes.
    spawn = get_context("spawn")
    with ProcessPoolExecutor(jobs, mp_context=spawn, initializer=signal, initargs=(SIGINT, SIG_DFL)) as pool:
        yield from pool.map(work, items)
