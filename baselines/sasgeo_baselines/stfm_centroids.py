# SPDX-License-Identifier: Apache-2.0
"""`stfm_centroids`: each object by the distances, angles and labels of the objects around it (STFM, 2025)."""

from dataclasses import dataclass
from typing import Final, Self

import cv2
import numpy as np
from scipy.spatial import cKDTree
from scipy.spatial.distance import cdist

from sasgeo_baselines.object_matcher import LEFT_OUT, PreparedView
from sasgeo_baselines.place_matcher import PlaceMatcher
from sasgeo_baselines.pose_votes import Floats, Ints, Votes, allowed, rigid_poses
from sasgeo_baselines.roads import view_grid
from sasgeo_bench import (
    NODE_KINDS,
    UNKNOWN,
    Disc,
    Evidence,
    MappedGraph,
    MatcherCard,
    Mode,
    Nodes,
    ObservedGraph,
    Query,
    Region,
    thinned,
)

APART_M: Final = 25.0
OF_OBJECTS: Final = frozenset(name for kind in NODE_KINDS for name in kind.classes)  # classes
_LABEL: Final = float(np.sqrt(0.5))  # so that two labels that differ are 1 apart, as the greatest ratio and 0 are


@dataclass(frozen=True, kw_only=True)
class Patterns:
    """Objects, each with its nearest neighbours in the order of their labels, then of distance.

    `kind`, shape (P,), is the label of the object itself; `corners_m`, shape (P, 1 + neighbours, 2), its place, then
    those of its neighbours; `vector`, shape (P, D), is what is compared; `reach_m`, shape (P,), how far the farthest
    neighbour lies.
    """

    kind: Ints
    corners_m: Floats
    vector: Floats
    reach_m: Floats

    @classmethod
    def of(cls, places_m: Floats, kind: Ints, *, neighbours: int) -> Self:
        """Describe objects by each other, of which there must be more than `neighbours`.

        `vector` holds the ratio of each neighbour's distance to that of the farthest, the turn from the neighbour
        before (from the last one, for the first) as half of its cosine and sine, and the label.

        Examples
        --------
        Five neighbours of one kind, 10 m apart on a line that leads north from the first object:

        >>> places_m = np.array([[0.0, 10.0 * at] for at in range(6)])
        >>> first = Patterns.of(places_m, np.zeros(6, dtype=np.int64), neighbours=5).vector[0]
        >>> first[:5].tolist(), first[5:10].tolist()
        ([0.2, 0.4, 0.6, 0.8, 1.0], [0.5, 0.5, 0.5, 0.5, 0.5])
        """
        found = cKDTree(places_m).query(places_m, k=range(2, neighbours + 2))  # the nearest of an object is itself
        away_m, near = (np.asarray(part) for part in found)
        order = np.lexsort((away_m, kind[near]), axis=1)
        away_m, near = np.take_along_axis(away_m, order, axis=1), np.take_along_axis(near, order, axis=1)
        reach_m = away_m.max(axis=1)
        to_m = places_m[near] - places_m[:, None]
        angle = np.arctan2(to_m[..., 0], to_m[..., 1])
        turn = angle - np.roll(angle, 1, axis=1)
        ratio = away_m / np.where(reach_m > 0, reach_m, 1.0)[:, None]
        label = np.eye(len(NODE_KINDS))[kind[near]].reshape(len(kind), -1) * _LABEL
        return cls(
            kind=kind,
            corners_m=np.concatenate([places_m[:, None], places_m[near]], axis=1),
            vector=np.hstack([ratio, np.cos(turn) / 2, np.sin(turn) / 2, label]),
            reach_m=reach_m,
        )

    def some(self, keep: Ints) -> Self:
        """Return some of the patterns."""
        return type(self)(
            kind=self.kind[keep],
            corners_m=self.corners_m[keep],
            vector=self.vector[keep],
            reach_m=self.reach_m[keep],
        )


def clear_m(evidence: Evidence, places_m: Floats) -> Floats:
    """Return how far places of a view lie from ground where objects may be hidden, or from its border, shape (N,).

    Ground is hidden where a class that objects are made of is unknown, unless the view does not read that class at all.

    Examples
    --------
    >>> view = Evidence(classes=("building",), cells=np.zeros((1, 100, 100), dtype=np.uint8), cell_size_m=1.0)
    >>> clear_m(view, np.array([[0.5, 0.5], [40.5, 0.5]])).tolist()
    [50.0, 10.0]
    """
    layers = (evidence.layer(name) != UNKNOWN for name in evidence.classes if name in OF_OBJECTS)
    read = [known for known in layers if known.any()]
    known = np.pad(np.all(read, axis=0) if read else np.zeros(evidence.shape, dtype=bool), 1).astype(np.uint8)
    away = cv2.distanceTransform(known, cv2.DIST_L2, cv2.DIST_MASK_PRECISE)[1:-1, 1:-1] * evidence.cell_size_m
    rows, cols = evidence.shape
    row, col = np.clip(view_grid(evidence).to_cells(places_m), 0, (rows - 1, cols - 1)).T
    return np.asarray(away[row, col], dtype=np.float64)


