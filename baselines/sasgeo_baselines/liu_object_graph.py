# SPDX-License-Identifier: Apache-2.0
"""`liu_object_graph`: graphs of objects of a view and of tiles of the map, matched node by node."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from heapq import nlargest
from typing import Final

import numpy as np

from sasgeo_baselines.global_descriptor import lattice_m
from sasgeo_baselines.object_matcher import FEWEST, LEFT_OUT, Floats, Ints, PreparedView, fitted
from sasgeo_baselines.place_matcher import PlaceMatcher
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
    rotation,
    thinned,
)

APART_M: Final = 25.0
# Of an edge, as in the source's code: overlap of boxes, same class, cosine of features. They sum to 1.1.
OVERLAP, SAME, COSINE = 0.6, 0.2, 0.3
ROUNDS: Final = 3
MIDDLE_M2, DECADE = 150.0, 2.0  # area of a usual house, and a logarithm that is far from it
NEAR_M: Final = 24.0  # standard deviation of places in a tile: offset of the tile and error of the heading
MOST_TILES: Final = 1500  # more than a disc of 500 m holds: of more, those with the view's mix of kinds are looked at
AGREE_M: Final = 8.0
SAMPLES: Final = 200  # of three matches: with half of them wrong, all fail with a probability below 1e-11


@dataclass(frozen=True, kw_only=True)
class Objects(PreparedView):
    """Objects of a view, with what of it is known."""

    seen: ObservedGraph


@dataclass(frozen=True, kw_only=True)
class Tile:
    """A tile at a heading: rows of the map's nodes that the view would show there, and their similarity to its own."""

    pose: Pose
    rows: Ints
    likeness: Floats

    @property
    def bound(self) -> float:
        """Return the score of the tile if several objects could share a partner."""
        return float(self.likeness.max(axis=1).sum() / max(self.likeness.shape)) if self.likeness.size else 0.0


@dataclass(frozen=True, kw_only=True)
class Matched(Mode):
    """A pose on which `inliers` matched objects agree; its score is that of its tile."""

    inliers: int


