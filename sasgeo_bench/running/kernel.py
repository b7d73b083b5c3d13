# SPDX-License-Identifier: Apache-2.0
"""Calls of the Linux kernel that Python has no name for."""

import ctypes
import os
import sys
from typing import Final

PR_SET_PDEATHSIG: Final = 1
PR_SET_DUMPABLE: Final = 4
PR_SET_CHILD_SUBREAPER: Final = 36
PR_SET_NO_NEW_PRIVS: Final = 38


def libc() -> ctypes.CDLL:
    """Load the C library; a call that fails leaves its error number for `last_error`."""
    return ctypes.CDLL(None, use_errno=True)


def last_error() -> OSError:
    """Error of the last call that failed."""
    number = ctypes.get_errno()
    return OSError(number, os.strerror(number))


def syscall(number: int, *arguments: object) -> int:
    """Call the kernel by number; the negative error number where it refuses."""
    library = libc()
    library.syscall.restype = ctypes.c_long
    result = int(library.syscall(ctypes.c_long(number), *arguments))
    return result if result >= 0 else -ctypes.get_errno()


def prctl(option: int, value: int) -> bool:
    """Set a property of this process; False where the system does not know it."""
    return sys.platform == "linux" and int(libc().prctl(option, value, 0, 0, 0)) == 0


def mount(source: str, target: str, kind: str | None, flags: int, data: str = "") -> None:
    """Mount something, or change what is mounted.

    Raises
    ------
    OSError
        If the kernel refuses.
    """
    given = (os.fsencode(source), os.fsencode(target), kind.encode() if kind else None)
    if libc().mount(*given, ctypes.c_ulong(flags), data.encode() or None) != 0:
        raise last_error()
