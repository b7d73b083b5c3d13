# SPDX-License-Identifier: Apache-2.0
"""A run on a dask cluster: paths, configurations and ids travel, rows are written where they are made."""

import logging
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from typing import TYPE_CHECKING, Final

from sasgeo_bench.errors import ConfigError, StoreError
from sasgeo_bench.running import prediction_files
from sasgeo_bench.running.answers import Cost, Watch, answer
from sasgeo_bench.running.plan import RunPart, RunPlan

if TYPE_CHECKING:
    from distributed import Client

_CONNECT_S: Final = 10.0
_CHUNKS_PER_THREAD: Final = 4  # so that the last ones end at about the same time
_LEAST_QUERIES, _MOST_QUERIES = 8, 256  # of a chunk: each begins by preparing the map


@contextmanager
def connected(address: str) -> Iterator["Client"]:
    """A client of a scheduler, or of one with N processes on this machine for local:N.

    Parameters
    ----------
    address : str
        As in tcp://10.0.0.5:8786, or local:4.

    Raises
    ------
    ConfigError
        If dask is not installed, the address makes no sense, or nobody answers there.
    """
    try:
        from distributed import Client, LocalCluster  # noqa: PLC0415 - an extra: only whoever asks for it needs it
    except ImportError as error:
        message = "--dask needs the package distributed: pip install 'sasgeo-bench[dask]'"
        raise ConfigError(message) from error
    kind, _, count = address.partition(":")
    if kind == "local":
        if not (count.isascii() and count.isdecimal() and int(count) >= 1):
            message = f"--dask must be local:N with N >= 1, or a scheduler's address, got {address!r}"
            raise ConfigError(message)
        with (
            # One thread each: a chunk waits for one matcher's process. No dashboard: nobody asked for an open port.
            LocalCluster(
                n_workers=int(count),
                threads_per_worker=1,
                processes=True,
                dashboard_address=None,
                silence_logs=logging.CRITICAL,
            ) as cluster,
            Client(cluster) as client,
        ):
            yield client
        return
    try:
        client = Client(address, timeout=_CONNECT_S)
    except (OSError, TimeoutError, ValueError) as error:
        message = f"no dask scheduler answers at {address!r} within {_CONNECT_S:g} s: check the address, or use local:N"
        raise ConfigError(message) from error
    with client:
        yield client


def answer_on(client: "Client", plan: RunPlan, parts: Sequence[RunPart]) -> Iterator[tuple[int, int, Cost]]:
    """Ask everything that is left on a cluster.

    Parameters
    ----------
    client : distributed.Client
        From `connected`. All its workers must reach the same folders, and have the plugin installed.
    plan : RunPlan
        From `plan_run`.
    parts : sequence of RunPart
        Tasks with queries left.

    Yields
    ------
    tuple of int, int, Cost
        As each chunk is done: the number of its part, its queries, and what it took. A chunk whose dask worker dies is
        given to another, which asks only what has no row yet.

    Raises
    ------
    StoreError
        If a chunk's dask workers died again and again; the rows that were written stay.
    """
    from distributed import KilledWorker, as_completed  # noqa: PLC0415

    threads = max(1, sum(client.nthreads().values()))
    where = {}
    # Other tasks' ids need not travel with every chunk, nor the blocks of a split.
    bare = replace(plan, parts=(), request=replace(plan.request, split=None))
    for number, part in enumerate(parts):
        for ids in _chunks(part.left, threads):
            chunk = replace(part, left=ids, asked={name: part.asked[name] for name in ids})
            where[client.submit(_answer_chunk, bare, chunk, pure=False)] = (number, len(ids))
    for future in as_completed(where):
        try:
            cost = future.result()
        except KilledWorker as error:
            message = "dask workers died over and over on the same queries: give them more memory, and run again"
            raise StoreError(message) from error
        yield (*where[future], cost)


def _chunks(ids: Sequence[str], threads: int) -> Iterator[tuple[str, ...]]:
    """Ids in chunks, several for each thread."""
    size = -(-len(ids) // (threads * _CHUNKS_PER_THREAD))
    size = min(max(size, _LEAST_QUERIES), _MOST_QUERIES)
    for start in range(0, len(ids), size):
        yield tuple(ids[start : start + size])


def _answer_chunk(plan: RunPlan, part: RunPart) -> Cost:
    """Ask one chunk in the process of a dask worker; what an earlier try of it has written is not asked again."""
    done = prediction_files.ids_done(part.folder, part.asked, again=plan.request.again)
    left = tuple(name for name in part.left if name not in done)
    return answer(plan, [replace(part, left=left)], jobs=1, watch=Watch())
