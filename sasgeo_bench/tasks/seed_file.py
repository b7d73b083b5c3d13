# SPDX-License-Identifier: Apache-2.0
"""Private seeds as users pass them: a file that only its owner can read, or an environment variable."""

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
SUFFIX: Final = ".seed"  # by which every run recognizes the file and hides it from matchers
_MOST_BYTES: Final = 4096  # more digits are refused
_PR_SET_DUMPABLE: Final = 4


def take_seed(file: Path | None, environ: MutableMapping[str, str] | None = None) -> PrivateSeed | None:
    """Take the private seed of a file `<name>.seed`, or of the environment; None without any.

    The variable is removed from the environment. From then on other processes of the user can read neither the memory
    nor the initial environment of this one (Linux).

    Raises
    ------
    ConfigError
        If both are given, or the text is not a seed.
    StoreError
        If the file cannot be read, others can read it, or it has another suffix.

    Examples
    --------
    >>> environ = {"SASGEO_SEED": "3f" * 16}
    >>> take_seed(None, environ).bits, environ
    (128, {})
    """
    text = (os.environ if environ is None else environ).pop(VARIABLE, None)
    if file is not None and text is not None:
        message = f"--seed-file and {VARIABLE} both give a private seed: leave one of them out"
        raise ConfigError(message)
    if file is None and text is None:
        return None
    if environ is None:
        _close_memory()
    return PrivateSeed((text or "").strip()) if file is None else PrivateSeed(_read(file), file=file.resolve())


def _read(file: Path) -> str:
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
    """Keep other processes of the user from reading this one's memory or environment (/proc/<pid>, ptrace)."""
    if sys.platform == "linux":
        ctypes.CDLL(None).prctl(_PR_SET_DUMPABLE, 0, 0, 0, 0)