class LiuObjectGraph(PlaceMatcher[Objects]):
    """Similarity of nodes after averaging along the edges, partners by Sinkhorn's iteration, pose by RANSAC."""

    open_numbers = {
        "step_m": (24.0, 32.0),  # of tiles: a view is at most 17 or 23 m off the middle of one
        "slack": (0.3, 0.5, 0.7),  # similarity below which an object rather has no partner
    }
    chosen = {"step_m": 24.0, "slack": 0.5}

    card = MatcherCard(
        name="liu_object_graph",
        version="1",
        title="Object graphs of view and tiles, matched by Sinkhorn's iteration",
        source=(
            "Liu, Ren and Chen, Object-aware graph matching network for cross-domain remote sensing image "
            "localization (Chinese Journal of Aeronautics 2026, arXiv 2511.02489), by its abstract and released code "
            "for graphs: objects as nodes of a complete graph, edges of 0.6 complete IoU of boxes, 0.2 for the same "
            "class and 0.3 cosine of features, without loops; boxes are features, too; graph attention, similarity of "
            "nodes across graphs, retrieval of tiles by it"
        ),
        ours=(
            "Nothing is learned. Objects are the nodes of the SASGeo scorer's graph, without ends of roads and bends; "
            "features are kind, logarithm of area and degree; boxes are squares of the same area, laid along the line "
            "between two so that headings do not matter; attention is a softmax of ten times the edges, and three "
            "rounds each average a node with what it attends to; a node keeps its features of all rounds. Tiles every "
            f"{chosen['step_m']:g} m, headings 15 degrees apart within 2.5 standard deviations of the prior; of more "
            "than 1500 tiles those whose counts of kinds are most like the view's; similarity is the cosine of "
            "features times a Gaussian of the distance of places in the tile (24 m); for the 64 best, 20 iterations "
            f"of Sinkhorn with a slack bin at {chosen['slack']:g}; the score is the sum of matched similarities over "
            "the larger number of objects; the pose a weighted least-squares fit of the matches within 8 m of the "
            "best of 200 fits of three, or the tile itself"
        ),
        licence="Apache-2.0",
        tracks=("retrieval", "localization"),
        limits=(
            "Blind where fewer than three whole objects are seen: its authors say that tiles of few objects do not "
            "suit it; objects that the view could not show are left out as partners, but their neighbours hear of "
            "them; no cells, no elongation, scale 1, no sequence, no weights by what lasts, no rejection"
        ),
    )

    def read(self, region: Region, learned: str | None) -> None:
        """Read the nodes of the map."""
        del learned
        self.mapped = MappedGraph.of(region)
        self.grid = region.grid

    def look(self, query: Query) -> Objects | None:
        """Return the whole objects of a view; None if they are fewer than three."""
        seen = ObservedGraph.of(query)
        nodes = seen.nodes.taken(~seen.is_cut & ~np.isin(seen.nodes.kind, LEFT_OUT))
        return Objects(nodes=nodes, prior=query.prior, seen=seen) if len(nodes) >= FEWEST else None

    def modes(self, view: Objects, disc: Disc, *, count: int) -> list[Mode]:
        """Return the poses of the tiles with the highest scores."""
        found: list[Mode] = []
        # 64 tiles and headings that are matched in full, the best first by their best similarities
        for tile in nlargest(64, self.tiles(view, disc), key=lambda tile: tile.bound):
            partners = sinkhorn(tile.likeness, slack=self.numbers["slack"])
            score = float((partners * tile.likeness).sum() / max(tile.likeness.shape))
            best = partners.argmax(axis=1)
            share = partners[np.arange(len(best)), best]
            kept = np.flatnonzero(share >= 0.1)  # least share of an object that a match must have
            mapped_m = self.mapped.nodes.places_m[tile.rows[best[kept]]]
            pose, inliers = posed(view.nodes.places_m[kept], mapped_m, share[kept])
            if pose is None or not view.allows(pose, disc):
                pose, inliers = tile.pose, 0
            found.append(Matched(pose=pose, score=score, inliers=inliers))
        return thinned(sorted(found, key=lambda mode: -mode.score), APART_M, count)

    def diagnostics(self, view: Objects, found: Sequence[Mode]) -> dict[str, float]:
        """Return how many matched objects agree on the first answer, and their share of the objects of the view."""
        first = found[0]
        inliers = first.inliers if isinstance(first, Matched) else 0
        return {"inliers": float(inliers), "inlier_ratio": inliers / len(view.nodes)}

    def tiles(self, view: Objects, disc: Disc) -> Iterator[Tile]:
        """Yield the tiles of a disc at all headings, without those that hold less than the view needs to show."""
        mine = node_features(view.nodes)
        yaws_deg = view.yaws_deg(15.0)  # degrees: an object 90 m away moves by 12 m at most
        for middle_m, rows in self._places(view, disc):
            nodes = _taken(self.mapped.nodes, rows)
            cosine = mine @ node_features(nodes).T
            for yaw_deg in yaws_deg:
                places_m = (nodes.places_m - middle_m) @ rotation(yaw_deg)
                shown = np.flatnonzero(view.seen.shows(places_m, nodes.kind))
                if len(shown) < FEWEST:
                    continue
                apart_m2 = np.square(view.nodes.places_m[:, None] - places_m[None, shown]).sum(axis=2)
                likeness = np.maximum(cosine[:, shown], 0) * np.exp(-apart_m2 / (2 * NEAR_M**2))
                pose = Pose(easting_m=float(middle_m[0]), northing_m=float(middle_m[1]), yaw_deg=yaw_deg)
                yield Tile(pose=pose, rows=rows[shown], likeness=likeness)

    def _places(self, view: Objects, disc: Disc) -> list[tuple[Floats, Ints]]:
        """Return the middles of tiles in a disc, and the rows of the nodes around each that the view may show."""
        radius_m = None if disc.center_m is None else disc.radius_m
        around = Prior(center_m=disc.center_m, radius_m=radius_m, yaw_deg=None, yaw_sigma_deg=None, scale_sigma=0.0)
        kinds = len(NODE_KINDS)
        asked = view.seen.asked & ~np.isin(np.arange(kinds), LEFT_OUT)
        found, counts = [], []
        for middle_m in lattice_m(around, self.grid, step_m=self.numbers["step_m"]):
            rows = self.mapped.around(middle_m, view.reach_m + NEAR_M)
            rows = rows[asked[self.mapped.nodes.kind[rows]]]
            if len(rows) >= FEWEST:
                found.append((middle_m, rows))
                counts.append(np.bincount(self.mapped.nodes.kind[rows], minlength=kinds))
        if len(found) <= MOST_TILES:
            return found
        alike = _unit(np.array(counts)) @ np.bincount(view.nodes.kind, minlength=kinds)
        return [found[at] for at in np.sort(np.argsort(-alike, kind="stable")[:MOST_TILES])]


