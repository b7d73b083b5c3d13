# SPDX-License-Identifier: Apache-2.0
"""`triangle_rsim`: triangles of building centres, looked up by their shape (Liu et al. 2025)."""

from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass
from itertools import combinations, permutations
from typing import Final, Self

import numpy as np
from scipy.spatial import Delaunay, QhullError, cKDTree

from sasgeo_baselines.object_matcher import FEWEST, PreparedView, fitted
from sasgeo_baselines.place_matcher import PlaceMatcher
from sasgeo_baselines.pose_votes import Floats, Ints, Votes, allowed, rigid_poses
from sasgeo_bench import (
    NODE_KINDS,
    PRESENT,
    Chart,
    Disc,
    MappedGraph,
    MatcherCard,
    Mode,
    Nodes,
    ObservedGraph,
    Pose,
    PoseCheck,
    Query,
    Region,
    inverse,
    thinned,
)

CLASS: Final = "building"
SAME_M: Final = 10.0  # a seen and a mapped building this near are one, for the fit
APART_M: Final = 25.0
FULL: Final = 255  # of a map's degrees

KINDS: Final = tuple(at for at, kind in enumerate(NODE_KINDS) if kind.classes == (CLASS,))


@dataclass(frozen=True, kw_only=True)
class Triangles:
    """Triangles of places, their corners ordered by the length of the side opposite, the shortest first.

    `corners`, int64 of shape (T, 3), are rows of places; `shape`, shape (T, 6), what two like triangles share.
    """

    corners: Ints
    shape: Floats

    @classmethod
    def of(cls, places_m: Floats, area_m2: Floats) -> Self:
        """Join neighbours: Delaunay triangles, and each place with any two of its five nearest.

        Examples
        --------
        >>> found = Triangles.of(np.array([[0.0, 0.0], [40.0, 0.0], [0.0, 30.0]]), np.full(3, 100.0))
        >>> found.corners.tolist()
        [[1, 2, 0]]
        >>> found.shape[0, :2].round(2).tolist()
        [0.6, 0.8]
        """
        corners = _neighbours(places_m)
        sides_m = _sides_m(places_m, corners)
        # 150 m: side of a triangle: longer ones seldom fit into a view
        is_small = (sides_m.max(axis=1) <= 150.0) & (sides_m.min(axis=1) > 0)
        corners, sides_m = corners[is_small], sides_m[is_small]
        corners = np.take_along_axis(corners, np.argsort(sides_m, axis=1, kind="stable"), axis=1)
        return cls(corners=corners, shape=shapes_of(places_m, area_m2, corners))


def _neighbours(places_m: Floats) -> Ints:
    """Return rows of places that make triangles, each once, shape (T, 3)."""
    count = len(places_m)
    found = [np.zeros((0, 3), dtype=np.int64)]
    if count >= FEWEST:
        tree = cKDTree(places_m)
        # 5 buildings around each, any two of which make a triangle with it
        near = np.asarray(tree.query(places_m, k=min(5 + 1, count))[1])  # each is nearest to itself
        found += [
            np.column_stack([near[:, 0], near[:, one], near[:, two]])
            for one, two in combinations(range(1, near.shape[1]), 2)
        ]
        with suppress(QhullError):  # all on one line
            found.append(Delaunay(places_m - places_m.mean(axis=0)).simplices.astype(np.int64))
    return np.unique(np.sort(np.concatenate(found), axis=1), axis=0)


def _sides_m(places_m: Floats, corners: Ints) -> Floats:
    """Return the length of the side opposite to each corner, shape (T, 3)."""
    at = places_m[corners]
    return np.asarray(np.linalg.norm(np.roll(at, -1, axis=1) - np.roll(at, -2, axis=1), axis=2))


