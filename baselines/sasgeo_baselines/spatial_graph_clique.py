# SPDX-License-Identifier: Apache-2.0
"""`spatial_graph_clique`: the largest set of objects whose distances from each other agree on both sides."""

from collections.abc import Sequence
from typing import Final

import networkx as nx  # type: ignore[import-untyped, unused-ignore]
import numpy as np

from sasgeo_baselines.object_matcher import Floats, Ints, ObjectMatcher, Pairs, PreparedView, fitted
from sasgeo_bench import Disc, MatcherCard, Mode, Pose, thinned

YAW_STEP_DEG: Final = 5.0
APART_M: Final = 25.0


class SpatialGraphClique(ObjectMatcher):
    """Maximum clique of the graph of correspondences; its size is the score."""

    open_numbers = {
        "agree_m": (3.0, 5.0, 8.0),  # two distances that may be the same
        "near_m": (10.0, 14.0),  # of a peak of votes: pairs whose votes lie so near are looked at together
    }
    chosen = {"agree_m": 8.0, "near_m": 10.0}

    card = MatcherCard(
        name="spatial_graph_clique",
        version="1",
        title="Maximum clique of objects with the same distances",
        source=(
            "Matsuzaki, Koide, Oishi, Yokozuka and Banno, Single-Shot Global Localization via Graph-Theoretic "
            "Correspondence Matching, arXiv 2306.03641, as its abstract describes it: instances in a segmented picture "
            "and in a labelled 3D point cloud, joined by the maximum clique of their correspondences; shown on "
            "simulated towns, not from the air"
        ),
        ours=(
            "Objects are the nodes of the SASGeo scorer's graph, correspondences those of one kind, which agree if "
            f"they keep distances within {chosen['agree_m']:g} m. The graph of all correspondences of a map is too "
            "large, so poses that many pairs vote for (cells of 8 m, headings 5 degrees apart within 2.5 standard "
            "deviations of the prior) are looked at one by one: at each of the best 24 that lie 25 m apart the 60 "
            f"pairs nearest to it, within {chosen['near_m']:g} m, and once more around the pose that they give. The "
            "clique's pose is the least-squares fit of its pairs; its score is its size, and of two of a size the one "
            "that fits better"
        ),
        licence="Apache-2.0",
        tracks=("retrieval", "localization"),
        limits=(
            "Blind where fewer than three whole objects are seen; no cells, so that shapes and empty ground say "
            "nothing; scale is 1; no sequence, no weights by what lasts, no unknown; the size of the clique, a "
            "diagnostic, is its only confidence"
        ),
    )

    def modes(self, view: PreparedView, disc: Disc, *, count: int) -> list[Mode]:
        """Return the poses of the largest cliques."""
        pairs = Pairs.of_kind(view, self.mapped.nodes, self.within(view, disc))
        found = []
        for peak in pairs.peaks(disc, view.yaws_deg(YAW_STEP_DEG), count=24):  # peaks
            mode = self._at(pairs, peak.pose)
            mode = mode and self._at(pairs, mode.pose)  # once more: a peak is up to half a step of the heading off
            if mode is not None and view.allows(mode.pose, disc):
                found.append(mode)
        return thinned(sorted(found, key=lambda mode: -mode.score), APART_M, count)

    def _at(self, pairs: Pairs, pose: Pose) -> Mode | None:
        """Return the pose of the largest clique of pairs near a pose; None if they are fewer than three."""
        # Rows of the pairs that vote for a place near a pose, the nearest first
        away_m = np.hypot(*(pairs.places_m(pose.yaw_deg) - (pose.easting_m, pose.northing_m)).T)
        near = np.flatnonzero(away_m <= self.numbers["near_m"])
        # At most 60 pairs of one peak, the nearest first: bounds the search for a clique
        near = np.asarray(near[np.argsort(away_m[near], kind="stable")[:60]], dtype=np.int64)
        places_m, owner = (pairs.seen_m[near], pairs.mapped_m[near]), owners(pairs, near)
        clique = near[largest_clique(*places_m, owner, agree_m=self.numbers["agree_m"])]
        if len(clique) < 3:  # at least 3 of a clique: two pairs always agree with something
            return None
        fit, error_m = fitted(pairs.seen_m[clique], pairs.mapped_m[clique])
        return Mode(pose=fit, score=len(clique) + 0.5 / (1.0 + error_m))

    def diagnostics(self, view: PreparedView, found: Sequence[Mode]) -> dict[str, float]:
        """Return the size of the largest clique."""
        del view
        return {"inliers": float(int(found[0].score))}


def owners(pairs: Pairs, chosen: Ints) -> Ints:
    """Return the seen and the mapped object of each chosen pair, shape (P, 2)."""
    return np.column_stack([pairs.seen[chosen], pairs.mapped[chosen]])


def largest_clique(seen_m: Floats, mapped_m: Floats, owner: Ints, *, agree_m: float) -> Ints:
    """Return rows of the largest set of pairs whose distances agree pairwise; of several the first.

    Parameters
    ----------
    seen_m, mapped_m : ndarray of float, shape (P, 2)
        Places of each pair in the view and on the map.
    owner : ndarray of int, shape (P, 2)
        The seen and the mapped object of each pair: an object belongs to one pair of a clique.
    agree_m : float
        By which two distances may differ.

    Examples
    --------
    Three corners of a square agree; the fourth lies 9 m off:

    >>> seen_m = np.array([[0.0, 0.0], [40.0, 0.0], [0.0, 40.0], [40.0, 40.0]])
    >>> mapped_m = seen_m + (100.0, 0.0) + np.array([[0, 0], [0, 0], [0, 0], [0, 9.0]])
    >>> largest_clique(seen_m, mapped_m, np.arange(4)[:, None].repeat(2, axis=1), agree_m=5.0).tolist()
    [0, 1, 2]
    """
    if not len(seen_m):
        return np.zeros(0, dtype=np.int64)
    apart = [np.linalg.norm(places[:, None] - places[None, :], axis=2) for places in (seen_m, mapped_m)]
    is_free = (owner[:, None] != owner[None, :]).all(axis=2)
    agree = is_free & (np.abs(apart[0] - apart[1]) < agree_m)
    graph = nx.from_numpy_array(agree)
    clique, _ = nx.max_weight_clique(graph, weight=None)
    return np.array(sorted(clique), dtype=np.int64)
