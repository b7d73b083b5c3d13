# SPDX-License-Identifier: Apache-2.0
"""`graph_only`: numbers of objects by kind and their distances from each other, without overlap of rasters."""

import math
from dataclasses import dataclass
from functools import lru_cache
from typing import Final, Self

import geopandas as gpd
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from sasgeo_baselines.global_descriptor import Descriptor, components, lattice_m, separate
from sasgeo_bench import (
    PRESENT,
    UNKNOWN,
    WITHHELD,
    Chart,
    Disc,
    Evidence,
    MapGraph,
    Match,
    MatcherCard,
    Prior,
    Query,
    Region,
    at_place,
    block_max,
    build_graph,
    is_blind,
    make_features,
    points_of,
    ranked_candidates,
)

# A crossing connects nothing: one road is above the other. Dead ends are ignored: gaps in perception make more.
KINDS: Final = (
    *("intersection", "large intersection", "crossing", "level_crossing"),
    *("road_rail_crossing", "road_water_crossing", "building"),
)


@dataclass(frozen=True, kw_only=True)
class Nodes:
    """Places, shape (N, 2), and kinds of nodes, shape (N,), as indices into `KINDS`, with a tree for look-up."""

    places_m: NDArray[np.float64]
    kind: NDArray[np.int64]
    tree: cKDTree

    @classmethod
    def of(cls, graph: MapGraph) -> Self:
        """Return the nodes of a graph that are of `KINDS`."""
        names = graph.nodes["kind"].to_numpy(dtype=object)
        # 4: road ends that meet: a crossroads, not a fork
        is_large = (names == "intersection") & (graph.nodes["degree"].to_numpy() >= 4)
        names = np.where(is_large, "large intersection", names)
        kind = np.array([KINDS.index(name) if name in KINDS else -1 for name in names], dtype=np.int64)
        chosen = kind >= 0
        points = graph.nodes.geometry.array[chosen]
        places_m = np.column_stack((points.x, points.y)).astype(np.float64).reshape(-1, 2)
        return cls(places_m=places_m, kind=kind[chosen], tree=cKDTree(places_m))

    @classmethod
    def seen(cls, vectors: gpd.GeoDataFrame, *, epsg: int) -> Self:
        """Derive the nodes of perceived vectors as those of the map are derived; places are (right, up), metres."""
        count = len(vectors)
        columns = {
            "osm_type": ["way"] * count,
            "osm_id": np.arange(count),
            "version": np.ones(count, dtype=np.int32),
            "timestamp": [None] * count,
            "class": vectors["class"].to_list(),
            "level": vectors["level"].to_numpy(),
            "is_bridge": vectors["is_bridge"].to_numpy(),
            "is_tunnel": np.zeros(count, dtype=bool),
            "is_visible": np.ones(count, dtype=bool),
            "width_m": np.full(count, np.nan),
            "geometry": np.asarray(vectors.geometry.array),
        }
        return cls.of(build_graph(make_features(columns, epsg=epsg)))

    def around(self, place_m: tuple[float, float], radius_m: float) -> Descriptor:
        """Describe the nodes within a distance of a place, kind by kind."""
        near = np.array(sorted(self.tree.query_ball_point(place_m, radius_m)), dtype=np.int64)
        kind, places_m = self.kind[near], self.places_m[near]
        return Descriptor.of([places_m[kind == at] for at in range(len(KINDS))], reach_m=2 * radius_m)


STEP_M: Final = 32.0
NEAR_M: Final = 16.0  # a candidate may be moved so far, east and north
APART_M: Final = 25.0
MOST_TRIED: Final = 1000  # places of a lattice; a larger prior has a wider one
_AROUND: Final = np.array([(east, north) for north in (1, 0, -1) for east in (-1, 0, 1)], dtype=np.float64)


class GraphOnly:
    """Rank places by the graph descriptor alone, and by the nodes of the map graph where vectors were seen."""

    card = MatcherCard(
        name="graph_only",
        version="1",
        title="Graph descriptor alone",
        source="SASGeo paper (Trukhina and Vashkelis), the graph descriptor of its Section VI; Eq. 9 is its proposal",
        ours=(
            "For every class the number of connected patches of at least 9 m2 and a histogram of the distances of "
            "their centroids, in the largest disc within the view, on cells of 2 m; what is unknown is allowed for by "
            "the share of the disc that is known. With perceived vectors the same of junctions of three and of more "
            "roads, crossings with and without connection, and buildings, of a graph derived from the vectors as the "
            "map's is, and the mean of both. A candidate is the best of nine places 16 m apart; localization tries a "
            "lattice of 32 m, wider where that were more than 1000 places, then the places around the best 24"
        ),
        licence="Apache-2.0",
        tracks=("retrieval", "localization"),
        limits=(
            "No overlap, no correspondences: heading is the prior's (north if unknown), scale 1, places are no finer "
            "than 16 m; a patch that the disc cuts counts as one; no confidence"
        ),
    )

    def __init__(self) -> None:
        self._chart: Chart | None = None

    def prepare(self, region: Region, learned: str | None) -> None:
        """Read the layers and the nodes of the map."""
        del learned
        self._chart = Chart.of(region)
        self._used = self._chart.used()
        self._nodes = Nodes.of(region.graph)

    def match(self, query: Query, *, top_k: int) -> Match:
        """Rank candidates, or places of a lattice, by the distance of descriptors."""
        if self._chart is None:
            raise RuntimeError(f"{self.card.name}: call prepare() with a region before match()")
        if is_blind(query) and (query.vectors is None or query.vectors.empty):
            return WITHHELD
        view = _ViewOnMap.of(query, self._chart, self._nodes, used=self._used)
        diagnostics = {"known_share": 1.0 - query.evidence.unknown_share}
        if query.track == "retrieval":
            best = [view.scores(place_m + NEAR_M * _AROUND).max() for place_m in points_of(query.candidates)]
            kept = [float(score) if math.isfinite(score) else None for score in best]
            return ranked_candidates(query, kept, top_k=top_k, diagnostics=diagnostics)
        points_m, scores = _searched(view, query.prior)
        chosen = separate(points_m, scores, apart_m=APART_M, most=top_k)
        poses = [at_place(points_m[at], query.prior) for at in chosen]
        return Match(poses=poses, scores=[float(scores[at]) for at in chosen], diagnostics=diagnostics)


