# SPDX-License-Identifier: Apache-2.0
"""Spread long work over processes or a cluster; show its progress: as a line now and then, or as a terminal does."""

import logging
import os
import re
import time
from collections import defaultdict, deque
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from contextlib import ExitStack, chdir, contextmanager
from dataclasses import dataclass, field
from functools import partial
from multiprocessing import get_context, parent_process
from multiprocessing.connection import wait
from signal import SIG_DFL, SIGINT, signal
from socket import gethostname
from threading import Thread
from types import FunctionType
from typing import TYPE_CHECKING, Final, Generic, NamedTuple, Protocol, TypeVar, cast

from sasgeo_bench.core.errors import ConfigError, StoreError
from sasgeo_bench.core.texts import message_of

if TYPE_CHECKING:
    from distributed import Client

EVERY_S = 10.0  # read when progress begins to be shown, so that a test can silence it on a slow machine
QUIET: Final = "SASGEO_QUIET"  # variable that is set while nothing is to be shown but results and errors
_MINUTE_S: Final = 60.0
_HOUR_S: Final = 3600.0
_CONNECT_S: Final = 10.0
MOST_PROCESSES: Final = 1000  # at once, of one command
_ADDRESS: Final = re.compile(r"(?:(?:tcp|tls)://)?[^\s/:]+:\d{1,5}|(?:tcp|tls)://\[[0-9a-fA-F:.%]+\]:\d{1,5}")

Tell = Callable[[str], None]
Item = TypeVar("Item")
Found = TypeVar("Found")


class Progress(Protocol):
    """Progress of a piece of work; called by one thread at a time."""

    def begin(self, label: str, total: int) -> None:
        """Begin a piece of work with so many items."""
        ...

    def advance(self, label: str, count: int) -> None:
        """Count so many more items as done."""
        ...


def duration_text(seconds: float) -> str:
    """Say a duration in the unit that fits it.

    >>> [duration_text(seconds) for seconds in (4.2, 89.0, 200.0, 9000.0)]
    ['4 s', '89 s', '3 min', '2.5 h']
    """
    if seconds < 2 * _MINUTE_S:
        return f"{seconds:.0f} s"
    return f"{seconds / _MINUTE_S:.0f} min" if seconds < 2 * _HOUR_S else f"{seconds / _HOUR_S:.1f} h"


class Lines:
    """Progress as a line every ten seconds.

    The time left assumes that the items to come take as long as those since the first, which waits for a process that
    starts or a map that is read.

    >>> lines = Lines(lambda line: print(line.split(", about")[0]), every_s=0.0)
    >>> lines.begin("rejectors", 16)
    >>> lines.state()
    'rejectors: 0 of 16'
    >>> for _ in range(2):
    ...     lines.advance("rejectors", 1)
    rejectors: 1 of 16
    rejectors: 2 of 16
    """

    def __init__(self, tell: Tell, *, every_s: float | None = None) -> None:
        self._tell, self._every_s = tell, EVERY_S if every_s is None else every_s
        self._totals: dict[str, int] = {}
        self._done: dict[str, int] = {}
        self._firsts: dict[str, tuple[float, int]] = {}  # when the first were done, and how many
        self._last_s = time.monotonic()
        self._current = ""

    def begin(self, label: str, total: int) -> None:
        """Begin to count."""
        self._totals[label], self._done[label] = total, 0
        self._firsts.pop(label, None)
        self._current = label

    def advance(self, label: str, count: int) -> None:
        """Print progress and time left, if something is left and the last line is old enough."""
        self._done[label] += count
        self._current = label if self._done[label] < self._totals[label] else ""
        now = time.monotonic()
        self._firsts.setdefault(label, (now, count))
        if self._current and now - self._last_s >= self._every_s:
            self._last_s = now
            self._tell(self.state())

    def state(self) -> str:
        """Progress of the work that began or moved on last; empty where none is under way."""
        if not self._current:
            return ""
        total, done = self._totals[self._current], self._done[self._current]
        text = f"{self._current}: {done} of {total}"
        since_s, first = self._firsts.get(self._current, (0.0, 0))
        if done == first:
            return text
        left_s = (time.monotonic() - since_s) / (done - first) * (total - done)
        return f"{text}, about {duration_text(left_s)} left"


def silent(line: object) -> None:
    """Print nothing."""


@dataclass
class _Outlet:
    """Where lines and counts of this process go."""

    tell: Tell = silent
    progress: Progress = field(default_factory=lambda: Lines(silent))


_outlet = _Outlet()  # of the process, not of a thread or context: all that works for a command reports to its user


