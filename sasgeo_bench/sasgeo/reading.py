# SPDX-License-Identifier: Apache-2.0
"""A map and a view as one arm of the scorer reads them: what the search gets, and the terms of the joint score."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Final, Self

import numpy as np
from numpy.typing import NDArray

from sasgeo_bench.geometry.pose import Pose
from sasgeo_bench.regions.evidence import PRESENT
from sasgeo_bench.regions.region import Region
from sasgeo_bench.sasgeo.ablations import Switches
from sasgeo_bench.sasgeo.distinct import Rarity
from sasgeo_bench.sasgeo.graph import GraphScore, verify
from sasgeo_bench.sasgeo.joint import columns
from sasgeo_bench.sasgeo.learnt import Learnt
from sasgeo_bench.sasgeo.mapped import MappedGraph
from sasgeo_bench.sasgeo.observed import ObservedGraph
from sasgeo_bench.sasgeo.raster import RasterView, likeness_by_hand, read_field
from sasgeo_bench.sasgeo.tuples import proposals
from sasgeo_bench.sasgeo.weights import information
from sasgeo_bench.search.field import Field, Template
from sasgeo_bench.tasks.query import Query

DAYS_PER_YEAR: Final = 365.25
LEAST_SIGMA_M: Final = 1.0  # of a refined position: half a cell of the search
MOST_SIGMA_M: Final = 25.0  # a score that does not bend tells no place better than this
PROPOSED: Final = 20  # poses by the graph, of a view of any heading
SCALE_SPREAD: Final = 2.5  # standard deviations of scale, as the search looks for
MOST_SCALED: Final = 0.9
_STEP_M: Final = 4.0  # for the bend of a score


def age_years(query: Query, region: Region) -> float:
    """From the map to the view; 0 where the map is the younger one."""
    return max(0.0, (query.observed_on - region.manifest.extract.date).days / DAYS_PER_YEAR)


@dataclass(frozen=True, kw_only=True)
class Reader:
    """A map made ready for one arm; `learnt` in the order of its classes."""

    region: Region
    learnt: Learnt
    switches: Switches
    field: Field
    graph: MappedGraph | None
    rarity: Rarity | None

    @classmethod
    def of(cls, region: Region, learnt: Learnt, switches: Switches) -> Self:
        """Read a map."""
        learnt = learnt.of_classes(region.classes)
        near = learnt.likeness if switches.learns else likeness_by_hand(region.classes)
        cell_m = region.grid.cell_size_m
        is_rare = switches.is_distinctive
        return cls(
            region=region,
            learnt=learnt,
            switches=switches,
            field=read_field(region, near, trust=learnt.trust if switches.is_stamped else None),
            graph=MappedGraph.of(region) if switches.has_graph else None,
            rarity=Rarity.of(region.layers, region.classes, cell_size_m=cell_m) if is_rare else None,
        )

    def learning(self, learnt: Learnt) -> Self:
        """The same map by other exponents and weights; likeness is that of the map as it was read."""
        return replace(self, learnt=learnt.of_classes(self.region.classes))

    def glance(self, query: Query) -> "Glance":
        """Read a view."""
        return Glance(reader=self, query=query)


@dataclass(frozen=True, kw_only=True)
class Glance:
    """A view on a map."""

    reader: Reader
    query: Query

    @cached_property
    def age_years(self) -> float:
        """Of the map."""
        return age_years(self.query, self.reader.region)

    @cached_property
    def view(self) -> RasterView:
        """Weighed by the gains of the arm, by square metre so that exponents are those of any cell, not tempered."""
        reader, seen = self.reader, self.reader.switches.seen(self.query.evidence)
        gains = reader.switches.gains(reader.learnt, age_years=self.age_years, season=self.query.season)
        view = RasterView.of(seen, reader.region.classes, gains).times(np.float32(seen.cell_size_m**2))
        if reader.rarity is None:
            return view
        return view.times(reader.rarity.weights(seen.cells, seen.classes, cell_size_m=seen.cell_size_m))

    @cached_property
    def template(self) -> Template:
        """What is searched for."""
        return self.view.tempered(self.reader.learnt.temper).template()

    @cached_property
    def observed(self) -> ObservedGraph:
        """The graph of the view."""
        return ObservedGraph.of(self.query)

    def proposed(self) -> list[Pose]:
        """Poses that pairs of junctions propose, where the arm looks at graphs and the heading is not known."""
        prior, graph = self.query.prior, self.reader.graph
        if graph is None or prior.yaw_deg is not None:
            return []
        reach = min(SCALE_SPREAD * prior.scale_sigma, MOST_SCALED)
        found = proposals(self.observed, graph, count=PROPOSED, scales=(1 - reach, 1 + reach), prior=prior)
        return [item.pose for item in found]

    def by_class(self, poses: Sequence[Pose]) -> NDArray[np.float64]:
        """Scores of Eq. 8 by class, not tempered, shape (M, C)."""
        return self.view.by_class(self.reader.field, poses)

    def verified(self, poses: Sequence[Pose]) -> list[GraphScore] | None:
        """Scores of Eq. 9, where the arm looks at graphs."""
        return None if self.reader.graph is None else verify(self.observed, self.reader.graph, poses)

    def terms(self, poses: Sequence[Pose], verified: Sequence[GraphScore] | None) -> NDArray[np.float64]:
        """Terms of Eq. 11 of each pose: see `joint.columns`."""
        tempered = self.by_class(poses) * self.reader.learnt.temper
        graph = None if verified is None else np.array([one.score for one in verified])
        nodes = 0 if graph is None else len(self.observed.nodes)
        return columns(tempered, graph, self.reader.learnt.blend, nodes=nodes)

    def sigma_m(self, pose: Pose) -> float:
        """Standard deviation of a refined position, metres, from the bend of the raster's score around it."""
        steps = [(0.0, 0.0), (_STEP_M, 0.0), (-_STEP_M, 0.0), (0.0, _STEP_M), (0.0, -_STEP_M)]
        poses = [
            replace(pose, easting_m=pose.easting_m + east_m, northing_m=pose.northing_m + north_m)
            for east_m, north_m in steps
        ]
        here, east, west, north, south = (self.by_class(poses) * self.reader.learnt.temper).sum(axis=1).tolist()
        bend = min(2 * here - east - west, 2 * here - north - south) / _STEP_M**2
        return float(np.clip(1 / math.sqrt(bend), LEAST_SIGMA_M, MOST_SIGMA_M)) if bend > 0 else MOST_SIGMA_M

    @cached_property
    def information_nats(self) -> float:
        """What the known cells can tell of the place: cells by class, mutual information, exponent."""
        learnt, seen = self.reader.learnt, self.query.evidence
        known = {name: float((layer <= PRESENT).sum()) for name, layer in zip(seen.classes, seen.cells, strict=True)}
        return sum(
            known.get(name, 0.0) * information(rates, age_years=self.age_years) * float(temper)
            for name, rates, temper in zip(learnt.classes, learnt.rates, learnt.temper, strict=True)
        )
