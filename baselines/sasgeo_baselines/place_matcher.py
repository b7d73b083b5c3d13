# SPDX-License-Identifier: Apache-2.0
"""Base of matchers of single views that can name the best poses within a disc: answers of both tracks from these."""

from abc import ABC, abstractmethod
from collections.abc import Sequence
from typing import Final, Generic, TypeVar

from sasgeo_bench import WITHHELD, Disc, Match, MatcherCard, Mode, Pose, Query, Region, is_blind, ranked_candidates

MOST_PLACES: Final = 10  # poses of one answer
AROUND_M: Final = 24.0  # a view may lie so far from its candidate

View = TypeVar("View")


class PlaceMatcher(ABC, Generic[View]):
    """A matcher of single views; a subclass says how it reads a map, how a view, and which poses are best."""

    card: MatcherCard

    def __init__(self) -> None:
        self._is_ready = False

    @abstractmethod
    def read(self, region: Region, learned: str | None) -> None:
        """Index the map."""

    @abstractmethod
    def look(self, query: Query) -> View | None:
        """Return what is seen, as `modes` reads it; None where it says nothing."""

    @abstractmethod
    def modes(self, view: View, disc: Disc, *, count: int) -> list[Mode]:
        """Return up to `count` poses whose place lies in a disc, best first, apart from each other."""

    def near(self, view: View, poses: Sequence[Pose]) -> list[Mode | None]:
        """Return the best pose near each candidate; None where there is none."""
        discs = [Disc(center_m=(pose.easting_m, pose.northing_m), radius_m=AROUND_M) for pose in poses]
        return [next(iter(self.modes(view, disc, count=1)), None) for disc in discs]

    def diagnostics(self, view: View, found: Sequence[Mode]) -> dict[str, float]:
        """Return further numbers about an answer of at least one pose, best first; by default none."""
        del view, found
        return {}

    def prepare(self, region: Region, learned: str | None) -> None:
        """Index the map."""
        self.read(region, learned)
        self._is_ready = True

    def match(self, query: Query, *, top_k: int) -> Match:
        """Return the best poses, or rank the candidates by the best pose near each."""
        if not self._is_ready:
            message = f"{self.card.name}: call prepare() with a region before match()"
            raise RuntimeError(message)
        is_empty = is_blind(query) and (query.vectors is None or query.vectors.empty)
        view = None if is_empty else self.look(query)
        if view is None:
            return WITHHELD
        if query.track == "retrieval":
            near = self.near(view, query.candidates)
            poses = [mode.pose if mode else pose for mode, pose in zip(near, query.candidates, strict=True)]
            best = sorted((mode for mode in near if mode), key=lambda mode: -mode.score)
            told = self.diagnostics(view, best) if best else {}
            scores = [mode.score if mode else None for mode in near]
            return ranked_candidates(query, scores, top_k=top_k, poses=poses, diagnostics=told)
        disc = Disc(center_m=query.prior.center_m, radius_m=query.prior.radius_m or 0.0)
        found = self.modes(view, disc, count=max(2, min(top_k, MOST_PLACES)))
        if not found:
            return WITHHELD
        values = [mode.score for mode in found]
        told = self.diagnostics(view, found) | ({"margin": values[0] - values[1]} if len(values) > 1 else {})
        return Match(poses=[mode.pose for mode in found][:top_k], scores=values[:top_k], diagnostics=told)
