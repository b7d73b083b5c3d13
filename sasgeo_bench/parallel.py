# SPDX-License-Identifier: Apache-2.0
"""The same work for many things, by several processes."""

from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from signal import SIG_DFL, SIGINT, signal
from typing import TypeVar

Item = TypeVar("Item")
Found = TypeVar("Found")


def spread(work: Callable[[Item], Found], items: Sequence[Item], *, jobs: int = 1) -> Iterator[Found]:
    """Do one thing for each of many, by several processes where there are several jobs and items.

    Parameters
    ----------
    work : callable
        What another process can import and name. In this process it is called as it is.
    items : sequence
        What it is done for; sent to the processes, as what is found is sent back.
    jobs : int
        Processes.

    Yields
    ------
    object
        What came of each item, in their order. The first error that is met is raised here.

    Examples
    --------
    >>> list(spread(abs, [-1, 2]))
    [1, 2]
    """
    if jobs == 1 or len(items) < 2:  # noqa: PLR2004 - one item is no work to share
        yield from map(work, items)
        return
    # An interrupt ends the processes where they are: what they write is whole or not there, and the next run goes on.
    spawn = get_context("spawn")
    with ProcessPoolExecutor(jobs, mp_context=spawn, initializer=signal, initargs=(SIGINT, SIG_DFL)) as pool:
        yield from pool.map(work, items)
