# SPDX-License-Identifier: Apache-2.0
"""Graph score of the SASGeo paper, Eq. 9: correspondences of nodes of a view and a map, and their relations.

Every term is a log-likelihood ratio of a view from here against one from a similar place. A seen node that is mapped
adds log(hit p(offset) / density), one that is not mapped log(extra), a mapped one that is not seen log(1 - hit);
relations of neighbours add to this. The numbers are those of `GraphRules`; a view without vectors keeps its starting
values, since only vectors teach others.
"""

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, fields
from typing import Any, Final, Self

import numpy as np
import scipy  # its optimizers are loaded where they are used: matchers without a graph start without them

from sasgeo_bench.core.errors import ConfigError
from sasgeo_bench.geometry.pose import Pose, inverse, wrap_deg
from sasgeo_bench.sasgeo.mapped import MappedGraph
from sasgeo_bench.sasgeo.nodes import INDEX, NODE_KINDS, Bools, Floats, Ints
from sasgeo_bench.sasgeo.observed import ObservedGraph

DEGREES: Final = 3  # equal degrees, degrees that differ by one, and by more
_OF_KINDS: Final = ("hit", "extra")
_RATIOS: Final = ("degrees", "link", "false_link", "lost_link")  # the rest is positive


@dataclass(frozen=True, slots=True, kw_only=True)
class GraphRules:
    """Tolerances and likelihood ratios of nodes and of their relations.

    The defaults are starting values: guesses from how far maps and odometry are off, before any view was seen.
    `rule_fitting.fit_rules` replaces the ratios, hits and extra nodes by statistics of training views; tolerances stay.

    Parameters
    ----------
    gate_m : float
        Largest offset of a node.
    place_sigma_m : float
        Standard deviation of an offset, each axis.
    shift_m, stretch_m : float
        Largest shift that neighbouring nodes have in common, and the distance over which they have it: after a first
        assignment the gate moves with the neighbours.
    wander : float
        Probability that the place, an arm or the area of a right match is an outlier.
    arm_sigma_deg : float
        Standard deviation of the direction of a road at a junction.
    area_sigma, area_spread : float
        Standard deviation of the logarithm of an area, and that among different houses.
    degrees : tuple of float
        Log ratios of degrees that are equal, differ by one, and by more.
    edge_sigma_m, edge_strain : float
        Standard deviation of the relative place of two neighbours, each axis: a constant, and a part of their distance.
    edge_weight : float
        Of a pair of neighbours: several pairs share one node.
    link, false_link, lost_link : float
        Log ratios of a way between two nodes on both sides, in the view alone, and on the map alone.
    hit, extra : tuple of float
        For each of `NODE_KINDS`: the probability that a visible map node is seen, and the share of seen nodes that no
        map has.

    Raises
    ------
    ConfigError
        If a number is not finite or out of range.
    """

    gate_m: float = 12.0
    place_sigma_m: float = 6.0
    shift_m: float = 20.0
    stretch_m: float = 35.0
    wander: float = 0.05
    arm_sigma_deg: float = 15.0
    area_sigma: float = 0.2
    area_spread: float = 0.8
    degrees: tuple[float, ...] = (0.4, -1.2, -2.5)
    edge_sigma_m: float = 2.0
    edge_strain: float = 0.12
    edge_weight: float = 0.25
    link: float = 0.6
    false_link: float = -1.5
    lost_link: float = -0.7
    hit: tuple[float, ...] = tuple(kind.hit for kind in NODE_KINDS)
    extra: tuple[float, ...] = tuple(kind.extra for kind in NODE_KINDS)

    def __post_init__(self) -> None:
        for item in fields(self):
            values = np.atleast_1d(getattr(self, item.name))
            fits = np.isfinite(values) if item.name in _RATIOS else np.isfinite(values) & (values > 0)
            if item.name in (*_OF_KINDS, "wander"):
                fits &= values < 1
            if not fits.all():
                raise ConfigError(f"{item.name} of the graph is out of range: {getattr(self, item.name)!r}")
        if (len(self.degrees), len(self.hit), len(self.extra)) != (DEGREES, len(NODE_KINDS), len(NODE_KINDS)):
            raise ConfigError(f"the graph has {DEGREES} ratios of degrees and {len(NODE_KINDS)} kinds of nodes")

    def to_stored(self) -> dict[str, Any]:
        """Return the numbers for JSON, those of kinds by name."""
        return asdict(self) | {
            name: {kind.name: value for kind, value in zip(NODE_KINDS, getattr(self, name), strict=True)}
            for name in _OF_KINDS
        }

    @classmethod
    def from_stored(cls, stored: Mapping[str, Any]) -> Self:
        """Read what `to_stored` returns; raise KeyError, TypeError or ConfigError for anything else."""
        by_kind = {name: tuple(float(stored[name][kind]) for kind in INDEX) for name in _OF_KINDS}
        return cls(**{**stored, **by_kind, "degrees": tuple(stored["degrees"])})


