# SPDX-License-Identifier: Apache-2.0
"""A map and a view as one ablation of the scorer reads them: input of the search, and terms of the joint score."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING, Final, NamedTuple, Self

import numpy as np
import scipy  # its trees are loaded where they are used: matchers without a graph start without them
from numpy.typing import NDArray

from sasgeo_bench.core.errors import ConfigError
from sasgeo_bench.geometry.pose import Pose, Prior, wrap_deg
from sasgeo_bench.osm.taxonomy import load_taxonomy
from sasgeo_bench.regions.evidence import PRESENT, Evidence
from sasgeo_bench.regions.region import Region
from sasgeo_bench.sasgeo.ablations import Switches
from sasgeo_bench.sasgeo.class_weights import Rarity
from sasgeo_bench.sasgeo.graph import GraphScore, verify
from sasgeo_bench.sasgeo.joint import columns, of_prior
from sasgeo_bench.sasgeo.mapped import JUNCTIONS, JunctionPairs, MappedGraph
from sasgeo_bench.sasgeo.nodes import Floats, Ints, Nodes
from sasgeo_bench.sasgeo.observed import ObservedGraph
from sasgeo_bench.sasgeo.overlap import Compared, overlap_of, overlap_weights
from sasgeo_bench.sasgeo.raster import CELL_M, RasterView, burnt, read_field, with_unknown_margins
from sasgeo_bench.sasgeo.scorer_model import ScorerModel
from sasgeo_bench.sasgeo.weights import information
from sasgeo_bench.search.field import Field, Template
from sasgeo_bench.search.plan import Plan
from sasgeo_bench.tasks.query import Query

if TYPE_CHECKING:
    from scipy.spatial import cKDTree

APART_M: Final = (30.0, 180.0)  # of two junctions: nearer ones give no heading, farther ones are seldom both in a view
SLACK_M: Final = 4.0  # tolerance of their distance
_PLACE_M, _YAW_DEG, _LOG_SCALE = 12.0, 8.0, 0.08  # votes within these are for one pose
_SIGMAS: Final = 3.0
_REACH: Final = 1.0 + 1e-6  # tolerance, so that a mean keeps some of its votes


class Proposal(NamedTuple):
    """A pose and its votes: the sum of the rarities of agreeing pairs of junctions, nats."""

    pose: Pose
    votes: float


def proposals(
    seen: ObservedGraph,
    mapped: MappedGraph,
    *,
    count: int,
    scales: tuple[float, float] = (1.0, 1.0),
    prior: Prior | None = None,
) -> list[Proposal]:
    """Propose up to `count` poses from pairs of junctions whose arms agree, the most votes first.

    Each pair of the view is looked up among those of the map by length, within the scales, and directions of arms. Each
    hit votes for one pose, in closed form, with a weight that falls with the number of hits for that length. Poses
    outside the prior's disc, or beyond three sigma of its heading, are dropped.

    Raises
    ------
    ConfigError
        If the scales are not positive, finite and in order.
    """
    if not 0 < scales[0] <= scales[1] < math.inf:
        raise ConfigError(f"scales are the least and the greatest scale, both positive and finite, got {scales!r}")
    cast = np.concatenate([np.zeros((0, 6)), *(_votes(seen.nodes, mapped, kind, scales) for kind in JUNCTIONS)])
    if prior is not None:
        # Which poses a prior allows
        fits = np.ones(len(cast), dtype=bool)
        if prior.center_m is not None and prior.radius_m is not None:
            fits &= np.hypot(*(cast[:, :2] - prior.center_m).T) <= prior.radius_m + _PLACE_M
        if prior.yaw_deg is not None and prior.yaw_sigma_deg is not None:
            fits &= np.abs(wrap_deg(cast[:, 2] - prior.yaw_deg)) <= _SIGMAS * prior.yaw_sigma_deg
        cast = cast[fits]
    return _counted(cast, count) if len(cast) and count > 0 else []


def _votes(nodes: Nodes, mapped: MappedGraph, kind: int, scales: tuple[float, float]) -> Floats:
    """Return easting, northing, yaw, scale, weight and number of the pair for each hit, shape (V, 6)."""
    ours, found = JunctionPairs.of(nodes, kind, range_m=APART_M), [np.zeros((0, 6))]
    for theirs in mapped.junction_pairs[kind]:
        low, high = (
            np.searchsorted(theirs.length_m, ours.length_m * scale + slack_m)
            for scale, slack_m in zip(scales, (-SLACK_M, SLACK_M), strict=True)
        )
        # At most 150 pairs of a view, the longest: they give the best heading
        for number in range(max(0, len(ours.length_m) - 150), len(ours.length_m)):
            first, last = int(low[number]), int(high[number])
            hits = theirs.like(ours.arms[number], first, last)
            if len(hits):
                poses = _similarities(nodes, ours, number, mapped, theirs, hits, scales)
                rarity = math.log((last - first + 1) / len(hits))  # always positive
                about = np.broadcast_to([rarity, number], (len(hits), 2))
                found.append(np.column_stack((poses, about)))
    return np.concatenate(found)


def _similarities(
    nodes: Nodes,
    ours: JunctionPairs,
    number: int,
    mapped: MappedGraph,
    theirs: JunctionPairs,
    hits: Ints,
    scales: tuple[float, float],
) -> Floats:
    """Return the similarities from one pair of the view to pairs of the map: easting, northing, yaw, scale, (H, 4)."""
    yaw_deg = theirs.bearing_deg[hits] - ours.bearing_deg[number]
    scale = np.clip(theirs.length_m[hits] / ours.length_m[number], *scales)
    right_m, up_m = nodes.places_m[ours.ends[number]].mean(axis=0)
    sine, cosine = np.sin(np.radians(yaw_deg)), np.cos(np.radians(yaw_deg))
    turned_m = np.column_stack((cosine * right_m + sine * up_m, cosine * up_m - sine * right_m))
    middle_m = mapped.nodes.places_m[theirs.ends[hits]].mean(axis=1) - scale[:, None] * turned_m
    return np.column_stack((middle_m, yaw_deg, scale))


def _counted(cast: Floats, count: int) -> list[Proposal]:
    """Return poses with the most votes, best first, no two for one place and heading."""
    at = _spread(cast)
    tree = scipy.spatial.cKDTree(at)
    # 10 cells of votes tried for each requested pose
    found = [_gathered(cast, at, tree, start) for start in _crowded(cast, at, 10 * count)]
    kept: list[tuple[Proposal, Floats]] = []
    for proposal, place in sorted(found, key=lambda item: -item[0].votes):
        if all(np.linalg.norm(place - other) > 2 * _REACH for _, other in kept):
            kept.append((proposal, place))
    return [proposal for proposal, _ in kept[:count]]


def _spread(cast: Floats) -> Floats:
    """Return votes as points, shape (V, 5): those for one pose lie within 1 of each other, and headings wrap around."""
    turn = np.radians(cast[:, 2:3])
    return np.column_stack(
        (
            cast[:, :2] / _PLACE_M,
            np.concatenate((np.cos(turn), np.sin(turn)), axis=1) / math.radians(_YAW_DEG),
            np.log(cast[:, 3]) / _LOG_SCALE,
        )
    )


def _crowded(cast: Floats, at: Floats, most: int) -> Floats:
    """Return centres of the cells with the most votes, shape (S, 5)."""
    _, cell = np.unique(np.floor(at).astype(np.int64), axis=0, return_inverse=True)
    cell = cell.ravel()
    weight = np.bincount(cell, weights=cast[:, 4])
    middle = np.column_stack([np.bincount(cell, weights=part) for part in at.T]) / np.bincount(cell)[:, None]
    return np.asarray(middle[np.argsort(-weight, kind="stable")[:most]])


def _gathered(cast: Floats, at: Floats, tree: "cKDTree", start: Floats) -> tuple[Proposal, Floats]:
    """Return the pose of the votes around a point, and its point; each pair of the view votes once."""
    place = at[tree.query(start)[1]]
    for _ in range(2):
        near = np.array(sorted(tree.query_ball_point(place, _REACH)), dtype=np.int64)
        some = cast[near]
        place = np.average(at[near], axis=0, weights=some[:, 4])
    east_m, north_m = (place[:2] * _PLACE_M).tolist()
    yaw_deg = math.degrees(math.atan2(place[3], place[2]))
    best = np.zeros(int(some[:, 5].max()) + 1)
    np.maximum.at(best, some[:, 5].astype(np.int64), some[:, 4])
    pose = Pose(easting_m=east_m, northing_m=north_m, yaw_deg=yaw_deg, scale=math.exp(place[4] * _LOG_SCALE))
    return Proposal(pose=pose, votes=float(best.sum())), place


DAYS_PER_YEAR: Final = 365.25
MOST_SIGMA_M: Final = 25.0  # of a position where the score is flat
MOST_SCALED: Final = 0.9
_STEP_M: Final = 4.0  # for the curvature of a score


def age_years(query: Query, region: Region) -> float:
    """Return the years from the map to the view; 0 for a younger map."""
    return max(0.0, (query.observed_on - region.manifest.extract.date).days / DAYS_PER_YEAR)


@dataclass(frozen=True, kw_only=True)
class Reader:
    """A map prepared for one ablation; `model` has the classes of the map, in its order."""

    region: Region
    model: ScorerModel
    switches: Switches
    field: Field
    graph: MappedGraph | None
    rarity: Rarity | None

    @classmethod
    def of(cls, region: Region, model: ScorerModel, switches: Switches, *, search_cell_m: float = CELL_M) -> Self:
        """Prepare a map; it is searched in cells of about `search_cell_m`."""
        model = model.of_classes(region.classes)
        cell_m = region.grid.cell_size_m
        is_rare = switches.is_distinctive
        return cls(
            region=region,
            model=model,
            switches=switches,
            field=read_field(
                region, model.likeness, trust=model.trust if switches.is_stamped else None, cell_size_m=search_cell_m
            ),
            graph=MappedGraph.of(region) if switches.has_graph else None,
            rarity=Rarity.of(region.layers, region.classes, cell_size_m=cell_m) if is_rare else None,
        )

    def read(self, query: Query) -> "Reading":
        """Return a view on the map."""
        return Reading(reader=self, query=query)


_FAINT: Final = 2  # times the cells of the coarsest level, see `Reading.plan`; from pictures of train places
LEAST_SIGMA_M: Final = 1.0  # of a refined position: half a cell of the search


@dataclass(frozen=True, kw_only=True)
class Reading:
    """A view on a map, with its template, graph and scores."""

    reader: Reader
    query: Query

    @cached_property
    def age_years(self) -> float:
        """Return the age of the map."""
        return age_years(self.query, self.reader.region)

    @cached_property
    def view(self) -> RasterView:
        """Return the view weighed by gains per square metre, so that scales of evidence hold for any cell size."""
        reader, seen = self.reader, self.reader.switches.seen(self.query.evidence)
        gains = reader.switches.gains(reader.model, age_years=self.age_years, season=self.query.season)
        view = RasterView.of(seen, reader.region.classes, gains)
        drawn = self._burnt()
        if drawn is not None:
            both = [name in drawn.classes for name in reader.region.classes]
            view = view.halved_with(RasterView.of(drawn, reader.region.classes, gains), both)
        view = view.times(np.float32(seen.cell_size_m**2))
        if reader.switches.is_correlated(self.query.evidence):
            view = view.levelled().damped()
        if reader.rarity is None:
            return view
        return view.times(reader.rarity.weights(seen.cells, seen.classes, cell_size_m=seen.cell_size_m))

    def _burnt(self) -> Evidence | None:
        """Return the perceived vectors as a raster view, if the ablation reads them and there are any."""
        vectors = self.query.vectors
        if vectors is None or not self.reader.switches.burns_vectors:
            return None
        drawn = burnt(vectors, self.query.evidence)
        return None if drawn is None else with_unknown_margins(drawn)

    @cached_property
    def template(self) -> Template:
        """Return the template of the gains of Eq. 7."""
        return self.view.scaled(self.reader.model.scaling).template()

    @cached_property
    def searched(self) -> Template:
        """Return the template of the search: that of the gains, and of a certain view its overlap with the map."""
        if not (self._is_sharp and self.reader.switches.searches_overlap):
            return self.template
        weights = self.template.weights + overlap_weights(self._read, self.reader.region.classes)
        return replace(self.template, weights=weights)

    @cached_property
    def _read(self) -> Evidence:
        return self.reader.switches.read(self.query.evidence)

    @property
    def _is_sharp(self) -> bool:
        """Return whether the view is read as certain, and errors in it hang together."""
        return self._read.is_certain and self.reader.switches.is_correlated(self.query.evidence)

    @property
    def graph(self) -> MappedGraph | None:
        """Return the graph of the map, if the ablation has one and the view has vectors."""
        return None if self.query.vectors is None else self.reader.graph

    @cached_property
    def observed(self) -> ObservedGraph:
        """Return the graph of the view."""
        return ObservedGraph.of(self.query)

    def proposed(self) -> list[Pose]:
        """Return poses proposed by pairs of junctions, if there is a graph and the heading is unknown."""
        prior, graph = self.query.prior, self.graph
        if graph is None or prior.yaw_deg is not None:
            return []
        reach = min(2.5 * prior.scale_sigma, MOST_SCALED)  # standard deviations of scale, as in the search
        # 20 poses by the graph, of a view of any heading
        found = proposals(self.observed, graph, count=20, scales=(1 - reach, 1 + reach), prior=prior)
        return [item.pose for item in found]

    def plan(self, plan: Plan) -> Plan:
        """Return how the view is searched: from cells half as large if it has probabilities, whoever reads them.

        Where no class is certain, a place stands out on large cells too little to stay within the beam.
        """
        return plan if self.query.evidence.is_certain else replace(plan, cells=_FAINT * plan.cells)

    def by_class(self, poses: Sequence[Pose]) -> NDArray[np.float64]:
        """Return scores of Eq. 8 by class before scaling, shape (M, C)."""
        return self.view.by_class(self.reader.field, poses)

    def verified(self, poses: Sequence[Pose]) -> list[GraphScore] | None:
        """Return scores of Eq. 9, if there is a graph."""
        return None if self.graph is None else verify(self.observed, self.graph, poses, self.reader.model.rules)

    def terms(self, poses: Sequence[Pose], verified: Sequence[GraphScore] | None) -> NDArray[np.float64]:
        """Return terms of Eq. 11 of each pose, see `joint.columns`, and those of `beside`."""
        scaled, blend = self.by_class(poses) * self.reader.model.scaling, self.reader.model.blend
        graph = None if verified is None else np.array([one.score for one in verified])
        nodes = 0 if graph is None else len(self.observed.nodes)
        terms = columns(scaled, graph, blend, nodes=nodes)
        if self._is_sharp:
            return np.column_stack((terms, self.beside(poses) * blend.beside))
        if not self.reader.switches.is_correlated(self.query.evidence):
            return terms
        by_map = Compared.of(self._read, self.reader.region.classes, self.reader.field, poses).explained
        return np.column_stack((terms, blend.alpha * by_map, blend.alpha * of_prior(poses, self.query.prior)))

    def beside(self, poses: Sequence[Pose]) -> NDArray[np.float64]:
        """Return our terms of a certain view at each pose before they are weighed, shape (M, 4), 0 where left out.

        They are what the prior says of heading and of scale, how unlike the amounts of the classes are, negative, and
        the overlap of view and map.
        """
        switches, region, found = self.reader.switches, self.reader.region, np.zeros((len(poses), 4))
        if not self._is_sharp:
            return found
        if switches.weighs_prior:
            found[:, :2] = of_prior(poses, self.query.prior)
        if switches.weighs_amounts or switches.weighs_overlap != "never":
            near = None if switches.is_stamped else self.reader.model.likeness[:, 1]
            compared = Compared.of(self._read, region.classes, self.reader.field, poses, near=near)
            if switches.weighs_amounts:
                found[:, 2] = -compared.unlike.sum(axis=1)
            if switches.weighs_overlap != "never":
                is_line = np.array([name in load_taxonomy().lines for name in region.classes])
                found[:, 3] = overlap_of(compared, is_line, is_gated=switches.weighs_overlap == "gated")
        return found

    def sigma_m(self, pose: Pose) -> float:
        """Return the standard deviation of a refined position from the curvature of the raster score, metres."""
        steps = [(0.0, 0.0), (_STEP_M, 0.0), (-_STEP_M, 0.0), (0.0, _STEP_M), (0.0, -_STEP_M)]
        poses = [
            replace(pose, easting_m=pose.easting_m + east_m, northing_m=pose.northing_m + north_m)
            for east_m, north_m in steps
        ]
        here, east, west, north, south = (self.by_class(poses) * self.reader.model.scaling).sum(axis=1).tolist()
        bend = min(2 * here - east - west, 2 * here - north - south) / _STEP_M**2
        return float(np.clip(1 / math.sqrt(bend), LEAST_SIGMA_M, MOST_SIGMA_M)) if bend > 0 else MOST_SIGMA_M

    @cached_property
    def information_nats(self) -> float:
        """Return the information in known cells: cells by class, times mutual information and scale of evidence."""
        model, seen = self.reader.model, self.query.evidence
        known = {name: float((layer <= PRESENT).sum()) for name, layer in zip(seen.classes, seen.cells, strict=True)}
        return sum(
            known.get(name, 0.0) * information(rates, age_years=self.age_years) * float(scaling)
            for name, rates, scaling in zip(model.classes, model.rates, model.scaling, strict=True)
        )
