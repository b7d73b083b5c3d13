# SPDX-License-Identifier: Apache-2.0
"""A private seed, from a file or the environment, and the facts about it that files may hold."""

import ctypes
import datetime as dt
import hashlib
import math
import os
import re
import stat
import sys
from collections.abc import Iterable, Mapping, MutableMapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Final, Self

from pydantic import BaseModel, ConfigDict, Field, TypeAdapter, ValidationError

from sasgeo_bench.core.config import Record
from sasgeo_bench.core.errors import ConfigError, StoreError
from sasgeo_bench.core.folders import fresh_file, locked
from sasgeo_bench.core.json import read_json
from sasgeo_bench.core.paths import plain_file
from sasgeo_bench.core.progress import tell
from sasgeo_bench.core.texts import json_text

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


def seed_record(seed: Seed) -> dict[str, int | dict[str, str | int]]:
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
    if sys.platform != "win32" and status.st_mode & (stat.S_IRWXG | stat.S_IRWXO):  # there these bits say nothing
        raise StoreError(f"{file} can be read by others (mode {stat.S_IMODE(status.st_mode):03o}): chmod 600 {file}")
    return text.strip()


def _close_memory() -> None:
    if sys.platform == "linux":
        ctypes.CDLL(None).prctl(_PR_SET_DUMPABLE, 0, 0, 0, 0)


FOLDER: Final = "sealed"  # below the root of what is built; hidden from matchers
_MEND: Final = "restore it from a copy, for it says which sealed places were opened"


class Opening(BaseModel):
    """One opening of a sealed place: the commitment and bits of the seed that drew it, and the day."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    commitment: Annotated[str, Field(pattern=r"^[0-9a-f]{64}$")]
    bits: Annotated[int, Field(ge=1)]
    opened: dt.date

    @classmethod
    def of(cls, seed: PrivateSeed, opened: dt.date) -> Self:
        """Return the opening by a seed on a day.

        >>> Opening.of(PrivateSeed("3f" * 16, is_sealed=True), dt.date(2026, 11, 23)).to_text()
        '2026-11-23 by seed cd5fd9130682'
        """
        return cls(commitment=seed.commitment, bits=seed.bits, opened=opened)

    def to_text(self) -> str:
        """Return the day and the first digits of the commitment."""
        return f"{self.opened.isoformat()} by seed {self.commitment[:12]}"


class SealedPlace(Record):
    """A sealed place: the commitment of the seed that the board draws it by, if it does, and every opening."""

    drawn_by: Annotated[str, Field(pattern=r"^[0-9a-f]{64}$")] | None
    openings: list[Opening]


Openings = Mapping[str, tuple[Opening, ...]]  # by place, the first one first
_ADAPTER: Final = TypeAdapter(dict[str, tuple[Opening, ...]])


def openings_file(out: Path, split: str) -> Path:
    """Return the file that records the openings of a split below a root."""
    return out / FOLDER / f"{split}.json"


def read_openings(out: Path, split: str) -> Openings:
    """Read the openings of a split below a root; none if nothing was opened there. Raise `StoreError` if damaged."""
    path = openings_file(out, split)
    return parse_openings(read_json(path, mend=_MEND), path) if path.is_file() else {}


def parse_openings(content: object, path: Path) -> Openings:
    """Check openings that were read from a file; raise `StoreError`, which names the file, if they are none."""
    try:
        return _ADAPTER.validate_python(content)
    except ValidationError as error:
        raise StoreError(f"{path} is damaged ({error.errors()[0]['msg']}): {_MEND}") from error


def joined_openings(first: Openings, second: Openings) -> Openings:
    """Return the openings of both by place, each seed once: those of `first` as recorded, then what `second` adds.

    The order is that of the records, never that of the days: anyone may state an earlier day.
    """
    found: dict[str, dict[str, Opening]] = {}
    for place in dict.fromkeys((*first, *second)):
        own = found.setdefault(place, {})
        for item in (*first.get(place, ()), *second.get(place, ())):
            own.setdefault(item.commitment, item)
    return {place: tuple(own.values()) for place, own in found.items()}


def record_openings(out: Path, split: str, places: Iterable[str], opening: Opening) -> Openings:
    """Record that places are opened, and return all openings of the split; one by a known seed is not a new one.

    Raise `StoreError` if the file is damaged or cannot be written.
    """
    path = openings_file(out, split)
    with locked(path):
        before = read_openings(out, split)
        known = joined_openings(before, dict.fromkeys(places, (opening,)))
        if known != before:
            for place in (place for place in known if known[place] != before.get(place)):
                again = f", opened before on {before[place][-1].to_text()}" if before.get(place) else ""
                tell(f"opening sealed place {place}{again}")
            with fresh_file(path, mend="check the free space and your rights") as scratch:
                scratch.write_text(json_text(_ADAPTER.dump_python(dict(known), mode="json")), encoding="utf-8")
    return known


def sealed_record(
    openings: Openings, places: Iterable[str], drawn: Iterable[str], seed: PrivateSeed | None
) -> dict[str, SealedPlace]:
    """Return sealed places for `board.json`: by which seed this board draws each, and every opening.

    >>> sealed_record({}, ["porto"], [], None)["porto"].model_dump()
    {'drawn_by': None, 'openings': []}
    """
    commitment, there = None if seed is None else seed.commitment, set(drawn)
    return {
        place: SealedPlace(drawn_by=commitment if place in there else None, openings=list(openings.get(place, ())))
        for place in places
    }