def by_degree(seen: Ints, mapped: Ints, rules: GraphRules) -> Floats:
    """Return the ratios of degrees; 0 where either is unknown, shape (P,)."""
    return np.where((seen > 0) & (mapped > 0), np.array(rules.degrees)[degree_step(seen, mapped)], 0.0)


def degree_step(seen: Ints, mapped: Ints) -> Ints:
    """Return by how much degrees differ, as an index of `GraphRules.degrees`, shape (P,)."""
    return np.asarray(np.minimum(np.abs(seen - mapped), DEGREES - 1))


def by_area(seen_m2: Floats, mapped_m2: Floats, rules: GraphRules) -> Floats:
    """Return the ratios of equal against unrelated areas; 0 where there are none, shape (P,)."""
    off = np.log(seen_m2 / mapped_m2)
    has_both = np.isfinite(off)
    off = np.where(has_both, off, 0.0)
    spread = 2**0.5 * rules.area_spread
    right = np.log(spread / rules.area_sigma) + off**2 / 2 * (1 / spread**2 - 1 / rules.area_sigma**2)
    return np.where(has_both, np.logaddexp(np.log1p(-rules.wander) + right, np.log(rules.wander)), 0.0)


def by_arms(seen_deg: Floats, mapped_deg: Floats, rules: GraphRules) -> Floats:
    """Return the ratios of seen arms and the nearest mapped ones; 0 where either side has none, shape (P,)."""
    count = np.isfinite(mapped_deg).sum(axis=1, keepdims=True)
    nearest = arm_offsets_deg(seen_deg, mapped_deg)
    counts = np.isfinite(nearest)
    nearest = np.where(counts, nearest, 0.0)
    right = np.exp(-(nearest**2) / (2 * rules.arm_sigma_deg**2)) * (2 / np.pi) ** 0.5 / rules.arm_sigma_deg
    chance = np.maximum(count, 1) / 180.0
    ratio = np.log((1 - rules.wander) * right / chance + rules.wander)
    return np.asarray(np.where(counts, ratio, 0.0).sum(axis=1))


def arm_offsets_deg(seen_deg: Floats, mapped_deg: Floats) -> Floats:
    """Return the angle from each seen arm to the nearest mapped one, shape (P, MOST_ARMS); infinite without one."""
    off_deg = np.abs(wrap_deg(seen_deg[:, :, None] - mapped_deg[:, None, :]))
    return np.asarray(np.where(np.isfinite(off_deg), off_deg, np.inf).min(axis=2, initial=np.inf))


START: Final = GraphRules()  # of nodes of masks, and of all nodes before training
_SPREAD_M: Final = np.array([kind.spread_m for kind in NODE_KINDS])
_IS_DRAWN: Final = np.array([kind.drawing == "vectors" for kind in NODE_KINDS])
_NONE: Final[frozenset[int]] = frozenset()
_SLACK_M: Final = 1.0


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


