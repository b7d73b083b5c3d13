# SPDX-License-Identifier: Apache-2.0
"""Sealed places of a pipeline: closed without their seed; with it they are opened, and the opening is recorded."""

import datetime as dt
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from sasgeo_bench.boards.board_files import BOARD, read_board_manifest
from sasgeo_bench.core.errors import ConfigError
from sasgeo_bench.tasks.private_seed import (
    Opening,
    Openings,
    PrivateSeed,
    SealedPlace,
    joined_openings,
    read_openings,
    record_openings,
    sealed_record,
)
from sasgeo_bench.tasks.split import Split
from sasgeo_bench.tasks.task_plan import Request


@dataclass(frozen=True, kw_only=True)
class Seal:
    """The sealed places of a split: those that a pipeline draws, the seed, and the openings before it."""

    split: Split
    drawn: tuple[str, ...]
    seed: PrivateSeed | None
    openings: Openings
    out: Path

    def lines(self) -> list[str]:
        """Report by place whether it is left out, opened, or opened again."""
        return [f"  sealed {place}: {self._state(place)}" for place in self.split.sealed]

    def _state(self, place: str) -> str:
        before = self.openings.get(place, ())
        if self.seed is None or place not in self.drawn:
            ending = f"opened on {before[-1].to_text()}" if before else "not opened"
            return f"left out, {ending} (--sealed-seed-file opens it)"
        same = next((item for item in before if item.commitment == self.seed.commitment), None)
        if same is not None:
            return f"opened on {same.to_text()}"
        again = f" again, after {before[-1].to_text()}: it is no longer unseen" if before else ""
        return f"to be opened{again}, by seed {self.seed.commitment[:12]}"


def seal_of(
    split: Split, requests: Sequence[Request], seed: PrivateSeed | None, private: PrivateSeed | None, *, out: Path
) -> Seal | None:
    """Return the sealed places of a pipeline; None without any.

    Raise `ConfigError` if their seed is given and nothing is sealed, or together with a private seed.
    """
    if seed is not None and private is not None:
        raise ConfigError("a private seed draws no sealed place: give --seed-file or --sealed-seed-file, not both")
    regions = dict.fromkeys(item.region.id for item in requests)
    drawn = tuple(dict.fromkeys(place for name in regions if (place := split.sealed_place(name)) is not None))
    if seed is not None and not drawn:
        raise ConfigError(
            f"no region of the pipeline is of a sealed place of split {split.spec.id!r}: leave the seed out"
        )
    if not split.sealed:
        return None
    return Seal(split=split, drawn=drawn, seed=seed, openings=read_openings(out, split.spec.id), out=out)


def open_seal(
    seal: Seal, requests: Sequence[Request], *, opened: dt.date | None, stored: Path | None
) -> dict[str, SealedPlace]:
    """Record that sealed places are opened, before anything is drawn, and return what `board.json` says of them.

    `opened` is the day, today (UTC) unless given. `stored` is the folder of stored results of this very pipeline,
    whose openings count, too, and came before those recorded here. Raise `ConfigError` if every test place of a
    hold-out is sealed and stays closed, or the day is in the future or before an opening that is recorded.
    """
    split = seal.split
    places = {place for item in requests for place in split.places_in(item.region.id)}
    if split.spec.kind == "holdout" and not any(split.part_of(place) == "test" for place in places):
        raise ConfigError(
            f"every test place of split {split.spec.id!r} is sealed, so that nothing can be ranked: --sealed-seed-file "
            "opens them"
        )
    openings = seal.openings if stored is None else joined_openings(_stored_openings(stored), seal.openings)
    if seal.seed is not None:
        if opened is not None:
            check_day(opened, seal, openings)
        opening = Opening.of(seal.seed, opened or _today())
        now = record_openings(seal.out, split.spec.id, seal.drawn, opening)
        openings = joined_openings(openings, now)
    return sealed_record(openings, split.sealed, seal.drawn, seal.seed)


def check_day(opened: dt.date, seal: Seal, openings: Openings) -> None:
    """Raise `ConfigError` for a day to come, or before an opening by another seed: days are stated, records are not."""
    if opened > _today():
        raise ConfigError(f"--opened {opened.isoformat()} has not come yet: leave it out, which takes today (UTC)")
    for place in seal.drawn:
        before = openings.get(place, ())
        is_known = seal.seed is not None and seal.seed.commitment in {item.commitment for item in before}
        if before and not is_known and opened < before[-1].opened:
            raise ConfigError(
                f"--opened {opened.isoformat()} is before the recorded opening of sealed place {place}, on "
                f"{before[-1].to_text()}: leave it out, which takes today (UTC)"
            )


def _today() -> dt.date:
    return dt.datetime.now(tz=dt.UTC).date()


def _stored_openings(stored: Path) -> Openings:
    """Return the openings that the board of stored results tells of; none without such a board."""
    if not (stored / BOARD).is_file():
        return {}
    return {place: tuple(item.openings) for place, item in read_board_manifest(stored).sealed.items()}
