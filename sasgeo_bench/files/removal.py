# SPDX-License-Identifier: Apache-2.0
"""Remove folders of any content."""

import os
from contextlib import suppress
from pathlib import Path
from typing import NamedTuple


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
