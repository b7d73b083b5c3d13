# SPDX-License-Identifier: Apache-2.0
"""Base of matchers that score overlaps of single channels at all places: intersection, information, phase."""

from abc import ABC, abstractmethod
from typing import Final

import numpy as np
from numpy.typing import NDArray

from sasgeo_bench import (
    WITHHELD,
    Chart,
    Evidence,
    Match,
    MatcherCard,
    Overlaps,
    Query,
    Region,
    ShiftPlan,
    ShiftSearch,
    is_blind,
    ranked_candidates,
)

MOST_PLACES: Final = 10  # poses of one answer


class ShiftMatcher(ABC):
    """A matcher of single views by a score of their overlaps with the map; a subclass says which."""

    card: MatcherCard
    plan = ShiftPlan()

    def __init__(self) -> None:
        self._chart: Chart | None = None

    def read(self, region: Region) -> Chart:
        """Return the map; by default its classes as they are."""
        return Chart.of(region)

    def shared(self, evidence: Evidence, chart: Chart) -> list[str]:
        """Return the classes of the map that a view is held against; by default those that both have."""
        return [name for name in chart.classes if name in evidence.classes]

    @abstractmethod
    def channels(self, evidence: Evidence, names: tuple[str, ...]) -> NDArray[np.float32]:
        """Return the view as the score reads it, of the classes `names`, shape (V, rows, cols)."""

    @abstractmethod
    def score(self, overlaps: Overlaps, names: tuple[str, ...]) -> NDArray[np.float32]:
        """Return the score of each place from overlaps of `channels` with the map's classes `names` and known cells."""

    def prepare(self, region: Region, learned: str | None) -> None:
        """Read the map."""
        del learned
        self._chart = self.read(region)
        self._used = self._chart.used()

    def match(self, query: Query, *, top_k: int) -> Match:
        """Return the best poses, or rank the candidates by the best pose near each."""
        search = None if is_blind(query) else self.search(query)
        if search is None:
            return WITHHELD
        if query.track == "retrieval":
            near = search.candidates(query.candidates)
            poses = [mode.pose if mode else pose for mode, pose in zip(near, query.candidates, strict=True)]
            return ranked_candidates(query, [mode.score if mode else None for mode in near], top_k=top_k, poses=poses)
        found = search.places(min(top_k, MOST_PLACES))
        if not found:
            return WITHHELD
        scores = [mode.score for mode in found]
        margin = {"margin": scores[0] - scores[1]} if len(scores) > 1 else {}
        return Match(poses=[mode.pose for mode in found], scores=scores, diagnostics=margin)

    def search(self, query: Query) -> ShiftSearch | None:
        """Return the search for a view; None where it shares no class with the map."""
        if self._chart is None:
            message = f"{self.card.name}: call prepare() with a region before match()"
            raise RuntimeError(message)
        chart, seen = self._chart, query.evidence
        names = tuple(name for name in self.shared(seen, chart) if self._used[chart.classes.index(name)])
        if not names:
            return None
        return ShiftSearch(
            chart=chart,
            bands=np.array([chart.classes.index(name) for name in names], dtype=np.int64),
            channels=self.channels(seen, names),
            cell_size_m=seen.cell_size_m,
            score=lambda overlaps: self.score(overlaps, names),
            prior=query.prior,
            plan=self.plan,
        )
