# SPDX-License-Identifier: Apache-2.0
"""Private seeds as a user hands them over: a file that nobody else can read, or an environment variable."""

import ctypes
import os
import stat
import sys
from collections.abc import MutableMapping
from pathlib import Path
from typing import Final

from sasgeo_bench.errors import ConfigError, StoreError
from sasgeo_bench.tasks.private_seed import PrivateSeed

VARIABLE: Final = "SASGEO_SEED"
SUFFIX: Final = ".seed"  # by which every run knows the file, and hides it from matchers
_MOST_BYTES: Final = 4096  # more digits are refused
_PR_SET_DUMPABLE: Final = 4


def take_seed(file: Path | None, environ: MutableMapping[str, str] | None = None) -> PrivateSeed | None:
    """Take the private seed that a user has handed over; None without any.

    The variable is removed from the environment, and from here on other processes of the user can look neither into the
    memory nor into the first environment of this one (Linux).

    Parameters
    ----------
    file : Path, optional
        A file `<name>.seed`, readable by its owner alone.
    environ : mutable mapping, optional
        The process's environment unless given.

    Raises
    ------
    ConfigError
        If both are given, or the text is no seed.
    StoreError
        If the file cannot be read, others can read it, or it is named otherwise.

    Examples
    --------
    >>> environ = {"SASGEO_SEED": "3f" * 16}
    >>> take_seed(None, environ).bits, environ
    (128, {})
    """
    said = (os.environ if environ is None else environ).pop(VARIABLE, None)
    if file is not None and said is not None:
        message = f"--seed-file and {VARIABLE} both give a private seed: leave one of them out"
        raise ConfigError(message)
    if file is None and said is None:
        return None
    if environ is None:
        _close_memory()
    return PrivateSeed((said or "").strip()) if file is None else PrivateSeed(_read(file), file=file.resolve())


def _read(file: Path) -> str:
    """Text of a seed file that its owner alone can read."""
    if file.suffix != SUFFIX:
        message = f"{file} must be named <name>{SUFFIX}, by which runs know what to hide from matchers: rename it"
        raise StoreError(message)
    try:
        status, text = file.stat(), file.read_bytes()[: _MOST_BYTES + 1].decode("ascii", errors="replace")
    except OSError as error:
        message = f"{file} cannot be read ({error.strerror or error}): name the file of the private seed"
        raise StoreError(message) from error
    if status.st_mode & (stat.S_IRWXG | stat.S_IRWXO):
        message = f"{file} can be read by others (mode {stat.S_IMODE(status.st_mode):03o}): chmod 600 {file}"
        raise StoreError(message)
    return text.strip()


def _close_memory() -> None:
    """Let no other process of the user read this one's memory or environment (/proc/<pid>/mem, environ, ptrace)."""
    if sys.platform == "linux":
        ctypes.CDLL(None).prctl(_PR_SET_DUMPABLE, 0, 0, 0, 0)
