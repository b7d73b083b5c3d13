# SPDX-License-Identifier: Apache-2.0
"""Folders removed whatever is in them."""

import os
from contextlib import suppress
from pathlib import Path
from typing import NamedTuple


def remove_tree(folder: Path) -> None:
    """Remove a folder with all that is in it, whatever a plugin has made there; nothing is raised, no link is followed.

    It goes down and up again folder by folder, with one of them open at a time: neither depth nor long names nor rights
    that were taken away stop it. What the system refuses to remove stays.

    Parameters
    ----------
    folder : Path
        To remove; it need not be there.

    Examples
    --------
    >>> remove_tree(Path("nowhere"))
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
                        return  # moved meanwhile: whatever lies here is none of it
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
    """A folder that is being emptied: what was gone into, what else is left there, and which folder it is."""

    name: str
    left: list[str]
    known: os.stat_result


def _instead(old: int, new: int) -> int:
    os.close(old)
    return new


def _unlinked(name: str, beside: int) -> int | None:
    """Remove a file or link; a folder is opened instead, if it can be."""
    with suppress(OSError):
        os.unlink(name, dir_fd=beside)
        return None
    with suppress(OSError):
        return _opened(name, beside)
    return None


def _opened(name: str, beside: int | None) -> int:
    """A folder to work in, all rights given to its owner; no link is followed."""
    flags = os.O_DIRECTORY | os.O_NOFOLLOW
    if hasattr(os, "O_PATH"):  # opens without the right to read, so that this folder and no other gets its rights
        known = os.open(name, flags | os.O_PATH, dir_fd=beside)
        try:
            with suppress(OSError):
                Path(f"/proc/self/fd/{known}").chmod(0o700)
        finally:
            os.close(known)
    return os.open(name, flags | os.O_RDONLY, dir_fd=beside)
