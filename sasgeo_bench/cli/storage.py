# SPDX-License-Identifier: Apache-2.0
"""Object storage: the commands that send a folder there and fetch it."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import typer

from sasgeo_bench.cli.console import say
from sasgeo_bench.cli.options import Options
from sasgeo_bench.errors import counted
from sasgeo_bench.files.storage import Moved, fetch, send, shown

Url = Annotated[str, typer.Argument(help="place of the folder itself, as s3://bucket/regions/vaduz (fsspec)")]


@dataclass(frozen=True, kw_only=True)
class SendOptions(Options):
    """Words of send."""

    folder: Annotated[Path, typer.Argument(help="folder of a region, task, run or board, or all of an OUT")]
    url: Url


@dataclass(frozen=True, kw_only=True)
class FetchOptions(Options):
    """Words of fetch."""

    url: Url
    folder: Annotated[Path, typer.Argument(help="folder to write, in place of an older copy")]


def send_command(options: SendOptions) -> None:
    """Copy a finished folder into object storage; files that are there already are not sent again."""
    moved = send(options.folder, options.url)
    say(f"{shown(options.url)}: {_text(moved, 'sent')}")


def fetch_command(options: FetchOptions) -> None:
    """Copy a folder that was sent out of object storage, each file held against its hash."""
    moved = fetch(options.url, options.folder)
    say(f"{options.folder}: {_text(moved, 'fetched')}")


def _text(moved: Moved, verb: str) -> str:
    hidden = f"; {counted(moved.hidden, 'hidden file')} left out" if moved.hidden else ""
    return f"{counted(moved.files, 'file')}, {moved.bytes / 1e6:.1f} MB, {moved.moved} {verb}{hidden}"