def shapes_of(places_m: Floats, area_m2: Floats, corners: Ints) -> Floats:
    """Return the invariants of triangles with their corners in a given order, shape (T, 6).

    Ratios of the first two sides to the third, logarithm of the third, logarithms of the ratios of the first two
    buildings' areas to the third's, and the sense of rotation.
    """
    sides_m, log_area = _sides_m(places_m, corners), np.log(area_m2)[corners]
    one, two = (places_m[corners[:, at]] - places_m[corners[:, 2]] for at in (0, 1))
    sense = np.sign(one[:, 0] * two[:, 1] - one[:, 1] * two[:, 0])
    return np.column_stack(
        [
            sides_m[:, :2] / sides_m[:, 2:],
            np.log(sides_m[:, 2]),
            log_area[:, :2] - log_area[:, 2:],
            sense,
        ]
    )


def differences(ratio: float, log_area: float) -> Floats:
    """Return by how much each number of the shape of like triangles may differ alone, shape (6,)."""
    # 0.15: difference of two logarithms of the longest side, alone, that may be
    # 0.5: a triangle and its mirror image differ by 2: more than all that may differ
    return np.array([ratio, ratio, 0.15, log_area, log_area, 0.5])


@dataclass(frozen=True, kw_only=True)
class BuildingView(PreparedView):
    """Whole buildings of a view, all of one kind of node, and a comparison of its building cells with the map's."""

    kind: int
    check: PoseCheck