def tell(line: str) -> None:
    """Report one line on the work to the listener: the user of a command, none in a program by default."""
    _outlet.tell(line)


def begin(label: str, total: int) -> None:
    """Begin a piece of work with so many items."""
    _outlet.progress.begin(label, total)


def advance(label: str, count: int) -> None:
    """Count so many more items as done."""
    _outlet.progress.advance(label, count)


@contextmanager
def reporting(tell: Tell | None = None, progress: Progress | None = None) -> Iterator[None]:
    """Send lines and counts of all that this process does inside to `tell` and `progress`.

    Without `tell`, lines go on to where they went before; without `progress`, counts become lines.

    >>> with reporting(print):
    ...     tell("2 regions to be built")
    2 regions to be built
    """
    before = _outlet.tell, _outlet.progress
    _outlet.tell = tell or before[0]
    _outlet.progress = progress or (Lines(tell) if tell else before[1])
    try:
        yield
    finally:
        _outlet.tell, _outlet.progress = before


def reported(work: Callable[[Item], Found]) -> Callable[[Item], Found]:
    """Return work for `spread` that reports to the listener of this process from another one, too.

    A function that other processes can import gets each line at once, anything else when the item is done.
    """
    named = isinstance(_outlet.tell, FunctionType) and "<" not in _outlet.tell.__qualname__
    return partial(_reported, work, _outlet.tell if named else None, _here())


class _Reported(NamedTuple, Generic[Found]):
    """A result, and the lines of its work."""

    lines: list[str]
    found: Found


def _here() -> tuple[str, int]:
    return gethostname(), os.getpid()  # workers of a cluster may have the same number elsewhere


def _reported(work: Callable[[Item], Found], tell: Tell | None, parent: tuple[str, int], item: Item) -> Found:
    if _here() == parent:  # who listens there listens already
        return work(item)
    lines: list[str] = []
    with reporting(tell or lines.append):
        found = work(item)
    return found if tell else cast("Found", _Reported(lines, found))


def check_jobs(jobs: int) -> None:
    """Raise `ConfigError` for a number of processes that no computer starts."""
    if not 1 <= jobs <= MOST_PROCESSES:
        raise ConfigError(f"--jobs must lie between 1 and {MOST_PROCESSES}, got {jobs}")


@contextmanager
def connected(address: str) -> Iterator["Client"]:
    """Yield a client of a dask scheduler at tcp://host:port, or of N processes on this machine for local:N.

    Raise `ConfigError` if dask is not installed, the address is wrong, or no scheduler answers there.
    """
    try:
        from distributed import Client, LocalCluster  # noqa: PLC0415 - an optional dependency
    except ImportError as error:
        raise ConfigError("--dask needs the package distributed: pip install 'sasgeo-bench[dask]'") from error
    kind, _, count = address.partition(":")
    if kind == "local":
        if not (count.isascii() and count.isdecimal() and len(count) <= 10 and 1 <= int(count) <= MOST_PROCESSES):
            raise ConfigError(
                f"--dask must be local:N with N from 1 to {MOST_PROCESSES}, or a scheduler's address, got {address!r}"
            )
        with ExitStack() as stack:
            try:
                # One thread each: a chunk waits for one matcher's process. The page that dask serves anyway is for this
                # machine alone, at any port: by default it is for all, with a warning where a cluster has that port.
                cluster = LocalCluster(
                    n_workers=int(count),
                    threads_per_worker=1,
                    processes=True,
                    dashboard_address="127.0.0.1:0",
                    silence_logs=logging.CRITICAL,
                )
                client = stack.enter_context(Client(stack.enter_context(cluster)))
            except (OSError, RuntimeError) as error:  # TimeoutError is among them
                raise ConfigError(
                    f"{count} dask workers cannot be started here ({message_of(error)}): ask for fewer"
                ) from error
            yield client
        return
    if not _ADDRESS.fullmatch(address):
        raise ConfigError(f"--dask must be local:N, or a scheduler's address as tcp://host:port, got {address!r}")
    try:
        client = Client(address, timeout=_CONNECT_S)
    except (OSError, TimeoutError, ValueError, TypeError) as error:  # TypeError: of TLS without certificates
        raise ConfigError(
            f"no dask scheduler answers at {address!r} within {_CONNECT_S:g} s: check the address, or use local:N"
        ) from error
    with client:
        yield client


