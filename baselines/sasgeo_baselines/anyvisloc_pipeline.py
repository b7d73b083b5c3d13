# SPDX-License-Identifier: Apache-2.0
"""`anyvisloc_pipeline`: retrieval of tiles, local features in the best of them, and most inliers (AnyVisLoc)."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Final, Self

import cv2
import numpy as np
from numpy.typing import NDArray

from sasgeo_baselines.global_descriptor import Sums, lattice_m, shares
from sasgeo_baselines.image.features import Features, detect
from sasgeo_baselines.image.orb_homography import LEAST_MATCHES, NEAR_M, is_likely, similarity
from sasgeo_baselines.place_matcher import AROUND_M, PlaceMatcher
from sasgeo_bench import (
    PRESENT,
    UNKNOWN,
    Disc,
    Evidence,
    Grid,
    Match,
    MatcherCard,
    Mode,
    Pose,
    Prior,
    Query,
    Region,
    at_place,
    points_of,
    thinned,
)

TOP: Final = 5  # tiles that are matched
APART_M: Final = 25.0
GROUND: Final = 128  # grey of what has no class
# Later classes are drawn over earlier ones; neighbours differ in grey, so that their rims are seen.
GREYS: Final = {
    "farmland": 150,
    "bare": 170,
    "green": 90,
    "water": 30,
    "coastline": 10,
    "waterway": 30,
    "parking": 175,
    "field_boundary": 110,
    "path_track": 190,
    "railway": 60,
    "road_minor": 215,
    "road_major": 235,
    "bridge": 200,
    "building": 0,
}
_TILE_CELLS: Final = 512
_MARGIN_CELLS: Final = 48  # around a tile, so that its edge has features too


@dataclass(frozen=True, kw_only=True)
class Drawing:
    """Classes drawn in grey, uint8 of shape (rows, cols), and where any class is known."""

    grey: NDArray[np.uint8]
    is_known: NDArray[np.bool_]

    @classmethod
    def of_view(cls, evidence: Evidence, cell_size_m: float) -> Self:
        """Draw a view in cells as large as those of the map."""
        grey = drawn(lambda name: evidence.layer(name) == PRESENT, evidence.classes, evidence.shape)
        is_known = (evidence.cells != UNKNOWN).any(axis=0).astype(np.uint8)
        ratio = evidence.cell_size_m / cell_size_m
        size = (max(1, round(evidence.shape[1] * ratio)), max(1, round(evidence.shape[0] * ratio)))
        sized = [cv2.resize(plane, size, interpolation=cv2.INTER_NEAREST) for plane in (grey, is_known)]
        return cls(grey=np.asarray(sized[0], dtype=np.uint8), is_known=np.asarray(sized[1], dtype=bool))

    @classmethod
    def of_map(cls, region: Region) -> Self:
        """Draw a map."""
        known = region.known()
        grey = drawn(lambda name: (region.layer(name) == PRESENT) & known, region.classes, region.grid.shape)
        return cls(grey=grey, is_known=known)


def drawn(
    present: Callable[[str], NDArray[np.bool_]], classes: Sequence[str], shape: tuple[int, int]
) -> NDArray[np.uint8]:
    """Draw where classes are present, in the order of `GREYS`.

    >>> present = {"water": np.array([[True, True, False]]), "bridge": np.array([[False, True, False]])}
    >>> drawn(present.__getitem__, ("bridge", "water"), (1, 3)).tolist()
    [[30, 200, 128]]
    """
    grey = np.full(shape, GROUND, dtype=np.uint8)
    for name, value in GREYS.items():
        if name in classes:
            grey[present(name)] = value
    return grey


@dataclass(frozen=True, kw_only=True)
class PreparedView:
    """A view by the roots of the shares of its classes, by name, and by local features, (right, up) of its middle."""

    roots: dict[str, float]
    features: Features
    side_m: float
    prior: Prior


class AnyvislocPipeline(PlaceMatcher[PreparedView]):
    """The five most similar tiles, and the one in which most local features agree on a similarity."""

    open_numbers = {
        "ratio": (0.75, 0.85, 0.95),  # of the nearest to the second nearest feature
        "per_m2": (0.01, 0.02),  # features: one for about 10 x 10 or 7 x 7 m, as houses have corners
    }
    chosen = {"ratio": 0.85, "per_m2": 0.02}

    card = MatcherCard(
        name="anyvisloc_pipeline",
        version="1",
        title="Tiles by a global descriptor, local features, most inliers",
        source=(
            "Exploring the best way for UAV visual localization under Low-altitude Multi-view Observation Condition: "
            "a Benchmark (AnyVisLoc, arXiv 2503.10692, CVPR 2026 Findings): a gallery of tiles with half cover, "
            "blocks of the size of the footprint; the top 5 by retrieval are matched locally, and the candidate with "
            "most inliers gives the pose; its modes of a prior are whatever a query tells here"
        ),
        ours=(
            "On class layers: the descriptor is the root of each class's share in a square of the view's side, north "
            "up, half a side apart, by Euclidean distance; view and map are drawn in greys by class, in cells of the "
            f"map, and matched one way by ORB with a ratio test ({chosen['ratio']:g}), a feature for each "
            f"{1 / chosen['per_m2']:g} m2; a similarity by RANSAC (five matches within 3 m at least) in place of PnP, "
            "as a plane has no depth; it is dropped where heading or scale are beyond 2.5 standard deviations of the "
            "prior and some slack, or the place is not allowed. Tiles without a similarity answer with their middle "
            "and the prior's heading, behind all others"
        ),
        licence="Apache-2.0",
        tracks=("retrieval", "localization"),
        limits=(
            "The source matches pictures by deep networks; drawn classes have corners only where classes meet. The "
            "descriptor is blind to where things lie, and what it misses no feature finds; the number of inliers, a "
            "diagnostic, is its only confidence; no sequence, no weights by what lasts"
        ),
    )

    def read(self, region: Region, learned: str | None) -> None:
        """Sum the classes of the map, and find its features."""
        del learned
        self._grid, self._classes = region.grid, region.classes
        self._sums = Sums.of(region)
        self._features = map_features(Drawing.of_map(region), region.grid, per_m2=self.numbers["per_m2"])

    def look(self, query: Query) -> PreparedView | None:
        """Return descriptor and features of a view; None where no class of the map is known in it."""
        seen = query.evidence
        found = zip(seen.classes, shares(seen.cells), strict=True)
        roots = {name: math.sqrt(share) for name, share in found if name in self._classes and not math.isnan(share)}
        if not roots:
            return None
        drawing = Drawing.of_view(seen, self._grid.cell_size_m)
        side_m = max(seen.size_m)
        features = view_features(drawing, self._grid, per_m2=self.numbers["per_m2"])
        return PreparedView(roots=roots, features=features, side_m=side_m, prior=query.prior)

    def match(self, query: Query, *, top_k: int) -> Match:
        """Return the poses of the best tiles, and the number of inliers of the first."""
        found = super().match(query, top_k=top_k)
        if not found.poses:
            return found
        return replace(found, diagnostics={**found.diagnostics, "inliers": max(found.scores[0], 0.0)})

    def modes(self, view: PreparedView, disc: Disc, *, count: int) -> list[Mode]:
        """Return the poses of the best tiles within a disc."""
        # 0.5: step of the side of a tile to the next: they overlap by half
        places_m = lattice_m(view.prior, self._grid, step_m=0.5 * view.side_m)
        tiles = [at_place(place_m, view.prior) for place_m in places_m[disc.holds(places_m)]]
        found = [mode for mode in self._matched(view, tiles, [disc] * len(tiles), most=TOP) if mode is not None]
        return thinned(sorted(found, key=lambda mode: -mode.score), APART_M, count)

    def near(self, view: PreparedView, poses: Sequence[Pose]) -> list[Mode | None]:
        """Return the pose that the tile around each candidate gives; of all but the best it is the candidate's own."""
        tiles = [at_place((pose.easting_m, pose.northing_m), view.prior) for pose in poses]
        discs = [Disc(center_m=(pose.easting_m, pose.northing_m), radius_m=AROUND_M) for pose in poses]
        return self._matched(view, tiles, discs, most=len(tiles))

    def _matched(
        self, view: PreparedView, tiles: Sequence[Pose], discs: Sequence[Disc], *, most: int
    ) -> list[Mode | None]:
        """Return a mode for each of the `most` tiles that are most alike, None for the others."""
        # Its score is the number of inliers of the first `TOP` tiles; without any, minus the distance of descriptors.
        # Distances of descriptors of tiles, shape (N,); infinite where the map is unknown
        places_m = points_of(tiles)
        counts = self._sums.squares(places_m, view.side_m)
        squared = np.zeros(len(places_m))
        for name, root in view.roots.items():
            squared += (np.sqrt(counts[self._classes.index(name)] / np.maximum(counts[-1], 1)) - root) ** 2
        away = np.where(counts[-1] > 0, np.sqrt(squared), np.inf)
        found: list[Mode | None] = [None] * len(tiles)
        for rank, at in enumerate(np.argsort(away, kind="stable")[:most].tolist()):
            if not math.isfinite(away[at]):
                break
            best = self._local(view, tiles[at], discs[at]) if rank < TOP else None
            found[at] = best or Mode(pose=tiles[at], score=-float(away[at]))
        return found

    def _local(self, view: PreparedView, tile: Pose, disc: Disc) -> Mode | None:
        """Match a view with the features of a tile; None where too few agree, or on what the prior excludes."""
        away_m = np.abs(self._features.points - (tile.easting_m, tile.northing_m))
        mapped = self._features.chosen(np.asarray((away_m <= view.side_m / 2).all(axis=1)))
        seen_m, mapped_m = paired(view.features, mapped, ratio=self.numbers["ratio"])
        mode = similarity(seen_m, mapped_m)
        if mode is None or not is_likely(mode.pose, view.prior) or not disc.has(mode.pose):
            return None
        errors_m = np.linalg.norm(mode.pose.to_map(seen_m) - mapped_m, axis=1)
        return replace(mode, score=float((errors_m <= NEAR_M).sum()))