def _taken(nodes: Nodes, rows: Ints) -> Nodes:
    """Return the nodes of some rows, without relations."""
    own = {
        name: getattr(nodes, name)[rows]
        for name in ("places_m", "kind", "degree", "area_m2", "reach_m", "arms_deg", "feature")
    }
    return Nodes(**own, pairs=np.zeros((0, 2), dtype=np.int64), relation=np.zeros(0, dtype=np.int64))


def node_features(nodes: Nodes) -> Floats:
    """Return unit features of nodes: their own and those after each of three rounds, side by side, shape (N, D)."""
    features = local_features(nodes)
    rounds = [features]
    edges = edge_weights(nodes, features)
    # 10: sharpness of the attention: an edge that is heavier by 0.1 counts e times
    attention = np.exp(10.0 * (edges - edges.max(axis=1, keepdims=True)))
    np.fill_diagonal(attention, 0.0)
    attention /= np.maximum(attention.sum(axis=1, keepdims=True), np.finfo(np.float64).tiny)
    for _ in range(ROUNDS):
        features = _unit(features + attention @ features)
        rounds.append(features)
    return _unit(np.concatenate(rounds, axis=1))


def local_features(nodes: Nodes) -> Floats:
    """Return kind, size and degree of nodes as unit vectors, shape (N, K + 2)."""
    size = np.nan_to_num(np.log(nodes.area_m2 / MIDDLE_M2) / DECADE)
    degree = np.where(nodes.degree > 0, (nodes.degree - 3) / DECADE, 0.0)  # most junctions have three arms
    return _unit(np.column_stack((np.eye(len(NODE_KINDS))[nodes.kind], size, degree)))


def _unit(rows: Floats) -> Floats:
    return np.asarray(rows / np.linalg.norm(rows, axis=1, keepdims=True))


def edge_weights(nodes: Nodes, features: Floats) -> Floats:
    """Return the weights of the complete graph, shape (N, N), zero on the diagonal."""
    apart_m = np.linalg.norm(nodes.places_m[:, None] - nodes.places_m[None, :], axis=2)
    # 4 m: half the side of the box of a junction: a road's width
    half_m = np.where(nodes.area_m2 > 0, np.sqrt(np.nan_to_num(nodes.area_m2)) / 2, 4.0)
    is_same = nodes.kind[:, None] == nodes.kind[None, :]
    edges = OVERLAP * complete_iou(apart_m, half_m) + SAME * is_same + COSINE * (features @ features.T)
    np.fill_diagonal(edges, 0.0)
    return np.asarray(edges)