def spread(
    work: Callable[[Item], Found],
    items: Sequence[Item],
    *,
    jobs: int = 1,
    dask: str | None = None,
    label: str = "",
) -> Iterator[Found]:
    """Yield `work(item)` for each item, in order, computed by several processes if there are several jobs and items.

    Items that are done are counted under `label`, if it is given. Another process must be able to import `work`, and to
    receive items and send results. The first error is raised here.

    `dask` is the address of a scheduler, or local:N, whose workers reach the same folders: an item whose worker dies,
    or cannot write or read, is given to another one. Raise `ConfigError` if it is not there, or named beside `jobs`;
    `StoreError` if no worker can do an item.
    """
    check_jobs(jobs)
    if dask is not None and jobs > 1:
        raise ConfigError(f"--jobs {jobs} and --dask {dask} both share out the work: leave one of them out")
    if label:
        begin(label, len(items))
    for found in _found(work, items, jobs) if dask is None else _found_on_cluster(work, items, dask):
        if isinstance(found, _Reported):
            for line in found.lines:
                tell(line)
            found = cast("Found", found.found)  # noqa: PLW2901
        if label:
            advance(label, 1)
        yield found


def _found(work: Callable[[Item], Found], items: Sequence[Item], jobs: int) -> Iterator[Found]:
    if jobs == 1 or len(items) < 2:  # one item is no work to share
        yield from map(work, items)
        return
    try:
        with ProcessPoolExecutor(jobs, mp_context=get_context("spawn"), initializer=_end_with_parent) as pool:
            tasks = deque(pool.submit(work, item) for item in items)
            try:
                while tasks:
                    yield tasks.popleft().result()
            except BaseException:
                # `map` would cancel the tasks themselves, and a thread of the pool fail on them if a process dies, too.
                pool.shutdown(wait=False, cancel_futures=True)
                raise
    except BrokenProcessPool as error:
        raise StoreError(
            f"one of {jobs} processes died, by a signal or for want of memory: ask for fewer --jobs, and go on; "
            "what is written stays"
        ) from error


class _Tried(NamedTuple, Generic[Found]):
    """What came of an item: a result, or the error that a worker met who may lack what others have."""

    result: Found | None
    worker: str = ""
    error: OSError | None = None


def _found_on_cluster(work: Callable[[Item], Found], items: Sequence[Item], address: str) -> Iterator[Found]:
    early: dict[int, Found] = {}
    following = 0
    with connected(address) as client:
        for number, found in done_on(client, work, items):
            early[number] = found
            while following in early:
                yield early.pop(following)
                following += 1


def done_on(client: "Client", work: Callable[[Item], Found], items: Sequence[Item]) -> Iterator[tuple[int, Found]]:
    """Yield number and result of each item of a cluster as it is done.

    An item whose worker dies is given to another; one that fails for want of a file or of room is tried by each other
    worker once. Raise `StoreError` if workers die on an item over and over; the last error, if no worker can do one.
    """
    from distributed import KilledWorker, as_completed  # noqa: PLC0415 - an optional dependency, of which `connected` tells

    try_ = partial(_try, work, os.getcwd())  # noqa: PTH109 - a text
    numbers = {future: number for number, future in enumerate(client.map(try_, items, pure=False))}
    failed: defaultdict[int, set[str]] = defaultdict(set)
    pending = as_completed(numbers)
    for future in pending:
        number = numbers.pop(future)
        try:
            tried: _Tried[Found] = future.result()
        except KilledWorker as error:
            raise StoreError(
                "dask workers died over and over on the same item: give them more memory, and go on"
            ) from error
        if tried.error is None:
            yield number, cast("Found", tried.result)
            continue
        failed[number].add(tried.worker)
        others = sorted(set(client.scheduler_info(n_workers=-1)["workers"]) - failed[number])
        if not others:
            raise tried.error
        again = client.submit(try_, items[number], pure=False, workers=others)
        numbers[again] = number
        pending.add(again)


def _try(work: Callable[[Item], Found], folder: str, item: Item) -> _Tried[Found]:
    from distributed import get_worker  # noqa: PLC0415

    try:
        with chdir(folder):  # a worker may serve others, too
            return _Tried(work(item))
    except OSError as error:  # a full disk, a folder that is not mounted: errors of ours about files are among them
        return _Tried(None, str(get_worker().address), error)


def _end_with_parent() -> None:
    """End this process at once on an interrupt, or when the program that it works for has gone."""
    # Files are written whole or not at all, and the next run resumes. Without this a killed program leaves its
    # processes waiting for work for ever: each of them holds the other end of the pipe that the others read.
    signal(SIGINT, SIG_DFL)
    parent = parent_process()
    if parent is not None:
        Thread(target=_exit_after, args=(parent.sentinel,), daemon=True).start()


def _exit_after(sentinel: int) -> None:
    wait([sentinel])
    os._exit(1)  # from a thread nothing gentler ends the process
