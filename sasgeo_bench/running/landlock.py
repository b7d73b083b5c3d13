# SPDX-License-Identifier: Apache-2.0
"""Landlock: the kernel refuses every file, TCP port and process that is not allowed."""

import ctypes
import errno
import os
import struct
import sys
from collections.abc import Iterator, Sequence
from typing import Final

from sasgeo_bench.running import kernel

LANDLOCK_CREATE: Final = 444
LANDLOCK_ADD: Final = 445
LANDLOCK_RESTRICT: Final = 446
LANDLOCK_VERSION: Final = 1
RULE_PATH: Final = 1

# Rights of Landlock by the version that brought them; https://docs.kernel.org/userspace-api/landlock.html
READ_RIGHTS: Final = 0b1101  # execute, read file, read directory
WRITE_RIGHT: Final = 0b10  # write file
LIST_RIGHT: Final = 0b1000  # read directory
_FIRST_RIGHTS: Final = (1 << 13) - 1
TRUNCATE_SINCE: Final = 3
_LATER_RIGHTS: Final = {2: 1 << 13, TRUNCATE_SINCE: 1 << 14, 5: 1 << 15}  # refer, truncate, ioctl on devices
_FILE_RIGHTS: Final = 0b111 | 1 << 14 | 1 << 15  # those that a rule on a single file may hold
NET_SINCE: Final = 4
_NET_RIGHTS: Final = 0b11  # bind and connect of TCP
SCOPE_SINCE: Final = 6
_SCOPES: Final = 0b11  # abstract sockets and signals leave the domain


def landlock_version() -> int:
    """Version of Landlock that the kernel offers; 0 where it has none.

    Examples
    --------
    >>> landlock_version() >= 0
    True
    """
    if sys.platform != "linux":
        return 0
    found = kernel.syscall(LANDLOCK_CREATE, None, 0, LANDLOCK_VERSION)
    return max(0, found)


def restrict(allowed: Sequence[tuple[str, int]], writable: Sequence[str], version: int) -> None:
    """Refuse every file that is not allowed; there is no way back for this process and its children.

    Parameters
    ----------
    allowed : sequence of (str, int)
        Files and folders, and the rights to them and all within.
    writable : sequence of str
        Folders with all rights.
    version : int
        Of Landlock, at least 1.
    """
    rights = _FIRST_RIGHTS
    for since, later in _LATER_RIGHTS.items():
        rights |= later if version >= since else 0
    attributes = struct.pack(
        "QQQ", rights, _NET_RIGHTS if version >= NET_SINCE else 0, _SCOPES if version >= SCOPE_SINCE else 0
    )
    size = 24 if version >= SCOPE_SINCE else 16 if version >= NET_SINCE else 8
    ruleset = kernel.syscall(LANDLOCK_CREATE, ctypes.c_char_p(attributes), ctypes.c_size_t(size), 0)
    if ruleset < 0:
        raise OSError(-ruleset, os.strerror(-ruleset))
    for path, granted in (*allowed, *((path, rights) for path in writable)):
        _allow(ruleset, path, granted & rights)
    kernel.prctl(kernel.PR_SET_NO_NEW_PRIVS, 1)
    refused = kernel.syscall(LANDLOCK_RESTRICT, ruleset, 0)
    os.close(ruleset)
    if refused < 0:
        raise OSError(-refused, os.strerror(-refused))


def _allow(ruleset: int, path: str, rights: int) -> None:
    """Add a rule for a folder or a file; one that is not there is passed over."""
    try:
        descriptor = os.open(path, os.O_PATH | os.O_CLOEXEC)
    except OSError:
        return
    try:
        if not os.path.isdir(path):  # noqa: PTH112 - no pathlib before the door is shut
            rights &= _FILE_RIGHTS
        rule = struct.pack("=Qi", rights, descriptor)
        added = kernel.syscall(LANDLOCK_ADD, ruleset, RULE_PATH, ctypes.c_char_p(rule), 0)
        if added < 0 and added != -errno.EINVAL:
            raise OSError(-added, os.strerror(-added), path)
    finally:
        os.close(descriptor)


def outermost(paths: Sequence[str]) -> list[str]:
    """Resolve paths that exist, and drop those inside another one: a covered folder needs no second cover.

    Examples
    --------
    >>> outermost(["/usr/lib", "/usr", "/usr/../usr", "/nowhere"])
    ['/usr']
    """
    found: list[str] = []
    for path in sorted({os.path.realpath(path) for path in paths}, key=lambda path: path.split("/")):
        if os.path.exists(path) and not (found and path.startswith(f"{found[-1]}/")):  # noqa: PTH110 - no pathlib yet
            found.append(path)
    return found


def around(path: str, hidden: Sequence[str]) -> Iterator[tuple[str, int]]:
    """A path with the right to read it; where something hidden lies within, all else that lies there now.

    Of a folder that holds something hidden the names can be listed, or nothing in it could be imported. Links in it
    are passed over: what they lead to is read where it lies, if that is in reach, and nobody looked through it else.

    Examples
    --------
    >>> [name for name, _ in around("/usr", ["/home/me/truth"])]
    ['/usr']
    >>> list(around("/home/me/truth/vaduz", ["/home/me/truth"]))
    []
    """
    real = os.path.realpath(path)
    if any(real == folder or real.startswith(f"{folder}/") for folder in hidden):
        return
    inside = [folder for folder in hidden if folder.startswith(f"{real.rstrip('/')}/")]
    if not inside:
        yield path, READ_RIGHTS
        return
    try:
        names = sorted(os.listdir(real))  # noqa: PTH208 - no pathlib before the door is shut
    except OSError:
        return
    yield real, LIST_RIGHT
    for name in names:
        inner = f"{real.rstrip('/')}/{name}"
        if not os.path.islink(inner):  # noqa: PTH114 - no pathlib before the door is shut
            yield from around(inner, hidden)
