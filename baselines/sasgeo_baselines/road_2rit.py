# SPDX-License-Identifier: Apache-2.0
"""`road_2rit`: pairs of junctions with the directions of their roads, tested by the roads around (Li et al. 2019)."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Final, Self

import numpy as np
from scipy.spatial import cKDTree

from sasgeo_baselines.place_matcher import AROUND_M, PlaceMatcher
from sasgeo_baselines.pose_votes import SLACK_M, Bools, Floats, allowed, pose_of, rigid_poses
from sasgeo_baselines.roads import MappedRoads, SeenRoads
from sasgeo_bench import (
    NODE_KINDS,
    Disc,
    MappedGraph,
    MatcherCard,
    Mode,
    Nodes,
    ObservedGraph,
    Pose,
    Prior,
    Query,
    Region,
    thinned,
)

LENGTH_M: Final = (20.0, 230.0)  # of a pair: past one junction, and as far as two of a view of 192 m usually lie
APART_M: Final = 25.0
JUNCTIONS: Final = tuple(at for at, kind in enumerate(NODE_KINDS) if kind.name.endswith("intersection"))


@dataclass(frozen=True, kw_only=True)
class Tuples:
    """Pairs of junctions of one kind: T pairs, the shortest first, each with the bearings of its roads.

    `ends_m`, shape (T, 2, 2), are the places; `arms_deg`, shape (T, 2, A), bearings counted from that of the pair, NaN
    behind the last one.
    """

    ends_m: Floats
    length_m: Floats
    arms_deg: Floats

    @classmethod
    def of(cls, nodes: Nodes, kind: int) -> Self:
        """Pair the junctions of a kind that have at least three roads.

        Examples
        --------
        Two junctions of three roads, 50 m apart, the second one to the east:

        >>> import sasgeo_bench as sgb
        >>> cells = np.zeros((1, 128, 128), dtype=np.uint8)
        >>> cells[0, 60:66] = cells[0, :64, 30:36] = cells[0, 64:, 80:86] = sgb.PRESENT
        >>> view = sgb.Evidence(classes=("road_minor",), cells=cells, cell_size_m=1.0)
        >>> found = Tuples.of(sgb.ObservedGraph.make(view).nodes, JUNCTIONS[1])
        >>> found.length_m.round().tolist(), np.sort(found.arms_deg).round(-1)[0, :, :3].tolist()
        ([50.0], [[0.0, 180.0, 270.0], [0.0, 90.0, 180.0]])
        """
        # At least 3 arms of a junction
        chosen = np.flatnonzero((nodes.kind == kind) & (np.isfinite(nodes.arms_deg).sum(axis=1) >= 3))
        places_m = nodes.places_m[chosen]
        pairs = np.zeros((0, 2), dtype=np.int64)
        if len(chosen):
            pairs = cKDTree(places_m).query_pairs(LENGTH_M[1], output_type="ndarray").astype(np.int64)
        along_m = places_m[pairs[:, 1]] - places_m[pairs[:, 0]]
        length_m = np.hypot(*along_m.T)
        order = np.lexsort((pairs[:, 1], pairs[:, 0], length_m))
        order = order[length_m[order] >= LENGTH_M[0]]
        bearing_deg = np.degrees(np.arctan2(along_m[order, 0], along_m[order, 1]))
        ends = chosen[pairs[order]]
        arms_deg = np.mod(nodes.arms_deg[ends] - bearing_deg[:, None, None], 360.0)
        return cls(ends_m=nodes.places_m[ends], length_m=length_m[order], arms_deg=arms_deg)

    def some(self, rows: slice) -> Self:
        """Return some of the pairs."""
        return type(self)(ends_m=self.ends_m[rows], length_m=self.length_m[rows], arms_deg=self.arms_deg[rows])

    def turned(self) -> Self:
        """Return the pairs from their other ends."""
        arms_deg = np.mod(self.arms_deg[:, ::-1] + 180.0, 360.0)
        return type(self)(ends_m=self.ends_m[:, ::-1], length_m=self.length_m, arms_deg=arms_deg)


def same_arms(ours_deg: Floats, theirs_deg: Floats, *, turn_deg: float, least: int) -> Bools:
    """Return which junctions may be the same by the bearings of their roads: at least `least` of them agree.

    Parameters
    ----------
    ours_deg : ndarray of float, shape (A,)
        Bearings of one junction, NaN behind the last one.
    theirs_deg : ndarray of float, shape (N, B)
        Those of others.
    turn_deg : float
        By which two bearings of one road may differ.
    least : int
        Number of roads of one junction that have one of the other.

    Examples
    --------
    >>> crossing = np.array([0.0, 90.0, 180.0, 270.0])
    >>> others = np.array([[80.0, 170.0, 281.0], [45.0, 170.0, 281.0], [45.0, 135.0, 270.0]])
    >>> same_arms(crossing, others, turn_deg=20.0, least=2).tolist()
    [True, True, False]
    """
    off_deg = np.abs(np.mod(theirs_deg[:, :, None] - ours_deg + 180.0, 360.0) - 180.0)
    agrees = off_deg <= turn_deg  # never of a NaN
    common = np.minimum(agrees.any(axis=1).sum(axis=1), agrees.any(axis=2).sum(axis=1))
    return np.asarray(common >= least)


@dataclass(frozen=True, kw_only=True)
class RoadView:
    """Pairs of junctions of a view, by kind, its roads, and what is known of its heading."""

    pairs: dict[int, Tuples]
    roads: SeenRoads
    prior: Prior


class Road2Rit(PlaceMatcher[RoadView]):
    """Tuples of two junctions with tangents give poses; the roads around decide between them."""

    open_numbers = {
        "turn_deg": (10.0, 20.0, 30.0),  # of a road: that of a mask bends within a road's width of a junction
        "bearings": (1, 2),  # that agree at each end: a detector misses roads at junctions, and adds some
    }
    chosen = {"turn_deg": 20.0, "bearings": 1}

    card = MatcherCard(
        name="road_2rit",
        version="1",
        title="Pairs of junctions with the directions of their roads",
        source=(
            "Li, Yang, Wang and He, Road-network-based Rapid Geolocalization, arXiv 1906.12174, as its abstract "
            "describes it: tuples of two road intersections with their tangents, necessary conditions for two tuples "
            "to match, the transformation in closed form, and a test of every hypothesis on points of the roads"
        ),
        ours=(
            "Junctions and the bearings of their roads are those of the SASGeo scorer's graph. Tuples of 20 to 230 m "
            "match where lengths agree within 8 m (or two standard deviations of the scale) and, at both ends, of the "
            f"bearings at least {chosen['bearings']:g} agree within {chosen['turn_deg']:g} degrees, counted from the "
            "axis of the pair (a condition that missed roads leave true); the 150 longest tuples of a view are looked "
            "up. A match gives a rigid pose instead of a homography, since views are metric. Poses that the prior "
            "allows are tested on 60 seen points of roads; the best 600 by the share of seen points within 5 m of a "
            "mapped road, less the share of mapped points in the known part of the view that no seen road is near; "
            "the best 24, 6 m apart, are fitted to the roads by ICP and tested again. Roads are the middle lines of "
            "masks on both sides, of a view its vectors if it has any"
        ),
        licence="Apache-2.0",
        tracks=("retrieval", "localization"),
        limits=(
            "Roads are major and minor ones and paths; blind where any of the three is unknown all over, or fewer than "
            "two whole junctions of three roads are seen; roads alone count, buildings and "
            "ground do not; scale is 1; no tilt; no sequence, no weights by what lasts; no confidence but the score"
        ),
    )

    def read(self, region: Region, learned: str | None) -> None:
        """Read junctions and roads of the map."""
        del learned
        nodes = MappedGraph.of(region).nodes
        self._pairs = {kind: Tuples.of(nodes, kind) for kind in JUNCTIONS}
        self._roads = MappedRoads.of(region)

    def look(self, query: Query) -> RoadView | None:
        """Return the junctions and the roads of a view; None if it has no pair of whole junctions, or hardly a road."""
        seen = ObservedGraph.of(query)
        nodes, roads = seen.nodes.taken(~seen.is_cut), SeenRoads.of(query)
        pairs = {kind: Tuples.of(nodes, kind) for kind in JUNCTIONS}
        # At least 20 points along roads of a view
        if not any(len(found.length_m) for found in pairs.values()) or len(roads.points_m) < 20:
            return None
        return RoadView(pairs=pairs, roads=roads, prior=query.prior)

    def modes(self, view: RoadView, disc: Disc, *, count: int) -> list[Mode]:
        """Return the poses whose roads agree best."""
        return self._tested(view, self.poses(view, disc), disc)[:count]

    def near(self, view: RoadView, poses: Sequence[Pose]) -> list[Mode | None]:
        """Return the best pose near each candidate; tuples are looked up once for all."""
        found = self.poses(view, Disc(center_m=None, radius_m=0.0))
        discs = [Disc(center_m=(pose.easting_m, pose.northing_m), radius_m=AROUND_M) for pose in poses]
        tested = (self._tested(view, found[allowed(found, view.prior, disc)], disc) for disc in discs)
        return [next(iter(modes), None) for modes in tested]

    def poses(self, view: RoadView, disc: Disc) -> Floats:
        """Return the poses that tuples of the view and of the map name and the prior allows, shape (V, 3)."""
        return np.concatenate([np.zeros((0, 3)), *self._hypotheses(view, disc)])

    def _hypotheses(self, view: RoadView, disc: Disc) -> Iterator[Floats]:
        turn_deg, bearings = self.numbers["turn_deg"], int(self.numbers["bearings"])
        for kind, ours in view.pairs.items():
            # 8 m of a length, or two standard deviations of the scale if that is more
            slack_m = np.maximum(8.0, 2.0 * view.prior.scale_sigma * ours.length_m)
            # At most 150 pairs of a view, the longest first: they give the best heading
            for row in range(len(ours.length_m))[: -150 - 1 : -1]:
                low, high = ours.length_m[row] - slack_m[row], ours.length_m[row] + slack_m[row]
                once = self._pairs[kind].some(slice(*np.searchsorted(self._pairs[kind].length_m, [low, high])))
                for theirs in (once, once.turned()):
                    poses = rigid_poses(np.broadcast_to(ours.ends_m[row], theirs.ends_m.shape), theirs.ends_m)
                    may = np.flatnonzero(allowed(poses, view.prior, disc))
                    for end, own_deg in enumerate(ours.arms_deg[row]):
                        may = may[same_arms(own_deg, theirs.arms_deg[may, end], turn_deg=turn_deg, least=bearings)]
                    yield poses[may]

    def _tested(self, view: RoadView, poses: Floats, disc: Disc) -> list[Mode]:
        if not len(poses):
            return []
        points_m = view.roads.points_m
        few_m = points_m[:: max(1, len(points_m) // 60)]  # 60: seen points of the first test
        # 600 poses of the second test: all seen points, and the mapped ones
        first = np.argsort(-self._roads.hits(few_m, poses), kind="stable")[:600]
        modes = self._judged(view, [pose_of(row) for row in poses[first]])
        # 6 m: of poses this near to each other only the best is fitted
        best = thinned(modes, 6.0, 24)  # poses that are fitted to the roads
        settled = [self._roads.settled(view.roads, mode.pose, disc.wider(SLACK_M)) for mode in best]
        return thinned(self._judged(view, settled), APART_M)

    def _judged(self, view: RoadView, poses: Sequence[Pose]) -> list[Mode]:
        modes = [Mode(pose=pose, score=round(self._roads.agreement(view.roads, pose), 9)) for pose in poses]
        return sorted(modes, key=lambda mode: -mode.score)