def paired(seen: Features, mapped: Features, *, ratio: float) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return places of features that are clearly nearest to each other by their descriptors, shape (N, 2) each."""
    if min(len(seen), len(mapped)) < LEAST_MATCHES:
        return np.zeros((0, 2)), np.zeros((0, 2))
    nearest = cv2.BFMatcher(cv2.NORM_HAMMING).knnMatch(seen.descriptors, mapped.descriptors, k=2)
    chosen = [first for first, second in nearest if first.distance < ratio * second.distance]
    ours, theirs = (np.array([getattr(item, name) for item in chosen], dtype=int) for name in ("queryIdx", "trainIdx"))
    return seen.points[ours], mapped.points[theirs]


def view_features(drawing: Drawing, grid: Grid, *, per_m2: float) -> Features:
    """Return the features of a view, (right, up) of its middle, metres."""
    found = detect(drawing.grey, drawing.is_known, most=_most(drawing.grey.shape, grid, per_m2))
    rows, cols = drawing.grey.shape
    right_up = (found.points - (cols / 2, rows / 2)) * (grid.cell_size_m, -grid.cell_size_m)
    return Features(points=right_up, descriptors=found.descriptors)


def map_features(drawing: Drawing, grid: Grid, *, per_m2: float) -> Features:
    """Return the features of a map, easting and northing, found tile by tile."""
    parts = []
    for row, col, tile in grid.windows(_TILE_CELLS):
        top, left = max(row - _MARGIN_CELLS, 0), max(col - _MARGIN_CELLS, 0)
        cut = np.s_[top : row + tile.rows + _MARGIN_CELLS, left : col + tile.cols + _MARGIN_CELLS]
        grey = drawing.grey[cut]
        found = detect(grey, drawing.is_known[cut], most=_most(grey.shape, grid, per_m2))
        points = found.points + np.array([left, top])
        is_own = np.asarray(((points >= (col, row)) & (points < (col + tile.cols, row + tile.rows))).all(axis=1))
        parts.append(Features(points=grid.to_en_m(points), descriptors=found.descriptors).chosen(is_own))
    return Features(
        points=np.concatenate([part.points for part in parts]),
        descriptors=np.concatenate([part.descriptors for part in parts]),
    )


def _most(shape: tuple[int, ...], grid: Grid, per_m2: float) -> int:
    return max(1, round(per_m2 * shape[0] * shape[1] * grid.cell_size_m**2))
