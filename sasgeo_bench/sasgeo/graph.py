# SPDX-License-Identifier: Apache-2.0
"""Graph score of the SASGeo paper, Eq. 9: correspondences of nodes of a view and a map, and their relations.

Every term is a log-likelihood ratio of a view from here against one from a similar place. A seen node that is mapped
adds log(hit p(offset) / density), one that is not mapped log(extra), a mapped one that is not seen log(1 - hit);
relations of neighbours add to this. Probabilities are set by hand (`nodes.KINDS`, `GraphRules`).
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final, Self

import numpy as np
from scipy.optimize import linear_sum_assignment

from sasgeo_bench.geometry.pose import Pose, inverse, wrap_deg
from sasgeo_bench.sasgeo.mapped import MappedGraph
from sasgeo_bench.sasgeo.nodes import KINDS, Bools, Floats, Ints
from sasgeo_bench.sasgeo.observed import ObservedGraph


@dataclass(frozen=True, slots=True, kw_only=True)
class GraphRules:
    """Tolerances and likelihood ratios, set by hand."""

    gate_m: float = 12.0  # largest offset of a node: twice the errors of maps and detectors, and that of a search
    place_sigma_m: float = 6.0  # each axis: 4 m of the map, 3 m of the pose, some metres of a warp
    # Largest common shift of neighbouring nodes, and its correlation length: after a first assignment the gate moves
    # with the neighbours. This tolerates warps of 15 m rms with waves of 60 m and more.
    warp_m: float = 20.0
    stretch_m: float = 35.0
    wander: float = 0.05  # probability that the place, an arm or the area of a right match is an outlier
    arm_sigma_deg: float = 15.0
    area_sigma: float = 0.2  # of the logarithm of an area
    area_spread: float = 0.8  # standard deviation of the logarithm of areas of different houses
    degrees: tuple[float, float, float] = (0.4, -1.2, -2.5)  # that are equal, differ by one, and by more
    # Standard deviation of the relative place of two neighbours: a constant, and a part of their distance. A warp of
    # 10 m rms with waves of 90 m strains by 0.4, a heading error of 3 degrees by 0.05.
    edge_sigma_m: float = 2.0
    edge_strain: float = 0.12
    edge_weight: float = 0.25  # of a pair of neighbours: a node has about six, which share its place
    link: float = 0.6  # a way between two nodes on both sides
    false_link: float = -1.5  # in the view alone
    lost_link: float = -0.7  # on the map alone


def by_degree(seen: Ints, mapped: Ints, rules: GraphRules) -> Floats:
    """Return the ratios of degrees; 0 where either is unknown, shape (P,)."""
    off = np.minimum(np.abs(seen - mapped), len(rules.degrees) - 1)
    return np.where((seen > 0) & (mapped > 0), np.array(rules.degrees)[off], 0.0)


def by_area(seen_m2: Floats, mapped_m2: Floats, rules: GraphRules) -> Floats:
    """Return the ratios of equal against unrelated areas; 0 where there are none, shape (P,)."""
    off = np.log(seen_m2 / mapped_m2)
    spread = 2**0.5 * rules.area_spread
    right = np.exp(-(off**2) / (2 * rules.area_sigma**2)) / rules.area_sigma
    chance = np.exp(-(off**2) / (2 * spread**2)) / spread
    ratio = np.log((1 - rules.wander) * right + rules.wander * chance) - np.log(chance)
    return np.where(np.isfinite(ratio), ratio, 0.0)


def by_arms(seen_deg: Floats, mapped_deg: Floats, rules: GraphRules) -> Floats:
    """Return the ratios of seen arms and the nearest mapped ones; 0 where either side has none, shape (P,)."""
    off_deg = np.abs(wrap_deg(seen_deg[:, :, None] - mapped_deg[:, None, :]))
    count = np.isfinite(mapped_deg).sum(axis=1, keepdims=True)
    nearest = np.where(np.isfinite(off_deg), off_deg, np.inf).min(axis=2, initial=np.inf)
    counts = np.isfinite(nearest)
    nearest = np.where(counts, nearest, 0.0)
    right = np.exp(-(nearest**2) / (2 * rules.arm_sigma_deg**2)) * (2 / np.pi) ** 0.5 / rules.arm_sigma_deg
    chance = np.maximum(count, 1) / 180.0
    ratio = np.log((1 - rules.wander) * right / chance + rules.wander)
    return np.asarray(np.where(counts, ratio, 0.0).sum(axis=1))


_HIT: Final = np.array([kind.hit for kind in KINDS])
_EXTRA: Final = np.array([kind.extra for kind in KINDS])
_SPREAD_M: Final = np.array([kind.spread_m for kind in KINDS])
_NONE: Final[frozenset[int]] = frozenset()
_SLACK_M: Final = 1.0
_LEAST_MATCHED: Final = 3  # nodes needed to estimate a local shift


@dataclass(frozen=True, slots=True, kw_only=True)
class GraphScore:
    """Graph score of one pose, nats, and its counts; all 0 without evidence.

    Nodes are `matched`; unmatched in the view, on known map; or visible on the map and unmatched. Edges between matched
    nodes agree on both sides or contradict. `consistency` is the share of agreeing nodes and edges among all judged
    ones, `rms_m` the root mean square offset of matched nodes.
    """

    score: float = 0.0
    matched: int = 0
    unmatched_seen: int = 0
    unmatched_mapped: int = 0
    agreeing: int = 0
    contradicting: int = 0
    consistency: float = 0.0
    rms_m: float = 0.0


def verify(seen: ObservedGraph, mapped: MappedGraph, poses: Sequence[Pose]) -> list[GraphScore]:
    """Return the score of Eq. 9 of each pose, with its best correspondences.

    Examples
    --------
    Three streets seen where they are, and a quarter turn off:

    >>> import shapely
    >>> from sasgeo_bench.regions.evidence import Evidence
    >>> from sasgeo_bench.regions.graph import build_graph
    >>> from sasgeo_bench.geometry.grid import Grid
    >>> from sasgeo_bench.tasks.vectors import as_features, vector_table
    >>> ways = ("LINESTRING (-90 0, 0 0, 40 0, 90 0)", "LINESTRING (0 0, 0 90)", "LINESTRING (40 0, 40 -90)")
    >>> lines = shapely.from_wkt(ways)
    >>> streets = vector_table([("road_minor", 0, False, line) for line in lines])
    >>> grid = Grid(epsg=32632, west_m=-96.0, north_m=96.0, cell_size_m=2.0, rows=96, cols=96)
    >>> known, features = np.ones(grid.shape, dtype=bool), as_features(streets)
    >>> mapped = MappedGraph.make(build_graph(features), features, known=known, grid=grid)
    >>> view = Evidence(classes=("road_minor",), cells=np.zeros((1, 96, 96), dtype=np.uint8), cell_size_m=2.0)
    >>> poses = [Pose(easting_m=0.0, northing_m=0.0, yaw_deg=yaw_deg) for yaw_deg in (0.0, 90.0)]
    >>> here, turned = verify(ObservedGraph.make(view, streets), mapped, poses)
    >>> here.score > turned.score
    True
    """
    rules = GraphRules()
    judge = _Judge(seen=seen, mapped=mapped, rules=rules, pull=_pull(seen.nodes.places_m, rules.stretch_m))
    return [judge.score(pose) for pose in poses]


def _pull(places_m: Floats, stretch_m: float) -> Floats:
    """Return the influence of each node on the shift of others, shape (N, N), 0 on the diagonal."""
    distance_2 = ((places_m[:, None] - places_m[None]) ** 2).sum(axis=2)
    pull = np.exp(-distance_2 / (2 * stretch_m**2))
    np.fill_diagonal(pull, 0.0)
    return np.asarray(pull)


@dataclass(frozen=True, kw_only=True)
class _Stage:
    """A view at a pose: its nodes on the map, map nodes around, and the (negative) scores of unmatched nodes.

    `around` are rows of the map nodes.
    """

    pose: Pose
    places_m: Floats
    around: Ints
    lost_seen: Floats
    lost_mapped: Floats


@dataclass(frozen=True, kw_only=True)
class _Pairs:
    """Candidate correspondences: rows of nodes of the view and of `_Stage.around`, and the score of each pair."""

    seen: Ints
    mapped: Ints
    score: Floats

    def some(self, keep: Bools) -> Self:
        """Return selected pairs."""
        return type(self)(seen=self.seen[keep], mapped=self.mapped[keep], score=self.score[keep])


@dataclass(frozen=True, kw_only=True)
class _Judge:
    """A view and a map, to be compared pose by pose."""

    seen: ObservedGraph
    mapped: MappedGraph
    rules: GraphRules
    pull: Floats

    def score(self, pose: Pose) -> GraphScore:
        """Assign, shift each node with its neighbours, assign again and sum up."""
        stage = self._stage(pose)
        pairs = self._assigned(stage, np.zeros_like(stage.places_m))
        if len(pairs.seen) >= _LEAST_MATCHED:
            pairs = self._assigned(stage, self._shift_m(stage, pairs))
        return self._summed(stage, pairs)

    def _stage(self, pose: Pose) -> _Stage:
        nodes, ours = self.mapped.nodes, self.seen.nodes
        reach_m = float(np.hypot(*self.seen.visible.shape[1:])) * self.seen.cell_size_m / 2 * pose.scale
        reach_m += self.rules.gate_m + self.rules.warp_m + _SPREAD_M.max() + _SLACK_M
        around = self.mapped.around(np.array([pose.easting_m, pose.northing_m]), reach_m)
        around = around[self.seen.asked[nodes.kind[around]]]
        kind = nodes.kind[around]
        local_m = inverse(pose).to_map(nodes.places_m[around])
        half_m = np.array(self.seen.visible.shape[:0:-1]) * self.seen.cell_size_m / 2
        is_whole = (np.abs(local_m) + nodes.radius_m[around, None] / pose.scale < half_m).all(axis=1)
        is_due = is_whole & self.seen.shows(local_m, kind)
        places_m = pose.to_map(ours.places_m)
        counts = ~self.seen.is_cut & self.mapped.knows(places_m) & (self.mapped.density_per_m2[ours.kind] > 0)
        return _Stage(
            pose=pose,
            places_m=places_m,
            around=around,
            lost_seen=np.where(counts, np.log(_EXTRA[ours.kind]), 0.0),
            lost_mapped=np.where(is_due, np.log1p(-_HIT[kind]), 0.0),
        )

    def _assigned(self, stage: _Stage, shift_m: Floats) -> _Pairs:
        """Return the best one-to-one correspondences within the gate around shifted nodes."""
        pairs = self._near(stage, shift_m)
        gain = pairs.score - stage.lost_seen[pairs.seen] - stage.lost_mapped[pairs.mapped]
        off_m = self._offsets_m(stage, pairs) - shift_m[pairs.seen]
        if shift_m.any():  # prefer offsets like those of neighbours
            gain -= (off_m**2).sum(axis=1) / (2 * self.rules.place_sigma_m**2)
        table = np.zeros((len(stage.places_m), len(stage.around)))
        table[pairs.seen, pairs.mapped] = np.maximum(gain, 0.0)
        rows, cols = np.unique(pairs.seen), np.unique(pairs.mapped)
        row, col = linear_sum_assignment(table[np.ix_(rows, cols)], maximize=True)
        chosen = np.zeros_like(table, dtype=bool)
        chosen[rows[row], cols[col]] = True
        return pairs.some(chosen[pairs.seen, pairs.mapped] & (gain > 0))

    def _near(self, stage: _Stage, shift_m: Floats) -> _Pairs:
        """Return pairs of one kind within the gate and their scores."""
        ours, theirs, rules = self.seen.nodes, self.mapped.nodes, self.rules
        at_m = stage.places_m + shift_m
        gate_m = rules.gate_m + _SPREAD_M[ours.kind]
        row, there = self.mapped.like(at_m, ours.kind, gate_m)
        col = np.searchsorted(stage.around, there)
        kind = ours.kind[row]
        pairs = _Pairs(seen=row, mapped=col, score=np.zeros(len(row)))
        sigma_m = np.hypot(rules.place_sigma_m, _SPREAD_M[kind])
        off_2 = (self._offsets_m(stage, pairs) ** 2).sum(axis=1)
        dense = np.exp(-off_2 / (2 * sigma_m**2)) / (2 * np.pi * sigma_m**2)
        flat = 1 / (np.pi * gate_m[row] ** 2)
        place = np.log((1 - rules.wander) * dense + rules.wander * flat) - np.log(self.mapped.density_per_m2[kind])
        score = np.log(_HIT[kind]) + place
        score += by_degree(ours.degree[row], theirs.degree[there], rules)
        score += by_area(ours.area_m2[row] * stage.pose.scale**2, theirs.area_m2[there], rules)
        score += by_arms(ours.arms_deg[row] + stage.pose.yaw_deg, theirs.arms_deg[there], rules)
        return _Pairs(seen=row, mapped=col, score=score)

    def _offsets_m(self, stage: _Stage, pairs: _Pairs) -> Floats:
        """Return offsets from nodes of the view to those of the map, shape (P, 2)."""
        return np.asarray(self.mapped.nodes.places_m[stage.around[pairs.mapped]] - stage.places_m[pairs.seen])

    def _shift_m(self, stage: _Stage, pairs: _Pairs) -> Floats:
        """Return the mean offset of the neighbours of each node, without itself, shrunk towards 0."""
        follows = self.pull[:, pairs.seen]
        shift_m = (follows @ self._offsets_m(stage, pairs)) / (follows.sum(axis=1, keepdims=True) + 1.0)
        length_m = np.hypot(*shift_m.T)[:, None]
        return np.asarray(shift_m * np.minimum(1.0, self.rules.warp_m / np.maximum(length_m, 1e-9)))

    def _summed(self, stage: _Stage, pairs: _Pairs) -> GraphScore:
        lost_seen, lost_mapped = stage.lost_seen.copy(), stage.lost_mapped.copy()
        lost_seen[pairs.seen] = lost_mapped[pairs.mapped] = 0.0
        off_m = self._offsets_m(stage, pairs)
        edges = np.concatenate((self._by_neighbours(stage, pairs, off_m), self._by_links(stage, pairs)))
        good, bad = int((edges > 0).sum()), int((edges < 0).sum())
        missing = int((lost_seen < 0).sum()), int((lost_mapped < 0).sum())
        fine = 2 * len(pairs.seen) + good
        judged = fine + sum(missing) + bad
        return GraphScore(
            score=float(pairs.score.sum() + lost_seen.sum() + lost_mapped.sum() + edges.sum()),
            matched=len(pairs.seen),
            unmatched_seen=missing[0],
            unmatched_mapped=missing[1],
            agreeing=good,
            contradicting=bad,
            consistency=fine / judged if judged else 0.0,
            rms_m=float(np.sqrt((off_m**2).sum(axis=1).mean())) if len(off_m) else 0.0,
        )

    def _by_neighbours(self, stage: _Stage, pairs: _Pairs, off_m: Floats) -> Floats:
        """Return scores of the relative places of matched neighbours."""
        at = np.full(len(stage.places_m), -1)
        at[pairs.seen] = np.arange(len(pairs.seen))
        ends = at[self.seen.near]
        kept = (ends >= 0).all(axis=1)
        ends, near, rules = ends[kept], self.seen.near[kept], self.rules
        length_m = np.hypot(*(stage.places_m[near[:, 0]] - stage.places_m[near[:, 1]]).T)
        spread_2 = (_SPREAD_M[self.seen.nodes.kind[near]] ** 2).sum(axis=1)
        sigma_2 = rules.edge_sigma_m**2 + (rules.edge_strain * length_m) ** 2 + spread_2
        strain_2 = ((off_m[ends[:, 0]] - off_m[ends[:, 1]]) ** 2).sum(axis=1)
        chance_2 = 2 * rules.place_sigma_m**2 + spread_2  # of two independent offsets
        ratio = np.log(chance_2 / sigma_2) - strain_2 / 2 * (1 / sigma_2 - 1 / chance_2)
        ratio = np.where(sigma_2 < chance_2, np.maximum(ratio, np.log(rules.wander)), 0.0)
        return np.asarray(rules.edge_weight * ratio)

    def _by_links(self, stage: _Stage, pairs: _Pairs) -> Floats:
        """Return scores of ways between matched nodes, on both sides or on one.

        A way past an unmatched node is no contradiction: that node is counted already.
        """
        ours, theirs, rules = self.seen.links, self.mapped.links, self.rules
        to_map = dict(zip(pairs.seen.tolist(), stage.around[pairs.mapped].tolist(), strict=True))
        to_view = {there: here for here, there in to_map.items()}
        found: list[float] = []
        for one, there in to_map.items():
            for two in ours.get(one, _NONE):
                if one < two and two in to_map:
                    if to_map[two] in theirs.get(there, _NONE):
                        found.append(rules.link)
                    elif not _passes(theirs, there, to_map[two], matched=to_view):
                        found.append(rules.false_link)
        for one, here in to_view.items():
            for two in theirs.get(one, _NONE):
                if one < two and two in to_view:
                    other = to_view[two]
                    if other not in ours.get(here, _NONE) and not _passes(ours, here, other, matched=to_map):
                        found.append(rules.lost_link)
        return np.array(found, dtype=np.float64)


def _passes(links: dict[int, set[int]], one: int, two: int, *, matched: dict[int, int]) -> bool:
    """Return whether a way leads from one node to another past an unmatched one."""
    return any(node not in matched for node in links.get(one, _NONE) & links.get(two, _NONE))
