# SPDX-License-Identifier: Apache-2.0
"""A private seed: text that only its owner knows, and all that may be said of it in files."""

import hashlib
import math
import re
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

from sasgeo_bench.errors import ConfigError

LEAST_BITS: Final = 64  # with fewer it can be found: a query's id lets anybody check a guess, some 10^6 a second
REPRODUCING_BITS: Final = 128  # asked of a seed that is to vouch for a row
_DIGITS: Final = re.compile(r"[0-9a-f]{1,1024}")


@dataclass(frozen=True, slots=True)
class PrivateSeed:
    """A seed that is never written: files hold its commitment, texts and `repr` nothing.

    Parameters
    ----------
    text : str
        Random digits, decimal or hexadecimal, as of `secrets.token_hex(16)`.
    file : Path, optional
        Where it was read from; matchers must not see it.

    Raises
    ------
    ConfigError
        If the text holds anything but digits; the message does not quote it.

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
        """Bits that so many digits can hold at most; whether they are random, nobody can see."""
        return math.floor(len(self.text) * math.log2(10 if self.text.isdecimal() else 16) + 1e-9)

    @property
    def commitment(self) -> str:
        """SHA-256 of the seed in a context of its own: two files of one seed agree, and neither gives it away.

        Of 128 random bits nobody finds what was hashed: 10^12 guesses a second take 10^19 years. Of few bits a guess
        would find it, as it would by the id of a query.
        """
        return hashlib.sha256(f"sasgeo-bench private seed {self.text}".encode()).hexdigest()

    @property
    def root(self) -> str:
        """Root of all chance that comes of it; no number that is a public seed has the same."""
        return f"private {self.text}"


Seed = int | PrivateSeed


def seed_said(seed: Seed) -> dict[str, Any]:
    """What files hold of a seed: a public one itself, of a private one the commitment and its bits.

    Examples
    --------
    >>> seed_said(7)
    {'seed': 7}
    >>> seed_said(PrivateSeed("3f" * 16))["private_seed"]["bits"]
    128
    """
    if isinstance(seed, int):
        return {"seed": seed}
    return {"private_seed": {"commitment": seed.commitment, "bits": seed.bits}}
