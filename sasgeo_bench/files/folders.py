# SPDX-License-Identifier: Apache-2.0
"""Write folders whole or not at all, by one run at a time; remove folders of any content."""

import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import NamedTuple

from filelock import FileLock, Timeout

from sasgeo_bench.errors import StoreError


def remove_tree(folder: Path) -> None:
    """Remove a folder with all its content, whatever a plugin has made there; raise nothing, follow no link.

    It goes down and up again folder by folder, with one of them open at a time: depth, long names and missing rights do
    not stop it. What the system refuses to remove stays; the folder need not exist.
    """
    with suppress(OSError):
        here = _opened(str(folder), None)
        try:
            above: list[_Above] = []
            left = os.listdir(here)  # noqa: PTH208 - no path is short enough
            while left or above:
                if not left:
                    name, left, known = above.pop()
                    here = _instead(here, os.open("..", os.O_RDONLY | os.O_DIRECTORY, dir_fd=here))
                    if not os.path.samestat(os.fstat(here), known):
                        return  # moved meanwhile: this is another folder
                    with suppress(OSError):
                        os.rmdir(name, dir_fd=here)
                elif (below := _unlinked(left[-1], here)) is None:
                    left.pop()
                else:
                    above.append(_Above(left.pop(), left, os.fstat(here)))
                    here, left = _instead(here, below), os.listdir(below)  # noqa: PTH208
        finally:
            os.close(here)
        folder.rmdir()


class _Above(NamedTuple):
    """A folder while it is emptied: the entry being emptied, the other entries left, and the identity of the folder."""

    name: str
    left: list[str]
    known: os.stat_result


def _instead(old: int, new: int) -> int:
    os.close(old)
    return new


def _unlinked(name: str, parent: int) -> int | None:
    """Remove a file or link; open a folder instead, if possible."""
    with suppress(OSError):
        os.unlink(name, dir_fd=parent)
        return None
    with suppress(OSError):
        return _opened(name, parent)
    return None


def _opened(name: str, parent: int | None) -> int:
    """Open a folder with all rights given to its owner; follow no link."""
    flags = os.O_DIRECTORY | os.O_NOFOLLOW
    if hasattr(os, "O_PATH"):  # opens without the right to read: exactly this folder gets the rights
        known = os.open(name, flags | os.O_PATH, dir_fd=parent)
        try:
            with suppress(OSError):
                Path(f"/proc/self/fd/{known}").chmod(0o700)
        finally:
            os.close(known)
    return os.open(name, flags | os.O_RDONLY, dir_fd=parent)


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
def fresh_file(path: Path, *, mend: str) -> Iterator[Path]:
    """Yield a scratch file next to `path` that replaces it if the block succeeds, and is removed otherwise.

    Raise `StoreError`, with the advice `mend`, if it cannot be written.
    """
    scratch = path.with_name(f".{path.name}.{os.getpid()}.partial")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        yield scratch
        _flush(scratch)
        scratch.rename(path)
    except OSError as error:
        with suppress(OSError):
            scratch.unlink()
        message = f"{path} cannot be written ({error.strerror or error}): {mend}"
        raise StoreError(message) from error


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
