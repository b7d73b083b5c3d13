# SPDX-License-Identifier: Apache-2.0
"""Write folders whole or not at all, by one run at a time."""

import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

from filelock import FileLock, Timeout

from sasgeo_bench.errors import StoreError
from sasgeo_bench.files.removal import remove_tree


@contextmanager
def locked(folder: Path, *, tell: Callable[[str], None]) -> Iterator[None]:
    """Hold the lock of a folder; a second run says so and waits. Raise `StoreError` if the lock cannot be made."""
    lock = FileLock(folder.parent / f".{folder.name}.lock")
    try:
        folder.parent.mkdir(parents=True, exist_ok=True)
        try:
            lock.acquire(timeout=0)
        except Timeout:
            tell(f"{folder} is being written by another run, waiting for it")
            lock.acquire()
    except OSError as error:
        message = f"{folder} cannot be written ({error.strerror or error}): check the free space and your rights"
        raise StoreError(message) from error
    try:
        yield
    finally:
        lock.release()


@contextmanager
def fresh_folder(target: Path) -> Iterator[Path]:
    """Yield an empty folder next to `target` that replaces it if the block succeeds, and is removed otherwise.

    Call it under `locked`: leftovers of a build that was killed are removed first.
    """
    scratch = target.parent / f".{target.name}.partial"
    replaced = target.parent / f".{target.name}.replaced"
    if replaced.exists() and not target.exists():
        replaced.rename(target)  # killed between the two renames below: the old region is still whole
    for leftover in (scratch, replaced):
        _clear(leftover)
    scratch.mkdir(parents=True)
    try:
        yield scratch
        for path in scratch.rglob("*"):
            _flush(path)
        if os.path.lexists(target):  # true also for a broken link
            target.rename(replaced)
        scratch.rename(target)
    finally:
        _clear(scratch)
        _clear(replaced)


def _clear(path: Path) -> None:
    """Remove a folder, or a file or link in its place; the target of a link stays."""
    if path.is_symlink() or path.is_file():
        path.unlink()
    else:
        remove_tree(path)


def _flush(path: Path) -> None:
    """Force a file to the disk before the folder gets its name."""
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
