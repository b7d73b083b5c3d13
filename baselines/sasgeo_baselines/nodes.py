# SPDX-License-Identifier: Apache-2.0
"""Nodes of a map graph, or of the graph of perceived vectors, by kind: junctions, crossings, buildings."""

from dataclasses import dataclass
from typing import Final, Self

import geopandas as gpd
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from sasgeo_baselines.descriptor import Descriptor
from sasgeo_bench import MapGraph, build_graph, make_features

# A crossing connects nothing: one road is above the other. Dead ends are ignored: gaps in perception make more.
KINDS: Final = (
    *("intersection", "large intersection", "crossing", "level_crossing"),
    *("road_rail_crossing", "road_water_crossing", "building"),
)
_LARGE: Final = 4  # road ends that meet: a crossroads, not a fork


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
        is_large = (names == "intersection") & (graph.nodes["degree"].to_numpy() >= _LARGE)
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