def objects_of(nodes: Nodes) -> Nodes:
    """Return the nodes that are objects here: no ends of roads and bends of rivers, and nothing wide."""
    # 30 m: radius of an object: a view cuts wider ones
    return nodes.taken(~np.isin(nodes.kind, LEFT_OUT) & (nodes.radius_m <= 30.0))


@dataclass(frozen=True, kw_only=True)
class PatternView(PreparedView):
    """Objects of a view, and the patterns of those whose neighbours are all seen."""

    patterns: Patterns


class StfmCentroids(PlaceMatcher[PatternView]):
    """Objects match by the pattern of their neighbours; matches vote for poses."""

    open_numbers = {
        "neighbours": (4, 5, 6),  # of an object, the nearest: few enough to lie within a small view around most objects
        "matches": (10, 30),  # mapped objects for a seen one, the most alike first
    }
    chosen = {"neighbours": 4, "matches": 30}

    card = MatcherCard(
        name="stfm_centroids",
        version="1",
        title="Objects by distances, angles and labels of their neighbours",
        source=(
            "A Localization Method for UAV Aerial Images Based on Semantic Topological Feature Matching (Remote "
            "Sensing 2025, 17(10), 1671), as its abstract and headings describe it: centres of segmented objects, "
            "feature vectors of distance ratios, angle differences and semantic labels, which do not depend on "
            "rotation and scale, matched by Euclidean distance"
        ),
        ours=(
            "Objects are the nodes of the SASGeo scorer's graph, up to 30 m in radius, of kinds that the view shows: "
            f"neighbours the {chosen['neighbours']:g} nearest, in the order of label and distance; a ratio is that to "
            "the farthest of them, an angle that from the neighbour before, as half of its cosine and sine, a label 0 "
            "or 1. The source compares whole pictures; here each seen object, if its neighbours all lie nearer than "
            f"the border of what the view knows of the classes of objects, votes with its {chosen['matches']:g} most "
            "alike objects of the map of its own label, by the rigid pose that lays both patterns on each other and "
            "with the weight 1 / (1 + distance). The score is the weight of the votes that agree within 12 m and 8 "
            "degrees"
        ),
        licence="Apache-2.0",
        tracks=("retrieval", "localization"),
        limits=(
            "One object that is missed or made up among the neighbours changes the pattern; blind where fewer than six "
            "whole objects are seen, or none has all its neighbours in view; it does not look at the map again to "
            "verify; scale is not asked, the pose has scale 1; no sequence, no weights by what lasts"
        ),
    )

    def __init__(self, **numbers: float) -> None:
        super().__init__(**numbers)
        self._neighbours, self._matches = int(self.numbers["neighbours"]), int(self.numbers["matches"])

    def read(self, region: Region, learned: str | None) -> None:
        """Read the objects of the map."""
        del learned
        self.index(MappedGraph.of(region).nodes)

    def index(self, nodes: Nodes) -> None:
        """Keep the objects of a map."""
        self._nodes = objects_of(nodes)

    def look(self, query: Query) -> PatternView | None:
        """Return the objects of a view and their patterns; None if no object has all its neighbours in view."""
        seen = ObservedGraph.of(query)
        nodes = objects_of(seen.nodes.taken(~seen.is_cut))
        if len(nodes) <= self._neighbours:
            return None
        found = Patterns.of(nodes.places_m, nodes.kind, neighbours=self._neighbours)
        is_whole = found.reach_m < clear_m(query.evidence, found.corners_m[:, 0])
        if not is_whole.any():
            return None
        return PatternView(nodes=nodes, prior=query.prior, patterns=found.some(np.flatnonzero(is_whole)))

    def modes(self, view: PatternView, disc: Disc, *, count: int) -> list[Mode]:
        """Return the poses that most matches vote for."""
        crowds = self.votes(view, disc).crowds(count=24)  # poses that most matches vote for
        return thinned((crowd.mode for crowd in crowds), APART_M, count)

    def votes(self, view: PatternView, disc: Disc) -> Votes:
        """Return the poses of the most alike objects that the prior allows."""
        within = disc.wider(view.reach_m).holds(self._nodes.places_m)
        nodes = self._nodes.taken(within & np.isin(self._nodes.kind, view.nodes.kind))
        if len(nodes) <= self._neighbours:
            return Votes.of(np.zeros((0, 3)), np.zeros(0))
        ours, theirs = view.patterns, Patterns.of(nodes.places_m, nodes.kind, neighbours=self._neighbours)
        away = cdist(ours.vector, theirs.vector)
        away[ours.kind[:, None] != theirs.kind] = np.inf
        best = np.argsort(away.round(9), axis=1, kind="stable")[:, : self._matches]
        seen = np.repeat(np.arange(len(best)), best.shape[1])
        away, best = away[seen, best.ravel()], best.ravel()
        poses = rigid_poses(ours.corners_m[seen], theirs.corners_m[best])
        is_sane = np.isfinite(away) & allowed(poses, view.prior, disc)
        return Votes.of(poses[is_sane], 1.0 / (1.0 + away[is_sane]))
