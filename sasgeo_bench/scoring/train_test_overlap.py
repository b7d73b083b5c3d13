# SPDX-License-Identifier: Apache-2.0
"""Overlap of training and test places: rows of a method that was trained on the place it is tested on."""

from collections.abc import Iterator, Mapping, Sequence

import pandas as pd

from sasgeo_bench.errors import named
from sasgeo_bench.matching.learned_file import LearnedSaid
from sasgeo_bench.scoring.entries import Entry
from sasgeo_bench.scoring.rows import is_unranked
from sasgeo_bench.tasks.split import Split


def set_apart(entries: Sequence[Entry], scores: Mapping[str, pd.DataFrame], split: Split | None) -> dict[str, str]:
    """Return by entry why its rows are excluded from ranks; other entries are missing.

    Rows are excluded if the answers about a place come from training on that place. Controls are unranked anyway.
    `scores` has the columns suite, region and place of every query the entry was asked; `split` assigns the half of
    each place.
    """
    found = {}
    for entry in entries:
        places = [] if is_unranked(entry.name) else sorted(set(_overlaps(entry, scores[entry.name], split)))
        if places:
            what = places[0] if len(places) == 1 else named(places, "place")
            found[entry.name] = f"trained on {what}, which it is tested on"
    return found


def _overlaps(entry: Entry, scores: pd.DataFrame, split: Split | None) -> Iterator[str]:
    """Yield places that the answers about them were trained on."""
    for place in dict.fromkeys(scores["place"]):
        if place in _declared(entry, str(place), split):
            yield str(place)
    for about in entry.runs:
        learned = LearnedSaid.of(about)
        is_mine = (scores["suite"] == about["suite"]) & (scores["region"] == about["region"])
        yield from set() if learned is None else set(scores.loc[is_mine, "place"]) & set(learned.trained_on)


def _declared(entry: Entry, place: str, split: Split | None) -> Sequence[str]:
    """Return the declared training places of the answers about a place."""
    if entry.submission is None:
        return entry.declared or ()
    return entry.submission.card.taught(None if split is None else split.half_of.get(place))
