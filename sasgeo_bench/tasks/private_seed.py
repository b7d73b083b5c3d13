# SPDX-License-Identifier: Apache-2.0
"""A private seed, from a file or the environment, and the facts about it that files may hold."""

import ctypes
import hashlib
import math
import os
import re
import stat
import sys
from collections.abc import MutableMapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

from sasgeo_bench.errors import ConfigError, StoreError
from sasgeo_bench.files.paths import plain_file

LEAST_BITS: Final = 64  # fewer can be guessed: a query's id verifies a guess, some 10^6 a second
REPRODUCING_BITS: Final = 128  # least for a seed that certifies a row
_DIGITS: Final = re.compile(r"[0-9a-f]{1,1024}")


@dataclass(frozen=True, slots=True)
class PrivateSeed:
    """A seed that is never written: files hold its commitment, messages and `repr` nothing.

    With `is_sealed` it draws the sealed places of a split, otherwise all queries of a private run.
    `text` holds random digits, decimal or hexadecimal, as of `secrets.token_hex(16)`; anything else raises a
    ConfigError that does not quote it. Matchers must not see `file`.

    Examples
    --------
    >>> seed = PrivateSeed("3f" * 16)
    >>> seed.bits, seed
    (128, PrivateSeed(file=None))
    """

    text: str = field(repr=False)
    file: Path | None = field(default=None, compare=False)
    is_sealed: bool = field(default=False, repr=False)

    def __post_init__(self) -> None:
        if not _DIGITS.fullmatch(self.text):
            raise ConfigError(
                f"the {self.kind} seed of {self.file or 'the environment'} must be random digits 0-9 and a-f alone, as "
                "secrets.token_hex(16) makes them"
            )

    @property
    def kind(self) -> str:
        """Return "private", or "sealed"."""
        return "sealed" if self.is_sealed else "private"

    @property
    def bits(self) -> int:
        """Return the most bits that so many digits can hold; whether they are random cannot be checked."""
        return math.floor(len(self.text) * math.log2(10 if self.text.isdecimal() else 16) + 1e-9)

    @property
    def commitment(self) -> str:
        """Return the SHA-256 of the seed in its own context: equal for all files of one seed, and revealing for none.

        Nobody finds 128 random bits: 10^12 guesses a second take 10^19 years. Guessing finds a few bits, here and by
        the id of a query.
        """
        return hashlib.sha256(f"sasgeo-bench {self.kind} seed {self.text}".encode()).hexdigest()

    @property
    def root(self) -> str:
        """Return the text that replaces the number of a public seed; no number has the same text."""
        return f"{self.kind} {self.text}"


Seed = int | PrivateSeed


def seed_record(seed: Seed) -> dict[str, Any]:
    """Return what files hold of a seed: a public one itself, of a private one the commitment and its bits."""
    if isinstance(seed, int):
        return {"seed": seed}
    return {f"{seed.kind}_seed": {"commitment": seed.commitment, "bits": seed.bits}}


VARIABLE: Final = "SASGEO_SEED"
SEALED_VARIABLE: Final = "SASGEO_SEALED_SEED"
SUFFIX: Final = ".seed"  # by which every run recognizes the file and hides it from matchers
_PR_SET_DUMPABLE: Final = 4


def take_seed(
    file: Path | None, environ: MutableMapping[str, str] | None = None, *, is_sealed: bool = False
) -> PrivateSeed | None:
    """Take the private seed of a file `<name>.seed`, or of the environment; None without any.

    With `is_sealed` it is the seed of sealed places, which has a flag and a variable of its own.

    The variable is removed from the environment. From then on other processes of the user can read neither the memory
    nor the initial environment of this one (Linux).

    Raises
    ------
    ConfigError
        If both are given, or the text is not a seed.
    StoreError
        If the file cannot be read, others can read it, or it has another suffix.
    """
    kind, flag, variable = (
        ("sealed", "--sealed-seed-file", SEALED_VARIABLE) if is_sealed else ("private", "--seed-file", VARIABLE)
    )
    text = (os.environ if environ is None else environ).pop(variable, None)
    if file is not None and text is not None:
        raise ConfigError(f"{flag} and {variable} both give a {kind} seed: leave one of them out")
    if file is None and text is None:
        return None
    if environ is None:
        _close_memory()
    if file is None:
        return PrivateSeed((text or "").strip(), is_sealed=is_sealed)
    return PrivateSeed(_read(file), file=file.resolve(), is_sealed=is_sealed)


def _read(file: Path) -> str:
    if file.suffix != SUFFIX:
        raise StoreError(
            f"{file} must be named <name>{SUFFIX}, by which runs know what to hide from matchers: rename it"
        )
    try:
        # 4096 bytes: more digits are refused
        status, text = file.stat(), plain_file(file).read_bytes()[: 4096 + 1].decode("ascii", errors="replace")
    except OSError as error:
        raise StoreError(
            f"{file} cannot be read ({error.strerror or error}): name a file with a seed that you can read"
        ) from error
    if status.st_mode & (stat.S_IRWXG | stat.S_IRWXO):
        raise StoreError(f"{file} can be read by others (mode {stat.S_IMODE(status.st_mode):03o}): chmod 600 {file}")
    return text.strip()


def _close_memory() -> None:
    if sys.platform == "linux":
        ctypes.CDLL(None).prctl(_PR_SET_DUMPABLE, 0, 0, 0, 0)
