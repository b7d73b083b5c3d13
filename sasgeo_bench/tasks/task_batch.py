# SPDX-License-Identifier: Apache-2.0
"""Many requests -> tasks on disk, by several processes."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from sasgeo_bench.errors import ConfigError
from sasgeo_bench.parallel import spread
from sasgeo_bench.tasks.build import ensure_tasks
from sasgeo_bench.tasks.task_plan import Request


@dataclass(frozen=True, kw_only=True)
class Drawn:
    """What came of a request: its folders, or what the region lacks for it; and what was told on the way."""

    lines: tuple[str, ...]
    folders: tuple[Path, ...] = ()
    lack: str | None = None


def carry_out(requests: Sequence[Request], *, jobs: int = 1) -> Iterator[Drawn]:
    """Carry requests out, by several processes if there are several jobs; no query hangs on how many there are.

    Parameters
    ----------
    requests : sequence of Request
        What was done before is left as it is.
    jobs : int
        Processes.

    Yields
    ------
    Drawn
        One for each request, in their order.

    Raises
    ------
    StoreError
        If a folder cannot be written or holds something that is not ours.

    Examples
    --------
    >>> list(carry_out([], jobs=2))
    []
    """
    yield from spread(_carry_out, requests, jobs=jobs)


def _carry_out(request: Request) -> Drawn:
    lines: list[str] = []
    try:
        folders = ensure_tasks(request, tell=lines.append)
    except ConfigError as error:
        return Drawn(lines=tuple(lines), lack=str(error).removesuffix(" (--skip passes on to the next suite)"))
    return Drawn(lines=tuple(lines), folders=folders)
