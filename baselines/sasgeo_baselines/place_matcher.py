# SPDX-License-Identifier: Apache-2.0
"""Base of matchers of single views that can name the best poses within a disc: answers of both tracks from these."""

from abc import ABC, abstractmethod
from collections.abc import Sequence
from typing import Final, Generic, TypeVar

import numpy as np
from numpy.typing import NDArray

from sasgeo_baselines.tunable import Tunable
from sasgeo_bench import (
    WITHHELD,
    Disc,
    Match,
    Mode,
    Pose,
    Prior,
    Query,
    Region,
    is_blind,
    ranked_candidates,
    wrap_deg,
)

MOST_PLACES: Final = 10  # poses of one answer
SPREAD: Final = 2.5  # standard deviations of the prior's heading that are tried: as many as the scorer's
AROUND_M: Final = 24.0  # a view may lie so far from its candidate

View = TypeVar("View")


def turns_within(prior: Prior, count: int, *, spread: float = SPREAD) -> NDArray[np.int64]:
    """Return which of `count` equal parts of a circle are headings that a prior allows, at least that nearest to it.

    >>> ahead = Prior(center_m=None, radius_m=None, yaw_deg=10.0, yaw_sigma_deg=20.0, scale_sigma=0.0)
    >>> turns_within(ahead, 12).tolist()
    [0, 1, 2, 11]
    """
    turns = np.arange(count)
    if prior.yaw_deg is None or prior.yaw_sigma_deg is None:
        return turns
    step_deg = 360.0 / count
    away_deg = np.abs(wrap_deg(turns * step_deg - prior.yaw_deg))
    return np.flatnonzero(away_deg <= spread * prior.yaw_sigma_deg + step_deg / 2)


class PlaceMatcher(Tunable, ABC, Generic[View]):
    """A matcher of single views; a subclass says how it reads a map, how a view, and which poses are best."""

    def __init__(self, **numbers: float) -> None:
        super().__init__(**numbers)
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
            raise RuntimeError(f"{self.card.name}: call prepare() with a region before match()")
        is_empty = is_blind(query) and (query.vectors is None or query.vectors.empty)
        view = None if is_empty else self.look(query)
        if view is None:
            return WITHHELD
        if query.track == "retrieval":
            near = self.near(view, query.candidates)
            poses = [mode.pose if mode else pose for mode, pose in zip(near, query.candidates, strict=True)]
            best = sorted((mode for mode in near if mode), key=lambda mode: -mode.score)
            reported = self.diagnostics(view, best) if best else {}
            scores = [mode.score if mode else None for mode in near]
            return ranked_candidates(query, scores, top_k=top_k, poses=poses, diagnostics=reported)
        disc = Disc(center_m=query.prior.center_m, radius_m=query.prior.radius_m or 0.0)
        found = self.modes(view, disc, count=max(2, min(top_k, MOST_PLACES)))
        if not found:
            return WITHHELD
        values = [mode.score for mode in found]
        reported = self.diagnostics(view, found) | ({"margin": values[0] - values[1]} if len(values) > 1 else {})
        return Match(poses=[mode.pose for mode in found][:top_k], scores=values[:top_k], diagnostics=reported)
