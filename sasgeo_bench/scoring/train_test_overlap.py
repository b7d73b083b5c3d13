# SPDX-License-Identifier: Apache-2.0
"""Which rows of a board are set apart: those of a method that a place has taught which it is asked about."""

from collections.abc import Iterator, Mapping, Sequence

import pandas as pd

from sasgeo_bench.errors import named
from sasgeo_bench.matching.learned_file import LearnedSaid
from sasgeo_bench.scoring.entries import Entry
from sasgeo_bench.scoring.rows import is_unranked
from sasgeo_bench.tasks.split import Split


def set_apart(entries: Sequence[Entry], scores: Mapping[str, pd.DataFrame], split: Split | None) -> dict[str, str]:
    """Say why rows are set apart, by contestant; who is not set apart is not in it.

    The rule: a row is set apart where answers about a place come from what that place has taught. Controls and
    yardsticks are beside the ranks anyway.

    Parameters
    ----------
    entries : sequence of Entry
        Who is scored.
    scores : mapping of str to pandas.DataFrame
        By contestant, columns suite, region and place of every query it was asked.
    split : Split, optional
        Says the half of each place.

    Examples
    --------
    >>> set_apart([], {}, None)
    {}
    """
    found = {}
    for entry in entries:
        places = [] if is_unranked(entry.name) else sorted(set(_taught_and_asked(entry, scores[entry.name], split)))
        if places:
            what = places[0] if len(places) == 1 else named(places, "place")
            found[entry.name] = f"trained on {what}, which it is tested on"
    return found


def _taught_and_asked(entry: Entry, scores: pd.DataFrame, split: Split | None) -> Iterator[str]:
    """Places that have taught the very answers about them."""
    for place in dict.fromkeys(scores["place"]):
        if place in _declared(entry, str(place), split):
            yield str(place)
    for about in entry.runs:
        said = LearnedSaid.of(about)
        is_mine = (scores["suite"] == about["suite"]) & (scores["region"] == about["region"])
        yield from set() if said is None else set(scores.loc[is_mine, "place"]) & set(said.trained_on)


def _declared(entry: Entry, place: str, split: Split | None) -> Sequence[str]:
    """Places that are said to have taught the answers about a place."""
    if entry.submission is None:
        return entry.declared or ()
    return entry.submission.card.taught(None if split is None else split.half_of.get(place))
