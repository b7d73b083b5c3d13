# SPDX-License-Identifier: Apache-2.0
"""A head start: what a pipeline would draw and ask first lies packed beside its file, and is unpacked once."""

import lzma
import os
import tarfile
from collections.abc import Iterator
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Final

from sasgeo_bench.errors import StoreError
from sasgeo_bench.progress import Tell
from sasgeo_bench.texts import one_line

SUFFIX: Final = ".tar.xz"
FOLDERS: Final = frozenset(("regions", "runs", "segmenters", "tasks", "truth"))  # below the root of what is built


def unpack_head_start(pipeline_file: Path, out: Path, *, tell: Tell) -> None:
    """Lay what is packed beside a pipeline file, `demo.tar.xz` beside `demo.toml`, into `out`; nothing where none is.

    Each map, task and run is laid down whole where none of its name lies, and replaces nothing. It is checked as if it
    had been made here: what another version of the program made is made again. Raise `StoreError` if the archive is
    damaged, or `out` cannot be written.
    """
    archive = pipeline_file.with_name(pipeline_file.stem + SUFFIX)
    if not archive.is_file():
        return
    if not hasattr(tarfile, "data_filter"):  # of Python 3.11.4 on: without it a name in an archive may lead anywhere
        tell(f"{archive.name} is not unpacked by a Python older than 3.11.4: all is drawn and asked here")
        return
    try:
        out.mkdir(parents=True, exist_ok=True)
        with TemporaryDirectory(prefix=".head-start-", dir=out) as folder:
            scratch = Path(folder)
            with tarfile.open(archive, "r:xz") as packed:
                packed.extractall(scratch, filter="data")
            strange = sorted(set(os.listdir(scratch)) - FOLDERS)  # noqa: PTH208 - names alone
            if strange:
                message = f"{archive} holds {strange[0]!r}: pack {', '.join(sorted(FOLDERS))} alone"
                raise StoreError(message)
            laid = sum(_lay(unit, out / unit.relative_to(scratch)) for unit in _units(scratch))
    except (OSError, EOFError, lzma.LZMAError, tarfile.TarError) as error:
        mend = "remove the archive, and all is drawn and asked here"
        message = f"{archive} cannot be unpacked into {out} ({one_line(str(error))}): {mend}"
        raise StoreError(message) from error
    if laid:
        tell(f"{laid} maps, tasks, truths and runs come with the program ({archive.name}), and are not made again")


def _units(folder: Path) -> Iterator[Path]:
    """Yield the outermost folders that hold files: a map, a task, its truths, a run with all its parts."""
    for parent, folders, files in os.walk(folder):
        if files:
            folders.clear()  # they belong to it
            yield Path(parent)


def _lay(unit: Path, target: Path) -> bool:
    """Move a folder to where none lies; return whether it was moved."""
    target.parent.mkdir(parents=True, exist_ok=True)
    if target.exists():
        return False
    try:
        unit.rename(target)
    except OSError:
        if not target.exists():  # else another process was first
            raise
        return False
    return True