@dataclass(frozen=True, slots=True, kw_only=True)
class Matching:
    """What the correspondences at one pose show; `degrees` and `links` of the nodes of vectors.

    `degrees`, shape (3,), counts pairs by how much their degrees differ; `links`, shape (3,), ways on both sides, in
    the view alone and on the map alone. `kinds`, shape (4, K), counts nodes of each kind: map nodes that were visible,
    those of them matched, seen nodes that count, those of them unmatched.
    """

    degrees: Ints
    links: Ints
    kinds: Ints


def match_nodes(
    seen: ObservedGraph, mapped: MappedGraph, poses: Sequence[Pose], rules: GraphRules = START
) -> list[Matching]:
    """Return what the best correspondences at each pose show, for the statistics of `rule_fitting`."""
    judge = _Judge.of(seen, mapped, rules)
    return [judge.matching(pose) for pose in poses]


def verify(
    seen: ObservedGraph, mapped: MappedGraph, poses: Sequence[Pose], rules: GraphRules = START
) -> list[GraphScore]:
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
    judge = _Judge.of(seen, mapped, rules)
    return [judge.score(pose) for pose in poses]


@dataclass(frozen=True, kw_only=True)
class _Stage:
    """A view at a pose: its nodes on the map, map nodes around, and the (negative) scores of unmatched nodes.

    `around` are rows of the map nodes; `is_judged` leaves out patches that reach beyond the view, of which the place
    and the area depend on what is out of view.
    """

    pose: Pose
    places_m: Floats
    around: Ints
    is_judged: Bools
    lost_seen: Floats
    lost_mapped: Floats


@dataclass(frozen=True, kw_only=True)
class _Pairs:
    """Candidate correspondences: rows of nodes of the view and of `_Stage.around`, and the score of each pair."""

    seen: Ints
    mapped: Ints
    score: Floats

    def some(self, keep: Bools) -> Self:
        return type(self)(seen=self.seen[keep], mapped=self.mapped[keep], score=self.score[keep])


