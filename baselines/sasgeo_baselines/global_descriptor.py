# SPDX-License-Identifier: Apache-2.0
"""`global_descriptor`: shares of classes, blind to their places; and the graph descriptor of the paper."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import chain
from typing import Final, Self

import cv2
import numpy as np
from numpy.typing import NDArray

from sasgeo_bench import (
    PRESENT,
    UNKNOWN,
    WITHHELD,
    Grid,
    Match,
    MatcherCard,
    Prior,
    Query,
    Region,
    at_place,
    is_blind,
    middle_m,
    offsets_m,
    points_of,
    ranked_candidates,
)


def lattice_m(prior: Prior, grid: Grid, *, step_m: float) -> NDArray[np.float64]:
    """Return places on the map within the disc of a prior, on multiples of a step, north to south, shape (N, 2).

    The centre of the disc if there is none.

    Examples
    --------
    >>> small = Prior(center_m=(0.0, 0.0), radius_m=5.0, yaw_deg=None, yaw_sigma_deg=None, scale_sigma=0.03)
    >>> grid = Grid(epsg=32632, west_m=-8.0, north_m=8.0, cell_size_m=1.0, rows=16, cols=16)
    >>> lattice_m(small, grid, step_m=5.0).tolist()
    [[0.0, 5.0], [-5.0, 0.0], [0.0, 0.0], [5.0, 0.0], [0.0, -5.0]]
    """
    west_m, south_m, east_m, north_m = grid.bounds_m
    center_m = middle_m(prior, grid)
    if prior.radius_m is not None:
        west_m, east_m = max(west_m, center_m[0] - prior.radius_m), min(east_m, center_m[0] + prior.radius_m)
        south_m, north_m = max(south_m, center_m[1] - prior.radius_m), min(north_m, center_m[1] + prior.radius_m)
    eastings = np.arange(np.ceil(west_m / step_m), np.floor(east_m / step_m) + 1) * step_m
    northings = np.arange(np.floor(north_m / step_m), np.ceil(south_m / step_m) - 1, -1) * step_m
    points = np.column_stack((np.tile(eastings, len(northings)), np.repeat(northings, len(eastings))))
    if prior.radius_m is not None:
        points = points[offsets_m(points, center_m) <= prior.radius_m]
    return points if len(points) else np.array([center_m])


@dataclass(frozen=True, kw_only=True)
class Sums:
    """Summed-area table of a map: cells of each class and, last, known cells.

    `below` is int64 of shape (C + 1, rows + 1, cols + 1): sums over all coarse cells above and left.
    """

    grid: Grid
    below: NDArray[np.int64]

    @classmethod
    def of(cls, region: Region, classes: tuple[str, ...] | None = None) -> Self:
        """Sum the layers of a region, or of some of its classes."""
        # 4 m a cell of the sums; finer ones take memory and add nothing
        factor = max(1, round(4.0 / region.grid.cell_size_m))
        names = [name for name in region.classes if classes is None or name in classes]
        known = region.known()
        grid = region.grid.coarsen(factor)
        below = np.zeros((len(names) + 1, grid.rows + 1, grid.cols + 1), dtype=np.int64)
        summed = chain(((region.layer(name) == PRESENT) & known for name in names), (known,))
        for into, layer in zip(below, summed, strict=True):
            padded = np.zeros((grid.rows * factor, grid.cols * factor), dtype=bool)
            padded[: layer.shape[0], : layer.shape[1]] = layer
            blocks = padded.reshape(grid.rows, factor, grid.cols, factor).sum(axis=(1, 3), dtype=np.int64)
            into[1:, 1:] = blocks.cumsum(axis=0).cumsum(axis=1)
        return cls(grid=grid, below=below)

    def squares(self, points_m: NDArray[np.float64], side_m: float) -> NDArray[np.int64]:
        """Return cells of each class and, last, known cells in upright squares around places, shape (C + 1, N)."""
        corners = (points_m - side_m / 2, points_m + side_m / 2)
        (left, bottom), (right, top) = (np.rint(self.grid.to_uv(corner)).astype(np.int64).T for corner in corners)
        left, right = (np.clip(edge, 0, self.grid.cols) for edge in (left, right))
        top, bottom = (np.clip(edge, 0, self.grid.rows) for edge in (top, bottom))
        sums = self.below
        return np.asarray(sums[:, bottom, right] - sums[:, top, right] - sums[:, bottom, left] + sums[:, top, left])


def separate(points_m: NDArray[np.float64], scores: NDArray[np.float64], *, apart_m: float, most: int) -> list[int]:
    """Return indices of the best places, none nearer to a better one than a distance; ties keep their order."""
    left = scores.astype(np.float64)
    chosen: list[int] = []
    while len(chosen) < most:
        at = int(np.argmax(left))
        if not np.isfinite(left[at]):
            break
        chosen.append(at)
        left[offsets_m(points_m, (points_m[at, 0], points_m[at, 1])) < apart_m] = -np.inf
    return chosen


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
            raise RuntimeError(f"{self.card.name}: call prepare() with a region before match()")
        if is_blind(query):
            return WITHHELD
        diagnostics = {"known_share": 1.0 - query.evidence.unknown_share}
        if query.track == "retrieval":
            scores = self._scores(self._sums, query, points_of(query.candidates)).tolist()
            kept = [score if math.isfinite(score) else None for score in scores]
            return ranked_candidates(query, kept, top_k=top_k, diagnostics=diagnostics)
        points_m = lattice_m(query.prior, self._region, step_m=STEP_M)
        scores = self._scores(self._sums, query, points_m)
        chosen = separate(points_m, scores, apart_m=APART_M, most=top_k)
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
    """Return the share of the known cells in which each class is present; NaN where none is known."""
    known = [int((layer != UNKNOWN).sum()) for layer in cells]
    present = [int((layer == PRESENT).sum()) for layer in cells]
    return [there / count if count else math.nan for there, count in zip(present, known, strict=True)]


BINS: Final = 16  # of distances, from 0 to the longest possible
LEAST_M2: Final = 9.0  # smaller patches are noise
MOST_THINGS: Final = 1000  # of a kind, the largest: bounds the number of pairs


@dataclass(frozen=True, kw_only=True)
class Descriptor:
    """Counts of objects by kind, shape (K,), and histograms of the distances of their pairs; invariant to rotation.

    `spread` has shape (K, BINS); each row sums to 1, or is 0 where there is no pair.
    """

    counts: NDArray[np.float64]
    spread: NDArray[np.float64]

    @classmethod
    def of(cls, things_m: Sequence[NDArray[np.float64]], *, reach_m: float) -> Self:
        """Describe places of objects of each kind, shape (N, 2) each, metres; `reach_m` is the longest distance."""
        counts = np.array([len(places_m) for places_m in things_m], dtype=np.float64)
        spread = [distances(places_m, reach_m=reach_m) for places_m in things_m]
        return cls(counts=counts, spread=np.array(spread, dtype=np.float64).reshape(-1, BINS))

    def scaled(self, shares: NDArray[np.float64]) -> Self:
        """Return the descriptor with counts scaled to shares of the area, kind by kind."""
        return replace(self, counts=self.counts * shares)

    def distance(self, other: Self) -> float:
        """Return the distance of two descriptors, 0..1: the mean over kinds of counts and histograms.

        Counts n and m differ by |n - m| / (n + m + 1), so that one of few counts little; histograms by half their L1
        distance.

        Examples
        --------
        >>> one, four = (Descriptor(counts=np.array([n]), spread=np.zeros((1, BINS))) for n in (1.0, 4.0))
        >>> one.distance(four)
        0.25
        """
        if not len(self.counts):
            return 0.0
        by_count = np.abs(self.counts - other.counts) / (self.counts + other.counts + 1)
        by_spread = np.abs(self.spread - other.spread).sum(axis=1) / 2
        return float((by_count + by_spread).mean() / 2)


def distances(places_m: NDArray[np.float64], *, reach_m: float) -> NDArray[np.float64]:
    """Return the histogram of the distances of all pairs, shape (BINS,), of sum 1; zeros where there is no pair.

    Each distance is split between its two nearest bins, so that small moves make small differences.
    """
    from scipy.spatial.distance import pdist  # noqa: PLC0415 - slow to import, and most matchers need no distances

    made = np.zeros(BINS)
    if len(places_m) > 1:
        at = np.minimum(pdist(places_m) * ((BINS - 1) / reach_m), BINS - 1)
        low = np.minimum(at.astype(np.int64), BINS - 2)
        upper = at - low
        made += np.bincount(low, weights=1 - upper, minlength=BINS)
        made += np.bincount(low + 1, weights=upper, minlength=BINS)
        made /= len(at)
    return made


def components(present: NDArray[np.uint8], *, cell_size_m: float) -> NDArray[np.float64]:
    """Return centroids of the connected patches of a layer, metres right and down from its corner, shape (N, 2).

    Cells that touch at a corner are connected. Patches under `LEAST_M2` are dropped; at most `MOST_THINGS` are kept,
    the largest.

    Examples
    --------
    >>> layer = np.zeros((8, 8), dtype=np.uint8)
    >>> layer[:3, :3] = layer[4:8, 4:8] = layer[0, 7] = 1
    >>> components(layer, cell_size_m=1.0).tolist()
    [[6.0, 6.0], [1.5, 1.5]]
    """
    if not present.any():
        return np.zeros((0, 2))
    _, _, stats, centroids = cv2.connectedComponentsWithStats(present, connectivity=8)
    areas = stats[1:, cv2.CC_STAT_AREA]
    order = np.argsort(-areas, kind="stable")[:MOST_THINGS]
    kept = order[areas[order] * cell_size_m**2 >= LEAST_M2]
    # 0.5 of a cell: OpenCV counts from the middle of the first one
    return np.asarray((centroids[1:][kept] + 0.5) * cell_size_m, dtype=np.float64)
