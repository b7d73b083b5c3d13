# SPDX-License-Identifier: Apache-2.0
"""Paths that a caller gives to a public function, or names in a file."""

import errno
import stat
from contextlib import suppress
from pathlib import Path
from typing import Final

from sasgeo_bench.core.errors import StoreError
from sasgeo_bench.core.texts import one_line

_SPECIAL: Final = {
    stat.S_IFIFO: "a pipe",
    stat.S_IFSOCK: "a socket",
    stat.S_IFCHR: "a device",
    stat.S_IFBLK: "a device",
}


def given_path(value: object) -> Path:
    """Return a path that was given as a text or a path; raise `StoreError` for anything else.

    >>> given_path("out/boards/demo").name
    'demo'
    >>> given_path(5)
    Traceback (most recent call last):
        ...
    sasgeo_bench.core.errors.StoreError: 5 is no path: name a folder or a file, as a text or a Path
    """
    if not isinstance(value, str | Path) or "\0" in str(value) or value == "":
        raise StoreError(f"{one_line(repr(value))} is no path: name a folder or a file, as a text or a Path")
    return Path(value)


def plain_file(path: Path) -> Path:
    """Return the path of a file that is about to be read; raise `OSError` if it is a pipe, a socket or a device.

    To open a pipe waits until another program writes to it, perhaps for ever. Of a folder, or what is not there, the
    opening itself speaks. Every reader of this package calls it.

    >>> plain_file(Path("/dev/null"))
    Traceback (most recent call last):
        ...
    OSError: [Errno 22] it is a device, a plain file is needed: '/dev/null'
    """
    kind = None
    with suppress(OSError, ValueError):
        kind = _SPECIAL.get(stat.S_IFMT(path.stat().st_mode))
    if kind is not None:
        raise OSError(errno.EINVAL, f"it is {kind}, a plain file is needed", str(path))
    return path


def read_bounded(path: Path, most_bytes: int) -> bytes:
    """Return the bytes of a file; raise `OSError` if it has more than so many, or as `plain_file` does.

    >>> read_bounded(Path(__file__), 10**6)[:6]
    b'# SPDX'
    """
    with plain_file(path).open("rb") as source:
        data = source.read(most_bytes + 1)
    if len(data) > most_bytes:
        raise OSError(errno.EFBIG, f"it has more than {most_bytes} bytes", str(path))
    return data
