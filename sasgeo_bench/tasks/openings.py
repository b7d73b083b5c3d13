# SPDX-License-Identifier: Apache-2.0
"""Which sealed places of a split were opened, when, and by which seed: a file that is written before they are drawn."""

import datetime as dt
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Annotated, Final, Self

from pydantic import BaseModel, ConfigDict, Field, TypeAdapter, ValidationError

from sasgeo_bench.config import Record
from sasgeo_bench.errors import StoreError
from sasgeo_bench.files.folders import fresh_file, locked
from sasgeo_bench.files.json import read_json
from sasgeo_bench.progress import tell
from sasgeo_bench.tasks.private_seed import PrivateSeed
from sasgeo_bench.texts import json_text

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
