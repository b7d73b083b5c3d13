# SPDX-License-Identifier: Apache-2.0
"""A private seed: text that only its owner knows, and the facts about it that files may hold."""

import hashlib
import math
import re
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

from sasgeo_bench.errors import ConfigError

LEAST_BITS: Final = 64  # fewer can be guessed: a query's id verifies a guess, some 10^6 a second
REPRODUCING_BITS: Final = 128  # least for a seed that certifies a row
_DIGITS: Final = re.compile(r"[0-9a-f]{1,1024}")


@dataclass(frozen=True, slots=True)
class PrivateSeed:
    """A seed that is never written: files hold its commitment, messages and `repr` nothing.

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

    def __post_init__(self) -> None:
        """Check the digits."""
        if not _DIGITS.fullmatch(self.text):
            message = (
                f"the private seed of {self.file or 'the environment'} must be random digits 0-9 and a-f alone, as "
                "secrets.token_hex(16) makes them"
            )
            raise ConfigError(message)

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
        return hashlib.sha256(f"sasgeo-bench private seed {self.text}".encode()).hexdigest()

    @property
    def root(self) -> str:
        """Return the text that replaces the number of a public seed; no number has the same text."""
        return f"private {self.text}"


Seed = int | PrivateSeed


def seed_record(seed: Seed) -> dict[str, Any]:
    """Return what files hold of a seed: a public one itself, of a private one the commitment and its bits."""
    if isinstance(seed, int):
        return {"seed": seed}
    return {"private_seed": {"commitment": seed.commitment, "bits": seed.bits}}