def complete_iou(apart_m: Floats, half_m: Floats) -> Floats:
    """Return the complete IoU of squares, shape (N, N): IoU less the share of the distance in the diagonal, squared.

    Squares lie along the line between their middles; their proportions are the same, so the third term is 0.

    >>> complete_iou(np.array([[0.0, 30.0], [30.0, 0.0]]), np.array([5.0, 5.0])).round(3).tolist()
    [[1.0, -0.529], [-0.529, 1.0]]
    """
    one, two = half_m[:, None], half_m[None, :]
    along = np.maximum(np.minimum(one, apart_m + two) - np.maximum(-one, apart_m - two), 0)
    both = along * 2 * np.minimum(one, two)
    either = 4 * (one**2 + two**2) - both
    long = np.maximum(one, apart_m + two) - np.minimum(-one, apart_m - two)
    diagonal = long**2 + (2 * np.maximum(one, two)) ** 2
    return np.asarray(both / either - apart_m**2 / diagonal)


def sinkhorn(likeness: Floats, *, slack: float) -> Floats:
    """Return the share of each pair in an assignment with slack: rows and columns sum to at most 1, shape (N, M).

    >>> sinkhorn(np.array([[1.0, 0.9], [0.9, 0.0]]), slack=0.5).round(1).tolist()  # the second has no other partner
    [[0.3, 0.7], [0.7, 0.0]]
    """
    rows, cols = likeness.shape
    padded = np.full((rows + 1, cols + 1), slack)
    padded[:rows, :cols] = likeness
    kernel = np.exp((padded - max(slack, float(likeness.max(initial=0.0)))) / 0.1)  # 0.1: softness of the assignment
    mine, theirs = np.ones(rows + 1), np.ones(cols + 1)
    mine[-1], theirs[-1] = cols, rows
    down, right = np.ones(rows + 1), np.ones(cols + 1)
    for _ in range(20):  # iterations
        down = mine / (kernel @ right)
        right = theirs / (down @ kernel)
    return np.asarray((down[:, None] * kernel * right)[:rows, :cols])


def posed(seen_m: Floats, mapped_m: Floats, weight: Floats) -> tuple[Pose | None, int]:
    """Return the pose on which most matches agree, by weight, and how many they are; None for fewer than three.

    >>> seen_m = np.array([[0.0, 0.0], [50.0, 0.0], [0.0, 40.0], [-30.0, 20.0]])
    >>> here = Pose(easting_m=10.0, northing_m=20.0, yaw_deg=30.0)
    >>> lost_m = here.to_map(seen_m) + np.array([[0.0, 0.0]] * 3 + [[70.0, 0.0]])
    >>> pose, inliers = posed(seen_m, lost_m, np.ones(4))
    >>> round(pose.yaw_deg, 6), inliers
    (30.0, 3)
    """
    if len(seen_m) < FEWEST:
        return None, 0
    # Rows of three different matches, shape (SAMPLES, 3): the same ones for the same number of matches
    count = len(seen_m)
    chance = np.random.default_rng(count).random((SAMPLES, count))
    chosen = np.asarray(chance.argpartition(2, axis=1)[:, :3])
    agrees = _left_m(seen_m, mapped_m, chosen) <= AGREE_M
    best = agrees[(agrees @ weight).argmax()]
    if np.count_nonzero(best) < FEWEST:
        return None, 0
    pose, _ = fitted(seen_m[best], mapped_m[best], weight[best])
    return pose, int(np.count_nonzero(best))


def _left_m(seen_m: Floats, mapped_m: Floats, chosen: Ints) -> Floats:
    """Return the errors of all matches at the rigid pose of each three, metres, shape (SAMPLES, N)."""
    one, other = (
        np.ascontiguousarray(part).view(np.complex128)[:, 0] for part in (np.float64(seen_m), np.float64(mapped_m))
    )
    mine, theirs = one[chosen].mean(axis=1), other[chosen].mean(axis=1)
    spin = (np.conj(one[chosen] - mine[:, None]) * (other[chosen] - theirs[:, None])).sum(axis=1)
    turn = spin / np.maximum(np.abs(spin), np.finfo(np.float64).tiny)
    return np.asarray(np.abs(turn[:, None] * (one - mine[:, None]) - (other - theirs[:, None])))