class TriangleRsim(PlaceMatcher[BuildingView]):
    """Like triangles vote for poses; the overlap of all buildings decides between them."""

    open_numbers = {
        "ratio": (0.1, 0.15, 0.25),  # difference of two ratios of sides, alone, that may be
        "log_area": (0.5, 1.0),  # the same of the logarithm of a ratio of building areas: masks merge and cut houses
    }
    chosen = {"ratio": 0.1, "log_area": 1.0}

    card = MatcherCard(
        name="triangle_rsim",
        version="1",
        title="Triangles of building centres",
        source=(
            "Liu et al., RSIM: A Rotation and Scale Invariant Map Matching Method for UAV Visual Geolocalization "
            "(IEEE JSTARS 2025), as described in public: patterns of triangles of any three building centres, which "
            "do not depend on rotation and scale, of buildings found in the view and in a vector map"
        ),
        ours=(
            "Buildings are the nodes of the SASGeo scorer's graph. Triangles: Delaunay, and each building with any "
            f"two of its five nearest, sides up to 150 m. Two are alike by ratios of sides ({chosen['ratio']:g}), the "
            "longest side (15 %, since scale is known), ratios of the buildings' areas (their logarithms within "
            f"{chosen['log_area']:g}) and sense of rotation, as one distance in a KD-tree, nearly equal sides in any "
            "order. Of the mapped triangles like a seen one the 100 most alike vote, 30,000 in all at most, each for "
            "a rigid pose, with the more weight the rarer its triangle; the 24 poses with most votes (12 m, 8 "
            "degrees) are fitted to buildings within 10 m and ranked by intersection over union of the building cells "
            "known on both sides"
        ),
        licence="Apache-2.0",
        tracks=("retrieval", "localization"),
        limits=(
            "Blind where fewer than three whole buildings are seen, weak where many houses of a row are one in a mask; "
            "buildings alone count; a building that is missed changes the triangles around; scale is 1; no sequence, "
            "no weights by what lasts; the overlap is its only confidence"
        ),
    )

    def read(self, region: Region, learned: str | None) -> None:
        """Read the buildings of the map and their triangles."""
        del learned
        self._chart = building_chart(region)
        self.index(MappedGraph.of(region).nodes)

    def index(self, nodes: Nodes) -> None:
        """Keep the buildings of a map and their triangles, those of vectors and those of masks."""
        self._nodes = {kind: nodes.taken(nodes.kind == kind) for kind in KINDS}
        self._triangles = {kind: Triangles.of(each.places_m, each.area_m2) for kind, each in self._nodes.items()}

    def look(self, query: Query) -> BuildingView | None:
        """Return the whole buildings of a view; None if they are fewer than three."""
        if CLASS not in query.evidence.classes:
            return None
        seen = ObservedGraph.of(query)
        kind = max(KINDS, key=lambda kind: int((seen.nodes.kind == kind).sum()))
        nodes = seen.nodes.taken(~seen.is_cut & (seen.nodes.kind == kind))
        if len(nodes) < FEWEST:
            return None
        check = PoseCheck(
            chart=self._chart,
            bands=np.zeros(1, dtype=np.int64),
            seen=query.evidence.layer(CLASS)[None],
            cell_size_m=query.evidence.cell_size_m,
        )
        return BuildingView(nodes=nodes, prior=query.prior, kind=kind, check=check)

    def modes(self, view: BuildingView, disc: Disc, *, count: int) -> list[Mode]:
        """Return the poses with most votes by the overlap of their buildings."""
        crowds = self.votes(view, disc).crowds(count=24)  # poses that most triangles vote for
        settled = (self._settled(view, crowd.mode.pose) for crowd in crowds)
        poses = [pose for pose in settled if view.allows(pose, disc)]
        modes = [Mode(pose=pose, score=round(view.check.agreement(pose), 9)) for pose in poses]
        return thinned(sorted(modes, key=lambda mode: -mode.score), APART_M, count)

    def votes(self, view: BuildingView, disc: Disc) -> Votes:
        """Return the poses of like triangles that the prior allows, the rarer a triangle the more weight."""
        cast = np.concatenate([np.zeros((0, 4)), *self._votes(view, disc)])
        return Votes.of(cast[:, :3], cast[:, 3])

    def _votes(self, view: BuildingView, disc: Disc) -> Iterator[Floats]:
        nodes, theirs = self._nodes[view.kind], self._triangles[view.kind]
        middle_m = nodes.places_m[theirs.corners].mean(axis=1)
        within = np.flatnonzero(disc.wider(view.reach_m).holds(middle_m))
        if not len(within):
            return
        may_differ = differences(**self.numbers)
        tree = cKDTree(theirs.shape[within] / may_differ)
        ours = Triangles.of(view.nodes.places_m, view.nodes.area_m2)
        for order in permutations(range(3)):  # nearly equal sides come in any order
            corners = ours.corners[:, order]
            shape = shapes_of(view.nodes.places_m, view.nodes.area_m2, corners)
            # 100 triangles of a map for one of a view, the most alike first
            found = tree.query(shape / may_differ, k=100, distance_upper_bound=1.0)
            away, near = (np.asarray(part) for part in found)
            row, at = np.nonzero(np.isfinite(away))
            hits = within[near[row, at]]
            poses = rigid_poses(view.nodes.places_m[corners[row]], nodes.places_m[theirs.corners[hits]])
            count = np.bincount(row, minlength=len(corners))[row]
            cast = np.column_stack([poses, np.log1p(len(within) / count)])
            yield cast[allowed(poses, view.prior, disc)]

    def _settled(self, view: BuildingView, pose: Pose) -> Pose:
        """Fit a pose to the buildings that are the same from it: each the nearest of the other."""
        seen_m, places_m = view.nodes.places_m, self._nodes[view.kind].places_m
        around = Disc(center_m=(pose.easting_m, pose.northing_m), radius_m=view.reach_m + SAME_M)
        mapped_m = places_m[around.holds(places_m)]
        if not len(mapped_m):
            return pose
        tree = cKDTree(mapped_m)
        away_m, at = (np.asarray(part) for part in tree.query(pose.to_map(seen_m), distance_upper_bound=SAME_M))
        back = np.asarray(cKDTree(seen_m).query(inverse(pose).to_map(mapped_m))[1])
        same = np.flatnonzero(np.isfinite(away_m))
        same = same[back[at[same]] == same]
        return fitted(seen_m[same], mapped_m[at[same]])[0] if len(same) >= FEWEST else pose


def building_chart(region: Region) -> Chart:
    """Return the building layer of a map alone."""
    present = np.zeros((1, *region.grid.shape), dtype=np.uint8)
    if CLASS in region.classes:
        present[0] = (region.layer(CLASS) == PRESENT) * np.uint8(FULL)
    return Chart(grid=region.grid, classes=(CLASS,), degree=present, known=region.known() * np.uint8(FULL))
