# SPDX-License-Identifier: Apache-2.0
"""Tasks of many requests, drawn by several processes."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from sasgeo_bench.errors import ConfigError
from sasgeo_bench.parallel import spread
from sasgeo_bench.tasks.build import ensure_tasks
from sasgeo_bench.tasks.task_plan import Request


@dataclass(frozen=True, kw_only=True)
class Drawn:
    """Result of a request: its folders, or what the region lacks for it, and the lines of progress."""

    lines: tuple[str, ...]
    folders: tuple[Path, ...] = ()
    lack: str | None = None


def carry_out(requests: Sequence[Request], *, jobs: int = 1) -> Iterator[Drawn]:
    """Draw the tasks of requests with several processes, whose number changes no query; yield results in order.

    Tasks that are up to date stay. Raise a StoreError if a folder cannot be written or holds foreign files.
    """
    yield from spread(_carry_out, requests, jobs=jobs)


def _carry_out(request: Request) -> Drawn:
    lines: list[str] = []
    try:
        folders = ensure_tasks(request, tell=lines.append)
    except ConfigError as error:
        return Drawn(lines=tuple(lines), lack=str(error).removesuffix(" (--skip passes on to the next suite)"))
    return Drawn(lines=tuple(lines), folders=folders)
