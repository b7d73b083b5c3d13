# SPDX-License-Identifier: Apache-2.0
"""Rows of a conformance table, and those that every kind of plugin has."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Final, Literal

from sasgeo_bench.errors import MatchError
from sasgeo_bench.files.plugins import check_card_name
from sasgeo_bench.matching.matcher import MatcherCard
from sasgeo_bench.matching.segmenter import SegmenterCard
from sasgeo_bench.running.replies import PluginReply

Outcome = Literal["pass", "fail", "not applicable"]
Listing = Mapping[str, tuple[int, int]]

LEARNS: Final = "learns, the same text twice"  # a row of those that have a learn()
_LOADS: Final = "loads, and has a card"
_MOST_NAMED: Final = 3


@dataclass(frozen=True, slots=True, kw_only=True)
class Check:
    """One row of the table."""

    name: str
    outcome: Outcome
    found: str


def check_of(name: str, fault: str | None, found: str) -> Check:
    """Return a row that fails by a fault, or passes with what was found.

    >>> check_of("the same answer twice", None, "4 images").outcome
    'pass'
    """
    return Check(name=name, outcome="fail" if fault else "pass", found=fault or found)


def loaded_check(spec: str, reply: PluginReply, card: MatcherCard | SegmenterCard | None, *, group: str) -> Check:
    """Check that a plugin of a group of entry points was loaded, and that its card has a name of its own."""
    if reply.status != "ok" or card is None:
        return Check(name=_LOADS, outcome="fail", found=reply.message)
    try:
        check_card_name(spec, card.name, group=group)
    except MatchError as error:
        return Check(name=_LOADS, outcome="fail", found=str(error))
    return Check(name=_LOADS, outcome="pass", found=f"{card.name} {card.version}")


def taught_check(first: PluginReply, second: PluginReply, lessons: str) -> Check:
    """Check that two trainings on the same lessons, each in a process of its own, gave the same text."""
    lost = next((reply for reply in (first, second) if reply.learned is None), None)
    fault = "another text the second time" if lost is None and first.learned != second.learned else ""
    fault = fault if lost is None else f"{lost.status}: {lost.message}"
    size = len((first.learned or "").encode())
    return check_of(LEARNS, fault, f"{size} bytes from {lessons}, {first.seconds or 0.0:.2f} s")


def refusal_of(reply: PluginReply) -> str:
    """Return what a process was refused, in words; empty if nothing was."""
    return reply.message if reply.status == "refused" else ""


def listing_of(folder: Path) -> Listing:
    """List everything below a folder, files with size and time of writing."""
    found = {path.relative_to(folder).as_posix(): path for path in folder.rglob("*")}
    status = {name: path.stat() for name, path in found.items() if path.is_file()}
    return {name: (status[name].st_size, status[name].st_mtime_ns) if name in status else (0, 0) for name in found}


def kept_check(refused: str, before: Listing, after: Listing, limited: str) -> Check:
    """Check that nothing outside the scratch folder was refused, or written where no sandbox refuses it."""
    changed = sorted(path for path in before.keys() | after.keys() if before.get(path) != after.get(path))
    fault = f"wrote among maps and tasks: {', '.join(changed[:_MOST_NAMED])}" if changed else ""
    fault = f"was refused what it asked for: {refused}" if refused else fault
    return check_of(
        "kept to its scratch folder", fault, limited or "not shut in: looked for files among maps and tasks alone"
    )
