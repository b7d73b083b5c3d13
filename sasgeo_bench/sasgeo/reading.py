# SPDX-License-Identifier: Apache-2.0
"""A map and a view as one ablation of the scorer reads them: input of the search, and terms of the joint score."""

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
from sasgeo_bench.sasgeo.learnt import ScorerModel
from sasgeo_bench.sasgeo.mapped import MappedGraph
from sasgeo_bench.sasgeo.observed import ObservedGraph
from sasgeo_bench.sasgeo.raster import RasterView, likeness_by_hand, read_field
from sasgeo_bench.sasgeo.tuples import proposals
from sasgeo_bench.sasgeo.weights import information
from sasgeo_bench.search.field import Field, Template
from sasgeo_bench.tasks.query import Query

DAYS_PER_YEAR: Final = 365.25
LEAST_SIGMA_M: Final = 1.0  # of a refined position: half a cell of the search
MOST_SIGMA_M: Final = 25.0  # of a position where the score is flat
PROPOSED: Final = 20  # poses by the graph, of a view of any heading
SCALE_SPREAD: Final = 2.5  # standard deviations of scale, as in the search
MOST_SCALED: Final = 0.9
_STEP_M: Final = 4.0  # for the curvature of a score


def age_years(query: Query, region: Region) -> float:
    """Return the years from the map to the view; 0 for a younger map."""
    return max(0.0, (query.observed_on - region.manifest.extract.date).days / DAYS_PER_YEAR)


@dataclass(frozen=True, kw_only=True)
class Reader:
    """A map prepared for one ablation; `learnt` is the model in the order of its classes."""

    region: Region
    learnt: ScorerModel
    switches: Switches
    field: Field
    graph: MappedGraph | None
    rarity: Rarity | None

    @classmethod
    def of(cls, region: Region, learnt: ScorerModel, switches: Switches) -> Self:
        """Prepare a map."""
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

    def read(self, query: Query) -> "Reading":
        """Return a view on the map."""
        return Reading(reader=self, query=query)


@dataclass(frozen=True, kw_only=True)
class Reading:
    """A view on a map, with its template, graph and scores."""

    reader: Reader
    query: Query

    @cached_property
    def age_years(self) -> float:
        """Age of the map."""
        return age_years(self.query, self.reader.region)

    @cached_property
    def view(self) -> RasterView:
        """Return the view weighed by gains per square metre, so that scales of evidence hold for any cell size."""
        reader, seen = self.reader, self.reader.switches.seen(self.query.evidence)
        gains = reader.switches.gains(reader.learnt, age_years=self.age_years, season=self.query.season)
        view = RasterView.of(seen, reader.region.classes, gains).times(np.float32(seen.cell_size_m**2))
        if reader.rarity is None:
            return view
        return view.times(reader.rarity.weights(seen.cells, seen.classes, cell_size_m=seen.cell_size_m))

    @cached_property
    def template(self) -> Template:
        """Return the template of the search."""
        return self.view.scaled(self.reader.learnt.scaling).template()

    @cached_property
    def observed(self) -> ObservedGraph:
        """Return the graph of the view."""
        return ObservedGraph.of(self.query)

    def proposed(self) -> list[Pose]:
        """Return poses proposed by pairs of junctions, if the ablation has a graph and the heading is unknown."""
        prior, graph = self.query.prior, self.reader.graph
        if graph is None or prior.yaw_deg is not None:
            return []
        reach = min(SCALE_SPREAD * prior.scale_sigma, MOST_SCALED)
        found = proposals(self.observed, graph, count=PROPOSED, scales=(1 - reach, 1 + reach), prior=prior)
        return [item.pose for item in found]

    def by_class(self, poses: Sequence[Pose]) -> NDArray[np.float64]:
        """Return scores of Eq. 8 by class before scaling, shape (M, C)."""
        return self.view.by_class(self.reader.field, poses)

    def verified(self, poses: Sequence[Pose]) -> list[GraphScore] | None:
        """Return scores of Eq. 9, if the ablation has a graph."""
        return None if self.reader.graph is None else verify(self.observed, self.reader.graph, poses)

    def terms(self, poses: Sequence[Pose], verified: Sequence[GraphScore] | None) -> NDArray[np.float64]:
        """Return terms of Eq. 11 of each pose: see `joint.columns`."""
        scaled = self.by_class(poses) * self.reader.learnt.scaling
        graph = None if verified is None else np.array([one.score for one in verified])
        nodes = 0 if graph is None else len(self.observed.nodes)
        return columns(scaled, graph, self.reader.learnt.blend, nodes=nodes)

    def sigma_m(self, pose: Pose) -> float:
        """Return the standard deviation of a refined position from the curvature of the raster score, metres."""
        steps = [(0.0, 0.0), (_STEP_M, 0.0), (-_STEP_M, 0.0), (0.0, _STEP_M), (0.0, -_STEP_M)]
        poses = [
            replace(pose, easting_m=pose.easting_m + east_m, northing_m=pose.northing_m + north_m)
            for east_m, north_m in steps
        ]
        here, east, west, north, south = (self.by_class(poses) * self.reader.learnt.scaling).sum(axis=1).tolist()
        bend = min(2 * here - east - west, 2 * here - north - south) / _STEP_M**2
        return float(np.clip(1 / math.sqrt(bend), LEAST_SIGMA_M, MOST_SIGMA_M)) if bend > 0 else MOST_SIGMA_M

    @cached_property
    def information_nats(self) -> float:
        """Return the information in known cells: cells by class, times mutual information and scale of evidence."""
        learnt, seen = self.reader.learnt, self.query.evidence
        known = {name: float((layer <= PRESENT).sum()) for name, layer in zip(seen.classes, seen.cells, strict=True)}
        return sum(
            known.get(name, 0.0) * information(rates, age_years=self.age_years) * float(scaling)
            for name, rates, scaling in zip(learnt.classes, learnt.rates, learnt.scaling, strict=True)
        )
