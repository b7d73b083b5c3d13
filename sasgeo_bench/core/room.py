# SPDX-License-Identifier: Apache-2.0
"""A room in the user's cache for what is made once and asked for again: whole entries, within one size.

An entry is a file, or a folder that `seal` closed; its name is the hash of all that it follows from. It may be removed
at any time.
"""

import json
import os
import shutil
import time
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Final, NamedTuple, Self

from sasgeo_bench.core.errors import StoreError
from sasgeo_bench.core.folders import remove_tree
from sasgeo_bench.core.paths import plain_file
from sasgeo_bench.core.progress import tell

VARIABLE: Final = "SASGEO_KEPT_MB"  # most megabytes that are kept; 0 keeps nothing
MOST_MB: Final = 4000
_ABOUT: Final = "kept.json"  # of a folder, written last: sizes of the other files
_LEFT_S: Final = 3600  # nothing is made for an hour: what is older was left by a process that was killed
_DIGITS: Final = 12  # of a number of megabytes: Python reads no endless ones


def cache_home() -> Path:
    """Return the program's folder in the user's cache (`XDG_CACHE_HOME`); raise `StoreError` if the user has none."""
    cache_home = Path(os.environ.get("XDG_CACHE_HOME", ""))
    with suppress(RuntimeError):  # of a user who is only a number, as in containers
        cache_home = cache_home if cache_home.is_absolute() else Path.home() / ".cache"
    if not cache_home.is_absolute():  # a home may be anything, too
        raise StoreError("you have no home, and so no cache: name a folder by XDG_CACHE_HOME")
    return cache_home / "sasgeo-bench"


class Entry(NamedTuple):
    """A file or folder that is kept, when it was last asked for, and its size."""

    path: Path
    asked_s: float
    size: int


@dataclass(frozen=True)
class Room:
    """The folder of all that is kept: of maps, each in a folder of its own, and of answers that rejectors judged."""

    root: Path

    @classmethod
    def of_user(cls) -> Self:
        """Return that of the user; raise `StoreError` without a cache."""
        return cls(cache_home())

    @property
    def maps(self) -> Path:
        """Return the folder of what is kept of maps."""
        return self.root / "maps"

    @property
    def fits(self) -> Path:
        """Return the folder of what rejectors made of answers."""
        return self.root / "rejectors"

    def entries(self) -> Iterator[Entry]:
        """Yield all that is kept whole."""
        for mark in (*self.maps.glob(f"*/[!.]*/{_ABOUT}"), *self.fits.glob("[!.]*")):
            with suppress(OSError):
                path = mark.parent if mark.name == _ABOUT else mark
                files = [*path.iterdir()] if path.is_dir() else [path]
                yield Entry(path, mark.stat().st_mtime, sum(one.stat().st_size for one in files))

    def make(self, needed: int) -> None:
        """Remove what was not asked for longest, until so many bytes fit; raise `StoreError` if they cannot."""
        for left in (*self.maps.glob(".*"), *self.maps.glob("*/.*"), *self.fits.glob(".*")):
            with suppress(OSError):
                if left.stat().st_mtime < time.time() - _LEFT_S:
                    _remove(left)
        known = sorted(self.entries(), key=lambda entry: entry.asked_s)
        total = sum(entry.size for entry in known)
        if needed > most_bytes():
            raise StoreError(f"{needed / 1e6:.0f} MB are more than {VARIABLE} allows")
        for entry in known:
            if total + needed <= most_bytes():
                break
            _remove(entry.path)
            total -= 0 if os.path.lexists(entry.path) else entry.size
            with suppress(OSError):
                entry.path.parent.rmdir()  # of a map of which nothing is kept any more
        if total + needed > most_bytes():
            raise StoreError(f"{self.root} holds what cannot be removed, and more than {VARIABLE} allows")
        self.root.mkdir(parents=True, exist_ok=True)
        if shutil.disk_usage(self.root).free < 2 * needed:
            raise StoreError(f"{self.root} has too little free space")


def _remove(path: Path) -> None:
    remove_tree(path)
    with suppress(OSError):
        path.unlink()


def most_bytes() -> int:
    """Return how many bytes are kept at most, as `SASGEO_KEPT_MB` says."""
    return _most_mb(os.environ.get(VARIABLE, "")) * 10**6


@cache
def _most_mb(text: str) -> int:
    is_number = text.isdecimal() and len(text) <= _DIGITS
    if text and not is_number:
        tell(f"{VARIABLE} is {text[:40]!r}, no whole number of megabytes: {MOST_MB} are kept at most")
    return int(text) if is_number else MOST_MB


def seal(folder: Path) -> None:
    """Record the sizes of the files of what was made, so that it counts as whole."""
    sizes = {path.name: path.stat().st_size for path in folder.iterdir()}
    (folder / _ABOUT).write_text(json.dumps(sizes), encoding="utf-8")


def is_whole(folder: Path) -> bool:
    """Return whether all that was sealed in a folder is there."""
    try:
        sizes = json.loads(plain_file(folder / _ABOUT).read_text(encoding="utf-8"))
        return bool(sizes) and all((folder / name).stat().st_size == size for name, size in sizes.items())
    except (OSError, ValueError, AttributeError):
        return False


def touch(path: Path) -> None:
    """Note that a file or folder was asked for, where it can be written: what was not asked for longest goes first."""
    with suppress(OSError):
        os.utime(path / _ABOUT if path.is_dir() else path)
