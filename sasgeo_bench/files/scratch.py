# SPDX-License-Identifier: Apache-2.0
"""Scratch folders, in the system's temporary one or elsewhere; those of a killed program are removed by the next."""

import fcntl
import os
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from functools import cache
from pathlib import Path
from typing import Final

from sasgeo_bench.files.folders import remove_tree

PREFIX: Final = "sasgeo-scratch-"
_NEW: Final = ".sasgeo-new-"  # until it is locked: nobody sweeps a folder of this name


@contextmanager
def scratch_folder(what: str, *, within: Path | None = None) -> Iterator[Path]:
    """Yield an empty resolved folder, and remove it at the end, whatever is in it then.

    The folder is locked while its program lives: an unlocked one is a leftover, and is removed when another program
    makes its first one there. `what` is a word of the name, and `within` a folder other than the system's.
    """
    root = Path(tempfile.gettempdir() if within is None else within).resolve()
    _sweep_once(root)
    folder = Path(tempfile.mkdtemp(prefix=f"{_NEW}{what}-", dir=root))
    lock = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
    try:
        with suppress(OSError):  # where a file system locks no folder, nothing is swept
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
            folder = folder.rename(folder.with_name(PREFIX + folder.name.removeprefix(_NEW)))
        yield folder
    finally:
        remove_tree(folder)
        os.close(lock)


def sweep(root: Path) -> int:
    """Remove the scratch folders of programs that were killed; return how many. Those of other users stay."""
    swept = 0
    for folder in sorted(root.glob(f"{PREFIX}*")):
        with suppress(OSError):  # a link, a file, another user's, locked, or gone meanwhile
            lock = os.open(folder, os.O_RDONLY | os.O_DIRECTORY | os.O_NOFOLLOW)
            try:
                if os.fstat(lock).st_uid != os.geteuid():
                    continue
                fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
                remove_tree(folder)
                swept += 1
            finally:
                os.close(lock)
    return swept


@cache
def _sweep_once(root: Path) -> int:
    return sweep(root)
