# SPDX-License-Identifier: Apache-2.0
"""`global_descriptor`: shares of classes, blind to their places."""

import math
from typing import Final

import numpy as np
from numpy.typing import NDArray

from sasgeo_baselines.places import Sums, first_apart, lattice_m
from sasgeo_bench import (
    PRESENT,
    UNKNOWN,
    WITHHELD,
    Match,
    MatcherCard,
    Query,
    Region,
    at_place,
    is_blind,
    points_of,
    ranked_candidates,
)

STEP_M: Final = 32.0  # no place is further than 23 m from one of the lattice
APART_M: Final = 25.0


class GlobalDescriptor:
    """Compare the share of every class in the view with those in squares of the map."""

    card = MatcherCard(
        name="global_descriptor",
        version="1",
        title="Shares of classes",
        source="SASGeo paper (Trukhina and Vashkelis), Section VI, variant 1",
        ours=(
            "The paper names no formula: here the share of the known cells that each class covers, Euclidean distance; "
            "map squares are upright, of the view's side at scale 1; localization by a lattice of 32 m within the prior"
        ),
        licence="Apache-2.0",
        tracks=("retrieval", "localization"),
        limits="Blind to where things lie; heading is the prior's (north if unknown), scale 1; no confidence",
    )

    def __init__(self) -> None:
        self._sums: Sums | None = None

    def prepare(self, region: Region, learned: str | None) -> None:
        """Sum the layers of the map."""
        del learned
        self._sums = Sums.of(region)
        self._region = region.grid
        self._classes = region.classes

    def match(self, query: Query, *, top_k: int) -> Match:
        """Rank candidates, or places of a lattice, by the distance of their shares from those of the view."""
        if self._sums is None:
            message = f"{self.card.name}: call prepare() with a region before match()"
            raise RuntimeError(message)
        if is_blind(query):
            return WITHHELD
        diagnostics = {"known_share": 1.0 - query.evidence.unknown_share}
        if query.track == "retrieval":
            scores = self._scores(self._sums, query, points_of(query.candidates)).tolist()
            kept = [score if math.isfinite(score) else None for score in scores]
            return ranked_candidates(query, kept, top_k=top_k, diagnostics=diagnostics)
        points_m = lattice_m(query.prior, self._region, step_m=STEP_M)
        scores = self._scores(self._sums, query, points_m)
        chosen = first_apart(points_m, scores, apart_m=APART_M, most=top_k)
        poses = [at_place(points_m[at], query.prior) for at in chosen]
        return Match(poses=poses, scores=[float(scores[at]) for at in chosen], diagnostics=diagnostics)

    def _scores(self, sums: Sums, query: Query, points_m: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return minus the distance of shares, shape (N,); minus infinity where the map is unknown."""
        counts = sums.squares(points_m, max(query.evidence.size_m))
        seen = shares(query.evidence.cells)
        squared = np.zeros(len(points_m))
        for name, share in zip(query.evidence.classes, seen, strict=True):
            if name in self._classes and not math.isnan(share):
                mapped = counts[self._classes.index(name)] / np.maximum(counts[-1], 1)
                squared += (mapped - share) ** 2
        return np.where(counts[-1] > 0, -np.sqrt(squared), -np.inf)


def shares(cells: NDArray[np.uint8]) -> list[float]:
    """Return the share of the known cells in which each class is present; NaN where none is known.

    Examples
    --------
    >>> shares(np.array([[[1, 0, 0, 2]], [[1, 1, 2, 2]]], dtype=np.uint8))
    [0.3333333333333333, 1.0]
    """
    known = [int((layer != UNKNOWN).sum()) for layer in cells]
    present = [int((layer == PRESENT).sum()) for layer in cells]
    return [there / count if count else math.nan for there, count in zip(present, known, strict=True)]