@dataclass(frozen=True, kw_only=True)
class _Judge:
    """A view and a map, to be compared pose by pose."""

    seen: ObservedGraph
    mapped: MappedGraph
    rules: GraphRules
    pull: Floats

    @classmethod
    def of(cls, seen: ObservedGraph, mapped: MappedGraph, rules: GraphRules) -> Self:
        """Prepare a view: each drawing has rules of its own."""
        stretch_m = _by_kind(rules, "stretch_m")[seen.nodes.kind]
        # Influence of each node on the shift of others, shape (N, N), 0 on the diagonal
        distance_2 = ((seen.nodes.places_m[:, None] - seen.nodes.places_m[None]) ** 2).sum(axis=2)
        pull = np.exp(-distance_2 / (2 * stretch_m[:, None] ** 2))
        np.fill_diagonal(pull, 0.0)
        return cls(seen=seen, mapped=mapped, rules=rules, pull=np.asarray(pull))

    def score(self, pose: Pose) -> GraphScore:
        stage = self._stage(pose)
        return self._summed(stage, self._matched(stage))

    def matching(self, pose: Pose) -> Matching:
        stage = self._stage(pose)
        return self._shown(stage, self._matched(stage))

    def _shown(self, stage: _Stage, pairs: _Pairs) -> Matching:
        ours, theirs = self.seen.nodes, self.mapped.nodes
        own = _IS_DRAWN[ours.kind[pairs.seen]]
        seen, mapped = ours.degree[pairs.seen[own]], theirs.degree[stage.around[pairs.mapped[own]]]
        steps = degree_step(seen, mapped)[(seen > 0) & (mapped > 0)]
        return Matching(
            degrees=np.bincount(steps, minlength=len(self.rules.degrees)),
            links=self._links(stage, pairs)[0],
            kinds=self._counts(stage, pairs),
        )

    def _matched(self, stage: _Stage) -> _Pairs:
        pairs = self._assigned(stage, np.zeros_like(stage.places_m))
        if len(pairs.seen) < 3:  # nodes needed to estimate a local shift
            return pairs
        return self._assigned(stage, self._shift_m(stage, pairs))

    @property
    def _gate_m(self) -> Floats:
        """Return the largest offset of each kind, shape (K,)."""
        return np.asarray(_by_kind(self.rules, "gate_m") + _SPREAD_M)

    def _by_drawing(self, is_drawn: Bools) -> tuple[tuple[GraphRules, Bools], ...]:
        return ((self.rules, is_drawn), (START, ~is_drawn))

    def _stage(self, pose: Pose) -> _Stage:
        nodes, ours = self.mapped.nodes, self.seen.nodes
        reach_m = float(np.hypot(*self.seen.visible.shape[1:])) * self.seen.cell_size_m / 2 * pose.scale
        reach_m += (self._gate_m + _by_kind(self.rules, "shift_m")).max() + _SLACK_M
        around = self.mapped.around(np.array([pose.easting_m, pose.northing_m]), reach_m)
        around = around[self.seen.asked[nodes.kind[around]]]
        kind = nodes.kind[around]
        local_m = inverse(pose).to_map(nodes.places_m[around])
        half_m = np.array(self.seen.visible.shape[:0:-1]) * self.seen.cell_size_m / 2
        is_whole = (np.abs(local_m) + nodes.radius_m[around, None] / pose.scale < half_m).all(axis=1)
        out_m = (nodes.reach_m[around] - self._gate_m[kind]) / pose.scale
        is_due = is_whole & self.seen.shows(local_m, kind)
        places_m = pose.to_map(ours.places_m)
        counts = ~self.seen.is_cut & self.mapped.knows(places_m) & (self.mapped.density_per_m2[ours.kind] > 0)
        return _Stage(
            pose=pose,
            places_m=places_m,
            around=around,
            is_judged=(nodes.reach_m[around] == 0) | (np.abs(local_m) + out_m[:, None] < half_m).all(axis=1),
            lost_seen=np.where(counts, np.log(_by_kind(self.rules, "extra")[ours.kind]), 0.0),
            lost_mapped=np.where(is_due, np.log1p(-_by_kind(self.rules, "hit")[kind]), 0.0),
        )

    def _assigned(self, stage: _Stage, shift_m: Floats) -> _Pairs:
        """Return the best one-to-one correspondences within the gate around shifted nodes."""
        pairs = self._near(stage, shift_m)
        gain = pairs.score - stage.lost_seen[pairs.seen] - stage.lost_mapped[pairs.mapped]
        off_m = self._offsets_m(stage, pairs) - shift_m[pairs.seen]
        if shift_m.any():  # prefer offsets like those of neighbours
            sigma_m = _by_kind(self.rules, "place_sigma_m")[self.seen.nodes.kind[pairs.seen]]
            gain -= (off_m**2).sum(axis=1) / (2 * sigma_m**2)
        table = np.zeros((len(stage.places_m), len(stage.around)))
        table[pairs.seen, pairs.mapped] = np.maximum(gain, 0.0)
        rows, cols = np.unique(pairs.seen), np.unique(pairs.mapped)
        row, col = scipy.optimize.linear_sum_assignment(table[np.ix_(rows, cols)], maximize=True)
        chosen = np.zeros_like(table, dtype=bool)
        chosen[rows[row], cols[col]] = True
        return pairs.some(chosen[pairs.seen, pairs.mapped] & (gain > 0))

    def _near(self, stage: _Stage, shift_m: Floats) -> _Pairs:
        ours = self.seen.nodes
        row, there = self.mapped.like(stage.places_m + shift_m, ours.kind, self._gate_m[ours.kind])
        place = np.searchsorted(stage.around, there)
        is_judged = stage.is_judged[place]
        row, there, place = row[is_judged], there[is_judged], place[is_judged]
        pairs = _Pairs(seen=row, mapped=place, score=np.zeros(len(row)))
        off_2 = (self._offsets_m(stage, pairs) ** 2).sum(axis=1)
        for rules, own in self._by_drawing(_IS_DRAWN[ours.kind[row]]):
            pairs.score[own] = self._alike(stage.pose, row[own], there[own], off_2[own], rules)
        return pairs

    def _alike(self, pose: Pose, row: Ints, there: Ints, off_2: Floats, rules: GraphRules) -> Floats:
        """Return scores of pairs of nodes by place, degree, area and arms, shape (P,)."""
        ours, theirs = self.seen.nodes, self.mapped.nodes
        kind = ours.kind[row]
        sigma_m = np.hypot(rules.place_sigma_m, _SPREAD_M[kind])
        dense = np.exp(-off_2 / (2 * sigma_m**2)) / (2 * np.pi * sigma_m**2)
        flat = 1 / (np.pi * self._gate_m[kind] ** 2)
        place = np.log((1 - rules.wander) * dense + rules.wander * flat) - np.log(self.mapped.density_per_m2[kind])
        score = np.log(_by_kind(self.rules, "hit")[kind]) + place
        score += by_degree(ours.degree[row], theirs.degree[there], rules)
        score += by_area(ours.area_m2[row] * pose.scale**2, theirs.area_m2[there], rules)
        score += by_arms(ours.arms_deg[row] + pose.yaw_deg, theirs.arms_deg[there], rules)
        return np.asarray(score)

    def _offsets_m(self, stage: _Stage, pairs: _Pairs) -> Floats:
        """Return offsets from nodes of the view to those of the map, shape (P, 2)."""
        return np.asarray(self.mapped.nodes.places_m[stage.around[pairs.mapped]] - stage.places_m[pairs.seen])

    def _shift_m(self, stage: _Stage, pairs: _Pairs) -> Floats:
        """Return the mean offset of the neighbours of each node, without itself, shrunk towards 0."""
        follows = self.pull[:, pairs.seen]
        shift_m = (follows @ self._offsets_m(stage, pairs)) / (follows.sum(axis=1, keepdims=True) + 1.0)
        length_m = np.hypot(*shift_m.T)
        most_m = _by_kind(self.rules, "shift_m")[self.seen.nodes.kind]
        return np.asarray(shift_m * np.minimum(1.0, most_m / np.maximum(length_m, 1e-9))[:, None])

    def _summed(self, stage: _Stage, pairs: _Pairs) -> GraphScore:
        lost_seen, lost_mapped = stage.lost_seen.copy(), stage.lost_mapped.copy()
        lost_seen[pairs.seen] = lost_mapped[pairs.mapped] = 0.0
        off_m = self._offsets_m(stage, pairs)
        edges, links = self._by_neighbours(stage, pairs, off_m), self._links(stage, pairs)
        good = int((edges > 0).sum() + links[:, 0].sum())
        bad = int((edges < 0).sum() + links[:, 1:].sum())
        missing = int((lost_seen < 0).sum()), int((lost_mapped < 0).sum())
        fine = 2 * len(pairs.seen) + good
        judged = fine + sum(missing) + bad
        return GraphScore(
            score=float(pairs.score.sum() + lost_seen.sum() + lost_mapped.sum() + edges.sum())
            + sum(
                float(row @ (one.link, one.false_link, one.lost_link))
                for row, one in zip(links, (self.rules, START), strict=True)
            ),
            matched=len(pairs.seen),
            unmatched_seen=missing[0],
            unmatched_mapped=missing[1],
            agreeing=good,
            contradicting=bad,
            consistency=fine / judged if judged else 0.0,
            rms_m=float(np.sqrt((off_m**2).sum(axis=1).mean())) if len(off_m) else 0.0,
        )

    def _by_neighbours(self, stage: _Stage, pairs: _Pairs, off_m: Floats) -> Floats:
        ends, kind, length_m = self._neighbours(stage, pairs)
        strain_2 = ((off_m[ends[:, 0]] - off_m[ends[:, 1]]) ** 2).sum(axis=1)
        spread_2 = (_SPREAD_M[kind] ** 2).sum(axis=1)
        score = np.zeros(len(ends))
        for rules, own in self._by_drawing(np.asarray(_IS_DRAWN[kind].all(axis=1))):
            sigma_2 = rules.edge_sigma_m**2 + (rules.edge_strain * length_m[own]) ** 2 + spread_2[own]
            chance_2 = 2 * rules.place_sigma_m**2 + spread_2[own]  # of two independent offsets
            ratio = np.log(chance_2 / sigma_2) - strain_2[own] / 2 * (1 / sigma_2 - 1 / chance_2)
            ratio = np.where(sigma_2 < chance_2, np.maximum(ratio, np.log(rules.wander)), 0.0)
            score[own] = rules.edge_weight * ratio
        return score

    def _neighbours(self, stage: _Stage, pairs: _Pairs) -> tuple[Ints, Ints, Floats]:
        """Return pairs of matched neighbours: rows of `pairs` and kinds, shape (E, 2) each, and distances, metres."""
        at = np.full(len(stage.places_m), -1)
        at[pairs.seen] = np.arange(len(pairs.seen))
        kept = (at[self.seen.near] >= 0).all(axis=1)
        near = self.seen.near[kept]
        length_m = np.hypot(*(stage.places_m[near[:, 0]] - stage.places_m[near[:, 1]]).T)
        return at[near], self.seen.nodes.kind[near], length_m

    def _links(self, stage: _Stage, pairs: _Pairs) -> Ints:
        """Count ways between matched nodes of vectors and of masks, shape (2, 3)."""
        # On both sides, in the view alone, on the map alone. A way past an unmatched node is no contradiction: that
        # node is counted already.
        ours, theirs = self.seen.links, self.mapped.links
        to_map = dict(zip(pairs.seen.tolist(), stage.around[pairs.mapped].tolist(), strict=True))
        to_view = {there: here for here, there in to_map.items()}
        row = (~_IS_DRAWN[self.seen.nodes.kind]).astype(int).tolist()
        found = np.zeros((2, 3), dtype=np.int64)
        for one, there in to_map.items():
            for two in ours.get(one, _NONE):
                if one < two and two in to_map:
                    if to_map[two] in theirs.get(there, _NONE):
                        found[row[one], 0] += 1
                    elif not _passes(theirs, there, to_map[two], matched=to_view):
                        found[row[one], 1] += 1
        for one, here in to_view.items():
            for two in theirs.get(one, _NONE):
                if one < two and two in to_view:
                    other = to_view[two]
                    if other not in ours.get(here, _NONE) and not _passes(ours, here, other, matched=to_map):
                        found[row[here], 2] += 1
        return found

    def _counts(self, stage: _Stage, pairs: _Pairs) -> Ints:
        """Return the counts of `Matching.kinds`."""
        around, ours = self.mapped.nodes.kind[stage.around], self.seen.nodes.kind
        is_due, counts = stage.lost_mapped < 0, stage.lost_seen < 0
        is_matched, is_free = np.zeros_like(is_due), np.ones_like(counts)
        is_matched[pairs.mapped], is_free[pairs.seen] = True, False
        chosen = (around[is_due], around[is_due & is_matched], ours[counts], ours[counts & is_free])
        return np.stack([np.bincount(kind, minlength=len(NODE_KINDS)) for kind in chosen])


def _by_kind(rules: GraphRules, name: str) -> Floats:
    """Return a number for each kind of node, shape (K,): of these rules for vectors, the starting value for masks."""
    # Shares of kinds are counted in the view itself, whatever it was drawn from.
    value = np.asarray(getattr(rules, name), dtype=np.float64)
    return value if value.ndim else np.where(_IS_DRAWN, value, getattr(START, name))


def _passes(links: dict[int, set[int]], one: int, two: int, *, matched: dict[int, int]) -> bool:
    return any(node not in matched for node in links.get(one, _NONE) & links.get(two, _NONE))