@dataclass(frozen=True, kw_only=True)
class _ViewOnMap:
    """Descriptors of a view within its largest disc, and the map to compare with.

    `things` describes the layers of the classes in `bands`, of which the shares `shares` are known; `seen_nodes`
    describes the perceived vectors, None without.
    """

    chart: Chart
    nodes: Nodes
    radius_m: float
    bands: NDArray[np.int64]
    shares: NDArray[np.float64]
    things: Descriptor
    seen_nodes: Descriptor | None

    @classmethod
    def of(cls, query: Query, chart: Chart, nodes: Nodes, *, used: NDArray[np.bool_]) -> Self:
        """Describe a view; classes that the map holds nowhere, by `used`, are ignored."""
        view, radius_m = query.evidence, min(query.evidence.size_m) / 2
        inside = _disc(view.shape)
        known = np.array([(layer != UNKNOWN)[inside].mean() for layer in view.cells])
        mapped = {name for name, is_used in zip(chart.classes, used, strict=True) if is_used}
        chosen = [at for at, name in enumerate(view.classes) if name in mapped and known[at] > 0]
        seen = None
        if query.vectors is not None:
            seen = Nodes.seen(query.vectors, epsg=chart.grid.epsg).around((0.0, 0.0), radius_m)
        return cls(
            chart=chart,
            nodes=nodes,
            radius_m=radius_m,
            bands=np.array([chart.classes.index(view.classes[at]) for at in chosen], dtype=np.int64),
            shares=known[chosen],
            things=_things_of(view, chosen, radius_m),
            seen_nodes=seen,
        )

    def scores(self, points_m: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return minus the distance of each place, shape (N,); minus infinity where the map is unknown."""
        return np.array([self._score(place_m) for place_m in points_m])

    def _score(self, place_m: NDArray[np.float64]) -> float:
        factor = _factor(self.chart.grid.cell_size_m)
        size = max(1, round(2 * self.radius_m / (self.chart.grid.cell_size_m * factor)))
        corner = self.chart.grid.to_uv(place_m[None])[0] - size * factor / 2
        col, row = np.rint(corner.round(6)).astype(np.int64).tolist()
        *layers, known = self.chart.blocks(row, col, size, factor, self.bands)
        inside = _disc((size, size))
        share = float(known[inside].mean())
        if share == 0:
            return -math.inf
        found = []
        if len(self.bands):
            mapped = _described(
                [layer * inside for layer in layers], self.chart.grid.cell_size_m * factor, self.radius_m
            )
            found.append(self.things.scaled(np.full(len(layers), share)).distance(mapped.scaled(self.shares)))
        if self.seen_nodes is not None:
            east_m, north_m = place_m.tolist()
            found.append(self.seen_nodes.distance(self.nodes.around((east_m, north_m), self.radius_m)))
        return -sum(found) / len(found) if found else 0.0


def _searched(view: _ViewOnMap, prior: Prior) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return places within the prior, shape (N, 2), and scores: of a lattice, then around its best places."""
    grid, step_m = view.chart.grid, STEP_M
    points_m = lattice_m(prior, grid, step_m=step_m)
    if len(points_m) > MOST_TRIED:
        step_m *= math.ceil(math.sqrt(len(points_m) / MOST_TRIED))
        points_m = lattice_m(prior, grid, step_m=step_m)
    scores = view.scores(points_m)
    west_m, south_m, east_m, north_m = grid.bounds_m
    disc = Disc(center_m=prior.center_m, radius_m=prior.radius_m or 0.0)
    while step_m > NEAR_M:
        step_m /= 2
        best = points_m[separate(points_m, scores, apart_m=APART_M, most=24)]
        near = (best[:, None] + step_m * _AROUND[_AROUND.any(axis=1)]).reshape(-1, 2)
        on_map = ((near >= (west_m, south_m)) & (near <= (east_m, north_m))).all(axis=1)
        near = near[on_map & disc.holds(near)]
        points_m, scores = np.concatenate((points_m, near)), np.concatenate((scores, view.scores(near)))
    return points_m, scores


def _things_of(view: Evidence, chosen: list[int], radius_m: float) -> Descriptor:
    factor = _factor(view.cell_size_m)
    layers = [block_max((view.cells[at] == PRESENT).astype(np.uint8), factor) for at in chosen]
    return _described([layer * _disc(layer.shape) for layer in layers], view.cell_size_m * factor, radius_m)


def _described(layers: list[NDArray[np.uint8]], cell_size_m: float, radius_m: float) -> Descriptor:
    return Descriptor.of([components(layer, cell_size_m=cell_size_m) for layer in layers], reach_m=2 * radius_m)


def _factor(cell_size_m: float) -> int:
    return max(1, round(2.0 / cell_size_m))  # 2 m: finer patches cost more and add nothing


@lru_cache(maxsize=16)
def _disc(shape: tuple[int, ...]) -> NDArray[np.bool_]:
    rows, cols = (np.arange(count) + 0.5 - count / 2 for count in shape)
    found = np.asarray(np.hypot(*np.meshgrid(rows, cols, indexing="ij")) <= min(shape) / 2)
    found.flags.writeable = False
    return found
