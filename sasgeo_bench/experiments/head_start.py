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
from sasgeo_bench.files.folders import locked, remove_tree
from sasgeo_bench.progress import Tell
from sasgeo_bench.texts import one_line

SUFFIX: Final = ".tar.xz"
_SCRATCH: Final = ".head-start-"
FOLDERS: Final = frozenset(("regions", "runs", "segmenters", "tasks", "truth"))  # below the root of what is built


def head_start_of(pipeline_file: Path) -> Path | None:
    """Return the archive beside a pipeline file, `demo.tar.xz` beside `demo.toml`; None where none is.

    Raise `StoreError` if what has its name is no file.
    """
    archive = pipeline_file.with_name(pipeline_file.stem + SUFFIX)
    if archive.is_file():
        return archive
    if archive.is_symlink() or archive.exists():
        message = f"{archive} is no file, and a head start of {pipeline_file.name} has this name: move it away"
        raise StoreError(message)
    return None


def unpack_head_start(pipeline_file: Path, out: Path, *, tell: Tell) -> None:
    """Lay what is packed beside a pipeline file into `out`; nothing where nothing is.

    Each map, task and run is laid down whole where none of its name lies, and replaces nothing. It is checked as if it
    had been made here: what another version of the program made is made again. Raise `StoreError` if the archive is
    damaged or holds something else, or `out` cannot be written.
    """
    archive = head_start_of(pipeline_file)
    if archive is None:
        return
    if not hasattr(tarfile, "data_filter"):  # of Python 3.11.4 on: without it a name in an archive may lead anywhere
        tell(f"{archive.name} is not unpacked by a Python older than 3.11.4: all is drawn and asked here")
        return
    try:
        with locked(out / "head-start", tell=tell):
            for left in out.glob(f"{_SCRATCH}*"):  # of a run that was killed: nobody else unpacks now
                remove_tree(left)
            with TemporaryDirectory(prefix=_SCRATCH, dir=out) as folder:
                _unpack(archive, Path(folder))
                laid = _lay_all(Path(folder), out)
    except OSError as error:
        message = (
            f"{out} cannot be written ({error.strerror or error}: {error.filename2 or error.filename}): check your "
            "rights and the free space, or name another folder by --out"
        )
        raise StoreError(message) from error
    if laid:
        tell(f"{laid} maps, tasks, truths and runs were packed in {archive.name}, and are not made again")


def _unpack(archive: Path, scratch: Path) -> None:
    """Unpack an archive of folders of `FOLDERS` alone."""
    try:
        with tarfile.open(archive, "r:xz") as packed:
            packed.extractall(scratch, filter="data")
    except (EOFError, lzma.LZMAError, tarfile.TarError) as error:
        mend = "pack it again, or remove it, and all is drawn and asked here"
        message = f"{archive} is damaged ({one_line(str(error))}): {mend}"
        raise StoreError(message) from error
    strange = sorted(path.name for path in scratch.iterdir() if path.name not in FOLDERS or not path.is_dir())
    if strange:
        message = f"{archive} holds {strange[0]!r}: pack the folders {', '.join(sorted(FOLDERS))} alone"
        raise StoreError(message)


def _lay_all(scratch: Path, out: Path) -> int:
    """Move each outermost folder that holds files to where none lies: a map, a task, its truths, a run with its parts.

    Return how many were moved.
    """
    units = {unit: out / unit.relative_to(scratch) for unit in _units(scratch)}
    for target in units.values():  # before the first is moved: where one cannot be, none is
        target.parent.mkdir(parents=True, exist_ok=True)
    new = {unit: target for unit, target in units.items() if not target.exists()}
    for unit, target in new.items():
        unit.rename(target)
    return len(new)


def _units(folder: Path) -> Iterator[Path]:
    for parent, folders, files in os.walk(folder):
        if files:
            folders.clear()  # they belong to it
            yield Path(parent)
