# SPDX-License-Identifier: Apache-2.0
"""Rules of the graph score, estimated from matchings of training views."""

from collections.abc import Sequence
from dataclasses import replace
from typing import Final

import numpy as np

from sasgeo_bench.sasgeo.graph import START, GraphRules, Matching
from sasgeo_bench.sasgeo.nodes import Ints

WEIGHT: Final = 30.0  # observations that a starting value counts as
_LEAST_SHARE: Final = 0.01  # and most, 1 less it
# While rules are estimated degrees say nothing: else nodes of wrong places would be matched where their degrees agree,
# and agreement would look common there.
BLANK: Final = replace(START, degrees=(0.0,) * len(START.degrees))


def fit_rules(right: Sequence[Matching], wrong: Sequence[Matching]) -> GraphRules:
    """Estimate the rules from matchings at the true poses of views, and at wrong poses that a search found.

    Ratios of degrees and links are the logarithms of their frequencies at right poses over those at wrong ones, hits
    and extra nodes are frequencies.
    """
    hit, extra = _kinds(np.sum([one.kinds for one in right], axis=0))
    links = _ratios([one.links for one in right], [one.links for one in wrong], _LINKS)
    return replace(
        START,
        degrees=_ratios([one.degrees for one in right], [one.degrees for one in wrong], START.degrees),
        link=links[0],
        false_link=links[1],
        lost_link=links[2],
        hit=hit,
        extra=extra,
    )


_LINKS: Final = (START.link, START.false_link, START.lost_link)


def _share(count: int, total: int, start: float) -> float:
    return float(np.clip((count + WEIGHT * start) / (total + WEIGHT), _LEAST_SHARE, 1 - _LEAST_SHARE))


def _kinds(counts: Ints) -> tuple[tuple[float, ...], tuple[float, ...]]:
    """Return hits and extra nodes of each kind, from `Matching.kinds`."""
    due, matched, seen, free = counts.tolist()
    hit = tuple(map(_share, matched, due, START.hit))
    return hit, tuple(map(_share, free, seen, START.extra))


def _ratios(right: Sequence[Ints], wrong: Sequence[Ints], start: Sequence[float]) -> tuple[float, ...]:
    """Return log ratios of the frequencies of some outcomes, right over wrong, mixed with starting values."""
    # One observation of each outcome is shared out by the totals, so that what was never seen has ratio 0. A ratio
    # counts by its precision, a starting value as known to within one nat.
    here, there = (np.sum([*counts, np.zeros(len(start))], axis=0) for counts in (right, wrong))
    if not (here.sum() and there.sum()):
        return tuple(start)
    total = here.sum() + there.sum()
    here, there = here + here.sum() / total, there + there.sum() / total
    found = np.log(here / here.sum()) - np.log(there / there.sum())
    precision = here * there / (here + there)
    return tuple(((precision * found + np.array(start)) / (precision + 1)).tolist())
